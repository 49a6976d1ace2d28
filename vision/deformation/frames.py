"""Which frames belong to which stick phase, and sums over the frames of each stick."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class StickFrames:
    """Frames that lie wholly within a stick, stick after stick, in order of time.

    frame: place in the tracks, (F,).  row: the stick each belongs to, (F,), rising.  u: time from -1 at t_v
    to +1 at t_p, (F,).  slot: time since t_v in whole frame intervals, (F,): lost frames leave gaps.
    sticks: their number, those without a frame included.  length_s, and middle_s on the clock:
    (sticks,).  interval_s: between frames.
    """

    frame: Ints
    row: Ints
    u: Doubles
    slot: Ints
    sticks: int
    length_s: Doubles
    middle_s: Doubles
    interval_s: float

    def sums(self, values: NDArray[np.generic]) -> Doubles:
        """Sum of `values` (F, ...) over the frames of each stick, (sticks, ...); 0 for a stick without."""
        return self._reduce(np.add, values, 0.0)

    @property
    def since_s(self) -> Doubles:
        """Time since t_v, (F,)."""
        return (self.u + 1) / 2 * self.length_s[self.row]

    @property
    def counts(self) -> Ints:
        """Frames in each stick, (sticks,)."""
        return np.bincount(self.row, minlength=self.sticks)

    def lowest(self, values: NDArray[np.generic]) -> Doubles:
        """Smallest of `values` (F, ...) in each stick, (sticks, ...); inf for a stick without frames."""
        return self._reduce(np.minimum, values, np.inf)

    def _reduce(self, operation: np.ufunc, values: NDArray[np.generic], empty: float) -> Doubles:
        out = np.full((self.sticks, *values.shape[1:]), empty)
        if self.row.size:
            first = np.flatnonzero(np.r_[True, np.diff(self.row) > 0])
            out[self.row[first]] = operation.reduceat(values, first, axis=0, dtype=float)
        return out


def frames_of_sticks(
    time_s: Doubles, start_s: Doubles, stop_s: Doubles, *, margin_s: float, interval_s: float
) -> StickFrames:
    """The frames at least `margin_s` after the start and before the end of each stick.

    A frame whose time is not later than the one before (a stale time stamp) is left out: its time is wrong.

    Args: time_s, of every frame on the sticks' clock, NaN where unknown.  start_s and stop_s, (sticks,), in
    order and not overlapping.  interval_s, between two frames.
    """
    known = np.flatnonzero(np.isfinite(time_s))
    known = known[time_s[known] > np.r_[-np.inf, np.maximum.accumulate(time_s[known])[:-1]]]
    stick = np.searchsorted(start_s + margin_s, time_s[known], side="right") - 1
    inside = (stick >= 0) & (time_s[known] <= stop_s[stick] - margin_s)
    frame, row = known[inside], stick[inside]
    since = time_s[frame] - start_s[row]
    slot, length = np.rint(since / interval_s).astype(np.int64), stop_s - start_s
    u, middle = 2 * since / length[row] - 1, start_s + length / 2
    return StickFrames(frame, row, u, slot, start_s.size, length, middle, interval_s)
