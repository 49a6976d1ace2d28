r"""Young's modulus of one sheet from push–pull cycles between two clamps.

The distance Δ of the clamps increases and decreases; while the sheet is taut, the force is F = kΔ + F0.
Source: Plati, Restagno & Poulard, appendix "Single sheets characterization".
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import pandas as pd
import scipy
import xarray as xr
from numpy.typing import ArrayLike

from vision.data import (
    FORCE,
    ForceMetadata,
    Metadata,
    Schema,
    Tunable,
    Variable,
    load_unit,
    record,
    with_word,
)
from vision.errors import InputError, check_positive
from vision.models.single_fits import Estimate
from vision.numeric import Floats, Ints, correlation_inflation
from vision.sample import LEAST_GPA, MOST_GPA, Sample, is_plausible_modulus
from vision.signals import running_mean

PUBLISHED_SHEET = Sample(length_mm=16.8)
"""The publication's single sheet between its clamps: ε = 0.1, W = 45, L = 16.8 mm."""


@dataclass(frozen=True, kw_only=True, repr=False)
class ModulusSettings(Tunable):
    """Tunable constants of the cycles and of the fit to a loading branch."""

    part: tuple[float, float] = (0.4, 0.9)
    """Part of the rise of the force on a loading branch that is fitted. A lower start includes the slack of a
    sheet that was pushed (`test_a_fit_from_the_slack_on_is_wrong`); a narrow part has larger errors."""
    smoothing: float = 0.02
    """Window of the running mean of Δ and F for finding turning points and levels, as a fraction of a branch.
    Larger rounds the turning points, smaller finds false ones in noise."""
    least_reversal: float = 0.2
    """Least movement back, as a fraction of the range of Δ, after a turning point. Larger misses cycles of
    growing amplitude, smaller mistakes a slip of the clamp for a cycle."""
    least_samples: int = 12
    """Fewest samples on the fitted part of a branch. Larger leaves out more branches; smaller fits lines to
    too few points for an error from their scatter."""
    origin_tolerance: float = 0.05
    """Difference of Δ0 from L, as a fraction of L, above which a warning is given. Larger passes a Y_p as
    wrong; smaller warns of the slack of a sheet (`test_a_position_that_is_not_the_distance`)."""


@dataclass(frozen=True, kw_only=True)
class CyclesMetadata(Metadata):
    """How the cycles were measured."""

    source: str = "the recording"  # path
    sheet: Sequence[float] = (math.nan,) * 3  # ε, W and L, mm
    clamp_distance_from: str = "given"  # or "column" (recorded) or "length" (Δ = L + crosshead)
    shift_mm: float = 0.0  # Δ minus the displacement of the crosshead, without the machine's correction
    machine_stiffness_N_per_mm: float = math.nan  # for which Δ was corrected; NaN without correction
    notes: Sequence[str] = field(default_factory=list)  # assumptions
    warnings: Sequence[str] = field(default_factory=list)  # possible errors of the numbers


_CYCLE = ("cycle",)
CYCLES = Schema(
    "cycles",
    "vision.models.modulus.measure_cycles",
    {
        "cycle": Variable(_CYCLE, "", "cycle number, from 1"),
        "k_N_per_mm": Variable(_CYCLE, "N/mm", "slope of the loading branch"),
        "k_err_N_per_mm": Variable(_CYCLE, "N/mm", "standard error of k"),
        "F0_N": Variable(_CYCLE, "N", "force extrapolated to Δ = 0"),
        "F0_err_N": Variable(_CYCLE, "N", "standard error of F0"),
        "Y_p_GPa": Variable(_CYCLE, "GPa", "|F0| / (εW)"),
        "Y_p_err_GPa": Variable(_CYCLE, "GPa", "standard error of Y_p"),
        "Y_slope_GPa": Variable(_CYCLE, "GPa", "kL / (εW)"),
        "Y_slope_err_GPa": Variable(_CYCLE, "GPa", "standard error of kL/(εW)"),
        "delta0_mm": Variable(_CYCLE, "mm", "Δ0 = −F0/k"),
        "delta0_err_mm": Variable(_CYCLE, "mm", "standard error of Δ0"),
        "loop_mJ": Variable(_CYCLE, "mJ", "energy lost in the cycle"),
        "residual_mm": Variable(_CYCLE, "mm", "Δ at F = 0, unloading minus loading"),
        "K_tangent_N_per_mm": Variable(_CYCLE, "N/mm", "slope after the turn from loading to unloading"),
        "drift_N": Variable(_CYCLE, "N", "largest force minus that of the cycle before"),
        "t_start_s": Variable(_CYCLE, "s", "start of the loading branch"),
        "t_end_s": Variable(_CYCLE, "s", "end of the loading branch"),
        "fit_from_mm": Variable(_CYCLE, "mm", "Δ where the fitted part starts"),
        "fit_to_mm": Variable(_CYCLE, "mm", "Δ where it ends"),
        "F_max_N": Variable(_CYCLE, "N", "largest force of the branch"),
        "samples": Variable(_CYCLE, "", "samples fitted"),
    },
    kind=pd.DataFrame,
)

