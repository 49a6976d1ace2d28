"""Drops of a sawtooth among noise and knees, and the load cell's low-pass."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from scipy.signal import butter, lfilter, sosfilt

from tests.scenes.sawtooth import Test, plain, realistic, recording, signal_of
from vision.errors import InputError
from vision.experiment import force_recording, preset, simulate_pull, with_settings
from vision.force import find_stick_slip
from vision.force.corners import SlipTransients, find_corners
from vision.force.lowpass import estimate_lowpass
from vision.force.slips import find_slips
from vision.models import fit_models
from vision.numeric import Floats


@pytest.mark.parametrize("snr", [6.0, 40.0])
def test_every_slip_is_at_its_sample(snr: float) -> None:
    """A failure means slips are missed, doubled, or away from the sample after their drop."""
    test = plain(sticks=100, samples=40, snr=snr, seed=1)
    slips = find_slips(test.force["load_N"].to_numpy(), 1.0)
    true = np.r_[test.truth["t_v_s"], test.truth["t_p_s"].iloc[-1]] / 0.01
    away = np.abs(slips.edge[:, None] - true).min(axis=1)
    assert slips.edge.size == pytest.approx(true.size, abs=1)
    assert np.mean(away <= 2) > 0.97
    assert np.median(slips.drop) == pytest.approx(snr, rel=0.1)
    assert slips.period == pytest.approx(40, rel=0.05)


def test_a_gap_between_small_and_large_drops_moves_the_threshold() -> None:
    """A failure means clusters of small false drops stay among the true ones."""
    small = np.where(np.arange(60) % 3 == 1, 8.0, 100.0)
    load = np.concatenate([np.linspace(0, drop, 50, endpoint=False) + 500 for drop in small])
    load += np.random.default_rng(2).standard_normal(load.size)
    slips = find_slips(load, 1.0)
    assert slips.threshold_how == "gap"
    assert 8 < slips.threshold < 100
    assert slips.drop.min() > 50


def test_slips_in_louder_noise_are_below_no_gap() -> None:
    """Every sixth slip lies in noise that is 40 times louder. A failure means that the slips there, as large
    as the others, are left out as if they were small."""
    test = plain(sticks=180, samples=60, snr=400.0, seed=3, scatter=0.0)
    load = test.force["load_N"].to_numpy()
    loud = np.arange(load.size) % 3600 < 600
    load = load + np.where(loud, 40.0, 0.0) * np.random.default_rng(4).standard_normal(load.size)
    slips = find_slips(load, np.where(loud, 40.0, 1.0))
    assert slips.edge.size == pytest.approx(len(test.truth) + 1, abs=2)


def test_slips_are_found_where_a_load_behind_a_low_pass_grows() -> None:
    """Drops grow from 0.8 to 80 N. A failure means that a third of them is left out, since what the low-pass
    bends in the last sticks is larger."""
    test = plain(sticks=150, samples=150, snr=400, seed=4, scatter=0.0)
    load = test.force["load_N"].to_numpy()
    tail = lfilter([0.07], [1, -0.93], load - 100) * np.geomspace(0.002, 0.2, load.size)
    slips = find_slips(tail + 0.1 * np.random.default_rng(5).standard_normal(load.size), 0.1)
    assert slips.edge.size == pytest.approx(len(test.truth) + 1, abs=4)


@pytest.mark.parametrize(("least", "most"), [(0.12, 0.9), (0.12, 0.12)])
def test_small_slips_close_to_large_ones_are_found(least: float, most: float) -> None:
    """One slip of three is small, and the load is back at its peak as soon as it has risen by as much. A
    failure means events that hold two sticks, of which no warning tells."""
    rng = np.random.default_rng(4)
    drops = 50 * (1 + 0.07 * rng.standard_normal(90))
    drops[1::3] *= rng.permutation(np.geomspace(least, most, 30))
    stick = [np.arange(drop, 0, -1 / 3) for drop in drops]
    load = 500 - np.concatenate(stick) + 0.1 * rng.standard_normal(sum(map(len, stick)))
    true = np.cumsum([len(part) for part in stick])[:-1]
    slips = find_slips(load, 0.1)
    if least == most:  # small ones below a gap are counted
        assert slips.threshold_how == "gap"
        assert slips.left_out.size == pytest.approx(30, abs=1)
        return
    assert slips.edge.size == pytest.approx(true.size, abs=1)
    assert np.mean(np.abs(slips.edge[:, None] - true).min(axis=0) <= 2) > 0.98


def test_knees_are_not_slips() -> None:
    """A failure means the change of slope within the sticks of fast pulls counts as an event of its own."""
    test = plain(sticks=40, samples=200, snr=2000, jitter=0.1, scatter=0.05, seed=3)
    time = test.force["time_s"].to_numpy()
    stick = np.searchsorted(test.truth["t_v_s"], time, side="right") - 1
    start, end = (test.truth[name].to_numpy()[stick] for name in ("t_v_s", "t_p_s"))
    phase = np.clip(np.where(stick >= 0, (time - start) / (end - start), 0.0), 0.0, 1.0)
    bump = 500 * np.minimum(phase / 0.3, (1 - phase) / 0.7)
    bent = test.force.assign(load_N=("time_s", test.force["load_N"].to_numpy() + bump))
    assert len(find_stick_slip(bent)) == len(find_stick_slip(test.force))


def pull(level_N: Floats, drops_N: Floats, *, ramp_s: float, seed: int) -> tuple[Floats, Floats, float]:
    """(load, time of each slip, noise) at 200 Hz: sticks that rise at 0.07 N/s up to the level,
    after the whole load has been built up from zero."""
    rate, slope, slips, knots = 200, 0.07, [], [(0.0, level_N[0] - 0.2)]
    for top, drop in zip(level_N, drops_N, strict=True):
        at, load = knots[-1]
        slips.append(at + max(0.2, (top - load) / slope))
        knots += [(slips[-1], top), (slips[-1] + 0.01, top - drop)]
    places, loads = np.array(knots).T
    time = np.arange(0, places[-1], 1 / rate)
    load = np.interp(time, places, loads) * np.clip(time / ramp_s, 0, 1)
    return load + np.random.default_rng(seed).normal(0, 0.004, time.size), np.array(slips), 0.004


@pytest.mark.parametrize("seed", range(3))
def test_no_slip_is_joined_to_the_build_up_of_the_load(seed: int) -> None:
    """A failure means that all slips are lost for a minute after the load has been built up: two thirds of
    these were."""
    drops = np.random.default_rng(seed).uniform(0.15, 0.35, 40)
    load, slips, sigma = pull(np.full(40, 20.0), drops, ramp_s=15, seed=seed)
    found = find_slips(load, sigma).edge / 200
    late = slips[(slips > 16) & (slips < load.size / 200 - 1)]
    assert (np.abs(found[:, None] - late).min(axis=0) < 0.05).all()
    assert np.sum(found > 16) <= late.size + 1


@pytest.mark.parametrize("seed", range(3))
def test_no_stick_is_lost_beside_one_that_falls(seed: int) -> None:
    """A failure means that one stick in which the load falls takes the slips around it: half were lost
    where the friction falls along the pull."""
    rng = np.random.default_rng(seed)
    level = 20 - 0.012 * np.arange(250) + rng.normal(0, 0.01, 250)
    drops = rng.uniform(0.03, 0.06, 250)
    load, slips, sigma = pull(level, drops, ramp_s=1e-9, seed=seed)
    found = find_slips(load, sigma).edge / 200
    assert np.mean(np.abs(found[:, None] - slips[:-1]).min(axis=0) < 0.05) > 0.9


FAST = {"speed": 10.0, "rate": 2000.0, "noise": 0.05, "d1": 13.8, "slip_s": 0.005}


def median_ratios(test: Test, **options: float | str) -> dict[str, float]:
    events = find_stick_slip(test.force, **options)
    nearest = np.abs(events["t_p_s"].to_numpy()[:, None] - test.truth["t_p_s"].to_numpy()).argmin(axis=1)
    truth = test.truth.iloc[nearest].reset_index(drop=True)
    columns = ("stick_length_um", "dF_N", "K_N_per_mm")
    return {name: float((events[name] / truth[name]).median()) for name in columns}


@pytest.mark.thorough
@pytest.mark.parametrize("tau", [0.001, 0.003, 0.01])
def test_fast_pulls_behind_a_slow_chain_come_out_true(tau: float) -> None:
    """A failure means force drops and stick lengths of fast pulls are the amplifier's, not the sample's."""
    test = realistic(tau=tau, **FAST)
    assert find_stick_slip(test.force, lowpass_s="auto").attrs["lowpass_s"] == pytest.approx(tau, rel=0.05)
    for name, ratio in median_ratios(test, lowpass_s="auto").items():
        assert ratio == pytest.approx(1, abs=0.03), name


def test_a_second_order_filter_is_no_low_pass_of_first_order() -> None:
    """A failure means that the wrong filter is undone, so that Λ_st is a tenth too short and called sure."""
    test = realistic(tau=0.0, noise=0.1, d1=14.5)
    load = sosfilt(butter(2, 5.0, fs=200.0, output="sos"), test.force["load_N"].to_numpy())
    events = find_stick_slip(test.force.assign(load_N=("time_s", load)), lowpass_s="auto")
    attrs = events.attrs
    assert (attrs["lowpass_s"], attrs["lowpass_how"]) == (0, "doubtful")
    assert not attrs["lowpass_proven"]
    assert attrs["lowpass_doubt"] == "shape"
    nearest = np.abs(events["t_p_s"].to_numpy()[:, None] - test.truth["t_p_s"].to_numpy()).argmin(axis=1)
    for name, error in (("stick_length_um", "stick_length_err_um"), ("dF_N", "dF_err_N")):
        off = events[name].to_numpy() - test.truth[name].to_numpy()[nearest]
        assert np.median(np.abs(off) / events[error]) < 2, name


def test_a_slow_chain_left_alone_spoils_the_drops() -> None:
    """A failure means the test above would pass without correcting for the low-pass, and so prove nothing."""
    assert median_ratios(realistic(tau=0.01, **FAST), lowpass_s=0.0)["dF_N"] < 0.9


@pytest.mark.parametrize("settings", [{"rate": 200.0}, {"rate": 1000.0, "slip_s": 0.02}, FAST])
def test_no_low_pass_is_seen_where_there_is_none(settings: dict[str, float]) -> None:
    """A failure means a slip's own length, or noise, is taken for a low-pass."""
    attrs = find_stick_slip(realistic(tau=0.0, **settings).force, lowpass_s="auto").attrs
    assert attrs["lowpass_s"] == 0
    assert not attrs["lowpass_proven"]


