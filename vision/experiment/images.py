"""The frames themselves, in blocks: ridges seen through the geometry, texture, light, sensor."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vision.experiment.camera import grey_levels
from vision.experiment.geometry import rows_from_middle
from vision.experiment.randomness import stream
from vision.experiment.surface import Surface

if TYPE_CHECKING:
    from vision.experiment.scene import Scene

Array = NDArray[np.float64]
Pixels = NDArray[Any]

_PIXELS_PER_BLOCK = 4_000_000
"""Bounds the memory of a block, whatever the frame's size."""


@dataclass(frozen=True, kw_only=True)
class _Lookup:
    """Fixed in time: the cell and the place within it of every pixel edge, and the cell of every pixel's
    centre."""

    cell: NDArray[np.int32]
    share: NDArray[np.float32]
    centre: NDArray[np.int32]


def frame_blocks(scene: Scene, *, workers: int = 2) -> Iterator[Pixels]:
    """All frames in order, as blocks (frame, row, column) of uint8 (8 bit) or uint16.

    A block holds a few million pixels; at most `workers` + 1 of them exist at once. Every frame draws
    its noise from its own stream, so neither blocks nor threads change the data.
    """
    camera = scene.experiment.camera
    total = len(scene.times.camera_s)
    step = int(np.clip(_PIXELS_PER_BLOCK // (camera.width * camera.height), 1, 32))
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
        self.surface = Surface(scene)
        self.lookup = _lookup(scene)
        self.base = self._seen(scene.base)
        # Made before threads start, so that none finds them half done.
        self.response = self.surface.response
        self.surface.texture(slice(0, 1))
        scene.sway_px(slice(0, 1))

    def block(self, frames: slice) -> Pixels:
        scene = self.scene
        light, flicker = scene.ridge_light(frames), scene.flicker(frames)
        texture = self.surface.texture(frames).astype(np.float32)
        owners = _owners(scene, frames)
        drawn = [
            self._frame(light[i], texture[i], owners[i], float(flicker[i]), frames.start + i)
            for i in range(frames.stop - frames.start)
        ]
        return np.stack(drawn)

    def _frame(
        self,
        light: Array,
        texture: NDArray[np.float32],
        owner: NDArray[np.int32],
        flicker: float,
        number: int,
    ) -> Pixels:
        ridges = self._seen(light)
        factor = np.take_along_axis(texture, owner[self.lookup.centre], axis=1)
        factor += 1
        ridges *= factor
        ridges += self.base
        ridges *= self.response
        ridges *= np.float32(flicker)
        rng = stream(self.scene.experiment.seed, "sensor", number)
        return grey_levels(ridges, self.scene.experiment.camera, rng)

    def _seen(self, light: Array) -> NDArray[np.float32]:
        """Light per pixel (row, column): light up to its right edge less that up to its left one."""
        up_to = np.concatenate([[0.0], np.cumsum(light)])
        at_edges = up_to[self.lookup.cell]
        at_edges += self.lookup.share * light.astype(np.float32)[self.lookup.cell]
        return np.asarray(np.diff(at_edges, axis=1), np.float32)


def _lookup(scene: Scene) -> _Lookup:
    line, geometry = scene.line, scene.geometry
    zeta = rows_from_middle(geometry.height)[:, None]

    def place(x_px: Array) -> Array:
        at = (geometry.source_px(x_px, zeta) - line.start_px) * line.per_px
        return np.asarray(np.clip(at, 0, line.cells - 1e-6))

    edges = place(np.arange(geometry.width + 1, dtype=float) - 0.5)
    centres = place(np.arange(geometry.width, dtype=float))
    cell = np.floor(edges).astype(np.int32)
    return _Lookup(cell=cell, share=np.asarray(edges - cell, np.float32), centre=centres.astype(np.int32))


def _owners(scene: Scene, frames: slice) -> NDArray[np.int32]:
    """Which sheet's paper is seen in each cell, (frame, cell): borders half way between neighbours."""
    line = scene.line
    x = scene.positions_px(frames)[0]
    borders = np.ceil(((x[:, 1:] + x[:, :-1]) / 2 - line.start_px) * line.per_px - 0.5).astype(np.int64)
    steps = np.zeros((len(x), line.cells + 1), np.int32)
    row = np.arange(len(x))[:, None]
    np.add.at(steps, (row, np.clip(borders, 0, line.cells)), 1)
    return np.asarray(np.cumsum(steps[:, :-1], axis=1), np.int32)
