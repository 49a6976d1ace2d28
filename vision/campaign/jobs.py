"""Jobs: Snakemake starts them, here or on a cluster, and each analyses its films one after the other.

Snakemake only schedules. The results of films are read from their states, and an error costs only its film.
"""

from __future__ import annotations

import importlib
import importlib.util
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Literal

from vision.campaign.films import SETTINGS, is_remote
from vision.campaign.plan import PLAN, Plan, PlannedFilm, State, inputs_of, write_plan, write_state
from vision.campaign.results import page_age, write_film, write_page
from vision.errors import InputError, install_advice
from vision.files import answered, c_library, prefetch, shortened
from vision.run.reading import is_run

# --- Snakemake, a process -----------------------------------------------------------------------------------

HERE = Path(__file__).parent
SNAKEFILE = HERE / "Snakefile"
LOG = "snakemake.log"
JOBS = ".jobs"
PLUGINS = {"https": "http", "gs": "gcs", "az": "azure"}  # plugins not named after their protocol


def check_engine(executor: str, films: Iterable[str] = ()) -> None:
    """Check that Snakemake, the storage plugins and the cluster's commands are installed.

    Raises: InputError.
    """
    if importlib.util.find_spec("snakemake") is None:
        raise InputError("track campaign", "Snakemake 9", "none", install_advice("campaign"))
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


def run_snakemake(
    plan: Plan,
    target: Literal["films", "pool"],
    *,
    profile: Path,
    executor: str,
    cores: int | None,
    watch: Callable[[], None] | None = None,
) -> int:
    """Run Snakemake on a written plan, with the profile in a folder, and return its exit status.

    `cores`, the number of jobs at a time, takes precedence over the profile's. `watch` is called about every
    second. A KeyboardInterrupt is raised after the jobs have ended.
    """
    command = [sys.executable, "-P", "-m", "snakemake"]
    command += ["--snakefile", str(SNAKEFILE), "--profile", str(profile)]
    command += ["--directory", str(plan.out), "--nolock", "--quiet", "rules", "host"]
    command += ["--config", f"plan={plan.out / PLAN}"]
    if cores is not None:
        command += ["--cores" if executor == "local" else "--jobs", str(cores)]
    command += ["--", target]
    # All jobs of the plan must run, whichever ran before: finished films are not in the plan.
    shutil.rmtree(plan.out / JOBS, ignore_errors=True)
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
    """End Snakemake and the processes it started. On a cluster it first cancels its jobs."""
    if not hasattr(os, "killpg"):  # Windows
        process.kill()
        return
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
        with suppress(OSError):
            os.killpg(process.pid, number)
        with suppress(subprocess.TimeoutExpired):
            process.wait(20)  # seconds for its jobs to end
            break
    with suppress(OSError):  # kill processes that outlived it
        os.killpg(process.pid, signal.SIGKILL)


def run_films(plan: Plan, run: Callable[[Plan], int]) -> Plan:
    """Run the films of a plan, give each its final state, and return the plan with the jobs that were run.

    If a film in object storage does not exist, Snakemake starts nothing. Such a film is marked as failed and
    the others are run without it.
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
    """Mark films without a result as failed: their job was killed, never began, or could not write."""
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
            _try_to_write(plan.out, replace(state, state="failed", reason=why))


def _last_line(log: Path) -> str:
    """Quote the last line of Snakemake's log that reports an error."""
    try:
        lines = log.read_text(encoding="utf-8", errors="replace").splitlines()[-60:]
    except OSError:
        return f"see {LOG}"
    errors = [line.strip() for line in lines if "error" in line.lower() and len(line.strip()) > 20]
    errors = [line for line in errors if not line.startswith("Exiting because")]
    return f"{LOG} says: {shortened(errors[-1])}" if errors else f"see {LOG} and what the batch system wrote"


# --- one job ------------------------------------------------------------------------------------------------

Work = Callable[[PlannedFilm, Path, Path], str]
"""Function that analyses a film. Arguments: the film, the path to read it from, the run folder to write.
Returns: why there is no run, in one line; "" if there is one."""


def run_job(plan: Plan, job: str, work: Work, *, fetched: Sequence[Path] = ()) -> int:
    """Analyse every unfinished film of a job; return 0 if all are finished then, else 1.

    Each film has a process of its own, on Linux forked after the imports: if it dies (a crashing decoder,
    lack of memory), this film is marked as failed and the next begins. `fetched` are local copies of the
    job's films in object storage, in their order.
    """
    importlib.import_module("vision.figures.drawing")  # matplotlib, once for all the films' processes
    copies = dict(zip(plan.remote(job), fetched, strict=False))
    films = [plan.film(name) for name in plan.jobs[job].films]
    for film in films:
        if plan.finished(film) is not None:
            continue
        code = _in_child(partial(_run, plan, film, work, copies))
        state = plan.state(film)
        if code != 0 and state.state == "running":  # the process died
            how = f"signal {-code} ({signal.strsignal(-code)})" if code < 0 else f"status {code}"
            why, seconds = f"the process of this film ended with {how}", time.time() - state.at
            _try_to_write(plan.out, replace(state, state="failed", reason=why, seconds=seconds))
    return 0 if all(plan.finished(film) for film in films) else 1


