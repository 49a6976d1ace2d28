"""A testing machine's file becomes load and separation against time."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vision.errors import InputError
from vision.force.columns import Column, Role, resolve
from vision.force.flags import sample_flags, usable
from vision.force.matfile import read_mat
from vision.force.table import Table
from vision.force.textfile import read_text

if TYPE_CHECKING:
    import xarray as xr

_MIN_SAMPLES = 10
_SPEED_TOLERANCE = 0.05


def read_force(
    path: str | Path,
    *,
    speed_mm_min: float | None = None,
    d0_mm: float | None = None,
    columns: Mapping[str, str] | None = None,
) -> xr.Dataset:
    """Load and separation of a traction test, as recorded: nothing is smoothed, sorted or left out.

    d = d0 + crosshead where a displacement is recorded, else d0 + V (t - t0) where a speed is given; `d_mm`
    is NaN where neither is there.  Without `d0_mm` it counts from the crosshead's zero and a note says so; 0
    means that the column is the separation itself.  Tension is positive.

    Args: path, any layout of a testing machine (text, CSV, .TRA, .mat).  speed_mm_min, V.  d0_mm, separation
    at crosshead 0.  columns, {"time": …, "load": …, "displacement": …, "video_time": …} as `parse_columns`
    returns.

    Returns: load_N, d_mm, flag (time_s) and, where recorded, crosshead_mm and video_time_s.  `flag` as in
    `sample_flags`; rows with a bad time stay, so time_s may hold NaN or run backwards: use `good_samples`.
    A load that is a force over a weight (unit "1") keeps its name and has units "1".  attrs: layout,
    encoding, separator, decimal, columns, source ("displacement", "speed" or "none"), speed_mm_min, d0_mm,
    notes, warnings.

    Raises InputError for a missing, unreadable or unrecognised file, ambiguous columns or unknown units.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(path, "a force recording", "a folder" if path.is_dir() else "no such file")
    with np.errstate(invalid="ignore"):
        tables = read_mat(path) if path.suffix.lower() == ".mat" else read_text(path)
        found, facts = _joined(path, tables, columns)
        return _dataset(path, found, facts, speed_mm_min, d0_mm)


def good_samples(force: xr.Dataset) -> xr.Dataset:
    """The samples that can be measured on: finite, times strictly rising, load cell not saturated."""
    return force.isel(time_s=np.flatnonzero(usable(force["flag"].values)))


def _joined(
    path: Path, tables: list[Table], named: Mapping[str, str] | None
) -> tuple[dict[Role, Column], dict[str, str]]:
    """The columns of the blocks that hold time and load, one after the other."""
    largest = max(tables, key=lambda table: table.numbers.size)
    resolved: list[tuple[dict[Role, Column], Table]] = []
    for table in tables:
        try:
            resolved.append((resolve(path, table, named), table))
        except InputError:
            if table is largest:
                raise
    roles = set(resolved[[table is largest for _, table in resolved].index(True)][0])
    used = [columns for columns, _ in resolved if set(columns) == roles]
    joined: dict[Role, Column] = {
        role: Column(
            column.name,
            column.unit,
            column.assumed,
            np.concatenate([columns[role].values for columns in used]),
        )
        for role, column in used[0].items()
    }
    facts = {**largest.facts, "blocks": f"{len(used)} of {len(tables)}", "seen": largest.listing()}
    return joined, facts


