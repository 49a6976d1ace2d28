"""Columns that a program put beside the picture, and backgrounds that are none."""

import numpy as np
import pytest

import vision
from tests.scenes import combs
from tests.scenes.degraded import write_ffv1, write_h264, write_jpegs
from vision.data import StripMetadata, TrackMetadata
from vision.run.reading import read_run, read_strip
from vision.sheets import track_sheets
from vision.video import open_video, strip_profile

WRITERS = {
    "lossless": lambda path, pixels: write_ffv1(path / "film.mkv", pixels),
    "JPEG": lambda path, pixels: write_jpegs(path / "film.avi", pixels, 85),
    "H.264": lambda path, pixels: write_h264(path / "film.mp4", pixels, 20),
}


def film(level, height, *, fwhm_px=6.0):
    """Frames of a comb whose ends are out of view, (frame, z, x), and its positions."""
    x = combs.comb(60, per_side=14, axis_px=160, pitch_px=18, slip=0.4, uneven=0.05)
    rng = np.random.default_rng(2)
    light = level + height * combs.ridges(x, width=320, fwhm_px=fwhm_px, contrast=rng.uniform(0.8, 1.2, 28))
    return light[:, None] + rng.normal(0, 2, (60, 24, 320)), x


def as_pixels(light):
    return np.clip(np.rint(light), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("writer", WRITERS)
@pytest.mark.parametrize("level", [0, 255])
def test_padding_beside_the_picture_is_left_out(tmp_path, level, writer):
    """A failure means that gaps are taken for sheets, since bars at the sides look like a background."""
    light, x = film(140, -70)
    pixels = np.pad(as_pixels(light), ((0, 0), (0, 0), (64, 48)), constant_values=level)
    profile = strip_profile(open_video(WRITERS[writer](tmp_path, pixels)))
    assert profile["x"].values[[0, -1]].tolist() == [64, 383]
    assert StripMetadata.of(profile).padding == ["0:64", "384:432"]
    tracks = track_sheets(profile)
    assert TrackMetadata.of(tracks).ridges == "dark"
    away = np.nanmedian(np.abs(tracks.x_px.values[:, :, None] - 64 - x[:, None]), axis=0).min(axis=1)
    assert away.max() < 1


def test_repeated_edges_of_the_picture_are_left_out(tmp_path):
    """The repeated columns are as bright as gaps or sheets, and would say that these are the background."""
    light, _ = film(140, -70)
    pixels = np.pad(as_pixels(light), ((0, 0), (0, 0), (64, 48)), mode="edge")
    profile = strip_profile(open_video(WRITERS["lossless"](tmp_path, pixels)))
    assert profile["x"].values[[0, -1]].tolist() == [65, 382]


@pytest.mark.parametrize("fwhm_px", [2.0, 6.0])
@pytest.mark.parametrize("level", [-40, 0, 30])
def test_an_even_background_is_no_padding(tmp_path, level, fwhm_px):
    """A failure means that the background that tells sheets from gaps is lost; below 0 it is clipped."""
    x = combs.comb(60, per_side=6, axis_px=160, pitch_px=18, slip=0.4)
    light = level + 160 * combs.ridges(x, width=320, fwhm_px=fwhm_px)
    noise = np.random.default_rng(2).normal(0, 2, (60, 24, 320))
    flicker = 1 + 0.1 * np.sin(np.arange(60))[:, None, None]
    film = WRITERS["lossless"](tmp_path, as_pixels((light[:, None] + noise) * flicker))
    profile = strip_profile(open_video(film))
    assert profile.sizes["x"] == 320
    assert StripMetadata.of(profile).padding == []


def test_given_columns_are_kept(tmp_path):
    """Whoever gives the columns wants these."""
    pixels = np.pad(as_pixels(film(140, -70)[0]), ((0, 0), (0, 0), (64, 48)))
    profile = strip_profile(open_video(WRITERS["lossless"](tmp_path, pixels)), columns=slice(0, 432))
    assert profile.sizes["x"] == 432


def test_a_run_without_padding_is_read_at_its_columns(tmp_path):
    """A failure means that `certify` and `review` look for the sheets beside where they are."""
    pixels = np.pad(as_pixels(film(140, -70)[0]), ((0, 0), (0, 0), (64, 48)))
    run = tmp_path / "run"
    vision.save_run(vision.analyse(WRITERS["lossless"](tmp_path, pixels)), run)
    stored = read_strip(read_run(run))
    assert stored["x"].values[[0, -1]].tolist() == [64, 383]


def test_white_bars_are_not_called_overexposed(tmp_path):
    """A failure means that clipped pixels are looked for beside the picture."""
    pixels = np.pad(as_pixels(film(40, 90)[0]), ((0, 0), (0, 0), (64, 48)), constant_values=255)
    run = vision.analyse(WRITERS["lossless"](tmp_path, pixels))
    assert not any("brightest" in line for line in run.warnings)
