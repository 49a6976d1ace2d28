"""How noisy a recording is, and which samples are impulsive spikes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

MAD_TO_SIGMA = 1.4826
_SPIKE_SIGMAS = 6.0
_SPIKE_WINDOW = 5


def noise_sigma(y: NDArray[np.float64]) -> float:
    """Standard deviation of white noise on a signal of slow rises and sudden drops.

    The median absolute second difference sees neither the rises nor the few drops.  Never below what the
    quantum of the recording causes (q/√12), nor zero.  Source: physics notes on detection.
    """
    second = np.diff(y, 2)
    spread = MAD_TO_SIGMA * float(np.median(np.abs(second - np.median(second)))) / np.sqrt(6.0)
    return float(max(spread, _quantum(y) / np.sqrt(12.0), 1e-9 * float(np.ptp(y)), np.finfo(float).tiny))


def _quantum(y: NDArray[np.float64]) -> float:
    """The smallest difference between two recorded values, rounding errors aside; 0 for a constant."""
    steps = np.diff(np.unique(y))
    steps = steps[steps > 1e-6 * float(np.ptp(y))]
    return float(steps.min()) if steps.size else 0.0


def spikes(y: NDArray[np.float64], sigma: float) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """(which samples are spikes, the signal with spikes replaced by the median of five samples).

    A spike is one or two samples over six σ away from the median of the five around it: slips and corners of
    a sawtooth stay, because the median follows them.
    """
    from scipy.ndimage import median_filter

    middle = median_filter(y, size=_SPIKE_WINDOW, mode="nearest")
    # The corner of a steep sawtooth also lies off the median, by at most two rises between samples.
    rise = 2.0 * float(np.median(np.abs(np.diff(middle))))
    is_spike = np.abs(y - middle) > _SPIKE_SIGMAS * sigma + rise
    return is_spike, np.where(is_spike, middle, y)
