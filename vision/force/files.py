"""Tables of numbers, with names and units of their columns, from text, Excel and MATLAB files."""

from __future__ import annotations

import contextlib
import csv
import io
import re
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from datetime import date
from itertools import compress, zip_longest
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
import pandas as pd
import scipy

from vision.errors import InputError
from vision.files import (
    READ_HDF5,
    READ_MATLAB,
    THOUSANDS,
    check_regular,
    decode_text,
    groups_thousands,
    reading,
    some_lines,
    try_out,
)
from vision.numeric import CLOCK, CLOCK_PARTS, DATE, Bools, Floats, clock_seconds, number

Dimension = Literal["time", "force", "length", "ratio"]


class _Most:
    """Limits of what is read; a file beyond them is not a force recording."""

    bytes = 8 << 30  # of a table of plain numbers, about 300 million rows
    mixed_bytes = 1 << 30  # of other text, which takes ten times its size in memory
    columns = 1000
    matrix_columns = 20  # of a matrix in a .mat file; wider ones are images or tables of something else
    letters = 200  # characters of a header cell, or of a number with its unit


_WANTED, _WANTED_MAT = "a force recording", "a MATLAB .mat file"
_ADVICE = "export the recording as text with one row per sample"
LEAST_ROWS = 3


@dataclass(frozen=True)
class Table:
    """One block of numbers of a file with its header, before its columns are interpreted."""

    names: tuple[str, ...]  # one per column
    units: tuple[str, ...]  # "" where none is written
    numbers: Floats  # (rows, columns), NaN where a cell is empty or not a number
    facts: dict[str, str] = field(default_factory=dict)  # layout, encoding, separator, decimal
    first_line: int = 0  # line of the first row in the file, counted from 1; 0 where unknown

    def listing(self) -> str:
        """Return the columns for a message: 1 "Time" [s], 2 "Load" [N] …; without a name the first value."""
        shown = []
        for k, (name, unit) in enumerate(zip(self.names, self.units, strict=True)):
            first = self.numbers[0, k] if len(self.numbers) else float("nan")
            named = f'"{name}"' + (f" [{unit}]" if unit else "")
            empty = "" if np.isfinite(self.numbers[:, k]).any() else " (empty)"
            shown.append(f"{k + 1} " + (named + empty if name else f"(no name, starts {first:g})"))
        return ", ".join(shown)


def read_tables(path: Path) -> list[Table]:
    """Read every block of numbers of a recording, in file order.

    It may be text as MTS TestSuite (text and CSV), MTS 793, Instron Bluehill, Zwick TRA, Shimadzu Trapezium
    and LabVIEW (.lvm) write it, a plain table with or without a header, with units in the cells, or one
    column with a unit in each line; an Excel workbook (.xlsx, .xlsm), whose worksheets are read like text; or
    a MATLAB .mat file, v4 to v7.3, which gives one table of the vectors that share the commonest length:
    fields of a struct are named "struct.field" and columns of a matrix "matrix 1", "matrix 2" …. Clock times
    become seconds, with the unit `TIME_OF_DAY`. Thousands separators are removed, and overflow marks become
    NaN.

    Raises InputError for a file that cannot be read, no block of three rows of numbers, or no vectors.
    """
    size = check_regular(path, _WANTED).st_size
    if size > _Most.bytes:
        raise InputError(path, f"at most {_Most.bytes >> 30} GiB", f"{size >> 20} MiB", "export a part of it")
    with reading(path, _WANTED, "export it again"):
        kind = path.suffix.lower()
        return _READERS.get(kind, _read_text)(path)


# --- units --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Unit:
    """A unit as written, its dimension, and its size in s, N or mm."""

    text: str
    dimension: Dimension
    factor: float


TIME_OF_DAY = "time of day"  # unit of a column of clock times, which are read as seconds

