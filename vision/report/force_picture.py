"""force.png: a recording and what was measured on it, on one page to judge it by."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vision.force.recording import good_samples
from vision.report import force_charts
from vision.report.decimate import outline
from vision.report.draw import draw_chart
from vision.report.style import MODEL, PEAK, QUIET, VALLEY, picture_style

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr
    from matplotlib.axes import Axes

    from vision.models.fits_result import ModelFits

ZOOMED_EVENTS = 6
MOST_POINTS = 4000


def write_force_picture(
    path: Path, force: xr.Dataset, sticks: pd.DataFrame, fits: ModelFits | None = None
) -> None:
    """Writes a PNG: the whole recording, a few sticks with their lines, amplitude and stiffness against d.

    Args: force, of `read_force`; sticks, of `find_stick_slip`; fits, whose curves are drawn where given.
    """
    from matplotlib.figure import Figure

    unit = force_charts.load_unit(force)
    charts = (
        force_charts.pull_chart(force, sticks, fits),
        force_charts.drops_chart(sticks, fits, unit=unit),
        force_charts.stiffness_chart(sticks, fits, unit=unit),
    )
    with picture_style():
        figure = Figure(figsize=(13, 9), layout="constrained")
        whole, zoom, *trends = figure.subplots(2, 2).ravel()
        for ax, chart in zip((whole, *trends), charts, strict=True):
            draw_chart(ax, chart)
            ax.set_title(chart.title, loc="left")
            if not any(series.x.size for series in chart.series):
                ax.text(0.5, 0.5, "d is not known", ha="center", transform=ax.transAxes, color=QUIET[0])
                ax.set(xticks=[], yticks=[])
        draw_some_sticks(zoom, force, sticks)
        whole.set_title(_found(sticks, unit), loc="left")
        figure.savefig(path, dpi=110)


def _found(sticks: pd.DataFrame, unit: str) -> str:
    least = sticks.attrs.get("threshold_N", np.nan)
    return f"{len(sticks)} events, drops above {least:.3g} {'of the weight' if unit == '1' else unit}"


def draw_some_sticks(ax: Axes, force: xr.Dataset, sticks: pd.DataFrame) -> Axes:
    """F(t) of a few events in the middle of the test, with their valleys, peaks and the lines between."""
    start = max(len(sticks) // 2 - ZOOMED_EVENTS // 2, 0)
    some = sticks.iloc[start : start + ZOOMED_EVENTS]
    t_v, t_p, f_v, f_p = (some[name].to_numpy(float) for name in ("t_v_s", "t_p_s", "F_v_N", "F_p_N"))
    pause = 0.15 * (t_p[-1] - t_v[0])
    good = good_samples(force) if "flag" in force else force
    time = good["time_s"].to_numpy()
    near = (time > t_v[0] - pause) & (time < t_p[-1] + pause)
    at, load = outline(time[near], good["load_N"].to_numpy()[near][:, None], most=MOST_POINTS)
    ax.plot(at, load[:, 0], color=QUIET[0], lw=0.8, label="F")
    ax.plot([t_v, t_p], [f_v, f_p], color=MODEL[0], lw=1.2)
    ax.plot(t_p, f_p, "o", color=PEAK[0], ms=4, label="peaks")
    ax.plot(t_v, f_v, "o", color=VALLEY[0], mfc="none", ms=6, label="valleys")
    ax.set(xlabel="t (s)", ylabel=force_charts.load_label("F", force_charts.load_unit(force)))
    title = "A few sticks, with the lines from valley to peak"
    if lowpass_s := sticks.attrs.get("lowpass_s", 0.0):
        title += f"\n(without the force chain's low-pass of {1e3 * lowpass_s:.2g} ms; F as recorded)"
    ax.set_title(title, loc="left")
    low, high = ax.get_ylim()
    ax.set_ylim(low, high + 0.12 * (high - low))  # room for the legend
    ax.legend(loc="upper right", ncols=3, fontsize=8)
    ax.grid(alpha=0.25)
    return ax
