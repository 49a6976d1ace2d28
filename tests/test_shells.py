"""Sizes of stiff shells against made tracks whose shells are known, and the tables of sheets and shells."""

import numpy as np
import pandas as pd
import pytest

from tests.scenes.creeping import profile
from tests.scenes.shells import ideal, measured, scores, stage, true_sizes
from vision.errors import InputError
from vision.shells import classify_sheets, classify_shells, deformation_table, isotonic

# Stick length (um), frames a stick and M_eff along a test: early, middle, late, and late at 5 mm/min.
STAGES = [(27, 100, (12, 14.5)), (12.6, 45, (7, 10)), (7.7, 27, (3, 6)), (12.6, 9, (7, 10))]
# σ_x/Λ_st at n that crosses 0.1 at b
SHAPES = {
    "power 1.5": lambda n, b: 0.1 * (n / b) ** 1.5,
    "power 3": lambda n, b: 0.1 * (n / b) ** 3,
    "flat core, straight rise": lambda n, b: 0.02 + np.maximum(0.08 + 0.03 * (n - b), 0),
    "step": lambda n, b: np.where(n < b, 0.04, 0.3),
    "two steps": lambda n, b: np.where(n < b, 0.05, np.where(n < b + 5, 0.18, 0.45)),
    "sigmoid": lambda n, b: 0.5 / (1 + 4 * np.exp((b - n) / 2)),
    "levelling off": lambda n, b: 0.4 * np.maximum(-np.expm1((b - n - 2.3) / 8), 0),
}


@pytest.mark.thorough
@pytest.mark.parametrize("rho", [0.0, 0.5])
@pytest.mark.parametrize("noise", [0.02, 0.05])
@pytest.mark.parametrize("where", STAGES)
def test_shell_within_one_sheet(where, noise, rho):
    """A failure means that more than a tenth of the shells are off by over one sheet, or their intervals."""
    made, motion = stage(*where, noise_px=noise, rho=rho)
    shells, truth = classify_shells(motion), true_sizes(made)
    assert np.mean(np.abs(shells["stiff_sheets"].astype(float) - truth) <= 1) >= 0.9
    inside = (shells["stiff_low"] <= truth) & (truth <= shells["stiff_high"])
    assert inside.mean() >= 0.87
    assert shells["monotone"].mean() > 0.97


@pytest.mark.parametrize("where", [(12.6, 9, (7, 10)), (12.6, 8, (7, 10)), (7.7, 9, (3, 6))])
def test_shell_within_one_sheet_in_few_noisy_frames(where):
    """A failure means that fast pulls under the publication's noise at its worst give no usable shells."""
    made, motion = stage(*where, noise_px=0.08)
    shells, truth = classify_shells(motion), true_sizes(made)
    hit, inside = scores(shells, truth)
    assert hit >= 0.9
    assert inside >= 0.87


def test_sheets_help_each_other():
    """A failure means that counting sheets one by one is as good, and all else here is for nothing."""
    made, motion = stage(12.6, 9, (7, 10), noise_px=0.08)
    truth = true_sizes(made)
    singly = [(motion["ratio"].to_numpy()[:, motion["side"] == side] < 0.1).sum(axis=1) for side in (-1, 1)]
    together_off = classify_shells(motion)["stiff_sheets"].astype(float) - truth
    assert (together_off**2).mean() < 0.5 * ((np.stack(singly, axis=1).ravel() - truth) ** 2).mean()


@pytest.mark.parametrize(
    ("name", "sheets"), [(name, 25) for name in SHAPES] + [("flat core, straight rise", 50), ("power 3", 50)]
)
def test_no_shape_of_the_truth_is_asked_for(name, sheets):
    """A failure means that sizes are right only where the ratio is the simulator's own power law."""
    rng = np.random.default_rng(5)
    place = rng.uniform(0.5, 12, 80)[:, None]
    ratio = np.clip(SHAPES[name](np.arange(1, sheets + 1), place), 0, 1)
    error = 0.0255 * np.exp(0.2 * rng.standard_normal(ratio.shape))
    shells = classify_shells(ideal(ratio + error * rng.standard_normal(ratio.shape), error))
    hit, inside = scores(shells, (ratio < 0.1).sum(axis=1))
    assert hit >= 0.9
    assert inside >= 0.87


