"""A run is made again under its decisions, in a process of its own, and takes the old one's place whole."""

from __future__ import annotations

import contextlib
import io
import json
import os
import pickle
import subprocess
import sys
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vision.clock import Clock
from vision.errors import InputError
from vision.pipeline import Analysis, Settings, analyse, open_recording
from vision.review.differences import differences
from vision.review.editing import Before
from vision.run.folder import clean_up
from vision.run.provenance import Origin, Parameter, plain
from vision.run.reading import input_of, parameters_of, read_run, read_strip, tracks_of
from vision.run.writing import write_run
from vision.sheets.corrections import Correction, Decisions
from vision.video import Video

Tell = Callable[..., None]
"""Called with what is being done, and with frames done and their number where those are known."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """What is to be saved.

    Parameters
    ----------
    folder, settings
        The run, and the settings that it was made with, without corrections.
    applied
        Decisions that it already follows.
    decisions
        Those that it shall follow.
    clock
        The run's, kept where no decision changes it.
    film
        Where the film lies now, if not where it was. Without the film all but another strip can be saved.
    beside
        Files of the review that are kept with the run: content by name.
    options
        Names of arguments and the command's options that the report shows in their place.
    into
        Where the run is written, if it shall not take the old one's place.
    """

    folder: Path
    settings: Settings
    applied: tuple[Correction, ...]
    decisions: Decisions
    clock: Clock | None = None
    film: Path | None = None
    beside: Mapping[str, bytes] | None = None
    options: Mapping[str, str] = field(default_factory=dict)
    into: Path | None = None


def save_run(job: Job, tell: Tell = lambda stage, done=0, total=0: None) -> None:
    """Run what follows from the decisions again and replace the run folder.

    Parameters
    ----------
    job
        What is to be saved.
    tell
        Called with what is being done.

    Raises
    ------
    InputError
        Where a decision does not fit, or a file is gone; the run stays as it was.
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

    analysis = analyse(
        _recording(job, inputs),
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


def _recording(job: Job, inputs: list[Any]) -> Video | None:
    """The film, for its first frame and another strip; None where it is gone."""
    try:
        return open_recording(input_of(job.folder, inputs[0], job.film), job.settings)
    except InputError:
        return None


# --- in a process of its own --------------------------------------------------------------------------------


class Saver:
    """One run at a time that is made again, beside the server.

    Notes
    -----
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

    def start(self, job: Job, finished: Callable[[Mapping[str, Any]], None]) -> None:
        """Begin.

        Parameters
        ----------
        job
            What is to be done.
        finished
            Called, in a thread, when the run has been written, with its `differences` from the old one where
            that has kept its place.

        Raises
        ------
        InputError
            While another one is being made.
        """
        if self.running:
            raise InputError("the run", "one that is not being tracked or saved", "one that is", "wait")
        self.stage, self.error, self._cancelled = "starting", "", False
        self._thread = Thread(target=self._work, args=(job, finished), daemon=True)
        self._thread.start()

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

    def _work(self, job: Job, finished: Callable[[Mapping[str, Any]], None]) -> None:
        found: Mapping[str, Any] = {}
        error = "the process that tracks ended without a word; the run is as it was"
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
        with subprocess.Popen([sys.executable, "-c", _CHILD], **pipes) as child:  # type: ignore[call-overload]
            self._child = child
            if self._cancelled:
                child.kill()
            with contextlib.suppress(BrokenPipeError):  # it was killed
                pickle.dump((sys.path, os.getpid()), child.stdin)
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

    Parameters
    ----------
    server
        The process that waits for it. Once it is gone, the run is left as it was: its decisions are in
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


# --- what decisions replaced --------------------------------------------------------------------------------


def pack(steps: Sequence[Before | None]) -> bytes:
    """What the decisions replaced, in their order, as the content of an .npz file."""
    facts = [
        None
        if step is None
        else {name: getattr(step, name) for name in ("how", "first", "stop", "sheets", "axis_px", "axis_how")}
        for step in steps
    ]
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
    """The inverse of `pack`; nothing for a file that is not there or damaged: then a decision can still be
    taken back, but is seen only when it is saved."""
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
