"""overview.png: the frame with strip and sheets, the space-time diagram with tracks, and x(n, t) − mean."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vision.report.decimate import outline
from vision.report.style import axis_of, picture_style, sheet_colours

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.patches import Rectangle

MOST_ROWS = 1500  # of a space-time diagram on a page; more would only be averaged by the screen
MOST_LABELS = 26
LABELS_ACROSS = 50  # that would fill the width of the page
MOST_POINTS = 6000  # of a line on a page; extremes are kept
FEW_FRAMES = 60  # that need dots to be seen: a line has no point of its own


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
        draw_kymograph(middle, strip, tracks, pixel_size_um=pixel_size_um)
        draw_displacements(bottom, tracks, pixel_size_um=pixel_size_um)
        figure.savefig(path, dpi=110)


def write_kymograph_png(path: Path, strip: xr.DataArray, *, pixel_size_um: float | None) -> None:
    """The strip's space-time diagram with axes."""
    from matplotlib.figure import Figure

    with picture_style():
        figure = Figure(figsize=(13, 8), layout="constrained")
        draw_kymograph(figure.subplots(), strip, None, pixel_size_um=pixel_size_um)
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


def draw_kymograph(
    ax: Axes, strip: xr.DataArray, tracks: xr.Dataset | None, *, pixel_size_um: float | None
) -> Axes:
    """I(x, t), time downwards; with tracks drawn on it where given. White where frames are missing."""
    time, time_label = time_axis(strip)
    values, half = _even_rows(strip.values, time)
    scale, x_label = axis_of(pixel_size_um)
    x = strip["x"].values
    known = values[np.isfinite(values)]
    low, high = np.percentile(known, (0.5, 99.5)) if known.size else (0.0, 1.0)
    left, right, bottom, top = (x[0] - 0.5) * scale, (x[-1] + 0.5) * scale, time[-1] + half, time[0] - half
    look: Any = {"cmap": "gray", "aspect": "auto", "interpolation": "nearest"}
    ax.imshow(values, vmin=low, vmax=max(high, low + 1e-6), extent=(left, right, bottom, top), **look)
    if tracks is not None:
        dots = _dots(len(time))
        for x_px, colour in zip(tracks["x_px"].values.T, sheet_colours(tracks), strict=True):
            ax.plot(x_px * scale, time, lw=0.7, color=colour, **dots)
    ax.set(xlabel=x_label, ylabel=time_label, xlim=(left, right), ylim=(bottom, top))
    ax.set_title(
        "Space-time diagram of the strip" + (" with the tracks" if tracks is not None else ""), loc="left"
    )
    return ax


def _even_rows(values: NDArray[np.float32], time: NDArray[np.float64]) -> tuple[NDArray[np.float32], float]:
    """Rows of a picture whose time runs evenly, and half the time of a row.

    Each row is the frame nearest to its time, NaN where that is further than a frame's own time: a gap in
    the time stamps is a gap in the picture.
    """
    frames = len(time)
    if frames == 1:
        return values, 0.5
    usual = float(np.median(np.diff(time)))
    rows = min(MOST_ROWS, round((time[-1] - time[0]) / usual) + 1)
    wanted = np.linspace(time[0], time[-1], rows)
    after = np.clip(np.searchsorted(time, wanted), 1, frames - 1)
    nearest = np.where(wanted - time[after - 1] < time[after] - wanted, after - 1, after)
    out = np.array(values[nearest])
    out[np.abs(time[nearest] - wanted) > usual] = np.nan
    return out, 0.5 * float(time[-1] - time[0]) / (rows - 1)


def _dots(frames: int) -> dict[str, Any]:
    """Markers for a line of few points."""
    return {"marker": "o", "ms": 2.5} if frames <= FEW_FRAMES else {}


def draw_displacements(ax: Axes, tracks: xr.Dataset, *, pixel_size_um: float | None) -> Axes:
    """x(n, t) less its mean for every sheet; one hue per side, dark at the centre."""
    time, time_label = time_axis(tracks)
    scale, x_label = axis_of(pixel_size_um, small=True)
    x = tracks["x_px"].values
    known = np.isfinite(x)
    mean = np.where(known, x, 0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    short, lines = outline(time, (x - mean) * scale, most=MOST_POINTS)
    for line, colour in zip(lines.T, sheet_colours(tracks), strict=True):
        ax.plot(short, line, lw=0.8, color=colour, **_dots(len(short)))
    _name_sides(ax, tracks)
    ax.set(xlabel=time_label, ylabel=x_label.replace("x", "x − mean", 1))
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
    """A line through the strip for every sheet seen, with n above as far as there is room."""
    x, colours, n = _first_row(tracks), sheet_colours(tracks), tracks["n"].values
    step = max(1, -(-tracks.sizes["sheet"] // MOST_LABELS))
    room, last = np.ptp(ax.get_xlim()) / LABELS_ACROSS, -np.inf
    box = {"boxstyle": "round,pad=0.12", "fc": "white", "ec": "none", "alpha": 0.75}
    look: Any = {"textcoords": "offset points", "ha": "center", "va": "bottom", "fontsize": 7, "bbox": box}
    for i in np.flatnonzero(np.isfinite(x)):
        ax.plot([x[i], x[i]], [top, bottom], color=colours[i], lw=0.9)
        if (n[i] - 1) % step == 0 and x[i] - last > room:
            ax.annotate(str(n[i]), (x[i], top), (0, 3), **look)
            last = x[i]


def _first_row(tracks: xr.Dataset) -> NDArray[np.float64]:
    """Positions in the frame that is shown: the first with most sheets."""
    known = np.isfinite(tracks["x_px"].values).sum(axis=1)
    return np.asarray(tracks["x_px"].values[int(np.argmax(known > 0))], np.float64)


def time_axis(data: xr.Dataset | xr.DataArray) -> tuple[NDArray[np.float64], str]:
    """Seconds, or frame numbers where the clock is unknown or runs backwards; the label says if it is a
    playback rate."""
    time = np.asarray(data["time_s"].values, np.float64)
    if not (np.isfinite(time).all() and (np.diff(time) > 0).all()):
        return np.asarray(data["frame"].values, np.float64), "frame"
    return time, "t (s, playback rate)" if data.attrs.get("clock_kind") == "playback" else "t (s)"


def _rectangle(x: float, y: float, width: float, height: float) -> Rectangle:
    from matplotlib.patches import Rectangle

    return Rectangle((x, y), width, height, fill=False, ec="#d55e00", lw=1.6)
