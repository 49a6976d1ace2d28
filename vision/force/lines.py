"""Straight and broken lines through many stretches of a signal at once."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def flat_ranges(start: Ints, stop: Ints) -> tuple[Ints, Ints]:
    """(row, index) of every integer in [start, stop) of every row, one after the other."""
    count = np.maximum(stop - start, 0)
    row = np.repeat(np.arange(start.size), count)
    index = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count) + np.repeat(start, count)
    return row, index


@dataclass(frozen=True)
class Lines:
    """Least-squares lines, one per stretch: y = mean_y + slope (x - mean_x).

    count: samples used.  spread: residual standard deviation.  sxx: sum of (x - mean_x)².  All NaN with fewer
    than three samples or where x does not vary.
    """

    slope: Floats
    mean_x: Floats
    mean_y: Floats
    sxx: Floats
    spread: Floats
    count: Floats

    def at(self, x: Floats) -> Floats:
        """The lines' values."""
        return self.mean_y + self.slope * (x - self.mean_x)

    def error_at(self, x: Floats, noise: float) -> Floats:
        """Standard error of the lines' values for white noise."""
        return np.asarray(noise * np.sqrt(1 / self.count + (x - self.mean_x) ** 2 / self.sxx))

    @property
    def slope_error(self) -> Floats:
        """Standard error of the slopes, from the residuals."""
        return self.spread / np.sqrt(self.sxx)

    def take(self, rows: slice) -> Lines:
        """Some of the lines."""
        return Lines(*(getattr(self, part.name)[rows] for part in fields(self)))


def fit_lines(x: Floats, y: Floats, start: Ints, stop: Ints) -> Lines:
    """Lines through (x, y) over [start, stop), one per row; NaN in y is left out."""
    row, index = flat_ranges(start, stop)
    keep = np.isfinite(y[index]) & np.isfinite(x[index])
    row, index = row[keep], index[keep]

    def total(values: Floats) -> Floats:
        return np.bincount(row, weights=values, minlength=start.size).astype(float)

    count = np.bincount(row, minlength=start.size).astype(float)
    with np.errstate(divide="ignore", invalid="ignore"):
        count[count < 3] = np.nan
        mean_x, mean_y = total(x[index]) / count, total(y[index]) / count
        dx, dy = x[index] - mean_x[row], y[index] - mean_y[row]
        sxx = total(dx * dx)
        sxx[sxx <= 0] = np.nan
        slope = total(dx * dy) / sxx
        spread = np.sqrt(total((dy - slope[row] * dx) ** 2) / np.maximum(count - 2, 1))
    return Lines(slope, mean_x, mean_y, sxx, spread, count)


@dataclass(frozen=True)
class BrokenLines:
    """Continuous two-slope lines: slope `first` up to `knee` (fraction of the stretch), then `second`.

    gain: how many times smaller the squared residual is than a single line's; about 1 where one line does.
    """

    first: Floats
    second: Floats
    knee: Floats
    gain: Floats


_KNEES = np.linspace(0.15, 0.85, 15)
_NO_KNEE = 2.0


def fit_broken_lines(x: Floats, y: Floats, start: Ints, stop: Ints) -> BrokenLines:
    """The best of 15 knees between 15 and 85 % of each stretch; NaN with fewer than 12 samples."""
    row, index = flat_ranges(start, stop)
    keep = np.isfinite(y[index]) & np.isfinite(x[index])
    row, index = row[keep], index[keep]
    low, span = _extent(x[index], row, start.size)
    u = (x[index] - low[row]) / span[row]
    straight, _ = _hinges(u, y[index], row, start.size, _NO_KNEE)
    fits = [_hinges(u, y[index], row, start.size, knee) for knee in _KNEES]
    squares = np.array([square for square, _ in fits])
    best = np.argmin(squares, axis=0)
    chosen = best, np.arange(start.size)
    slopes = np.array([slope for _, slope in fits])[chosen] / span[:, np.newaxis]
    return BrokenLines(
        slopes[:, 0],
        slopes.sum(axis=1),
        np.where(np.isfinite(span), _KNEES[best], np.nan),
        straight / np.maximum(squares[chosen], np.finfo(float).tiny),
    )


def _extent(x: Floats, row: Ints, rows: int) -> tuple[Floats, Floats]:
    """(lowest x, span) of each row; the span is NaN where 12 samples are not there or x does not vary."""
    low, high = np.full(rows, np.inf), np.full(rows, -np.inf)
    np.minimum.at(low, row, x)
    np.maximum.at(high, row, x)
    good = (np.bincount(row, minlength=rows) >= 12) & (high > low)
    span = np.subtract(high, low, out=np.full(rows, np.nan), where=good)
    return np.where(good, low, 0.0), span


def _hinges(u: Floats, y: Floats, row: Ints, rows: int, knee: float) -> tuple[Floats, Floats]:
    """(sum of squares left, [slope, its change at the knee]) of y = a + b u + c max(0, u - knee)."""
    design = np.stack([np.ones_like(u), u, np.maximum(0.0, u - knee)], axis=1)
    design[~np.isfinite(u)] = 0.0
    matrix = np.zeros((rows, 3, 3))
    right = np.zeros((rows, 3))
    np.add.at(matrix, row, design[:, :, np.newaxis] * design[:, np.newaxis, :])
    np.add.at(right, row, design * y[:, np.newaxis])
    solution = (np.linalg.pinv(matrix, hermitian=True) @ right[:, :, np.newaxis])[:, :, 0]
    residual = y - np.sum(design * solution[row], axis=1)
    return np.bincount(row, weights=residual**2, minlength=rows).astype(float), solution[:, 1:]
