"""Commands on a recording (preview, kymograph) and on finished runs (export to compare)."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import xarray as xr
from cyclopts import Parameter as Option

from vision.certify import CertifySettings, certify_run, statements, write_certificate
from vision.command.console import complain, conclude, frame_progress, in_columns
from vision.command.options import (
    CompareOptions,
    Config,
    MovedFilm,
    OutputOptions,
    PaperOptions,
    Run,
    Switch,
    VideoOptions,
    WindowOptions,
    flag_of,
    names_given,
)
from vision.command.settings import (
    at_least,
    merged,
    parameters_given,
    parse_pixel_size,
    parse_range,
    parse_seconds,
    parse_sheets,
    parse_width,
    settings_of,
)
from vision.command.track import OVERLAY, one_film, origin_of, run_name
from vision.comparison import compare as compare_runs
from vision.comparison import write_comparison
from vision.comparison.comparison import MARK, answers
from vision.data import DiagramMetadata, StripMetadata, TrackMetadata, warnings_of
from vision.errors import InputError, counted, did_you_mean
from vision.figures import kymograph_figure, load_figures, preview_figure
from vision.files import AGAIN, expanded, reading
from vision.folder import check_new, check_place, whole_file
from vision.pipeline import Analysis, Settings, analyse, open_recording
from vision.run.export import Format, export_run, write_overlay
from vision.run.reading import check_outside, check_results, is_run, read_run, stored_analysis
from vision.run.tables import frame_step_s, unevenness_s, write_space_time_tif
from vision.run.writing import results_folder
from vision.spacetime import Sheet, space_time
from vision.summary import aligned
from vision.video import Video, find_strip, measure_strip, strip_profile, video_files

DIAGRAMS = "diagrams"  # key in run.json that distinguishes a folder of diagrams from a run


# --- preview ------------------------------------------------------------------------------------------------


def preview(
    video: Annotated[Path, Option(help="A video as for track.")],
    /,
    options: VideoOptions = VideoOptions(),
    *,
    config: Config = None,
    output: OutputOptions = OutputOptions(),
) -> int:
    """Show within seconds the frame, the strip, the ridges and their noise.

    Tracks the first frames only. Prints the same lines as track about them, and writes NAME_preview.png, or
    with --out also a .pdf or .svg file.

    For example:

        track preview test.avi

        track preview beam.cine --rotate 90 --strip 14:630
    """
    video, settings = one_film(video), settings_of(merged(options, config=config))
    target = output.out or Path(f"{run_name(video)}_preview.png")
    if output.out is not None:
        check_new(target, overwrite=output.overwrite)
    film, start = make_preview(video, settings)
    assert start.frame is not None and start.strip is not None and start.tracks is not None
    with whole_file(target) as path:
        figure = preview_figure(start.frame, start.strip, start.tracks, pixel_size_um=start.pixel_size_um)
        figure.save(path)
    rows, columns = film.shape
    count = "unknown number of" if film.estimated is None else f"{film.estimated}"
    size = f"{count} frames of {columns} x {rows} px, {film.depth_bits} bit; the first are tracked here"
    about = [line for line in start.summary() if not line.startswith("frames")]
    summary = [*aligned([("film", size)]), *about, *aligned([("picture", str(target))])]
    return conclude(summary, start.warnings, quiet=output.quiet)


def make_preview(path: Path, settings: Settings) -> tuple[Video, Analysis]:
    """Return a film, and the analysis of its first frames.  Raises: InputError as `track` does."""
    film = open_recording(path, settings)
    how: dict[str, Any] = {"columns": settings.columns, "settings": settings.tuning.video}
    rows = settings.rows
    chosen = find_strip(film, **how) if rows is None else measure_strip(film, rows, **how)
    count = min(24, film.estimated or 24)  # 24 frames give the scatter of a position to one seventh
    first = slice(film.first, film.first + count)
    # Corrections are about frames that are not tracked here.
    start = analyse(path, None, replace(settings, rows=chosen.rows, strips=1, frames=first, corrections=()))
    assert start.tracks is not None
    tracks = start.tracks.assign_attrs(strip_how=chosen.how)
    warnings = dict.fromkeys((*film.warnings, *chosen.warnings, *start.warnings))
    return film, replace(start, tracks=tracks, warnings=tuple(warnings))


# --- kymograph ----------------------------------------------------------------------------------------------


def kymograph(
    video_or_run: Annotated[Path, Option(help="A run folder, or a video as for track.")],
    /,
    window: WindowOptions = WindowOptions(),
    options: VideoOptions = VideoOptions(),
    *,
    picture: Annotated[Literal["png", "pdf", "svg"], Option(help="Format of the picture.")] = "png",
    output: OutputOptions = OutputOptions(),
) -> int:
    """Draw space-time diagrams of the whole strip, or of windows around sheets.

    Writes the folder NAME_kymograph with one 16-bit TIFF per diagram, which Fiji opens in µm and s, and one
    picture of all, side by side with axes. Slips are marked: those of the run's force recording, or without
    one the common outward steps of the sheets. The options of a video below are for films; with a run only
    --columns, --frames and --pixel-size count, as the others were decided when it was made. Those of sheets
    (--sheets to --corrections) count only where a film is tracked, with --sheet or --pitch.

    For example:

        track kymograph test_tracks --sheet right:23 --sheet right:10 --width 0.2mm --time 40:45.1

        track kymograph test.avi --frames 0:600
    """
    started = time.perf_counter()
    sheets, width = _windows_of(window)
    part: dict[str, Any] = {"time_s": parse_seconds(window.time)}
    video_or_run = one_film(video_or_run)
    target = output.out or Path(f"{run_name(video_or_run)}_kymograph")
    check_results(target, overwrite=output.overwrite, mark=DIAGRAMS)
    parameters = merged(options)
    if is_run(video_or_run):
        with reading(video_or_run, "a run folder as track writes it", AGAIN):
            data, files = _from_run(video_or_run, options)
        part["frames"] = parse_range(options.frames, "--frames")
    else:
        settings = settings_of(parameters)
        film = open_recording(video_or_run, settings)
        if settings.pixel_size_um is None and settings.pitch_um is None:
            settings = replace(settings, pixel_size_um=film.facts.pixel_size_um)
            if "width_um" in width and settings.pixel_size_um is None:
                needed = "a pixel size (mm needs --pixel-size)"
                raise InputError(f"--width {window.width}", needed, "none", "or give the width as 20px")
        given = (parameters[name].value for name in ("timestamps", "corrections"))
        files = [*video_files(video_or_run), *(file for file in given if file is not None)]
        data = _from_video(film, settings, track=bool(sheets), quiet=output.quiet)
    diagrams = _diagrams(data, sheets, width, follow=window.follow, **part)
    warnings = [*data.warnings, *_warnings(diagrams)]
    slips = _slips_shown(data, diagrams[0])
    facts = origin_of(files, parameters | parameters_given(window, output)).facts(warnings=warnings)
    facts |= {DIAGRAMS: list(map(_diagram_facts, diagrams)), "slips": slips}
    shown = [DiagramMetadata.of(diagram).sheet or "strip" for diagram in diagrams]
    names = [f"kymograph_{sheet.replace(':', '')}.tif" for sheet in shown]
    figure = kymograph_figure(diagrams, slips=data.slips)
    size = data.pixel_size_um
    with results_folder(target, facts, started=started, overwrite=output.overwrite) as folder:
        for name, diagram in zip(names, diagrams, strict=True):
            write_space_time_tif(diagram, folder / name, pixel_size_um=size)
        figure.save(folder / f"kymograph.{picture}")
    rows, columns = diagrams[0].shape
    scale = "" if size is None else f", {size:g} µm per px"
    lines = {
        "diagrams": f"{len(diagrams)}; {rows} frames x {columns} px{scale}",
        "slips": slips,
        "results": f"{target}/: {', '.join([*names, f'kymograph.{picture}'])}",
    }
    return conclude(aligned(lines.items()), warnings, quiet=output.quiet)


def _windows_of(window: WindowOptions) -> tuple[list[Sheet], dict[str, float]]:
    """Return the sheets to show and the width of their windows.  Raises: InputError."""
    sheets = parse_sheets(window.sheet)
    for option, given in (("--width", window.width), ("--follow", window.follow)):
        if given and not sheets:
            raise InputError(option, "a sheet for the window", "none", "give --sheet right:1, for example")
    return sheets, parse_width(window.width) if window.width else {}


def _from_run(folder: Path, options: VideoOptions) -> tuple[Analysis, list[Path]]:
    """Read a run's kymograph.tif, tracks and slips, and return their files; a given pixel size overrides its.

    Raises: InputError for options that only a video takes, columns that the run lacks, and a damaged run.
    """
    accepted = ("columns", "frames", "pixel_size")
    if given := [name for name in names_given(options) if name not in accepted]:
        found = ", ".join(map(flag_of, given))
        raise InputError(folder, "options that a run takes", found, "give the video, or run track again")
    run, (size, _) = read_run(folder), parse_pixel_size(options.pixel_size)
    data = stored_analysis(run, Settings(pixel_size_um=run.pixel_size_um if size is None else size))
    columns = parse_range(options.columns, "--columns") or slice(None)
    files = [folder / name for name in ("kymograph.tif", "tracks.nc", "events.csv", "clock.json")]
    assert data.strip is not None
    data = replace(data, strip=_cut(data.strip, columns, folder), sticks=run.events)
    return data, [file for file in files if file.exists()]


def _cut(strip: xr.DataArray, columns: slice, folder: Path) -> xr.DataArray:
    """Return these columns of a run's strip.  Raises: InputError if it has none of them."""
    last = None if columns.stop is None else columns.stop - 1  # a slice of labels has both ends
    part = strip.sel(x=slice(columns.start, last))
    if not part.sizes["x"]:
        x, found = strip["x"].values, f"{columns.start}:{columns.stop}"
        raise InputError(f"{folder}: --columns", f"a part of {x[0]}:{x[-1] + 1}", found)
    return part


