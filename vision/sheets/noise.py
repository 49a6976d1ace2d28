"""How noisy the profile is at each sheet, and how noisy the positions turn out."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vision.sheets.medians import nan_median
from vision.sheets.subpixel import Starts, gather

Doubles = NDArray[np.float64]

TRIPLES = 400  # groups of three consecutive frames that are asked, spread over the recording
LEAST_TRIPLES = 8
NORMAL_MEDIAN = 0.6745  # median of the absolute value of a standard normal variable


def intensity_noise(
    profile: NDArray[np.floating], x_px: Doubles, *, half_px: int, fallback: float
) -> Doubles:
    """Standard deviation of the profile's noise around each sheet, grey levels.

    Second differences in time of the pixels around a ridge hold its noise, its motion and its flicker;
    motion and flicker (level, brightness, first and second derivative of the ridge) are fitted and taken
    off, the rest is noise. Unlike a figure taken along x it does not mistake paper texture for noise, and
    knows that bright ridges are noisier.

    Args: profile (frame, x); x_px, positions (frame, N), NaN where missing; fallback, for sheets seen in
    fewer than eight groups of three frames.  Returns: (N,).  Source: median over the groups, so slips do
    not count.
    """
    half = max(half_px, 5)
    middle = _triples(x_px)
    if len(middle) < LEAST_TRIPLES:
        return np.full(x_px.shape[1], fallback)
    centre = np.nan_to_num(np.rint(x_px[middle]), nan=-10 * half).astype(np.int64)
    offsets = np.arange(-half - 1, half + 2)
    before, now, after = (
        gather(profile, Starts(np.repeat(middle + step, x_px.shape[1]), centre.ravel()), offsets)
        for step in (-1, 0, 1)
    )
    variance = _residual_variance(before + after - 2 * now, (before + now + after) / 3)
    variance = variance.reshape(len(middle), -1) / 6
    known = np.isfinite(variance).sum(axis=0) >= LEAST_TRIPLES
    typical = nan_median(variance, axis=0)
    return np.asarray(np.where(known, np.sqrt(typical), fallback), np.float64)


def position_noise(x_px: Doubles) -> Doubles:
    """Standard deviation of the positions from frame to frame, px, as measured: (N,), NaN for fewer than
    eight triples.

    From second differences in time, so that a steady creep does not count, less their median over the
    sheets, so that vibration of the camera does not either (with five sheets or more); median absolute
    value, so slips do not.
    """
    second = x_px[2:] - 2 * x_px[1:-1] + x_px[:-2]
    if x_px.shape[1] >= 5 and len(second):
        second = second - np.nan_to_num(nan_median(second, axis=1))[:, None]
    known = np.isfinite(second).sum(axis=0) >= LEAST_TRIPLES
    if not len(second):
        return np.full(x_px.shape[1], np.nan)
    typical = nan_median(np.abs(second), axis=0)
    return np.asarray(np.where(known, typical / NORMAL_MEDIAN / np.sqrt(6), np.nan), np.float64)


def _triples(x_px: Doubles) -> NDArray[np.int64]:
    """Middle frames of triples in which most sheets are seen, spread over the recording."""
    seen = np.isfinite(x_px).mean(axis=1) > 0.5
    middle = 1 + np.flatnonzero(seen[2:] & seen[1:-1] & seen[:-2])
    if not len(middle):
        return np.asarray(middle, np.int64)
    return np.unique(middle[np.linspace(0, len(middle) - 1, TRIPLES).astype(int)])


def _residual_variance(change: Doubles, mean: Doubles) -> Doubles:
    """Variance of what is left of `change` (points, pixels) when the mean ridge's own changes are fitted and
    removed."""
    inner = mean[:, 1:-1]
    basis = np.stack(
        [
            np.ones_like(inner),
            inner - inner.mean(axis=1, keepdims=True),
            (mean[:, 2:] - mean[:, :-2]) / 2,
            mean[:, 2:] - 2 * inner + mean[:, :-2],
        ],
        axis=2,
    )
    known = np.isfinite(basis).all(axis=(1, 2)) & np.isfinite(change).all(axis=1)
    out = np.full(len(change), np.nan)
    q = np.linalg.qr(basis[known] + 1e-9)[0]
    rest = change[known][:, 1:-1]
    rest = rest - (q @ (np.swapaxes(q, 1, 2) @ rest[:, :, None]))[:, :, 0]
    dof = inner.shape[1] - basis.shape[2]
    # the median of a chi-squared variable with k degrees of freedom is about k (1 − 2/(9k))³
    out[known] = (rest**2).sum(axis=1) / (dof * (1 - 2 / (9 * dof)) ** 3)
    return out
