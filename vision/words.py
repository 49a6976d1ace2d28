"""Tables of few different words, such as the flags of positions.

They take a byte each: as text they take 36 bytes a position, so that a film of 100 000 frames would have more
text than positions. Text is made when it is read, of the part that is read.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from xarray.backends import BackendArray
from xarray.core import indexing

from vision.memory import row_parts
from vision.numeric import Bools, Codes, Strings


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
    codes = np.empty(text.shape, np.uint8)
    for rows in row_parts(len(text)):
        part = number_words(text[rows].values, known)
        codes[rows] = np.where(part < len(listed), part, np.uint8(0))
    return codes


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
