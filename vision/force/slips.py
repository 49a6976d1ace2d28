"""Where a sawtooth drops: the slips of a recording.

Candidates from a step filter become slips where the stick lines on both sides show a drop.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from vision.force.lines import LEAST_FOR_KNEE, Lines, bend_squares, fit_lines, fit_polynomials, flat_ranges
from vision.force.settings import ForceSettings
from vision.numeric import Floats, Ints, nan_median
from vision.signals import apart, find_maxima, running_median


@dataclass(frozen=True)
class Slips:
    """Drops of the load, each between two samples."""

    edge: Ints  # index of the first sample after the steepest drop
    drop: Floats  # height between the stick lines on both sides there
    period: float  # median samples from slip to slip; NaN with fewer than two
    threshold: float  # smallest drop kept
    # "noise" (a multiple of it), "jumps" (above those upward), "gap" (between small and large drops) or
    # "given"
    threshold_how: str
    left_out: Floats  # drops beyond the white noise that are below the threshold
    jumps: int = 0  # upward ones as large as the drops kept: about so many of these are no slips


def find_slips(
    y: Floats, sigma: float, *, threshold: float | None = None, settings: ForceSettings = ForceSettings()
) -> Slips:
    """Slips of a sawtooth without spikes.

    y: load, finite.  sigma: standard deviation of its white noise, in the unit of y.  threshold: smallest
    drop that is a slip; by default 4 sigma, or the middle of the widest gap in the logarithm of the drops
    where one separates small from large ones.  Empty arrays where there are no slips.

    A step filter as wide as 0.15 periods, the period found stretch by stretch, proposes drops. Neighbouring
    sticks are joined where one line, straight or with a knee, fits both as well as two, or where the load
    falls between two drops. What remains is kept where the lines on both sides, extended to the drop, differ
    by the threshold. Drops are measured between fitted lines, so 4 sigma here is stricter than 6 sigma
    between single samples.

    Noise that is not white, knocks and ringing jump up as they jump down; slips do not. Jumps upward within
    the sticks therefore tell how many drops of each size are none, and may raise the threshold.
    """
    edge = _edges(y, _first_period(y, sigma, settings), sigma, settings)
    edge = _edges(y, _local_period(edge, y.size), sigma, settings)
    drop = _stick_drops(y, edge, settings)
    least, how = (settings.threshold_sigmas * sigma, "noise") if threshold is None else (threshold, "given")
    keep, left_out, jump = drop >= least, np.empty(0), np.empty(0)
    if threshold is None and (jump := _jumps_upward(y, edge, sigma, settings, least)).size:
        # The threshold that leaves most slips over, every jump upward but one counting against some.
        steps = np.r_[least, np.nextafter(np.sort(jump), np.inf)]
        above = np.sum(drop >= steps[:, np.newaxis], axis=1)
        balance = above - settings.jump_cost * np.maximum(jump.size - 1 - np.arange(steps.size), 0)
        best = int(np.argmax(balance))
        if best:
            left_out = drop[keep & (drop < steps[best])]
            keep, least, how = drop >= steps[best], float(steps[best]), "jumps"
    if threshold is None and (gap := size_gap(drop[keep], settings.threshold_gap, 0.5)) > least:
        left_out = drop[(drop >= settings.threshold_sigmas * sigma) & (drop < gap)]
        keep, least, how = drop >= gap, gap, "gap"
    period = float(np.median(np.diff(edge[keep]))) if keep.sum() > 1 else float("nan")
    return Slips(edge[keep], drop[keep], period, least, how, left_out, int(np.sum(jump >= least)))


def _jumps_upward(y: Floats, edge: Ints, sigma: float, settings: ForceSettings, least: float) -> Floats:
    """Heights of the jumps upward between the edges: drops, of `least` or more, of each stick's mirror image.

    A stick is mirrored about a parabola through it, which keeps its rise and turns what is on it.
    """
    bounds = np.r_[0, edge, y.size]
    whole = np.flatnonzero(np.diff(bounds) > 2 * settings.few_samples)
    _, left, _ = fit_polynomials(y, bounds[whole], bounds[whole + 1], 2)
    mirrored = y.copy()
    mirrored[flat_ranges(bounds[whole], bounds[whole + 1])[1]] -= 2 * left
    period = _local_period(edge, y.size)
    # Not the slips themselves; and what the load itself, between lines on both sides, shows to jump.
    slips = np.concatenate([edge + away for away in range(-3, 4)])
    if not np.setdiff1d(_peaks(mirrored, _half_widths(period, settings), sigma, settings), slips).size:
        return np.empty(0)
    found = np.setdiff1d(_edges(mirrored, period, sigma, settings), slips)
    both = np.union1d(edge, found)
    height = -_stick_drops(y, both, settings)[np.searchsorted(both, found)]
    return height[height >= least]


def upward_share(y: Floats, edge: Ints, settings: ForceSettings) -> float:
    """Return how far the load jumps upward within its sticks, over how far it drops at the slips.

    Both are medians of the step filter at the width that finds the slips, less the rise of the sticks: the
    largest upward step of each stick, and the downward step at each edge. Noise reaches about 1 because it
    jumps upward as far and as fast as downward. NaN where the sticks are too short for the filter,
    infinite where the load does not drop more than it rises.
    """
    half = _half_widths(_local_period(edge, y.size), settings)
    slope = stick_lines(y, edge, settings).slope
    step = _step_filter(y, half)
    drop = step[edge] + half[edge] * 0.5 * (slope[:-1] + slope[1:])
    row, index = flat_ranges(edge[:-1] + half[edge[:-1]], edge[1:] - half[edge[1:]])
    upward = np.full(edge.size - 1, np.nan)
    np.fmax.at(upward, row, -step[index] - slope[1:-1][row] * half[index])
    usual = float(nan_median(drop))
    return float(nan_median(upward)) / usual if usual > 0 else float("inf")


def stick_lines(y: Floats, edge: Ints, settings: ForceSettings) -> Lines:
    """Lines through the central part of the stretches between edges: one more than there are edges."""
    return fit_lines(np.arange(y.size, dtype=float), y, *stick_middles(edge, y.size, settings))


def stick_middles(edge: Ints, size: int, settings: ForceSettings) -> tuple[Ints, Ints]:
    """[start, stop) of the central part (`line_part`) of each stretch between edges."""
    bounds = np.r_[0, edge, size]
    length = np.diff(bounds)
    margin = (0.5 * (1 - settings.line_part) * length).astype(np.int64)
    margin = np.minimum(margin, np.maximum(length - 3, 0) // 2)  # a line needs three samples
    return bounds[:-1] + margin, bounds[1:] - margin


def _step_filter(y: Floats, half: Ints) -> Floats:
    """Mean of `half` samples before each index less the mean of as many from it on; NaN at the ends."""
    total = np.r_[0.0, np.cumsum(y - y.mean())]
    index = np.arange(y.size)
    low, high = index - half, index + half
    inside = (low >= 0) & (high <= y.size)
    low, high = np.where(inside, low, 0), np.where(inside, high, 0)
    step = (2 * total[index] - total[low] - total[high]) / half
    return np.where(inside, step, np.nan)


def _peaks(y: Floats, half: Ints, sigma: float, settings: ForceSettings) -> Ints:
    """Where the step filter stands out by `candidate_sigmas` of its own standard deviation for white noise.

    Prominence, not height: the filter's level on a stick follows the stiffness and the filter's width.
    """
    standard = np.nan_to_num(_step_filter(y, half) / (sigma * np.sqrt(2.0 / half)), nan=-np.inf)
    found = find_maxima(standard, least_prominence=settings.candidate_sigmas, reach=8 * int(half.max()))
    return apart(found.at, standard[found.at], max(int(half.min()), 1))


def _edges(y: Floats, period: Floats, sigma: float, settings: ForceSettings) -> Ints:
    """Drops of a signal whose period, in samples, is known at every sample."""
    edge = _join_weak(y, _peaks(y, _half_widths(period, settings), sigma, settings), sigma, settings)
    return _join_knees(y, _join_parts(y, edge, settings), sigma, settings)


def _half_widths(period: Floats, settings: ForceSettings) -> Ints:
    """Half the widths of the step filter for these periods."""
    return np.asarray(np.clip(np.rint(settings.step_width * period), 2, None), np.int64)


def _first_period(y: Floats, sigma: float, settings: ForceSettings) -> Floats:
    """Samples from drop to drop at every sample, each stretch at the scale of filter that suits it."""
    scales = np.unique(np.geomspace(2, max(y.size // 12, 3), 24).astype(np.int64))
    found = [_peaks(y, np.full(1, scale), sigma, settings) for scale in scales]
    whole = _best_scale(scales, found, 0, y.size) or (y.size / 3, 0)
    stretches = int(np.clip(whole[1] // 20, 1, 64))  # of 20 events or more: fewer give no median
    bounds = np.linspace(0, y.size, stretches + 1)
    periods = np.array([(_best_scale(scales, found, a, b) or whole)[0] for a, b in pairwise(bounds)])
    return _at_every_sample(0.5 * (bounds[:-1] + bounds[1:]), periods, y.size)


def _local_period(edge: Ints, size: int) -> Floats:
    """The same from drops already found: a running median of nine spacings."""
    if edge.size < 3:
        return np.full(size, max(size / 3, 1.0))
    spacing = running_median(np.diff(edge), 9)
    return _at_every_sample(0.5 * (edge[1:] + edge[:-1]), spacing, size)


def _at_every_sample(index: NDArray[np.floating], period: Floats, size: int) -> Floats:
    """Periods known at some samples, at every sample."""
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


def _join_weak(y: Floats, edge: Ints, sigma: float, settings: ForceSettings) -> Ints:
    """Joins neighbouring sticks that one line fits as well as two, least certain edge first."""
    while edge.size:
        lines = stick_lines(y, edge, settings)
        score = _split_gain(lines.take(slice(None, -1)), lines.take(slice(1, None))) / sigma**2
        weak = ~(score > settings.split_sigmas**2)
        if not weak.any():
            break
        score = np.where(weak, np.nan_to_num(score, nan=-1.0), np.inf)
        padded = np.r_[np.inf, score, np.inf]
        edge = edge[~(weak & (padded[1:-1] <= padded[:-2]) & (padded[1:-1] < padded[2:]))]
    return edge


def _join_parts(y: Floats, edge: Ints, settings: ForceSettings) -> Ints:
    """Joins the parts of one slip: between two of them the load falls, or is too short for a line.

    A part that is joined to a stick belongs to it: the line through both may fall, but the stick rises.
    """
    rises = stick_lines(y, edge, settings).slope > 0
    while edge.size > 1:
        falling = np.flatnonzero(~rises[1:-1])
        if not falling.size:
            break
        drop = np.nan_to_num(_stick_drops(y, edge, settings), nan=-np.inf)
        gone = np.where(drop[falling] < drop[falling + 1], falling, falling + 1)
        kept = np.setdiff1d(np.arange(edge.size), gone)
        rises = np.logical_or.reduceat(rises, np.r_[0, kept + 1])
        edge = edge[kept]
    return edge


def _join_knees(y: Floats, edge: Ints, sigma: float, settings: ForceSettings) -> Ints:
    """Joins what a line with a knee, without any drop, fits as well as the lines on both sides.

    The load never falls at a knee, but lines that meet a little before an edge lie apart at it. A stretch
    that was joined is told by its knee from then on: one line would fit it so badly that a knee anywhere does
    as well, and slip after slip would be joined to it.
    """
    x = np.arange(y.size, dtype=float)
    bounds = np.r_[0, edge, y.size]
    told = fit_lines(x, y, bounds[:-1], bounds[1:]).squares
    doubtful = np.arange(edge.size)
    while doubtful.size:
        bounds = np.r_[0, edge, y.size]
        low, at, high = bounds[doubtful], edge[doubtful], bounds[doubtful + 2]
        bent = _squares_with_knee(x, y, low, at, high)
        knee = bent - (told[doubtful] + told[doubtful + 1]) < (settings.split_sigmas * sigma) ** 2
        # One of two neighbours at a time: the other may be a slip once they are joined.
        first = np.diff(doubtful[knee], prepend=-2) > 1
        gone = doubtful[knee][first]
        beside = np.setdiff1d(np.r_[gone - 1, gone + 1], gone)
        beside = beside[(beside >= 0) & (beside < edge.size)]
        doubtful = beside - np.searchsorted(gone, beside)
        told[gone] = bent[knee][first]
        told, edge = np.delete(told, gone + 1), np.delete(edge, gone)
    return edge


def _squares_with_knee(x: Floats, y: Floats, low: Ints, edge: Ints, high: Ints) -> Floats:
    """Sum of squares over [low, high) about a line with a knee where the lines on both sides of the edge
    meet; infinite where they do not."""
    before, after = fit_lines(x, y, low, edge), fit_lines(x, y, edge, high)
    here = np.asarray(edge - 0.5, dtype=float)
    with np.errstate(divide="ignore", invalid="ignore"):
        meet = here - (before.at(here) - after.at(here)) / (before.slope - after.slope)
    knee = (meet > low) & (meet < high) & (high - low >= LEAST_FOR_KNEE)
    squares = np.full(edge.size, np.inf)
    squares[knee] = bend_squares(x, y, low[knee], high[knee], meet[knee])
    return squares


def _split_gain(a: Lines, b: Lines) -> Floats:
    """By how much two lines instead of one lower the sum of squares over both stretches."""
    weight = a.count * b.count / (a.count + b.count)
    apart_x, apart_y = b.mean_x - a.mean_x, b.mean_y - a.mean_y
    sxy = a.slope * a.sxx + b.slope * b.sxx
    joint_sxx = a.sxx + b.sxx + weight * apart_x**2
    joint_sxy = sxy + weight * apart_x * apart_y
    return weight * apart_y**2 + a.slope**2 * a.sxx + b.slope**2 * b.sxx - joint_sxy**2 / joint_sxx


def _stick_drops(y: Floats, edge: Ints, settings: ForceSettings) -> Floats:
    """Height between the stick lines on both sides of each edge."""
    lines = stick_lines(y, edge, settings)
    here = np.asarray(edge - 0.5, dtype=float)
    return lines.take(slice(None, -1)).at(here) - lines.take(slice(1, None)).at(here)


def size_gap(drop: Floats, ratio: float, most: float) -> float:
    """The middle of the widest gap in log(drop) with at most that share of the drops below it; 0 where none
    spans that ratio."""
    ordered = np.sort(drop[drop > 0])
    if ordered.size < 8:
        return 0.0
    lower = np.log(ordered[: int(most * ordered.size) + 1])
    widest = int(np.argmax(np.diff(lower)))
    # A single small drop below all others is no cluster of noise.
    if np.diff(lower)[widest] < np.log(ratio) or widest + 1 < 0.02 * ordered.size:
        return 0.0
    return float(np.exp(0.5 * (lower[widest] + lower[widest + 1])))
