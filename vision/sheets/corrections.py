"""Doubtful stretches, and the decisions that settle them by hand.

`doubtful_stretches` lists where an identity was doubted, and why; a TOML file says what to do about them:

.. code-block:: toml

    [[accept]]            # the doubted ridge is this sheet
    sheet = 0
    frames = "226:355"    # half-open, as in the film

    [[leave_out]]         # no position here, whatever was found
    sheet = 3
    frames = "10:12"

    [[swap]]              # these two were taken for each other
    sheets = [4, 5]
    frames = "60:61"

    [[assign]]            # the ridge at this column of the first frame, followed from there
    sheet = 6
    frames = "80:111"
    x_px = 687.0

`sheet` is the index from the left, as in tracks.csv.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from vision.errors import InputError
from vision.numeric import Floats, Ints, nan_median
from vision.sheets.recovery import DOUBTS, Detections
from vision.sheets.ridges import RidgeComb, Ridges
from vision.sheets.settings import DEFAULT, TrackingSettings

KEYS: Mapping[str, tuple[str, ...]] = {
    "accept": ("sheet", "frames"),
    "leave_out": ("sheet", "frames"),
    "swap": ("sheets", "frames"),
    "assign": ("sheet", "frames", "x_px"),
}
"""Kinds of corrections, and what an entry of each must hold."""


@dataclass(frozen=True, kw_only=True)
class Correction:
    """One decision about a sheet in a stretch of frames.

    Parameters
    ----------
    kind
        "accept", "leave_out", "swap" or "assign".
    sheets
        One index from the left, two for "swap".
    first, stop
        Frames, half-open, as numbered in the film.
    x_px
        Column of the ridge in the first frame, for "assign".
    name
        What a message calls it.
    """

    kind: str
    sheets: tuple[int, ...]
    first: int
    stop: int
    x_px: float | None = None
    name: str = "the correction"


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
    columns = ["sheet", "side", "n", "first_frame", "last_frame", "frames", "why"]
    columns += ["x_withheld_px", "x_expected_px"]
    doubtful = np.asarray(tracks["flag"].values == "doubtful")
    edge = np.diff(np.pad(doubtful.astype(np.int8), ((1, 1), (0, 0))), axis=0)
    sheet, first = np.nonzero((edge == 1).T)
    _, stop = np.nonzero((edge == -1).T)
    number, side, n = tracks["frame"].values, tracks["side"].values, tracks["n"].values

    def of(name: str, row: Any, column: Any) -> Any:
        return tracks[name].values[row, column] if name in tracks else np.nan

    rows = [
        (
            int(k),
            int(side[k]),
            int(n[k]),
            int(number[a]),
            int(number[b - 1]),
            int(b - a),
            DOUBTS.get(str(of("why", a, k)), "identity not certain"),
            float(of("x_withheld_px", a, k)),
            float(of("x_expected_px", a, k)),
        )
        for k, a, b in zip(sheet, first, stop, strict=True)
    ]
    table = pd.DataFrame(rows, columns=columns)
    return table.sort_values("frames", ascending=False, kind="stable").reset_index(drop=True)


def read_corrections(path: str | Path) -> tuple[Correction, ...]:
    """Decisions from a TOML file, in its order.

    Parameters
    ----------
    path
        The file; see the module for what it holds.

    Raises
    ------
    InputError
        For a file that cannot be read, an unknown kind or key, or a value of the wrong kind; it names the
        entry.
    """
    try:
        table = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError) as error:
        raise InputError(path, "a TOML file of corrections", str(error)) from error
    found = []
    for kind, entries in table.items():
        if kind not in KEYS:
            raise InputError(path, f"entries {', '.join(f'[[{name}]]' for name in KEYS)}", f"'{kind}'")
        if not isinstance(entries, list):
            raise InputError(path, f"[[{kind}]], in two brackets", f"{kind} = {entries!r}")
        found += [_entry(path, kind, number, entry) for number, entry in enumerate(entries, 1)]
    return tuple(found)


def _entry(path: str | Path, kind: str, number: int, entry: Any) -> Correction:
    name = f"{path}, [[{kind}]] {number}"
    if not isinstance(entry, dict) or set(entry) != set(KEYS[kind]):
        found = ", ".join(entry) if isinstance(entry, dict) else repr(entry)
        raise InputError(name, " and ".join(KEYS[kind]), found or "nothing")
    sheets = entry["sheets"] if kind == "swap" else [entry["sheet"]]
    whole = isinstance(sheets, list) and all(type(sheet) is int and sheet >= 0 for sheet in sheets)
    if not whole or len(set(sheets)) != (2 if kind == "swap" else 1):
        wanted = (
            "sheets = [4, 5], two indices from the left" if kind == "swap" else "sheet = 4, from the left"
        )
        raise InputError(name, wanted, repr(entry.get("sheets", entry.get("sheet"))))
    first, colon, stop = str(entry["frames"]).partition(":")
    if not (colon and first.strip().isdecimal() and stop.strip().isdecimal() and int(first) < int(stop)):
        raise InputError(name, 'frames = "A:B" with A < B', repr(entry["frames"]))
    x_px = entry.get("x_px")
    if x_px is not None and (isinstance(x_px, bool) or not isinstance(x_px, int | float)):
        raise InputError(name, "x_px, a column in px", repr(x_px))
    place = None if x_px is None else float(x_px)
    return Correction(
        kind=kind, sheets=tuple(sheets), first=int(first), stop=int(stop), x_px=place, name=name
    )


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
    _check_unique(corrections)
    arrays = {name: np.array(getattr(detections, name)) for name in _TABLES}
    for correction in corrections:
        rows = np.flatnonzero((frames >= correction.first) & (frames < correction.stop))
        _check_there(correction, rows, frames, arrays["start_px"].shape[1])
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
            x = _followed(correction, rows, arrays["start_px"], ridges, comb, origin_px, settings)
            _put(arrays, rows, sheet, x, ridges, "missing")
    return replace(detections, **arrays)


_TABLES = ("start_px", "contrast", "fwhm_px", "flag", "why", "withheld_px")


def _check_unique(corrections: Sequence[Correction]) -> None:
    for i, one in enumerate(corrections):
        for other in corrections[:i]:
            shared = set(one.sheets) & set(other.sheets)
            if shared and one.first < other.stop and other.first < one.stop:
                found = f"sheet {min(shared)} in the same frames as in {other.name.rpartition(', ')[2]}"
                raise InputError(one.name, "one decision per sheet and frame", found)


def _check_there(correction: Correction, rows: Ints, frames: Ints, sheets: int) -> None:
    if max(correction.sheets) >= sheets:
        raise InputError(correction.name, f"a sheet from 0 to {sheets - 1}", str(max(correction.sheets)))
    if len(rows) < correction.stop - correction.first:
        there = f"frames within {frames[0]}:{frames[-1] + 1}"
        raise InputError(correction.name, there, f"{correction.first}:{correction.stop}")


def _put(arrays: dict[str, Any], rows: Ints, sheet: int, x: Floats, ridges: Ridges, otherwise: str) -> None:
    """Sheet at x in these rows; flagged `otherwise` where x is NaN."""
    known = np.isfinite(x)
    distance = np.nan_to_num(np.abs(ridges.x_px[rows] - np.nan_to_num(x)[:, None]), nan=np.inf)
    nearest = np.argmin(distance, axis=1)
    arrays["start_px"][rows, sheet] = x
    arrays["contrast"][rows, sheet] = np.where(known, ridges.contrast[rows, nearest], np.nan)
    arrays["fwhm_px"][rows, sheet] = np.where(known, ridges.fwhm_px[rows, nearest], np.nan)
    arrays["flag"][rows, sheet] = np.where(known, "ok", otherwise)
    arrays["why"][rows, sheet] = ""
    arrays["withheld_px"][rows, sheet] = np.nan


def _followed(
    correction: Correction,
    rows: Ints,
    start_px: Floats,
    ridges: Ridges,
    comb: RidgeComb,
    origin_px: float,
    settings: TrackingSettings,
) -> Floats:
    """The ridge nearest to the column in the first row, then in each row the one nearest to where the other
    sheets' motion takes it; NaN where none is near."""
    others = np.delete(start_px, correction.sheets[0], axis=1)
    moved = np.nan_to_num(nan_median(np.diff(others[rows], axis=0), axis=1))
    reach = settings.faint_reach * comb.pitch_px
    x = np.full(len(rows), np.nan)
    at = float(correction.x_px or 0.0) - origin_px
    for i, row in enumerate(rows):
        at += float(moved[i - 1]) if i else 0.0
        distance = np.nan_to_num(np.abs(ridges.x_px[row] - at), nan=np.inf)
        nearest = int(np.argmin(distance))
        if distance[nearest] > reach:
            if i == 0:
                seen = ridges.x_px[row][np.isfinite(ridges.x_px[row])] + origin_px
                found = ", ".join(f"{place:.0f}" for place in seen) or "none"
                raise InputError(correction.name, f"a ridge near x_px = {correction.x_px:g}", found)
            continue
        x[i] = at = float(ridges.x_px[row, nearest])
        if (others[row] == at).any():
            taken = int(np.flatnonzero(start_px[row] == at)[0])
            raise InputError(
                correction.name,
                "a ridge that is no other sheet's",
                f"sheet {taken}'s in frame {correction.first + i}",
                "swap the two, or leave the other one out",
            )
    return x
