"""Load and separation against time, with quality flags, from the file of a testing machine.

The columns of time, load and displacement are found by their names in four languages and by their units, or
are given by the user.
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import xarray as xr

from vision.data import FORCE, ForceMetadata, changed_settings, record
from vision.errors import PATH, InputError, check_kind, check_positive, check_within
from vision.force.files import TIME_OF_DAY, Dimension, Table, Unit, read_tables, unit_of
from vision.force.settings import ForceSettings
from vision.numeric import Bools, Floats, Strings, spread_indices
from vision.signals import running_median

Role = Literal["time", "load", "displacement", "video_time"]
ROLES: tuple[Role, ...] = get_args(Role)
_ADVICE = "`columns` time=…,load=…,displacement=…"
_LEAST_SAMPLES = 10
_MOST = 1e11  # s, N or mm: beyond all that is recorded, clock times since 1601 in s included


def read_force(
    path: str | Path,
    *,
    speed_mm_min: float | None = None,
    d0_mm: float | None = None,
    d0_err_mm: float | None = None,
    columns: Mapping[str, str] | None = None,
    settings: ForceSettings = ForceSettings(),
) -> xr.Dataset:
    """Read load and separation of a traction test as recorded: nothing is smoothed, sorted or left out.

    Parameters
    ----------
    path
        Recording of a testing machine in any layout (text, CSV, .TRA, .xlsx, .mat).
    speed_mm_min
        V, pulling speed. It replaces a displacement that is not recorded, and is else compared with it.
    d0_mm
        Separation when the recording begins; the crosshead's change since then is added. Give 0 where the
        column is the separation itself. By default `d_mm` counts from the zero of the crosshead, with a note.
    d0_err_mm
        Error of `d0_mm`, for the systematic errors of the fits.
    columns
        ``{"time": …, "load": …, "displacement": …, "video_time": …}``, as from `parse_columns`, for columns
        that are not found by their names.
    settings
        See `ForceSettings`.

    Returns
    -------
    Dataset with dimension ``time_s``: ``load_N`` (tension positive), ``d_mm``, ``flag`` and, where recorded,
    ``crosshead_mm`` and ``video_time_s``; attributes are described in `vision.data.ForceMetadata`. Rows with
    a bad time remain, so ``time_s`` may contain NaN or decrease: use `good_samples`. ``d_mm`` is NaN where
    neither a displacement nor a speed is known. A load that is a force over a weight has units "1". Rows from
    the begin of a second recording in the file are flagged "backwards", and a warning names it.

    Raises
    ------
    InputError
        For a missing, unreadable or unrecognised file, ambiguous columns or unknown units.

    Notes
    -----
    .. math:: d = d_0 + x_\\mathrm{crosshead}(t) - x_\\mathrm{crosshead}(t_0)
        \\quad\\text{or}\\quad d = d_0 + V (t - t_0)
    """
    check_kind(PATH, "the path of a force recording", path=path)
    check_kind(Mapping | None, "roles and the names of their columns", columns=columns)
    check_positive(speed_mm_min=speed_mm_min)
    check_within("a number of mm from 0", 0, math.inf, d0_mm=d0_mm, d0_err_mm=d0_err_mm)
    path = Path(path)
    with np.errstate(invalid="ignore"):
        found, facts, blocks = _joined(path, read_tables(path), columns)
        force = _dataset(path, found, facts, blocks, speed_mm_min, d0_mm, d0_err_mm, settings)
    return record(
        force,
        "read_force",
        path=str(path),
        speed_mm_min=speed_mm_min,
        d0_mm=d0_mm,
        d0_err_mm=d0_err_mm,
        columns=dict(columns) if columns else None,
        settings=changed_settings(settings),
    )


def good_samples(force: xr.Dataset) -> xr.Dataset:
    """Return the samples that are fit for measuring: finite, at rising times, and not saturated."""
    return force.isel(time_s=np.flatnonzero(usable(flags_of(force))))


def flags_of(force: xr.Dataset, settings: ForceSettings = ForceSettings()) -> Strings:
    """Return the flag of every sample; of arrays of one's own, without flags, as `read_force` sets them."""
    if "flag" in force:
        return np.asarray(force["flag"].values, dtype=str)
    time, load, d_mm = (force[name].to_numpy().astype(float) for name in ("time_s", "load_N", "d_mm"))
    return sample_flags(time, load, d_mm if np.isfinite(d_mm).any() else None, settings=settings)


