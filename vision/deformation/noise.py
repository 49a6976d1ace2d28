"""Noise of the positions, its autocorrelation, and the standard errors of the creep that follow from it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import matmul_toeplitz
from scipy.optimize import nnls
from scipy.special import chdtri, gammaincinv, spherical_jn

from vision.deformation.creep import LEAST_FRAMES, Creep, StickFrames, legendre
from vision.deformation.settings import DeformationSettings
from vision.numeric import Bools, Floats, Ints, nan_median

_RHO = np.r_[0.05:0.9:0.05, 0.92, 0.95]  # AR(1) coefficients that are tried
_LEAST_DOF = 30  # residual degrees of freedom below which no correlation is looked for
_LEAST_VARIANCE_PX2 = 1e-12  # of positions without noise, whose residuals are rounding

# --- autocorrelation ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class AR1Noise:
    r"""Noise with autocorrelation 1 at lag 0 and :math:`s \rho^k` at a lag of k frames.

    Parameters
    ----------
    share
        s: 1 for an AR(1) process; below 1, white noise lies on top of it; 0 for white noise.
    rho
        AR(1) coefficient.
    """

    share: float
    rho: float

    def at(self, lag: int) -> float:
        """Correlation at one lag, frames."""
        return 1.0 if lag == 0 else self.share * self.rho**lag

    def correlate(self, values: Floats, frames: StickFrames) -> Floats:
        """Correlation matrix of the noise times `values` (F, k), stick by stick; lost frames are
        respected."""
        if self.share == 0:
            return values
        slots = int(frames.slot.max(initial=0)) + 1
        grid = np.zeros((slots, frames.sticks, values.shape[1]))
        np.add.at(grid, (frames.slot, frames.row), values)
        slow = matmul_toeplitz(self.rho ** np.arange(slots), grid.reshape(slots, -1)).reshape(grid.shape)
        return np.asarray(values + self.share * (slow[frames.slot, frames.row] - values))


WHITE = AR1Noise(0.0, 0.0)


def variance_inflation(noise: AR1Noise, frames: StickFrames, terms: int) -> Floats:
    r"""Variance of each coefficient of a fit over what it would be for white noise.

    Parameters
    ----------
    noise, frames, terms
        Noise with correlation R; the frames of each stick, all of which are taken to be used; terms of the
        fit.

    Returns
    -------
    (stick, term); 1 for white noise, and in sticks with too few frames for a fit.

    Notes
    -----
    .. math:: [(A^T A)^{-1} A^T R A (A^T A)^{-1}]_{kk} / [(A^T A)^{-1}]_{kk}

    with the Legendre polynomials at the frames in the columns of A.
    """
    design = legendre(frames.u, terms)
    good = frames.counts >= LEAST_FRAMES
    gram, spread = (
        frames.sums(design[:, :, None] * other[:, None, :])[good]
        for other in (design, noise.correlate(design, frames))
    )
    inverse = np.linalg.inv(gram)
    out = np.ones((frames.sticks, terms))
    out[good] = np.einsum("eab,ebc,eca->ea", inverse, spread, inverse) / np.einsum("eaa->ea", inverse)
    return out


class _ResidualProducts:
    """Products of residuals k frames apart, and their expectation for noise of 1 px.

    The fitted curve takes up part of slow noise; how much follows from the frames' own pattern.
    """

    def __init__(self, frames: StickFrames, terms: int, lags: int) -> None:
        self.frames = frames
        count = frames.counts
        self.dof = np.where(count >= LEAST_FRAMES, count - terms, 0).astype(np.int64)  # (stick,)
        self.basis = self._orthonormal(terms)
        self.pairs = [self._pairs(lag) for lag in range(lags + 1)]

    def _orthonormal(self, terms: int) -> Floats:
        """Basis of the curves in each stick, (F, terms), 0 in sticks with too few frames."""
        design = legendre(self.frames.u, terms)
        good = self.dof > 0
        gram = self.frames.sums(design[:, :, None] * design[:, None, :])[good]
        turn = np.zeros((good.size, terms, terms))
        turn[good] = np.linalg.inv(np.linalg.cholesky(gram))
        return np.asarray(np.einsum("fab,fb->fa", turn[self.frames.row], design))

    def _pairs(self, lag: int) -> tuple[Ints, Ints]:
        """Frames of one stick that are `lag` intervals apart."""
        row, slot = self.frames.row, self.frames.slot
        first = np.arange(max(row.size - lag, 0))
        second = first + lag
        near = (row[first] == row[second]) & (slot[second] - slot[first] == lag)
        return first[near], second[near]

    def expected(self, noise: AR1Noise, weight: Floats) -> Floats:
        """Sum of the products at each lag, with `weight` (stick,) sheets in each stick."""
        covariance, row = self._covariance(noise), self.frames.row
        sums = [(weight[row[i]] * covariance(i, j, lag)).sum() for lag, (i, j) in enumerate(self.pairs)]
        return np.array(sums)

    def squares(self, noise: AR1Noise) -> Floats:
        """Sum of squares that the curve leaves in each stick, (stick,)."""
        every = np.arange(self.frames.row.size)
        return self.frames.sums(self._covariance(noise)(every, every, 0))

    def _covariance(self, noise: AR1Noise) -> Callable[[Ints, Ints, int], Floats]:
        """Covariance of two residuals: (1 - QQ') R (1 - QQ') with Q the basis and R the noise's
        correlation."""
        q = self.basis
        rq = noise.correlate(q, self.frames)
        inner = self.frames.sums(q[:, :, None] * rq[:, None, :])

        def at(i: Ints, j: Ints, lag: int) -> Floats:
            twice = np.einsum("fa,fab,fb->f", q[i], inner[self.frames.row[i]], q[j])
            crossed = np.einsum("fa,fa->f", q[i], rq[j]) + np.einsum("fa,fa->f", rq[i], q[j])
            return np.asarray(noise.at(lag) - crossed + twice)

        return at


def _fit_correlation(residual: Floats, cells: Bools, products: _ResidualProducts) -> AR1Noise:
    """The correlation whose expected residual products match the measured ones best.

    White noise, AR(1), or AR(1) under white noise: a more general one only where it fits better than chance.
    residual (F, sheet) is in units of each sheet's noise; cells (stick, sheet) are used.
    """
    weight = cells.sum(axis=1).astype(float)
    row = products.frames.row
    used = np.where(cells[row], residual, 0.0)
    if weight @ products.dof < _LEAST_DOF or not used.any():
        return WHITE
    count = np.array([weight[row[i]].sum() for i, _ in products.pairs])
    lags = count > 0
    measured = np.array([np.sum(used[i] * used[j]) for i, j in products.pairs])[lags]
    per_error = 1 / (np.sqrt(count[lags]) * measured[0] / count[0])
    white = products.expected(WHITE, weight)[lags] * per_error
    best = nnls(white[:, None], measured * per_error)[1] ** 2, WHITE
    for rho in _RHO:
        slow = products.expected(AR1Noise(1.0, float(rho)), weight)[lags] * per_error
        for columns, penalty in (([slow], 4.0), ([slow, white], 9.0)):  # chi-square of one and two parameters
            part, misfit = nnls(np.stack(columns, axis=1), measured * per_error)
            if part[0] > 0 and misfit**2 + penalty < best[0]:
                best = misfit**2 + penalty, AR1Noise(float(part[0] / part.sum()), float(rho))
    return best[1]


# --- size ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Noise:
    """Noise of all sheets.

    Parameters
    ----------
    noise_px
        Standard deviation of single positions of each sheet, (sheet,).
    correlation
        From frame to frame, the same for all sheets.
    excess
        Factor, 1 or more, by which the residuals of a stick exceed the sheet's noise beyond chance,
        (stick, sheet).
    """

    noise_px: Floats
    correlation: AR1Noise
    excess: Floats


def measure_noise(
    residual: Floats, creep: Creep, frames: StickFrames, predicted_px: Floats, settings: DeformationSettings
) -> Noise:
    """Noise of every sheet and its autocorrelation, from the residuals to a parabola or cubic in each stick.

    Parameters
    ----------
    residual
        Positions less `creep`, px, (F, sheet); NaN where there is no position.
    creep, frames
        The curves, and the frames to which they were fitted.
    predicted_px
        Standard errors of the positions as the subpixel fit states them, px, (sheet,); NaN where unknown.
    settings
        Weight of the prediction, and when residuals are uneven.

    Notes
    -----
    What a curve leaves of correlated noise is computed from the frames' own pattern, so that short sticks do
    not make the noise look white.  Sticks with uneven residuals (a sheet that slipped by itself) do not
    count.
    """
    terms = creep.coefficient.shape[2]
    square = frames.sums(np.where(np.isfinite(residual), residual, 0.0) ** 2)
    dof = np.where(creep.good, creep.count - terms, 0)
    typical = _typical_variance(square, dof)
    usual = (dof > 0) & ~_uneven(square, dof, typical, settings)
    products = _ResidualProducts(frames, terms, settings.correlation_lags)
    complete = usual & (dof == products.dof[:, None])
    correlation = _fit_correlation(residual / np.sqrt(typical), complete, products)
    expected = dof * (products.squares(correlation) / np.maximum(products.dof, 1))[:, None]
    variance = _variance(square * usual, expected * usual, dof * usual, predicted_px, settings)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(dof > 0, square / expected / variance, 1.0)
    uneven = _uneven(ratio * dof, dof, np.ones(variance.size), settings)
    return Noise(np.sqrt(variance), correlation, np.where(uneven, np.sqrt(np.maximum(ratio, 1)), 1.0))


def _typical_variance(square: Floats, dof: Ints) -> Floats:
    """Median noise variance per sheet, as if it were white, (sheet,); the sheets' median for the rest."""
    median = 2 * gammaincinv(np.maximum(dof, 1) / 2, 0.5)  # of chi-square
    each = nan_median(np.where(dof > 0, square / median, np.nan))
    overall = float(nan_median(each[None], axis=1)[0])
    return np.maximum(np.where(np.isfinite(each), each, np.nan_to_num(overall)), _LEAST_VARIANCE_PX2)


