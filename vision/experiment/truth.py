"""What is known about a synthetic test: `truth.nc`."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from vision.experiment.mechanics import camera_time
from vision.experiment.scene import Scene, strip_slice

_MEANING = {
    "x_px": (
        "px",
        "true position: mean over the exposure and over the default strip's rows, centroid of the ridge",
    ),
    "visible": ("1", "1 where the ridge lies wholly inside the frame"),
    "time_s": ("s", "camera clock at mid-exposure"),
    "stamp_s": ("s", "time stamp the camera wrote; stale stamps repeat the one before"),
    "time_force_s": ("s", "force clock at mid-exposure"),
    "exposed": ("1", "number of the frame as exposed, lost frames counted"),
    "d_mm": ("mm", "separation at mid-exposure"),
    "t_v_video_s": ("s", "start of the stick on the camera clock"),
    "t_p_video_s": ("s", "end of the stick on the camera clock"),
    "slip_s": ("s", "start of every slip on the force clock; slip 0 ends the initial loading"),
    "slip_video_s": ("s", "start of every slip on the camera clock"),
    "slip_delay_s": ("s", "how much later than the slip each sheet jumps"),
    "sigma_x_um": ("um", "RMS displacement over the stick"),
    "sweep_um": ("um", "inward motion over the stick"),
    "ratio": ("1", "sigma_x over the stick length"),
    "shell": ("1", "1 where the ratio is below the stiff threshold"),
    "fwhm_px": ("px", "full width of each ridge at half height"),
    "height": ("1", "height of each ridge over the gaps, in units of saturation"),
}


def truth_of(scene: Scene) -> xr.Dataset:
    """Everything known about a synthetic test.

    Parameters
    ----------
    scene
        From `make_scene`.

    Returns
    -------
    Dataset
        Dimensions frame, sheet, event and slip. Events have the columns of `events.csv` (force clock) and
        M_eff, without the initial loading. Attributes: every setting as JSON, the rows of the default strip,
        the clocks, the axis.
    """
    data = {**_of_frames(scene), **_of_events(scene), **_of_sheets(scene)}
    dataset = xr.Dataset(data, coords={"sheet": np.arange(len(scene.comb.n))})
    for name, (units, meaning) in _MEANING.items():
        dataset[name].attrs |= {"units": units, "long_name": meaning}
    dataset["shell"].attrs |= {"flag_values": np.array([0, 1], np.int8), "flag_meanings": "mobile stiff"}
    dataset.attrs |= _facts(scene)
    return dataset


def _of_frames(scene: Scene) -> dict[str, Any]:
    """Positions and times of every frame."""
    times = scene.times
    x = scene.seen_px(slice(None))
    reach = scene.ridges.fwhm_px
    inside = (x > reach - 0.5) & (x < scene.experiment.camera.width - 0.5 - reach)
    return {
        "x_px": (("frame", "sheet"), x),
        "visible": (("frame", "sheet"), inside.astype(np.int8)),
        "time_s": ("frame", times.camera_s),
        "stamp_s": ("frame", times.stamp_s),
        "time_force_s": ("frame", times.machine_s),
        "exposed": ("frame", times.exposed),
        "d_mm": ("frame", scene.pull.separation_mm(times.machine_s)),
    }


def _of_events(scene: Scene) -> dict[str, Any]:
    """Events and slips on both clocks, and the deformation of every sheet."""
    pull, e = scene.pull, scene.experiment
    events = pull.events()
    keep = np.flatnonzero(pull.complete)[1:]
    ratio = scene.motion.ratio[keep]
    sweep = scene.motion.sweep_px[keep] * e.camera.pixel_size_um
    slips = np.flatnonzero(pull.complete)
    following = np.minimum(slips + 1, len(pull.start_s) - 1)
    both = ("event", "sheet")
    table = {str(name): ("event", events[name].to_numpy()) for name in events.columns}
    return table | {
        "t_v_video_s": ("event", camera_time(events["t_v_s"].to_numpy(), e)),
        "t_p_video_s": ("event", camera_time(events["t_p_s"].to_numpy(), e)),
        "slip_s": ("slip", pull.slip_s),
        "slip_video_s": ("slip", camera_time(pull.slip_s, e)),
        "slip_delay_s": (("slip", "sheet"), scene.motion.delay_s[following]),
        "sigma_x_um": (both, ratio * events["stick_length_um"].to_numpy()[:, np.newaxis]),
        "sweep_um": (both, sweep),
        "ratio": (both, ratio),
        "shell": (both, (ratio < e.sheets.stiff_ratio).astype(np.int8)),
    }


def _of_sheets(scene: Scene) -> dict[str, Any]:
    """Place and appearance of every sheet."""
    comb, ridges = scene.comb, scene.ridges
    return {
        "side": ("sheet", comb.side),
        "n": ("sheet", comb.n),
        "fwhm_px": ("sheet", ridges.fwhm_px),
        "height": ("sheet", ridges.height),
    }


def _facts(scene: Scene) -> dict[str, Any]:
    """Settings and what is one number for the whole test."""
    e, rows = scene.experiment, strip_slice(scene.experiment)
    return {
        "settings": json.dumps(asdict(e)),
        "seed": e.seed,
        "strip_z0": rows.start,
        "strip_z1": rows.stop,
        "axis_px": scene.comb.axis_px,
        "offset_s": e.clocks.offset_s,
        "drift_ppm": e.clocks.drift_ppm,
        "pixel_size_um": e.camera.pixel_size_um,
        "fps": e.camera.fps,
        "frames_lost": scene.times.lost,
        "first_slip_s": float(scene.pull.end_s[0]),
        "positions": "pixel centres at integers",
    }


def save_truth(truth: xr.Dataset, path: Path) -> None:
    """Write the truth as compressed netCDF-4."""
    packed = {name: {"zlib": True, "shuffle": True} for name in truth.data_vars}
    truth.to_netcdf(path, engine="h5netcdf", encoding=packed)
