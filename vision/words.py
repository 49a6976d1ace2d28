"""Tables of few different words, such as the flags of positions, at one byte each.

Text takes 36 bytes a position, so that a film of 100 000 frames would have more text than positions. It is
made when it is read, of the part that is read.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import reduce
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from xarray.backends import BackendArray
from xarray.core import indexing

from vision.numeric import Bools, Codes, row_parts


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


def is_word(text: xr.DataArray, *wanted: str) -> Bools:
    """Return where a table of words (rows, …) has one of those that are wanted; a part is read at a time."""
    found = np.zeros(text.shape, bool)
    for rows in row_parts(len(text)):
        part: NDArray[Any] = text[rows].values
        found[rows] = reduce(np.logical_or, (part == word for word in wanted))
    return found


def word_counts(text: xr.DataArray) -> dict[str, int]:
    """Return how often each word occurs in a table (rows, …), in alphabetical order."""
    counts: Counter[str] = Counter()
    for rows in row_parts(len(text)):
        left = text[rows].values.ravel()
        while left.size:  # there are about a dozen words; np.unique would sort all of them
            other = left != left[0]
            counts[str(left[0])] += left.size - int(other.sum())
            left = left[other]
    return dict(sorted(counts.items()))
