"""`track VIDEO`: from the file to x(n,t)."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter as Option

from vision.command.finish import Run, report, write
from vision.command.options import choice, merge, number, parse_range
from vision.command.progress import frame_progress
from vision.command.pull import analyse, read_recording
from vision.errors import InputError
from vision.run.provenance import Parameter

SWITCH = Option(negative="", show_default=False)
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
    "force": None,
    "speed": None,
    "d0": None,
    "force_columns": None,
    "force_threshold": None,
    "force_lowpass": None,
    "offset": None,
    "threshold": 0.1,
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
    force: Path | None = None,
    speed: float | None = None,
    d0: float | None = None,
    force_columns: str | None = None,
    force_threshold: float | None = None,
    force_lowpass: float | None = None,
    offset: float | None = None,
    threshold: float | None = None,
    config: Path | None = None,
    out: Path | None = None,
    overwrite: Annotated[bool, SWITCH] = False,
    quiet: Annotated[bool, SWITCH] = False,
    verbose: Annotated[bool, SWITCH] = False,
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
    force
        Force recording of the testing machine; adds events, clocks, σ_x/Λ_st and shells.
    speed
        Pulling speed V in mm/min, where no displacement is recorded.
    d0
        Initial separation in mm, added to the crosshead.
    force_columns
        Columns of the recording, as in time=Time,load=Load:kN,displacement=3.
    force_threshold
        Smallest drop that is a slip, N; found from the noise if not given.
    force_lowpass
        Time constant of the force chain's filter, s, which is undone; found from the slips if not given, 0
        for none.
    offset
        Force clock at video time 0, s, if known (0 with a common hardware trigger); found from the slips if
        not given.
    threshold
        σ_x/Λ_st below which a sheet is stiff.
    config
        TOML file with any of these options; the command line wins.
    out
        Run folder; for NAME.avi, NAME_tracks in the working directory by default.
    overwrite
        Replace an earlier run folder.
    quiet
        No progress bar and no summary.
    verbose
        All of run.json's findings in the summary.
    """
    from vision.run.folder import check_target
    from vision.run.provenance import described_meanwhile

    options = merge({name: value for name, value in locals().items() if name in DEFAULTS}, DEFAULTS, config)
    target = out or Path(f"{run_name(video)}_tracks")
    check_target(target, overwrite=overwrite)
    with described_meanwhile(video) as describe:
        run = _measure(video, options, quiet=quiet)
        write(run, target, describe, overwrite=overwrite)
    return report(run, target, quiet=quiet, verbose=verbose)


def run_name(video: Path) -> str:
    """Base name of the run folder: the file's or folder's own; of a pattern what is no wildcard."""
    whole = video.absolute() if video.name else video.resolve()
    if whole.exists():
        return whole.name if whole.is_dir() else whole.stem
    plain = "".join(c for c in whole.stem if c not in '*?[]<>|:"').strip("_-. ")
    return plain or whole.parent.name or "video"


def _measure(video: Path, options: dict[str, Parameter], *, quiet: bool) -> Run:
    """Read, track and, with a force recording, analyse."""
    began = time.perf_counter()
    value = {name: option.value for name, option in options.items()}
    settings = track_settings(value)
    force = read_recording(value)  # before the long work: its columns may not be recognised
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
    _check_width(settings, recording.shape[1])
    with frame_progress("reading", quiet=quiet) as progress:
        profile = strip_profile(recording, rows, columns=columns, progress=progress)
    read = time.perf_counter()
    tracks = track_sheets(profile, **settings)
    tracked = time.perf_counter()
    pull = None if force is None else analyse(force, tracks, value)
    seconds = {"reading": read - started, "tracking": tracked - read, "force": time.perf_counter() - tracked}
    return Run(recording, profile, tracks, options, began, seconds, pull)


def track_settings(value: dict[str, Any]) -> dict[str, Any]:
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


def _check_width(settings: Mapping[str, Any], width: int) -> None:
    """InputError for a length in px that is far beyond a picture of this width."""
    axis, window = settings["axis_px"], settings["window_px"]
    if axis is not None and not -width <= axis <= 2 * width:
        found, advice = f"{axis:g}", "give it in px, counted from the left"
        raise InputError("--axis", f"a column within or near the picture's {width}", found, advice)
    if isinstance(window, int) and window > width:
        raise InputError("--window", f"at most the picture's {width} columns", str(window), "try auto")
