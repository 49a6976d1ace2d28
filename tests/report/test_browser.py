"""The page in a real browser: every figure draws, zoom and switches work, nothing leaves the page."""

import csv
import io
import os
import re
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image

from tests.scenes.analysed import FACTS
from tests.scenes.browser import Visit, assert_shut_in
from vision.figures import Panel, Series
from vision.figures.catalogue import figures_of
from vision.figures.style import DATA, to_unicode
from vision.report import write_report
from vision.report.page import render_page

pytestmark = pytest.mark.thorough


@pytest.fixture(scope="module")
def report(pulled, tmp_path_factory):
    return write_report(tmp_path_factory.mktemp("page") / "report.html", pulled, FACTS)


class ReportVisit(Visit):
    """The open report, with every figure drawn."""

    def __init__(self, browser, path, **look):
        super().__init__(browser, path.as_uri(), **look)
        self.page.wait_for_function(
            "[...document.querySelectorAll('figure[data-chart]')].every((f) => f.dataset.drawn === 'yes')"
        )

    def range_of(self, name, scale="x"):
        return self.page.evaluate(
            "([name, scale]) => { const s = document.getElementById(name).plot.scales[scale];"
            " return [s.min, s.max]; }",
            [name, scale],
        )

    def click(self, name, label):
        self.page.locator(f"#{name}").get_by_label(label, exact=True).click()

    def wait_range(self, name, test):
        self.page.wait_for_function(
            f"() => {{ const s = document.getElementById('{name}').plot.scales.x; return {test}; }}"
        )


@pytest.fixture
def visit(browser, report):
    opened = ReportVisit(browser, report)
    yield opened
    opened.context.close()


def inked(visit, name):
    """Different colours in the figure's canvas: an empty one has next to none."""
    return visit.page.evaluate(
        """(name) => {
          const canvas = document.querySelector(`#${name} canvas`);
          const data = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
          const seen = new Set();
          for (let i = 0; i < data.length; i += 4) {
            if (data[i + 3] > 200) seen.add((data[i] << 16) | (data[i + 1] << 8) | data[i + 2]);
          }
          return seen.size;
        }""",
        name,
    )


def test_every_figure_draws_without_complaint_or_request(visit, pulled, report):
    """A failure means an empty figure, a script error, or a page that asks the network."""
    names = [figure.name for figure in figures_of(pulled)]
    assert visit.page.locator("figure[data-drawn=yes]").count() == len(names)
    assert visit.complaints == []
    assert [url for url in visit.requests if not url.startswith("data:")] == [report.as_uri()]
    assert {name: inked(visit, name) for name in names if inked(visit, name) < 8} == {}


def test_the_page_could_not_ask_the_network_if_it_tried(visit):
    """A failure means that a script that strayed into the page could send the data away."""
    assert_shut_in(visit)


NUMBERS_ON_TWO_LINES = """
  [...document.querySelectorAll("td")].filter((cell) => {
    const within = document.createRange();
    within.selectNodeContents(cell);
    return /^[−.0-9]+$/.test(cell.textContent) && within.getClientRects().length > 1;
  }).map((cell) => cell.textContent)
"""


@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (390, "dark")])
def test_the_page_fits_its_window(browser, report, width, scheme):
    """A failure means that a phone shows a page cut off at the right, or in the wrong colours."""
    visit = ReportVisit(browser, report, viewport={"width": width, "height": 900}, color_scheme=scheme)
    assert visit.page.evaluate("document.documentElement.scrollWidth") <= width
    assert visit.page.evaluate("document.documentElement.dataset.theme") == scheme
    assert visit.page.evaluate(NUMBERS_ON_TWO_LINES) == []
    assert visit.complaints == []
    if folder := os.environ.get("SHEETVISION_SCREENSHOTS"):
        visit.page.screenshot(path=f"{folder}/report_{width}_{scheme}.png", full_page=True)
    visit.context.close()


def page_with(browser, folder, figures):
    """Open a page of these figures and nothing else."""
    words = dict.fromkeys(("title", "kind", "subtitle"), "")
    lists = {name: [] for name in ("answers", "warnings", "missing", "methods", "tables")}
    return ReportVisit(
        browser, render_page(folder / "page.html", [("Section", figures)], {}, **words, **lists)
    )


