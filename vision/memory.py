"""Large tables that take little memory: those in temporary files, and those of few different words.

Of a table in a file only the part in use is in memory. Where I(x, t) is in one, so are the tables of
positions (`table_beside`). Words, such as the flags of positions, take a byte
each: as text they take 36 bytes a position, so that a film of 100 000 frames would have more text than
positions. Text is made when it is read, of the part that is read.
"""

from __future__ import annotations

import gc
import math
import mmap
import os
import tempfile
import weakref
from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import reduce
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import xarray as xr
from numpy.lib.array_utils import byte_bounds
from numpy.typing import DTypeLike, NDArray
from xarray.backends import BackendArray
from xarray.core import indexing

from vision.files import c_library
from vision.numeric import Bools, Codes, Floats32, Ints, Strings, row_parts

Order = Literal["C", "F"]

_APART_AT_ONCE = 16  # rows far from each other in the file
_KEPT_BYTES = 256 << 20  # of I(x, t) and tables in files: below, memory is spent to save 7 % of the time
_ROWS_AT_ONCE = 1024  # consecutive ones: 8 MiB of 1920 columns


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
    these are in one and the disk has room, else in memory.

    The memory of the tables that are in files by then is given back.
    """
    file = _file_of(values)
    if file is not None and 0 not in shape:
        give_back_tables()
        with suppress(OSError):
            return table_in_file(shape, file.folder, dtype, order)
    return np.empty(shape, dtype, order)


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


def give_back_tables() -> None:
    """Give the memory of all tables in temporary files back to the system, unless they are small."""
    files = [file for reference in _TemporaryFile.in_use.valuerefs() if (file := reference())]
    if hasattr(mmap, "MADV_DONTNEED") and sum(map(len, files)) > _KEPT_BYTES:
        for file in files:
            file.madvise(mmap.MADV_DONTNEED)


def give_back_freed() -> None:
    """Give the memory of tables in temporary files back to the system, and memory that was freed and that the
    C library keeps between what is in use.

    If there are such tables, Python first frees what refers to itself, such as drawings with their pixels.
    The C library is not asked where it is not GNU's. It takes a few milliseconds.
    """
    if _TemporaryFile.in_use:
        gc.collect(1)
        give_back_tables()
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


# --- tables of words ----------------------------------------------------------------------------------------


class _Words(BackendArray):
    """Words as xarray reads them: the number of each in a list of words."""

    def __init__(self, codes: Codes, listed: Sequence[str]) -> None:
        self.codes, self.listed = codes, np.array(listed)
        self.shape, self.dtype = codes.shape, self.listed.dtype

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Any:
        support = indexing.IndexingSupport.OUTER_1VECTOR
        return indexing.explicit_indexing_adapter(key, self.shape, support, self._read)

    def _read(self, key: tuple[Any, ...]) -> Any:
        return self.listed[self.codes[key]]


def words(codes: Codes, listed: Sequence[str]) -> indexing.MemoryCachedArray:
    """Return the data of a variable whose values are words.

    codes: number of each word in the list.  listed: the words.

    Returns
    -------
    MemoryCachedArray
        To pass to `xarray.Variable` as its data, as xarray does for files. What is read of the variable is an
        array of str; one that was read or changed as a whole stays in memory as text.
    """
    read_later: Any = indexing.LazilyIndexedArray(_Words(codes, listed))
    return indexing.MemoryCachedArray(indexing.CopyOnWriteArray(read_later))  # type: ignore[no-untyped-call]


def _numbered(text: xr.DataArray) -> tuple[Codes, Strings] | None:
    """Return the number of each word, and the words, of a table from `words` or a part of it; None if it is
    in memory as text. To count them in 20 000 frames of 50 sheets takes 1 ms, and 57 ms as text."""
    data = text.variable._data  # xarray has no other way to what is not read yet
    while isinstance(data, indexing.MemoryCachedArray | indexing.CopyOnWriteArray):
        data = data.array
    if not isinstance(data, indexing.LazilyIndexedArray) or not isinstance(data.array, _Words):
        return None
    part = xr.Variable(text.dims, indexing.LazilyIndexedArray(data.array.codes, data.key))
    return part.values, data.array.listed


def words_of_characters(characters: xr.DataArray) -> indexing.MemoryCachedArray:
    """Return the data of a variable of words that a file holds as characters, (rows, …, character).

    The file is read a few rows at a time.

    Raises: ValueError or OverflowError if they are no text, or more than 256 different words.
    """
    codes = np.empty(characters.shape[:-1], np.uint8)
    listed: list[bytes] = []
    for rows in row_parts(len(characters)):
        whole = np.ascontiguousarray(characters[rows].values).view(f"S{characters.shape[-1]}")
        codes[rows] = number_words(whole[..., 0], listed)
    return words(codes, [word.decode() for word in listed])


def word_codes(text: xr.DataArray, listed: Sequence[str]) -> Codes:
    """Return the number of each word of a table (rows, …) in a list; 0 for words that are not in it."""
    known = list(listed)
    parts = [number_words(text[rows].values, known) for rows in row_parts(len(text))]
    codes = np.concatenate([np.empty((0, *text.shape[1:]), np.uint8), *parts])
    return np.where(codes < len(listed), codes, np.uint8(0))


def number_words(text: NDArray[Any], listed: list[Any]) -> Codes:
    """Return the number of each word in a list, to which words that it lacks are added."""
    flat, codes, left = text.ravel(), np.empty(text.size, np.uint8), np.arange(text.size)
    while left.size:  # there are about a dozen words; np.unique would sort all of them
        word = flat[left[0]].item()
        if word not in listed:
            listed.append(word)
        other = flat[left] != word
        codes[left[~other]] = listed.index(word)
        left = left[other]
    return codes.reshape(text.shape)


def is_word(text: xr.DataArray, *wanted: str) -> Bools:
    """Return where a table of words (rows, …) has one of those that are wanted; a part is read at a time."""
    if known := _numbered(text):
        codes, listed = known
        return np.asarray(np.isin(listed, wanted)[codes])
    found = np.zeros(text.shape, bool)
    for rows in row_parts(len(text)):
        part: NDArray[Any] = text[rows].values
        found[rows] = reduce(np.logical_or, (part == word for word in wanted))
    return found


def word_counts(text: xr.DataArray) -> dict[str, int]:
    """Return how often each word occurs in a table (rows, …), in alphabetical order."""
    found, counts = _numbered(text), np.zeros(256, np.int64)
    listed = [] if found is None else found[1].tolist()
    for rows in row_parts(len(text)):
        codes = number_words(text[rows].values, listed) if found is None else found[0][rows]
        counts += np.bincount(codes.ravel(), minlength=256)
    known = dict(zip(listed, counts.tolist(), strict=False))
    return {word: known[word] for word in sorted(known) if known[word]}
