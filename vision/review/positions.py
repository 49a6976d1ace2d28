"""Compact x(n, t) of a run, and the effect of decisions on it without tracking again.

A test of 100 000 frames and 50 sheets takes 70 MB.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from vision.clock import video_slips
from vision.data import TRACKS, StripMetadata, TrackMetadata
from vision.errors import InputError
from vision.numeric import Bools, Codes, Floats, Floats32, Ints, nan_median, nearest
from vision.review.recordings import Diagram
from vision.review.tracks_file import StoredTracks
from vision.run.tables import attrs_of_netcdf
from vision.sheets.corrections import OF_SHEETS, Correction, check_there, follow_ridge, not_taken
from vision.sheets.identities import WHYS
from vision.sheets.numbering import number_sheets
from vision.sheets.recovery import FLAGS, Flag, predicted_by_neighbours
from vision.sheets.ridges import RidgeComb, Ridges, find_ridges
from vision.sheets.subpixel import FitName, fit_sheets

CELLS = ("x_px", "err_px", "withheld_px", "flag", "why")
"""Names of the arrays of (frame, sheet)."""
SLIP_ROWS = 10_000
"""Rows in which slips are searched at a time. All of 100 000 rows would take 250 MB of memory; in parts with
fewer than about ten slips their typical size is poorly known."""


@dataclass(frozen=True, kw_only=True)
class Positions:
    """Positions of every sheet in every frame, or in a part of the frames."""

    frame: Ints  # numbers in the film, (frame,)
    time_s: Floats  # camera's clock, (frame,)
    # (frame, sheet), NaN if there is no position. Single precision, 1e-4 px, is enough for display; saving
    # does not use these values.
    x_px: Floats32
    err_px: Floats32  # standard error
    withheld_px: Floats32  # ridge whose identity is doubtful
    flag: Codes  # a `Flag`, (frame, sheet)
    why: Codes  # a `Doubt`, (frame, sheet)
    # numbering from the axis, (sheet,)
    side: Ints
    n: Ints
    attrs: Mapping[str, Any]  # metadata of the tracks
    first_row: int = 0  # row of the run at which this part begins

    @property
    def sheets(self) -> int:
        """Number of sheets."""
        return int(self.x_px.shape[1])

    @property
    def track_facts(self) -> TrackMetadata:
        """How the sheets were found."""
        return TrackMetadata.of(xr.Dataset(attrs=self.attrs))

    @property
    def strip_facts(self) -> StripMetadata:
        """How the strip was read."""
        return StripMetadata.of(xr.Dataset(attrs=self.attrs))

    def comb(self, diagram: Diagram) -> RidgeComb:
        """Return the appearance of the ridges, as the tracking measured it."""
        return RidgeComb.of(self.track_facts, diagram.columns, diagram.settings)

    def expected_px(self, rows: Ints) -> Floats:
        """Return the position of each sheet predicted from its neighbours, in these rows."""
        # further rows, spread over the run, show how neighbours move together
        spread = np.arange(0, len(self.x_px), max(1, len(self.x_px) // 300))
        predicted = predicted_by_neighbours(self.x_px[np.concatenate([spread, rows])].astype(np.float64))
        return predicted[len(spread) :]

    @property
    def doubtful(self) -> Bools:
        """Whether each identity is doubtful, (frame, sheet)."""
        return np.asarray(self.flag == Flag.DOUBTFUL, bool)

    def tracks(self, rows: slice | Ints = slice(None)) -> xr.Dataset:
        """Return rows as `track_sheets` does, without the flags, which clock and deformation do not need."""
        values: dict[str, Any] = {
            "x_px": self.x_px[rows].astype(np.float64),
            "x_err_px": self.err_px[rows].astype(np.float64),
            "time_s": self.time_s[rows],
            "side": self.side,
            "n": self.n,
        }
        data = {name: (TRACKS[name].dims, one, TRACKS[name].attrs) for name, one in values.items()}
        axes = {"frame": self.frame[rows], "sheet": np.arange(self.sheets)}
        return xr.Dataset(data, axes, dict(self.attrs)).set_coords(["time_s", "side", "n"])

    def slips_s(self) -> Floats:
        """Return the times at which the sheets step outwards, s on the camera's clock."""
        frames = len(self.frame)
        parts = [slice(k, min(k + SLIP_ROWS, frames) + 1) for k in range(0, frames, SLIP_ROWS)]
        return np.concatenate([_slips_in(self.tracks(part)) for part in parts])

    def row_of(self, frame: int) -> int:
        """Return the row of a frame number.  Raises: InputError for a frame that the run does not have."""
        row = int(np.searchsorted(self.frame, frame))
        if row >= len(self.frame) or self.frame[row] != frame:
            raise InputError("the frame", f"one from {self.frame[0]} to {self.frame[-1]}", f"{frame}")
        return row

    def ridges(self, diagram: Diagram, rows: slice) -> Ridges:
        """Find the ridges in these rows as the tracking does; x counts from the diagram's first column."""
        profile = diagram.rows(self.first_row + rows.start, self.first_row + rows.stop)
        return find_ridges(profile, self.comb(diagram))

    def copied(self, rows: slice) -> Positions:
        """Return a copy of some rows that can be changed independently."""
        arrays = {name: getattr(self, name)[rows].copy() for name in (*CELLS, "frame", "time_s")}
        return replace(self, **arrays, first_row=self.first_row + rows.start)


