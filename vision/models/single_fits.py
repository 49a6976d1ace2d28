"""Fits of one model each: peaks by Eq. 1, drops by A𝒩, stiffness by M_eff K_eff; and the classes of results.

All are weighted least squares with standard errors from the residuals.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from os import PathLike
from typing import Any

import numpy as np
import pandas as pd
import scipy
from numpy.typing import ArrayLike

from vision.data import Tunable, whole_events
from vision.errors import InputError
from vision.folder import Shown, numbered
from vision.models import equations
from vision.numeric import Bools, Floats, with_minus
from vision.sample import Sample

FIT_ERRORS = (ValueError, ArithmeticError, RuntimeError, np.linalg.LinAlgError)  # of a fit to unusual events
PARAMETERS = {
    "mu": "mu",
    "T0_N": "t0_N",
    "A": "amplitude",
    "N_hat_N": "n_hat_N",
    "Y_eff_GPa": "modulus_GPa",
    "Lambda_hat_mm": "scale_mm",
}
"""Names of the fitted parameters in models.json, and their fields in `ModelFits`."""
SYMBOLS = {
    "mu": ("μ", ""),
    "T0_N": ("𝒯_0", "N"),
    "A": ("A", ""),
    "N_hat_N": ("N̂", "N"),
    "Y_eff_GPa": ("Y_eff", "GPa"),
    "Lambda_hat_mm": ("Λ̂", "mm"),
}
"""Their symbols and units."""

SLOW_MM_MIN = 1.0
"""Pulling speed up to which the publication's models of A, N̂ and Y_eff hold."""


@dataclass(frozen=True, kw_only=True, repr=False)
class FitSettings(Tunable):
    """Tunable constants of the fits of the models; the tests named are in tests/models/test_fits.py."""

    least_events: int = 6
    """Fewest events that are fitted. Fewer leave no scatter to measure errors from; more refuse short
    recordings."""
    largest_offset_N: float = 10.0
    """Largest |𝒯0| that a load cell's zero may have, as in the publication. Larger lets pass a wrong d0 or
    unit as an offset; smaller warns of drifting load cells (`test_a_wrong_unit_is_named`)."""
    clear_offset: float = 5.0
    """𝒯0 over its error above which it differs significantly from 0."""
    large_offset: float = 0.1
    """𝒯0 over the usual peak above which an unknown error of d0 is a warning: drifts of load cells are at
    0.03, a d0 that is 3 mm off at 0.17."""
    drift_fall: float = 3.0
    """Fall of the peaks over a test, as a ratio, from which a drift of the load is told from μ and 𝒯0. Larger
    is silent about drifts that cancel 𝒯0 (`test_a_drift_that_cancels_the_offset_is_in_the_errors`)."""
    unlike_drops: float = 0.4
    """Relative scatter of the drops above which a warning is given: it is 0.05 to 0.2 in a test, 0.5 if half
    of them are small."""
    most_unfitted: float = 0.25
    """Share of the events that Eq. 1 may leave out after the build-up without a warning
    (`test_a_wrong_d0_is_a_warning_with_a_next_step`)."""
    contradicting_chi2: float = 3.0
    """χ²/dof above which a model contradicts its points. Smaller warns of slightly correlated scatter, whose
    errors are widened; larger keeps a note of a wrong geometry from being a warning."""
    largest_scale: float = 20.0
    """Largest Λ̂/d that is fitted; there K no longer decreases as M_eff does, and a warning says so."""


DEFAULT = FitSettings()


@dataclass(frozen=True)
class Estimate:
    """A value with its standard error and its systematic error; unknown errors are NaN."""

    value: float
    error: float
    systematic_error: float = float("nan")


UNKNOWN = Estimate(math.nan, math.nan)


def plus_minus(estimate: Estimate) -> str:
    """Return a value ± its standard error, to two digits of the error; four digits without an error."""
    value, error = estimate.value, estimate.error
    if not math.isfinite(error) or error <= 0:
        return with_minus(f"{value:.4g}")
    digits = max(0, 1 - math.floor(math.log10(error)))
    return with_minus(f"{value:.{digits}f} ± {error:.{digits}f}")


