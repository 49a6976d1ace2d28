"""Identities: every sheet keeps its index through every slip, or the doubt is said."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vision.sheets.alignment import Alignment, align
from vision.sheets.choice import standing_still
from vision.sheets.comb import Comb
from vision.sheets.medians import nan_median
from vision.sheets.reference import Model, build_model
from vision.sheets.ridges import Ridges
from vision.sheets.segments import split_segments

Doubles = NDArray[np.float64]
Ints = NDArray[np.int64]

# Frames whose median position is "where the sheet was", robust against slips and ringing
FRAMES_PER_REST = 32
SEEN_SHARE = 0.25  # of those frames: seen less often, a sheet's place is taken from its neighbours
ROUNDS = 2


@dataclass(frozen=True)
class Links:
    """match: candidate of each sheet in each frame, −1 where missing, (frame, N).  margin: nats by which
    this identity
    beats the next, (frame, N).  rest_px: where each sheet was around that time, (frame, N).  model: the comb.
    """

    match: Ints
    margin: Doubles
    rest_px: Doubles
    model: Model


def link(
    ridges: Ridges, comb: Comb, *, width_px: int, sheets: int | None = None, source: str = "the strip"
) -> Links:
    """Pair the candidates of all frames with the sheets.

    Frames are first joined to segments in which nothing can be mistaken; one comb is found that most of
    the recording agrees on; then all segments are aligned with that comb at once, and again with each
    sheet expected where it was found around that time. No frame depends on the one before, so a mistake
    cannot spread.

    Args: ridges, candidates per frame; comb; width_px, of the profile; sheets, their number where known.
    Raises: InputError where there are no ridges or fewer than `sheets`.
    """
    segments = split_segments(ridges, comb, width_px=width_px)
    model = build_model(segments, comb, width_px=width_px, sheets=sheets, source=source)

    def aligned(model: Model, rest: Doubles) -> Alignment:
        middle = rest[segments.start + segments.length // 2]
        reference = model.reference(middle, comb, width_px, open_ended=sheets is None)
        return align(segments.candidates, reference)

    match = aligned(model, np.broadcast_to(model.x_px, (len(ridges.x_px), model.sheets))).match
    model, match = _without_marks(model, segments.in_frames(match, ridges.count), ridges, sheets)
    for _ in range(ROUNDS):
        rest = _resting_places(_positions(ridges, match), model)
        alignment = aligned(model, rest)
        before, match = match, segments.in_frames(alignment.match, ridges.count)
        if np.array_equal(before, match):
            break
    margin = np.where(match >= 0, alignment.margin[segments.of_frames()], np.nan)
    return Links(match, margin, rest, model)


def _without_marks(model: Model, match: Ints, ridges: Ridges, sheets: int | None) -> tuple[Model, Ints]:
    """Take out what stands still while its neighbours move (unless the number of sheets was given)."""
    if sheets is not None:
        return model, match
    x = _positions(ridges, match)
    still = standing_still(x - _resting_places(x, model), model.x_px)
    return model.only(np.flatnonzero(~still)), match[:, ~still]


def _positions(ridges: Ridges, match: Ints) -> Doubles:
    x = np.take_along_axis(ridges.x_px.astype(np.float64), np.maximum(match, 0), axis=1)
    return np.where(match >= 0, x, np.nan)


def _resting_places(x_px: Doubles, model: Model) -> Doubles:
    """Median position of each sheet over about thirty frames, on every frame; gaps filled from neighbours
    and time."""
    frames = len(x_px)
    blocks = max(1, round(frames / FRAMES_PER_REST))
    edges = np.linspace(0, frames, blocks + 1).astype(int)
    size = int(np.diff(edges).max())
    index = np.minimum(edges[:-1, None] + np.arange(size), edges[1:, None] - 1)
    moved = x_px[index] - model.x_px
    seldom = np.isfinite(moved).mean(axis=1) < SEEN_SHARE
    moved = np.where(seldom, np.nan, nan_median(moved, axis=1))
    moved = fill_rows(fill_rows(moved, model.x_px).T, np.arange(blocks, dtype=np.float64)).T
    at = np.searchsorted(edges[1:], np.arange(frames), side="right")
    return np.asarray(model.x_px + np.nan_to_num(moved)[np.minimum(at, blocks - 1)], np.float64)


def fill_rows(values: Doubles, at: Doubles) -> Doubles:
    """NaN replaced by linear interpolation along each row, ends held; rows of NaN stay NaN.

    Args: values (rows, columns); at, ascending abscissa of the columns.
    """
    known = np.isfinite(values)
    number = np.arange(values.shape[1])
    left = np.maximum.accumulate(np.where(known, number, -1), axis=1)
    right = np.minimum.accumulate(np.where(known, number, len(number))[:, ::-1], axis=1)[:, ::-1]
    lower = np.where(left < 0, right, left)
    upper = np.where(right >= len(number), left, right)
    usable = (lower >= 0) & (lower < len(number)) & (upper >= 0)
    lower, upper = np.where(usable, lower, 0), np.where(usable, upper, 0)
    span = at[upper] - at[lower]
    share = np.where(span > 0, (at - at[lower]) / np.where(span > 0, span, 1), 0.0)
    low = np.take_along_axis(values, lower, axis=1)
    filled = low + share * (np.take_along_axis(values, upper, axis=1) - low)
    return np.where(usable, filled, np.nan)