def _from_video(video: Video, settings: Settings, *, track: bool, quiet: bool) -> Analysis:
    """Read a video's strip and, with `track` or a pitch, track its sheets."""
    with frame_progress("reading", quiet=quiet) as progress:
        if track or settings.pitch_um is not None:
            return analyse(video, None, settings, progress=progress)
        strip = strip_profile(video, settings.rows, columns=settings.columns, progress=progress)
        return Analysis(settings=settings, strip=strip, warnings=tuple(warnings_of(strip)))


def _diagrams(
    data: Analysis, sheets: Sequence[Sheet], width: dict[str, float], *, follow: bool, **part: Any
) -> list[xr.DataArray]:
    """Return one diagram per sheet, or one of the whole strip if no sheet is asked for."""
    size = data.pixel_size_um
    assert data.strip is not None
    if not sheets or data.tracks is None:
        return [space_time(data.strip, pixel_size_um=size, **part)]
    pitch = min(TrackMetadata.of(data.tracks).pitch_px, float(data.strip.sizes["x"]))
    width = width or ({"width_px": pitch} if size is None else {"width_um": 200.0})
    part |= {"around": data.tracks, "follow": follow, "pixel_size_um": size, **width}
    diagrams = [space_time(data.strip, sheet=sheet, **part) for sheet in sheets]
    return list({DiagramMetadata.of(diagram).sheet: diagram for diagram in diagrams}.values())  # each once


