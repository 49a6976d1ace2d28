"""What decisions by hand change: the corrected detections; a ridge followed from where it was pointed at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from vision.errors import InputError
from vision.numeric import Floats, Ints, nan_median, nearest
from vision.sheets.corrections import OF_SHEETS, OF_STRETCHES, Correction, ordered
from vision.sheets.recovery import Detections
from vision.sheets.ridges import RidgeComb, Ridges
from vision.sheets.settings import DEFAULT, TrackingSettings

_TABLES = ("start_px", "contrast", "fwhm_px", "flag", "why", "withheld_px")


def apply_corrections(
    detections: Detections,
    ridges: Ridges,
    corrections: Sequence[Correction],
    comb: RidgeComb,
    *,
    frames: Ints,
    origin_px: float = 0.0,
    settings: TrackingSettings = DEFAULT,
) -> Detections:
    """The detections as corrected by hand.

    Parameters
    ----------
    detections
        As found; not changed.
    ridges
        Candidates of every frame.
    corrections
        Decisions, applied in their order.
    comb
        Pitch of the ridges.
    frames
        Number of every row in the film, (frame,).
    origin_px
        Column of the profile's first pixel in the picture.
    settings
        How near a ridge must be to be the one that is meant.

    Raises
    ------
    InputError
        For a sheet or frames that are not there, two entries about one sheet in one frame, nothing to
        accept, or a ridge that is not there or another sheet's; it names the entry.
    """
    wanted = ordered([one for one in corrections if one.kind in OF_SHEETS])
    _check_unique(wanted)
    arrays = {name: np.array(getattr(detections, name)) for name in _TABLES}
    for correction in wanted:
        rows = np.flatnonzero((frames >= correction.first) & (frames < (correction.stop or np.inf)))
        check_there(correction, rows, frames, arrays["start_px"].shape[1])
        if correction.kind in OF_STRETCHES:
            _apply_to_stretch(correction, rows, arrays, ridges, comb, origin_px, settings)
        elif correction.kind == "delete":
            arrays = {
                name: np.delete(values, correction.sheets[0], axis=1) for name, values in arrays.items()
            }
        else:
            arrays = _added(correction, int(rows[0]), arrays, ridges, comb, origin_px, settings)
    return replace(detections, **arrays)


def _apply_to_stretch(
    correction: Correction,
    rows: Ints,
    arrays: dict[str, Any],
    ridges: Ridges,
    comb: RidgeComb,
    origin_px: float,
    settings: TrackingSettings,
) -> None:
    """Change the arrays in place."""
    sheet = correction.sheets[0]
    if correction.kind == "swap":
        for values in arrays.values():
            one, other = (values[rows, k].copy() for k in correction.sheets)
            values[rows, correction.sheets[0]], values[rows, correction.sheets[1]] = other, one
    elif correction.kind == "leave_out":
        _put(arrays, rows, sheet, np.full(len(rows), np.nan), ridges, "left_out")
    elif correction.kind == "accept":
        doubted = rows[arrays["flag"][rows, sheet] == "doubtful"]
        if not len(doubted):
            raise InputError(correction.name, "a doubtful stretch to accept", "none in these frames")
        _put(arrays, doubted, sheet, arrays["withheld_px"][doubted, sheet], ridges, "missing")
    else:
        others = np.delete(arrays["start_px"], sheet, axis=1)
        x = follow_ridge(correction, rows, others, ridges, comb, origin_px=origin_px, settings=settings)
        shared = np.argwhere(others[rows] == x[:, None])
        if len(shared):
            row, other = (int(place) for place in shared[0])
            raise not_taken(correction, correction.first + row, other + (other >= sheet))
        _put(arrays, rows, sheet, x, ridges, "missing")


def _added(
    correction: Correction,
    row: int,
    arrays: dict[str, Any],
    ridges: Ridges,
    comb: RidgeComb,
    origin_px: float,
    settings: TrackingSettings,
) -> dict[str, Any]:
    """One more column, where the ridge stands among the sheets; "missing" where it is lost or another's."""
    others = arrays["start_px"]
    frames = len(others)
    x = np.full(frames, np.nan)
    for rows in (np.arange(row, frames), np.arange(row, -1, -1)):
        x[rows] = follow_ridge(correction, rows, others, ridges, comb, origin_px=origin_px, settings=settings)
    shared = others == x[:, None]
    if shared[row].any():
        raise not_taken(correction, correction.first, int(shared[row].argmax()))
    x[shared.any(axis=1)] = np.nan
    usual = np.where(np.isfinite(others[row]), others[row], nan_median(others, axis=0))
    place = int((usual < x[row]).sum())
    empty = {"flag": "missing", "why": ""}
    wider = {
        name: np.insert(values, place, empty.get(name, np.nan), axis=1) for name, values in arrays.items()
    }
    _put(wider, np.arange(frames), place, x, ridges, "missing")
    return wider


