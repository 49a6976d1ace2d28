"""The report's figures on matplotlib axes: for notebooks, and as files for a manuscript.

Every `draw_` function takes the axes to draw on and returns them; captions and numbers are those of the chart
functions in `sheet_charts`, `force_charts` and `shell_charts`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vision.report import force_charts, sheet_charts, shell_charts
from vision.report.chart import Chart, table_of
from vision.report.draw import draw_chart
from vision.report.drawing import drawn_meanwhile
from vision.report.results import RunResults
from vision.report.sections import charts_of, sections_of

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr
    from matplotlib.axes import Axes

    from vision.clock import Clock
    from vision.models.fits_result import ModelFits


def write_figures(folder: str | Path, results: RunResults) -> list[Path]:
    """Every figure of the report as PDF and SVG, its numbers as CSV, and all captions in captions.txt.

    The folder is made. Text stays text in both formats; long records are decimated as in the report. Returns
    the files written. Raises OSError where the folder cannot be written.
    """
    folder = Path(folder)
    charts = charts_of(sections_of(results))
    with drawn_meanwhile(folder, charts):
        tables = write_numbers(folder, charts)
    return [*(folder / f"{chart.name}.{kind}" for chart in charts for kind in ("pdf", "svg")), *tables]


def write_numbers(folder: Path, charts: Sequence[Chart]) -> list[Path]:
    """The charts' numbers as CSV, and their captions."""
    tables = [folder / f"{chart.name}.csv" for chart in charts]
    for path, chart in zip(tables, charts, strict=True):
        table_of(chart).to_csv(path, index=False, float_format="%.8g", lineterminator="\n")
    text = "\n\n".join(f"{chart.name}\n{chart.title}. {chart.caption}" for chart in charts)
    (folder / "captions.txt").write_text(text + "\n", encoding="utf-8")
    return [*tables, folder / "captions.txt"]


def draw_frame(ax: Axes, frame: NDArray[np.generic], tracks: xr.Dataset) -> Axes:
    """One frame with the strip and the numbered sheets."""
    return draw_chart(ax, sheet_charts.frame_chart(frame, tracks))


def draw_space_time(
    ax: Axes, strip: xr.DataArray, tracks: xr.Dataset, *, pixel_size_um: float | None = None
) -> Axes:
    """I(x, t) with the tracks on it, time downwards."""
    return draw_chart(ax, sheet_charts.space_time_chart(strip, tracks, pixel_size_um=pixel_size_um))


def draw_displacement(ax: Axes, tracks: xr.Dataset, *, pixel_size_um: float | None = None) -> Axes:
    """x(n, t) less each sheet's median."""
    return draw_chart(ax, sheet_charts.displacement_chart(tracks, pixel_size_um=pixel_size_um))


def draw_noise(ax: Axes, tracks: xr.Dataset, *, pixel_size_um: float | None = None) -> Axes:
    """Measured and predicted noise of every sheet's position."""
    return draw_chart(ax, sheet_charts.noise_chart(tracks, pixel_size_um=pixel_size_um))


def draw_locking(ax: Axes, tracks: xr.Dataset) -> Axes:
    """Histogram of x modulo one pixel."""
    return draw_chart(ax, sheet_charts.locking_chart(tracks))


def draw_pull(
    ax: Axes, force: xr.Dataset, sticks: pd.DataFrame | None = None, fits: ModelFits | None = None
) -> Axes:
    """F(d) with peaks, valleys and Eq. 1."""
    return draw_chart(ax, force_charts.pull_chart(force, sticks, fits))


def draw_clocks(
    ax: Axes,
    force: xr.Dataset,
    tracks: xr.Dataset,
    clock: Clock,
    sticks: pd.DataFrame | None = None,
    *,
    pixel_size_um: float | None = None,
) -> Axes:
    """Force and the sheets' common motion on one time axis; a second y axis is added."""
    chart = force_charts.clock_chart(force, tracks, clock, sticks, pixel_size_um=pixel_size_um)
    return draw_chart(ax, chart)


def draw_sticks(ax: Axes, force: xr.Dataset, sticks: pd.DataFrame) -> Axes:
    """F − F_v against d − d_v for a few events."""
    return draw_chart(ax, force_charts.sticks_chart(force, sticks))


def draw_drops(ax: Axes, sticks: pd.DataFrame, fits: ModelFits | None = None, *, unit: str = "N") -> Axes:
    """ΔF(d_v) with A times the normal force.  unit: "1" for a force over a weight."""
    return draw_chart(ax, force_charts.drops_chart(sticks, fits, unit=unit))


def draw_stiffness(ax: Axes, sticks: pd.DataFrame, fits: ModelFits | None = None, *, unit: str = "N") -> Axes:
    """K(d_v) with M_eff K_eff and (L + d)⁻¹.  unit: "1" for a force over a weight."""
    return draw_chart(ax, force_charts.stiffness_chart(sticks, fits, unit=unit))


def draw_stick(
    ax: Axes, tracks: xr.Dataset, motion: xr.Dataset, clock: Clock, *, event: int | None = None
) -> Axes:
    """δx(t) of all sheets over one stick. Raises InputError for an event that is not in `motion`."""
    return draw_chart(ax, shell_charts.stick_chart(tracks, motion, clock, event=event))


def draw_ratio(ax: Axes, motion: xr.Dataset, *, threshold: float = 0.1) -> Axes:
    """σ_x/Λ_st against n with the threshold shaded."""
    return draw_chart(ax, shell_charts.ratio_chart(motion, threshold=threshold))


def draw_shells(ax: Axes, shells: pd.DataFrame, fits: ModelFits | None = None) -> Axes:
    """Size of the stiff shell with its interval, and M_eff of the force."""
    return draw_chart(ax, shell_charts.shells_chart(shells, fits))
