"""Positions of ridges sharper than their pixels: locking is measured from their neighbours."""

import numpy as np
import pytest

from tests.scenes.combs import as_strip, comb, ridges, strip
from vision.data import TrackMetadata
from vision.sheets import track_sheets
from vision.sheets.distortion import NO_LOCKING, PixelLocking, pixel_locking
from vision.sheets.settings import DEFAULT, TrackingSettings


def sharp(x_px, width_px, *, height=120.0, noise=0.3, seed=0):
    """Boxes without soft edges, each pixel the mean of the light on it: the strip of sixteen rows' noise."""
    column = np.arange(int(x_px.max()) + 30)
    grey = np.full((len(x_px), len(column)), 30.0)
    for x, width in zip(x_px.T[:, :, None], np.broadcast_to(width_px, x_px.shape[1]), strict=True):
        low, high = (np.clip(column - x + edge, -width / 2, width / 2) for edge in (-0.5, 0.5))
        grey += height * (high - low)
    grey += np.random.default_rng(seed).normal(0, noise, grey.shape)
    return as_strip(grey.astype(np.float32))


def creeping(sweep_px, frames=400, seed=0):
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
    x = creeping(sweep_px, seed=seed)
    tracks = track_sheets(sharp(x, width_px, seed=seed), sheets=24)
    off = errors(tracks, x)
    assert np.sqrt(np.nanmean(off**2)) < 0.01
    assert np.nanmean(np.abs(off) < tracks["x_err_px"].values) > 0.55
    assert np.nanmean(np.abs(off) > 4 * tracks["x_err_px"].values) < 0.02
    assert TrackMetadata.of(tracks).locking_px > 0.015


@pytest.mark.parametrize(("width_px", "sweep_px"), [(1.3, 1.5), (2.5, 1.5), (2.5, 0.3), (4.0, 1.5)])
def test_without_the_correction_they_lock(width_px, sweep_px):
    """A failure means that the test above would pass without the correction."""
    x = creeping(sweep_px)
    never = TrackingSettings(locking_sigmas=1e9)
    tracks = track_sheets(sharp(x, width_px), sheets=24, settings=never)
    off = errors(tracks, x)
    assert TrackMetadata.of(tracks).locking_px == 0
    assert np.nanmean(np.abs(off) > 4 * tracks["x_err_px"].values) > 0.08


def test_sharp_ridges_of_different_widths_have_larger_errors():
    """A failure means that the shift that sheets do not share is in no error."""
    x = creeping(4.0)
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
    found = pixel_locking(x + np.random.default_rng(0).normal(0, 0.001, x.shape), 0.001, DEFAULT)
    shift = found.at(x) - np.nanmean(found.at(x), axis=0)
    assert np.abs(shift).max() < 0.003


def test_the_publications_fit_is_not_corrected():
    """A failure means that --fit paper is not the publication's fit."""
    x = creeping(1.5)
    picture = sharp(x, 2.5)
    asked = track_sheets(picture, sheets=24, fit="paper")
    never = track_sheets(picture, sheets=24, fit="paper", settings=TrackingSettings(locking_sigmas=1e9))
    np.testing.assert_array_equal(asked["x_px"].values, never["x_px"].values)


@pytest.mark.parametrize("mirrored", [False, True])
def test_known_waves_are_found_in_positions(mirrored):
    """Positions with known locking, noise and motion of single sheets: truth within four errors."""
    rng = np.random.default_rng(3)
    x = creeping(2.0) + np.cumsum(rng.normal(0, 0.002, (400, 24)), axis=0)
    waves = np.array([0.004, 0.03, 0.0, -0.01])
    locking, seen = PixelLocking(waves, 0.0), x
    for _ in range(20):  # the shift depends on the position that is seen
        seen = x + locking.at(seen)
    seen = seen + rng.normal(0, 0.004, x.shape)
    sign = -1 if mirrored else 1
    found = pixel_locking(sign * seen, 0.004, DEFAULT)
    np.testing.assert_allclose(found.waves, waves * [sign, 1, sign, 1], atol=0.002)
    assert found.error_px < 0.003
    np.testing.assert_allclose(sign * found.at(sign * seen), locking.at(seen), atol=0.005)


def test_too_few_sheets_tell_nothing():
    """A failure means that chance is subtracted from the positions of a few sheets."""
    x = creeping(2.0)[:, :11]
    x = x + 0.03 * np.sin(2 * np.pi * x)
    assert pixel_locking(x, 0.004, DEFAULT) is NO_LOCKING
    assert pixel_locking(np.full((5, 24), np.nan), 0.004, DEFAULT) is NO_LOCKING
