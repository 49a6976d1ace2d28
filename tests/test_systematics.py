"""The budget of systematic errors: each source with a known size, and none where it has no part."""

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.scenes.analysed import EXPERIMENT, PIXEL_UM, Found, video_only, with_force
from tests.scenes.combs import comb, ridges, strip
from vision.deformation import horizontal_deformation
from vision.experiment import profiles
from vision.sheets import track_sheets
from vision.systematics import Budget, systematic_budget


def lit(gradient):
    """Ridges in light that falls by this fraction over 1200 px; truth and strip."""
    x = comb(60)
    light = 1 + gradient * (np.arange(1200) / 1200 - 0.5)
    picture = strip(ridges(x), snr=1000)
    picture.values[:] *= light
    return x, picture


@pytest.mark.parametrize("gradient", [0.3, 0.8])
def test_uneven_light_shifts_places_by_what_the_budget_says(gradient):
    """A failure means that places are off by more than all of their errors, and nothing says so."""
    x, picture = lit(gradient)
    tracks = track_sheets(picture)
    actual = np.sqrt(np.mean(np.mean(tracks.x_px.values - x, axis=0) ** 2))
    assert systematic_budget(Found(strip=picture, tracks=tracks)).total("x_px") == pytest.approx(
        actual, rel=0.3
    )
    assert actual > 5 * float(tracks.x_predicted_px.median()) / np.sqrt(len(x))


def test_even_light_shifts_nothing():
    """A failure means a systematic error where there is none to find."""
    _, picture = lit(0.0)
    assert float(track_sheets(picture).constant_error_px.max()) < 0.003


def test_the_choice_of_rows_is_in_the_budget_and_in_no_statistical_error():
    """It is the same in all frames: an x_err_px that held it would not be the scatter of displacements."""
    _, picture = lit(0.0)
    plain, bowed = (track_sheets(picture.assign_attrs(strip_err_px=err)) for err in (0.0, 0.3))
    assert np.array_equal(plain.x_err_px.values, bowed.x_err_px.values)
    budget = systematic_budget(Found(strip=picture, tracks=bowed))
    assert budget.sources["strip"] == {"x_px": 0.3}
    assert budget.total("x_px") == pytest.approx(0.3, abs=1e-3)


def test_the_budget_of_a_whole_run():
    """What was not given is not known, which is not zero; the force's part is that of its fits."""
    found = with_force()
    budget = systematic_budget(found)
    assert set(budget.values) == {
        *("x_px", "mu", "T0_N", "A", "N_hat_N", "Y_eff_GPa", "Lambda_hat_mm", "K_N_per_mm", "ratio")
    }
    assert budget.total("mu") == pytest.approx(found.fits.mu.systematic_error)
    assert budget.unknown("mu") == ["d0"]
    assert budget.unknown("K_N_per_mm") == ["d0", "machine"]
    assert budget.unknown("ratio") == ["pixel_size", "clock", "machine"]  # the scene's clock has no error
    sticks = found.sticks.copy()
    sticks.attrs["machine_stiffness_N_per_mm"] = 1e5
    surer = replace(found, clock=replace(found.clock, error_ms=0.5), sticks=sticks)
    assert systematic_budget(surer).unknown("ratio") == ["pixel_size"]
    beyond_ms = 1000 * found.motion.attrs["margin_s"] + 1  # more than the time left out beside slips
    worse = replace(surer, clock=replace(found.clock, error_ms=beyond_ms))
    assert systematic_budget(worse).unknown("ratio") == ["pixel_size", "clock"]
    assert math.isnan(
        systematic_budget(surer).total("ratio")
    )  # a clock that matters nothing is no error of 0
    assert math.isnan(systematic_budget(video_only()).values["x_px"])
    assert systematic_budget(Found()).values == {}


@pytest.mark.parametrize("wrong", [0.97, 1.03])
def test_a_pixel_size_wrong_by_its_error_shifts_ratios_by_what_the_budget_says(wrong):
    """A failure means that σ_x/Λ_st is off by more than the stated error of the scale allows."""
    right = with_force()
    motion = horizontal_deformation(right.tracks, right.sticks, right.clock, pixel_size_um=wrong * PIXEL_UM)
    off = replace(right, motion=motion, pixel_size_um=wrong * PIXEL_UM, pixel_size_err_um=0.03 * PIXEL_UM)
    true, read = (systematic_budget(one).values["ratio"] for one in (right, off))
    stated = systematic_budget(off).total("ratio")
    assert stated == pytest.approx(abs(read - true), rel=0.05)
    assert "pixel_size" not in systematic_budget(off).unknown("ratio")
    truth = profiles(EXPERIMENT)[1]
    nearest = np.abs(motion["t_v_s"].values[:, None] - truth["t_v_s"].values).argmin(axis=1)
    relative = motion["ratio"].values[:, [0, -1]] / truth["ratio"].values[nearest][:, [0, -1]] - 1
    assert 0.02 < abs(np.nanmedian(relative)) < 1.2 * stated / read  # of the outermost sheets


def test_sources_add_in_squares():
    """A failure means that parts of a budget add up linearly, or that an unknown one counts as zero."""
    parts = {"strip": {"x_px": 3.0}, "light": {"x_px": 4.0}, "clock": {"x_px": None}}
    budget = Budget(values={"x_px": 1.0}, statistical={"x_px": 0.1}, sources=parts)
    assert budget.total("x_px") == 5.0
    assert budget.to_json()["x_px"]["systematic"] == 5.0
    assert budget.to_json()["x_px"]["sources"]["clock"] is None
