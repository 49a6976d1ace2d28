"""Errors of ridges distorted by specks, reflections, the edge of a hand or uneven light.

`distortion` estimates the error from each ridge's shape and height. `not_one_ridge` finds ridges of several.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from vision.numeric import FWHM, NORMAL_MEDIAN, Bools, Floats, Floats32, nan_median
from vision.sheets.ridges import FRAMES_PER_BLOCK, RidgeComb
from vision.sheets.settings import TrackingSettings
from vision.sheets.subpixel import Starts, gather, position_noise

ENOUGH = 5  # sheets of which neighbours show what is usual; ridges of fewer are checked at any width


def not_one_ridge(bright: Floats32, x_px: Floats, comb: RidgeComb) -> Bools:
    """Return which sheets are not a single ridge, (N,): their mean profile differs from the comb's.

    Several sheets side by side, far thinner than most, appear as one hump to the search for ridges, and the
    position lies between them. A sheet's mean profile, over 0.6 ridge widths on either side of its positions
    x_px (frame, N), correlates with that of all sheets by less than `least_likeness`. Always False for fewer
    than five sheets.
    """
    if x_px.shape[1] < ENOUGH:
        return np.zeros(x_px.shape[1], bool)
    half = max(3, round(min(0.6 * comb.fwhm_px, 0.5 * comb.pitch_px)))
    profiles, shape = _sampled_profiles(bright, x_px, half)
    own = nan_median(profiles)
    own -= own.mean(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        likeness = (shape - shape.mean()) @ own / np.linalg.norm(own, axis=0) / np.std(shape)
    return np.asarray(likeness / np.sqrt(len(shape)) < comb.settings.least_likeness, bool)


def _sampled_profiles(bright: Floats32, x_px: Floats, half: int) -> tuple[Floats, Floats]:
    """Return the pixels at offsets u from the positions in some frames, with mean 0 and standard deviation 1,
    (frame, u, N), and their median over all sheets and frames, (u,)."""
    sample = np.unique(np.linspace(0, len(bright) - 1, 200).astype(int))
    level = _around(bright[sample], x_px[sample], half)
    level -= level.mean(axis=1, keepdims=True)
    level /= level.std(axis=1, keepdims=True)
    return level, nan_median(level.swapaxes(1, 2).reshape(-1, level.shape[1]))


def distortion(
    bright: Floats32, x_px: Floats, err_px: Floats, blurred: Bools, comb: RidgeComb
) -> tuple[Floats, Floats]:
    r"""Return how far dirt, reflections, neighbours or light may shift positions, px.

    The first result is the error of each displacement, (frame, N), 0 without a sign; the second how far each
    sheet is usually pulled aside, compared with the other sheets, (N,). x_px, err_px: positions and their
    errors from noise (frame, N), NaN where missing. Ridges blurred by motion (frame, N) are lopsided for that
    reason and have 0.

    The comb's mean shape :math:`S` is fitted to the pixels around each position with level a, height b and
    shift s:

    .. math:: I(x + u) = a + b\,(S(u) - s\,S'(u)) .

    It is fitted three times: over the whole ridge, over its top alone, and over the whole ridge with a slope
    of the background. Whatever is not a shift of the ridge shifts these fits by different amounts. The
    differences from the first fit, times `_error_over`, are the error where they exceed their noise
    (`_significant`). The mean difference of a sheet shifts all its positions alike, and is no error of
    displacements.

    Light that falls off over a ridge hardly changes its shape; it shows in the heights (`_shift_by_light`).
    """
    settings = comb.settings
    none = np.zeros_like(x_px), np.zeros(x_px.shape[1])
    narrow = comb.fwhm_px < settings.distortion_least_px
    if narrow and x_px.shape[1] >= ENOUGH:
        return none
    half = max(3, round(min(0.9 * comb.fwhm_px, 0.5 * comb.pitch_px)))
    shape = _sampled_profiles(bright, x_px, half)[1]
    if not np.isfinite(shape).all():
        return none
    fits = _fit_matrix(shape, min(max(2, round(0.5 * comb.fwhm_px)), half - 1))
    height, apart, sloping = np.empty((3, *x_px.shape))

    def fit(rows: slice) -> None:
        found = fits @ _around(bright[rows], x_px[rows], half)
        with np.errstate(divide="ignore", invalid="ignore"):
            shift = found[:, 1::2] / found[:, ::2]
        height[rows] = found[:, 0]
        apart[rows], sloping[rows] = shift[:, 1] - shift[:, 0], shift[:, 2] - shift[:, 0]

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(fit, (slice(i, i + FRAMES_PER_BLOCK) for i in range(0, len(bright), FRAMES_PER_BLOCK))))
    height[blurred], apart[blurred], sloping[blurred] = np.nan, np.nan, np.nan
    size = _shift_by_light(x_px, height, comb)
    for differs, usual, k in (
        (apart, settings.distortion_error, 3),
        (sloping, settings.distortion_slope, 5),
    ):
        noise = err_px * float(np.linalg.norm(fits[k] - fits[1]) / np.linalg.norm(fits[1]))
        seen = _significant(differs - nan_median(differs), noise, settings)
        size = np.fmax(size, _error_over(differs, usual, x_px, settings) * seen)
    size = np.minimum(size, comb.fwhm_px)  # what is fitted lies within the ridge
    pull = nan_median(apart)
    pull = np.abs(pull - nan_median(pull))
    least = np.fmax(settings.distortion_sigmas * nan_median(pull) / NORMAL_MEDIAN, settings.distortion_floor)
    lasting = settings.distortion_error * _if_above(pull, least)
    return np.where(np.isfinite(apart), size, 0.0), none[1] if narrow else lasting


def _fit_matrix(shape: Floats, top: int) -> Floats:
    """Return the matrix from pixels to height and shift of the mean shape, (6, u): fitted to all pixels, to
    those up to `top` from the middle, and to all with a sloping background."""
    basis = np.stack([np.ones_like(shape), shape, np.gradient(shape)], axis=1)
    inner = slice(len(shape) // 2 - top, len(shape) // 2 + top + 1)
    fits = np.zeros((6, len(shape)))
    fits[:2] = np.linalg.pinv(basis)[1:]
    fits[2:4, inner] = np.linalg.pinv(basis[inner])[1:]
    fits[4:] = np.linalg.pinv(np.column_stack([basis, np.arange(len(shape)) - len(shape) // 2]))[1:3]
    return fits


def _error_over(values: Floats, usual: float, x_px: Floats, settings: TrackingSettings) -> float:
    r"""Return the error of a position over the size of `values` (frame, N): `usual`, or what the film shows.

    Where a distortion changes, position and value change together. Changes over `distortion_frames` are taken
    relative to both neighbours, and k is the median of their ratios, weighted by the change of the value, so
    that slips do not enter. With q the share by which they change in the same direction more often than in
    opposite ones, the result is :math:`\sqrt{q k^2 + (1 - q^2) u^2}`, u being the usual one.
    """

    def change(of: Floats) -> Floats:
        mean = _mean_over(of, settings.distortion_frames)
        relative = mean[:, 1:-1] - (mean[:, :-2] + mean[:, 2:]) / 2
        return relative[settings.distortion_frames :] - relative[: -settings.distortion_frames]

    moved, changed = change(x_px), change(values)
    weight = np.where(np.isfinite(moved * changed), np.abs(changed), 0.0)
    known, total = weight > 0, weight.sum(axis=0)
    if not known.any():
        return usual
    along = np.where(known, np.copysign(weight, moved * changed), 0.0).sum(axis=0)
    share = abs(float(np.mean(along[total > 0] / total[total > 0])))
    ratio, weight = moved[known] / changed[known], weight[known]
    order = np.argsort(ratio)
    median = ratio[order][np.searchsorted(np.cumsum(weight[order]), weight.sum() / 2)]
    return float(np.sqrt(share * median**2 + (1 - share**2) * usual**2))


def _significant(values: Floats, noise: Floats, settings: TrackingSettings) -> Floats:
    """Return the size of values (frame, N) in a frame, over some frames, or usually; 0 where it is noise.

    The largest of three significant sizes counts: the value itself, the mean over `distortion_frames` around
    it, and the usual size of that mean in the whole film. noise: standard deviation of a single value,
    (frame, N), independent from frame to frame.
    """
    frames = settings.distortion_frames
    single, mean = np.abs(values), np.abs(_mean_over(values, frames))
    noise = np.fmax(noise, position_noise(values))  # also where tops are clipped, or a codec adds its own
    noise_of_mean = noise / np.sqrt(frames)
    usual, usual_noise = nan_median(mean) / NORMAL_MEDIAN, nan_median(noise_of_mean)
    chance = 1 + 2 * np.sqrt(2 * frames / len(values))  # of so many means of noise
    excess = np.sqrt(np.where(usual**2 > chance * usual_noise**2, np.abs(usual**2 - usual_noise**2), 0.0))
    above = _if_above(single, settings.distortion_sigmas * noise)
    return np.fmax(excess, np.fmax(above, _if_above(mean, settings.distortion_sigmas * noise_of_mean)))


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


def _shift_by_light(x_px: Floats, height: Floats, comb: RidgeComb) -> Floats:
    r"""Return the shift of each ridge due to light L that falls off over it, px, (frame, N).

    A Gaussian in such light remains a Gaussian, shifted by :math:`\sigma_r^2 L'/L`, so that only heights
    reveal the shift. A lamp that moves, or the edge of a shadow, shows as a slope between a sheet and its
    neighbours on both sides, beyond the scatter of single sheets. Fewer than five sheets do not show that
    scatter: every change of the slope between two sheets, beyond its noise in time, then counts as light.
    """
    settings = comb.settings
    with np.errstate(divide="ignore", invalid="ignore"):
        light = np.log(np.where(height > 0, height, np.nan))
    light -= nan_median(light)
    light -= nan_median(light, axis=1)[:, None]  # exposure
    if light.shape[1] >= ENOUGH:
        means = (_mean_over(light, frames) for frames in (1, settings.distortion_frames))
        across = [_slope_across(mean, x_px, settings) for mean in means]
    else:
        with np.errstate(divide="ignore", invalid="ignore"):
            slope = np.diff(light, axis=1) / np.diff(nan_median(x_px))
        slope = _significant(slope, np.zeros_like(slope), settings)
        across = [np.pad(slope, ((0, 0), (1, 0))), np.pad(slope, ((0, 0), (0, 1)))]
    return settings.distortion_light * (comb.fwhm_px / FWHM) ** 2 * np.fmax(*across)


def _slope_across(light: Floats, x_px: Floats, settings: TrackingSettings) -> Floats:
    """Return the slope of the light from sheet to sheet, per px, (frame, N); 0 where it is scatter.

    It is the smaller of the slopes to both neighbours if these have the same sign, and its scatter is that of
    single sheets against the mean of their neighbours. The first and last sheet have that of their neighbour.
    """
    apart = np.diff(nan_median(x_px))
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = np.diff(light, axis=1) / np.where(apart > 0, apart, np.nan)
    bend = light[:, 1:-1] - (light[:, :-2] + light[:, 2:]) / 2
    scatter = float(nan_median(np.abs(bend).ravel())) / NORMAL_MEDIAN / np.sqrt(1.5)
    left, right = slope[:, :-1], slope[:, 1:]
    smaller = np.where(left * right > 0, np.fmin(np.abs(left), np.abs(right)), 0.0)
    found = _if_above(smaller, settings.distortion_sigmas * np.sqrt(2) * scatter / float(nan_median(apart)))
    return np.pad(found, ((0, 0), (1, 1)), "edge")


def _mean_over(values: Floats, frames: int) -> Floats:
    """Return the mean of values (frame, N) over the `frames` frames around each, NaN where the value is."""
    known = np.isfinite(values)
    at = np.arange(len(values))
    first, last = np.maximum(at - frames // 2, 0), np.minimum(at + frames // 2 + 1, len(values))
    total, count = (
        np.cumsum(np.pad(part, ((1, 0), (0, 0))), axis=0)
        for part in (np.where(known, values, 0.0), known.astype(np.float64))
    )
    total, count = total[last] - total[first], count[last] - count[first]
    return np.where(known, total / np.maximum(count, 1), np.nan)
