"""Recordings of paper sliding on paper, as `track force` reads them; skipped where they are absent."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import scipy

from vision.data import StickMetadata
from vision.force import find_stick_slip
from vision.force.recording import read_force

DATA = Path(__file__).parents[2] / "../shared/data"
pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason="the recordings are not here")

SPEED_MM_MIN = {"k168Nm_v42": 2.52, "k168Nm_v1100": 66.0, "k1002Nm_v4300": None}


@cache
def recorded(name):
    """The recording; at its speed where that is known."""
    return read_force(DATA / f"paper_on_paper_{name}.mat", speed_mm_min=SPEED_MM_MIN[name])


@cache
def events_of(name):
    """Its events, as recorded."""
    return find_stick_slip(recorded(name))


@pytest.mark.thorough
@pytest.mark.parametrize("name", SPEED_MM_MIN)
def test_every_force_lies_within_what_was_recorded(name):
    """A failure means a peak, a valley or a drop that no sample shows; nothing is deconvolved unasked."""
    force, events = recorded(name), events_of(name)
    low, high = float(force.load_N.min()), float(force.load_N.max())
    assert force["load_N"].attrs["units"] == "1"  # force over weight
    for part in ("F_p_N", "F_v_N"):
        assert low <= events[part].min() and events[part].max() <= high
    assert (events["dF_N"] > 0).all() and events["dF_N"].max() <= high - low
    assert StickMetadata.of(events).lowpass_s == 0


@pytest.mark.thorough
def test_the_slow_pull_is_a_clean_sawtooth():
    """375 s at 2 kHz with impulsive noise: stick-slip at a steady pace, no event of which is doubtful; K is
    the spring's over the weight."""
    force, events = recorded("k168Nm_v42"), events_of("k168Nm_v42")
    facts = StickMetadata.of(events)
    assert float(force.time_s[-1] - force.time_s[0]) == pytest.approx(375.6, abs=0.1)
    assert facts.regime == "stick-slip" and facts.fall_over_rise < 0.1
    assert 240 <= len(events) <= 260
    assert (events["flag"] == "ok").all()
    assert events["K_N_per_mm"].median() == pytest.approx(0.61, abs=0.02)
    assert facts.spikes > 0  # impulses are counted, and no events
    peaks = events["t_p_s"].to_numpy()
    steps = np.diff(peaks)
    assert steps.min() > 0.3 * np.median(steps)  # an impulse taken for a slip would cut a stick in two
    seen = np.array([207.6, 211.9, 221.4, 227.9, 219.3])  # five of the largest slips, read off a plot
    assert np.abs(peaks[:, None] - seen).min(axis=0).max() < 0.15


@pytest.mark.thorough
@pytest.mark.parametrize(("every", "steps"), [(1, 6), (5, 9), (20, 9)])
def test_a_coarse_load_cell_shows_the_same_slips(every, steps):
    """A failure means that rounding to a sixth or ninth of the usual drop hides slips or makes others: the
    hum that a coarse load hides was subtracted, and its steps with it."""
    force, fine = recorded("k168Nm_v42"), events_of("k168Nm_v42")
    step = fine["dF_N"].median() / steps
    part = force.isel(time_s=slice(None, None, every))
    events = find_stick_slip(part.assign(load_N=step * np.round(part["load_N"] / step)))
    peaks, reach = fine["t_p_s"].to_numpy(), 0.15 * fine["t_p_s"].diff().median()
    away = np.abs(events["t_p_s"].to_numpy()[:, None] - peaks)
    assert np.mean(away.min(axis=0) < reach) > 0.9
    assert np.mean(away.min(axis=1) < reach) > 0.99


