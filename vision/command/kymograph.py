"""`track kymograph VIDEO_OR_RUN`: space-time diagrams for Fiji and for the page."""

from __future__ import annotations

import time as clock
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter as Option

from vision.command.console import conclude, frame_progress
from vision.command.options import (
    Flag,
    VideoOptions,
    merged,
    parameters_given,
    parse_length,
    parse_pixel_size,
    parse_range,
    parse_seconds,
    parse_sheets,
    settings_of,
)
from vision.command.track import command_line, run_name
from vision.errors import InputError
from vision.files import reading as reading_of

if TYPE_CHECKING:
    import xarray as xr

    from vision.numeric import Floats
    from vision.pipeline import Settings

PAPER_WIDTH_UM = 200.0
MARK = "diagrams"  # of run.json: tells a folder of diagrams from a run
OF_A_RUN = ("columns", "frames", "pixel_size")  # reading options that a finished run takes, too


@Option(name="*")
@dataclass(frozen=True, kw_only=True)
class WindowOptions:
    """What of the strip is shown."""

    sheet: Annotated[tuple[str, ...], Option(negative="")] = ()
    """Window around a sheet: side and number, as right:23, or the index from the left; can be repeated."""
    width: str | None = None
    """Width of the window in mm, um, µm or px; 0.2mm, or one pitch where there is no pixel size."""
    follow: Flag = False
    """The window moves with the sheet, interpolated between pixels, instead of standing still."""
    time: str | None = None
    """Part of the recording in seconds of the video's clock, A:B."""


@dataclass(frozen=True)
class Source:
    """What diagrams are cut from: the strip, the sheets and the times of slips as far as they are known."""

    strip: xr.DataArray
    tracks: xr.Dataset | None
    slips_s: Floats | None
    slips_from: str
    pixel_size_um: float | None
    files: tuple[Path, ...]
    warnings: tuple[str, ...] = ()


def kymograph(
    video_or_run: Path,
    /,
    window: WindowOptions | None = None,
    reading: VideoOptions | None = None,
    *,
    picture: Literal["png", "pdf", "svg"] = "png",
    out: Path | None = None,
    overwrite: Flag = False,
    quiet: Flag = False,
) -> int:
    """Space-time diagrams: the whole strip, or windows around sheets, side by side.

    Writes a 16-bit TIFF for each, which Fiji opens in µm and s, and one picture with axes. Slips are marked:
    those of a run's force recording, else the common outward steps of the sheets.

    Examples:

        track kymograph test_tracks --sheet right:23 --sheet right:10 --width 0.2mm --time 40:45.1

        track kymograph test.avi --frames 0:600

    Parameters
    ----------
    video_or_run
        A run folder, or a video as for track.
    window
        What of the strip is shown.
    reading
        How a video is read; of a run only columns, frames and pixel size can be chosen.
    picture
        Kind of the picture.
    out
        Folder; NAME_kymograph in the working directory by default.
    overwrite
        Replace an earlier one.
    quiet
        No progress bar and no summary.
    """
    started = clock.perf_counter()
    window, reading = window or WindowOptions(), reading or VideoOptions()
    options = _space_time_options(window)
    from vision.figures import kymograph_figure
    from vision.run import Origin, check_mark, check_target, is_run, run_folder, write_json
    from vision.run.tiff import write_space_time_tif

    target = out or Path(f"{run_name(video_or_run)}_kymograph")
    check_target(target, overwrite=overwrite)
    check_mark(target, MARK)
    parameters = merged(reading)
    if is_run(video_or_run):
        with reading_of(video_or_run, "a run folder as track writes it", "run track again"):
            source = _from_run(video_or_run, reading)
        options["frames"] = parse_range(reading.frames, "--frames")
    else:
        wanted = bool(options["sheets"])
        source = _from_video(video_or_run, settings_of(parameters), track=wanted, quiet=quiet)
    diagrams = _diagrams(source, **options)
    warnings = [*source.warnings, *_warnings(diagrams)]
    slips, chosen = _slips_shown(source, diagrams[0]), parameters | parameters_given(vars(window))
    facts = Origin(command=command_line(), inputs=source.files, parameters=chosen).facts()
    facts |= {MARK: [_about(diagram) for diagram in diagrams], "slips": slips, "warnings": warnings}
    names = [f"kymograph_{d.attrs.get('sheet', 'strip').replace(':', '')}.tif" for d in diagrams]
    figure = kymograph_figure(diagrams, slips_s=source.slips_s, slips_from=source.slips_from)
    size = source.pixel_size_um
    with run_folder(target, overwrite=overwrite) as folder:
        for name, diagram in zip(names, diagrams, strict=True):
            write_space_time_tif(diagram, folder / name, pixel_size_um=size)
        figure.save(folder / f"kymograph.{picture}")
        facts["seconds"] = {"total": clock.perf_counter() - started}
        write_json(facts, folder / "run.json")
    rows, columns = diagrams[0].shape
    scale = "" if size is None else f", {size:g} µm per px"
    lines = [
        f"diagrams   {len(diagrams)} of {rows} frames x {columns} px{scale}",
        f"slips      {slips}",
        f"results    {target}/: {', '.join([*names, f'kymograph.{picture}'])}",
    ]
    return conclude(lines, warnings, quiet=quiet)


def _space_time_options(window: WindowOptions) -> dict[str, Any]:
    """Arguments of `space_time` but for the strip.  Raises: InputError, before anything is read."""
    sheets = parse_sheets(window.sheet)
    for option, given in (("--width", window.width), ("--follow", window.follow)):
        if given and not sheets:
            raise InputError(option, "a sheet for the window", "none", "give --sheet right:1, for example")
    return {
        "sheets": sheets,
        "width": parse_length(window.width, "--width") if window.width else {},
        "follow": window.follow,
        "time_s": parse_seconds(window.time, "--time"),
    }


