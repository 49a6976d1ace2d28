"""Read finished runs and the table that gives the sample, velocity, humidity and temperature of each."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Self

import numpy as np
import pandas as pd

from vision.data import SIDES, whole_events
from vision.errors import PATH, InputError, check_kind, counted, nearest_word
from vision.files import AGAIN, check_regular, decode_text, path_beside, reading
from vision.force.files import EXCEL, worksheets
from vision.models import Estimate
from vision.models.single_fits import check_columns, complete_events, with_fitted_stiffness
from vision.numeric import Floats, number
from vision.run.provenance import checksum_of
from vision.run.reading import RunFolder, is_run, read_json, read_run
from vision.sample import PUBLISHED, Sample

COLUMNS = ("run", "sample", "V_mm_min", "n_test", "RH_percent", "T_C")
Cells = Mapping[Hashable, Any]  # cells of one row of the table, by column
LIMITS = {"V_mm_min": (1e-6, 1e4), "n_test": (0.0, 1e6), "RH_percent": (0.0, 100.0), "T_C": (-90.0, 200.0)}
# Usual names of the columns. A message about an unknown column suggests the nearest of them.
ALIKE = {
    "run": "run", "name": "run", "folder": "run", "file": "run", "test": "run",
    "sample": "sample", "block": "sample", "specimen": "sample",
    "v_mm_min": "V_mm_min", "v": "V_mm_min", "speed": "V_mm_min", "velocity": "V_mm_min",
    "n_test": "n_test", "n": "n_test", "tests": "n_test", "previous": "n_test", "age": "n_test",
    "rh_percent": "RH_percent", "rh": "RH_percent", "humidity": "RH_percent",
    "t_c": "T_C", "t": "T_C", "temperature": "T_C", "temp": "T_C",
}  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class TractionTest:
    """One finished run with its row of the table."""

    run: str  # name in tables and figures
    folder: Path
    sample_name: str  # "" if unknown
    speed_mm_min: float  # pulling velocity; NaN, like the next three, if unknown
    n_test: float  # number of previous tests
    humidity_percent: float
    temperature_C: float
    sample: Sample  # geometry and adhesion
    events: pd.DataFrame  # complete events with separation, force and stiffness, in order of d_v_mm
    fit_range_mm: tuple[float, float] | None  # range of the fits in the run; None if it has none
    modulus: Estimate  # Y_eff fitted in the run, GPa; NaN if it has none
    modulus_undetermined: bool  # whether the run says that its K does not determine Y_eff
    errors: Mapping[str, float]  # given errors: "d0_mm" and fields of the sample
    # shifts of the run's μ, 𝒯0, … by the errors of its force recording: {"load_drift": {"mu": 0.07, …}, …}
    instrument: Mapping[str, Mapping[str, float]]
    notes: tuple[str, ...] = ()  # about the run
    film: FilmResults | None = None  # σ_x/Λ_st and shells; None for a force recording alone

    def column(self, name: str) -> Floats:
        """Return one column of the events."""
        return self.events[name].to_numpy(float)


@dataclass(frozen=True, kw_only=True, eq=False)
class TestSet:
    """The tests that can be compared, error messages of the others, and warnings."""

    __test__ = False  # not a test of pytest
    tests: tuple[TractionTest, ...]
    failures: tuple[str, ...]
    warnings: tuple[str, ...]


def read_tests(runs: Sequence[str | Path] = (), table: str | Path | pd.DataFrame | None = None) -> TestSet:
    """Read finished run folders and the table of tests, as `vision.compare` takes them.

    Folders in the table are relative to its file. Without a column ``run``, row k describes run k.

    Returns: the tests, and one line for each run, cell or column that cannot be used.
    Raises: InputError if there is neither a table nor a run, the table cannot be read, or no run can be used.
    """
    check_kind(tuple | list, "a list of run folders", runs=runs)
    for path in runs:
        check_kind(PATH, "the paths of run folders, which `save_run` returns", runs=path)
    rows, base, warnings = _read_table(table)
    folders = [Path(run) for run in runs]
    failures: list[str] = []
    if not folders:
        if rows is None or "run" not in rows:
            raise InputError("`runs`", "finished run folders", "none", "name them, or give `table`")
        folders = [path_beside(base, str(name)) for name in rows["run"]]
    folders = list(dict.fromkeys(folders))
    row_of = _rows_of_runs(folders, rows, base, failures, warnings)
    names = [folder.resolve().name for folder in folders]
    tests: list[TractionTest] = []
    recordings: dict[Any, str] = {}  # fingerprint of each force recording, and the run that has it
    for folder, name in zip(folders, names, strict=True):
        unique = name if names.count(name) == 1 else str(folder)
        try:
            with reading(folder, "a run as track writes it", AGAIN):
                run = read_run(folder)
                test = _read_test(run, unique, row_of.get(folder, {}), warnings)
                _check_unique(run, unique, recordings)  # only a run that can be used counts as the first
                tests.append(test)
        except InputError as error:
            failures.append(str(error))
    if not tests:
        more = f" (and {len(failures) - 1} more)" if len(failures) > 1 else ""
        raise InputError("the runs", "at least one that can be used", failures[0] + more)
    return TestSet(tests=tuple(tests), failures=tuple(failures), warnings=tuple(warnings))


# --- the table ----------------------------------------------------------------------------------------------


def _read_table(table: str | Path | pd.DataFrame | None) -> tuple[pd.DataFrame | None, Path, list[str]]:
    """Return the known columns with checked values, the folder that paths are relative to, and warnings."""
    if table is None:
        return None, Path(), []
    if isinstance(table, pd.DataFrame):
        rows, source, base = table.copy(), "`table`", Path()
    else:
        header, lines = table_cells(Path(table), "a CSV or Excel table of tests")
        cells = [dict(zip(header, (cell.strip() or None for cell in row), strict=False)) for _, row in lines]
        rows, source, base = pd.DataFrame(cells, columns=header), str(table), Path(table).parent
    rows.columns = [str(name).strip() for name in rows.columns]
    warnings = []
    if unknown := [name for name in rows.columns if name not in COLUMNS]:
        near = f"nearest is {ALIKE[nearest_word(unknown[0].lower(), ALIKE)]}"
        known = near if len(unknown) == 1 else f"known ones are {', '.join(COLUMNS)}"
        warnings.append(f"{source}: not known and left out: {', '.join(unknown)}; the {known}")
    rows = rows[[name for name in COLUMNS if name in rows.columns]]
    if rows.empty or not len(rows.columns):
        raise InputError(source, f"rows with any of the columns {', '.join(COLUMNS)}", "none")
    for name, limits in LIMITS.items():
        if name in rows:
            rows = rows.assign(**{name: _numbers(rows[name], name, limits, source, warnings)})
    return rows, base, warnings


def table_cells(path: Path, wanted: str) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Return the heading of a table and, with their line numbers, the rows that are not empty: of the first
    worksheet of an Excel workbook that is not empty, or of text in any encoding. There commas separate cells,
    or semicolons or tabs; then commas in numbers are decimal marks.  wanted: what the file should be.
    Raises: InputError."""
    if check_regular(path, wanted).st_size > 1 << 24:
        raise InputError(path, wanted, "a far larger file", "check its name")
    with reading(path, wanted, "save it again"):
        if path.suffix.lower() in EXCEL:
            sheets = ([*enumerate(rows, start=1)] for _, rows in worksheets(path))
            table, separator = next((rows for rows in sheets if any(cells for _, cells in rows)), []), ""
        else:
            text, _ = decode_text(path, path.read_bytes(), wanted)
            first = text.lstrip().partition("\n")[0]
            separator = max((",", ";", "\t"), key=first.count)
            reader = csv.reader(io.StringIO(text), delimiter=separator, skipinitialspace=True, strict=True)
            table = [(reader.line_num, cells) for cells in reader]
    table = [(number, cells) for number, cells in table if any(cell.strip() for cell in cells)]
    if len(table) < 2:
        raise InputError(path, "a heading and a row for each test", counted(len(table), "line"))
    if separator != ",":
        table = [(number, [_with_points(cell) for cell in cells]) for number, cells in table]
    return table[0][1], table[1:]


