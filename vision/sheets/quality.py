"""Effects of the recording on positions, beyond pixel noise.

`repeated_frames` finds frames that the codec or the recorder repeated, and `motion_blur` ridges that moved
while the shutter was open. `distortion` estimates the error of ridges distorted by specks, reflections, the
edge of a hand or uneven light, and `not_one_ridge` finds ridges of several sheets. `scene_changes` finds
where the picture changes permanently. `spatial_scatter` measures errors that persist from frame to frame,
`shared_error` those that neighbours share, and `noise_excess` what all stated errors leave out.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import reduce
from typing import NamedTuple, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.numeric import (
    NORMAL_MEDIAN,
    Bools,
    Floats,
    Floats32,
    median_of_all,
    nan_median,
    nan_quantile,
    row_parts,
    weighted_median,
)
from vision.sheets.ridges import FRAMES_PER_BLOCK, RidgeComb, in_blocks, profile_noise
from vision.sheets.settings import DEFAULT, TrackingSettings
from vision.sheets.subpixel import Starts, gather, position_noise
from vision.sheets.vibration import own_vibration
from vision.signals import running_median

FOURTH = np.array([1.0, -4.0, 6.0, -4.0, 1.0])
LEAST_FRAMES = 8
NEIGHBOURHOOD = 5  # sheets whose shapes change alike as they creep
ENOUGH = 5  # sheets of which neighbours show what is usual; ridges of fewer are checked at any width
BLUR_FRAMES = 2  # before and after a blurred one: two may show the same one of two images
LIGHT_FRAMES = 5  # before and after, in at least one of which a ridge is as high as its light permits
SCENE_FRAMES = 5  # compared before and after a change of scene
OPENING = 10  # sheets that show the opening of the comb
NOISE_LAGS = range(2, 9)  # frames: an error that repeats itself vanishes at some of them
FITTED = {True: 3.0, False: 1.25}  # sheets whose scatter medians of a line, or of a level, remove
ONE_SIGMA = 0.6827  # share of values that lie within one standard deviation
LAGS = {True: (12, 8, 6, 4, 3, 2, 1), False: (4, 3, 2, 1)}
"""Lags, in frames, of second differences in time, for codecs that predict frames from others (True) and for
all others. Content that a codec keeps unchanged shows at longer lags; but so do bent creep and the individual
motion of sheets, and stick phases must be longer than two lags."""


# --- frames and blur ----------------------------------------------------------------------------------------


def repeated_frames(profile: Floats32, settings: TrackingSettings = DEFAULT) -> Bools:
    """Return which frames of a profile (frame, x) repeat the strip of the frame before, (frame,).

    The measure is the root mean square change from the frame before. Noise alone makes frames differ by √2 of
    its standard deviation, within a few per cent. A frame is repeated if its change is less than noise and is
    separated by a clear gap from the changes of the other quiet frames (the quietest tenth). Without such a
    gap no frame is repeated: under vibration, frames near a turning point also change by less than most.
    """
    change = np.empty(max(0, len(profile) - 1))
    for start in range(0, len(change), FRAMES_PER_BLOCK):
        step = np.diff(profile[start : start + FRAMES_PER_BLOCK + 1], axis=0)
        change[start : start + len(step)] = np.sqrt(np.square(step).mean(axis=1, dtype=np.float64))
    moving = change[np.isfinite(change) & (change > 0)]
    frozen = np.zeros(len(profile), bool)
    # in a film without noise, or of a still scene, nothing shows that a frame should have changed
    if moving.size >= max(LEAST_FRAMES, settings.least_changing * len(change)):
        quiet = np.sort(change[change <= np.quantile(moving, 0.1)])
        gaps = np.flatnonzero(quiet[:-1] < settings.frozen_fraction * quiet[1:])
        if gaps.size:
            known = np.flatnonzero(np.isfinite(change))
            some = known[np.linspace(0, len(known) - 1, 200).astype(int)]
            frozen[1:] = change <= min(quiet[gaps[-1]], np.sqrt(2) * profile_noise(profile[some]))
    return frozen


def motion_blur(x_px: Floats, contrast: Floats32, fwhm_px: Floats32, comb: RidgeComb) -> tuple[Bools, Floats]:
    r"""Return whether each ridge moved during the exposure, and how far this may shift it, px; (frame, N).

    x_px, contrast, fwhm_px: position, height and width of the ridges (frame, N), NaN where missing.

    A ridge that jumps by D after a fraction p of the exposure appears twice, with heights p and 1 − p. The
    fit follows the higher image. Its error is up to :math:`\min(p, 1-p)\,D`: the loss of height times the
    motion over `BLUR_FRAMES` frames before and after. It is smaller where both images merge into one wider
    ridge. A ridge is blurred if it moved by more than a fraction of its width and is wider or lower than
    usual by more than its scatter. A ridge that is low in all of several frames is in a shadow.

    All sheets of a frame have the same p. Hence a sheet that moved by more than half its width has at least
    the signs of most such sheets: its own may be hidden by a background that varies, or, after a jump of
    about one pitch, by the image of its neighbour, which fills the gap that its own leaves.
    """
    settings = comb.settings
    fast = np.zeros(x_px.shape, bool)
    moved, excess, loss = (np.empty(x_px.shape) for _ in range(3))
    sampled = 0.7 / comb.fwhm_px**2  # height that a ridge between two pixels loses
    for n, x in enumerate(x_px.T):
        near = _frames_around(x, BLUR_FRAMES)
        step = np.nan_to_num(reduce(np.fmax, near) - reduce(np.fmin, near))
        lower, wider = -np.log(contrast[:, n].astype(np.float64)), np.log(fwhm_px[:, n].astype(np.float64))
        lower = lower - np.fmax(nan_median(lower), reduce(np.fmin, _frames_around(lower, LIGHT_FRAMES)))
        fast[:, n] = (step > settings.blur_fraction * comb.fwhm_px) & np.isfinite(x)
        moved[:, n] = step
        excess[:, n] = np.maximum(_excess(lower, sampled), _excess(wider, sampled))
        loss[:, n] = np.clip(1 - np.exp(-np.nan_to_num(lower)), 0.0, 0.5)
    blurred, err = np.empty_like(fast), moved
    for rows in row_parts(len(x_px)):
        blurred[rows], err[rows] = _blurred(moved[rows], fast[rows], excess[rows], loss[rows], comb)
    return blurred, err


def _blurred(
    moved: Floats, fast: Bools, excess: Floats, loss: Floats, comb: RidgeComb
) -> tuple[Bools, Floats]:
    """Return which ridges of some frames are blurred, and how far this may shift them, px; (frame, N).

    moved: motion over `BLUR_FRAMES` frames before and after, px. fast: whether it may blur. excess, loss: the
    signs of each sheet itself, to which those of the frame are added here.
    """
    settings = comb.settings
    apart = moved / comb.fwhm_px
    pitches = np.maximum(np.rint(moved / comb.pitch_px), 1.0)
    overlapping = np.abs(moved - pitches * comb.pitch_px) < settings.blur_overlap * comb.fwhm_px
    informative = fast & ~overlapping & (apart > 0.5)
    for sign, share in ((excess, 0.5), (loss, 0.75)):
        of_frame = nan_quantile(np.where(informative, sign, np.nan), share, axis=1)[:, None]
        np.copyto(sign, np.fmax(sign, of_frame), where=informative | (fast & overlapping))
    suspect = fast & (excess > 0.5 * settings.blur_sigmas)  # not flagged, but with a larger error
    merged = np.minimum(0.8, apart)  # images nearer than a width merge, and the fit finds their middle
    err = np.where(suspect, settings.blur_error * loss * moved * merged, 0.0)
    return fast & (excess > settings.blur_sigmas), err


def _frames_around(values: Floats, frames: int) -> list[Floats]:
    """Return values (frame,) of each frame before, at and after every frame, up to so many frames away."""
    padded = np.pad(values, frames, constant_values=np.nan)
    return [padded[k : k + len(values)] for k in range(2 * frames + 1)]


def _excess(values: Floats, least: float) -> Floats:
    """Return how far values of a sheet (frame,) exceed their median plus `least`, in standard deviations."""
    off = values - nan_median(values)
    spread = nan_median(np.abs(off)) / NORMAL_MEDIAN
    return np.nan_to_num(np.maximum(off - least, 0.0) / np.maximum(spread, 0.004))


# --- distorted ridges ---------------------------------------------------------------------------------------


def not_one_ridge(profile: Floats32, x_px: Floats, comb: RidgeComb) -> Bools:
    """Return which sheets are not a single ridge, (N,): their mean profile differs from the comb's.

    Several sheets side by side, far thinner than most, appear as one hump to the search for ridges, and the
    position lies between them. A sheet's mean profile, over 0.6 ridge widths on either side of its positions
    x_px (frame, N), correlates with that of all sheets by less than `least_likeness`. Always False for fewer
    than five sheets.
    """
    if x_px.shape[1] < ENOUGH:
        return np.zeros(x_px.shape[1], bool)
    half = max(3, round(min(0.6 * comb.fwhm_px, 0.5 * comb.pitch_px)))
    profiles, shape = _sampled_profiles(profile, x_px, half, comb)
    own = nan_median(profiles)
    own -= own.mean(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        likeness = (shape - shape.mean()) @ own / np.linalg.norm(own, axis=0) / np.std(shape)
    return np.asarray(likeness / np.sqrt(len(shape)) < comb.settings.least_likeness, bool)


def _sampled_profiles(profile: Floats32, x_px: Floats, half: int, comb: RidgeComb) -> tuple[Floats, Floats]:
    """Return the pixels at offsets u from the positions in some frames, with mean 0 and standard deviation 1,
    (frame, u, N), and their median over all sheets and frames, (u,)."""
    sample = np.unique(np.linspace(0, len(profile) - 1, 200).astype(int))
    level = _around(comb.bright(profile[sample]), x_px[sample], half)
    level -= level.mean(axis=1, keepdims=True)
    level /= level.std(axis=1, keepdims=True)
    return level, nan_median(level.swapaxes(1, 2).reshape(-1, level.shape[1]))


class Distortion(NamedTuple):
    """Error of each displacement, px, (frame, N), 0 without a sign; the usual distortion of each sheet,
    slight signs included, px, (N,); how far each is pulled aside in all frames, against the others, px, (N,);
    and the relative error of its displacements, (N,)."""

    error_px: Floats
    usual_px: Floats
    lasting_px: Floats
    scale: Floats

    @classmethod
    def none(cls, x_px: Floats) -> Self:
        """Return that of positions (frame, N) without any."""
        return cls(np.zeros(x_px.shape), *np.zeros((3, x_px.shape[1])))


def distortion(
    profile: Floats32, x_px: Floats, err_px: Floats, blurred: Bools, comb: RidgeComb
) -> Distortion:
    r"""Return how far dirt, reflections, neighbours or light may shift positions.

    x_px, err_px: positions and their errors from noise (frame, N), NaN where missing. Ridges blurred by
    motion (frame, N) are lopsided for that reason and have no error.

    The comb's mean shape :math:`S` is fitted to the pixels around each position with level a, height b and
    shift s:

    .. math:: I(x + u) = a + b\,(S(u) - s\,S'(u)) .

    It is fitted three times: over the whole ridge, over its top alone, and over the whole ridge with a slope
    of the background. Whatever is not a shift of the ridge shifts these fits by different amounts. The
    differences from the first fit, times `_error_over`, are the error where they exceed their noise
    (`_significant`): clearly, unless the film shows that positions change with them. The mean difference of a
    sheet shifts all its positions alike, and is no error of displacements.

    Light that falls off over a ridge hardly changes its shape; it shows in the heights (`_shift_by_light`).
    What stands still where a ridge moves changes all displacements of its sheet by the same factor
    (`displacement_scale_error`).
    """
    settings = comb.settings
    narrow = comb.fwhm_px < settings.distortion_least_px
    if narrow and x_px.shape[1] >= ENOUGH:
        return Distortion.none(x_px)
    half = max(3, round(min(0.9 * comb.fwhm_px, 0.5 * comb.pitch_px)))
    shape = _sampled_profiles(profile, x_px, half, comb)[1]
    if not np.isfinite(shape).all():
        return Distortion.none(x_px)
    fits = _fit_matrix(shape, min(max(2, round(0.5 * comb.fwhm_px)), half - 1))
    away = np.arange(-half, half + 1)
    height, apart, sloping, pulled_px2 = (np.empty(x_px.shape) for _ in range(4))

    def fit(rows: slice) -> None:
        around = _around(comb.bright(profile[rows]), x_px[rows], half)
        found = fits @ around
        with np.errstate(divide="ignore", invalid="ignore"):
            shift = found[:, 1::2] / found[:, ::2]
            level = around.mean(axis=1) / found[:, 0]  # in units of the height, as the mean shape has none
            pulled_px2[rows] = np.abs(fits[1] @ away * level + fits[1] @ (away * shape))
        height[rows] = found[:, 0]
        apart[rows], sloping[rows] = shift[:, 1] - shift[:, 0], shift[:, 2] - shift[:, 0]

    in_blocks(fit, len(profile))
    height[blurred], apart[blurred], sloping[blurred] = np.nan, np.nan, np.nan
    differences = [
        _Difference(
            differs,
            *_error_over(differs, usual, x_px, settings),
            float(np.linalg.norm(fits[k] - fits[1]) / np.linalg.norm(fits[1])),
        )
        for differs, usual, k in (
            (apart, settings.distortion_error, 3),
            (sloping, settings.distortion_slope, 5),
        )
    ]
    size = _shift_by_light(x_px, height, pulled_px2, settings)
    height[~(height > 0)] = np.nan
    shapes = [np.log(height, out=height), apart, sloping]
    if comb.fwhm_px > settings.overlap * comb.pitch_px:
        del shapes[1:]
    scale = displacement_scale_error(x_px, shapes, settings)
    usual_px = np.empty(x_px.shape[1])
    own_noise = [position_noise(one.px) for one in differences]
    for n, x in enumerate(x_px.T):
        found = slight = size[:, n]
        for one, own in zip(differences, own_noise, strict=True):
            values = one.px[:, n] - nan_median(one.px[:, n])
            certain, likely = _significant(values, np.fmax(one.noise * err_px[:, n], own[n]), settings)
            found = np.fmax(found, np.hypot(one.assumed * certain, one.confirmed * likely))
            slight = np.fmax(slight, np.hypot(one.assumed, one.confirmed) * likely)
        found = np.fmax(found, scale[n] * np.abs(x - nan_median(x)))
        within = np.where(np.isfinite(apart[:, n]), comb.fwhm_px, 0.0)  # what is fitted lies in the ridge
        size[:, n] = np.fmin(found, within)
        usual_px[n] = nan_median(np.fmin(slight, within))
    pull = nan_median(apart)
    pull = np.abs(pull - nan_median(pull))
    least = np.fmax(settings.distortion_sigmas * nan_median(pull) / NORMAL_MEDIAN, settings.distortion_floor)
    lasting = settings.distortion_error * _if_above(pull, least)
    return Distortion(size, usual_px, np.zeros_like(lasting) if narrow else lasting, scale)


class _Difference(NamedTuple):
    """Difference of a fit from that to the whole ridge, px, (frame, N); the error of a position over it, as
    the film shows and as assumed (`_error_over`); and its noise over that of the position."""

    px: Floats
    confirmed: float
    assumed: float
    noise: float


def displacement_scale_error(x_px: Floats, shape: Sequence[Floats], settings: TrackingSettings) -> Floats:
    r"""Return the relative error of each sheet's displacements from what stands still in the picture, (N,).

    Dirt on the lens or on the sensor changes a ridge that moves past it. Where it dims the light by a factor
    T(x), it shifts a ridge of standard deviation :math:`\sigma_r` by
    :math:`\sigma_r^2\,\mathrm{d} \ln T/\mathrm{d}x`. This shift changes as the ridge moves, so that all
    displacements of the sheet are too large or too small by the same factor. Positions alone do not show it,
    but the ridge's shape and height change with its position.

    shape: the logarithm of the height and, where flanks do not overlap, the differences between the fits of
    `distortion`, px, (frame, N). The regression of each on the position, less what neighbouring sheets share
    (paper that leans as it creeps), times `static_scale`, is the error, where it is significant. Below
    `static_floor` it is 0.
    """
    square = np.zeros(x_px.shape[1])
    for values, factor in zip(shape, settings.static_scale, strict=False):
        each = [_regression(x, y) for x, y in zip(x_px.T, values.T, strict=True)]
        slope, error2, count = np.array(each, np.float64).reshape(-1, 3).T
        slope = slope - running_median(slope, NEIGHBOURHOOD)
        found = (slope**2 > settings.distortion_sigmas**2 * error2) & (count > LEAST_FRAMES)
        square += np.where(found, factor**2 * (slope**2 - error2), 0.0)
    return _if_above(np.sqrt(square), np.full(square.shape, settings.static_floor))


def _regression(x: Floats, y: Floats) -> tuple[float, float, int]:
    """Return the slope of y over x, both (frame,), its squared error, and the number of known values."""
    known = np.isfinite(y) & np.isfinite(x)
    total = int(known.sum())
    count = max(total, 1)
    x, y = (np.where(known, v - np.where(known, v, 0.0).sum() / count, 0.0) for v in (x, y))
    spread = max(float((x**2).sum()), 1e-12)
    slope = float((x * y).sum()) / spread
    rest = y - slope * x
    power = float((rest**2).sum())
    lag1 = float((rest[1:] * rest[:-1]).sum()) / max(power, 1e-12)  # autocorrelation of the residuals
    lag1 = min(max(lag1, 0.0), 0.95)
    return slope, power / max(count - 2, 1) / spread * (1 + lag1) / (1 - lag1), count


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


def _error_over(
    values: Floats, usual: float, x_px: Floats, settings: TrackingSettings
) -> tuple[float, float]:
    r"""Return the error of a position over the size of `values` (frame, N), as the film shows and as assumed.

    Where a distortion changes, position and value change together. Changes over `distortion_frames` are taken
    relative to both neighbours, and k is the median of their ratios, weighted by the change of the value, so
    that slips do not enter. With q the share by which they change in the same direction more often than in
    opposite ones, the results are :math:`\sqrt{q}\,|k|` and :math:`\sqrt{1 - q^2}\,u`, u being the usual one.
    """

    moved, changed = (_relative_change(of, settings.distortion_frames) for of in (x_px, values))
    total, along = np.zeros((2, moved.shape[1]))
    for k, (move, change) in enumerate(zip(moved.T, changed.T, strict=True)):
        both = move * change
        weight = np.where(np.isfinite(both), np.abs(change), 0.0)
        known = weight > 0
        total[k], along[k] = weight.sum(), np.where(known, np.copysign(weight, both), 0.0).sum()
        move[:] = np.divide(move, change, where=known, out=np.full(len(move), np.nan))  # now the ratio
        change[:] = weight
    if not (changed > 0).any():
        return 0.0, usual
    share = abs(float(np.mean(along[total > 0] / total[total > 0])))
    median = weighted_median(moved.ravel(), changed.ravel())
    return float(np.sqrt(share) * abs(median)), float(np.sqrt(1 - share**2) * usual)


def _relative_change(values: Floats, frames: int) -> Floats:
    """Return changes of means over `frames` frames, relative to both neighbours, (frame − frames, N − 2)."""
    mean = mean_over(values, frames)
    change = np.empty((max(0, len(values) - frames), max(0, values.shape[1] - 2)))
    for k, column in enumerate(change.T):
        relative = mean[:, k + 1] - (mean[:, k] + mean[:, k + 2]) / 2
        column[:] = relative[frames:] - relative[:-frames]
    return change


def _significant(values: Floats, noise: Floats, settings: TrackingSettings) -> tuple[Floats, Floats]:
    """Return the size of values of a sheet (frame,) in a frame, over some frames, or usually; 0 where it is
    noise.

    The largest of three sizes counts: the value itself, the mean over `distortion_frames` around it, and the
    usual size of that mean in the whole film, if they exceed `distortion_sigmas` times their noise. In the
    second result the usual size, less noise, counts as soon as chance does not explain it. noise: standard
    deviation of a single value, (frame,), independent from frame to frame; at least that which the values
    show (`position_noise`), as tops may be clipped, and a codec adds its own.
    """
    frames = settings.distortion_frames
    single, mean = np.abs(values), np.abs(mean_over(values[:, None], frames)[:, 0])
    least = settings.distortion_sigmas * noise
    of_mean = least / np.sqrt(frames)
    above = np.fmax(_if_above(single, least), _if_above(mean, of_mean))
    usual, usual_noise = nan_median(mean) / NORMAL_MEDIAN, nan_median(noise) / np.sqrt(frames)
    chance = 1 + 2 * np.sqrt(2 * frames / len(values))  # of so many means of noise
    excess = np.sqrt(np.where(usual**2 > chance * usual_noise**2, np.abs(usual**2 - usual_noise**2), 0.0))
    certain = _if_above(usual, settings.distortion_sigmas * usual_noise)
    return np.fmax(certain, above), np.fmax(excess, above)


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


def _shift_by_light(x_px: Floats, height: Floats, pulled_px2: Floats, settings: TrackingSettings) -> Floats:
    r"""Return the shift of each ridge due to light L that falls off over it, px, (frame, N).

    pulled_px2: shift of each ridge per slope :math:`L'/L`, px², (frame, N): that of the fit of the mean shape
    to :math:`u\,(a + b\,S(u))`, since the light between the ridges slopes as well. It is changed in place.

    A Gaussian in such light remains a Gaussian, shifted by :math:`\sigma_r^2 L'/L`, so that only heights
    reveal the shift. A lamp that moves, or the edge of a shadow, shows as a slope between a sheet and its
    neighbours on both sides, beyond the scatter of single sheets. Fewer than five sheets do not show that
    scatter: every change of the slope between two sheets, beyond its noise in time, then counts as light.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        light = np.log(np.where(height > 0, height, np.nan))
    light -= nan_median(light)
    light -= nan_median(light, axis=1)[:, None]  # exposure
    if light.shape[1] >= ENOUGH:
        shift = _slope_across(light, x_px, settings)
        light = mean_over(light, settings.distortion_frames)
        np.fmax(shift, _slope_across(light, x_px, settings), out=shift)
    else:
        with np.errstate(divide="ignore", invalid="ignore"):
            slope = np.diff(light, axis=1) / np.diff(nan_median(x_px))
        noise = np.broadcast_to(position_noise(slope), slope.shape)
        for between, own in zip(slope.T, noise.T, strict=True):
            between[:] = _significant(between, np.fmax(own, 0.0), settings)[1]
        shift = np.fmax(np.pad(slope, ((0, 0), (1, 0))), np.pad(slope, ((0, 0), (0, 1))))
    pulled_px2 *= shift
    return pulled_px2


def _slope_across(light: Floats, x_px: Floats, settings: TrackingSettings) -> Floats:
    """Return the slope of the light from sheet to sheet, per px, (frame, N); 0 where it is scatter.

    It is the smaller of the slopes to both neighbours if these have the same sign, and its scatter is that of
    single sheets against the mean of their neighbours. The first and last sheet have that of their neighbour.
    """
    apart = np.diff(nan_median(x_px))
    apart_px = float(nan_median(apart))
    apart = np.where(apart > 0, apart, np.nan)
    bend = light[:, 1:-1].copy()
    for rows in row_parts(len(bend)):
        bend[rows] -= (light[rows, :-2] + light[rows, 2:]) / 2
    scatter = median_of_all(np.abs(bend, out=bend)) / NORMAL_MEDIAN / np.sqrt(1.5)
    del bend
    least, across = settings.distortion_sigmas * np.sqrt(2) * scatter / apart_px, np.empty(light.shape)
    for rows in row_parts(len(light)):
        with np.errstate(divide="ignore", invalid="ignore"):
            slope = np.diff(light[rows], axis=1) / apart
        left, right = slope[:, :-1], slope[:, 1:]
        smaller = np.where(left * right > 0, np.fmin(np.abs(left), np.abs(right)), 0.0)
        across[rows] = np.pad(_if_above(smaller, least), ((0, 0), (1, 1)), "edge")
    return across


def mean_over(values: Floats, frames: int) -> Floats:
    """Return the mean of values (frame, N) over the `frames` frames around each, NaN where the value is."""
    mean = np.empty(values.shape)
    for column, of_sheet in zip(mean.T, values.T, strict=True):
        (total,), (count,) = (part.T for part in _sums_around(of_sheet[:, None], frames // 2))
        column[:] = np.where(np.isfinite(of_sheet), total / np.maximum(count, 1), np.nan)
    return mean


def _sums_around(values: NDArray[np.floating], reach: int) -> Floats:
    """Return sum and number of known values up to `reach` frames before and after each, (2, frame, N)."""
    known = np.isfinite(values)
    sums = np.zeros((2, *values.shape))
    sums[0][known], sums[1] = values[known], known
    for part in sums if values.size else ():
        cv2.boxFilter(part, -1, (1, 2 * reach + 1), part, normalize=False, borderType=cv2.BORDER_CONSTANT)
    return sums


# --- changes of the scene -----------------------------------------------------------------------------------


class SceneChange(NamedTuple):
    """A permanent change of the sheets' positions or brightnesses.

    frame: first frame of the new scene. moved_px: displacement that all sheets share. brightness: change of
    the logarithm of brightness, rms over the sheets, without the common change.
    """

    frame: int
    moved_px: float
    brightness: float


def scene_changes(x_px: Floats32, contrast: Floats32, comb: RidgeComb) -> list[SceneChange]:
    """Find where the film was cut, or the camera or the light was moved: identities may change there.

    x_px, contrast: positions and heights of the ridges (frame, N), NaN where missing. Changes are in order of
    time; there are none where such changes are usual in the film.

    Means over five frames before and after are compared. In a slip the sides of the comb move against each
    other, and every sheet keeps its brightness. The scene changes where all sheets are displaced by more than
    they are displaced against each other, or where their relative brightnesses change. Such a change must be
    several times the usual one, happen once, and persist: a camera that was knocked swings back.
    """
    settings = comb.settings
    frames, sheets = x_px.shape
    if frames < 4 * SCENE_FRAMES or sheets < 3:
        return []
    bright = np.log(contrast.astype(np.float64))
    bright -= nan_median(bright, axis=1)[:, None]
    moved = after_less_before(x_px)
    together = nan_median(moved, axis=1)
    moved -= together[:, None]
    apart = nan_median(np.abs(moved, out=moved), axis=1)
    rigid = np.abs(together) > 2.0 * np.nan_to_num(apart, nan=np.inf)
    displaced = np.where(rigid, np.abs(np.nan_to_num(together)) / comb.pitch_px / settings.cut_pitches, 0.0)
    del moved
    brightened = after_less_before(bright)
    known = np.isfinite(brightened).sum(axis=1)
    np.square(np.nan_to_num(brightened, copy=False, posinf=0.0, neginf=0.0), out=brightened)
    change = np.sqrt(brightened.sum(axis=1) / np.maximum(known, 1))
    change[known < max(3, sheets / 2)] = 0.0
    events = []
    at = _single_peak(displaced, 1.0, settings)
    if at is not None and _persists(x_px, at + SCENE_FRAMES, together[at]):
        events.append(at)
    at = _single_peak(change, settings.cut_brightness, settings)
    if at is not None and _persists(bright, at + SCENE_FRAMES, change[at]):
        events.append(at)
    if len(events) == 2 and abs(events[0] - events[1]) <= SCENE_FRAMES:
        events = events[:1]  # one cut, seen in both
    return [
        SceneChange(at + SCENE_FRAMES, float(np.nan_to_num(together[at])), float(change[at]))
        for at in sorted(events)
    ]


def _single_peak(values: Floats, limit: float, settings: TrackingSettings) -> int | None:
    """Return the position of a peak far above the usual values and twice as high as all others, if any."""
    least = max(limit, settings.cut_ratio * float(np.median(values)))
    at = int(np.argmax(values))
    others = np.abs(np.arange(len(values)) - at) > 2 * SCENE_FRAMES
    return at if values[at] >= least and (values[others] < values[at] / 2).all() else None


def _persists(values: NDArray[np.floating], frame: int, change: float) -> bool:
    """Return whether half of a change of values (frame, N) remains three times SCENE_FRAMES after a frame."""
    later = values[frame + 3 * SCENE_FRAMES :][:SCENE_FRAMES]
    remaining = nan_median(later) - nan_median(values[:frame][-4 * SCENE_FRAMES :])
    remaining = remaining[np.isfinite(remaining)]
    return not len(remaining) or bool(np.sqrt((remaining**2).mean()) >= abs(change) / 2)


def after_less_before(values: NDArray[np.floating]) -> Floats:
    """Return means over SCENE_FRAMES frames less those before, (frame − 2 SCENE_FRAMES + 1, N)."""
    reach = SCENE_FRAMES // 2
    change = np.empty((max(0, len(values) - 2 * SCENE_FRAMES + 1), values.shape[1]))
    for column, of_sheet in zip(change.T, values.T, strict=True):
        (total,), (count,) = (part[reach:-reach].T for part in _sums_around(of_sheet[:, None], reach))
        # a running sum does not return to 0
        means = np.where(count > 0, total, np.nan) / np.maximum(count, 1)
        column[:] = means[SCENE_FRAMES:] - means[:-SCENE_FRAMES]
    return change


# --- scatter of positions -----------------------------------------------------------------------------------


class BetweenSlips:
    """Positions (frame, N), NaN where missing or repeated, divided at the slips.

    In a slip sheets move by more than usual, and neighbours move alike. Where a codec redraws a frame,
    neighbours do not move alike. Vibration of single sheets is subtracted (`own_vibration`).
    """

    def __init__(self, x_px: Floats, settings: TrackingSettings = DEFAULT) -> None:
        self.frames = len(x_px)
        self.seen = np.isfinite(x_px).any(axis=1)
        self.x_px = x_px[self.seen]
        self.x_px -= own_vibration(self.x_px, settings)
        self.slips = np.zeros(len(self.x_px), np.int64)
        if x_px.shape[1] < len(FOURTH):
            return
        apart, *sizes = np.empty((3, max(0, len(self.x_px) - 1)))
        for rows in row_parts(len(apart)):
            step = np.diff(self.x_px[rows.start : rows.stop + 1], axis=0)
            apart[rows] = nan_quantile(np.abs(_fourth(step)), 0.75, axis=1)
            # vibration hides slips in the steps, but not in those without the common motion
            for size, moved in zip(sizes, (step, step - nan_median(step, axis=1)[:, None]), strict=True):
                size[rows] = nan_quantile(np.abs(moved), 0.75, axis=1)
        slip = np.zeros(len(apart), bool)
        for size in sizes:
            slip |= (size > 3 * nan_median(size[size > 0])) & (size > 3 * apart)
        self.slips = np.cumsum(np.r_[0, slip])

    def second(self, lags: Sequence[int], values: Floats | None = None) -> Floats:
        """Return second differences in time that contain no slip, (…, N).

        They are of values (frame, …), by default the positions, at the first of these lags that leaves enough
        frames, and are scaled to keep the standard deviation of independent values.
        """
        x = self.x_px if values is None else values
        for lag in lags:
            calm = self.without_slip(2 * lag)
            if calm.sum() >= LEAST_FRAMES:
                second = x[lag:-lag] * -2.0
                second += x[: -2 * lag]
                second += x[2 * lag :]
                second = second if calm.all() else second[calm]
                second /= np.sqrt(6)
                return second
        return x[:0]

    def without_slip(self, frames: int) -> Bools:
        """Return whether this many frames follow each frame without a slip, for all but the last of them."""
        return np.asarray(self.slips[frames:] == self.slips[:-frames], bool)


def spatial_scatter(positions: BetweenSlips, *, between_frames: bool) -> Floats:
    """Return the scatter of each sheet's position against its neighbours, px, (N,).

    It is the deviation of fourth differences along n, in which a motion smooth in n hardly shows, of second
    differences in time, in which the creep and the jumps of single sheets do not show. The lag in time is up
    to 4 frames, or up to 12 where a codec predicts frames from others. Unlike the scatter from frame to frame
    it includes errors that a codec carries from one frame to the next. NaN for fewer than five sheets, and
    where slips leave too few frames between them.
    """
    x, lags = positions.x_px, LAGS[between_frames]
    sheets = x.shape[1]
    if sheets < len(FOURTH) or not len(positions.second(lags, x[:, :1])):
        return np.full(sheets, np.nan)
    around = (x[:, k : k + len(FOURTH)] for k in range(sheets - len(FOURTH) + 1))
    scatter = [_deviation(_fourth(positions.second(lags, five))[:, 0]) for five in around]
    return np.asarray(np.pad(np.array(scatter), 2, mode="edge"), np.float64)


def noise_excess(positions: BetweenSlips, err_px: Floats, settings: TrackingSettings = DEFAULT) -> Floats:
    r"""Return how much more positions scatter than their errors (frame, N) say, as a factor, (N,).

    Turbulent air, flicker that differs between rows, and a camera that shakes along leaning sheets shift each
    ridge by another amount, and leave its shape unchanged. This shows in second differences of positions in
    time, between slips: those of the film, and those of the sheet itself, since often only the outer sheets
    of one side slip. The motion that all sheets share is subtracted. With ten sheets or more, so is a share
    in the opening of the comb, the motion of its outer thirds against each other: either one linear in n (a
    camera that vibrates or breathes), or that of the sheets beside, which move alike when slips are slow or
    come in every frame, whichever leaves less. Sizes at several lags are averaged as squares, since at one
    lag an error that lasts or repeats itself may cancel; a size is the one within which 68 % of the frames
    lie. Vibration of most sheets counts as an error if it is no line in the spectrum. 1 for fewer than five
    sheets, and where slips leave too few frames between them.
    """
    sheets = err_px.shape[1]
    if sheets < len(FOURTH):
        return np.ones(sheets)
    slips = _slips_of_sheets(positions.x_px, settings)
    variance = err_px[positions.seen]
    np.square(variance, out=variance)

    def size(lag: int) -> Floats:
        calm = positions.without_slip(2 * lag)
        if calm.sum() < 2 * LEAST_FRAMES:
            return np.full(sheets, np.nan)
        second = positions.second((lag,))
        for values, slip in zip(second.T, slips.T, strict=True):
            values[(slip[2 * lag :] != slip[: -2 * lag])[calm]] = np.nan

        def over_expected(values: Floats, own: Floats) -> Floats:
            expected = (own[: -2 * lag] + 4 * own[lag:-lag] + own[2 * lag :])[calm] / 6
            return nan_quantile(np.abs(values) / np.sqrt(expected), ONE_SIGMA)

        sizes = [
            np.array([over_expected(*pair) for pair in zip(scatter.T, variance.T, strict=True)])
            for scatter in _without_motion(second)
        ]
        return min(sizes, key=lambda of_sheets: float(nan_median(of_sheets)))

    sizes = np.array([size(lag) for lag in NOISE_LAGS])
    total, count = np.nansum(sizes**2, axis=0), np.isfinite(sizes).sum(axis=0)
    excess = np.sqrt(total / np.where(count, count, np.nan) / (1 - FITTED[sheets >= OPENING] / sheets))
    usual = np.nan_to_num(nan_median(excess), nan=1.0)
    own = np.where(excess > settings.own_excess[0] * usual, excess, usual)
    return np.fmin(own, settings.own_excess[1] * usual)


def _slips_of_sheets(x_px: Floats, settings: TrackingSettings) -> NDArray[np.int32]:
    """Return the number of slips of each sheet up to each frame, beyond the common motion, (frame, N)."""
    step = np.diff(x_px, axis=0)
    step -= nan_median(step, axis=1)[:, None]
    slips = np.zeros(x_px.shape, np.int32)
    for moved, count in zip(step.T, slips.T, strict=True):
        size = np.abs(moved - nan_median(moved))
        np.cumsum(size > settings.slip_sigmas * nan_median(size) / NORMAL_MEDIAN, out=count[1:])
    return slips


def shared_error(positions: BetweenSlips) -> float:
    r"""Return the error that neighbouring sheets share where a codec predicts frames from others, px.

    It is to be added in quadrature to `spatial_scatter`, which does not include it. 0 for fewer than eight
    sheets or sixteen frames.

    Blocks of the codec are wider than a sheet's spacing, and predicted frames move them by quarter pixels.

    1. Sheets in one block share an error. Second differences of positions in time, without the motion of the
       comb (`_without_motion`), scatter by :math:`a` over all sheets and by :math:`b` between neighbours:
       :math:`c = s_x\,(a^2/b^2 - 1)^{1/2}`, with :math:`s_x` the usual `spatial_scatter`. The ratio a/b is
       taken at a lag of at most four frames: creep that bends in a stick shows in a at longer ones.
    2. All sheets share an error that cannot be distinguished from vibration of the camera. It is the larger
       of c and :math:`s_x\,s/(s + 2 s_x)`, where s is the vibration seen from frame to frame. Both were
       measured on H.264, HEVC, MPEG-2, MPEG-4 and VP9 (reports/degraded.md).
    """
    sheets = positions.x_px.shape[1]
    if sheets < len(FOURTH) + 3 or positions.frames < 2 * LEAST_FRAMES:
        return 0.0
    own = float(np.nan_to_num(nan_median(spatial_scatter(positions, between_frames=True))))
    second = positions.second(LAGS[False])
    between = _deviation_of_all(_fourth(second))
    apart = min(_deviation_of_all(values) for values in _without_motion(second))
    apart /= np.sqrt(1 - FITTED[sheets >= OPENING] / sheets)
    ratio = apart / max(between, 1e-9)
    blocks = own * float(np.sqrt(max(0.0, ratio**2 - 1)))
    shaking = _deviation_of_all(positions.second((1,), nan_median(positions.x_px, axis=1)[:, None]))
    followed = own * shaking / max(shaking + 2 * own, 1e-9)
    return float(np.hypot(blocks, max(blocks, followed)))


def _without_motion(second: Floats) -> Iterator[Floats]:
    """Yield second differences (frame, N) without the motion that all sheets share, and, with ten sheets or
    more, also without a share in the opening of the comb, the motion of its outer thirds against each other:
    one linear in n, then that of the sheets beside. What is given is changed in place."""
    second -= nan_median(second, axis=1)[:, None]
    sheets = second.shape[1]
    if sheets < OPENING:
        yield second
        return
    third, place = sheets // 3, np.arange(sheets) - (sheets - 1) / 2
    low, high = (nan_median(part, axis=1) for part in (second[:, :third], second[:, -third:]))
    opening = np.nan_to_num(high - low)
    known = np.isfinite(second)
    power = np.array([(opening[seen] ** 2).sum() for seen in known.T])
    along = np.array([(opening[seen] * own[seen]).sum() for seen, own in zip(known.T, second.T, strict=True)])
    share = along / np.maximum(power, np.finfo(float).tiny)
    beside = np.pad(share, 1, "reflect", reflect_type="odd")
    for of in (place / (sheets - third), (beside[:-2] + beside[2:]) / 2):
        rest = second.copy()
        for rows in row_parts(len(second)):
            rest[rows] -= opening[rows, None] * of
        yield rest


def _fourth(x_px: Floats) -> Floats:
    """Return fourth differences along n, (frame, N − 4), scaled as `BetweenSlips.second` is."""
    last = x_px.shape[1] - len(FOURTH) + 1
    fourth = x_px[:, :last] * FOURTH[0]
    for k, weight in enumerate(FOURTH[1:], 1):
        fourth += x_px[:, k : k + last] * weight
    fourth /= np.sqrt((FOURTH**2).sum())
    return np.asarray(fourth, np.float64)


def _deviation(values: Floats) -> float:
    """Return a robust standard deviation of values about zero, NaN where nothing is known.

    Absolute values are limited to their 0.9 quantile, which reduces a normal variable's deviation to 0.9118.
    A median absolute deviation would be zero where codecs repeat blocks.
    """
    size = np.abs(values.ravel())
    count = np.isfinite(size).sum()
    if not count:
        return np.nan
    np.minimum(size, nan_quantile(size, 0.9), out=size)
    np.square(np.nan_to_num(size, copy=False), out=size)
    return float(np.sqrt(size.sum() / count) / 0.9118)


def _deviation_of_all(values: Floats) -> float:
    """Return the same for all values together; 0 where nothing is known."""
    return float(np.nan_to_num(_deviation(values)))
