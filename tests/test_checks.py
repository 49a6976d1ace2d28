"""Findings that contradict each other are said, with what to do; findings that agree are not."""

import re
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from scipy.ndimage import gaussian_filter

import vision.checks
import vision.pipeline
from tests.scenes.analysed import with_force
from tests.scenes.combs import blurred, comb, ridges, strip
from tests.scenes.reviewed import FORCE, SETTINGS, VIDEO, clean
from vision.checks import (
    CheckSettings,
    consistency_warnings,
    decision_warnings,
    longest_stretches,
    overexposure,
    shells_against_fits,
    tracking_warnings,
    unlike_sides,
)
from vision.figures import Results
from vision.pipeline import Analysis, Settings, Tuning, all_warnings, analyse
from vision.sample import PUBLISHED
from vision.sheets import TrackingSettings, track_sheets
from vision.sheets.corrections import correction_of
from vision.sheets.recovery import missing_stretches
from vision.shells import ShellSettings
from vision.summary import _noise, summary_lines
from vision.video import VideoSettings

PITCH, SHEETS, AXIS = 20.0, 50, 600.0


def film(contrast=1.0, snr=100):
    """Fifty creeping and slipping sheets around an axis at 600 px."""
    return strip(ridges(comb(150), contrast=contrast), snr=snr)


@pytest.fixture(scope="module")
def picture():
    return film()


@pytest.fixture(scope="module")
def tracked(picture):
    """The tracks of it; not to be changed."""
    return track_sheets(picture)


def test_a_film_that_agrees_with_itself_raises_nothing(picture, tracked):
    """A failure means a warning on good films: nobody reads the next one."""
    assert consistency_warnings(tracked) == []
    assert consistency_warnings(track_sheets(picture, sheets=SHEETS, axis_px=AXIS)) == []


def lit(side):
    """Sheets of 8 px, bright on one side (a number of each frame from −1 to 1)."""
    x = comb(150, per_side=12, axis_px=300)
    halves = (ridges(x + off, width=600, fwhm_px=2.5, flat_px=4.0) for off in (-2.0, 2.0))
    return strip(
        sum((1 + 0.7 * sign * side[:, None]) * half for sign, half in zip((-1, 1), halves, strict=True))
    )


@pytest.mark.parametrize("what", ["side", "brightness", "constant"])
def test_ridges_lit_from_the_other_side_are_named(what):
    """A failure means that positions are off by two pixels in half of the film, and the run says nothing, or
    that it warns of light that shifts no ridge."""
    after = np.arange(150) > 90
    film = lit(np.where(after & (what == "side"), -1.0, 1.0))
    film.values[:] *= np.where(after & (what == "brightness"), 1.5, 1.0)[:, None]
    said = [line for line in tracking_warnings(track_sheets(film)) if "unlike usual" in line]
    assert len(said) == (what == "side")
    assert all(":150)" in line for line in said)


ORDERS = {
    "before 1 frame (30) the sheets advance at once": np.r_[:30, 31, 30, 32:150],
    "10 frames (90, 91, 92, 93, 94 …) repeat an earlier picture (80, 81, 82, 83, 84 …)": np.r_[:90, 80:140],
    "in each 2 successive frames the order is wrong": np.arange(150) ^ 1,
}


@pytest.mark.parametrize("named", ORDERS)
def test_frames_in_the_wrong_order_are_named(picture, named):
    """A failure means that a film with frames in the wrong order is analysed in silence."""
    order = ORDERS[named][: len(picture)]
    wrong = picture.isel(frame=np.arange(len(order))).copy(data=picture.values[order])
    said = [line for line in tracking_warnings(track_sheets(wrong)) if line.startswith(named)]
    assert len(said) == 1
    assert not any(line.startswith(tuple(ORDERS)) for line in tracking_warnings(track_sheets(picture)))


@pytest.mark.parametrize("name", [field.name for field in fields(CheckSettings)])
def test_every_setting_is_used(name):
    """A failure means that somebody turns a knob that is connected to nothing."""
    source = "".join(Path(part.__file__).read_text("utf-8") for part in (vision.checks, vision.pipeline))
    assert re.search(rf"\b(settings|checks)\.{name}\b", source)