def _in_child(work: Callable[[], None]) -> int:
    """Run `work` in a process of its own; return its exit code, < 0 for a signal.

    On Linux it is forked, and has what is loaded; Windows cannot fork, and macOS's own libraries do not bear
    it.
    """
    forks = sys.platform.startswith("linux")
    context = multiprocessing.get_context("fork") if forks else multiprocessing.get_context("spawn")
    child = context.Process(target=_until_parent_ends, args=(work,))
    child.start()
    try:
        child.join()
    except KeyboardInterrupt:
        child.terminate()
        child.join()
        raise
    return child.exitcode or 0


def _until_parent_ends(work: Callable[[], None]) -> None:
    """Run `work` in a child that ends with its parent, however that ends, and is interrupted only once. A
    terminal or batch system signals all processes, then the parent signals its child: the second signal would
    interrupt the clean-up."""
    signals = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]

    def once(number: int, frame: object) -> None:
        for each in signals:
            signal.signal(each, signal.SIG_IGN)
        raise KeyboardInterrupt

    for each in signals:
        signal.signal(each, once)
    if library := c_library():
        library.prctl(1, signal.SIGTERM)
    try:
        work()
    except KeyboardInterrupt:
        os._exit(130)


def _run(plan: Plan, film: PlannedFilm, work: Work, copies: dict[str, Path]) -> None:
    """Analyse a film and write its state, and now and then the page."""
    before = plan.state(film)
    begun = replace(before, state="running", attempts=before.attempts + 1, reason="", seconds=0.0)
    _try_to_write(plan.out, begun)
    started = time.perf_counter()
    try:
        ended = _run_one(plan, film, work, copies)
    except KeyboardInterrupt:
        _try_to_write(plan.out, replace(begun, state="waiting", reason="interrupted"))
        raise
    except (InputError, OSError) as error:  # the tables or the thumbnail could not be written
        ended = State(name=film.name, state="failed", reason=shortened(str(error), 300))
    seconds = time.perf_counter() - started
    ended = replace(ended, key=film.key, run=plan.run_digest(film.name))
    _try_to_write(plan.out, replace(ended, seconds=seconds, attempts=begun.attempts))
    if page_age(plan.out) > SETTINGS.page_seconds * (1 + len(plan.films) / 100):
        with suppress(InputError):  # a full disk also fails the films, which report it
            write_page(plan, live=True)


def _try_to_write(out: Path, state: State) -> None:
    """Write a state unless the disk is full; `close_states` reports films that have no state."""
    with suppress(InputError):
        write_state(out, state)


def _run_one(plan: Plan, film: PlannedFilm, work: Work, copies: dict[str, Path]) -> State:
    """Analyse one film, write its tables for the pool and its thumbnail, and return its state."""
    target = plan.run_of(film.name)
    with _source(film, copies, stage=plan.stage) as source:
        why = work(film, source, target)
    if why or not is_run(target):
        return State(name=film.name, state="failed", reason=why)
    return write_film(plan, film.name)


@contextmanager
def _source(film: PlannedFilm, copies: dict[str, Path], *, stage: bool) -> Iterator[Path]:
    """Return the path to read a film from: its own, Snakemake's copy, or a copy on the node's local disk.

    Raises: InputError if the disk has no room for the copy, or the film's disk stops answering.
    """
    if is_remote(film.film):
        if film.film not in copies:
            raise InputError(film.film, "a film that Snakemake fetched", "none", "install its storage plugin")
        yield copies[film.film]
        return
    path = Path(film.film)
    if not stage or not answered(path.is_file, path):
        yield path
        return

    def sizes() -> dict[Path, int]:
        return {file: file.stat().st_size for file in inputs_of(film.film, {}) if file.is_file()}

    files = answered(sizes, path)
    room, needed = shutil.disk_usage(tempfile.gettempdir()).free, sum(files.values())
    if needed > 0.95 * room:
        wanted, found = f"room for {needed / 1e9:.1f} GB of {path.name}", f"{room / 1e9:.1f} GB free"
        raise InputError(tempfile.gettempdir(), wanted, found, "set TMPDIR")
    with tempfile.TemporaryDirectory(prefix="track-") as folder:
        for file in files:
            copy_or_give_up(file, Path(folder) / file.name)
        yield Path(folder) / path.name


def copy_or_give_up(source: Path, target: Path) -> None:
    """Copy a file from a disk that may stop answering.  Raises: InputError if it does, OSError."""

    def parts() -> Iterator[bytes]:
        with source.open("rb") as file:
            while part := file.read(1 << 24):
                yield part

    with target.open("wb") as copy:
        for part in prefetch(parts(), source):
            copy.write(part)
