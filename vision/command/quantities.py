"""Lengths with units, seconds and sheets, as typed on the command line."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

from vision.errors import InputError

if TYPE_CHECKING:
    from vision.spacetime import Sheet

UM_PER = {"mm": 1000.0, "um": 1.0, "µm": 1.0, "μm": 1.0}  # micro sign and Greek mu


def parse_length(text: str, option: str) -> dict[str, float]:
    """A positive length with its unit: {"width_um": …} for mm, um and µm, {"width_px": …} for px.

    Raises: InputError; a number without a unit is refused, as µm and px are both likely.
    """
    match = re.fullmatch(r"\s*([0-9.]+(?:[eE][+-]?\d+)?)\s*(mm|um|µm|μm|px)\s*", text)
    value = _float(match[1]) if match else math.nan
    if match is None or not 0 < value < math.inf:
        raise InputError(option, "a length with its unit: mm, um, µm or px", f"'{text}'", "write 0.2mm")
    unit = match[2]
    return {"width_px": value} if unit == "px" else {"width_um": value * UM_PER[unit]}


def parse_seconds(text: str | None, option: str) -> tuple[float | None, float | None] | None:
    """`A:B` in seconds, half-open, either end may be left out; None for all.  Raises: InputError."""
    if text is None:
        return None
    first, colon, last = text.partition(":")
    start = _float(first) if first.strip() else None
    stop = _float(last) if last.strip() else None
    ends = [end for end in (start, stop) if end is not None]
    if not colon or not ends or not all(map(math.isfinite, ends)) or ends != sorted(set(ends)):
        raise InputError(option, "two times in seconds A:B with A < B", f"'{text}'", "write 40:45.1")
    return start, stop


def parse_sheets(texts: Sequence[str] | None) -> list[Sheet]:
    """Sheets as side and number (right:23) or index from the left (47), several with commas.

    Raises: InputError.
    """
    return [_sheet(part.strip()) for text in texts or () for part in text.split(",")]


def _sheet(text: str) -> Sheet:
    if text.isdecimal():
        return int(text)
    side, _, n = text.partition(":")
    if side not in ("left", "right") or not n.isdecimal() or int(n) < 1:
        raise InputError("--sheet", "a side and a number, or an index", f"'{text}'", "write right:23 or 47")
    return side, int(n)


def _float(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
