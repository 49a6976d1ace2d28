"""Fits that make tests comparable: each by itself with T* and Y_eff fixed, and one μ for several tests."""

# ruff: noqa: N815 (the unit is part of a name, and newton is N)
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np
import pandas as pd
import scipy

from vision.comparison.tests import TractionTest
from vision.errors import InputError
from vision.models import Estimate, equations
from vision.numeric import Bools, Floats
from vision.sample import Sample

MU_RANGE = 0.05, 5.0  # looked through; a fit at either end is none
MISFIT = 3.0  # χ²/dof from which it is said


@dataclass(frozen=True, kw_only=True)
class CompareSettings:
    """Tunable constants of the comparison."""

    t0_limit_N: float = 10.0
    """Largest offset 𝒯0 of a test in the joint fit. Wider lets μ and 𝒯0 trade; the publication has 10 N."""
    slow_mm_min: float = 1.0
    """Velocity up to which the models of A, N̂ and Y_eff are the publication's; Y_eff is taken from these."""
    smooth_events: int = 15
    """Window of the running scatter of ΔF. Shorter is noisier, longer blurs the place of a change; the
    scatter of a test without a change must stay level."""
    draws: int = 4000
    """Permutations of a p value: its own scatter is √(p/draws), 0.0035 at 0.05."""
    significance: float = 0.05
    """Share of tests without any trend in which one may be claimed."""
    seed: int = 0
    """Of the permutations."""


@dataclass(frozen=True, kw_only=True)
class TestFit:
    """What one test gives with T* and Y_eff fixed.

    Parameters
    ----------
    mu, t0_N
        From the peak forces.
    amplitude
        A.
    scale_mm, n_hat_N
        Λ̂ and N̂ from K; their systematic error is that of Y_eff.
    chi2_dof
        Squared deviation from the models over that between neighbouring events, mean of the three fits.
    peak_scatter
        Standard deviation of the peaks about the fit, as a share of them.
    used
        Which events.
    notes
        What limits the result.
    """

    __test__ = False
    mu: Estimate
    t0_N: Estimate
    amplitude: Estimate
    scale_mm: Estimate
    n_hat_N: Estimate
    chi2_dof: float
    peak_scatter: float
    used: Bools = field(repr=False)
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class JointFriction:
    """One μ for several tests of one sample.

    Parameters
    ----------
    sample
        Name.
    runs
        Which tests.
    mu
        The common friction coefficient.
    t0_N
        Offset of each test.
    at_limit
        Runs whose offset is as large as it may be.
    disagreement
        χ²/dof of the tests' own μ about the common one. What they differ by beyond their errors is in the
        error of `mu`.
    amplitude
        A, the weighted mean of the slow tests.
    """

    sample: str
    runs: tuple[str, ...]
    mu: Estimate
    t0_N: tuple[float, ...]
    at_limit: tuple[str, ...]
    disagreement: float
    amplitude: Estimate


def usable_range(test: TractionTest) -> Bools:
    """Events that the models can hold for: within the run's fit range, from the maximum of the peaks on."""
    d, peak = test.column("d_v_mm"), test.column("F_p_N")
    used: Bools = np.ones(d.size, bool)
    if test.fit_range_mm is not None:
        low, high = test.fit_range_mm
        used = (d >= low - 1e-6) & (d <= high + 1e-6)
    smooth = pd.Series(peak).rolling(5, center=True, min_periods=1).median().to_numpy()
    used &= np.arange(d.size) >= int(np.argmax(np.where(used, smooth, -np.inf)))
    return used if used.sum() >= 6 else np.ones(d.size, bool)


