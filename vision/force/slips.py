"""Where a sawtooth drops, and what follows each drop: the slips, and the load cell's low-pass.

Candidates from a step filter are kept where the stick lines show a drop. The low-pass is found in the
transients after slips, and corrected by deconvolution.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from itertools import pairwise

import numpy as np
import scipy
from numpy.typing import NDArray

from vision.force.lines import (
    LEAST_FOR_KNEE,
    Lines,
    bend_squares,
    fit_lines,
    fit_polynomials,
    flat_ranges,
    lagged_hinge,
)
from vision.force.settings import ForceSettings
from vision.numeric import Bools, Floats, Ints, nan_median
from vision.signals import apart, find_maxima, running_mean, running_median

# --- slips --------------------------------------------------------------------------------------------------


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


# --- the load cell's low-pass -------------------------------------------------------------------------------


@dataclass(frozen=True)
class SlipTransients:
    """What follows each slip, in samples."""

    start: Ints  # of half-open ranges clear of slips
    stop: Ints
    middle: Floats  # of the slip as recorded
    valley: Floats  # its end
    peak: Floats  # where the next slip begins
    drop: Floats  # the slip's height

    def take(self, rows: Bools) -> SlipTransients:
        """Some of the transients."""
        return SlipTransients(*(getattr(self, part.name)[rows] for part in fields(self)))


@dataclass(frozen=True)
class LowpassEstimate:
    """A time constant and the evidence for it."""

    samples: float  # the time constant
    gain: float  # by how much it lowers the squares, over what chance does with one more number per stick
    # Transients extrapolated to the middle of their slips, over the drops: median, and interquartile range
    # over the median. A low-pass leaves transients of one and the same height, half of the drop or more.
    height: float
    scatter: float

    def confirms(self, before: LowpassEstimate, settings: ForceSettings) -> bool:
        """Whether this, from corners corrected for the low-pass found before, shows the same one."""
        steady = abs(np.log(self.samples / before.samples)) < 0.25
        enough = self.gain > settings.lowpass_accepted and 0.25 < self.height < 5.0
        return enough and self.scatter < 0.6 and steady


def estimate_lowpass(y: Floats, transients: SlipTransients, corrected: float = 0.0) -> LowpassEstimate | None:
    """Time constant of a first-order low-pass; None with fewer than three sticks of eight samples or more.

    After each slip the load, without spikes, is the sample's own rise (a parabola, with a knee for fast
    pulls) plus an exponential transient, of the same time constant in every stick and of free height in each.
    The time constant is that of least squares.  corrected: time constant, in samples, whose delay the corners
    in `transients` are already corrected for.
    """
    blocks = _Blocks.of(y, transients, corrected)
    if blocks is None:
        return None
    without = min(blocks.over_knees(0.0))
    tau, knee = blocks.best()
    squares, transient = blocks.fit(tau, knee)
    # Squares are differences of sums: no smaller than what rounding leaves.
    rounding = np.finfo(float).eps * float(np.sum(blocks.load**2))
    freedom = max(int(blocks.known.sum()) - 5 * blocks.drop.size, 1)
    chance = blocks.drop.size * max(squares, rounding, np.finfo(float).tiny) / freedom
    with np.errstate(over="ignore"):
        height = transient * np.exp(np.minimum(-blocks.middle / tau, 50.0)) / blocks.drop
    # Of the larger drops: noise hides what small ones leave.
    low, median, high = np.percentile(height[blocks.drop >= np.median(blocks.drop)], [25, 50, 75])
    return LowpassEstimate(
        samples=tau * blocks.size,
        gain=(without - squares) / chance,
        height=float(median),
        scatter=float((high - low) / median) if median > 0 else float("inf"),
    )


@dataclass(frozen=True)
class _Blocks:
    """Some sticks, as rows of means over `size` samples: lines stay lines, exponentials exponentials.

    load, known: (stick, block), less the first sample's, 0 where not known.  middle, valley, peak: as in
    `SlipTransients`, in blocks from the first.  corrected: samples.
    """

    load: Floats
    known: Bools
    middle: Floats
    valley: Floats
    peak: Floats
    drop: Floats
    size: int
    corrected: float
    knees = (0.1, 0.2, 0.3, 0.4, 0.5, 0.7, 1.0)  # tried, in sticks; 1 is no knee

    @classmethod
    def of(cls, y: Floats, transients: SlipTransients, corrected: float) -> _Blocks | None:
        """At most 100 sticks of about 120 blocks: enough for a time constant known to a few per cent."""
        count = transients.stop - transients.start
        inside = (transients.start >= 0) & (transients.stop <= y.size)  # a slip without a place has none
        usable = np.flatnonzero((count >= 8) & (transients.drop > 0) & inside)
        if usable.size < 3:
            return None
        pick = usable[np.unique(np.linspace(0, usable.size - 1, 100).astype(np.int64))]
        start, count = transients.start[pick], count[pick]
        size = max(int(np.median(count)) // 120, 1)
        blocks = np.minimum(count // size, 8 * 120)  # later in a long stick there is no transient left
        index = start[:, None] + np.arange(size * int(blocks.max()))
        load = y[np.minimum(index, y.size - 1)] - y[start][:, None]
        load = load.reshape(pick.size, -1, size).mean(axis=2)
        known = np.arange(load.shape[1]) < blocks[:, None]
        first = start + 0.5 * (size - 1)
        places = (transients.middle, transients.valley, transients.peak)
        middle, valley, peak = ((at[pick] - first) / size for at in places)
        load = np.where(known, load, 0.0)
        return cls(load, known, middle, valley, peak, transients.drop[pick], size, corrected)

    def best(self) -> tuple[float, float]:
        """(time constant, knee) of the least squares: the best of a grid, then downhill from there."""
        shortest = 0.15  # samples: a shorter one leaves no transient
        high = max(0.6 * float(np.median(self.peak)), 2 * shortest)
        grid = np.geomspace(shortest, high, 15)
        left = np.array([self.over_knees(tau) for tau in grid])
        first, knee = np.unravel_index(int(left.argmin()), left.shape)
        start = np.array([np.log(grid[first]), min(self.knees[knee], 0.9)])
        steps = np.array([start, (start[0] + 0.2, start[1]), (start[0], start[1] - 0.05)])

        def squares(pair: Floats) -> float:
            return self.fit(float(np.exp(pair[0])), float(pair[1]))[0]

        found = scipy.optimize.minimize(
            squares,
            start,
            method="Nelder-Mead",
            bounds=[(float(np.log(shortest)), float(np.log(high))), (self.knees[0], 0.9)],
            options={"initial_simplex": steps, "xatol": 1e-3, "fatol": 1e-3},
        )
        return float(np.exp(found.x[0])), float(found.x[1])

    def fit(self, tau: float, knee: float) -> tuple[float, Floats]:
        """(squares left, heights of the transients) of all rows; tau in blocks (0: none), knee in sticks."""
        parabola, hinge, transient = self._columns(tau)
        columns = [*parabola, *([hinge(knee)] if knee < 1 else []), *transient]
        directions, length = _orthonormal(columns)
        with np.errstate(divide="ignore", invalid="ignore"):
            return self._left(directions), _dot(directions[-1], self.load) / length

    def over_knees(self, tau: float) -> list[float]:
        """Squares left for each of the knees: what they share is fitted once."""
        parabola, hinge, transient = self._columns(tau)
        shared, _ = _orthonormal([*parabola, *transient])
        left = self._left(shared)
        return [
            left - (self._along(_orthonormal([hinge(knee)], shared)[0][-1]) if knee < 1 else 0.0)
            for knee in self.knees
        ]

    def _left(self, directions: Sequence[Floats]) -> float:
        """Squares left by orthonormal directions."""
        return float(np.sum(self.load**2)) - sum(self._along(one) for one in directions)

    def _along(self, direction: Floats) -> float:
        return float(np.sum(_dot(direction, self.load) ** 2))

    def _columns(self, tau: float) -> tuple[list[Floats], Callable[[float], Floats], list[Floats]]:
        """Of the fit in each row, 0 where no block is known: a parabola, a hinge by its knee, a transient."""
        t = np.arange(float(self.load.shape[1]))
        # The low-pass delays the end of the slip by its time constant.
        begin = self.valley - (tau - self.corrected / self.size)
        rise = self.peak - begin
        u = (t - begin[:, None]) / rise[:, None]

        def hinge(knee: float) -> Floats:
            return lagged_hinge(t - (begin + knee * rise)[:, None], tau) * self.known

        transient = [np.exp(-t / tau) * self.known] if tau else []
        one = self.known.astype(np.float64)
        return [one, u * one, u**2 * one], hinge, transient


def _orthonormal(columns: Sequence[Floats], before: Sequence[Floats] = ()) -> tuple[list[Floats], Floats]:
    """Orthonormal directions of columns within each row, behind others; the last column's own length.

    Modified Gram-Schmidt for all rows at once: LAPACK's QR of each small matrix takes three times as long.
    """
    directions, length = list(before), np.zeros(0)
    for column in columns:
        own = column
        for direction in directions:
            own = own - _dot(direction, own)[:, None] * direction
        length = np.sqrt(_dot(own, own))
        some = length > 1e-9 * np.sqrt(_dot(column, column))  # less is rounding
        directions.append(own * np.divide(1, length, out=np.zeros_like(length), where=some)[:, None])
    return directions, length


def _dot(one: Floats, other: Floats) -> Floats:
    return np.asarray(np.einsum("sw,sw->s", one, other), np.float64)


@dataclass(frozen=True)
class DeconvolvedLoad:
    """A recording corrected for the load cell's low-pass."""

    load: Floats  # means over `width` samples: deconvolution alone would drown it in noise
    edge: Ints  # the first sample after the steepest drop of each slip
    late: float  # samples by which `load` lags behind the clock
    width: int  # samples averaged
    sigma: float  # noise of `load`


