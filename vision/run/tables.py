"""Write tracks.csv, tracks.nc, sheets.csv and other tables."""

from __future__ import annotations

import json
import math
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import xarray as xr
from numpy.typing import NDArray
from pyarrow import csv

from vision.files import harmless_table
from vision.numeric import row_parts

_JSON = ("[", "{", '"')  # first character of an attribute that is read back as JSON
ROWS_PER_CHUNK = 1 << 17  # of the table of positions that are in memory
ROWS_PER_BATCH = 1 << 15  # formatted at once: Arrow's 1024 take a quarter longer


def write_tracks_csv(
    tracks: xr.Dataset, path: Path, *, pixel_size_um: float | None, stop: threading.Event | None = None
) -> None:
    """Write one row for every frame and sheet, frame by frame; stop early once `stop` is set.

    Positions have four decimals and are empty if not measured. Arrow writes five times as fast as pandas: a
    test of 100 000 frames has five million rows.
    """
    style = csv.WriteOptions(include_header=False, quoting_style="none", batch_size=ROWS_PER_BATCH)
    with path.open("wb") as file:
        for k, columns in enumerate(columns_in_parts(tracks, pixel_size_um)):
            if stop is not None and stop.is_set():
                return
            if k == 0:
                file.write((",".join(columns) + "\n").encode())
            table = {name: pa.array(values, from_pandas=True) for name, values in columns.items()}
            csv.write_csv(pa.table(table), file, style)


