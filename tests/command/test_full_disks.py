"""Disks that are full, cannot be written or disappear: one line, nothing lost, nothing left."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.scenes.comb_video import write_video
from vision.command.main import run
from vision.errors import InputError
from vision.folder import run_folder

pytestmark = pytest.mark.usefixtures("without_pictures")

ROOT = Path(__file__).parents[2]
COMMANDS = {
    "track": ["{film}", "--no-report", "--quiet", "--out", "{disk}/out"],
    "kymograph": ["kymograph", "{run}", "--out", "{disk}/diagram"],
    "export": ["export", "{run}", "--to", "xlsx", "--out", "{disk}/export"],
    "figures": ["figures", "{run}", "--to", "csv", "--out", "{disk}/figures"],
}
LEFT_BYTES = (0, 30_000)
SIZE = 4 << 20

# One process for all: each command on a disk with so much room left. What ends the process is seen.
CHILD = """
import json, os, sys
from pathlib import Path
from tests.scenes.undrawn import undraw
from vision.command.main import main
undraw()
commands, disk, left = json.loads(sys.argv[1])
filler = Path(disk, "filler")
for name, words in commands.items():
    for size in left:
        room = os.statvfs(disk)
        filler.write_bytes(bytes(room.f_bavail * room.f_frsize - size))
        before = sorted(p.name for p in Path(disk).iterdir())
        try:
            main(words)
        except SystemExit as end:
            status = end.code
        after = sorted(p.name for p in Path(disk).iterdir())
        print(json.dumps([name, size, status, sorted(set(after) - set(before))]), flush=True)
        filler.unlink()
"""


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    place = tmp_path_factory.mktemp("run")
    film = write_video(place / "comb.tif")
    assert run([str(film), "--quiet", "--no-report", "--out", str(place / "run")]) == 0
    return film, place / "run"


@pytest.fixture
def disk(tmp_path):
    """A small disk of its own, where one may make one."""
    place = tmp_path / "disk"
    place.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={SIZE}", "none", str(place)]
    if shutil.which("mount") is None or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("no disk may be mounted here")
    yield place
    subprocess.run(["umount", "-l", str(place)], check=True)


def filled(disk, finished):
    film, folder = finished
    words = {
        name: [word.format(film=film, run=folder, disk=disk) for word in command]
        for name, command in COMMANDS.items()
    }
    task = json.dumps([words, str(disk), LEFT_BYTES])
    environment = os.environ | {"PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "ignore"}
    child = [sys.executable, "-c", CHILD, task]
    return subprocess.run(child, capture_output=True, text=True, env=environment, check=False)


@pytest.mark.thorough
def test_every_command_on_a_full_disk_ends_in_one_line(disk, finished):
    """A failure means a killed process (a mapped file that does not fit), a traceback, or rubbish."""
    done = filled(disk, finished)
    assert done.returncode == 0, done.stderr
    outcomes = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("[")]
    assert len(outcomes) == len(COMMANDS) * len(LEFT_BYTES)
    for name, left, status, new in outcomes:
        assert status in (0, 2), name
        assert status == 0 or new == [] or (name, left > 0) == ("figures", True), name  # whole ones may stay
    refused = [o for o in outcomes if o[2] == 2]
    assert {name for name, *_ in refused} == set(COMMANDS)
    said = [line for line in done.stderr.splitlines() if line.startswith("track: ")]
    assert (len(said), len(done.stderr.splitlines())) == (len(refused), len(refused)), done.stderr
    assert all("full disk" in line or "no space" in line for line in said), said


LARGE = """
import sys
from pathlib import Path
import numpy as np
import xarray as xr
from vision.run.tables import write_space_time_tif
coords = {"frame": np.arange(9000), "x": np.arange(400), "time_s": ("frame", np.arange(9000) / 60)}
diagram = xr.DataArray(np.ones((9000, 400), np.float32), dims=("frame", "x"), coords=coords)
try:
    write_space_time_tif(diagram, Path(sys.argv[1], "a.tif"), pixel_size_um=None)
except OSError as error:
    print(error.strerror)
"""


def test_a_diagram_larger_than_the_disk_does_not_kill_the_process(disk):
    """A failure means SIGBUS: pages of a mapped file that the disk has no room for."""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    child = [sys.executable, "-c", LARGE, str(disk)]
    done = subprocess.run(child, capture_output=True, text=True, env=environment, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, "No space left on device"), done.stderr


def test_a_disk_that_cannot_be_written_is_one_line(disk, finished, capsys):
    """A failure means a traceback, hours of work for nothing, or an earlier run that is gone."""
    shutil.copytree(finished[1], disk / "out")
    subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
    film = str(finished[0])
    for words in ([film, "--out", f"{disk}/new"], [film, "--out", f"{disk}/out", "--overwrite"]):
        assert run([*words, "--quiet"]) == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        assert "read-only" in said or "can be written" in said
    assert (disk / "out" / "tracks.csv").read_bytes() == (finished[1] / "tracks.csv").read_bytes()


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_place_that_is_removed_meanwhile_is_one_line(overwrite, tmp_path):
    """A failure means a traceback where someone tidies up during a long run."""
    place = tmp_path / "place"
    place.mkdir()
    with pytest.raises(InputError, match="can be written") as caught:  # noqa: SIM117
        with run_folder(place / "out", overwrite=overwrite) as made:
            (made / "run.json").write_text("{}")
            shutil.rmtree(place)
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []
