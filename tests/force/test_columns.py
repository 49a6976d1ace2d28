"""Columns and their units are found by name, given by the user, or refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.scenes.machine_files import LOAD, PULL, TIME, rows, written
from vision.errors import InputError
from vision.force import parse_columns, read_force


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
        (("sec", 1), ("lbf", 4.4482216), ("in", 25.4)),
        (("seconds", 1), ("kgf", 9.80665), ("ft", 304.8)),
        (("msec", 1e-3), ("gf", 9.80665e-3), ("inches", 25.4)),
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
        ("a\x00b\x00", "a binary file"),
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
    """A failure means a mistyped `columns` is ignored."""
    with pytest.raises(InputError, match="ROLE=COLUMN"):
        parse_columns(text)
