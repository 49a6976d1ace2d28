"""Write tracks.csv, tracks.nc, sheets.csv and other tables, and space-time diagrams as TIFF.

The TIFFs open in Fiji with µm and s per pixel; those of a run are read back.
"""

from __future__ import annotations

import io
import json
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pandas as pd
import pyarrow as pa
import tifffile
import xarray as xr
from numpy.typing import NDArray
from pyarrow import compute, csv

from vision.data import OPERATIONS
from vision.errors import InputError
from vision.files import AGAIN, check_regular, reading, shortened
from vision.memory import parts_in_turn, row_parts
from vision.numeric import Floats, Floats32, rms
from vision.sheets.identities import DOUBTS
from vision.sheets.recovery import FLAG_MEANINGS
from vision.spacetime import grey_limits
from vision.video import FrameStore
from vision.video.reader import read_fully
from vision.video.stacks import check_tiff
from vision.words import number_words

_JSON = ("[", "{", '"')  # first character of an attribute that is read back as JSON
ROWS_PER_CHUNK = 1 << 15  # of the table of positions that are in memory
ROWS = 1024  # written or read at once, so that memory does not grow with the recording
IMAGEJ_BYTES = (1 << 32) - (1 << 20)  # ImageJ's TIFF holds less than 4 GiB


def write_tracks_csv(
    tracks: xr.Dataset, path: Path, *, pixel_size_um: float | None, stop: threading.Event | None = None
) -> None:
    """Write one row for every frame and sheet, frame by frame; stop early once `stop` is set.

    Positions have four decimals and are empty if not measured. Arrow writes five times as fast as pandas: a
    test of 100 000 frames has five million rows.
    """
    # Arrow formats 1024 rows at once by default, which takes a quarter longer.
    pool = pa.system_memory_pool()  # Arrow's own keeps 22 MiB
    style = csv.WriteOptions(include_header=False, quoting_style="none", batch_size=1 << 15)
    with path.open("wb") as file:
        for k, columns in enumerate(columns_in_parts(tracks, pixel_size_um)):
            if stop is not None and stop.is_set():
                return
            if k == 0:
                file.write((",".join(columns) + "\n").encode())
            table = {name: _in_arrow(values, pool) for name, values in columns.items()}
            csv.write_csv(pa.table(table), file, style, memory_pool=pool)


def _in_arrow(values: NDArray[Any], pool: pa.MemoryPool) -> pa.Array:
    """Return a column as Arrow stores it, NaN as null. Few different words are converted once each."""
    if values.dtype.kind != "U":
        return pa.array(values, from_pandas=True, memory_pool=pool)
    listed: list[str] = []
    codes = number_words(values, listed)
    return compute.take(pa.array(listed, pa.string()), pa.array(codes), memory_pool=pool)


