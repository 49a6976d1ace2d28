"""The jobs: Snakemake starts them, here or on a cluster, and each takes its films in turn.

Snakemake only schedules: what became of the films is in their states, and each failure is kept to its film.
"""

from __future__ import annotations

import ctypes
import importlib.util
import mmap
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

from PIL import Image

from vision.campaign.films import is_remote
from vision.campaign.plan import PLAN, Plan, PlannedFilm, State, Word, inputs_of, write_plan, write_state
from vision.campaign.results import page_age, write_page, write_partitions
from vision.campaign.settings import CampaignSettings
from vision.errors import InputError
from vision.files import shortened
from vision.pipeline import Analysis
from vision.run.folder import lock_open_file

# --- Snakemake, a process -----------------------------------------------------------------------------------


HERE = Path(__file__).parent
SNAKEFILE = HERE / "Snakefile"
LOG = "snakemake.log"
JOBS = ".jobs"
PLUGINS = {"https": "http", "gs": "gcs", "az": "azure"}  # not called as their addresses begin


def check_engine(executor: str, films: Iterable[str] = ()) -> None:
    """Refuse early where Snakemake, a storage plugin or the cluster's commands are missing.

    Raises: InputError.
    """
    if importlib.util.find_spec("snakemake") is None:
        raise InputError("track campaign", "Snakemake 9", "none", "pip install '.[campaign]'")
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

    Raises: InputError where another campaign runs there, or the folder cannot be written.
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
    executor: str,
    cores: int | None,
    watch: Callable[[], None] | None = None,
) -> int:
    """Run the Snakefile for a written plan with a folder of a Snakemake profile; its exit status.

    `cores`, jobs at a time, goes before the profile's; `watch` is called about every second. A
    KeyboardInterrupt passes after its jobs have ended.
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
    """Run the films of a plan and give each its state; the plan with the jobs that were run.

    Snakemake starts nothing at all if a film in object storage is not there. Such a film has failed, and the
    others are run without it.
    """
    while plan.jobs:
        log = plan.out / LOG
        since = log.stat().st_size if log.exists() else 0
        run(plan)
        text = log.read_bytes()[since:].decode("utf-8", "replace")
        lines = {line.strip().removesuffix(" (in storage)") for line in text.splitlines()}
        absent = [job for job in plan.jobs if lines.intersection(plan.remote(job))]
        if "MissingInputException" not in text or not absent:
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
            if shutil.disk_usage(plan.out).free < 1_000_000:
                why = f"the disk of {plan.out} is full"
            elif state.state == "running":
                why = f"its job ended without a result (killed, or out of memory or time); see {LOG}"
            else:
                why = f"its job never began; {_last_line(plan.out / LOG)}"
            _note(plan.out, replace(state, state="failed", reason=why))


def _last_line(log: Path) -> str:
    """The last line of Snakemake's log that tells of an error."""
    try:
        lines = log.read_text(encoding="utf-8", errors="replace").splitlines()[-60:]
    except OSError:
        return f"see {LOG}"
    errors = [line.strip() for line in lines if "error" in line.lower() and len(line.strip()) > 20]
    errors = [line for line in errors if not line.startswith("Exiting because")]
    return f"{LOG} says: {shortened(errors[-1])}" if errors else f"see {LOG} and what the batch system wrote"


# --- one job ------------------------------------------------------------------------------------------------


STATES: dict[int, Word] = {0: "done", 1: "warnings"}  # by the exit status of a film's analysis


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What a film's analysis ended with."""

    status: int  # its exit status, as of `track`
    reason: str = ""  # one line where that is 2 or 3
    warnings: tuple[str, ...] = ()  # one line each
    analysis: Analysis | None = None  # None where nothing was found


Work = Callable[[PlannedFilm, Path, Path], Outcome]
"""Analyses a film, from a path where it may be read, into a run folder."""


def run_job(
    plan: Plan,
    job: str,
    work: Work,
    *,
    fetched: Sequence[Path] = (),
    settings: CampaignSettings = CampaignSettings(),
) -> int:
    """Take every film of a job that is not done; 0 if all are now, else 1.

    A child process, forked after the imports, takes them. If it dies of one film (a decoder that crashes,
    memory), that film has failed and another child takes the rest. `fetched` are local copies of the job's
    films in object storage, in their order.
    """
    copies = dict(zip(plan.remote(job), fetched, strict=False))
    films = [plan.film(name) for name in plan.jobs[job].films]
    left = [film for film in films if plan.finished(film) is None]
    with mmap.mmap(-1, mmap.PAGESIZE) as turn:  # shared with the child: the number of the film it is at
        while left:
            todo, turn[0:8] = tuple(left), bytes(8)
            code = _in_child(partial(_each, plan, todo, work, copies, turn, settings))
            if code == 0:
                break
            at = int.from_bytes(turn[0:8], "little")
            state = plan.state(todo[at])
            if state.state == "running":  # the process died of it
                how = f"signal {-code} ({signal.strsignal(-code)})" if code < 0 else f"status {code}"
                why = f"the process of this film ended with {how}"
                _note(plan.out, replace(state, state="failed", reason=why, seconds=time.time() - state.at))
            left = list(todo[at + 1 :])
    return 0 if all(plan.finished(film) for film in films) else 1


def _in_child(work: Callable[[], None]) -> int:
    """Exit code of some work in a forked process, negative for a signal; without fork, in this one."""
    if "fork" not in multiprocessing.get_all_start_methods():
        work()
        return 0
    child = multiprocessing.get_context("fork").Process(target=_with_parent, args=(work,))
    child.start()
    try:
        child.join()
    except KeyboardInterrupt:
        child.terminate()
        child.join()
        raise
    return child.exitcode or 0


