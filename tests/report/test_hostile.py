"""Names that would bite, in every output of a film: pages, pictures, tables."""

import csv
import json
import os
import re
import shutil
import xml.etree.ElementTree as ET
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import openpyxl
import pandas as pd
import pytest

from tests.scenes.comb_video import frames_of, positions, write_video
from tests.scenes.comparison import campaign, write_campaign
from vision.certify import CertifySettings, certify, write_certificate
from vision.command.main import run
from vision.figures import load_figures, save_figures
from vision.run.reading import read_run, read_strip

NAME = '=HYPERLINK("http:x.y")<script>alert(1)<script>"onload=alert(2) $\\frac{$ {{7*7}}\r\n\udcff ../x'
NAME = NAME.replace("/", "_")
SHIPPED = Path(__file__).parents[2] / "vision" / "report" / "assets"


class Page(HTMLParser):
    """Tags with their attributes, and the text of scripts."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.scripts, self._script = [], [], False
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        self._script = tag == "script"
        if self._script:
            self.scripts.append("")

    def handle_endtag(self, tag):
        self._script = self._script and tag != "script"

    def handle_data(self, data):
        if self._script:
            self.scripts[-1] += data


def check_page(file):
    """Nothing runs but what is shipped, nothing is loaded, nothing was evaluated."""
    text = file.read_text(encoding="utf-8")
    page = Page(text)
    shipped = [asset.read_text(encoding="utf-8") for asset in SHIPPED.glob("*.js")]
    for script in page.scripts:
        assert script.strip() in {asset.strip() for asset in shipped} or json.loads(script) is not None
    for tag, attributes in page.tags:
        assert not [name for name in attributes if name.startswith("on")], (tag, attributes)
        assert tag not in ("iframe", "object", "embed", "base", "form")
        for name in ("src", "href"):
            assert (attributes.get(name) or "data:").startswith("data:"), (tag, attributes)
    return text


def bites(cell):
    return cell.lstrip()[:1] in tuple("=+-@") and not re.fullmatch(r"[-+]?[0-9.]+(e[-+]?[0-9]+)?", cell)


def check_csv(file):
    with file.open(newline="", encoding="utf-8") as lines:
        cells = [cell for row in csv.reader(lines) for cell in row]
    assert cells
    assert [cell for cell in cells if cell and bites(cell)] == []


pytestmark = [pytest.mark.posix, pytest.mark.usefixtures("without_pictures")]


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A run folder of the film, in a folder of its own."""
    place = tmp_path_factory.mktemp("hostile")
    here = Path.cwd()
    os.chdir(place)
    try:
        (place / "films").mkdir()
        film = write_video(place / "films" / f"{NAME}.tif", frames_of(positions(frames=40)))
        assert run([str(film), "--quiet", "--out", f"{NAME}_tracks"]) == 0
    finally:
        os.chdir(here)
    return place


@pytest.fixture
def here(place, monkeypatch):
    monkeypatch.chdir(place)
    before = set(place.rglob("*"))
    yield place
    for path in set(place.rglob("*")) - before:  # each test begins with the run alone
        if path.exists():
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    assert sorted(p.name for p in place.parent.iterdir()).count(place.name) == 1


RUN = f"{NAME}_tracks"


def test_the_report_shows_the_name_and_runs_none_of_it(here):
    """A failure means that opening a report runs what a film's name says."""
    text = check_page(here / RUN / "report.html")
    assert "&lt;script&gt;alert(1)" in text
    assert "{{7*7}}" in text
    facts = json.loads((here / RUN / "run.json").read_text())
    assert "alert(1)" in facts["inputs"][0]["path"]
    assert "failures" not in facts


