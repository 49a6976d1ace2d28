"""Fits that make tests comparable: of each test with T* and Y_eff fixed, and of one μ for several tests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd
import scipy

from vision.comparison.runs import INSTRUMENT, TractionTest
from vision.data import Tunable
from vision.errors import InputError, counted
from vision.models import Estimate, equations
from vision.models.single_fits import (
    DEFAULT,
    FIT_ERRORS,
    SLOW_MM_MIN,
    UNKNOWN,
    fit_drops,
    fit_peaks,
    fit_stiffness,
    low_speed,
    normal_force_at_scale,
    stiffness_errors,
    with_friction,
)
from vision.numeric import Bools, Floats, rms, two_digits, with_minus
from vision.sample import Sample

JOINT_ERROR = "stat. and d_0"
"""What the error of a joint μ contains."""
COMPARED = ("mu", "T0_N", "A", "N_hat_N", "Lambda_hat_mm")  # columns of tests.csv


@dataclass(frozen=True, kw_only=True, repr=False)
class CompareSettings(Tunable):
    """Tunable constants of the comparison."""

    t0_limit_N: float = DEFAULT.largest_offset_N
    """Largest offset 𝒯0 of a test in the joint fit. A larger limit lets 𝒯0 compensate for a wrong μ; the
    publication has 10 N."""
    smooth_events: int = 15
    """Window of the running scatter of ΔF. Shorter is noisier, longer blurs the position of a change."""
    joint_misfit: float = 2.0
    """Ratio of χ²/dof of the peaks about the joint curve and about the individual ones from which no single μ
    fits: 1.2 for μ of 0.890 to 0.894, 8 for 0.89 and 0.91. Larger accepts curves that miss the points."""
    most_disagreement: float = 4.0
    """χ²/dof of the individual μ of several tests above which a warning says that they differ by more than
    their errors. Smaller warns of chance (`test_tests_that_share_their_friction_coefficient`)."""
    test_misfit: float = DEFAULT.contradicting_chi2
    """χ²/dof of the fits of one test above which it gets a warning; 1 is expected. Smaller warns of chance in
    tests with few events, larger accepts a wrong modulus (`test_a_wrong_modulus_shows`)."""
    least_side: int = 10
    """Smallest number of events on either side of a change of the scatter. Fewer make a chance run of large
    events a change, more miss changes near the ends of a test."""
    change_p: float = 0.01
    """Largest p value of a change of the scatter. A larger value claims changes in even scatter
    (`test_regular_sticks_have_no_change`), a smaller one misses late changes."""
    least_tests: int = 5
    """Smallest number of tests in which trends are examined. With four the smallest possible p value is 2/24,
    above `significance`; a larger number leaves out trends that could be found."""
    draws: int = 4000
    """Permutations per p value, whose standard error is √(p/draws): 0.0035 at p = 0.05."""
    significance: float = 0.05
    """Probability with which any trend is claimed if there is none."""
    seed: int = 0
    """Seed of the permutations."""


@dataclass(frozen=True, kw_only=True)
class TestFit:
    """Fit of one test with T* and Y_eff fixed."""

    __test__ = False
    # μ, 𝒯0, A, N̂ and Λ̂ by their names in tests.csv, with standard errors. N̂ and Λ̂ are NaN if K does not
    # follow the stiffness of M_eff sheets with this Y_eff.
    values: Mapping[str, Estimate]
    # For each source of a systematic error, the shift of each value caused by one standard error of the
    # source. "d0" and the sources of the force recording belong to this test alone, "Y_eff" to all tests, the
    # others to the sample.
    shifts: Mapping[str, Mapping[str, float]]
    chi2_dof: float  # squared deviation over that between neighbouring events, mean of the three fits
    peak_scatter: float  # root mean square deviation of the peaks from the fit, relative to the fit
    used: Bools = field(repr=False)  # whether each event was used
    notes: tuple[str, ...] = ()  # limitations of the result
    warnings: tuple[str, ...] = ()  # reasons why it may be wrong

    @property
    def mu(self) -> Estimate:
        """Friction coefficient."""
        return self.values["mu"]

    @property
    def scale_mm(self) -> Estimate:
        """Λ̂."""
        return self.values["Lambda_hat_mm"]

    def shift(self, source: str, name: str) -> float:
        """Return the shift of a quantity by one source of a systematic error; 0 if there is none."""
        return self.shifts.get(source, {}).get(name, 0.0)

    def individual_error(self, name: str) -> float:
        """Return the error of a quantity that other tests do not share: that of the fit and that of d0."""
        return float(np.hypot(self.values[name].error, self.shift("d0", name)))

    def estimate(self, name: str) -> Estimate:
        """Return a quantity with its systematic error as well."""
        return replace(self.values[name], systematic_error=self.systematic_error(name))

    def systematic_error(self, name: str) -> float:
        """Return all shifts of a quantity added in quadrature; NaN if no source of an error is known."""
        total = float(np.linalg.norm([shift[name] for shift in self.shifts.values()]))
        return total if total != 0 else float("nan")


@dataclass(frozen=True, kw_only=True)
class JointFriction:
    """Joint μ of several tests of one sample.

    The standard error of μ includes everything that differs from test to test: noise, the error of each d0
    (where it is given), and further scatter of the individual μ. The systematic error includes that of the
    geometry, which all tests of a sample share, and those of the force recordings; NaN if none is known.
    """

    sample: str  # name of the sample
    runs: tuple[str, ...]
    mu: Estimate
    t0_N: tuple[float, ...]  # offset of each test
    at_limit: tuple[str, ...]  # runs whose offset reaches the limit
    disagreement: float  # χ²/dof of the individual μ about the joint one
    disagrees: bool  # whether they differ by more than their errors
    amplitude: Estimate  # A, weighted mean of the slow tests
    misfit: float  # χ²/dof of all peaks about the joint curve, relative to that about the individual ones
    fits: bool  # whether the joint curve fits the peaks nearly as well as the individual ones
    without_d0_error: tuple[str, ...] = ()  # runs that state no error of d0: that of μ does not contain it

    @property
    def name(self) -> str:
        """The sample, or all tests."""
        return self.sample or "all tests"

    @property
    def warning(self) -> str:
        """Why μ should not be used; "" if it may be."""
        if self.fits and not self.disagrees:
            return ""
        differ = f"the individual μ of {len(self.runs)} tests differ by more than their errors (χ²/dof"
        none = f"no single μ fits the {len(self.runs)} tests (χ²/dof of their individual μ"
        problem = f"{differ if self.fits else none} {self.disagreement:.3g})"
        return f"{self.name}: {problem}: use the μ of each test, in tests.csv of the comparison"

    @property
    def error_contains(self) -> str:
        """What the standard error of μ contains, as its label."""
        if not self.without_d0_error:
            return JOINT_ERROR
        return "stat." if len(self.without_d0_error) == len(self.runs) else f"{JOINT_ERROR} where given"


def usable_range(test: TractionTest) -> Bools:
    """Return which events the models apply to: those in the run's fit range, so that μ is that of the run;
    without one those from the highest peak on."""
    d, peak = test.column("d_v_mm"), test.column("F_p_N")
    used: Bools
    if test.fit_range_mm is not None:
        low, high = test.fit_range_mm
        used = (d >= low - 1e-6) & (d <= high + 1e-6)  # d has nine digits in events.csv
    else:
        smooth = pd.Series(peak).rolling(5, center=True, min_periods=1).median().to_numpy()
        used = np.arange(d.size) >= int(np.argmax(smooth))
    return used if used.sum() >= 6 else np.ones(d.size, bool)


# --- one test -----------------------------------------------------------------------------------------------


def fit_test(test: TractionTest, modulus: Estimate, settings: CompareSettings = CompareSettings()) -> TestFit:
    r"""Fit μ, 𝒯0 and A of one test with T* fixed, and Λ̂ and N̂ with Y_eff fixed.

    test: from `read_tests`.  modulus: Y_eff in GPa with its error.  Raises: InputError if the peaks do not
    fall with d.

    .. math:: F_p = \mathcal T(d_p; \mu) + \mathcal T_0, \quad \Delta F = A\, \mathcal N(d_v; \mu), \quad
        K = M \sqrt{1 - d_v/\hat\Lambda}\; \epsilon W Y_\mathrm{eff} / L

    K depends on μ only through Λ̂, so Λ̂ alone is fitted; N̂ follows from μ and Λ̂ with the errors of both.
    Weights and errors are as in `fit_models`. Source: publication, section on the effective number of sheets.
    """
    used = usable_range(test)
    events = test.events[used]
    try:
        values, chi2, scatter = _fit(events, test.sample, modulus.value)
    except FIT_ERRORS as error:
        wanted = "events that follow the publication's models"
        found = "others (a fit that does not converge)"
        raise InputError(test.folder, wanted, found, "check `d0_mm`") from error
    mu, t0 = values["mu"], values["T0_N"]
    if not (0.05 < mu.value < 5.0 and mu.value > 2 * mu.error):
        found = f"others (μ = {with_minus(f'{mu.value:.3g}')} ± {two_digits(mu.error)})"
        raise InputError(test.folder, "peak forces that fall with d as Eq. 1 does", found, "check `d0_mm`")
    notes, warnings = [], []
    if abs(t0.value) > settings.t0_limit_N:
        warnings.append(
            f"offset 𝒯0 = {with_minus(f'{t0.value:.3g}')} N lies beyond ±{settings.t0_limit_N:g} N"
        )
    if not low_speed(test.speed_mm_min):
        notes.append(f"A, N̂ and Λ̂ are defined for V up to {SLOW_MM_MIN:g} mm/min")
    if not np.isfinite(values["Lambda_hat_mm"].value):
        notes.append("K does not follow that of M_eff sheets with this Y_eff: no Λ̂")
    if chi2 > settings.test_misfit:
        warnings.append(f"the models misfit: χ²/dof = {chi2:.3g}, errors scaled")
    if left := int((~used).sum()):
        where = "before the largest peaks" if test.fit_range_mm is None else "outside the run's fit range"
        notes.append(f"{counted(left, 'event')} {where} left out")
    return TestFit(
        values=values,
        shifts={},
        chi2_dof=chi2,
        peak_scatter=scatter,
        used=used,
        notes=tuple(notes),
        warnings=tuple(warnings),
    )


def _fit(
    events: pd.DataFrame, sample: Sample, modulus: float, known: Mapping[str, Estimate] | None = None
) -> tuple[dict[str, Estimate], float, float]:
    """Return (`COMPARED`, χ²/dof, relative scatter of the peaks about the fit). If μ, 𝒯0 and A are known,
    only the stiffness is fitted."""
    with np.errstate(all="ignore"):  # fits may leave the valid range on the way; the result is checked
        stiffness = fit_stiffness(events, sample, modulus_GPa=modulus)
        fits = [stiffness]
        if known is None:
            peaks = fit_peaks(events, sample)
            drops = with_friction(lambda m: fit_drops(events, sample, max(m, 1e-3)), peaks.estimate(0))
            fits = [peaks, drops, stiffness]
            known = {"mu": peaks.estimate(0), "T0_N": peaks.estimate(1), "A": drops.estimate(0)}
        scale = stiffness.estimate(0)
        if not scale.value < 0.999 * DEFAULT.largest_scale * float(events["d_v_mm"].max()):
            scale = UNKNOWN
        mu = known["mu"]
        n_hat, by_scale, by_mu, _ = normal_force_at_scale(mu.value, scale.value, sample)
        error = float(np.hypot(by_mu * mu.error, by_scale * scale.error))
        found = {name: known[name] for name in ("mu", "T0_N", "A")}
        found |= {"N_hat_N": Estimate(n_hat, error), "Lambda_hat_mm": scale}
        chi2 = float(np.nanmean([fit.goodness.chi2_dof for fit in fits]))
    return found, chi2, fits[0].goodness.scatter


def systematic_shifts(test: TractionTest, fit: TestFit, modulus: Estimate, main: bool) -> TestFit:
    """Return the fit with the shifts that errors of d0, the geometry and Y_eff cause; those by the force
    recording (drift of the load cell, its low-pass) come from the run's fits.

    modulus: Y_eff; its systematic error comes from the main sample's geometry.  main: whether the test
    belongs to that sample. Its K determines the product of Y_eff and geometry, so errors of its geometry do
    not change Λ̂.
    """
    used, shifts = test.events[fit.used], dict[str, dict[str, float]]()

    def refit(
        source: str, events: pd.DataFrame = used, sample: Sample = test.sample, y_GPa: float = modulus.value
    ) -> None:
        peaks_unchanged = source not in ("d0", "thickness_mm", "t_star_N")
        try:
            shifted, *_ = _fit(events, sample, y_GPa, fit.values if peaks_unchanged else None)
        except FIT_ERRORS:
            shifts[source] = dict.fromkeys(COMPARED, float("nan"))
        else:
            shifts[source] = {q: shifted[q].value - fit.values[q].value for q in COMPARED}

    y_errors = {"Y_eff": modulus.error} | ({} if main else {"main_sample": modulus.systematic_error})
    for source, error in y_errors.items():
        if error > 0:
            refit(source, y_GPa=modulus.value * (1 + error / modulus.value))
    if (d0_err := test.errors.get("d0_mm", 0.0)) > 0:
        refit("d0", used.assign(d_v_mm=used["d_v_mm"] + d0_err, d_p_mm=used["d_p_mm"] + d0_err))
    for name, power in _GEOMETRY.items():
        if (error := test.errors.get(name, 0.0)) > 0:
            size = getattr(test.sample, name)
            growth = 1 + error / size
            y_GPa = modulus.value * growth ** (-power if main else 0)
            refit(name, sample=replace(test.sample, **{name: size * growth}), y_GPa=y_GPa)
    for source, parts in test.instrument.items():
        shifts[source] = {q: parts.get(q, 0.0) for q in COMPARED}
    return replace(fit, shifts=shifts)


_GEOMETRY = {"thickness_mm": 1, "width_mm": 1, "length_mm": -1, "t_star_N": 0}
"""Exponent of each in the stiffness K of one sheet."""


def common_modulus(tests: Sequence[TractionTest], main: str) -> tuple[Estimate, tuple[str, ...]]:
    """Return Y_eff of the main sample in GPa, a weighted mean over its slow tests, and the runs averaged.

    Each test contributes the Y_eff fitted in its run or, if there is none, a fit of Λ̂ and Y_eff. Tests that
    do not determine it count only if none does. The error
    includes disagreement between the tests. The systematic error is that of ε, W and L; NaN if unknown.
    """
    of_sample = [test for test in tests if test.sample_name == main]
    of_sample = [test for test in of_sample if not test.modulus_undetermined] or of_sample
    slow = [test for test in of_sample if low_speed(test.speed_mm_min)] or of_sample
    mean = weighted_mean([_modulus_of_test(test) for test in slow])
    relative = [
        slow[0].errors[name] / getattr(slow[0].sample, name)
        for name, power in _GEOMETRY.items()
        if power and name in slow[0].errors
    ]
    systematic = mean.value * float(np.linalg.norm(relative)) if relative else float("nan")
    return replace(mean, systematic_error=systematic), tuple(test.run for test in slow)


def _modulus_of_test(test: TractionTest) -> Estimate:
    if np.isfinite(test.modulus.value) and test.modulus.error > 0:
        return test.modulus
    try:
        with np.errstate(all="ignore"):
            return fit_stiffness(test.events[usable_range(test)], test.sample).estimate(1)
    except FIT_ERRORS:
        return UNKNOWN


def weighted_mean(parts: Sequence[Estimate]) -> Estimate:
    """Return the mean of the known parts. Its error is scaled by √(χ²/dof) if they disagree."""
    known = [part for part in parts if np.isfinite(part.value) and part.error > 0]
    if not known:
        return UNKNOWN
    value, error = np.array([part.value for part in known]), np.array([part.error for part in known])
    mean = float(np.average(value, weights=error**-2))
    chi2 = float(np.sum(((value - mean) / error) ** 2) / (len(known) - 1)) if len(known) > 1 else 1.0
    return Estimate(mean, float(np.sum(error**-2.0) ** -0.5) * max(chi2, 1.0) ** 0.5)


# --- one μ for several tests --------------------------------------------------------------------------------


def _residuals(test: TractionTest, fit: TestFit, mu: float, limit_N: float) -> tuple[Floats, float]:
    """Return residuals of the peaks from Eq. 1 with the best offset 𝒯0, in standard deviations, and 𝒯0."""
    d, force = test.column("d_p_mm")[fit.used], test.column("F_p_N")[fit.used]
    fitted, wanted = (equations.traction(d, mu=m, sample=test.sample) for m in (fit.mu.value, mu))
    floor = 1e-3 * float(np.abs(force).max()) or 1.0
    scatter = fit.peak_scatter * np.maximum(np.abs(fitted + fit.values["T0_N"].value), floor)
    t0 = float(np.clip(np.average(force - wanted, weights=scatter**-2), -limit_N, limit_N))
    return (force - wanted - t0) / scatter, t0


def fit_joint(
    tests: Sequence[TractionTest],
    fits: Sequence[TestFit],
    sample: str,
    settings: CompareSettings = CompareSettings(),
) -> JointFriction:
    """Fit one μ to several tests, each with an individual offset 𝒯0 within ±`t0_limit_N`.

    tests, fits: the tests and the fit of each.  sample: name of their sample.
    """
    limit, step = settings.t0_limit_N, 1e-5  # step: difference of μ for numerical derivatives

    def residuals(mu: float) -> list[tuple[Floats, float]]:
        return [_residuals(test, fit, mu, limit) for test, fit in zip(tests, fits, strict=True)]

    def misfit(mu: float) -> float:
        return sum(float(np.sum(residual**2)) for residual, _ in residuals(mu))

    individual = np.array([fit.mu.value for fit in fits])
    bounds = 0.9 * individual.min(), 1.1 * individual.max()
    mu = float(
        scipy.optimize.minimize_scalar(misfit, bounds=bounds, method="bounded", options={"xatol": 1e-9}).x
    )
    offsets = {test.run: t0 for test, (_, t0) in zip(tests, residuals(mu), strict=True)}
    # Fisher information on μ in each test, with its offset fitted as well
    pairs = zip(residuals(mu + step), residuals(mu - step), strict=True)
    information = np.array([np.sum((more - less) ** 2) / (2 * step) ** 2 for (more, _), (less, _) in pairs])
    slow = [fit.values["A"] for test, fit in zip(tests, fits, strict=True) if low_speed(test.speed_mm_min)]
    free = max(sum(int(fit.used.sum()) for fit in fits) - len(fits) - 1, 1)
    chi2 = misfit(mu) / free  # relative: residuals are in units of the scatter about the individual curves
    errors = np.array([fit.individual_error("mu") for fit in fits])
    disagreement = float(np.sum(((individual - mu) / errors) ** 2) / (individual.size - 1))
    return JointFriction(
        sample=sample,
        runs=tuple(offsets),
        mu=_joint_mu(mu, tests, fits, information),
        t0_N=tuple(offsets.values()),
        at_limit=tuple(run for run, t0 in offsets.items() if abs(t0) >= limit),
        disagreement=disagreement,
        disagrees=disagreement > settings.most_disagreement,
        amplitude=weighted_mean(slow),
        misfit=chi2,
        fits=chi2 < settings.joint_misfit,
        without_d0_error=tuple(
            test.run for test, fit in zip(tests, fits, strict=True) if "d0" not in fit.shifts
        ),
    )


def _joint_mu(
    mu: float, tests: Sequence[TractionTest], fits: Sequence[TestFit], information: Floats
) -> Estimate:
    """Return μ with its errors (see `JointFriction`), given the information on μ in each test."""
    weight = information / information.sum()
    scale = float(np.mean([max(fit.chi2_dof, 1.0) for fit in fits]))
    by_d0 = np.array([fit.shift("d0", "mu") for fit in fits])
    between = float(np.var([fit.mu.value for fit in fits], ddof=1))
    between -= float(np.mean([fit.individual_error("mu") ** 2 for fit in fits]))
    variance = scale / information.sum() + np.sum((weight * by_d0) ** 2) + max(between, 0.0) / len(fits)
    by_instrument = [weight * [fit.shift(name, "mu") for fit in fits] for name in INSTRUMENT]
    by_shared = shared_shifts(tests, fits, "mu") @ weight
    systematic = float(np.linalg.norm(np.concatenate([by_shared, *by_instrument])))
    return Estimate(mu, float(np.sqrt(variance)), systematic or float("nan"))


def shared_shifts(tests: Sequence[TractionTest], fits: Sequence[TestFit], quantity: str) -> Floats:
    """Return the shifts of a quantity by each source of error that tests share, (source, test).

    The tests of one sample share the errors of its geometry, and all tests share that of Y_eff. Errors of d0
    and of the force recording belong to one test alone.
    """
    found: dict[tuple[str, str], Floats] = {}
    for k, (test, fit) in enumerate(zip(tests, fits, strict=True)):
        for source, shift in fit.shifts.items():
            if source not in ("d0", *INSTRUMENT):
                sample = test.sample_name if source in _GEOMETRY else ""
                found.setdefault((source, sample), np.zeros(len(fits)))[k] = shift[quantity]
    return np.array(list(found.values())).reshape(-1, len(fits))


# --- the collapse -------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Collapse:
    """Collapse of the tests on the master curve, and RMS deviations of K/K_eff from it, in sheets."""

    table: pd.DataFrame  # one row per event: run, d_v_mm, d_hat, sheets (K/K_eff), sheets_err, model
    common_scale_mm: float  # the single Λ̂ that fits all tests best
    rms_before: float  # deviation with this common Λ̂
    rms_after: float  # deviation with the Λ̂ of each test
    rms_noise: float  # deviation that the scatter between neighbouring events alone causes


def collapse(tests: Sequence[TractionTest], fits: Sequence[TestFit], modulus: Estimate) -> Collapse | None:
    r"""Compare K/K_eff with the master curve M√(1 − d̂), d̂ = d_v/Λ̂, for tests with a Λ̂; None if none has."""
    parts = []
    for test, fit in zip(tests, fits, strict=True):
        if not np.isfinite(fit.scale_mm.value):
            continue
        of_one_sheet = float(equations.sheet_stiffness(modulus_GPa=modulus.value, sample=test.sample))
        d = test.column("d_v_mm")[fit.used]
        sheets = test.column("K_N_per_mm")[fit.used] / of_one_sheet
        d_hat = d / fit.scale_mm.value
        model = equations.effective_sheets(d_hat, sample=test.sample)
        noise = np.diff(sheets - model)
        parts.append(
            pd.DataFrame(
                {
                    "run": test.run,
                    "d_v_mm": d,
                    "d_hat": d_hat,
                    "sheets": sheets,
                    "sheets_err": stiffness_errors(test.events[fit.used]) / of_one_sheet,
                    "model": model,
                    "sheets_per_block": test.sample.sheets_per_block,
                    "noise": float(np.sqrt(np.mean(noise**2) / 2)),
                }
            )
        )
    if not parts:
        return None
    table = pd.concat(parts, ignore_index=True)
    scale = _common_scale(tests, fits, modulus)
    block = table["sheets_per_block"].to_numpy(float)
    before = block * np.sqrt(np.maximum(1 - table["d_v_mm"].to_numpy(float) / scale, 0))
    return Collapse(
        table=table,
        common_scale_mm=scale,
        rms_before=rms(table["sheets"].to_numpy(float) - before),
        rms_after=rms((table["sheets"] - table["model"]).to_numpy(float)),
        rms_noise=rms(table["noise"].to_numpy(float)),
    )


def _common_scale(tests: Sequence[TractionTest], fits: Sequence[TestFit], modulus: Estimate) -> float:
    """Return one Λ̂ for all events: tests of one geometry are fitted together, then the fits are averaged."""
    groups: dict[Sample, list[pd.DataFrame]] = {}
    for test, fit in zip(tests, fits, strict=True):
        if np.isfinite(fit.scale_mm.value):
            groups.setdefault(test.sample, []).append(test.events[fit.used])
    together = {sample: pd.concat(parts, ignore_index=True) for sample, parts in groups.items()}
    with np.errstate(all="ignore"):
        scales = [
            fit_stiffness(events, sample, modulus_GPa=modulus.value).value[0]
            for sample, events in together.items()
        ]
    return float(np.average(scales, weights=[len(events) for events in together.values()]))
