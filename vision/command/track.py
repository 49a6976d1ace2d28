"""`track VIDEO`: from the file to x(n,t)."""

from __future__ import annotations

import shlex
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter as Option

from vision.command.options import choice, merge, number, parse_range
from vision.command.progress import frame_progress
from vision.errors import InputError
from vision.run.provenance import Parameter

if TYPE_CHECKING:
    import xarray as xr

    from vision.video import Video

DEFAULTS: dict[str, Any] = {
    "strip": "auto",
    "columns": None,
    "sheets": None,
    "ridges": "auto",
    "axis": None,
    "fit": "sliding",
    "window": None,
    "pixel_size": None,
    "fps": None,
    "timestamps": None,
    "frames": None,
    "rotate": 0,
}


def track(
    video: Path,
    /,
    *,
    strip: str | None = None,
    columns: str | None = None,
    sheets: int | None = None,
    ridges: Literal["bright", "dark", "auto"] | None = None,
    axis: float | None = None,
    fit: Literal["sliding", "paper", "template"] | None = None,
    window: str | None = None,
    pixel_size: float | None = None,
    fps: float | None = None,
    timestamps: Path | None = None,
    frames: str | None = None,
    rotate: Literal[0, 90, 180, 270] | None = None,
    config: Path | None = None,
    out: Path | None = None,
    overwrite: Annotated[bool, Option(negative="")] = False,
    quiet: Annotated[bool, Option(negative="")] = False,
    verbose: Annotated[bool, Option(negative="")] = False,
) -> int:
    """Track every sheet of a video: positions x(n,t), their errors, pictures and tables in a new folder.

    Parameters
    ----------
    video
        A video file, a TIFF stack, a folder or a quoted glob of numbered images.
    strip
        Rows averaged, Z0:Z1, half-open, from the top; auto finds the rows where ridges are straight and
        clear.
    columns
        Columns looked at, X0:X1.
    sheets
        Number of ridges in view; found if not given.
    ridges
        Polarity: bright, dark or auto.
    axis
        Symmetry axis in px; found from the motion if not given.
    fit
        sliding (default), paper (the publication's, exactly) or template (best for wide ridges).
    window
        Fit window in px, odd, or auto to follow the ridges' width; 9 where they are 6 to 14 px wide.
    pixel_size
        µm per pixel; without it lengths are in px.
    fps
        The camera's frame rate, where the file's own is only a playback rate.
    timestamps
        Text file with the time of every frame.
    frames
        Part of the video, A:B.
    rotate
        Turn each frame clockwise first, for sheets that move along y.
    config
        TOML file with any of these options; the command line wins.
    out
        Run folder; <video name>_tracks in the working directory by default.
    overwrite
        Replace an earlier run folder.
    quiet
        No progress bar and no summary.
    verbose
        All of run.json's findings in the summary.
    """
    from vision.run.folder import check_target

    options = merge({name: value for name, value in locals().items() if name in DEFAULTS}, DEFAULTS, config)
    target = out or Path(f"{_name(video)}_tracks")
    check_target(target, overwrite=overwrite)
    recording, profile, tracks, seconds = _measure(video, options, quiet=quiet)
    _write(target, recording, profile, tracks, options, seconds, overwrite=overwrite)
    return _report(target, profile, tracks, options, quiet=quiet, verbose=verbose)


def _name(video: Path) -> str:
    """Base name of the run folder."""
    name = video.stem if video.suffix else video.name
    return "".join(c for c in name if c not in '*?[]<>|:"') or "video"


