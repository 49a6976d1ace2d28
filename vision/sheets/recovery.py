"""Detections: one ridge per sheet and frame, or the reason why there is none.

`assign_detections` takes the pairs from `identify_sheets`, withholds those that are doubtful, and searches
again with a lower threshold where a sheet is missing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from vision.numeric import Bools, Floats, Floats32, Ints, Strings, nan_median, nearest
from vision.sheets.alignment import values_of
from vision.sheets.identities import Identities, fill_rows
from vision.sheets.neighbours import (
    anchored,
    hops,
    last_seen,
    neighbour_residual,
    pattern_shift,
    rest_positions,
    torn,
)
from vision.sheets.ridges import RidgeComb, Ridges, find_ridges
from vision.sheets.settings import TrackingSettings

LIKE_ITSELF = 0.7
"""Change of log contrast up to which a ridge may be the sheet that is expected there: a factor of two."""


@dataclass(frozen=True)
class Detections:
    """One ridge per sheet and frame, all (frame, N).

    start_px: whole pixel of the ridge, NaN where flag is not "ok". contrast, fwhm_px: its prominence, grey
    levels, and its width. flag: "ok", "missing", "merged", "edge" or "doubtful". why: reason for a doubtful
    identity, a key of `DOUBTS`; "" elsewhere. withheld_px: whole pixel of a doubtful ridge, NaN elsewhere.
    """

    start_px: Floats
    contrast: Floats
    fwhm_px: Floats
    flag: Strings
    why: Strings
    withheld_px: Floats


def assign_detections(
    profile: Floats32, ridges: Ridges, identities: Identities, comb: RidgeComb
) -> Detections:
    """Return one ridge for each sheet in each frame of the profile (frame, x), or the reason why there is
    none.

    The expected position of a missing sheet follows from the displacement of its neighbours in the same
    frame. A ridge there that was too faint for the first search is accepted if it reaches a fraction of the
    sheet's usual contrast. Positions of uncertain identity (`DOUBTS`) are flagged "doubtful" and withheld.
    """
    candidates = np.stack([ridges.x_px, ridges.contrast, ridges.fwhm_px])
    paired = np.stack([values_of(identities.match, values) for values in candidates])
    usual = np.stack([identities.squeeze.undone(paired[0]), *paired[1:]])
    why = _doubts(usual, identities, comb)
    why[_numbered_off_the_end(candidates[:2], paired[:2], comb)] = "end"
    why[_shifted_pattern(np.where(why == "", paired, np.nan), comb.settings)] = "pattern"
    paired, why = _reassign_hops(candidates, paired, why, comb)
    doubtful = why != ""
    withheld = np.where(doubtful, paired[0], np.nan)
    found = np.where(doubtful, np.nan, paired)
    expected = _expected(found[0], identities.rest_px)
    rows, sheet, faint = _faint_ridges(profile, found, expected, doubtful, comb)
    if len(rows):  # some of these may be ridges that are near by chance
        found[:, rows, sheet] = faint
        found[:, hops(neighbour_residual(found[0]), comb) & np.isnan(paired[0])] = np.nan
    flag = np.where(np.isfinite(found[0]), "ok", "missing").astype("<U8")
    flag[_merged(found, expected, comb)] = "merged"
    flag[_hidden(found[0], doubtful, comb)] = "merged"
    half = comb.fwhm_px / 2
    outside = (expected < half) | (expected > profile.shape[1] - 1 - half)
    flag[(flag != "ok") & outside] = "edge"
    flag[doubtful] = "doubtful"
    start, contrast, fwhm = np.where(flag == "ok", found, np.nan)
    return Detections(start, contrast, fwhm, flag, why, withheld)


# --- doubt --------------------------------------------------------------------------------------------------

DOUBTS = {
    "margin": "another numbering fits nearly as well",
    "tear": "displaced differently from the largest group of sheets",
    "end": "a ridge beyond the comb is like the sheets, while the sheet at the other end is missing",
    "jump": "displaced by a jump that could be one of whole pitches",
    "pattern": "brightnesses and widths fit another numbering: the comb may have jumped by whole pitches",
    "hop": "on another ridge, away from the position that the neighbours predict",
}
"""Meaning of each `Detections.why`."""


def _doubts(paired: Floats, identities: Identities, comb: RidgeComb) -> Strings:
    """Return why the identity of each paired ridge is doubtful (margin, jump, tear) or "", (frame, N).

    A margin that is too small is no doubt where the pattern confirms the identity. `paired` holds positions,
    contrasts and widths, (3, frame, N).
    """
    x, contrast, fwhm = paired
    why = np.full(x.shape, "", "<U9")
    why[~(identities.margin >= comb.settings.doubt)] = "margin"
    displaced = x - rest_positions(x)
    why[_unproved_jumps(x, displaced, contrast, identities, comb)] = "jump"
    why[torn(displaced, comb)] = "tear"
    why[np.isnan(x)] = ""
    unsettled = why == "margin"
    if unsettled.any():
        known = np.where(why == "tear", np.nan, x)
        trusted = np.isfinite(known) & (why == "")
        why[unsettled & anchored(known, np.log(contrast), np.log(fwhm), trusted, comb)] = ""
    return why


def _numbered_off_the_end(candidates: Floats32, paired: Floats, comb: RidgeComb) -> Bools:
    """Return where a displaced comb leaves out a ridge at one end while its other end is missing, (frame, N).

    If the ridge beyond the end is like the sheets, the frame has as many ridges as the comb has sheets, and
    another numbering pairs all of them. In a comb that is displaced by less than half of `jump_fraction`, a
    sheet from beyond the end has come into view. candidates and paired hold positions and contrasts,
    (2, frame, K) and (2, frame, N).
    """
    x, contrast = paired
    moved = nan_median(x - rest_positions(x), axis=1)
    rows = np.flatnonzero(np.abs(moved) > 0.5 * comb.settings.jump_fraction * comb.pitch_px)
    ridge, height = candidates[:, rows].astype(np.float64)
    alike = np.abs(np.log(height / nan_median(contrast[rows], axis=1)[:, None])) < LIKE_ITSELF
    off = np.zeros(len(x), bool)
    for way in (1, -1):  # a ridge beyond the last sheet, then one before the first
        place = way * x[rows, ::way]
        beyond = (way * ridge - np.fmax.reduce(place, axis=1)[:, None]) / comb.pitch_px
        off[rows] |= np.isnan(place[:, 0]) & (alike & (beyond > 0.5) & (beyond < 1.5)).any(axis=1)
    return np.asarray(off[:, None] & np.isfinite(x), bool)


def _shifted_pattern(certain: Floats, settings: TrackingSettings) -> Bools:
    """Return where brightnesses and widths fit another numbering than in most frames, (frame, N).

    certain: positions, contrasts and widths (3, frame, N), NaN where doubtful. Frames in which at most half
    of the sheets are certain are ignored.
    """
    seen = np.isfinite(certain[0])
    rows = np.flatnonzero(seen.mean(axis=1) > 0.5)
    away = np.zeros(seen.shape, bool)
    if len(rows):
        log_contrast, log_width = np.log(certain[1:, rows])
        shift = pattern_shift(log_contrast, log_width, settings)
        shifts, counts = np.unique(shift, return_counts=True)
        away[rows] = seen[rows] & (shift != shifts[counts.argmax()])[:, None]
    return away


def _reassign_hops(
    candidates: Floats32, paired: Floats, why: Strings, comb: RidgeComb
) -> tuple[Floats, Strings]:
    """Give each sheet that hopped to another ridge the ridge at its predicted position, or doubt it.

    A ridge that another sheet has is not given. candidates and paired hold positions, contrasts and widths,
    (3, frame, K) and (3, frame, N).
    """
    for _ in range(4):  # each pass finds the largest residual among neighbours and sets that sheet aside
        x = np.where(why == "", paired[0], np.nan)
        residual = neighbour_residual(x)
        off = hops(residual, comb)
        if not off.any():
            break
        frame, sheet = np.nonzero(off)
        best, distance = nearest(candidates[0, frame], (x - residual)[off])
        there, height = candidates[:2, frame, best].astype(np.float64)
        accept = (distance <= comb.settings.faint_reach * comb.pitch_px) & (there != x[off])
        usual = nan_median(np.log(np.where(why == "", paired[1], np.nan)))[sheet]
        accept &= np.abs(np.log(height) - usual) < LIKE_ITSELF
        accept &= ~(np.where(off, np.nan, paired[0])[frame] == there[:, None]).any(axis=1)
        accept &= _unshared(frame, there, accept)
        why, paired = why.copy(), paired.copy()
        why[frame[~accept], sheet[~accept]] = "hop"
        paired[:, frame[accept], sheet[accept]] = candidates[:, frame[accept], best[accept]]
    return paired, why


def _unproved_jumps(
    x: Floats, displaced: Floats, contrast: Floats, identities: Identities, comb: RidgeComb
) -> Bools:
    """Return where the comb is displaced by a jump that could be one of whole pitches, (frame, N).

    Jumps divide the film into runs of frames. Where the comb is not at its usual place, the margin must
    exceed the cost of staying there; with neither end in view, where only brightness shows a jump, it must
    also exceed the costs of sheets that cross the edges. After a real jump every sheet keeps its brightness.
    Where brightnesses changed by more than `least_misfit`, the costs mistake changed sheets for exchanged
    ones, and the margin required grows by the ratio of the squares: the overdispersion of a quasi-likelihood
    (McCullagh & Nelder 1989, chapter 9). `displaced` is x less the rest positions.
    """
    settings = comb.settings
    seen = np.isfinite(x).any(axis=1)
    step = np.nan_to_num(nan_median(np.diff(x[seen], axis=0), axis=1))
    run = np.zeros(len(x), np.int64)
    run[np.flatnonzero(seen)[1:]] = np.abs(step) > settings.jump_fraction * comb.pitch_px
    run = np.cumsum(run)
    moved = nan_median(displaced, axis=1)
    place = np.array([nan_median(moved[run == one]) for one in range(run[-1] + 1)])
    apart = np.abs(place - place[:, None]) / (settings.step_fraction * comb.pitch_px)
    away = apart[np.argmax((apart < 0.5) @ np.bincount(run))][run] > 1
    if not away.any():
        return np.zeros(x.shape, bool)
    reach = settings.edge_pitches * comb.pitch_px
    rest = identities.rest_px
    no_end_in_view = (rest[:, 0] < reach) & (rest[:, -1] > comb.width_px - 1 - reach)
    least = settings.stay_cost + 1.0 + np.where(no_end_in_view, 2 * settings.crossing_cost, 0.0)
    off = np.log(contrast) - identities.reference.log_contrast
    off -= nan_median(off, axis=1)[:, None]  # flicker
    misfit = np.minimum(np.nan_to_num(off) ** 2, LIKE_ITSELF**2).sum(axis=1)
    misfit /= np.maximum(np.isfinite(off).sum(axis=1), 1)
    worse = np.maximum(misfit / settings.least_misfit**2, 1.0)
    margin = nan_median(identities.margin, axis=1)  # of the whole comb; single sheets may be less certain
    runs = [run == one for one in range(run[-1] + 1)]
    # medians: a slip within the exposure of one frame changes brightnesses there alone
    given, wanted = (np.array([nan_median(part[one]) for one in runs]) for part in (margin, least * worse))
    unproved = away & (given < wanted)[run]
    return np.asarray(unproved[:, None] & np.isfinite(x), bool)


# --- the second search --------------------------------------------------------------------------------------


def _expected(start: Floats, rest: Floats) -> Floats:
    """Return rest positions plus the displacement of the neighbours, in frames in which a sheet is missing.

    NaN in all other frames, and where fewer than half of the sheets are detected.
    """
    expected = np.full(start.shape, np.nan)
    rows = np.isnan(start).any(axis=1) & (np.isfinite(start).mean(axis=1) >= 0.5)
    expected[rows] = rest[rows] + fill_rows(start[rows] - rest[rows], nan_median(rest))
    return expected


def _faint_ridges(
    profile: Floats32, found: Floats, expected: Floats, doubtful: Bools, comb: RidgeComb
) -> tuple[Ints, Ints, Floats]:
    """Return faint ridges at the expected positions of missing sheets: frame, sheet, and position, contrast
    and width (3, ridges). `found` holds these for the sheets already detected, (3, frame, N)."""
    wanted = np.isnan(found[0]) & np.isfinite(expected) & ~doubtful
    rows = np.flatnonzero(wanted.any(axis=1))
    if not len(rows):
        return rows, rows, np.zeros((3, 0))
    faint = find_ridges(profile[rows], replace(comb, contrast=0.0))
    row, sheet = np.nonzero(wanted[rows])
    frame = rows[row]
    best, distance = nearest(faint.x_px[row], expected[frame, sheet])
    there = np.stack([faint.x_px, faint.contrast, faint.fwhm_px])[:, row, best].astype(np.float64)
    usual = np.nan_to_num(nan_median(found[1]))[sheet]
    keep = (distance <= comb.settings.faint_reach * comb.pitch_px) & (
        there[1] >= comb.settings.faint_contrast * usual
    )
    keep &= nearest(found[0, frame], there[0])[1] > 0.5 * comb.fwhm_px
    keep &= _unshared(frame, there[0], keep)
    return frame[keep], sheet[keep], there[:, keep]


def _unshared(frame: Ints, x: Floats, keep: Bools) -> Bools:
    """Return False for kept entries that share (frame, x) with another kept entry: no ridge is given to two
    sheets."""
    _, which, counts = np.unique(
        np.stack([frame[keep], x[keep]]), axis=1, return_inverse=True, return_counts=True
    )
    unshared = np.ones(len(frame), bool)
    unshared[keep] = counts[which.ravel()] == 1
    return unshared


def _merged(found: Floats, expected: Floats, comb: RidgeComb) -> Bools:
    """Return which missing sheets form one ridge with a detected neighbour, and these neighbours, (frame, N).

    Their expected positions are within a ridge's width of each other, or the neighbour is as high or as wide
    as two sheets. `found` holds positions, contrasts and widths (3, frame, N).
    """
    start = found[0]
    missing = np.isnan(start)
    if not missing.any():
        return np.zeros_like(missing)
    apart = np.abs(np.diff(np.where(missing, expected, start), axis=1))
    beside = np.pad(missing, ((0, 0), (1, 1)))
    # the usual size is that without a missing neighbour, which may be missing in most frames
    alone = np.where(beside[:, :-2] | beside[:, 2:], np.nan, found[1:])
    usual = nan_median(alone, axis=1)
    size = found[1:] / np.where(np.isfinite(usual), usual, nan_median(found[1:], axis=1))[:, None]
    size /= nan_median(size, axis=2)[..., None]  # exposure, focus
    double = (size[0] > comb.settings.merged_height) | (size[1] > comb.settings.merged_width)
    pair = (apart < comb.settings.merged_widths * comb.fwhm_px) | double[:, 1:] | double[:, :-1]
    return _both(pair & (missing[:, 1:] ^ missing[:, :-1]))


def _hidden(start: Floats, doubtful: Bools, comb: RidgeComb) -> Bools:
    """Return which missing sheets were near a detected neighbour just before or after, and these neighbours.

    One lies behind the other, so that the ridge is no higher than usual, and it is unknown which is seen.
    """
    gap = np.diff(start, axis=1)
    around = np.fmin(last_seen(gap.T).T, last_seen(gap[::-1].T).T[::-1])
    near = min(comb.settings.touching_widths * comb.fwhm_px, comb.settings.touching_pitches * comb.pitch_px)
    seen = np.isfinite(start)
    missing = ~seen & ~doubtful  # a doubtful sheet does have a ridge
    return _both((around < near) & (missing[:, 1:] & seen[:, :-1] | seen[:, 1:] & missing[:, :-1]))


def _both(pair: Bools) -> Bools:
    """Return both sheets, (frame, N), of each pair of neighbours, (frame, N − 1)."""
    none = np.zeros((len(pair), 1), bool)
    return np.asarray(np.hstack([pair, none]) | np.hstack([none, pair]), bool)


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
    sheet, first, stop = stretches(np.asarray(tracks["flag"].values == "doubtful"))
    number = tracks["frame"].values

    def at_first(name: str) -> Any:
        return tracks[name].values[first, sheet] if name in tracks else np.full(len(sheet), np.nan)

    table = pd.DataFrame(
        {
            "sheet": sheet,
            "side": tracks["side"].values[sheet],
            "n": tracks["n"].values[sheet],
            "first_frame": number[first],
            "last_frame": number[stop - 1],
            "frames": stop - first,
            "why": [DOUBTS.get(str(why), "identity not certain") for why in at_first("why")],
            "x_withheld_px": at_first("x_withheld_px"),
            "x_expected_px": at_first("x_expected_px"),
        }
    )
    return table.sort_values("frames", ascending=False, kind="stable", ignore_index=True)


def stretches(marked: Bools) -> tuple[Ints, Ints, Ints]:
    """Return the unbroken stretches of True in each column of (frame, sheet): sheet, first row, end row."""
    edge = np.diff(np.pad(marked.astype(np.int8), ((1, 1), (0, 0))), axis=0)
    sheet, first = np.nonzero((edge == 1).T)
    _, stop = np.nonzero((edge == -1).T)
    return sheet, first, stop