def _joined(
    path: Path, tables: list[Table], named: Mapping[str, str] | None
) -> tuple[dict[Role, Column], dict[str, str], list[Table]]:
    """Return the columns of the blocks that hold time and load, one after the other, the file's facts, and
    these blocks."""
    largest = max(tables, key=lambda table: table.numbers.size)
    wanted = find_columns(path, largest, named)
    used: list[dict[Role, Column]] = []
    blocks: list[Table] = []
    for table in tables:
        try:
            columns = wanted if table is largest else find_columns(path, table, named)
        except InputError:
            continue  # a smaller block of other data, such as a table of peaks
        if set(columns) == set(wanted):
            used.append(columns)
            blocks.append(table)
    joined: dict[Role, Column] = {
        role: Column(
            first.name, first.unit, first.assumed, np.concatenate([columns[role].values for columns in used])
        )
        for role, first in used[0].items()
    }
    facts = {"blocks": f"{len(used)} of {len(tables)}", "columns_seen": largest.listing()}
    return joined, largest.facts | facts, blocks


def _dataset(
    path: Path,
    found: dict[Role, Column],
    facts: dict[str, str],
    blocks: list[Table],
    speed_mm_min: float | None,
    d0_mm: float | None,
    d0_err_mm: float | None,
    settings: ForceSettings,
) -> xr.Dataset:
    """Return the dataset of `read_force` for the columns found."""
    time, load = found["time"].values, found["load"].values
    crosshead = found["displacement"].values if "displacement" in found else None
    if time.size < _LEAST_SAMPLES:
        raise InputError(path, f"at least {_LEAST_SAMPLES} samples", f"{time.size}")
    flags = sample_flags(time, load, crosshead, settings=settings)
    restart = _restart(time)
    flags[restart:] = "backwards"  # a longer second recording would go on where the first one ends
    good = usable(flags)
    if good.sum() < _LEAST_SAMPLES:
        falling = np.mean(flags == "backwards") > 0.5
        advice = "the rows seem to be in reverse order: sort them by time" if falling else ""
        count = f"{good.sum() or 'none'} among {time.size} rows"
        raise InputError(path, "rising times and finite loads", count, advice)
    # With d0 = 0 the column is the separation itself.
    start = 0.0 if crosshead is None or not d0_mm else float(crosshead[good][0])
    if crosshead is not None:
        travel, source = crosshead - start, "displacement"
    elif speed_mm_min is not None:
        travel, source = speed_mm_min / 60.0 * (time - float(time[good][0])), "speed"
    else:
        travel, source = np.full(time.shape, np.nan), "none"
    values = {"load_N": load, "d_mm": (d0_mm or 0.0) + travel, "flag": flags}
    values |= {} if crosshead is None else {"crosshead_mm": crosshead}
    values |= {"video_time_s": found["video_time"].values} if "video_time" in found else {}
    force = xr.Dataset(
        {name: ("time_s", column, FORCE[name].attrs) for name, column in values.items()},
        coords={"time_s": ("time_s", time, FORCE["time_s"].attrs)},
    )
    if found["load"].unit == "1":
        force["load_N"].attrs["units"] = "1"
    measured = _speed(time[good], travel[good])
    jumps = np.zeros_like(good) if crosshead is None else _jumps(crosshead, flags == "nan", settings)
    warnings = _restart_warnings(restart, time.size, blocks)
    warnings += _warnings(found["load"], flags, load[good], source, speed_mm_min, measured)
    warnings += _gap_warnings(flags == "gap", jumps, time, travel, source, settings)
    if source == "speed":
        warnings += _rest_warnings(time[good], load[good], travel[good], d0_mm, settings)
    if abs(start) > 0.05 * max(float(np.ptp(travel[good])), 1e-9):  # zeros are set manually
        warnings.append(
            f"the crosshead starts at {start:.4g} mm: `d0_mm` {d0_mm:g} is added to its change since then; "
            "`d0_mm` 0 takes the column for the separation itself"
        )
    metadata = ForceMetadata(
        source=str(path),
        separation_from=source,
        speed_mm_min=measured if source == "displacement" else speed_mm_min or float("nan"),
        d0_mm=math.nan if d0_mm is None else d0_mm,
        d0_err_mm=math.nan if d0_err_mm is None else float(d0_err_mm),
        displacement_unit="assumed" if crosshead is not None and found["displacement"].assumed else "stated",
        columns=[f"{role} = {c.name} [{c.unit}]" for role, c in found.items()],
        notes=_notes(found, source, d0_mm, _at_slips(jumps, load)),
        warnings=warnings,
        **facts,
    )
    return force.assign_attrs(metadata.attrs())


