"""What a decision would change before it is kept: positions, numbering, deformation, other rows."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from vision.clock import Clock
from vision.deformation import horizontal_deformation
from vision.errors import InputError, with_options
from vision.numeric import Floats, Floats32, Ints, Pixels
from vision.review.positions import Positions, apply, positions_of, usual_places
from vision.review.recordings import decided_clock
from vision.review.tracks_file import read_tracks
from vision.sheets.corrections import OF_STRETCHES, Correction
from vision.sheets.ridges import describe_ridges, find_ridges
from vision.sheets.subpixel import fit_sheets, position_noise
from vision.shells import classify_sheets, classify_shells
from vision.video.strip import row_means

if TYPE_CHECKING:
    from vision.review.session import Session

STICKS_AROUND = 3
"""On each side of a stick, from which noise and camera movement are measured anew. All of a run take three
times as long and change a ratio by a thirtieth of its error, a shell by one sheet in one stick of thirty."""
SHOWN_ROWS = 400  # of a preview
MOST_ROWS = 2000  # in which a stick is measured with those around it
NOISE_FRAMES = 16  # from which the noise in other rows is measured
READY = ("ok", "given")  # of a clock


class Effects:
    """Measures what decisions would change in a session; keeps none."""

    def __init__(self, run: Session) -> None:
        self.run = run
        self._around: tuple[int, list[Pixels], int] = (-1, [], 0)
        self._known: tuple[int, dict[int, dict[str, Any]]] = (-1, {})

    def preview(self, request: Mapping[str, Any], frame: Any = None) -> dict[str, Any]:
        """What a decision would change: positions about a frame, numbering, and σ_x/Λ_st of the stick there.

        frame: where the page looks; the decision's first frame if it is not within its frames.
        Raises: InputError where the decision does not fit.
        """
        decision = self.run.decision_of(request)
        with self.run.lock:
            if decision.kind == "clock":
                return {"text": decision.text(), **self.clock_preview(decision.offset_s, decision.drift_ppm)}
            at = self._row_shown(decision, frame)
            near, rows = self._rows_for(decision, at)
            before = self.run.positions.copied(rows)
            clipped = _clipped(decision, before)
            after, _ = apply(self.run.positions.copied(rows), clipped, self.run.diagram)
            shown = _about(at - rows.start)
            now = then = None
            if near is not None:
                now = self._now(near.event)
                then = self._then(now, before, after, near.since(rows.start))
            return {
                "text": decision.text(),
                "frames": before.frame[shown],
                "before": _shown(before, shown),
                "after": _shown(after, shown),
                "event": near and near.event,
                "stick_before": now,
                "stick_after": then,
            }

    def preview_of(self, tracks: Path, frame: int) -> dict[str, Any]:
        """What another run's tracks.nc would change: positions about a frame, numbering, the stick there."""
        at = self.run.positions.row_of(frame)
        near, rows = self._rows_for(Correction(kind="strip"), at)
        after = positions_of(read_tracks(tracks, rows))
        shown = _about(at - rows.start)
        return {
            "frames": after.frame[shown],
            "after": _shown(after, shown),
            "event": near and near.event,
            "stick_before": near and self._now(near.event),
            "stick_after": near and self._measured(after, near.since(rows.start)),
        }

    def _row_shown(self, decision: Correction, frame: Any) -> int:
        """Row that a preview is about: the frame shown, as far as the decision changes it."""
        numbers = self.run.positions.frame
        first = max(decision.first, int(numbers[0]))
        last = int(numbers[-1]) if decision.stop is None else min(decision.stop - 1, int(numbers[-1]))
        shown = frame if isinstance(frame, int) and first <= frame <= last else first
        if decision.kind in ("assign", "add"):
            shown = min(max(shown, first), first + MOST_ROWS // 2)
        return min(int(np.searchsorted(numbers, shown)), len(numbers) - 1)

    def _rows_for(self, decision: Correction, at: int) -> tuple[Near | None, slice]:
        """The stick at a row, and the rows of a preview: around it, from where a ridge is followed."""
        numbers, event = self.run.positions.frame, self._event_at(at)
        near = None if event is None else self._near(event)
        a, b, _ = _about(at).indices(len(numbers))
        if near is not None:
            a, b = min(a, int(near.rows[0])), max(b, int(near.rows[-1]) + 1)
        if decision.kind in ("assign", "add"):
            a = min(a, int(np.searchsorted(numbers, decision.first)))
        return near, slice(a, b)

    def _event_at(self, row: int, clock: Clock | None = None) -> int | None:
        """The stick in which a frame lies, where the clock is sure."""
        clock, events = clock or self.run.clock, self.run.stored.events
        if clock is None or events is None or clock.status not in READY:
            return None
        time_s = float(clock.to_force_s(self.run.positions.time_s[row]))
        inside = (events["t_v_s"] <= time_s) & (events["t_p_s"] >= time_s)
        return int(events["event"].to_numpy()[inside.to_numpy()][0]) if inside.any() else None

    def clock_preview(self, offset_s: Any, drift_ppm: Any = 0.0, frame: Any = None) -> dict[str, Any]:
        """Sticks and slips by another clock, and σ_x/Λ_st of the stick at a frame.

        Raises: InputError without a force recording.
        """
        decision = self.run.decision_of({"kind": "clock", "offset_s": offset_s, "drift_ppm": drift_ppm})
        if self.run.stored.events is None:
            raise InputError("the clock", "a run with a force recording", "none")
        with self.run.lock:
            clock = decided_clock(self.run.stored.clock, decision)
            by_it = {"sticks": self.run.sticks(clock), "slips": self.run.slips(clock)}
            if not isinstance(frame, int):
                return by_it
            event = self._event_at(self.run.positions.row_of(frame), clock)
            after = None if event is None else self._by_clock(event, clock)
            return by_it | {"event": event, "stick_after": after}

    def strip_preview(self, rows: Any, frame: Any) -> dict[str, Any]:
        """Ridges of one frame in other rows, and the noise of positions in the frames about it.

        Raises: InputError for rows outside the picture, or without a ridge.
        """
        top, bottom = self.run.decision_of({"kind": "strip", "rows": rows}).rows or (0, 0)
        height = self.run.recordings.film().shape[0]
        if bottom > height:
            raise InputError("the strip", f"rows within 0:{height}", f"{rows}")
        at = self.run.positions.row_of(frame if isinstance(frame, int) else int(self.run.positions.frame[0]))
        pictures, here = self._pictures(at)
        first = self.run.diagram.first_column
        across = slice(first, first + self.run.diagram.columns)
        profile = np.stack([row_means(one[None, top:bottom, across])[0] for one in pictures])
        comb = describe_ridges(profile, polarity=self.run.positions.comb.polarity, source="the strip")
        seen = find_ridges(profile, comb, settings=self.run.settings.tuning.tracking)
        window = self.run.positions.track_facts.window_px
        bright = comb.bright(profile)
        start = _nearest(seen.x_px, usual_places(self.run.positions) - first, 0.5 * comb.pitch_px)
        x, _ = fit_sheets(bright, start, fit="sliding", window_px=window, comb=comb)
        known = np.isfinite(seen.x_px[here])
        return {
            "rows": [top, bottom],
            "frame": int(self.run.positions.frame[at]),
            "profile": profile[here],
            "ridges": seen.x_px[here][known].astype(float) + first,
            "contrast": comb.contrast,
            "fwhm_px": comb.fwhm_px,
            "profile_noise": comb.noise,
            "noise_px": float(np.nanmedian(position_noise(x))) if len(x) >= 3 else math.nan,
            "sheets_seen": int(np.isfinite(x[here]).sum()),
        }

    def _pictures(self, row: int) -> tuple[list[Pixels], int]:
        """Frames about one, kept while the page stays at it, and its place among them."""
        with self.run.lock:
            if self._around[0] != row:
                film, positions = self.run.recordings.film(), self.run.positions
                first = max(0, min(row - NOISE_FRAMES // 2, len(positions.frame) - NOISE_FRAMES))
                rows = range(first, min(first + NOISE_FRAMES, len(positions.frame)))
                found = [(k, film.picture(int(positions.frame[k]), float(positions.time_s[k]))) for k in rows]
                kept = [(k, one) for k, one in found if one is not None]
                if row not in [k for k, _ in kept]:
                    raise InputError("the frame", "one that can be read", f"{positions.frame[row]}")
                self._around = row, [one for _, one in kept], [k for k, _ in kept].index(row)
            return self._around[1], self._around[2]

    # --- deformation ----------------------------------------------------------------------------------------

    def stick(self, event: int) -> dict[str, Any]:
        """σ_x/Λ_st of every sheet in one stick and the shell of each side; without sheets, the reason."""
        with self.run.lock:
            return {"event": event, **self._now(event)}

    def _now(self, event: int) -> dict[str, Any]:
        """Of the positions as they are; kept until a decision changes them."""
        if self._known[0] != self.run.revision:
            self._known = self.run.revision, {}
        if event not in self._known[1]:
            self._known[1][event] = self._by_clock(event)
        return self._known[1][event]

    def _by_clock(self, event: int, clock: Clock | None = None) -> dict[str, Any]:
        """Of the positions as they are, by the run's clock or another."""
        try:
            near = self._near(event, clock)
        except InputError as error:
            return _unknown(error)
        return self._measured(self.run.positions, near)

    def _then(self, now: dict[str, Any], before: Positions, after: Positions, near: Near) -> dict[str, Any]:
        """Of other positions; what is known already where they are the same about this stick."""
        same = np.array_equal(before.side, after.side) and np.array_equal(before.n, after.n)
        if same and np.array_equal(before.x_px[near.rows], after.x_px[near.rows], equal_nan=True):
            return now
        return self._measured(after, near)

    def _near(self, event: int, clock: Clock | None = None) -> Near:
        """The stick with those around it.  Raises: InputError where clock or events are missing or unsure."""
        clock, events = clock or self.run.clock, self.run.stored.events
        if clock is None or events is None:
            raise InputError("the run", "a force recording and its clock", "none", "give `force` to track")
        if clock.status not in READY:
            raise InputError("the clock", "one that is sure", "an ambiguous one", "accept a candidate")
        place = np.flatnonzero(events["event"].to_numpy() == event)
        if not place.size:
            raise InputError("the event", "one of events.csv", f"{event}")
        time = clock.to_force_s(self.run.positions.time_s)
        step = float(np.nanmedian(np.diff(time[: min(len(time), 1000)])))
        for around in range(STICKS_AROUND, -1, -1):
            sticks = events.iloc[max(0, place[0] - around) : place[0] + around + 1]
            first, last = sticks["t_v_s"].min() - 2 * step, sticks["t_p_s"].max() + 2 * step
            rows = np.flatnonzero((time >= first) & (time <= last))
            if rows.size <= MOST_ROWS:
                break
        if not rows.size:
            raise InputError("the stick phase", "one within the film", f"{event}")
        return Near(event=event, clock=clock, sticks=sticks, rows=rows)

    def _measured(self, positions: Positions, near: Near) -> dict[str, Any]:
        """σ_x/Λ_st of every sheet in a stick, and the shell of each side; why not where it cannot be."""
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
            sheets = classify_sheets(one, threshold=settings.threshold).isel(event=0)
            shells = classify_shells(one, threshold=settings.threshold, settings=settings.tuning.shells)
        except InputError as error:
            return _unknown(error)
        names = ("side", "n", "ratio", "ratio_err", "p_stiff", "shell", "flag")
        table = pd.DataFrame(
            {"index": sheets["sheet"].values} | {name: sheets[name].values for name in names}
        )
        sizes = shells[["side", "stiff_sheets", "stiff_low", "stiff_high"]]
        return {"sheets": table.to_dict("records"), "shells": sizes.to_dict("records")}


@dataclass(frozen=True, kw_only=True)
class Near:
    """One stick, with those around it from which noise and camera movement are measured."""

    event: int
    clock: Clock  # by which they lie in these rows
    sticks: pd.DataFrame
    rows: Ints

    def since(self, row: int) -> Near:
        """With rows counted from another one."""
        return replace(self, rows=self.rows - row)


def _unknown(error: InputError) -> dict[str, Any]:
    return {"sheets": [], "shells": [], "reason": with_options(str(error))}


def _about(row: int) -> slice:
    """The rows that are shown around one."""
    return slice(max(0, row - SHOWN_ROWS // 2), row + SHOWN_ROWS // 2)


def _clipped(decision: Correction, part: Positions) -> Correction:
    """The decision within a part of the frames."""
    if decision.kind not in OF_STRETCHES:
        return decision
    first, last = int(part.frame[0]), int(part.frame[-1])
    stop = last + 1 if decision.stop is None else min(decision.stop, last + 1)
    return replace(decision, first=max(decision.first, first), stop=stop)


def _shown(positions: Positions, rows: slice) -> dict[str, Any]:
    """What a preview draws: positions of every sheet, and their numbering."""
    return {
        "x_px": np.round(positions.x_px[rows].astype(np.float64), 3),
        "side": positions.side,
        "n": positions.n,
        "axis_px": positions.track_facts.axis_px,
    }


def _nearest(x: Floats32, places: Floats, reach: float) -> Floats:
    """The candidate of each frame nearest to each place, (frame, place); NaN without one in reach."""
    distance = np.abs(x[:, :, None] - places[None, None, :])
    distance = np.where(np.isfinite(distance), distance, np.inf)
    best = distance.argmin(axis=1)
    found = np.take_along_axis(x, best, axis=1).astype(float)
    return np.where(distance.min(axis=1) <= reach, found, np.nan)
