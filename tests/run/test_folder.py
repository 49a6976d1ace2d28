"""The run folder appears whole or not at all, and says where its numbers come from."""

from __future__ import annotations

import errno
import hashlib
import json
import math
import os
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from vision.errors import InputError
from vision.run import folder
from vision.run.folder import run_folder, write_json
from vision.run.provenance import MIB, PARTS, Checksums, Parameter, describe_input
from vision.run.tables import attrs_of_netcdf, netcdf_attrs


def write_run(folder, text="{}"):
    (folder / "run.json").write_text(text)
    (folder / "tracks.csv").write_text("x")


def test_everything_appears_at_once(tmp_path):
    """A failure means that a reader can meet half a run."""
    with run_folder(tmp_path / "deep" / "out") as folder:
        write_run(folder)
        assert not (tmp_path / "deep" / "out").exists()
    assert {p.name for p in (tmp_path / "deep" / "out").iterdir()} == {"run.json", "tracks.csv"}
    assert [p.name for p in (tmp_path / "deep").iterdir()] == ["out"]


@pytest.mark.parametrize("error", [KeyboardInterrupt(), ValueError("x"), MemoryError()])
def test_an_interrupted_run_leaves_nothing_and_the_earlier_run_stays(tmp_path, error):
    """A failure means that Ctrl-C destroys results."""
    with run_folder(tmp_path / "out") as folder:
        write_run(folder, "first")
    with pytest.raises(type(error)), run_folder(tmp_path / "out", overwrite=True) as folder:
        write_run(folder, "second")
        raise error
    assert (tmp_path / "out" / "run.json").read_text() == "first"
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_a_full_disk_is_one_line(tmp_path):
    """A failure means a traceback, or a silent loss, when the disk is full."""
    with pytest.raises(InputError, match="full disk"), run_folder(tmp_path / "out"):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert list(tmp_path.iterdir()) == []


def test_only_run_folders_are_ever_overwritten(tmp_path):
    """A failure means that --overwrite can delete a folder that is not ours."""
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter1.tex").write_text("years of work")
    with pytest.raises(InputError, match=r"no run\.json"), run_folder(tmp_path / "thesis", overwrite=True):
        pass
    assert (tmp_path / "thesis" / "chapter1.tex").exists()
    with pytest.raises(InputError, match="overwrite"), run_folder(tmp_path / "thesis"):
        pass


def test_folders_made_for_a_run_that_failed_are_gone(tmp_path):
    """A failure means that empty folders stay where nothing was written."""
    with pytest.raises(ValueError, match="x"), run_folder(tmp_path / "a" / "b" / "out"):
        raise ValueError("x")
    with pytest.raises(ValueError, match="x"), folder.whole_file(tmp_path / "a" / "b.png"):
        raise ValueError("x")
    assert list(tmp_path.iterdir()) == []


def test_a_place_that_cannot_be_written_is_said(tmp_path):
    """A failure means that hours of tracking end in a traceback."""
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError), run_folder(tmp_path / "file" / "out"):
        pass


def leave_behind(folder, name, text):
    (folder / name).mkdir()
    write_run(folder / name, text)


def test_what_a_killed_process_left_is_removed(tmp_path):
    """A failure means that hidden folders pile up beside the data."""
    with run_folder(tmp_path / "out") as folder:
        write_run(folder, "first")
    leave_behind(tmp_path, ".out.0123abcd.part", "half")
    leave_behind(tmp_path, ".other.0123abcd.part", "not ours")
    with run_folder(tmp_path / "out", overwrite=True) as folder:
        write_run(folder, "second")
    assert {p.name for p in tmp_path.iterdir()} == {"out", ".other.0123abcd.part"}


