"""Preview what a decision would change: positions, numbering, deformation, the rows of the strip."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from vision.clock import Clock
from vision.deformation import horizontal_deformation
from vision.errors import InputError, with_options
from vision.numeric import Ints, Pixels
from vision.review.positions import Positions, apply, median_positions, nearest_ridges
from vision.review.recordings import decided_clock
from vision.sheets.corrections import OF_STRETCHES, Correction
from vision.sheets.ridges import describe_ridges, find_ridges
from vision.sheets.subpixel import fit_sheets, position_noise
from vision.shells import classify_sheets, classify_shells
from vision.video.strip import row_means

if TYPE_CHECKING:
    from vision.review.session import Session

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
            return {"text": decision.text(), "concerned": self._concerned(decision), **compared}

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
