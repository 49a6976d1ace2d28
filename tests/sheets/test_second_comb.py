"""A reflection of the sheets is found by the light that it moves between ridges and gaps."""

import numpy as np
import pytest

from tests.scenes.combs import comb, ridges, strip
from vision.checks import tracking_warnings
from vision.data import TrackMetadata
from vision.sheets import track_sheets
from vision.sheets.film import SecondComb

WIDTH = 640
WARNING = "a reflection, a second comb or haze"


def film(second, *, frames=300, seed=1, sign=1, width_px=11.0, snr=100):
    """Truth and strip of 28 uneven sheets, with or without a second, fainter comb that stands still."""
    x = comb(frames, per_side=14, axis_px=320, period=100, slip=0.4, uneven=0.1, seed=seed)
    light = ridges(x, width=WIDTH, fwhm_px=2.5, flat_px=width_px)
    if second:
        light += 0.3 * ridges(np.tile(x[0] + 9, (frames, 1)), width=WIDTH, fwhm_px=2.5, flat_px=width_px)
    return x, strip(light, snr=snr, seed=seed, sign=sign)


def displacement_error(tracks, x):
    off = tracks.x_px.values - x
    return off - np.nanmedian(off, axis=0)


def in_errors(off, tracks):
    return np.sqrt(np.nanmean((off / tracks.x_err_px.values) ** 2))


@pytest.mark.parametrize(("seed", "sign"), [(1, 1), (2, -1), (3, 1)])
def test_a_second_comb_is_in_the_errors_and_named(seed, sign):
    """A failure means that positions are off by up to half a pixel, and the run says nothing."""
    x, picture = film(True, seed=seed, sign=sign)
    tracks = track_sheets(picture, sheets=28)
    assert 0.6 < in_errors(displacement_error(tracks, x), tracks) < 1.4
    assert any(WARNING in line for line in tracking_warnings(tracks))


def test_without_the_search_the_errors_are_too_small(monkeypatch):
    monkeypatch.setattr("vision.sheets.tracks.second_comb", lambda *_: SecondComb())
    x, picture = film(True)
    tracks = track_sheets(picture, sheets=28)
    assert in_errors(displacement_error(tracks, x), tracks) > 1.4


def beside(what, picture):
    """Change the film by what is no second comb."""
    column, frame = np.arange(WIDTH), np.arange(300)[:, None]
    rng = np.random.default_rng(0)
    match what:
        case "lamp":
            picture.values[:] *= 1 + 0.5 * np.sin(frame / 40) * (column / WIDTH - 0.5)
        case "flicker":
            picture.values[:] *= 1 + 0.2 * np.sin(1.3 * frame + column / 100)
        case "shadow":
            picture.values[:] *= 1 - 0.5 / (1 + np.exp((column - 2 * frame) / 6))
        case "object":
            picture.values[:] *= 1 - 0.9 * np.exp(-(((column - 320 - 150 * np.sin(frame / 70)) / 6) ** 4))
        case "unequal pixels":
            picture.values[:] *= 1 + 0.03 * rng.normal(size=WIDTH)
    return picture


@pytest.mark.parametrize("what", ["nothing", "lamp", "flicker", "shadow", "object", "unequal pixels"])
@pytest.mark.parametrize("snr", [15, 100])
def test_other_light_is_no_second_comb(what, snr):
    """A failure means that errors are enlarged, and the user looks for a reflection that is not there."""
    _, picture = film(False, snr=snr)
    tracks = track_sheets(beside(what, picture))
    assert TrackMetadata.of(tracks).second_comb_err_px == 0
    assert not any(WARNING in line for line in tracking_warnings(tracks))