def test_settings_reach_the_warnings(tracked):
    """A failure means that `tuning.checks` stops somewhere on the way."""

    def warned(**tuning):
        settings = Settings(pixel_size_um=10.0, sample=PUBLISHED, tuning=Tuning(**tuning))
        return all_warnings(Analysis(settings=settings, tracks=tracked))

    assert not warned()
    (still,) = warned(tracking=TrackingSettings(still_share=1.1))
    assert "hardly any sheet moves" in still
    wide, apart = warned(checks=CheckSettings(odd_width=0.5, unlikely_spacing=1.0))
    assert "50 of 50 sheets" in wide and "0.2 mm apart" in apart
    assert apart.endswith("check `pixel_size_um` (µm) and `thickness_mm`")


@pytest.mark.parametrize("axis_px", [AXIS - 10 * PITCH, AXIS + 10 * PITCH])
def test_an_axis_where_motion_excludes_it(picture, axis_px):
    """Sheets move towards the axis: one ten sheets aside would have ten sheets move away from it."""
    lines = consistency_warnings(track_sheets(picture, axis_px=axis_px))
    assert len(lines) == 1
    assert f"axis at {axis_px:.0f} px is outside the range that the motion allows" in lines[0]
    assert "`axis_px`" in lines[0]


@pytest.mark.parametrize("pitches", [0.4, 0.65, -0.65])
def test_an_axis_that_motion_allows_is_not_doubted(picture, pitches):
    """The innermost sheets hardly move and stand unevenly, so that more than half a pitch aside is what
    motion allows. A failure means that the middle of a good comb is doubted."""
    assert consistency_warnings(track_sheets(picture, axis_px=AXIS + pitches * PITCH)) == []


@pytest.mark.parametrize(
    ("high_px", "said"),
    [
        (192.9, "found from motion; the motion allows no other gap between sheets"),
        (220.0, "found from motion; the motion allows 192.5 to 220.0 px"),
        (280.0, "not decided by the motion, which allows 192.5 to 280.0 px"),
    ],
)
def test_an_axis_is_said_to_be_where_the_motion_allows_it(tracked, high_px, said):
    """A failure means "192.5 px (the motion allows 193 to 193 px)", which contradicts itself, or that an axis
    which the motion leaves open by four sheets is called found."""
    found = {"axis_px": 192.5, "axis_how": "motion", "axis_low_px": 192.9, "axis_high_px": high_px}
    tracks = tracked.assign_attrs(**found, axis_open="yes" if said.startswith("not") else "no")
    (line,) = [one for one in summary_lines(Results(tracks=tracks)) if one.startswith("axis")]
    assert line.startswith(f"axis       192.5 px ({said})")


def test_an_axis_beside_one_side_that_hardly_moves_is_not_called_found():
    """The innermost sheets of one side move too little to show where the axis is. A failure means that nine
    sheets of doubt pass for a find, or an axis outside its own range."""
    side = comb(60, slip=0.05)[:, 25:]
    tracks = track_sheets(strip(ridges(side), snr=30))
    assert tracks.attrs["axis_high_px"] - tracks.attrs["axis_low_px"] > 3 * PITCH
    (line,) = [one for one in summary_lines(Results(tracks=tracks)) if one.startswith("axis")]
    assert (
        "half a spacing beyond the innermost sheet in view; not decided by the motion, which allows" in line
    )
    axis, low, high = map(float, re.findall(r"\d+\.\d", line))
    assert low <= axis <= high


@pytest.mark.parametrize("told", [12, 20, 40, 44, 49])
def test_fewer_sheets_told_than_seen(picture, told):
    """`sheets` 40 on a film of 50 renumbers all of them: the ten left out are like the others. Of 12, the
    most even ones may be every third."""
    lines = consistency_warnings(track_sheets(picture, sheets=told))
    assert len(lines) == (2 if told == 12 else 1)  # 12 are too far apart for the motion of their ends
    more = f"beyond the {told} sheets of the comb or between them, {SHEETS - told} more would change every n"
    assert more in lines[0]
    assert f"`sheets` as {SHEETS}" in lines[0]


def test_sheets_in_black_background(picture):
    """Reflections of a tenth of a ridge's height, in line with the comb, that make up a number of sheets
    that is too large: they are no sheets."""
    height = np.where(np.abs(np.arange(SHEETS) - 24.5) > 21.5, 0.095, 1.0)
    lines = consistency_warnings(track_sheets(film(height, snr=1000), sheets=SHEETS))
    assert len(lines) == 1
    assert "6 of 50 sheets (index 0, 1, 2, 47, 48, 49) may be something else" in lines[0]
    assert "restrict `columns`" in lines[0]


