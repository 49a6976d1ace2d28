"""`track VIDEO` as typed: files, exit status, messages."""

import hashlib
import json
import os
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import tifffile
import xarray as xr

from tests.scenes.comb_video import frames_of, positions, write_video
from vision import pipeline
from vision.command import track
from vision.command.main import run
from vision.files import answered
from vision.run import writing

FILES = {
    "tracks.csv",
    "tracks.nc",
    "sheets.csv",
    "kymograph.tif",
    "kymograph.png",
    "overview.png",
    "report.html",
    "figures.npz",
    "run.json",
}
LINES = ["sheets", "frames", "positions", "noise", "strip", "ridges", "axis", "clock", "scale"]
LINES += ["errors", "results"]


pytestmark = pytest.mark.usefixtures("without_pictures")


@pytest.fixture
def video(tmp_path):
    return write_video(tmp_path / "comb.tif")


def test_the_run_folder_holds_the_truth_in_the_contract_s_columns(video, capsys):
    """A failure means that scripts which read the run folder break, or that its numbers are wrong."""
    assert run([str(video), "--fps", "20", "--pixel-size", "10"]) == 0
    folder = Path("comb_tracks")
    assert {file.name for file in folder.iterdir()} == FILES
    table = pd.read_csv(folder / "tracks.csv")
    assert ",".join(table.columns[:9]) == "frame,time_s,index,side,n,x_px,x_err_px,x_um,flag"
    truth = positions()
    assert len(table) == truth.size
    np.testing.assert_allclose(table["x_px"].to_numpy().reshape(truth.shape), truth, atol=0.05)
    np.testing.assert_allclose(table["x_um"], table["x_px"] * 10, atol=1e-3)
    np.testing.assert_allclose(table["time_s"], table["frame"] / 20)
    assert table["n"].iloc[:8].tolist() == [4, 3, 2, 1, 1, 2, 3, 4]
    assert table["side"].iloc[:8].tolist() == [-1] * 4 + [1] * 4
    sheets = pd.read_csv(folder / "sheets.csv")
    assert ",".join(sheets.columns[:8]) == "index,side,n,x_mean_px,found,fwhm_px,snr,x_noise_px"
    summary = capsys.readouterr().out.splitlines()
    assert [line[:11].strip() for line in summary] == LINES
    assert summary[0].startswith("sheets     8 bright ridges (4 left, 4 right)")


def test_tracks_nc_holds_the_same_as_tracks_csv(video):
    """A failure means that MATLAB or xarray users see other numbers than spreadsheet users."""
    assert run([str(video), "--quiet", "--pixel-size", "10"]) == 0
    table = pd.read_csv("comb_tracks/tracks.csv")
    with xr.open_dataset("comb_tracks/tracks.nc", engine="h5netcdf") as data:
        assert data.x_px.dims == ("frame", "sheet")
        np.testing.assert_allclose(data.x_px.values.ravel(), table.x_px, atol=1e-4)
        np.testing.assert_allclose(data.x_err_px.values.ravel(), table.x_err_px, atol=1e-5)
        np.testing.assert_allclose(data.x_um.values, 10 * data.x_px.values)
        assert (data.x_px.attrs["units"], data.x_um.attrs["units"]) == ("px", "um")
        assert data.x_px.attrs["long_name"]
        assert (data.flag.astype(str).values == "ok").all()
        assert data.attrs["fit"] == "sliding"


def test_kymograph_tif_opens_calibrated(video):
    """A failure means that Fiji would show wrong micrometres or seconds."""
    assert run([str(video), "--quiet", "--fps", "20", "--pixel-size", "10"]) == 0
    with tifffile.TiffFile("comb_tracks/kymograph.tif") as file:
        assert file.pages[0].shape == (60, 180)
        facts = file.imagej_metadata
        tags = file.pages[0].tags
        assert facts["unit"] == "micron"
        assert facts["yunit"] == "sec"
        assert np.divide(*tags["XResolution"].value) == pytest.approx(0.1)
        assert np.divide(*tags["YResolution"].value) == pytest.approx(20)


def test_the_seconds_of_run_json_are_all_of_them(video, monkeypatch):
    """A failure means that a run that takes long does not say where its time went."""
    now_s, read = [100.0], pipeline.strip_profile

    def reading(*arguments, **options):
        now_s[0] += 20
        return read(*arguments, **options)

    def reporting(*_, **__):
        now_s[0] += 3

    monkeypatch.setattr(pipeline, "strip_profile", reading)
    monkeypatch.setattr(writing, "write_report", reporting)
    monkeypatch.setattr(time, "perf_counter", lambda: now_s[0])  # a clock that only these two move
    assert run([str(video), "--quiet"]) == 0
    seconds = json.loads(Path("comb_tracks/run.json").read_text())["seconds"]
    assert seconds.pop("total") == 23
    assert seconds.pop("pictures and report") == 3
    assert sum(seconds.values()) == max(seconds.values()) == 20


