"""Commands on recordings of machines, without a film: force, friction, modulus."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vision.command.console import complain, one_line, say
from vision.command.options import (
    Flag,
    ForceOptions,
    SampleOptions,
    merged,
    option_names,
    parameters_given,
    parse_pair,
    settings_of,
)
from vision.command.track import command_line, finish
from vision.errors import InputError, known_as

if TYPE_CHECKING:
    import pandas as pd

    from vision.figures import Figure
    from vision.models.friction import DiscFriction, FrictionSettings, StaticFriction
    from vision.run import Origin


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
    from vision.data import ForceMetadata
    from vision.pipeline import analyse
    from vision.run import Origin, check_target, write_run

    parameters = merged(machine or ForceOptions(), sample or SampleOptions(), config=config)
    target = out or Path(f"{file.stem}_force")
    check_target(target, overwrite=overwrite)
    settings = replace(settings_of(parameters), t_star_fitted=free_t_star)
    analysis = analyse(None, file, settings)
    parameters |= parameters_given({"free_t_star": free_t_star})
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


# --- single sheets ------------------------------------------------------------------------------------------


def _write(
    target: Path,
    overwrite: bool,
    origin: Origin,
    started: float,
    *,
    figure: Figure,
    tables: Mapping[str, pd.DataFrame],
    content: Mapping[str, Any],
    facts: Mapping[str, Any],
) -> None:
    """The run folder: tables, figures.npz, run.json, and a JSON file and a picture named like the figure."""
    from vision.figures import save_figures
    from vision.run import run_folder, write_json
    from vision.run.tables import write_table

    with run_folder(target, overwrite=overwrite) as folder:
        for name, table in tables.items():
            write_table(table, folder / f"{name}.csv")
        write_json(content, folder / f"{figure.name}.json")
        figure.save(folder / f"{figure.name}.png")
        save_figures(folder / "figures.npz", [figure])
        write_json(
            {**origin.facts(), **facts, "seconds": {"total": time.perf_counter() - started}},
            folder / "run.json",
        )


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
    overwrite: Flag = False,
    quiet: Flag = False,
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
    from vision.figures.labels import plus_minus
    from vision.figures.single_sheets import modulus_figure
    from vision.force import parse_columns, read_force
    from vision.models import Estimate
    from vision.models.modulus import ModulusSettings, measure_cycles, summarise_modulus
    from vision.run import Origin, check_target
    from vision.sample import Sample

    started = time.perf_counter()
    target = out or Path(f"{file.stem}_modulus")
    check_target(target, overwrite=overwrite)
    sizes = {"thickness_mm": thickness, "width_mm": width, "length_mm": length}
    shares = parse_pair(part, "--part", "two shares A:B with 0 <= A < B <= 1", most=1)
    with known_as(columns="force_columns"):
        force = read_force(file, columns=parse_columns(force_columns) if force_columns else None)
    cycles = measure_cycles(
        force,
        sheet=Sample(thickness_mm=thickness, width_mm=width, length_mm=length),
        clamp_distance_mm=clamp_distance,
        machine_stiffness_N_per_mm=machine_stiffness,
        settings=ModulusSettings(part=shares),
    )
    means = summarise_modulus(cycles)
    published = {"thickness_mm": 0.1, "width_mm": 45.0, "length_mm": 16.8}
    typed = sizes | {
        "clamp_distance_mm": clamp_distance,
        "machine_stiffness_N_per_mm": machine_stiffness,
        "part": part,
        "force_columns": force_columns,
    }
    notes, warnings = list(cycles.attrs["notes"]), list(cycles.attrs["warnings"])
    if sizes == published:
        notes.append("the publication's sheet is assumed: ε = 0.1, W = 45, L = 16.8 mm")
    _write(
        target,
        overwrite,
        Origin(
            command=command_line(),
            inputs=[file],
            parameters=parameters_given(typed, published | {"part": "0.4:0.9"}),
        ),
        started,
        figure=modulus_figure(force, cycles, clamp_distance_mm=clamp_distance),
        tables={"cycles": cycles},
        content={
            **means,
            "cycles": len(cycles),
            "sheet": sizes,
            "clamp_distance_from": cycles.attrs["clamp_distance_from"],
            "machine_stiffness_N_per_mm": machine_stiffness,
            "notes": notes,
        },
        facts={"cycles": len(cycles), "notes": notes, "warnings": warnings},
    )
    if not quiet:
        lines = [f"{len(cycles)} loading branches -> {target}"]
        for name, key in (("Y_p = |F0|/(εW)", "Y_p_GPa"), ("kL/(εW)", "Y_slope_GPa")):
            mean = means[key]
            scatter = f", scatter {mean.scatter:.2g}" if len(cycles) > 1 else ""
            lines.append(f"{name} {plus_minus(Estimate(mean.value, mean.error))} GPa{scatter}")
        lines.append(
            f"peak {means['F_max_N'].value:.4g} N, drifting by {means['drift_N'].value:.2g} N a cycle; "
            f"tangent K {means['K_tangent_N_per_mm'].value:.4g} N/mm; loop {means['loop_mJ'].value:.3g} mJ"
        )
        say([*lines, *notes])
    for line in warnings:
        complain(f"{file.name}: {line}")
    return 1 if warnings else 0


def friction(
    *files: Path,
    radius: float = 25.0,
    normal_force: str | None = None,
    dynamic: str = "0.3:120",
    mu: float = 0.89,
    out: Path | None = None,
    overwrite: Flag = False,
    quiet: Flag = False,
) -> int:
    """Static and dynamic friction of two sheets from a rheometer's files, and the law μ_s = a(1 + b/N).

    Writes friction.csv, friction.json, run.json, friction.png and figures.npz. A file or measurement that
    cannot be used is named, the others are done, and the exit status is 1.

    Parameters
    ----------
    files
        RheoCompass exports (UTF-16 or UTF-8, several results and intervals), TRIOS exports, or tables with
        units.
    radius
        Radius of the discs in mm.
    normal_force
        Normal force in N in place of a recorded one: one number for all files, or one a file, as in
        0.1,0.5,1.
    dynamic
        Travelled angles in degrees over which the dynamic coefficient is the mean.
    mu
        Constant coefficient with which the thresholds are compared.
    out
        Run folder; by default FIRSTFILE_friction in the working directory.
    overwrite
        Replace an existing run folder.
    quiet
        No summary on standard output.
    """
    from vision.figures.single_sheets import friction_figure
    from vision.models.friction import RIM_CAVEAT, FrictionSettings, friction_table
    from vision.run import Origin, check_target

    started = time.perf_counter()
    if not files:
        raise InputError("track friction", "one or more files", "none", "name the rheometer's files")
    target = out or Path(f"{files[0].stem}_friction")
    check_target(target, overwrite=overwrite)
    wanted = "two angles A:B in degrees with 0 <= A < B"
    settings = FrictionSettings(dynamic_deg=parse_pair(dynamic, "--dynamic", wanted))
    found = _measure(files, _loads(normal_force, len(files)), radius, settings)
    if not found.measured:
        for line in found.failures:
            complain(line)
        return 2
    law, why = _law(found)
    notes = [*found.notes, *([why] if why else [])]
    typed = {"radius_mm": radius, "normal_force_N": normal_force, "dynamic_deg": dynamic, "mu": mu}
    usual = {"radius_mm": 25.0, "dynamic_deg": "0.3:120", "mu": 0.89}
    content: dict[str, Any] = dict.fromkeys(("a", "a_err", "b_N", "b_err_N", "chi2_dof"))
    content |= asdict(law) if law else {}
    crossing_N = law.crossing_N(mu) if law and mu > law.a else None
    _write(
        target,
        overwrite,
        Origin(
            command=command_line(),
            inputs=[file for file in files if file.is_file()],
            parameters=parameters_given(typed, usual),
        ),
        started,
        figure=friction_figure(found.measured, found.curves, law, mu=mu, dynamic_deg=settings.dynamic_deg),
        tables={"friction": friction_table(found.measured)},
        content=content
        | {"mu": mu, "thresholds_equal_at_N": crossing_N, "caveat": RIM_CAVEAT, "notes": notes},
        facts={
            "measurements": len(found.measured),
            "failures": found.failures,
            "notes": [*notes, RIM_CAVEAT],
            "warnings": found.warnings,
        },
    )
    if not quiet:
        count = f"{len(found.measured)} measurements of {len(files)} files"
        say([f"{count} -> {target}", *_friction_summary(found, law), RIM_CAVEAT])
    for line in [*found.failures, *found.warnings, *([why] if why else [])]:
        complain(line)
    return 1 if found.failures or found.warnings else 0


@dataclass
class _Found:
    """What the files gave: coefficients with their curves, what failed, and remarks."""

    measured: list[DiscFriction] = field(default_factory=list)
    curves: list[pd.DataFrame] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def warnings(self) -> list[str]:
        return [
            f"{Path(one.source).name}, {one.measurement}: {line}"
            for one in self.measured
            for line in one.warnings
        ]


def _measure(
    files: Sequence[Path], loads: Sequence[float | None], radius_mm: float, settings: FrictionSettings
) -> _Found:
    """Each file and each measurement by itself: one that fails is named and the others are done."""
    from vision.models.friction import friction_curve, friction_of_disc
    from vision.models.rheometer import read_rheometer

    found = _Found()
    for file, load in zip(files, loads, strict=True):
        try:
            rotations = read_rheometer(file)
        except (InputError, OSError) as error:
            found.failures.append(one_line(error))
            continue
        found.failures += [f"{file}: {line}" for line in rotations[0].attrs["left_out"]]
        for rotation in rotations:
            found.notes += [f"{file.name}: {line}" for line in rotation.attrs["notes"]]
            options: dict[str, Any] = {"radius_mm": radius_mm, "normal_force_N": load, "settings": settings}
            try:
                one, curve = friction_of_disc(rotation, **options), friction_curve(rotation, **options)
            except InputError as error:
                found.failures.append(str(error))
                continue
            found.measured.append(one)
            found.curves.append(curve)
    return found


def _law(found: _Found) -> tuple[StaticFriction | None, str]:
    """The fitted law, or None and the reason why there is none."""
    from vision.models.friction import fit_static_friction, friction_table

    table = friction_table(found.measured)
    try:
        law = fit_static_friction(table["N_N"], table["mu_s"], table["mu_s_err"])
    except InputError as error:
        return None, f"no law fitted: {error}"
    if law.chi2_dof > 1:
        found.notes.append(
            f"sheets differ by more than the errors of single measurements (χ²/dof {law.chi2_dof:.3g}): "
            "errors of a and b are scaled by its square root"
        )
    return law, ""


def _friction_summary(found: _Found, law: StaticFriction | None) -> list[str]:
    from vision.figures.labels import plus_minus
    from vision.models import Estimate

    lines = [
        f"N {one.N_N:.4g} N: μ_s {plus_minus(Estimate(one.mu_s, one.mu_s_err))}, "
        f"μ_d {plus_minus(Estimate(one.mu_d, one.mu_d_err))}"
        for one in found.measured
    ]
    if law is not None:
        a, b = Estimate(law.a, law.a_err), Estimate(law.b_N, law.b_err_N)
        lines.append(f"μ_s = a(1 + b/N): a {plus_minus(a)}, b {plus_minus(b)} N")
    return lines


def _loads(text: str | None, files: int) -> list[float | None]:
    if text is None:
        return [None] * files
    try:
        loads: list[float | None] = [float(part) for part in text.split(",")]
    except ValueError:
        loads = []
    if len(loads) not in (1, files) or not all(load is not None and 0 < load < 1e9 for load in loads):
        raise InputError("--normal-force", f"one positive number, or {files} with commas", f"'{text}'")
    return loads * files if len(loads) == 1 else loads
