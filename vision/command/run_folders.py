"""Run folders from Python: what was analysed is written to one, and one becomes an analysis again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from vision.command.settings import options_of, settings_of_run
from vision.data import ForceMetadata
from vision.errors import InputError
from vision.folder import check_target
from vision.pipeline import Analysis
from vision.run.provenance import Origin, Parameter
from vision.run.reading import analyse_again, film_if_there, read_run
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
    times = analysis.settings.timestamps
    film = () if analysis.video is None else (*video_files(analysis.video.path), times)
    inputs = [file for file in (*film, force) if file is not None]
    settings = analysis.settings
    if analysis.video is not None and settings.pixel_size_um == analysis.video.facts.pixel_size_um:
        settings = replace(settings, pixel_size_um=None)  # it was not given
    parameters = options_of(settings) | {
        "force": Parameter(force, "default" if force is None else "given"),
        "report": Parameter(report, "given"),
    }
    origin = Origin(command="analysed from Python", inputs=inputs, parameters=parameters)
    facts = {"force_alone": True} if analysis.tracks is None else None
    write_run(analysis, folder, origin, overwrite=overwrite, report=report, facts=facts)
    return folder


def load_run(
    folder: str | Path, *, film: str | Path | None = None, force: str | Path | None = None
) -> Analysis:
    """Return the analysis of a run folder, of the command or of `save_run`, for its figures and datasets.

    Strip, tracks and clock are those of the folder. The other stages run again, with the settings of the run
    and with this version of the program, which takes seconds.

    Parameters
    ----------
    folder
        The run folder.
    film, force
        New paths of the film and the force recording, if they were moved without the run. Without its film,
        an analysis lacks the image of a frame.

    Raises
    ------
    InputError
        If the folder is no run or is damaged, or the force recording is missing or another one.
    """
    run = read_run(Path(folder))
    settings = replace(settings_of_run(run.folder), corrections=tuple(run.applied))
    return analyse_again(run, settings, film_if_there(run, settings, film, asked=True), run.force(force))
