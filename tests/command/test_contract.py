"""What scripts outside the project rely on and no other test holds: names, defaults, columns, coordinates."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from tests.scenes.comb_video import frames_of, positions, write_video
from vision.command.main import make_app, run
from vision.sheets.identities import WHYS
from vision.sheets.recovery import FLAGS

pytestmark = pytest.mark.usefixtures("without_pictures")

COMMANDS = "kymograph export force simulate preview certify figures compare friction modulus campaign overlay"
OPTIONS = (
    "strip columns sheets ridges axis fit window pixel-size corrections sheets-per-block thickness width "
    "length t-star force-lowpass fps timestamps frames rotate force force-columns speed d0 offset threshold "
    "config out overwrite quiet verbose no-report checksum"
)
DEFAULTS = {
    "strip": "auto",
    "ridges": "auto",
    "fit": "auto",
    "rotate": 0,
    "threshold": 0.1,
    "force_lowpass": "0",
}
DEFAULTS |= {"sheets_per_block": 25, "thickness": 0.1, "width": 45.0, "length": 57.0, "t_star": 0.003}
DEFAULTS |= dict.fromkeys(("columns", "sheets", "axis", "pixel_size", "corrections", "fps", "timestamps"))
DEFAULTS |= dict.fromkeys(("frames", "force", "force_columns", "speed", "d0", "offset"))
WIDTH = (
    171  # the comb is 20 px from the left edge and 10 px from the right: turned the wrong way it is elsewhere
)


@pytest.fixture(scope="module")
def pixels():
    return frames_of(positions(), width_px=WIDTH)


@pytest.fixture(autouse=True)
def film(pixels, tmp_path):
    return write_video(tmp_path / "comb.tif", pixels)


def tracked(*options, film="comb.tif", status=0):
    """tracks.csv of a film with 8 sheets."""
    assert run([film, "--out", "run", "--quiet", "--no-report", *options]) == status
    return pd.read_csv("run/tracks.csv")


def x_px(table):
    return table["x_px"].to_numpy().reshape(-1, table["index"].nunique())


def test_every_promised_command_and_option_is_there(capsys, monkeypatch):
    """A failure means that a line in somebody's script is refused."""
    assert {*COMMANDS.split(), "review"} <= set(make_app())
    monkeypatch.setenv("COLUMNS", "200")
    assert run(["--help"]) == 0
    said = capsys.readouterr().out
    assert [name for name in OPTIONS.split() if f"--{name}" not in said] == []


def test_defaults_and_facts_are_recorded():
    """A failure means that a run without options is another measurement than promised, or that run.json no
    longer says what it was."""
    tracked()
    facts = json.loads(Path("run/run.json").read_text())
    assert {name: facts["parameters"][name]["value"] for name in DEFAULTS} == DEFAULTS
    assert {facts["parameters"][name]["how"] for name in DEFAULTS} == {"default"}
    every = {"out", "overwrite", "resume", "follow", "report", "checksum", "quiet", "verbose", "config"}
    assert every <= set(facts["parameters"])
    assert facts["found"]["window_px"] == 9  # ridges 7 px wide
    assert facts["frames"]["lost"] == 0
    assert facts["command"].startswith("track") and {"sheetvision", "numpy"} <= set(facts["versions"])
    assert facts["warnings"] == [] and facts["seconds"]["total"] > 0
    assert not Path("run/report.html").exists()


def test_every_variable_of_tracks_nc_says_what_it_is():
    """A failure means that a reader of tracks.nc must guess a unit."""
    tracked()
    with xr.open_dataset("run/tracks.nc", engine="h5netcdf") as data:
        assert data.x_px.dims == ("frame", "sheet")
        assert [name for name in data.variables if not data[name].attrs.get("long_name")] == []
        whole = ("frame", "sheet", "index", "side", "n")
        assert [data[name].attrs["units"] for name in whole] == ["1"] * 5
        assert {part.partition(": ")[0] for part in data.flag.meanings.split("; ")} == set(FLAGS)
        assert {part.partition(": ")[0] for part in data.why.meanings.split("; ")} == set(WHYS) - {""}
        measured = [name for name in data.data_vars if data[name].dtype.kind == "f"]
        assert [name for name in measured if not data[name].attrs.get("units")] == []
        units = {name.rpartition("_")[2]: data[name].attrs["units"] for name in measured if "_" in name}
    assert units == {"px": "px"}


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_frames_are_turned_clockwise_before_anything_else(pixels, turns):
    """A failure means that sheets which move along y are measured from the other end of the picture."""
    write_video(Path("turned.tif"), np.rot90(pixels, turns, axes=(1, 2)))  # anticlockwise
    table = tracked("--rotate", str(90 * turns), film="turned.tif")
    np.testing.assert_allclose(x_px(table), positions(), atol=0.05)


def test_positions_and_frames_are_counted_in_the_whole_film():
    """A failure means that x or the time of a part of the film are not those of the whole film."""
    table = tracked("--columns", "30:151", "--frames", "10:50", "--fps", "20")
    np.testing.assert_allclose(x_px(table), positions()[10:50, 1:7], atol=0.05)
    assert table["frame"].tolist() == np.repeat(np.arange(10, 50), 6).tolist()
    np.testing.assert_allclose(table["time_s"], table["frame"] / 20)


def test_a_given_axis_a_window_and_polarity_are_used(pixels):
    """A failure means that a choice is recorded and not made."""
    write_video(Path("dark.tif"), 255 - pixels)
    options = ("--ridges", "dark", "--axis", "51", "--window", "7", "--fit", "paper")
    table = tracked(*options, film="dark.tif", status=1)  # the motion shows another axis, which is said
    np.testing.assert_allclose(x_px(table), positions(), atol=0.2)
    assert table["n"].iloc[:8].tolist() == [2, 1, 1, 2, 3, 4, 5, 6]
    assert table["side"].iloc[:8].tolist() == [-1] * 2 + [1] * 6
    found = json.loads(Path("run/run.json").read_text())["found"]
    assert (found["window_px"], found["ridges"]["polarity"]) == (7, "dark")


def test_the_times_of_a_file_are_the_camera_s():
    """A failure means that x(n,t) is drawn over another clock than the camera's."""
    times = 3 + 0.05 * np.arange(60) + 0.001 * np.arange(60) ** 1.5
    Path("times.txt").write_text("\n".join(f"{time:.6f}" for time in times))
    table = tracked("--timestamps", "times.txt")
    np.testing.assert_allclose(table["time_s"].to_numpy()[::8], times, atol=1e-6)


@pytest.mark.parametrize(
    ("word", "lines"), [("--quiet", "none"), (None, "ten"), ("--verbose", "more")], ids=str
)
def test_a_summary_goes_to_standard_output_and_nothing_else(word, lines, capsys):
    """A failure means that a script which reads the summary finds progress in it, or --quiet is not."""
    assert run(["comb.tif", "--no-report", *([word] if word else [])]) == 0
    said = capsys.readouterr()
    assert said.err == ""
    count = said.out.count("\n")
    assert {"none": count == 0, "ten": 8 <= count <= 12, "more": count > 12}[lines]
