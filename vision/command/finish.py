"""The end of a run: the folder, the summary, the exit status."""

from __future__ import annotations

import shlex
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vision.command.console import complain, say
from vision.run.provenance import Parameter

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr
    from numpy.typing import NDArray

    from vision.clock import Clock
    from vision.command.pull import Pull
    from vision.models.fits_result import ModelFits
    from vision.video import Video


@dataclass(frozen=True)
class Run:
    """A finished measurement, before it is written.

    profile: I(x, t).  tracks: x(n, t).  started: by `time.perf_counter`.  seconds: wall clock of each stage.
    pull: the machine's side, None without a force recording.
    """

    recording: Video
    profile: xr.DataArray
    tracks: xr.Dataset
    options: dict[str, Parameter]
    started: float
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
    from vision.figures import figures_of, kymograph, overview, save_figures
    from vision.report import write_report
    from vision.run.folder import run_folder
    from vision.run.provenance import write_run_json
    from vision.video import reference_frame

    started, frame = time.perf_counter(), reference_frame(run.recording)
    results = _results(run, frame)
    figures, seconds = figures_of(results), run.seconds
    with run_folder(target, overwrite=overwrite) as folder:
        _write_tables(run, folder)
        save_figures(folder / "figures.npz", figures)
        for figure in (overview(figures), kymograph(figures)):
            if figure is not None:
                figure.save(folder / f"{figure.name}.png")
        written = time.perf_counter()
        inputs = [describe()]
        seconds |= {"tables and pictures": written - started}
        seconds |= {"waiting for the checksum": time.perf_counter() - written}
        facts = _facts(run, inputs)
        write_report(folder / "report.html", results, facts, figures=figures, options=OPTIONS)
        ended = time.perf_counter()
        seconds |= {"writing, in all": ended - started, "total": ended - run.started}
        write_run_json(folder, facts | {"seconds": seconds})


OPTIONS = {
    "pixel_size_um": "--pixel-size",
    "force": "--force",
    "offset_s": "--offset",
    "speed_mm_min": "--speed",
    "d0_mm": "--d0",
}


@dataclass(frozen=True, kw_only=True)
class _Results:
    """What figures and the report are made from."""

    strip: xr.DataArray
    tracks: xr.Dataset
    frame: NDArray[Any]
    pixel_size_um: float | None
    force: xr.Dataset | None = None
    sticks: pd.DataFrame | None = None
    clock: Clock | None = None
    motion: xr.Dataset | None = None
    shells: pd.DataFrame | None = None
    fits: ModelFits | None = None
    threshold: float = 0.1
    reasons: Mapping[str, str] = field(default_factory=dict)
    warnings: Sequence[str] = ()


def _results(run: Run, frame: NDArray[Any]) -> _Results:
    names = ("force", "sticks", "clock", "motion", "shells", "fits", "threshold")
    machine = {} if run.pull is None else {name: getattr(run.pull, name) for name in names}
    return _Results(
        strip=run.profile, tracks=run.tracks, frame=frame, pixel_size_um=run.pixel_size_um, **machine
    )


def _write_tables(run: Run, folder: Path) -> None:
    from vision.command.pull import write_pull
    from vision.run.kymograph import write_kymograph_tif
    from vision.run.tables import sheets_table, write_tracks_csv, write_tracks_nc

    size = run.pixel_size_um
    write_tracks_csv(run.tracks, folder / "tracks.csv", pixel_size_um=size)
    write_tracks_nc(run.tracks, folder / "tracks.nc", pixel_size_um=size)
    sheets_table(run.tracks).to_csv(folder / "sheets.csv", index=False, lineterminator="\n")
    write_kymograph_tif(run.profile, folder / "kymograph.tif", pixel_size_um=size)
    if run.pull is not None:
        write_pull(run.pull, folder)


def _facts(run: Run, inputs: list[dict[str, Any]]) -> dict[str, Any]:
    """What run.json holds."""
    from vision.command.pull import pull_facts
    from vision.run.provenance import describe_input
    from vision.run.summary import run_facts

    command = shlex.join(["track", *sys.argv[1:]])
    facts = run_facts(command, inputs, run.profile, run.tracks, run.options, run.seconds)
    if run.pull is not None:
        facts |= pull_facts(run.pull)
        facts["warnings"] += [*run.pull.warnings, *filter(None, [run.pull.problem])]
        facts["inputs"].append(describe_input(Path(run.options["force"].value)))
    return facts


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