@pytest.mark.parametrize("slip", [0.3, 0.015])
@pytest.mark.parametrize("end", [0, -1])
def test_a_still_edge_beyond_the_comb(end, slip):
    """The edge of a lamp's light a spacing beyond the comb, in all frames. A failure means that it passes
    for the outermost sheet, which moves most of all, or that such a sheet is doubted."""
    x_px = comb(150, slip=slip)
    assert consistency_warnings(track_sheets(strip(ridges(x_px)))) == []
    x_px[:, end] = x_px[0, end]
    (line,) = consistency_warnings(track_sheets(strip(ridges(x_px))))
    assert f"1 of 50 sheets (index {end % 50}) may be something else" in line
    assert "still at the comb's end" in line


@pytest.mark.parametrize("place", [3, 10, 40])
def test_a_scratch_at_the_place_of_a_missing_sheet(place):
    """It looks like a sheet, and stands still between sheets that move by too little for it to be left out. A
    failure means that it passes for a sheet that sticks, and the stiff shell is too large."""
    x_px = comb(150, slip=0.1)
    x_px[:, place] = x_px[0, place]
    (line,) = consistency_warnings(track_sheets(strip(ridges(x_px))))
    assert f"1 of 50 sheets (index {place}) may be something else" in line
    assert "between sheets that move" in line


def test_stripes_of_the_background_that_continue_the_comb():
    """Stripes with the sheets' spacing beyond both ends stand still. A failure means that they pass for
    sheets, which shifts n of all sheets, or that sheets which move against their neighbours are doubted."""
    x_px = comb(150)
    x_px[:, :3], x_px[:, -2:] = x_px[0, :3], x_px[0, -2:]
    (line,) = consistency_warnings(track_sheets(strip(ridges(x_px))))
    assert "5 of 50 sheets (index 0, 1, 2, 48, 49) may be something else" in line
    x_px[60:, [1, 48]] = np.nan  # texture is not seen in all frames
    (line,) = [one for one in consistency_warnings(track_sheets(strip(ridges(x_px)))) if "else" in one]
    assert "5 of 50 sheets (index 0, 1, 2, 48, 49) may be something else" in line
    opposed = comb(150)
    opposed[:, :3] = 2 * opposed[0, :3] - opposed[:, :3]
    assert "still" not in str(consistency_warnings(track_sheets(strip(ridges(opposed)))))


def test_a_sheet_that_moves_by_itself_leaves_those_beyond_sheets():
    """A sheet splits in mid-film, and one half of it is followed. A failure means that all sheets beyond it,
    which move far less, are doubted."""
    x_px = comb(150, slip=0.08)
    x_px[75:, 28] += 0.3 * PITCH
    assert "something else" not in str(consistency_warnings(track_sheets(strip(ridges(x_px)))))


@pytest.mark.parametrize(("parted", "said"), [(25, 1), (150, 0)])
def test_sheets_that_leave_early_are_named(parted, said):
    """The blocks part soon after the film begins, or never. A failure means that the half of the sheets that
    stays is numbered without a word as if it were all, or a warning on good films."""
    x_px = comb(150)
    x_px[parted:, ::2] = np.nan
    lines = consistency_warnings(track_sheets(strip(ridges(x_px))))
    assert sum("of the frames there is a further ridge" in line for line in lines) == said


@pytest.mark.parametrize(("height", "said"), [(0.17, 1), (0.5, 0)])
def test_the_end_of_a_reflection_beyond_the_comb(height, said):
    """A faint ridge one pitch beyond the last sheet, which moves along with it. A failure means that it
    passes for a sheet, and shifts n of all sheets of a side, or that a dim sheet is doubted."""
    contrast = np.ones(SHEETS)
    contrast[-1] = height
    lines = consistency_warnings(track_sheets(film(contrast, snr=300)))
    assert [f"(index {SHEETS - 1})" in line for line in lines if "something else" in line] == [True] * said


