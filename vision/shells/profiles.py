"""Rising profiles: the ways in which σ_x/Λ_st may depend on n."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]
Singles = NDArray[np.float32]  # likelihoods of thousands of curves need speed, not digits

_FOOT = np.geomspace(0.6, 30, 7)  # sheets from where the rise sets in to the boundary
_BEND = (0.6, 1.4, 4.0)  # exponent of the rise: concave, nearly straight, steeper and steeper
_FLOOR = (0.0, 0.3, 0.7)  # ratio of the innermost sheets, in thresholds
_CEILING = (1.5, 2.5, 5.0, 1e4)  # ratio at which the rise ends, in thresholds
_MOST = 30.0  # thresholds; the sheets do not move more than this
_INSIDE, _OUTSIDE = 3.0, 6.0  # sheets beyond the innermost and outermost where a boundary may lie
_THINNING = 5  # divides no number of feet, bends, floors or ceilings, so that all kinds remain
_MOST_PLACES = 120  # of the boundary; half a sheet apart where sheets are not very many


@dataclass(frozen=True)
class Profiles:
    """Curves that never fall with n, ratio (curve, sheet), ordered by how many sheets are below threshold.

    half_square: half the ratio's square.
    """

    ratio: Singles
    half_square: Singles

    @classmethod
    def crossing(cls, n: Doubles, threshold: float) -> Profiles:
        """Curves at n (sheet,), from the centre outwards, that cross the threshold t at a place b.

        t (c + (C - c) h/(1 + h)) with h ∝ max(1 + (n - b)/a, 0)^q: nothing moves up to b - a, then a power
        law, levelling off towards a ceiling.  Power laws through the centre (a = b, c = 0), flat cores with
        a straight rise (q = 1), steps (small a, low ceiling) and sigmoids are among them or near.  All b,
        from inside the innermost to beyond the outermost sheet, are equally frequent.
        """
        apart = max(0.5, (n[-1] - n[0]) / _MOST_PLACES)
        place = np.arange(n[0] - _INSIDE, n[-1] + _OUTSIDE, apart) + apart / 2
        every = np.meshgrid(place, _FOOT, _BEND, _FLOOR, _CEILING, indexing="ij")
        b, foot, bend, floor, ceiling = (part.reshape(-1, 1) for part in every)
        rise = (1 - floor) / (ceiling - 1) * np.maximum(1 + (n - b) / foot, 0) ** bend
        ratio = threshold * np.minimum(floor + (ceiling - floor) * rise / (1 + rise), _MOST)
        ratio = ratio[np.argsort((ratio < threshold).sum(axis=1), kind="stable")]
        return cls(ratio.astype(np.float32), (ratio**2 / 2).astype(np.float32))

    def thinned(self) -> Profiles:
        """A fifth of the curves, of all kinds, for what needs no fine resolution."""
        return Profiles(self.ratio[::_THINNING].copy(), self.half_square[::_THINNING].copy())
