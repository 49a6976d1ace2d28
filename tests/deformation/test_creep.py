"""Frames of sticks, the Legendre fit to all of them at once, sheets that slip late, noise, pixel locking."""

import tracemalloc
from dataclasses import fields

import numpy as np
import pytest

from tests.scenes.creeping import PIXEL_UM, errors, make, measure, uniform
from vision.deformation import creep as creep_module
from vision.deformation.creep import (
    AR1Noise,
    DeformationSettings,
    find_late_slips,
    fit_creep,
    fixed_pattern_gain,
    frames_of_sticks,
    legendre,
)

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


def test_creep_does_not_depend_on_how_many_sheets_are_fitted_at_once(monkeypatch):
    """A failure means that long films have other deformations than short ones, or other errors."""
    frames, rng = frames_of(8, 30), np.random.default_rng(4)
    x = rng.normal(size=(240, 7)) + frames.u[:, None]
    x[rng.random(x.shape) < 0.1] = np.nan
    expected = fit_creep(x, frames, 3, SETTINGS, AR1Noise(0.5, 0.7))
    monkeypatch.setattr(creep_module, "POSITIONS_AT_ONCE", 500)
    found = fit_creep(x, frames, 3, SETTINGS, AR1Noise(0.5, 0.7))
    for one in fields(expected):
        np.testing.assert_allclose(getattr(found, one.name), getattr(expected, one.name), rtol=1e-12)


def test_memory_of_many_frames_is_a_few_tables_of_positions():
    """A failure means that the deformation of a long film takes more memory than all that was read of it."""
    frames = frames_of(2000, 20)
    x = np.random.default_rng(5).normal(0, 0.02, (40_000, 40)) + frames.u[:, None]
    creep = fit_creep(x, frames, 3, SETTINGS)
    tracemalloc.start()
    try:
        for work, tables in (
            (lambda: fit_creep(x, frames, 3, SETTINGS), 2.0),
            (lambda: find_late_slips(x, frames, SETTINGS), 5.0),
            (lambda: creep.at(frames), 2.0),
        ):
            before = tracemalloc.get_traced_memory()[0]
            tracemalloc.reset_peak()
            work()
            assert tracemalloc.get_traced_memory()[1] - before < tables * x.nbytes
    finally:
        tracemalloc.stop()


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


def test_a_jump_of_many_sheets_within_one_stick_leaves_the_others_alone():
    """A failure means that the jump passes for sheets that slip late, and shortens every stick."""
    made = make(uniform(5.0, 20.0, events=20), noise_px=0.03, frames=40)
    quiet = measure(made)
    inside = 5 + made.tracks["time_s"].to_numpy() > made.sticks["t_v_s"][7] + 0.2
    made.tracks["x_px"][:, ::2] += np.where(inside, 3.0, 0.0)[:, None]
    motion = measure(made)
    assert (motion["flag"][7] != "ok").any()
    change = np.delete(((motion["ratio"] - quiet["ratio"]) / quiet["ratio_err"]).to_numpy(), 7, axis=0)
    assert np.abs(change).max() < 0.5


@pytest.mark.parametrize("window_px", [9, 21])
def test_how_much_of_a_fixed_pattern_goes_into_the_creep(window_px):
    """A failure means that the error of long sticks from unequal pixels has the wrong size, or is that of
    another window than the one that was fitted."""
    rng = np.random.default_rng(4)
    response, u, reach = rng.standard_normal(6000), np.linspace(-1, 1, 401), 6.0
    half_px = window_px // 2
    pattern = np.convolve(response, -np.arange(-half_px, half_px + 1), "same")
    pattern /= pattern.std()
    at = rng.uniform(20, 5980, 1500)[:, None] + reach * u
    moved = np.interp(at, np.arange(6000), pattern)
    share = np.linalg.lstsq(legendre(u, 3), moved.T, rcond=None)[0]
    size = np.sqrt((share**2).mean(axis=1))
    np.testing.assert_allclose(size, fixed_pattern_gain(reach, 3, window_px), rtol=0.1)


def test_the_window_of_the_fit_decides_how_much_unequal_pixels_add():
    """A failure means that errors are those of a window of 9 px where another was fitted."""
    made = make(uniform(5.0, 20.0), noise_px=0.03, frames=40)
    errors = []
    for window_px in (9, 21):
        made.tracks.attrs |= {"fit": "sliding", "window_px": window_px}
        settings = DeformationSettings(fixed_pattern=3.0)  # the largest part of the error
        errors.append(np.nanmedian(measure(made, settings=settings)["ratio_err"]))
    assert errors[1] < 0.9 * errors[0]
