"""Noise, its autocorrelation and the fixed-pattern error, on made tracks and on their own."""

import numpy as np
import pytest

from tests.scenes.creeping import PIXEL_UM, errors, make, measure, uniform
from vision.deformation.creep import Creep, legendre
from vision.deformation.noise import (
    AR1Noise,
    Noise,
    fixed_pattern_gain,
    fixed_pattern_px,
)
from vision.deformation.settings import DeformationSettings


@pytest.mark.parametrize("frames", [8, 30])
def test_noise_and_its_memory_are_found_in_short_sticks(frames):
    """A failure means that removing the creep passes for removing the noise's memory or size."""
    made = make(uniform(1.0, 20.0), frames=frames, noise_px=0.05, rho=0.6)
    motion = measure(made)
    assert motion["noise_um"].mean() / PIXEL_UM == pytest.approx(0.05, rel=0.08)
    assert motion.attrs["noise_rho"] == pytest.approx(0.6, abs=0.1)
    assert motion.attrs["noise_share"] > 0.9


def test_errors_that_forget_the_memory_are_too_small():
    """Errors as for white noise must fail here, or the test of the stated error could not notice them."""
    made = make(uniform(0.3, 20.0), frames=60, noise_px=0.05, rho=0.6)
    motion = measure(made)
    wrong, stated = errors(made, motion)
    as_white = stated * np.sqrt(
        np.repeat(motion["effective_frames"], 20).to_numpy() / motion["frames"].to_numpy().ravel()
    )
    assert np.mean(np.abs(wrong) < as_white) < 0.55
    assert 0.60 < np.mean(np.abs(wrong) < stated) < 0.75


def test_white_noise_on_top_of_slow_noise():
    """A failure means that half-white noise is taken for white or for all slow, and errors are off."""
    made = make(uniform(0.3, 20.0), frames=60, noise_px=0.04, white_px=0.04, rho=0.7)
    motion = measure(made)
    wrong, stated = errors(made, motion)
    assert motion.attrs["noise_share"] == pytest.approx(0.5, abs=0.15)
    assert 0.60 < np.mean(np.abs(wrong) < stated) < 0.75


def test_a_noisy_sheet_has_its_own_error():
    """A failure means that one blurred sheet borrows the precision of its neighbours."""
    made = make(uniform(0.5, 20.0, events=60), noise_px=0.02)
    extra = 0.08 * np.random.default_rng(5).standard_normal(made.tracks.sizes["frame"])
    made.tracks["x_px"][:, 3] += extra
    motion = measure(made)
    assert motion["noise_um"][3] / PIXEL_UM == pytest.approx(np.hypot(0.02, 0.08), rel=0.1)
    assert motion["noise_um"][4] / PIXEL_UM == pytest.approx(0.02, rel=0.1)
    assert (motion["ratio_err"][:, 3] > 3 * motion["ratio_err"][:, 4]).all()


def test_a_sheet_that_slips_by_itself_has_a_larger_error():
    """A failure means that a jump within a stick passes for creep with the error of a quiet sheet."""
    made = make(uniform(0.5, 20.0, events=20), noise_px=0.02)
    quiet = measure(made)
    inside = 5 + made.tracks["time_s"].to_numpy() > made.sticks["t_v_s"][7] + 0.2
    made.tracks["x_px"][:, 6] += np.where(inside, 3.0, 0.0)
    motion = measure(made)
    assert motion["flag"][7, 6] == "uneven"
    assert motion["ratio_err"][7, 6] > 3 * quiet["ratio_err"][7, 6]
    assert (np.delete(motion["flag"].to_numpy()[7], 6) == "ok").all()
    neighbours = np.delete((motion["ratio"] - quiet["ratio"])[7].to_numpy(), 6)
    assert np.abs(neighbours).max() < quiet["ratio_err"][7].min()
    others = np.delete(motion["ratio_err"].to_numpy(), 7, axis=0)
    np.testing.assert_allclose(others, np.delete(quiet["ratio_err"].to_numpy(), 7, axis=0), rtol=0.1)


def test_bends_that_turn_round_are_no_pattern():
    """A failure means that all errors are NaN where by chance nothing at all of the bends returns."""
    bends = np.zeros((2, 12, 3))
    bends[..., 1] = np.linspace(0.5, 5, 12)
    bends[..., 2] = np.cos(np.arange(12)) * [[1], [-1]]
    sure, inverse = np.ones((2, 12), bool), np.zeros((2, 12, 3, 3))
    noise = Noise(np.full(12, 0.05), AR1Noise(0.0, 0.0), np.ones((2, 12)))
    nothing = np.zeros((2, 12))
    creep = Creep(bends, inverse, nothing, nothing, np.full((2, 12), 40), sure)
    pattern = fixed_pattern_px(creep, np.full_like(bends, 1e-3), noise, DeformationSettings())
    np.testing.assert_array_equal(pattern, 0)


def test_how_much_of_a_fixed_pattern_goes_into_the_creep():
    """A failure means that the error of long sticks from unequal pixels has the wrong size."""
    rng = np.random.default_rng(4)
    response, u, reach = rng.standard_normal(6000), np.linspace(-1, 1, 401), 6.0
    pattern = np.convolve(response, -np.arange(-4, 5), "same")
    pattern /= pattern.std()
    at = rng.uniform(20, 5980, 1500)[:, None] + reach * u
    moved = np.interp(at, np.arange(6000), pattern)
    share = np.linalg.lstsq(legendre(u, 3), moved.T, rcond=None)[0]
    np.testing.assert_allclose(np.sqrt((share**2).mean(axis=1)), fixed_pattern_gain(reach, 3), rtol=0.1)
