"""A run is made again under its decisions, in a process of its own, and takes the old one's place whole."""

from __future__ import annotations

import contextlib
import io
import json
import os
import pickle
import shutil
import subprocess
import sys
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vision.clock import Clock
from vision.errors import InputError
from vision.files import PACKAGES
from vision.numeric import Floats, Ints
from vision.pipeline import Analysis, Settings, analyse, open_recording
from vision.review.positions import Before, Positions, positions_of, usual_places
from vision.review.tracks_file import read_tracks
from vision.run.folder import clean_up, plain, put_in_place
from vision.run.provenance import Origin, Parameter
from vision.run.reading import input_of, parameters_of, read_run, read_strip, read_table, tracks_of
from vision.run.writing import write_run
from vision.sheets.corrections import Correction, Decisions

if TYPE_CHECKING:
    from vision.review.session import Session

Tell = Callable[..., None]
"""Called with what is being done, and with frames done and their number where those are known."""

DIFFERENT = 3.0
"""Standard errors of both positions by which they differ: three of a thousand equal ones do by chance."""


@dataclass(frozen=True, kw_only=True)
class SaveJob:
    """What is to be saved."""

    folder: Path  # the run
    settings: Settings  # that it was made with, without corrections
    applied: tuple[Correction, ...]  # decisions that it already follows
    decisions: Decisions  # those that it shall follow
    clock: Clock | None = None  # the run's, kept where no decision changes it
    # where the film lies now, if not where it was; without the film all but another strip can be saved
    film: Path | None = None
    beside: Mapping[str, bytes] | None = None  # files of the review kept with the run: content by name
    # names of arguments and the command's options that the report shows in their place
    options: Mapping[str, str] = field(default_factory=dict)
    into: Path | None = None  # where the run is written, if it shall not take the old one's place


def save_run(job: SaveJob, tell: Tell = lambda stage, done=0, total=0: None) -> None:
    """Run what follows from the decisions again and replace the run folder.

    Raises: InputError where a decision does not fit, or a file is gone; the run stays as it was.
    """
    tell("reading the run")
    folder, settings = job.folder, replace(job.settings, corrections=job.decisions.corrections)
    run = read_run(folder)
    inputs, parameters = run.facts.get("inputs") or [], parameters_of(folder, run.facts)
    earlier = Analysis(
        settings=replace(settings, corrections=job.applied),
        strip=read_strip(run),
        tracks=tracks_of(run),
        clock=job.clock,
    )
    force, size = (parameters.get(name, Parameter(None, "default")).value for name in ("force", "pixel_size"))
    tell("measuring")

    def read(done: int, total: int | None) -> None:
        tell("reading the film" if done != total else "measuring", done, total or 0)

    try:
        video = open_recording(input_of(folder, inputs[0], job.film), job.settings)
    except InputError:  # it is gone; it is needed for another strip alone
        video = None
    analysis = analyse(
        video,
        None if force is None else input_of(folder, inputs[-1]),
        settings if settings.pitch_um is None else replace(settings, pixel_size_um=None),
        earlier=earlier,
        progress=read,
    )
    if settings.pitch_um is not None and size is not None:
        parameters["pixel_size"] = Parameter(analysis.pixel_size_um, "found")
    tell("writing")
    write_run(
        analysis,
        job.into or folder,
        Origin(command=str(run.facts.get("command", "")), parameters=parameters, options=job.options),
        overwrite=True,
        report=(folder / "report.html").exists(),
        facts={"inputs": inputs},
        decisions=job.decisions,
        beside=job.beside,
    )


# --- in a process of its own --------------------------------------------------------------------------------


