"""Errors of positions that are the same in all frames: by neighbours, uneven light and lopsided ridges."""

import numpy as np
import pytest

from tests.scenes.combs import comb, ridges, strip
from vision.sheets import constant_shift, track_sheets


def unequal(seed, *, widths_apart=1.5, dark=False, gradient=0.0, flat=0.0):
    """Ridges of unlike height and width, so many widths apart; how far each is off, and the tracks."""
    random = np.random.default_rng(seed)
    x = comb(80, per_side=10, pitch_px=16.0, axis_px=180, uneven=0.05, slip=0.15, seed=seed)
    height, width = (np.exp(random.uniform(-most, most, 20)) for most in (0.4, 0.15))
    wide = 16.0 / widths_apart * width * (0.6 if flat else 1.0)
    picture = strip(
        ridges(x, width=360, fwhm_px=wide, contrast=height, flat_px=flat * 16.0 / widths_apart), snr=200
    )
    picture.values[:] *= 1 + gradient * (np.arange(360) / 360 - 0.5)
    if dark:
        picture.values[:] = 220 - picture.values
    tracks = track_sheets(picture, sheets=20, ridges="dark" if dark else "bright")
    return np.nanmean(tracks.x_px.values - x, axis=0), tracks


@pytest.mark.parametrize(
    "scene", [{}, {"dark": True}, {"gradient": 0.6}, {"flat": 0.6, "widths_apart": 1.25}], ids=str
)
def test_unequal_neighbours_that_overlap_are_in_the_constant_error(scene):
    """A bright or wide neighbour pulls all positions of a sheet towards it. A failure means that positions
    are off by up to a seventh of a pixel in every frame and no error says so, or that errors are far too
    large."""
    films = [unequal(seed, **scene) for seed in range(4)]
    off = np.concatenate([one for one, _ in films])
    stated, overlap, light = (
        np.concatenate([tracks[name].values for _, tracks in films])
        for name in ("constant_error_px", "x_overlap_px", "x_light_px")
    )
    assert np.abs(off).max() > 0.04
    assert (np.abs(off) < 2 * stated + 0.004).mean() > 0.97
    assert np.median(stated) < 2.5 * np.median(np.abs(off)) + 0.004
    assert np.std(off - overlap - light) < 0.5 * np.std(off) + 0.002


@pytest.mark.parametrize("widths_apart", [2.2, 3.0])
def test_unequal_ridges_that_do_not_overlap_have_no_constant_error(widths_apart):
    """The gaps between unequal ridges are unequally bright where their tails meet, in even light as well. A
    failure means that this passes for uneven light."""
    off, tracks = unequal(5, widths_apart=widths_apart)
    assert np.abs(off).max() < 0.02
    assert float(tracks.constant_error_px.max()) < 2 * np.abs(off).max() + 0.006


@pytest.mark.parametrize("side", [-1, 1])
def test_sheets_that_are_brighter_on_one_side_have_a_constant_error(side, monkeypatch):
    """Each sheet is up to 0.3 times brighter at the edge that faces the lamp, and positions lie by up to half
    a pixel towards it in all frames. A failure means that no error says so."""
    x = comb(80, per_side=8, pitch_px=18.0, axis_px=160, uneven=0.05, slip=0.15)
    slope = side * np.random.default_rng(3).uniform(0.0, 0.3, 16)
    parts = [
        ridges(x + away, width=320, fwhm_px=3.0, flat_px=1.0, contrast=1 + slope * away / 3)
        for away in range(-3, 4)
    ]
    picture = strip(np.sum(parts, axis=0), snr=100)
    for factor, said in ((constant_shift.LOPSIDED, True), (0.0, False)):
        monkeypatch.setattr(constant_shift, "LOPSIDED", factor)
        tracks = track_sheets(picture, sheets=16)
        off = np.nanmean(tracks.x_px.values - x, axis=0)
        assert (side * off > -0.01).all() and np.abs(off).max() > 0.3
        assert ((np.abs(off) < 2 * tracks.constant_error_px.values + 0.01).mean() > 0.9) == said
