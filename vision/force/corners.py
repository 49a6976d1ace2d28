"""Peaks and valleys to a fraction of a sample: where a slip begins and ends."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vision.force.chain import Tails, Undelayed
from vision.force.lines import Floats, Ints, fit_broken_lines, flat_ranges
from vision.force.slips import stick_lines, stick_middles

# A slip of a spring-block is half a cosine: its 90 % and 10 % crossings lie 0.59 of half its length from
# the middle.
_HALF_COSINE = 0.59
_STRAIGHT = 0.8
# An instantaneous drop between two samples, joined by a line, crosses 90 % and 50 % this many samples apart,
# and some more, added in squares, where undoing a low-pass leaves a sample part of the way down.
_UNRESOLVED, _PART_WAY = 0.4, 0.5
# Shorter from 90 to 10 %, in samples, a slip's own length is not resolved.
_SHORT = 1.0
# Samples by which a corner may be off: where between two a slip begins or ends is not seen.
_SAMPLED = 0.3
# Half a cosine is an assumption: a corner may be off by this part of a slip's length.
_SHAPE = 0.04
_CLEAR_SIGMAS = 20.0
_REACH = 0.3
# Clear of a slip is what lies this many times its half length from its middle.
_CLEAR = 1.2
# Squared residuals of one line over those of two: above this a stick has two slopes.
_BENT = 1.5


@dataclass(frozen=True)
class Corners:
    """Begin (peak) and end (valley) of each slip, in samples, fractions included.

    middle: half-way down.  drop: height between the stick lines.  error: standard error of one corner's
    place.  knee: where the stick before and after changes slope, one more than slips, NaN where it does not.
    """

    peak: Floats
    valley: Floats
    middle: Floats
    drop: Floats
    error: Floats
    knee: Floats

    def tails(self) -> Tails:
        """The stretches between slips, clear of them, for the force chain's time constant."""
        # The chain delays the end of a slip, not its onset.
        own = np.maximum(_CLEAR * (self.middle - self.peak), 1.0)
        return Tails(
            start=np.ceil(self.middle + own).astype(np.int64)[:-1],
            stop=np.floor(self.middle - own).astype(np.int64)[1:],
            middle=self.middle[:-1],
            valley=self.valley[:-1],
            peak=self.peak[1:],
            drop=self.drop[:-1],
        )


def find_corners(signal: Undelayed, *, two_slopes: bool) -> Corners:
    """Begin and end of the slips of a recording.

    Between the stick lines before (1) and after (0) a slip passes 90, 50 and 10 %; these times, scaled as
    for half a cosine, give its begin and end.  Slips too short for the sampling count half as long as they
    look.  Each slip's own length is used where its drop is over 20 σ, else the recording's median.

    Args: two_slopes, whether the stick lines may have a knee.
    """
    base = _Baselines.of(signal.load, signal.edge, two_slopes)
    high, middle, low = _crossings(signal.load, signal.edge, base)
    onset, end = (_resolved(part, signal) for part in (middle - high, low - middle))
    usual_onset, usual_end = _usual(onset), _usual(end)
    if usual_onset + usual_end < _SHORT:
        # Half of what is seen: the rest may be the sampling's or a low-pass too short to tell.
        usual_onset = usual_end = 0.25 * (usual_onset + usual_end)
        onset, end = np.full_like(onset, usual_onset), np.full_like(end, usual_end)
    clear = (base.drop > _CLEAR_SIGMAS * signal.sigma) & np.isfinite(onset) & np.isfinite(end)
    onset = _half(np.where(clear, onset, usual_onset), base.before_slope, base.drop)
    end = _half(np.where(clear, np.minimum(end, usual_end * 2), usual_end), base.after_slope, base.drop)
    middle = middle - signal.late
    last = signal.load.size - 1.0
    return Corners(
        peak=np.clip(middle - onset, 0, last),
        valley=np.clip(middle + end, 0, last),
        middle=middle,
        drop=base.drop,
        knee=base.knee - signal.late,
        error=_errors(signal, base.drop, usual_onset + usual_end),
    )


def _half(distance: Floats, slope: Floats, drop: Floats) -> Floats:
    """Half a slip's length from the distance of a crossing.

    The drop between the stick lines is the slip's own and what the lines rise meanwhile, which is straight.
    """
    half = distance / _HALF_COSINE
    for _ in range(2):
        with np.errstate(over="ignore"):  # next to no drop: all of it is straight
            straight = np.clip(2 * slope * half / np.maximum(drop, np.finfo(float).tiny), 0, 1)
        half = distance / (_HALF_COSINE + (_STRAIGHT - _HALF_COSINE) * np.nan_to_num(straight))
    return half


def _errors(signal: Undelayed, drop: Floats, length: float) -> Floats:
    """Standard error of a corner's place: noise over the slip's slope there, and the sampling."""
    unsure = np.hypot(_SAMPLED, _SHAPE * length / _HALF_COSINE)
    steepest = np.pi / 2 * np.maximum(drop, signal.sigma) / max(length / _HALF_COSINE, signal.width)
    return np.hypot(signal.sigma / steepest, unsure)


