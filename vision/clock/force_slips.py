"""Slips as the load cell sees them: when the load drops, corrected for the delay of its low-pass."""

from __future__ import annotations

import numpy as np
import pandas as pd
import xarray as xr

from vision.clock.settings import ClockSettings
from vision.data import StickMetadata
from vision.force.lines import flat_ranges
from vision.force.recording import good_samples
from vision.numeric import Floats, Ints

_LONGEST_DROP = 100  # samples after its steepest part; keeps memory small at high sampling rates


def force_slips(
    force: xr.Dataset, sticks: pd.DataFrame, *, settings: ClockSettings = ClockSettings()
) -> pd.DataFrame:
    r"""Middle of every slip, in order, the one that ends the initial loading first.

    Parameters
    ----------
    force
        From `read_force`.
    sticks
        From `find_stick_slip`.
    settings
        See `ClockSettings`.

    Returns
    -------
    A table, empty where `sticks` is, with the columns

    - time_s: on the force clock;
    - error_s: standard error of each by itself;
    - drop_N: how far the force fell, the mean of the slip's own drop and of the rises before and after it, as
      the sheets may follow either; NaN for the first and last slip, which are known from one side only.

    ``attrs``: delay_s, which was subtracted, and lag_s, by what all times together may be wrong.

    Notes
    -----
    The steepest drop finds a slip; the mean time of its drop, sample by sample, places it to a part of a
    sampling interval. The load cell's low-pass delays that mean by its time constant :math:`\tau` and makes
    the drop asymmetric: the impulse response :math:`e^{-t/\tau}/\tau` has a third central moment of
    :math:`2\tau^3`, while a slip itself, symmetric, has none. So the mean third moment of all slips gives the
    delay.
    """
    good = good_samples(force)
    time, load = good["time_s"].to_numpy().astype(float), good["load_N"].to_numpy().astype(float)
    begin, end, drop = _bounds(sticks)
    if not len(begin) or len(time) < 3:
        return pd.DataFrame({"time_s": np.empty(0), "error_s": np.empty(0), "drop_N": np.empty(0)})
    interval = float(np.median(np.diff(time)))
    steepest, of = np.unique(_steepest(time, load, begin, end), return_index=True)
    middle, delay, duration = _mean_times(time, load, steepest, settings)
    order = np.argsort(middle)
    error = np.full(len(order), 0.5 * interval / np.sqrt(12))
    table = pd.DataFrame({"time_s": (middle - delay)[order], "error_s": error, "drop_N": drop[of][order]})
    # What remains of the delay, of the sampling, and of the shape of a drop.
    lag = np.multiply((0.25, 0.12, 0.02), (delay, interval, duration))
    table.attrs |= {"delay_s": delay, "lag_s": float(np.sqrt(lag @ lag))}
    return table


def _bounds(sticks: pd.DataFrame) -> tuple[Floats, Floats, Floats]:
    """Begin, end and drop of each slip; the last one ends, as the table does not say, as the others do."""
    if not len(sticks):
        return np.empty(0), np.empty(0), np.empty(0)
    valley, peak = sticks["t_v_s"].to_numpy(float), sticks["t_p_s"].to_numpy(float)
    first = StickMetadata.of(sticks).first_slip_s
    usual = float(np.median(valley[1:] - peak[:-1])) if len(peak) > 1 else 0.0
    begin, end = np.r_[first, peak], np.r_[valley, peak[-1] + max(usual, 0.0)]
    known = np.isfinite(begin) & np.isfinite(end)
    return begin[known], end[known], _drop_N(sticks)[known]


def _drop_N(sticks: pd.DataFrame) -> Floats:
    """How far the force fell in each slip; NaN for the first and the last, known from one side only."""
    peak, valley = (np.asarray(sticks[name], np.float64) for name in ("F_p_N", "F_v_N"))
    rise, fall = peak - valley, peak[:-1] - valley[1:]
    return np.asarray(np.r_[np.nan, 0.5 * fall + 0.25 * (rise[:-1] + rise[1:]), np.nan])


def _steepest(time: Floats, load: Floats, begin: Floats, end: Floats) -> Ints:
    """The sample before the steepest drop of each slip, looked for three samples beyond its ends."""
    around = 3
    start = np.clip(np.searchsorted(time, begin) - around, 0, len(time) - 2)
    stop = np.clip(np.searchsorted(time, end) + around, start + 1, len(time) - 1)
    row, index = flat_ranges(start, stop)
    order = np.lexsort((load[index] - load[index + 1], row))
    return np.asarray(index[order[np.flatnonzero(np.diff(np.r_[row[order], -1]) != 0)]])


def _mean_times(
    time: Floats, load: Floats, steepest: Ints, settings: ClockSettings
) -> tuple[Floats, float, float]:
    """(mean time of each drop, delay of the low-pass, time from 1 % to 1 % of the steepest drop), s."""
    spacing = float(np.median(np.diff(steepest))) if len(steepest) > 1 else 0.0
    reach = int(np.clip(settings.window_of_period * spacing, 1, _LONGEST_DROP))
    around = np.arange(-reach, reach + 1)
    inside = (steepest >= reach) & (steepest < len(time) - 1 - reach)
    middle = 0.5 * (time[steepest] + time[steepest + 1])
    if not inside.any():
        return middle, 0.0, 0.0
    index = steepest[inside, None] + around
    drop = load[index] - load[index + 1]
    drop = drop - np.median(drop, axis=1, keepdims=True)  # the stick's own rise
    first, last = _extent(drop.sum(axis=0), reach, settings.drop_end)
    drop, when = drop[:, first : last + 1], (0.5 * (time[index] + time[index + 1]))[:, first : last + 1]
    total = np.maximum(drop.sum(axis=1), drop.max(axis=1))
    total[total <= 0] = 1.0  # a constant load has no drop to place
    away = when - middle[inside, None]
    shift = np.clip((drop * away).sum(axis=1) / total, away[:, 0], away[:, -1])
    middle[inside] += shift
    third = float((drop * (away - shift[:, None]) ** 3).sum() / total.sum())
    return middle, float(np.cbrt(max(third, 0.0) / 2)), float(np.median(away[:, -1] - away[:, 0]))


def _extent(profile: Floats, centre: int, end: float) -> tuple[int, int]:
    """First and last place around the centre where the sum of all drops exceeds `end` of its height there."""
    small = np.flatnonzero(profile < end * profile[centre])
    first = small[small < centre].max(initial=-1) + 1
    last = small[small > centre].min(initial=len(profile)) - 1
    return int(first), int(last)
