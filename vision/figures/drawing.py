"""Draw figures with matplotlib, on given axes or to files.

Files use matplotlib's defaults, not a user's matplotlibrc. Axes have computed positions, as layout engines
and tight bounding boxes draw everything twice. pyplot is not imported.
"""

from __future__ import annotations

import math
import re
import struct
import sys
import textwrap
import zlib
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure as Page
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from vision.data import SIDES
from vision.figures.figure import Arrow, Band, Figure, Image, Panel, Series
from vision.figures.style import (
    CASING,
    HIGHLIGHT,
    MANY_POINTS,
    MISSING,
    MODEL,
    QUIET,
    SLIPS,
    TURNS,
    label_step,
    to_mathtext,
)
from vision.numeric import Bools, Floats

MOST_LINES = 40  # marked times that get a line across; more are marked only at the edges
_DASHES = (0, (4, 2))
_STYLE: dict[str, Any] = {
    "font.family": "DejaVu Sans",  # part of matplotlib, with all characters that figures need
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.formatter.useoffset": False,  # its "+1.909e1" above the axis lies on the title
    "image.composite_image": False,
    "mathtext.default": "regular",
    "text.hinting": "no_hinting",  # saves 20 ms, and makes no difference at this size
    "svg.fonttype": "none",
    "svg.hashsalt": "sheetvision",  # names of parts of a drawing, which are random without it
    "pdf.fonttype": 42,
}


class _Inches(NamedTuple):
    """Sizes on a page with letters of 10 pt; `_inches` returns them for the letters in use."""

    side: float = 0.85  # margin of a panel with the numbers and label of an axis
    inner: float = 0.18  # without them
    top: float = 0.12  # above each panel
    bottom: float = 0.55  # below it
    foot: float = 0.16  # height of a line below the labels of a panel
    title: float = 0.26  # heights
    legend: float = 0.24  # height of a legend of one row
    legend_row: float = 0.175  # of each further one
    character: float = 0.075  # widths in a legend
    marker: float = 0.55
    title_character: float = 0.08  # widths of letters
    foot_character: float = 0.065
    label_character: float = 0.069
    number: float = 0.8  # width for each number of the x axis
    x_label: float = 0.3  # from an axis to its label
    y_label: float = 0.64  # at most, for the longest numbers
    tick: float = 0.17  # of it without the numbers: the tick and the gaps beside them
    digit: float = 0.0925  # of a number at an axis
    least_height: float = 0.35  # of a panel


_MOST_HEIGHT = 9.0  # of a panel, inches


def _letters() -> float:
    """Return the size of letters over 10 pt, for which sizes are given here."""
    return float(mpl.rcParams["font.size"]) / 10


def _inches() -> _Inches:
    return _Inches(*(_letters() * size for size in _Inches()))


def draw_panel(ax: Axes, panel: Panel, name: str = "") -> Axes:
    """Draw a panel on these axes with colours for a light background, and return the axes.

    A second y axis is added if the panel has one. The legend is above the axes, so that it hides no
    data, or inside them if the figure has no room there. It keeps the entries of what was drawn on the axes
    before; `name` precedes the new ones.
    """
    right = ax.twinx() if panel.y2_label else None
    if panel.image is not None:
        _draw_image(ax, panel, panel.image)
    _draw_bands(ax, panel)
    if panel.switchable:
        _draw_sheets(ax, panel)
    else:
        for series, first in _in_turns(panel.series):
            if series.look != "ticks":
                _draw_series(right if series.axis == "right" and right else ax, series, first)
    for x in panel.x_lines:
        for colour, dashes in (("white", "-"), (QUIET[0], (0, (6, 4)))):  # visible on dark and light images
            ax.axvline(x, color=colour, lw=1, ls=dashes)
    _set_axes(ax, right, panel)
    _draw_arrows(ax, panel.arrows)
    _draw_ticks(ax, [series for series in panel.series if series.look == "ticks"], panel.x_lines)
    if panel.inset is not None:
        _draw_inset(ax, panel.inset)
    if panel.marks is not None and panel.marks.size:
        _draw_marks(ax, panel.marks)
    if panel.empty:
        ax.text(0.5, 0.5, panel.placeholder, transform=ax.transAxes, ha="center", color=QUIET[0])
        ax.set(xticks=[], yticks=[])
    _draw_legend(ax, panel, name)
    return ax


