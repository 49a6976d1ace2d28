"""Fits of the publication's models to stick-slip events: choice of events, fits, systematic errors."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from numbers import Real
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from vision.data import FORCE, ForceMetadata, StickMetadata, load_unit, whole_events
from vision.errors import InputError, check_kind, check_positive, shown
from vision.force.corners import AVERAGE_ERROR
from vision.force.signal import slope_error_of_steps, step_between
from vision.models import equations
from vision.models.single_fits import (
    DEFAULT,
    FIT_ERRORS,
    PARAMETERS,
    SLOW_MM_MIN,
    UNKNOWN,
    Estimate,
    Fit,
    FitSettings,
    ModelFits,
    check_columns,
    complete_events,
    fit_drops,
    fit_peaks,
    fit_stiffness,
    fit_weighted,
    low_speed,
    normal_force_at_scale,
    plus_minus,
    with_fitted_stiffness,
    with_friction,
)
from vision.numeric import Floats, sigma_about_zero, two_digits, with_minus
from vision.sample import LEAST_GPA, LEAST_MU, MOST_GPA, MOST_MU, PUBLISHED, Sample, is_plausible_modulus
from vision.signals import running_median

_SUSPECTS = "check `d0_mm`, the sample's geometry and the load's zero"
_GEOMETRY = ("thickness_mm", "width_mm", "length_mm", "t_star_N")


def fit_models(
    force: xr.Dataset,
    sticks: pd.DataFrame,
    sample: Sample = PUBLISHED,
    *,
    free_t_star: bool = False,
    mu: float | None = None,
    modulus_GPa: float | None = None,
    fit_range_mm: tuple[float, float] | None = None,
    geometry_err: Mapping[str, float] | None = None,
    settings: FitSettings = DEFAULT,
) -> ModelFits:
    r"""Fit μ and an offset to the peaks, A to the drops, and N-hat and Y_eff to the stiffness.

    Parameters
    ----------
    force
        From `read_force`. Its load must be in N and its initial separation known.
    sticks
        From `find_stick_slip`; events with a flag other than "slow" or "negative" are left out.
    sample
        M, thickness, width, length and T*; the publication's by default.
    free_t_star
        Whether to fit T* as well. It is degenerate with μ (correlation -0.999), which is noted.
    mu, modulus_GPa
        Known values of μ and Y_eff, which are then not fitted.
    fit_range_mm
        Separations (d_v) of the first and last event to use. By default the range begins at the maximum of
        the peaks or, if that is later, where Eq. 1 begins to fit: no event of the build-up follows it.
    geometry_err
        Errors of fields of the sample, such as ``{"thickness_mm": 0.002}``, for the systematic errors.
    settings
        See `FitSettings`.

    Returns
    -------
    The parameters with errors, functions of separation, and goodness of fit.

    Raises
    ------
    InputError
        If the load is a force over a weight, the initial separation is unknown, there are fewer than six
        complete events, separations are not between 0 and the length of the sheets, the stiffness is that of
        no material (a displacement in m read as mm), the events do not determine the parameters, or an
        argument is not positive.

    Notes
    -----
    .. math:: F_p = \mathcal T(d_p; \mu, T^*) + \mathcal T_0, \quad
        \Delta F = A\, \mathcal N(d_v), \quad K = M_\mathrm{eff}(d_v; \hat N)\, \epsilon W Y_\mathrm{eff} / L

    The first fit gives μ. K depends on μ and N-hat through Lambda-hat alone, so Lambda-hat and Y_eff are
    fitted and N-hat follows. Where sticks have a knee, K is the slope after it. Peaks and drops are weighted
    by their size, to which their scatter is proportional; K is weighted by its errors. Standard errors follow
    from the residuals (White's covariance), multiplied by the root of chi2_dof if that exceeds 1. Systematic
    errors are the changes of the parameters when d0 and the geometry change by their errors, and when the
    load cell drifts, over the test, by as much as T0 or as a term linear in d that fits the peaks beside T0
    (the larger one, at most 10 N). Source: paper, Eqs. 1 and 2, section on the effective number of sheets.
    """
    FORCE.check(force)
    check_kind(pd.DataFrame, "what `vision.find_stick_slip` returns", sticks=sticks)
    check_kind(Sample, "a `Sample`", sample=sample)
    if load_unit(force) == "1":
        raise InputError("the force recording", "a force in N", "a force over a weight")
    if ForceMetadata.of(force).lacks_d0:
        raise InputError("the force recording", "the initial separation", "none", "give `d0_mm`")
    check_positive(mu=mu, modulus_GPa=modulus_GPa)
    check_fit_range(fit_range_mm)
    given = _Given(sample, mu, modulus_GPa, free_t_star, settings)
    errors = dict(geometry_err or {})
    for name, value in errors.items():
        if name not in _GEOMETRY or not 0 <= value < np.inf:
            raise InputError("`geometry_err`", f"errors of {', '.join(_GEOMETRY)}", f"{name}: {value!r}")
    complete = _complete_events(sticks, given, force)
    unit_doubt = _doubtful_units(complete, sample, force)
    with np.errstate(all="ignore"):  # fits may diverge; their results are checked
        try:
            events, left_out = _choose_events(complete, given, fit_range_mm)
            fits = replace(_fit_all(events, given), drift_N=given.drift(events))
        except InputError as error:
            if unit_doubt and not error.is_of_argument:
                error.advice = "; ".join(filter(None, (error.advice, unit_doubt)))
            raise
        except FIT_ERRORS as error:
            raise _undetermined("a fit that does not converge", unit_doubt) from error
        if not all(np.isfinite((one.value, one.error)).all() for one in fits.named().values()):
            held = "" if mu is None and modulus_GPa is None else "check `mu` and `modulus_GPa`"
            raise _undetermined("values or errors that are not finite", held or unit_doubt)
        left_out = {"flagged": len(sticks) - len(complete)} | left_out
        fits = _with_systematics(fits, force, events, given, errors)
        misread = _misread_lengths(fits, complete, given, force)
        if abs(fits.t0_N.value) > float(events["F_p_N"].abs().max()):
            reason = f"an offset 𝒯0 of {with_minus(f'{fits.t0_N.value:.2g}')} N, larger than the peaks"
            raise _undetermined(reason, misread or unit_doubt)
    remarks = list(_remarks(fits, force, left_out, float(events["F_p_N"].median()), settings))
    d0_err = ForceMetadata.of(force).d0_err_mm
    return replace(
        fits,
        left_out=left_out,
        input_errors=errors | ({"d0_mm": d0_err} if np.isfinite(d0_err) else {}),
        notes=tuple(line for line, warns in remarks if not warns),
        warnings=(
            *filter(None, (unit_doubt or _doubtful_sample(fits), misread)),
            *(line for line, warns in remarks if warns),
        ),
    )


@dataclass(frozen=True)
class _Given:
    """What is known: the sample, parameters (None: to be fitted), whether T* is fitted, and the settings."""

    sample: Sample
    mu: float | None
    modulus_GPa: float | None
    free_t_star: bool
    settings: FitSettings

    @property
    def held(self) -> tuple[str, ...]:
        """Known parameters by their field in `ModelFits`."""
        return tuple(name for name in ("mu", "modulus_GPa") if getattr(self, name) is not None)

    def fit_peaks(self, events: pd.DataFrame) -> Fit:
        """Fit Eq. 1 with the T* of the sample, which suffices to judge whether it describes the peaks."""
        return fit_peaks(events, self.sample, mu=self.mu)

    def fit_drift(self, events: pd.DataFrame, peaks: Fit) -> Fit | None:
        """Fit Eq. 1 and a drift of the load; None where the peaks fall too little to tell them apart.
        peaks: the fit without drift."""
        mu, offset, *_ = peaks.value.tolist()
        ends = events["d_p_mm"].agg(["min", "max"])
        first, last = equations.traction(ends, mu=max(mu, 1e-3), sample=self.sample) + offset
        if not first > self.settings.drift_fall * last > 0:
            return None
        return fit_peaks(events, self.sample, mu=self.mu, free_drift=True)

    def drift(self, events: pd.DataFrame) -> Estimate:
        """Return the drift of the load over the test, N; NaN where it cannot be told."""
        fit = self.fit_drift(events, self.fit_peaks(events))
        return fit.estimate(3) if fit else UNKNOWN


def _undetermined(reason: str, advice: str = "") -> InputError:
    """Error for events that do not determine the parameters."""
    advice = advice or "check `d0_mm`, and that the force was recorded while the blocks were pulled apart"
    return InputError(
        "the force recording", "events that follow the paper's model", f"others ({reason})", advice
    )


def _read_as(force: xr.Dataset) -> str:
    """Advice to check the units, with the columns that were read."""
    advice = "check the units of displacement and load"
    if not (columns := ForceMetadata.of(force).columns):
        return advice
    states_them = "`force_columns` displacement=NAME:m,load=NAME:kN states them"
    return f"{advice}, read as {'; '.join(columns)} ({states_them})"


def _doubtful_units(events: pd.DataFrame, sample: Sample, force: xr.Dataset) -> str:
    """Why the units are doubtful, "" if they are not. The modulus of the sheets is at least the one at which
    all M sheets together have the stiffness K. InputError is raised if no material has it, or if events are
    closer than a crosshead can resolve."""
    distance = float(np.ptp(events["d_v_mm"])) / (len(events) - 1)
    if distance < 1e-4:  # below the resolution of any crosshead
        wanted, found = "events at least 0.1 µm apart", f"{1e3 * distance:.2g} µm"
        raise InputError("the force recording", wanted, found, _read_as(force))
    k = float(events["K_N_per_mm"].median())
    least = k * sample.length_mm / (1000 * sample.sheets_per_block * sample.thickness_mm * sample.width_mm)
    found = f"K of {k:.3g} N/mm, which needs sheets of {least:.2g} GPa"
    if least > 1000:  # the modulus of diamond
        raise InputError("the force recording", "sheets of less than 1000 GPa", found, _read_as(force))
    return "" if is_plausible_modulus(least) else f"{found} or more: {_read_as(force)}"


def _doubtful_sample(fits: ModelFits) -> str:
    """Why the sizes of the sample are doubtful, "" if they are not: μ or the modulus is not that of sheets.

    A wrong size changes only these two, which occur in the equations as μ ε M² and ε W Y_eff / L.
    """
    lines = []
    for one, names, (least, most), what in (
        (fits.mu, {"mu"}, (LEAST_MU, MOST_MU), "μ of {:.2g} is not in the {:g} to {:g} of sheets"),
        (
            fits.modulus_GPa,
            {"Y_eff_GPa", "modulus_GPa"},
            (LEAST_GPA, MOST_GPA),
            "Y_eff of {:.2g} GPa is not in the {:g} to {:g} GPa of paper and films",
        ),
    ):
        known = not names & {*fits.undetermined, *fits.held}
        if known and not (one.value - 2 * one.error < most and one.value + 2 * one.error > least):
            lines.append(what.format(one.value, least, most))
    sizes = "check `sheets_per_block`, `thickness_mm`, `width_mm` and `length_mm`"
    return f"{' and '.join(lines)}: {sizes}" if lines else ""


def _misread_lengths(fits: ModelFits, events: pd.DataFrame, given: _Given, force: xr.Dataset) -> str:
    """Warning that Eq. 1 fits only if the displacement is in another unit than mm; "" if that is not so.
    InputError is raised instead if the file states no unit, so that mm was a guess."""
    facts, chi2 = ForceMetadata.of(force), fits.goodness["peaks"].chi2_dof
    worst, largest_N = given.settings.contradicting_chi2, given.settings.largest_offset_N
    if not (chi2 > worst and abs(fits.t0_N.value) > largest_N and np.isfinite(facts.d0_mm)):
        return ""
    for unit, mm in (("cm", 10.0), ("inch", 25.4), ("m", 1000.0)):
        lengths = {name: facts.d0_mm + mm * (events[name] - facts.d0_mm) for name in ("d_v_mm", "d_p_mm")}
        read = events.assign(**lengths, K_N_per_mm=events["K_N_per_mm"] / mm)
        try:
            peaks = given.fit_peaks(_choose_events(read, given, None)[0])
        except FIT_ERRORS:
            continue
        if peaks.goodness.chi2_dof < worst and abs(peaks.value[1]) < largest_N:
            found = f"𝒯0 = {fits.t0_N.value:.3g} N and χ²/dof {chi2:.3g} with displacement in mm; in {unit} "
            found += f"it agrees (μ = {peaks.value[0]:.3g}, 𝒯0 = {peaks.value[1]:.2g} N)"
            if facts.displacement_unit == "assumed":
                advice = f"the file states no unit: give `force_columns` displacement=NAME:{unit}"
                raise InputError("the force recording", "peaks that agree with Eq. 1", found, advice)
            return f"the unit of the displacement contradicts Eq. 1: {found}"
    return ""


def _complete_events(sticks: pd.DataFrame, given: _Given, force: xr.Dataset) -> pd.DataFrame:
    """Return the complete events with all that the fits need; raise InputError if they are too few."""
    check_columns(sticks, "the force recording")
    events = with_fitted_stiffness(sticks)
    events = events[complete_events(events)]
    if len(events) < given.settings.least_events:
        d = force["d_mm"].values
        advice = "lengths need a displacement or `speed_mm_min`"
        if np.isfinite(d).any():
            advice = f"the separation changes by {np.nanmax(d) - np.nanmin(d):.3g} mm: {_read_as(force)}"
        if "flag" in sticks and len(sticks) - whole_events(sticks["flag"]).sum() > len(events):
            advice = "most have a flag, which tells why"
        wanted = f"at least {given.settings.least_events} whole events with d, F_p, dF and K"
        raise InputError("the force recording", wanted, f"{len(events)} of {len(sticks)}", advice)
    low, high = float(events["d_v_mm"].min()), float(events["d_p_mm"].max())
    from_zero = low < 0.1 * high  # no pull makes the separation ten times as large
    if from_zero or high >= given.sample.length_mm:
        raise InputError(
            "the force recording",
            f"separations between 0 and {given.sample.length_mm:g} mm, well above 0",
            f"{low:.5g} to {high:.5g} mm{', as of a displacement that begins at 0' if from_zero else ''}",
            f"give the initial separation with `d0_mm`, check `length_mm`, or {_read_as(force)}",
        )
    return events


# --- choice of events ---------------------------------------------------------------------------------------


def _choose_events(
    events: pd.DataFrame, given: _Given, fit_range: tuple[float, float] | None
) -> tuple[pd.DataFrame, dict[str, int]]:
    """The events to fit, and the numbers of those left out by reason."""
    if fit_range is not None:
        inside = events["d_v_mm"].between(*fit_range)
        if inside.sum() < given.settings.least_events:
            found = f"{inside.sum()} of {len(events)}, which lie between "
            found += f"{events['d_v_mm'].min():.4g} and {events['d_v_mm'].max():.4g} mm"
            raise InputError("`fit_range_mm`", f"at least {given.settings.least_events} events within", found)
        return events[inside], {"outside": int((~inside).sum())}
    top = _maximum(events["F_p_N"].to_numpy(float), given.settings.least_events)
    start = _first_that_fits(events, given, top)
    return events.iloc[start:], {"build_up": top, "misfit": start - top}


def check_fit_range(fit_range_mm: Any) -> None:
    """Raise `InputError` for a range of separations that is not two increasing numbers or None."""
    if fit_range_mm is None:
        return
    pair = fit_range_mm if isinstance(fit_range_mm, tuple | list) else ()
    numbers = len(pair) == 2 and all(isinstance(end, Real) for end in pair)
    if not (numbers and 0 <= pair[0] < pair[1] < math.inf):
        raise InputError("`fit_range_mm`", "two separations A < B in mm", shown(fit_range_mm))


def _maximum(peaks: Floats, least: int) -> int:
    """Index of the largest peak, smoothed over seven; 0 if the rise to it is not beyond the scatter, or fewer
    than `least` follow."""
    smooth = running_median(peaks, min(7, peaks.size), ends="symmetric")
    top = int(np.argmax(smooth))
    scatter = float(sigma_about_zero(np.diff(peaks))) / np.sqrt(2)
    rise = smooth[top] - np.median(peaks[: max(min(3, top), 1)])
    return top if rise > 3 * scatter and peaks.size - top >= least else 0


def _first_that_fits(events: pd.DataFrame, given: _Given, top: int) -> int:
    """Index of the first event from which Eq. 1 fits the peaks, at the beginning and over the whole range.

    Starts from the maximum of the peaks (`top`) to half of the later events are tried. If none fits, they are
    tried less strictly, so that peaks with slightly correlated scatter do not leave in the whole build-up; if
    still none fits, the result is `top`.
    """
    count = len(events) - top
    steps = np.r_[0.0, np.geomspace(0.01, 0.5, 12)] * count
    misfits: dict[int, float] = {}  # χ²/dof − 1 over its limit, by start; only where the first peaks fit
    for start in top + np.unique(steps.astype(np.int64)):
        part = events.iloc[int(start) :]
        if len(part) < given.settings.least_events:
            break
        fit = given.fit_peaks(part)
        fit = given.fit_drift(part, fit) or fit
        first = fit.residual[: max(5, len(part) // 20)]
        noise = np.sqrt(np.mean(np.diff(fit.residual) ** 2) / 2)
        if abs(float(first.mean())) < 2 * noise / np.sqrt(first.size):
            misfits[int(start)] = (fit.goodness.chi2_dof - 1) / (_largest_chi2(len(part)) - 1)
            if misfits[int(start)] < 1:
                break
    for limit in (1, 2):
        fitting = [start for start, misfit in misfits.items() if misfit < limit]
        if fitting:
            return _end_of_build_up(events, given, fitting[0]) if fitting[0] else 0
    return top


def _largest_chi2(points: int) -> float:
    """Upper limit of the chi2_dof of a correct model: three standard errors of a ratio of two variances."""
    return float(1 + 3 / np.sqrt(points))


def _end_of_build_up(events: pd.DataFrame, given: _Given, start: int) -> int:
    """First event from which the rest of a build-up changes μ and 𝒯0 by at most a tenth of their errors. The
    build-up is modelled as exponential. Noise hides its last part, which still biases the fit. Its length
    follows from its beginning, and its effect on each parameter from the linearised fit."""
    d, peak = events["d_p_mm"].to_numpy(float), events["F_p_N"].to_numpy(float)
    after = given.fit_peaks(events.iloc[start:])

    def steady(mu: float, t0: float) -> Floats:
        return np.asarray(equations.traction(d, mu=max(mu, 1e-3), sample=given.sample) + t0)

    expected = steady(*after.value[:2])
    # At the very beginning the scatter relative to the force differs from that of the later peaks.
    first = int(np.argmax(peak > 0.5 * expected))

    def missing_share(q: Floats) -> Floats:
        """Share of the steady force that is not built up yet, at most 1, with length exp(q[2])."""
        return np.asarray(np.exp(-np.exp(q[3]) - (d - d[first]) / np.exp(q[2])))

    def model(q: Floats) -> Floats:
        return (steady(q[0], q[1]) * (1 - missing_share(q)))[first:]

    missing = max(1 - float(peak[first] / expected[first]), 0.01)
    length = max(float(d[start] - d[first]) / 4, float(np.ptp(d)) / 1000)
    guess = [*after.value[:2], np.log(length), np.log(-np.log(missing))]
    fit = fit_weighted(model, peak[first:], None, guess)
    share, force = missing_share(fit.value), steady(*fit.value[:2])
    by_mu = (steady(fit.value[0] * 1.001, fit.value[1]) - force) / (0.001 * fit.value[0])
    by_t0 = np.ones_like(d)
    slopes = np.array([by_t0] if given.mu is not None else [by_mu, by_t0]).T / force[:, np.newaxis]
    latest = d.size - max(2 * given.settings.least_events, d.size // 4)
    for begin in range(start, latest):
        inverse = np.linalg.pinv(slopes[begin:])
        error = fit.goodness.scatter * np.sqrt(np.sum(inverse**2, axis=1))
        if (np.abs(inverse @ share[begin:]) <= 0.1 * error).all():
            return begin
    return max(start, latest)


# --- the fits -----------------------------------------------------------------------------------------------


def _fit_all(events: pd.DataFrame, given: _Given) -> ModelFits:
    """Run the three fits one after the other, and derive N̂ and the bending length."""
    peaks = fit_peaks(events, given.sample, mu=given.mu, free_t_star=given.free_t_star)
    mu, t0 = peaks.estimate(0), peaks.estimate(1)
    t_star = Estimate(abs(float(peaks.value[2])), peaks.estimate(2).error if given.free_t_star else math.nan)
    if not mu.value > mu.error:  # also where either is NaN
        known = f" ± {two_digits(mu.error)}" if mu.error > 0 else ", its error not determined"
        raise _undetermined(f"friction coefficient {with_minus(f'{mu.value:.3g}')}{known}")
    sample = replace(given.sample, t_star_N=t_star.value)
    drops = with_friction(lambda m: fit_drops(events, sample, m), mu)
    stiffness = fit_stiffness(events, sample, modulus_GPa=given.modulus_GPa, settings=given.settings)
    span = (float(events["d_v_mm"].min()), float(events["d_v_mm"].max()))
    undetermined: tuple[str, ...] = ()
    if float(stiffness.value[0]) > 0.999 * given.settings.largest_scale * span[1]:  # Λ̂ at its limit
        undetermined = ("Lambda_hat_mm", "N_hat_N", "bending_length_mm")
        undetermined += ("Y_eff_GPa",) if given.modulus_GPa is None else ()
    n_hat, bending, correlation = _derived(stiffness, peaks, sample, given.free_t_star, 0.5 * sum(span))
    return ModelFits(
        mu=mu,
        t0_N=t0,
        t_star_N=t_star,
        amplitude=drops.estimate(0),
        n_hat_N=n_hat,
        modulus_GPa=stiffness.estimate(1),
        scale_mm=stiffness.estimate(0),
        bending_mm=bending,
        goodness={"peaks": peaks.goodness, "drops": drops.goodness, "stiffness": stiffness.goodness},
        correlation=correlation,
        d_mm=span,
        sample=given.sample,
        held=given.held,
        undetermined=undetermined,
    )


def _derived(
    stiffness: Fit, peaks: Fit, sample: Sample, free_t_star: bool, d_mm: float
) -> tuple[Estimate, Estimate, dict[str, float]]:
    """N̂, λ of the outermost sheet, and all correlations, with errors propagated to first order."""
    scale, modulus = stiffness.value.tolist()
    n_hat, by_scale, by_mu, by_t_star = normal_force_at_scale(float(peaks.value[0]), scale, sample)
    of_n_hat = np.array([by_scale, 0.0, by_mu, by_t_star])  # by Λ̂, Y_eff, μ and T*
    of_modulus = np.array([0.0, 1.0, 0.0, 0.0])
    outermost = sample.sheets_per_block
    bending = equations.bending_length_mm(outermost, d_mm, n_hat_N=n_hat, modulus_GPa=modulus, sample=sample)
    of_bending = float(bending) / 2 * (of_modulus / modulus - of_n_hat / n_hat)
    covariance = np.zeros((4, 4))
    covariance[:2, :2] = stiffness.covariance
    covariance[2:, 2:] = peaks.covariance[np.ix_([0, 2], [0, 2])]
    jacobian = np.array([of_n_hat, of_bending, of_modulus])
    propagated = jacobian @ covariance @ jacobian.T
    errors = np.sqrt(np.diag(propagated)).tolist()
    product = errors[0] * errors[2]
    correlation = {"mu,T0_N": peaks.correlation(0, 1), "Lambda_hat_mm,Y_eff_GPa": stiffness.correlation(0, 1)}
    correlation |= {"mu,T_star_N": peaks.correlation(0, 2)} if free_t_star else {}
    correlation["N_hat_N,Y_eff_GPa"] = float(propagated[0, 2] / product) if product > 0 else 0.0
    return Estimate(n_hat, errors[0]), Estimate(float(bending), errors[1]), correlation


# --- systematic errors --------------------------------------------------------------------------------------


def _with_systematics(
    fits: ModelFits, force: xr.Dataset, events: pd.DataFrame, given: _Given, geometry: Mapping[str, float]
) -> ModelFits:
    """Add a budget of systematic errors, by repeating the fits with each source changed by its error."""
    d0_err = ForceMetadata.of(force).d0_err_mm
    # A drift may cancel the offset that the load cell's zero would leave: then only the drift itself shows.
    drift = max(abs(fits.t0_N.value), fits.t0_N.error, abs(fits.drift_N.value))
    drift = min(drift, given.settings.largest_offset_N)
    span = max(fits.d_mm[1] - fits.d_mm[0], 1e-9)

    def refit(changed: pd.DataFrame, sample: Sample = fits.sample) -> dict[str, float]:
        stiffness = {"K_N_per_mm": float(changed["K_N_per_mm"].median())}
        try:
            found = _fit_all(changed, replace(given, sample=sample))
        except FIT_ERRORS:
            return dict.fromkeys(PARAMETERS, float("nan")) | stiffness
        return {name: one.value for name, one in found.named().items()} | stiffness

    def by(change: Callable[[float], dict[str, float]], error: float) -> dict[str, float | None]:
        """Half the difference between the fits with a source changed by plus and by minus its error."""
        for share in (1.0, 0.1):  # a part of an error with which nothing can be fitted, in proportion
            plus, minus = change(share * error), change(-share * error)
            moved = [abs(plus[name] - minus[name]) / (2 * share) for name in plus]
            if np.isfinite(moved).all():
                break
        return dict(zip(plus, moved, strict=True))

    def shifted(d_mm: float) -> dict[str, float]:
        return refit(events.assign(d_v_mm=events["d_v_mm"] + d_mm, d_p_mm=events["d_p_mm"] + d_mm))

    def drifted(load_N: float) -> dict[str, float]:
        # The drift grows linearly from 0 at the first event to `load_N` at the last.
        ramp = load_N * (events["d_p_mm"] - events["d_p_mm"].min()) / span
        slope = events["K_N_per_mm"] + load_N / span
        return refit(events.assign(F_p_N=events["F_p_N"] + ramp, K_N_per_mm=slope))

    def resized(name: str) -> Callable[[float], dict[str, float]]:
        size = getattr(fits.sample, name)
        return lambda by_mm: refit(events, replace(fits.sample, **{name: size + by_mm}))

    unknown: dict[str, float | None] = dict.fromkeys((*PARAMETERS, "K_N_per_mm"))
    budget = {"d0": by(shifted, d0_err) if np.isfinite(d0_err) else unknown}
    by_drift = by(drifted, drift)
    budget["load_drift"] = by_drift | {"T0_N": max(drift, by_drift["T0_N"] or 0.0)}
    budget |= _coarse_displacement(force, events, refit)
    budget |= _unresolved_corners(fits, force, events, refit)
    budget |= {name: by(resized(name), error) for name, error in geometry.items()}

    def systematic(name: str, estimate: Estimate) -> Estimate:
        parts = [part for source in budget.values() if (part := source[name]) is not None]
        return replace(estimate, systematic_error=float(np.sqrt(np.sum(np.square(parts)))))

    changed = {PARAMETERS[name]: systematic(name, one) for name, one in fits.named().items()}
    return replace(fits, budget=budget, **changed)  # type: ignore[arg-type]


def _coarse_displacement(
    force: xr.Dataset, events: pd.DataFrame, refit: Callable[[pd.DataFrame], dict[str, float]]
) -> dict[str, dict[str, float | None]]:
    """Part of the budget from steps of the displacement, which make K too small or too large, more so in
    short sticks; empty where they change it by less than a thousandth."""
    way_mm = StickMetadata.of(events).central_part * (events["d_p_mm"] - events["d_v_mm"]).to_numpy(float)
    share = slope_error_of_steps(step_between(force["d_mm"].to_numpy()), way_mm)
    if not np.nanmedian(share) > 1e-3:
        return {}
    # K is a quotient: it is also too large or small on average, the more so the larger its error is.
    bias = share * (1 + 3 * share) / 4
    k = events["K_N_per_mm"]
    plus, minus = (refit(events.assign(K_N_per_mm=k * (1 + part * bias))) for part in (0.5, -0.5))
    return {"steps": {name: abs(plus[name] - minus[name]) for name in plus}}


def _unresolved_corners(
    fits: ModelFits,
    force: xr.Dataset,
    events: pd.DataFrame,
    refit: Callable[[pd.DataFrame], dict[str, float]],
) -> dict[str, dict[str, float | None]]:
    """Part of the budget from valleys and peaks that the low-pass and the sampling round off."""
    by_sampling = _drop_lost_by_sampling(force, events)
    facts, amplitude = StickMetadata.of(events), abs(fits.amplitude.value)
    of_drop, of_k = abs(facts.lowpass_dF_share), abs(facts.lowpass_K_share)

    none: dict[str, float | None] = dict.fromkeys((*PARAMETERS, "K_N_per_mm"), 0.0)

    def changes(**columns: pd.Series[float]) -> dict[str, float | None]:
        found = refit(events.assign(**columns))
        return none | {name: abs(found[name] - one.value) for name, one in fits.named().items()}

    # As in the errors of the events, but all alike: a filter may have lengthened the slips, or both corners
    # of a stick, in squares, err by the average.
    of_average = 1.4 * AVERAGE_ERROR * facts.average_s
    source, length_s = ("filter", facts.filter_s) if facts.filter_s else ("average", of_average)
    if length_s:
        # The stick rises on while the load still falls: both corners are off, together by this length.
        cut = events["dF_N"] * length_s / (events["t_p_s"] - events["t_v_s"])
        by_filter = changes(F_p_N=events["F_p_N"] + cut / np.sqrt(2), dF_N=events["dF_N"] + cut)
        # The rise during the slip is the same loss, measured after the valley.
        by_filter["A"] = max(by_filter["A"] or 0.0, amplitude * abs(by_sampling))
        return {source: _larger(by_filter, _settling(fits, facts.central_part, events, refit))}
    if not (of_drop or of_k):
        return {"sampling": none | {"A": amplitude * abs(by_sampling)}} if by_sampling else {}
    # Both make the valleys too shallow, so the errors add linearly.
    # K loses more in short sticks, which come late in a test, so that Λ̂ changes more than K does.
    k = events["K_N_per_mm"].fillna(0.0)
    by_lowpass = changes(
        F_p_N=events["F_p_N"] + k * facts.lowpass_peak_mm,
        K_N_per_mm=k * (1 + events["K_lowpass_share"].fillna(0.0)),
    )
    by_lowpass |= {
        "A": amplitude * (of_drop + abs(by_sampling)),
        "K_N_per_mm": abs(float(events["K_N_per_mm"].median())) * of_k,
    }
    if facts.lowpass_doubt == "shape":
        by_lowpass = _larger(by_lowpass, _settling(fits, facts.central_part, events, refit))
    return {"low_pass": by_lowpass}


def _larger(first: Mapping[str, float | None], second: Mapping[str, float | None]) -> dict[str, float | None]:
    return {name: max(one or 0.0, second.get(name) or 0.0) for name, one in first.items()}


def _settling(
    fits: ModelFits, part: float, events: pd.DataFrame, refit: Callable[[pd.DataFrame], dict[str, float]]
) -> dict[str, float | None]:
    """What an unknown filter, or ringing, may change, after which the load settles within the sticks: as much
    as the fit to the slopes of their central 30 % differs from that to the central `part`, noise aside."""
    later = refit(events.assign(K_N_per_mm=events["K30_N_per_mm"]))
    noise = (part / 0.3) ** 3 - 1  # variance that the narrower part adds, over that of the whole
    return {
        name: float(np.sqrt(max((later[name] - one.value) ** 2 - noise * one.error**2, 0.0)))
        for name, one in fits.named().items()
        if np.isfinite(later[name])
    }


def _drop_lost_by_sampling(force: xr.Dataset, events: pd.DataFrame) -> float:
    """Median share of ΔF by which the force rises again during a slip; 0 if sticks are straight.

    In sticks with a knee, or that begin steeply, the force rises fastest right after a slip. The rise before
    the recorded valley is lost: it lasts as long as the slip and the delay of the load cell, at least one
    sample. At the lowest sample the rise and the tail of a low-pass cancel, so the next two steps count too.
    """
    facts = StickMetadata.of(events)
    if not facts.two_slopes and not facts.bend_share < 0:
        return 0.0
    time, load = force["time_s"].values, force["load_N"].values
    near = np.searchsorted(time, events["t_v_s"].to_numpy(float))[:, np.newaxis] + np.arange(-3, 4)
    near = np.clip(near, 0, load.size - 4)
    lowest = np.take_along_axis(near, np.argmin(load[near], axis=1)[:, np.newaxis], axis=1)[:, 0]
    slip_s = events["slip_time_s"].to_numpy(float) + np.nan_to_num(facts.lowpass_proposed_s)
    samples = np.maximum(slip_s / (time[lowest + 1] - time[lowest]), 1)
    rise = np.fmax(load[lowest + 1] - load[lowest], (load[lowest + 3] - load[lowest + 1]) / 2) * samples
    share = float(np.nanmedian(rise / events["dF_N"].to_numpy(float)))
    return share if np.isfinite(share) else 0.0


# --- notes and warnings -------------------------------------------------------------------------------------


def _limits(fits: ModelFits, left_out: Mapping[str, int]) -> Iterator[str]:
    """Yield notes on degenerate parameters, the range of d, and the events used."""
    used = fits.goodness["peaks"].points
    of_scale = fits.correlation["Lambda_hat_mm,Y_eff_GPa"]
    degenerate = {"T* and μ": fits.correlation.get("mu,T_star_N")}
    degenerate |= {"Λ̂ and Y_eff": of_scale} if abs(of_scale) > 0.98 else {}
    for names, correlation in degenerate.items():
        if correlation is not None:
            yield with_minus(
                f"{names} are degenerate (correlation {correlation:.3f}): use them only together"
            )
    if fits.d_mm[1] > fits.scale_mm.value:
        yield f"d goes beyond {fits.scale_mm.value:.2f} mm, where M_eff is 0"
    reasons = {"build_up": "of the build-up", "misfit": "after the build-up, before Eq. 1 fits"}
    if without := [f"{left_out[name]} {reason}" for name, reason in reasons.items() if left_out.get(name)]:
        span = f"from d = {fits.d_mm[0]:.2f} to {fits.d_mm[1]:.2f} mm"
        yield f"fitted to {used} events {span}, without {' and '.join(without)} (`fit_range_mm`)"
    elif "outside" in left_out:
        yield f"fitted to {used} events in the given range, {left_out['outside']} are outside"


def _remarks(
    fits: ModelFits, force: xr.Dataset, left_out: Mapping[str, int], peak_N: float, settings: FitSettings
) -> Iterator[tuple[str, bool]]:
    """Yield remarks on the events used, the misfit, the offset, the speed and the systematic errors, and
    whether each is a warning.  peak_N: the usual F_p."""
    used, facts = fits.goodness["peaks"].points, ForceMetadata.of(force)
    for note in _limits(fits, left_out):
        yield note, False
    unfitted, all_events = left_out.get("misfit", 0), used + sum(left_out.values())
    if unfitted > settings.most_unfitted * all_events:
        line = f"Eq. 1 does not fit {unfitted} of {all_events} events, those at the smaller separations"
        yield f"{line} after the build-up, which are left out: {_SUSPECTS}", True
    for name, good in fits.goodness.items():
        if good.chi2_dof > _largest_chi2(good.points):
            line = f"the model does not follow the {name} (χ²/dof {good.chi2_dof:.3g}): "
            line += f"errors widened {two_digits(np.sqrt(good.chi2_dof))} times; {_SUSPECTS}"
            yield line, good.chi2_dof > settings.contradicting_chi2
    yield from _offset_remarks(fits.t0_N, peak_N, facts.d0_err_mm, settings)
    if abs(fits.drift_N.value) > max(settings.clear_offset * fits.drift_N.error, abs(fits.t0_N.value)):
        line = f"the load seems to drift by {plus_minus(fits.drift_N)} N over the test, which 𝒯0 hides, or a "
        line += "filter lowers the peaks: μ and 𝒯0 may be off by their systematic errors; check the zero"
        yield f"{line} before and after", True
    if fits.undetermined:
        names = "Λ̂, N̂ and Y_eff" if "Y_eff_GPa" in fits.undetermined else "Λ̂ and N̂"
        yield f"K does not fall with d as M_eff does: {names} are not determined", True
    if (scatter := fits.goodness["drops"].scatter) > settings.unlike_drops:
        line = f"the drops scatter by {100 * scatter:.0f} % about A 𝒩, as small slips among large ones do:"
        yield f"{line} A is the mean of both; `threshold_N` leaves the small ones out", True
    if not low_speed(speed := facts.speed_mm_min):
        line = (
            f"the models of A, N̂ and Y_eff hold for V ≤ {SLOW_MM_MIN:g} mm/min; here V = {speed:.3g} mm/min"
        )
        yield line, False
    if not np.isfinite(facts.d0_err_mm):
        yield "systematic errors do not include the error of d0, which is not given (give `d0_err_mm`)", False


def _offset_remarks(
    offset: Estimate, peak_N: float, d0_err_mm: float, settings: FitSettings
) -> Iterator[tuple[str, bool]]:
    """Yield a remark on an offset 𝒯0 that is no zero, and whether it is a warning.  peak_N: the usual F_p."""
    value, largest_N = with_minus(f"{offset.value:.3g}"), settings.largest_offset_N
    if abs(offset.value) - 2 * offset.error > largest_N:  # short tests hardly determine it
        line = f"𝒯0 = {value} N exceeds ±{largest_N:g} N, the largest error of a zero: "
        yield line + "check `d0_mm`, the sample's geometry, the zero and the units", True
    elif abs(offset.value) > settings.clear_offset * offset.error > 0:
        line = (
            f"𝒯0 = {value} N is {two_digits(abs(offset.value) / offset.error)} statistical errors from 0, as"
            " where the load cell's zero or drift, its low-pass, `d0_mm` or the sample's geometry is wrong"
        )
        if np.isfinite(d0_err_mm) or abs(offset.value) < settings.large_offset * peak_N:
            yield f"{line}; known errors of these are in the systematic error", False
        else:
            yield f"{line}; the error of d0 is in no result: give `d0_err_mm`", True
