"""Spacings in which a sheet was overlooked are pointed out, and only those."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.scenes.combs import comb, ridges, strip
from vision.checks import consistency_warnings, tracking_warnings
from vision.data import TrackMetadata
from vision.errors import InputError
from vision.sheets import TrackingSettings, track_sheets, wide_spacings
from vision.sheets.reference import static_ridges


def without_one(k: int):
    """Sixteen sheets, one of which is hardly there."""
    truth = comb(60, per_side=8, axis_px=260, slip=0.2, uneven=0.08)
    return truth, strip(ridges(truth, width=520, contrast=np.where(np.arange(16) == k, 0.01, 1.0)))


def test_an_overlooked_sheet_is_pointed_out_where_it_is():
    """A failure means that numbers n are one off beyond a faint sheet, and nobody is told."""
    truth, picture = without_one(4)
    tracks = track_sheets(picture)
    assert tracks.sizes["sheet"] == 15
    said = [line for line in tracking_warnings(tracks) if line.startswith("sheets may be missing")]
    assert float(said[0].split("x = ")[1].split(" px")[0]) == pytest.approx(truth[:, 4].mean(), abs=4)


def test_a_given_number_settles_it():
    """A failure means that who has counted the sheets is still asked to."""
    _, picture = without_one(4)
    assert track_sheets(picture, sheets=15).attrs["wide_spacings"] == []


@settings(max_examples=40)
@given(seed=st.integers(0, 10_000), jitter=st.floats(0, 0.12), hole=st.integers(1, 48))
def test_even_combs_have_no_holes_and_a_missing_sheet_leaves_one(seed, jitter, hole):
    """A failure means false alarms on sound recordings, or holes that are not seen."""
    rng = np.random.default_rng(seed)
    x = 100 + 20 * (np.arange(50) + rng.uniform(-jitter, jitter, 50))
    assert not wide_spacings(x)[0].size
    middle, size = wide_spacings(np.delete(x, hole))
    assert middle == pytest.approx([x[hole]], abs=5)
    assert 1.5 < size[0] < 2.6


def test_a_ridge_in_a_wide_spacing_may_be_the_sheet():
    """A failure means that a sheet that nearly touches others is lost silently, or that dust is a sheet."""
    x = 20.0 * np.arange(30)
    x[15:] += 9.0  # 1.45 pitches: too little to tell by itself
    assert not wide_spacings(x)[0].size
    assert wide_spacings(x, np.array([294.0]))[0] == pytest.approx([294.5])
    assert not wide_spacings(x, np.array([110.0, -30.0, 700.0]))[0].size  # in usual spacings, and outside


def test_a_speck_far_outside_does_not_make_up_the_number():
    """A failure means that --sheets takes dust for the sheet that is missing, and renumbers the others."""
    truth = comb(60, per_side=8, axis_px=260, slip=0.2, uneven=0.08)
    speck = np.full((60, 1), truth.max() + 90)
    picture = strip(ridges(np.c_[truth, speck], width=560, contrast=np.r_[np.ones(16), 0.4]))
    assert track_sheets(picture, sheets=16).sizes["sheet"] == 16
    with pytest.raises(InputError, match="16 and 1 far outside"):
        track_sheets(picture, sheets=17)


@pytest.mark.parametrize("sheets", [16, 17])
def test_a_refused_number_names_one_that_is_tracked(sheets):
    """One of sixteen sheets is hardly there, and a speck lies far outside. A failure means that 16 is refused
    with another number of ridges than 17 is, or that no number that is named can be tracked."""
    truth = comb(60, per_side=8, axis_px=260, slip=0.2, uneven=0.08)
    speck = np.full((60, 1), truth.max() + 90)
    contrast = np.r_[np.where(np.arange(16) == 4, 0.01, 1.0), 0.4]
    picture = strip(ridges(np.c_[truth, speck], width=560, contrast=contrast))
    with pytest.raises(InputError, match=r"found 15 and 1 far outside .*`sheets` as 15 .*`axis_px`"):
        track_sheets(picture, sheets=sheets)
    (line,) = [one for one in tracking_warnings(track_sheets(picture)) if one.startswith("sheets may be")]
    assert "the 15 ridges found" in line
    assert track_sheets(picture, sheets=15).sizes["sheet"] == 15


@pytest.mark.parametrize("away_px", [-9.5, 10.0])
@pytest.mark.parametrize("seed", [1, 2])
def test_a_mark_beside_sheets_that_hardly_move_has_no_position(away_px, seed):
    """A stamp brighter than the sheets, half way from one to the next, hides them; they creep by a tenth of a
    pixel, too little to tell from whole pixels. A failure means that the stamp is given as a sheet."""
    truth = comb(120, per_side=8, axis_px=260, slip=0.03, uneven=0.12, seed=seed)
    mark = np.full((120, 1), truth[:, 3].mean() + away_px)
    picture = strip(ridges(truth, width=520) + 1.5 * ridges(mark, width=520, fwhm_px=9.0))
    for least, stamped in ((TrackingSettings().mark_distorted, False), (np.inf, True)):
        settings = TrackingSettings(mark_distorted=least, most_distorted=np.inf, wide_by_a_gap=np.inf)
        tracks = track_sheets(picture, settings=settings)
        ok = tracks.flag.values == "ok"
        off = np.abs(tracks.x_px.values[..., None] - truth[:, None]).min(axis=2)
        assert (off[ok] > 4).any() == stamped
        assert ok.sum() >= 14 * 120


@pytest.mark.parametrize("slip", [0.3, 0.03])
@pytest.mark.parametrize("right", [True, False])
def test_a_ruler_beside_the_comb_is_not_tracked(slip, right):
    """Ticks at half the sheets' spacing stand beside the comb. A failure means that they are given as sheets,
    though they never move; or that a side of the comb that stands apart and still is taken for a ruler."""
    truth = comb(120, per_side=8, axis_px=400, slip=slip, uneven=0.05)
    ticks = np.arange(60, 210, 10.0)
    places = np.c_[np.tile(ticks, (120, 1)), truth]
    picture = ridges(places, width=800, fwhm_px=5.0)
    tracks = track_sheets(strip(picture[:, ::-1] if right else picture))
    x = tracks.x_px.values
    x = (799 - x)[:, ::-1] if right else x
    given = np.isfinite(x)
    assert given.sum() == truth.size
    assert (np.abs(x[given].reshape(truth.shape) - truth) < 1).all()
    moved = truth[:, :7:-1] - truth[:, :7:-1].mean(axis=0)
    apart = np.c_[np.tile(60 + 20.0 * np.arange(5), (120, 1)), 220 + 20 * np.arange(8) + moved]
    assert np.isfinite(track_sheets(strip(ridges(apart, width=800))).x_px.values).all()


@pytest.mark.parametrize("spacing", [np.linspace(10, 45, 40), np.linspace(50, 10, 40)])
def test_sheets_filmed_at_an_angle_are_all_kept(spacing):
    """Perspective narrows the spacings along the comb.  A failure means that the narrowest are taken for dust
    between sheets, and n is wrong from there on."""
    moved = comb(60, per_side=20, slip=0.1)
    truth = 30 + np.cumsum(spacing) + moved - moved.mean(axis=0)
    tracks = track_sheets(strip(ridges(truth, width=int(spacing.sum() + 80), fwhm_px=6.0)))
    assert tracks.x_px.shape == truth.shape
    assert (np.abs(tracks.x_px.values - truth) < 1).all()


@pytest.mark.parametrize("per_side", [3, 4, 6])
def test_dim_patches_that_move_along_between_sheets_are_none(per_side):
    """Wide patches of a fifth of the sheets' contrast are seen between some of them. A failure means that
    these make the comb uneven, so that they pass for sheets, and n of those further out is wrong."""
    pitch, width = 80.0, 160 * per_side + 120
    truth = comb(80, per_side=per_side, pitch_px=pitch, axis_px=width / 2)
    patches = truth[:, 1:-1:2] + 0.26 * pitch
    picture = ridges(truth, width=width, fwhm_px=8.0)
    tracks = track_sheets(strip(picture + ridges(patches, width=width, fwhm_px=15.0, contrast=0.2)))
    assert tracks.x_px.shape == truth.shape
    assert (np.abs(tracks.x_px.values - truth) < 1).all()


@pytest.mark.parametrize("seed", [0, 1])
def test_texture_beside_an_even_comb_is_no_sheet(seed):
    """Beside the comb, a background shows narrow stripes at about half of its spacing. A failure means that
    every second one is a sheet, since the comb is even without them."""
    rng = np.random.default_rng(seed)
    truth = comb(120, per_side=10, pitch_px=22.0, axis_px=350, slip=0.2, uneven=0.06, seed=seed)
    away = 5 + np.cumsum(rng.uniform(11.5, 13, (2, 8)), axis=1)
    beside = np.r_[truth[:, 0].min() - away[0], truth[:, -1].max() + away[1]]
    stripes = np.tile(beside, (120, 1)), rng.uniform(0.25, 0.35, 16)
    picture = ridges(truth, width=700, fwhm_px=8.0)
    picture += ridges(stripes[0], width=700, fwhm_px=3.3, contrast=stripes[1])
    assert track_sheets(strip(picture)).sizes["sheet"] == 20


@pytest.mark.parametrize("off", [0.0, 0.1, 0.3])
def test_dim_sheets_between_bright_ones_are_kept(off):
    """Every second sheet is five times dimmer, and nearer to one neighbour. A failure means that the bright
    ones pass for the whole comb."""
    truth = comb(60, per_side=9, pitch_px=24.0, axis_px=266)[:, :-1]
    truth[:, 1::2] += off * 24
    height = np.where(np.arange(17) % 2, 0.2, 1.0)
    assert track_sheets(strip(ridges(truth, width=532, contrast=height))).sizes["sheet"] == 17


def test_a_few_sheets_are_no_comb_to_compare_with():
    """A failure means that a handful of markers is said to lack one."""
    assert not wide_spacings(np.array([0.0, 20, 40, 80, 100, 120, 140]))[0].size


@pytest.mark.parametrize("right", [True, False])
def test_the_outermost_sheet_of_a_dense_comb_is_kept(right):
    """It stands close to the next, so that its ridge is low and narrow. A failure means that it is lost
    without a word, though it moves as a sheet does."""
    truth = comb(150, per_side=10, pitch_px=10.0, axis_px=150, slip=0.15)
    truth[:, 0] += 2.5
    picture = ridges(truth, width=300, fwhm_px=6.5)
    tracks = track_sheets(strip(picture[:, ::-1] if right else picture))
    assert tracks.sizes["sheet"] == 20


@pytest.mark.parametrize("period", [12.0, 16.0])
def test_a_stationary_pattern_behind_the_comb_is_not_tracked(period):
    """A fringe or a fabric of a tenth of the sheets' contrast is seen beside them. A failure means that its
    stripes become sheets outside the comb, and shift the axis."""
    truth = comb(150, per_side=15, pitch_px=16.0, axis_px=305)
    wave = 0.1 * np.sin(2 * np.pi * np.arange(610) / period)
    tracks = track_sheets(strip(ridges(truth, width=610) + wave))
    assert tracks.sizes["sheet"] == 30
    assert abs(TrackMetadata.of(tracks).axis_px - 305) < 8


@pytest.mark.parametrize(("per_side", "slip"), [(3, 0.3), (8, 0.1), (15, 0.3), (30, 0.03)])
def test_dim_outer_sheets_are_kept(per_side, slip):
    """The outermost sheets are four times, and the next two times dimmer than the others. A failure means
    that they are taken for a pattern beside the comb."""
    width = 40 * per_side + 120
    truth = comb(150, per_side=per_side, axis_px=width / 2, slip=slip)
    height = np.ones(2 * per_side)
    height[[0, -1]], height[[1, -2]] = 0.25, 0.5
    assert track_sheets(strip(ridges(truth, width=width, contrast=height))).sizes["sheet"] == 2 * per_side


def test_dim_sheets_of_the_stiff_centre_are_kept():
    """Only one side is in view, and its innermost sheets, which hardly move, lie in a shadow. A failure means
    that they are taken for a pattern beside the comb."""
    truth = comb(150, per_side=13, axis_px=40)[:, 13:]
    height = np.r_[0.15, 0.22, 0.35, 0.6, np.ones(9)]
    assert track_sheets(strip(ridges(truth, width=360, contrast=height))).sizes["sheet"] == 13


@pytest.mark.parametrize("slip", [0.15, 0.3])
def test_a_ridge_left_out_beyond_the_outermost_sheet_is_warned_of(slip):
    """The two outermost sheets stand so close that their ridges are no longer those of sheets. A failure
    means that the comb is short of them without a word. A speck on the lens, which does not move, is none."""
    truth = comb(150, per_side=10, pitch_px=10.0, axis_px=150, slip=slip)
    speck = ridges(np.full((150, 1), 44.0), width=300, fwhm_px=4.0, contrast=0.15)
    plain = consistency_warnings(track_sheets(strip(ridges(truth, width=300, fwhm_px=6.0) + speck)))
    assert not [line for line in plain if "beyond the outermost" in line]
    truth[:, 0] += 2.8
    tracks = track_sheets(strip(ridges(truth, width=300, fwhm_px=6.5)))
    assert tracks.sizes["sheet"] < 20
    assert [line for line in consistency_warnings(tracks) if "beyond the outermost" in line]


@pytest.mark.parametrize("first", [6, 34])
def test_a_part_that_slips_onto_the_next_sheets_is_named(first):
    """From frame 30 of 240 on, the sheets from `first` on are 0.72 pitches further left, one of them in one
    ridge with its neighbour. A failure means that the comb has a sheet too few, and those beyond take their
    neighbours' places, without a word, or that a comb that stays whole is warned of."""
    truth = comb(240, per_side=20, axis_px=430, slip=0.3, period=30)
    for slipped in (0.0, 0.72):
        truth[30:, first:] -= slipped * 20.0
        tracks = track_sheets(
            strip(ridges(truth, width=860, contrast=0.8 + 0.2 * np.sin(1.7 * np.arange(40))))
        )
        nearest = np.abs(tracks.x_px.values[..., None] - truth[:, None]).argmin(axis=2)
        assert (nearest[0] != nearest[-1]).any() == bool(slipped)
        told = [line for line in consistency_warnings(tracks) if "beyond the outermost" in line]
        assert bool(told) == bool(slipped)