def _measure(
    video: Path, options: dict[str, Parameter], *, quiet: bool
) -> tuple[Video, xr.DataArray, xr.Dataset, dict[str, float]]:
    """Read and track; wall-clock seconds of either."""
    value = {name: option.value for name, option in options.items()}
    settings = _track_settings(value)
    started = time.perf_counter()
    from vision.sheets.tracks import track_sheets
    from vision.video import open_video, strip_profile

    recording = open_video(
        video,
        rotate=choice(value["rotate"], "--rotate", (0, 90, 180, 270)),
        frames=parse_range(value["frames"], "--frames"),
        fps=number(value["fps"], "--fps", least=1e-9),
        timestamps=None if value["timestamps"] is None else Path(value["timestamps"]),
    )
    rows, columns = parse_range(value["strip"], "--strip"), parse_range(value["columns"], "--columns")
    with frame_progress("reading", quiet=quiet) as progress:
        profile = strip_profile(recording, rows, columns=columns, progress=progress)
    read = time.perf_counter()
    tracks = track_sheets(profile, **settings)
    return recording, profile, tracks, {"reading": read - started, "tracking": time.perf_counter() - read}


def _track_settings(value: dict[str, Any]) -> dict[str, Any]:
    """Arguments of `track_sheets`; InputError for values no recording could fit."""
    number(value["pixel_size"], "--pixel-size", least=1e-6)
    window = value["window"]
    if window is not None and window != "auto":
        if not str(window).isdigit():
            raise InputError("--window", "an odd number of pixels, or auto", f"'{window}'")
        window = int(window)
    return {
        "ridges": choice(value["ridges"], "--ridges", ("bright", "dark", "auto")),
        "sheets": number(value["sheets"], "--sheets", least=1, whole=True),
        "axis_px": number(value["axis"], "--axis", least=-1e6),
        "fit": choice(value["fit"], "--fit", ("sliding", "paper", "template")),
        "window_px": window,
    }


def _write(
    target: Path,
    recording: Video,
    profile: xr.DataArray,
    tracks: xr.Dataset,
    options: dict[str, Parameter],
    seconds: dict[str, float],
    *,
    overwrite: bool,
) -> None:
    """The run folder, whole."""
    from vision.report.overview import write_kymograph_png, write_overview
    from vision.run.folder import run_folder
    from vision.run.kymograph import write_kymograph_tif
    from vision.run.provenance import write_run_json
    from vision.run.summary import run_facts
    from vision.run.tables import sheets_table, write_tracks_csv, write_tracks_nc
    from vision.video import reference_frame

    started = time.perf_counter()
    size = options["pixel_size"].value
    with run_folder(target, overwrite=overwrite) as folder:
        write_tracks_csv(tracks, folder / "tracks.csv", pixel_size_um=size)
        write_tracks_nc(tracks, folder / "tracks.nc", pixel_size_um=size)
        sheets_table(tracks).to_csv(folder / "sheets.csv", index=False, lineterminator="\n")
        write_kymograph_tif(profile, folder / "kymograph.tif", pixel_size_um=size)
        write_kymograph_png(folder / "kymograph.png", profile, pixel_size_um=size)
        write_overview(
            folder / "overview.png", reference_frame(recording), profile, tracks, pixel_size_um=size
        )
        seconds["writing"] = time.perf_counter() - started
        command = shlex.join(["track", *sys.argv[1:]])
        write_run_json(folder, run_facts(command, recording.path, profile, tracks, options, seconds))


def _report(
    target: Path,
    profile: xr.DataArray,
    tracks: xr.Dataset,
    options: dict[str, Parameter],
    *,
    quiet: bool,
    verbose: bool,
) -> int:
    """Summary to standard output, warnings to standard error; the exit status."""
    from vision.run.summary import findings, summary_lines, warnings_that_matter

    warnings = warnings_that_matter(profile, tracks)
    for line in warnings:
        sys.stderr.write(f"track: warning: {line}\n")
    if not quiet:
        lines = summary_lines(target, profile, tracks, options)
        if verbose:
            lines += [f"{name:>22}  {value}" for name, value in findings(profile, tracks).items()]
        sys.stdout.write("\n".join(lines) + "\n")
    return 1 if warnings else 0
