"""Stick-slip, slow slips, oscillations and cycles are told apart, and measured as recorded."""

from __future__ import annotations

import re

import numpy as np
import pytest
import xarray as xr

from tests.scenes.sawtooth import realistic, recording
from vision.data import ForceMetadata, StickMetadata
from vision.errors import InputError
from vision.force import ForceSettings, find_stick_slip
from vision.force.corners import find_extremes

STICK_S, DROP_N, RATE_HZ = 0.03, 8.0, 10_000.0


def half_cosine(slip_s: float, *, noise: float = 0.01, speed: float = 10.0) -> xr.Dataset:
    """Straight sticks of 30 ms and slips of half a cosine, 8 N each."""
    time = np.arange(0, 80 * (STICK_S + slip_s), 1 / RATE_HZ)
    phase = time % (STICK_S + slip_s)
    falling = DROP_N * (1 + np.cos(np.pi * (phase - STICK_S) / slip_s)) / 2
    load = 20 + np.where(phase < STICK_S, DROP_N * phase / STICK_S, falling)
    load = load + noise * np.random.default_rng(0).standard_normal(time.size)
    return recording(time, load, 13 + speed / 60 * time, speed)


@pytest.mark.thorough
@pytest.mark.parametrize("slip_s", [0.01, 0.02, 0.03])
def test_slow_slips_are_measured_at_recorded_extremes(slip_s: float) -> None:
    """A failure means slow slips are read larger than the recording swings, or too short."""
    events = find_stick_slip(half_cosine(slip_s))
    assert events["dF_N"].median() == pytest.approx(DROP_N, rel=0.01)
    assert events["slip_length_um"].median() == pytest.approx(1e3 * 10 / 60 * slip_s, rel=0.15)
    assert events["flag"].str.contains("slow").mean() > 0.95
    assert events.attrs["regime"] == "stick-slip"


def test_extrapolation_through_slow_slips_fails() -> None:
    """A failure means the test above would pass with stick lines extended through slow slips."""
    lines = find_stick_slip(half_cosine(0.03), settings=ForceSettings(slow_slip=100, between_samples=1.0))
    assert lines["flag"].eq("ok").all()
    extremes = find_stick_slip(half_cosine(0.03))
    assert lines["slip_length_um"].median() < 0.85 * extremes["slip_length_um"].median()


@pytest.mark.thorough
@pytest.mark.parametrize("noise", [0.003, 0.01, 0.03, 0.1])
@pytest.mark.parametrize(("fall", "rise"), [(60, 120), (100, 150), (40, 60)])
def test_noise_does_not_lengthen_slow_slips(fall: int, rise: int, noise: float) -> None:
    """A failure means that the largest of many samples of noise is the peak: 17 % too much at a tenth of the
    drop, with errors that say 4 %."""
    stick = np.linspace(0, 1, rise, endpoint=False)
    slip = 0.5 * (1 + np.cos(np.pi * np.arange(fall) / fall))
    load = 10 + np.tile(np.r_[stick, slip], 80)
    load += noise * np.random.default_rng(1).standard_normal(load.size)
    events = find_stick_slip(recording(1e-3 * np.arange(load.size), load, 13.0 + np.zeros(load.size), 1.0))
    assert events["flag"].str.contains("slow").all()
    assert events["dF_N"].median() == pytest.approx(1, abs=0.035)
    for name, truth in (("dF", 1), ("F_p", 11), ("F_v", 10)):
        off = np.abs(events[f"{name}_N"] - truth) / events[f"{name}_err_N"]
        assert np.mean(off < 2) > 0.9, name
    assert events["dF_err_N"].median() < noise + 0.01


