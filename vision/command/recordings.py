"""Commands without a video (force, friction, modulus), and simulate, which makes a synthetic test."""

from __future__ import annotations

import math
import shlex
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from inspect import cleandoc
from pathlib import Path
from typing import Annotated, Any

import pandas as pd
from cyclopts import Parameter as Option

from vision.command.console import complain, conclude, frame_progress, one_line
from vision.command.options import (
    Config,
    ForceOptions,
    FrictionOptions,
    ModulusOptions,
    OutputOptions,
    SampleOptions,
    SimulateOptions,
    Switch,
    flag_of,
)
from vision.command.settings import (
    at_least,
    merged,
    parameters_given,
    parse_pair,
    parse_with_error,
    settings_of,
)
from vision.command.track import finish, origin_of
from vision.errors import InputError, counted, known_as
from vision.experiment import preset as ready_made
from vision.experiment import setting_names, settings_from_toml, with_settings
from vision.experiment import simulate as make_test
from vision.figures import Figure, save_figures
from vision.figures.single_sheets import friction_figure, modulus_figure
from vision.files import expanded
from vision.folder import write_csv, write_json
from vision.force import parse_columns, read_force
from vision.models import Estimate, both_errors, plus_minus
from vision.models import friction as discs
from vision.models import modulus as push_pull
from vision.models.rheometer import RotationMetadata, read_rheometer
from vision.numeric import number, with_minus
from vision.pipeline import analyse
from vision.run.provenance import checksum_of, describe_input
from vision.run.reading import check_results
from vision.run.writing import results_folder, write_run
from vision.sample import Sample
from vision.summary import aligned


def force(
    file: Annotated[Path, Option(help="Recording of a testing machine: text, CSV, .TRA, .xlsx or .mat.")],
    /,
    machine: ForceOptions = ForceOptions(),
    sample: SampleOptions = SampleOptions(),
    *,
    free_t_star: Annotated[
        Switch, Option(help="Also fit T* (the data hardly separate it from the friction coefficient).")
    ] = False,
    config: Config = None,
    output: OutputOptions = OutputOptions(),
) -> int:
    """Find stick-slip events, stiffness and model fits from a force recording alone.

    Writes the folder FILE_force: events.csv, models.json, run.json and force.png. Exit status 1 if there is a
    warning that matters.
    """
    parameters = merged(machine, sample, config=config)
    target = output.out or Path(f"{file.stem}_force")
    check_results(target, overwrite=output.overwrite, mark="force_alone")
    analysis = analyse(None, file, replace(settings_of(parameters), t_star_fitted=free_t_star))
    parameters |= parameters_given(output, free_t_star=free_t_star, config=config)
    inputs = (file,) if config is None else (file, config)
    origin = origin_of(inputs, parameters)
    write_run(analysis, target, origin, overwrite=output.overwrite, facts={"force_alone": True})
    return finish(analysis, target, "force.png", quiet=output.quiet)


# --- single sheets ------------------------------------------------------------------------------------------


def modulus(
    file: Annotated[Path, Option(help="Recording of a testing machine with time, load and displacement.")],
    /,
    options: ModulusOptions = ModulusOptions(),
    *,
    output: OutputOptions = OutputOptions(),
) -> int:
    """Measure Young's modulus of one sheet from push–pull cycles.

    Writes the folder FILE_modulus: cycles.csv, modulus.json, run.json, modulus.png and figures.npz. Exit
    status 1 if there is a warning that matters.
    """
    started = time.perf_counter()
    target = output.out or Path(f"{file.stem}_modulus")
    check_results(target, overwrite=output.overwrite, mark="cycles")
    wanted = "two shares A:B with 0 <= A < B <= 1"
    shares = parse_pair(options.part, "--part", wanted, most=1, example="0.4:0.9")
    columns = parse_columns(options.force_columns) if options.force_columns else None
    with known_as(columns="force_columns"):
        force = read_force(file, columns=columns)
    names = ("thickness", "width", "length")
    sizes = {f"{name}_mm": parse_with_error(getattr(options, name), flag_of(name)) for name in names}
    size: dict[str, Any] = {name: value for name, (value, _) in sizes.items()}
    sheet_err = {name: error for name, (_, error) in sizes.items() if error is not None}
    sheet = Sample(**size)
    cycles = push_pull.measure_cycles(
        force,
        sheet=sheet,
        clamp_distance_mm=options.clamp_distance,
        machine_stiffness_N_per_mm=options.machine_stiffness,
        settings=push_pull.ModulusSettings(part=shares),
    )
    means = push_pull.summarise_modulus(cycles, sheet_err)
    measured = push_pull.CyclesMetadata.of(cycles)
    notes, warnings = list(measured.notes), measured.warnings
    if sheet == push_pull.PUBLISHED_SHEET:
        notes.append("sheet of ε = 0.1, W = 45, L = 16.8 mm, the publication's size")
    origin = origin_of([file], parameters_given(options, output))
    content = {
        **means,
        "cycles": len(cycles),
        "sheet": size,
        "sheet_err": sheet_err,
        "clamp_distance_from": measured.clamp_distance_from,
        "machine_stiffness_N_per_mm": options.machine_stiffness,
        "notes": origin.named(notes),
    }
    facts = {**origin.facts(warnings=warnings, notes=notes), "cycles": len(cycles)}
    figure = modulus_figure(force, cycles)
    with results_folder(target, facts, started=started, overwrite=output.overwrite) as folder:
        _write(folder, "cycles", cycles, figure, content)
    lines = [f"{len(cycles)} loading branches -> {target}/", *_modulus_lines(means, len(cycles)), *notes]
    return conclude(lines, [f"{file.name}: {line}" for line in warnings], quiet=output.quiet)


