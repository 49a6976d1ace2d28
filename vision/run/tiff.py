"""I(x, t) as Fiji reads it: µm and s per pixel."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
import xarray as xr

from vision.errors import InputError
from vision.figures.decimate import grey_limits
from vision.numeric import Floats

ROWS = 4096  # written at once, so that memory does not grow with the recording
IMAGEJ_BYTES = (1 << 32) - (1 << 20)  # ImageJ's own TIFF ends at 4 GiB


def write_kymograph_tif(strip: xr.DataArray, path: Path, *, pixel_size_um: float | None) -> None:
    """Rows are frames, columns x; 32-bit floats in grey levels, NaN for frames that are not there.

    ImageJ metadata hold the size of a pixel: µm (or "pixel") along x and seconds along t; above 4 GiB it is
    a plain BigTIFF without them.
    """
    values = np.asarray(strip.values, np.float32)
    if values.nbytes > IMAGEJ_BYTES:
        tifffile.imwrite(path, values, bigtiff=True)
        return
    tifffile.imwrite(path, values, imagej=True, **_calibration(strip, pixel_size_um))


def write_space_time_tif(diagram: xr.DataArray, path: Path, *, pixel_size_um: float | None) -> None:
    """Rows are frames, columns x; 16 bits, 0 where there is no picture, so 1 to 65535 are grey values.

    1 is black (0 for whole numbers, the smallest value for a float recording) and 65535 white (the camera's
    largest grey level, or the largest value). ImageJ metadata turn the numbers back into grey levels, and
    hold the size of a pixel, µm (or "pixel") along x and seconds along t, and the place of x = 0 and t = 0.
    Fiji's time axis is even: rows are frames also where the recording's times are not (`unevenness_s`).

    Raises: InputError for more than ImageJ's TIFF can hold, 4 GiB.
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
    if hasattr(os, "posix_fallocate"):  # a mapping that finds the disk full kills the process
        with path.open("r+b") as file:
            os.posix_fallocate(file.fileno(), 0, path.stat().st_size)
    for start in range(0, len(diagram), ROWS):
        rows = np.asarray(diagram[start : start + ROWS].values, np.float64)
        grey = np.clip(np.rint((rows - low) / step) + 1, 1, 65535)
        pixels[start : start + ROWS] = np.where(np.isfinite(rows), grey, 0)
    pixels.flush()


def frame_step_s(times_s: Floats) -> float:
    """Time from one frame to the next, s: the mean over all steps but gaps; 1 without a clock.

    The mean, as time stamps rounded to whole milliseconds have a median that is off by up to half of one.
    """
    steps = np.diff(times_s[np.isfinite(times_s)])
    middle = float(np.median(steps)) if len(steps) else 0.0
    if middle <= 0:
        return 1.0
    return float(steps[np.abs(steps - middle) <= middle / 2].mean())


def unevenness_s(times_s: Floats) -> float:
    """How far, at most, an even time axis through the first frame is off, s, where that is more than half a
    frame; else 0.
    """
    known = np.flatnonzero(np.isfinite(times_s))
    if known.size < 2:
        return 0.0
    step = frame_step_s(times_s)
    even = times_s[known[0]] + step * (known - known[0])
    off = float(np.abs(times_s[known] - even).max())
    return off if off > step / 2 else 0.0


def _calibration(strip: xr.DataArray, pixel_size_um: float | None) -> dict[str, Any]:
    """Size of a pixel and the place of the origin, as `tifffile` writes them for ImageJ."""
    times = np.asarray(strip["time_s"].values, np.float64)
    step_s = frame_step_s(times)
    first_s = float(times[0]) if np.isfinite(times[:1]).all() else float(strip["frame"].values[0])
    unit = "pixel" if pixel_size_um is None else "micron"
    timeless = not np.isfinite(times).any()
    return {
        "resolution": (1.0 if pixel_size_um is None else 1.0 / pixel_size_um, 1.0 / step_s),
        "metadata": {
            "axes": "YX",
            "unit": unit,
            "yunit": "frame" if timeless else "sec",
            "xorigin": -float(strip["x"].values[0]),
            "yorigin": -first_s / step_s,
        },
    }


def _levels(diagram: xr.DataArray) -> tuple[float, float]:
    """Grey level of the number 1, and grey levels per number."""
    bits = int(diagram.attrs.get("depth_bits", 32))
    if bits <= 16:
        low, high = 0.0, float((1 << bits) - 1)
    else:
        known = diagram.values[np.isfinite(diagram.values)]
        low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
    return low, (high - low) / 65534 or 1.0


def _display(diagram: xr.DataArray, low: float, step: float) -> dict[str, float]:
    """The range Fiji shows at first: all but the outermost grey values."""
    sample = diagram.values[:: max(1, len(diagram) // 4096)]
    if not np.isfinite(sample).any():
        return {}
    dark, bright = grey_limits(sample)
    return {"min": (dark - low) / step + 1, "max": (bright - low) / step + 1}