def _uneven(square: Floats, dof: Ints, variance: Floats, settings: DeformationSettings) -> Bools:
    """Residuals larger than chance allows, with half the degrees of freedom: correlated noise scatters
    more."""
    fewer = np.maximum(dof / 2, 1)
    limit = chdtri(fewer, settings.uneven_probability)
    return np.asarray(square / variance * fewer / np.maximum(dof, 1) > limit)


def _variance(
    square: Floats, expected: Floats, dof: Ints, predicted_px: Floats, settings: DeformationSettings
) -> Floats:
    """Noise variance per sheet: of its residuals, averaged with the predicted one times the common ratio."""
    measured, per_unit, weight = square.sum(axis=0), expected.sum(axis=0), dof.sum(axis=0)
    predicted = predicted_px**2
    middle = float(nan_median(predicted[None], axis=1)[0])
    shape = np.where(np.isfinite(predicted), predicted, middle if middle > 0 else 1.0)
    prior = shape * measured.sum() / max(float((per_unit * shape).sum()), 1e-300)
    with np.errstate(divide="ignore", invalid="ignore"):
        own = np.where(per_unit > 0, measured / per_unit, prior)
    both = (weight * own + settings.predicted_dof * prior) / (weight + settings.predicted_dof)
    return np.asarray(np.maximum(both, _LEAST_VARIANCE_PX2))


