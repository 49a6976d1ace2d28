"""Which column is time, load, displacement: by name in four languages and by unit, or as the user says."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from vision.errors import InputError
from vision.numeric import Floats

Role = Literal["time", "load", "displacement", "video_time"]
Dimension = Literal["time", "force", "length", "ratio"]
ROLES: tuple[Role, ...] = get_args(Role)
_ADVICE = "`columns` time=…,load=…,displacement=…"

# --- units --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Unit:
    """A unit as written: what it measures and how many s, N or mm it is."""

    text: str
    dimension: Dimension
    factor: float


TIME_OF_DAY = "time of day"  # in place of the unit of a column of clock times, which are read as seconds

# Written forms, case kept: mN and MN differ.
_FACTORS: dict[Dimension, dict[str, float]] = {
    "time": {
        **dict.fromkeys(("s", "sec", "secs", "second", "seconds", "sek", "seg", TIME_OF_DAY), 1.0),
        **dict.fromkeys(("ms", "msec", "millisecond", "milliseconds"), 1e-3),
        **dict.fromkeys(("µs", "us"), 1e-6),
        **dict.fromkeys(("min", "minute", "minutes", "Minuten"), 60.0),
        **dict.fromkeys(("h", "hr", "hour", "hours"), 3600.0),
    },
    "force": {
        **dict.fromkeys(("N", "newton", "newtons"), 1.0),
        **{"kN": 1e3, "MN": 1e6, "daN": 10.0, "mN": 1e-3, "µN": 1e-6, "uN": 1e-6},
        **dict.fromkeys(("lbf", "lb", "lbs"), 4.4482216152605),
        **dict.fromkeys(("kgf", "kp", "kg"), 9.80665),
        **dict.fromkeys(("gf", "g"), 9.80665e-3),
    },
    "length": {
        **{"mm": 1.0, "cm": 10.0, "m": 1000.0, "µm": 1e-3, "um": 1e-3, "nm": 1e-6},
        **dict.fromkeys(("millimeter", "millimeters", "millimetre", "millimetres"), 1.0),
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
    """The unit without the brackets and spaces around it: "(kN)" and " [kN] " are both "kN"."""
    return text.strip().strip("()[]{}<>").strip().removesuffix(".")


def unit_of(text: str) -> Unit | None:
    """The unit a text stands for; None where it is not a unit of time, force or length.

    Case decides between mN and MN and is otherwise ignored.
    """
    key = without_brackets(text).translate(_GREEK_MU)
    return _EXACT.get(key) or _LOWER.get(key.lower())


_BRACKETED = re.compile(r"^(?P<name>.*?)\s*[\(\[\{<](?P<unit>[^()\[\]{}<>]*)[\)\]\}>]\s*$")
_TRAILING = re.compile(r"^(?P<name>.*\S)(?:\s*[,/]\s*|_|\s+in\s+)(?P<unit>[^\s,/_]+)\s*$")


def split_name(header: str) -> tuple[str, str]:
    """("Load", "kN") from "Load (kN)", "Load [kN]", "Load, kN", "Load / kN", "Load in kN" or "load_kN".

    A unit in brackets is split off whatever it is; the other forms only where the ending is a known unit.
    """
    bracketed = _BRACKETED.match(header)
    if bracketed:
        return bracketed["name"].strip(), bracketed["unit"].strip()
    trailing = _TRAILING.match(header)
    if trailing and unit_of(trailing["unit"]):
        return trailing["name"].strip(), trailing["unit"].strip()
    return header.strip(), ""


# --- tables -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Table:
    """One block of numbers of a file with its header, before anything is known about its meaning."""

    names: tuple[str, ...]  # one per column
    units: tuple[str, ...]  # "" where none is written
    numbers: Floats  # (rows, columns), NaN where a cell is empty or not a number
    facts: dict[str, str] = field(default_factory=dict)  # layout, encoding, separator, decimal

    def listing(self) -> str:
        """The columns for a message: 1 "Time" [s], 2 "Load" [N] …; the first value where there is no name."""
        shown = []
        for k, (name, unit) in enumerate(zip(self.names, self.units, strict=True)):
            first = self.numbers[0, k] if len(self.numbers) else float("nan")
            named = f'"{name}"' + (f" [{unit}]" if unit else "")
            shown.append(f"{k + 1} " + (named if name else f"(no name, starts {first:g})"))
        return ", ".join(shown)


# --- roles --------------------------------------------------------------------------------------------------


def _set(words: str) -> frozenset[str]:
    return frozenset(words.split())


_DIMENSION = dict[Role, Dimension](time="time", load="force", displacement="length", video_time="time")
_BASE = dict[Role, str](time="s", load="N", displacement="mm", video_time="s")
_WORDS: dict[Role, frozenset[str]] = {
    "time": _set(
        "time timestamp datetime temps zeit uhrzeit zeitstempel tiempo hora heure laufzeit prufzeit messzeit"
        " testzeit t elapsed duree duracion"
    ),
    "load": _set("load force kraft prufkraft standardkraft zugkraft last fuerza carga charge effort f fnorm"),
    "displacement": _set(
        "displacement disp crosshead extension position stroke travel separation actuator d traverse course"
        " deplacement allongement traversenweg standardweg verfahrweg weg verschiebung"
        " desplazamiento posicion recorrido carrera travesano alargamiento"
    ),
}
_VIDEO = _set("video camera kamera camara")
# Columns that carry such a word are not measurements of the sample.
_NEVER = _set(
    "sollwert soll setpoint command consigne consigna target demand rate speed vitesse geschwindigkeit"
    " velocidad stress strain error max maximum peak pic min minimum count cycle"
)
_ABSOLUTE = _set("absolute absolue absolu absolut absoluta absoluto")
_OVER_WEIGHT = frozenset({"fnorm"})


@dataclass(frozen=True)
class Column:
    """A column with its role's unit."""

    name: str  # as in the file
    unit: str  # as written or given, "1" for a force over a weight
    assumed: bool  # true where no unit is written and the base unit (s, N or mm) is taken
    values: Floats = field(repr=False)  # in s, N or mm


