"""Classes of a figure: panels of curves, points and images as plain data.

Matplotlib (`Figure.plot`, `Figure.save`) and the report's page draw the same data. They can be written as a
table (`Figure.table`) or stored in a file (`save_figures`, `load_figures`).
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from vision.errors import InputError, check_within
from vision.files import AGAIN, reading
from vision.folder import write_csv
from vision.numeric import Bools, Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Ink = tuple[str, str]
"""Colour on a light and on a dark background."""
Range = tuple[float, float]


@dataclass(frozen=True, kw_only=True, eq=False)
class Series:
    """One curve or set of points."""

    label: str  # name in legends and tables; "" for none
    x: Floats  # (k,), rising
    y: Floats  # (k,); NaN leaves a gap
    ink: Ink  # colour
    # appearance; "steps": bars of a histogram, "ticks": strokes at `low` and `high` with `text` above
    look: Literal["line", "points", "both", "steps", "ticks"] = "line"
    low: Floats | None = None  # lower ends of error bars, (k,)
    high: Floats | None = None  # upper ends
    text: tuple[str, ...] = ()  # labels of "ticks", one per point
    text_y: float | None = None  # y of the labels' lower ends; None for `low`
    dashed: bool = False  # distinguishes lines without colour
    hollow: bool = False  # distinguishes points without colour
    shift: float = 0.0  # added to x in drawings, not in tables, so that points do not overlap
    width: float = 1.2  # of the line, in points
    axis: Literal["left", "right"] = "left"  # the y axis that is used
    sheet: tuple[int, int] | None = None  # (side, n) of a sheet, which the page can switch on and off

    @classmethod
    def points(cls, label: str, x: Any, y: Any, ink: Ink, error: Any = None, **rest: Any) -> Series:
        """Return points, with error bars of the standard errors if these are given."""
        x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
        bars = {} if error is None else {"low": y - np.asarray(error), "high": y + np.asarray(error)}
        return cls(label=label, x=x, y=y, ink=ink, look="points", **bars | rest)

    @classmethod
    def model(cls, label: str, x: Floats, y: Any, ink: Ink) -> Series:
        """Return the curve of a model, wide and dashed."""
        return cls(label=label, x=x, y=np.asarray(y, np.float64), ink=ink, dashed=True, width=2.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class Image:
    """A grey image under the curves."""

    pixels: NDArray[np.uint8]  # grey levels (row, column)
    left: float  # outer edges in units of the axes
    right: float
    top: float
    bottom: float
    missing: Bools | None = None  # True where nothing was recorded, (row, column); None if nowhere
    black: float | None = None  # grey level of the recording that is drawn black; None without a grey scale
    white: float | None = None  # grey level that is drawn white
    interpolated: bool = False  # between the recording's pixels along x

    @property
    def scale(self) -> str:
        """The grey scale in words; "" without one."""
        if self.black is None or self.white is None:
            return ""
        ends = (f"{one:.3g}" if abs(one) < 1000 else f"{one:.0f}" for one in (self.black, self.white))
        how = ", interpolated along x" if self.interpolated else ""
        return f"black to white: grey levels {' to '.join(ends)}{how}"


@dataclass(frozen=True, kw_only=True, eq=False)
class Band:
    """A range of the y axis, or of the x axis (`of_x`), shaded or as an outline."""

    low: float
    high: float
    label: str
    outline: bool = False
    of_x: bool = False
    across: Range | None = None  # ends of an outline along x; by default those of the panel


@dataclass(frozen=True, kw_only=True, eq=False)
class Arrow:
    """A double-headed arrow between two points that shows a length."""

    x: Range
    y: Range
    label: str


@dataclass(frozen=True, kw_only=True, eq=False)
class Panel:
    """One pair of axes and what is drawn on them."""

    x_label: str  # with unit, as the other labels
    y_label: str  # "" for a panel that shares the axis of its left neighbour
    # There is a second y axis if it has a label; its curves are drawn below those of the first.
    y2_label: str = ""
    series: tuple[Series, ...] = ()
    image: Image | None = None
    bands: tuple[Band, ...] = ()
    x_lines: tuple[float, ...] = ()  # dashed vertical lines
    marks: Floats | None = None  # times that are marked across an image
    marks_label: str = ""  # what the marks are
    x_range: Range | None = None  # range that is shown; None for everything
    y_range: Range | None = None
    first_view: Range | None = None  # part of x that the page shows first
    downwards: bool = False  # y grows downwards, as in an image
    time_down: bool = False  # x of the series runs down the page and y across it, as in a space-time diagram
    whole_numbers: bool = False  # x has only whole numbers
    y_whole_numbers: bool = False  # and y
    aspect: float = 0.5  # height over width of the plotted area
    square_pixels: bool = False  # both axes have the same scale
    x_log: bool = False  # logarithmic axes
    y_log: bool = False
    arrows: tuple[Arrow, ...] = ()
    title: str = ""  # shown if a figure has several panels
    placeholder: str = "no data"  # text that is shown without data
    inset: Panel | None = None  # small panel in the upper right corner, which the page leaves out

    @property
    def switchable(self) -> bool:
        """Whether some series are sheets, which the page can switch on and off."""
        return any(series.sheet is not None for series in self.series)

    @property
    def foot(self) -> str:
        """Lines that explain the grey levels and the marks, shown below the panel."""
        return "\n".join(filter(None, (self.image.scale if self.image else "", self.marks_label)))

    @property
    def common_x(self) -> bool:
        """Whether there are series, and all share one x."""
        return len({id(series.x) for series in self.series}) == 1

    @property
    def empty(self) -> bool:
        """Whether there is nothing to draw."""
        return self.image is None and not any(np.isfinite(series.y).any() for series in self.series)

    def figure(self, name: str, caption: str, *, title: str = "", **rest: Any) -> Figure:
        """Return a figure of this panel alone, with its title unless another is given."""
        return Figure(name=name, title=title or self.title, caption=caption, panels=(self,), **rest)

    def table(self) -> pd.DataFrame:
        """Return one column per series, named with its unit, if all share x, else one row per point."""
        if not self.series:
            return pd.DataFrame()
        plain = all(series.low is None and not series.text for series in self.series)
        if self.common_x and plain:
            columns = {f"{series.label}: {self.y_label}": series.y for series in self.series}
            return pd.DataFrame({self.x_label: self.series[0].x} | columns)
        return pd.concat([self._rows(series) for series in self.series], ignore_index=True)

    def _rows(self, series: Series) -> pd.DataFrame:
        table = pd.DataFrame({"series": series.label, self.x_label: series.x, "y": series.y})
        if self.y2_label:
            table["quantity"] = self.y2_label if series.axis == "right" else self.y_label
        else:
            table = table.rename(columns={"y": self.y_label})
        if series.low is not None and series.high is not None:
            table = table.assign(low=series.low, high=series.high)
        return table.assign(text=series.text) if series.text else table


@dataclass(frozen=True, kw_only=True, eq=False)
class Figure:
    """A figure: one or more panels and a caption that says what it shows and how it was computed."""

    name: str  # short, used for files and in `track figures`
    title: str  # for the page and a manuscript, as is the caption
    caption: str
    panels: tuple[Panel, ...]  # in reading order
    columns: int = 1  # number of panels side by side
    width_in: float = 6.0  # width of the saved figure, inches
    panel_titles: bool = False  # whether a single panel has its title, too (several always have)

    @classmethod
    def grid(
        cls,
        name: str,
        title: str,
        caption: str,
        panels: Iterable[Panel],
        *,
        aspect: float | None = None,
        **rest: Any,
    ) -> Figure:
        """Return a figure of panels in rows of two, or three if there are three, all with this aspect."""
        shown = tuple(panel if aspect is None else replace(panel, aspect=aspect) for panel in panels)
        page = {"columns": 3 if len(shown) == 3 else 2, "width_in": 13.0} | rest
        return cls(name=name, title=title, caption=caption, panels=shown, **page)

    @property
    def panel(self) -> Panel:
        """The first panel, the only one of most figures."""
        return self.panels[0]

    @property
    def shows_titles(self) -> bool:
        """Whether the titles of the panels are drawn."""
        return self.panel_titles or len(self.panels) > 1

    def table(self) -> pd.DataFrame:
        """Return the drawn numbers without images; of several panels one row per point, with its panel."""
        if len(self.panels) == 1:
            return self.panel.table()
        parts = [_long(panel.table(), panel) for panel in self.panels if panel.series]
        return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame()

    def plot(self, ax: Axes | None = None, *, label: str = "", color: str | None = None) -> Axes:
        """Draw with matplotlib, and return the axes of the first panel; ``.figure`` is the whole figure.

        ax: axes to draw on, for a figure of one panel. By default a new matplotlib figure is made, which
        notebooks display.  label, color: of this test among others on the same axes; the label precedes the
        entries of the legend.  Raises: InputError if axes are given for several panels.
        """
        from vision.figures import drawing

        if ax is None:
            return drawing.new_figure(self).axes[0]
        if len(self.panels) > 1:
            raise InputError("`ax`", f"None, as {self.name} has {len(self.panels)} panels", "axes")
        panel = self.panel
        if color is not None:
            panel = replace(panel, series=tuple(replace(one, ink=(color, color)) for one in panel.series))
        return drawing.draw_panel(ax, panel, label)

    def of_width(self, width_mm: float, font_size: float = 10.0) -> Figure:
        """Return the figure for this width on paper; panels without room side by side are stacked.

        font_size: of the letters with which it will be saved, pt.  Raises: InputError for a width at which
        axes and labels have no room, which is below 50 mm with letters of 10 pt.
        """
        _check_letters(font_size)
        least = 5.0 * font_size  # mm for a panel: the numbers and label of its axis take half of them
        check_within(f"a width from {least:g} to 1000 mm", least, 1000, width_mm=width_mm)
        columns = min(self.columns, len(self.panels), int(width_mm / (1.2 * least)) or 1)
        panels = list(self.panels)
        if columns < self.columns:  # a panel that shares the axis of its left neighbour gets its own
            for k, panel in enumerate(panels[1:], 1):
                before = panels[k - 1]
                x_label, y_label = panel.x_label or before.x_label, panel.y_label or before.y_label
                panels[k] = replace(panel, x_label=x_label, y_label=y_label)
        return replace(self, width_in=width_mm / 25.4, columns=columns, panels=tuple(panels))

    def save(self, path: str | Path, *, dpi: float | None = None, font_size: float = 10.0) -> Path:
        """Write the figure in the format of the suffix of `path`, which is returned.

        path: a file with suffix .png, .pdf or .svg (both with text as text), or .csv for the table.
        dpi: resolution of a PNG and of images within the other two; by default that of the format.
        font_size: of labels, pt; numbers in pictures and legends are a fifth to a third smaller.

        Raises: InputError for another suffix, OSError if the file cannot be written.
        """
        _check_letters(font_size)
        path = Path(path)
        kind = path.suffix.lower()
        if kind == ".csv":
            write_csv(self.table(), path, digits=8)
        elif kind in (".png", ".pdf", ".svg"):
            from vision.figures import drawing

            drawing.write(self, path, dpi=dpi, font_size=font_size)
        else:
            raise InputError(path.name, "a name that ends in .png, .pdf, .svg or .csv", kind or "no ending")
        return path

    def png(self) -> bytes:
        """Return the content of a PNG file of the figure."""
        from vision.figures import drawing

        return drawing.png(drawing.render(self))

    _repr_png_ = png  # for notebooks


def _check_letters(font_size: float) -> None:
    check_within("a size of letters from 4 to 40 pt", 4, 40, font_size=font_size)


def _long(table: pd.DataFrame, panel: Panel) -> pd.DataFrame:
    """Return a panel's table with one row per point, and with column names that all panels share."""
    x, y = panel.x_label, panel.y_label
    if "series" not in table:
        table = table.melt(id_vars=x, var_name="series", value_name="y")
    table = table.rename(columns={x: "x", y: "y"}).assign(panel=panel.title, x_label=x, y_label=y)
    first = ["panel", "series", "x_label", "x", "y_label", "y"]
    return table[[*first, *(name for name in table if name not in first)]]


