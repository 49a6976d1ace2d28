"""Fits of the paper's models to stick-slip events."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vision.errors import InputError
from vision.models import equations, single_sheet
from vision.models.equations import PAPER, Assembly
from vision.models.fits_result import Estimate, Goodness, ModelFits, ShellComparison

if TYPE_CHECKING:
    import pandas as pd

Floats = NDArray[np.float64]

_MIN_EVENTS = 6
_DEGENERATE = 0.98


def fit_models(
    sticks: pd.DataFrame,
    shells: pd.DataFrame | None = None,
    *,
    assembly: Assembly = PAPER,
    t_star_N: float = equations.T_STAR_N,
    free_t_star: bool = False,
) -> ModelFits:
    """μ and 𝒯0 from the peaks, A from the drops, N̂ and Y_eff from the stiffness.

    F_p = 𝒯(d_p; μ, T*) + 𝒯0 (Eq. 1 where the slip happens); then, with that μ, ΔF = A 𝒩(d_v) and
    K = M_eff(d_v; N̂) ε W Y_eff / L.  Peaks and drops scatter by a share of themselves and are weighted
    so; K by its own error.  Standard errors come from the deviations themselves (White's sandwich), so
    they hold whatever the scatter's size; the error of μ is carried into A, N̂ and Y_eff.

    Args: sticks, as from `find_stick_slip`: events not flagged "ok" are left out.  shells, columns d_v_mm and
    stiff_sheets, compared with M_eff.  assembly, the sample; the paper's by default.  t_star_N, T*;
    free_t_star fits it too, which is degenerate with μ (correlation -0.999) and noted.

    Raises InputError with fewer than six whole events, or separations that are not between 0 and the sheets'
    length (is --d0 given?).  Source: paper, Eqs. 1 and 2, section on the effective number of sheets.
    """
    events = _usable(sticks, assembly)
    peaks = _fit_peaks(events, assembly, t_star_N, free_t_star)
    t_star = float(peaks.value[2]) if free_t_star else t_star_N
    mu = peaks.estimate(0)
    drops = _with_friction(lambda m: _fit_drops(events, assembly, m, t_star), mu)
    stiffness = _with_friction(lambda m: _fit_stiffness(events, assembly, m, t_star), mu)
    span = (float(events["d_v_mm"].min()), float(events["d_v_mm"].max()))
    scale, bending = _derived(stiffness, mu, t_star, assembly, 0.5 * sum(span))
    fits = ModelFits(
        mu=mu,
        t0_N=peaks.estimate(1),
        t_star_N=peaks.estimate(2) if free_t_star else Estimate(t_star_N, float("nan")),
        amplitude=drops.estimate(0),
        n_hat_N=stiffness.estimate(0),
        modulus_GPa=stiffness.estimate(1),
        scale_mm=scale,
        bending_mm=bending,
        goodness={"peaks": peaks.goodness, "drops": drops.goodness, "stiffness": stiffness.goodness},
        correlation=_correlations(peaks, stiffness, free_t_star),
        d_mm=span,
        assembly=assembly,
        shells=None,
        notes=_notes(peaks, stiffness, span, scale, free_t_star),
    )
    return fits if shells is None else compare_shells(fits, shells)


def compare_shells(fits: ModelFits, shells: pd.DataFrame) -> ModelFits:
    """The same fits with imaging's shells (columns d_v_mm, stiff_sheets) set against the force's M_eff."""
    from dataclasses import replace

    known = shells.dropna(subset=["d_v_mm", "stiff_sheets"]).astype({"stiff_sheets": float})
    difference = (known["stiff_sheets"] - fits.effective_sheets(known["d_v_mm"])).to_numpy()
    if not difference.size:
        return fits
    mean, rms = float(difference.mean()), float(np.sqrt(np.mean(difference**2)))
    return replace(fits, shells=ShellComparison(difference.size, mean, rms))


def _usable(sticks: pd.DataFrame, assembly: Assembly) -> pd.DataFrame:
    needed = ["d_v_mm", "d_p_mm", "F_p_N", "dF_N", "K_N_per_mm"]
    events: pd.DataFrame = sticks[sticks["flag"] == "ok"] if "flag" in sticks else sticks
    rising = (events["dF_N"] > 0) & (events["K_N_per_mm"] > 0)
    events = events.loc[rising & np.isfinite(events[needed].to_numpy(float)).all(axis=1)]
    if len(events) < _MIN_EVENTS:
        raise InputError(
            "model fits",
            f"at least {_MIN_EVENTS} whole events with d, F_p, dF and K",
            f"{len(events)} of {len(sticks)}",
            "lengths need a displacement or --speed",
        )
    low, high = float(events["d_v_mm"].min()), float(events["d_p_mm"].max())
    if low <= 0 or high >= assembly.length_mm:
        raise InputError(
            "model fits",
            f"separations between 0 and {assembly.length_mm:g} mm",
            f"{low:.3g} to {high:.3g} mm",
            "give the initial separation with --d0",
        )
    return events


@dataclass(frozen=True)
class _Fit:
    """Parameters with their covariance."""

    value: Floats
    covariance: Floats
    goodness: Goodness

    def estimate(self, k: int) -> Estimate:
        return Estimate(float(self.value[k]), float(np.sqrt(self.covariance[k, k])))

    def correlation(self, a: int, b: int) -> float:
        return float(self.covariance[a, b] / np.sqrt(self.covariance[a, a] * self.covariance[b, b]))


def _fit(model: Callable[[Floats], Floats], y: Floats, sigma: Floats | None, start: Sequence[float]) -> _Fit:
    """Weighted least squares with White's covariance; with sigma None the errors are a share of the model."""
    from scipy.optimize import least_squares

    value, width = np.asarray(start, float), np.abs(y) if sigma is None else sigma
    scale = np.maximum(np.abs(value), 1e-3)

    def deviation(q: Floats, w: Floats) -> Floats:
        return (model(q) - y) / w

    for _ in range(3 if sigma is None else 1):
        found = least_squares(deviation, value, args=(width,), x_scale=scale, xtol=1e-12, ftol=1e-12)
        value = found.x
        if sigma is None:
            width = np.maximum(np.abs(model(value)), 1e-6 * float(np.abs(y).max()))
    residual, jacobian = np.asarray(found.fun, dtype=float), np.asarray(found.jac, dtype=float)
    bread = np.linalg.pinv(jacobian.T @ jacobian)
    meat = jacobian.T @ (jacobian * residual[:, np.newaxis] ** 2)
    free = max(y.size - value.size, 1)
    return _Fit(value, bread @ meat @ bread * y.size / free, _goodness(model(value), y, residual, free))


def _goodness(model: Floats, y: Floats, residual: Floats, free: int) -> Goodness:
    neighbours = float(np.sum(np.diff(residual) ** 2) / (2 * max(residual.size - 1, 1)))
    chi2 = float(np.sum(residual**2) / free / neighbours) if neighbours > 0 else float("nan")
    return Goodness(int(y.size), float(np.sqrt(np.mean((y / model - 1) ** 2))), chi2)


def _fit_peaks(events: pd.DataFrame, assembly: Assembly, t_star_N: float, free_t_star: bool) -> _Fit:
    d, peak = events["d_p_mm"].to_numpy(float), events["F_p_N"].to_numpy(float)

    def model(q: Floats) -> Floats:
        t_star = abs(q[2]) if free_t_star else t_star_N
        force = equations.traction(d, mu=max(q[0], 1e-3), t_star_N=t_star, assembly=assembly)
        return np.asarray(force + q[1])

    trials = np.linspace(0.2, 2.0, 91)
    misfit = [np.sum((model(np.array([mu, 0.0, t_star_N])) / peak - 1) ** 2) for mu in trials]
    start = [float(trials[int(np.argmin(misfit))]), 0.0, t_star_N]
    return _fit(model, peak, None, start if free_t_star else start[:2])


def _fit_drops(events: pd.DataFrame, assembly: Assembly, mu: float, t_star_N: float) -> _Fit:
    d, drop = events["d_v_mm"].to_numpy(float), events["dF_N"].to_numpy(float)
    total = equations.total_normal_force(d, mu=mu, t_star_N=t_star_N, assembly=assembly)
    return _fit(lambda q: np.asarray(q[0] * total), drop, None, [float(np.median(drop / total))])


def _fit_stiffness(events: pd.DataFrame, assembly: Assembly, mu: float, t_star_N: float) -> _Fit:
    d, k = events["d_v_mm"].to_numpy(float), events["K_N_per_mm"].to_numpy(float)
    sigma = _stiffness_errors(events)

    def model(q: Floats) -> Floats:
        return np.asarray(
            equations.assembly_stiffness(
                d, mu=mu, n_hat_N=np.exp(q[0]), modulus_GPa=q[1], t_star_N=t_star_N, assembly=assembly
            )
        )

    trials = np.geomspace(0.005, 20, 60)
    shape = [model(np.array([np.log(n_hat), 1.0])) for n_hat in trials]
    modulus = [float(np.sum(k * s / sigma**2) / max(np.sum((s / sigma) ** 2), 1e-300)) for s in shape]
    misfit = [np.sum(((k - y * s) / sigma) ** 2) for y, s in zip(modulus, shape, strict=True)]
    best = int(np.argmin(misfit))
    fit = _fit(model, k, sigma, [float(np.log(trials[best])), modulus[best]])
    # Fitted as log N̂, which keeps it positive; told as N̂.
    turn = np.diag([np.exp(fit.value[0]), 1.0])
    value = np.array([np.exp(fit.value[0]), fit.value[1]])
    return _Fit(value, turn @ fit.covariance @ turn, fit.goodness)


def _stiffness_errors(events: pd.DataFrame) -> Floats:
    """Errors of K, each added to half the usual one: one luckily small error must not outweigh the rest."""
    error = events["K_err_N_per_mm"].to_numpy(float)
    known = np.isfinite(error) & (error > 0)
    usual = float(np.median(error[known])) if known.any() else 1.0
    return np.hypot(np.where(known, error, usual), 0.5 * usual)


def _with_friction(fit: Callable[[float], _Fit], mu: Estimate) -> _Fit:
    """A fit at the fitted μ whose covariance carries the error of μ too."""
    centre = fit(mu.value)
    slope = (fit(mu.value + mu.error).value - fit(mu.value - mu.error).value) / 2
    return _Fit(centre.value, centre.covariance + np.outer(slope, slope), centre.goodness)


def _derived(
    stiffness: _Fit, mu: Estimate, t_star_N: float, assembly: Assembly, d_mm: float
) -> tuple[Estimate, Estimate]:
    """(Λ̂, λ of the outermost sheet), errors carried through to first order."""

    def both(parameters: Floats, friction: float) -> Floats:
        n_hat, modulus = parameters
        scale = equations.separation_scale_mm(
            mu=friction, n_hat_N=n_hat, t_star_N=t_star_N, assembly=assembly
        )
        bending = single_sheet.bending_length_mm(
            assembly.sheets_per_side,
            d_mm,
            n_hat_N=n_hat,
            modulus_GPa=modulus,
            thickness_mm=assembly.thickness_mm,
            width_mm=assembly.width_mm,
        )
        return np.array([float(scale), float(bending)])

    centre = stiffness.value
    step = 1e-4 * np.diag(centre)
    slopes = np.column_stack(
        [(both(centre + move, mu.value) - both(centre - move, mu.value)) / (2 * move.sum()) for move in step]
    )
    value = both(centre, mu.value)
    error = np.sqrt(np.diag(slopes @ stiffness.covariance @ slopes.T))
    return Estimate(float(value[0]), float(error[0])), Estimate(float(value[1]), float(error[1]))


def _correlations(peaks: _Fit, stiffness: _Fit, free_t_star: bool) -> dict[str, float]:
    found = {"mu,T0_N": peaks.correlation(0, 1), "N_hat_N,Y_eff_GPa": stiffness.correlation(0, 1)}
    return found | ({"mu,T_star_N": peaks.correlation(0, 2)} if free_t_star else {})


def _notes(
    peaks: _Fit, stiffness: _Fit, span: tuple[float, float], scale: Estimate, free_t_star: bool
) -> tuple[str, ...]:
    notes = []
    if free_t_star:
        notes.append(
            f"T* and mu are degenerate (correlation {peaks.correlation(0, 2):.3f}): read them together only"
        )
    if abs(stiffness.correlation(0, 1)) > _DEGENERATE:
        notes.append("N_hat and Y_eff are nearly degenerate over this range of d")
    if span[1] > scale.value:
        notes.append(f"d goes beyond {scale.value:.2f} mm, where M_eff is 0")
    return tuple(notes)
