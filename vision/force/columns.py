"""Which column is time, load, displacement: by name in four languages and by unit, or as the user says."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from vision.errors import InputError
from vision.force.table import Table
from vision.force.units import Dimension, Unit, unit_of

Role = Literal["time", "load", "displacement", "video_time"]
ROLES: tuple[Role, ...] = get_args(Role)
OPTION = "--force-columns time=…,load=…,displacement=…"


def _set(words: str) -> frozenset[str]:
    return frozenset(words.split())


_DIMENSION: dict[Role, Dimension] = {
    "time": "time",
    "load": "force",
    "displacement": "length",
    "video_time": "time",
}
_BASE: dict[Role, str] = {"time": "s", "load": "N", "displacement": "mm", "video_time": "s"}
_WORDS: dict[Role, frozenset[str]] = {
    "time": _set("time temps zeit tiempo laufzeit prufzeit messzeit testzeit t elapsed duree duracion"),
    "load": _set("load force kraft prufkraft standardkraft zugkraft last fuerza carga charge effort f fnorm"),
    "displacement": _set(
        "displacement crosshead extension position stroke travel separation actuator d traverse course"
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
    """A column put to use: its name in the file, its values in s, N or mm, and how its unit was known.

    unit: as written or given, "1" for a force over a weight.  assumed: no unit is written, the base unit is
    taken.
    """

    name: str
    unit: str
    assumed: bool
    values: NDArray[np.float64] = field(repr=False)


def parse_columns(text: str) -> dict[str, str]:
    """The roles of `--force-columns time=Time,load=Load:kN,displacement=3`.

    A value is a column's name, or its number counted from 1; `:unit` states the unit, a leading `-` turns
    the sign, and `time=2000Hz` stands for a recording that has a sampling rate and no times.
    Raises InputError.
    """
    found: dict[str, str] = {}
    for part in re.split(r",(?=\s*\w+\s*=)", text.strip().strip(",")):
        key, equals, value = part.partition("=")
        role = next((role for role in ROLES if role == key.strip()), None)
        if role is None or not equals or not value.strip():
            raise InputError(
                "--force-columns", f"ROLE=COLUMN with ROLE one of {', '.join(ROLES)}", f'"{part}"'
            )
        found[role] = value.strip()
    return found


def resolve(path: Path, table: Table, named: Mapping[str, str] | None = None) -> dict[Role, Column]:
    """The columns of a table by role; "displacement" and "video_time" only where there is one.

    Raises InputError where time or load is missing, where two columns would do equally, or where a unit is
    written that is not known: the message lists the columns and shows the option that names them.
    """
    named = named or {}
    unknown = set(named) - set(ROLES)
    if unknown:
        raise InputError("--force-columns", f"roles {', '.join(ROLES)}", ", ".join(sorted(unknown)))
    columns: dict[Role, Column] = {}
    for role in ROLES:
        column = _named(path, table, role, named[role]) if role in named else _guessed(path, table, role)
        if column is not None:
            columns[role] = column
    for role in ("time", "load"):
        if role not in columns:
            raise _missing(path, table, role)
    return columns


def _missing(path: Path, table: Table, role: str) -> InputError:
    rate = " (time=2000Hz where only the sampling rate is known)" if role == "time" else ""
    return InputError(
        path, f"a {role} column", f"columns {table.listing()}", f"name them with {OPTION}{rate}"
    )


def _named(path: Path, table: Table, role: Role, text: str) -> Column:
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
        matches = [k for k, known in enumerate(table.names) if _same(known, candidate)]
        if len(matches) == 1:
            return matches[0], sign, unit_text
        if not matches and candidate.isdigit() and 1 <= int(candidate) <= len(table.names):
            return int(candidate) - 1, sign, unit_text
    raise InputError(
        path, f'one column "{text}"', f"columns {table.listing()}", f"name or number them with {OPTION}"
    )


def _same(known: str, asked: str) -> bool:
    return bool(known) and known.casefold() == asked.strip().casefold()


def _guessed(path: Path, table: Table, role: Role) -> Column | None:
    candidates = [k for k in range(len(table.names)) if _fits(table, role, k)]
    if not candidates and role in ("load", "displacement"):
        candidates = [k for k in range(len(table.names)) if _fits_by_unit(table, role, k)]
    if not candidates:
        return None
    best = min(_rank(table, role, k) for k in candidates)
    chosen = [k for k in candidates if _rank(table, role, k) == best]
    if len(chosen) > 1:
        several = ", ".join(f'{k + 1} "{table.names[k]}"' for k in chosen)
        raise InputError(path, f"one {role} column", f"{len(chosen)}: {several}", f"choose with {OPTION}")
    return _column(path, table, role, chosen[0], "")


def _words(name: str) -> list[str]:
    plain = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
    # "TestTime" and "video_time" are two words each.
    return re.findall(r"[a-z]+", re.sub(r"(?<=[a-z])(?=[A-Z])", " ", plain).lower())


def _fits(table: Table, role: Role, k: int) -> bool:
    """A name of this role, and not a unit of something else."""
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
    """Smaller is better: with a unit, not an absolute machine position, and for time the shortest name."""
    words = _words(table.names[k])
    return (
        unit_of(table.units[k]) is None,
        bool(set(words) & _ABSOLUTE),
        len(words) if role == "time" else 0,
    )


def _column(path: Path, table: Table, role: Role, k: int, given: str) -> Column:
    written = given or table.units[k]
    name = table.names[k] or f"column {k + 1}"
    if not written and set(_words(name)) & _OVER_WEIGHT:
        written = "1"
    unit = unit_of(written) if written else Unit(_BASE[role], _DIMENSION[role], 1.0)
    allowed = (_DIMENSION[role], "ratio") if role == "load" else (_DIMENSION[role],)
    if unit is None or unit.dimension not in allowed:
        advice = f"say it with --force-columns {role}={name}:{_BASE[role]} (or another unit)"
        raise InputError(path, f'a unit of {_DIMENSION[role]} for "{name}"', f'"{written}"', advice)
    shown = "1" if unit.dimension == "ratio" else unit.text
    return Column(name, shown, assumed=not written, values=table.numbers[:, k] * unit.factor)