def both_errors(estimate: Estimate, contained: str = "stat.") -> str:
    """Return a value with its statistical and, if known, its systematic error, the smaller with two digits,
    or one where the larger would have more than three.  contained: what the first error contains."""
    systematic = estimate.systematic_error
    if not (math.isfinite(systematic) and systematic > 0):
        return plus_minus(estimate)
    known = [e for e in (estimate.error, systematic) if math.isfinite(e) and e > 0]
    least, most = (math.floor(math.log10(e)) for e in (min(known), max(known)))
    digits = max(0, -least, min(1 - least, 2 - most))
    error = f"{estimate.error:.{digits}f}" if math.isfinite(estimate.error) else "?"
    return with_minus(
        f"{estimate.value:.{digits}f} ± {error} ({contained}) ± {systematic:.{digits}f} (syst.)"
    )


@dataclass(frozen=True)
class Goodness:
    """Goodness of fit of one model."""

    points: int  # number of points
    scatter: float  # RMS of the relative deviation from the model
    # Mean square deviation over that expected from the scatter between neighbouring points, which does not
    # depend on the model: about 1 if the shape of the model is right, larger if it is not.
    chi2_dof: float


@dataclass(frozen=True, kw_only=True, repr=False)
class ModelFits(Shown):
    """Parameters of the paper's models for one recording, with standard errors."""

    mu: Estimate  # friction coefficient
    t0_N: Estimate  # offset of the peak forces
    t_star_N: Estimate  # T*; its error is NaN if it was not fitted
    amplitude: Estimate  # A
    n_hat_N: Estimate  # N-hat
    modulus_GPa: Estimate  # Y_eff
    scale_mm: Estimate  # Lambda-hat, where M_eff reaches 0
    bending_mm: Estimate  # bending length of the outermost sheet in the middle of the test
    goodness: dict[str, Goodness]  # of the fits to "peaks", "drops" and "stiffness"
    correlation: dict[str, float]  # of parameters that are fitted together
    d_mm: tuple[float, float]  # separation at the first and last event used
    sample: Sample  # as given
    # Drift of the load over the range of d, if the peaks have one; the fits assume none. NaN if not told.
    drift_N: Estimate = UNKNOWN
    notes: tuple[str, ...] = ()  # limitations of the result
    warnings: tuple[str, ...] = ()  # reasons why it may be wrong
    held: tuple[str, ...] = ()  # names of parameters that were given, not fitted
    # Names in models.json of parameters that the events do not determine. They keep the number at which the
    # fit stopped, which is no result; their errors are as large.
    undetermined: tuple[str, ...] = ()
    # Numbers of unused events by reason: "flagged", "build_up" (before the maximum of the peaks), "misfit"
    # (after it, before Eq. 1 fits) and "outside" the given range.
    left_out: Mapping[str, int] = field(default_factory=dict)
    # Given standard errors of d0 (``d0_mm``) and of fields of the sample.
    input_errors: Mapping[str, float] = field(default_factory=dict)
    # Contribution of each source of systematic error to each parameter; None where it is not known.
    budget: Mapping[str, Mapping[str, float | None]] = field(default_factory=dict)

    def named(self) -> dict[str, Estimate]:
        """Fitted parameters by their names in models.json."""
        return {name: getattr(self, part) for name, part in PARAMETERS.items()}

    def reduced_separation(self, d_mm: ArrayLike) -> Floats:
        """Separation divided by Lambda-hat, dimensionless."""
        return np.asarray(d_mm, float) / self.scale_mm.value

    def effective_sheets(self, d_mm: ArrayLike) -> Floats:
        """M_eff per side at d according to the force; 0 beyond Lambda-hat."""
        return equations.effective_sheets(self.reduced_separation(d_mm), sample=self.sample)

    def peak_force_N(self, d_mm: ArrayLike) -> Floats:
        """Fitted peak force, traction plus offset."""
        sample = replace(self.sample, t_star_N=self.t_star_N.value)
        return np.asarray(equations.traction(d_mm, mu=self.mu.value, sample=sample) + self.t0_N.value)

    def stiffness_N_per_mm(self, d_mm: ArrayLike) -> Floats:
        """Fitted stiffness K(d) = M_eff K_eff."""
        one = equations.sheet_stiffness(modulus_GPa=self.modulus_GPa.value, sample=self.sample)
        return np.asarray(self.effective_sheets(d_mm) * one)

    @property
    def chi2_dof(self) -> float:
        """Mean chi2_dof of the three fits."""
        return float(np.mean([good.chi2_dof for good in self.goodness.values()]))

    def text(self, name: str, unit: str = "") -> str:
        """Return a parameter, by its name in models.json, as a value with both errors and its unit, or "not
        determined"."""
        if name in self.undetermined:
            return "not determined"
        return f"{both_errors(getattr(self, PARAMETERS[name]))} {unit}".rstrip()

    def _shown(self) -> tuple[str, dict[str, str]]:
        shown = {symbol.replace("𝒯_0", "𝒯0"): (name, unit) for name, (symbol, unit) in SYMBOLS.items()}
        rows = {symbol: self.text(*parameter) for symbol, parameter in shown.items()}
        rows["d"] = f"{self.d_mm[0]:.2f} to {self.d_mm[1]:.2f} mm"
        rows |= {
            f"χ²/dof, {name}": f"{good.chi2_dof:.3g} ({good.points} points)"
            for name, good in self.goodness.items()
        }
        rows |= numbered("note", self.notes) | numbered("warning", self.warnings)
        return "models fitted to the force recording", rows

    def to_json(self) -> dict[str, Any]:
        """Return the content of models.json: values with errors, goodness of fit and sample."""
        named = self.named() | {"bending_length_mm": self.bending_mm, "load_drift_N": self.drift_N}
        if np.isfinite(self.t_star_N.error):
            named["T_star_N"] = self.t_star_N
        return {
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
            "held": self.held,
            "undetermined": self.undetermined,
            "events_left_out": dict(self.left_out),
            "input_errors": dict(self.input_errors),
            "budget": {source: dict(parts) for source, parts in self.budget.items()},
            "notes": self.notes,
            "warnings": self.warnings,
        }