def fit_test(test: TractionTest, modulus: Estimate, settings: CompareSettings | None = None) -> TestFit:
    r"""μ, 𝒯0 and A of one test with T* fixed, Λ̂ and N̂ with Y_eff fixed.

    Parameters
    ----------
    test
        Of `read_tests`.
    modulus
        Y_eff in GPa with its error.
    settings
        Tunable constants.

    Raises
    ------
    InputError
        For peaks that do not fall with d.

    Notes
    -----
    .. math:: F_p = \mathcal T(d_p; \mu) + \mathcal T_0, \quad \Delta F = A\, \mathcal N(d_v; \mu), \quad
        K = M \sqrt{1 - d_v/\hat\Lambda}\; \epsilon W Y_\mathrm{eff} / L

    K knows μ only through Λ̂, so Λ̂ alone is fitted and N̂ follows with the errors of both. Peaks and drops
    are weighted by a share of the model, K by its own error. Standard errors are White's, times √(χ²/dof)
    where the models misfit. Source: publication, section on the effective number of sheets.
    """
    tuning = settings or CompareSettings()
    used = usable_range(test)
    d_v, d_p = test.column("d_v_mm")[used], test.column("d_p_mm")[used]
    mu, t0, scatter, misfit_p = _fit_peaks(d_p, test.column("F_p_N")[used], test.sample)
    if not (MU_RANGE[0] * 1.1 < mu.value < MU_RANGE[1] / 1.1 and mu.value > 2 * mu.error):
        found = f"others (μ = {mu.value:.3g} ± {mu.error:.2g})"
        raise InputError(test.folder, "peak forces that fall with d as Eq. 1 does", found, "check `d0_mm`")
    amplitude, misfit_d = _fit_drops(d_v, test.column("dF_N")[used], mu, test.sample)
    k, sigma = test.column("K_N_per_mm")[used], stiffness_errors(test)[used]
    scale, misfit_k = fit_scale(d_v, k, sigma, modulus, test.sample)
    notes = []
    if abs(t0.value) > tuning.t0_limit_N:
        notes.append(f"offset 𝒯0 = {t0.value:.3g} N lies beyond ±{tuning.t0_limit_N:g} N")
    if test.speed_mm_min > 1.05 * tuning.slow_mm_min:
        notes.append(f"A, N̂ and Λ̂ are defined for V up to {tuning.slow_mm_min:g} mm/min")
    if not np.isfinite(scale.value):
        notes.append("K is not that of M_eff sheets with this Y_eff: no Λ̂")
    chi2 = float(np.nanmean([misfit_p, misfit_d, misfit_k]))
    if chi2 > MISFIT:
        notes.append(f"the models misfit: χ²/dof = {chi2:.3g}, errors scaled")
    left = int((~used).sum())
    if left:
        notes.append(f"{left} events before the largest peaks or outside the run's fit range left out")
    return TestFit(
        mu=mu,
        t0_N=t0,
        amplitude=amplitude,
        scale_mm=scale,
        n_hat_N=_n_hat(mu, scale, test.sample),
        chi2_dof=chi2,
        peak_scatter=scatter,
        used=used,
        notes=tuple(notes),
    )


# --- peaks --------------------------------------------------------------------------------------------------


def _fit_peaks(d: Floats, peak: Floats, sample: Sample) -> tuple[Estimate, Estimate, float, float]:
    """(μ, 𝒯0, scatter of the peaks as a share of them, χ²/dof)."""
    floor = 1e-3 * float(np.abs(peak).max()) or 1.0
    width = np.maximum(np.abs(peak), floor)
    mu, t0 = 0.5, 0.0
    for _ in range(3):
        mu = _best(partial(_offset_misfit, d=d, peak=peak, width=width, sample=sample), *MU_RANGE)
        model = equations.traction(d, mu=mu, sample=sample)
        t0 = float(np.average(peak - model, weights=width**-2))
        width = np.maximum(np.abs(model + t0), floor)
    slope = _traction_slope(d, mu, sample)
    jacobian = np.column_stack([slope, np.ones(d.size)]) / width[:, np.newaxis]
    residual = (model + t0 - peak) / width
    covariance, misfit = _white(jacobian, residual)
    errors = np.sqrt(np.diag(covariance))
    scatter = float(np.sqrt(np.sum(residual**2) / max(d.size - 2, 1)))
    return Estimate(mu, float(errors[0])), Estimate(t0, float(errors[1])), scatter, misfit


def _offset_misfit(mu: float, d: Floats, peak: Floats, width: Floats, sample: Sample) -> float:
    """Squared deviation with the best offset."""
    rest = peak - equations.traction(d, mu=mu, sample=sample)
    rest = rest - np.average(rest, weights=width**-2)
    return float(np.sum((rest / width) ** 2))


