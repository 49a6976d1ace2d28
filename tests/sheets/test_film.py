"""Repeated frames and motion during the exposure: scenes with known truth."""

import numpy as np
import pytest

from tests.scenes.combs import blurred, comb, creeping, ridges, strip
from vision.checks import tracking_warnings
from vision.data import TrackMetadata
from vision.sheets import track_sheets
from vision.sheets.film import gap_depth, repeated_frames
from vision.sheets.ridges import describe_ridges


@pytest.mark.parametrize("touched", [0.0, 0.05])
def test_repeated_frames_are_found_and_give_no_position(touched):
    """A failure means that a film whose codec froze is taken for one without noise."""
    _, picture = creeping()
    again = [10, 40, 41, 42, 90]
    for frame in again:
        noise = np.random.default_rng(frame).normal(0, touched, picture.shape[1])
        picture.values[frame] = picture.values[frame - 1] + noise
    tracks = track_sheets(picture)
    frozen = (tracks.flag.values == "frozen").all(axis=1)
    assert np.flatnonzero(frozen).tolist() == again
    assert np.isnan(tracks.x_px.values[again]).all()


def test_quiet_frames_of_a_moving_film_are_no_repeats():
    """Most frames move by pixels, some stand still: these have noise of their own."""
    x, _ = creeping()
    x = x + np.cumsum(np.where(np.arange(120) % 10 < 7, 3.0, 0.0) * (-1) ** np.arange(120))[:, None]
    assert not repeated_frames(strip(ridges(x, width=420)).values).any()


def averaged_in_time(picture, how):
    """The strip as a camera records it that mixes each frame with those before, or with both beside it."""
    picture, values = picture.copy(deep=True), picture.values.copy()
    if how in ("of two", "of three"):
        before = [np.vstack([values[:1]] * k + [values[: len(values) - k]]) for k in range(3)]
        picture.values[:] = np.mean(before[: 2 + (how == "of three")], axis=0)
    elif how == "median":
        picture.values[1:-1] = np.median([values[:-2], values[1:-1], values[2:]], axis=0)
    elif how:
        for frame in range(1, len(values)):
            picture.values[frame] = (1 - how) * values[frame] + how * picture.values[frame - 1]
    return picture


@pytest.mark.parametrize("how", [0.3, 0.6, "median", "of two", "of three"])
def test_frames_averaged_in_time_are_said_to_be(how):
    """A failure means that positions up to a pixel late after slips pass for precise to 0.01 px."""
    x = comb(240, per_side=12, axis_px=320, slip=0.25, period=40)
    tracks = track_sheets(averaged_in_time(strip(ridges(x, width=640), snr=60), how))
    off = np.abs(tracks.x_px.values - x)
    assert np.nanmax(off) > 0.15
    assert how == "median" or np.mean(off > 3 * tracks.x_err_px.values) < 0.03
    assert TrackMetadata.of(tracks).second_comb_err_px == 0
    (line,) = (line for line in tracking_warnings(tracks) if "averaged in time" in line)
    assert "noise reduction" in line


@pytest.mark.thorough
@pytest.mark.parametrize("period", [0, 3, 4, 5.5, 8, 13])
@pytest.mark.parametrize("size_px", [0.3, 3.0])
def test_frames_of_a_camera_that_vibrates_are_not_averaged(period, size_px):
    """Nor are those of one that shakes at random. A failure means warnings of films that are in order."""
    x, _ = creeping(240)
    time, random = np.arange(240)[:, None], np.random.default_rng(5)
    x = x + size_px * (np.sin(2 * np.pi * time / period) if period else random.standard_normal((240, 1)))
    for snr in (20, 200):
        assert TrackMetadata.of(track_sheets(strip(ridges(x, width=420), snr=snr))).noise_lasts == 0


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("period", [3.6, 5.2])
@pytest.mark.parametrize(("unequal", "size_px"), [(0.005, 0.4), (0.02, 0.2)])
def test_frames_that_vibrate_over_unequal_pixels_are_not_averaged(seed, period, unequal, size_px):
    """Pixels that differ in brightness come back after a period. A failure means a warning of a film in
    order, whose noise does not last."""
    rng, time = np.random.default_rng(seed), np.arange(200)[:, None]
    shaking = size_px * np.sin(2 * np.pi * time / rng.uniform(period, period + 1))
    x = comb(200, per_side=12, axis_px=320, slip=0.25, period=40) + shaking
    picture = strip(ridges(x, width=640), snr=200)
    picture.values[:] *= 1 + unequal * rng.normal(size=640)
    assert TrackMetadata.of(track_sheets(picture)).noise_lasts == 0


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("averaged", "lasts", "snr"), [(0.0, 30, 200), (0.4, 12, 60)])
def test_frames_of_sheets_that_ring_are_not_averaged(seed, averaged, lasts, snr):
    """After every slip each sheet rings at a frequency of its own, by up to 1.5 px. A failure means that a
    film in order is said to be averaged in time, or that one which is averaged is not."""
    rng, since = np.random.default_rng(seed), np.arange(300)[:, None] % 40 + 1
    rate, size_px = rng.uniform(0.6, 1.8, 24), 1.5 * rng.uniform(0.3, 1, 24)
    ringing = size_px * np.exp(-since / lasts) * np.sin(rate * since)
    x = comb(300, per_side=12, axis_px=320, slip=0.25, period=40) + ringing
    picture = strip(ridges(x, width=640, fwhm_px=3.5, flat_px=8.0), snr=snr)
    tracks = track_sheets(averaged_in_time(picture, averaged) if averaged else picture)
    assert (TrackMetadata.of(tracks).noise_lasts > 0) == (averaged > 0)


