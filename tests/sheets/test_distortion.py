"""What pulls ridges aside is in their errors, and sheets that are several have no position."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from tests.scenes.combs import as_strip, comb, creeping, ridges, strip
from tests.scenes.degraded import SCENE
from tests.scenes.identity_cases import brightness
from vision.data import TrackMetadata
from vision.experiment import preset, profiles, with_settings
from vision.sheets import track_sheets
from vision.sheets.distortion import (
    NO_LOCKING,
    Distortion,
    PixelLocking,
    _significant,
    pixel_locking,
)
from vision.sheets.film import SecondComb
from vision.sheets.settings import DEFAULT, TrackingSettings


def beside_a_ridge(what):
    """Sixteen creeping sheets; in frames 40 to 80 something stands beside the sixth: a highlight that is no
    ridge itself, or a shadow on its flank. Truth, strip, and the frames."""
    x, picture = creeping()
    at = x[40:80, 5, None] + (12 if what == "highlight" else 5)
    away = (np.arange(picture.shape[1]) - at) / (12 if what == "highlight" else 3)
    light = np.exp(-(away**2) / 2)
    if what == "highlight":
        picture.values[40:80] += 90 * light
    else:
        picture.values[40:80] *= 1 - 0.5 * light
    return x, picture, slice(40, 80)


@pytest.mark.parametrize("what", ["highlight", "shadow"])
def test_ridges_that_are_pulled_aside_have_the_error_of_it(what):
    """A failure means that what stands beside a ridge moves it by tenths of a pixel, and its error says
    hundredths."""
    x, picture, beside = beside_a_ridge(what)
    tracks = track_sheets(picture)
    off, stated = np.abs(tracks.x_px.values - x), tracks.x_err_px.values
    assert np.median(off[beside, 5]) > 0.2
    assert (off[beside, 5] < 3 * stated[beside, 5]).mean() > 0.9
    assert float(tracks.distorted[5]) == pytest.approx(
        1 / 3, abs=0.11
    )  # means over nine frames reach further


def test_a_shadow_that_moves_with_its_sheet_shifts_all_positions_of_it():
    """A failure means that a constant shift is not stated, or is taken for an error of displacements."""
    x, picture = creeping(snr=100)
    away = (np.arange(picture.shape[1]) - x[:, 5, None] - 5) / 3
    picture.values[:] *= 1 - 0.4 * np.exp(-(away**2) / 2)
    tracks = track_sheets(picture)
    off = np.median(tracks.x_px.values - x, axis=0)
    assert abs(off[5]) > 0.2
    assert 0.25 < float(tracks.x_lasting_px[5]) / abs(off[5]) < 2
    assert float(tracks.x_err_px[:, 5].median()) < 0.2 * abs(off[5])
    assert (np.delete(tracks.x_lasting_px.values, 5) == 0).all()


def test_ridges_that_nothing_pulls_keep_their_errors():
    """The same film without it, and the film's other sheets: nothing is distorted, noisy or not."""
    for snr in (10, 30, 100):
        tracks = track_sheets(creeping(snr=snr)[1])
        assert float(tracks.distorted.max()) < 0.01
    _, picture, _ = beside_a_ridge("shadow")
    assert float(track_sheets(picture).distorted.values[np.r_[:4, 8:16]].max()) < 0.01


@pytest.mark.parametrize("moving", [False, True])
def test_light_that_falls_off_over_a_ridge_is_in_its_error(moving):
    """A stain on the window that sheets move under, or the edge of a shadow that moves over them: a Gaussian
    times such light is a Gaussian again, and shifted. A failure means that no error says so: from the shape
    alone one in a hundred, and one in twenty, are gross errors called ok."""
    x = comb(200, per_side=13, axis_px=310, slip=0.6)
    at, column = 310 - 3 * np.arange(200)[:, None] if moving else 80.0, np.arange(620)
    light = (
        1 - 0.5 / (1 + np.exp((column - at) / 5)) if moving else 1 - 0.6 * np.exp(-(((column - at) / 6) ** 2))
    )
    tracks = track_sheets(strip(ridges(x, width=620) * light, snr=60))
    error = tracks.x_px.values - x
    error -= np.nanmedian(error, axis=0)
    gross = np.abs(error) > np.fmax(5 * tracks.x_err_px.values, 0.2)
    assert gross.mean() < 0.004
    assert (np.abs(error) > 0.2).mean() > 0.01
    assert (tracks.flag.values == "ok").mean() > 0.99


def off_in_errors(picture, x, *, sheets=None):
    """Displacements measured less true ones, rms, in stated errors."""
    tracks = track_sheets(picture, sheets=sheets)
    off = tracks.x_px.values - x
    return np.sqrt(np.mean(((off - np.median(off, axis=0)) / tracks.x_err_px.values) ** 2))


