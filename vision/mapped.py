"""Large tables in temporary files, of which only the part in use is in memory."""

from __future__ import annotations

import mmap
import os
import tempfile
import weakref
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.array_utils import byte_bounds
from numpy.typing import NDArray

from vision.files import c_library
from vision.numeric import Floats32, Ints, row_parts

_APART_AT_ONCE = 16  # rows far from each other in the file
_ROWS_AT_ONCE = 1024  # consecutive ones: 8 MiB of 1920 columns


class _TemporaryFile(mmap.mmap):
    """A shared mapping of a file without a name, which goes when the last array in it does.

    The file keeps what is written to a shared mapping, so that its pages can be given back.
    """

    def __init__(self, descriptor: int, _size: int) -> None:
        self.address: int = np.frombuffer(self, np.uint8).ctypes.data
        self.descriptor = os.dup(descriptor)  # for `put_rows`
        weakref.finalize(self, os.close, self.descriptor)


def table_in_file(rows: int, columns: int, folder: Path | None) -> Floats32:
    """Return a table of zeros (rows, columns) in a temporary file in `folder`, by default the system's.

    It is used as any array; `give_back` lets go of the memory of a part.

    Raises: OSError if the disk is full.
    """
    size = 4 * rows * columns
    with tempfile.TemporaryFile(prefix="sheetvision-", dir=folder) as file:  # the mapping keeps it
        if hasattr(os, "posix_fallocate"):  # writing to a mapping on a full disk would kill the process
            os.posix_fallocate(file.fileno(), 0, size)
        else:
            os.ftruncate(file.fileno(), size)
        return np.ndarray((rows, columns), np.float32, _TemporaryFile(file.fileno(), size))


def put_rows(table: Floats32, start: int, rows: Floats32) -> None:
    """Write consecutive rows into a table from row `start` on; into a file, without bringing it into memory.

    Writing through the mapping would first have the system fetch each page, which takes four times as long.
    """
    place = table[start : start + len(rows)]
    file = _file_of(table)
    if file is None or not place.flags.c_contiguous or not hasattr(os, "pwrite"):
        place[:] = rows
        give_back(place)
        return
    data = np.ascontiguousarray(rows, np.float32).reshape(-1).view(np.uint8).data
    at = byte_bounds(place)[0] - file.address
    while data:
        written = os.pwrite(file.descriptor, data, at)
        data, at = data[written:], at + written


def give_back(values: NDArray[Any]) -> None:
    """Give the memory of values in a temporary file back to the system, which reads them again when needed.

    Nothing happens to values that are in memory alone, or where the system has no such call.
    """
    file = _file_of(values)
    if file is not None and values.size and hasattr(mmap, "MADV_DONTNEED"):
        start, stop = (int(place) - file.address for place in byte_bounds(values))
        start -= start % mmap.PAGESIZE
        file.madvise(mmap.MADV_DONTNEED, start, stop - start)


def _file_of(values: NDArray[Any]) -> _TemporaryFile | None:
    """Return the temporary file in which values are stored, None if they are in memory alone."""
    owner: Any = values
    while isinstance(owner, np.ndarray):
        owner = owner.base
    return owner if isinstance(owner, _TemporaryFile) else None


def give_back_freed() -> None:
    """Give memory that was freed, and that the C library keeps between what is in use, back to the system.

    Nothing happens where it is not the GNU C library. It takes a few milliseconds.
    """
    if library := c_library():
        with suppress(AttributeError):
            library.malloc_trim(0)


def parts_in_turn(table: NDArray[Any], at_once: int = _ROWS_AT_ONCE) -> Iterator[slice]:
    """Yield slices of consecutive rows of a table, and give back the memory of each before the next."""
    for rows in row_parts(len(table), at_once):
        yield rows
        give_back(table[rows])


def some_rows(table: NDArray[Any], rows: Ints) -> NDArray[Any]:
    """Return some rows of a table, copied.

    A few are copied at a time, since each can bring the megabytes around it in the file into memory.
    """
    found = np.empty((len(rows), *table.shape[1:]), table.dtype)
    for part in row_parts(len(rows), _APART_AT_ONCE):
        found[part] = table[rows[part]]
        give_back(table)
    return found
