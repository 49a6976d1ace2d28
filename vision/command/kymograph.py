"""`track kymograph VIDEO_OR_RUN`: space-time diagrams for Fiji and for the page."""

from __future__ import annotations

import shlex
import sys
import time as clock
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter as Option

from vision.command.console import complain, say
from vision.command.options import number, parse_range
from vision.command.quantities import parse_length, parse_seconds, parse_sheets
from vision.command.space_time_source import Source, VideoOptions, from_run, from_video
from vision.errors import InputError

if TYPE_CHECKING:
    import xarray as xr

PAPER_WIDTH_UM = 200.0
MARK = "diagrams"  # of run.json: tells a folder of diagrams from a run


@Option(name="*")
@dataclass(frozen=True, kw_only=True)
class CutOptions:
    """What of the strip is shown."""

    sheet: Annotated[tuple[str, ...], Option(negative="")] = ()
    """Window around a sheet: side and number, as right:23, or the index from the left; can be repeated."""
    width: str | None = None
    """Width of the window in mm, um, µm or px; 0.2mm, or one pitch where there is no pixel size."""
    follow: Annotated[bool, Option(negative="")] = False
    """The window moves with the sheet, interpolated between pixels, instead of standing still."""
    frames: str | None = None
    """Part of the recording, A:B; of a video only these are read."""
    time: str | None = None
    """Part of the recording in seconds of the video's clock, A:B."""
    columns: str | None = None
    """Columns of the video, X0:X1."""
    pixel_size: float | None = None
    """µm per pixel; a run's own if not given."""


