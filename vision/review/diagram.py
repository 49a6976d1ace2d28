"""I(x, t) of a run, read from kymograph.tif a part at a time, and the ridges in it."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from threading import Lock

import numpy as np

from vision.errors import InputError
from vision.numeric import Floats32
from vision.review.positions import Positions
from vision.run.reading import AGAIN, stored_kymograph
from vision.sheets.ridges import Ridges, find_ridges
from vision.sheets.settings import TrackingSettings

PARTS_KEPT = 4
"""Parts that neighbouring tiles share; more keep more memory, up to 8 MB each."""


class Diagram:
    """I(x, t) on disk: read, not mapped, so that it takes no memory but for the part in use.

    Parameters
    ----------
    path
        kymograph.tif.
    first_column
        Of the picture, at which it begins.
    settings
        Of the tracking, by which ridges are found again.

    Raises
    ------
    InputError
        For a file that is not there, or damaged.
    """

    def __init__(self, path: Path, first_column: int, settings: TrackingSettings) -> None:
        self.path, self.first_column, self.settings = path, first_column, settings
        self._offset, self._dtype, (self.frames, self.columns) = stored_kymograph(path)
        self._file = path.open("rb")  # kept open: saving puts another file in its place
        self._lock = Lock()
        self.shared_rows = lru_cache(PARTS_KEPT)(self.rows)

    def close(self) -> None:
        """Let the file go."""
        self._file.close()

    def rows(self, start: int, stop: int) -> Floats32:
        """These frames, (frame, x), grey levels; NaN in frames that are not there."""
        stop = min(stop, self.frames)
        count = max(0, stop - start) * self.columns
        with self._lock:
            self._file.seek(self._offset + start * self.columns * self._dtype.itemsize)
            values = np.fromfile(self._file, self._dtype, count)
        if values.size < count:
            raise InputError(self.path, f"{self.frames} frames", "a file that was cut short", AGAIN)
        return np.asarray(values.reshape(-1, self.columns), np.float32)

    def sample(self, count: int) -> Floats32:
        """Frames spread over the run."""
        at = np.unique(np.linspace(0, self.frames - 1, count).astype(np.int64))
        return np.concatenate([self.rows(int(row), int(row) + 1) for row in at])

    def ridges(self, positions: Positions, rows: slice) -> Ridges:
        """Candidates in these frames, as the tracking saw them; columns counted from the diagram's first."""
        return find_ridges(self.rows(rows.start, rows.stop), positions.comb, settings=self.settings)
