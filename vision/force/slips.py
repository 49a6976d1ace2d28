"""Where a sawtooth drops: candidates from a step filter, kept where the stick lines say there is a drop."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vision.force.lines import Bools, Floats, Ints, Lines, bend_squares, fit_lines

_WIDTH_OF_PERIOD = 0.15
_CANDIDATE_Z = 5.5
_SPLIT_Z = 5.0
_LEAST_FOR_KNEE = 12
_THRESHOLD_SIGMAS = 4.0
_GAP_FACTOR = 3.0
_EVENTS_PER_STRETCH = 20
_LINE_PART = 0.8
_REACH_WIDTHS = 16
_RUNNING = 9


@dataclass(frozen=True)
class Slips:
    """Drops between samples, and the stick lines on both sides.

    edge: index of the first sample after the steepest drop.  drop: height between the two lines there.
    period: median samples from slip to slip.  threshold: smallest drop kept.
    threshold_how: "noise", "gap" or "given".
    """

    edge: Ints
    drop: Floats
    period: float
    threshold: float
    threshold_how: str


def find_slips(y: Floats, sigma: float, *, threshold: float | None = None) -> Slips:
    """Slips of a spike-free sawtooth with white noise `sigma`.

    A step filter as wide as 0.15 periods (found stretch by stretch) proposes drops.  Neighbouring sticks are
    joined where one line, straight or with a knee, fits both as well as two, or where what lies between two
    drops falls.
    What stays is kept where the lines on both sides, extended to the drop, differ by the threshold: unless
    given 4 σ of one sample, or the middle of the widest gap in the logarithm of the drops where one parts
    small ones from the rest.  Drops are measured between fitted lines, so 4 σ here is stricter than 6 σ
    between single samples.  No slips: empty arrays.

    Args: y, load, finite.  sigma and threshold in the unit of y.
    """
    edge = _edges(y, _first_period(y, sigma), sigma)
    edge = _edges(y, _local_period(edge, y.size), sigma)
    drop = stick_drops(y, edge)
    least, how = (_THRESHOLD_SIGMAS * sigma, "noise") if threshold is None else (threshold, "given")
    keep = drop >= least
    if threshold is None and (gap := _gap(drop[keep])) > least:
        keep, least, how = drop >= gap, gap, "gap"
    period = float(np.median(np.diff(edge[keep]))) if keep.sum() > 1 else float("nan")
    return Slips(edge[keep], drop[keep], period, least, how)


def stick_lines(y: Floats, edge: Ints) -> Lines:
    """Lines through the middle 80 % of the stretches between edges: one more than there are edges."""
    return fit_lines(np.arange(y.size, dtype=float), y, *stick_middles(edge, y.size))


def stick_middles(edge: Ints, size: int) -> tuple[Ints, Ints]:
    """[start, stop) of the middle 80 % of each stretch between edges."""
    bounds = np.r_[0, edge, size]
    length = np.diff(bounds)
    margin = np.minimum((0.5 * (1 - _LINE_PART) * length).astype(np.int64), np.maximum(length - 3, 0) // 2)
    return bounds[:-1] + margin, bounds[1:] - margin


def _step(y: Floats, half: Ints) -> Floats:
    """Mean of `half` samples before each index less the mean of as many from it on; NaN at the ends."""
    total = np.r_[0.0, np.cumsum(y - y.mean())]
    index = np.arange(y.size)
    low, high = index - half, index + half
    inside = (low >= 0) & (high <= y.size)
    low, high = np.where(inside, low, 0), np.where(inside, high, 0)
    step = (2 * total[index] - total[low] - total[high]) / half
    return np.where(inside, step, np.nan)


def _peaks(y: Floats, half: Ints, sigma: float) -> Ints:
    """Where the step filter stands out by 5.5 of its own standard deviations for white noise.

    Prominence, not height: the filter's level on a stick follows the stiffness and the filter's width.
    """
    from scipy.signal import find_peaks

    standard = np.nan_to_num(_step(y, half) / (sigma * np.sqrt(2.0 / half)), nan=-np.inf)
    narrowest, reach = max(int(half.min()), 1), _REACH_WIDTHS * int(half.max())
    with warnings.catch_warnings():
        # A load that holds still leaves a level filter: no peak, and nothing to warn of.
        warnings.filterwarnings("ignore", "some peaks have a prominence of 0", RuntimeWarning)
        found, _ = find_peaks(standard, prominence=_CANDIDATE_Z, distance=narrowest, wlen=reach)
    return np.asarray(found, dtype=np.int64)


def _edges(y: Floats, period: Floats, sigma: float) -> Ints:
    half = np.clip(np.rint(_WIDTH_OF_PERIOD * period), 2, None).astype(np.int64)
    return _slips_only(y, _whole(y, _significant(y, _peaks(y, half, sigma), sigma)), sigma)


def _first_period(y: Floats, sigma: float) -> Floats:
    """Samples from drop to drop at every sample, each stretch at the scale of filter that suits it."""
    scales = np.unique(np.geomspace(2, max(y.size // 12, 3), 24).astype(np.int64))
    found = [_peaks(y, np.full(1, scale), sigma) for scale in scales]
    whole = _best_scale(scales, found, 0, y.size) or (y.size / 3, 0)
    stretches = int(np.clip(whole[1] // _EVENTS_PER_STRETCH, 1, 64))
    bounds = np.linspace(0, y.size, stretches + 1)
    periods = np.array([(_best_scale(scales, found, a, b) or whole)[0] for a, b in pairwise(bounds)])
    return _spread(0.5 * (bounds[:-1] + bounds[1:]), periods, y.size)


def _local_period(edge: Ints, size: int) -> Floats:
    """The same from drops already found: a running median of nine spacings."""
    from scipy.ndimage import median_filter

    if edge.size < 3:
        return np.full(size, max(size / 3, 1.0))
    spacing = median_filter(np.diff(edge).astype(float), size=_RUNNING, mode="nearest")
    return _spread(0.5 * (edge[1:] + edge[:-1]), spacing, size)


def _spread(index: NDArray[np.floating[Any]], period: Floats, size: int) -> Floats:
    return np.exp(np.interp(np.arange(size), index, np.log(period)))


def _best_scale(scales: Ints, found: list[Ints], start: float, stop: float) -> tuple[float, int] | None:
    """(period, drops) at the scale that sees most drops and is at most a quarter of their spacing."""
    best: tuple[float, int] | None = None
    for scale, peaks in zip(scales, found, strict=True):
        inside = peaks[(peaks >= start) & (peaks < stop)]
        spacing = float(np.median(np.diff(inside))) if inside.size >= 3 else 0.0
        # Of scales that see the same drops the widest has the least noise.
        if scale <= 0.25 * spacing and (best is None or inside.size >= best[1]):
            best = spacing, inside.size
    return best


def _significant(y: Floats, edge: Ints, sigma: float) -> Ints:
    """Joins neighbouring sticks that one line fits as well as two, least certain edge first."""
    while edge.size:
        lines = stick_lines(y, edge)
        score = _split_gain(lines.take(slice(None, -1)), lines.take(slice(1, None))) / sigma**2
        weak = ~(score > _SPLIT_Z**2)
        if not weak.any():
            break
        score = np.where(weak, np.nan_to_num(score, nan=-1.0), np.inf)
        padded = np.r_[np.inf, score, np.inf]
        edge = edge[~(weak & (padded[1:-1] <= padded[:-2]) & (padded[1:-1] < padded[2:]))]
    return edge


def _whole(y: Floats, edge: Ints) -> Ints:
    """Joins the parts of one slip: between two of them the load falls, or there is no room for a line."""
    while edge.size > 1:
        falling = np.flatnonzero(~(stick_lines(y, edge).slope[1:-1] > 0))
        if not falling.size:
            break
        drop = np.nan_to_num(stick_drops(y, edge), nan=-np.inf)
        edge = np.delete(edge, np.where(drop[falling] < drop[falling + 1], falling, falling + 1))
    return edge


def _slips_only(y: Floats, edge: Ints, sigma: float) -> Ints:
    """Joins what a line with a knee, without any drop, fits as well as two lines.

    The load never falls at a knee, but lines that meet a little before an edge lie apart at it.
    """
    x = np.arange(y.size, dtype=float)
    doubtful = np.arange(edge.size)
    while doubtful.size:
        bounds = np.r_[0, edge, y.size]
        low, at, high = bounds[doubtful], edge[doubtful], bounds[doubtful + 2]
        knee = _is_knee(x, y, low, at, high, sigma)
        # One of two neighbours at a time: the other may be a slip once they are joined.
        gone = doubtful[knee]
        gone = gone[np.diff(gone, prepend=-2) > 1]
        beside = np.setdiff1d(np.r_[gone - 1, gone + 1], gone)
        beside = beside[(beside >= 0) & (beside < edge.size)]
        doubtful = beside - np.searchsorted(gone, beside)
        edge = np.delete(edge, gone)
    return edge


def _is_knee(x: Floats, y: Floats, low: Ints, edge: Ints, high: Ints, sigma: float) -> Bools:
    """Whether a line with a knee fits [low, high) about as well as one line before and one after the edge."""
    before, after = fit_lines(x, y, low, edge), fit_lines(x, y, edge, high)
    here = np.asarray(edge - 0.5, dtype=float)
    with np.errstate(divide="ignore", invalid="ignore"):
        meet = here - (before.at(here) - after.at(here)) / (before.slope - after.slope)
    knee = (meet > low) & (meet < high) & (high - low >= _LEAST_FOR_KNEE)
    squares = bend_squares(x, y, low[knee], high[knee], meet[knee])
    knee[knee] = squares - (before.squares + after.squares)[knee] < _SPLIT_Z**2 * sigma**2
    return np.asarray(knee)


def _split_gain(a: Lines, b: Lines) -> Floats:
    """By how much two lines instead of one lower the sum of squares over both stretches."""
    weight = a.count * b.count / (a.count + b.count)
    apart_x, apart_y = b.mean_x - a.mean_x, b.mean_y - a.mean_y
    sxy = a.slope * a.sxx + b.slope * b.sxx
    joint_sxx = a.sxx + b.sxx + weight * apart_x**2
    joint_sxy = sxy + weight * apart_x * apart_y
    return weight * apart_y**2 + a.slope**2 * a.sxx + b.slope**2 * b.sxx - joint_sxy**2 / joint_sxx


def stick_drops(y: Floats, edge: Ints) -> Floats:
    """Height between the stick lines on both sides of each edge."""
    lines = stick_lines(y, edge)
    here = np.asarray(edge - 0.5, dtype=float)
    return lines.take(slice(None, -1)).at(here) - lines.take(slice(1, None)).at(here)


def _gap(drop: NDArray[np.float64]) -> float:
    """The middle of the widest gap in log(drop) below the median; 0 where none spans a factor of 3."""
    ordered = np.sort(drop[drop > 0])
    if ordered.size < 8:
        return 0.0
    lower = np.log(ordered[: ordered.size // 2 + 1])
    widest = int(np.argmax(np.diff(lower)))
    if np.diff(lower)[widest] < np.log(_GAP_FACTOR) or widest + 1 < 0.02 * ordered.size:
        return 0.0
    return float(np.exp(0.5 * (lower[widest] + lower[widest + 1])))
