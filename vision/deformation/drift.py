"""The camera's steady movement in each stick, told from the sheets' own creep by pairs left and right."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vision.deformation.frames import Bools, Doubles, Ints
from vision.sheets.medians import nan_median

LEAST_PAIRS = 3
_GAP = 0.6  # pitches by which a gap must be too wide for a sheet to be missing in it
_AXIS_OFF = (-2, -1, 1, 2)  # sheets by which left and right are numbered unlike
_MUCH_LESS = 0.5
_UNLIKE = 0.2  # share of their creep by which the sheets of a pair are first taken to differ
_ROUNDS = 4
_NOISY = 9.0  # times the usual variance: such pairs (one slipped by itself) say nothing of asymmetry
TELLING = 25.0  # times the noise's variance by which sheets must creep unlike, to tell sides from drift


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


@dataclass(frozen=True)
class BothSides:
    """Places of the sheets that stand opposite each other."""

    left: Ints
    right: Ints
    movement = "vibration and drift taken off"

    @classmethod
    def of(cls, side: Ints, n: Ints, middle_px: Doubles, slope_px: Doubles) -> BothSides:
        """By their numbers, in which overlooked sheets are counted, for they leave a gap; and by their creep,
        where the axis turns out to be elsewhere.

        side, n: (sheet,), in order of place.  middle_px, slope_px: (stick, sheet).
        """
        left, right = np.flatnonzero(side < 0), np.flatnonzero(side > 0)
        n = n + np.where(side < 0, _missing(middle_px, left[::-1]), _missing(middle_px, right))
        found = []
        for off in (0, *_AXIS_OFF):
            _, first, second = np.intersect1d(n[left] + off, n[right], return_indices=True)
            found.append(cls(left[first], right[second]))
        unlike = np.array([each.unlike_px(slope_px) for each in found])
        return found[np.argmin(unlike) if unlike.min() < _MUCH_LESS * unlike[0] else 0]

    def unlike_px(self, slope_px: Doubles) -> float:
        """By how much pairs differ in all sticks alike; infinite without enough of them."""
        if not self.enough:
            return np.inf
        middle = slope_px[:, self.left] + slope_px[:, self.right]
        away = nan_median(middle - nan_median(middle, axis=1)[:, None])
        return float(np.nan_to_num(np.abs(away)).mean())

    @property
    def enough(self) -> bool:
        """Whether there are pairs enough to tell drift from creep."""
        return self.left.size >= LEAST_PAIRS

    def drift(self, coefficient: Doubles, error: Doubles, **_: bool) -> Drift:
        """Drift of the camera during each stick.

        Creep is inwards on both sides, so half the sum of a pair is what moved the camera, up to the pair's
        asymmetry: a share of its creep, larger the nearer the axis, as where a sheet was overlooked on one
        side.  How large, is measured from how the pairs disagree.  Where the sides differ, the nearly still
        inner sheets lead; a difference that all sheets share in equal measure looks like drift.

        Args: coefficient and its error in x to the right, px, (stick, sheet), NaN where unknown.
        """
        left, right = coefficient[:, self.left], coefficient[:, self.right]
        noise = (error[:, self.left] ** 2 + error[:, self.right] ** 2) / 4
        pair = _Pairs.of(left, right, noise)
        unlike = _UNLIKE
        for _round in range(_ROUNDS):
            weight = pair.known / np.maximum(pair.noise + (unlike * pair.step) ** 2, 1e-18)
            total = weight.sum(axis=1)
            share = np.divide(weight, total[:, None], out=np.zeros_like(weight), where=pair.known)
            value = (share * pair.middle).sum(axis=1)
            unlike = pair.unlike(value, share)
        of_sheet = np.zeros_like(coefficient)
        of_sheet[:, self.left] = of_sheet[:, self.right] = share
        random = np.divide(1, total, out=np.zeros_like(total), where=total > 0)
        together = pair.together(value, weight) * (share * pair.step).sum(axis=1)
        return Drift(value, np.sqrt(random + together**2), of_sheet)


@dataclass(frozen=True)
class _Pairs:
    """Half the sum of each pair, its variance, and the step of the creep from one sheet to the next, px, 0
    where not known; quiet pairs are asked how they differ.  All (stick, pair)."""

    middle: Doubles
    step: Doubles
    noise: Doubles
    known: Bools
    quiet: Bools

    @classmethod
    def of(cls, left: Doubles, right: Doubles, noise: Doubles) -> _Pairs:
        """left, right: coefficients."""
        middle, step = (right + left) / 2, (left - right) / 2
        known = np.isfinite(middle) & np.isfinite(noise)
        known &= known.sum(axis=1, keepdims=True) >= LEAST_PAIRS
        quiet = known & (noise <= _NOISY * np.median(noise[known])) if known.any() else known
        middle, step, noise = (np.where(known, part, 0.0) for part in (middle, step, noise))
        return cls(middle, step, noise, known, quiet)

    def unlike(self, value: Doubles, share: Doubles) -> float:
        """How many steps pairs differ by, beyond noise."""
        apart = (self.middle - value[:, None]) ** 2 - self.noise * (1 - share)
        steps = max(float((self.step[self.quiet] ** 2).sum()), 1e-18)
        return float(np.sqrt(max(float(apart[self.quiet].sum()), 0.0) / steps))

    def together(self, value: Doubles, weight: Doubles) -> float:
        """How many steps all pairs differ by in the same way."""
        weight = weight * self.quiet
        steps = max(float((weight * self.step**2).sum()), 1e-18)
        return float((weight * self.step * (self.middle - value[:, None])).sum()) / steps


def _missing(middle_px: Doubles, outwards: Ints) -> Ints:
    """Sheets missing between the innermost and each of those sheets, as (sheet,), 0 for others."""
    out = np.zeros(middle_px.shape[1], np.int64)
    gap = np.abs(np.diff(nan_median(middle_px)[outwards]))
    if np.isfinite(gap).any():
        pitch = float(nan_median(gap))
        missing = np.maximum(np.floor(np.nan_to_num(gap / pitch) - _GAP), 0)
        out[outwards[1:]] = np.cumsum(missing)
    return out
