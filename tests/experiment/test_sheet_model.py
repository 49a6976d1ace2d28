"""The pull resolved by sheets: against Eq. 1, Eq. 2, the spring and block, and its own energy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vision.errors import InputError
from vision.experiment.sheet_model import (
    SheetPull,
    equation_normal_N,
    loads_at,
    normal_of_loads_N,
    pull_sheets,
    slip_share,
    threshold_loads_N,
)
from vision.models import equations
from vision.models.spring_block import SpringBlock, stick_slip
from vision.sample import Sample

PULL = SheetPull(d_end_mm=13.08)


@pytest.mark.parametrize(("d", "share"), [(13.0, 0.934), (18.0, 0.944)])
def test_sum_over_the_sheets_against_eq_1(d: float, share: float) -> None:
    """Σ over n = 1 … 25 is 0.934 and 0.944 of Eq. 1, at n − ½ equal to 5e-6: the continuum limit's error."""
    traction = float(equations.traction(d, mu=0.89))
    assert round(2 * threshold_loads_N(PULL, d).sum() / traction, 3) == share
    middles = replace(PULL, positions="middles")
    assert 2 * threshold_loads_N(middles, d).sum() == pytest.approx(traction, rel=5e-6)


def test_normal_forces_are_eq_2() -> None:
    """A failure means that the sheets' N is not the publication's."""
    expected = equations.normal_force(np.arange(1, 26), 14.0, mu=0.89)
    np.testing.assert_allclose(equation_normal_N(PULL, 14.0), expected, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("positions", ["edges", "middles"])
@pytest.mark.parametrize("d", [13.0, 15.0, 18.0])
def test_normal_force_of_loads_at_threshold_is_eq_2(positions: str, d: float) -> None:
    """A failure means the normal force from actual loads is another model than Eq. 2."""
    pull = replace(PULL, positions=positions)
    found = normal_of_loads_N(pull, threshold_loads_N(pull, d), d)
    np.testing.assert_allclose(found, equation_normal_N(pull, d), rtol=1e-12, atol=1e-15)
    # Close to the law it comes from, dN/dn = −(2εn/d) T, which the discrete weights must not bend.
    half = normal_of_loads_N(pull, 0.5 * threshold_loads_N(pull, d), d)
    np.testing.assert_allclose(half, 0.5 * found)


def test_without_amplification_there_are_2m_adhering_sheets() -> None:
    """α → 0: the force is 2 M T*."""
    far = SheetPull(d0_mm=1e7, d_end_mm=1e7 + 0.01, longest_step_um=1.0)
    for mode in ("equation", "loads"):
        assert pull_sheets(replace(far, normal_force=mode))["force_N"].values[-1] == pytest.approx(
            2 * 25 * 0.003, rel=1e-4
        )


def test_one_sheet_is_a_spring_and_a_block() -> None:
    """A failure means a sheet sticks or slips otherwise than the block under the load of both faces."""
    sample = Sample(sheets_per_block=1, thickness_mm=60.0, width_mm=0.075)  # k = 300 N/mm, α = 8.2
    pull = SheetPull(sample=sample, positions="middles", d_end_mm=13.1, speed_mm_min=2.0)
    result = pull_sheets(pull)
    slips = np.flatnonzero(result["slipped"].values[:, 0])[5:-1]
    d = result["d_mm"].values[slips]
    load = 2 * np.array([equation_normal_N(pull, at)[0] for at in d])
    cycles = [
        stick_slip(
            SpringBlock(mass_kg=1e-6, stiffness_N_per_mm=300.0, load_N=w, mu_static=0.89, mu_dynamic=0.72),
            2 / 60,
        )
        for w in load
    ]
    before, after = result["load_N"].values[slips - 1, 0], result["load_N"].values[slips, 0]
    adhesion = 0.003
    np.testing.assert_allclose(before, 0.89 * load + adhesion, rtol=1e-8)
    lowest = np.array([float(cycle.lowest_elongation_mm) for cycle in cycles])
    np.testing.assert_allclose(after, 300 * lowest + adhesion, rtol=1e-8)
    drop = np.array([float(cycle.force_drop_N) for cycle in cycles])
    np.testing.assert_allclose(before - after, drop, rtol=1e-8)
    stick = np.diff(result["time_s"].values[slips])
    expected = np.array([float(cycle.stick_time_s) for cycle in cycles])[1:]
    np.testing.assert_allclose(stick, expected, rtol=5e-3)  # N falls a little while it sticks


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"normal_force": "loads"},
        {"slips": "together"},
        {"machine_N_per_mm": 2e4},
        {"slips": "together", "machine_N_per_mm": 2e4},
    ],
)
def test_energy_is_balanced(change: dict[str, object]) -> None:
    """Work = elastic energy + what friction takes, and friction only takes."""
    result = pull_sheets(replace(PULL, **change))
    work, elastic, lost = (result[f"{name}_mJ"].values for name in ("work", "elastic", "dissipated"))
    np.testing.assert_allclose(work, elastic + lost, rtol=1e-9, atol=1e-12)
    assert work[-1] > 1
    assert (np.diff(lost) >= -1e-9).all()


