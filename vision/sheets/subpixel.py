"""Ridge positions to a hundredth of a pixel, one function per fit, each with its error.

All take the profile (frame, x) and whole-pixel starting points, and return positions in px (pixel centres
at integers) and the error that one grey level of white pixel noise would give them. Ridges are bright:
pass the negative profile for dark ones.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]


class Fit(NamedTuple):
    """Positions and what they rest on, one entry per starting point.

    x_px: position, NaN where the fit has no answer.  err_per_noise: px of position error (standard
    deviation) per grey level of white noise in the profile.
    """

    x_px: Doubles
    err_per_noise: Doubles


class Starts(NamedTuple):
    """Where to fit: frame number (row of the profile) and whole pixel, both (points,)."""

    frame: NDArray[np.int64]
    x: NDArray[np.int64]


def paper_vertex(
    profile: NDArray[np.floating], starts: Starts, *, window_px: int = 9, search_px: int = 3
) -> Fit:
    """Vertex of the least-squares parabola through `window_px` pixels centred on the brightest one.

    The publication's method, exactly (appendix B): the brightest pixel is looked for within `search_px`
    of the start, a second-degree polynomial is fitted around it, its vertex is the position. Equals
    `numpy.polyfit` to rounding. It locks to whole pixels (50–190 mpx peak to peak), which
    `sliding_vertex` does not.

    NaN where the window leaves the frame, the brightest pixel lies at the end of the search, the parabola
    has no maximum, or its vertex lies outside the window.
    """
    half = window_px // 2
    around = np.arange(-search_px, search_px + 1)
    near = gather(profile, starts, around)
    at_end = np.isnan(near).all(axis=1)
    brightest = np.argmax(np.where(np.isnan(near), -np.inf, near), axis=1)
    centre = starts.x + around[brightest]
    offsets = np.arange(-half, half + 1)
    slope, curvature = _parabola(gather(profile, Starts(starts.frame, centre), offsets), offsets)
    with np.errstate(divide="ignore", invalid="ignore"):
        vertex = -slope / (2 * curvature)
        noise = np.hypot(
            1 / np.sqrt((offsets**2).sum()), 2 * vertex / np.sqrt(_quadratic_norm(offsets))
        ) / np.abs(2 * curvature)
    bad = (
        at_end
        | (brightest == 0)
        | (brightest == 2 * search_px)
        | ~(curvature < 0)
        | ~(np.abs(vertex) <= half)
    )
    return Fit(np.where(bad, np.nan, centre + vertex), np.where(bad, np.nan, noise))


def sliding_vertex(profile: NDArray[np.floating], starts: Starts, *, window_px: int = 9) -> Fit:
    """Ridge positions where the slope of the least-squares parabola is zero.

    A parabola fitted to `window_px` pixels has, at its centre, a slope that is one fixed linear filter of
    the profile. A ridge lies where that slope falls through zero as the window slides, so unlike the
    vertex of a window pinned to the brightest pixel the result does not lock to whole pixels. Between
    pixels the slope is interpolated by the cubic through its four neighbours; of several zeros the one
    nearest the start counts.

    NaN where the slope does not fall through zero within half a window of the start, or the window leaves
    the frame.
    Source: paper, appendix B; Savitzky & Golay 1964.
    """
    half, width = window_px // 2, profile.shape[1]
    slope = _slope(profile, window_px).ravel()
    left = np.flatnonzero((slope[:-1] >= 0) & (slope[1:] < 0))
    column = left % width
    left = left[(column >= half) & (column <= width - 2 - half)]  # the parabola stands inside the frame
    at, found = _nearest(left, slope, starts.frame * width + starts.x, half)
    four = slope[np.clip(at[:, None] + np.arange(-1, 3), 0, len(slope) - 1)].astype(np.float64)
    step, steepness = _cubic_zero(four)
    found &= np.isfinite(step) & (at // width == starts.frame)
    err = 1 / np.sqrt((np.arange(-half, half + 1) ** 2).sum()) / np.abs(steepness)
    return Fit(np.where(found, at % width + step, np.nan), np.where(found, err, np.nan))


def template_shift(
    profile: NDArray[np.floating], starts: Starts, shape: NDArray[np.integer], x_px: Doubles, *, half_px: int
) -> Fit:
    """Positions by matching each ridge to its own mean shape.

    For each shape (one per sheet) the pixels of all its ridges, each shifted by its first position, give
    the mean profile and its derivative at any fraction of a pixel (a smoothing spline through all of
    them). One Gauss-Newton step then fits shift, brightness and background together, twice over;
    residuals of the shift are taken out in the mean over all of a sheet's ridges, so a template never
    moves a sheet's mean position.

    Args: shape, which template each start belongs to (points,); x_px, first positions, from `sliding_vertex`.
    NaN where x_px is NaN, the window leaves the frame, or the step is larger than a pixel.
    Source: least-squares matching, Cramér-Rao bound in physics notes: 1.00–1.04 of it at FWHM 6–10 px.
    """
    centre = np.rint(np.nan_to_num(x_px)).astype(np.int64)
    offsets = np.arange(-half_px, half_px + 1)
    pixels = gather(profile, Starts(starts.frame, centre), offsets)
    position, err = np.array(x_px, np.float64), np.full(len(x_px), np.nan)
    usable = np.isfinite(position) & np.isfinite(pixels).all(axis=1)
    for which in np.unique(shape[usable]):
        mine = np.flatnonzero(usable & (shape == which))
        position[mine], err[mine] = _match(pixels[mine], offsets, position[mine] - centre[mine], centre[mine])
    return Fit(np.where(np.isfinite(err), position, np.nan), err)


def gather(profile: NDArray[np.floating], starts: Starts, offsets: NDArray[np.integer]) -> Doubles:
    """Pixels at `offsets` from each start, (points, offsets), NaN outside the frame."""
    columns = starts.x[:, None] + offsets
    inside = (columns >= 0) & (columns < profile.shape[1])
    flat = starts.frame[:, None] * profile.shape[1] + np.clip(columns, 0, profile.shape[1] - 1)
    return np.where(inside, profile.ravel()[flat].astype(np.float64), np.nan)


def _quadratic_norm(offsets: NDArray[np.integer]) -> float:
    centred = offsets.astype(np.float64) ** 2
    return float(((centred - centred.mean()) ** 2).sum())


def _parabola(pixels: Doubles, offsets: NDArray[np.integer]) -> tuple[Doubles, Doubles]:
    """Slope and second-degree coefficient of the least-squares parabola through rows of pixels."""
    linear = offsets / (offsets**2).sum()
    square = offsets.astype(np.float64) ** 2
    quadratic = (square - square.mean()) / _quadratic_norm(offsets)
    level = pixels - pixels.mean(axis=1, keepdims=True)
    return level @ linear, level @ quadratic


def _slope(profile: NDArray[np.floating], window_px: int) -> NDArray[np.float32]:
    """Slope of the sliding parabola at every pixel, grey levels per px."""
    offsets = np.arange(-(window_px // 2), window_px // 2 + 1)
    kernel = (offsets / (offsets**2).sum())[None, :]
    clean = np.ascontiguousarray(profile, np.float32)
    return np.asarray(cv2.filter2D(clean, cv2.CV_32F, kernel, borderType=cv2.BORDER_REPLICATE), np.float32)


def _nearest(
    left: NDArray[np.int64], slope: NDArray[np.float32], start: NDArray[np.int64], reach: int
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Of the pixels just left of a zero, the one whose zero is nearest each start, and whether it is within
    reach."""
    if not len(left):
        return np.zeros_like(start), np.zeros(len(start), bool)
    zero = left + slope[left] / (slope[left].astype(np.float64) - slope[left + 1])
    after = np.searchsorted(zero, start)
    before, after = np.maximum(after - 1, 0), np.minimum(after, len(zero) - 1)
    chosen = np.where(np.abs(zero[before] - start) <= np.abs(zero[after] - start), before, after)
    return left[chosen], np.abs(zero[chosen] - start) <= reach


