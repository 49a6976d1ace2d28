"""Damaged and odd files that once ended in a traceback, a hang, a crash or a silent loss."""

import signal
import tarfile
from pathlib import Path

import pytest

from vision.command.main import run

ARCHIVE = Path(__file__).parents[2] / "../shared/data/broken.tar.xz"
pytestmark = [
    pytest.mark.skipif(not ARCHIVE.is_file(), reason="the damaged files are not here"),
    pytest.mark.usefixtures("without_pictures"),
]
LIMIT_S = 300  # of one file on a busy machine; on a quiet one each takes less than two
TABLES = {".csv", ".txt", ".mat"}
SAID = {  # what must be said of files that lose frames
    "front_half.tif": "19 of 40",
    "cut10.tif": "39 of 40",
    "t1.mkv": "cut short",
    "2a3d169b.webm": "missing",
}


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("broken")
    with tarfile.open(ARCHIVE) as archive:
        # Python before 3.11.4 has no filters
        archive.extractall(folder, **({"filter": "data"} if hasattr(tarfile, "data_filter") else {}))
    return sorted(path for path in folder.rglob("*") if path.is_file() and not path.name.startswith("run_"))


def late(number, frame):
    raise TimeoutError("no answer within the limit")


@pytest.mark.thorough
def test_every_damaged_file_ends_in_a_line_or_says_what_is_missing(files, tmp_path, monkeypatch, capsys):
    """A failure means a traceback, a hang, or frames that are lost without a word."""
    monkeypatch.chdir(tmp_path)
    signal.signal(signal.SIGALRM, late)
    wrong = []
    for path in files:
        film = path.suffix not in TABLES
        command = [str(path), "--no-report"] if film else ["force", str(path), "--d0", "50"]
        signal.alarm(LIMIT_S)
        status = run([*command, "--quiet", "--out", "run", "--overwrite"])
        signal.alarm(0)
        said = capsys.readouterr().err
        if status not in (0, 1, 2) or "Traceback" in said or (status == 2 and said.count("\n") != 1):
            wrong.append((path.name, status, said[:200]))
        if path.name in SAID and (status != 1 or SAID[path.name] not in said):
            wrong.append((path.name, status, said[:200]))
    assert len(files) > 45
    assert wrong == []
