"""What is wrong with single samples of a recording: said, never mended."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

GAP_FACTOR = 5.0
_SATURATED_RUN = 5


def sample_flags(
    time_s: NDArray[np.float64], load: NDArray[np.float64], displacement: NDArray[np.float64] | None
) -> NDArray[np.str_]:
    """One word per sample: the first of these that applies, else "ok".

    "nan" time, load or displacement is not a number; "backwards" time is earlier than a time already seen;
    "repeated" time is the same; "saturated" one of 5 or more equal samples in a row at the largest |load| of
    the recording; "gap" the time before this sample is over 5 sampling intervals (the sample itself is good).
    """
    flags = np.full(time_s.shape, "ok", dtype="<U9")
    bad = ~np.isfinite(time_s) | ~np.isfinite(load)
    if displacement is not None:
        bad |= ~np.isfinite(displacement)
    latest = np.fmax.accumulate(np.r_[-np.inf, np.where(bad, -np.inf, time_s)])[:-1]
    step = np.where(bad, np.nan, time_s) - latest
    usual = (
        np.median(step[np.isfinite(step) & (step > 0)]) if np.any(np.isfinite(step) & (step > 0)) else np.nan
    )
    flags[np.isfinite(step) & (step > GAP_FACTOR * usual)] = "gap"
    flags[_saturated(load)] = "saturated"
    flags[step == 0] = "repeated"
    flags[step < 0] = "backwards"
    flags[bad] = "nan"
    return flags


def _saturated(load: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Runs of at least 5 samples at exactly the largest |load|; none where that is the resting value."""
    finite = np.abs(load[np.isfinite(load)])
    if not finite.size or finite.max() == np.median(finite):
        return np.zeros(load.shape, dtype=bool)
    at_limit = np.abs(load) == finite.max()
    edges = np.flatnonzero(np.diff(np.r_[False, at_limit, False]))
    starts, stops = edges[::2], edges[1::2]
    long = stops - starts >= _SATURATED_RUN
    marks = np.zeros(load.size + 1, dtype=int)
    np.add.at(marks, starts[long], 1)
    np.add.at(marks, stops[long], -1)
    return np.asarray(np.cumsum(marks[:-1]) > 0)


def usable(flags: NDArray[np.str_]) -> NDArray[np.bool_]:
    """Samples that can be measured on: good ones and those after a gap."""
    return np.isin(flags, ("ok", "gap"))
