"""Save decisions: run the affected stages again in a separate process, and replace the run folder."""

from __future__ import annotations

import contextlib
import json
import os
import pickle
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Any

import numpy as np

from vision.errors import InputError, unexpected, unwritable
from vision.files import PACKAGE_PATHS
from vision.folder import check_target, clean_up, keep_others, plain, put_in_place
from vision.locks import POSIX
from vision.numeric import Floats, Ints
from vision.pipeline import Settings
from vision.review.effects import Positions, median_positions, read_positions
from vision.review.recordings import StoredRun
from vision.run.provenance import Origin
from vision.run.reading import analyse_again, film_if_there, read_run
from vision.run.writing import WRITTEN, write_run
from vision.sheets.corrections import Decisions

if TYPE_CHECKING:
    from vision.review.session import Session

Tell = Callable[..., None]
"""Called with the current stage and, if they are known, the number of frames done and of all frames."""

DIFFERENT = 3.0
"""Standard errors by which positions differ. By chance, three of a thousand equal positions do so."""


@dataclass(frozen=True, kw_only=True)
class SaveJob:
    """A run and the decisions that are to be applied to it."""

    folder: Path  # the run
    settings: Settings  # settings of the run, without corrections
    decisions: Decisions  # decisions that are to be applied
    # path of the film if it has been moved; without the film, anything but another strip can be saved
    film: Path | None
    options: Mapping[str, str]  # the one that the report shows in place of each argument's name
    into: Path | None = None  # where to write the run if it must not replace the old one


def save_decisions(job: SaveJob, tell: Tell = lambda stage, done=0, total=0: None) -> None:
    """Run the stages that the decisions affect again, and replace the run folder.

    Raises: InputError if a decision is not valid or a file is missing; the run is not changed then.
    """
    tell("reading the run")
    folder, settings = job.folder, replace(job.settings, corrections=job.decisions.corrections)
    check_target(job.into or folder, overwrite=True)
    run = StoredRun.of(folder)
    tell("measuring")

    def read(done: int, total: int | None) -> None:
        tell("reading the film" if done != total else "measuring", done, total or 0)

    force, video = run.force(), film_if_there(run, settings, job.film)
    analysis = analyse_again(run, settings, video, force, progress=read)
    tell("writing")
    write_run(
        analysis,
        job.into or folder,
        Origin(command=str(run.facts.get("command", "")), parameters=run.parameters, options=job.options),
        overwrite=True,
        report=(folder / "report.html").exists(),
        facts={"inputs": run.facts.get("inputs") or [], "directory": run.facts.get("directory")},
        decisions=job.decisions,
    )


# --- in a separate process ----------------------------------------------------------------------------------


class Saver:
    """Executes one `SaveJob` at a time in a process beside the server.

    A separate process keeps the page responsive and returns its memory. It stops writing when the server that
    started it is gone.
    """

    def __init__(self) -> None:
        self._thread: Thread | None = None
        self._child: subprocess.Popen[bytes] | None = None
        self._cancelled = False
        self.stage, self.error, self.done, self.total = "", "", 0, 0

    @property
    def running(self) -> bool:
        """Whether a job is being executed."""
        return self._thread is not None and self._thread.is_alive()

    def check_free(self) -> None:
        """Raise `InputError` while a job is being executed."""
        if self.running:
            wanted, found = "one that is not being tracked or saved", "one that is"
            raise InputError("the run", wanted, found, "wait for its end, or cancel it")

    def start(self, job: SaveJob, finished: Callable[[Mapping[str, Any]], None]) -> None:
        """Start a job.

        finished: called in a thread when the run has been written, with its `differences` from the old run if
        that was not replaced.  Raises: InputError while another job is being executed.
        """
        self.check_free()
        self.stage, self.error, self._cancelled = "starting", "", False
        self._thread = Thread(target=self._work, args=(job, finished), daemon=True)
        self._thread.start()

    def progress(self) -> dict[str, Any]:
        """Return the progress of the job, and its error."""
        state = {"stage": self.stage, "done": self.done, "total": self.total, "error": self.error}
        return {"running": self.running, **state}

    def wait(self) -> None:
        """Wait for the end of the job."""
        if self._thread is not None:
            self._thread.join()

    def cancel(self) -> None:
        """End the job and remove what it has written."""
        self._cancelled = True
        if self._child is not None:
            self._child.kill()
        self.wait()

    def _work(self, job: SaveJob, finished: Callable[[Mapping[str, Any]], None]) -> None:
        found: Mapping[str, Any] = {}
        error = "the process that tracks ended without a message; the run is unchanged"
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
        with subprocess.Popen([sys.executable, "-I", "-c", _CHILD], **pipes) as child:  # type: ignore[call-overload]
            self._child = child
            if self._cancelled:
                child.kill()
            with contextlib.suppress(OSError):  # the child was killed
                pickle.dump((PACKAGE_PATHS, os.getpid()), child.stdin)
                pickle.dump(job, child.stdin)
            with contextlib.suppress(OSError):
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


