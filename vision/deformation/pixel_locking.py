"""Pixel locking of the publication's fit: positions biased towards whole pixels, and its correction.

The publication fits a parabola to a window centred on the brightest pixel; its vertex lies nearer to that
pixel than the ridge does, by a fixed share of the distance.  Where the ridge stands midway between two
pixels, noise decides which is the brightest and positions jump between two values; the sheet's own creep
tells which it was.
"""

from __future__ import annotations

import numpy as np

from vision.deformation.creep import StickFrames, fit_creep
from vision.deformation.settings import DeformationSettings
from vision.numeric import Floats, nan_median

_AMBIGUOUS_PX = 0.25  # from a pixel's centre, beyond which its neighbour may have been the brightest
_ROUNDS = 2, 2, 3, 4  # terms of the creep, round by round: a line is not led astray by wrong pixels


def pixel_locking_slope(x_px: Floats, x_err_px: Floats) -> Floats:
    """Share by which distances to the brightest pixel are underestimated, for each sheet.

    Parameters
    ----------
    x_px, x_err_px
        Positions of the publication's fit with their standard errors, px, (frame, sheet).

    Returns
    -------
    (sheet,); 0 where no locking is seen.

    Notes
    -----
    The stated variance of a position holds the square of the bias, so that it rises with the square of the
    distance; the slope of that rise, by least squares over all frames, is the square of the share.
    """
    known = np.isfinite(x_px) & np.isfinite(x_err_px)
    count = np.maximum(known.sum(axis=0), 1)
    offset, error = (
        np.where(known, value**2 - np.where(known, value**2, 0.0).sum(axis=0) / count, 0.0)
        for value in (x_px - np.rint(x_px), x_err_px)
    )
    rise = (offset * error).sum(axis=0) / np.maximum((offset**2).sum(axis=0), 1e-12)
    return np.asarray(np.sqrt(np.maximum(rise, 0.0)))


def correct_pixel_locking(
    x_px: Floats, slope: Floats, frames: StickFrames, terms: int, settings: DeformationSettings
) -> Floats:
    """Positions without pixel locking.

    Parameters
    ----------
    x_px
        Positions in the sticks' frames, px, (F, sheet).
    slope
        Of `pixel_locking_slope`, (sheet,).
    frames, terms, settings
        Of the creep that decides which pixel was the brightest: of the two candidates, the one nearer to the
        sheet's creep and the camera's vibration is taken.

    Returns
    -------
    (F, sheet); the input where no sheet is locked.
    """
    if not slope.any():
        return x_px
    offset = x_px - np.rint(x_px)
    nearest, other = (x_px + slope * _bias(away) for away in (offset, offset - np.sign(offset)))
    corrected = nearest
    for order in _ROUNDS:
        expected = fit_creep(corrected, frames, min(order, terms), settings).at(frames)
        expected = expected + nan_median(corrected - expected, axis=1)[:, None]
        better = np.abs(other - expected) < np.abs(nearest - expected)
        corrected = np.where(better & (np.abs(offset) > _AMBIGUOUS_PX), other, nearest)
    return corrected


def _bias(offset_px: Floats) -> Floats:
    """Bias over the sheet's share; measured on drawn ridges, the same for all their widths."""
    return np.asarray(0.945 * offset_px + 0.034 * np.sin(2 * np.pi * offset_px))
