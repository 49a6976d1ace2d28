"""`track VIDEO --force FILE` as typed, on the bundled recordings."""

import json
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from vision.command.main import run

pytestmark = pytest.mark.usefixtures("without_pictures")

PAPER = Path(__file__).parents[2] / "fixtures" / "paper"
VIDEO = [
    str(PAPER / "video.avi"),
    "--timestamps",
    str(PAPER / "timestamps.txt"),
    "--pixel-size",
    "10",
    "--out",
    "run",
]
FORCE = ["--force", str(PAPER / "force.txt"), "--d0", "13"]


@pytest.fixture(scope="module")
def truth():
    with xr.open_dataset(PAPER / "truth.nc", engine="h5netcdf") as data:
        return data.load()


@pytest.fixture(scope="module")
def known(truth, tmp_path_factory):
    """The run with the offset known: its folder, and what it said."""
    folder, said = tmp_path_factory.mktemp("known") / "run", StringIO()
    with redirect_stdout(said):
        assert run([*VIDEO[:-1], str(folder), *FORCE, "--offset", str(truth.attrs["offset_s"])]) == 0
    return folder, said.getvalue()


def test_with_the_offset_known_ratios_and_shells_are_those_of_the_truth(truth, known):
    """A failure means that the tables of the publication's main result are wrong or missing."""
    folder, said = known
    table = pd.read_csv(folder / "deformation.csv")
    columns = (
        "event,index,side,n,sigma_x_um,sigma_x_corrected_um,sweep_um,stick_length_um,ratio,ratio_err,p_stiff"
    )
    assert list(table.columns[:12]) == [*columns.split(","), "shell"]
    events = pd.read_csv(folder / "events.csv")
    first = "event,t_v_s,t_p_s,d_v_mm,d_p_mm,F_v_N,F_p_N,dF_N,stick_length_um,slip_length_um,K_N_per_mm"
    assert list(events.columns[:12]) == [*first.split(","), "K_err_N_per_mm"]
    start = events.set_index("event")["t_v_s"][table["event"].unique()].to_numpy()
    same = np.abs(start[:, None] - truth["t_v_s"].values).argmin(axis=1)
    ratio = table.pivot_table(index="event", columns="index", values="ratio", dropna=False).to_numpy()
    assert np.nanmedian(np.abs(ratio - truth["ratio"].values[same])) < 0.01
    shells = pd.read_csv(folder / "shells.csv")
    named = "event,d_v_mm,side,stiff_sheets,stiff_low,stiff_high,M_eff_model"
    assert list(shells.columns[:7]) == named.split(",")
    assert (shells["stiff_sheets"] - shells["M_eff_model"]).abs().max() < 2
    clock = json.loads((folder / "clock.json").read_text())
    promised = {
        "offset_s",
        "drift_ppm",
        "residual_ms",
        "matched",
        "unmatched_video",
        "unmatched_force",
        "margin",
    }
    assert promised <= set(clock) and clock["status"] == "given"
    assert clock["offset_s"] == pytest.approx(truth.attrs["offset_s"])
    assert "shells     13 (13 to 13) sheets per side" in said


def test_few_slips_are_called_ambiguous_and_nothing_is_guessed(capsys):
    """A failure means that a clock shifted by an event could pass for the right one."""
    assert run([*VIDEO, *FORCE]) == 1
    assert "ambiguous" in capsys.readouterr().err
    assert json.loads(Path("run/clock.json").read_text())["status"] == "ambiguous"
    assert not Path("run/deformation.csv").exists()
    assert len(pd.read_csv("run/tracks.csv")) == 300 * 50


def test_a_clock_at_which_no_slip_coincides_gives_no_shells(truth, capsys):
    """A failure means confident shells from frames cut half a second beside the stick phases."""
    assert run([*VIDEO, *FORCE, "--offset", str(truth.attrs["offset_s"] + 0.5)]) == 2
    assert not Path("run/shells.csv").exists()
    assert Path("run/tracks.csv").exists()
    said = capsys.readouterr()
    assert "slips that coincide" in said.err
    assert "nan" not in said.out


def test_common_motion_is_taken_off_unless_told_otherwise(truth, known):
    """A failure means that --common-mode does nothing, or that run.json does not say it was off."""
    offset = ("--offset", str(truth.attrs["offset_s"]))
    assert run([*VIDEO, *FORCE, *offset, "--common-mode", "off"]) in (0, 1)
    runs = (known[0], Path("run"))
    ratios = [pd.read_csv(folder / "deformation.csv")["ratio"].to_numpy() for folder in runs]
    assert json.loads((known[0] / "run.json").read_text())["parameters"]["common_mode"]["value"] == "on"
    assert json.loads(Path("run/run.json").read_text())["parameters"]["common_mode"]["value"] == "off"
    assert np.nanmax(np.abs(ratios[0] - ratios[1])) > 1e-6


def test_a_stage_without_its_input_keeps_the_tracks(truth, capsys):
    """A failure means that an hour of tracking is thrown away for an option that was left out."""
    at = VIDEO.index("--pixel-size")
    film = VIDEO[:at] + VIDEO[at + 2 :]
    assert run([*film, *FORCE, "--offset", str(truth.attrs["offset_s"])]) == 2
    assert "earlier results are in run" in capsys.readouterr().err
    assert Path("run/tracks.csv").exists()
    assert Path("run/events.csv").exists()
    assert json.loads(Path("run/run.json").read_text())["not_measured"]["motion"]


def test_an_offset_outside_the_recording_is_said_before_the_work(capsys):
    """A failure means that a wrong offset is noticed only after the video was read."""
    assert run([*VIDEO, *FORCE, "--offset", "100000"]) == 2
    said = capsys.readouterr().err
    assert "--offset: expected a video within the force recording" in said
    assert said.count("\n") == 1
    assert not Path("run").exists()


def test_a_recording_that_cannot_be_read_is_said_before_the_work(capsys):
    """A failure means that a wrong file is noticed only after the video was read."""
    assert run([*VIDEO, "--force", str(PAPER / "truth.nc")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not Path("run").exists()


def test_a_video_with_more_ridges_than_sheets_says_so(truth, capsys):
    """A failure means that a sample of 30 sheets is fitted as one of 20, or as the assumed 25, in silence."""
    options = ("--offset", str(truth.attrs["offset_s"]), "--frames", "0:120", "--overwrite")
    assert run([*VIDEO, *FORCE, *options, "--sheets-per-block", "20"]) == 1
    said = capsys.readouterr()
    assert "20 sheets per block and side given, but n reaches 25: check --sheets-per-block" in said.err
    # The sizes that were not given are assumed, and must not go without a word.
    assert "M = 20 sheets of 0.1 x 45 x 57 mm (the publication's where not given)" in said.out
    assert run([*VIDEO, *FORCE, *options, "--axis", "800"]) == 1
    said = capsys.readouterr()
    assert "25 sheets per block and side assumed, but n reaches 33" in said.err
    assert "assumed: the publication's, M = 25" in said.out
    assert "the video shows 33 per side" in said.out
