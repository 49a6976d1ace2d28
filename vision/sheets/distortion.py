"""Positions that are not those of the sheets: locked to whole pixels, or of distorted ridges.

`pixel_locking` measures, from the sheets' motion against each other, by how much positions depend on where in
a pixel they lie. `distortion` estimates how far specks, reflections, neighbours or uneven light may shift
positions, from the shape and height of the ridge. `not_one_ridge` and `two_in_one` find ridges of several
sheets.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from typing import NamedTuple, Self

import cv2
import numpy as np

from vision.memory import give_back, in_two_threads, row_parts, some_rows, table_beside
from vision.numeric import (
    FWHM,
    NORMAL_MEDIAN,
    Bools,
    Floats,
    Floats32,
    centred,
    correlation_inflation,
    nan_median,
    nan_quantile,
    sigma_about_zero,
    spread_indices,
    typical_median,
    typical_medians,
    typical_rows,
    typical_where,
    weighted_median,
)
from vision.sheets.reference import spacing_sizes
from vision.sheets.ridges import RidgeComb, in_blocks
from vision.sheets.settings import LEAST_FRAMES, TrackingSettings
from vision.sheets.subpixel import Starts, gather, position_noise
from vision.signals import mean_over, running_median

ENOUGH = 5  # sheets of which neighbours show what is usual
FAR_BEYOND = 10.0  # median changes of width in a frame: overexposed ridges widen by up to 9 of them
MOST_LOUDER = 4.0  # noise of one sheet's width over that of the others: more is an object that flickers
PHASE_FRAMES = 20  # in which a sheet shows how its own shape depends on its place in the pixels


# --- locking of positions to whole pixels -------------------------------------------------------------------


_HARMONICS = 2  # of a period of one pixel; sharper edges lock at once, at 1/20 of the second harmonic
_LEAST_SHEETS = 12  # fewer do not tell the scatter between sheets from chance
_LEAST_LOCKING_FRAMES = 100  # fewer do not tell it from the motion of slips
_MOST_FRAMES = 1000  # spread over the film: enough, and memory does not grow with it
_OUTLIER = 5.0  # median deviations: slips and exchanged sheets
_PARTS = 10  # of the film, for the errors of single sheets' locking
_WELL_SEEN = 0.1  # variance of cosine and sine of a position beside its motion: 0.3 and 0.7 over a pixel


class PixelLocking(NamedTuple):
    """By how much a position is shifted depending on where in a pixel it lies."""

    waves: Floats  # amplitudes, px, of cos 2πx, sin 2πx, cos 4πx and sin 4πx, (4,)
    error_px: float  # RMS of what the sheets lock by otherwise than these amplitudes, with their errors

    @property
    def rms_px(self) -> float:
        """Root mean square of the shift over a pixel."""
        return float(np.sqrt(0.5 * np.sum(self.waves**2)))

    def at(self, x_px: Floats) -> Floats:
        """Return the shift of positions."""
        return np.asarray(np.tensordot(self.waves, pixel_waves(x_px), axes=1), np.float64)


NO_LOCKING = PixelLocking(np.zeros(2 * _HARMONICS), 0.0)


def pixel_locking(x_px: Floats, settings: TrackingSettings) -> PixelLocking:
    r"""Measure how positions lock to whole pixels: `NO_LOCKING` where it is not clear.

    Parameters
    ----------
    x_px
        Positions (frame, N), NaN where missing or repeated.
    settings
        `locking_sigmas` and `locking_scatter` decide what is clear.

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
    if x.shape[1] < _LEAST_SHEETS or len(x) < _LEAST_LOCKING_FRAMES or _at_one_place(middle, settings):
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
    scatter = _scatter_of_sheets(regressors, own, known, settings)
    error_px = float(np.sqrt(0.5 * np.sum(variance) + 0.5 * np.sum(scatter)))
    return PixelLocking(found, error_px) if error_px else NO_LOCKING


