"""Fits that make tests comparable: each by itself with T* and Y_eff fixed, and one μ for several tests."""

# ruff: noqa: N815 (the unit is part of a name, and newton is N)
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd
import scipy

from vision.comparison.runs import INSTRUMENT, TractionTest
from vision.errors import InputError
from vision.models import Estimate, equations
from vision.models.single_fits import (
    FAILURES,
    LARGEST_SCALE,
    fit_drops,
    fit_peaks,
    fit_stiffness,
    stiffness_errors,
    with_friction,
)
from vision.numeric import Bools, Floats
from vision.sample import Sample

DISAGREES = 4.0  # χ²/dof of the tests' own μ, from which on they are said to differ
QUANTITIES = ("mu", "T0_N", "A", "N_hat_N", "Lambda_hat_mm")  # columns of tests.csv


def with_word(name: str, word: str) -> str:
    """N_hat_err_N from N_hat_N: the unit comes last."""
    stem, unit = next(((name.removesuffix(u), u) for u in ("_N", "_mm") if name.endswith(u)), (name, ""))
    return f"{stem}_{word}{unit}"


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
    joint_misfit: float = 2.0
    """χ²/dof of the peaks about the joint curve, over that about each test's own, from which on no single μ
    fits. Smaller warns of tests that differ by less than single events scatter; larger lets curves pass
    beside the points. Tests of μ 0.890 to 0.894 give 1.2, of 0.89 and 0.91 eight."""
    test_misfit: float = 3.0
    """χ²/dof of a test's own fits from which on it gets a warning. Events that follow the models give 1;
    smaller warns of chance in tests of few events, larger passes a wrong modulus
    (`test_a_wrong_modulus_shows`)."""
    change_p: float = 0.01
    """Share of random orders of the events that may divide as well as a change of the scatter. Larger claims
    changes in even scatter (`test_regular_sticks_have_no_change`), smaller misses late ones."""
    change_ratio: float = 1.5
    """Least rise of the scatter at a change. Smaller claims what no eye would see, larger misses changes of
    tests that are irregular from the start."""
    draws: int = 4000
    """Permutations of a p value: its own scatter is √(p/draws), 0.0035 at 0.05."""
    significance: float = 0.05
    """Share of tests without any trend in which one may be claimed."""
    seed: int = 0
    """Of the permutations."""

    def slow(self, test: TractionTest) -> bool:
        """Whether a test was pulled slowly enough for all models; measured velocities differ by 5 %."""
        return not test.speed_mm_min > 1.05 * self.slow_mm_min


@dataclass(frozen=True, kw_only=True)
class TestFit:
    """What one test gives with T* and Y_eff fixed."""

    __test__ = False
    # μ, 𝒯0, A, N̂ and Λ̂ by their names in tests.csv, with standard errors; N̂ and Λ̂ are NaN where K is not that
    # of M_eff sheets with this Y_eff
    values: Mapping[str, Estimate]
    # source of a systematic error to by how much it moves each of them (one standard error of the source):
    # "d0" and those of the force recording are the test's own, "Y_eff" all share, others belong to the sample
    shifts: Mapping[str, Mapping[str, float]]
    chi2_dof: float  # squared deviation over that between neighbouring events, mean of the three fits
    peak_scatter: float  # root mean square deviation of the peaks from the fit, as a share of them
    used: Bools = field(repr=False)  # which events
    notes: tuple[str, ...] = ()  # what limits the result
    warnings: tuple[str, ...] = ()  # what may make it wrong

    @property
    def mu(self) -> Estimate:
        """Friction coefficient."""
        return self.values["mu"]

    @property
    def scale_mm(self) -> Estimate:
        """Λ̂."""
        return self.values["Lambda_hat_mm"]

    def own_error(self, name: str) -> float:
        """Error of a quantity that is the test's own: that of the fit, and that of d0."""
        return float(np.hypot(self.values[name].error, self.shifts.get("d0", {}).get(name, 0.0)))

    def systematic_error(self, name: str) -> float:
        """All shifts together; NaN where nothing that moves the quantity is known."""
        total = float(np.linalg.norm([moved[name] for moved in self.shifts.values()]))
        return total if total != 0 else float("nan")


