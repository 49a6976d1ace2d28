"""Slips as the load cell sees them: when the load drops, less what the force chain delays it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vision.force.lines import flat_ranges
from vision.force.recording import good_samples

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

Doubles = NDArray[np.float64]
Ints = NDArray[np.int64]

_AROUND = 3  # samples looked at before and after each slip for its steepest drop
_LONGEST = 100  # samples a drop may take after its steepest part
_OF_PERIOD = 0.3
_GONE = 0.01  # of the steepest drop: what is smaller is no part of it
# What the times of all slips together may be off by: parts of the delay found, of a sampling interval, and of
# the time a drop takes.
_UNSURE = (0.25, 0.12, 0.02)


def force_slips(force: xr.Dataset, sticks: pd.DataFrame) -> pd.DataFrame:
    """Middle of every slip, in order, the one that ends the initial loading first.

    The steepest drop finds a slip; the mean time of its drop, sample by sample, places it to a part of a
    sampling interval.  A low-pass in the force chain delays that mean by its time constant and leaves a
    tail: a first-order one has a third central moment of twice the constant cubed, and a slip itself,
    symmetric, has none.  So the tail of all slips together tells the delay, which is taken off.

    Args: force, from `read_force`.  sticks, from `find_stick_slip`.
    Returns: time_s (force clock), error_s (of each by itself) and drop_N, how much the force let go, NaN
    where not known: the mean of the slip's own drop and of the rises before and after it, as the sheets may
    follow either.  attrs: delay_s, taken off, and lag_s, what all may be off by together.  Empty where sticks
    is.
    """
    import pandas as pd

    good = good_samples(force)
    time, load = good["time_s"].to_numpy().astype(float), good["load_N"].to_numpy().astype(float)
    begin, end, drop = _bounds(sticks)
    if not len(begin) or len(time) < 3:
        return pd.DataFrame({"time_s": np.empty(0), "error_s": np.empty(0), "drop_N": np.empty(0)})
    interval = float(np.median(np.diff(time)))
    steepest, of = np.unique(_steepest(time, load, begin, end), return_index=True)
    middle, delay, length = _mean_times(time, load, steepest)
    order = np.argsort(middle)
    error = np.full(len(order), 0.5 * interval / np.sqrt(12))
    table = pd.DataFrame({"time_s": (middle - delay)[order], "error_s": error, "drop_N": drop[of][order]})
    lag = np.multiply(_UNSURE, (delay, interval, length))
    table.attrs |= {"delay_s": delay, "lag_s": float(np.sqrt(lag @ lag))}
    return table


def _bounds(sticks: pd.DataFrame) -> tuple[Doubles, Doubles, Doubles]:
    """Begin, end and drop of each slip; the last one ends, as the table does not say, as the others do."""
    if not len(sticks):
        return np.empty(0), np.empty(0), np.empty(0)
    valley, peak = sticks["t_v_s"].to_numpy(float), sticks["t_p_s"].to_numpy(float)
    first = float(sticks.attrs.get("first_slip_s", valley[0]))
    usual = float(np.median(valley[1:] - peak[:-1])) if len(peak) > 1 else 0.0
    begin, end = np.r_[first, peak], np.r_[valley, peak[-1] + max(usual, 0.0)]
    known = np.isfinite(begin) & np.isfinite(end)
    return begin[known], end[known], _drop_N(sticks)[known]


def _drop_N(sticks: pd.DataFrame) -> Doubles:
    """How much the force let go in each slip; NaN for the first and the last, known from one side only."""
    peak, valley = (np.asarray(sticks[name], np.float64) for name in ("F_p_N", "F_v_N"))
    rise, fall = peak - valley, peak[:-1] - valley[1:]
    return np.asarray(np.r_[np.nan, 0.5 * fall + 0.25 * (rise[:-1] + rise[1:]), np.nan])


def _steepest(time: Doubles, load: Doubles, begin: Doubles, end: Doubles) -> Ints:
    """The sample before the steepest drop of each slip."""
    start = np.clip(np.searchsorted(time, begin) - _AROUND, 0, len(time) - 2)
    stop = np.clip(np.searchsorted(time, end) + _AROUND, start + 1, len(time) - 1)
    row, index = flat_ranges(start, stop)
    order = np.lexsort((load[index] - load[index + 1], row))
    return np.asarray(index[order[np.flatnonzero(np.diff(np.r_[row[order], -1]) != 0)]])


def _mean_times(time: Doubles, load: Doubles, steepest: Ints) -> tuple[Doubles, float, float]:
    """(mean time of each drop, delay of the force chain, time from 1 % to 1 % of the steepest drop), s."""
    spacing = float(np.median(np.diff(steepest))) if len(steepest) > 1 else 0.0
    reach = int(np.clip(_OF_PERIOD * spacing, 1, _LONGEST))
    around = np.arange(-reach, reach + 1)
    inside = (steepest >= reach) & (steepest < len(time) - 1 - reach)
    middle = 0.5 * (time[steepest] + time[steepest + 1])
    if not inside.any():
        return middle, 0.0, 0.0
    index = steepest[inside, None] + around
    drop = load[index] - load[index + 1]
    drop = drop - np.median(drop, axis=1, keepdims=True)  # the stick's own rise
    first, last = _extent(drop.sum(axis=0), reach)
    drop, when = drop[:, first : last + 1], (0.5 * (time[index] + time[index + 1]))[:, first : last + 1]
    total = np.maximum(drop.sum(axis=1), drop.max(axis=1))
    total[total <= 0] = 1.0  # a load that holds still has no drop to place
    away = when - middle[inside, None]
    shift = np.clip((drop * away).sum(axis=1) / total, away[:, 0], away[:, -1])
    middle[inside] += shift
    third = float((drop * (away - shift[:, None]) ** 3).sum() / total.sum())
    return middle, float(np.cbrt(max(third, 0.0) / 2)), float(np.median(away[:, -1] - away[:, 0]))


def _extent(profile: Doubles, centre: int) -> tuple[int, int]:
    """First and last place around the centre where the drops of all slips together are not yet gone."""
    small = np.flatnonzero(profile < _GONE * profile[centre])
    first = small[small < centre].max(initial=-1) + 1
    last = small[small > centre].min(initial=len(profile)) - 1
    return int(first), int(last)
