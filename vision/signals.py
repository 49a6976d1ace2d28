"""Maxima, running medians and running means of a line of values.

`scipy.signal` and `scipy.ndimage` have the same. They are not used: the first loads `scipy.stats` and with it
most of SciPy, which takes longer than tracking a thousand frames; the second takes half as long.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from vision.numeric import Bools, Floats, Ints


def running_median(
    values: NDArray[np.floating], size: int, *, ends: Literal["edge", "symmetric"] = "edge"
) -> Floats:
    """Median of `size` values around each; the upper one of the two in the middle where `size` is even.

    Parameters
    ----------
    values
        (samples,), without NaN.
    size
        Of the window, in samples.
    ends
        What stands beyond the ends: the last value there, or the line mirrored.
    """
    padded = np.pad(np.asarray(values, np.float64), (size // 2, (size - 1) // 2), ends)
    windows, middle = sliding_window_view(padded, size), size // 2
    block = 1 << 16  # more windows at once take more memory, and no less time
    parts = [
        np.partition(windows[start : start + block], middle, axis=1)[:, middle]
        for start in range(0, len(windows), block)
    ]
    return np.concatenate(parts) if parts else np.empty(0)


def running_mean(values: NDArray[np.floating], size: int) -> Floats:
    """Mean of `size` values around each; beyond the ends stands the last value there."""
    padded = np.pad(np.asarray(values, np.float64), (size // 2 + 1, (size - 1) // 2), "edge")
    level = padded.mean()  # sums of what is left lose fewer digits
    total = np.cumsum(padded - level)
    return np.asarray(level + (total[size:] - total[:-size]) / size, np.float64)


class Maxima(NamedTuple):
    """Local maxima from left to right, all (K,).

    Parameters
    ----------
    at
        Place; of a plateau its middle, rounded down.
    prominence
        Height above the higher of the lowest points on both sides, each within reach and before anything
        higher.
    """

    at: Ints
    prominence: Floats


def find_maxima(
    line: NDArray[np.floating], *, least_prominence: float, reach: int, widest: int | None = None
) -> Maxima:
    """Maxima of a line that rise above their surroundings.

    Parameters
    ----------
    line
        Values without NaN.
    least_prominence
        Above 0; maxima of less are left out.
    reach
        How far to either side the surroundings extend.
    widest
        Longest plateau.

    Returns
    -------
    Maxima

    Notes
    -----
    The same as `scipy.signal.find_peaks` with a window of ``2 reach + 1``.
    Between two neighbouring extrema a line only rises or only falls, so that it is enough to go from one
    minimum to the next.
    """
    first, last = _turns(line)
    level = line[last]
    rises = level[1:] > level[:-1]
    top = 1 + np.flatnonzero(rises[:-1] & ~rises[1:])
    dip = np.flatnonzero(np.append(True, ~rises) & np.append(rises, True))  # before and after each maximum
    at = (first[top] + last[top]) // 2
    ground = _Ground(line, at, level[top], level[dip], reach)
    some = np.flatnonzero(ground.may_stand_out(least_prominence))
    if widest is not None:
        some = some[(last[top] - first[top])[some] < widest]
    left = ground.lowest(some, last[dip], to_right=False)
    high = level[top[some]] - left >= least_prominence
    some, left = some[high], left[high]
    right = ground.lowest(some, first[dip], to_right=True)
    prominence = np.asarray(level[top[some]] - np.maximum(left, right), np.float64)
    enough = prominence >= least_prominence
    return Maxima(at[some[enough]], prominence[enough])


def half_widths(line: NDArray[np.floating], maxima: Maxima) -> Floats:
    """Widths of maxima at half their prominence, as `scipy.signal.peak_widths`, (K,).

    Parameters
    ----------
    line
        The line in which they were found.
    maxima
        From `find_maxima`.
    """
    half = line[maxima.at] - 0.5 * maxima.prominence
    with np.errstate(invalid="ignore"):  # a line may end in -inf
        return _to_half(line, maxima.at, half, -1) + _to_half(line, maxima.at, half, 1)


def _turns(line: NDArray[np.floating]) -> tuple[Ints, Ints]:
    """First and last place of the runs of equal values at which a line may turn, its ends included.

    In between it only rises or only falls. There are few of them: all that follows is done on these alone.
    """
    rises, falls = line[1:] > line[:-1], line[1:] < line[:-1]
    other = (rises[1:] != rises[:-1]) | (falls[1:] != falls[:-1])
    knots = np.concatenate([[0], 1 + np.flatnonzero(other), [len(line) - 1]])
    value = line[knots]
    changes = np.flatnonzero(value[1:] != value[:-1])
    return knots[np.append(0, changes + 1)], knots[np.append(changes, len(knots) - 1)]


class _Ground(NamedTuple):
    """A line with its maxima (K,) and the minima around them (K + 1,)."""

    line: NDArray[np.floating]
    at: Ints
    height: NDArray[np.floating]
    depth: NDArray[np.floating]
    reach: int

    def may_stand_out(self, least: float) -> Bools:
        """False for maxima that cannot rise by so much, since they stand too little above the minimum between
        them and a higher neighbour: most of those that noise makes, (K,)."""
        height, depth = self.height.astype(np.float64), self.depth.astype(np.float64)
        up = np.diff(height)
        found = np.ones(len(height), np.bool_)
        found[1:] &= (up >= 0) | (height[1:] - depth[1:-1] >= least)
        found[:-1] &= (up <= 0) | (height[:-1] - depth[1:-1] >= least)
        return found

    def lowest(self, maxima: Ints, place: Ints, *, to_right: bool) -> Floats:
        """Lowest value on one side of the maxima, within reach and before anything higher.

        place: of the minima, at the end from which they are reached.
        """
        step, last = (1 if to_right else -1), len(self.at) - 1
        on, dip = np.arange(len(maxima)), maxima + to_right
        here, height = self.at[maxima], self.height[maxima]
        low = height.astype(np.float64)
        while len(on):
            inside = np.abs(place[dip] - here) <= self.reach
            seen = self.depth[dip]
            seen[~inside] = self.line[here[~inside] + step * self.reach]
            low[on] = np.minimum(low[on], seen)
            beyond = dip if to_right else dip - 1  # the next maximum
            further = inside & (beyond >= 0) & (beyond <= last)
            further &= self.height[np.minimum(np.maximum(beyond, 0), last)] <= height
            on, dip, here, height = on[further], dip[further] + step, here[further], height[further]
        return low


def _to_half(line: NDArray[np.floating], at: Ints, half: Floats, step: int) -> Floats:
    """Distance from the maxima to where the line falls to `half`, on one side."""
    here, on = at.copy(), np.arange(len(at))
    while len(on):
        here[on] += step
        on = on[line[here[on]] > half[on]]
    inner, outer = line[here - step].astype(np.float64), line[here].astype(np.float64)
    return np.asarray(np.abs(here - at) - (half - outer) / (inner - outer), np.float64)


def apart(at: Ints, height: NDArray[np.floating], least: float) -> Ints:
    """Maxima that are at least so far apart: of those that are closer the highest stay.

    Parameters
    ----------
    at
        Places in rising order.
    height
        Of each.
    least
        Smallest distance.
    """
    kept, near = np.ones(len(at), np.bool_), np.diff(at) < least
    crowded = np.flatnonzero(np.r_[near, False] | np.r_[False, near])  # few: the others need no loop
    for k in crowded[np.argsort(height[crowded], kind="stable")[::-1]]:
        if kept[k]:
            low, high = np.searchsorted(at, [at[k] - least + 1, at[k] + least])
            kept[low:high] = False
            kept[k] = True
    return at[kept]
