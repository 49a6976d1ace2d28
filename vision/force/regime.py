"""What a recording shows: stick-slip, an oscillation, cycles of loading and unloading, or noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vision.force.corners import Extremes
from vision.force.lines import flat_ranges
from vision.force.settings import ForceSettings
from vision.force.slips import Slips, upward_share
from vision.numeric import Bools, Floats


@dataclass(frozen=True)
class Regime:
    """What kind of motion a recording shows."""

    # "stick-slip"; "oscillation": rises and falls are equally long and rounded, and have one frequency;
    # "cycles": they are equally long and straight; "noise": the load jumps upward about as far as it drops
    name: str
    fall_over_rise: float  # median duration of falls over that of rises
    line_share: float  # share of the load's variance within 20 % of the frequency of the slips
    upward_share: float  # median of the largest upward jumps within sticks over the median drop


def find_regime(y: Floats, slips: Slips, extremes: Extremes, settings: ForceSettings) -> Regime:
    """Return whether a load shows stick-slip, an oscillation, cycles of loading and unloading, or noise.

    A line and half a cosine are fitted to each rise and fall of the load, and show which of them are straight
    or rounded. Slow slips of stick-slip are rounded as those of an oscillation, but the sticks are straight.
    """
    rise, fall = extremes.rise, extremes.fall[1:]
    known = (rise >= 4) & (fall >= 2)
    upward = upward_share(y, slips.edge, settings)
    name = "noise" if upward > settings.upward_share else "stick-slip"
    if known.sum() < 2:
        return Regime(name, float("nan"), float("nan"), upward)
    ratio = float(np.median(fall[known] / rise[known]))
    share = _line_share(y, extremes)
    equal = settings.equal_share < ratio < 1 / settings.equal_share
    v, p, next_v = extremes.valley[:-1], extremes.peak[1:], extremes.valley[1:]
    rounded_rise = _roundness(y, v[known], p[known]) > 1
    rounded_fall = _roundness(y, p[known], next_v[known]) > 1
    if equal and rounded_rise and share > settings.line_share:
        name = "oscillation"
    elif equal and not rounded_rise and not rounded_fall:
        name = "cycles"
    return Regime(name, ratio, share, upward)


def _roundness(y: Floats, start: Floats, stop: Floats) -> float:
    """Return the median ratio of the squared residuals of a line to those of half a cosine."""
    row, index = flat_ranges(start.astype(np.int64), stop.astype(np.int64) + 1)
    u = (index - start[row]) / (stop - start)[row]
    residual = []
    for shape in (u, 0.5 * (1 - np.cos(np.pi * u))):
        count = np.bincount(row).astype(float)
        dx = shape - (np.bincount(row, shape) / count)[row]
        dy = y[index] - (np.bincount(row, y[index]) / count)[row]
        slope = np.bincount(row, dx * dy) / np.maximum(np.bincount(row, dx * dx), 1e-300)
        residual.append(np.bincount(row, (dy - slope[row] * dx) ** 2))
    return float(np.median(residual[0] / np.maximum(residual[1], 1e-300)))


def _line_share(y: Floats, extremes: Extremes) -> float:
    """Return the share of the load's variance within 20 % of the frequency of the slips.

    The variance is that of all frequencies above half of the slips'.
    """
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
    """Return whether the crosshead goes back during each fall, by more than a fifth of its last advance.

    travel: separation at each sample; where it is NaN, no fall counts as unloading.
    """
    index = np.arange(travel.size)
    at_peak, at_valley = (np.interp(at, index, travel) for at in (extremes.peak, extremes.valley))
    forward = np.abs(at_peak - np.r_[travel[0], at_valley[:-1]])
    return np.asarray((at_peak - at_valley) > np.maximum(0.2 * forward, 1e-12))
