"""Trends of μ, N̂ and Λ̂ with the number of previous tests and with humidity, which may be confounded."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
import scipy

from vision.comparison.joint import CompareSettings
from vision.numeric import Bools, Floats

QUANTITIES = ("mu", "N_hat_N", "Lambda_hat_mm")
PREDICTORS = ("n_test", "RH_percent")
LEAST_TESTS = 5


@dataclass(frozen=True, kw_only=True)
class Trend:
    """One quantity against one predictor.

    Parameters
    ----------
    quantity, predictor
        Columns of tests.csv.
    tests
        How many have both.
    slope, slope_err, intercept
        Weighted line, on its own.
    scatter
        Standard deviation from test to test about the line, beyond the tests' own errors.
    spearman, p
        Rank correlation, and how often random orders correlate as well.
    partial_slope, partial_slope_err, partial_p
        With the other predictor held fixed; NaN where that is not known.
    p_adjusted
        Of the partial slope where there is one, else of the rank correlation, times the number of trends
        looked at (Holm).
    claimed
        Whether `p_adjusted` is below the significance.
    reason
        Why there is no trend at all; "" where it was looked for.
    """

    quantity: str
    predictor: str
    tests: int
    slope: float = np.nan
    slope_err: float = np.nan
    intercept: float = np.nan
    scatter: float = np.nan
    spearman: float = np.nan
    p: float = np.nan
    partial_slope: float = np.nan
    partial_slope_err: float = np.nan
    partial_p: float = np.nan
    p_adjusted: float = np.nan
    claimed: bool = False
    reason: str = ""


def find_trends(table: pd.DataFrame, settings: CompareSettings | None = None) -> tuple[Trend, ...]:
    r"""All trends of a table of tests.

    Parameters
    ----------
    table
        tests.csv: the quantities with their errors, n_test and RH_percent.
    settings
        Tunable constants.

    Notes
    -----
    Weights are 1/(error² + s²), s the scatter between tests beyond their errors, found so that
    χ²/dof is 1 where it would be larger. The p value of Spearman's ρ is the share of random orders with a
    |ρ| as large. Partial slopes come from y = a + b₁ n_test + b₂ RH; their p value permutes the residuals of
    the model without the slope in question (Freedman and Lane 1983), so it holds whatever the other predictor
    does. As several trends are looked at, p values are adjusted (Holm 1979): at most one comparison in
    twenty claims any trend where there is none.
    """
    tuning = settings or CompareSettings()
    found = [
        _trend(table, quantity, predictor, tuning) for quantity in QUANTITIES for predictor in PREDICTORS
    ]
    deciding = np.array([t.p if np.isnan(t.partial_p) else t.partial_p for t in found])
    adjusted = holm(deciding)
    return tuple(
        Trend(**{**vars(t), "p_adjusted": float(p), "claimed": bool(p < tuning.significance)})
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


def _trend(table: pd.DataFrame, quantity: str, predictor: str, tuning: CompareSettings) -> Trend:
    y, error, x = (table[name].to_numpy(float) for name in (quantity, _error_of(quantity), predictor))
    known: Bools = np.isfinite(y) & np.isfinite(x) & (error > 0)
    count = int(known.sum())
    if count < LEAST_TESTS or not np.ptp(x[known]) > 0:
        reason = f"{count} tests with both, at least {LEAST_TESTS} needed" if count < LEAST_TESTS else ""
        return Trend(
            quantity=quantity, predictor=predictor, tests=count, reason=reason or f"{predictor} never changes"
        )
    rng = np.random.default_rng(tuning.seed)
    line, covariance, scatter = weighted_fit(_design(x[known]), y[known], error[known])
    rho, p = spearman(x[known], y[known], rng, tuning.draws)
    partial = _partial(table, quantity, predictor, known, rng, tuning)
    return Trend(
        quantity=quantity,
        predictor=predictor,
        tests=count,
        slope=float(line[1]),
        slope_err=float(np.sqrt(covariance[1, 1])),
        intercept=float(line[0]),
        scatter=scatter,
        spearman=rho,
        p=p,
        partial_slope=partial[0],
        partial_slope_err=partial[1],
        partial_p=partial[2],
    )


def _error_of(quantity: str) -> str:
    return {"mu": "mu_err", "N_hat_N": "N_hat_err_N", "Lambda_hat_mm": "Lambda_hat_err_mm"}[quantity]


def _design(*columns: Floats) -> Floats:
    return np.column_stack([np.ones(columns[0].size), *columns])


def weighted_fit(design: Floats, y: Floats, error: Floats) -> tuple[Floats, Floats, float]:
    """Parameters, their covariance, and the scatter beyond the errors with which χ²/dof is at most 1."""
    free = y.size - design.shape[1]

    def fit(scatter: float) -> tuple[Floats, Floats, float]:
        weight = 1 / (error**2 + scatter**2)
        covariance = np.asarray(np.linalg.pinv(design.T @ (design * weight[:, np.newaxis])), np.float64)
        value = covariance @ (design.T @ (weight * y))
        return value, covariance, float(np.sum(weight * (y - design @ value) ** 2) / max(free, 1))

    low, high = 0.0, float(np.std(y)) * 2
    if fit(0.0)[2] <= 1 or high == 0:
        return *fit(0.0)[:2], 0.0
    for _ in range(25):
        middle = (low + high) / 2
        low, high = (middle, high) if fit(middle)[2] > 1 else (low, middle)
    return *fit(high)[:2], high


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


def _partial(
    table: pd.DataFrame,
    quantity: str,
    predictor: str,
    known: Bools,
    rng: np.random.Generator,
    tuning: CompareSettings,
) -> tuple[float, float, float]:
    """Slope with the other predictor held fixed, its error and its p value; NaN where they are one."""
    nothing = (float("nan"),) * 3
    other = table[PREDICTORS[1 - PREDICTORS.index(predictor)]].to_numpy(float)
    known = known & np.isfinite(other)
    x, z = table[predictor].to_numpy(float)[known], other[known]
    if known.sum() < LEAST_TESTS + 1 or not (np.ptp(z) > 0 and np.ptp(x) > 0):
        return nothing
    if abs(np.corrcoef(x, z)[0, 1]) > 0.999:
        return nothing
    y, error = table[quantity].to_numpy(float)[known], table[_error_of(quantity)].to_numpy(float)[known]
    value, covariance, scatter = weighted_fit(_design(x, z), y, error)
    root = 1 / np.sqrt(error**2 + scatter**2)
    full, reduced = _design(x, z) * root[:, np.newaxis], _design(z) * root[:, np.newaxis]
    fitted = reduced @ (np.linalg.pinv(reduced) @ (y * root))
    rest = y * root - fitted
    drawn = fitted + rng.permuted(np.tile(rest, (tuning.draws, 1)), axis=1)
    t = np.abs(_t_of_slope(full, (y * root)[np.newaxis]))[0]
    p = (1 + np.sum(np.abs(_t_of_slope(full, drawn)) >= t * (1 - 1e-12))) / (tuning.draws + 1)
    return float(value[1]), float(np.sqrt(covariance[1, 1])), float(p)


def _t_of_slope(design: Floats, y: Floats) -> Floats:
    """Slope over its error for each row of y."""
    inverse = np.linalg.pinv(design)
    value = y @ inverse.T
    rest = y - value @ design.T
    spread = np.sqrt(np.sum(rest**2, axis=1) / (y.shape[1] - design.shape[1]))
    return np.asarray(value[:, 1] / (np.linalg.norm(inverse[1]) * np.maximum(spread, 1e-300)))