# --- turning points -----------------------------------------------------------------------------------------


def turning_points(displacement: ArrayLike, *, settings: ModulusSettings = ModulusSettings()) -> Ints:
    """Indices of the samples at which a displacement reverses, including the first and the last sample; they
    alternate between minima and maxima. The displacement must not contain NaN; noise and steps of the
    resolution are smoothed."""
    raw = np.asarray(displacement, float)
    last = raw.size - 1
    if raw.size < 5 or float(np.ptp(raw)) == 0:
        return np.array([0, max(last, 0)], np.int64)
    turns = _extrema(raw, settings.least_reversal)
    if turns.size > 2:
        turns = _extrema(_smoothed(raw, turns, settings), settings.least_reversal)
    return turns


def _smoothed(values: Floats, turns: Ints, settings: ModulusSettings) -> Floats:
    """Return the running mean over a fraction of the median branch between turning points."""
    width = max(int(settings.smoothing * float(np.median(np.diff(turns)))), 1)
    return running_mean(values, width)


def _extrema(values: Floats, least: float) -> Ints:
    """Indices of the extrema with a prominence of `least` times the range, and of both ends."""
    prominence = least * float(np.ptp(values))
    # The padding lets values at the ends be extrema; they are removed and added again below.
    padded = np.concatenate([[values.min()], values, [values.min()]])
    high, _ = scipy.signal.find_peaks(padded, prominence=prominence)
    padded = np.concatenate([[values.max()], values, [values.max()]])
    low, _ = scipy.signal.find_peaks(-padded, prominence=prominence)
    inner = np.union1d(high, low).astype(np.int64) - 1
    inner = inner[(inner > 0) & (inner < values.size - 1)]
    # An extremum near an end value is noise beside that end.
    if inner.size and abs(values[inner[0]] - values[0]) < prominence:
        inner = inner[1:]
    if inner.size and abs(values[inner[-1]] - values[-1]) < prominence:
        inner = inner[:-1]
    return np.union1d(inner, [0, values.size - 1]).astype(np.int64)


# --- cycles -------------------------------------------------------------------------------------------------


