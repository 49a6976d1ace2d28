"""An analysis from Python as a run folder."""

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st

import vision
from vision.command.main import run
from vision.command.run_folders import OWN_FORCE
from vision.command.settings import options_of, settings_of, settings_of_run
from vision.errors import InputError
from vision.figures.catalogue import figures_of
from vision.folder import RUN_JSON
from vision.pipeline import Settings
from vision.run.reading import read_run
from vision.sample import Sample
from vision.sheets.corrections import correction_of

LATE = Path(__file__).parents[2] / "fixtures" / "late"
GIVEN = Settings(
    rows=slice(0, 30), pixel_size_um=10, timestamps=LATE / "timestamps.txt", d0_mm=16.6, d0_err_mm=0.1
)


def replace_path(file, old, new):
    """Replace a path in a JSON file."""
    old, new = (json.dumps(path)[1:-1] for path in (old, new))
    file.write_text(file.read_text(encoding="utf-8").replace(old, new), encoding="utf-8")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A test of the fixture with a changed constant, and its run folder."""
    tuning = GIVEN.tuning
    tracking = replace(tuning.tracking, standard_widths_px=(5.0, 14.0))
    settings = replace(GIVEN, tuning=replace(tuning, tracking=tracking))
    analysis = vision.analyse(LATE / "video.avi", LATE / "force.txt", settings)
    return analysis, vision.save_run(analysis, tmp_path_factory.mktemp("saved") / "run")


def test_the_folder_has_what_the_command_writes(made, tmp_path, monkeypatch):
    """A failure means that results from a notebook are others than those of the command, or fewer."""
    analysis, folder = made
    monkeypatch.chdir(tmp_path)
    film, force, times = (str(LATE / name) for name in ("video.avi", "force.txt", "timestamps.txt"))
    options = ["--strip", "0:30", "--pixel-size", "10", "--timestamps", times, "--force", force]
    assert run([film, *options, "--d0", "16.6±0.1", "--out", "typed", "--quiet"]) in (0, 1)
    typed = tmp_path / "typed"
    assert {path.name for path in folder.iterdir()} == {path.name for path in typed.iterdir()}
    for name in ("sheets.csv", "events.csv", "deformation.csv", "shells.csv"):
        pd.testing.assert_frame_equal(pd.read_csv(folder / name), pd.read_csv(typed / name))
    ours, theirs = (json.loads((one / RUN_JSON).read_text()) for one in (folder, typed))
    assert ours["inputs"] == theirs["inputs"]
    for name in ("strip", "pixel_size", "timestamps", "d0", "fit", "thickness", "force"):
        assert ours["parameters"][name] == theirs["parameters"][name], name
    np.testing.assert_array_equal(read_run(folder).tracks["x_px"], analysis.tracks["x_px"])


def test_the_settings_are_in_the_folder(made):
    """A failure means that a review measures with other settings, or constants, than the notebook."""
    analysis, folder = made
    assert settings_of_run(folder) == analysis.settings
    assert settings_of_run(folder).tuning.tracking.standard_widths_px == (5.0, 14.0)


def test_other_commands_take_the_folder(made, tmp_path, monkeypatch):
    """A failure means that results from a notebook cannot be looked at, exported or compared."""
    _, folder = made
    monkeypatch.chdir(tmp_path)
    assert run(["overlay", str(folder), "--frames", "0:3", "--quiet"]) == 0
    assert run(["export", str(folder), "--to", "csv", "--quiet"]) == 0
    assert run(["compare", str(folder), "--quiet"]) in (0, 1)


def test_a_force_recording_alone_is_a_run_of_track_force(tmp_path):
    """A failure means that the results of a test without a film cannot be kept."""
    alone = vision.analyse(None, LATE / "force.txt", Settings(d0_mm=16.6, t_star_fitted=True))
    folder = vision.save_run(alone, tmp_path / "run")
    assert (folder / "events.csv").exists()
    assert settings_of_run(folder) == alone.settings
    assert vision.load_run(folder).summary() == alone.summary()
    typed = ["force", str(LATE / "force.txt"), "--d0", "16.6", "--out", str(tmp_path / "typed")]
    assert run([*typed, "--quiet"]) in (0, 1)
    plain = vision.analyse(None, LATE / "force.txt", Settings(d0_mm=16.6))
    assert vision.load_run(tmp_path / "typed").fits.mu == plain.fits.mu


@pytest.mark.parametrize(
    "scale", [["--pixel-size", "10±0.1"], ["--scale", "1±0.01mm=100px"], ["--pitch", "0.2+-0.002mm"]]
)
def test_the_error_of_the_pixel_size_is_in_the_folder(scale, tmp_path, monkeypatch):
    """A failure means that a typed error of the scale is lost in run.json, in a review or in a notebook."""
    monkeypatch.chdir(tmp_path)
    force = ["--force", str(LATE / "force.txt"), "--d0", "16.6", "--timestamps", str(LATE / "timestamps.txt")]
    assert run([str(LATE / "video.avi"), *force, *scale, "--strip", "0:30", "--out", "typed", "--quiet"]) == 0
    facts = json.loads(Path("typed", RUN_JSON).read_text())
    ratio = facts["systematic_errors"]["ratio"]
    assert ratio["sources"]["pixel_size"] == pytest.approx(0.01 * ratio["value"])
    loaded = vision.load_run("typed")
    assert " ± 0.1" in next(line for line in loaded.summary() if line.startswith("scale"))
    assert loaded.pixel_size_err_um == pytest.approx(0.01 * loaded.pixel_size_um)
    assert loaded.settings == vision.load_run(vision.save_run(loaded, "saved")).settings


def test_a_run_is_loaded_as_it_was_saved(made):
    """A failure means that last week's run has other numbers in a notebook, or lacks a figure."""
    analysis, folder = made
    again = vision.load_run(folder)
    np.testing.assert_array_equal(again.tracks["x_px"], analysis.tracks["x_px"])
    assert set(again.tracks.variables) == set(analysis.tracks.variables)  # x_um of another scale would stay
    np.testing.assert_allclose(again.motion["ratio"], analysis.motion["ratio"], rtol=1e-9)
    pd.testing.assert_frame_equal(again.shells, analysis.shells)
    assert again.clock == analysis.clock
    assert again.fits.mu == analysis.fits.mu
    assert again.warnings == analysis.warnings
    assert again.summary() == analysis.summary()
    assert {f.name for f in figures_of(again)} == {f.name for f in figures_of(analysis)}


