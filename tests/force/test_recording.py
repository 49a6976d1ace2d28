"""Every layout of a testing machine is read back to the numbers that were written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from vision.errors import InputError
from vision.force.columns import parse_columns
from vision.force.recording import read_force

TIME = np.arange(40) * 0.1
LOAD = 20 + np.arange(40) * 0.5
PULL = np.arange(40) * 0.002


def rows(*columns: np.ndarray, sep: str = "\t", decimal: str = ".", quote: str = "") -> str:
    lines = [sep.join(f"{quote}{value:.6f}{quote}" for value in row) for row in zip(*columns, strict=True)]
    return "\n".join(lines).replace(".", decimal) + "\n"


MTS = (
    "File Path: C:\\DAQ- Crosshead, … - (Timed).txt\n"
    "Test: MTS EM Tension (Simplified) with Video Extensometer 5\n"
    "Test Run: 3\nDate: 1/10/2022 12:52:17 PM\n\n\n"
    "Crosshead \tLoad \tTime \tStrain 1 \tVideo Time \t\nmm\tN\tsec\tmm/mm\tsec\n"
) + rows(PULL, LOAD, TIME, TIME * 0 - 5.38e-6, 0.999958 * TIME + 8.0853)
MTS_CSV = '"Crosshead ","Load ","Time "\n"mm","N","sec"\n' + rows(PULL, LOAD, TIME, sep=",")
MTS_FRENCH = "Traverse \tForce \tTemps \t\nmm\tN\ts\n" + rows(PULL, LOAD, TIME, decimal=",")
MPT_HEAD = "Datum\tLaufzeit\tCh 1 Kraft Sollwert\tCh 1 Kraft\tCh 1 Weg\nd\ts\tkN\tkN\tmm\n"
MPT_BLOCK = "\nDatenerfassung\t\t\t\t\t\tZeit:\t544,35547\ts\t22.07.2014 07:28:27\n" + MPT_HEAD
DAYS = np.full(20, 41842.0)
MPT = (
    "MTS793|MPT|DEU|1|2|,|.|:|49|1|1|A\n"
    + MPT_BLOCK
    + rows(DAYS, TIME[:20], LOAD[:20] / 900, LOAD[:20] / 1e3, PULL[:20], decimal=",")
    + "\nSpitzenwerte\nZyklus\tMax Kraft\n-\tkN\n"
    + rows(TIME[:5], TIME[:5], decimal=",")
    + MPT_BLOCK
    + rows(DAYS, TIME[20:], LOAD[20:] / 900, LOAD[20:] / 1e3, PULL[20:], decimal=",")
)
INSTRON = 'Maximum Load : Maximum Load,"131.18347",lbf\n\nTime,Extension,Load\n(s),(in),(lbf)\n' + rows(
    TIME, PULL / 25.4, LOAD / 4.4482216152605, sep=",", quote='"'
)
INSTRON_UNIVERSAL = "Time;Displacement;Force\n(s);(mm);(kN)\n" + rows(
    TIME, PULL, LOAD / 1e3, sep=";", decimal=","
)
ZWICK = (
    '"Épaisseur éprouvette",1,"mm"\n"Temps","Traverse absolue","Force standard","Course standard"\n'
    '"s","mm","N","mm"\n'
) + rows(TIME, PULL - 794.864, LOAD, PULL, sep=",")
SPANISH = "Tiempo (ms);Fuerza (kgf);Desplazamiento (µm)\n" + rows(
    TIME * 1e3, LOAD / 9.80665, PULL * 1e3, sep=";", decimal=","
)
SNAKE = "time_s,load_mN,crosshead_cm\n" + rows(TIME, LOAD * 1e3, PULL / 10, sep=",")
SPACES = "# t / min   Kraft in N   Weg / m\n" + rows(TIME / 60, LOAD, PULL / 1e3, sep="   ")

LAYOUTS = {
    "mts": (MTS, "utf-8-sig", "\r\n"),
    "mts-utf16": (MTS, "utf-16", "\r\n"),
    "mts-csv": (MTS_CSV, "utf-8", "\n"),
    "mts-french": (MTS_FRENCH, "utf-8-sig", "\r\n"),
    "mpt": (MPT, "latin-1", "\r\n"),
    "instron": (INSTRON, "utf-8", "\n"),
    "instron-universal": (INSTRON_UNIVERSAL, "utf-8", "\r\n"),
    "zwick": (ZWICK, "latin-1", "\r\n"),
    "spanish": (SPANISH, "latin-1", "\n"),
    "snake": (SNAKE, "utf-8", "\n"),
    "spaces": (SPACES, "utf-8", "\n"),
}


def written(
    folder: Path, text: str, encoding: str = "utf-8", newline: str = "\n", name: str = "test.txt"
) -> Path:
    path = folder / name
    path.write_bytes(text.replace("\n", newline).encode(encoding, errors="replace"))
    return path


@pytest.mark.parametrize("layout", LAYOUTS)
def test_layout_gives_back_the_numbers(layout: str, tmp_path: Path) -> None:
    """A failure means a unit, separator, decimal mark or column of that machine is misread."""
    force = read_force(written(tmp_path, *LAYOUTS[layout]), d0_mm=13)
    np.testing.assert_allclose(force["time_s"], TIME, atol=1e-4)
    np.testing.assert_allclose(force["load_N"], LOAD, rtol=1e-3)
    np.testing.assert_allclose(force["d_mm"], 13 + PULL, atol=2e-5)
    assert force.attrs["source"] == "displacement"
    assert set(force["flag"].values) == {"ok"}


def test_facts_of_the_file_are_told(tmp_path: Path) -> None:
    """A failure means the run folder would not say how a recording was understood."""
    attrs = read_force(written(tmp_path, *LAYOUTS["mpt"])).attrs
    assert attrs["layout"] == "MTS 793"
    assert attrs["encoding"] == "utf-8"  # nothing in that file is outside ASCII
    assert (attrs["separator"], attrs["decimal"], attrs["blocks"]) == ("tab", ",", "2 of 3")
    assert "load = Ch 1 Kraft [kN]" in attrs["columns"]
    assert "--d0 not given" in attrs["notes"]


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
        import h5py

        with h5py.File(path, "w") as file:
            file["t"], file["run/load_kN"] = TIME[None, :], LOAD[None, :] / 1e3
    force = read_force(path, speed_mm_min=1.2)
    np.testing.assert_allclose(force["load_N"], LOAD)
    np.testing.assert_allclose(force["d_mm"], TIME * 0.02)
    assert force.attrs["source"] == "speed"


def test_no_header_needs_names(tmp_path: Path) -> None:
    """A failure means columns are guessed from numbers alone, or cannot be named."""
    path = written(tmp_path, rows(TIME, LOAD / 1e3, PULL, sep=";", decimal=","))
    with pytest.raises(InputError, match=r"no name, starts 0.*--force-columns time="):
        read_force(path)
    force = read_force(path, columns=parse_columns("time=1,load=2:kN,displacement=3"))
    np.testing.assert_allclose(force["load_N"], LOAD)
    np.testing.assert_allclose(force["crosshead_mm"], PULL)


def test_one_column_with_units_in_each_line(tmp_path: Path) -> None:
    """A failure means a bare list of forces cannot be used even with its sampling rate."""
    path = written(tmp_path, "".join(f"{value:.2f} N1\n" for value in LOAD))
    with pytest.raises(InputError, match="time=2000Hz"):
        read_force(path)
    force = read_force(path, columns={"time": "10Hz", "load": "1"})
    np.testing.assert_allclose(force["load_N"], LOAD)
    np.testing.assert_allclose(force["time_s"], TIME)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "Time (s),Load (N),Force (N)\n" + rows(TIME, LOAD, LOAD, sep=","),
            'one load column.*2 "Load", 3 "Force"',
        ),
        (
            "Time (s),Load (stone)\n" + rows(TIME, LOAD, sep=","),
            'unit of force for "Load".*stone.*load=Load:N',
        ),
        ("Time (s),Width (mm)\n" + rows(TIME, LOAD, sep=","), 'a load column.*2 "Width"'),
        ("Load (N),Width (mm)\n" + rows(LOAD, LOAD, sep=","), "a time column"),
        ("nothing here\nbut words\n", "no three lines of numbers"),
        ("", "an empty file"),
        ("a\x00b\x00", "a binary file"),
        ("Time (s),Load (N)\n" + rows(TIME[:4], LOAD[:4], sep=","), "at least 10 samples; found 4"),
    ],
)
def test_what_cannot_be_used_is_refused_in_one_line(text: str, message: str, tmp_path: Path) -> None:
    """A failure means a silent guess, or a traceback where a user needs to know what to do."""
    with pytest.raises(InputError, match=message) as caught:
        read_force(written(tmp_path, text))
    assert "\n" not in str(caught.value)


def test_missing_or_damaged_files(tmp_path: Path) -> None:
    """A failure means a traceback for a wrong path or a broken .mat."""
    with pytest.raises(InputError, match="no such file"):
        read_force(tmp_path / "absent.txt")
    with pytest.raises(InputError, match="MATLAB"):
        read_force(written(tmp_path, "not a mat file", name="bad.mat"))


def test_bad_samples_are_flagged_and_kept(tmp_path: Path) -> None:
    """A failure means bad rows are dropped, mended or taken as good."""
    time, load = TIME.copy(), LOAD.copy()
    time[5] = time[4]
    time[9] = time[7]
    load[12] = np.nan
    time[20:] += 5
    load[30:36] = 60.0
    force = read_force(written(tmp_path, "time (s),load (N)\n" + rows(time, load, sep=",")), speed_mm_min=1)
    flags = force["flag"].values
    expected = np.full(40, "ok", dtype="<U9")
    expected[[5, 9, 12, 20]] = ["repeated", "backwards", "nan", "gap"]
    expected[30:36] = "saturated"
    np.testing.assert_array_equal(flags, expected)
    assert "1 of 40 samples flagged backwards" in force.attrs["warnings"]


def test_what_is_taken_for_granted_is_said(tmp_path: Path) -> None:
    """A failure means a missing unit, speed or tension is guessed in silence."""
    path = written(tmp_path, "t;Fnorm\n" + rows(TIME, -LOAD / 100, sep=";"))
    force = read_force(path)
    assert force["load_N"].attrs["units"] == "1"
    assert '"t" has no unit' in force.attrs["notes"]
    assert "force over a weight" in force.attrs["notes"]
    assert "no --speed" in force.attrs["warnings"]
    assert "compression" in force.attrs["warnings"]
    assert np.isnan(force["d_mm"]).all()
    turned = read_force(path, columns={"load": "-Fnorm"})
    assert "compression" not in turned.attrs["warnings"]


def test_speed_is_checked_against_the_crosshead(tmp_path: Path) -> None:
    """A failure means a wrong --speed goes unnoticed, or overrides what was measured."""
    path = written(tmp_path, *LAYOUTS["snake"])
    assert "--speed says 5" in read_force(path, speed_mm_min=5).attrs["warnings"]
    assert read_force(path, speed_mm_min=1.2).attrs["warnings"] == ""
    assert read_force(path).attrs["speed_mm_min"] == pytest.approx(1.2)


@pytest.mark.parametrize("text", ["speed=1", "load", "load="])
def test_option_that_cannot_be_parsed(text: str) -> None:
    """A failure means a mistyped --force-columns is ignored."""
    with pytest.raises(InputError, match="ROLE=COLUMN"):
        parse_columns(text)
