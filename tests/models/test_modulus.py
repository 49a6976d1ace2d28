"""Young's modulus from push–pull cycles of known truth, and cycles told from a pull."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from tests.scenes.single_sheets import CyclesTest, cycles_record, write_cycles
from vision.errors import InputError
from vision.force import find_stick_slip
from vision.force.recording import read_force
from vision.models.modulus import (
    CYCLES,
    PUBLISHED_SHEET,
    MeanValue,
    ModulusSettings,
    mean_over_cycles,
    measure_cycles,
    summarise_modulus,
    turning_points,
)
from vision.sample import Sample

TEST = CyclesTest()


def recorded(tmp_path: Path, test: CyclesTest) -> tuple[xr.Dataset, pd.DataFrame]:
    truth = write_cycles(tmp_path / "sheet.txt", test)
    return read_force(tmp_path / "sheet.txt"), truth


@pytest.mark.parametrize("modulus", [2.0, 2.5, 3.0])
@pytest.mark.parametrize("absolute", [False, True], ids=["from-zero", "distance"])
def test_modulus_of_a_recording(tmp_path: Path, modulus: float, absolute: bool) -> None:
    """A failure means Y_p is wrong, or depends on whether the machine records Δ or its change."""
    force, truth = recorded(tmp_path, replace(TEST, modulus_GPa=modulus, absolute=absolute))
    cycles = measure_cycles(force)
    CYCLES.check(cycles)
    assert cycles["cycle"].tolist() == [1, 2, 3, 4, 5]
    for name in ("Y_p_GPa", "Y_slope_GPa"):
        mean = mean_over_cycles(cycles, name)
        assert mean.value == pytest.approx(modulus, abs=max(4 * mean.error, 0.002))
        assert mean.error < 0.003
    assert cycles["k_N_per_mm"].mean() == pytest.approx(truth["k_N_per_mm"][0], rel=0.002)
    assert cycles["delta0_mm"].mean() == pytest.approx(16.8, abs=0.002)
    assert cycles["loop_mJ"].mean() == pytest.approx(truth["loop_mJ"][0], rel=0.01)


def test_errors_of_single_cycles_are_their_scatter() -> None:
    """A failure means the error of a cycle is not what cycles scatter by."""
    record = cycles_record(replace(TEST, cycles=40, seed=2))
    cycles = measure_cycles(_dataset(record))
    for name in ("k_N_per_mm", "F0_N", "Y_p_GPa", "delta0_mm"):
        error = {"k_N_per_mm": "k_err_N_per_mm", "F0_N": "F0_err_N"}.get(name)
        error = error or {"Y_p_GPa": "Y_p_err_GPa", "delta0_mm": "delta0_err_mm"}[name]
        assert cycles[name].std() == pytest.approx(cycles[error].mean(), rel=0.35)


def _dataset(record: pd.DataFrame) -> xr.Dataset:
    """A dataset as `read_force` returns it, from a table."""
    data = {
        "load_N": ("time_s", record["load_N"].to_numpy(), {"units": "N"}),
        "d_mm": ("time_s", record["crosshead_mm"].to_numpy(), {"units": "mm"}),
        "crosshead_mm": ("time_s", record["crosshead_mm"].to_numpy(), {"units": "mm"}),
        "flag": ("time_s", np.full(len(record), "ok")),
    }
    return xr.Dataset(data, coords={"time_s": record["time_s"].to_numpy()})


def test_quoted_numbers() -> None:
    """Y_p of 2 and 3 GPa is k = 536 and 804 N/mm and |F0| = 9 and 13.5 kN on the publication's sheet."""
    for modulus, k, offset in ((2.0, 536, 9.0), (3.0, 804, 13.5)):
        cycle = measure_cycles(_dataset(cycles_record(replace(TEST, modulus_GPa=modulus)))).iloc[0]
        assert cycle["k_N_per_mm"] == pytest.approx(k, rel=0.002)
        assert -cycle["F0_N"] / 1000 == pytest.approx(offset, rel=0.002)
        assert cycle["Y_p_GPa"] == pytest.approx(modulus, rel=0.002)
        assert cycle["Y_slope_GPa"] == pytest.approx(modulus, rel=0.002)


def test_the_extrapolated_offset_has_the_larger_absolute_error(tmp_path: Path) -> None:
    """F0 lies the whole length away from the data: its relative error is that of k, not that of F."""
    force, _ = recorded(tmp_path, TEST)
    row = measure_cycles(force).iloc[0]
    assert row["F0_err_N"] / abs(row["F0_N"]) == pytest.approx(
        row["k_err_N_per_mm"] / row["k_N_per_mm"], rel=0.02
    )
    assert row["F0_err_N"] > 50 * 0.05 / np.sqrt(row["samples"])


def test_a_fit_from_the_slack_on_is_wrong(tmp_path: Path) -> None:
    """The part that is fitted matters: from the slack on, the slope is too small."""
    force, _ = recorded(tmp_path, replace(TEST, knee_mm=0.01))
    right = mean_over_cycles(measure_cycles(force), "Y_slope_GPa").value
    wrong = measure_cycles(force, settings=ModulusSettings(part=(0.01, 0.9)))
    assert right == pytest.approx(2.5, rel=0.03)
    assert mean_over_cycles(wrong, "Y_slope_GPa").value < 0.9 * 2.5