def test_corrections_of_a_run_are_in_what_is_loaded(tmp_path):
    """A failure means that a sheet that was left out by hand is back."""
    cut = replace(GIVEN, corrections=(correction_of("leave_out", {"sheet": 3, "frames": "5:9"}),))
    folder = vision.save_run(vision.analyse(LATE / "video.avi", None, cut), tmp_path / "run")
    again = vision.load_run(folder)
    assert again.settings.corrections == cut.corrections
    assert (again.tracks["flag"][5:9, 3] == "left_out").all()


def test_moved_files_are_said_or_found(made, tmp_path):
    """A failure means results without a force recording and without a word, or those of another one."""
    _, folder = made
    for name in ("video.avi", "force.txt", "timestamps.txt"):
        shutil.copy(LATE / name, tmp_path)
    shutil.copytree(folder, tmp_path / "run")
    replace_path(tmp_path / "run" / RUN_JSON, str(LATE), str(tmp_path))
    (tmp_path / "force.txt").rename(tmp_path / "moved.txt")
    with pytest.raises(InputError, match="force"):
        vision.load_run(tmp_path / "run")
    assert len(vision.load_run(tmp_path / "run", force=tmp_path / "moved.txt").sticks)
    with pytest.raises(InputError, match=r"bytes|same size"):
        vision.load_run(tmp_path / "run", film=tmp_path / "moved.txt")
    (tmp_path / "video.avi").unlink()
    assert vision.load_run(tmp_path / "run", force=tmp_path / "moved.txt").frame is None


@pytest.mark.parametrize("old", ["/media/old/films/late/", "D:\\films\\late\\"])
def test_run_and_films_that_were_moved_together_are_found(old, made, tmp_path):
    """A failure means that a campaign on a disk with another path cannot be corrected or loaded any more."""
    _, folder = made
    shutil.copytree(LATE, tmp_path / "new" / "films" / "late")
    shutil.copytree(folder, tmp_path / "new" / "series" / "runs" / "late")
    moved = tmp_path / "new" / "series" / "runs" / "late" / RUN_JSON
    replace_path(moved, f"{LATE}{os.sep}", old)
    again = vision.load_run(moved.parent)
    assert again.video.path == tmp_path / "new" / "films" / "late" / "video.avi"
    assert len(again.sticks)
    assert again.settings.timestamps == tmp_path / "new" / "films" / "late" / "timestamps.txt"


def test_files_are_named_by_text_as_well(tmp_path):
    """A failure means that a notebook's analysis cannot be saved, for a reason that nobody understands."""
    (tmp_path / "c.toml").write_text('[[leave_out]]\nsheet = 3\nframes = "5:9"\n')
    texts = {"timestamps": str(LATE / "timestamps.txt"), "corrections": str(tmp_path / "c.toml")}
    test = vision.analyse(str(LATE / "video.avi"), str(LATE / "force.txt"), rows=GIVEN.rows, **texts)
    assert (test.tracks["flag"][5:9, 3] == "left_out").all()
    folder = vision.save_run(test, str(tmp_path / "run"))
    again = vision.load_run(str(folder), force=str(LATE / "force.txt")).settings
    assert again.timestamps == test.settings.timestamps == LATE / "timestamps.txt"
    assert [one.what for one in again.corrections] == [one.what for one in test.settings.corrections]
    for wrong in ([3], ("leave_out",), 3):
        with pytest.raises(InputError, match="`corrections`: expected the path of a file"):
            Settings(corrections=wrong)


