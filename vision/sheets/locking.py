"""Locking of positions to whole pixels, measured from the sheets' motion against each other."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vision.numeric import NORMAL_MEDIAN, Bools, Floats, nan_median, sigma_about_zero, spread_indices
from vision.sheets.settings import TrackingSettings

_HARMONICS = 2  # of a period of one pixel; sharper edges lock at once, at 1/20 of the second harmonic
_LEAST_SHEETS = 12  # fewer do not tell the scatter between sheets from chance
_LEAST_LOCKING_FRAMES = 100  # fewer do not tell it from the motion of slips
_MOST_FRAMES = 1000  # spread over the film: enough, and memory does not grow with it
_OUTLIER = 5.0  # median deviations: slips and exchanged sheets
_PARTS = 10  # of the film, for the errors of single sheets' locking
_ALIKE = 0.5  # mean resultant length of the sheets' places in their pixels: by chance 0.2 for 24 sheets
_CLEAR_SCATTER = 9.0  # over the square of its error: ordinary ridges reach 3, sharp unlike ones 50 to 4000
_WELL_SEEN = 0.1  # variance of cosine and sine of a position beside its motion: 0.3 and 0.7 over a pixel


class PixelLocking(NamedTuple):
    """By how much a position is shifted depending on where in a pixel it lies.

    Parameters
    ----------
    waves
        Amplitudes, px, of cos 2πx, sin 2πx, cos 4πx and sin 4πx, (4,).
    error_px
        Root mean square of what the sheets lock by otherwise than these amplitudes, with their errors.
    """

    waves: Floats
    error_px: float

    @property
    def rms_px(self) -> float:
        """Root mean square of the shift over a pixel."""
        return float(np.sqrt(0.5 * np.sum(self.waves**2)))

    def at(self, x_px: Floats) -> Floats:
        """Return the shift of positions."""
        return np.asarray(np.tensordot(self.waves, pixel_waves(x_px), axes=1), np.float64)


NO_LOCKING = PixelLocking(np.zeros(2 * _HARMONICS), 0.0)


def pixel_locking(x_px: Floats, err_px: float, settings: TrackingSettings) -> PixelLocking:
    r"""Measure how positions lock to whole pixels: `NO_LOCKING` where it is not clear.

    Parameters
    ----------
    x_px
        Positions (frame, N), NaN where missing or repeated.
    err_px
        Usual error of a position by noise.
    settings
        `locking_sigmas` decides what is clear, `least_locking` what matters.

    Returns
    -------
    PixelLocking
        `NO_LOCKING` also for fewer than twelve sheets or 100 frames, and for sheets that all lie at the same
        place in their pixels.

    Notes
    -----
    Ridges sharper than about two pixels are not described by their pixels, and every fit draws them towards
    some place in the pixel. One sheet alone does not show this: its shape and its motion explain each other.
    Its neighbours do, since each lies elsewhere in its pixel. The displacement :math:`u_n` of each sheet,
    less the mean of both neighbours, is fitted by the same combination of waves

    .. math:: b(x) = \sum_{k=1}^{2} a_k \cos 2\pi k x + b_k \sin 2\pi k x

    for all sheets. Motion of their own lies anywhere in the pixel; how far the sheets contradict each other
    gives the standard errors. Sheets of different shapes lock differently: those that moved over whole pixels
    are fitted once more, each by itself and with a part in proportion to its displacement, which is motion;
    the scatter of the first harmonic beyond its errors is the error that remains.
    """
    rows = spread_indices(len(x_px), _MOST_FRAMES)
    x = x_px[rows]
    middle = nan_median(x)
    if x.shape[1] < _LEAST_SHEETS or len(x) < _LEAST_LOCKING_FRAMES or _at_one_place(middle):
        return NO_LOCKING
    moved = x - middle
    known, against = without_outliers(_against_neighbours(moved))
    regressors = _against_neighbours(pixel_waves(x))
    products, loads = normal_equations(regressors, against, known)
    inverse = np.linalg.pinv(products.sum(axis=0))
    found = inverse @ loads.sum(axis=0)
    unexplained = loads - products @ found  # of each sheet: they scatter by more than noise explains
    variance = np.diag(inverse @ (unexplained.T @ unexplained) @ inverse)
    if not (found**2 > settings.locking_sigmas**2 * variance).any():
        found, variance = np.zeros_like(found), np.zeros_like(variance)
    own = against - np.einsum("a,afn->fn", found, regressors)
    regressors = np.concatenate([regressors, moved[np.newaxis, :, 1:-1]])
    scatter = _scatter_of_sheets(regressors, own, known)
    locking = PixelLocking(found, float(np.sqrt(0.5 * np.sum(variance) + 0.5 * np.sum(scatter))))
    matters = np.hypot(locking.rms_px, locking.error_px) > settings.least_locking * err_px
    return locking if matters else NO_LOCKING


def pixel_waves(x_px: Floats) -> Floats:
    """Return cosine and sine of the position in its pixel, of each harmonic in turn, (4, …)."""
    turn = 2 * np.pi * x_px
    return np.stack([wave(k * turn) for k in range(1, _HARMONICS + 1) for wave in (np.cos, np.sin)])


def _at_one_place(x_px: Floats) -> bool:
    """Return whether sheets lie at the same place in their pixels, or at two places half a pixel apart.

    Their shifts are then in proportion to their motion, which none of the waves may take away.
    """
    turns = np.exp(2j * np.pi * x_px[np.isfinite(x_px)])
    return any(abs(np.sum(turns**k)) > _ALIKE * len(turns) for k in range(1, _HARMONICS + 1))


def _against_neighbours(values: Floats) -> Floats:
    """Return the values of each sheet, along the last axis, less the mean of both neighbours."""
    return np.asarray(values[..., 1:-1] - 0.5 * (values[..., :-2] + values[..., 2:]), np.float64)


def without_outliers(values: Floats) -> tuple[Bools, Floats]:
    """Return which values (frame, N) are near the median of their sheet, and their difference from it."""
    off = values - nan_median(values)
    return np.abs(off) < _OUTLIER * sigma_about_zero(off), off


def normal_equations(regressors: Floats, values: Floats, known: Bools) -> tuple[Floats, Floats]:
    """Return the sums of products of each sheet's regressors, (N, K, K), and of them and its values, (N, K).

    Both are taken less their means over the frames. regressors: (K, frame, N); values, known: (frame, N).
    """
    count = np.maximum(known.sum(axis=0), 1)

    def centred(rows: Floats) -> Floats:
        kept = np.where(known, rows, 0.0)
        return np.where(known, kept - kept.sum(axis=-2, keepdims=True) / count, 0.0)

    rows = centred(regressors)
    return np.einsum("afn,bfn->nab", rows, rows), np.einsum("afn,fn->na", rows, centred(values))


def _scatter_of_sheets(regressors: Floats, values: Floats, known: Bools) -> Floats:
    """Return the variance, between sheets, of the two amplitudes of the first harmonic, beyond their errors.

    Only sheets that moved over whole pixels tell: there these waves vary by themselves, the other regressors
    aside. The errors are those of a jackknife over parts of the film. 0 for fewer than six such sheets, and
    where the amplitudes are not three times their errors.
    """
    parts = np.array_split(np.arange(len(values)), _PARTS)
    each = [normal_equations(regressors[:, rows], values[rows], known[rows]) for rows in parts]
    products, loads = (np.stack(parts) for parts in zip(*each, strict=True))
    inverse = np.linalg.pinv(products.sum(axis=0), hermitian=True)
    count = np.maximum(known.sum(axis=0), 1)[:, np.newaxis]
    alone = np.diagonal(inverse, axis1=1, axis2=2)[:, :2] * count
    well = ((alone > 0) & (alone < 1 / _WELL_SEEN)).all(axis=1)
    if np.sum(well) < _LEAST_SHEETS // 2:
        return np.zeros(2)
    products, loads = products[:, well], loads[:, well]

    def solved(products: Floats, loads: Floats) -> Floats:
        found = np.linalg.pinv(products, hermitian=True) @ loads[..., np.newaxis]
        return np.asarray(found[..., :2, 0], np.float64)

    whole = solved(products.sum(axis=0), loads.sum(axis=0))
    without = solved(products.sum(axis=0) - products, loads.sum(axis=0) - loads)  # (part, sheet, 2)
    error = (_PARTS - 1) * np.var(without, axis=0)
    # Medians, since some sheets are seen in few places of their pixels, and know little of either.
    error, scatter = (np.median(values, axis=0) / NORMAL_MEDIAN**2 for values in (error, whole**2))
    return np.where(scatter > _CLEAR_SCATTER * error, scatter - error, 0.0)
