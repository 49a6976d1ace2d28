"""Runs whose events follow no model are compared or refused, never at the others' cost."""

import json

import numpy as np
import pandas as pd
import pytest

import vision
from tests.scenes.comparison import events, write_run
from vision.comparison.comparison import answers
from vision.errors import InputError

STRANGE = {
    "one separation": lambda t: t.assign(d_v_mm=14.0, d_p_mm=14.02),
    "equal peaks": lambda t: t.assign(F_p_N=100.0),
    "equal drops": lambda t: t.assign(dF_N=10.0),
    "equal stiffness without errors": lambda t: t.assign(K_N_per_mm=3000.0, K_err_N_per_mm=0.0),
    "stiffness beyond all sheets": lambda t: t.assign(K_N_per_mm=1e5),
    "stiffness that rises": lambda t: t.assign(K_N_per_mm=t["K_N_per_mm"].to_numpy()[::-1]),
    "peaks that rise": lambda t: t.assign(F_p_N=t["F_p_N"].to_numpy()[::-1]),
    "peaks below zero": lambda t: t.assign(F_p_N=t["F_p_N"] - 1000),
    "no errors of K": lambda t: t.drop(columns=["K_err_N_per_mm", "flag"]),
    "one huge drop": lambda t: t.assign(dF_N=t["dF_N"].where(t.index != 50, 1e6)),
    "slow slips": lambda t: t.assign(flag=np.where(t.index % 2, "slow", "slow+negative")),
    "six events": lambda t: t.iloc[:6],
    "tiny": lambda t: t.assign(F_p_N=1e-9 * t["F_p_N"], dF_N=1e-9 * t["dF_N"]),
}
REFUSED = ("one separation", "peaks that rise", "equal peaks", "tiny")


@pytest.mark.parametrize("name", STRANGE)
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_strange_events(name, tmp_path):
    """A failure means that one odd run costs the comparison of all."""
    odd = write_run(tmp_path / "odd", STRANGE[name](events(seed=1)))
    good = [write_run(tmp_path / f"good{k}", events(seed=k)) for k in range(2)]
    found = vision.compare([*good, odd])
    assert found.table["mu"].iloc[:2].to_numpy() == pytest.approx(0.89, abs=0.003)
    assert np.isfinite(found.table["mu_err"].iloc[:2]).all()
    for figure in found.figures():
        figure.save(tmp_path / f"{figure.name}.csv")
    assert (len(found.failures) == 1) == (name in REFUSED)
    try:
        vision.compare([odd])
    except InputError as error:
        assert "\n" not in str(error)


def test_flagged_events_are_named(tmp_path):
    """A failure means that nobody learns why none of the events can be used."""
    run = write_run(tmp_path / "odd", events(seed=1).assign(flag="oscillation"))
    with pytest.raises(InputError, match=r"found 0 of 144 \(flags: oscillation 144\)"):
        vision.compare([run])


@pytest.mark.thorough
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_random_events(tmp_path):
    """A failure means a traceback for numbers that some instrument will write one day."""
    rng = np.random.default_rng(0)
    for k in range(20):
        count = int(rng.integers(6, 60))
        table = pd.DataFrame(
            {
                name: 10.0 ** rng.uniform(-3, 4, count) if k % 2 else rng.uniform(1, 50, count)
                for name in ("F_p_N", "dF_N", "K_N_per_mm", "K_err_N_per_mm")
            }
        )
        d = np.sort(rng.uniform(0.5, 56, count))
        write_run(tmp_path / f"r{k}", table.assign(d_v_mm=d, d_p_mm=d + 0.01))
    found = vision.compare([tmp_path / f"r{k}" for k in range(20)])
    assert len(found.table) + len(found.failures) == 20
    assert len(found.failures) > 5
    found.to_json()
    found.figures()


def test_one_recording_counts_once(tmp_path):
    """A failure means errors that shrink because a test was tracked twice."""
    runs = [write_run(tmp_path / name, events(seed=1)) for name in ("first", "again")]
    other = write_run(tmp_path / "other", events(seed=2))
    found = vision.compare([*runs, other])
    assert found.table["run"].tolist() == ["first", "other"]
    (line,) = found.failures
    assert "that of first, which would count twice" in line
    unusable = write_run(tmp_path / "unusable", events(seed=1), d0_mm=None)
    found = vision.compare([unusable, runs[1], other])
    assert found.table["run"].tolist() == ["again", "other"]
    assert len(found.failures) == 1


def test_a_comparison_shows_its_results_and_takes_folders_alone(tmp_path):
    """A failure means a notebook full of tables of events, or a TypeError for analyses."""
    found = vision.compare([write_run(tmp_path / f"r{k}", events(seed=k)) for k in (1, 2)])
    assert repr(found).startswith("comparison of 2 tests\n  one μ of all tests: 0.8")
    assert len(repr(found)) < 1000 and "Y_eff" in found._repr_html_()
    with pytest.raises(InputError, match="`runs`: expected the paths of run folders, which `save_run`"):
        vision.compare([found])


def test_runs_without_an_initial_separation_are_refused(tmp_path):
    """A failure means that the machine's travel is compared as if it were the separation, or a traceback."""
    good = write_run(tmp_path / "good", events(seed=1))
    travel = write_run(tmp_path / "travel", events(seed=2), d0_mm=None)
    beyond = write_run(tmp_path / "beyond", events(seed=3).assign(d_v_mm=1616.0, d_p_mm=1616.01))
    found = vision.compare([good, travel, beyond])
    without, outside = found.failures
    assert "found no `d0_mm`" in without
    assert "between 0 and the length of the sheets, 57 mm; found d from 1616 to 1616 mm" in outside


def test_a_modulus_that_its_run_does_not_determine_counts_for_nothing(tmp_path):
    """A failure means that Y_eff of all tests is drawn to the number at which a fit stopped."""
    good = write_run(tmp_path / "good", events(seed=1))
    odd = write_run(tmp_path / "odd", STRANGE["stiffness that rises"](events(seed=2)))
    models = {"Y_eff_GPa": {"value": 2.385, "error": 0.0001}, "undetermined": ["Lambda_hat_mm", "Y_eff_GPa"]}
    (odd / "models.json").write_text(json.dumps(models))
    both, alone = vision.compare([odd, good]), vision.compare([odd])
    assert both.modulus_from == ("good",)
    assert both.modulus.value == pytest.approx(3.8, abs=0.1)
    assert any("K does not determine Y_eff in odd" in line for line in alone.warnings)
    (answer,) = (one for one in answers(alone) if one.what.startswith("Y_eff"))
    assert "not determined" in answer.value
    assert "±" not in answer.value


def test_a_test_has_the_same_friction_coefficient_as_its_run(tmp_path):
    """A failure means two values of μ for one test, in its run and in the comparison."""
    made = events(seed=1)
    made.loc[4:8, "F_p_N"] *= 1.1  # the largest are not the first
    span = {"fit_range_mm": [made["d_v_mm"].min(), made["d_v_mm"].max()]}
    found = vision.compare([write_run(tmp_path / "run", made, models=span)])
    assert found.table["events_used"].tolist() == [len(made)]
    assert not found.table["notes"].item()
    cut = vision.compare([write_run(tmp_path / "unfitted", made)])
    assert cut.table["events_used"].item() < len(made)
    assert "before the largest peaks" in cut.table["notes"].item()
