"""Frames as they are read: I(x, t), in memory or in a temporary file, with the status and time of each."""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vision.errors import InputError
from vision.numeric import Floats, Floats32, Strings
from vision.video.settings import VideoSettings

STATUS_TYPE = "<U7"  # ok, blank, corrupt, lost


@dataclass(frozen=True)
class FramesRead:
    """Consecutive frames: intensity (frame, x), grey levels; status and time of each, s."""

    intensity: Floats32
    status: Strings
    times_s: Floats


class FrameStore:
    """All frames read so far, in order.

    Parameters
    ----------
    columns, expected, spill_bytes, folder
        See `ProfileStore`.
    """

    def __init__(
        self, columns: int, *, expected: int | None, spill_bytes: int, folder: Path | None = None
    ) -> None:
        self._rows = ProfileStore(columns, expected=expected, spill_bytes=spill_bytes, folder=folder)
        self._marks = np.zeros(1024, [("status", STATUS_TYPE), ("time_s", np.float64)])
        self.count = 0
        """Frames so far."""

    def append(self, frames: FramesRead) -> None:
        """Add frames at the end."""
        needed = self.count + frames.status.size
        if needed > self._marks.size:
            self._marks = np.concatenate(
                [self._marks, np.zeros(max(needed, self._marks.size), self._marks.dtype)]
            )
        new = self._marks[self.count : needed]
        new["status"], new["time_s"] = frames.status, frames.times_s
        self._rows.append(frames.intensity)
        self.count = needed

    def part(self, start: int, stop: int) -> FramesRead:
        """Frames `start` to before `stop`, not copied."""
        marks = self._marks[start:stop]
        return FramesRead(self._rows.rows()[start:stop], marks["status"], marks["time_s"])

    def copy(self, start: int, stop: int) -> FramesRead:
        """The same, as a copy."""
        part = self.part(start, stop)
        return FramesRead(part.intensity.copy(), part.status.copy(), part.times_s.copy())

    def all(self) -> FramesRead:
        """All frames; the intensity is not copied."""
        marks = self._marks[: self.count]
        return FramesRead(self._rows.rows(), marks["status"].copy(), marks["time_s"].copy())


class ProfileStore:
    """I(x, t) as it grows: rows of float32, in memory or in a temporary file.

    Parameters
    ----------
    columns
        Values in a row.
    expected
        A guess at the number of rows; more or fewer are fine.
    spill_bytes
        Above this size the rows live in a temporary file.
    folder
        Where that file lies; that of the system's temporary files if not given.

    Raises
    ------
    InputError
        Where the disk is full.
    """

    def __init__(
        self,
        columns: int,
        *,
        expected: int | None,
        spill_bytes: int = VideoSettings.spill_bytes,
        folder: Path | None = None,
    ) -> None:
        self._columns = columns
        self._folder = folder
        self._spill_bytes = spill_bytes
        self._used = 0
        most = max(1, 2 * spill_bytes // (4 * columns))  # a damaged header may announce any number
        self._rows = self._allocate(max(1, min(expected or 1024, most)))

    def append(self, rows: Floats32) -> None:
        """Add `rows` (k, columns) at the end."""
        needed = self._used + rows.shape[0]
        if needed > self._rows.shape[0]:
            old = self.rows()
            self._rows = self._allocate(max(needed, 2 * self._rows.shape[0]))
            self._rows[: self._used] = old
        self._rows[self._used : needed] = rows
        self._used = needed

    def rows(self) -> Floats32:
        """All rows so far, (n, columns), not copied."""
        return self._rows[: self._used]

    def _allocate(self, capacity: int) -> Floats32:
        size = capacity * self._columns * 4
        if size <= self._spill_bytes:
            return np.empty((capacity, self._columns), np.float32)
        with tempfile.TemporaryFile(prefix="sheetvision-", dir=self._folder) as file:  # the mapping keeps it
            try:  # the whole length at once: a mapping that finds the disk full kills the process
                if hasattr(os, "posix_fallocate"):
                    os.posix_fallocate(file.fileno(), 0, size)
                else:
                    os.truncate(file.fileno(), size)
            except OSError as error:
                wanted = f"{size / (1 << 30):.1f} GiB for I(x, t)"
                found = (error.strerror or str(error)).lower()
                advice = (
                    "give another `out`, or `columns`" if self._folder else "set TMPDIR, or give `columns`"
                )
                raise InputError(self._folder or tempfile.gettempdir(), wanted, found, advice) from error
            return np.memmap(file, np.float32, "r+", shape=(capacity, self._columns))