def kymograph(
    video_or_run: Path,
    /,
    cut: CutOptions | None = None,
    reading: VideoOptions | None = None,
    *,
    picture: Literal["png", "pdf", "svg"] = "png",
    out: Path | None = None,
    overwrite: Annotated[bool, Option(negative="")] = False,
    quiet: Annotated[bool, Option(negative="")] = False,
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
    cut
        What of the strip is shown.
    reading
        How a video is read.
    picture
        Kind of the picture.
    out
        Folder; NAME_kymograph in the working directory by default.
    overwrite
        Replace an earlier one.
    quiet
        No progress bar and no summary.
    """
    from vision.run.folder import check_target
    from vision.run.reading import check_mark

    started = clock.perf_counter()
    cut = cut or CutOptions()
    wishes = _wishes(cut)
    target = out or Path(f"{video_or_run.stem if video_or_run.suffix else video_or_run.name}_kymograph")
    check_target(target, overwrite=overwrite)
    check_mark(target, MARK)
    source = _source(video_or_run, cut, reading, wishes, quiet=quiet)
    diagrams = _diagrams(source, **wishes)
    warnings = [*source.warnings, *_warnings(diagrams)]
    facts = _facts(cut, reading, source, diagrams, warnings)
    files = _write(target, overwrite, picture, source, diagrams, facts, started)
    return _report(target, files, source, diagrams, warnings, quiet=quiet)


def _source(
    path: Path, cut: CutOptions, reading: VideoOptions | None, wishes: dict[str, Any], *, quiet: bool
) -> Source:
    """The run, or the video; of a video the frames are cut while it is read, so that wish is fulfilled."""
    from vision.run.reading import is_run

    columns, size = parse_range(cut.columns, "--columns"), wishes.pop("pixel_size_um")
    if is_run(path):
        return from_run(path, reading, columns=columns, pixel_size_um=size)
    return from_video(
        path,
        reading or VideoOptions(),
        frames=wishes.pop("frames"),
        columns=columns,
        pixel_size_um=size,
        track=bool(wishes["sheets"]),
        quiet=quiet,
    )


def _wishes(cut: CutOptions) -> dict[str, Any]:
    """Arguments of `space_time` but for the strip.  Raises: InputError, before anything is read."""
    sheets = parse_sheets(cut.sheet)
    for option, given in (("--width", cut.width), ("--follow", cut.follow)):
        if given and not sheets:
            raise InputError(option, "a sheet for the window", "none", "give --sheet right:1, for example")
    return {
        "sheets": sheets,
        "width": parse_length(cut.width, "--width") if cut.width else {},
        "follow": cut.follow,
        "frames": parse_range(cut.frames, "--frames"),
        "time_s": parse_seconds(cut.time, "--time"),
        "pixel_size_um": number(cut.pixel_size, "--pixel-size", least=1e-6),
    }


def _diagrams(
    source: Source, *, sheets: list[Any], width: dict[str, Any], follow: bool, **part: Any
) -> list[xr.DataArray]:
    """One per sheet; of the whole strip where no sheet is asked for."""
    from vision.spacetime import space_time

    size = source.pixel_size_um
    if not sheets or source.tracks is None:
        return [space_time(source.strip, pixel_size_um=size, **part)]
    pitch: dict[str, Any] = {"width_px": min(float(source.tracks.attrs["pitch_px"]), source.strip.sizes["x"])}
    width = width or (pitch if size is None else {"width_um": PAPER_WIDTH_UM})
    window: dict[str, Any] = {"around": source.tracks, "follow": follow, "pixel_size_um": size}
    window |= width | part
    drawn = [space_time(source.strip, sheet=sheet, **window) for sheet in sheets]
    return list({diagram.attrs["sheet"]: diagram for diagram in drawn}.values())  # each sheet once


def _warnings(diagrams: list[xr.DataArray]) -> list[str]:
    """What makes the TIFF's even time axis, or a sheet's window, misleading."""
    from vision.run.kymograph import unevenness_s

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


def _facts(
    cut: CutOptions,
    reading: VideoOptions | None,
    source: Source,
    diagrams: list[xr.DataArray],
    warnings: list[str],
) -> dict[str, Any]:
    """Everything run.json holds but the timings."""
    from vision.run.provenance import Parameter, describe_input, versions

    options = vars(cut) | vars(reading or VideoOptions())
    return {
        "command": shlex.join(["track", *sys.argv[1:]]),
        "versions": versions(),
        "parameters": {
            name: Parameter(value, "default" if value in (None, (), False) else "given")
            for name, value in options.items()
        },
        "inputs": [describe_input(path) for path in source.files],
        MARK: [_about(diagram) for diagram in diagrams],
        "slips": _slips(source, diagrams[0]),
        "warnings": warnings,
    }


def _about(diagram: xr.DataArray) -> dict[str, Any]:
    """What one diagram shows."""
    from vision.run.kymograph import frame_step_s

    names = ("sheet", "sheet_index", "centre_px", "follow", "pixel_size_um")
    frame, x = diagram["frame"].values, diagram["x"].values
    return {
        "frames": [frame[0], frame[-1]],
        "columns": [x[0], x[-1]],
        "s_per_row": frame_step_s(diagram["time_s"].values),
        **{name: diagram.attrs[name] for name in names if name in diagram.attrs},
    }


def _slips(source: Source, diagram: xr.DataArray) -> str:
    """How many slips are marked and what they were taken from, or why none is."""
    from vision.run.kymograph import frame_step_s

    if source.slips is None:
        return "not known: without a force they take tracked sheets and a symmetry axis"
    times, slips_s = diagram["time_s"].values, source.slips.times_s
    half = frame_step_s(times) / 2
    seen = (slips_s >= times[0] - half) & (slips_s <= times[-1] + half)
    return f"{seen.sum()} in the part shown, from {source.slips.how}"


def _write(
    target: Path,
    overwrite: bool,
    picture: str,
    source: Source,
    diagrams: list[xr.DataArray],
    facts: dict[str, Any],
    started: float,
) -> list[str]:
    """The folder, whole; names of the TIFFs in it."""
    from vision.figures import kymograph_figure
    from vision.run.folder import run_folder
    from vision.run.kymograph import write_space_time_tif
    from vision.run.provenance import write_run_json

    names = [f"kymograph_{d.attrs.get('sheet', 'strip').replace(':', '')}.tif" for d in diagrams]
    slips = source.slips
    marks: dict[str, Any] = {} if slips is None else {"slips_s": slips.times_s, "slips_from": slips.how}
    with run_folder(target, overwrite=overwrite) as folder:
        for name, diagram in zip(names, diagrams, strict=True):
            write_space_time_tif(diagram, folder / name, pixel_size_um=source.pixel_size_um)
        kymograph_figure(diagrams, **marks).save(folder / f"kymograph.{picture}")
        write_run_json(folder, {**facts, "seconds": {"total": clock.perf_counter() - started}})
    return [*names, f"kymograph.{picture}"]


def _report(
    target: Path,
    files: list[str],
    source: Source,
    diagrams: list[xr.DataArray],
    warnings: list[str],
    *,
    quiet: bool,
) -> int:
    """Summary to standard output, warnings to standard error; the exit status."""
    for line in warnings:
        complain(f"warning: {line}")
    if not quiet:
        rows, columns = diagrams[0].shape
        size = "" if source.pixel_size_um is None else f", {source.pixel_size_um:g} µm per px"
        say(
            [
                f"diagrams   {len(diagrams)} of {rows} frames x {columns} px{size}",
                f"slips      {_slips(source, diagrams[0])}",
                f"results    {target}/: {', '.join(files)}",
            ]
        )
    return 1 if warnings else 0
