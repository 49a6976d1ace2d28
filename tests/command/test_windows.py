"""On Windows, as far as Linux can show it: many laboratory computers run it."""

import ctypes
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.scenes.comb_video import frames_of, positions, write_video
from vision import files
from vision.memory import put_rows, table_in_file

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="shown on Linux alone")
ROOT = Path(__file__).resolve().parents[2]
PAPER = ROOT / "fixtures" / "paper"


def windows(*arguments, folder, program=("-m", "tests.scenes.windows")):
    """Run the command without what POSIX systems alone have."""
    command = [sys.executable, *program, *map(str, arguments)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, check=False, cwd=folder, env=environment, capture_output=True, text=True)
    return done.returncode, done.stderr


def test_the_main_job_runs_and_replaces_its_run(tmp_path):
    """A failure means that `track` ends in an unexpected error on Windows."""
    film = [
        PAPER / "video.avi",
        "--pixel-size",
        "10",
        "--timestamps",
        PAPER / "timestamps.txt",
        "--out",
        "r",
    ]
    force = ["--force", PAPER / "force.txt", "--d0", "13", "--offset", "36"]
    assert windows(*film, "--no-report", folder=tmp_path)[0] == 0
    before = pd.read_csv(tmp_path / "r" / "tracks.csv")
    assert windows(*film, *force, "--overwrite", folder=tmp_path)[0] == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["r"]
    assert (tmp_path / "r" / "deformation.csv").exists()
    pd.testing.assert_frame_equal(pd.read_csv(tmp_path / "r" / "tracks.csv"), before)


STORES_AT_ONCE = """
from tests.scenes.windows import become_windows

become_windows()
from vision.command import main
from vision.run.reading import Checkpoint

Checkpoint.__init__.__kwdefaults__["after_s"] = 0
raise SystemExit(main())
"""


def test_frames_stored_for_resume_are_removed(tmp_path):
    """A failure means that every long film leaves a hidden folder behind, as open files cannot be removed."""
    film = [PAPER / "video.avi", "--out", "r", "--no-report"]
    assert windows(*film, folder=tmp_path, program=("-c", STORES_AT_ONCE))[0] == 0
    assert [path.name for path in tmp_path.iterdir()] == ["r"]


WINDOWS = """
from pathlib import Path
from tests.scenes.windows import become_windows

become_windows()
from vision import folder, locks
from vision.command import main
"""


def test_what_a_killed_run_left_is_removed_but_not_what_one_writes(tmp_path):
    """A failure means that hidden folders pile up, or that two runs remove each other's files."""
    for name in (".r.1.part", ".r.2.old", ".r.reading", ".r.3.part"):
        (tmp_path / name).mkdir()
    held = "lock = locks.lock_folder(Path('.r.3.part'))\nassert not locks.lock_folder(Path('.r.3.part'))\n"
    film = [PAPER / "video.avi", "--out", "r", "--no-report"]
    assert windows(*film, folder=tmp_path, program=("-c", f"{WINDOWS}{held}raise SystemExit(main())"))[0] == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == [".r.3.part", "r"]
    assert windows(*film, "--overwrite", folder=tmp_path)[0] == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["r"]


OPENED_MEANWHILE = f"""{WINDOWS}
import importlib

module = importlib.import_module("vision.command.track")
analyse = module.analyse

def then_open(*given, **options):
    global file
    analysis = analyse(*given, **options)
    file = open("r/tracks.csv")
    return analysis

module.analyse = then_open
raise SystemExit(main())
"""