@pytest.mark.parametrize(("share", "absent"), [(0.0, 0), (0.1, 0), (0.6, 0), (0.0, 10)])
def test_an_axis_that_the_camera_moves(share, absent):
    """A machine that goes back and forth, and a camera that moves along by a share of the outermost sheets'
    motion. A failure means that the camera places the axis, or that sides of which one lacks sheets, as where
    a camera moves along, pass without a word."""
    stick = comb(24)
    course = np.tile(np.r_[0:24, 23:-1:-1], 4)
    camera = share * (stick[:, 0] - stick[:, 0].mean())
    picture = strip(ridges(stick[course, absent:] + camera[course, None]), snr=60)
    tracks = track_sheets(picture)
    left = (tracks["side"].values < 0).sum()
    assert 0 <= left - (25 - absent) <= (1 if absent else 0)
    lines = consistency_warnings(tracks, columns=picture["x"].values)
    if absent:
        assert len(lines) == 1
        assert f"{left} sheets on the left of the axis but {40 - left} on the right" in lines[0]
    else:
        assert lines == []
    assert consistency_warnings(tracks) == []  # the comb may go on outside the picture


@pytest.mark.parametrize(("sigma", "seed", "said"), [(0.06, 1, 0), (0.2, 3, 0), (0.3, 2, 1), (0.32, 3, 1)])
def test_sheets_out_of_focus_are_said_to_merge(sigma, seed, said):
    """Of 20 sheets, 15 to 19 are found where `said`. A failure means that the others are lost without a word,
    or that a comb which is slightly out of focus, or whose number of sheets was given, is questioned."""
    picture = blurred(sigma, seed=seed)
    tracks = track_sheets(picture)
    assert (tracks.sizes["sheet"] < 20) == said
    lines = [line for line in tracking_warnings(tracks) if "neighbours may be seen as one" in line]
    assert len(lines) == said
    assert all("focus the camera" in line and "`sheets`" in line for line in lines)
    given = track_sheets(picture, sheets=tracks.sizes["sheet"])
    assert "seen as one" not in str(tracking_warnings(given))


@pytest.mark.parametrize("lopsided", [False, True])
def test_sheets_that_all_move_the_same_way_are_questioned(lopsided):
    """The whole comb is in view. A failure means that a comb which every slip carries further than it opens
    is taken for one side of the sample without a word, or that one side of a sample is questioned."""
    x = comb(150, slip=0.85)
    carried = x - 1.5 * (x[:, :1] - x[0, 0])
    if lopsided:  # sheets of one side do not slip
        carried[:, :20] = carried[0, :20] + (carried[:, 20:21] - carried[0, 20])
    for shown, said in ((carried, 1), (x, 0), (x[:, 25:], 0)):
        picture = strip(ridges(shown - shown[0, 0] + 80, width=1300))
        lines = consistency_warnings(track_sheets(picture), columns=picture["x"].values)
        assert [" sheets move the same way" in line for line in lines] == [True] * said
        assert all("`axis_px`" in line for line in lines)


def test_an_axis_is_open_by_the_setting_of_the_run():
    """A failure means that the warning of an open axis follows the default, not `decided_sheets`."""
    x = comb(150, slip=0.4)[:, 3:] + np.random.default_rng(3).normal(0, 0.4, (150, 1))
    picture = strip(ridges(x - x[0, 0] + 10, width=1300))
    for sheets, said in ((0, True), (50, False)):
        tracks = track_sheets(picture, settings=TrackingSettings(decided_sheets=sheets))
        lines = consistency_warnings(tracks, columns=picture["x"].values)
        assert any("leaves open where the axis is" in line for line in lines) == said


def test_an_axis_that_no_motion_shows_is_assumed():
    """One side of a comb that hardly moves. A failure means that half of the sheets get another side, and all
    of them another number, without a word; or that the warning comes where both sides move."""
    still = track_sheets(strip(ridges(comb(60, slip=0.0)[:, 25:])))
    assert still.attrs["axis_how"] == "geometry"
    (line,) = consistency_warnings(still, PUBLISHED)
    assert "the middle of the ridges is assumed" in line
    assert "give `axis_px`" in line
    assert consistency_warnings(still) == []


def test_an_axis_of_a_comb_that_is_cut_off_is_not_its_middle():
    """A failure means that n of all sheets is wrong without a word, as five of one side are beyond the edge
    of the picture and nothing moves; or that a comb within the picture is questioned."""
    for cut in (0, 5):
        x = comb(60, slip=0.0)[:, cut:]
        picture = strip(ridges(x - x[0, 0] + (10 if cut else 60), width=1200))
        tracks = track_sheets(picture)
        lines = consistency_warnings(tracks, columns=picture["x"].values)
        assert tracks.attrs["axis_how"] == "geometry"
        assert len(lines) == (cut > 0)
        assert all("may cut off one end" in line for line in lines)


