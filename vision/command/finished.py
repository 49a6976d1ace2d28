"""Commands on finished runs: export, figures, overlay, certify, compare."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter as Option

from vision.command.console import complain, conclude, frame_progress, say
from vision.command.options import Flag, option_names, parameters_given, parse_range
from vision.command.track import command_line
from vision.errors import InputError


def export(
    run: Path,
    /,
    *,
    to: Literal["csv", "xlsx", "parquet", "mat", "trackpy", "napari"],
    out: Path | None = None,
    overwrite: Flag = False,
    quiet: Flag = False,
) -> int:
    """Tables of a finished run in another program's format.

    csv and parquet: a folder with a file for each table. xlsx: one worksheet for each. mat: matrices and
    structs for MATLAB. trackpy: x, y, frame, particle. napari: track_id, t, y, x. The unit is the last part
    of a column's name; trackpy and napari have px.

    Positions that were not measured are empty in csv, xlsx and parquet, NaN in mat, and left out for trackpy
    and napari.

    Examples:

        track export test_tracks --to xlsx

        track export test_tracks --to mat --out for_matlab.mat

    Parameters
    ----------
    run
        Run folder.
    to
        Format.
    out
        File or folder; the run's name with the format's ending in the working directory by default.
    overwrite
        Replace an earlier export.
    quiet
        No summary.
    """
    from vision.run import export_run, read_run

    exported = export_run(read_run(run), to, out=out, overwrite=overwrite)
    for note in exported.notes:
        complain(note)
    if not quiet:
        folder = "/" if exported.target.is_dir() else ""
        say([f"{to} -> {exported.target}{folder}"])
    return 0


def figures(
    run: Path | None = None,
    /,
    *names: str,
    compare: Path | None = None,
    to: Literal["pdf", "svg", "png", "csv"] = "pdf",
    out: Path | None = None,
    overwrite: Flag = False,
    quiet: Flag = False,
) -> int:
    """The figures of a finished run, for a manuscript; csv holds a figure's numbers.

    Examples:

        track figures test_tracks --to svg

        track figures test_tracks deformation shells --to pdf --out manuscript

        track figures --compare comparison collapse trends

    Parameters
    ----------
    run
        Run folder.
    names
        Figures; all of the run if none is named.
    compare
        Folder that `track compare` wrote, in place of a run.
    to
        Format.
    out
        Folder; the run's name with _figures in the working directory by default.
    overwrite
        Replace files that are there.
    quiet
        No summary.
    """
    from vision.figures import load_figures
    from vision.run import check_new, read_run, whole_file

    if compare is not None:  # what stands where the run does is the first figure's name
        names = names if run is None else (str(run), *names)
        run = compare
    if run is None:
        raise InputError("track figures", "a run folder", "none", "give RUN, or --compare DIR")
    folder = read_run(run).folder
    made = {figure.name: figure for figure in load_figures(folder / "figures.npz")}
    if unknown := [name for name in names if name not in made]:
        raise InputError(run, f"figures of this run ({', '.join(made)})", ", ".join(unknown))
    target = out or Path(f"{folder.resolve().name}_figures")
    files = [target / f"{name}.{to}" for name in names or made]
    for file in files:
        check_new(file, overwrite=overwrite)
    for file in files:
        with whole_file(file) as path:
            made[file.stem].save(path)
    if not quiet:
        say([f"{len(files)} figures -> {target}/"])
    return 0


def overlay(
    run: Path,
    /,
    *,
    film: Path | None = None,
    frames: str | None = None,
    out: Path | None = None,
    overwrite: Flag = False,
    quiet: Flag = False,
) -> int:
    """The film of a finished run with its tracks drawn on it, as MP4: to see whether they follow the sheets.

    Examples:

        track overlay test_tracks

        track overlay test_tracks --frames 300:600 --film /archive/test.avi

    Parameters
    ----------
    run
        Run folder.
    film
        Where the film lies now, if not where it was when it was tracked.
    frames
        Part of the film, A:B, frame numbers as in tracks.csv.
    out
        The MP4; the run's name with _overlay.mp4 in the working directory by default.
    overwrite
        Replace a file that is there.
    quiet
        No progress bar and no summary.
    """
    from vision.run import check_new, read_run, whole_file
    from vision.run.overlay import film_of, write_overlay

    part = parse_range(frames, "--frames")
    made = read_run(run)
    target = out or Path(f"{made.folder.resolve().name}_overlay.mp4")
    if target.suffix.lower() != ".mp4":
        raise InputError("`out`", "a name that ends in .mp4", f"'{target}'")
    check_new(target, overwrite=overwrite)
    source = film_of(made, film)
    with frame_progress("drawing", quiet=quiet) as progress, whole_file(target) as path:
        written = write_overlay(made, source, path, frames=part, progress=progress)
    if not quiet:
        rows, columns = written.shape
        size = f"{written.frames} frames of {columns} x {rows} px"
        megabytes = target.stat().st_size / 1e6
        say([f"{size}, played at {written.fps:g} frames/s, {megabytes:.1f} MB -> {target}"])
    return 0


def certify(
    run: Path,
    /,
    *,
    films: int = 3,
    most_frames: int = 600,
    out: Path | None = None,
    overwrite: Flag = False,
    quiet: Flag = False,
) -> int:
    """What the recording of a finished run can resolve, from films like it whose truth is known.

    Films are put together from the run's own mean ridges, light, motion and residuals, and go through the
    same analysis. certificate.html says on one page how large the error of each sheet is, the smallest sweep
    in a stick, the pull towards whole pixels, how safe identities are, and the bias of σ_x/Λ_st at the
    threshold; certificate.csv and certificate.json hold the numbers. Exit status 1 where something is not
    covered.

    Examples:

        track certify test_tracks

        track certify test_tracks --films 6 --out certified

    Parameters
    ----------
    run
        Run folder.
    films
        Films made. More take longer and average over more encounters of noise and motion.
    most_frames
        Frames imitated, from the middle of the run.
    out
        Folder; the run's name with _certificate in the working directory by default.
    overwrite
        Replace an earlier certificate.
    quiet
        No summary.
    """
    from vision.certify import CertifySettings, certify_run, write_certificate
    from vision.certify.page import statements
    from vision.run import read_run

    for name, value, least in (("--films", films, 1), ("--most-frames", most_frames, 30)):
        if value < least:
            raise InputError(name, f"a whole number from {least}", f"{value}")
    finished = read_run(run)
    target = out or Path(f"{finished.folder.resolve().name}_certificate")
    if (target / "certificate.json").exists() and not overwrite:
        raise InputError(
            target, "a new folder", "an earlier certificate", "give `overwrite` or another `out`"
        )
    if target.exists() and not target.is_dir():
        raise InputError(target, "a folder", "a file", "give another `out`")
    settings = replace(CertifySettings(), films=films, most_frames=most_frames)
    with frame_progress("films", quiet=quiet) as progress:
        certificate = certify_run(finished, settings=settings, progress=progress)
    write_certificate(certificate, target)
    said = statements(certificate)
    wide = max(len(name) for name, _ in said)
    lines = [*(f"{name:<{wide}}  {text}" for name, text in said), f"-> {target}/"]
    return conclude(lines, certificate.warnings, quiet=quiet)


def compare(
    *runs: Path,
    table: Path | None = None,
    main_sample: str | None = None,
    fix_yeff: float | None = None,
    out: Path | None = None,
    overwrite: Flag = False,
    report: Annotated[bool, Option(show_default=False)] = True,
    quiet: Flag = False,
) -> int:
    """Several finished tests side by side: one table, one μ, the collapse, the change points, the trends.

    Writes tests.csv (one row per run), trends.json, all_events.csv, figures.npz, collapse.png, trends.png,
    report.html and run.json. A run that cannot be used is named, the rest is done, and the exit status is 1.

    Examples:

        track compare old_tracks new_tracks --table tests.csv

        track compare --table tests.csv --main-sample A --out comparison

    Parameters
    ----------
    runs
        Run folders with a force recording; those that the table names if none is given.
    table
        CSV with any of the columns run,sample,V_mm_min,n_test,RH_percent,T_C.
    main_sample
        Sample whose Y_eff is held fixed for all tests; that of the first run if not given.
    fix_yeff
        Y_eff in GPa, where it is known otherwise.
    out
        Folder; comparison in the working directory if not given.
    overwrite
        Replace an earlier comparison.
    report
        Write report.html.
    quiet
        No summary.
    """
    from vision.comparison import compare as compare_runs
    from vision.comparison.comparison import summary_lines
    from vision.run import Origin, check_mark, check_target
    from vision.run.comparing import MARK, write_comparison

    target = out or Path("comparison")
    check_target(target, overwrite=overwrite)
    check_mark(target, MARK)
    found = compare_runs(runs, table, main_sample=main_sample, modulus_GPa=fix_yeff)
    origin = Origin(
        command=command_line(),
        inputs=[*(test.folder / "events.csv" for test in found.tests), *([table] if table else [])],
        parameters=parameters_given({"table": table, "main_sample": main_sample, "fix_yeff": fix_yeff}),
        options=option_names(),
    )
    write_comparison(found, target, origin, overwrite=overwrite, report=report)
    for line in (*found.failures, *found.warnings):
        complain(line)
    if not quiet:
        say([f"{len(found.tests)} tests -> {target}/", *summary_lines(found)])
    return 1 if found.failures or found.warnings else 0