def _warnings(diagrams: list[xr.DataArray]) -> list[str]:
    """Return warnings of uneven frame times, empty frames, and frames in which a sheet was not found."""
    off = unevenness_s(diagrams[0]["time_s"].values)
    lines = [f"frame times are uneven: the TIFF's time axis is off by up to {off:.3g} s"] if off else []
    recorded = diagrams[0]["status"] == "ok"
    if empty := int((~recorded).sum()):
        lines.append(f"{empty} of {recorded.size} frames shown are empty")
    for diagram in diagrams:
        name = DiagramMetadata.of(diagram).sheet
        if name and (lost := int((diagram["x_sheet_px"].isnull() & recorded).sum())):
            lines.append(f"sheet {name}: not found in {lost} of {recorded.size} frames shown")
    return lines


def _diagram_facts(diagram: xr.DataArray) -> dict[str, Any]:
    """Return what run.json says of one diagram."""
    facts = DiagramMetadata.of(diagram)
    window = asdict(facts) if facts.sheet else {"pixel_size_um": facts.pixel_size_um}
    frame, x = diagram["frame"].values, diagram["x"].values
    return {
        "frames": [frame[0], frame[-1]],
        "columns": [x[0], x[-1]],
        "s_per_row": frame_step_s(diagram["time_s"].values),
        **window,
    }