def test_unequal_sheets_are_sheets():
    """A fifth of the height is a faint sheet, no background."""
    uneven = np.where(np.arange(SHEETS) % 7 == 3, 0.2, 1.0)
    assert consistency_warnings(track_sheets(film(uneven, snr=300), sheets=SHEETS)) == []


def test_more_ridges_on_a_side_than_the_sample_has_sheets(tracked):
    """A block of 20 sheets cannot show 25 ridges; a sample that nobody gave contradicts nothing."""
    given = replace(PUBLISHED, sheets_per_block=20)
    lines = consistency_warnings(tracked, given)
    assert len(lines) == 1
    assert "20 sheets per block and side given, but n reaches 25" in lines[0]
    assert "`sheets_per_block`" in lines[0]
    assert consistency_warnings(tracked, replace(PUBLISHED, sheets_per_block=25, width_mm=44.0)) == []
    assert consistency_warnings(track_sheets(strip(ridges(comb(150, per_side=29))))) == []


def test_a_side_that_lacks_a_sheet_of_the_sample_is_named():
    """A failure means that n of the sheets beyond an overlooked one is too small and nothing says so, or that
    it is said where the number of sheets was given, or no sample is known."""
    contrast = np.ones(SHEETS)
    contrast[17] = 0.0
    picture = film(contrast)
    tracks = track_sheets(picture)
    assert "24 sheets on the left but 25 on the right" in " ".join(consistency_warnings(tracks, PUBLISHED))
    assert consistency_warnings(tracks) == []
    assert consistency_warnings(track_sheets(picture, sheets=49), PUBLISHED) == []


@pytest.mark.parametrize(("size_um", "said"), [(None, 0), (10, 0), (3, 0), (30, 0), (0.01, 1), (10_000, 1)])
def test_a_pixel_size_in_another_unit(tracked, size_um, said):
    """A failure means that µm taken for mm are not noticed, or that a true pixel size is questioned."""
    lines = consistency_warnings(tracked, assumed=PUBLISHED, pixel_size_um=size_um)
    assert sum("check `pixel_size_um`" in line for line in lines) == said
    unknown = consistency_warnings(tracked, pixel_size_um=size_um)  # thickness of the sheets
    assert sum("0.2 µm apart" in line for line in unknown) == len(unknown) == (size_um == 0.01)


def test_a_part_of_one_side(picture):
    """Sheets 7 to 25 of the right side. A failure means that they count as 1 to 19 without a word."""
    tracks = track_sheets(picture[:, int(AXIS + 6 * PITCH) :])
    (line,) = consistency_warnings(tracks, assumed=PUBLISHED)
    assert "only 19 of 25 sheets of one side are in view" in line
    assert "`axis_px`" in line
    beside = track_sheets(picture[:, int(AXIS + 6 * PITCH) :], axis_px=AXIS + 6 * PITCH)
    assert consistency_warnings(beside, assumed=PUBLISHED) == []


def test_n_counts_from_a_given_axis_out_of_view(picture):
    """Sheets 7 to 25 of the right side, with the axis known. A failure means that they count as 1 to 19, or
    that the summary does not say what it assumed."""
    tracks = track_sheets(picture[:, int(AXIS + 6 * PITCH) :], axis_px=AXIS)
    np.testing.assert_array_equal(tracks.n, np.arange(7, 26))
    assert consistency_warnings(tracks, assumed=PUBLISHED) == []
    (line,) = (line for line in summary_lines(Results(tracks=tracks)) if line.startswith("axis"))
    assert "n begins at 7, as 6 more sheets fit" in line
    too_far = track_sheets(picture[:, int(AXIS + 6 * PITCH) :], axis_px=AXIS - 5 * PITCH)
    assert "but n reaches 30" in " ".join(consistency_warnings(too_far, PUBLISHED))


@pytest.fixture(scope="module")
def wrong_d0():
    """The film that began at 16.6 mm, read as if at 13."""
    return analyse(VIDEO, FORCE, replace(SETTINGS, d0_mm=13.0))


