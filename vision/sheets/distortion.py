"""Errors of ridges distorted by specks, highlights, the edge of a hand or uneven light.

`distortion` estimates the error from the shape and height of each ridge, and `shift_by_moving_light` the
error due to light that moves over the whole comb. `not_one_ridge` finds sheets that are not a single ridge.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vision.numeric import FWHM, NORMAL_MEDIAN, Bools, Floats, Floats32, nan_median, nan_quantile
from vision.sheets.ridges import FRAMES_PER_BLOCK, RidgeComb
from vision.sheets.settings import DEFAULT, TrackingSettings
from vision.sheets.subpixel import Starts, gather


def not_one_ridge(
    bright: Floats32, x_px: Floats, comb: RidgeComb, settings: TrackingSettings = DEFAULT
) -> Bools:
    """Return which sheets are not a single ridge, (N,): their mean profile differs from the comb's.

    Several sheets side by side, far thinner than most, appear as one hump to the search for ridges, and the
    position lies between them. Always False for fewer than five sheets.

    Parameters
    ----------
    bright
        Profile with bright ridges (frame, x).
    x_px
        Positions (frame, N), NaN where missing.
    comb
        Width and pitch of the ridges.
    settings
        `least_likeness`: correlation of a sheet's mean profile, over 0.6 ridge widths on either side of its
        positions, with that of all sheets.
    """
    if x_px.shape[1] < 5:
        return np.zeros(x_px.shape[1], bool)
    half = max(3, round(min(0.6 * comb.fwhm_px, 0.5 * comb.pitch_px)))
    _, normalised, shape = _sampled_profiles(bright, x_px, half)
    own = nan_median(normalised)
    own -= own.mean(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        likeness = (shape - shape.mean()) @ own / np.linalg.norm(own, axis=0) / np.std(shape)
    return np.asarray(likeness / np.sqrt(len(shape)) < settings.least_likeness, bool)


def _sampled_profiles(bright: Floats32, x_px: Floats, half: int) -> tuple[Floats, Floats, Floats]:
    """Return the pixels at offsets u from the positions in some frames, (frame, u, N), the same with mean 0
    and standard deviation 1, and the median of the latter over all sheets and frames, (u,)."""
    sample = np.unique(np.linspace(0, len(bright) - 1, 200).astype(int))
    around = _around(bright[sample], x_px[sample], half)
    level = around - around.mean(axis=1, keepdims=True)
    level /= level.std(axis=1, keepdims=True)
    return around, level, nan_median(level.swapaxes(1, 2).reshape(-1, level.shape[1]))


def distortion(
    bright: Floats32,
    x_px: Floats,
    err_px: Floats,
    blurred: Bools,
    comb: RidgeComb,
    settings: TrackingSettings = DEFAULT,
) -> Floats:
    r"""Return how far dirt, a highlight or an edge may shift each position, px, (frame, N); 0 without a sign.

    Parameters
    ----------
    bright
        Profile with bright ridges (frame, x).
    x_px, err_px
        Positions and their errors from noise (frame, N), NaN where missing.
    blurred
        Ridges blurred by motion (frame, N), which are lopsided for that reason: 0.
    comb
        Width and pitch of the ridges.
    settings
        The fields `distortion_…` and `lopsided`.

    Notes
    -----
    The comb's mean shape :math:`S` is fitted to the pixels around each position with level a, height b and
    shift s; r is the residual:

    .. math:: I(x + u) = a + b\,(S(u) - s\,S'(u)) + r(u) .

    Two quantities indicate an error. The first is the change of s if a slope of the background is fitted as
    well; it shows light that varies over the window. The second is the residual over the shape's slope,
    :math:`\langle r^2 \rangle^{1/2} / (b\,\langle S'^2 \rangle^{1/2})`; it shows narrower disturbances, which
    shift the ridge by about as much. Only the odd part of the residual counts, since differences of width
    move nothing. Each quantity has a part that lasts, the sheet's mean, which is compared with that of
    the other sheets, and a part that varies from frame to frame, less what all sheets of a frame share (blur,
    exposure).

    Four cases need care. Where ridges overlap, narrow ridges between broad ones have a sloping background: a
    mean residual then counts only if the sheet's slope is far beyond the others', or if the residual remains
    once the slope is fitted. Where all ridges are lopsided, mean residuals are not used. Where s usually
    changes by far more than noise explains, something moves over the whole comb (such as its own reflection),
    and the usual change is an error, too. Light that falls off over a ridge does not change its shape; it
    shows in the heights (`_shift_by_light`).
    """
    if comb.fwhm_px < settings.distortion_least_px:
        return np.zeros_like(x_px)
    half = max(3, round(min(0.9 * comb.fwhm_px, 0.5 * comb.pitch_px)))
    around, _, shape = _sampled_profiles(bright, x_px, half)
    if not np.isfinite(shape).all():
        return np.zeros_like(x_px)
    fit_matrix = _fit_matrix(shape)
    mean_residual = nan_median(_fit_shape(around, fit_matrix).residual)  # of each sheet, (u // 2, N)
    mean_with_slope = nan_median(_residual_with_slope(around, shape))
    height, change, varying = np.empty((3, *x_px.shape))

    def fit(rows: slice) -> None:
        height[rows], change[rows], residual = _fit_shape(_around(bright[rows], x_px[rows], half), fit_matrix)
        residual -= mean_residual
        residual -= nan_median(residual, axis=2)[..., None]
        varying[rows] = _odd_rms(residual)

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(fit, (slice(i, i + FRAMES_PER_BLOCK) for i in range(0, len(bright), FRAMES_PER_BLOCK))))
    floor, times = settings.distortion_floor, settings.distortion_residual
    shift, lasting_slope = _shift_by_slope(change, err_px, _change_noise(shape), settings)
    height[blurred] = np.nan
    shift = np.fmax(shift, _shift_by_light(x_px, height, comb, settings))
    residual = _if_above(varying, np.fmax(times * nan_median(varying), floor))
    residual += _lasting_residual(mean_residual, mean_with_slope, lasting_slope > 0, comb, settings)
    size = np.hypot(shift, settings.distortion_error * residual)
    return np.where(np.isfinite(change) & ~blurred, size, 0.0)  # unknown too near the picture's edge


def _shift_by_slope(
    change: Floats, err_px: Floats, noise: float, settings: TrackingSettings
) -> tuple[Floats, Floats]:
    """Return unusual shifts due to a sloping background, px, (frame, N), and their lasting part, (N,).

    change: of the shift if a slope is fitted, px, (frame, N). noise: its noise over that of the position.
    """
    floor, sigmas = settings.distortion_floor, settings.distortion_sigmas
    usual = nan_median(change)
    off = np.abs(change - usual)
    usual_off = float(nan_median((off / err_px).ravel())) / NORMAL_MEDIAN
    everywhere = usual_off > settings.distortion_everywhere * noise
    within = (0.0 if everywhere else usual_off) * err_px
    apart = np.abs(usual - nan_median(usual))
    between = nan_median(apart) / NORMAL_MEDIAN
    lasting = _if_above(apart, np.fmax(sigmas * between, floor))
    shift = _if_above(off, np.fmax(sigmas * within, floor)) + lasting
    return (np.fmax(shift, usual_off * err_px) if everywhere else shift), lasting


def _lasting_residual(
    mean: Floats, mean_with_slope: Floats, sloping: Bools, comb: RidgeComb, settings: TrackingSettings
) -> Floats:
    """Return the mean residuals of sheets that differ from the others, px, (N,); 0 for the others.

    mean, mean_with_slope: mean residuals without and with a slope fitted, (u // 2, N). sloping: sheets whose
    slope is far beyond that of the others, (N,).
    """
    odd, odd_with_slope = (
        np.sqrt(2) * _odd_rms(part - nan_median(part, axis=1)[:, None]) for part in (mean, mean_with_slope)
    )
    if not nan_median(odd) < settings.lopsided:
        return np.zeros_like(odd)
    overlap = comb.fwhm_px > settings.overlapping * comb.pitch_px
    size = odd_with_slope if overlap else odd
    unusual = size > np.fmax(settings.distortion_residual * nan_median(size), settings.distortion_floor)
    return np.asarray(odd * (unusual | (sloping & overlap)), np.float64)


def _if_above(size: Floats, least: Floats) -> Floats:
    """Return sizes that exceed `least`, and 0 for the others."""
    return np.where(size > least, size, 0.0)


def _around(bright: Floats32, x_px: Floats, half: int) -> Floats:
    """Return grey levels at whole pixels from each position, (frame, u, N), by cubics through four pixels."""
    frames, sheets = x_px.shape
    left = np.floor(np.nan_to_num(x_px, nan=-10.0 * half)).astype(np.int64)
    starts = Starts(np.repeat(np.arange(frames), sheets), left.ravel())
    pixels = gather(bright, starts, np.arange(-half - 1, half + 3))
    pixels = pixels.reshape(frames, sheets, -1).swapaxes(1, 2).copy()
    t = (x_px - left)[:, None]
    weights = (
        -t * (t - 1) * (t - 2) / 6,
        (t + 1) * (t - 1) * (t - 2) / 2,
        -(t + 1) * t * (t - 2) / 2,
        (t + 1) * t * (t - 1) / 6,
    )
    width = 2 * half + 1
    around = weights[0] * pixels[:, :width]
    for i in (1, 2, 3):
        around += weights[i] * pixels[:, i : i + width]
    return np.asarray(around, np.float64)


def _bases(shape: Floats) -> tuple[Floats, Floats]:
    """Return the basis of the fit: level, shape and its slope, (u, 3); with a sloping background, (u, 4)."""
    level_background = np.stack([np.ones_like(shape), shape, np.gradient(shape)], axis=1)
    return level_background, np.column_stack([level_background, np.arange(len(shape)) - len(shape) // 2])


def _change_noise(shape: Floats) -> float:
    """Return the noise of `_ShapeFit.change` over the noise of the shift itself."""
    shift, with_slope = (np.linalg.pinv(basis)[2] for basis in _bases(shape))
    return float(np.linalg.norm(with_slope - shift) / np.linalg.norm(shift))


class _ShapeFit(NamedTuple):
    """Fit of the mean shape to pixels (frame, u, N).

    Parameters
    ----------
    height
        Height of the ridge, grey levels (frame, N).
    change
        Change of the shift if a slope is fitted as well, px, (frame, N).
    residual
        Odd part of the residual over the shape's slope, px: the left half, (frame, u // 2, N). The right half
        is its negative.
    """

    height: Floats
    change: Floats
    residual: Floats


def _fit_matrix(shape: Floats) -> Floats:
    """Return the matrix that takes pixels to the fit, which is linear in them.

    Its rows give height and shift without a slope, both with a slope, and the odd residual.
    """
    level_background, sloping = _bases(shape)
    first, second = np.linalg.pinv(level_background), np.linalg.pinv(sloping)
    return np.concatenate([first[1:3], second[1:3], _odd_residual(level_background, first)])


def _fit_shape(pixels: Floats, fit_matrix: Floats) -> _ShapeFit:
    """Apply the matrix from `_fit_matrix` to pixels."""
    found = fit_matrix @ pixels
    height, shift, height_with_slope, shift_with_slope = (found[:, k] for k in range(4))
    with np.errstate(divide="ignore", invalid="ignore"):
        change = shift_with_slope / height_with_slope - shift / height
        return _ShapeFit(height, change, found[:, 4:] / height[:, None])


def _residual_with_slope(pixels: Floats, shape: Floats) -> Floats:
    """Return the residual as in `_ShapeFit`, but with a slope fitted as well."""
    basis = _bases(shape)[1]
    fit = np.linalg.pinv(basis)
    found = np.concatenate([fit[1:2], _odd_residual(basis, fit)]) @ pixels
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(found[:, 1:] / found[:, :1], np.float64)


def _odd_residual(basis: Floats, fit: NDArray[np.floating]) -> Floats:
    """Return the matrix from pixels to the left half of their residual's odd part, over the shape's slope."""
    residual = np.eye(len(basis)) - basis @ fit
    odd = (residual - residual[::-1])[: len(basis) // 2]
    return np.asarray(odd / np.sqrt(2 * (basis[:, 2] ** 2).mean()), np.float64)


def _odd_rms(left_half: Floats) -> Floats:
    """Return the root mean square over u of an odd function of u, from its left half (…, u // 2, N)."""
    return np.asarray(np.sqrt((left_half**2).sum(axis=-2) / (left_half.shape[-2] + 0.5)), np.float64)


def _shift_by_light(
    x_px: Floats, height: Floats, comb: RidgeComb, settings: TrackingSettings = DEFAULT
) -> Floats:
    r"""Return the shift of each ridge due to light L that falls off over it, px, (frame, N); 0 where usual.

    A Gaussian in such light remains a Gaussian, shifted by :math:`\sigma_r^2 L'/L`, so that only heights
    reveal the shift. Stationary changes of light (dirt) show as a slope of L along the path of a sheet that
    is the same in both halves of the film. Moving ones (the edge of a shadow) show as a slope that three
    adjacent sheets share in a frame; it is doubled, as an edge is steeper in its middle than from sheet to
    sheet.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        light = np.log(np.where(height > 0, height, np.nan))
    light -= nan_median(light)
    light -= nan_median(light, axis=1)[:, None]  # exposure
    step = np.pad(
        np.diff(light, axis=1) / np.diff(nan_median(x_px)), ((0, 0), (1, 1)), constant_values=np.nan
    )
    left, right = step[:, :-1], step[:, 1:]
    across = 2 * np.fmin(np.abs(left), np.abs(right))
    early = np.arange(len(light))[:, None] < len(light) / 2
    halves = [
        _slope_along(x_px, np.where(half, light, np.nan), comb.fwhm_px / 5, settings)
        for half in (early, ~early)
    ]
    along = np.minimum(*(np.abs(slope - nan_median(slope)) for slope in halves))
    limits = settings.distortion_sigmas, settings.distortion_floor
    variance = (comb.fwhm_px / FWHM) ** 2
    stationary = _unusual(variance * along, *limits)
    moving = _unusual(variance * across, *limits)
    return np.fmax(stationary, np.where(left * right > 0, moving, 0.0))


def shift_by_moving_light(
    x_px: Floats, contrast: Floats, comb: RidgeComb, settings: TrackingSettings = DEFAULT
) -> Floats:
    r"""Return the shift of all ridges due to light whose slope over the comb changes, px, (frame, 1).

    A slope of the light L shifts a Gaussian by :math:`\sigma_r^2 L'/L`. The slope is measured from the
    heights of sheets half a comb apart, relative to their usual heights. The shift is doubled, as the light
    between the ridges slopes, too. 0 for fewer than four sheets.
    """
    half = x_px.shape[1] // 2
    if half < 2:
        return np.zeros((len(x_px), 1))
    light = np.log(np.where(contrast > 0, contrast, np.nan))
    slope = (light[:, half:] - light[:, :-half]) / (x_px[:, half:] - x_px[:, :-half])
    slope -= nan_median(slope)
    common = nan_median(slope, axis=1)
    scatter = nan_median(np.abs(slope - common[:, None]), axis=1) / NORMAL_MEDIAN
    # objects that cover some sheets make no common slope
    error = 1.25 * scatter / np.sqrt(slope.shape[1])
    seen = np.abs(common) > settings.distortion_sigmas * error
    return np.where(seen, 2 * (comb.fwhm_px / FWHM) ** 2 * np.abs(common), 0.0)[:, None]


def _unusual(size: Floats, times: float, floor: float) -> Floats:
    """Return sizes that exceed the floor and `times` their median, and 0 for the others."""
    return _if_above(size, np.fmax(times * nan_median(size.ravel()), floor))


def _slope_along(x_px: Floats, values: Floats, step_px: float, settings: TrackingSettings) -> Floats:
    """Return the slope of values against each sheet's position, at its position in every frame, (frame, N).

    Values are averaged (median) over steps in position. The slope is the mean of the slopes to the next steps
    on both sides, or that to one of them. A slope within its noise is 0; NaN where both steps are empty.
    """
    known = np.isfinite(x_px) & np.isfinite(values)
    step = np.floor(np.nan_to_num(x_px - nan_quantile(x_px, 0.0)) / step_px).astype(np.int64)
    columns = int(step.max(initial=0)) + 2
    cell = 1 + step + columns * np.arange(x_px.shape[1])
    count = np.bincount(cell[known], minlength=1 + columns * x_px.shape[1])
    ordered = np.append(values[known][np.lexsort((values[known], cell[known]))], np.nan)
    middle = np.where(count > 0, ordered[np.cumsum(count) - count + count // 2], np.nan)
    within = nan_median(np.abs(values - middle[cell])) / NORMAL_MEDIAN  # of each sheet
    slope = np.diff(middle)
    known_in = np.maximum(count, 1)
    noise = settings.distortion_sigmas * np.sqrt(1 / known_in[1:] + 1 / known_in[:-1])
    sides = [
        np.where(np.abs(slope[at]) > noise[at] * within, slope[at] / step_px, 0.0 * slope[at])
        for at in (cell - 1, cell)
    ]
    return nan_median(np.stack(sides))
