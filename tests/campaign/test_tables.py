"""The tables of all tests: partitioned, of one schema, opened lazily."""

import os

import numpy as np
import pandas as pd
import pyarrow.compute as pc
import pyarrow.dataset as ds
import pyarrow.parquet as pq
import pytest

import vision
from tests.campaign.scenes import films
from vision.campaign.tables import as_arrow, close_tables, open_tables, write_partitions, write_tests
from vision.errors import InputError


@pytest.fixture(scope="module")
def analyses(tmp_path_factory):
    """Of two films: one in µm, the other in px only."""
    paths = films(tmp_path_factory.mktemp("films"), 2)
    return [
        vision.analyse(path, settings=vision.pipeline.Settings(fps=20.0, pixel_size_um=size))
        for path, size in zip(paths, (10.0, None), strict=True)
    ]


def test_each_film_is_a_partition_and_all_are_one_table(tmp_path, analyses):
    """A failure means that rows of one test stand under another's name, or that types differ."""
    names = ["old 1", "50% RH/é"]
    for name, analysis in zip(names, analyses, strict=True):
        write_partitions(tmp_path, name, analysis)
    write_tests(tmp_path, {names[0]: {"sample": "a", "n": 1.0}, names[1]: {"sample": None, "n": np.nan}})
    close_tables(tmp_path, names)
    positions = open_tables(tmp_path, "positions")
    for name, analysis in zip(names, analyses, strict=True):
        table = positions.to_table(filter=ds.field("film") == name).to_pandas()
        assert len(table) == 240
        np.testing.assert_allclose(table["x_px"], analysis.tracks["x_px"].values.ravel(), atol=1e-4)
        assert table["x_um"].notna().all() == (analysis.pixel_size_um is not None)
    tests = open_tables(tmp_path, "tests").to_table().to_pandas().set_index("film")
    assert tests.loc[names[0], "sample"] == "a"
    assert pd.isna(tests.loc[names[1], "sample"])
    assert open_tables(tmp_path, "sheets").count_rows() == 16
    close_tables(tmp_path, names[:1])  # the other film is no longer in the table
    assert open_tables(tmp_path, "positions").count_rows() == 240
    with pytest.raises(InputError, match="tables of a campaign"):
        open_tables(tmp_path, "sticks")
    with pytest.raises(InputError, match="one of tests, sheets"):
        open_tables(tmp_path, "nothing")


def test_other_programs_read_the_folder_as_one_table(tmp_path, analyses):
    """As pandas does, which knows nothing of campaigns."""
    for name, analysis in zip("ab", analyses, strict=True):
        write_partitions(tmp_path, name, analysis)
    close_tables(tmp_path, "ab")
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
        os.link(part if "film=t42/" in str(other) else others[0], other)
    close_tables(tmp_path, [f"t{k}" for k in range(100)])
    table = open_tables(tmp_path, "positions")
    assert table.count_rows() == 100 * rows
    one = table.to_table(columns=["x_px"], filter=(ds.field("film") == "t42") & (ds.field("frame") < 10))
    assert pc.sum(one["x_px"]).as_py() == 45
    with pytest.raises(OSError):
        table.to_table(columns=["x_px"])