def _traction_slope(d: Floats, mu: float, sample: Sample) -> Floats:
    step = 1e-5
    high, low = (equations.traction(d, mu=mu + s, sample=sample) for s in (step, -step))
    return np.asarray((high - low) / (2 * step))


def _best(misfit: Callable[[float], float], low: float, high: float) -> float:
    """The least of a misfit over a positive parameter: a grid, then refined between its neighbours."""
    grid = np.geomspace(low, high, 60)
    with np.errstate(all="ignore"):
        values = np.nan_to_num([misfit(float(q)) for q in grid], nan=np.inf)
        at = int(np.argmin(values))
        bounds = float(grid[max(at - 1, 0)]), float(grid[min(at + 1, grid.size - 1)])
        found = scipy.optimize.minimize_scalar(
            misfit, bounds=bounds, method="bounded", options={"xatol": 1e-9}
        )
    return float(found.x)


def _white(jacobian: Floats, residual: Floats) -> tuple[Floats, float]:
    """White's covariance, scaled where the model misfits, and χ²/dof against neighbouring events."""
    points, free = residual.size, max(residual.size - jacobian.shape[1], 1)
    bread = np.linalg.pinv(jacobian.T @ jacobian)
    meat = jacobian.T @ (jacobian * residual[:, np.newaxis] ** 2)
    neighbours = float(np.sum(np.diff(residual) ** 2) / (2 * max(points - 1, 1)))
    misfit = float(np.sum(residual**2) / free / neighbours) if neighbours > 0 else 1.0
    return bread @ meat @ bread * (points / free) * max(misfit, 1.0), misfit


# --- drops and stiffness ------------------------------------------------------------------------------------


def _fit_drops(d: Floats, drop: Floats, mu: Estimate, sample: Sample) -> tuple[Estimate, float]:
    """A with the error of μ carried into it."""

    def share(m: float) -> Floats:
        return np.asarray(drop / equations.total_normal_force(d, mu=m, sample=sample))

    ratio = share(mu.value)
    value = float(ratio.mean())
    covariance, misfit = _white(np.ones((d.size, 1)), ratio / value - 1)
    step = max(1e-5, 0.1 * mu.error) if np.isfinite(mu.error) else 1e-5
    slope = (float(share(mu.value + step).mean()) - float(share(mu.value - step).mean())) / (2 * step)
    error = np.hypot(value * np.sqrt(covariance[0, 0]), slope * mu.error)
    return Estimate(value, float(error)), misfit


def stiffness_errors(test: TractionTest) -> Floats:
    """Errors of K, each added to half the usual one: one luckily small error must not outweigh the rest."""
    error = np.full(len(test.events), np.nan)
    if "K_err_N_per_mm" in test.events:
        error = test.column("K_err_N_per_mm")
    known: Bools = np.isfinite(error) & (error > 0)
    usual = (
        float(np.median(error[known])) if known.any() else 0.05 * float(np.median(test.column("K_N_per_mm")))
    )
    return np.hypot(np.where(known, error, usual), 0.5 * usual)


def fit_scale(
    d: Floats, k: Floats, sigma: Floats, modulus: Estimate, sample: Sample
) -> tuple[Estimate, float]:
    """Λ̂ in mm from K with Y_eff fixed, and χ²/dof; the systematic error is that of Y_eff.

    NaN where K exceeds what all sheets together have, or where no Λ̂ within reach fits.
    """
    value, misfit, error = _scale_at(d, k, sigma, modulus.value, sample)
    systematic = float("nan")
    if np.isfinite(modulus.error) and np.isfinite(value):
        ends = [_scale_at(d, k, sigma, modulus.value + s * modulus.error, sample)[0] for s in (-1, 1)]
        systematic = abs(ends[1] - ends[0]) / 2
    return Estimate(value, error, systematic), misfit


