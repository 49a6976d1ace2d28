"""Pixel locking of the publication's fit: its slope from stated errors, and positions without it."""

import numpy as np
import pytest

from vision.deformation.creep import correct_pixel_locking, frames_of_sticks, pixel_locking_slope
from vision.deformation.settings import DeformationSettings

SETTINGS = DeformationSettings()


def locked(share=0.15, *, noise_px=0.02, sheets=10, seed=1):
    """(true positions, locked ones, their stated errors, frames): five sticks of 2 px sweep."""
    rng = np.random.default_rng(seed)
    time = np.arange(200) / 100
    begin = (np.arange(6) * 40 - 0.5) / 100
    frames = frames_of_sticks(time, begin[:-1], begin[1:], margin_s=0.0, interval_s=0.01)
    true = 20.3 * np.arange(sheets) + rng.uniform(0, 1, (5, sheets))[frames.row] - frames.u[:, None]
    seen = true + noise_px * rng.standard_normal(true.shape)
    away = seen - np.rint(seen + 0.05 * rng.standard_normal(seen.shape))  # noise decides midway
    x_px = seen - share * away
    error_px = np.hypot(noise_px, share * (x_px - np.rint(x_px)))
    return true, x_px, error_px, frames


@pytest.mark.parametrize("share", [0.0, 0.1, 0.2])
def test_the_slope_is_in_the_stated_errors(share):
    """A failure means that positions are corrected by too much, or those that are not locked."""
    _, x_px, error_px, _ = locked(share)
    np.testing.assert_allclose(pixel_locking_slope(x_px, error_px), share, atol=1e-6)


def test_the_slope_of_sheets_never_seen_is_0():
    """A failure means that a sheet without positions makes a NaN of all."""
    x_px = np.full((10, 2), np.nan)
    np.testing.assert_array_equal(pixel_locking_slope(x_px, x_px), 0)


def test_corrected_positions_follow_the_creep():
    """A failure means that locking, up to a tenth of a pixel here, passes for motion."""
    true, x_px, error_px, frames = locked()
    corrected = correct_pixel_locking(x_px, pixel_locking_slope(x_px, error_px), frames, 4, SETTINGS)
    before, after = (np.sqrt(np.mean((x - true) ** 2)) for x in (x_px, corrected))
    assert before > 0.04
    assert after < 0.025


def test_without_locking_positions_stay_as_they_are():
    """A failure means that other fits are changed."""
    _, x_px, _, frames = locked(0.0)
    assert correct_pixel_locking(x_px, np.zeros(10), frames, 4, SETTINGS) is x_px
