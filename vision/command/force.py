"""`track force FILE`: stick-slip events, stiffness and model fits from a force recording alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from vision.command.console import complain
from vision.command.options import Flag, ForceOptions, SampleOptions, merged, option_names, settings_of
from vision.command.track import command_line, finish


def force(
    file: Path,
    /,
    machine: ForceOptions | None = None,
    sample: SampleOptions | None = None,
    *,
    free_t_star: Flag = False,
    detection_limit: Flag = False,
    config: Path | None = None,
    out: Path | None = None,
    overwrite: Flag = False,
    quiet: Flag = False,
) -> int:
    """Stick-slip events, stiffness and model fits from a force recording alone.

    Writes events.csv, models.json, run.json and force.png. Exit status 1 if a warning matters.

    Parameters
    ----------
    file
        Recording of a testing machine: text, CSV, .TRA or .mat.
    machine
        How the recording is read.
    sample
        Geometry of the sample.
    free_t_star
        Fit T* too (it can hardly be told from the friction coefficient).
    detection_limit
        Also put small known slips into the recording and look for them.
    config
        TOML file with any of these options; the command line wins.
    out
        Run folder; by default FILE_force in the working directory.
    overwrite
        Replace an existing run folder.
    quiet
        No summary on standard output.
    """
    parameters = merged(machine or ForceOptions(), sample or SampleOptions(), config=config)
    from vision.data import ForceMetadata
    from vision.pipeline import analyse
    from vision.run import Origin, Parameter, check_target, write_run

    target = out or Path(f"{file.stem}_force")
    check_target(target, overwrite=overwrite)
    settings = replace(settings_of(parameters), t_star_fitted=free_t_star)
    analysis = analyse(None, file, settings)
    parameters["free_t_star"] = Parameter(free_t_star, "given" if free_t_star else "default")
    origin = Origin(command=command_line(), inputs=(file,), parameters=parameters, options=option_names())
    facts = {"detection_limit": _limit(analysis) if detection_limit else None}
    write_run(analysis, target, origin, overwrite=overwrite, facts=facts)
    if analysis.force is not None:
        for note in ForceMetadata.of(analysis.force).notes:
            complain(f"{file.name}: {note}")
    return finish(analysis, target, "force.png", quiet=quiet)


def _limit(analysis: Any) -> dict[str, Any] | None:
    """The smallest slip that is found, and what was tried."""
    if analysis.sticks is None:
        return None
    from vision.force import detection_limit

    table = detection_limit(analysis.force, analysis.sticks)
    return {"limit_N": table.attrs["limit_N"], "tried": table.to_dict("records")}
