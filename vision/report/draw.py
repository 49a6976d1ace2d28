"""A chart on matplotlib axes, for manuscripts and notebooks."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from vision.report.chart import Chart, Series
from vision.report.style import QUIET, STROKE
from vision.report.symbols import drawn

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MOST_LABELS = 30  # side by side
_DASHES = (0, (4, 2))
_MOST_IN_LEGEND = 8
_ACROSS = 4  # entries of a legend beside each other


def draw_chart(ax: Axes, chart: Chart, *, legend_above: bool = False) -> Axes:
    """Draw the chart on these axes, colours for a light ground; a second y axis is added where it has one.

    legend_above: where a title would be, so that it hides nothing.  Nothing else of the figure is touched.
    Returns the same axes.
    """
    if chart.picture is not None:
        _draw_picture(ax, chart)
    if chart.x_range is not None and not chart.upright_time:
        ax.set_xlim(chart.x_range)
    _draw_bands(ax, chart)
    right: Axes | None = ax.twinx() if chart.y2_label else None
    for series in chart.series:
        _draw_series(
            right if series.axis == "right" and right is not None else ax, series, chart.upright_time
        )
    for x in chart.x_lines:
        ax.axvline(x, color=QUIET[0], lw=1, ls=(0, (6, 4)))
    _frame_axes(ax, chart)
    if right is not None:
        right.set_ylabel(drawn(chart.y2_label))
        right.spines["right"].set_visible(True)
        _one_above_the_other(ax, right, chart)
    _legend(ax, right, chart, above=legend_above)
    return ax


def _draw_picture(ax: Axes, chart: Chart) -> None:
    picture = chart.picture
    assert picture is not None
    extent = (picture.left, picture.right, picture.bottom, picture.top)
    ax.imshow(
        picture.pixels, cmap="gray", vmin=0, vmax=255, extent=extent, aspect="auto", interpolation="nearest"
    )


def _draw_bands(ax: Axes, chart: Chart) -> None:
    from matplotlib.patches import Rectangle

    for band in chart.bands:
        if band.outline:
            left, right = chart.x_range or ax.get_xlim()
            box = Rectangle(
                (left, band.low), right - left, band.high - band.low, fill=False, ec="#d55e00", lw=1.5
            )
            ax.add_patch(box)
        else:
            ax.axhspan(band.low, band.high, color=QUIET[0], alpha=0.15, lw=0, label=band.label)


def _draw_series(ax: Axes, series: Series, upright: bool) -> None:
    colour, label, at = series.ink[0], drawn(series.label), series.x + series.shift
    if series.look == "ticks":
        _number_ticks(ax, series)
        return
    if series.low is not None and series.high is not None:
        ax.vlines(at, series.low, series.high, color=colour, lw=0.9)
    if series.look == "steps":
        width = float(series.x[1] - series.x[0]) if len(series.x) > 1 else 1.0
        ax.bar(at, series.y, width, color=colour, alpha=0.5, ec=colour, label=label)
        return
    look: dict[str, Any] = {"color": colour, "lw": series.width, "ls": _DASHES if series.dashed else "-"}
    if series.look in ("points", "both"):
        look |= {"marker": "o", "ms": 3.5, "mfc": "none" if series.hollow else colour, "mew": 0.9}
    if series.look == "points":
        look["ls"] = "none"
        look["ms"] = 5.5 if series.hollow else 3.0  # a point in a ring shows both
    x, y = (series.y, at) if upright else (at, series.y)
    ax.plot(x, y, label=label, **look)


def _number_ticks(ax: Axes, series: Series) -> None:
    """Strokes at both ends of every tick, what is between them left to be seen; the text above, thinned to
    what can be read. The axes' x range must be set.
    """
    assert series.low is not None
    assert series.high is not None
    stroke = STROKE * (series.high - series.low)
    for start, stop in ((series.low, series.low + stroke), (series.high - stroke, series.high)):
        ax.vlines(series.x, start, stop, color=series.ink[0], lw=0.8)
    low, high = ax.get_xlim()
    pitch = float(np.median(np.diff(series.x))) if len(series.x) > 1 else high - low
    step = max(1, int(np.ceil((high - low) / _MOST_LABELS / max(pitch, 1e-9))))
    box = {"boxstyle": "round,pad=0.12", "fc": "white", "ec": "none", "alpha": 0.75}
    for x, y, text in list(zip(series.x, series.low, series.text, strict=True))[::step]:
        place: dict[str, Any] = {"textcoords": "offset points", "ha": "center", "va": "bottom"}
        ax.annotate(text, (x, y), (0, 3), fontsize=7, bbox=box, **place)


def _frame_axes(ax: Axes, chart: Chart) -> None:
    along, across = chart.first_view or chart.x_range, chart.y_range
    if chart.upright_time:
        ax.set(xlabel=drawn(chart.y_label), ylabel=drawn(chart.x_label))
        along, across = across, along
    else:
        ax.set(xlabel=drawn(chart.x_label), ylabel=drawn(chart.y_label))
    if along is not None and along[1] > along[0]:
        ax.set_xlim(along)
    if across is not None and across[1] > across[0]:
        ax.set_ylim(across[::-1] if chart.downwards or chart.upright_time else across)
    if chart.picture is None:
        ax.grid(alpha=0.25)


def _one_above_the_other(ax: Axes, right: Axes, chart: Chart) -> None:
    """Ranges of the two y axes, from what is in view, such that neither curve hides the other."""
    for own, side, below, above in ((ax, "left", 1.15, 0.05), (right, "right", 0.05, 1.15)):
        mine = [series for series in chart.series if series.axis == side]
        low, high = ax.get_xlim()
        seen = np.concatenate([s.y[(s.x >= low) & (s.x <= high) & np.isfinite(s.y)] for s in mine])
        if seen.size:
            span = float(np.ptp(seen)) or 1.0
            own.set_ylim(float(seen.min()) - below * span, float(seen.max()) + above * span)


def _legend(ax: Axes, right: Axes | None, chart: Chart, *, above: bool) -> None:
    """A legend of few series; for many sheets only the outermost of each side, which name the tones."""
    handles, labels = ax.get_legend_handles_labels()
    if right is not None:
        more = right.get_legend_handles_labels()
        handles, labels = handles + more[0], labels + more[1]
    if chart.switchable and len(labels) > _MOST_IN_LEGEND:
        numbers = [series.sheet[1] if series.sheet else 0 for series in chart.series]
        sides = np.array([series.sheet[0] if series.sheet else 0 for series in chart.series])
        ends = [
            mine[pick(np.array(numbers)[mine])]
            for side in (-1, 1)
            if len(mine := np.flatnonzero(sides == side))
            for pick in (np.argmin, np.argmax)
        ]
        handles, labels = [handles[k] for k in ends], [labels[k] for k in ends]
    place: dict[str, Any] = {"loc": "best", "framealpha": 0.8, "frameon": True, "edgecolor": "none"}
    if above:
        across = _ACROSS if len(labels) <= _ACROSS else _ACROSS - 1
        place = {"loc": "lower right", "bbox_to_anchor": (1, 1), "ncols": across, "columnspacing": 1.2}
    if labels and chart.picture is None:
        ax.legend(handles, labels, fontsize=8, **place)