def _modulus_lines(means: Mapping[str, push_pull.MeanValue], cycles: int) -> list[str]:
    """Return the moduli, forces and losses as text."""
    lines = []
    for name, key in (("Y_p = |F0|/(εW)", "Y_p_GPa"), ("kL/(εW)", "Y_slope_GPa")):
        mean = means[key]
        scatter = f", scatter {mean.scatter:.2g} GPa" if cycles > 1 else ""
        lines.append(f"{name} {both_errors(mean)} GPa{scatter}")
    others = {
        "peak {:.4g} N": "F_max_N",
        "drifting by {:.2g} N per cycle": "drift_N",
        "tangent K {:.4g} N/mm": "K_tangent_N_per_mm",
        "loop {:.3g} mJ": "loop_mJ",
    }
    known = [text.format(means[key].value) for text, key in others.items() if math.isfinite(means[key].value)]
    return [*lines, with_minus("; ".join(known))] if known else lines


def friction(
    *files: Annotated[
        Path,
        Option(
            help="RheoCompass exports (UTF-16 or UTF-8, several results and intervals), or tables with units."
        ),
    ],
    options: FrictionOptions = FrictionOptions(),
    output: OutputOptions = OutputOptions(),
) -> int:
    """Measure friction of two sheets from rheometer files, and fit μ_s = a(1 + b/N).

    Writes the folder FIRSTFILE_friction: friction.csv, friction.json, run.json, friction.png and figures.npz.
    A file or measurement that cannot be used is named, the others are used, and the exit status is 1.
    """
    started = time.perf_counter()
    files = expanded(files)
    if not files:
        raise InputError("track friction", "one or more files", "none", "name the rheometer's files")
    target = output.out or Path(f"{files[0].stem}_friction")
    check_results(target, overwrite=output.overwrite, mark="measurements")
    wanted = "two angles A:B in degrees with 0 <= A < B"
    at_least(options.mu, "--mu", 1e-9)
    angles = parse_pair(options.dynamic, "--dynamic", wanted, example="0.3:120")
    settings = discs.FrictionSettings(dynamic_deg=angles)
    loads = _loads(options.normal_force, len(files))
    measured, failures, notes = _measure(files, loads, options.radius, settings)
    if not measured:
        for line in failures:
            complain(line)
        return 2
    law, note = _law(measured)
    notes += filter(None, [note])
    warnings = [
        f"{Path(one.source).name}, {one.measurement}: {line}" for one in measured for line in one.warnings
    ]
    origin = origin_of([file for file in files if file.is_file()], parameters_given(options, output))
    content: dict[str, Any] = dict.fromkeys(("a", "a_err", "b_N", "b_err_N", "chi2_dof"))
    content |= asdict(law) if law else {}
    content |= {
        "mu": options.mu,
        "thresholds_equal_at_N": law.crossing_N(options.mu) if law and options.mu > law.a else None,
        "caveat": discs.RIM_CAVEAT,
        "notes": origin.named(notes),
    }
    facts = origin.facts(failures=failures, warnings=warnings, notes=[*notes, discs.RIM_CAVEAT])
    facts |= {"measurements": len(measured)}
    figure = friction_figure(measured, law, mu=options.mu, dynamic_deg=settings.dynamic_deg)
    with results_folder(target, facts, started=started, overwrite=output.overwrite) as folder:
        _write(folder, "friction", discs.friction_table(measured), figure, content)
    if law is None:
        complain(note)
    count = f"{counted(len(measured), 'measurement')} of {counted(len(files), 'file')}"
    lines = [f"{count} -> {target}/", *_friction_summary(measured, law), discs.RIM_CAVEAT]
    return conclude(lines, warnings, failures=failures, quiet=output.quiet)


def _write(folder: Path, name: str, table: pd.DataFrame, figure: Figure, content: Mapping[str, Any]) -> None:
    """Write a table, figures.npz, and JSON and picture named like the figure."""
    write_csv(table, folder / f"{name}.csv")
    write_json(content, folder / f"{figure.name}.json")
    figure.save(folder / f"{figure.name}.png")
    save_figures(folder / "figures.npz", [figure])


