"""Width, pitch, contrast and polarity of a comb; and the candidates of every frame."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.signal import find_peaks

from tests.scenes.combs import CONTRAST, blurred, comb, ridges, strip
from vision.checks import tracking_warnings
from vision.errors import InputError
from vision.figures import Results
from vision.sheets import track_sheets
from vision.sheets.ridges import describe_ridges, find_ridges, profile_noise
from vision.sheets.settings import TrackingSettings
from vision.signals import find_maxima, half_widths
from vision.summary import summary_lines

FRAMES, SHEETS, PITCH, FWHM = 40, 16, 20.0, 7.0


def drawn(*, sign=1, snr=100.0, fwhm_px=FWHM, width=520):
    truth = comb(FRAMES, per_side=SHEETS // 2, axis_px=width / 2, slip=0.2)
    return truth, strip(ridges(truth, width=width, fwhm_px=fwhm_px), sign=sign, snr=snr).values


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("fwhm", [4.0, 7.0, 9.0])
def test_a_known_comb_is_described_as_drawn(sign, fwhm):
    """A failure means that thresholds and windows, which follow these figures, are wrong."""
    _, profile = drawn(sign=sign, fwhm_px=fwhm)
    found = describe_ridges(profile)
    assert found.polarity == ("bright" if sign > 0 else "dark")
    assert found.fwhm_px == pytest.approx(fwhm, rel=0.12)
    assert found.pitch_px == pytest.approx(PITCH, abs=1)
    assert found.contrast == pytest.approx(CONTRAST, rel=0.15)
    assert found.noise == pytest.approx(CONTRAST / 100, rel=0.1)
    assert found.count == SHEETS


def test_noise_is_measured_beside_ridges_and_not_made_of_them():
    """A failure means that sharp ridges count as noise, and faint sheets are then missed."""
    _, clean = drawn(snr=1e6)
    assert profile_noise(clean) < 0.01
    white = np.random.default_rng(1).normal(0, 2.5, clean.shape).astype(np.float32)
    assert profile_noise(clean + white) == pytest.approx(2.5, rel=0.03)


def test_every_ridge_of_every_frame_is_a_candidate_at_its_pixel():
    """A failure means that fits start at the wrong pixel, or that sheets are missed."""
    truth, profile = drawn()
    found = find_ridges(profile, describe_ridges(profile))
    assert (found.count == SHEETS).all()
    assert np.abs(found.x_px - truth).max() <= 1
    np.testing.assert_allclose(found.contrast, CONTRAST, rtol=0.2)
    np.testing.assert_allclose(found.fwhm_px, FWHM, rtol=0.3)


@pytest.mark.parametrize("seed", range(5))
def test_the_ridges_of_a_frame_do_not_depend_on_the_frames_beside_it(seed):
    """A failure means that a ridge at the edge stands out from pixels of another frame."""
    rng = np.random.default_rng(seed)
    profile = gaussian_filter(rng.normal(size=(12, 200)), (0, 3), mode="nearest").astype(np.float32)
    profile += rng.normal(scale=0.1, size=(12, 1)).astype(np.float32)  # bright and dark edges in turn
    known = replace(describe_ridges(drawn()[1]), noise=0.01, contrast=20.0, fwhm_px=7.0)
    together = find_ridges(100 * profile, known)
    for k, frame in enumerate(100 * profile):
        alone = find_ridges(frame[None], known)
        for name in ("x_px", "contrast", "fwhm_px"):
            np.testing.assert_array_equal(
                getattr(together, name)[k, : alone.count[0]], getattr(alone, name)[0]
            )
        assert together.count[k] == alone.count[0]


def test_hot_pixels_edges_and_empty_frames_are_no_candidates():
    """A failure means that a defect of the sensor, the picture's rim or a lost frame passes for a sheet."""
    truth, profile = drawn()
    described = describe_ridges(profile)
    hot = profile.copy()
    hot[:, 20] += CONTRAST
    hot[:, -1] += CONTRAST
    hot[7] = np.nan
    found = find_ridges(hot, described)
    assert truth.min() > 40
    assert not (found.x_px < 40).any()
    assert found.count[7] == 0
    assert (np.delete(found.count, 7) == SHEETS).all()


def test_what_no_longer_stands_out_is_no_candidate():
    """The same ridges in forty times the noise: had these candidates too, thresholds would do nothing."""
    _, profile = drawn()
    noise = np.random.default_rng(2).normal(0, CONTRAST, profile.shape).astype(np.float32)
    loud = find_ridges(profile + noise, describe_ridges(profile + noise, sheets=SHEETS))
    assert loud.count.mean() < SHEETS / 2


