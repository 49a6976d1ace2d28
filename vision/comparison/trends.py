"""What changes from test to test and within one: trends of μ, N̂ and Λ̂, and where ΔF turns irregular."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pandas as pd
import scipy

from vision.comparison.joint import CompareSettings, with_word
from vision.comparison.runs import TractionTest
from vision.numeric import Bools, Floats, Ints

QUANTITIES = ("mu", "N_hat_N", "Lambda_hat_mm")
PREDICTORS = ("n_test", "RH_percent")
LEAST_TESTS = 5


@dataclass(frozen=True, kw_only=True)
class Trend:
    """One quantity against one predictor."""

    quantity: str  # columns of tests.csv
    predictor: str
    tests: int  # how many have both
    slope: float = np.nan  # weighted line, on its own
    slope_err: float = np.nan
    slope_systematic: float = np.nan  # error of the geometry and Y_eff
    intercept: float = np.nan
    scatter: float = np.nan  # standard deviation of tests about the line, beyond their own errors
    spearman: float = np.nan  # rank correlation
    p: float = np.nan  # how often random orders correlate as well
    partial_slope: float = np.nan  # with the other predictor held fixed; NaN where that is not known
    partial_slope_err: float = np.nan
    partial_slope_systematic: float = np.nan
    partial_p: float = np.nan
    # of the partial slope where there is one, else of the rank correlation, times the number of trends (Holm)
    p_adjusted: float = np.nan
    claimed: bool = False  # `p_adjusted` is below the significance, the slope beyond its systematic errors
    reason: str = ""  # why there is no trend at all; "" where it was examined

    @property
    def beyond_systematic(self) -> bool:
        """Whether the slope, partial where there is one, exceeds two of its systematic errors."""
        if np.isnan(self.partial_slope):
            return abs(self.slope) > 2 * self.slope_systematic
        return abs(self.partial_slope) > 2 * self.partial_slope_systematic


def find_trends(
    table: pd.DataFrame,
    settings: CompareSettings = CompareSettings(),
    *,
    shared: Mapping[str, Floats] | None = None,
) -> tuple[Trend, ...]:
    r"""All trends of a table of tests, tests.csv: the quantities with their errors, n_test and RH_percent.

    shared: of each quantity, what errors that several tests have in common move it by, (source, test).

    Weights are 1/(error² + s²), s the scatter between tests beyond their errors, found so that
    χ²/dof is 1 where it would be larger. The p value of Spearman's ρ is the share of random orders with a
    |ρ| as large. Partial slopes come from y = a + b₁ n_test + b₂ RH; their p value permutes the residuals of
    the model without the slope in question (Freedman and Lane 1983), so it holds whatever the other predictor
    does. As there are several trends, p values are adjusted (Holm 1979): at most one comparison in
    twenty claims any trend where there is none. An error of the geometry moves all tests of a sample
    together, which no permutation knows of: a slope within two of its systematic errors is not claimed.
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
    """p values adjusted for their number; NaN stays and does not count."""
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
    if count < LEAST_TESTS:
        return Trend(**about, reason=f"{count} tests with both, at least {LEAST_TESTS} needed")
    if not np.ptp(x[known]) > 0:
        return Trend(**about, reason=f"{predictor} never changes")
    rng = np.random.default_rng(settings.seed)
    moved = np.zeros((0, y.size)) if shared is None else np.nan_to_num(shared)
    line, covariance, scatter = weighted_fit(_design(x[known]), y[known], error[known])
    rho, p = spearman(x[known], y[known], rng, settings.draws)
    found = Trend(
        **about,
        slope=float(line[1]),
        slope_err=float(np.sqrt(covariance[1, 1])),
        slope_systematic=_moved_slope(_design(x[known]), error[known], scatter, covariance, moved[:, known]),
        intercept=float(line[0]),
        scatter=scatter,
        spearman=rho,
        p=p,
    )
    z = table[PREDICTORS[1 - PREDICTORS.index(predictor)]].to_numpy(float)
    known &= np.isfinite(z)
    x, z, y, error = (part[known] for part in (x, z, y, error))
    if known.sum() < LEAST_TESTS + 1 or not (np.ptp(z) > 0 and np.ptp(x) > 0):
        return found
    if abs(np.corrcoef(x, z)[0, 1]) > 0.999:
        return found  # one and the same: neither can be held fixed
    design = _design(x, z)
    plane, covariance, scatter = weighted_fit(design, y, error)
    return replace(
        found,
        partial_slope=float(plane[1]),
        partial_slope_err=float(np.sqrt(covariance[1, 1])),
        partial_slope_systematic=_moved_slope(design, error, scatter, covariance, moved[:, known]),
        partial_p=_partial_p(design, y, 1 / np.hypot(error, scatter), rng, settings.draws),
    )


