# ruff: noqa: N815 (the unit is part of a name, and newton is N)
"""Fits of the paper's models to stick-slip events, and their form in models.json."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from vision.data import FORCE, ForceMetadata, html_table
from vision.errors import InputError
from vision.models import equations
from vision.models.single_sheet import bending_length_mm
from vision.numeric import Bools, Floats
from vision.sample import PUBLISHED, Sample

_LEAST_EVENTS = 6
_DEGENERATE = 0.98  # correlation from which two parameters are better read together


@dataclass(frozen=True)
class Estimate:
    """A value, its standard error and its systematic error; errors that are not known are NaN."""

    value: float
    error: float
    systematic_error: float = float("nan")


@dataclass(frozen=True)
class Goodness:
    """How well one model follows its points.

    Parameters
    ----------
    points
        How many.
    scatter
        Root mean square of the deviation over the model.
    chi2_dof
        Squared deviations over the point-to-point scatter of neighbours, which knows no model: about 1 where
        the model's shape is right, more where it is not.
    """

    points: int
    scatter: float
    chi2_dof: float


@dataclass(frozen=True, kw_only=True)
class ModelFits:
    """Parameters of the paper's models for one recording, with standard errors.

    Parameters
    ----------
    mu, t0_N
        Friction coefficient, and offset of the peak forces.
    t_star_N
        T*; its error is NaN where it was held fixed.
    amplitude, n_hat_N, modulus_GPa
        A, N-hat and Y_eff.
    scale_mm
        Lambda-hat, where M_eff reaches 0.
    bending_mm
        Bending length of the outermost sheet at mid-test.
    goodness
        Of the fits to "peaks", "drops" and "stiffness".
    correlation
        Of the pairs of parameters that are fitted together.
    d_mm
        Separation at the first and last event used.
    sample
        As given.
    notes
        What limits the result.
    """

    mu: Estimate
    t0_N: Estimate
    t_star_N: Estimate
    amplitude: Estimate
    n_hat_N: Estimate
    modulus_GPa: Estimate
    scale_mm: Estimate
    bending_mm: Estimate
    goodness: dict[str, Goodness]
    correlation: dict[str, float]
    d_mm: tuple[float, float]
    sample: Sample
    notes: tuple[str, ...]

    def reduced_separation(self, d_mm: ArrayLike) -> Floats:
        """Separation over Lambda-hat, without unit."""
        return np.asarray(d_mm, float) / self.scale_mm.value

    def effective_sheets(self, d_mm: ArrayLike) -> Floats:
        """M_eff per side that the force implies at d; 0 beyond Lambda-hat."""
        return equations.effective_sheets(self.reduced_separation(d_mm), sample=self.sample)

    def peak_force_N(self, d_mm: ArrayLike) -> Floats:
        """The fitted peak force, traction plus offset."""
        sample = replace(self.sample, t_star_N=self.t_star_N.value)
        return np.asarray(equations.traction(d_mm, mu=self.mu.value, sample=sample) + self.t0_N.value)

    def stiffness_N_per_mm(self, d_mm: ArrayLike) -> Floats:
        """The fitted K(d) = M_eff K_eff."""
        one = equations.sheet_stiffness(modulus_GPa=self.modulus_GPa.value, sample=self.sample)
        return np.asarray(self.effective_sheets(d_mm) * one)

    @property
    def chi2_dof(self) -> float:
        """That of the three fits together."""
        return float(np.mean([good.chi2_dof for good in self.goodness.values()]))

    def _repr_html_(self) -> str:
        named = {
            "μ": (self.mu, ""),
            "𝒯0": (self.t0_N, "N"),
            "A": (self.amplitude, ""),
            "N̂": (self.n_hat_N, "N"),
            "Y_eff": (self.modulus_GPa, "GPa"),
            "Λ̂": (self.scale_mm, "mm"),
        }
        rows = {
            name: f"{one.value:.5g}" + (f" ± {one.error:.2g}" if np.isfinite(one.error) else "") + f" {unit}"
            for name, (one, unit) in named.items()
        }
        rows["d"] = f"{self.d_mm[0]:.2f} to {self.d_mm[1]:.2f} mm"
        rows |= {
            f"χ²/dof, {name}": f"{good.chi2_dof:.3g} ({good.points} points)"
            for name, good in self.goodness.items()
        }
        rows |= {f"note {k}": line for k, line in enumerate(self.notes, 1)}
        return html_table("models fitted to the force recording", rows)

    def to_json(self) -> dict[str, Any]:
        """The content of models.json: values with errors, how well they fit, and the sample; no NaN in it."""
        named = {
            "mu": self.mu,
            "T0_N": self.t0_N,
            "A": self.amplitude,
            "N_hat_N": self.n_hat_N,
            "Y_eff_GPa": self.modulus_GPa,
            "Lambda_hat_mm": self.scale_mm,
            "bending_length_mm": self.bending_mm,
        }
        if np.isfinite(self.t_star_N.error):
            named["T_star_N"] = self.t_star_N
        content = {
            **{name: asdict(estimate) for name, estimate in named.items()},
            "events_used": self.goodness["peaks"].points,
            "fit_range_mm": self.d_mm,
            "chi2_dof": self.chi2_dof,
            "sample": asdict(self.sample),
            "goodness": {name: asdict(good) for name, good in self.goodness.items()},
            "correlation": self.correlation,
            "d_mm": self.d_mm,
            "d_hat": tuple(self.reduced_separation(self.d_mm).tolist()),
            "M_eff": tuple(self.effective_sheets(self.d_mm).tolist()),
            "notes": self.notes,
        }
        return {key: _without_nan(item) for key, item in content.items()}


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(item) for item in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def fit_models(
    force: xr.Dataset,
    sticks: pd.DataFrame,
    sample: Sample = PUBLISHED,
    *,
    free_t_star: bool = False,
) -> ModelFits:
    r"""Friction coefficient and offset from the peaks, A from the drops, N-hat and Y_eff from the stiffness.

    Parameters
    ----------
    force
        As from `read_force`: its load must be in N and its initial separation known.
    sticks
        As from `find_stick_slip`; events not flagged "ok" are left out.
    sample
        M, thickness, width, length and T*; the publication's by default.
    free_t_star
        Fit T* too, which is degenerate with the friction coefficient (correlation -0.999) and noted.

    Returns
    -------
    The parameters with errors, functions of separation, and goodness of fit.

    Raises
    ------
    InputError
        For a force over a weight, an unknown initial separation, fewer than six whole events, separations
        that are not between 0 and the sheets' length, or events that do not determine the parameters.

    Notes
    -----
    .. math:: F_p = \mathcal T(d_p; \mu, T^*) + \mathcal T_0, \quad
        \Delta F = A\, \mathcal N(d_v), \quad K = M_\mathrm{eff}(d_v; \hat N)\, \epsilon W Y_\mathrm{eff} / L

    The first fit gives the friction coefficient that the other two use. Peaks and drops scatter by a share of
    themselves and are weighted accordingly; K by its own error. Standard errors come from the deviations
    themselves (White's covariance), so they hold whatever the size of the scatter; the error of the friction
    coefficient is carried into A, N-hat and Y_eff.
    Source: paper, Eqs. 1 and 2, section on the effective number of sheets.
    """
    FORCE.check(force)
    _check_force(force)
    with np.errstate(all="ignore"):  # fits may stray; what comes out is checked
        try:
            fits = _fit_all(_usable(sticks, sample), sample, free_t_star)
        except InputError:
            raise
        except (ValueError, ArithmeticError, RuntimeError, np.linalg.LinAlgError) as error:
            raise _undetermined(str(error)) from error
    parts = (fits.mu, fits.t0_N, fits.amplitude, fits.n_hat_N, fits.modulus_GPa, fits.scale_mm)
    if not all(np.isfinite((part.value, part.error)).all() for part in parts):
        raise _undetermined("values or errors that are not finite")
    return fits


def _undetermined(reason: str) -> InputError:
    advice = "check `d0_mm`, and that the force was recorded while the blocks were pulled apart"
    return InputError("model fits", "events that follow the paper's model", f"others ({reason})", advice)


def _check_force(force: xr.Dataset) -> None:
    """Refuses a load that is no force, and separations counted from an unknown place."""
    if force["load_N"].attrs.get("units") == "1":
        raise InputError("model fits", "a force in N", "a force over a weight")
    facts = ForceMetadata.of(force)
    if facts.separation_from != "none" and np.isnan(facts.d0_mm):
        raise InputError("model fits", "the initial separation", "none", "give `d0_mm`")


def _usable(sticks: pd.DataFrame, sample: Sample) -> pd.DataFrame:
    """Whole events with everything the fits need."""
    needed = ["d_v_mm", "d_p_mm", "F_p_N", "dF_N", "K_N_per_mm"]
    if absent := [name for name in needed if name not in sticks]:
        raise InputError("model fits", f"columns {', '.join(needed)}", f"no {', '.join(absent)}")
    events: pd.DataFrame = sticks[sticks["flag"] == "ok"] if "flag" in sticks else sticks
    rising = (events["dF_N"] > 0) & (events["K_N_per_mm"] > 0)
    events = events.loc[rising & np.isfinite(events[needed].to_numpy(float)).all(axis=1)]
    if len(events) < _LEAST_EVENTS:
        raise InputError(
            "model fits",
            f"at least {_LEAST_EVENTS} whole events with d, F_p, dF and K",
            f"{len(events)} of {len(sticks)}",
            "lengths need a displacement or `speed_mm_min`",
        )
    low, high = float(events["d_v_mm"].min()), float(events["d_p_mm"].max())
    if low <= 0 or high >= sample.length_mm:
        raise InputError(
            "model fits",
            f"separations between 0 and {sample.length_mm:g} mm",
            f"{low:.3g} to {high:.3g} mm",
            "give the initial separation with `d0_mm`",
        )
    return events


def _fit_all(events: pd.DataFrame, given: Sample, free_t_star: bool) -> ModelFits:
    """The three fits one after the other, and what follows from them."""
    peaks = _fit_peaks(events, given, free_t_star)
    mu = peaks.estimate(0)
    t_star = Estimate(given.t_star_N, float("nan"))
    if free_t_star:
        t_star = replace(peaks.estimate(2), value=abs(float(peaks.value[2])))
    if not mu.value > mu.error:  # also where either is NaN
        raise _undetermined(f"friction coefficient {mu.value:.3g} ± {mu.error:.2g}")
    sample = replace(given, t_star_N=t_star.value)
    drops = _with_friction(lambda m: _fit_drops(events, sample, m), mu)
    stiffness = _with_friction(lambda m: _fit_stiffness(events, sample, m), mu)
    span = (float(events["d_v_mm"].min()), float(events["d_v_mm"].max()))
    scale, bending = _derived(stiffness, mu, sample, 0.5 * sum(span))
    return ModelFits(
        mu=mu,
        t0_N=peaks.estimate(1),
        t_star_N=t_star,
        amplitude=drops.estimate(0),
        n_hat_N=stiffness.estimate(0),
        modulus_GPa=stiffness.estimate(1),
        scale_mm=scale,
        bending_mm=bending,
        goodness={"peaks": peaks.goodness, "drops": drops.goodness, "stiffness": stiffness.goodness},
        correlation=_correlations(peaks, stiffness, free_t_star),
        d_mm=span,
        sample=given,
        notes=_notes(peaks, stiffness, span, scale, free_t_star),
    )


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


def _fit_peaks(events: pd.DataFrame, sample: Sample, free_t_star: bool) -> _Fit:
    """μ and 𝒯0, and T* if that is free, from the peak forces."""
    d, peak = events["d_p_mm"].to_numpy(float), events["F_p_N"].to_numpy(float)

    def model(q: Floats) -> Floats:
        assumed = replace(sample, t_star_N=max(abs(float(q[2])), 1e-12)) if free_t_star else sample
        return np.asarray(equations.traction(d, mu=max(q[0], 1e-3), sample=assumed) + q[1])

    trials = np.linspace(0.2, 2.0, 91)
    start = [0.0, 0.0, sample.t_star_N]
    misfit = [np.sum((model(np.array([mu, *start[1:]])) / peak - 1) ** 2) for mu in trials]
    start[0] = float(trials[int(np.argmin(misfit))])
    return _fit(model, peak, None, start if free_t_star else start[:2])


def _fit_drops(events: pd.DataFrame, sample: Sample, mu: float) -> _Fit:
    """A from the force drops."""
    d, drop = events["d_v_mm"].to_numpy(float), events["dF_N"].to_numpy(float)
    total = equations.total_normal_force(d, mu=mu, sample=sample)
    return _fit(lambda q: np.asarray(q[0] * total), drop, None, [float(np.median(drop / total))])


def _fit_stiffness(events: pd.DataFrame, sample: Sample, mu: float) -> _Fit:
    """N̂ and Y_eff from the stiffness."""
    d, k = events["d_v_mm"].to_numpy(float), events["K_N_per_mm"].to_numpy(float)
    sigma = _stiffness_errors(events)

    def model(q: Floats) -> Floats:
        return np.asarray(
            equations.assembly_stiffness(d, mu=mu, n_hat_N=np.exp(q[0]), modulus_GPa=q[1], sample=sample)
        )

    trials = np.geomspace(0.005, 20, 60)
    shape = [model(np.array([np.log(n_hat), 1.0])) for n_hat in trials]
    modulus = [float(np.sum(k * s / sigma**2) / max(np.sum((s / sigma) ** 2), 1e-300)) for s in shape]
    misfit = [np.sum(((k - y * s) / sigma) ** 2) for y, s in zip(modulus, shape, strict=True)]
    best = int(np.argmin(misfit))
    fit = _fit(model, k, sigma, [float(np.log(trials[best])), modulus[best]])
    # Fitted as log N̂, which keeps it positive; reported as N̂.
    turn = np.diag([np.exp(fit.value[0]), 1.0])
    value = np.array([np.exp(fit.value[0]), fit.value[1]])
    return _Fit(value, turn @ fit.covariance @ turn, fit.goodness)


def _stiffness_errors(events: pd.DataFrame) -> Floats:
    """Errors of K, each added to half the usual one: one luckily small error must not outweigh the rest."""
    error = np.full(len(events), np.nan)
    if "K_err_N_per_mm" in events:
        error = events["K_err_N_per_mm"].to_numpy(float)
    known: Bools = np.isfinite(error) & (error > 0)
    usual = float(np.median(error[known])) if known.any() else 1.0
    return np.hypot(np.where(known, error, usual), 0.5 * usual)


def _with_friction(fit: Callable[[float], _Fit], mu: Estimate) -> _Fit:
    """A fit at the fitted μ whose covariance carries the error of μ too."""
    centre = fit(mu.value)
    slope = (fit(mu.value + mu.error).value - fit(mu.value - mu.error).value) / 2
    return _Fit(centre.value, centre.covariance + np.outer(slope, slope), centre.goodness)


def _derived(stiffness: _Fit, mu: Estimate, sample: Sample, d_mm: float) -> tuple[Estimate, Estimate]:
    """(Λ̂, λ of the outermost sheet), errors carried through to first order."""

    def both(parameters: Floats) -> Floats:
        n_hat, modulus = parameters
        scale = equations.separation_scale_mm(mu=mu.value, n_hat_N=n_hat, sample=sample)
        outermost = sample.sheets_per_block
        bending = bending_length_mm(outermost, d_mm, n_hat_N=n_hat, modulus_GPa=modulus, sample=sample)
        return np.array([float(scale), float(bending)])

    centre = stiffness.value
    step = 1e-4 * np.diag(centre)
    slopes = np.column_stack(
        [(both(centre + move) - both(centre - move)) / (2 * move.sum()) for move in step]
    )
    scale, bending = both(centre).tolist()
    scale_error, bending_error = np.sqrt(np.diag(slopes @ stiffness.covariance @ slopes.T)).tolist()
    return Estimate(scale, scale_error), Estimate(bending, bending_error)


def _correlations(peaks: _Fit, stiffness: _Fit, free_t_star: bool) -> dict[str, float]:
    found = {"mu,T0_N": peaks.correlation(0, 1), "N_hat_N,Y_eff_GPa": stiffness.correlation(0, 1)}
    return found | ({"mu,T_star_N": peaks.correlation(0, 2)} if free_t_star else {})


def _notes(
    peaks: _Fit, stiffness: _Fit, span: tuple[float, float], scale: Estimate, free_t_star: bool
) -> tuple[str, ...]:
    """What limits the result."""
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