_VALUE = r"[-+]?[0-9]+(?:[.,][0-9]+)?\s*(?:mm|[uµμ]m|px|ms|s|N)?(?:/px)?"
_VALUES = re.compile(rf"\s*{_VALUE}(?:\s*(?:±|\+-|\+/-|[:=])\s*{_VALUE})*\s*")


def _with_points(cell: str) -> str:
    """Return a cell with decimal points if it is numbers alone, as 16,6 or 16,6±0,1 or 13,2:17."""
    return re.sub(r"(?<=[0-9]),(?=[0-9])", ".", cell) if _VALUES.fullmatch(cell) else cell


def _numbers(
    column: pd.Series, name: str, limits: tuple[float, float], source: str, warnings: list[str]
) -> pd.Series:
    """Return the numbers of a column. Values beyond the limits become NaN with one warning for all."""
    values = pd.to_numeric(column, errors="coerce").astype(float)
    given = column.notna() & (column.astype(str).str.strip() != "")
    wrong = given & ~((values >= limits[0]) & (values <= limits[1]))
    if wrong.any():
        shown = ", ".join(f"'{cell}'" for cell in column[wrong].astype(str).tolist()[:3])
        warnings.append(
            f"{source}: expected {name} between {limits[0]:g} and {limits[1]:g}; found {shown}; left out"
        )
    values = values.where(~wrong)
    if name == "RH_percent" and values.notna().any() and values.max() <= 1:
        warnings.append(
            f"{source}: expected RH_percent in percent; found none above {values.max():g}, so they "
            "look like fractions; left out"
        )
        values[:] = np.nan
    return values


