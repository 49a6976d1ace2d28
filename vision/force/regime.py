"""Is it stick-slip at all? Recorded extremes of each slip, slow slips, oscillations and unloading."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vision.force.lines import flat_ranges
from vision.force.settings import ForceSettings
from vision.numeric import Bools, Floats, Ints
from vision.signals import running_mean


@dataclass(frozen=True)
class Extremes:
    """Highest load before and lowest load after the middle of each slip, spikes aside.

    Parameters
    ----------
    peak, valley
        Where, in samples.
    high, low
        The load there, averaged over `width` samples.
    highest, lowest
        The single largest and smallest sample.
    width
        Samples averaged for each slip: a 24th of it, so that a half cosine loses next to nothing.
    """

    peak: Floats
    valley: Floats
    high: Floats
    low: Floats
    highest: Floats
    lowest: Floats
    width: Ints

    @property
    def fall(self) -> Floats:
        """Samples from each peak to the valley after it."""
        return self.valley - self.peak

    @property
    def rise(self) -> Floats:
        """Samples from each valley to the next peak; one fewer than slips."""
        return self.peak[1:] - self.valley[:-1]


def find_extremes(y: Floats, middle: Floats, length: Floats) -> Extremes:
    """Recorded extremes around each slip.

    Parameters
    ----------
    y
        Load without spikes.
    middle
        Middle of each slip, in samples.
    length
        Length of each slip, in samples: what the load is averaged over follows it.

    Returns
    -------
    One peak and valley per slip: the peak between the middle of the stick before and that of the slip, the
    valley between that and the middle of the stick after.
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
    """Slips that take a considerable part of the sticks beside them.

    Parameters
    ----------
    fall
        Length of each slip.
    rise
        Length of each stick between two slips, one fewer.
    settings
        ``slow_slip``.
    """
    if not rise.size:
        return np.zeros(fall.shape, dtype=bool)
    beside = np.minimum(np.r_[rise[:1], rise], np.r_[rise, rise[-1:]])
    return np.asarray(fall > settings.slow_slip * np.maximum(beside, 1e-9))


@dataclass(frozen=True)
class Regime:
    """What kind of motion a recording shows.

    Parameters
    ----------
    name
        "stick-slip", "oscillation" (rise and fall equally long, both rounded, a narrow line in the spectrum)
        or "cycles" (rise and fall equally long and both straight).
    fall_over_rise
        Median duration of falls over that of rises.
    line_share
        Share of the load's variance within 20 % of the frequency of the slips.
    """

    name: str
    fall_over_rise: float
    line_share: float


def find_regime(y: Floats, extremes: Extremes, settings: ForceSettings) -> Regime:
    """Stick-slip, or an oscillation, or loading and unloading.

    Parameters
    ----------
    y
        Load without spikes.
    extremes
        As from `find_extremes`.
    settings
        ``equal_share`` and ``line_share``.

    Notes
    -----
    Rises and falls are each fitted by a straight line and by half a cosine. Slow slips of true stick-slip are
    rounded too, but their sticks are straight.
    """
    rise, fall = extremes.rise, extremes.fall[1:]
    known = (rise >= 4) & (fall >= 2)
    if known.sum() < 2:
        return Regime("stick-slip", float("nan"), float("nan"))
    ratio = float(np.median(fall[known] / rise[known]))
    share = _line_share(y, extremes)
    equal = settings.equal_share < ratio < 1 / settings.equal_share
    v, p, next_v = extremes.valley[:-1], extremes.peak[1:], extremes.valley[1:]
    rounded_rise = _roundness(y, v[known], p[known]) > 1
    rounded_fall = _roundness(y, p[known], next_v[known]) > 1
    name = "stick-slip"
    if equal and rounded_rise and share > settings.line_share:
        name = "oscillation"
    elif equal and not rounded_rise and not rounded_fall:
        name = "cycles"
    return Regime(name, ratio, share)


def _roundness(y: Floats, start: Floats, stop: Floats) -> float:
    """Squares that straight lines leave over those that half cosines leave, all stretches together."""
    row, index = flat_ranges(start.astype(np.int64), stop.astype(np.int64) + 1)
    u = (index - start[row]) / (stop - start)[row]
    left = []
    for shape in (u, 0.5 * (1 - np.cos(np.pi * u))):
        count = np.bincount(row).astype(float)
        dx = shape - (np.bincount(row, shape) / count)[row]
        dy = y[index] - (np.bincount(row, y[index]) / count)[row]
        slope = np.bincount(row, dx * dy) / np.maximum(np.bincount(row, dx * dx), 1e-300)
        left.append(float(np.sum((dy - slope[row] * dx) ** 2)))
    return left[0] / max(left[1], 1e-300)


def _line_share(y: Floats, extremes: Extremes) -> float:
    """Share of the variance, from half the slips' frequency on, within 20 % of that frequency."""
    low, high = int(extremes.peak[0]), int(extremes.peak[-1])
    if high - low < 8:
        return float("nan")
    part = y[low:high]
    frequency = np.fft.rfftfreq(part.size)
    power = np.abs(np.fft.rfft((part - part.mean()) * np.hanning(part.size))) ** 2
    usual = 1 / float(np.median(np.diff(extremes.peak)))
    whole = power[frequency > 0.5 * usual].sum()
    return float(power[np.abs(frequency - usual) < 0.2 * usual].sum() / whole) if whole > 0 else float("nan")


def is_unloading(travel: Floats, extremes: Extremes) -> Bools:
    """Falls during which the crosshead goes back by a fifth of what it went forward before, or more.

    Parameters
    ----------
    travel
        Separation at each sample; where it is not known nothing is unloading.
    extremes
        As from `find_extremes`.
    """
    place = np.arange(travel.size)
    at_peak, at_valley = (np.interp(at, place, travel) for at in (extremes.peak, extremes.valley))
    forward = np.abs(at_peak - np.r_[travel[0], at_valley[:-1]])
    return np.asarray((at_peak - at_valley) > np.maximum(0.2 * forward, 1e-12))
