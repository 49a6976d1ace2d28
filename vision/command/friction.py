"""`track friction FILE…`: friction of two sheets from a rheometer's files."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter as Option

from vision.command.console import complain, say
from vision.command.track import command_line
from vision.errors import InputError, with_options

if TYPE_CHECKING:
    import pandas as pd

    from vision.models.friction import DiscFriction, FrictionSettings, StaticFriction
    from vision.run.provenance import Parameter


def friction(
    *files: Path,
    radius: float = 25.0,
    normal_force: str | None = None,
    dynamic: str = "0.3:120",
    mu: float = 0.89,
    out: Path | None = None,
    overwrite: Annotated[bool, Option(negative="")] = False,
    quiet: Annotated[bool, Option(negative="")] = False,
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
    from vision.models.friction import RIM_CAVEAT, FrictionSettings
    from vision.run.folder import check_target
    from vision.run.provenance import Parameter

    start = time.perf_counter()
    if not files:
        raise InputError("track friction", "one or more files", "none", "name the rheometer's files")
    target = out or Path(f"{files[0].stem}_friction")
    check_target(target, overwrite=overwrite)
    settings = FrictionSettings(dynamic_deg=_angles(dynamic))
    found = _measure(files, _loads(normal_force, len(files)), radius, settings)
    if not found.measured:
        raise InputError(*_parts([with_options(line, _OPTIONS) for line in found.failures]))
    given = {"radius_mm": radius, "normal_force_N": normal_force, "dynamic_deg": dynamic, "mu": mu}
    usual = {"radius_mm": 25.0, "normal_force_N": None, "dynamic_deg": "0.3:120", "mu": 0.89}
    parameters = {
        name: Parameter(value, "default" if value == usual[name] else "given")
        for name, value in given.items()
    }
    law, why = _law(found)
    _write(target, overwrite, files, found, law, why, parameters, start)
    if not quiet:
        say([f"{len(found.measured)} measurements of {len(files)} files -> {target}", *_summary(found, law)])
        say([RIM_CAVEAT])
    for line in [*found.failures, *found.warnings, *([why] if why else [])]:
        complain(with_options(line, _OPTIONS))
    return 1 if found.failures or found.warnings else 0


_OPTIONS = {"normal_force_N": "--normal-force", "radius_mm": "--radius"}


@dataclass
class _Found:
    """What the files gave: coefficients with their curves, what failed, and remarks."""

    measured: list[DiscFriction] = field(default_factory=list)
    curves: list[pd.DataFrame] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    settings: FrictionSettings | None = None

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
    from vision.models.friction import friction_curve, friction_of_disc, read_rheometer

    found = _Found(settings=settings)
    for file, load in zip(files, loads, strict=True):
        try:
            rotations = read_rheometer(file)
        except (InputError, OSError) as error:
            found.failures.append(_line(error, file))
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


def _write(
    target: Path,
    overwrite: bool,
    files: Sequence[Path],
    found: _Found,
    law: StaticFriction | None,
    why: str,
    parameters: Mapping[str, Parameter],
    start: float,
) -> None:
    from vision.figures import save_figures
    from vision.figures.single_sheets import friction_figure
    from vision.models.friction import RIM_CAVEAT, friction_table
    from vision.run.folder import run_folder
    from vision.run.provenance import Origin, write_json
    from vision.run.tables import write_table

    mu, settings = float(parameters["mu"].value), found.settings
    notes = [*found.notes, *([why] if why else [])]
    content: dict[str, Any] = dict.fromkeys(("a", "a_err", "b_N", "b_err_N", "chi2_dof"))
    content |= law.to_json() if law else {}
    content |= {
        "mu": mu,
        "thresholds_equal_at_N": law.crossing_N(mu) if law and mu > law.a else None,
        "caveat": RIM_CAVEAT,
        "notes": notes,
    }
    read = [file for file in files if file.is_file()]
    facts = Origin(command=command_line(), inputs=read, parameters=parameters).facts() | {
        "measurements": len(found.measured),
        "failures": found.failures,
        "notes": [*notes, RIM_CAVEAT],
        "warnings": found.warnings,
    }
    assert settings is not None
    with run_folder(target, overwrite=overwrite) as folder:
        write_table(friction_table(found.measured), folder / "friction.csv")
        write_json(content, folder / "friction.json")
        figure = friction_figure(found.measured, found.curves, law, mu=mu, dynamic_deg=settings.dynamic_deg)
        figure.save(folder / "friction.png")
        save_figures(folder / "figures.npz", [figure])
        write_json({**facts, "seconds": {"total": time.perf_counter() - start}}, folder / "run.json")


def _summary(found: _Found, law: StaticFriction | None) -> list[str]:
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


def _angles(text: str) -> tuple[float, float]:
    low, _, high = text.partition(":")
    try:
        first, last = float(low), float(high)
    except ValueError:
        first, last = 0.0, 0.0
    if not 0 <= first < last < float("inf"):
        raise InputError("--dynamic", "two angles A:B in degrees with 0 <= A < B", f"'{text}'")
    return first, last


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


def _line(error: Exception, file: Path) -> str:
    if isinstance(error, OSError):
        reason = (error.strerror or str(error)).lower()
        error = InputError(file, "a file that can be read", reason)
    return str(error)


def _parts(failures: list[str]) -> tuple[str, str, str]:
    """One message where nothing at all could be used."""
    more = f" (and {len(failures) - 1} more)" if len(failures) > 1 else ""
    about, _, rest = failures[0].partition(": expected ")
    expected, _, found = rest.partition("; found ")
    return about, expected, found + more
