"""The machine's side of a run: the force recording meets the tracks."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vision.command.options import number
from vision.errors import InputError
from vision.figures.labels import plus_minus

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from vision.clock import Clock
    from vision.models.fits_result import ModelFits


LEAST_UNMATCHED = 3  # slips on either side: fewer may all have been missed by the other


@dataclass
class Pull:
    """What came of the force recording, as far as it got.

    problem: why it got no further; what was found before that stays.  warnings: what must be said.
    """

    force: xr.Dataset
    sticks: pd.DataFrame | None = None
    clock: Clock | None = None
    motion: xr.Dataset | None = None
    shells: pd.DataFrame | None = None
    fits: ModelFits | None = None
    threshold: float = 0.1
    problem: str = ""
    warnings: list[str] = field(default_factory=list)


def read_recording(value: Mapping[str, Any]) -> xr.Dataset | None:
    """The force recording named by --force; None without one.  Raises: InputError."""
    number(value["threshold"], "--threshold", least=1e-6)
    number(value["force_lowpass"], "--force-lowpass", least=0)
    if value["force"] is None:
        return None
    from vision.force.columns import parse_columns
    from vision.force.recording import read_force

    columns = parse_columns(value["force_columns"]) if value["force_columns"] else None
    return read_force(
        Path(value["force"]),
        speed_mm_min=number(value["speed"], "--speed", least=1e-9),
        d0_mm=number(value["d0"], "--d0", least=0),
        columns=columns,
    )


def analyse(force: xr.Dataset, tracks: xr.Dataset, value: Mapping[str, Any]) -> Pull:
    """Events, models, clocks, deformation and shells, one after the other as far as the data go.

    A stage that the data do not allow ends the analysis with its reason in `problem`; nothing is raised for
    input that does not fit, because the tracking is already done and must be kept.
    """
    pull = Pull(force, threshold=float(value["threshold"]))
    pull.warnings += [line for line in str(force.attrs["warnings"]).split("\n") if line]
    try:
        _fill(pull, tracks, value)
    except InputError as error:
        pull.problem = str(error)
    return pull


def _fill(pull: Pull, tracks: xr.Dataset, value: Mapping[str, Any]) -> None:
    """Stage after stage; what is there when one of them raises InputError stays."""
    from vision.clock import synchronise
    from vision.deformation import horizontal_deformation
    from vision.force.stickslip import find_stick_slip
    from vision.shells import classify_shells

    sticks = pull.sticks = find_stick_slip(
        pull.force, threshold_N=value["force_threshold"], lowpass_s=value["force_lowpass"]
    )
    pull.fits, note = model_fits(pull.force, sticks)
    pull.warnings += [note] if note else []
    clock = pull.clock = synchronise(tracks, pull.force, sticks, offset_s=value["offset"])
    pull.warnings += list(clock.warnings)
    _check_given(clock)
    if clock.status == "ambiguous":  # its warning says so; frames cannot be told to stick phases
        return
    motion = pull.motion = horizontal_deformation(tracks, sticks, clock, pixel_size_um=value["pixel_size"])
    model = pull.fits.effective_sheets if pull.fits else None
    pull.shells = classify_shells(motion, threshold=pull.threshold, effective_sheets=model)


def _check_given(clock: Clock) -> None:
    """A clock at which nothing coincides would cut the frames at the wrong places: refused."""
    seen = min(clock.unmatched_video, clock.unmatched_force)
    if clock.status == "given" and clock.matched == 0 and seen >= LEAST_UNMATCHED:
        raise InputError(
            "the clocks",
            "slips that coincide in video and force",
            f"none of {clock.unmatched_video} and {clock.unmatched_force} at the clock that was told "
            f"({clock.how})",
            "check --offset, or whether the two files belong together",
        )


def model_fits(force: xr.Dataset, sticks: pd.DataFrame, **options: Any) -> tuple[ModelFits | None, str]:
    """The fits to the force alone, or None and the reason why there are none.  options: of `fit_models`."""
    from vision.models.fits import fit_models

    if force["load_N"].attrs["units"] == "1":
        return None, "no model fits: they need a force in N, not over a weight"
    if math.isnan(force.attrs["d0_mm"]):
        return None, "no model fits: they need the initial separation, --d0"
    try:
        return fit_models(sticks, **options), ""
    except InputError as error:
        return None, f"no model fits: {error}"


def write_pull(pull: Pull, folder: Path) -> None:
    """events.csv, models.json, clock.json, deformation.csv and shells.csv, those that there are."""
    from vision.shells import deformation_table

    if pull.sticks is not None:
        write_table(pull.sticks, folder / "events.csv")
    if pull.fits is not None:
        write_json(pull.fits.to_json(), folder / "models.json")
    if pull.clock is not None:
        write_json(pull.clock.to_json(), folder / "clock.json")
    if pull.motion is not None:
        write_table(deformation_table(pull.motion, threshold=pull.threshold), folder / "deformation.csv")
    if pull.shells is not None:
        write_table(pull.shells, folder / "shells.csv")


def write_table(table: pd.DataFrame, path: Path) -> None:
    """CSV with nine digits."""
    table.to_csv(path, index=False, float_format="%.9g", lineterminator="\n")


def write_json(content: Mapping[str, Any], path: Path) -> None:
    """Strict JSON, to be read by people too."""
    text = json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8")


def pull_facts(pull: Pull) -> dict[str, Any]:
    """For run.json: what the recording was read as, the events' thresholds, the clocks."""
    told = {key: value for key, value in pull.force.attrs.items() if key not in ("notes", "warnings")}
    facts: dict[str, Any] = {"force": told, "force_problem": pull.problem}
    if pull.sticks is not None:
        facts["events"] = {"found": len(pull.sticks), **pull.sticks.attrs}
    if pull.clock is not None:
        facts["clock"] = pull.clock.to_json()
    return facts