def off_unchecked(monkeypatch, picture, x):
    """The same where no ridge is checked for distortion, nor the film for a second comb."""
    monkeypatch.setattr("vision.sheets.tracks.second_comb", lambda *_: SecondComb())
    monkeypatch.setattr("vision.sheets.tracks.distortion", lambda _, x_px, *__: Distortion.none(x_px))
    return off_in_errors(picture, x)


def test_a_lamp_that_moves_is_in_the_error(monkeypatch):
    """A failure means that light whose slope over the comb changes shifts all sheets by twice their stated
    errors, as it does without the term for it."""
    x = comb(200, per_side=8, axis_px=200)
    slope = 0.5 * np.sin(np.arange(200) / 40)[:, None] * np.linspace(-1, 1, 400)
    picture = strip(ridges(x, width=400))
    picture.values[:] = picture.values * (1 + slope)
    assert off_in_errors(picture, x) < 1.4
    assert off_unchecked(monkeypatch, picture, x) > 2


def test_light_that_tilts_at_random_from_frame_to_frame_is_in_the_error():
    """All sheets shift alike, which passes for motion of the camera. A failure means that fewer than
    half of the positions are within their stated errors."""
    x = comb(200, per_side=16, axis_px=320, slip=0.3)
    picture = strip(ridges(x, width=640), snr=150)
    tilt = 0.3 * np.random.default_rng(1).standard_normal((200, 1))
    picture.values[:] *= 1 + tilt * np.linspace(-1, 1, 640)
    tracks = track_sheets(picture)
    off = tracks.x_px.values - x
    within = np.abs(off - np.median(off, axis=0)) <= tracks.x_err_px.values
    assert 0.64 < within.mean() < 0.76


@pytest.mark.parametrize("lopsided", [0.0, 0.4])
def test_ridges_lopsided_alike_are_not_distorted(lopsided):
    """A shoulder that every sheet has is its shape: it moves no sheet against another."""
    x, _ = creeping()
    picture = strip(ridges(x, width=400) + lopsided * ridges(x + 5, width=400))
    assert float(track_sheets(picture).distorted.max()) < 0.01


def test_narrow_ridges_between_broad_ones_are_not_distorted():
    """Their neighbours' flanks are a slope of the light that moves with them. A failure means errors of 0.3
    to 0.6 px of sheets that are off by 0.02 px."""
    changes = {**SCENE, "optics.fwhm_px": 11}
    picture, truth = profiles(with_settings(preset("paper", seed=32), changes))
    tracks = track_sheets(picture)
    off = tracks.x_px.values - truth.x_px.values
    assert np.std(off - off.mean(axis=0), axis=0).max() < 0.05
    assert np.median(tracks.x_err_px.values, axis=0).max() < 0.05


@pytest.mark.parametrize("seed", [1, 2])
def test_a_reflection_that_moves_over_all_ridges_is_in_their_errors(seed, monkeypatch):
    """A mirror image of a third of the light, moving against the comb, shifts every ridge by half a pixel.
    A failure means that it passes as the usual scatter of such ridges: nine in ten errors were gross."""
    x = comb(200, per_side=13, axis_px=310, slip=0.5)
    image = 620 - x + 7 * np.sin(np.arange(200) / 20 + seed)[:, None]
    light = ridges(x, width=620) + 0.35 * ridges(image, width=620, fwhm_px=9)
    picture = strip(light, snr=80, seed=seed)
    assert 0.7 < off_in_errors(picture, x) < 2
    assert off_unchecked(monkeypatch, picture, x) > 5


@pytest.mark.parametrize("seed", [2, 3, 4])
def test_texture_that_moves_with_a_sheet_is_no_distortion(seed):
    """Each sheet has two lines of its own, bright or dark, half as high as the sheet. A failure means that
    some sheets have errors of many pixels, since their tops look nothing like those of the others."""
    x, rng = comb(200, per_side=10, axis_px=300, pitch_px=27), np.random.default_rng(seed)
    light = ridges(x, width=600, fwhm_px=2.5, flat_px=8)
    for away in rng.uniform(-4, 4, (2, x.shape[1])):
        light += ridges(x + away, width=600, fwhm_px=3, contrast=rng.choice([-0.5, 0.5], x.shape[1]))
    tracks = track_sheets(strip(light, snr=60, seed=seed))
    one_ridge = tracks.found.values > 0.9  # others look like two sheets
    off = (tracks.x_px.values - x)[:, one_ridge]
    off -= np.nanmedian(off, axis=0)
    stated, true = (np.sqrt(np.nanmean(v**2)) for v in (tracks.x_err_px.values[:, one_ridge], off))
    assert one_ridge.mean() >= 0.9
    assert true < 0.03
    assert stated < 1.5 * true


