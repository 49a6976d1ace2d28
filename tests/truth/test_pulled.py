"""The whole chain on a simulated test: tracks and force meet, and σ_x/Λ_st and shells come out true."""

from dataclasses import replace

import numpy as np
import pytest

import vision
from vision.errors import InputError
from vision.experiment import Experiment, profiles, simulate, with_settings
from vision.experiment.settings import Camera


@pytest.fixture(scope="module")
def minute(tmp_path_factory):
    """A minute of the paper's test, 40 frames/s: tracks, force recording, events, clock and truth."""
    whole = Experiment()
    experiment = replace(whole, camera=replace(whole.camera, duration_s=60.0, fps=40.0))
    strip, truth = profiles(experiment)
    tiny = replace(experiment, camera=Camera(width=1920, height=4, strip_rows=4, duration_s=0.2))
    force_file = simulate(tiny, tmp_path_factory.mktemp("force") / "test").force
    tracks, force = vision.track_sheets(strip), vision.read_force(force_file, d0_mm=13.0)
    sticks = vision.find_stick_slip(force)
    return tracks, force, sticks, vision.synchronise(tracks, force, sticks), truth


@pytest.mark.thorough
def test_the_clocks_meet_within_two_milliseconds(minute):
    """A failure means that stick phases are cut at the wrong frames."""
    _, _, _, clock, truth = minute
    assert clock.status == "ok"
    middle = 30.0
    true = truth.attrs["offset_s"] + middle * (1 + truth.attrs["drift_ppm"] * 1e-6)
    assert float(clock.to_force_s(np.array([middle]))[0]) == pytest.approx(true, abs=0.003)


def test_ratios_and_shells_are_true(minute):
    """A failure means that the published σ_x/Λ_st or the number of stiff sheets would be wrong."""
    tracks, _, sticks, clock, truth = minute
    motion = vision.horizontal_deformation(tracks, sticks, clock, pixel_size_um=10.0)
    nearest = np.abs(motion["t_v_s"].values[:, None] - truth["t_v_s"].values).argmin(axis=1)
    known = np.isfinite(motion["ratio"].values)
    off = (motion["ratio"].values - truth["ratio"].values[nearest])[known]
    assert known.mean() > 0.95
    assert abs(np.median(off)) < 0.01
    assert np.quantile(np.abs(off), 0.9) < 0.03
    shells = vision.classify_shells(motion)
    size = (truth["ratio"].values[nearest] < 0.1).reshape(len(nearest), 2, -1).sum(axis=2)
    found = shells.pivot_table(index="event", columns="side", values="stiff_sheets").to_numpy(float)
    assert (np.abs(found - size) <= 1).mean() >= 0.9


def test_a_wrong_clock_is_refused(minute):
    """A failure means that the test above would pass with any clock."""
    tracks, force, sticks, _, truth = minute
    wrong = vision.synchronise(tracks, force, sticks, offset_s=truth.attrs["offset_s"] + 0.4)
    with pytest.raises(InputError, match="slips of the film within all of them"):
        vision.horizontal_deformation(tracks, sticks, wrong, pixel_size_um=10.0)


def test_forces_give_back_the_models(minute):
    """A failure means that μ, A, N̂ or Y_eff of a publication would be wrong."""
    _, force, sticks, _, _ = minute
    fits = vision.fit_models(force, sticks)
    assert fits.mu.value == pytest.approx(0.89, abs=4 * fits.mu.error + 0.005)
    assert fits.amplitude.value == pytest.approx(0.34, rel=0.05)
    assert fits.n_hat_N.value == pytest.approx(0.57, abs=4 * fits.n_hat_N.error + 0.03)


def test_a_load_cell_that_rings_leaves_clocks_ratios_and_models_as_they_are(minute, tmp_path):
    """A failure means that averaging the ringing shifts the slips, the sticks or the forces."""
    tracks, plain, _, _, truth = minute
    tiny = Camera(width=1920, height=4, strip_rows=4, duration_s=0.2)
    ringing = with_settings(replace(Experiment(), camera=tiny), {"load_cell.ringing_Hz": 15.0})
    force = vision.read_force(simulate(ringing, tmp_path / "test").force, d0_mm=13.0)
    assert np.abs(force["load_N"].values - plain["load_N"].values).max() > 20
    assert any("oscillates at 15" in line for line in vision.find_stick_slip(force).attrs["warnings"])
    sticks = vision.find_stick_slip(force, average_s="auto")
    clock = vision.synchronise(tracks, force, sticks)
    assert (sticks["flag"] == "ok").all()
    assert clock.status == "ok"
    true = truth.attrs["offset_s"] + 30 * (1 + truth.attrs["drift_ppm"] * 1e-6)
    late = 0.003 + 0.1 / (2 * np.pi * 15)  # of the low-pass and of the resonance, which the average hides
    assert float(clock.to_force_s(np.array([30.0]))[0]) - late == pytest.approx(true, abs=0.002)
    test_ratios_and_shells_are_true((tracks, force, sticks, clock, truth))
    test_forces_give_back_the_models((tracks, force, sticks, clock, truth))
