"""What all films come to: the tables and the page."""

from __future__ import annotations

import os
import re
import sys
from html.parser import HTMLParser

import numpy as np
import pandas as pd
import pyarrow.compute as pc
import pyarrow.dataset as ds
import pyarrow.parquet as pq
import pytest

import vision
from tests.campaign.scenes import films, planned, rows
from vision.campaign.films import Row
from vision.campaign.jobs import run_job
from vision.campaign.plan import State, make_plan, write_state
from vision.campaign.results import (
    as_arrow,
    duration,
    needs_pool,
    open_tables,
    pool,
    remove_others,
    write_page,
    write_partitions,
    write_tests,
)
from vision.errors import InputError
from vision.run.provenance import Origin
from vision.run.reading import read_run
from vision.sheets.corrections import correction_of

# --- tables -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Of two films: one in µm, the other in px only."""
    paths = films(tmp_path_factory.mktemp("films"), 2)
    analyses = [
        vision.analyse(path, fps=20.0, pixel_size_um=size)
        for path, size in zip(paths, (10.0, None), strict=True)
    ]
    return [
        read_run(vision.save_run(one, path.with_suffix(""), report=False))
        for one, path in zip(analyses, paths, strict=True)
    ]


def test_each_film_is_a_partition_and_all_are_one_table(tmp_path, runs):
    """A failure means that rows of one test stand under another's name, or that types differ."""
    names = ["old 1", "50% RH/é"]
    for name, run in zip(names, runs, strict=True):
        write_partitions(tmp_path, name, run)
    write_tests(tmp_path, {names[0]: {"sample": "a", "n": 1.0}, names[1]: {"sample": None, "n": np.nan}})
    positions = open_tables(tmp_path, "positions")
    for name, run in zip(names, runs, strict=True):
        table = positions.to_table(filter=ds.field("film") == name).to_pandas()
        assert len(table) == 240
        np.testing.assert_allclose(table["x_px"], run.tracks["x_px"].values.ravel(), atol=1e-4)
        assert table["x_um"].notna().all() == (run.pixel_size_um is not None)
    tests = open_tables(tmp_path, "tests").to_table().to_pandas().set_index("film")
    assert tests.loc[names[0], "sample"] == "a"
    assert pd.isna(tests.loc[names[1], "sample"])
    assert open_tables(tmp_path, "sheets").count_rows() == 16
    remove_others(tmp_path, names[:1])  # the other film is no longer in the table
    assert open_tables(tmp_path, "positions").count_rows() == 240
    with pytest.raises(InputError, match="tables of a campaign"):
        open_tables(tmp_path, "sticks")
    with pytest.raises(InputError, match="one of tests, sheets"):
        open_tables(tmp_path, "nothing")


def test_other_programs_read_the_folder_as_one_table(tmp_path, runs):
    """As pandas does, which knows nothing of campaigns."""
    for name, run in zip("ab", runs, strict=True):
        write_partitions(tmp_path, name, run)
    table = pd.read_parquet(tmp_path / "tables" / "sheets")
    assert table["film"].astype(str).value_counts().to_dict() == {"a": 8, "b": 8}


def test_types_do_not_depend_on_what_one_film_holds():
    """A failure means that tables of films without events cannot be read together with the others."""
    full = pd.DataFrame({"flag": ["ok"], "x": [1.0], "n": [1], "s": pd.Series([None], dtype=object)})
    empty = full.iloc[:0]
    assert as_arrow(full).schema == as_arrow(empty).schema
    assert str(as_arrow(full).schema.field("s").type) == "string"


def test_a_hundred_million_rows_open_lazily(tmp_path):
    """A hundred films of a million rows: looking at one film reads that film alone, of 99 others no value."""
    rows = 1_000_000
    part = tmp_path / "tables" / "positions" / "film=t0" / "part.parquet"
    part.parent.mkdir(parents=True)
    x = np.arange(rows, dtype=np.float64)
    pq.write_table(as_arrow(pd.DataFrame({"frame": np.arange(rows), "x_px": x, "flag": "ok"})), part)
    others = [part.parents[1] / f"film=t{k}" / part.name for k in range(1, 100)]
    for other in others:
        other.parent.mkdir()
    values, end = bytearray(part.read_bytes()), part.stat().st_size
    values[4 : end - 8 - int.from_bytes(values[-8:-4], "little")] = bytes(
        end - 12 - int.from_bytes(values[-8:-4], "little")
    )  # all but the index at the end: who reads a value fails
    others[0].write_bytes(values)
    for other in others[1:]:
        os.link(part if other.parent.name == "film=t42" else others[0], other)
    table = open_tables(tmp_path, "positions")
    assert table.count_rows() == 100 * rows
    one = table.to_table(columns=["x_px"], filter=(ds.field("film") == "t42") & (ds.field("frame") < 10))
    assert pc.sum(one["x_px"]).as_py() == 45
    with pytest.raises(OSError):
        table.to_table(columns=["x_px"])


