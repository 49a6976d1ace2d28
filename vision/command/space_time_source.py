"""What space-time diagrams are cut from: a finished run, or a video read and tracked now."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from cyclopts import Parameter as Option

from vision.command.options import number, parse_range
from vision.command.progress import frame_progress
from vision.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    import xarray as xr
    from numpy.typing import NDArray


@Option(name="*")
@dataclass(frozen=True, kw_only=True)
class VideoOptions:
    """How a video is read; a run has been read already."""

    strip: str | None = None
    """Rows averaged, Z0:Z1, half-open; found if not given."""
    sheets: int | None = None
    """Number of ridges in view; found if not given."""
    ridges: Literal["bright", "dark", "auto"] | None = None
    """Polarity; auto if not given."""
    axis: float | None = None
    """Symmetry axis in px; found from the motion if not given."""
    fps: float | None = None
    """The camera's frame rate, where the file's own is only a playback rate."""
    timestamps: Path | None = None
    """Text file with the time of every frame."""
    rotate: Literal[0, 90, 180, 270] | None = None
    """Turn each frame clockwise first."""


@dataclass(frozen=True)
class Slips:
    """Times on the video's clock, and what they were taken from."""

    times_s: NDArray[np.float64]
    how: str


@dataclass(frozen=True)
class Source:
    """strip, I(x, t).  tracks, where sheets are known.  slips, None where not known.  files, what was read.
    warnings, what is wrong with it.
    """

    strip: xr.DataArray
    tracks: xr.Dataset | None
    slips: Slips | None
    pixel_size_um: float | None
    files: tuple[Path, ...]
    warnings: tuple[str, ...]


def from_run(
    folder: Path, reading: VideoOptions | None, *, columns: slice | None, pixel_size_um: float | None
) -> Source:
    """A run's kymograph.tif, tracks and slips; a pixel size given now goes before the run's own.

    Raises: InputError for options that only a video takes, for columns that the run does not have, and for
    a damaged run.
    """
    from vision.run.reading import read_run, read_strip, slip_times_s

    given = [name for name, value in vars(reading or VideoOptions()).items() if value is not None]
    if given:
        found = ", ".join(f"--{name}" for name in given)
        raise InputError(folder, "options that a run takes", found, "give the video, or run track again")
    run = read_run(folder)
    strip = read_strip(run)
    if columns is not None:
        strip = _cut(strip, columns, folder)
    files = ("kymograph.tif", "tracks.nc", "events.csv", "clock.json")
    return Source(
        strip=strip,
        tracks=run.tracks,
        slips=_slips(run.tracks, slip_times_s(run)),
        pixel_size_um=run.pixel_size_um if pixel_size_um is None else pixel_size_um,
        files=tuple(folder / name for name in files if (folder / name).exists()),
        warnings=(),
    )


def _cut(strip: xr.DataArray, columns: slice, folder: Path) -> xr.DataArray:
    x = strip["x"].values
    keep = (x >= (columns.start or 0)) & (x < (x[-1] + 1 if columns.stop is None else columns.stop))
    if not keep.any():
        found = f"{columns.start}:{columns.stop}"
        raise InputError(f"{folder}: --columns", f"a part of {x[0]}:{x[-1] + 1}", found)
    first = int(keep.argmax())
    return strip.isel(x=slice(first, first + int(keep.sum())))


def from_video(
    path: Path,
    reading: VideoOptions,
    *,
    frames: slice | None,
    columns: slice | None,
    pixel_size_um: float | None,
    track: bool,
    quiet: bool,
) -> Source:
    """A video's strip, and its sheets where they are asked for.  Raises: InputError as `track` does."""
    from vision.run.summary import warnings_that_matter
    from vision.sheets.tracks import track_sheets
    from vision.video import open_video, strip_profile

    rows = parse_range(reading.strip, "--strip")
    sheets = number(reading.sheets, "--sheets", least=1, whole=True)
    fps = number(reading.fps, "--fps", least=1e-9)
    recording = open_video(
        path, rotate=reading.rotate or 0, frames=frames, fps=fps, timestamps=reading.timestamps
    )
    with frame_progress("reading", quiet=quiet) as progress:
        strip = strip_profile(recording, rows, columns=columns, progress=progress)
    warnings = [line for line in str(strip.attrs["warnings"]).split("\n") if line]
    tracks = None
    if track:
        tracks = track_sheets(strip, ridges=reading.ridges or "auto", sheets=sheets, axis_px=reading.axis)
        warnings = warnings_that_matter(strip, tracks)
    given = () if reading.timestamps is None else (reading.timestamps,)
    return Source(strip, tracks, _slips(tracks, None), pixel_size_um, (path, *given), tuple(warnings))


def _slips(tracks: xr.Dataset | None, force_s: NDArray[np.float64] | None) -> Slips | None:
    """The force's slips where its clock is sure, else the sheets' common outward steps.

    None where the axis was only guessed from the sheets' places: which way is outward is not known then.
    """
    from vision.clock import video_slips

    if force_s is not None:
        return Slips(force_s, "the force")
    if tracks is None:
        return None
    still = math.isnan(tracks.attrs["axis_low_px"])
    if tracks.attrs["axis_how"] == "geometry" and still:
        return None
    try:
        return Slips(video_slips(tracks)["time_s"].to_numpy(), "the sheets' common steps")
    except InputError:  # too few frames, or none with a time: nothing to mark
        return None
