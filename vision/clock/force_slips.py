"""Slips as the load cell sees them: the steepest drop of each."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vision.force.lines import flat_ranges
from vision.force.recording import good_samples

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

_AROUND = 3  # samples looked at before and after each slip


def force_slips(force: xr.Dataset, sticks: pd.DataFrame) -> pd.DataFrame:
    """Time of the steepest drop of every slip, in order, the one that ends the initial loading first.

    Steepest between two samples, not the corner: a load cell's low-pass delays the corner's fall-off and
    half-way point, the steepest drop hardly.

    Args: force, from `read_force`.  sticks, from `find_stick_slip`.
    Returns: time_s (force clock) and error_s, half a sampling interval evenly spread.  attrs: interval_s.
    Empty where sticks is.
    """
    import pandas as pd

    good = good_samples(force)
    time, load = good["time_s"].to_numpy().astype(float), good["load_N"].to_numpy().astype(float)
    interval = float(np.median(np.diff(time))) if len(time) > 1 else float("nan")
    begin, end = _bounds(sticks)
    start = np.clip(np.searchsorted(time, begin) - _AROUND, 0, max(len(time) - 2, 0))
    stop = np.clip(np.searchsorted(time, end) + _AROUND, start + 1, max(len(time) - 1, 1))
    row, index = flat_ranges(start, stop)
    drop = load[index] - load[index + 1] if len(index) else np.empty(0)
    order = np.lexsort((drop, row))
    steepest = index[order[np.flatnonzero(np.diff(np.r_[row[order], -1]) != 0)]]
    at = np.unique(0.5 * (time[steepest] + time[steepest + 1]))
    table = pd.DataFrame({"time_s": at, "error_s": np.full(len(at), interval / np.sqrt(12))})
    table.attrs["interval_s"] = interval
    return table


def _bounds(sticks: pd.DataFrame) -> tuple[np.ndarray, np.ndarray]:
    """Begin and end of each slip; the last one ends, as the table does not say, as the others do."""
    if not len(sticks):
        return np.empty(0), np.empty(0)
    valley, peak = sticks["t_v_s"].to_numpy(float), sticks["t_p_s"].to_numpy(float)
    first = float(sticks.attrs.get("first_slip_s", valley[0]))
    usual = float(np.median(valley[1:] - peak[:-1])) if len(peak) > 1 else 0.0
    begin, end = np.r_[first, peak], np.r_[valley, peak[-1] + max(usual, 0.0)]
    known = np.isfinite(begin) & np.isfinite(end)
    return begin[known], end[known]
