"""Figures drawn by matplotlib, on given axes or as files.

Files start from matplotlib's defaults whatever matplotlibrc says, and from fixed places for the axes: layout
engines and tight bounding boxes draw everything twice. pyplot is not imported.
"""

from __future__ import annotations

import sys
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure as Page
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.transforms import blended_transform_factory

from vision.figures.figure import Arrow, Band, Figure, Image, Panel, Series
from vision.figures.labels import to_mathtext
from vision.figures.style import CASING, HIGHLIGHT, MISSING, MODEL, QUIET

PNG_DPI, VECTOR_DPI = 100, 300
STROKE = 0.2  # of the strip's height: a sheet is marked above and below, so that its ridge stays in view
MOST_LINES = 40  # marked times with a line across; more are marked at the edges alone
# A sixth of the time of `savefig`: no alpha channel, little compression, each row less the one above it.
_PNG = (cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP)
_DASHES = (0, (4, 2))
_GREYS = mpl.colormaps["gray"].with_extremes(bad=MISSING)
_STYLE: dict[str, Any] = {
    "font.family": "DejaVu Sans",  # comes with matplotlib and has all letters that figures need
    "font.size": 10,
    "axes.titlesize": 11,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "image.composite_image": False,
    "mathtext.default": "regular",
    "svg.fonttype": "none",
    "pdf.fonttype": 42,
}
# inches
_LEFT, _INNER, _BOTTOM, _TOP = 0.8, 0.15, 0.55, 0.12
_TITLE, _LEGEND = 0.26, 0.24
_LEAST_HEIGHT, _MOST_HEIGHT = 0.35, 9.0
_LETTER, _MARKER = 0.075, 0.55  # of a legend's entry

SCALE_POINTS = 19  # of a frame's grey scale below it: past the numbers of the axis


_TICK_ROOM_IN = 0.22  # height that a number on the y axis needs


def draw_panel(ax: Axes, panel: Panel) -> Axes:
    """Draw a panel on these axes with colours for a light background, and return them.

    A second y axis is added where the panel has one. The legend stands above the axes, where it hides no
    data.
    """
    right = ax.twinx() if panel.y2_label else None
    if panel.image is not None:
        _draw_image(ax, panel.image, square=panel.square_pixels)
    _draw_bands(ax, panel)
    if panel.switchable:
        _draw_sheets(ax, panel)
    else:
        for series in panel.series:
            if series.look != "ticks":
                _draw_series(right if series.axis == "right" and right else ax, series)
    for x in panel.x_lines:
        for colour, dashes in (("white", "-"), (QUIET[0], (0, (6, 4)))):  # visible on dark and light images
            ax.axvline(x, color=colour, lw=1, ls=dashes)
    _set_axes(ax, right, panel)
    _draw_annotations(ax, panel)
    if panel.empty:
        ax.text(0.5, 0.5, panel.placeholder, transform=ax.transAxes, ha="center", color=QUIET[0])
        ax.set(xticks=[], yticks=[])
    _draw_legend(ax, panel)
    return ax


def _draw_annotations(ax: Axes, panel: Panel) -> None:
    """What explains the data: arrows, a grey scale, numbers, an inset, marks along the edge."""
    _draw_arrows(ax, panel.arrows)
    if panel.image is not None and panel.image.scale:
        _draw_scale(ax, panel.image.scale, below=panel.downwards)
    _draw_ticks(ax, [series for series in panel.series if series.look == "ticks"])
    if panel.inset is not None:
        _draw_inset(ax, panel.inset)
    if panel.marks is not None and panel.marks.size:
        _draw_marks(ax, panel.marks)


def new_figure(figure: Figure, *, interactive: bool = False) -> Page:
    """A matplotlib figure with every panel in its place.

    interactive: made by pyplot in a notebook that uses it, so that it is shown below the cell.
    """
    with picture_style():
        boxes, size = _layout(figure)
        notebook = interactive and "ipykernel" in sys.modules
        pyplot = sys.modules.get("matplotlib.pyplot") if notebook else None
        page: Page = pyplot.figure(figsize=size) if pyplot else Page(figsize=size)
        for panel, box in zip(figure.panels, boxes, strict=True):
            ax = page.add_axes(box)
            draw_panel(ax, panel)
            _thin_ticks(ax, box[3] * size[1])
            if len(figure.panels) > 1:
                # not `set_title`, which measures everything around the axes
                legend = (
                    0.0
                    if _one_row(panel, box[2] * size[0])
                    else _LEGEND * _legend_rows(panel, box[2] * size[0])
                )
                top = box[1] + box[3] + (0.06 + legend) / size[1]
                page.text(box[0], top, to_mathtext(panel.title), fontsize=11)
            if not _labelled(panel):
                ax.tick_params(labelleft=False)
        if label := next((p.marks_label for p in figure.panels if p.marks is not None and p.marks.size), ""):
            page.text(1 - 0.1 / size[0], 0.05 / size[1], label, color=HIGHLIGHT, fontsize=8, ha="right")
    return page


