"""Each stick phase: its corners to a fraction of a sample, and all that is measured on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pandas as pd
import xarray as xr
from numpy.polynomial.legendre import legvander

from vision.force.lines import BrokenLines, fit_broken_lines, fit_lines, fit_polynomials, flat_ranges
from vision.force.recording import find_spikes, noise_sigma, usable
from vision.force.settings import ForceSettings
from vision.force.slips import DeconvolvedLoad, SlipTransients, stick_lines, stick_middles
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


# --- measures -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Signal:
    """The good samples of a force recording."""

    time: Floats  # s
    travel: Floats  # of the sample's end, mm
    load: Floats  # as recorded, N
    clean: Floats  # with spikes replaced by their neighbours, N
    is_spike: Bools  # samples that are spikes
    sigma: float  # noise of the load, N
    damage: dict[str, Ints]  # for each kind of bad sample, how many of them came before each good one
    alike: float = 1.0  # neighbouring samples whose noise counts as one: more than 1 where it is not white

    @classmethod
    def of(cls, force: xr.Dataset, settings: ForceSettings) -> Signal:
        """The good samples of a recording from `vision.force.read_force`."""
        count = force.sizes["time_s"]
        flags = np.asarray(force["flag"].values, dtype=str) if "flag" in force else np.full(count, "ok")
        good = usable(flags)
        good[np.flatnonzero(good)[_filled_in(force["load_N"].to_numpy()[good].astype(float))]] = False
        time, travel, load = (force[k].to_numpy()[good].astype(float) for k in ("time_s", "d_mm", "load_N"))
        sigma = noise_sigma(load)
        is_spike, clean = find_spikes(load, sigma, settings=settings)
        kinds = ("gap", "nan", "saturated", "repeated", "backwards")
        damage = {kind: np.cumsum(flags == kind)[good] for kind in kinds if np.any(flags == kind)}
        return cls(time, travel, load, clean, is_spike, sigma, damage)

    @cached_property
    def interval_s(self) -> float:
        """From sample to sample, at the median."""
        return float(np.median(np.diff(self.time)))

    def interval_at(self, place: Floats) -> Floats:
        """Time between the samples around these places: it may change within a recording."""
        earlier = np.clip(np.floor(place).astype(np.int64), 0, self.time.size - 2)
        return self.time[earlier + 1] - self.time[earlier]

    @cached_property
    def spikeless(self) -> Floats:
        """Load with NaN for spikes, so that fits leave them out."""
        return np.where(self.is_spike, np.nan, self.load)


def _filled_in(load: Floats) -> Bools:
    """Samples that repeat the one before, or lie on a straight line from one measured value to the next: of a
    file written at a higher rate than the load cell's.

    Then nearly all runs of equal values, or of equal differences, are of one length; steps of a coarse load
    are not. Where a line's ends lie between samples the first sample after each is kept.
    """
    steps = np.diff(np.unique(load[:20_000]))  # enough to show the last digit written
    rounding = 3 * float(np.min(steps, where=steps > 1e-9 * np.ptp(load), initial=np.inf))
    repeats = np.diff(load, prepend=np.nan) == 0
    bends = np.r_[True, np.abs(np.diff(load, 2)) > rounding, True]
    bends[1:] &= ~bends[:-1]
    for measured, most in ((~repeats, load.size), (bends, 25)):
        length = np.diff(np.append(np.flatnonzero(measured), load.size))
        usual = np.median(length)
        even = np.abs(length - usual * np.rint(length / usual)) <= (usual >= 4 and measured is bends)
        if 1 < usual <= most and np.mean(even) > 0.9:
            return np.asarray(~measured, np.bool_)
    return np.zeros_like(repeats)


@dataclass(frozen=True)
class _Sticks:
    """Valley, peak and knee (NaN: none) of each stick, in samples; lag: time constant of the low-pass."""

    v: Floats
    p: Floats
    knee: Floats
    lag: float
    settings: ForceSettings

    def central(self, part: float) -> tuple[Ints, Ints]:
        """[start, stop) of the central part."""
        margin = 0.5 * (1 - part) * (self.p - self.v)
        return _between(self.v + margin, self.p - margin)

    def one_slope(self, part: float) -> tuple[Ints, Ints]:
        """The same after the knee; before it where it comes late."""
        length = self.p - self.v
        margin, clear = 0.5 * (1 - part) * length, 0.03 * length
        start, stop = self.v + margin, self.p - margin
        early = self.knee - self.v < 0.65 * length
        start = np.where(early, np.fmax(start, self.knee + clear), start)
        return _between(start, np.where(early, stop, np.fmin(stop, self.knee - clear)))

    def broken(self, x: Floats, y: Floats) -> BrokenLines:
        """Lines with a knee through nearly all of each stick."""
        return fit_broken_lines(x, y, *self.central(self.settings.line_part), lag=self.lag)


def _between(start: Floats, stop: Floats) -> tuple[Ints, Ints]:
    return np.ceil(start).astype(np.int64), np.floor(stop).astype(np.int64) + 1


def measure_sticks(
    signal: Signal,
    corners: Corners,
    extremes: Extremes,
    lag: float,
    two_slopes: bool,
    compliance: float,
    settings: ForceSettings,
) -> pd.DataFrame:
    """The columns of `vision.data.STICKS` that are measured on each stick by itself.

    One row per stick, from the valley after slip j to the peak before slip j + 1.  corners, extremes: in
    samples; valley[j] ends slip j, peak[j] begins it.  lag: time constant of the low-pass that is corrected
    for, in samples, 0: as recorded.  compliance: of the machine, mm/N.
    """
    index = np.arange(signal.time.size, dtype=float)
    slow = is_slow(corners.valley - corners.peak, corners.peak[1:] - corners.valley[:-1], settings)
    recorded = slow if not lag else np.zeros_like(slow)
    valley = np.where(recorded, extremes.valley, corners.valley)
    peak = np.where(recorded, extremes.peak, corners.peak)
    v, p, v_next = valley[:-1], peak[1:], valley[1:]
    sticks = _Sticks(v, p, corners.knee[1:-1], lag, settings)
    t_v, t_p, t_next = (np.interp(at, index, signal.time) for at in (v, p, v_next))
    ends = _ends(signal, sticks, t_v, t_p, corners.shape)
    # by which a stick may rise beyond its last sample, and a wrong place of its corner moves the force there
    rises = [np.abs(ends.slope) * signal.interval_at(at) for at in (v, p)]
    f_v, f_p = ends.f_v, ends.f_p
    if lag:
        load, there = _without_lowpass(signal, lag), (corners.middle, corners.valley - corners.peak)
        held = _within_recorded(load, find_extremes(load.clean, *there), ends, rises, settings)
        bent = np.isfinite(sticks.knee)
        f_v, f_p = (np.where(bent, one, line) for one, line in zip(held, (f_v, f_p), strict=True))
    else:
        f_v, f_p = _within_recorded(signal, extremes, ends, rises, settings)
        f_v = np.where(recorded[:-1], extremes.low[:-1], f_v)
        f_p = np.where(recorded[1:], extremes.high[1:], f_p)
    place = np.where(recorded, _flat_top_error(signal, corners, extremes), corners.error)
    # The machine's stretch is subtracted at the corners: at every sample it would add the load's noise to d.
    d_v = np.interp(v, index, signal.travel) - compliance * f_v
    d_p = np.interp(p, index, signal.travel) - compliance * f_p
    last = np.interp(v_next[-1:], index, signal.travel) - compliance * signal.clean[int(v_next[-1])]
    relative = np.hypot(place[:-1], place[1:]) / (p - v)
    # Either end of a stick is read off single samples of d, with their noise and steps.
    unsteady = np.nan_to_num(fit_lines(signal.time, signal.travel, *_between(v, p)).spread)
    # Near a slow slip's extreme the load is level: the place of the corner does not matter there.
    f_v_err = np.hypot(ends.error_v, np.where(recorded[:-1], 0, rises[0] * place[:-1]))
    f_p_err = np.hypot(ends.error_p, np.where(recorded[1:], 0, rises[1] * place[1:]))
    # Ringing swings about the stick line; a stick may also bend too sharply to be followed. Noise aside, what
    # was recorded beyond the line is part of the error.
    noise = 4 * signal.sigma
    f_v_err = np.hypot(f_v_err, np.maximum(f_v - extremes.lowest[:-1] - noise, 0))
    f_p_err = np.hypot(f_p_err, np.maximum(extremes.highest[1:] - f_p - noise, 0))
    table = pd.DataFrame(
        {
            "event": np.arange(v.size),
            "t_v_s": t_v,
            "t_p_s": t_p,
            "d_v_mm": d_v,
            "d_p_mm": d_p,
            "F_v_N": f_v,
            "F_p_N": f_p,
            "dF_N": f_p - f_v,
            "stick_length_um": 1e3 * (d_p - d_v),
            "slip_length_um": 1e3 * (np.r_[d_v[1:], last] - d_p),
            **_stiffness(signal, sticks, two_slopes, compliance),
            "F_v_raw_N": extremes.lowest[:-1],
            "F_p_raw_N": extremes.highest[1:],
            "F_v_err_N": f_v_err,
            "F_p_err_N": f_p_err,
            "dF_err_N": np.hypot(f_v_err, f_p_err),
            "stick_length_err_um": 1e3 * np.hypot((d_p - d_v) * relative, np.sqrt(2) * unsteady),
            "slip_time_s": t_next - t_p,
            "samples": (p - v).astype(int),
        }
    )
    return table.assign(flag=_event_flags(signal, sticks, corners, ends.slope > 0, slow[:-1] | slow[1:]))


def _without_lowpass(signal: Signal, lag: float) -> Signal:
    """The load before a low-pass of `lag` samples, with the noise that this brings."""
    gain = 1 / np.expm1(1 / lag)
    load = signal.clean + gain * np.diff(signal.clean, prepend=signal.clean[:1])
    return replace(signal, clean=load, sigma=signal.sigma * float(np.sqrt(1 + 2 * gain * (1 + gain))))


def _within_recorded(
    signal: Signal, extremes: Extremes, ends: _Ends, rises: Sequence[Floats], settings: ForceSettings
) -> tuple[Floats, Floats]:
    """Forces at the ends of the stick lines, held to what was recorded there.

    A stick ends between two samples, and may be a sample's rise longer than what was recorded; since the load
    cell is late, a small share of the drop is left at the valley. The whole recording's range is never left.
    """
    highest, lowest = extremes.highest[1:], extremes.lowest[:-1]
    rise_v, rise_p = rises
    spare = rise_v + settings.between_samples * np.maximum(highest - lowest, 0)
    f_v = np.fmax(ends.f_v, np.maximum(lowest - spare, signal.clean.min()))
    f_p = np.fmin(ends.f_p, np.minimum(highest + rise_p, signal.clean.max()))
    return f_v, f_p


def _flat_top_error(signal: Signal, corners: Corners, extremes: Extremes) -> Floats:
    """Samples within which noise hides the extreme of half a cosine."""
    noise = signal.sigma / np.sqrt(extremes.width)
    relative = noise / np.maximum(extremes.high - extremes.low, noise)
    return np.asarray(np.fmax(extremes.fall * 2 / np.pi * np.sqrt(relative), corners.error))


@dataclass(frozen=True)
class _Ends:
    """Forces at the two ends of each stick with the errors of their lines, and the sticks' slope in N/s."""

    f_v: Floats
    f_p: Floats
    error_v: Floats
    error_p: Floats
    slope: Floats