def test_slips_that_are_level_at_both_ends_passed_no_low_pass() -> None:
    """Slips of half a cosine between sticks that each begin more or less steeply. A failure means that errors
    of forces are ten times too large, since a few of the sticks look like transients of a low-pass."""
    rng, u, slip_s = np.random.default_rng(0), np.linspace(0, 1, 20)[1:], 0.04
    time, load = [np.zeros(1)], [np.ones(1)]
    valleys = []
    for _ in range(80):
        rise, steep = 0.3 * np.exp(0.4 * rng.standard_normal()), 0.3 * np.exp(0.8 * rng.standard_normal())
        part = 0.1 * np.exp(0.5 * rng.standard_normal())
        time.append(time[-1][-1] + 0.08 * rise / 0.3 * u)
        along = (1 - part) * u + part * np.expm1(-u / steep) / np.expm1(-1 / steep)
        load.append(load[-1][-1] + rise * along)
        peak = load[-1][-1]
        fall = peak - max(peak - 0.3 * np.exp(0.4 * rng.standard_normal()), 0.2)
        time.append(time[-1][-1] + slip_s * u)
        load.append(peak - fall * (1 - np.cos(np.pi * u)) / 2)
        valleys.append((time[-1][-1], load[-1][-1]))
    at = np.arange(0, time[-1][-1], 1e-3)
    noisy = np.interp(at, np.concatenate(time), np.concatenate(load)) + 0.002 * rng.standard_normal(at.size)
    events = find_stick_slip(recording(at, noisy, 13 + at, 60.0))
    assert np.isnan(events.attrs["lowpass_proposed_s"])
    when, low = np.transpose(valleys)
    off = events["F_v_N"].to_numpy() - low[np.abs(when[:, None] - events["t_v_s"].to_numpy()).argmin(axis=0)]
    assert np.median(np.abs(off)) < np.median(events["F_v_err_N"]) < 3 * np.median(np.abs(off))