def pixel_waves(x_px: Floats) -> Floats:
    """Return cosine and sine of the position in its pixel, of each harmonic in turn, (4, …)."""
    turn = 2 * np.pi * x_px
    return np.stack([wave(k * turn) for k in range(1, _HARMONICS + 1) for wave in (np.cos, np.sin)])


def _at_one_place(x_px: Floats, settings: TrackingSettings) -> bool:
    """Return whether sheets lie at the same place in their pixels, or at two places half a pixel apart. Their
    shifts are then in proportion to their motion, which none of the waves may take away."""
    turns = np.exp(2j * np.pi * x_px[np.isfinite(x_px)])
    return any(abs(np.sum(turns**k)) > settings.locking_alike * len(turns) for k in range(1, _HARMONICS + 1))


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
    rows = centred(regressors, known, axis=-2)
    return np.einsum("afn,bfn->nab", rows, rows), np.einsum("afn,fn->na", rows, centred(values, known))


def _scatter_of_sheets(
    regressors: Floats, values: Floats, known: Bools, settings: TrackingSettings
) -> Floats:
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
    return np.where(scatter > settings.locking_scatter * error, scatter - error, 0.0)


# --- distorted ridges ---------------------------------------------------------------------------------------


def not_one_ridge(profile: Floats32, x_px: Floats, lasting_px: Floats, comb: RidgeComb) -> Bools:
    """Return which sheets are not a single ridge, (N,): their mean profile differs from the comb's.

    Several sheets side by side, far thinner than most, appear as one hump to the search for ridges, and the
    position lies between them. A sheet's mean profile, over 0.8 ridge widths on either side of its positions
    x_px (frame, N), correlates with that of all sheets by less than `least_likeness` times the square of what
    is usual: sheets with texture differ anyway, and nearer than 0.8 widths that of the top would decide. So
    does a sheet with another or a mark beside it, which pulls it aside by lasting_px (N,), more than
    `most_distorted` ridge widths, unless its profile is the usual one. Sheets may be turned over: the mirror
    image counts as well. Fewer than five sheets show no usual profile.
    """
    pulled = lasting_px > comb.settings.most_distorted * comb.fwhm_px
    if x_px.shape[1] < ENOUGH:
        return np.asarray(pulled, bool)
    half = comb.half_px(0.8)
    profiles, shape = _sampled_profiles(profile, x_px, half, comb)
    own = nan_median(profiles)
    own -= own.mean(axis=0)
    shape -= shape.mean()
    with np.errstate(divide="ignore", invalid="ignore"):
        likeness = (
            np.fmax(shape @ own, shape[::-1] @ own) / np.linalg.norm(own, axis=0) / np.linalg.norm(shape)
        )
    unlike = comb.settings.least_likeness * float(nan_median(likeness)) ** 2
    least = np.where(pulled, comb.settings.usual_likeness, unlike)
    return np.asarray(likeness < least, bool)


def two_in_one(x_px: Floats, rest_px: Floats, fwhm_px: Floats32, comb: RidgeComb) -> Bools:
    """Return which sheets are wider than the others beside a spacing in which one seems to be missing, (N,).

    The missing one then lies against its neighbour: one ridge, whose position is that of neither. A wide
    ridge alone may be a thick sheet, and a wide spacing alone a gap. x_px, fwhm_px: positions, NaN where
    missing, and widths of the ridges, (frame, N). rest_px: rest positions (N,).
    """
    order = np.argsort(rest_px)  # corrections may have exchanged sheets
    _, gap = spacing_sizes(rest_px[order], settings=comb.settings)
    near = np.zeros(len(order), bool)
    near[order[:-1][gap]] = near[order[1:][gap]] = True
    wide = np.log(typical_where(np.isfinite(x_px), fwhm_px))
    wide = wide - nan_median(wide)
    scatter = sigma_about_zero(wide)
    least = max(np.log(comb.settings.wide_by_a_gap), comb.settings.distortion_sigmas * scatter)
    return np.asarray(near & (wide > least), bool)