def thin_beside_thick(seed):
    """Sheets 7 px wide, and between some of them two to five that are 2.5 px wide and 5 px apart."""
    rng = np.random.default_rng(seed)
    place, width, at = [], [], 25.0
    while at < 600:
        if rng.uniform() < 0.6:
            place, width, at = [*place, at + 3], [*width, 7.0], at + 16
        else:
            thin = at + 5.0 * np.arange(rng.integers(2, 6))
            place, width, at = [*place, *thin], [*width, *[2.5] * len(thin)], thin[-1] + 11
    outer = (np.array(place) - 312) / 288
    phase = np.arange(150)[:, None] / 30 % 1 - 0.5
    x = np.array(place) - 4 * np.sign(outer) * outer**2 * phase
    light = ridges(x, width=640, fwhm_px=np.array(width), contrast=brightness(len(place), seed))
    return x, np.array(width), strip(light, snr=60, seed=seed)


def wrong_and_thick(tracks, x, width):
    """Positions called ok that are further from their sheet than half way to the next, and the share of the
    positions of thick sheets that are called ok."""
    found = np.where(tracks.flag.values == "ok", tracks.x_px.values, np.nan)
    found = found[:, np.isfinite(found).any(axis=0)]
    own = np.nanmedian(np.abs(found[:, :, None] - x[:, None]), axis=0).argmin(axis=1)
    half = np.diff(x[0], prepend=-np.inf, append=np.inf)
    half = np.minimum(half[1:], half[:-1]) / 2
    thick = width[own] == 7
    wrong = int((np.abs(found - x[:, own]) > half[own]).sum())
    return wrong, np.isfinite(found[:, thick]).sum() / len(x) / (width == 7).sum()


def test_the_middle_of_a_thick_and_a_thin_sheet_has_no_position():
    """Sheets 7.5 px wide, beside one of which stands another, 2.5 px wide, 5 px away: one ridge. A failure
    means that the place between both is given as the sheet's, with an error as large as the ridge."""
    x, _ = creeping()
    thin = x[:, 5:6] + 5.0
    light = ridges(x, width=400, fwhm_px=7.5) + ridges(thin, width=400, fwhm_px=2.5, contrast=1.4)
    for most, given in ((TrackingSettings().most_distorted, False), (np.inf, True)):
        tracks = track_sheets(
            strip(light), settings=TrackingSettings(most_distorted=most, mark_distorted=np.inf)
        )
        assert (tracks.flag.values[:, 5] == "ok").any() == given
        assert (np.delete(tracks.flag.values, 5, axis=1) == "ok").all()
    assert np.median(np.abs(tracks.x_px.values[:, 5] - x[:, 5])) > 2


def test_thin_sheets_taken_for_one_ridge_have_no_position():
    """A failure means that a place between thin sheets is given as a sheet's, with a small error."""
    films = [thin_beside_thick(seed) for seed in (6, 8, 10, 12)]
    found = [wrong_and_thick(track_sheets(picture), x, width) for x, width, picture in films]
    assert sum(wrong for wrong, _ in found) == 0
    assert min(thick for _, thick in found) > 0.95
    trusting = replace(TrackingSettings(), least_likeness=-1.0)
    found = [wrong_and_thick(track_sheets(p, settings=trusting), x, width) for x, width, p in films]
    assert sum(wrong for wrong, _ in found) > 20


@pytest.mark.parametrize("kind", ["one bright side", "stripes"])
def test_sheets_of_unlike_looks_are_sheets(kind):
    """Flat ridges with one bright side, a third of them turned over, or wider ones, each with dark stripes of
    its own on its top. A failure means that a third of the sheets have no position in any frame."""
    x = comb(120, per_side=8, axis_px=220.0, pitch_px=26.0, period=40.0, slip=0.25)
    rng, sheets = np.random.default_rng(5), x.shape[1]
    if kind == "one bright side":
        side = np.where(np.arange(sheets) % 3 == 0, -1, 1)
        light = 0.5 * ridges(x, width=440, fwhm_px=2.5, flat_px=10.0)
        light += 0.7 * ridges(x + 3.6 * side, width=440, fwhm_px=2.8)
    else:
        light = ridges(x, width=440, fwhm_px=2.5, flat_px=13.0)
        for place in (-3.5, 0.0, 3.5):
            light -= ridges(x + place, width=440, fwhm_px=3.5, contrast=rng.uniform(0, 0.6, sheets))
    tracks = track_sheets(strip(light, snr=60))
    assert (tracks.flag.values == "ok").mean() > 0.98
    off = (tracks.x_px - x).values
    off = np.abs(off - np.median(off, axis=0))
    assert (off < np.maximum(5 * tracks.x_err_px.values, 0.3)).all()


