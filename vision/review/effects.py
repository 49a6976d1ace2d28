"""x(n, t) of a run under review, and what decisions change in it, without tracking again.

Decisions are applied to compact positions (a test of 100 000 frames and 50 sheets takes 70 MB), and
previewed: positions, numbering, deformation, the rows of the strip.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray

from vision.clock import Clock, video_slips
from vision.data import TRACKS, StripMetadata, TrackMetadata
from vision.deformation import horizontal_deformation
from vision.errors import InputError, with_options
from vision.memory import row_parts
from vision.numeric import Bools, Codes, Floats, Floats32, Ints, Pixels, nearest, typical_median
from vision.review.recordings import Diagram, decided_clock
from vision.run.reading import read_tracks
from vision.sheets.corrections import (
    OF_SHEETS,
    OF_STRETCHES,
    Corrected,
    Correction,
    PossibleRidges,
    follow_ridge,
)
from vision.sheets.doubts import predicted_by_neighbours
from vision.sheets.identities import WHYS
from vision.sheets.numbering import number_sheets, placed
from vision.sheets.recovery import FLAGS, Flag
from vision.sheets.ridges import RidgeComb, describe_ridges, find_faint, find_ridges
from vision.sheets.subpixel import FitName, fit_sheets, position_noise
from vision.shells import classify_sheets, classify_shells
from vision.video.strip import row_means
from vision.words import word_codes

if TYPE_CHECKING:
    from vision.review.session import Session

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
        parts = row_parts(len(self.frame), 10_000)
        return np.concatenate([_slips_in(self.tracks(slice(one.start, one.stop + 1))) for one in parts])

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
    stored = ("x_px", "x_err_px", "x_withheld_px")
    tracks = read_tracks(path, without=["x_expected_px"], single=stored)
    shape = tracks["x_px"].shape

    x_px, err_px, withheld_px = (
        tracks[name].values if name in tracks else np.full(shape, np.nan, np.float32) for name in stored
    )
    return Positions(
        frame=tracks["frame"].values,
        time_s=tracks["time_s"].values,
        x_px=x_px,
        err_px=err_px,
        withheld_px=withheld_px,
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
    """Return the typical position of every sheet, px, (N,)."""
    return typical_median(positions.x_px)


def apply(positions: Positions, decision: Correction, diagram: Diagram) -> Positions:
    """Apply a decision and return the new positions.

    If the number of sheets does not change, the arrays are changed in place. Ridges are searched in the
    diagram and fitted with the sliding window, and get the sheet's median error: when the run is saved, they
    are tracked again with its own fit. Decisions about strip and clock change nothing here. Sheets are
    counted as in these positions.

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
        arrays, comb = {name: getattr(positions, name) for name in CELLS}, positions.comb(diagram)
        super().__init__(arrays, "x_px", positions.frame, comb, origin_px=0.0)
        self.positions, self.diagram = positions, diagram

    def follow(self, correction: Correction, rows: Ints, without: int | None = None) -> tuple[Floats, Ints]:
        """Follow a ridge block by block; each block starts where the ridge was last seen."""
        origin, at = float(self.diagram.first_column), 0
        ridge_px, owner = np.full(len(rows), np.nan), np.full(len(rows), -1)
        while True:
            block = slice(at, at + BLOCK)
            part = slice(int(rows[block].min()), int(rows[block].max()) + 1)
            profile = self.positions.profile(self.diagram, part)
            ridges = PossibleRidges(find_ridges(profile, self.comb), find_faint(profile, self.comb))
            x_px = self.positions.x_px[part] - np.float64(origin)
            fitted_from = nearest_ridges(ridges.candidates.x_px, x_px, SAME_RIDGE_PX)
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

    def measured(self, rows: Ints, sheet: int, ridge_px: Floats, otherwise: Flag) -> dict[str, Any]:
        """Fit the ridges; the positions get the sheet's median error."""
        error_px = self.arrays["err_px"]
        known = error_px[:, sheet][np.isfinite(error_px[:, sheet])]
        error = np.median(known) if known.size else np.nanmedian(typical_median(error_px))
        seen, x = np.isfinite(ridge_px), np.full(len(rows), np.nan)
        x[seen] = self._fitted(ridge_px[seen], rows[seen])
        fitted = np.isfinite(x)
        return {
            "x_px": x,
            "err_px": np.where(fitted, error, np.nan),
            "flag": np.where(seen, np.where(fitted, Flag.OK, Flag.UNFIT), otherwise),
        }

    def _fitted(self, ridge_px: Floats, rows: Ints) -> Floats:
        """Fit subpixel positions to ridges in these rows."""
        facts, first_column = self.positions.track_facts, self.diagram.first_column
        fit: FitName = "paper" if facts.fit == "paper" else "sliding"
        start, x = np.rint(ridge_px - np.float64(first_column)), np.empty(len(rows))
        for part in row_parts(len(rows), BLOCK):
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
    if not np.isfinite(x_px).any():
        raise InputError("the decision", "a sheet with a position that remains", "none")
    numbering = number_sheets(placed(x_px)[None], axis_px=facts.axis_px)
    unseen = 0 if facts.axis_how == "given" else numbering.n.min() - 1
    return replace(positions, side=numbering.side, n=numbering.n - unseen)