def test_run_json_says_what_was_given_and_what_was_found(video):
    """A failure means that a run cannot be traced back or repeated."""
    assert run([str(video), "--quiet", "--sheets", "8"]) == 0
    facts = json.loads(Path("comb_tracks/run.json").read_text())
    assert facts["parameters"]["sheets"] == {"value": 8, "how": "given"}
    assert facts["parameters"]["fit"] == {"value": "auto", "how": "default"}
    assert facts["found"]["ridges"]["polarity"] == "bright"
    assert facts["found"]["window_px"] == 9
    assert facts["frames"]["expected"] == facts["frames"]["read"] == 60
    assert len(facts["inputs"][0]["sha256"]) == 64
    assert facts["inputs"][0]["size_bytes"] == video.stat().st_size
    assert {"numpy", "sheetvision", "python"} <= set(facts["versions"])


def test_options_come_from_a_toml_file_and_the_command_line_wins(video, tmp_path):
    """A failure means that a campaign's settings are not what its file says."""
    (tmp_path / "run.toml").write_text("pixel-size = 5.0\nfps = 40\n")
    assert run([str(video), "--quiet", "--config", "run.toml", "--fps", "20"]) == 0
    parameters = json.loads(Path("comb_tracks/run.json").read_text())["parameters"]
    assert parameters["pixel_size"] == {"value": 5.0, "how": "config"}
    assert parameters["fps"] == {"value": 20.0, "how": "given"}


def test_a_blank_frame_is_flagged_and_sets_the_exit_status(tmp_path, capsys):
    """A failure means that a lost frame goes unnoticed."""
    pixels = frames_of(positions())
    pixels[30] = 255
    write_video(tmp_path / "blank.tif", pixels)
    assert run(["blank.tif", "--quiet"]) == 1
    assert "1 frame blank" in capsys.readouterr().err
    table = pd.read_csv("blank_tracks/tracks.csv")
    gone = table[table.frame == 30]
    assert (gone.flag == "blank").all()
    assert gone.x_px.isna().all()
    assert (table[table.frame != 30].flag == "ok").all()


def test_an_earlier_run_is_kept_unless_told_otherwise(video, refused):
    """A failure means that results are overwritten."""
    assert run([str(video), "--quiet"]) == 0
    stamp = Path("comb_tracks/run.json").read_bytes()
    assert "--overwrite" in refused(str(video), "--quiet", "--sheets", "8")
    assert Path("comb_tracks/run.json").read_bytes() == stamp
    assert run([str(video), "--quiet", "--sheets", "99", "--overwrite"]) == 2
    assert Path("comb_tracks/run.json").read_bytes() == stamp
    assert run([str(video), "--quiet", "--sheets", "8", "--overwrite"]) == 0
    assert Path("comb_tracks/run.json").read_bytes() != stamp


def test_a_finished_run_is_not_resumed(video, refused):
    """A failure means that the user is told to give another folder, and not that the run is complete."""
    assert run([str(video), "--quiet", "--resume"]) == 0  # nothing is stored: it starts at the first frame
    said = refused(str(video), "--resume")
    assert "comb_tracks: expected an interrupted run to resume; found one that is finished" in said
    assert "give --overwrite" in said
    assert run([str(video), "--quiet", "--resume", "--overwrite"]) == 0


def test_a_new_run_keeps_the_user_s_files_and_decisions(video, tmp_path, capsys):
    """A failure means that --overwrite takes a notebook, or hours of review, without a word."""
    decisions = tmp_path / "mine.toml"
    decisions.write_text('[[leave_out]]\nsheet = 2\nframes = "3:5"\n')
    assert run([str(video), "--quiet", "--corrections", str(decisions)]) in (0, 1)
    folder, current = Path("comb_tracks"), Path("comb_tracks/corrections.toml")
    Path(folder, "notes.txt").write_text("seen")
    Path(folder, "plots").mkdir()
    Path(folder, "plots", "one.svg").write_text("<svg/>")
    assert run([str(video), "--quiet", "--overwrite"]) == 1
    (kept,) = folder.glob("corrections_*.toml")
    assert str(kept) in capsys.readouterr().err and not current.exists()
    assert Path(folder, "notes.txt").read_text() == "seen"
    assert Path(folder, "plots", "one.svg").read_text() == "<svg/>"
    for _ in range(2):  # all are applied again: nothing is set aside
        assert run([str(video), "--quiet", "--overwrite", "--corrections", str(decisions)]) in (0, 1)
        assert "not applied" not in capsys.readouterr().err
        assert current.exists() and list(folder.glob("corrections_*.toml")) == [kept]


