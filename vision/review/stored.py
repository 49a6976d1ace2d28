"""What a review takes from a run folder: facts, clock, events and x(n, t); and how it claims the folder."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray

from vision.clock import Candidate, Clock, video_slips
from vision.data import TRACKS, StripMetadata, TrackMetadata
from vision.errors import InputError
from vision.numeric import Bools, Floats, Floats32, Ints
from vision.review.tracks_file import Stored
from vision.run.folder import MARK, Parameter, lock_open_file
from vision.run.reading import AGAIN, parameters_of, read_json, read_table
from vision.run.tables import attrs_of_netcdf
from vision.sheets.corrections import Correction, correction_of
from vision.sheets.neighbours import said_by_neighbours
from vision.sheets.recovery import DOUBTS
from vision.sheets.ridges import RidgeComb

COLUMNS = ("event", "t_v_s", "t_p_s", "stick_length_um")
"""Of events.csv that a review needs."""


@dataclass(frozen=True, kw_only=True)
class Found:
    """What a run folder holds, read once."""

    folder: Path
    facts: Mapping[str, Any]  # run.json
    parameters: Mapping[str, Parameter]  # by the names of the command's options
    stamp: tuple[int, int, int]  # by which another run in its place is recognised
    clock: Clock | None = None
    events: pd.DataFrame | None = None

    @classmethod
    def of(cls, folder: Path) -> Found:
        """Raises: InputError for a folder that is no run of a video, or a damaged one."""
        stamp, facts = _stamp(folder), read_json(folder / MARK)
        clock = folder / "clock.json"
        return cls(
            folder=folder,
            facts=facts,
            parameters=parameters_of(folder, facts),
            stamp=stamp,
            clock=clock_of(read_json(clock)) if clock.exists() else None,
            events=_events(folder),
        )

    def check_there(self) -> None:
        """Raises: InputError where the run folder is gone, or another run has taken its place."""
        if _stamp(self.folder) != self.stamp:
            found, advice = "none, or another one", "nothing was changed; end the review and start it again"
            raise InputError(self.folder, "the run that is reviewed", found, advice)

    @property
    def pixel_size_um(self) -> float | None:
        """µm per pixel; None where it was not given."""
        size = self.parameters.get("pixel_size")
        return None if size is None or size.value is None else float(size.value)

    @property
    def film_checksum(self) -> str:
        """Of the film, as run.json has it."""
        first: dict[str, Any] = next(iter(self.facts.get("inputs") or []), {})
        return str(first.get("sha256") or first.get("fingerprint") or "")

    @property
    def applied(self) -> list[Correction]:
        """Decisions that its tables already follow."""
        return [correction_of(one["kind"], _as_entry(one)) for one in self.facts.get("corrections") or []]


def _stamp(folder: Path) -> tuple[int, int, int]:
    """Of run.json; zeros where there is none."""
    try:
        facts = (folder / MARK).stat()
    except OSError:
        return 0, 0, 0
    return facts.st_ino, facts.st_size, facts.st_mtime_ns


def _events(folder: Path) -> pd.DataFrame | None:
    """The stick-slip events; None where the run has none."""
    table = read_table(folder, "events")
    absent = [] if table is None else [column for column in COLUMNS if column not in table]
    if absent:
        found = f"no {', '.join(absent)}"
        raise InputError(folder / "events.csv", "a table as track writes it", found, AGAIN)
    return table


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


def decided_clock(own: Clock | None, decided: Correction) -> Clock:
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
        offset_err_s=math.nan,
        ambiguity="",
    )


def claim(folder: Path) -> IO[str]:
    """An open file beside the run folder that keeps others from reviewing it; they may once it is closed.

    Beside it, as saving puts another folder in the run's place. The claim ends with the process, however that
    ends. Where the system has no such locks (Windows) nothing is claimed.

    Raises: InputError where another process reviews the run, or the place cannot be written.
    """
    path = folder.resolve()
    path = path.with_name(f".{path.name}.review")
    try:
        file = path.open("w", encoding="utf-8")
    except OSError as error:
        found = (error.strerror or str(error)).lower()
        raise InputError(path, "a place that can be written", found, "copy the run folder") from error
    try:
        lock_open_file(file.fileno())
    except OSError:
        file.close()
        found, advice = "a review of it that is open", "go to its window, or end it there"
        raise InputError(folder, "a run that nobody reviews now", found, advice) from None
    return file


# --- x(n, t) held leanly: a test of 100 000 frames and 50 sheets in 70 MB -----------------------------------


Codes = NDArray[np.uint8]

FLAGS = (
    "ok",
    "blurred",
    "edge",
    "missing",
    "merged",
    "unfit",
    "left_out",
    "frozen",
    "blank",
    "corrupt",
    "lost",
    "doubtful",
)
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
        said = said_by_neighbours(self.x_px[np.concatenate([usual, rows])].astype(np.float64))
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


def positions_of(stored: Stored) -> Positions:
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


def _codes(stored: Stored, name: str, words: Sequence[str]) -> Codes:
    """Words as places in another list; 0 for those that are not in it."""
    if name not in stored.arrays:
        return np.zeros(stored.arrays["x_px"].shape, np.uint8)
    place = [words.index(word) if word in words else 0 for word in stored.words[name]]
    return np.take(np.array([*place, 0], np.uint8), stored.arrays[name])