def _slips_in(tracks: xr.Dataset) -> Floats:
    """Return the times of slips in a part of the film; none if it has too few frames or no times."""
    try:
        return np.asarray(video_slips(tracks)["time_s"], np.float64)
    except InputError:
        return np.empty(0)


def positions_of(stored: StoredTracks) -> Positions:
    """Convert stored tracks into positions."""
    arrays, shape = stored.arrays, stored.arrays["x_px"].shape
    attrs = {name: value for name, value in stored.attrs.items() if name not in ("Conventions", "title")}
    return Positions(
        frame=arrays["frame"],
        time_s=arrays["time_s"],
        x_px=arrays["x_px"],
        err_px=arrays["x_err_px"],
        withheld_px=arrays.get("x_withheld_px", np.full(shape, np.nan, np.float32)),
        flag=_codes(stored, "flag", FLAGS),
        why=_codes(stored, "why", WHYS),
        side=arrays["side"],
        n=arrays["n"],
        attrs=attrs_of_netcdf(attrs),
    )


def _codes(stored: StoredTracks, name: str, words: Sequence[str]) -> Codes:
    """Return the stored words of an array as indices in `words`; 0 for those that are not in it."""
    if name not in stored.arrays:
        return np.zeros(stored.arrays["x_px"].shape, np.uint8)
    code = [words.index(word) if word in words else 0 for word in stored.words[name]]
    return np.take(np.array([*code, 0], np.uint8), stored.arrays[name])


# --- decisions ----------------------------------------------------------------------------------------------

BLOCK = 2048  # frames in which a ridge is followed at a time, so that candidates take little memory
MEDIAN_ROWS = 2000  # frames from which the median position of a sheet is computed
SAME_RIDGE_PX = 2.0
"""Distance within which a position and the whole pixel of a candidate are the same ridge: fits end this close
to their start. A larger value would join neighbours that are 4 px apart."""
_EMPTY: Mapping[str, Any] = {"flag": Flag.MISSING, "why": 0}


@dataclass(frozen=True, kw_only=True)
class UndoStep:
    """What is needed to undo a decision: the values that it replaced, and the earlier numbering."""

    how: str  # "cells" (were replaced), "deleted" or "added" (a sheet), "numbered"
    first: int  # row
    stop: int  # row
    sheets: tuple[int, ...]  # columns
    arrays: Mapping[str, NDArray[Any]]  # earlier values by name: side, n and, unless a sheet was added, cells
    # earlier axis
    axis_px: float
    axis_how: str


