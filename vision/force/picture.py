"""A picture of the recording and of what was measured on it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vision.force.recording import good_samples

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr
    from matplotlib.axes import Axes

Floats = NDArray[np.float64]
Curve = Callable[[Floats], Floats]

_MOST_POINTS = 4000
_ZOOMED_EVENTS = 6
_LOAD, _PEAK, _VALLEY, _MODEL = "#4878a8", "#c0392b", "#2e8b57", "#222222"


def draw_force(
    force: xr.Dataset,
    sticks: pd.DataFrame,
    path: Path,
    *,
    peak_model: Curve | None = None,
    stiffness_model: Curve | None = None,
) -> None:
    """Writes a PNG: the whole recording, a few sticks with their lines, peaks and stiffness against d.

    peak_model, stiffness_model: fitted F_max(d) and K(d), drawn where given.  Nothing is shown on a screen.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 8.5), layout="constrained")
    whole, zoom, peaks, stiffness = figure.subplots(2, 2).ravel()
    unit = "F / weight" if force["load_N"].attrs.get("units") == "1" else "F (N)"
    good = good_samples(force) if "flag" in force else force
    middle = sticks.iloc[max(len(sticks) // 2 - _ZOOMED_EVENTS // 2, 0) :].head(_ZOOMED_EVENTS)
    pause = 0.15 * float(middle["t_p_s"].iloc[-1] - middle["t_v_s"].iloc[0])
    _draw_load(whole, good, sticks, unit, lines=False)
    near = (good["time_s"] > middle["t_v_s"].iloc[0] - pause) & (
        good["time_s"] < middle["t_p_s"].iloc[-1] + pause
    )
    _draw_load(zoom, good.isel(time_s=near.to_numpy()), middle, unit, lines=True)
    whole.set_title(f"{len(sticks)} events, threshold {sticks.attrs.get('threshold_N', np.nan):.3g}")
    zoom.set_title("peaks, valleys and stick lines")
    _draw_trend(peaks, sticks, "d_p_mm", "F_p_N", unit, peak_model)
    _draw_trend(
        stiffness,
        sticks,
        "d_v_mm",
        "K_N_per_mm",
        "K (1/mm)" if unit == "F / weight" else "K (N/mm)",
        stiffness_model,
    )
    figure.savefig(path, dpi=110)


def _draw_load(axes: Axes, force: xr.Dataset, sticks: pd.DataFrame, unit: str, *, lines: bool) -> None:
    time, load = _outline(force["time_s"].to_numpy(), force["load_N"].to_numpy())
    axes.plot(time, load, color=_LOAD, linewidth=0.6)
    if lines:
        ends = sticks[["t_v_s", "t_p_s"]].to_numpy().T, sticks[["F_v_N", "F_p_N"]].to_numpy().T
        axes.plot(*ends, color=_MODEL, linewidth=1.0)
    size = 5.0 if lines else 2.0
    axes.plot(sticks["t_p_s"], sticks["F_p_N"], "^", color=_PEAK, markersize=size, label="peak")
    axes.plot(sticks["t_v_s"], sticks["F_v_N"], "v", color=_VALLEY, markersize=size, label="valley")
    axes.set(xlabel="t (s)", ylabel=unit)
    axes.legend(loc="best", frameon=False)


def _outline(time: Floats, load: Floats) -> tuple[Floats, Floats]:
    """A long signal as the lowest and highest sample of each of some thousand stretches."""
    step = -(-time.size // _MOST_POINTS)
    if step <= 2:
        return time, load
    rows = time.size // step
    parts = load[: rows * step].reshape(rows, step)
    at = np.sort(np.stack([parts.argmin(axis=1), parts.argmax(axis=1)], axis=1), axis=1)
    index = (at + step * np.arange(rows)[:, np.newaxis]).ravel()
    return time[index], load[index]


def _draw_trend(axes: Axes, sticks: pd.DataFrame, x: str, y: str, label: str, model: Curve | None) -> None:
    usable = sticks[(sticks["flag"] == "ok") & sticks[x].notna()]
    axes.set(xlabel="d (mm)", ylabel=label)
    if usable.empty:
        axes.text(0.5, 0.5, "d is not known", ha="center", transform=axes.transAxes)
        return
    axes.plot(usable[x], usable[y], ".", color=_PEAK, markersize=4, label=y)
    if model is not None:
        d = np.linspace(float(usable[x].min()), float(usable[x].max()), 300)
        axes.plot(d, model(d), color=_MODEL, linewidth=1.2, label="model")
    axes.set_ylim(0, 1.15 * float(usable[y].quantile(0.99)))
    axes.legend(loc="best", frameon=False)
