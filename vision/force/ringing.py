"""Ringing of the load after slips: its period, and the load averaged over it."""

from __future__ import annotations

import numpy as np
import scipy

from vision.force.settings import ForceSettings
from vision.numeric import Floats, peak_offset, quantum


def ringing_period(load: Floats, settings: ForceSettings) -> float:
    """Return the period of an oscillation that follows the slips, in samples; NaN for none.

    The autocorrelation of the load's steps falls below minus `ringing_alike` and then rises above it. Slips,
    which are the largest steps, are cut to the size of the others: three times as many where that shows no
    period, as slips may be slow. A load that oscillates throughout also has such a period. The steps of a
    coarse load, by one quantum at regular times, are no oscillation.
    """
    step = np.diff(load)
    step -= np.median(step)
    size = np.abs(step)
    for cut in (1 - settings.ringing_steps, 3 * (1 - settings.ringing_steps)):
        most = float(np.quantile(size, 1 - cut))
        period = _period(np.clip(step, -most, most), settings) if most else float("nan")
        if np.isfinite(period):
            return period if most > 1.5 * quantum(load) else float("nan")
    return float("nan")


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
    """Return the load averaged twice over a time around each sample, or over less of it at the ends.

    One mean over the period of ringing that decays leaves a few per cent of it, two leave a thousandth. A
    cubic spline through the samples is averaged, so that periods of a few samples cancel as well.
    """
    start = np.maximum(time_s - average_s / 2, time_s[0])
    stop = np.minimum(time_s + average_s / 2, time_s[-1])
    for _ in range(2):
        sums = scipy.interpolate.CubicSpline(time_s, load).antiderivative()
        load = np.asarray((sums(stop) - sums(start)) / (stop - start), np.float64)
    return load
