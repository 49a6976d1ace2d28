"""What a decision does to positions that are measured already, without tracking again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vision.numeric import Floats, Floats32, Ints, nan_median
from vision.review.positions import CELLS, DOUBTFUL, FLAGS, POSITIONED, WHYS, Positions
from vision.sheets.corrections import OF_SHEETS, Correction, apply_corrections, check_there
from vision.sheets.numbering import number_sheets
from vision.sheets.recovery import Detections
from vision.sheets.ridges import Polarity, RidgeComb, Ridges, find_ridges
from vision.sheets.settings import TrackingSettings
from vision.sheets.subpixel import FitName, fit_sheets

Undo = Callable[[Positions], Positions]

BLOCK = 2048  # frames in which a ridge is followed at a time
MEDIAN_ROWS = 2000  # frames from which a sheet's usual place is taken


@dataclass(frozen=True)
class Diagram:
    """I(x, t) with what is needed to find its ridges again.

    Parameters
    ----------
    values
        (frame, x), grey levels; may be memory-mapped.
    first_column
        Of the picture, at which it begins.
    settings
        Of the tracking.
    """

    values: Floats32
    first_column: int
    settings: TrackingSettings

    def ridges(self, positions: Positions, rows: slice | Ints) -> Ridges:
        """Candidates in these frames, as the tracking saw them; columns counted from the diagram's first."""
        profile = np.asarray(self.values[rows], np.float32)
        return find_ridges(profile, comb_of(positions), settings=self.settings)


def comb_of(positions: Positions) -> RidgeComb:
    """What the ridges look like, as the tracking measured it."""
    facts = positions.track_facts
    polarity: Polarity = "bright" if facts.ridges == "bright" else "dark"
    count = float(facts.sheets)
    return RidgeComb(
        polarity, facts.ridge_fwhm_px, facts.pitch_px, facts.contrast, facts.profile_noise, count, 0.0
    )


def apply(positions: Positions, decision: Correction, diagram: Diagram) -> tuple[Positions, Undo]:
    """Positions after a decision, and how to take it back.

    Arrays are changed in place where the number of sheets stays. New positions are those of the sliding
    window; saving measures them like all others.

    Raises
    ------
    InputError
        Where the decision does not fit the positions; nothing is changed then.
    """
    if decision.kind == "axis":
        return _with_axis(positions, decision.x_px)
    if decision.kind not in OF_SHEETS:
        return positions, lambda now: now
    stop = np.inf if decision.stop is None else decision.stop
    rows = np.flatnonzero((positions.frame >= decision.first) & (positions.frame < stop))
    check_there(decision, rows, positions.frame, positions.sheets)
    part = slice(int(rows[0]), int(rows[-1]) + 1)
    if decision.kind == "delete":
        return _without(positions, decision.sheets[0])
    if decision.kind == "add":
        return _with_sheet(positions, decision, diagram)
    if decision.kind == "swap":
        _swap(positions, part, decision.sheets)
        return positions, lambda now: _swap(now, part, decision.sheets)
    sheet = decision.sheets[0]
    if decision.kind == "leave_out":
        changed = {"x_px": np.full(len(rows), np.nan), "flag": np.full(len(rows), FLAGS.index("left_out"))}
    else:
        changed = _measured(positions, decision, part, diagram)
    before = {name: getattr(positions, name)[part, sheet].copy() for name in CELLS}
    _put(positions, part, sheet, changed)

    def undo(now: Positions) -> Positions:
        for name, values in before.items():
            getattr(now, name)[part, sheet] = values
        return now

    return positions, undo


def _swap(positions: Positions, rows: slice, sheets: tuple[int, ...]) -> Positions:
    one, other = sheets
    for name in CELLS:
        values = getattr(positions, name)
        values[rows, [one, other]] = values[rows, [other, one]]
    return positions


def _put(positions: Positions, rows: slice, sheet: int, changed: dict[str, NDArray[Any]]) -> None:
    """New positions and flags of one sheet; its usual error, and no doubt any more."""
    known = positions.err_px[:, sheet][np.isfinite(positions.err_px[:, sheet])]
    usual = float(np.median(known)) if known.size else float(np.nanmedian(positions.err_px))
    x = changed["x_px"]
    positions.x_px[rows, sheet] = x
    positions.err_px[rows, sheet] = np.where(np.isfinite(x), usual, np.nan)
    positions.flag[rows, sheet] = changed["flag"]
    positions.why[rows, sheet] = 0
    positions.withheld_px[rows, sheet] = np.nan


# --- ridges that become a sheet's ---------------------------------------------------------------------------


