"""Errors of position that repeat wherever a sheet passes: pixels of unequal response, dust.

They do not average out over the frames of a stick, and a straight line hides them: where the pattern has a
slope, the scale is wrong.  Their size is told from bends that a sheet shows again in every stick.
"""

from __future__ import annotations

import numpy as np

from vision.deformation.creep import Creep
from vision.deformation.frames import Bools, Doubles
from vision.deformation.noise import Noise

_USUAL = 0.5  # of the noise of one frame: pixels that differ by 0.7 % under 5000 electrons
_DOUBT = 0.15  # of the square of that
_STEPS = 200
_WAVES_PER_PX = np.arange(0.01, 0.5, 0.01)
_WINDOW_PX = np.arange(5)  # half of the standard fit window
_POWER = (np.sin(2 * np.pi * _WAVES_PER_PX[:, None] * _WINDOW_PX) @ _WINDOW_PX) ** 2


def repeating(reach_px: Doubles, terms: int) -> Doubles:
    """RMS share in P_0, P_1, ... of a pattern of 1 px for a sheet that creeps by twice reach_px.

    The positions' fit weighs pixels by their distance from the ridge, within the window: that filter gives
    the pattern its spectrum.  A wave of f per px has the share (2 l + 1) j_l(2 pi f reach) in P_l
    (spherical Bessel functions).  Returns: the shape of reach_px and (terms,).
    """
    from scipy.special import spherical_jn

    reach = np.nan_to_num(np.abs(reach_px))
    grid = np.linspace(0, float(reach.max(initial=0.0)) + 1e-9, _STEPS)
    order, phase = np.arange(terms)[:, None, None], 2 * np.pi * _WAVES_PER_PX[:, None] * grid
    square = _POWER @ spherical_jn(order, phase) ** 2 / _POWER.sum()
    return np.stack([(2 * k + 1) * np.interp(reach, grid, np.sqrt(square[k])) for k in range(terms)], axis=-1)


def pattern_px(creep: Creep, error: Doubles, noise: Noise) -> Doubles:
    """RMS of the pattern at each sheet, px, (sheet,), from bends that return in every stick.

    Bends that all sheets share are no pattern: the camera's movement, and creep that slows down.  Where
    there is too little to see, the pattern is taken to be as large as for the other sheets, or usual.
    Args: creep, of three terms or more; error, of its coefficients, noise alone (stick, sheet, terms).
    """
    used = (creep.good & (noise.excess <= 1))[..., None]
    everything = creep.coefficient, error, repeating(creep.coefficient[..., 1], error.shape[2])
    coefficient, error, expected = (np.where(used, values, 0.0) for values in everything)
    unit_px = noise.noise_px[:, None]
    own = _own(coefficient[..., 2:], coefficient[..., 1:2], used)
    seen, size = _again(own / unit_px), _again(expected[..., 2:])
    chance = ((error[..., 2:] / unit_px) ** 2).sum(axis=0)
    common = _square((seen.sum(), size.sum()), ((chance + _USUAL**2 * size) ** 2).sum(), _USUAL**2, _DOUBT)
    scatter = ((chance + common * size) ** 2).sum(axis=1)
    each = _square((seen.sum(axis=1), size.sum(axis=1)), scatter, common, common)
    return np.asarray(np.sqrt(each) * noise.noise_px)


def _own(bend: Doubles, slope: Doubles, used: Bools) -> Doubles:
    """Bends (stick, sheet, ...) less what all sheets of a stick share: a constant, a share of the slope."""
    count = np.maximum(used.sum(axis=1, keepdims=True), 1)
    bend, slope = (np.where(used, v - v.sum(axis=1, keepdims=True) / count, 0.0) for v in (bend, slope))
    square = np.maximum((slope**2).sum(axis=1, keepdims=True), 1e-12)
    return np.asarray(bend - slope * (bend * slope).sum(axis=1, keepdims=True) / square)


def _again(value: Doubles) -> Doubles:
    """Sums of products between different sticks of each sheet, (sheet, ...): what does not return cancels."""
    return np.asarray(value.sum(axis=0) ** 2 - (value**2).sum(axis=0))


def _square(
    measured: tuple[Doubles, Doubles], scatter: Doubles, before: Doubles | float, doubt: Doubles | float
) -> Doubles:
    """Pattern's square: the ratio of two sums, of which half the variance of the first is `scatter`, and what
    it was taken for before, weighted; not below 0, and as before where there is no doubt of it (0)."""
    seen, size = measured
    known = size / np.maximum(2 * scatter, 1e-300) * np.square(doubt)
    return np.asarray(np.maximum(seen * known + before, 0.0) / (size * known + 1))
