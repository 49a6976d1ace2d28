"""Maxima, running medians and means, and the extremes of intervals, of one-dimensional signals.

`scipy.signal` and `scipy.ndimage` have equivalent functions, but importing them takes longer than tracking a
thousand frames. Force recordings, which have millions of samples, are searched by those of SciPy.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from vision.memory import row_parts
from vision.numeric import AT_ONCE, Floats, Ints


def running_median(
    values: NDArray[np.floating], size: int, *, ends: Literal["edge", "symmetric", "inside"] = "edge"
) -> Floats:
    """Return the running median; for an even `size`, the upper of the two middle values.

    values: (samples,), without NaN.  size: length of the window in samples.  ends: padding beyond the ends:
    the outermost value, or the mirrored signal; or "inside", the outermost window without any, in which the
    outermost value counts once, if there are as many values.
    """
    if ends == "inside" and len(values) < size:
        ends = "edge"
    before, after = size // 2, (size - 1) // 2
    table = np.asarray(values, np.float64)
    windows = sliding_window_view(table if ends == "inside" else np.pad(table, (before, after), ends), size)
    median = np.empty(len(windows))
    for part in row_parts(len(windows), max(1, 4 * AT_ONCE // size)):
        median[part] = np.partition(windows[part], before, axis=1)[:, before]
    return np.pad(median, (before, after), "edge") if ends == "inside" else median


def running_mean(values: NDArray[np.floating], size: int) -> Floats:
    """Return the running mean of `size` values, with the signal padded by its outermost values."""
    padded = np.pad(np.asarray(values, np.float64), (size // 2 + 1, (size - 1) // 2), "edge")
    level = padded.mean()  # sums of deviations from the mean lose fewer digits
    total = np.cumsum(padded - level)
    return np.asarray(level + (total[size:] - total[:-size]) / size, np.float64)


def mean_over(values: NDArray[np.floating], samples: int) -> Floats:
    """Return the mean of the known values among the `samples` around each, NaN where the value is unknown."""
    known = np.isfinite(values)
    own = np.stack([np.where(known, values, 0.0), known])  # values and their number
    sums = own.copy()
    for k in range(1, samples // 2 + 1):
        sums[:, k:] += own[:, :-k]
        sums[:, :-k] += own[:, k:]
    return np.where(known, sums[0] / np.maximum(sums[1], 1), np.nan)


def minmax_decimate(x: Floats, y: NDArray[np.floating], *, most: int) -> tuple[Floats, Floats]:
    """Return the minimum and maximum of every column in intervals of equally many points, in order of time.

    Unlike an average, this preserves the whole jump of a slip, however short it is.

    x: (points,).  y: (points, columns) or (points,), NaN if not known.  most: largest number of points.
    The result has two points per interval, NaN without values; x and y are unchanged if they are few enough.
    """
    if len(x) <= most:
        return np.asarray(x, np.float64), np.asarray(y, np.float64)
    columns = y.reshape(len(y), -1)
    step = -(-2 * len(x) // most)
    intervals = -(-len(x) // step)
    rows = np.minimum(np.arange(intervals)[:, None] * step + [0, min(step - 1, step // 2)], len(x) - 1)
    extremes = np.empty((2 * intervals, columns.shape[1]))
    for part in row_parts(columns.shape[1], max(1, AT_ONCE // len(x))):  # limits the memory
        extremes[:, part] = _extremes(columns[:, part], step, intervals)
    return np.asarray(x, np.float64)[rows.ravel()], extremes.reshape(-1, *y.shape[1:])


def _extremes(y: NDArray[np.floating], step: int, intervals: int) -> Floats:
    """Return the extremes of each interval of `step` rows, the earlier first, (2 intervals, columns)."""
    padded = np.full((intervals * step, y.shape[1]), np.nan)
    padded[: len(y)] = y
    blocks = padded.reshape(intervals, step, -1)
    unknown = np.isnan(blocks)
    low = np.where(unknown, np.inf, blocks).argmin(axis=1)
    high = np.where(unknown, -np.inf, blocks).argmax(axis=1)
    order = np.sort(np.stack([low, high], axis=1), axis=1)
    return np.take_along_axis(blocks, order, axis=1).reshape(2 * intervals, -1)


class Maxima(NamedTuple):
    """Local maxima from left to right, (K,)."""

    at: Ints  # index; of a plateau that of its middle, rounded down
    # height above a base: the higher of the minima on the two sides, each searched within `reach` and as far
    # as the next higher value
    prominence: Floats


def find_maxima(
    line: NDArray[np.floating], *, least_prominence: float, reach: int, widest: int | None = None
) -> Maxima:
    """Find the maxima of a signal that have at least a given prominence.

    Equivalent to `scipy.signal.find_peaks` with a window of ``2 reach + 1``. The signal is monotonic between
    neighbouring extrema, so only the extrema are searched.

    line: the signal, without NaN.  least_prominence: above 0.  reach: number of samples on either side within
    which the base of a maximum is searched.  widest: plateaus must be shorter than this.
    """
    first, last = _turns(line)
    level = line[last]
    rises = level[1:] > level[:-1]
    top = 1 + np.flatnonzero(rises[:-1] & ~rises[1:])
    dip = np.flatnonzero(np.append(True, ~rises) & np.append(rises, True))  # before and after each maximum
    at = (first[top] + last[top]) // 2
    extrema = _Extrema(line, at, level[top], level[dip], reach)
    candidates = np.flatnonzero(last[top] - first[top] < (len(line) if widest is None else widest))
    left = extrema.lowest(candidates, last[dip], to_right=False)
    high = level[top[candidates]] - left >= least_prominence
    candidates, left = candidates[high], left[high]
    right = extrema.lowest(candidates, first[dip], to_right=True)
    prominence = np.asarray(level[top[candidates]] - np.maximum(left, right), np.float64)
    enough = prominence >= least_prominence
    return Maxima(at[candidates[enough]], prominence[enough])


def half_widths(line: NDArray[np.floating], maxima: Maxima, *, below: float = 0.5) -> Floats:
    """Return the widths of maxima at half their prominence, (K,), as `scipy.signal.peak_widths` does.

    line: the signal in which the maxima were found.  maxima: from `find_maxima`.  below: another share of the
    prominence below the top.
    """
    half = line[maxima.at] - below * maxima.prominence
    with np.errstate(invalid="ignore"):  # the signal may end with -inf
        return _to_half(line, maxima.at, half, -1) + _to_half(line, maxima.at, half, 1)


def _turns(line: NDArray[np.floating]) -> tuple[Ints, Ints]:
    """Return first and last index of each run of equal values at a possible extremum, or at an end.

    Between these runs the signal is monotonic. Since they are few, working on them alone is fast.
    """
    rises, falls = line[1:] > line[:-1], line[1:] < line[:-1]
    turns = (rises[1:] != rises[:-1]) | (falls[1:] != falls[:-1])
    knots = np.concatenate([[0], 1 + np.flatnonzero(turns), [len(line) - 1]])
    value = line[knots]
    changes = np.flatnonzero(value[1:] != value[:-1])
    return knots[np.append(0, changes + 1)], knots[np.append(changes, len(knots) - 1)]


class _Extrema(NamedTuple):
    """A signal with the index and height of its maxima (K,) and the depth of its minima (K + 1,)."""

    line: NDArray[np.floating]
    at: Ints
    height: NDArray[np.floating]
    depth: NDArray[np.floating]
    reach: int

    def lowest(self, maxima: Ints, minima_at: Ints, *, to_right: bool) -> Floats:
        """Return the lowest value on one side of maxima, within reach and up to the next higher value.

        minima_at: indices of the minima, for a plateau the end that faces the maximum.
        """
        step, last = (1 if to_right else -1), len(self.at) - 1
        on, dip = np.arange(len(maxima)), maxima + to_right
        here, height = self.at[maxima], self.height[maxima]
        low = height.astype(np.float64)
        while len(on):
            inside = np.abs(minima_at[dip] - here) <= self.reach
            value = self.depth[dip]
            value[~inside] = self.line[here[~inside] + step * self.reach]
            low[on] = np.minimum(low[on], value)
            beyond = dip if to_right else dip - 1  # the next maximum
            further = inside & (beyond >= 0) & (beyond <= last)
            further &= self.height[np.minimum(np.maximum(beyond, 0), last)] <= height
            on, dip, here, height = on[further], dip[further] + step, here[further], height[further]
        return low


def _to_half(line: NDArray[np.floating], at: Ints, half: Floats, step: int) -> Floats:
    """Return the distance from each maximum to where the signal falls to `half`, on one side."""
    here, on = at.copy(), np.arange(len(at))
    while len(on):
        here[on] += step
        on = on[line[here[on]] > half[on]]
    inner, outer = line[here - step].astype(np.float64), line[here].astype(np.float64)
    return np.asarray(np.abs(here - at) - (half - outer) / (inner - outer), np.float64)


def enforce_distance(at: Ints, height: NDArray[np.floating], least: float) -> Ints:
    """Select maxima that are at least a given distance apart; of closer ones the highest remains.

    at: indices in ascending order.  height: height of each maximum.  least: smallest distance.
    """
    kept, near = np.ones(len(at), np.bool_), np.diff(at) < least
    crowded = np.flatnonzero(np.r_[near, False] | np.r_[False, near])  # only these few need the loop
    for k in crowded[np.argsort(height[crowded], kind="stable")[::-1]]:
        if kept[k]:
            low, high = np.searchsorted(at, [at[k] - least + 1, at[k] + least])
            kept[low:high] = False
            kept[k] = True
    return at[kept]