class Saver:
    """One run at a time that is made again, beside the server.

    A process of its own keeps the page answering and gives its memory back. It writes nothing once the
    server that started it is gone.
    """

    def __init__(self) -> None:
        self._thread: Thread | None = None
        self._child: subprocess.Popen[bytes] | None = None
        self._cancelled = False
        self.stage, self.error, self.done, self.total = "", "", 0, 0

    @property
    def running(self) -> bool:
        """Whether a run is being made."""
        return self._thread is not None and self._thread.is_alive()

    def start(self, job: SaveJob, finished: Callable[[Mapping[str, Any]], None]) -> None:
        """Begin.

        finished: called, in a thread, when the run has been written, with its `differences` from the old one
        where that has kept its place.  Raises: InputError while another one is being made.
        """
        if self.running:
            raise InputError("the run", "one that is not being tracked or saved", "one that is", "wait")
        self.stage, self.error, self._cancelled = "starting", "", False
        self._thread = Thread(target=self._work, args=(job, finished), daemon=True)
        self._thread.start()

    def progress(self) -> dict[str, Any]:
        """How far it is, and what went wrong."""
        state = {"stage": self.stage, "done": self.done, "total": self.total, "error": self.error}
        return {"running": self.running, **state}

    def wait(self) -> None:
        """Until nothing is being made."""
        if self._thread is not None:
            self._thread.join()

    def cancel(self) -> None:
        """End it; nothing of it is left once this returns."""
        self._cancelled = True
        if self._child is not None:
            self._child.kill()
        self.wait()

    def _work(self, job: SaveJob, finished: Callable[[Mapping[str, Any]], None]) -> None:
        found: Mapping[str, Any] = {}
        error = "the process that tracks ended without a word; the run is as it was"
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
        with subprocess.Popen([sys.executable, "-c", _CHILD], **pipes) as child:  # type: ignore[call-overload]
            self._child = child
            if self._cancelled:
                child.kill()
            with contextlib.suppress(BrokenPipeError):  # it was killed
                pickle.dump((PACKAGES, os.getpid()), child.stdin)
                pickle.dump(job, child.stdin)
            with contextlib.suppress(BrokenPipeError):
                child.stdin.close()
            for line in child.stdout:
                kind, content, done, total = json.loads(line)
                if kind == "stage":
                    self.stage, self.done, self.total = content, done, total
                elif kind == "found":
                    found = content
                else:
                    error = content
        if self._cancelled:
            clean_up(job.into or job.folder)
            error = "cancelled"
        if not error:
            try:
                finished(found)
            except InputError as broken:
                error = str(broken)
        self.stage, self.error, self._child, self.done, self.total = "", error, None, 0, 0


# The packages that the server has, and none in the working directory.
_CHILD = """
import pickle, sys
sys.path[:], server = pickle.load(sys.stdin.buffer)
from vision.review.saving import in_child
in_child(server)
"""


def in_child(server: int) -> None:
    """Save what standard input holds, and tell how it goes, a line of JSON each: ["stage", text, frames done,
    their number], ["found", differences, 0, 0] where a run is put beside, at last ["end", error, 0, 0].

    server: the process that waits for it. Once it is gone, the run is left as it was: its decisions are in
    corrections.toml.
    """
    lines, sys.stdout = sys.stdout, sys.stderr

    def tell(content: Any, done: int = 0, total: int = 0, *, kind: str = "stage") -> None:
        if os.getppid() != server:
            os._exit(1)
        lines.write(json.dumps([kind, content, done, total]) + "\n")
        lines.flush()

    try:
        job = pickle.load(sys.stdin.buffer)
        save_run(job, tell)
        if job.into is not None:
            tell("comparing")
            tell(plain(differences(job.folder, job.into)), kind="found")
        tell("", kind="end")
    except InputError as error:
        tell(str(error), kind="end")
    except BrokenPipeError:
        os._exit(1)
    except Exception as error:  # shown in the page; the run stays as it was
        tell(" ".join(f"unexpected {type(error).__name__}: {error}".split()), kind="end")


# --- tracked again before it is kept ------------------------------------------------------------------------


