"""Folders and files appear whole or not at all, and their JSON is strict."""

from __future__ import annotations

import errno
import json
import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from vision import folder
from vision.errors import InputError
from vision.folder import check_target, run_folder, write_json
from vision.locks import claim
from vision.run.provenance import Parameter


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


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize(("below", "found"), [("", "found a file of this name"), ("run", "found a file at ")])
def test_a_file_in_the_place_of_a_run_folder_is_said(tmp_path, below, found, overwrite):
    """A failure means advice that cannot work: a file is never overwritten, and no right is missing."""
    (tmp_path / "notes").write_text("years of work")
    with pytest.raises(InputError, match=found), run_folder(tmp_path / "notes" / below, overwrite=overwrite):
        pass
    assert (tmp_path / "notes").read_text() == "years of work"


def test_only_run_folders_are_ever_overwritten(tmp_path):
    """A failure means that --overwrite can delete a folder that is not ours."""
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter1.tex").write_text("years of work")
    with pytest.raises(InputError, match=r"no run\.json"), run_folder(tmp_path / "thesis", overwrite=True):
        pass
    assert (tmp_path / "thesis" / "chapter1.tex").exists()
    with pytest.raises(InputError, match="overwrite"), run_folder(tmp_path / "thesis"):
        pass


def test_what_overwrite_does_not_change_is_said_at_once(tmp_path):
    """A failure means that `overwrite` is asked for, and the folder is then refused all the same."""
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match=r"a new folder, or a run folder to overwrite; found something else"):
        check_target(tmp_path, overwrite=False)
    (tmp_path / "run.json").write_text("{}")
    with pytest.raises(InputError, match="give `overwrite`"):
        check_target(tmp_path, overwrite=False)


def test_an_empty_folder_is_used_without_being_asked(tmp_path):
    """A failure means that a folder made for the results must be deleted first."""
    (tmp_path / "out").mkdir()
    with run_folder(tmp_path / "out") as folder:
        write_run(folder)
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"run.json", "tracks.csv"}
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


@pytest.mark.posix
@pytest.mark.parametrize("there", [True, False])
def test_a_link_to_a_folder_stays(there, tmp_path):
    """A failure means that results which were linked to another disk go to this one, or are refused."""
    elsewhere = tmp_path / "disk" / "results"
    elsewhere.parent.mkdir()
    if there:
        elsewhere.mkdir()
    (tmp_path / "run").symlink_to(elsewhere)
    for overwrite in (False, True):
        with run_folder(tmp_path / "run", overwrite=overwrite) as path:
            write_json({"overwrite": overwrite}, path / "run.json")
        assert (tmp_path / "run").is_symlink()
        assert json.loads((elsewhere / "run.json").read_text(encoding="utf-8")) == {"overwrite": overwrite}


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


def test_a_drive_that_is_not_there_is_said(tmp_path, monkeypatch):
    """A failure means a traceback on Windows, where a disk was unplugged or has another letter."""
    monkeypatch.setattr(Path, "exists", lambda path: False)
    with pytest.raises(InputError, match="found no such drive or server"):
        check_target(tmp_path / "out", overwrite=False)


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


def test_one_at_a_time_holds_a_claim_which_leaves_no_file(tmp_path):
    """A failure means that two reviews of one run begin together, or that hidden files stay beside it."""
    file, busy, held, most = tmp_path / ".r.review", InputError("r", "a", "b"), [], []

    def take_turns(_):
        for _ in range(200):
            try:
                with claim(file, busy, "") as lock:
                    held.append(lock)
                    most.append(len(held))
                    held.remove(lock)
            except InputError as error:
                assert error is busy

    with ThreadPoolExecutor(8) as threads:
        list(threads.map(take_turns, range(8)))
    assert max(most) == 1
    assert not any(tmp_path.iterdir())


def test_a_claim_is_of_the_file_that_is_there(tmp_path, monkeypatch):
    """A failure means that two hold it, if one opened the file before its last holder removed it."""
    file, lock = tmp_path / ".r.review", pytest.importorskip("fcntl").flock
    monkeypatch.setattr("fcntl.flock", lambda *of: (file.unlink(), monkeypatch.undo(), lock(*of)))
    with claim(file, InputError("r", "a", "first"), ""), pytest.raises(InputError, match="second"):
        claim(file, InputError("r", "a", "second"), "")


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
