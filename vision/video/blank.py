"""is_blank(): frames without the recording's content: white, black, grey, a light switched off."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

NO_CONTRAST = 0.1  # of the recording's median: a light dimmed to a tenth still passes, noise alone does not
LOW_CONTRAST = 0.35  # too little only together with a level that is out of the ordinary
BRIGHT = 1.3  # times the median level
SATURATED = 0.98  # of the saturation level, in every column
_CHUNK_ROWS = 4096


def is_blank(
    profiles: NDArray[np.float32], readable: NDArray[np.bool_], *, saturation_level: float | None = None
) -> NDArray[np.bool_]:
    """Which readable frames show nothing of what the others show.

    A frame is blank if its profile is constant or saturated throughout, if its contrast (standard deviation
    along x) is below `NO_CONTRAST` of the recording's median contrast, or if the frame is brighter than
    usual and its contrast, relative to its level, is below `LOW_CONTRAST` of the median. Dim frames keep
    their relative contrast and a tenth of the absolute one suffices; motion blur leaves the light's
    gradient and the edges.

    Args: profiles, intensity (frame, x); readable (frame).  Returns: bool (frame), False where not readable.
    Fails where more than half of a recording is blank: only constant and saturated frames are then found.
    """
    level, contrast, darkest = _figures(profiles)
    blank = contrast <= 1e-6 * np.maximum(np.abs(level), 1.0)
    if saturation_level is not None:
        blank |= darkest >= SATURATED * saturation_level
    usual = readable & ~blank
    if usual.any():
        usual_level = float(np.median(level[usual]))
        usual_contrast = float(np.median(contrast[usual]))
        blank |= contrast < NO_CONTRAST * usual_contrast
        relative = contrast * usual_level < LOW_CONTRAST * usual_contrast * level
        blank |= relative & (level > BRIGHT * usual_level)
    return blank & readable


def _figures(profiles: NDArray[np.float32]) -> tuple[NDArray[np.float64], ...]:
    """Mean, standard deviation and minimum along x, in chunks: the profiles may exceed memory."""
    out = np.empty((3, profiles.shape[0]))
    for start in range(0, profiles.shape[0], _CHUNK_ROWS):
        part = profiles[start : start + _CHUNK_ROWS]
        span = slice(start, start + part.shape[0])
        out[0, span] = part.mean(axis=1, dtype=np.float64)
        out[1, span] = part.std(axis=1, dtype=np.float64)
        out[2, span] = part.min(axis=1)
    return out[0], out[1], out[2]