@pytest.mark.parametrize("samples", [30, 100])
@pytest.mark.parametrize("snr", [6.0, 20.0])
def test_no_low_pass_is_seen_in_noise(samples: int, snr: float) -> None:
    """A failure means a wrong guess, once corrected for, confirms itself."""
    for seed in range(2):
        force = plain(sticks=150, samples=samples, snr=snr, seed=seed).force
        assert find_stick_slip(force, lowpass_s="auto").attrs["lowpass_s"] == 0


def test_a_fit_that_is_nearly_singular_proves_nothing() -> None:
    """A failure means that a low-pass fits 10^16 times better than none, since sticks that began long before
    they are seen leave the knee's transient and that of the slip the same."""
    rng = np.random.default_rng(0)
    start = 600 * np.arange(1, 20)
    stop = start + 60
    load = 0.01 * np.arange(600.0 * 21) + 0.02 * rng.standard_normal(600 * 21)
    transients = SlipTransients(
        start, stop, start - 200.0, start - rng.uniform(100, 200, start.size), stop + 5.0, np.ones(start.size)
    )
    found = estimate_lowpass(load, transients)
    assert found is not None
    assert found.gain < 1e3


def test_slips_of_several_samples_behind_a_slow_chain_are_no_shorter_in_noise() -> None:
    """A failure means noise of the corrected load shortens slips, and so lengthens drops and sticks."""
    for tau, noise in ((0.05, 2.0), (0.2, 0.3)):
        test = realistic(tau=tau, noise=noise, rate=100.0, slip_s=0.1, d1=14.5)
        for name, ratio in median_ratios(test, lowpass_s=tau).items():
            assert ratio == pytest.approx(1, abs=0.02), name


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


