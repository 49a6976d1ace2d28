"""Array types and robust statistics that every stage uses."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vision.memory import give_back, in_two_threads, row_parts

if TYPE_CHECKING:
    import pandas as pd

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Ints = NDArray[np.int64]
Ints32 = NDArray[np.int32]
Bools = NDArray[np.bool_]
Strings = NDArray[np.str_]
Codes = NDArray[np.uint8]  # members of an IntEnum
Pixels = NDArray[Any]  # grey levels as the file stores them: unsigned integers or float32

FWHM = float(np.sqrt(8 * np.log(2)))
"""Full width at half maximum of a Gaussian, in its standard deviations."""
NORMAL_MEDIAN = 0.6744897501960817
"""Median of the absolute value of a standard normal variable. The median absolute deviation (MAD) divided by
it estimates the standard deviation."""
AT_ONCE = 1 << 16
"""Values of which medians are taken at once: a copy of more takes memory, and is not in a core's cache."""
TYPICAL_ROWS = 4096
"""Frames of which typical values are found (`typical_median`). More take longer; the median of so many
differs from that of all by 2 % of their scatter, and their median size by as much of itself."""


@dataclass(frozen=True)
class Rows:
    """A dataclass of arrays that have the same first axis."""

    def take(self, rows: slice | Ints | Bools) -> Self:
        """Return the selected rows of all arrays."""
        return replace(self, **{name: values[rows] for name, values in vars(self).items()})


def mad_sigma(values: NDArray[np.floating], axis: int | None = None) -> Any:
    """Estimate the standard deviation of normal values from their median absolute deviation.

    values: without NaN.  axis: None for all values, which gives a float.
    """
    middle = np.median(values, axis=axis, keepdims=True)
    return np.median(np.abs(values - middle), axis=axis) / NORMAL_MEDIAN


def white_noise(values: Floats) -> float:
    """Estimate the standard deviation of white noise on a smooth curve of three values or more.

    In second differences the curve cancels; the median absolute one does not depend on a few jumps.
    """
    return float(mad_sigma(np.diff(values, 2)) / np.sqrt(6.0))


def quantum(y: Floats) -> float:
    """Return the smallest step between the values that occur, but for rounding errors; 0 for one value."""
    steps = np.diff(np.unique(y))
    return float(np.min(steps, where=steps > 1e-6 * np.ptp(y), initial=np.inf)) if steps.size else 0.0


def two_digits(value: float) -> str:
    """Return a number with two significant digits, from 1e-4 to 1e6 without a power of ten: 170."""
    return f"{float(f'{value:.2g}'):g}"


def with_minus(text: str) -> str:
    """Return text of numbers with minus signs instead of hyphens."""
    return text.replace("-", "−")


def number(value: Any) -> float:
    """Return text or another value as a number, NaN if it is none."""
    try:
        return float(value)
    except (TypeError, ValueError):
        return np.nan


DATE = r"[0-9]{1,4}[-./][0-9]{1,2}[-./][0-9]{1,4}"
CLOCK = r"(?:[0-9]{1,2}:)?[0-9]{1,2}:[0-9]{2}(?:[.,][0-9]*)?(?: ?[AaPp][Mm])?Z?"
"""Pattern of a time of the day, with AM or PM or without hours ("52:17.1")."""
CLOCK_PARTS = re.compile(r"(?:(\d+):)?(\d+):(\d+(?:[.,]\d*)?)(?: ?([AaPp])[Mm])?Z?$")


def clock_seconds(parts: pd.DataFrame) -> Floats:
    """Return seconds from the groups of CLOCK_PARTS, times of the day, continued past midnight.

    A decrease by half a day or more is the next day. The date, which has many forms, is ignored.
    """
    hour, minute, second = (parts[k].str.replace(",", ".").to_numpy(float) for k in range(3))
    half = parts[3].str.lower()
    hour = np.where(half.notna(), hour % 12 + 12.0 * (half == "p"), hour)
    period = 3600.0 if np.isnan(hour).all() else 86400.0
    seconds = 3600 * np.nan_to_num(hour) + 60 * minute + second
    known = np.isfinite(seconds)
    seconds[known] = np.unwrap(seconds[known], period=period)
    return np.asarray(seconds, np.float64)


