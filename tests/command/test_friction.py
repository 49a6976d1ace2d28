"""`track friction` from files to a run folder."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest

from tests.scenes.single_sheets import DiscTest, write_rheocompass, write_rheometer_csv
from vision.command.main import run

COLUMNS = ["file", "measurement", "N_N", "mu_s", "mu_s_err", "mu_d", "mu_d_err"]
TEST = DiscTest(loads_N=(0.1, 0.5, 2.0))


def test_run_folder(capsys: pytest.CaptureFixture[str]) -> None:
    """A failure means a script that reads the run folder by its agreed names breaks."""
    truth = write_rheocompass("rheo.csv", TEST)
    assert run(["friction", "rheo.csv"]) == 0
    out = Path("rheo_friction")
    table = pd.read_csv(out / "friction.csv")
    assert list(table.columns[:7]) == COLUMNS
    assert table["file"].tolist() == ["rheo.csv"] * 3
    assert table["mu_s"].to_numpy() == pytest.approx(truth["mu_s"].to_numpy(), rel=0.01)
    law = json.loads((out / "friction.json").read_text("utf-8"))
    assert {"a", "a_err", "b_N", "b_err_N", "chi2_dof"} <= law.keys()
    assert law["a"] == pytest.approx(0.507, abs=4 * law["a_err"])
    assert law["thresholds_equal_at_N"] == pytest.approx(0.189, abs=0.01)
    told = json.loads((out / "run.json").read_text("utf-8"))
    assert told["parameters"]["radius"] == {"value": 25.0, "how": "default"}
    assert len(told["inputs"][0]["sha256"]) == 64
    assert (out / "friction.png").stat().st_size > 10_000
    printed = capsys.readouterr()
    assert "0.75 times the true" in printed.out
    assert printed.err == ""


def test_a_copy_of_a_file_does_not_count_twice(capsys: pytest.CaptureFixture[str]) -> None:
    """A failure means that errors shrink by a factor of 1.4 where a pattern matches a file and its copy."""
    write_rheocompass("rheo.csv", TEST)
    Path("rheo (1).csv").write_bytes(Path("rheo.csv").read_bytes())
    assert run(["friction", "rheo*.csv", "--out", "two"]) == 1
    assert "rheo.csv: expected a file of other measurements; found the content of rheo (1).csv" in (
        capsys.readouterr().err
    )
    assert run(["friction", "rheo.csv", "--out", "one"]) == 0
    errors = [json.loads(Path(name, "friction.json").read_text("utf-8"))["a_err"] for name in ("one", "two")]
    assert errors[0] == pytest.approx(errors[1])


def test_files_that_fail_are_named_and_the_rest_is_done(capsys: pytest.CaptureFixture[str]) -> None:
    """A failure means one bad file costs the others, or goes unnoticed."""
    write_rheocompass("rheo.csv", TEST)
    write_rheometer_csv("bare.csv", TEST, load_N=0.5, normal=False)
    Path("bad.csv").write_text("Time (s),Force (N)\n1,2\n2,3\n")
    assert run(["friction", "rheo.csv", "bare.csv", "bad.csv", "gone.csv", "--out", "all"]) == 1
    error = capsys.readouterr().err
    assert "bare.csv" in error
    assert "give --normal-force" in error
    assert "bad.csv: expected a torque column" in error
    assert "gone.csv" in error
    assert error.count("\n") == 3
    assert len(pd.read_csv("all/friction.csv")) == 3
    assert len(json.loads(Path("all/run.json").read_text("utf-8"))["failures"]) == 3


def test_a_bad_result_of_a_file_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    """A failure means a result without a known unit goes unnoticed, or takes its neighbours with it."""
    write_rheocompass("rheo.csv", TEST, encoding="utf-8")
    head, first, second, third = Path("rheo.csv").read_text("utf-8").split("Result:")
    spoiled = "Result:".join([head, first, second.replace("[mN·m]", "[lbf·ft]"), third])
    Path("rheo.csv").write_text(spoiled, encoding="utf-8")
    assert run(["friction", "rheo.csv"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "rheo.csv: Friction 0.5 N: " in line
    assert "lbf·ft" in line
    assert len(pd.read_csv("rheo_friction/friction.csv")) == 2
    assert len(json.loads(Path("rheo_friction/run.json").read_text("utf-8"))["failures"]) == 1


def test_normal_force_told_for_all_or_for_each() -> None:
    """A failure means the load of one file is used for another."""
    for name, load in (("a.csv", 0.5), ("b.csv", 2.0)):
        write_rheometer_csv(name, TEST, load_N=load, normal=False)
    assert run(["friction", "a.csv", "b.csv", "--normal-force", "0.5,2", "--out", "each"]) == 0
    assert pd.read_csv("each/friction.csv")["mu_d"].to_numpy() == pytest.approx([0.44, 0.44], rel=0.01)
    assert run(["friction", "a.csv", "b.csv", "--normal-force", "0.5", "--out", "same"]) == 0
    assert pd.read_csv("same/friction.csv")["mu_d"].to_numpy() == pytest.approx([0.44, 1.76], rel=0.01)


def test_one_load_gives_coefficients_and_no_law(capsys: pytest.CaptureFixture[str]) -> None:
    """A failure means a law through one point, or no table where there is none."""
    write_rheometer_csv("one.csv", TEST, load_N=0.5)
    assert run(["friction", "one.csv", "--quiet"]) == 0
    assert "no law fitted" in capsys.readouterr().err
    assert json.loads(Path("one_friction/friction.json").read_text("utf-8"))["a"] is None


@pytest.mark.parametrize(
    "arguments",
    [
        ["friction"],
        ["friction", "bad.csv"],
        ["friction", "gone.csv"],
        ["friction", "rheo.csv", "--normal-force", "0.1,0.2"],
        ["friction", "rheo.csv", "--normal-force", "-1"],
        ["friction", "rheo.csv", "--dynamic", "120:0.3"],
        ["friction", "rheo.csv", "--radius", "0"],
        ["friction", "rheo.csv", "--mu", "nan"],
        ["friction", "rheo.csv", "--mu=-1"],
    ],
)
def test_bad_input_is_one_line_and_writes_nothing(arguments: list[str], refused: Callable[..., str]) -> None:
    """A failure means a traceback, several lines, or half a run folder."""
    write_rheometer_csv("rheo.csv", TEST, load_N=0.5)
    Path("bad.csv").write_text("a,b\n1,2\n")
    refused(*arguments)