def _design(*columns: Floats) -> Floats:
    return np.column_stack([np.ones(columns[0].size), *columns])


def weighted_fit(design: Floats, y: Floats, error: Floats) -> tuple[Floats, Floats, float]:
    """Parameters, their covariance, and the scatter beyond the errors with which χ²/dof is at most 1."""
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


def _moved_slope(design: Floats, error: Floats, scatter: float, covariance: Floats, moved: Floats) -> float:
    """What the shared sources (source, test) move the first slope by, together; 0 without any."""
    weighted = design / (error**2 + scatter**2)[:, np.newaxis]
    return float(np.linalg.norm(moved @ weighted @ covariance[1]))


def spearman(x: Floats, y: Floats, rng: np.random.Generator, draws: int) -> tuple[float, float]:
    """Rank correlation and its p value from random orders."""
    a, b = scipy.stats.rankdata(x), scipy.stats.rankdata(y)
    a, b = a - a.mean(), b - b.mean()
    size = float(np.sqrt(np.sum(a**2) * np.sum(b**2)))
    if not size > 0:
        return float("nan"), float("nan")
    rho = float(a @ b) / size
    others = rng.permuted(np.tile(b, (draws, 1)), axis=1) @ a / size
    return rho, float((1 + np.sum(np.abs(others) >= abs(rho) - 1e-12)) / (draws + 1))


def _partial_p(design: Floats, y: Floats, root: Floats, rng: np.random.Generator, draws: int) -> float:
    """p value of the first slope with the other predictor held fixed; `root` of the weights."""
    full, y = design * root[:, np.newaxis], y * root
    reduced = full[:, [0, 2]]
    fitted = reduced @ (np.linalg.pinv(reduced) @ y)
    drawn = fitted + rng.permuted(np.tile(y - fitted, (draws, 1)), axis=1)
    t = np.abs(_t_of_slope(full, y[np.newaxis]))[0]
    return float((1 + np.sum(np.abs(_t_of_slope(full, drawn)) >= t * (1 - 1e-12))) / (draws + 1))


def _t_of_slope(design: Floats, y: Floats) -> Floats:
    """Slope over its error for each row of y."""
    inverse = np.linalg.pinv(design)
    value = y @ inverse.T
    rest = y - value @ design.T
    spread = np.sqrt(np.sum(rest**2, axis=1) / (y.shape[1] - design.shape[1]))
    return np.asarray(value[:, 1] / (np.linalg.norm(inverse[1]) * np.maximum(spread, 1e-300)))


# --- a change within one test -------------------------------------------------------------------------------

LEAST_SIDE = 10  # events on either side of a change


@dataclass(frozen=True, kw_only=True)
class Irregularity:
    """Running coefficient of variation of ΔF, and where it changes."""

    run: str
    speed_mm_min: float
    d_mm: Floats = field(repr=False)  # separation of each event
    variation: Floats = field(repr=False)  # running coefficient of variation there
    change_mm: float  # where it rises; NaN where there is no change
    change_err_mm: float
    before: float  # coefficient of variation on either side; the same where there is no change
    after: float
    p: float  # how often a test without a change looks as changed as this one
    reason: str  # why there is no change point; "" where there is one