def rms(values: Floats) -> float:
    """Return the root mean square of the finite values; NaN without any."""
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if known.size else np.nan


def correlation_inflation(residual: Floats, most: float) -> float:
    r"""Return :math:`(1 + \rho)/(1 - \rho)`, by which AR(1) noise enlarges the variance of a mean or slope.

    :math:`\rho` is the correlation of neighbouring residuals, from 0 to `most`, which few residuals exceed by
    chance.
    """
    squares = float(residual @ residual)
    rho = float(residual[1:] @ residual[:-1]) / squares if squares > 0 else 0.0
    rho = min(max(rho, 0.0), most)
    return (1 + rho) / (1 - rho)


def nan_median(values: NDArray[np.floating], axis: int = 0) -> Floats:
    """Return the median along an axis, ignoring NaN; NaN, without a warning, if all values are NaN."""
    return _of_lanes(_median, values, axis)


def sigma_about_zero(values: NDArray[np.floating], axis: int = 0) -> Floats:
    """Estimate the standard deviation of normal values about 0 from their median size, ignoring NaN."""
    return nan_median(np.abs(values), axis) / NORMAL_MEDIAN


def nan_quantile(values: NDArray[np.floating], fraction: float, axis: int = 0) -> Floats:
    """Return a quantile along an axis, ignoring NaN, interpolated linearly; NaN if all values are NaN."""
    return _of_lanes(partial(_quantile, fraction), values, axis)


def typical(values: NDArray[np.floating]) -> float:
    """Return the median of all values of (rows,) or (rows, columns) in `typical_rows`, ignoring NaN."""
    rows, found = typical_rows(len(values)), []
    for column in np.atleast_2d(values.T):  # one at a time is in memory, of a table in a file
        found.append(column[rows])
        give_back(column)
    return float(nan_median(np.array(found).ravel()))


def typical_median(values: NDArray[np.floating]) -> Floats:
    """Return the median of each column of (rows, columns) over `typical_rows`, ignoring NaN."""
    return typical_medians(lambda rows: values[rows], len(values))


def typical_size(values: NDArray[np.floating], middle: Floats | float = 0.0) -> Floats:
    """Return the median distance of each column of (rows, columns) from its `middle`, (columns,), over
    `typical_rows`, ignoring NaN."""
    return typical_medians(lambda rows: np.abs(values[rows] - middle), len(values))


def typical_where(known: Bools, values: NDArray[np.floating]) -> Floats:
    """Return the median of each column of (rows, columns) over `typical_rows`, where it is known."""
    return typical_medians(lambda rows: np.where(known[rows], values[rows], np.nan), len(values))


def typical_medians(made: Callable[[Ints | slice], NDArray[np.floating]], rows: int) -> Floats:
    """Return the median over `typical_rows` of each column of a table that is made row by row.

    made: returns the rows with these indices.  rows: number of all rows. All count for columns that are
    mostly NaN in `typical_rows`: a sheet may be seen in few frames.
    """
    some = made(typical_rows(rows))
    medians = nan_median(some)
    rare = np.isfinite(some).sum(axis=0) < TYPICAL_ROWS // 8
    if rows > TYPICAL_ROWS and rare.any():
        medians[rare] = nan_median(made(slice(None))[:, rare])
    return medians


def typical_rows(rows: int) -> Ints | slice:
    """Return all rows, or `TYPICAL_ROWS` of more: one in each of as many equal parts, at a random place in
    it, so that what repeats itself is met in all its phases. They are the same ones at each call."""
    if rows <= TYPICAL_ROWS:
        return slice(None)
    edge = np.arange(TYPICAL_ROWS + 1) * rows // TYPICAL_ROWS
    return np.random.default_rng(0).integers(edge[:-1], edge[1:])


def median_step(values: NDArray[np.floating]) -> Floats:
    """Return the median step of all columns from each row to the next, (rows − 1,), a part at a time."""

    def of_part(rows: slice) -> Floats:
        near = values[rows.start : rows.stop + 1].astype(np.float64)
        return nan_median(np.diff(near, axis=0), axis=1)

    return _of_rows(of_part, len(values) - 1)


