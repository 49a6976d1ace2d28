"""x(n, t) of a run in little memory, and what a decision does to it without tracking again.

A test of 100 000 frames and 50 sheets takes 70 MB.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from vision.clock import video_slips
from vision.data import TRACKS, StripMetadata, TrackMetadata
from vision.errors import InputError
from vision.numeric import Bools, Floats, Floats32, Ints, nan_median
from vision.review.recordings import Diagram
from vision.review.tracks_file import StoredTracks
from vision.run.tables import attrs_of_netcdf
from vision.sheets.corrections import OF_SHEETS, Correction, check_there, follow_ridge, not_taken
from vision.sheets.neighbours import predicted_by_neighbours
from vision.sheets.numbering import number_sheets
from vision.sheets.recovery import DOUBTS
from vision.sheets.ridges import RidgeComb, Ridges, find_ridges
from vision.sheets.subpixel import FitName, fit_sheets

Codes = NDArray[np.uint8]

FLAGS = (
    "ok", "blurred", "edge", "missing", "merged", "unfit", "left_out", "frozen", "blank", "corrupt", "lost",
    "doubtful",
)  # fmt: skip
"""Words of `flag`, the worse the later: of several frames that share a pixel the worst is shown."""
WHYS = ("", *DOUBTS)
DOUBTFUL = FLAGS.index("doubtful")
CELLS = ("x_px", "err_px", "withheld_px", "flag", "why")
"""Arrays of (frame, sheet)."""
SLIP_ROWS = 10_000
"""In which slips are looked for at a time: all of 100 000 take 250 MB of memory; with fewer than some ten
slips in a part their usual size is not known well."""


@dataclass(frozen=True, kw_only=True)
class Positions:
    """Every sheet in every frame."""

    frame: Ints  # numbers in the film, (frame,)
    time_s: Floats  # of the camera's clock, (frame,)
    # (frame, sheet), NaN where there is none. In single precision, 1e-4 px, which is enough to look at;
    # saving does not use them.
    x_px: Floats32
    err_px: Floats32  # standard error
    withheld_px: Floats32  # the doubted ridge
    flag: Codes  # place in `FLAGS`, (frame, sheet)
    why: Codes  # place in `WHYS`, (frame, sheet)
    # as numbered from the axis, (sheet,)
    side: Ints
    n: Ints
    attrs: Mapping[str, Any]  # of the tracks: how they were found
    first_row: int = 0  # of the run, at which a part of it begins

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

    @property
    def comb(self) -> RidgeComb:
        """What the ridges look like, as the tracking measured it."""
        return RidgeComb.of(self.track_facts)

    def expected_px(self, rows: Ints) -> Floats:
        """Where the sheets around say that each sheet must be, in these rows."""
        usual = np.arange(0, len(self.x_px), max(1, len(self.x_px) // 300))  # how neighbours move together
        said = predicted_by_neighbours(self.x_px[np.concatenate([usual, rows])].astype(np.float64))
        return said[len(usual) :]

    @property
    def doubtful(self) -> Bools:
        """Where an identity is in doubt, (frame, sheet)."""
        return np.asarray(self.flag == DOUBTFUL, bool)

    def tracks(self, rows: slice | Ints = slice(None)) -> xr.Dataset:
        """These rows as `track_sheets` returns them, without the words, which neither clock nor deformation
        needs."""
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
        """When the sheets themselves step outwards, whatever the clock, s; a part of the film at a time."""
        frames = len(self.frame)
        parts = [slice(k, min(k + SLIP_ROWS, frames) + 1) for k in range(0, frames, SLIP_ROWS)]
        return np.concatenate([_slips_in(self.tracks(part)) for part in parts])

    def row_of(self, frame: int) -> int:
        """Row of a frame number.  Raises: InputError for a frame that the run does not have."""
        row = int(np.searchsorted(self.frame, frame))
        if row >= len(self.frame) or self.frame[row] != frame:
            raise InputError("the frame", f"one from {self.frame[0]} to {self.frame[-1]}", f"{frame}")
        return row

    def ridges(self, diagram: Diagram, rows: slice) -> Ridges:
        """Candidates in these rows, as the tracking saw them; x from the diagram's first column."""
        profile = diagram.rows(self.first_row + rows.start, self.first_row + rows.stop)
        return find_ridges(profile, self.comb, settings=diagram.settings)

    def copied(self, rows: slice) -> Positions:
        """A part that can be changed without changing this."""
        arrays = {name: getattr(self, name)[rows].copy() for name in (*CELLS, "frame", "time_s")}
        return replace(self, **arrays, first_row=self.first_row + rows.start)


