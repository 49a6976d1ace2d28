"""Columns found by name or given, quality flags, notes and warnings of a recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.scenes.machine_files import LAYOUTS, LOAD, PULL, TIME, rows, written
from vision.data import operations_of
from vision.errors import InputError
from vision.force import ForceSettings, good_samples, parse_columns, read_force


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
    assert "1 of 40 samples flagged backwards and left out" in force.attrs["warnings"]


def test_rows_in_reverse_order_are_refused_with_advice(tmp_path: Path) -> None:
    """A failure means that a recording of which one sample is usable ends in an unexpected error later."""
    table = "time (s),load (N)\n" + rows(TIME[::-1], LOAD[::-1], sep=",")
    with pytest.raises(InputError, match="found 1 among 40 rows; the rows seem to be in reverse order"):
        read_force(written(tmp_path, table), speed_mm_min=1)


def test_a_gap_where_samples_are_dense_is_one_in_time(tmp_path: Path) -> None:
    """A failure means that a loss during fast sampling is said to make every later d wrong."""
    time = np.r_[np.arange(0, 300, 0.1), 300 + np.arange(0, 10, 0.005)]
    time[-1000:] += 0.05
    table = rows(time, 50 + np.sin(time), time / 60, sep=",")
    force = read_force(written(tmp_path, "time (s),load (N),crosshead (mm)\n" + table))
    assert force.attrs["warnings"] == ["1 gaps in time"]


@pytest.mark.parametrize(
    ("row", "step_s", "told"), [(150, 0.0, "displacement jumps by -14.9 mm at 15 s"), (90, 5.0, "1 gaps")]
)
def test_a_displacement_that_starts_again_is_told_from_a_gap(
    row: int, step_s: float, told: str, tmp_path: Path
) -> None:
    """A failure means that d is wrong from a row on, and only a gap in time is told."""
    index = np.arange(200)
    time, d = 0.1 * index, 0.1 * (index if step_s else index % row)
    time[row:] += step_s
    d[row:] += step_s
    text = "Time (s),Load (N),Extension (mm)\n"
    text += "".join(f"{t:.1f},{k % 7},{x:.2f}\n" for k, t, x in zip(index, time, d, strict=True))
    warnings = read_force(written(tmp_path, text), d0_mm=13).attrs["warnings"]
    assert [told in line for line in warnings] == [True]


@pytest.mark.parametrize("heading", ["", "Time (s),Load (N),Extension (mm)\n"])
@pytest.mark.parametrize("rows", [40, 90])
def test_a_second_recording_in_the_file_is_named(rows: int, heading: str, tmp_path: Path) -> None:
    """A failure means the end of a second, longer test goes on where the first one ends, without a word."""
    tests = [
        "".join(f"{0.1 * k:.1f},{5 + k % 7},{0.01 * k:.2f}\n" for k in range(count)) for count in (60, rows)
    ]
    file = tmp_path / "two.csv"
    file.write_text("Time (s),Load (N),Extension (mm)\n" + heading.join(tests))
    force = read_force(file, d0_mm=13)
    line = 62 + bool(heading)
    assert f"starts again at line {line}: the file seems to hold two" in force.attrs["warnings"][0]
    assert good_samples(force).sizes["time_s"] == 60


def test_single_wrong_times_are_no_second_recording(tmp_path: Path) -> None:
    """A failure means a recording is cut off at the first damaged time."""
    time = 0.1 * np.arange(200)
    time[[50, 90]] = 0.0, 1e5
    file = tmp_path / "one.csv"
    file.write_text("Time (s),Load (N)\n" + "".join(f"{t:.1f},{k % 7}\n" for k, t in enumerate(time)))
    assert not any("starts again" in line for line in read_force(file, speed_mm_min=1).attrs["warnings"])


def test_a_load_cell_that_is_mostly_saturated_is_flagged(tmp_path: Path) -> None:
    """A failure means that a plateau at the load cell's limit passes for sticks without a peak."""
    load = np.minimum(LOAD, np.quantile(LOAD, 0.3))
    force = read_force(written(tmp_path, "time (s),load (N)\n" + rows(TIME, load, sep=",")), speed_mm_min=1)
    np.testing.assert_array_equal(force["flag"].values == "saturated", load == load.max())


