"""Fewer points for drawings: long records become the minimum and maximum of short intervals."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vision.numeric import Floats, Floats32

_ROWS_AT_ONCE = 64  # of an image, so that memory stays at a few copies of them


def minmax_decimate(x: Floats, y: NDArray[np.floating], *, most: int) -> tuple[Floats, Floats]:
    """Minimum and maximum of every column in intervals of equally many points, in the order of time.

    No average is taken, so a slip keeps its whole jump however short it is.

    x (points,); y (points, columns), NaN where there is nothing; most: largest number of points wanted.
    Returns x and y, two points an interval; unchanged where they are few enough. NaN for an interval
    without values.
    """
    if len(x) <= most:
        return np.asarray(x, np.float64), np.asarray(y, np.float64)
    step = -(-2 * len(x) // most)
    intervals = -(-len(x) // step)
    at = np.minimum(np.arange(intervals)[:, None] * step + [0, min(step - 1, step // 2)], len(x) - 1)
    out = np.empty((2 * intervals, y.shape[1]))
    for start in range(0, y.shape[1], 16):  # so that memory stays at a few copies of some columns
        part = slice(start, start + 16)
        out[:, part] = _extremes(y[:, part], step, intervals)
    return np.asarray(x, np.float64)[at.ravel()], out


def _extremes(y: NDArray[np.floating], step: int, intervals: int) -> Floats:
    """(2 intervals, columns): the extreme that came first, then the other."""
    padded = np.full((intervals * step, y.shape[1]), np.nan)
    padded[: len(y)] = y
    blocks = padded.reshape(intervals, step, -1)
    unknown = np.isnan(blocks)
    low = np.where(unknown, np.inf, blocks).argmin(axis=1)
    high = np.where(unknown, -np.inf, blocks).argmax(axis=1)
    order = np.sort(np.stack([low, high], axis=1), axis=1)
    return np.take_along_axis(blocks, order, axis=1).reshape(2 * intervals, -1)


def minmax_by_x(x: Floats, y: Floats, *, bins: int) -> tuple[Floats, Floats]:
    """Minimum and maximum of y in equal bins of x, whatever the order of the points.

    For curves whose x jitters or stands still, such as a separation that is recorded in steps. Bins without
    points are left out.
    """
    good = np.isfinite(x) & np.isfinite(y)
    x, y = x[good], y[good]
    if len(x) == 0 or x.max() <= x.min():
        return np.empty(0), np.empty(0)
    width = (x.max() - x.min()) / bins
    place = np.minimum((x - x.min()) / width, bins - 1).astype(np.int64)
    order = np.argsort(place, kind="stable")
    found, first = np.unique(place[order], return_index=True)
    low, high = (op.reduceat(y[order], first) for op in (np.minimum, np.maximum))
    centre = x.min() + (found + 0.5) * width
    both = np.stack([low, high], axis=1)
    both[1::2] = both[1::2, ::-1]  # up, then down: no line from bin to bin that the data lack
    return np.repeat(centre, 2) + np.tile([-0.25, 0.25], len(centre)) * width, both.ravel()


def time_rows(values: NDArray[np.floating], time: Floats, *, most: int) -> tuple[Floats32, Floats]:
    """Rows of an image at equal steps of time, each the mean of its frames.

    values: (frames, columns), NaN in lost frames, read in parts.  time: (frames,), rising.  most: largest
    number of rows wanted; fewer where the recording has fewer frame intervals.

    Returns rows (k, columns), and their k + 1 edges in time. A row without a frame between two rows with
    frames, as where the frame times jitter, repeats the one before; in longer gaps rows are NaN.
    """
    steps = np.diff(time)
    step = float(np.median(steps)) if steps.size else 0.0
    span = float(time[-1] - time[0])
    count = min(most, 1 + round(span / step)) if step > 0 else min(most, len(time))
    half = step / 2 or 0.5
    edges = np.linspace(time[0] - half, time[-1] + half, count + 1)
    place = np.searchsorted(time, edges)
    rows = mean_rows(values, place)
    has_frame = np.diff(place) > 0
    lone = np.flatnonzero(~has_frame[1:-1] & has_frame[:-2] & has_frame[2:]) + 1
    rows[lone] = rows[lone - 1]
    return rows, edges


def mean_rows(values: NDArray[np.floating], ends: NDArray[np.integer[Any]]) -> Floats32:
    """Means of the known values between neighbouring ends, (len(ends) - 1, columns); NaN for none.

    The values are read in parts, so that memory does not grow with the recording.
    """
    rows = np.full((len(ends) - 1, values.shape[1]), np.nan, np.float32)
    for start in range(0, len(rows), _ROWS_AT_ONCE):
        part = ends[start : start + _ROWS_AT_ONCE + 1]
        filled = np.flatnonzero(np.diff(part) > 0)
        if filled.size:
            rows[start + filled] = _means(values[part[0] : part[-1]], part[filled] - part[0])
    return rows


def _means(values: NDArray[np.floating], starts: NDArray[np.integer[Any]]) -> Floats:
    """Means of the known values from each start to the next, the last to the end."""
    known = np.isfinite(values)
    if known.all():  # as in most films
        count = np.diff(np.append(starts, len(values)))[:, None]
        return np.asarray(np.add.reduceat(values, starts, axis=0, dtype=np.float64) / count)
    total = np.add.reduceat(np.where(known, values, 0), starts, axis=0, dtype=np.float64)
    count = np.add.reduceat(known, starts, axis=0, dtype=np.int32)
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan))


def grey_limits(*pictures: NDArray[np.floating]) -> tuple[float, float]:
    """Grey levels that are drawn black and white, the same for all pictures (rows, columns).

    All but 0.2 % of the levels at either end: a few dead pixels or reflections would take up the whole scale,
    but ridges, bright or dark, may fill so little of a picture that leaving out 0.5 % flattens them. Some
    hundred rows and columns are looked at. NaN does not count.
    """
    some = [p[:: max(1, p.shape[0] // 500), :: max(1, p.shape[1] // 500)] for p in pictures]
    known = np.concatenate([np.empty(0), *(part[np.isfinite(part)] for part in some)])
    if not known.size:
        return 0.0, 1.0
    low, high = np.percentile(known, (0.2, 99.8))
    return float(low), float(max(high, low + 1e-6))


def grey_levels(values: NDArray[np.floating], low: float, high: float) -> NDArray[np.uint8]:
    """8-bit grey between two levels; unknown values become mid-grey."""
    share = np.subtract(values, low, dtype=np.float32)
    share *= 255 / max(high - low, 1e-9)
    share[np.isnan(share)] = 127.5
    np.clip(share, 0, 255, out=share)  # in place: a seventh of the time
    return np.asarray(np.rint(share, out=share), np.uint8)
