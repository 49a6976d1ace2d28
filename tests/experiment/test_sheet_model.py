"""The pull resolved by sheets: against Eq. 1, Eq. 2, and the spring and block."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vision.experiment.mechanics import normal_N, pull_sheets
from vision.experiment.settings import Mechanics
from vision.models import equations
from vision.models.equations import SpringBlock
from vision.sample import PUBLISHED, Sample

PULL = Mechanics(d_end_mm=13.08)


@pytest.mark.parametrize("d", [13.0, 18.0])
def test_sum_over_the_sheets_is_eq_1(d: float) -> None:
    """At their thresholds 2M sheets carry Eq. 1, to 5e-6: the continuum limit's error."""
    loads = 2 * PULL.mu * normal_N(d, PULL) + PUBLISHED.t_star_N
    assert 2 * loads.sum() == pytest.approx(float(equations.traction(d, mu=0.89)), rel=5e-6)


def test_one_sheet_is_a_spring_and_a_block() -> None:
    """A failure means a sheet sticks or slips otherwise than the block under the load of both faces."""
    sample = Sample(sheets_per_block=1, thickness_mm=60.0, width_mm=0.075)  # k = 300 N/mm, α = 8.2
    pull = Mechanics(d_end_mm=13.1, speed_mm_min=2.0)
    result = pull_sheets(pull, sample)
    slips = np.flatnonzero(result["slipped"].values)[5:-1]
    d = result["d_mm"].values[slips]
    load = 2 * np.array([normal_N(at, pull, sample)[0] for at in d])
    made_of = {"mass_kg": 1e-6, "stiffness_N_per_mm": 300.0, "mu_static": 0.89, "mu_dynamic": 0.72}
    blocks = [SpringBlock(load_N=w, **made_of) for w in load]
    before, after = result["load_N"].values[slips - 1, 0], result["load_N"].values[slips, 0]
    adhesion = 0.003
    np.testing.assert_allclose(before, 0.89 * load + adhesion, rtol=1e-8)
    lowest = np.array([block.lowest_elongation_mm for block in blocks])
    np.testing.assert_allclose(after, 300 * lowest + adhesion, rtol=1e-8)
    drop = np.array([block.force_drop_N for block in blocks])
    np.testing.assert_allclose(before - after, drop, rtol=1e-8)
    stick = np.diff(result["time_s"].values[slips])
    expected = np.array([float(block.stick_time_s(2 / 60)) for block in blocks])[1:]
    np.testing.assert_allclose(stick, expected, rtol=5e-3)  # N falls a little while it sticks


def test_no_load_exceeds_its_threshold() -> None:
    """A failure means a sheet goes on sticking beyond what friction holds."""
    result = pull_sheets(PULL)
    right = result["load_N"].values[:, 25:]
    for d, load in zip(result["d_mm"].values, right, strict=True):
        assert (load <= (2 * 0.89 * normal_N(d, PULL) + 0.003) * (1 + 1e-6)).all()
    assert (right >= 0).all()


def test_sides_are_mirror_images_unless_the_sheets_differ() -> None:
    """A failure means left and right, or centre and outside, are mixed up."""
    result = pull_sheets(PULL)
    load = result["load_N"].values
    np.testing.assert_array_equal(load, load[:, ::-1])
    assert result["n"].values.tolist() == [*range(25, 0, -1), *range(1, 26)]
    assert result["side"].values.tolist() == [-1] * 25 + [1] * 25
    assert load[-1, 25] > 10 * load[-1, 45]
    factor = np.ones(50)
    factor[25] = 2.0  # n = 1 on the right
    strong = pull_sheets(PULL, threshold_factor=factor)["load_N"].values
    assert strong[:, 25].max() > 1.5 * strong[:, 24].max()


def test_sheets_that_hold_each_other_give_eq_1_and_the_drops() -> None:
    """Peaks are Eq. 1, drops A𝒩, sticks 2AN(1)/k, and sheet n sticks for N(n)/N(1) of each."""
    pull = replace(PULL, d_end_mm=13.15)
    result = pull_sheets(pull)
    after = np.flatnonzero(result["slipped"].values)[1:]
    force, d = result["force_N"].values, result["d_mm"].values
    np.testing.assert_allclose(force[after - 1], equations.traction(d[after], mu=0.89), rtol=1e-4)
    drops = equations.stick_slip_amplitude(d[after], mu=0.89)
    np.testing.assert_allclose(force[after - 1] - force[after], drops, rtol=1e-4)
    first, last = d[after[:-1]], d[after[1:] - 1]
    innermost = np.array([normal_N(at, pull)[0] for at in first])
    falls = 2 * 0.89 * innermost * 2 * 0.1 * 0.89 * 25**2 / first**2  # of the threshold with d, N/mm
    np.testing.assert_allclose(last - first, 2 * 0.34 * innermost / (300 + falls), rtol=0.01)
    load = result["load_N"].values[:, 25:]
    gained = load[after[1] - 1] - load[after[0]]
    crept = 1 - gained / (300 * (last[0] - first[0]))
    normal = normal_N(first[0], pull)
    np.testing.assert_allclose(crept, 1 - normal / normal[0], atol=0.02)


def test_a_finer_step_changes_nothing() -> None:
    """A failure means slips depend on how often N is computed."""
    coarse, fine = pull_sheets(PULL), pull_sheets(PULL, longest_step_um=0.1)
    slips = [np.flatnonzero(run["slipped"].values) for run in (coarse, fine)]
    assert slips[0].size == slips[1].size > 1
    at = [run["d_mm"].values[found] for run, found in zip((coarse, fine), slips, strict=True)]
    np.testing.assert_allclose(at[0], at[1], rtol=1e-7)