def test_the_checkout_s_cli_runs_as_a_process(video):
    """A failure means that `python cli.py` or its exit status is broken, or pictures empty."""
    root = Path(__file__).parents[2]
    done = subprocess.run(
        [sys.executable, str(root / "cli.py"), str(video)],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": str(root)},
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert done.stdout.count("\n") == len(LINES)
    sizes = {file.name: file.stat().st_size for file in Path("comb_tracks").iterdir()}
    assert min(sizes[name] for name in ("overview.png", "kymograph.png", "report.html")) > 10_000


def test_every_file_that_was_read_is_in_run_json(video):
    """A failure means that options, times or decisions may change and the run still looks repeatable. The
    film stands first and the force last, where a review looks for them."""
    Path("times.txt").write_text("".join(f"{k / 20}\n" for k in range(60)), encoding="utf-8")
    Path("run.toml").write_text("sheets = 8\n", encoding="utf-8")
    Path("hand.toml").write_text("[[axis]]\nx_px = 90.0\n", encoding="utf-8")
    force = Path(__file__).parents[2] / "fixtures" / "paper" / "force.txt"
    given = ["--timestamps", "times.txt", "--config", "run.toml", "--corrections", "hand.toml"]
    run([str(video), "--quiet", "--no-report", *given, "--force", str(force)])
    inputs = json.loads(Path("comb_tracks/run.json").read_text())["inputs"]
    names = [Path(one["path"]).name for one in inputs]
    assert names == [video.name, "times.txt", "run.toml", "hand.toml", "force.txt"]
    assert inputs[2]["size_bytes"] == Path("run.toml").stat().st_size
    window = ["--sheet", "right:1", "--width", "9px", "--timestamps", "times.txt", "--quiet"]
    assert run(["kymograph", str(video), *window, "--corrections", "hand.toml"]) == 0
    inputs = json.loads(Path("comb_kymograph/run.json").read_text())["inputs"]
    assert [Path(one["path"]).name for one in inputs] == [video.name, "times.txt", "hand.toml"]


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (["--d0", "13"], "--d0"),
        (["--speed", "1", "--fix-mu", "0.9"], "--speed, --fix-mu"),
        (["--offset", "3"], "--offset"),
    ],
)
def test_options_of_a_force_that_is_not_given_are_refused(video, refused, options, named):
    """A failure means that they are ignored without a word, and a force that was forgotten is not missed."""
    said = refused(video, *options)
    assert said.startswith(f"track: {named}: ") and "give --force FILE" in said
    Path("run.toml").write_text("d0 = 13\n", encoding="utf-8")  # a file may serve other films, too
    assert run([str(video), "--config", "run.toml", "--quiet", "--no-report"]) == 0


def test_a_checksum_covers_every_byte_of_the_film(video):
    """A failure means that --checksum names another file, or is forgotten."""
    assert run([str(video), "--quiet", "--no-report", "--checksum", "--overwrite"]) == 0
    (film,) = json.loads(Path("comb_tracks/run.json").read_text())["inputs"]
    assert film["sha256"] == hashlib.sha256(video.read_bytes()).hexdigest()


@pytest.mark.thorough
@pytest.mark.parametrize("with_force", [False, True])
def test_a_run_loads_only_what_it_needs(video, with_force):
    """A failure means up to half a second more for every run: libraries that nobody needs."""
    unused = ["scipy.signal", "scipy.stats", "scipy.interpolate", "matplotlib.pyplot"]
    options = [str(video), "--fps", "20"]
    if with_force:
        paper = Path(__file__).parents[2] / "fixtures" / "paper"
        options = [str(paper / "video.avi"), "--timestamps", str(paper / "timestamps.txt")]
        options += ["--force", str(paper / "force.txt"), "--d0", "13", "--pixel-size", "10"]
    else:
        unused += ["scipy.optimize", "av"]
    code = (
        "import sys\n"
        f"from vision.command.main import run; assert run([*{options!r}, '--quiet']) < 2\n"
        f"print([name for name in {unused} if name in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout.strip() == "[]", done.stderr


@pytest.mark.parametrize("others", [(), ("other.avi",)])
def test_a_disk_that_does_not_answer_is_one_line(video, others, monkeypatch, capsys):
    """A failure means that a command typed with a film on a lost mount never comes back."""
    lost, real = threading.Event(), Path.exists
    monkeypatch.setattr(Path, "exists", lambda path: lost.wait(20) if path.name == video.name else real(path))
    monkeypatch.setattr(track, "answered", partial(answered, answer_s=0.2))
    try:
        assert run([str(video), *others]) == 2
    finally:
        lost.set()
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    assert "comb.tif: expected a disk or network that answers; found no answer for 0.2 s" in line
