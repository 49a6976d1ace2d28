"""How far ridges lean over a stack of bands, and how wide they are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_STEP_PX = 0.5  # of the lean over the whole stack, between trials
_FURTHEST_PX = 12.0
_SEGMENT_PX = 256  # measured apart along x; wider than the widest pitch


def lean_px(bands: NDArray[np.floating]) -> float:
    """Shift along x from one band to the next, px, positive to the right downwards.

    The median over segments along x, so that a label or ridges bowed apart do not count as a lean.  In
    each, bands (frame, band, x) are shifted in proportion to their place until their sum is strongest. Of
    several maxima, a pitch apart, the one nearest to upright is taken; leans beyond 12 px over the stack
    are not found.  0 for a single band.
    """
    count, width = bands.shape[1:]
    if count < 2:
        return 0.0
    parts = np.array_split(bands, max(1, width // _SEGMENT_PX), axis=-1)
    return float(np.median([_lean_of_stack(part) for part in parts]) / (count - 1))


def _lean_of_stack(bands: NDArray[np.floating]) -> float:
    """Lean from the first band to the last: the best trial, refined by a parabola through its neighbours."""
    spectrum = np.fft.rfft(bands - bands.mean(axis=-1, keepdims=True), axis=-1)
    frequency = np.fft.rfftfreq(bands.shape[-1])
    place = np.linspace(-0.5, 0.5, bands.shape[1])
    trials = np.arange(-_FURTHEST_PX, _FURTHEST_PX + _STEP_PX / 2, _STEP_PX)
    power = np.array([_coherent_power(spectrum, frequency, place * lean) for lean in trials])
    inner = power[1:-1]
    peaks = np.flatnonzero((inner >= power[:-2]) & (inner > power[2:])) + 1
    if not peaks.size:
        return float(trials[np.argmax(power)])
    best = int(peaks[np.argmin(np.abs(trials[peaks]))])
    before, here, after = power[best - 1 : best + 2]
    return float(trials[best] + _STEP_PX * 0.5 * (before - after) / (before - 2 * here + after))


def _coherent_power(
    spectrum: NDArray[np.complexfloating], frequency: NDArray[np.floating], shifts_px: NDArray[np.floating]
) -> float:
    """Power of the sum of bands after moving each back by its shift."""
    phase = np.exp(2j * np.pi * np.outer(shifts_px, frequency)).astype(np.complex64)
    return float((np.abs(np.einsum("fbk,bk->fk", spectrum, phase)) ** 2).sum())


def ridge_width_px(slopes: NDArray[np.floating]) -> float:
    """Typical full width of a ridge at half height, px, from slopes along x (frame, x).

    A ridge's slope changes sign at its top: the slope's autocorrelation has its first minimum where one
    flank meets the other, for a Gaussian at sqrt(6)/2.355 = 1.04 of the width; the smoothing of the slopes
    is included.
    """
    power = np.abs(np.fft.rfft(slopes, n=2 * slopes.shape[-1], axis=-1)) ** 2
    correlation = np.fft.irfft(power.sum(axis=0))[: slopes.shape[-1] // 2]
    rising = np.flatnonzero(np.diff(correlation) > 0)
    return float(rising[0]) / 1.04 if rising.size else float("nan")