# Written forms, in which case matters: mN and MN differ.
_FACTORS: dict[Dimension, dict[str, float]] = {
    "time": {
        **dict.fromkeys(("s", "sec", "secs", "second", "seconds", "sek", "seg", TIME_OF_DAY), 1.0),
        **dict.fromkeys(("Sekunde", "Sekunden", "seconde", "secondes", "segundo", "segundos"), 1.0),
        **dict.fromkeys(("ms", "msec", "millisecond", "milliseconds"), 1e-3),
        **dict.fromkeys(("µs", "us"), 1e-6),
        **dict.fromkeys(("min", "minute", "minutes", "Minuten"), 60.0),
        **dict.fromkeys(("h", "hr", "hour", "hours"), 3600.0),
    },
    "force": {
        **dict.fromkeys(("N", "newton", "newtons"), 1.0),
        **dict.fromkeys(("kN", "kilonewton", "kilonewtons"), 1e3),
        **{"MN": 1e6, "daN": 10.0, "cN": 1e-2, "mN": 1e-3, "µN": 1e-6, "uN": 1e-6},
        **dict.fromkeys(("lbf", "lb", "lbs"), 4.4482216152605),
        **dict.fromkeys(("kgf", "kp", "kg"), 9.80665),
        **dict.fromkeys(("gf", "g"), 9.80665e-3),
    },
    "length": {
        **{"mm": 1.0, "cm": 10.0, "m": 1000.0, "µm": 1e-3, "um": 1e-3, "nm": 1e-6},
        **dict.fromkeys(("millimeter", "millimeters", "millimetre", "millimetres"), 1.0),
        **dict.fromkeys(("millimètre", "millimètres", "milímetro", "milímetros"), 1.0),
        **dict.fromkeys(("meter", "meters", "metre", "metres"), 1000.0),
        **dict.fromkeys(("micron", "microns", "micrometer", "micrometers"), 1e-3),
        **dict.fromkeys(("in", "inch", "inches", '"'), 25.4),
        "ft": 304.8,
    },
    "ratio": dict.fromkeys(("1", "-", "N/N", "dimensionless"), 1.0),
}
_EXACT = {text: Unit(text, dim, f) for dim, table in _FACTORS.items() for text, f in table.items()}
_LOWER = {text.lower(): unit for text, unit in _EXACT.items() if text not in {"mN", "MN"}}
_GREEK_MU = str.maketrans({"\u03bc": "µ"})


def without_brackets(text: str) -> str:
    """Return a unit without brackets and spaces around it: "kN" for "(kN)" and " [kN] "."""
    return text.strip().strip("()[]{}<>").strip().removesuffix(".")


def unit_of(text: str) -> Unit | None:
    """Return the unit that a text denotes; None where it is not a unit of time, force or length.

    Case distinguishes mN from MN and is otherwise ignored.
    """
    key = without_brackets(text).translate(_GREEK_MU)
    return _EXACT.get(key) or _LOWER.get(key.lower())


_BRACKETED = re.compile(r"^(?P<name>.*?)\s*[\(\[\{<](?P<unit>[^()\[\]{}<>]*)[\)\]\}>]\s*$")
_TRAILING = re.compile(r"^(?P<name>.*\S)(?:\s*[,/]\s*|_|\s+in\s+)(?P<unit>[^\s,/_]+)\s*$")


def split_name(header: str, is_unit: Callable[[str], object] = unit_of) -> tuple[str, str]:
    """Return ("Load", "kN") for "Load (kN)", "Load [kN]", "Load, kN", "Load / kN", "Load in kN" or "Load_kN".

    Any text in brackets is split off as the unit; the other forms are split only where
    `is_unit` knows what follows.
    """
    bracketed = _BRACKETED.match(header)
    if bracketed:
        return bracketed["name"].strip(), bracketed["unit"].strip()
    trailing = _TRAILING.match(header)
    if trailing and is_unit(trailing["unit"]):
        return trailing["name"].strip(), trailing["unit"].strip()
    return header.strip(), ""


# --- text ---------------------------------------------------------------------------------------------------

_WHITESPACE = r"\s+"
_SEPARATORS = ("\t", ";", ",", "|", _WHITESPACE)
_SEPARATOR_NAMES = {"\t": "tab", ";": "semicolon", ",": "comma", "|": "bar", _WHITESPACE: "spaces"}
_NOT_A_NUMBER = (
    *("nan", "n/a", "#n/a", "na", "inf", "-inf", "+inf", "--", "---", "", "ol", "ovl", "over", "overflow"),
    *("overload", "overrange", "1.#qnan", "1.#inf", "-1.#ind", "-1.#inf"),
)
_SUFFIXED = re.compile(r"^\s*(?P<number>[-+]?\d*\.?\d+(?:[eE][-+]?\d+)?)\s*(?P<unit>[A-Za-zµ]+?)\d*\s*$")