def test_what_slips_take_is_friction_times_distance() -> None:
    """A failure means a slip does not go about the level of dynamic friction."""
    result = pull_sheets(replace(PULL, relaxed=False))
    load, slipped = result["load_N"].values, result["slipped"].values
    step, sheet = np.nonzero(slipped)
    before, after = load[step - 1, sheet], load[step, sheet]
    number = result["n"].values[sheet]
    normal = np.stack([equation_normal_N(PULL, d) for d in result["d_mm"].values[step]])
    normal = normal[np.arange(step.size), number - 1]
    friction, distance = (2 * 0.89 - 0.34) * normal + 0.003, (before - after) / 300
    np.testing.assert_allclose((before**2 - after**2) / 600, friction * distance, rtol=1e-7)
    lost = np.diff(result["dissipated_mJ"].values)[np.unique(step) - 1]
    taken = np.bincount(step, weights=friction * distance)[np.unique(step)]
    np.testing.assert_allclose(lost, taken, rtol=1e-6)


@pytest.mark.parametrize("mode", ["equation", "loads"])
def test_no_load_exceeds_its_threshold(mode: str) -> None:
    """A failure means a sheet goes on sticking beyond what friction holds."""
    pull = replace(PULL, normal_force=mode)
    result = pull_sheets(pull)
    right = result["load_N"].values[:, 25:]
    for d, load in list(zip(result["d_mm"].values, right, strict=True))[::20]:
        normal = equation_normal_N(pull, d) if mode == "equation" else normal_of_loads_N(pull, load, d)
        assert (load <= (2 * 0.89 * normal + 0.003) * (1 + 1e-6)).all()
    assert (right >= 0).all()


def test_sides_are_mirror_images_unless_the_sheets_differ() -> None:
    """A failure means left and right, or centre and outside, are mixed up."""
    result = pull_sheets(PULL)
    load = result["load_N"].values
    np.testing.assert_array_equal(load, load[:, ::-1])
    assert result["n"].values.tolist() == [*range(25, 0, -1), *range(1, 26)]
    assert result["side"].values.tolist() == [-1] * 25 + [1] * 25
    assert (np.diff(load[-1, 25:]) < 1.5).all()
    assert load[-1, 25] > 10 * load[-1, 45]
    factor = np.ones(50)
    factor[25] = 2.0  # n = 1 on the right
    strong = pull_sheets(replace(PULL, threshold_factor=tuple(factor)))["load_N"].values
    assert strong[:, 25].max() > 1.5 * strong[:, 24].max()


def test_sheets_that_know_of_each_other_slip_together() -> None:
    """With N from the actual loads an outer slip frees those inside; with Eq. 2 only mirror images meet."""
    alone, coupled = (pull_sheets(replace(PULL, normal_force=mode)) for mode in ("equation", "loads"))
    together = [run["slipped"].values.sum(axis=1).max() for run in (alone, coupled)]
    assert together[0] <= 4
    assert together[1] >= 16


UNEQUAL = tuple((1 + 0.02 * np.random.default_rng(0).standard_normal(50)).tolist())


def test_sheets_that_slip_alone_stay_below_eq_1() -> None:
    """Never all at their thresholds, sheets carry 1 − A/2μ of Eq. 1 on average.

    Where N follows the loads, e^α makes of that Eq. 1 at μ − A/2: a fifth of the force. A failure means that
    the low force is an error of the model, not what Coulomb friction gives.
    """
    pull = SheetPull(d_end_mm=13.2, positions="middles", threshold_factor=UNEQUAL)
    shares = []
    for mode in ("equation", "loads"):
        result = pull_sheets(replace(pull, normal_force=mode))
        late = result["d_mm"].values > 13.1
        d = result["d_mm"].values[late]
        shares.append(float(np.mean(result["force_N"].values[late] / equations.traction(d, mu=0.89))))
    assert shares[0] == pytest.approx(1 - 0.34 / (2 * 0.89), abs=0.02)
    lower = equations.traction(13.2, mu=0.72) / equations.traction(13.2, mu=0.89)
    assert shares[1] == pytest.approx(float(lower), abs=0.05)


def test_a_machine_that_springs_back_makes_larger_slips_but_no_larger_force() -> None:
    """A failure means that the machine's spring explains the force of Eq. 1, or couples nothing."""
    pull = SheetPull(d_end_mm=13.15, positions="middles", threshold_factor=UNEQUAL)
    stiff, soft = (pull_sheets(replace(pull, machine_N_per_mm=k)) for k in (np.inf, 5e3))
    together = [run["slipped"].values.sum(axis=1).max() for run in (stiff, soft)]
    assert together[0] <= 2
    assert together[1] > 8
    assert (np.diff(soft["time_s"].values) >= 0).all()
    peaks = [np.max(r["force_N"] / equations.traction(r["d_mm"], mu=0.89)) for r in (stiff, soft)]
    assert max(peaks) < 0.95


