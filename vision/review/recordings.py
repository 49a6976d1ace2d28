"""Read a run for a review: its folder, tiles of I(x, t), single frames of the film, and the force.

I(x, t) is read from kymograph.tif in parts. Its tiles, from the whole test down to single pixels, show every
slip and every thin ridge.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from vision.clock import Clock
from vision.errors import InputError
from vision.files import AGAIN, Stamp
from vision.folder import RUN_JSON
from vision.locks import POSIX
from vision.memory import row_parts
from vision.numeric import Floats, Floats32, Pixels, spread_indices
from vision.pipeline import Settings, open_force, open_recording
from vision.run.provenance import checksum_of
from vision.run.reading import RunFolder, read_json
from vision.run.tables import stored_kymograph
from vision.sheets.corrections import Correction
from vision.sheets.settings import TrackingSettings
from vision.signals import minmax_decimate
from vision.spacetime import grey_levels, grey_limits
from vision.video import Video

if TYPE_CHECKING:
    from vision.video.encoded import EncodedReader

# --- the folder ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class StoredRun(RunFolder):
    """The run folder that is reviewed."""

    stamp: Stamp  # of run.json, to notice that another run has replaced this one

    @classmethod
    def of(cls, folder: Path) -> StoredRun:
        """Open a run folder.  Raises: InputError if its run.json is damaged."""
        return cls(folder, read_json(folder / RUN_JSON), Stamp.of(folder / RUN_JSON))

    def check_there(self) -> None:
        """Check that the folder still holds this run.  Raises: InputError if not."""
        if self.stamp.change(self.folder / RUN_JSON):
            found, advice = "none, or another one", "nothing was changed; end the review and start it again"
            raise InputError(self.folder, "the run that is reviewed", found, advice)

    @property
    def film_checksum(self) -> str:
        """Checksum or fingerprint of the film in run.json."""
        return checksum_of(next(iter(self.facts.get("inputs") or []), {}))


def decided_clock(earlier: Clock | None, decision: Correction) -> Clock:
    """Return the clock of a decision. Its counts of slips remain the earlier ones until the run is saved."""
    kept = ("residual_ms", "matched", "unmatched_video", "unmatched_force", "margin", "candidates")
    known: dict[str, Any] = {"unmatched_video": 0, "unmatched_force": 0}
    known |= {name: getattr(earlier, name) for name in (*kept, "warnings")} if earlier else {}
    offset_s, drift_ppm = decision.offset_s or 0.0, decision.drift_ppm
    return Clock(offset_s=offset_s, drift_ppm=drift_ppm, status="given", how="given", **known)


# --- I(x, t) ------------------------------------------------------------------------------------------------

Grey = NDArray[np.uint8]


class Diagram:
    """I(x, t) of kymograph.tif. It is read in parts, not mapped, so only the part in use takes memory.

    first_column: column of the picture at which the diagram begins.  settings: those of the tracking, with
    which ridges are found again.  Raises: InputError if the file is missing or damaged.
    """

    def __init__(self, path: Path, first_column: int, settings: TrackingSettings) -> None:
        self.path, self.first_column, self.settings = path, first_column, settings
        self._offset, self._dtype, (self.frames, self.columns) = stored_kymograph(path)
        # It remains open, because saving replaces it; Windows does not replace what is open.
        self._file = path.open("rb") if POSIX else None
        self._lock = Lock()
        self.shared_rows = lru_cache(4)(self.rows)  # parts that neighbouring tiles share, up to 8 MB each

    def rows(self, start: int, stop: int) -> Floats32:
        """Return frames in grey levels, (frame, x); lost frames are NaN."""
        values = np.empty((max(0, min(stop, self.frames) - start), self.columns), self._dtype)
        with self._lock, nullcontext(self._file) if self._file else self.path.open("rb") as file:
            file.seek(self._offset + start * self.columns * self._dtype.itemsize)
            done = file.readinto(values.reshape(-1).view(np.uint8).data)
        if done < values.nbytes:
            raise InputError(self.path, f"{self.frames} frames", "a file that was cut short", AGAIN)
        return np.asarray(values, np.float32)

    def close(self) -> None:
        """Close the file."""
        if self._file:
            self._file.close()

    def sample(self, count: int) -> Floats32:
        """Return frames spread over the run."""
        rows = spread_indices(self.frames, count).tolist()
        return np.concatenate([self.rows(row, row + 1) for row in rows])


TILE_ROWS, TILE_COLUMNS = 256, 512
"""Wider tiles need fewer requests, but panning waits longer; one of this size takes 3 ms."""
TILE_FACTOR = 4
"""Rows of a level that become one row of the next. 2 would double the memory and the work of the first view;
with 8 the page shrinks pictures so much that single frames fade."""
FIRST_KEPT = 2
"""Finest level held in memory. Level 1 would need half the size of the recording's 8-bit diagram, and is as
fast to compute from the file: 2 MB per tile."""


class Tiles:
    """Image pyramid of one space-time diagram.

    A row of level l represents ``TILE_FACTOR**l`` frames; columns are never merged. Level 0 is the recording
    itself. A coarse row shows each column's largest value in its frames (the smallest if ridges are dark), so
    that a ridge that appears in a single frame remains visible.
    """

    def __init__(self, diagram: Diagram, *, bright: bool) -> None:
        self.diagram, self.bright = diagram, bright
        self.low, self.high = grey_limits(diagram.sample(512))
        self._kept = self._coarse_levels()

    @property
    def levels(self) -> int:
        """Number of levels; the last one fits into one tile's rows."""
        frames, levels = self.diagram.frames, 1
        while frames > TILE_ROWS:
            frames, levels = -(-frames // TILE_FACTOR), levels + 1
        return levels

    def _coarse_levels(self) -> list[Grey]:
        """Return the levels held in memory, from `FIRST_KEPT` on."""
        step, wanted = TILE_FACTOR**FIRST_KEPT, self.levels - FIRST_KEPT
        if wanted <= 0:
            return []
        columns, groups = self.diagram.columns, -(-self.diagram.frames // step)
        # 4 MB are read at a time, and whole groups of rows, so that the next level needs no other part
        block = TILE_FACTOR * max(1, (1 << 20) // (TILE_FACTOR * step * columns))
        kept = [np.empty((groups, columns), np.uint8)]
        level = np.empty((-(-groups // TILE_FACTOR), columns), np.float32)
        for rows in row_parts(groups, block):
            part = _extremes(self.diagram.rows(rows.start * step, rows.stop * step), step, bright=self.bright)
            kept[0][rows] = grey_levels(part, self.low, self.high)
            next_rows = slice(rows.start // TILE_FACTOR, -(-rows.stop // TILE_FACTOR))
            level[next_rows] = _extremes(part, TILE_FACTOR, bright=self.bright)
        while len(kept) < wanted:
            kept.append(grey_levels(level, self.low, self.high))
            level = _extremes(level, TILE_FACTOR, bright=self.bright)
        return kept

    def part(self, level: int, x: int, y: int) -> Grey:
        """Return one tile in 8 bits; those at the right and lower edge are smaller.

        Raises: InputError if there is no such tile.
        """
        rows, columns = TILE_ROWS, TILE_COLUMNS
        step = TILE_FACTOR**level if 0 <= level < self.levels else 0
        height = -(-self.diagram.frames // step) if step else 0
        if not (0 <= y * rows < height and 0 <= x * columns < self.diagram.columns):
            raise InputError("the tile", f"one of {self.levels} levels", f"{level}/{x}/{y}")
        across = slice(x * columns, (x + 1) * columns)
        if level >= FIRST_KEPT:
            return self._kept[level - FIRST_KEPT][y * rows : (y + 1) * rows, across]
        part = self.diagram.shared_rows(y * rows * step, (y + 1) * rows * step)[:, across]
        shown = part if level == 0 else _extremes(part, step, bright=self.bright)
        return grey_levels(shown, self.low, self.high)


def _extremes(values: Floats32, step: int, *, bright: bool) -> Floats32:
    """Return the largest (or smallest) of every `step` rows, ignoring NaN; the last group may be shorter."""
    pick = np.fmax if bright else np.fmin
    full = len(values) // step * step
    out = pick.reduce(values[:full].reshape(-1, step, values.shape[1]), axis=1)
    if full < len(values):
        out = np.concatenate([out, pick.reduce(values[full:], axis=0)[None]])
    return np.asarray(out, np.float32)


# --- film and force -----------------------------------------------------------------------------------------


class Film:
    """Random access to a recording, opened as the run read it.

    Uncompressed films, stacks and single images are read directly. A compressed film is decoded from the key
    frame before the requested time, or from the frame shown last when playing forward.
    """

    def __init__(self, video: Video) -> None:
        self._video, self.shape = video, video.shape  # (rows, columns) after rotation
        self._lock = Lock()
        self._frames: Iterator[tuple[float, Pixels]] = iter(())
        self._shown_s = np.inf
        self._ahead: tuple[float, Pixels] | None = None

    def picture(self, number: int, time_s: float) -> Pixels | None:
        """Return one frame with the run's rotation; None if it cannot be read.

        time_s: on the camera's clock; it is used only if it comes from the file's own time stamps.
        """
        with self._lock:
            reader: Any = self._video.reader
            if hasattr(reader, "from_key_frame"):  # an `EncodedReader`; importing it would load FFmpeg
                found = self._near(reader, self._time_in_file(reader, number, time_s))
                if found is not None:
                    return np.rot90(found, k=-(self._video.turned_deg // 90))
            # by number: fast if the film is read directly, else the film is decoded from the beginning
            block = next(replace(self._video, first=number, stop=number + 1).blocks(), None)
            return None if block is None or not block.status or block.status[0] != "ok" else block.pixels[0]

    def _time_in_file(self, reader: EncodedReader, number: int, time_s: float) -> float:
        """Return the frame's time by the file's time stamps or rate; NaN if neither is known."""
        if reader.facts.times_in_blocks:
            return time_s if self._video.clock.kind == "file" else np.nan
        return number / reader.facts.playback_fps if reader.facts.playback_fps else np.nan

    def _near(self, reader: EncodedReader, time_s: float) -> Pixels | None:
        """Return the frame within half an interval of this time; None if there is none or the time is NaN."""
        if np.isnan(time_s):
            return None
        reach_s = 0.5 / (reader.facts.playback_fps or 1.0)
        # Frames up to a second ahead are decoded one after the other; for a longer jump the decoder seeks.
        # Two seconds make jumps slower, half a second seeks at each longer step.
        if not self._shown_s < time_s <= self._shown_s + 1.0:
            self._frames, self._ahead = reader.from_key_frame(time_s), None
        while True:
            entry = self._ahead or next(self._frames, None)
            self._ahead = None
            if entry is None:
                self._shown_s = np.inf
                return None
            self._shown_s = entry[0]
            if entry[0] > time_s + reach_s:
                self._ahead = entry
                return None
            if entry[0] >= time_s - reach_s:
                return entry[1]


class Recordings:
    """Film and force of a run, each opened when first needed; `moved` is the film's new path, if any."""

    def __init__(self, stored: StoredRun, settings: Settings, moved: Path | None) -> None:
        self.stored, self.settings, self.moved = stored, settings, moved
        self._lock = Lock()
        self._film: Film | InputError | None = None
        self._force: xr.Dataset | None = None
        self._grey: tuple[float, float] | None = None

    def film(self) -> Film:
        """Open the film, once: a disk that does not answer delays one request, not all.

        Raises: InputError if it is missing or another one.
        """
        with self._lock:
            if self._film is None:
                try:
                    path = self.stored.input("film", self.moved)
                    self._film = Film(open_recording(path, self.settings))
                except InputError as error:
                    self._film = error
            if isinstance(self._film, InputError):
                raise self._film
            return self._film

    def picture(self, frame: int, time_s: float) -> Grey:
        """Return one frame in 8 bits, with the same grey scale for all frames."""
        pixels = self.film().picture(frame, time_s)
        if pixels is None:
            raise InputError("the frame", "one that can be read", f"{frame}, which cannot")
        values = np.asarray(pixels, np.float32)
        if self._grey is None:
            self._grey = grey_limits(values)
        return grey_levels(values, *self._grey)

    def force(self, first_s: float, stop_s: float, points: int) -> Floats:
        """Return seconds on the force clock, load and separation, (rows, 3); extremes if rows exceed points.

        Raises: InputError if there is no force recording.
        """
        with self._lock:
            if self._force is None:
                path = self.stored.input("force")
                self._force = open_force(path, self.settings)[["load_N", "d_mm"]]
        time_s = self._force["time_s"].to_numpy()
        a, b = np.searchsorted(time_s, [first_s, stop_s])
        values = np.column_stack([self._force[name].to_numpy()[a:b] for name in ("load_N", "d_mm")])
        at, low_high = minmax_decimate(time_s[a:b], values, most=points)
        return np.column_stack([at, low_high])
