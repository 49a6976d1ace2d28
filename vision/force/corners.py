"""Peaks and valleys to a fraction of a sample: where a slip begins and ends."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vision.force.lines import Floats, Ints, flat_ranges
from vision.force.slips import stick_drops, stick_lines

# A slip of a spring-block is half a cosine: its 90 % and 10 % crossings lie 0.59 of half its length from
# the middle.
_HALF_COSINE = 0.59
# An instantaneous drop between two samples, joined by a line, crosses 90 % and 50 % this many samples apart.
_UNRESOLVED = 0.4
# The same two distances of an exponential tail, end over onset: ln 5 / ln 1.8.
_EXPONENTIAL = 2.74
# From 50 % to 10 % an exponential tail takes 1.6 time constants: three times that is five.
_SETTLED = 3.0
# Shorter from 90 to 10 %, in samples, a slip's own length is not resolved.
_SHORT = 1.5
_CLEAR_SIGMAS = 20.0
_REACH = 0.3


@dataclass(frozen=True)
class Corners:
    """Begin (peak) and end (valley) of each slip, in samples, fractions included.

    chain: how much of the slips' length is put down to the force chain's response: 0 none, 1 all.
    settling: samples from a valley until that response has died away (five time constants); 0 without one.
    """

    peak: Floats
    valley: Floats
    chain: float
    settling: float


def find_corners(y: Floats, edge: Ints, sigma: float) -> Corners:
    """Begin and end of the slips at the given edges.

    Between the stick lines before (1) and after (0) a slip passes 90, 50 and 10 %; these times, scaled as
    for half a cosine, give its begin and end.  A low-pass in the force chain makes the end lag
    (exponential tail) while the onset stays sharp; that asymmetry, over all slips, tells how much of their
    length is the chain's, and that part is taken off.  Slips too short for the sampling begin and end at
    the same instant, where they are half-way.  Each slip's own length is used where its drop is over 20 σ,
    else the recording's median.
    """
    high, middle, low = _crossings(y, edge)
    onset, end = _resolved(middle - high), _resolved(low - middle)
    usual_onset, usual_end = _usual(onset), _usual(end)
    chain = 0.0
    if usual_end > usual_onset:
        ratio = usual_end / max(usual_onset, 1e-9)
        chain = float(np.clip((ratio - 1) / (_EXPONENTIAL - 1), 0.0, 1.0))
    settling = _SETTLED * usual_end * chain
    if usual_onset + usual_end < _SHORT:
        onset, end = np.zeros_like(onset), np.zeros_like(end)
        usual_onset = usual_end = 0.0
    clear = (stick_drops(y, edge) > _CLEAR_SIGMAS * sigma) & np.isfinite(onset) & np.isfinite(end)
    onset = np.where(clear, onset, usual_onset) * (1 - chain) / _HALF_COSINE
    end = np.where(clear, np.minimum(end, usual_end * 2), usual_end)
    end = np.where(chain > 0, onset, end / _HALF_COSINE)
    last = y.size - 1.0
    return Corners(np.clip(middle - onset, 0, last), np.clip(middle + end, 0, last), chain, settling)


def _usual(distance: Floats) -> float:
    known = distance[np.isfinite(distance)]
    return float(np.median(known)) if known.size else 0.0


def _resolved(distance: Floats) -> Floats:
    """A distance between crossings without what sampling alone makes of a sudden drop."""
    return np.sqrt(np.maximum(distance**2 - _UNRESOLVED**2, 0.0))


def _crossings(y: Floats, edge: Ints) -> tuple[Floats, Floats, Floats]:
    """Where the signal falls through 90, 50 and 10 % of the way between the stick lines around each edge."""
    bounds = np.r_[0, edge, y.size]
    length = np.diff(bounds)
    start = edge - np.maximum((_REACH * length[:-1]).astype(np.int64), 2)
    stop = np.minimum(edge + np.maximum((_REACH * length[1:]).astype(np.int64), 2), y.size - 1)
    row, index = flat_ranges(np.maximum(start, 0), stop)
    lines = stick_lines(y, edge)
    before, after = lines.take(slice(None, -1)), lines.take(slice(1, None))
    here = np.asarray(edge - 0.5, dtype=float)
    drop = before.at(here) - after.at(here)
    # One line each side of the edge, at the distance of the drop there: lines of different slope never cross.
    x = index.astype(float)
    base = np.where(
        index < edge[row],
        before.mean_y[row] + before.slope[row] * (x - before.mean_x[row]) - drop[row],
        after.mean_y[row] + after.slope[row] * (x - after.mean_x[row]),
    )
    u = (y[index] - base) / drop[row]
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
    part = (u[here] - level) / np.maximum(u[here] - u[np.minimum(here + 1, u.size - 1)], np.finfo(float).tiny)
    return np.where(at >= 0, index[here] + part, np.nan)
