"""What the figures of several tests show, and what is said beside them."""

import json

import numpy as np
import pandas as pd
import pytest

import vision
from tests.scenes.comparison import campaign, events, write_campaign, write_run
from vision.comparison.comparison import _methods, _subtitle
from vision.comparison.figures import slope_text
from vision.comparison.joint import CompareSettings
from vision.comparison.trends import Trend
from vision.figures.figure import Panel, Series, save_figures
from vision.figures.style import DATA
from vision.models import equations
from vision.sample import PUBLISHED, Sample


def with_sticks(folder, title):
    """A run that has kept its figure of single sticks."""
    panel = Panel(x_label="d − d_v (µm)", y_label="F − F_v (N)", title=title, series=(LINE,))
    save_figures(folder / "figures.npz", [panel.figure("sticks", "Sticks.", title="Sticks")])
    return folder


LINE = Series(label="1", x=np.arange(3.0), y=np.arange(3.0), ink=DATA)


def test_speeds_that_differ_in_the_last_digit_are_one(tmp_path):
    """A failure means one velocity twice on the page, and figures of one name that overwrite each other."""
    speeds = (1.0, 0.9999999999999998, 10.0)
    folders = [
        with_sticks(write_run(tmp_path / f"r{k}", events(speed=v, seed=k), speed=v), f"r{k}")
        for k, v in enumerate(speeds)
    ]
    names = [figure.name for figure in vision.compare(folders).figures()]
    assert names.count("sticks_V1") == 1
    assert "sticks_V10" in names
    assert len(set(names)) == len(names)


def test_samples_without_names_are_not_counted(tmp_path):
    """A failure means that tests of unknown samples are called tests of one sample."""
    folders = [write_run(tmp_path / f"r{k}", events(seed=k)) for k in range(2)]
    assert _subtitle(vision.compare(folders).tests) == "2 tests, V = 1 mm/min"
    table = tmp_path / "tests.csv"
    table.write_text("run,sample\nr0,A\nr1,A\n")
    assert _subtitle(vision.compare(folders, table=table).tests) == "2 tests of 1 sample, V = 1 mm/min"


def test_tests_that_share_no_friction_coefficient(tmp_path):
    """A failure means a joint μ, and its curve, that no test has, and nothing said."""
    folders = [write_run(tmp_path / f"r{k}", events(mu=mu, seed=k)) for k, mu in enumerate((0.7, 0.9))]
    found = vision.compare(folders)
    assert found.joint[0].disagreement > 1000
    (line,) = [line for line in found.warnings if "no single μ fits the 2 tests" in line]
    assert f"{found.joint[0].disagreement:.3g}" in line
    figures = {figure.name: figure for figure in found.figures()}
    for name in ("peaks", "drops"):
        assert [one.label for one in figures[name].panel.series] == ["r0", "r1"]
    assert "No curve" in figures["peaks"].caption


@pytest.mark.parametrize("mu", [0.89, 0.894])
def test_tests_that_share_their_friction_coefficient(tmp_path, mu):
    """A failure means a warning about tests that differ by less than events scatter, or no curve."""
    made = (events(seed=1), events(mu=mu, seed=2))
    found = vision.compare([write_run(tmp_path / f"r{k}", one) for k, one in enumerate(made)])
    assert found.joint[0].disagrees == (mu != 0.89)
    assert found.joint[0].disagrees == any("differ by more than their" in s for s in found.warnings)
    assert not any("single μ" in line for line in found.warnings)
    peaks = next(figure for figure in found.figures() if figure.name == "peaks")
    assert [one.label for one in peaks.panel.series] == ["r0", "r1", "Eq. 1"]  # one velocity
    assert "fitted jointly to all tests" in peaks.caption


def test_ten_tests_can_be_told_apart(tmp_path):
    """A failure means that no figure shows which of ten tests is unlike the others."""
    folders = [write_run(tmp_path / f"r{k}", events(seed=k)) for k in range(10)]
    facts = json.loads((folders[9] / "run.json").read_text())
    (folders[9] / "run.json").write_text(json.dumps(facts | {"warnings": ["one", "two"]}))
    table = pd.DataFrame({"RH_percent": np.linspace(30, 50, 10), "film": "x", "force": "x"})
    found = vision.compare(folders, table=table)
    figures = {figure.name: figure for figure in found.figures()}
    for name in ("peaks", "drops", "stiffnesses", "collapse"):
        shown = figures[name].panel.series[:10]
        assert [one.label for one in shown] == [folder.name for folder in folders], name
        assert len({one.ink for one in shown}) == 10
    assert found.table["notes"].str.contains("2 warnings in its report").tolist() == [False] * 9 + [True]
    (line,) = (line for line in found.warnings if "not known and left out" in line)
    assert "film, force" in line
    assert "adjusted for the number of trends." in figures["trend_scale_RH"].caption


