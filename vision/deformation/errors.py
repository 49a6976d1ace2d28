"""What the errors of the creep are made of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vision.deformation.creep import Creep
from vision.deformation.frames import Doubles, StickFrames
from vision.deformation.memory import inflation
from vision.deformation.noise import Noise
from vision.deformation.pattern import repeating


@dataclass(frozen=True)
class Errors:
    """pattern_px: (sheet,), see `pattern`.  scale: error of the magnification, as a share of the creep."""

    noise: Noise
    pattern_px: Doubles
    frames: StickFrames
    scale: float = 0.0

    def of(self, fit: Creep) -> Doubles:
        """Standard errors of the coefficients, (stick, sheet, terms)."""
        terms = fit.coefficient.shape[2]
        white = np.einsum("eskk->esk", fit.inverse)
        factor = inflation(self.noise.memory, self.frames, terms)[:, None]
        random = np.sqrt(white * factor) * (self.noise.noise_px * self.noise.excess)[..., None]
        reach = fit.coefficient[..., 1]
        again = repeating(reach, terms) * self.pattern_px[:, None]
        return np.asarray(np.sqrt(random**2 + again**2 + (self.scale * reach[..., None]) ** 2))