def _cubic_zero(four: Doubles) -> tuple[Doubles, Doubles]:
    """Zero in [0, 1] of the cubic through values at −1, 0, 1, 2, and its derivative there; Newton from the
    chord."""
    a, b, c, d = four.T
    cubic = np.stack([(-a + 3 * b - 3 * c + d) / 6, (a - 2 * b + c) / 2, c - b / 2 - a / 3 - d / 6, b])
    with np.errstate(divide="ignore", invalid="ignore"):
        t = b / (b - c)
        for _ in range(4):
            value = ((cubic[0] * t + cubic[1]) * t + cubic[2]) * t + cubic[3]
            rise = (3 * cubic[0] * t + 2 * cubic[1]) * t + cubic[2]
            t = np.clip(t - value / rise, 0.0, 1.0)
    return t, (3 * cubic[0] * t + 2 * cubic[1]) * t + cubic[2]


def _match(
    pixels: Doubles, offsets: NDArray[np.integer], fraction: Doubles, centre: NDArray[np.int64]
) -> tuple[Doubles, Doubles]:
    """Positions of one sheet's ridges against their mean shape, and their error per grey level of noise."""
    from scipy.interpolate import make_lsq_spline

    bins = np.arange(offsets[0] - 0.5, offsets[-1] + 0.51, 1.0)
    knots = np.r_[[bins[0]] * 3, bins, [bins[-1]] * 3]
    step = np.zeros_like(fraction)
    err = np.full_like(fraction, np.nan)
    for _ in range(2):
        place = offsets - (fraction + step)[:, None]
        order = np.argsort(place.ravel(), kind="stable")
        at, level = np.clip(place.ravel()[order], bins[0], bins[-1]), pixels.ravel()[order]
        try:
            spline = make_lsq_spline(at, level, knots, k=3)
        except (ValueError, np.linalg.LinAlgError):
            return fraction + centre, err
        more, err = _gauss_newton(pixels, spline(place), spline.derivative()(place))
        step += more - np.nanmean(more)
    bad = ~(np.abs(step) <= 1.0)
    return np.where(bad, np.nan, fraction + step + centre), np.where(bad, np.nan, err)


def _gauss_newton(pixels: Doubles, mean: Doubles, rise: Doubles) -> tuple[Doubles, Doubles]:
    """Shift that brings the mean shape onto the pixels, with brightness and level fitted alongside."""
    basis = np.stack([-rise, mean - mean.mean(axis=1, keepdims=True), np.ones_like(mean)], axis=2)
    inverse = np.linalg.pinv(np.swapaxes(basis, 1, 2) @ basis, hermitian=True)
    fitted = (inverse @ (np.swapaxes(basis, 1, 2) @ (pixels - mean)[:, :, None]))[:, :, 0]
    return fitted[:, 0], np.sqrt(np.maximum(inverse[:, 0, 0], 0.0))
