"""Stiff and mobile sheets, and the tables of shells."""

import numpy as np
import pandas as pd
import pytest

from tests.scenes.creeping import profile
from tests.scenes.shells import ideal, measured
from vision.errors import InputError
from vision.shells import classify_sheets, classify_shells, deformation_table, with_model

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
    full = with_model(plain, lambda d_mm: 2 * d_mm)
    assert plain["M_eff_model"].isna().all()
    np.testing.assert_allclose(full["M_eff_model"], 2 * plain["d_v_mm"])
    pd.testing.assert_frame_equal(full, classify_shells(motion, effective_sheets=lambda d_mm: 2 * d_mm))


@pytest.mark.parametrize(
    "options", [{"threshold": 0.0}, {"threshold": np.nan}, {"certainty": 0.5}, {"certainty": 1}]
)
def test_impossible_settings_are_refused(options):
    """A failure means a table of nonsense from a threshold or certainty that cannot be meant."""
    _, motion = measured(profile([8.0]), noise_px=0.03)
    with pytest.raises(InputError, match="expected"):
        classify_shells(motion, **options)


def test_a_ratio_known_exactly_is_on_one_side_of_the_threshold():
    """A failure means that perfect ratios get no probability, or are called stiff above the threshold."""
    motion = ideal(np.array([[0.0999, 0.1, 0.1001, -0.0999, -0.1001]]), 0.0)
    p = classify_sheets(motion)["p_stiff"].to_numpy()[0]
    np.testing.assert_allclose(p, [1, 0.5, 0, 1, 0], atol=1e-6)