def test_one_sheet_on_a_side_hides_no_number_of_the_other(browser, tmp_path):
    """A failure means that sheets of a film with few of them have no number in the frame."""
    left, right = (
        Series(label=name, x=x, y=0 * x, low=0 * x - 1, high=0 * x + 1, text=text, ink=DATA, look="ticks")
        for name, x, text in (
            ("left", np.array([10.0]), ("1",)),
            ("right", np.array([17.0, 24.0]), ("1", "77")),
        )
    )
    panel = Panel(x_label="x", y_label="z", series=(left, right), x_range=(0.0, 30.0), y_range=(-2.0, 2.0))
    visit = page_with(browser, tmp_path, [panel.figure("frame", "Caption.", title="frame")])
    assert ">77</text>" in visit.page.evaluate("document.getElementById('frame').svg()")
    visit.context.close()


def test_error_bars_lie_within_the_axes(browser, tmp_path):
    """A failure means that the largest errors are cut off, and look smaller than they are."""
    x, error = np.arange(4.0), np.array([0.1, 5.0, 0.1, 3.0])
    left = Series.points("one", x, x, DATA, error)
    right = replace(left, axis="right", label="other")
    panels = {
        "single": Panel(x_label="n", y_label="a", series=(left,)),
        "double": Panel(x_label="n", y_label="a", y2_label="b", series=(left, right)),
    }
    figures = [panel.figure(name, "Caption.", title=name) for name, panel in panels.items()]
    visit = page_with(browser, tmp_path, figures)
    for name, scale in (("single", "y"), ("double", "y"), ("double", "y2")):
        low, high = visit.range_of(name, scale)
        assert low < -4 and high > 6, (name, scale)
    visit.context.close()


def test_no_series_of_many_points_hides_another(browser, tmp_path):
    """A failure means that of several tests that coincide only the last is seen."""
    rng = np.random.default_rng(0)
    inks = ("#ff0000", "#00ff00", "#0000ff")
    series = [
        Series.points(ink, np.linspace(0, 1, 700), 0.01 * rng.standard_normal(700), (ink, ink))
        for ink in inks
    ]
    panel = Panel(x_label="d", y_label="F", series=tuple(series), y_range=(-0.5, 0.5))
    visit = page_with(browser, tmp_path, [panel.figure("crowd", "Caption.", title="crowd")])
    counts = visit.page.evaluate(
        """() => {
          const canvas = document.querySelector("#crowd canvas");
          const data = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
          const count = [0, 0, 0];
          for (let i = 0; i < data.length; i += 4) {
            const at = [0, 1, 2].filter((k) => data[i + k] > 200);
            if (data[i + 3] > 200 && at.length === 1) count[at[0]]++;
          }
          return count;
        }"""
    )
    assert min(counts) > 0.8 * max(counts) > 0
    drawn = visit.page.evaluate("document.getElementById('crowd').svg()")
    assert all(drawn.count(f'fill="{ink}"') >= 32 for ink in inks)
    visit.context.close()


def test_dragging_zooms_and_the_button_shows_the_whole_again(visit):
    """A failure means that a single slip cannot be looked at."""
    low, high = visit.range_of("tracks")
    box = visit.page.locator("#tracks .u-over").bounding_box()
    visit.page.locator("#tracks").scroll_into_view_if_needed()
    box = visit.page.locator("#tracks .u-over").bounding_box()
    middle = box["y"] + box["height"] / 2
    visit.page.mouse.move(box["x"] + 0.25 * box["width"], middle)
    visit.page.mouse.down()
    visit.page.mouse.move(box["x"] + 0.5 * box["width"], middle, steps=5)
    visit.page.mouse.up()
    visit.wait_range("tracks", f"s.max - s.min < {0.3 * (high - low)}")
    start, stop = visit.range_of("tracks")
    assert start == pytest.approx(low + 0.25 * (high - low), abs=0.02 * (high - low))
    assert stop == pytest.approx(low + 0.5 * (high - low), abs=0.02 * (high - low))
    visit.click("tracks", "show the whole range (double click)")
    visit.wait_range("tracks", f"Math.abs(s.max - {high}) < 1e-6 && Math.abs(s.min - {low}) < 1e-6")


