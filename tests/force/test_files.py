"""Every layout of a testing machine is read back to the numbers that were written."""

from __future__ import annotations

import sys
import time
import zipfile
from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path

import h5py
import numpy as np
import openpyxl
import pytest
from scipy.io import savemat

from tests.scenes.machine_files import LAYOUTS, LOAD, PULL, TIME, labview, labview_segments, written
from vision.data import ForceMetadata
from vision.errors import InputError
from vision.force import read_force
from vision.force.files import read_tables
from vision.force.recording import good_samples


@pytest.mark.parametrize("layout", LAYOUTS)
def test_layout_gives_back_the_numbers(layout: str, tmp_path: Path) -> None:
    """A failure means a unit, separator, decimal mark or column of that machine is misread."""
    force = read_force(written(tmp_path, *LAYOUTS[layout]), d0_mm=13)
    np.testing.assert_allclose(force["time_s"], TIME, atol=1e-4)
    np.testing.assert_allclose(force["load_N"], LOAD, rtol=1e-3)
    np.testing.assert_allclose(force["d_mm"], 13 + PULL, atol=2e-5)
    assert force.attrs["separation_from"] == "displacement"
    assert set(force["flag"].values) == {"ok"}


@pytest.mark.parametrize(("pause_s", "samples"), [(0.5, 40), (30.0, 20)])
def test_segments_of_labview_are_one_recording_or_several(
    pause_s: float, samples: int, tmp_path: Path
) -> None:
    """A failure means that the time between segments is lost, or that two tests are joined to one."""
    force = read_force(written(tmp_path, labview_segments("No", pause_s=pause_s)))
    good = good_samples(force)
    np.testing.assert_allclose(good["time_s"], (TIME + pause_s * (np.arange(40) // 20))[:samples], atol=1e-4)
    np.testing.assert_allclose(good["load_N"], LOAD[:samples])
    assert any("two recordings" in line for line in ForceMetadata.of(force).warnings) == (samples < 40)


def test_labview_without_units_assumes_that_of_the_load(tmp_path: Path) -> None:
    """A failure means that the load's unit is assumed silently."""
    force = read_force(written(tmp_path, labview(TIME, LOAD, PULL, x="One")))
    assert any("taken for N" in line for line in ForceMetadata.of(force).warnings)


def test_values_of_labview_over_another_axis_are_no_times(tmp_path: Path) -> None:
    """A failure means that frequencies are read as seconds."""
    text = labview(TIME, LOAD, PULL, x="One", tags="X_Dimension\tFrequency\tFrequency\t\n")
    with pytest.raises(InputError, match='a time column; found columns 1 "X_Value"'):
        read_force(written(tmp_path, text))


def test_channels_of_labview_at_different_times_are_refused(tmp_path: Path) -> None:
    """A failure means that loads are paired with positions of other times."""
    text = labview(TIME, LOAD, PULL, x="No").replace("0,100000\t0,100000", "0,100000\t0,200000")
    with pytest.raises(InputError, match='channels at the same times; found "Force" and "Position"'):
        read_force(written(tmp_path, text))


def test_an_empty_time_column_is_named_with_what_to_give(tmp_path: Path) -> None:
    """A failure means that nothing tells how to give the sampling rate of a recording without times."""
    lines = [f";{load:.3f};{pull:.6f}" for load, pull in zip(LOAD, PULL, strict=True)]
    text = "Time (s);Load (N);Position (mm)\n" + "\n".join(lines) + "\n"
    with pytest.raises(InputError, match=r'a time column; found columns 1 "Time" \[s\] \(empty\).*2000Hz'):
        read_force(written(tmp_path, text))


def test_quoted_decimal_commas_between_commas(tmp_path: Path) -> None:
    """A failure means that a spreadsheet exported with the settings of a German country cannot be read."""
    rows = [(TIME, 3), (LOAD, 3), (PULL, 6)]
    cells = [[f'"{v:.{digits}f}"'.replace(".", ",") for v in column] for column, digits in rows]
    lines = ['"Zeit (s)","Kraft (N)","Weg (mm)"', *map(",".join, zip(*cells, strict=True))]
    force = read_force(written(tmp_path, "\n".join(lines) + "\n"))
    np.testing.assert_allclose(force["time_s"], TIME, atol=1e-6)
    np.testing.assert_allclose(force["load_N"], LOAD, atol=1e-3)


@pytest.mark.parametrize("marks", [".,,", ",.,", ",,.", ",.."])
def test_columns_with_decimal_marks_of_their_own(tmp_path: Path, marks: str) -> None:
    """A failure means that 0.995, 1.000 in a file of decimal commas become 0.995 s and 1000 s."""
    time_s, load_N = np.arange(0, 4, 0.005), np.resize(LOAD - LOAD[0], 800)
    columns = (time_s, load_N, 2000 * time_s)
    cells = [[f"{v:.3f}".replace(".", mark) for v in one] for one, mark in zip(columns, marks, strict=True)]
    text = "\n".join(["Zeit (s);Kraft (N);Weg (um)", *map(";".join, zip(*cells, strict=True))])
    force = read_force(written(tmp_path, text + "\n"))
    np.testing.assert_allclose(force["time_s"], time_s, atol=1e-9)
    np.testing.assert_allclose(force["load_N"], load_N, atol=1e-3)
    np.testing.assert_allclose(force["d_mm"], 2 * time_s, atol=1e-6)


CLOCKS = {
    "midnight": ("Time", lambda t: clock(86398 + t)),
    "comma": ("Uhrzeit", lambda t: clock(45000 + t).replace(".", ",")),
    "german date": ("Zeit", lambda t: "10.01.2022 " + clock(45000 + t)),
    "iso": ("timestamp", lambda t: "2022-01-10T" + clock(45000 + t)),
    "noon": ("Time", lambda t: f"1/10/2022 {clock(43198 + t if t < 2 else t - 2, 12)} {'AP'[int(t >= 2)]}M"),
    "minutes": ("Time", lambda t: clock(3598 + t)[3:]),
    "durations": ("Time", lambda t: f"{t / 60:.9f} min"),
}


def clock(seconds: float, hours: int = 24) -> str:
    """A time of the day."""
    hour, rest = divmod(round(10 * seconds), 36000)
    return f"{hour % hours or hours % 24:02d}:{rest // 600:02d}:{rest % 600 / 10:04.1f}"


@pytest.mark.parametrize("form", CLOCKS)
def test_times_of_the_day_become_seconds(form: str, tmp_path: Path) -> None:
    """A failure means that a recording with clock times cannot be read, or jumps at midnight."""
    name, stamp = CLOCKS[form]
    lines = [f"{stamp(t)};{f:.3f};{x:.6f}" for t, f, x in zip(TIME, LOAD, PULL, strict=True)]
    text = f"{name};Load (N);Position (mm)\n" + "\n".join(lines) + "\n"
    force = read_force(written(tmp_path, text))
    np.testing.assert_allclose(force["time_s"] - force["time_s"][0], TIME, atol=1e-6)
    np.testing.assert_allclose(force["load_N"], LOAD)
    assert set(force["flag"].values) == {"ok"}


def test_a_coarse_clock_gives_way_to_elapsed_time(tmp_path: Path) -> None:
    """A failure means that whole seconds are taken where the machine also wrote tenths."""
    lines = [f"{clock(np.floor(t))},{t:.1f},{f:.3f}" for t, f in zip(TIME, LOAD, strict=True)]
    force = read_force(written(tmp_path, "Time,Elapsed Time (s),Load (N)\n" + "\n".join(lines) + "\n"))
    np.testing.assert_allclose(force["time_s"], TIME)


@pytest.mark.parametrize("mark", ["OL", "*******", "-1.#IND", "#DIV/0!", "9.9E+37"])
@pytest.mark.parametrize("separator", [",", "  "])
def test_marks_of_overflow_are_lost_samples(mark: str, separator: str, tmp_path: Path) -> None:
    """A failure means that such a line cuts the recording in two, or that its mark becomes a number."""
    cells = [[f"{t:9.4f}", f"{f:9.3f}", f"{x:9.6f}"] for t, f, x in zip(TIME, LOAD, PULL, strict=True)]
    cells[11][1] = mark
    text = separator.join(("Time (s)", "Load (N)", "Position (mm)"))
    force = read_force(written(tmp_path, "\n".join([text, *map(separator.join, cells)]) + "\n"))
    assert list(np.flatnonzero(force["flag"].values != "ok")) == [11]
    assert force["flag"].values[11] == "nan"
    np.testing.assert_allclose(force["load_N"].drop_isel(time_s=11), np.delete(LOAD, 11))


def test_facts_of_the_file_are_told(tmp_path: Path) -> None:
    """A failure means the run folder would not say how a recording was understood."""
    facts = ForceMetadata.of(read_force(written(tmp_path, *LAYOUTS["mpt"])))
    assert facts.layout == "MTS 793"
    assert facts.encoding == "utf-8"  # nothing in that file is outside ASCII
    assert (facts.separator, facts.decimal, facts.blocks) == ("tab", ",", "2 of 3")
    assert "load = Ch 1 Kraft [kN]" in facts.columns
    assert facts.notes == ["`d0_mm` not given: d counts from the crosshead's zero"]


def test_video_time_is_kept_apart_from_time(tmp_path: Path) -> None:
    """A failure means the camera's clock in an MTS file is lost or taken for the machine's."""
    force = read_force(written(tmp_path, *LAYOUTS["mts"]))
    np.testing.assert_allclose(force["video_time_s"], 0.999958 * TIME + 8.0853, atol=1e-4)


@pytest.mark.parametrize("version", ["5", "7.3"])
def test_matlab(version: str, tmp_path: Path) -> None:
    """A failure means .mat files, the only form of some public data, cannot be used."""
    path = tmp_path / "test.mat"
    if version == "5":
        savemat(path, {"t": TIME[:, None], "run": {"load_kN": LOAD / 1e3}, "note": "hello"})
    else:
        with h5py.File(path, "w") as file:
            file["t"], file["run/load_kN"] = TIME[None, :], LOAD[None, :] / 1e3
    force = read_force(path, speed_mm_min=1.2)
    np.testing.assert_allclose(force["load_N"], LOAD)
    np.testing.assert_allclose(force["d_mm"], TIME * 0.02)
    assert force.attrs["separation_from"] == "speed"


def _workbook(path: Path, sheets: dict[str, list[list[object]]]) -> Path:
    book = openpyxl.Workbook()
    book.remove(book.active)
    for title, rows in sheets.items():
        sheet = book.create_sheet(title)
        for row in rows:
            sheet.append(row)
    book.save(path)
    return path


START = datetime(2024, 5, 12, 23, 59, 58)  # two seconds before midnight
CELLS: dict[str, Callable[[float], object]] = {
    "numbers": lambda t: t,
    "text with decimal commas": lambda t: str(t).replace(".", ","),
    "dates": lambda t: START + timedelta(seconds=t),
    "times of day": lambda t: (START + timedelta(seconds=t)).time(),
    "durations": lambda t: timedelta(seconds=t),
}


@pytest.mark.parametrize("kind", CELLS)
def test_excel(kind: str, tmp_path: Path) -> None:
    """A failure means that a workbook as testing machines export it is refused, or read as other numbers.

    It has a worksheet of parameters and one of results before that of the recording.
    """
    words = kind.startswith("text")
    loads = [str(load / 1e3).replace(".", ",") if words else float(load / 1e3) for load in LOAD]
    rows = [["Probe 1"], ["Zeit", "Kraft", None, "Bemerkung"], ["" if kind == "dates" else "s", "kN"]]
    if kind not in ("numbers", "text with decimal commas"):
        rows[2][0] = None
    rows += [[CELLS[kind](float(t)), load] for t, load in zip(TIME, loads, strict=True)]
    peaks = [["Nr", "Fmax"], [None, "N"], [1, 28.1], [2, 28.2], [3, 28.0], [4, "#DIV/0!"]]
    sheets = {"Parameter": [["V", 1.2]], "Ergebnisse": peaks, "Probe 1": rows}
    path = _workbook(tmp_path / "test.xlsx", sheets)
    force = read_force(path, speed_mm_min=1.2)
    np.testing.assert_allclose(force["load_N"], LOAD)
    np.testing.assert_allclose(force["time_s"] - force["time_s"][0], TIME - TIME[0], atol=1e-5)


def test_the_worksheet_of_a_second_recording_is_named(tmp_path: Path) -> None:
    """A failure means that of a workbook of several specimens one is used, and it is not said which."""
    rows = [["Time (s)", "Load (N)"], *zip(TIME.tolist(), LOAD.tolist(), strict=True)]
    path = _workbook(tmp_path / "test.xlsx", {"A": rows, "Probe 2": rows})
    force = read_force(path, speed_mm_min=1.2)
    assert any("starts again at line 2 of worksheet Probe 2" in line for line in force.attrs["warnings"])


@pytest.mark.parametrize(
    ("rows", "found"),
    [([], "none"), ([["Load", "Time"], ["high", "early"]], "none"), ([[None] * 2000 + [1.0]], "2001")],
)
def test_excel_without_a_recording(rows: list[list[object]], found: str, tmp_path: Path) -> None:
    """A failure means a traceback for an empty workbook, one of text, or one that would take all memory."""
    with pytest.raises(InputError, match=found):
        read_force(_workbook(tmp_path / "test.xlsx", {"Data": rows}))


@pytest.mark.skipif(sys.platform != "linux", reason="there it is seen what is open")
def test_a_damaged_workbook_is_closed(tmp_path: Path) -> None:
    """A failure means that Windows does not let it be removed, or exported again."""
    from tests.scenes.windows import held

    whole, damaged = _workbook(tmp_path / "whole.xlsx", {"Data": [[0.1, 5.0]]}), tmp_path / "damaged.xlsx"
    with zipfile.ZipFile(whole) as parts, zipfile.ZipFile(damaged, "w") as out:
        for name in parts.namelist():
            out.writestr(name, "<" if name == "xl/workbook.xml" else parts.read(name))
    with pytest.raises(InputError, match="damaged") as caught:
        read_force(damaged)
    assert held(damaged) is None, caught  # which refers to everything that was in use


def test_excel_that_unpacks_to_more_than_it_may(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A failure means that a small file can fill the memory."""
    path = _workbook(tmp_path / "test.xlsx", {"Data": [[0.1 * n, 5.0] for n in range(1000)]})
    monkeypatch.setattr("vision.force.files._Most.mixed_bytes", 10_000)
    with pytest.raises(InputError, match="unpacked"):
        read_force(path)


def test_missing_or_damaged_files(tmp_path: Path) -> None:
    """A failure means a traceback for a wrong path or a broken .mat."""
    with pytest.raises(InputError, match="no such file"):
        read_force(tmp_path / "absent.txt")
    for damaged in ("not a mat file", "\x89HDF\r\n\x1a\n and no more"):
        path = tmp_path / "bad.mat"
        path.write_bytes(damaged.encode("latin-1"))
        with pytest.raises(InputError, match="MATLAB"):
            read_force(path)


def test_padded_cells_beside_words_are_read_soon(tmp_path):
    """A failure means that an aligned table with a column of words takes for ever."""
    cells = [", ".join(f"{v:>12.4f}" for v in (n / 100, 5.0, n / 60, 1.0, 2.0, 3.0, 4.0)) for n in range(100)]
    text = "Time (s), Load (N), Disp (mm), A, B, C, D, Status\n"
    file = tmp_path / "pad.csv"
    file.write_text(text + "".join(f"{line},          running \n" for line in cells))
    started = time.process_time()
    (table,) = read_tables(file)
    assert time.process_time() - started < 60  # 0.01 s here
    assert table.numbers.shape == (100, 8)
    assert np.allclose(table.numbers[:, 0], np.arange(100) / 100)


@pytest.mark.parametrize("separator", [",", ";", "\t", "   "])
@pytest.mark.parametrize("odd", ["", "nan", "remark"])
def test_the_fast_way_gives_what_the_careful_one_does(separator, odd, tmp_path, monkeypatch):
    """A failure means that numbers depend on which of the two ways read them."""
    rows = np.random.default_rng(0).normal(0, 50, (500, 3)).round(5)
    lines = [separator.join(map(str, row)) for row in rows.tolist()]
    if odd == "nan":
        lines[200] = separator.join(("1.5", "nan", "2"))
    elif odd:
        lines[200] = "a remark of the machine"
    file = tmp_path / "a.txt"
    head = [separator.join(("Time", "Load", "Position")), separator.join(("s", "N", "mm"))]
    file.write_text("\n".join(["Test 7", *head, *lines]) + "\n")
    fast = read_tables(file)
    monkeypatch.setattr("vision.force.files._read_plain", lambda path: None)
    slow = read_tables(file)
    assert [t.names for t in fast] == [t.names for t in slow]
    for one, other in zip(fast, slow, strict=True):
        assert (one.units, one.facts) == (other.units, other.facts)
        assert np.array_equal(one.numbers, other.numbers, equal_nan=True)


def test_commas_between_columns_and_in_numbers_are_refused(tmp_path: Path) -> None:
    """A failure means columns of halved numbers, and advice about a threshold."""
    rows = "\n".join(f"{n // 10},{n % 10},{n % 7},5,0,{n:03d}" for n in range(40))
    path = tmp_path / "pull.csv"
    path.write_text(f"time (s),load (N),crosshead (mm)\n{rows}\n", encoding="utf-8")
    with pytest.raises(InputError, match="3 names above 6 cells"):
        read_force(path)
    path.write_text(path.read_text(encoding="utf-8").replace(",5,", ".5,"), encoding="utf-8")
    read_tables(path)  # a decimal point: these are columns without a name


def test_an_empty_row_of_units_hides_no_names(tmp_path: Path) -> None:
    """A failure means that columns have to be given by hand though the file names them."""
    rows = "\n".join(f"{n / 10:.1f},{n / 600:.4f},{n % 7}.5" for n in range(40))
    path = tmp_path / "pull.csv"
    for ending in ("", "\na remark\n1.0,2.0,3.0"):  # read by pandas at once, and line by line
        path.write_text(f"Time,Extension,Load\n,,\n{rows}{ending}\n", encoding="utf-8")
        (table, *_) = read_tables(path)
        assert table.names == ("Time", "Extension", "Load")
        assert table.units == ("", "", "")


@pytest.mark.parametrize("separator", ["\t", ";", "  "])
def test_points_between_thousands_are_no_decimal_points(separator: str, tmp_path: Path) -> None:
    """A failure means that a time of whole milliseconds, 995, 1.000, 1.005, starts again every second."""
    time, load = 5 * np.arange(900), 100_000 + 7 * np.arange(900)
    numbers = [
        separator.join(f"{n:,}".replace(",", ".") for n in row) for row in zip(time, load, strict=True)
    ]
    path = tmp_path / "force.txt"
    path.write_text("\n".join([separator.join(["Zeit (ms)", "Kraft (mN)"]), *numbers]), encoding="utf-8")
    (table,) = read_tables(path)
    np.testing.assert_array_equal(table.numbers, np.column_stack([time, load]))
    decimal = [
        separator.join([f"{t / 1000:.3f}", f"{n / 1000:.3f}"]) for t, n in zip(time, load, strict=True)
    ]
    path.write_text("\n".join([separator.join(["Zeit (s)", "Kraft (N)"]), *decimal]), encoding="utf-8")
    (table,) = read_tables(path)
    np.testing.assert_allclose(table.numbers, np.column_stack([time, load]) / 1000)
    mixed = [
        f"{n:,}".replace(",", ".") + f"{separator}{t / 1000:.3f}" for n, t in zip(time, load, strict=True)
    ]
    path.write_text("\n".join(mixed), encoding="utf-8")
    (table,) = read_tables(path)  # 100.000 may be either
    mixed = [f"{row}{separator}0.25" for row in mixed]
    path.write_text("\n".join(mixed), encoding="utf-8")
    with pytest.raises(InputError, match="points between thousands in column 1, decimal points in column 3"):
        read_tables(path)
