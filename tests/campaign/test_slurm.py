"""On a SLURM of this one machine: `pytest -m slow tests/campaign/test_slurm.py`, as root.

Debian: apt-get install slurm-wlm munge. The test starts the daemons where none answer, and ends those.
"""

import csv
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.campaign.scenes import environment, films, table
from vision.campaign.engine import profile_of

pytestmark = pytest.mark.slow
pytest.importorskip("snakemake_executor_plugin_slurm", reason="pip install '.[campaign]'")
HERE = Path(__file__).parents[2]
SETUP = HERE / "../shared/slurm-one-node.sh"


def command(*words):
    return subprocess.run(words, capture_output=True, text=True, check=False).stdout


def idle():
    return shutil.which("sinfo") is not None and bool(
        re.search("idle|mix|alloc", command("sinfo", "-h", "-o", "%T"))
    )


@pytest.fixture(scope="module")
def cluster():
    """A node that takes jobs; skipped, and said, where there is none and none can be started."""
    if not idle():
        if shutil.which("slurmctld") is None or os.getuid() != 0 or not SETUP.exists():
            pytest.skip("no SLURM here, and none can be started (root, slurm-wlm and munge are needed)")
        subprocess.run(["bash", SETUP], check=True, capture_output=True)
    if not idle():
        pytest.skip("SLURM's daemons do not start here")
    return command("hostname").strip()


def jobs(state):
    return command("squeue", "-h", "-t", state, "-o", "%i").split()


def until(ready, seconds=150):
    end = time.monotonic() + seconds
    while not ready():
        assert time.monotonic() < end, "it never came"
        time.sleep(0.5)


def test_forty_films_one_killed_job_one_drained_node_one_bad_film(cluster, tmp_path):
    """A failure means that what happens on a cluster every week costs the other films, or is not said."""
    films(tmp_path, 40, frames=60)
    (tmp_path / "t7.tif").write_bytes(b"II*\0nothing")
    path, out = table(tmp_path / "t.csv", [f"t{k}.tif" for k in range(40)], fps=20), tmp_path / "out"
    profile = tmp_path / "profile"
    shutil.copytree(profile_of("slurm"), profile)
    settings = (profile / "config.yaml").read_text()
    settings = settings.replace("checks: 15", "checks: 5").replace("checks: 10", "checks: 5")
    (profile / "config.yaml").write_text(settings + "slurm-status-command: squeue\n")
    asked = [str(path), "--out", str(out), "--executor", "slurm", "--profile", str(profile), "--cores", "4"]
    process = subprocess.Popen(
        [sys.executable, "-m", "vision.command", "campaign", *asked, "--no-report"],
        env=environment(HERE), cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        until(lambda: jobs("running") and len(list(out.glob("runs/*/run.json"))) >= 2)
        killed = jobs("running")[0]
        subprocess.run(["scancel", "--full", "--signal=KILL", killed], check=True)
        name = command("sinfo", "-h", "-o", "%n").split()[0]
        subprocess.run(["scontrol", "update", f"nodename={name}", "state=drain", "reason=test"], check=True)
        time.sleep(8)
        subprocess.run(["scontrol", "update", f"nodename={name}", "state=resume"], check=True)
        said, complained = process.communicate(timeout=400)
    finally:
        process.kill()
    assert process.returncode == 1
    with (out / "campaign.csv").open() as file:
        found = {Path(row["film"]).stem: row for row in csv.DictReader(file)}
    assert [name for name, row in found.items() if row["state"] != "done"] == ["t7"]
    assert "expected a TIFF" in found["t7"]["reason"]
    assert "t7: failed" in complained
    assert "40 tests: 39 done, 1 failed" in said
    log = (out / "snakemake.log").read_text()
    assert log.count("Trying to restart job") == 2  # the killed one and that of the bad film
