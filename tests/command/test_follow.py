"""`track VIDEO --follow` as a process: it shows what it sees, and Ctrl-C ends it with a whole run."""

import json
import os
import re
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from tests.scenes.comb_video import frames_of, positions
from tests.scenes.films import write_avi

ROOT = Path(__file__).parents[2]
COMMAND = [sys.executable, "-m", "tests.scenes.undrawn"]


@pytest.fixture
def film(tmp_path):
    return write_avi(tmp_path / "whole.avi", frames_of(positions(frames=400)))


def grow(source, target, stop):
    data, size = source.read_bytes(), source.stat().st_size // 400
    with target.open("wb", buffering=0) as out:
        for at in range(0, len(data), size):
            out.write(data[at : at + size])
            if stop.wait(0.02):
                return


@pytest.mark.posix
def test_ctrl_c_ends_it_with_a_whole_run(film, tmp_path):
    """A failure means that nothing is seen while the camera writes, or that Ctrl-C loses what was read."""
    growing, stop = tmp_path / "a.avi", threading.Event()
    writer = threading.Thread(target=grow, args=(film, growing, stop))
    writer.start()
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "env": environment}
    with subprocess.Popen([*COMMAND, "a.avi", "--follow", "--out", "out"], **pipes) as process:
        state = process.stderr.readline()
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=300)
    stop.set()
    writer.join()
    assert "8 sheets, noise 0.0" in state
    shown = int(re.match(r"frame (\d+)", state)[1])
    assert (process.returncode, "Traceback" in err) == (1, False), err
    assert "followed up to frame" in err
    facts = json.loads((tmp_path / "out" / "run.json").read_text())
    assert facts["frames"]["read"] > shown
    assert {"tracks.csv", "overview.png", "report.html"} <= {p.name for p in (tmp_path / "out").iterdir()}
    assert "sheets" in out
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.avi", "out", "whole.avi"]


@pytest.mark.parametrize(
    "words", [["whole.avi", "--follow", "--resume"], ["whole.avi", "whole.avi", "--follow"]]
)
def test_what_does_not_go_together_is_refused(words, film, refused):
    """A failure means that one of two contradictory wishes is ignored."""
    assert "--follow" in refused(*words)