def new_figure(figure: Figure) -> Page:
    """Return a matplotlib figure with all panels.

    In a notebook pyplot makes it, so that it is displayed below the cell.
    """
    page = Page()
    if "ipykernel" in sys.modules:
        import matplotlib.pyplot as plt

        page = plt.figure()  # outside of the style, in which pyplot would not be interactive, and remain so
    with picture_style():
        page.set_facecolor(mpl.rcParams["figure.facecolor"])
        return _page(figure, page)


def _page(figure: Figure, page: Page | None = None) -> Page:
    """Return a matplotlib figure, by default a new one, with all panels; the caller sets the style."""
    boxes, size = _layout(figure)
    page = Page() if page is None else page
    page.set_size_inches(size)
    axes, longest = list[Axes](), 0  # number at a y axis, in characters
    for k, (panel, (left, bottom, width, height)) in enumerate(zip(figure.panels, boxes, strict=True)):
        box = left / size[0], bottom / size[1], width / size[0], height / size[1]
        ax = page.add_axes(box)
        axes.append(ax)
        draw_panel(ax, panel)
        if not (panel.x_log or panel.empty):  # so that long numbers do not touch
            nbins = int(np.clip(width / _inches().number, 4, 9))
            ax.locator_params(axis="x", nbins=nbins, integer=panel.whole_numbers)
        if panel.y_whole_numbers:
            ax.locator_params(axis="y", integer=True)
        # By default matplotlib measures the tick labels at each drawing to place the axis labels.
        ax.xaxis.set_label_coords(0.5, -_inches().x_label / height)
        count = 99 if panel.y_log else _longest_number(ax)
        longest = max(longest, count)
        if not panel.y_log and count > 6:  # they would touch the label
            ax.tick_params(axis="y", labelsize=8 * _letters())
        if panel.y2_label:
            right = page.axes[-1]
            right.yaxis.set_label_coords(1 + _label_reach(_longest_number(right)) / width, 0.5)
        if figure.shows_titles:
            row = [other for other, box in zip(figure.panels, boxes, strict=True) if box[1] == bottom]
            top = bottom + height + 0.06 * _letters() + max(_head(other, width)[1] for other in row)
            page.text(box[0], top / size[1], to_mathtext(_title(panel, width)), fontsize=11 * _letters())
        if not _labelled(panel):
            ax.tick_params(labelleft=False)
        following = figure.panels[k + 1].foot if k + 1 < len(boxes) and boxes[k + 1][1] == bottom else ""
        if panel.foot != following:  # once for panels side by side
            below = (left + width) / size[0], (bottom - _inches().bottom) / size[1]
            page.text(
                *below, _foot(panel, width), color=QUIET[0], fontsize=8 * _letters(), ha="right", va="top"
            )
    for ax, (_, _, width, _) in zip(axes, boxes, strict=True):  # in line, one below the other
        ax.yaxis.set_label_coords(-_label_reach(longest) / width, 0.5)
    return page


def _longest_number(ax: Axes) -> int:
    """Return the length of the longest number at a y axis, in characters."""
    ends, ticks = sorted(ax.get_ylim()), ax.get_yticks()
    drawn = ticks[(ticks >= ends[0]) & (ticks <= ends[1])]
    return max(map(len, ax.yaxis.get_major_formatter().format_ticks(drawn.tolist())), default=0)


def _label_reach(characters: int) -> float:
    """Return how far the label of a y axis lies from it, beyond numbers of so many characters, inches."""
    return min(_inches().y_label, _inches().tick + characters * _inches().digit)