def columns_in_parts(tracks: xr.Dataset, pixel_size_um: float | None) -> Iterator[dict[str, NDArray[Any]]]:
    """Yield `tracks_columns` of `ROWS_PER_CHUNK` rows at a time, so that memory does not grow."""
    step = max(1, ROWS_PER_CHUNK // max(1, tracks.sizes["sheet"]))
    for frames in row_parts(max(1, tracks.sizes["frame"]), step):
        yield tracks_columns(tracks.isel(frame=frames), pixel_size_um=pixel_size_um)


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
    others = ("x_scatter_px", "x_predicted_px", "constant_error_px", "misscaled")
    digits |= {name: 5 for name in others if name in tracks}
    who = {"index": tracks["sheet"].values, "side": tracks["side"].values, "n": tracks["n"].values}
    return pd.DataFrame(who | {name: tracks[name].values.round(places) for name, places in digits.items()})


def write_tracks_nc(tracks: xr.Dataset, path: Path, *, pixel_size_um: float | None) -> None:
    """Write netCDF-4 with CF units and long names; x_um only if the pixel size is known; flags as characters.

    `constant_error_px`, also an attribute of x_px (rms of the sheets), is the error that every frame has.

    Raises: OSError if the disk is full.
    """
    data = tracks.assign_coords(index=("sheet", tracks["sheet"].values, {"long_name": "index from the left"}))
    data["frame"].attrs["long_name"] = "frame number"
    data["sheet"].attrs["long_name"] = "sheet, counted from the left"
    for whole in ("frame", "sheet", "index", "side", "n"):
        data[whole].attrs["units"] = "1"
    for words, meanings in (("flag", FLAG_MEANINGS), ("why", DOUBTS)):
        if words in data:
            text = "; ".join(f"{word}: {meaning}" for word, meaning in meanings.items())
            data[words].attrs["meanings"] = text
    if "constant_error_px" in data:
        comment = "x_err_px: random error of a position; constant_error_px: equal in all frames"
        constant = rms(data["constant_error_px"].values)
        data["x_px"].attrs |= {"constant_error_px": constant, "comment": comment}
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
    with _FileForHDF5(path, "w+b") as file:
        try:
            data.to_netcdf(file, engine="h5netcdf", encoding=encoding)
        finally:
            if file.error is not None:
                raise file.error


class _FileForHDF5(io.FileIO):
    """A file that keeps its first failure to write: HDF5 would crash the process if it were raised."""

    error: OSError | None = None

    def write(self, data: Any) -> int:
        left = memoryview(data)
        try:
            while left and self.error is None:
                left = left[super().write(left) :]
        except OSError as error:
            self.error = error
        return len(data)


def _as_bytes(text: xr.Variable) -> NDArray[np.bytes_]:
    """Encode ASCII text, as wide as the longest one, ten times as fast as xarray does, a part at a time."""

    def encoded(rows: slice) -> NDArray[np.bytes_]:
        wide = np.ascontiguousarray(text[rows].values, np.str_)
        width = max(1, int(np.strings.str_len(wide).max(initial=1)))
        codes = wide.view(np.uint32).reshape(*wide.shape, -1)[..., :width]  # of the characters
        return np.ascontiguousarray(codes, np.uint8).view(f"S{width}")[..., 0]

    return np.concatenate([encoded(rows) for rows in list(row_parts(len(text))) or [slice(0)]])


def netcdf_attrs(attrs: Mapping[str, Any]) -> dict[str, Any]:
    """Convert attributes for netCDF: lists become JSON, and so does text that would be read back as JSON.

    Characters of file names that are not UTF-8 become "?".
    """
    return {name: _encoded(name, value) for name, value in attrs.items() if value is not None}


def _encoded(name: str, value: Any) -> Any:
    if isinstance(value, list | tuple | dict) or _is_read_as_json(name, value):
        value = json.dumps(value, default=str)
    return value.encode("utf-8", "replace").decode() if isinstance(value, str) else value


def attrs_of_netcdf(attrs: Mapping[str, Any]) -> dict[str, Any]:
    """Convert attributes back to what Python has: the inverse of `netcdf_attrs`."""
    plain = {name: one.item() if isinstance(one, np.generic) else one for name, one in attrs.items()}
    return {name: json.loads(one) if _is_read_as_json(name, one) else one for name, one in plain.items()}


def _is_read_as_json(name: str, value: Any) -> bool:
    """Tell whether a text is read back as JSON; `OPERATIONS` is JSON in memory, too."""
    return name != OPERATIONS and isinstance(value, str) and value[:1] in _JSON


# --- space-time diagrams ------------------------------------------------------------------------------------


def write_kymograph_tif(
    strip: xr.DataArray, path: Path, *, pixel_size_um: float | None, stop: threading.Event | None = None
) -> None:
    """Write I(x, t) as 32-bit grey levels: rows are frames, columns x; NaN for frames without a picture.

    It stops early once `stop` is set. ImageJ metadata hold the size of a pixel: µm (or "pixel") along x and
    seconds along t. Above 4 GiB the file is a plain BigTIFF without them.
    """
    values = np.asarray(strip.values, np.float32)
    large = values.nbytes > IMAGEJ_BYTES
    form = {"bigtiff": True} if large else {"imagej": True, **_calibration(strip, pixel_size_um)}
    with _open_tif(path, values.shape, values.dtype, **form) as file:
        for part in parts_in_turn(values):
            if stop is not None and stop.is_set():
                return
            file.write(np.ascontiguousarray(values[part]).data)


def write_space_time_tif(diagram: xr.DataArray, path: Path, *, pixel_size_um: float | None) -> None:
    """Write a space-time diagram with 16 bits: rows are frames, columns x; 0 is a frame without a picture.

    1 is black (grey level 0, or the smallest value of a float recording) and 65535 white (the camera's
    largest grey level, or the largest value). ImageJ metadata convert the numbers to grey levels, and hold
    the size of a pixel, µm (or "pixel") along x and seconds along t, and the origin of x and t. Each row is a
    frame, so that Fiji's time axis is wrong if frame times are uneven (`unevenness_s`).

    Raises: InputError for more than 4 GiB, the limit of ImageJ's TIFF.
    """
    size = 2 * diagram.size
    if size > IMAGEJ_BYTES:
        raise InputError(
            path, "at most 4 GiB, what Fiji's TIFF holds", f"{size >> 20} MiB", "take a part of it (`time_s`)"
        )
    low, step = _levels(diagram)
    facts = _calibration(diagram, pixel_size_um)
    facts["metadata"] |= {"cf": 0, "c0": low - step, "c1": step, "vunit": "grey level"}
    facts["metadata"] |= _display(diagram, low, step)
    with _open_tif(path, diagram.shape, np.dtype(np.uint16), imagej=True, **facts) as file:
        for part in row_parts(len(diagram), ROWS):
            rows = np.asarray(diagram[part].values, np.float64)
            grey = np.clip(np.rint((rows - low) / step) + 1, 1, 65535)
            file.write(np.where(np.isfinite(rows), grey, 0).astype(np.uint16).data)


def _open_tif(path: Path, shape: tuple[int, ...], dtype: np.dtype[Any], **form: Any) -> BinaryIO:
    """Make a TIFF of one picture, and return it open where its rows are to be written, from the first on."""
    place = tifffile.imwrite(path, shape=shape, dtype=dtype, returnoffset=True, **form)
    assert place is not None
    file = path.open("r+b")
    file.seek(place[0])
    return file


def frame_step_s(times_s: Floats) -> float:
    """Return the mean time between frames without gaps, s; 1 without a clock.

    The median would be wrong by up to half a millisecond for times rounded to whole milliseconds.
    """
    steps = np.diff(times_s[np.isfinite(times_s)])
    median = float(np.median(steps)) if len(steps) else 0.0
    if median <= 0:
        return 1.0
    return float(steps[np.abs(steps - median) <= median / 2].mean())


def unevenness_s(times_s: Floats) -> float:
    """Return the largest error of an even time axis from the first frame, s; 0 if below half a frame."""
    known = np.flatnonzero(np.isfinite(times_s))
    if known.size < 2:
        return 0.0
    step = frame_step_s(times_s)
    even = times_s[known[0]] + step * (known - known[0])
    off = float(np.abs(times_s[known] - even).max())
    return off if off > step / 2 else 0.0


def _calibration(strip: xr.DataArray, pixel_size_um: float | None) -> dict[str, Any]:
    """Return the size of a pixel and the origin as `tifffile` writes them for ImageJ."""
    times = np.asarray(strip["time_s"].values, np.float64)
    step_s = frame_step_s(times)
    first_s = float(times[0]) if np.isfinite(times[:1]).all() else float(strip["frame"].values[0])
    return {
        "resolution": (1.0 if pixel_size_um is None else 1.0 / pixel_size_um, 1.0 / step_s),
        "metadata": {
            "axes": "YX",
            "unit": "pixel" if pixel_size_um is None else "micron",
            "yunit": "sec" if np.isfinite(times).any() else "frame",
            "xorigin": -float(strip["x"].values[0]),
            "yorigin": -first_s / step_s,
        },
    }


def _levels(diagram: xr.DataArray) -> tuple[float, float]:
    """Return the grey level of the pixel value 1, and grey levels per pixel value."""
    bits = int(diagram.attrs.get("depth_bits", 32))
    if bits <= 16:
        low, high = 0.0, float((1 << bits) - 1)
    else:
        known = diagram.values[np.isfinite(diagram.values)]
        low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
    return low, (high - low) / 65534 or 1.0


def _display(diagram: xr.DataArray, low: float, step: float) -> dict[str, float]:
    """Return the range of pixel values that Fiji displays at first (`grey_limits`)."""
    sample = diagram.values[:: max(1, len(diagram) // 4096)]
    if not np.isfinite(sample).any():
        return {}
    dark, bright = grey_limits(sample)
    return {"min": (dark - low) / step + 1, "max": (bright - low) / step + 1}


def stored_kymograph(path: Path) -> tuple[int, np.dtype[Any], tuple[int, int]]:
    """Return the byte at which the values of a space-time diagram begin, their type and shape (frame, x).

    Callers read the file in parts rather than mapping it, as a mapped file that becomes shorter kills the
    process.

    Raises: InputError for a damaged file.
    """
    wanted = "a space-time diagram as track writes it"
    check_regular(path, wanted)
    check_tiff(path)
    with reading(path, wanted, AGAIN):
        with tifffile.TiffFile(path) as tif:
            page = tif.pages.first
            shape, dtype, start = page.shape, page.dtype, page.dataoffsets[0]
            plain = page.is_contiguous and dtype is not None and dtype.newbyteorder("=") == np.float32
            order = tif.byteorder
        sizes = [size for size in shape if isinstance(size, int) and size > 0]  # a damaged one is a tuple
        if len(sizes) != 2 or len(shape) != 2 or not plain:
            raise InputError(path, wanted, f"{dtype} of shape {shortened(str(shape), 40)}", AGAIN)
        return start, np.dtype(np.float32).newbyteorder(order), (shape[0], shape[1])


def read_kymograph_tif(path: Path, frames: int) -> Floats32:
    """Read a space-time diagram, (frames, x).  Raises: InputError."""
    start, stored, shape = stored_kymograph(path)
    if shape[0] != frames:
        raise InputError(path, f"{frames} rows, one per frame of tracks.nc", f"shape {shape}", AGAIN)
    rows = FrameStore(shape[1], expected=frames)
    with reading(path, "a space-time diagram as track writes it", AGAIN), path.open("rb") as file:
        file.seek(start)
        for some in row_parts(frames, ROWS):
            part = np.empty((some.stop - some.start, shape[1]), stored)
            read_fully(file, part.data.cast("B"), path)
            rows.append(part.astype(np.float32, copy=False))
    return rows.rows()
