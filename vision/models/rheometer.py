"""Reading of rheometer exports: RheoCompass (Anton Paar) and plain tables."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from vision.data import Metadata, Schema, Variable, record
from vision.errors import InputError
from vision.files import check_regular, decode_text
from vision.force.files import split_name


@dataclass(frozen=True, kw_only=True)
class RotationMetadata(Metadata):
    """Metadata of the table of one rotation."""

    source: str = "the rheometer's file"  # path
    measurement: str = "1"  # result and interval, unique within the file
    notes: Sequence[str] = field(default_factory=list)  # assumptions
    warnings: Sequence[str] = field(default_factory=list)  # possible errors of the numbers
    left_out: Sequence[str] = field(default_factory=list)  # unusable results and intervals, with the reason


_ROW = ("sample",)
ROTATION = Schema(
    "rotation",
    "vision.models.rheometer.read_rheometer",
    {
        "time_s": Variable(_ROW, "s", "time"),
        "angle_rad": Variable(_ROW, "rad", "deflection angle"),
        "torque_N_m": Variable(_ROW, "N m", "torque"),
        "normal_force_N": Variable(_ROW, "N", "normal force"),
    },
    needs=("time_s", "angle_rad", "torque_N_m"),
    kind=pd.DataFrame,
)

_TORQUE = {"Nm": 1.0, "mNm": 1e-3, "µNm": 1e-6, "nNm": 1e-9, "Nmm": 1e-3, "cNm": 1e-2, "mNmm": 1e-6}
_ANGLE = {
    "rad": 1.0,
    "mrad": 1e-3,
    "µrad": 1e-6,
    "°": math.pi / 180,
    "deg": math.pi / 180,
    "rev": 2 * math.pi,
}
_FORCE = {"N": 1.0, "mN": 1e-3, "µN": 1e-6, "kN": 1e3}
_TIME = {"s": 1.0, "sec": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0}


@dataclass(frozen=True)
class _Quantity:
    """Rules by which the column of a quantity is recognised."""

    column: str  # name in `ROTATION`
    words: tuple[str, ...]  # one of which is in its name
    never: tuple[str, ...]  # none of which is in its name
    units: Mapping[str, float]  # possible units, with their factors to SI
    default_unit: str = ""  # unit if none is written


_QUANTITIES = (
    _Quantity("torque_N_m", ("torque", "drehmoment", "couple", "moment"), ("force", "speed"), _TORQUE),
    _Quantity(
        "angle_rad",
        ("angle", "angular deflection", "angular displacement", "winkel"),
        ("phase", "loss", "shift"),
        _ANGLE,
    ),
    _Quantity(
        "normal_force_N",
        ("normal force", "axial force", "normalkraft", "force normale"),
        ("stress",),
        _FORCE,
        "N",
    ),
    _Quantity("time_s", ("time", "zeit", "temps"), ("date", "stamp"), _TIME, "s"),
)
_MARKS = ("Project:", "Test:", "Result:", "Interval and data points:", "Interval data:")
_SEPARATORS = ("\t", ";", ",")


def read_rheometer(path: str | Path) -> list[pd.DataFrame]:
    """Read every rotation in a file of a rheometer.

    Parameters
    ----------
    path
        RheoCompass export (Anton Paar; UTF-16 or UTF-8; tab, semicolon or comma; several results and
        intervals), or a plain table whose header names torque and angle with their units, as in ``Torque
        [mN·m]``. Units: mN·m, µN·m, N·m; mrad, rad, °; N, mN.

    Returns
    -------
    list of pandas.DataFrame
        One per measurement in file order, columns as in `ROTATION` (NaN in the normal force where a cell is
        empty). The angle starts at 0. Angle and torque are positive in the direction of the rotation.
        ``attrs`` as in `RotationMetadata`.

    Raises: InputError if the file is missing, empty or binary, or no part of it has a torque with a known
    unit and a rotation.

    Notes
    -----
    Intervals of one result are one measurement if the second continues at the angle and the normal force at
    which the first ended (a fine sampling of the peak, then a coarse one). Intervals without rotation
    (approach, waiting) are left out, with a note. A result that cannot be used does not affect the others.
    """
    path = Path(path)
    check_regular(path, "a rheometer's file")
    lines = decode_text(path, path.read_bytes(), "a rheometer's file")[0].splitlines()
    results = [k for k, line in enumerate(lines) if _mark(line) == "Result:"]
    starts = [k for k, line in enumerate(lines) if _mark(line) == "Interval and data points:"]
    blocks = _intervals(lines, starts, results) if starts else [_plain_table(path, lines)]
    for block in blocks:
        if block.problem:
            continue
        try:
            _convert(path, block)
        except InputError as error:
            if len(blocks) == 1:
                raise
            block.problem = error.problem.removeprefix("expected ").replace("; found ", ", but ", 1)
    rotations = _measurements(blocks)
    if not rotations:
        problems = list(dict.fromkeys(block.problem for block in blocks if block.problem))
        found = "; ".join(problems[:3]) or "no rows of numbers"
        raise InputError(path, "a rotation", found, "export torque and deflection angle")
    left_out = _left_out(blocks, {k: _words(lines[k], _separator(lines[k]))[1] for k in results})
    return [_table(path, parts, blocks, left_out) for parts in rotations]


@dataclass
class _Block:
    """One interval of a result."""

    line: int  # line of the file at which its result begins, which distinguishes results of one name
    name: str
    number: str  # of the interval, as the file gives it
    names: list[str] = field(default_factory=list)  # of the columns
    units: list[str] = field(default_factory=list)  # of the columns, as written
    cells: pd.DataFrame = field(default_factory=pd.DataFrame)  # as text
    warnings: list[str] = field(default_factory=list)
    problem: str = ""  # why it is not a measurement; "" if it is
    waiting: bool = False  # whether it has values but no rotation, as before and between measurements
    values: pd.DataFrame = field(default_factory=pd.DataFrame)  # numbers in SI units


def _mark(line: str) -> str:
    """The RheoCompass keyword at the start of a line, "" for none."""
    start = line.lstrip('\ufeff" ')
    return next((mark for mark in _MARKS if start.startswith(mark)), "")


def _separator(line: str) -> str:
    """The most frequent separator in a line."""
    return max(_SEPARATORS, key=line.count)


def _cells(lines: Sequence[str], separator: str) -> pd.DataFrame:
    """Cells as text; short rows are filled with ""."""
    width = max((line.count(separator) for line in lines), default=0) + 1
    return pd.read_csv(
        io.StringIO("\n".join(lines)),
        sep=separator,
        header=None,
        names=list(range(width)),
        dtype=str,
        keep_default_na=False,
        skip_blank_lines=True,
        index_col=False,
        engine="c",
        on_bad_lines="skip",
    ).fillna("")


def _intervals(lines: list[str], starts: list[int], results: list[int]) -> list[_Block]:
    """The intervals of a RheoCompass export."""
    marks = [_mark(line) for line in lines]
    blocks: list[_Block] = []
    for place, start in enumerate(starts, 1):
        stop = next(
            (k for k in range(start + 1, len(lines)) if marks[k] not in ("", "Interval data:")), len(lines)
        )
        before = max((k for k in results if k < start), default=-1)
        separator = _separator(lines[start])
        result = "" if before < 0 else _words(lines[before], separator)[1]
        _, number, announced, *_ = _words(lines[start], separator)
        number = number or str(place)
        block = _Block(before, f"{result or 'result'}, interval {number}", number)
        header = next((k for k in range(start, stop) if marks[k] == "Interval data:"), stop)
        if header + 1 >= stop:
            block.problem = "no 'Interval data:' with columns and rows"
        else:
            _read_interval(block, lines[header:stop], announced)
        blocks.append(block)
    repeated = {b.name for b in blocks if sum(b.name == other.name for other in blocks) > 1}
    for place, block in enumerate(blocks, 1):
        if block.name in repeated:
            block.name += f" (no. {place} in the file)"
    return blocks


def _words(line: str, separator: str) -> list[str]:
    """Cells of a line with a keyword, padded to at least three."""
    return [*(cell.strip().strip('"').strip() for cell in line.split(separator)), "", ""]


def _read_interval(block: _Block, lines: list[str], announced: str) -> None:
    """Fill an interval: a row of names, rows of which the last has the units in brackets, then data.
    announced: number of points, as written."""
    cells = _cells(lines, _separator(lines[0])).map(str.strip)
    block.names = [str(cell) for cell in cells.iloc[0, 1:]]
    block.units = [""] * len(block.names)
    first = 1
    for row in range(1, min(4, len(cells))):
        written = [str(cell) for cell in cells.iloc[row, 1:]]
        if any(cell.startswith("[") for cell in written):
            block.units, first = written, row + 1
            break
    data = cells.iloc[first:, 1:].reset_index(drop=True)
    data = block.cells = data[(data != "").any(axis=1)]
    if announced.isdecimal() and int(announced) != len(data):
        block.warnings.append(f"{block.name} announces {announced} points and has {len(data)}")


def _plain_table(path: Path, lines: list[str]) -> _Block:
    """A plain table: its header names a torque, and the units are in the header or in the row below."""
    header = next((k for k, line in enumerate(lines) if _looks_like_header(line)), None)
    if header is None:
        shown = next((line.strip()[:60] for line in lines if line.strip()), "nothing")
        raise InputError(path, "a torque column", f"the first line '{shown}'", "name it: Torque [mN·m]")
    cells = _cells(lines[header:], _separator(lines[header])).map(str.strip)
    known = {unit for quantity in _QUANTITIES for unit in quantity.units}
    # "torque_N_m" and "Torque in mN m": a unit of two words
    headers = [re.sub("N[ _](?=mm?$)", "N", str(cell).lstrip("#% ")) for cell in cells.iloc[0]]
    split = [split_name(header, lambda text: _unit(text) in known) for header in headers]
    names, units = [name.replace("_", " ") for name, _ in split], [unit for _, unit in split]
    first = 1
    if len(cells) > 1 and not any(units) and not _numbers(cells.iloc[1]).notna().any():
        units, first = [str(cell) for cell in cells.iloc[1]], 2
    return _Block(-1, path.stem, "1", names, units, cells.iloc[first:].reset_index(drop=True))


def _looks_like_header(line: str) -> bool:
    """Whether a line has several cells, one of which names a torque."""
    low = line.lower()
    if len(line) > 5000:  # not a header, and slow to split
        return False
    return max(map(line.count, _SEPARATORS)) > 0 and any(word in low for word in _QUANTITIES[0].words)


_NO_SIGN = str.maketrans(dict.fromkeys("·⋅•∙*. _-[]()") | {"μ": "µ"})


def _unit(text: str) -> str:
    """The unit without brackets, spaces and multiplication signs: "[mN·m]" becomes "mNm"."""
    plain = text.strip().translate(_NO_SIGN)
    return "µ" + plain[1:] if plain[:1] == "u" and plain[1:] in ("Nm", "N", "rad") else plain


def _convert(path: Path, block: _Block) -> None:
    """Set the values of an interval in SI units, or the problem for which it is not a rotation.

    Raises: InputError for an unknown unit.
    """
    found = {q.column: column for q in _QUANTITIES if (column := _column(path, block, q)) is not None}
    for name, what in (("torque_N_m", "torque"), ("angle_rad", "deflection angle")):
        if name not in found:
            block.problem = f"no {what} (columns: {', '.join(filter(None, block.names))})"
            return
    values = pd.DataFrame({"time_s": np.nan} | found)
    known = values[["torque_N_m", "angle_rad"]].notna().all(axis=1)
    if int((~known).sum()):
        block.warnings.append(f"{block.name}: {int((~known).sum())} of {len(values)} points without numbers")
    block.values = values[known].reset_index(drop=True)
    travelled = float(np.ptp(block.values["angle_rad"])) if len(block.values) else 0.0
    if travelled < math.radians(0.05):
        block.problem = f"no rotation ({math.degrees(travelled):.2g}° travelled)"
        block.waiting = len(block.values) > 0


def _column(path: Path, block: _Block, quantity: _Quantity) -> pd.Series[float] | None:
    """The values of one quantity in its SI unit; None without such a column."""
    low = [name.lower() for name in block.names]
    possible = [k for k, name in enumerate(low) if any(word in name for word in quantity.words)]
    possible = [k for k in possible if not any(word in low[k] for word in quantity.never)]
    if not possible:
        return None
    with_unit = [k for k in possible if _unit(block.units[k]) in quantity.units]
    k = min(with_unit or possible, key=lambda index: len(low[index]))  # "Time" before "Interval Time"
    unit = _unit(block.units[k]) or quantity.default_unit
    if unit not in quantity.units:
        written = f'"{block.units[k]}"' if unit else "no unit"
        wanted = f'a unit of "{block.names[k]}" among {", ".join(quantity.units)}'
        advice = f"write it in the header, as in {block.names[k]} [{next(iter(quantity.units))}]"
        raise InputError(path, wanted, written, advice)
    return _numbers(block.cells.iloc[:, k]) * quantity.units[unit]


def _numbers(cells: pd.Series[Any]) -> pd.Series[float]:
    """Numbers from text with a decimal point or comma; NaN where the text is not a number. Where cells have
    both, the last mark is the decimal one, and the other separates thousands."""
    text = cells.astype(str)
    comma = text.str.contains(",", regex=False)
    both = text[comma & text.str.contains(".", regex=False)]
    if len(both) and (both.str.rfind(",") < both.str.rfind(".")).all():
        text = text.str.replace(",", "", regex=False)
    elif comma.any():
        text = text if both.empty else text.str.replace(".", "", regex=False)
        text = text.str.replace(",", ".", regex=False)
    numbers: pd.Series[float] = pd.to_numeric(text, errors="coerce").astype(float)
    return numbers


def _measurements(blocks: list[_Block]) -> list[list[_Block]]:
    """The usable intervals, grouped by measurement."""
    groups: list[list[_Block]] = []
    previous: _Block | None = None
    for block in blocks:
        if not block.problem:
            if previous is not None and not previous.problem and _continues(previous, block):
                groups[-1].append(block)
            else:
                groups.append([block])
        previous = block
    return groups


def _continues(first: _Block, second: _Block) -> bool:
    """Whether the second interval continues the first: same result, direction, angle and normal force."""
    if first.line != second.line:
        return False
    a, b = first.values["angle_rad"].to_numpy(), second.values["angle_rad"].to_numpy()
    direction = np.sign(a[-1] - a[0])
    step = (b[0] - a[-1]) * direction
    if np.sign(b[-1] - b[0]) != direction or not 0 <= step <= 0.05 * (np.ptp(a) + np.ptp(b)):
        return False
    if "normal_force_N" not in first.values or "normal_force_N" not in second.values:
        return True
    low, high = sorted(abs(float(part.values["normal_force_N"].mean())) for part in (first, second))
    return high <= 1.1 * low


def _left_out(blocks: list[_Block], results: Mapping[int, str]) -> list[str]:
    """Results and intervals without a usable measurement, with the reason. A result without any is one line;
    otherwise each interval is. results: names by line of the file."""
    found: list[str] = []
    for line in dict.fromkeys([*results, *(block.line for block in blocks)]):
        of_result = [block for block in blocks if block.line == line]
        unusable = [block for block in of_result if block.problem and not block.waiting]
        if not of_result:
            found.append(f"{results[line] or 'a result'}: no interval with data")
        elif unusable and all(block.problem for block in of_result):
            found.append(f"{results.get(line) or of_result[0].name}: {unusable[0].problem}")
        else:
            found += [f"{block.name}: {block.problem}" for block in unusable]
    return found


def _table(path: Path, parts: list[_Block], blocks: list[_Block], left_out: Sequence[str]) -> pd.DataFrame:
    """Table of one measurement: its intervals joined, with the angle from 0 and signs along the rotation."""
    table = pd.concat([part.values for part in parts], ignore_index=True)
    time = table["time_s"].to_numpy(float)
    if not np.all(np.diff(time) >= 0):
        # "Interval Time" starts again at 0 in each interval; without times only the order is known.
        steps = np.diff(time, prepend=time[:1])
        typical = float(np.median(steps[steps > 0])) if (steps > 0).any() else 1.0
        table["time_s"] = np.cumsum(np.where(steps >= 0, steps, typical))
    angle = table["angle_rad"].to_numpy(float)
    direction = 1.0 if angle[-1] >= angle[0] else -1.0
    table["angle_rad"] = direction * (angle - angle[0])
    torque = direction * table["torque_N_m"]
    table["torque_N_m"] = torque if float(torque.mean()) >= 0 else -torque
    waiting = [block for block in blocks if block.waiting and block.line == parts[0].line]
    name = parts[0].name
    if len(parts) > 1:
        name += f" to {parts[-1].number}"
    facts = RotationMetadata(
        source=str(path),
        measurement=name,
        notes=[f"left out: {block.name}: {block.problem}" for block in waiting],
        warnings=[line for part in parts for line in part.warnings],
        left_out=left_out,
    )
    columns = [name for name in ROTATION.variables if name in table]
    table = table[columns]
    table.attrs.update(facts.attrs())
    return record(table, "read_rheometer", path=str(path))