def _step(
    positions: Positions, how: str, sheets: tuple[int, ...] = (), rows: slice = slice(0, 0)
) -> UndoStep:
    """Return the step that undoes a change of these cells, or of the numbering."""
    facts, columns = positions.track_facts, sheets[0] if how == "deleted" else list(sheets)
    cells = CELLS if how in ("cells", "deleted") else ()
    return UndoStep(
        how=how,
        first=rows.start,
        stop=rows.stop,
        sheets=sheets,
        arrays={name: getattr(positions, name)[rows, columns].copy() for name in cells}
        | {"side": positions.side, "n": positions.n},
        axis_px=facts.axis_px,
        axis_how=facts.axis_how,
    )


def median_positions(positions: Positions) -> Floats:
    """Return the median position of every sheet, from frames spread over the run."""
    return _medians(positions.x_px)


def _medians(values: Floats32) -> Floats:
    return nan_median(values[:: max(1, len(values) // MEDIAN_ROWS)].astype(np.float64))


def apply(positions: Positions, decision: Correction, diagram: Diagram) -> tuple[Positions, UndoStep]:
    """Apply a decision; return the new positions and how to undo it.

    If the number of sheets does not change, the arrays are changed in place. Ridges are searched in the
    diagram and fitted with the sliding window; they get the sheet's median error. (Saving tracks again, with
    the run's own fit.) Decisions about strip and clock change nothing here. Sheets are counted as in these
    positions.

    Raises: InputError if the decision is not valid for the positions, which are not changed then.
    """
    if decision.kind == "axis":
        attrs = dict(positions.attrs) | {"axis_px": float(decision.x_px or 0.0), "axis_how": "given"}
        return _renumbered(replace(positions, attrs=attrs)), _step(positions, "numbered")
    if decision.kind not in OF_SHEETS:
        return positions, _step(positions, "numbered")
    stop = np.inf if decision.stop is None else decision.stop
    rows = np.flatnonzero((positions.frame >= decision.first) & (positions.frame < stop))
    check_there(decision, rows, positions.frame, positions.sheets)
    if decision.kind == "add":
        return _with_sheet(positions, decision, diagram)
    if decision.kind == "delete":
        before = _step(positions, "deleted", decision.sheets, slice(0, len(positions.frame)))
        return _renumbered(_removed(positions, decision.sheets[0])), before
    part = slice(int(rows[0]), int(rows[-1]) + 1)
    before = _step(positions, "cells", decision.sheets, part)
    if decision.kind == "swap":
        for name in CELLS:
            getattr(positions, name)[part, list(decision.sheets)] = before.arrays[name][:, ::-1]
    else:
        find = {"leave_out": _left_out, "accept": _accepted, "assign": _assigned}[decision.kind]
        _put(positions, part, decision.sheets[0], *find(positions, decision, part, diagram))
    return positions, before


def undo(positions: Positions, step: UndoStep) -> Positions:
    """Undo the last decision and return the earlier positions."""
    arrays = step.arrays
    match step.how:
        case "cells":
            for name in CELLS:
                getattr(positions, name)[step.first : step.stop, list(step.sheets)] = arrays[name]
        case "deleted":
            positions = _inserted(positions, step.sheets[0], arrays)
        case "added":
            positions = _removed(positions, step.sheets[0])
    attrs = dict(positions.attrs) | {"axis_px": step.axis_px, "axis_how": step.axis_how}
    return replace(positions, side=arrays["side"], n=arrays["n"], attrs=attrs)


def _put(positions: Positions, rows: slice, sheet: int, x: Floats, flag: NDArray[Any]) -> None:
    """Set positions and flags of one sheet, with its median error; clear the doubt where it is settled."""
    known = positions.err_px[:, sheet][np.isfinite(positions.err_px[:, sheet])]
    error = np.median(known) if known.size else np.nanmedian(_medians(positions.err_px))
    settled = flag != Flag.DOUBTFUL
    positions.x_px[rows, sheet] = x
    positions.err_px[rows, sheet] = np.where(np.isfinite(x), error, np.nan)
    positions.flag[rows, sheet] = flag
    positions.why[rows, sheet] = np.where(settled, 0, positions.why[rows, sheet])
    positions.withheld_px[rows, sheet] = np.where(settled, np.nan, positions.withheld_px[rows, sheet])


# --- ridges that are assigned to a sheet --------------------------------------------------------------------


def _left_out(
    positions: Positions, decision: Correction, part: slice, diagram: Diagram
) -> tuple[Floats, NDArray[Any]]:
    """Return no positions for these rows."""
    rows = part.stop - part.start
    return np.full(rows, np.nan), np.full(rows, Flag.LEFT_OUT)


def _accepted(
    positions: Positions, decision: Correction, part: slice, diagram: Diagram
) -> tuple[Floats, NDArray[Any]]:
    """Return positions and flags of these rows, with the doubtful ridges fitted."""
    sheet = decision.sheets[0]
    x, flag = positions.x_px[part, sheet].astype(np.float64), positions.flag[part, sheet].copy()
    doubtful = np.flatnonzero(flag == Flag.DOUBTFUL)
    if not len(doubtful):
        raise InputError(decision.name, "a doubtful stretch to accept", "none in these frames")
    withheld = positions.withheld_px[part, sheet][doubtful] - np.float64(diagram.first_column)
    x[doubtful] = _fitted(positions, np.rint(withheld), part.start + doubtful, diagram)
    flag[doubtful] = np.where(np.isfinite(x[doubtful]), Flag.OK, Flag.UNFIT)
    return x, flag


def _assigned(
    positions: Positions, decision: Correction, part: slice, diagram: Diagram
) -> tuple[Floats, NDArray[Any]]:
    """Return positions and flags of these rows, with the assigned ridge followed."""
    start, other = _followed(positions, decision, part, diagram, without=decision.sheets[0])
    if (other >= 0).any():
        row = int((other >= 0).argmax())
        raise not_taken(decision, int(positions.frame[part.start + row]), int(other[row]))
    x = _fitted(positions, start, np.arange(part.start, part.stop), diagram)
    return x, _flags(start, x)


def _with_sheet(positions: Positions, decision: Correction, diagram: Diagram) -> tuple[Positions, UndoStep]:
    """Add a sheet, followed from the given frame in both directions of time."""
    row, frames = positions.row_of(decision.first), len(positions.frame)
    start, other = np.full(frames, np.nan), np.full(frames, -1)
    for part in (slice(row, frames), slice(0, row + 1)):
        start[part], other[part] = _followed(positions, decision, part, diagram, back=part.start < row)
    if other[row] >= 0:
        raise not_taken(decision, decision.first, int(other[row]))
    start[other >= 0] = np.nan
    x = _fitted(positions, start, np.arange(frames), diagram)
    here = positions.x_px[row]
    others = np.where(np.isfinite(here), here, median_positions(positions))
    sheet = int((others < start[row] + diagram.first_column).sum())
    wider = _inserted(positions, sheet, _EMPTY)
    more = replace(wider, side=np.insert(positions.side, sheet, 1), n=np.insert(positions.n, sheet, 1))
    _put(more, slice(0, frames), sheet, x, _flags(start, x))
    return _renumbered(more), _step(positions, "added", (sheet,))


def _flags(start: Floats, x: Floats) -> NDArray[Any]:
    """Return the flags of a sheet with ridges `start` and fitted positions `x`."""
    found = np.where(np.isfinite(x), Flag.OK, Flag.UNFIT)
    return np.where(np.isfinite(start), found, Flag.MISSING)


def _followed(
    positions: Positions,
    decision: Correction,
    part: slice,
    diagram: Diagram,
    *,
    without: int | None = None,
    back: bool = False,
) -> tuple[Floats, Ints]:
    """Follow a ridge through these rows.

    Return its whole pixels, NaN where it is lost, and the sheet that has this ridge already, -1 if none. A
    block of rows starts where the ridge was last seen. `without`: sheet to ignore. `back`: backwards in time.
    """
    comb, origin = positions.comb(diagram), float(diagram.first_column)
    start, other = np.full(len(positions.frame), np.nan), np.full(len(positions.frame), -1)
    at, wanted = (part.stop - 1 if back else part.start), decision
    while True:
        first, stop = (at + 1 - BLOCK, at + 1) if back else (at, at + BLOCK)
        rows = slice(max(part.start, first), min(part.stop, stop))
        ridges = positions.ridges(diagram, rows)
        x_px = positions.x_px[rows] - np.float64(origin)
        fitted_from = nearest_ridges(ridges.x_px, x_px, SAME_RIDGE_PX)
        owned = np.where(np.isfinite(fitted_from), fitted_from, np.rint(x_px))
        if without is not None:
            owned[:, without] = np.nan
        order = np.arange(rows.stop - rows.start)[:: -1 if back else 1]
        found = np.empty(len(order))
        found[order] = follow_ridge(wanted, order, owned, ridges, comb, origin_px=origin)
        start[rows] = found
        shared = owned == found[:, None]
        other[rows] = np.where(shared.any(axis=1), shared.argmax(axis=1), -1)
        if (rows.start == part.start) if back else (rows.stop == part.stop):
            return start[part], other[part]
        seen = np.flatnonzero(np.isfinite(found))
        last = int(seen[0] if back else seen[-1])
        if rows.start + last == at:  # not found again in a whole block
            return start[part], other[part]
        at, wanted = rows.start + last, replace(decision, x_px=float(found[last]) + origin)


def nearest_ridges(ridges_px: NDArray[np.floating], targets: Floats, reach: float) -> Floats:
    """Return the candidate nearest to each target (frame, target) in its frame; NaN if none is in reach."""
    out = np.full(targets.shape, np.nan)
    for k, at in enumerate(targets.T):  # one at a time needs little memory
        best, distance = nearest(ridges_px, at)
        out[:, k] = np.where(distance <= reach, ridges_px[np.arange(len(at)), best], np.nan)
    return out


def _fitted(positions: Positions, start_px: Floats, rows: Ints, diagram: Diagram) -> Floats:
    """Fit subpixel positions, in columns of the picture, to ridges at whole pixels in these rows."""
    comb, facts = positions.comb(diagram), positions.track_facts
    fit: FitName = "paper" if facts.fit == "paper" else "sliding"
    x = np.full(len(rows), np.nan)
    for begin in range(0, len(rows), BLOCK):
        part = slice(begin, begin + BLOCK)
        first, last = int(rows[part][0]), int(rows[part][-1]) + 1
        profile = diagram.rows(positions.first_row + first, positions.first_row + last)[rows[part] - first]
        bright = comb.bright(profile)
        found, _ = fit_sheets(bright, start_px[part, None], fit=fit, window_px=facts.window_px, comb=comb)
        x[part] = found[:, 0]
    return x + diagram.first_column


# --- sheets and axis ----------------------------------------------------------------------------------------


def _renumbered(positions: Positions) -> Positions:
    """Number the sheets from the axis; one without any position lies between its neighbours."""
    facts, x_px = positions.track_facts, median_positions(positions)
    known = np.flatnonzero(np.isfinite(x_px))
    if not known.size:
        raise InputError("the decision", "a sheet with a position that remains", "none")
    x_px = np.interp(np.arange(len(x_px)), known, x_px[known])
    numbering = number_sheets(x_px[None], axis_px=facts.axis_px)
    unseen = 0 if facts.axis_how == "given" else numbering.n.min() - 1
    return replace(positions, side=numbering.side, n=numbering.n - unseen)


def _removed(positions: Positions, sheet: int) -> Positions:
    cells = {name: np.delete(getattr(positions, name), sheet, axis=1) for name in CELLS}
    return replace(positions, **cells, side=np.delete(positions.side, sheet), n=np.delete(positions.n, sheet))


def _inserted(positions: Positions, sheet: int, values: Mapping[str, Any]) -> Positions:
    """Insert a column with these values, NaN for arrays that are not among them."""
    earlier = {name: getattr(positions, name) for name in CELLS}
    cells = {k: np.insert(one, sheet, values.get(k, np.nan), axis=1) for k, one in earlier.items()}
    return replace(positions, **cells)