def write(figure: Figure, path: Path, *, dpi: float | None = None, font_size: float = 10.0) -> None:
    """Write a PNG, PDF or SVG, by the path's suffix; equal figures give equal files."""
    kind = path.suffix.lower()
    if kind == ".png":
        path.write_bytes(png(render(figure, dpi=dpi, font_size=font_size), dpi or 100))
        return
    undated = {"CreationDate" if kind == ".pdf" else "Date": None}
    with picture_style(font_size):
        _page(figure).savefig(path, dpi=300 if dpi is None else dpi, metadata=undated)


def render(figure: Figure, *, dpi: float | None = None, font_size: float = 10.0) -> NDArray[np.uint8]:
    """Return the figure's pixels, RGBA (rows, columns, 4)."""
    with picture_style(font_size):
        page = _page(figure)
        page.set_dpi(100 if dpi is None else dpi)
        canvas: Any = FigureCanvasAgg(page)
        canvas.draw()
    return np.asarray(canvas.buffer_rgba())


def write_png(pixels: NDArray[np.uint8], path: Path) -> None:
    """Write pixels as returned by `render`; other Python threads can run meanwhile."""
    path.write_bytes(png(pixels))


def png(pixels: NDArray[np.uint8], dpi: float | None = None) -> bytes:
    """Return the content of a PNG file of pixels as returned by `render`; with `dpi` it states its size."""
    # Without alpha channel, with little compression and the "up" filter: a sixth of the time of `savefig`.
    options = (cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP)
    content = cv2.imencode(".png", cv2.cvtColor(pixels, cv2.COLOR_RGBA2BGR), options)[1].tobytes()
    if dpi is None:
        return content
    per_metre = round(dpi / 0.0254)
    size = struct.pack(">4sIIB", b"pHYs", per_metre, per_metre, 1)
    chunk = struct.pack(">I13sI", 9, size, zlib.crc32(size))
    return content[:33] + chunk + content[33:]  # after the header


def picture_style(font_size: float = 10.0) -> AbstractContextManager[None]:
    """Return a context with matplotlib's defaults and the style of these figures; font_size: pt."""
    defaults: dict[Any, Any] = {k: v for k, v in mpl.rcParamsDefault.items() if not k.startswith("backend")}
    return mpl.rc_context(defaults | _STYLE | {"font.size": font_size})


# --- one panel ----------------------------------------------------------------------------------------------


def _draw_image(ax: Axes, panel: Panel, image: Image) -> None:
    pixels = image.pixels if image.missing is None else np.ma.masked_array(image.pixels, image.missing)
    ax.imshow(
        pixels,
        extent=(image.left, image.right, image.bottom, image.top),
        aspect="equal" if panel.square_pixels else "auto",
        interpolation="nearest",
        # Grey values, to which colours are applied last, take a quarter of the time of an RGB image.
        cmap=mpl.colormaps["gray"].with_extremes(bad=MISSING),
        vmin=0,
        vmax=255,
        interpolation_stage="data",
    )


def _draw_bands(ax: Axes, panel: Panel) -> None:
    for band in panel.bands:
        if band.outline:
            low, high = band.across or panel.x_range or ax.get_xlim()
            size = high - low, band.high - band.low
            ax.add_patch(Rectangle((low, band.low), *size, fill=False, ec=HIGHLIGHT, lw=1.5))
        else:
            shade = ax.axvspan if band.of_x else ax.axhspan
            shade(band.low, band.high, color=QUIET[0], alpha=0.15, lw=0)