def find_irregular(test: TractionTest, settings: CompareSettings = CompareSettings()) -> Irregularity:
    r"""Where the scatter of ΔF changes for good.

    The relative deviation r of ΔF from its own smooth course has the running coefficient of variation
    √⟨r²⟩. The change point is the split that best divides log|r| into two levels, which single large events
    cannot mimic. It is claimed where fewer than 1 % of random orders of r divide as well, the scatter rises
    by half or more, and two levels describe it better (BIC) than a smooth rise, as that of noise over a
    falling ΔF. Its error is the spread of the place over 200 bootstrap draws within the two parts.
    """
    d, drop = test.column("d_v_mm"), test.column("dF_N")
    nan = float("nan")
    whole: dict[str, Any] = {"run": test.run, "speed_mm_min": test.speed_mm_min, "d_mm": d}
    window = settings.smooth_events | 1
    if d.size < max(2 * window, 2 * LEAST_SIDE + 1):
        unknown: dict[str, Any] = dict.fromkeys(("change_mm", "change_err_mm", "before", "after", "p"), nan)
        reason = f"{d.size} events, at least {2 * window} needed"
        return Irregularity(**whole, **unknown, variation=np.full(d.size, nan), reason=reason)
    r = drop / np.maximum(scipy.signal.savgol_filter(drop, window, 2), 1e-3 * float(drop.max())) - 1
    own = scipy.signal.savgol_coeffs(window, 2)[window // 2]  # share of its own value in the smoothed one
    r *= 1 / np.sqrt(1 - own)  # a smooth course takes part of the scatter with it
    square, count = (np.convolve(part, np.ones(window), "same") for part in (r**2, np.ones(d.size)))
    level = np.log(np.abs(r) + 0.05 * float(np.median(np.abs(r))) + 1e-12)
    at = int(_splits(level[np.newaxis])[0])
    rng = np.random.default_rng(settings.seed)
    draws = min(settings.draws, 500)  # enough to tell 1 % from 2 %
    shuffled = rng.permuted(np.tile(level, (draws, 1)), axis=1)
    best = _gains(level[np.newaxis])[0].max()
    p = float((1 + np.sum(_gains(shuffled).max(axis=1) >= best)) / (draws + 1))
    before, after = (float(np.sqrt(np.mean(part**2))) for part in (r[:at], r[at:]))
    both = float(np.sqrt(np.mean(r**2)))
    reason = _why_not(p, before, after, _steady_rise_is_better(level, d, at), settings)
    error = nan
    if not reason:
        parts = [rng.choice(part, (200, part.size)) for part in (level[:at], level[at:])]
        places = _splits(np.concatenate(parts, axis=1))
        error = float(np.hypot(np.std(d[places]), np.median(np.diff(d))))
    return Irregularity(
        **whole,
        variation=np.sqrt(square / count),
        change_mm=nan if reason else float((d[at - 1] + d[at]) / 2),
        change_err_mm=error,
        before=both if reason else before,
        after=both if reason else after,
        p=p,
        reason=reason,
    )


def _gains(level: Floats) -> Floats:
    """How much each split of each row lowers the sum of squares, (row, split); splits from LEAST_SIDE on."""
    n = level.shape[1]
    centred = level - level.mean(axis=1, keepdims=True)
    left = np.cumsum(centred, axis=1)[:, LEAST_SIDE - 1 : n - LEAST_SIDE]
    count = np.arange(LEAST_SIDE, n - LEAST_SIDE + 1)
    return np.asarray(left**2 * (1 / count + 1 / (n - count)))


def _splits(level: Floats) -> Ints:
    """First event after the best split of each row."""
    return np.asarray(_gains(level).argmax(axis=1) + LEAST_SIDE)


def _steady_rise_is_better(level: Floats, d: Floats, at: int) -> bool:
    """Whether a line or a parabola in d describes the level as well as two levels do, by BIC.

    The parabola is there for measuring noise over a falling ΔF, whose logarithm bends. The place of the
    change counts as three parameters, since it is the best of many (Hall, Osborn & Sakkas 2013).
    """
    n = level.size
    steps = sum(float(np.sum((part - part.mean()) ** 2)) for part in (level[:at], level[at:]))
    smooth = []
    for degree in (1, 2):
        curve = np.polynomial.Polynomial.fit(d, level, degree)
        smooth.append(n * np.log(np.sum((level - curve(d)) ** 2) / n) + (degree + 1) * np.log(n))
    return bool(min(smooth) <= n * np.log(steps / n) + 5 * np.log(n))


def _why_not(p: float, before: float, after: float, steady: bool, settings: CompareSettings) -> str:
    """Why a split of the events is no change point; "" where it is one."""
    if p >= settings.change_p:
        return f"random orders of the events divide as well (p = {p:.2g})"
    if after < settings.change_ratio * before:
        return f"the scatter goes from {before:.2g} to {after:.2g}"
    return "the scatter rises steadily, at no one place" if steady else ""
