"""Reduce long records and images for drawings, without losing minima and maxima."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vision.mapped import give_back, some_rows
from vision.numeric import Floats, Floats32, column_parts

_ROWS_AT_ONCE = 64  # of an image, so that memory stays at a few copies of them


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
    for part in column_parts(columns):  # limits the memory
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


def time_rows(values: NDArray[np.floating], time: Floats, *, most: int) -> tuple[Floats32, Floats]:
    """Return rows of an image at equal steps of time, each the mean of its frames.

    values: (frames, columns), NaN in lost frames, read in parts.  time: (frames,), rising.  most: largest
    number of rows; there are no more than frames in the recording's duration.

    Returns the rows (k, columns) and their k + 1 edges in time. A single row without a frame, as frame times
    may jitter, repeats the row before; rows in longer gaps are NaN.
    """
    steps = np.diff(time)
    step = float(np.median(steps)) if steps.size else 0.0
    span = float(time[-1] - time[0])
    count = min(most, 1 + round(span / step)) if step > 0 else min(most, len(time))
    half = step / 2 or 0.5
    edges = np.linspace(time[0] - half, time[-1] + half, count + 1)
    ends = np.searchsorted(time, edges)
    has_frame = np.diff(ends) > 0
    rows = np.full((count, values.shape[1]), np.nan, np.float32)
    for start in range(0, count, _ROWS_AT_ONCE):
        part = ends[start : start + _ROWS_AT_ONCE + 1]
        filled = np.flatnonzero(np.diff(part) > 0)
        if filled.size:
            rows[start + filled] = _means(values[part[0] : part[-1]], part[filled] - part[0])
            give_back(values[part[0] : part[-1]])
    single = np.flatnonzero(~has_frame[1:-1] & has_frame[:-2] & has_frame[2:]) + 1
    rows[single] = rows[single - 1]
    return rows, edges


def _means(values: NDArray[np.floating], starts: NDArray[np.integer[Any]]) -> Floats:
    """Return means of the known values from each start to the next start or the end."""
    known = np.isfinite(values)
    if known.all():  # as in most films
        count = np.diff(np.append(starts, len(values)))[:, None]
        return np.asarray(np.add.reduceat(values, starts, axis=0, dtype=np.float64) / count)
    total = np.add.reduceat(np.where(known, values, 0), starts, axis=0, dtype=np.float64)
    count = np.add.reduceat(known, starts, axis=0, dtype=np.int32)
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan))


def grey_limits(*pictures: NDArray[np.floating]) -> tuple[float, float]:
    """Return the grey levels that are drawn black and white in every picture (rows, columns).

    These are the quantiles at 0.2 and 99.8 %. The extremes would be those of a few dead pixels or
    reflections; with 0.5 and 99.5 % narrow ridges, bright or dark, would be cut off. About 500 rows and
    columns are used; NaN is ignored.
    """
    steps = [[max(1, size // 500) for size in picture.shape] for picture in pictures]
    samples = [
        some_rows(picture, np.arange(0, len(picture), down))[:, ::across]
        for picture, (down, across) in zip(pictures, steps, strict=True)
    ]
    known = np.concatenate([np.empty(0), *(part[np.isfinite(part)] for part in samples)])
    if not known.size:
        return 0.0, 1.0
    low, high = np.percentile(known, (0.2, 99.8))
    return float(low), float(max(high, low + 1e-6))


def grey_levels(values: NDArray[np.floating], low: float, high: float) -> NDArray[np.uint8]:
    """Convert values to 8-bit grey, black at `low` and white at `high`; NaN becomes mid-grey."""
    grey = np.subtract(values, low, dtype=np.float32)
    grey *= 255 / max(high - low, 1e-9)
    grey[np.isnan(grey)] = 127.5
    np.clip(grey, 0, 255, out=grey)  # in place, in a seventh of the time
    return np.asarray(np.rint(grey, out=grey), np.uint8)


def label_step(x: Any, width: float) -> int:
    """Return 1, 2, 5, 10, 20, …: labels of this width fit at every so many-th point."""
    pitch = float(np.median(np.abs(np.diff(x)))) if len(x) > 1 else width
    least = width / max(pitch, 1e-9)
    steps = np.outer(10 ** np.arange(6), [1, 2, 5]).ravel()
    return int(steps[min(int(np.searchsorted(steps, least)), steps.size - 1)])