def _read_text(path: Path) -> list[Table]:
    """Read every block of numbers of a text recording."""
    plain = _read_plain(path)
    if plain is not None:
        return [plain]
    size = path.stat().st_size
    if size > _Most.mixed_bytes:
        wanted = f"at most {_Most.mixed_bytes >> 30} GiB of text that is not numbers alone"
        raise InputError(path, wanted, f"{size >> 20} MiB", "export one table of numbers")
    text, encoding = decode_text(path, path.read_bytes(), _WANTED)
    lines = text.splitlines()
    style = _find_style(path, lines)
    if style is None:
        return [_suffixed_column(path, lines, encoding)]
    tables = _read_blocks(path, lines, style, _facts(lines, style, encoding))
    if not tables:
        raise InputError(path, f"{LEAST_ROWS} lines of numbers in a row", "none", _ADVICE)
    return tables


def _read_plain(path: Path) -> Table | None:
    """Read the commonest recording, a header followed by numbers only, by pandas directly from the disk.

    None for any other file: several blocks, remarks, cells of text. Those take ten times as long and as much
    memory to read.
    """
    with path.open("rb") as file:
        head = file.read(1 << 17)  # the header and the first rows
        whole = not file.read(1)
    raw = head.split(b"\n")[: None if whole else -1]
    text, encoding = decode_text(path, b"\n".join(raw), _WANTED)
    lines = text.splitlines()
    style = _find_style(path, lines)
    if len(lines) not in (len(raw), len(raw) - 1) or style is None or style.separator == style.decimal:
        return None
    runs = _runs(lines, style)
    if len(runs) != 1 or any(line.strip() for line in lines[runs[0][1] :]):
        return None
    start = runs[0][0]
    width = _width([line for line in lines[start:] if line.strip()], style, path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.ParserWarning)  # a later row is longer
            values = _parsed(str(path.absolute()), style, width, skiprows=start, dtype=np.float64).to_numpy()
    except (ValueError, pd.errors.ParserWarning):
        return None
    if np.isnan(values[:, 1:]).all(axis=1).any() or len(values) < LEAST_ROWS:
        return None  # a remark, or the last line cut short
    _check_commas(path, lines[:start], lines[start:], style, width)
    names, units = _header(lines[:start], style, width)
    table = Table(names, units, values, _facts(lines, style, encoding), start + 1)
    if tags := _labview_tags(lines[:start], style):
        table = _with_labview_times(path, table, tags)
    return _drop_empty(table)


def _facts(lines: list[str], style: _Style, encoding: str) -> dict[str, str]:
    """Return how the file was read."""
    return {
        "layout": _layout(lines),
        "encoding": encoding,
        "separator": _SEPARATOR_NAMES[style.separator],
        "decimal": style.decimal,
    }


@dataclass(frozen=True)
class _Style:
    """A separator and a decimal mark, with the patterns of a number and of a line of numbers."""

    separator: str
    decimal: str
    thousands: bool = False  # whether points between groups of three digits are no decimal points

    @property
    def number(self) -> str:
        """Pattern of one number."""
        mark = re.escape(self.decimal)
        whole = rf"(?>{THOUSANDS.format(mark=re.escape('.'))}|[0-9]++)" if self.thousands else "[0-9]++"
        return rf"[-+]?+(?:{whole}(?:{mark}[0-9]*+)?+|{mark}[0-9]++)(?:[eE][-+]?+[0-9]++)?+"

    def patterns(self) -> tuple[re.Pattern[str], re.Pattern[str]]:
        """Return the patterns of one number and of a whole line of numbers.

        Quantifiers are possessive (`*+`): with backtracking a line of padded cells could take hours.
        """
        words = "|".join(re.escape(word) for word in sorted(_NOT_A_NUMBER, key=len, reverse=True) if word)
        marks = r"\*++|#[A-Za-z0/]++[!?]"  # number too long for its column, error of a spreadsheet
        clock = rf"{DATE}(?:[ T]{CLOCK})?|{CLOCK}"
        value = rf"(?>{clock}|{words}|{marks}|{self.number})"
        if self.separator == _WHITESPACE:
            line = rf"\s*+{value}(?:\s++{value})+\s*+"
        else:
            quoted = rf'"[ ]*+{value}?+[ ]*+"'
            # Where the comma is both separator and decimal mark only quotes distinguish them.
            bare = "" if self.separator == self.decimal else rf"|{value}?+"
            cell = rf"[ ]*+(?>{quoted}{bare})[ ]*+"
            line = rf"{cell}(?:{re.escape(self.separator)}{cell})+"
        return re.compile(self.number), re.compile(line, re.IGNORECASE)

    def cells(self, line: str) -> list[str]:
        """Return the cells of a line; among separating spaces a single one may be part of a name."""
        if self.separator != _WHITESPACE:
            return [cell.strip() for cell in next(csv.reader([line], delimiter=self.separator), [])]
        return re.split(r"\s{2,}|\t", line.strip()) if re.search(r"\S\s{2,}\S|\t", line) else line.split()


