"""ProfileStore: I(x, t) as it grows, in memory or, past a stated size, in an unlinked temporary file."""

from __future__ import annotations

import os
import tempfile

import numpy as np
from numpy.typing import NDArray

from vision.errors import InputError

SPILL_BYTES = 1 << 30  # 1 GiB: 140 000 frames of 1920 columns
_TRUSTED = 2  # times the spill size: room made at once for a promise, which a damaged header may inflate


class ProfileStore:
    """Rows of float32 appended block by block.

    columns: values in a row.  expected: a guess at the number of rows; more or fewer are fine. spill_bytes:
    above this size the rows live in a temporary file that vanishes with the last array that uses it.
    Raises: InputError where the disk has no room for it.
    """

    def __init__(self, columns: int, *, expected: int | None, spill_bytes: int = SPILL_BYTES) -> None:
        self._columns = columns
        self._spill_bytes = spill_bytes
        self._used = 0
        most = max(1, _TRUSTED * spill_bytes // (4 * columns))
        self._rows = self._room(max(1, min(expected or 1024, most)))

    def append(self, rows: NDArray[np.float32]) -> None:
        """Add `rows` (k, columns) at the end."""
        needed = self._used + rows.shape[0]
        if needed > self._rows.shape[0]:
            self._grow(max(needed, 2 * self._rows.shape[0]))
        self._rows[self._used : needed] = rows
        self._used = needed

    def rows(self) -> NDArray[np.float32]:
        """All rows so far, (n, columns), not copied."""
        return self._rows[: self._used]

    def _grow(self, capacity: int) -> None:
        old = self.rows()
        self._rows = self._room(capacity)
        self._rows[: self._used] = old

    def _room(self, capacity: int) -> NDArray[np.float32]:
        size = capacity * self._columns * 4
        if size <= self._spill_bytes:
            return np.empty((capacity, self._columns), np.float32)
        with tempfile.TemporaryFile(
            prefix="sheetvision-"
        ) as file:  # the mapping keeps it until it is dropped
            _reserve(file.fileno(), size)
            return np.memmap(file, np.float32, "r+", shape=(capacity, self._columns))


def _reserve(descriptor: int, size: int) -> None:
    """Make a file that long, its room on the disk included: a mapping that finds none kills the process."""
    try:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(descriptor, 0, size)
        else:
            os.truncate(descriptor, size)
    except OSError as error:
        found = (error.strerror or str(error)).lower()
        room = f"{size / (1 << 30):.1f} GiB for I(x, t)"
        raise InputError(tempfile.gettempdir(), room, found, "set TMPDIR, or take --columns") from error