def test_a_run_that_another_program_has_open_is_not_replaced(tmp_path):
    """A failure means that a table that Excel shows costs an hour's tracking, or is found at its end."""
    film = [PAPER / "video.avi", "--out", "r", "--no-report"]
    assert windows(*film, folder=tmp_path)[0] == 0
    held = f"{WINDOWS}file = open('r/tracks.csv')\n"
    program = ("-c", f"{held}raise SystemExit(main())")
    status, said = windows(*film, "--overwrite", folder=tmp_path, program=program)
    assert status == 2
    assert "found tracks.csv: the process cannot access the file" in said
    assert sorted(path.name for path in tmp_path.iterdir()) == ["r"]

    program = ("-c", OPENED_MEANWHILE)
    status, said = windows(*film, "--overwrite", folder=tmp_path, program=program)
    assert status == 2
    assert "the new run is in r_2; close its files" in said
    assert (tmp_path / "r" / "tracks.csv").read_bytes() == (tmp_path / "r_2" / "tracks.csv").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["r", "r_2"]


REVIEWS = f"""{WINDOWS}
from tests.scenes.reviewed import SETTINGS
from tests.scenes.windows import held
from vision.errors import InputError
from vision.review.saving import save_decisions
from vision.review.session import Session

with Session(Path("r"), SETTINGS) as session:
    session.tiles.part(0, 0, 0)
    assert held("r") is None
    job, file, said = session.job([], []), open("r/tracks.csv"), []
    try:
        save_decisions(job, said.append)
    except InputError as error:
        assert "expected a folder that no program uses" in str(error)
    assert said == ["reading the run"]
"""


def test_a_review_leaves_its_run_closed(tmp_path):
    """A failure means that no decision of a review can be saved on Windows, since the run cannot be replaced,
    or that it is measured again before that is said."""
    assert windows(PAPER / "video.avi", "--out", "r", "--no-report", folder=tmp_path)[0] == 0
    status, said = windows(folder=tmp_path, program=("-c", REVIEWS))
    assert status == 0, said


SCANNED = f"""{WINDOWS}
import threading

with folder.run_folder(Path("r")) as made:
    file = (made / "run.json").open("w")
    threading.Timer(0.3, file.close).start()
"""


def test_a_virus_scanner_may_look_at_a_new_run(tmp_path):
    """A failure means that a run is lost, since one of its files was open for a moment."""
    status, said = windows(folder=tmp_path, program=("-c", SCANNED))
    assert status == 0, said
    assert (tmp_path / "r" / "run.json").exists()


def test_a_parser_is_tried_out_in_a_process_without_limits(tmp_path):
    """A failure means that no MATLAB file can be read on Windows, or that a damaged one is."""
    (tmp_path / "pull.mat").write_bytes(b"MATLAB 5.0 MAT-file" + bytes(200))
    status, said = windows("force", "pull.mat", folder=tmp_path)
    assert status == 2
    assert said.startswith("track: pull.mat: expected a MATLAB .mat file; found")


def test_a_pattern_that_the_shell_does_not_expand(tmp_path):
    """A failure means that `track *.avi` finds no film in the command prompt."""
    for name in ("a.avi", "b.avi"):
        write_video(tmp_path / name, frames_of(positions(30)))
    assert windows("*.avi", "--no-report", folder=tmp_path)[0] == 0
    assert sorted(path.name for path in tmp_path.glob("*_tracks")) == ["a_tracks", "b_tracks"]


def test_the_c_library_is_that_of_linux_alone(monkeypatch):
    """A failure means that a call of Linux is looked for where ctypes raises TypeError for it."""
    monkeypatch.setattr(files.sys, "platform", "win32")
    assert files.c_library() is None
    monkeypatch.setattr(files.sys, "platform", "linux")
    assert isinstance(files.c_library(), ctypes.CDLL)


def test_tables_in_files_without_calls_of_posix(tmp_path, monkeypatch):
    """A failure means that a film whose I(x, t) does not fit into memory is not tracked on Windows."""
    for name in ("posix_fallocate", "pwrite"):
        monkeypatch.delattr(f"os.{name}", raising=False)
    monkeypatch.delattr("mmap.MADV_DONTNEED", raising=False)
    table = table_in_file((100, 7), tmp_path)
    rows = np.arange(140, dtype=np.float32).reshape(20, 7)
    put_rows(table, 30, rows)
    np.testing.assert_array_equal(table[30:50], rows)
    assert not table[50:].any()
