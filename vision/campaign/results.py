"""Results of a campaign: a page with all states, the tables, and the comparison of the finished tests."""

from __future__ import annotations

import base64
import math
import shutil
import time
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pandas as pd
import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.parquet as pq
from jinja2 import Environment, StrictUndefined
from PIL import Image

from vision.campaign.films import SETTINGS
from vision.campaign.plan import FINISHED, Plan, PlannedFilm, State, Word, read_if_whole, write_state
from vision.comparison import compare, write_comparison
from vision.comparison.runs import COLUMNS, LIMITS
from vision.errors import InputError, counted
from vision.figures import Results
from vision.files import reading, shortened
from vision.folder import whole_file, write_csv, write_json
from vision.models.single_fits import Estimate, plus_minus
from vision.numeric import number
from vision.run.provenance import Origin
from vision.run.reading import RunFolder, is_run, read_json, read_run
from vision.run.tables import columns_in_parts
from vision.run.writing import FAILURES

# --- the page -----------------------------------------------------------------------------------------------

PAGE = "index.html"
ORDER_OF_STATES = ("failed", "partial", "warnings", "running", "waiting", "done")

TEMPLATE = Path(__file__).with_name("index.html.jinja")
SHOWN = {
    "sample": "sample",
    "V_mm_min": "V (mm/min)",
    "n_test": "tests before",
    "RH_percent": "RH (%)",
    "T_C": "T (°C)",
}


def page_age(out: Path) -> float:
    """Return the seconds since index.html was written; infinite if it does not exist."""
    try:
        return time.time() - (out / PAGE).stat().st_mtime
    except OSError:
        return float("inf")


def write_page(plan: Plan, *, live: bool, remarks: tuple[str, ...] = ()) -> None:
    """Write index.html and campaign.csv from the films' states.

    live: whether the page reloads itself.  remarks: lines above the table.  Raises: InputError.
    """
    states = [plan.state(film) for film in plan.films]
    films = list(zip(plan.films, states, strict=True))
    counts = Counter(str(state.state) for state in states)
    facts = [name for name in SHOWN if any(name in film.facts for film in plan.films)]
    left = sum(film.seconds for film, state in films if state.state in ("waiting", "running"))
    text = (
        Environment(autoescape=True, undefined=StrictUndefined)
        .from_string(TEMPLATE.read_text(encoding="utf-8"))
        .render(
            title=plan.out.name,
            live=live,
            refresh=10,  # seconds
            now=time.strftime("%Y-%m-%d %H:%M:%S"),
            ended=len(states) - counts["waiting"] - counts["running"],
            counts=[(word, counts[word]) for word in ORDER_OF_STATES if counts[word]],
            left=duration(left) if live and left else "",
            pool=(plan.out / "pool" / "report.html").is_file(),
            remarks=remarks,
            facts=[SHOWN[name] for name in facts],
            tests=counted(len(films), "test"),
            measured=any(state.mu or state.stiff for state in states),
            films=[_row(plan, film, state, facts) for film, state in films],
        )
    )
    with whole_file(plan.out / PAGE) as path:
        path.write_text(text, encoding="utf-8", errors="replace")
    rows = [
        (film.film, state.state, state.reason, round(state.seconds, 3), _run(plan, film, state))
        for film, state in films
    ]
    with whole_file(plan.out / "campaign.csv") as path:
        write_csv(pd.DataFrame(rows, columns=["film", "state", "reason", "seconds", "run"]), path)


def _run(plan: Plan, film: PlannedFilm, state: State) -> str:
    """Return a film's run in the campaign's folder; "" for none, or for one with other settings."""
    return f"runs/{film.name}" if state.state in FINISHED and is_run(plan.run_of(film.name)) else ""


