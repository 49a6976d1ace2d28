"""A run under review: the data that the page shows, and the decisions about it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from pathlib import Path
from threading import RLock
from typing import Any, Self

import numpy as np

from vision.clock import Clock
from vision.errors import InputError
from vision.files import AGAIN, reading
from vision.folder import plain, whole_file
from vision.locks import claim
from vision.memory import give_back_freed
from vision.numeric import Floats, Floats32, Ints, nearest, stretches
from vision.pipeline import Settings
from vision.review.effects import SAME_RIDGE_PX, Effects, apply, median_positions, read_positions
from vision.review.recordings import (
    TILE_COLUMNS,
    TILE_FACTOR,
    TILE_ROWS,
    Diagram,
    Grey,
    Recordings,
    StoredRun,
    Tiles,
    decided_clock,
)
from vision.review.saving import SaveJob, Saver, Trial
from vision.run.reading import first_column
from vision.run.writing import CORRECTIONS
from vision.sheets.corrections import (
    KEYS,
    OPTIONAL,
    Correction,
    Decisions,
    correction_of,
    corrections_text,
    decision_texts,
    last_of,
    read_decisions,
    sheet_names,
)
from vision.sheets.identities import DOUBTS, WHYS
from vision.sheets.numbering import placed
from vision.sheets.recovery import FLAG_MEANINGS, FLAGS, LONG_GAP, WITHOUT_RIDGE
from vision.sheets.ridges import find_ridges
from vision.signals import minmax_decimate


class Session:
    """A run, its decisions, and the positions that follow from them.

    Every decision is written to corrections.toml before the call that makes it returns. The run's tables
    change when it is saved.

    settings: those of the run; its corrections are read from the folder.  film: its path, if it has been
    moved since it was tracked.  options: the command-line option that the report shows in place of each
    argument's name.
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
        self.saver, self.effects, self.trial = Saver(), Effects(self), Trial(self)
        self.lock = RLock()
        self.revision = 0
        path, taken = folder.resolve(), "a review of it that is open"
        advice = "go to its window, or end it there"
        busy = InputError(folder, "a run that nobody reviews now", taken, advice)
        # beside the folder, because saving replaces the folder
        self._claim = claim(path.with_name(f".{path.name}.review"), busy, "copy the run folder")
        self.trial.sweep()  # remove what a killed review left
        self._slips_at_revision = lru_cache(1)(
            lambda revision: np.unique(self._frames_at(self.positions.slips_s()))
        )
        try:
            with reading(folder, "a run folder as track writes it", AGAIN):
                self._load()
                self.revision = 0  # stored answers to a page's first requests have revision 0
                self.recordings = Recordings(self.stored, settings, film)
        except BaseException:
            self._claim.release()
            raise

    def _load(self) -> None:
        """Read the folder, then apply the decisions that are not in its tables yet."""
        self.stored = StoredRun.of(self.folder)
        self.events, self.saved_clock = self.stored.events, self.stored.clock
        ridges = self.stored.facts.get("found", {}).get("ridges", {}).get("polarity", "bright")
        first, tracking = first_column(self.stored), self.settings.tuning.tracking
        self.diagram = Diagram(self.folder / "kymograph.tif", first, tracking)
        try:
            self.positions = read_positions(self.folder / "tracks.nc")
            give_back_freed()
            self.tiles = Tiles(self.diagram, bright=ridges == "bright")
            give_back_freed()
            if len(self.positions.frame) != self.diagram.frames:
                frames = f"{len(self.positions.frame)} rows, one per frame of tracks.nc"
                raise InputError(self.diagram.path, frames, f"{self.diagram.frames}", AGAIN)
            self._load_decisions()
        except BaseException:
            self.diagram.close()
            raise

    def _load_decisions(self) -> None:
        """Read the decisions and bring the positions, in which the saved ones are applied, up to date."""
        self.applied = self.stored.applied
        path = self.folder / CORRECTIONS
        wanted = read_decisions(path) if path.exists() else Decisions(corrections=tuple(self.applied))
        self.undone = list(wanted.undone)
        same = _common_start(self.applied, wanted.corrections)
        self.decisions = list(wanted.corrections[:same])
        # Undone decisions that remain visible until the run is saved, as they are in its tables.
        self.unseen = self.applied[same:][::-1]
        for decision in wanted.corrections[same:]:
            self._apply(decision)

    def _apply(self, decision: Correction) -> None:
        self.positions = apply(self.positions, decision, self.diagram)
        self.decisions.append(decision)
        self.revision += 1

    def _step_back(self) -> Correction:
        """Remove the last decision; apply the others again to the saved positions.

        Raises: InputError if the run is gone.
        """
        pending, decision = self.pending, self.decisions.pop()
        if pending:
            self.positions = read_positions(self.folder / "tracks.nc")
            for earlier in pending[:-1]:
                self.positions = apply(self.positions, earlier, self.diagram)
        else:
            self.unseen.append(decision)
        self.revision += 1
        return decision

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.trial.discard()
        self.saver.wait()
        self.diagram.close()
        self._claim.release()

    # --- saving ---------------------------------------------------------------------------------------------

    def save(self) -> None:
        """Start to run the affected stages again.  Raises: InputError if that is being done already."""
        with self.lock:
            self.trial.discard()
            self.saver.start(self.job(self.decisions, self.undone), lambda found: self.reload())

    def job(self, decisions: Sequence[Correction], undone: Sequence[Correction]) -> SaveJob:
        """Return the job that applies these decisions to the run.  Raises: InputError if the run is gone."""
        self.stored.check_there()
        return SaveJob(
            folder=self.folder,
            settings=self.settings,
            decisions=self._as_written(decisions, undone),
            film=self.recordings.moved,
            options=self.options,
        )

    def saving(self) -> dict[str, Any]:
        """Return the progress of saving, and whether there is anything to save."""
        return self.saver.progress() | {"changed": self.changed}

    def reload(self) -> None:
        """Read the run that has replaced this one."""
        with self.lock:
            earlier = self.diagram
            self._load()
            earlier.close()
            self.revision += 1

    def check_free(self) -> None:
        """Check that the run is not being tracked or saved, and discard a finished trial.

        Raises: InputError.
        """
        self.saver.check_free()
        self.trial.discard()

    # --- decisions ------------------------------------------------------------------------------------------

    def decide(self, request: Mapping[str, Any]) -> None:
        """Make a decision.  Raises: InputError if it is not valid; nothing is changed then."""
        with self.lock:
            self.check_free()
            if any(one.kind in ("add", "delete") for one in self.unseen):
                found = "numbers that change when the run is saved"
                raise InputError("the decision", "sheets that are numbered as shown", found, "save first")
            self._add(self.decision_of(request, dated=True), [])

    def undo(self) -> None:
        """Undo the last decision.  Raises: InputError if there is none."""
        with self.lock:
            self.check_free()
            if not self.decisions:
                raise InputError("undo", "a decision to undo", "none")
            self._write(self.decisions[:-1], [*self.undone, self.decisions[-1]])
            self.undone.append(self._step_back())

    def redo(self) -> None:
        """Redo the decision that was undone last.  Raises: InputError if there is none."""
        with self.lock:
            self.check_free()
            if not self.undone:
                raise InputError("redo", "a decision that was undone", "none")
            again, rest = self.undone[-1], self.undone[:-1]
            if not (self.unseen and self.unseen[-1].what == again.what):
                self._add(again, rest)
                return
            # the positions still show this decision, since it could not be undone in them
            self._write([*self.decisions, again], rest)
            self.unseen.pop()
            self.decisions.append(again)
            self.undone = rest
            self.revision += 1

    def _add(self, decision: Correction, undone: list[Correction]) -> None:
        """Apply a decision and write it; a decision that cannot be written is not applied."""
        self.stored.check_there()
        self._apply(decision)
        try:
            self._write(self.decisions, undone)
        except InputError:
            self._step_back()
            raise
        self.undone = undone

    @property
    def pending(self) -> list[Correction]:
        """Decisions that are not in the run's tables yet."""
        return self.decisions[_common_start(self.applied, self.decisions) :]

    @property
    def changed(self) -> bool:
        """Whether saving would change the run."""
        return len(self.decisions) != len(self.applied) or bool(self.pending)

    def decision_of(self, request: Mapping[str, Any], *, dated: bool = False) -> Correction:
        """Read a decision from a page's request.  Raises: InputError if it is not valid."""
        kind = str(request.get("kind"))
        if kind not in KEYS:
            raise InputError("the decision", f"a kind of {', '.join(KEYS)}", repr(kind))
        allowed = (*KEYS[kind], *OPTIONAL.get(kind, ()))
        entry = {name: value for name, value in request.items() if name in allowed}
        if dated:
            entry["date"] = self._now()
        return correction_of(kind, entry, "the decision")

    def _now(self) -> str:
        """Return the time, but always later than the last decision's: decisions are ordered by date."""
        last = max((one.date for one in self.decisions if one.date), default="")
        now = datetime.now(UTC)
        if last:
            earliest = datetime.fromisoformat(last) + timedelta(milliseconds=1)
            now = max(now, earliest.astimezone(UTC))
        return now.isoformat(timespec="milliseconds")

    def _write(self, decisions: Sequence[Correction], undone: Sequence[Correction]) -> None:
        """Write corrections.toml atomically; it is on the disk when this returns."""
        self.stored.check_there()
        text = corrections_text(self._as_written(decisions, undone))
        with whole_file(self.folder / CORRECTIONS, durable=True) as path:
            path.write_text(text, encoding="utf-8")

    def _as_written(self, decisions: Sequence[Correction], undone: Sequence[Correction]) -> Decisions:
        checksum = self.stored.film_checksum
        return Decisions(corrections=tuple(decisions), undone=tuple(undone), film=checksum)

    # --- data of the page -----------------------------------------------------------------------------------

    def summary(self) -> dict[str, Any]:
        """Return everything that a page needs first, except what grows with the length of the film."""
        with self.lock:
            positions, facts, strip = self.positions, self.positions.track_facts, self.positions.strip_facts
            decision = last_of(self.pending, "strip")
            return {
                "name": self.stored.name,
                "frames": self.diagram.frames,
                "first_frame": int(positions.frame[0]),
                "columns": self.diagram.columns,
                "first_column": self.diagram.first_column,
                "threshold": self.settings.threshold,
                "strip": (decision and decision.rows) or (strip.strip_z0, strip.strip_z1),
                "axis_px": facts.axis_px,
                "pitch_px": facts.pitch_px,
                "ridges": facts.ridges,
                "sheets": self.sheets(),
                "doubts": self.doubts(),
                "sticks": self.sticks(),
                "clock": plain(self.clock),
                "tiles": {
                    "rows": TILE_ROWS,
                    "columns": TILE_COLUMNS,
                    "factor": TILE_FACTOR,
                    "levels": self.tiles.levels,
                },
                **self.state(),
            }

    def state(self) -> dict[str, Any]:
        """Return what changes with each decision."""
        saved, names = len(self.decisions) - len(self.pending), self.names()
        return {
            "revision": self.revision,
            "decisions": [one | {"saved": k < saved} for k, one in enumerate(_listed(self.decisions, names))],
            "undone": _listed(self.undone, names),
            "can_undo": bool(self.decisions),
            "can_redo": bool(self.undone),
            "changed": self.changed,
            "unseen": decision_texts(self.unseen, names),
            "warnings": [str(line) for line in self.stored.facts.get("warnings") or ()],
            "saving": self.saving(),
        }

    def names(self) -> list[str]:
        """Return the names of the sheets for texts about decisions, from the left."""
        return sheet_names(self.positions.side, self.positions.n)

    def sheets(self) -> list[dict[str, Any]]:
        """Return one entry per sheet, from the left."""
        positions, x_px = self.positions, placed(median_positions(self.positions))
        return [
            {"index": k, "side": int(side), "n": int(n), "x_px": float(x_px[k])}
            for k, (side, n) in enumerate(zip(positions.side, positions.n, strict=True))
        ]

    def doubts(self) -> list[dict[str, Any]]:
        """Return the doubtful stretches, then those without a ridge for `LONG_GAP` frames or more, at most
        500, the longest of each first."""
        positions = self.positions
        missing = np.isin(positions.flag, [FLAGS.index(flag) for flag in WITHOUT_RIDGE])
        sheet, first, stop = np.hstack([stretches(positions.doubtful), stretches(missing)])
        gap = missing[first, sheet]
        longest = np.lexsort((first - stop, gap))
        longest = longest[~gap[longest] | (stop - first >= LONG_GAP)[longest]][:500]
        expected = positions.expected_px(first[longest])
        return [
            {
                "sheet": int(sheet[k]),
                "side": int(positions.side[sheet[k]]),
                "n": int(positions.n[sheet[k]]),
                "first": int(positions.frame[first[k]]),
                "stop": int(positions.frame[stop[k] - 1]) + 1,
                "frames": int(stop[k] - first[k]),
                "why": FLAG_MEANINGS[FLAGS[positions.flag[first[k], sheet[k]]]]
                if gap[k]
                else DOUBTS.get(WHYS[positions.why[first[k], sheet[k]]], "identity not certain"),
                "x_withheld_px": float(positions.withheld_px[first[k], sheet[k]]),
                "x_expected_px": float(expected[row, sheet[k]]),
            }
            for row, k in enumerate(longest)
        ]

    @property
    def clock(self) -> Clock | None:
        """The run's clock, or that of a later decision."""
        decision, saved = last_of(self.pending, "clock"), self.saved_clock
        return saved if decision is None else decided_clock(saved, decision)

    def sticks(self, clock: Clock | None = None) -> list[dict[Any, Any]]:
        """Return the stick phases within the film, in frames, by the current clock or another."""
        clock, events = clock or self.clock, self.events
        if clock is None or events is None:
            return []
        start, stop = (clock.to_video_s(events[name].to_numpy(float)) for name in ("t_v_s", "t_p_s"))
        frames = {"first": self._frames_at(start), "stop": self._frames_at(stop) + 1}
        time_s = self.positions.time_s
        inside = (stop > np.nanmin(time_s)) & (start < np.nanmax(time_s))
        return events[["event", "stick_length_um"]].assign(**frames)[inside].to_dict("records")

    def slips(self, clock: Clock | None = None) -> Ints:
        """Return the first frames after the slips of the force or, without a clock, of the sheets."""
        clock, time_s = clock or self.clock, self.positions.time_s
        if clock is None or self.events is None or clock.status == "ambiguous":
            return self.film_slips()
        at = clock.to_video_s(self.events["t_p_s"].to_numpy(float))
        return np.unique(self._frames_at(at[(at > np.nanmin(time_s)) & (at < np.nanmax(time_s))]))

    def film_slips(self) -> Ints:
        """Return the first frames after the outward steps of the sheets."""
        return self._slips_at_revision(self.revision)  # cached, since a long film takes a second

    def _frames_at(self, seconds: Floats) -> Ints:
        """Return the number of the next frame after each time on the camera's clock."""
        time_s = self.positions.time_s
        known = np.flatnonzero(np.isfinite(time_s))
        if not known.size:
            return np.zeros(len(seconds), np.int64)
        row = np.searchsorted(time_s[known], np.nan_to_num(seconds, nan=-np.inf))
        return np.asarray(self.positions.frame[known[np.minimum(row, known.size - 1)]], np.int64)

    def curves(self, first: int, stop: int, points: int) -> Floats32:
        """Return frames and x_px of every sheet, (rows, 1 + sheets); extremes if frames exceed points."""
        with self.lock:
            positions = self.positions
            a, b = np.searchsorted(positions.frame, [first, stop])
            rows = slice(int(a), max(int(b), int(a)))
            frame = positions.frame[rows].astype(np.float64)
            at, values = minmax_decimate(frame, positions.x_px[rows], most=points)
        return np.column_stack([at, values]).astype(np.float32)

    def picture(self, frame: int) -> Grey:
        """Return one frame of the film."""
        return self.recordings.picture(frame, float(self.positions.time_s[self.positions.row_of(frame)]))

    def ridges(self, frame: int) -> dict[str, Any]:
        """Return every ridge found in one frame with the sheet it is assigned to, and every sheet."""
        with self.lock:
            positions = self.positions
            row = positions.row_of(frame)
            profile = positions.profile(self.diagram, slice(row, row + 1))
            seen = find_ridges(profile, positions.comb(self.diagram))  # as the tracking does
            known = np.isfinite(seen.x_px[0])
            x = seen.x_px[0][known].astype(float) + self.diagram.first_column
            owner = _owners(x, positions.x_px[row])
            candidates = [{"x_px": x[k], "sheet": owner[k]} for k in range(len(x))]
            sheets = [
                {
                    "index": k,
                    "flag": FLAGS[positions.flag[row, k]],
                    "why": DOUBTS.get(WHYS[positions.why[row, k]], ""),
                    "x_px": positions.x_px[row, k],
                    "withheld_px": positions.withheld_px[row, k],
                }
                for k in range(positions.sheets)
            ]
        return {"frame": frame, "candidates": candidates, "sheets": sheets}


def _listed(decisions: Sequence[Correction], names: Sequence[str]) -> list[dict[str, Any]]:
    texts = zip(decisions, decision_texts(decisions, names), strict=True)
    return [{"kind": one.kind, "text": text, "date": one.date, "entry": one.entry()} for one, text in texts]


def _common_start(one: Sequence[Correction], other: Sequence[Correction]) -> int:
    """Return how many decisions, from the first on, are the same in both."""
    pairs = enumerate(zip(one, other, strict=False))
    return next((k for k, (a, b) in pairs if a.what != b.what), min(len(one), len(other)))


def _owners(x: Floats, positions: Floats32) -> list[int | None]:
    """Return the index of the sheet nearest to each candidate; None if none is within `SAME_RIDGE_PX`."""
    sheet, distance = nearest(np.broadcast_to(positions.astype(float), (len(x), len(positions))), x)
    return [int(k) if away <= SAME_RIDGE_PX else None for k, away in zip(sheet, distance, strict=True)]
