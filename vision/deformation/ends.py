"""Sheets that slip one by one: later than the force drops, or before."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vision.deformation.creep import Creep, fit_creep, legendre
from vision.deformation.frames import Bools, Doubles, StickFrames
from vision.sheets.medians import nan_median
from vision.sheets.noise import NORMAL_MEDIAN

_LATEST_S = 0.025  # after the force dropped, or before
_LONGEST_S = 2 * _LATEST_S
_LEAST_INSIDE = 6  # frames
_TERMS = 3
_FAR = 5.0  # standard errors from where the rest of the stick says that the sheet should be
_CLEAR = 2.0  # times as far a sheet must jump for its frames to tell when it slips
_LEAST, _FURTHEST = 0.01, 1.5  # jumps
_FEW = 0.2  # of the sheets: what more of them do together is an error of the slip's time
_LEAST_LATE = 0.004  # of the sheets, to say anything of the others


@dataclass(frozen=True)
class Ends:
    """outside: positions (F, sheet) at which the sheet is not in the stick yet, or no longer.

    lost: share of the stick in which it does not creep therefore, with its error lost_err, (stick, sheet).
    """

    outside: Bools
    lost: Doubles
    lost_err: Doubles


def find_ends(x_px: Doubles, frames: StickFrames) -> Ends:
    """Hold the frames at either end of each stick against a parabola through the others.

    Where a sheet is still where it was before its slip, or already where it is after it, so it is in the
    frames nearer to the slip, and it slipped between that frame and the next.  How late the other sheets were
    follows from the share of late ones: all delays up to the longest are taken to be equally likely.  Sticks
    with too few frames are left as they are.

    Args: x_px (F, sheet), the camera's vibration taken off.
    """
    late, blurred, clear = _late(x_px, frames)
    length_s = frames.length_s[:, None]
    outside, lost, variance = np.zeros_like(late), np.zeros(clear.shape), np.zeros(clear.shape)
    for since_s in (frames.since_s, frames.length_s[frames.row] - frames.since_s):
        near = (since_s < frames.length_s[frames.row] / 2)[:, None]
        begin = _latest(near & blurred, since_s, frames)
        last = np.maximum(_latest(near & late, since_s, frames), begin)
        gone = (since_s[:, None] <= last[frames.row]) & (last > 0)[frames.row]
        first = frames.lowest(np.where(gone | np.isnan(x_px), np.inf, since_s[:, None]))
        longest = begin + _longest(frames.lowest(since_s) - begin[:, 0], last > begin, clear)
        until = np.where(last > begin, first, np.minimum(first, longest))
        until = np.where(np.isfinite(until), until, last)
        outside |= gone
        lost += ((last + until) / 2 - begin) / length_s
        variance += (until - last) ** 2 / 12 / length_s**2
    return Ends(outside, lost, np.sqrt(variance))


def _latest(these: Bools, since_s: Doubles, frames: StickFrames) -> Doubles:
    """Time of the last of these frames (F, ...) in each stick, s, (stick, ...); 0 without any."""
    return np.maximum(-frames.lowest(np.where(these, -since_s[:, None], 0.0)), 0.0)


def _late(x_px: Doubles, frames: StickFrames) -> tuple[Bools, Bools, Bools]:
    """Positions by which a sheet has not slipped yet, or already, (F, sheet); frames in which all sheets are
    on their way, (F, 1); and sheets that jump far enough to tell, (stick, sheet)."""
    end = _near_the_ends(frames)
    creep = fit_creep(np.where(end, np.nan, x_px), frames, terms=_TERMS)
    residual = x_px - creep.at(frames)
    residual -= nan_median(residual, axis=1)[:, None]
    far = _FAR * _expected(np.where(end, np.nan, residual), end, creep, frames)
    jump = 2 * creep.coefficient[..., 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        worst = -frames.lowest(np.where(end & np.isfinite(far), -far, 0.0))
        clear = (worst > 0) & np.isfinite(worst) & (np.abs(jump) > _CLEAR * worst)
        part = -np.sign(frames.u)[:, None] * residual / jump[frames.row]
        part = np.where(end & clear[frames.row] & (part < _FURTHEST), part, np.nan)
        common = np.maximum(_low(part), 0.0)[:, None]
        least = np.maximum(far / np.abs(jump)[frames.row], _LEAST)
        late, blurred = part - common > least, (common > least).any(axis=1, keepdims=True)
    return np.asarray(late), np.asarray(blurred), clear


def _near_the_ends(frames: StickFrames) -> Bools:
    """Frames at either end of sticks that have enough others, (F, 1)."""
    reach = int(np.ceil(_LATEST_S / frames.interval_s))
    after = np.arange(frames.row.size) - np.searchsorted(frames.row, frames.row)
    before = frames.counts[frames.row] - 1 - after
    near = np.minimum(after, before) < reach
    return np.asarray(near & (after + before + 1 - 2 * reach >= _LEAST_INSIDE))[:, None]


def _expected(residual: Doubles, end: Bools, creep: Creep, frames: StickFrames) -> Doubles:
    """Standard error of the residuals at the ends, to which the curve is not fitted, px, (F, sheet); NaN for
    the others."""
    count = max(float(np.median(creep.count)), _TERMS + 1)
    usual = nan_median(np.abs(residual)) / NORMAL_MEDIAN * np.sqrt(count / (count - _TERMS))
    left_out = np.flatnonzero(end[:, 0])
    design = legendre(frames.u[left_out], _TERMS)
    doubt = 1 + np.einsum("fa,fsab,fb->fs", design, creep.inverse[frames.row[left_out]], design)
    expected = np.full(residual.shape, np.nan)
    expected[left_out] = usual * np.sqrt(doubt)
    return expected


def _low(part: Doubles) -> Doubles:
    """The value above which all but a few of the sheets are, (F,); 0 where nothing is known."""
    ordered = np.nan_to_num(np.sort(part, axis=1))  # NaN comes last
    place = (_FEW * np.maximum(np.isfinite(part).sum(axis=1) - 1, 0)).astype(int)
    return np.asarray(np.take_along_axis(ordered, place[:, None], axis=1)[:, 0])


def _longest(first_s: Doubles, late: Bools, clear: Bools) -> float:
    """Longest delay, s: the share of sheets that are late falls with the time of the first frame.

    first_s: of each stick, (stick,).  0 where too few are late.
    """
    weight = clear.sum(axis=1)
    seen = (late & clear).sum() / max(weight.sum(), 1)
    if seen < _LEAST_LATE:
        return 0.0
    longest = np.linspace(0.0, _LONGEST_S, 101)[1:]
    share = weight @ np.maximum(1 - first_s[:, None] / longest, 0.0) / weight.sum()
    return float(np.interp(seen, share, longest))
