"""How near x(n,t) comes to the truth: against the Cramér–Rao bound, and against the paper's fit."""

from functools import cache

import numpy as np
import pytest

from tests.scenes.combs import bound_px, comb, ridges, strip
from vision.sheets import track_sheets

SNR = 100
FRAMES = 400


def scene(*, fwhm_px, snr=SNR, pitch_px=20.0, per_side=15, flat_px=0.0):
    """A comb that slips and drifts by three pixels, so that every fraction of a pixel is met."""
    drift = np.linspace(0, 3, FRAMES)[:, None]
    x = comb(FRAMES, pitch_px=pitch_px, per_side=per_side) + drift
    return x, strip(ridges(x, fwhm_px=fwhm_px, flat_px=flat_px), snr=snr)


def locking_px(x, truth):
    """Peak to peak of the mean error against the fraction of a pixel the sheet truly stands at."""
    known = np.isfinite(x)
    bin_ = (truth[known] % 1 * 20).astype(int)
    return np.ptp(np.bincount(bin_, (x - truth)[known], 20) / np.bincount(bin_, minlength=20))


def rms(values):
    return np.sqrt(np.nanmean(values**2))


@pytest.fixture(scope="module", params=[6, 7, 8], ids=lambda fwhm: f"fwhm{fwhm}")
def usual(request):
    """The case the accuracy is promised for: FWHM 6–8 px, profile SNR 100, pitch 20 px."""
    truth, picture = scene(fwhm_px=request.param)
    return request.param, truth, cache(lambda fit: track_sheets(picture, fit=fit))


@pytest.mark.thorough
@pytest.mark.parametrize("fit", ["auto", "sliding"])
def test_the_usual_fits_are_near_the_bound_and_do_not_lock(usual, fit):
    """A failure means positions are noisier than the light allows, or biased with the fraction of a pixel."""
    fwhm, truth, tracked = usual
    x = tracked(fit).x_px.values
    ratio = rms(x - truth) / bound_px(fwhm, SNR)
    assert np.isfinite(x).all()
    assert 0.95 < ratio < 1.25  # below the bound the scene, not the fit, would be wrong
    assert locking_px(x, truth) < 0.010


def test_template_is_at_the_bound(usual):
    """A failure means matching a ridge to its mean shape gives accuracy away, or moves the means."""
    fwhm, truth, tracked = usual
    x = tracked("template").x_px.values
    assert 0.95 < rms(x - truth) / bound_px(fwhm, SNR) < 1.1
    assert locking_px(x, truth) < 0.010
    assert np.abs(np.mean(x - truth, axis=0)).max() < 0.2 * bound_px(fwhm, SNR)


def test_the_papers_fit_locks_to_whole_pixels(usual):
    """The same scenes with the paper's fit: had they no locking, the tests above would prove nothing.

    The narrower the ridge, the stronger: 125, 80 and 55 mpx here.
    """
    fwhm, truth, tracked = usual
    x = tracked("paper").x_px.values
    least = {6: 0.110, 7: 0.070, 8: 0.045}[fwhm]
    assert least < locking_px(x, truth) < 0.200
    assert rms(x - truth) > 2 * bound_px(fwhm, SNR)


@pytest.mark.parametrize("fit", ["sliding", "paper", "template"])
def test_stated_errors_are_the_scatter(usual, fit):
    """A failure means x_err_px cannot be used as an error bar (the paper's includes its locking)."""
    _, truth, tracked = usual
    tracks = tracked(fit)
    assert 0.9 < rms(tracks.x_err_px.values) / rms(tracks.x_px.values - truth) < 1.1


@pytest.mark.parametrize("snr", [20, 300])
def test_stated_errors_follow_the_noise(snr):
    """A failure means x_err_px holds at one noise only."""
    truth, picture = scene(fwhm_px=7, snr=snr)
    tracks = track_sheets(picture)
    assert 0.9 < rms(tracks.x_err_px.values) / rms(tracks.x_px.values - truth) < 1.1


@pytest.mark.thorough
@pytest.mark.parametrize("fit", ["sliding", "template"])
@pytest.mark.parametrize(
    ("edge_px", "flat_px", "pitch_px", "per_side"),
    [(3, 0, 12, 25), (8, 20, 50, 10), (6, 24, 60, 8), (8, 30, 60, 8)],
    ids=["3px", "flat20px", "flat24px", "flat30px"],
)
def test_windows_follow_the_width(edge_px, flat_px, pitch_px, per_side, fit):
    """A failure means narrow or broad ridges are fitted with the wrong window or have wrong errors."""
    truth, picture = scene(fwhm_px=edge_px, flat_px=flat_px, pitch_px=pitch_px, per_side=per_side)
    tracks = track_sheets(picture, fit=fit)
    error = tracks.x_px.values - truth
    assert np.isfinite(error).mean() > 0.999
    assert 0.9 < rms(tracks.x_err_px.values) / rms(error) < 1.1
    assert locking_px(tracks.x_px.values, truth) < 0.010
    assert rms(error) < 0.030


def test_nine_pixels_do_not_suit_a_flat_bottom():
    """The fixed window on a 24-px ridge sees only its flat middle: the reason windows follow the width."""
    truth, picture = scene(fwhm_px=6, flat_px=24, pitch_px=60, per_side=8)
    fixed = track_sheets(picture, window_px=9).x_px.values
    own = track_sheets(picture).x_px.values
    assert rms(fixed - truth) > 5 * rms(own - truth)


@pytest.mark.parametrize("fwhm", [6, 8])
def test_measured_noise_is_the_scatter(fwhm):
    """A failure means x_noise_px, which noise corrections of σ_x rest on, is wrong.

    Half the sheets slip by more than the noise in every 25th frame; that must not count.
    """
    truth, picture = scene(fwhm_px=fwhm)
    tracks = track_sheets(picture)
    scatter = np.std(tracks.x_px.values - truth, axis=0)
    ratio = tracks.x_noise_px.values / scatter
    assert 0.93 < np.median(ratio) < 1.1
    assert ((ratio > 0.75) & (ratio < 1.3)).all()


def test_measured_noise_leaves_out_vibration_and_creep():
    """A failure means a shaking or drifting camera is mistaken for noise of the positions."""
    truth, _ = scene(fwhm_px=7)
    shaken = (
        truth + np.random.default_rng(3).normal(0, 0.3, FRAMES)[:, None] + np.linspace(0, 40, FRAMES)[:, None]
    )
    tracks = track_sheets(strip(ridges(shaken)))
    assert np.median(tracks.x_noise_px.values) < 1.15 * rms(tracks.x_px.values - shaken)


def test_brighter_noise_on_some_sheets_shows_in_their_errors():
    """A failure means one figure of noise is used for all sheets, though bright ridges are noisier."""
    truth, picture = scene(fwhm_px=7, per_side=25)
    loud = picture.copy()
    loud.values[:, 600:] += np.random.default_rng(4).normal(0, 3 * 60 / SNR, loud.values[:, 600:].shape)
    tracks = track_sheets(loud)
    error, stated = tracks.x_px.values - truth, tracks.x_err_px.values
    for half in (slice(0, 24), slice(26, 50)):
        assert 0.9 < rms(stated[:, half]) / rms(error[:, half]) < 1.1
    assert rms(error[:, 26:]) > 2.5 * rms(error[:, :24])