@pytest.mark.thorough
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
        InputError, match=r"between slips, 0\.[23]\d* s; found .* s; give `lowpass_s` in seconds"
    ):
        find_stick_slip(plain(sticks=20).force, lowpass_s=lowpass_s)


@pytest.mark.thorough
def test_a_long_hold_among_short_sticks() -> None:
    """A failure means that one long stick makes all others take as much memory."""
    rng = np.random.default_rng(0)
    saw = 5 * (np.arange(40 * 30) % 30) / 30
    load = np.r_[saw, np.linspace(0, 5, 60_000), saw]
    time = np.arange(load.size) / 100
    force = recording(time, 20 + load + 0.02 * rng.standard_normal(load.size), 13 + time / 1000, 0.06)
    slips = find_slips(force["load_N"].values, 0.02)
    load = force["load_N"].values
    corners = find_corners(signal_of(load, 0.02), slips)
    transients = corners.transients()
    tracemalloc.start()
    estimate_lowpass(load, transients)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 20e6


@pytest.mark.thorough
@pytest.mark.parametrize("ramp_s", [0.0, 1.0])
@pytest.mark.parametrize(("before_s", "after_s"), [(2, 0), (3, 30), (10, 0), (30, 0), (100, 10)])
def test_a_rest_before_or_after_the_pull_changes_no_event(
    before_s: float, after_s: float, ramp_s: float
) -> None:
    """A failure means that slips beside a rest are lost, or that a stick begins within the first loading."""
    moving = realistic(d1=13.8, noise=0.0, slip_s=0.002, seed=1).force
    time, load, d = (moving[name].to_numpy() for name in ("time_s", "load_N", "d_mm"))
    # The crosshead accelerates evenly, and covers the same way in twice the time.
    whole = np.arange(0, time[-1] + ramp_s / 2, 0.005)
    way = np.where(whole < ramp_s, whole**2 / (2 * ramp_s or 1), whole - ramp_s / 2)
    rest = round(before_s / 0.005), round(after_s / 0.005)

    def events(rest: tuple[int, int]) -> Floats:
        load_N, d_mm = (np.pad(np.interp(way, time, values), rest, "edge") for values in (load, d))
        noise = np.random.default_rng(5).normal(0, 0.1, load_N.size)
        force = recording(0.005 * np.arange(load_N.size), load_N + noise, d_mm, 1.0)
        found = find_stick_slip(force)
        assert (found["flag"] == "ok").all()
        start = 0.005 * rest[0]
        return found[["t_v_s", "t_p_s", "dF_N", "stick_length_um"]].to_numpy() - [start, start, 0, 0]

    with_rest, without = events(rest), events((0, 0))
    np.testing.assert_allclose(with_rest, without, atol=0.4)


