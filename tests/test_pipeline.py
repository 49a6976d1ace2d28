"""analyse(): every stage once, in order, and nothing lost where one of them fails."""

import dataclasses
import html
import json
import re
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import tifffile
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import vision
from tests.force.test_signal import rung
from tests.scenes.combs import comb, ridges, strip
from vision import pipeline
from vision.checks import tracking_warnings
from vision.command.main import run
from vision.data import TrackMetadata, operations_of, warnings_of
from vision.errors import InputError
from vision.pipeline import Settings
from vision.run import provenance, writing
from vision.sheets.corrections import correction_of

DEEP = Path(__file__).parents[1] / "fixtures" / "deep"
ARGUMENTS = (
    *(str(DEEP / "video.tif"), "--timestamps", str(DEEP / "timestamps.txt")),
    *("--force", str(DEEP / "force.txt"), "--d0", "13", "--quiet", "--out"),
)


@pytest.fixture(scope="module")
def whole():
    settings = Settings(d0_mm=13, pixel_size_um=10, timestamps=DEEP / "timestamps.txt")
    return vision.analyse(DEEP / "video.tif", DEEP / "force.txt", settings)


def test_every_stage_is_there_or_has_its_reason(whole):
    """A failure means that a part of the analysis is missing without a word."""
    for name in ("strip", "tracks", "frame", "force", "sticks", "fits"):
        assert getattr(whole, name) is not None, name
    for name in ("clock", "motion", "shells"):
        assert (getattr(whole, name) is not None) or whole.reasons or whole.clock.status == "ambiguous"
    assert {"reading", "tracking", "sticks"} <= set(whole.seconds)
    assert whole.failures == {}


def test_each_operation_is_recorded_with_its_parameters(whole):
    """A failure means that a dataset does not say how it was made."""
    done = [step["operation"] for step in operations_of(whole.tracks)]
    assert done == ["strip_profile", "track_sheets"]
    assert "fit" in operations_of(whole.tracks)[-1]["parameters"]


def test_datasets_can_be_written_by_xarray_and_used_again(whole, tmp_path):
    """A failure means that xarray refuses a dataset, or that a stage refuses one that xarray wrote."""

    def again(data):
        data.to_netcdf(tmp_path / "data.nc")
        load = xr.load_dataset if isinstance(data, xr.Dataset) else xr.load_dataarray
        return load(tmp_path / "data.nc")

    one, two = "a warning that stands alone", "another, of σ_x"
    strip = again(whole.strip.assign_attrs(warnings=[one]))
    tracks = vision.track_sheets(strip)
    xr.testing.assert_equal(tracks, whole.tracks)
    assert warnings_of(tracks) == [one]
    tracks = again(tracks.assign_attrs(warnings=[one, two]))
    sticks = vision.find_stick_slip(again(whole.force))
    pd.testing.assert_frame_equal(sticks, whole.sticks)
    offset_s = float(xr.load_dataset(DEEP / "truth.nc").attrs["offset_s"])
    clock = vision.synchronise(tracks, whole.force, sticks, offset_s=offset_s)
    motion = vision.horizontal_deformation(tracks, sticks, clock, pixel_size_um=10)
    assert warnings_of(tracks) == [one, two]
    shells = vision.classify_shells(again(motion))
    pd.testing.assert_frame_equal(shells, vision.classify_shells(motion))
    assert [step["operation"] for step in operations_of(tracks)] == ["strip_profile", "track_sheets"]


@pytest.mark.parametrize("steps", [[], [40], [40, 80]])
def test_lists_among_the_facts_are_lists_again(whole, steps, tmp_path):
    """xarray reads a list as an array, or as its only item. A failure means an error of Python's, or
    positions spelled in single letters, in the warnings about tracks that were stored."""
    wide = [f"{step} px (1.9 pitches)" for step in steps]
    told = whole.tracks.assign_attrs(large_steps=steps, wide_spacings=wide)
    told.to_netcdf(tmp_path / "data.nc")
    again = xr.load_dataset(tmp_path / "data.nc")
    assert (TrackMetadata.of(again).large_steps, TrackMetadata.of(again).wide_spacings) == (steps, wide)
    assert tracking_warnings(again) == tracking_warnings(told)


