"""Robust statistics against NumPy's own, and indices spread over a record."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from vision.memory import in_two_threads, row_parts
from vision.numeric import (
    common_change,
    median_step,
    nan_median,
    nan_quantile,
    spread_indices,
    typical_median,
    typical_rows,
    typical_size,
    typical_where,
    weighted_median,
    without_common_change,
)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("shape", [(7, 40), (1400, 6), (6, 1401), (20_000, 30)])
def test_medians_and_quantiles_are_numpy_s_whatever_the_length(shape, axis):
    """A failure means that selecting the middle values of long recordings finds others than sorting does."""
    rng = np.random.default_rng(3)
    values = rng.normal(size=shape)
    values[rng.random(shape) < 0.2] = np.nan
    np.testing.assert_array_equal(nan_median(values, axis), np.nanmedian(values, axis))
    for fraction in (0.0, 0.25, 0.75, 1.0):
        expected = np.nanquantile(values, fraction, axis)
        np.testing.assert_allclose(nan_quantile(values, fraction, axis), expected, rtol=1e-14, atol=1e-15)


def test_where_nothing_is_left_there_is_no_value():
    """A failure means a warning, an error or a number for a sheet that was never seen."""
    values = np.full((1600, 2), np.nan)
    values[0, 1] = 4.0
    for found in (nan_median(values), nan_quantile(values, 0.75)):
        np.testing.assert_array_equal(found, [np.nan, 4.0])
    assert nan_median(np.empty((0, 2))).shape == nan_quantile(np.empty((0, 2)), 0.75).shape == (2,)


def test_computations_in_two_threads_may_contain_others():
    """A failure means that a thread waits for itself for ever."""

    def product(k):
        return sum(in_two_threads(lambda n: n * k, range(50)))

    found = ThreadPoolExecutor(1).submit(in_two_threads, product, range(50))
    assert found.result(timeout=20) == [1225 * k for k in range(50)]


def test_indices_are_spread_from_the_first_to_the_last():
    """A failure means a sample of a recording that misses its end, or names a frame twice."""
    assert spread_indices(101, 5).tolist() == [0, 25, 50, 75, 100]
    assert spread_indices(3, 5).tolist() == [0, 1, 2]
    assert spread_indices(1, 5).tolist() == [0]


@pytest.mark.parametrize(
    ("shape", "axis"), [((400, 300), 0), ((400, 300), 1), ((3, 1000, 70), 1), ((100_000,), 0)]
)
def test_medians_of_large_tables_are_those_of_their_parts(shape, axis):
    """A failure means that long films have other medians than short ones."""
    values = np.random.default_rng(0).normal(size=shape)
    values[values > 1.8] = np.nan
    np.testing.assert_array_equal(nan_median(values, axis=axis), np.nanmedian(values, axis=axis))
    expected = np.nanquantile(values, 0.9, axis=axis)
    np.testing.assert_allclose(nan_quantile(values, 0.9, axis=axis), expected, rtol=1e-12, atol=1e-15)


def test_typical_values_of_long_tables_are_those_of_all_rows():
    """A failure means that the typical values of long films are those of a part of the film, of some phases
    of a vibration, or none for a sheet that is seen in few frames."""
    rng = np.random.default_rng(2)
    rows = np.arange(40_960)
    table = rng.normal(size=(40_960, 4))
    table[:, 1] += 3.0 * (rows % 8 < 5)  # vibration: most frames are on one side
    table[:, 2] += rows / 1000  # creep
    table[rng.random(40_960) > 0.002, 3] = np.nan
    table[:, 3] += 7.0
    scatter = np.nanstd(table, axis=0)
    assert (np.abs(typical_median(table) - np.nanmedian(table, axis=0)) < 0.06 * scatter).all()
    assert typical_median(table)[3] == np.nanmedian(table[:, 3])
    known = table[:, :1] > 0
    assert abs(typical_where(known, table[:, :1])[0] - np.median(table[known[:, 0], 0])) < 0.04
    assert abs(typical_size(table[:, :1])[0] - 0.6745) < 0.03
    assert np.array_equal(typical_median(table[:4096]), nan_median(table[:4096]), equal_nan=True)
    chosen = typical_rows(40_960)
    assert len(chosen) == 4096 and (np.diff(chosen) > 0).all() and (np.bincount(chosen % 8) > 450).all()


@pytest.mark.parametrize("count", [1, 2, 5, 300, 30_000])
def test_half_of_the_weight_lies_up_to_a_weighted_median(count):
    """A failure means a wrong estimate of the errors of distorted ridges."""
    rng = np.random.default_rng(count)
    values, weights = rng.normal(size=count).round(3), rng.uniform(0.1, 2.0, count)
    values[5::7], weights[5::7] = np.nan, 0.0
    order = np.argsort(values)
    expected = values[order][np.searchsorted(np.cumsum(weights[order]), weights.sum() / 2)]
    assert weighted_median(values, weights) == expected


def test_common_changes_are_those_of_most_columns():
    """A failure means that vibration or flicker of all sheets counts as theirs."""
    rng = np.random.default_rng(1)
    common, own = rng.normal(size=(5000, 1)), np.arange(5.0)
    table = common + own
    np.testing.assert_allclose(median_step(table), np.diff(common[:, 0]), atol=1e-12)
    np.testing.assert_allclose(common_change(table, own), common[:, 0], atol=1e-12)
    np.testing.assert_allclose(np.ptp(without_common_change(table), axis=0), 0.0, atol=1e-12)
    assert [part.stop - part.start for part in row_parts(10, 4)] == [4, 4, 2]


@pytest.mark.parametrize("count", [0, 1, 2, 101])
def test_two_threads_return_all_results_in_order(count):
    """A failure means that parts of a table are exchanged, computed twice or left out."""
    done = []

    def work(k: int) -> int:
        done.append(k)
        return k * k

    assert in_two_threads(work, iter(range(count))) == [k * k for k in range(count)]
    assert sorted(done) == list(range(count))


@pytest.mark.parametrize("of_caller", [False, True])
def test_an_error_in_either_thread_is_raised(of_caller):
    """Both threads are at work. A failure means that a part of a table keeps values of nothing, without a
    message, or that the other thread works through the rest first."""
    both, done = threading.Barrier(2), []

    def work(k: int) -> None:
        if k < 2:
            both.wait(timeout=5)
        if (threading.current_thread() is threading.main_thread()) is of_caller:
            raise ValueError("wrong")
        time.sleep(0.02)
        done.append(k)

    with pytest.raises(ValueError, match="wrong"):
        in_two_threads(work, range(20))
    assert len(done) < 5