class Trial:
    """Tracks a session's run again under a decision that is not kept, and says what that would change.

    The new run is written whole, beside the old one, with the decision in its corrections.toml. Keeping it is
    a change of two names: what is kept is exactly what was shown, and the film is not read a second time.
    """

    def __init__(self, run: Session) -> None:
        self.run = run
        self._place: Path | None = None  # where it is written
        self._found: Mapping[str, Any] | None = None

    def start(self, request: Mapping[str, Any]) -> None:
        """Begin to track again.  Raises: InputError where the decision does not fit, or while it is busy."""
        run = self.run
        with run.lock:
            run.check_free()
            decision = run.decision_of(request, dated=True)
            self._place = _beside(run.folder)
            job = run.job([*run.decisions, decision], [])
            run.saver.start(replace(job, into=self._place), self._take)

    def state(self) -> dict[str, Any]:
        """How far it is, and what was found."""
        others = {} if self._place is not None else {"running": False, "error": ""}  # saving, not a trial
        return self.run.saver.progress() | {"found": self._found} | others

    def at(self, frame: int) -> dict[str, Any]:
        """Positions about a frame, and σ_x/Λ_st of the stick there, before and after.

        Raises: InputError where nothing was tracked again.
        """
        with self.run.lock:
            return self.run.effects.preview_of(self._ready() / "tracks.nc", frame)

    def _ready(self) -> Path:
        """Where the new run lies."""
        if self._found is None or self._place is None:
            raise InputError("the trial", "a run that was tracked again", "none", "track again first")
        return self._place

    def keep(self) -> None:
        """Put the new run, whose corrections.toml holds the decision, in the old one's place.

        Raises: InputError where nothing was tracked again, or it cannot be written; the run stays as it was.
        """
        run = self.run
        with run.lock:
            place = self._ready()
            run.stored.check_there()
            try:
                put_in_place(place, run.folder.resolve(), overwrite=True)
            except OSError as error:
                found = (error.strerror or str(error)).lower()
                raise InputError(run.folder, "a place that can be written", found, "not kept") from error
            self.discard()
            run.reload()

    def discard(self) -> None:
        """Throw it away, also while it is being made."""
        with self.run.lock:
            if self._place is None:
                return
            if self.run.saver.running and self._found is None:
                self.run.saver.cancel()
            self.sweep()
            self._place = self._found = None

    def sweep(self) -> None:
        """Remove what lies beside the run, from a killed review, too."""
        place = _beside(self.run.folder)
        shutil.rmtree(place, ignore_errors=True)
        clean_up(place)

    def _take(self, found: Mapping[str, Any]) -> None:
        self._found = found


def _beside(folder: Path) -> Path:
    path = folder.resolve()
    return path.with_name(f".{path.name}.tried")


def differences(before: Path, after: Path) -> dict[str, Any]:
    """What one run folder says that another one does not.

    Pairs are before and after. Of the whole runs: sheets (left and right), positions, doubtful (positions),
    error_px (median). Of the sheets that both have, each other's nearest within half a pitch: gained and lost
    (positions); of the positions in both, their number compared, how many differ by more than `DIFFERENT`
    errors, how many lie on other_ridge, more than half a pitch away, median_px and largest_px (of the
    difference). ratios: known (pairs), median and largest (of the difference), of (compared), other_shell
    (called otherwise). shells: of each side the median number of stiff sheets, and in how many sticks it is
    other. Both None where a run has none.  Raises: InputError for damaged files.
    """
    old, new = (positions_of(read_tracks(folder / "tracks.nc")) for folder in (before, after))
    pairs = _pairs(usual_places(old), usual_places(new), old.track_facts.pitch_px)
    return _positions_differ(old, new, *pairs) | _deformation_differs(before, after, *pairs)