def _slips_shown(data: Analysis, diagram: xr.DataArray) -> str:
    """Return how many slips are marked and what they were found from, or why none is marked."""
    if data.slips.time_s is None:
        return "not known: without a force recording, tracked sheets and a symmetry axis are needed"
    times = diagram["time_s"].values
    half = frame_step_s(times) / 2
    shown = data.slips.within(times[0] - half, times[-1] + half)
    return f"{shown.size} in the part shown, from {data.slips.source}"


# --- finished runs: export, figures, overlay, certify, compare ----------------------------------------------


def export(
    run: Run,
    /,
    *,
    to: Annotated[Format, Option(help="Format.")],
    output: OutputOptions = OutputOptions(),
) -> int:
    """Write the tables of a finished run in another program's format.

    csv and parquet: a folder with one file per table. xlsx: one worksheet per table. mat: matrices and
    structs for MATLAB. trackpy: x, y, frame, particle. napari: track_id, t, y, x. imagej: the tracks as
    polylines on kymograph.tif, for Fiji's ROI manager. The unit is the last part of a column's name; trackpy,
    napari and imagej use px. The file or folder has the run's name.

    Positions that were not measured are empty in csv, xlsx and parquet, NaN in mat, and left out for trackpy,
    napari and imagej.

    For example:

        track export test_tracks --to xlsx

        track export test_tracks --to mat --out for_matlab.mat
    """
    target, notes = export_run(read_run(run), to, out=output.out, overwrite=output.overwrite)
    for note in notes:
        complain(note)
    place = f"{target}/" if target.is_dir() else f"{target}"
    return conclude([f"{to} -> {place}"], (), quiet=output.quiet)


def figures(
    run: Annotated[Path, Option(help="Run folder, or the folder that `track compare` wrote.")],
    /,
    *names: Annotated[str, Option(help="Names of figures; all if none is given.")],
    to: Annotated[Literal["pdf", "svg", "png", "csv"], Option(help="Format.")] = "pdf",
    list_: Annotated[
        Switch, Option(name="--list", help="Print the name and title of every figure, and write nothing.")
    ] = False,
    paper: PaperOptions = PaperOptions(),
    output: OutputOptions = OutputOptions(),
) -> int:
    """Write the figures of a finished run for a manuscript, or their numbers as csv.

    A comparison of several tests has figures, too. Writes one file per figure into the folder RUN_figures.

    For example:

        track figures test_tracks --list

        track figures test_tracks --to svg

        track figures test_tracks deformation shells --width 86mm --font-size 8 --out manuscript

        track figures comparison collapse trends
    """
    finished = read_run(run)
    made = {figure.name: figure for figure in load_figures(run / "figures.npz")}
    if unknown := [name for name in names if name not in made]:
        advice = did_you_mean(unknown[0], made) or "--list prints their titles"
        raise InputError(run, f"figures of this run ({', '.join(made)})", ", ".join(unknown), advice)
    if list_:
        return conclude(in_columns([(name, one.title) for name, one in made.items()], "<"), (), quiet=False)
    if paper.width is not None:
        width = parse_width(paper.width)
        if "width_px" in width:
            raise InputError("--width", "a width on paper", f"'{paper.width}'", "write 86mm")
        made = {name: one.of_width(width["width_um"] / 1000, paper.font_size) for name, one in made.items()}
    target = output.out or Path(f"{finished.name}_figures")
    check_outside(target, run)
    chosen = names or tuple(made)
    images = [name for name in chosen if to == "csv" and made[name].table().empty]
    files = [target / f"{name}.{to}" for name in chosen if name not in images]
    for file in files:
        check_new(file, overwrite=output.overwrite)
    for file in files:
        with whole_file(file) as path:
            made[file.stem].save(path, dpi=300, font_size=paper.font_size)
    without = f"; images without numbers: {', '.join(images)}" if images else ""
    return conclude([f"{counted(len(files), 'figure')} -> {target}/{without}"], (), quiet=output.quiet)


