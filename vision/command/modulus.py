"""`track modulus FILE`: Young's modulus of one sheet from push–pull cycles."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter as Option

from vision.command.console import complain, say
from vision.command.track import command_line
from vision.errors import InputError, known_as


def modulus(
    file: Path,
    /,
    *,
    thickness: float = 0.1,
    width: float = 45.0,
    length: float = 16.8,
    clamp_distance: float | None = None,
    machine_stiffness: float | None = None,
    part: str = "0.4:0.9",
    force_columns: str | None = None,
    out: Path | None = None,
    overwrite: Annotated[bool, Option(negative="")] = False,
    quiet: Annotated[bool, Option(negative="")] = False,
) -> int:
    """Young's modulus of one sheet from push–pull cycles.

    Writes cycles.csv, modulus.json, run.json, modulus.png and figures.npz. Exit status 1 if a
    warning matters.

    Parameters
    ----------
    file
        Recording of a testing machine with time, load and displacement.
    thickness
        Of the sheet, mm.
    width
        Of the sheet, mm.
    length
        Between the clamps, mm.
    clamp_distance
        Distance of the clamps at the first sample, mm, where it is neither the displacement nor the length.
    machine_stiffness
        The machine's own stiffness in N/mm, to correct the distance; no correction if absent.
    part
        Part of the rise of the force on each loading branch that is fitted.
    force_columns
        Columns by name or number, as in time=Time,load=Load:kN,displacement=3.
    out
        Run folder; by default FILE_modulus in the working directory.
    overwrite
        Replace an existing run folder.
    quiet
        No summary on standard output.
    """
    from vision.figures import save_figures
    from vision.figures.labels import plus_minus
    from vision.figures.single_sheets import modulus_figure
    from vision.force.columns import parse_columns
    from vision.force.recording import read_force
    from vision.models import Estimate
    from vision.models.modulus import ModulusSettings, measure_cycles, summarise_modulus
    from vision.run.folder import check_target, run_folder
    from vision.run.provenance import Origin, Parameter, write_json
    from vision.run.tables import write_table
    from vision.sample import Sample

    start = time.perf_counter()
    target = out or Path(f"{file.stem}_modulus")
    check_target(target, overwrite=overwrite)
    sheet = Sample(thickness_mm=thickness, width_mm=width, length_mm=length)
    settings = ModulusSettings(part=_part(part))
    with known_as(columns="force_columns"):
        force = read_force(file, columns=parse_columns(force_columns) if force_columns else None)
    cycles = measure_cycles(
        force,
        sheet=sheet,
        clamp_distance_mm=clamp_distance,
        machine_stiffness_N_per_mm=machine_stiffness,
        settings=settings,
    )
    means = summarise_modulus(cycles)
    given = {
        "thickness_mm": (thickness, 0.1),
        "width_mm": (width, 45.0),
        "length_mm": (length, 16.8),
        "clamp_distance_mm": (clamp_distance, None),
        "machine_stiffness_N_per_mm": (machine_stiffness, None),
        "part": (part, "0.4:0.9"),
        "force_columns": (force_columns, None),
    }
    notes, warnings = list(cycles.attrs["notes"]), list(cycles.attrs["warnings"])
    if (thickness, width, length) == (0.1, 45.0, 16.8):
        notes.append("the publication's sheet is assumed: ε = 0.1, W = 45, L = 16.8 mm")
    content = {
        **{name: mean.to_json() for name, mean in means.items()},
        "cycles": len(cycles),
        "sheet": {"thickness_mm": thickness, "width_mm": width, "length_mm": length},
        "clamp_distance_from": cycles.attrs["clamp_distance_from"],
        "machine_stiffness_N_per_mm": machine_stiffness,
        "notes": notes,
    }
    parameters = {
        name: Parameter(value, "default" if value == usual else "given")
        for name, (value, usual) in given.items()
    }
    facts = Origin(command=command_line(), inputs=[file], parameters=parameters).facts() | {
        "cycles": len(cycles),
        "notes": notes,
        "warnings": warnings,
    }
    with run_folder(target, overwrite=overwrite) as folder:
        write_table(cycles, folder / "cycles.csv")
        write_json(content, folder / "modulus.json")
        figure = modulus_figure(force, cycles, clamp_distance_mm=clamp_distance)
        figure.save(folder / "modulus.png")
        save_figures(folder / "figures.npz", [figure])
        write_json({**facts, "seconds": {"total": time.perf_counter() - start}}, folder / "run.json")
    if not quiet:
        named = {"Y_p = |F0|/(εW)": "Y_p_GPa", "kL/(εW)": "Y_slope_GPa"}
        lines = [f"{len(cycles)} loading branches -> {target}"]
        for name, key in named.items():
            mean = means[key]
            scatter = f", scatter {mean.scatter:.2g}" if len(cycles) > 1 else ""
            lines.append(f"{name} {plus_minus(Estimate(mean.value, mean.error))} GPa{scatter}")
        say([*lines, *notes])
    for line in warnings:
        complain(f"{file.name}: {line}")
    return 1 if warnings else 0


def _part(text: str) -> tuple[float, float]:
    low, _, high = text.partition(":")
    try:
        first, last = float(low), float(high)
    except ValueError:
        first, last = 0.0, 0.0
    if not 0 <= first < last <= 1:
        raise InputError("--part", "two shares A:B with 0 <= A < B <= 1", f"'{text}'")
    return first, last
