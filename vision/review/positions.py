"""x(n, t) held leanly: a test of 100 000 frames and 50 sheets in 70 MB, flags as codes in place of words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from vision.clock import video_slips
from vision.data import TRACKS, StripMetadata, TrackMetadata
from vision.errors import InputError
from vision.numeric import Bools, Floats, Floats32, Ints
from vision.review.tracks_file import Stored, read_tracks
from vision.run.tables import attrs_of_netcdf
from vision.sheets.neighbours import said_by_neighbours
from vision.sheets.recovery import DOUBTS
from vision.sheets.ridges import RidgeComb

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
    """Every sheet in every frame.

    Parameters
    ----------
    frame, time_s
        Numbers in the film, and seconds of the camera's clock, (frame,).
    x_px, err_px
        Position and standard error, (frame, sheet); NaN where there is none. In single precision, 1e-4 px,
        which is enough to look at; saving does not use them.
    withheld_px
        The doubted ridge, (frame, sheet).
    flag, why
        Places in `FLAGS` and `WHYS`, (frame, sheet).
    side, n
        As numbered from the axis, (sheet,).
    attrs
        Of the tracks: how they were found.
    first_row
        Of the run, at which a part of it begins.
    """

    frame: Ints
    time_s: Floats
    x_px: Floats32
    err_px: Floats32
    withheld_px: Floats32
    flag: Codes
    why: Codes
    side: Ints
    n: Ints
    attrs: Mapping[str, Any]
    first_row: int = 0

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
        }
        variables = {name: (TRACKS[name].dims, data, TRACKS[name].attrs) for name, data in values.items()}
        coords = {
            "frame": self.frame[rows],
            "sheet": np.arange(self.sheets),
            "time_s": ("frame", self.time_s[rows], TRACKS["time_s"].attrs),
            "side": ("sheet", self.side, TRACKS["side"].attrs),
            "n": ("sheet", self.n, TRACKS["n"].attrs),
        }
        return xr.Dataset(variables, coords, dict(self.attrs))

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


def read_positions(path: Path, rows: slice = slice(None)) -> Positions:
    """Of a tracks.nc, or of some of its frames.

    Raises
    ------
    InputError
        For a file that is not there, damaged, or no tracks.
    """
    return positions_of(read_tracks(path, rows))


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
