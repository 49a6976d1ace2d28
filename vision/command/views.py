"""Commands that look: at a recording (preview, kymograph), or at finished runs (export to compare)."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from vision.certify import CertifySettings, certify_run, statements, write_certificate
from vision.command.console import complain, conclude, frame_progress, in_columns, say
from vision.command.options import OutputOptions, VideoOptions, WindowOptions, option_names
from vision.command.settings import (
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
from vision.comparison import compare as compare_runs
from vision.comparison.comparison import summary_lines
from vision.data import StripMetadata, TrackMetadata, warnings_of
from vision.errors import InputError
from vision.figures import kymograph_figure, load_figures, preview_figure, sides_known, slip_times
from vision.files import reading as reading_of
from vision.numeric import Floats, Ints, Pixels
from vision.pipeline import Settings, analyse, open_recording, track_strip
from vision.run import (
    Origin,
    check_mark,
    check_new,
    check_target,
    export_run,
    is_run,
    read_run,
    read_strip,
    run_folder,
    slip_times_s,
    whole_file,
    write_json,
)
from vision.run.comparing import MARK, write_comparison
from vision.run.export import Format, film_of, frame_step_s, unevenness_s, write_overlay, write_space_time_tif
from vision.run.reading import AGAIN, tracks_of
from vision.sheets import pixel_size_from_pitch
from vision.sheets.ridges import describe_ridges, find_ridges
from vision.sheets.tracks import LOSSY
from vision.spacetime import space_time
from vision.summary import flag_counts, frame_times, noise_figures, overexposure, tracking_warnings
from vision.video import Video, reference_frame, strip_profile, video_files
from vision.video.strip import row_means
from vision.video.strip_find import choose_strip

DIAGRAMS = "diagrams"  # of run.json: tells a folder of diagrams from a run


# --- preview ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Preview:
    """What a few frames show."""

    video: Video  # the whole film
    frame: Pixels  # the first frame of those tracked that shows something
    strip: xr.DataArray  # of the consecutive frames
    tracks: xr.Dataset
    counts: Ints  # ridges in each of the frames spread over the film
    warnings: tuple[str, ...]  # about the strip, the light, and positions in the frames that were tracked


def preview(video: Path, reading: VideoOptions, config: Path | None, output: OutputOptions) -> int:
    """What would be measured, from a few frames; the exit status."""
    settings = settings_of(merged(reading, config=config))
    target = output.out or Path(f"{run_name(video)}_preview.png")
    if output.out is not None:
        check_new(target, overwrite=output.overwrite)
    found = look(video, settings)
    size = settings.pixel_size_um
    if settings.pitch_um is not None:
        size = pixel_size_from_pitch(found.tracks, settings.pitch_um)
    with whole_file(target) as path:
        preview_figure(found.frame, found.strip, found.tracks, pixel_size_um=size).save(path)
    return conclude([*lines(found, size), f"picture    {target}"], found.warnings, quiet=output.quiet)


def look(path: Path, settings: Settings) -> Preview:
    """Read, track and count a few frames.  Raises: InputError as `track` does."""
    film = open_recording(path, settings)
    strip_settings = settings.tuning.video
    chosen = choose_strip(film, settings.rows, columns=settings.columns, settings=strip_settings)
    rows = chosen.rows
    count = min(24, film.estimated or 24)  # the scatter of one position is then known to a seventh
    few = open_recording(path, replace(settings, frames=slice(film.first, film.first + count)))
    strip = strip_profile(few, rows, columns=settings.columns, settings=strip_settings)
    # Decisions by hand are about frames that are not looked at here.
    tracks = track_strip(strip, replace(settings, corrections=()))
    columns = slice(int(strip["x"].values[0]), int(strip["x"].values[-1]) + 1)
    spread = list(film.sample(12)) or list(itertools.islice(film.frames(), 12))
    profile = row_means(np.stack([frame[rows, columns] for frame in spread]))
    comb = describe_ridges(profile, polarity=tracks.attrs["ridges"], settings=settings.tuning.tracking)
    ridges = find_ridges(profile, comb, settings=settings.tuning.tracking)
    frame = reference_frame(few)
    # What is missing can only be known from all frames.
    kept = [line for line in warnings_of(tracks) if "missing" not in line]
    light = overexposure(frame, rows, strip_settings)
    warnings = dict.fromkeys([*film.warnings, *chosen.warnings, *kept, *light, *tracking_warnings(tracks)])
    return Preview(film, frame, strip, tracks, ridges.count, tuple(warnings))


def lines(found: Preview, pixel_size_um: float | None) -> list[str]:
    """What was found, in nine lines."""
    strip, comb, film = StripMetadata.of(found.strip), TrackMetadata.of(found.tracks), found.video
    rows, columns = film.shape
    count = "an unknown number of" if film.estimated is None else f"{film.estimated}"
    about = "" if film.expected is not None else "about " * (film.estimated is not None)
    noise = noise_figures(found.tracks, pixel_size_um)
    length = "" if pixel_size_um is None else f" = {noise['stated_um']:.3f} µm"
    lean = "no lean measured" if math.isnan(strip.tilt_deg) else f"lean {strip.tilt_deg:+.2f}°"
    flags = flag_counts(found.tracks)
    other = ", ".join(f"{n} {name}" for name, n in flags.items() if name != "ok") or "none missing"
    low, high = int(found.counts.min()), int(found.counts.max())
    counted = f"{low}" if low == high else f"{low} to {high}"
    scale = "px: give `pixel_size_um` for µm" if pixel_size_um is None else f"{pixel_size_um:g} µm per px"
    frames, left = found.tracks.sizes["frame"], int((found.tracks["side"] < 0).sum())
    sides = f" ({left} left, {comb.sheets - left} right)" if sides_known(found.tracks) else ""
    hidden = f" (not independent: {strip.codec} hides the noise of the pixels)" * (strip.codec in LOSSY)
    return [
        f"film       {about}{count} frames of {columns} x {rows} px, {film.depth_bits} bit, {strip.codec}",
        f"clock      {frame_times(strip)}",
        f"strip      rows {strip.strip_z0}:{strip.strip_z1}, clarity {strip.strip_clarity:.2f}, {lean}, "
        f"{strip.strip_err_px:.3f} px from the choice of rows",
        f"sheets     {comb.sheets} {comb.ridges} ridges{sides}; {counted} in {found.counts.size} frames over "
        "the film, others than sheets included",
        f"ridges     {comb.ridge_fwhm_px:.1f} px wide, {comb.pitch_px:.1f} px apart; {comb.fit} fit over "
        f"{comb.window_px} px",
        f"light      ridges {comb.contrast:.3g} grey levels high, profile noise {comb.profile_noise:.2g}",
        f"positions  {flags.get('ok', 0)} in the first {frames} frames; {other}",
        f"noise      {noise['stated_px']:.4f} px{length} stated; {noise['measured_px']:.4f} px scatter "
        f"between {frames} frames{hidden}",
        f"scale      {scale}",
    ]


# --- kymograph ----------------------------------------------------------------------------------------------


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
    video_or_run: Path, window: WindowOptions, reading: VideoOptions, picture: str, output: OutputOptions
) -> int:
    """Space-time diagrams of a video or of a run; the exit status."""
    started = time.perf_counter()
    options = _space_time_options(window)
    target = output.out or Path(f"{run_name(video_or_run)}_kymograph")
    check_target(target, overwrite=output.overwrite)
    check_mark(target, DIAGRAMS)
    parameters = merged(reading)
    if is_run(video_or_run):
        with reading_of(video_or_run, "a run folder as track writes it", AGAIN):
            source = _from_run(video_or_run, reading)
        options["frames"] = parse_range(reading.frames, "--frames")
    else:
        wanted, settings = bool(options["sheets"]), settings_of(parameters)
        if "width_um" in options["width"] and settings.pixel_size_um is None and settings.pitch_um is None:
            needed = "a pixel size (mm needs --pixel-size)"
            raise InputError(f"--width {window.width}", needed, "none", "or give the width as 20px")
        given = (parameters[name].value for name in ("timestamps", "corrections"))
        files = (*video_files(video_or_run), *(file for file in given if file is not None))
        source = _from_video(video_or_run, settings, files, track=wanted, quiet=output.quiet)
    diagrams = _diagrams(source, **options)
    warnings = [*source.warnings, *_warnings(diagrams)]
    slips, chosen = _slips_shown(source, diagrams[0]), parameters | parameters_given(vars(window))
    facts = Origin(command=command_line(), inputs=source.files, parameters=chosen).facts()
    facts |= {DIAGRAMS: [_about(diagram) for diagram in diagrams], "slips": slips, "warnings": warnings}
    names = [f"kymograph_{d.attrs.get('sheet', 'strip').replace(':', '')}.tif" for d in diagrams]
    figure = kymograph_figure(diagrams, slips_s=source.slips_s, slips_from=source.slips_from)
    size = source.pixel_size_um
    with run_folder(target, overwrite=output.overwrite) as folder:
        for name, diagram in zip(names, diagrams, strict=True):
            write_space_time_tif(diagram, folder / name, pixel_size_um=size)
        figure.save(folder / f"kymograph.{picture}")
        facts["seconds"] = {"total": time.perf_counter() - started}
        write_json(facts, folder / "run.json")
    rows, columns = diagrams[0].shape
    scale = "" if size is None else f", {size:g} µm per px"
    lines = [
        f"diagrams   {len(diagrams)} of {rows} frames x {columns} px{scale}",
        f"slips      {slips}",
        f"results    {target}/: {', '.join([*names, f'kymograph.{picture}'])}",
    ]
    return conclude(lines, warnings, quiet=output.quiet)


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

    Raises: InputError for options that only a video takes, columns that the run lacks, and a damaged run.
    """
    taken = ("columns", "frames", "pixel_size")
    given = [name for name, value in vars(reading).items() if value is not None and name not in taken]
    if given:
        found = ", ".join(f"--{name}" for name in given)
        raise InputError(folder, "options that a run takes", found, "give the video, or run track again")
    run = read_run(folder)
    strip = read_strip(run)
    columns, size = parse_range(reading.columns, "--columns"), parse_pixel_size(reading.pixel_size)
    files = ("kymograph.tif", "tracks.nc", "events.csv", "clock.json")
    slips_s, slips_from = slip_times(run.tracks, slip_times_s(run))
    return Source(
        strip=_cut(strip, columns or slice(None), folder),
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


def _from_video(
    path: Path, settings: Settings, files: tuple[Path, ...], *, track: bool, quiet: bool
) -> Source:
    """A video's strip, and its sheets where windows around them are wanted; it is read from `files`."""
    with frame_progress("reading", quiet=quiet) as progress:
        if track or settings.pitch_um is not None:
            analysis = analyse(path, None, settings, progress=progress)
            strip, tracks, warnings = analysis.strip, analysis.tracks, analysis.warnings
            settings = analysis.settings
        else:
            video = open_recording(path, settings)
            strip = strip_profile(video, settings.rows, columns=settings.columns, progress=progress)
            tracks, warnings = None, tuple(warnings_of(strip))
    assert strip is not None
    return Source(strip, tracks, *slip_times(tracks), settings.pixel_size_um, files, warnings)


def _diagrams(
    source: Source, *, sheets: list[Any], width: dict[str, Any], follow: bool, **part: Any
) -> list[xr.DataArray]:
    """One per sheet; of the whole strip where no sheet is asked for."""
    size = source.pixel_size_um
    if not sheets or source.tracks is None:
        return [space_time(source.strip, pixel_size_um=size, **part)]
    pitch = min(TrackMetadata.of(source.tracks).pitch_px, float(source.strip.sizes["x"]))
    width = width or ({"width_px": pitch} if size is None else {"width_um": 200.0})
    window: dict[str, Any] = {"around": source.tracks, "follow": follow, "pixel_size_um": size}
    cut = [space_time(source.strip, sheet=sheet, **window, **width, **part) for sheet in sheets]
    return list({diagram.attrs["sheet"]: diagram for diagram in cut}.values())  # each sheet once


def _warnings(diagrams: list[xr.DataArray]) -> list[str]:
    """What makes the TIFF's even time axis, or a sheet's window, misleading."""
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
    if source.slips_s is None:
        return "not known: without a force they take tracked sheets and a symmetry axis"
    times = diagram["time_s"].values
    half = frame_step_s(times) / 2
    seen = (source.slips_s >= times[0] - half) & (source.slips_s <= times[-1] + half)
    return f"{seen.sum()} in the part shown, from {source.slips_from}"


# --- finished runs: export, figures, overlay, certify, compare ----------------------------------------------


def export(run: Path, to: Format, output: OutputOptions) -> int:
    """Tables of a run for another program; the exit status."""
    exported = export_run(read_run(run), to, out=output.out, overwrite=output.overwrite)
    for note in exported.notes:
        complain(note)
    folder = "/" if exported.target.is_dir() else ""
    return conclude([f"{to} -> {exported.target}{folder}"], (), quiet=output.quiet)


def figures(
    run: Path | None, names: Sequence[str], compare: Path | None, to: str, output: OutputOptions
) -> int:
    """The figures of a run or of a comparison, a file each; the exit status."""
    if compare is not None:  # what stands where the run does is the first figure's name
        names = names if run is None else (str(run), *names)
        run = compare
    if run is None:
        raise InputError("track figures", "a run folder", "none", "give RUN, or --compare DIR")
    folder = read_run(run).folder
    made = {figure.name: figure for figure in load_figures(folder / "figures.npz")}
    if unknown := [name for name in names if name not in made]:
        raise InputError(run, f"figures of this run ({', '.join(made)})", ", ".join(unknown))
    target = output.out or Path(f"{folder.resolve().name}_figures")
    files = [target / f"{name}.{to}" for name in names or made]
    for file in files:
        check_new(file, overwrite=output.overwrite)
    for file in files:
        with whole_file(file) as path:
            made[file.stem].save(path)
    return conclude([f"{len(files)} figures -> {target}/"], (), quiet=output.quiet)


def overlay(run: Path, film: Path | None, frames: str | None, output: OutputOptions) -> int:
    """The film of a run with its tracks drawn on it; the exit status."""
    part = parse_range(frames, "--frames")
    made = read_run(run)
    target = output.out or Path(f"{made.folder.resolve().name}_overlay.mp4")
    if target.suffix.lower() != ".mp4":
        raise InputError("`out`", "a name that ends in .mp4", f"'{target}'")
    check_new(target, overwrite=output.overwrite)
    source = film_of(made, film)
    with frame_progress("drawing", quiet=output.quiet) as progress, whole_file(target) as path:
        written = write_overlay(made, source, path, frames=part, progress=progress)
    size = f"{written.frames} frames of {written.shape[1]} x {written.shape[0]} px"
    speed = f"{written.fps:g} frames/s{_slower(written.fps, StripMetadata.of(tracks_of(made)).fps)}"
    line = f"{size}, played at {speed}, {target.stat().st_size / 1e6:.1f} MB -> {target}"
    return conclude([line], (), quiet=output.quiet)


def _slower(played: float, recorded: float) -> str:
    """How much slower or faster than the film a copy of all its frames plays; "" for the same or unknown."""
    times = recorded / played
    if not math.isfinite(times) or abs(times - 1) < 0.01:
        return ""
    how = f"{times:.3g} times slower" if times > 1 else f"{1 / times:.3g} times faster"
    return f" ({how} than recorded, at {recorded:.4g})"


def certify(run: Path, films: int, most_frames: int, output: OutputOptions) -> int:
    """The certificate of a run; the exit status."""
    for name, value, least in (("--films", films, 1), ("--most-frames", most_frames, 30)):
        if value < least:
            raise InputError(name, f"a whole number from {least}", f"{value}")
    finished = read_run(run)
    target = output.out or Path(f"{finished.folder.resolve().name}_certificate")
    if (target / "certificate.json").exists():
        check_new(target, overwrite=output.overwrite, kind="folder")
    if target.exists() and not target.is_dir():
        raise InputError(target, "a folder", "a file", "give another `out`")
    settings = CertifySettings(films=films, most_frames=most_frames)
    with frame_progress("films", quiet=output.quiet) as progress:
        certificate = certify_run(finished, settings=settings, progress=progress)
    write_certificate(certificate, target)
    lines = [*in_columns(statements(certificate), "<"), f"-> {target}/"]
    return conclude(lines, certificate.warnings, quiet=output.quiet)


def compare(
    runs: Sequence[Path],
    table: Path | None,
    main_sample: str | None,
    fix_yeff: float | None,
    report: bool,
    output: OutputOptions,
) -> int:
    """Several runs side by side; the exit status."""
    target = output.out or Path("comparison")
    check_target(target, overwrite=output.overwrite)
    check_mark(target, MARK)
    found = compare_runs(runs, table, main_sample=main_sample, modulus_GPa=fix_yeff)
    origin = Origin(
        command=command_line(),
        inputs=[*(test.folder / "events.csv" for test in found.tests), *([table] if table else [])],
        parameters=parameters_given({"table": table, "main_sample": main_sample, "fix_yeff": fix_yeff}),
        options=option_names(),
    )
    write_comparison(found, target, origin, overwrite=output.overwrite, report=report)
    for line in (*found.failures, *found.warnings):
        complain(line)
    if not output.quiet:
        say([f"{len(found.tests)} tests -> {target}/", *summary_lines(found)])
    return 1 if found.failures or found.warnings else 0