def _sampled_profiles(profile: Floats32, x_px: Floats, half: int, comb: RidgeComb) -> tuple[Floats, Floats]:
    """Return the pixels at offsets u from the positions in some frames, with mean 0 and standard deviation 1,
    (frame, u, N), and their median over all sheets and frames, (u,)."""
    sample = spread_indices(len(profile), 200)
    level = levels_around(comb.bright(some_rows(profile, sample)), x_px[sample], half)
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
    profile: Floats32, x_px: Floats, err_px: Floats, fwhm_px: Floats32, blurred: Bools, comb: RidgeComb
) -> Distortion:
    r"""Return how far dirt, reflections, neighbours or light may shift positions.

    x_px, err_px: positions and their errors from noise (frame, N), NaN where missing. fwhm_px: widths of the
    ridges, (frame, N). Ridges blurred by motion (frame, N) are lopsided for that reason; only their width
    counts, as what passes in a single frame also looks like blur.

    The comb's mean shape :math:`S` is fitted to the pixels around each position with level a, height b and
    shift s:

    .. math:: I(x + u) = a + b\,(S(u) - s\,S'(u)) .

    It is fitted three times: over the whole ridge, over its top alone, and over the whole ridge with a slope
    of the background. Whatever is not a shift of the ridge shifts these fits by different amounts. The
    differences from the first fit, times `_error_over`, are the error where they exceed their noise
    (`_significant`): clearly, unless the film shows that positions change with them. The mean difference of a
    sheet shifts all its positions alike, and is no error of displacements.

    In narrow ridges, what depends on their place among the pixels is subtracted before (`sampled_well_px`).

    Light that falls off over a ridge hardly changes its shape; it shows in the heights (`_shift_by_light`).
    What covers a flank, such as a needle or a cable, may leave shape and height as they are, but not the
    width: the position shifts by half of what is gone (`_single_width_changes`), at most.
    What stands still where a ridge moves changes all displacements of its sheet by the same factor
    (`displacement_scale_error`). A texture of the light does so to all sheets, up to a ridge width or so; it
    shows in the heights of all of them together (`texture_error`).
    """
    settings = comb.settings
    half = comb.half_px(0.9)
    shape = _sampled_profiles(profile, x_px, half, comb)[1]
    if not np.isfinite(shape).all():
        return Distortion.none(x_px)
    fits = _fit_matrix(shape, min(max(2, round(0.5 * comb.fwhm_px)), half - 1))
    height, apart, sloping, pulled_px2 = _fit_shape(profile, x_px, shape, fits, comb)
    height[blurred], apart[blurred], sloping[blurred] = np.nan, np.nan, np.nan
    height[~(height > 0)] = np.nan
    log_height = np.log(height, out=height)
    narrow = comb.fwhm_px < settings.sampled_well_px
    if narrow:
        _subtract_pixel_phase((log_height, apart, sloping), x_px)
    shapes, texture = [log_height, apart, sloping], 0.0
    if comb.fwhm_px > settings.overlap * comb.pitch_px:
        del shapes[1:]
    else:  # otherwise heights change with the distance of the neighbours
        texture = texture_error(x_px, log_height, comb)
    scale = displacement_scale_error(x_px, shapes, settings)
    rest = typical_median(x_px)
    size = _shift_by_light(rest, log_height, pulled_px2, settings)
    del height, log_height, shapes  # each is as large as the positions
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
    covered_px = comb.fwhm_px / 2 * _single_width_changes(np.log(fwhm_px), settings)
    usual_px, reach_px = np.empty(x_px.shape[1]), settings.texture_length * comb.fwhm_px
    own_noise, middles = ([of(one.px) for one in differences] for of in (position_noise, typical_median))

    def of_sheet(n: int) -> None:
        found = slight = size[:, n]
        for one, own, middle in zip(differences, own_noise, middles, strict=True):
            values = one.px[:, n] - middle[n]
            certain, likely = _significant(values, np.fmax(one.noise * err_px[:, n], own[n]), settings)
            found = np.fmax(found, np.hypot(one.assumed * certain, one.confirmed * likely))
            slight = np.fmax(slight, np.hypot(one.assumed, one.confirmed) * likely)
        away = np.abs(x_px[:, n] - rest[n])
        apart_px = reach_px * np.sqrt(-2 * np.expm1(-((away / reach_px) ** 2) / 2))
        found = np.fmax(found, np.fmax(scale[n] * away, texture * apart_px))
        within = np.where(np.isfinite(apart[:, n]), comb.fwhm_px, 0.0)  # what is fitted lies in the ridge
        size[:, n] = np.fmax(np.fmin(found, within), covered_px[:, n])
        usual_px[n] = nan_median(np.fmin(slight, within))

    in_two_threads(of_sheet, range(x_px.shape[1]))
    if narrow:  # of what lasts, the place among the pixels is not told from dirt if a sheet hardly moves
        return Distortion(size, *np.zeros((3, x_px.shape[1])))
    pull = typical_median(apart)
    pull = np.abs(pull - nan_median(pull))
    least = np.fmax(settings.distortion_sigmas * nan_median(pull) / NORMAL_MEDIAN, settings.distortion_floor)
    return Distortion(size, usual_px, settings.distortion_error * _if_above(pull, least), scale)