@pytest.mark.parametrize("spoil", ["scatter", "unseen", "one mobile inside", "one misread"])
def test_single_sheets_do_not_decide(spoil):
    """A failure means that sheets that scatter, are not seen or stand out lead the shell's size astray."""
    rng = np.random.default_rng(6)
    ratio = profile(rng.uniform(6, 14, 120))
    events, one = np.arange(120), rng.integers(0, 25, 120)
    if spoil == "scatter":
        ratio *= 1 + 0.2 * rng.standard_normal(ratio.shape)
    if spoil == "one mobile inside":
        one = one % 5
        ratio[events, one] = 0.4
    measured = ratio + 0.02 * rng.standard_normal(ratio.shape)
    if spoil == "unseen":
        measured[rng.uniform(size=ratio.shape) < 0.2] = np.nan
    if spoil == "one misread":
        measured[events, one] += rng.choice([-0.3, 0.3], 120)
    hit, inside = scores(classify_shells(ideal(measured, 0.02)), (ratio < 0.1).sum(axis=1))
    assert hit >= 0.9
    assert inside >= 0.85


def test_an_error_of_the_stick_length_moves_all_sheets_at_once():
    """A failure means that intervals do not know of the error that Λ_st brings to all sheets alike."""
    rng = np.random.default_rng(7)
    ratio = profile(rng.uniform(8, 14, 120))
    measured = ratio * (1 + 0.15 * rng.standard_normal((120, 1))) + 0.005 * rng.standard_normal(ratio.shape)
    motion = ideal(measured, 0.005)
    truth = (ratio < 0.1).sum(axis=1)
    assert scores(classify_shells(motion), truth)[1] < 0.8
    known = motion.assign(
        ratio_err=np.hypot(motion["ratio_err"], 0.15 * motion["ratio"]),
        length_err=("event", np.full(120, 0.15)),
    )
    assert scores(classify_shells(known), truth)[1] >= 0.87


def test_movement_of_the_camera_moves_all_sheets_at_once():
    """A failure means that intervals do not know of the error of the camera's drift, or are far too wide."""
    rng = np.random.default_rng(7)
    ratio = profile(rng.uniform(8, 14, 120))
    measured = ratio + 0.03 * rng.standard_normal((120, 1)) + 0.005 * rng.standard_normal(ratio.shape)
    motion = ideal(measured, 0.005)
    truth = (ratio < 0.1).sum(axis=1)
    assert scores(classify_shells(motion), truth)[1] < 0.6
    drift_um = 0.03 * np.sqrt(12) * motion["stick_length_um"].to_numpy()
    known = motion.assign(ratio_err=np.hypot(motion["ratio_err"], 0.03), drift_err_um=("event", drift_um))
    shells = classify_shells(known)
    assert scores(shells, truth)[1] >= 0.87
    assert (shells["stiff_high"] - shells["stiff_low"]).mean() < 8


def test_intervals_are_short():
    """A failure means that an interval holds the truth only because it is wide, or goes to one side."""
    rng = np.random.default_rng(7)
    ratio = profile(rng.uniform(8, 14, 120))
    shells = classify_shells(ideal(ratio + 0.0255 * rng.standard_normal(ratio.shape), 0.0255))
    assert (shells["stiff_high"] - shells["stiff_low"]).mean() < 1.8
    size = shells["stiff_sheets"]
    assert (size - shells["stiff_low"]).mean() == pytest.approx((shells["stiff_high"] - size).mean(), abs=0.4)


def test_noise_that_drowns_all_gives_the_widest_interval():
    """A failure means that a size is made up where nothing was measured."""
    rng = np.random.default_rng(8)
    shells = classify_shells(ideal(profile(np.full(20, 8.0)) + 3 * rng.standard_normal((20, 25)), 3.0))
    assert (shells["stiff_high"] - shells["stiff_low"]).min() > 15


@pytest.mark.parametrize("rho", [0.0, 0.5])
def test_intervals_hold_where_noise_is_at_its_worst(rho):
    """A failure means that intervals are too narrow just where sizes become uncertain."""
    made, motion = stage(12.6, 9, (7, 10), noise_px=0.08, rho=rho)
    shells, truth = classify_shells(motion), true_sizes(made)
    assert ((shells["stiff_low"] <= truth) & (truth <= shells["stiff_high"])).mean() >= 0.87
    _, calm = stage(12.6, 9, (7, 10), noise_px=0.02, rho=rho)
    width, calm_width = (
        (table["stiff_high"] - table["stiff_low"]).mean() for table in (shells, classify_shells(calm))
    )
    assert width > 1.5 * calm_width


def test_the_raw_figure_misses_a_shell_of_eight():
    """A shell of 8 must read wrong without the noise correction, or the correction is not needed."""
    made, motion = measured(profile(np.full(40, 8.5)), stick_um=7.7, frames=27, noise_px=0.08)
    assert (true_sizes(made) == 8).all()
    raw = (motion["sigma_x_um"] / motion["stick_length_um"]).to_numpy()
    raw_sizes = (raw[:, motion["side"] > 0] < 0.1).sum(axis=1)
    assert np.median(raw_sizes) <= 5
    shells = classify_shells(motion)
    assert np.median(shells["stiff_sheets"].astype(float)) == 8
    assert np.mean(np.abs(shells["stiff_sheets"].astype(float) - 8) <= 1) >= 0.9