@dataclass(frozen=True, kw_only=True)
class JointFriction:
    """One μ for several tests of one sample.

    The error of μ holds what differs from test to test: noise, each test's d0, and what the tests' own μ
    differ by beyond that; the systematic one is that of the geometry, which all tests of a sample share, and
    of the tests' load cells; NaN where neither is known.
    """

    sample: str  # its name
    runs: tuple[str, ...]
    mu: Estimate
    t0_N: tuple[float, ...]  # offset of each test
    at_limit: tuple[str, ...]  # runs whose offset is as large as it may be
    disagreement: float  # χ²/dof of the tests' own μ about the common one
    amplitude: Estimate  # A, the weighted mean of the slow tests
    misfit: float  # χ²/dof of all peaks about the joint curve, over that about each test's own
    fits: bool  # whether the peaks scatter about the joint curve as they do about their own

    @property
    def disagrees(self) -> bool:
        """Whether the tests do not share one μ."""
        return self.disagreement > DISAGREES


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


# --- one test -----------------------------------------------------------------------------------------------


def fit_test(test: TractionTest, modulus: Estimate, settings: CompareSettings = CompareSettings()) -> TestFit:
    r"""μ, 𝒯0 and A of one test with T* fixed, Λ̂ and N̂ with Y_eff fixed.

    test: of `read_tests`.  modulus: Y_eff in GPa with its error.  Raises: InputError for peaks that do not
    fall with d.

    .. math:: F_p = \mathcal T(d_p; \mu) + \mathcal T_0, \quad \Delta F = A\, \mathcal N(d_v; \mu), \quad
        K = M \sqrt{1 - d_v/\hat\Lambda}\; \epsilon W Y_\mathrm{eff} / L

    K knows μ only through Λ̂, so Λ̂ alone is fitted and N̂ follows with the errors of both. The weights and
    errors are those of `fit_models`. Source: publication, section on the effective number of sheets.
    """
    used = usable_range(test)
    events = test.events[used]
    try:
        values, chi2, scatter = _fit(events, test.sample, modulus.value)
    except FAILURES as error:
        wanted = "events that follow the publication's models"
        raise InputError(test.folder, wanted, f"others ({error})", "check `d0_mm`") from error
    mu, t0 = values["mu"], values["T0_N"]
    if not (0.05 < mu.value < 5.0 and mu.value > 2 * mu.error):
        found = f"others (μ = {mu.value:.3g} ± {mu.error:.2g})"
        raise InputError(test.folder, "peak forces that fall with d as Eq. 1 does", found, "check `d0_mm`")
    notes, warnings = [], []
    if abs(t0.value) > settings.t0_limit_N:
        warnings.append(f"offset 𝒯0 = {t0.value:.3g} N lies beyond ±{settings.t0_limit_N:g} N")
    if not settings.slow(test):
        notes.append(f"A, N̂ and Λ̂ are defined for V up to {settings.slow_mm_min:g} mm/min")
    if not np.isfinite(values["Lambda_hat_mm"].value):
        notes.append("K is not that of M_eff sheets with this Y_eff: no Λ̂")
    if chi2 > settings.test_misfit:
        warnings.append(f"the models misfit: χ²/dof = {chi2:.3g}, errors scaled")
    if left := int((~used).sum()):
        notes.append(f"{left} events before the largest peaks or outside the run's fit range left out")
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
    """(`QUANTITIES`, χ²/dof, scatter of the peaks as a share of them).

    Where μ, 𝒯0 and A are known, the stiffness alone is fitted.
    """
    with np.errstate(all="ignore"):  # fits may stray; what comes out is checked
        stiffness = fit_stiffness(events, sample, {"modulus_GPa": modulus})
        fits = [stiffness]
        if known is None:
            peaks = fit_peaks(events, sample, False, {})
            drops = with_friction(lambda m: fit_drops(events, sample, max(m, 1e-3)), peaks.estimate(0))
            fits = [peaks, drops, stiffness]
            known = {"mu": peaks.estimate(0), "T0_N": peaks.estimate(1), "A": drops.estimate(0)}
        scale = stiffness.estimate(0)
        if not scale.value < 0.999 * LARGEST_SCALE * float(events["d_v_mm"].max()):
            scale = Estimate(float("nan"), float("nan"))
        found = {name: known[name] for name in ("mu", "T0_N", "A")}
        found |= {"N_hat_N": _n_hat(known["mu"], scale, sample), "Lambda_hat_mm": scale}
        chi2 = float(np.nanmean([fit.goodness.chi2_dof for fit in fits]))
    return found, chi2, fits[0].goodness.scatter


