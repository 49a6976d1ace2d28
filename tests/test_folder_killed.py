"""Killed between any two steps of writing and replacing a run folder: the old one whole, or the new one."""

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from vision import folder
from vision.folder import clean_up, run_folder

FILES = ("run.json", "tracks.csv", "tracks.nc")
MOST_STEPS = 400
posix = pytest.mark.skipif(not hasattr(os, "fork"), reason="processes cannot be forked here")


def fill(made, text):
    for name in FILES:
        (made / name).write_text(text)


def replace(target, text="new"):
    with run_folder(target, overwrite=True) as made:
        fill(made, text)


def whole(target):
    """ "old" or "new" where every file is there and of the same run."""
    texts = {(target / name).read_text() for name in FILES}
    assert len(texts) == 1, texts
    assert sorted(p.name for p in target.iterdir()) == sorted(FILES)
    return texts.pop()


def killed_at(step, target, exchange):
    """Whether a process that is killed before its `step`th call of the system got so far."""
    child = os.fork()
    if child == 0:
        left = [step]

        def hook(event, arguments):
            if event.partition(".")[0] in ("os", "shutil", "open", "ctypes", "fcntl", "glob", "tempfile"):
                left[0] -= 1
                if left[0] == 0:
                    os.kill(os.getpid(), signal.SIGKILL)

        if not exchange:
            folder._exchange = lambda one, other: False
        sys.addaudithook(hook)
        try:
            replace(target)
        finally:
            os._exit(0)
    _, status = os.waitpid(child, 0)
    return os.WIFSIGNALED(status)


@posix
@pytest.mark.parametrize("exchange", [True, False])
@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
def test_killed_before_any_call_of_the_system(exchange, tmp_path):
    """A failure means that a kill mixes two runs, loses one, or leaves hidden folders for ever."""
    target, seen = tmp_path / "out", []
    for step in range(1, MOST_STEPS):
        shutil.rmtree(target, ignore_errors=True)
        target.mkdir()
        fill(target, "old")
        ended = not killed_at(step, target, exchange)
        if exchange:
            whole(target)  # at every moment, before anything is put right
        clean_up(target)
        seen.append(whole(target))
        assert [p.name for p in tmp_path.iterdir()] == ["out"], step
        if ended:
            break
    assert ended
    assert seen == ["old"] * seen.count("old") + ["new"] * seen.count("new")
    assert seen.count("old") > 5
    assert seen.count("new") > 3


@pytest.mark.parametrize("exchange", [True, False])
def test_interrupted_before_any_call_of_the_system(exchange, tmp_path):
    """A failure means that Ctrl-C, a time limit or a closed terminal leaves hidden folders or half a run."""
    target, left, seen = tmp_path / "out", [0], []

    def interrupt(event, arguments):
        if event.partition(".")[0] in ("os", "shutil", "open", "ctypes", "fcntl", "glob") and left[0] > 0:
            left[0] -= 1
            if left[0] == 0:
                raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        if not exchange:
            patch.setattr(folder, "_exchange", lambda one, other: False)
        sys.addaudithook(interrupt)  # for the rest of the process, but idle when nothing is left to count
        for step in range(1, MOST_STEPS):
            shutil.rmtree(target, ignore_errors=True)
            target.mkdir()
            fill(target, "old")
            try:
                left[0] = step
                replace(target)
                interrupted = left[0] == 0
                left[0] = 0
            except KeyboardInterrupt:
                interrupted = True
            seen.append(whole(target))
            assert [p.name for p in tmp_path.iterdir()] == ["out"], step
            if not interrupted:
                break
    assert not interrupted
    assert seen == ["old"] * seen.count("old") + ["new"] * seen.count("new")
    assert seen.count("old") > 5
    assert seen.count("new") > 3


SCRIPT = """
import importlib.util, sys
from pathlib import Path
spec = importlib.util.spec_from_file_location("folder", sys.argv[1])
module = sys.modules["folder"] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
with module.run_folder(Path(sys.argv[2]), overwrite=True) as made:
    for name in ("run.json", "tracks.csv", "tracks.nc"):
        (made / name).write_text("new")
"""
CALLS = [("mkdir", 1), ("flock", 1), ("renameat2", 1), ("unlinkat", 1), ("unlinkat", 2), ("unlinkat", 3)]
CALLS += [("unlinkat", 4), ("rmdir", 1), ("write", 2), ("write", 3)]


def strace(*arguments):
    return subprocess.run(["strace", "-f", "-o", os.devnull, *arguments], capture_output=True, check=False)


@pytest.fixture(scope="module")
def tracer():
    if shutil.which("strace") is None or strace("true").returncode != 0:
        pytest.skip("no strace, or it may not trace here")


@pytest.mark.parametrize(("call", "count"), CALLS)
def test_killed_in_a_call_of_the_system(call, count, tracer, tmp_path):
    """The same with the kernel's own calls; a failure means that one of them is not safe to stop in."""
    target = tmp_path / "out"
    target.mkdir()
    fill(target, "old")
    source = str(Path(folder.__file__))
    inject = f"inject={call}:signal=KILL:when={count}"
    environment = ["-E", f"PYTHONPATH={Path(__file__).parents[2]}", "-E", "PYTHONDONTWRITEBYTECODE=1"]
    done = strace("-e", inject, *environment, sys.executable, "-c", SCRIPT, source, str(target))
    assert done.returncode in (0, -signal.SIGKILL, 128 + signal.SIGKILL), done.stderr
    whole(target)
    clean_up(target)
    whole(target)
    assert [p.name for p in tmp_path.iterdir()] == ["out"]
