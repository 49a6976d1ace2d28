"""The Dataset that `horizontal_deformation` returns."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vision.deformation.amplitude import Amplitude
from vision.deformation.frames import Doubles, Ints

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

_SURE = 3.0  # standard errors beyond which an outward movement is believed
_PLACES = ("t_v_s", "t_p_s", "d_v_mm", "d_p_mm")
_ABOUT = {
    "sigma_x_um": ("um", "RMS displacement over the usable frames of the stick, as measured"),
    "sigma_x_corrected_um": ("um", "RMS displacement over the whole stick without noise and camera movement"),
    "sigma_x_err_um": ("um", "standard error of sigma_x_corrected_um"),
    "sweep_um": ("um", "inward movement over the whole stick, fitted line, camera movement taken off"),
    "ratio": ("1", "sigma_x_corrected_um over stick_length_um"),
    "ratio_err": ("1", "standard error of ratio"),
    "ratio_signed": ("1", "ratio before negative values are set to 0; positive inwards"),
    "frames": ("1", "positions used"),
    "x_hat_px": ("px", "mean position over the stick"),
    "flag": ("", "ok, or what is the matter"),
    "stick_length_um": ("um", "stick length"),
    "frames_left_out": ("1", "frames of the stick left out because a slip may lie in their exposure"),
    "effective_frames": ("1", "independent frames that would give the same error of the sweep"),
    "drift_um": ("um", "movement of the camera during the stick, to the right, taken off"),
    "noise_um": ("um", "standard deviation of single positions, from the residuals to the creep"),
}


def as_dataset(
    tracks: xr.Dataset, events: pd.DataFrame, found: Amplitude, *, pixel_size_um: float, left_out: Ints
) -> xr.Dataset:
    """Amplitudes in um and over the stick lengths, with flags; negative ones become 0 unless they are sure.

    tracks, events: the sheets and sticks that `found` is about.  left_out: frames, (event,).
    """
    import xarray as xr

    each = {
        "stick_length_um": _length(events)[:, 0],
        "frames_left_out": left_out,
        "effective_frames": found.effective_frames,
        "drift_um": found.drift_px * pixel_size_um,
    }
    coords: dict[str, Any] = {"event": events["event"].to_numpy(), "sheet": tracks["sheet"].values}
    coords |= {name: ("event", events[name].to_numpy(float)) for name in _PLACES if name in events}
    coords |= {name: ("sheet", tracks[name].values) for name in ("side", "n")}
    data = _of_sheets(events, found, pixel_size_um)
    parts: dict[str, Any] = {name: (("event", "sheet"), value, _about(name)) for name, value in data.items()}
    parts |= {name: ("event", value, _about(name)) for name, value in each.items()}
    parts["noise_um"] = ("sheet", found.noise_px * pixel_size_um, _about("noise_um"))
    source = str(tracks.attrs.get("source", ""))
    return xr.Dataset(parts, coords, {"source": source, "pixel_size_um": pixel_size_um})


def _of_sheets(
    events: pd.DataFrame, found: Amplitude, pixel_size_um: float
) -> dict[str, NDArray[np.generic]]:
    length = _length(events)
    signed, error = found.signed_px * pixel_size_um, found.error_px * pixel_size_um
    outward = signed < -_SURE * error
    size = np.where(outward, -signed, np.maximum(signed, 0))
    ratio = size / length
    conditions = {
        "few": ~found.good,
        "no_length": np.broadcast_to(np.isnan(length), found.good.shape),
        "outward": outward,
        "uneven": found.uneven,
        "below_noise": signed < 0,
    }
    return {
        "sigma_x_um": found.raw_px * pixel_size_um,
        "sigma_x_corrected_um": size,
        "sigma_x_err_um": error,
        "sweep_um": found.sweep_px * pixel_size_um,
        "ratio": ratio,
        "ratio_err": np.hypot(error / length, ratio * _length_error(events) / length),
        "ratio_signed": signed / length,
        "frames": found.count,
        "x_hat_px": found.middle_px,
        "flag": np.select(list(conditions.values()), list(conditions), default="ok"),
    }


def _length(events: pd.DataFrame) -> Doubles:
    """Stick lengths, um, (event, 1); NaN where there is none."""
    length = events["stick_length_um"].to_numpy(float)[:, None]
    return np.where(length > 0, length, np.nan)


def _length_error(events: pd.DataFrame) -> Doubles:
    """Errors of the stick lengths, um, (event, 1); 0 where they are not known."""
    if "stick_length_err_um" not in events:
        return np.zeros((len(events), 1))
    return np.asarray(np.nan_to_num(events["stick_length_err_um"].to_numpy(float))[:, None])


def _about(name: str) -> dict[str, str]:
    units, long_name = _ABOUT[name]
    return {"long_name": long_name} | ({"units": units} if units else {})
