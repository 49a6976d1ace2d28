"""Snakemake as a process: it schedules, here or on a cluster; what became of the films is in their states."""

from __future__ import annotations

import importlib.util
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Literal

from vision.campaign.plan import PLAN, Plan, write_plan
from vision.campaign.states import State, write_state
from vision.campaign.table import is_remote
from vision.errors import InputError
from vision.files import shortened
from vision.run.folder import lock_open_file

HERE = Path(__file__).parent
SNAKEFILE = HERE / "Snakefile"
LOG = "snakemake.log"
JOBS = ".jobs"
PLUGINS = {"https": "http", "gs": "gcs", "az": "azure"}  # not called as their addresses begin


def profile_of(executor: str) -> Path:
    """The shipped profile of an executor."""
    return HERE / "profiles" / executor


def check_engine(executor: str, films: Iterable[str] = ()) -> None:
    """Refuse early where Snakemake, a storage plugin or the cluster's commands are missing.

    Raises
    ------
    InputError
        In one line.
    """
    if importlib.util.find_spec("snakemake") is None:
        raise InputError("track campaign", "Snakemake 9", "none", "pip install 'sheetvision[campaign]'")
    if executor == "slurm" and shutil.which("sbatch") is None:
        raise InputError(
            "`executor`", "SLURM's commands on this machine", "no sbatch", "run it on a login node"
        )
    for film in films:
        kind = film.partition("://")[0]
        plugin = PLUGINS.get(kind, kind)
        if is_remote(film) and importlib.util.find_spec(f"snakemake_storage_plugin_{plugin}") is None:
            advice = f"pip install snakemake-storage-plugin-{plugin}"
            raise InputError(film, f"Snakemake's storage plugin for {kind}://", "none", advice)


@contextmanager
def campaign_lock(out: Path) -> Iterator[None]:
    """Claim a campaign's folder for this process; the claim ends with it, however that ends.

    Raises
    ------
    InputError
        Where another campaign runs there, or the folder cannot be written.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        handle = os.open(out / ".lock", os.O_RDWR | os.O_CREAT, 0o644)
    except OSError as error:
        found = (error.strerror or str(error)).lower()
        raise InputError(out, "a place that can be written", found, "give another `out`") from error
    try:
        try:
            lock_open_file(handle)
        except BlockingIOError as error:
            raise InputError(
                out, "a campaign that does not run", "one that does", "wait for its end"
            ) from error
        except OSError:
            pass  # a file server without locks
        yield
    finally:
        os.close(handle)


def run_snakemake(
    plan: Plan,
    target: Literal["films", "pool"],
    *,
    profile: Path,
    executor: str = "local",
    cores: int | None = None,
    watch: Callable[[], None] | None = None,
) -> int:
    """Run the Snakefile for a written plan.

    Parameters
    ----------
    plan
        The campaign's.
    target
        Its films, or the pool.
    profile
        Folder of a Snakemake profile.
    executor
        local or slurm.
    cores
        Jobs at a time, in place of the profile's.
    watch
        Called about every second.

    Returns
    -------
    Snakemake's exit status.

    Raises
    ------
    KeyboardInterrupt
        After its jobs have ended.
    """
    command = [sys.executable, "-P", "-m", "snakemake"]
    command += ["--snakefile", str(SNAKEFILE), "--profile", str(profile)]
    command += ["--directory", str(plan.out), "--nolock", "--quiet", "rules", "host"]
    command += ["--config", f"plan={plan.out / PLAN}"]
    at_a_time = "--cores" if executor == "local" else "--jobs"
    command += ([] if cores is None else [at_a_time, str(cores)]) + ["--", target]
    shutil.rmtree(plan.out / JOBS, ignore_errors=True)  # the plan knows what is done
    with (plan.out / LOG).open("ab") as log:
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True, cwd=plan.out
        )
        try:
            while True:
                with suppress(subprocess.TimeoutExpired):
                    return process.wait(1.0)
                if watch is not None:
                    watch()
        except KeyboardInterrupt:
            _stop(process)
            raise


def _stop(process: subprocess.Popen[bytes]) -> None:
    """End Snakemake and all it started; on a cluster it cancels its jobs first."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
        with suppress(OSError):
            os.killpg(process.pid, number)
        with suppress(subprocess.TimeoutExpired):
            process.wait(20)  # seconds for its jobs to end
            break
    with suppress(OSError):  # what outlived it
        os.killpg(process.pid, signal.SIGKILL)


def run_films(plan: Plan, run: Callable[[Plan], int]) -> Plan:
    """Run the films of a plan and give each its state.

    Snakemake starts nothing at all if a film in object storage is not there. Such a film has failed, and the
    others are run without it.

    Returns
    -------
    The plan with the jobs that were run.
    """
    while plan.jobs:
        log = plan.out / LOG
        since = log.stat().st_size if log.exists() else 0
        run(plan)
        told = log.read_bytes()[since:].decode("utf-8", "replace")
        lines = {line.strip().removesuffix(" (in storage)") for line in told.splitlines()}
        absent = [job for job in plan.jobs if lines.intersection(plan.remote(job))]
        if "MissingInputException" not in told or not absent:
            break
        for film in (plan.film(name) for job in absent for name in plan.jobs[job].films):
            why = f"{film.film}: expected a film in storage; found none"
            write_state(plan.out, replace(plan.state(film), state="failed", reason=why))
        plan = replace(plan, jobs={name: job for name, job in plan.jobs.items() if name not in absent})
        write_plan(plan)
    close_states(plan)
    return plan


def close_states(plan: Plan) -> None:
    """A planned film without an end has failed: its job was killed, never began, or could write nothing."""
    for job in plan.jobs.values():
        for film in map(plan.film, job.films):
            state = plan.state(film)
            if state.state not in ("waiting", "running"):
                continue
            with suppress(InputError):  # a full disk: the page still tells
                write_state(plan.out, unfinished(plan, state))


def unfinished(plan: Plan, state: State) -> State:
    """The state of a film whose job ended without a word."""
    if shutil.disk_usage(plan.out).free < 1_000_000:
        why = f"the disk of {plan.out} is full"
    elif state.state == "running":
        why = f"its job ended without a result (killed, or out of memory or time); see {LOG}"
    else:
        why = f"its job never began; {_last_line(plan.out / LOG)}"
    return replace(state, state="failed", reason=why)


def _last_line(log: Path) -> str:
    """The last line of Snakemake's log that tells of an error."""
    try:
        lines = log.read_text(encoding="utf-8", errors="replace").splitlines()[-60:]
    except OSError:
        return f"see {LOG}"
    told = [line.strip() for line in lines if "error" in line.lower() and len(line.strip()) > 20]
    told = [line for line in told if not line.startswith("Exiting because")]
    return f"{LOG} says: {shortened(told[-1])}" if told else f"see {LOG} and what the batch system wrote"
