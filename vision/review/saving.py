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
from vision.review.editing import Before
from vision.run.provenance import Origin, Parameter
from vision.run.reading import input_of, read_run, read_strip, tracks_of
from vision.run.writing import write_run
from vision.sheets.corrections import Correction, Decisions
from vision.video import Video

Tell = Callable[[str], None]


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
    """

    folder: Path
    settings: Settings
    applied: tuple[Correction, ...]
    decisions: Decisions
    clock: Clock | None = None
    film: Path | None = None
    beside: Mapping[str, bytes] | None = None
    options: Mapping[str, str] = field(default_factory=dict)


def save_run(job: Job, tell: Tell = lambda stage: None) -> None:
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
    inputs, recorded = run.facts.get("inputs") or [], run.facts.get("parameters", {})
    size = recorded.get("pixel_size", {}).get("value")
    earlier = Analysis(
        settings=replace(settings, corrections=job.applied),
        strip=read_strip(run),
        tracks=tracks_of(run),
        clock=job.clock,
    )
    with_force = recorded.get("force", {}).get("value") is not None
    tell("tracking")
    analysis = analyse(
        _recording(job, inputs),
        input_of(folder, inputs[-1]) if with_force else None,
        settings if settings.pitch_um is None else replace(settings, pixel_size_um=None),
        earlier=earlier,
        progress=lambda done, total: tell(f"reading the film, {done} of {total or 'unknown'} frames"),
    )
    parameters = {name: Parameter(one.get("value"), one.get("how")) for name, one in recorded.items()}
    if settings.pitch_um is not None and size is not None:
        parameters["pixel_size"] = Parameter(analysis.pixel_size_um, "found")
    tell("writing")
    write_run(
        analysis,
        folder,
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
    """One saving at a time, beside the server.

    Parameters
    ----------
    done
        Called, in a thread, when a run has been replaced.

    Notes
    -----
    A process of its own keeps the page answering and gives its memory back. It writes nothing once the
    server that started it is gone.
    """

    def __init__(self, done: Callable[[], None]) -> None:
        self._done = done
        self._thread: Thread | None = None
        self.stage, self.error = "", ""

    @property
    def running(self) -> bool:
        """Whether a run is being saved."""
        return self._thread is not None and self._thread.is_alive()

    def start(self, job: Job) -> None:
        """Begin.  Raises: InputError while another one runs."""
        if self.running:
            raise InputError("save", "one saving at a time", "one that runs")
        self.stage, self.error = "starting", ""
        self._thread = Thread(target=self._work, args=(job,), daemon=True)
        self._thread.start()

    def wait(self) -> None:
        """Until nothing is being saved."""
        if self._thread is not None:
            self._thread.join()

    def _work(self, job: Job) -> None:
        error = "the process that saves ended without a word; the run is as it was"
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
        with subprocess.Popen([sys.executable, "-c", _CHILD], **pipes) as child:  # type: ignore[call-overload]
            with contextlib.suppress(BrokenPipeError):
                pickle.dump((sys.path, os.getpid()), child.stdin)
                pickle.dump(job, child.stdin)
                child.stdin.close()
            for line in child.stdout:
                kind, text = json.loads(line)
                if kind == "stage":
                    self.stage = text
                else:
                    error = text
        if not error:
            try:
                self._done()
            except InputError as broken:
                error = str(broken)
        self.stage, self.error = "", error


# The packages that the server has, and none in the working directory.
_CHILD = """
import pickle, sys
sys.path[:], server = pickle.load(sys.stdin.buffer)
from vision.review.saving import in_child
in_child(server)
"""


def in_child(server: int) -> None:
    """Save what standard input holds, and tell how it goes, a line of JSON each: ["stage", text], at last
    ["end", error or ""].

    Parameters
    ----------
    server
        The process that waits for it. Once it is gone, the run is left as it was: its decisions are in
        corrections.toml.
    """
    lines, sys.stdout = sys.stdout, sys.stderr

    def tell(stage: str, kind: str = "stage") -> None:
        if os.getppid() != server:
            os._exit(1)
        lines.write(json.dumps([kind, stage]) + "\n")
        lines.flush()

    try:
        save_run(pickle.load(sys.stdin.buffer), tell)
        tell("", "end")
    except InputError as error:
        tell(str(error), "end")
    except BrokenPipeError:
        os._exit(1)
    except Exception as error:  # shown in the page; the run stays as it was
        tell(" ".join(f"unexpected {type(error).__name__}: {error}".split()), "end")


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
