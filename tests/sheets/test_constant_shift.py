"""Errors of positions that are the same in all frames: by neighbours, uneven light and lopsided ridges."""

import tracemalloc

import numpy as np
import pytest

from tests.scenes.combs import comb, ridges, strip
from vision.sheets import constant_shift, track_sheets
from vision.sheets.ridges import describe_ridges


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


def test_sheets_with_a_texture_have_the_usual_constant_error(monkeypatch):
    """The texture shifts maxima and flanks, of some sheets both alike. A failure means that most are off
    by more than the stated error."""
    x = comb(60, per_side=12, pitch_px=15.0, axis_px=190, uneven=0.03, slip=0.15)
    random = np.random.default_rng(5)
    parts = [
        ridges(x + away, width=380, fwhm_px=2.0, contrast=np.exp(random.normal(0, 0.12, 24)))
        for away in range(-3, 4)
    ]
    picture = strip(np.sum(parts, axis=0), snr=200)
    within = {}
    for usual in (True, False):
        if not usual:
            monkeypatch.setattr(constant_shift, "sigma_about_zero", lambda own: own)
        tracks = track_sheets(picture, sheets=24)
        off = np.nanmean(tracks.x_px.values - x, axis=0)
        within[usual] = (np.abs(off) < tracks.constant_error_px.values).mean()
    assert 0.5 < within[True] < 0.8
    assert within[False] < 0.4


def test_sheets_with_few_positions_have_a_constant_error():
    """Six frames of two thousand have positions, as where most identities are doubtful, and one sheet has
    none. A failure means that the run ends with an unexpected error, or that this sheet has an error."""
    x = comb(2000, per_side=4, pitch_px=16.0, axis_px=100)
    profile = ridges(x, width=200, fwhm_px=7.0)
    described = describe_ridges(profile, sheets=8)
    x[:, 3] = x[:1002] = x[1008:] = np.nan
    size = constant_shift.constant_shift(profile, x, 9, described).size_px
    assert np.flatnonzero(np.isnan(size)).tolist() == [3]
    assert np.nanmax(size) < 0.15
    x[:] = np.nan
    assert np.isnan(constant_shift.constant_shift(profile, x, 9, described).size_px).all()


@pytest.mark.parametrize("left_out", [7, 19])
def test_a_ridge_that_is_no_sheet_does_not_spoil_the_fit(left_out):
    """A ridge has no positions, or lies beyond the last sheet. A failure means that errors of its neighbours
    of a hundredth of a pixel are stated as up to five pixels."""
    x = comb(60, per_side=10, pitch_px=16.0, axis_px=180, uneven=0.05, slip=0.15)
    height = np.exp(np.random.default_rng(0).uniform(-0.4, 0.4, 20))
    profile = strip(ridges(x, width=360, fwhm_px=7.0, contrast=height), snr=200).values
    shown = np.delete(x, left_out, axis=1)
    shift = constant_shift.constant_shift(profile, shown, 9, describe_ridges(profile, sheets=20))
    assert shift.size_px.max() < 0.1


def test_dark_lines_within_bright_bands_have_no_large_error():
    """The sheets are dark lines in the middle of bright bands, which are no ridges on a smooth background. A
    failure means that errors of several pixels are stated, the widths of what is fitted to the bands."""
    x = comb(40, per_side=4, pitch_px=100.0, axis_px=450)
    band, line = ridges(x, width=900, fwhm_px=4.0, flat_px=26.0), ridges(x, width=900, fwhm_px=14.0)
    profile = np.linspace(150, 10, 900) + 100 * band / band.max() - 70 * line / line.max()
    described = describe_ridges(profile, polarity="dark", sheets=8)
    size = constant_shift.constant_shift(profile.astype(np.float32), x, 25, described).size_px
    assert not (size > 1).any()


def test_a_position_beside_its_ridge_has_no_error_larger_than_the_pitch():
    """A position lies between sharp ridges, where noise alone rises and falls. A failure means that the
    middle of flanks that are not there is put far away."""
    x = comb(40, per_side=5, pitch_px=20.0, axis_px=120)
    noise = np.random.default_rng(1).normal(0, 1, (40, 240)).astype(np.float32)
    profile = ridges(x, width=240, fwhm_px=2.0) + noise
    described = describe_ridges(profile, sheets=10)
    for away in np.linspace(0.0, 10.0, 81):
        shown = x + away * (np.arange(10) == 4)
        assert np.nanmax(constant_shift.constant_shift(profile, shown, 9, described).shape) < 20


def test_the_constant_error_of_many_sheets_needs_little_memory(monkeypatch):
    """The fit compares pixels with the ridges beside them alone, which changes nothing. A failure means that
    a comb of 300 sheets needs hundreds of megabytes and seconds, or has other errors."""
    x = comb(60, per_side=150, pitch_px=12.0, axis_px=1830, uneven=0.05)
    profile = ridges(x, width=3660, fwhm_px=8.0)
    described = describe_ridges(profile, sheets=300)
    tracemalloc.start()
    shift = constant_shift.constant_shift(profile, x, 9, described)
    assert tracemalloc.get_traced_memory()[1] < 80e6
    tracemalloc.stop()
    monkeypatch.setattr(constant_shift, "TOGETHER", 300)
    whole = constant_shift.constant_shift(profile, x, 9, described)
    assert np.abs(np.subtract(shift, whole)).max() < 1e-4
    assert np.nanmax(shift.size_px) > 0.01
