"""Parsers in a process of their own: bounded, blind to the working directory, ended with their parent."""

import os
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from tests.scenes.waiting import until
from vision.errors import InputError
from vision.files import READ_HDF5, READ_MATLAB, check_regular, read_toml, reading, try_out


@pytest.fixture
def matlab(tmp_path):
    savemat(tmp_path / "a.mat", {"t": np.arange(50.0)})
    return tmp_path / "a.mat"


def test_whole_files_pass(matlab, tmp_path):
    """A failure means that good recordings are refused."""
    try_out(matlab, READ_MATLAB, "a .mat file")
    with h5py.File(tmp_path / "a.nc", "w") as file:
        file["x"] = np.arange(5)
    try_out(tmp_path / "a.nc", READ_HDF5, "a netCDF file")


@pytest.mark.parametrize(
    ("parser", "found", "seconds"),
    [
        pytest.param("import os; os.kill(os.getpid(), 11)", "SIGSEGV", 60, marks=pytest.mark.posix),
        ("while True: pass", "does not end", 0.5),
        ("bytearray(1 << 40)", "asks for more memory", 60),
        ("raise TypeError('a\\nb')", "found a damaged or incomplete one; save", 60),
        ("import os; os._exit(7)", "damaged or incomplete", 60),
    ],
)
def test_whatever_a_parser_does_is_one_line(parser, found, seconds, matlab):
    """A failure means that a damaged file ends, or holds up, the program itself."""
    with pytest.raises(InputError, match=found) as caught:
        try_out(matlab, parser, "a .mat file", seconds=seconds)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("error", "found"),
    [
        (TypeError("'<' not supported between instances of 'tuple' and 'int'"), "found a damaged one; copy"),
        (AssertionError(), "found a damaged one; copy"),
        (ValueError("Error tokenizing data. C error: EOF inside string"), "a quotation mark is never closed"),
        (KeyError("offset_s"), "'offset_s' is missing"),
        (KeyError(270), "found a damaged one; copy"),
        (UnicodeDecodeError("utf-8", b"\xff", 0, 1, "invalid start byte"), "its text is not UTF-8"),
    ],
)
def test_a_damaged_file_is_described_without_words_of_python(error, found, tmp_path):
    """A failure means that a user reads "AssertionError" where the file should be copied again."""
    with pytest.raises(InputError, match=found) as caught, reading(tmp_path / "a", "a recording"):
        raise error
    assert "Error" not in str(caught.value)


def test_what_is_wrong_with_a_toml_file_is_said(tmp_path):
    """A failure means that a typing error in a long file of options is not found."""
    (tmp_path / "a.toml").write_text("strip = '60:144'\nfps 60\n")
    with pytest.raises(InputError, match="line 2"):
        read_toml(tmp_path / "a.toml", "options", "mend it")


def test_folders_that_an_import_puts_first_for_a_while_do_not_matter(matlab, monkeypatch):
    """A failure means that a sound file is refused now and then: OpenCV does this while it is imported."""
    (matlab.parent / "typing.py").write_text("raise ImportError('not the one of Python')")
    monkeypatch.setattr(sys, "path", [str(matlab.parent), *sys.path])
    try_out(matlab, READ_MATLAB, "a .mat file")


def test_modules_beside_the_data_are_not_run(matlab, monkeypatch):
    """A failure means that opening a folder of someone's data runs their code."""
    monkeypatch.chdir(matlab.parent)
    monkeypatch.setenv("PYTHONPATH", ".")
    monkeypatch.setattr(sys, "path", ["", *sys.path])
    for name in ("pickle", "scipy", "json", "ctypes"):
        (matlab.parent / f"{name}.py").write_text("open('executed', 'w')")
    try_out(matlab, READ_MATLAB, "a .mat file")
    assert not (matlab.parent / "executed").exists()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="prctl is Linux's")
def test_it_ends_with_its_parent(matlab, tmp_path):
    """A failure means that a killed run leaves a process that eats a core."""
    code = (
        "from vision.files import try_out; from pathlib import Path\n"
        'parser = "import os, time;'
        " print(os.getpid(), file=open('pid', 'w'), flush=True); time.sleep(999)\"\n"
        f"try_out(Path({str(matlab)!r}), parser, 'x', seconds=600)"
    )
    place = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    parent = subprocess.Popen([sys.executable, "-c", code], cwd=tmp_path, env=place)
    pid = until(lambda: (tmp_path / "pid").exists() and (tmp_path / "pid").read_text().strip())
    parent.kill()
    parent.wait()
    until(lambda: not alive(int(pid)))


def alive(pid):
    """Whether a process runs; a dead one that nobody waits for does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.parametrize(
    ("asked", "there", "advice"),
    [
        ("test.avi", "test.mkv", "did you mean test.mkv"),
        pytest.param("Test.AVI", "test.avi", "did you mean test.avi", marks=pytest.mark.posix),
        ("pull_13mn.csv", "pull_13mm.csv", "did you mean pull_13mm.csv"),
        ("test.avi", "other.txt", "check the path"),
    ],
)
def test_missing_files_suggest_a_similar_name(asked, there, advice, tmp_path):
    """A failure means that a slip of the pen is not answered with the name of the file beside it."""
    (tmp_path / there).touch()
    with pytest.raises(InputError, match=f"found no such file; {advice}"):
        check_regular(tmp_path / asked, "a video")


@pytest.mark.posix
def test_a_link_to_nothing_is_named_as_such(tmp_path):
    """A failure means that a link to a film on a disk that was unmounted is answered with its own name."""
    (tmp_path / "test.avi").symlink_to(tmp_path / "away.avi")
    with pytest.raises(InputError, match=r"found a link to .*away\.avi, which does not exist"):
        check_regular(tmp_path / "test.avi", "a video")


def test_a_missing_file_in_a_missing_folder(tmp_path):
    """A failure means a traceback where the folder does not exist, either."""
    with pytest.raises(InputError, match="no such file; check the path"):
        check_regular(tmp_path / "absent" / "test.avi", "a video")