def measure_cycles(
    force: xr.Dataset,
    *,
    sheet: Sample = PUBLISHED_SHEET,
    clamp_distance_mm: float | None = None,
    machine_stiffness_N_per_mm: float | None = None,
    settings: ModulusSettings = ModulusSettings(),
) -> pd.DataFrame:
    r"""Measure slope, offset and modulus of every loading branch.

    Parameters
    ----------
    force
        From `vision.read_force`, with a displacement.
    sheet
        ε, W and L of the sheet; its other fields are not used.
    clamp_distance_mm
        Δ at the first sample. By default the displacement is Δ itself if its median differs from L by less
        than L/2, else that of a crosshead that is 0 at Δ = L; a note states which.
    machine_stiffness_N_per_mm
        Stiffness of frame, load cell and clamps together; F divided by it is subtracted from Δ.
    settings
        See `ModulusSettings`.

    Returns
    -------
    pandas.DataFrame
        Columns as in `CYCLES`, one row per loading branch, ``attrs`` as in `CyclesMetadata`. NaN in
        ``K_tangent_N_per_mm`` and ``loop_mJ`` if the recording ends before the sheet is half or, for the
        latter, nearly unloaded, in ``F_max_N`` and ``drift_N`` if it ends before the turn, in ``residual_mm``
        if F does not return to 0, and in ``drift_N`` of the first cycle.

    Raises
    ------
    InputError
        If there is no displacement or no cycle, the load is not a force, the given machine stiffness is
        smaller than the measured one, or all branches have too few samples.

    Notes
    -----
    .. math:: F = k\Delta + F_0, \qquad \sigma_{F_0}^2 = s^2/n + \bar\Delta^2\sigma_k^2, \qquad
        Y_p = \frac{k\Delta_0}{\epsilon W} = \frac{|F_0|}{\epsilon W}, \qquad \Delta_0 = -F_0/k

    The publication prints Δ0 = k/F0, which has the wrong dimension. The slope and the length also give a
    modulus, kL/(εW). F0 is extrapolated from strains of a few per cent to Δ = 0, so k and F0 have nearly the
    same relative error, and an error of Δ enters in full: 1 % of L is 1 % of Y_p. Residuals with a
    correlation ρ between samples enlarge the errors by √((1 + ρ)/(1 − ρ)). Source: appendix "Single sheets
    characterization".
    """
    machine = machine_stiffness_N_per_mm
    check_positive(machine_stiffness_N_per_mm=machine)
    cycles, facts = _clean(force, sheet, clamp_distance_mm, machine or math.inf, settings)
    source = facts.source
    branches = _loading_branches(cycles)
    if not branches:
        reversals = max(cycles.turns.size - 2, 0)
        raise InputError(source, "push–pull cycles", f"a displacement that turns back {reversals} times")
    delta, load, rows = cycles.delta, cycles.load, []
    for start, stop, following in branches:
        fitted = _part(cycles.smooth, start, stop, settings.part)
        if (samples := fitted.stop - fitted.start) < settings.least_samples:
            continue
        times = {"t_start_s": float(cycles.time[start]), "t_end_s": float(cycles.time[stop])}
        fit = {"fit_from_mm": float(delta[fitted][0]), "fit_to_mm": float(delta[fitted][-1])}
        turned = stop < delta.size - 1  # else the recording ends before the largest force
        peak = float(cycles.smooth[start : stop + 1].max()) if turned else math.nan
        fit |= {"F_max_N": peak, "samples": samples}
        line = _line(delta[fitted], load[fitted], sheet)
        rows.append(line | _unloading(cycles, start, stop, following, sheet) | times | fit)
    if not rows:
        wanted = f"loading branches with {settings.least_samples} samples on the fitted part of their rise"
        raise InputError(source, wanted, "none", "is tension negative, or the recording too coarse?")
    if (least := min(row["k_N_per_mm"] for row in rows)) <= 0:
        advice = "`machine_stiffness_N_per_mm` may be too small" if machine else "is tension negative?"
        found = f"a slope of {least:.3g} N/mm"
        raise InputError(source, "a force that rises with Δ on loading branches", found, advice)
    table = pd.DataFrame(rows)
    table.insert(0, "cycle", np.arange(1, len(rows) + 1))
    table["drift_N"] = table["F_max_N"].diff()
    stiffness = math.nan if machine is None else machine
    skipped = len(branches) - len(rows)
    few = [f"{skipped} loading branches with too few samples"] if skipped else []
    meta = replace(
        facts,
        sheet=(sheet.thickness_mm, sheet.width_mm, sheet.length_mm),
        machine_stiffness_N_per_mm=stiffness,
        notes=[*facts.notes, *_remarks(table, sheet, stiffness)],
        warnings=[*facts.warnings, *few, *_implausible(table, sheet), *_off_origin(table, sheet, settings)],
    )
    table.attrs.update(meta.attrs())
    return record(table, "measure_cycles", machine_stiffness_N_per_mm=stiffness, part=settings.part)


def _implausible(table: pd.DataFrame, sheet: Sample) -> list[str]:
    """Return a warning if a modulus is implausible for a sheet, which reveals a wrong unit."""
    for name, symbol in (("Y_p_GPa", "Y_p"), ("Y_slope_GPa", "kL/(εW)")):
        if not is_plausible_modulus(modulus := float(table[name].mean())):
            size = f"{sheet.thickness_mm:g} x {sheet.width_mm:g} x {sheet.length_mm:g} mm"
            return [
                f"expected a modulus of {LEAST_GPA:g} to {MOST_GPA:g} GPa, as sheets have; found {symbol} = "
                f"{modulus:.2g} GPa for a sheet of {size}: check `thickness_mm`, `width_mm` and "
                "`length_mm` (mm) and the units of force and displacement"
            ]
    return []