def test_an_earlier_run_stays_and_what_is_no_analysis_is_refused(made, tmp_path):
    """A failure means lost results, or a traceback."""
    analysis, folder = made
    with pytest.raises(InputError, match="overwrite"):
        vision.save_run(analysis, folder)
    with pytest.raises(InputError, match="what `analyse` returned"):
        vision.save_run(analysis.tracks, tmp_path / "other")
    assert not (tmp_path / "other").exists()


def sizes(low, high):
    """Finite numbers in a range, or None."""
    return st.none() | st.floats(low, high)


@pytest.mark.parametrize("change", ["arrays", "zero", "nothing"])
def test_a_force_that_no_file_holds_is_in_the_folder(tmp_path, change):
    """A failure means that what a notebook measured is lost when it is saved, or is that of the file."""
    force = vision.read_force(LATE / "force.txt", d0_mm=16.6, d0_err_mm=0.1)
    if change == "arrays":  # those of the machine, without its file
        named = {name: ("time_s", force[name].values) for name in ("load_N", "d_mm")}
        attrs = {"d0_err_mm": 0.1}
        force = xr.Dataset(named, coords={"time_s": force["time_s"].values}, attrs=attrs)
    elif change == "zero":
        force = force.assign(load_N=force["load_N"] - 1.5)
    made = vision.analyse(None, force)
    folder = vision.save_run(made, tmp_path / "run").rename(tmp_path / "moved")
    assert (folder / OWN_FORCE).exists() == (change != "nothing")
    again = vision.load_run(folder)
    pd.testing.assert_frame_equal(again.sticks, made.sticks)
    assert again.fits.mu == made.fits.mu
    assert vision.load_run(vision.save_run(again, folder, overwrite=True)).fits.mu == made.fits.mu


def test_a_film_that_was_opened_is_read_again_as_it_was(tmp_path):
    """A failure means that another strip of the run has another clock, or other frames."""
    film = vision.open_video(LATE / "video.avi", fps=60, frames=slice(20, 90))
    folder = vision.save_run(vision.analyse(film), tmp_path / "run")
    assert run([str(folder), "--strip", "2:28", "--out", str(tmp_path / "again"), "--quiet"]) in (0, 1)
    before, after = (pd.read_csv(one / "tracks.csv") for one in (folder, tmp_path / "again"))
    for name in ("frame", "time_s"):
        np.testing.assert_array_equal(before[name], after[name])


@given(
    rows=st.none() | st.builds(slice, st.none() | st.integers(0, 50), st.integers(51, 200)),
    frames=st.none() | st.builds(slice, st.integers(0, 50), st.none()),
    window_px=st.sampled_from([None, "auto", 9, 21]),
    lowpass=st.sampled_from([0.0, "auto", 0.0123]),
    axis_px=sizes(-10, 5000),
    pixel_size_um=sizes(0.01, 1000),
    pitch_um=sizes(1, 1000),
    scale_err=sizes(0, 1),
    d0=sizes(0, 100),
    d0_err=sizes(0, 1),
    fit_range_mm=st.none() | st.just((13.25, 17.0)),
    length_err=sizes(0.01, 1),
    thickness=st.none() | st.floats(0.01, 1),
    force_columns=st.none() | st.just({"time": "Time", "load": "Load, F:kN"}),
    common_mode=st.booleans(),
    rotate=st.sampled_from([0, 90]),
)
def test_settings_come_back_from_their_options(
    lowpass, d0, d0_err, length_err, thickness, pixel_size_um, pitch_um, scale_err, **rest
):
    """A failure means a setting that a run from Python forgets or changes."""
    if scale_err is not None:
        scale_err *= pitch_um or pixel_size_um or 1.0
    settings = Settings(
        force_lowpass_s=lowpass,
        d0_mm=d0,
        d0_err_mm=None if d0 is None or d0_err is None else d0_err * d0,
        sample=None if thickness is None else Sample(thickness_mm=thickness, length_mm=60.0),
        geometry_err={} if thickness is None or length_err is None else {"length_mm": length_err},
        pixel_size_um=pixel_size_um if pitch_um is None else None,
        pixel_size_err_um=scale_err if pitch_um is None and pixel_size_um is not None else None,
        pitch_um=pitch_um,
        pitch_err_um=None if pitch_um is None else scale_err,
        **rest,
    )
    again = settings_of(options_of(settings))
    assert again == settings
