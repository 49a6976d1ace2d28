"""Errors that were measured: scenes with known truth."""

from itertools import product

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from tests.scenes.combs import comb, creeping, ridges, shaken_comb, strip
from vision.sheets import scatter, track_sheets
from vision.sheets.scatter import BetweenSlips, noise_excess, shared_error, spatial_scatter


def test_the_noise_is_measured_without_the_repeats():
    """Every frame twice, as from a codec that doubles the rate: the noise is still that of the frames."""
    _, picture = creeping()
    once = track_sheets(picture)
    twice = track_sheets(picture.isel(frame=np.repeat(np.arange(120), 2)).assign_coords(frame=np.arange(240)))
    assert (twice.flag.values == "frozen").mean() == pytest.approx(0.5, abs=0.01)
    assert twice.x_noise_px.median() == pytest.approx(float(once.x_noise_px.median()), rel=0.15)


def test_errors_are_never_zero():
    """A drawing without noise still holds errors above zero."""
    x, _ = creeping()
    tracks = track_sheets(strip(ridges(x, width=400), snr=1e9))
    assert (tracks.x_err_px.values > 0).all()


def test_scatter_between_sheets_sees_errors_that_persist():
    """Errors carried from frame to frame for ten frames: the scatter in time misses them."""
    rng = np.random.default_rng(5)
    x = comb(2000, slip=0.3) + np.repeat(rng.normal(0, 0.1, (200, 50)), 10, axis=0)
    assert np.median(spatial_scatter(BetweenSlips(x), between_frames=True)) == pytest.approx(0.1, rel=0.1)


def test_sheets_that_move_each_in_its_own_way_do_not_scatter():
    """Jumps and creep that differ by a tenth from sheet to sheet are motion: a failure means that compressed
    films of such sheets get errors ten times too large."""
    rng = np.random.default_rng(3)
    own = 1 + rng.normal(0, 0.1, 50)
    slips = np.cumsum(np.arange(400) % 40 == 39)[:, None]
    moving = 20 * np.arange(50) + own * (0.2 * np.arange(400)[:, None] - 8 * slips)
    x = moving + rng.normal(0, 0.02, moving.shape)
    assert np.median(spatial_scatter(BetweenSlips(x), between_frames=True)) == pytest.approx(0.02, rel=0.1)
    assert np.hypot(0.02, shared_error(BetweenSlips(x))) == pytest.approx(0.02, rel=0.1)
    straight = x - np.median(x, axis=0)
    assert np.std(straight[:, 2:-2] - (straight[:, 1:-3] + straight[:, 3:-1]) / 2) > 5 * 0.02


def test_slips_are_seen_while_the_camera_shakes():
    """By more than sheets slip.  A failure means that slips count as errors that sheets share."""
    rng = np.random.default_rng(4)
    slips = np.cumsum(np.arange(400) % 40 == 39)[:, None] * np.linspace(-0.5, 0.5, 50)
    x = 20 * np.arange(50) + slips + rng.normal(0, 0.5, (400, 1)) + rng.normal(0, 0.02, (400, 50))
    assert np.diff(BetweenSlips(x).slips)[38::40].all()
    assert np.median(noise_excess(BetweenSlips(x), np.full(x.shape, 0.02))) == pytest.approx(1, abs=0.1)


def test_a_part_of_a_long_film_tells_by_how_much_positions_scatter(monkeypatch):
    """Light that flickers makes every second frame noisier.  A failure means that errors of long films are
    those of its even frames, or take ten times as long."""
    rng = np.random.default_rng(8)
    noise_px = np.where(np.arange(16_000) % 2, 0.02, 0.06)[:, None] * np.linspace(1, 2, 12)
    x, err_px = 20 * np.arange(12) + rng.normal(0, noise_px), np.full(noise_px.shape, 0.02)
    counted, motion = [], scatter._motion
    monkeypatch.setattr(scatter, "_motion", lambda second: counted.append(len(second)) or motion(second))
    found = noise_excess(BetweenSlips(x), err_px)
    assert max(counted) < 5000
    monkeypatch.setattr(scatter, "SIZED_FRAMES", len(x))
    np.testing.assert_allclose(found, noise_excess(BetweenSlips(x), err_px), rtol=0.02)