def _measured(
    positions: Positions, decision: Correction, part: slice, diagram: Diagram
) -> dict[str, NDArray[Any]]:
    """Positions and flags of the sheet of "accept" or "assign" in these rows."""
    sheet = decision.sheets[0]
    x, flag = positions.x_px[part, sheet].copy(), positions.flag[part, sheet].copy()
    begin = part.start
    wanted = decision
    if decision.kind == "accept":
        doubted = np.flatnonzero(flag == DOUBTFUL)
        begin, end = (part.start + int(doubted[k]) for k in (0, -1)) if doubted.size else (begin, begin)
        part_end = end + 1
    else:
        part_end = part.stop
    while begin < part_end:
        rows = slice(begin, min(begin + BLOCK, part_end))
        settled = not (positions.flag[rows, sheet] == DOUBTFUL).any()
        if decision.kind == "accept" and doubted.size and settled:
            begin = rows.stop
            continue
        numbers = positions.frame[rows]
        wanted = replace(wanted, first=int(numbers[0]), stop=int(numbers[-1]) + 1)
        found = _through_tracking(positions, wanted, rows, diagram)
        new = found.start_px[:, sheet]
        changed = np.isfinite(new) | (found.flag[:, sheet] != np.asarray(FLAGS)[positions.flag[rows, sheet]])
        if decision.kind == "accept":
            changed = positions.flag[rows, sheet] == DOUBTFUL
        here = slice(rows.start - part.start, rows.stop - part.start)
        fitted = _fitted(positions, new, rows, diagram)
        x[here] = np.where(changed, fitted, x[here])
        flag[here] = np.where(changed, _codes(found.flag[:, sheet], fitted), flag[here])
        begin = rows.stop
        if decision.kind == "assign" and begin < part_end:
            seen = np.flatnonzero(np.isfinite(new))
            begin = rows.start + int(seen[-1])  # goes on from where the ridge was seen last
            wanted = replace(wanted, x_px=float(new[seen[-1]]) + diagram.first_column)
            if begin == rows.start:
                break
    return {"x_px": x, "flag": flag}


def _through_tracking(
    positions: Positions, decision: Correction, rows: slice, diagram: Diagram
) -> Detections:
    """What the tracking makes of a decision in these rows."""
    shape = positions.x_px[rows].shape
    comb, origin = comb_of(positions), diagram.first_column
    ridges = diagram.ridges(positions, rows)
    detections = Detections(
        start_px=_whole_pixels(positions.x_px[rows] - origin, ridges),
        contrast=np.full(shape, comb.contrast),
        fwhm_px=np.full(shape, comb.fwhm_px),
        flag=np.asarray(FLAGS)[positions.flag[rows]],
        why=np.asarray(WHYS)[positions.why[rows]],
        withheld_px=positions.withheld_px[rows] - np.float64(origin),
    )
    return apply_corrections(
        detections,
        ridges,
        [decision],
        comb,
        frames=positions.frame[rows],
        origin_px=origin,
        settings=diagram.settings,
    )


def _whole_pixels(x_px: Floats, ridges: Ridges) -> Floats:
    """The candidate nearest to each position, within 2 px: the pixel from which it was fitted."""
    out = np.full(x_px.shape, np.nan)
    for k in range(ridges.x_px.shape[1]):  # a column at a time: memory of one (frame, sheet)
        at = ridges.x_px[:, k : k + 1]
        near = np.abs(x_px - at) <= 2.0
        better = near & ~(np.abs(x_px - out) <= np.abs(x_px - at))
        out = np.where(better, at, out)
    return np.where(np.isfinite(out), out, np.rint(x_px))


def _fitted(positions: Positions, start_px: Floats, rows: slice, diagram: Diagram) -> Floats:
    """Subpixel positions from whole pixels (frame,), as columns of the picture."""
    profile = np.asarray(diagram.values[rows], np.float32)
    comb, facts = comb_of(positions), positions.track_facts
    fit: FitName = "paper" if facts.fit == "paper" else "sliding"
    bright = profile if comb.sign > 0 else -profile
    x, _ = fit_sheets(bright, start_px[:, None], fit=fit, window_px=facts.window_px, comb=comb)
    return np.asarray(x[:, 0] + diagram.first_column, np.float64)


def _codes(words: NDArray[np.str_], x_px: Floats) -> NDArray[np.uint8]:
    """Places in `FLAGS`; "unfit" where a ridge has no position."""
    codes = np.zeros(words.shape, np.uint8)
    for code, word in enumerate(FLAGS):
        codes[words == word] = code
    return np.where((codes == 0) & ~np.isfinite(x_px), FLAGS.index("unfit"), codes).astype(np.uint8)


