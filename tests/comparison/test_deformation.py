"""What the films of several tests show: figures of σ_x/Λ_st and of shells, and columns of tests.csv."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr

import vision
from tests.scenes.comparison import events, write_run
from vision.pipeline import Settings

N = np.arange(1, 26)
LATE = Path(__file__).parents[2] / "fixtures" / "late"


def true_ratio(d_mm, outer=0.5):
    """σ_x/Λ_st of sheets 1 to 25, (…, 25), which rises with d."""
    return outer * (N / 25) ** 2 * (1 + 0.2 * (np.asarray(d_mm)[..., None] - 15))


def with_film(folder, which, *, outer=0.5, seed=0):
    """A run whose film shows these events of its force recording."""
    table = events(seed=seed)
    write_run(folder, table)
    rng, seen = np.random.default_rng(seed), table.iloc[which]
    sheets, shells = [], []
    for event, d_mm in zip(seen["event"], seen["d_v_mm"], strict=True):
        for side in (-1, 1):
            ratio = true_ratio(d_mm, outer) + rng.normal(0, 0.01, 25)
            sheets += [(event, side, n, y, 0.01) for n, y in zip(N, ratio, strict=True)]
            size = int((true_ratio(d_mm, outer) < 0.1).sum())
            shells.append((event, d_mm, side, size, size - 1, size + 1))
    columns = ["event", "side", "n", "ratio", "ratio_err"]
    pd.DataFrame(sheets, columns=columns).to_csv(folder / "deformation.csv", index=False)
    columns = ["event", "d_v_mm", "side", "stiff_sheets", "stiff_low", "stiff_high"]
    pd.DataFrame(shells, columns=columns).to_csv(folder / "shells.csv", index=False)
    return folder


def figures_of(found):
    return {figure.name: figure for figure in found.figures()}


def test_films_are_compared_at_the_separations_that_all_of_them_show(tmp_path):
    """A failure means that a difference of d passes for one of the samples, or colours that do not match."""
    runs = [
        write_run(tmp_path / "force", events(seed=8)),
        with_film(tmp_path / "a", slice(20, 60), seed=1),
        with_film(tmp_path / "b", slice(40, 80), outer=0.3, seed=2),
    ]
    found = vision.compare(runs)
    figures = figures_of(found)
    d = events()["d_v_mm"].to_numpy()[40:60]
    for series, outer in zip(figures["ratios"].panel.series, (0.5, 0.3), strict=True):
        assert f"d_v = {d.mean():.2f} mm, mean of 20" in series.label
        true = true_ratio(d, outer).mean(axis=0)
        np.testing.assert_array_equal(series.x, np.r_[-N[::-1], N])
        off = (series.y - np.r_[true[::-1], true]) / (series.high - series.y)
        assert np.sqrt(np.mean(off**2)) < 1.4
    assert "which all films show" in figures["ratios"].caption
    inks = {series.label: series.ink for series in figures["irregular"].panel.series}
    for series in (*figures["ratios"].panel.series, *figures["shells"].panel.series):
        assert series.ink == next(ink for label, ink in inks.items() if label[0] == series.label[0])
    assert [len(series.x) for series in figures["shells"].panel.series] == [40, 40]


def test_films_of_other_separations_are_said(tmp_path):
    """A failure means that two films without a common separation are compared without a word."""
    runs = [with_film(tmp_path / f"r{k}", slice(40 * k, 40 * k + 9), seed=k) for k in range(2)]
    figure = figures_of(vision.compare(runs))["ratios"]
    assert "different separations" in figure.caption
    assert [series.label.rpartition(" ")[2] for series in figure.panel.series] == ["9", "9"]


def test_the_columns_are_the_medians_of_the_film(tmp_path):
    """A failure means wrong numbers in tests.csv, or numbers of films that there are not."""
    runs = [with_film(tmp_path / "a", slice(20, 61), seed=3), write_run(tmp_path / "b", events(seed=4))]
    table = vision.compare(runs).table
    row, d = table.iloc[0], events()["d_v_mm"].to_numpy()[20:61]
    assert (row["film_sticks"], row["film_d_mm"]) == (41, pytest.approx(d[20]))
    for side in ("left", "right"):
        assert row[f"stiff_{side}"] == np.median((true_ratio(d) < 0.1).sum(axis=1))
        assert row[f"ratio_n_{side}"] == 25
        assert abs(row[f"ratio_{side}"] - true_ratio(d)[20, 24]) < 2.5 * row[f"ratio_{side}_err"] < 0.05
        assert 0.5 < row[f"stiff_{side}_err"] < 1
    assert table.iloc[1].filter(regex="film|stiff|ratio").isna().all()
    assert "ratios" not in figures_of(vision.compare(runs[1:]))


def test_a_number_of_sheets_on_which_all_sticks_agree_has_an_error(tmp_path):
    """A failure means an error of zero, with which a weighted fit follows this test alone."""
    folder = with_film(tmp_path / "a", slice(20, 61))
    shells = pd.read_csv(folder / "shells.csv").assign(stiff_sheets=12, stiff_low=12, stiff_high=12)
    shells.to_csv(folder / "shells.csv", index=False)
    row = vision.compare([folder]).table.iloc[0]
    assert row["stiff_left"] == 12
    assert row["stiff_left_err"] == row["stiff_right_err"] == pytest.approx(0.29, abs=0.01)


@pytest.mark.parametrize("damage", [lambda t: t.drop(columns="ratio"), lambda t: t.assign(ratio="x")])
def test_a_damaged_table_of_the_film_leaves_the_force(damage, tmp_path):
    """A failure means a traceback, a test that is lost, or a film that is missing without a word."""
    run = with_film(tmp_path / "a", slice(20, 60))
    path = run / "deformation.csv"
    damage(pd.read_csv(path)).to_csv(path, index=False)
    found = vision.compare([run])
    assert len(found.table) == 1
    assert [line for line in found.warnings if line.endswith("the film of this run is not compared")]
    assert np.isnan(found.table.iloc[0]["film_sticks"])


def test_values_that_are_no_numbers_count_for_nothing(tmp_path):
    """A failure means that one damaged cell ends a comparison, or changes its result."""
    run = with_film(tmp_path / "a", slice(20, 60))
    before = vision.compare([run]).table.iloc[0]
    for name, columns in (("deformation", ("n", "ratio", "event")), ("shells", ("stiff_sheets", "side"))):
        table = pd.read_csv(run / f"{name}.csv").astype(float)
        for k, column in enumerate(columns):
            table.loc[k, column] = (np.inf, np.nan)[k % 2]
        table.to_csv(run / f"{name}.csv", index=False)
    found = vision.compare([run])
    assert found.table.iloc[0]["stiff_left"] == before["stiff_left"]
    assert found.table.iloc[0]["ratio_n_left"] == 25
    assert {"ratios", "shells"} <= set(figures_of(found))


def test_a_simulated_film_has_its_true_shell_and_ratio(tmp_path):
    """A failure means that tests.csv contradicts what the sheets did."""
    settings = Settings(pixel_size_um=10, timestamps=LATE / "timestamps.txt", d0_mm=16.6)
    analysis = vision.analyse(LATE / "video.avi", LATE / "force.txt", settings)
    row = vision.compare([vision.save_run(analysis, tmp_path / "run", report=False)]).table.iloc[0]
    truth = xr.load_dataset(LATE / "truth.nc", engine="h5netcdf")
    nearest = np.abs(analysis.motion["t_v_s"].values[:, None] - truth["t_v_s"].values).argmin(axis=1)
    ratio = truth["ratio"].values[nearest]
    for side, name in ((-1, "left"), (1, "right")):
        of_side = ratio[:, truth["side"].values == side]
        assert (
            abs(row[f"stiff_{name}"] - np.median((of_side < 0.1).sum(axis=1))) <= 2 * row[f"stiff_{name}_err"]
        )
        outer = np.median(
            ratio[:, (truth["side"].values == side) & (truth["n"].values == row[f"ratio_n_{name}"])]
        )
        assert abs(row[f"ratio_{name}"] - outer) < 2.5 * row[f"ratio_{name}_err"] < 0.1