def test_messages_name_the_settings():
    """A failure means that a line advises an argument that `Settings` does not have."""
    late = DEEP.parent / "late" / "force.txt"
    found = vision.analyse(None, late, Settings(d0_mm=16.6))
    named = set(re.findall(r"`(\w+)`", "\n".join([*found.summary(), *found.warnings])))
    assert "force_lowpass_s" in named
    assert named <= {one.name for one in fields(Settings)}
    with pytest.raises(InputError, match="lower `force_threshold_N` if"):
        vision.analyse(None, late, Settings(d0_mm=16.6, force_threshold_N=1e4))
    lines = vision.analyse(None, rung(10, 0.2, 0.3), Settings()).warnings
    assert any("`force_threshold_N` 10 counts them" in line for line in lines)


def test_a_force_recording_alone_is_an_analysis_too(whole):
    """A failure means that the force alone takes another way than with a video."""
    alone = vision.analyse(None, DEEP / "force.txt", Settings(d0_mm=13))
    assert alone.tracks is None
    assert alone.fits.mu == whole.fits.mu


def test_an_analysis_shows_itself(whole):
    """A failure means that a notebook shows a wall of text, or that a figure takes no axes."""
    assert whole._repr_html_().count("<img") == 1
    for line in whole.summary():  # those that go on with the one before, too
        assert line.partition(" ")[2].strip() in html.unescape(whole._repr_html_())
    assert repr(whole).splitlines() == whole.summary()
    ax = Figure().add_subplot()
    assert whole.plot.tracks(ax) is ax
    assert isinstance(whole.plot.noise(), Axes)
    assert {"tracks", "force", "deformation"} <= set(dir(whole.plot))
    assert "deformation" in repr(whole.plot)  # what a notebook shows
    with pytest.raises(AttributeError, match="no figure"):
        _ = whole.plot.nonsense


def test_a_name_of_two_words_is_one_row_in_a_notebook(whole):
    """A failure means the row "no" for a sheet without a ridge."""
    lost = whole.tracks.copy(deep=True)
    lost["flag"][10:40, 3] = "missing"
    shown = replace(whole, tracks=lost)._repr_html_()
    assert re.search(r">no ridge</th><td[^>]*>for 10 frames or more: ", shown)


def test_a_figure_without_its_data_is_refused_with_the_reason():
    """A failure means an empty picture for what was not measured."""
    alone = vision.analyse(None, DEEP / "force.txt")
    with pytest.raises(InputError, match="deformation"):
        alone.plot.deformation()


def broken(*arguments, **options):
    raise ZeroDivisionError("nobody foresaw this")


@pytest.mark.usefixtures("no_picture")
@pytest.mark.parametrize("name", ["d0_mm", "sheets", "threshold", "window_px", "force_lowpass_s"])
def test_a_text_in_place_of_a_number_is_named(name):
    """A failure means that a number read from a table as text ends in a TypeError far from its cause."""
    with pytest.raises(InputError, match=f"`{name}`: expected .*number.*; found the text '13'"):
        Settings(**{name: "13"})
    assert Settings(window_px="auto", force_lowpass_s="auto").window_px == "auto"


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("pixel_size_um", size) for size in (-1, 1e-5, 1e4)),
        *(
            (name, -1)
            for name in ("fps", "pitch_um", "speed_mm_min", "mu", "modulus_GPa", "strips", "sheets")
        ),
        *((name, -1) for name in ("force_threshold_N", "force_lowpass_s", "machine_stiffness_N_per_mm")),
        *(("threshold", value) for value in (-0.1, 0, 10)),
        *(("window_px", 4), ("rotate", 45), ("ridges", "white"), ("fit", "gauss"), ("sheets", 2.5)),
        *(("rows", (60, 144)), ("columns", "60:144"), ("frames", [0, 5]), ("timestamps", 3)),
        *(("fit_range_mm", (17, 13)), ("fit_range_mm", 13), ("offset_s", float("nan")), ("axis_px", [3])),
        *(("sample", {"thickness_mm": 0.1}), ("tuning", None), ("common_mode", "off"), ("fps", "auto")),
    ],
)
def test_a_setting_out_of_range_is_refused_at_once(name, value):
    """A failure means that a mistyped setting is only noticed after a long film is read, or never."""
    with pytest.raises(InputError, match=f"^`{name}`: expected .*; found "):
        Settings(**{name: value})