def _n_hat(mu: Estimate, scale: Estimate, sample: Sample) -> Estimate:
    r"""N̂ = T*/(2μ) (exp(α) − 1) with α = 2μεM²/Λ̂, and the errors of μ and Λ̂, which are independent."""
    alpha = 2 * mu.value * sample.thickness_mm * sample.sheets_per_block**2 / scale.value
    value = sample.t_star_N / (2 * mu.value) * float(np.expm1(alpha))
    by_alpha = sample.t_star_N / (2 * mu.value) * alpha * float(np.exp(alpha))  # times dα/α
    by_mu, by_scale = (by_alpha - value) / mu.value, by_alpha / scale.value
    return Estimate(value, float(np.hypot(by_mu * mu.error, by_scale * scale.error)))


def systematic_shifts(test: TractionTest, fit: TestFit, modulus: Estimate, main: bool) -> TestFit:
    """The fit with what each error of d0, the geometry and Y_eff moves it by.

    Errors of the force recording (drift of the load cell, its low-pass) are those of the run's own fits.

    test, fit: of `fit_test`.  modulus: Y_eff; its systematic error is that of the main sample's geometry.
    main: whether the test is of the main sample: there K fixes Y_eff times the geometry, whose errors leave
    Λ̂ as it is.
    """
    events, sample = test.events[fit.used], test.sample
    shifts: dict[str, dict[str, float]] = {}

    def source(name: str, relative: float = 0.0, d_mm: float = 0.0) -> None:
        if not (np.isfinite(relative + d_mm) and relative + d_mm > 0):
            return
        other, y = sample, modulus.value
        if name in _GEOMETRY:
            other = replace(sample, **{name: getattr(sample, name) * (1 + relative)})
            y *= (1 + relative) ** (-_GEOMETRY[name] if main else 0)
        else:
            y *= 1 + relative
        shifted = events.assign(d_v_mm=events["d_v_mm"] + d_mm, d_p_mm=events["d_p_mm"] + d_mm)
        try:
            peaks_stay = name not in ("d0", "thickness_mm", "t_star_N")
            moved, *_ = _fit(shifted, other, y, fit.values if peaks_stay else None)
        except FAILURES:
            shifts[name] = dict.fromkeys(QUANTITIES, float("nan"))
            return
        shifts[name] = {q: moved[q].value - fit.values[q].value for q in QUANTITIES}

    source("Y_eff", modulus.error / modulus.value)
    if not main:
        source("main_sample", modulus.systematic_error / modulus.value)
    source("d0", d_mm=test.errors.get("d0_mm", float("nan")))
    for name in _GEOMETRY:
        source(name, test.errors.get(name, float("nan")) / getattr(sample, name))
    for name, parts in test.instrument.items():
        shifts[name] = {q: parts.get(q, 0.0) for q in QUANTITIES}
    return replace(fit, shifts=shifts)


_GEOMETRY = {"thickness_mm": 1, "width_mm": 1, "length_mm": -1, "t_star_N": 0}
"""Power with which each enters K of one sheet."""


def common_modulus(
    tests: Sequence[TractionTest], main: str, settings: CompareSettings = CompareSettings()
) -> tuple[Estimate, tuple[str, ...]]:
    """Y_eff of the main sample in GPa, the weighted mean of its slow tests, and which runs these are.

    The run's own fit is used where it has one, else Λ̂ and Y_eff are fitted here. The error holds how far the
    tests disagree; the systematic one is that of ε, W and L, NaN where none of their errors is known.
    """
    mine = [test for test in tests if test.sample_name == main]
    slow = list(filter(settings.slow, mine)) or mine
    mean = weighted_mean([_own_modulus(test) for test in slow])
    relative = [
        slow[0].errors[name] / getattr(slow[0].sample, name)
        for name, power in _GEOMETRY.items()
        if power and name in slow[0].errors
    ]
    systematic = mean.value * float(np.linalg.norm(relative)) if relative else float("nan")
    return replace(mean, systematic_error=systematic), tuple(test.run for test in slow)


def _own_modulus(test: TractionTest) -> Estimate:
    if np.isfinite(test.modulus_GPa) and test.modulus_err_GPa > 0:
        return Estimate(test.modulus_GPa, test.modulus_err_GPa)
    try:
        with np.errstate(all="ignore"):
            return fit_stiffness(test.events[usable_range(test)], test.sample, {}).estimate(1)
    except FAILURES:
        return Estimate(float("nan"), float("nan"))