def test_a_wrong_d0_contradicts_the_shells(wrong_d0):
    """The force then implies 9.1 stiff sheets per side where the film shows 7 to 8; with the right d0 it
    implies 8.2, which is 8. A failure means that a wrong separation passes, or a right one is doubted."""
    offset, line = wrong_d0.warnings
    assert "𝒯0 = 5.99 N is" in offset and "give `d0_err_mm`" in offset
    assert "M_eff of the fits (9.1) lies outside the stiff shell's interval (7 to 8 sheets)" in line
    assert "check `d0_mm`" in line
    assert clean().warnings == ()


def test_shells_that_say_nothing_about_the_fits(wrong_d0):
    """Two phases are too few; a side that is stiff as far as it is in view may have more stiff sheets; an
    M_eff that is not known better than to a sheet contradicts nothing."""
    shells, fits, settings = wrong_d0.shells, wrong_d0.fits, ShellSettings()
    assert len(shells_against_fits(shells, fits, settings)) == 1
    assert shells_against_fits(shells[:2], fits, settings) == []
    cut = shells.assign(sheets_known=shells["stiff_high"].astype(int))
    assert shells_against_fits(cut, fits, settings) == []
    loose = replace(fits, scale_mm=replace(fits.scale_mm, error=20 * fits.scale_mm.error))
    assert shells_against_fits(shells, loose, settings) == []
    unknown = replace(fits, scale_mm=replace(fits.scale_mm, value=300.0, error=300.0))
    assert shells_against_fits(shells, unknown, settings) == []
    agreeing = shells.assign(stiff_high=9)
    assert shells_against_fits(agreeing, fits, settings) == []
    fewer = shells.assign(stiff_low=12, stiff_high=14)
    (line,) = shells_against_fits(fewer, fits, settings, codec="h264")
    assert "the codec (h264) may hide" in line
    assert "codec" not in "".join(shells_against_fits(fewer, fits, settings, codec="ffv1"))


def test_sides_with_different_shells_are_said():
    """A failure means that an axis one sheet aside, or a side that does not slip, passes in silence; or that
    sides are said to differ that do so within their errors, by one sheet, or now one way and now the other.
    """

    def said(left, right, error=1):
        rows = [(event, side, size) for event in range(10) for side, size in ((-1, left), (1, right))]
        sizes = [size(event) if callable(size) else size for event, _, size in rows]
        table = pd.DataFrame(rows, columns=["event", "side", "stiff_sheets"]).assign(stiff_sheets=sizes)
        table = table.assign(
            stiff_low=table["stiff_sheets"] - error, stiff_high=table["stiff_sheets"] + error
        )
        return unlike_sides(table.astype("Int64"), ShellSettings())

    (line,) = said(12, 15)
    assert "12 sheets on the left but 15 on the right in 10 of 10" in line and "`axis_px`" in line
    assert said(12, 14) == [] == said(12, 13, error=0) != said(12, 14, error=0)
    assert said(12, lambda event: 12 + 5 * (-1) ** event) == []
    assert unlike_sides(None, ShellSettings()) == []


def test_frames_of_another_scene_are_named(picture, tracked):
    """A failure means that half a film of something else passes as some missing positions."""
    assert tracking_warnings(tracked) == []
    other = picture.copy(deep=True)
    rng = np.random.default_rng(1)
    other.values[90:] = 60 + rng.normal(0, 0.6, other.values[90:].shape)
    lines = [line for line in tracking_warnings(track_sheets(other)) if "fewer than half" in line]
    assert len(lines) == 1
    assert "in 60 frames (the longest run is 90:150)" in lines[0]


@pytest.mark.parametrize("seed", range(3))
def test_a_film_of_something_else_is_not_taken_for_sheets(picture, tracked, seed):
    """A failure means that a landscape gets six warnings, and none says that it shows no sheets."""
    line = "may be no comb of sheets"
    repeated = tracked.copy(deep=True)
    repeated["flag"][::2], repeated["flag"][1::4], repeated["flag"][3:9:4] = "frozen", "left_out", "missing"
    for sheets in (tracked, repeated):  # neither repeated pictures nor decisions speak against a comb
        assert line not in " ".join(tracking_warnings(sheets))
    smooth = gaussian_filter(np.random.default_rng(seed).normal(0, 1, picture.shape), [6, 5])
    scene = picture.copy(data=np.float32(100 + 40 * smooth / smooth.std()))
    tracks = track_sheets(scene)
    assert line in tracking_warnings(tracks)[0], seed


