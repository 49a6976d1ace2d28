"""Noise of the positions, its autocorrelation, and the standard errors of the creep that follow from it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy

from vision.deformation.creep import AR1Noise, Creep, StickFrames, fit_creep
from vision.deformation.settings import DeformationSettings
from vision.numeric import Bools, Floats, Ints, nan_median
from vision.sheets import TrackingSettings

_LEAST_VARIANCE_PX2 = 1e-12  # of positions without noise, whose residuals are rounding

# --- size and autocorrelation -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Noise:
    """Noise of all sheets."""

    noise_px: Floats  # standard deviation of single positions of each sheet, (sheet,)
    correlation: AR1Noise  # from frame to frame, the same for all sheets
    excess: Floats  # factor, 1 or more, by which a stick's residuals exceed that noise, (stick, sheet)


def measure_noise(
    x_px: Floats, frames: StickFrames, terms: int, predicted_px: Floats, settings: DeformationSettings
) -> Noise:
    """Noise of every sheet and its autocorrelation, from the residuals to a parabola or cubic in each stick.

    x_px: positions without vibration, (F, sheet), NaN where there is none.  predicted_px: their standard
    errors as the subpixel fit states them, (sheet,), NaN where unknown.  Sticks with uneven residuals (a
    sheet that slipped by itself) do not count towards the noise.
    """
    white = fit_creep(x_px, frames, terms, settings)
    usual = (white.dof > 0) & ~_uneven(white.square, white.dof, _typical_variance(white), settings)
    correlation = _fit_correlation(x_px, frames, terms, usual, settings)
    creep = fit_creep(x_px, frames, terms, settings, correlation)
    variance = _variance(np.where(usual, creep.square, 0.0), creep.dof * usual, predicted_px, settings)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(creep.dof > 0, creep.square / creep.dof / variance, 1.0)
    uneven = _uneven(ratio * creep.dof, creep.dof, np.ones(variance.size), settings)
    return Noise(np.sqrt(variance), correlation, np.where(uneven, np.sqrt(np.maximum(ratio, 1)), 1.0))


def _fit_correlation(
    x_px: Floats, frames: StickFrames, terms: int, usual: Bools, settings: DeformationSettings
) -> AR1Noise:
    """White noise, AR(1), or AR(1) under white noise, by restricted maximum likelihood with a variance of
    its own for each sheet; a more general one only where it fits better than chance.

    Every so many sheets and sticks are enough in a long recording.  usual: (stick, sheet) used.
    """
    every = max(1, round(x_px.size / settings.correlation_positions))
    sheets = max(1, min(every, x_px.shape[1] // 8))
    kept = usual[:, ::sheets] & (np.arange(frames.sticks) % max(1, every // sheets) == 0)[:, None]
    inside = kept.any(axis=1)[frames.row]
    names = ("frame", "row", "u", "slot")
    part = replace(frames, **{name: getattr(frames, name)[inside] for name in names})
    x_px = np.where(kept[part.row], x_px[inside, ::sheets], np.nan)

    def deviance(share: float, rho: float) -> float:
        creep = fit_creep(x_px, part, terms, settings, AR1Noise(share, rho))
        dof = creep.dof.sum(axis=0)
        variance = np.nansum(creep.square, axis=0)[dof > 0] / dof[dof > 0]
        sizes = dof[dof > 0] @ np.log(np.maximum(variance, _LEAST_VARIANCE_PX2))
        return float(sizes + creep.log_det.sum() - np.linalg.slogdet(creep.inverse[creep.good])[1].sum())

    def mixture(both: Floats) -> float:
        return deviance(float(both[0]), float(both[1]))

    gain = 9.0  # in -2 log-likelihood that one more parameter must bring: 3 standard errors
    white = fit_creep(x_px, part, terms, settings)
    if white.dof.sum() < 30 or not np.nansum(white.square) > _LEAST_VARIANCE_PX2 * white.dof.sum():
        return AR1Noise()
    pure = scipy.optimize.minimize_scalar(
        lambda rho: deviance(1.0, rho), bounds=(0.01, 0.97), method="bounded", options={"xatol": 0.01}
    )
    if pure.fun + gain > deviance(0.0, 0.0):
        return AR1Noise()
    mixed = scipy.optimize.minimize(
        mixture,
        [0.5, max(0.5, pure.x)],
        method="Nelder-Mead",
        bounds=[(0.01, 1.0), (0.02, 0.97)],
        options={"xatol": 0.01, "fatol": 0.5, "maxfev": 40},
    )
    if mixed.fun + gain > pure.fun:
        return AR1Noise(1.0, float(pure.x))
    return AR1Noise(float(mixed.x[0]), float(mixed.x[1]))


def _typical_variance(creep: Creep) -> Floats:
    """Median noise variance per sheet, px², (sheet,); the sheets' median for those without."""
    median = 2 * scipy.special.gammaincinv(np.maximum(creep.dof, 1) / 2, 0.5)  # of chi-square
    each = nan_median(np.where(creep.dof > 0, creep.square / median, np.nan))
    overall = float(nan_median(each[None], axis=1)[0])
    return np.maximum(np.where(np.isfinite(each), each, np.nan_to_num(overall)), _LEAST_VARIANCE_PX2)


