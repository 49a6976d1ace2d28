"""The tables of all tests as Parquet datasets, a partition for each film, written by the film's own job.

Nothing here grows with the number of tests: opening reads the schema, and what is read is what is asked for.
"""

from __future__ import annotations

import shutil
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pandas as pd
import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.parquet as pq
import xarray as xr

from vision.errors import InputError
from vision.files import reading
from vision.pipeline import Analysis
from vision.run import whole_file
from vision.run.tables import ROWS_PER_CHUNK, sheets_table, tracks_table
from vision.shells import deformation_table

TABLES = ("tests", "sheets", "sticks", "deformation", "positions")
FOLDER = "tables"
FILE = "part.parquet"


def open_tables(out: str | Path, table: str) -> ds.Dataset:
    """One table of all tests of a campaign, opened lazily.

    Parameters
    ----------
    out
        The campaign's folder.
    table
        ``tests`` (a row a film), ``sheets``, ``sticks`` (a row an event), ``deformation`` (event and sheet)
        or ``positions`` (frame and sheet). Each has the column ``film``.

    Returns
    -------
    pyarrow.dataset.Dataset
        ``.to_table(columns=…, filter=…)`` reads what is asked for.

    Raises
    ------
    InputError
        Where there is no such table.

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
        # that of all films together, where the pool has written it: they may differ in columns
        both = [path for path in (files[0], folder / "_common_metadata") if path.is_file()]
        schema = pa.unify_schemas([pq.read_schema(path) for path in both])
        film = pa.field("film", pa.string())
        partitioning = ds.HivePartitioning(pa.schema([film]), segment_encoding="uri")
        return ds.dataset(
            [str(file) for file in files],
            format="parquet",
            schema=schema.append(film),
            partitioning=partitioning,
            partition_base_dir=str(folder),
        )


def write_partitions(out: Path, film: str, analysis: Analysis) -> None:
    """Write a film's part of each table; what it does not have, an earlier run of it may have had: that goes.

    Raises
    ------
    InputError
        Where it cannot be written.
    """
    tables: dict[str, pd.DataFrame] = {}
    if analysis.tracks is not None:
        tables["sheets"] = sheets_table(analysis.tracks)
    if analysis.sticks is not None:
        tables["sticks"] = analysis.sticks
    if analysis.motion is not None:
        tables["deformation"] = deformation_table(analysis.motion, threshold=analysis.threshold)
    for name in ("sheets", "sticks", "deformation"):
        place = _partition(out, name, film)
        if name in tables:
            with whole_file(place) as path:
                pq.write_table(as_arrow(tables[name]), path)
        else:
            place.unlink(missing_ok=True)
    place = _partition(out, "positions", film)
    if analysis.tracks is None:
        place.unlink(missing_ok=True)
        return
    with whole_file(place) as path:
        _write_positions(analysis.tracks, path, analysis.pixel_size_um)


def _write_positions(tracks: xr.Dataset, path: Path, size_um: float | None) -> None:
    """In pieces, so that memory does not grow with the recording."""
    step = max(1, ROWS_PER_CHUNK // max(1, tracks.sizes["sheet"]))
    writer = None
    try:
        for start in range(0, max(1, tracks.sizes["frame"]), step):
            part = tracks.isel(frame=slice(start, start + step))
            table = as_arrow(tracks_table(part, pixel_size_um=size_um))
            writer = writer or pq.ParquetWriter(path, table.schema)
            writer.write_table(table)
    finally:
        if writer is not None:
            writer.close()


def write_tests(out: Path, tests: Mapping[str, Mapping[str, Any]]) -> None:
    """The table of tests, a partition for each film.  Raises: InputError."""
    for film, facts in tests.items():
        with whole_file(_partition(out, "tests", film)) as path:
            pq.write_table(as_arrow(pd.DataFrame([facts])), path)


def close_tables(out: Path, films: Collection[str]) -> None:
    """Remove the parts of other films, and write each table's common schema.  Raises: InputError."""
    kept = {_partition(out, "x", film).parent.name for film in films}
    for table in TABLES:
        folder = out / FOLDER / table
        for part in folder.glob("film=*"):
            if part.name not in kept:
                shutil.rmtree(part, ignore_errors=True)
        schemas = list(_schemas(folder))
        if schemas:
            with whole_file(folder / "_common_metadata") as path:
                pq.write_metadata(pa.unify_schemas(schemas), path)


def _schemas(folder: Path) -> Iterator[pa.Schema]:
    for file in sorted(folder.glob(f"film=*/{FILE}")):
        with reading(file, "a table as track campaign writes it", "run track campaign again"):
            yield pq.read_schema(file)


def _partition(out: Path, table: str, film: str) -> Path:
    return out / FOLDER / table / f"film={quote(film, safe='')}" / FILE


def as_arrow(table: pd.DataFrame) -> pa.Table:
    """A table with one type for each kind of column, whatever one film happens to hold.

    Numbers are double where the column may lack some, whole ones int64; words are strings, also where all
    are missing.
    """
    columns = {}
    for name, column in table.items():
        if pd.api.types.is_bool_dtype(column):
            kind = pa.bool_()
        elif pd.api.types.is_integer_dtype(column):
            kind = pa.int64()
        elif pd.api.types.is_float_dtype(column):
            kind = pa.float64()
        else:
            kind, column = pa.string(), column.astype("string")  # noqa: PLW2901
        columns[str(name)] = pa.array(column, type=kind, from_pandas=True)
    return pa.table(columns)