def test_a_load_in_coarse_steps_is_not_saturated(tmp_path: Path) -> None:
    """A failure means that the top of a sawtooth is left out since the load cell stays at each of its steps
    for a while; or that the true limit of such a load cell passes."""
    time = np.arange(2000) / 100
    coarse = np.round((20 + time % 4 * 0.07) / 0.02) * 0.02  # 28 samples a step
    for load, limit in ((coarse, False), (np.minimum(coarse, 20.16), True)):
        text = "time (s),load (N)\n" + rows(time, load, sep=",")
        flags = read_force(written(tmp_path, text), speed_mm_min=1)["flag"].values
        np.testing.assert_array_equal(flags == "saturated", limit & (load == load.max()))


def test_only_a_recorded_crosshead_starts_anywhere(tmp_path: Path) -> None:
    """A failure means a warning about a crosshead in a file that has none."""
    force = read_force(written(tmp_path, "time (s),load (N)\n" + rows(TIME, LOAD, sep=",")), d0_mm=13)
    assert not any("crosshead starts" in line for line in force.attrs["warnings"])


def test_what_is_taken_for_granted_is_said(tmp_path: Path) -> None:
    """A failure means a missing unit, speed or tension is guessed in silence."""
    path = written(tmp_path, "t;Fnorm\n" + rows(TIME, -LOAD / 100, sep=";"))
    force = read_force(path)
    assert force["load_N"].attrs["units"] == "1"
    notes, warnings = ("; ".join(force.attrs[name]) for name in ("notes", "warnings"))
    assert '"t" has no unit' in notes
    assert "force over a weight" in notes
    assert "no `speed_mm_min`" in warnings
    assert "compression" in warnings
    assert np.isnan(force["d_mm"]).all()
    turned = read_force(path, columns={"load": "-Fnorm"})
    assert not any("compression" in line for line in turned.attrs["warnings"])


def test_a_load_without_a_unit_is_a_warning(tmp_path: Path) -> None:
    """A failure means a load in lbf is taken for N in silence, or one in N is doubted."""

    def doubted(header: str, columns: dict[str, str] | None = None) -> bool:
        path = written(tmp_path, header + "\n" + rows(TIME, LOAD, sep=","))
        warnings = read_force(path, columns=columns, speed_mm_min=1).attrs["warnings"]
        return any("expected a load with a unit" in line for line in warnings)

    assert doubted("time,load")
    assert not doubted("time,load", {"load": "load:lbf"})
    for header in ("time,load (N)", "time_s,load_N", "time,load\ns,kN"):
        assert not doubted(header)


def test_speed_is_checked_against_the_crosshead(tmp_path: Path) -> None:
    """A failure means a wrong speed goes unnoticed, or overrides what was measured."""
    path = written(tmp_path, *LAYOUTS["snake"])
    (warning,) = read_force(path, speed_mm_min=5).attrs["warnings"]
    assert "not at `speed_mm_min` 5" in warning
    assert read_force(path, speed_mm_min=1.2).attrs["warnings"] == []
    assert read_force(path).attrs["speed_mm_min"] == pytest.approx(1.2)


def test_settings_reach_the_flags_and_are_recorded(tmp_path: Path) -> None:
    """A failure means a setting does nothing, or results do not say that it was changed."""
    time = TIME.copy()
    time[20:] += 0.3
    path = written(tmp_path, "time (s),load (N)\n" + rows(time, LOAD, sep=","))
    assert "gap" not in read_force(path).attrs["warnings"]
    strict = read_force(path, settings=ForceSettings(gap_intervals=3))
    assert "1 gaps in time" in strict.attrs["warnings"]
    (entry,) = operations_of(strict)
    assert entry["operation"] == "read_force"
    assert entry["parameters"]["settings"] == {"gap_intervals": 3}