# --- fixed-pattern error ------------------------------------------------------------------------------------

_WAVES_PER_PX = np.arange(0.01, 0.5, 0.01)
_WINDOW_PX = np.arange(5)  # half of the standard fit window, which weighs pixels by their distance
_POWER = (np.sin(2 * np.pi * _WAVES_PER_PX[:, None] * _WINDOW_PX) @ _WINDOW_PX) ** 2


def fixed_pattern_gain(reach_px: Floats, terms: int) -> Floats:
    r"""RMS share of a fixed pattern of 1 px in each coefficient of the creep.

    Parameters
    ----------
    reach_px
        Half the distance that the sheet creeps, any shape.
    terms
        Of the creep.

    Returns
    -------
    The shape of `reach_px` and (terms,).

    Notes
    -----
    A wave of f per px has the share :math:`(2 l + 1) j_l(2 \pi f r)` in :math:`P_l` (spherical Bessel
    functions); waves are weighted by the transfer function of the subpixel fit.
    """
    reach = np.nan_to_num(np.abs(reach_px))
    grid = np.linspace(0, float(reach.max(initial=0.0)) + 1e-9, 200)
    order, phase = np.arange(terms)[:, None, None], 2 * np.pi * _WAVES_PER_PX[:, None] * grid
    square = _POWER @ spherical_jn(order, phase) ** 2 / _POWER.sum()
    return np.stack([(2 * k + 1) * np.interp(reach, grid, np.sqrt(square[k])) for k in range(terms)], axis=-1)