def test_positions_are_left_out_for_the_reason_that_holds():
    """A failure means that sheets in one ridge are said to be of uncertain identity."""
    tracks = with_force().tracks.copy(deep=True)
    total = tracks["flag"].size
    tracks["flag"][3:5, 0] = "merged"
    assert tracking_warnings(tracks)[0].startswith(
        f"2 of {total} positions left out where a sheet shares a ridge"
    )
    tracks["flag"][3:6, 1] = "doubtful"
    line = tracking_warnings(tracks)[0]
    assert line.startswith(f"5 of {total} positions left out: 3 where the identity of the sheet is")
    assert ", 2 where a sheet shares a ridge" in line
    tracks["flag"][:] = "merged"
    assert "overview.png" not in tracking_warnings(tracks)[0]  # a preview has none


@pytest.mark.parametrize("frames", [1, 60])
def test_a_picture_has_no_noise_to_measure_and_says_so(picture, frames):
    """One picture, or one repeated: a failure means "nan px" or "0.0000 px" as if that had been measured."""
    still = picture.isel(frame=np.zeros(frames, int)).assign_coords(frame=np.arange(frames))
    tracks = track_sheets(still)
    assert any("all frames are equal" in line for line in tracking_warnings(tracks)) == (frames > 1)
    assert "not measured" in _noise(tracks, None).value


def test_a_film_of_few_grey_levels_is_not_called_still(tracked):
    """A failure means that a film that moves is said to consist of equal frames."""
    tracks = tracked.assign(x_noise_px=("sheet", np.zeros(tracked.sizes["sheet"])))
    lines = " ".join(tracking_warnings(tracks))
    assert "too few grey levels" in lines
    assert "all frames are equal" not in lines


def test_frames_without_positions_are_not_called_equal(tracked):
    """A failure means that a noisy film in which no ridge could be fitted is said not to change."""
    nothing = np.full_like(tracked.x_noise_px.values, np.nan)
    tracks = tracked.assign(flag=xr.full_like(tracked.flag, "missing"), x_noise_px=("sheet", nothing))
    assert "all frames are equal" not in " ".join(tracking_warnings(tracks))


@pytest.mark.parametrize(
    ("apart_px", "how", "snr"),
    [
        (11.0, "spacings of 11 and 29 px alternate", 100),
        (19.0, "only every second spacing changes", 100),
        (19.0, "only every second spacing changes", 12),
    ],
)
def test_two_edges_of_every_sheet_are_said_to_be_pairs(apart_px, how, snr):
    """Light from both sides draws two lines for each sheet, which keep their distance.  A failure means that
    twice as many sheets as there are pass, or are said to lack some."""
    edge = comb(60, per_side=8, axis_px=330)[:, :, None] * 2 - 330
    both = (edge + np.array([0.0, apart_px])).reshape(60, 32)
    picture = strip(ridges(both, width=700, fwhm_px=5.0), snr=snr)
    lines = tracking_warnings(track_sheets(picture))
    assert [line for line in lines if "sheets may be missing" in line] == []
    assert sum(f"form pairs: {how}" in line for line in lines) == 1
    # With half the number, the middle half of the edges or none would be tracked.
    assert any("count edges" in line and "`sheets` as 32" in line for line in lines)
    assert not any("form pairs" in line for line in tracking_warnings(track_sheets(picture, sheets=32)))


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_ridge_between_pairs_does_not_hide_them(mirrored):
    """Seven pairs of edges, and a wide ridge between two of them. A failure means that one false ridge is
    enough for edges to pass for sheets, or that it passes for a sheet itself."""
    edges = 100 + 100 * np.arange(7)[:, None] + np.array([0.0, 25.0])
    x, width = np.r_[edges.ravel(), 663.0], np.r_[np.full(14, 9.0), 20.0]
    x = 825 - x if mirrored else x
    still = np.tile(x, (60, 1)) + np.random.default_rng(1).normal(0, 0.3, (60, 1))
    tracks = track_sheets(strip(ridges(still, width=825, fwhm_px=width)))
    assert tracks.sizes["sheet"] == 15
    index = 2 if mirrored else 12
    (line,) = [one for one in tracking_warnings(tracks) if "form pairs" in one]
    assert f"spacings of 25 and 75 px alternate, but for the ridge of index {index}" in line
    assert "try `ridges` as dark" in line
    assert any(
        f"1 of 15 sheets (index {index}) may be something else" in one for one in consistency_warnings(tracks)
    )


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_an_uneven_comb_has_no_pairs(seed):
    """A failure means that sheets at uneven distances, which all change, are called edges."""
    uneven = comb(60, per_side=16, axis_px=350, uneven=0.2, seed=seed)
    lines = tracking_warnings(track_sheets(strip(ridges(uneven, width=700, fwhm_px=5.0))))
    assert not any("form pairs" in line for line in lines)