def test_a_sinusoid_is_an_oscillation() -> None:
    """A failure means 130 events "without a flag" in a recording without a single stick."""
    time = np.arange(0, 3, 5e-4)
    noise = 0.003 * np.random.default_rng(1).standard_normal(time.size)
    load = 0.3 + 0.08 * np.sin(2 * np.pi * 35 * time) + noise
    events = find_stick_slip(recording(time, load, 13 + 4 * time, 240.0))
    assert events.attrs["regime"] == "oscillation"
    assert any("oscillation" in line for line in events.attrs["warnings"])
    assert events["flag"].str.contains("oscillation").all()
    assert events["dF_N"].median() == pytest.approx(0.16, rel=0.06)


@pytest.mark.thorough
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("white", [0.0, 0.02])
def test_slow_noise_alone_gives_no_event_called_ok(white: float, seed: int) -> None:
    """A failure means drops of pink (1/f) noise pass for slips: 5 to 9 a recording did."""
    rng = np.random.default_rng(seed)
    frequency = np.fft.rfftfreq(12_000)
    frequency[0] = frequency[1]
    pink = np.fft.irfft(np.fft.rfft(rng.normal(size=12_000)) / np.sqrt(frequency), 12_000)
    time = np.arange(pink.size) / 100
    load = 20 + 0.01 * time + 0.05 * pink / pink.std() + white * rng.standard_normal(time.size)
    events = find_stick_slip(recording(time, load, 13 + time / 60, 1.0))
    assert not (events["flag"] == "ok").any()
    assert re.search(r"not stick-slip|stick-slip is not clearly visible", events.attrs["warnings"][0])


@pytest.mark.parametrize("known", [True, False])
def test_a_purely_elastic_triangle_is_no_stick_slip(known: bool) -> None:
    """A failure means loading and unloading of one sheet pass as stick and slip."""
    time = np.arange(0, 50, 0.01)
    swing = 5 - np.abs(time % 10 - 5)
    load = 20 * swing + 0.05 * np.random.default_rng(2).standard_normal(time.size)
    force = recording(time, load, 13 + swing / 100 if known else np.full(time.size, np.nan), 1.0)
    if known:
        with pytest.raises(InputError, match=r"stick-slip.*push–pull cycles"):
            find_stick_slip(force)
    else:
        events = find_stick_slip(force)
        assert events.attrs["regime"] == "cycles"
        assert events["flag"].str.contains("cycles").all()


@pytest.mark.thorough
def test_negative_friction_is_flagged() -> None:
    """A failure means friction that pushes is reported without a word."""
    force = half_cosine(0.001)
    events = find_stick_slip(force.assign(load_N=force["load_N"] - 23))
    assert events["flag"].str.contains("negative").all()
    assert not find_stick_slip(force)["flag"].str.contains("negative").any()


@pytest.mark.thorough
@pytest.mark.parametrize("speed", [4.9975, 5.0])
def test_knees_are_seen_in_the_sticks_not_in_the_speed(speed: float) -> None:
    """A failure means ΔF jumps by 8 % between two speeds that nobody can tell apart."""
    rng = np.random.default_rng(3)
    time = np.arange(0, 20, 1e-3)
    phase = time % 0.3 / 0.3
    rise = np.where(phase < 0.4, 1.4 * phase, 0.56 + 0.44 * (phase - 0.4) / 0.6)
    load = 20 + 10 * rise + 0.02 * rng.standard_normal(time.size)
    events = find_stick_slip(recording(time, load, 13 + speed / 60 * time, speed))
    assert events.attrs["two_slopes"]
    assert events["dF_N"].median() == pytest.approx(10, rel=0.02)
    ratio = (events["K1_N_per_mm"] / events["K2_N_per_mm"]).median()
    assert ratio == pytest.approx(1.4 / (0.44 / 0.6), rel=0.05)
    straight = find_stick_slip(
        recording(time, 20 + 10 * phase + 0.02 * rng.standard_normal(time.size), 13 + time / 12, speed)
    )
    assert not straight.attrs["two_slopes"]
    assert straight["K1_N_per_mm"].isna().all()


