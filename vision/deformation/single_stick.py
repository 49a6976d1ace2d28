"""δx(t) of all sheets over one stick, to be drawn."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vision.errors import InputError

if TYPE_CHECKING:
    import xarray as xr

    from vision.deformation.motion import VideoClock


def stick_displacement(
    tracks: xr.Dataset, motion: xr.Dataset, clock: VideoClock, *, event: int
) -> xr.DataArray:
    """Displacement of every sheet during one stick: δx = x - x̂, um, positive to the right.

    As measured: noise, camera movement and the frames next to the slips are in it.

    Args: tracks and clock, as given to `horizontal_deformation`; motion, what it returned.  event, its
    number.
    Returns: DataArray (frame, sheet) with since_s (frame), time since t_v; NaN where there is no position.
    Raises: InputError for an event that is not in `motion`.
    """
    if event not in motion["event"]:
        known = motion["event"].values
        raise InputError(
            "event", f"one inside the video ({known[0]} to {known[-1]})", f"{event}", "take another one"
        )
    stick = motion.sel(event=event)
    since = clock.to_force_s(np.asarray(tracks["time_s"].values, float)) - float(stick["t_v_s"])
    inside = (since >= 0) & (since <= float(stick["t_p_s"] - stick["t_v_s"]))
    away: xr.DataArray = (tracks["x_px"][inside] - stick["x_hat_px"]) * motion.attrs["pixel_size_um"]
    away = away.assign_coords(since_s=("frame", since[inside], {"units": "s"}))
    return away.assign_attrs(units="um", long_name="displacement from the mean over the stick")