def _row(plan: Plan, film: PlannedFilm, state: State, facts: list[str]) -> dict[str, Any]:
    run, given = plan.run_of(film.name), [film.facts.get(name, "") for name in facts]
    finished = bool(_run(plan, film, state))
    page = "report.html" if (run / "report.html").is_file() else "overview.png"
    return {
        "state": state.state,
        "name": film.name,
        "file": Path(film.film).name,
        "link": f"runs/{quote(film.name, safe='')}/{page}" if finished else "",
        "picture": _data_uri(plan.out / "thumbnails" / f"{film.name}.png") if finished else "",
        "facts": [f"{fact:g}" if isinstance(fact, float) else fact for fact in given],
        "mu": state.mu,
        "stiff": state.stiff,
        "frames": state.frames or film.frames or "",
        "seconds": f"{state.seconds:.1f}" if state.seconds else "",
        "warnings": state.warnings,
        "reason": state.reason or (film.doubt if state.state == "waiting" else ""),
    }


def _data_uri(path: Path) -> str:
    try:
        return "data:image/png;base64," + base64.b64encode(path.read_bytes()).decode()
    except OSError:
        return ""


def _write_thumbnail(plan: Plan, film: str) -> None:
    """Write the picture of a film for the page; none if its overview cannot be read."""
    with suppress(OSError, ValueError), Image.open(plan.run_of(film) / "overview.png") as image:
        image.thumbnail((SETTINGS.thumbnail_px, 4 * SETTINGS.thumbnail_px))
        (plan.out / "thumbnails").mkdir(exist_ok=True)
        image.convert("RGB").quantize(32).save(plan.out / "thumbnails" / f"{film}.png", optimize=True)