def test_a_run_that_was_moved_aside_is_put_back(tmp_path):
    """A failure means that a kill between two renames loses the earlier run."""
    leave_behind(tmp_path, ".out.0123abcd.old", "first")
    with pytest.raises(InputError, match="overwrite"), run_folder(tmp_path / "out"):
        pass
    assert (tmp_path / "out" / "run.json").read_text() == "first"
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_two_runs_at_once_do_not_remove_each_other_s_files(tmp_path):
    """A failure means that a run started meanwhile deletes what another is writing."""
    with run_folder(tmp_path / "out") as first:
        write_run(first, "first")
        with run_folder(tmp_path / "out2") as other:
            write_run(other)
        folder.clean_up(tmp_path / "out")
        assert (first / "run.json").read_text() == "first"


@pytest.mark.parametrize("exchange", [True, False])
def test_an_earlier_run_is_replaced_whole(exchange, tmp_path, monkeypatch):
    """A failure means that files of two runs are mixed, or that a copy of the old one stays."""
    if not exchange:
        monkeypatch.setattr(folder, "_exchange", lambda one, other: False)
    for text in ("first", "second"):
        with run_folder(tmp_path / "out", overwrite=True) as made:
            write_run(made, text)
            (made / text).touch()
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"run.json", "tracks.csv", "second"}
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


# --- run.json -----------------------------------------------------------------------------------------------


