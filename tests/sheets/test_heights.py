"""x(n, z, t): positions in parts of the strip, one above the other, against rendered truth."""

import numpy as np
import pytest
import xarray as xr

from vision.errors import InputError
from vision.experiment import Experiment, simulate, with_settings
from vision.sheets import track_sheets, with_heights
from vision.video import open_video, strip_profile, strip_profiles

STRIPS, LEAN_DEG, ROWS = 4, 0.8, slice(8, 88)
SCENE = with_settings(
    Experiment(),
    {
        "camera.width": 480,
        "camera.height": 96,
        "camera.strip_rows": 80,
        "camera.duration_s": 3.0,
        "sheets.count": 12,
        "optics.tilt_deg": LEAN_DEG,
        "optics.texture": 0.0,  # which leans with the sheets' own pattern, not with the ridges
        "optics.gradient": 0.0,  # four times as steep in a picture as narrow as this
        "sheets.bow_px": 0.0,
    },
)


@pytest.fixture(scope="module")
def test(tmp_path_factory):
    return simulate(SCENE, tmp_path_factory.mktemp("lean"))


@pytest.fixture(scope="module")
def measured(test):
    whole, parts = strip_profiles(open_video(test.video), STRIPS, ROWS)
    return with_heights(track_sheets(whole), parts)


def truth_at(test, z):
    """(frame, sheet, z): the sheets lean about the frame's middle row, in which the truth holds."""
    with xr.open_dataset(test.truth) as truth:
        x = truth["x_px"].values[..., None]
    return x + np.tan(np.radians(LEAN_DEG)) * (z - (SCENE.camera.height - 1) / 2)


def test_positions_at_every_height_are_true_within_their_errors(test, measured):
    """A failure means that a sheet's lean or bending is measured wrongly, or with a wrong error."""
    z = measured["z"].values
    off = (measured["x_z_px"].values - truth_at(test, z)) / measured["x_z_err_px"].values
    assert z.tolist() == [17.5, 37.5, 57.5, 77.5]
    assert np.isfinite(off).mean() > 0.98
    assert 0.62 < (np.abs(off) < 1)[np.isfinite(off)].mean() < 0.76
    lean = np.nanmedian(measured["x_z_px"].values[..., -1] - measured["x_z_px"].values[..., 0])
    assert lean == pytest.approx(60 * np.tan(np.radians(LEAN_DEG)), abs=0.01)


def test_the_whole_strip_s_position_is_not_that_of_its_parts(test, measured):
    """The truth of one height, taken for another's, must fail: else the test above proves nothing."""
    wrong = measured["x_z_px"].values - truth_at(test, measured["z"].values[::-1])
    assert np.nanmedian(np.abs(wrong)) > 0.2


def test_the_strip_itself_stays_as_it_is_without_parts(test, measured):
    """A failure means that --strips changes x(n, t)."""
    alone = track_sheets(strip_profile(open_video(test.video), ROWS))
    np.testing.assert_array_equal(alone["x_px"], measured["x_px"])
    np.testing.assert_array_equal(alone["flag"], measured["flag"])


def test_no_position_at_a_height_where_the_strip_has_none(test):
    """A failure means that what was withheld comes back through the parts."""
    whole, parts = strip_profiles(open_video(test.video), STRIPS, ROWS)
    tracks = track_sheets(whole)
    tracks["x_px"][10:20, 3] = np.nan
    assert np.isnan(with_heights(tracks, parts)["x_z_px"][10:20, 3]).all()


@pytest.mark.parametrize("strips", [1, 41, 0, -3])
def test_parts_that_cannot_be_are_refused(test, strips):
    """A failure means a part of less than two rows, or a traceback."""
    with pytest.raises(InputError, match="`strips`: expected 2 to 40 parts of the strip's 80 rows"):
        strip_profiles(open_video(test.video), strips, ROWS)


def test_parts_of_another_reading_are_refused(test, measured):
    """A failure means that positions are looked for in the wrong frames."""
    _, parts = strip_profiles(open_video(test.video, frames=slice(0, 100)), STRIPS, ROWS)
    with pytest.raises(InputError, match="the tracks' frames"):
        with_heights(measured, parts)