def _slips_in(tracks: xr.Dataset) -> Floats:
    """Of a part; none in too few frames, or without times."""
    try:
        return np.asarray(video_slips(tracks)["time_s"], np.float64)
    except InputError:
        return np.empty(0)


def positions_of(stored: StoredTracks) -> Positions:
    """What has been read."""
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
    """Words as places in another list; 0 for those that are not in it."""
    if name not in stored.arrays:
        return np.zeros(stored.arrays["x_px"].shape, np.uint8)
    place = [words.index(word) if word in words else 0 for word in stored.words[name]]
    return np.take(np.array([*place, 0], np.uint8), stored.arrays[name])


# --- decisions ----------------------------------------------------------------------------------------------

BLOCK = 2048  # frames in which a ridge is followed at a time, so that candidates take little memory
MEDIAN_ROWS = 2000  # frames from which a sheet's usual place is taken
SAME_RIDGE_PX = 2.0
"""Distance within which a position and a candidate's whole pixel are one ridge: fits end that near to where
they start. More would join neighbours that are 4 px apart."""
_EMPTY: Mapping[str, Any] = {"flag": FLAGS.index("missing"), "why": 0}


@dataclass(frozen=True, kw_only=True)
class Before:
    """What a decision replaced: enough to take it back."""

    how: str  # "swap", "cells" (of one sheet), "deleted", "added", "numbering" or "nothing"
    first: int = 0  # row
    stop: int = 0  # row
    sheets: tuple[int, ...] = ()  # columns
    arrays: Mapping[str, NDArray[Any]] = field(default_factory=dict)  # earlier values by their names
    # of the numbering
    axis_px: float = np.nan
    axis_how: str = ""


def usual_places(positions: Positions) -> Floats:
    """Median position of every sheet, from frames spread over the run."""
    return _usual(positions.x_px)


