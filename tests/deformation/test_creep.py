"""Frames of sticks, the Legendre fit to all of them at once, and sheets that slip late."""

import numpy as np
import pytest

from vision.deformation.creep import AR1Noise, find_late_slips, fit_creep, frames_of_sticks, legendre
from vision.deformation.settings import DeformationSettings

SETTINGS = DeformationSettings()


def frames_of(sticks=5, per_stick=40, *, fps=100.0, margin_s=0.0):
    """Frames of sticks that follow each other, the slips between two frames."""
    time = np.arange(sticks * per_stick) / fps
    begin = (np.arange(sticks + 1) * per_stick - 0.5) / fps
    return frames_of_sticks(time, begin[:-1], begin[1:], margin_s=margin_s, interval_s=1 / fps)


def test_frames_and_their_times_in_the_stick():
    """A failure means that frames count for the wrong stick, or at the wrong time in it."""
    frames = frames_of(3, 10)
    np.testing.assert_array_equal(frames.frame, np.arange(30))
    np.testing.assert_array_equal(frames.row, np.repeat(np.arange(3), 10))
    np.testing.assert_allclose(frames.u[:10], np.linspace(-0.9, 0.9, 10))
    np.testing.assert_allclose(frames.since_s[10:20], (np.arange(10) + 0.5) / 100)
    clear = frames_of(3, 10, margin_s=0.012)
    np.testing.assert_array_equal(clear.counts, [8, 8, 8])


def test_frames_without_a_time_or_with_a_stale_one():
    """A failure means that a wrong time stamp puts a frame where it was not taken."""
    time = np.array([0.0, 0.1, np.nan, 0.3, 0.3, 0.2, 0.6])
    frames = frames_of_sticks(time, np.array([-0.02]), np.array([1.0]), margin_s=0.0, interval_s=0.1)
    np.testing.assert_array_equal(frames.frame, [0, 1, 3, 6])
    np.testing.assert_array_equal(frames.slot, [0, 1, 3, 6])


def test_sums_and_minima_of_sticks_without_frames():
    """A failure means that a stick without frames takes those of its neighbour."""
    start, stop = np.array([0.0, 1.0, 2.0]), np.array([1.0, 2.0, 3.0])
    frames = frames_of_sticks(np.array([0.2, 0.4, 2.5]), start, stop, margin_s=0.0, interval_s=0.1)
    values = np.array([[1.0], [2.0], [5.0]])
    np.testing.assert_array_equal(frames.sums(values)[:, 0], [3, 0, 5])
    np.testing.assert_array_equal(frames.lowest(values)[:, 0], [1, np.inf, 5])


@pytest.mark.parametrize("terms", [2, 3, 4])
def test_a_series_is_found_again_with_gaps(terms):
    """A failure means that gaps shift the coefficients."""
    frames, rng = frames_of(), np.random.default_rng(1)
    true = rng.standard_normal((5, 3, terms))
    x = np.einsum("fk,fsk->fs", legendre(frames.u, terms), true[frames.row])
    x[rng.uniform(size=x.shape) < 0.2] = np.nan
    creep = fit_creep(x, frames, terms, SETTINGS)
    assert creep.good.all()
    np.testing.assert_allclose(creep.coefficient, true, atol=1e-10)
    known = np.isfinite(x)
    np.testing.assert_allclose(creep.at(frames)[known], x[known], atol=1e-10)
    np.testing.assert_array_equal(creep.count, frames.sums(known))


@pytest.mark.parametrize("noise", [AR1Noise(), AR1Noise(1.0, 0.8), AR1Noise(0.7, 0.8)])
def test_generalised_least_squares(noise):
    """A failure means that correlated noise, lost frames or gaps of single sheets go wrong in fits and
    errors."""
    time = np.delete(np.arange(60) / 10, [7, 19, 44])
    start, stop = np.array([0.04, 3.0]), np.array([3.0, 5.95])
    frames = frames_of_sticks(time, start, stop, margin_s=0.0, interval_s=0.1)
    x = 500 + np.random.default_rng(1).standard_normal((frames.row.size, 3))
    x[[3, 4, 40], 1] = np.nan
    creep = fit_creep(x, frames, 3, SETTINGS, noise)
    for stick, sheet in np.ndindex(2, 3):
        used = np.isfinite(x[:, sheet]) & (frames.row == stick)
        lag = np.abs(frames.slot[used][:, None] - frames.slot[used])
        matrix = np.where(lag == 0, 1.0, noise.share * noise.rho**lag)
        design, precision = legendre(frames.u[used], 3), np.linalg.inv(matrix)
        inverse = np.linalg.inv(design.T @ precision @ design)
        expected = inverse @ design.T @ precision @ x[used, sheet]
        away = x[used, sheet] - design @ expected
        np.testing.assert_allclose(creep.coefficient[stick, sheet], expected, rtol=1e-9)
        np.testing.assert_allclose(creep.inverse[stick, sheet], inverse, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(creep.square[stick, sheet], away @ precision @ away, rtol=1e-9)
        np.testing.assert_allclose(creep.log_det[stick, sheet], np.linalg.slogdet(matrix)[1], atol=1e-9)


def test_too_few_positions_or_too_short_a_part():
    """A failure means that a creep is made up."""
    frames = frames_of(2, 40)
    x = np.zeros((80, 3))
    x[3:40, 0] = np.nan
    x[15:40, 1] = np.nan  # 15 of 40 span less than two fifths
    good = fit_creep(x, frames, 2, SETTINGS).good
    np.testing.assert_array_equal(good, [[False, False, True], [True, True, True]])


def test_a_sheet_that_slips_late():
    """A failure means that frames before its slip count as creep, or those of punctual sheets are lost."""
    frames, rng = frames_of(), np.random.default_rng(2)
    x = -5.0 * frames.u[:, None] * np.ones(12) + 0.02 * rng.standard_normal((frames.row.size, 12))
    late = np.flatnonzero(frames.row == 2)[:2]
    x[late, 4] += -10.0  # still where the creep before had taken it
    found = find_late_slips(x, frames, SETTINGS)
    np.testing.assert_array_equal(np.argwhere(found.outside), [[late[0], 4], [late[1], 4]])
    assert found.lost[2, 4] == pytest.approx(2 / 40, abs=0.5 / 40)
    assert np.delete(found.lost.ravel(), 2 * 12 + 4).max() < 0.5 / 40
    punctual = np.where(found.outside, x + 10.0, x)
    assert not find_late_slips(punctual, frames, SETTINGS).outside.any()