@pytest.mark.parametrize(("period", "size"), [(8, 2.0), (20, 2.0), (20, 0.25)])
def test_slips_of_a_few_outer_sheets_are_no_noise(period, size):
    """On one side at a time, with creep between them.  A failure means that the slips of a third of the
    sheets enlarge the errors of all, five times and more."""
    slips = np.arange(200) % period == period - 1
    x = np.tile(60 + 20.0 * np.arange(30), (200, 1))
    for side, outer in enumerate((slice(0, 5), slice(25, 30))):
        own = slips & (np.cumsum(slips) % 2 == side)
        x[:, outer] += size * (np.cumsum(own) - own.mean() * np.arange(200))[:, None]
    tracks = track_sheets(strip(ridges(x, width=700)))
    off = tracks.x_px.values - x
    off = np.abs(off - np.mean(off, axis=0))
    assert 0.62 < (off < tracks.x_err_px.values).mean() < 0.74


@pytest.mark.parametrize(("period", "lasts"), [(2, 0.5), (12, 3), (30, 4)])
def test_slow_slips_are_no_noise(period, lasts):
    """Slips that last several frames, and one in every other frame.  A failure means that the motion of the
    outer sheets counts as an error of all, which is then twice to nine times too large."""
    frame, n = np.arange(200)[:, None], np.r_[np.arange(15, 0, -1), np.arange(1, 16)]
    since = np.clip(frame - np.arange(period / 2, 200, period), 0, None)
    slipped = (1 - np.exp(-since / lasts)).sum(axis=1) - np.arange(200) / period
    outwards = (n - 0.5) * 20 + 8 * (n / 15) ** 2.3 * slipped[:, None]
    x = 400 + np.repeat([-1, 1], 15) * outwards
    tracks = track_sheets(strip(ridges(x, width=800)))
    off = tracks.x_px.values - x
    off = np.abs(off - np.mean(off, axis=0))
    assert 0.62 < (off < tracks.x_err_px.values).mean() < 0.85


@pytest.mark.parametrize("seed", [1, 2])
def test_sheets_that_ring_after_slips_do_not_scatter(seed):
    """After every slip each sheet rings at a frequency of its own. A failure means that this motion, over in
    the later half of a stick, makes the errors of all positions half as large again."""
    random, since = np.random.default_rng(seed), np.arange(240)[:, None] % 40
    truth = comb(240, per_side=15, axis_px=320, slip=0.2, period=40)
    turns = since / random.uniform(3, 8, 30) + random.uniform(0, 1, 30)
    truth += random.uniform(0.3, 1.2, 30) * np.exp(-since / 5) * np.sin(2 * np.pi * turns)
    tracks = track_sheets(strip(ridges(truth, width=640), seed=seed))
    off = tracks.x_px.values - truth
    assert 0.9 < np.median(tracks.x_err_px.values) / np.std(off - np.median(off, axis=0)) < 1.2


def test_short_sticks_of_a_short_film_show_what_errors_leave_out():
    """Noise of twice the errors in 35 frames with three slips. A failure means that the later halves of the
    sticks, a few frames, make it seem a fifth smaller."""
    excess, moved = [], 0.1 * (np.arange(54) - 27)
    for seed, slips in product((1, 2, 3), ([8, 18, 29], [6, 15, 25], [7, 19, 29])):
        count = np.searchsorted(slips, np.arange(35), side="right")[:, None]
        noise = np.random.default_rng(seed).normal(0, 0.02, (35, 54))
        x = 14 * np.arange(54) + count * moved + noise
        excess.append(np.median(noise_excess(BetweenSlips(x), np.full(x.shape, 0.01))))
    assert np.mean(excess) == pytest.approx(2, rel=0.06)


def test_a_scatter_needs_frames_between_slips():
    """A comb that slips in every other frame leaves none to compare: nothing is stated, and nothing fails."""
    slips = np.cumsum(np.where(np.arange(30) % 2, 0.01, 5.0))[:, None] * np.linspace(0.5, 1, 12)
    x = 20 * np.arange(12) + slips
    assert np.isnan(spatial_scatter(BetweenSlips(x), between_frames=True)).all()
    assert shared_error(BetweenSlips(x)) == 0


def test_noise_that_differs_from_sheet_to_sheet_is_not_shared():
    """A failure means that motion, of sheets or of the camera, is taken for errors of a codec."""
    moving, noise = shaken_comb()
    excess = noise_excess(BetweenSlips(moving + noise), np.full(noise.shape, 0.02))
    assert np.median(excess) == pytest.approx(1, abs=0.1)
    assert shared_error(BetweenSlips(moving + noise)) < 0.4 * 0.02
    still = moving - moving.mean(axis=1, keepdims=True)
    assert shared_error(BetweenSlips(still + noise)) < 0.4 * 0.02