def _restart(time: Floats) -> int:
    """Return the first row at which the time starts again, as in a second recording; without one, the number
    of rows. The time falls by nine tenths of what has passed, and goes on from there; rows ten before and
    nine after it tell this from single wrong times."""
    row = np.flatnonzero(np.diff(time) < 0) + 1
    row = row[(row >= 10) & (row + 9 < time.size)]
    before, here, after = time[row - 10], time[row], time[row + 9]
    again = (after > here) & (after < before) & (here - time[0] < 0.1 * (before - time[0]))
    return int(row[again][0]) if again.any() else time.size


def _restart_warnings(restart: int, rows: int, blocks: list[Table]) -> list[str]:
    """Return that the file holds a second recording, and from which line on."""
    if restart == rows:
        return []
    starts = np.cumsum([0, *(len(block.numbers) for block in blocks)])
    k = int(np.searchsorted(starts, restart, side="right")) - 1
    line, layout = blocks[k].first_line, blocks[k].facts.get("layout", "")
    place = f"line {line + restart - starts[k]}" if line else f"row {restart + 1}"
    place += f" of worksheet {layout.removeprefix('Excel, ')}" if layout.startswith("Excel, ") else ""
    return [
        f"the time starts again at {place}: the file seems to hold two recordings or more, and only the "
        "first is used; save each in a file of its own"
    ]


def _speed(time: Floats, travel: Floats) -> float:
    """Return the median speed, mm/min, of twenty stretches of the recording, so that holds do not count."""
    knots = spread_indices(time.size, 21)
    steps = np.diff(time[knots])
    if not steps.size or not np.all(steps > 0):
        return float("nan")
    return float(np.median(np.diff(travel[knots]) / steps) * 60.0)


def _notes(found: dict[Role, Column], source: str, d0_mm: float | None, on_sample: bool) -> list[str]:
    """Return what was assumed."""
    assumed = {role: c for role, c in found.items() if c.assumed and role != "load"}  # a load is warned of
    notes = [f'"{c.name}" has no unit: {role} assumed in {c.unit}' for role, c in assumed.items()]
    if found["load"].unit == "1":
        notes.append("load is a force over a weight (unit 1): values named _N are in units of that weight")
    if source == "speed":
        notes.append("no displacement recorded: d = d0 + V t with the speed given")
    elif source == "displacement" and d0_mm is None:
        notes.append("`d0_mm` not given: d counts from the crosshead's zero")
    if on_sample:
        notes.append(
            "the displacement jumps where the load falls, as between two points of the sample: Λ_st and K "
            "do not contain the machine's stretch, which need not be corrected"
        )
    return notes


def _warnings(
    column: Column, flags: Strings, load: Floats, source: str, speed_mm_min: float | None, measured: float
) -> list[str]:
    """Return what may spoil the results; `load`: the good samples of the load's column."""
    warnings = []
    if column.assumed:
        warnings.append(
            f'expected a load with a unit; found "{column.name}" without, taken for N: write the unit '
            "beside its name, or give `force_columns` load=NAME:N (or kgf, lbf)"
        )
    if source == "none":
        warnings.append("no displacement column and no `speed_mm_min`: d, lengths and stiffness are empty")
    # A machine holds its speed to a per cent; five leave room for the start and stop.
    if source == "displacement" and speed_mm_min and not np.isclose(measured, speed_mm_min, rtol=0.05):
        warnings.append(
            f"the crosshead moved at {measured:.3g} mm/min, not at `speed_mm_min` {speed_mm_min:g}: "
            "crosshead used" + _factor(measured / speed_mm_min)
        )
    counts = {word: int(np.sum(flags == word)) for word in ("nan", "repeated", "backwards", "saturated")}
    warnings += [
        f"{k} of {flags.size} samples flagged {word} and left out" for word, k in counts.items() if k
    ]
    if is_compression(load):
        warnings.append("the load is negative: a recording in compression, or tension counted negative")
    return warnings