def overlay(
    run: Run,
    /,
    *,
    film: MovedFilm = None,
    frames: Annotated[
        str | None, Option(help="Part of the film, A:B, with frame numbers as in tracks.csv.")
    ] = None,
    output: OutputOptions = OutputOptions(),
) -> int:
    """Draw the tracks of a finished run on its film, to see whether they follow the sheets.

    Writes RUN_overlay.mp4. The file says what it is, and `track` warns if it is given as a film.

    For example:

        track overlay test_tracks

        track overlay test_tracks --frames 300:600 --film /archive/test.avi
    """
    part = parse_range(frames, "--frames")
    made = read_run(run)
    target = output.out or Path(f"{made.name}{OVERLAY}.mp4")
    if target.suffix.lower() != ".mp4":
        raise InputError("`out`", "a name that ends in .mp4", f"'{target}'")
    check_new(target, overwrite=output.overwrite)
    source = made.input("film", film)
    with frame_progress("drawing", quiet=output.quiet) as progress, whole_file(target) as path:
        count, (rows, columns), fps = write_overlay(made, source, path, frames=part, progress=progress)
    size = f"{count} frames of {columns} x {rows} px"
    recorded = StripMetadata.of(made.tracks).fps
    slowed = f" (recorded at {recorded:.4g})" if recorded != fps else ""
    line = f"{size}, played at {fps:g} frames/s{slowed}, {target.stat().st_size / 1e6:.1f} MB -> {target}"
    return conclude([line], (), quiet=output.quiet)


def certify(
    run: Run,
    /,
    *,
    films: Annotated[
        int,
        Option(help="Number of synthetic films. More take longer and average over more noise and motion."),
    ] = CertifySettings.films,
    most_frames: Annotated[
        int, Option(help="Largest number of frames of a film, from the middle of the run.")
    ] = CertifySettings.most_frames,
    output: OutputOptions = OutputOptions(),
) -> int:
    """Measure what the recording of a run can resolve, from similar films with known truth.

    Synthetic films are made from the run's own mean ridges, light, motion and residuals, and analysed in the
    same way. Writes the folder RUN_certificate: certificate.html states on one page the error of each sheet,
    the smallest sweep in a stick phase, the pixel locking, how certain identities are, and the bias of
    σ_x/Λ_st at the threshold; certificate.csv and certificate.json hold the numbers. Exit status 1 if the
    certificate does not cover everything.

    For example:

        track certify test_tracks

        track certify test_tracks --films 6 --out certified
    """
    at_least(films, "--films", 1)
    at_least(most_frames, "--most-frames", CertifySettings.least_frames)
    finished = read_run(run)
    target = output.out or Path(f"{finished.name}_certificate")
    check_outside(target, run)
    if (target / "certificate.json").exists():
        check_new(target, overwrite=output.overwrite, kind="folder")
    check_place(target / "certificate.html")
    settings = CertifySettings(films=films, most_frames=most_frames)
    with frame_progress("films", quiet=output.quiet) as progress:
        certificate = certify_run(finished, settings=settings, progress=progress)
    write_certificate(certificate, target)
    answers = [(one.what, f"{one.value} {one.detail}") for one in statements(certificate)]
    lines = [*in_columns(answers, "<"), f"-> {target}/"]
    return conclude(lines, certificate.warnings, quiet=output.quiet)


def compare(
    *runs: Annotated[
        Path,
        Option(help="Run folders with a force recording; those of the table if none is given."),
    ],
    options: CompareOptions = CompareOptions(),
    output: OutputOptions = OutputOptions(),
) -> int:
    """Compare several tests: one table, one μ, the collapse, change points and trends.

    Writes the folder comparison: tests.csv (one row per run), trends.json, all_events.csv, figures.npz,
    collapse.png, trends.png (if conditions vary), report.html and run.json. A run that cannot be used is
    named, the others are compared, and the exit status is 1.

    For example:

        track compare old_tracks new_tracks --table tests.csv

        track compare --table tests.csv --main-sample A --out two_samples
    """
    target = output.out or Path("comparison")
    table, main_sample, fix_yeff = options.table, options.main_sample, options.fix_yeff
    found = compare_runs(expanded(runs), table, main_sample=main_sample, modulus_GPa=fix_yeff)
    try:
        check_results(target, overwrite=output.overwrite, mark=MARK)
    except InputError:
        for line in found.failures:  # a run that cannot be used is named even if the folder exists
            complain(line)
        raise
    origin = origin_of([table] if table else [], parameters_given(options, output))
    write_comparison(found, target, origin, overwrite=output.overwrite, report=options.report)
    rows = [(one.what, ", ".join(filter(None, (one.value, one.detail)))) for one in answers(found)]
    lines = [f"{counted(len(found.tests), 'test')} -> {target}/", *in_columns(rows, "<")]
    return conclude(lines, found.warnings, failures=found.failures, quiet=output.quiet)
