"""Two runs of one film, compared: how many positions differ, by how much, and what becomes of the shells."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from vision.numeric import Floats, Floats32, Ints
from vision.review.editing import usual_places
from vision.review.positions import Positions, read_rows
from vision.run.reading import read_table

DIFFERENT = 3.0
"""Standard errors of both positions by which they differ: three of a thousand equal ones do by chance."""


def differences(before: Path, after: Path) -> dict[str, Any]:
    """What one run folder says that another one does not.

    Parameters
    ----------
    before, after
        Run folders.

    Returns
    -------
    dict
        Pairs are before and after. Of the whole runs: sheets (left and right), positions, doubtful
        (positions), error_px (median). Of the sheets that both have, each other's nearest within half a
        pitch: gained and lost (positions); of the positions in both, their number compared, how many differ
        by more than `DIFFERENT` errors, how many lie on other_ridge, more than half a pitch away, median_px
        and largest_px (of the difference). ratios: known (pairs), median and largest (of the difference), of
        (compared), other_shell (called otherwise). shells: of each side the median number of stiff sheets,
        and in how many sticks it is other. Both None where a run has none.

    Raises
    ------
    InputError
        For damaged files.
    """
    old, new = (read_rows(folder / "tracks.nc") for folder in (before, after))
    pairs = _pairs(usual_places(old), usual_places(new), old.track_facts.pitch_px)
    return _of_positions(old, new, *pairs) | _of_deformation(before, after, *pairs)


def _of_deformation(before: Path, after: Path, old: Ints, new: Ints) -> dict[str, Any]:
    """How σ_x/Λ_st of the sheets in both runs, and the shells, differ."""
    names = ("deformation", "shells")
    (sheets, shells), (sheets_new, shells_new) = (
        [read_table(folder, name) for name in names] for folder in (before, after)
    )
    if sheets is None or sheets_new is None or shells is None or shells_new is None:
        return {"ratios": None, "shells": None}
    index = dict(zip(old.tolist(), new.tolist(), strict=True))
    both = sheets.assign(index=sheets["index"].map(index)).merge(sheets_new, on=["event", "index"])
    change = (both["ratio_y"] - both["ratio_x"]).abs().dropna()
    ratios = {
        "known": [int(table["ratio"].notna().sum()) for table in (sheets, sheets_new)],
        "of": len(change),
        "median": float(change.median()),
        "largest": float(change.max()),
        "other_shell": int((both["shell_x"] != both["shell_y"]).sum()),
    }
    sides = shells.merge(shells_new, on=["event", "side"])
    sizes = [
        {
            "side": side,
            "median": [float(part[f"stiff_sheets_{which}"].median()) for which in "xy"],
            "other": int((part["stiff_sheets_x"] != part["stiff_sheets_y"]).sum()),
            "of": len(part),
        }
        for side in (-1, 1)
        if len(part := sides[sides["side"] == side])
    ]
    return {"ratios": ratios, "shells": sizes}


def _pairs(old_px: Floats, new_px: Floats, pitch_px: float) -> tuple[Ints, Ints]:
    """Sheets of two runs that are each other's nearest, within half a pitch."""
    distance = np.nan_to_num(np.abs(old_px[:, None] - new_px[None, :]), nan=np.inf)
    nearest = distance.argmin(axis=1)
    old = np.arange(len(old_px))
    mutual = (distance.argmin(axis=0)[nearest] == old) & (distance[old, nearest] < 0.5 * pitch_px)
    return old[mutual], nearest[mutual].astype(np.int64)


def _of_positions(before: Positions, after: Positions, old: Ints, new: Ints) -> dict[str, Any]:
    """How the positions of the sheets in both runs differ, a sheet at a time."""
    known, gained, lost, differ, other = np.zeros(2, np.int64), 0, 0, 0, 0
    moved: list[Floats32] = []
    for a, b in zip(old, new, strict=True):
        was, will = before.x_px[:, a], after.x_px[:, b]
        there, then = np.isfinite(was), np.isfinite(will)
        gained, lost = gained + int((then & ~there).sum()), lost + int((there & ~then).sum())
        both = there & then
        away = np.abs(will - was)[both]
        error = np.hypot(before.err_px[:, a], after.err_px[:, b])[both]
        differ += int((away > DIFFERENT * error).sum())
        other += int((away > 0.5 * before.track_facts.pitch_px).sum())
        moved.append(away)
    for k, part in enumerate((before, after)):
        known[k] = np.isfinite(part.x_px).sum()
    all_moved = np.concatenate(moved) if moved else np.empty(0, np.float32)
    return {
        "sheets": [[int((part.side == side).sum()) for side in (-1, 1)] for part in (before, after)],
        "positions": known,
        "doubtful": [int(part.doubtful.sum()) for part in (before, after)],
        "error_px": [float(np.nanmedian(part.err_px)) for part in (before, after)],
        "gained": gained,
        "lost": lost,
        "compared": len(all_moved),
        "differ": differ,
        "other_ridge": other,
        "median_px": float(np.median(all_moved)) if all_moved.size else None,
        "largest_px": float(all_moved.max()) if all_moved.size else None,
    }
