"""read_timestamps(): the camera's own times from a text or CSV file."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vision.errors import InputError

_SECONDS = {"s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "ns": 1e-9}
_UNIT = re.compile(r"(?:^|[\s_(\[.,;/-])(s|sec|seconds|ms|us|µs|μs|ns)(?:$|[\s)\],;])", re.IGNORECASE)
_TIME_NAME = re.compile(r"time|stamp|zeit|temps", re.IGNORECASE)


def read_timestamps(path: Path) -> tuple[NDArray[np.float64], tuple[str, ...]]:
    """Times of all frames, in s, and what is odd about them.

    One time per line, or columns divided by comma, semicolon, tab or space; a header names the column
    ("time", "timestamp") and its unit: `time_ms`, `Timestamp (us)`, `t [ns]`. Lines starting with # are
    header too. Without a header the last column is taken when there are two (number, time), and the unit is
    s.
    Raises: InputError for a missing or empty file, or text where a number is due.
    """
    lines = _lines(path)
    header = [line for line in lines if not _numbers(line)]
    rows = [numbers for line in lines if (numbers := _numbers(line))]
    if not rows:
        raise InputError(path, "one time per line", "no numbers", "give one time per frame, in s")
    first_row = next(n for n, line in enumerate(lines) if _numbers(line))
    if len(header) > first_row:
        broken = next(line for line in lines[first_row:] if not _numbers(line))
        raise InputError(path, "a number in every line", repr(broken[:40]))
    widths = {len(row) for row in rows}
    if len(widths) > 1:
        raise InputError(path, "the same number of columns in every line", f"{min(widths)} to {max(widths)}")
    column, unit_s = _column(header[-1] if header else "", len(rows[0]))
    times_s = np.array([row[column] for row in rows]) * unit_s
    if not np.isfinite(times_s).all():
        raise InputError(path, "a time for every frame", "NaN or infinity")
    return times_s, _oddities(times_s, path)


def _lines(path: Path) -> list[str]:
    try:
        text = path.read_text(encoding="utf-8-sig", errors="replace")
    except OSError as error:
        found = error.strerror or type(error).__name__
        raise InputError(path, "a readable file of time stamps", found) from None
    return [line.strip() for line in text.splitlines() if line.strip()]


def _cells(line: str) -> list[str]:
    parts = re.split(r"[;\t]", line) if re.search(r"[;\t]", line) else line.split(",")
    return [cell.strip() for cell in (parts if len(parts) > 1 else line.split())]


def _numbers(line: str) -> list[float]:
    """The line's numbers; none where a cell is no number. Beside ; or tab decimal commas are understood."""
    cells = [cell for cell in _cells(line) if cell]
    if re.search(r"[;\t]", line):
        cells = [cell.replace(",", ".") for cell in cells]
    try:
        return [float(cell) for cell in cells]
    except ValueError:
        return []


def _column(header: str, width: int) -> tuple[int, float]:
    """Which column holds times, and its unit in s."""
    names = [name for name in _cells(header.lstrip("# ")) if name] if width > 1 else [header.lstrip("# ")]
    place = next((n for n, name in enumerate(names) if _TIME_NAME.search(name)), width - 1)
    place = place if place < width else width - 1
    unit = _UNIT.search(names[place] if place < len(names) else header)
    return place, _SECONDS[unit.group(1).lower()] if unit else 1.0


def _oddities(times_s: NDArray[np.float64], path: Path) -> tuple[str, ...]:
    steps = np.diff(times_s)
    backwards = np.flatnonzero(steps <= 0)
    if backwards.size:
        where = int(backwards[0]) + 1
        return (f"{path.name}: {backwards.size} time(s) do not grow, the first at frame {where}",)
    return ()