def test_the_checksum_of_a_small_input_is_that_of_all_of_it(tmp_path):
    """A failure means that run.json names another file than the one that was tracked."""
    data = bytes(range(256)) * (MIB // 200)  # a little over one chunk
    (tmp_path / "a.bin").write_bytes(data)
    facts = describe_input(tmp_path / "a.bin")
    assert facts["sha256"] == hashlib.sha256(data).hexdigest()
    assert facts["size_bytes"] == len(data)


@pytest.mark.parametrize("given", ["f", "f/*.bin", "*/*.bin"])
def test_folders_and_patterns_are_hashed_as_one(given, tmp_path, monkeypatch):
    """A failure means that a series of images has no checksum, or one that changes with the order."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "f").mkdir()
    for name in "cab":
        (tmp_path / "f" / f"{name}.bin").write_bytes(name.encode())
    assert describe_input(Path(given))["sha256"] == hashlib.sha256(b"abc").hexdigest()


def test_a_large_input_has_a_fingerprint_that_sees_its_ends_and_its_size(tmp_path):
    """A failure means that a film that was cut or replaced passes as the one that was tracked."""
    path = tmp_path / "big.bin"
    with path.open("wb") as file:
        file.truncate((PARTS + 40) * MIB)  # takes no room
    plain = describe_input(path)
    assert "sha256" not in plain
    with path.open("r+b") as file:
        file.seek(-1, 2)
        file.write(b"x")
    changed = describe_input(path)
    with path.open("r+b") as file:
        file.truncate((PARTS + 41) * MIB)
    longer = describe_input(path)
    assert len({facts["fingerprint"] for facts in (plain, changed, longer)}) == 3
    assert describe_input(path, whole=True)["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()


def test_an_input_that_is_gone_is_one_line(tmp_path, monkeypatch):
    """A failure means that a drive pulled out in the middle ends in a traceback."""
    (tmp_path / "a.bin").write_bytes(b"a")

    def gone(*arguments, **options):
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(Path, "open", gone)
    with pytest.raises(InputError, match=r"a\.bin.*input/output error"):
        describe_input(tmp_path / "a.bin")


@dataclass
class Fact:
    value: float


def test_json_is_strict_and_null_where_there_is_no_number(tmp_path):
    """A failure means that other programs cannot read run.json."""
    content = {
        "nan": math.nan,
        "array": np.array([1.0, np.inf]),
        "fact": Fact(np.float64(2)),
        "given": Parameter(slice(1, 2), "given"),
        3: (np.int64(4), True, None, Path("a")),
    }
    write_json(content, tmp_path / "a.json")
    read = json.loads((tmp_path / "a.json").read_text(), parse_constant=pytest.fail)
    assert read == {
        "nan": None,
        "array": [1.0, None],
        "fact": {"value": 2.0},
        "given": {"value": "slice(1, 2, None)", "how": "given"},
        "3": [4, True, None, "a"],
    }


def test_attributes_come_back_from_netcdf_as_they_were():
    """A failure means that a film called [1].avi makes a run that cannot be read."""
    attrs = {"source": "[1].avi", "note": '"quoted"', "list": [1, "a"], "plain": "x", "number": 2.0}
    assert attrs_of_netcdf(netcdf_attrs(attrs)) == attrs
    assert netcdf_attrs({"source": "a\udcff.avi"}) == {"source": "a?.avi"}


def test_many_images_have_one_fingerprint_that_sees_the_first_the_last_and_their_sizes(tmp_path, monkeypatch):
    """A failure means that a folder of 100 000 images is read twice, or that one that was changed passes."""
    monkeypatch.setattr("vision.run.provenance.MIB", 100)
    for n in range(40):
        (tmp_path / f"{n:02d}.bin").write_bytes(bytes([n]) * 333)
    plain = describe_input(tmp_path)
    assert "sha256" not in plain
    assert plain["size_bytes"] == 40 * 333
    seen = {plain["fingerprint"]}
    for n in (0, 39):
        data = (tmp_path / f"{n:02d}.bin").read_bytes()
        (tmp_path / f"{n:02d}.bin").write_bytes(b"x" + data[1:-1] + b"y")
        seen.add(describe_input(tmp_path)["fingerprint"])
    os.truncate(tmp_path / "17.bin", 332)
    seen.add(describe_input(tmp_path)["fingerprint"])
    assert len(seen) == 4
    every = b"".join(file.read_bytes() for file in sorted(tmp_path.iterdir()))
    assert describe_input(tmp_path, whole=True)["sha256"] == hashlib.sha256(every).hexdigest()


def test_checksums_beside_the_reading_are_those_of_the_whole_files(tmp_path):
    """A failure means that --checksum names other files than those that were read."""
    files = [tmp_path / "a.bin", tmp_path / "b.bin"]
    for k, file in enumerate(files):
        file.write_bytes(bytes([k]) * (3 * MIB + 17))
    with Checksums(files) as sums:
        progress = sums.following(None)
        for done in range(5):
            progress(done, 5)
        found = sums.found()
    assert found == {file: describe_input(file, whole=True) for file in files}


class Watched(Checksums):
    """Keeps what was read whenever it looks at the film's place."""

    read = 0

    def _wait(self, done, size):
        self.read = done
        super()._wait(done, size)


def test_checksums_do_not_run_ahead_of_the_film(tmp_path, monkeypatch):
    """A failure means that a film larger than the memory is read from the disk twice."""
    monkeypatch.setattr("vision.run.provenance.AHEAD_BYTES", MIB)
    file = tmp_path / "a.bin"
    file.write_bytes(bytes(20 * MIB))
    with Watched([file]) as sums:
        for share, expected in ((0, 2), (25, 7), (50, 12)):  # the film's place, one MiB, and where it waits
            sums.following(None)(share, 100)
            until = time.monotonic() + 120
            while sums.read < expected * MIB and time.monotonic() < until:
                time.sleep(0.01)
            time.sleep(0.05)
            assert sums.read == expected * MIB
        assert sums.found()[file]["size_bytes"] == 20 * MIB
    assert sums.read == 20 * MIB


def test_an_input_that_cannot_be_read_for_its_checksum_is_one_line(tmp_path, monkeypatch):
    """A failure means that the thread's error is lost, and a run without a checksum passes for whole."""

    def gone(*arguments, **options):
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr("vision.run.provenance._parts", gone)
    with Checksums([tmp_path]) as sums, pytest.raises(InputError, match="input/output error"):
        sums.found()


def test_a_run_that_fails_does_not_wait_for_its_checksum(tmp_path, monkeypatch):
    """A failure means that Ctrl-C, or the next film, waits until 100 GB are read."""
    monkeypatch.setattr("vision.run.provenance.AHEAD_BYTES", 0)
    (tmp_path / "a.bin").write_bytes(bytes(20 * MIB))
    with Checksums([tmp_path / "a.bin"]) as sums:
        thread = sums._thread
    thread.join(5)
    assert not thread.is_alive()
