"""When each frame was taken, on the camera's clock and on the machine's; what was lost and what was mis-
stamped."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vision.experiment.randomness import stream

if TYPE_CHECKING:
    from vision.experiment.settings import Experiment

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class FrameTimes:
    """One entry per frame that reached the file; times are of mid-exposure.

    camera_s is true camera time, stamp_s what the camera wrote (stale stamps repeat the one before),
    machine_s the force clock; `exposed` numbers the frames before any were lost.
    """

    camera_s: Array
    stamp_s: Array
    machine_s: Array
    exposed: NDArray[np.int64]
    lost: int


def frame_times(experiment: Experiment) -> FrameTimes:
    """Frames kept, with their times; the first is never lost."""
    camera, clocks = experiment.camera, experiment.clocks
    total = max(round(camera.duration_s * camera.fps), 1)
    rng = stream(experiment.seed, "clocks")
    keep = rng.uniform(size=total) >= clocks.dropped
    keep[0] = True
    exposed = np.flatnonzero(keep)
    true = exposed / camera.fps
    stale = rng.uniform(size=total)[exposed] < clocks.stale
    stale[0] = False
    source = np.maximum.accumulate(np.where(stale, 0, np.arange(len(true))))
    machine = clocks.offset_s + (1 + clocks.drift_ppm * 1e-6) * true
    return FrameTimes(
        camera_s=true, stamp_s=true[source], machine_s=machine, exposed=exposed, lost=total - len(exposed)
    )


def camera_time(machine_s: Array, experiment: Experiment) -> Array:
    """Video time of a moment on the force clock."""
    clocks = experiment.clocks
    return (np.asarray(machine_s) - clocks.offset_s) / (1 + clocks.drift_ppm * 1e-6)
