"""The creep of every sheet in every stick as a short Legendre series, fitted to all at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vision.deformation.frames import Bools, Doubles, Ints, StickFrames

LEAST_FRAMES = 4
LEAST_COVER = 0.4  # of the stick: below it the rest would be guessed, not measured


@dataclass(frozen=True)
class Creep:
    """x(u) = sum of coefficient_k P_k(u), u from -1 at t_v to +1 at t_p.

    coefficient: (stick, sheet, K).  inverse: inverse of the normal matrix, (stick, sheet, K, K): the
    coefficients' covariance for white noise of one pixel.  count: positions used, (stick, sheet).  good:
    whether they allow a fit; where not, the rest is NaN.
    """

    coefficient: Doubles
    inverse: Doubles
    count: Ints
    good: Bools

    def at(self, frames: StickFrames) -> Doubles:
        """The fitted positions in every frame, (F, sheet)."""
        design = legendre(frames.u, self.coefficient.shape[2])
        return np.asarray(np.einsum("fk,fsk->fs", design, self.coefficient[frames.row]))


def legendre(u: Doubles, terms: int) -> Doubles:
    """P_0, P_1, ... at u, (size of u, terms): orthogonal over the stick, so P_0's coefficient is its mean."""
    return np.asarray(np.polynomial.legendre.legvander(u, terms - 1))


def fit_creep(x_px: Doubles, frames: StickFrames, *, terms: int) -> Creep:
    """Least squares over the frames of each stick; NaN positions are left out.

    Args: x_px (F, sheet).  terms: 2 is a line, 3 a parabola.
    Good are sticks with four positions or more that span at least two fifths of them.
    """
    known = np.isfinite(x_px)
    count = frames.sums(known).astype(np.int64)
    good = (count >= LEAST_FRAMES) & (_span(known, frames) >= LEAST_COVER)
    design = legendre(frames.u, terms)
    value = np.where(known, x_px, 0.0)
    matrix = np.stack(
        [
            frames.sums(known * (design[:, a] * design[:, b])[:, None])
            for a in range(terms)
            for b in range(terms)
        ],
        axis=-1,
    ).reshape(*good.shape, terms, terms)
    right = np.stack([frames.sums(value * design[:, [k]]) for k in range(terms)], axis=-1)
    inverse = np.full_like(matrix, np.nan)
    inverse[good] = np.linalg.inv(matrix[good])
    return Creep(np.einsum("esab,esb->esa", inverse, right), inverse, count, good)


def mean_square(x_px: Doubles, frames: StickFrames) -> Doubles:
    """Mean of (x - mean x)² over the frames of each stick as they are, (stick, sheet), px²; NaN without
    frames."""
    known = np.isfinite(x_px)
    count = frames.sums(known)
    count[count == 0] = np.nan
    mean = frames.sums(np.where(known, x_px, 0.0)) / count
    away = np.where(known, x_px - mean[frames.row], 0.0)
    return frames.sums(away**2) / count


def _span(known: Bools, frames: StickFrames) -> Doubles:
    """Share of each stick between its first and last known position, (stick, sheet)."""
    u = np.broadcast_to(frames.u[:, None], known.shape)
    low, high = frames.lowest(np.where(known, u, np.inf)), -frames.lowest(np.where(known, -u, np.inf))
    return np.asarray((high - low) / 2)