def test_wrong_sheet_and_wrong_distance_fail(tmp_path: Path) -> None:
    """The tests above must notice settings that are off."""
    force, _ = recorded(tmp_path, TEST)
    thin = measure_cycles(force, sheet=Sample(thickness_mm=0.08, width_mm=45, length_mm=16.8))
    far = measure_cycles(force, clamp_distance_mm=18.0)
    assert thin["Y_p_GPa"].mean() == pytest.approx(2.5 / 0.8, rel=0.01)
    assert far["Y_p_GPa"].mean() == pytest.approx(2.5 * 18.0 / 16.8, rel=0.01)
    assert far["Y_slope_GPa"].mean() == pytest.approx(2.5, rel=0.01)
    assert far.attrs["clamp_distance_from"] == "given"


@pytest.mark.parametrize(("start_mm", "said"), [(0.0, False), (5.0, True), (100.0, True)])
def test_a_position_that_is_not_the_distance(tmp_path: Path, start_mm: float, said: bool) -> None:
    """A crosshead whose zero is elsewhere. A failure means a Y_p seven times too large without a word."""
    force, _ = recorded(tmp_path, TEST)
    force["crosshead_mm"] = force["crosshead_mm"] + start_mm
    cycles = measure_cycles(force)
    warned = [line for line in cycles.attrs["warnings"] if "clamp_distance_mm" in line]
    assert len(warned) == said
    assert abs(cycles["Y_p_GPa"].mean() / 2.5 - 1 - start_mm / 16.8) < 0.02
    assert not measure_cycles(force, clamp_distance_mm=16.8).attrs["warnings"]


def test_the_machines_compliance_is_taken_off(tmp_path: Path) -> None:
    """A failure means a soft machine makes a soft sheet: 5000 N/mm in series lower k by 12 %."""
    force, truth = recorded(tmp_path, replace(TEST, machine_stiffness_N_per_mm=5000.0))
    as_recorded = measure_cycles(force)
    corrected = measure_cycles(force, machine_stiffness_N_per_mm=5000.0)
    k = truth["k_N_per_mm"][0]
    assert as_recorded["k_N_per_mm"].mean() == pytest.approx(1 / (1 / k + 1 / 5000), rel=0.003)
    assert corrected["k_N_per_mm"].mean() == pytest.approx(k, rel=0.003)
    assert any("compliance is not corrected" in line for line in as_recorded.attrs["notes"])
    with pytest.raises(InputError, match="too small"):
        measure_cycles(force, machine_stiffness_N_per_mm=400.0)


def test_a_sheet_that_stiffens_scatters(tmp_path: Path) -> None:
    """A failure means the error of the mean hides that cycles differ."""
    force, truth = recorded(tmp_path, replace(TEST, growth=0.03))
    cycles = measure_cycles(force)
    np.testing.assert_allclose(cycles["Y_p_GPa"], truth["Y_p_GPa"], rtol=0.004)
    mean = summarise_modulus(cycles)["Y_p_GPa"]
    assert mean.scatter == pytest.approx(truth["Y_p_GPa"].std(), rel=0.05)
    assert mean.error == pytest.approx(mean.scatter / np.sqrt(5))


def test_one_cycle_has_an_error_and_no_scatter(tmp_path: Path) -> None:
    """A failure means a single cycle gives an error of 0, or NaN."""
    force, _ = recorded(tmp_path, replace(TEST, cycles=1))
    mean = summarise_modulus(measure_cycles(force))["Y_p_GPa"]
    assert mean.error > 0
    assert np.isnan(mean.scatter)
    assert np.isnan(mean.scatter)


def test_residual_distance_at_zero_force() -> None:
    """A failure means a permanent stretch between loading and unloading is not measured."""
    up, down = np.linspace(-0.02, 0.1, 600), np.linspace(0.1, -0.02, 600)
    position = np.tile(np.concatenate([up, down]), 3)
    load = np.tile(np.concatenate([600 * up, 60 / 0.09 * (down - 0.01)]), 3)
    record = pd.DataFrame({"time_s": np.arange(load.size) * 0.02, "crosshead_mm": position, "load_N": load})
    cycles = measure_cycles(_dataset(record))
    assert cycles["residual_mm"].mean() == pytest.approx(0.01, abs=5e-4)
    # Between the two lines over the whole travel, from −0.02 to 0.1 mm.
    area = np.trapezoid(600 * up - 60 / 0.09 * (up - 0.01), up)
    assert cycles["loop_mJ"].dropna().mean() == pytest.approx(area, rel=0.02)


# --- cycles or a pull ---------------------------------------------------------------------------------------


def test_cycles_are_told_from_a_pull(tmp_path: Path) -> None:
    """A failure means `track force` takes loading and unloading of an elastic sheet for sticks and slips."""
    force, _ = recorded(tmp_path, replace(TEST, friction_N=0.0, slack_mm=0.0001))
    with pytest.raises(InputError, match="push–pull cycles"):
        find_stick_slip(force)