def test_buttons_zoom_where_there_is_no_mouse(visit):
    """A failure means that a phone's reader cannot zoom."""
    low, high = visit.range_of("clocks")
    visit.click("clocks", "zoom in")
    visit.wait_range("clocks", f"s.max - s.min < {0.6 * (high - low)}")
    start, _ = visit.range_of("clocks")
    visit.click("clocks", "later")
    visit.wait_range("clocks", f"s.min > {start}")
    visit.click("clocks", "show the whole range (double click)")
    visit.wait_range("clocks", f"s.max - s.min >= {high - low}")


def test_the_space_time_diagram_zooms_in_both_directions(visit):
    """A failure means that one sheet cannot be looked at closely."""
    visit.page.locator("#space_time").scroll_into_view_if_needed()
    time, x = visit.range_of("space_time"), visit.range_of("space_time", "y")
    box = visit.page.locator("#space_time .u-over").bounding_box()
    visit.page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 0.2 * box["height"])
    visit.page.mouse.down()
    visit.page.mouse.move(box["x"] + 0.8 * box["width"], box["y"] + 0.6 * box["height"], steps=5)
    visit.page.mouse.up()
    visit.wait_range("space_time", f"s.max - s.min < {0.5 * (time[1] - time[0])}")
    zoomed = visit.range_of("space_time")
    assert zoomed[0] == pytest.approx(time[0] + 0.2 * (time[1] - time[0]), rel=0.05)  # time runs down
    zoomed = visit.range_of("space_time", "y")
    assert zoomed[1] - zoomed[0] == pytest.approx(0.3 * (x[1] - x[0]), rel=0.05)


def shown(visit):
    return visit.page.evaluate(
        "document.getElementById('tracks').plot.series.slice(1).filter((s) => s.show).map((s) => s.label)"
    )


def test_sheets_switch_on_and_off(visit):
    """A failure means that one sheet cannot be seen alone among fifty."""
    assert len(shown(visit)) == 50
    visit.click("tracks", "hide all sheets")
    assert shown(visit) == []
    visit.click("tracks", "sheet right 23")
    assert shown(visit) == ["right 23"]
    button = visit.page.locator("#tracks").get_by_label("sheet right 23", exact=True)
    assert button.get_attribute("aria-pressed") == "true"
    visit.click("tracks", "left sheets only")
    assert set(shown(visit)) == {f"left {n}" for n in range(1, 26)}
    visit.click("tracks", "show all sheets")
    assert len(shown(visit)) == 50


def test_each_figure_hands_out_its_numbers(visit, pulled):
    """A failure means that the numbers behind a figure cannot be had, or are others."""
    with visit.page.expect_download() as waiting:
        visit.click("tracks", "download this figure's numbers")
    assert waiting.value.suggested_filename == "tracks.csv"
    rows = list(csv.reader(io.StringIO(waiting.value.path().read_text(encoding="utf-8"))))
    assert rows[0][:2] == ["t (s)", "left 25"]
    assert len(rows) == 1 + pulled.tracks.sizes["frame"]
    x = pulled.tracks["x_px"].values[:, -1]
    away = 10 * (x[17] - float(np.median(x[:20])))
    assert float(rows[18][-1]) == pytest.approx(away, abs=0.01)
    tables = visit.page.evaluate(
        "[...document.querySelectorAll('figure[data-chart]')].map((f) => f.table().split('\\n').length)"
    )
    assert min(tables) > 3