def test_slips_whose_middles_cross_still_have_their_extremes():
    """A failure means that a recording of very quick slips ends in an error nobody foresaw."""
    load = np.r_[np.arange(50.0), np.arange(50.0), np.arange(50.0)]
    found = find_extremes(load, 0.0, np.array([49.6, 53.2, 49.9, 99.5]), np.full(4, 2.0), np.full(4, 1.0))
    for part in (found.peak, found.valley, found.high, found.low):
        assert np.isfinite(part).all()
    assert found.peak[0] == 49 and found.valley[3] == 100


@pytest.mark.parametrize("seed", [6, 12, 14])
def test_smoothed_noise_gives_no_event_called_ok(seed: int) -> None:
    """A failure means that a few swings of a smoothly sliding load, between many slow ones, are slips."""
    rng = np.random.default_rng([seed, 3976050858])
    width = np.arange(-120, 121)
    load = np.convolve(rng.standard_normal(12_000), np.exp(-(width**2) / 1800), "same")
    time = np.arange(load.size) / 100
    force = recording(time, 20 + 0.01 * time + 0.05 * load / load.std(), 13 + time / 60, 1.0)
    assert not (find_stick_slip(force)["flag"] == "ok").any()


@pytest.mark.parametrize("size_um", [0.0, 0.5, 2.0])
@pytest.mark.parametrize("measured", [True, False])
def test_a_periodic_error_of_the_displacement_is_told(size_um: float, measured: bool) -> None:
    """A failure means that K of single sticks, wrong by up to 16 %, has no warning, or that a crosshead that
    itself moves unevenly is said to be measured wrongly."""
    made = realistic(tau=0.0, noise=0.1, d1=14.0)
    time, d, load = (made.force[name].to_numpy() for name in ("time_s", "d_mm", "load_N"))
    off = 1e-3 * size_um * np.sin(2 * np.pi * (d - d[0]) / 0.08)
    if not measured:  # the same displacement, which the load now follows
        load = np.interp(time + 60 * off, time, load)
    force = made.force.assign(load_N=("time_s", load), d_mm=("time_s", d + off))
    said = [line for line in StickMetadata.of(find_stick_slip(force)).warnings if "periodic error" in line]
    assert len(said) == (measured and size_um > 0)
    for line in said:
        assert f"±{size_um:.2g} µm every" in line
        assert float(line.split("every ")[1].split(" ")[0]) == pytest.approx(80, rel=0.06)


@pytest.mark.parametrize(
    ("kind", "said"), [("steady", ""), ("rest", "machine rested"), ("speed", "changed its")]
)
def test_a_machine_that_is_not_steady_is_told_where_d_comes_from_the_speed(kind: str, said: str) -> None:
    """A failure means that d is wrong by a rest or by another speed in the test, and nothing says so, or that
    a steady pull is doubted."""
    made = realistic(d1=14.5).force
    made.attrs |= ForceMetadata(separation_from="speed").attrs()
    time = made["time_s"].to_numpy().copy()
    middle = time.size // 2
    if kind == "speed":
        time[:middle] = 0.5 * time[:middle] + 0.5 * time[middle]
        time -= time[0]
    columns = {name: made[name].to_numpy() for name in ("time_s", "load_N", "flag")}
    if kind == "rest":  # of 8 s, in which the load relaxes
        rest = np.full(1600, columns["load_N"][middle]) - 0.5 * np.log1p(np.arange(1600) / 20)
        columns = {
            name: np.insert(each, middle, each[middle - 1600 : middle]) for name, each in columns.items()
        }
        columns["load_N"][middle : middle + 1600] = rest
        time = np.arange(columns["load_N"].size) / 200
    force = recording(time, columns["load_N"], 13 + time / 60, 1.0).assign_attrs(made.attrs)
    warnings = [line for line in find_stick_slip(force).attrs["warnings"] if "d0 + V t" in line]
    assert len(warnings) == bool(said)
    assert said in "".join(warnings)
