"""Trends of μ, N̂ and Λ̂ from test to test, and the separation at which ΔF becomes irregular within one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pandas as pd
import scipy

from vision.comparison.joint import CompareSettings
from vision.comparison.runs import TractionTest
from vision.data import with_word
from vision.errors import counted
from vision.models import Estimate, plus_minus
from vision.models.single_fits import SYMBOLS
from vision.numeric import Bools, Floats, rms

QUANTITIES = ("mu", "N_hat_N", "Lambda_hat_mm")  # columns of tests.csv, as are the next ones
PREDICTORS = {"n_test": "number of previous tests", "RH_percent": "relative humidity (%)"}
PER = {"n_test": "per test", "RH_percent": "per %"}  # unit of slopes


@dataclass(frozen=True, kw_only=True)
class Trend:
    """Regression of one quantity on one predictor."""

    quantity: str  # columns of tests.csv
    predictor: str
    tests: int  # number of tests with both
    slope: float = np.nan  # slope of a weighted line, ignoring the other predictor
    slope_err: float = np.nan
    slope_systematic: float = np.nan  # error due to the geometry and Y_eff
    intercept: float = np.nan
    scatter: float = np.nan  # standard deviation of tests about the line, beyond their errors
    spearman: float = np.nan  # rank correlation
    p: float = np.nan  # share of random orders with as large a rank correlation
    partial_slope: float = np.nan  # with the other predictor held fixed; NaN if that is not known
    partial_slope_err: float = np.nan
    partial_slope_systematic: float = np.nan
    partial_p: float = np.nan
    # p of the partial slope (without one, of the rank correlation), adjusted for the number of trends (Holm)
    p_adjusted: float = np.nan
    claimed: bool = False  # `p_adjusted` is below the significance, the slope beyond its systematic errors
    reason: str = ""  # why the trend was not examined; "" if it was

    @property
    def name(self) -> str:
        """The quantity and the predictor as text."""
        return f"{SYMBOLS[self.quantity][0]} with {PREDICTORS[self.predictor].removesuffix(' (%)')}"

    @property
    def beyond_systematic(self) -> bool:
        """Whether the slope (the partial one if there is one) exceeds twice its systematic error."""
        if np.isnan(self.partial_slope):
            return abs(self.slope) > 2 * self.slope_systematic
        return abs(self.partial_slope) > 2 * self.partial_slope_systematic


def find_trends(
    table: pd.DataFrame,
    settings: CompareSettings = CompareSettings(),
    *,
    shared: Mapping[str, Floats] | None = None,
) -> tuple[Trend, ...]:
    r"""Find the trends of μ, N̂ and Λ̂ in tests.csv with the number of previous tests and with humidity.

    table: the content of tests.csv.  shared: for each quantity, its shifts by errors that several tests share
    (source, test), from `shared_shifts`.

    Weights are 1/(error² + s²), where s is the scatter between tests beyond their errors, chosen such that
    χ²/dof is at most 1. The p value of Spearman's ρ is the share of random orders with as large a |ρ|.
    Partial slopes come from y = a + b₁ n_test + b₂ RH; their p value permutes the residuals of the model
    without that slope (Freedman and Lane 1983). The p values are adjusted for the number of trends (Holm
    1979): if there is no trend, at most one comparison in twenty claims one. An error of the geometry shifts
    all tests of a sample together, so a slope within two of its systematic errors is not claimed.
    """
    found = [
        _trend(table, quantity, predictor, (shared or {}).get(quantity), settings)
        for quantity in QUANTITIES
        for predictor in PREDICTORS
    ]
    adjusted = holm(np.array([t.p if np.isnan(t.partial_p) else t.partial_p for t in found]))
    return tuple(
        replace(t, p_adjusted=float(p), claimed=bool(p < settings.significance and t.beyond_systematic))
        for t, p in zip(found, adjusted, strict=True)
    )


def holm(p: Floats) -> Floats:
    """Return p values adjusted for their number (Holm). NaN remains NaN and is not counted."""
    known = np.flatnonzero(np.isfinite(p))
    order = known[np.argsort(p[known])]
    adjusted = np.full(p.size, np.nan)
    steps = p[order] * np.arange(order.size, 0, -1)
    adjusted[order] = np.minimum(np.maximum.accumulate(steps), 1.0) if order.size else steps
    return adjusted


def _trend(
    table: pd.DataFrame, quantity: str, predictor: str, shared: Floats | None, settings: CompareSettings
) -> Trend:
    error_of = with_word(quantity, "err")
    y, error, x = (table[name].to_numpy(float) for name in (quantity, error_of, predictor))
    known: Bools = np.isfinite(y) & np.isfinite(x) & (error > 0)
    count = int(known.sum())
    about: dict[str, Any] = {"quantity": quantity, "predictor": predictor, "tests": count}
    if count < settings.least_tests:
        reason = f"{counted(count, 'test')} with both, at least {settings.least_tests} needed"
        return Trend(**about, reason=reason)
    if not np.ptp(x[known]) > 0:
        return Trend(**about, reason=f"{predictor} never changes")
    rng = np.random.default_rng(settings.seed)
    shifts = np.zeros((0, y.size)) if shared is None else np.nan_to_num(shared)

    def slope(design: Floats) -> tuple[Floats, dict[str, Any], float]:
        """Line or plane through the known tests, its first slope with both errors, and the scatter."""
        line, covariance, scatter = weighted_fit(design, y[known], error[known])
        # the shift by errors that tests share, added in quadrature
        weighted = design / (error[known] ** 2 + scatter**2)[:, np.newaxis]
        systematic = np.linalg.norm(shifts[:, known] @ weighted @ covariance[1])
        names = {"slope": line[1], "slope_err": np.sqrt(covariance[1, 1]), "slope_systematic": systematic}
        return line, {name: float(value) for name, value in names.items()}, scatter

    line, found, scatter = slope(_design(x[known]))
    one, other = (scipy.stats.rankdata(values[known]) for values in (x, y))
    rho, p = permutation_test(one, other, np.ones((count, 1)), rng, settings.draws)
    trend = Trend(**about, **found, intercept=float(line[0]), scatter=scatter, spearman=rho, p=p)
    (held,) = PREDICTORS.keys() - {predictor}
    z = table[held].to_numpy(float)
    known &= np.isfinite(z)
    if known.sum() < settings.least_tests + 1 or not (np.ptp(z[known]) > 0 and np.ptp(x[known]) > 0):
        return trend
    if abs(np.corrcoef(x[known], z[known])[0, 1]) > 0.999:
        return trend  # the predictors are collinear, so neither can be held fixed
    design = _design(x[known], z[known])
    _, found, scatter = slope(design)
    root = 1 / np.hypot(error[known], scatter)  # of the weights
    weighted = design * root[:, None]
    _, partial_p = permutation_test(weighted[:, 1], y[known] * root, weighted[:, [0, 2]], rng, settings.draws)
    return replace(trend, partial_p=partial_p, **{f"partial_{name}": value for name, value in found.items()})


def _design(*columns: Floats) -> Floats:
    return np.column_stack([np.ones(columns[0].size), *columns])


def weighted_fit(design: Floats, y: Floats, error: Floats) -> tuple[Floats, Floats, float]:
    """Return parameters, their covariance, and the extra scatter with which χ²/dof is at most 1."""
    free = max(y.size - design.shape[1], 1)

    def fit(scatter: float) -> tuple[Floats, Floats, float]:
        weight = 1 / (error**2 + scatter**2)
        covariance = np.asarray(np.linalg.pinv(design.T @ (design * weight[:, np.newaxis])), np.float64)
        value = covariance @ (design.T @ (weight * y))
        return value, covariance, float(np.sum(weight * (y - design @ value) ** 2) / free)

    high = float(np.std(y)) * 2
    if fit(0.0)[2] <= 1 or high == 0 or fit(high)[2] >= 1:
        scatter = 0.0 if fit(0.0)[2] <= 1 else high
    else:
        scatter = float(scipy.optimize.brentq(lambda s: fit(s)[2] - 1, 0.0, high))
    return *fit(scatter)[:2], scatter


def permutation_test(
    x: Floats, y: Floats, others: Floats, rng: np.random.Generator, draws: int
) -> tuple[float, float]:
    """Return the correlation of x and y at fixed `others`, (test, 1 or 2), and its p value, the share
    of random orders of what the others leave of y that correlate as much (Freedman and Lane 1983)."""
    basis = np.linalg.qr(others)[0]
    x, rest = (part - basis @ (basis.T @ part) for part in (x, y))
    if not min(np.ptp(x), np.ptp(rest)) > 0:
        return float("nan"), float("nan")
    drawn = np.vstack([y, y - rest + rng.permuted(np.tile(rest, (draws, 1)), axis=1)])
    drawn -= drawn @ basis @ basis.T
    found = drawn @ x / np.maximum(np.linalg.norm(x) * np.linalg.norm(drawn, axis=1), 1e-300)
    larger = np.sum(np.abs(found[1:]) >= abs(found[0]) - 1e-9)
    return float(found[0]), float((1 + larger) / (draws + 1))


# --- a change within one test -------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Irregularity:
    """Running coefficient of variation of ΔF, and the separation at which it changes."""

    run: str
    speed_mm_min: float
    d_mm: Floats = field(repr=False)  # separation of each event
    variation: Floats = field(repr=False)  # running coefficient of variation there
    change_mm: float = np.nan  # separation at which it rises; NaN if there is no change
    change_err_mm: float = np.nan
    before: float = np.nan  # coefficient of variation on either side; the same if there is no change
    after: float = np.nan
    p: float = np.nan  # probability that a test without a change shows one as large
    reason: str  # why there is no change point; "" if there is one

    @property
    def change_text(self) -> str:
        """The separation of the change with its error."""
        return f"{plus_minus(Estimate(self.change_mm, self.change_err_mm))} mm"


def find_irregular(test: TractionTest, settings: CompareSettings = CompareSettings()) -> Irregularity:
    r"""Find the separation at which the scatter of ΔF rises permanently.

    r is the relative deviation of ΔF from its smoothed course, √⟨r²⟩ the running coefficient of variation.
    The change point is the split that best divides log|r| into two levels; the logarithm keeps single large
    events from mimicking a change. It is claimed if fewer than 1 % of random orders of r divide as well, the
    scatter rises, and two levels describe it better (BIC) than a smooth rise, such as that of constant noise
    over a falling ΔF. Its error is the spread over 200 bootstrap draws within the two parts.
    """
    d, drop = test.column("d_v_mm"), test.column("dF_N")
    about: dict[str, Any] = {"run": test.run, "speed_mm_min": test.speed_mm_min, "d_mm": d}
    window, least = settings.smooth_events | 1, settings.least_side
    if d.size < max(2 * window, 2 * least + 1):
        reason = f"{d.size} events, at least {2 * window} needed"
        return Irregularity(**about, variation=np.full(d.size, np.nan), reason=reason)
    r = drop / np.maximum(scipy.signal.savgol_filter(drop, window, 2), 1e-3 * float(drop.max())) - 1
    weight = scipy.signal.savgol_coeffs(window, 2)[window // 2]  # weight of an event in its smoothed value
    r *= 1 / np.sqrt(1 - weight)  # the smoothed course follows part of the scatter
    square, count = (np.convolve(part, np.ones(window), "same") for part in (r**2, np.ones(d.size)))
    level = np.log(np.abs(r) + 0.05 * float(np.median(np.abs(r))) + 1e-12)
    gains = _gains(level[np.newaxis], least)[0]  # of every split
    at = int(gains.argmax()) + least
    rng = np.random.default_rng(settings.seed)
    draws = min(settings.draws, 500)  # enough to distinguish 1 % from 2 %
    shuffled = rng.permuted(np.tile(level, (draws, 1)), axis=1)
    p = float((1 + np.sum(_gains(shuffled, least).max(axis=1) >= gains.max())) / (draws + 1))
    before, after = (rms(part) for part in (r[:at], r[at:]))
    both = rms(r)
    reason, error = "", np.nan
    if p >= settings.change_p:
        reason = f"random orders of the events divide as well (p = {p:.2g})"
    elif after < before:
        reason = f"the scatter goes from {before:.2g} to {after:.2g}"
    elif _smooth_rise_is_better(level, d, at):
        reason = "the scatter rises smoothly, without a change point"
    else:
        parts = [rng.choice(part, (200, part.size)) for part in (level[:at], level[at:])]
        splits = _gains(np.concatenate(parts, axis=1), least).argmax(axis=1) + least
        error = float(np.hypot(np.std(d[splits]), np.median(np.diff(d))))
    return Irregularity(
        **about,
        variation=np.sqrt(square / count),
        change_mm=np.nan if reason else float((d[at - 1] + d[at]) / 2),
        change_err_mm=error,
        before=both if reason else before,
        after=both if reason else after,
        p=p,
        reason=reason,
    )


def _gains(level: Floats, least: int) -> Floats:
    """Return by how much each split of each row lowers the sum of squares, (row, split from `least`)."""
    n = level.shape[1]
    centred = level - level.mean(axis=1, keepdims=True)
    left = np.cumsum(centred, axis=1)[:, least - 1 : n - least]
    count = np.arange(least, n - least + 1)
    return np.asarray(left**2 * (1 / count + 1 / (n - count)))


def _smooth_rise_is_better(level: Floats, d: Floats, at: int) -> bool:
    """Return whether a line or a parabola in d describes the level as well as two levels do, by BIC. The
    parabola allows for constant noise relative to a falling ΔF, whose logarithm is curved. The position of
    the change counts as three parameters, since it is the best of many (Hall, Osborn & Sakkas 2013)."""
    n = level.size
    steps = sum(float(np.sum((part - part.mean()) ** 2)) for part in (level[:at], level[at:]))
    smooth = []
    for degree in (1, 2):
        curve = np.polynomial.Polynomial.fit(d, level, degree)
        smooth.append(n * np.log(np.sum((level - curve(d)) ** 2) / n) + (degree + 1) * np.log(n))
    return bool(min(smooth) <= n * np.log(steps / n) + 5 * np.log(n))