def test_each_figure_is_saved_as_svg(visit, pulled):
    """A failure means an empty file, or one that shows something else than the page."""
    for figure in figures_of(pulled):
        root = ElementTree.fromstring(
            visit.page.evaluate("(n) => document.getElementById(n).svg()", figure.name)
        )
        text = " ".join(item.text for item in root.iter("{http://www.w3.org/2000/svg}text"))
        assert to_unicode(figure.panel.x_label) in text
        assert to_unicode(figure.panel.y_label) in text
        paths = [item.get("d") for item in root.iter("{http://www.w3.org/2000/svg}path")]
        assert all(path.startswith("M") for path in paths)
        longest = max(path.count("L") for path in paths)
        expected = max(len(s.x) for s in figure.panel.series)
        if any(s.look in ("line", "both") for s in figure.panel.series):
            assert longest > 0.3 * min(expected, 500), figure.name
        assert bool(list(root.iter("{http://www.w3.org/2000/svg}image"))) == bool(figure.panel.image)


@pytest.mark.parametrize("name", ["tracks", "space_time"])
def test_a_figure_is_saved_as_file(visit, name):
    """A failure means an empty or broken file, or another figure's."""
    for kind in ("SVG", "PNG"):
        with visit.page.expect_download() as waiting:
            visit.click(name, f"download this figure as {kind}")
        assert waiting.value.suggested_filename == f"{name}.{kind.lower()}"
        content = waiting.value.path().read_bytes()
        if kind == "SVG":
            assert content.decode() == visit.page.evaluate("(n) => document.getElementById(n).svg()", name)
            continue
        pixels = np.asarray(Image.open(io.BytesIO(content)).convert("RGB"))
        assert pixels.shape[1] == 1600
        assert len(np.unique(pixels.astype(np.int32) @ (1 << 16, 1 << 8, 1))) > 20
    assert visit.complaints == []
    assert visit.page.evaluate("document.documentElement.dataset.theme") == "light"


def test_a_saved_figure_shows_what_the_page_shows(visit):
    """A failure means that zoom and hidden sheets are lost on saving."""
    visit.click("tracks", "hide all sheets")
    visit.click("tracks", "sheet right 23")
    whole = visit.page.evaluate("document.getElementById('tracks').svg()")
    assert whole.count("<path") < 60  # one curve and the axes
    visit.click("tracks", "zoom in")
    visit.page.wait_for_function("(whole) => document.getElementById('tracks').svg() !== whole", arg=whole)
    assert (
        visit.page.evaluate("document.querySelectorAll('canvas').length")
        == visit.page.locator("figure").count()
    )


def test_the_methods_are_copied_as_latex(visit):
    """A failure means an empty clipboard, as the text for LaTeX is hidden."""
    visit.page.evaluate("addEventListener('copy', () => { window.copied = String(getSelection()); })")
    visit.page.get_by_text("copy as LaTeX").click()
    assert r"$\sigma_{x}$" in visit.page.evaluate("window.copied")
    assert not visit.page.locator("#methods-latex").is_visible()


def test_the_theme_button_repaints_the_figures(visit):
    """A failure means dark curves on a dark ground."""
    sample = "document.querySelector('#noise canvas').toDataURL()"
    mark = "getComputedStyle(document.querySelectorAll('#force .u-marker')[4]).borderTopColor"
    before, black = visit.page.evaluate(sample), visit.page.evaluate(mark)
    visit.page.locator(".theme").click()
    assert visit.page.evaluate("document.documentElement.dataset.theme") == "dark"
    visit.page.wait_for_function(f"(before) => {sample} !== before", arg=before)
    assert black == "rgb(26, 26, 26)"  # the model's curve, in the legend
    assert visit.page.evaluate(mark) == "rgb(242, 242, 242)"
    assert visit.complaints == []


def test_it_prints_light_and_whole(browser, report, tmp_path):
    """A failure means a black or cut-off printout."""
    visit = ReportVisit(browser, report, color_scheme="dark")
    visit.page.evaluate("window.dispatchEvent(new Event('beforeprint'))")
    assert visit.page.evaluate("document.documentElement.dataset.theme") == "light"
    assert visit.page.evaluate("document.getElementById('force').plot.width") <= 700
    visit.page.evaluate("window.dispatchEvent(new Event('afterprint'))")
    assert visit.page.evaluate("document.documentElement.dataset.theme") == "dark"
    printed = visit.page.pdf(path=str(tmp_path / "report.pdf"), format="A4")
    assert 6 <= len(re.findall(rb"/Type\s*/Page\b", printed)) <= 13
    visit.context.close()
