"""Where a sawtooth drops: the slips of a recording.

Candidates from a step filter become slips where the stick lines on both sides show a drop.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from vision.data import ThresholdHow
from vision.errors import counted
from vision.force.lines import LEAST_FOR_KNEE, FittedLoad, Lines, bend_squares, fit_polynomials
from vision.force.settings import ForceSettings
from vision.numeric import Bools, Floats, Ints, flat_ranges, nan_median
from vision.signals import enforce_distance, find_maxima, running_median


@dataclass(frozen=True)
class Slips:
    """Drops of the load, each between two samples."""

    edge: Ints  # index of the first sample after the steepest drop
    drop: Floats  # height between the stick lines on both sides there; ΔF of an event may be smaller
    threshold: float  # smallest drop that counts as a slip
    # "noise": a multiple of the noise; "jumps": above the upward jumps; "gap": between small and large drops;
    # "given"
    threshold_how: ThresholdHow
    left_out: Floats  # drops that exceed the white noise but not the threshold
    # Upward jumps within the sticks: positions, heights between lines, and rises within five samples.
    jump_edge: Ints
    jump: Floats
    jump_rise: Floats

    @cached_property
    def period(self) -> float:
        """Median samples from slip to slip; NaN with fewer than two."""
        return float(np.median(np.diff(self.edge))) if self.edge.size > 1 else float("nan")

    def kept(self, keep: Bools, threshold: float, how: ThresholdHow) -> Slips:
        """Return some of the slips, above a higher threshold, and the others as left out."""
        return replace(
            self,
            edge=self.edge[keep],
            drop=self.drop[keep],
            threshold=threshold,
            threshold_how=how,
            left_out=self.drop[~keep],
        )

    def in_every_sample(self, load: Floats, every: int) -> Slips:
        """Return the slips among all samples of a load of which they were found in one of every few."""
        place = np.maximum(self.edge - 1, 0)[:, np.newaxis] * every + np.arange(1, every + 1)
        place = np.minimum(place, load.size - 1)
        steepest = np.argmax(load[place - 1] - load[place], axis=1)
        return replace(
            self, edge=place[np.arange(self.edge.size), steepest], jump_edge=self.jump_edge * every
        )

    def at_first_fall(self, load: Floats, period: int) -> Slips:
        """Return the slips of a load averaged over a period of ringing where the load itself falls: at the
        first fall half as steep as the steepest one within a period, since later ones are swings."""
        place = np.clip(self.edge[:, np.newaxis] + np.arange(-period, period + 1), 1, load.size - 1)
        fall = load[place - 1] - load[place]
        first = np.argmax(fall > 0.5 * fall.max(axis=1, keepdims=True), axis=1)
        near = np.minimum(first[:, np.newaxis] + np.arange(period // 2 + 1), 2 * period)
        steepest = near[:, 0] + np.argmax(np.take_along_axis(fall, near, axis=1), axis=1)
        return replace(self, edge=place[np.arange(len(place)), steepest])

    def before_jumps(self, settings: ForceSettings) -> Ints:
        """Return the number of slips before each upward jump that is as large as slips, and rises by more
        than a stick does within five samples: lines through curved sticks, or through a hold, are also apart.
        """
        usual = float(np.median(self.drop))
        large = self.jump_rise - 5 * usual / self.period > 0.5 * self.jump
        large &= self.jump > settings.upward_share * usual
        return np.searchsorted(self.edge, self.jump_edge[large])

    def warnings(self, unit: str, settings: ForceSettings) -> list[str]:
        """Return which slips may have been left out, and how many of the drops, in `unit`, may be none. Drops
        below `close_share` of the usual one hardly change a fit."""
        lines, usual = [], float(np.median(self.drop))
        left_out = self.left_out[self.left_out >= settings.close_share * usual]
        if left_out.size:
            low, high = left_out.min(), left_out.max()
            sizes = f"{low:.3g}" if left_out.size == 1 else f"{low:.3g} to {high:.3g}"
            why = {
                "jumps": "no larger than the load's own jumps upward",
                "gap": "below a gap in the sizes of drops",
                "noise": "no larger than four errors, since the noise is slow",
            }[self.threshold_how]
            lines.append(
                f"{counted(left_out.size, 'drop')} between fitted lines of {sizes} {unit} not counted, "
                f"{why}: `threshold_N` {0.9 * low:.2g} counts them"
            )
        if self.threshold_how == "noise" and self.threshold > 0.5 * usual:
            lines.append(
                f"drops between fitted lines below {self.threshold:.3g} {unit} are not told from the noise: "
                f"slips may be missed, since the median drop is {usual:.3g} {unit}"
            )
        return lines


def find_slips(
    y: Floats,
    sigma: Floats | float,
    *,
    threshold: float | None = None,
    settings: ForceSettings = ForceSettings(),
) -> Slips:
    """Return the slips of a sawtooth without spikes; empty arrays where there are none.

    A step filter of 0.15 local periods on either side proposes drops. Two neighbouring sticks are joined
    where one line, straight or with a knee, fits both as well as two lines do, or where the load falls
    between two drops. A remaining drop is a slip where the lines on both sides, extended to the drop, differ
    by the threshold: by default 4 `sigma`, the white noise of y at every sample or one for all.

    Noise that is not white, knocks and ringing jump upward as often as downward, but slips only fall. The
    number of upward jumps within the sticks therefore estimates how many drops of each size are not slips,
    and may raise the threshold, as does a wide gap between the sizes of small and large drops.
    """
    sigma = np.broadcast_to(sigma, y.shape)
    load = FittedLoad(y)
    edge = _edges(load, _first_period(y, sigma, settings), sigma, settings)
    edge = _edges(load, _local_period(edge, y.size), sigma, settings)
    edge, drop = _with_close(load, edge, sigma, settings)
    jump_edge, jump_N = _jumps_upward(load, edge, sigma, settings)
    # From here on drops and jumps are as high as if the noise were the usual one everywhere.
    noise = float(np.median(sigma))
    height, jump = drop * (noise / sigma[edge]), jump_N * (noise / sigma[jump_edge])
    least = settings.threshold_sigmas * noise if threshold is None else threshold
    how: ThresholdHow = "noise" if threshold is None else "given"
    keep, left_out = (height if threshold is None else drop) >= least, np.empty(0)
    if threshold is None and jump.size:
        # Choose the threshold with most slips, less `jump_cost` for each upward jump above it except one: of
        # the heights or, where these grow, of those over the usual ones around, since what bends large sticks
        # is larger than small slips.
        usual = running_median(height, 9, ends="symmetric") if edge.size else np.ones(1)
        low, high = np.quantile(usual, [0.1, 0.9])
        kinds = [(height, jump)]
        if high > settings.noise_ratio * low > 0:
            kinds.append((height / usual, jump / np.interp(jump_edge, edge, usual)))
        best = np.sum(height >= least) - settings.jump_cost * (jump.size - 1)
        for size, other in kinds:
            steps = np.nextafter(np.sort(other), np.inf)
            above = np.sum((height >= least) & (size >= steps[:, np.newaxis]), axis=1)
            balance = above - settings.jump_cost * np.maximum(jump.size - 2 - np.arange(steps.size), 0)
            if balance.max() > best:
                best, large = balance.max(), size >= steps[np.argmax(balance)]
                keep, left_out, how = (height >= least) & large, drop[(height >= least) & ~large], "jumps"
        if how == "jumps":
            least = float(height[keep].min()) if keep.any() else float(jump.max())
    if threshold is None:
        # Where the noise changes, equal drops differ in height; where the range does, in size.
        gaps = [size_gap(some[keep], settings.threshold_gap, 0.5) for some in (drop, height)]
        if min(gaps) > least:
            large = (drop >= gaps[0]) | (height >= gaps[1])
            left_out = drop[(height >= settings.threshold_sigmas * noise) & ~large]
            keep, least, how = keep & large, gaps[1], "gap"
    step = y[np.minimum(jump_edge + 2, y.size - 1)] - y[np.maximum(jump_edge - 3, 0)]
    return Slips(edge[keep], drop[keep], least, how, left_out, jump_edge, jump_N, step)


def _jumps_upward(
    load: FittedLoad, edge: Ints, sigma: Floats, settings: ForceSettings
) -> tuple[Ints, Floats]:
    """Return the positions and heights of the upward jumps between the edges that exceed the noise.

    They are the drops of the mirrored load: each stick is mirrored about the parabola fitted to it, which
    keeps the rise of the stick and inverts the deviations from it.
    """
    y = load.y
    bounds = np.r_[0, edge, y.size]
    whole = np.flatnonzero(np.diff(bounds) > 2 * settings.few_samples)
    mirrored = y - 2 * _about_parabolas(y, bounds[whole], bounds[whole + 1])
    half = _half_widths(_local_period(edge, y.size), settings)
    peaks = _peaks(_step_filter(mirrored, half), half, sigma, settings)
    # The slips themselves are excluded. An upward jump must also show between the lines through the load.
    slips = np.concatenate([edge + away for away in range(-3, 4)])
    if not np.setdiff1d(peaks, slips).size:
        return np.empty(0, np.int64), np.empty(0)
    found = np.setdiff1d(_join(FittedLoad(mirrored), peaks, sigma, settings), slips)
    both = np.union1d(edge, found)
    height = -stick_drops(load, both, settings)[np.searchsorted(both, found)]
    high = height >= settings.threshold_sigmas * sigma[found]
    # Lines that fall in a slow slip and rise after it are apart where they meet, but the load does not jump.
    rise = float(np.median(stick_lines(load, edge, settings).slope))
    high &= -_step_filter(y, half)[found] - rise * half[found] > 0.5 * height
    return found[high], height[high]


def missed_slips(
    y: Floats, sigma: Floats, edge: Ints, start: Floats, stop: Floats, settings: ForceSettings
) -> tuple[int, float]:
    """Return how many more downward than upward steps the sticks contain, 0 where that is chance, and their
    median height.

    Noise of any kind steps upward as often as downward about the parabola of a stick, but slips only fall. A
    step exceeds `threshold_sigmas` of the noise, and `close_share` of the drops beside its stick. The begin
    of the sticks, where a filter or ringing leaves its tail, does not count.
    """
    half = np.maximum(_half_widths(_local_period(edge, y.size), settings) // 3, 2)
    first, last = np.ceil(start).astype(np.int64), np.floor(stop).astype(np.int64) + 1
    whole, drop = last - first > 6 * half[edge[:-1]], stick_drops(y, edge, settings)
    first, last, usual = first[whole], last[whole], 0.5 * (drop[:-1] + drop[1:])[whole]
    if not first.size:
        return 0, 0.0
    wide = half[first]
    row, searched = flat_ranges(first + np.maximum(wide, (last - first) // 5), last - wide)
    step = np.nan_to_num(_step_filter(_about_parabolas(y, first, last), half)[searched])
    noise = settings.threshold_sigmas * sigma[searched] * np.sqrt(2 / half[searched])
    least = np.maximum(noise, settings.close_share * usual[row])
    down, up = (
        enforce_distance(searched[high], np.abs(step[high]), int(2 * half.min()))
        for high in (step > least, -step > least)
    )
    excess = int(down.size - up.size)
    if excess < max(1.0, 4 * np.sqrt(down.size + up.size)):
        return 0, 0.0
    return excess, float(np.median(step[np.isin(searched, down)]))


def _about_parabolas(y: Floats, start: Ints, stop: Ints) -> Floats:
    """Return the deviations of the load from a parabola fitted to each stretch; 0 outside the stretches."""
    residual = np.zeros(y.size)
    residual[flat_ranges(start, stop)[1]] = fit_polynomials(y, start, stop, 2)[1]
    return residual


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


def stick_lines(load: Floats | FittedLoad, edge: Ints, settings: ForceSettings) -> Lines:
    """Return lines through the central part of each stretch between edges: one more than edges."""
    load = load if isinstance(load, FittedLoad) else FittedLoad(load)
    return load.lines(*stick_middles(edge, load.y.size, settings))


def _lines_beside(load: FittedLoad, edge: Ints, settings: ForceSettings) -> tuple[Lines, Lines]:
    """Return the stick lines before and after each edge, through at most `line_reach` usual spacings.

    Two lines fit a rest and the rise after it better than one wherever within the rest the edge is, and a
    long stick may contain a slow slip.
    """
    start, stop = stick_middles(edge, load.y.size, settings)
    reach = np.ceil(settings.line_reach * _local_period(edge, load.y.size)[edge]).astype(np.int64)
    before, after = np.maximum(start[:-1], stop[:-1] - reach), np.minimum(stop[1:], start[1:] + reach)
    return load.lines(before, stop[:-1]), load.lines(start[1:], after)


def _stretch_bounds(edge: Ints, size: int) -> Ints:
    """Return the edges, and before and after them where the first stretch begins and the last one ends: one
    usual spacing of the edges beside them, as what lies beyond may be a rest."""
    if edge.size < 3:
        return np.asarray(np.r_[0, edge, size], np.int64)
    spacing = np.diff(edge)
    first, last = (max(int(np.median(some)), LEAST_FOR_KNEE) for some in (spacing[:9], spacing[-9:]))
    return np.asarray(np.r_[max(edge[0] - first, 0), edge, min(edge[-1] + last, size)], np.int64)


def stick_middles(edge: Ints, size: int, settings: ForceSettings) -> tuple[Ints, Ints]:
    """Return the half-open range of the central part (`line_part`) of each stretch between edges.

    Of the first and the last stretch only the part of `_stretch_bounds` counts.
    """
    bounds = _stretch_bounds(edge, size)
    length = np.diff(bounds)
    margin = (0.5 * (1 - settings.line_part) * length).astype(np.int64)
    margin = np.minimum(margin, np.maximum(length - 3, 0) // 2)  # a line needs three samples
    return bounds[:-1] + margin, bounds[1:] - margin


def _step_filter(y: Floats, half: Ints) -> Floats:
    """Return the mean of the `half` samples before each index minus that of the `half` samples from it on.

    NaN at the ends.
    """
    total = np.r_[0.0, np.cumsum(y - y.mean())]
    step = np.full(y.size, np.nan)
    if half.size == 1:  # the same at every index, for which slices are faster
        k, last = half[0], y.size - half[0] + 1
        if k < last:
            step[k:last] = (2 * total[k:last] - total[: last - k] - total[2 * k :]) / k
        return step
    index = np.arange(y.size)
    inside = np.flatnonzero((index >= half) & (index + half <= y.size))
    k = half[inside]
    step[inside] = (2 * total[inside] - total[inside - k] - total[inside + k]) / k
    return step


def _peaks(step: Floats, half: Ints, sigma: Floats, settings: ForceSettings) -> Ints:
    """Return the peaks of a step filter's output whose prominence exceeds `candidate_sigmas` for white noise.

    Heights would not do: on a stick the filter's level depends on the stiffness and on its own width.
    """
    standard = np.nan_to_num(step / (sigma * np.sqrt(2.0 / half)), nan=-np.inf)
    reach = 8 * int(half.max())  # within which the base of a peak is searched, on either side
    least = settings.candidate_sigmas
    found = find_maxima(standard, least_prominence=least, reach=reach, widest=reach + 1).at
    return enforce_distance(found, standard[found], max(int(half.min()), 1))


def _edges(load: FittedLoad, period: Floats, sigma: Floats, settings: ForceSettings) -> Ints:
    """Return the edges of a signal whose period, in samples, is known at every sample."""
    half = _half_widths(period, settings)
    return _join(load, _peaks(_step_filter(load.y, half), half, sigma, settings), sigma, settings)


def _join(load: FittedLoad, edge: Ints, sigma: Floats, settings: ForceSettings) -> Ints:
    """Join neighbouring sticks between which there is no slip."""
    edge = _join_weak(load, edge, sigma, settings)
    return _join_knees(load, _join_parts(load, edge, settings), sigma, settings)


def _with_close(load: FittedLoad, edge: Ints, sigma: Floats, settings: ForceSettings) -> tuple[Ints, Floats]:
    """Return the edges, with those between them that the step filter does not tell apart, and all drops.

    The filter is halved until it has two samples on either side. What it proposes must pass the same tests,
    and be clear: a drop of twice the usual threshold and of `close_share` of those beside it, which stay as
    they are, between sticks that rise by as much, and half as steeply as the one that it divides.
    """
    half = _half_widths(_local_period(edge, load.y.size), settings)
    least = 2 * settings.threshold_sigmas * sigma
    drop, slope = stick_drops(load, edge, settings), stick_lines(load, edge, settings).slope
    while edge.size > 1 and (half > 2).any():
        half = np.maximum(half // 2, 2)
        step = _step_filter(load.y, half)
        close = _peaks(step, half, sigma, settings)
        close = close[(close > edge[0]) & (close < edge[-1])]
        after = np.searchsorted(edge, close)
        apart = np.minimum(close - edge[after - 1], edge[after] - close) > half[close]
        # Most peaks are noise: where a slip is, the filter shows at least half of its drop.
        apart &= step[close] + slope[after] * half[close] > 0.5 * least[close]
        if not apart.any():
            continue
        joined = _join(load, np.union1d(edge, close[apart]), sigma, settings)
        new = ~np.isin(joined, edge)
        new[:1] = new[-1:] = False  # a search may have moved the outermost
        at = np.flatnonzero(new & (joined > edge[0]) & (joined < edge[-1]))
        if not at.size:
            continue
        after = np.searchsorted(edge, joined[at])
        parts, part_slope = stick_drops(load, joined, settings), stick_lines(load, joined, settings).slope
        now = np.zeros(edge.size)
        now[np.isin(edge, joined)] = parts[np.isin(joined, edge)]
        stays = now > 0.5 * drop
        share = settings.close_share * np.minimum(drop[after - 1], drop[after])
        shorter = np.minimum(joined[at] - joined[at - 1], joined[at + 1] - joined[at])
        good = np.minimum(parts[at], slope[after] * shorter) > np.maximum(least[joined[at]], share)
        good &= stays[after - 1] & stays[after]
        good &= np.minimum(part_slope[at], part_slope[at + 1]) > 0.5 * slope[after]
        if good.any():
            edge = np.union1d(edge, joined[at[good]])
            drop, slope = stick_drops(load, edge, settings), stick_lines(load, edge, settings).slope
    return edge, drop


def _half_widths(period: Floats, settings: ForceSettings) -> Ints:
    """Return half the width of the step filter for each period."""
    return np.asarray(np.clip(np.rint(settings.step_width * period), 2, None), np.int64)


def _first_period(y: Floats, sigma: Floats, settings: ForceSettings) -> Floats:
    """Return the period, in samples, at every sample, from the filter width that suits each stretch best."""
    scales = np.unique(np.geomspace(2, max(y.size // 12, 3), 24).astype(np.int64))
    widths = [np.full(1, scale) for scale in scales]
    found = [_peaks(_step_filter(y, half), half, sigma, settings) for half in widths]
    whole = _best_scale(scales, found, 0, y.size) or (y.size / 3, 0)
    stretches = int(np.clip(whole[1] // 20, 1, 64))  # each of 20 events or more, for a median
    bounds = np.linspace(0, y.size, stretches + 1)
    periods = np.array([(_best_scale(scales, found, a, b) or whole)[0] for a, b in pairwise(bounds)])
    return _at_every_sample(0.5 * (bounds[:-1] + bounds[1:]), periods, y.size)


def _local_period(edge: Ints, size: int) -> Floats:
    """Return the period at every sample from known edges: a running median of nine spacings."""
    if edge.size < 3:
        return np.full(size, max(size / 3, 1.0))
    # Without mirrored ends, the first and the last spacing would count fivefold.
    spacing = running_median(np.diff(edge), 9, ends="symmetric")
    return _at_every_sample(0.5 * (edge[1:] + edge[:-1]), spacing, size)


def _at_every_sample(index: NDArray[np.floating], period: Floats, size: int) -> Floats:
    """Interpolate periods that are known at some samples to every sample."""
    return np.exp(np.interp(np.arange(size), index, np.log(period)))


def _best_scale(scales: Ints, found: list[Ints], start: float, stop: float) -> tuple[float, int] | None:
    """Return the period and the number of drops at the scale that shows most drops.

    The scale must be at most a quarter of their spacing; None where no scale is.
    """
    best: tuple[float, int] | None = None
    for scale, peaks in zip(scales, found, strict=True):
        inside = peaks[(peaks >= start) & (peaks < stop)]
        spacing = float(np.median(np.diff(inside))) if inside.size >= 3 else 0.0
        # Of scales that show equally many drops the widest has the least noise.
        if scale <= 0.25 * spacing and (best is None or inside.size >= best[1]):
            best = spacing, inside.size
    return best


def _join_weak(load: FittedLoad, edge: Ints, sigma: Floats, settings: ForceSettings) -> Ints:
    """Join neighbouring sticks that one line fits as well as two, the least certain edge first."""
    while edge.size:
        a, b = _lines_beside(load, edge, settings)
        weight = a.count * b.count / (a.count + b.count)
        apart_x, apart_y = b.mean_x - a.mean_x, b.mean_y - a.mean_y
        joint_sxx = a.sxx + b.sxx + weight * apart_x**2
        joint_sxy = a.slope * a.sxx + b.slope * b.sxx + weight * apart_x * apart_y
        # By how much two lines, in place of one, lower the squared residuals over both stretches.
        gain = weight * apart_y**2 + a.slope**2 * a.sxx + b.slope**2 * b.sxx - joint_sxy**2 / joint_sxx
        score = gain / sigma[edge] ** 2
        weak = ~(score > settings.split_sigmas**2)
        if not weak.any():
            break
        score = np.where(weak, np.nan_to_num(score, nan=-1.0), np.inf)
        padded = np.r_[np.inf, score, np.inf]
        edge = edge[~(weak & (padded[1:-1] <= padded[:-2]) & (padded[1:-1] < padded[2:]))]
    return edge


def _join_parts(load: FittedLoad, edge: Ints, settings: ForceSettings) -> Ints:
    """Join the parts of one slip: stretches in which the load falls, or that are too short for a line.

    The load falls at both ends of such a stretch: a long one that rises at either contains a slow slip. One
    that is joined to a rising stick counts as rising, though the line through both may fall.
    """
    before, after = _lines_beside(load, edge, settings)
    rises = np.r_[False, (after.slope[:-1] > 0) | (before.slope[1:] > 0), False]
    while edge.size > 1:
        falling = np.flatnonzero(~rises[1:-1])
        if not falling.size:
            break
        drop = np.nan_to_num(stick_drops(load, edge, settings), nan=-np.inf)
        gone = np.where(drop[falling] < drop[falling + 1], falling, falling + 1)
        remaining = np.setdiff1d(np.arange(edge.size), gone)
        rises = np.logical_or.reduceat(rises, np.r_[0, remaining + 1])
        edge = edge[remaining]
    return edge


def _join_knees(load: FittedLoad, edge: Ints, sigma: Floats, settings: ForceSettings) -> Ints:
    """Join neighbouring sticks that one continuous line with a knee fits as well as two lines.

    The load never falls at a knee, but two lines that meet a little before an edge differ at the edge. From
    then on a joined stretch is judged by the residuals about its knee. One straight line would fit it so
    badly that a knee anywhere would improve the fit, and slip after slip would be joined to it.
    """
    bounds = _stretch_bounds(edge, load.y.size)
    begin, end = bounds[0], bounds[-1]
    squares = load.lines(bounds[:-1], bounds[1:]).squares
    candidates = np.arange(edge.size)
    while candidates.size:
        bounds = np.r_[begin, edge, end]
        low, at, high = bounds[candidates], edge[candidates], bounds[candidates + 2]
        bent = _squares_with_knee(load, low, at, high)
        least = (settings.split_sigmas * sigma[at]) ** 2
        knee = bent - (squares[candidates] + squares[candidates + 1]) < least
        # Remove one of two neighbouring edges at a time: the other may be a slip once the sticks are joined.
        first = np.diff(candidates[knee], prepend=-2) > 1
        gone = candidates[knee][first]
        beside = np.setdiff1d(np.r_[gone - 1, gone + 1], gone)
        beside = beside[(beside >= 0) & (beside < edge.size)]
        candidates = beside - np.searchsorted(gone, beside)
        squares[gone] = bent[knee][first]
        squares, edge = np.delete(squares, gone + 1), np.delete(edge, gone)
    return edge


def _squares_with_knee(load: FittedLoad, low: Ints, edge: Ints, high: Ints) -> Floats:
    """Return the squared residuals over [low, high) of a line whose knee is where both sides' lines meet.

    Infinite where the lines before and after the edge do not meet within the range.
    """
    before, after = load.lines(low, edge), load.lines(edge, high)
    here = np.asarray(edge - 0.5, dtype=float)
    with np.errstate(divide="ignore", invalid="ignore"):
        meet = here - (before.at(here) - after.at(here)) / (before.slope - after.slope)
    knee = (meet > low) & (meet < high) & (high - low >= LEAST_FOR_KNEE)
    squares = np.full(edge.size, np.inf)
    squares[knee] = bend_squares(load.y, low[knee], high[knee], meet[knee])
    return squares


def stick_drops(load: Floats | FittedLoad, edge: Ints, settings: ForceSettings) -> Floats:
    """Return the difference, at each edge, of the lines through the sticks before and after it."""
    here = np.asarray(edge - 0.5, dtype=float)
    before, after = _lines_beside(load if isinstance(load, FittedLoad) else FittedLoad(load), edge, settings)
    return before.at(here) - after.at(here)


def size_gap(drop: Floats, ratio: float, most: float) -> float:
    """Return the middle of the widest gap in log(drop) that spans `ratio`; 0 where there is none.

    At most the share `most` of the drops lies below it.
    """
    ordered = np.sort(drop[drop > 0])
    if ordered.size < 8:
        return 0.0
    lower = np.log(ordered[: int(most * ordered.size) + 1])
    widest = int(np.argmax(np.diff(lower)))
    if np.diff(lower)[widest] < np.log(ratio):
        return 0.0
    return float(np.exp(0.5 * (lower[widest] + lower[widest + 1])))