@pytest.mark.parametrize("kind", ["against its neighbour", "gap", "thick", "thick, and a gap elsewhere"])
def test_a_sheet_against_its_neighbour_is_merged_with_it(kind):
    """Sheets 5 px wide, one of which stands 4 px from its neighbour. A failure means that the place between
    both is given as that of a sheet, or that a gap, or a thick sheet, alone has no position."""
    x = comb(200, per_side=8, axis_px=200, slip=0.5, uneven=0.05, period=60)
    if "gap" in kind:
        x = np.delete(x, 6, axis=1)
    elif kind == "against its neighbour":
        x[:, 6] = x[:, 5] + 4.0
    width = np.where((np.arange(x.shape[1]) == 12) & ("thick" in kind), 8.0, 5.0)
    picture = strip(sum(ridges(x[:, [n]], width=400, fwhm_px=wide) for n, wide in enumerate(width)))
    tracks = track_sheets(picture)
    merged = (tracks.flag.values == "merged").all(axis=0)
    assert (tracks.flag.values[:, ~merged] == "ok").all()
    assert np.flatnonzero(merged).tolist() == ([5] if kind == "against its neighbour" else [])
    if merged.any():
        trusting = track_sheets(picture, settings=TrackingSettings(wide_by_a_gap=np.inf))
        assert np.abs(np.median(trusting.x_px.values[:, 5] - x[:, 5])) > 1.5


def overlaid(what, fwhm_px=7.0):
    """Sixteen creeping sheets, and what is drawn over or under them: positions and strip."""
    x = comb(240, per_side=8, axis_px=200, slip=0.5, uneven=0.1, period=60)
    column = np.arange(400)
    picture = strip(ridges(x, width=400, fwhm_px=fwhm_px, contrast=brightness(16, 3)))
    if what == "ruler":
        picture.values[:] *= 1 - 0.15 * (column % 13.7 < 2)
    elif what == "reflection":
        picture.values[:] += 8 * ridges(x[:1] + 7.0, width=400)
    elif what == "background out of focus":
        picture.values[:] += 40 * ridges(190 - 0.8 * (x - 200), width=400, fwhm_px=18.0)
    else:
        picture.values[:] += np.random.default_rng(2).normal(0, 2.5, 400)
    return x, picture


@pytest.mark.parametrize("what", ["ruler", "reflection", "background out of focus", "unequal pixels"])
def test_what_lies_over_or_under_the_whole_comb_is_in_the_errors(what, monkeypatch):
    """Sheets move against it slowly, and nothing tells it from the usual shape of the ridges. A failure means
    that it shifts sheets by two to six times their stated errors."""
    x, picture = overlaid(what)
    tracks = track_sheets(picture)
    off = tracks.x_px.values - x
    in_errors = (off - np.median(off, axis=0)) / tracks.x_err_px.values
    assert np.sqrt(np.mean(in_errors**2)) < 1.8
    within = np.abs(in_errors) <= 1
    assert 0.5 < within.mean() < 0.9
    assert off_unchecked(monkeypatch, picture, x) > 2


@pytest.mark.parametrize("period", [35, 60])
@pytest.mark.parametrize("moving", [False, True])
def test_how_far_distortions_move_ridges_is_measured_in_the_film(moving, period):
    """Fringes of light, 13.7 px apart, lie or move over the comb. A failure means that they move sheets by
    1.5 times their stated errors: further than dirt or a background of the same distortion would."""
    x = comb(180, per_side=15, axis_px=320, slip=0.15, uneven=0.05, period=period)
    phase = np.arange(640) / 13.7 - moving * np.arange(180)[:, None] / 19
    light = ridges(x, width=640, fwhm_px=8.0, contrast=brightness(30, 3))
    picture = strip(light * (1 + 0.17 * np.sin(2 * np.pi * phase)))
    assert 0.7 < off_in_errors(picture, x) < 1.25


@pytest.mark.parametrize("seed", [1, 2])
def test_a_picture_stretched_by_the_motion_is_no_distortion(seed):
    """Lopsided ridges of a picture that every slip stretches, so that shapes change as sheets move. A failure
    means that the motion is taken for what distorts the ridges, and errors are stated ten times too large."""
    random = np.random.default_rng(seed)
    rest = 100 + 160 * np.arange(7) + random.uniform(-5, 5, 7)
    phase = np.arange(200)[:, None] / 23.7 % 1 - 0.5

    def warped(x):
        return x - np.sign(x - 500) * np.abs((x - 500) / 500) ** 2 * 40 * phase

    parts = np.r_[rest, rest + 9 + random.uniform(-1, 1, 7)]
    height = np.r_[np.ones(7), 0.15 * random.uniform(0.3, 1.7, 7)]
    width = np.repeat([18.0, 7.0], 7)
    picture = strip(ridges(warped(parts), width=1160, fwhm_px=width, contrast=height), snr=150, seed=seed)
    tracks = track_sheets(picture)
    off = tracks.x_px.values - warped(rest)
    over = np.median(tracks.x_err_px.values, axis=0) / np.std(off, axis=0)
    assert 0.7 < np.median(over) < 2
    assert over.max() < 5


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_slight_differences_between_sheets_are_no_distortion(seed):
    """Sheets of several widths in uneven light and unequal pixels. A failure means that errors are stated too
    large: that what hardly exceeds its noise counts with a factor for dirt, which the film does not show."""
    random = np.random.default_rng(seed)
    x = comb(160, per_side=14, pitch_px=17, axis_px=300, slip=0.25, uneven=0.08, seed=seed)
    width, height = 10 * random.normal(1, 0.08, 28), 4 * random.uniform(0.6, 1.3, 28)
    light = (1 + 0.005 * random.normal(size=600)) * (1 - 0.3 * np.linspace(-1, 1, 600) ** 2)
    tracks = track_sheets(strip(ridges(x, width=600, fwhm_px=width, contrast=height) * light, snr=60))
    off = tracks.x_px.values - x
    within = np.abs(off - off.mean(axis=0)) <= tracks.x_err_px.values
    assert 0.62 < within.mean() < 0.72


