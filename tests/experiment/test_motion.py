"""x(n, t): creep inwards, jump outwards, the sigma profile, exact exposure averages."""

from dataclasses import replace

import numpy as np
import pytest

from vision.experiment import Clocks, Experiment, Mechanics, Sheets, simulate_pull
from vision.experiment.motion import comb_at_rest, sheet_motion

STILL = Sheets(spread_per_mm=0.0)


def moved(experiment):
    pull, comb = simulate_pull(experiment.mechanics, seed=experiment.seed), comb_at_rest(experiment)
    return pull, comb, sheet_motion(experiment, pull, comb)


def test_sigma_over_stick_length_is_the_paper_profile():
    """RMS over a stick: 0.5 of its length outermost, 0.1 at M_eff. Sampled from the motion itself."""
    pull, comb, motion = moved(Experiment(sheets=STILL))
    k = 40
    t = np.linspace(pull.start_s[k], pull.end_s[k], 4001)
    x_um = 10 * motion.mean_px((t[:-1] + 1e-9), t[1:])
    ratio = x_um.std(axis=0) / (1000 * (pull.d_end_mm[k] - pull.d_start_mm[k]))
    assert ratio == pytest.approx(motion.ratio[k], abs=2e-4)
    assert ratio[[0, -1]] == pytest.approx([0.5, 0.5], abs=1e-3)
    at_m_eff = np.interp(pull.effective_sheets[k], comb.n[25:], ratio[25:])
    assert at_m_eff == pytest.approx(0.1, abs=0.005)


def test_sheets_creep_inwards_and_jump_outwards_mirrored():
    """A failure means the direction of motion is wrong on one side."""
    pull, comb, motion = moved(Experiment(sheets=replace(STILL, pitch_jitter=0.0)))
    start, end = pull.start_s[10] + 1e-3, pull.end_s[10] - 1e-3
    before, after, jumped = motion.mean_px(
        np.array([start, end, pull.start_s[11] + 1e-3]),
        np.array([start, end, pull.start_s[11] + 1e-3]) + 1e-6,
    )
    outward = comb.side
    assert (outward * (after - before) < 0).all()
    assert (outward * (jumped - after) > 0).all()
    assert after == pytest.approx(-after[::-1])


def test_exposure_average_is_the_mean_of_short_exposures():
    """Blur during a slip: the closed form against 20 000 short exposures, with delays between sheets."""
    _, _, motion = moved(Experiment(sheets=replace(STILL, slip_delay_s=0.1)))
    edges = np.linspace(30.0, 34.0, 20_001)
    fine = motion.mean_px(edges[:-1], edges[1:]).mean(axis=0)
    assert motion.mean_px(np.array([30.0]), np.array([34.0]))[0] == pytest.approx(fine, abs=1e-8)


def test_sheets_rest_before_the_pull_and_after_it():
    """A video may start before the machine and go on after it."""
    e = Experiment(mechanics=Mechanics(d_end_mm=13.5), clocks=Clocks(offset_s=10.0))
    _, _, motion = moved(e)
    t = np.array([-10.0, -1.0, 30.5, 60.0])
    x = motion.mean_px(t, t + 0.01)
    assert x[0] == pytest.approx(x[1])
    assert x[2] == pytest.approx(x[3], abs=1e-9)


def test_delays_spread_the_slips_of_single_sheets():
    """With delays the sheets jump one after another; without, all within a millisecond."""
    for delay, least in ((0.0, 50), (0.2, 5)):
        pull, _, motion = moved(Experiment(sheets=replace(STILL, slip_delay_s=delay)))
        t = np.array([pull.end_s[20] + 0.02])
        after = motion.mean_px(t, t + 1e-6)[0]
        jumped = np.abs(after - motion.outer_px[21]) < 0.3 * np.abs(motion.sweep_px[21]) + 1e-9
        assert (jumped.sum() >= least) if delay == 0 else (jumped.sum() < 25)


@pytest.mark.parametrize(
    ("sheets", "n", "side"),
    [
        (Sheets(count=4), [2, 1, 1, 2], [-1, -1, 1, 1]),
        (Sheets(count=5), [2, 1, 1, 2, 3], [-1, -1, 1, 1, 1]),
        (Sheets(count=3, side="right"), [1, 2, 3], [1, 1, 1]),
        (Sheets(count=3, side="left"), [3, 2, 1], [-1, -1, -1]),
    ],
)
def test_numbering(sheets, n, side):
    """n counts from the axis outwards from 1, the middle one of an odd comb on the right."""
    comb = comb_at_rest(Experiment(sheets=sheets))
    assert comb.n.tolist() == n
    assert comb.side.tolist() == side
    assert (np.diff(comb.rest_px) > 0).all()
    if len(n) == 5:
        assert comb.rank.tolist() == [2, 1, 0, 1, 2]


def test_fifty_a_side_have_the_same_outer_sheet():
    """With 50 ridges a side the profile stretches: rank over per_side counts, not n."""
    e = Experiment(sheets=Sheets(count=100, per_side=50, pitch_px=15))
    _, _, motion = moved(e)
    assert motion.ratio[5][[0, -1]] == pytest.approx([0.5, 0.5])
