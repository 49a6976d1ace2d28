"""Run folders from Python: what was analysed is written to one, and one becomes an analysis again."""

from __future__ import annotations

import math
import tempfile
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr

from vision.command.settings import options_of, settings_of_run
from vision.data import FORCE, ForceMetadata, load_unit
from vision.errors import InputError
from vision.folder import check_target
from vision.pipeline import Analysis, Settings, open_force
from vision.run.provenance import Origin, Parameter, describe_input
from vision.run.reading import analyse_again, film_if_there, read_run
from vision.run.writing import write_run
from vision.video import video_files

OWN_FORCE = "force_recording.csv"
"""Force recording in a run folder, if it is no file as it was analysed."""


def save_run(analysis: Analysis, folder: str | Path, *, overwrite: bool = False, report: bool = True) -> Path:
    """Write the results of `analyse` to a run folder, as the command ``track`` does, and return its path.

    Other commands take the folder (``track review``, ``overlay``, ``export``, ``figures``, ``certify``), and
    `compare` does. Its run.json holds the settings, changed constants too. A force recording that is made of
    arrays, or was changed since it was read, is written to the folder (force_recording.csv).

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
    settings, own, force = analysis.settings, None, None
    if analysis.force is not None and (force := _file_of(analysis.force, settings)) is None:
        force, own = folder.absolute() / OWN_FORCE, _force_table(analysis.force)
        known = ForceMetadata.of(analysis.force)
        d0_mm = None if known.lacks_d0 else 0.0  # its column is the separation itself, if that is known
        d0_err_mm = None if math.isnan(known.d0_err_mm) else known.d0_err_mm
        settings = replace(settings, d0_mm=d0_mm, d0_err_mm=d0_err_mm, speed_mm_min=None, force_columns=None)
    # A review expects the film first and the force recording last.
    times = analysis.settings.timestamps
    film = () if analysis.video is None else (*video_files(analysis.video.path), times)
    inputs = [file for file in (*film, force) if file is not None]
    if analysis.video is not None and settings.pixel_size_um == analysis.video.facts.pixel_size_um:
        settings = replace(settings, pixel_size_um=None)  # it was not given
    parameters = options_of(settings) | {
        "force": Parameter(force, "default" if force is None else "given"),
        "report": Parameter(report, "given"),
    }
    facts = {"force_alone": True} if analysis.tracks is None else None
    command = "analysed from Python"
    with tempfile.TemporaryDirectory() as place:
        described, further = {}, []
        if own is not None and force is not None:
            own.to_csv(table := Path(place) / OWN_FORCE, index=False)
            described, further = {force: describe_input(table) | {"path": str(force)}}, [table]
        origin = Origin(command=command, inputs=inputs, parameters=parameters, described=described)
        write_run(analysis, folder, origin, overwrite=overwrite, report=report, facts=facts, further=further)
    return folder


def _file_of(force: xr.Dataset, settings: Settings) -> Path | None:
    """Return the file of a force recording; None if it is made of arrays, or was changed after reading."""
    path = Path(ForceMetadata.of(force).source)
    if not path.is_file():
        return None
    with suppress(InputError):
        read = open_force(path, settings)
        if all(np.array_equal(read[name], force[name], equal_nan=True) for name in FORCE.needs or ()):
            return path
    return None


def _force_table(force: xr.Dataset) -> pd.DataFrame:
    """Return a force recording as a table that `read_force` reads."""
    unit = load_unit(force)
    columns = {"time (s)": "time_s", f"load ({unit})": "load_N", "displacement (mm)": "d_mm"}
    columns |= {"video time (s)": "video_time_s"} if "video_time_s" in force else {}
    return pd.DataFrame({header: force[name].values for header, name in columns.items()})


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