def _fit_shape(
    profile: Floats32, x_px: Floats, shape: Floats, fits: Floats, comb: RidgeComb
) -> tuple[Floats, Floats, Floats, Floats]:
    """Fit the mean shape (u,) to the pixels around positions, with the matrix of `_fit_matrix`.

    Returns the height, by how much the fits to the top and with a slope shift the position, and its shift per
    slope of the light (`_shift_by_light`), all (frame, N). All shifts are relative to the height of the whole
    ridge: the top of a sheet with texture may have none of the mean shape.
    """
    half = len(shape) // 2
    away = np.arange(-half, half + 1)
    height, apart, sloping, pulled_px2 = (table_beside(profile, x_px.shape, order="F") for _ in range(4))

    def fit(rows: slice) -> None:
        around = levels_around(comb.bright(profile[rows]), x_px[rows], half)
        found = fits @ around
        with np.errstate(divide="ignore", invalid="ignore"):
            shift = found[:, 1::2] / found[:, :1]
            level = around.mean(axis=1) / found[:, 0]  # in units of the height, as the mean shape has none
            pulled_px2[rows] = np.abs(fits[1] @ away * level + fits[1] @ (away * shape))
        height[rows] = found[:, 0]
        apart[rows], sloping[rows] = shift[:, 1] - shift[:, 0], shift[:, 2] - shift[:, 0]

    in_blocks(fit, profile)
    return height, apart, sloping, pulled_px2


def _subtract_pixel_phase(tables: Sequence[Floats], x_px: Floats) -> None:
    """Subtract from tables of values of the ridges what depends on where they lie in their pixels.

    The shape of ridges narrower than some five pixels depends on it. The same combination of `pixel_waves` is
    fitted to all sheets; sheets that moved over whole pixels have one of their own beside it, as sheets may
    have different shapes. All are (frame, N); the tables are changed in place.
    """
    equations = []
    for x, *own in zip(x_px.T, *(values.T for values in tables), strict=True):
        waves = pixel_waves(x[:, None])
        for of_sheet in own:
            known, off = without_outliers(of_sheet[:, None])
            (products,), (loads,) = normal_equations(waves, off, known)
            equations.append((products, loads, known.sum()))
    products, loads, count = (
        np.array(part).reshape(-1, len(tables), *np.shape(part[0])) for part in zip(*equations, strict=True)
    )
    common = np.linalg.pinv(products.sum(axis=0), hermitian=True) @ loads.sum(axis=0)[..., None]
    alone = np.linalg.pinv(products, hermitian=True) @ (loads[..., None] - products @ common)
    moved = nan_quantile(x_px, 0.95) - nan_quantile(x_px, 0.05) > 1.0
    alone[~(moved[:, None] & (count >= PHASE_FRAMES))] = 0.0
    amplitudes = (common + alone)[..., 0]
    for x, of_sheet, *own in zip(x_px.T, amplitudes, *(values.T for values in tables), strict=True):
        waves = pixel_waves(x)
        for values, amplitude in zip(own, of_sheet, strict=True):
            np.subtract(values, amplitude @ waves, out=values)


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
        both = zip(x_px.T, values.T, strict=True)
        each = in_two_threads(lambda pair: _regression(*pair), both)
        slope, error2, count = np.array(each, np.float64).reshape(-1, 3).T
        slope -= running_median(slope, settings.leaning_sheets, ends="inside")
        found = (slope**2 > settings.distortion_sigmas**2 * error2) & (count > LEAST_FRAMES)
        square += np.where(found, factor**2 * (slope**2 - error2), 0.0)
    return _if_above(np.sqrt(square), settings.static_floor)