def parse_columns(text: str) -> dict[str, str]:
    """The roles in a text such as ``time=Time,load=Load:kN,displacement=3``.

    Parameters
    ----------
    text
        ``role=column`` pairs. A column is a name, or a number counted from 1; ``:unit`` states the unit, a
        leading ``-`` turns the sign, and ``time=2000Hz`` stands for a recording that has a sampling rate and
        no times.

    Returns
    -------
    Role to column, as `read_force` takes it.

    Raises
    ------
    InputError
        For anything else.
    """
    found: dict[str, str] = {}
    for part in re.split(r",(?=\s*\w+\s*=)", text.strip().strip(",")):
        key, equals, value = part.partition("=")
        role = next((role for role in ROLES if role == key.strip()), None)
        if role is None or not equals or not value.strip():
            raise InputError("`columns`", f"ROLE=COLUMN with ROLE one of {', '.join(ROLES)}", f'"{part}"')
        found[role] = value.strip()
    return found


def find_columns(path: Path, table: Table, named: Mapping[str, str] | None = None) -> dict[Role, Column]:
    """The columns of a table by role; "displacement" and "video_time" only where there is one.

    Raises InputError where time or load is missing, where two columns would do equally, or where a written
    unit is not known: the message lists the columns and shows how to name them.
    """
    named = named or {}
    unknown = set(named) - set(ROLES)
    if unknown:
        raise InputError("`columns`", f"roles {', '.join(ROLES)}", ", ".join(sorted(unknown)))
    columns: dict[Role, Column] = {}
    for role in ROLES:
        column = _named(path, table, role, named[role]) if role in named else _guessed(path, table, role)
        if column is not None:
            columns[role] = column
    for role in ("time", "load"):
        if role not in columns:
            rate = " (time=2000Hz where only the sampling rate is known)" if role == "time" else ""
            raise InputError(
                path, f"a {role} column", f"columns {table.listing()}", f"name them with {_ADVICE}{rate}"
            )
    return columns


def _named(path: Path, table: Table, role: Role, text: str) -> Column:
    """The column that the user names for a role."""
    rate = re.fullmatch(r"([\d.]+)\s*Hz", text) if role == "time" else None
    if rate:
        return Column(text, "Hz", assumed=False, values=np.arange(len(table.numbers)) / float(rate[1]))
    index, sign, unit_text = _locate(path, table, text)
    column = _column(path, table, role, index, unit_text)
    return Column(column.name, column.unit, column.assumed, sign * column.values)


