"""The run folder appears whole or not at all."""

import errno

import pytest

from vision.errors import InputError
from vision.run.folder import run_folder


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
    with pytest.raises(InputError, match="--overwrite"), run_folder(tmp_path / "thesis"):
        pass


def test_a_place_that_cannot_be_written_is_said(tmp_path):
    """A failure means that hours of tracking end in a traceback."""
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError), run_folder(tmp_path / "file" / "out"):
        pass
