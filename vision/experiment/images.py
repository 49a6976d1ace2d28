"""From light to grey levels: the sensor, the frames of the video, and I(x, t) of the strip drawn directly.

A pixel that collects e electrons has the variance e + read² (photons and read-out); the mean of n rows has an
n-th of that. Grey level = black level + e / gain, rounded and clipped.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict

import numpy as np
import xarray as xr
from scipy.sparse import coo_array, csr_array

from vision.data import STRIP, StripMetadata, record
from vision.experiment.mechanics import random_stream
from vision.experiment.scene import Scene, make_scene, strip_slice, truth_of
from vision.experiment.settings import Camera, Experiment
from vision.numeric import Floats, Floats32, Ints, Pixels

Progress = Callable[[int, int | None], None]

# --- sensor -------------------------------------------------------------------------------------------------


def saturation_level(camera: Camera) -> int:
    """Return the highest grey level."""
    return int(2**camera.bits - 1)


def electrons_per_level(camera: Camera) -> float:
    """Return the gain in electrons per grey level: the full well over the levels above black."""
    return camera.full_well_e / (saturation_level(camera) - camera.black_level)


def grey_levels(light: Floats32, camera: Camera, rng: np.random.Generator) -> Pixels:
    """Convert light (fraction of saturation) to noisy, rounded and clipped grey levels."""
    electrons = light * np.float32(camera.full_well_e)
    if camera.noise:
        # With thousands of electrons per pixel, normal deviates agree with Poisson deviates to 1e-3.
        spread = np.sqrt(np.maximum(electrons, 0) + np.float32(camera.read_noise_e**2))
        electrons += spread * rng.standard_normal(light.shape, dtype=np.float32)
    np.minimum(electrons, np.float32(camera.full_well_e), out=electrons)
    electrons *= np.float32(1 / electrons_per_level(camera))
    electrons += np.float32(camera.black_level + 0.5)
    np.clip(electrons, 0, saturation_level(camera), out=electrons)
    return electrons.astype(np.uint8 if camera.bits == 8 else np.uint16)


def mean_of_rows(light: Floats, camera: Camera, rows: int, rng: np.random.Generator) -> Floats32:
    """Return the mean grey level of `rows` pixels, with the same mean and variance as if each were drawn."""
    electrons = light * camera.full_well_e
    gain = electrons_per_level(camera)
    if camera.noise:
        one = np.maximum(electrons, 0) + camera.read_noise_e**2 + gain**2 / 12  # + rounding
        electrons = electrons + np.sqrt(one / rows) * rng.standard_normal(light.shape, dtype=np.float32)
    levels = camera.black_level + np.minimum(electrons, camera.full_well_e) / gain
    return np.asarray(np.clip(levels, 0, saturation_level(camera)), np.float32)


# --- frames -------------------------------------------------------------------------------------------------


def frame_blocks(scene: Scene, *, workers: int = 2) -> Iterator[Pixels]:
    """Yield all frames in order, in blocks (frame, row, column) of uint8 (8 bit) or uint16.

    A block has a few million pixels; at most `workers` + 1 of them exist at a time. Every frame has its own
    stream of random numbers, so the data depend neither on the blocks nor on the threads.
    """
    camera = scene.experiment.camera
    total = len(scene.times.camera_s)
    step = int(np.clip(4_000_000 // (camera.width * camera.height), 1, 32))
    painter = _Painter(scene)
    waiting: deque[Future[Pixels]] = deque()
    with ThreadPoolExecutor(workers) as pool:
        for first in range(0, total, step):
            waiting.append(pool.submit(painter.block, slice(first, min(first + step, total))))
            if len(waiting) > workers:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


class _Painter:
    """Draws blocks of frames of one scene; safe to use from several threads."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        cell = _cell_of(scene, np.arange(scene.geometry.width + 1, dtype=float) - 0.5)
        self.edge_cell = np.floor(cell).astype(np.int32)
        self.edge_share = np.asarray(cell - self.edge_cell, np.float32)
        centre = _cell_of(scene, np.arange(scene.geometry.width, dtype=float))
        self.centre_cell = centre.astype(np.int32)
        self.base = self._seen(scene.base)
        # Cached properties are computed before threads start, which is not thread-safe.
        self.response = scene.response
        scene.texture(slice(0, 1))

    def block(self, frames: slice) -> Pixels:
        scene = self.scene
        light, flicker = scene.ridge_light(frames), scene.flicker(frames)
        texture = scene.texture(frames).astype(np.float32)
        owners = _owners(scene, frames)
        drawn = [
            self._frame(light[i], texture[i], owners[i], float(flicker[i]), frames.start + i)
            for i in range(frames.stop - frames.start)
        ]
        return np.stack(drawn)

    def _frame(self, light: Floats, texture: Floats32, owner: Ints, flicker: float, number: int) -> Pixels:
        """Draw one frame from the ridges' light per cell, the texture (row, sheet) and each cell's sheet."""
        ridges = self._seen(light)
        factor = np.take_along_axis(texture, owner[self.centre_cell], axis=1)
        factor += 1
        ridges *= factor
        ridges += self.base
        ridges *= self.response
        ridges *= np.float32(flicker)
        rng = random_stream(self.scene.experiment.seed, "sensor", number)
        return grey_levels(ridges, self.scene.experiment.camera, rng)

    def _seen(self, light: Floats) -> Floats32:
        """Return the light per pixel (row, column): cumulative light at its right minus left edge."""
        up_to = np.concatenate([[0.0], np.cumsum(light)])
        at_edges = up_to[self.edge_cell]
        at_edges += self.edge_share * light.astype(np.float32)[self.edge_cell]
        return np.asarray(np.diff(at_edges, axis=1), np.float32)