def _data_lines(lines: list[str], style: _Style) -> Bools:
    """Return which lines contain numbers: in all cells, or in at least two and half of the cells."""
    number, whole = style.patterns()

    def is_data(line: str) -> bool:
        if whole.fullmatch(line):
            return any(ch.isdigit() for ch in line) or "nan" in line.lower()
        if style.separator == style.decimal or style.separator not in line:
            return False
        cells = style.cells(line)
        numbers = sum(number.fullmatch(cell) is not None for cell in cells)
        return numbers >= 2 and 2 * numbers >= len(cells)

    return np.fromiter((is_data(line) for line in lines), dtype=bool, count=len(lines))


def _find_style(path: Path, lines: list[str]) -> _Style | None:
    """The separator and decimal mark under which most lines are numbers; None where none are."""
    sample = some_lines(lines)  # all lines would take as long as reading them
    styles = [_Style(separator, decimal) for separator in _SEPARATORS for decimal in (".", ",")]
    counts = [int(_data_lines(sample, style).sum()) for style in styles]
    best = int(np.argmax(counts))
    if counts[best] < LEAST_ROWS:
        return None
    return _with_thousands(path, sample, styles[best])


def _with_thousands(path: Path, lines: list[str], style: _Style) -> _Style:
    """Return the style for points that group digits, as in 995, 1.000, 1.005; the given one without any.

    Raises: InputError if other columns have decimal points.
    """
    if style.decimal != "." or style.separator == ",":
        return style
    rows = map(style.cells, compress(lines, _data_lines(lines, style)))
    found = [groups_thousands(column, ".") for column in zip_longest(*rows, fillvalue="")]
    if True not in found:
        return style
    if False in found:
        mixed = f"points between thousands in column {found.index(True) + 1}"
        mixed += f", decimal points in column {found.index(False) + 1}"
        raise InputError(path, "points of one meaning", mixed, "export it without separators of thousands")
    return replace(style, decimal=",", thousands=True)


def _layout(lines: list[str]) -> str:
    """Return the program that wrote a file, recognised by its header; "table" for an unknown one."""
    head = "\n".join(lines[:40]).lower()
    known = {
        "labview measurement": "LabVIEW",
        "mts793": "MTS 793",
        "file path:": "MTS TestSuite",
        "bluehill": "Instron Bluehill",
        "maximum load :": "Instron Bluehill",
        "prouvette": "Zwick TRA",
        "specimen thickness": "Zwick TRA",
        "probendicke": "Zwick TRA",
    }
    return next((name for mark, name in known.items() if mark in head), "table")


