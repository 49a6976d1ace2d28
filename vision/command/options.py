"""Options as typed on the command line or written in a TOML file, and where each came from."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vision.errors import InputError
from vision.run.provenance import Parameter


def merge(given: Mapping[str, Any], defaults: Mapping[str, Any], config: Path | None) -> dict[str, Parameter]:
    """Every option with its value and origin: the command line wins over the file, the file over the default.

    Args: given, options as parsed, None where not typed; defaults, the same names.
    Raises: InputError for a TOML file that cannot be read, names an unknown option or gives it a wrong type.
    """
    from_file = read_config(config, defaults) if config else {}
    merged: dict[str, Parameter] = {}
    for name, default in defaults.items():
        if given.get(name) is not None:
            merged[name] = Parameter(given[name], "given")
        elif name in from_file:
            merged[name] = Parameter(from_file[name], "config")
        else:
            merged[name] = Parameter(default, "default")
    return merged


def read_config(path: Path, known: Mapping[str, Any]) -> dict[str, Any]:
    """Options from a TOML file, by their long names with hyphens or underscores."""
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        advice = "write lines like: strip = '60:144'"
        raise InputError(path, "a TOML file of options", str(error), advice) from error
    named = {key.replace("-", "_"): value for key, value in table.items()}
    for key, value in named.items():
        if key not in known:
            raise InputError(path, f"options of track ({', '.join(known)})", f"'{key}'")
        if isinstance(value, (dict, list)):
            raise InputError(path, f"one value for '{key}'", f"a {type(value).__name__}")
    return named


def parse_range(text: str | None, option: str) -> slice | None:
    """`A:B`, half-open, either end may be left out; None and "auto" for all.

    Raises: InputError for anything else.
    """
    if text is None or text == "auto":
        return None
    first, colon, last = str(text).partition(":")
    try:
        start, stop = int(first) if first.strip() else None, int(last) if last.strip() else None
    except ValueError:
        start, stop, colon = None, None, ""
    if not colon or (start or 0) < 0 or (stop is not None and stop <= (start or 0)):
        raise InputError(option, "two whole numbers A:B with 0 <= A < B", f"'{text}'")
    return slice(start, stop)


def number(value: Any, option: str, *, least: float, whole: bool = False) -> Any:
    """A number not below `least`, as it is; None passes.  Raises: InputError."""
    if value is None:
        return None
    fits = isinstance(value, (int, float)) and not isinstance(value, bool) and value >= least
    if not fits or (whole and not float(value).is_integer()) or value == float("inf"):
        kind = "a whole number" if whole else "a number"
        raise InputError(option, f"{kind} from {least:g}", f"'{value}'")
    return int(value) if whole else float(value)


def choice(value: Any, option: str, names: tuple[Any, ...]) -> Any:
    """One of the names.  Raises: InputError."""
    if value not in names:
        raise InputError(option, "one of " + ", ".join(map(str, names)), f"'{value}'")
    return value