def _cell_of(scene: Scene, x_px: Floats) -> Floats:
    """Return the position on the line of cells, (row, column), of pixel coordinates x_px in every row."""
    line = scene.line
    at = (scene.geometry.source_px(x_px, scene.geometry.zeta_px[:, None]) - line.start_px) * line.per_px
    return np.asarray(np.clip(at, 0, line.cells - 1e-6))


def _owners(scene: Scene, frames: slice) -> Ints:
    """Return the sheet visible in each cell, (frame, cell); borders lie half way between neighbours."""
    line = scene.line
    x = scene.positions_px(frames)[0]
    borders = np.ceil(((x[:, 1:] + x[:, :-1]) / 2 - line.start_px) * line.per_px - 0.5).astype(np.int64)
    steps = np.zeros((len(x), line.cells + 1), np.int32)
    row = np.arange(len(x))[:, None]
    np.add.at(steps, (row, np.clip(borders, 0, line.cells)), 1)
    return np.cumsum(steps[:, :-1], axis=1, dtype=np.int64)


# --- I(x, t) ------------------------------------------------------------------------------------------------


def profiles(experiment: Experiment) -> tuple[xr.DataArray, xr.Dataset]:
    """Draw I(x, t) of the default strip directly: a thousand frames in a second or two.

    Parameters
    ----------
    experiment
        The experiment.

    Returns
    -------
    strip : DataArray
        intensity (frame, x), float32 grey levels, as `strip_profile` gives it for this experiment's video.
    truth : Dataset
        As in truth.nc, see `truth_of`.

    Notes
    -----
    Rows are averaged before noise is added, so the noise is that of the mean. Structure along the rows
    (shapes of dust, texture inside a bowed ridge) is averaged as well.
    """
    scene = make_scene(experiment)
    total, width = len(scene.times.camera_s), experiment.camera.width
    intensity = np.empty((total, width), np.float32)
    average = _row_average(scene)
    for first in range(0, total, 32):
        frames = slice(first, min(first + 32, total))
        intensity[frames] = _strip_block(scene, average, frames)
    return _as_strip(intensity, scene), truth_of(scene)


def _strip_block(scene: Scene, average: csr_array, frames: slice) -> Floats32:
    """Return I(x, t) of some frames."""
    experiment, rows = scene.experiment, strip_slice(scene.experiment)
    texture = np.asarray(1 + scene.texture(frames)[:, rows].mean(axis=1))
    light = scene.base + scene.ridge_light(frames, texture)
    up_to = np.cumsum(light, axis=1)
    seen = (average @ np.pad(up_to, ((0, 0), (1, 0))).T).T
    seen *= scene.response[rows].mean(axis=0) * scene.flicker(frames)[:, None]
    rng = random_stream(experiment.seed, "profile noise", frames.start)
    return mean_of_rows(seen, experiment.camera, rows.stop - rows.start, rng)


def _row_average(scene: Scene) -> csr_array:
    """Return the matrix (column, cell edge) that maps cumulative light at cell edges to the strip mean.

    The light of a pixel is the cumulative light at its right edge minus that at its left edge, interpolated
    between cell edges in each row. Rows are weighted with their light.
    """
    line, rows = scene.line, strip_slice(scene.experiment)
    weight = scene.row_light[rows]
    zeta = scene.geometry.zeta_px[rows][:, None]
    edges = scene.geometry.source_px(np.arange(scene.geometry.width + 1, dtype=float) - 0.5, zeta)
    at = np.clip((edges - line.start_px) * line.per_px, 0, line.cells - 1e-9)
    cell = np.floor(at).astype(np.int64)
    share, w = at - cell, np.broadcast_to((weight / weight.sum())[:, None], at.shape)
    edge = np.broadcast_to(np.arange(edges.shape[1]), at.shape)
    values = np.concatenate([(w * (1 - share)).ravel(), (w * share).ravel()])
    where = np.tile(edge.ravel(), 2), np.concatenate([cell.ravel(), cell.ravel() + 1])
    reading = coo_array((values, where), shape=(edges.shape[1], line.cells + 1)).tocsr()
    return csr_array(reading[1:] - reading[:-1])


def _as_strip(intensity: Floats32, scene: Scene) -> xr.DataArray:
    """Return the strip with the coordinates and metadata that `strip_profile` gives it."""
    experiment, rows, kept = scene.experiment, strip_slice(scene.experiment), len(intensity)
    strip = xr.DataArray(
        intensity,
        dims=("frame", "x"),
        coords={
            "frame": np.arange(kept, dtype=np.int64),
            "x": np.arange(intensity.shape[1], dtype=np.int64),
            "time_s": ("frame", scene.times.stamp_s, STRIP["time_s"].attrs),
            "status": ("frame", np.full(kept, "ok")),
        },
        name="intensity",
        attrs=STRIP["intensity"].attrs,
    )
    metadata = StripMetadata(
        source="synthetic",
        depth_bits=experiment.camera.bits,
        saturation_level=float(saturation_level(experiment.camera)),
        strip_z0=rows.start,
        strip_z1=rows.stop,
        tilt_deg=experiment.optics.tilt_deg,
        clock_kind="given",
        fps=float(experiment.camera.fps),
        frames_expected=kept,
        frames_read=kept,
    )
    return record(strip.assign_attrs(metadata.attrs()), "profiles", **asdict(experiment))
