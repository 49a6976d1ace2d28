"""Running medians and means, and maxima that are apart, against SciPy's."""

import tracemalloc

import numpy as np
import pytest
from scipy import ndimage
from scipy.signal import find_peaks

from vision.signals import enforce_distance, find_maxima, half_widths, running_mean, running_median


@pytest.mark.parametrize("size", [1, 2, 5, 6, 9])
@pytest.mark.parametrize("samples", [9, 70_000])  # less, and more, than is taken at once
def test_running_median_and_mean_are_those_of_scipy(samples, size):
    """A failure means that spikes are looked for, and loads smoothed, by another rule than the stated one."""
    line = np.random.default_rng(size).normal(5, 1, samples)
    np.testing.assert_array_equal(
        running_median(line, size), ndimage.median_filter(line, size, mode="nearest")
    )
    mirrored = ndimage.median_filter(line, size, mode="reflect")
    np.testing.assert_array_equal(running_median(line, size, ends="symmetric"), mirrored)
    mean = ndimage.uniform_filter1d(line, size, mode="nearest")
    np.testing.assert_allclose(running_mean(line, size), mean, atol=1e-9)


@pytest.mark.parametrize("seed", range(10))
def test_maxima_apart_are_those_of_scipy(seed):
    """A failure means that one slip is counted twice, or that two are taken for one."""
    line = np.random.default_rng(seed).normal(0, 1, 400).cumsum()
    found = find_maxima(line, least_prominence=1e-9, reach=line.size)
    expected, _ = find_peaks(line, distance=7)
    np.testing.assert_array_equal(enforce_distance(found.at, line[found.at], 7), expected)
    assert len(expected) < len(found.at)


@pytest.mark.parametrize("seed", range(20))
def test_maxima_of_lines_with_flat_tops_are_those_of_scipy(seed):
    """A failure means that a saturated ridge, or one among noise, is missed or stands elsewhere."""
    rng = np.random.default_rng(seed)
    line = rng.integers(0, 12, 500).repeat(rng.integers(1, 6, 500)).astype(np.float32)
    line += rng.normal(0, 0.2, line.size).astype(np.float32) * (seed % 2)
    found = find_maxima(line, least_prominence=2.0, reach=25, widest=4)
    expected, facts = find_peaks(line, prominence=2.0, wlen=51, plateau_size=(None, 4))
    np.testing.assert_array_equal(found.at, expected)
    np.testing.assert_array_equal(found.prominence, facts["prominences"])
    assert len(expected) > 20


def test_a_width_is_that_at_half_the_height():
    """A failure means that windows of fits, which follow the ridges' width, are too narrow or too wide."""
    line = 5 + 80 * np.exp(-((np.arange(200) - 100.0) ** 2) / (2 * 6.0**2))
    found = find_maxima(line, least_prominence=1.0, reach=200)
    assert found.at.tolist() == [100]
    assert half_widths(line, found)[0] == pytest.approx(2.3548 * 6.0, rel=5e-3)


def test_running_median_takes_little_memory():
    """Failure: a recording of a million samples takes a GB, as the windows of all are kept."""
    values = np.random.default_rng(3).normal(size=50_000)
    running_median(values[:1000], 101)
    tracemalloc.start()
    found = running_median(values, 101)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 15 * values.nbytes
    assert found[777] == np.median(values[777 - 50 : 777 + 51])
