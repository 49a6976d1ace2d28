"""Tables in temporary files: their values, their memory, and what they leave behind; and tables of words,
which are text to whoever reads them, and a byte each until then."""

import gc
import json
import mmap
import os
import pickle
import platform
import subprocess
import sys
import weakref
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import xarray as xr

from tests.scenes.comb_video import frames_of, positions
from tests.scenes.combs import comb, ridges, strip
from tests.scenes.films import write_avi
from vision import memory
from vision.memory import (
    give_back,
    give_back_freed,
    in_two_threads,
    parts_in_turn,
    put_rows,
    some_rows,
    table_beside,
    table_in_file,
)
from vision.numeric import typical
from vision.sheets import track_sheets
from vision.video import VideoSettings, open_video, strip_profile
from vision.words import is_word, word_codes, word_counts, words, words_of_characters

needs_proc = pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="no peak of the memory")


@pytest.fixture
def table(tmp_path):
    """700 rows of 100 columns in a file."""
    made = table_in_file((700, 100), tmp_path)
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


@pytest.mark.parametrize("kept", [0, 1 << 30])
def test_tables_beside_one_in_a_file_are_in_files(table, monkeypatch, kept):
    """Failure: tables of positions of a long film fill the memory, or a full disk ends its run."""
    beside = table_beside(table[5:], (2, 50, 3), np.float64, "F")
    assert isinstance(beside.base, mmap.mmap)
    beside[:] = np.arange(300).reshape(2, 50, 3)
    monkeypatch.setattr(memory, "_KEPT_BYTES", kept)
    assert in_two_threads(lambda n: beside[0, n, 0], [0, 49]) == [0, 147]
    assert np.array_equal(beside.ravel(), np.arange(300))
    in_memory = [table_beside(np.zeros(3), (4, 5)), table_beside(table, (0, 5))]
    monkeypatch.setattr(os, "posix_fallocate", Mock(side_effect=OSError), raising=False)
    in_memory.append(table_beside(table, (4, 5)))
    assert [one.base for one in in_memory] == [None, None, None]


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
    # a killed process leaves nothing either: on Windows the system removes the file
    assert os.name != "posix" or list(tmp_path.iterdir()) == []
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


def resident():
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line.split()[1] for line in lines if line.startswith("VmRSS"))) << 10


def test_what_refers_to_itself_is_freed_beside_tables_in_files(table):
    """Failure: what earlier stages of a long film left remains in memory until it is written, 40 MiB."""
    old: dict[str, object] = {"array": np.ones(3)}
    old["itself"] = old
    array = weakref.ref(old["array"])
    gc.collect()  # it is among the oldest now
    del old
    give_back_freed()
    assert array() is None
    assert table[1, 0] == 100


@needs_proc
def test_a_typical_value_leaves_nothing_in_memory(tmp_path):
    """Failure: each of the large tables that the report looks at stays in memory."""
    made = table_in_file((50_000, 100), tmp_path)
    made[:] = 1
    give_back(made)
    before = resident()
    assert typical(made) == typical(made[:, 0]) == 1
    assert resident() - before < 10 << 20  # of 19 MiB


@needs_proc
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="a function of the GNU C library")
def test_memory_between_what_is_in_use_is_given_back():
    """Failure: what a stage has freed stays with the process, and the next stage adds its own."""
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


# --- tables of words ----------------------------------------------------------------------------------------

LISTED = ("ok", "missing", "left_out")
CODES = np.random.default_rng(0).integers(0, 3, (5000, 4)).astype(np.uint8)
TEXT = np.array(LISTED)[CODES]


@pytest.fixture
def flags():
    return xr.DataArray(words(CODES, LISTED), dims=("frame", "sheet"), coords={"frame": np.arange(5000)})


def test_the_values_are_text(flags):
    """A failure means that a script that reads flags finds something else."""
    assert flags.dtype == TEXT.dtype
    assert flags.shape == TEXT.shape
    np.testing.assert_array_equal(flags.values, TEXT)
    np.testing.assert_array_equal(np.asarray(flags), TEXT)


@pytest.mark.parametrize(
    "part",
    [np.s_[3], np.s_[:, 1], np.s_[10:20, ::2], np.s_[-1, -1], np.s_[[4, 2], :], np.s_[[4, 2], [0, 3, 1]]],
)
def test_parts_are_those_of_the_text(flags, part):
    """A failure means that flags are those of other positions."""
    rows, sheets = part if isinstance(part, tuple) else (part, slice(None))
    expected = xr.DataArray(TEXT, dims=("frame", "sheet"))[rows, sheets]
    np.testing.assert_array_equal(flags[rows, sheets].values, expected.values)
    np.testing.assert_array_equal(flags.isel(frame=rows).isel(sheet=sheets).values, expected.values)


