"""overview.png: the frame with strip and sheets, the space-time diagram with tracks, and x(n, t) − mean."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vision.report.axes import displacement_unit, time_axis
from vision.report.decimate import outline
from vision.report.kymograph import dots, draw_kymograph
from vision.report.style import STROKE, picture_style, sheet_colours
from vision.spacetime import space_time

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.patches import Rectangle

LABELS_ACROSS = 80  # that would fill the width of the page
MOST_POINTS = 4000  # of a line on a page, more than it has pixels; extremes are kept


def write_overview(
    path: Path,
    frame: NDArray[np.generic],
    strip: xr.DataArray,
    tracks: xr.Dataset,
    *,
    pixel_size_um: float | None,
) -> None:
    """One page to judge a run by.

    Args: frame, one whole frame (rows, columns); strip, I(x, t); tracks, from `track_sheets`.
    """
    from matplotlib.figure import Figure

    with picture_style():
        figure = Figure(figsize=(13, 15), layout="constrained")
        rows, columns = frame.shape
        tall = float(np.clip(12.5 * rows / columns, 2.0, 5))
        top, middle, bottom = figure.subplots(3, 1, height_ratios=[tall, 6, 5])
        draw_frame(top, frame, strip, tracks)
        draw_kymograph(middle, space_time(strip, pixel_size_um=pixel_size_um), tracks=tracks)
        draw_displacements(bottom, tracks, pixel_size_um=pixel_size_um)
        figure.savefig(path, dpi=110)


def draw_frame(ax: Axes, frame: NDArray[np.generic], strip: xr.DataArray, tracks: xr.Dataset) -> Axes:
    """One frame, the strip's rows framed, sheets numbered n from the axis outwards."""
    grey = frame.astype(np.float32)
    low, high = np.percentile(grey, (0.5, 99.8))
    ax.imshow(grey, cmap="gray", vmin=low, vmax=max(high, low + 1), aspect="auto", interpolation="nearest")
    z0, z1 = strip.attrs["strip_z0"], strip.attrs["strip_z1"]
    x0, x1 = strip["x"].values[[0, -1]]
    ax.add_patch(_rectangle(x0 - 0.5, z0 - 0.5, x1 - x0 + 1, z1 - z0))
    ax.set_xlim(-0.5, frame.shape[1] - 0.5)
    _number_sheets(ax, tracks, z0 - 0.5, z1 - 0.5)
    for colour, dashes in (("white", "solid"), ("black", (0, (6, 4)))):  # seen on dark and on light ground
        ax.axvline(tracks.attrs["axis_px"], color=colour, lw=1, ls=dashes)
    ax.set(xlabel="x (px)", ylabel="z (px)")
    title = f"Frame with the strip (rows {z0}:{z1}), the symmetry axis (dashed) and the sheets' numbers n"
    ax.set_title(title, loc="left", pad=16)
    return ax


def draw_displacements(ax: Axes, tracks: xr.Dataset, *, pixel_size_um: float | None) -> Axes:
    """x(n, t) less its mean for every sheet; one hue per side, dark at the centre."""
    time, time_label = time_axis(tracks)
    scale, unit = displacement_unit(pixel_size_um)
    x = tracks["x_px"].values
    known = np.isfinite(x)
    mean = np.where(known, x, 0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    short, lines = outline(time, (x - mean) * scale, most=MOST_POINTS)
    for line, colour in zip(lines.T, sheet_colours(tracks), strict=True):
        ax.plot(short, line, lw=0.8, color=colour, **dots(len(short)))
    _name_sides(ax, tracks)
    ax.set(xlabel=time_label, ylabel=f"x − mean ({unit})")
    if time[-1] > time[0]:
        ax.set_xlim(time[0], time[-1])
    if not known.any():
        ax.text(0.5, 0.5, "no positions", transform=ax.transAxes, ha="center", color="0.4")
    ax.set_title("Displacement of every sheet", loc="left")
    ax.grid(alpha=0.3)
    return ax


def _name_sides(ax: Axes, tracks: xr.Dataset) -> None:
    """The legend, above the lines so that it hides none."""
    side, n, colours = tracks["side"].values, tracks["n"].values, sheet_colours(tracks)
    for sign, name in ((-1, "left"), (1, "right")):
        mine = np.flatnonzero(side == sign)
        if len(mine):
            outer = mine[np.argmax(n[mine])]
            span = f"{n[mine].min()} (dark) to {n[outer]} (bright)" if len(mine) > 1 else f"{n[outer]}"
            ax.plot([], [], color=colours[outer], lw=2, label=f"{name}, n = {span}")
    ax.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=2, borderaxespad=0.1)


def _number_sheets(ax: Axes, tracks: xr.Dataset, top: float, bottom: float) -> None:
    """Strokes at the strip's edges for every sheet seen, with n above as far as there is room."""
    x, colours, n = _first_row(tracks), sheet_colours(tracks), tracks["n"].values
    known = np.flatnonzero(np.isfinite(x))
    room, last = np.ptp(ax.get_xlim()) / LABELS_ACROSS, -np.inf
    pitch = float(np.median(np.diff(x[known]))) if known.size > 1 else room
    step, stroke = max(1, int(np.ceil(room / pitch))), STROKE * (bottom - top)
    box = {"boxstyle": "round,pad=0.12", "fc": "white", "ec": "none", "alpha": 0.75}
    look: Any = {"textcoords": "offset points", "ha": "center", "va": "bottom", "fontsize": 7, "bbox": box}
    for i in known:
        for start, stop in ((top, top + stroke), (bottom - stroke, bottom)):
            ax.plot([x[i], x[i]], [start, stop], color=colours[i], lw=0.9)
        if (n[i] - 1) % step == 0 and x[i] - last > room:
            ax.annotate(str(n[i]), (x[i], top), (0, 3), **look)
            last = x[i]


def _first_row(tracks: xr.Dataset) -> NDArray[np.float64]:
    """Positions in the frame that is shown: the first with most sheets."""
    known = np.isfinite(tracks["x_px"].values).sum(axis=1)
    return np.asarray(tracks["x_px"].values[int(np.argmax(known > 0))], np.float64)


def _rectangle(x: float, y: float, width: float, height: float) -> Rectangle:
    from matplotlib.patches import Rectangle

    return Rectangle((x, y), width, height, fill=False, ec="#d55e00", lw=1.6)
