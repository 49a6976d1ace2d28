"""Least-squares lines, lines with a knee and polynomials through many stretches of a signal at once."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.polynomial.legendre import legvander
from numpy.typing import NDArray

from vision.numeric import Floats, Ints, Rows, flat_ranges

LEAST_FOR_KNEE = 12  # samples of a stretch below which two slopes cannot be fitted


@dataclass(frozen=True)
class Lines(Rows):
    """Least-squares lines, one per stretch: y = mean_y + slope (x - mean_x).

    All are NaN with fewer than three samples or where x does not vary.
    """

    slope: Floats
    mean_x: Floats
    mean_y: Floats
    sxx: Floats  # sum of (x - mean_x)²
    spread: Floats  # residual standard deviation
    count: Floats  # samples used

    def at(self, x: Floats) -> Floats:
        """Return the value of each line at x."""
        return self.mean_y + self.slope * (x - self.mean_x)

    def lever(self, x: Floats) -> Floats:
        """Return the standard error of each line at x for residuals of standard deviation 1."""
        return np.asarray(np.sqrt(1 / self.count + (x - self.mean_x) ** 2 / self.sxx), np.float64)

    @property
    def squares(self) -> Floats:
        """Sum of squared residuals of each line; valid without a lag."""
        return np.asarray(self.spread**2 * np.maximum(self.count - 2, 1))

    @property
    def slope_error(self) -> Floats:
        """Standard error of the slopes, from the residuals."""
        return self.spread / np.sqrt(self.sxx)

    @classmethod
    def joined(cls, parts: Sequence[Lines]) -> Lines:
        """Return the lines of all parts."""
        return cls(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)))


class FittedLoad:
    """A load whose stretches are fitted with lines once each, however often they are asked for."""

    def __init__(self, y: Floats) -> None:
        self.y = y
        self._x = np.arange(y.size, dtype=float)
        self._known = np.empty(0, np.int64)  # the stretches as numbers in ascending order
        self._lines = Lines(*[np.empty(0) for _ in fields(Lines)])

    def lines(self, start: Ints, stop: Ints) -> Lines:
        """Return the lines through half-open ranges of samples."""
        base = self.y.size + 1
        asked = start * base + stop
        new = np.setdiff1d(asked, self._known)
        if new.size:
            fitted = fit_lines(self._x, self.y, *np.divmod(new, base))
            known = np.concatenate([self._known, new])
            order = np.argsort(known)
            self._known, self._lines = known[order], Lines.joined([self._lines, fitted]).take(order)
        return self._lines.take(np.searchsorted(self._known, asked))


def fit_lines(x: Floats, y: Floats, start: Ints, stop: Ints, *, lag: float = 0.0) -> Lines:
    """Fit one line to (x, y) over each half-open range of samples; NaN samples are left out.

    `lag` is the time constant, in samples, of a first-order low-pass that y went through. With a lag an
    exponential of free height fits the transient, and the line is that of the signal before the low-pass.
    """
    # Blocks that the processor's cache holds take half the time.
    block = np.cumsum(stop - start) // 32_768
    cuts = [0, *np.flatnonzero(np.diff(block)) + 1, start.size]
    return Lines.joined([_fit_lines(x, y, start[a:b], stop[a:b], lag) for a, b in pairwise(cuts)])


def _fit_lines(x: Floats, y: Floats, start: Ints, stop: Ints, lag: float) -> Lines:
    """Fit the lines of one block of `fit_lines`."""
    row, index = _known_samples(x, y, start, stop)
    rows = _Rows(row, start.size, least=4 if lag else 3)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean_x, mean_y = rows.mean(x[index]), rows.mean(y[index])
        dx, dy = x[index] - rows.at(mean_x), y[index] - rows.at(mean_y)
        if lag:
            mean_x = mean_x - lag * rows.total(dx * index) / rows.total(
                (index - rows.at(rows.mean(index))) * index
            )
            transient = np.exp(-(index - start[row]) / lag)
            offset = rows.mean(transient)
            transient -= rows.at(offset)
            squares = rows.total(transient**2)
            height_x, height_y = (rows.total(part * transient) / squares for part in (dx, dy))
            dx, dy = dx - rows.at(height_x) * transient, dy - rows.at(height_y) * transient
        sxx = rows.total(dx * dx)
        sxx[sxx <= 0] = np.nan
        slope = rows.total(dx * dy) / sxx
        if lag:
            mean_y = mean_y - (height_y - slope * height_x) * offset
        spread = np.sqrt(
            rows.total((dy - rows.at(slope) * dx) ** 2) / np.maximum(rows.count - (3 if lag else 2), 1)
        )
    return Lines(slope, mean_x, mean_y, sxx, spread, rows.count)


def _known_samples(x: Floats, y: Floats, start: Ints, stop: Ints) -> tuple[Ints, Ints]:
    """Return `flat_ranges` without the samples whose x or y is NaN."""
    row, index = flat_ranges(start, stop)
    known = np.isfinite(y[index]) & np.isfinite(x[index])
    return (row, index) if known.all() else (row[known], index[known])


class _Rows:
    """Sums over the samples of each row, in order; the count is NaN for rows of fewer than `least`."""

    def __init__(self, row: Ints, rows: int, least: int) -> None:
        size = np.bincount(row, minlength=rows)
        self._size, self._filled = size, np.flatnonzero(size)
        self._first = (np.cumsum(size) - size)[self._filled]
        self.count = np.where(size < least, np.nan, size)

    def total(self, values: NDArray[Any]) -> Floats:
        total = np.zeros(self.count.size)
        total[self._filled] = np.add.reduceat(values, self._first)  # twice as fast as np.bincount
        return total

    def mean(self, values: NDArray[Any]) -> Floats:
        return np.asarray(self.total(values) / self.count)

    def at(self, each: Floats) -> Floats:
        """Return the value of its row at every sample."""
        return np.repeat(each, self._size)


def fit_polynomials(y: Floats, start: Ints, stop: Ints, degree: int = 4) -> tuple[Floats, Floats, Ints]:
    """Fit a polynomial to each stretch of 10 samples or more.

    Returns the coefficients (rows, degree + 1) of Legendre polynomials over each stretch, and the residual
    and the row of each sample.
    """
    row, index = flat_ranges(start, stop)
    size = degree + 1
    terms = legvander(2 * (index - start[row]) / (stop - 1 - start)[row] - 1, degree).T
    rows = _Rows(row, start.size, least=0)
    value = y[index] - rows.at(rows.mean(y[index]))  # keeps the digits of the sums
    products = np.empty((start.size, size, size + 1))
    for k, one in enumerate(terms):
        products[:, k, size] = rows.total(one * value)
        for m, other in enumerate(terms[: k + 1]):
            products[:, k, m] = products[:, m, k] = rows.total(one * other)
    found = np.asarray(np.linalg.solve(products[:, :, :size], products[:, :, size:])[:, :, 0], np.float64)
    for part, one in zip(found.T, terms, strict=True):
        value -= rows.at(part) * one
    return found, value, row


@dataclass(frozen=True)
class BrokenLines:
    """Continuous lines with a knee, one per stretch."""

    first: Floats  # slope before the knee
    second: Floats  # slope after the knee
    knee: Floats  # position of the knee, as a fraction of the stretch
    low: Floats  # begin of each stretch in x
    span: Floats  # length of each stretch in x
    level: Floats  # value at low
    gain: Floats  # squared residual of a single line over that of the line with a knee

    @property
    def knee_x(self) -> Floats:
        """Position of the knee in x."""
        return self.low + self.knee * self.span

    def first_at(self, x: Floats) -> Floats:
        """Return the value at x of the line before the knee, extended."""
        return self.level + self.first * (x - self.low)

    def second_at(self, x: Floats) -> Floats:
        """Return the value at x of the line after the knee, extended."""
        return self.first_at(self.knee_x) + self.second * (x - self.knee_x)


def fit_broken_lines(x: Floats, y: Floats, start: Ints, stop: Ints, *, lag: float = 0.0) -> BrokenLines:
    """Fit a line with the best of 15 knees, from 15 to 85 % of each stretch.

    NaN with fewer than 12 samples or where x does not vary. Parameters are those of `fit_lines`.
    """
    row, index = _known_samples(x, y, start, stop)
    low, high = np.full(start.size, np.inf), np.full(start.size, -np.inf)
    np.minimum.at(low, row, x[index])
    np.maximum.at(high, row, x[index])
    good = (np.bincount(row, minlength=start.size) >= LEAST_FOR_KNEE) & (high > low)
    span = np.subtract(high, low, out=np.full(start.size, np.nan), where=good)
    low = np.where(good, low, 0.0)
    u = (x[index] - low[row]) / span[row]
    late = lag / np.maximum(stop - start - 1.0, 1.0)
    transient = np.exp(-(index - start[row]) / lag) if lag else np.zeros_like(u)
    knees = np.linspace(0.15, 0.85, 15)
    # A knee at 2, beyond the end, is a single line.
    (straight, _), *fits = _fit_hinges(u, y[index], row, transient, late, [2.0, *knees])
    squares = np.array([square for square, _ in fits])
    best = np.argmin(squares, axis=0)
    chosen = best, np.arange(start.size)
    level, slope, change = np.moveaxis(np.array([solution for _, solution in fits])[chosen][:, :3], 1, 0)
    return BrokenLines(
        first=slope / span,
        second=(slope + change) / span,
        knee=np.where(np.isfinite(span), knees[best], np.nan),
        low=low,
        span=span,
        level=level + slope * late,
        gain=straight / np.maximum(squares[chosen], np.finfo(float).tiny),
    )


def lagged_hinge(t: Floats, tau: Floats | float) -> Floats:
    """Return max(0, t) after a first-order low-pass of time constant tau, in the unit of t."""
    late = np.maximum(t, 0.0)
    if not np.any(tau):
        return late
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(np.greater(tau, 0), late + tau * np.expm1(-late / tau), late)


def bend_squares(y: Floats, start: Ints, stop: Ints, knee: Floats) -> Floats:
    """Return the squared residuals of a line with its knee at index `knee`; 12 samples or more each."""
    row, index = flat_ranges(start, stop)
    span = stop - 1 - start
    u, knee = (index - start[row]) / span[row], ((knee - start) / span)[row]
    ((squares, _),) = _fit_hinges(u, y[index], row, np.zeros_like(u), np.zeros(start.size), [knee])
    return squares


def _fit_hinges(
    u: Floats, y: Floats, row: Ints, transient: Floats, late: Floats, knees: Iterable[float | Floats]
) -> list[tuple[Floats, Floats]]:
    """Fit y = a + b u + c max(0, u - knee) + transient to each row, once for each of the knees.

    u goes from 0 to 1 in each row; `late` is the lag of each row, in u. Returns for each knee the squared
    residuals and the coefficients (a, b, c, transient) of each row.
    """
    rows = _Rows(row, late.size, least=0)
    columns = np.where(np.isfinite(u), [np.ones_like(u), u, np.zeros_like(u), transient], 0.0)
    # All knees share the products of the columns, and those with y, except for those of the hinge.
    products = np.zeros((late.size, 4, 4))
    for a, b in ((0, 0), (0, 1), (0, 3), (1, 1), (1, 3), (3, 3)):
        products[:, a, b] = products[:, b, a] = rows.total(columns[a] * columns[b])
    with_y = np.stack([rows.total(column * y) for column in columns], axis=1)
    fits = []
    for knee in knees:
        hinge = lagged_hinge(u - knee, late[row])
        columns[2] = np.where(np.isfinite(hinge), hinge, 0.0)
        for k in range(4):
            products[:, 2, k] = products[:, k, 2] = rows.total(columns[2] * columns[k])
        with_y[:, 2] = rows.total(columns[2] * y)
        solution = (np.linalg.pinv(products, hermitian=True) @ with_y[:, :, np.newaxis])[:, :, 0]
        residual = y - np.sum(columns * solution.T[:, row], axis=0)
        fits.append((rows.total(residual**2), solution))
    return fits
