"""What a figure is, before it is drawn: the same numbers go to the page, to a PDF and to a table."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pandas as pd

Doubles = NDArray[np.float64]
Ink = tuple[str, str]  # colour on a light and on a dark ground


@dataclass(frozen=True, kw_only=True)
class Series:
    """One curve or set of points.

    x, y: (k,), x rising; NaN in y leaves a gap.  low, high: ends of an error bar, (k,), where there is one.
    look: "line", "points", "both", "steps" (a histogram's bars) or "ticks" (bars from low to high with
    `text` above).  dashed, hollow: tell series apart without colour.  shift: added to x where it is drawn,
    so that points with the same x stand side by side; tables have x itself.  axis: which y axis.  sheet:
    (side, n) of a sheet that can be switched on and off.
    """

    label: str
    x: Doubles
    y: Doubles
    ink: Ink
    look: Literal["line", "points", "both", "steps", "ticks"] = "line"
    low: Doubles | None = None
    high: Doubles | None = None
    text: tuple[str, ...] = ()
    dashed: bool = False
    hollow: bool = False
    shift: float = 0.0
    width: float = 1.2
    axis: Literal["left", "right"] = "left"
    sheet: tuple[int, int] | None = None


@dataclass(frozen=True, kw_only=True)
class Picture:
    """A grey image under the curves. pixels: (rows, columns), 8 bit.  left, right, top, bottom: outer edges
    in the axes' units."""

    pixels: NDArray[np.uint8]
    left: float
    right: float
    top: float
    bottom: float


@dataclass(frozen=True, kw_only=True)
class Band:
    """A stretch of the y axis: shaded, or with its outline only.  left, right: its ends, None for all x."""

    low: float
    high: float
    label: str
    outline: bool = False
    left: float | None = None
    right: float | None = None


@dataclass(frozen=True, kw_only=True)
class Chart:
    """A figure: numbers, labels with units, and a caption that says what is seen and how it was computed.

    x_range, y_range: what is shown of all there is, None for everything.  first_view: the part of x that is
    shown until the reader asks for the whole.  y2_label: a second y axis; its series go below those of the
    first, so that neither hides the other.  x_lines: dashed upright lines.
    downwards: y grows downwards, as in a picture.  whole_numbers: x counts something.  upright_time: the
    series' x runs down the page and their y across it, as in a space-time diagram.  aspect: height over
    width of the plotted area.
    """

    name: str
    title: str
    caption: str
    x_label: str
    y_label: str
    series: tuple[Series, ...]
    y2_label: str = ""
    picture: Picture | None = None
    bands: tuple[Band, ...] = ()
    x_lines: tuple[float, ...] = ()
    x_range: tuple[float, float] | None = None
    first_view: tuple[float, float] | None = None
    y_range: tuple[float, float] | None = None
    downwards: bool = False
    whole_numbers: bool = False
    upright_time: bool = False
    aspect: float = 0.5
    notes: tuple[str, ...] = ()

    @property
    def switchable(self) -> bool:
        """Whether its series are sheets, to be switched on and off."""
        return any(series.sheet is not None for series in self.series)

    @property
    def one_grid(self) -> bool:
        """Whether all series share one x."""
        return all(series.x is self.series[0].x for series in self.series)


def table_of(chart: Chart) -> pd.DataFrame:
    """The figure's numbers: one column a series where all share x, else one row a point with its series."""
    import pandas as pd

    if not chart.series:
        return pd.DataFrame()
    plain = all(series.low is None and not series.text for series in chart.series)
    if chart.one_grid and plain:
        columns = {chart.x_label: chart.series[0].x} | {s.label: s.y for s in chart.series}
        return pd.DataFrame(columns)
    return pd.concat([_long(chart, series) for series in chart.series], ignore_index=True)


def _long(chart: Chart, series: Series) -> pd.DataFrame:
    import pandas as pd

    y_label = chart.y2_label if series.axis == "right" else chart.y_label
    table = pd.DataFrame({"series": series.label, chart.x_label: series.x, "y": series.y})
    if chart.y2_label:
        table["quantity"] = y_label
    else:
        table = table.rename(columns={"y": y_label})
    if series.low is not None and series.high is not None:
        table = table.assign(low=series.low, high=series.high)
    return table.assign(text=series.text) if series.text else table