def pull_lines(pull: Pull) -> list[str]:
    """For the summary: events, clocks, stick phases in the video, shells."""
    lines = []
    if pull.sticks is not None:
        lines.append(
            f"events     {len(pull.sticks)} stick-slip events; {event_sizes(pull.force, pull.sticks)}; "
            f"{force_chain(pull.sticks)}"
        )
    if pull.fits is not None:
        fits = pull.fits
        lines.append(
            f"models     μ {plus_minus(fits.mu)}, A {plus_minus(fits.amplitude)}, "
            f"N̂ {plus_minus(fits.n_hat_N)} N"
        )
    if pull.clock is not None:
        clock = pull.clock
        lines.append(
            f"clocks     {clock.status}: offset {clock.offset_s:.4f} s, drift {clock.drift_ppm:.0f} ppm, "
            f"{clock.matched} slips matched"
            + (f" to {clock.residual_ms:.1f} ms" if math.isfinite(clock.residual_ms) else "")
        )
    if pull.shells is not None and pull.motion is not None:
        size = pull.shells["stiff_sheets"].dropna().astype(float)
        found = f"{size.median():.0f} ({size.min():.0f} to {size.max():.0f})" if len(size) else "not known"
        lines.append(
            f"shells     {pull.motion.sizes['event']} stick phases in the video; stiff sheets a side {found}"
        )
    return lines


def event_sizes(force: xr.Dataset, sticks: pd.DataFrame) -> str:
    """Medians of ΔF, Λ_st and K, in the unit of the load."""
    middle = sticks.median(numeric_only=True)
    over_weight = force["load_N"].attrs["units"] == "1"
    drop, slope = (" of the weight", "/mm") if over_weight else (" N", " N/mm")
    sizes = f"median ΔF {middle['dF_N']:.3g}{drop}"
    if math.isnan(middle["stick_length_um"]):
        return f"{sizes}; lengths and K not known without the separation"
    return f"{sizes}, Λ_st {middle['stick_length_um']:.3g} µm, K {middle['K_N_per_mm']:.4g}{slope}"


def force_chain(sticks: pd.DataFrame) -> str:
    """What was made of the force chain's low-pass."""
    lowpass_ms = 1e3 * float(sticks.attrs["lowpass_s"])
    if sticks.attrs["lowpass_how"] == "doubtful":
        return "tails after slips are of no single low-pass, none undone (--force-lowpass)"
    if not lowpass_ms:
        return "no low-pass undone"
    return f"low-pass of {lowpass_ms:.2g} ms ({sticks.attrs['lowpass_how']}) undone"
