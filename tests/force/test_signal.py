"""White noise and spikes of a load."""

from __future__ import annotations

import numpy as np
import pytest

from vision.force.signal import find_spikes, noise_sigma


@pytest.mark.parametrize("sigma", [0.3, 2.0])
def test_noise_of_a_sawtooth_is_that_of_its_samples(sigma: float) -> None:
    """A failure means rises or drops count as noise, and with it thresholds and errors are wrong."""
    rng = np.random.default_rng(0)
    saw = 50 * (np.arange(20_000) % 200) / 200
    assert noise_sigma(saw + sigma * rng.standard_normal(saw.size)) == pytest.approx(sigma, rel=0.03)


def test_noise_is_never_below_the_quantum() -> None:
    """A failure means a coarse load cell, whose samples repeat, counts as free of noise."""
    steps = np.repeat(np.arange(100.0), 50) * 0.5
    assert noise_sigma(steps) == pytest.approx(0.5 / np.sqrt(12))


def test_spikes_are_found_and_corners_are_not() -> None:
    """A failure means spikes stay in the load, or peaks of a sawtooth are cut off."""
    rng = np.random.default_rng(1)
    saw = 50 * (np.arange(2000) % 40) / 40 + 0.2 * rng.standard_normal(2000)
    hit = np.arange(17, 2000, 40)
    spiky = saw.copy()
    spiky[hit] += 10
    found, clean = find_spikes(spiky, 0.2)
    np.testing.assert_array_equal(np.flatnonzero(found), hit)
    assert np.abs(clean - saw).max() < 5
    assert not find_spikes(saw, 0.2)[0].any()