def test_an_error_larger_than_its_value_is_refused():
    """A failure means that 10±20 is a separation, or a run from Python that the command refuses."""
    with pytest.raises(InputError, match=r"^`d0_err_mm`: expected at most the value 10; found 20"):
        Settings(d0_mm=10, d0_err_mm=20)
    assert Settings(d0_mm=0, d0_err_mm=0.1).d0_err_mm == 0.1  # the column is the separation


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "`video` and `force`: expected at least one"),
        (("v.avi", Settings()), "`settings` is the third argument"),
        (("v.avi", None, {"pixel_size_um": 10}), "`settings`: expected a `Settings`.*; found the type dict"),
        ((3,), "`video`: expected the path of a video"),
        (("v.avi", 3), "`force`: expected the path of a force recording"),
    ],
)
def test_wrong_arguments_of_an_analysis(arguments, message):
    """A failure means an empty analysis, or a traceback from deep inside."""
    with pytest.raises(InputError, match=message):
        vision.analyse(*arguments)


def test_wrong_arguments_of_single_stages(whole):
    """A failure means a traceback from deep inside in place of the argument's name."""
    tracks, force, sticks = whole.tracks, whole.force, whole.sticks
    film = vision.open_video(DEEP / "video.tif")
    calls = {
        "path": [lambda: vision.open_video(None), lambda: vision.read_force(None)],
        "fps": [lambda: vision.open_video(DEEP / "video.tif", fps="25")],
        "frames": [lambda: vision.open_video(DEEP / "video.tif", frames=(1, 5))],
        "video": [lambda: vision.strip_profile("video.avi")],
        "rows": [lambda: vision.strip_profile(film, (0, 9)), lambda: vision.strip_profile(film, "0:9")],
        "columns": [lambda: vision.read_force(DEEP / "force.txt", columns=["time"])],
        "axis_px": [lambda: vision.track_sheets(whole.strip, axis_px="3")],
        "threshold_N": [lambda: vision.find_stick_slip(force, threshold_N="1")],
        "sticks": [lambda: vision.fit_models(force, None)],
        "sample": [lambda: vision.fit_models(force, sticks, 25)],
        "offset_s": [lambda: vision.synchronise(tracks, force, sticks, offset_s="24")],
        "clock": [lambda: vision.horizontal_deformation(tracks, sticks, 24.0, pixel_size_um=10)],
        "runs": [lambda: vision.compare(None)],
    }
    for name, wrong in calls.items():
        for call in wrong:
            with pytest.raises(InputError, match=f"`{name}`: expected .*; found "):
                call()
    with pytest.raises(InputError, match=r"the tracks: expected what `vision\.track_sheets` returns"):
        vision.horizontal_deformation(tracks.x_px, sticks, None, pixel_size_um=10)


@pytest.mark.parametrize("name", ["d0_mm", "d0_err_mm"])
@pytest.mark.parametrize("value", [-1.0, float("nan")])
def test_a_separation_that_cannot_be_is_refused_at_once(name, value):
    """A failure means that a film is read for an hour before its fits refuse the separation."""
    with pytest.raises(InputError, match=f"`{name}`: expected a number of mm from 0"):
        Settings(**{name: value})


def test_an_unforeseen_error_in_a_late_stage_costs_only_that_stage(monkeypatch, tmp_path, capsys):
    """A failure means that hours of tracking are lost to a defect of the fits."""
    monkeypatch.setattr(pipeline, "fit_models", broken)
    out = tmp_path / "run"
    assert run([*ARGUMENTS, str(out)]) == 3
    assert "failures.txt" in capsys.readouterr().err
    assert "nobody foresaw this" in (out / "failures.txt").read_text()
    assert json.loads((out / "run.json").read_text())["failures"] == ["fits"]
    assert (out / "tracks.csv").stat().st_size > 1000
    assert (out / "events.csv").exists()