@pytest.mark.parametrize("seed", range(3))
def test_haze_that_grows_over_a_part_of_the_comb_is_no_reflection(seed):
    """It dims ridges and fills the gaps beside them, whatever the sheets do. A failure means that errors are
    15 times too large."""
    frames, column = 150, np.arange(400)
    x = comb(frames, per_side=12, pitch_px=13, axis_px=200, period=25, slip=0.2, uneven=0.04, seed=seed)
    light = ridges(x, width=400, fwhm_px=6.5)
    haze = 0.5 * np.linspace(0, 1, frames)[:, None] * np.exp(-(((column - 130) / 50) ** 2))
    tracks = track_sheets(strip(light * (1 - haze) + 0.5 * light.max() * haze, snr=150, seed=seed))
    off = displacement_error(tracks, x)
    assert 0.25 < in_errors(off, tracks) < 1.4


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("away_px", [2.0, 4.7])
def test_a_second_comb_over_narrow_ridges_is_named(seed, away_px):
    """Ridges of 4 px, over which their reflection moves the other way. A failure means that positions are off
    by several errors, and the run says nothing."""
    x = comb(200, per_side=16, pitch_px=9.5, axis_px=170, period=20, slip=0.15, seed=seed)
    light = ridges(x, width=340, fwhm_px=4.2) + 0.2 * ridges(2 * x[0] + away_px - x, width=340, fwhm_px=4.2)
    tracks = track_sheets(strip(light, snr=400, seed=seed))
    off = displacement_error(tracks, x)
    assert np.sqrt(np.nanmean(off**2)) > 3 * np.median(tracks.x_noise_px.values)
    assert any(WARNING in line for line in tracking_warnings(tracks))


@pytest.mark.parametrize("seed", range(3))
def test_a_second_comb_that_moves_as_a_whole_is_named(seed):
    """The picture of an even comb in a pane that shakes: it lies over all sheets alike. A failure means that
    all positions are off by many errors, and the run says nothing."""
    frames = np.arange(200)
    x = comb(200, per_side=12, pitch_px=10, axis_px=150, period=25, slip=0.15, seed=seed)
    shaken = 3 * np.sin(frames / (9 + seed))[:, None] + 2.0
    tracks = track_sheets(
        strip(ridges(x, width=300, fwhm_px=4.5) + 0.2 * ridges(x + shaken, width=300, fwhm_px=4.5))
    )
    assert 0.4 < in_errors(displacement_error(tracks, x), tracks) < 1.6
    assert any(WARNING in line for line in tracking_warnings(tracks))


@pytest.mark.parametrize("seed", range(3))
def test_a_focus_that_changes_is_no_second_comb(seed):
    """It changes all tops and gaps, but not the sides of the ridges against each other. A failure means that
    the errors are enlarged, and that the user looks for a reflection."""
    x = comb(200, per_side=12, pitch_px=10, axis_px=150, period=25, slip=0.15, seed=seed)
    sharp, soft = (ridges(x, width=300, fwhm_px=width) * 4.5 / width for width in (4.5, 6.5))
    share = 0.5 + 0.5 * np.sin(np.arange(200) / (9 + seed))[:, None]
    tracks = track_sheets(strip(share * sharp + (1 - share) * soft))
    assert TrackMetadata.of(tracks).second_comb_err_px == 0


@pytest.mark.parametrize("film_of", [{"frames": 55}, {"width_px": 2.0}])
def test_short_films_and_narrow_ridges_tell_nothing(film_of):
    tracks = track_sheets(film(True, **film_of)[1])
    assert TrackMetadata.of(tracks).second_comb_err_px == 0


@pytest.mark.parametrize("seed", range(3))
def test_ridges_that_creep_over_pixels_are_no_second_comb(seed):
    """At a spacing of 12.2 px tops and the gaps between them lie at the same place in their pixels. A failure
    means that errors are three times too large, and the user looks for a reflection that is not there."""
    frames = 200
    x = comb(frames, per_side=16, pitch_px=12.2, axis_px=220, period=40, slip=0.12, uneven=0.02, seed=seed)
    x += np.linspace(-0.3, 0.3, frames)[:, None]
    tracks = track_sheets(strip(ridges(x, width=440, fwhm_px=6.2), snr=300, seed=seed))
    assert TrackMetadata.of(tracks).second_comb_err_px == 0
