"""White noise and spikes of a load."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.scenes.sawtooth import signal_of
from vision.force.settings import ForceSettings
from vision.force.signal import find_spikes, noise_sigma, with_slow_noise
from vision.force.slips import find_slips


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


@pytest.mark.parametrize("whole", [5, 20])
def test_noise_is_that_of_the_sticks_with_good_samples(whole: int) -> None:
    """A failure means sticks of which all samples are spikes, as of a ringing load, end the analysis or
    change the noise."""
    rng = np.random.default_rng(3)
    noise = np.convolve(rng.standard_normal(8000), np.ones(20) / 4, "same")
    signal = signal_of(50 * (np.arange(8000) % 100) / 100 + noise, 0.5)
    slips = find_slips(signal.clean, 0.5)
    ringing = replace(signal, is_spike=np.arange(8000) >= 100 * (whole + 1))
    assert slips.edge.size == 79
    found = with_slow_noise(ringing, slips, ForceSettings())
    if whole < 8:
        assert found.slow is None
    else:
        assert found.alike == pytest.approx(with_slow_noise(signal, slips, ForceSettings()).alike, rel=0.5)
