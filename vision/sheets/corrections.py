"""Doubtful stretches, and the decisions that settle them by hand.

`doubtful_stretches` lists where an identity was doubted, and why; a TOML file says what to do about them, and
about the sheets as a whole:

.. code-block:: toml

    [[accept]]            # the doubted ridge is this sheet
    sheet = 0
    frames = "226:355"    # half-open, as in the film; "226:" goes to the end

    [[leave_out]]         # no position here, whatever was found
    sheet = 3
    frames = "10:12"

    [[swap]]              # these two were taken for each other
    sheets = [4, 5]
    frames = "60:61"

    [[assign]]            # the ridge at this column of the first frame, followed from there
    sheet = 6
    frames = "80:111"
    x_px = 687.0

    [[add]]               # this ridge is a sheet that was not counted, followed both ways
    frame = 500
    x_px = 312.0

    [[delete]]            # this is no sheet
    sheet = 12

    [[axis]]              # the symmetry axis
    x_px = 959.5

    [[strip]]             # the rows that are averaged
    rows = "60:144"

    [[clock]]             # force clock at video time 0, and its drift if known
    offset_s = 36.0024
    drift_ppm = -181.4

`sheet` is the index from the left, as in tracks.csv. Every entry may hold ``date``. Entries with a date are
applied in its order, each to what those before it left: an index is the one seen at that date. Entries
without go first, their indices those of the tracking. Of several axes, strips or clocks the last
counts. ``[run]`` names the film that the decisions are about; entries under ``[[undone]]`` do nothing.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from datetime import date as day
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from vision.errors import InputError
from vision.numeric import Bools, Ints
from vision.sheets.recovery import DOUBTS

KEYS: Mapping[str, tuple[str, ...]] = {
    "accept": ("sheet", "frames"),
    "leave_out": ("sheet", "frames"),
    "swap": ("sheets", "frames"),
    "assign": ("sheet", "frames", "x_px"),
    "add": ("frame", "x_px"),
    "delete": ("sheet",),
    "axis": ("x_px",),
    "strip": ("rows",),
    "clock": ("offset_s",),
}
"""Kinds of corrections, and what an entry of each must hold."""
OPTIONAL: Mapping[str, tuple[str, ...]] = {"clock": ("drift_ppm",)}
"""What else an entry may hold, beside its date."""
OF_STRETCHES = ("accept", "leave_out", "swap", "assign")
OF_SHEETS = (*OF_STRETCHES, "add", "delete")
"""Kinds that change which ridge is which sheet; the others change one number of the run."""


@dataclass(frozen=True, kw_only=True)
class Correction:
    """One decision.

    Parameters
    ----------
    kind
        One of `KEYS`.
    sheets
        One index from the left, two for "swap", none where it is about no sheet.
    first, stop
        Frames, half-open, as numbered in the film; stop None is the end. Of "add" the frame of x_px alone.
    x_px
        Column of the ridge in the first frame, for "assign" and "add"; of the axis.
    rows
        Of the strip, half-open.
    offset_s, drift_ppm
        Of the clock.
    date
        When it was made, ISO 8601; "" if not stated.
    name
        What a message calls it.
    """

    kind: str
    sheets: tuple[int, ...] = ()
    first: int = 0
    stop: int | None = None
    x_px: float | None = None
    rows: tuple[int, int] | None = None
    offset_s: float | None = None
    drift_ppm: float = 0.0
    date: str = ""
    name: str = "the correction"

    def text(self) -> str:
        """In words, for the report and the list of decisions."""
        who = " and ".join(f"sheet {k}" for k in self.sheets)
        when = f"frames {self.first}:{'' if self.stop is None else self.stop}"
        match self.kind:
            case "accept":
                return f"doubted ridge accepted as {who}, {when}"
            case "leave_out":
                return f"{who} left out, {when}"
            case "swap":
                return f"{who} swapped, {when}"
            case "assign":
                return f"ridge at {self.x_px:.1f} px assigned to {who}, {when}"
            case "add":
                return f"ridge at {self.x_px:.1f} px of frame {self.first} added as a sheet"
            case "delete":
                return f"{who} deleted"
            case "axis":
                return f"axis at {self.x_px:.1f} px"
            case "strip":
                top, bottom = self.rows or (0, 0)
                return f"strip at rows {top}:{bottom}"
            case _:
                drift = f", drift {self.drift_ppm:.1f} ppm" if self.drift_ppm else ""
                return f"force clock at {self.offset_s:.4f} s at video time 0{drift}"

    @property
    def what(self) -> tuple[str, dict[str, Any]]:
        """What it says, whenever and wherever it was said."""
        return self.kind, replace(self, date="").entry()

    def entry(self) -> dict[str, Any]:
        """As it stands in a file, without its kind."""
        stop = "" if self.stop is None else self.stop
        values: dict[str, Any] = {
            "sheet": self.sheets[0] if self.sheets else None,
            "sheets": list(self.sheets),
            "frames": f"{self.first}:{stop}",
            "frame": self.first,
            "x_px": self.x_px,
            "rows": "" if self.rows is None else f"{self.rows[0]}:{self.rows[1]}",
            "offset_s": self.offset_s,
            "drift_ppm": self.drift_ppm,
        }
        keys = (*KEYS[self.kind], *OPTIONAL.get(self.kind, ()))
        return {key: values[key] for key in keys} | ({"date": self.date} if self.date else {})


@dataclass(frozen=True, kw_only=True)
class Decisions:
    """What a file of corrections holds.

    Parameters
    ----------
    corrections
        In the order in which they count.
    undone
        Taken back, the last one last; they do nothing.
    film
        SHA-256 or fingerprint of the film that they are about; "" if not stated.
    """

    corrections: tuple[Correction, ...] = ()
    undone: tuple[Correction, ...] = ()
    film: str = ""


def last_of(corrections: Sequence[Correction], kind: str) -> Correction | None:
    """The one of this kind that counts: the last; None without any."""
    return next((one for one in reversed(ordered(corrections)) if one.kind == kind), None)


def ordered(corrections: Sequence[Correction]) -> tuple[Correction, ...]:
    """In the order of application: by date; without one first, those that change indices last among them."""
    places = ("delete", "add")

    def key(one: Correction) -> tuple[str, int, int]:
        late = places.index(one.kind) + 1 if not one.date and one.kind in places else 0
        return one.date, late, -one.sheets[0] if late and one.sheets else 0

    return tuple(sorted(corrections, key=key))


def doubtful_stretches(tracks: xr.Dataset) -> pd.DataFrame:
    """Where an identity is in doubt: one row per sheet and unbroken stretch, the longest first.

    Parameters
    ----------
    tracks
        From `vision.track_sheets`.

    Returns
    -------
    pandas.DataFrame
        sheet, side, n; first_frame and last_frame, frames; why (in words); x_withheld_px, the doubted ridge,
        and x_expected_px, where the sheets around say it must be, both in the first frame (NaN if unknown).
    """
    columns = ["sheet", "side", "n", "first_frame", "last_frame", "frames", "why"]
    columns += ["x_withheld_px", "x_expected_px"]
    sheet, first, stop = stretches(np.asarray(tracks["flag"].values == "doubtful"))
    number, side, n = tracks["frame"].values, tracks["side"].values, tracks["n"].values

    def of(name: str, row: Any, column: Any) -> Any:
        return tracks[name].values[row, column] if name in tracks else np.nan

    rows = [
        (
            int(k),
            int(side[k]),
            int(n[k]),
            int(number[a]),
            int(number[b - 1]),
            int(b - a),
            DOUBTS.get(str(of("why", a, k)), "identity not certain"),
            float(of("x_withheld_px", a, k)),
            float(of("x_expected_px", a, k)),
        )
        for k, a, b in zip(sheet, first, stop, strict=True)
    ]
    table = pd.DataFrame(rows, columns=columns)
    return table.sort_values("frames", ascending=False, kind="stable").reset_index(drop=True)


def stretches(marked: Bools) -> tuple[Ints, Ints, Ints]:
    """Unbroken stretches of True in each column of (frame, sheet): sheet, first row, row after the last."""
    edge = np.diff(np.pad(marked.astype(np.int8), ((1, 1), (0, 0))), axis=0)
    sheet, first = np.nonzero((edge == 1).T)
    _, stop = np.nonzero((edge == -1).T)
    return sheet, first, stop


# --- the file -----------------------------------------------------------------------------------------------


def read_corrections(path: str | Path) -> tuple[Correction, ...]:
    """Decisions from a TOML file, in the order in which they count.

    Parameters
    ----------
    path
        The file; see the module for what it holds.

    Raises
    ------
    InputError
        For a file that cannot be read, an unknown kind or key, or a value of the wrong kind; it names the
        entry.
    """
    return read_decisions(path).corrections


def read_decisions(path: str | Path) -> Decisions:
    """All of the file: what `read_corrections` gives, what was undone, and which film they are about.

    Raises
    ------
    InputError
        As `read_corrections`.
    """
    try:
        table = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError) as error:
        raise InputError(path, "a TOML file of corrections", str(error)) from error
    run, undone = table.pop("run", {}), table.pop("undone", [])
    if not isinstance(run, dict) or not isinstance(undone, list):
        raise InputError(path, "[run] and [[undone]] as tables", f"run = {run!r}")
    found = []
    for kind, entries in table.items():
        if kind not in KEYS:
            raise InputError(path, f"entries {', '.join(f'[[{name}]]' for name in KEYS)}", f"'{kind}'")
        if not isinstance(entries, list):
            raise InputError(path, f"[[{kind}]], in two brackets", f"{kind} = {entries!r}")
        found += [
            correction_of(kind, entry, f"{path}, [[{kind}]] {number}")
            for number, entry in enumerate(entries, 1)
        ]
    return Decisions(
        corrections=ordered(found),
        undone=tuple(_undone(path, number, entry) for number, entry in enumerate(undone, 1)),
        film=str(run.get("film", "")),
    )


def _undone(path: str | Path, number: int, entry: Any) -> Correction:
    name = f"{path}, [[undone]] {number}"
    if not isinstance(entry, dict) or entry.get("kind") not in KEYS:
        raise InputError(name, f"a kind of {', '.join(KEYS)}", repr(entry))
    return correction_of(entry["kind"], {key: entry[key] for key in entry if key != "kind"}, name)


def corrections_text(decisions: Decisions) -> str:
    """The file of these decisions, as `read_decisions` takes it; one entry a paragraph, so that two files
    merge line by line."""
    parts = [
        "# Decisions by hand. `track VIDEO --corrections FILE` honours them; `track review` adds to them.\n"
    ]
    if decisions.film:
        parts.append(_paragraph("[run]", {"film": decisions.film}))
    parts += [_paragraph(f"[[{one.kind}]]", one.entry()) for one in decisions.corrections]
    parts += [_paragraph("[[undone]]", {"kind": one.kind} | one.entry()) for one in decisions.undone]
    return "\n".join(parts)


def _paragraph(head: str, values: Mapping[str, Any]) -> str:
    lines = (f"{name} = {json.dumps(value, ensure_ascii=False)}\n" for name, value in values.items())
    return f"{head}\n{''.join(lines)}"


def correction_of(kind: str, entry: Any, name: str = "the correction") -> Correction:
    """One decision from what an entry holds.

    Raises
    ------
    InputError
        For a key that is missing or unknown, or a value of the wrong kind; it names the entry.
    """
    allowed = {*KEYS[kind], *OPTIONAL.get(kind, ()), "date"}
    if not isinstance(entry, dict) or not set(KEYS[kind]) <= set(entry) <= allowed:
        found = ", ".join(entry) if isinstance(entry, dict) else repr(entry)
        raise InputError(name, " and ".join(KEYS[kind]), found or "nothing")
    parts: dict[str, Any] = {}
    if "sheet" in entry or "sheets" in entry:
        parts["sheets"] = _sheets(kind, entry, name)
    if "frames" in entry:
        parts["first"], parts["stop"] = _range(entry["frames"], name, "frames", open_end=True)
    if "frame" in entry:
        parts["first"] = _whole(entry["frame"], name, "frame, a number from 0")
        parts["stop"] = parts["first"] + 1
    if "rows" in entry:
        parts["rows"] = _range(entry["rows"], name, "rows")
    for key, unit in (("x_px", "a column in px"), ("offset_s", "seconds"), ("drift_ppm", "a number")):
        if key in entry:
            parts[key] = _number(entry[key], name, f"{key}, {unit}")
    return Correction(kind=kind, date=_date(entry.get("date", ""), name), name=name, **parts)


def _sheets(kind: str, entry: Mapping[str, Any], name: str) -> tuple[int, ...]:
    sheets = entry["sheets"] if kind == "swap" else [entry["sheet"]]
    whole = isinstance(sheets, list) and all(type(sheet) is int and sheet >= 0 for sheet in sheets)
    if not whole or len(set(sheets)) != (2 if kind == "swap" else 1):
        swap = "sheets = [4, 5], two indices from the left"
        wanted = swap if kind == "swap" else "sheet = 4, from the left"
        raise InputError(name, wanted, repr(entry.get("sheets", entry.get("sheet"))))
    return tuple(sheets)


def _range(text: Any, name: str, what: str, *, open_end: bool = False) -> tuple[int, int | None]:
    first, colon, stop = (part.strip() for part in str(text).partition(":"))
    digits = first.isdecimal() and (stop.isdecimal() or (open_end and not stop))
    if not (colon and digits and len(first + stop) < 19 and (not stop or int(first) < int(stop))):
        raise InputError(name, f'{what} = "A:B" with A < B', repr(text))
    return int(first), int(stop) if stop else None


def _whole(value: Any, name: str, wanted: str) -> int:
    if type(value) is not int or not 0 <= value < 1 << 60:
        raise InputError(name, wanted, repr(value))
    return value


def _number(value: Any, name: str, wanted: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e12:
        raise InputError(name, wanted, repr(value))
    return float(value)


def _date(value: Any, name: str) -> str:
    """As text that sorts by time: in UTC where it says its offset."""
    if isinstance(value, day):  # a datetime is one too
        value = value.isoformat()
    try:
        moment = datetime.fromisoformat(value) if value else None
    except (TypeError, ValueError):
        raise InputError(name, 'date = "2026-01-31T12:00:00Z"', repr(value)) from None
    if moment is None or moment.tzinfo is None:
        return str(value)
    return moment.astimezone(UTC).isoformat(timespec="milliseconds")
