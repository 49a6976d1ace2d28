"""kymograph.tif: I(x, t) as Fiji reads it, µm and s per pixel."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import xarray as xr

IMAGEJ_BYTES = (1 << 32) - (1 << 20)  # ImageJ's own TIFF ends at 4 GiB


def write_kymograph_tif(strip: xr.DataArray, path: Path, *, pixel_size_um: float | None) -> None:
    """Rows are frames, columns x; 32-bit floats in grey levels, NaN for frames that are not there.

    ImageJ metadata hold the size of a pixel: µm (or "pixel") along x and seconds along t; above 4 GiB a
    plain BigTIFF without them.
    """
    import tifffile

    values = np.asarray(strip.values, np.float32)
    if values.nbytes > IMAGEJ_BYTES:
        tifffile.imwrite(path, values, bigtiff=True)
        return
    step_s = median_step_s(strip["time_s"].values)
    unit = "pixel" if pixel_size_um is None else "micron"
    per_x = 1.0 if pixel_size_um is None else 1.0 / pixel_size_um
    tifffile.imwrite(
        path,
        values,
        imagej=True,
        resolution=(per_x, 1.0 / step_s),
        metadata={"axes": "YX", "unit": unit, "yunit": "sec"},
    )


def median_step_s(times_s: np.ndarray) -> float:
    """Time from one frame to the next, s; 1 where the recording does not say."""
    steps = np.diff(times_s[np.isfinite(times_s)])
    step = float(np.median(steps)) if len(steps) else 0.0
    return step if step > 0 else 1.0
