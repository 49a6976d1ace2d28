"""`track compare` from run folders to a folder of its own, and what it says of bad input."""

import json
import re

import numpy as np
import pandas as pd
import pytest

import vision
from tests.docs.test_columns import documented
from tests.scenes.comparison import campaign, events, write_campaign, write_run
from tests.scenes.undrawn import undrawn
from vision.command.main import run
from vision.comparison.comparison import answers
from vision.comparison.runs import read_tests
from vision.errors import InputError
from vision.experiment import Experiment, force_recording, with_settings, write_force
from vision.experiment.mechanics import simulate_pull
from vision.figures import load_figures
from vision.figures.style import to_unicode

COLUMNS = (
    "run,sample,V_mm_min,n_test,RH_percent,mu,mu_err,T0_N,T0_err_N,A,A_err,N_hat_N,N_hat_err_N,"
    "Lambda_hat_mm,Lambda_hat_err_mm,chi2_dof"
)


@pytest.fixture
def six(tmp_path):
    """Six runs and their table, in a fresh working directory."""
    truth = campaign(np.random.default_rng(4)).iloc[:6]
    write_campaign(tmp_path, truth)
    return [f"test{k:02d}" for k in range(6)]


def test_the_folder(six, tmp_path, capsys):
    """A failure means that a script that reads the agreed names breaks."""
    assert run(["compare", *six, "--table", "tests.csv"]) == 1  # μ follows the humidity
    shown = capsys.readouterr()
    assert "track: warning: a: no single μ fits the 4 tests" in shown.err
    assert "one μ of sample a " in shown.out and " for 4 tests" in shown.out
    (line,) = (line for line in shown.out.splitlines() if "one μ of sample a " in line)
    assert line.endswith("without the error of d0, which is not given")  # it may be why they differ
    assert "one μ of all samples " in shown.out
    folder = tmp_path / "comparison"
    table = pd.read_csv(folder / "tests.csv")
    assert ",".join(table.columns).startswith(COLUMNS)
    assert sorted(documented()["tests.csv"]) == sorted({*table.columns, "T_C"})
    assert table["run"].tolist() == six
    trends = json.loads((folder / "trends.json").read_text(encoding="utf-8"))
    assert {t["quantity"] for t in trends["trends"]} == {"mu", "N_hat_N", "Lambda_hat_mm"}
    assert trends["collapse"]["rms_after"] < trends["collapse"]["rms_before"]
    assert len(pd.read_csv(folder / "all_events.csv")) == sum(
        len(pd.read_csv(tmp_path / name / "events.csv")) for name in six
    )
    facts = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    assert facts["compare"]["runs"] == six
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "6 tests: comparison" in page
    assert 'id="collapse"' in page
    for row in table.itertuples():  # what was fitted to each test
        cells = page.split(f"<td>{row.run}</td>")[1].split("</tr>")[0]
        assert float(re.search(r"<td>(0\.\d+) ± ", cells)[1]) == pytest.approx(row.mu, abs=row.mu_err / 2)
    assert "No warnings" not in page and "no single μ fits the 4 tests" in page
    assert "https://" not in page.split("<script")[0]


