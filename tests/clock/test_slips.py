"""Slips as the load cell and the camera see them, against known times."""

import numpy as np
import pytest
from scipy.signal import bilinear, butter, lfilter

from tests.scenes.slip_trains import sawtooth, slip_times, sticks_of, tracks
from vision.clock import ClockSettings, force_slips, video_slips
from vision.errors import InputError
from vision.experiment import force_recording, preset, with_settings, write_force
from vision.experiment.scene import make_scene
from vision.force import find_stick_slip
from vision.force.recording import read_force

STOP_S = 60.0
FRAME_S = 0.05


@pytest.fixture(scope="module")
def slips_s():
    times = 1.0 + slip_times(np.random.default_rng(0), 150, period_s=0.61)
    return times[times < STOP_S - 1]


@pytest.mark.parametrize(("rate_hz", "lowpass_s"), [(200, 0.003), (1000, 0.003), (100, 0.01), (200, 0.0003)])
def test_force_slips_are_free_of_the_chain_s_delay(rate_hz, lowpass_s, slips_s):
    """A failure means that the load cell's low-pass shifts all clocks by its time constant."""
    force = sawtooth(np.random.default_rng(8), slips_s, stop_s=STOP_S, rate_hz=rate_hz, lowpass_s=lowpass_s)
    found = force_slips(force, sticks_of(slips_s))
    assert len(found) == len(slips_s)
    bias = np.mean(found["time_s"].to_numpy() - slips_s)
    assert abs(bias) < 1e-3 + 0.2 * lowpass_s + 0.05 / rate_hz
    assert abs(bias) < 3 * found["lag_s"].iloc[0]


@pytest.mark.parametrize(("rate_hz", "lowpass_s"), [(10, 0.003), (20, 0.003), (25, 0.0003), (200, 0.0003)])
def test_slips_within_one_sampling_interval(rate_hz, lowpass_s, slips_s):
    """A failure means that a force sampled as slowly as it slips is timed worse than stated: its clocks are
    then called ambiguous."""
    force = sawtooth(np.random.default_rng(8), slips_s, stop_s=STOP_S, rate_hz=rate_hz, lowpass_s=lowpass_s)
    found = force_slips(force, sticks_of(slips_s))
    stated = np.hypot(found["error_s"], 1e-3)  # a slip itself lasts about 1 ms
    assert 0.6 < np.std((found["time_s"] - slips_s) / stated) < 1.2


def test_slips_where_the_load_holds_still(slips_s):
    """A failure means a division by no drop, where the events are those of another recording."""
    force = sawtooth(np.random.default_rng(8), slips_s, stop_s=STOP_S)
    found = force_slips(force.assign(load_N=0 * force["load_N"] + 5), sticks_of(slips_s))
    np.testing.assert_allclose(found["time_s"], slips_s, atol=0.05)


def test_without_the_correction_they_are_late(slips_s):
    """A failure means that the test above would pass without the correction."""
    force = sawtooth(np.random.default_rng(9), slips_s, stop_s=STOP_S, lowpass_s=0.01)
    time_s, load = force["time_s"].to_numpy(), force["load_N"].to_numpy()
    near = np.abs(time_s - slips_s[:, None]) < 0.05
    fall = np.maximum(-np.gradient(load), 0) * near
    assert np.mean((fall * time_s).sum(axis=1) / fall.sum(axis=1) - slips_s) > 7e-3
    assert abs(np.mean(force_slips(force, sticks_of(slips_s))["time_s"].to_numpy() - slips_s)) < 3e-3


@pytest.mark.parametrize(("frequency_hz", "damping"), [(20, 0.4), (35, 0.3), (35, 0.7)])
def test_a_filter_of_second_order_is_in_the_error(frequency_hz, damping, slips_s):
    """A failure means that clocks are off by many errors behind a load cell whose delay does not show."""
    force = sawtooth(np.random.default_rng(11), slips_s, stop_s=STOP_S, rate_hz=1000, lowpass_s=0.0003)
    turn = 2 * np.pi * frequency_hz
    cell = bilinear([turn**2], [1, 2 * damping * turn, turn**2], fs=1000)
    delayed = force.assign(load_N=("time_s", lfilter(*cell, force["load_N"].to_numpy())))
    found = force_slips(delayed, sticks_of(slips_s))
    bias = np.mean(found["time_s"].to_numpy() - slips_s)
    assert 0.6 * found["lag_s"].iloc[0] < bias < 2 * found["lag_s"].iloc[0]
    unaware = ClockSettings(unseen_delay=0.0, swing_back=np.inf)
    unaware = force_slips(delayed, sticks_of(slips_s), settings=unaware)
    assert bias > 4 * unaware["lag_s"].iloc[0]


