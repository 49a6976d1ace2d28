"""One model at a time: the peaks by Eq. 1, the drops by A𝒩, the stiffness by M_eff K_eff.

Weighted least squares whose errors come from the deviations themselves.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
import scipy

from vision.models import equations
from vision.models.results import Estimate, Goodness
from vision.numeric import Bools, Floats
from vision.sample import Sample

LARGEST_SCALE = 20.0  # Λ̂ over d at which K no longer falls as M_eff does: a limit, not a result


@dataclass(frozen=True)
class Fit:
    """Parameters with their covariance."""

    value: Floats
    covariance: Floats
    goodness: Goodness
    residual: Floats

    def estimate(self, k: int) -> Estimate:
        """Parameter k with its error."""
        return Estimate(float(self.value[k]), float(np.sqrt(self.covariance[k, k])))

    def correlation(self, a: int, b: int) -> float:
        """Of parameters a and b; 0 where one is known."""
        both = float(np.sqrt(self.covariance[a, a] * self.covariance[b, b]))
        return float(self.covariance[a, b]) / both if both > 0 else 0.0

    def with_held(self, place: int, value: float) -> Fit:
        """The same with one more parameter, known and without error, before `place`."""
        covariance = np.insert(np.insert(self.covariance, place, 0.0, axis=0), place, 0.0, axis=1)
        return replace(self, value=np.insert(self.value, place, value), covariance=covariance)


def fit_weighted(
    model: Callable[[Floats], Floats], y: Floats, sigma: Floats | None, start: Sequence[float]
) -> Fit:
    """Weighted least squares with White's covariance; with sigma None the errors are a share of the model."""
    value, width = np.asarray(start, float), np.abs(y) if sigma is None else sigma
    scale = np.maximum(np.abs(value), 1e-3)

    def deviation(q: Floats, w: Floats) -> Floats:
        return (model(q) - y) / w

    for _ in range(3 if sigma is None else 1):
        found = scipy.optimize.least_squares(
            deviation, value, args=(width,), x_scale=scale, xtol=1e-12, ftol=1e-12
        )
        value = found.x
        if sigma is None:
            width = np.maximum(np.abs(model(value)), 1e-6 * float(np.abs(y).max()))
    residual, jacobian = np.asarray(found.fun, dtype=float), np.asarray(found.jac, dtype=float)
    bread = np.linalg.pinv(jacobian.T @ jacobian)
    meat = jacobian.T @ (jacobian * residual[:, np.newaxis] ** 2)
    free = max(y.size - value.size, 1)
    goodness = _goodness(model(value), y, residual, free)
    # Deviations that hang together from event to event count for fewer than they are.
    wider = max(goodness.chi2_dof, 1.0) if np.isfinite(goodness.chi2_dof) else 1.0
    return Fit(value, bread @ meat @ bread * (y.size / free * wider), goodness, residual)


def _goodness(model: Floats, y: Floats, residual: Floats, free: int) -> Goodness:
    neighbours = float(np.sum(np.diff(residual) ** 2) / (2 * max(residual.size - 1, 1)))
    chi2 = float(np.sum(residual**2) / free / neighbours) if neighbours > 0 else float("nan")
    return Goodness(int(y.size), float(np.sqrt(np.mean((y / model - 1) ** 2))), chi2)


def fit_peaks(events: pd.DataFrame, sample: Sample, free_t_star: bool, held: Mapping[str, float]) -> Fit:
    """μ, 𝒯0 and, if that is free, T* from the peak forces."""
    d, peak = events["d_p_mm"].to_numpy(float), events["F_p_N"].to_numpy(float)

    def force(mu: float, t0: float, t_star: float) -> Floats:
        assumed = replace(sample, t_star_N=max(abs(t_star), 1e-12))
        return np.asarray(equations.traction(d, mu=max(mu, 1e-3), sample=assumed) + t0)

    given = held.get("mu")

    def model(q: Floats) -> Floats:
        mu, rest = (given, q) if given is not None else (float(q[0]), q[1:])
        return force(mu, float(rest[0]), float(rest[1]) if free_t_star else sample.t_star_N)

    trials = np.linspace(0.2, 2.0, 91) if given is None else np.array([given])
    misfit = [np.sum((force(float(mu), 0.0, sample.t_star_N) / peak - 1) ** 2) for mu in trials]
    start = [float(trials[int(np.argmin(misfit))])] if given is None else []
    fit = fit_weighted(model, peak, None, [*start, 0.0, *([sample.t_star_N] if free_t_star else [])])
    return fit if given is None else fit.with_held(0, given)


