"""What a decision would change before it is kept: positions, numbering, deformation, other rows."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import xarray as xr

from vision.clock import Clock
from vision.deformation import horizontal_deformation
from vision.errors import InputError
from vision.numeric import Floats, Floats32, Pixels
from vision.review.editing import apply, usual_places
from vision.review.positions import Positions
from vision.review.stored import decided_clock
from vision.sheets.corrections import OF_STRETCHES, Correction
from vision.sheets.ridges import describe_ridges, find_ridges
from vision.sheets.subpixel import fit_sheets, position_noise
from vision.shells import classify_sheets
from vision.video.strip import row_means

if TYPE_CHECKING:
    from vision.review.session import Session

STICKS_AROUND = 3  # on each side of a stick, from which noise and camera movement are measured anew
SHOWN_ROWS = 400  # of a preview
MOST_ROWS = 2000  # on which a preview works
NOISE_FRAMES = 16  # from which the noise in other rows is measured
READY = ("ok", "given")  # of a clock


class Effects:
    """Measures what decisions change; keeps none.

    Parameters
    ----------
    run
        The session whose positions, clock and film are looked at.
    """

    def __init__(self, run: Session) -> None:
        self.run = run
        self._around: tuple[int, list[Pixels], int] = (-1, [], 0)
        self._measured: tuple[int | None, int, list[dict[str, Any]]] = (None, -1, [])

    def preview(self, request: Mapping[str, Any], frame: Any = None) -> dict[str, Any]:
        """What a decision would change: positions about a frame, numbering, and σ_x/Λ_st of the stick there.

        Parameters
        ----------
        request
            The decision.
        frame
            Where the page looks; the decision's first frame if it is not within its frames.

        Raises
        ------
        InputError
            Where the decision does not fit.
        """
        decision = self.run.decision_of(request)
        with self.run.lock:
            if decision.kind == "clock":
                return {"text": decision.text(), **self.clock_preview(decision.offset_s, decision.drift_ppm)}
            rows, at = self._window(decision, frame)
            before = self.run.positions.copied(rows)
            clipped = _clipped(decision, before)
            after, _ = apply(self.run.positions.copied(rows), clipped, self.run.diagram)
            near = slice(max(0, at - rows.start - SHOWN_ROWS // 2), at - rows.start + SHOWN_ROWS // 2)
            event = self._event_at(at)
            return {
                "text": decision.text(),
                "frames": before.frame[near],
                "before": _shown(before, near),
                "after": _shown(after, near),
                "event": event,
                "stick_before": self._ratios_now(event),
                "stick_after": self._ratios(after, event),
            }

    def _window(self, decision: Correction, frame: Any) -> tuple[slice, int]:
        """Rows that a preview works on, and the one in their middle: those around the frame looked at, with
        the sticks there, from where a ridge is first followed."""
        positions = self.run.positions
        numbers = positions.frame
        first = max(decision.first, int(numbers[0]))
        last = int(numbers[-1]) if decision.stop is None else min(decision.stop - 1, int(numbers[-1]))
        looked = frame if isinstance(frame, int) and first <= frame <= last else first
        if decision.kind in ("assign", "add"):
            looked = min(max(looked, first), first + MOST_ROWS // 2)
        at = min(int(np.searchsorted(numbers, looked)), len(numbers) - 1)
        a, b = max(0, at - MOST_ROWS // 2), min(len(numbers), at + MOST_ROWS // 2)
        if decision.kind in ("assign", "add"):
            a = min(a, int(np.searchsorted(numbers, first)))
        return slice(a, b), at

    def _event_at(self, row: int, clock: Clock | None = None) -> int | None:
        """The stick in which a frame lies, where the clock is sure."""
        clock, events = clock or self.run.clock, self.run.found.events
        if clock is None or events is None or clock.status not in READY:
            return None
        time_s = float(clock.to_force_s(self.run.positions.time_s[row]))
        inside = (events["t_v_s"] <= time_s) & (events["t_p_s"] >= time_s)
        return int(events["event"].to_numpy()[inside.to_numpy()][0]) if inside.any() else None

    def _ratios(
        self, positions: Positions, event: int | None, clock: Clock | None = None
    ) -> list[dict[str, Any]]:
        """σ_x/Λ_st of one stick; nothing where it cannot be measured."""
        if event is None:
            return []
        try:
            return _of_event(self._motion(positions, [event], clock), event)
        except InputError:
            return []

    def _ratios_now(self, event: int | None) -> list[dict[str, Any]]:
        """`_ratios` of the positions as they are, kept until they change."""
        if self._measured[:2] != (event, self.run.revision):
            self._measured = event, self.run.revision, self._ratios(self.run.positions, event)
        return self._measured[2]

    def clock_preview(self, offset_s: Any, drift_ppm: Any = 0.0, frame: Any = None) -> dict[str, Any]:
        """Sticks and slips by another clock, and σ_x/Λ_st of the stick at a frame.

        Raises
        ------
        InputError
            Without a force recording.
        """
        request = {"kind": "clock", "offset_s": offset_s, "drift_ppm": drift_ppm}
        decision = self.run.decision_of(request)
        if self.run.found.events is None:
            raise InputError("the clock", "a run with a force recording", "none")
        with self.run.lock:
            clock = decided_clock(self.run.found.clock, decision)
            by_it = {"sticks": self.run.sticks(clock), "slips": self.run.slips(clock)}
            if not isinstance(frame, int):
                return by_it
            event = self._event_at(self.run.positions.row_of(frame), clock)
            after = self._ratios(self.run.positions, event, clock)
            return by_it | {"event": event, "stick_after": after}

    def strip_preview(self, rows: Any, frame: Any) -> dict[str, Any]:
        """Ridges of one frame in other rows, and the noise of positions in the frames about it.

        Raises
        ------
        InputError
            For rows outside the picture, or without a ridge.
        """
        decision = self.run.decision_of({"kind": "strip", "rows": rows})
        top, bottom = decision.rows or (0, 0)
        if bottom > self.run.film().shape[0]:
            raise InputError("the strip", f"rows within 0:{self.run.film().shape[0]}", f"{rows}")
        at = self.run.positions.row_of(frame if isinstance(frame, int) else int(self.run.positions.frame[0]))
        pictures, here = self._pictures(at)
        first = self.run.diagram.first_column
        across = slice(first, first + self.run.diagram.columns)
        profile = np.stack([row_means(one[None, top:bottom, across])[0] for one in pictures])
        comb = describe_ridges(profile, polarity=self.run.positions.comb.polarity, source="the strip")
        seen = find_ridges(profile, comb, settings=self.run.settings.tuning.tracking)
        window = self.run.positions.track_facts.window_px
        bright = profile if comb.sign > 0 else -profile
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
                film, positions = self.run.film(), self.run.positions
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
        """σ_x/Λ_st of every sheet in one stick: as saved, or measured anew where decisions wait."""
        table, shells = self.run.found.deformation, self.run.found.shells
        if self.run.changed or table is None:
            with self.run.lock:
                return self._stick_now(self.run.positions, event)
        part = table[table["event"] == event]
        if not len(part):
            raise InputError("the event", "one within the film", f"{event}")
        names = ("index", "side", "n", "ratio", "ratio_err", "p_stiff", "shell", "flag")
        sheets = part[list(names)].to_dict("records")
        sides = [] if shells is None else shells[shells["event"] == event].to_dict("records")
        return {"event": event, "preview": False, "sheets": sheets, "shells": sides}

    def _stick_now(self, positions: Positions, event: int) -> dict[str, Any]:
        motion = self._motion(positions, [event])
        return {"event": event, "preview": True, "shells": [], "sheets": _of_event(motion, event)}

    def _motion(self, positions: Positions, wanted: list[int], clock: Clock | None = None) -> xr.Dataset:
        """Deformation in these sticks, with those around them for noise and camera movement.

        Raises
        ------
        InputError
            Where clock, events or pixel size are missing, or the sticks lie outside the film.
        """
        clock, events = clock or self.run.clock, self.run.found.events
        if clock is None or events is None:
            raise InputError("the run", "a force recording and its clock", "none", "give `force` to track")
        if clock.status not in READY:
            raise InputError("the clock", "one that is sure", "an ambiguous one", "accept a candidate")
        places = [int(k) for k in np.flatnonzero(events["event"].isin(wanted).to_numpy())]
        if not places:
            raise InputError("the event", "one of events.csv", f"{wanted}")
        near = slice(max(0, places[0] - STICKS_AROUND), places[-1] + STICKS_AROUND + 1)
        some = events.iloc[near]
        time = clock.to_force_s(positions.time_s)
        step = float(np.nanmedian(np.diff(time[: min(len(time), 1000)])))
        kept = (time >= some["t_v_s"].min() - 2 * step) & (time <= some["t_p_s"].max() + 2 * step)
        motion = horizontal_deformation(
            positions.tracks(np.flatnonzero(kept)),
            some,
            clock,
            pixel_size_um=self.run.found.facts.get("parameters", {}).get("pixel_size", {}).get("value"),
            common_mode=self.run.settings.common_mode,
            settings=self.run.settings.tuning.deformation,
        )
        return classify_sheets(motion, threshold=self.run.settings.threshold)


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


def _of_event(motion: xr.Dataset, event: int) -> list[dict[str, Any]]:
    if event not in motion["event"].values:
        raise InputError("the event", "one within the film", f"{event}")
    one = motion.sel(event=event)
    names = ("ratio", "ratio_err", "p_stiff", "shell", "flag")
    columns = {"index": one["sheet"], "side": one["side"], "n": one["n"]} | {
        name: one[name] for name in names
    }
    table = pd.DataFrame({name: values.values for name, values in columns.items()})
    return [{str(name): value for name, value in row.items()} for row in table.to_dict("records")]