# The child imports the server's packages, and none from the working directory.
_CHILD = """
import pickle, sys
sys.path[:], server = pickle.load(sys.stdin.buffer)
from vision.review.saving import in_child
in_child(server)
"""


def in_child(server: int) -> None:
    """Execute the `SaveJob` on standard input and write its progress to standard output as lines of JSON.

    The lines are ["stage", text, frames done, all frames], then ["found", differences, 0, 0] if the run does
    not replace the old one, and ["end", error, 0, 0].

    server: the process that waits for the result. If it has gone, the run is not changed; the decisions are
    in corrections.toml.
    """
    lines, sys.stdout = sys.stdout, sys.stderr

    def tell(content: Any, done: int = 0, total: int = 0, *, kind: str = "stage") -> None:
        # On Windows the parent may be the launcher of the virtual environment.
        if POSIX and os.getppid() != server:
            os._exit(1)
        lines.write(json.dumps([kind, content, done, total]) + "\n")
        lines.flush()

    try:
        job = pickle.load(sys.stdin.buffer)
        save_decisions(job, tell)
        if job.into is not None:
            tell("comparing")
            tell(plain(differences(job.folder, job.into)), kind="found")
        tell("", kind="end")
    except InputError as error:
        tell(str(error), kind="end")
    except BrokenPipeError:
        os._exit(1)
    except Exception as error:  # shown in the page; the run is not changed
        tell(unexpected(error), kind="end")


# --- tracking again before a decision is made ---------------------------------------------------------------


class Trial:
    """Tracks a session's run again with a tentative decision, and compares the result.

    The new run is written beside the old one, with the decision in its corrections.toml. To accept it, the
    two folders are exchanged, so the accepted run is exactly the one shown, and the film is read only once.
    """

    def __init__(self, run: Session) -> None:
        self.run = run
        self._folder: Path | None = None  # of the new run
        self._found: Mapping[str, Any] | None = None
        self._positions: Positions | None = None  # of the new run, once they are shown

    def start(self, request: Mapping[str, Any]) -> None:
        """Start tracking.  Raises: InputError if the decision is not valid or another job is running."""
        run = self.run
        with run.lock:
            run.check_free()
            decision = run.decision_of(request, dated=True)
            self._folder = _trial_folder(run.folder)
            job = run.job([*run.decisions, decision], [])
            run.saver.start(replace(job, into=self._folder), self._take)

    def state(self) -> dict[str, Any]:
        """Return the progress of the trial, and its result."""
        state = self.run.saver.progress() | {"found": self._found}
        return state if self._folder is not None else state | {"running": False, "error": ""}  # a save runs

    def at(self, frame: int) -> dict[str, Any]:
        """Return positions near a frame, and σ_x/Λ_st of the stick phase there, before and after.

        Raises: InputError if there is no finished trial.
        """
        with self.run.lock:
            tracks = self._finished() / "tracks.nc"
            self._positions = self._positions or read_positions(tracks)
            return self.run.effects.preview_of(self._positions, frame)

    def _finished(self) -> Path:
        """Return the folder of the new run."""
        if self._found is None or self._folder is None:
            raise InputError("the trial", "a run that was tracked again", "none", "track again first")
        return self._folder

    def keep(self) -> None:
        """Replace the run by the new one, whose corrections.toml contains the decision.

        Raises: InputError if no trial is finished or the folder cannot be written; nothing changes then.
        """
        run = self.run
        with run.lock:
            folder = self._finished()
            run.stored.check_there()
            try:
                keep_others(run.folder, folder, WRITTEN)
                put_in_place(folder, run.folder.resolve(), overwrite=True)
            except OSError as error:
                raise unwritable(run.folder, error, "not kept") from error
            self.discard()
            run.reload()

    def discard(self) -> None:
        """Remove the new run; if it is not finished, end its job."""
        with self.run.lock:
            if self._folder is None:
                return
            if self.run.saver.running and self._found is None:
                self.run.saver.cancel()
            self.sweep()
            self._folder = self._found = self._positions = None

    def sweep(self) -> None:
        """Remove the folder of a trial, including one left by a killed review."""
        folder = _trial_folder(self.run.folder)
        shutil.rmtree(folder, ignore_errors=True)
        clean_up(folder)

    def _take(self, found: Mapping[str, Any]) -> None:
        self._found = found