def fit_drops(events: pd.DataFrame, sample: Sample, mu: float) -> Fit:
    """A from the force drops."""
    d, drop = events["d_v_mm"].to_numpy(float), events["dF_N"].to_numpy(float)
    total = equations.total_normal_force(d, mu=mu, sample=sample)
    return fit_weighted(lambda q: np.asarray(q[0] * total), drop, None, [float(np.median(drop / total))])


def fit_stiffness(events: pd.DataFrame, sample: Sample, held: Mapping[str, float]) -> Fit:
    """Λ̂ and Y_eff from the stiffness, K = M √(1 − d/Λ̂) ε W Y_eff / L: no friction coefficient in it."""
    d, k = events["d_v_mm"].to_numpy(float), events["K_N_per_mm"].to_numpy(float)
    sigma = _stiffness_errors(events)
    given = held.get("modulus_GPa")

    def stiffness(scale: float, modulus: float) -> Floats:
        sheets = equations.effective_sheets(d / scale, sample=sample)
        return np.asarray(sheets * equations.sheet_stiffness(modulus_GPa=modulus, sample=sample))

    def model(q: Floats) -> Floats:
        return stiffness(float(np.exp(q[0])), float(q[1]) if given is None else given)

    trials = np.geomspace(1.001 * d.min(), LARGEST_SCALE * d.max(), 120)
    shapes = [stiffness(float(scale), 1.0) for scale in trials]
    modulus = [
        given or float(np.sum(k * s / sigma**2) / max(float(np.sum((s / sigma) ** 2)), 1e-300))
        for s in shapes
    ]
    misfit = [np.sum(((k - y * s) / sigma) ** 2) for y, s in zip(modulus, shapes, strict=True)]
    best = int(np.argmin(misfit))
    start = [float(np.log(trials[best])), *([modulus[best]] if given is None else [])]
    fit = fit_weighted(model, k, sigma, start)
    if given is not None:
        fit = fit.with_held(1, given)
    largest = LARGEST_SCALE * float(d.max())
    if fit.value[0] >= np.log(largest):
        modulus_alone = fit_weighted(lambda q: stiffness(largest, float(q[0])), k, sigma, [fit.value[1]])
        fit = modulus_alone.with_held(0, float(np.log(largest)))
        fit.covariance[0, 0] = 1.0  # of a logarithm: as large as Λ̂ itself
    # Fitted as log Λ̂, which keeps it positive; reported as Λ̂.
    scale = float(np.exp(fit.value[0]))
    turn = np.diag([scale, 1.0])
    return replace(fit, value=np.array([scale, fit.value[1]]), covariance=turn @ fit.covariance @ turn)


def _stiffness_errors(events: pd.DataFrame) -> Floats:
    """Errors of K, each added to half the usual one: one luckily small error must not outweigh the rest."""
    error = np.full(len(events), np.nan)
    if "K_err_N_per_mm" in events:
        error = events["K_err_N_per_mm"].to_numpy(float)
    known: Bools = np.isfinite(error) & (error > 0)
    usual = float(np.median(error[known])) if known.any() else 1.0
    return np.hypot(np.where(known, error, usual), 0.5 * usual)


def with_friction(fit: Callable[[float], Fit], mu: Estimate) -> Fit:
    """A fit at the fitted μ whose covariance carries the error of μ too."""
    centre = fit(mu.value)
    slope = (fit(mu.value + mu.error).value - fit(mu.value - mu.error).value) / 2
    return replace(centre, covariance=centre.covariance + np.outer(slope, slope))


def usual_chi2(points: int) -> float:
    """What chi2_dof rarely exceeds where the model is right: it compares two estimates of one variance."""
    return float(1 + 3 / np.sqrt(points))