@pytest.mark.parametrize(
    ("gain", "top", "told"), [(1.0, 255, 0), (2.2, 255, 1), (35.0, 4095, 1), (16.0, 4095, 0), (0.1, 255, 0)]
)
def test_an_overexposed_film_is_told(gain, top, told):
    """Ridges whose tops the camera cut off, also one of 12 bits in a file of 16; not ridges that end below,
    nor those of a film so dark that it has few grey levels."""
    x, rng = np.arange(400), np.random.default_rng(0)
    light = 40 + 110 * np.exp(-(((x % 20) - 10) ** 2) / 23) + rng.normal(0, 2, (60, 400))
    frame = np.clip(light * gain, 0, top).astype(np.uint16)
    settings = VideoSettings()
    lines = overexposure(frame, slice(10, 50), settings)
    assert [f"the brightest ({top})" in line for line in lines] == [True] * told
    assert overexposure(frame, slice(10, 50), replace(settings, overexposed=1.1)) == []


def test_a_clipped_ground_is_not_called_flat_tops():
    """A failure means that the ground of dark ridges, as in a negative, is taken for the ridges' tops."""
    x = np.arange(400)
    frame = np.tile(np.clip(300 - 110 * np.exp(-(((x % 20) - 10) ** 2) / 23), 0, 255), (60, 1))
    (line,) = overexposure(frame.astype(np.uint8), slice(10, 50), VideoSettings(), dark=True)
    assert "ground is clipped" in line and "negative" in line and "flat tops" not in line


def test_a_swap_that_lets_two_sheets_jump_is_told(picture):
    """A failure means that one wrong decision by hand makes a sheet another one, and nobody notices."""
    swap = correction_of("swap", {"sheets": [4, 5], "frames": "60:"})
    (line,) = decision_warnings(track_sheets(picture, corrections=(swap,)), (swap,))
    assert line.startswith("left 21 (index 4) and left 20 (index 5) swapped, frames 60:")
    assert "in frame 60" in line
    assert "+1.0 and -1.0 pitches" in line
    whole = correction_of("swap", {"sheets": [4, 5], "frames": "0:"})
    assert decision_warnings(track_sheets(picture, corrections=(whole,)), (whole,)) == []


@pytest.mark.parametrize("frames", [(100, 300), (100, 141)])
def test_a_sheet_that_is_lost_for_long_is_named(frames):
    """A failure means that nobody learns which sheet has no ridge, and when, without reading tracks.csv."""
    x = comb(300)
    x[slice(*frames), 12] = np.nan
    tracks = track_sheets(strip(ridges(x)))
    where = f"left 13 (index 12) in frames {frames[0]}:{frames[1]} (missing)"
    count = frames[1] - frames[0]
    line = f"{count} of 15000 positions missing (flag in tracks.csv: {count} missing): {where}"
    assert tracking_warnings(tracks) == ([line] if 100 * count > 15000 else [])
    assert f"no ridge   for 10 frames or more: {where}" in summary_lines(Results(tracks=tracks))


def test_sheets_that_blink_are_not_listed(tracked):
    """A failure means a list of single frames, in which the long stretches are not seen."""
    blinking = tracked.copy(deep=True)
    blinking["flag"][10:19, 3] = "missing"
    assert len(missing_stretches(tracked)) == len(missing_stretches(blinking)) == 0
    for sheet in range(0, 20, 2):
        blinking["flag"][50 + sheet : 90, sheet] = "edge"
    assert list(missing_stretches(blinking)["sheet"]) == list(range(0, 20, 2))
    assert longest_stretches(missing_stretches(blinking), "flag").endswith("(edge) …")