def test_one_misread_sheet_does_not_cut_a_shell():
    """A failure means that one sheet that reads high by chance ends the shell there."""
    ratio = profile([9.0, 9.0, 9.0])
    ratio[:, 3] += 0.06
    shells = classify_shells(ideal(ratio, 0.03))
    assert shells["monotone"].all()
    assert (shells["stiff_sheets"] - 8).abs().max() <= 1


def test_well_measured_sheets_lead():
    """A failure means that a blurred sheet has the same say in the shell's size as sharp ones."""
    ratio, error = profile([8.5]), np.full((1, 25), 0.005)
    ratio[:, 4], error[:, 4] = 0.4, 0.3
    shells = classify_shells(ideal(ratio, error))
    assert shells["monotone"].all()
    assert (shells["stiff_sheets"] == 8).all()


def test_a_ratio_that_surely_falls_with_n_is_counted_sheet_by_sheet(monkeypatch):
    """A failure means that sheets mobile inside and stiff outside are counted as if it were the reverse."""
    rng = np.random.default_rng(9)
    ratio = profile(np.full(60, 9.5))[:, ::-1]
    motion = ideal(ratio + 0.03 * rng.standard_normal(ratio.shape), 0.03)
    shells = classify_shells(motion)
    assert not shells["monotone"].any()
    assert abs(shells["stiff_sheets"].mean() - 9) < 0.5
    always = np.ones(60, bool)
    monkeypatch.setattr("vision.shells.isotonic", lambda side, _: (isotonic(side, 1.0)[0], always))
    assert classify_shells(motion)["stiff_sheets"].mean() < 8


def test_a_mobile_sheet_deep_inside_is_not_averaged_away():
    """A failure means that one sheet that moves, well measured, counts as stiff among stiff ones."""
    ratio = profile([9.5, 9.5, 9.5])
    ratio[:, 3] = 0.3
    shells = classify_shells(ideal(ratio, 0.01))
    assert not shells["monotone"].any()
    assert (shells["stiff_sheets"] == 8).all()


def test_all_stiff_or_all_mobile():
    """A failure means that a shell cannot be empty or whole."""
    shells = classify_shells(ideal(np.array([[0.01] * 10, [0.4] * 10]), 0.01))
    assert list(shells["stiff_sheets"]) == [10, 0]
    assert list(shells["stiff_low"]) == [10, 0]
    assert list(shells["stiff_high"]) == [10, 0]


def test_threshold_moves_the_boundary():
    """A failure means that the threshold is ignored."""
    made, motion = measured(profile(np.full(10, 8.0)), stick_um=27.0, frames=60, noise_px=0.02)
    for threshold in (0.05, 0.1, 0.25):
        sizes = classify_shells(motion, threshold=threshold)["stiff_sheets"].astype(float)
        truth = (made.ratio < threshold).sum(axis=1) // 2
        np.testing.assert_allclose(sizes, np.repeat(truth, 2), atol=1)


DEFORMATION = (
    "event,index,side,n,sigma_x_um,sigma_x_corrected_um,sweep_um,stick_length_um,"
    "ratio,ratio_err,p_stiff,shell"
)
SHELLS = "event,d_v_mm,side,stiff_sheets,stiff_low,stiff_high,M_eff_model"


def test_p_stiff_is_a_probability():
    """A failure means that of the sheets called 80 % stiff, it is not four in five that are."""
    ratio = np.random.default_rng(4).uniform(0, 0.25, (100, 25))
    made, motion = measured(ratio, stick_um=12.6, frames=12, noise_px=0.05)
    p = classify_sheets(motion)["p_stiff"].to_numpy().ravel()
    stiff = (made.ratio < 0.1).ravel()
    for low, high in ((0.0, 0.1), (0.1, 0.35), (0.35, 0.65), (0.65, 0.9), (0.9, 1.0)):
        group = (p >= low) & (p <= high)
        assert group.sum() > 100
        assert stiff[group].mean() == pytest.approx(p[group].mean(), abs=0.07)


def test_what_cannot_be_told_is_undetermined():
    """A failure means that a sheet at the threshold, or one never seen, is called stiff or mobile."""
    made, motion = measured(np.tile([0.02, 0.1, 0.3, 0.4, 0.5], (60, 1)), stick_um=20.0, noise_px=0.05)
    motion["ratio_signed"][:, 0] = np.nan
    judged = classify_sheets(motion)
    share = {n: (judged["shell"].sel(sheet=motion["n"] == n) == "undetermined").mean() for n in (1, 2, 3)}
    assert share[1] == 0
    assert share[2] > 0.6
    assert share[3] == 0
    assert (judged["shell"][:, 0] == "undetermined").all()
    assert np.isnan(judged["p_stiff"].to_numpy()[:, 0]).all()
    assert set(judged["shell"].sel(sheet=motion["n"] == 1).to_numpy().ravel()) == {"stiff"}
    assert "p_stiff" not in motion
    assert made.ratio.shape == judged["shell"].shape


