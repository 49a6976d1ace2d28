"""One job: a process that imports once and takes its films in turn, each failure kept to its film."""

from __future__ import annotations

import ctypes
import mmap
import multiprocessing
import os
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from PIL import Image

from vision.campaign.page import page_age, write_page
from vision.campaign.plan import Plan, PlannedFilm, inputs_of
from vision.campaign.settings import CampaignSettings
from vision.campaign.states import State, Word, write_state
from vision.campaign.table import is_remote
from vision.campaign.tables import write_partitions
from vision.errors import InputError
from vision.files import shortened
from vision.pipeline import Analysis

STATES: dict[int, Word] = {0: "done", 1: "warnings"}  # by the exit status of a film's analysis


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What a film's analysis ended with.

    Parameters
    ----------
    status
        Its exit status, as of `track`.
    reason
        One line where that is 2 or 3.
    warnings
        Of the analysis, one line each.
    analysis
        What was found; None where nothing was.
    """

    status: int
    reason: str = ""
    warnings: tuple[str, ...] = ()
    analysis: Analysis | None = None


Work = Callable[[PlannedFilm, Path, Path], Outcome]
"""Analyses a film, from a path where it may be read, into a run folder."""


def run_job(
    plan: Plan,
    job: str,
    work: Work,
    *,
    fetched: Sequence[Path] = (),
    settings: CampaignSettings | None = None,
) -> int:
    """Take every film of a job that is not done; 0 if all are now, else 1.

    A child process, forked after the imports, takes them. If it dies of one film (a decoder that crashes,
    memory), that film has failed and another child takes the rest.

    Parameters
    ----------
    plan
        The campaign's.
    job
        A job of it.
    work
        Analyses one film.
    fetched
        Local copies of the job's films in object storage, in their order.
    settings
        Tunable constants.
    """
    tuning = settings or CampaignSettings()
    copies = dict(zip(plan.remote(job), fetched, strict=False))
    films = [plan.film(name) for name in plan.jobs[job].films]
    left = [film for film in films if plan.finished(film) is None]
    with mmap.mmap(-1, mmap.PAGESIZE) as turn:  # shared with the child: the number of the film it is at
        while left:
            todo, turn[0:8] = tuple(left), bytes(8)
            code = _in_child(partial(_each, plan, todo, work, copies, turn, tuning))
            if code == 0:
                break
            at = int.from_bytes(turn[0:8], "little")
            _died(plan, todo[at], code)
            left = list(todo[at + 1 :])
    return 0 if all(plan.finished(film) for film in films) else 1


def _died(plan: Plan, film: PlannedFilm, code: int) -> None:
    """The film at which its process died has failed."""
    state = plan.state(film)
    if state.state == "running":
        how = f"signal {-code} ({signal.strsignal(-code)})" if code < 0 else f"status {code}"
        why = f"the process of this film ended with {how}"
        _note(plan.out, replace(state, state="failed", reason=why, seconds=time.time() - state.at))


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
    told = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]

    def once(number: int, frame: object) -> None:
        for each in told:
            signal.signal(each, signal.SIG_IGN)
        raise KeyboardInterrupt

    for each in told:
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
    _thumbnail(target / "overview.png", plan.out / "thumbnails" / f"{film.name}.png", tuning.thumbnail_px)
    warnings = outcome.warnings
    reason = outcome.reason or (shortened(warnings[0], 300) if warnings else "")
    more = f" (and {len(warnings) - 1} more)" if outcome.status == 1 and len(warnings) > 1 else ""
    return replace(
        state, state=STATES.get(outcome.status, "partial"), reason=reason + more, warnings=warnings
    )


@contextmanager
def _source(
    film: PlannedFilm, copies: dict[str, Path], tuning: CampaignSettings, *, stage: bool
) -> Iterator[Path]:
    """Where a film is read from: itself, what Snakemake fetched, or a copy on the node's own disk.

    Raises
    ------
    InputError
        Where the disk has no room for the copy, or the film's disk stops answering.
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
        found = f"{room / 1e9:.1f} GB free"
        raise InputError(
            tempfile.gettempdir(), f"room for {needed / 1e9:.1f} GB of {path.name}", found, "set TMPDIR"
        )
    with tempfile.TemporaryDirectory(prefix="track-") as folder:
        for file in files:
            copy_or_give_up(file, Path(folder) / file.name, stalled_s=tuning.stalled_seconds)
        yield Path(folder) / path.name


def copy_or_give_up(source: Path, target: Path, *, stalled_s: float) -> None:
    """Copy a file from a disk that may stop answering: reading it would then never return.

    Parameters
    ----------
    source, target
        Files.
    stalled_s
        Longest time in which the copy does not grow.

    Raises
    ------
    InputError
        After that time.
    OSError
        Where the file cannot be read or written.
    """
    ended: list[OSError | None] = []

    def copy() -> None:
        try:
            shutil.copyfile(source, target)
            ended.append(None)
        except OSError as error:
            ended.append(error)

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
    if ended and ended[0] is not None:
        raise ended[0]


def _thumbnail(picture: Path, small: Path, width: int) -> None:
    """A small copy of a picture; none is no failure."""
    with suppress(OSError, ValueError):
        small.parent.mkdir(parents=True, exist_ok=True)
        with Image.open(picture) as image:
            image.thumbnail((width, 4 * width))
            image.convert("RGB").quantize(32).save(small, optimize=True)
