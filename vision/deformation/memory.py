"""How long the noise of the positions remembers, and what that costs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vision.deformation.creep import LEAST_FRAMES, legendre
from vision.deformation.frames import Bools, Doubles, Ints, StickFrames

_LAGS = 8
_RHO = np.r_[0.05:0.9:0.05, 0.92, 0.95]
_LEAST_DOF = 30  # residual degrees of freedom below which no correlation is looked for


@dataclass(frozen=True)
class Memory:
    """Autocorrelation of the noise: 1 at lag 0, share * rho^k at a lag of k frames.

    A share of 1 is an AR(1) process; below 1, white noise lies on top of it; 0 is white.
    """

    share: float
    rho: float

    def at(self, lag: NDArray[np.int64]) -> Doubles:
        """Correlation at each lag, frames."""
        return np.where(lag == 0, 1.0, self.share * self.rho ** np.abs(lag))

    def applied(self, values: Doubles, frames: StickFrames) -> Doubles:
        """The noise's correlation matrix times `values` (F, k), stick by stick; lost frames are respected.

        The sum over all lags is two recursive filters, one forwards and one backwards in time.
        """
        if self.share == 0:
            return values
        from scipy.signal import lfilter

        grid = np.zeros((frames.sticks, int(frames.slot.max(initial=0)) + 1, values.shape[1]))
        np.add.at(grid, (frames.row, frames.slot), values)
        forward, back = (lfilter([1.0], [1.0, -self.rho], g, axis=1) for g in (grid, grid[:, ::-1]))
        both = (forward + back[:, ::-1] - grid)[frames.row, frames.slot]
        return np.asarray(values + self.share * (both - values))


def inflation(memory: Memory, frames: StickFrames, terms: int) -> Doubles:
    """Variance of each coefficient of a fit over what it would be for white noise, (stick, terms).

    1 for white noise.  From all frames of each stick; 1 where they are too few for a fit.
    """
    design = legendre(frames.u, terms)
    good = frames.counts >= LEAST_FRAMES
    gram, spread = (
        frames.sums(design[:, :, None] * other[:, None, :])[good]
        for other in (design, memory.applied(design, frames))
    )
    inverse = np.linalg.inv(gram)
    out = np.ones((frames.sticks, terms))
    out[good] = np.einsum("eab,ebc,eca->ea", inverse, spread, inverse) / np.einsum("eaa->ea", inverse)
    return out


class Products:
    """Products of residuals so many frames apart: which they are, and what to expect of them.

    The fitted curve takes up part of slow noise; the frames' own pattern says how much.  dof: degrees of
    freedom left to a sheet seen in all frames of a stick, (stick,), 0 where there are too few frames.
    """

    def __init__(self, frames: StickFrames, terms: int) -> None:
        self.frames = frames
        count = frames.counts
        self.dof = np.where(count >= LEAST_FRAMES, count - terms, 0).astype(np.int64)
        self.basis = self._orthonormal(terms)
        self.pairs = [self._pairs(lag) for lag in range(_LAGS + 1)]

    def _orthonormal(self, terms: int) -> Doubles:
        """The curves' basis in each stick, (F, terms), 0 in sticks with too few frames."""
        design = legendre(self.frames.u, terms)
        good = self.dof > 0
        gram = self.frames.sums(design[:, :, None] * design[:, None, :])[good]
        turn = np.zeros((good.size, terms, terms))
        turn[good] = np.linalg.inv(np.linalg.cholesky(gram))
        return np.asarray(np.einsum("fab,fb->fa", turn[self.frames.row], design))

    def _pairs(self, lag: int) -> tuple[Ints, Ints]:
        row, slot = self.frames.row, self.frames.slot
        first = np.arange(row.size - lag) if lag < row.size else np.arange(0)
        second = first + lag
        near = (row[first] == row[second]) & (slot[second] - slot[first] == lag)
        return first[near], second[near]

    def expected(self, memory: Memory, weight: Doubles) -> Doubles:
        """Expected sum of products at each lag for noise of one pixel; weight: sheets per stick, (stick,)."""
        at = self._covariance(memory)
        row = self.frames.row
        return np.array([(weight[row[i]] * at(i, j, lag)).sum() for lag, (i, j) in enumerate(self.pairs)])

    def left(self, memory: Memory) -> Doubles:
        """Expected sum of squares left by the curve in each stick for noise of one pixel, (stick,)."""
        every = np.arange(self.frames.row.size)
        return self.frames.sums(self._covariance(memory)(every, every, 0))

    def _covariance(self, memory: Memory) -> Callable[[Ints, Ints, int], Doubles]:
        """Covariance of two residuals: (1 - QQ') R (1 - QQ') with Q the basis and R the noise's."""
        q = self.basis
        rq = memory.applied(q, self.frames)
        inner = self.frames.sums(q[:, :, None] * rq[:, None, :])

        def at(i: Ints, j: Ints, lag: int) -> Doubles:
            twice = np.einsum("fa,fab,fb->f", q[i], inner[self.frames.row[i]], q[j])
            crossed = np.einsum("fa,fa->f", q[i], rq[j]) + np.einsum("fa,fa->f", rq[i], q[j])
            return np.asarray(memory.at(np.array(lag)) - crossed + twice)

        return at


def find_memory(residual: Doubles, cells: Bools, products: Products) -> Memory:
    """The correlation whose expected residual products match the measured ones best, up to 8 frames apart.

    White noise, AR(1), or AR(1) under white noise: a more general one only where it fits better than chance.
    Args: residual (F, sheet) in units of each sheet's noise.  cells: (stick, sheet) used.
    """
    weight = cells.sum(axis=1).astype(float)
    row = products.frames.row
    used = np.where(cells[row], residual, 0.0)
    if weight @ products.dof < _LEAST_DOF or not used.any():
        return Memory(0.0, 0.0)
    count = np.array([weight[row[i]].sum() for i, _ in products.pairs])
    lags = count > 0
    measured = np.array([np.sum(used[i] * used[j]) for i, j in products.pairs])[lags]
    per_error = 1 / (np.sqrt(count[lags]) * measured[0] / count[0])
    white = products.expected(Memory(0.0, 0.0), weight)[lags] * per_error
    best = _misfit([white], measured * per_error)[1], Memory(0.0, 0.0)
    for rho in _RHO:
        slow = products.expected(Memory(1.0, float(rho)), weight)[lags] * per_error
        for columns, price in (([slow], 4.0), ([slow, white], 9.0)):
            part, misfit = _misfit(columns, measured * per_error)
            if part[0] > 0 and misfit + price < best[0]:
                best = misfit + price, Memory(float(part[0] / part.sum()), float(rho))
    return best[1]


def _misfit(columns: list[Doubles], measured: Doubles) -> tuple[Doubles, float]:
    """Non-negative shares of the columns that make up `measured`, and the squares left."""
    from scipy.optimize import nnls

    part, rest = nnls(np.stack(columns, axis=1), measured)
    return part, float(rest**2)
