"""Runs of frames through which every candidate can be followed without doubt."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vision.sheets.alignment import Candidates
from vision.sheets.ridges import Ridges

Doubles = NDArray[np.float64]
Ints = NDArray[np.int64]

STEP_SHARE = 0.3  # of the spacing to the nearer neighbour: a smaller step cannot be mistaken


CHANGE_FACTOR = 5.0  # times the typical change of the brightnesses between frames: another comb stands there
LEAST_CHANGE = 0.2  # natural logarithm


@dataclass(frozen=True)
class Segments:
    """Runs of frames with equally many candidates, none of which moves far between frames.

    start, length: first frame and number of frames, (segments,).  candidates: their mean position and log
    contrast.
    """

    start: Ints
    length: Ints
    candidates: Candidates

    def of_frames(self) -> Ints:
        """Segment of every frame (frame,)."""
        return np.repeat(np.arange(len(self.start)), self.length)


def split_segments(ridges: Ridges, pitch_px: float) -> Segments:
    """Cut the recording where a candidate comes, goes or jumps.

    Inside a segment the k-th candidate of one frame is the k-th of the next: counts are equal and every
    step is below 0.3 of the spacing to the nearer neighbour (or of the pitch, if smaller). A comb that
    jumps by a whole pitch so that one sheet leaves the picture as another enters looks still; its
    brightnesses change, and so it is cut.
    """
    x = ridges.x_px.astype(np.float64)
    room = np.fmin(_spacing(x), pitch_px)
    step = np.abs(np.diff(x, axis=0)) / np.fmin(room[1:], room[:-1])
    same_count = np.diff(ridges.count) == 0
    still = np.where(np.isnan(step), 0.0, step).max(axis=1, initial=0.0) < STEP_SHARE
    log_contrast = np.log(ridges.contrast.astype(np.float64))
    change = _brightness_change(log_contrast)
    steady = change <= max(LEAST_CHANGE, CHANGE_FACTOR * float(np.median(change)) if len(change) else 0.0)
    start = np.r_[0, 1 + np.flatnonzero(~(same_count & still & steady))].astype(np.int64)
    length = np.diff(np.r_[start, len(x)])
    log_width = np.log(ridges.fwhm_px.astype(np.float64))
    tables = [_means(values, start, length) for values in (x, log_contrast, log_width)]
    candidates = Candidates(*tables)
    return Segments(start, length, candidates)


def _brightness_change(log_contrast: Doubles) -> Doubles:
    """Root mean square change of log contrast from frame to frame, over the candidates, (frame − 1,)."""
    change = np.diff(log_contrast, axis=0)
    known = np.isfinite(change)
    total = np.where(known, change**2, 0.0).sum(axis=1)
    return np.asarray(np.sqrt(total / np.maximum(known.sum(axis=1), 1)), np.float64)


def _spacing(x: Doubles) -> Doubles:
    """Distance to the nearer neighbour, inf where there is none."""
    gap = np.nan_to_num(np.diff(x, axis=1), nan=np.inf)
    end = np.full((len(x), 1), np.inf)
    return np.asarray(np.minimum(np.hstack([end, gap]), np.hstack([gap, end])), np.float64)


def _means(values: Doubles, start: Ints, length: Ints) -> Doubles:
    return np.asarray(np.add.reduceat(values, start, axis=0) / length[:, None], np.float64)
