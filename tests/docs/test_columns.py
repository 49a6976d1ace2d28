"""docs/columns.md has every column of the tables, as `vision.data` declares it."""

import json
import re
from pathlib import Path

import pytest

from tests.scenes.analysed import with_force
from vision.data import MOTION, SHELLS, STICKS, TRACKS
from vision.pipeline import Settings, analyse
from vision.run.provenance import Origin
from vision.run.tables import sheets_table, tracks_table
from vision.run.writing import write_run
from vision.shells import deformation_table

PROJECT = Path(__file__).parents[2]
PAGE = PROJECT / "docs" / "columns.md"


def documented():
    """Table to column to (unit, meaning)."""
    parts = re.split(r"^## ", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]
    return {
        part.partition("\n")[0]: {
            name: (unit, meaning)
            for name, unit, meaning in re.findall(r"^\| `(\w+)` \| (.*?) ?\| (.+) \|$", part, re.MULTILINE)
        }
        for part in parts
    }


@pytest.mark.parametrize(
    ("name", "declared", "written"),
    [
        ("events.csv", STICKS, lambda run: run.sticks),
        ("deformation.csv", MOTION, lambda run: deformation_table(run.motion)),
        ("shells.csv", SHELLS, lambda run: run.shells),
        ("sheets.csv", TRACKS, lambda run: sheets_table(run.tracks)),
    ],
)
def test_every_column_has_its_unit_and_meaning(name, declared, written):
    """A failure means that a column is not explained, or explained as another."""
    page = documented()[name]
    assert list(page) == list(written(with_force()).columns)
    known = [column for column in page if column in declared.variables]
    assert len(known) >= 7
    assert {c: page[c] for c in known} == {c: (declared[c].units, declared[c].long_name) for c in known}


def test_the_readme_lists_the_columns_of_tracks():
    """A failure means that a column of tracks.csv was added, or its place changed, without a word."""
    row = re.search(r"`tracks.csv` .*?: `([\w,]+)`", (PROJECT / "README.md").read_text(encoding="utf-8"))
    assert row[1].split(",") == list(tracks_table(with_force().tracks))


def test_every_flag_of_a_deformation_is_explained():
    """A failure means that a reader meets a flag in deformation.csv that the page does not explain."""
    code = (PROJECT / "vision" / "deformation" / "motion.py").read_text(encoding="utf-8")
    given = re.findall(r'^ +"(\w+)": ', code.partition("flags = {")[2].partition("}")[0], re.MULTILINE)
    assert sorted(documented()["Flags of deformation.csv"]) == sorted([*given, "ok"])
    assert len(given) == 5


def test_every_entry_of_the_json_files_is_explained(tmp_path):
    """A failure means that an entry is not explained, or that one is explained that no longer exists."""
    late = Path(__file__).parents[2] / "fixtures" / "late"
    settings = Settings(pixel_size_um=10, timestamps=late / "timestamps.txt", d0_mm=16.6)
    run = analyse(late / "video.avi", late / "force.txt", settings)
    origin = Origin(command="track video.avi", inputs=(late / "video.avi",), parameters={})
    write_run(run, tmp_path / "run", origin, report=False)
    for name in ("clock.json", "models.json", "run.json"):
        written = json.loads((tmp_path / "run" / name).read_text(encoding="utf-8"))
        assert list(documented()[name]) == list(written)