def _measure(
    files: Sequence[Path], loads: Sequence[float | None], radius_mm: float, settings: discs.FrictionSettings
) -> tuple[list[discs.DiscFriction], list[str], list[str]]:
    """Return the friction in every measurement of every file, failures (one line each), and notes.

    A file or measurement that fails costs no other. A copy of a file that came before fails, as its
    measurements would count twice.
    """
    first: dict[str, Path] = {}
    measured: list[discs.DiscFriction] = []
    failures: list[str] = []
    notes: list[str] = []
    for file, load in zip(files, loads, strict=True):
        try:
            rotations = read_rheometer(file)
            other = first.setdefault(checksum_of(describe_input(file)), file)
            if other is not file:
                found = f"the content of {other}, which would count twice"
                raise InputError(file, "a file of other measurements", found, "leave one of them out")
        except (InputError, OSError) as error:
            failures.append(one_line(error))
            continue
        failures += [f"{file}: {line}" for line in RotationMetadata.of(rotations[0]).left_out]
        for rotation in rotations:
            notes += [f"{file.name}: {line}" for line in RotationMetadata.of(rotation).notes]
            try:
                one = discs.friction_of_disc(
                    rotation, radius_mm=radius_mm, normal_force_N=load, settings=settings
                )
                measured.append(one)
            except InputError as error:
                failures.append(str(error))
    return measured, failures, notes


def _law(measured: Sequence[discs.DiscFriction]) -> tuple[discs.StaticFriction | None, str]:
    """Return the fitted law and a note on it, "" for none; or None and the reason why there is none."""
    table = discs.friction_table(measured)
    try:
        law = discs.fit_static_friction(table["N_N"], table["mu_s"], table["mu_s_err"])
    except InputError as error:
        return None, f"no law fitted: {error}"
    if law.chi2_dof <= 1:
        return law, ""
    return law, (
        f"sheets differ by more than the errors of single measurements (χ²/dof {law.chi2_dof:.3g}): "
        "errors of a and b are scaled by its square root"
    )


def _friction_summary(measured: Sequence[discs.DiscFriction], law: discs.StaticFriction | None) -> list[str]:
    lines = [
        f"N = {one.N_N:.4g} N: μ_s {plus_minus(Estimate(one.mu_s, one.mu_s_err))}, "
        f"μ_d {plus_minus(Estimate(one.mu_d, one.mu_d_err))}"
        for one in measured
    ]
    if law is not None:
        a, b = Estimate(law.a, law.a_err), Estimate(law.b_N, law.b_err_N)
        lines.append(f"μ_s = a(1 + b/N): a {plus_minus(a)}, b {plus_minus(b)} N")
    return lines


def _loads(text: str | None, files: int) -> list[float | None]:
    """Return the normal force typed for each file, None to take the recorded one.  Raises: InputError."""
    if text is None:
        return [None] * files
    loads = [number(part) for part in text.split(",")]
    if len(loads) not in (1, files) or not all(0 < load < 1e9 for load in loads):
        raise InputError("--normal-force", f"one positive number, or {files} with commas", f"'{text}'")
    return [*loads] * files if len(loads) == 1 else [*loads]


# --- a synthetic test ---------------------------------------------------------------------------------------


def simulate(
    directory: Annotated[Path, Option(help="Folder to make.")],
    /,
    options: SimulateOptions = SimulateOptions(),
) -> int:
    """Make a synthetic traction test: a film, a force recording, and their truth.

    Writes video.*, force.txt, truth.nc and the camera's timestamps.txt. Settings are taken from the preset,
    then the TOML file, then the options, then --set; later ones override.
    """
    experiment = ready_made(options.preset)
    changes = settings_from_toml(options.config) if options.config else {}
    typed = {"seed": options.seed, "camera.duration_s": options.duration}
    changes |= {name: value for name, value in typed.items() if value is not None}
    changes |= dict(map(_pair, options.set_))
    experiment = with_settings(experiment, changes)  # at once, as some settings are valid only with others
    container, overwrite = options.container, options.overwrite
    with frame_progress("drawing", quiet=options.quiet) as progress:
        test = make_test(experiment, directory, container=container, overwrite=overwrite, progress=progress)
    lost = f", {test.frames_lost} lost" if test.frames_lost else ""
    size = f"{experiment.camera.width} x {experiment.camera.height} px, {experiment.ridges_in_view} sheets"
    files = {"video": test.video, "force": test.force, "truth": test.truth, "stamps": test.timestamps}
    lines = [f"{test.frames} frames{lost} of {size}, seed {experiment.seed}"]
    scale, d0 = f"{experiment.camera.pixel_size_um:g}", f"{experiment.mechanics.d0_mm:g}"
    track = ["track", str(test.video), "--pixel-size", scale, "--timestamps", str(test.timestamps)]
    track += ["--force", str(test.force), "--d0", d0]
    rows = [*((name, str(path)) for name, path in files.items()), ("next", shlex.join(track))]
    rows += [("offset", f"{experiment.clocks.offset_s:g} s: give --offset if the clocks are ambiguous")]
    lines += aligned(rows)
    return conclude(lines, (), quiet=options.quiet)


simulate.__doc__ = f"{cleandoc(simulate.__doc__ or '')}\n\n{setting_names()}"


def _pair(text: str) -> tuple[str, str]:
    """Parse `GROUP.SETTING=VALUE`.  Raises: InputError."""
    name, equals, value = text.partition("=")
    if not equals:
        raise InputError("--set", "GROUP.SETTING=VALUE", text)
    return name.strip(), value.strip()
