"""Write what was analysed from Python to a run folder, which every command takes."""

from __future__ import annotations

from pathlib import Path

from vision.command.settings import parameters_of
from vision.data import ForceMetadata
from vision.errors import InputError
from vision.folder import check_target
from vision.pipeline import Analysis
from vision.run.provenance import Origin, Parameter
from vision.run.writing import write_run
from vision.video import video_files


def save_run(analysis: Analysis, folder: str | Path, *, overwrite: bool = False, report: bool = True) -> Path:
    """Write the results of `analyse` to a run folder, as the command ``track`` does, and return its path.

    Other commands take the folder (``track review``, ``overlay``, ``export``, ``figures``, ``certify``), and
    `compare` does. Its run.json holds the settings, changed constants too.

    Parameters
    ----------
    analysis
        As returned by `analyse`, with the film's strip.
    folder
        The folder to write; an earlier run there is replaced with `overwrite`.
    overwrite
        Whether to replace an earlier run.
    report
        Whether to write report.html.

    Raises
    ------
    InputError
        If the folder exists (without `overwrite`), cannot be written, or the analysis has no results.
    """
    if not isinstance(analysis, Analysis):
        raise InputError("`analysis`", "what `analyse` returned", f"a {type(analysis).__name__}")
    folder = Path(folder)
    check_target(folder, overwrite=overwrite)
    force = None if analysis.force is None else Path(ForceMetadata.of(analysis.force).source)
    force = force if force is not None and force.is_file() else None
    # A review expects the film first and the force recording last.
    film = () if analysis.video is None else video_files(analysis.video.path)
    inputs = [*film, *(file for file in (analysis.settings.timestamps, force) if file is not None)]
    parameters = parameters_of(analysis.settings) | {
        "force": Parameter(force, "default" if force is None else "given"),
        "report": Parameter(report, "given"),
    }
    stated_um = None if analysis.video is None else analysis.video.facts.pixel_size_um
    if analysis.settings.pitch_um is not None or analysis.pixel_size_um == stated_um is not None:
        parameters["pixel_size"] = Parameter(analysis.pixel_size_um, "found")
    origin = Origin(command="analysed from Python", inputs=inputs, parameters=parameters)
    facts = {"force_alone": True} if analysis.tracks is None else None
    write_run(analysis, folder, origin, overwrite=overwrite, report=report, facts=facts)
    return folder
