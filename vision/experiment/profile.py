"""I(x, t) of the strip drawn directly, without its images: a thousand frames in a second or two."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vision.experiment.camera import mean_of_rows, saturation_level
from vision.experiment.geometry import row_light, rows_from_middle, strip_slice
from vision.experiment.randomness import stream
from vision.experiment.scene import Scene, make_scene
from vision.experiment.surface import Surface
from vision.experiment.truth import truth_of

if TYPE_CHECKING:
    import scipy.sparse
    import xarray as xr

    from vision.experiment.settings import Experiment

Array = NDArray[np.float64]
Progress = Callable[[int, int | None], None]

_BLOCK = 32


def profiles(experiment: Experiment, *, progress: Progress | None = None) -> tuple[xr.DataArray, xr.Dataset]:
    """I(x, t) as `strip_profile` gives it for this experiment's video, and the truth behind it.

    Rows of the default strip are averaged before noise is added, so the noise is that of the mean; what a row
    average cannot show (dust shapes, texture inside a ridge's bow) is averaged too. progress is called with
    (frames done, frames in all). Returns intensity (frame, x), float32 grey levels, and the truth Dataset.
    """
    scene = make_scene(experiment)
    total, width = len(scene.times.camera_s), experiment.camera.width
    intensity = np.empty((total, width), np.float32)
    average, surface = _row_average(scene), Surface(scene)
    for first in range(0, total, _BLOCK):
        frames = slice(first, min(first + _BLOCK, total))
        intensity[frames] = _block(scene, surface, average, frames)
        if progress is not None:
            progress(frames.stop, total)
    return _as_strip_profile(intensity, scene), truth_of(scene)


def _block(
    scene: Scene, surface: Surface, average: scipy.sparse.csr_array, frames: slice
) -> NDArray[np.float32]:
    experiment, rows = scene.experiment, strip_slice(scene.experiment)
    light = scene.base + scene.ridge_light(frames, surface.strip_texture(frames))
    up_to = np.cumsum(light, axis=1)
    seen = (average @ np.pad(up_to, ((0, 0), (1, 0))).T).T
    seen *= surface.response[rows].mean(axis=0) * scene.flicker(frames)[:, None]
    rng = stream(experiment.seed, "profile noise", frames.start)
    return mean_of_rows(seen, experiment.camera, rows.stop - rows.start, rng)


def _row_average(scene: Scene) -> scipy.sparse.csr_array:
    """The matrix (column, cell edge) that turns light summed up to each cell edge into the strip's row
    mean.

    Each pixel's light is that up to its right edge less that up to its left one, read between cell
    edges, row by row, rows weighted with their light.
    """
    import scipy.sparse

    line, rows = scene.line, strip_slice(scene.experiment)
    weight = row_light(scene.experiment)[rows]
    zeta = rows_from_middle(scene.geometry.height)[rows][:, None]
    edges = scene.geometry.source_px(np.arange(scene.geometry.width + 1, dtype=float) - 0.5, zeta)
    at = np.clip((edges - line.start_px) * line.per_px, 0, line.cells - 1e-9)
    cell = np.floor(at).astype(np.int64)
    share, w = at - cell, np.broadcast_to((weight / weight.sum())[:, None], at.shape)
    edge = np.broadcast_to(np.arange(edges.shape[1]), at.shape)
    values = np.concatenate([(w * (1 - share)).ravel(), (w * share).ravel()])
    where = np.tile(edge.ravel(), 2), np.concatenate([cell.ravel(), cell.ravel() + 1])
    reading = scipy.sparse.coo_array((values, where), shape=(edges.shape[1], line.cells + 1)).tocsr()
    return scipy.sparse.csr_array(reading[1:] - reading[:-1])


def _as_strip_profile(intensity: NDArray[np.float32], scene: Scene) -> xr.DataArray:
    """Coordinates and attributes as `strip_profile` writes them."""
    import xarray as xr

    times, width = scene.times, intensity.shape[1]
    coords: dict[str, Any] = {
        "frame": np.arange(len(intensity), dtype=np.int64),
        "x": np.arange(width, dtype=np.int64),
        "time_s": ("frame", times.stamp_s, {"units": "s"}),
        "status": ("frame", np.full(len(intensity), "ok")),
    }
    return xr.DataArray(
        intensity, dims=("frame", "x"), coords=coords, name="intensity", attrs=_attributes(scene)
    )


def _attributes(scene: Scene) -> dict[str, Any]:
    camera, rows = scene.experiment.camera, strip_slice(scene.experiment)
    kept = len(scene.times.camera_s)
    return {
        "units": "grey level",
        "long_name": "mean intensity of the strip",
        "source": "synthetic",
        "rotate": 0,
        "depth_bits": camera.bits,
        "saturation_level": float(saturation_level(camera)),
        "clock_kind": "given",
        "fps": float(camera.fps),
        "frames_expected": kept,
        "frames_read": kept,
        "frames_lost": 0,
        "frames_blank": 0,
        "frames_corrupt": 0,
        "warnings": "",
        "strip_z0": rows.start,
        "strip_z1": rows.stop,
        "strip_how": "given",
        "tilt_deg": scene.experiment.optics.tilt_deg,
    }