@pytest.mark.parametrize("seed", range(3))
def test_quiet_frames_of_a_film_that_vibrates_are_no_repeats(seed):
    """Nearly all frames differ by a pixel or more, and a few by chance by next to nothing: they count.

    The one frame that is repeated among them is found."""
    x, _ = creeping(240)
    rng = np.random.default_rng(seed)
    x = x + (2 * np.sin(2.1 * np.arange(240) + seed) + rng.normal(0, 0.3, 240))[:, None]
    picture = strip(ridges(x, width=420)).values
    assert not repeated_frames(picture).any()
    picture[77] = picture[76]
    assert np.flatnonzero(repeated_frames(picture)).tolist() == [77]


def test_a_camera_that_shakes_by_pixels_repeats_no_frame():
    """At one turning point two frames stand alike within a tenth of a pixel, which is more than noise, and
    nothing else comes near. Failure: a frame with a motion of its own has no position."""
    x, _ = creeping()
    x = x + 4.0 * (-1.0) ** np.arange(120)[:, None]
    x[60] = x[59] + 0.1
    picture = strip(ridges(x, width=440), snr=200).values
    assert not repeated_frames(picture).any()
    picture[60] = picture[59]
    assert np.flatnonzero(repeated_frames(picture)).tolist() == [60]


def slipping(slip_widths, *, fwhm=7.0, frames=240, seed=0):
    """Forty sheets, the outermost of which jump to and fro by so many widths within every sixth exposure, at
    a random time: two ridges drawn over each other. Truth is the mean over the exposure."""
    rng = np.random.default_rng(seed)
    rest = 60 + 25.0 * np.arange(40)
    size = slip_widths * fwhm * np.abs(np.arange(40) - 19.5) / 20
    slips = np.arange(frames) % 6 == 5
    after = np.cumsum(slips) % 2
    before = np.r_[0, after[:-1]]
    share = np.where(slips, rng.random(frames), 1.0)[:, None]
    first, last = (rest + state[:, None] * size for state in (before, after))
    light = share * ridges(first, width=1120, fwhm_px=fwhm)
    light += (1 - share) * ridges(last, width=1120, fwhm_px=fwhm)
    return share * first + (1 - share) * last, strip(light), slips


def test_errors_hold_in_frames_in_which_sheets_slip():
    """A failure means that sheets off by pixels in a slip frame claim hundredths: 62 to 74 in 100 truths are
    to lie within one error, over small and large slips."""
    inside, found = [], 0
    for slip in (0.5, 1.0, 1.5, 2.0):
        truth, picture, slips = slipping(slip)
        tracks = track_sheets(picture, sheets=40)
        inside.append((np.abs(tracks.x_px.values - truth) < tracks.x_err_px.values)[slips])
        found += (tracks.flag.values[slips] == "blurred").sum()
        assert not (tracks.flag.values[~slips] == "blurred").any()
    assert 0.62 < np.mean(inside) < 0.74
    assert found > 0.3 * np.size(inside)


def test_errors_hold_where_ridges_are_drawn_over_their_neighbours():
    """Slips of 0.6 to 1.1 pitches within one exposure: nothing is lower or wider, and only the sheets inside
    tell it. A failure means sheets called ok that are off by many times their error: every second once."""
    inside, gross = [], []
    for slip in (3.0, 4.0):
        truth, picture, slips = slipping(slip, seed=1)
        tracks = track_sheets(picture, sheets=40)
        far = slips[:, None] & (slip * 7 / 20 * np.abs(np.arange(40) - 19.5) > 0.6 * 25)
        error = np.abs(tracks.x_px.values - truth)
        known = far & np.isfinite(error)
        assert known.sum() > 0.7 * far.sum()
        inside += list((error < tracks.x_err_px.values)[known])
        gross += list((error > 5 * tracks.x_err_px.values + 0.2)[known])
    assert 0.58 < np.mean(inside) < 0.78
    assert np.mean(gross) < 0.02