def test_dirt_that_passes_a_ridge_is_in_its_error_all_the_way():
    """Dirt that passes a ridge distorts it to one side and then to the other. A failure means that in the
    frames in between, in which the position may be off by as much, the error is that of noise; or that it
    remains where the dirt is gone."""
    frame, noise = np.arange(200), np.full(200, 0.01)
    passing = [(frame - at) / 6 for at in (50, 150)]
    values = sum(0.3 * u * np.exp((1 - u**2) / 2) for u in passing)
    values += noise * np.random.default_rng(1).normal(size=200)
    size, _ = _significant(values, noise, DEFAULT)
    without, _ = _significant(values, noise, replace(DEFAULT, distortion_gap=0))
    for at in (50, 150):
        beside = min(without[at - 6], without[at + 6])
        assert without[at] < 0.3 * beside
        assert size[at] > 0.8 * beside / np.sqrt(2)
    np.testing.assert_array_equal(size[np.r_[:20, 80:120, 180:200]], without[np.r_[:20, 80:120, 180:200]])
    assert (size[85:115] == 0).all()


@pytest.mark.parametrize("seed", [1, 2])
def test_a_soft_object_that_covers_ridges_in_part_is_in_their_errors(seed):
    """It swings over the comb and lets a part of the light through. A failure means that the ridges at its
    edge are off by one and a half to two stated errors."""
    x = comb(300, per_side=13, axis_px=310, slip=0.2, uneven=0.1, period=100, seed=seed)
    away = np.arange(620) - 310 - 200 * np.sin(np.arange(300)[:, None] / 200 + seed)
    hides = np.mean([np.exp(-0.5 * ((away - lean) / 7) ** 4) for lean in np.linspace(-6, 6, 13)], axis=0)
    picture = strip(ridges(x, width=620, contrast=brightness(26, seed)), seed=seed)
    picture.values[:] = 10 + (picture.values - 10) * (1 - 0.6 * hides)
    stated, without = (
        track_sheets(picture, sheets=26, settings=replace(DEFAULT, covered_width=least))
        for least in (DEFAULT.covered_width, np.inf)
    )
    off = stated.x_px.values - x
    off -= np.nanmedian(off, axis=0)
    larger = stated.x_err_px.values > 1.2 * without.x_err_px.values
    assert 0.005 < larger.mean() < 0.03
    for tracks, low, high in ((stated, 0.6, 1.3), (without, 1.35, 3)):
        assert low < np.sqrt(np.mean((off / tracks.x_err_px.values)[larger] ** 2)) < high


@pytest.mark.parametrize("px_per_frame", [2.3, 5.7])
def test_a_needle_that_passes_in_front_is_in_the_errors(px_per_frame):
    """It is 4 px wide, hides half of the height, and stands at the flank of a ridge in single frames, which
    then looks like a ridge that is shifted. A failure means that such positions are off by half a pixel at
    errors of hundredths."""
    x = comb(300, per_side=13, axis_px=310, slip=0.2, uneven=0.1, period=100)
    needle = np.abs(np.arange(620) - (60 + px_per_frame * np.arange(300)[:, None] % 500)) < 2
    light = ridges(x, width=620, fwhm_px=4.0, flat_px=7.0) * (1 - 0.5 * needle)
    for least, low, high in ((DEFAULT.covered_width, 0, 10), (np.inf, 50, np.inf)):
        tracks = track_sheets(strip(light), settings=replace(DEFAULT, covered_width=least))
        wrong = np.abs(tracks.x_px.values - x) > np.maximum(5 * tracks.x_err_px.values, 0.3)
        assert low <= wrong.sum() <= high
        assert float(tracks.x_err_px.median()) < 0.03


