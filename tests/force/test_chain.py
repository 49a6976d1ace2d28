"""The force chain's low-pass: found in the slips' tails, and undone."""

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from tests.scenes.sawtooth import Test, plain, realistic, recording
from vision.errors import InputError
from vision.experiment import simulate_pull, with_settings
from vision.experiment.force_file import force_recording
from vision.experiment.presets import preset
from vision.force import find_stick_slip
from vision.force.corners import find_corners
from vision.force.lines import fit_broken_lines, fit_lines
from vision.force.lowpass import deconvolve_lowpass, estimate_lowpass
from vision.force.recording import read_force
from vision.force.slips import find_slips
from vision.models.fits import fit_models

FAST = {"speed": 10.0, "rate": 2000.0, "noise": 0.05, "d1": 13.8, "slip_s": 0.005}


def median_ratios(test: Test, **options: float) -> dict[str, float]:
    events = find_stick_slip(test.force, **options)
    nearest = np.abs(events["t_p_s"].to_numpy()[:, None] - test.truth["t_p_s"].to_numpy()).argmin(axis=1)
    truth = test.truth.iloc[nearest].reset_index(drop=True)
    columns = ("stick_length_um", "dF_N", "K_N_per_mm")
    return {name: float((events[name] / truth[name]).median()) for name in columns}


@pytest.mark.parametrize("tau", [0.001, 0.003, 0.01])
def test_fast_pulls_behind_a_slow_chain_come_out_true(tau: float) -> None:
    """A failure means force drops and stick lengths of fast pulls are the amplifier's, not the sample's."""
    test = realistic(tau=tau, **FAST)
    assert find_stick_slip(test.force).attrs["lowpass_s"] == pytest.approx(tau, rel=0.05)
    for name, ratio in median_ratios(test).items():
        assert ratio == pytest.approx(1, abs=0.03), name


def test_a_slow_chain_left_alone_spoils_the_drops() -> None:
    """A failure means the test above would pass without undoing the low-pass, and so prove nothing."""
    assert median_ratios(realistic(tau=0.01, **FAST), lowpass_s=0.0)["dF_N"] < 0.9


@pytest.mark.parametrize("settings", [{"rate": 200.0}, {"rate": 1000.0, "slip_s": 0.02}, FAST])
def test_no_low_pass_is_seen_where_there_is_none(settings: dict[str, float]) -> None:
    """A failure means a slip's own length, or noise, is taken for the force chain."""
    assert find_stick_slip(realistic(tau=0.0, **settings).force).attrs["lowpass_s"] == 0


@pytest.mark.parametrize("samples", [30, 100])
@pytest.mark.parametrize("snr", [6.0, 20.0])
def test_no_low_pass_is_seen_in_noise(samples: int, snr: float) -> None:
    """A failure means a wrong guess, once undone, confirms itself."""
    for seed in range(2):
        force = plain(sticks=150, samples=samples, snr=snr, seed=seed).force
        assert find_stick_slip(force).attrs["lowpass_s"] == 0


def test_tails_of_no_single_low_pass_are_left_alone_and_said() -> None:
    """A failure means that real slips that relax each in its own way are taken for a slow amplifier."""
    path = Path(__file__).parents[3] / "shared/data/paper_on_paper_k168Nm_v1100.mat"
    if not path.is_file():
        pytest.skip("the recording is not here")
    for two_slopes in (False, True):
        attrs = find_stick_slip(read_force(path), two_slopes=two_slopes).attrs
        assert (attrs["lowpass_s"], attrs["lowpass_how"]) == (0, "doubtful")


def test_a_given_low_pass_is_used() -> None:
    """A failure means the user's word counts for nothing."""
    test = realistic(tau=0.01, **FAST)
    attrs = find_stick_slip(test.force, lowpass_s=0.01).attrs
    assert (attrs["lowpass_s"], attrs["lowpass_how"]) == (pytest.approx(0.01), "given")


@pytest.mark.parametrize("settings", [FAST | {"tau": 0.003}, {"rate": 200.0}, {"rate": 100.0, "tau": 0.01}])
def test_stick_lengths_carry_an_honest_error(settings: dict[str, float]) -> None:
    """A failure means stick_length_err_um is too small to be used in σ_x/Λ_st."""
    test = realistic(**settings)
    events = find_stick_slip(test.force)
    nearest = np.abs(events["t_p_s"].to_numpy()[:, None] - test.truth["t_p_s"].to_numpy()).argmin(axis=1)
    off = events["stick_length_um"].to_numpy() - test.truth["stick_length_um"].to_numpy()[nearest]
    assert np.mean(np.abs(off) < events["stick_length_err_um"]) > 0.6
    assert (events["stick_length_err_um"] < 0.1 * events["stick_length_um"]).all()


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