def _off_origin(table: pd.DataFrame, sheet: Sample, settings: ModulusSettings) -> list[str]:
    """Return a warning if Δ is not the distance of the clamps, which Y_p assumes and kL/(εW) does not."""
    root = float(table["delta0_mm"].mean())
    if abs(root / sheet.length_mm - 1) <= settings.origin_tolerance:
        return []
    slope, extrapolated = (float(table[name].mean()) for name in ("Y_slope_GPa", "Y_p_GPa"))
    return [
        f"the force is 0 at Δ = {root:.4g} mm, where a sheet of L = {sheet.length_mm:g} mm has Δ = L: Y_p ="
        f" {extrapolated:.3g} GPa is wrong by as much, and kL/(εW) = {slope:.3g} GPa holds if L is right:"
        " give `length_mm`, or `clamp_distance_mm` (the distance of the clamps at the first sample)"
    ]


_ORIGINS = {
    "column": "the displacement is taken for the distance Δ of the clamps",
    "length": "the displacement is taken to be 0 at Δ = L = {length:g} mm",
}


def _origin(crosshead: Floats, sheet: Sample, clamp_distance_mm: float | None) -> tuple[str, float]:
    """Source of Δ as in `CyclesMetadata`, and Δ minus the displacement, mm."""
    if clamp_distance_mm is not None:
        check_positive(clamp_distance_mm=clamp_distance_mm)
        return "given", clamp_distance_mm - float(crosshead[0])
    recorded = abs(float(np.median(crosshead)) - sheet.length_mm) < sheet.length_mm / 2
    return ("column", 0.0) if recorded else ("length", sheet.length_mm)


class _Cycles(NamedTuple):
    """Usable samples of a recording."""

    time: Floats  # s
    delta: Floats  # Δ corrected for the machine, mm
    load: Floats  # N
    smooth: Floats  # smoothed load, N
    turns: Ints  # indices of the turning points


def _loading_branches(cycles: _Cycles) -> list[tuple[int, int, int | None]]:
    """Start, end, and end of the next unloading (None if cut off) of each branch on which Δ increases."""
    turns = cycles.turns
    if turns.size < 4:
        return []
    travel = np.diff(cycles.delta[turns])
    whole = np.abs(travel) > 0.5 * float(np.median(np.abs(travel)))  # others are cut off by the recording
    return [
        (int(turns[k]), int(turns[k + 1]), int(turns[k + 2]) if whole[k + 1 : k + 2].any() else None)
        for k in np.flatnonzero((travel > 0) & whole)
    ]


def _clean(
    force: xr.Dataset,
    sheet: Sample,
    clamp_distance_mm: float | None,
    machine_N_per_mm: float,
    settings: ModulusSettings,
) -> tuple[_Cycles, CyclesMetadata]:
    """Usable samples with their turning points, and the metadata with source, origin of Δ and warnings."""
    FORCE.check(force)
    source = ForceMetadata.of(force).source
    if "crosshead_mm" not in force:
        how = "rename its column in the header: displacement, crosshead, extension, position or stroke (mm)"
        raise InputError(source, "a displacement", "time and load only", how)
    if load_unit(force) != "N":
        raise InputError(source, "a load in N", f"units {load_unit(force)!r}")
    time = force["time_s"].values.astype(float)
    crosshead, load = force["crosshead_mm"].values.astype(float), force["load_N"].values.astype(float)
    usable = np.isfinite(time) & np.isfinite(crosshead) & np.isfinite(load)
    usable &= ~np.isin(force["flag"].values, ("saturated", "backwards", "repeated"))
    warnings = [] if usable.all() else [f"{int((~usable).sum())} of {usable.size} samples left out"]
    time, crosshead, load = time[usable], crosshead[usable], load[usable]
    if time.size < 5:
        raise InputError(source, "samples with time, displacement and load", f"{time.size}")
    how, shift = _origin(crosshead, sheet, clamp_distance_mm)
    delta = crosshead + shift
    notes = [_ORIGINS[how].format(length=sheet.length_mm)] if how != "given" else []
    facts = CyclesMetadata(
        source=source, clamp_distance_from=how, shift_mm=shift, notes=notes, warnings=warnings
    )
    turns = turning_points(delta, settings=settings)
    smooth = _smoothed(load, turns, settings)
    return _Cycles(time, delta - load / machine_N_per_mm, load, smooth, turns), facts


