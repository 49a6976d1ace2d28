"""Independent random numbers for each part of an experiment.

Each part draws from its own stream, derived from the experiment's seed and the part's name, so that a
change of one part (more texture, say) leaves every other part's numbers as they were.
"""

from __future__ import annotations

import zlib

import numpy as np


def stream(seed: int, part: str, *numbers: int) -> np.random.Generator:
    """Generator of one part (and, where given, of one frame or sheet of it)."""
    key = (zlib.crc32(part.encode()), *numbers)
    return np.random.Generator(np.random.SFC64(np.random.SeedSequence(seed, spawn_key=key)))
