"""What pulls a ridge aside: specks, highlights, the edge of a hand, light that falls off over it.

`distortion` tells by how much, from the ridge's shape and height; `shift_by_lamp` what light that moves over
the whole comb does; `not_one_ridge` which sheets are none.
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
    """Which sheets (N,) are no single ridge: their mean picture is not that of the comb's ridges.

    Sheets far thinner than most, side by side, are one hump to the search for ridges, and the position lies
    between them. Always False for fewer than five sheets.

    Parameters
    ----------
    bright
        Profile with bright ridges (frame, x).
    x_px
        Positions (frame, N), NaN where missing.
    comb
        Width and pitch of the ridges.
    settings
        `least_likeness`: correlation of a sheet's mean picture, over six tenths of a width to either side of
        its positions, with that of all sheets.
    """
    if x_px.shape[1] < 5:
        return np.zeros(x_px.shape[1], bool)
    half = max(3, round(min(0.6 * comb.fwhm_px, 0.5 * comb.pitch_px)))
    _, level, shape = _pictures(bright, x_px, half)
    own = nan_median(level)
    own -= own.mean(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        likeness = (shape - shape.mean()) @ own / np.linalg.norm(own, axis=0) / np.std(shape)
    return np.asarray(likeness / np.sqrt(len(shape)) < settings.least_likeness, bool)


def _pictures(bright: Floats32, x_px: Floats, half: int) -> tuple[Floats, Floats, Floats]:
    """Pixels around positions in some frames (frame, u, N), the same with mean 0 and deviation 1, and the
    median of these over all sheets and frames (u,)."""
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
    r"""What dirt, a highlight or an edge may shift each position by, px, (frame, N); 0 where nothing shows.

    Parameters
    ----------
    bright
        Profile with bright ridges (frame, x).
    x_px, err_px
        Positions and their errors from noise (frame, N), NaN where missing.
    blurred
        Ridges drawn over themselves (frame, N), which are lopsided anyway: 0.
    comb
        Width and pitch of the ridges.
    settings
        The fields `distortion_…` and `lopsided`.

    Notes
    -----
    To the pixels around each position the comb's mean shape :math:`S` is fitted with level, height and shift,

    .. math:: I(x + u) = a + b\,(S(u) - s\,S'(u)) + r(u) .

    The position may be off by the change of s where a slope is fitted as well (light that varies over the
    window), and by the residual in terms of the shape's own slope,
    :math:`\langle r^2 \rangle^{1/2} / (b\,\langle S'^2 \rangle^{1/2})` (anything narrower, which shifts the
    ridge by about as much as it shows elsewhere). Of the residual only the odd part counts: widths differ,
    and move nothing. Each is split into the sheet's own mean, which is compared with the other sheets', and
    what differs from it in a frame; what all sheets of a frame have in common (blur, exposure) is left out.
    Where ridges overlap, narrow ones between broad ones have a slope under them: a sheet's mean residual
    counts where its slope is far beyond the others', or what is left without the slope. Where ridges are
    lopsided by themselves it says nothing. Where s usually changes by far more than noise makes it, something
    moves over the whole comb (its own reflection), and what is usual is an error, too. What no shape tells,
    light that falls off over a ridge, is seen in the heights.
    """
    if comb.fwhm_px < settings.distortion_least_px:
        return np.zeros_like(x_px)
    half = max(3, round(min(0.9 * comb.fwhm_px, 0.5 * comb.pitch_px)))
    around, _, shape = _pictures(bright, x_px, half)
    if not np.isfinite(shape).all():
        return np.zeros_like(x_px)
    to_fit = _to_shape_fit(shape)
    own = nan_median(_shape_fit(around, to_fit).residual)  # each sheet's own, (u, N)
    straight = nan_median(_residual_with_slope(around, shape))
    height, slant, unlike = np.empty((3, *x_px.shape))

    def fit(rows: slice) -> None:
        height[rows], slant[rows], residual = _shape_fit(_around(bright[rows], x_px[rows], half), to_fit)
        residual -= own
        residual -= nan_median(residual, axis=2)[..., None]
        unlike[rows] = _odd_rms(residual)

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(fit, (slice(i, i + FRAMES_PER_BLOCK) for i in range(0, len(bright), FRAMES_PER_BLOCK))))
    floor, times = settings.distortion_floor, settings.distortion_residual
    shifted, sloping = _shift_by_slope(slant, err_px, _slant_noise(shape), settings)
    height[blurred] = np.nan
    shifted = np.fmax(shifted, _shift_by_light(x_px, height, comb, settings))
    rough = _beyond(unlike, np.fmax(times * nan_median(unlike), floor))
    rough += _lasting_residual(own, straight, sloping > 0, comb, settings)
    size = np.hypot(shifted, settings.distortion_error * rough)
    return np.where(np.isfinite(slant) & ~blurred, size, 0.0)  # unknown too near the picture's edge


def _shift_by_slope(
    slant: Floats, err_px: Floats, noise: float, settings: TrackingSettings
) -> tuple[Floats, Floats]:
    """Where a slope under the ridge changes the shift by more than usual, px, (frame, N), and the part of it
    that lasts, against the other sheets', (N,).  noise: of `slant`, over that of the position."""
    floor, sigmas = settings.distortion_floor, settings.distortion_sigmas
    usual = nan_median(slant)
    off = np.abs(slant - usual)
    usual_off = float(nan_median((off / err_px).ravel())) / NORMAL_MEDIAN
    everywhere = usual_off > settings.distortion_everywhere * noise
    within = (0.0 if everywhere else usual_off) * err_px
    apart = np.abs(usual - nan_median(usual))
    between = nan_median(apart) / NORMAL_MEDIAN
    lasting = _beyond(apart, np.fmax(sigmas * between, floor))
    shifted = _beyond(off, np.fmax(sigmas * within, floor)) + lasting
    return (np.fmax(shifted, usual_off * err_px) if everywhere else shifted), lasting


def _lasting_residual(
    own: Floats, straight: Floats, sloping: Bools, comb: RidgeComb, settings: TrackingSettings
) -> Floats:
    """Sheets' mean residuals (u // 2, N) that are unlike the others', (N,), else 0.

    straight: those where a slope is fitted, too. sloping: sheets whose slope is far beyond the others' (N,).
    """
    odd, bent = (np.sqrt(2) * _odd_rms(part - nan_median(part, axis=1)[:, None]) for part in (own, straight))
    if not nan_median(odd) < settings.lopsided:
        return np.zeros_like(odd)
    overlap = comb.fwhm_px > settings.overlapping * comb.pitch_px
    judged = bent if overlap else odd
    unlike = judged > np.fmax(settings.distortion_residual * nan_median(judged), settings.distortion_floor)
    return np.asarray(odd * (unlike | (sloping & overlap)), np.float64)


def _beyond(size: Floats, least: Floats) -> Floats:
    """Sizes above what is usual, else 0."""
    return np.where(size > least, size, 0.0)


def _around(bright: Floats32, x_px: Floats, half: int) -> Floats:
    """Grey levels at whole pixels from each position, (frame, u, N), by the cubic through four pixels."""
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
    """Level, shape and its slope, (u, 3); the same and a slope of the light, (u, 4)."""
    upright = np.stack([np.ones_like(shape), shape, np.gradient(shape)], axis=1)
    return upright, np.column_stack([upright, np.arange(len(shape)) - len(shape) // 2])


def _slant_noise(shape: Floats) -> float:
    """Scatter that white noise gives the change of the shift where a slope is fitted too, over that of the
    shift itself."""
    shift, sloping = (np.linalg.pinv(basis)[2] for basis in _bases(shape))
    return float(np.linalg.norm(sloping - shift) / np.linalg.norm(shift))


class _ShapeFit(NamedTuple):
    """Of pixels (frame, u, N).

    Parameters
    ----------
    height
        Grey levels (frame, N).
    change
        Of the shift, px, where a slope is fitted too, (frame, N).
    residual
        What the shape does not explain, its odd part, in terms of the shape's slope: the left half
        (frame, u // 2, N), of which the right one is the negative.
    """

    height: Floats
    change: Floats
    residual: Floats


def _to_shape_fit(shape: Floats) -> Floats:
    """What takes pixels to all of the fit, which is linear in them: height and shift, both with a slope, and
    the odd residual."""
    upright, sloping = _bases(shape)
    first, second = np.linalg.pinv(upright), np.linalg.pinv(sloping)
    return np.concatenate([first[1:3], second[1:3], _odd_residual(upright, first)])


def _shape_fit(pixels: Floats, to_fit: Floats) -> _ShapeFit:
    """By the matrix of `_to_shape_fit`."""
    found = to_fit @ pixels
    height, shift, other_height, other_shift = (found[:, k] for k in range(4))
    with np.errstate(divide="ignore", invalid="ignore"):
        return _ShapeFit(height, other_shift / other_height - shift / height, found[:, 4:] / height[:, None])


def _residual_with_slope(pixels: Floats, shape: Floats) -> Floats:
    """The same residual where a slope is fitted too."""
    basis = _bases(shape)[1]
    fit = np.linalg.pinv(basis)
    found = np.concatenate([fit[1:2], _odd_residual(basis, fit)]) @ pixels
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(found[:, 1:] / found[:, :1], np.float64)


def _odd_residual(basis: Floats, fit: NDArray[np.floating]) -> Floats:
    """What takes pixels to the left half of the odd part of their residual, over the shape's slope."""
    residual = np.eye(len(basis)) - basis @ fit
    odd = (residual - residual[::-1])[: len(basis) // 2]
    return np.asarray(odd / np.sqrt(2 * (basis[:, 2] ** 2).mean()), np.float64)


def _odd_rms(left_half: Floats) -> Floats:
    """Root mean square over u of what is odd in u, from its left half (…, u // 2, N)."""
    return np.asarray(np.sqrt((left_half**2).sum(axis=-2) / (left_half.shape[-2] + 0.5)), np.float64)


def _shift_by_light(
    x_px: Floats, height: Floats, comb: RidgeComb, settings: TrackingSettings = DEFAULT
) -> Floats:
    r"""By how much light L that falls off over a ridge shifts it against its usual place, px, (frame, N); 0
    where that is no more than usual.

    A Gaussian times such light is a Gaussian again, and no shape tells that it is shifted by
    :math:`\sigma_r^2 L'/L`. The heights tell: L along a sheet's own way, as far as both halves of the film
    agree (what stands still: dirt); and what three sheets side by side have in common in a frame (what moves:
    the edge of a shadow), taken twice, as an edge is steeper in its middle than from sheet to sheet.
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
    still = _unusual(variance * along, *limits)
    moving = _unusual(variance * across, *limits)
    return np.fmax(still, np.where(left * right > 0, moving, 0.0))


def shift_by_lamp(
    x_px: Floats, contrast: Floats, comb: RidgeComb, settings: TrackingSettings = DEFAULT
) -> Floats:
    r"""By how much light whose slope over the comb changes shifts all ridges of a frame, px, (frame, 1).

    Light L that slopes shifts a Gaussian by :math:`\sigma_r^2 L'/L`, seen in the heights of sheets half a
    comb apart against what is usual; twice, as the light between the ridges slopes, too. 0 for fewer than
    four sheets.
    """
    half = x_px.shape[1] // 2
    if half < 2:
        return np.zeros((len(x_px), 1))
    light = np.log(np.where(contrast > 0, contrast, np.nan))
    slope = (light[:, half:] - light[:, :-half]) / (x_px[:, half:] - x_px[:, :-half])
    slope -= nan_median(slope)
    common = nan_median(slope, axis=1)
    scatter = nan_median(np.abs(slope - common[:, None]), axis=1) / NORMAL_MEDIAN
    error = 1.25 * scatter / np.sqrt(slope.shape[1])  # what covers or clips some sheets is no slope over all
    seen = np.abs(common) > settings.distortion_sigmas * error
    return np.where(seen, 2 * (comb.fwhm_px / FWHM) ** 2 * np.abs(common), 0.0)[:, None]


def _unusual(size: Floats, times: float, floor: float) -> Floats:
    """Sizes above a floor and so many times their median, else 0."""
    return _beyond(size, np.fmax(times * nan_median(size.ravel()), floor))


def _slope_along(x_px: Floats, values: Floats, step_px: float, settings: TrackingSettings) -> Floats:
    """Slope of values against each sheet's own position, at its position in every frame, (frame, N).

    From the median of the known values within one step to those of the next steps on both sides, or on one;
    0 where their scatter explains it, NaN where there are none of either.
    """
    known = np.isfinite(x_px) & np.isfinite(values)
    place = np.floor(np.nan_to_num(x_px - nan_quantile(x_px, 0.0)) / step_px).astype(np.int64)
    columns = int(place.max(initial=0)) + 2
    cell = 1 + place + columns * np.arange(x_px.shape[1])
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
