"""One experiment made ready to be looked at: where everything is, at any frame, before the sensor.

Light is in fractions of the sensor's saturation.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vision.experiment.clocks import FrameTimes, frame_times
from vision.experiment.geometry import Geometry, camera_geometry, seen_px
from vision.experiment.mechanics import Pull, pull_apart
from vision.experiment.motion import Comb, Motion, comb_at_rest, sheet_motion
from vision.experiment.randomness import stream
from vision.experiment.ridges import Looks, light_per_cell, ridge_looks

if TYPE_CHECKING:
    from vision.experiment.settings import Experiment

Array = NDArray[np.float64]

_BLUR_PARTS = 24
"""A frame exposed during a jump is the mean of this many shorter exposures."""
_BLUR_FROM_PX = 0.3
"""Motion within one exposure below this changes a ridge's width by less than 0.1 % and is drawn sharp."""
_CELLS_PER_PX = 8
_EDGE_PITCHES = 1.5
"""The sample's edge, where the surroundings begin, beyond the outermost ridge at rest."""
_EDGE_SOFT_PX = 4.0


@dataclass(frozen=True, kw_only=True)
class Line:
    """Cells 1/per_px wide from start_px on."""

    start_px: float
    per_px: int
    cells: int


@dataclass(frozen=True)
class Scene:
    """Everything derived from an experiment that rendering and truth share."""

    experiment: Experiment
    pull: Pull
    comb: Comb
    motion: Motion
    looks: Looks
    geometry: Geometry
    times: FrameTimes

    @cached_property
    def _camera_sway(self) -> tuple[Array, Array, Array, float]:
        """Frequencies, phases and weights of the vibration, and the phase of the slow drift."""
        rng = stream(self.experiment.seed, "sway")
        hz, phase = rng.uniform(15, 60, 4), rng.uniform(0, 2 * np.pi, 5)
        return hz, phase[:4], rng.dirichlet(np.ones(4)), float(phase[4])

    def sway_px(self, frames: slice) -> Array:
        """Common shift of the picture in each frame: slow drift and vibration, averaged over the exposure."""
        optics, camera = self.experiment.optics, self.experiment.camera
        t = self.times.machine_s[frames]
        hz, phase, weight, slow = self._camera_sway
        waves = np.sin(2 * np.pi * hz * t[:, None] + phase) * np.sinc(hz * camera.exposure_s)
        share = (t - self.times.machine_s[0]) / camera.duration_s
        drift = optics.drift_px * (share - 0.5 + 0.2 * np.sin(2 * np.pi * share + slow))
        return np.asarray(drift + optics.vibration_px * waves @ np.sqrt(2 * weight))

    def flicker(self, frames: slice) -> Array:
        """Brightness factor of each frame: the lamp averaged over the exposure."""
        optics, camera = self.experiment.optics, self.experiment.camera
        t = self.times.machine_s[frames]
        wave = np.sin(2 * np.pi * optics.flicker_Hz * t) * np.sinc(optics.flicker_Hz * camera.exposure_s)
        return np.asarray(1 + optics.flicker * wave)

    def positions_px(self, frames: slice, *, parts: int = 1) -> Array:
        """Where the sheets are (part, frame, sheet) averaged over each of `parts` equal parts of the
        exposure."""
        exposure = self.experiment.camera.exposure_s * (1 + self.experiment.clocks.drift_ppm * 1e-6)
        t = self.times.machine_s[frames]
        edges = np.linspace(-exposure / 2, exposure / 2, parts + 1) if exposure else np.array([-5e-7, 5e-7])
        shift = (self.comb.rest_px + self.sway_px(frames)[:, None])[None]
        moved = [self.motion.mean_px(t + a, t + b) for a, b in pairwise(edges)]
        return shift + np.array(moved)

    def seen_px(self, frames: slice) -> Array:
        """True x (frame, sheet) in camera pixels, averaged over the exposure and the default strip's rows."""
        return seen_px(self.positions_px(frames)[0], self.geometry, self.experiment)

    @cached_property
    def line(self) -> Line:
        """The line of cells on which ridges are drawn: wider than the frame by what tilt and bow can
        bring in."""
        if self.geometry.straight:
            return Line(start_px=-0.5, per_px=1, cells=self.geometry.width)
        g = self.geometry
        most = abs(g.tilt) * g.height / 2 + 2.25 * abs(g.bow_px) + abs(g.distortion) * g.width
        margin = int(np.ceil(most)) + 3
        cells = (g.width + 2 * margin) * _CELLS_PER_PX
        return Line(start_px=-0.5 - margin, per_px=_CELLS_PER_PX, cells=cells)

    @cached_property
    def base(self) -> Array:
        """Light in each cell without ridges: the gaps' level, and the surroundings beyond the sample's
        edges."""
        from scipy.special import ndtr

        optics, comb, line = self.experiment.optics, self.comb, self.line
        room = _EDGE_PITCHES * self.experiment.sheets.pitch_px
        left, right = comb.rest_px.min() - room, comb.rest_px.max() + room
        if self.experiment.sheets.side != "both":  # the other half goes on beyond the axis
            left, right = (-1e6, right) if self.experiment.sheets.side == "right" else (left, 1e6)
        x = line.start_px + (np.arange(line.cells) + 0.5) / line.per_px
        sample = ndtr((x - left) / _EDGE_SOFT_PX) - ndtr((x - right) / _EDGE_SOFT_PX)
        return np.asarray(optics.level * (optics.surround + (1 - optics.surround) * sample) / line.per_px)

    def ridge_light(self, frames: slice, brightness: Array | None = None) -> Array:
        """Light of the ridges in each cell, (frame, cell), blurred by what moves while the shutter is open.

        brightness: factor (frame, sheet) on each ridge's height.
        """
        halves = self.positions_px(frames, parts=2)
        factor = np.ones(halves.shape[1:]) if brightness is None else brightness
        light = self._cells(halves.mean(axis=0), factor)
        moving = np.flatnonzero(np.abs(np.diff(halves, axis=0)[0]).max(axis=1) > _BLUR_FROM_PX / 2)
        if moving.size:
            parts = self.positions_px(frames, parts=_BLUR_PARTS)[:, moving]
            light[moving] = np.mean([self._cells(part, factor[moving]) for part in parts], axis=0)
        return light

    def _cells(self, positions_px: Array, brightness: Array) -> Array:
        line = self.line
        return light_per_cell(
            positions_px, brightness, self.looks, start_px=line.start_px, per_px=line.per_px, cells=line.cells
        )


def make_scene(experiment: Experiment) -> Scene:
    """Work out the pull, the sheets' motion, their looks and the frame times of an experiment."""
    pull = pull_apart(experiment.mechanics, seed=experiment.seed)
    comb = comb_at_rest(experiment)
    return Scene(
        experiment=experiment,
        pull=pull,
        comb=comb,
        motion=sheet_motion(experiment, pull, comb),
        looks=ridge_looks(experiment),
        geometry=camera_geometry(experiment, comb),
        times=frame_times(experiment),
    )