def _read_blocks(path: Path, lines: list[str], style: _Style, facts: dict[str, str]) -> list[Table]:
    """Return each run of data lines as a table, with the header above it."""
    tables: list[Table] = []
    header_from = 0
    stamps: list[_Stamp | None] = []  # when segments of a LabVIEW file begin
    for start, stop in _runs(lines, style):
        values, written = _numbers(path, [line for line in lines[start:stop] if line.strip()], style)
        _check_commas(path, lines[header_from:start], lines[start:stop], style, values.shape[1])
        names, units = _header(lines[header_from:start], style, values.shape[1])
        units = tuple(of_cells or unit for unit, of_cells in zip(units, written, strict=True))
        if tables and not any(names) and values.shape[1] == tables[-1].numbers.shape[1]:
            # A remark between two runs of numbers is not a header: the columns stay the same.
            names, units = tables[-1].names, tables[-1].units
        table = Table(names, units, values, facts, start + 1)
        tags = _labview_tags(lines[header_from:start], style)
        stamps.append(_stamp_of(tags))
        tables.append(_drop_empty(_with_labview_times(path, table, tags) if tags else table))
        header_from = stop
    _continue_segments(tables, stamps)
    return tables


def _runs(lines: list[str], style: _Style) -> list[tuple[int, int]]:
    """Return the half-open range of each run of at least 3 data lines; blank lines do not end a run."""
    data = _data_lines(lines, style)
    breaks = np.array([bool(line.strip()) for line in lines]) & ~data
    run = np.cumsum(breaks)
    rows = np.flatnonzero(data)
    if not rows.size:
        return []
    first = np.flatnonzero(np.r_[True, np.diff(run[rows]) > 0])
    last = np.r_[first[1:], rows.size] - 1
    return [
        (int(rows[a]), int(rows[b]) + 1) for a, b in zip(first, last, strict=True) if b - a + 1 >= LEAST_ROWS
    ]


def _width(lines: list[str], style: _Style, path: Path) -> int:
    """Return the number of columns of the longest line; raise InputError for too many."""
    if style.separator == _WHITESPACE:
        width = max((len(line.split()) for line in lines), default=0)
    elif style.separator == style.decimal:
        width = max((len(style.cells(line)) for line in lines), default=0)
    else:
        width = max((line.count(style.separator) for line in lines), default=0) + 1
    return _checked_width(width, path)


def _checked_width(width: int, path: Path) -> int:
    """Return a number of columns; raise InputError for too many."""
    if width > _Most.columns:
        raise InputError(path, f"at most {_Most.columns} columns", str(width), "export fewer of them")
    return width


def _parsed(source: str | io.StringIO, style: _Style, width: int, **more: Any) -> pd.DataFrame:
    """Parse numbers by the C parser of pandas, from a file or from text."""
    frame: pd.DataFrame = pd.read_csv(
        source,
        sep=style.separator,
        decimal=style.decimal,
        header=None,
        names=list(range(width)),
        na_values=list(_NOT_A_NUMBER[1:]),
        skipinitialspace=True,
        index_col=False,
        compression=None,
        **more,
    )
    return frame


def _numbers(path: Path, lines: list[str], style: _Style) -> tuple[Floats, list[str]]:
    """Return lines of numbers as an array, NaN for other cells, and the units in the cells of each column."""
    width, text = _width(lines, style, path), io.StringIO("\n".join(lines))
    frame = _parsed(text, style, width, skip_blank_lines=False, low_memory=False)
    columns = [_as_floats(frame[column], style.decimal) for column in frame.columns]
    return np.column_stack([values for values, _ in columns]), [unit for _, unit in columns]


def _as_floats(series: pd.Series[Any], decimal: str) -> tuple[Floats, str]:
    """Return the values of a column, and the unit written in most cells, as in "0.005 sec"; "" for none."""
    if pd.api.types.is_numeric_dtype(series):
        return series.to_numpy(dtype=float), ""
    text = series.astype(str).str.strip()
    clock = text.str.extract(CLOCK_PARTS)
    if clock[1].notna().mean() > 0.5:
        return clock_seconds(clock), TIME_OF_DAY
    other = "." if decimal == "," else ","
    if groups_thousands(some_lines(text.to_list()), other) is False:  # this column has another decimal mark
        decimal = other
    else:
        thousands = rf"(?<=[0-9])[{other}'\u2019\u00a0\u202f ](?=[0-9]{{3}}(?![0-9]))"
        grouped = text.str.match(rf"[-+]?[1-9][0-9]{{0,2}}(?:{thousands}[0-9]{{3}})+(?![0-9])")
        text = text.mask(grouped, text.str.replace(thousands, "", regex=True))
    text = text.str.replace(decimal, ".")
    cells = text.str.extract(_SUFFIXED)
    unit = str(cells["unit"].mode().get(0, ""))
    if unit_of(unit) and (cells["unit"] == unit).mean() > 0.5:
        text = cells["number"].where(cells["unit"] == unit)
    else:
        unit = ""
    return pd.to_numeric(text, errors="coerce").to_numpy(dtype=float), unit