def crosshead_file(folder: Path, crosshead: np.ndarray) -> Path:
    """A recording of 200 samples with this crosshead."""
    time = np.arange(crosshead.size) * 0.1
    rows = "\n".join(f"{t:.2f},{x:.5f},{10 + t:.3f}" for t, x in zip(time, crosshead, strict=True))
    path = folder / "pull.csv"
    path.write_text(f"Time (s),Crosshead (mm),Load (N)\n{rows}\n", encoding="utf-8")
    return path


@pytest.mark.parametrize(("start", "said"), [(0.0, False), (5.0, True)])
def test_d0_is_added_to_the_crossheads_change(tmp_path: Path, start: float, said: bool) -> None:
    """A failure means a crosshead that starts at +5 mm gives d = 18 to 23 mm and a wrong μ, silently."""
    path = crosshead_file(tmp_path, start + np.linspace(0, 5, 200))
    force = read_force(path, d0_mm=13.0)
    np.testing.assert_allclose(force["d_mm"][[0, -1]], [13, 18], atol=1e-6)
    assert any("starts at 5 mm" in line for line in force.attrs["warnings"]) == said
    np.testing.assert_allclose(read_force(path, d0_mm=0.0)["d_mm"][[0, -1]], [start, start + 5], atol=1e-6)
    assert not any("starts at" in line for line in read_force(path, d0_mm=0.0).attrs["warnings"])


def test_without_a_crosshead_the_pull_begins_with_the_recording(tmp_path: Path) -> None:
    """A failure means that a clock which starts at 100 s puts d off by what the machine did not travel."""
    path = written(tmp_path, "time (s),load (N)\n" + rows(100 + TIME, LOAD, sep=","))
    force = read_force(path, speed_mm_min=3.0, d0_mm=13.0)
    np.testing.assert_allclose(force["d_mm"], 13 + 3 / 60 * (TIME - TIME[0]), atol=1e-9)


@pytest.mark.parametrize(("rest_s", "said"), [(0.0, False), (10.0, True)])
def test_a_rest_before_the_pull_is_told_where_d_comes_from_the_speed(
    rest_s: float, said: bool, tmp_path: Path
) -> None:
    """A failure means a d that is 0.17 mm too large, and μ and Λ̂ off by 6 and 12 errors, without a word."""
    time = np.arange(0, 40, 0.05)
    load = 20 * np.clip(time - rest_s, 0, 5) % 90 + np.random.default_rng(1).normal(0, 0.1, time.size)
    path = written(tmp_path, "time (s),load (N)\n" + rows(time, load, sep=","))
    warnings = read_force(path, speed_mm_min=1, d0_mm=13.0).attrs["warnings"]
    assert any("give `d0_mm` 12.83" in line for line in warnings) == said
    no_d0 = read_force(path, speed_mm_min=1).attrs["warnings"]
    assert any("the load is level for the first 10" in line for line in no_d0) == said


def test_a_gap_in_which_the_machine_may_have_rested_is_told_where_d_comes_from_the_speed(
    tmp_path: Path,
) -> None:
    """A failure means that after 25 s without a recording d is 0.42 mm too large, without a word."""
    time = np.arange(0, 40, 0.05)
    time[400:] += 25
    load = 20 * np.clip(np.arange(0, 40, 0.05), 0, 5) % 90
    path = written(tmp_path, "time (s),load (N)\n" + rows(time, load, sep=","))
    (line,) = read_force(path, speed_mm_min=1, d0_mm=13.0).attrs["warnings"]
    assert "1 gaps in time, in which d = d0 + V t advances by 0.418 mm" in line


def test_the_error_of_d0_travels_with_the_recording(tmp_path: Path) -> None:
    """A failure means the fits do not know how well d0 is known."""
    path = crosshead_file(tmp_path, np.linspace(0, 5, 200))
    assert read_force(path, d0_mm=13.0, d0_err_mm=0.1).attrs["d0_err_mm"] == 0.1
    assert np.isnan(read_force(path, d0_mm=13.0).attrs["d0_err_mm"])


