"""Tables in temporary files: their values, their memory, and what they leave behind."""

import json
import pickle
import platform
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from tests.scenes.comb_video import frames_of, positions
from tests.scenes.films import write_avi
from vision.mapped import give_back, give_back_freed, parts_in_turn, put_rows, some_rows, table_in_file
from vision.sheets import track_sheets
from vision.video import VideoSettings, open_video, strip_profile

needs_proc = pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="no peak of the memory")


@pytest.fixture
def table(tmp_path):
    """700 rows of 100 columns in a file."""
    made = table_in_file(700, 100, tmp_path)
    made[:] = np.arange(70_000).reshape(700, 100)
    return made


def test_values_outlast_their_memory(table):
    """Failure: positions come from zeros, or from what another thread has not written yet."""
    expected = np.arange(70_000, dtype=np.float32).reshape(700, 100)
    for values in (table, table[3:5], table[:, 60:], table[::7, ::3], table[:0], expected):
        give_back(values)
        assert np.array_equal(table, expected)
    table[650] = -1
    give_back(table[640:660])
    assert (table[650] == -1).all()
    assert [rows.stop for rows in parts_in_turn(table, 300)] == [300, 600, 700]
    rows = np.array([699, 0, *range(5, 45)])
    assert np.array_equal(some_rows(table, rows), table[rows])


@pytest.mark.parametrize("where", ["file", "rows of it", "columns of it", "memory"])
def test_rows_are_put_where_they_belong(table, where):
    """Failure: I(x, t) of a long film has frames in the wrong place, or of another type."""
    places = {"file": np.s_[:], "rows of it": np.s_[100:600], "columns of it": np.s_[:, 10:20]}
    target = table[places[where]] if where in places else np.array(table)
    expected, whole = target.copy(), table.copy()
    rng = np.random.default_rng(1)
    for start, count in ((450, 50), (0, 3), (7, 0)):
        rows = np.asfortranarray(rng.normal(size=(count, target.shape[1])))
        put_rows(target, start, rows)
        expected[start : start + count] = rows
    assert np.array_equal(target, expected)
    if where in places:
        whole[places[where]] = expected
    assert np.array_equal(table, whole)


def test_it_is_an_array_as_any_other(table, tmp_path):
    """Failure: a strip cannot be stored, copied or sent to another process, or leaves a file behind."""
    assert type(table) is np.ndarray
    assert list(tmp_path.iterdir()) == []  # a killed process leaves nothing either
    assert np.array_equal(pickle.loads(pickle.dumps(table)), table)
    view, copied = table[100:200], table.copy()
    assert np.array_equal(view, copied[100:200])


def test_tracks_of_a_strip_in_a_file_are_the_same(tmp_path):
    """Failure: long films have other positions than short ones."""
    film = open_video(write_avi(tmp_path / "a.avi", frames_of(positions(frames=400))))
    in_memory = strip_profile(film, slice(0, 12))
    in_file = strip_profile(film, slice(0, 12), settings=VideoSettings(spill_bytes=1000))
    in_file.attrs = in_memory.attrs  # which state the setting
    xr.testing.assert_identical(track_sheets(in_file), track_sheets(in_memory))


@needs_proc
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="a function of the GNU C library")
def test_memory_between_what_is_in_use_is_given_back():
    """Failure: what a stage has freed stays with the process, and the next stage adds its own."""

    def resident():
        lines = Path("/proc/self/status").read_text().splitlines()
        return int(next(line.split()[1] for line in lines if line.startswith("VmRSS"))) << 10

    made = [np.ones(5000) for _ in range(2000)]  # 40 kB each, which the C library does not map one by one
    kept = made[::10]
    del made
    before = resident()
    give_back_freed()
    assert before - resident() > 40 << 20
    assert all((one == 1).all() for one in kept)


CHILD = """
import json, sys
from vision.sheets import track_sheets
from vision.video import open_video, strip_profile
def peak():
    lines = open("/proc/self/status").read().splitlines()
    return int(next(line.split()[1] for line in lines if line.startswith("VmHWM"))) << 10
def tracked(frames):
    strip = strip_profile(open_video(sys.argv[1], frames=frames), slice(0, 2))
    track_sheets(strip)
    return strip.nbytes
tracked(slice(0, 2000))  # what does not depend on the number of frames
open("/proc/self/clear_refs", "w").write("5")
before = peak()
print(json.dumps([tracked(None), before, peak()]))
"""


@pytest.mark.thorough
@needs_proc
def test_a_long_strip_is_not_in_memory(tmp_path):
    """Failure: memory holds all of I(x, t), so that a long film takes all of it."""
    moving = frames_of(positions(frames=60, sheets=4, pitch_px=40.0), width_px=2000, rows=2)
    film = write_avi(tmp_path / "a.avi", np.tile(moving, (200, 1, 1)))
    done = subprocess.run(
        [sys.executable, "-c", CHILD, str(film)], capture_output=True, text=True, check=True
    )
    strip, before, after = json.loads(done.stdout)
    assert strip > VideoSettings.spill_bytes
    assert after - before < 0.6 * strip  # all of it is more