def _deformation_differs(before: Path, after: Path, old: Ints, new: Ints) -> dict[str, Any]:
    """How σ_x/Λ_st of the sheets in both runs, and the shells, differ."""
    names = ("deformation", "shells")
    (sheets, shells), (sheets_new, shells_new) = (
        [read_table(folder, name) for name in names] for folder in (before, after)
    )
    if sheets is None or sheets_new is None or shells is None or shells_new is None:
        return {"ratios": None, "shells": None}
    index = dict(zip(old.tolist(), new.tolist(), strict=True))
    both = sheets.assign(index=sheets["index"].map(index)).merge(sheets_new, on=["event", "index"])
    change = (both["ratio_y"] - both["ratio_x"]).abs().dropna()
    ratios = {
        "known": [int(table["ratio"].notna().sum()) for table in (sheets, sheets_new)],
        "of": len(change),
        "median": float(change.median()),
        "largest": float(change.max()),
        "other_shell": int((both["shell_x"] != both["shell_y"]).sum()),
    }
    sides = shells.merge(shells_new, on=["event", "side"])
    sizes = [
        {
            "side": side,
            "median": [float(part[f"stiff_sheets_{which}"].median()) for which in "xy"],
            "other": int((part["stiff_sheets_x"] != part["stiff_sheets_y"]).sum()),
            "of": len(part),
        }
        for side in (-1, 1)
        if len(part := sides[sides["side"] == side])
    ]
    return {"ratios": ratios, "shells": sizes}


def _pairs(old_px: Floats, new_px: Floats, pitch_px: float) -> tuple[Ints, Ints]:
    """Sheets of two runs that are each other's nearest, within half a pitch."""
    distance = np.nan_to_num(np.abs(old_px[:, None] - new_px[None, :]), nan=np.inf)
    nearest = distance.argmin(axis=1)
    old = np.arange(len(old_px))
    mutual = (distance.argmin(axis=0)[nearest] == old) & (distance[old, nearest] < 0.5 * pitch_px)
    return old[mutual], nearest[mutual].astype(np.int64)


def _positions_differ(before: Positions, after: Positions, old: Ints, new: Ints) -> dict[str, Any]:
    """How the positions of the sheets in both runs differ."""
    was, will = before.x_px[:, old], after.x_px[:, new]
    there, then = np.isfinite(was), np.isfinite(will)
    both = there & then
    moved = np.abs(will - was)[both]
    error = np.hypot(before.err_px[:, old], after.err_px[:, new])[both]
    return {
        "sheets": [[int((part.side == side).sum()) for side in (-1, 1)] for part in (before, after)],
        "positions": [int(np.isfinite(part.x_px).sum()) for part in (before, after)],
        "doubtful": [int(part.doubtful.sum()) for part in (before, after)],
        "error_px": [float(np.nanmedian(part.err_px)) for part in (before, after)],
        "gained": int((then & ~there).sum()),
        "lost": int((there & ~then).sum()),
        "compared": len(moved),
        "differ": int((moved > DIFFERENT * error).sum()),
        "other_ridge": int((moved > 0.5 * before.track_facts.pitch_px).sum()),
        "median_px": float(np.median(moved)) if moved.size else None,
        "largest_px": float(moved.max()) if moved.size else None,
    }


# --- what decisions replaced --------------------------------------------------------------------------------


def pack(steps: Sequence[Before | None]) -> bytes:
    """What the decisions replaced, in their order, as the content of an .npz file."""
    names = ("how", "first", "stop", "sheets", "axis_px", "axis_how")
    facts = [step and {name: getattr(step, name) for name in names} for step in steps]
    arrays: dict[str, Any] = {
        f"{k}.{name}": values
        for k, step in enumerate(steps)
        if step is not None
        for name, values in step.arrays.items()
    }
    stream = io.BytesIO()
    np.savez_compressed(stream, facts=np.frombuffer(json.dumps(facts).encode(), np.uint8), **arrays)
    return stream.getvalue()


def unpack(path: Path) -> list[Before | None]:
    """The inverse of `pack`; nothing for a file that is not there or damaged.

    Then a decision can still be taken back, but is seen only when it is saved.
    """
    try:
        with np.load(path, allow_pickle=False) as kept:
            facts = json.loads(kept["facts"].tobytes())
            arrays = {name: kept[name] for name in kept.files}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error):
        return []
    return [None if one is None else _step(k, one, arrays) for k, one in enumerate(facts)]


def _step(k: int, facts: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> Before:
    own = {name.partition(".")[2]: values for name, values in arrays.items() if name.startswith(f"{k}.")}
    return Before(**{**facts, "sheets": tuple(facts["sheets"])}, arrays=own)