def _usual(values: Floats32) -> Floats:
    return nan_median(values[:: max(1, len(values) // MEDIAN_ROWS)].astype(np.float64))


def apply(positions: Positions, decision: Correction, diagram: Diagram) -> tuple[Positions, Before]:
    """Positions after a decision, and what it replaced.

    Arrays are changed in place where the number of sheets stays. New positions are those of the sliding
    window with the sheet's usual error; saving measures them like all others. Decisions about strip and clock
    change nothing here. Sheets are counted as in these positions; ridges are looked for in the diagram.

    Raises: InputError where the decision does not fit the positions; nothing is changed then.
    """
    if decision.kind == "axis":
        return _with_axis(positions, float(decision.x_px or 0.0))
    if decision.kind not in OF_SHEETS:
        return positions, Before(how="nothing")
    stop = np.inf if decision.stop is None else decision.stop
    rows = np.flatnonzero((positions.frame >= decision.first) & (positions.frame < stop))
    check_there(decision, rows, positions.frame, positions.sheets)
    first, last = int(rows[0]), int(rows[-1]) + 1
    match decision.kind:
        case "delete":
            return _without(positions, decision.sheets[0])
        case "add":
            return _with_sheet(positions, decision, diagram)
        case "swap":
            _swap(positions, slice(first, last), decision.sheets)
            return positions, Before(how="swap", first=first, stop=last, sheets=decision.sheets)
    part, sheet = slice(first, last), decision.sheets[0]
    if decision.kind == "leave_out":
        x, flag = np.full(last - first, np.nan), np.full(last - first, FLAGS.index("left_out"))
    elif decision.kind == "accept":
        x, flag = _accepted(positions, decision, part, diagram)
    else:
        x, flag = _assigned(positions, decision, part, diagram)
    before = {name: getattr(positions, name)[part, sheet].copy() for name in CELLS}
    _put(positions, part, sheet, x, flag)
    return positions, Before(how="cells", first=first, stop=last, sheets=(sheet,), arrays=before)


def take_back(positions: Positions, before: Before) -> Positions:
    """Positions as they were before the last decision."""
    rows, arrays = slice(before.first, before.stop), before.arrays
    match before.how:
        case "swap":
            _swap(positions, rows, before.sheets)
            return positions
        case "cells":
            for name in CELLS:
                getattr(positions, name)[rows, before.sheets[0]] = arrays[name]
            return positions
        case "deleted":
            return replace(_inserted(positions, before.sheets[0], arrays), side=arrays["side"], n=arrays["n"])
        case "added":
            return replace(_removed(positions, before.sheets[0]), side=arrays["side"], n=arrays["n"])
        case "numbering":
            attrs = dict(positions.attrs) | {"axis_px": before.axis_px, "axis_how": before.axis_how}
            return replace(positions, side=arrays["side"], n=arrays["n"], attrs=attrs)
    return positions


def _swap(positions: Positions, rows: slice, sheets: tuple[int, ...]) -> None:
    one, other = sheets
    for name in CELLS:
        values = getattr(positions, name)
        values[rows, [one, other]] = values[rows, [other, one]]


def _put(positions: Positions, rows: slice, sheet: int, x: Floats, flag: NDArray[Any]) -> None:
    """New positions and flags of one sheet; its usual error, and no doubt where there is none any more."""
    known = positions.err_px[:, sheet][np.isfinite(positions.err_px[:, sheet])]
    error = np.median(known) if known.size else np.nanmedian(_usual(positions.err_px))
    settled = flag != DOUBTFUL
    positions.x_px[rows, sheet] = x
    positions.err_px[rows, sheet] = np.where(np.isfinite(x), error, np.nan)
    positions.flag[rows, sheet] = flag
    positions.why[rows, sheet] = np.where(settled, 0, positions.why[rows, sheet])
    positions.withheld_px[rows, sheet] = np.where(settled, np.nan, positions.withheld_px[rows, sheet])


# --- ridges that become a sheet's ---------------------------------------------------------------------------


def _accepted(
    positions: Positions, decision: Correction, part: slice, diagram: Diagram
) -> tuple[Floats, NDArray[Any]]:
    """Positions and flags of these rows, with the doubted ridges measured."""
    sheet = decision.sheets[0]
    x, flag = positions.x_px[part, sheet].astype(np.float64), positions.flag[part, sheet].copy()
    doubted = np.flatnonzero(flag == DOUBTFUL)
    if not len(doubted):
        raise InputError(decision.name, "a doubtful stretch to accept", "none in these frames")
    withheld = positions.withheld_px[part, sheet][doubted] - np.float64(diagram.first_column)
    x[doubted] = _fitted(positions, np.rint(withheld), part.start + doubted, diagram)
    flag[doubted] = np.where(np.isfinite(x[doubted]), FLAGS.index("ok"), FLAGS.index("unfit"))
    return x, flag


def _assigned(
    positions: Positions, decision: Correction, part: slice, diagram: Diagram
) -> tuple[Floats, NDArray[Any]]:
    """Positions and flags of these rows, with the ridge followed."""
    start, other = _followed(positions, decision, part, diagram, without=decision.sheets[0])
    if (other >= 0).any():
        row = int((other >= 0).argmax())
        raise not_taken(decision, int(positions.frame[part.start + row]), int(other[row]))
    x = _fitted(positions, start, np.arange(part.start, part.stop), diagram)
    return x, _state(start, x)


def _with_sheet(positions: Positions, decision: Correction, diagram: Diagram) -> tuple[Positions, Before]:
    """One more sheet, followed both ways."""
    row, frames = positions.row_of(decision.first), len(positions.frame)
    start, other = np.full(frames, np.nan), np.full(frames, -1)
    for part in (slice(row, frames), slice(0, row + 1)):
        start[part], other[part] = _followed(positions, decision, part, diagram, back=part.start < row)
    if other[row] >= 0:
        raise not_taken(decision, decision.first, int(other[row]))
    start[other >= 0] = np.nan
    x = _fitted(positions, start, np.arange(frames), diagram)
    here = positions.x_px[row]
    usual = np.where(np.isfinite(here), here, usual_places(positions))
    place = int((usual < start[row] + diagram.first_column).sum())
    wider = _inserted(positions, place, _EMPTY)
    more = replace(wider, side=np.insert(positions.side, place, 1), n=np.insert(positions.n, place, 1))
    _put(more, slice(0, frames), place, x, _state(start, x))
    before = Before(how="added", sheets=(place,), arrays={"side": positions.side, "n": positions.n})
    return _renumbered(more, more.track_facts.axis_px), before


def _state(start: Floats, x: Floats) -> NDArray[Any]:
    """Flags of a sheet by whether it has a ridge, and whether that has a position."""
    found = np.where(np.isfinite(x), FLAGS.index("ok"), FLAGS.index("unfit"))
    return np.where(np.isfinite(start), found, FLAGS.index("missing"))


def _followed(
    positions: Positions,
    decision: Correction,
    part: slice,
    diagram: Diagram,
    *,
    without: int | None = None,
    back: bool = False,
) -> tuple[Floats, Ints]:
    """Whole pixels of the ridge in these rows, NaN where it is lost, and whose it is, -1 if nobody's.

    In blocks; each goes on from where the ridge was seen last.
    """
    comb, origin = positions.comb, float(diagram.first_column)
    start, other = np.full(len(positions.frame), np.nan), np.full(len(positions.frame), -1)
    at, wanted = (part.stop - 1 if back else part.start), decision
    while True:
        first, stop = (at + 1 - BLOCK, at + 1) if back else (at, at + BLOCK)
        rows = slice(max(part.start, first), min(part.stop, stop))
        ridges = positions.ridges(diagram, rows)
        owned = _whole_pixels(positions.x_px[rows] - np.float64(origin), ridges)
        if without is not None:
            owned[:, without] = np.nan
        order = np.arange(rows.stop - rows.start)[:: -1 if back else 1]
        found = np.empty(len(order))
        found[order] = follow_ridge(
            wanted, order, owned, ridges, comb, origin_px=origin, settings=diagram.settings
        )
        start[rows] = found
        shared = owned == found[:, None]
        other[rows] = np.where(shared.any(axis=1), shared.argmax(axis=1), -1)
        if (rows.start == part.start) if back else (rows.stop == part.stop):
            return start[part], other[part]
        seen = np.flatnonzero(np.isfinite(found))
        last = int(seen[0] if back else seen[-1])
        if rows.start + last == at:  # not seen again in a whole block
            return start[part], other[part]
        at, wanted = rows.start + last, replace(decision, x_px=float(found[last]) + origin)


def _whole_pixels(x_px: Floats, ridges: Ridges) -> Floats:
    """Each position as the candidate from which it was fitted; rounded where there is none near."""
    out, least = np.rint(x_px), np.full(x_px.shape, SAME_RIDGE_PX)
    for k in range(ridges.x_px.shape[1]):  # a column at a time: memory of one (frame, sheet)
        distance = np.abs(x_px - ridges.x_px[:, k : k + 1])
        nearer = distance <= least
        out[nearer] = np.broadcast_to(ridges.x_px[:, k : k + 1], out.shape)[nearer]
        least = np.where(nearer, distance, least)
    return out


def _fitted(positions: Positions, start_px: Floats, rows: Ints, diagram: Diagram) -> Floats:
    """Subpixel positions, as columns of the picture, from whole pixels in these rows of the positions."""
    comb, facts = positions.comb, positions.track_facts
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


def _renumbered(positions: Positions, axis_px: float) -> Positions:
    numbering = number_sheets(usual_places(positions)[None], axis_px=axis_px)
    return replace(positions, side=numbering.side, n=numbering.n)


def _with_axis(positions: Positions, axis_px: float) -> tuple[Positions, Before]:
    facts = positions.track_facts
    before = Before(
        how="numbering",
        arrays={"side": positions.side, "n": positions.n},
        axis_px=facts.axis_px,
        axis_how=facts.axis_how,
    )
    about = dict(positions.attrs) | {"axis_px": axis_px, "axis_how": "given"}
    return replace(_renumbered(positions, axis_px), attrs=about), before


def _without(positions: Positions, sheet: int) -> tuple[Positions, Before]:
    arrays = {name: getattr(positions, name)[:, sheet].copy() for name in CELLS}
    arrays |= {"side": positions.side, "n": positions.n}
    fewer = _removed(positions, sheet)
    before = Before(how="deleted", sheets=(sheet,), arrays=arrays)
    return _renumbered(fewer, fewer.track_facts.axis_px), before


def _removed(positions: Positions, sheet: int) -> Positions:
    cells = {name: np.delete(getattr(positions, name), sheet, axis=1) for name in CELLS}
    return replace(positions, **cells, side=np.delete(positions.side, sheet), n=np.delete(positions.n, sheet))


def _inserted(positions: Positions, sheet: int, values: Mapping[str, Any]) -> Positions:
    """One more column of these values, NaN where there are none."""
    earlier = {name: getattr(positions, name) for name in CELLS}
    cells = {k: np.insert(one, sheet, values.get(k, np.nan), axis=1) for k, one in earlier.items()}
    return replace(positions, **cells)
