"""What is drawn of long records: slips stay whole, pictures stay true."""

import tracemalloc

import numpy as np
import pytest

from vision.figures.decimate import grey_levels, minmax_decimate, time_rows


def test_a_slip_of_one_frame_keeps_its_full_height():
    """A failure means that a slip can vanish from the report of a long test."""
    y = np.zeros((100_000, 3))
    y[54_321, 1], y[77_777, 2] = 5.0, -3.0
    _, shown = minmax_decimate(np.arange(100_000.0), y, most=2000)
    assert len(shown) <= 2000
    assert (shown[:, 1].max(), shown[:, 2].min()) == (5.0, -3.0)


def test_means_would_lose_that_slip():
    """The plain way to thin a record fails here, so the test above is not empty."""
    y = np.zeros(100_000)
    y[54_321] = 5.0
    assert y.reshape(1000, -1).mean(axis=1).max() < 0.1


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


def test_picture_rows_are_means_of_their_frames():
    """A failure means that the space-time diagram shows other grey values than the strip."""
    values = np.random.default_rng(2).normal(100, 10, (6400, 7)).astype(np.float32)
    rows, edges = time_rows(values, np.arange(6400) / 60, most=200)
    assert rows.shape == (200, 7)
    assert len(edges) == 201
    direct = values[: 32 * 199].reshape(199, 32, 7).mean(axis=1)
    # the first row may take one frame more or less than the plain split does
    np.testing.assert_allclose(rows[5:190].mean(axis=0), direct[5:190].mean(axis=0), rtol=5e-3)
    assert np.isfinite(rows).all()


def test_every_frame_has_its_own_row_while_there_is_room():
    """A failure means that frames are shifted or merged without need."""
    values = np.arange(50, dtype=np.float32)[:, None] * np.ones((1, 3), np.float32)
    rows, _ = time_rows(values, np.arange(50) * 0.04, most=1200)
    np.testing.assert_array_equal(rows, values)


def test_lost_frames_leave_their_rows_empty():
    """A failure means that frames which do not exist are shown as if they did."""
    values = np.ones((100, 2), np.float32)
    values[40:50] = np.nan
    rows, _ = time_rows(values, np.arange(100.0), most=1200)
    assert np.isnan(rows[40:50]).all()
    assert np.isfinite(rows[np.r_[0:40, 50:100]]).all()


def test_a_pause_of_the_camera_keeps_the_time_scale():
    """A failure means that the tracks do not lie on their ridges after a pause in the recording."""
    time = np.r_[np.arange(100.0), 200 + np.arange(100.0)]
    values = np.r_[np.zeros((100, 1)), np.ones((100, 1))].astype(np.float32)
    rows, edges = time_rows(values, time, most=150)
    centre = (edges[:-1] + edges[1:]) / 2
    assert (rows[(centre > 203)] == 1).all()
    assert (rows[(centre < 97)] == 0).all()
    assert np.isnan(rows[(centre > 110) & (centre < 190)]).all()


def test_grey_levels_span_black_to_white():
    """A failure means a picture without contrast, or unknown pixels shown as black."""
    grey = grey_levels(np.array([0.0, 50.0, 100.0, 200.0, np.nan]), 0.0, 100.0)
    assert grey.tolist() == [0, 128, 255, 255, 128]


def test_positions_of_a_long_film_are_reduced_a_few_sheets_at_a_time():
    """A failure means that drawing a long film takes several copies of its positions."""
    positions = np.zeros((40_000, 30))
    tracemalloc.start()
    try:
        minmax_decimate(np.arange(40_000.0), positions, most=2000)
        assert tracemalloc.get_traced_memory()[1] < positions.nbytes / 2
    finally:
        tracemalloc.stop()
