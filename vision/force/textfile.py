"""Text recordings: encoding, separator, decimal mark, header and blocks found; pandas reads the numbers."""

from __future__ import annotations

import csv
import io
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vision.errors import InputError
from vision.force.table import Table
from vision.force.units import bare, split_name, unit_of

_WHITESPACE = r"\s+"
_SEPARATORS = ("\t", ";", ",", "|", _WHITESPACE)
_SEPARATOR_NAMES = {"\t": "tab", ";": "semicolon", ",": "comma", "|": "bar", _WHITESPACE: "spaces"}
_NOT_A_NUMBER = ("nan", "n/a", "#n/a", "na", "inf", "-inf", "+inf", "--", "---", "")
_MIN_ROWS = 3
_SAMPLE = 400
_SUFFIXED = re.compile(r"^\s*(?P<number>[-+]?\d*\.?\d+(?:[eE][-+]?\d+)?)\s*(?P<unit>[A-Za-zµ]+?)\d*\s*$")


def read_text(path: Path) -> list[Table]:
    """Every block of numbers of a text recording, in file order.

    Layouts: MTS TestSuite (text and CSV), MTS 793, Instron Bluehill, Zwick TRA, plain tables with or without
    a header, one column with a unit in each line.  Raises InputError where no block of 3 rows of numbers is
    found.
    """
    text, encoding = _decode(path)
    lines = text.splitlines()
    style = _find_style(lines)
    if style is None:
        return [_suffixed_column(path, lines, encoding)]
    facts = {
        "layout": _layout(lines),
        "encoding": encoding,
        "separator": _SEPARATOR_NAMES[style.separator],
        "decimal": style.decimal,
    }
    return _read_blocks(lines, style, facts)


def _decode(path: Path) -> tuple[str, str]:
    data = path.read_bytes()
    if not data.strip():
        raise InputError(path, "a force recording", "an empty file")
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return data.decode("utf-16", errors="replace"), "utf-16"
    if b"\x00" in data[:4096]:
        raise InputError(
            path, "a text table or a MATLAB .mat", "a binary file", "export the recording as text or CSV"
        )
    for encoding in ("utf-8-sig", "cp1252"):
        try:
            return data.decode(encoding), _encoding_name(data, encoding)
        except UnicodeDecodeError:
            continue
    return data.decode("latin-1"), "latin-1"


def _encoding_name(data: bytes, encoding: str) -> str:
    if encoding == "cp1252":
        return "latin-1"
    return "utf-8 with BOM" if data.startswith(b"\xef\xbb\xbf") else "utf-8"


@dataclass(frozen=True)
class _Style:
    """A separator and a decimal mark, and the patterns of a cell and of a whole line of numbers."""

    separator: str
    decimal: str

    @property
    def number(self) -> str:
        mark = re.escape(self.decimal)
        return rf"[-+]?(?:\d+(?:{mark}\d*)?|{mark}\d+)(?:[eE][-+]?\d+)?"

    def patterns(self) -> tuple[re.Pattern[str], re.Pattern[str]]:
        words = "|".join(re.escape(word) for word in _NOT_A_NUMBER if word)
        value = rf"(?:{self.number}|{words})"
        if self.separator == _WHITESPACE:
            line = rf"\s*{value}(?:\s+{value})+\s*"
        else:
            # Where comma is both separator and decimal mark only quotes tell them apart.
            cell = (
                rf'[ ]*"[ ]*{value}?[ ]*"[ ]*'
                if self.separator == self.decimal
                else rf'[ ]*"?[ ]*{value}?[ ]*"?[ ]*'
            )
            line = rf"{cell}(?:{re.escape(self.separator)}{cell})+"
        return re.compile(self.number), re.compile(line, re.IGNORECASE)

    def cells(self, line: str) -> list[str]:
        if self.separator != _WHITESPACE:
            return [cell.strip() for cell in next(csv.reader([line], delimiter=self.separator), [])]
        return re.split(r"\s{2,}|\t", line.strip()) if re.search(r"\S\s{2,}\S|\t", line) else line.split()


def _data_lines(lines: list[str], style: _Style) -> NDArray[np.bool_]:
    """Which lines hold numbers: all cells, or at least two of them and half of the cells."""
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


def _find_style(lines: list[str]) -> _Style | None:
    """The separator and decimal mark under which most lines are numbers; None where none are."""
    middle = len(lines) // 2
    sample = [*lines[:_SAMPLE], *lines[max(_SAMPLE, middle) : middle + _SAMPLE]]
    styles = [_Style(separator, decimal) for separator in _SEPARATORS for decimal in (".", ",")]
    counts = [int(_data_lines(sample, style).sum()) for style in styles]
    best = int(np.argmax(counts))
    return styles[best] if counts[best] >= _MIN_ROWS else None


def _layout(lines: list[str]) -> str:
    head = "\n".join(lines[:40]).lower()
    known = {
        "mts793": "MTS 793",
        "file path:": "MTS TestSuite",
        "bluehill": "Instron Bluehill",
        "maximum load :": "Instron Bluehill",
        "prouvette": "Zwick TRA",
        "specimen thickness": "Zwick TRA",
        "probendicke": "Zwick TRA",
    }
    return next((name for mark, name in known.items() if mark in head), "table")


