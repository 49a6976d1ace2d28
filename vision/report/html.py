"""report.html: one page that holds everything and asks nothing of the network."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from vision.report.chart import Chart, Doubles, Picture, Series
from vision.report.encode import Store, picture_uri
from vision.report.methods import citation, methods
from vision.report.origin import provenance
from vision.report.results import RunResults
from vision.report.sections import Section, charts_of, missing_parts, sections_of
from vision.report.summary import answers, subtitle, warnings_of
from vision.report.symbols import lettered, marked_up

PICTURE_BYTES = 450_000  # at most, for one picture before base64


def write_report(path: str | Path, results: RunResults, *, sections: Sequence[Section] | None = None) -> Path:
    """Write the page. It is one file of less than 3 MB, opens offline and needs no other file beside it.

    Long records are decimated for display (lowest and highest of each stretch); nothing in `results` is
    changed. sections: of these results, where they are made already. Returns the path. Raises OSError where
    the file cannot be written.
    """
    sections = sections_of(results) if sections is None else sections
    text = _template().render(
        title=_title(results),
        subtitle=subtitle(results),
        answers=answers(results),
        warnings=warnings_of(results),
        missing=missing_parts(results),
        sections=sections,
        methods=methods(results),
        citation=citation(results),
        provenance=provenance(results),
        data=_markup(_script_safe(page_data(charts_of(sections)))),
        **{name: _markup(text) for name, text in _assets().items()},
    )
    path = Path(path)
    path.write_text(text, encoding="utf-8")
    return path


def page_data(charts: Sequence[Chart]) -> dict[str, Any]:
    """What the page's script draws from: charts by name, and the long arrays they share."""
    store = Store()
    content = {chart.name: _chart_data(chart, store) for chart in charts}
    return {"charts": content, "blobs": store.blobs()}


def _chart_data(chart: Chart, store: Store) -> dict[str, Any]:
    arrays: list[dict[str, Any]] = []
    places: dict[int, int] = {}

    def place(values: Doubles) -> int:
        if id(values) not in places:
            places[id(values)] = len(arrays)
            arrays.append(store.add(values))
        return places[id(values)]

    return {
        "name": chart.name,
        "title": chart.title,
        "xLabel": chart.x_label,
        "yLabel": chart.y_label,
        "y2Label": chart.y2_label,
        "axisLabels": [lettered(label) for label in (chart.x_label, chart.y_label, chart.y2_label)],
        "series": [_series_data(series, place) for series in chart.series],
        "arrays": arrays,
        "switchable": chart.switchable,
        "wholeNumbers": chart.whole_numbers,
        "oneGrid": chart.one_grid if chart.series else False,
        "picture": None if chart.picture is None else _picture_data(chart.picture),
        "bands": [{"low": b.low, "high": b.high, "outline": b.outline} for b in chart.bands],
        "xLines": chart.x_lines,
        "xRange": chart.x_range,
        "yRange": chart.y_range,
        "firstView": chart.first_view,
        "downwards": chart.downwards,
        "uprightTime": chart.upright_time,
        "aspect": chart.aspect,
    }


def _series_data(series: Series, place: Any) -> dict[str, Any]:
    data: dict[str, Any] = {
        "label": series.label,
        "marked": str(marked_up(series.label)),
        "x": place(series.x),
        "y": place(series.y),
        "ink": series.ink,
        "look": series.look,
        "dashed": series.dashed,
        "hollow": series.hollow,
        "shift": series.shift,
        "width": series.width,
        "axis": series.axis,
        "sheet": series.sheet,
    }
    if series.low is not None and series.high is not None:
        data |= {"low": place(series.low), "high": place(series.high)}
    return data | ({"text": series.text} if series.text else {})


def _picture_data(picture: Picture) -> dict[str, Any]:
    edges = {name: getattr(picture, name) for name in ("left", "right", "top", "bottom")}
    return edges | {"uri": picture_uri(picture.pixels, most_bytes=PICTURE_BYTES)}


def _title(results: RunResults) -> str:
    return Path(str(results.profile.attrs.get("source", "recording"))).name


def _script_safe(data: dict[str, Any]) -> str:
    """JSON that cannot end the script element it stands in."""
    text = json.dumps(data, allow_nan=False, separators=(",", ":"), ensure_ascii=False)
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")


def _markup(text: str) -> Any:
    from markupsafe import Markup

    return Markup(text)


@cache
def _assets() -> dict[str, str]:
    """The plotting library and the page's own style and script, as shipped with the package."""
    here = files("vision.report")
    places = {
        "plot_css": "assets/uPlot.min.css",
        "plot_js": "assets/uPlot.iife.min.js",
        "css": "page/report.css",
        "js": "page/report.js",
    }
    return {name: here.joinpath(place).read_text(encoding="utf-8") for name, place in places.items()}


@cache
def _template() -> Any:
    from jinja2 import Environment, StrictUndefined

    text = files("vision.report").joinpath("page/report.html.jinja").read_text(encoding="utf-8")
    made = Environment(autoescape=True, undefined=StrictUndefined)
    made.filters["symbols"] = marked_up
    return made.from_string(text)
