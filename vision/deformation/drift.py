"""The camera's steady movement in each stick, told from the sheets' own creep by pairs left and right."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vision.deformation.frames import Bools, Doubles, Ints

LEAST_PAIRS = 3
_UNLIKE = 0.2  # share of their creep by which the sheets of a pair are first taken to differ
_ROUNDS = 4
_NOISY = 9.0  # times the usual variance: such pairs (one slipped by itself) say nothing of asymmetry
_TELLING = 25.0  # times the noise's variance by which sheets must creep unlike, to tell sides from drift
_LIKELY = np.array([0.2, 0.5])  # share by which one side creeps more, sheets by which it is numbered off


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
    asymmetry: a share of its creep, measured from how the pairs disagree, and what one side does more than
    the other in all sticks, which is taken off.  Where the sides differ, the nearly still inner sheets lead;
    a difference that all sheets share in equal measure looks like drift.

    Args: coefficient and its error in x to the right, px, (stick, sheet), NaN where unknown; side and n,
    (sheet,).
    """
    left, right = pairs(side, n)
    pair = _pairs(coefficient[:, left], coefficient[:, right], error[:, left], error[:, right])
    sides, asymmetry = _Sides.of(pair), _UNLIKE
    for _ in range(_ROUNDS):
        weight = pair.known / np.maximum(pair.noise + (asymmetry * pair.inwards) ** 2, 1e-18)
        total = weight.sum(axis=1, keepdims=True)
        share = np.divide(weight, total, out=np.zeros_like(weight), where=pair.known)
        more, doubt = sides.fitted(pair, share, weight)
        value = (share * (pair.middle - more)).sum(axis=1)
        asymmetry = pair.asymmetry(value[:, None] + more, share)
    of_sheet = np.zeros_like(coefficient)
    of_sheet[:, left] = of_sheet[:, right] = share
    random = np.divide(1, total, out=np.zeros_like(total), where=total > 0)[:, 0]
    return Drift(value, np.sqrt(random + doubt**2), of_sheet)


def pairs(side: Ints, n: Ints) -> tuple[Ints, Ints]:
    """Places of the sheets that stand opposite each other: (left, right)."""
    left, right = np.flatnonzero(side < 0), np.flatnonzero(side > 0)
    _, first, second = np.intersect1d(n[left], n[right], return_indices=True)
    return left[first], right[second]


@dataclass(frozen=True)
class _Pairs:
    """Half the sum and half the difference of each pair, with their variance, px, 0 where not known; quiet
    pairs are asked how they differ.  All (stick, pair)."""

    middle: Doubles
    inwards: Doubles
    noise: Doubles
    known: Bools
    quiet: Bools

    def asymmetry(self, expected: Doubles, share: Doubles) -> float:
        """Share of their creep by which the sheets of a pair differ, beyond what is expected."""
        apart = (self.middle - expected) ** 2 - self.noise * (1 - share)
        creep = float((self.inwards[self.quiet] ** 2).sum())
        return float(np.sqrt(max(float(apart[self.quiet].sum()), 0.0) / max(creep, 1e-18)))


def _pairs(left: Doubles, right: Doubles, left_err: Doubles, right_err: Doubles) -> _Pairs:
    middle, inwards, noise = (right + left) / 2, (left - right) / 2, (right_err**2 + left_err**2) / 4
    known = np.isfinite(middle) & np.isfinite(noise)
    known &= known.sum(axis=1, keepdims=True) >= LEAST_PAIRS
    quiet = known & (noise <= _NOISY * np.median(noise[known])) if known.any() else known
    middle, inwards, noise = (np.where(known, part, 0.0) for part in (middle, inwards, noise))
    return _Pairs(middle, inwards, noise, known, quiet)


@dataclass(frozen=True)
class _Sides:
    """How pairs stand apart, px, (2, pair), if one side creeps by as much again as the other, and if it is
    numbered one off (a sheet was overlooked).  0 where sheets creep too much alike to tell from drift."""

    ways: Doubles

    @classmethod
    def of(cls, pair: _Pairs) -> _Sides:
        """From the mean creep of the quiet pairs."""
        count = np.maximum(pair.quiet.sum(axis=0), 1)
        mean, noise = ((pair.quiet * part).sum(axis=0) / count for part in (pair.inwards, pair.noise))
        if mean.size < LEAST_PAIRS or np.var(mean) <= _TELLING * noise.mean():
            return cls(np.zeros((2, mean.size)))
        return cls(np.stack([mean, np.gradient(mean)]))

    def fitted(self, pair: _Pairs, share: Doubles, weight: Doubles) -> tuple[Doubles, Doubles]:
        """What the sides' difference adds to the pairs' middles, px, (pair,), and the error that it leaves in
        the drift, (stick,)."""
        about = share @ self.ways.T
        shape = self.ways[:, None] - about.T[..., None]
        away = pair.middle - (share * pair.middle).sum(axis=1, keepdims=True)
        weight = weight * pair.quiet
        matrix = np.einsum("aep,ep,bep->ab", shape, weight, shape) + np.diag(_LIKELY**-2)
        covariance = np.linalg.inv(matrix)
        size = covariance @ np.einsum("aep,ep,ep->a", shape, weight, away)
        return size @ self.ways, np.sqrt(np.einsum("ea,ab,eb->e", about, covariance, about))
