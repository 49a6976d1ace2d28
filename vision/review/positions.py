"""Compact x(n, t) of a run, and the effect of decisions on it without tracking again.

A test of 100 000 frames and 50 sheets takes 70 MB.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from vision.clock import video_slips
from vision.data import TRACKS, StripMetadata, TrackMetadata
from vision.errors import InputError
from vision.memory import word_codes
from vision.numeric import Bools, Codes, Floats, Floats32, Ints, nan_median, nearest
from vision.review.recordings import Diagram
from vision.run.reading import read_tracks
from vision.sheets.corrections import OF_SHEETS, Corrected, Correction, follow_ridge
from vision.sheets.doubts import predicted_by_neighbours
from vision.sheets.identities import WHYS
from vision.sheets.numbering import number_sheets
from vision.sheets.recovery import FLAGS, Flag
from vision.sheets.ridges import RidgeComb, find_faint, find_ridges
from vision.sheets.subpixel import FitName, fit_sheets

CELLS = ("x_px", "err_px", "withheld_px", "flag", "why")
"""Names of the arrays of (frame, sheet)."""


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
        axes = {"frame": self.frame[rows], "sheet": np.arange(self.sheets)}
        return xr.Dataset(TRACKS.declared(values), axes, dict(self.attrs)).set_coords(["time_s", "side", "n"])

    def slips_s(self) -> Floats:
        """Return the times at which the sheets step outwards, s on the camera's clock."""
        # All of 100 000 rows at once would take 250 MB of memory; in parts with fewer than about ten slips
        # their typical size is poorly known.
        frames, at_once = len(self.frame), 10_000
        parts = [slice(k, min(k + at_once, frames) + 1) for k in range(0, frames, at_once)]
        return np.concatenate([_slips_in(self.tracks(part)) for part in parts])

    def row_of(self, frame: int) -> int:
        """Return the row of a frame number.  Raises: InputError for a frame that the run does not have."""
        row = int(np.searchsorted(self.frame, frame))
        if row >= len(self.frame) or self.frame[row] != frame:
            raise InputError("the frame", f"one from {self.frame[0]} to {self.frame[-1]}", f"{frame}")
        return row

    def profile(self, diagram: Diagram, rows: slice) -> Floats32:
        """Return the diagram, (frame, x), in these rows."""
        return diagram.rows(self.first_row + rows.start, self.first_row + rows.stop)

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


def read_positions(path: Path) -> Positions:
    """Read the positions of a run from its tracks.nc.  Raises: InputError if it is missing or damaged."""
    tracks = read_tracks(path, without=["x_expected_px"])
    shape = tracks["x_px"].shape

    def single(name: str) -> Floats32:
        values = tracks[name].values if name in tracks else np.broadcast_to(np.nan, shape)
        return values.astype(np.float32)

    return Positions(
        frame=tracks["frame"].values,
        time_s=tracks["time_s"].values,
        x_px=single("x_px"),
        err_px=single("x_err_px"),
        withheld_px=single("x_withheld_px"),
        flag=word_codes(tracks["flag"], FLAGS),
        why=word_codes(tracks["why"], WHYS) if "why" in tracks else np.zeros(shape, np.uint8),
        side=tracks["side"].values,
        n=tracks["n"].values,
        attrs={name: value for name, value in tracks.attrs.items() if name not in ("Conventions", "title")},
    )


# --- decisions ----------------------------------------------------------------------------------------------

BLOCK = 2048  # frames in which a ridge is followed at a time, so that candidates take little memory
SAME_RIDGE_PX = 2.0
"""Distance within which a position and the whole pixel of a candidate are the same ridge: fits end this close
to their start. A larger value would join neighbours that are 4 px apart."""


def median_positions(positions: Positions) -> Floats:
    """Return the median position of every sheet, from 2000 frames spread over the run."""
    return _medians(positions.x_px)