@pytest.mark.thorough
@pytest.mark.parametrize("samples", [5, 10, 20])
def test_a_moving_mean_of_the_load_makes_no_events(samples):
    """A failure means three times as many events, nearly all flagged as jumps: swings of averaged noise."""
    force, known = recorded("k168Nm_v42"), events_of("k168Nm_v42")
    load = np.pad(force["load_N"], (samples // 2, samples - 1 - samples // 2), "edge")
    load = np.convolve(load, np.full(samples, 1 / samples), "valid")
    events = find_stick_slip(force.assign(load_N=("time_s", load)))
    assert len(known) <= len(events) < 1.05 * len(known)  # smaller slips are found in less noise
    assert (events["flag"] == "ok").mean() > 0.9  # behind 20 samples, averaging divides 8 sticks of 256


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("cutoff_Hz", "name"), [(50, "k168Nm_v42"), (10, "k168Nm_v42"), (200, "k168Nm_v1100")]
)
def test_a_filter_of_the_load_makes_no_events(cutoff_Hz, name):
    """A failure means thousands of events, swings of the noise behind a filter as amplifiers have one."""
    force, known = recorded(name), events_of(name)
    rate_Hz = 1 / float(force["time_s"].diff("time_s").median())
    sos = scipy.signal.butter(2, cutoff_Hz, fs=rate_Hz, output="sos")
    start = float(force["load_N"][0])
    load = scipy.signal.sosfilt(sos, force["load_N"] - start) + start
    events = find_stick_slip(force.assign(load_N=("time_s", load)))
    peaks, reach = known["t_p_s"].to_numpy(), 0.15 * known["t_p_s"].diff().median()
    away = np.abs(events["t_p_s"].to_numpy()[:, None] - peaks)
    assert np.mean(away.min(axis=0) < reach) > 0.97
    assert np.mean(away.min(axis=1) < reach) > 0.95  # smaller slips are found in less noise
    assert StickMetadata.of(events).regime == "stick-slip"


@pytest.mark.thorough
def test_lost_samples_make_no_events():
    """A failure means a thousand events: interpolated samples were taken for ones without noise."""
    force, known = recorded("k168Nm_v42"), events_of("k168Nm_v42")
    kept = np.random.default_rng(3).random(force.sizes["time_s"]) > 0.2
    events = find_stick_slip(force.isel(time_s=np.flatnonzero(kept)))
    assert len(events) == pytest.approx(len(known), abs=3)


def test_the_fast_pull_has_rounded_events_and_says_so():
    """Irregular and rounded: stick-slip still, every slip slow against its stick; the spring is the same."""
    events = events_of("k168Nm_v1100")
    facts = StickMetadata.of(events)
    assert facts.regime == "stick-slip" and facts.fall_over_rise > 0.2
    assert 100 <= len(events) <= 140
    assert events["flag"].str.contains("slow").mean() > 0.9
    assert events["K_N_per_mm"].median() == pytest.approx(0.62, abs=0.04)


def test_errors_do_not_depend_on_a_single_drop():
    """A failure means that errors are many times larger in the whole recording, in which one drop more is
    found, than in one sample of two, in most of it, with a little more noise or where it is averaged."""
    force = recorded("k168Nm_v1100")
    load, size = force["load_N"].to_numpy(), force.sizes["time_s"]
    noisy = load + 5e-4 * np.random.default_rng(0).standard_normal(size)
    changed = [
        force.isel(time_s=slice(None, None, 2)),
        force.isel(time_s=slice(size // 10, 9 * size // 10)),
        force.assign(load_N=("time_s", noisy, force["load_N"].attrs)),
        force.assign(load_N=("time_s", scipy.ndimage.uniform_filter1d(load, 3), force["load_N"].attrs)),
    ]
    errors = ["F_v_err_N", "F_p_err_N", "dF_err_N"]
    whole = events_of("k168Nm_v1100")[errors].median().to_numpy()
    for other in changed:
        assert find_stick_slip(other)[errors].median().to_numpy() == pytest.approx(whole, rel=0.5)


@pytest.mark.parametrize("lowpass_s", [0.0, "auto"])
def test_the_stiff_spring_oscillates(lowpass_s):
    """Almost sinusoidal, 0.19 of the weight from peak to valley: no stick-slip, no drop above that, and no
    force off the recorded curve from a model nobody asked for."""
    force, name = recorded("k1002Nm_v4300"), "k1002Nm_v4300"
    events = find_stick_slip(force, lowpass_s=lowpass_s) if lowpass_s else events_of(name)
    facts = StickMetadata.of(events)
    assert facts.regime == "oscillation"
    said = " ".join(facts.warnings)
    assert "an oscillation, not stick-slip" in said
    assert "varies by 0.19 of the weight" in said or "varies by 0.189 of the weight" in said
    low, high = np.quantile(force.load_N.values, (0.01, 0.99))
    assert high - low == pytest.approx(0.19, abs=0.005)
    assert 0.12 < events["dF_N"].median() < high - low
    assert (events["F_v_N"] > 0.15).all()
    assert (events["F_p_N"] <= events["F_p_raw_N"] + 1e-9).all()
    assert (events["F_v_N"] >= events["F_v_raw_N"] - 1e-9).all()
    assert not (events["flag"] == "ok").any()


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["k168Nm_v1100", "k1002Nm_v4300"])
def test_transients_that_fit_no_single_filter_are_not_corrected(name):
    """A failure means that real slips that relax each in its own way are taken for a slow amplifier."""
    facts = StickMetadata.of(find_stick_slip(recorded(name), lowpass_s="auto"))
    assert facts.lowpass_s == 0
    assert facts.lowpass_how in ("none", "doubtful")