def test_errors_that_neighbours_share_are_counted():
    """Blocks that hold three sheets each, and all of them by as much: fourth differences see less than there
    is."""
    moving, noise = shaken_comb()
    blocks = np.repeat(np.random.default_rng(1).normal(0, 0.04, (400, 17)), 3, axis=1)[:, :50]
    blocks += np.random.default_rng(2).normal(0, 0.04, (400, 1))
    seen = np.median(spatial_scatter(BetweenSlips(moving + noise + blocks), between_frames=True))
    there = np.linalg.norm([0.02, 0.04, 0.04])
    assert seen < 0.8 * there
    assert np.hypot(seen, shared_error(BetweenSlips(moving + noise + blocks))) == pytest.approx(
        there, rel=0.15
    )


@pytest.mark.parametrize("bend", [0.5, 1.8])
def test_creep_that_bends_is_no_error_that_sheets_share(bend):
    """Sheets creep by up to 6 px in sticks of 40 frames, fast at first or at last.  A failure means that
    H.264 films of such sheets get errors three to ten times too large."""
    _, noise = shaken_comb()
    place, stick = np.linspace(-1, 1, 50), np.arange(400) % 40
    x = 525 + 500 * place - 6 * place * np.abs(place) * ((stick + 1) / 40)[:, None] ** bend + noise
    positions = BetweenSlips(x)
    scatter = np.median(spatial_scatter(positions, between_frames=True))
    assert 0.02 < np.hypot(scatter, shared_error(positions)) < 0.03


@pytest.mark.parametrize("skipped", [0.3, 0.5])
def test_a_shaking_that_a_codec_leaves_out_in_part_is_counted(skipped):
    """Every second frame is as its neighbours say, in this share of its blocks, as with B frames."""
    moving, noise = shaken_comb(shake=0.03)
    shown = moving + noise
    between = (shown[:-2] + shown[2:]) / 2
    blocks = np.repeat(np.random.default_rng(2).random((398, 17)) < skipped, 3, axis=1)[:, :50]
    odd = (np.arange(398) % 2 == 0)[:, None]
    shown[1:-1] = np.where(blocks & odd, between, shown[1:-1])
    there = np.std((shown - moving)[1:-1])
    seen = np.sqrt(np.mean(spatial_scatter(BetweenSlips(shown), between_frames=True) ** 2))
    assert np.hypot(seen, shared_error(BetweenSlips(shown))) == pytest.approx(there, rel=0.15)


def test_auto_takes_the_template_where_it_is_better_and_says_so():
    """A failure means that the less exact fit is taken, or another than the tables say."""
    x, picture = creeping(300)
    tracks = track_sheets(picture)
    assert (tracks.attrs["fit"], tracks.attrs["fit_asked"]) == ("template", "auto")
    error, sliding = (np.std(t.x_px.values - x) for t in (tracks, track_sheets(picture, fit="sliding")))
    assert error < 0.97 * sliding


@pytest.mark.parametrize("film", ["few frames", "still"])
def test_auto_keeps_to_sliding_where_no_shape_can_be_learned(film):
    """A failure means that a mean shape of one fraction of a pixel, or from a few frames, is trusted."""
    x = comb(40) + 0.0 if film == "few frames" else np.broadcast_to(comb(1), (300, 50))
    tracks = track_sheets(strip(ridges(x)))
    assert tracks.attrs["fit"] == "sliding"


def test_noise_alike_in_neighbouring_pixels_is_in_the_errors():
    """A camera that sharpens or resamples makes noise alike in neighbouring pixels: the pixels predict too
    small an error; what is stated must hold, and the prediction stay what it is."""
    x, picture = creeping(240)
    noise = np.random.default_rng(7).normal(0, 1, picture.shape)
    picture.values[:] += (noise + np.roll(noise, 1, axis=1) + np.roll(noise, 2, axis=1)) / np.sqrt(3)
    tracks = track_sheets(picture)
    off = np.abs(tracks.x_px.values - x - np.median(tracks.x_px.values - x, axis=0))
    assert 0.62 < (off < tracks.x_err_px.values).mean() < 0.74
    assert (off < tracks.x_predicted_px.values).mean() < 0.6


