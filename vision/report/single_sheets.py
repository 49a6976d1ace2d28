"""friction.png and modulus.png: measurements on single sheets, each on one page to judge it by."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from vision.figures.drawing import picture_style
from vision.figures.labels import plus_minus
from vision.figures.style import DATA, MODEL, PEAK, QUIET, VALLEY, ordered_inks
from vision.models import Estimate
from vision.models.friction import PUBLISHED_FRICTION, threshold_curves
from vision.models.modulus import CyclesMetadata, clamp_distance, mean_over_cycles
from vision.numeric import Floats
from vision.sample import Sample

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr
    from matplotlib.axes import Axes

    from vision.models.friction import DiscFriction, StaticFriction

MOST_POINTS = 3000
LEAST_ANGLE_DEG = 0.01  # left end of the logarithmic axis


def write_friction_picture(
    path: Path,
    measured: Sequence[DiscFriction],
    curves: Sequence[pd.DataFrame],
    law: StaticFriction | None,
    *,
    mu: float = 0.89,
    dynamic_deg: tuple[float, float] = (0.3, 120.0),
) -> None:
    """Three panels as the publication's: μ(φ) with the maxima, μ_s and μ_d against N, threshold forces.

    Parameters
    ----------
    path
        PNG.
    measured, curves
        Of `friction_of_disc` and `friction_curve`, in the same order.
    law
        Fitted to the measurements; None where there were too few.
    mu
        Constant coefficient to compare with, as the fit of Eq. 1 gives it.
    dynamic_deg
        Range of μ_d, shaded.
    """
    from matplotlib.figure import Figure

    with picture_style():
        figure = Figure(figsize=(15, 5), layout="constrained")
        along, against, thresholds = figure.subplots(1, 3)
        _draw_curves(along, measured, curves, dynamic_deg)
        _draw_coefficients(against, measured, law, mu)
        _draw_thresholds(thresholds, law, mu)
        figure.savefig(path, dpi=110)


def _draw_curves(
    ax: Axes,
    measured: Sequence[DiscFriction],
    curves: Sequence[pd.DataFrame],
    dynamic_deg: tuple[float, float],
) -> None:
    order = np.argsort([one.N_N for one in measured])
    top = 0.0
    for k, (ink, _) in zip(order, ordered_inks(len(order)), strict=True):
        one, curve = measured[k], curves[k]
        angle, height = curve["angle_deg"].to_numpy(), curve["mu"].to_numpy()
        step = max(len(angle) // MOST_POINTS, 1)
        ax.plot(np.maximum(angle[::step], LEAST_ANGLE_DEG), height[::step], color=ink, lw=0.9)
        if np.isfinite(one.mu_s):
            ax.errorbar(
                one.peak_deg,
                one.mu_s,
                yerr=one.mu_s_err,
                fmt="o",
                color=ink,
                mec="black",
                ms=6,
                zorder=3,
                label=f"{one.N_N:.3g} N",
            )
            top = max(top, one.mu_s)
    ax.axvspan(*dynamic_deg, color=QUIET[0], alpha=0.12, lw=0, label="μ$_d$")
    ax.set(xscale="log", xlabel="φ (°)", ylabel="μ = 3τ / 2RN", xlim=(LEAST_ANGLE_DEG, None))
    ax.set_ylim(0, 1.15 * top if top else None)
    ax.set_title("Friction against angle, first maxima marked", loc="left")
    ax.legend(fontsize=8, title="N", ncols=2, loc="upper right")
    ax.grid(alpha=0.25)


def _draw_coefficients(
    ax: Axes, measured: Sequence[DiscFriction], law: StaticFriction | None, mu: float
) -> None:
    load = np.array([one.N_N for one in measured])
    for name, colour, mark in (("mu_s", PEAK[0], "o"), ("mu_d", DATA[0], "s")):
        value = np.array([getattr(one, name) for one in measured])
        error = np.array([getattr(one, f"{name}_err") for one in measured])
        known = np.isfinite(value)
        label = "μ$_s$" if name == "mu_s" else "μ$_d$"
        ax.errorbar(load[known], value[known], yerr=error[known], fmt=mark, color=colour, ms=5, label=label)
    at = np.geomspace(0.7 * load.min(), 1.3 * load.max(), 200)
    if law is not None:
        text = f"{law.a:.3f} (1 + {law.b_N:.3f} N / N)"
        ax.plot(at, law.mu_s(at), color=MODEL[0], lw=1.2, label=f"a(1 + b/N) = {text}")
    ax.axhline(mu, color=QUIET[0], ls=":", label=f"μ = {mu:g} of the whole sample")
    ax.set(xscale="log", xlabel="N (N)", ylabel="friction coefficient")
    ax.set_ylim(0, None)
    ax.set_title("Static and dynamic coefficient", loc="left")
    ax.legend(fontsize=8, loc="best")
    ax.grid(alpha=0.25)


def _draw_thresholds(ax: Axes, law: StaticFriction | None, mu: float) -> None:
    shown = law or PUBLISHED_FRICTION
    table = threshold_curves(mu=mu, law=shown)
    name = "a(N + b)" if law is not None else "a(N + b), the publication's"
    ax.plot(table["N_N"], table["constant_N"], color=QUIET[0], ls="--", label=f"μN, μ = {mu:g}")
    ax.plot(table["N_N"], table["law_N"], color=MODEL[0], label=name)
    crossing = shown.crossing_N(mu)
    if np.isfinite(crossing):
        ax.plot(crossing, mu * crossing, "o", color=PEAK[0], label=f"equal at {crossing:.3f} N")
    ax.set(xscale="log", yscale="log", xlabel="N (N)", ylabel="static friction force (N)")
    ax.set_title("Thresholds over the loads inside the blocks", loc="left")
    ax.legend(fontsize=8, loc="best")
    ax.grid(alpha=0.25)


def write_modulus_picture(
    path: Path, force: xr.Dataset, cycles: pd.DataFrame, *, clamp_distance_mm: float | None = None
) -> None:
    """F(Δ) with the fitted parts, the loading branch about its line, and the modulus of each cycle.

    Parameters
    ----------
    path
        PNG.
    force, cycles
        Of `vision.read_force` and `measure_cycles`.
    clamp_distance_mm
        As given to `measure_cycles`.
    """
    from matplotlib.figure import Figure

    facts = CyclesMetadata.of(cycles)
    thickness, width, length = facts.sheet
    sheet = Sample(thickness_mm=thickness, width_mm=width, length_mm=length)
    delta = clamp_distance(force, sheet=sheet, clamp_distance_mm=clamp_distance_mm)
    load, time = force["load_N"].values, force["time_s"].values
    if np.isfinite(facts.machine_stiffness_N_per_mm):
        delta = delta - load / facts.machine_stiffness_N_per_mm
    with picture_style():
        figure = Figure(figsize=(15, 5), layout="constrained")
        whole, residuals, moduli = figure.subplots(1, 3)
        whole.plot(delta, load, color=QUIET[0], lw=0.7, label="F")
        inks = ordered_inks(len(cycles))
        for (ink, _), row in zip(inks, cycles.to_dict("records"), strict=True):
            line = np.array([row["fit_from_mm"], row["fit_to_mm"]])
            whole.plot(line, row["k_N_per_mm"] * line + row["F0_N"], color=ink, lw=2)
            branch = (time >= row["t_start_s"]) & (time <= row["t_end_s"])
            x, y = delta[branch], load[branch]
            residuals.plot(
                x, y - (row["k_N_per_mm"] * x + row["F0_N"]), color=ink, lw=0.8, label=str(row["cycle"])
            )
        span = cycles["fit_from_mm"].min(), cycles["fit_to_mm"].max()
        residuals.axvspan(*span, color=QUIET[0], alpha=0.12, lw=0, label="fitted")
        _limits(residuals, delta, cycles)
        _draw_moduli(moduli, cycles)
        whole.axhline(0, color=QUIET[0], lw=0.6)
        whole.set(xlabel="distance of the clamps Δ (mm)", ylabel="F (N)")
        whole.set_title(f"{len(cycles)} loading branches, fitted parts in colour", loc="left")
        residuals.set(xlabel="Δ (mm)", ylabel="F − (kΔ + F0) (N)")
        residuals.set_title("Loading branches about their lines", loc="left")
        residuals.legend(fontsize=8, title="cycle", ncols=2)
        for ax in (whole, residuals, moduli):
            ax.grid(alpha=0.25)
        figure.savefig(path, dpi=110)


def _limits(ax: Axes, delta: Floats, cycles: pd.DataFrame) -> None:
    """The fitted part and a little beside it: far from it the residuals only tell of the slack."""
    low, high = float(cycles["fit_from_mm"].min()), float(cycles["fit_to_mm"].max())
    ax.set_xlim(low - 0.3 * (high - low), min(high + 0.3 * (high - low), float(np.nanmax(delta))))
    shown = [line for line in ax.get_lines() if np.size(line.get_xdata()) > 2]
    inside = [_between(line.get_xdata(), line.get_ydata(), *ax.get_xlim()) for line in shown]
    reach = 1.6 * max((float(np.nanmax(np.abs(part))) for part in inside if part.size), default=1.0)
    ax.set_ylim(-reach, reach)


def _between(x: ArrayLike, y: ArrayLike, low: float, high: float) -> Floats:
    at, values = np.asarray(x, float), np.asarray(y, float)
    return values[(at >= low) & (at <= high)]


def _draw_moduli(ax: Axes, cycles: pd.DataFrame) -> None:
    number = cycles["cycle"].to_numpy(float)
    drawn = (("Y_p", PEAK[0], "o", -0.05, "|F0|/(εW)"), ("Y_slope", VALLEY[0], "s", 0.05, "kL/(εW)"))
    for name, colour, mark, shift, label in drawn:
        value, error = cycles[f"{name}_GPa"].to_numpy(), cycles[f"{name}_err_GPa"].to_numpy()
        mean = mean_over_cycles(cycles, f"{name}_GPa")
        text = f"{label}: {plus_minus(Estimate(mean.value, mean.error))} GPa"
        ax.errorbar(number + shift, value, yerr=error, fmt=mark, color=colour, ms=5, label=text)
        ax.axhline(mean.value, color=colour, lw=0.8, ls="--")
    ax.set(xlabel="cycle", ylabel="Young's modulus (GPa)", xticks=number)
    low, high = ax.get_ylim()
    ax.set_ylim(low, high + 0.2 * (high - low))  # above the points, for the legend
    ax.set_title("Modulus of each cycle, and the means", loc="left")
    ax.legend(fontsize=8, loc="best")