def _from_run(folder: Path, reading: VideoOptions) -> Source:
    """A run's kymograph.tif, tracks and slips; a pixel size given now goes before the run's own.

    Raises
    ------
    InputError
        For options that only a video takes, for columns that the run does not have, and for a damaged run.
    """
    from vision.figures import slip_times
    from vision.run import read_run, read_strip, slip_times_s

    given = [name for name, value in vars(reading).items() if value is not None and name not in OF_A_RUN]
    if given:
        found = ", ".join(f"--{name}" for name in given)
        raise InputError(folder, "options that a run takes", found, "give the video, or run track again")
    run = read_run(folder)
    strip = read_strip(run)
    columns, size = parse_range(reading.columns, "--columns"), parse_pixel_size(reading.pixel_size)
    files = ("kymograph.tif", "tracks.nc", "events.csv", "clock.json")
    slips_s, slips_from = slip_times(run.tracks, slip_times_s(run))
    return Source(
        strip=strip if columns is None else _cut(strip, columns, folder),
        tracks=run.tracks,
        slips_s=slips_s,
        slips_from=slips_from,
        pixel_size_um=run.pixel_size_um if size is None else size,
        files=tuple(folder / name for name in files if (folder / name).exists()),
    )


def _cut(strip: xr.DataArray, columns: slice, folder: Path) -> xr.DataArray:
    x = strip["x"].values
    keep = (x >= (columns.start or 0)) & (x < (x[-1] + 1 if columns.stop is None else columns.stop))
    if not keep.any():
        found = f"{columns.start}:{columns.stop}"
        raise InputError(f"{folder}: --columns", f"a part of {x[0]}:{x[-1] + 1}", found)
    first = int(keep.argmax())
    return strip.isel(x=slice(first, first + int(keep.sum())))


def _from_video(path: Path, settings: Settings, *, track: bool, quiet: bool) -> Source:
    """A video's strip, and its sheets where windows around them are wanted."""
    from vision.data import warnings_of
    from vision.figures import slip_times
    from vision.pipeline import analyse, open_recording
    from vision.video import strip_profile

    with frame_progress("reading", quiet=quiet) as progress:
        if track or settings.pitch_um is not None:
            analysis = analyse(path, None, settings, progress=progress)
            strip, tracks, warnings = analysis.strip, analysis.tracks, analysis.warnings
            settings = analysis.settings
        else:
            video = open_recording(path, settings)
            strip = strip_profile(video, settings.rows, columns=settings.columns, progress=progress)
            tracks, warnings = None, tuple(warnings_of(strip))
    given = () if settings.timestamps is None else (settings.timestamps,)
    assert strip is not None
    return Source(strip, tracks, *slip_times(tracks), settings.pixel_size_um, (path, *given), warnings)


def _diagrams(
    source: Source, *, sheets: list[Any], width: dict[str, Any], follow: bool, **part: Any
) -> list[xr.DataArray]:
    """One per sheet; of the whole strip where no sheet is asked for."""
    from vision.data import TrackMetadata
    from vision.spacetime import space_time

    size = source.pixel_size_um
    if not sheets or source.tracks is None:
        return [space_time(source.strip, pixel_size_um=size, **part)]
    pitch = min(TrackMetadata.of(source.tracks).pitch_px, float(source.strip.sizes["x"]))
    width = width or ({"width_px": pitch} if size is None else {"width_um": PAPER_WIDTH_UM})
    window: dict[str, Any] = {"around": source.tracks, "follow": follow, "pixel_size_um": size}
    cut = [space_time(source.strip, sheet=sheet, **window, **width, **part) for sheet in sheets]
    return list({diagram.attrs["sheet"]: diagram for diagram in cut}.values())  # each sheet once


def _warnings(diagrams: list[xr.DataArray]) -> list[str]:
    """What makes the TIFF's even time axis, or a sheet's window, misleading."""
    from vision.run.tiff import unevenness_s

    off = unevenness_s(diagrams[0]["time_s"].values)
    lines = [f"frame times are uneven: the TIFF's time axis is off by up to {off:.3g} s"] if off else []
    there = diagrams[0]["status"] == "ok"
    if empty := int((~there).sum()):
        lines.append(f"{empty} of {there.size} frames shown are empty")
    for diagram in diagrams:
        if "sheet" in diagram.attrs and (gone := int((diagram["x_sheet_px"].isnull() & there).sum())):
            name = diagram.attrs["sheet"]
            lines.append(f"sheet {name}: not found in {gone} of {there.size} frames shown")
    return lines


def _about(diagram: xr.DataArray) -> dict[str, Any]:
    """What one diagram shows."""
    from vision.run.tiff import frame_step_s

    names = ("sheet", "sheet_index", "centre_px", "follow", "pixel_size_um")
    frame, x = diagram["frame"].values, diagram["x"].values
    return {
        "frames": [frame[0], frame[-1]],
        "columns": [x[0], x[-1]],
        "s_per_row": frame_step_s(diagram["time_s"].values),
        **{name: diagram.attrs[name] for name in names if name in diagram.attrs},
    }


def _slips_shown(source: Source, diagram: xr.DataArray) -> str:
    """How many slips are marked and what they were taken from, or why none is."""
    from vision.run.tiff import frame_step_s

    if source.slips_s is None:
        return "not known: without a force they take tracked sheets and a symmetry axis"
    times = diagram["time_s"].values
    half = frame_step_s(times) / 2
    seen = (source.slips_s >= times[0] - half) & (source.slips_s <= times[-1] + half)
    return f"{seen.sum()} in the part shown, from {source.slips_from}"
