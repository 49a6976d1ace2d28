"""`track force` from a file to a run folder."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.scenes.sawtooth import Test, realistic
from vision.command.main import run
from vision.figures.figure import load_figures
from vision.force import find_stick_slip
from vision.models import fit_models

pytestmark = pytest.mark.usefixtures("without_pictures")

COLUMNS = (
    "event,t_v_s,t_p_s,d_v_mm,d_p_mm,F_v_N,F_p_N,dF_N,stick_length_um,slip_length_um,K_N_per_mm,"
    "K_err_N_per_mm"
)


def force(file: Path, *options: str) -> int:
    """Exit status of `track force`."""
    return run(["force", str(file), *options])


@pytest.fixture(scope="module")
def test() -> Test:
    return realistic(d1=15.5, noise=0.2)


@pytest.fixture
def file(test: Test, tmp_path: Path) -> Path:
    """The test as an MTS recording whose crosshead starts at 0, in a fresh working directory."""
    time, load, d = (test.force[name].to_numpy() for name in ("time_s", "load_N", "d_mm"))
    rows = "\n".join(f"{a:.6f}\t{b:.3f}\t{c:.4f}" for a, b, c in zip(d - 13, load, time, strict=True))
    path = tmp_path / "pull.txt"
    path.write_text(f"Crosshead \tLoad \tTime \t\nmm\tN\tsec\n{rows}\n", encoding="utf-8-sig")
    return path


def test_events_of_a_recording_give_back_the_models(test: Test) -> None:
    """A failure means detection and measurement bend the physics that the fits then find."""
    recorded = fit_models(test.force, find_stick_slip(test.force)).amplitude
    assert abs(recorded.value - 0.34) < 0.03 * 0.34 + recorded.systematic_error
    fits = fit_models(test.force, find_stick_slip(test.force, lowpass_s="auto"))
    assert fits.mu.value == pytest.approx(0.89, abs=0.003)
    assert fits.t0_N.value == pytest.approx(0, abs=0.6)
    assert fits.amplitude.value == pytest.approx(0.34, rel=0.03)
    assert fits.n_hat_N.value == pytest.approx(0.57, rel=0.03)
    assert fits.modulus_GPa.value == pytest.approx(3.8, rel=0.02)


@pytest.mark.thorough
def test_what_the_low_pass_takes_from_the_peaks_is_in_the_errors() -> None:
    """A low-pass of 3 ms moves μ by more than its other errors: a failure means that none of them says so."""
    made = realistic(d1=18, noise=0.05).force
    recorded, corrected = (fit_models(made, find_stick_slip(made, lowpass_s=how)) for how in (0.0, "auto"))
    for name in ("mu", "T0_N", "N_hat_N"):
        moved = abs(corrected.named()[name].value - recorded.named()[name].value)
        assert moved > 0.9 * recorded.named()[name].error
        assert recorded.budget["low_pass"][name] == pytest.approx(moved, rel=0.3)
    assert "low_pass" not in corrected.budget


@pytest.mark.parametrize("tau", [0.05, 0.1])
def test_what_the_low_pass_takes_from_the_stiffness_is_in_the_errors(tau: float) -> None:
    """A failure means Λ̂ and N̂ are off by several errors in a recording behind a slow amplifier."""
    made = realistic(d1=14.2, noise=0.1, tau=tau).force
    fits = fit_models(made, find_stick_slip(made))
    scale = 2 * 0.89 * 0.1 * 25**2 / np.log(1 + 2 * 0.89 * 0.57 / 0.003)
    for name, truth in (("Lambda_hat_mm", scale), ("N_hat_N", 0.57), ("Y_eff_GPa", 3.8)):
        found = fits.named()[name]
        off = abs(found.value - truth)
        assert off < 2 * np.hypot(found.error, found.systematic_error), name
        others = [errors[name] or 0.0 for source, errors in fits.budget.items() if source != "low_pass"]
        assert off > 3 * np.hypot(found.error, np.hypot(*others)), name


@pytest.mark.parametrize("mean_s", [0.05, 0.1])
def test_what_a_moving_mean_takes_from_the_drops_is_in_the_errors(mean_s: float) -> None:
    """A failure means that A is off by four to eight errors in a load that the amplifier averages."""
    made = realistic(d1=14.2, noise=0.1, tau=0.0).force
    width = round(200 * mean_s) + 1
    load = np.pad(made["load_N"].to_numpy(), (width - 1, 0), "edge")
    made = made.assign(load_N=("time_s", np.convolve(load, np.full(width, 1 / width), "valid")))
    fits = fit_models(made, find_stick_slip(made))
    off = abs(fits.amplitude.value - 0.34)
    assert off > 0.05 * 0.34
    others = [errors["A"] or 0.0 for source, errors in fits.budget.items() if source != "filter"]
    assert off > 3 * np.hypot(fits.amplitude.error, np.hypot.reduce(others))
    assert off < 2 * np.hypot(fits.amplitude.error, fits.amplitude.systematic_error)
    assert fits.amplitude.systematic_error < 2 * off


@pytest.mark.thorough
def test_a_run_folder_is_complete_and_kept(
    file: Path, test: Test, capsys: pytest.CaptureFixture[str]
) -> None:
    """A failure means a script that reads the run folder by its agreed names breaks, or that results are
    lost without --overwrite."""
    assert force(file, "--d0", "13") == 0
    folder = Path("pull_force")
    events = pd.read_csv(folder / "events.csv")
    assert ",".join(events.columns).startswith(COLUMNS)
    assert len(events) == len(test.truth)
    np.testing.assert_allclose(events["d_v_mm"], test.truth["d_v_mm"], atol=2e-3)
    models = json.loads((folder / "models.json").read_text(encoding="utf-8"))
    assert models["mu"]["value"] == pytest.approx(0.89, abs=0.003)
    for name in ("mu", "T0_N", "A", "N_hat_N", "Y_eff_GPa", "Lambda_hat_mm"):
        assert set(models[name]) >= {"value", "error", "systematic_error"}, name
    assert 0 < models["events_used"] <= len(events)
    assert 13 <= models["fit_range_mm"][0] < models["fit_range_mm"][1] <= 15.6
    assert {"chi2_dof", "sample"} <= set(models)
    facts = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    assert facts["parameters"]["d0"] == {"value": 13, "how": "given"}
    assert {"out", "overwrite", "quiet", "config"} <= set(facts["parameters"])
    assert "give --d0 with its error" in " ".join(models["notes"])  # not the argument of Python
    assert facts["force"]["separation_from"] == "displacement"
    assert len(facts["inputs"][0]["sha256"]) == 64
    assert (folder / "force.png").is_file()
    assert "μ 0.89" in capsys.readouterr().out
    before = (folder / "run.json").read_bytes()
    assert force(file, "--d0", "13", "--quiet") == 2
    assert "--overwrite" in capsys.readouterr().err
    assert (folder / "run.json").read_bytes() == before
    assert force(file, "--d0", "13", "--quiet", "--overwrite") == 0


def force_axis() -> str:
    """The label below F(d)."""
    figures = {figure.name: figure for figure in load_figures("pull_force/figures.npz")}
    return figures["force"].panel.x_label


def test_without_d0_there_are_events_and_no_models(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A failure means the models are fitted to separations that are not known."""
    assert force(file) == 1
    said, complained = capsys.readouterr()
    assert "models     none" in said and "give --d0" in said
    assert "warning: the initial separation is not known" in complained
    assert "mu" not in json.loads(Path("pull_force/models.json").read_text(encoding="utf-8"))
    assert force_axis() == "distance the machine moved (mm)"
    force(file, "--d0", "0", "--overwrite")  # the displacement is the separation itself
    assert "initial separation is not known" not in capsys.readouterr().err
    assert force_axis() == "d (mm)"


