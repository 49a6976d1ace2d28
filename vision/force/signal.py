"""The good samples of a recording: lost and filled-in ones, spikes, ringing, white and slow noise, hum."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy
import xarray as xr
from numpy.lib.stride_tricks import sliding_window_view

from vision.force.lines import fit_lines, fit_polynomials
from vision.force.recording import flags_of, usable
from vision.force.settings import ForceSettings
from vision.force.slips import Slips, stick_middles
from vision.numeric import (
    Bools,
    Floats,
    Ints,
    flat_ranges,
    nan_median,
    peak_offset,
    quantum,
    spread_indices,
    white_noise,
)
from vision.signals import find_maxima, running_mean, running_median

_WITHIN = 0.683  # share of normally distributed values within one standard deviation


@dataclass(frozen=True)
class Signal:
    """The good samples of a force recording."""

    time: Floats  # s
    travel: Floats  # separation, mm
    load: Floats  # as recorded, or averaged, N
    clean: Floats  # load with spikes replaced by their neighbours, N
    is_spike: Bools  # samples that are spikes
    is_missing: Bools  # samples put in where the recording lost one
    sigma: float  # standard deviation of the load's white noise, N
    noise: Floats  # the same at every sample
    damage: dict[str, Ints]  # by kind, the number of bad samples before each good one
    alike: float = 1.0  # number of neighbouring samples whose noise is common: 1 for white noise
    wander: float = 0.0  # standard deviation, N, of noise so slow that it moves a stick as a whole
    slow: SlowNoise | None = None  # noise that is not white
    hum: Sequence[Hum] = ()  # the strongest line first; the load contains it, and the noise its rms
    averaged: float = 0.0  # samples over which the load was averaged, which takes ringing out of it
    every: int = 1  # samples of the recording for each of these

    @classmethod
    def of(cls, force: xr.Dataset, settings: ForceSettings) -> Signal:
        """Select the good samples of a recording from `vision.force.read_force`."""
        flags = flags_of(force, settings)
        good = usable(flags)
        # A few lost samples leave a stick whole: more of them in a row, and those at the limit, do not.
        run = np.cumsum(good)
        many = np.bincount(run, ~good)[run] >= settings.gap_intervals
        good[np.flatnonzero(good)[_filled_in(force["load_N"].to_numpy()[good].astype(float))]] = False
        time, travel, load = (force[k].to_numpy()[good].astype(float) for k in ("time_s", "d_mm", "load_N"))
        noise, sigma = noise_levels(load, settings)
        is_spike, clean = find_spikes(load, noise, settings=settings)
        kinds = ("gap", "nan", "saturated", "repeated", "backwards")
        bad = {kind: (flags == kind) & (many | (kind in {"gap", "saturated"})) for kind in kinds}
        damage = {kind: np.cumsum(at)[good] for kind, at in bad.items() if at.any()}
        none = np.zeros_like(is_spike)
        return cls(time, travel, load, clean, is_spike, none, sigma, noise, damage)._even(settings)

    def _even(self, settings: ForceSettings) -> Signal:
        """Return the signal with the samples that the recording lost put in by interpolation.

        All that follows counts samples, which else ran unevenly. Unchanged unless all times are multiples of
        one interval, and where the rate itself changes; gaps stay.
        """
        steps = np.diff(self.time)
        steps = steps / np.median(steps[steps < 1.5 * np.quantile(steps, 0.1)])
        count = np.rint(steps)
        lost = (count > 1) & (count <= settings.gap_intervals)
        slower = sliding_window_view(count, min(100, count.size)).min(axis=1) > 1
        if not lost.any() or slower.any() or np.mean(np.abs(steps - count) < 0.1) < 0.99:
            return self
        count = np.where(lost, count, 1)
        place = np.r_[0.0, np.cumsum(count)]
        every = np.arange(place[-1] + 1)
        before = np.searchsorted(place, every, side="right") - 1
        new = place[before] != every
        return replace(
            self,
            time=np.interp(every, place, self.time),
            travel=np.interp(every, place, self.travel),
            load=np.interp(every, place, self.load),
            clean=np.interp(every, place, self.clean),
            is_spike=self.is_spike[before] & ~new,
            is_missing=new,
            noise=self.noise[before],
            damage={kind: counted[before] for kind, counted in self.damage.items()},
        )

    def average(self, average_s: float, settings: ForceSettings) -> Signal:
        """Return the signal with the load averaged over a time, spikes included; unchanged for 0."""
        if not average_s:
            return self
        load, width = averaged(self.time, self.load, average_s), average_s / self.interval_s
        # The mean of many averages has the noise that it had without them, in which ringing cancels between
        # samples one period apart.
        apart = max(min(round(width), self.load.size // 10), 1)
        sigma = max(noise_sigma(self.load[k::apart]) for k in range(min(apart, 8)))
        noise = np.full(load.shape, sigma)
        return replace(self, load=load, averaged=width)._cleaned(noise, sigma, settings)

    def thinned(self, every: int, settings: ForceSettings) -> Signal:
        """Return one sample in so many, as recorded, and the spikes and noise of these."""
        part = slice(None, None, every)
        arrays = ("time", "travel", "load", "is_missing")
        thin = replace(
            self,
            **{name: getattr(self, name)[part] for name in arrays},
            damage={kind: counted[part] for kind, counted in self.damage.items()},
            every=every,
        )
        return thin._cleaned(*thin.noise_of(thin.load, settings), settings)

    def _cleaned(self, noise: Floats, sigma: float, settings: ForceSettings) -> Signal:
        """Return the signal with this noise, and the spikes that exceed it."""
        is_spike, clean = find_spikes(self.load, noise, settings=settings)
        return replace(self, clean=clean, is_spike=is_spike & ~self.is_missing, noise=noise, sigma=sigma)

    def with_noise_of(self, thin: Signal) -> Signal:
        """Return all samples with the noise that was measured in one sample of every few."""
        return replace(
            self,
            noise=np.repeat(thin.noise, thin.every)[: self.time.size],
            sigma=thin.sigma,
            alike=thin.alike * thin.every,
            wander=thin.wander,
            slow=thin.slow,
            hum=[Hum(line.frequency / thin.every, line.wave) for line in thin.hum],
        )

    def without(self, hum: Sequence[Hum], settings: ForceSettings) -> Signal:
        """Return the signal without these waves, and the noise that remains."""
        if not hum:
            return self
        clean = self.clean - np.sum([line.wave for line in hum], axis=0)
        noise, sigma = self.noise_of(clean, settings)
        least = quantum(self.load) / np.sqrt(12.0)  # which the waves hide but do not remove
        return replace(self, clean=clean, sigma=max(sigma, least), noise=np.maximum(noise, least))

    def noise_of(self, load: Floats, settings: ForceSettings) -> tuple[Floats, float]:
        """Return the noise of a load at every sample, and of all: interpolated samples show none."""
        known = ~self.is_missing
        noise, sigma = noise_levels(load[known], settings)
        return noise[np.maximum(np.cumsum(known) - 1, 0)], sigma

    @cached_property
    def interval_s(self) -> float:
        """Median sampling interval."""
        return float(np.median(np.diff(self.time)))

    def interval_at(self, position: Floats) -> Floats:
        """Return the sampling interval at each position (samples), since it may change within a recording."""
        earlier = np.clip(np.floor(position).astype(np.int64), 0, self.time.size - 2)
        return self.time[earlier + 1] - self.time[earlier]

    def noise_at(self, position: Floats) -> Floats:
        """Return the standard deviation of the white noise at each position (samples), N."""
        return self.noise[np.clip(np.rint(position).astype(np.int64), 0, self.time.size - 1)]

    def time_at(self, position: Floats) -> Floats:
        """Return the time at each position (samples)."""
        return np.interp(position, np.arange(self.time.size), self.time)

    @cached_property
    def spikeless(self) -> Floats:
        """Load with NaN in place of spikes and lost samples, so that fits leave them out."""
        return np.where(self.is_spike | self.is_missing, np.nan, self.load)


def _filled_in(load: Floats) -> Bools:
    """Return which samples were filled in because the file is written at a higher rate than the load cell's.

    They repeat the sample before, or lie on a straight line from one measured value to the next. Nearly all
    values, or bends, then begin in the sample after a tick of the load cell's clock (`_tick`), unlike the
    steps of a coarse load. Where a value is equal to the one before, its first sample is a tick later.
    """
    rounding = 3 * quantum(load[:20_000])  # enough to find the last digit written
    repeats = np.diff(load, prepend=np.nan) == 0
    tick = _tick(~repeats)
    if tick:
        index = np.arange(load.size)
        begin = np.maximum.accumulate(np.where(repeats, 0, index))
        age, left = index - begin, np.append(np.flatnonzero(~repeats), load.size)[np.cumsum(~repeats)] - index
        new = (age == np.rint(tick * np.rint(age / tick))) & (left > tick / 2)
        return np.asarray(repeats & ~new, np.bool_)
    if _repeats_at_random(load, repeats):
        return np.asarray(repeats, np.bool_)
    bends = np.r_[True, np.abs(np.diff(load, 2)) > rounding, True]
    second = bends[1:] & bends[:-1]
    second[1:] &= ~bends[:-2]  # three in a row are a curve, as of a load that rings
    bends[1:] &= ~second
    return np.asarray(~bends if 0 < _tick(bends) <= 25 else np.zeros_like(bends), np.bool_)


def _repeats_at_random(load: Floats, repeats: Bools) -> bool:
    """Return whether a program that asks for the load faster than it is measured has repeated values: three
    tenths of them, at least, though the load changes by ten times its last digit or more from one to the
    next. Values of a coarse load, which repeat by chance, change by one or two digits."""
    new = np.flatnonzero(~repeats)
    lengths, changes = np.diff(np.append(new, load.size)), np.abs(np.diff(load[new]))
    if new.size < 100 or np.mean(lengths > 1) < 0.3:
        return False
    return float(np.median(changes)) > 10 * quantum(load[:20_000])


def _tick(begins: Bools) -> float:
    """Return the samples from tick to tick of a clock in whose ticks values begin; 0 for none.

    In parts of 64 values, each with its own phase, 95 % begin within one sample after a tick.
    """
    at = np.flatnonzero(begins)
    usual = float(np.median(np.diff(at))) if at.size > 10 else 0.0
    if usual <= 1:
        return 0.0
    ticks = []
    for first in spread_indices(max(at.size - 64, 1), 8):
        some = at[first : first + 64] - at[first]
        step = 1 / (8.0 * some[-1])
        frequency = np.arange(0.5 / usual, min(4 / usual, 0.5 + step), step)  # some values may be equal
        phase = np.exp(2j * np.pi * frequency[:, np.newaxis] * some)
        away = np.abs(np.angle(phase / phase.mean(axis=1, keepdims=True))) / (2 * np.pi)
        within = np.mean(away <= 0.5 * frequency[:, np.newaxis] + 0.07, axis=1) >= 0.95
        ticks.append(1 / frequency[np.argmax(within)] if within.any() else 0.0)
    tick = float(np.median(ticks))
    return tick if np.mean(np.abs(np.array(ticks) - tick) <= 0.02 * tick) > 0.7 else 0.0


# --- white noise and spikes ---------------------------------------------------------------------------------


def noise_sigma(y: Floats) -> float:
    """Estimate the standard deviation of white noise on slow rises with sudden drops, from three samples on.

    The median absolute second difference depends neither on the rises nor on the few drops. The result is at
    least the noise that the quantum q of the recording causes, and never zero:

    .. math:: \\sigma = \\max(\\mathrm{MAD}(\\Delta^2 y) / (0.674\\,\\sqrt 6),\\; q / \\sqrt{12})
    """
    return float(
        max(white_noise(y), quantum(y) / np.sqrt(12.0), 1e-9 * float(np.ptp(y)), np.finfo(float).tiny)
    )


def smoothed_samples(load: Floats, settings: ForceSettings) -> int:
    """Return the samples over which a filter has smoothed the noise, a power of two; 1 for none.

    The noise of every k-th sample grows with k by up to a factor of four where k doubles as long as samples
    are alike, and not at all once they are not; bent sticks and slips let it grow again. k is where it grows
    least. Noise that nowhere before grows by `smooth_growth`, as that of a random walk, is not smooth. That
    behind a moving mean grows faster at the length of the mean. Of hum, four samples in each period are left.
    """
    most = load.size // settings.smooth_fewest
    if most < 2:
        return 1
    # Rounding hides how noise of less than half a quantum grows.
    least_N = max(0.5 * quantum(load), 1e-9 * float(np.ptp(load)), np.finfo(float).tiny)
    if _noise_of_half(load[::2], least_N) < 1.3 * _noise_of_half(load, least_N):  # neighbours are not alike
        return 1
    hum = find_hum(load, settings)
    quiet = load - np.sum([line.wave for line in hum], axis=0) if hum else load
    sigma, growth = [_noise_of_half(quiet, least_N)], [np.inf]
    # At the length of a moving mean it grows by a quarter more than before.
    while 2 ** len(growth) <= most and growth[-1] <= 1.3 * min(growth):
        every = 2 ** len(growth)
        parts = [_noise_of_half(quiet[k::every], least_N) for k in range(min(every, 4))]
        sigma.append(float(np.median(parts)))
        growth.append(sigma[-1] / sigma[-2])
    least = int(np.argmin(growth)) - 1
    if max(growth[1 : least + 2]) < settings.smooth_growth:
        return 1
    every = 1 << least
    fastest = max((line.frequency for line in hum if line.rms > sigma[least]), default=0.0)
    return every if every * fastest <= 0.25 else 1 << max(int(np.log2(0.25 / fastest)), 0)


def _noise_of_half(y: Floats, least: float) -> float:
    """Return the noise, at least `least`, from the mean of the smaller half of the second differences.

    Their median, as in `noise_sigma`, would be a multiple of the quantum, and jump as the noise grows.
    """
    size = np.abs(np.diff(y, 2))
    half = np.partition(size, size.size // 2)[: size.size // 2]
    return max(float(half.mean() / (0.3247 * np.sqrt(6))), least)


def noise_levels(y: Floats, settings: ForceSettings) -> tuple[Floats, float]:
    """Return `noise_sigma` at every sample, of all unless the parts differ by `noise_ratio`; and of all."""
    whole = noise_sigma(y)
    parts = np.array_split(y, min(y.size // 500 + 1, 32))
    level = np.maximum(running_median(np.array([noise_sigma(part) for part in parts]), 3), 0.05 * whole)
    if level.max() < settings.noise_ratio * level.min():
        return np.full(y.shape, whole), whole
    level = np.max(sliding_window_view(np.pad(level, 1, "edge"), 3), axis=1)  # a change lies within a part
    return np.repeat(level, [part.size for part in parts]), whole


def find_spikes(
    y: Floats, sigma: Floats | float, *, settings: ForceSettings = ForceSettings()
) -> tuple[Bools, Floats]:
    """Return which samples belong to spikes, and the signal with their neighbours' level in place of spikes.

    A spike, of one or two samples, differs by `spike_sigmas` from the median of the five samples around it.
    """
    middle = running_median(y, 5)
    off = np.abs(y - middle) - settings.spike_sigmas * sigma
    # The corner of a steep sawtooth also differs from the median, by at most two rises between samples: those
    # of the whole recording, or those nearby where a part was sampled more slowly.
    rise = np.abs(np.diff(middle, append=middle[-1:]))
    suspect = np.flatnonzero(off > 2.0 * np.median(rise))
    around, is_spike = sliding_window_view(np.pad(rise, 50, "edge"), 101), np.zeros(y.size, np.bool_)
    for some in np.array_split(suspect, suspect.size // 65_536 + 1):  # so that memory does not grow with them
        is_spike[some] = off[some] > 2.0 * np.median(around[some], axis=1)
    is_spike[is_spike] = ~_begins_bent(y, np.flatnonzero(is_spike), sigma)
    clean = np.where(is_spike, middle, y)
    return is_spike, clean


def _begins_bent(y: Floats, at: Ints, sigma: Floats | float) -> Bools:
    """Return which samples `at` are an end of a stick that is steep there, as of sheets that slip in turn:
    the step to the next sample is within a factor of three of those further on, which are clear of the noise,
    and the load on the other side is on another level."""
    bent = np.zeros(at.size, np.bool_)
    for way in (1, -1):
        here, beside, far = (y[np.clip(at + k * way, 0, y.size - 1)] for k in (0, 1, 3))
        near, further = beside - here, (far - beside) / 2
        alike = (
            (near * further > 0) & (np.abs(near) < 3 * np.abs(further)) & (np.abs(further) < 3 * np.abs(near))
        )
        clear = np.abs(further) > 3 * np.broadcast_to(sigma, y.shape)[at]
        slip = np.abs(far - y[np.clip(at - 3 * way, 0, y.size - 1)]) > 3 * np.abs(near)
        bent |= alike & clear & slip
    return bent


def step_between(values: Floats) -> float:
    """Return the median step between the values that occur; 0 where nearly all values differ."""
    different = np.unique(values[np.isfinite(values)])
    return float(np.median(np.diff(different))) if 2 < different.size < 0.2 * values.size else 0.0


def slope_error_of_steps(step: float, way: Floats) -> Floats:
    """Return the relative standard error, at most 1, of the slope of a column that rises by `way` in steps.

    It is that of a line fitted to a staircase whose first step may begin anywhere.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.fmin(0.44 * (step / way) ** 2, 1.0), np.float64)