# --- figures in a file --------------------------------------------------------------------------------------

_CLASSES: dict[str, type] = {part.__name__: part for part in (Series, Image, Band, Arrow, Panel, Figure)}
_PARTS = {"series": Series, "bands": Band, "arrows": Arrow, "panels": Panel, "image": Image, "inset": Panel}


def save_figures(path: str | Path, figures: Iterable[Figure]) -> Path:
    """Write figures to one compressed .npz file for `load_figures`; return its path.

    The file holds JSON (as bytes, "figures") and every array that it refers to.
    """
    path = Path(path)
    arrays: dict[str, Any] = {}
    names: dict[int, str] = {}  # by the id of an array, as figures share some

    def store(array: NDArray[Any]) -> dict[str, str]:
        name = names.setdefault(id(array), f"array{len(names)}")
        arrays[name] = array
        return {"array": name}

    text = json.dumps([_encode(figure, store) for figure in figures], ensure_ascii=False, allow_nan=False)
    np.savez_compressed(path, figures=np.frombuffer(text.encode(), np.uint8), **arrays)
    return path


def _encode(value: Any, store: Callable[[NDArray[Any]], Any]) -> Any:
    """Convert a value to JSON; `store` takes an array and returns what refers to it."""
    if isinstance(value, np.ndarray):
        return store(value)
    if type(value).__name__ in _CLASSES:
        content = {
            one.name: _encode(item, store)
            for one in fields(value)
            if (item := getattr(value, one.name)) is not one.default
        }
        return {"class": type(value).__name__} | content
    return [_encode(item, store) for item in value] if isinstance(value, tuple) else value


