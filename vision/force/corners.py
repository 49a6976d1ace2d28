"""Where each slip begins and ends: corners between the stick lines, and the recorded extremes around it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial.legendre import legvander

from vision.force.lines import fit_broken_lines, fit_polynomials, flat_ranges
from vision.force.lowpass import DeconvolvedLoad, SlipTransients
from vision.force.settings import ForceSettings
from vision.force.slips import stick_lines, stick_middles
from vision.numeric import Bools, Floats, Ints, mad_sigma, nan_median
from vision.signals import running_mean

# A slip of a spring and block is half a cosine: its 90 % and 10 % crossings lie 0.59 of half its length from
# the middle; those of a straight fall 0.8.
_HALF_COSINE, _STRAIGHT = 0.59, 0.8

# --- corners ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Corners:
    """Begin (peak) and end (valley) of each slip, in samples, fractions included."""

    peak: Floats
    valley: Floats
    middle: Floats  # where the load is half-way down
    drop: Floats  # height between the stick lines
    error: Floats  # standard error of one corner's place
    knee: Floats  # where the stick before and after changes slope: one more than slips, NaN where it does not
    shape: Shape  # of the sticks without a knee

    def transients(self) -> SlipTransients:
        """The stretches between slips and clear of them, in which a low-pass leaves its transients."""
        # A low-pass delays the end of a slip, not its onset.
        own = np.maximum(1.2 * (self.middle - self.peak), 1.0)
        return SlipTransients(
            start=np.ceil(self.middle + own).astype(np.int64)[:-1],
            stop=np.floor(self.middle - own).astype(np.int64)[1:],
            middle=self.middle[:-1],
            valley=self.valley[:-1],
            peak=self.peak[1:],
            drop=self.drop[:-1],
        )


def find_corners(
    signal: DeconvolvedLoad, *, two_slopes: bool, settings: ForceSettings = ForceSettings()
) -> Corners:
    """Begin and end of the slips of a recording: one peak and one valley per slip, inside the recording.

    Between the stick lines before (1) and after (0) a slip the load passes 90, 50 and 10 %; these times,
    scaled as for half a cosine, give begin and end. Slips too short for the sampling count half as long as
    they look. Each slip's own length is used where its drop is over 20 sigma, else the recording's median.
    `two_slopes`: the stick lines may have a knee.
    """
    base = _Baselines.of(signal, two_slopes, settings)
    high, middle, low = _crossings(signal.load, signal.edge, base)
    stick = np.diff(signal.edge)
    if stick.size and 2 * nan_median(np.fmin(middle - high, low - middle)) < settings.shape_slip * np.median(
        stick
    ):
        shape = Shape.of(signal.load, signal.edge, settings)
        if shape.begin or shape.end:
            base = _Baselines.of(signal, two_slopes, settings, shape)
            high, middle, low = _crossings(signal.load, signal.edge, base)
    # What sampling and smoothing alone make of a sudden drop is no part of a slip's length: it crosses 90 %
    # and 50 % 0.4 samples apart, and more where deconvolution leaves a sample part of the way down.
    blur = np.hypot(0.4 * signal.width, 0.5 if signal.late else 0.0)
    onset, end = (np.sqrt(np.maximum(part**2 - blur**2, 0.0)) for part in (middle - high, low - middle))
    usual_onset, usual_end = (float(np.nan_to_num(nan_median(part))) for part in (onset, end))
    if usual_onset + usual_end < 1.0:
        # Not resolved. Half of what is seen: the rest may be the sampling's or a low-pass too short to tell.
        usual_onset = usual_end = 0.25 * (usual_onset + usual_end)
        onset, end = np.full_like(onset, usual_onset), np.full_like(end, usual_end)
    clear = base.drop > 20 * signal.sigma  # noise would scatter the length of smaller ones
    clear &= np.isfinite(onset) & np.isfinite(end)
    onset = _half_length(np.where(clear, onset, usual_onset), base.before_slope, base.drop)
    end = np.where(clear, np.minimum(end, usual_end * 2), usual_end)
    end = _half_length(end, base.after_slope, base.drop)
    middle = middle - signal.late
    last = signal.load.size - 1.0
    return Corners(
        peak=np.clip(middle - onset, 0, last),
        valley=np.clip(middle + end, 0, last),
        middle=middle,
        drop=base.drop,
        knee=base.knee - signal.late,
        shape=base.shape,
        error=_errors(signal, base.drop, (usual_onset + usual_end) / _HALF_COSINE, settings),
    )


def _half_length(distance: Floats, slope: Floats, drop: Floats) -> Floats:
    """Half a slip's length from the distance of a crossing.

    The drop between the stick lines is the slip's own plus what the lines rise meanwhile, which is straight.
    """
    half = distance / _HALF_COSINE
    for _ in range(2):
        with np.errstate(over="ignore"):  # next to no drop: all of it is straight
            straight = np.clip(2 * slope * half / np.maximum(drop, np.finfo(float).tiny), 0, 1)
        half = distance / (_HALF_COSINE + (_STRAIGHT - _HALF_COSINE) * np.nan_to_num(straight))
    return half


def _errors(signal: DeconvolvedLoad, drop: Floats, length: float, settings: ForceSettings) -> Floats:
    """Standard error of a corner's place: noise over the slip's slope there, sampling, and unknown shape."""
    unsure = np.hypot(settings.corner_error, settings.shape_error * length)
    steepest = np.pi / 2 * np.maximum(drop, signal.sigma) / max(length, signal.width)
    return np.hypot(signal.sigma / steepest, unsure)


@dataclass(frozen=True)
class _Baselines:
    """The stick line before and after each edge: value half a sample before it, slope, and the drop."""

    before: Floats
    before_slope: Floats
    after: Floats
    after_slope: Floats
    knee: Floats
    shape: Shape

    @property
    def drop(self) -> Floats:
        return self.before - self.after

    @classmethod
    def of(
        cls, signal: DeconvolvedLoad, two_slopes: bool, settings: ForceSettings, shape: Shape | None = None
    ) -> _Baselines:
        """Straight stick lines, or with a knee where that fits clearly better, or of one shape for all."""
        y, edge = signal.load, signal.edge
        lines = stick_lines(y, edge, settings)
        here = np.asarray(edge - 0.5, dtype=float)
        # Each stick between a slip at its begin and one at its end; the first and the last lack one of them.
        begin, end = np.insert(here, 0, np.nan), np.append(here, np.nan)
        shape = shape or Shape(0.0, 0.0, 0.0)
        rise = np.nan_to_num(lines.slope * (end - begin))
        at_begin, at_end = lines.at(begin) + shape.begin * rise, lines.at(end) + shape.end * rise
        early, late = lines.slope, lines.slope
        knee = np.full(edge.size + 1, np.nan)
        if two_slopes:
            middles = stick_middles(edge, y.size, settings)
            broken = fit_broken_lines(np.arange(y.size, dtype=float), y, *middles)
            bent = (broken.gain > settings.knee_gain) & (broken.first > 0) & (broken.second > 0)
            knee = np.where(bent, broken.knee_x, np.nan)
            at_begin, early = np.where(bent, [broken.first_at(begin), broken.first], [at_begin, early])
            at_end, late = np.where(bent, [broken.second_at(end), broken.second], [at_end, late])
        return cls(at_end[:-1], late[:-1], at_begin[1:], early[1:], knee, shape)


def _crossings(y: Floats, edge: Ints, base: _Baselines) -> tuple[Floats, Floats, Floats]:
    """Where the signal falls through 90, 50 and 10 % of the way between the stick lines around each edge."""
    reach = np.maximum((0.3 * np.diff(np.r_[0, edge, y.size])).astype(np.int64), 2)  # into either stick
    row, index = flat_ranges(np.maximum(edge - reach[:-1], 0), np.minimum(edge + reach[1:], y.size - 1))
    # One line each side of the edge, at the distance of the drop there: lines of different slope never cross.
    slope = np.where(index < edge[row], base.before_slope[row], base.after_slope[row])
    line = base.after[row] + slope * (index - edge[row] + 0.5)
    u = (y[index] - line) / base.drop[row]
    middle = _half_way(u, row, index, edge.size)
    # A slip cut short by the next one may never pass half-way: its middle is then the steepest drop.
    middle = np.where(np.isfinite(middle), middle, edge - 0.5)
    high = _passage(u, row, index, 0.9, index[:-1] <= middle[row[:-1]], edge.size, 1)
    low = _passage(u, row, index, 0.1, index[1:] >= middle[row[:-1]], edge.size, -1)
    return high, middle, low


def _half_way(u: Floats, row: Ints, index: Ints, rows: int) -> Floats:
    """The likeliest place of a step from 1 to 0: where the sum of u - 0.5 so far is largest; NaN at a
    window's end.

    A single crossing of 0.5 would be thrown off by the first outlier when the drop is a few times the noise.
    """
    so_far = np.cumsum(u - 0.5)
    largest = np.full(rows, -np.inf)
    np.maximum.at(largest, row, so_far)
    best = np.flatnonzero((so_far == largest[row]) & np.r_[row[1:] == row[:-1], False])
    first = np.full(rows, u.size, dtype=np.int64)
    np.minimum.at(first, row[best], best)
    return _interpolated(u, index, 0.5, np.where(first < u.size, first, -1))


def _passage(u: Floats, row: Ints, index: Ints, level: float, allowed: Bools, rows: int, sign: int) -> Floats:
    """Index, interpolated, at which u falls through a level: for the last (sign 1) or first (-1) time of each
    row where that is allowed; NaN if never."""
    falling = np.flatnonzero((u[:-1] >= level) & (u[1:] < level) & (row[:-1] == row[1:]) & allowed)
    place = np.full(rows, -np.inf)
    np.maximum.at(place, row[falling], sign * falling)
    return _interpolated(u, index, level, np.where(np.isfinite(place), sign * place, -1).astype(np.int64))


def _interpolated(u: Floats, index: Ints, level: float, at: Ints) -> Floats:
    """Where u passes the level between the samples `at` and the next; NaN for -1."""
    here = np.maximum(at, 0)
    part = (u[here] - level) / np.maximum(u[here] - u[np.minimum(here + 1, u.size - 1)], 1e-9)
    return np.where(at >= 0, index[here] + part, np.nan)


@dataclass(frozen=True)
class Shape:
    """By how much curved sticks leave their lines at either end, as shares of what the lines rise.

    Each is what all sticks of a recording have in common; 0 where they are straight.
    """

    begin: float
    end: float
    error: float  # what the polynomials may be wrong by, the same at both ends

    @classmethod
    def of(cls, y: Floats, edge: Ints, settings: ForceSettings) -> Shape:
        """Polynomials of degree 2 to 4 through what the lines of all sticks between two slips leave."""
        start, stop = (at[1:-1] for at in stick_middles(edge, y.size, settings))
        straight = cls(0.0, 0.0, 0.0)
        length = np.diff(edge)
        rise = stick_lines(y, edge, settings).slope[1:-1] * length
        long = max(2 * settings.few_samples, 0.5 * np.quantile(length, 0.9)) if length.size else 0
        some = np.flatnonzero((length > long) & (rise > 0))  # the shorter ones may be swings
        if some.size < 8:
            return straight
        some = some[:: some.size // 400 + 1]  # enough for medians
        share = fit_polynomials(y, start[some], stop[some])[0][:, 2:] / rise[some, np.newaxis]
        middle = np.median(share, axis=0)
        standard = 1.25 * mad_sigma(share, axis=0) / np.sqrt(some.size)
        middle[np.abs(middle) < settings.shape_sigmas * standard] = 0.0
        reach = float(np.median(length[some] / (stop - 1 - start)[some]))
        terms = middle[:, np.newaxis] * legvander(np.array([-reach, reach]), 4)[:, 2:].T
        begin, end = terms.sum(axis=0)
        if not middle.any() or max(abs(begin), abs(end)) > 1.0:  # no stick leaves its line that far
            return straight
        return cls(float(begin), float(end), float(np.sqrt((terms[:, 0] ** 2).sum())) / 4)


# --- recorded extremes --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Extremes:
    """Highest load before and lowest load after the middle of each slip, spikes aside."""

    peak: Floats  # where, in samples
    valley: Floats
    high: Floats  # the load there, averaged over `width` samples
    low: Floats
    highest: Floats  # the single largest and smallest sample
    lowest: Floats
    width: Ints  # samples averaged for each slip: a 24th of it, so that a half cosine loses next to nothing

    @property
    def fall(self) -> Floats:
        """Samples from each peak to the valley after it."""
        return self.valley - self.peak

    @property
    def rise(self) -> Floats:
        """Samples from each valley to the next peak; one fewer than slips."""
        return self.peak[1:] - self.valley[:-1]


def find_extremes(y: Floats, middle: Floats, length: Floats) -> Extremes:
    """Recorded extremes around each slip of a load without spikes.

    The peak lies between the middle of the stick before and that of the slip, the valley between that and the
    middle of the stick after.  middle, length: of each slip, in samples; what is averaged follows the length.
    """
    last = y.size - 1
    between = 0.5 * (middle[:-1] + middle[1:])
    # Before the first and after the last slip: as far as half of the stick beside them.
    first = middle[0] - (between[0] - middle[0]) if between.size else 0.0
    final = middle[-1] + (middle[-1] - between[-1]) if between.size else last
    bounds = np.clip(np.r_[first, between, final], 0, last)
    here = np.clip(np.rint(middle), 0, last).astype(np.int64)
    # Middles of slips that hardly differ may come in either order: each slip has its own sample at least.
    start = np.minimum(np.floor(bounds[:-1]).astype(np.int64), here)
    stop = np.maximum(np.ceil(bounds[1:]).astype(np.int64), here)
    width = 2 * (np.nan_to_num(length) / 48).astype(np.int64) + 1
    smooth = {int(w): running_mean(y, int(w)) for w in np.unique(_octaves(width))}
    peak, high, highest = _largest(y, smooth, _octaves(width), start, here + 1, 1)
    valley, low, lowest = _largest(-y, smooth, _octaves(width), here, stop + 1, -1)
    return Extremes(peak, valley, high, -low, highest, -lowest, width)


def _octaves(width: Ints) -> Ints:
    """Odd widths 1, 3, 5, 9, 17, …: a few filters serve all slips."""
    exponent = np.floor(np.log2(np.maximum(width - 1, 1))).astype(np.int64)
    return np.where(width > 1, 2**exponent + 1, 1)


def _largest(
    y: Floats, smooth: dict[int, Floats], width: Ints, start: Ints, stop: Ints, sign: int
) -> tuple[Floats, Floats, Floats]:
    """(place, smoothed value, single largest sample) of the largest value in each range."""
    row, index = flat_ranges(start, np.minimum(stop, y.size))
    single = np.full(start.size, -np.inf)
    np.maximum.at(single, row, y[index])
    values = np.empty(index.size)
    for w, signal in smooth.items():
        mine = width[row] == w
        values[mine] = sign * signal[index[mine]]
    best = np.full(start.size, -np.inf)
    np.maximum.at(best, row, values)
    hits = np.flatnonzero(values == best[row])
    place = np.full(start.size, np.nan)
    # Of equal samples the one next to the slip: the last for peaks, the first for valleys.
    order = hits if sign > 0 else hits[::-1]
    place[row[order]] = index[order]
    return place, best, single


def is_slow(fall: Floats, rise: Floats, settings: ForceSettings) -> Bools:
    """Slips (lengths `fall`) that take a considerable part of the sticks beside them (`rise`, one fewer)."""
    if not rise.size:
        return np.zeros(fall.shape, dtype=bool)
    beside = np.minimum(np.r_[rise[:1], rise], np.r_[rise, rise[-1:]])
    return np.asarray(fall > settings.slow_slip * np.maximum(beside, 1e-9), np.bool_)
