"""Commands on finished runs: export, figures, overlay, certify, compare."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from vision.certify import CertifySettings, certify_run, statements, write_certificate
from vision.command.console import complain, conclude, frame_progress, in_columns, say
from vision.command.options import OutputOptions, option_names
from vision.command.settings import parameters_given, parse_range
from vision.command.track import command_line
from vision.comparison import compare as compare_runs
from vision.comparison.comparison import summary_lines
from vision.errors import InputError
from vision.figures import load_figures
from vision.run import Origin, check_mark, check_new, check_target, export_run, read_run, whole_file
from vision.run.comparing import MARK, write_comparison
from vision.run.export import Format
from vision.run.overlay import film_of, write_overlay


def export(run: Path, to: Format, output: OutputOptions) -> int:
    """Tables of a run for another program; the exit status."""
    exported = export_run(read_run(run), to, out=output.out, overwrite=output.overwrite)
    for note in exported.notes:
        complain(note)
    if not output.quiet:
        folder = "/" if exported.target.is_dir() else ""
        say([f"{to} -> {exported.target}{folder}"])
    return 0


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
    if not output.quiet:
        say([f"{len(files)} figures -> {target}/"])
    return 0


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
    if not output.quiet:
        rows, columns = written.shape
        size = f"{written.frames} frames of {columns} x {rows} px"
        megabytes = target.stat().st_size / 1e6
        say([f"{size}, played at {written.fps:g} frames/s, {megabytes:.1f} MB -> {target}"])
    return 0


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
    settings = replace(CertifySettings(), films=films, most_frames=most_frames)
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
