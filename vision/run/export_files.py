"""Tables as files of other programs: worksheets, Parquet, MATLAB."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vision.errors import InputError
from vision.run.export_tables import event_tables, settings_table
from vision.run.reading import Run
from vision.run.tables import sheets_table

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

EXCEL_ROWS = (1 << 20) - 1  # below the header
ROWS_AT_ONCE = 50_000


def write_csv(tables: Mapping[str, pd.DataFrame], folder: Path) -> None:
    """One file per table, as in the run folder: commas, points, empty where there is nothing."""
    for name, table in tables.items():
        table.to_csv(folder / f"{name}.csv", index=False, lineterminator="\n")


def write_parquet(tables: Mapping[str, pd.DataFrame], folder: Path) -> None:
    """One file per table; null where there is nothing."""
    for name, table in tables.items():
        table.to_parquet(folder / f"{name}.parquet", engine="pyarrow", index=False)


def write_xlsx(tables: Mapping[str, pd.DataFrame], path: Path) -> list[str]:
    """One worksheet per table, the column names with their units frozen on top; empty cells for nothing.

    Returns what was left out: tracks, where it has more rows than a worksheet holds; its positions are in
    the wide table, too.
    Raises: InputError where any other table is too long.
    """
    import openpyxl

    long = [name for name, table in tables.items() if len(table) > EXCEL_ROWS]
    if long not in ([], ["tracks"]):
        rows = len(tables[long[-1]])
        found = f"{rows} in {long[-1]}"
        raise InputError(path, f"at most {EXCEL_ROWS} rows", found, "use --to parquet, csv or mat")
    book = openpyxl.Workbook(write_only=True)
    for name, table in tables.items():
        if name not in long:
            _write_sheet(book, name, table)
    book.save(path)
    return [f"{name}: {len(tables[name])} rows are more than a worksheet holds; left out" for name in long]


def _write_sheet(book: Any, name: str, table: pd.DataFrame) -> None:
    from openpyxl.cell import WriteOnlyCell
    from openpyxl.styles import Font

    sheet = book.create_sheet(name)
    sheet.freeze_panes = "A2"
    header = [WriteOnlyCell(sheet, value=str(column)) for column in table.columns]
    for cell in header:
        cell.font = Font(bold=True)
    sheet.append(header)
    for row in _cells(table):
        sheet.append(row)


def _cells(table: pd.DataFrame) -> Iterator[tuple[Any, ...]]:
    """Rows as Excel can hold them."""
    for start in range(0, len(table), ROWS_AT_ONCE):
        part = table.iloc[start : start + ROWS_AT_ONCE]
        columns = [_column(part[name]) for name in part.columns]
        yield from zip(*columns, strict=True)


def _column(column: pd.Series[Any]) -> pd.Series[Any]:
    """Nothing for NaN, words for infinity, text without control characters."""
    from openpyxl.cell.cell import ILLEGAL_CHARACTERS_RE

    cells = column.astype(object).where(column.notna(), None)
    if column.dtype.kind == "f":
        return cells.mask(np.isinf(column), column.astype(str))
    if column.dtype.kind in "iub":
        return cells
    return cells.map(lambda text: ILLEGAL_CHARACTERS_RE.sub("", text) if isinstance(text, str) else text)


def write_mat(run: Run, path: Path) -> None:
    """A MATLAB 5 file: x_px, x_err_px, x_um and flag (frames × sheets), and what belongs to them.

    frame and time_s are columns, index, side and n rows. Positions that are not "ok" are NaN; flag counts
    from 1 into flag_names. sheets, events, deformation, shells and settings are structs with a column per
    field. x_um is all NaN where the pixel size is not known.
    """
    from scipy.io import savemat

    content: dict[str, Any] = {}
    tables = event_tables(run) | {"settings": settings_table(run)}
    if run.tracks is not None:
        content = _matrices(run.tracks, np.nan if run.pixel_size_um is None else run.pixel_size_um)
        tables["sheets"] = sheets_table(run.tracks)
    content |= {name: _struct(table) for name, table in tables.items()}
    savemat(path, content, appendmat=False, long_field_names=True, do_compression=True)


def _matrices(tracks: xr.Dataset, pixel_size_um: float) -> dict[str, Any]:
    """x(n, t) and its coordinates, numbers as doubles."""
    x = tracks["x_px"].values
    names, codes = np.unique(tracks["flag"].values, return_inverse=True)
    return {
        "x_px": x,
        "x_err_px": tracks["x_err_px"].values,
        "x_um": x * pixel_size_um,
        "pixel_size_um": pixel_size_um,
        "flag": (codes.reshape(x.shape) + 1).astype(np.uint8),
        "flag_names": names.astype(object)[None],
        "frame": tracks["frame"].values.astype(np.float64)[:, None],
        "time_s": tracks["time_s"].values[:, None],
        "index": tracks["sheet"].values.astype(np.float64)[None],
        "side": tracks["side"].values.astype(np.float64)[None],
        "n": tracks["n"].values.astype(np.float64)[None],
    }


def _struct(table: pd.DataFrame) -> dict[str, Any]:
    """Columns of a table: numbers as doubles, text as cells."""
    return {
        str(name): (
            column.to_numpy(np.float64)[:, None]
            if column.dtype.kind in "iufb"
            else column.fillna("").astype(str).to_numpy(object)[:, None]
        )
        for name, column in table.items()
    }