# --- previews -----------------------------------------------------------------------------------------------

SHOWN_ROWS = 400  # rows of a preview
MAX_ROWS = 2000  # rows in which a stick phase and its neighbours are measured


class Effects:
    """Previews the effects of decisions on a session, which does not change."""

    def __init__(self, run: Session) -> None:
        self.run = run
        self._pictures = lru_cache(1)(self._read_pictures)
        self._at_revision = lru_cache(200)(lambda event, revision: self._by_clock(event))

    def preview(self, request: Mapping[str, Any], frame: Any = None) -> dict[str, Any]:
        """Return what a decision would change: positions near a frame, numbering, σ_x/Λ_st.

        frame: the frame shown by the page; if the decision does not contain it, its first frame is used.
        ``concerned`` is the number of frames that the decision concerns, shown or not.
        Raises: InputError if the decision is not valid for this run.
        """
        decision = self.run.decision_of(request)
        with self.run.lock:
            if decision.kind == "clock":
                return {"text": decision.text(), **self.clock_preview(decision.offset_s, decision.drift_ppm)}
            at = self._row_shown(decision, frame)
            near, rows = self._rows_for(decision, at)
            part = self.run.positions.copied(rows)
            after = apply(part, _clipped(decision, part), self.run.diagram)
            compared = self._compared(after, at, near, rows)
            text = decision.text(self.run.names())
            return {"text": text, "concerned": self._concerned(decision), **compared}

    def _concerned(self, decision: Correction) -> int:
        """Return the number of frames that a decision concerns, of which a preview shows those near one."""
        stop = np.inf if decision.stop is None or decision.kind == "add" else decision.stop
        first = decision.first if decision.kind in OF_STRETCHES else 0
        return int(np.sum((self.run.positions.frame >= first) & (self.run.positions.frame < stop)))

    def preview_of(self, after: Positions, frame: int) -> dict[str, Any]:
        """Return what positions of another run would change: those near a frame, numbering, the stick."""
        at = self.run.positions.row_of(frame)
        near, rows = self._rows_for(Correction(kind="strip"), at)
        return self._compared(after.copied(rows), at, near, rows)

    def _compared(
        self, after: Positions, at: int, near: StickAndNeighbours | None, rows: slice
    ) -> dict[str, Any]:
        """Return the current and other positions of some rows near one of them, and the stick phase there."""
        before, shown = self.run.positions.copied(rows), _rows_around(at - rows.start)
        stick_before = stick_after = near and self._current(near.event)
        if near:
            near = replace(near, rows=near.rows - rows.start)
            same = np.array_equal(before.side, after.side) and np.array_equal(before.n, after.n)
            old, new = (part.x_px[near.rows] for part in (before, after))
            if not (same and np.array_equal(old, new, equal_nan=True)):
                stick_after = self._measured(after, near)
        return {
            "frames": before.frame[shown],
            "before": _shown(before, shown),
            "after": _shown(after, shown),
            "event": near and near.event,
            "stick_before": stick_before,
            "stick_after": stick_after,
        }

    def _row_shown(self, decision: Correction, frame: Any) -> int:
        """Return the row of a preview: that of the shown frame or, if the decision lacks it, of its first."""
        numbers = self.run.positions.frame
        first = max(decision.first, int(numbers[0]))
        last = int(numbers[-1]) if decision.stop is None else min(decision.stop - 1, int(numbers[-1]))
        shown = frame if isinstance(frame, int) and first <= frame <= last else first
        if decision.kind in ("assign", "add"):
            shown = min(max(shown, first), first + MAX_ROWS // 2)
        return min(int(np.searchsorted(numbers, shown)), len(numbers) - 1)

    def _rows_for(self, decision: Correction, at: int) -> tuple[StickAndNeighbours | None, slice]:
        """Return the stick phase at a row, and the rows around it from where an assigned ridge starts."""
        numbers, event = self.run.positions.frame, self._event_at(at)
        near = None if event is None else self._near(event)
        start, stop, _ = _rows_around(at).indices(len(numbers))
        if near is not None:
            start, stop = min(start, int(near.rows[0])), max(stop, int(near.rows[-1]) + 1)
        if decision.kind in ("assign", "add"):
            start = min(start, int(np.searchsorted(numbers, decision.first)))
        return near, slice(start, stop)

    def _event_at(self, row: int, clock: Clock | None = None) -> int | None:
        """Return the stick phase that contains a row; None if there is none or the clock is ambiguous."""
        clock, events = clock or self.run.clock, self.run.events
        if clock is None or events is None or clock.status == "ambiguous":
            return None
        time_s = float(clock.to_force_s(self.run.positions.time_s[row]))
        inside = (events["t_v_s"] <= time_s) & (events["t_p_s"] >= time_s)
        return int(events["event"].to_numpy()[inside.to_numpy()][0]) if inside.any() else None

    def clock_preview(self, offset_s: Any, drift_ppm: Any = 0.0, frame: Any = None) -> dict[str, Any]:
        """Return stick phases and slips with another clock, and σ_x/Λ_st of the stick phase at a frame.

        Raises: InputError if the run has no force recording.
        """
        decision = self.run.decision_of({"kind": "clock", "offset_s": offset_s, "drift_ppm": drift_ppm})
        if self.run.events is None:
            raise InputError("the clock", "a run with a force recording", "none")
        with self.run.lock:
            clock = decided_clock(self.run.saved_clock, decision)
            times = {"sticks": self.run.sticks(clock), "slips": self.run.slips(clock)}
            if not isinstance(frame, int):
                return times
            event = self._event_at(self.run.positions.row_of(frame), clock)
            after = None if event is None else self._by_clock(event, clock)
            return times | {"event": event, "stick_after": after}

    def strip_preview(self, rows: Any, frame: Any) -> dict[str, Any]:
        """Return the ridges of one frame in another strip, and the noise of positions in nearby frames.

        Raises: InputError for rows outside the picture, or without a ridge.
        """
        top, bottom = self.run.decision_of({"kind": "strip", "rows": rows}).rows or (0, 0)
        height = self.run.recordings.film().shape[0]
        if bottom > height:
            raise InputError("the strip", f"rows within 0:{height}", f"{rows}")
        at = self.run.positions.row_of(frame if isinstance(frame, int) else int(self.run.positions.frame[0]))
        pictures, here = self._pictures(at)  # `here`: index of the frame among the pictures
        first = self.run.diagram.first_column
        across = slice(first, first + self.run.diagram.columns)
        profile = np.stack([row_means(one[None, top:bottom, across])[0] for one in pictures])
        comb = describe_ridges(
            profile,
            polarity=self.run.positions.comb(self.run.diagram).polarity,
            settings=self.run.diagram.settings,
        )
        seen = find_ridges(profile, comb)
        window = self.run.positions.track_facts.window_px
        usual = np.tile(median_positions(self.run.positions) - first, (len(profile), 1))
        start = nearest_ridges(seen.x_px, usual, 0.5 * comb.pitch_px)
        x, _ = fit_sheets(profile, start, fit="sliding", window_px=window, comb=comb)
        known = np.isfinite(seen.x_px[here])
        return {
            "rows": [top, bottom],
            "frame": int(self.run.positions.frame[at]),
            "ridges": seen.x_px[here][known].astype(float) + first,
            "contrast": comb.contrast,
            "fwhm_px": comb.fwhm_px,
            "profile_noise": comb.noise,
            "noise_px": float(np.nanmedian(position_noise(x))) if len(x) >= 3 else math.nan,
            "sheets_seen": int(np.isfinite(x[here]).sum()),
        }

    def _read_pictures(self, row: int) -> tuple[list[Pixels], int]:
        """Return the readable ones of 16 frames around a row, and the index of its own frame among them."""
        count = 16
        with self.run.lock:
            film, positions = self.run.recordings.film(), self.run.positions
            first = max(0, min(row - count // 2, len(positions.frame) - count))
            rows = range(first, min(first + count, len(positions.frame)))
            found = {k: film.picture(int(positions.frame[k]), float(positions.time_s[k])) for k in rows}
            pictures = {k: picture for k, picture in found.items() if picture is not None}
            if row not in pictures:
                raise InputError("the frame", "one that can be read", f"{positions.frame[row]}")
            return list(pictures.values()), list(pictures).index(row)

    # --- deformation ----------------------------------------------------------------------------------------

    def stick(self, event: int) -> dict[str, Any]:
        """Return σ_x/Λ_st of every sheet in one stick phase and the shell of each side, or why not."""
        with self.run.lock:
            return {"event": event, **self._current(event)}

    def _current(self, event: int) -> dict[str, Any]:
        """Return the deformation with the current positions and clock, cached until they change."""
        return self._at_revision(event, self.run.revision)

    def _by_clock(self, event: int, clock: Clock | None = None) -> dict[str, Any]:
        """Return the deformation with the current positions and the run's clock or another."""
        try:
            near = self._near(event, clock)
        except InputError as error:
            return _unknown(error)
        return self._measured(self.run.positions, near)

    def _near(self, event: int, clock: Clock | None = None) -> StickAndNeighbours:
        """Return a stick phase with its neighbours, three on each side or fewer if they are long.

        Noise and camera movement are measured from them. All stick phases would take three times as long and
        change a ratio by a thirtieth of its error, and a shell by one sheet in one of thirty.

        Raises: InputError if events or clock are missing.
        """
        clock, events = clock or self.run.clock, self.run.events
        if clock is None or events is None:
            raise InputError("the run", "a force recording and its clock", "none", "give `force` to track")
        if clock.status == "ambiguous":
            raise InputError("the clock", "an unambiguous one", "an ambiguous one", "accept a candidate")
        at = np.flatnonzero(events["event"].to_numpy() == event)
        if not at.size:
            raise InputError("the event", "one of events.csv", f"{event}")
        time = clock.to_force_s(self.run.positions.time_s)
        step = float(np.nanmedian(np.diff(time[: min(len(time), 1000)])))
        for around in (3, 2, 1, 0):
            sticks = events.iloc[max(0, at[0] - around) : at[0] + around + 1]
            first, last = sticks["t_v_s"].min() - 2 * step, sticks["t_p_s"].max() + 2 * step
            rows = np.flatnonzero((time >= first) & (time <= last))
            if rows.size <= MAX_ROWS:
                break
        if not rows.size:
            raise InputError("the stick phase", "one within the film", f"{event}")
        return StickAndNeighbours(event=event, clock=clock, sticks=sticks, rows=rows)

    def _measured(self, positions: Positions, near: StickAndNeighbours) -> dict[str, Any]:
        """Return σ_x/Λ_st of every sheet in a stick phase and the shell of each side, or why not."""
        settings = self.run.settings
        try:
            motion = horizontal_deformation(
                positions.tracks(near.rows),
                near.sticks,
                near.clock,
                pixel_size_um=self.run.stored.pixel_size_um,
                common_mode=settings.common_mode,
                settings=settings.tuning.deformation,
            )
            if near.event not in motion["event"].values:
                why = "This stick phase does not lie wholly within the film."
                return {"sheets": [], "shells": [], "reason": why}
            one = motion.sel(event=[near.event])
            how: dict[str, Any] = {"threshold": settings.threshold, "settings": settings.tuning.shells}
            sheets = classify_sheets(one, **how).isel(event=0)
            shells = classify_shells(one, **how)
        except InputError as error:
            return _unknown(error)
        names = ("side", "n", "ratio", "ratio_err", "shell", "flag")
        table = pd.DataFrame(
            {"index": sheets["sheet"].values} | {name: sheets[name].values for name in names}
        )
        sizes = shells[["side", "stiff_sheets", "stiff_low", "stiff_high"]]
        return {"sheets": table.to_dict("records"), "shells": sizes.to_dict("records")}


@dataclass(frozen=True, kw_only=True)
class StickAndNeighbours:
    """One stick phase, with its neighbours, from which noise and camera movement are measured."""

    event: int
    clock: Clock  # clock that relates the stick phases to the rows
    sticks: pd.DataFrame
    rows: Ints


def _unknown(error: InputError) -> dict[str, Any]:
    return {"sheets": [], "shells": [], "reason": with_options(str(error))}


def _rows_around(row: int) -> slice:
    """Return the rows that are shown around one."""
    return slice(max(0, row - SHOWN_ROWS // 2), row + SHOWN_ROWS // 2)


def _clipped(decision: Correction, part: Positions) -> Correction:
    """Return the decision limited to the frames of a part of the run."""
    if decision.kind not in OF_STRETCHES:
        return decision
    first, last = int(part.frame[0]), int(part.frame[-1])
    stop = last + 1 if decision.stop is None else min(decision.stop, last + 1)
    return replace(decision, first=max(decision.first, first), stop=stop)


def _shown(positions: Positions, rows: slice) -> dict[str, Any]:
    """Return what a preview draws: positions of every sheet, and their numbering."""
    return {
        "x_px": np.round(positions.x_px[rows].astype(np.float64), 3),
        "side": positions.side,
        "n": positions.n,
        "axis_px": positions.track_facts.axis_px,
    }