def weighted_mean(parts: Sequence[Estimate]) -> Estimate:
    """The mean of the known parts, its error scaled by their χ²/dof where they disagree."""
    known = [part for part in parts if np.isfinite(part.value) and part.error > 0]
    if not known:
        return Estimate(float("nan"), float("nan"))
    value, error = np.array([part.value for part in known]), np.array([part.error for part in known])
    mean = float(np.average(value, weights=error**-2))
    chi2 = float(np.sum(((value - mean) / error) ** 2) / (len(known) - 1)) if len(known) > 1 else 1.0
    return Estimate(mean, float(np.sum(error**-2.0) ** -0.5) * max(chi2, 1.0) ** 0.5)


# --- one μ for several tests --------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, eq=False)
class _Peaks:
    """The peaks of one test with the standard deviation of each."""

    d_mm: Floats
    force_N: Floats
    scatter_N: Floats
    sample: Sample

    def rest(self, mu: float, limit_N: float) -> tuple[Floats, float]:
        """Deviations from Eq. 1 with the best offset 𝒯0, in standard deviations, and that offset."""
        off = self.force_N - equations.traction(self.d_mm, mu=mu, sample=self.sample)
        t0 = float(np.clip(np.average(off, weights=self.scatter_N**-2), -limit_N, limit_N))
        return (off - t0) / self.scatter_N, t0


def _peaks(test: TractionTest, fit: TestFit) -> _Peaks:
    d, force = test.column("d_p_mm")[fit.used], test.column("F_p_N")[fit.used]
    model = equations.traction(d, mu=fit.mu.value, sample=test.sample) + fit.values["T0_N"].value
    floor = 1e-3 * float(np.abs(force).max()) or 1.0
    scatter = fit.peak_scatter * np.maximum(np.abs(model), floor)
    return _Peaks(d_mm=d, force_N=force, scatter_N=scatter, sample=test.sample)


def fit_joint(
    tests: Sequence[TractionTest],
    fits: Sequence[TestFit],
    sample: str,
    settings: CompareSettings = CompareSettings(),
) -> JointFriction:
    """One μ for several tests, each with an offset 𝒯0 of its own within ±10 N.

    tests, fits: which, and what each gives.  sample: its name.
    """
    limit, step = settings.t0_limit_N, 1e-5  # step: of μ, for derivatives
    peaks = [_peaks(test, fit) for test, fit in zip(tests, fits, strict=True)]

    def misfit(mu: float) -> float:
        return sum(float(np.sum(one.rest(mu, limit)[0] ** 2)) for one in peaks)

    own = np.array([fit.mu.value for fit in fits])
    reach = 0.9 * own.min(), 1.1 * own.max()
    mu = float(
        scipy.optimize.minimize_scalar(misfit, bounds=reach, method="bounded", options={"xatol": 1e-9}).x
    )
    offsets = {test.run: one.rest(mu, limit)[1] for test, one in zip(tests, peaks, strict=True)}
    # Of μ in each test, beside its offset.
    changes = [one.rest(mu + step, limit)[0] - one.rest(mu - step, limit)[0] for one in peaks]
    information = np.array([np.sum(change**2) / (2 * step) ** 2 for change in changes])
    slow = [fit.values["A"] for test, fit in zip(tests, fits, strict=True) if settings.slow(test)]
    free = max(sum(one.d_mm.size for one in peaks) - len(peaks) - 1, 1)
    chi2 = misfit(mu) / free  # the peaks' scatter is that about the tests' own curves
    errors = np.array([fit.own_error("mu") for fit in fits])
    return JointFriction(
        sample=sample,
        runs=tuple(offsets),
        mu=_joint_mu(mu, tests, fits, information),
        t0_N=tuple(offsets.values()),
        at_limit=tuple(run for run, t0 in offsets.items() if abs(t0) >= limit),
        disagreement=float(np.sum(((own - mu) / errors) ** 2) / (own.size - 1)),
        amplitude=weighted_mean(slow),
        misfit=chi2,
        fits=chi2 < settings.joint_misfit,
    )


