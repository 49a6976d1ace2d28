"""Where a sheet may have been overlooked: spacings too wide for the comb."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vision.sheets.noise import NORMAL_MEDIAN

Doubles = NDArray[np.float64]

LEAST_SPACINGS = 8
TOO_WIDE = 1.6  # local pitches
SIGMAS = 3.0  # of the logarithms of all spacings: an uneven comb has wide spacings anyway
NEIGHBOURS = 9


def wide_spacings(x_px: Doubles) -> tuple[Doubles, Doubles]:
    """Middles, px, and sizes, in local pitches, of spacings in which a sheet seems to be missing.

    The local pitch is the median of the nine spacings around.  Fewer than nine sheets: none, since there is
    no comb to compare with.

    Args: x_px, resting places of the sheets, ascending (N,).
    """
    from scipy.ndimage import median_filter

    spacing = np.diff(x_px)
    if spacing.size < LEAST_SPACINGS:
        return np.empty(0), np.empty(0)
    size = spacing / median_filter(spacing, size=NEIGHBOURS, mode="nearest")
    log = np.log(size)
    scatter = float(np.median(np.abs(log - np.median(log)))) / NORMAL_MEDIAN
    wide = log > max(np.log(TOO_WIDE), SIGMAS * scatter)
    return (x_px[:-1] + 0.5 * spacing)[wide], size[wide]