def test_samples_at_one_speed_differ_in_colour_and_mark(tmp_path):
    """A failure means two samples that look like one."""
    folders = [write_run(tmp_path / f"r{k}", events(seed=k)) for k in range(2)]
    table = pd.DataFrame({"run": [folder.name for folder in folders], "sample": ["thin", "thick"]})
    figures = {figure.name: figure for figure in vision.compare(folders, table=table).figures()}
    for name in ("peaks", "drops", "stiffnesses"):
        one, other = figures[name].panel.series[:2]
        assert {one.label, other.label} == {"thin", "thick"}
        assert one.ink != other.ink and one.hollow != other.hollow


def test_systematic_errors_of_the_runs_are_taken_over(tmp_path):
    """A failure means a drifting load cell that the comparison knows nothing of, or an error of exactly 0."""
    drift = {"mu": 0.07, "T0_N": 5.9, "A": 0.2, "N_hat_N": 0.1, "Lambda_hat_mm": 0.3, "K_N_per_mm": 1.0}
    models = {"budget": {"d0": dict.fromkeys(drift), "load_drift": drift}}
    folders = [
        write_run(tmp_path / "known", events(seed=1), models=models),
        write_run(tmp_path / "unknown", events(seed=2)),
    ]
    found = vision.compare(folders)
    columns = ["mu_systematic", "T0_systematic_N", "A_systematic"]
    known, unknown = (found.table.set_index("run").loc[name, columns] for name in ("known", "unknown"))
    assert known.to_numpy(float) == pytest.approx([0.07, 5.9, 0.2])
    assert unknown.isna().all()  # nothing moves μ, 𝒯0 and A
    assert found.joint[0].mu.systematic_error == pytest.approx(
        0.035, rel=0.2
    )  # half of the weight is its own
    peaks = next(figure for figure in found.figures() if figure.name == "peaks")
    assert "(stat.) ± " in peaks.caption  # no run states an error of d0
    assert [series.label for series in peaks.panels[0].series][:2] == ["known", "unknown"]  # one velocity
    assert np.isnan(vision.compare(folders[1:]).table["mu_systematic"].iloc[0])


def test_the_axes_show_every_test(tmp_path):
    """A failure means that the slips of a test with few and large ones are cut off without a word."""
    folders = [write_run(tmp_path / f"r{k}", events(seed=k)) for k in range(4)]
    few = events(seed=9).iloc[:8]
    few = few.assign(dF_N=4 * few["dF_N"], K_N_per_mm=3 * few["K_N_per_mm"])
    found = vision.compare([*folders, write_run(tmp_path / "few", few)])
    for figure in found.figures():
        if figure.name in ("drops", "stiffnesses"):
            (low, high), shown = figure.panel.y_range, [one.y for one in figure.panel.series]
            assert low == 0 and np.nanmax(np.concatenate(shown)) < high


def test_numbers_of_previous_tests_are_whole(tmp_path):
    """A failure means an axis that counts 1.5 tests."""
    folders = [write_run(tmp_path / f"r{k}", events(seed=k)) for k in range(3)]
    table = pd.DataFrame({"run": [folder.name for folder in folders], "n_test": [0, 1, 2]})
    (trend,) = [one for one in vision.compare(folders, table=table).figures() if one.name == "trends"]
    assert trend.panels
    assert all(panel.whole_numbers for panel in trend.panels)


def test_every_sample_has_its_own_colour_and_curves(tmp_path):
    """A failure means the curve of one sample drawn through the points of another, or with its thickness."""
    other = Sample(sheets_per_block=20, thickness_mm=0.15)
    runs = [write_run(tmp_path / "first", events(sample=other, mu=1.05, seed=1), sample=other)]
    runs += [write_run(tmp_path / f"r{k}", events(speed=1 / k, seed=k), speed=1 / k) for k in (1, 2)]
    samples = pd.DataFrame({"run": [run.name for run in runs], "sample": ["A", "B", "B"]})
    found = vision.compare(runs, samples)
    mus = [found.fits[0].mu.value, found.joint[0].mu.value]
    figures = found.figures()[:3]
    for figure in figures:
        labels = [one.label for one in figure.panel.series]
        assert labels[:2] == ["A", "B"]
        assert len(set(labels)) == len(labels) and {one[-1] for one in labels[2:]} == {"A", "B"}
        inks = {name: {one.ink for one in figure.panel.series[2:] if one.label[-1] == name} for name in "AB"}
        assert not inks["A"] & inks["B"]
    (a, b), drops = figures[0].panel.series[-2:], figures[1].panel.series[-2:]
    for eq1, drop, mu, sample in zip((a, b), drops, mus, (other, PUBLISHED), strict=True):
        assert eq1.y == pytest.approx(equations.traction(eq1.x, mu=mu, sample=sample))
        total = equations.total_normal_force(drop.x, mu=mu, sample=sample)
        assert np.ptp(drop.y / total) < 1e-9
    assert "of A" in figures[0].caption and "fitted jointly to B" in figures[0].caption