def _draw_sheets(ax: Axes, panel: Panel) -> None:
    """Draw the lines of many sheets as one collection, which is three times as fast.

    If all would cover the panel, most are faint. The outer sheets are on top, of each pair the dashed one, so
    that both sides are seen where they coincide. Dots mark isolated positions, which a line does not show, or
    all positions if they are few. Over a space-time diagram lines are interrupted at jumps (`_interrupted`).
    """
    shown = [_interrupted(series, panel) if panel.time_down else series for series in panel.series]
    known = _bottom_up([series for series in shown if np.isfinite(series.y).any()])
    if known:
        lines = [np.stack([s.y, s.x] if panel.time_down else [s.x, s.y], axis=1) for s in known]
        width, full = known[0].width, _in_full(panel)
        if panel.image is not None or len(full) < len(panel.series):  # not to fill a small figure
            width *= min(1.0, _width_in(ax) / 12.0)  # in a panel 12 inches wide lines have their width
        if panel.image is not None:  # coloured lines are invisible on white ridges without a dark edge
            ax.add_collection(LineCollection(lines, linewidths=1.9 * width, colors=CASING, alpha=0.7))
        inks, dashes = [s.ink[0] for s in known], [_DASHES if s.dashed else "-" for s in known]
        widths = [width if s.sheet in full else 0.5 * width for s in known]
        alphas = [1.0 if s.sheet in full else 0.35 for s in known]
        style: dict[str, Any] = {"linewidths": widths, "linestyles": dashes, "alpha": alphas}
        ax.add_collection(LineCollection(lines, colors=inks, **style))
    size = 1.2 if panel.time_down else 2.5
    for series in shown:
        dots = np.isfinite(series.y) if series.look == "both" else _isolated(series.y)
        if dots.any():
            x, y = (series.y, series.x) if panel.time_down else (series.x, series.y)
            ax.plot(x[dots], y[dots], ls="none", marker="o", ms=size, color=series.ink[0])