@pytest.mark.parametrize("mirrored", [False, True])
def test_the_last_sheet_is_kept_where_the_light_falls_off(mirrored):
    """The light falls to a tenth along the comb, and the last sheet, as bright as those beside it, moves by
    a third of their motion. A failure means that a sheet which everybody sees is lost without a word. One of
    that brightness beside sheets in full light is a speck."""
    truth = comb(80, per_side=10, axis_px=260)
    truth[:, -1] = truth[:, -1].mean() + 0.3 * (truth[:, -1] - truth[:, -1].mean())
    falling = np.geomspace(1.0, 0.1, 20)
    for contrast, sheets in ((falling, 20), (np.r_[np.ones(19), falling[-1]], 19)):
        picture = ridges(truth, width=520, contrast=contrast)
        tracks = track_sheets(strip(picture[:, ::-1] if mirrored else picture))
        assert tracks.sizes["sheet"] == sheets


def test_an_innermost_sheet_near_a_stiff_one_is_no_mark():
    """One side in view: its last two sheets hardly move, the one before them slips far. A failure means that
    the last sheet is taken for dust as it is nearer to the next than usual, and all sheets count one too
    low, or that dust beside a sheet that moves is kept."""
    rest = np.r_[0, np.cumsum([30, 30, 30, 30, 30, 21])]
    phase = np.arange(150)[:, None] % 25 / 25 - 0.5
    moves = np.array([17, 12, 8, 8, 18, 1.6, 1.0])
    assert not static_ridges(moves * phase, rest).any()
    moves[-2:] = 12, 1
    assert np.flatnonzero(static_ridges(moves * phase, rest)) == [6]


def test_a_faint_bump_that_stands_still_beside_two_sheets_is_none():
    """Two sheets before a background with a faint bump. A failure means that it is the innermost of three
    sheets, without a warning."""
    x = [60, 120] - np.array([9.0, 2.0]) * (1 - np.arange(150)[:, None] % 25 / 25)
    light = ridges(x, width=260, fwhm_px=12) + ridges(np.full((150, 1), 200.0), width=260, contrast=0.2)
    assert track_sheets(strip(light)).sizes["sheet"] == 2