def _thin_ticks(ax: Axes, height_in: float) -> None:
    """Only as many numbers along y as the height of a flat panel has room for."""
    low, high = sorted(ax.get_ylim())
    ticks = [float(y) for y in ax.get_yticks() if low <= y <= high]
    room = max(int(height_in / _TICK_ROOM_IN), 1)
    if 1 < room < len(ticks):
        ax.set_yticks([ticks[0], ticks[-1]])
    elif room < len(ticks):
        ax.set_yticks(ticks[-1:])


def write(figure: Figure, path: Path, *, dpi: float | None = None) -> None:
    """Write a PNG, PDF or SVG, by the path's ending; the same figure gives the same file."""
    kind = path.suffix.lower().removeprefix(".")
    if kind == "png":
        path.write_bytes(png(figure, dpi=dpi))
        return
    with picture_style():
        stamp: dict[str, Any] = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}[kind]
        page = new_figure(figure)
        page.savefig(path, format=kind, dpi=VECTOR_DPI if dpi is None else dpi, metadata=stamp)


def png(figure: Figure, *, dpi: float | None = None) -> bytes:
    """The figure as PNG."""
    with picture_style():
        page = new_figure(figure)
        page.set_dpi(PNG_DPI if dpi is None else dpi)
        canvas: Any = FigureCanvasAgg(page)
        canvas.draw()
        pixels = cv2.cvtColor(np.asarray(canvas.buffer_rgba()), cv2.COLOR_RGBA2BGR)
    return cv2.imencode(".png", pixels, _PNG)[1].tobytes()


def picture_style() -> AbstractContextManager[None]:
    """matplotlib's own defaults and the style of these figures, for as long as the block lasts."""
    plain: dict[Any, Any] = {k: v for k, v in mpl.rcParamsDefault.items() if not k.startswith("backend")}
    return mpl.rc_context(plain | _STYLE)


# --- one panel ----------------------------------------------------------------------------------------------


def _draw_image(ax: Axes, image: Image, *, square: bool) -> None:
    extent = (image.left, image.right, image.bottom, image.top)
    # Grey values, which become colours where the page shows them: a quarter of the time of an RGB image.
    look: dict[str, Any] = {"aspect": "equal" if square else "auto", "interpolation": "nearest"}
    look |= {"cmap": _GREYS, "vmin": -0.5, "vmax": 255.5, "interpolation_stage": "data"}
    pixels = image.pixels if image.missing is None else np.ma.masked_array(image.pixels, image.missing)
    ax.imshow(pixels, extent=extent, **look)


