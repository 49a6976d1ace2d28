"""What the whole comb does together: camera vibration and drift, told from the sheets' own creep."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vision.deformation.frames import Doubles, Ints
from vision.sheets.medians import nan_median

LEAST_SHEETS = 5
LEAST_PAIRS = 3
_OWN_WAY = 8.0  # typical residuals from the other sheets beyond which one does not move with them
_STILL_PX = 1e-6  # least typical residual, for positions without noise
_UNLIKE = 0.2  # share of their creep by which the sheets of a pair are first taken to differ
_ROUNDS = 4
_NOISY = 9.0  # times the usual variance: such pairs (one slipped by itself) say nothing of asymmetry


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


@dataclass(frozen=True)
class Drift:
    """Common value of one coefficient of the creep in each stick with its error, px, (stick,).

    Both are 0 where fewer than three pairs of sheets are seen: then nothing is known of the camera's drift.
    share: weight with which each sheet's pair went into it, (stick, sheet).
    """

    value: Doubles
    error: Doubles
    share: Doubles

    def error_without(self, error: Doubles) -> Doubles:
        """Errors (stick, sheet) of the coefficients less the drift, of which each sheet is itself a part."""
        return np.asarray(np.sqrt(error**2 * (1 - self.share) + self.error[:, None] ** 2))


def drift(coefficient: Doubles, error: Doubles, side: Ints, n: Ints) -> Drift:
    """Drift of the camera during each stick, from pairs of sheets left and right of the axis.

    Creep is inwards on both sides, so half the sum of a pair is what moved the camera, up to the pair's
    asymmetry: a share of its creep, measured from how the pairs disagree.  Where the sides differ, the
    nearly still inner sheets lead; a difference that all sheets share in equal measure looks like drift.

    Args: coefficient and its error in x to the right, px, (stick, sheet), NaN where unknown; side and n,
    (sheet,).
    """
    left, right = pairs(side, n)
    middle = (coefficient[:, right] + coefficient[:, left]) / 2
    inwards = (coefficient[:, left] - coefficient[:, right]) / 2
    noise = (error[:, right] ** 2 + error[:, left] ** 2) / 4
    known = np.isfinite(middle) & np.isfinite(noise)
    known &= known.sum(axis=1, keepdims=True) >= LEAST_PAIRS
    middle, inwards, noise = (np.where(known, part, 0.0) for part in (middle, inwards, noise))
    asked = known & (noise <= _NOISY * np.median(noise[known])) if known.any() else known
    asymmetry = _UNLIKE
    for _ in range(_ROUNDS):
        weight = known / np.maximum(noise + (asymmetry * inwards) ** 2, 1e-18)
        total = weight.sum(axis=1)
        value = np.divide((weight * middle).sum(axis=1), total, out=np.zeros_like(total), where=total > 0)
        share = np.divide(weight, total[:, None], out=np.zeros_like(weight), where=known)
        apart = (middle - value[:, None]) ** 2 - noise * (1 - share)
        asymmetry = np.sqrt(
            max(float(apart[asked].sum()), 0.0) / max(float((inwards[asked] ** 2).sum()), 1e-18)
        )
    of_sheet = np.zeros_like(coefficient)
    of_sheet[:, left] = of_sheet[:, right] = share
    random = np.divide(1, total, out=np.zeros_like(total), where=total > 0)
    # Sheets numbered one off on one side: then all pairs differ the same way.
    shared = asymmetry * (share * inwards).sum(axis=1)
    return Drift(value, np.sqrt(random + shared**2), of_sheet)


def pairs(side: Ints, n: Ints) -> tuple[Ints, Ints]:
    """Places of the sheets that stand opposite each other: (left, right)."""
    left, right = np.flatnonzero(side < 0), np.flatnonzero(side > 0)
    _, first, second = np.intersect1d(n[left], n[right], return_indices=True)
    return left[first], right[second]
