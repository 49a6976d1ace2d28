"""The end of a run: the folder, the summary, the exit status."""

from __future__ import annotations

import shlex
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vision.command.console import complain, say
from vision.run.provenance import Parameter

if TYPE_CHECKING:
    import numpy as np
    import xarray as xr
    from numpy.typing import NDArray

    from vision.command.pull import Pull
    from vision.video import Video


@dataclass(frozen=True)
class Run:
    """A finished measurement, before it is written.

    profile: I(x, t).  tracks: x(n, t).  seconds: wall clock of each stage.  pull: the machine's side, None
    without a force recording.
    """

    recording: Video
    profile: xr.DataArray
    tracks: xr.Dataset
    options: dict[str, Parameter]
    seconds: dict[str, float]
    pull: Pull | None

    @property
    def pixel_size_um(self) -> float | None:
        """µm per pixel, None where it was not given."""
        value = self.options["pixel_size"].value
        return None if value is None else float(value)


def write(run: Run, target: Path, describe: Callable[[], dict[str, Any]], *, overwrite: bool) -> None:
    """The run folder, whole or not at all.

    describe: waits for the video's size and checksum.  Raises: InputError where it cannot be written.
    """
    from vision.report.kymograph import write_kymograph_picture
    from vision.report.overview import write_overview
    from vision.run.folder import run_folder
    from vision.run.kymograph import write_kymograph_tif
    from vision.run.tables import sheets_table, write_tracks_csv, write_tracks_nc
    from vision.spacetime import space_time
    from vision.video import reference_frame

    started, size = time.perf_counter(), run.pixel_size_um
    frame = reference_frame(run.recording)
    with run_folder(target, overwrite=overwrite) as folder:
        write_tracks_csv(run.tracks, folder / "tracks.csv", pixel_size_um=size)
        write_tracks_nc(run.tracks, folder / "tracks.nc", pixel_size_um=size)
        sheets_table(run.tracks).to_csv(folder / "sheets.csv", index=False, lineterminator="\n")
        write_kymograph_tif(run.profile, folder / "kymograph.tif", pixel_size_um=size)
        write_kymograph_picture(folder / "kymograph.png", [space_time(run.profile, pixel_size_um=size)])
        write_overview(folder / "overview.png", frame, run.profile, run.tracks, pixel_size_um=size)
        _write_pull(run, folder)
        run.seconds["writing"] = time.perf_counter() - started
        inputs = [describe()]
        run.seconds["waiting for the checksum"] = time.perf_counter() - started - run.seconds["writing"]
        _write_report(run, frame, _write_facts(run, inputs, folder), folder)


def _write_pull(run: Run, folder: Path) -> None:
    if run.pull is not None:
        from vision.command.pull import write_pull

        write_pull(run.pull, folder)


def _write_facts(run: Run, inputs: list[dict[str, Any]], folder: Path) -> dict[str, Any]:
    """run.json, and what it holds."""
    from vision.command.pull import pull_facts
    from vision.run.provenance import describe_input, write_run_json
    from vision.run.summary import run_facts

    command = shlex.join(["track", *sys.argv[1:]])
    facts = run_facts(command, inputs, run.profile, run.tracks, run.options, run.seconds)
    if run.pull is not None:
        facts |= pull_facts(run.pull)
        facts["warnings"] += run.pull.warnings
        facts["inputs"].append(describe_input(Path(run.options["force"].value)))
    write_run_json(folder, facts)
    return facts


def _write_report(run: Run, frame: NDArray[np.generic], facts: dict[str, Any], folder: Path) -> None:
    """report.html, and its figures for a manuscript in figures/."""
    from vision.report.figures import write_figures
    from vision.report.html import write_report
    from vision.report.results import RunResults

    pull = run.pull
    machine: dict[str, Any] = {}
    if pull is not None:
        names = ("force", "sticks", "clock", "motion", "shells", "fits", "threshold")
        machine = {name: getattr(pull, name) for name in names}
        machine["notes"] = (pull.problem,) if pull.problem else ()
    results = RunResults(
        profile=run.profile,
        tracks=run.tracks,
        frame=frame,
        facts=facts,
        pixel_size_um=run.pixel_size_um,
        **machine,
    )
    write_report(folder / "report.html", results)
    write_figures(folder / "figures", results)


def report(run: Run, target: Path, *, quiet: bool, verbose: bool) -> int:
    """Summary to standard output, warnings to standard error; the exit status.

    0: done.  1: a warning that matters.  2: the force recording could not be used (what was tracked is kept).
    """
    from vision.command.pull import pull_lines
    from vision.run.summary import findings, summary_lines, warnings_that_matter

    warnings = warnings_that_matter(run.profile, run.tracks) + (run.pull.warnings if run.pull else [])
    for line in warnings:
        complain(f"warning: {line}")
    if not quiet:
        lines = summary_lines(target, run.profile, run.tracks, run.options)
        lines[-1:-1] = pull_lines(run.pull) if run.pull else []
        if verbose:
            lines += [f"{name:>22}  {value}" for name, value in findings(run.profile, run.tracks).items()]
        say(lines)
    if run.pull and run.pull.problem:
        complain(f"{run.pull.problem} (the tracks are kept in {target})")
        return 2
    return 1 if warnings else 0