def _medians(values: Floats32) -> Floats:
    return nan_median(values[:: max(1, len(values) // 2000)].astype(np.float64))


def apply(positions: Positions, decision: Correction, diagram: Diagram) -> Positions:
    """Apply a decision and return the new positions.

    If the number of sheets does not change, the arrays are changed in place. Ridges are searched in the
    diagram and fitted with the sliding window; they get the sheet's median error. (Saving tracks again, with
    the run's own fit.) Decisions about strip and clock change nothing here. Sheets are counted as in these
    positions.

    Raises: InputError if the decision is not valid for the positions, which are not changed then.
    """
    if decision.kind == "axis":
        attrs = dict(positions.attrs) | {"axis_px": float(decision.x_px or 0.0), "axis_how": "given"}
        return _renumbered(replace(positions, attrs=attrs))
    if decision.kind not in OF_SHEETS:
        return positions
    corrected = _CorrectedPositions(positions, diagram)
    (sheet, *_) = corrected.apply(decision)
    side, n = positions.side, positions.n
    if decision.kind == "add":
        side, n = (np.insert(one, sheet, 1) for one in (side, n))
    elif decision.kind == "delete":
        side, n = (np.delete(one, sheet) for one in (side, n))
    else:
        return positions
    return _renumbered(replace(positions, **corrected.arrays, side=side, n=n))


class _CorrectedPositions(Corrected):
    """Positions, in columns of the picture, whose ridges are searched in the diagram."""

    def __init__(self, positions: Positions, diagram: Diagram) -> None:
        super().__init__({name: getattr(positions, name) for name in CELLS}, "x_px", positions.frame)
        self.positions, self.diagram, self.comb = positions, diagram, positions.comb(diagram)

    def follow(self, correction: Correction, rows: Ints, without: int | None = None) -> tuple[Floats, Ints]:
        """Follow a ridge block by block; each block starts where the ridge was last seen."""
        origin, at = float(self.diagram.first_column), 0
        ridge_px, owner = np.full(len(rows), np.nan), np.full(len(rows), -1)
        while True:
            block = slice(at, at + BLOCK)
            part = slice(int(rows[block].min()), int(rows[block].max()) + 1)
            profile = self.positions.profile(self.diagram, part)
            ridges = find_ridges(profile, self.comb), find_faint(profile, self.comb)
            x_px = self.positions.x_px[part] - np.float64(origin)
            fitted_from = nearest_ridges(ridges[0].x_px, x_px, SAME_RIDGE_PX)
            whole = np.where(np.isfinite(fitted_from), fitted_from, np.rint(x_px))
            order = rows[block] - part.start
            found, owner[block] = follow_ridge(
                correction, order, whole, ridges, self.comb, without=without, origin_px=origin
            )
            ridge_px[block] = found + origin
            last = int(np.flatnonzero(np.isfinite(found))[-1])
            if block.stop >= len(rows) or last == 0:  # not found again in a whole block
                return ridge_px, owner
            at, correction = at + last, replace(correction, x_px=float(ridge_px[at + last]))

    def put(self, rows: Ints, sheet: int, ridge_px: Floats, otherwise: Flag) -> None:
        """Fit the ridges; the positions get the sheet's median error."""
        error_px = self.arrays["err_px"]
        known = error_px[:, sheet][np.isfinite(error_px[:, sheet])]
        error = np.median(known) if known.size else np.nanmedian(_medians(error_px))
        seen, x = np.isfinite(ridge_px), np.full(len(rows), np.nan)
        x[seen] = self._fitted(ridge_px[seen], rows[seen])
        fitted = np.isfinite(x)
        values = {
            "x_px": x,
            "err_px": np.where(fitted, error, np.nan),
            "withheld_px": np.nan,
            "flag": np.where(seen, np.where(fitted, Flag.OK, Flag.UNFIT), otherwise),
            "why": 0,
        }
        for name, one in values.items():
            self.arrays[name][rows, sheet] = one

    def _fitted(self, ridge_px: Floats, rows: Ints) -> Floats:
        """Fit subpixel positions to ridges in these rows."""
        facts, first_column = self.positions.track_facts, self.diagram.first_column
        fit: FitName = "paper" if facts.fit == "paper" else "sliding"
        start, x = np.rint(ridge_px - np.float64(first_column)), np.empty(len(rows))
        for begin in range(0, len(rows), BLOCK):
            part = slice(begin, begin + BLOCK)
            first, stop = int(rows[part].min()), int(rows[part].max()) + 1
            profile = self.positions.profile(self.diagram, slice(first, stop))
            seen = profile[rows[part] - first]
            found, _ = fit_sheets(seen, start[part, None], fit=fit, window_px=facts.window_px, comb=self.comb)
            x[part] = found[:, 0]
        return x + first_column


def nearest_ridges(ridges_px: NDArray[np.floating], targets: Floats, reach: float) -> Floats:
    """Return the candidate nearest to each target (frame, target) in its frame; NaN if none is in reach."""
    out = np.full(targets.shape, np.nan)
    for k, at in enumerate(targets.T):  # one at a time needs little memory
        best, distance = nearest(ridges_px, at)
        out[:, k] = np.where(distance <= reach, ridges_px[np.arange(len(at)), best], np.nan)
    return out


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