def _rows_of_runs(
    folders: Sequence[Path], rows: pd.DataFrame | None, base: Path, failures: list[str], warnings: list[str]
) -> dict[Path, Cells]:
    """Return the table's row of each run; warn about runs without a row and rows without a run."""
    if rows is None:
        return {}
    if "run" not in rows:
        if len(rows) != len(folders):
            expected = f"{len(folders)} rows, one per run in their order, or a column run"
            raise InputError("`table`", expected, f"{len(rows)}")
        return dict(zip(folders, rows.to_dict("records"), strict=True))
    known: dict[Path, Cells] = {}
    for row in rows.to_dict("records"):
        name = str(row["run"]).strip()
        path = path_beside(base, name)
        matches = [f for f in folders if f.resolve() == path.resolve()]
        matches = matches or [f for f in folders if f.resolve().name == Path(name).name]
        if len(matches) > 1:
            warnings.append(f"run {name} of the table fits {len(matches)} runs: give its path; row left out")
        elif not matches and not path.exists():
            failures.append(f"{name}: expected a finished run, as the table names it; found no such folder")
        elif matches and matches[0] in known:
            warnings.append(f"run {name} is in the table more than once; its first row is used")
        elif matches:
            known[matches[0]] = row
    if missing := [str(folder) for folder in folders if folder not in known and is_run(folder)]:
        warnings.append(f"not in the table, so left out of the trends: {', '.join(missing)}")
    return known


# --- one run ------------------------------------------------------------------------------------------------


def _check_unique(run: RunFolder, name: str, recordings: dict[Any, str]) -> None:
    """Refuse a second run of one force recording: it is no second measurement of μ.
    recordings: name of the run of each fingerprint so far, to which this one is added."""
    source = (run.facts.get("force") or {}).get("source")
    inputs = run.facts.get("inputs") or ()
    marks = [checksum_of(one) for one in inputs if one.get("path") == source]
    if not any(marks[:1]):
        return
    other = recordings.setdefault(marks[0], name)
    if other != name:
        found = f"that of {other}, which would count twice"
        raise InputError(
            run.folder, "a force recording that no other run has", found, "leave one of them out"
        )


def _read_test(made: RunFolder, name: str, row: Cells, warnings: list[str]) -> TractionTest:
    _check_separation(made)
    folder = made.folder
    models = read_json(folder / "models.json") if (folder / "models.json").is_file() else {}
    recorded = number((made.facts.get("force") or {}).get("speed_mm_min"))
    given = number(row.get("V_mm_min"))
    if math.isfinite(given) and math.isfinite(recorded) and abs(given / recorded - 1) > 0.05:
        warnings.append(f"{name}: the table has V = {given:g} mm/min, its recording {recorded:.4g}")
    modulus = models.get("Y_eff_GPa") or {}
    sample = _sample(models.get("sample") or made.facts.get("sample"))
    events = _events(made, sample)
    if sample is PUBLISHED:
        warnings.append(f"{name}: the run does not say which sample it had; the publication's is assumed")
    label = row.get("sample")
    warned = len(made.facts.get("warnings") or ())
    low, high = map(number, models.get("fit_range_mm") or (None, None))
    return TractionTest(
        run=name,
        folder=folder,
        sample_name="" if label is None or label != label else str(label).strip(),
        speed_mm_min=given if math.isfinite(given) else recorded,
        n_test=number(row.get("n_test")),
        humidity_percent=number(row.get("RH_percent")),
        temperature_C=number(row.get("T_C")),
        sample=sample,
        events=events,
        fit_range_mm=(low, high) if low < high else None,
        modulus=Estimate(number(modulus.get("value")), number(modulus.get("error"))),
        modulus_undetermined="Y_eff_GPa" in (models.get("undetermined") or ()),
        errors={
            name: error
            for name, value in (models.get("input_errors") or {}).items()
            if (error := number(value)) > 0
        },
        instrument=_instrument(models.get("budget") or {}),
        notes=(f"{counted(warned, 'warning')} in its report",) if warned else (),
        film=FilmResults.of(made, warnings),
    )


