"""Write report.html, one page with everything about a run that needs no network."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from jinja2 import Environment, StrictUndefined, Template
from jinja2.utils import htmlsafe_json_dumps
from markupsafe import Markup
from PIL import Image as Pillow

from vision.data import SIDES, ForceMetadata, StripMetadata
from vision.errors import with_options
from vision.figures import Figure, Image, Panel, Series
from vision.figures.catalogue import Results, figures_of, missing_parts, sections_of
from vision.figures.style import (
    CASING,
    HIGHLIGHT,
    MANY_POINTS,
    MISSING,
    SLIPS,
    TURNS,
    rgb,
    to_html,
    to_latex,
    to_unicode,
)
from vision.folder import flattened
from vision.numeric import Floats, two_digits, with_minus
from vision.report.text import ANALYSED_WITH, CITED, methods, subtitle
from vision.sheets import doubtful_stretches
from vision.summary import answers
from vision.systematics import QUANTITIES, SOURCES, systematic_budget

_PART = " (of its size and 64 MiB of it)"  # what a fingerprint covers
PLAIN = 400  # largest number of values of an array that is written as plain numbers


def write_report(
    path: str | Path,
    results: Results,
    facts: Mapping[str, Any],
    *,
    figures: Sequence[Figure] | None = None,
    options: Mapping[str, str] | None = None,
) -> Path:
    """Write the page: one file of less than 3 MB that opens offline and needs no other file.

    facts: the content of run.json (command, parameters, inputs, versions, warnings); entries may be missing.
    figures: those of `figures_of(results)`, if they exist already.  options: the option that replaces each
    argument of the library in messages.  Raises: OSError if the file cannot be written.
    """
    figures = figures_of(results) if figures is None else figures
    refused = (results.reasons[name] for name in results.refused())
    lines = (*map(str, facts.get("warnings", ())), *results.warnings, *refused)
    warnings = dict.fromkeys(with_options(line, options) for line in lines)
    title = "recording" if results.force is None else Path(ForceMetadata.of(results.force).source).name
    if results.strip is not None:
        film = Path(StripMetadata.of(results.strip).source)
        title = Path(film.parent.name, film.name).as_posix()  # many films have the same name
    tables = [budget_table(results), *([] if results.tracks is None else [doubt_table(results.tracks)])]
    return render_page(
        path,
        sections_of(figures),
        facts,
        title=title,
        kind="sheet positions",
        subtitle=subtitle(results),
        answers=[replace(one, detail=with_options(one.detail, options)) for one in answers(results)],
        warnings=list(warnings),
        missing=[with_options(line, options) for line in missing_parts(results)],
        methods=methods(results),
        tables=[table for table in tables if table.rows],
    )


def render_page(
    path: str | Path,
    sections: Sequence[tuple[str, Sequence[Figure]]],
    facts: Mapping[str, Any],
    **content: Any,
) -> Path:
    """Write a page of figures, with one panel each, under their headings.

    `facts` is the content of run.json; `content` holds the other variables of the template: title, kind,
    subtitle, answers, warnings, missing, methods and tables.
    """
    store = ArrayStore()
    charts = {one.name: _panel_data(one.name, one.panel, store) for _, part in sections for one in part}
    style = {"slips": SLIPS, "casing": CASING, "outline": HIGHLIGHT, "many": MANY_POINTS, "turns": TURNS}
    data = {"charts": charts, "blobs": store.blobs(), "style": style}
    text = _template().render(
        sections=sections,
        provenance=provenance(facts),
        analysed_with=ANALYSED_WITH,
        citation=CITED,
        data=htmlsafe_json_dumps(data, allow_nan=False, separators=(",", ":"), ensure_ascii=False),
        **content,
    )
    path = Path(path)
    path.write_text(text, encoding="utf-8", errors="replace")
    return path


@cache
def _template() -> Template:
    """Return the template, with the plotting library and the page's own style and script."""
    environment = Environment(autoescape=True, undefined=StrictUndefined)
    environment.filters["symbols"] = to_html
    environment.filters["latex"] = to_latex
    shipped = {"plot_css": "uPlot.min.css", "plot_js": "uPlot.iife.min.js"}
    shipped |= {"css": "report.css", "js": "report.js"}
    environment.globals.update({name: Markup(_asset(place)) for name, place in shipped.items()})
    return environment.from_string(_asset("report.html.jinja"))


def _asset(name: str) -> str:
    return files("vision.report").joinpath("assets", name).read_text(encoding="utf-8")


# --- data for the page's script -----------------------------------------------------------------------------


