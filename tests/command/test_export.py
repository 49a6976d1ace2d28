"""`track export` as typed, on a run made by `track`."""

import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.scenes.comb_video import positions, write_video
from vision.command.main import run

pytestmark = pytest.mark.usefixtures("without_pictures")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made")
    video = write_video(folder / "comb.tif")
    target = folder / "comb_tracks"
    assert run([str(video), "--fps", "20", "--pixel-size", "10", "--quiet", "--out", str(target)]) == 0
    return target


@pytest.fixture
def there(made, tmp_path):
    shutil.copytree(made, tmp_path / "comb_tracks")
    return tmp_path


WRITTEN = {
    "csv": "comb_tracks_csv",
    "parquet": "comb_tracks_parquet",
    "xlsx": "comb_tracks.xlsx",
    "mat": "comb_tracks.mat",
    "trackpy": "comb_tracks_trackpy.csv",
    "napari": "comb_tracks_napari.csv",
}


@pytest.mark.parametrize("to", WRITTEN)
def test_every_format_of_a_real_run_is_written_and_named(there, to, capsys):
    """A failure means that a promised format does not work on what `track` writes."""
    assert run(["export", "comb_tracks", "--to", to]) == 0
    said = capsys.readouterr()
    assert WRITTEN[to] in said.out
    assert said.err == ""
    assert {p.name for p in there.iterdir()} == {"comb_tracks", WRITTEN[to]}


def test_the_truth_comes_out_in_µm(there):
    """A failure means that exported positions are not those of the sheets."""
    assert run(["export", "comb_tracks", "--to", "csv", "--quiet", "--out", "wide"]) == 0
    wide = pd.read_csv("wide/positions.csv")
    truth = positions()
    np.testing.assert_allclose(wide.filter(like="_um"), 10 * truth, atol=0.5)
    np.testing.assert_allclose(wide["right_4_um"], 10 * truth[:, 7], atol=0.5)
    assert np.abs(wide["right_3_um"] - 10 * truth[:, 7]).min() > 100


BAD = {
    "no such run": (["nothing", "--to", "csv"], "nothing"),
    "a folder that is no run": (["empty", "--to", "csv"], "run.json"),
    "unknown format": (["comb_tracks", "--to", "spss"], "spss"),
    "no format": (["comb_tracks"], "--to"),
    "inside the run": (["comb_tracks", "--to", "mat", "--out", "comb_tracks/x.mat"], "outside the run"),
    "a file in the way": (["comb_tracks", "--to", "mat", "--out", "note.txt"], "--overwrite"),
    "a folder in the way": (["comb_tracks", "--to", "mat", "--out", "empty", "--overwrite"], "a folder"),
    "a file where a folder goes": (["comb_tracks", "--to", "csv", "--out", "note.txt/x"], "note.txt"),
    "damaged tracks": (["broken", "--to", "mat"], "tracks.nc"),
    "damaged events": (["odd", "--to", "mat"], "events.csv"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_ends_in_one_line_and_status_2(case, there, refused):
    """A failure means a traceback, a silent guess or half a result for bad input."""
    (there / "empty").mkdir()
    (there / "note.txt").write_text("years of work")
    for name in ("broken", "odd"):
        shutil.copytree("comb_tracks", name)
    Path("broken/tracks.nc").write_bytes(b"\x89HDF cut")
    Path("odd/events.csv").write_bytes(b"")
    arguments, named = BAD[case]
    assert named in refused("export", *arguments)


def test_a_workbook_has_its_suffix(there):
    """A failure means a file that no spreadsheet program opens with a double click."""
    assert run(["export", "comb_tracks", "--to", "xlsx", "--out", "exp_xlsx", "--quiet"]) == 0
    assert (there / "exp_xlsx.xlsx").is_file()
    assert not (there / "exp_xlsx").exists()


def test_figures_are_drawn_as_wide_as_a_column(there, refused):
    """A failure means that a manuscript's figures have to be drawn again by hand."""
    wide = ["--to", "svg", "--width", "86mm", "--font-size", "8", "--out", "column", "--quiet"]
    assert run(["figures", "comb_tracks", "noise", *wide]) == 0
    assert 'width="243.7' in (there / "column" / "noise.svg").read_text(encoding="utf-8")
    assert "--width" in refused("figures", "comb_tracks", "--width", "300px", "--out", "a")
    assert "--width" in refused("figures", "comb_tracks", "--width", "5mm", "--out", "a")
    assert "--font-size" in refused("figures", "comb_tracks", "--font-size", "900", "--out", "a")
    assert not (there / "a").exists()


def test_figures_are_listed_and_a_mistyped_one_is_met_with_the_nearest(there, refused, capsys):
    """A failure means that the user has to guess what a figure shows, or how it is spelled."""
    before = sorted(there.rglob("*"))
    assert run(["figures", "comb_tracks", "--list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    named = dict(line.split(maxsplit=1) for line in lines)
    assert named["noise"] == "Noise of the positions"
    assert "did you mean noise?" in refused("figures", "comb_tracks", "nosie")
    assert sorted(there.rglob("*")) == before


def test_figures_as_csv_have_units_and_numbers(there, capsys):
    """A failure means columns of an unknown unit, or an empty file for a figure of images."""
    assert run(["figures", "comb_tracks", "--to", "csv", "--out", "numbers"]) == 0
    said = capsys.readouterr().out
    files = {file.stem: pd.read_csv(file) for file in (there / "numbers").iterdir()}
    assert all(table.size for table in files.values())
    assert "from frame to frame: noise of x (µm)" in files["noise"]
    assert "images without numbers: single_sheets" in said and "single_sheets" not in files
