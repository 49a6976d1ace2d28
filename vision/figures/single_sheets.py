"""Figures of single sheets: friction of two on a rheometer, and modulus of one from push–pull cycles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
import xarray as xr

from vision.figures.figure import Band, Figure, Panel, Range, Series
from vision.figures.style import DATA, MODEL, PEAK, QUIET, VALLEY, ordered_inks
from vision.models import Estimate, plus_minus
from vision.models.friction import PUBLISHED_FRICTION, DiscFriction, StaticFriction, friction_table
from vision.models.modulus import CyclesMetadata, mean_over_cycles
from vision.numeric import Floats
from vision.signals import minmax_decimate

MOST_POINTS = 3000  # of a curve


def friction_figure(
    measured: Sequence[DiscFriction],
    law: StaticFriction | None,
    *,
    mu: float,
    dynamic_deg: tuple[float, float],
) -> Figure:
    """Return μ(φ) with its maxima, μ_s and μ_d against N, and the threshold forces.

    law: None if there were too few measurements.  mu: constant coefficient for comparison, as from Eq. 1.
    dynamic_deg: range of angles for μ_d.
    """
    fitted = (
        f" Line: μ_s = a(1 + b/N), a = {plus_minus(Estimate(law.a, law.a_err))}, "
        f"b = {plus_minus(Estimate(law.b_N, law.b_err_N))} N."
        if law is not None
        else " Too few measurements to fit the law: the publication's thresholds are shown."
    )
    return Figure.grid(
        "friction",
        "Friction of two sheets",
        (
            "Left: μ = 3τ/(2RN) against the angle, larger loads brighter, with the first maximum of each, "
            "μ_s; shaded: range over which μ_d is the mean. Middle: both coefficients against the normal "
            f"force, with standard errors.{fitted} Right: static friction force at the loads inside the "
            "blocks, with a constant coefficient and with this law. Compare figure 10 of the publication."
        ),
        (
            _angle_panel(measured, dynamic_deg),
            _coefficient_panel(measured, law, mu),
            _threshold_panel(law, mu),
        ),
        aspect=0.9,
    )


def _angle_panel(measured: Sequence[DiscFriction], dynamic_deg: tuple[float, float]) -> Panel:
    least_deg = 0.01  # left end of the logarithmic axis
    order = np.argsort([one.N_N for one in measured])
    series: list[Series] = []
    top = 0.0
    for k, ink in zip(order, ordered_inks(len(order)), strict=True):
        one = measured[k]
        angle = np.maximum(one.curve["angle_deg"].to_numpy(float), least_deg)
        at, height = minmax_decimate(angle, one.curve["mu"].to_numpy(float), most=MOST_POINTS)
        series.append(Series(label=f"{one.N_N:.3g} N", x=at, y=height, ink=ink, width=0.9))
        if np.isfinite(one.mu_s):
            series.append(Series.points("", [one.peak_deg], [one.mu_s], MODEL, [one.mu_s_err], hollow=True))
            top = max(top, one.mu_s)
    last = max((float(s.x.max()) for s in series if s.x.size), default=1.0)
    return Panel(
        title="Friction against angle",
        x_label="φ (°)",
        y_label="μ = 3τ/(2RN)",
        series=tuple(series),
        bands=(Band(low=dynamic_deg[0], high=dynamic_deg[1], label="dynamic range", of_x=True),),
        x_range=(least_deg, max(last, 10 * least_deg)),
        y_range=(0.0, 1.15 * top) if top else None,
        x_log=True,
    )


def _coefficient_panel(measured: Sequence[DiscFriction], law: StaticFriction | None, mu: float) -> Panel:
    table = friction_table(measured).sort_values("N_N")
    load = table["N_N"].to_numpy(float)
    series = [
        Series.points("μ static", load, table["mu_s"], PEAK, table["mu_s_err"]),
        Series.points("μ dynamic", load, table["mu_d"], DATA, table["mu_d_err"], hollow=True),
    ]
    at = np.geomspace(0.7 * load.min(), 1.3 * load.max(), 200)
    if law is not None:
        series.append(Series(label="a(1 + b/N)", x=at, y=law.mu_s(at), ink=MODEL))
    constant = np.full(2, mu)
    series.append(Series(label=f"μ = {mu:g}", x=at[[0, -1]], y=constant, ink=QUIET, dashed=True))
    top = float(np.nanmax([mu, *table["mu_s"], *table["mu_d"]]))
    return Panel(
        title="Static and dynamic coefficient",
        x_label="normal force N (N)",
        y_label="friction coefficient",
        series=tuple(series),
        y_range=(0.0, 1.2 * top),
        x_range=(float(at[0]), float(at[-1])),
        x_log=True,
    )


def _threshold_panel(law: StaticFriction | None, mu: float) -> Panel:
    shown = law or PUBLISHED_FRICTION
    load = np.geomspace(0.0034, 6.4, 200)  # N in the blocks: from T*/μ to that on the axis at d = 13.5 mm
    name = "a(N + b)" if law is not None else "a(N + b), published"
    series = [
        Series(label=f"μN, μ = {mu:g}", x=load, y=mu * load, ink=QUIET, dashed=True),
        Series(label=name, x=load, y=shown.threshold_N(load), ink=MODEL),
    ]
    crossing = shown.crossing_N(mu)
    if np.isfinite(crossing):
        series.append(Series.points(f"equal at {crossing:.3f} N", [crossing], [mu * crossing], PEAK))
    return Panel(
        title="Thresholds over the loads in the blocks",
        x_label="normal force N (N)",
        y_label="static friction force (N)",
        series=tuple(series),
        x_range=(float(load.min()), float(load.max())),
        x_log=True,
        y_log=True,
    )


# --- the modulus of one sheet -------------------------------------------------------------------------------


def modulus_figure(force: xr.Dataset, cycles: pd.DataFrame) -> Figure:
    """Return F(Δ) with the fitted parts, the loading branches less their lines, and the moduli.

    cycles: from `measure_cycles` of this recording.
    """
    facts = CyclesMetadata.of(cycles)
    delta = force["crosshead_mm"].to_numpy().astype(float) + facts.shift_mm
    load = force["load_N"].to_numpy().astype(float)
    if np.isfinite(facts.machine_stiffness_N_per_mm):
        delta = delta - load / facts.machine_stiffness_N_per_mm
    return Figure.grid(
        "modulus",
        "Young's modulus of one sheet",
        (
            f"Left: force against the distance of the clamps, {len(cycles)} loading branches with the fitted "
            "parts F = kΔ + F0 in colour. Middle: the branches less their lines; shaded: the fitted range. "
            "Right: modulus of each cycle with its standard error, and the means (dashed). Compare figure 11 "
            "of the publication."
        ),
        (_cycles_panel(delta, load, cycles), _branches_panel(force, delta, load, cycles), _moduli(cycles)),
        aspect=0.9,
    )


def _cycles_panel(delta: Floats, load: Floats, cycles: pd.DataFrame) -> Panel:
    step = max(1, -(-delta.size // (4 * MOST_POINTS)))  # thinned, as minmax_decimate needs a rising x
    series = [Series(label="F", x=delta[::step], y=load[::step], ink=QUIET, width=0.7)]
    inks = ordered_inks(len(cycles))
    for k, (ink, row) in enumerate(zip(inks, cycles.to_dict("records"), strict=True)):
        line = np.array([row["fit_from_mm"], row["fit_to_mm"]])
        fitted = row["k_N_per_mm"] * line + row["F0_N"]
        label = "F = kΔ + F0, fitted" if k == len(cycles) - 1 else ""  # the last hides the others
        series.append(Series(label=label, x=line, y=fitted, ink=ink, width=2.0))
    return Panel(
        title="Push–pull cycles",
        x_label="distance of the clamps Δ (mm)",
        y_label="F (N)",
        series=tuple(series),
    )


def _branches_panel(force: xr.Dataset, delta: Floats, load: Floats, cycles: pd.DataFrame) -> Panel:
    """Return residuals of the loading branches near the fitted part; farther off the sheet is slack."""
    time = force["time_s"].to_numpy()
    low, high = float(cycles["fit_from_mm"].min()), float(cycles["fit_to_mm"].max())
    view: Range = (low - 0.3 * (high - low), min(high + 0.3 * (high - low), float(np.nanmax(delta))))
    series: list[Series] = []
    for ink, row in zip(ordered_inks(len(cycles)), cycles.to_dict("records"), strict=True):
        branch = (
            (time >= row["t_start_s"]) & (time <= row["t_end_s"]) & (delta >= view[0]) & (delta <= view[1])
        )
        x = delta[branch]
        residual = load[branch] - (row["k_N_per_mm"] * x + row["F0_N"])
        at, y = minmax_decimate(x, residual, most=MOST_POINTS)
        series.append(Series(label=str(row["cycle"]), x=at, y=y, ink=ink, width=0.8))
    inside = [s.y[(s.x >= low) & (s.x <= high)] for s in series]
    reach = 2.5 * max((float(np.nanmax(np.abs(y))) for y in inside if y.size), default=1.0) or 1.0
    return Panel(
        title="Residuals of the fitted lines",
        x_label="Δ (mm)",
        y_label="F − (kΔ + F0) (N)",
        series=tuple(series),
        bands=(Band(low=low, high=high, label="fitted", of_x=True),),
        x_range=view,
        y_range=(-reach, reach),
    )


def _moduli(cycles: pd.DataFrame) -> Panel:
    number = cycles["cycle"].to_numpy(float)
    series: list[Series] = []
    ends = np.array([number.min() - 0.3, number.max() + 0.3])
    drawn = (("Y_p", PEAK, False, -0.05, "|F0|/(εW)"), ("Y_slope", VALLEY, True, 0.05, "kL/(εW)"))
    for name, ink, hollow, shift, label in drawn:
        value, error = (cycles[f"{name}{part}_GPa"].to_numpy(float) for part in ("", "_err"))
        mean = mean_over_cycles(cycles, f"{name}_GPa")
        text = f"{label}: {plus_minus(mean)} GPa"
        series += [
            Series.points(text, number, value, ink, error, hollow=hollow, shift=shift),
            Series(label="", x=ends, y=np.full(2, mean.value), ink=ink, dashed=True, width=0.8),
        ]
    return Panel(
        title="Modulus of each cycle",
        x_label="cycle",
        y_label="Young's modulus (GPa)",
        series=tuple(series),
        whole_numbers=True,
    )
