"""Robust statistics against NumPy's own, and indices spread over a record."""

import numpy as np
import pytest

from vision.numeric import nan_median, nan_quantile, spread_indices


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("shape", [(7, 40), (1400, 6), (6, 1401)])
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


def test_indices_are_spread_from_the_first_to_the_last():
    """A failure means a sample of a recording that misses its end, or names a frame twice."""
    assert spread_indices(101, 5).tolist() == [0, 25, 50, 75, 100]
    assert spread_indices(3, 5).tolist() == [0, 1, 2]
    assert spread_indices(1, 5).tolist() == [0]