def _factor(ratio: float) -> str:
    """Return which unit of time may be wrong for speeds of this ratio; "" for none."""
    for factor in (60, 1000):
        if np.isclose(abs(np.log(max(ratio, 1e-9))), np.log(factor), atol=0.05):
            return f"; a factor of {factor}: check the unit of the time"
    return ""


def _gap_warnings(
    gap: Bools, jumps: Bools, time: Floats, travel: Floats, source: str, settings: ForceSettings
) -> list[str]:
    """Return how many gaps there are in time, and where the displacement jumps while the time goes on."""
    step = np.diff(time, prepend=np.nan)
    jump = np.flatnonzero(gap & jumps & (step < 2 * np.nanmedian(step)))
    lines = [f"{count} gaps in time"] if (count := int(gap.sum()) - jump.size) else []
    way = float(np.sum(np.diff(travel, prepend=np.nan)[gap]))
    if lines and source == "speed" and way > settings.rest_mm:
        lines[0] += (
            f", in which d = d0 + V t advances by {way:.3g} mm: if the machine rested, or began again, d is "
            "wrong afterwards"
        )
    if jump.size:
        first, more = jump[0], f" and {jump.size - 1} times later" if jump.size > 1 else ""
        by = np.diff(travel)[first - 1]
        lines.append(
            f"the displacement jumps by {by:.3g} mm at {time[first]:.4g} s{more}: samples were lost while "
            "the clock stood still, or a counter was set to 0 or wrapped, and d is wrong from there on"
        )
    return lines


def _rest_warnings(
    time: Floats, load: Floats, travel: Floats, d0_mm: float | None, settings: ForceSettings
) -> list[str]:
    """Return that the machine may have rested at first, where d is calculated from its speed: the load is
    level until it leaves its initial level by a fiftieth of its range.  travel: at this speed, mm."""
    smooth = running_median(load, 11)
    low, high = np.percentile(load, (1, 99))
    away = np.flatnonzero(np.abs(smooth - smooth[0]) > 0.02 * (high - low))
    if not away.size or travel[away[0]] < settings.rest_mm:
        return []
    by, rest_s = float(travel[away[0]]), time[away[0]] - time[0]
    instead = f", or give `d0_mm` {d0_mm - by:.5g}" if d0_mm and d0_mm > by else ""
    return [
        f"the load is level for the first {rest_s:.3g} s: if the machine rested, d = d0 + V t is {by:.3g} mm "
        f"too large; cut these rows{instead}"
    ]


def is_compression(load: Floats) -> bool:
    """Return whether the load is mostly negative and reaches further below zero than above."""
    low, high = np.percentile(load[np.isfinite(load)], (1, 99))
    return bool(-low > high and np.nanmedian(load) < 0)


# --- which column is what -----------------------------------------------------------------------------------


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
# A column whose name contains one of these words is not a measurement of the sample.
_NEVER = _set(
    "sollwert soll setpoint command consigne consigna target demand rate speed vitesse geschwindigkeit"
    " velocidad stress strain error max maximum peak pic min minimum count cycle"
)
_ABSOLUTE = _set("absolute absolue absolu absolut absoluta absoluto")
_OVER_WEIGHT = frozenset({"fnorm"})


@dataclass(frozen=True)
class Column:
    """A column of the file, in the base unit of its role."""

    name: str  # as in the file
    unit: str  # as written or given, "1" for a force over a weight
    assumed: bool  # whether no unit is written, so that the base unit (s, N or mm) is assumed
    values: Floats = field(repr=False)  # in s, N or mm


