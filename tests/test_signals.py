"""Running medians and means, and maxima that are apart, against SciPy's; extremes of intervals."""

import tracemalloc

import numpy as np
import pytest
from scipy import ndimage
from scipy.signal import find_peaks

from vision.signals import (
    enforce_distance,
    find_maxima,
    half_widths,
    minmax_decimate,
    running_mean,
    running_median,
)


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


def test_a_slip_of_one_frame_keeps_its_full_height():
    """A failure means that a slip can vanish from the report of a long test."""
    y = np.zeros((100_000, 3))
    y[54_321, 1], y[77_777, 2] = 5.0, -3.0
    _, shown = minmax_decimate(np.arange(100_000.0), y, most=2000)
    assert len(shown) <= 2000
    assert (shown[:, 1].max(), shown[:, 2].min()) == (5.0, -3.0)


@pytest.mark.parametrize("sign", [1, -1])
def test_the_decimated_curve_keeps_the_order_in_time(sign):
    """A failure means that a rising stretch could be drawn as falling: a slip with the wrong sign."""
    y = sign * np.arange(10_000.0)[:, None]
    _, shown = minmax_decimate(np.arange(10_000.0), y, most=500)
    assert (np.diff(sign * shown[:, 0]) > 0).all()


def test_the_decimated_curve_says_when_within_one_stretch():
    """A failure means that events are drawn at the wrong time."""
    time = np.arange(60_000) / 60
    y = (time > 700).astype(float)[:, None]
    x, shown = minmax_decimate(time, y, most=3000)
    stretch = time[-1] / (len(x) / 2)
    assert abs(x[np.argmax(shown[:, 0] > 0.5)] - 700) <= stretch


def test_short_records_are_drawn_as_they_are():
    """A failure means that a short record loses points for nothing."""
    time, y = np.arange(50.0), np.random.default_rng(0).normal(size=(50, 2))
    x, shown = minmax_decimate(time, y, most=50)
    np.testing.assert_array_equal(x, time)
    np.testing.assert_array_equal(shown, y)


def test_unknown_stretches_stay_unknown():
    """A failure means that a gap is drawn over, or that one missing frame empties a stretch."""
    y = np.ones((4000, 2))
    y[1000:2000, 0] = np.nan
    y[::3, 1] = np.nan
    x, shown = minmax_decimate(np.arange(4000.0), y, most=400)
    inside = (x >= 1020) & (x < 1980)
    assert np.isnan(shown[inside, 0]).all()
    assert np.isfinite(shown[~((x > 980) & (x < 2020)), 0]).all()
    assert np.isfinite(shown[:, 1]).all()


def test_positions_of_a_long_film_are_reduced_a_few_sheets_at_a_time():
    """A failure means that drawing a long film takes several copies of its positions."""
    positions = np.zeros((40_000, 30))
    tracemalloc.start()
    try:
        minmax_decimate(np.arange(40_000.0), positions, most=2000)
        assert tracemalloc.get_traced_memory()[1] < positions.nbytes / 2
    finally:
        tracemalloc.stop()