def _panel_data(name: str, panel: Panel, store: ArrayStore) -> dict[str, Any]:
    """Return a panel as JSON; its series refer to arrays by their index in `arrays`."""
    arrays: list[dict[str, Any]] = []
    indices: dict[int, int] = {}

    def index_of(values: Floats) -> int:
        if id(values) not in indices:
            indices[id(values)] = len(arrays)
            arrays.append(store.add(values))
        return indices[id(values)]

    picture = None
    if (image := panel.image) is not None:
        picture = {edge: getattr(image, edge) for edge in ("left", "right", "top", "bottom")}
        picture["uri"] = image_uri(image, most_bytes=450_000)
    same = (
        "x_label y_label y2_label x_lines x_range y_range first_view downwards time_down whole_numbers "
        "y_whole_numbers switchable common_x"
    )
    return {
        "name": name,
        **{one: getattr(panel, one) for one in same.split()},
        "axis_labels": [to_unicode(label) for label in (panel.x_label, panel.y_label, panel.y2_label)],
        "series": [_series_data(series, index_of) for series in panel.series],
        "arrays": arrays,
        "picture": picture,
        "bands": [vars(band) for band in panel.bands],
        "marks": [] if panel.marks is None else [float(f"{t:.8g}") for t in panel.marks.tolist()],
        "arrows": [vars(arrow) | {"label": to_unicode(arrow.label)} for arrow in panel.arrows],
        "aspect": 0.75 if panel.time_down else panel.aspect,
    }


def _series_data(series: Series, index_of: Callable[[Floats], int]) -> dict[str, Any]:
    same = ("label", "ink", "look", "dashed", "hollow", "shift", "width", "axis", "sheet")
    data: dict[str, Any] = {name: getattr(series, name) for name in same}
    if not np.isfinite(series.y).any():
        data["label"] = ""  # the legend leaves it out
    data |= {"html": str(to_html(series.label)), "textLabel": to_unicode(series.label)}
    data |= {"x": index_of(series.x), "y": index_of(series.y)}
    if series.low is not None and series.high is not None:
        data |= {"low": index_of(series.low), "high": index_of(series.high)}
    return data | ({"text": series.text, "textY": series.text_y} if series.text else {})