def _part(smooth: Floats, start: int, stop: int, part: tuple[float, float]) -> slice:
    """Contiguous samples of a branch between two fractions of the rise of the force."""
    branch = smooth[start : stop + 1]
    top = int(np.argmax(branch))
    low = int(np.argmin(branch[: top + 1]))
    level = branch[low] + np.asarray(part) * (branch[top] - branch[low])
    rise = branch[low : top + 1]
    first = low + int(np.flatnonzero(rise < level[0])[-1] + 1 if (rise < level[0]).any() else 0)
    last = low + int(np.argmax(rise >= level[1]))
    return slice(start + first, start + max(last, first))


def _line(delta: Floats, load: Floats, sheet: Sample) -> dict[str, float]:
    """Columns of the table that follow from the least-squares line F = kΔ + F0 through the samples. Standard
    errors are those of correlated residuals. Only k if it is not positive; -inf if Δ does not vary."""
    if not np.ptp(delta) > 0:
        return {"k_N_per_mm": -math.inf}
    line = scipy.stats.linregress(delta, load)
    slope, offset = float(line.slope), float(line.intercept)
    if slope <= 0:
        return {"k_N_per_mm": slope}
    widening = math.sqrt(correlation_inflation(load - slope * delta - offset, 0.99))
    slope_err, offset_err = widening * float(line.stderr), widening * float(line.intercept_stderr)
    mean_err = slope_err * float(delta.std())  # of the load at the mean of Δ
    area = 1000 * sheet.thickness_mm * sheet.width_mm
    return {
        "k_N_per_mm": slope,
        "k_err_N_per_mm": slope_err,
        "F0_N": offset,
        "F0_err_N": offset_err,
        "Y_p_GPa": abs(offset) / area,
        "Y_p_err_GPa": offset_err / area,
        "Y_slope_GPa": slope * sheet.length_mm / area,
        "Y_slope_err_GPa": slope_err * sheet.length_mm / area,
        "delta0_mm": -offset / slope,
        "delta0_err_mm": math.hypot(mean_err, float(load.mean()) / slope * slope_err) / slope,
    }


def _unloading(cycles: _Cycles, start: int, top: int, stop: int | None, sheet: Sample) -> dict[str, float]:
    """Columns of the unloading: energy lost in the cycle, change of Δ at F = 0, and slope after the turn. The
    slope is taken from 5 % to 25 % of the fall of the force, without the rounded turn itself. There the
    friction within the sample reverses and nothing slides yet, so it is the stiffness of the whole sample."""
    if stop is None:
        return dict.fromkeys(("loop_mJ", "residual_mm", "K_tangent_N_per_mm"), math.nan)
    delta, load, smooth = cycles.delta, cycles.load, cycles.smooth
    # The energy is that over the range of Δ common to both branches, since a cycle need not close.
    up, down = slice(start, top + 1), slice(top, stop + 1)
    common = max(float(delta[start]), float(delta[stop]))
    loop = _work(delta[up], load[up], common) + _work(delta[down], load[down], common)
    closed = stop < delta.size - 1 or delta[top] - delta[stop] > 0.9 * (delta[top] - delta[start])
    turn = _part(-smooth, top, stop, (0.05, 0.25))
    enough = turn.stop - turn.start > 2
    tangent = _line(delta[turn], load[turn], sheet)["k_N_per_mm"] if enough else math.nan
    return {
        "loop_mJ": loop if closed else math.nan,
        "residual_mm": _zero_crossing(delta[down][::-1], smooth[down][::-1])
        - _zero_crossing(delta[up], smooth[up]),
        "K_tangent_N_per_mm": tangent,
    }