def test_sheets_that_hold_each_other_give_eq_1_and_the_drops() -> None:
    """Peaks are Eq. 1, drops A𝒩, sticks 2AN(1)/k, and sheet n sticks for N(n)/N(1) of each."""
    pull = replace(PULL, d_end_mm=13.15, positions="middles", slips="together")
    result = pull_sheets(pull)
    after = np.flatnonzero(result["slipped"].values.any(axis=1))[1:]
    force, d = result["force_N"].values, result["d_mm"].values
    np.testing.assert_allclose(force[after - 1], equations.traction(d[after], mu=0.89), rtol=1e-4)
    drops = equations.stick_slip_amplitude(d[after], mu=0.89)
    np.testing.assert_allclose(force[after - 1] - force[after], drops, rtol=1e-4)
    first, last = d[after[:-1]], d[after[1:] - 1]
    innermost = np.array([equation_normal_N(pull, at)[0] for at in first])
    falls = 2 * 0.89 * innermost * 2 * 0.1 * 0.89 * 25**2 / first**2  # of the threshold with d, N/mm
    np.testing.assert_allclose(last - first, 2 * 0.34 * innermost / (300 + falls), rtol=0.01)
    share = slip_share(result, first, last).values[0, 25:]
    normal = equation_normal_N(pull, first[0])
    np.testing.assert_allclose(share, 1 - normal / normal[0], atol=0.02)
    alone = pull_sheets(replace(pull, slips="alone"))
    assert np.max(alone["force_N"] / equations.traction(alone["d_mm"], mu=0.89)) < 0.95


def test_inner_sheets_stick_and_outer_ones_slide() -> None:
    """The shell: over less than their stick inner sheets do not slip, outer ones do all the way."""
    result = pull_sheets(replace(PULL, relaxed=False))
    share = slip_share(result, 13.0, 13.01).values[0]
    right = share[25:]
    np.testing.assert_allclose(right[:5], 0, atol=1e-9)
    assert (right[20:] > 0.95).all()


def test_loads_between_events() -> None:
    """A failure means per-sheet loads are read at another d than asked for."""
    result = pull_sheets(PULL)
    k = int(np.flatnonzero(result["slipped"].values.any(axis=1))[3])
    d = result["d_mm"].values
    np.testing.assert_allclose(loads_at(result, d[k]), result["load_N"].values[[k]])
    middle = 0.5 * (d[k] + d[k + 1])
    mean = 0.5 * (result["load_N"].values[k] + result["load_N"].values[k + 1])
    np.testing.assert_allclose(loads_at(result, middle)[0], mean)
    with pytest.raises(InputError, match="d_mm"):
        loads_at(result, 12.9)


def test_a_finer_step_changes_nothing() -> None:
    """A failure means slips depend on how often N is computed."""
    coarse = pull_sheets(PULL)
    fine = pull_sheets(replace(PULL, longest_step_um=0.1))
    at = np.linspace(13.0, 13.08, 400)
    np.testing.assert_allclose(loads_at(coarse, at)[:, 25:35], loads_at(fine, at)[:, 25:35], rtol=1e-4)
    assert coarse["slipped"].values.sum() == fine["slipped"].values.sum()


@pytest.mark.parametrize(
    "wrong",
    [
        {"mu": 0.0},
        {"d_end_mm": 12.0},
        {"amplitude": 2.0},
        {"normal_force": "guess"},
        {"positions": "corners"},
        {"slips": "never"},
        {"machine_N_per_mm": 0.0},
        {"threshold_factor": (1.0, 2.0)},
        {"speed_mm_min": np.nan},
    ],
)
def test_meaningless_pulls_are_refused(wrong: dict[str, object]) -> None:
    """A failure means NaN, or a loop without end."""
    with pytest.raises(InputError, match=f"`{next(iter(wrong))}`"):
        replace(PULL, **wrong)


def test_sheets_on_the_verge_of_sliding_do_not_stop_the_pull() -> None:
    """A sheet whose own load decided whether it sticks or slides once kept the pull at one d for ever."""
    result = pull_sheets(SheetPull(d0_mm=14.0, d_end_mm=14.15, normal_force="loads"))
    assert result["d_mm"].values[-1] == pytest.approx(14.15)
    assert result.sizes["step"] < 5000


def test_sheets_that_grip_above_their_threshold_do_not_stop_the_pull() -> None:
    """Loads that start above what the actual N holds once left no time for the first slip."""
    result = pull_sheets(replace(PULL, normal_force="loads", relaxed=False))
    assert result["d_mm"].values[-1] == pytest.approx(13.08)


def test_slips_together_need_eq_2() -> None:
    """A failure means a combination that is not worked out runs all the same."""
    with pytest.raises(InputError, match="`slips`"):
        replace(PULL, slips="together", normal_force="loads")