def image_uri(image: Image, *, most_bytes: int) -> str:
    """Return an image as a JPEG data URI of at most `most_bytes`, with fewer pixels if necessary."""
    pixels = image.pixels
    if image.missing is not None:
        pixels = np.repeat(pixels[:, :, None], 3, axis=2)
        pixels[image.missing] = rgb(MISSING)
    picture = Pillow.fromarray(pixels)
    while True:
        for quality in (85, 70, 50, 30, 15):
            stream = io.BytesIO()
            picture.save(stream, "JPEG", quality=quality)
            if stream.tell() <= most_bytes:
                return "data:image/jpeg;base64," + base64.b64encode(stream.getvalue()).decode("ascii")
        picture = picture.resize((max(1, picture.width * 2 // 3), max(1, picture.height * 2 // 3)))


class ArrayStore:
    """Arrays of a page, each stored once even if several figures draw it."""

    def __init__(self) -> None:
        self._indices: dict[bytes, int] = {}  # encoded array to its index in `blobs`

    def add(self, values: Floats) -> dict[str, Any]:
        """Encode an array for the page: as numbers if it is short, else as 16-bit residuals from a line.

        The line goes from the first to the last value of a rising array, such as times, and is constant for
        others. The resolution is 1/65534 of the residuals' range, finer than a screen.
        """
        values = np.asarray(values, np.float64)
        if values.size <= PLAIN:
            return {"v": [float(f"{v:.8g}") if isfinite(v) else None for v in values.tolist()]}
        start = slope = 0.0
        if np.isfinite(values).all() and (np.diff(values) >= 0).all():
            start, slope = float(values[0]), float(values[-1] - values[0]) / (values.size - 1)
        residual = values - start - slope * np.arange(values.size)
        known = np.isfinite(residual)
        inside = residual[known]
        low, high = (float(inside.min()), float(inside.max())) if inside.size else (0.0, 0.0)
        middle, step = (low + high) / 2, (high - low) / (2 * 32767) or 1.0
        code = np.where(known, np.rint((np.nan_to_num(residual) - middle) / step), -32768).astype("<i2")
        index = self._indices.setdefault(code.tobytes(), len(self._indices))
        return {"b": index, "start": start + middle, "slope": slope, "step": step}

    def blobs(self) -> list[str]:
        """Return all arrays in base64, in the order of their indices."""
        return [base64.b64encode(data).decode("ascii") for data in self._indices]


# --- tables -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FactsTable:
    """A small table of the page."""

    title: str
    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""


def budget_table(results: Results) -> FactsTable:
    """Return the contributions to the systematic error of each result, and its statistical error."""
    budget = systematic_budget(results)
    quantities = [name for name in QUANTITIES if name in budget.values]
    heads = ("", *(" in ".join(filter(None, QUANTITIES[name])) for name in quantities))
    unknown = () if results.fits is None else results.fits.undetermined

    def row(head: str, texts: Mapping[str, str], undetermined: str = "") -> tuple[str, ...]:
        return head, *(undetermined if name in unknown else texts.get(name, "") for name in quantities)

    def two_digits_of(errors: Mapping[str, float | None]) -> dict[str, str]:
        return {name: _two_digits(error, "not known") for name, error in errors.items()}

    values = {name: _digits(value) for name, value in budget.values.items()}
    statistical = {name: _two_digits(error) for name, error in budget.statistical.items()}
    rows = [row("value", values, "not determined"), row("statistical error", statistical)]
    rows += [row(SOURCES.get(one, one), two_digits_of(errors)) for one, errors in budget.sources.items()]
    rows.append(row("systematic error", two_digits_of({name: budget.total(name) for name in quantities})))
    note = (
        "The last row is the root of the sum of squares of the known errors. Values and statistical errors "
        "of a position, of K and of σ_x/Λ_st are medians over positions, events and sheets. The systematic "
        "error of a position is the same in every frame, so that displacements do not have it. An empty cell "
        "means no effect."
    )
    return FactsTable("Systematic errors", heads, tuple(rows) if quantities else (), note)


def doubt_table(tracks: xr.Dataset) -> FactsTable:
    """Return the stretches in which the identity of a sheet is uncertain."""
    heads = ("sheet", "side", "n", "frames", "why", "ridge withheld (px)", "predicted by neighbours (px)")
    table = doubtful_stretches(tracks)
    rows = tuple(
        (
            str(row["sheet"]),
            SIDES[row["side"]],
            str(row["n"]),
            _frames(row["first_frame"], row["last_frame"]),
            str(row["why"]),
            _digits(row["x_withheld_px"], places=1),
            _digits(row["x_expected_px"], places=1),
        )
        for row in table.head(100).to_dict("records")
    )
    note = (
        "No position is given there; the entries of a file of corrections decide manually about each stretch."
    )
    if more := len(table) - len(rows):
        note += f" {more} shorter ones: run.json."
    return FactsTable("Doubtful stretches", heads, rows, note)


def _frames(first: int, last: int) -> str:
    """Return a range of frames, which stays on one line."""
    return str(first) if first == last else f"{first}\u2060–\u2060{last}"


def _digits(value: float | None, *, places: int | None = None) -> str:
    if value is None or not np.isfinite(value):
        return "—"
    return with_minus(f"{value:.4g}" if places is None else f"{value:.{places}f}")


def _two_digits(error: float | None, unknown: str = "—") -> str:
    return unknown if error is None or not np.isfinite(error) else with_minus(two_digits(error))


def provenance(facts: Mapping[str, Any]) -> list[FactsTable]:
    """Return tables of parameters, findings, manual decisions, inputs, versions and command."""
    parameters = (
        (name, "—" if one["value"] is None else str(one["value"]), str(one["how"]))
        for name, one in facts.get("parameters", {}).items()
    )
    decisions = (
        (str(one["text"]), str(one["date"])[:19].replace("T", " ") or "—")
        for one in facts.get("corrections", ())
    )
    inputs = (
        (str(one["path"]), str(one["size_bytes"]), str(one.get("sha256") or f"{one['fingerprint']}{_PART}"))
        for one in facts.get("inputs", ())
    )
    tables = [
        FactsTable("Parameters", ("parameter", "value", "given or found"), tuple(parameters)),
        FactsTable("What was found", ("quantity", "value"), tuple(_texts(facts.get("found", {})))),
        FactsTable("Manual decisions", ("decision", "date"), tuple(decisions)),
        FactsTable("Inputs", ("file", "bytes", "SHA-256"), tuple(inputs)),
        FactsTable("Versions", ("package", "version"), tuple(_texts(facts.get("versions", {})))),
        FactsTable("Command", ("command line",), ((str(facts["command"]),),) if "command" in facts else ()),
    ]
    return [table for table in tables if table.rows]


def _texts(values: Mapping[str, Any]) -> Iterable[tuple[str, ...]]:
    for name, value in flattened(values, ": "):
        yield name, f"{value:.6g}" if isinstance(value, float) else str(value)
