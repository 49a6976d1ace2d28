"""Columns below a Bayer pattern of colour filters: films with known truth."""

import numpy as np
import pytest
import tifffile

from tests.scenes.combs import comb, ridges
from vision.data import StripMetadata
from vision.sheets import track_sheets
from vision.video import open_video, strip_profile, strip_profiles
from vision.video.strip import equalise_columns

FRAMES, WIDTH, ROWS = 120, 360, 24
RED, GREEN, BLUE = 0.5, 1.0, 0.75


def film(path, *, mosaic, seed=0):
    """Positions, and a film of 20 sheets, as a camera of colours or of grey saves it."""
    rng = np.random.default_rng(seed)
    x = comb(FRAMES, per_side=10, pitch_px=16.4, axis_px=WIDTH / 2, slip=0.12, uneven=0.04, seed=seed)
    light = 0.25 + 0.7 * ridges(x, width=WIDTH, fwhm_px=7.0, contrast=rng.normal(1, 0.08, 20))
    filters = np.full((ROWS, WIDTH), GREEN)
    if mosaic:
        filters[::2, ::2], filters[1::2, 1::2] = RED, BLUE
    pixels = 9000 * light[:, None, :] * filters
    tifffile.imwrite(path, np.clip(rng.normal(pixels, 90), 0, 65535).astype(np.uint16))
    return x, open_video(path)


def told(strip):
    return [line for line in StripMetadata.of(strip).warnings if "Bayer" in line]


@pytest.mark.parametrize("seed", range(2))
def test_sheets_below_a_mosaic_are_all_found_with_true_errors(tmp_path, seed):
    """A failure means that sheets are lost, or that errors are several times too large."""
    x, video = film(tmp_path / "a.tif", mosaic=True, seed=seed)
    strip = strip_profile(video, slice(0, ROWS))
    tracks = track_sheets(strip)
    assert tracks.sizes["sheet"] == 20
    off = tracks.x_px.values - x
    off -= off.mean(axis=0)
    assert 0.6 < np.mean(np.abs(off) <= tracks.x_err_px.values) < 0.8
    (line,) = told(strip)
    assert "15 %" in line  # (1 + 0.75) / (1 + 0.5) = 1.17 = (1 + 0.077) / (1 − 0.077)


def test_each_part_of_a_strip_has_its_own_mosaic(tmp_path):
    """Parts of odd heights have unequal shares of red and blue rows. A failure means that sheets at several
    heights are still those of the mosaic."""
    _, video = film(tmp_path / "a.tif", mosaic=True)
    _, parts = strip_profiles(video, 3, slice(0, 21))
    second = np.diff(parts.mean("frame").values, n=2, axis=1)
    assert np.abs((second * (-1.0) ** np.arange(WIDTH - 2)).mean(axis=1)).max() < 10  # of 6750 grey levels


def test_columns_of_a_grey_camera_are_left_as_they_are(tmp_path):
    """A failure means that films in order are changed, or that a warning says what is not so."""
    _, video = film(tmp_path / "a.tif", mosaic=False)
    strip = strip_profile(video, slice(0, ROWS))
    assert not told(strip)
    means = np.concatenate([frames.mean(axis=1) for frames in (block.pixels for block in video.blocks())])
    assert np.allclose(strip.values, means, rtol=1e-6)


@pytest.mark.parametrize("fwhm_px", [1.0, 1.5, 2.5, 4.0])
@pytest.mark.parametrize(("pitch_px", "uneven"), [(16.0, 0.0), (16.0, 0.1), (9.3, 0.0), (7.0, 0.05)])
def test_sharp_ridges_are_no_mosaic(fwhm_px, pitch_px, uneven):
    """A failure means that the columns of sharp ridges are made brighter and darker in turn."""
    x = comb(60, per_side=15, pitch_px=pitch_px, axis_px=250.3, slip=0.2, uneven=uneven)
    profile = (30 + 100 * ridges(x, width=500, fwhm_px=fwhm_px)).astype(np.float32)
    assert equalise_columns(profile, np.ones(60, bool)) == 0
