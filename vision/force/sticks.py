"""What is measured on each stick phase: forces, lengths, stiffness and their errors, and its flags."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from vision.data import joined_flags
from vision.force.corners import Corners, Extremes, Shape, find_extremes, is_slow, without_lowpass
from vision.force.lines import Lines, fit_broken_lines, fit_lines, fit_polynomials
from vision.force.settings import ForceSettings
from vision.force.signal import Signal, slope_error_of_steps, step_between
from vision.numeric import Bools, Floats, Ints, mad_sigma, nan_median, quantum

# Samples below which a slip may be sudden, where each sample is the mean since the one before.
UNRESOLVED = 2.5
# Samples from which a slip shows its shape, and the `Corners.tails` of half a cosine.
_SHAPED, _TAILS = 3.5, 1.77
_OUTWARDS = np.array([[-1.0], [1.0]])  # from the middle of a stick to its valley and to its peak


@dataclass(frozen=True, kw_only=True)
class _Sticks:
    """Where each stick begins, its valley, and ends, its peak; what was recorded there, (2, stick)."""

    position: Floats  # in samples
    last_valley: float  # that after the last slip
    slow: Bools  # whether the slip there is slow: `position` is then that of the extreme
    extreme: Floats  # lowest load at the valley and highest at the peak, averaged
    furthest: Floats  # the same of single samples
    width: int  # samples averaged
    knee: Floats  # position of the knee, (stick,); NaN for none
    lag: float  # time constant of the low-pass that is corrected for; 0 for none
    settings: ForceSettings

    @classmethod
    def of(cls, corners: Corners, extremes: Extremes, slow: Bools, settings: ForceSettings) -> _Sticks:
        """Return the sticks between slips, of which some are slow."""
        valley = np.where(slow, extremes.valley, corners.valley)
        peak = np.where(slow, extremes.peak, corners.peak)
        return cls(
            position=np.stack([valley[:-1], peak[1:]]),
            last_valley=valley[-1],
            slow=_beside(slow),
            extreme=np.stack([extremes.low[:-1], extremes.high[1:]]),
            furthest=extremes.furthest,
            width=extremes.width,
            knee=corners.knee[1:-1],
            lag=corners.lowpass,
            settings=settings,
        )

    def central(self, part: float) -> tuple[Ints, Ints]:
        """Return the half-open range of the central part of each stick."""
        valley, peak = self.position
        return _between(*_central(valley, peak, part))

    def sides(self, part: float) -> tuple[tuple[Ints, Ints], tuple[Ints, Ints]]:
        """Return the ranges of the central part before and after the knee, or the middle, clear of it."""
        valley, peak = self.position
        start, stop = _central(valley, peak, part)
        clear = 0.03 * (peak - valley)
        knee = np.where(np.isfinite(self.knee), self.knee, 0.5 * (valley + peak))
        return _between(start, np.fmin(stop, knee - clear)), _between(np.fmax(start, knee + clear), stop)


def _central(valley: Floats, peak: Floats, part: float) -> tuple[Floats, Floats]:
    """Return where the central part of each stick begins and ends, in samples."""
    margin = 0.5 * (1 - part) * (peak - valley)
    return valley + margin, peak - margin


def _between(start: Floats, stop: Floats) -> tuple[Ints, Ints]:
    """Return the half-open range of the samples from start to stop."""
    return np.ceil(start).astype(np.int64), np.floor(stop).astype(np.int64) + 1


def _beside(of_slips: NDArray[Any]) -> NDArray[Any]:
    """Return values of the slips before and after each stick, (2, stick)."""
    return np.stack([of_slips[:-1], of_slips[1:]])


def measure_sticks(
    signal: Signal,
    corners: Corners,
    extremes: Extremes,
    compliance: float,
    settings: ForceSettings,
    lengthened: float,
    filter_known: bool,
) -> pd.DataFrame:
    """Return the columns of `vision.data.STICKS` that are measured on each stick.

    One row per stick, from the valley after slip j to the peak before slip j + 1. `corners` and `extremes`
    are in samples: peak[j] begins slip j, valley[j] ends it. `compliance` is that of the machine, mm/N.
    `lengthened`: the `filter_length` of these corners.
    `filter_known`: the low-pass of the load is known, so that longer slips are not due to another filter.
    """
    slow = is_slow(corners, settings)
    sticks = _Sticks.of(corners, extremes, slow & (corners.lowpass == 0), settings)
    samples, time = sticks.position[1] - sticks.position[0], signal.time_at(sticks.position)
    ends = _ends(signal, sticks, time, corners.shape)
    force = _forces(signal, corners, sticks, ends)
    d, d_next, noise_mm = _separations(signal, sticks, force, compliance)
    (f_v, f_p), (t_v, t_p), (d_v, d_p) = force, time, d
    t_next = np.append(t_v[1:], signal.time_at(np.array(sticks.last_valley)))
    off, half = (_beside(part) for part in _position_errors(signal, corners, lengthened, filter_known))
    error = _corner_errors(signal, sticks, ends, force, off)
    lost = ends.rise * np.where(sticks.slow, np.fmin(half, lengthened / 2), half)
    # The extreme of a slow slip lies up to half a sample from one, on the stick or on half a cosine. The root
    # mean square of what the sample misses is a fifth of the rise, and of the drop over the slip's square.
    missed = np.hypot(ends.rise, (f_p - f_v) / np.fmax(_beside(corners.length), 1.0) ** 2) / 5
    lost = np.where(sticks.slow, np.hypot(lost, missed), lost)
    apart = np.hypot(np.hypot(*np.hypot(off, _rounded(sticks, ends, force, extremes))), half.sum(axis=0))
    sample_um = 1e3 * (d_p - d_v) / np.where(samples == 0, np.nan, samples)
    length_error = np.hypot(sample_um * apart, 1e3 * np.sqrt(2) * noise_mm)
    # The load may have relaxed in a rest, so that slow slips count with all their length.
    rest_error = np.hypot(length_error, sample_um * _beside(corners.length / 2).sum(axis=0))
    table = pd.DataFrame(
        {
            "event": np.arange(samples.size),
            "t_v_s": t_v,
            "t_p_s": t_p,
            "d_v_mm": d_v,
            "d_p_mm": d_p,
            "F_v_N": f_v,
            "F_p_N": f_p,
            "dF_N": f_p - f_v,
            "stick_length_um": 1e3 * (d_p - d_v),
            "slip_length_um": 1e3 * (d_next - d_p),
            **_stiffness(signal, sticks, corners.two_slopes, compliance),
            "F_v_raw_N": sticks.furthest[0],
            "F_p_raw_N": sticks.furthest[1],
            **dict(zip(("F_v_err_N", "F_p_err_N"), np.hypot(np.hypot(ends.error, error), lost), strict=True)),
            "dF_err_N": np.hypot(np.hypot(ends.error_rise, np.hypot(*error)), lost.sum(axis=0)),
            "stick_length_err_um": length_error,
            "K_lowpass_share": 0.0,
            "slip_time_s": t_next - t_p,
            "samples": samples.astype(int),
        }
    )
    if lengthened:
        # What a filter leaves of the slips bends the sticks from their ends on, so that their middles differ
        # from K by about as much as K from that of the sample.
        middle = nan_median((table["K30_N_per_mm"] / table["K_N_per_mm"]).to_numpy(float))
        table["K_err_N_per_mm"] += abs(np.nan_to_num(middle, nan=1.0) - 1) * table["K_N_per_mm"].abs()
    marks = {
        "few": samples < settings.few_samples,
        "falling": ~(ends.slope > 0) | _contain_falls(signal, sticks, f_p - f_v),
        "slow": slow[:-1] | slow[1:],
        "still": _held(1e3 * (d_next - d_v), rest_error, t_next - t_v, settings),
    }
    return table.assign(flag=joined_flags(_damaged(signal, corners, sticks) | marks))


def _damaged(signal: Signal, corners: Corners, sticks: _Sticks) -> dict[str, Bools]:
    """Return for each kind of bad samples in which sticks there are any.

    Both neighbouring slips count: bad samples in them hide how high or low the load was.
    """
    (valley, peak), last = sticks.position, signal.time.size - 1
    begin, end = np.floor(np.fmin(corners.peak[:-1], valley)), np.ceil(np.fmax(corners.valley[1:], peak))
    first, final = (np.clip(at, 0, last).astype(int) for at in (begin, end))
    return {kind: count[final] > count[first] for kind, count in signal.damage.items()}


def _held(way: Floats, error: Floats, duration: Floats, settings: ForceSettings) -> Bools:
    """Return in or before which sticks the machine paused, or the displacement had ended: from one valley to
    the next it moves clearly more slowly than in the two sticks before and the two after. The load relaxes in
    a rest, which looks like a slip."""
    duration = np.where(duration > 0, duration, np.nan)  # swings at the same place
    speed = way / duration
    around = pd.Series(speed).rolling(5, center=True, min_periods=1).median().to_numpy()
    typical = nan_median(speed)
    usual = np.where(np.abs(around) < 0.01 * typical, typical, around)  # those around may have ended as well
    paused = (way + 3 * error) / duration < settings.least_speed * usual
    return np.asarray(paused | np.r_[paused[1:], False], np.bool_)


def _contain_falls(signal: Signal, sticks: _Sticks, rise: Floats) -> Bools:
    """Return in which sticks the load falls by `falling_share` of their `rise`, clear of the noise.

    They contain a slip that was not found, such as one that lasts longer than they do.
    """
    settings = sticks.settings
    (mean,), samples = _part_means(*sticks.central(settings.line_part), settings, signal.clean)
    fall = np.fmax.reduce(np.fmax.accumulate(mean) - mean)
    noise = signal.noise_at(sticks.position[0]) * np.sqrt(2 * signal.alike / np.maximum(samples.min(0), 1))
    return np.asarray(fall > np.fmax(settings.falling_share * rise, settings.spike_sigmas * noise), np.bool_)


def _part_means(
    start: Ints, stop: Ints, settings: ForceSettings, *values: Floats
) -> tuple[list[Floats], Ints]:
    """Return the means of each of these values over `uneven_parts` of each stick, (part, stick), and the
    samples of each part."""
    parts = settings.uneven_parts
    edge = start + np.arange(parts + 1)[:, np.newaxis] * (stop - start) // parts
    samples, means = np.diff(edge, axis=0), []
    for each in values:
        total = np.r_[0.0, np.cumsum(each - each.mean())]
        with np.errstate(divide="ignore", invalid="ignore"):
            means.append(np.diff(total[edge], axis=0) / samples + each.mean())
    return means, samples


def _position_errors(
    signal: Signal, corners: Corners, lengthened: float, filter_known: bool
) -> tuple[Floats, Floats]:
    """Return the standard error of the position of each corner, and how far lengthening may have moved both
    corners of a slip apart; in samples.

    A slip may be as long as it appears, or lengthened: up to 2.5 samples where each is the mean since the one
    before, by `lengthened` samples by a filter of the machine, further where the noise of neighbouring
    samples is common. Either corner is then off by half of it, and the two of a stick by all of it.
    """
    # Corners lie between two samples; of lost ones the next known samples are further apart.
    known = np.flatnonzero(~signal.is_missing)
    after = np.clip(np.searchsorted(known, corners.middle), 1, known.size - 1)
    apart = known[after] - known[after - 1]
    length = corners.length
    wholly = signal.alike > 1
    longer = wholly | (length < UNRESOLVED) | (not filter_known)
    resolved = not (wholly or lengthened) and np.quantile(length, 0.1) >= UNRESOLVED
    before = np.sqrt(np.maximum(length**2 - UNRESOLVED**2, 0)) if resolved else 0.0
    return corners.error * apart, np.where(longer, (length - before) / 2, 0)


def _rounded(sticks: _Sticks, ends: _Ends, force: Floats, extremes: Extremes) -> Floats:
    """Return by how many samples rounding may move valley and peak, (2, stick), from the slips' corners.

    The load of a block that creeps before it slips is highest earlier, below the stick line. The extreme
    that was recorded shows how far, but for noise; no further than the line rises by what was cut off.
    """
    away = np.abs(np.stack([extremes.valley[:-1], extremes.peak[1:]]) - sticks.position)
    with np.errstate(divide="ignore", invalid="ignore"):
        cut_off = np.abs(force - ends.force) / ends.rise
    return np.where(sticks.slow | (sticks.lag > 0), 0.0, np.fmin(away, np.nan_to_num(cut_off)))


def filter_length(signal: Signal, corners: Corners, settings: ForceSettings) -> float:
    """Return by how many samples a filter of the machine may have lengthened every slip; 0 for none.

    A filter lengthens all slips alike, so by no more than the shortest last; and not at all where they have
    the shape of a moving block's, half a cosine, and the noise is faster than they are. A filter with a tail
    takes longer after the middle than before it. Tails are longer than those of a straight fall, as a moving
    mean makes it of a sudden slip, and shorter than those of several means; either half may differ, where
    friction changes gradually, but a filter makes both differ. A smoothed recording has noise as smooth as
    its slips. Where they are not slow, the noise must be white, and the load must not swing below the stick
    after them, as behind a sharp filter or in a load cell that rings.
    """
    length = float(np.quantile(corners.length, 0.1))
    slow = bool(is_slow(corners, settings).all())
    with np.errstate(divide="ignore", invalid="ignore"):
        level = bool(nan_median(corners.onset / corners.end) >= 1 - settings.level_share)
    if length >= _SHAPED:
        low, high = corners.tails.min() / _TAILS, corners.tails.max() / _TAILS
        level &= bool(high > 1 - settings.tails_share and low < 1 + settings.tails_share)
    most = settings.smooth_noise if slow else settings.white_noise
    level = level and _noise_correlation(signal, corners, 0.05 * length, settings) < most
    if level and not slow:
        position = np.stack([corners.valley[:-1], corners.peak[1:]])
        central = _between(*_central(position[0], position[1], settings.line_part))
        line = fit_lines(np.arange(float(signal.clean.size)), signal.clean, *central)
        rise = np.maximum(line.slope * (position[1] - position[0]), 0.0)
        level = _begin(signal, position, line.at(position) + corners.shape.ends * rise, settings) == 0
    return 0.0 if level or length < UNRESOLVED else length


def _noise_correlation(signal: Signal, corners: Corners, apart: float, settings: ForceSettings) -> float:
    """Return the correlation of the noise within the sticks over so many samples; NaN in short sticks.
    Rounding to the last digit is white, whatever a filter did before, and not counted."""
    lag = max(round(apart), 1)
    start, stop = _between(*_central(corners.valley[:-1], corners.peak[1:], settings.line_part))
    long = stop - start >= max(10, 4 * lag)  # a polynomial is fitted to each
    if not long.any():
        return float("nan")
    _, noise, row = fit_polynomials(signal.clean, start[long], stop[long])
    product = np.where(row[lag:] == row[:-lag], noise[lag:] * noise[:-lag], 0.0)
    common = np.bincount(row[lag:], product, minlength=int(long.sum()))
    squares, length = np.bincount(row, noise**2), (stop - start)[long]
    rounding = quantum(signal.load[~signal.is_missing][:20_000]) ** 2 / 12
    other = 1 - rounding / max(float(np.median(squares / length)), np.finfo(float).tiny)
    with np.errstate(divide="ignore", invalid="ignore"):
        # The five terms of the polynomial take as much from the correlation of white noise.
        found = float(nan_median(common / squares) + 5 / np.median(length))
    return found / other if other > 1 - settings.rounding_share else math.nan


def _corner_errors(signal: Signal, sticks: _Sticks, ends: _Ends, force: Floats, off: Floats) -> Floats:
    """Return the errors of F_v and F_p (`force`) from those of the corners, `off` samples, (2, stick).

    At the extreme of a slow slip the load is level, so that an error of its position causes none; but it is
    the largest of several means, errs by the noise of one, and half of its samples lie on the rising stick.
    What was recorded beyond the line, noise aside, is part of the error (ringing, a filter that overshoots, a
    sharp bend, a coarse load), and so is how far the force was moved from the line.
    """
    line = np.where(sticks.slow, force, ends.force)
    noise = sticks.settings.extreme_sigmas * signal.noise_at(sticks.position)
    beyond = np.fmax(_OUTWARDS * (sticks.furthest - line) - noise, np.abs(force - line))
    at_extreme = np.hypot(signal.sigma / np.sqrt(sticks.width), ends.rise * sticks.width / 8)
    return np.hypot(np.where(sticks.slow, at_extreme, ends.rise * off), beyond)


def _separations(
    signal: Signal, sticks: _Sticks, force: Floats, compliance: float
) -> tuple[Floats, Floats, Floats]:
    """Return d at the ends of each stick, (2, stick), at its next valley, and the error of one sample of it.

    The error contains the noise and the steps of d.
    """
    last = sticks.last_valley
    pace = fit_lines(signal.time, signal.travel, *_between(*sticks.position))
    # The machine's stretch is subtracted at the corners only: at every sample it would add the load's noise.
    d = _travel_at(signal, sticks, pace) - compliance * force
    d_last = (
        np.interp(last, np.arange(signal.time.size), signal.travel) - compliance * signal.clean[int(last)]
    )
    # d may stand still within a stick that is as long as a step of its digits.
    step = step_between(signal.travel) / np.sqrt(12)
    return d, np.r_[d[0, 1:], d_last], np.fmax(np.nan_to_num(pace.spread), step)


def _travel_at(signal: Signal, sticks: _Sticks, pace: Lines) -> Floats:
    """Return the recorded d at the ends of each stick, (2, stick).

    A displacement of the sample jumps during the slip. Where it does, it is read from the sample within the
    stick next to the corner.
    """
    index = np.arange(signal.time.size)
    near = np.interp(sticks.position, index, signal.travel)
    first = np.rint(np.clip(sticks.position - _OUTWARDS, 0, index[-1])).astype(np.int64)
    within = signal.travel[first] + pace.slope * (signal.time_at(sticks.position) - signal.time[first])
    usual = np.fmax(4 * pace.spread, np.abs(pace.slope) * signal.interval_s)
    return np.where(np.abs(near - within) > usual, within, near)


def _forces(signal: Signal, corners: Corners, sticks: _Sticks, ends: _Ends) -> Floats:
    """Return F_v and F_p, (2, stick): the ends of the stick lines, limited to what was recorded.

    Beside slow slips they are the recorded extremes. Of a load that is corrected for a low-pass, only those
    of sticks with a knee are limited.
    """
    if not sticks.lag:
        return np.where(sticks.slow, sticks.extreme, _within_recorded(signal, sticks, ends))
    load, gain = without_lowpass(signal.clean, sticks.lag)
    noise = signal.noise * float(np.sqrt(1 + 2 * gain * (1 + gain)))
    extremes = find_extremes(load, signal.sigma, corners.middle, corners.length, corners.drop)
    limited = _within_recorded(
        replace(signal, clean=load, noise=noise), replace(sticks, furthest=extremes.furthest), ends
    )
    return np.where(np.isfinite(sticks.knee), limited, ends.force)


def _within_recorded(signal: Signal, sticks: _Sticks, ends: _Ends) -> Floats:
    """Return F_v and F_p of the stick lines, (2, stick), limited to what was recorded there.

    A stick ends between two samples, so either force may exceed the recorded one by the rise from sample to
    sample there; at valleys by a small share of the drop, too, since the load cell is late. Lines cut the
    corners of sticks that begin steeply, or end with a small slip before the large one: the recorded peak
    and, unless the load rings, valley hold, except for the noise of single samples; a begin that is steep in
    most sticks holds in all.
    """
    (lowest, highest), settings = sticks.furthest, sticks.settings
    margin = ends.rise.copy()
    margin[0] += settings.between_samples * np.maximum(highest - lowest, 0)
    limit = np.array([[-signal.clean.min()], [signal.clean.max()]])
    f_v, f_p = _OUTWARDS * np.fmin(
        _OUTWARDS * ends.force, np.minimum(_OUTWARDS * sticks.furthest + margin, limit)
    )
    noise_v, noise_p = settings.extreme_sigmas * signal.noise_at(sticks.position)
    begin = _begin(signal, sticks.position, ends.force, settings)
    if begin is not None:
        f_v = np.fmin(f_v, lowest + noise_v)
    if begin:
        f_v = np.fmin(f_v, ends.force[0] + begin * (ends.force[1] - ends.force[0]))
    top = _top(signal, sticks.position, ends.force, settings)
    f_p = np.fmin(f_p, ends.force[1] + top * (ends.force[1] - ends.force[0]) + ends.rise[1])
    return np.stack([f_v, np.fmax(f_p, highest - noise_p)])


def _begin(signal: Signal, position: Floats, force: Floats, settings: ForceSettings) -> float | None:
    """Return how far the sticks begin below their lines, over the drop, at most 0; None if the load rings.

    The lines go from valley to peak, at `position` and `force`, (2, stick). Both show in the median over all
    sticks of the load minus the line since the valley. Where the load oscillates about the lines after the
    slips, its maximum in the first quarter of the sticks exceeds its level in the second by `ringing_share`
    of the first swing or more.
    """
    some, quarter = _to_compare(position)
    if not some.size:
        return 0.0
    valley, length = (part[some, np.newaxis] for part in (position[0], position[1] - position[0]))
    index = np.minimum(np.ceil(valley) + np.arange(2 * quarter), signal.clean.size - 1).astype(np.int64)
    low, high = force[:, some, np.newaxis]
    off = (signal.clean[index] - low) / np.maximum(high - low, 1e-300) - (index - valley) / length
    course = np.median(off, axis=0)
    level = np.median(course[quarter:])
    swing = int(np.argmin(course[:quarter]))
    begin = min(float(course[swing]) + _chance(off[:, swing], settings), 0.0)
    again = np.max(course[swing:quarter]) - level
    return None if begin and again > settings.ringing_share * (level - course[swing]) else begin


def _top(signal: Signal, position: Floats, force: Floats, settings: ForceSettings) -> float:
    """Return how far the median load of all sticks stays below the ends of their lines, over the drop.

    At most 0. The load of a block that creeps before it slips does, by less than the noise of one stick.
    """
    some, quarter = _to_compare(position)
    if not some.size or signal.averaged:  # an average rounds the peaks, too
        return 0.0
    low, high = force[:, some, np.newaxis]
    index = np.floor(position[1][some, np.newaxis]).astype(np.int64) - np.arange(quarter)
    below = (signal.clean[np.maximum(index, 0)] - high) / np.maximum(high - low, 1e-300)
    course = np.median(below, axis=0)
    best = int(np.argmax(course))
    return min(float(course[best]) + _chance(below[:, best], settings), 0.0)


def _to_compare(position: Floats) -> tuple[Ints, int]:
    """Return the sticks of half the usual length or more, and the samples in a quarter of the usual one.

    No sticks if they are too few, or too short, to show what all have in common. position: (2, stick).
    """
    length = position[1] - position[0]
    quarter = int(np.median(length) / 4)
    some = np.flatnonzero(length >= 2 * quarter)
    return (some if quarter >= 4 and some.size >= 4 else some[:0]), quarter


def _chance(values: Floats, settings: ForceSettings) -> float:
    """Return by how much noise may lower the median of some sticks."""
    return settings.extreme_sigmas * float(mad_sigma(values)) / float(np.sqrt(values.size))


@dataclass(frozen=True)
class _Ends:
    """Both ends of each stick line, (2, stick), and its rise, (stick,)."""

    force: Floats  # N
    error: Floats  # of the line alone, without that of the corner's position
    rise: Floats  # from sample to sample, N
    slope: Floats  # N/s
    error_rise: Floats  # of the difference of the two ends, whose errors are opposite


def _ends(signal: Signal, sticks: _Sticks, time: Floats, shape: Shape) -> _Ends:
    """Extend the stick lines to the corners, with the common curvature or the line on that side of a knee."""
    central = sticks.central(sticks.settings.line_part)
    line = fit_lines(signal.time, signal.spikeless, *central, lag=sticks.lag)
    bent, duration = np.isfinite(sticks.knee), time[1] - time[0]
    rise = np.maximum(line.slope * duration, 0.0)
    force, lever = line.at(time) + shape.ends * rise, line.lever(time)
    apart = duration / np.sqrt(line.sxx)
    if bent.any():
        # Either end is that of a line through the samples on its side of the knee alone.
        ranges = sticks.sides(sticks.settings.line_part)
        sides = [fit_lines(signal.time, signal.spikeless, *side, lag=sticks.lag) for side in ranges]
        bent = bent & np.isfinite(sides[0].spread + sides[1].spread)
        force = np.where(bent, [side.at(at) for side, at in zip(sides, time, strict=True)], force)
        lever = np.where(bent, [side.lever(at) for side, at in zip(sides, time, strict=True)], lever)
        apart = np.where(bent, np.hypot(*lever), apart)
    # The common curvature is in the residuals of the lines, but is no noise.
    straight = np.sqrt(np.maximum(line.spread**2 - (shape.spread * rise) ** 2, 0))
    noise = np.sqrt(signal.alike) * np.fmax(straight, np.fmin(line.spread, signal.sigma))
    if not sticks.lag:
        noise = noise * np.where(bent, 1.0, _unevenness(signal, line, *central, noise, sticks.settings))
    return _Ends(
        force,
        error=np.hypot(np.hypot(noise * lever, np.where(bent, 0.0, shape.errors * rise)), signal.wander),
        rise=np.abs(line.slope) * signal.interval_at(sticks.position),
        slope=line.slope,
        error_rise=np.hypot(noise * apart, np.where(bent, 0.0, shape.difference_error * rise)),
    )


def _unevenness(
    signal: Signal, line: Lines, start: Ints, stop: Ints, noise: Floats, settings: ForceSettings
) -> Floats:
    """Return how many times more each stick leaves its line for a while than `noise` explains, at least 1, as
    with small slips within it and the steps of a coarse load. What the means over its parts have in common in
    all sticks, in proportion to their rises, is their curvature."""
    (load, time), samples = _part_means(start, stop, settings, signal.clean, signal.time)
    off = load - line.at(time)
    rise = line.slope * (signal.time[stop - 1] - signal.time[start])
    with np.errstate(divide="ignore", invalid="ignore"):
        off = off - rise * nan_median(off / rise, axis=1)[:, np.newaxis]
        size = np.sqrt(np.sum(off**2 * samples, axis=0) / (settings.uneven_parts - 2)) / noise
    return np.where((size > settings.uneven_excess) & (noise > 0), size, 1.0)


def _stiffness(signal: Signal, sticks: _Sticks, two_slopes: bool, compliance: float) -> dict[str, Floats]:
    """Return the columns of K: slopes of load against d, corrected for the machine's compliance in series."""

    def of_sample(slope: Floats) -> Floats:
        with np.errstate(divide="ignore"):
            return np.where(slope * compliance < 1, slope / (1 - slope * compliance), np.nan)

    time, travel, load, wider = signal.time, signal.travel, signal.spikeless, np.sqrt(signal.alike)
    settings, step = sticks.settings, step_between(travel)

    def with_error(start: Ints, stop: Ints) -> tuple[Floats, Floats]:
        """Return K and its error, from slopes against time, since noise of d would lower slopes against d."""
        rise = fit_lines(time, load, start, stop, lag=sticks.lag)
        pace = fit_lines(time, travel, start, stop, lag=sticks.lag)
        speed = pace.slope
        # But for rounding; a load in coarse steps may not change, either.
        stands = np.abs(speed) < 1e-9 * np.abs(nan_median(speed))
        stands |= np.abs(rise.slope) < 1e-9 * np.abs(nan_median(rise.slope))
        with np.errstate(divide="ignore", invalid="ignore"):
            slope = np.where(stands | (speed == 0), np.nan, rise.slope / speed)
            uneven = (
                1.0 if sticks.lag else _unevenness(signal, rise, start, stop, wider * rise.spread, settings)
            )
            # A coarse d may rise by a step more or less than it should, as the sticks around it tell.
            usual = pd.Series(np.abs(speed)).rolling(5, center=True, min_periods=1).median().to_numpy()
            way = usual * (time[np.minimum(stop, time.size) - 1] - time[np.minimum(start, time.size - 1)])
            of_pace = np.fmax(pace.slope_error / np.abs(speed), slope_error_of_steps(step, way))
            error = np.hypot(wider * uneven * rise.slope_error / np.abs(speed), slope * of_pace)
            return of_sample(slope), error * (of_sample(slope) / slope) ** 2

    part = settings.central_part
    (k, error), (narrow, _), (wide, _) = (with_error(*sticks.central(share)) for share in (part, 0.3, 0.7))
    columns = {"K_N_per_mm": k, "K_err_N_per_mm": error}
    columns |= {"K30_N_per_mm": narrow, "K70_N_per_mm": wide}
    names = ("K1_N_per_mm", "K2_N_per_mm", "K2_err_N_per_mm", "knee", "knee_gain")
    if not two_slopes or not np.isfinite(travel).any():
        return columns | dict.fromkeys(names, np.full(k.size, np.nan))
    broken = fit_broken_lines(travel, load, *sticks.central(settings.line_part), lag=sticks.lag)
    early = sticks.knee - sticks.position[0] < 0.65 * (sticks.position[1] - sticks.position[0])
    after, after_error = with_error(
        *(np.where(early, *ends[::-1]) for ends in zip(*sticks.sides(part), strict=True))
    )
    bent = np.isfinite(sticks.knee)
    second = np.where(bent, after, of_sample(broken.second)), np.where(bent, after_error, error)
    return columns | dict(
        zip(names, (of_sample(broken.first), *second, broken.knee, broken.gain), strict=True)
    )