def texture_error(x_px: Floats, log_height: Floats, comb: RidgeComb) -> float:
    r"""Return the usual relative error of displacements by a texture of the light that stands still.

    Stripes and spots of a lamp, of a background or of a window shift each ridge that moves through them. They
    change its height as well, by the slope :math:`s = \mathrm{d} \ln L/\mathrm{d}x`, and the shift
    :math:`\sigma_r^2 s` changes over a length of about the standard deviation :math:`\sigma_r` of a ridge, as
    it sees nothing finer. The relative error of displacements is therefore `texture_shift` times
    :math:`\sigma_r` times the root mean square of s: of all sheets, since s is not known to lie where it
    changes. It holds up to a distance of `texture_length` ridge widths, beyond which shifts are independent.

    log_height: logarithms of the heights, (frame, N). They count relative to the mean of both neighbours,
    which excludes the exposure and light that tilts; the texture under the neighbours adds half the square.
    0 for fewer than five sheets, and where chance explains half of it.
    """
    sheets = x_px.shape[1]
    if sheets < ENOUGH:
        return 0.0
    square = np.full((2, sheets), np.nan)
    for n in range(1, sheets - 1):
        relative = log_height[:, n] - (log_height[:, n - 1] + log_height[:, n + 1]) / 2
        square[:, n] = _slopes_in_cells(x_px[:, n], relative, comb.settings.texture_length * comb.fwhm_px)
    found, chance = np.nan_to_num(nan_median(square, axis=1)) / NORMAL_MEDIAN**2
    slope = float(np.sqrt((found - chance) / 1.5)) if found > 2 * chance else 0.0
    return comb.settings.texture_shift * comb.fwhm_px / FWHM * slope


def _slopes_in_cells(x: Floats, y: Floats, width: float) -> tuple[float, float]:
    """Return the mean square of the slopes of y over x, both (frame,), each within a cell of this width, and
    what chance adds to it; NaN for few values. Cells count by their spread of x. In a single cell the slope
    is that of `_regression`."""
    known = np.isfinite(x) & np.isfinite(y)
    if known.sum() <= LEAST_FRAMES:
        return np.nan, np.nan
    x, y = x[known], y[known]
    cell = np.rint((x - np.median(x)) / width).astype(np.int64)
    cell -= cell.min()
    count = np.bincount(cell)
    x, y = (v - (np.bincount(cell, v) / np.maximum(count, 1))[cell] for v in (x, y))
    spread = np.maximum(np.bincount(cell, x * x), 1e-12)
    shared = np.bincount(cell, x * y)
    rest = y - (shared / spread)[cell] * x
    cells = int((count > 1).sum())
    variance = float(rest @ rest) / max(len(x) - 2 * cells, 1) * correlation_inflation(rest, 0.95)
    total = float(spread.sum())
    return float(np.sum(shared**2 / spread)) / total, cells * variance / total