@pytest.mark.parametrize("to", ["csv", "xlsx"])
def test_exported_tables_compute_nothing(to, here):
    """A failure means that a film's name becomes a formula in a spreadsheet."""
    out = here / ("export" if to == "csv" else "export.xlsx")
    assert run(["export", RUN, "--to", to, "--out", str(out), "--quiet"]) == 0
    if to == "csv":
        for file in out.glob("*.csv"):
            check_csv(file)
        assert "HYPERLINK" in (out / "settings.csv").read_text(encoding="utf-8")
        return
    book = openpyxl.load_workbook(out)
    cells = [cell for sheet in book for row in sheet.rows for cell in row]
    assert any("HYPERLINK" in str(cell.value) for cell in cells)
    assert {cell.data_type for cell in cells} <= {"s", "n", "b"}
    assert [cell.value for cell in cells if cell.data_type == "s" and bites(cell.value)] == []
    assert [cell for cell in cells if cell.hyperlink] == []


@pytest.mark.parametrize("to", ["svg", "csv"])
def test_figures_hold_text_alone(to, here):
    """A failure means that a picture runs what a film's name says."""
    assert run(["figures", RUN, "--to", to, "--out", "figures", "--quiet"]) == 0
    files = list((here / "figures").iterdir())
    assert len(files) > 3
    for file in files:
        if to == "csv":
            check_csv(file)
        else:
            tags = [(part.tag.rpartition("}")[2], part.attrib) for part in ET.parse(file).iter()]
            assert not {tag for tag, _ in tags} & {"script", "foreignObject", "a", "iframe"}
            assert not [name for _, attributes in tags for name in attributes if name.startswith("on")]


def test_figures_stay_in_their_folder(here):
    """A failure means that a run folder from elsewhere writes files where it likes."""
    bad = Path(shutil.copytree(here / RUN, here / "bad"))
    figures = load_figures(bad / "figures.npz")
    for name in ("../escaped", str(here / "escaped"), "a\0b", ""):
        save_figures(bad / "figures.npz", [replace(figures[0], name=name)])
        assert run(["figures", "bad", "--to", "csv", "--out", "figures", "--quiet"]) == 2
    assert not list(here.rglob("escaped*"))


def test_preview_kymograph_and_default_names_stay_here(here):
    """A failure means that a name leads the results to another folder, or ends in a traceback."""
    film = next((here / "films").iterdir())
    assert run(["preview", str(film), "--quiet"]) in (0, 1)
    assert run(["kymograph", RUN, "--quiet"]) == 0
    new = [p for p in here.iterdir() if p.name not in ("films", RUN)]
    assert len(new) >= 2
    assert all(p.name.startswith("=HYPERLINK") for p in new)


def test_the_certificate_shows_the_name_and_runs_none_of_it(here):
    """A failure means that a certificate, which is made to be passed on, runs what a name says."""
    found = read_run(here / RUN)
    made = certify(read_strip(found), found.tracks, settings=CertifySettings(films=1, largest_jump=1.0))
    write_certificate(replace(made, codec=NAME, fit=NAME, warnings=(NAME,)), here / "certificate")
    text = check_page(here / "certificate" / "certificate.html")
    assert "&lt;script&gt;alert(1)" in text


def test_a_comparison_shows_names_and_runs_none_of_them(tmp_path, monkeypatch):
    """A failure means that the page or the table of several tests bites by the name of one of them."""
    monkeypatch.chdir(tmp_path)
    tests = campaign(np.random.default_rng(4)).iloc[:4].copy()
    tests["run"] = [f"{NAME.replace(chr(0xDCFF), '').replace(chr(13), '')}{k}" for k in range(4)]
    tests["sample"] = ["=1+1", "<script>alert(1)</script>", '"onload=alert(2)', "@SUM(A1)"]
    write_campaign(tmp_path, tests)
    assert run(["compare", "--table", "tests.csv", "--out", "all", "--quiet"]) in (0, 1)
    text = check_page(tmp_path / "all" / "report.html")
    assert "&lt;script&gt;alert(1)" in text
    check_csv(tmp_path / "all" / "tests.csv")
    assert len(pd.read_csv(tmp_path / "all" / "tests.csv")) == 4