@pytest.mark.thorough
def test_figures_of_a_comparison(six, tmp_path, refused):
    """A failure means that the figures of several tests cannot be had for a manuscript."""
    assert run(["compare", *six, "--table", "tests.csv", "--out", "all", "--quiet"]) == 1
    assert run(["figures", "all", "collapse", "trends", "--to", "csv", "--out", "m"]) == 0
    collapse = pd.read_csv(tmp_path / "m" / "collapse.csv")
    assert (tmp_path / "m" / "trends.csv").exists()
    assert collapse["d̂ = d_v / Λ̂"].between(0.5, 1.2).all()
    figures = load_figures(tmp_path / "all" / "figures.npz")
    named = {figure.name: figure for figure in figures}
    assert {"peaks", "drops", "stiffnesses", "collapse", "irregular", "trends"} <= set(named)
    assert named["collapse"].panel.inset is not None
    inks = [series.ink for series in named["irregular"].panel.series]
    assert len(set(inks)) == len(inks) == 6  # tests of one velocity too
    labels = [
        text for figure in figures for p in figure.panels for text in (p.x_label, p.y_label, p.y2_label)
    ]
    assert not any("_" in to_unicode(label) for label in labels)  # the page draws them as they are
    page = (tmp_path / "all" / "report.html").read_text(encoding="utf-8")
    on_page = [name for name in named if f'"name":"{name}"' in page]
    assert len(on_page) >= 8
    assert "trends" not in on_page  # the page shows its panels as figures of their own
    for figure in figures:
        assert figure.save(tmp_path / f"{figure.name}.png").stat().st_size > 5000
    assert "collapse" in refused("figures", "all", "shells")
    assert run(["figures"]) == 2


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda t: t.rename(columns={"RH_percent": "humidity"}), "the nearest is RH_percent"),
        (lambda t: t.rename(columns={"V_mm_min": "V_mm_mn"}), "the nearest is V_mm_min"),
        (lambda t: t.assign(RH_percent=t["RH_percent"] / 100), "look like fractions"),
        (lambda t: t.assign(n_test=["x", *t["n_test"][1:].astype(str)]), "1e+06; found 'x'"),
        (lambda t: t.assign(run=["gone", *t["run"][1:]]), "gone: expected a finished run"),
        (lambda t: t.iloc[1:], "not in the table, so left out of the trends: test00"),
        (lambda t: pd.concat([t, t.iloc[:1]]), "run test00 is in the table more than once"),
        (lambda t: t.assign(V_mm_min=60.0), "the table has V = 60 mm/min, its recording"),
    ],
)  # fmt: skip
def test_a_doubtful_table(six, change, said):
    """One line for each doubt, and the rest is read."""
    found = read_tests(six, change(pd.read_csv("tests.csv")))
    assert any(said in line for line in (*found.warnings, *found.failures))
    assert len(found.tests) == 6


@pytest.mark.usefixtures("no_picture")
def test_runs_that_cannot_be_used_are_named_and_the_rest_done(six, tmp_path, capsys):
    """A failure means that one bad run costs all others, or is silently left out."""
    made = tmp_path / "few"
    write_run(made, events().iloc[:4])
    (tmp_path / "video_only").mkdir()
    (tmp_path / "video_only" / "run.json").write_text("{}")
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "run.json").write_text("{")
    bad = ["few", "video_only", "broken", "nowhere"]
    assert run(["compare", *six[:2], *bad, "--out", "out", "--quiet"]) == 1
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 5
    assert "differ by more than their errors" in lines[-1]
    assert all(any(f"{name}" in line for line in lines) for name in bad)
    assert "at least 6 whole events" in lines[0]
    assert len(pd.read_csv("out/tests.csv")) == 2


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["compare"], "expected finished run folders"),
        (["compare", "nowhere"], "found no such folder"),
        (["compare", "tests.csv"], "found a file"),
        (["compare", "test00", "--table", "none.csv"], "none.csv: expected a CSV or Excel table"),
        (["compare", "test00", "--table", "empty.csv"], "empty.csv"),
        (["compare", "test00", "--table", "tests.csv", "--main-sample", "z"], "--main-sample: expected"),
        (["compare", "test00", "--fix-yeff", "-1"], "--fix-yeff: expected a positive number"),
        (["compare", "test00", "--table", "nameless.csv"], "--table: expected 1 rows"),
        (["compare", "test00", "--out", "test01", "--overwrite"], "or an earlier result of the same command"),
    ],
)  # fmt: skip
def test_input_that_cannot_be_used(six, tmp_path, arguments, said, refused):
    """Exit status 2, one line, nothing written."""
    (tmp_path / "empty.csv").write_text("")
    (tmp_path / "nameless.csv").write_text("n_test\n1\n2\n")
    assert said in refused(*arguments)


