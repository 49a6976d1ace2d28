"""`track force FILE`: stick-slip events, stiffness and model fits from a force recording alone."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter as Option

from vision.command.console import complain, say
from vision.command.options import number
from vision.command.pull import event_sizes, force_chain, model_fits, write_json, write_table
from vision.figures.labels import plus_minus

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from vision.models.fits_result import ModelFits


def force(
    file: Path,
    /,
    *,
    speed: float | None = None,
    d0: float | None = None,
    force_columns: str | None = None,
    force_threshold: float | None = None,
    force_lowpass: float | None = None,
    machine_stiffness: float | None = None,
    t_star: float = 0.003,
    free_t_star: Annotated[bool, Option(negative="")] = False,
    detection_limit: Annotated[bool, Option(negative="")] = False,
    out: Path | None = None,
    overwrite: Annotated[bool, Option(negative="")] = False,
    quiet: Annotated[bool, Option(negative="")] = False,
) -> int:
    """Stick-slip events, stiffness and model fits from a force recording alone.

    Writes events.csv, models.json, run.json and force.png. Exit status 1 if a warning matters.

    Parameters
    ----------
    file
        Recording of a testing machine: text, CSV, .TRA or .mat.
    speed
        Pulling speed V in mm/min, where no displacement is recorded.
    d0
        Initial separation in mm, added to the crosshead; 0 if the column is the separation itself.
    force_columns
        Columns by name or number, as in time=Time,load=Load:kN,displacement=3.
    force_threshold
        Smallest drop that is a slip, N; found from the noise if absent.
    force_lowpass
        Time constant of the force chain's filter, s, which is undone; found from the slips if absent, 0 for
        none.
    machine_stiffness
        The machine's own stiffness in N/mm, to correct d; no correction if absent.
    t_star
        Friction force T* of the adhering sheets in N, held fixed.
    free_t_star
        Fit T* too (it can hardly be told from the friction coefficient).
    detection_limit
        Also put small known slips into the recording and look for them.
    out
        Run folder; by default FILE_force in the working directory.
    overwrite
        Replace an existing run folder.
    quiet
        No summary on standard output.
    """
    from vision.force.columns import parse_columns
    from vision.force.recording import read_force
    from vision.force.stickslip import find_stick_slip
    from vision.run.folder import check_target

    start = time.perf_counter()
    target = out or Path(f"{file.stem}_force")
    check_target(target, overwrite=overwrite)
    columns = parse_columns(force_columns) if force_columns else None
    recording = read_force(file, speed_mm_min=speed, d0_mm=d0, columns=columns)
    sticks = find_stick_slip(
        recording,
        threshold_N=force_threshold,
        machine_stiffness_N_per_mm=machine_stiffness,
        lowpass_s=number(force_lowpass, "--force-lowpass", least=0),
    )
    fits, note = model_fits(recording, sticks, t_star_N=t_star, free_t_star=free_t_star)
    facts = _facts(recording, sticks, note, _limit(recording, sticks) if detection_limit else None)
    facts["parameters"] = _parameters(
        speed_mm_min=speed,
        d0_mm=d0,
        force_columns=force_columns,
        force_threshold_N=force_threshold,
        force_lowpass_s=force_lowpass,
        machine_stiffness_N_per_mm=machine_stiffness,
        t_star_N=t_star,
        free_t_star=free_t_star,
    )
    _write(target, overwrite, recording, sticks, fits, facts, start)
    if not quiet:
        say(_summary(target, recording, sticks, fits))
    for line in [*facts["warnings"], *facts["notes"]]:
        complain(f"{file.name}: {line}")
    return 1 if facts["warnings"] else 0


def _limit(recording: xr.Dataset, sticks: pd.DataFrame) -> dict[str, Any]:
    from vision.force.detection import detection_limit

    table = detection_limit(recording, sticks)
    return {"limit_N": table.attrs["limit_N"], "tried": table.to_dict("records")}


def _facts(
    recording: xr.Dataset, sticks: pd.DataFrame, note: str, limit: dict[str, Any] | None
) -> dict[str, Any]:
    from vision.run.provenance import describe_input, versions

    told = {key: value for key, value in recording.attrs.items() if key not in ("notes", "warnings")}
    notes = [line for line in (*recording.attrs["notes"].split("\n"), note) if line]
    return {
        "command": " ".join(sys.argv),
        "versions": versions(),
        "inputs": [describe_input(Path(recording.attrs["path"]))],
        "force": told,
        "events": {"found": len(sticks), "whole": int((sticks["flag"] == "ok").sum()), **sticks.attrs},
        "detection_limit": limit,
        "notes": notes,
        "warnings": [line for line in recording.attrs["warnings"].split("\n") if line],
    }


def _parameters(**values: Any) -> dict[str, Any]:
    from vision.run.provenance import Parameter

    defaults = {"t_star_N": 0.003, "free_t_star": False}
    return {
        name: Parameter(value, "default" if value == defaults.get(name) else "given")
        for name, value in values.items()
    }


def _write(
    target: Path,
    overwrite: bool,
    recording: xr.Dataset,
    sticks: pd.DataFrame,
    fits: ModelFits | None,
    facts: dict[str, Any],
    start: float,
) -> None:
    from vision.figures import force_overview_figure
    from vision.run.folder import run_folder
    from vision.run.provenance import write_run_json

    with run_folder(target, overwrite=overwrite) as folder:
        write_table(sticks, folder / "events.csv")
        write_json(fits.to_json() if fits else {"fixed": {}, "notes": facts["notes"]}, folder / "models.json")
        force_overview_figure(recording, sticks, fits).save(folder / "force.png")
        write_run_json(folder, {**facts, "timings": {"total_s": time.perf_counter() - start}})


def _summary(target: Path, recording: xr.Dataset, sticks: pd.DataFrame, fits: ModelFits | None) -> list[str]:
    lines = [
        f"{len(sticks)} stick-slip events, {int((sticks['flag'] == 'ok').sum())} without a flag -> {target}",
        f"drop above {sticks.attrs['threshold_N']:.3g} ({sticks.attrs['threshold_how']}), "
        f"noise {sticks.attrs['noise_N']:.2g}, spikes {sticks.attrs['spikes']}, {force_chain(sticks)}",
        event_sizes(recording, sticks),
    ]
    if fits:
        named = {"mu": fits.mu, "T0 (N)": fits.t0_N, "A": fits.amplitude, "N_hat (N)": fits.n_hat_N}
        named["Y_eff (GPa)"] = fits.modulus_GPa
        lines.append(", ".join(f"{name} {plus_minus(e)}" for name, e in named.items()))
    return lines