@pytest.mark.usefixtures("no_picture")
def test_an_unforeseen_error_in_the_report_costs_no_table(monkeypatch, tmp_path, capsys):
    """A failure means that a picture that cannot be drawn takes the positions with it."""
    monkeypatch.setattr(writing, "write_report", broken)
    out = tmp_path / "run"
    assert run([*ARGUMENTS, str(out)]) == 3
    assert capsys.readouterr().err.count("\n") >= 1
    assert (out / "tracks.csv").stat().st_size > 1000
    assert json.loads((out / "run.json").read_text())["failures"] == ["pictures and report"]


@pytest.mark.usefixtures("no_picture")
def test_a_large_film_has_its_report_too(monkeypatch, tmp_path):
    """A failure means that films too large for a whole checksum end without their page."""
    monkeypatch.setattr(provenance, "PARTS", 2)
    film = Path(__file__).parents[1] / "fixtures" / "paper" / "video.avi"
    out = tmp_path / "run"
    assert run([str(film), "--quiet", "--out", str(out)]) == 0
    digest = json.loads((out / "run.json").read_text())["inputs"][0]["fingerprint"]
    assert digest in (out / "report.html").read_text()


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("kind", "entry", "kept"),
    [
        ("clock", {"offset_s": 12.0}, ("strip", "tracks")),
        ("axis", {"x_px": 300.0}, ("strip",)),
        ("delete", {"sheet": 2}, ("strip",)),
        ("strip", {"rows": "4:16"}, ()),
    ],
)
def test_only_what_follows_from_a_decision_is_run_again(whole, kind, entry, kept):
    """A failure means that a decision waits for hours of reading, or does not reach what it changes."""
    settings = replace(whole.settings, corrections=(correction_of(kind, entry),))
    again = vision.analyse(DEEP / "video.tif", whole.force, settings, earlier=whole)
    assert [name for name in ("strip", "tracks") if getattr(again, name) is getattr(whole, name)] == list(
        kept
    )
    assert ("reading" in again.seconds) == (kind == "strip")
    if kind == "clock":
        assert again.clock is None or (again.clock.status, again.clock.offset_s) == ("given", 12.0)
        assert "clock" in again.reasons or again.clock is not None
    if kind == "strip":
        assert (again.strip.attrs["strip_z0"], again.strip.attrs["strip_z1"]) == (4, 16)
        with pytest.raises(InputError, match="film"):
            vision.analyse(None, whole.force, settings, earlier=whole)
    if kind == "delete":
        assert again.tracks.sizes["sheet"] == whole.tracks.sizes["sheet"] - 1
    if kind == "axis":
        assert again.tracks.attrs["axis_px"] == 300.0


@pytest.mark.parametrize(
    ("changed", "kept"),
    [
        ({"fps": 30.0, "timestamps": None}, ()),
        ({"rows": slice(0, 10)}, ()),
        ({"sheets": 20}, ("strip",)),
        ({"ridges": "dark"}, ("strip",)),
        ({"tuning": pipeline.Tuning(tracking=pipeline.TrackingSettings(window_per_width=0.8))}, ("strip",)),
        ({"offset_s": 12.0}, ("strip", "tracks")),
        ({"d0_mm": 13.5, "pixel_size_um": 9.0}, ("strip", "tracks")),
    ],
)
def test_what_follows_from_a_changed_setting_is_run_again(whole, changed, kept):
    """A failure means results of the earlier settings under the new ones."""
    settings = replace(whole.settings, **changed)
    try:
        again = vision.analyse(DEEP / "video.tif", DEEP / "force.txt", settings, earlier=whole)
    except InputError as error:  # of a number of sheets that the film does not have
        assert "sheets" in changed or "ridges" in changed, error
        return
    assert [name for name in ("strip", "tracks") if getattr(again, name) is getattr(whole, name)] == [*kept]
    if "fps" in changed:
        assert np.diff(again.tracks["time_s"]).mean() == pytest.approx(1 / 30)
    if "pixel_size_um" in changed:
        assert again.pixel_size_um == 9.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class More(Settings):
    """Settings with one that is in no list of what it changes."""

    exposure_s: float = 0.0


