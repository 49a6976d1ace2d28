"""One run that is being looked at and put right: what is shown, and the decisions made about it."""

from __future__ import annotations

import math
import os
import secrets
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from threading import RLock
from typing import IO, Any, Self

import numpy as np
import pandas as pd
import xarray as xr

from vision.clock import Candidate, Clock, video_slips
from vision.data import StripMetadata
from vision.deformation import horizontal_deformation
from vision.errors import InputError
from vision.figures.decimate import grey_levels, minmax_decimate
from vision.files import reading
from vision.force import read_force
from vision.numeric import Floats, Floats32, Ints, Pixels
from vision.pipeline import Settings
from vision.review.diagram import Diagram
from vision.review.editing import Before, apply, take_back, usual_places
from vision.review.film import Film
from vision.review.positions import FLAGS, WHYS, Positions, read_positions
from vision.review.saving import Job, Saver, pack, unpack
from vision.review.tiles import Tiles, encode_png
from vision.run.folder import MARK
from vision.run.reading import input_of, read_json, read_table_of
from vision.run.writing import CORRECTIONS
from vision.sheets.corrections import (
    KEYS,
    OF_STRETCHES,
    OPTIONAL,
    Correction,
    Decisions,
    correction_of,
    corrections_text,
    last_of,
    read_decisions,
    stretches,
)
from vision.sheets.recovery import DOUBTS
from vision.sheets.ridges import describe_ridges, find_ridges
from vision.sheets.subpixel import fit_sheets, position_noise
from vision.shells import classify_sheets
from vision.video import Video, open_video
from vision.video.strip import row_means

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

REPLACED = "corrections.npz"  # what saved decisions replaced, so that they can be taken back
STICKS_AROUND = 3  # on each side of a stick, from which noise and camera movement are measured anew
SHOWN_ROWS = 400  # of a preview
MOST_ROWS = 2000  # on which a preview works
NOISE_FRAMES = 16  # from which the noise in other rows is measured
MOST_DOUBTS = 500  # listed
READY = ("ok", "given")  # of a clock


@dataclass(frozen=True, kw_only=True)
class Found:
    """What a run folder holds, read once.

    Parameters
    ----------
    folder
        The run folder.
    facts
        run.json.
    clock, events, deformation, shells
        As far as the run has them.
    """

    folder: Path
    facts: Mapping[str, Any]
    clock: Clock | None = None
    events: pd.DataFrame | None = None
    deformation: pd.DataFrame | None = None
    shells: pd.DataFrame | None = None

    @classmethod
    def of(cls, folder: Path) -> Found:
        """Raises: InputError for a folder that is no run of a video, or a damaged one."""
        facts = read_json(folder / MARK)
        clock = folder / "clock.json"
        return cls(
            folder=folder,
            facts=facts,
            clock=clock_of(read_json(clock)) if clock.exists() else None,
            events=read_table_of(folder, "events"),
            deformation=read_table_of(folder, "deformation"),
            shells=read_table_of(folder, "shells"),
        )

    @property
    def film_checksum(self) -> str:
        """Of the film, as run.json has it."""
        first: dict[str, Any] = next(iter(self.facts.get("inputs") or []), {})
        return str(first.get("sha256") or first.get("fingerprint") or "")

    @property
    def applied(self) -> list[Correction]:
        """Decisions that its tables already follow."""
        return [
            correction_of(entry["kind"], _as_entry(entry)) for entry in self.facts.get("corrections") or []
        ]


def clock_of(facts: Mapping[str, Any]) -> Clock:
    """`Clock` from clock.json."""
    values: dict[str, Any] = {name: math.nan if value is None else value for name, value in facts.items()}
    values["candidates"] = tuple(Candidate(**one) for one in facts.get("candidates") or ())
    values["warnings"] = tuple(facts.get("warnings") or ())
    return Clock(**{name: values[name] for name in Clock.__dataclass_fields__ if name in values})


