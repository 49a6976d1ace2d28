"""Detections: one ridge per sheet and frame, or the reason why there is none.

`assign_detections` takes the pairs from `identify_sheets`, withholds those that are doubtful
(`vision.sheets.doubts`), and searches again with a lower threshold where a sheet is missing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from vision.memory import row_parts, some_rows, table_beside
from vision.numeric import (
    Bools,
    Codes,
    Floats,
    Floats32,
    Ints,
    beside,
    nan_median,
    nearest,
    stretches,
    typical_median,
    typical_rows,
    typical_where,
)
from vision.sheets.alignment import values_of
from vision.sheets.doubts import (
    LIKE_ITSELF,
    doubts_of,
    hops,
    numbered_by_a_neighbour,
    numbered_in_part,
    split,
    unlike_neighbours,
)
from vision.sheets.identities import DOUBTS, Doubt, Identities, exchanged, fill_rows, last_seen
from vision.sheets.ridges import RidgeComb, Ridges, find_ridges
from vision.words import is_word


class Flag(IntEnum):
    """Why a sheet has a position in a frame, or none, in one byte; see `track_sheets`."""

    OK, BLURRED, EDGE, MISSING, MERGED, UNFIT, LEFT_OUT, FROZEN, BLANK, CORRUPT, LOST, DOUBTFUL = range(12)


FLAGS = tuple(flag.name.lower() for flag in Flag)
"""Name of each `Flag`, as in tracks.csv."""
WITHOUT_RIDGE = ("missing", "edge", "unfit")
"""Flags of frames in which a sheet was looked for and has no position."""
LONG_GAP = 10
"""Number of successive frames without a ridge from which a sheet is named. Fewer would name sheets that
flicker at the edge of the picture; more would be silent where a sheet lacks a whole stick phase."""
FLAG_MEANINGS = {
    "ok": "measured",
    "blurred": "measured, with a larger error: the ridge moved while the shutter was open",
    "edge": "outside the picture",
    "missing": "no ridge",
    "merged": "several sheets, or a sheet and a mark, in one ridge",
    "unfit": "no fit, or partly hidden by what hides the next sheet",
    "left_out": "left out by a manual decision",
    "frozen": "the film repeats the frame before",
    "blank": "a blank frame",
    "corrupt": "a corrupt frame",
    "lost": "a lost frame",
    "doubtful": "the identity of the sheet is uncertain",
}
"""Meaning of each of `FLAGS`."""


@dataclass(frozen=True)
class Detections:
    """One ridge per sheet and frame, all (frame, N).

    start_px: whole pixel of the ridge, NaN where flag is not OK. contrast, fwhm_px: its prominence, grey
    levels, and its width. flag: a `Flag`, OK, MISSING, MERGED, EDGE or DOUBTFUL. why: a `Doubt`.
    withheld_px: whole pixel of a doubtful ridge, NaN elsewhere.
    """

    start_px: Floats32
    contrast: Floats32
    fwhm_px: Floats32
    flag: Codes
    why: Codes
    withheld_px: Floats32


def assign_detections(
    profile: Floats32, ridges: Ridges, identities: Identities, comb: RidgeComb
) -> Detections:
    """Return one ridge for each sheet in each frame of the profile (frame, x), or the reason why there is
    none.

    The expected position of a missing sheet follows from the displacement of its neighbours in the same
    frame. A ridge there that was too faint for the first search is accepted if it reaches a fraction of the
    sheet's usual contrast. Positions of uncertain identity (`Doubt`) are flagged DOUBTFUL and withheld.
    """
    paired = table_beside(profile, (3, *identities.match.shape[::-1]), np.float32).swapaxes(1, 2)
    for table, values in zip(paired, (ridges.x_px, ridges.contrast, ridges.fwhm_px), strict=True):
        table[:] = values_of(identities.match, values)
    why = doubts_of(identities.usual_px, paired[1], identities, comb)
    x, contrast = (np.where(why == Doubt.NONE, values, np.nan) for values in paired[:2])
    off = exchanged(x, contrast, identities.margin, comb)
    del x, contrast
    why[off & (why == Doubt.NONE)] = Doubt.EXCHANGE
    sample = typical_rows(len(why))  # shows usual contrasts and widths
    certain = np.where(why[sample] == Doubt.NONE, paired[1:, sample], np.nan)
    _reassign_hops(ridges, paired, why, comb)
    why[_alone_and_away(np.where(why == Doubt.NONE, paired[0], np.float32(np.nan)), comb)] = Doubt.ALONE
    expected = _expected(np.where(why == Doubt.NONE, paired[0], np.nan), identities.rest_px)
    off = numbered_by_a_neighbour(ridges, identities.match, paired, certain, expected, comb)
    del expected
    why[off & (why == Doubt.NONE)] = Doubt.NEIGHBOUR
    why[numbered_in_part(paired[1:], why == Doubt.NONE, certain, comb.settings)] = Doubt.PATTERN
    off = split(ridges, identities.match, paired, certain)
    why[off & (why == Doubt.NONE)] = Doubt.SPLIT
    doubtful, unpaired = why != Doubt.NONE, np.isnan(paired[0])
    withheld = table_beside(profile, unpaired.shape, np.float32, "F")
    withheld[:] = np.where(doubtful, paired[0], np.nan)
    found = paired
    found[:, doubtful] = np.nan
    expected = _expected(found[0], identities.rest_px)
    rows, sheet, faint = _faint_ridges(profile, found, expected, doubtful, comb)
    if len(rows):  # some of these may be ridges that are near by chance
        found[:, rows, sheet] = faint
        off = hops(unlike_neighbours(found[0]), comb)
        found[:, off & unpaired] = np.nan
    flag = np.where(np.isfinite(found[0]), Flag.OK, Flag.MISSING).astype(np.uint8)
    flag[_merged(found, expected, comb)] = Flag.MERGED
    half = comb.fwhm_px / 2
    outside = (expected < half) | (expected > profile.shape[1] - 1 - half)
    flag[(flag != Flag.OK) & outside] = Flag.EDGE
    flag[doubtful] = Flag.DOUBTFUL
    found[:, flag != Flag.OK] = np.nan
    start, contrast, fwhm = found
    return Detections(start, contrast, fwhm, flag, why, withheld)


def _reassign_hops(ridges: Ridges, paired: Floats32, why: Codes, comb: RidgeComb) -> None:
    """Give each sheet that hopped to another ridge the ridge at its predicted position, or doubt it. A ridge
    that another sheet has is not given. Positions, contrasts and widths of the paired ridges, (3, frame, N),
    and doubts are changed in place."""
    for _ in range(4):  # each pass finds the largest residual among neighbours and sets that sheet aside
        x = np.where(why == Doubt.NONE, paired[0], np.float32(np.nan))
        residual = unlike_neighbours(x)
        off = hops(residual, comb)
        if not off.any():
            break
        frame, sheet = np.nonzero(off)
        best, distance = nearest(ridges.x_px[frame], x[off] - residual[off])
        looks = (ridges.x_px, ridges.contrast, ridges.fwhm_px)
        candidate = np.stack([values[frame, best] for values in looks])
        there, height = candidate[:2].astype(np.float64)
        accept = (distance <= comb.settings.faint_reach * comb.pitch_px) & (there != x[off])
        usual = typical_where(why == Doubt.NONE, np.log(paired[1].astype(np.float64)))[sheet]
        accept &= np.abs(np.log(height) - usual) < LIKE_ITSELF
        accept &= ~(np.where(off[frame], np.nan, paired[0][frame]) == there[:, None]).any(axis=1)
        accept &= _unshared(frame, there, accept)
        why[frame[~accept], sheet[~accept]] = Doubt.HOP
        paired[:, frame[accept], sheet[accept]] = candidate[:, accept]


def _alone_and_away(x: Floats32, comb: RidgeComb) -> Bools:
    """Return which ridges lie where the sheet is not and which no neighbour confirms, (frame, N). They lie
    more than half a pitch outside the range between the sheet's confirmed positions before and after. The
    edge of what hides the sheets around may look like a ridge."""
    away, rows = np.zeros(x.shape, bool), np.flatnonzero(np.isnan(x).any(axis=1))
    if x.shape[1] < 3 or not len(rows):  # no neighbours predict, or all sheets are seen
        return away
    away[rows] = np.isfinite(x[rows]) & np.isnan(unlike_neighbours(x[rows]))
    some = np.flatnonzero(away.any(axis=0))
    own = x[:, some].T.astype(np.float64)
    confirmed = np.where(away[:, some].T, np.nan, own)
    before, after = last_seen(confirmed), last_seen(confirmed[:, ::-1])[:, ::-1]
    off_px = np.fmax(np.fmin(before, after) - own, own - np.fmax(before, after)).T
    away[:, some] &= off_px > comb.pitch_px / 2
    return away


# --- the second search --------------------------------------------------------------------------------------


def _expected(start: Floats32, rest: Floats) -> Floats:
    """Return rest positions plus the displacement of the neighbours, in frames in which a sheet is missing.
    NaN in all other frames, and where fewer than half of the sheets are detected."""
    expected = np.full(start.shape, np.nan)
    rows = np.isnan(start).any(axis=1) & (np.isfinite(start).mean(axis=1) >= 0.5)
    expected[rows] = rest[rows] + fill_rows(start[rows] - rest[rows], typical_median(rest))
    return expected


def _faint_ridges(
    profile: Floats32, found: Floats32, expected: Floats, doubtful: Bools, comb: RidgeComb
) -> tuple[Ints, Ints, Floats]:
    """Return faint ridges at the expected positions of missing sheets: frame, sheet, and position, contrast
    and width (3, ridges). `found` holds these for the sheets already detected, (3, frame, N)."""
    wanted = np.isnan(found[0]) & np.isfinite(expected) & ~doubtful
    missing = np.flatnonzero(wanted.any(axis=1))
    usual = np.nan_to_num(nan_median(found[1])) if len(missing) else np.zeros(0)  # contrasts
    none = np.zeros(0, np.int64)
    parts = [(none, none, np.zeros((3, 0)))]
    for part in row_parts(len(missing)):
        rows = missing[part]
        faint = find_ridges(some_rows(profile, rows), replace(comb, contrast=0.0))
        row, sheet = np.nonzero(wanted[rows])
        frame = rows[row]
        best, distance = nearest(faint.x_px[row], expected[frame, sheet])
        there = np.stack([faint.x_px, faint.contrast, faint.fwhm_px])[:, row, best].astype(np.float64)
        keep = (distance <= comb.settings.faint_reach * comb.pitch_px) & (
            there[1] >= comb.settings.faint_contrast * usual[sheet]
        )
        keep &= nearest(found[0, frame], there[0])[1] > 0.5 * comb.fwhm_px
        keep &= _unshared(frame, there[0], keep)
        parts.append((frame[keep], sheet[keep], there[:, keep]))
    frame, sheet, there = (np.concatenate(one, axis=-1) for one in zip(*parts, strict=True))
    return frame, sheet, there


def _unshared(frame: Ints, x: Floats, keep: Bools) -> Bools:
    """Return False for kept entries that share (frame, x) with another kept entry: no ridge is given to two
    sheets."""
    _, which, counts = np.unique(
        np.stack([frame[keep], x[keep]]), axis=1, return_inverse=True, return_counts=True
    )
    unshared = np.ones(len(frame), bool)
    unshared[keep] = counts[which.ravel()] == 1
    return unshared


def _merged(found: Floats32, expected: Floats, comb: RidgeComb) -> Bools:
    """Return which missing sheets form one ridge with a detected neighbour, and these neighbours, (frame, N).
    Their expected positions are within a ridge's width of each other, or the neighbour is as high or as wide
    as two sheets. `found` holds positions, contrasts and widths (3, frame, N)."""
    missing = np.isnan(found[0])
    if not missing.any():
        return np.zeros_like(missing)
    beside_missing = beside(missing)
    # the usual size is that without a missing neighbour, which may be missing in most frames
    usual = np.stack([typical_where(~beside_missing, sizes) for sizes in found[1:]])
    usual = np.where(np.isfinite(usual), usual, nan_median(found[1:], axis=1))
    pair = np.zeros((len(missing), missing.shape[1] - 1), bool)
    some = np.flatnonzero(missing.any(axis=1))
    for part in row_parts(len(some)):
        rows = some[part]
        size = found[1:, rows] / usual[:, None]
        size /= nan_median(size, axis=2)[..., None]  # exposure, focus
        double = (size[0] > comb.settings.merged_height) | (size[1] > comb.settings.merged_width)
        apart = np.abs(np.diff(np.where(missing[rows], expected[rows], found[0, rows]), axis=1))
        near = apart < comb.settings.merged_widths * comb.fwhm_px
        one = missing[rows, 1:] ^ missing[rows, :-1]
        pair[rows] = (near | double[:, 1:] | double[:, :-1]) & one
    padded = np.pad(pair, ((0, 0), (1, 1)))
    return np.asarray(padded[:, 1:] | padded[:, :-1], bool)  # both sheets of each pair


# --- doubtful identities as a table -------------------------------------------------------------------------


def doubtful_stretches(tracks: xr.Dataset) -> pd.DataFrame:
    """List the doubtful identities: one row per sheet and unbroken stretch of frames, the longest first.

    Parameters
    ----------
    tracks
        From `vision.track_sheets`.

    Returns
    -------
    pandas.DataFrame
        sheet, side, n; first_frame and last_frame, frames; why (in words); x_withheld_px, the doubtful ridge,
        and x_expected_px, the position that the neighbours predict, both in the first frame (NaN if unknown).
    """
    table = _stretches(tracks, ("doubtful",), ("why", "x_withheld_px", "x_expected_px"))
    return table.assign(why=[DOUBTS.get(str(why), "identity not certain") for why in table["why"]])


def missing_stretches(tracks: xr.Dataset) -> pd.DataFrame:
    """List where a sheet has no ridge in `LONG_GAP` successive frames or more, as `doubtful_stretches` does:
    sheet, side, n, first_frame, last_frame, frames, flag (in the first of them)."""
    table = _stretches(tracks, WITHOUT_RIDGE, ("flag",))
    return table[table["frames"] >= LONG_GAP]


def _stretches(tracks: xr.Dataset, flags: Sequence[str], more: Sequence[str]) -> pd.DataFrame:
    """Return the unbroken stretches with these flags, the longest first, with further variables of the tracks
    in the first frame of each."""
    sheet, first, stop = stretches(is_word(tracks["flag"], *flags))
    number = tracks["frame"].values

    def at_first(name: str) -> Any:
        if name not in tracks or not len(first):  # xarray before 2026.7 fails at no place in a lazy table
            return np.full(len(first), np.nan)
        at = {"frame": xr.DataArray(first, dims="one"), "sheet": xr.DataArray(sheet, dims="one")}
        return tracks[name].isel(at).values

    found = {
        "sheet": sheet,
        "side": tracks["side"].values[sheet],
        "n": tracks["n"].values[sheet],
        "first_frame": number[first],
        "last_frame": number[stop - 1],
        "frames": stop - first,
    }
    table = pd.DataFrame(found | {name: at_first(name) for name in more})
    return table.sort_values("frames", ascending=False, kind="stable", ignore_index=True)