@pytest.fixture
def ringing(slips_s):
    """The recording of a load cell that rings at 30 Hz, behind a low-pass, at this sampling rate."""

    def recorded(rate_hz, lowpass_s):
        fine = sawtooth(
            np.random.default_rng(8), slips_s, stop_s=STOP_S, rate_hz=2000, lowpass_s=lowpass_s, noise_N=0
        )
        load, turn = fine["load_N"].to_numpy(), 2 * np.pi * 30
        cell = bilinear([turn**2], [1, 2 * 0.05 * turn, turn**2], fs=2000)
        load = lfilter(*cell, load - load[0]) + load[0]
        coarse = fine.assign(load_N=("time_s", load)).isel(time_s=slice(None, None, 2000 // rate_hz))
        noise = np.random.default_rng(3).normal(0, 0.5, coarse.sizes["time_s"])
        return coarse.assign(load_N=coarse["load_N"] + noise)

    return recorded


@pytest.mark.parametrize("rate_hz", [100, 200])
@pytest.mark.parametrize("lowpass_s", [0.0003, 0.005])
def test_the_ringing_of_a_load_cell_does_not_move_the_slips(rate_hz, lowpass_s, ringing, slips_s):
    """A failure means that clocks are off by a third of the ringing's period, or state as much."""
    sticks = sticks_of(slips_s)
    sticks.attrs["ringing_s"] = 1 / 30
    found = force_slips(ringing(rate_hz, lowpass_s), sticks)
    bias, lag_s = np.mean(found["time_s"].to_numpy() - slips_s), found["lag_s"].iloc[0]
    assert abs(bias) < min(0.004, 2 * lag_s)
    assert lag_s < 0.009


def test_a_low_pass_that_ringing_hides_is_in_the_error(tmp_path):
    """A failure means that clocks are off by the delay of the low-pass, five times what they state."""
    of_cell = {
        "lowpass_s": 0.01,
        "ringing_Hz": 15.0,
        "ringing_damping": 0.1,
        "noise_N": 0.02,
        "quantum_N": 0.1,
    }
    of_pull = {"speed_mm_min": 2.0, "d_end_mm": 15.05, "period_jitter": 0.15, "softening": 0.0}
    changes = {f"load_cell.{name}": value for name, value in of_cell.items()}
    changes |= {f"mechanics.{name}": value for name, value in of_pull.items()}
    experiment = with_settings(preset("paper", seed=135), changes | {"clocks.force_rate_Hz": 500.0})
    pull = make_scene(experiment).pull
    write_force(tmp_path / "force.txt", force_recording(experiment, pull), experiment.force_file)
    force = read_force(tmp_path / "force.txt")
    sticks = find_stick_slip(force)
    found = force_slips(force, sticks)
    late_s = found["time_s"].to_numpy()[:, None] - pull.end_s
    bias = np.median(np.take_along_axis(late_s, np.abs(late_s).argmin(axis=1)[:, None], axis=1))
    assert 0.01 < bias < 2 * found["lag_s"].iloc[0]
    unaware = force_slips(force, sticks, settings=ClockSettings(behind_ringing=0.0))
    assert bias > 4 * unaware["lag_s"].iloc[0]


@pytest.mark.parametrize("lowpass_s", [0.0003, 0.005, 0.01])
def test_ringing_of_an_unknown_period_is_in_the_error(lowpass_s, ringing, slips_s):
    """At three samples a swing its period is not found. A failure means that clocks are off by two or three
    of their errors."""
    load = ringing(100, lowpass_s)
    found = force_slips(load, sticks_of(slips_s))
    bias = np.mean(found["time_s"].to_numpy() - slips_s)
    assert 0.5 * found["lag_s"].iloc[0] < bias < 2 * found["lag_s"].iloc[0]
    unaware = force_slips(load, sticks_of(slips_s), settings=ClockSettings(swing_back=np.inf))
    assert bias > 1.5 * unaware["lag_s"].iloc[0]


@pytest.mark.parametrize(
    ("rate_hz", "lowpass_s", "noise_N"), [(100, 0.01, 4), (200, 0.01, 4), (200, 0.005, 3)]
)
def test_noise_does_not_hide_the_delay_of_a_low_pass(rate_hz, lowpass_s, noise_N, slips_s):
    """A failure means that clocks are late by the low-pass, or three errors, where the load is noisy."""
    noisy = {"rate_hz": rate_hz, "lowpass_s": lowpass_s, "noise_N": noise_N}
    found = force_slips(
        sawtooth(np.random.default_rng(8), slips_s, stop_s=STOP_S, **noisy), sticks_of(slips_s)
    )
    bias = np.mean(found["time_s"].to_numpy() - slips_s)
    assert abs(bias) < min(0.5 * lowpass_s, found["lag_s"].iloc[0])


@pytest.mark.parametrize("order", [2, 4])
def test_a_filter_as_fast_as_the_sampling_is_in_the_error(order, slips_s):
    """A failure means that clocks are off by many errors behind the usual filter before slow sampling."""
    force = sawtooth(np.random.default_rng(12), slips_s, stop_s=STOP_S, rate_hz=2000, lowpass_s=0.0003)
    load = force["load_N"].to_numpy()
    load = lfilter(*butter(order, 40, fs=2000), load - load[0]) + load[0]
    filtered = force.assign(load_N=("time_s", load)).isel(time_s=slice(None, None, 20))
    found = force_slips(filtered, sticks_of(slips_s))
    bias = np.mean(found["time_s"].to_numpy() - slips_s)
    assert 0.004 < bias < 4 * found["lag_s"].iloc[0]


def test_no_sticks_no_slips(slips_s):
    """A failure means a traceback where a recording has no events."""
    force = sawtooth(np.random.default_rng(10), slips_s, stop_s=STOP_S)
    assert len(force_slips(force, sticks_of(slips_s).iloc[:0])) == 0


# --- as the camera sees them --------------------------------------------------------------------------------


def against(found_s, true_s):
    """found minus true for each found one."""
    nearest = np.abs(found_s[:, None] - true_s).argmin(axis=1)
    return found_s - true_s[nearest]


@pytest.mark.parametrize(
    "scene",
    [
        {},
        {"lost": 0.03},
        {"missing": 0.4},
        {"noise_px": 0.15, "jump_px": 1.5},
        {"sides": (1,), "shake_px": 0.02},
        {"sides": (1,), "shake_px": 0.5},
        {"sides": (1,), "power": 0.0},
        {"shake_px": 0.5, "drift_px": 40.0},
        {"exposure_s": 0.03},
        {"frame_s": 0.2, "missing": 0.0},
    ],
)
def test_every_slip_is_seen_and_nothing_else(scene, slips_s):
    """A failure means that shaking, lost frames or missing sheets are taken for slips, or hide them; or
    that slips of sheets that all slip alike are taken for shaking."""
    found = video_slips(tracks(np.random.default_rng(1), slips_s, stop_s=STOP_S, **scene))
    off = against(found["time_s"].to_numpy(), slips_s)
    assert len(found) == pytest.approx(len(slips_s), rel=0.03)
    assert np.abs(off / found["error_s"]).max() < 4
    assert np.sqrt(np.mean((off / found["error_s"]) ** 2)) == pytest.approx(1, abs=0.35)


def test_four_of_fifty_sheets_beside_a_hand_show_the_slips(slips_s):
    """A failure means that slips are lost, or are misplaced to the end of what hides the other sheets."""
    rng = np.random.default_rng(7)
    seen = tracks(rng, slips_s, stop_s=STOP_S, per_side=25)
    x = seen["x_px"].values.copy()
    for first in range(10, len(x), 40):
        x[first : first + 8, rng.permutation(50)[4:]] = np.nan
    found = video_slips(seen.assign(x_px=(("frame", "sheet"), x)))
    off = against(found["time_s"].to_numpy(), slips_s)
    assert len(found) == pytest.approx(len(slips_s), rel=0.03)
    assert np.abs(off / found["error_s"]).max() < 4


def test_a_slip_between_two_frames_is_placed_in_the_middle(slips_s):
    """A failure means a bias of the clocks by part of a frame."""
    found = video_slips(tracks(np.random.default_rng(2), slips_s, stop_s=STOP_S))
    off = against(found["time_s"].to_numpy(), slips_s)
    assert np.std(off) == pytest.approx(FRAME_S / np.sqrt(12), rel=0.15)
    assert abs(np.mean(off)) < 3 * FRAME_S / np.sqrt(12 * len(off))


def test_a_long_exposure_places_slips_to_a_part_of_a_frame(slips_s):
    """A failure means that what a frame taken during a slip tells about its time is thrown away."""
    found = video_slips(tracks(np.random.default_rng(3), slips_s, stop_s=STOP_S, exposure_s=0.048))
    off = against(found["time_s"].to_numpy(), slips_s)
    assert np.std(off) < 0.1 * FRAME_S


@pytest.mark.parametrize("spread_s", [0.0, 0.02, 0.04])
@pytest.mark.parametrize("frame_s", [0.01, 0.05])
def test_the_time_from_the_first_to_the_last_sheet_is_measured(spread_s, frame_s, slips_s):
    """The force may fall with either of them. A failure means that a clock late by half of this time states a
    fraction of it as its error."""
    film = tracks(np.random.default_rng(3), slips_s, stop_s=STOP_S, frame_s=frame_s, spread_s=spread_s)
    assert video_slips(film)["spread_s"].iloc[0] == pytest.approx(spread_s, rel=0.4, abs=0.003)


@pytest.mark.parametrize("exposure_s", [0.002, 0.012])
def test_it_is_measured_where_no_single_step_is_clear(exposure_s, slips_s):
    """A failure means that a clock is late by more than its error where sheets slip by a few errors of a
    position, or that noise counts as a delay."""
    small = {"jump_px": 0.4, "per_side": 25, "frame_s": 1 / 60, "exposure_s": exposure_s, "stop_s": STOP_S}
    late, together = (
        video_slips(tracks(np.random.default_rng(3), slips_s, spread_s=spread_s, **small))["spread_s"].iloc[0]
        for spread_s in (0.02, 0.0)
    )
    assert 0.016 < late < 0.03
    assert together < 0.005


def test_a_film_that_cannot_show_it_does_not_exclude_it(slips_s):
    """A failure means that a clock late by 10 ms states 2 ms, where noise hides that sheets slip in turn."""
    faint = {"jump_px": 0.2, "per_side": 20, "exposure_s": 0.01, "stop_s": STOP_S, "frame_s": 0.04}
    film = tracks(np.random.default_rng(3), slips_s, spread_s=0.02, **faint)
    assert video_slips(film)["spread_s"].iloc[0] > 0.016
    dense = np.arange(1.0, STOP_S - 1, 0.13)  # a slip in every third frame: none is apart from the others
    film = tracks(np.random.default_rng(3), dense, spread_s=0.02, **faint | {"jump_px": 3.0})
    assert 0.01 < video_slips(film)["spread_s"].iloc[0] <= 0.04


def test_slips_in_many_frames_of_a_film_that_begins_at_rest(slips_s):
    """Two of five frames show part of a slip, and for 18 s before the sheets rest.  A failure means
    that a slow camera sees no slips, as creep, rest and slips pass for noise."""
    moving = tracks(np.random.default_rng(6), slips_s, stop_s=STOP_S, frame_s=0.12, exposure_s=0.1)
    resting = moving["x_px"].values[:1] + 0.05 * np.random.default_rng(7).standard_normal((150, 20))
    frames = 150 + moving.sizes["frame"]
    film = moving.isel(frame=np.r_[np.zeros(150, int), : frames - 150])
    film = film.assign(x_px=(("frame", "sheet"), np.r_[resting, moving["x_px"].values]))
    film = film.assign_coords(time_s=("frame", 0.06 + 0.12 * np.arange(frames)))
    found = video_slips(film)
    assert len(found) == pytest.approx(len(slips_s), abs=3)
    assert np.median(np.abs(against(found["time_s"].to_numpy(), slips_s + 150 * 0.12))) < 0.05


def test_common_shaking_without_slips_is_no_slip():
    """A failure means that noise alone sets the clocks."""
    still = tracks(np.random.default_rng(4), np.array([1e3]), stop_s=STOP_S, shake_px=2.0)
    assert len(video_slips(still)) < 4


def test_inward_steps_and_bad_single_frames_are_no_slips(slips_s):
    """A failure means that a blurred frame, or sheets that are pushed together, count as slips."""
    seen = tracks(np.random.default_rng(5), slips_s, stop_s=STOP_S)
    turned = seen.assign_coords(side=-seen["side"])
    assert len(video_slips(turned)) < 0.05 * len(slips_s)
    bad = np.arange(7, seen.sizes["frame"] - 5, 101)
    x = seen["x_px"].values.copy()
    x[bad] += 20.0 * seen["side"].values
    found = video_slips(seen.assign(x_px=(("frame", "sheet"), x)))
    assert len(found) == pytest.approx(len(slips_s), abs=len(bad) / 2)


def test_stale_time_stamps_do_not_misplace_slips(slips_s):
    """A failure means that a camera that repeats a time stamp spoils the clocks."""
    rng = np.random.default_rng(6)
    seen = tracks(rng, slips_s, stop_s=STOP_S)
    time = seen["time_s"].values.copy()
    stale = np.flatnonzero(rng.random(len(time) - 1) < 0.05) + 1
    time[stale] = time[stale - 1]
    found = video_slips(seen.assign_coords(time_s=("frame", time)))
    off = against(found["time_s"].to_numpy(), slips_s)
    assert len(found) > 0.95 * len(slips_s)
    assert np.abs(off / found["error_s"]).max() < 4


def test_frames_without_times_are_refused(slips_s):
    """A failure means a traceback where a user forgot the frame rate."""
    seen = tracks(np.random.default_rng(7), slips_s, stop_s=STOP_S)
    with pytest.raises(InputError, match=r"film\.avi: expected a time for each frame.*`fps`"):
        video_slips(seen.assign_coords(time_s=("frame", np.full(seen.sizes["frame"], np.nan))))
    with pytest.raises(InputError, match="at least 3 frames"):
        video_slips(seen.isel(frame=slice(0, 2)))
