"""`track figures RUN` or `track figures --compare DIR`: the report's figures for a manuscript."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from vision.command.console import say
from vision.command.options import Flag
from vision.errors import InputError


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
    from vision.run import read_run, whole_file

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
    if taken := [file for file in files if file.exists() and not overwrite]:
        raise InputError(taken[0], "a new file", "one that exists", "give `overwrite` or another `out`")
    for file in files:
        with whole_file(file) as path:
            made[file.stem].save(path)
    if not quiet:
        say([f"{len(files)} figures -> {target}/"])
    return 0