def test_noise_that_a_camera_sharpens_is_in_the_errors():
    """Sharpening makes noise opposite in neighbouring pixels. A failure means that the pixels predict the
    error, which is then far too large."""
    x, picture = creeping(240, snr=20)
    smooth = (np.roll(picture.values, 1, axis=1) + np.roll(picture.values, -1, axis=1)) / 2
    picture.values[:] += 2 * (picture.values - smooth)
    tracks = track_sheets(picture)
    off = np.abs(tracks.x_px.values - x - np.median(tracks.x_px.values - x, axis=0))
    assert 0.62 < (off < tracks.x_err_px.values).mean() < 0.8
    assert (off < tracks.x_predicted_px.values).mean() > 0.8


def turbulent(rng, x):
    """Shifts by air that is alike over some sheets and some frames, px, (frame, N)."""
    return 0.1 * gaussian_filter(rng.normal(size=x.shape), (1.0, 1.5)) * np.sqrt(4 * np.pi * 1.5)


def flickering(rng, x):
    """Shifts of leaning sheets by light that flickers in another phase in every row, px, (frame, N)."""
    lean = rng.normal(0, 0.1, x.shape[1])
    return lean * np.sin(2 * np.pi * 0.37 * np.arange(len(x)))[:, None]


def swaying(rng, x):
    """Shifts of leaning sheets by a camera that nods slowly, px, (frame, N)."""
    return rng.normal(0, 0.1, x.shape[1]) * np.sin(2 * np.pi * 0.05 * np.arange(len(x)))[:, None]


@pytest.mark.thorough
@pytest.mark.parametrize("shifts", [turbulent, flickering, swaying])
@pytest.mark.parametrize("seed", range(3))
def test_shifts_that_leave_no_trace_in_a_ridge_are_in_the_errors(shifts, seed):
    """A failure means that turbulent air, or flicker that differs between rows, moves sheets by ten stated
    errors, flag ok."""
    x = comb(200, per_side=15, axis_px=400, slip=0.2)
    truth_off = shifts(np.random.default_rng(seed), x)
    tracks = track_sheets(strip(ridges(x + truth_off, width=800), seed=seed))
    off = tracks.x_px.values - x
    off = np.abs(off - np.median(off, axis=0))
    err = tracks.x_err_px.values
    assert 0.55 < (off < err).mean() < 0.85
    assert (off > 5 * err).mean() < 1e-3
    assert (off < tracks.x_predicted_px.values).mean() < 0.4  # which the pixels do not tell


def test_a_sheet_that_moves_by_itself_does_not_scatter():
    """Two sheets swing through the film. A failure means that their own motion counts as their error."""
    x = comb(200, per_side=15, axis_px=400, slip=0.2)
    x[:, [7, 20]] += 3 * np.sin(np.arange(200) / 15)[:, None]
    tracks = track_sheets(strip(ridges(x, width=800)))
    usual = np.median(tracks.x_err_px.values, axis=0)
    assert (usual[[7, 20]] < 2.5 * np.median(usual)).all()


@pytest.mark.parametrize("shaken_px", [0.0, 4.0])
def test_the_errors_of_a_shaken_film_are_those_of_its_pixels(shaken_px):
    """What all sheets do together from frame to frame is no noise.  A failure means that displacements known
    to some hundredths of a pixel are given with errors of tenths."""
    random = np.random.default_rng(0)
    shaking = shaken_px * np.sin(1.9 * np.arange(150)) + 0.35 * shaken_px * random.normal(size=150)
    x = comb(150, per_side=12, axis_px=300) + shaking[:, None]
    tracks = track_sheets(strip(ridges(x, width=600), snr=150))
    off = tracks.x_px.values - x
    within = np.abs(off - np.median(off, axis=0)) < tracks.x_err_px.values
    assert 0.62 < within.mean() < 0.74


def test_a_sheet_that_a_cable_cuts_has_no_position():
    """A dark cable crosses the comb; its edges cut ridges beside those that it hides. Failure: what
    is left of a ridge is given as its place, pixels and many of its stated errors off; or that sheets
    further away lose positions."""
    truth = comb(150, per_side=25, axis_px=640, slip=0.2)
    picture = ridges(truth, width=1280)
    edges = 400 + 3 * np.arange(40)
    for frame, edge in enumerate(edges, start=50):
        picture[frame, edge : edge + 70] = -0.2
    tracks = track_sheets(strip(picture))
    off = np.abs(tracks.x_px.values - truth)
    given = np.isfinite(off)
    assert not (off > np.fmax(0.5, 6 * tracks.x_err_px.values))[given].any()
    clear = np.ones(truth.shape, bool)
    x = truth[50:90]
    clear[50:90] = (x < edges[:, None] - 12) | (x > edges[:, None] + 82)
    assert given[clear].mean() > 0.995
