"""What lies on the sheets and on the lens: paper texture that travels with its sheet, light, dust, pixel
response."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vision.experiment.geometry import column_light, row_light, strip_slice
from vision.experiment.randomness import stream

if TYPE_CHECKING:
    from vision.experiment.scene import Scene

Array = NDArray[np.float64]

_DUST_DARKENS = 0.25


@dataclass(frozen=True)
class Surface:
    """Patterns of one scene. Every second sheet belongs to the block that the machine pulls along z."""

    scene: Scene

    @cached_property
    def _pattern(self) -> Array:
        """Relative brightness along each sheet, (row, sheet), long enough for the whole video."""
        from scipy.ndimage import gaussian_filter1d

        e = self.scene.experiment
        travel = int(np.ceil(self._travel_px(slice(None)).max())) + 2
        noise = stream(e.seed, "texture").standard_normal((e.camera.height + travel, e.sheets.count))
        smooth = gaussian_filter1d(noise, e.optics.texture_px / 2.355, axis=0, mode="wrap")
        smooth /= smooth.std() or 1.0
        return np.asarray(e.optics.texture * np.clip(smooth, -3, 3))

    def _travel_px(self, frames: slice) -> Array:
        """How far the pulled block has moved along z since the first frame."""
        scene = self.scene
        d = scene.pull.separation_mm(scene.times.machine_s)
        return np.asarray((d - d[0])[frames] * 1000 / scene.experiment.camera.pixel_size_um)

    def texture(self, frames: slice) -> Array:
        """Relative brightness (frame, row, sheet) of each ridge along z, mean zero."""
        rows = np.arange(self.scene.experiment.camera.height)
        travel = self._travel_px(frames)
        whole = np.floor(travel).astype(np.int64)
        share = (travel - whole)[:, None, None]
        pulled, at = self._pattern[:, 0::2], whole[:, None] + rows
        texture = np.empty((len(travel), len(rows), self._pattern.shape[1]))
        texture[:, :, 0::2] = (1 - share) * pulled[at] + share * pulled[at + 1]
        texture[:, :, 1::2] = self._pattern[None, : len(rows), 1::2]
        return texture

    @cached_property
    def response(self) -> NDArray[np.float32]:
        """Light gradient, dust and pixel response, (row, column), 1 on average."""
        e = self.scene.experiment
        camera = e.camera
        light = row_light(e)[:, None] * column_light(e)
        light *= 1 + camera.prnu * stream(e.seed, "prnu").standard_normal(light.shape)
        return np.asarray(light * self._dust(), np.float32)

    def _dust(self) -> Array:
        """Transmission of the dust on the lens: round dark spots that stay where they are."""
        e = self.scene.experiment
        rng = stream(e.seed, "dust")
        x, z = rng.uniform(0, e.camera.width, e.optics.dust), rng.uniform(0, e.camera.height, e.optics.dust)
        size = rng.uniform(1.5, 5, e.optics.dust)
        across = np.exp(-((np.arange(e.camera.width) - x[:, None]) ** 2) / (2 * size[:, None] ** 2))
        along = np.exp(-((np.arange(e.camera.height) - z[:, None]) ** 2) / (2 * size[:, None] ** 2))
        return np.asarray(1 - np.minimum(_DUST_DARKENS * along.T @ across, 0.9))

    def strip_texture(self, frames: slice) -> Array:
        """Factor (frame, sheet) on a ridge's height in the mean over the default strip's rows."""
        rows = strip_slice(self.scene.experiment)
        return np.asarray(1 + self.texture(frames)[:, rows].mean(axis=1))
