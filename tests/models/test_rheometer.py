"""Rheometer files of known content, in every layout, and those that cannot be used."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.scenes.single_sheets import DiscTest, write_rheocompass, write_rheometer_csv
from vision.errors import InputError
from vision.models.rheometer import ROTATION, read_rheometer

TEST = DiscTest(loads_N=(0.2, 1.0), torque_noise_mN_m=0.0, normal_noise_N=0.0)
LAYOUTS = [
    {},
    {"encoding": "utf-8", "separator": ",", "torque_unit": "µN·m", "angle_unit": "°", "unit_rows": 1},
    {"encoding": "utf-8-sig", "separator": ",", "decimal": ","},
    {"separator": ";", "decimal": ",", "torque_unit": "N·m", "angle_unit": "rad"},
]


@pytest.mark.parametrize("layout", LAYOUTS, ids=["utf16-tab", "utf8-comma", "quoted", "semicolon"])
def test_every_layout_gives_the_same_numbers(tmp_path: Path, layout: dict[str, str]) -> None:
    """A failure means a unit, a decimal mark, a result or an interval is misread."""
    truth = write_rheocompass(tmp_path / "rheo.csv", TEST, **layout)
    found = read_rheometer(tmp_path / "rheo.csv")
    assert len(found) == len(truth) == 2
    for rotation, load in zip(found, truth["N_N"], strict=True):
        ROTATION.check(rotation)
        assert rotation.attrs["measurement"] == f"Friction {load:g} N, interval 2 to 3"
        angle = np.degrees(rotation["angle_rad"].to_numpy())
        assert angle[0] == 0
        assert angle[-1] == pytest.approx(125, abs=0.3)
        torque = 2 / 3 * TEST.friction(load, angle) * load * 0.025
        np.testing.assert_allclose(rotation["torque_N_m"], torque, rtol=2e-4, atol=1e-9)
        np.testing.assert_allclose(rotation["normal_force_N"], load, rtol=1e-6)
        assert rotation.attrs["notes"] == [
            f"left out: Friction {load:g} N, interval 1: no rotation (0° travelled)"
        ]


def test_utf16_without_a_byte_order_mark(tmp_path: Path) -> None:
    """A failure means that such an export passes for a binary file."""
    write_rheocompass(tmp_path / "with.csv", TEST)
    text = (tmp_path / "with.csv").read_text("utf-16")
    (tmp_path / "without.csv").write_bytes(text.encode("utf-16-le"))
    assert len(read_rheometer(tmp_path / "without.csv")) == 2


def test_turning_the_other_way_gives_the_same(tmp_path: Path) -> None:
    """A failure means the sense of rotation turns the friction coefficient negative."""
    write_rheometer_csv(tmp_path / "a.csv", TEST)
    table = pd.read_csv(tmp_path / "a.csv")
    table[["Torque (mN·m)", "Angle (°)"]] *= -1
    table.to_csv(tmp_path / "b.csv", index=False)
    one, other = (read_rheometer(tmp_path / name)[0] for name in ("a.csv", "b.csv"))
    pd.testing.assert_frame_equal(one, other, check_exact=False)


def _write(path: Path, head: str, rows: str = "0,0,0\n1,1,10\n2,2,20\n") -> Path:
    path.write_text(f"{head}\n{rows}", encoding="utf-8")
    return path


@pytest.mark.parametrize(
    "head",
    [
        "Time [s],Torque [µN·m],Angle [mrad]",
        "time_s,torque_µNm,angle_mrad",
        "t,Drehmoment in uN.m,Winkel (mrad)",
        "time_s,torque_µN_m,angle_mrad",
        "Time in s,Torque in µN m,Angle in mrad",
    ],
)
def test_names_and_units_of_plain_tables(tmp_path: Path, head: str) -> None:
    """A failure means a common way of writing a unit is not understood, or is off by a power of ten."""
    (rotation,) = read_rheometer(_write(tmp_path / "t.csv", head, "0,0,0\n1,5,100\n2,4,200\n"))
    np.testing.assert_allclose(rotation["torque_N_m"], [0, 5e-6, 4e-6])
    np.testing.assert_allclose(rotation["angle_rad"], [0, 0.1, 0.2])


def test_a_cut_export_says_so(tmp_path: Path) -> None:
    """A failure means a half-copied file passes for a whole one."""
    write_rheocompass(tmp_path / "rheo.csv", replace(TEST, loads_N=(1.0,)), encoding="utf-8")
    lines = (tmp_path / "rheo.csv").read_text("utf-8").splitlines()
    (tmp_path / "cut.csv").write_text("\n".join(lines[:-100]), encoding="utf-8")
    (rotation,) = read_rheometer(tmp_path / "cut.csv")
    assert any("announces" in line for line in rotation.attrs["warnings"])


@pytest.mark.parametrize(
    ("head", "rows", "message"),
    [
        ("Time [s],Force [N],Angle [mrad]", "0,0,0\n1,1,1\n", "a torque column"),
        ("Time [s],Torque,Angle [mrad]", "0,0,0\n1,1,100\n2,2,200\n", "found no unit; write it"),
        ("Time [s],Torque [lbf],Angle [mrad]", "0,0,0\n1,1,100\n2,2,200\n", '"\\[?lbf'),
        ("Time [s],Torque [mN·m],Speed", "0,0,0\n1,1,100\n2,2,200\n", "no deflection angle"),
        ("Time [s],Torque [mN·m],Angle [mrad]", "0,1,5\n1,1,5\n2,1,5\n", "no rotation"),
        ("Time [s],Torque [mN·m],Angle [mrad]", "", "no rotation|no rows"),
        ("", "", "an empty file"),
    ],
    ids=["no-torque", "no-unit", "odd-unit", "no-angle", "no-rotation", "no-rows", "empty"],
)
def test_bad_files_are_refused_in_one_line(tmp_path: Path, head: str, rows: str, message: str) -> None:
    """A failure means a traceback, or numbers from a file that holds none."""
    with pytest.raises(InputError, match=message) as caught:
        read_rheometer(_write(tmp_path / "t.csv", head, rows))
    assert "\n" not in str(caught.value)


def test_missing_and_binary_files(tmp_path: Path) -> None:
    """A failure means a wrong path or a spreadsheet ends in a traceback."""
    with pytest.raises(InputError, match="no such file"):
        read_rheometer(tmp_path / "gone.csv")
    (tmp_path / "a.xlsx").write_bytes(b"PK\x03\x04\x00\x00\x10" * 200)
    with pytest.raises(InputError, match="binary"):
        read_rheometer(tmp_path / "a.xlsx")


def test_long_lines_of_rubbish_take_no_time(tmp_path: Path) -> None:
    """A failure means a pattern that backtracks exponentially."""
    start = time.process_time()
    for times in (100, 20_000):
        rubbish = "Torque [mN·m], " + "((((" * times + "_in_in_in" * times + "\n" + "1,2,3" * times
        with pytest.raises(InputError):
            read_rheometer(_write(tmp_path / "t.csv", rubbish, ""))
    assert time.process_time() - start < 60  # 0.1 s here


def _without_torque(text: str) -> str:
    """A result's table without the column of torques."""
    rows = [line.split("\t") for line in text.splitlines()]
    place = next(row.index("Torque") for row in rows if "Torque" in row)
    table = [row[:place] + row[place + 1 :] if len(row) > place else row for row in rows]
    return "\n".join("\t".join(row) for row in table) + "\n"


