"""The pull and x(n, t): events, force and separation against the paper's equations, creep and jumps."""

from dataclasses import replace

import numpy as np
import pytest

from vision.experiment import Experiment, simulate_pull
from vision.experiment.mechanics import comb_at_rest, sheet_motion
from vision.experiment.settings import Clocks, Mechanics, Sheets
from vision.models import equations as eq
from vision.sample import Sample

REGULAR = Mechanics(peak_scatter=0.0, period_jitter=0.0)


def test_every_event_is_exactly_the_model():
    """A failure means truth.nc would not be the truth: F_p is Eq. 1 at d_p; dF is A times Eq. 2's total,
    and K that of M_eff sheets, at d_v."""
    events = simulate_pull(REGULAR, seed=0).events()
    assert events["F_p_N"].to_numpy() == pytest.approx(eq.traction(events["d_p_mm"], mu=0.89), rel=1e-12)
    drop = eq.stick_slip_amplitude(events["d_v_mm"], mu=0.89)
    assert events["dF_N"].to_numpy() == pytest.approx(drop, rel=1e-12)
    stiffness = eq.assembly_stiffness(events["d_v_mm"], mu=0.89, n_hat_N=0.57, modulus_GPa=3.8)
    assert events["K_N_per_mm"].to_numpy() == pytest.approx(stiffness, rel=1e-12)
    length = 1000 * events["dF_N"] / events["K_N_per_mm"]
    assert events["stick_length_um"].to_numpy() == pytest.approx(length.to_numpy(), rel=1e-6)
    assert 440 <= len(events) <= 700


def test_force_curve_passes_through_its_events_with_the_stated_stiffness():
    """F(t) must hit F_v and F_p at their times, and have slope K in the middle of the stick."""
    pull = simulate_pull(Mechanics(), seed=3)
    events = pull.events()
    assert pull.force_N(events["t_v_s"].to_numpy()) == pytest.approx(events["F_v_N"].to_numpy(), rel=1e-9)
    assert pull.force_N(events["t_p_s"].to_numpy()) == pytest.approx(events["F_p_N"].to_numpy(), rel=1e-9)
    middle = (events["t_v_s"] + events["t_p_s"]).to_numpy() / 2
    dt = 1e-3
    rise = pull.force_N(middle + dt) - pull.force_N(middle - dt)
    slope = rise / (pull.separation_mm(middle + dt) - pull.separation_mm(middle - dt))
    assert slope == pytest.approx(events["K_N_per_mm"].to_numpy(), rel=1e-6)


def test_the_pull_begins_with_an_elastic_loading_from_zero():
    """As in the paper's first figure: no force at d0, a rise of tens of micrometres, then the first slip."""
    pull = simulate_pull(REGULAR, seed=0)
    assert pull.force_N(np.array([-1.0, 0.0])).tolist() == [0, 0]
    loading_um = 1000 * (pull.d_end_mm[0] - pull.d_start_mm[0])
    assert 30 < loading_um < 80
    assert pull.events()["t_v_s"].iloc[0] == pytest.approx(pull.slip_s[0] + 0.001)


def test_scatter_and_jitter_have_the_asked_size():
    """A failure means a user's 3 % is not 3 %."""
    m = Mechanics(peak_scatter=0.03, period_jitter=0.1)
    events = simulate_pull(m, seed=1).events()
    peak = events["F_p_N"] / eq.traction(events["d_p_mm"], mu=0.89) - 1
    drop = events["dF_N"] / eq.stick_slip_amplitude(events["d_v_mm"], mu=0.89) - 1
    assert np.std(peak) == pytest.approx(0.03, rel=0.15)
    assert np.std(drop) == pytest.approx(0.1, rel=0.15)


def test_two_slopes_in_fast_pulls():
    """The early part is steeper by the asked ratio, the later one has slope K."""
    m = replace(REGULAR, speed_mm_min=10.0, early_stiffness_ratio=1.8)
    pull = simulate_pull(m, seed=0)
    one = pull.events().iloc[20]
    t = one["t_v_s"] + (one["t_p_s"] - one["t_v_s"]) * np.array([0.1, 0.2, 0.6, 0.8])
    f, d = pull.force_N(t), pull.separation_mm(t)
    slopes = np.diff(f)[[0, 2]] / np.diff(d)[[0, 2]]
    assert slopes == pytest.approx([1.8 * one["K_N_per_mm"], one["K_N_per_mm"]], rel=1e-6)


def test_offset_and_build_up_move_the_peaks():
    """The offset adds to every peak; with build-up the first peaks lie below Eq. 1 and grow towards it."""
    raised = simulate_pull(replace(REGULAR, t0_N=5.0), seed=0).events()
    assert (raised["F_p_N"] - eq.traction(raised["d_p_mm"], mu=0.89)).to_numpy() == pytest.approx(5.0)
    built = simulate_pull(replace(REGULAR, buildup_mm=0.2), seed=0).events()
    share = built["F_p_N"] / eq.traction(built["d_p_mm"], mu=0.89)
    assert share.iloc[0] < 0.5
    assert share.iloc[-1] == pytest.approx(1.0, abs=1e-6)


def test_beyond_the_last_stiff_sheet_the_pull_goes_on():
    """d-hat > 1: M_eff is 0, the stiffness used that of one sheet, and nothing is NaN."""
    pull = simulate_pull(replace(REGULAR, d0_mm=19.0, d_end_mm=20.0), seed=0)
    events = pull.events()
    assert (events["M_eff"].iloc[-10:] == 0).all()
    assert np.isfinite(events.to_numpy()).all()


def test_another_sample_has_its_own_forces():
    """M, ε, W, L and T* all reach the forces and the stiffness: fewer and stiffer sheets."""
    sample = Sample(sheets_per_block=20, thickness_mm=0.15, width_mm=30.0, length_mm=40.0, t_star_N=0.004)
    events = simulate_pull(REGULAR, seed=0, sample=sample).events()
    peaks = eq.traction(events["d_p_mm"], mu=0.89, sample=sample)
    assert events["F_p_N"].to_numpy() == pytest.approx(peaks, rel=1e-12)
    one_sheet = 3.8e3 * 0.15 * 30 / 40
    stiffness = np.maximum(events["M_eff"], 1) * one_sheet
    assert events["K_N_per_mm"].to_numpy() == pytest.approx(stiffness.to_numpy(), rel=1e-12)
    assert events["M_eff"].max() < 20


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