def _as_entry(facts: Mapping[str, Any]) -> dict[str, Any]:
    """An entry of a corrections file from what run.json says about a correction."""
    known = {name: value for name, value in facts.items() if name in Correction.__dataclass_fields__}
    for name in ("sheets", "rows"):
        if known.get(name) is not None:
            known[name] = tuple(known[name])
    return Correction(**known).entry()


class Session:
    """A run, its decisions, and the positions that follow from them.

    Parameters
    ----------
    folder
        The run folder.
    settings
        As the run was made with; its corrections are not used, those of the folder are.
    film
        Where the film lies now, if not where it was when it was tracked.
    options
        Names of arguments and the command's options that a report shows in their place.

    Notes
    -----
    Every decision is on disk, in corrections.toml, before the call that made it returns. The run's tables
    follow when it is saved.
    """

    def __init__(
        self,
        folder: Path,
        settings: Settings,
        *,
        film: Path | None = None,
        options: Mapping[str, str] | None = None,
    ) -> None:
        self.folder, self.settings, self.options = folder, settings, dict(options or {})
        self.saver = Saver(self._saved)
        self._film_moved = film
        self._film: Film | None = None
        self._film_reason = ""
        self.lock = RLock()
        self.revision = 0
        self._claim = claim(folder)
        self._around: tuple[int, list[Pixels], int] = (-1, [], 0)
        self._measured: tuple[int | None, int, list[dict[str, Any]]] = (None, -1, [])
        self._grey: tuple[float, float] | None = None
        self._force: xr.Dataset | None = None
        try:
            with reading(folder, "a run folder as track writes it", "run track again"):
                self._load()
        except BaseException:
            self._claim.close()
            raise

    def _load(self) -> None:
        """Read the folder, then take up the decisions that its tables do not follow yet."""
        self.found = Found.of(self.folder)
        columns = self.settings.columns
        first = 0 if columns is None else columns.start or 0
        self.diagram = Diagram(self.folder / "kymograph.tif", first, self.settings.tuning.tracking)
        ridges = self.found.facts.get("found", {}).get("ridges", {}).get("polarity", "bright")
        self.tiles = Tiles(self.diagram, bright=ridges == "bright")
        with ThreadPoolExecutor(1) as pool:  # while the tracks are tried out and read
            built = pool.submit(self.tiles.build)
            self.positions = read_positions(self.folder / "tracks.nc")
            built.result()
        if len(self.positions.frame) != self.diagram.frames:
            frames = f"{len(self.positions.frame)} rows, one per frame of tracks.nc"
            raise InputError(self.diagram.path, frames, f"{self.diagram.frames}", "run track again")
        self.applied = self.found.applied
        path = self.folder / CORRECTIONS
        decided = read_decisions(path) if path.exists() else Decisions(corrections=tuple(self.applied))
        self.undone = list(decided.undone)
        self.decisions: list[Correction] = []
        self._before: list[Before | None] = []  # what each replaced, None where it is not known
        self.unseen: list[Correction] = []  # taken back, but shown as if it were not until the run is saved
        as_saved = list(decided.corrections[: len(self.applied)])
        if [one.what for one in as_saved] == [one.what for one in self.applied]:
            kept = unpack(self.folder / REPLACED)
            self.decisions += as_saved
            self._before += (kept + [None] * len(as_saved))[: len(as_saved)]
        else:
            self._take_back_saved(decided)
        for decision in decided.corrections[len(self.decisions) :]:
            self._apply(decision)

    def _take_back_saved(self, decided: Decisions) -> None:
        """From the decisions that the run follows to those that were still held when it was left."""
        kept = unpack(self.folder / REPLACED)
        same = _common(self.applied, decided.corrections)
        self.decisions = list(self.applied)
        self._before = (kept + [None] * len(self.applied))[: len(self.applied)]
        while len(self.decisions) > same:
            self._step_back()

    def _apply(self, decision: Correction) -> None:
        self.positions, before = apply(self.positions, decision, self.diagram)
        self.decisions.append(decision)
        self._before.append(before)
        self.revision += 1

    def _step_back(self) -> Correction:
        decision, before = self.decisions.pop(), self._before.pop()
        if before is None:
            self.unseen.append(decision)
        else:
            self.positions = take_back(self.positions, before)
        self.revision += 1
        return decision

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.saver.wait()
        self.diagram.close()
        self._claim.close()

    # --- film and force -------------------------------------------------------------------------------------

    def film(self) -> Film:
        """The film, opened at the first need.  Raises: InputError where it is gone or another one."""
        with self.lock:
            if self._film_reason:
                raise InputError("the film", "the one that was tracked", self._film_reason)
            if self._film is None:
                try:
                    self._film = Film(self._open_film())
                except InputError as error:
                    self._film_reason = str(error)
                    raise
            return self._film

    def _open_film(self) -> Video:
        path = input_of(self.folder, self._input(0), self._film_moved)
        chosen = self.settings
        return open_video(
            path, rotate=chosen.rotate, frames=chosen.frames, fps=chosen.fps, timestamps=chosen.timestamps
        )

    def _input(self, place: int) -> Mapping[str, Any]:
        """The film's entry among run.json's inputs (0), or the force recording's (-1)."""
        inputs = self.found.facts.get("inputs") or []
        named = self.found.facts.get("parameters", {}).get("force", {}).get("value")
        if not inputs or (place and not named):
            raise InputError(self.folder, "a film and a force recording", "none in its run.json")
        return dict(inputs[place])

    def frame_png(self, frame: int) -> bytes:
        """One frame as an 8-bit PNG, by the same black and white throughout."""
        film, row = self.film(), self.positions.row_of(frame)
        pixels = film.picture(frame, float(self.positions.time_s[row]))
        if pixels is None:
            raise InputError("the frame", "one that can be read", f"{frame}, which cannot")
        if self._grey is None:
            known = np.asarray(pixels, np.float32)
            low, high = np.percentile(known[np.isfinite(known)], (0.5, 99.8))
            self._grey = float(low), float(max(high, low + 1e-6))
        return encode_png(grey_levels(np.asarray(pixels, np.float32), *self._grey))

    def force(self) -> xr.Dataset:
        """The force recording, read at the first need.  Raises: InputError where there is none."""
        with self.lock:
            if self._force is None:
                chosen = self.settings
                self._force = read_force(
                    input_of(self.folder, self._input(-1)),
                    speed_mm_min=chosen.speed_mm_min,
                    d0_mm=chosen.d0_mm,
                    d0_err_mm=chosen.d0_err_mm,
                    columns=chosen.force_columns,
                    settings=chosen.tuning.force,
                )
            return self._force

    def force_curve(self, first_s: float, stop_s: float, points: int) -> Floats:
        """(rows, 3): seconds of the force clock, load, separation; extremes where there are more rows than
        points."""
        force = self.force()
        time_s = force["time_s"].to_numpy()
        a, b = np.searchsorted(time_s, [first_s, stop_s])
        values = np.column_stack([force[name].to_numpy()[a:b] for name in ("load_N", "d_mm")])
        at, low_high = minmax_decimate(time_s[a:b], values, most=points)
        return np.column_stack([at, low_high])

    # --- saving ---------------------------------------------------------------------------------------------

    def save(self) -> None:
        """Begin to re-run what follows from the decisions.  Raises: InputError while that is being done."""
        with self.lock:
            self.saver.start(
                Job(
                    folder=self.folder,
                    settings=self.settings,
                    applied=tuple(self.applied),
                    decisions=self._held(self.decisions, self.undone),
                    clock=self.found.clock,
                    film=self._film_moved,
                    beside={REPLACED: pack(self._before)} if self._before else {},
                    options=self.options,
                )
            )

    def saving(self) -> dict[str, Any]:
        """How far saving is."""
        saver = self.saver
        return {"running": saver.running, "stage": saver.stage, "error": saver.error, "changed": self.changed}

    def _saved(self) -> None:
        with self.lock:
            earlier = self.diagram
            self._load()
            earlier.close()
            self.revision += 1

    def _check_free(self) -> None:
        """Decisions wait while the run is made again.  Raises: InputError."""
        if self.saver.running:
            raise InputError("the run", "a run that is not being saved", "one that is", "wait for its end")

    # --- decisions ------------------------------------------------------------------------------------------

    def decide(self, request: Mapping[str, Any]) -> None:
        """Keep a decision.  Raises: InputError where it does not fit; nothing is kept then."""
        with self.lock:
            self._check_free()
            if any(one.kind in ("add", "delete") for one in self.unseen):
                found = "a number that waits to be saved"
                raise InputError("the decision", "sheets that are numbered as shown", found, "save first")
            self._keep(self.decision_of(request, dated=True), [])

    def undo(self) -> None:
        """Take the last decision back.  Raises: InputError without one."""
        with self.lock:
            self._check_free()
            if not self.decisions:
                raise InputError("undo", "a decision to take back", "none")
            self._write(self.decisions[:-1], [*self.undone, self.decisions[-1]])
            self.undone.append(self._step_back())

    def redo(self) -> None:
        """Make the last decision that was taken back again.  Raises: InputError without one."""
        with self.lock:
            self._check_free()
            if not self.undone:
                raise InputError("redo", "a decision that was taken back", "none")
            again, rest = self.undone[-1], self.undone[:-1]
            if not (self.unseen and self.unseen[-1].what == again.what):
                self._keep(again, rest)
                return
            self._write([*self.decisions, again], rest)
            self.unseen.pop()
            self.decisions.append(again)
            self._before.append(None)
            self.undone = rest
            self.revision += 1

    def _keep(self, decision: Correction, undone: list[Correction]) -> None:
        """Apply and write; what cannot be written is not applied either."""
        self._apply(decision)
        try:
            self._write(self.decisions, undone)
        except InputError:
            self._step_back()
            raise
        self.undone = undone

    @property
    def pending(self) -> list[Correction]:
        """Decisions that the run's tables do not follow yet."""
        return self.decisions[_common(self.applied, self.decisions) :]

    @property
    def changed(self) -> bool:
        """Whether saving would change the run."""
        return len(self.decisions) != len(self.applied) or bool(self.pending)

    def decision_of(self, request: Mapping[str, Any], *, dated: bool = False) -> Correction:
        """What a page asks for.  Raises: InputError for an unknown kind or a value of the wrong kind."""
        kind = str(request.get("kind"))
        if kind not in KEYS:
            raise InputError("the decision", f"a kind of {', '.join(KEYS)}", repr(kind))
        allowed = (*KEYS[kind], *OPTIONAL.get(kind, ()))
        entry = {name: value for name, value in request.items() if name in allowed}
        if dated:
            entry["date"] = self._now()
        return correction_of(kind, entry, "the decision")

    def _now(self) -> str:
        """The time, later than the last decision's whatever the machine's clock says: dates are the order."""
        last = max((one.date for one in self.decisions if one.date), default="")
        now = datetime.now(UTC)
        if last:
            earliest = datetime.fromisoformat(last) + timedelta(milliseconds=1)
            now = max(now, earliest.astimezone(UTC))
        return now.isoformat(timespec="milliseconds")

    def _write(self, decisions: Sequence[Correction], undone: Sequence[Correction]) -> None:
        """corrections.toml, whole and on the disk when this returns."""
        held = self._held(decisions, undone)
        write_durably(self.folder / CORRECTIONS, corrections_text(held))

    def _held(self, decisions: Sequence[Correction], undone: Sequence[Correction]) -> Decisions:
        checksum = self.found.film_checksum
        return Decisions(corrections=tuple(decisions), undone=tuple(undone), film=checksum)

    # --- what is shown --------------------------------------------------------------------------------------

    def summary(self) -> dict[str, Any]:
        """Everything a page needs at first, of any length of the film."""
        with self.lock:
            positions, facts, strip = self.positions, self.positions.track_facts, self.positions.strip_facts
            frames, columns = self.diagram.frames, self.diagram.columns
            shape = {
                "name": self.folder.resolve().name,
                "source": strip.source,
                "frames": frames,
                "first_frame": int(positions.frame[0]),
                "time_first_s": positions.time_s[0],
                "time_last_s": positions.time_s[-1],
                "fps": strip.fps,
                "clock_kind": strip.clock_kind,
                "columns": columns,
                "first_column": self.diagram.first_column,
                "pixel_size_um": self.found.facts.get("parameters", {}).get("pixel_size", {}).get("value"),
                "threshold": self.settings.threshold,
                "strip": self._rows(strip),
                "axis_px": facts.axis_px,
                "axis_range_px": [facts.axis_low_px, facts.axis_high_px],
                "pitch_px": facts.pitch_px,
                "ridge_fwhm_px": facts.ridge_fwhm_px,
                "ridges": facts.ridges,
                "flags": FLAGS,
                "has_force": self.found.events is not None,
                "warnings": self.found.facts.get("warnings", []),
            }
            lists = {
                "has_force": self.found.events is not None,
                "sheets": self.sheets(),
                "doubts": self.doubts(),
                "sticks": self.sticks(),
                "clock": None if self.clock is None else self.clock.to_json(),
                "tiles": {
                    "levels": self.tiles.levels,
                    "columns": self.tiles.settings.columns,
                    "rows": self.tiles.settings.rows,
                    "factor": self.tiles.settings.factor,
                },
            }
            return shape | lists | self.state()

    def _rows(self, strip: StripMetadata) -> tuple[int, int]:
        """Rows of the strip, as decided on."""
        decided = last_of(self.pending, "strip")
        return (strip.strip_z0, strip.strip_z1) if decided is None or decided.rows is None else decided.rows

    def state(self) -> dict[str, Any]:
        """What changes with each decision."""
        pending = len(self.pending)
        return {
            "revision": self.revision,
            "decisions": [
                {
                    "kind": one.kind,
                    "text": one.text(),
                    "date": one.date,
                    "saved": k < len(self.decisions) - pending,
                }
                | {"entry": one.entry()}
                for k, one in enumerate(self.decisions)
            ],
            "undone": [_listed(one) for one in self.undone],
            "can_undo": bool(self.decisions),
            "can_redo": bool(self.undone),
            "changed": self.changed,
            "unseen": [one.text() for one in self.unseen],
            "saving": self.saving(),
        }

    def sheets(self) -> list[dict[str, Any]]:
        """One entry per sheet, from the left."""
        positions, places = self.positions, usual_places(self.positions)
        return [
            {"index": k, "side": int(side), "n": int(n), "x_px": float(places[k])}
            for k, (side, n) in enumerate(zip(positions.side, positions.n, strict=True))
        ]

    def doubts(self) -> list[dict[str, Any]]:
        """Doubtful stretches, the longest first."""
        positions = self.positions
        sheet, first, stop = stretches(positions.doubtful)
        worst = np.argsort(first - stop, kind="stable")[:MOST_DOUBTS]
        expected = positions.expected_px(first[worst])
        return [
            {
                "sheet": int(sheet[k]),
                "side": int(positions.side[sheet[k]]),
                "n": int(positions.n[sheet[k]]),
                "first": int(positions.frame[first[k]]),
                "stop": int(positions.frame[stop[k] - 1]) + 1,
                "frames": int(stop[k] - first[k]),
                "why": DOUBTS.get(WHYS[positions.why[first[k], sheet[k]]], "identity not certain"),
                "x_withheld_px": float(positions.withheld_px[first[k], sheet[k]]),
                "x_expected_px": float(expected[place, sheet[k]]),
            }
            for place, k in enumerate(worst)
        ]

    @property
    def clock(self) -> Clock | None:
        """The run's, or the one that was decided on since."""
        decided, own = last_of(self.pending, "clock"), self.found.clock
        return own if decided is None else _given(own, decided)

    def sticks(self, clock: Clock | None = None) -> list[dict[str, Any]]:
        """Stick phases within the film, in frames of the film by the clock as it is."""
        clock, events = clock or self.clock, self.found.events
        if clock is None or events is None:
            return []
        start, stop = (clock.to_video_s(events[name].to_numpy(float)) for name in ("t_v_s", "t_p_s"))
        first, last = self._frames_at(start), self._frames_at(stop)
        time_s = self.positions.time_s
        inside = (stop > np.nanmin(time_s)) & (start < np.nanmax(time_s))
        names = ("event", "d_v_mm", "dF_N", "F_p_N", "stick_length_um", "K_N_per_mm", "flag")
        known = [name for name in names if name in events]
        table = events[known].assign(first=first, stop=last + 1, start_s=start, end_s=stop)
        return [{str(name): value for name, value in row.items()} for row in table[inside].to_dict("records")]

    def slips(self, clock: Clock | None = None) -> list[int]:
        """First frames after the slips: of the force where its clock is sure, else of the sheets' steps."""
        clock, time_s = clock or self.clock, self.positions.time_s
        if clock is not None and self.found.events is not None and clock.status in READY:
            at = clock.to_video_s(self.found.events["t_p_s"].to_numpy(float))
            at = at[(at > np.nanmin(time_s)) & (at < np.nanmax(time_s))]
        else:
            at = self._video_slips_s()
        return sorted({int(frame) for frame in self._frames_at(at)})

    def film_slips(self) -> list[int]:
        """First frames after the sheets' own steps, whatever the clock."""
        with self.lock:
            return sorted({int(frame) for frame in self._frames_at(self._video_slips_s())})

    def _video_slips_s(self) -> Floats:
        if not hasattr(self, "_seen_slips_s"):
            try:
                self._seen_slips_s = video_slips(self.positions.tracks())["time_s"].to_numpy(float)
            except InputError:  # too few frames, or none with a time
                self._seen_slips_s = np.empty(0)
        return self._seen_slips_s

    def _frames_at(self, seconds: Floats) -> Ints:
        """Numbers of the frames next after these times of the camera's clock."""
        time_s = self.positions.time_s
        known = np.flatnonzero(np.isfinite(time_s))
        if not known.size:
            return np.zeros(len(seconds), np.int64)
        row = np.searchsorted(time_s[known], np.nan_to_num(seconds, nan=-np.inf))
        return np.asarray(self.positions.frame[known[np.minimum(row, known.size - 1)]], np.int64)

    def curves(self, first: int, stop: int, points: int, what: str = "x") -> Floats32:
        """(rows, 1 + sheets): frame number, then a value of each sheet; extremes of intervals where there
        are more rows than points.

        Parameters
        ----------
        first, stop
            Frames, half-open.
        points
            Rows wanted at most.
        what
            "x" (px), "err" (px), "withheld" (px), or "flag": place in `FLAGS`, the worst
            of each interval.

        Raises
        ------
        InputError
            For another name.
        """
        names = {"x": "x_px", "err": "err_px", "withheld": "withheld_px"}
        if what not in (*names, "flag"):
            raise InputError("what", f"{', '.join(names)} or flag", repr(what))
        with self.lock:
            positions = self.positions
            a, b = np.searchsorted(positions.frame, [first, stop])
            rows = slice(int(a), max(int(b), int(a)))
            frame = positions.frame[rows].astype(np.float64)
            if what == "flag":
                at, values = _worst(frame, positions.flag[rows], points)
            else:
                at, values = minmax_decimate(frame, getattr(positions, names[what])[rows], most=points)
        return np.column_stack([at, values]).astype(np.float32)

    def ridges(self, frame: int) -> dict[str, Any]:
        """Every candidate that the program saw in one frame, with the sheet it is taken for."""
        with self.lock:
            positions = self.positions
            row = positions.row_of(frame)
            seen = self.diagram.ridges(positions, slice(row, row + 1))
            known = np.isfinite(seen.x_px[0])
            x = seen.x_px[0][known].astype(float) + self.diagram.first_column
            owner = _owners(x, positions.x_px[row])
            doubted = _owners(x, positions.withheld_px[row])
            candidates = [
                {
                    "x_px": x[k],
                    "contrast": seen.contrast[0][known][k],
                    "fwhm_px": seen.fwhm_px[0][known][k],
                    "sheet": int(owner[k]) if owner[k] >= 0 else None,
                    "doubted_sheet": int(doubted[k]) if doubted[k] >= 0 else None,
                }
                for k in range(len(x))
            ]
            expected = positions.expected_px(np.array([row]))[0]
            names = ("x_px", "err_px", "withheld_px")
            sheets = [
                {"index": k, "flag": FLAGS[positions.flag[row, k]]}
                | {"why": DOUBTS.get(WHYS[positions.why[row, k]], "")}
                | {name: getattr(positions, name)[row, k] for name in names}
                | {"expected_px": expected[k]}
                for k in range(positions.sheets)
            ]
        return {"frame": frame, "candidates": candidates, "sheets": sheets}

    # --- effects that are not kept --------------------------------------------------------------------------

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
        decision = self.decision_of(request)
        with self.lock:
            if decision.kind == "clock":
                return {"text": decision.text(), **self.clock_preview(decision.offset_s, decision.drift_ppm)}
            rows, at = self._window(decision, frame)
            before = self.positions.copied(rows)
            clipped = _clipped(decision, before)
            after, _ = apply(self.positions.copied(rows), clipped, self.diagram)
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
        positions = self.positions
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
        clock, events = clock or self.clock, self.found.events
        if clock is None or events is None or clock.status not in READY:
            return None
        time_s = float(clock.to_force_s(self.positions.time_s[row]))
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
        if self._measured[:2] != (event, self.revision):
            self._measured = event, self.revision, self._ratios(self.positions, event)
        return self._measured[2]

    def clock_preview(self, offset_s: Any, drift_ppm: Any = 0.0, frame: Any = None) -> dict[str, Any]:
        """Sticks and slips by another clock, and σ_x/Λ_st of the stick at a frame.

        Raises
        ------
        InputError
            Without a force recording.
        """
        request = {"kind": "clock", "offset_s": offset_s, "drift_ppm": drift_ppm}
        decision = self.decision_of(request)
        if self.found.events is None:
            raise InputError("the clock", "a run with a force recording", "none")
        with self.lock:
            clock = _given(self.found.clock, decision)
            by_it = {"sticks": self.sticks(clock), "slips": self.slips(clock)}
            if not isinstance(frame, int):
                return by_it
            event = self._event_at(self.positions.row_of(frame), clock)
            after = self._ratios(self.positions, event, clock)
            return by_it | {"event": event, "stick_after": after}

    def strip_preview(self, rows: Any, frame: Any) -> dict[str, Any]:
        """Ridges of one frame in other rows, and the noise of positions in the frames about it.

        Raises
        ------
        InputError
            For rows outside the picture, or without a ridge.
        """
        decision = self.decision_of({"kind": "strip", "rows": rows})
        top, bottom = decision.rows or (0, 0)
        if bottom > self.film().shape[0]:
            raise InputError("the strip", f"rows within 0:{self.film().shape[0]}", f"{rows}")
        at = self.positions.row_of(frame if isinstance(frame, int) else int(self.positions.frame[0]))
        pictures, here = self._pictures(at)
        first = self.diagram.first_column
        across = slice(first, first + self.diagram.columns)
        profile = np.stack([row_means(one[None, top:bottom, across])[0] for one in pictures])
        comb = describe_ridges(profile, polarity=self.positions.comb.polarity, source="the strip")
        seen = find_ridges(profile, comb, settings=self.settings.tuning.tracking)
        window = self.positions.track_facts.window_px
        bright = profile if comb.sign > 0 else -profile
        start = _nearest(seen.x_px, usual_places(self.positions) - first, 0.5 * comb.pitch_px)
        x, _ = fit_sheets(bright, start, fit="sliding", window_px=window, comb=comb)
        known = np.isfinite(seen.x_px[here])
        return {
            "rows": [top, bottom],
            "frame": int(self.positions.frame[at]),
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
        with self.lock:
            if self._around[0] != row:
                film, positions = self.film(), self.positions
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
        table, shells = self.found.deformation, self.found.shells
        if self.changed or table is None:
            with self.lock:
                return self._stick_now(self.positions, event)
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
        clock, events = clock or self.clock, self.found.events
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
            pixel_size_um=self.found.facts.get("parameters", {}).get("pixel_size", {}).get("value"),
            common_mode=self.settings.common_mode,
            settings=self.settings.tuning.deformation,
        )
        return classify_sheets(motion, threshold=self.settings.threshold)