def test_few_known_sheets_give_no_size_and_gaps_count():
    """A failure means a size from nothing, or a shell that shrinks because a sheet was not seen."""
    ratio = profile(np.full(4, 8.5))
    ratio[1, 2:] = np.nan
    ratio[2, 3:5] = np.nan
    ratio[3] = np.nan
    shells = classify_shells(ideal(ratio, 0.01))
    assert list(shells["stiff_sheets"].isna()) == [False, True, False, True]
    assert list(shells["sheets_known"]) == [25, 2, 23, 0]
    assert shells["stiff_sheets"][2] == 8
    assert shells["stiff_low"][1] is pd.NA


def test_a_sheet_that_moves_outwards_is_mobile():
    """A failure means that direction decides what is stiff, and a wrong axis makes all sheets stiff."""
    _, motion = measured(-profile(np.full(10, 8.0)), stick_um=20.0, noise_px=0.02)
    shells = classify_shells(motion)
    assert shells["monotone"].all()
    outward = motion["flag"] == "outward"
    assert outward.mean() > 0.8
    assert (classify_sheets(motion)["shell"].to_numpy()[outward & (motion["ratio"] > 0.2)] == "mobile").all()
    np.testing.assert_allclose(shells["stiff_sheets"].astype(float), 7, atol=1)


def test_tables_have_the_columns_people_read():
    """A failure means that scripts that read deformation.csv or shells.csv break, or find rows of another."""
    made, motion = measured(profile([8.0, 6.0]), noise_px=0.03)
    table, shells = deformation_table(motion), classify_shells(motion)
    assert ",".join(table.columns[:12]) == DEFORMATION
    assert ",".join(shells.columns[:7]) == SHELLS
    assert list(table["event"]) == [0] * 50 + [1] * 50
    assert list(table["index"][:50]) == list(range(50))
    row = table[(table["event"] == 1) & (table["index"] == 37)].iloc[0]
    here = motion.sel(event=1, sheet=37)
    assert (row["side"], row["n"]) == (1, 13)
    assert row["ratio"] == here["ratio"]
    assert row["ratio"] == pytest.approx(row["sigma_x_corrected_um"] / row["stick_length_um"])
    assert row["stick_length_um"] == made.sticks["stick_length_um"][1]
    assert list(zip(shells["event"], shells["side"], strict=True)) == [(0, -1), (0, 1), (1, -1), (1, 1)]
    np.testing.assert_allclose(shells["d_v_mm"][::2], made.sticks["d_v_mm"])


def test_the_forces_figure_stands_beside_imagings():
    """A failure means that M_eff is not that of the row's own d_v, or that an input was written into."""
    _, motion = measured(profile([8.0, 6.0]), noise_px=0.03)
    plain = classify_shells(motion)
    full = classify_shells(motion, effective_sheets=lambda d_mm: 2 * d_mm)
    assert plain["M_eff_model"].isna().all()
    np.testing.assert_allclose(full["M_eff_model"], 2 * plain["d_v_mm"])
    pd.testing.assert_frame_equal(full.drop(columns="M_eff_model"), plain.drop(columns="M_eff_model"))


@pytest.mark.parametrize("threshold", [0.0, np.nan])
def test_an_impossible_threshold_is_refused(threshold):
    """A failure means a table of nonsense from a threshold that cannot be meant."""
    _, motion = measured(profile([8.0]), noise_px=0.03)
    with pytest.raises(InputError, match="expected"):
        classify_shells(motion, threshold=threshold)


def test_a_ratio_known_exactly_is_on_one_side_of_the_threshold():
    """A failure means that perfect ratios get no probability, or are called stiff above the threshold."""
    motion = ideal(np.array([[0.0999, 0.1, 0.1001, -0.0999, -0.1001]]), 0.0)
    p = classify_sheets(motion)["p_stiff"].to_numpy()[0]
    np.testing.assert_allclose(p, [1, 0.5, 0, 1, 0], atol=1e-6)


def test_effective_sheets_that_are_no_function_are_named():
    """A failure means that a number in place of a function ends in "'int' object is not callable"."""
    with pytest.raises(InputError, match="`effective_sheets`: expected a function"):
        classify_shells(ideal(np.linspace(0, 1, 10)[None], 0.01), effective_sheets=8)