def _read_blocks(lines: list[str], style: _Style, facts: dict[str, str]) -> list[Table]:
    tables: list[Table] = []
    header_from = 0
    for start, stop in _runs(lines, style):
        values = _numbers([line for line in lines[start:stop] if line.strip()], style)
        names, units = _header(lines[header_from:start], style, values.shape[1])
        if tables and not any(names) and values.shape[1] == tables[-1].numbers.shape[1]:
            # A remark between two runs of numbers is not a header: the columns go on as before.
            names, units = tables[-1].names, tables[-1].units
        tables.append(_drop_empty(Table(names, units, values, facts)))
        header_from = stop
    return tables


def _runs(lines: list[str], style: _Style) -> list[tuple[int, int]]:
    """[start, stop) of each run of at least 3 data lines; blank lines do not end a run."""
    data = _data_lines(lines, style)
    breaks = np.array([bool(line.strip()) for line in lines]) & ~data
    run = np.cumsum(breaks)
    rows = np.flatnonzero(data)
    if not rows.size:
        return []
    first = np.flatnonzero(np.r_[True, np.diff(run[rows]) > 0])
    last = np.r_[first[1:], rows.size] - 1
    return [
        (int(rows[a]), int(rows[b]) + 1) for a, b in zip(first, last, strict=True) if b - a + 1 >= _MIN_ROWS
    ]


def _numbers(lines: list[str], style: _Style) -> NDArray[np.float64]:
    import pandas as pd

    if style.separator == _WHITESPACE:
        width = max(len(line.split()) for line in lines)
    else:
        width = max(line.count(style.separator) for line in lines) + 1
    frame = pd.read_csv(
        io.StringIO("\n".join(lines)),
        sep=style.separator,
        decimal=style.decimal,
        header=None,
        names=list(range(width)),
        na_values=list(_NOT_A_NUMBER[1:]),
        skipinitialspace=True,
        skip_blank_lines=False,
        index_col=False,
        low_memory=False,
    )
    return np.column_stack([_as_floats(frame[column], style.decimal) for column in frame.columns])


def _as_floats(column: object, decimal: str) -> NDArray[np.float64]:
    import pandas as pd

    series = pd.Series(column)
    if not pd.api.types.is_numeric_dtype(series):
        series = pd.to_numeric(series.astype(str).str.strip().str.replace(decimal, "."), errors="coerce")
    return series.to_numpy(dtype=float)


def _header(lines: list[str], style: _Style, width: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names and units from the text above a block, "" where there is none."""
    rows = [style.cells(line.lstrip("#% ")) for line in lines if line.strip()]
    blank = ("",) * width
    if not rows or len([cell for cell in rows[-1] if cell]) < min(2, width):
        return blank, blank
    if _is_unit_row(rows[-1]) and len(rows) > 1:
        names = _fit(rows[-2], width)
        return names, tuple(bare(cell) for cell in _fit(rows[-1], width))
    split = [split_name(cell) for cell in _fit(rows[-1], width)]
    return tuple(name for name, _ in split), tuple(unit for _, unit in split)


def _is_unit_row(cells: list[str]) -> bool:
    """A row under the names: short cells, at least two and half of them a known unit or bracketed."""
    filled = [cell for cell in cells if cell]
    known = [cell for cell in filled if unit_of(cell) or (cell[0] in "([" and cell[-1] in ")]")]
    return len(known) >= min(2, len(filled)) and 2 * len(known) >= len(filled) and max(map(len, filled)) <= 12


def _fit(cells: list[str], width: int) -> tuple[str, ...]:
    return tuple([*(cell.strip() for cell in cells), *[""] * width][:width])


def _drop_empty(table: Table) -> Table:
    """Without the nameless columns that hold nothing: the trace of a separator at the end of each line."""
    keep = [k for k, name in enumerate(table.names) if name or np.isfinite(table.numbers[:, k]).any()]
    return Table(
        tuple(table.names[k] for k in keep),
        tuple(table.units[k] for k in keep),
        table.numbers[:, keep],
        table.facts,
    )


def _suffixed_column(path: Path, lines: list[str], encoding: str) -> Table:
    """One column whose every line carries its unit, as in "0.00 N1", or no unit at all."""
    found = [match for line in lines if (match := _SUFFIXED.match(line))]
    plain = [line for line in lines if re.fullmatch(_Style(";", ".").number, line.strip())]
    if max(len(found), len(plain)) < _MIN_ROWS:
        raise InputError(
            path,
            "columns of numbers (time, load, displacement)",
            "no three lines of numbers in a row",
            "export the recording as text with one row per sample",
        )
    facts = {"layout": "one column", "encoding": encoding, "separator": "none", "decimal": "."}
    if len(found) >= len(plain):
        values = np.array([float(match["number"]) for match in found])
        return Table(("",), (found[0]["unit"],), values[:, np.newaxis], facts)
    return Table(("",), ("",), np.array([float(line) for line in plain])[:, np.newaxis], facts)
