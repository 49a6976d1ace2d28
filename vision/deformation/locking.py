"""The publication's fit pulls positions towards whole pixels; here they are let go again.

Its window is centred on the brightest pixel, and the vertex lies nearer to it than the ridge does, by a
share of the distance.  Where the ridge stands between two pixels, noise decides which is the brightest, and
positions jump to and fro: there the sheet's own creep tells which it was.
"""

from __future__ import annotations

import numpy as np

from vision.deformation.creep import fit_creep
from vision.deformation.frames import Doubles, StickFrames
from vision.sheets.medians import nan_median

_BETWEEN = 0.25  # px from a pixel's centre beyond which its neighbour may have been the brightest
_TERMS = 2, 2, 3, 4  # of the creep, round by round: a line is not led astray by wrong pixels


def pull(x_px: Doubles, error_px: Doubles) -> Doubles:
    """Share by which the sheets' offsets from the brightest pixel are short, (sheet,); 0 where not seen.

    The stated errors of the publication's fit hold the pull in each frame; their squares rise with the
    square of the offset.  x_px, error_px: (frame, sheet).
    """
    known = np.isfinite(x_px) & np.isfinite(error_px)
    count = np.maximum(known.sum(axis=0), 1)
    offset, error = (
        np.where(known, value**2 - np.where(known, value**2, 0.0).sum(axis=0) / count, 0.0)
        for value in (x_px - np.rint(x_px), error_px)
    )
    rise = (offset * error).sum(axis=0) / np.maximum((offset**2).sum(axis=0), 1e-12)
    return np.asarray(np.sqrt(np.maximum(rise, 0.0)))


def let_go(x_px: Doubles, share: Doubles, frames: StickFrames, terms: int) -> Doubles:
    """Positions (F, sheet) without the pull.

    Of the two pixels that may have been the brightest, the one that suits the sheet's creep (of `terms`
    terms) and the camera's vibration better is taken.
    """
    if not share.any():
        return x_px
    offset = x_px - np.rint(x_px)
    nearest, other = (x_px + share * _short(away) for away in (offset, offset - np.sign(offset)))
    freed = nearest
    for order in _TERMS:
        expected = fit_creep(freed, frames, terms=min(order, terms)).at(frames)
        expected = expected + nan_median(freed - expected, axis=1)[:, None]
        better = np.abs(other - expected) < np.abs(nearest - expected)
        freed = np.where(better & (np.abs(offset) > _BETWEEN), other, nearest)
    return freed


def _short(offset_px: Doubles) -> Doubles:
    """By how much a position is short over its sheet's share; the same for all widths of ridges, measured."""
    return np.asarray(0.945 * offset_px + 0.034 * np.sin(2 * np.pi * offset_px))