@dataclass(frozen=True)
class _Baselines:
    """The stick line before and after each edge: value half a sample before it, slope, and the drop."""

    before: Floats
    before_slope: Floats
    after: Floats
    after_slope: Floats
    knee: Floats

    @property
    def drop(self) -> Floats:
        return self.before - self.after

    @classmethod
    def of(cls, y: Floats, edge: Ints, two_slopes: bool) -> _Baselines:
        lines = stick_lines(y, edge)
        here = np.asarray(edge - 0.5, dtype=float)
        # Each stick between a slip at its begin and one at its end; the first and the last lack one of them.
        begin, end = np.insert(here, 0, np.nan), np.append(here, np.nan)
        at_begin, at_end, early, late = lines.at(begin), lines.at(end), lines.slope, lines.slope
        knee = np.full(edge.size + 1, np.nan)
        if two_slopes:
            broken = fit_broken_lines(np.arange(y.size, dtype=float), y, *stick_middles(edge, y.size))
            bent = (broken.gain > _BENT) & (broken.first > 0) & (broken.second > 0)
            knee = np.where(bent, broken.knee_x, np.nan)
            at_begin, early = np.where(bent, [broken.first_at(begin), broken.first], [at_begin, early])
            at_end, late = np.where(bent, [broken.second_at(end), broken.second], [at_end, late])
        return cls(at_end[:-1], late[:-1], at_begin[1:], early[1:], knee)


def _usual(distance: Floats) -> float:
    known = distance[np.isfinite(distance)]
    return float(np.median(known)) if known.size else 0.0


def _resolved(distance: Floats, signal: Undelayed) -> Floats:
    """A distance between crossings without what sampling and smoothing alone make of a sudden drop."""
    blur = np.hypot(_UNRESOLVED * signal.width, _PART_WAY if signal.late else 0.0)
    return np.asarray(np.sqrt(np.maximum(distance**2 - blur**2, 0.0)))


def _crossings(y: Floats, edge: Ints, base: _Baselines) -> tuple[Floats, Floats, Floats]:
    """Where the signal falls through 90, 50 and 10 % of the way between the stick lines around each edge."""
    bounds = np.r_[0, edge, y.size]
    length = np.diff(bounds)
    start = edge - np.maximum((_REACH * length[:-1]).astype(np.int64), 2)
    stop = np.minimum(edge + np.maximum((_REACH * length[1:]).astype(np.int64), 2), y.size - 1)
    row, index = flat_ranges(np.maximum(start, 0), stop)
    # One line each side of the edge, at the distance of the drop there: lines of different slope never cross.
    slope = np.where(index < edge[row], base.before_slope[row], base.after_slope[row])
    line = base.after[row] + slope * (index - edge[row] + 0.5)
    u = (y[index] - line) / base.drop[row]
    middle = _half_way(u, row, index, edge.size)
    # A slip cut short by the next one may never pass half-way: then the steepest drop stands for its middle.
    middle = np.where(np.isfinite(middle), middle, edge - 0.5)
    high = _last_above(u, row, index, 0.9, edge.size, middle)
    low = _first_below(u, row, index, 0.1, edge.size, middle)
    return high, middle, low


def _half_way(u: Floats, row: Ints, index: Ints, rows: int) -> Floats:
    """The likeliest place of a step from 1 to 0: where the sum of u - 0.5 so far is largest; NaN at a
    window's end.

    A single crossing of 0.5 would be thrown off by the first outlier when the drop is a few times the noise.
    """
    so_far = np.cumsum(u - 0.5)
    largest = np.full(rows, -np.inf)
    np.maximum.at(largest, row, so_far)
    best = np.flatnonzero((so_far == largest[row]) & np.r_[row[1:] == row[:-1], False])
    first = np.full(rows, u.size, dtype=np.int64)
    np.minimum.at(first, row[best], best)
    return _interpolated(u, index, 0.5, np.where(first < u.size, first, -1))


def _last_above(u: Floats, row: Ints, index: Ints, level: float, rows: int, until: Floats) -> Floats:
    """Index, interpolated, at which u last falls through a level before `until`; NaN if never."""
    allowed = np.flatnonzero(
        (u[:-1] >= level) & (u[1:] < level) & (row[:-1] == row[1:]) & (index[:-1] <= until[row[:-1]])
    )
    last = np.full(rows, -1, dtype=np.int64)
    np.maximum.at(last, row[allowed], allowed)
    return _interpolated(u, index, level, last)


def _first_below(u: Floats, row: Ints, index: Ints, level: float, rows: int, since: Floats) -> Floats:
    """Index, interpolated, at which u first falls through a level after `since`; NaN if never."""
    allowed = np.flatnonzero(
        (u[:-1] >= level) & (u[1:] < level) & (row[:-1] == row[1:]) & (index[1:] >= since[row[:-1]])
    )
    first = np.full(rows, u.size, dtype=np.int64)
    np.minimum.at(first, row[allowed], allowed)
    return _interpolated(u, index, level, np.where(first < u.size, first, -1))


def _interpolated(u: Floats, index: Ints, level: float, at: Ints) -> Floats:
    here = np.maximum(at, 0)
    part = (u[here] - level) / np.maximum(u[here] - u[np.minimum(here + 1, u.size - 1)], 1e-9)
    return np.where(at >= 0, index[here] + part, np.nan)