def deconvolve_lowpass(y: Floats, sigma: float, slips: Slips, tau: float) -> DeconvolvedLoad:
    r"""The load before a first-order low-pass of `tau` samples, with the slips' places in it.

    .. math:: z_k = y_k + c\,(y_k - y_{k-1}), \qquad c = 1 / (e^{1/\tau} - 1)

    has no transient left after a step, and on a rise it lags by :math:`\tau - c` samples. It is smoothed
    only as far as the usual drop needs to be 40 times the noise, by a tenth of a period at most.
    y, sigma: load without spikes, and its noise.
    """
    if not tau:
        return DeconvolvedLoad(y, slips.edge, 0.0, 1, sigma)
    gain = 1 / np.expm1(1 / tau)
    widths = 1 + 2 * np.arange(int(slips.period / 20) + 1)  # up to a tenth of a period
    # A mean of differences is a difference of ends: its noise falls with the width itself.
    noise = sigma * np.sqrt((1 + 2 * gain * (1 + gain) / widths) / widths)
    noisy = int(np.sum(noise > np.median(slips.drop) / 40))
    chosen = min(noisy, widths.size - 1)
    width = int(widths[chosen])
    load = running_mean(y + gain * np.diff(y, prepend=y[:1]), width)
    edge = _steepest(load, slips.edge, 2 * tau, width)
    return DeconvolvedLoad(load, edge, tau - gain, width, float(noise[chosen]))


def _steepest(y: Floats, edge: Ints, back: float, width: int) -> Ints:
    """The middle of the largest drop over 2 `width` samples, at most `back` or 0.4 sticks before an edge."""
    earlier = np.minimum(0.4 * np.diff(edge, prepend=0), back)
    away = np.arange(-int(earlier.max()), 2)
    place = np.clip(edge[:, None] + away, width, y.size - 1 - width)
    drop = np.where(away >= -earlier[:, None], y[place - width] - y[place - 1 + width], -np.inf)
    return np.asarray(place[np.arange(edge.size), drop.argmax(axis=1)])