def _ends(signal: Signal, sticks: _Sticks, t_v: Floats, t_p: Floats, shape: Shape) -> _Ends:
    """Stick lines extended to the corners, each side of a knee its own, with the common curvature."""
    central = sticks.central(sticks.settings.line_part)
    line = fit_lines(signal.time, signal.spikeless, *central, lag=sticks.lag)
    bent = np.isfinite(sticks.knee)
    rise = np.maximum(line.slope * (t_p - t_v), 0.0)
    f_v, f_p = line.at(t_v) + shape.begin * rise, line.at(t_p) + shape.end * rise
    if bent.any():
        broken = sticks.broken(signal.time, signal.spikeless)
        f_v = np.where(bent, broken.first_at(t_v), f_v)
        f_p = np.where(bent, broken.second_at(t_p), f_p)
    wider = np.sqrt(signal.alike)
    error_v, error_p = (np.hypot(wider * line.error_at(at), shape.error * rise) for at in (t_v, t_p))
    return _Ends(f_v, f_p, error_v, error_p, line.slope)


def _stiffness(signal: Signal, sticks: _Sticks, two_slopes: bool, compliance: float) -> dict[str, Floats]:
    """Slopes of load against d, corrected for the machine's compliance in series."""

    def sample(slope: Floats) -> Floats:
        with np.errstate(divide="ignore"):
            return np.where(slope * compliance < 1, slope / (1 - slope * compliance), np.nan)

    time, travel, load, wider = signal.time, signal.travel, signal.spikeless, np.sqrt(signal.alike)

    def both(start: Ints, stop: Ints) -> tuple[Floats, Floats]:
        """K and its error: against d itself, its noise and steps would make every slope too small."""
        rise = fit_lines(time, load, start, stop, lag=sticks.lag)
        pace = fit_lines(time, travel, start, stop, lag=sticks.lag)
        with np.errstate(divide="ignore", invalid="ignore"):
            slope = np.where(pace.slope == 0, np.nan, rise.slope / pace.slope)
            error = np.hypot(wider * rise.slope_error, slope * pace.slope_error) / np.abs(pace.slope)
            return sample(slope), error * (sample(slope) / slope) ** 2

    part = sticks.settings.central_part
    (k, error), (narrow, _), (wide, _) = (both(*sticks.central(share)) for share in (part, 0.3, 0.7))
    columns = {"K_N_per_mm": k, "K_err_N_per_mm": error}
    columns |= {"K30_N_per_mm": narrow, "K70_N_per_mm": wide}
    names = ("K1_N_per_mm", "K2_N_per_mm", "K2_err_N_per_mm", "knee", "knee_gain")
    if not two_slopes or not np.isfinite(travel).any():
        return columns | dict.fromkeys(names, np.full(k.size, np.nan))
    broken = sticks.broken(travel, load)
    after, after_error = both(*sticks.one_slope(part))
    bent = np.isfinite(sticks.knee)
    second = np.where(bent, after, sample(broken.second)), np.where(bent, after_error, error)
    return columns | dict(zip(names, (sample(broken.first), *second, broken.knee, broken.gain), strict=True))


def _event_flags(signal: Signal, sticks: _Sticks, corners: Corners, rising: Bools, slow: Bools) -> list[str]:
    """What is wrong within each stick, joined by "+"; "ok" where nothing is."""
    v, p, last = sticks.v, sticks.p, signal.time.size - 1
    # The slips at both ends count: what was lost in one hides how high or low the load was there.
    begin, end = np.fmin(corners.peak[:-1], v), np.fmax(corners.valley[1:], p)
    first, final = (np.clip(at, 0, last).astype(int) for at in (np.floor(begin), np.ceil(end)))
    marks = {kind: seen[final] > seen[first] for kind, seen in signal.damage.items()}
    marks |= {"few": p - v < sticks.settings.few_samples, "falling": ~rising, "slow": slow}
    return ["+".join(word for word, mark in marks.items() if mark[k]) or "ok" for k in range(v.size)]
