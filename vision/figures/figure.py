"""What a figure is: panels of curves, points and images as plain data.

The same data are drawn by matplotlib (`Figure.plot`, `Figure.save`), drawn by the report's page, written as a
table (`Figure.table`), and kept in a file (`save_figures`, `load_figures`).
"""

from __future__ import annotations

import json
import math
import re
import zipfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields
from pathlib import Path
from types import UnionType
from typing import TYPE_CHECKING, Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from vision.errors import InputError
from vision.escaping import harmless_table
from vision.files import reading
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
    # x, y: (k,), x rising; NaN in y leaves a gap
    x: Floats
    y: Floats
    ink: Ink  # its colour
    # "line", "points", "both", "steps" (bars of a histogram) or "ticks" (strokes at `low` and `high`
    # with `text` above)
    look: Literal["line", "points", "both", "steps", "ticks"] = "line"
    # low, high: ends of error bars, (k,), where there are any
    low: Floats | None = None
    high: Floats | None = None
    text: tuple[str, ...] = ()  # one label a point, for "ticks"
    # dashed, hollow: distinguish series without colour
    dashed: bool = False
    hollow: bool = False
    # added to x in drawings, so that points with the same x stand side by side; tables hold x itself
    shift: float = 0.0
    width: float = 1.2  # of the line, in points
    axis: Literal["left", "right"] = "left"  # which y axis
    sheet: tuple[int, int] | None = None  # (side, n) of a sheet, which the page can switch on and off

    @classmethod
    def points(cls, label: str, x: Any, y: Any, ink: Ink, error: Any = None, **rest: Any) -> Series:
        """Points, with their standard errors where these are given."""
        x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
        bars = {} if error is None else {"low": y - np.asarray(error), "high": y + np.asarray(error)}
        return cls(label=label, x=x, y=y, ink=ink, look="points", **bars | rest)

    @classmethod
    def model(cls, label: str, x: Floats, y: Any, ink: Ink) -> Series:
        """The curve of a model: wide and dashed."""
        return cls(label=label, x=x, y=np.asarray(y, np.float64), ink=ink, dashed=True, width=2.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class Image:
    """A grey image under the curves."""

    pixels: NDArray[np.uint8]  # grey levels (row, column)
    # left, right, top, bottom: outer edges in units of the axes
    left: float
    right: float
    top: float
    bottom: float
    # True where nothing was recorded, (row, column); None where every pixel is known
    missing: Bools | None = None
    # black, white: grey levels of the recording that are shown black and white; NaN where the image has
    # no scale
    black: float = math.nan
    white: float = math.nan

    @property
    def scale(self) -> str:
        """The grey scale in words, black to white, "" without one."""
        if not (math.isfinite(self.black) and math.isfinite(self.white)):
            return ""
        return f"grey levels {self.black:.3g} to {self.white:.3g}"


@dataclass(frozen=True, kw_only=True, eq=False)
class Band:
    """A shaded range of the y axis, or of the x axis (`of_x`), or only its outline."""

    low: float
    high: float
    label: str
    outline: bool = False
    of_x: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class Arrow:
    """A length between two points, with a head at both ends."""

    x: Range
    y: Range
    label: str


@dataclass(frozen=True, kw_only=True, eq=False)
class Panel:
    """One pair of axes with what is drawn on them."""

    # x_label, y_label, y2_label: with units. The second y axis is there where it has a label; its
    # curves go below those of the first, so that neither hides the other. A panel without `y_label`
    # shares the axis of its left neighbour.
    x_label: str
    y_label: str
    y2_label: str = ""
    # series, image, bands: what is drawn
    series: tuple[Series, ...] = ()
    image: Image | None = None
    bands: tuple[Band, ...] = ()
    x_lines: tuple[float, ...] = ()  # dashed vertical lines
    # marks, marks_label: times marked across an image, and what they are
    marks: Floats | None = None
    marks_label: str = ""
    # x_range, y_range: what is shown; None for everything
    x_range: Range | None = None
    y_range: Range | None = None
    first_view: Range | None = None  # part of x that the page shows first
    downwards: bool = False  # y grows downwards, as in an image
    time_down: bool = False  # x of the series runs down the page and y across it, as in a space-time diagram
    whole_numbers: bool = False  # x counts something
    aspect: float = 0.5  # height over width of the plotted area
    square_pixels: bool = False  # both axes have the same scale
    # x_log, y_log: logarithmic axes
    x_log: bool = False
    y_log: bool = False
    arrows: tuple[Arrow, ...] = ()  # lengths that are pointed out, with their symbols
    title: str = ""  # shown above a panel of several
    placeholder: str = "no data"  # shown where there is nothing to draw
    inset: Panel | None = None  # a small panel in the upper right corner, which the page leaves out

    @property
    def switchable(self) -> bool:
        """Whether its series are sheets, which the page can switch on and off."""
        return any(series.sheet is not None for series in self.series)

    @property
    def common_x(self) -> bool:
        """Whether all series share one x."""
        return all(series.x is self.series[0].x for series in self.series)

    @property
    def empty(self) -> bool:
        """Whether there is nothing to draw."""
        return self.image is None and not any(np.isfinite(series.y).any() for series in self.series)

    def table(self) -> pd.DataFrame:
        """One column a series where all share x, else one row a point with the name of its series."""
        if not self.series:
            return pd.DataFrame()
        plain = all(series.low is None and not series.text for series in self.series)
        if self.common_x and plain:
            return pd.DataFrame({self.x_label: self.series[0].x} | {s.label: s.y for s in self.series})
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
    """A figure: numbers, labels with units, and a caption that says what it shows and how it was computed."""

    name: str  # short, used for files and in `track figures`
    # title, caption: of the page and of a manuscript
    title: str
    caption: str
    panels: tuple[Panel, ...]  # one, or several in reading order
    columns: int = 1  # panels side by side
    width_in: float = 6.0  # width of the saved figure, inches
    notes: tuple[str, ...] = ()  # warnings that belong to the figure

    @classmethod
    def of(cls, name: str, panel: Panel, caption: str, *, title: str = "", **rest: Any) -> Figure:
        """A figure of one panel, under the panel's title unless another is given."""
        return cls(name=name, title=title or panel.title, caption=caption, panels=(panel,), **rest)

    @property
    def panel(self) -> Panel:
        """The first panel, the only one of most figures."""
        return self.panels[0]

    def table(self) -> pd.DataFrame:
        """The drawn numbers; with several panels, one row a point and the name of its panel.

        Images are not in it.
        """
        if len(self.panels) == 1:
            return self.panel.table()
        parts = [_long(panel.table(), panel) for panel in self.panels if panel.series]
        return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame()

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw with matplotlib.

        Parameters
        ----------
        ax
            Axes to draw on, for a figure of one panel; None makes a new matplotlib figure, in a notebook that
            uses pyplot one that is shown.

        Returns
        -------
        The axes of the first panel; ``.figure`` is the whole.

        Raises
        ------
        InputError
            For `ax` with a figure of several panels.
        """
        from vision.figures import drawing

        if ax is None:
            return drawing.new_figure(self, interactive=True).axes[0]
        if len(self.panels) > 1:
            raise InputError("`ax`", f"None, as {self.name} has {len(self.panels)} panels", "axes")
        return drawing.draw_panel(ax, self.panel)

    def save(self, path: str | Path, *, dpi: float | None = None) -> Path:
        """Write the figure; the ending of `path` says how.

        Parameters
        ----------
        path
            Ends in .png, .pdf, .svg (text stays text in both), or .csv for the table.
        dpi
            Resolution of a PNG and of images within the other two; None for what suits the kind.

        Returns
        -------
        The path.

        Raises
        ------
        InputError
            For another ending.
        OSError
            Where the file cannot be written.
        """
        path = Path(path)
        kind = path.suffix.lower()
        if kind == ".csv":
            harmless_table(self.table()).to_csv(path, index=False, float_format="%.8g", lineterminator="\n")
        elif kind in (".png", ".pdf", ".svg"):
            from vision.figures import drawing

            drawing.write(self, path, dpi=dpi)
        else:
            raise InputError(path, "a name that ends in .png, .pdf, .svg or .csv", kind or "no ending")
        return path

    def png(self) -> bytes:
        """The figure as a PNG file's content."""
        from vision.figures import drawing

        return drawing.png(self)

    def _repr_png_(self) -> bytes:
        return self.png()


def _long(table: pd.DataFrame, panel: Panel) -> pd.DataFrame:
    """One row a point, under names that all panels share."""
    x, y = panel.x_label, panel.y_label
    if "series" not in table:
        table = table.melt(id_vars=x, var_name="series", value_name="y")
    table = table.rename(columns={x: "x", y: "y"}).assign(panel=panel.title, x_label=x, y_label=y)
    first = ["panel", "series", "x_label", "x", "y_label", "y"]
    return table[[*first, *(name for name in table if name not in first)]]


# --- figures in a file --------------------------------------------------------------------------------------

_CLASSES: dict[str, type] = {part.__name__: part for part in (Series, Image, Band, Arrow, Panel, Figure)}


def save_figures(path: str | Path, figures: Iterable[Figure]) -> Path:
    """Write figures to one compressed .npz file, from which `load_figures` reads them; returns its path.

    It holds JSON (as bytes, "figures"), all curves in one array ("curves") and the images.
    """
    path = Path(path)
    curves: list[Floats] = []
    images: dict[str, NDArray[Any]] = {}
    places: dict[int, Any] = {}
    length = 0

    def place(array: NDArray[Any]) -> Any:
        nonlocal length
        if id(array) not in places:  # arrays that figures share are kept once
            if array.ndim == 1:
                curves.append(np.asarray(array, np.float64))
                places[id(array)] = [length, length + array.size]
                length += array.size
            else:
                places[id(array)] = f"image{len(images)}"
                images[places[id(array)]] = array
        return {"array": places[id(array)]}

    kept = list(figures)  # alive while their arrays are told apart by id
    text = json.dumps([_encode(figure, place) for figure in kept], ensure_ascii=False, allow_nan=False)
    arrays = {
        "figures": np.frombuffer(text.encode(), np.uint8),
        "curves": np.concatenate([*curves, np.empty(0)]),
    }
    # Level 1 is four times as fast as the usual 6, for files a twentieth larger.
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, array in (arrays | images).items():
            entry = zipfile.ZipInfo(f"{name}.npy")  # without the time of day: same figures, same file
            entry.compress_type = zipfile.ZIP_DEFLATED
            with archive.open(entry, "w", force_zip64=True) as stream:
                np.lib.format.write_array(stream, np.ascontiguousarray(array), allow_pickle=False)
    return path


def _encode(value: Any, place: Callable[[NDArray[Any]], Any]) -> Any:
    """A value as JSON; arrays by their place in the file."""
    if isinstance(value, np.ndarray):
        return place(value)
    if type(value).__name__ in _CLASSES:
        content = {
            part.name: _encode(found, place)
            for part in fields(value)
            if not _is_default(found := getattr(value, part.name), part.default)
        }
        return {"class": type(value).__name__} | content
    return [_encode(item, place) for item in value] if isinstance(value, tuple) else value


def _is_default(value: Any, default: Any) -> bool:
    """Whether a field need not be kept; NaN, which JSON lacks, is only ever a default."""
    numbers = isinstance(value, float) and isinstance(default, float)
    return value is default or (numbers and math.isnan(value) and math.isnan(default))


def load_figures(path: str | Path) -> list[Figure]:
    """Figures from a file of `save_figures`, in their order.

    Raises: InputError for a file that does not hold figures, or those of an incompatible version.
    """
    with reading(Path(path), "figures that a run has saved", "run track again"):
        with np.load(path, allow_pickle=False) as arrays:
            stored = {name: arrays[name] for name in arrays.files}
        listed = json.loads(stored["figures"].tobytes().decode())
        cut: dict[tuple[int, int], Floats] = {}
        figures = [_decode(item, stored, cut) for item in listed]
        for figure in figures:  # it becomes the name of a file
            if not re.fullmatch(r"\w{1,60}", figure.name):
                raise ValueError(f"a figure of the name {figure.name!r}")
        return figures


def _decode(value: Any, stored: dict[str, NDArray[Any]], cut: dict[tuple[int, int], Floats]) -> Any:
    """The reverse of `_encode`; arrays that were one are one again."""
    if isinstance(value, list):
        return tuple(_decode(item, stored, cut) for item in value)
    if not isinstance(value, dict):
        return value
    if "array" in value:
        at = value["array"]
        if isinstance(at, str):
            return stored[at]
        return cut.setdefault((at[0], at[1]), stored["curves"][at[0] : at[1]])
    made = _CLASSES[value["class"]]
    parts = {name: _decode(item, stored, cut) for name, item in value.items() if name != "class"}
    hints = get_type_hints(made)
    if wrong := [name for name, part in parts.items() if not _fits(part, hints[name])]:
        raise TypeError(f"{value['class']}.{wrong[0]} is no {hints[wrong[0]]}")
    figure = made(**parts)
    if isinstance(figure, Series):
        held = [part for part in (figure.y, figure.low, figure.high, figure.text or None) if part is not None]
        if figure.x.ndim != 1 or any(len(part) != len(figure.x) for part in held):
            raise ValueError(f"a series of {figure.x.shape} points with values of another number")
    return figure


def _fits(value: Any, kind: Any) -> bool:
    """Whether a value read from a file is of the declared type; the types are those of this module."""
    origin, inner = get_origin(kind), get_args(kind)
    if origin is Literal:
        return value in inner
    if origin in (Union, UnionType):
        return any(_fits(value, one) for one in inner)
    if origin is tuple and isinstance(value, tuple):
        if inner[-1] is Ellipsis:
            return all(_fits(item, inner[0]) for item in value)
        return len(value) == len(inner) and all(map(_fits, value, inner))
    if kind is float:
        return isinstance(value, (int, float)) and not isinstance(value, bool)
    return isinstance(value, origin or kind)