# --- sheets and axis ----------------------------------------------------------------------------------------


def usual_places(positions: Positions) -> Floats:
    """Median position of every sheet, from frames spread over the run."""
    return nan_median(positions.x_px[:: max(1, len(positions.x_px) // MEDIAN_ROWS)])


def _renumbered(positions: Positions, axis_px: float) -> Positions:
    numbering = number_sheets(usual_places(positions)[None], axis_px=axis_px)
    return replace(positions, side=numbering.side, n=numbering.n)


def _with_axis(positions: Positions, axis_px: float | None) -> tuple[Positions, Undo]:
    side, n, attrs = positions.side, positions.n, positions.attrs
    about = dict(attrs) | {"axis_px": float(axis_px or 0.0), "axis_how": "given"}
    moved = replace(_renumbered(positions, float(axis_px or 0.0)), attrs=about)
    return moved, lambda now: replace(now, side=side, n=n, attrs=attrs)


def _without(positions: Positions, sheet: int) -> tuple[Positions, Undo]:
    before = {name: getattr(positions, name)[:, sheet].copy() for name in CELLS}
    side, n = positions.side, positions.n
    columns = {name: np.delete(getattr(positions, name), sheet, axis=1) for name in CELLS}
    fewer = replace(positions, **columns, side=np.delete(side, sheet), n=np.delete(n, sheet))

    def undo(now: Positions) -> Positions:
        wider = {name: np.insert(getattr(now, name), sheet, before[name], axis=1) for name in CELLS}
        return replace(now, **wider, side=side, n=n)

    return _renumbered(fewer, fewer.track_facts.axis_px), undo


def _with_sheet(positions: Positions, decision: Correction, diagram: Diagram) -> tuple[Positions, Undo]:
    """One more sheet, followed both ways in blocks; each block begins where the ridge was last seen."""
    frames = len(positions.frame)
    row = positions.row_of(decision.first)
    x, origin = np.full(frames, np.nan), diagram.first_column
    place = -1
    for ahead in (True, False):
        at, column = row, float(decision.x_px or 0.0)
        while 0 <= at < frames:
            rows = slice(at, min(at + BLOCK, frames)) if ahead else slice(max(0, at + 1 - BLOCK), at + 1)
            wanted = replace(decision, first=int(positions.frame[at]), stop=int(positions.frame[at]) + 1)
            found = _through_tracking(positions, replace(wanted, x_px=column), rows, diagram)
            where = _new_column(found.start_px, _whole_pixels_of(positions, rows, diagram))
            place = where if place < 0 else place
            new = found.start_px[:, where]
            x[rows] = np.where(np.isfinite(new), _fitted(positions, new, rows, diagram), x[rows])
            seen = np.flatnonzero(np.isfinite(new))
            end = rows.start + int(seen[-1] if ahead else seen[0]) if seen.size else at
            done = rows.stop == frames if ahead else rows.start == 0
            if done or end == at:
                break
            at, column = end, float(new[seen[-1] if ahead else seen[0]]) + origin
    empty: dict[str, Any] = {"flag": FLAGS.index("missing"), "why": 0}
    side, n = positions.side, positions.n
    wider = {
        name: np.insert(getattr(positions, name), place, empty.get(name, np.nan), axis=1) for name in CELLS
    }
    more = replace(positions, **wider, side=np.insert(side, place, 1), n=np.insert(n, place, 1))
    state = np.where(np.isfinite(x), FLAGS.index("ok"), FLAGS.index("missing"))
    _put(more, slice(None), place, {"x_px": x, "flag": state})

    def undo(now: Positions) -> Positions:
        fewer = {name: np.delete(getattr(now, name), place, axis=1) for name in CELLS}
        return replace(now, **fewer, side=side, n=n)

    return _renumbered(more, more.track_facts.axis_px), undo


def _whole_pixels_of(positions: Positions, rows: slice, diagram: Diagram) -> Floats:
    return _whole_pixels(positions.x_px[rows] - diagram.first_column, diagram.ridges(positions, rows))


def _new_column(wider: Floats, narrower: Floats) -> int:
    """Which column was put in."""
    same = [np.array_equal(wider[:, k], narrower[:, k], equal_nan=True) for k in range(narrower.shape[1])]
    return int(np.argmin([*same, False]))


def positioned(positions: Positions) -> NDArray[np.bool_]:
    """Where there is a position, (frame, sheet)."""
    return np.asarray(np.isin(positions.flag, POSITIONED), bool)