def load_figures(path: str | Path) -> list[Figure]:
    """Read the figures of a file of `save_figures`, in their order.

    Raises: InputError for a file that does not hold figures, or those of an incompatible version.
    """
    with reading(Path(path), "figures that a run has saved", AGAIN):
        with np.load(path, allow_pickle=False) as arrays:
            stored = {name: arrays[name] for name in arrays.files}
        figures = [_decode(item, stored) for item in json.loads(stored["figures"].tobytes().decode())]
        for figure in figures:  # the name of a figure becomes that of a file
            if not re.fullmatch(r"\w{1,60}", figure.name):
                raise ValueError(f"a figure of the name {figure.name!r}")
        return figures


def _decode(value: Any, stored: dict[str, NDArray[Any]]) -> Any:
    """Convert a value back from JSON; stored: arrays of the file by name."""
    if isinstance(value, list):
        return tuple(_decode(item, stored) for item in value)
    if not isinstance(value, dict):
        return value
    if "array" in value:
        return stored[value["array"]]
    parts = {name: _decode(item, stored) for name, item in value.items() if name != "class"}
    for name, kind in _PARTS.items():
        found = parts.get(name) or ()
        if not all(isinstance(part, kind) for part in (found if isinstance(found, tuple) else (found,))):
            raise TypeError(f"{name} that are not")
    return _CLASSES[value["class"]](**parts)