@pytest.mark.thorough
@pytest.mark.parametrize("hold_s", [3, 10])
def test_a_stick_in_which_the_machine_was_held_is_flagged(hold_s: int) -> None:
    """A failure means that the line through a stick and a hold gives a wrong event without any flag."""
    moving = realistic(d1=13.8, noise=0.1, slip_s=0.002, seed=1)
    time, load, d = (moving.force[name].to_numpy() for name in ("time_s", "load_N", "d_mm"))
    begin, end = moving.truth.loc[15, ["t_v_s", "t_p_s"]]
    place = int(np.searchsorted(time, 0.5 * (begin + end)))
    index = np.r_[:place, np.full(200 * hold_s, place), place : time.size]
    noise = np.random.default_rng(2).normal(0, 0.1, index.size)
    events = find_stick_slip(recording(0.005 * np.arange(index.size), load[index] + noise, d[index], 1.0))
    held = (events["t_v_s"] < 0.005 * place) & (events["t_p_s"] > 0.005 * place)
    assert held.sum() == 1
    held |= held.shift(-1, fill_value=False)  # where the load relaxes, the stick before ends too early
    assert events["flag"][held].str.contains("still").all()
    assert (events["flag"][~held] == "ok").all()


@pytest.mark.parametrize(("rate", "step_mm"), [(750.0, 1e-4), (1000.0, 5e-5)])
def test_an_encoder_whose_steps_are_a_few_samples_long_does_not_stand_still(
    rate: float, step_mm: float
) -> None:
    """A failure means that slips within one step of the displacement are taken for holds of the machine."""
    force = realistic(d1=13.8, rate=rate, noise=0.1, slip_s=0.002, tau=0.0, seed=3).force
    events = find_stick_slip(force.assign(d_mm=np.round(force["d_mm"] / step_mm) * step_mm))
    assert len(events) > 30
    assert (events["flag"] == "ok").all()


def test_a_displacement_of_which_a_step_is_as_long_as_a_stick_does_not_stand_still() -> None:
    """A failure means that sticks within one step of the displacement are taken for holds of the machine."""
    force = realistic(d1=13.8, noise=0.1, slip_s=0.002, tau=0.0, seed=3).force
    events = find_stick_slip(force.assign(d_mm=np.floor(force["d_mm"] / 0.02) * 0.02))
    assert (events["stick_length_um"] == 0).any() or events["stick_length_um"].min() < 5
    assert not events["flag"].str.contains("still").any()