def _uneven(square: Floats, dof: Ints, variance: Floats, settings: DeformationSettings) -> Bools:
    """Residuals larger than chance allows, with half the degrees of freedom: correlated noise scatters
    more."""
    fewer = np.maximum(dof / 2, 1)
    limit = scipy.special.chdtri(fewer, settings.uneven_probability)
    return np.asarray(square / variance * fewer / np.maximum(dof, 1) > limit)


def _variance(square: Floats, dof: Ints, predicted_px: Floats, settings: DeformationSettings) -> Floats:
    """Noise variance per sheet: of its residuals, averaged with the predicted one times the common ratio."""
    measured, weight = square.sum(axis=0), dof.sum(axis=0)
    predicted = predicted_px**2
    middle = float(nan_median(predicted[None], axis=1)[0])
    shape = np.where(np.isfinite(predicted), predicted, middle if middle > 0 else 1.0)
    prior = shape * measured.sum() / max(float((weight * shape).sum()), 1e-300)
    both = (measured + settings.predicted_dof * prior) / (weight + settings.predicted_dof)
    return np.asarray(np.maximum(both, _LEAST_VARIANCE_PX2))


# --- fixed-pattern error ------------------------------------------------------------------------------------


def fixed_pattern_gain(reach_px: Floats, terms: int) -> Floats:
    r"""RMS share of a fixed pattern of 1 px in each coefficient of the creep, (..., terms).

    reach_px (...) is half the distance that the sheet creeps.  A wave of f per px has the share
    :math:`(2 l + 1) j_l(2 \pi f r)` in :math:`P_l` (spherical Bessel functions); waves are weighted by the
    transfer function of the subpixel fit, which weighs pixels by their distance from its centre.
    """
    waves_per_px = np.arange(0.01, 0.5, 0.01)
    window_px = np.arange(TrackingSettings().standard_window_px // 2 + 1)
    power = (np.sin(2 * np.pi * waves_per_px[:, None] * window_px) @ window_px) ** 2
    reach = np.nan_to_num(np.abs(reach_px))
    grid = np.linspace(0, float(reach.max(initial=0.0)) + 1e-9, 200)
    order, phase = np.arange(terms)[:, None, None], 2 * np.pi * waves_per_px[:, None] * grid
    square = power @ scipy.special.spherical_jn(order, phase) ** 2 / power.sum()
    return np.stack([(2 * k + 1) * np.interp(reach, grid, np.sqrt(square[k])) for k in range(terms)], axis=-1)


def fixed_pattern_px(creep: Creep, error: Floats, noise: Noise, settings: DeformationSettings) -> Floats:
    """RMS error of position that repeats wherever a sheet passes (unequal pixels, dust), px, (sheet,).

    Such errors do not average out over the frames of a stick, and a straight line hides them.  Their size
    follows from bends of the creep (three terms or more) that a sheet shows again in every stick; bends that
    all sheets share are no pattern but camera movement, or creep that slows down.  error: of the coefficients
    from noise alone, px, (stick, sheet, term).
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
    """What the errors of the creep are made of."""

    noise: Noise  # of the positions
    pattern_px: Floats  # fixed-pattern error of each sheet, (sheet,)
    scale: float = 0.0  # relative error of the magnification

    def of(self, fit: Creep) -> Floats:
        """Standard errors of the coefficients of a fit with the noise's correlation, px, (stick, sheet,
        term)."""
        variance = np.einsum("eskk->esk", fit.inverse)
        random = np.sqrt(variance) * (self.noise.noise_px * self.noise.excess)[..., None]
        reach = fit.coefficient[..., 1]
        pattern = fixed_pattern_gain(reach, variance.shape[2]) * self.pattern_px[:, None]
        return np.asarray(np.sqrt(random**2 + pattern**2 + (self.scale * reach[..., None]) ** 2))