def _given(own: Clock | None, decided: Correction) -> Clock:
    """The clock of a decision; slips are counted again when it is saved."""
    known = own or Clock(
        offset_s=0.0,
        drift_ppm=0.0,
        residual_ms=math.nan,
        matched=0,
        unmatched_video=0,
        unmatched_force=0,
        margin=math.nan,
        status="given",
        how="given",
    )
    return replace(
        known,
        offset_s=decided.offset_s or 0.0,
        drift_ppm=decided.drift_ppm,
        status="given",
        how="given",
        error_ms=math.nan,
        drift_err_ppm=math.nan,
    )


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


def _listed(one: Correction) -> dict[str, Any]:
    return {"kind": one.kind, "text": one.text(), "date": one.date, "entry": one.entry()}


def _common(one: Sequence[Correction], other: Sequence[Correction]) -> int:
    """How many decisions from the first on say the same in both."""
    pairs = enumerate(zip(one, other, strict=False))
    return next((k for k, (a, b) in pairs if a.what != b.what), min(len(one), len(other)))


def _owners(x: Floats, positions: Floats | Floats32) -> Ints:
    """Index of the sheet whose position is this candidate's, -1 for none; within 2 px, the nearest."""
    distance = np.abs(np.asarray(positions, float)[None, :] - x[:, None])
    distance = np.where(np.isfinite(distance), distance, np.inf)
    nearest = distance.argmin(axis=1)
    near = distance[np.arange(len(x)), nearest] <= 2.0
    return np.where(near, nearest, -1).astype(np.int64)


