"""The load cell's low-pass: found in the transients after slips, and corrected."""

import tracemalloc

import numpy as np
import pytest

from tests.scenes.sawtooth import Test, plain, realistic, recording
from vision.errors import InputError
from vision.experiment import force_recording, preset, simulate_pull, with_settings
from vision.force import find_stick_slip
from vision.force.lowpass import deconvolve_lowpass, estimate_lowpass
from vision.force.slips import find_slips
from vision.force.sticks import find_corners
from vision.models import fit_models

FAST = {"speed": 10.0, "rate": 2000.0, "noise": 0.05, "d1": 13.8, "slip_s": 0.005}


def median_ratios(test: Test, **options: float | str) -> dict[str, float]:
    events = find_stick_slip(test.force, **options)
    nearest = np.abs(events["t_p_s"].to_numpy()[:, None] - test.truth["t_p_s"].to_numpy()).argmin(axis=1)
    truth = test.truth.iloc[nearest].reset_index(drop=True)
    columns = ("stick_length_um", "dF_N", "K_N_per_mm")
    return {name: float((events[name] / truth[name]).median()) for name in columns}


@pytest.mark.parametrize("tau", [0.001, 0.003, 0.01])
def test_fast_pulls_behind_a_slow_chain_come_out_true(tau: float) -> None:
    """A failure means force drops and stick lengths of fast pulls are the amplifier's, not the sample's."""
    test = realistic(tau=tau, **FAST)
    assert find_stick_slip(test.force, lowpass_s="auto").attrs["lowpass_s"] == pytest.approx(tau, rel=0.05)
    for name, ratio in median_ratios(test, lowpass_s="auto").items():
        assert ratio == pytest.approx(1, abs=0.03), name


def test_a_slow_chain_left_alone_spoils_the_drops() -> None:
    """A failure means the test above would pass without correcting for the low-pass, and so prove nothing."""
    assert median_ratios(realistic(tau=0.01, **FAST), lowpass_s=0.0)["dF_N"] < 0.9


@pytest.mark.parametrize("settings", [{"rate": 200.0}, {"rate": 1000.0, "slip_s": 0.02}, FAST])
def test_no_low_pass_is_seen_where_there_is_none(settings: dict[str, float]) -> None:
    """A failure means a slip's own length, or noise, is taken for a low-pass."""
    attrs = find_stick_slip(realistic(tau=0.0, **settings).force, lowpass_s="auto").attrs
    assert attrs["lowpass_s"] == 0
    assert not attrs["lowpass_proven"]


@pytest.mark.parametrize("samples", [30, 100])
@pytest.mark.parametrize("snr", [6.0, 20.0])
def test_no_low_pass_is_seen_in_noise(samples: int, snr: float) -> None:
    """A failure means a wrong guess, once corrected for, confirms itself."""
    for seed in range(2):
        force = plain(sticks=150, samples=samples, snr=snr, seed=seed).force
        assert find_stick_slip(force, lowpass_s="auto").attrs["lowpass_s"] == 0


def test_everything_is_as_recorded_unless_asked() -> None:
    """A failure means a model is applied unasked, or what it would change is kept from the user."""
    test = realistic(tau=0.01, **FAST)
    events = find_stick_slip(test.force)
    attrs = events.attrs
    assert (attrs["lowpass_s"], attrs["lowpass_how"]) == (0, "recorded")
    assert attrs["lowpass_proposed_s"] == pytest.approx(0.01, rel=0.05)
    assert attrs["lowpass_proven"]
    load = test.force["load_N"].to_numpy()
    assert (events["F_p_N"] <= load.max()).all()
    swing = events["F_p_raw_N"] - events["F_v_raw_N"]
    assert (events["F_v_N"] >= events["F_v_raw_N"] - 0.05 * swing).all()
    assert (events["F_p_N"] <= events["F_p_raw_N"] + 0.02 * swing).all()
    true = find_stick_slip(test.force, lowpass_s=0.01)
    assert (np.abs(true["dF_N"] - events["dF_N"]) <= events["dF_err_N"]).mean() > 0.95
    assert true["dF_N"].median() > 1.05 * events["dF_N"].median()


def test_a_given_low_pass_is_used() -> None:
    """A failure means a given time constant is ignored."""
    test = realistic(tau=0.01, **FAST)
    attrs = find_stick_slip(test.force, lowpass_s=0.01).attrs
    assert (attrs["lowpass_s"], attrs["lowpass_how"]) == (pytest.approx(0.01), "given")


@pytest.mark.parametrize("lowpass_s", [0.0, 0.003])
def test_the_stiffness_of_fast_pulls_is_that_after_the_knee(lowpass_s: float) -> None:
    """A failure means K, and with it N̂ and Y_eff, mixes the two slopes of a fast stick."""
    experiment = with_settings(preset("fast", seed=3), {"load_cell.lowpass_s": lowpass_s})
    pull = simulate_pull(experiment.mechanics, seed=3)
    load = force_recording(experiment, pull)
    time, d = load["time_s"].to_numpy(), 13 + load["crosshead_mm"].to_numpy()
    force = recording(time, load["load_N"].to_numpy(), d, 10.0)
    sticks = find_stick_slip(force, lowpass_s="auto")
    assert sticks.attrs["two_slopes"]
    truth = pull.events()
    nearest = np.abs(sticks["t_p_s"].to_numpy()[:, None] - truth["t_p_s"].to_numpy()).argmin(axis=1)
    ratio = sticks["K2_N_per_mm"].to_numpy() / truth["K_N_per_mm"].to_numpy()[nearest]
    assert np.median(ratio) == pytest.approx(1, abs=0.005)
    fits = fit_models(force, sticks)
    assert fits.modulus_GPa.value == pytest.approx(3.8, abs=3 * fits.modulus_GPa.error)
    assert fits.n_hat_N.value == pytest.approx(0.57, abs=3 * fits.n_hat_N.error)


@pytest.mark.parametrize("lowpass_s", [3.0, -0.001, float("nan")])
def test_a_time_constant_longer_than_a_stick_is_refused(lowpass_s: float) -> None:
    """A failure means that milliseconds given for seconds silently spoil all corners."""
    with pytest.raises(
        InputError, match=r"slip to slip, 0\.[23]\d* s; found .* s; give `lowpass_s` in seconds"
    ):
        find_stick_slip(plain(sticks=20).force, lowpass_s=lowpass_s)


def test_a_long_hold_among_short_sticks() -> None:
    """A failure means that one long stick makes all others take as much memory."""
    rng = np.random.default_rng(0)
    saw = 5 * (np.arange(40 * 30) % 30) / 30
    load = np.r_[saw, np.linspace(0, 5, 60_000), saw]
    time = np.arange(load.size) / 100
    force = recording(time, 20 + load + 0.02 * rng.standard_normal(load.size), 13 + time / 1000, 0.06)
    slips = find_slips(force["load_N"].values, 0.02)
    load = force["load_N"].values
    corners = find_corners(deconvolve_lowpass(load, 0.02, slips, 0.0), two_slopes=False)
    transients = corners.transients()
    tracemalloc.start()
    estimate_lowpass(load, transients)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 20e6
