"""Medians of tables with gaps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]


def nan_median(values: NDArray[np.floating], axis: int = 0) -> Doubles:
    """Median along an axis of what is not NaN; NaN, without a warning, where nothing is left."""
    ordered = np.sort(np.asarray(values, np.float64), axis=axis)  # NaN comes last
    count = np.expand_dims(np.isfinite(ordered).sum(axis=axis), axis)
    if ordered.shape[axis] == 0:
        return np.full(count.squeeze(axis).shape, np.nan)
    low, high = np.maximum(count - 1, 0) // 2, count // 2
    high = np.minimum(high, np.maximum(count - 1, 0))
    pair = np.take_along_axis(ordered, low, axis) + np.take_along_axis(ordered, high, axis)
    return np.asarray(np.where(count > 0, pair / 2, np.nan).squeeze(axis), np.float64)
