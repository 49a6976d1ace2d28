"""`track modulus` from a recording to a run folder."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.scenes.single_sheets import CyclesTest, write_cycles
from vision.command.main import run

COLUMNS = ["cycle", "k_N_per_mm", "k_err_N_per_mm", "F0_N", "F0_err_N", "Y_p_GPa", "Y_p_err_GPa"]


def test_run_folder(capsys: pytest.CaptureFixture[str]) -> None:
    """A failure means a script that reads the run folder by its agreed names breaks."""
    write_cycles("sheet.txt", CyclesTest())
    assert run(["modulus", "sheet.txt"]) == 0
    out = Path("sheet_modulus")
    cycles = pd.read_csv(out / "cycles.csv")
    assert list(cycles.columns[:7]) == COLUMNS
    assert len(cycles) == 5
    mean = json.loads((out / "modulus.json").read_text("utf-8"))["Y_p_GPa"]
    assert mean["value"] == pytest.approx(2.5, abs=0.005)
    assert 0 < mean["error"] < mean["scatter"]
    told = json.loads((out / "run.json").read_text("utf-8"))
    assert told["parameters"]["length"] == {"value": 16.8, "how": "default"}
    assert any("the publication's size" in line for line in told["notes"])
    assert (out / "modulus.png").stat().st_size > 10_000
    assert re.search(r"Y_p = \|F0\|/\(εW\) 2.4997.* GPa, scatter [\d.]+ GPa\n", capsys.readouterr().out)


def test_another_sheet_and_a_soft_machine() -> None:
    """A failure means an option does not reach the measurement."""
    write_cycles("sheet.txt", CyclesTest(machine_stiffness_N_per_mm=5000.0))
    assert run(["modulus", "sheet.txt", "--machine-stiffness", "5000", "--thickness", "0.2", "--quiet"]) == 0
    content = json.loads(Path("sheet_modulus/modulus.json").read_text("utf-8"))
    assert content["k_N_per_mm"]["value"] == pytest.approx(669.6, rel=0.003)
    assert content["Y_slope_GPa"]["value"] == pytest.approx(1.25, rel=0.003)
    assert content["sheet"]["thickness_mm"] == 0.2


def test_a_size_with_its_error(capsys: pytest.CaptureFixture[str]) -> None:
    """A failure means that a size as `track` takes it is refused, or that its error is lost."""
    write_cycles("sheet.txt", CyclesTest())
    assert run(["modulus", "sheet.txt", "--thickness", "0.1±0.002", "--width", "45+-0.3"]) == 0
    content = json.loads(Path("sheet_modulus/modulus.json").read_text("utf-8"))
    assert content["Y_p_GPa"]["systematic_error"] == pytest.approx(2.5 * np.hypot(0.02, 0.3 / 45), rel=0.01)
    assert content["sheet"] == {"thickness_mm": 0.1, "width_mm": 45.0, "length_mm": 16.8}
    assert content["sheet_err"] == {"thickness_mm": 0.002, "width_mm": 0.3}
    assert "(stat.) ± 0.0527 (syst.) GPa" in capsys.readouterr().out
    assert run(["modulus", "sheet.txt", "--thickness", "0,1", "--out", "again"]) == 2
    assert (
        "--thickness: expected a number of mm from 0, or with its smaller error; found '0,1'"
        in capsys.readouterr().err
    )


@pytest.mark.parametrize("option", [["--thickness", "100"], ["--width", "0.045"], ["--length", "16800"]])
def test_a_size_in_another_unit(option: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    """A failure means that a thickness in µm gives a modulus of no material, and nothing is said."""
    write_cycles("sheet.txt", CyclesTest())
    assert run(["modulus", "sheet.txt", *option]) == 1
    assert "check --thickness, --width and --length (mm)" in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments",
    [
        ["modulus", "gone.txt"],
        ["modulus", "pull.csv"],
        ["modulus", "bare.csv"],
        ["modulus", "sheet.txt", "--part", "0.9:0.4"],
        ["modulus", "sheet.txt", "--thickness", "0"],
        ["modulus", "sheet.txt", "--machine-stiffness", "100"],
    ],
)
def test_bad_input_is_one_line_and_writes_nothing(arguments: list[str], refused: Callable[..., str]) -> None:
    """A failure means a traceback, several lines, or half a run folder."""
    write_cycles("sheet.txt", CyclesTest(cycles=2))
    time = np.arange(500) * 0.1
    pull = pd.DataFrame({"time (s)": time, "load (N)": time, "displacement (mm)": time / 60})
    pull.to_csv("pull.csv", index=False)
    pull.drop(columns="displacement (mm)").to_csv("bare.csv", index=False)
    refused(*arguments)


@pytest.mark.parametrize("command", ["modulus", "force", "friction"])
def test_another_commands_results_are_not_replaced(command: str, refused: Callable[..., str]) -> None:
    """A failure means that one wrong --out with --overwrite costs the run of a film."""
    write_cycles("sheet.txt", CyclesTest())
    Path("film_tracks").mkdir()
    Path("film_tracks/run.json").write_text('{"frames": {"read": 5}}')
    assert "another run; give another --out" in refused(
        command, "sheet.txt", "--out", "film_tracks", "--overwrite"
    )


@pytest.mark.parametrize(("share", "unknown"), [(0.3, ["drifting"]), (0.2, ["drifting", "loop"])])
def test_a_recording_that_ends_within_a_cycle(
    share: float, unknown: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    """A failure means a drift of −25 N since the last peak was not reached, a quarter of the energy lost in a
    cycle, or "nan N"."""
    write_cycles("sheet.txt", CyclesTest())
    lines = Path("sheet.txt").read_text("utf-8").splitlines()
    Path("cut.txt").write_text("\n".join(lines[: int(share * len(lines))]), "utf-8")
    run(["modulus", "cut.txt"])
    printed = capsys.readouterr().out
    assert "peak 54" in printed
    assert [word for word in ("drifting", "loop", "nan") if word in printed] == [
        word for word in ("drifting", "loop") if word not in unknown
    ]
