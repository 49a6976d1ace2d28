"""The camera's clock as the testing machine wrote it down beside its own."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vision.force.noise import MAD_TO_SIGMA

if TYPE_CHECKING:
    import xarray as xr

_LEAST_VALUES = 10
_ROUNDS = 10
_FAR = 5.0
_MOST_DRIFT = 0.02


def clock_from_column(force: xr.Dataset) -> tuple[float, float] | None:
    """(offset_s, drift_ppm) of the line through the column "Video Time"; None without a usable one.

    A value is written until the next frame arrives: only the first sample of each counts.  Values far off
    the line (5 σ) are left out.  Not usable is a column with under ten different values, or whose seconds
    differ from the machine's by over 2 %: then it is no clock of the recording.
    """
    if "video_time_s" not in force:
        return None
    video, machine = _fresh(force["video_time_s"].to_numpy(), force["time_s"].to_numpy())
    if len(video) < _LEAST_VALUES:
        return None
    centre = float(np.median(video))
    slope, middle = _line(video - centre, machine)
    if abs(slope - 1) > _MOST_DRIFT:
        return None
    return middle - slope * centre, 1e6 * (slope - 1)


def _fresh(
    video: NDArray[np.float64], machine: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    known = np.isfinite(video) & np.isfinite(machine)
    video, machine = video[known], machine[known]
    new = np.flatnonzero(np.diff(video) > 0) + 1
    return video[new], machine[new]


def _line(x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[float, float]:
    """Slope and intercept, outliers left out; the start is the median of slopes across half the data."""
    half = len(x) // 2
    rise, run = y[-half:] - y[:half], x[-half:] - x[:half]
    slope = float(np.median(rise[run > 0] / run[run > 0])) if np.any(run > 0) else float("nan")
    intercept = float(np.median(y - slope * x))
    for _ in range(_ROUNDS):
        away = np.abs(y - intercept - slope * x)
        near = away <= _FAR * max(MAD_TO_SIGMA * float(np.median(away)), 1e-6)
        if not np.ptp(x[near]) > 0:
            break
        slope, intercept = (float(c) for c in np.polyfit(x[near], y[near], 1))
    return slope, intercept
