"""Space-time diagrams as TIFF: written for Fiji with µm and s per pixel, and read back."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
import xarray as xr

from vision.errors import InputError
from vision.figures.decimate import grey_limits
from vision.files import AGAIN, check_regular, reading
from vision.numeric import Floats, Floats32
from vision.video.frames import FrameStore
from vision.video.reader import read_fully
from vision.video.stacks import check_tiff

ROWS = 4096  # written or read at once, so that memory does not grow with the recording
IMAGEJ_BYTES = (1 << 32) - (1 << 20)  # ImageJ's TIFF holds less than 4 GiB


def write_kymograph_tif(strip: xr.DataArray, path: Path, *, pixel_size_um: float | None) -> None:
    """Write I(x, t) as 32-bit grey levels: rows are frames, columns x; NaN for frames without a picture.

    ImageJ metadata hold the size of a pixel: µm (or "pixel") along x and seconds along t. Above 4 GiB the
    file is a plain BigTIFF without them.
    """
    values = np.asarray(strip.values, np.float32)
    if values.nbytes > IMAGEJ_BYTES:
        tifffile.imwrite(path, values, bigtiff=True)
        return
    tifffile.imwrite(path, values, imagej=True, **_calibration(strip, pixel_size_um))


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
    pixels = tifffile.memmap(path, shape=diagram.shape, dtype=np.uint16, imagej=True, **facts)
    if hasattr(os, "posix_fallocate"):  # writing to a mapped file on a full disk would kill the process
        with path.open("r+b") as file:
            os.posix_fallocate(file.fileno(), 0, path.stat().st_size)
    for start in range(0, len(diagram), ROWS):
        rows = np.asarray(diagram[start : start + ROWS].values, np.float64)
        grey = np.clip(np.rint((rows - low) / step) + 1, 1, 65535)
        pixels[start : start + ROWS] = np.where(np.isfinite(rows), grey, 0)
    pixels.flush()


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
        if len(shape) != 2 or not plain:
            raise InputError(path, wanted, f"{dtype} of shape {shape}", AGAIN)
        return start, np.dtype(np.float32).newbyteorder(order), (shape[0], shape[1])


def read_kymograph_tif(path: Path, frames: int) -> Floats32:
    """Read a space-time diagram, (frames, x).  Raises: InputError."""
    start, stored, shape = stored_kymograph(path)
    if shape[0] != frames:
        raise InputError(path, f"{frames} rows, one per frame of tracks.nc", f"shape {shape}", AGAIN)
    rows = FrameStore(shape[1], expected=frames)
    with (
        reading(path, "a space-time diagram as track writes it", AGAIN),
        path.open("rb", buffering=0) as file,
    ):
        file.seek(start)
        for first in range(0, frames, ROWS):
            part = np.empty((min(ROWS, frames - first), shape[1]), stored)
            read_fully(file, part.data.cast("B"), path)
            rows.append(part.astype(np.float32, copy=False))
    return rows.rows()