def test_no_header_needs_names(tmp_path: Path) -> None:
    """A failure means columns are guessed from numbers alone, or cannot be named."""
    path = written(tmp_path, rows(TIME, LOAD / 1e3, PULL, sep=";", decimal=","))
    with pytest.raises(InputError, match=r"no name, starts 0.*`columns` time="):
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
    ("time", "load", "length"),
    [
        (("s", 1), ("N", 1), ("mm", 1)),
        (("ms", 1e-3), ("kN", 1e3), ("cm", 10)),
        (("µs", 1e-6), ("MN", 1e6), ("m", 1e3)),
        (("min", 60), ("mN", 1e-3), ("µm", 1e-3)),
        (("h", 3600), ("daN", 10), ("nm", 1e-6)),
        (("h", 3600), ("cN", 1e-2), ("cm", 10)),
        (("sec", 1), ("lbf", 4.4482216), ("in", 25.4)),
        (("seconds", 1), ("kgf", 9.80665), ("ft", 304.8)),
        (("msec", 1e-3), ("gf", 9.80665e-3), ("inches", 25.4)),
        (("Sekunden", 1), ("Kilonewton", 1e3), ("millimètre", 1)),
    ],
)
def test_units_become_s_N_and_mm(time, load, length, tmp_path: Path) -> None:
    """A failure means a recording in this unit is a thousand times too strong, or too long."""
    head = f"Time ({time[0]});Load ({load[0]});Crosshead ({length[0]})\n"
    values = (TIME / time[1], LOAD / load[1], PULL / length[1])
    body = "".join(";".join(f"{v:.12g}" for v in row) + "\n" for row in zip(*values, strict=True))
    force = read_force(written(tmp_path, head + body))
    np.testing.assert_allclose(force["time_s"], TIME, atol=1e-9)
    np.testing.assert_allclose(force["load_N"], LOAD, rtol=1e-6)
    np.testing.assert_allclose(force["crosshead_mm"], PULL, rtol=1e-6, atol=1e-9)


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
        ("a\x00\x00b\x01\x00", "a binary file"),
        ("Time (s),Load (N)\n" + rows(TIME[:4], LOAD[:4], sep=","), "at least 10 samples; found 4"),
    ],
)
def test_what_cannot_be_used_is_refused_in_one_line(text: str, message: str, tmp_path: Path) -> None:
    """A failure means a silent guess, or a traceback where a user needs to know what to do."""
    with pytest.raises(InputError, match=message) as caught:
        read_force(written(tmp_path, text))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["speed=1", "load", "load="])
def test_option_that_cannot_be_parsed(text: str) -> None:
    """A failure means a mistyped `force_columns` is ignored, or the message names an option of the film."""
    with pytest.raises(InputError, match="`force_columns`: expected ROLE=COLUMN") as caught:
        parse_columns(text)
    assert "write time=Time,load=Load:kN" in str(caught.value)


def test_a_separation_below_zero_is_refused(tmp_path):
    """A failure means that d0 with a wrong sign shifts every separation without a word."""
    path = tmp_path / "f.txt"
    path.write_text("Time [s]\tLoad [N]\tDisplacement [mm]\n" + "".join(f"{k}\t1\t{k}\n" for k in range(9)))
    with pytest.raises(InputError, match="`d0_mm`: expected a number of mm from 0; found -13"):
        read_force(path, d0_mm=-13)


@pytest.mark.parametrize(("unit", "told"), [("min", "a factor of 60"), ("s", "")])
def test_times_in_another_unit_than_the_header_says_are_told(unit: str, told: str, tmp_path: Path) -> None:
    """A failure means that seconds under the name of minutes leave every speed wrong by 60 without a hint."""
    time = 0.1 * np.arange(200)
    text = f"time ({unit}),load (N),displacement (mm)\n" + rows(time, 5 + np.sin(time), time / 60, sep=",")
    warnings = read_force(written(tmp_path, text), speed_mm_min=1, d0_mm=13).attrs["warnings"]
    assert any("check the unit of the time" in line and told in line for line in warnings) == bool(told)