def test_specks_on_the_lens_are_in_the_errors_of_displacements():
    """Sheets move by a few pixels past specks that dim a few columns: displacements of some are too large
    or too small by a quarter, in every stick alike. A failure means that these pass for precise."""
    wrong, stated = [], []
    for seed in range(4):
        random = np.random.default_rng(seed)
        x = comb(300, per_side=15, axis_px=320, slip=0.3, uneven=0.05, seed=seed)
        at, size, depth = random.uniform([[0], [2], [0.05]], [[640], [6], [0.3]], (3, 25))
        specks = depth * np.exp(-(((np.arange(640)[:, None] - at) / size) ** 2) / 2)
        picture = strip(ridges(x, width=640, fwhm_px=8.0, contrast=brightness(30, seed)), snr=100)
        picture.values[:] *= np.prod(1 - specks, axis=1)
        tracks, far = track_sheets(picture, sheets=30), np.ptp(x, axis=0) > 1
        moved = x - np.median(x, axis=0)
        factor = (moved * tracks.x_px.values).sum(axis=0) / (moved**2).sum(axis=0)
        wrong.append(np.abs(factor - 1)[far])
        stated.append(tracks.misscaled.values[far])
    off, error = np.concatenate(wrong), np.hypot(np.concatenate(stated), 0.02)
    assert (off > 0.1).mean() > 0.2
    assert np.quantile(off / error, 0.9) < 0.5 * np.quantile(off / 0.02, 0.9)
    assert 0.4 < (off < error).mean() < 0.9


@pytest.mark.parametrize("at", [0, 3, 29])
def test_a_speck_beside_a_sheet_is_in_the_error_of_its_displacements(at):
    """Its displacements are too small by a fifth. A failure means that no error is stated, as of outermost
    sheets that are compared with themselves, or one for sheets without a speck."""
    x = comb(300, per_side=15, axis_px=320, slip=0.3, uneven=0.05)
    picture = strip(ridges(x, width=640, fwhm_px=8.0, contrast=brightness(30)), snr=100)
    picture.values[:] *= 1 - 0.3 * np.exp(-(((np.arange(640) - x[:, at].mean() - 5) / 3) ** 2) / 2)
    tracks = track_sheets(picture, sheets=30)
    moved = x[:, at] - x[:, at].mean()
    wrong = 1 - moved @ tracks.x_px.values[:, at] / (moved @ moved)
    assert 0.15 < wrong < 0.25
    assert 0.6 < tracks.misscaled.values[at] / wrong < 1.5
    others = np.delete(np.where(np.ptp(x, axis=0) > 0.2, tracks.misscaled.values, 0), at)
    assert others.max() < 0.03


@pytest.mark.parametrize("fwhm_px", [4.5, 8.0])
def test_a_texture_of_the_light_is_in_the_errors_of_a_comb_that_moves_through_it(fwhm_px):
    """The comb drifts by two pitches through light with spots of some pixels, which pull each ridge in turn
    to either side by hundredths of a pixel. A failure means that fewer than half of the displacements are
    within their errors, as without the term for it, or that it is measured too coarsely for such a drift."""
    within = {}
    coarse = replace(DEFAULT, texture_length=6.0)
    for name, settings in (
        ("stated", DEFAULT),
        ("coarse", coarse),
        ("none", replace(DEFAULT, texture_shift=0, second_comb_shift=0)),
    ):
        inside = []
        for seed, grain_px in enumerate((1.5, 4.0)):
            x = comb(200, per_side=14, axis_px=320, slip=0.25, uneven=0.05, seed=seed)
            x += 40 * np.linspace(-0.5, 0.5, 200)[:, None]
            grains = gaussian_filter1d(np.random.default_rng(seed).normal(size=640), grain_px, mode="wrap")
            picture = strip(ridges(x, width=640, fwhm_px=fwhm_px, contrast=brightness(28, seed)))
            picture.values[:] *= 1 + 0.02 * grains / grains.std()
            tracks = track_sheets(picture, sheets=28, settings=settings)
            off = tracks.x_px.values - x
            inside.append(np.abs(off - np.median(off, axis=0)) <= tracks.x_err_px.values)
        within[name] = np.mean(inside)
    assert 0.58 < within["stated"] < 0.74
    assert within["none"] < 0.5
    assert within["coarse"] < within["stated"] - 0.05


def few_ridges(what, count, fwhm_px, snr):
    """Two to four ridges, of which neighbours tell little, under light that moves or a focus that drifts."""
    time, column, width = np.arange(200)[:, None], np.arange(30 * (count + 1)), 30 * (count + 1)
    x = 30.0 * np.arange(1, count + 1) + 0.5 * np.sin(time / 11 + np.arange(count))
    beam = np.exp(-(((column - width * (1.6 * time / 200 - 0.3)) / (0.35 * width)) ** 2))
    if what == "focus":
        sharp, blurred = (ridges(x, width=width, fwhm_px=fwhm_px * wider) for wider in (1.0, 1.6))
        beside = ridges(x + 0.5 * fwhm_px, width=width, fwhm_px=fwhm_px) * 0.6
        return x, strip(beside + sharp + (blurred - sharp) * time / 200, snr=snr)
    light = ridges(x, width=width, fwhm_px=fwhm_px)
    return x, strip(light * (1 + 0.8 * beam) if what == "beam" else light + 0.3 * beam, snr=snr)


