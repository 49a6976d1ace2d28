"""Units as testing machines write them, and their factors to s, N and mm."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

Dimension = Literal["time", "force", "length", "ratio"]


@dataclass(frozen=True)
class Unit:
    """A unit: what it measures and how many s, N or mm it is."""

    text: str
    dimension: Dimension
    factor: float


_POUND_N = 4.4482216152605
_KILOGRAM_N = 9.80665

# Written forms, case kept: mN and MN differ.
_FACTORS: dict[Dimension, dict[str, float]] = {
    "time": {
        **dict.fromkeys(("s", "sec", "secs", "second", "seconds", "sek", "seg"), 1.0),
        **dict.fromkeys(("ms", "msec", "millisecond", "milliseconds"), 1e-3),
        **dict.fromkeys(("µs", "us"), 1e-6),
        **dict.fromkeys(("min", "minute", "minutes", "Minuten"), 60.0),
        **dict.fromkeys(("h", "hr", "hour", "hours"), 3600.0),
    },
    "force": {
        **dict.fromkeys(("N", "newton", "newtons"), 1.0),
        **{"kN": 1e3, "MN": 1e6, "daN": 10.0, "mN": 1e-3, "µN": 1e-6, "uN": 1e-6},
        **dict.fromkeys(("lbf", "lb", "lbs"), _POUND_N),
        **dict.fromkeys(("kgf", "kp", "kg"), _KILOGRAM_N),
        **dict.fromkeys(("gf",), _KILOGRAM_N / 1000),
    },
    "length": {
        **{"mm": 1.0, "cm": 10.0, "m": 1000.0, "µm": 1e-3, "um": 1e-3, "nm": 1e-6},
        **dict.fromkeys(("in", "inch", "inches", '"'), 25.4),
        "ft": 304.8,
    },
    "ratio": dict.fromkeys(("1", "-", "N/N", "dimensionless"), 1.0),
}
_EXACT = {text: Unit(text, dim, f) for dim, table in _FACTORS.items() for text, f in table.items()}
_LOWER = {text.lower(): unit for text, unit in _EXACT.items() if text not in {"mN", "MN"}}
_GREEK_MU = str.maketrans({"\u03bc": "µ"})


def bare(text: str) -> str:
    """The unit without the brackets and spaces around it: "(kN)" and " [kN] " are both "kN"."""
    return text.strip().strip("()[]{}<>").strip()


def unit_of(text: str) -> Unit | None:
    """The unit a text stands for; None where it is not a unit of time, force or length.

    Case decides between mN and MN and is otherwise forgiven.
    """
    key = bare(text).translate(_GREEK_MU)
    return _EXACT.get(key) or _LOWER.get(key.lower())


_BRACKETED = re.compile(r"^(?P<name>.*?)\s*[\(\[\{<](?P<unit>[^()\[\]{}<>]*)[\)\]\}>]\s*$")
_TRAILING = re.compile(r"^(?P<name>.*\S)(?:\s*[,/]\s*|_|\s+in\s+)(?P<unit>[^\s,/_]+)\s*$")


def split_name(header: str) -> tuple[str, str]:
    """("Load", "kN") from "Load (kN)", "Load [kN]", "Load, kN", "Load / kN", "Load in kN" or "load_kN".

    A unit in brackets is split off whatever it says; the other forms only where the ending is a known unit.
    """
    bracketed = _BRACKETED.match(header)
    if bracketed:
        return bracketed["name"].strip(), bracketed["unit"].strip()
    trailing = _TRAILING.match(header)
    if trailing and unit_of(trailing["unit"]):
        return trailing["name"].strip(), trailing["unit"].strip()
    return header.strip(), ""
