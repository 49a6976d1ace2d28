"""What was read of a long film is kept beside the run folder, so that an interrupted run can go on."""

from __future__ import annotations

import hashlib
import os
import shutil
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Self

import numpy as np
from numpy.typing import NDArray

import vision
from vision.errors import InputError
from vision.files import reading
from vision.run.folder import existing_parent, lock_folder, reading_folder
from vision.run.provenance import describe_input, plain, write_json
from vision.run.reading import read_json
from vision.video import FramesRead, FrameStore, Video, VideoSettings, video_files

FRAMES, FACTS = "frames", "reading.json"
STATUS = ("", "ok", "corrupt", "lost")  # by their number in the file; 0 is what a crash leaves unwritten
PART = 4096  # frames read back at a time
AGAIN = "run without `resume` to start at the first frame"


class Checkpoint:
    """Keeps I(x, t) block by block while a film is read, and gives it back to a run that resumes.

    A folder beside the run folder, hidden as the run folder itself is until it is whole, holds one file that
    grows by a record per frame (status, time, the strip's mean) and one that says what is read and how. It
    exists once the reading has taken `after_s`, and until the run folder is written: `done` removes it. A
    record that was cut short by a kill is left out. Without `resume`, what an earlier run left is removed.

    Parameters
    ----------
    target
        The run folder to come.
    resume
        Go on where an interrupted run of the same film with the same settings ended; from the first frame
        where nothing was kept.
    after_s
        Seconds of reading after which frames are kept.

    Raises
    ------
    InputError
        With `resume`: on entering, where another process reads into the same folder; from `begin`, where the
        film or the way it is read is another one.

    Notes
    -----
    Frames are numbered without gaps (`vision.video.Reader`), and each row is computed from its frame alone,
    so that the result is the same bit for bit. A disk that is full costs the checkpoint, not the run.
    """

    def __init__(
        self, target: Path, *, resume: bool = False, after_s: float = VideoSettings.resume_after_s
    ) -> None:
        self.folder = existing_parent(target)
        """Where I(x, t) may spill: on the disk that has room for results."""
        self.resumed = 0
        """Frames taken over from the interrupted run."""
        self.kept = 0
        """Frames in the file by now."""
        self._target, self._place = target, reading_folder(target)
        self._resume, self._after_s = resume, after_s
        self._began = time.monotonic()
        self._own = False  # whether the folder is this run's
        self._off = False  # whether nothing is kept: another run has the folder, or it cannot be written
        self._lock: int | None = None
        self._file: BinaryIO | None = None
        self._facts: Callable[[], dict[str, Any]] = dict

    def __enter__(self) -> Self:
        if self._place.is_dir():
            self._lock = lock_folder(self._place)
            self._own = self._lock is not None or os.name != "posix"
            self._off = not self._own
            if self._off and self._resume:
                found, advice = "one that still runs", "wait for it, or give another `out`"
                raise InputError(self._target, "an interrupted run to resume", found, advice)
            if not self._resume:
                self.done()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        where: TracebackType | None,
    ) -> None:
        if self._file is not None:
            self._file.close()
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def done(self) -> None:
        """Leave nothing to resume: the run folder is written."""
        if self._own:
            shutil.rmtree(self._place, ignore_errors=True)
        self.__exit__(None, None, None)
        self._file, self._own, self.kept = None, False, 0

    def begin(self, video: Video, rows: slice, columns: slice) -> Iterator[FramesRead]:
        """What an interrupted run kept of this reading, part by part; nothing where there is none."""
        self._began = time.monotonic()
        self._facts = partial(_facts, video, rows, columns)
        width = columns.stop - columns.start
        self._record = np.dtype([("status", "u1"), ("time_s", "<f8"), ("intensity", "<f4", width)])
        if not (self._own and (self._place / FACTS).is_file()):
            return
        self._check()
        frames = self._place / FRAMES
        with reading(frames, "frames of an interrupted run", AGAIN):
            self._file = frames.open("r+b", buffering=0)
        while (part := np.fromfile(self._file, self._record, PART)).size:
            whole = part[: _first_odd(part["status"])]
            self.kept += whole.size
            yield FramesRead(whole["intensity"], np.array(STATUS)[whole["status"]], whole["time_s"])
            if whole.size < part.size:
                break
        self.resumed = self.kept
        self._file.truncate(self.kept * self._record.itemsize)
        self._file.seek(0, os.SEEK_END)

    def add(self, frames: FrameStore) -> None:
        """Keep what is new, once reading has taken long enough."""
        if self._off or (self._file is None and time.monotonic() - self._began < self._after_s):
            return
        try:
            if self._file is None:
                self._start()
            for start in range(self.kept, frames.count, PART):
                self._write(frames.part(start, min(start + PART, frames.count)))
        except (OSError, InputError):  # the run itself may still succeed
            self.done()
            self._off = True

    def _start(self) -> None:
        """Make the folder; the facts come last, as frames without them are nothing."""
        self.done()
        self._place.mkdir(parents=True)
        self._own, self._lock = True, lock_folder(self._place)
        self._file = (self._place / FRAMES).open("wb", buffering=0)
        write_json(self._facts(), self._place / FACTS)

    def _write(self, part: FramesRead) -> None:
        records = np.empty(part.status.size, self._record)
        records["status"] = [STATUS.index(status) for status in part.status]
        records["time_s"], records["intensity"] = part.times_s, part.intensity
        assert self._file is not None
        data = memoryview(records.tobytes())
        while data:
            data = data[self._file.write(data) :]
        self.kept += records.size

    def _check(self) -> None:
        """Refuse to go on with another film, or with the same one read otherwise."""
        kept = read_json(self._place / FACTS)
        for name, now in plain(self._facts()).items():
            if kept.get(name) != now:
                about = "the same film" if name == "inputs" else f"{name} {kept.get(name)} as before"
                found = "one that was changed or replaced" if name == "inputs" else str(now)
                raise InputError(self._target, f"{about}, to resume", found, AGAIN)


def _facts(video: Video, rows: slice, columns: slice) -> dict[str, Any]:
    """What I(x, t) depends on."""
    given = video.given_times_s
    return {
        "sheetvision": vision.__version__,
        "strip": [rows.start, rows.stop],
        "columns": [columns.start, columns.stop],
        "rotate": video.rotate,
        "frames": [video.first, video.stop],
        "fps": video.given_fps,
        "timestamps": None if given is None else hashlib.sha256(given.tobytes()).hexdigest(),
        "inputs": _fingerprints(video),
    }


def _fingerprints(video: Video) -> list[dict[str, Any]]:
    """Size and content of every file of the film; its name and time may change."""
    described = [describe_input(path) for path in video_files(video.path)]
    return [{k: v for k, v in one.items() if k not in ("path", "modified_s")} for one in described]


def _first_odd(status: NDArray[np.uint8]) -> int:
    """How many records come before the first one that was not written."""
    odd = np.flatnonzero((status == 0) | (status >= len(STATUS)))
    return int(odd[0]) if odd.size else status.size