def _trial_folder(folder: Path) -> Path:
    path = folder.resolve()
    return path.with_name(f".{path.name}.tried")


def differences(before: Path, after: Path) -> dict[str, Any]:
    """Compare two run folders; pairs of numbers are those before and after.

    Of all sheets: ``sheets`` (left and right), ``positions``, ``doubtful`` positions, median ``error_px``.
    Of the sheets in both runs, which are nearest to each other and within half a pitch: number of positions
    ``compared``, how many ``differ`` by more than `DIFFERENT` errors, ``median_px`` and ``largest_px``
    difference; ``median`` and ``largest`` difference of the ``ratios`` and their number (``of``). ``shells``:
    for each side the ``median`` number of stiff sheets (pair), and the number of stick phases in which it
    changed (``other``). The last two are None if a run has none.

    Raises: InputError for damaged files.
    """
    old, new = (read_positions(folder / "tracks.nc") for folder in (before, after))
    pairs = _pairs(median_positions(old), median_positions(new), old.track_facts.pitch_px)
    return _positions_differ(old, new, *pairs) | _deformation_differs(before, after, *pairs)


def _deformation_differs(before: Path, after: Path, old: Ints, new: Ints) -> dict[str, Any]:
    """Compare σ_x/Λ_st of the sheets in both runs, and the shells (see `differences`)."""
    names = ("deformation", "shells")
    (sheets, shells), (sheets_new, shells_new) = (
        map(read_run(folder).table, names) for folder in (before, after)
    )
    if sheets is None or sheets_new is None or shells is None or shells_new is None:
        return {"ratios": None, "shells": None}
    index = dict(zip(old.tolist(), new.tolist(), strict=True))
    names_of = ("_old", "_new")
    sheets = sheets.assign(index=sheets["index"].map(index))
    both = sheets.merge(sheets_new, on=["event", "index"], suffixes=names_of)
    change = (both["ratio_new"] - both["ratio_old"]).abs().dropna()
    ratios = {"of": len(change), "median": float(change.median()), "largest": float(change.max())}
    sides = shells.merge(shells_new, on=["event", "side"], suffixes=names_of)
    sizes = []
    for side in (-1, 1):
        part = sides[sides["side"] == side]
        if len(part):
            was, now = part["stiff_sheets_old"], part["stiff_sheets_new"]
            medians = [float(was.median()), float(now.median())]
            other = int((was.fillna(-1) != now.fillna(-1)).sum())
            sizes.append({"side": side, "median": medians, "other": other, "of": len(part)})
    return {"ratios": ratios, "shells": sizes}


def _pairs(old_px: Floats, new_px: Floats, pitch_px: float) -> tuple[Ints, Ints]:
    """Return the sheets of two runs that are nearest to each other and within half a pitch."""
    distance = np.nan_to_num(np.abs(old_px[:, None] - new_px[None, :]), nan=np.inf)
    nearest = distance.argmin(axis=1)
    old = np.arange(len(old_px))
    mutual = (distance.argmin(axis=0)[nearest] == old) & (distance[old, nearest] < 0.5 * pitch_px)
    return old[mutual], nearest[mutual].astype(np.int64)


def _positions_differ(before: Positions, after: Positions, old: Ints, new: Ints) -> dict[str, Any]:
    """Compare the positions of the sheets in both runs (see `differences`)."""
    x_old, x_new = before.x_px[:, old], after.x_px[:, new]
    both = np.isfinite(x_old) & np.isfinite(x_new)
    moved = np.abs(x_new - x_old)[both]
    error = np.hypot(before.err_px[:, old], after.err_px[:, new])[both]
    return {
        "sheets": [[int((part.side == side).sum()) for side in (-1, 1)] for part in (before, after)],
        "positions": [int(np.isfinite(part.x_px).sum()) for part in (before, after)],
        "doubtful": [int(part.doubtful.sum()) for part in (before, after)],
        "error_px": [float(np.nanmedian(part.err_px)) for part in (before, after)],
        "compared": len(moved),
        "differ": int((moved > DIFFERENT * error).sum()),
        "median_px": float(np.median(moved)) if moved.size else None,
        "largest_px": float(moved.max()) if moved.size else None,
    }