def _scale_at(
    d: Floats, k: Floats, sigma: Floats, modulus: float, sample: Sample
) -> tuple[float, float, float]:
    """(Λ̂, χ²/dof, error)."""
    nan = float("nan")
    full = sample.sheets_per_block * float(equations.sheet_stiffness(modulus_GPa=modulus, sample=sample))
    if not full > 0:
        return nan, nan, nan

    def model(inverse: float) -> Floats:
        return np.asarray(full * np.sqrt(np.maximum(1 - inverse * d, 0)))

    low, high = 1e-3 / float(d.max()), 2.0 / float(d.min())
    inverse = _best(lambda q: float(np.sum(((model(q) - k) / sigma) ** 2)), low, high)
    if not 1.01 * low < inverse < 0.99 * high:
        return nan, nan, nan
    inside = 1 - inverse * d > 1e-9
    slope = np.where(inside, -full * d / (2 * np.sqrt(np.maximum(1 - inverse * d, 1e-9))), 0.0)
    covariance, misfit = _white((slope / sigma)[:, np.newaxis], (model(inverse) - k) / sigma)
    return 1 / inverse, misfit, float(np.sqrt(covariance[0, 0])) / inverse**2


def _n_hat(mu: Estimate, scale: Estimate, sample: Sample) -> Estimate:
    r"""N̂ = T*/(2μ) (exp(2μεM²/Λ̂) − 1), with the errors of μ and Λ̂, which come from different numbers."""

    def n_hat(m: float, length: float) -> float:
        exponent = 2 * m * sample.thickness_mm * sample.sheets_per_block**2 / length
        return float(sample.t_star_N / (2 * m) * np.expm1(min(exponent, 700.0)))

    if not np.isfinite(scale.value):
        return Estimate(float("nan"), float("nan"))
    step_m, step_l = 1e-5 * mu.value, 1e-5 * scale.value
    by_mu = (n_hat(mu.value + step_m, scale.value) - n_hat(mu.value - step_m, scale.value)) / (2 * step_m)
    by_scale = (n_hat(mu.value, scale.value + step_l) - n_hat(mu.value, scale.value - step_l)) / (2 * step_l)
    return Estimate(
        n_hat(mu.value, scale.value),
        float(np.hypot(by_mu * mu.error, by_scale * scale.error)),
        abs(by_scale) * scale.systematic_error,
    )


def common_modulus(
    tests: Sequence[TractionTest], main: str, settings: CompareSettings | None = None
) -> tuple[Estimate, tuple[str, ...]]:
    """Y_eff of the main sample in GPa, the weighted mean of its slow tests, and which runs these are.

    The run's own fit is used where it has one, else Λ̂ and Y_eff are fitted here. The error holds how far the
    tests disagree.
    """
    tuning = settings or CompareSettings()
    mine = [test for test in tests if test.sample_name == main]
    slow = [test for test in mine if not test.speed_mm_min > 1.05 * tuning.slow_mm_min] or mine
    found = [_own_modulus(test) for test in slow]
    value, error, _ = weighted_mean(found)
    return Estimate(value, error), tuple(test.run for test in slow)


def _own_modulus(test: TractionTest) -> Estimate:
    if np.isfinite(test.modulus_GPa) and test.modulus_err_GPa > 0:
        return Estimate(test.modulus_GPa, test.modulus_err_GPa)
    used = usable_range(test)
    d, k, sigma = test.column("d_v_mm")[used], test.column("K_N_per_mm")[used], stiffness_errors(test)[used]
    one = float(equations.sheet_stiffness(modulus_GPa=1.0, sample=test.sample)) * test.sample.sheets_per_block

    def shape(inverse: float) -> Floats:
        return np.asarray(one * np.sqrt(np.maximum(1 - inverse * d, 0)))

    def modulus(s: Floats) -> float:
        return float(np.sum(k * s / sigma**2) / max(np.sum((s / sigma) ** 2), 1e-300))

    def misfit(inverse: float) -> float:
        s = shape(inverse)
        return float(np.sum(((modulus(s) * s - k) / sigma) ** 2))

    inverse = _best(misfit, 1e-3 / float(d.max()), 1.05 / float(d.max()))
    s = shape(inverse)
    value = modulus(s)
    slope = np.where(s > 0, -value * one**2 * d / (2 * np.maximum(s, 1e-9)), 0.0)
    covariance, _ = _white(np.column_stack([slope, s]) / sigma[:, np.newaxis], (value * s - k) / sigma)
    return Estimate(value, float(np.sqrt(covariance[1, 1])))


