"""Space-time diagrams with axes: the strip, or windows around several sheets side by side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vision.report.axes import UM_PER_MM, position_unit, time_axis
from vision.report.decimate import mean_rows, outline
from vision.report.style import picture_style, sheet_colours

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes

Doubles = NDArray[np.float64]
Limits = tuple[float, float]

MOST_ROWS = 1500  # on a page; more would only be averaged by the screen
GAP = 1.5  # frame intervals between two rows: more is a gap and left empty
MOST_LINES = 40  # slips with a line across; more are marked at the edge alone
SLIP_COLOUR, EMPTY_COLOUR = "#d55e00", "#cfe3f5"
ROWS_PER_INCH = 75
FEW_FRAMES = 60  # that need dots to be seen: a line has no point of its own


def write_kymograph_picture(
    path: Path,
    diagrams: Sequence[xr.DataArray],
    *,
    slips_s: Doubles | None = None,
    slips_from: str = "the force",
) -> None:
    """One panel per diagram of `space_time`, side by side, with one time axis and one grey scale for all.

    slips_s, times on the recording's clock, taken from `slips_from`. The kind of picture is the file name's
    ending: png, pdf or svg.
    """
    from matplotlib.figure import Figure

    narrow = "sheet" in diagrams[0].attrs
    rows = max(len(diagram) for diagram in diagrams)
    height = float(np.clip(rows / ROWS_PER_INCH, 4, 9)) if narrow else 8.0
    with picture_style():
        figure = Figure(figsize=(1.2 + 2.4 * len(diagrams) if narrow else 13, height))
        figure.set_layout_engine("constrained", wspace=0.04)
        panels = figure.subplots(1, len(diagrams), sharey=True, squeeze=False)[0]
        limits = grey_limits(diagrams)
        for ax, diagram in zip(panels, diagrams, strict=True):
            draw_kymograph(ax, diagram, slips_s=slips_s, limits=limits)
            ax.label_outer()
            ax.xaxis.set_tick_params(labelbottom=True)
        if slips_s is not None and slips_s.size:
            about = f"orange: slips, from {slips_from}"
            figure.supxlabel(about, color=SLIP_COLOUR, fontsize=8, x=0.99, ha="right")
        figure.savefig(path, dpi=150)


def draw_kymograph(
    ax: Axes,
    diagram: xr.DataArray,
    *,
    tracks: xr.Dataset | None = None,
    slips_s: Doubles | None = None,
    limits: Limits | None = None,
) -> Axes:
    """I(x, t) with time downwards; what is not there is pale blue, slips are orange.

    Args: diagram, of `space_time`, with pixel_size_um in its attributes where lengths are to be in µm or mm;
    tracks, of `track_sheets`, drawn on the whole strip; slips_s, times on the recording's clock; limits, grey
    levels of black and white.
    Long diagrams are averaged over rows to what a page can show. Gaps in the frames' times stay gaps.
    """
    import matplotlib as mpl

    low, high = limits or grey_limits([diagram])
    time, time_label = time_axis(diagram)
    values, edges = _rows(np.asarray(diagram.values), time)
    x, x_label = _columns(diagram)
    grey = mpl.colormaps["gray"].with_extremes(bad=EMPTY_COLOUR)
    ax.pcolorfast(x, edges, np.ma.masked_invalid(values), cmap=grey, vmin=low, vmax=high)
    if tracks is not None:
        _draw_tracks(ax, tracks, time, diagram)
    ax.set(xlabel=x_label, ylabel=time_label, xlim=(x[0], x[-1]), ylim=(edges[-1], edges[0]))
    ax.set_title(_title(diagram) + (" with the tracks" if tracks is not None else ""), loc="left")
    if "sheet" in diagram.attrs:
        ax.locator_params(axis="x", nbins=4, prune="both")
    if slips_s is not None and time_label != "frame":
        _mark(ax, slips_s[(slips_s >= edges[0]) & (slips_s <= edges[-1])])
    return ax


def _draw_tracks(ax: Axes, tracks: xr.Dataset, time: Doubles, diagram: xr.DataArray) -> None:
    scale, _ = position_unit(diagram.attrs.get("pixel_size_um"), diagram.sizes["x"])
    at, lines = outline(time, tracks["x_px"].values * scale, most=2 * MOST_ROWS)
    for x, colour in zip(lines.T, sheet_colours(tracks), strict=True):
        ax.plot(x, at, lw=0.7, color=colour, **dots(len(at)))


def dots(frames: int) -> dict[str, Any]:
    """Markers for a line of few points."""
    return {"marker": "o", "ms": 2.5} if frames <= FEW_FRAMES else {}


def grey_limits(diagrams: Sequence[xr.DataArray]) -> Limits:
    """Grey levels shown as black and white, the same for all: all but the outermost half per cent."""
    known = [d.values[:: max(1, len(d) // MOST_ROWS)].ravel() for d in diagrams]
    grey = np.concatenate([values[np.isfinite(values)] for values in known])
    if not grey.size:
        return 0.0, 1.0
    low, high = np.percentile(grey, (0.5, 99.5))
    return float(low), max(float(high), float(low) + 1e-6)


def _mark(ax: Axes, slips_s: Doubles) -> None:
    """A pointer at both edges for each slip and a thin line across; short ticks alone where they are many."""
    if not slips_s.size:  # nothing drawn would still take room in the layout
        return
    few = slips_s.size <= MOST_LINES
    look: dict[str, Any] = {"ms": 5, "mec": "white", "mew": 0.5} if few else {"ms": 9, "mew": 0.6}
    for place, pointer in ((0.0, ">"), (1.0, "<")):
        ax.plot(
            np.full(slips_s.size, place),
            slips_s,
            pointer if few else "_",
            color=SLIP_COLOUR,
            transform=ax.get_yaxis_transform(),
            clip_on=False,
            zorder=3,
            **look,
        )
    if few:
        ax.hlines(slips_s, *ax.get_xlim(), color=SLIP_COLOUR, lw=0.7, ls=(0, (4, 4)))


def _columns(diagram: xr.DataArray) -> tuple[Doubles, str]:
    """Edges of the columns, and their label: mm, or µm below 1 mm and in a window; px without a scale."""
    x = np.asarray(diagram["x"].values, np.float64)
    edges = np.append(x - 0.5, x[-1] + 0.5)
    size = diagram.attrs.get("pixel_size_um")
    if "sheet" not in diagram.attrs:
        scale, unit = position_unit(size, x.size)
        return edges * scale, f"x ({unit})"
    name = "x − x(n,t)"
    if not diagram.attrs["follow"]:
        edges, name = edges - diagram.attrs["centre_px"], "x − x₀"
    return (edges, f"{name} (px)") if size is None else (edges * size, f"{name} (µm)")


def _title(diagram: xr.DataArray) -> str:
    if "sheet" not in diagram.attrs:
        return "Space-time diagram of the strip"
    side, n = diagram.attrs["sheet"].split(":")
    size, centre = diagram.attrs.get("pixel_size_um"), diagram.attrs["centre_px"]
    place = f"{centre:.1f} px" if size is None else f"{centre * size / UM_PER_MM:.2f} mm"
    return f"{side}, n = {n}" + ("" if diagram.attrs["follow"] else f"\nx₀ = {place}")


def _rows(values: NDArray[np.float32], time: Doubles) -> tuple[NDArray[np.float32], Doubles]:
    """Rows fit for a page and the times of their edges; an empty row stands for each gap in time."""
    values, time = _averaged(values, time)
    steps = np.diff(time)
    step = float(np.median(steps)) if steps.size else 1.0
    gap = steps > GAP * step
    between = np.where(gap, time[:-1] + step / 2, time[:-1] + steps / 2)
    after = np.flatnonzero(gap) + 1
    edges = np.insert(between, after, time[after] - step / 2)
    values = np.insert(values, after, np.nan, axis=0)
    return values, np.r_[time[0] - step / 2, edges, time[-1] + step / 2]


def _averaged(values: NDArray[np.float32], time: Doubles) -> tuple[NDArray[np.float32], Doubles]:
    """Means over as many rows as it takes to have no more than MOST_ROWS; NaN where all are NaN."""
    k = -(-len(values) // MOST_ROWS)
    if k == 1:
        return values, time
    ends = np.append(np.arange(0, len(values), k), len(values))
    return mean_rows(values, ends), np.add.reduceat(time, ends[:-1]) / np.diff(ends)