@pytest.mark.parametrize("seed", range(60))
def test_maxima_are_those_of_scipy(seed):
    """A failure means that ridges are found, measured or left out by another rule than the documented one."""
    rng = np.random.default_rng(seed)
    levels, length = rng.integers(2, 12), rng.integers(3, 300)
    line = rng.integers(0, levels, length).astype(np.float32)  # plateaus, ties and equal neighbours
    if seed % 2:
        line += rng.normal(0, 1, length).astype(np.float32)
    reach, widest, least = int(rng.integers(4, 40)), int(rng.integers(1, 8)), rng.uniform(0.1, 3)
    whole = find_maxima(line, least_prominence=least, reach=length)
    near = find_maxima(line, least_prominence=least, reach=reach, widest=widest)
    for found, limits in ((whole, {}), (near, {"wlen": 2 * reach + 1, "plateau_size": (1, widest)})):
        at, facts = find_peaks(line, prominence=least, width=0.0, rel_height=0.5, **limits)
        np.testing.assert_array_equal(found.at, at)
        np.testing.assert_array_equal(found.prominence, facts["prominences"])
        np.testing.assert_allclose(half_widths(line, found), facts["widths"], atol=1e-11)


@pytest.mark.parametrize("sheets", [3, 4, 5])
def test_ridges_on_a_lit_base_are_not_one_wide_ridge(sheets):
    """A failure means that a film of few sheets on a lit block is given as one sheet as wide as the block."""
    x = comb(FRAMES, per_side=8, axis_px=260, slip=0.2)[:, 8 - sheets // 2 :][:, :sheets]
    columns = np.arange(520)
    base = (columns > x.min() - 12) & (columns < x.max() + 12)
    light = ridges(x, width=520, contrast=0.5) + 1.2 * base
    found = describe_ridges(strip(light).values)
    assert found.count == sheets
    assert found.pitch_px == pytest.approx(PITCH, abs=1)
    assert found.fwhm_px < 10


@pytest.mark.parametrize(("sigma", "seed"), [(0.3, 5), (0.32, 4)])
def test_ridges_on_the_light_of_a_blurred_comb(sigma, seed):
    """The light of twelve sheets out of focus is higher than what the ridges rise above it. A failure means
    that three or four of them describe the comb, and one or two sheets are found."""
    assert track_sheets(blurred(sigma, sheets=12, seed=seed)).sizes["sheet"] == 12


@pytest.mark.parametrize(
    ("unlike", "dark", "polarity", "said"),
    [
        (0.3, 0.0, "dark", False),
        (0.3, 0.2, "dark", True),
        (0.0, 0.2, "dark", True),
        (0.0, 0.32, "bright", False),
    ],
)
def test_a_background_that_seldom_says_anything_is_heard(unlike, dark, polarity, said):
    """Sheets, alike in width or not, with narrow gaps before a background that is halfway between them, and
    as dark as the gaps in a share of the frames. A failure means that gaps are taken for sheets without a
    word, or only because they are narrower, or that the background is heard though it says nothing."""
    rng = np.random.default_rng(2)
    width_px = 12 * (1 + unlike * rng.uniform(-1, 1, 16))
    first = 50 + np.r_[0, np.cumsum(width_px + 6)[:-1]]
    columns, frames = np.arange(380)[:, None], np.arange(100)[:, None]
    inside = ((columns >= first) & (columns < first + width_px)).any(axis=1)
    beside = (columns < first[0] - 6).T | (columns > first[-1] + width_px[-1] + 6).T
    level = np.where(beside, np.where(frames < 100 * dark, 0.0, 30.0), 60.0 * inside)
    picture = gaussian_filter(level, (0, 1.2)) + 40 + rng.normal(0, 0.5, level.shape)
    found = describe_ridges(picture.astype(np.float32))
    assert found.polarity == polarity
    assert ("says the opposite" in found.doubt) == said


@pytest.mark.parametrize("pitch", [2.6, 3.5])
def test_a_comb_that_is_too_fine_is_refused_for_that(pitch):
    """A failure means that who filmed it from too far away is sent to look at rows and rotation."""
    fine = comb(60, per_side=20, pitch_px=pitch, axis_px=100, slip=0.3)
    picture = strip(ridges(fine, width=200, fwhm_px=pitch / 2))
    with pytest.raises(InputError, match=f"a pattern of {pitch} px"):
        track_sheets(picture)
    with pytest.raises(InputError, match="none above the noise"):
        track_sheets(strip(np.zeros((60, 200))))


# --- which stripes are the sheets, where they are wider than the gaps ---------------------------------------


WIDTH = 480


def wide_sheets(*, shift_px=0.0, per_side=10, contrast=1.0, uneven=0.15, slip=0.3):
    """Sheets of 11 px at a pitch of 18 px, half as wide again as the gaps."""
    x = comb(FRAMES, per_side=per_side, pitch_px=18.0, axis_px=WIDTH / 2 + shift_px, uneven=uneven, slip=slip)
    return x, ridges(x, width=WIDTH, fwhm_px=3.0, flat_px=11.0, contrast=contrast)


def shades(sheets):
    return np.random.default_rng(4).normal(1, 0.15, sheets)


def chosen(light, sign):
    return describe_ridges(strip(light, sign=sign).values).polarity == ("bright" if sign > 0 else "dark")


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("shift_px", [-90.0, 0.0, 90.0])
def test_the_background_beside_the_comb_tells_sheets_from_gaps(sign, shift_px):
    """A failure means that gaps are measured where only one end of the comb is in view."""
    x, light = wide_sheets(shift_px=shift_px)
    assert ((x.min() > 40) & (x.max() < WIDTH - 40)) == (shift_px == 0)
    assert chosen(light, sign)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("seed", range(3))
def test_a_background_of_one_pitch_tells_sheets_from_gaps(seed, sign):
    """Sheets that touch and differ in height and width, before a background of one pitch at either end. A
    failure means that the narrow, even gaps between them are tracked without a word."""
    rng = np.random.default_rng(seed)
    x = comb(FRAMES, per_side=20, pitch_px=10.0, axis_px=207, uneven=0.06)
    width, height = (np.clip(rng.normal(1, scatter, 40), 0.5, 1.6) for scatter in (0.2, 0.35))
    light = ridges(x, width=415, fwhm_px=6.5 * width, contrast=height)
    found = describe_ridges(strip(light, sign=sign).values)
    assert found.polarity == ("bright" if sign > 0 else "dark")


@pytest.mark.parametrize("sign", [1, -1])
def test_a_given_polarity_that_takes_gaps_for_sheets_is_told(sign):
    """A failure means that the user of a wrong --ridges publishes the gaps and never learns of it."""
    _, light = wide_sheets()
    right, wrong = ("bright", "dark") if sign > 0 else ("dark", "bright")
    film = strip(light, sign=sign)
    for asked, likelier in (("auto", ""), (right, ""), (wrong, right)):
        tracks = track_sheets(film, ridges=asked)
        assert tracks.attrs["ridges_likelier"] == likelier
        said = next(line for line in summary_lines(Results(tracks=tracks)) if line.startswith("sheets"))
        assert (f"the {right} stripes look more like sheets" in said) == bool(likelier)


@pytest.mark.parametrize("sign", [1, -1])
def test_sheets_that_touch_do_not_turn_the_comb_over(sign):
    """Two sheets without a gap are one ridge, so that ridges are no more than gaps. A failure means that this
    turns sheets into gaps in a film whose ends are both in view."""
    x, _ = wide_sheets()
    x[:, 1] = x[:, 0] + 11.0
    assert chosen(ridges(x, width=WIDTH, fwhm_px=3.0, flat_px=11.0), sign)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("slip", [0.0, 0.6])
def test_a_comb_without_ends_is_known_by_what_varies(sign, slip):
    """A failure means that gaps are measured in a film that the comb fills from edge to edge."""
    x, light = wide_sheets(per_side=18, contrast=shades(36), slip=slip)
    assert x[:, 1].max() < 0
    assert x[:, -2].min() > WIDTH
    assert chosen(light, sign)


def test_sheets_of_a_comb_that_leaves_the_picture_are_measured():
    """A failure means that positions are those of gaps, which move by the mean of two sheets."""
    x, light = wide_sheets(contrast=shades(20))
    x = x + np.linspace(0, 90, FRAMES)[:, None]
    light = ridges(x, width=WIDTH, fwhm_px=3.0, flat_px=11.0, contrast=shades(20))
    found = track_sheets(strip(light)).x_px.values
    there = np.isfinite(found)
    away = np.abs(found[..., None] - x[:, None, :]).min(axis=2)
    assert there.mean() > 0.7
    assert away[there].max() < 0.5


@pytest.mark.parametrize(("fwhm_px", "gain", "noise"), [(11.0, 4, 0.0), (9.0, 6, 1.0)])
@pytest.mark.parametrize("uneven", [0.1, 0.15])
def test_gaps_of_an_overexposed_comb_are_no_sheets(uneven, fwhm_px, gain, noise):
    """Ridges whose tops are clipped to one level, with a codec's noise or without, are wider than the gaps,
    which then differ more in brightness than they do. A failure means that positions are those of gaps."""
    x = comb(FRAMES, per_side=10, pitch_px=20.0, axis_px=WIDTH / 2, uneven=uneven, slip=0.3)
    film = strip(ridges(x, width=WIDTH, fwhm_px=fwhm_px, contrast=shades(20)))
    of_codec = np.random.default_rng(3).normal(0, noise, film.shape)
    film = film.copy(data=(np.minimum(gain * (film.values - 25), 250) + of_codec).astype(np.float32))
    tracks = track_sheets(film)
    assert tracks.attrs["ridges"] == "bright"
    assert polarity_warnings(tracks) == []
    assert np.nanmedian(np.abs(tracks.x_px.values[..., None] - x[:, None]).min(axis=2)) < 0.3


def test_gaps_of_a_comb_that_is_overexposed_in_part_are_no_sheets():
    """The brighter half of the sheets reaches the ceiling, through a codec that adds noise. A failure means
    that every position is that of a gap, or that a film whose background is clear is questioned."""
    x = comb(FRAMES, per_side=10, pitch_px=20.0, axis_px=WIDTH / 2, uneven=0.15, slip=0.3)
    film = strip(ridges(x, width=WIDTH, fwhm_px=12.0, contrast=shades(20)))
    noise = np.random.default_rng(3).normal(0, 2, film.shape)
    film = film.copy(data=(np.minimum(4 * (film.values - 25), 4 * CONTRAST + 28) + noise).astype(np.float32))
    tracks = track_sheets(film)
    assert tracks.attrs["ridges"] == "bright"
    assert polarity_warnings(tracks) == []


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("seed", range(6))
def test_sheets_of_unlike_widths_that_fill_the_picture_are_told_from_gaps(seed, sign):
    """Flat sheets as wide as the gaps, which differ a little in width and brightness: neither narrowness nor
    what varies decides alone. A failure means that one of them does, and every position is that of a gap."""
    x = comb(FRAMES, per_side=18, pitch_px=16.0, axis_px=WIDTH / 2, uneven=0.03, seed=seed)
    rng = np.random.default_rng(seed)
    shade, flat = rng.normal(1, 0.06, 36), rng.normal(8, 0.72, 36)
    sheets = (
        ridges(x[:, [n]], width=WIDTH, fwhm_px=5.0, flat_px=flat[n], contrast=shade[n]) for n in range(36)
    )
    assert chosen(sum(sheets), sign)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_lit_field_that_ends_beside_the_comb_is_not_the_background(sign):
    """Dark sheets before a lamp that is a little wider than the comb; beyond the lamp it is dark again. A
    failure means that the bright gaps are taken for sheets."""
    x, light = wide_sheets(contrast=0.6 * shades(20))
    columns = np.arange(WIDTH)
    lamp = (columns > x.min() - 20) & (columns < x.max() + 20)
    assert chosen(light - 0.6 * lamp, sign)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("seed", [0, 3])
def test_gaps_that_open_and_close_in_a_surround_like_the_sheets_are_doubted(seed, sign):
    """Wide dark sheets before a lamp that ends with them, which shines through the gaps unequally: all but
    the changes of the widths in time speaks for the narrow bright gaps. A failure means that nobody is
    told."""
    random = np.random.default_rng(seed)
    x = comb(FRAMES, per_side=10, pitch_px=18.0, axis_px=WIDTH / 2, slip=0.6, uneven=0.03, seed=seed)
    flat, columns = random.normal(11, 0.9, 20), np.arange(WIDTH)
    sheets = sum(ridges(x[:, [n]], width=WIDTH, fwhm_px=2.0, flat_px=flat[n]) for n in range(20))
    lamp = np.interp(columns, x.mean(axis=0), 1 + 0.15 * random.normal(size=20))
    lamp *= (columns > x.min() - 4) & (columns < x.max() + 4)
    found = describe_ridges(strip(lamp * (1 - 0.85 * sheets), snr=200, sign=sign).values)
    assert found.polarity == ("bright" if sign > 0 else "dark")
    assert "change their widths" in found.doubt


def boards(x, *, away_px):
    """Light of boards as bright as a sheet, whose edges stand this far beyond the outermost sheets."""
    columns = np.arange(WIDTH)
    beyond = np.fmax(x[:, :1] - away_px - columns, columns - x[:, -1:] - away_px)
    return 1 / (1 + np.exp(-np.clip(beyond, -30, 30)))


def polarity_warnings(tracks):
    return [line for line in tracking_warnings(tracks) if "stripes are taken for the sheets" in line]


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(("fwhm", "away_px"), [(5.0, 10.0), (5.0, 14.0), (6.0, 16.0), (7.0, 14.0)])
def test_boards_beside_the_comb_are_not_its_background(sign, fwhm, away_px):
    """Narrow sheets between two boards as bright as they are (or as dark). A failure means that every
    position is that of a gap, or that nobody is told that the evidence is contradictory."""
    x = comb(FRAMES, per_side=10, pitch_px=16.0, axis_px=WIDTH / 2, uneven=0.12)
    light = ridges(x, width=WIDTH, fwhm_px=fwhm, contrast=np.random.default_rng(8).normal(1, 0.08, 20))
    film = strip(light + boards(x, away_px=away_px), sign=sign)
    tracks = track_sheets(film)
    found = tracks.x_px.values
    away = np.abs(found[..., None] - x[:, None, :]).min(axis=2)
    assert np.isfinite(found).mean() > 0.9
    assert np.nanmedian(away) < 0.1
    (line,) = polarity_warnings(tracks)
    assert "`ridges`" in line
    assert "background" in line
    # Evidence that is too little to overrule the background is told all the same.
    trusting = describe_ridges(film.values, settings=TrackingSettings(clear_evidence=math.inf))
    assert trusting.polarity == ("dark" if sign > 0 else "bright")
    assert "background" in trusting.doubt


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("scatter", [0.0, 0.03, 0.05])
@pytest.mark.parametrize(("fwhm", "flat_px"), [(6.0, 0.0), (7.0, 0.0), (8.0, 0.0), (3.5, 9.0), (3.5, 10.0)])
def test_equal_sheets_that_fill_the_picture_are_told_from_gaps(sign, scatter, fwhm, flat_px):
    """Where the flanks of sheets overlap, gaps differ in level and sheets do not. A failure means that every
    position is that of a gap."""
    x = comb(FRAMES, per_side=18, pitch_px=16.0, axis_px=WIDTH / 2, uneven=0.12)
    shade = np.random.default_rng(8).normal(1, scatter, 36)
    assert chosen(ridges(x, width=WIDTH, fwhm_px=fwhm, flat_px=flat_px, contrast=shade), sign)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_close_call_between_sheets_and_gaps_is_a_warning_unless_given(sign):
    """Equal sheets as wide as the gaps, with no end of the comb in view. A failure means that gaps may be
    measured and nobody is told, or that a decision by hand is doubted."""
    x = comb(FRAMES, per_side=18, pitch_px=16.0, axis_px=WIDTH / 2, uneven=0.12)
    film = strip(ridges(x, width=WIDTH, fwhm_px=9.0), sign=sign)
    (line,) = polarity_warnings(track_sheets(film))
    assert "no clear background" in line
    assert not polarity_warnings(track_sheets(film, ridges="bright" if sign > 0 else "dark"))


def two_bands(left_px):
    """Two bright bands that vibrate, 8 px wide, with a gap as wide, and `left_px` columns left of them."""
    columns, frames = np.arange(40 - 5 + left_px), np.arange(FRAMES)[:, None]
    at = columns - left_px - 0.5 * np.sin(frames)
    level = 30 + 165.0 * (((at > 0) & (at < 8)) | ((at > 16) & (at < 24))) + 50.0 * (at > 24)
    noise = np.random.default_rng(3).normal(0, 0.3, level.shape)
    return (gaussian_filter(level, (0, 0.8)) + noise).astype(np.float32)


@pytest.mark.parametrize("left_px", [2, 3, 5, 12])
def test_the_edge_of_the_picture_makes_no_narrow_ridges(left_px):
    """However much of the background is in view, the bands are bright and 8 px wide. A failure means that
    what the picture's edge leaves of a gap is taken for narrow dark ridges, which are tracked instead."""
    found = describe_ridges(two_bands(left_px))
    assert found.polarity == "bright"
    assert found.fwhm_px == pytest.approx(8, abs=0.5)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("phase", [0.0, 0.3, 0.6])
def test_few_stripes_as_wide_as_their_gaps_are_doubted(sign, phase):
    """Three or four stripes of a vibrating pattern, which fill the picture. A failure means that chance
    decides which are tracked, and nobody is told."""
    x = 7.0 * (np.arange(-1, 6) + phase) + np.random.default_rng(1).normal(0, 0.02, (FRAMES, 1))
    tracks = track_sheets(strip(ridges(x, width=28, fwhm_px=3.5), sign=sign))
    (line,) = polarity_warnings(tracks)
    assert "nearly as wide" in line


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("shift_px", [-90.0, 0.0, 90.0])
def test_thick_sheets_before_a_background_are_not_doubted(sign, shift_px):
    """A failure means a warning on clear films: nobody reads the next one."""
    _, light = wide_sheets(shift_px=shift_px)
    assert not describe_ridges(strip(light, sign=sign).values).doubt


@pytest.mark.parametrize("sign", [1, -1])
def test_sheets_of_different_shades_that_fill_the_picture_are_not_doubted(sign):
    """A failure means a warning on clear films: nobody reads the next one."""
    _, light = wide_sheets(per_side=18, contrast=shades(36))
    assert not describe_ridges(strip(light, sign=sign).values).doubt


@pytest.mark.parametrize("phase", [2.8, 3.5])
@pytest.mark.parametrize("seed", range(3))
def test_a_background_on_the_slope_of_the_light_does_not_turn_faint_sheets_into_gaps(phase, seed):
    """Sheets of 2.5 grey levels in light that varies by up to 15 along the picture: beside the comb it is as
    bright as the sheets, or as dark as the gaps, because of the light alone.  A failure means that gaps are
    tracked without a warning."""
    rng = np.random.default_rng(seed)
    x = comb(60, per_side=16, pitch_px=12, axis_px=240, uneven=0.05)
    width, height = (np.exp(rng.normal(0, scatter, 32)) for scatter in (0.1, 0.05))
    light = 60 + 15 * np.sin(3 * np.arange(480) / 480 + phase)
    profile = light + 2.5 * ridges(x, width=480, fwhm_px=5.5 * width, contrast=height)
    found = describe_ridges((profile + rng.normal(0, 0.13, profile.shape)).astype(np.float32))
    assert found.polarity == "bright"
    assert "no clear background" in found.doubt


def in_turn(fwhm_px, *, dark=0.8, per_side=12, **how):
    """White and black sheets in turn on grey, the black ones less dark than the others are bright."""
    x = comb(FRAMES, per_side=per_side, pitch_px=16.0, axis_px=WIDTH / 2, uneven=0.12)
    shade = np.random.default_rng(8).normal(1, 0.08, 2 * per_side)
    shade[1::2] *= -dark
    return strip(0.7 * ridges(x, width=WIDTH, fwhm_px=fwhm_px, contrast=shade), sign=-1, **how)


def in_turn_warnings(film, **how):
    return [line for line in tracking_warnings(track_sheets(film, **how)) if "lie in turn" in line]


@pytest.mark.parametrize("fwhm", [4.0, 6.0, 7.0])
@pytest.mark.parametrize(("dark", "per_side"), [(1.0, 12), (0.6, 12), (1.0, 18)])
def test_white_and_black_sheets_in_turn_are_named(fwhm, dark, per_side):
    """A failure means that half of the sheets are counted in silence, or that a decision is doubted."""
    film = in_turn(fwhm, dark=dark, per_side=per_side)
    (line,) = in_turn_warnings(film)
    assert "two runs" in line
    assert not polarity_warnings(track_sheets(film))
    for given in ("bright", "dark"):
        assert not in_turn_warnings(film, ridges=given)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("fwhm", [2.5, 4.0, 6.0, 9.0, 11.0])
@pytest.mark.parametrize("per_side", [12, 18])
def test_sheets_and_gaps_do_not_pass_for_white_and_black_sheets(sign, fwhm, per_side):
    """A failure means a warning on clear films: nobody reads the next one."""
    x = comb(FRAMES, per_side=per_side, pitch_px=16.0, axis_px=WIDTH / 2, uneven=0.12)
    shade = np.random.default_rng(8).normal(1, 0.08, 2 * per_side)
    film = strip(ridges(x, width=WIDTH, fwhm_px=fwhm, contrast=shade), sign=sign)
    assert not in_turn_warnings(film)
