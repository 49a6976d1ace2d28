"""The pull: events, force and separation against the paper's equations."""

from dataclasses import replace

import numpy as np
import pytest

from vision.experiment import Mechanics, simulate_pull
from vision.models import equations as eq
from vision.sample import Sample

REGULAR = Mechanics(peak_scatter=0.0, period_jitter=0.0)


@pytest.mark.parametrize(
    ("d", "traction", "amplitude", "stiffness", "length_um"),
    [
        (13, 236.6, 90.3, 4237, 21.3),
        (13.5, 175.6, 67.0, 4059, 16.5),
        (13.7, 156.8, 59.9, 3986, 15.0),
        (15, 81.2, 31.0, 3473, 8.9),
        (17.1, 34.9, 13.3, 2423, 5.5),
        (18, 25.8, 9.8, 1795, 5.5),
    ],
)
def test_events_follow_the_reference_table(d, traction, amplitude, stiffness, length_um):
    """Without scatter the first event of a pull begun at d (the loading undone) has the table's numbers."""
    m = replace(REGULAR, d0_mm=d - 0.3, d_end_mm=d + 0.1)
    events = simulate_pull(m, seed=0).events().set_index("d_v_mm")
    at = {name: np.interp(d, events.index, events[name]) for name in events.columns}
    peak = np.interp(d, events["d_p_mm"], events["F_p_N"])
    assert peak == pytest.approx(traction, rel=2e-3)
    assert at["dF_N"] == pytest.approx(amplitude, rel=5e-3)
    assert at["K_N_per_mm"] == pytest.approx(stiffness, rel=1e-3)
    assert at["stick_length_um"] == pytest.approx(length_um, rel=1e-2)


def test_every_event_is_exactly_the_model():
    """A failure means truth.nc would not be the truth: F_p is Eq. 1 at d_p, dF is A times Eq. 2's total
    at d_v."""
    events = simulate_pull(REGULAR, seed=0).events()
    assert events["F_p_N"].to_numpy() == pytest.approx(eq.traction(events["d_p_mm"], mu=0.89), rel=1e-12)
    drop = eq.stick_slip_amplitude(events["d_v_mm"], mu=0.89)
    assert events["dF_N"].to_numpy() == pytest.approx(drop, rel=1e-12)
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
