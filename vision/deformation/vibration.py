"""The camera's vibration: what the whole comb does together in each frame."""

from __future__ import annotations

import numpy as np

from vision.deformation.frames import Doubles
from vision.sheets.medians import nan_median

LEAST_SHEETS = 5
_OWN_WAY = 8.0  # typical residuals from the other sheets beyond which one does not move with them
_STILL_PX = 1e-6  # least typical residual, for positions without noise


def shaking(residual: Doubles) -> Doubles:
    """Common movement in each frame that is no creep, px, (F,): the weighted mean residual of all sheets.

    Residuals are to each sheet's own creep, so creep is not in it, however unlike the sides are. Weights
    are the inverse of each sheet's residual variance; a sheet that goes its own way in a frame is left out.
    0 in frames with fewer than five sheets, which would lose too much of their own noise.
    """
    spread, weight = _spread_and_weight(residual)
    with np.errstate(invalid="ignore"):
        away = np.abs(residual - nan_median(residual, axis=1)[:, None])
        known = (away <= _OWN_WAY * spread) & (weight > 0)
    enough = known.sum(axis=1) >= LEAST_SHEETS
    total = (known * weight).sum(axis=1)
    moved = np.where(known, residual, 0.0) @ weight
    return np.asarray(np.divide(moved, total, out=np.zeros_like(total), where=enough))


def noise_regained(residual: Doubles) -> Doubles:
    """Factor on each sheet's noise variance for the part that went with the common movement, (sheet,)."""
    _, weight = _spread_and_weight(residual)
    if (weight > 0).sum() < LEAST_SHEETS:
        return np.ones(weight.size)
    return np.asarray(1 / (1 - np.minimum(weight / weight.sum(), 0.5)))


def _spread_and_weight(residual: Doubles) -> tuple[Doubles, Doubles]:
    """Typical residual of each sheet, px, and 1 over its square, (sheet,); the weight is 0 where unknown."""
    spread = nan_median(np.abs(residual))
    usual = nan_median(spread[None], axis=1)[0]
    spread = np.maximum(spread, 0.1 * usual if usual > 0 else _STILL_PX)
    return spread, np.where(np.isfinite(spread), spread**-2, 0.0)
