"""Runs of frames through which every candidate can be followed without doubt."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vision.sheets.alignment import Candidates
from vision.sheets.comb import Comb
from vision.sheets.ridges import Floats, Ridges

Doubles = NDArray[np.float64]
Ints = NDArray[np.int64]
Truths = NDArray[np.bool_]

STEP_SHARE = 0.3  # of the spacing to the nearer neighbour: a smaller step cannot be mistaken
MOST_AT_AN_EDGE = 2  # candidates that come in or go out on the left between two frames
CHANGE_FACTOR = 5.0  # times the typical change of the brightnesses between frames: another comb stands there
LEAST_CHANGE = 0.2  # natural logarithm


@dataclass(frozen=True)
class Segments:
    """Runs of frames in which candidates do not move far between frames, and come and go at the picture's
    edges only.

    start, length: first frame and number of frames, (segments,).  place: where in the segment's list each
    frame's own list begins, (frame,).  candidates: their mean position (as if seen in the middle frame), log
    contrast and log width.
    """

    start: Ints
    length: Ints
    place: Ints
    candidates: Candidates

    def of_frames(self) -> Ints:
        """Segment of every frame (frame,)."""
        return np.repeat(np.arange(len(self.start)), self.length)

    def in_frames(self, match: Ints, count: Ints) -> Ints:
        """Candidate of each sheet in each frame (frame, N), from that in each segment; −1 where none.

        Args: match (segments, N); count, candidates in each frame (frame,).
        """
        own = match[self.of_frames()]
        number = own - self.place[:, None]
        return np.where((own >= 0) & (number >= 0) & (number < count[:, None]), number, -1)


class _Joint(NamedTuple):
    """How each frame follows on the one before, (frame − 1,): whether it does; how many candidates came in on
    the left; how far those in both moved in the mean, px."""

    holds: Truths
    came: Ints
    moved_px: Doubles


def split_segments(ridges: Ridges, comb: Comb, *, width_px: int) -> Segments:
    """Cut the recording where a candidate comes, goes or jumps, save where sheets cross the picture's edge.

    Inside a segment every candidate of one frame is one of the next, or crosses the edge there, and every
    step is below 0.3 of the spacing to the nearer neighbour (or of the pitch, if smaller). A comb that jumps
    by a whole pitch so that one sheet leaves the picture as another enters looks still; its brightnesses
    change, and so it is cut.
    """
    joint = _joints(ridges, comb, width_px)
    start = np.r_[0, 1 + np.flatnonzero(~joint.holds)].astype(np.int64)
    length = np.diff(np.r_[start, len(ridges.x_px)])
    of_frame = np.repeat(np.arange(len(start)), length)
    place = np.r_[0, -np.cumsum(joint.came)]
    place -= np.minimum.reduceat(place, start)[of_frame]
    drift = np.r_[0.0, np.cumsum(joint.moved_px)]
    drift -= drift[start + length // 2][of_frame]
    tables = [
        _means(values, of_frame, place)
        for values in (ridges.x_px - drift[:, None], np.log(ridges.contrast), np.log(ridges.fwhm_px))
    ]
    return Segments(start, length, place, Candidates(*tables))


def _joints(ridges: Ridges, comb: Comb, width_px: int) -> _Joint:
    """Frames of equal count first; where these do not follow on each other, with sheets crossing the edge."""
    frames = len(ridges.x_px)
    joint = _joint(ridges, np.arange(frames - 1), 0, comb, width_px)
    usual = float(np.median(joint.change)) if frames > 1 else 0.0
    most = max(LEAST_CHANGE, CHANGE_FACTOR * usual)
    holds, moved = joint.holds & (joint.change <= most), joint.moved_px
    came = np.zeros(frames - 1, np.int64)
    for number in (1, -1, 2, -2)[: 2 * MOST_AT_AN_EDGE]:
        rows = np.flatnonzero(~holds)
        joint = _joint(ridges, rows, number, comb, width_px)
        good = joint.holds & (joint.change <= most)
        holds[rows[good]], came[rows[good]], moved[rows[good]] = True, number, joint.moved_px[good]
    return _Joint(holds, came, np.where(holds, moved, 0.0))


class _Pairs(NamedTuple):
    holds: Truths
    moved_px: Doubles
    change: Doubles


def _joint(ridges: Ridges, rows: Ints, came: int, comb: Comb, width_px: int) -> _Pairs:
    """Whether frame row + 1 follows on frame row with `came` new candidates on the left (gone, if negative);
    mean step, px; change of the brightnesses, natural logarithm; all (rows,)."""
    before, after = ridges.x_px[rows], _onward(ridges.x_px[rows + 1], came)
    paired = np.isfinite(before) & np.isfinite(after)
    step = np.where(paired, after - before, 0.0)
    room = np.fmin(np.fmin(_spacing(before), _spacing(after)), comb.pitch_px)
    still = (np.abs(step) < STEP_SHARE * room) | ~paired
    edge = comb.fwhm_px + STEP_SHARE * comb.pitch_px
    single = [np.where(paired, np.nan, x) for x in (before, after)] + [ridges.x_px[rows + 1, : max(came, 0)]]
    crossing = [np.isnan(x) | (x < edge) | (x > width_px - 1 - edge) for x in single]
    count = paired.sum(axis=1)
    alone = ridges.count[rows] + ridges.count[rows + 1] - 2 * count
    holds = still.all(axis=1) & np.hstack(crossing).all(axis=1) & (alone <= count)
    bright = np.log(ridges.contrast)
    change = np.where(paired, _onward(bright[rows + 1], came) - bright[rows], 0.0)
    total = np.maximum(count, 1)
    return _Pairs(holds, step.sum(axis=1) / total, np.sqrt((change**2).sum(axis=1) / total))


def _onward(values: Floats, by: int) -> Floats:
    """Rows moved to the left by some places (to the right, if negative), NaN where that leaves a gap."""
    moved = np.full_like(values, np.nan)
    if by >= 0:
        moved[:, : values.shape[1] - by] = values[:, by:]
    else:
        moved[:, -by:] = values[:, :by]
    return moved


def _spacing(x: Floats) -> Floats:
    """Distance to the nearer neighbour, inf where there is none."""
    gap = np.nan_to_num(np.diff(x, axis=1), nan=np.inf)
    end = np.full((len(x), 1), np.inf, x.dtype)
    return np.minimum(np.hstack([end, gap]), np.hstack([gap, end]))


def _means(values: NDArray[np.floating], of_frame: Ints, place: Ints) -> Doubles:
    """Mean over the frames of each segment, (segments, places), NaN where there is nothing."""
    frame, k = np.nonzero(np.isfinite(values))
    column = place[frame] + k
    shape = (int(of_frame[-1]) + 1, int(column.max(initial=0)) + 1)
    index = of_frame[frame] * shape[1] + column
    count = np.bincount(index, minlength=shape[0] * shape[1])
    total = np.bincount(index, values[frame, k].astype(np.float64), minlength=shape[0] * shape[1])
    return np.where(count > 0, total / np.maximum(count, 1), np.nan).reshape(shape)