def _check_unique(corrections: Sequence[Correction]) -> None:
    for i, one in enumerate(corrections):
        for other in corrections[:i]:
            shared = set(one.sheets) & set(other.sheets)
            apart = one.first >= (other.stop or np.inf) or other.first >= (one.stop or np.inf)
            if shared and not apart and not (one.date or other.date):
                found = f"sheet {min(shared)} in the same frames as in {other.name.rpartition(', ')[2]}"
                raise InputError(one.name, "one decision per sheet and frame", found)


def check_there(correction: Correction, rows: Ints, frames: Ints, sheets: int) -> None:
    """Refuse a sheet or frames that are not there: `rows` are the correction's among `frames`.

    Raises: InputError.
    """
    if max(correction.sheets, default=0) >= sheets:
        raise InputError(correction.name, f"a sheet from 0 to {sheets - 1}", str(max(correction.sheets)))
    stop = int(frames[-1]) + 1 if correction.stop is None else correction.stop
    if correction.kind != "delete" and len(rows) < max(1, stop - correction.first):
        there = f"frames within {frames[0]}:{frames[-1] + 1}"
        raise InputError(correction.name, there, f"{correction.first}:{stop}")


def _put(arrays: dict[str, Any], rows: Ints, sheet: int, x: Floats, ridges: Ridges, otherwise: str) -> None:
    """Sheet at x in these rows; flagged `otherwise` where x is NaN."""
    known = np.isfinite(x)
    best, _ = nearest(ridges.x_px[rows], x)
    arrays["start_px"][rows, sheet] = x
    arrays["contrast"][rows, sheet] = np.where(known, ridges.contrast[rows, best], np.nan)
    arrays["fwhm_px"][rows, sheet] = np.where(known, ridges.fwhm_px[rows, best], np.nan)
    arrays["flag"][rows, sheet] = np.where(known, "ok", otherwise)
    arrays["why"][rows, sheet] = ""
    arrays["withheld_px"][rows, sheet] = np.nan


def follow_ridge(
    correction: Correction,
    rows: Ints,
    others: Floats,
    ridges: Ridges,
    comb: RidgeComb,
    *,
    origin_px: float = 0.0,
    settings: TrackingSettings = DEFAULT,
) -> Floats:
    """The ridge nearest to a column in the first row, then in each row the one nearest to where the other
    sheets' motion takes it.

    Parameters
    ----------
    correction
        Its x_px is the column, as in the picture.
    rows
        Of the next two, in the order in which the ridge is followed.
    others
        Whole pixels of the other sheets, (frame, sheet).
    ridges
        Candidates of every frame.
    comb
        Pitch of the ridges.
    origin_px
        Column of the profile's first pixel in the picture.
    settings
        How near a ridge must be to be the one that is meant.

    Returns
    -------
    Whole pixels, one per row; NaN where none is near.

    Raises
    ------
    InputError
        Where none is near the column in the first row.
    """
    moved = np.nan_to_num(nan_median(np.diff(others[rows], axis=0), axis=1))
    reach = settings.faint_reach * comb.pitch_px
    travelled = np.concatenate([[0.0], np.cumsum(moved)])
    still = ridges.x_px[rows] - travelled[:, None]  # as seen by one who moves with the other sheets
    x = np.full(len(rows), np.nan)
    at = float(correction.x_px or 0.0) - origin_px
    begin = 0
    while begin < len(rows):
        block = still[begin : begin + 256]  # the result does not depend on this number
        guess, distance = nearest(block, np.full(len(block), at))
        near = distance <= reach
        if begin == 0 and not near[0]:
            seen = ridges.x_px[rows[0]][np.isfinite(ridges.x_px[rows[0]])] + origin_px
            found = ", ".join(f"{place:.0f}" for place in seen) or "none"
            raise InputError(correction.name, f"a ridge near x_px = {correction.x_px:g}", found)
        before = _last_before(np.where(near, block[np.arange(len(block)), guess], np.nan), at)
        best, distance = nearest(block, before)  # from where it was last, row by row
        close = distance <= reach
        wrong = np.flatnonzero((best != guess) | (close != near))
        done = slice(0, int(wrong[0]) + 1 if len(wrong) else len(block))  # up to there `before` is right
        taken = np.flatnonzero(close[done])
        x[begin + taken] = ridges.x_px[rows[begin + taken], best[taken]]
        if len(taken):
            at = float(block[taken[-1], best[taken[-1]]])
        begin += done.stop
    return x


def _last_before(values: Floats, first: float) -> Floats:
    """The last known value before each; `first` before the first."""
    earlier = np.concatenate([[first], values[:-1]])
    number = np.maximum.accumulate(np.where(np.isfinite(earlier), np.arange(len(earlier)), 0))
    return np.asarray(earlier[number], np.float64)


def not_taken(correction: Correction, frame: int, sheet: int) -> InputError:
    """The refusal of a ridge that is another sheet's."""
    found, advice = f"sheet {sheet}'s in frame {frame}", "swap the two, or leave the other one out"
    return InputError(correction.name, "a ridge that is no other sheet's", found, advice)