@pytest.mark.parametrize("of_last", [0.2, 0.5])
def test_errors_hold_where_frames_are_blended(of_last):
    """Converters of frame rates mix two frames, and a ringing comb appears twice, often with one image where
    the frame before had one. A failure means that positions off by pixels claim tenths."""
    frame = np.arange(300)
    ringing = 40 * np.exp(-(frame % 75) / 20) * np.cos(2.1 * (frame % 75) + frame // 75)
    x = 100 + 100.0 * np.arange(7) + ringing[:, None]
    uneven = 1 + 0.1 * np.sin(np.arange(800) / 15)
    light = ridges(x, width=800, fwhm_px=14.0) * uneven
    mixed = (1 - of_last) * light + of_last * np.vstack([light[:1], light[:-1]])
    truth = (1 - of_last) * x + of_last * np.vstack([x[:1], x[:-1]])
    tracks = track_sheets(strip(mixed), sheets=7)
    off = np.abs(tracks.x_px.values - truth - np.nanmedian(tracks.x_px.values - truth, axis=0))
    assert np.isfinite(off).mean() > 0.8
    gross = (tracks.flag.values == "ok") & (off > 5 * tracks.x_err_px.values) & (off > 0.3)
    assert gross.mean() < 0.005


def test_without_the_blur_the_same_errors_fail():
    """The errors of the quiet frames hold few of the truths in slip frames: the scene is hard."""
    truth, picture, slips = slipping(1.5)
    tracks = track_sheets(picture, sheets=40)
    quiet = np.nanmedian(tracks.x_err_px.values[~slips], axis=0)
    assert (np.abs(tracks.x_px.values - truth) < quiet)[slips].mean() < 0.4


def test_sharp_slips_are_not_called_blurred():
    """A short exposure shows every slip sharply: nothing is to be flagged."""
    x = comb(200, slip=0.8)
    tracks = track_sheets(strip(ridges(x)))
    assert (tracks.flag.values == "blurred").mean() < 1e-3


def test_fast_slips_are_motion():
    """Slips every three frames: a failure means that their scatter from frame to frame is taken for noise."""
    frame = np.arange(120)[:, None]
    phase = (frame / 3 + 0.3 * np.sin(frame / 7)) % 1
    x = comb(120, per_side=8, axis_px=200, slip=0.0) + 3 * (phase - 0.5) * np.linspace(-1, 1, 16)
    lines = tracking_warnings(track_sheets(strip(ridges(x, width=400))))
    assert not any("hardly any sheet moves relative to the others" in line for line in lines)


@pytest.mark.parametrize(("slip", "said"), [(0.0, 1), (0.03, 0)])
def test_a_pattern_that_stands_still_is_not_taken_for_a_comb_in_silence(slip, said):
    """Wallpaper, a grille, a shaken one too, or a film that ends before the pull.  A failure means that who
    filmed the wrong thing is told of many sheets and their errors; or that slips of half a pixel are none."""
    shaking = np.random.default_rng(0).normal(0, 1.0, (60, 1))
    x = comb(60, per_side=8, axis_px=200, slip=slip) + shaking
    lines = tracking_warnings(track_sheets(strip(ridges(x, width=400))))
    assert sum("hardly any sheet moves relative to the others" in line for line in lines) == said


@pytest.mark.parametrize("sigma", [0.06, 0.15, 0.2, 0.25, 0.3])
def test_the_depth_of_gaps_shows_the_focus(sigma):
    """Gaussians of one height, whose depth of the gaps follows from their sum. A failure means that a film
    out of focus passes for one in focus, or the other way round."""
    near = np.exp(-0.5 * (np.arange(-8, 8.1, 0.5) / np.hypot(sigma, 0.13)) ** 2)
    depth = 1 - near[1::2].sum() / near[::2].sum()
    profile = blurred(sigma, unlike=0.0)
    found = track_sheets(profile, sheets=20)
    assert found.sizes["sheet"] == 20
    assert found.attrs["gap_depth"] == pytest.approx(depth, abs=0.06)


def test_gaps_of_sheets_without_a_position_have_no_depth():
    """A failure means that a film whose identities are all uncertain ends the run."""
    profile = blurred(0.1)
    comb = describe_ridges(profile.values)
    assert np.isnan(gap_depth(profile.values, np.full((30, 20), np.nan), comb))


@pytest.mark.parametrize("beyond_px", [10.0, 30.0])
def test_gaps_that_are_lit_are_not_out_of_focus(beyond_px):
    """A lit board behind sharp sheets ends half a spacing or more beyond them. A failure means that its light
    passes for blur, and that sheets are said to be merged."""
    x = comb(30, per_side=10, axis_px=250)
    columns = np.arange(500)
    board = (columns > x.min() - beyond_px) & (columns < x.max() + beyond_px)
    tracks = track_sheets(strip(ridges(x, width=500, contrast=0.3) + 1.0 * board, snr=100))
    assert tracks.sizes["sheet"] == 20
    assert np.isnan(tracks.attrs["gap_depth"])