def test_the_label_of_one_mu_says_which_errors_it_contains(tmp_path):
    """A failure means that an error of d0 that nobody gave is said to be contained."""
    drift = {"load_drift": {"mu": 0.01}}
    given = {"budget": drift, "input_errors": {"d0_mm": 0.05}}
    made = [
        write_run(tmp_path / f"r{k}", events(seed=k), models=models)
        for k, models in enumerate((given, given, {"budget": drift}, {"budget": drift}))
    ]

    def one_mu(folders):
        said = answers(vision.compare(folders))[0]
        return f"{said.value}; {said.detail}"

    assert "(stat. and d_0) ±" in one_mu(made[:2]) and "without" not in one_mu(made[:2])
    assert "(stat. and d_0 where given) ±" in one_mu(made[1:3])
    assert "without the error of d0, which is not given in r2" in one_mu(made[1:3])
    assert "(stat.) ±" in one_mu(made[2:])
    assert one_mu(made[2:]).endswith("without the error of d0, which is not given")


def test_one_test_has_no_joint_mu(six, capsys):
    """A failure means that the main line of a comparison is absent, and nothing says why."""
    assert run(["compare", six[0], "--no-report"]) == 0
    assert "not fitted, needs at least two tests; that of test00 is 0.8" in capsys.readouterr().out


def test_a_wrong_argument_is_named_even_if_the_folder_exists(six, refused, capsys):
    """A failure means that a user deletes a folder, and only then learns of the wrong argument."""
    assert run(["compare", six[0], "--no-report", "--quiet"]) == 0
    assert run(["compare", six[0], "nope"]) == 2
    first, last = capsys.readouterr().err.splitlines()
    assert first.startswith("track: nope: expected") and "comparison: expected" in last
    assert "the runs: expected at least one that can be used; found nope" in refused("compare", "nope")


def test_a_table_alone_and_one_with_semicolons(six, tmp_path):
    """The table may name the runs; decimal commas and a byte-order mark are no obstacle."""
    table = pd.read_csv("tests.csv")
    table.to_csv("german.csv", sep=";", decimal=",", index=False, encoding="utf-8-sig")
    found = vision.compare(table=tmp_path / "german.csv")
    assert found.table["RH_percent"].to_numpy() == pytest.approx(table["RH_percent"])
    assert all("no single μ" in s or "differ by more than their" in s for s in found.warnings)
    in_order = vision.compare(six, table.drop(columns="run"))
    assert in_order.table["n_test"].tolist() == table["n_test"].tolist()
    with pytest.raises(InputError, match="`runs`"):
        vision.compare()


@pytest.mark.thorough
def test_force_recordings_go_all_the_way(tmp_path):
    """Two simulated recordings at two velocities, through `track force`: one μ, and single sticks drawn."""
    names = []
    for k, speed in enumerate((0.5, 1.0)):
        experiment = with_settings(
            Experiment(), {"mechanics.speed_mm_min": speed, "mechanics.d_end_mm": 15.0, "seed": k}
        )
        pull = simulate_pull(experiment.mechanics, seed=experiment.seed)
        write_force(tmp_path / f"v{k}.txt", force_recording(experiment, pull), experiment.force_file)
        with undrawn():
            assert run(["force", f"v{k}.txt", "--d0", f"{experiment.mechanics.d0_mm:g}", "--quiet"]) in (0, 1)
        names.append(f"v{k}_force")
    found = vision.compare(names)
    assert found.table["V_mm_min"].to_numpy() == pytest.approx([0.5, 1.0], rel=0.02)
    (joint,) = found.joint
    assert joint.mu.value == pytest.approx(Experiment().mechanics.mu, abs=0.004)
    figures = {figure.name: figure for figure in found.figures()}
    assert len(figures["sticks"].panels) == 2
    assert {arrow.label for arrow in figures["sticks"].panel.arrows} == {"Λ_st", "ΔF"}
    assert figures["sticks"].save(tmp_path / "sticks.png").stat().st_size > 5000
