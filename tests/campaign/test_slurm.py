"""On a SLURM of this one machine: `pytest -m slow tests/campaign/test_slurm.py`, as root.

Debian: apt-get install slurm-wlm munge. The test starts the daemons where none answer, and ends those.
"""

import csv
import json
import os
import re
import shutil
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.campaign.scenes import environment, films, table
from tests.scenes.waiting import until
from vision.campaign import jobs

pytestmark = pytest.mark.slow
pytest.importorskip("snakemake_executor_plugin_slurm", reason="pip install '.[campaign]'")
HERE = Path(__file__).parents[2]
CONF = Path("/etc/slurm/slurm.conf")
DAEMONS = ("slurmctld", "slurmd", "munged")
ONE_NODE = """
ClusterName=one
SlurmctldHost={host}
AuthType=auth/munge
SlurmUser=root
StateSaveLocation={place}
SlurmdSpoolDir={place}/slurmd
SlurmctldPidFile={place}/slurmctld.pid
SlurmdPidFile={place}/slurmd.pid
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
ReturnToService=2
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
NodeName={host} CPUs={cores} RealMemory={memory} State=UNKNOWN
PartitionName=main Nodes={host} Default=YES MaxTime=INFINITE State=UP
"""


def command(*words):
    return subprocess.run(words, capture_output=True, text=True, check=False).stdout


def idle():
    known = shutil.which("sinfo") is not None
    return known and bool(re.search("idle|mix|alloc", command("sinfo", "-h", "-o", "%T")))


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """A node that takes jobs; skipped, and said, where there is none and none can be started."""
    if idle():
        yield
        return
    absent = [name for name in DAEMONS if shutil.which(name, path=f"{os.environ['PATH']}:/usr/sbin") is None]
    if absent or os.getuid() != 0:
        pytest.skip(f"no SLURM answers and none can be started ({', '.join(absent) or 'not root'})")
    place = tmp_path_factory.mktemp("slurm")
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") * 85 // 100 >> 20
    facts = {"host": socket.gethostname(), "cores": os.cpu_count(), "memory": memory, "place": place}
    made = not CONF.exists()
    if made:  # where every step of a job looks for it; the environment does not reach them
        CONF.parent.mkdir(exist_ok=True)
        CONF.write_text(ONE_NODE.format(**facts))
    Path("/run/munge").mkdir(exist_ok=True)
    shutil.chown("/run/munge", "munge", "munge")
    munge = ["runuser", "-u", "munge", "--", "/usr/sbin/munged", "-F"]
    nowhere, started = subprocess.DEVNULL, []
    try:
        for words in (munge, ["slurmctld", "-D"], ["slurmd", "-D"]):
            started.append(subprocess.Popen(words, stdout=nowhere, stderr=nowhere))
            time.sleep(2)
        if not any(idle() or time.sleep(1) for _ in range(20)):
            pytest.skip("SLURM's daemons do not start here")
        yield
    finally:
        for process in reversed(started):
            process.terminate()
            process.wait(30)
        if made:
            CONF.unlink()


def held(out):
    """Stop a running job in the middle of a good film, so that it cannot end first: its number, or ""."""
    if len(list(out.glob("runs/*/run.json"))) < 2:
        return ""
    plan = json.loads((out / "plan.json").read_text())["jobs"]
    for line in command("squeue", "-h", "-t", "running", "-o", "%i %k").splitlines():
        number, _, comment = line.partition(" ")
        names = next((job["films"] for key, job in plan.items() if key in comment), [])
        states = [out / "states" / f"{name}.json" for name in names if name != "t7"]
        if not any(is_running(file) for file in states):
            continue
        command("scancel", "--full", "--signal=STOP", number)
        time.sleep(1)  # it has stopped, or had ended before
        if any(is_running(file) for file in states):
            return number
        command("scancel", "--full", "--signal=CONT", number)
    return ""


def is_running(state):
    return state.exists() and json.loads(state.read_text())["state"] == "running"


def test_forty_films_one_killed_job_one_drained_node_one_bad_film(cluster, tmp_path):
    """A failure means that what happens on a cluster every week costs the other films, or is not said."""
    films(tmp_path, 40, frames=60)
    (tmp_path / "t7.tif").write_bytes(b"II*\0nothing")
    path, out = table(tmp_path / "t.csv", [f"t{k}.tif" for k in range(40)], fps=20), tmp_path / "out"
    profile = tmp_path / "profile"
    shutil.copytree(jobs.HERE / "profiles" / "slurm", profile)
    settings = (profile / "config.yaml").read_text()
    settings = settings.replace("checks: 15", "checks: 5").replace("checks: 10", "checks: 5")
    (profile / "config.yaml").write_text(settings + "slurm-status-command: squeue\n")
    asked = [str(path), "--out", str(out), "--executor", "slurm", "--profile", str(profile), "--cores", "4"]
    process = subprocess.Popen(
        [sys.executable, "-m", "vision.command", "campaign", *asked, "--no-report"],
        env=environment(HERE), cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        killed = until(lambda: held(out), 300)
        subprocess.run(["scancel", "--full", "--signal=KILL", killed], check=True)
        name = command("sinfo", "-h", "-o", "%n").split()[0]
        subprocess.run(["scontrol", "update", f"nodename={name}", "state=drain", "reason=test"], check=True)
        time.sleep(8)
        subprocess.run(["scontrol", "update", f"nodename={name}", "state=resume"], check=True)
        said, complained = process.communicate(timeout=600)
    finally:
        process.kill()
    assert process.returncode == 1
    with (out / "campaign.csv").open() as file:
        found = {Path(row["film"]).stem: row for row in csv.DictReader(file)}
    assert [name for name, row in found.items() if row["state"] != "done"] == ["t7"]
    assert "expected a TIFF" in found["t7"]["reason"]
    assert "t7: failed" in complained
    assert "40 tests: 39 done, 1 failed" in said
    states = [json.loads(file.read_text()) for file in (out / "states").glob("*.json")]
    assert {state["name"] for state in states if state["attempts"] > 1} > {"t7"}  # and what was killed
    log = (out / "snakemake.log").read_text()
    assert log.count("Trying to restart job") == 2  # the killed one and that of the bad film
