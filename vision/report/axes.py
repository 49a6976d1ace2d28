"""What stands along an axis: times and lengths, with their units."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import xarray as xr

UM_PER_MM = 1000


def time_axis(data: xr.Dataset | xr.DataArray) -> tuple[NDArray[np.float64], str]:
    """Seconds, or frame numbers where the clock is unknown, stands still or runs backwards; and the label.

    The label says where seconds are only the file's playback rate. Single times that repeat are kept.
    """
    time = np.asarray(data["time_s"].values, np.float64)
    steps = np.diff(time)
    if not np.isfinite(time).all() or (steps < 0).any() or (steps.size and np.median(steps) <= 0):
        return np.asarray(data["frame"].values, np.float64), "frame"
    return time, "t (s, playback rate)" if data.attrs.get("clock_kind") == "playback" else "t (s)"


def displacement_unit(pixel_size_um: float | None) -> tuple[float, str]:
    """Factor from px, and unit: µm, or px where the pixel size is not known."""
    return (1.0, "px") if pixel_size_um is None else (pixel_size_um, "µm")


def position_unit(pixel_size_um: float | None, width_px: float) -> tuple[float, str]:
    """Factor from px, and unit, of a picture that is `width_px` wide: mm, or µm below 1 mm; px without a
    scale."""
    if pixel_size_um is None or pixel_size_um * width_px < UM_PER_MM:
        return displacement_unit(pixel_size_um)
    return pixel_size_um / UM_PER_MM, "mm"
