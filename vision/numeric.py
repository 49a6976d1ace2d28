"""Array types and robust statistics that every stage uses."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Strings = NDArray[np.str_]
Codes = NDArray[np.uint8]  # members of an IntEnum
Pixels = NDArray[Any]  # grey levels as the file stores them: unsigned integers or float32

FWHM = float(np.sqrt(8 * np.log(2)))
"""Full width at half maximum of a Gaussian, in its standard deviations."""
NORMAL_MEDIAN = 0.6744897501960817
"""Median of the absolute value of a standard normal variable. The median absolute deviation (MAD) divided by
it estimates the standard deviation."""


def mad_sigma(values: NDArray[np.floating], axis: int | None = None) -> Any:
    """Estimate the standard deviation of normal values from their median absolute deviation.

    Parameters
    ----------
    values
        Any shape, without NaN.
    axis
        Axis along which the deviation is computed; None for all values.

    Returns
    -------
    A float for ``axis=None``, else an array without that axis.
    """
    middle = np.median(values, axis=axis, keepdims=True)
    return np.median(np.abs(values - middle), axis=axis) / NORMAL_MEDIAN


def white_noise(values: Floats) -> float:
    """Estimate the standard deviation of white noise on a smooth curve of three values or more.

    In second differences the curve cancels; the median absolute one does not depend on a few jumps.
    """
    return float(mad_sigma(np.diff(values, 2)) / np.sqrt(6.0))


def two_digits(value: float) -> str:
    """Return a number with two significant digits, from 1e-4 to 1e6 without a power of ten: 170."""
    return f"{float(f'{value:.2g}'):g}"


def rms(values: Floats) -> float:
    """Return the root mean square of the finite values; NaN without any."""
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if known.size else np.nan


def nan_median(values: NDArray[np.floating], axis: int = 0) -> Floats:
    """Return the median along an axis, ignoring NaN; NaN, without a warning, if all values are NaN."""
    lanes = np.array(np.moveaxis(np.asarray(values), axis, -1), np.float64, order="C")
    size = lanes.shape[-1]
    if size == 0:
        return np.full(lanes.shape[:-1], np.nan)
    if size < 1000:
        lanes.sort(axis=-1)  # NaN comes last
        if _complete(lanes):
            return np.asarray(lanes[..., (size - 1) // 2] + lanes[..., size // 2]) / 2
    count = np.isfinite(lanes).sum(axis=-1)
    last = np.maximum(count - 1, 0)
    low, high = last // 2, np.minimum(count // 2, last)
    if size < 1000:
        pair = _in_lanes(lanes, low) + _in_lanes(lanes, high)
    else:  # selecting the upper of the two middle values is faster than sorting all
        pair = np.empty(count.shape)
        for k in np.ndindex(count.shape):
            lane, middle = lanes[k], int(high[k])
            lane.partition(middle)
            pair[k] = lane[middle] + (lane[middle] if low[k] == middle else lane[:middle].max())
    return np.where(count > 0, pair / 2, np.nan)


def nan_quantile(values: NDArray[np.floating], fraction: float, axis: int = 0) -> Floats:
    """Return a quantile along an axis, ignoring NaN, interpolated linearly; NaN if all values are NaN."""
    ordered = np.array(np.moveaxis(np.asarray(values), axis, -1), np.float64, order="C")
    ordered.sort(axis=-1)  # NaN comes last
    size = ordered.shape[-1]
    if size == 0:
        return np.full(ordered.shape[:-1], np.nan)
    if _complete(ordered):
        place = fraction * (size - 1)
        below, above = ordered[..., int(place)], ordered[..., min(int(place) + 1, size - 1)]
        return np.asarray(below + (above - below) * (place - int(place)), np.float64)
    count = np.isfinite(ordered).sum(axis=-1)
    index = fraction * np.maximum(count - 1, 0)
    low = np.floor(index).astype(np.int64)
    high = np.minimum(low + 1, np.maximum(count - 1, 0))
    below, above = _in_lanes(ordered, low), _in_lanes(ordered, high)
    return np.where(count > 0, below + (above - below) * (index - low), np.nan)


def _complete(ordered: Floats) -> bool:
    """Return whether all values of ordered lanes are finite."""
    return bool(np.isfinite(ordered[..., [0, -1]]).all())


def _in_lanes(lanes: Floats, index: Ints) -> Floats:
    """Return the value at one index of each lane along the last axis."""
    return np.take_along_axis(lanes, index[..., None], axis=-1)[..., 0]


def spread_indices(count: int, most: int) -> Ints:
    """Return the indices of up to `most` of `count` values, evenly spread from the first to the last."""
    return np.unique(np.linspace(0, count - 1, most).astype(np.int64))


def nearest(candidates: NDArray[np.floating], at: NDArray[np.floating]) -> tuple[Ints, Floats]:
    """Find the candidate nearest to `at` (rows,) in each row of `candidates` (rows, K), ignoring NaN.

    Returns its index and its distance, (rows,); the distance is inf if all candidates of a row are NaN.
    """
    distance = np.abs(candidates - at[:, None])
    distance = np.where(np.isfinite(distance), distance, np.inf)
    best = np.argmin(distance, axis=1)
    return best, distance[np.arange(len(best)), best]


def shifted(values: NDArray[Any], by: int) -> NDArray[Any]:
    """Shift values (rows, columns) to the left by `by` columns; columns that become free are NaN."""
    moved = np.full_like(values, np.nan)
    if 0 <= by < values.shape[1]:
        moved[:, : values.shape[1] - by] = values[:, by:]
    elif 0 < -by < values.shape[1]:
        moved[:, -by:] = values[:, :by]
    return moved


def stretches(marked: Bools) -> tuple[Ints, Ints, Ints]:
    """Return the unbroken stretches of True in each column of (frame, sheet): sheet, first row, end row."""
    edge = np.diff(np.pad(marked.astype(np.int8), ((1, 1), (0, 0))), axis=0)
    sheet, first = np.nonzero((edge == 1).T)
    _, stop = np.nonzero((edge == -1).T)
    return sheet, first, stop
