"""Where each sheet is detected in each frame, and why it is not where it is not.

`assign_detections` takes what `identify_sheets` paired, withdraws what is doubtful, and looks again, more
closely, where a sheet is missing.
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
    pattern_moved,
    places_in_comb,
    torn,
)
from vision.sheets.ridges import RidgeComb, Ridges, find_ridges
from vision.sheets.settings import DEFAULT, TrackingSettings

LIKE_ITSELF = 0.7
"""Logarithm of contrast within which a ridge may be the sheet that was expected there: a factor of two."""


@dataclass(frozen=True)
class Detections:
    """One ridge per sheet and frame, all (frame, N).

    Parameters
    ----------
    start_px
        Whole pixel of the ridge, NaN where flag is not "ok".
    contrast, fwhm_px
        Its prominence, grey levels, and width.
    flag
        "ok", "missing", "merged", "edge" or "doubtful".
    why
        Why a doubtful identity is doubted: one of `DOUBTS`, "" elsewhere.
    withheld_px
        Whole pixel of the doubtful ridge, NaN elsewhere.
    """

    start_px: Floats
    contrast: Floats
    fwhm_px: Floats
    flag: Strings
    why: Strings
    withheld_px: Floats


def assign_detections(
    profile: Floats32,
    ridges: Ridges,
    identities: Identities,
    comb: RidgeComb,
    *,
    settings: TrackingSettings = DEFAULT,
) -> Detections:
    """One ridge for each sheet in each frame, or the reason why there is none.

    Where a missing sheet must be follows from its neighbours' displacement in the same frame. A ridge there
    that was too faint for the first search is taken if it reaches a fraction of the sheet's usual contrast.
    Positions whose identity is not certain (for one of `DOUBTS`) are flagged "doubtful" and not given.

    Parameters
    ----------
    profile
        Grey levels (frame, x).
    ridges, identities
        Candidates of every frame, and which of them is which sheet.
    comb
        Width, pitch and contrast of the ridges.
    settings
        Thresholds.
    """
    candidates = np.stack([ridges.x_px, ridges.contrast, ridges.fwhm_px])
    paired = np.stack([values_of(identities.match, values) for values in candidates])
    why = _doubts(paired[0], paired[1], identities, comb, profile.shape[1], settings)
    why = _settled(why, paired, comb, settings)
    why[_pattern_away(np.where(why == "", paired, np.nan))] = "pattern"
    paired, why = _other_ridges(candidates, paired, why, comb, settings)
    doubtful = why != ""
    withheld = np.where(doubtful, paired[0], np.nan)
    found = np.where(doubtful, np.nan, paired)
    expected = _expected(found[0], identities.rest_px)
    rows, sheet, faint = _faint_ridges(profile, found, expected, doubtful, comb, settings)
    if len(rows):  # a second look may find no more than a ridge that happens to be near
        found[:, rows, sheet] = faint
        found[:, hops(neighbour_residual(found[0]), comb, settings) & np.isnan(paired[0])] = np.nan
    flag = np.where(np.isfinite(found[0]), "ok", "missing").astype("<U8")
    flag[_merged(found, expected, comb, settings)] = "merged"
    flag[_swallowed(found[0], doubtful, comb, settings)] = "merged"
    half = comb.fwhm_px / 2
    outside = (expected < half) | (expected > profile.shape[1] - 1 - half)
    flag[(flag != "ok") & outside] = "edge"
    flag[doubtful] = "doubtful"
    start, contrast, fwhm = np.where(flag == "ok", found, np.nan)
    return Detections(start, contrast, fwhm, flag, why, withheld)


# --- doubt --------------------------------------------------------------------------------------------------

DOUBTS = {
    "margin": "another numbering fits nearly as well",
    "tear": "displaced unlike the largest group of sheets",
    "jump": "after a jump by whole pitches",
    "looks": "pitches away from the usual place, and the sheets look unlike themselves",
    "pattern": "brightnesses and widths fit another numbering: the comb may have jumped by whole pitches",
    "hop": "away from where the neighbours say, on another ridge",
}
"""What `Detections.why` means."""


def _doubts(
    x: Floats,
    contrast: Floats,
    identities: Identities,
    comb: RidgeComb,
    width_px: int,
    settings: TrackingSettings,
) -> Strings:
    """Why the identity of each paired ridge (frame, N) is doubtful, as far as frame and margin tell."""
    why = np.full(x.shape, "", "<U9")
    jump, unlike = _after_jumps(x, contrast, identities, comb, width_px, settings)
    why[jump] = "jump"
    why[jump & unlike[:, None]] = "looks"
    why[~(identities.margin >= settings.doubt) & (why != "looks")] = "margin"
    why[torn(x - places_in_comb(x), comb, settings)] = "tear"
    why[np.isnan(x)] = ""
    return why


def _pattern_away(sure: Floats) -> Bools:
    """Where the sheets' looks belong to another numbering than in most frames (frame, N). `sure`: positions,
    contrasts and widths (3, frame, N), NaN where there is doubt; frames full of it are passed over."""
    seen = np.isfinite(sure[0])
    rows = np.flatnonzero(seen.mean(axis=1) > 0.5)
    with np.errstate(divide="ignore", invalid="ignore"):
        moved = pattern_moved(*np.log(sure[1:, rows]))
    values, counts = np.unique(moved, return_counts=True)
    away = np.zeros_like(seen)
    away[rows] = seen[rows] & (moved != values[np.argmax(counts)] if len(rows) else moved)[:, None]
    return np.asarray(away, bool)


def _settled(why: Strings, paired: Floats, comb: RidgeComb, settings: TrackingSettings) -> Strings:
    """The doubts without those that the pattern settles: it fits this numbering and no other one."""
    open_ = (why == "jump") | (why == "margin")
    if not open_.any():
        return why
    x, contrast, fwhm = paired
    with np.errstate(divide="ignore", invalid="ignore"):
        looks = np.log(contrast), np.log(fwhm)
    known = np.where(why == "tear", np.nan, x)
    sure = anchored(known, *looks, np.isfinite(known) & (why == ""), comb, settings)
    return np.where(sure & open_, "", why)


def _other_ridges(
    candidates: Floats32, paired: Floats, why: Strings, comb: RidgeComb, settings: TrackingSettings
) -> tuple[Floats, Strings]:
    """Sheets that hopped to another ridge: the ridge in the right place where no other sheet has it, else a
    doubt. Positions, contrasts and widths of candidates (3, frame, K) and of sheets (3, frame, N)."""
    for _ in range(4):  # each names the sheet that leaves its neighbours most, the next looks without it
        x = np.where(why == "", paired[0], np.nan)
        residual = neighbour_residual(x)
        off = hops(residual, comb, settings)
        if not off.any():
            break
        frame, sheet = np.nonzero(off)
        best, distance = nearest(candidates[0, frame], (x - residual)[off])
        there, height = candidates[:2, frame, best].astype(np.float64)
        take = (distance <= settings.faint_reach * comb.pitch_px) & (there != x[off])
        usual = nan_median(np.log(np.where(why == "", paired[1], np.nan)))[sheet]
        take &= np.abs(np.log(height) - usual) < LIKE_ITSELF
        take &= ~(np.where(off, np.nan, paired[0])[frame] == there[:, None]).any(axis=1)
        take &= _unshared(frame, there, take)
        why, paired = why.copy(), paired.copy()
        why[frame[~take], sheet[~take]] = "hop"
        paired[:, frame[take], sheet[take]] = candidates[:, frame[take], best[take]]
    return paired, why


def _after_jumps(
    x: Floats,
    contrast: Floats,
    identities: Identities,
    comb: RidgeComb,
    width_px: int,
    settings: TrackingSettings,
) -> tuple[Bools, Bools]:
    """Frames in which the comb stands whole pitches from where it mostly does, without proof (frame, N), and
    those in which it looks so unlike itself that its pattern is no proof either (frame,).

    Such a jump must be proved by a margin that the cost of staying in place cannot bring by itself; with
    neither end in view, where only brightness tells a jump from none, nor those of sheets crossing the edges.
    A comb that jumped still looks like itself. Where it does not, the costs count sheets that changed for
    sheets that were exchanged, and the margin is worth less by as much as the brightness fits worse than
    usual: the overdispersion of a quasi-likelihood (McCullagh & Nelder 1989, chapter 9).
    """
    seen = np.flatnonzero(np.isfinite(x).any(axis=1))
    step = np.nan_to_num(nan_median(np.diff(x[seen], axis=0), axis=1)) / comb.pitch_px
    jump = np.where(np.abs(step) > settings.tear_fraction, np.rint(step), 0).astype(np.int64)
    place = np.zeros(len(x), np.int64)
    place[seen[1:]] = np.cumsum(jump)
    values, counts = np.unique(place[seen], return_counts=True)
    away = place != (values[np.argmax(counts)] if len(values) else 0)
    if not away.any():
        return np.zeros(x.shape, bool), away
    reach = settings.edge_pitches * comb.pitch_px
    rest = identities.rest_px
    filled = (rest[:, 0] < reach) & (rest[:, -1] > width_px - 1 - reach)
    least = settings.stay_cost + 1.0 + np.where(filled, 2 * settings.crossing_cost, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        off = np.log(contrast) - identities.reference.log_contrast
    off -= nan_median(off, axis=1)[:, None]  # flicker
    misfit = np.minimum(np.nan_to_num(off) ** 2, LIKE_ITSELF**2).sum(axis=1)
    misfit /= np.maximum(np.isfinite(off).sum(axis=1), 1)
    usual = float(nan_median(misfit[seen][~away[seen]]))
    # a stay away is one event: all its frames together are believed or not
    stay = np.r_[0, np.cumsum(away[1:] != away[:-1])]
    worse = np.maximum(misfit / max(usual, settings.least_misfit**2), 1.0)
    whole = nan_median(identities.margin, axis=1)  # of the comb; single sheets may be less certain
    known = np.isfinite(whole)
    frames = np.maximum(np.bincount(stay, known), 1)
    worse, whole = (
        (np.bincount(stay, np.nan_to_num(values)) / frames)[stay]
        for values in (np.where(known, worse, 0.0), whole)
    )
    doubt = np.asarray((away & (whole < least * worse))[:, None] & np.isfinite(x), bool)
    return doubt, np.asarray(worse > settings.unlike_itself, bool)


# --- a second look ------------------------------------------------------------------------------------------


def _expected(start: Floats, rest: Floats) -> Floats:
    """Where each sheet must be in frames in which one is missing: its rest position moved as its neighbours
    are. NaN with fewer than half of the sheets detected, and in all other frames."""
    expected = np.full(start.shape, np.nan)
    rows = np.isnan(start).any(axis=1) & (np.isfinite(start).mean(axis=1) >= 0.5)
    expected[rows] = rest[rows] + fill_rows(start[rows] - rest[rows], nan_median(rest))
    return expected


def _faint_ridges(
    profile: Floats32,
    found: Floats,
    expected: Floats,
    doubtful: Bools,
    comb: RidgeComb,
    settings: TrackingSettings,
) -> tuple[Ints, Ints, Floats]:
    """Faint ridges where missing sheets must be: frame, sheet, and their x, contrast and width (3, ridges).
    `found` holds the same of what is known (3, frame, N)."""
    wanted = np.isnan(found[0]) & np.isfinite(expected) & ~doubtful
    rows = np.flatnonzero(wanted.any(axis=1))
    if not len(rows):
        return rows, rows, np.zeros((3, 0))
    faint = find_ridges(profile[rows], replace(comb, contrast=0.0), settings=settings)
    row, sheet = np.nonzero(wanted[rows])
    frame = rows[row]
    best, distance = nearest(faint.x_px[row], expected[frame, sheet])
    there = np.stack([faint.x_px, faint.contrast, faint.fwhm_px])[:, row, best].astype(np.float64)
    usual = np.nan_to_num(nan_median(found[1]))[sheet]
    keep = (distance <= settings.faint_reach * comb.pitch_px) & (there[1] >= settings.faint_contrast * usual)
    keep &= nearest(found[0, frame], there[0])[1] > 0.5 * comb.fwhm_px
    keep &= _unshared(frame, there[0], keep)
    return frame[keep], sheet[keep], there[:, keep]


def _unshared(frame: Ints, x: Floats, keep: Bools) -> Bools:
    """False for kept entries whose (frame, x) another kept entry has too: no ridge is given to two sheets."""
    _, which, counts = np.unique(
        np.stack([frame[keep], x[keep]]), axis=1, return_inverse=True, return_counts=True
    )
    alone = np.ones(len(frame), bool)
    alone[keep] = counts[which.ravel()] == 1
    return alone


def _merged(found: Floats, expected: Floats, comb: RidgeComb, settings: TrackingSettings) -> Bools:
    """Missing sheets and the detected neighbours that they have become one ridge with: where they must be
    within a ridge's width of each other, or where the neighbour is as high or as wide as more than one sheet.
    `found` holds positions, contrasts and widths (3, frame, N)."""
    start = found[0]
    missing = np.isnan(start)
    if not missing.any():
        return np.zeros_like(missing)
    apart = np.abs(np.diff(np.where(missing, expected, start), axis=1))
    beside = np.pad(missing, ((0, 0), (1, 1)))
    alone = np.where(beside[:, :-2] | beside[:, 2:], np.nan, found[1:])  # it may be missing in most frames
    usual = nan_median(alone, axis=1)
    size = found[1:] / np.where(np.isfinite(usual), usual, nan_median(found[1:], axis=1))[:, None]
    size /= nan_median(size, axis=2)[..., None]  # exposure, focus
    double = (size[0] > settings.merged_height) | (size[1] > settings.merged_width)
    pair = (apart < settings.merged_widths * comb.fwhm_px) | double[:, 1:] | double[:, :-1]
    return _both(pair & (missing[:, 1:] ^ missing[:, :-1]))


def _swallowed(start: Floats, doubtful: Bools, comb: RidgeComb, settings: TrackingSettings) -> Bools:
    """Missing sheets, and the detected neighbours that they came near to before they went or after they came
    back: one lies behind the other, no higher than either, and nothing tells which of both is seen."""
    gap = np.diff(start, axis=1)
    around = np.fmin(last_seen(gap.T).T, last_seen(gap[::-1].T).T[::-1])
    near = min(settings.touching_widths * comb.fwhm_px, settings.touching_pitches * comb.pitch_px)
    seen = np.isfinite(start)
    missing = ~seen & ~doubtful  # a doubtful ridge is one of its own
    return _both((around < near) & (missing[:, 1:] & seen[:, :-1] | seen[:, 1:] & missing[:, :-1]))


def _both(pair: Bools) -> Bools:
    """Both sheets of each pair of neighbours (frame, N − 1), (frame, N)."""
    none = np.zeros((len(pair), 1), bool)
    return np.asarray(np.hstack([pair, none]) | np.hstack([none, pair]), bool)


# --- what is in doubt, as a table ---------------------------------------------------------------------------


def doubtful_stretches(tracks: xr.Dataset) -> pd.DataFrame:
    """Where an identity is in doubt: one row per sheet and unbroken stretch, the longest first.

    Parameters
    ----------
    tracks
        From `vision.track_sheets`.

    Returns
    -------
    pandas.DataFrame
        sheet, side, n; first_frame and last_frame, frames; why (in words); x_withheld_px, the doubted ridge,
        and x_expected_px, where the sheets around say it must be, both in the first frame (NaN if unknown).
    """
    sheet, first, stop = stretches(np.asarray(tracks["flag"].values == "doubtful"))
    number = tracks["frame"].values

    def there(name: str) -> Any:
        return tracks[name].values[first, sheet] if name in tracks else np.full(len(sheet), np.nan)

    table = pd.DataFrame(
        {
            "sheet": sheet,
            "side": tracks["side"].values[sheet],
            "n": tracks["n"].values[sheet],
            "first_frame": number[first],
            "last_frame": number[stop - 1],
            "frames": stop - first,
            "why": [DOUBTS.get(str(why), "identity not certain") for why in there("why")],
            "x_withheld_px": there("x_withheld_px"),
            "x_expected_px": there("x_expected_px"),
        }
    )
    return table.sort_values("frames", ascending=False, kind="stable", ignore_index=True)


def stretches(marked: Bools) -> tuple[Ints, Ints, Ints]:
    """Unbroken stretches of True in each column of (frame, sheet): sheet, first row, row after the last."""
    edge = np.diff(np.pad(marked.astype(np.int8), ((1, 1), (0, 0))), axis=0)
    sheet, first = np.nonzero((edge == 1).T)
    _, stop = np.nonzero((edge == -1).T)
    return sheet, first, stop
