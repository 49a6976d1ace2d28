"""Large tables that take little memory: tables in temporary files, and passes over them a part at a time.

Of a table in a file only the part in use is in memory. Where I(x, t) is in one, so are the tables of
positions (`table_beside`). Whatever goes through them in parts (`row_parts`, `in_two_threads`) gives their
memory back to the system, which reads them again when they are needed.
"""

from __future__ import annotations

import gc
import math
import mmap
import os
import tempfile
import weakref
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any, ClassVar, Literal, TypeVar

import numpy as np
from numpy.lib.array_utils import byte_bounds
from numpy.typing import DTypeLike, NDArray

from vision.files import c_library

Item = TypeVar("Item")
Result = TypeVar("Result")
Order = Literal["C", "F"]

ROWS_AT_ONCE = 2048
"""Frames of which tables are computed at once (`row_parts`)."""
_APART_AT_ONCE = 16  # rows far from each other in the file
_KEPT_BYTES = 256 << 20  # of I(x, t) and tables in files: below, memory is spent to save 7 % of the time

_OTHER_THREAD = ThreadPoolExecutor(1)
"""That of `in_two_threads`. To start one for each call takes 0.1 ms, a hundred times in a short film."""


# --- tables in temporary files ------------------------------------------------------------------------------


class _TemporaryFile(mmap.mmap):
    """A shared mapping of a file without a name, which goes when the last array in it does.

    The file keeps what is written to a shared mapping, so that its pages can be given back.
    """

    in_use: ClassVar[weakref.WeakValueDictionary[int, _TemporaryFile]] = weakref.WeakValueDictionary()

    def __init__(self, descriptor: int, _size: int) -> None:
        self.address: int = np.frombuffer(self, np.uint8).ctypes.data
        self.descriptor = os.dup(descriptor)  # for `put_rows`
        self.folder: Path | None = None
        weakref.finalize(self, os.close, self.descriptor)
        self.in_use[id(self)] = self


def table_in_file(
    shape: tuple[int, ...], folder: Path | None, dtype: DTypeLike = np.float32, order: Order = "C"
) -> NDArray[Any]:
    """Return a table of zeros in a temporary file in `folder`, by default the system's.

    It is used as any array; `give_back` lets go of the memory of a part.

    Raises: OSError if the disk is full.
    """
    size = np.dtype(dtype).itemsize * math.prod(shape)
    with tempfile.TemporaryFile(prefix="sheetvision-", dir=folder) as file:  # the mapping keeps it
        if hasattr(os, "posix_fallocate"):  # writing to a mapping on a full disk would kill the process
            os.posix_fallocate(file.fileno(), 0, size)
        else:
            os.ftruncate(file.fileno(), size)
        mapped = _TemporaryFile(file.fileno(), size)
    mapped.folder = folder
    return np.ndarray(shape, dtype, mapped, order=order)


def table_beside(
    values: NDArray[Any], shape: tuple[int, ...], dtype: DTypeLike = np.float64, order: Order = "C"
) -> NDArray[Any]:
    """Return a table whose values are not set yet: in a temporary file in the folder of that of `values`, if
    these are in one and the disk has room, else in memory."""
    file = _file_of(values)
    if file is not None and 0 not in shape:
        _give_back_tables()
        with suppress(OSError):
            return table_in_file(shape, file.folder, dtype, order)
    return np.empty(shape, dtype, order)


def put_rows(table: NDArray[np.float32], start: int, rows: NDArray[np.float32]) -> None:
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


def _give_back_tables(*, small: bool = False) -> None:
    """Give the memory of all tables in temporary files back to the system; small ones if asked."""
    if _TemporaryFile.in_use and hasattr(mmap, "MADV_DONTNEED"):
        files = [file for reference in _TemporaryFile.in_use.valuerefs() if (file := reference())]
        if small or sum(map(len, files)) > _KEPT_BYTES:
            for file in files:
                file.madvise(mmap.MADV_DONTNEED)


def give_back_freed() -> None:
    """Give the memory of tables in temporary files back to the system, and memory that was freed and that the
    C library keeps between what is in use.

    If there are such tables, Python first frees what refers to itself, such as drawings with their pixels.
    The C library is not asked where it is not GNU's. It takes some milliseconds.
    """
    if _TemporaryFile.in_use:
        gc.collect()
        _give_back_tables(small=True)
    if library := c_library():
        with suppress(AttributeError):
            library.malloc_trim(0)


def some_rows(table: NDArray[Any], rows: NDArray[np.int64]) -> NDArray[Any]:
    """Return some rows of a table, copied.

    A few are copied at a time, since each can bring the megabytes around it in the file into memory.
    """
    found = np.empty((len(rows), *table.shape[1:]), table.dtype)
    for part in row_parts(len(rows), _APART_AT_ONCE):
        found[part] = table[rows[part]]
        give_back(table)
    return found


# --- passes over large tables ------------------------------------------------------------------------------


def row_parts(rows: int, at_once: int = ROWS_AT_ONCE) -> Iterator[slice]:
    """Yield slices of consecutive rows: what is computed of a part at a time takes little memory.

    Before the next, the memory of tables in temporary files is given back.
    """
    for start in range(0, rows, at_once):
        yield slice(start, min(start + at_once, rows))
        _give_back_tables()


def parts_in_turn(table: NDArray[Any], at_once: int = 1024) -> Iterator[slice]:
    """Yield slices of consecutive rows of a table, and give back the memory of each before the next."""
    for rows in row_parts(len(table), at_once):
        yield rows
        give_back(table[rows])


def in_two_threads(work: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """Return the results of `work` for all items, in order, found by this thread and another.

    What `work` writes must be another part of an array for each item. `np.errstate` around the call does not
    hold in the other thread. After each item, the memory of tables in temporary files is given back.
    """
    todo, results = list(items), dict[int, Result]()
    numbers = iter(range(len(todo)))

    def work_through() -> None:
        try:
            for k in numbers:  # each thread takes the next
                results[k] = work(todo[k])
                _give_back_tables()
        except BaseException:
            list(numbers)  # nothing is left to do for the other thread
            raise

    if len(todo) < 2:
        work_through()
    else:
        other = _OTHER_THREAD.submit(work_through)
        try:
            work_through()
        finally:
            if not other.cancel():  # it has begun
                other.result()
    return [results[k] for k in range(len(todo))]