def test_a_setting_that_nobody_placed_changes_all_that_was_read(whole):
    """A failure means that a new setting leaves the earlier positions as they were, without a word."""
    earlier = replace(whole, settings=More(**vars(whole.settings)))
    assert vision.analyse(None, whole.force, earlier.settings, earlier=earlier).strip is whole.strip
    with pytest.raises(InputError, match="the film, to be read again for `exposure_s` `rotate`; found"):
        settings = replace(earlier.settings, exposure_s=1.0, rotate=180)
        vision.analyse(None, whole.force, settings, earlier=earlier)


def test_another_film_is_read(whole):
    """A failure means the positions of the earlier film under the name of another."""
    settings = replace(whole.settings, timestamps=None)
    earlier = replace(whole, settings=settings)
    again = vision.analyse(DEEP.parent / "dark" / "video.mp4", None, settings, earlier=earlier)
    assert again.tracks.sizes != whole.tracks.sizes


def test_without_a_change_nothing_is_run_again(whole):
    """Nor is the film needed."""
    again = vision.analyse(None, whole.force, whole.settings, earlier=whole)
    assert again.tracks is whole.tracks
    assert again.strip is whole.strip


def test_a_comb_that_lies_on_its_side_is_said_to(tmp_path):
    """A failure means that a film with the camera turned ends in "no ridges", without how to turn it."""
    picture = strip(ridges(comb(20, per_side=10, axis_px=220), width=440)).values
    lying = np.repeat(np.clip(picture, 0, 255).astype(np.uint8)[:, :, None], 64, axis=2)
    tifffile.imwrite(tmp_path / "lying.tif", lying)
    with pytest.raises(InputError, match=r"found horizontal ridges.*give `rotate` 90"):
        vision.analyse(tmp_path / "lying.tif")
    upright = vision.analyse(tmp_path / "lying.tif", settings=Settings(rotate=90))
    assert upright.tracks.sizes["sheet"] == 20
    tifffile.imwrite(tmp_path / "upright.tif", np.rot90(lying, axes=(1, 2)))
    with pytest.raises(InputError, match=r"found horizontal ridges.*give `rotate` 0"):
        vision.analyse(tmp_path / "upright.tif", settings=Settings(rotate=90))
    noise = np.random.default_rng(1).integers(0, 255, (20, 200, 200), dtype=np.uint8)
    tifffile.imwrite(tmp_path / "noise.tif", noise)
    with pytest.raises(InputError, match="check `rows`"):
        vision.analyse(tmp_path / "noise.tif")


def test_a_saturated_film_is_said_to_be_saturated(tmp_path):
    """A failure means that an overexposed film is said to show nothing above the noise."""
    rng = np.random.default_rng(0)
    grey = np.where(rng.random((20, 40, 200)) < 0.86, 255, rng.integers(100, 250, (20, 40, 200)))
    tifffile.imwrite(tmp_path / "film.tif", grey.astype(np.uint8), photometric="minisblack")
    with pytest.raises(InputError, match=r"found a saturated picture: \d\d % of the pixels"):
        vision.analyse(tmp_path / "film.tif")
    ridged = np.where(np.arange(200) % 20 < 14, 255, 80) - rng.integers(0, 2, (20, 40, 200))
    tifffile.imwrite(tmp_path / "wide.tif", ridged.astype(np.uint8), photometric="minisblack")
    with pytest.raises(InputError, match="a window no wider than the ridges' spacing"):
        vision.analyse(tmp_path / "wide.tif", settings=Settings(window_px=99))