@pytest.mark.skipif(sys.platform != "linux", reason="a job has no functions that a test defines")
def test_a_run_that_was_corrected_renews_tables_state_and_pool(tmp_path):
    """A failure means that a sheet that was left out by hand stays in the pooled tables, without a word."""
    (path,) = films(tmp_path, 1)
    plan = planned(tmp_path / "out", [path])

    def work(film, source, target):
        analysis = vision.analyse(path, fps=20.0, pixel_size_um=10.0)
        vision.save_run(analysis, target, report=False)
        return ""

    assert run_job(plan, *plan.jobs, work) == 0
    pool(plan, Origin(command="track campaign"))
    before = open_tables(plan.out, "positions").to_table().to_pandas()
    assert set(before["flag"]) == {"ok"} and not needs_pool(plan)
    decision = correction_of("leave_out", {"sheet": 3, "frames": "0:"})
    corrected = vision.analyse(path, fps=20.0, pixel_size_um=10.0, corrections=(decision,))
    vision.save_run(corrected, plan.run_of("t0"), report=False, overwrite=True)
    assert needs_pool(plan)
    pool(plan, Origin(command="track campaign"))
    after = open_tables(plan.out, "positions").to_table().to_pandas()
    assert set(after.loc[after["index"] == 3, "flag"]) == {"left_out"}
    np.testing.assert_array_equal(after["x_px"][after["index"] != 3], before["x_px"][before["index"] != 3])
    assert after.dtypes.equals(before.dtypes)
    sheets = open_tables(plan.out, "sheets").to_table().to_pandas().set_index("index")
    assert sheets.loc[3, "found"] == 0
    assert plan.state(plan.films[0]).warnings == corrected.warnings
    assert not needs_pool(plan)
    assert make_plan(rows([path]), plan.out).jobs == {}  # the correction stays


# --- the page -----------------------------------------------------------------------------------------------


HOSTILE = "<script>alert(1)</script> \"'><img src=x onerror=alert(2)> {{7*7}}"


class Elements(HTMLParser):
    """Start tags with their attributes."""

    def __init__(self, text):
        super().__init__()
        self.found = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))

    def all(self, tag):
        return [attrs for name, attrs in self.found if name == tag]


def page_of(plan, **how):
    write_page(plan, **({"live": False} | how))
    return (plan.out / "index.html").read_text(encoding="utf-8")


def test_every_test_with_state_reason_thumbnail_and_link(tmp_path):
    """A failure means that a failed film looks done, or that its reason or report is not found."""
    plan = planned(tmp_path / "out", films(tmp_path, 4))
    words = ("done", "warnings", "failed")
    for name, word in zip(("t0", "t1", "t2"), words, strict=True):
        key = plan.film(name).key
        state = State(name=name, key=key, state=word, reason=f"why {name}", warnings=("one", "two"))
        write_state(plan.out, state)
    for name in ("t0", "t1", "t2"):  # t2 has a run with other settings
        plan.run_of(name).mkdir(parents=True)
        for file in ("run.json", "report.html"):
            (plan.run_of(name) / file).write_text("{}")
    (plan.out / "thumbnails").mkdir()
    (plan.out / "thumbnails" / "t0.png").write_bytes(b"\x89PNG")
    text = page_of(plan)
    for word, count in [("done", 1), ("with warnings", 1), ("failed", 1), ("waiting", 1)]:
        assert f"<b>{count}</b> {word}" in text
    links = {link["href"] for link in Elements(text).all("a")}
    assert {"runs/t0/report.html", "runs/t1/report.html", "campaign.csv"} == links
    assert [image["src"] for image in Elements(text).all("img")] == ["data:image/png;base64,iVBORw=="]
    assert "why t2" in text
    lines = (plan.out / "campaign.csv").read_text().splitlines()
    assert lines[0] == "film,state,reason,seconds,run"
    assert [line.split(",")[1] for line in lines[1:]] == [*words, "waiting"]
    assert [line.rpartition(",")[2] for line in lines[1:]] == ["runs/t0", "runs/t1", "", ""]


@pytest.mark.posix
def test_hostile_names_are_text(tmp_path):
    """A failure means that a film's name or a warning runs a script in the reader's browser."""
    path = films(tmp_path, 1)[0]
    row = Row(row=2, film=str(path), name="x' onmouseover=alert(3) y=#?", facts={"sample": HOSTILE})
    plan = make_plan([row], tmp_path / "out")
    write_state(
        plan.out,
        State(name=row.name, key=plan.films[0].key, state="done", reason=HOSTILE, warnings=(HOSTILE,) * 2),
    )
    plan.run_of(row.name).mkdir(parents=True)
    (plan.run_of(row.name) / "run.json").write_text("{}")
    text = page_of(plan, remarks=(HOSTILE,))
    elements = Elements(text)
    assert elements.all("script") == elements.all("img") == []
    assert not [name for _, attrs in elements.found for name in attrs if name.startswith("on")]
    assert "{{7*7}}" in text
    (link,) = [a["href"] for a in elements.all("a") if a["href"].startswith("runs/")]
    assert re.fullmatch(r"runs/[A-Za-z0-9%._~-]+/overview\.png", link)
    policy = next(
        m["content"] for m in elements.all("meta") if m.get("http-equiv") == "Content-Security-Policy"
    )
    assert policy.startswith("default-src 'none'; style-src 'unsafe-inline'; img-src data:;")
    assert "script" not in policy


@pytest.mark.parametrize("live", [True, False])
def test_the_page_renews_itself_only_while_the_campaign_runs(tmp_path, live):
    """A failure means a page that stands still, or one that reloads for ever."""
    text = page_of(planned(tmp_path / "out", films(tmp_path, 1)), live=live)
    assert bool([m for m in Elements(text).all("meta") if m.get("http-equiv") == "refresh"]) == live
    assert ("computing are left" in text) == live


@pytest.mark.parametrize(("seconds", "said"), [(45, "45 s"), (150, "2 min"), (9000, "2.5 h")])
def test_what_is_left_is_said_in_its_unit(seconds, said):
    """A failure means that who waits for a campaign is told minutes for seconds."""
    assert duration(seconds) == said