def _regression(x: Floats, y: Floats) -> tuple[float, float, int]:
    """Return the slope of y over x, both (frame,), its squared error, and the number of known values."""
    known = np.isfinite(y) & np.isfinite(x)
    count = max(int(known.sum()), 1)
    x, y = centred(x, known), centred(y, known)
    spread = max(float((x**2).sum()), 1e-12)
    slope = float((x * y).sum()) / spread
    rest = y - slope * x
    variance = float((rest**2).sum()) / max(count - 2, 1) * correlation_inflation(rest, 0.95)
    return slope, variance / spread, count


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
    relative to both neighbours, and less what is in proportion to the neighbours' motion, since a ridge that
    moves further than these in every slip, and leans as it does, is displaced and not distorted; k is the
    median of their ratios, weighted by the change of the value, so that slips do not enter. With q the share
    by which they change in the same direction more often than in opposite ones, the results are
    :math:`\sqrt{q}\,|k|` and :math:`\sqrt{1 - q^2}\,u`, u being the usual one.
    """

    frames = settings.distortion_frames
    inner = max(0, values.shape[1] - 2)  # sheets between two others
    shape = inner, max(0, len(values) - frames)
    ratio, weights = (table_beside(values, shape) for _ in range(2))
    total, along = np.zeros((2, inner))

    def compare(some: slice) -> None:
        around = slice(some.start, some.stop + 2)
        moves, changes = (_relative_changes(table[:, around], frames) for table in (x_px, values))
        for k, ((move, motion), (change, _)) in enumerate(zip(moves, changes, strict=True), some.start):
            _subtract_proportion(move, motion)
            _subtract_proportion(change, motion)
            product = move * change
            weight = np.where(np.isfinite(product), np.abs(change), 0.0)
            known = weight > 0
            total[k], along[k] = weight.sum(), np.where(known, np.copysign(weight, product), 0.0).sum()
            ratio[k], weights[k] = np.nan, weight
            np.divide(move, change, where=known, out=ratio[k])
            give_back(ratio[k])
            give_back(weights[k])

    in_two_threads(compare, row_parts(inner, -(-inner // 2) or 1))
    if not (weights > 0).any():
        return 0.0, usual
    share = abs(float(np.mean(along[total > 0] / total[total > 0])))
    median = weighted_median(ratio.ravel(), weights.ravel())
    return float(np.sqrt(share) * abs(median)), float(np.sqrt(1 - share**2) * usual)


def _relative_changes(values: Floats, frames: int) -> Iterator[tuple[Floats, Floats]]:
    """Yield the changes of each sheet's means over `frames` frames, relative to both neighbours, and those of
    the neighbours, (frame − frames,), for all sheets (frame, N) but the first and last."""
    means: deque[Floats] = deque(maxlen=3)
    for of_sheet in values.T:
        means.append(mean_over(of_sheet, frames))
        if len(means) == 3:
            left, own, right = means
            both = (left + right) / 2
            relative = own - both  # the names are used again, so that nothing more is held meanwhile
            relative, both = (values[frames:] - values[:-frames] for values in (relative, both))
            yield relative, both


def _subtract_proportion(values: Floats, motion: Floats) -> None:
    """Subtract from values (frame,), in place, what is in proportion to the motion; NaN is left out."""
    known = np.isfinite(values) & np.isfinite(motion)
    power = float((motion[known] ** 2).sum())
    if power > 0:
        values -= float((values[known] * motion[known]).sum()) / power * motion


def _significant(values: Floats, noise: Floats, settings: TrackingSettings) -> tuple[Floats, Floats]:
    """Return the size of values of a sheet (frame,) in a frame, over some frames, or usually; 0 where it is
    noise.

    The largest of three sizes counts: the value itself, the mean over `distortion_frames` around it, and the
    usual size of that mean in the whole film, if they exceed `distortion_sigmas` times their noise. Between
    two such means, at most `distortion_gap` frames have at least the root mean square of what swings between
    them, which is the smaller of the two over the square root of 2. In the second result the usual size, less
    noise, counts as soon as chance does not explain it. noise: standard deviation of a single value,
    (frame,), independent from frame to frame; at least that which the values show (`position_noise`), as tops
    may be clipped, and a codec adds its own.
    """
    frames = settings.distortion_frames
    single, mean = np.abs(values), np.abs(mean_over(values, frames))
    least = settings.distortion_sigmas * noise
    of_mean = least / np.sqrt(frames)
    lasting = _if_above(mean, of_mean)
    if lasting.any():  # what passes a ridge changes its shape to one side and to the other, not in between
        gap = np.ones((settings.distortion_gap + 1, 1), np.uint8)
        swings = cv2.morphologyEx(lasting[:, None], cv2.MORPH_CLOSE, gap)[:, 0]
        lasting = np.fmax(lasting, swings / np.sqrt(2))
    above = np.fmax(_if_above(single, least), lasting)
    rows = typical_rows(len(values))
    typical, own = nan_median(mean[rows]) / NORMAL_MEDIAN, nan_median(noise[rows]) / np.sqrt(frames)
    chance = 1 + 2 * np.sqrt(2 * frames / len(values))  # of so many means of noise
    excess = np.sqrt(np.where(typical**2 > chance * own**2, np.abs(typical**2 - own**2), 0.0))
    certain = _if_above(typical, settings.distortion_sigmas * own)
    return np.fmax(certain, above), np.fmax(excess, above)


def _if_above(size: Floats, least: Floats | float) -> Floats:
    """Return sizes that exceed `least`, and 0 for the others."""
    return np.where(size > least, size, 0.0)


def levels_around(bright: Floats32, x_px: Floats, half: int) -> Floats:
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


def _shift_by_light(
    rest_px: Floats, log_height: Floats, pulled_px2: Floats, settings: TrackingSettings
) -> Floats:
    r"""Return the shift of each ridge due to light L that falls off over it, px, (frame, N).

    rest_px: usual position of each sheet, (N,). pulled_px2: shift of each ridge per slope :math:`L'/L`, px²,
    (frame, N): that of the fit of the mean shape to :math:`u\,(a + b\,S(u))`, since the light between the
    ridges slopes as well. It and log_height, (frame, N), are changed in place.

    A Gaussian in such light remains a Gaussian, shifted by :math:`\sigma_r^2 L'/L`, so that only heights
    reveal the shift. A lamp that moves, or the edge of a shadow, shows as a slope between a sheet and its
    neighbours on both sides, beyond the scatter of single sheets. Light that tilts over the whole comb shifts
    all sheets alike, as a camera that shakes does, and shows in far smaller slopes (`_tilt`). Fewer than five
    sheets do not show that scatter: every change of the slope between two sheets, beyond its noise in time,
    then counts as light.
    """

    def smooth(of_sheet: Floats) -> None:
        of_sheet[:] = mean_over(of_sheet, settings.distortion_frames)

    light = log_height
    light -= typical_median(light)
    light -= nan_median(light, axis=1)[:, None]  # exposure
    if light.shape[1] >= ENOUGH:
        scatter = _scatter_across(light)
        shift = np.zeros_like(light)
        np.fmax(shift, _tilt(light, rest_px, scatter, settings)[:, None], out=shift)
        _raise_to_slope_across(shift, light, rest_px, scatter, settings)
        in_two_threads(smooth, light.T)
        _raise_to_slope_across(shift, light, rest_px, _scatter_across(light), settings)
    else:
        with np.errstate(divide="ignore", invalid="ignore"):
            slope = np.diff(light, axis=1) / np.diff(rest_px)
        noise = np.broadcast_to(position_noise(slope), slope.shape)
        for between, own in zip(slope.T, noise.T, strict=True):
            between[:] = _significant(between, np.fmax(own, 0.0), settings)[1]
        shift = np.fmax(np.pad(slope, ((0, 0), (1, 0))), np.pad(slope, ((0, 0), (0, 1))))
    pulled_px2 *= shift
    return pulled_px2


def _raise_to_slope_across(
    size: Floats, light: Floats, rest_px: Floats, scatter: float, settings: TrackingSettings
) -> None:
    """Raise `size` to the slope of the light from sheet to sheet, per px, (frame, N), where it is no scatter.

    It is the smaller of the slopes to both neighbours if these have the same sign, and its scatter is that of
    single sheets against the mean of their neighbours. The first and last sheet have that of their neighbour.
    """
    apart = np.diff(rest_px)
    apart_px = float(nan_median(apart))
    apart = np.where(apart > 0, apart, np.nan)
    least = settings.distortion_sigmas * np.sqrt(2) * scatter / apart_px
    for rows in row_parts(len(light)):
        with np.errstate(divide="ignore", invalid="ignore"):
            slope = np.diff(light[rows], axis=1) / apart
        left, right = slope[:, :-1], slope[:, 1:]
        smaller = np.where(left * right > 0, np.fmin(np.abs(left), np.abs(right)), 0.0)
        across = np.pad(_if_above(smaller, least), ((0, 0), (1, 1)), "edge")
        np.fmax(size[rows], across, out=size[rows])


def _tilt(light: Floats, rest_px: Floats, scatter: float, settings: TrackingSettings) -> Floats:
    """Return the size of the slope of the light over the whole comb, per px, (frame,); 0 where it is scatter.
    It is the median over all pairs of sheets that are half the comb apart, which single sheets and shadows do
    not change."""
    half = light.shape[1] // 2
    apart = rest_px[half:] - rest_px[:-half]
    apart = np.where(apart > 0, apart, np.nan)
    slope = np.empty(len(light))
    for rows in row_parts(len(light)):
        slope[rows] = np.abs(nan_median((light[rows, half:] - light[rows, :-half]) / apart, axis=1))
    of_median = np.sqrt(np.pi / 2 / len(apart)) * np.sqrt(2) * scatter / nan_median(apart)
    return np.nan_to_num(_if_above(slope, settings.distortion_sigmas * of_median))


def _single_width_changes(log_width: Floats, settings: TrackingSettings) -> Floats32:
    """Return by how much each ridge alone became wider or narrower, (frame, N); 0 where it is scatter.

    It is the change against the median of the two sheets on either side, or against the ridge's own usual
    width if that is smaller. Widths of sheets in brighter noise scatter by more from frame to frame, and may
    change by more, as may all in frames in which most change: overexposed ridges widen by unlike amounts.
    log_width: the logarithm of the width, (frame, N). 0 where none of these sheets is seen,
    and for fewer than five.
    """
    frames, sheets = log_width.shape
    alone = np.zeros((frames, sheets), np.float32)
    if sheets < ENOUGH:
        return alone
    middle = typical_median(log_width)
    least = max(settings.covered_width, settings.distortion_sigmas * _scatter_across(log_width, middle))
    for rows in row_parts(frames):
        around = np.pad(log_width[rows] - middle, ((0, 0), (2, 2)), constant_values=np.nan)
        others = np.stack([around[:, k : k + sheets] for k in (0, 1, 3, 4)])
        own = around[:, 2:-2]
        alone[rows] = np.minimum(np.abs(own - nan_median(others)), np.abs(own))
    noise = typical_medians(
        lambda rows: np.abs(log_width[1:][rows] - log_width[:-1][rows]), max(0, frames - 1)
    )
    with np.errstate(divide="ignore", invalid="ignore"):  # in films without noise
        louder = np.clip(np.nan_to_num(noise / nan_median(noise)), 1.0, MOST_LOUDER)
    for rows in row_parts(frames):
        changed = alone[rows].astype(np.float64)
        together = FAR_BEYOND * nan_median(changed, axis=1)[:, None]
        alone[rows] = _if_above(changed, np.fmax(least * louder, together))
    return alone


def _scatter_across(light: Floats, middle: Floats | float = 0.0) -> float:
    """Return the scatter of single sheets against the mean of their neighbours, less the `middle` of each."""
    some = light[typical_rows(len(light))] - middle
    bend = some[:, 1:-1] - (some[:, :-2] + some[:, 2:]) / 2
    return float(nan_median(np.abs(bend).ravel()) / NORMAL_MEDIAN / np.sqrt(1.5))