@pytest.mark.parametrize("offset_s", [999.0, -999.0])
def test_an_offset_outside_the_force_is_refused_before_the_film_is_read(offset_s):
    """A failure means that a long film is tracked before a mistyped offset is named."""
    read = []
    settings = Settings(pixel_size_um=10, offset_s=offset_s, timestamps=DEEP / "timestamps.txt")
    with pytest.raises(InputError, match="`offset_s`: expected a video within the force recording"):
        vision.analyse(
            DEEP / "video.tif", DEEP / "force.txt", settings, progress=lambda *done: read.append(done)
        )
    assert not read


@pytest.mark.parametrize(
    "force", [xr.Dataset(), xr.Dataset({"load_N": ("time", [1.0])})], ids=["empty", "load alone"]
)
def test_a_dataset_that_is_no_force_recording_is_refused_at_once(force):
    """A failure means that another table in place of the force, with an offset, ends in a KeyError."""
    settings = Settings(pixel_size_um=10, offset_s=1.0, timestamps=DEEP / "timestamps.txt")
    with pytest.raises(InputError, match="force"):
        vision.analyse(DEEP / "video.tif", force, settings)


def test_single_settings_are_given_by_name(whole):
    """A failure means that a typed setting is ignored, or ends in a traceback of Python."""
    again = vision.analyse(None, whole.force, whole.settings, earlier=whole, pixel_size_um=9)
    assert again.settings == replace(whole.settings, pixel_size_um=9)
    with pytest.raises(InputError, match="did you mean fps"):
        vision.analyse(DEEP / "video.tif", fsp=25)
    for typed, name in {"d0": "d0_mm", "strip": "rows", "fix_mu": "mu", "thickness": "sample"}.items():
        with pytest.raises(InputError, match=rf"did you mean {name}\?"):
            vision.analyse(DEEP / "video.tif", **{typed: 1})
    with pytest.raises(InputError, match="`fps`: expected a positive number"):
        vision.analyse(DEEP / "video.tif", fps=-25)


def test_settings_are_those_of_what_was_opened(whole):
    """A failure means that a run states another clock, part or d0 than it was measured with."""
    film = vision.open_video(DEEP / "video.tif", fps=60, frames=slice(0, 40))
    found = vision.analyse(film, whole.force)
    assert (found.settings.fps, found.settings.frames) == (60, slice(0, 40))
    assert found.settings.d0_mm == 13
    assert np.diff(found.tracks["time_s"])[0] == pytest.approx(1 / 60)
    assert vision.analyse(film, earlier=found).strip is found.strip


def test_without_a_force_there_is_no_clock(whole):
    """A failure means that the summary states the clock of a force that is no longer there."""
    given = vision.analyse(None, whole.force, whole.settings, earlier=whole, offset_s=12.0)
    assert given.clock is not None
    assert vision.analyse(None, whole.force, given.settings, earlier=given).clock is given.clock
    assert vision.analyse(None, None, given.settings, earlier=given).clock is None


@pytest.mark.parametrize(
    "given", [{"fps": 25}, {"frames": slice(9)}, {"rotate": 90}, {"d0_mm": 14}, {"speed_mm_min": 3}]
)
def test_a_setting_that_would_change_nothing_is_refused(whole, given):
    """A failure means that the settings state d0 14 over the results of 13."""
    (name,) = given
    film = vision.open_video(DEEP / "video.tif", timestamps=DEEP / "timestamps.txt")
    with pytest.raises(InputError, match=f"`{name}`: expected .*, with which"):
        vision.analyse(film, whole.force, whole.settings, **given)
    with pytest.raises(InputError, match="`d0_mm`: expected none"):
        vision.analyse(None, whole.force.assign_attrs(operations="[]"), d0_mm=13)


def test_settings_show_what_was_changed():
    """A failure means that a notebook fills a screen with constants, and hides the few that were set."""
    clock = pipeline.Tuning().clock
    least = type(clock)(**{dataclasses.fields(clock)[0].name: 1})
    shown = repr(Settings(fps=25.0, tuning=pipeline.Tuning(clock=least)))
    assert shown == f"Settings(fps=25.0, tuning=Tuning(clock={least!r}))"
    assert repr(Settings()) == "Settings()"
