"""Peaks and valleys to a fraction of a sample: where a slip begins and ends."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vision.force.lines import fit_broken_lines, flat_ranges
from vision.force.lowpass import DeconvolvedLoad, SlipTransients
from vision.force.settings import DEFAULTS, ForceSettings
from vision.force.slips import stick_lines, stick_middles
from vision.numeric import Floats, Ints

# A slip of a spring and block is half a cosine: its 90 % and 10 % crossings lie 0.59 of half its length from
# the middle; those of a straight fall 0.8.
_HALF_COSINE, _STRAIGHT = 0.59, 0.8
# A sudden drop between two samples, joined by a line, crosses 90 % and 50 % this many samples apart, and some
# more, added in squares, where deconvolution leaves a sample part of the way down.
_UNRESOLVED, _PART_WAY = 0.4, 0.5


@dataclass(frozen=True)
class Corners:
    """Begin (peak) and end (valley) of each slip, in samples, fractions included.

    Parameters
    ----------
    peak, valley, middle
        Begin, end, and where the load is half-way down.
    drop
        Height between the stick lines.
    error
        Standard error of one corner's place.
    knee
        Where the stick before and after changes slope: one more than slips, NaN where it does not.
    """

    peak: Floats
    valley: Floats
    middle: Floats
    drop: Floats
    error: Floats
    knee: Floats

    def transients(self) -> SlipTransients:
        """The stretches between slips and clear of them, in which a low-pass leaves its transients."""
        # A low-pass delays the end of a slip, not its onset.
        own = np.maximum(1.2 * (self.middle - self.peak), 1.0)
        return SlipTransients(
            start=np.ceil(self.middle + own).astype(np.int64)[:-1],
            stop=np.floor(self.middle - own).astype(np.int64)[1:],
            middle=self.middle[:-1],
            valley=self.valley[:-1],
            peak=self.peak[1:],
            drop=self.drop[:-1],
        )


def find_corners(signal: DeconvolvedLoad, *, two_slopes: bool, settings: ForceSettings = DEFAULTS) -> Corners:
    """Begin and end of the slips of a recording.

    Parameters
    ----------
    signal
        As from `deconvolve_lowpass`.
    two_slopes
        Whether the stick lines may have a knee.
    settings
        See `ForceSettings`.

    Returns
    -------
    One peak and one valley per slip, inside the recording.

    Notes
    -----
    Between the stick lines before (1) and after (0) a slip the load passes 90, 50 and 10 %; these times,
    scaled as for half a cosine, give begin and end. Slips too short for the sampling count half as long as
    they look. Each slip's own length is used where its drop is over 20 sigma, else the recording's median.
    """
    base = _Baselines.of(signal, two_slopes, settings)
    high, middle, low = _crossings(signal.load, signal.edge, base)
    # What sampling and smoothing alone make of a sudden drop is no part of a slip's length.
    blur = np.hypot(_UNRESOLVED * signal.width, _PART_WAY if signal.late else 0.0)
    onset, end = (np.sqrt(np.maximum(part**2 - blur**2, 0.0)) for part in (middle - high, low - middle))
    usual_onset, usual_end = _known_median(onset), _known_median(end)
    if usual_onset + usual_end < 1.0:
        # Not resolved. Half of what is seen: the rest may be the sampling's or a low-pass too short to tell.
        usual_onset = usual_end = 0.25 * (usual_onset + usual_end)
        onset, end = np.full_like(onset, usual_onset), np.full_like(end, usual_end)
    clear = base.drop > 20 * signal.sigma  # noise would scatter the length of smaller ones
    clear &= np.isfinite(onset) & np.isfinite(end)
    onset = _half_length(np.where(clear, onset, usual_onset), base.before_slope, base.drop)
    end = _half_length(
        np.where(clear, np.minimum(end, usual_end * 2), usual_end), base.after_slope, base.drop
    )
    middle = middle - signal.late
    last = signal.load.size - 1.0
    return Corners(
        peak=np.clip(middle - onset, 0, last),
        valley=np.clip(middle + end, 0, last),
        middle=middle,
        drop=base.drop,
        knee=base.knee - signal.late,
        error=_errors(signal, base.drop, (usual_onset + usual_end) / _HALF_COSINE, settings),
    )


def _half_length(distance: Floats, slope: Floats, drop: Floats) -> Floats:
    """Half a slip's length from the distance of a crossing.

    The drop between the stick lines is the slip's own plus what the lines rise meanwhile, which is straight.
    """
    half = distance / _HALF_COSINE
    for _ in range(2):
        with np.errstate(over="ignore"):  # next to no drop: all of it is straight
            straight = np.clip(2 * slope * half / np.maximum(drop, np.finfo(float).tiny), 0, 1)
        half = distance / (_HALF_COSINE + (_STRAIGHT - _HALF_COSINE) * np.nan_to_num(straight))
    return half


def _errors(signal: DeconvolvedLoad, drop: Floats, length: float, settings: ForceSettings) -> Floats:
    """Standard error of a corner's place: noise over the slip's slope there, sampling, and unknown shape."""
    unsure = np.hypot(settings.corner_error, settings.shape_error * length)
    steepest = np.pi / 2 * np.maximum(drop, signal.sigma) / max(length, signal.width)
    return np.hypot(signal.sigma / steepest, unsure)


def _known_median(distance: Floats) -> float:
    known = distance[np.isfinite(distance)]
    return float(np.median(known)) if known.size else 0.0


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
    def of(cls, signal: DeconvolvedLoad, two_slopes: bool, settings: ForceSettings) -> _Baselines:
        """Straight stick lines, or with a knee where that fits clearly better."""
        y, edge = signal.load, signal.edge
        lines = stick_lines(y, edge, settings)
        here = np.asarray(edge - 0.5, dtype=float)
        # Each stick between a slip at its begin and one at its end; the first and the last lack one of them.
        begin, end = np.insert(here, 0, np.nan), np.append(here, np.nan)
        at_begin, at_end, early, late = lines.at(begin), lines.at(end), lines.slope, lines.slope
        knee = np.full(edge.size + 1, np.nan)
        if two_slopes:
            middles = stick_middles(edge, y.size, settings)
            broken = fit_broken_lines(np.arange(y.size, dtype=float), y, *middles)
            bent = (broken.gain > settings.knee_gain) & (broken.first > 0) & (broken.second > 0)
            knee = np.where(bent, broken.knee_x, np.nan)
            at_begin, early = np.where(bent, [broken.first_at(begin), broken.first], [at_begin, early])
            at_end, late = np.where(bent, [broken.second_at(end), broken.second], [at_end, late])
        return cls(at_end[:-1], late[:-1], at_begin[1:], early[1:], knee)


def _crossings(y: Floats, edge: Ints, base: _Baselines) -> tuple[Floats, Floats, Floats]:
    """Where the signal falls through 90, 50 and 10 % of the way between the stick lines around each edge."""
    reach = np.maximum((0.3 * np.diff(np.r_[0, edge, y.size])).astype(np.int64), 2)  # into either stick
    row, index = flat_ranges(np.maximum(edge - reach[:-1], 0), np.minimum(edge + reach[1:], y.size - 1))
    # One line each side of the edge, at the distance of the drop there: lines of different slope never cross.
    slope = np.where(index < edge[row], base.before_slope[row], base.after_slope[row])
    line = base.after[row] + slope * (index - edge[row] + 0.5)
    u = (y[index] - line) / base.drop[row]
    middle = _half_way(u, row, index, edge.size)
    # A slip cut short by the next one may never pass half-way: its middle is then the steepest drop.
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
    falling = (u[:-1] >= level) & (u[1:] < level) & (row[:-1] == row[1:])
    allowed = np.flatnonzero(falling & (index[:-1] <= until[row[:-1]]))
    last = np.full(rows, -1, dtype=np.int64)
    np.maximum.at(last, row[allowed], allowed)
    return _interpolated(u, index, level, last)


def _first_below(u: Floats, row: Ints, index: Ints, level: float, rows: int, since: Floats) -> Floats:
    """Index, interpolated, at which u first falls through a level after `since`; NaN if never."""
    falling = (u[:-1] >= level) & (u[1:] < level) & (row[:-1] == row[1:])
    allowed = np.flatnonzero(falling & (index[1:] >= since[row[:-1]]))
    first = np.full(rows, u.size, dtype=np.int64)
    np.minimum.at(first, row[allowed], allowed)
    return _interpolated(u, index, level, np.where(first < u.size, first, -1))


def _interpolated(u: Floats, index: Ints, level: float, at: Ints) -> Floats:
    """Where u passes the level between the samples `at` and the next; NaN for -1."""
    here = np.maximum(at, 0)
    part = (u[here] - level) / np.maximum(u[here] - u[np.minimum(here + 1, u.size - 1)], 1e-9)
    return np.where(at >= 0, index[here] + part, np.nan)
