"""A run under review: what is shown of it, and the decisions about it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict
from datetime import UTC, datetime, timedelta
from pathlib import Path
from threading import RLock
from typing import Any, Self

import numpy as np

from vision.clock import Clock
from vision.errors import InputError
from vision.figures.decimate import minmax_decimate
from vision.files import reading
from vision.numeric import Floats, Floats32, Ints, nearest
from vision.pipeline import Settings
from vision.review.effects import READY, Effects
from vision.review.positions import (
    FLAGS,
    SAME_RIDGE_PX,
    WHYS,
    Before,
    apply,
    positions_of,
    take_back,
    usual_places,
)
from vision.review.recordings import Diagram, Recordings, StoredRun, Tiles, claim, decided_clock
from vision.review.saving import SaveJob, Saver, Trial, pack, unpack
from vision.review.tracks_file import StoredTracks, read_tracks
from vision.run.folder import plain, whole_file
from vision.run.reading import AGAIN
from vision.run.writing import CORRECTIONS
from vision.sheets.corrections import (
    KEYS,
    OPTIONAL,
    Correction,
    Decisions,
    correction_of,
    corrections_text,
    last_of,
    read_decisions,
)
from vision.sheets.recovery import DOUBTS, stretches

REPLACED = "corrections.npz"  # what saved decisions replaced, so that they can be taken back


class Session:
    """A run, its decisions, and the positions that follow from them.

    Every decision is on disk, in corrections.toml, before the call that made it returns. The run's tables
    follow when it is saved.

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
    tracks
        Of the run, where they are being read already.
    """

    def __init__(
        self,
        folder: Path,
        settings: Settings,
        *,
        film: Path | None = None,
        options: Mapping[str, str] | None = None,
        tracks: Future[StoredTracks] | None = None,
    ) -> None:
        self.folder, self.settings, self.options = folder, settings, dict(options or {})
        self.saver, self.effects, self.trial = Saver(), Effects(self), Trial(self)
        self.lock = RLock()
        self.revision = 0
        self._claim = claim(folder)
        self.trial.sweep()  # what a killed review left
        self._film_slips: tuple[int, list[int]] = (-1, [])
        try:
            with reading(folder, "a run folder as track writes it", AGAIN):
                self._load(tracks)
                self.revision = 0  # whatever was taken up: pages know it from the first view
                self.recordings = Recordings(self.stored, settings, film)
        except BaseException:
            self._claim.close()
            raise

    def _load(self, tracks: Future[StoredTracks] | None = None) -> None:
        """Read the folder, then take up the decisions that its tables do not follow yet."""
        self.stored = StoredRun.of(self.folder)
        columns = self.settings.columns
        first = 0 if columns is None else columns.start or 0
        self.diagram = Diagram(self.folder / "kymograph.tif", first, self.settings.tuning.tracking)
        try:
            self._load_positions(tracks)
        except BaseException:
            self.diagram.close()
            raise

    def _load_positions(self, tracks: Future[StoredTracks] | None) -> None:
        """Positions, and the decisions about them."""
        ridges = self.stored.facts.get("found", {}).get("ridges", {}).get("polarity", "bright")
        self.tiles = Tiles(self.diagram, bright=ridges == "bright")
        with ThreadPoolExecutor(1) as pool:  # while the tracks are tried out and read
            built = pool.submit(self.tiles.build)
            stored = tracks.result() if tracks else read_tracks(self.folder / "tracks.nc")
            self.positions = positions_of(stored)
            built.result()
        if len(self.positions.frame) != self.diagram.frames:
            frames = f"{len(self.positions.frame)} rows, one per frame of tracks.nc"
            raise InputError(self.diagram.path, frames, f"{self.diagram.frames}", AGAIN)
        self.applied = self.stored.applied
        path = self.folder / CORRECTIONS
        decided = read_decisions(path) if path.exists() else Decisions(corrections=tuple(self.applied))
        self.undone = list(decided.undone)
        self.unseen: list[Correction] = []  # taken back, but shown as if it were not until the run is saved
        same, count = _common(self.applied, decided.corrections), len(self.applied)
        self.decisions = [*decided.corrections[:same], *self.applied[same:]]
        # what each replaced, None where it is not known
        self._before: list[Before | None] = [*unpack(self.folder / REPLACED), *[None] * count][:count]
        while len(self.decisions) > same:  # taken back since the run was saved
            self._step_back()
        for decision in decided.corrections[same:]:
            self._apply(decision)

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
        self.trial.discard()
        self.saver.wait()
        self.diagram.close()
        self._claim.close()

    # --- saving ---------------------------------------------------------------------------------------------

    def save(self) -> None:
        """Begin to re-run what follows from the decisions.  Raises: InputError while that is being done."""
        with self.lock:
            self.trial.discard()
            self.saver.start(self.job(self.decisions, self.undone), lambda found: self.reload())

    def job(self, decisions: Sequence[Correction], undone: Sequence[Correction]) -> SaveJob:
        """What makes the run follow these decisions.  Raises: InputError where the run is gone."""
        self.stored.check_there()
        strips = [last_of(part, "strip") for part in (self.applied, decisions)]
        same = len({one.rows if one else None for one in strips}) == 1  # else other positions were replaced
        return SaveJob(
            folder=self.folder,
            settings=self.settings,
            applied=tuple(self.applied),
            decisions=self._as_written(decisions, undone),
            clock=self.stored.clock,
            film=self.recordings.moved,
            beside={REPLACED: pack(self._before)} if self._before and same else {},
            options=self.options,
        )

    def saving(self) -> dict[str, Any]:
        """How far it is."""
        return self.saver.progress() | {"changed": self.changed}

    def reload(self) -> None:
        """Look at the run that has been put in this one's place."""
        with self.lock:
            earlier = self.diagram
            self._load()
            earlier.close()
            self.revision += 1

    def check_free(self) -> None:
        """Decisions wait while the run is made again; what was tried out before them is thrown away.

        Raises: InputError.
        """
        if self.saver.running:
            found = "one that is being tracked or saved"
            raise InputError("the run", "a run that rests", found, "wait for its end, or cancel it")
        self.trial.discard()

    # --- decisions ------------------------------------------------------------------------------------------

    def decide(self, request: Mapping[str, Any]) -> None:
        """Keep a decision.  Raises: InputError where it does not fit; nothing is kept then."""
        with self.lock:
            self.check_free()
            if any(one.kind in ("add", "delete") for one in self.unseen):
                found = "a number that waits to be saved"
                raise InputError("the decision", "sheets that are numbered as shown", found, "save first")
            self._add(self.decision_of(request, dated=True), [])

    def undo(self) -> None:
        """Take the last decision back.  Raises: InputError without one."""
        with self.lock:
            self.check_free()
            if not self.decisions:
                raise InputError("undo", "a decision to take back", "none")
            self._write(self.decisions[:-1], [*self.undone, self.decisions[-1]])
            self.undone.append(self._step_back())

    def redo(self) -> None:
        """Make the last decision that was taken back again.  Raises: InputError without one."""
        with self.lock:
            self.check_free()
            if not self.undone:
                raise InputError("redo", "a decision that was taken back", "none")
            again, rest = self.undone[-1], self.undone[:-1]
            if not (self.unseen and self.unseen[-1].what == again.what):
                self._add(again, rest)
                return
            self._write([*self.decisions, again], rest)
            self.unseen.pop()
            self.decisions.append(again)
            self._before.append(None)
            self.undone = rest
            self.revision += 1

    def _add(self, decision: Correction, undone: list[Correction]) -> None:
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
        self.stored.check_there()
        text = corrections_text(self._as_written(decisions, undone))
        with whole_file(self.folder / CORRECTIONS, durable=True) as path:
            path.write_text(text, encoding="utf-8")

    def _as_written(self, decisions: Sequence[Correction], undone: Sequence[Correction]) -> Decisions:
        checksum = self.stored.film_checksum
        return Decisions(corrections=tuple(decisions), undone=tuple(undone), film=checksum)

    # --- what is shown --------------------------------------------------------------------------------------

    def summary(self) -> dict[str, Any]:
        """Everything a page needs at first, of any length of the film."""
        with self.lock:
            positions, facts, strip = self.positions, self.positions.track_facts, self.positions.strip_facts
            decided = last_of(self.pending, "strip")
            return {
                "name": self.folder.resolve().name,
                "source": strip.source,
                "frames": self.diagram.frames,
                "first_frame": int(positions.frame[0]),
                "time_first_s": positions.time_s[0],
                "time_last_s": positions.time_s[-1],
                "fps": strip.fps,
                "clock_kind": strip.clock_kind,
                "columns": self.diagram.columns,
                "first_column": self.diagram.first_column,
                "pixel_size_um": self.stored.pixel_size_um,
                "threshold": self.settings.threshold,
                "strip": (decided and decided.rows) or (strip.strip_z0, strip.strip_z1),
                "axis_px": facts.axis_px,
                "axis_range_px": [facts.axis_low_px, facts.axis_high_px],
                "pitch_px": facts.pitch_px,
                "ridge_fwhm_px": facts.ridge_fwhm_px,
                "ridges": facts.ridges,
                "flags": FLAGS,
                "has_force": self.stored.events is not None,
                "warnings": self.stored.facts.get("warnings", []),
                "sheets": self.sheets(),
                "doubts": self.doubts(),
                "sticks": self.sticks(),
                "clock": plain(self.clock),
                "tiles": asdict(self.tiles.settings) | {"levels": self.tiles.levels},
                **self.state(),
            }

    def state(self) -> dict[str, Any]:
        """What changes with each decision."""
        saved = len(self.decisions) - len(self.pending)
        return {
            "revision": self.revision,
            "decisions": [_listed(one) | {"saved": k < saved} for k, one in enumerate(self.decisions)],
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
        """The longest doubtful stretches, at most 500, the longest first."""
        positions = self.positions
        sheet, first, stop = stretches(positions.doubtful)
        worst = np.argsort(first - stop, kind="stable")[:500]
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
        decided, own = last_of(self.pending, "clock"), self.stored.clock
        return own if decided is None else decided_clock(own, decided)

    def sticks(self, clock: Clock | None = None) -> list[dict[Any, Any]]:
        """Stick phases within the film, in frames of the film by the clock as it is."""
        clock, events = clock or self.clock, self.stored.events
        if clock is None or events is None:
            return []
        start, stop = (clock.to_video_s(events[name].to_numpy(float)) for name in ("t_v_s", "t_p_s"))
        frames = {"first": self._frames_at(start), "stop": self._frames_at(stop) + 1}
        time_s = self.positions.time_s
        inside = (stop > np.nanmin(time_s)) & (start < np.nanmax(time_s))
        return events[["event", "stick_length_um"]].assign(**frames)[inside].to_dict("records")

    def slips(self, clock: Clock | None = None) -> list[int]:
        """First frames after the slips: of the force where its clock is sure, else of the sheets' steps."""
        clock, time_s = clock or self.clock, self.positions.time_s
        if clock is None or self.stored.events is None or clock.status not in READY:
            return self.film_slips()
        at = clock.to_video_s(self.stored.events["t_p_s"].to_numpy(float))
        at = at[(at > np.nanmin(time_s)) & (at < np.nanmax(time_s))]
        return sorted({int(frame) for frame in self._frames_at(at)})

    def film_slips(self) -> list[int]:
        """First frames after the sheets' own steps, whatever the clock."""
        if self._film_slips[0] != self.revision:  # kept, as a long film takes a second
            frames = self._frames_at(self.positions.slips_s())
            self._film_slips = self.revision, sorted({int(frame) for frame in frames})
        return self._film_slips[1]

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

        what: "x" (px), "err" (px), "withheld" (px), or "flag", place in `FLAGS`, the worst of each interval.
        Raises: InputError for another name.
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
            seen = positions.ridges(self.diagram, slice(row, row + 1))
            known = np.isfinite(seen.x_px[0])
            x = seen.x_px[0][known].astype(float) + self.diagram.first_column
            owner = _owners(x, positions.x_px[row])
            doubted = _owners(x, positions.withheld_px[row])
            contrast, fwhm_px = seen.contrast[0][known], seen.fwhm_px[0][known]
            candidates = [
                {"x_px": x[k], "contrast": contrast[k], "fwhm_px": fwhm_px[k]}
                | {"sheet": owner[k], "doubted_sheet": doubted[k]}
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


def _listed(one: Correction) -> dict[str, Any]:
    return {"kind": one.kind, "text": one.text(), "date": one.date, "entry": one.entry()}


def _common(one: Sequence[Correction], other: Sequence[Correction]) -> int:
    """How many decisions from the first on say the same in both."""
    pairs = enumerate(zip(one, other, strict=False))
    return next((k for k, (a, b) in pairs if a.what != b.what), min(len(one), len(other)))


def _owners(x: Floats, positions: Floats32) -> list[int | None]:
    """Index of the sheet whose position is this candidate's, None for none; within 2 px, the nearest."""
    sheet, distance = nearest(np.broadcast_to(positions.astype(float), (len(x), len(positions))), x)
    return [int(k) if away <= SAME_RIDGE_PX else None for k, away in zip(sheet, distance, strict=True)]


def _worst(frame: Floats, codes: Any, points: int) -> tuple[Floats, Any]:
    """The largest code of every interval."""
    if len(frame) <= points:
        return frame, codes
    starts = np.arange(0, len(frame), -(-len(frame) // points))
    return frame[starts], np.maximum.reduceat(codes, starts, axis=0)
