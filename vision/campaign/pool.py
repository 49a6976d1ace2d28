"""The last job: all finished tests as one comparison, and the tables closed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from vision.campaign.plan import Plan, PlannedFilm
from vision.campaign.states import State
from vision.campaign.tables import close_tables, write_tests
from vision.comparison import compare
from vision.errors import InputError
from vision.run import Origin, whole_file, write_json
from vision.run.comparing import write_comparison
from vision.run.reading import read_json

POOL, KEPT = "pool", "pool.json"
COLUMNS = ("sample", "V_mm_min", "n_test", "RH_percent", "T_C")


def pool(plan: Plan, *, command: str = "", options: Mapping[str, str] | None = None) -> list[str]:
    """Compare all finished runs with a force recording; close the tables of all films.

    Parameters
    ----------
    plan
        The campaign's.
    command, options
        For run.json (`vision.run.Origin`).

    Returns
    -------
    Remarks: runs that could not be compared, warnings of the comparison, or why there is none.

    Raises
    ------
    InputError
        Where the results cannot be written.
    """
    done = [(film, state) for film in plan.films if (state := plan.finished(film))]
    write_tests(plan.out, {film.name: _facts(plan, film, state) for film, state in done})
    close_tables(plan.out, [film.name for film, _ in done])
    tests = [film for film, _ in done if (plan.run_of(film.name) / "events.csv").is_file()]
    if not tests:
        return ["no finished test has events of a force recording, so there is no comparison"]
    table = pd.DataFrame(
        [
            {"run": str(plan.run_of(film.name))} | {name: film.facts.get(name) for name in COLUMNS}
            for film in tests
        ]
    )
    try:
        found = compare([plan.run_of(film.name) for film in tests], table.dropna(axis="columns", how="all"))
    except InputError as error:
        return [f"no comparison: {error}"]
    origin = Origin(
        command=command,
        inputs=[test.folder / "events.csv" for test in found.tests],
        options=options or {},
    )
    write_comparison(found, plan.out / POOL, origin, overwrite=True, report=plan.report)
    return [*found.failures, *found.warnings]


def _facts(plan: Plan, film: PlannedFilm, state: State) -> dict[str, Any]:
    """A film's row in the table of tests."""
    facts = read_json(plan.run_of(film.name) / "run.json")
    frames = facts.get("frames") or {}
    numbers = {name: film.facts.get(name, float("nan")) for name in COLUMNS[1:]}
    return {
        "sample": film.facts.get("sample"),
        **{name: float(value) for name, value in numbers.items()},
        "notes": film.facts.get("notes"),
        "path": film.film,
        "key": film.key,
        "state": state.state,
        "warnings": len(state.warnings),
        "seconds": state.seconds,
        "frames_read": _count(frames.get("read")),
        "frames_lost": _count(frames.get("lost")),
        "run": str(Path("runs") / film.name),
    }


def _count(value: Any) -> float:
    return float(value) if isinstance(value, int | float) else float("nan")


def needs_pool(plan: Plan) -> bool:
    """Whether the finished films or what the table says of them have changed since the last pool."""
    return _kept(plan).get("key") != plan.pool_key()


def write_remarks(plan: Plan, lines: Sequence[str]) -> None:
    """Keep what was said of a pool, with what it was made from.  Raises: InputError."""
    with whole_file(plan.out / KEPT) as path:
        write_json({"key": plan.pool_key(), "remarks": list(lines)}, path)


def read_remarks(plan: Plan) -> tuple[str, ...]:
    """What was said of the last pool."""
    return tuple(str(line) for line in _kept(plan).get("remarks", ()))


def _kept(plan: Plan) -> dict[str, Any]:
    try:
        return read_json(plan.out / KEPT)
    except InputError:
        return {}