def test_single_positions_and_masks_are_those_of_the_text(flags):
    """A failure means that a list of positions has the flags of others."""
    at = {"frame": xr.DataArray([7, 2, 2], dims="one"), "sheet": xr.DataArray([0, 3, 1], dims="one")}
    np.testing.assert_array_equal(flags.isel(at).values, TEXT[[7, 2, 2], [0, 3, 1]])
    some = (CODES == 1).any(axis=1)
    np.testing.assert_array_equal(flags[some].values, TEXT[some])
    np.testing.assert_array_equal(flags.sel(frame=slice(5, 9)).values, TEXT[5:10])
    np.testing.assert_array_equal(flags.transpose("sheet", "frame").values, TEXT.T)


def test_they_compare_as_text(flags):
    """A failure means that a selection by flag is empty."""
    np.testing.assert_array_equal((flags == "ok").values, TEXT == "ok")
    np.testing.assert_array_equal((flags != "missing").values, TEXT != "missing")
    np.testing.assert_array_equal(flags.isin(["ok", "left_out"]).values, np.isin(TEXT, ("ok", "left_out")))
    np.testing.assert_array_equal(flags.where(flags == "ok", "no").values, np.where(TEXT == "ok", "ok", "no"))


@pytest.mark.parametrize("deep", [False, True])
def test_copies_and_pickles_are_equal_and_independent(flags, deep):
    """A failure means that a change of a copy changes the tracks, or is lost."""
    copied, stored = flags.copy(deep=deep), pickle.loads(pickle.dumps(flags))
    xr.testing.assert_identical(stored, flags)
    xr.testing.assert_identical(copied, xr.DataArray(TEXT, flags.coords, flags.dims))
    if deep:
        copied[0, 0] = "missing" if TEXT[0, 0] == "ok" else "ok"
        assert flags[0, 0] == TEXT[0, 0]
        assert copied[0, 0] != TEXT[0, 0]


def test_they_can_be_changed(flags):
    """A failure means that a script that sets a flag does not, without a word."""
    flags[3, 1] = "left_out"
    assert flags[3, 1] == "left_out"
    flags.values[4, 2] = "left_out"
    assert flags.values[4, 2] == "left_out"
    flags.loc[{"frame": 5}] = "missing"
    assert (flags.sel(frame=5) == "missing").all()
    assert (np.array([LISTED.index(word) for word in TEXT.ravel()]).reshape(TEXT.shape) == CODES).all()


def test_they_are_found_and_counted(flags):
    """A failure means wrong numbers of missing positions in the summary."""
    np.testing.assert_array_equal(is_word(flags, "ok", "missing"), np.isin(TEXT, ("ok", "missing")))
    assert word_counts(flags) == {word: int((word == TEXT).sum()) for word in sorted(LISTED)}
    text = xr.DataArray(TEXT, dims=("frame", "sheet"))
    assert word_counts(text) == word_counts(flags)
    assert word_counts(flags[:0]) == {}
    assert is_word(flags[:0], "ok").shape == (0, 4)
    for part in (flags[::-1], flags[[2, 0], 1:], flags[1], flags.T, flags[1:].copy(deep=True)):
        np.testing.assert_array_equal(is_word(part, "ok"), part.values == "ok")


def test_tracks_are_written_and_tabulated_with_their_flags(tmp_path):
    """A failure means that tracks in pandas or netCDF lack flags."""
    tracks = track_sheets(strip(ridges(comb(60, per_side=8, axis_px=260), width=520)))
    flag = tracks["flag"].values
    table = tracks[["x_px", "flag"]].to_dataframe()
    np.testing.assert_array_equal(table["flag"].to_numpy().reshape(flag.shape), flag)
    plain = tracks[["x_px", "flag", "why"]].drop_attrs()
    plain.to_netcdf(tmp_path / "tracks.nc", engine="h5netcdf")
    with xr.open_dataset(tmp_path / "tracks.nc", engine="h5netcdf") as stored:
        np.testing.assert_array_equal(stored["flag"].values.astype(str), flag)
        np.testing.assert_array_equal(stored["why"].values.astype(str), tracks["why"].values)


def characters(text):
    """Each word as characters, along a further axis."""
    text = np.asarray(text, "S")
    return xr.DataArray(text.view("S1").reshape(*text.shape, text.itemsize))


def test_words_are_read_from_their_characters():
    """A failure means that the flags of a run are others than those that were written."""
    flags = np.array([["ok", "missing", "ok"], ["edge", "ok", ""]])
    read = xr.Variable(("frame", "sheet"), words_of_characters(characters(flags)))
    assert read.values.tolist() == flags.tolist()
    assert read[1, :2].values.tolist() == ["edge", "ok"]


def test_text_that_is_no_table_of_words_is_refused():
    """A failure means that a damaged file gives wrong flags."""
    with pytest.raises((ValueError, OverflowError)):
        words_of_characters(characters([[f"{number}" for number in range(300)]]))


def test_words_are_numbered_as_in_the_list():
    """A failure means that a review shows other flags than the run has."""
    text = xr.DataArray([["ok", "new", "edge"], ["edge", "ok", "other"]], dims=("frame", "sheet"))
    assert word_codes(text, ["missing", "ok", "edge"]).tolist() == [[1, 0, 2], [2, 1, 0]]
    assert word_codes(text[:0], ["ok"]).shape == (0, 3)