@pytest.mark.parametrize("count", [2, 3, 4])
@pytest.mark.parametrize(
    ("what", "fwhm_px", "snr"),
    [("beam", 3.5, 1000), ("beam", 9.0, 60), ("reflected beam", 3.5, 1000), ("focus", 3.5, 1000)],
)
def test_few_ridges_have_the_error_of_light_and_focus(what, count, fwhm_px, snr):
    """A failure means that they move by up to fifty times their stated errors, which no neighbour shows."""
    x, picture = few_ridges(what, count, fwhm_px, snr)
    assert off_in_errors(picture, x, sheets=count) < 1.15


@pytest.mark.parametrize("fwhm_px", [3.5, 9.0])
@pytest.mark.parametrize("count", [2, 3, 4])
def test_few_ridges_that_nothing_moves_keep_their_errors(count, fwhm_px):
    """A failure means that noise, or the place of a ridge among the pixels, counts as light or dirt."""
    x, _ = few_ridges("", count, fwhm_px, 100)
    picture = strip(ridges(x, width=30 * (count + 1), fwhm_px=fwhm_px), snr=100)
    assert 0.85 < off_in_errors(picture, x) < 1.15


@pytest.mark.parametrize("what", ["ruler", "unequal pixels"])
def test_what_lies_over_narrow_ridges_is_in_the_errors(what, monkeypatch):
    """Ridges 3.5 px wide, whose shape depends on their place among the pixels as well. A failure means that
    letters over the picture shift sheets by several of their stated errors."""
    x, picture = overlaid(what, 3.5)
    assert off_in_errors(picture, x) < 1.8
    assert off_unchecked(monkeypatch, picture, x) > 2


@pytest.mark.parametrize("unlike", [0.0, 0.1])
def test_sharp_ridges_keep_their_errors(unlike):
    """Sheets about 4 px wide with edges one pixel wide. A failure means that the shapes which the pixels give
    them are taken for dirt, and errors are ten times too large."""
    x = comb(300, per_side=8, axis_px=130, slip=0.1, uneven=0.1, period=60, pitch_px=14.0)
    width = 4.0 * (1 + unlike * np.random.default_rng(4).uniform(-1, 1, 16))
    light = sum(ridges(x[:, [n]], width=260, fwhm_px=1.0, flat_px=flat) for n, flat in enumerate(width))
    tracks = track_sheets(strip(light, snr=200))
    off = tracks.x_px.values - x
    off -= np.median(off, axis=0)
    within = np.abs(off) < tracks.x_err_px.values
    assert 0.6 < within.mean() < 0.85
    by_pixels = track_sheets(strip(light, snr=200), settings=TrackingSettings(sampled_well_px=0.0))
    assert np.median(by_pixels.x_err_px) > 3 * np.median(tracks.x_err_px)


# --- positions of ridges sharper than their pixels ----------------------------------------------------------


def sharp(x_px, width_px, *, height=120.0, noise=0.3, seed=0):
    """Boxes without soft edges, each pixel the mean of the light on it: the strip of sixteen rows' noise."""
    column = np.arange(int(x_px.max()) + 30)
    grey = np.full((len(x_px), len(column)), 30.0)
    for x, width in zip(x_px.T[:, :, None], np.broadcast_to(width_px, x_px.shape[1]), strict=True):
        low, high = (np.clip(column - x + edge, -width / 2, width / 2) for edge in (-0.5, 0.5))
        grey += height * (high - low)
    grey += np.random.default_rng(seed).normal(0, noise, grey.shape)
    return as_strip(grey.astype(np.float32))


def creeping_by(sweep_px, frames=400, seed=0):
    """Positions (frame, 24) of a comb whose sheets creep, outer ones by more, from anywhere in a pixel."""
    rest = 30 + 12 * np.arange(24) + np.random.default_rng(seed).uniform(-1, 1, 24)
    share = (rest - rest.mean()) / np.ptp(rest) * 2
    return rest + sweep_px * share * (1 - np.arange(frames) % 60 / 60)[:, None]


def errors(tracks, x_px):
    """Errors of positions, each sheet's constant one left out."""
    off = tracks["x_px"].values - x_px
    return off - np.nanmedian(off, axis=0)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(("width_px", "sweep_px"), [(1.3, 1.5), (2.5, 1.5), (2.5, 0.3), (4.0, 1.5)])