def _worst(frame: Floats, codes: Any, points: int) -> tuple[Floats, Any]:
    """The largest code of every interval."""
    if len(frame) <= points:
        return frame, codes
    starts = np.arange(0, len(frame), -(-len(frame) // points))
    return frame[starts], np.maximum.reduceat(codes, starts, axis=0)


def claim(folder: Path) -> IO[str]:
    """An open file beside the run folder that keeps others from reviewing it; they may once it is closed.

    Beside it, as saving puts another folder in the run's place. The claim ends with the process, however that
    ends. Where the system has no such locks (Windows) nothing is claimed.

    Raises
    ------
    InputError
        Where another process reviews the run, or the place cannot be written.
    """
    path = folder.resolve()
    path = path.with_name(f".{path.name}.review")
    try:
        file = path.open("w", encoding="utf-8")
    except OSError as error:
        found = (error.strerror or str(error)).lower()
        raise InputError(path, "a place that can be written", found, "copy the run folder") from error
    if fcntl is not None:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            file.close()
            found, advice = "a review of it that is open", "go to its window, or end it there"
            raise InputError(folder, "a run that nobody reviews now", found, advice) from None
    return file


def write_durably(path: Path, text: str) -> None:
    """Replace a text file in one step; on the disk when this returns.

    Raises
    ------
    InputError
        Where it cannot be written; the file is as it was then.
    """
    made = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        with made.open("w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        made.replace(path)
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    except OSError as error:
        found = (error.strerror or str(error)).lower()
        raise InputError(path, "a place that can be written", found, "the decision is not kept") from error
    finally:
        made.unlink(missing_ok=True)