def _check_commas(path: Path, header: list[str], rows: list[str], style: _Style, width: int) -> None:
    """Refuse rows in which a comma separates columns and also is the decimal mark: more cells than names, and
    no decimal point in any."""
    above = [cells for line in header if any(cells := style.cells(line))]
    names = len([cell for cell in above[-1] if cell]) if above else 0
    if (
        style.separator == "," != style.decimal
        and 1 < names < width
        and not any("." in row for row in rows[:1000])
    ):
        found = f"{names} names above {width} cells, none of which has a decimal point"
        advice = "export it with decimal points, or with semicolons or tabs between the columns"
        raise InputError(path, "commas either between columns or in numbers", found, advice)


def _header(lines: list[str], style: _Style, width: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return names and units from the text above a block, "" for none."""
    rows = [cells for line in lines if any(cells := style.cells(line.lstrip("#% ")))]
    blank = ("",) * width
    named = [sum(cell != "" for cell in row) >= min(2, width) for row in rows]
    for name, unit in ((-2, -1), (-1, -2)) if len(rows) > 1 else ():
        if named[name] and _is_unit_row(rows[unit]):  # clock times have none: a single unit may be all
            return _fit(rows[name], width), tuple(map(without_brackets, _fit(rows[unit], width)))
    if not rows or not named[-1]:
        return blank, blank
    split = [split_name(cell) for cell in _fit(rows[-1], width)]
    return tuple(name for name, _ in split), tuple(unit for _, unit in split)


def _is_unit_row(cells: list[str]) -> bool:
    """Return whether short cells are a row of units: at least two, and half of them, known or bracketed."""
    filled = [cell for cell in cells if cell]
    known = [cell for cell in filled if unit_of(cell) or (cell[0] in "([" and cell[-1] in ")]")]
    return len(known) >= min(2, len(filled)) and 2 * len(known) >= len(filled) and max(map(len, filled)) <= 12


def _fit(cells: list[str], width: int) -> tuple[str, ...]:
    """Return exactly `width` cells: cut off, or padded with ""."""
    return tuple([*(cell.strip()[: _Most.letters] for cell in cells[:width]), *[""] * width][:width])


def _drop_empty(table: Table) -> Table:
    """Remove empty columns without a name, which come from a separator at the end of each line."""
    keep = [k for k, name in enumerate(table.names) if name or np.isfinite(table.numbers[:, k]).any()]
    names, units = (tuple(part[k] for k in keep) for part in (table.names, table.units))
    return replace(table, names=names, units=units, numbers=table.numbers[:, keep])


def _suffixed_column(path: Path, lines: list[str], encoding: str) -> Table:
    """Read a single column, of which every line contains the unit, as in "0.00 N1", or none does."""
    short = [line for line in lines if len(line) <= _Most.letters]
    found = [match for line in short if (match := _SUFFIXED.match(line))]
    plain = [line for line in short if re.fullmatch(_Style(";", ".").number, line.strip())]
    if max(len(found), len(plain)) < LEAST_ROWS:
        wanted = "columns of numbers (time, load, displacement)"
        raise InputError(path, wanted, "no three lines of numbers in a row", _ADVICE)
    facts = {"layout": "one column", "encoding": encoding, "separator": "none", "decimal": "."}
    with_unit = len(found) >= len(plain)
    numbers = [float(match["number"]) for match in found] if with_unit else [float(line) for line in plain]
    unit = found[0]["unit"] if with_unit else ""
    return Table(("",), (unit,), np.array(numbers)[:, np.newaxis], facts)


# --- LabVIEW ------------------------------------------------------------------------------------------------

_Stamp = tuple[int, float]  # day and second of the day
_LONGEST_PAUSE_S = 1.0  # between segments of one recording: saving takes less, another test more


def _labview_tags(lines: list[str], style: _Style) -> dict[str, list[str]]:
    """Return the header of a segment of a LabVIEW file by its tags, {} for another file.

    A tag's cells are those of its whole line: the cell of a channel is in the column of its values. Tags of
    the segment replace those of the file.
    """
    rows = [style.cells(line) for line in lines if line.strip()]
    return {row[0]: row for row in rows} if rows and rows[-1][0] == "X_Value" else {}


def _with_labview_times(path: Path, table: Table, tags: dict[str, list[str]]) -> Table:
    """Return a LabVIEW segment with one column of times, and the units of its channels.

    Times are X_Value, in one column or one for each channel, or X0 + i Delta_X where that is empty. They
    remain X_Value where X_Dimension is not the time.  Raises: InputError if channels have times of their own.
    """
    width = len(table.names)

    def cell(tag: str, k: int) -> str:
        return _fit(tags.get(tag, []), width)[k]

    def value(tag: str, k: int) -> float:
        return number(cell(tag, k).replace(",", "."))

    x = [k for k, name in enumerate(table.names) if name == "X_Value"]
    channels = [k for k in range(width) if k not in x and np.isfinite(table.numbers[:, k]).any()]
    units = [cell("Y_Unit_Label", k) or unit for k, unit in enumerate(table.units)]
    if not channels or (cell("X_Dimension", channels[0]) or "Time").casefold() != "time":
        return replace(table, units=tuple(units))
    times: Floats | None = None
    for k in channels:
        own: Floats = table.numbers[:, max((column for column in x if column < k), default=0)]
        if not np.isfinite(own).any():
            own = value("X0", k) + value("Delta_X", k) * np.arange(len(own), dtype=np.float64)
        if times is None:
            times, first = own, k
        elif np.nanmax(np.abs(own - times), initial=0) > 0.5 * np.nanmedian(np.abs(np.diff(times))):
            found = f'"{table.names[first]}" and "{table.names[k]}" at different times'
            raise InputError(path, "channels at the same times", found, "save them with one X column")
    numbers = table.numbers.copy()
    numbers[:, x[0]], units[x[0]] = times, "s"
    keep = [k for k in range(width) if k not in x[1:]]
    names = ["Time" if k in x else table.names[k] for k in keep]
    return replace(table, names=tuple(names), units=tuple(units[k] for k in keep), numbers=numbers[:, keep])


def _stamp_of(tags: dict[str, list[str]]) -> _Stamp | None:
    """Return when a segment begins; None where its header does not state it."""
    day, clock = ("".join(tags.get(tag, [])[1:2]) for tag in ("Date", "Time"))
    with contextlib.suppress(ValueError):  # not the year first, as LabVIEW writes it
        year, month, of_month = map(int, day.split("/"))
        hour, minute, second = clock.replace(",", ".").split(":")
        return date(year, month, of_month).toordinal(), 3600 * int(hour) + 60 * int(minute) + float(second)
    return None


def _continue_segments(tables: list[Table], stamps: list[_Stamp | None]) -> None:
    """Let the times of segments that begin again from X0 go on, by the difference of their stamps.

    Where a segment does not begin about where the one before ends, it is another recording and stays as it
    is.
    """
    for before, table, stamp in zip(tables[:-1], tables[1:], stamps[1:], strict=True):
        first, previous, times = stamps[0], before.numbers[:, 0], table.numbers[:, 0]
        if first and stamp and table.names[0] == before.names[0] == "Time":
            later = 86400 * (stamp[0] - first[0]) + stamp[1] - first[1]
            step = float(np.median(np.diff(previous)))
            end = previous[-1] + step
            if times[0] < end - 0.5 * step and abs(times[0] + later - end) <= _LONGEST_PAUSE_S:
                times += max(later, end - times[0])  # segments do not overlap


# --- Excel --------------------------------------------------------------------------------------------------


def _read_workbook(path: Path) -> list[Table]:
    """Read every block of numbers of an Excel workbook, worksheet by worksheet."""
    tables: list[Table] = []
    for title, rows in worksheets(path):
        lines = ["\t".join(row) for row in rows]
        if style := _find_style(path, lines):
            facts = {"layout": f"Excel, {title}", "encoding": "xlsx", "separator": "cells"}
            tables += _read_blocks(path, lines, style, facts | {"decimal": style.decimal})
    if not tables:
        raise InputError(path, f"{LEAST_ROWS} rows of numbers in a worksheet", "none", _ADVICE)
    return tables


def worksheets(path: Path) -> Iterator[tuple[str, Iterator[list[str]]]]:
    """Yield the title of each worksheet of an Excel workbook, and its rows as cells of text."""
    import openpyxl

    with zipfile.ZipFile(path) as packed:
        size = sum(part.file_size for part in packed.infolist())  # unpacked
    if size > _Most.mixed_bytes:
        wanted = f"a workbook of at most {_Most.mixed_bytes >> 30} GiB when unpacked"
        raise InputError(path, wanted, f"{size >> 20} MiB", "export one table of numbers as text")
    with path.open("rb") as file:  # openpyxl leaves damaged files open, which Windows then does not remove
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about styles and menus, which are not read
            book = openpyxl.load_workbook(file, read_only=True, data_only=True)
        with contextlib.closing(book):
            for sheet in book.worksheets:
                sheet.reset_dimensions()  # stated ones may be wrong
                yield sheet.title, (_written(row, path) for row in sheet.iter_rows(values_only=True))


def _written(row: tuple[object, ...], path: Path) -> list[str]:
    """Return the cells of a row as text, up to the last that is not empty."""
    cells = ["" if cell is None else " ".join(str(cell).split()) for cell in row]
    while cells and not cells[-1]:
        cells.pop()
    _checked_width(len(cells), path)
    return cells


# --- MATLAB -------------------------------------------------------------------------------------------------


def _read_mat(path: Path) -> list[Table]:
    """Return the vectors of a .mat file that share the commonest length, as one table."""
    version, variables = _load_mat(path)
    vectors = dict(_vectors(variables))
    if not vectors:
        raise InputError(
            path, "vectors of time and force", "no numeric vectors", "save them with plain names"
        )
    length = Counter(v.size for v in vectors.values()).most_common(1)[0][0]
    chosen = {name: v for name, v in vectors.items() if v.size == length}
    names, units = zip(*(split_name(name) for name in chosen), strict=True)
    values = np.column_stack(list(chosen.values()))
    return [Table(tuple(names), tuple(units), values, {"layout": f"MATLAB {version}", "encoding": "binary"})]


def _load_mat(path: Path) -> tuple[str, Mapping[str, Any]]:
    """Return the version of a .mat file and its variables by name; fields of groups as "group.field".

    Both parsers can crash or never return on a damaged file, so a separate process reads it first.
    """
    with reading(path, _WANTED_MAT, "save it again"):
        if not h5py.is_hdf5(path):
            try_out(path, READ_MATLAB, _WANTED_MAT)
            return "v5", scipy.io.loadmat(path, squeeze_me=True, struct_as_record=True)
        try_out(path, READ_HDF5, _WANTED_MAT)
        found: dict[str, Any] = {}

        def keep(name: str, item: object) -> None:
            if isinstance(item, h5py.Dataset) and not name.startswith("#"):
                # MATLAB stores column by column, so that HDF5 returns the transposed matrix.
                found[name.replace("/", ".")] = np.squeeze(np.asarray(item).T)

        with h5py.File(path) as file:
            file.visititems(keep)
    return "v7.3", found


def _vectors(variables: Mapping[str, Any], level: int = 0) -> Iterator[tuple[str, Floats]]:
    """Yield numeric vectors, and columns of matrices, with their names."""
    for name, value in variables.items():
        array = np.asarray(value)
        if name.startswith("__"):
            continue
        if array.dtype.names and array.ndim == 0 and level < 20:
            yield from _vectors({f"{name}.{key}": array[key].item() for key in array.dtype.names}, level + 1)
        elif array.dtype.kind in "fiu" and array.ndim == 1 and array.size >= LEAST_ROWS:
            yield name, array.astype(float)
        elif array.dtype.kind in "fiu" and array.ndim == 2 and array.shape[1] <= _Most.matrix_columns:
            yield from ((f"{name} {k + 1}", column.astype(float)) for k, column in enumerate(array.T))


EXCEL = (".xlsx", ".xlsm")
_READERS = {".mat": _read_mat, **dict.fromkeys(EXCEL, _read_workbook)}