def test_a_short_preload_or_holds_are_no_cycles() -> None:
    """Machines take up slack and wait: neither makes a pull a cycle."""
    time = np.arange(6000) * 0.02
    corners = np.interp(time, [0, 5, 10, 30, 60, 80, 120], [0, 0.05, 0, 0.5, 0.5, 1.2, 2.0])
    assert turning_points(corners).tolist() == [0, 5999]


def test_turning_points_of_noisy_cycles() -> None:
    """A failure means noise adds or moves turning points."""
    rng = np.random.default_rng(3)
    triangle = np.interp(np.arange(5001), np.arange(0, 5001, 500), [0, 1] * 5 + [0])
    found = turning_points(triangle + 0.01 * rng.standard_normal(5001))
    assert found.size == 11
    assert np.abs(found - np.arange(0, 5001, 500)).max() <= 15


def test_a_lacking_displacement_says_how_to_name_it() -> None:
    """A failure means that nobody knows what the column must be called."""
    bare = _dataset(cycles_record(TEST)).drop_vars("crosshead_mm")
    with pytest.raises(InputError, match="rename its column in the header: displacement, crosshead"):
        measure_cycles(bare)


def test_bad_input_is_refused_in_one_line(tmp_path: Path) -> None:
    """A failure means a traceback or a modulus from data that have none."""
    force, _ = recorded(tmp_path, TEST)
    bad = [
        (force.drop_vars("crosshead_mm"), {}, "a displacement"),
        (force.isel(time_s=slice(0, 300)), {}, "push–pull cycles"),
        (force.assign(load_N=-force["load_N"]), {}, "is tension negative"),
        (force, {"clamp_distance_mm": -1.0}, "clamp_distance_mm"),
        (force, {"machine_stiffness_N_per_mm": 0.0}, "machine_stiffness_N_per_mm"),
        (force, {"settings": ModulusSettings(least_samples=10_000)}, "none"),
    ]
    for data, options, message in bad:
        with pytest.raises(InputError, match=message) as caught:
            measure_cycles(data, **options)
        assert "\n" not in str(caught.value)


def test_the_strip_is_the_publications() -> None:
    """ε 0.1, L 16.8, W 45 mm."""
    assert (PUBLISHED_SHEET.thickness_mm, PUBLISHED_SHEET.length_mm, PUBLISHED_SHEET.width_mm) == (
        0.1,
        16.8,
        45.0,
    )


@pytest.mark.parametrize("clamp_distance_mm", [None, PUBLISHED_SHEET.length_mm])
def test_errors_of_the_size_are_those_of_a_sheet_of_another_size(clamp_distance_mm: float | None) -> None:
    """A failure means a modulus whose error misses that of a thickness measured to 2 %."""
    force, errors = _dataset(cycles_record(TEST)), {"thickness_mm": 0.002, "width_mm": 0.3, "length_mm": 0.1}

    def means(sheet: Sample, **sheet_err: float) -> dict[str, MeanValue]:
        cycles = measure_cycles(force, sheet=sheet, clamp_distance_mm=clamp_distance_mm)
        return summarise_modulus(cycles, sheet_err)

    usual = means(PUBLISHED_SHEET)
    for name in ("Y_p_GPa", "Y_slope_GPa"):
        assert math.isnan(usual[name].systematic_error)
        for size, error in errors.items():
            other = means(replace(PUBLISHED_SHEET, **{size: getattr(PUBLISHED_SHEET, size) + error}))
            shift = abs(other[name].value - usual[name].value)
            stated = means(PUBLISHED_SHEET, **{size: error})[name].systematic_error
            assert (0.0 if math.isnan(stated) else stated) == pytest.approx(shift, rel=0.03, abs=1e-9)


def test_push_and_pull_of_blocks_that_only_slide() -> None:
    """Jenkins element (k, f_y) at amplitude Δ: peak f_y, tangent k, 4 f_y (Δ − f_y/k) a cycle, no drift."""
    k, limit, amplitude = 1000.0, 8.0, 0.05
    block = CyclesTest(
        modulus_GPa=1e-9, stretch_mm=amplitude, slack_mm=amplitude, friction_N=limit, friction_N_per_mm=k
    )
    means = summarise_modulus(measure_cycles(_dataset(cycles_record(block))))
    assert means["F_max_N"].value == pytest.approx(limit, rel=0.01)
    assert means["K_tangent_N_per_mm"].value == pytest.approx(k, rel=0.02)
    assert means["loop_mJ"].value == pytest.approx(4 * limit * (amplitude - limit / k), rel=0.002)
    assert means["loop_mJ"].value != pytest.approx(4 * limit * amplitude, rel=0.1)
    assert abs(means["drift_N"].value) < 0.05
    worn = measure_cycles(_dataset(cycles_record(replace(TEST, growth=-0.02))))
    peaks = worn["F_max_N"].to_numpy()
    assert worn["drift_N"].to_numpy()[1:] == pytest.approx(np.diff(peaks))
    assert (worn["drift_N"].to_numpy()[1:] < -0.5).all()