def _locate(path: Path, table: Table, text: str) -> tuple[int, int, str]:
    """(column, sign, unit or "") of a user's NAME, NUMBER, NAME:unit or -NAME."""
    name, _, unit_text = text.rpartition(":") if ":" in text and text not in table.names else (text, "", "")
    for candidate, sign in ((name, 1), (name.removeprefix("-"), -1)):
        asked = candidate.strip().casefold()
        matches = [k for k, known in enumerate(table.names) if known and known.casefold() == asked]
        if len(matches) == 1:
            return matches[0], sign, unit_text
        if not matches and candidate.isdigit() and 1 <= int(candidate) <= len(table.names):
            return int(candidate) - 1, sign, unit_text
    raise InputError(
        path, f'one column "{text}"', f"columns {table.listing()}", f"name or number them with {_ADVICE}"
    )


def _guessed(path: Path, table: Table, role: Role) -> Column | None:
    """The column whose name, or else whose unit alone, fits a role best."""
    every = range(len(table.names))
    candidates = [k for k in every if _fits(table, role, k)]
    if not candidates and role != "video_time":
        candidates = [k for k in every if _fits_by_unit(table, role, k)]
    if not candidates:
        return None
    ranks = {k: _rank(table, role, k) for k in candidates}
    chosen = [k for k in candidates if ranks[k] == min(ranks.values())]
    if len(chosen) > 1:
        several = ", ".join(f'{k + 1} "{table.names[k]}"' for k in chosen)
        raise InputError(path, f"one {role} column", f"{len(chosen)}: {several}", f"choose with {_ADVICE}")
    return _column(path, table, role, chosen[0], "")


def _words(name: str) -> list[str]:
    """Lower-case words of a name without accents; "TestTime" and "video_time" are two words each."""
    plain = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
    return re.findall(r"[a-z]+", re.sub(r"(?<=[a-z])(?=[A-Z])", " ", plain).lower())


def _fits(table: Table, role: Role, k: int) -> bool:
    """Whether a column has a name of this role, and not a unit of something else."""
    words = set(_words(table.names[k]))
    unit = unit_of(table.units[k])
    if words & _NEVER or (unit and unit.dimension not in (_DIMENSION[role], "ratio")):
        return False
    if role == "video_time":
        return bool(words & _VIDEO and words & _WORDS["time"])
    if role == "displacement" and words & _WORDS["load"]:
        return False
    return bool(words & _WORDS[role]) and not words & _VIDEO


def _fits_by_unit(table: Table, role: Role, k: int) -> bool:
    unit = unit_of(table.units[k])
    return bool(unit and unit.dimension == _DIMENSION[role] and not set(_words(table.names[k])) & _NEVER)


def _rank(table: Table, role: Role, k: int) -> tuple[bool, bool, int]:
    """Smaller is better: with a unit, no absolute machine position or time of the day (which may be coarse),
    and for time the shortest name."""
    words = _words(table.names[k])
    absolute = bool(set(words) & _ABSOLUTE) or table.units[k] == TIME_OF_DAY
    return unit_of(table.units[k]) is None, absolute, len(words) if role == "time" else 0


def _column(path: Path, table: Table, role: Role, k: int, given: str) -> Column:
    """Column k in the base unit of its role; `given` unit, if any, instead of the written one."""
    written = given or table.units[k]
    name = table.names[k] or f"column {k + 1}"
    if not written and set(_words(name)) & _OVER_WEIGHT:
        written = "1"
    unit = unit_of(written) if written else Unit(_BASE[role], _DIMENSION[role], 1.0)
    allowed = (_DIMENSION[role], "ratio") if role == "load" else (_DIMENSION[role],)
    if unit is None or unit.dimension not in allowed:
        advice = f"state it with `columns` {role}={name}:{_BASE[role]} (or another unit)"
        raise InputError(path, f'a unit of {_DIMENSION[role]} for "{name}"', f'"{written}"', advice)
    shown = "1" if unit.dimension == "ratio" else unit.text
    return Column(name, shown, assumed=not written, values=table.numbers[:, k] * unit.factor)