def test_sharp_ridges_alike_are_measured_to_their_noise(width_px, sweep_px, seed):
    """A failure means that positions lock to pixels by 0.03 px with a stated error of 0.006 px."""
    x = creeping_by(sweep_px, seed=seed)
    tracks = track_sheets(sharp(x, width_px, seed=seed), sheets=24)
    off = errors(tracks, x)
    assert np.sqrt(np.nanmean(off**2)) < 0.01
    assert np.nanmean(np.abs(off) < tracks["x_err_px"].values) > 0.55
    assert np.nanmean(np.abs(off) > 4 * tracks["x_err_px"].values) < 0.02
    assert TrackMetadata.of(tracks).locking_px > 0.015


@pytest.mark.parametrize(("width_px", "sweep_px"), [(1.3, 1.5), (2.5, 1.5), (2.5, 0.3), (4.0, 1.5)])
def test_without_the_correction_they_lock(width_px, sweep_px):
    """A failure means that the test above would pass without the correction."""
    x = creeping_by(sweep_px)
    never = TrackingSettings(locking_sigmas=1e9)
    tracks = track_sheets(sharp(x, width_px), sheets=24, settings=never)
    off = errors(tracks, x)
    assert TrackMetadata.of(tracks).locking_px == 0
    assert np.nanmean(np.abs(off) > 4 * tracks["x_err_px"].values) > 0.08


def test_sharp_ridges_of_different_widths_have_larger_errors():
    """A failure means that the shift that sheets do not share is in no error."""
    x = creeping_by(4.0)
    width = 1.5 * (1 + 0.3 * np.random.default_rng(5).uniform(-1, 1, 24))
    tracks = track_sheets(sharp(x, width), sheets=24)
    off = np.abs(errors(tracks, x)) / tracks["x_err_px"].values
    assert TrackMetadata.of(tracks).locking_err_px > 0.005
    assert np.nanmean(off < 1) > 0.5
    assert np.nanmean(off > 5) < 0.01


@pytest.mark.parametrize("fwhm_px", [3.0, 7.0])
def test_ridges_as_lenses_draw_them_are_left_alone(fwhm_px):
    """A failure means that motion is taken for locking, and changed."""
    x = comb(300, per_side=12, axis_px=300, uneven=0.1)
    tracks = track_sheets(strip(ridges(x, width=620, fwhm_px=fwhm_px), snr=60))
    assert TrackMetadata.of(tracks).locking_px == 0


@pytest.mark.parametrize("pitch_px", [20.0, 12.5, 20.05, 20.25])
@pytest.mark.parametrize("slip", [0.01, 0.05, 0.2])
def test_motion_of_sheets_at_the_same_place_in_their_pixels_is_motion(pitch_px, slip):
    """A failure means that a part of their motion is taken for locking: u/2π where the pitch is 20 px."""
    x = comb(300, per_side=12, axis_px=300, pitch_px=pitch_px, slip=slip)
    found = pixel_locking(x + np.random.default_rng(0).normal(0, 0.001, x.shape), DEFAULT)
    shift = found.at(x) - np.nanmean(found.at(x), axis=0)
    assert np.abs(shift).max() < 0.003


def test_the_publications_fit_is_not_corrected():
    """A failure means that --fit paper is not the publication's fit."""
    x = creeping_by(1.5)
    picture = sharp(x, 2.5)
    asked = track_sheets(picture, sheets=24, fit="paper")
    never = track_sheets(picture, sheets=24, fit="paper", settings=TrackingSettings(locking_sigmas=1e9))
    np.testing.assert_array_equal(asked["x_px"].values, never["x_px"].values)


@pytest.mark.parametrize("mirrored", [False, True])
def test_known_waves_are_found_in_positions(mirrored):
    """Positions with known locking, noise and motion of single sheets: truth within four errors."""
    rng = np.random.default_rng(3)
    x = creeping_by(2.0) + np.cumsum(rng.normal(0, 0.002, (400, 24)), axis=0)
    waves = np.array([0.004, 0.03, 0.0, -0.01])
    locking, seen = PixelLocking(waves, 0.0), x
    for _ in range(20):  # the shift depends on the position that is seen
        seen = x + locking.at(seen)
    seen = seen + rng.normal(0, 0.004, x.shape)
    sign = -1 if mirrored else 1
    found = pixel_locking(sign * seen, DEFAULT)
    np.testing.assert_allclose(found.waves, waves * [sign, 1, sign, 1], atol=0.002)
    assert found.error_px < 0.003
    np.testing.assert_allclose(sign * found.at(sign * seen), locking.at(seen), atol=0.005)


def test_too_few_sheets_tell_nothing():
    """A failure means that chance is subtracted from the positions of a few sheets."""
    x = creeping_by(2.0)[:, :11]
    x = x + 0.03 * np.sin(2 * np.pi * x)
    assert pixel_locking(x, DEFAULT) is NO_LOCKING
    assert pixel_locking(np.full((5, 24), np.nan), DEFAULT) is NO_LOCKING
