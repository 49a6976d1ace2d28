"""Where each sheet is seen in each frame, faint glimpses included, and why it is not where it is not."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vision.sheets.alignment import CROSSING_COST, EDGE_REACH, STAY_COST
from vision.sheets.comb import Comb
from vision.sheets.linking import Links, fill_rows
from vision.sheets.medians import nan_median
from vision.sheets.ridges import Ridges, find_ridges

Doubles = NDArray[np.float64]

DOUBT = 3.0  # nats: odds below 20 to 1
# in a comb without ends that leaps by pitches: what staying and edges alone can bring, and a little
LEAP_DOUBT = STAY_COST + 2 * CROSSING_COST + 1.0
GLIMPSE_REACH = 0.3  # of the pitch: a faint ridge this near to where a missing sheet must be is that sheet
GLIMPSE_CONTRAST = 0.2  # of the sheet's usual contrast
TEAR = 0.6  # of the pitch: neighbours' displacements differ by less, even in a slip
LEAST_SEEN = 0.5  # of the sheets: below this a frame does not tell where a missing one must be
MERGED = 0.8  # of the ridge width: two sheets this near to each other are one ridge


@dataclass(frozen=True)
class Sightings:
    """start_px: whole pixel of the ridge, NaN where flag is not "ok"; contrast, grey levels; fwhm_px; flag:
    "ok",
    "missing", "merged", "edge" or "doubtful". All (frame, N).
    """

    start_px: Doubles
    contrast: Doubles
    fwhm_px: Doubles
    flag: NDArray[np.str_]


def sightings(profile: NDArray[np.float32], ridges: Ridges, links: Links, comb: Comb) -> Sightings:
    """Candidates paired with sheets, and for sheets that went missing a second, closer look.

    Where a missing sheet must be follows from its neighbours' displacement in the same frame. A ridge there
    that was too faint for the first search is taken if it reaches a fifth of the sheet's usual contrast.
    Positions whose identity is not certain (margin below 3 nats, displaced unlike the other sheets, or in a
    comb without ends that leapt by pitches) are flagged "doubtful" and not given.
    """
    doubtful = (links.match >= 0) & ~(links.margin >= DOUBT)
    found = np.where(links.match >= 0, _paired(ridges.x_px, links), np.nan)
    doubtful |= _torn(found - links.rest_px, comb)
    doubtful |= _leapt(found, links, comb, profile.shape[1])
    sure = (links.match >= 0) & ~doubtful
    table = [_paired(values, links) for values in (ridges.x_px, ridges.contrast, ridges.fwhm_px)]
    start, contrast, fwhm = (np.where(sure, values, np.nan) for values in table)
    expected = _expected(start, links.rest_px)
    rows, sheet, values = _glimpses(profile, start, contrast, expected, doubtful, comb)
    start[rows, sheet], contrast[rows, sheet], fwhm[rows, sheet] = values
    flag = np.where(np.isfinite(start), "ok", "missing").astype("<U8")
    flag[_merged(start, expected, comb)] = "merged"
    half = comb.fwhm_px / 2
    outside = (expected < half) | (expected > profile.shape[1] - 1 - half)
    flag[(flag != "ok") & outside] = "edge"
    flag[doubtful] = "doubtful"
    seen = flag == "ok"
    start, contrast, fwhm = (np.where(seen, values, np.nan) for values in (start, contrast, fwhm))
    return Sightings(start, contrast, fwhm, flag)


def _torn(moved: Doubles, comb: Comb) -> NDArray[np.bool_]:
    """Sheets on the smaller side of a tear: neighbours displaced from their resting places by very different
    amounts, in one frame.

    A slip moves neighbours alike, however far; what does not is a wrong identity, or as good as one.
    Tears cut the sheets of a frame into groups, and all but the largest group are doubtful.
    """
    frames, sheets = moved.shape
    seen = np.isfinite(moved)
    before = np.hstack([np.full((frames, 1), np.nan), _last_seen(moved)[:, :-1]])
    group = np.cumsum(np.abs(moved - before) > TEAR * comb.pitch_px, axis=1)
    key = (group + sheets * np.arange(frames)[:, None])[seen]
    size = np.bincount(key, minlength=frames * sheets).reshape(frames, sheets)
    own = np.take_along_axis(size, group, axis=1)
    return np.asarray(seen & (own < size.max(axis=1, keepdims=True)), bool)


def _leapt(x: Doubles, links: Links, comb: Comb, width_px: int) -> NDArray[np.bool_]:
    """Frames in which a comb that fills the picture stands whole pitches from where it mostly does.

    With neither end in view, only brightness tells such a leap from none: what rests on less is doubtful.
    """
    seen = np.flatnonzero(np.isfinite(x).any(axis=1))
    step = np.nan_to_num(nan_median(np.diff(x[seen], axis=0), axis=1)) / comb.pitch_px
    leap = np.where(np.abs(step) > TEAR, np.rint(step), 0).astype(np.int64)
    place = np.zeros(len(x), np.int64)
    place[seen[1:]] = np.cumsum(leap)
    values, counts = np.unique(place[seen], return_counts=True)
    usual = values[np.argmax(counts)] if len(values) else 0
    reach = EDGE_REACH * comb.pitch_px
    filled = (links.rest_px[:, 0] < reach) & (links.rest_px[:, -1] > width_px - 1 - reach)
    return np.asarray((filled & (place != usual))[:, None] & (links.margin < LEAP_DOUBT), bool)


def _last_seen(values: Doubles) -> Doubles:
    """NaN replaced by the last value before it in the row."""
    number = np.where(np.isfinite(values), np.arange(values.shape[1]), 0)
    return np.asarray(np.take_along_axis(values, np.maximum.accumulate(number, axis=1), axis=1), np.float64)


def _paired(values: NDArray[np.float32], links: Links) -> Doubles:
    return np.take_along_axis(values.astype(np.float64), np.maximum(links.match, 0), axis=1)


def _expected(start: Doubles, rest: Doubles) -> Doubles:
    """Where each sheet must be in each frame: its resting place moved as its neighbours are; NaN with few in
    view."""
    moved = fill_rows(start - rest, np.median(rest, axis=0))
    enough = np.isfinite(start).mean(axis=1) >= LEAST_SEEN
    return np.where(enough[:, None], rest + moved, np.nan)


def _glimpses(
    profile: NDArray[np.float32],
    start: Doubles,
    contrast: Doubles,
    expected: Doubles,
    doubtful: NDArray[np.bool_],
    comb: Comb,
) -> tuple[NDArray[np.int64], NDArray[np.int64], tuple[Doubles, ...]]:
    """Faint ridges where missing sheets must be: frame, sheet, and (x, contrast, width) of each."""
    wanted = np.isnan(start) & np.isfinite(expected) & ~doubtful
    rows = np.flatnonzero(wanted.any(axis=1))
    if not len(rows):
        nothing = np.zeros(0, np.int64)
        return nothing, nothing, (np.zeros(0),) * 3
    faint = find_ridges(profile[rows], replace(comb, contrast=0.0))
    row, sheet = np.nonzero(wanted[rows])
    frame = rows[row]
    distance = np.abs(faint.x_px[row] - expected[frame, sheet][:, None])
    distance = np.where(np.isfinite(distance), distance, np.inf)
    best = np.argmin(distance, axis=1)
    x, height, width = (v[row, best].astype(np.float64) for v in (faint.x_px, faint.contrast, faint.fwhm_px))
    usual = np.nan_to_num(nan_median(contrast, axis=0))[sheet]
    near = np.take_along_axis(distance, best[:, None], axis=1)[:, 0] <= GLIMPSE_REACH * comb.pitch_px
    own = np.nan_to_num(np.abs(start[frame] - x[:, None]), nan=np.inf).min(axis=1, initial=np.inf)
    keep = near & (height >= GLIMPSE_CONTRAST * usual) & (own > 0.5 * comb.fwhm_px)
    keep &= _first_of_each(frame, x, keep)
    return frame[keep], sheet[keep], (x[keep], height[keep], width[keep])


def _first_of_each(frame: NDArray[np.int64], x: Doubles, keep: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """No ridge is given to two sheets: True for the entries whose (frame, x) no kept entry has in common."""
    _, which, counts = np.unique(
        np.stack([frame[keep], x[keep]]), axis=1, return_inverse=True, return_counts=True
    )
    alone = np.ones(len(frame), bool)
    alone[keep] = counts[which.ravel()] == 1
    return alone


def _merged(start: Doubles, expected: Doubles, comb: Comb) -> NDArray[np.bool_]:
    """Missing sheets that must be within a ridge's width of a neighbour that is seen, and those
    neighbours."""
    gone = np.isnan(start) & np.isfinite(expected)
    close = np.abs(np.diff(np.where(gone, expected, start), axis=1)) < MERGED * comb.fwhm_px
    pair = close & (gone[:, 1:] ^ gone[:, :-1])
    none = np.zeros((len(start), 1), bool)
    return np.asarray(np.hstack([pair, none]) | np.hstack([none, pair]), bool)