def _joint_mu(
    mu: float, tests: Sequence[TractionTest], fits: Sequence[TestFit], information: Floats
) -> Estimate:
    """μ with its errors (see `JointFriction`), from the information on it in each test."""
    share = information / information.sum()
    widening = float(np.mean([max(fit.chi2_dof, 1.0) for fit in fits]))
    by_d0 = np.array([fit.shifts.get("d0", {}).get("mu", 0.0) for fit in fits])
    between = float(np.var([fit.mu.value for fit in fits], ddof=1))
    between -= float(np.mean([fit.own_error("mu") ** 2 for fit in fits]))
    variance = widening / information.sum() + np.sum((share * by_d0) ** 2) + max(between, 0.0) / len(fits)
    own = [share * [fit.shifts.get(name, {}).get("mu", 0.0) for fit in fits] for name in INSTRUMENT]
    systematic = float(np.linalg.norm(np.concatenate([shared_shifts(tests, fits, "mu") @ share, *own])))
    return Estimate(mu, float(np.sqrt(variance)), systematic or float("nan"))


def shared_shifts(tests: Sequence[TractionTest], fits: Sequence[TestFit], quantity: str) -> Floats:
    """By how much each source that several tests share moves a quantity of each of them, (source, test).

    Errors of the geometry are shared by the tests of one sample, those of Y_eff by all; d0 and those of the
    force recordings by none.
    """
    found: dict[tuple[str, str], Floats] = {}
    for k, (test, fit) in enumerate(zip(tests, fits, strict=True)):
        for source, moved in fit.shifts.items():
            if source not in ("d0", *INSTRUMENT):
                whose = test.sample_name if source in _GEOMETRY else ""
                found.setdefault((source, whose), np.zeros(len(fits)))[k] = moved[quantity]
    return np.array(list(found.values())).reshape(-1, len(fits))


# --- the collapse -------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Collapse:
    """How well the tests fall on the master curve; distances are root mean squares of K/K_eff, in sheets."""

    table: pd.DataFrame  # a row an event: run, d_v_mm, d_hat, sheets (K/K_eff), sheets_err, model
    common_scale_mm: float  # the one Λ̂ that fits all tests best
    rms_before: float  # from the master curve with the one Λ̂
    rms_after: float  # and with each test's own
    rms_noise: float  # what the scatter between neighbouring events alone gives


def collapse(tests: Sequence[TractionTest], fits: Sequence[TestFit], modulus: Estimate) -> Collapse | None:
    r"""K/K_eff against d̂ = d_v/Λ̂ with M√(1 − d̂), for the tests that have a Λ̂; None where none has.

    The distance before is that with one Λ̂ for all: what their differences cost.
    """
    parts = []
    for test, fit in zip(tests, fits, strict=True):
        if not np.isfinite(fit.scale_mm.value):
            continue
        one = float(equations.sheet_stiffness(modulus_GPa=modulus.value, sample=test.sample))
        d = test.column("d_v_mm")[fit.used]
        sheets = test.column("K_N_per_mm")[fit.used] / one
        d_hat = d / fit.scale_mm.value
        noise = np.diff(sheets - equations.effective_sheets(d_hat, sample=test.sample))
        parts.append(
            pd.DataFrame(
                {
                    "run": test.run,
                    "d_v_mm": d,
                    "d_hat": d_hat,
                    "sheets": sheets,
                    "sheets_err": stiffness_errors(test.events[fit.used]) / one,
                    "model": equations.effective_sheets(d_hat, sample=test.sample),
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
        rms_before=_rms(table["sheets"].to_numpy(float) - before),
        rms_after=_rms((table["sheets"] - table["model"]).to_numpy(float)),
        rms_noise=_rms(table["noise"].to_numpy(float)),
    )


def _common_scale(tests: Sequence[TractionTest], fits: Sequence[TestFit], modulus: Estimate) -> float:
    """One Λ̂ for all events; tests of one geometry are fitted together, others averaged by their events."""
    groups: dict[Sample, list[pd.DataFrame]] = {}
    for test, fit in zip(tests, fits, strict=True):
        if np.isfinite(fit.scale_mm.value):
            groups.setdefault(test.sample, []).append(test.events[fit.used])
    together = {sample: pd.concat(parts, ignore_index=True) for sample, parts in groups.items()}
    known = {"modulus_GPa": modulus.value}
    with np.errstate(all="ignore"):
        scales = [fit_stiffness(events, sample, known).value[0] for sample, events in together.items()]
    return float(np.average(scales, weights=[len(events) for events in together.values()]))


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.nanmean(values**2)))