@pytest.mark.parametrize(
    ("quantity", "predictor", "unit"),
    [
        ("mu", "RH_percent", "per %"),
        ("N_hat_N", "n_test", "N per test"),
        ("Lambda_hat_mm", "n_test", "mm per test"),
    ],
)
def test_slopes_have_their_unit(quantity, predictor, unit):
    """A failure means a number that nobody can compare with another."""
    trend = Trend(
        quantity=quantity, predictor=predictor, tests=9, slope=0.01, slope_err=0.002,
        partial_slope=0.02, partial_slope_err=0.003,
    )  # fmt: skip
    assert slope_text(trend, partial=False) == f"0.0100 ± 0.0020 {unit}"
    assert slope_text(trend, partial=True) == f"0.0200 ± 0.0030 {unit}"


def test_methods_tell_only_what_was_done(tmp_path):
    """A failure means that a paper claims a joint fit and trends that one test cannot have."""
    runs = [write_run(tmp_path / f"r{k}", events(seed=k)) for k in range(2)]
    one, two = (" ".join(_methods(vision.compare(some))) for some in (runs[:1], runs))
    assert ("One μ" in one, "One μ" in two) == (False, True)
    assert "Trends" not in one + two
    wide = vision.compare(runs, settings=CompareSettings(t0_limit_N=25.0, change_p=0.05))
    assert "within ±10 N" in two and "within ±25 N" in " ".join(_methods(wide))
    assert "fewer than 1 %" in two and "fewer than 5 %" in " ".join(_methods(wide))


def test_a_test_has_the_same_colour_in_every_figure(tmp_path):
    """A failure means that the last digits of measured velocities exchange the colours of two tests."""
    speeds = (1.0001, 0.9999, 1.0002)
    runs = [write_run(tmp_path / f"t{k}", events(seed=k), speed=speed) for k, speed in enumerate(speeds)]
    figures = {figure.name: figure for figure in vision.compare(runs).figures()}
    inks = {series.label: series.ink for series in figures["peaks"].panel.series}
    for series in figures["irregular"].panel.series:
        assert series.ink == inks[series.label.split(",")[0]]


def test_the_errors_of_trends_are_named(tmp_path):
    """A failure means that error bars without systematic errors are read as all."""
    runs = [write_run(tmp_path / f"t{k}", events(seed=k)) for k in range(4)]
    table = pd.DataFrame({"run": runs, "n_test": range(4)})
    figures = {figure.name: figure for figure in vision.compare(runs, table).figures()}
    assert "without systematic ones" in figures["trend_fits_n"].caption


def test_single_sticks_name_their_test(tmp_path):
    """A failure means events of one of many tests, and nobody knows of which."""
    folders = [with_sticks(write_run(tmp_path / f"r{k}", events(seed=k)), "") for k in range(2)]
    figures = {figure.name: figure for figure in vision.compare(folders).figures()}
    assert figures["sticks_V1"].caption.startswith("V = 1 mm/min, r")
    assert figures["sticks_V1"].panel.title.startswith("V = 1 mm/min, r")


def test_a_trend_shows_its_samples_and_a_line_only_if_it_is_claimed(tmp_path):
    """A failure means that samples cannot be told apart, or that a line suggests a trend without one."""
    truth = campaign(np.random.default_rng(5), n_hat_rh=0.0)
    found = vision.compare(*write_campaign(tmp_path / "all", truth))
    claimed = {(t.quantity, t.predictor): t.claimed for t in found.trends}
    assert claimed["N_hat_N", "n_test"] and not claimed["mu", "n_test"]
    figure = next(figure for figure in found.figures() if figure.name == "trend_fits_n")
    points = [one for one in figure.panel.series if one.look == "points"]
    assert [one.label for one in points] == [f"{what}, {name}" for what in ("N̂", "μ") for name in "abc"]
    assert len({one.ink for one in points}) == 3
    assert [one.hollow for one in points] == 3 * [False] + 3 * [True]
    assert [one.label for one in figure.panel.series if one.look == "line"] == ["N̂, trend"]
    assert "tests of all samples together" in figure.caption and "; no trend, p" in figure.caption
    alone = vision.compare(*write_campaign(tmp_path / "one", truth.assign(sample="a")))
    panel = next(figure for figure in alone.figures() if figure.name == "trend_fits_n").panel
    assert [one.label for one in panel.series if one.look == "points"] == ["N̂", "μ"]
