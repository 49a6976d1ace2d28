"""Runs killed at random moments: python -m tests.kill --cases 200 --seed 7.

Each case starts `track` in a process of its own over an earlier run, sends it (or its whole group) SIGKILL,
SIGTERM or SIGINT at a random moment, and looks at what is there; then a run resumes and must give what an
undisturbed one gives.
"""

import argparse
import json
import os
import shutil
import signal
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr

from tests.scenes.comb_video import frames_of, positions
from tests.scenes.films import write_avi
from tests.scenes.undrawn import undraw
from vision.command.main import main as track
from vision.command.main import run
from vision.folder import reading_folder
from vision.run.reading import Checkpoint

FRAMES = {"old": 150, "new": 200}
SHEETS = 8
FILES = ("run.json", "tracks.csv", "tracks.nc", "sheets.csv", "kymograph.tif", "overview.png", "figures.npz")
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
LIMIT_S = 300


def start(words, said):
    """`track` in a process and a group of its own; what it says goes to a file."""
    child = os.fork()
    if child:
        os.setpgid(child, child)  # here too: the signal may come before the child does it
        return child
    try:
        os.setpgid(0, 0)
        out = os.open(said, os.O_CREAT | os.O_WRONLY | os.O_TRUNC)
        os.dup2(out, 1)
        os.dup2(out, 2)
        Checkpoint.__init__.__kwdefaults__["after_s"] = 0.0  # frames are kept from the first on
        track(words)
    except SystemExit as end:
        os._exit(int(end.code or 0))
    os._exit(99)  # a traceback


def ended(child):
    """Exit status as a shell gives it, and the seconds until it came."""
    began = time.monotonic()
    while time.monotonic() - began < LIMIT_S:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            code = os.waitstatus_to_exitcode(status)
            return (128 - code if code < 0 else code), time.monotonic() - began
        time.sleep(0.002)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return "hang", LIMIT_S


def found(target):
    """ "old" or "new" for a whole run folder, else what is wrong with it."""
    missing = [name for name in FILES if not (target / name).is_file()]
    if missing:
        return f"no {missing}"
    frames = json.loads((target / "run.json").read_text())["frames"]["read"]
    which = next((name for name, count in FRAMES.items() if count == frames), f"{frames} frames")
    table = pd.read_csv(target / "tracks.csv")
    with xr.open_dataset(target / "tracks.nc", engine="h5netcdf") as tracks:
        whole = tracks["x_px"].shape == (frames, SHEETS)
    if len(table) != frames * SHEETS or not whole:
        return f"{len(table)} rows of {frames} frames"
    return which


def one_case(case, place, words, whole_s, random, references):
    """What went wrong, "" for nothing; and the seconds from the signal to the end."""
    target, said = place / "out", place / "said.txt"
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(references["old"], target)
    sent = SIGNALS[int(random.integers(len(SIGNALS)))]
    group = bool(random.integers(2))
    child = start([*words, "--overwrite"], said)
    late = random.random() < 0.3  # near the replacement
    time.sleep(random.uniform(0.8 if late else 0.0, 1.1) * whole_s)
    (os.killpg if group else os.kill)(child, sent)
    status, seconds = ended(child)
    which = found(target)
    if which not in FRAMES:
        return f"{sent.name}: the folder is {which}", seconds
    hidden = {p.name for p in place.glob(".out.*")}
    told = {signal.SIGKILL: 137, signal.SIGTERM: 130, signal.SIGINT: 130}[sent]
    early = status == 128 + sent and sent != signal.SIGKILL  # before Python had its handlers
    if status not in (0, told) and not early:
        return f"{sent.name}: status {status}; {said.read_text()[-500:]}", seconds
    if sent != signal.SIGKILL and hidden - {reading_folder(target).name} and not early:
        return f"{sent.name}: {hidden} left", seconds
    status, _ = ended(start([*words, "--overwrite", "--resume"], said))
    if status != 0 or found(target) != "new":
        return f"{sent.name}: the next run: {status}; {said.read_text()[-500:]}", seconds
    if (target / "tracks.csv").read_bytes() != (references["new"] / "tracks.csv").read_bytes():
        return f"{sent.name}: the resumed run has other positions", seconds
    hidden = [p.name for p in place.glob(".*") if p.name.startswith(".out")]
    return (f"{sent.name}: {hidden} left by the next run" if hidden else ""), seconds


def main():
    """Exit status 1 if a case failed."""
    parser = argparse.ArgumentParser(prog="python -m tests.kill", description=__doc__)
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--quick", action="store_true", help="no pictures are drawn")
    given = parser.parse_args()
    if given.quick:
        undraw()  # pictures take most of a short run's time
    place = Path(tempfile.mkdtemp(prefix="kill-"))
    film = write_avi(place / "film.avi", frames_of(positions(frames=FRAMES["new"])))
    words = [str(film), "--no-report", "--quiet", "--sheets", str(SHEETS)]
    references, whole_s = {}, 0.0
    for name, count in FRAMES.items():
        references[name] = place / f"reference_{name}"
        part = ["--frames", f"0:{count}", "--out", str(references[name])]
        assert run([*words, *part]) == 0  # in this process: those that are killed begin with all loaded
    status, whole_s = ended(start([*words, "--out", str(place / "timed")], place / "said.txt"))
    assert status == 0, (place / "said.txt").read_text()
    failures, slowest_s = 0, 0.0
    words += ["--out", str(place / "out")]
    for case in range(given.cases):
        random = np.random.default_rng([given.seed, case])
        wrong, seconds = one_case(case, place, words, whole_s, random, references)
        slowest_s = max(slowest_s, seconds)
        failures += bool(wrong)
        if wrong:
            sys.stdout.write(f"--- case {case}: {wrong}\n")
            shutil.rmtree(place / "out", ignore_errors=True)
        if wrong or (case + 1) % 10 == 0:
            sys.stdout.write(f"{case + 1} of {given.cases}, {failures} failed\n")
            sys.stdout.flush()
    shutil.rmtree(place)
    sys.stdout.write(
        f"{given.cases} cases, {failures} failed; a run takes {whole_s:.2f} s, "
        f"the slowest end after a signal {slowest_s:.2f} s\n"
    )
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