# --- ringing ------------------------------------------------------------------------------------------------


def ringing_period(load: Floats, settings: ForceSettings) -> float:
    """Return the period of an oscillation that follows the slips, in samples; NaN for none.

    The autocorrelation of the load's steps falls below minus `ringing_alike` and then rises above it. Slips,
    which are the largest steps, are cut to the size of the others. A load that oscillates throughout also has
    such a period. The steps of a coarse load, by one quantum at regular times, are no oscillation. Ringing
    that decays within a period or two is too short for that, and is told by the load after the largest falls.
    """
    step = np.diff(load)
    step -= np.median(step)
    size = np.abs(step)
    for cut in (1 - settings.ringing_steps, 3 * (1 - settings.ringing_steps)):  # slips may be slow
        most = float(np.quantile(size, 1 - cut))
        period = _period(np.clip(step, -most, most), settings) if most else float("nan")
        if np.isfinite(period):
            return period if most > 1.5 * quantum(load) else float("nan")
    # A fall of many samples has several steepest ones in noise; of one sample in 4 or 16 it has one.
    swings = (every * _swing_after_falls(load[::every], settings) for every in (1, 4, 16))
    return next((period for period in swings if np.isfinite(period)), float("nan"))


def _swing_after_falls(load: Floats, settings: ForceSettings) -> float:
    """Return the time in which the load swings after its falls, in samples; NaN if it does not.

    Of the load after the largest falls, less a line through later samples and over the size of the fall, the
    median over the falls goes below the line, above it by `ringing_rebound` or more, and below it again.
    """
    step, fewest = np.diff(load), settings.ringing_fewest
    if step.size < 4 * fewest:
        return float("nan")
    large = -0.5 * np.partition(step, fewest)[fewest]
    at = find_maxima(-step, least_prominence=1e-300, reach=fewest).at
    at = at[-step[at] >= large]
    length = int(np.median(np.diff(at))) // 2 if at.size > 1 else 0
    at = at[(at >= length // 4) & (at + 1 + length < load.size)]
    if length < 16 or at.size < fewest // 2:
        return float("nan")
    after, k = load[at[:, None] + 1 + np.arange(length)], np.arange(length)
    slope, level = np.polyfit(k[length // 2 :], after[:, length // 2 :].T, 1)
    fall = load[at[:, None] - np.arange(length // 4)].max(axis=1) - level
    steps = quantum(load)
    if np.median(fall) <= steps:
        return float("nan")
    each = (after - slope[:, None] * k - level[:, None]) / np.fmax(fall, steps)[:, None]
    swing = np.median(each, axis=0)
    low = int(np.argmin(swing))
    high = low + int(np.argmax(swing[low:]))
    again = high + int(np.argmin(swing[high : 3 * high - 2 * low + 1]))
    # Ringing that lasts is still there in the second half, as is the bend of the sticks.
    bend, noise = float(np.std(swing[length // 2 :])), float(np.median(np.abs(each[:, high] - swing[high])))
    noise = 5 * noise / (0.674 * float(np.sqrt(at.size)))
    least = max(settings.ringing_rebound, 2.5 * bend, noise, 1.5 * steps / float(np.median(fall)))
    if swing[high] < least or swing[again] > 0 or not 4 <= again - low < length // 2:
        return float("nan")
    low_at, again_at = (j + (float(peak_offset(*swing[j - 1 : j + 2])) if j else 0.0) for j in (low, again))
    return again_at - low_at


def _period(step: Floats, settings: ForceSettings) -> float:
    """Return the period of steps, in samples; NaN for none."""
    step = step - step.mean()
    longest = step.size // settings.ringing_fewest
    if longest < 4:
        return float("nan")
    size = scipy.fft.next_fast_len(step.size + longest, real=True)
    alike = scipy.fft.irfft(np.abs(scipy.fft.rfft(step, size)) ** 2, size)[:longest]
    alike /= alike[0]
    below = np.flatnonzero(alike < 0)
    if not below.size:
        return float("nan")
    again = below[0] + np.flatnonzero(alike[below[0] :] > 0)
    period = float("nan")
    if not again.size:
        return period
    first = int(again[0] + np.argmax(alike[again[0] : 2 * again[0]]))
    if alike[below[0] : first].min() > -settings.ringing_alike or alike[first] < settings.ringing_alike:
        return period
    # Later maxima tell the period better, as long as they are clear.
    place, count = float(first), 1
    while True:
        k = round(place)
        if k < 2 or k + 1 >= longest or alike[k] < settings.ringing_alike:
            return period
        k += int(np.argmax(alike[k - 1 : k + 2])) - 1
        period = (k + float(peak_offset(*alike[k - 1 : k + 2]))) / count
        count += 1
        place = count * period


def averaged(time_s: Floats, load: Floats, average_s: float) -> Floats:
    """Return the load averaged twice over a time around each sample, or over less of it at the ends: one mean
    over the period of ringing leaves a few per cent of it, two a thousandth. A cubic spline through the
    samples is averaged, so that periods of a few samples cancel as well."""
    start = np.maximum(time_s - average_s / 2, time_s[0])
    stop = np.minimum(time_s + average_s / 2, time_s[-1])
    for _ in range(2):
        sums = scipy.interpolate.CubicSpline(time_s, load).antiderivative()
        load = np.asarray((sums(stop) - sums(start)) / (stop - start), np.float64)
    return load


# --- slow noise ---------------------------------------------------------------------------------------------


def with_slow_noise(signal: Signal, slips: Slips, settings: ForceSettings) -> Signal:
    """Return the signal with `alike`, `wander` and `slow` of noise that is not white.

    It is measured without hum, which averages out along a stick but would hide it.
    """
    start, stop = (at[1:-1] for at in stick_middles(slips.edge, signal.clean.size, settings))
    some = np.flatnonzero(stop - start >= 2 * settings.few_samples)
    white = replace(signal, alike=1.0, wander=0.0, slow=None)
    if some.size < 8:
        return white
    some = some[:: some.size // 400 + 1]  # enough for a median
    start, stop = start[some], stop[some]
    hum = np.sum([line.wave for line in signal.hum], axis=0)
    clean, index = signal.clean - hum, np.arange(signal.clean.size, dtype=float)
    # Samples at uneven times leave a line over their numbers as far as the load rises meanwhile.
    pace, load = fit_lines(index, signal.time, start, stop), fit_lines(signal.time, clean, start, stop)
    row, inside = flat_ranges(start, stop)
    early = pace.mean_y[row] + pace.slope[row] * (inside - pace.mean_x[row]) - signal.time[inside]
    clean[inside] += np.nan_to_num(load.slope)[row] * early
    lines = fit_lines(index, np.where(np.isnan(signal.spikeless), np.nan, clean), start, stop)
    # Where the load rings, all samples of a short stick may be spikes.
    some = np.flatnonzero(np.isfinite(lines.spread))
    if some.size < 8:
        return white
    start, stop, lines = start[some], stop[some], lines.take(some)
    rise = lines.slope * (stop - start)
    rise = np.maximum(rise, 0.1 * np.median(np.abs(rise)) + np.finfo(float).tiny)
    # The curvature of the sticks is no noise: it would hide a filter whose noise is smaller.
    bend = fit_polynomials(clean, start, stop, degree=2)[0][:, 2]
    spread = float(np.median(np.sqrt(np.maximum(lines.spread**2 - bend**2 / 5, 0))))
    # A sample beside lost ones, which are interpolated, counts more than once.
    known = np.flatnonzero(~signal.is_missing)
    more = float(np.mean((known[2:] - known[:-2]) ** 2 / 4) * known.size / signal.time.size)
    white_N = spread * float(np.sqrt(more))
    slow = fit_slow_noise(clean, start, stop, rise, white_N, signal.averaged, settings)
    if slow is None:
        return white
    # Lines are fitted to the load as recorded, in which hum counts as white noise.
    hum_square = rms_of(signal.hum) ** 2
    slow, variance = replace(slow, white=slow.white + hum_square), spread**2 + hum_square
    length = int(np.median(stop - start))
    mean, half_rise = slow.of_line(length)
    alike = max(half_rise * length / (3 * variance), 1.0)
    wander = float(np.sqrt(max(mean - alike * variance / length, 0.0)))
    wander = min(wander, float(np.std(lines.at(stop.astype(float)))))  # noise moves no stick further than all
    return replace(signal, alike=alike, wander=wander, slow=slow)


@dataclass(frozen=True)
class SlowNoise:
    """Noise that is white noise plus slow noise."""

    white: float  # variance of the white part
    f: Floats  # frequencies, per sample
    slow: Floats  # variance of the slow part at each of them

    def of_line(self, length: int) -> tuple[float, float]:
        """Return the variances of the level and of half the rise of a line through so many samples."""
        mean, rise, _ = self._responses(length)
        white = self.white / length
        return white + float(mean**2 @ self.slow), 3 * white + float(rise**2 @ self.slow)

    def of_drop(self, length: float, reach: float) -> float:
        """Return the variance of the difference between two such lines, each extended towards the other.

        They meet at `reach` half lengths from the middle of either.
        """
        mean, rise, phase = self._responses(length)
        drop = 2 * (mean * np.sin(reach * phase) - reach * rise * np.cos(reach * phase))
        return (2 + 6 * reach**2) * self.white / length + float(drop**2 @ self.slow)

    def _responses(self, length: float) -> tuple[Floats, Floats, Floats]:
        """Return how level and half the rise respond to each frequency, and the phase at the line's end."""
        phase = np.pi * self.f * length
        mean = np.sin(phase) / (length * np.sin(np.pi * self.f))
        return mean, 3 * (np.sin(phase) / phase - np.cos(phase)) / phase, phase


def fit_slow_noise(
    y: Floats,
    start: Ints,
    stop: Ints,
    rise_N: Floats,
    white_N: float,
    averaged: float,
    settings: ForceSettings,
) -> SlowNoise | None:
    """Return the noise within the sticks [start, stop) if it is not white; None if it is.

    `rise_N` is how far each stick rises, `white_N` the noise if it is white. Of a load that was averaged
    twice over `averaged` samples, the noise that it had before is returned.

    White noise and one kind of slow noise are fitted to the variance of a contrast at time scales of m = 1,
    2, 4 … samples: of four neighbouring means of m samples the outer two minus the inner two, which is 0 on a
    line. What all sticks have in common there, in proportion to their rises, is their curvature, and is no
    noise; nor is a curvature of each stick's own, where white noise and the m⁴ by which that grows fit best.
    Slow noise has the spectrum of a time constant (autoregressive noise) or a power law between the frequency
    to the power -0.5 and -2 (pink noise, random walk), down to a sixth of the lowest frequency of the
    recording.
    """
    if white_N == 0:  # a load without any noise: calculated or heavily smoothed
        return None
    length = int(np.median(stop - start))
    scales = 2 ** np.arange(int(np.log2(length // 4)) + 1)
    scales = scales[scales >= min(averaged, scales[-2:][0])]  # the averages leave next to no noise below
    total, bend = np.r_[0.0, np.cumsum(y - y.mean())], rise_N / (stop - start) ** 2
    found = [_contrasts(total, start, stop, bend, int(m), length) for m in scales]
    variance = np.array([np.quantile(np.abs(values), _WITHIN) ** 2 for values in found])
    variance = np.maximum(variance, 1e-3 * white_N**2 / scales)  # coarse loads do not change at short scales
    beyond = 1 + settings.alike_sigmas / np.sqrt(found[-1].size)
    if variance[-1] <= beyond * 4 * white_N**2 / scales[-1]:
        return None
    # The variance of the logarithm of such a quantile's square is 3.7 over the number of values.
    weight = np.minimum([values.size for values in found], settings.contrasts * start.size) / 3.7
    f = np.geomspace(1 / (6 * y.size), 0.5, 400)
    sine, width = np.sin(np.pi * f), 2 * np.gradient(f)
    phase = np.pi * f * scales[:, np.newaxis]
    contrast = (8 * np.sin(phase) ** 3 * np.cos(phase) / (scales[:, np.newaxis] * sine)) ** 2
    contrast *= np.sinc(averaged * f) ** 4
    even = contrast @ width if averaged else 4 / scales
    corners = 2 * np.pi * 0.5 ** np.arange(2, np.log2(y.size))
    kinds = [(power, 0.0) for power in np.arange(0.5, 2.01, 0.25)] + [(2.0, corner) for corner in corners]
    root = np.sqrt(weight)[:, np.newaxis]

    def fit(other: Floats) -> tuple[Floats, float]:
        """Return the shares of white noise and of the other part, and the misfit."""
        parts = np.stack([even, other], axis=1) / variance[:, np.newaxis]
        share, _ = scipy.optimize.nnls(parts * root, root[:, 0])
        return share, float(weight @ np.log(np.maximum(parts @ share, 1e-9)) ** 2)

    best, least = None, fit((scales / scales[-1]) ** 4.0)[1] + 4  # in doubt it is slow noise
    for power, corner in kinds:
        density = (4 * sine**2 + corner**2) ** (-power / 2)
        share, misfit = fit(contrast @ (density * width))
        misfit += 0.5 * (corner > 0)
        if misfit < least:
            least = misfit
            best = SlowNoise(float(share[0]), f, share[1] * density * width)
    return best


def _contrasts(total: Floats, start: Ints, stop: Ints, bend: Floats, m: int, length: int) -> Floats:
    """Return the contrasts of means of m samples at up to 64 places along each stick, less their medians.

    `total` holds the sums of the load up to each sample, `bend` what the contrast of a common curvature is
    proportional to.
    """
    places = np.linspace(0, 1, min(length // (4 * m), 64)) if length >= 8 * m else np.array([0.5])
    long = stop - start >= 4 * m
    first, room = start[long, np.newaxis], (stop - start)[long, np.newaxis] - 4 * m
    at = first + np.rint(places * room).astype(np.int64)
    ends = [total[at + k * m] for k in range(5)]
    values = (ends[4] - 2 * ends[3] + 2 * ends[1] - ends[0]) / m
    usual = bend[long, np.newaxis]
    return np.asarray(values - usual * nan_median(values / usual, axis=0), np.float64).ravel()


# --- mains hum: narrow lines of the load's spectrum that are no stick-slip ---------------------------------

_LONGEST_PART = 1 << 14  # samples of one spectrum: finer lines than mains keep to within minutes
_LEAST_SPECTRA = 8
_LEAST_PART = 256
_AROUND = 24  # frequencies on either side of a line that it is compared with
_LEAST_PERIODS = 30  # in one spectrum: below, a line is not told from the slope of the spectrum
_MOST_PERIODS = 6  # of which one amplitude is measured
_MOST_LINES = 4  # mains and three of its harmonics
_TOGETHER = 10  # slips within which hum and slips keep their phase, if they do
_FEWEST = 8  # slips whose phases tell hum from harmonics


class Hum(NamedTuple):
    """One narrow line of a load's spectrum."""

    frequency: float  # per sample
    wave: Floats  # its course, at every sample

    @property
    def rms(self) -> float:
        """Root mean square of the wave."""
        return float(np.std(self.wave))


def rms_of(hum: Sequence[Hum]) -> float:
    """Return the root mean square of all waves together; 0 for none."""
    return float(np.linalg.norm([line.rms for line in hum]))


def find_hum(y: Floats, settings: ForceSettings) -> list[Hum]:
    """Return the narrow lines of a load's spectrum, the strongest first; regular stick-slip also has some.

    The spectra of the load's steps over overlapping parts of the recording are averaged. The largest steps,
    the slips, are cut to the size of the others. A line exceeds the median of the frequencies around it by
    `hum_ratio`. Its amplitude and phase may change within 30 periods.
    """
    part = min(1 << int(np.log2(max(y.size / _LEAST_SPECTRA, 2))), _LONGEST_PART)
    if part < _LEAST_PART:
        return []
    step = np.diff(y)
    step -= np.median(step)
    most = float(np.quantile(np.abs(step), settings.ringing_steps))
    if most:
        step = np.clip(step, -most, most)
    parts = sliding_window_view(step, part)[:: part // 2]
    power, taper = np.zeros(part // 2 + 1), np.hanning(part)
    for values in parts:  # one at a time: all would take as much memory as the recording, several times
        power += np.abs(np.fft.rfft(taper * values)) ** 2
    around = np.median(sliding_window_view(np.pad(power, _AROUND, "reflect"), 2 * _AROUND + 1), axis=1)
    excess = power / np.maximum(around, np.finfo(float).tiny)
    excess[:_LEAST_PERIODS] = excess[-4:] = 0
    found: list[Hum] = []
    while len(found) < _MOST_LINES and excess.max() > settings.hum_ratio:
        k = int(np.argmax(excess))
        frequency = float(k + peak_offset(*np.log(power[k - 1 : k + 2]))) / part
        found.append(Hum(frequency, _wave(y - sum(hum.wave for hum in found), frequency)))
        excess[k - 4 : k + 5] = 0
    return found


def _wave(y: Floats, frequency: float) -> Floats:
    """Return the part of a signal that oscillates at a frequency (per sample).

    Its amplitudes over single periods, or a few that are nearly a whole number of samples, are known; those
    at slips are wrong, and a running median over 30 periods leaves them out.
    """
    samples = np.arange(1, _MOST_PERIODS + 1) / frequency  # in one period, in two …
    off = np.abs(np.rint(samples) / samples - 1)
    together = 1 + int(np.argmax(off <= max(0.02, off.min())))
    size = round(together / frequency)
    turn = np.exp(-2j * np.pi * frequency * np.arange(y.size))
    seen = (y - running_mean(y, size)) * turn
    count = y.size // size
    amplitude = seen[: count * size].reshape(count, size).mean(axis=1)
    several = min(2 * (_LEAST_PERIODS // (2 * together)) + 1, count)
    middle = (np.arange(count) + 0.5) * size - 0.5
    real, imaginary = (
        np.interp(np.arange(y.size), middle, running_median(part, several, ends="symmetric"))
        for part in (amplitude.real, amplitude.imag)
    )
    return np.asarray(2 * np.real((real + 1j * imaginary) * turn.conj()), np.float64)


def is_hum(hum: Hum, y: Floats, slips: Slips, settings: ForceSettings) -> bool:
    """Tell hum from regular stick-slip, whose harmonics are narrow lines too.

    Hum is faster than the slips, which come at any phase of it, and the load within the sticks is straighter
    without it. `slips` are those of the load without the hum; three of its periods must lie between them.
    """
    if slips.edge.size < _FEWEST or slips.period * hum.frequency < 3:
        return False
    turn = np.exp(-2j * np.pi * hum.frequency * slips.edge)
    groups = np.array_split(turn, turn.size // _TOGETHER + 1)
    if np.mean([abs(group.mean()) for group in groups]) > settings.hum_in_phase:
        return False
    x, sticks = np.arange(y.size, dtype=float), stick_middles(slips.edge, y.size, settings)
    with_it, without = (np.nansum(fit_lines(x, load, *sticks).squares) for load in (y, y - hum.wave))
    return bool(with_it - without > 0.5 * hum.rms**2 * np.sum(sticks[1] - sticks[0]))
