"""A run's results as tables, in the shapes that other programs read."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from vision.run.reading import Run, read_json, read_table, tracks_of
from vision.run.tables import sheets_table, tracks_table

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

PER_EVENT = ("events", "deformation", "shells")


def all_tables(run: Run) -> dict[str, pd.DataFrame]:
    """Every table of a run, by name; those that it does not have are left out.

    tracks: one row per frame and sheet, every one. positions: x with one row per frame and one column per
    sheet, as side_n_unit. sheets, events, deformation, shells: as in the run folder. settings: what
    run.json, clock.json and models.json say. The unit is the last part of a column's name. Positions that
    are not "ok" are NaN, their flag says why.
    """
    tables: dict[str, pd.DataFrame] = {}
    if run.tracks is not None:
        size = run.pixel_size_um
        tables["tracks"] = tracks_table(run.tracks, pixel_size_um=size)
        tables["positions"] = positions_table(run.tracks, pixel_size_um=size)
        tables["sheets"] = sheets_table(run.tracks)
    return tables | event_tables(run) | {"settings": settings_table(run)}


def event_tables(run: Run) -> dict[str, pd.DataFrame]:
    """The tables that a force recording adds to a run."""
    found = {name: read_table(run, name) for name in PER_EVENT}
    return {name: table for name, table in found.items() if table is not None}


def positions_table(tracks: xr.Dataset, *, pixel_size_um: float | None) -> pd.DataFrame:
    """x(n, t), one row per frame: frame, time_s, then a column for each sheet from left to right.

    Columns are called left_3_um, right_23_um, or …_px where the pixel size is not known.
    """
    import pandas as pd

    unit, scale = ("px", 1.0) if pixel_size_um is None else ("um", pixel_size_um)
    sides = np.where(tracks["side"].values < 0, "left", "right")
    names = [f"{side}_{n}_{unit}" for side, n in zip(sides, tracks["n"].values, strict=True)]
    table = pd.DataFrame((tracks["x_px"].values * scale).round(4), columns=names)
    table.insert(0, "frame", tracks["frame"].values)
    table.insert(1, "time_s", tracks["time_s"].values.round(9))
    return table


def trackpy_table(run: Run) -> pd.DataFrame:
    """What trackpy's functions take: x, y, frame, particle and ep, px, with time_s, side and n beside.

    particle is the sheet's index from the left, ep the standard error of x. y is the middle of the strip,
    the same for all. Positions that are not "ok" are left out, as trackpy allows no NaN.
    """
    tracks = tracks_of(run)
    table = tracks_table(tracks)
    table = table[table["flag"] == "ok"].rename(columns={"x_px": "x", "x_err_px": "ep", "index": "particle"})
    table["y"] = _strip_middle_px(tracks)
    names = ["x", "y", "frame", "particle", "ep", "time_s", "side", "n"]
    return table[names].reset_index(drop=True)


def napari_table(run: Run) -> pd.DataFrame:
    """What napari's tracks layer takes: track_id, t (frame number), y, x, in px, track after track.

    y is the middle of the strip. Positions that are not "ok" are left out.
    """
    table = trackpy_table(run).rename(columns={"particle": "track_id", "frame": "t"})
    return table[["track_id", "t", "y", "x"]].sort_values(["track_id", "t"], ignore_index=True)


def settings_table(run: Run) -> pd.DataFrame:
    """name and value, as text, of everything the run says about itself, nested names joined by dots."""
    import pandas as pd

    facts = dict(run.facts)
    for name in ("clock", "models"):
        path = run.folder / f"{name}.json"
        if path.exists():
            facts[name] = read_json(path)
    pairs = list(_flat(facts, ""))
    return pd.DataFrame(pairs, columns=["name", "value"], dtype=str)


def _flat(facts: Mapping[str, Any], above: str) -> list[tuple[str, str]]:
    pairs: list[tuple[str, str]] = []
    for name, value in facts.items():
        if isinstance(value, Mapping):
            pairs += _flat(value, f"{above}{name}.")
        else:
            text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
            pairs.append((f"{above}{name}", text))
    return pairs


def _strip_middle_px(tracks: xr.Dataset) -> float:
    return (float(tracks.attrs["strip_z0"]) + float(tracks.attrs["strip_z1"]) - 1) / 2