def _work(delta: Floats, load: Floats, above: float) -> float:
    """Integral of F dΔ over the part with Δ above a limit, mJ."""
    clipped = np.maximum(delta, above)
    return float(np.sum(0.5 * (load[1:] + load[:-1]) * np.diff(clipped)))


def _zero_crossing(delta: Floats, load: Floats) -> float:
    """Δ at the last crossing of 0 by a rising force; NaN without one."""
    below = np.flatnonzero(load <= 0)
    if not below.size or below[-1] == load.size - 1:
        return math.nan
    k = int(below[-1])
    return float(delta[k] - load[k] * (delta[k + 1] - delta[k]) / (load[k + 1] - load[k]))


def _remarks(table: pd.DataFrame, sheet: Sample, machine: float) -> list[str]:
    """Notes on the extrapolation and on a missing correction for the machine."""
    k, root = float(table["k_N_per_mm"].mean()), float(table["delta0_mm"].mean())
    notes = [
        f"Y_p = |F0|/(εW) extrapolates from Δ = {table['fit_from_mm'].min():.4g} mm to 0; "
        f"kL/(εW) does not (Δ0 = {root:.4g} mm, L = {sheet.length_mm:g} mm)"
    ]
    if math.isnan(machine):
        notes.append(
            f"the machine's compliance is not corrected: 10⁵ N/mm would raise k by {100 * k / 1e5:.2g} %"
        )
    return notes


# --- the modulus --------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class MeanValue(Estimate):
    """Mean over cycles, and the scatter (standard deviation) of single cycles.

    The systematic error of a modulus is that of the sheet's size; NaN if none is given.
    """

    scatter: float


def mean_over_cycles(cycles: pd.DataFrame, column: str) -> MeanValue:
    """Mean of a column of `measure_cycles`, such as "Y_p_GPa", over the cycles, with equal weights. The error
    is the larger of the scatter over √n and that of the fits; with one cycle the scatter is NaN."""
    CYCLES.check(cycles)
    values = cycles[column].to_numpy(float)
    values = values[np.isfinite(values)]
    if not values.size:
        return MeanValue(value=math.nan, error=math.nan, scatter=math.nan)
    scatter = float(values.std(ddof=1)) if values.size > 1 else math.nan
    from_fits = 0.0
    if (of_fits := with_word(column, "err")) in cycles:
        from_fits = float(np.sqrt(np.nansum(cycles[of_fits].to_numpy(float) ** 2))) / values.size
    from_scatter = scatter / math.sqrt(values.size) if values.size > 1 else 0.0
    error = max(from_fits, from_scatter) or math.nan
    return MeanValue(value=float(values.mean()), error=error, scatter=scatter)


def summarise_modulus(
    cycles: pd.DataFrame, sheet_err: Mapping[str, float] | None = None
) -> dict[str, MeanValue]:
    """Means over the cycles of the moduli, of the fitted lines, and of the loops, by column.

    sheet_err: errors of the sheet's thickness_mm, width_mm and length_mm, as far as they are known, which
    enter the systematic error of the moduli.
    """
    moduli = ("Y_p_GPa", "Y_slope_GPa", "k_N_per_mm", "F0_N", "delta0_mm")
    loops = ("loop_mJ", "residual_mm", "F_max_N", "K_tangent_N_per_mm", "drift_N")
    means = {name: mean_over_cycles(cycles, name) for name in (*moduli, *loops)}
    if not sheet_err:
        return means
    measured, error = CyclesMetadata.of(cycles), dict.fromkeys(_SIZES, 0.0) | dict(sheet_err)
    relative = {name: error[name] / size for name, size in zip(_SIZES, measured.sheet, strict=True)}
    # L changes |F0| = k Δ0 only as the origin of Δ; where Δ is known otherwise, it does not.
    by_length = {"Y_slope_GPa": relative["length_mm"], "Y_p_GPa": 0.0}
    if measured.clamp_distance_from == "length":
        by_length["Y_p_GPa"] = error["length_mm"] / abs(means["delta0_mm"].value)
    for name, part in by_length.items():
        total = math.hypot(relative["thickness_mm"], relative["width_mm"], part)
        means[name] = replace(means[name], systematic_error=means[name].value * total or math.nan)
    return means


_SIZES = ("thickness_mm", "width_mm", "length_mm")
