"""The sensor: electrons, noise, grey levels.

A pixel that collects e electrons has variance e + read^2 (photons and read-out); the mean of n rows has
that over n. Grey level = black level + e / gain, rounded and clipped.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from vision.experiment.settings import Camera

_ROUNDING_VARIANCE = 1 / 12


def saturation_level(camera: Camera) -> int:
    """Highest grey level."""
    return int(2**camera.bits - 1)


def electrons_per_level(camera: Camera) -> float:
    """Gain in electrons per grey level: the full well over the levels above black."""
    return camera.full_well_e / (saturation_level(camera) - camera.black_level)


def grey_levels(light: NDArray[np.float32], camera: Camera, rng: np.random.Generator) -> NDArray[Any]:
    """A frame as written: light (fraction of saturation) becomes noisy, rounded, clipped grey levels."""
    electrons = light * np.float32(camera.full_well_e)
    if camera.noise:
        # Thousands of electrons a pixel: a normal deviate of the right variance is a Poisson one to 1e-3.
        spread = np.sqrt(np.maximum(electrons, 0) + np.float32(camera.read_noise_e**2))
        electrons += spread * rng.standard_normal(light.shape, dtype=np.float32)
    np.minimum(electrons, np.float32(camera.full_well_e), out=electrons)
    electrons *= np.float32(1 / electrons_per_level(camera))
    electrons += np.float32(camera.black_level + 0.5)
    np.clip(electrons, 0, saturation_level(camera), out=electrons)
    return electrons.astype(np.uint8 if camera.bits == 8 else np.uint16)


def mean_of_rows(
    light: NDArray[np.float64], camera: Camera, rows: int, rng: np.random.Generator
) -> NDArray[np.float32]:
    """The mean grey level of `rows` such pixels, without making them: same mean, same variance."""
    electrons = light * camera.full_well_e
    gain = electrons_per_level(camera)
    if camera.noise:
        one = np.maximum(electrons, 0) + camera.read_noise_e**2 + _ROUNDING_VARIANCE * gain**2
        electrons = electrons + np.sqrt(one / rows) * rng.standard_normal(light.shape, dtype=np.float32)
    levels = camera.black_level + np.minimum(electrons, camera.full_well_e) / gain
    return np.asarray(np.clip(levels, 0, saturation_level(camera)), np.float32)