def weighted_mean(parts: Sequence[Estimate]) -> tuple[float, float, float]:
    """Mean, its error and χ²/dof of the parts about it; the error is scaled where they disagree."""
    known = [part for part in parts if np.isfinite(part.value) and part.error > 0]
    if not known:
        return float("nan"), float("nan"), float("nan")
    value, error = np.array([part.value for part in known]), np.array([part.error for part in known])
    mean = float(np.average(value, weights=error**-2))
    chi2 = float(np.sum(((value - mean) / error) ** 2) / (len(known) - 1)) if len(known) > 1 else 1.0
    return mean, float(np.sum(error**-2.0) ** -0.5) * max(chi2, 1.0) ** 0.5, chi2


# --- one μ for several tests --------------------------------------------------------------------------------


def fit_joint(
    tests: Sequence[TractionTest],
    fits: Sequence[TestFit],
    sample: str,
    settings: CompareSettings | None = None,
) -> JointFriction:
    """One μ for several tests of one sample, each with an offset 𝒯0 of its own within ±10 N.

    Parameters
    ----------
    tests, fits
        Of one geometry.
    sample
        Name.
    settings
        Tunable constants.
    """
    tuning = settings or CompareSettings()
    parts = []
    for test, fit in zip(tests, fits, strict=True):
        d, peak = test.column("d_p_mm")[fit.used], test.column("F_p_N")[fit.used]
        model = equations.traction(d, mu=fit.mu.value, sample=test.sample) + fit.t0_N.value
        floor = 1e-3 * float(np.abs(peak).max()) or 1.0
        parts.append((d, peak, fit.peak_scatter * np.maximum(np.abs(model), floor), test.sample))

    def rest(mu: float, part: tuple[Floats, Floats, Floats, Sample]) -> tuple[Floats, float]:
        d, peak, width, geometry = part
        off = peak - equations.traction(d, mu=mu, sample=geometry)
        t0 = float(np.clip(np.average(off, weights=width**-2), -tuning.t0_limit_N, tuning.t0_limit_N))
        return (off - t0) / width, t0

    mu = _best(lambda m: sum(float(np.sum(rest(m, part)[0] ** 2)) for part in parts), *MU_RANGE)
    offsets = [rest(mu, part)[1] for part in parts]
    bound = [abs(t0) >= tuning.t0_limit_N for t0 in offsets]
    slopes = []
    for part, held in zip(parts, bound, strict=True):
        d, _, width, geometry = part
        slope = _traction_slope(d, mu, geometry)
        slopes.append((slope - (0.0 if held else np.average(slope, weights=width**-2))) / width)
    misfit = float(np.mean([max(fit.chi2_dof, 1.0) for fit in fits]))
    own_error = (misfit / float(np.sum(np.concatenate(slopes) ** 2))) ** 0.5
    own = [fit.mu for fit in fits]
    spread = [((one.value - mu) / one.error) ** 2 for one in own if one.error > 0]
    disagreement = float(np.sum(spread) / max(len(spread) - 1, 1))
    between = np.var([one.value for one in own], ddof=1) - np.mean([one.error**2 for one in own])
    error = float(np.sqrt(own_error**2 + max(float(between), 0.0) / len(own)))
    slow = [
        fit.amplitude
        for test, fit in zip(tests, fits, strict=True)
        if not test.speed_mm_min > 1.05 * tuning.slow_mm_min
    ]
    amplitude, amplitude_error, _ = weighted_mean(slow)
    return JointFriction(
        sample=sample,
        runs=tuple(test.run for test in tests),
        mu=Estimate(mu, error),
        t0_N=tuple(offsets),
        at_limit=tuple(test.run for test, held in zip(tests, bound, strict=True) if held),
        disagreement=disagreement,
        amplitude=Estimate(amplitude, amplitude_error),
    )