# --- single fits --------------------------------------------------------------------------------------------


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
        """Correlation of parameters a and b; 0 if one has no error."""
        product = float(np.sqrt(self.covariance[a, a] * self.covariance[b, b]))
        return float(self.covariance[a, b]) / product if product > 0 else 0.0


def fit_weighted(
    model: Callable[[Floats], Floats],
    y: Floats,
    sigma: Floats | None,
    start: Sequence[float],
    *,
    held: Collection[int] = (),
) -> Fit:
    """Weighted least squares with White's covariance; without sigma, errors are a fraction of the model.

    held: indices of parameters that keep their start values and have no errors; all may be held.
    """
    value, width = np.array(start, float), np.abs(y) if sigma is None else sigma
    fitted = np.array([k not in held for k in range(value.size)])
    scale, jacobian = np.maximum(np.abs(value), 1e-3), np.zeros((y.size, fitted.sum()))

    def deviation(q: Floats, w: Floats) -> Floats:
        every = value.copy()
        every[fitted] = q
        return (model(every) - y) / w

    for _ in range(3 if sigma is None else 1):
        if fitted.any():
            found = scipy.optimize.least_squares(
                deviation, value[fitted], args=(width,), x_scale=scale[fitted], xtol=1e-12, ftol=1e-12
            )
            value[fitted], jacobian = found.x, np.asarray(found.jac, dtype=float)
        residual = deviation(value[fitted], width)
        if sigma is None:
            width = np.maximum(np.abs(model(value)), 1e-6 * float(np.abs(y).max()))
    bread = np.linalg.pinv(jacobian.T @ jacobian)
    meat = jacobian.T @ (jacobian * residual[:, np.newaxis] ** 2)
    free = max(y.size - int(fitted.sum()), 1)
    neighbours = float(np.sum(np.diff(residual) ** 2) / (2 * max(residual.size - 1, 1)))
    chi2 = float(np.sum(residual**2) / free / neighbours) if neighbours > 0 else float("nan")
    goodness = Goodness(int(y.size), float(np.sqrt(np.mean((y / model(value) - 1) ** 2))), chi2)
    # Residuals that are correlated from event to event count as fewer independent ones.
    widening = max(chi2, 1.0) if np.isfinite(chi2) else 1.0
    covariance = np.zeros((value.size, value.size))
    covariance[np.ix_(fitted, fitted)] = bread @ meat @ bread * (y.size / free * widening)
    return Fit(value, covariance, goodness, residual)