def duration(seconds: float) -> str:
    """Return a duration in s, min or h with a suitable number of digits."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


# --- tables: Parquet datasets with one partition per film, written by the film's job ------------------------

TABLES = ("tests", "sheets", "sticks", "deformation", "positions")
FOLDER = "tables"
FILE = "part.parquet"


def open_tables(out: str | Path, table: str) -> ds.Dataset:
    """Open one table of all tests of a campaign lazily.

    Parameters
    ----------
    out
        The campaign's folder.
    table
        ``tests`` (one row per film), ``sheets``, ``sticks`` (one row per event), ``deformation`` (event and
        sheet) or ``positions`` (frame and sheet). Each has the column ``film``.

    Returns
    -------
    pyarrow.dataset.Dataset
        ``.to_table(columns=…, filter=…)`` reads the selected part.

    Raises
    ------
    InputError
        If there is no such table.

    Examples
    --------
    >>> positions = open_tables("campaign", "positions")  # doctest: +SKIP
    >>> positions.to_table(columns=["time_s", "x_um"], filter=ds.field("film") == "old_3")  # doctest: +SKIP
    """
    if table not in TABLES:
        raise InputError("`table`", f"one of {', '.join(TABLES)}", f"'{table}'")
    folder = Path(out) / FOLDER / table
    files = sorted(folder.glob(f"film=*/{FILE}"))
    if not files:
        raise InputError(folder, "tables of a campaign", "none", "run track campaign first")
    with reading(folder, "tables as track campaign writes them", "run track campaign again"):
        schema = pa.unify_schemas([pq.read_schema(file) for file in files])  # films may differ in columns
        film = pa.field("film", pa.string())
        partitioning = ds.HivePartitioning(pa.schema([film]), segment_encoding="uri")
        return ds.dataset(
            [str(file) for file in files],
            format="parquet",
            schema=schema.append(film),
            partitioning=partitioning,
            partition_base_dir=str(folder),
        )


def write_partitions(out: Path, film: str, run: RunFolder) -> None:
    """Write a film's part of each table; remove the parts of an earlier run that it no longer has.

    Raises: InputError, also for a damaged run.
    """
    columns = columns_in_parts(run.tracks, run.pixel_size_um) if run.of_video else ()
    tables = run.tables
    _write(_partition(out, "positions", film), map(pd.DataFrame, columns))
    for part, name in {"sheets": "sheets", "sticks": "events", "deformation": "deformation"}.items():
        _write(_partition(out, part, film), [tables[name]] if name in tables else ())


def _write(target: Path, tables: Iterable[pd.DataFrame]) -> None:
    """Write tables one below the other into one file; remove the file if there is no table."""
    parts = map(as_arrow, tables)
    if (first := next(parts, None)) is None:
        target.unlink(missing_ok=True)
        return
    with whole_file(target) as path, pq.ParquetWriter(path, first.schema) as writer:
        for part in chain([first], parts):
            writer.write_table(part)


def write_tests(out: Path, tests: Mapping[str, Mapping[str, Any]]) -> None:
    """Write the table of tests, one partition per film.  Raises: InputError."""
    for film, facts in tests.items():
        _write(_partition(out, "tests", film), [pd.DataFrame([facts])])


def remove_others(out: Path, films: Collection[str]) -> None:
    """Remove the partitions of all films but these."""
    kept = {_partition(out, "x", film).parent.name for film in films}
    for part in (out / FOLDER).glob("*/film=*"):
        if part.name not in kept:
            shutil.rmtree(part, ignore_errors=True)


def _partition(out: Path, table: str, film: str) -> Path:
    return out / FOLDER / table / f"film={quote(film, safe='')}" / FILE


def as_arrow(table: pd.DataFrame) -> pa.Table:
    """Convert a table to Arrow with column types that do not depend on the values of one film.

    Floating-point columns are double, integers int64, all others strings, even if every value is missing.
    """
    kinds = {"b": pa.bool_(), "i": pa.int64(), "u": pa.int64(), "f": pa.float64()}
    columns = {}
    for name, column in table.items():
        kind = kinds.get(column.dtype.kind, pa.string())
        values = column.astype("string") if kind == pa.string() else column
        columns[str(name)] = pa.array(values, type=kind, from_pandas=True)
    return pa.table(columns)


# --- the comparison -----------------------------------------------------------------------------------------

POOL, REMARKS = "pool", "pool.json"


def pool(plan: Plan, origin: Origin) -> None:
    """Compare all finished runs that have a force recording, and complete the tables of all films.

    Runs that were corrected or measured again since their job get new tables and states first.

    origin: for run.json of the comparison.  Raises: InputError if the folder cannot be written.
    """
    unread = [line for film in plan.films if (line := _renew_if_corrected(plan, film))]
    done = [(film, state) for film in plan.films if (state := plan.finished(film))]
    write_tests(plan.out, {film.name: _test_row(plan, film, state) for film, state in done})
    remove_others(plan.out, [film.name for film, _ in done])
    remarks = [*unread, *_compare([film for film, _ in done], plan, origin)]
    with whole_file(plan.out / REMARKS) as path:
        write_json({"key": plan.pool_key(), "remarks": remarks}, path)


def _renew_if_corrected(plan: Plan, film: PlannedFilm) -> str:
    """Write tables, picture and state of a run that is not that of its job; return why that fails, or ""."""
    state, now = plan.finished(film), plan.run_digest(film.name)
    if state is None or state.run in ("", now):
        return ""
    try:
        corrected = write_film(plan, film.name)
    except InputError as error:
        return f"{film.name}: its tables are those before it was corrected: {error}"
    kept = {name: getattr(state, name) for name in ("key", "seconds", "attempts")}
    write_state(plan.out, replace(corrected, **kept, run=now))
    return ""


def write_film(plan: Plan, name: str) -> State:
    """Write the tables and the picture of a finished run, fresh or corrected, and return its state.

    Raises: InputError for a damaged run.
    """
    run = read_run(plan.run_of(name))
    write_partitions(plan.out, name, run)
    state = _state_of_run(run, name)
    _write_thumbnail(plan, name)
    return state


def _state_of_run(run: RunFolder, name: str) -> State:
    """Return the state of a film whose run is written.  Raises: InputError if it is damaged."""
    warnings = tuple(map(str, run.facts.get("warnings") or ()))
    reasons, failures = run.facts.get("not_measured") or {}, run.facts.get("failures") or ()
    # what the input does not permit first, then unexpected errors, for which it is not to blame
    refused = sorted(Results(clock=run.clock, reasons=reasons).refused(), key=failures.__contains__)
    why = [reasons[stage] for stage in refused]
    why += [reasons.get(stage, f"unexpected error: {run.folder / FAILURES}") for stage in failures]
    word: Word = "done"
    reason = ""
    if why:
        word, reason = "partial", why[0]
    elif warnings:
        more = f" (and {len(warnings) - 1} more)" if len(warnings) > 1 else ""
        word, reason = "warnings", shortened(warnings[0], 300) + more
    frames = int((run.facts.get("frames") or {}).get("read") or 0)
    shells = run.table("shells", ["stiff_sheets"])
    stiff = "" if shells is None else _stiff_sheets(shells)
    found = State(name=name, state=word, reason=reason, warnings=warnings, frames=frames)
    return replace(found, mu=_mu_of(run), stiff=stiff)


def _stiff_sheets(shells: pd.DataFrame) -> str:
    """Return the median and the range of the numbers of stiff sheets, as 8 (6 to 9); "" if none is known."""
    size = shells["stiff_sheets"].dropna().astype(float)
    if not len(size):
        return ""
    least, most = int(size.min()), int(size.max())
    return f"{size.median():.0f}" + (f" ({least} to {most})" if least < most else "")


def _mu_of(run: RunFolder) -> str:
    """Return μ of a run with its statistical and systematic error in quadrature; "" if it is not known.

    Raises: InputError for a damaged file.
    """
    path = run.folder / "models.json"
    models = read_json(path) if path.is_file() else {}
    mu = models.get("mu") or {}
    value, *errors = (number(mu.get(part)) for part in ("value", "error", "systematic_error"))
    if not math.isfinite(value) or "mu" in (models.get("undetermined") or ()):
        return ""
    return plus_minus(Estimate(value, math.hypot(*filter(math.isfinite, errors))))


def _compare(films: Sequence[PlannedFilm], plan: Plan, origin: Origin) -> list[str]:
    """Compare these films; return failures and warnings, or why there is no comparison."""
    tests = [film for film in films if (plan.run_of(film.name) / "events.csv").is_file()]
    if not tests:
        return ["no finished test has events of a force recording, so there is no comparison"]
    facts = [{**film.facts, "run": str(plan.run_of(film.name))} for film in tests]
    try:
        found = compare(table=pd.DataFrame(facts, columns=COLUMNS).dropna(axis="columns", how="all"))
    except InputError as error:
        return [f"no comparison: {error}"]
    write_comparison(found, plan.out / POOL, origin, overwrite=True, report=plan.report)
    return [*found.failures, *found.warnings]


def _test_row(plan: Plan, film: PlannedFilm, state: State) -> dict[str, Any]:
    """Return a film's row of the table of tests."""
    frames = read_json(plan.run_of(film.name) / "run.json").get("frames") or {}
    return {
        "sample": film.facts.get("sample"),
        **{name: float(film.facts.get(name, "nan")) for name in LIMITS},
        "notes": film.facts.get("notes"),
        "path": film.film,
        "key": film.key,
        "state": state.state,
        "warnings": len(state.warnings),
        "seconds": state.seconds,
        "frames_read": number(frames.get("read")),
        "frames_lost": number(frames.get("lost")),
        "run": str(Path("runs") / film.name),
    }


def needs_pool(plan: Plan) -> bool:
    """Return whether the finished films or their facts have changed since the last pool."""
    return read_if_whole(plan.out / REMARKS).get("key") != plan.pool_key()


def read_remarks(plan: Plan) -> tuple[str, ...]:
    """Return the remarks on the last pool."""
    return tuple(str(line) for line in read_if_whole(plan.out / REMARKS).get("remarks", ()))