def _check_separation(run: RunFolder) -> None:
    """Refuse a run in which d is how far the machine moved, not the separation of the blocks."""
    facts = run.facts.get("force") or {}
    if facts.get("separation_from", "none") != "none" and not math.isfinite(number(facts.get("d0_mm"))):
        advice = "run track again with `d0_mm`"
        raise InputError(run.folder, "a run whose initial separation is known", "no `d0_mm`", advice)


INSTRUMENT = ("load_drift", "steps", "low_pass", "filter", "average", "sampling")
"""Sources of systematic errors that lie in the force recording; their effect is known from the run alone."""


def _instrument(budget: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    """Return the entries of a run's budget that come from the force recording and are not zero."""
    found = {}
    for source in INSTRUMENT:
        shifts = {str(name): number(shift) for name, shift in (budget.get(source) or {}).items()}
        if positive := {name: shift for name, shift in shifts.items() if shift > 0}:
            found[source] = positive
    return found


def _events(run: RunFolder, sample: Sample) -> pd.DataFrame:
    """Read the complete events, which have every value that is compared, in order of d_v_mm."""
    path, table = run.folder / "events.csv", run.table("events")
    if table is None:
        raise InputError(run.folder, "a run with a force recording", "no events.csv in it")
    if "flag" in table:
        table = table.assign(flag=table["flag"].fillna("ok"))
    table = with_fitted_stiffness(table)
    check_columns(table, path)
    complete, d = complete_events(table), table[["d_v_mm", "d_p_mm"]].to_numpy(float)
    within = (d[:, 0] > 0) & (d[:, 1] < sample.length_mm)
    if complete.any() and not within[complete].any():
        low, high = d[complete].min(), d[complete].max()
        wanted = f"separations between 0 and the length of the sheets, {sample.length_mm:g} mm"
        advice = "run track again with the right `d0_mm` in mm"
        raise InputError(path, wanted, f"d from {low:.4g} to {high:.4g} mm", advice)
    complete &= within
    if complete.sum() < 6:
        raise InputError(
            path,
            "at least 6 whole events with d, F_p, dF and K",
            f"{complete.sum()} of {len(table)}{_flags_of_others(table)}",
            "run track again with `d0_mm`" if np.isnan(d).all() else "",
        )
    low, high = float(d[complete, 0].min()), float(d[complete, 0].max())
    if high - low < 0.01:  # too small a range to see anything change with d
        raise InputError(path, "events over a range of separations", f"d from {low:.4g} to {high:.4g} mm")
    ordered: pd.DataFrame = table[complete].sort_values("d_v_mm", ignore_index=True)
    return ordered


def _flags_of_others(table: pd.DataFrame) -> str:
    """Return the flags of the events that are not whole, for a message."""
    if "flag" not in table:
        return ""
    counts = table["flag"][~whole_events(table["flag"])].value_counts().head(3)
    named = ", ".join(f"{name} {count}" for name, count in counts.items())
    return f" (flags: {named})" if named else ""


def _sample(content: Any) -> Sample:
    """Return the run's sample; the object PUBLISHED itself if the run does not state one."""
    parts = {part.name for part in fields(Sample)}
    return Sample(**{part: content[part] for part in parts}) if parts <= set(content or ()) else PUBLISHED


# --- the film of a run --------------------------------------------------------------------------------------

INTERVAL = 2 * 1.645  # standard errors in an interval that contains 90 %
WHOLE = 12**-0.5  # standard error by counting whole sheets
MEDIAN = 1.2533  # standard error of a median over that of a mean, √(π/2)
OF_SHEETS = ["event", "side", "n", "ratio", "ratio_err"]
OF_SHELLS = ["event", "d_v_mm", "side", "stiff_sheets", "stiff_low", "stiff_high"]


@dataclass(frozen=True, kw_only=True, eq=False)
class FilmResults:
    """Rows of deformation.csv and shells.csv of one run, without those in which nothing is known."""

    sheets: pd.DataFrame  # OF_SHEETS and d_v_mm
    shells: pd.DataFrame  # OF_SHELLS
    threshold: float  # σ_x/Λ_st below which a sheet is stiff

    @classmethod
    def of(cls, run: RunFolder, warnings: list[str]) -> Self | None:
        """Read the tables of a run; None without them. A damaged one is a warning: the force counts still."""
        try:
            sheets, shells = run.table("deformation", OF_SHEETS), run.table("shells", OF_SHELLS)
        except InputError as error:
            warnings.append(f"{error}; the film of this run is not compared")
            return None
        if sheets is None or shells is None:
            return None
        sheets, shells = _finite(sheets[OF_SHEETS]), _finite(shells[OF_SHELLS])
        sheets = sheets.assign(d_v_mm=sheets["event"].map(shells.groupby("event")["d_v_mm"].first()))
        return cls(sheets=sheets.dropna(), shells=shells.dropna(), threshold=run.threshold)

    def separations_mm(self) -> Floats:
        """Return d_v of the stick phases in which a ratio is known, rising."""
        return np.sort(self.sheets.groupby("event")["d_v_mm"].first().to_numpy(float))

    def mean_ratios(self, low_mm: float, high_mm: float) -> pd.DataFrame:
        """Return σ_x/Λ_st of each sheet, mean over the stick phases with d_v in this range.

        Columns: number (side · n, rising), ratio, and error: the standard error by the scatter between stick
        phases, and the error of one, which others may share.
        """
        table = self.sheets[self.sheets["d_v_mm"].between(low_mm, high_mm)]
        table = table.assign(number=table["side"] * table["n"], variance=table["ratio_err"] ** 2)
        groups = table.groupby("number")
        scatter = groups["ratio"].std(ddof=0)
        error = np.sqrt(groups["variance"].mean() + scatter**2 / groups.size())
        return pd.DataFrame({"ratio": groups["ratio"].mean(), "error": error}).reset_index()


def _finite(table: pd.DataFrame) -> pd.DataFrame:
    """Return the values as finite numbers, NaN for all others."""
    table = table.apply(pd.to_numeric, errors="coerce").astype(float)
    return table.where(np.isfinite(table))


def film_columns(film: FilmResults | None) -> dict[str, float]:
    """Return the columns of tests.csv about the film: medians over its stick phases; NaN if not known.

    Their errors contain that of a stick phase in full, since others may share it, the scatter between stick
    phases, and of numbers of sheets that they are whole.
    """
    of_side = ("stiff_{}", "stiff_{}_err", "ratio_n_{}", "ratio_{}", "ratio_{}_err")
    names = [name.format(side) for side in SIDES.values() for name in of_side]
    found = dict.fromkeys(["film_sticks", "film_d_mm", *names], np.nan)
    if film is None or film.sheets.empty:
        return found
    d_mm = film.separations_mm()
    found |= {"film_sticks": len(d_mm), "film_d_mm": float(np.median(d_mm))}
    for side, name in SIDES.items():
        sizes, sheets = (table[table["side"] == side] for table in (film.shells, film.sheets))
        if len(sizes):
            width = float((sizes["stiff_high"] - sizes["stiff_low"]).median())
            scatter = float(sizes["stiff_sheets"].std(ddof=0)) / np.sqrt(len(sizes))
            found[f"stiff_{name}"] = float(sizes["stiff_sheets"].median())
            error = np.hypot(width / INTERVAL, MEDIAN * scatter)
            found[f"stiff_{name}_err"] = float(np.hypot(error, WHOLE))
        often = sheets["n"].value_counts()
        often = often[2 * often >= len(d_mm)]  # one that leaves the picture in most sticks says little
        if len(often):
            n = int(often.index.max())
            outer = sheets[sheets["n"] == n]
            scatter = float(outer["ratio"].std(ddof=0)) / np.sqrt(len(outer))
            found |= {f"ratio_n_{name}": n, f"ratio_{name}": float(outer["ratio"].median())}
            found[f"ratio_{name}_err"] = float(np.hypot(outer["ratio_err"].median(), MEDIAN * scatter))
    return found
