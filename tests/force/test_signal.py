"""White noise and spikes of a load."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.signal import bilinear, lfilter

from tests.force.test_events import matched
from tests.scenes.sawtooth import Test, plain, signal_of
from tests.scenes.slip_trains import sawtooth, slip_times
from vision.clock import force_slips
from vision.errors import InputError
from vision.force import find_stick_slip
from vision.force.settings import ForceSettings
from vision.force.signal import (
    averaged,
    find_spikes,
    noise_sigma,
    ringing_period,
    smoothed_samples,
    with_slow_noise,
)
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


@pytest.mark.parametrize("quantum", [0.0, 0.5])
def test_noise_behind_a_moving_mean_is_smooth_and_that_of_a_low_pass_is_not(quantum: float) -> None:
    """A failure means that the swings of an averaged load are searched for slips, or that samples of random
    walks and of low-passed noise are left out, also where the noise is a few steps of a coarse load."""
    rng = np.random.default_rng(2)
    sticks = rng.integers(700, 1300, 60)
    saw = np.concatenate([np.linspace(0, 50, size) for size in sticks])
    white = rng.standard_normal(saw.size)

    def smoothed(load: np.ndarray) -> int:
        return smoothed_samples(np.round(load / quantum) * quantum if quantum else load, ForceSettings())

    for width in (4, 7, 10, 14, 20):
        mean = np.convolve(saw + 3 * np.sqrt(width) * white, np.full(width, 1 / width), "valid")
        assert width / 2 < smoothed(mean) < 4 * width, width
    for other in (white, 0.2 * np.cumsum(white), lfilter([1], [1, -0.9], white)):
        assert smoothed(saw + 2 * other) == 1


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


@pytest.mark.parametrize("tail", [0.0, 0.5])
@pytest.mark.parametrize("place", [0.0, 0.3, 0.7])
def test_steep_begins_of_sticks_are_no_spikes(place: float, tail: float) -> None:
    """Sticks that rise steeply at first, as of sheets that let go in turn, sampled at several places of the
    slip; and spikes in their middle, some with a tail. A failure means that the lowest load after each slip
    is replaced by a later one, or that spikes pass for such lows."""
    rng = np.random.default_rng(1)
    phase = (np.arange(4000) - place) % 50
    saw = 60 + 30 * phase / 50 - 25 * np.exp(-phase / 3) - 20 * np.exp(-phase / 20)
    noisy = saw + 0.1 * rng.standard_normal(4000)
    assert not find_spikes(noisy, 0.1)[0].any()
    hit = np.arange(25, 4000, 50)
    for sign in (-1, 1):
        spiky = noisy.copy()
        spiky[hit] += 15 * sign
        spiky[hit + 1] += 15 * sign * tail
        found, clean = find_spikes(spiky, 0.1)
        assert found[hit].all()
        assert not np.setdiff1d(np.flatnonzero(found), np.r_[hit, hit + 1, hit + 2]).size
        assert np.abs(clean - saw)[hit].max() < 3


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


# --- ringing of the load after slips ------------------------------------------------------------------------


SAMPLES = 200  # from slip to slip, at 100 Hz


@cache
def scene():
    test = plain(sticks=60, samples=SAMPLES, snr=200.0, jitter=0.1)
    return Test(test.force.assign(load_N=test.force["load_N"] + 1000), test.truth)


def resonance_poles(period, damping):
    swing = 2 * np.pi / period
    decay = np.exp(-damping * swing)
    return [1, -2 * decay * np.cos(swing), decay**2]


def resonance(load, period, damping, share=1.0):
    """The load of a cell whose resonance has this period (samples) and passes on this share of the load."""
    poles = resonance_poles(period, damping)
    return share * (load[0] + lfilter([sum(poles)], poles, load - load[0])) + (1 - share) * load


def rung(period, damping, share=1.0):
    test = scene()
    noise = 0.05 * np.random.default_rng(1).standard_normal(test.force.sizes["time_s"])
    load = resonance(test.force["load_N"].to_numpy(), period, damping, share) + noise
    return test.force.assign(load_N=("time_s", load))


RINGING = [(20, 0.05, 1.0), (10, 0.03, 1.0), (10, 0.03, 0.1), (10, 0.2, 0.3), (3.4, 0.05, 0.3)]


@pytest.mark.parametrize(("period", "damping", "share"), RINGING)
def test_events_are_those_of_the_load_without_ringing(period, damping, share):
    """A failure means swings counted as slips, or forces, lengths and K that the average has changed."""
    events = find_stick_slip(rung(period, damping, share), average_s="auto")
    assert events.attrs["average_s"] == pytest.approx(0.01 * period, rel=0.1)
    right, truth = matched(events, scene().truth)
    assert len(events) == len(right) == len(scene().truth)
    assert (right["flag"] == "ok").all()
    assert events.attrs["warnings"] == []
    for name, error in (
        ("dF_N", right["dF_err_N"]),
        ("stick_length_um", right["stick_length_err_um"]),
        ("K_N_per_mm", right["K_err_N_per_mm"]),
    ):
        assert ((right[name] - truth[name]).abs() < 3 * error).mean() > 0.95, name
        assert (right[name] / truth[name]).median() == pytest.approx(1, abs=0.005), name
        assert np.median(error / truth[name]) < 0.03, name


def test_one_mean_would_leave_ringing_in_the_stiffness():
    """Two means over a period leave 25 times less of ringing that decays by a fourth in it."""
    force = rung(20, 0.05)
    time, load = force["time_s"].to_numpy(), force["load_N"].to_numpy()
    decaying = np.exp(-0.05 * 2 * np.pi * np.arange(400) / 20) * np.cos(2 * np.pi * np.arange(400) / 20)
    twice = averaged(time[:400], decaying, 0.2)
    once = np.convolve(decaying, np.full(20, 1 / 20), "same")
    middle = slice(60, 140)
    assert np.ptp(twice[middle]) < 0.1 * np.ptp(once[middle]) < 0.1 * np.ptp(decaying[middle])
    assert averaged(time, load, 0.2) == pytest.approx(averaged(time, load + 7, 0.2) - 7)


@pytest.mark.parametrize(("period", "damping", "share"), RINGING)
def test_ringing_is_named_and_nothing_is_averaged_unasked(period, damping, share):
    """A failure means a recording refused, or called an oscillation, without the way out."""
    try:
        events = find_stick_slip(rung(period, damping, share))
    except InputError as error:
        assert "the load oscillates at" in str(error)
        return
    assert events.attrs["average_s"] == 0
    assert events.attrs["ringing_s"] == pytest.approx(0.01 * period, rel=0.1)
    whole = (events["flag"] == "ok").all()
    assert whole or any("`average_s`" in line for line in events.attrs["warnings"])


@pytest.mark.parametrize("period", [10.0, 12.7, 33.3])
def test_the_period_of_ringing(period):
    load = rung(period, 0.05, 0.3)["load_N"].to_numpy()
    assert ringing_period(load, ForceSettings()) == pytest.approx(period, rel=0.02)
    assert ringing_period(-load, ForceSettings()) == pytest.approx(period, rel=0.02)


@pytest.mark.parametrize("every", [1, 5])
@pytest.mark.parametrize("damping", [0.25, 0.4])
def test_ringing_that_decays_within_two_periods(damping: float, every: int) -> None:
    """Its swings are too few for an autocorrelation. A failure means that the swings of a load cell with
    damping are events, and all of them an oscillation, unless the load is averaged."""
    rate_hz, turn, rng = 5000 / every, 2 * np.pi * 60, np.random.default_rng(0)
    slips_s = 1.0 + slip_times(rng, 150, period_s=0.4)
    still = {
        "rate_hz": 5000,
        "lowpass_s": 0.0003,
        "noise_N": 0,
        "sizes": rng.lognormal(0, 0.25, slips_s.size),
    }
    fine = sawtooth(rng, slips_s, stop_s=slips_s[-1] + 1, **still)
    load = fine["load_N"].to_numpy()
    cell = bilinear([turn**2], [1, 2 * damping * turn, turn**2], fs=5000)
    load = lfilter(*cell, load - load[0]) + load[0] + rng.normal(0, 0.1, load.size)
    force = fine.assign(load_N=("time_s", load)).isel(time_s=slice(None, None, every))
    load = force["load_N"].to_numpy()
    assert ringing_period(load, ForceSettings()) == pytest.approx(rate_hz / 60, rel=0.15)
    assert np.isnan(ringing_period(load, ForceSettings(ringing_rebound=1.0)))
    for average_s in ("auto", 0.0):
        events = find_stick_slip(force, average_s=average_s)
        assert len(events) == len(slips_s) - 1
        assert (events["flag"] == "ok").all()
        place = np.abs(events["t_p_s"].to_numpy()[:, None] - slips_s).argmin(axis=1)
        off = events["F_p_N"] - 100 - 30 * still["sizes"][place]
        assert np.mean(np.abs(off) < 3 * events["F_p_err_N"]) > 0.9


def test_slips_noise_and_low_passes_do_not_ring():
    """A failure means that an ordinary recording is said to ring, and `auto` averages it."""
    load = scene().force["load_N"].to_numpy()
    white = np.random.default_rng(0).standard_normal(load.size)
    for other in (
        load,
        load + 5 * white,
        lfilter([0.2], [1, -0.8], load + white),
        np.cumsum(white),
        0 * load,
    ):
        assert np.isnan(ringing_period(other, ForceSettings()))
    plain_events = find_stick_slip(scene().force)
    auto = find_stick_slip(scene().force, average_s="auto")
    assert auto.attrs["average_s"] == 0
    assert plain_events.equals(auto)


COARSE = 25.0  # N, in which the drops are 146 steps and the noise is lost


@cache
def large():
    return plain(sticks=60, samples=SAMPLES, snr=146 * COARSE, jitter=0.1)


def coarse(load):
    return large().force.assign(load_N=("time_s", np.round(load / COARSE) * COARSE))


def test_the_steps_of_a_coarse_load_do_not_ring():
    """A failure means that the regular steps of a coarse load are called an oscillation."""
    load = large().force["load_N"].to_numpy()
    assert np.isnan(find_stick_slip(coarse(load + 1000)).attrs["ringing_s"])


@pytest.mark.parametrize(("period", "damping", "share"), [(10, 0.05, 1.0), (8, 0.03, 0.5)])
def test_a_coarse_load_that_rings_is_not_one_that_is_filled_in(period, damping, share):
    """A failure means that swings above the step are taken for the ends of lines, and the rest left out."""
    load = resonance(large().force["load_N"].to_numpy() + 1000, period, damping, share)
    events = find_stick_slip(coarse(load), average_s="auto")
    assert events.attrs["average_s"] == pytest.approx(0.01 * period, rel=0.02)
    right, truth = matched(events, large().truth)
    assert len(events) == len(right) == len(large().truth)
    assert (right["K_N_per_mm"] / truth["K_N_per_mm"]).median() == pytest.approx(1, abs=0.005)


def test_ringing_after_slips_as_long_as_half_its_period():
    """A failure means slips of several samples that hide the ringing, or errors without their length."""
    slip = 5
    sharp = np.pad(scene().force["load_N"].to_numpy(), slip // 2, "edge")
    load = resonance(np.convolve(sharp, np.full(slip, 1 / slip), "valid"), 10, 0.1, 0.5)
    events = find_stick_slip(scene().force.assign(load_N=("time_s", load)), average_s="auto")
    assert events.attrs["average_s"] == pytest.approx(0.1, rel=0.1)
    right, truth = matched(events, scene().truth)
    assert len(right) == len(scene().truth)
    shorter = 1 - 0.01 * slip / (truth["t_p_s"] - truth["t_v_s"])
    for name, error in (("dF_N", "dF_err_N"), ("stick_length_um", "stick_length_err_um")):
        z = (right[name] - shorter * truth[name]) / right[error]
        assert np.sqrt(np.mean(z**2)) < 2, name


def test_ringing_that_is_as_fast_as_slow_slips():
    """A failure means swings called slips, since slips that take longer than a swing hide the ringing."""
    test = plain(sticks=60, samples=220, snr=400, jitter=0.1)
    sharp = np.pad(test.force["load_N"].to_numpy(), (20, 19), "edge")
    fall = np.sin(np.pi * (np.arange(40) + 0.5) / 40)
    slow = np.convolve(sharp, fall / fall.sum(), "valid")
    load = resonance(slow, 36, 0.1, 1.0) + 0.5 * np.random.default_rng(3).standard_normal(slow.size)
    events = find_stick_slip(test.force.assign(load_N=("time_s", load)))
    assert events.attrs["ringing_s"] == pytest.approx(0.36, rel=0.05)
    assert len(events) == pytest.approx(len(test.truth), abs=2)


def test_errors_contain_slow_noise_below_the_average():
    """A failure means K and dF whose errors count pink noise as white, since the average hides its kind."""
    force, n = rung(10, 0.04, 0.3), scene().force.sizes["time_s"]
    frequency = np.maximum(np.fft.rfftfreq(n), 1 / n)
    pink = np.fft.irfft(np.fft.rfft(np.random.default_rng(2).standard_normal(n)) / np.sqrt(frequency), n)
    noisy = force.assign(load_N=force["load_N"] + pink / pink.std())
    right, truth = matched(find_stick_slip(noisy, average_s="auto"), scene().truth)
    assert len(right) == len(scene().truth)
    for name, error in (("K_N_per_mm", "K_err_N_per_mm"), ("dF_N", "dF_err_N")):
        z = (right[name] - truth[name]) / right[error]
        assert np.sqrt(np.mean(z**2)) < 1.5, name


@pytest.mark.parametrize(
    ("samples", "period", "damping"), [(150, 17, 0.02), (250, 33, 0.03), (400, 25, 0.03)]
)
def test_ringing_up_to_the_next_slip_is_no_smooth_noise(samples, period, damping):
    """A failure means that slips are searched in every eighth sample, where swings hide up to 58 of 79. Where
    the swings are the longest, only the number is right, and every stick has a flag."""
    test = plain(sticks=80, samples=samples, snr=200.0, jitter=0.1)
    load = resonance(test.force["load_N"].to_numpy() + 1000, period, damping)
    load += 0.05 * np.random.default_rng(1).standard_normal(load.size)
    events = find_stick_slip(test.force.assign(load_N=("time_s", load)))
    assert len(events) == len(test.truth)
    assert "`average_s`" in events.attrs["warnings"][0]
    placed = len(matched(events, test.truth)[0]) == len(test.truth)
    assert placed or (events["flag"] != "ok").all()


def test_an_oscillation_throughout_is_no_ringing():
    """A failure means that averaging over its period is proposed, which leaves nothing."""
    time = scene().force["time_s"].to_numpy()
    noise = 0.01 * np.random.default_rng(0).standard_normal(time.size)
    wave = 50 + 10 * np.sin(2 * np.pi * time / 0.4) + noise
    events = find_stick_slip(scene().force.assign(load_N=("time_s", wave)), average_s="auto")
    assert events.attrs["regime"] == "oscillation"
    assert events.attrs["average_s"] == 0
    assert np.isnan(events.attrs["ringing_s"])


def test_swings_are_no_events_and_give_one_warning():
    """A failure means that each swing is an event, or that the user is sent to the displacement, the range or
    the threshold, though the load rings."""
    force = rung(20, 0.03, 0.3)
    noise = 2e-4 * np.random.default_rng(0).standard_normal(force.sizes["time_s"])
    events = find_stick_slip(force.assign(d_mm=force["d_mm"] + noise))
    right, truth = matched(events, scene().truth)
    assert len(events) == len(right) == len(scene().truth)
    assert (events["flag"] == "ok").all()
    for name, error in (
        ("dF_N", "dF_err_N"),
        ("stick_length_um", "stick_length_err_um"),
        ("K_N_per_mm", "K_err_N_per_mm"),
    ):
        assert np.mean(np.abs(right[name] - truth[name]) < 3 * right[error]) > 0.95, name
    (line,) = events.attrs["warnings"]
    assert "give `average_s` auto" in line


def test_swings_that_are_a_large_part_of_the_sticks_are_told():
    """A failure means that swings are counted as slips without a word."""
    events = find_stick_slip(rung(50, 0.1, 0.3))
    assert any("the load oscillates with a period of 0.5" in line for line in events.attrs["warnings"])


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"average_s": -1.0}, "seconds from 0, or auto"),
        ({"average_s": "often"}, "seconds from 0, or auto"),
        ({"average_s": 0.1, "lowpass_s": 0.05}, "no `lowpass_s` beside it"),
        ({"average_s": 60.0}, "give a shorter `average_s`"),
    ],
)
def test_averages_that_cannot_be(given, message):
    with pytest.raises(InputError, match=message):
        find_stick_slip(scene().force, **given)


def test_an_average_that_is_too_short_is_told_the_period():
    """A failure means advice to sample faster, or an oscillation, though the ringing is known."""
    force = rung(20, 0.05, 1.0)
    try:
        lines = find_stick_slip(force, average_s=0.02).attrs["warnings"]
    except InputError as error:
        lines = [str(error)]
    assert any("`average_s` auto, or 0.2" in line for line in lines)


@pytest.mark.parametrize(("period", "damping", "share"), RINGING[:2])
def test_the_clock_takes_slips_where_they_are(period, damping, share):
    """A failure means a slip timed by the first swing, a fourth of a period late."""
    force = rung(period, damping, share)
    poles = resonance_poles(period, damping)
    late = -0.01 * np.dot(poles, range(3)) / sum(poles)  # of a resonance, for all that is slower than it
    true_s = force_slips(scene().force, find_stick_slip(scene().force))["time_s"].to_numpy() + late
    sticks = find_stick_slip(force, average_s="auto")
    assert np.median(np.abs(force_slips(force, sticks)["time_s"] - true_s)) < 0.002
    sticks.attrs["average_s"] = 0.0  # with the same slips in the load as recorded, known to ring
    assert np.median(np.abs(force_slips(force, sticks)["time_s"] - true_s)) < 0.002
    sticks.attrs["ringing_s"] = np.nan
    assert np.median(force_slips(force, sticks)["time_s"] - true_s) > 0.01


@pytest.mark.parametrize("size", [3.0, 20.0])
def test_hum_is_averaged_as_well(size):
    """A failure means that K is wrong by what hum leaves in it, though the user asked for the average."""
    time = scene().force["time_s"].to_numpy()
    hum = size * np.sin(2 * np.pi * 16 * time)
    events = find_stick_slip(scene().force.assign(load_N=scene().force["load_N"] + hum), average_s="auto")
    assert events.attrs["average_s"] == pytest.approx(1 / 16, rel=0.01)
    right, truth = matched(events, scene().truth)
    assert len(right) == len(scene().truth)
    assert (right["K_N_per_mm"] / truth["K_N_per_mm"]).median() == pytest.approx(1, abs=0.002)
    assert np.isnan(events.attrs["hum_Hz"])


def test_an_average_longer_than_the_recording_is_refused_in_words():
    """A failure means a threshold of nan, or a warning of NumPy, where milliseconds were meant."""
    with pytest.raises(InputError, match=r"averaged over 500 s; give a shorter `average_s`"):
        find_stick_slip(scene().force, average_s=500.0)