@pytest.mark.thorough
def test_without_speed_or_displacement(file: Path, test: Test, capsys: pytest.CaptureFixture[str]) -> None:
    """A failure means a missing speed is guessed, or costs the events that need none."""
    bare = Path("bare.csv")
    pd.DataFrame({"time (s)": test.force["time_s"], "load (N)": test.force["load_N"]}).to_csv(
        bare, index=False
    )
    assert force(bare, "--d0", "13") == 1
    assert "no --speed" in capsys.readouterr().err
    events = pd.read_csv("bare_force/events.csv")
    assert len(events) == len(test.truth)
    assert events["stick_length_um"].isna().all()
    assert force(bare, "--d0", "13", "--speed", "1", "--out", "with_speed", "--quiet") == 0


def test_nothing_is_written_for_bad_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A failure means half a run folder, or a traceback, for a recording without slips."""
    time = np.arange(2000) * 0.01
    load = 10 + time + np.random.default_rng(0).normal(0, 0.1, time.size)
    pd.DataFrame({"time (s)": time, "load (N)": load}).to_csv("ramp.csv", index=False)
    assert force(Path("ramp.csv")) == 2
    assert "ramp.csv: expected at least two slips" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ramp.csv"]


def test_errors_of_the_geometry_enter_the_systematic_errors(
    file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """μ goes as 1/ε, Y_eff as 1/(εW): a failure means ± is read and forgotten, or of the wrong size."""
    options = ["--thickness", "0.1±0.002", "--width", "45+-0.9", "--length", "57", "--t-star", "0.003±0.0003"]
    assert force(file, "--d0", "13.0±0", *options, "--out", "with") == 0
    found = json.loads(Path("with/models.json").read_text())
    budget = found["budget"]
    assert set(budget) == {"d0", "load_drift", "low_pass", "thickness_mm", "width_mm", "t_star_N"}
    assert budget["thickness_mm"]["mu"] == pytest.approx(0.02 * found["mu"]["value"], rel=0.1)
    assert budget["width_mm"]["Y_eff_GPa"] == pytest.approx(0.02 * found["Y_eff_GPa"]["value"], rel=0.1)
    assert budget["width_mm"]["mu"] == pytest.approx(0, abs=1e-6)
    assert found["mu"]["systematic_error"] >= budget["thickness_mm"]["mu"]
    Path("run.toml").write_text(
        "d0 = '13.0±0'\n[sample]\nthickness = '0.1±0.002'\nwidth = 45.0\n", encoding="utf-8"
    )
    assert force(file, "--config", "run.toml", "--out", "filed") == 0
    filed = json.loads(Path("filed/models.json").read_text())
    assert filed["budget"]["thickness_mm"] == pytest.approx(budget["thickness_mm"])
    assert "width_mm" not in filed["budget"]
    assert "assumed" not in capsys.readouterr().out


def test_a_thickness_that_is_none_is_one_line(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A failure means a typing error in the geometry becomes a modulus, or a traceback."""
    for option, text in (("--thickness", "0.1±x"), ("--t-star", "0±0.1"), ("--width", "wide")):
        assert force(file, "--d0", "13", option, text) == 2
        line = capsys.readouterr().err
        assert line.count("\n") == 1
        assert option in line