def _with_parent(work: Callable[[], None]) -> None:
    """Work that ends when the parent does, however that ends, and is interrupted once.

    A second signal (to all processes of a terminal or a batch system, then from the parent) would come in the
    middle of clearing up.
    """
    signals = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]

    def once(number: int, frame: object) -> None:
        for each in signals:
            signal.signal(each, signal.SIG_IGN)
        raise KeyboardInterrupt

    for each in signals:
        signal.signal(each, once)
    if sys.platform.startswith("linux"):
        ctypes.CDLL(None).prctl(1, signal.SIGTERM)
    try:
        work()
    except KeyboardInterrupt:
        os._exit(130)


def _each(
    plan: Plan,
    films: Sequence[PlannedFilm],
    work: Work,
    copies: dict[str, Path],
    turn: mmap.mmap,
    tuning: CampaignSettings,
) -> None:
    for number, film in enumerate(films):
        turn[0:8] = number.to_bytes(8, "little")
        before = plan.state(film)
        begun = replace(before, state="running", attempts=before.attempts + 1, reason="", seconds=0.0)
        _note(plan.out, begun)
        started = time.perf_counter()
        try:
            ended = _one(plan, film, work, copies, tuning)
        except KeyboardInterrupt:
            _note(plan.out, replace(begun, state="waiting", reason="interrupted"))
            raise
        except (InputError, OSError) as error:  # what is written beside the run
            ended = State(name=film.name, state="failed", reason=shortened(str(error), 300))
        seconds = time.perf_counter() - started
        _note(plan.out, replace(ended, key=film.key, seconds=seconds, attempts=begun.attempts))
        if page_age(plan.out) > tuning.page_seconds * (1 + len(plan.films) / 100):
            with suppress(InputError):  # a full disk is the films' own failure
                write_page(plan, live=True)


def _note(out: Path, state: State) -> None:
    """Write a state; on a full disk there is none, which the campaign's end reports."""
    with suppress(InputError):
        write_state(out, state)


def _one(
    plan: Plan, film: PlannedFilm, work: Work, copies: dict[str, Path], tuning: CampaignSettings
) -> State:
    """One film, its tables for the pool and its thumbnail."""
    target = plan.run_of(film.name)
    with _source(film, copies, tuning, stage=plan.stage) as source:
        outcome = work(film, source, target)
    run = target / "run.json"
    state = State(name=film.name, state="failed", reason=outcome.reason)
    if outcome.analysis is None or not run.is_file():
        return state
    write_partitions(plan.out, film.name, outcome.analysis)
    with suppress(OSError, ValueError), Image.open(target / "overview.png") as image:  # no thumbnail, no harm
        image.thumbnail((tuning.thumbnail_px, 4 * tuning.thumbnail_px))
        (plan.out / "thumbnails").mkdir(exist_ok=True)
        image.convert("RGB").quantize(32).save(plan.out / "thumbnails" / f"{film.name}.png", optimize=True)
    warnings, word = outcome.warnings, STATES.get(outcome.status, "partial")
    reason = outcome.reason or (shortened(warnings[0], 300) if warnings else "")
    more = f" (and {len(warnings) - 1} more)" if outcome.status == 1 and len(warnings) > 1 else ""
    return replace(state, state=word, reason=reason + more, warnings=warnings)


@contextmanager
def _source(
    film: PlannedFilm, copies: dict[str, Path], tuning: CampaignSettings, *, stage: bool
) -> Iterator[Path]:
    """Where a film is read from: itself, what Snakemake fetched, or a copy on the node's own disk.

    Raises: InputError where the disk has no room for the copy, or the film's disk stops answering.
    """
    if is_remote(film.film):
        if film.film not in copies:
            raise InputError(film.film, "a film that Snakemake fetched", "none", "install its storage plugin")
        yield copies[film.film]
        return
    path = Path(film.film)
    if not stage or not path.is_file():
        yield path
        return
    files = [file for file in inputs_of(film.film, {}) if file.is_file()]
    room, needed = shutil.disk_usage(tempfile.gettempdir()).free, sum(file.stat().st_size for file in files)
    if needed > 0.95 * room:
        wanted, found = f"room for {needed / 1e9:.1f} GB of {path.name}", f"{room / 1e9:.1f} GB free"
        raise InputError(tempfile.gettempdir(), wanted, found, "set TMPDIR")
    with tempfile.TemporaryDirectory(prefix="track-") as folder:
        for file in files:
            copy_or_give_up(file, Path(folder) / file.name, stalled_s=tuning.stalled_seconds)
        yield Path(folder) / path.name


def copy_or_give_up(source: Path, target: Path, *, stalled_s: float) -> None:
    """Copy a file from a disk that may stop answering: reading it would then never return.

    Raises: InputError after so many seconds in which the copy does not grow, OSError as `shutil.copyfile`.
    """
    failed: list[OSError] = []

    def copy() -> None:
        try:
            shutil.copyfile(source, target)
        except OSError as error:
            failed.append(error)

    copying = threading.Thread(target=copy, daemon=True)  # one that is stuck does not keep the process
    copying.start()
    size, since = -1, time.monotonic()
    while copying.is_alive():
        copying.join(min(1.0, stalled_s / 4))
        now = target.stat().st_size if target.exists() else 0
        if now != size:
            size, since = now, time.monotonic()
        elif copying.is_alive() and time.monotonic() - since > stalled_s:
            found = f"none for {stalled_s:.0f} s, after {size / 1e6:.1f} MB"
            raise InputError(source, "data from its disk", found, "look at the network, and run again")
    if failed:
        raise failed[0]
