"""Space-time diagrams with axes: the strip, or windows around several sheets side by side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vision.report.overview import MOST_ROWS, time_axis
from vision.report.style import picture_style

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes

Doubles = NDArray[np.float64]
Limits = tuple[float, float]

GAP = 1.5  # frame intervals between two rows: more is a gap and left empty
MOST_LINES = 40  # slips with a line across; more are marked at the edge alone
SLIP_COLOUR, EMPTY_COLOUR = "#d55e00", "#cfe3f5"
ROWS_PER_INCH = 75
UM_PER_MM = 1000
ROWS_AT_ONCE = 256  # of a page, averaged at a time


def write_space_time_picture(
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
            draw_space_time(ax, diagram, slips_s=slips_s, limits=limits)
            ax.label_outer()
            ax.xaxis.set_tick_params(labelbottom=True)
        if slips_s is not None and slips_s.size:
            about = f"orange: slips, from {slips_from}"
            figure.supxlabel(about, color=SLIP_COLOUR, fontsize=8, x=0.99, ha="right")
        figure.savefig(path, dpi=150)


def draw_space_time(
    ax: Axes, diagram: xr.DataArray, *, slips_s: Doubles | None = None, limits: Limits | None = None
) -> Axes:
    """I(x, t) with time downwards; what is not there is pale blue, slips are orange.

    Args: diagram, of `space_time`, with pixel_size_um in its attributes where lengths are to be in µm or mm;
    slips_s, times on the recording's clock; limits, grey levels of black and white.
    Long diagrams are averaged over rows to what a page can show. Gaps in the frames' times stay gaps.
    """
    import matplotlib as mpl

    low, high = limits or grey_limits([diagram])
    time, time_label = time_axis(diagram)
    values, edges = _rows(np.asarray(diagram.values), time)
    x, x_label = _columns(diagram)
    grey = mpl.colormaps["gray"].with_extremes(bad=EMPTY_COLOUR)
    ax.pcolorfast(x, edges, np.ma.masked_invalid(values), cmap=grey, vmin=low, vmax=high)
    ax.set(xlabel=x_label, ylabel=time_label, xlim=(x[0], x[-1]), ylim=(edges[-1], edges[0]))
    ax.set_title(_title(diagram), loc="left")
    if "sheet" in diagram.attrs:
        ax.locator_params(axis="x", nbins=4, prune="both")
    if slips_s is not None and time_label != "frame":
        _mark(ax, slips_s[(slips_s >= edges[0]) & (slips_s <= edges[-1])])
    return ax


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
        if size is None:
            return edges, "x (px)"
        wide = size * x.size >= UM_PER_MM
        return (edges * size / UM_PER_MM, "x (mm)") if wide else (edges * size, "x (µm)")
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
    block = k * ROWS_AT_ONCE
    means = [_means(values[start : start + block], k) for start in range(0, len(values), block)]
    return np.concatenate(means), _means(time[:, None], k)[:, 0]


def _means(values: NDArray[Any], k: int) -> NDArray[Any]:
    """Means of k rows at a time, of fewer at the end, leaving NaN out."""
    starts = np.arange(0, len(values), k)
    known = np.isfinite(values)
    count = np.add.reduceat(known, starts, axis=0, dtype=np.int32)
    total = np.add.reduceat(np.where(known, values, 0), starts, axis=0, dtype=np.float64)
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan), values.dtype)
