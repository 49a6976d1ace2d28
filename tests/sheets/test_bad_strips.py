"""Strips that cannot be tracked are refused in one line that says what to do."""

import numpy as np
import pytest

from tests.scenes.combs import as_strip, comb, ridges, strip
from vision.errors import InputError
from vision.sheets import track_sheets


def refusal(picture, **options):
    """The message, which must be one line that names the recording."""
    with pytest.raises(InputError) as caught:
        track_sheets(picture, **options)
    message = str(caught.value)
    assert "\n" not in message
    assert "expected" in message and "found" in message
    return message


def grey(level, frames=20, columns=200):
    return np.full((frames, columns), level, np.float32)


def test_constant_picture():
    """A failure means a covered lens ends in a traceback or in sheets."""
    assert "scene.avi: expected a picture with ridges; found a constant one" in refusal(as_strip(grey(80)))


def test_noise_alone():
    """A failure means noise is tracked as sheets."""
    assert "expected upright ridges" in refusal(strip(np.zeros((40, 400)), snr=20))


def test_a_slope_of_light_alone():
    """A failure means uneven light is tracked as sheets."""
    fall = np.broadcast_to(np.linspace(0, 2, 400), (40, 400))
    assert "ridge" in refusal(strip(fall, snr=100))


def test_fewer_ridges_than_asked():
    """A failure means sheets are invented to reach the number asked for."""
    picture = strip(ridges(comb(40, per_side=4, axis_px=150), width=300))
    message = refusal(picture, sheets=12)
    assert "12 ridges" in message and "found 8" in message


def test_no_usable_frame():
    """A failure means a recording of corrupt frames ends in a traceback."""
    assert "at least one usable frame" in refusal(as_strip(grey(np.nan)))


def test_too_few_columns():
    """A failure means a strip cut too narrow ends in a traceback."""
    assert "at least 8 columns" in refusal(as_strip(grey(80, columns=5)))


def test_axis_outside_the_picture_on_the_wrong_scale():
    """A failure means an axis typed in µm instead of px numbers every sheet wrongly without a word."""
    picture = strip(ridges(comb(40, per_side=4, axis_px=150), width=300))
    assert "axis" in refusal(picture, axis_px=1e6)


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_a_few_frames_are_enough_for_positions(frames):
    """One frame gives positions, and no error made up: a failure means short clips crash or warn."""
    truth = comb(frames, per_side=4, axis_px=150)
    tracks = track_sheets(strip(ridges(truth, width=300)))
    assert np.abs(tracks.x_px.values - truth).max() < 0.2
    assert np.isfinite(tracks.x_err_px.values).all()
    assert np.isnan(tracks.x_noise_px.values).all()