@pytest.mark.parametrize("lowpass_s", [0.0, 0.003])
def test_the_stiffness_of_fast_pulls_is_that_after_the_knee(lowpass_s: float) -> None:
    """A failure means K, and with it N̂ and Y_eff, mixes the two slopes of a fast stick."""
    experiment = with_settings(preset("fast", seed=3), {"load_cell.lowpass_s": lowpass_s})
    pull = simulate_pull(experiment.mechanics, seed=3)
    load = force_recording(experiment, pull)
    time, d = load["time_s"].to_numpy(), 13 + load["crosshead_mm"].to_numpy()
    sticks = find_stick_slip(recording(time, load["load_N"].to_numpy(), d, 10.0))
    truth = pull.events()
    nearest = np.abs(sticks["t_p_s"].to_numpy()[:, None] - truth["t_p_s"].to_numpy()).argmin(axis=1)
    ratio = sticks["K_N_per_mm"].to_numpy() / truth["K_N_per_mm"].to_numpy()[nearest]
    assert np.median(ratio) == pytest.approx(1, abs=0.005)
    fits = fit_models(sticks)
    assert fits.modulus_GPa.value == pytest.approx(3.8, abs=3 * fits.modulus_GPa.error)
    assert fits.n_hat_N.value == pytest.approx(0.57, abs=3 * fits.n_hat_N.error)


def test_lines_behind_a_low_pass_are_the_lines_before_it() -> None:
    """A failure means slopes and ends of sticks are those of the amplifier."""
    tau, fine = 12.0, 50
    index = np.arange(80.0)
    before = 3 + 0.5 * index + 0.4 * np.minimum(index - 25, 0)
    grid = np.arange(-fine * 200, fine * 80) / fine
    driven = np.interp(grid, index, before, left=60.0)
    keep = np.exp(-1 / (fine * tau))
    after = lfilter([1 - keep], [1, -keep], driven, zi=[keep * 60.0])[0][fine * 200 :: fine]
    start, stop = np.array([40]), np.array([80])
    line = fit_lines(index, after, start, stop, lag=tau)
    assert line.slope == pytest.approx(0.5, rel=1e-3)
    assert line.at(np.array([79.0])) == pytest.approx(before[-1], abs=0.02)
    assert fit_lines(index, after, start, stop).slope != pytest.approx(0.5, rel=0.05)
    broken = fit_broken_lines(index, after, np.array([0]), stop, lag=tau)
    assert broken.first == pytest.approx(0.9, rel=0.05)
    assert broken.second == pytest.approx(0.5, rel=0.02)
    assert broken.first_at(np.array([0.0])) == pytest.approx(before[0], abs=0.5)
    assert broken.second_at(np.array([79.0])) == pytest.approx(before[-1], abs=0.1)


@pytest.mark.parametrize("lowpass_s", [3.0, -0.001, float("nan")])
def test_a_time_constant_longer_than_a_stick_is_refused(lowpass_s: float) -> None:
    """A failure means that milliseconds given for seconds silently spoil all corners."""
    with pytest.raises(
        InputError, match=r"slip to slip, 0\.[23]\d* s; found .* s; give --force-lowpass in seconds"
    ):
        find_stick_slip(plain(sticks=20).force, lowpass_s=lowpass_s)


def test_a_long_hold_among_short_sticks() -> None:
    """A failure means that one long stick makes all others take as much memory."""
    rng = np.random.default_rng(0)
    saw = 5 * (np.arange(40 * 30) % 30) / 30
    load = np.r_[saw, np.linspace(0, 5, 300_000), saw]
    time = np.arange(load.size) / 100
    force = recording(time, 20 + load + 0.02 * rng.standard_normal(load.size), 13 + time / 1000, 0.06)
    slips = find_slips(force["load_N"].values, 0.02)
    tails = find_corners(
        deconvolve_lowpass(force["load_N"].values, 0.02, slips, 0.0), two_slopes=False
    ).tails()
    tracemalloc.start()
    estimate_lowpass(force["load_N"].values, tails)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 50e6


def test_a_load_that_holds_still_warns_of_nothing() -> None:
    """A failure means a library's warning on the terminal for a recording with a hold."""
    saw = 5 + 5 * (np.arange(41 * 30) % 30) / 30
    load = np.r_[saw, np.full(5000, 5.0), saw]
    time = np.arange(load.size) / 100
    assert len(find_stick_slip(recording(time, load, 13 + time / 1000, 0.06))) > 40