def parse_columns(text: str) -> dict[str, str]:
    """Parse the roles in a text such as ``time=Time,load=Load:kN,displacement=3``.

    Returns role to column, as `read_force` takes it. A column is a name, or a number counted from 1.
    ``:unit`` states the unit, a leading ``-`` inverts the sign, and ``time=2000Hz`` gives the sampling rate
    of a recording without times. Raises InputError for anything else.
    """
    found: dict[str, str] = {}
    for part in re.split(r",(?=\s*\w+\s*=)", text.strip().strip(",")):
        key, equals, value = part.partition("=")
        role = next((role for role in ROLES if role == key.strip()), None)
        if role is None or not equals or not value.strip():
            wanted = f"ROLE=COLUMN with ROLE one of {', '.join(ROLES)}"
            advice = "write time=Time,load=Load:kN,displacement=3, with names or numbers of columns"
            raise InputError("`force_columns`", wanted, f'"{part}"', advice)
        found[role] = value.strip()
    return found


def find_columns(path: Path, table: Table, named: Mapping[str, str] | None = None) -> dict[Role, Column]:
    """Return the columns of a table by role; "displacement" and "video_time" only where present.

    Raises InputError where time or load is missing, where two columns fit equally well, or where a written
    unit is not known. The message lists the columns and shows how to name them.
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
    """Return the column that the user names for a role."""
    rate = re.fullmatch(r"([\d.]+)\s*Hz", text) if role == "time" else None
    if rate:
        return Column(text, "Hz", assumed=False, values=np.arange(len(table.numbers)) / float(rate[1]))
    index, sign, unit_text = _locate(path, table, text)
    column = _column(path, table, role, index, unit_text)
    return Column(column.name, column.unit, column.assumed, sign * column.values)


def _locate(path: Path, table: Table, text: str) -> tuple[int, int, str]:
    """Return index, sign and unit ("" for none) of a column given as NAME, NUMBER, NAME:unit or -NAME."""
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
    """Return the column whose name, or else whose unit alone, fits a role best; None where none fits."""
    every = np.flatnonzero(np.isfinite(table.numbers).any(axis=0)).tolist()  # an empty column is none
    candidates = [k for k in every if _fits(table, role, k)]
    if not candidates and role != "video_time":
        units = [unit_of(unit) for unit in table.units]
        candidates = [k for k in every if (unit := units[k]) and unit.dimension == _DIMENSION[role]]
        candidates = [k for k in candidates if not set(_words(table.names[k])) & _NEVER]
    if not candidates:
        return None
    ranks = {k: _rank(table, role, k) for k in candidates}
    chosen = [k for k in candidates if ranks[k] == min(ranks.values())]
    if len(chosen) > 1:
        several = ", ".join(f'{k + 1} "{table.names[k]}"' for k in chosen)
        raise InputError(path, f"one {role} column", f"{len(chosen)}: {several}", f"choose with {_ADVICE}")
    return _column(path, table, role, chosen[0], "")


def _words(name: str) -> list[str]:
    """Return the lower-case words of a name without accents: two each for "TestTime" and "video_time"."""
    plain = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
    return re.findall(r"[a-z]+", re.sub(r"(?<=[a-z])(?=[A-Z])", " ", plain).lower())


def _fits(table: Table, role: Role, k: int) -> bool:
    """Return whether a column has a name of this role, and no unit of another."""
    words = set(_words(table.names[k]))
    unit = unit_of(table.units[k])
    if words & _NEVER or (unit and unit.dimension not in (_DIMENSION[role], "ratio")):
        return False
    if role == "video_time":
        return bool(words & _VIDEO and words & _WORDS["time"])
    if role == "displacement" and words & _WORDS["load"]:
        return False
    return bool(words & _WORDS[role]) and not words & _VIDEO


def _rank(table: Table, role: Role, k: int) -> tuple[bool, bool, int]:
    """Return a rank by which the best column of a role is the smallest: columns with a unit, then those that
    are neither an absolute position nor a coarse time of the day, then the shortest names for time."""
    words = _words(table.names[k])
    absolute = bool(set(words) & _ABSOLUTE) or table.units[k] == TIME_OF_DAY
    return unit_of(table.units[k]) is None, absolute, len(words) if role == "time" else 0


def _column(path: Path, table: Table, role: Role, k: int, given: str) -> Column:
    """Return column k in the base unit of its role; a `given` unit replaces the written one."""
    written = given or table.units[k]
    name = table.names[k] or f"column {k + 1}"
    if not written and set(_words(name)) & _OVER_WEIGHT:
        written = "1"
    unit = unit_of(written) if written else Unit(_BASE[role], _DIMENSION[role], 1.0)
    allowed = (_DIMENSION[role], "ratio") if role == "load" else (_DIMENSION[role],)
    if unit is None or unit.dimension not in allowed:
        advice = f"convert the values, or state the unit: `columns` {role}={name}:{_BASE[role]}"
        raise InputError(path, f'a unit of {_DIMENSION[role]} for "{name}"', f'"{written}"', advice)
    shown = "1" if unit.dimension == "ratio" else unit.text
    return Column(name, shown, assumed=not written, values=table.numbers[:, k] * unit.factor)


# --- quality flags; the data stay unchanged -----------------------------------------------------------------


def sample_flags(
    time_s: Floats, load: Floats, displacement: Floats | None, *, settings: ForceSettings = ForceSettings()
) -> Strings:
    """Return one flag per sample: the first of these that applies, else "ok".

    "nan": time, load or displacement is not a number. "backwards": the time is earlier than a previous one.
    "repeated": the time equals the latest one. "saturated": in a run of equal samples at the largest absolute
    load. "gap": several sampling intervals, or as long a way, lie before the sample, which itself is good.
    """
    flags = np.full(time_s.shape, "ok", dtype="<U9")
    bad = ~(np.abs(time_s) < _MOST) | ~(np.abs(load) < _MOST)  # damaged digits; NaN and infinity too
    if displacement is not None:
        bad |= ~(np.abs(displacement) < _MOST)
    latest = np.fmax.accumulate(np.r_[-np.inf, np.where(bad, -np.inf, time_s)])[:-1]
    step = np.where(bad, np.nan, time_s) - latest
    forward = step[np.isfinite(step) & (step > 0)]
    if forward.size:
        usual = np.full(step.shape, np.nan)
        usual[np.isfinite(step) & (step > 0)] = running_median(forward, 101)  # the rate may change
        flags[step > settings.gap_intervals * usual] = "gap"
    if displacement is not None:  # the clock may stand still during a loss, but the crosshead goes on
        jumps = _jumps(displacement, bad, settings)
        flags[jumps & (not _at_slips(jumps, load))] = "gap"
    flags[_saturated(load, settings.saturated_run)] = "saturated"
    flags[step == 0] = "repeated"
    flags[step < 0] = "backwards"
    flags[bad] = "nan"
    return flags


def _jumps(displacement: Floats, bad: Bools, settings: ForceSettings) -> Bools:
    """Return the samples before which the displacement moves several times as far as it usually does."""
    way = np.abs(np.diff(displacement, prepend=displacement[:1]))
    moves = way[~bad & (way > 0)]
    return way > settings.gap_intervals * np.quantile(moves, 0.99) if moves.size else np.zeros_like(bad)


def _at_slips(jumps: Bools, load: Floats) -> bool:
    """Return whether the displacement jumps where the load falls, as that of a sensor on the sample does.

    Over lost samples the load falls or rises. Five jumps are needed to tell.
    """
    falls = np.diff(load, prepend=load[:1])[jumps] < 0
    return bool(falls.size >= 5 and falls.mean() > 0.9)


def _saturated(load: Floats, least: int) -> Bools:
    """Return the samples in runs, of `least` or more, at the largest |load|; none if the load never changes.
    A load in coarse steps has runs at every step, so these must also be twice as long as most others."""
    finite = np.abs(load[np.isfinite(load)])
    if not finite.size or np.ptp(finite) == 0:
        return np.zeros(load.shape, dtype=bool)
    begins = np.flatnonzero(np.r_[True, load[1:] != load[:-1]])
    length = np.diff(np.append(begins, load.size))
    at_limit = np.abs(load[begins]) == finite.max()
    others = np.sort(length[~at_limit])
    steps = others[np.searchsorted(np.cumsum(others), 0.9 * others.sum())]
    return np.repeat(at_limit & (length >= max(least, 2 * steps)), length)


def usable(flags: Strings) -> Bools:
    """Return which samples are fit for measuring: good ones and those after a gap."""
    return np.isin(flags, ("ok", "gap"))