def _in_full(panel: Panel) -> set[tuple[int, int]]:
    """Return the sheets whose lines are drawn in full: all, or a few if all would cover the panel.

    Together the lines may rise and fall by 600 heights of the panel. More would make long tests a solid
    block, less would fade lines that can be told apart: five slips of 50 sheets have 300, twelve have 670.
    """
    sheets = {series.sheet for series in panel.series if series.sheet is not None}
    if panel.image is not None:
        return sheets
    known = [y for series in panel.series if (y := series.y[np.isfinite(series.y)]).size]
    travel = sum(float(np.abs(np.diff(y)).sum()) for y in known)
    if not known or travel <= 600 * np.ptp(np.concatenate(known)):
        return sheets
    full: set[tuple[int, int]] = set()
    for side in (-1, 1):
        outwards = sorted(sheet for sheet in sheets if side * sheet[0] > 0)
        full.update(outwards[:: -max(1, -(-len(outwards) // 4))])  # the outermost and others, evenly inwards
    return full


def _bottom_up(sheets: list[Series]) -> list[Series]:
    """Return sheets in the order in which they are drawn: outwards, and the dashed one of each pair last."""
    most: dict[int, int] = {}
    for side, n in (series.sheet or (0, 0) for series in sheets):
        most[side] = max(n, most.get(side, 0))
    pairs = min(most.values(), default=0)  # sheets beyond have no partner
    return sorted(sheets, key=lambda series: (min((series.sheet or (0, 0))[1], pairs), series.dashed))


def _interrupted(series: Series, panel: Panel) -> Series:
    """Return a track with a gap at each jump: over 0.4 % of the diagram, and four times as far as along it.

    The lines of fast oscillations would otherwise fill areas, and hide the image.
    """
    (first, last), (low, high) = panel.x_range or (0.0, np.inf), panel.y_range or (0.0, np.inf)
    across = np.abs(np.diff(series.y)) / (high - low)  # in widths of the panel
    along = np.abs(np.diff(series.x)) / (last - first) * panel.aspect
    jumps = np.flatnonzero((across > 0.004) & (across > 4 * along)) + 1
    x, y = np.insert(series.x, jumps, series.x[jumps]), np.insert(series.y, jumps, np.nan)
    return replace(series, x=x, y=y)


def _isolated(y: Floats) -> Bools:
    """Tell which values have no value before or after them."""
    known = np.r_[False, np.isfinite(y), False]
    return np.asarray(known[1:-1] & ~known[:-2] & ~known[2:])


def _in_turns(group: Sequence[Series]) -> list[tuple[Series, int | None]]:
    """Return series with the first of every `TURNS` points to draw; None for all.

    Series of many points take turns, else the last would hide the others. Those drawn last are at different
    x, so that each is seen where all coincide.
    """
    crowd = [series for series in group if series.look == "points" and series.x.size > MANY_POINTS]
    crowd = crowd if len(crowd) > 1 else []
    shifted = [(series, k * TURNS // len(crowd)) for k, series in enumerate(crowd)]
    turns = [(series, (turn - shift) % TURNS) for turn in range(TURNS) for series, shift in shifted]
    return [*((series, None) for series in group if series not in crowd), *turns]


def _draw_series(ax: Axes, series: Series, first: int | None = None) -> None:
    colour, at, every = series.ink[0], series.x + series.shift, None if first is None else (first, TURNS)
    if series.low is not None and series.high is not None and not first:
        if series.look == "line":  # a shaded range about a curve
            ax.fill_between(at, series.low, series.high, color=colour, alpha=0.2, lw=0)
        else:
            faint = at.size > MANY_POINTS
            ax.vlines(at, series.low, series.high, color=colour, lw=0.9, alpha=0.3 if faint else 1.0)
    if series.look == "steps":
        width = float(series.x[1] - series.x[0]) if len(series.x) > 1 else 1.0
        ax.bar(at, series.y, width, color=colour, alpha=0.5, ec=colour, label=series.label)
        return
    ax.plot(at, series.y, label=to_mathtext(series.label) or "_", markevery=every, **_line_style(series))
    if series.look == "line" and (alone := _isolated(series.y)).any():
        ax.plot(at[alone], series.y[alone], ls="none", marker="o", ms=2.5, color=colour)


def _line_style(series: Series) -> dict[str, Any]:
    """Return the arguments of `plot` for a series."""
    style: dict[str, Any] = {
        "color": series.ink[0],
        "lw": series.width,
        "ls": _DASHES if series.dashed else "-",
        "zorder": 2.1 if series.dashed else 2.0,  # a solid line would hide a dashed one
    }
    if series.look in ("points", "both"):
        style |= {"marker": "o", "ms": 3.5, "mfc": "none" if series.hollow else series.ink[0], "mew": 0.9}
    if series.look == "points":  # a filled point fits into a hollow one
        ring = 5.5 if series.x.size <= MANY_POINTS else 3.5
        style |= {"ls": "none", "ms": ring if series.hollow else 3.0}
    return style


def _draw_ticks(ax: Axes, groups: list[Series], x_lines: tuple[float, ...]) -> None:
    """Draw strokes at both ends of every tick, and as many numbers as fit, the first and outermost at once.

    Numbers are beside vertical lines, not on them. The x range must be set.
    """
    low, high = ax.get_xlim()
    character = abs(high - low) / max(_width_in(ax), 0.1) * _inches().character  # in units of the axis
    taken: list[tuple[float, float]] = []  # ranges of x with a number
    box = {"boxstyle": "round,pad=0.12", "fc": "white", "ec": "none", "alpha": 0.75}
    style: dict[str, Any] = {"textcoords": "offset points", "ha": "center", "va": "bottom", "bbox": box}
    widest = [max(map(len, series.text), default=1) + 0.8 for series in groups]  # with a gap, in characters
    steps = [label_step(s.x, character * width) for s, width in zip(groups, widest, strict=True)]
    step = max(steps, default=1)
    # Of each sheet: whether it has to wait for the first and the outermost of each side, number, x, y.
    numbers: list[tuple[bool, int, float, float]] = []
    first = min((1, *(int(text) for series in groups for text in series.text)))  # indices begin at 0
    for series in groups:
        assert series.low is not None and series.high is not None  # as all ticks have them
        stroke = 0.2 * (series.high - series.low)  # leaves the ridge visible between the two
        ax.vlines(series.x, series.low, series.low + stroke, color=series.ink[0], lw=0.9)
        ax.vlines(series.x, series.high - stroke, series.high, color=series.ink[0], lw=0.9)
        heights = series.low if series.text_y is None else np.full(series.x.size, series.text_y)
        which = [int(text) for text in series.text]
        ends = {first, max(which, default=first)}
        numbers += [
            (number not in ends, number, *place)
            for number, *place in zip(which, series.x.tolist(), heights.tolist(), strict=True)
            if (number - first) % step == 0 or number in ends
        ]
    for _, number, x, y in sorted(numbers):
        half = character * (0.6 + len(str(number))) / 2
        places = [x]
        if on := [line for line in x_lines if abs(x - line) < 1.6 * half]:
            beside = math.copysign(1.6 * half, x - on[0])
            on_line = abs(x - on[0]) < half / 4  # its number is where there is room
            places = [on[0] + beside, *([on[0] - beside] if on_line else [])]
        free = (at for at in places if not any(at - half < b and a < at + half for a, b in taken))
        if (at := next(free, None)) is not None:
            taken.append((at - half, at + half))
            ax.annotate(str(number), (at, y), (0, 3), fontsize=7 * _letters(), **style)


def _draw_inset(ax: Axes, panel: Panel) -> None:
    bottom, top = ax.get_ylim()
    ticks = [tick for tick in ax.get_yticks() if bottom <= tick <= top]
    ax.set_ylim(bottom, bottom + 1.6 * (top - bottom))  # room above the points, without ticks
    ax.set_yticks(ticks)
    small = ax.inset_axes((0.55, 0.62, 0.43, 0.37))
    for series, first in _in_turns(panel.series):
        _draw_series(small, series, first)
    small.set_xlabel(to_mathtext(panel.x_label), fontsize=8 * _letters(), labelpad=3)
    small.set_ylabel(to_mathtext(panel.y_label), fontsize=8 * _letters(), labelpad=4)
    small.tick_params(labelsize=7 * _letters(), pad=2)
    small.locator_params(nbins=4)
    for line in small.lines:
        line.set_markersize(2.0)


def _draw_arrows(ax: Axes, arrows: tuple[Arrow, ...]) -> None:
    for arrow in arrows:
        (x0, x1), (y0, y1) = arrow.x, arrow.y
        head = {"arrowstyle": "<->", "shrinkA": 0, "shrinkB": 0, "color": MODEL[0], "lw": 1.1}
        ax.annotate("", (x1, y1), (x0, y0), arrowprops=head)
        ha, va, offset = ("left", "center", (5, 0)) if x0 == x1 else ("center", "bottom", (0, 3))
        middle = (x0 + x1) / 2, (y0 + y1) / 2
        label = to_mathtext(arrow.label)
        ax.annotate(label, middle, offset, textcoords="offset points", ha=ha, va=va)


def _draw_marks(ax: Axes, marks: Floats) -> None:
    """Draw pointers at both edges and a thin line across for each time, or only ticks if there are many."""
    few = marks.size <= MOST_LINES
    style: dict[str, Any] = {"ms": 5, "mec": "white", "mew": 0.5} if few else {"ms": 9, "mew": 0.6}
    style |= {"color": SLIPS, "transform": ax.get_yaxis_transform(), "clip_on": False, "zorder": 3}
    for edge, pointer in ((0.0, ">"), (1.0, "<")):
        ax.plot(np.full(marks.size, edge), marks, pointer if few else "_", **style)
    if few:
        ax.hlines(marks, *ax.get_xlim(), color=SLIPS, lw=0.7, ls=(0, (4, 4)))


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
    elif panel.downwards:  # no ticks above the first row of the image
        last = panel.image.bottom - 0.5
        inside = [tick for tick in ax.get_yticks() if -0.5 <= tick <= last]
        ax.set_yticks([0, last] if panel.aspect < 0.25 else inside)  # flat images have no room for more
    if right is not None:
        right.set_ylabel(to_mathtext(panel.y2_label))
        right.spines["right"].set_visible(True)
        _stack(ax, right, panel)


def _stack(ax: Axes, right: Axes, panel: Panel) -> None:
    """Set the ranges of two y axes so that the curves in view are above each other."""
    low, high = ax.get_xlim()
    for axes, side, below, above in ((ax, "left", 1.15, 0.05), (right, "right", 0.05, 1.15)):
        y = np.empty(0)
        for series in panel.series:
            if series.axis == side:
                in_view = (series.x >= low) & (series.x <= high)
                curves = [curve for curve in (series.y, series.low, series.high) if curve is not None]
                y = np.concatenate([y, *(curve[in_view] for curve in curves)])
        y = y[np.isfinite(y)]
        if y.size:
            span = float(np.ptp(y)) or 1.0
            axes.set_ylim(float(y.min()) - below * span, float(y.max()) + above * span)


# --- legends ------------------------------------------------------------------------------------------------


def _draw_legend(ax: Axes, panel: Panel, name: str) -> None:
    earlier = ax.get_legend()
    known = [] if earlier is None else earlier.legend_handles
    handles: dict[str, Any] = {str(one.get_label()): one for one in known if one is not None}
    labels = [re.sub(r"\\\w+|[${}_]", "", label) for label in handles]  # their width is that of the letters
    for series, text in _legend_entries(panel):
        label = f"{name}: {text}" if name and isinstance(series, Series) else text
        handle = _legend_handle(series, label)
        if handles.setdefault(handle.get_label(), handle) is handle:
            labels.append(label)
    if handles:
        columns = _legend_columns(labels, _width_in(ax))
        place: dict[str, Any] = {"loc": "lower right", "bbox_to_anchor": (1, 1), "borderaxespad": 0.1}
        place |= {"ncols": columns, "frameon": False}
        if _legend_height(len(handles), columns) > _above_in(ax):
            place = {"loc": "best", "ncols": 1, "framealpha": 0.8}  # axes of others may lack the room
        ax.legend(handles=list(handles.values()), fontsize=8 * _letters(), columnspacing=1.2, **place)


def _legend_entries(panel: Panel) -> list[tuple[Series | Band, str]]:
    """Return series and bands with their labels: for sheets one per side, for images none."""
    if panel.image is not None or panel.empty:
        return []
    if not panel.switchable:
        parts: list[Series | Band] = [series for series in panel.series if np.isfinite(series.y).any()]
        return [(part, part.label) for part in (*parts, *panel.bands) if part.label]
    entries: list[tuple[Series | Band, str]] = []
    full = _in_full(panel)
    for side, name in SIDES.items():
        mine = {s.sheet[1]: s for s in panel.series if s.sheet is not None and s.sheet[0] == side}
        if mine:
            span = f"{min(mine)} (dark) to {max(mine)} (bright)" if len(mine) > 1 else f"{max(mine)}"
            strong = [n for n in sorted(mine) if (side, n) in full]
            if len(strong) < len(mine):
                span += f"; faint except {', '.join(map(str, strong))}"
            entries.append((mine[sorted(mine)[len(mine) // 2]], f"{name}, n = {span}"))
    return entries


def _legend_handle(series: Series | Band, label: str) -> Any:
    text = to_mathtext(label)
    if isinstance(series, Band):
        return Rectangle((0, 0), 1, 1, fc=QUIET[0], alpha=0.15, label=text)
    if series.look == "steps":
        return Rectangle((0, 0), 1, 1, fc=series.ink[0], alpha=0.5, ec=series.ink[0], label=text)
    return Line2D([], [], label=text, **_line_style(series) | {"lw": max(series.width, 1.2)})


def _legend_width(labels: list[str], columns: int) -> float:
    """Return the approximate width in inches of a legend with this number of columns."""
    widths = [len(label) * _inches().character + _inches().marker for label in labels]
    return float(sum(part.max() for part in np.array_split(widths, columns)))


def _legend_columns(labels: list[str], width_in: float) -> int:
    """Return the largest number of columns that fits."""
    fitting = (k for k in range(len(labels), 1, -1) if _legend_width(labels, k) <= width_in)
    return next(fitting, 1)


def _legend_height(entries: int, columns: int) -> float:
    return _inches().legend + _inches().legend_row * (-(-entries // columns) - 1)


def _head(panel: Panel, width_in: float) -> tuple[float, float]:
    """Return the height of a panel's legend, and the part of it below the title: all or nothing, inches."""
    labels = [label for _, label in _legend_entries(panel)]
    if not labels:
        return 0.0, 0.0
    columns = _legend_columns(labels, width_in)
    height = _legend_height(len(labels), columns)
    title = 0.09 * _letters() * max(map(len, _title(panel, width_in).split("\n")))
    beside = columns == len(labels) and _legend_width(labels, columns) + title < width_in
    return height, 0.0 if beside else height


# --- layout -------------------------------------------------------------------------------------------------

Box = tuple[float, float, float, float]


def _layout(figure: Figure) -> tuple[list[Box], tuple[float, float]]:
    """Return left, bottom, width and height of every panel, and the size of the page, in inches."""
    columns, sizes = min(figure.columns, len(figure.panels)), _inches()
    grid = [figure.panels[k : k + columns] for k in range(0, len(figure.panels), columns)]
    before, after = list[float](), list[float]()  # margins of each column
    for column in (figure.panels[k::columns] for k in range(columns)):
        before.append(sizes.side if any(map(_labelled, column)) else sizes.inner)
        after.append(sizes.side if any(panel.y2_label for panel in column) else sizes.inner)
    width = (figure.width_in - sum(before) - sum(after)) / columns
    boxes, y = [], 0.0
    for row in grid:
        tallest = width * max(panel.aspect for panel in row)
        labels = [label for p in row for label in (p.x_label if p.time_down else p.y_label, p.y2_label)]
        least = max(sizes.least_height, max(map(len, labels)) * sizes.label_character)
        height = float(np.clip(tallest, least, max(least, _MOST_HEIGHT)))
        y -= sizes.top + _top(figure, row, width) + height
        x = 0.0
        for _, left, right in zip(row, before, after, strict=False):
            boxes.append((x + left, y, width, height))
            x += left + width + right
        y -= sizes.bottom + sizes.foot * max(len(_foot(panel, width).splitlines()) for panel in row)
    return [(x, bottom - y, width, height) for x, bottom, width, height in boxes], (figure.width_in, -y)


def _top(figure: Figure, row: Sequence[Panel], width_in: float) -> float:
    """Return the height of titles, which end at one height, and legends above a row of panels, inches."""
    heads = [_head(panel, width_in) for panel in row]
    legend, below = max(height for height, _ in heads), max(height for _, height in heads)
    if not figure.shows_titles:
        return legend
    lines = max(1 + _title(panel, width_in).count("\n") for panel in row)
    return max(_inches().title * lines + below, legend)


def _title(panel: Panel, width_in: float) -> str:
    """Return the title, wrapped to the width of the panel."""
    return _wrapped(panel.title, width_in / _inches().title_character)


def _foot(panel: Panel, width_in: float) -> str:
    """Return the lines below a panel, wrapped to its width."""
    return _wrapped(panel.foot, width_in / _inches().foot_character)


_NUMBER_AND_UNIT = re.compile(r"(?<=\d) (?=(?:s|ms|px|µm|mm|N|times)\b)")


def _wrapped(text: str, characters: float) -> str:
    """Return the text in as few lines as this width needs, of like lengths, no unit without its number."""
    joined = _NUMBER_AND_UNIT.sub("\N{NO-BREAK SPACE}", text)
    lines = (_balanced(line, int(characters)) for line in joined.split("\n"))
    return "\n".join(lines).replace("\N{NO-BREAK SPACE}", " ")


def _balanced(line: str, most: int) -> str:
    """Return a line broken into as few as `most` characters allow, the longest as short as possible."""
    count = len(textwrap.wrap(line, most))
    widths = (k for k in range(1 + len(line) // max(count, 1), most) if len(textwrap.wrap(line, k)) == count)
    return textwrap.fill(line, next(widths, most))


def _labelled(panel: Panel) -> bool:
    """Tell whether the vertical axis has its own label."""
    return bool(panel.x_label if panel.time_down else panel.y_label)


def _above_in(ax: Axes) -> float:
    """Return the room above these axes on their figure, inches."""
    figure = ax.get_figure(root=True)
    return math.inf if figure is None else float((1 - ax.get_position().y1) * figure.get_figheight()) + 0.01


def _width_in(ax: Axes) -> float:
    figure = ax.get_figure(root=True)
    return float(ax.get_position().width * figure.get_figwidth()) if figure is not None else 5.0