def columns_in_parts(tracks: xr.Dataset, pixel_size_um: float | None) -> Iterator[dict[str, NDArray[Any]]]:
    """Yield `tracks_columns` of `ROWS_PER_CHUNK` rows at a time, so that memory does not grow."""
    step = max(1, ROWS_PER_CHUNK // max(1, tracks.sizes["sheet"]))
    for start in range(0, max(1, tracks.sizes["frame"]), step):
        yield tracks_columns(tracks.isel(frame=slice(start, start + step)), pixel_size_um=pixel_size_um)


def tracks_table(tracks: xr.Dataset, *, pixel_size_um: float | None = None) -> pd.DataFrame:
    """Return tracks as a long table: frame, time_s, index, side, n, x_px, x_err_px, x_um, flag."""
    return pd.DataFrame(tracks_columns(tracks, pixel_size_um=pixel_size_um))


def tracks_columns(tracks: xr.Dataset, *, pixel_size_um: float | None = None) -> dict[str, NDArray[Any]]:
    """Return the columns of `tracks_table`, (frame × sheet,)."""
    frames, sheets = tracks.sizes["frame"], tracks.sizes["sheet"]
    x = tracks["x_px"].values.ravel()
    return {
        "frame": np.repeat(tracks["frame"].values, sheets),
        "time_s": np.repeat(tracks["time_s"].values.round(9), sheets),
        "index": np.tile(tracks["sheet"].values, frames),
        "side": np.tile(tracks["side"].values, frames),
        "n": np.tile(tracks["n"].values, frames),
        "x_px": x.round(4),
        "x_err_px": tracks["x_err_px"].values.ravel().round(5),
        "x_um": np.full(x.shape, np.nan) if pixel_size_um is None else (x * pixel_size_um).round(4),
        "flag": tracks["flag"].values.ravel(),
    }


def sheets_table(tracks: xr.Dataset) -> pd.DataFrame:
    """Return one row per sheet: index, side, n, x_mean_px, found, fwhm_px, snr and noise columns."""
    digits = {"x_mean_px": 4, "found": 5, "fwhm_px": 2, "snr": 1, "x_noise_px": 5}
    digits |= {name: 5 for name in ("x_scatter_px", "x_predicted_px", "misscaled") if name in tracks}
    who = {"index": tracks["sheet"].values, "side": tracks["side"].values, "n": tracks["n"].values}
    return pd.DataFrame(who | {name: tracks[name].values.round(places) for name, places in digits.items()})


def write_tracks_nc(
    tracks: xr.Dataset, path: Path, *, pixel_size_um: float | None, constant_error_px: float = math.nan
) -> None:
    """Write netCDF-4 with CF units and long names; x_um only if the pixel size is known; flags as characters.

    `constant_error_px`, an attribute of x_px, is the error of positions that is the same in all frames. The
    file is made in memory, because HDF5 crashes the process if a disk fills up.  Raises: OSError.
    """
    data = tracks.assign_coords(index=("sheet", tracks["sheet"].values, {"long_name": "index from the left"}))
    data["frame"].attrs["long_name"] = "frame number"
    data["sheet"].attrs["long_name"] = "sheet, counted from the left"
    if math.isfinite(constant_error_px):
        comment = "x_err_px: error of a displacement; constant_error_px: of a position, equal in all frames"
        about = {"constant_error_px": constant_error_px, "comment": comment}
        data["x_px"] = data["x_px"].assign_attrs(about)
    if pixel_size_um is not None:
        about = {"long_name": "position of the sheet", "units": "um"}
        data = data.assign(x_um=(("frame", "sheet"), data["x_px"].values * pixel_size_um, about))
    data.attrs = {"Conventions": "CF-1.11", "title": "positions of sheets, x(n,t)"} | netcdf_attrs(data.attrs)
    encoding: dict[str, dict[str, Any]] = {}
    for name, variable in data.variables.items():
        packed = {"zlib": True, "complevel": 1, "shuffle": True} if variable.ndim >= 2 else {}
        encoding[str(name)] = packed
        if variable.dtype.kind in "UO":
            encoding[str(name)] = packed | {"char_dim_name": f"{name}_length"}
            attrs = variable.attrs | {"_Encoding": "utf-8"}
            data[name] = (variable.dims, _as_bytes(variable), attrs)
    path.write_bytes(data.to_netcdf(engine="h5netcdf", encoding=encoding))


def _as_bytes(text: xr.Variable) -> NDArray[np.bytes_]:
    """Encode ASCII text, as wide as the longest one, ten times as fast as xarray does, a part at a time."""
    parts = list(row_parts(len(text))) or [slice(0)]
    return np.concatenate([_encoded_part(text[rows].values) for rows in parts])


def _encoded_part(text: NDArray[Any]) -> NDArray[np.bytes_]:
    wide = np.ascontiguousarray(text, np.str_)
    width = max(1, int(np.strings.str_len(wide).max(initial=1)))
    codes = wide.view(np.uint32).reshape(*wide.shape, -1)[..., :width]  # of the characters
    return np.ascontiguousarray(codes, np.uint8).view(f"S{width}")[..., 0]


def write_table(table: pd.DataFrame, path: Path) -> None:
    """Write CSV with nine digits, with text that a spreadsheet would take for a formula made harmless."""
    harmless_table(table).to_csv(path, index=False, float_format="%.9g", lineterminator="\n")


def netcdf_attrs(attrs: Mapping[str, Any]) -> dict[str, Any]:
    """Convert attributes for netCDF: lists and dicts to JSON, also text that would be read back as JSON.

    Characters of file names that are not UTF-8 become "?".
    """
    encoded = {name: _encoded(value) for name, value in attrs.items() if value is not None}
    return {
        name: value.encode("utf-8", "replace").decode() if isinstance(value, str) else value
        for name, value in encoded.items()
    }


def _encoded(value: Any) -> Any:
    is_text = isinstance(value, str) and value[:1] in _JSON
    return json.dumps(value, default=str) if is_text or isinstance(value, list | tuple | dict) else value


def attrs_of_netcdf(attrs: Mapping[str, Any]) -> dict[str, Any]:
    """Convert attributes back: the inverse of `netcdf_attrs`."""
    return {
        name: json.loads(value) if isinstance(value, str) and value[:1] in _JSON else value
        for name, value in attrs.items()
    }
