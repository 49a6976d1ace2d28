"""Axis, side and n: from the motion where there is any, else from the middle."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from tests.scenes.combs import comb, ridges, strip
from vision import open_video, strip_profile
from vision.checks import tracking_warnings
from vision.errors import InputError
from vision.figures import Results
from vision.sheets import TrackingSettings, pixel_size_of, track_sheets
from vision.sheets.numbering import number_sheets
from vision.summary import summary_lines

HOSTILE = Path(__file__).parents[2] / "fixtures" / "hostile"
PITCH = 20.0


def tracked(truth, *, width=1200, **options):
    return track_sheets(strip(ridges(truth, width=width)), **options)


def numbered(left, right):
    """n of so many sheets on either side."""
    return np.r_[np.arange(left, 0, -1), np.arange(1, right + 1)]


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_even_comb(seed):
    """A failure means the axis of the usual picture is found elsewhere than in its middle."""
    tracks = tracked(comb(200, slip=0.6, uneven=0.1, seed=seed))
    assert abs(tracks.attrs["axis_px"] - 600) < PITCH / 2
    np.testing.assert_array_equal(tracks.side, np.repeat([-1, 1], 25))
    np.testing.assert_array_equal(tracks.n, numbered(25, 25))


@pytest.mark.parametrize("nowhere", [[0], [12], [24], [43], [0, 43], range(1, 44), range(44)])
@pytest.mark.parametrize("axis_px", [None, 600.0, -100.0])
def test_sheets_without_any_position_count(nowhere, axis_px):
    """A sheet that is withheld in the whole film has a number all the same. Failure: the axis is not known
    or the middle in place of that of the motion, n of the others is wrong, or a given axis ends the run."""
    truth = comb(60, slip=0.3)[:, :44]  # the axis is not in the middle of these
    truth += np.random.default_rng(1).normal(0, 0.005, truth.shape)
    known = np.delete(np.arange(44), nowhere)
    seen = np.full(truth.shape, np.nan)
    seen[:, known] = truth[:, known]
    numbering, whole = (number_sheets(x, axis_px=axis_px) for x in (seen, truth))
    if len(known) > 1:
        np.testing.assert_array_equal(numbering.n, whole.n)
        np.testing.assert_array_equal(numbering.side, whole.side)
        assert numbering.how == whole.how
        assert abs(numbering.axis_px - whole.axis_px) < PITCH / 2
    else:
        assert len(numbering.n) == 44


@pytest.mark.parametrize("first", [4, 5])
def test_sheets_that_touch_in_every_slip_do_not_move_the_axis(first):
    """Two sheets of one side touch from one slip to the next, so that their slips are never seen. A failure
    means that they are taken for still, as if the axis lay between them."""
    truth = comb(240, per_side=4, slip=0.3, period=24.0)
    seen = truth + np.random.default_rng(1).normal(0, 0.02, truth.shape)
    seen[np.arange(240) // 24 % 2 == 1, first : first + 2] = np.nan
    numbering = number_sheets(seen, width_px=1200)
    assert numbering.how == "motion"
    np.testing.assert_array_equal(numbering.n, numbered(4, 4))


@pytest.mark.parametrize(("sheet", "jump_px"), [(17, 6.0), (20, 3.0), (20, -3.0), (32, -6.0)])
def test_one_sheet_that_is_covered_in_a_slip_does_not_move_the_axis(sheet, jump_px):
    """A cable's edge draws one sheet of the stiff centre aside while the others slip. Failure: n is
    wrong by one to eight on all sheets."""
    truth = comb(60, slip=0.3)
    slip = int(np.argmax(np.abs(np.diff(truth[:, 0]))))
    truth[slip + 1 : slip + 9, sheet] += jump_px
    numbering = number_sheets(truth + np.random.default_rng(1).normal(0, 0.005, truth.shape))
    np.testing.assert_array_equal(numbering.n, numbered(25, 25))
    assert abs(numbering.low_px - 600) < 1.5 * PITCH


@pytest.mark.parametrize("cut", [2, 5, 9])
def test_asymmetric_crop_is_told_by_the_motion(cut):
    """A failure means n counts from the middle of the picture instead of from the axis of the blocks."""
    tracks = tracked(comb(300, slip=0.85)[:, cut:])
    assert tracks.attrs["axis_how"] == "motion"
    assert abs(tracks.attrs["axis_px"] - 600) < PITCH / 2
    assert int((tracks.side == -1).sum()) == 25 - cut


def test_without_motion_an_asymmetric_crop_is_taken_for_even():
    """The test above would pass by geometry alone if this one did not give another axis."""
    tracks = tracked(np.broadcast_to(comb(1)[:, 9:], (100, 41)))
    assert tracks.attrs["axis_how"] == "geometry"
    assert abs(tracks.attrs["axis_px"] - 600) > 2 * PITCH


@pytest.mark.parametrize("cut", [12, 15])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_vibration_does_not_hide_a_crop(cut, seed):
    """A failure means that a shaking camera makes a lopsided view pass for a centred one."""
    truth = comb(300, slip=0.3)[:, cut:]
    truth = truth + np.random.default_rng(seed).normal(0, 0.05, (300, 1))
    attrs = tracked(truth).attrs
    assert abs(attrs["axis_px"] - 600) < 3 * PITCH
    assert attrs["axis_low_px"] - PITCH < 600 < attrs["axis_high_px"] + PITCH
    assert attrs["axis_how"] == "motion"


def test_vibration_is_said_to_leave_the_axis_open():
    """A failure means that who cannot know the axis is told that the motion shows it."""
    truth = comb(300, slip=0.1) + np.random.default_rng(1).normal(0, 0.3, (300, 1))
    attrs = tracked(truth).attrs
    assert attrs["axis_how"] == "geometry"
    assert abs(attrs["axis_px"] - 600) < PITCH / 2
    assert attrs["axis_high_px"] - attrs["axis_low_px"] > 2 * PITCH


@pytest.mark.parametrize("drift_px", [0.0, 4.0])
@pytest.mark.parametrize("centre_px", [100, 300, 1100])
def test_a_zoom_without_slips_does_not_place_the_axis(centre_px, drift_px):
    """The camera zooms by 2 %, and drifts, in sixty frames. A failure means that the point that stands still
    in the picture is given as the axis, as certain."""
    rest, time = comb(1)[0], np.linspace(0, 1, 60)[:, None]
    truth = rest + (0.02 * (rest - centre_px) + drift_px) * time
    truth[20, [0, -1]] = np.nan
    numbering = number_sheets(truth + np.random.default_rng(1).normal(0, 0.02, truth.shape))
    assert numbering.how == "geometry"
    np.testing.assert_array_equal(numbering.n, numbered(25, 25))


def test_slips_of_one_side_leave_the_axis_open():
    """The other side stands still. A failure means that the axis is sought among a part of its sheets."""
    truth = comb(100, slip=0.3)
    truth[:, :25] = truth[0, :25]
    numbering = number_sheets(truth + np.random.default_rng(1).normal(0, 0.02, truth.shape))
    assert numbering.low_px < 600 < numbering.high_px


def test_odd_number():
    """A failure means one sheet too many or too few changes every n of a side."""
    truth = comb(200, slip=0.6)[:, 1:]
    tracks = tracked(truth)
    assert abs(tracks.attrs["axis_px"] - 600) < 0.55 * PITCH
    assert set(np.unique(tracks.side)) == {-1, 1}
    assert len(np.unique(np.stack([tracks.side, tracks.n]), axis=1).T) == 49


@pytest.mark.parametrize("gone", [[6], [6, 12], [40], [37, 43], [10, 11], [24], [25], [3, 45], [5, 10, 15]])
@pytest.mark.parametrize("first", [0, 1])
def test_missing_sheets_count_where_the_axis_is_the_middle(gone, first):
    """Still combs of 50 and 49 sheets with gaps. A failure means that every n is wrong, on both sides, where
    sheets of one side are not seen."""
    x = np.delete(comb(1, uneven=0.1), gone, axis=1)[:, first:]
    left = 25 - sum(one < 25 for one in gone) - first  # an odd comb has its axis on the first on the right
    numbering = number_sheets(np.repeat(x, 30, axis=0))
    assert (numbering.how, numbering.missing) == ("geometry", len(gone))
    np.testing.assert_array_equal(numbering.n, numbered(left, x.shape[1] - left))
    beside = 24 in gone or 25 in gone  # the gap next to the axis hides where in it the axis is
    assert numbering.axis_px == pytest.approx(600 + first * PITCH / 2, abs=(0.6 if beside else 0.3) * PITCH)


@pytest.mark.parametrize("mirrored", [False, True])
def test_two_sheets_that_one_side_lacks_leave_the_axis_in_its_place(mirrored):
    """Two faint sheets on the left are not found, and the motion leaves the axis open. A failure means that
    the axis is one sheet aside, that n of the other side is wrong, or that the warning does not say so."""
    profile = strip_profile(open_video(HOSTILE / "video.mkv"))
    with xr.open_dataset(HOSTILE / "truth.nc", engine="h5netcdf") as truth:
        x_true, n_true = truth["x_px"].values.mean(axis=0), truth["n"].values
    if mirrored:
        profile = profile.isel(x=slice(None, None, -1)).assign_coords(x=profile["x"].values)
        x_true = profile["x"].values[-1] - x_true
    tracks = track_sheets(profile)
    assert tracks.attrs["axis_how"] == "geometry"
    assert tracks.attrs["axis_px"] == pytest.approx(599.5, abs=2.0)
    nearest = np.abs(x_true - tracks["x_mean_px"].values[:, None]).argmin(axis=1)
    short = n_true[nearest] - tracks["n"].values
    whole, lacking = (-1, 1) if mirrored else (1, -1)
    assert not short[tracks["side"].values == whole].any()
    assert sorted(set(short[tracks["side"].values == lacking])) == [0, 1, 2]
    (line,) = [line for line in tracking_warnings(tracks) if line.startswith("sheets may be missing")]
    assert "the axis" in line
    assert "n of both sides may be wrong" in line
    assert "`axis_px`" in line
    (line,) = [line for line in summary_lines(Results(tracks=tracks)) if line.startswith("axis")]
    assert "the middle of the ridges in view and 2 that seem to be missing" in line


@pytest.mark.parametrize("right", [True, False])
def test_one_side_in_view(right):
    """A failure means half of one block's sheets are counted as the other block's."""
    truth = comb(300, slip=0.85)
    tracks = tracked(truth[:, 25:] if right else truth[:, :25])
    assert (tracks.side == (1 if right else -1)).all()
    np.testing.assert_array_equal(tracks.n, numbered(0, 25) if right else numbered(25, 0))
    assert abs(tracks.attrs["axis_px"] - 600) < PITCH


def still_towards_the_axis(sides, vibration_px=0.15):
    """Sheets 1 to 25 on the right, or on both sides, of which only the outer ones move; the camera vibrates;
    the right side by half as much as the left one if there are both."""
    n, stick = np.arange(1, 26), np.arange(200)[:, None] % 20 / 20
    out = (n - 0.5) * PITCH - 3.0 * (n / 25) ** 6 * stick
    truth = 600 + (out if sides == 1 else np.c_[-out[:, ::-1], 0.5 * (out + out[:1])])
    rng = np.random.default_rng(1)
    return truth + rng.normal(0, vibration_px, (200, 1)) + rng.normal(0, 0.01, truth.shape)


@pytest.mark.parametrize("mirrored", [False, True])
def test_one_side_whose_inner_half_is_still(mirrored):
    """The camera vibrates, and the motion leaves the axis open. A failure means that the still half of one
    side is taken for the other side, which creeps the wrong way."""
    x = still_towards_the_axis(1)
    found = number_sheets(-x[:, ::-1] if mirrored else x)
    assert (found.side == (-1 if mirrored else 1)).all()
    np.testing.assert_array_equal(found.n, numbered(25, 0) if mirrored else numbered(0, 25))
    assert found.carried == "perhaps"
    blind = number_sheets(x, settings=TrackingSettings(still_half=0.0))
    assert len(np.unique(blind.side)) == 2


def test_one_side_whose_innermost_sheets_are_still():
    """The camera vibrates. The motion excludes the middle of the comb, which is whole in the picture, but not
    its inner end. A failure means 7 sheets on one side and 18 on the other, and half of the stiff shell."""
    n, stick = np.arange(1, 26), np.arange(400)[:, None] % 20 / 20
    x = 100 + (n - 0.5) * PITCH - 3.0 * (n / 25) ** 3 * stick
    for seed in range(10):
        rng = np.random.default_rng(seed)
        seen = x + rng.normal(0, 0.15, (400, 1)) + rng.normal(0, 0.01, x.shape)
        assert (number_sheets(seen, width_px=700).side == 1).all()


def test_two_sides_of_which_one_moves_half_as_much():
    """A failure means that the less mobile side is taken for the inner half of the other."""
    found = number_sheets(still_towards_the_axis(2))
    np.testing.assert_array_equal(found.n, numbered(25, 25))


@pytest.mark.parametrize("axis", [520.0, 600.0, 701.0])
def test_a_given_axis_is_kept(axis):
    """A failure means the user is overruled."""
    truth = comb(60)
    tracks = tracked(truth, axis_px=axis)
    assert tracks.attrs["axis_px"] == axis
    assert tracks.attrs["axis_how"] == "given"
    np.testing.assert_array_equal(tracks.side, np.where(np.median(truth, axis=0) < axis, -1, 1))
    left = int((np.median(truth, axis=0) < axis).sum())
    np.testing.assert_array_equal(tracks.n, numbered(left, 50 - left))


def test_vibration_does_not_move_the_axis():
    """A failure means a shaking camera decides which side a sheet is on."""
    truth = comb(300, slip=0.6) + np.random.default_rng(1).normal(0, 1.0, (300, 1))
    assert abs(tracked(truth).attrs["axis_px"] - 600) < PITCH / 2


@pytest.mark.parametrize("seed", range(1, 7))
def test_a_comb_that_every_slip_carries_along_keeps_its_axis(seed):
    """With every slip the whole comb is carried by up to a pitch, either way. A failure means that the few
    slips that carried it one way number all sheets from near one end."""
    truth = comb(300, slip=0.3)
    jump = np.abs(np.diff(truth[:, 0], prepend=truth[0, 0])) > 3.0
    carried = np.random.default_rng(seed).uniform(-PITCH, PITCH, (300, 1)) * jump[:, None]
    noise = np.random.default_rng(seed).normal(0, 0.005, truth.shape)
    numbering = number_sheets(truth + np.cumsum(carried, axis=0) + noise)
    np.testing.assert_array_equal(numbering.n, numbered(25, 25))
    assert numbering.how == "geometry"
    assert numbering.low_px < 600 < numbering.high_px


def opening_comb(left, right, *, along=0.0, seed=1):
    """Positions of sheets of which the outermost creep inwards by 4 px in 30 frames, with a scatter of 15 %
    between sheets, while all move by `along` of that to the right."""
    rng, n = np.random.default_rng(seed), numbered(left, right)
    side = np.repeat([-1, 1], [left, right])
    share = (n / 25) ** 2 * (1 + 0.15 * rng.standard_normal(len(n)))
    phase = (np.arange(300)[:, None] % 30) / 30
    return (
        60 + PITCH * np.arange(len(n)) + 4.0 * phase * (along - side * share) + rng.normal(0, 0.01, (300, 1))
    )


@pytest.mark.parametrize("along", [-0.1, -0.02, 0.02, 0.1])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_comb_that_moves_along_with_its_opening(along, seed):
    """The load carries camera or sample along, and every slip returns them. A failure means that this numbers
    all sheets of a comb that is in view from end to end from another place than its middle."""
    truth = opening_comb(25, 25, along=along, seed=seed)
    whole = number_sheets(truth, width_px=int(truth[0, -1]) + 60)
    np.testing.assert_array_equal(whole.n, numbered(25, 25))
    assert whole.low_px - PITCH / 2 <= truth[0, 24:26].mean() <= whole.high_px + PITCH / 2
    crop = number_sheets(truth, width_px=int(truth[0, -1]) + 10)
    assert (crop.side != whole.side).any()


@pytest.mark.parametrize("along", [-1.6, 1.4, 1.6])
@pytest.mark.parametrize("sheets", [(25, 25), (18, 18), (0, 25), (25, 0), (0, 8)])
@pytest.mark.parametrize("seed", [1, 2])
def test_a_comb_that_is_carried_further_than_it_opens(sheets, along, seed):
    """Most sheets move alike. A failure means that both sides of a comb in view from end to end are taken for
    one, or one side, whose motion grows towards one end, for both."""
    both = sheets[0] == sheets[1]
    truth = opening_comb(*sheets, along=along if both else 0.0, seed=seed)
    found = number_sheets(truth, width_px=int(truth[0, -1]) + 60)
    assert abs(int((found.side < 0).sum()) - sheets[0]) <= (0 if both else 1)
    assert found.carried == ("yes" if both else "no")
    assert found.how == ("geometry" if both else "motion")


@pytest.mark.parametrize("cut", [2, 3])
@pytest.mark.parametrize("seed", range(6))
def test_the_middle_of_a_comb_that_is_cut_off_at_one_end_is_no_axis(cut, seed):
    """A failure means that the middle of what is in view is preferred to where the motion changes sign."""
    truth = opening_comb(8, 8, seed=seed)[:, cut:]
    numbering = number_sheets(truth - truth[0, 0] + 10, width_px=int(np.ptp(truth[0])) + 100)
    np.testing.assert_array_equal(numbering.n, numbered(8 - cut, 8))


@pytest.mark.parametrize("cut_left", [True, False])
@pytest.mark.parametrize("seed", range(10))
def test_an_axis_that_vibration_hides_is_near_the_middle_of_a_comb_that_lacks_one_sheet(cut_left, seed):
    """The camera vibrates, and the outermost sheet of one side is not in view. A failure means that n of all
    sheets changes by several when the picture cuts off one."""
    truth = opening_comb(25, 25, seed=seed) + np.random.default_rng(seed).normal(0, 0.4, (300, 1))
    truth = truth[:, 1:] - truth[0, 1] + 10 if cut_left else truth[:, :-1]
    numbering = number_sheets(truth, width_px=int(truth[0, -1]) + (100 if cut_left else 10))
    np.testing.assert_array_equal(numbering.n, numbered(24, 25) if cut_left else numbered(25, 24))
    assert abs(numbering.axis_px - truth[0, 23 + (not cut_left) :][:2].mean()) < PITCH / 4


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize(("left", "right"), [(25, 19), (17, 25)])
def test_a_whole_comb_with_unequal_sides_has_its_axis_from_motion(left, right, seed):
    """A failure means that the middle of the comb is preferred to what the motion shows."""
    truth = opening_comb(left, right, seed=seed)
    numbering = number_sheets(truth, width_px=int(truth[0, -1]) + 60)
    assert numbering.how == "motion"
    assert abs(int((numbering.side < 0).sum()) - left) <= 1


@pytest.mark.parametrize("seed", range(1, 7))
def test_avalanches_that_reach_a_part_of_the_comb_keep_the_axis_in_its_middle(seed):
    """Avalanches begin anywhere, run a sheet further in every frame, and end somewhere. A failure means that
    the side with the larger avalanches takes sheets of the other."""
    rng, side, n = np.random.default_rng(seed), np.sign(np.arange(50) - 24.5), numbered(25, 25)
    slipped = np.zeros((150, 50))
    for begin in range(10, 150, 30):
        from_first = np.abs(np.arange(50) - rng.integers(50))
        reached = from_first < rng.uniform(10, 50)
        slipped += reached * (np.arange(150)[:, None] >= begin + from_first)
    inwards = 6.0 * (n / 25) ** 2.3 * (np.arange(150)[:, None] / 30 - slipped)
    truth = 600 + side * ((n - 0.5) * PITCH - inwards) + rng.normal(0, 0.005, (150, 50))
    numbering = number_sheets(truth)
    assert numbering.low_px - PITCH < 600 < numbering.high_px + PITCH
    np.testing.assert_array_equal(numbering.n, n)


@pytest.mark.parametrize("mirrored", [False, True])
def test_one_side_leaves_its_end_to_the_axis(mirrored):
    """One side in view, whose slips are of the size of the noise or of a vibrating camera's motion. A failure
    means that the range which the motion allows ends within the sheets in view, though the axis is beyond."""
    rng, excluded = np.random.default_rng(3), 0
    for slip in (0.0, 0.02, 0.1):
        for vibration_px in (0.0, 0.1):
            for _ in range(10):
                truth = comb(60, slip=slip)[:, 25:]
                x = truth + rng.normal(0, 0.03, truth.shape) + rng.normal(0, vibration_px, (60, 1))
                found = number_sheets(1200 - x[:, ::-1] if mirrored else x)
                innermost = found.high_px < 590 if mirrored else found.low_px > 610
                excluded += bool(innermost)
    assert excluded <= 2  # of 60; noise that looks like a motion of the innermost sheets


@pytest.mark.parametrize("count", [1, 2, 3])
def test_hardly_any_sheets_are_numbered_all_the_same(count):
    """A failure means a close-up of a few sheets crashes or leaves sheets without a number."""
    tracks = tracked(comb(60, per_side=4, axis_px=150)[:, 4 - count // 2 :][:, :count], width=300)
    assert tracks.sizes["sheet"] == count
    assert np.isin(tracks.side, [-1, 1]).all() and (tracks.n >= 1).all()


def test_the_axis_of_an_odd_comb_lies_on_its_middle_sheet():
    """A failure means that the middle sheet changes sides, or its neighbours their n, when the axis that was
    reported is given back as `--axis`."""
    truth = comb(60, per_side=7, axis_px=300, slip=0.0)[:, :13]
    found = tracked(truth, width=600)
    middle = float(np.median(truth[:, 6]))
    assert found.attrs["axis_how"] == "geometry"
    assert middle - 0.03 * PITCH < found.attrs["axis_px"] < middle
    np.testing.assert_array_equal(found.n, numbered(6, 7))
    again = tracked(truth, width=600, axis_px=found.attrs["axis_px"])
    np.testing.assert_array_equal(again.n, found.n)
    np.testing.assert_array_equal(again.side, found.side)


def test_the_axis_is_not_on_the_middle_sheet_where_the_motion_excludes_it():
    """Seven sheets of which the third hardly moves. A failure means that the axis is said to be on the fourth
    since the number is odd, outside the range that the motion allows."""
    rest, opening = 100 + 160.0 * np.arange(7), np.array([-0.2, -0.05, 0.0, 0.08, 0.25, 0.5, 0.8])
    phase = np.arange(200)[:, None] / 23.7 % 1 - 0.5
    truth = rest - 20 * opening * phase
    numbering = number_sheets(truth + np.random.default_rng(1).normal(0, 0.01, truth.shape))
    assert rest[1] < numbering.low_px <= numbering.high_px < rest[3]
    assert abs(numbering.axis_px - numbering.low_px) < 100  # half a pitch is 80, a whole one wrong


def test_the_pixel_size_follows_from_the_mean_pitch():
    """Two in three spacings are 18 px wide, the third 24 px: 20 px in the mean, 18 px in the median, and one
    sheet is not seen. A failure means that lengths in µm are off by the comb's unevenness."""
    rest = 50 + np.r_[0, np.cumsum(np.tile([18.0, 18.0, 24.0], 6))]
    whole = tracked(np.broadcast_to(rest, (60, rest.size)), width=460)
    assert pixel_size_of(whole, pitch_um=200.0) == pytest.approx(10.0, rel=1e-3)
    seen = np.delete(rest, 7)  # 36 px between those beside it are no spacing of neighbours
    gap = tracked(np.broadcast_to(seen, (60, seen.size)), width=460)
    assert gap.sizes["sheet"] == seen.size
    near = np.delete(np.diff(rest), [6, 7])
    assert pixel_size_of(gap, pitch_um=200.0) == pytest.approx(200 / near.mean(), rel=1e-3)
    with pytest.raises(InputError, match="pitch_um"):
        pixel_size_of(whole, pitch_um=0.0)


def test_a_given_pixel_size_is_not_replaced_by_that_of_the_file():
    """A failure means that a wrong size, such as 0, is not reported but silently replaced."""
    rest = 50 + 20.0 * np.arange(12)
    stated = tracked(np.broadcast_to(rest, (30, 12)), width=320).assign_attrs(file_pixel_size_um=12.0)
    assert pixel_size_of(stated) == 12.0
    assert pixel_size_of(stated, pixel_size_um=0.0) == 0.0
    assert pixel_size_of(stated.assign_attrs(file_pixel_size_um=np.nan)) is None
