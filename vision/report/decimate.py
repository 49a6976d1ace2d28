"""Fewer points for the eye: long records become the lowest and highest of short stretches."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]

_COLUMNS_AT_ONCE = 16  # so that memory stays at a few copies of some columns
_ROWS_AT_ONCE = 64  # of an image, likewise


def outline(x: Doubles, y: NDArray[np.floating], *, most: int) -> tuple[Doubles, Doubles]:
    """Lowest and highest of every column in equal stretches, in the order in which they came.

    A slip, however short, spans its whole jump still: no average is taken.

    Args: x (points,); y (points, columns), NaN where there is nothing.  most: points wanted at most.
    Returns: x and y, two points a stretch; unchanged where they are few enough already. NaN for a stretch
    without any value.
    """
    if len(x) <= most:
        return np.asarray(x, np.float64), np.asarray(y, np.float64)
    step = -(-2 * len(x) // most)
    stretches = -(-len(x) // step)
    at = np.minimum(np.arange(stretches)[:, None] * step + [0, min(step - 1, step // 2)], len(x) - 1)
    out = np.empty((2 * stretches, y.shape[1]))
    for start in range(0, y.shape[1], _COLUMNS_AT_ONCE):
        part = slice(start, start + _COLUMNS_AT_ONCE)
        out[:, part] = _extremes(y[:, part], step, stretches)
    return np.asarray(x, np.float64)[at.ravel()], out


def _extremes(y: NDArray[np.floating], step: int, stretches: int) -> Doubles:
    """(2 stretches, columns): the extreme that came first, then the other."""
    padded = np.full((stretches * step, y.shape[1]), np.nan)
    padded[: len(y)] = y
    blocks = padded.reshape(stretches, step, -1)
    unknown = np.isnan(blocks)
    low = np.where(unknown, np.inf, blocks).argmin(axis=1)
    high = np.where(unknown, -np.inf, blocks).argmax(axis=1)
    order = np.sort(np.stack([low, high], axis=1), axis=1)
    return np.take_along_axis(blocks, order, axis=1).reshape(2 * stretches, -1)


def outline_by_x(x: Doubles, y: Doubles, *, bins: int) -> tuple[Doubles, Doubles]:
    """Lowest and highest y in equal bins of x, whatever the order of the points; empty bins are left out.

    For curves whose x jitters or stands still (a separation written in steps).
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
    both[1::2] = both[1::2, ::-1]  # up, then down: no stroke from bin to bin that the data do not have
    return np.repeat(centre, 2) + np.tile([-0.25, 0.25], len(centre)) * width, both.ravel()


def time_rows(
    values: NDArray[np.floating], time: Doubles, *, most: int
) -> tuple[NDArray[np.float32], Doubles]:
    """Rows of an image at even steps of time, each the mean of its frames.

    A row between two frames of an uneven clock takes the row before it.

    Args: values (frames, columns), NaN rows for lost frames, read in parts; time (frames,), rising.
    Returns: rows (k, columns), NaN where no frame lies; the k + 1 edges in time.
    """
    count = min(most, len(time))
    half = 0.5 * (time[-1] - time[0]) / max(1, count - 1) or 0.5
    edges = np.linspace(time[0] - half, time[-1] + half, count + 1)
    place = np.searchsorted(time, edges)
    rows = mean_rows(values, place)
    has_frame = np.diff(place) > 0
    lone = np.flatnonzero(~has_frame[1:] & has_frame[:-1]) + 1
    rows[lone] = rows[lone - 1]
    return rows, edges


def mean_rows(values: NDArray[np.floating], ends: NDArray[np.integer[Any]]) -> NDArray[np.float32]:
    """Means of the known values between neighbouring ends, (len(ends) - 1, columns); NaN for none.

    values are read in parts, so that memory does not grow with the recording.
    """
    rows = np.full((len(ends) - 1, values.shape[1]), np.nan, np.float32)
    for start in range(0, len(rows), _ROWS_AT_ONCE):
        part = ends[start : start + _ROWS_AT_ONCE + 1]
        filled = np.flatnonzero(np.diff(part) > 0)
        if filled.size:
            rows[start + filled] = _means(values[part[0] : part[-1]], part[filled] - part[0])
    return rows


def _means(values: NDArray[np.floating], starts: NDArray[np.integer[Any]]) -> NDArray[np.float64]:
    """Means of the known values from each start to the next, the last to the end."""
    known = np.isfinite(values)
    total = np.add.reduceat(np.where(known, values, 0), starts, axis=0, dtype=np.float64)
    count = np.add.reduceat(known, starts, axis=0, dtype=np.int32)
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan))


def grey_levels(values: NDArray[np.floating], low: float, high: float) -> NDArray[np.uint8]:
    """8-bit grey between two levels; what is unknown becomes mid-grey."""
    share = (np.nan_to_num(values, nan=(low + high) / 2) - low) / max(high - low, 1e-9)
    return np.asarray(np.clip(np.rint(255 * share), 0, 255), np.uint8)