def _dataset(
    path: Path,
    found: dict[Role, Column],
    facts: dict[str, str],
    speed_mm_min: float | None,
    d0_mm: float | None,
) -> xr.Dataset:
    import xarray as xr

    time, load = found["time"].values, found["load"].values
    crosshead = found["displacement"].values if "displacement" in found else None
    if time.size < _MIN_SAMPLES:
        raise InputError(path, f"at least {_MIN_SAMPLES} samples", f"{time.size}")
    flags = sample_flags(time, load, crosshead)
    good = usable(flags)
    if not good.any():
        raise InputError(path, "rising times and finite loads", f"none among {time.size} rows")
    travel, source = _travel(time, crosshead, speed_mm_min, start_s=float(time[good][0]))
    unit = found["load"].unit
    data = {
        "load_N": ("time_s", load, {"units": "1" if unit == "1" else "N", "long_name": "load"}),
        "d_mm": ("time_s", (d0_mm or 0.0) + travel, {"units": "mm", "long_name": "separation"}),
        "flag": ("time_s", flags),
    }
    if crosshead is not None:
        data["crosshead_mm"] = ("time_s", crosshead, {"units": "mm", "long_name": "crosshead"})
    if "video_time" in found:
        data["video_time_s"] = (
            "time_s",
            found["video_time"].values,
            {"units": "s", "long_name": "camera's clock"},
        )
    force = xr.Dataset(
        data, coords={"time_s": ("time_s", time, {"units": "s", "long_name": "machine's clock"})}
    )
    measured = _speed(time[good], travel[good])
    notes, warnings = _remarks(found, flags, good, source, speed_mm_min, d0_mm, measured, load[good])
    return force.assign_attrs(
        {
            "path": str(path),
            **facts,
            "columns": "; ".join(f"{role} = {c.name} [{c.unit}]" for role, c in found.items()),
            "source": source,
            "speed_mm_min": measured if source == "displacement" else speed_mm_min or float("nan"),
            "d0_mm": float("nan") if d0_mm is None else d0_mm,
            "notes": "\n".join(notes),
            "warnings": "\n".join(warnings),
        }
    )


def _travel(
    time: NDArray[np.float64],
    crosshead: NDArray[np.float64] | None,
    speed_mm_min: float | None,
    *,
    start_s: float,
) -> tuple[NDArray[np.float64], str]:
    if crosshead is not None:
        return crosshead, "displacement"
    if speed_mm_min is not None:
        return speed_mm_min / 60.0 * (time - start_s), "speed"
    return np.full(time.shape, np.nan), "none"


def _speed(time: NDArray[np.float64], travel: NDArray[np.float64]) -> float:
    """mm/min: the median speed over stretches of a twentieth of the recording, so that holds do not count."""
    knots = np.unique(np.linspace(0, time.size - 1, 21).astype(int))
    steps = np.diff(time[knots])
    return (
        float(np.median(np.diff(travel[knots]) / steps) * 60.0)
        if np.all(steps > 0) and steps.size
        else float("nan")
    )


def _remarks(
    found: dict[Role, Column],
    flags: NDArray[np.str_],
    good: NDArray[np.bool_],
    source: str,
    speed_mm_min: float | None,
    d0_mm: float | None,
    measured: float,
    load: NDArray[np.float64],
) -> tuple[list[str], list[str]]:
    """(notes, warnings): what was taken for granted, and what may spoil the results."""
    notes = [f'"{c.name}" has no unit: {role} taken in {c.unit}' for role, c in found.items() if c.assumed]
    warnings = []
    if found["load"].unit == "1":
        notes.append("load is a force over a weight (unit 1): every _N below is in units of that weight")
    if source == "speed":
        notes.append("no displacement recorded: d = d0 + V t with the speed given")
    if source == "none":
        warnings.append("no displacement recorded and no --speed: d, lengths and stiffness are empty")
    elif d0_mm is None:
        notes.append("--d0 not given: d counts from the crosshead's zero")
    if (
        source == "displacement"
        and speed_mm_min
        and not np.isclose(measured, speed_mm_min, rtol=_SPEED_TOLERANCE)
    ):
        warnings.append(
            f"the crosshead moved at {measured:.3g} mm/min, --speed says {speed_mm_min:g}: crosshead used"
        )
    counts = {word: int(np.sum(flags == word)) for word in ("nan", "repeated", "backwards", "saturated")}
    warnings += [
        f"{k} of {flags.size} samples flagged {word} and left out" for word, k in counts.items() if k
    ]
    if count := int(np.sum(flags == "gap")):
        warnings.append(f"{count} gaps in time")
    if is_compression(load):
        warnings.append("the load is negative: a recording in compression, or tension counted negative")
    return notes, warnings


def is_compression(load: NDArray[np.float64]) -> bool:
    """True where the load is mostly negative and reaches further below zero than above."""
    low, high = np.percentile(load[np.isfinite(load)], (1, 99))
    return bool(-low > high and np.nanmedian(load) < 0)