def _draw_scale(ax: Axes, text: str, *, below: bool) -> None:
    """The grey scale in words: below a frame, which may be flat, beside the axis label, at the end of the
    panel's room, since a frame may be narrow; else in the corner of the image."""
    look: dict[str, Any] = {"ha": "right", "fontsize": 6.5}
    if below and (page := ax.get_figure(root=True)) is not None:
        room = blended_transform_factory(page.transFigure, ax.transAxes)
        end = (ax.get_position(original=True).x1, 0.0)
        place: dict[str, Any] = {"xytext": (0, -SCALE_POINTS), "textcoords": "offset points", "va": "top"}
        ax.annotate(text, end, xycoords=room, color=QUIET[0], annotation_clip=False, **place, **look)
    else:
        box = {"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.8}
        ax.text(0.99, 0.01, text, bbox=box, transform=ax.transAxes, va="bottom", **look)


def _draw_bands(ax: Axes, panel: Panel) -> None:
    for band in panel.bands:
        if band.outline:
            low, high = panel.x_range or ax.get_xlim()
            size = high - low, band.high - band.low
            ax.add_patch(Rectangle((low, band.low), *size, fill=False, ec=HIGHLIGHT, lw=1.5))
        else:
            shade = ax.axvspan if band.of_x else ax.axhspan
            shade(band.low, band.high, color=QUIET[0], alpha=0.15, lw=0)


def _draw_sheets(ax: Axes, panel: Panel) -> None:
    """Lines of many sheets, those of one side in one collection: three times as fast as one by one."""
    dots = [series for series in panel.series if series.look == "both"]
    for dashed in (True, False):
        mine = [series for series in panel.series if series.dashed == dashed and np.isfinite(series.y).any()]
        lines = [np.stack([s.y, s.x] if panel.time_down else [s.x, s.y], axis=1) for s in mine]
        if lines:
            look: dict[str, Any] = {"linewidths": mine[0].width, "linestyles": _DASHES if dashed else "-"}
            if panel.image is not None:  # coloured lines are lost on white ridges without a dark edge
                casing: dict[str, Any] = {"colors": CASING, "linewidths": mine[0].width + 0.9, "alpha": 0.7}
                ax.add_collection(LineCollection(lines, **casing))
            ax.add_collection(LineCollection(lines, colors=[s.ink[0] for s in mine], **look))
    for series in dots:  # few points: a line alone would hide where they are
        x, y = (series.y, series.x) if panel.time_down else (series.x, series.y)
        ax.plot(x, y, ls="none", marker="o", ms=2.5, color=series.ink[0])


def _draw_series(ax: Axes, series: Series) -> None:
    colour, at = series.ink[0], series.x + series.shift
    if series.low is not None and series.high is not None:
        if series.look == "line":  # a spread about a curve
            ax.fill_between(at, series.low, series.high, color=colour, alpha=0.2, lw=0)
        else:
            ax.vlines(at, series.low, series.high, color=colour, lw=0.9)
    if series.look == "steps":
        width = float(series.x[1] - series.x[0]) if len(series.x) > 1 else 1.0
        ax.bar(at, series.y, width, color=colour, alpha=0.5, ec=colour, label=series.label)
        return
    ax.plot(at, series.y, label=to_mathtext(series.label) or "_", **_line_look(series))


def _line_look(series: Series) -> dict[str, Any]:
    look: dict[str, Any] = {
        "color": series.ink[0],
        "lw": series.width,
        "ls": _DASHES if series.dashed else "-",
    }
    if series.look in ("points", "both"):
        look |= {"marker": "o", "ms": 3.5, "mfc": "none" if series.hollow else series.ink[0], "mew": 0.9}
    if series.look == "points":
        look |= {"ls": "none", "ms": 5.5 if series.hollow else 3.0}  # a point within a ring shows both
    return look


def _draw_ticks(ax: Axes, groups: list[Series]) -> None:
    """Strokes at both ends of every tick, with as many numbers above as fit. The x range must be set."""
    low, high = ax.get_xlim()
    letter = abs(high - low) / max(_width_in(ax), 0.1) * 0.075  # width of a digit in units of the axis
    taken: list[tuple[float, float]] = []
    box = {"boxstyle": "round,pad=0.12", "fc": "white", "ec": "none", "alpha": 0.75}
    for series in groups:
        if series.low is None or series.high is None:
            continue
        stroke = STROKE * (series.high - series.low)
        ends = ((series.low, series.low + stroke), (series.high - stroke, series.high))
        for start, stop in ends:
            ax.vlines(series.x, start, stop, color=series.ink[0], lw=0.9)
        room = letter * (0.8 + max((len(text) for text in series.text), default=1))
        step = label_step(series.x, room)
        for x, y, text in zip(series.x, series.low, series.text, strict=True):
            span = (x - room / 2, x + room / 2)
            if (int(text) - 1) % step or any(span[0] < b and a < span[1] for a, b in taken):
                continue
            taken.append(span)
            place: dict[str, Any] = {"textcoords": "offset points", "ha": "center", "va": "bottom"}
            ax.annotate(text, (x, y), (0, 3), fontsize=7, bbox=box, **place)


def _draw_inset(ax: Axes, panel: Panel) -> None:
    small = ax.inset_axes((0.52, 0.58, 0.46, 0.40))
    for series in panel.series:
        _draw_series(small, replace(series, label=""))
    small.set_xlabel(to_mathtext(panel.x_label), fontsize=8, labelpad=1)
    small.set_ylabel(to_mathtext(panel.y_label), fontsize=8, labelpad=1)
    small.tick_params(labelsize=7)
    for line in small.lines:
        line.set_markersize(2.0)


def label_step(x: Any, room: float) -> int:
    """Every how many-th of these points has `room` for a label: 1, 2, 5, 10, 20 …"""
    pitch = float(np.median(np.abs(np.diff(x)))) if len(x) > 1 else room
    least = room / max(pitch, 1e-9)
    steps = np.outer(10 ** np.arange(6), [1, 2, 5]).ravel()
    return int(steps[min(int(np.searchsorted(steps, least)), steps.size - 1)])


def _draw_arrows(ax: Axes, arrows: tuple[Arrow, ...]) -> None:
    for arrow in arrows:
        (x0, x1), (y0, y1) = arrow.x, arrow.y
        head: dict[str, Any] = {
            "arrowstyle": "<->" if arrow.double else "->",
            "shrinkA": 0,
            "shrinkB": 0,
            "color": MODEL[0],
            "lw": 1.1,
        }
        ax.annotate("", (x1, y1), (x0, y0), arrowprops=head)
        upright = abs(x1 - x0) < 1e-9 * max(abs(x0), abs(x1), 1e-9)
        look: dict[str, Any] = {"textcoords": "offset points", "fontsize": 10}
        look |= {"ha": "left", "va": "center"} if upright else {"ha": "center", "va": "bottom"}
        middle = ((x0 + x1) / 2, (y0 + y1) / 2)
        ax.annotate(to_mathtext(arrow.label), middle, (5, 0) if upright else (0, 3), **look)


def _draw_marks(ax: Axes, marks: Any) -> None:
    """A pointer at both edges for each time and a thin line across; short ticks alone where they are many."""
    few = marks.size <= MOST_LINES
    look: dict[str, Any] = {"ms": 5, "mec": "white", "mew": 0.5} if few else {"ms": 9, "mew": 0.6}
    for edge, pointer in ((0.0, ">"), (1.0, "<")):
        ax.plot(
            np.full(marks.size, edge),
            marks,
            pointer if few else "_",
            color=HIGHLIGHT,
            transform=ax.get_yaxis_transform(),
            clip_on=False,
            zorder=3,
            **look,
        )
    if few:
        ax.hlines(marks, *ax.get_xlim(), color=HIGHLIGHT, lw=0.7, ls=(0, (4, 4)))


def _set_axes(ax: Axes, right: Axes | None, panel: Panel) -> None:
    along, across = panel.first_view or panel.x_range, panel.y_range
    labels = to_mathtext(panel.x_label), to_mathtext(panel.y_label)
    if panel.time_down:
        along, across, labels = across, along, labels[::-1]
    ax.set(xlabel=labels[0], ylabel=labels[1])
    if panel.x_log:
        ax.set_xscale("log")
    if panel.y_log:
        ax.set_yscale("log")
    if along is not None and along[1] > along[0]:
        ax.set_xlim(along)
    elif panel.image is None and all(series.look == "line" for series in panel.series):
        ax.margins(x=0)
    if across is not None and across[1] > across[0]:
        ax.set_ylim(across[::-1] if panel.downwards or panel.time_down else across)
    if panel.image is None:
        ax.grid(alpha=0.25)
    elif panel.downwards:  # no rows above the first
        ax.set_yticks([tick for tick in ax.get_yticks() if -0.5 <= tick <= panel.image.bottom])
    if right is not None:
        right.set_ylabel(to_mathtext(panel.y2_label))
        right.spines["right"].set_visible(True)
        _stack(ax, right, panel)


def _stack(ax: Axes, right: Axes, panel: Panel) -> None:
    """Ranges of two y axes, from what is in view, that put one curve above the other."""
    for own, side, below, above in ((ax, "left", 1.15, 0.05), (right, "right", 0.05, 1.15)):
        mine = [series for series in panel.series if series.axis == side]
        low, high = ax.get_xlim()
        seen = np.concatenate(
            [
                part[(s.x >= low) & (s.x <= high) & np.isfinite(part)]
                for s in mine
                for part in (s.y, s.low, s.high)  # error bars, too
                if part is not None
            ]
        )
        if seen.size:
            span = float(np.ptp(seen)) or 1.0
            own.set_ylim(float(seen.min()) - below * span, float(seen.max()) + above * span)


# --- legends ------------------------------------------------------------------------------------------------


def _draw_legend(ax: Axes, panel: Panel) -> None:
    entries = _legend_entries(panel)
    if entries:
        columns = _legend_columns(entries, _width_in(ax))
        handles = [_legend_handle(series, label) for series, label in entries]
        place: dict[str, Any] = {"loc": "lower right", "bbox_to_anchor": (1, 1), "borderaxespad": 0.1}
        ax.legend(handles=handles, fontsize=8, ncols=columns, frameon=False, columnspacing=1.2, **place)


def _legend_entries(panel: Panel) -> list[tuple[Series | Band, str]]:
    """What has a label; of sheets one entry a side, which names the tones. Nothing over an image."""
    if panel.image is not None or panel.empty:
        return []
    if not panel.switchable:
        parts: list[Series | Band] = [*panel.series, *panel.bands]
        return [(part, part.label) for part in parts if part.label]
    entries: list[tuple[Series | Band, str]] = []
    for side, name in ((-1, "left"), (1, "right")):
        mine = {s.sheet[1]: s for s in panel.series if s.sheet is not None and s.sheet[0] == side}
        if mine:
            span = f"{min(mine)} (dark) to {max(mine)} (bright)" if len(mine) > 1 else f"{max(mine)}"
            entries.append((mine[sorted(mine)[len(mine) // 2]], f"{name}, n = {span}"))
    return entries


def _legend_handle(series: Series | Band, label: str) -> Any:
    text = to_mathtext(label)
    if isinstance(series, Band):
        return Rectangle((0, 0), 1, 1, fc=QUIET[0], alpha=0.15, label=text)
    if series.look == "steps":
        return Rectangle((0, 0), 1, 1, fc=series.ink[0], alpha=0.5, ec=series.ink[0], label=text)
    return Line2D([], [], label=text, **_line_look(series) | {"lw": max(series.width, 1.2)})


def _legend_columns(entries: list[tuple[Series | Band, str]], width_in: float) -> int:
    lengths = [len(label) * _LETTER + _MARKER for _, label in entries]
    if sum(lengths) <= width_in:
        return len(entries)
    return int(np.clip(width_in // max(lengths), 1, len(entries)))


def _legend_rows(panel: Panel, width_in: float) -> int:
    """Rows that the legend takes above a panel of this width."""
    entries = _legend_entries(panel)
    if not entries:
        return 0
    return -(-len(entries) // _legend_columns(entries, width_in))


def _one_row(panel: Panel, width_in: float) -> bool:
    """Whether title and legend fit side by side."""
    labels = [label for _, label in _legend_entries(panel)]
    legend = sum(len(label) * _LETTER + _MARKER for label in labels)
    return legend + 0.09 * max(map(len, panel.title.split("\n"))) < width_in


# --- places -------------------------------------------------------------------------------------------------


def _layout(figure: Figure) -> tuple[list[tuple[float, float, float, float]], tuple[float, float]]:
    """Left, bottom, width and height of every panel as fractions of the page, and the page in inches."""
    columns = min(figure.columns, len(figure.panels))
    grid = [figure.panels[k : k + columns] for k in range(0, len(figure.panels), columns)]
    across = [[row[c] for row in grid if c < len(row)] for c in range(columns)]
    before = [_LEFT if any(map(_labelled, column)) else _INNER for column in across]
    after = [_LEFT if any(panel.y2_label for panel in column) else _INNER for column in across]
    width = (figure.width_in - sum(before) - sum(after)) / columns
    several = len(figure.panels) > 1
    heights = [
        float(np.clip(width * max(panel.aspect for panel in row), _LEAST_HEIGHT, _MOST_HEIGHT))
        for row in grid
    ]
    tops = [_TOP + max(_head(panel, width, several) for panel in row) for row in grid]
    bottom = _BOTTOM + (0.2 if any(panel.marks_label for panel in figure.panels) else 0)
    total = sum(heights) + sum(tops) + bottom * len(grid)
    boxes, y = [], total
    for row, height, top in zip(grid, heights, tops, strict=True):
        y -= top + height
        x = 0.0
        for column, _ in enumerate(row):
            x += before[column]
            boxes.append((x / figure.width_in, y / total, width / figure.width_in, height / total))
            x += width + after[column]
        y -= bottom
    return boxes, (figure.width_in, total)


def _labelled(panel: Panel) -> bool:
    """Whether the vertical axis has a label of its own."""
    return bool(panel.x_label if panel.time_down else panel.y_label)


def _head(panel: Panel, width_in: float, several: bool) -> float:
    """Height of title and legend above a panel."""
    legend = _LEGEND * _legend_rows(panel, width_in)
    if not several:
        return legend
    title = _TITLE * (1 + panel.title.count("\n"))
    return max(title, legend) if _one_row(panel, width_in) else title + legend


def _width_in(ax: Axes) -> float:
    figure = ax.get_figure(root=True)
    return float(ax.get_position().width * figure.get_figwidth()) if figure is not None else 5.0