def common_change(values: NDArray[np.floating], usual: Floats) -> Floats:
    """Return the median difference of each row from the usual values (columns,), a part at a time."""
    return _of_rows(lambda rows: nan_median(values[rows] - usual, axis=1), len(values))


def _of_rows(work: Callable[[slice], Floats], rows: int) -> Floats:
    """Return the results of `work` for all parts of the rows, one after the other."""
    return np.concatenate([np.empty(0), *in_two_threads(work, row_parts(rows))])


def without_common_change(values: NDArray[np.floating]) -> Floats:
    """Return values (frame, N) less the change that all columns share (vibration, flicker, focus)."""
    return np.asarray(values - common_change(values, typical_median(values))[:, None], np.float64)


def centred(values: Floats, known: Bools, axis: int = 0) -> Floats:
    """Return values less the mean of the known ones along an axis, and 0 where they are not known."""
    kept, count = np.where(known, values, 0.0), np.maximum(known.sum(axis=axis, keepdims=True), 1)
    return np.where(known, kept - kept.sum(axis=axis, keepdims=True) / count, 0.0)


def weighted_median(values: Floats, weights: Floats) -> float:
    """Return the value up to which the weights add up to half of their sum; (values,), NaN where not known.

    All values are counted in the intervals between some of them, and only those of the interval in the middle
    are sorted.
    """
    some = values[:: max(1, len(values) // 2048)]  # more intervals take longer to count in, fewer to sort
    edges = np.sort(some[np.isfinite(some)])[1:-1]
    sums = np.zeros(len(edges) + 1)
    for part in row_parts(len(values)):
        interval = np.searchsorted(edges, values[part], side="right")
        sums += np.bincount(interval, weights[part], len(sums))
    total = np.cumsum(sums)
    half = total[-1] / 2
    middle = int(np.searchsorted(total, half))
    low, high = np.r_[-np.inf, edges, np.inf][[middle, middle + 1]]
    near = np.flatnonzero((values >= low) & (values < high))
    near = near[np.argsort(values[near], kind="stable")]
    up_to = total[middle] - sums[middle] + np.cumsum(weights[near])
    return float(values[near[min(int(np.searchsorted(up_to, half)), len(near) - 1)]])


def _of_lanes(statistic: Callable[[Floats], Floats], values: NDArray[np.floating], axis: int) -> Floats:
    """Return a statistic of values along an axis, of a part at a time, as each is copied and sorted."""
    if np.ndim(values) == 1:  # most often, and then moving the axis takes as long as the median
        return statistic(np.array(values, np.float64))
    values = np.moveaxis(np.asarray(values), axis, -1)
    if values.size <= AT_ONCE:
        return statistic(np.array(values, np.float64, order="C"))
    each = values[0].size
    if each > AT_ONCE and values.ndim > 2:
        return np.stack([_of_lanes(statistic, part, -1) for part in values])
    rows = max(1, AT_ONCE // each)

    def of_part(some: slice) -> Floats:
        return statistic(np.array(values[some], np.float64, order="C"))

    return np.concatenate(in_two_threads(of_part, row_parts(len(values), rows)))


def _median(lanes: Floats) -> Floats:
    """Return the median of each lane along the last axis, ignoring NaN; the lanes are reordered in place."""
    below, above, _ = _beside_quantile(0.5, lanes)
    return np.asarray(below + above, np.float64) / 2


def _quantile(fraction: float, lanes: Floats) -> Floats:
    """Return a quantile of each lane along the last axis, ignoring NaN; the lanes are reordered in place."""
    below, above, share = _beside_quantile(fraction, lanes)
    return np.asarray(below + (above - below) * share, np.float64)


def _beside_quantile(fraction: float, lanes: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the values of each lane between which a quantile lies, and its place between them, 0 to 1."""
    size = lanes.shape[-1]
    if not 0 < size < 1000:
        return _selected(fraction, lanes)
    lanes.sort(axis=-1)  # NaN comes last
    low, high, share = _places(fraction, np.asarray(size))
    below, above = (np.array(lanes[..., int(at)]) for at in (low, high))
    shares = np.full(below.shape, share)
    partly = ~np.isfinite(lanes[..., -1])
    if partly.any():
        some = lanes[partly]
        low, high, shares[partly] = _places(fraction, np.isfinite(some).sum(axis=-1))
        below[partly], above[partly] = (np.take_along_axis(some, at[:, None], 1)[:, 0] for at in (low, high))
    return below, above, shares


def _selected(fraction: float, lanes: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the same for long lanes, in which selecting a value is faster than sorting all."""
    count = np.isfinite(lanes).sum(axis=-1)
    low, high, share = _places(fraction, count)
    below, above = (np.full(count.shape, np.nan) for _ in range(2))
    for k in np.ndindex(count.shape):
        if count[k]:
            lane, upper = lanes[k], int(high[k])
            lane.partition(upper)
            above[k] = lane[upper]
            below[k] = lane[upper] if low[k] == upper else lane[:upper].max()
    return below, above, share


def _places(fraction: float, count: Ints) -> tuple[Ints, Ints, Floats]:
    """Return the indices of the values beside a quantile of `count` values, and its place between them."""
    index = fraction * np.maximum(count - 1, 0)
    low, high = np.floor(index).astype(np.int64), np.ceil(index).astype(np.int64)
    return low, high, index - low


def spread_indices(count: int, most: int) -> Ints:
    """Return the indices of up to `most` of `count` values, evenly spread from the first to the last."""
    return np.unique(np.linspace(0, count - 1, most).astype(np.int64))


def flat_ranges(start: Ints, stop: Ints) -> tuple[Ints, Ints]:
    """Return (row, index): for every integer of many half-open ranges its range's number, and itself."""
    count = np.maximum(stop - start, 0)
    row = np.repeat(np.arange(start.size), count)
    index = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count) + np.repeat(start, count)
    return row, index


def peak_offset(before: ArrayLike, at: ArrayLike, after: ArrayLike) -> Floats:
    """Return how far the maximum of a parabola through three equally spaced values lies after the middle one.

    It is in units of their distance: within ±0.5 if the middle one is the largest. 0 without a maximum.
    """
    before, at, after = (np.asarray(values, np.float64) for values in (before, at, after))
    bend = before - 2 * at + after
    return np.where(bend < 0, 0.5 * (before - after) / np.where(bend < 0, bend, -1.0), 0.0)


def nearest(candidates: NDArray[np.floating], at: NDArray[np.floating]) -> tuple[Ints, Floats]:
    """Find the candidate nearest to `at` (rows,) in each row of `candidates` (rows, K), ignoring NaN.

    Returns its index and its distance, (rows,); the distance is inf if all candidates of a row are NaN.
    """
    distance = np.abs(candidates - at[:, None])
    distance = np.where(np.isfinite(distance), distance, np.inf)
    best = np.argmin(distance, axis=1)
    return best, distance[np.arange(len(best)), best]


def nearest_sorted(values: Floats, wanted: Floats) -> Ints:
    """Return the index of the value nearest to each wanted one. Values are ascending, and at least two."""
    right = np.clip(np.searchsorted(values, wanted), 1, len(values) - 1)
    closer = wanted - values[right - 1] < values[right] - wanted
    return np.asarray(np.where(closer, right - 1, right))


def shifted(values: NDArray[Any], by: int) -> NDArray[Any]:
    """Shift values (rows, columns) to the left by `by` columns; columns that become free are NaN."""
    moved = np.full_like(values, np.nan)
    if 0 <= by < values.shape[1]:
        moved[:, : values.shape[1] - by] = values[:, by:]
    elif 0 < -by < values.shape[1]:
        moved[:, -by:] = values[:, :by]
    return moved


def beside(marked: Bools) -> Bools:
    """Return which entries of (frame, sheet) are next to a marked one of the same frame."""
    padded = np.pad(marked, ((0, 0), (1, 1)))
    return np.asarray(padded[:, :-2] | padded[:, 2:], bool)


def stretches(marked: Bools) -> tuple[Ints, Ints, Ints]:
    """Return the unbroken stretches of True in each column of (frame, sheet): sheet, first row, end row."""
    some = np.flatnonzero(marked.any(axis=0))  # often few columns have any
    edge = np.diff(np.pad(marked[:, some].astype(np.int8), ((1, 1), (0, 0))), axis=0)
    column, first = np.nonzero((edge == 1).T)
    _, stop = np.nonzero((edge == -1).T)
    return some[column], first, stop