def fit_peaks(
    events: pd.DataFrame,
    sample: Sample,
    *,
    mu: float | None = None,
    free_t_star: bool = False,
    free_drift: bool = False,
) -> Fit:
    """Fit μ, unless it is given, 𝒯0 and, if they are free, T* and a drift of the load to the peak forces.

    The drift is linear in d, from 0 at the smallest separation to its value at the largest.
    """
    d, peak = events["d_p_mm"].to_numpy(float), events["F_p_N"].to_numpy(float)
    along = (d - d.min()) / max(float(np.ptp(d)), 1e-9)

    def force(friction: float, offset: float, t_star: float = sample.t_star_N, drift: float = 0.0) -> Floats:
        assumed = replace(sample, t_star_N=max(abs(t_star), 1e-12))
        steady = equations.traction(d, mu=max(friction, 1e-3), sample=assumed)
        return np.asarray(steady + offset + drift * along)

    trials = np.linspace(0.2, 2.0, 91) if mu is None else np.array([mu])
    width = np.maximum(np.abs(peak), 1e-3 * float(np.abs(peak).max()))
    rest = peak - np.array([force(trial, 0.0) for trial in trials.tolist()])
    offset = np.average(rest, axis=1, weights=width**-2.0)
    best = int(np.argmin((((rest - offset[:, np.newaxis]) / width) ** 2).sum(axis=1)))
    start = [float(trials[best]), float(offset[best]), sample.t_star_N, 0.0]
    held = [k for k, free in ((0, mu is None), (2, free_t_star), (3, free_drift)) if not free]
    return fit_weighted(lambda q: force(*q.tolist()), peak, None, start, held=held)


def fit_drops(events: pd.DataFrame, sample: Sample, mu: float) -> Fit:
    """Fit A to the force drops."""
    d, drop = events["d_v_mm"].to_numpy(float), events["dF_N"].to_numpy(float)
    total = equations.total_normal_force(d, mu=mu, sample=sample)
    return fit_weighted(lambda q: np.asarray(q[0] * total), drop, None, [float(np.mean(drop / total))])


def fit_stiffness(
    events: pd.DataFrame, sample: Sample, *, modulus_GPa: float | None = None, settings: FitSettings = DEFAULT
) -> Fit:
    """Fit Λ̂ and, unless it is given, Y_eff to the stiffness, K = M √(1 − d/Λ̂) ε W Y_eff / L, without μ."""
    d, k = events["d_v_mm"].to_numpy(float), events["K_N_per_mm"].to_numpy(float)
    sigma = stiffness_errors(events)

    def stiffness(scale: float, modulus: float) -> Floats:
        sheets = equations.effective_sheets(d / scale, sample=sample)
        return np.asarray(sheets * equations.sheet_stiffness(modulus_GPa=modulus, sample=sample))

    def model(q: Floats) -> Floats:
        """Return K; the fitted parameter is log Λ̂, which keeps Λ̂ positive."""
        return stiffness(float(np.exp(q[0])), float(q[1]))

    largest = settings.largest_scale * float(d.max())
    trials = np.geomspace(1.001 * d.min(), largest, 120)
    shapes = [stiffness(float(scale), 1.0) for scale in trials]
    modulus = [
        modulus_GPa or float(np.sum(k * s / sigma**2) / max(float(np.sum((s / sigma) ** 2)), 1e-300))
        for s in shapes
    ]
    misfit = [np.sum(((k - y * s) / sigma) ** 2) for y, s in zip(modulus, shapes, strict=True)]
    best = int(np.argmin(misfit))
    start = [float(np.log(trials[best])), modulus[best]]
    given = () if modulus_GPa is None else (1,)
    fit = fit_weighted(model, k, sigma, start, held=given)
    if fit.value[0] >= np.log(largest):
        fit = fit_weighted(model, k, sigma, [float(np.log(largest)), float(fit.value[1])], held=(0, *given))
        # Neither is determined: errors of log Λ̂ and Y_eff as large as Λ̂ and Y_eff themselves.
        fit.covariance[0, 0] = 1.0
        fit.covariance[1, 1] = 0.0 if given else float(fit.value[1]) ** 2
    scale = float(np.exp(fit.value[0]))
    jacobian = np.diag([scale, 1.0])
    covariance = jacobian @ fit.covariance @ jacobian
    return replace(fit, value=np.array([scale, fit.value[1]]), covariance=covariance)