@pytest.mark.parametrize(
    ("spoiled", "reason"),
    [
        (_without_torque, "no torque"),
        (lambda text: text.replace("[mN·m]", "[lbf·ft]"), "lbf·ft"),
        (lambda text: text.split("Interval data:")[0] + "\n", "no 'Interval data:'"),
        (lambda text: text.splitlines()[0] + "\n\n", "no interval with data"),
    ],
    ids=["no-torque", "odd-unit", "no-data", "empty"],
)
def test_a_result_that_cannot_be_used_costs_no_other(tmp_path: Path, spoiled, reason: str) -> None:
    """A failure means one bad result of a file loses the others, or is lost itself without a word."""
    write_rheocompass(tmp_path / "rheo.csv", replace(TEST, loads_N=(0.1, 0.5, 2.0)), encoding="utf-8")
    head, *results = (tmp_path / "rheo.csv").read_text("utf-8").split("Result:")
    results = ["Result:" + text for text in results]
    results[1] = spoiled(results[1])
    (tmp_path / "rheo.csv").write_text(head + "".join(results), encoding="utf-8")
    found = read_rheometer(tmp_path / "rheo.csv")
    assert [rotation.attrs["measurement"] for rotation in found] == [
        "Friction 0.1 N, interval 2 to 3",
        "Friction 2 N, interval 2 to 3",
    ]
    for rotation in found:
        (line,) = rotation.attrs["left_out"]
        assert line.startswith("Friction 0.5 N: ")
        assert reason in line


def test_two_results_of_one_name_are_two_measurements(tmp_path: Path) -> None:
    """A failure means that a second measurement is joined to the first where its angle happens to go on, or
    that joined intervals lose the number of the last one."""
    write_rheocompass(tmp_path / "rheo.csv", TEST)
    text = (tmp_path / "rheo.csv").read_text("utf-16")
    names = [f"Friction {load:g} N" for load in TEST.loads_N]
    for name in names:
        text = text.replace(name, "Friction")
    (tmp_path / "alike.csv").write_text(text, "utf-16")
    found = read_rheometer(tmp_path / "alike.csv")
    assert [rotation.attrs["measurement"] for rotation in found] == [
        f"Friction, interval 2 (no. {place} in the file) to 3" for place in (2, 5)
    ]


@pytest.mark.parametrize("angles", [("999,5", "1.000,5", "2.000,5"), ("999.5", "1,000.5", "2,000.5")])
def test_marks_between_thousands(tmp_path: Path, angles: tuple[str, ...]) -> None:
    """A failure means angles that are wrong by powers of ten, without a word."""
    rows = "".join(f"{k};1;{angle}\n" for k, angle in enumerate(angles))
    path = tmp_path / "marks.csv"
    path.write_text(f"Time [s];Torque [mN·m];Deflection Angle [mrad]\n{rows}", "utf-8")
    (rotation,) = read_rheometer(path)
    np.testing.assert_allclose(rotation["angle_rad"], [0, 0.001, 1.001])