def fixed_pattern_px(creep: Creep, error: Floats, noise: Noise, settings: DeformationSettings) -> Floats:
    """RMS error of position that repeats wherever a sheet passes: unequal pixels, dust.

    Such errors do not average out over the frames of a stick, and a straight line hides them.  Their size
    follows from bends that a sheet shows again in every stick.

    Parameters
    ----------
    creep
        Of three terms or more.
    error
        Of its coefficients from noise alone, px, (stick, sheet, term).
    noise
        Of the positions.
    settings
        Size taken where too little is seen.

    Returns
    -------
    px, (sheet,).

    Notes
    -----
    Bends that all sheets share are no pattern: camera movement, and creep that slows down.
    """
    used = (creep.good & (noise.excess <= 1))[..., None]
    everything = creep.coefficient, error, fixed_pattern_gain(creep.coefficient[..., 1], error.shape[2])
    coefficient, error, expected = (np.where(used, values, 0.0) for values in everything)
    unit_px = noise.noise_px[:, None]
    own = _own(coefficient[..., 2:], coefficient[..., 1:2], used)
    seen, size = _repeated(own / unit_px), _repeated(expected[..., 2:])
    chance = ((error[..., 2:] / unit_px) ** 2).sum(axis=0)
    usual = settings.fixed_pattern**2
    common = _posterior(seen.sum(), size.sum(), ((chance + usual * size) ** 2).sum(), usual, 0.6 * usual)
    scatter = ((chance + common * size) ** 2).sum(axis=1)
    each = _posterior(seen.sum(axis=1), size.sum(axis=1), scatter, common, common)
    return np.asarray(np.sqrt(each) * noise.noise_px)


def _own(bend: Floats, slope: Floats, used: Bools) -> Floats:
    """Bends (stick, sheet, ...) less what all sheets of a stick share: a constant, a share of the slope."""
    count = np.maximum(used.sum(axis=1, keepdims=True), 1)
    bend, slope = (np.where(used, v - v.sum(axis=1, keepdims=True) / count, 0.0) for v in (bend, slope))
    square = np.maximum((slope**2).sum(axis=1, keepdims=True), 1e-12)
    return np.asarray(bend - slope * (bend * slope).sum(axis=1, keepdims=True) / square)


def _repeated(value: Floats) -> Floats:
    """Sums of products between different sticks of each sheet, (sheet, ...): what does not repeat cancels."""
    return np.asarray(value.sum(axis=0) ** 2 - (value**2).sum(axis=0))


def _posterior(
    seen: Floats, size: Floats, scatter: Floats, prior: Floats | float, prior_err: Floats | float
) -> Floats:
    """Square of the pattern from the ratio seen/size and its prior, each weighted by its variance; half the
    variance of `seen` is `scatter`.  Not below 0; the prior where its error is 0."""
    weight = size / np.maximum(2 * scatter, 1e-300) * np.square(prior_err)
    return np.asarray(np.maximum(seen * weight + prior, 0.0) / (size * weight + 1))


# --- standard errors ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ErrorModel:
    """What the errors of the creep are made of.

    Parameters
    ----------
    noise, frames
        Noise of the positions, and the frames in which they lie.
    pattern_px
        Fixed-pattern error of each sheet, (sheet,).
    scale
        Relative error of the magnification.
    """

    noise: Noise
    frames: StickFrames
    pattern_px: Floats
    scale: float = 0.0

    def of(self, fit: Creep) -> Floats:
        """Standard errors of the coefficients, px, (stick, sheet, term)."""
        terms = fit.coefficient.shape[2]
        white = np.einsum("eskk->esk", fit.inverse)
        factor = variance_inflation(self.noise.correlation, self.frames, terms)[:, None]
        random = np.sqrt(white * factor) * (self.noise.noise_px * self.noise.excess)[..., None]
        reach = fit.coefficient[..., 1]
        pattern = fixed_pattern_gain(reach, terms) * self.pattern_px[:, None]
        return np.asarray(np.sqrt(random**2 + pattern**2 + (self.scale * reach[..., None]) ** 2))