def has_knees(events: pd.DataFrame) -> bool:
    """Return whether most whole stick phases have a knee, after which all sheets have gripped."""
    if "K2_N_per_mm" not in events:
        return False
    whole = events[whole_events(events["flag"])] if "flag" in events else events
    return bool(len(whole)) and float(np.isfinite(whole["K2_N_per_mm"].to_numpy(float)).mean()) > 0.5


def with_fitted_stiffness(events: pd.DataFrame) -> pd.DataFrame:
    """Return the events with the K that M_eff K_eff describes: the slope after the knee if there are knees.

    The slope of the central part then mixes the slopes before and after it.
    """
    if not has_knees(events):
        return events
    columns = {"K_N_per_mm": "K2_N_per_mm", "K_err_N_per_mm": "K2_err_N_per_mm"}
    return events.assign(**{name: events[after] for name, after in columns.items() if after in events})


NEEDED = ("d_v_mm", "d_p_mm", "F_p_N", "dF_N", "K_N_per_mm")
"""Columns of events that the fits use."""


def check_columns(events: pd.DataFrame, source: str | PathLike[str]) -> None:
    """Raise `InputError` for a table from `source` without all columns that the fits use."""
    if absent := [name for name in NEEDED if name not in events]:
        raise InputError(source, f"columns {', '.join(NEEDED)}", f"no {', '.join(absent)}")


def complete_events(events: pd.DataFrame) -> Bools:
    """Return which events are whole and have all that the fits use, with drop and stiffness above 0."""
    complete: Bools = np.isfinite(events[list(NEEDED)].to_numpy(float)).all(axis=1)
    complete &= (events[["dF_N", "K_N_per_mm"]].to_numpy(float) > 0).all(axis=1)
    return complete & whole_events(events["flag"]) if "flag" in events else complete


def stiffness_errors(events: pd.DataFrame) -> Floats:
    """Errors of K, with half the median error added in quadrature, so that no single event dominates."""
    error = np.full(len(events), np.nan)
    if "K_err_N_per_mm" in events:
        error = events["K_err_N_per_mm"].to_numpy(float)
    known: Bools = np.isfinite(error) & (error > 0)
    median = float(np.median(error[known] if known.any() else 0.05 * events["K_N_per_mm"]))
    error = np.where(known, error, median)
    return np.asarray(np.hypot(error, 0.5 * median), np.float64)


def low_speed(speed_mm_min: float) -> bool:
    """Return whether all models hold at a speed, which may be 5 % off as measured; also where it is NaN."""
    return not speed_mm_min > 1.05 * SLOW_MM_MIN


def with_friction(fit: Callable[[float], Fit], mu: Estimate) -> Fit:
    """Fit with this μ, and include the error of μ in the covariance."""
    centre = fit(mu.value)
    slope = (fit(mu.value + mu.error).value - fit(mu.value - mu.error).value) / 2
    return replace(centre, covariance=centre.covariance + np.outer(slope, slope))


def normal_force_at_scale(mu: float, scale_mm: float, sample: Sample) -> tuple[float, float, float, float]:
    """Return N̂, the normal force on the axis at d = Λ̂, and its derivatives by Λ̂, μ and T*."""
    alpha = float(equations.amplification(scale_mm, mu=mu, sample=sample))
    n_hat = float(equations.normal_force(0, scale_mm, mu=mu, sample=sample))
    by_log_alpha = sample.t_star_N / (2 * mu) * alpha * float(np.exp(alpha))
    return n_hat, -by_log_alpha / scale_mm, (by_log_alpha - n_hat) / mu, n_hat / sample.t_star_N
