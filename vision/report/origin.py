"""Tables of where the numbers come from: parameters, inputs, versions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from vision.report.results import RunResults


@dataclass(frozen=True)
class Table:
    """A small table of the page."""

    title: str
    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def provenance(results: RunResults) -> list[Table]:
    """Parameters with how each came about, inputs with their checksums, versions; only what is known."""
    facts = results.facts
    tables = [
        Table("Parameters", ("parameter", "value", "given or found"), tuple(_parameters(facts))),
        Table("What was found", ("what", "value"), tuple(_flat(facts.get("found", {})))),
        Table("Inputs", ("file", "bytes", "SHA-256"), tuple(_inputs(facts))),
        Table("Versions", ("package", "version"), tuple(_flat(facts.get("versions", {})))),
        Table("Command", ("command line",), ((str(facts["command"]),),) if "command" in facts else ()),
    ]
    return [table for table in tables if table.rows]


def _parameters(facts: Mapping[str, Any]) -> Iterable[tuple[str, ...]]:
    for name, parameter in facts.get("parameters", {}).items():
        plain = isinstance(parameter, Mapping)
        value = parameter["value"] if plain else parameter.value
        how = parameter["how"] if plain else parameter.how
        yield name, "—" if value is None else str(value), str(how)


def _inputs(facts: Mapping[str, Any]) -> Iterable[tuple[str, ...]]:
    for item in facts.get("inputs", ()):
        yield str(item["path"]), str(item["size_bytes"]), str(item["sha256"])


def _flat(values: Mapping[str, Any], before: str = "") -> Iterable[tuple[str, ...]]:
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{before}{name}: ")
        else:
            yield f"{before}{name}", f"{value:.6g}" if isinstance(value, float) else str(value)
