"""Width, pitch, contrast and polarity of a comb; and the candidates of every frame."""

import numpy as np
import pytest
from scipy.signal import find_peaks

from tests.scenes.combs import CONTRAST, comb, ridges, strip
from vision.errors import InputError
from vision.sheets import track_sheets
from vision.sheets.ridges import describe_ridges, find_ridges, profile_noise
from vision.signals import find_maxima, half_widths

FRAMES, SHEETS, PITCH, FWHM = 40, 16, 20.0, 7.0


def drawn(*, sign=1, snr=100.0, fwhm_px=FWHM, width=520):
    truth = comb(FRAMES, per_side=SHEETS // 2, axis_px=width / 2, slip=0.2)
    return truth, strip(ridges(truth, width=width, fwhm_px=fwhm_px), sign=sign, snr=snr).values


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("fwhm", [4.0, 7.0, 9.0])
def test_a_known_comb_is_described_as_drawn(sign, fwhm):
    """A failure means that thresholds and windows, which follow these figures, are wrong."""
    _, profile = drawn(sign=sign, fwhm_px=fwhm)
    found = describe_ridges(profile)
    assert found.polarity == ("bright" if sign > 0 else "dark")
    assert found.fwhm_px == pytest.approx(fwhm, rel=0.12)
    assert found.pitch_px == pytest.approx(PITCH, abs=1)
    assert found.contrast == pytest.approx(CONTRAST, rel=0.15)
    assert found.noise == pytest.approx(CONTRAST / 100, rel=0.1)
    assert found.count == SHEETS


def test_noise_is_measured_beside_ridges_and_not_made_of_them():
    """A failure means that sharp ridges count as noise, and faint sheets are then missed."""
    _, clean = drawn(snr=1e6)
    assert profile_noise(clean) < 0.01
    white = np.random.default_rng(1).normal(0, 2.5, clean.shape).astype(np.float32)
    assert profile_noise(clean + white) == pytest.approx(2.5, rel=0.03)


def test_every_ridge_of_every_frame_is_a_candidate_at_its_pixel():
    """A failure means that fits start at the wrong pixel, or that sheets are missed."""
    truth, profile = drawn()
    found = find_ridges(profile, describe_ridges(profile))
    assert (found.count == SHEETS).all()
    assert np.abs(found.x_px - truth).max() <= 1
    np.testing.assert_allclose(found.contrast, CONTRAST, rtol=0.2)
    np.testing.assert_allclose(found.fwhm_px, FWHM, rtol=0.3)


def test_hot_pixels_edges_and_empty_frames_are_no_candidates():
    """A failure means that a defect of the sensor, the picture's rim or a lost frame passes for a sheet."""
    truth, profile = drawn()
    described = describe_ridges(profile)
    hot = profile.copy()
    hot[:, 20] += CONTRAST
    hot[:, -1] += CONTRAST
    hot[7] = np.nan
    found = find_ridges(hot, described)
    assert truth.min() > 40
    assert not (found.x_px < 40).any()
    assert found.count[7] == 0
    assert (np.delete(found.count, 7) == SHEETS).all()


def test_what_no_longer_stands_out_is_no_candidate():
    """The same ridges in forty times the noise: had these candidates too, thresholds would do nothing."""
    _, profile = drawn()
    noise = np.random.default_rng(2).normal(0, CONTRAST, profile.shape).astype(np.float32)
    loud = find_ridges(profile + noise, describe_ridges(profile + noise, sheets=SHEETS))
    assert loud.count.mean() < SHEETS / 2


@pytest.mark.parametrize("seed", range(60))
def test_maxima_are_those_of_scipy(seed):
    """A failure means that ridges are found, measured or left out by another rule than the documented one."""
    rng = np.random.default_rng(seed)
    levels, length = rng.integers(2, 12), rng.integers(3, 300)
    line = rng.integers(0, levels, length).astype(np.float32)  # plateaus, ties and equal neighbours
    if seed % 2:
        line += rng.normal(0, 1, length).astype(np.float32)
    reach, widest, least = int(rng.integers(4, 40)), int(rng.integers(1, 8)), rng.uniform(0.1, 3)
    whole = find_maxima(line, least_prominence=least, reach=length)
    near = find_maxima(line, least_prominence=least, reach=reach, widest=widest)
    for found, limits in ((whole, {}), (near, {"wlen": 2 * reach + 1, "plateau_size": (1, widest)})):
        at, facts = find_peaks(line, prominence=least, width=0.0, rel_height=0.5, **limits)
        np.testing.assert_array_equal(found.at, at)
        np.testing.assert_array_equal(found.prominence, facts["prominences"])
        np.testing.assert_allclose(half_widths(line, found), facts["widths"], atol=1e-11)


@pytest.mark.parametrize("sheets", [3, 4, 5])
def test_ridges_on_a_lit_base_are_not_one_wide_ridge(sheets):
    """A failure means that a film of few sheets on a lit block is given as one sheet as wide as the block."""
    x = comb(FRAMES, per_side=8, axis_px=260, slip=0.2)[:, 8 - sheets // 2 :][:, :sheets]
    columns = np.arange(520)
    base = (columns > x.min() - 12) & (columns < x.max() + 12)
    light = ridges(x, width=520, contrast=0.5) + 1.2 * base
    found = describe_ridges(strip(light).values)
    assert found.count == sheets
    assert found.pitch_px == pytest.approx(PITCH, abs=1)
    assert found.fwhm_px < 10


@pytest.mark.parametrize("pitch", [2.6, 3.5])
def test_a_comb_that_is_too_fine_is_refused_for_that(pitch):
    """A failure means that who filmed it from too far away is sent to look at rows and rotation."""
    fine = comb(60, per_side=20, pitch_px=pitch, axis_px=100, slip=0.3)
    picture = strip(ridges(fine, width=200, fwhm_px=pitch / 2))
    with pytest.raises(InputError, match=f"a pattern of {pitch} px"):
        track_sheets(picture)
    with pytest.raises(InputError, match="none above the noise"):
        track_sheets(strip(np.zeros((60, 200))))
