"""Ridge positions to a hundredth of a pixel, one function per fit, each with its error.

The fits take the profile (frame, x) and whole-pixel starting points, and return positions in px (pixel
centres at integers) and the error that one grey level of white pixel noise would give them. Ridges are
bright: pass the negative profile for dark ones. `fit_sheets` runs a fit on all sheets of all frames;
`intensity_noise` and `position_noise` measure the noise that errors of positions come from.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Literal, NamedTuple

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from vision.errors import InputError
from vision.numeric import NORMAL_MEDIAN, Bools, Floats, Floats32, Ints, nan_median
from vision.sheets.ridges import FRAMES_PER_BLOCK, RidgeComb
from vision.sheets.settings import DEFAULT, TrackingSettings

FitName = Literal["sliding", "paper", "template"]
FitChoice = Literal["auto", "sliding", "paper", "template"]

LEAST_TRIPLES = 8  # groups of three consecutive frames from which noise is measured


class FittedPositions(NamedTuple):
    """One entry per starting point.

    Parameters
    ----------
    x_px
        Position, NaN where the fit has no answer.
    err_per_noise
        Standard error of the position, px, per grey level of white noise in the profile.
    """

    x_px: Floats
    err_per_noise: Floats


class Starts(NamedTuple):
    """Where to fit: frame number (row of the profile) and whole pixel, both (points,)."""

    frame: Ints
    x: Ints


# --- the three fits -----------------------------------------------------------------------------------------


def paper_vertex(
    profile: NDArray[np.floating], starts: Starts, *, window_px: int = 9, search_px: int = 3
) -> FittedPositions:
    r"""Vertex of the least-squares parabola through `window_px` pixels centred on the brightest one.

    The publication's method, exactly. It locks to whole pixels (50–190 mpx peak to peak), which
    `sliding_vertex` does not.

    Parameters
    ----------
    profile
        Grey levels (frame, x), bright ridges.
    starts
        Where to look, (points,).
    window_px
        Odd width of the fit window.
    search_px
        The brightest pixel is looked for this far to either side of the start.

    Returns
    -------
    FittedPositions
        NaN where the window leaves the frame, the brightest pixel lies at the end of the search, the parabola
        has no maximum, or its vertex lies outside the window.

    Notes
    -----
    With the parabola :math:`I = a + b\,(x - x_0) + c\,(x - x_0)^2` fitted around the brightest pixel
    :math:`x_0`, the position is

    .. math:: x = x_0 - \frac{b}{2c}, \qquad c < 0 .

    Equals `numpy.polyfit` to rounding. Source: paper, appendix B.
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
    return FittedPositions(np.where(bad, np.nan, centre + vertex), np.where(bad, np.nan, noise))


def sliding_vertex(profile: NDArray[np.floating], starts: Starts, *, window_px: int = 9) -> FittedPositions:
    r"""Ridge positions where the slope of the least-squares parabola is zero.

    A parabola fitted to `window_px` pixels has, at its centre, a slope that is one fixed linear filter of
    the profile. A ridge lies where that slope falls through zero as the window slides, so unlike the
    vertex of a window pinned to the brightest pixel the result does not lock to whole pixels.

    Parameters
    ----------
    profile
        Grey levels (frame, x), bright ridges.
    starts
        Where to look, (points,).
    window_px
        Odd width of the fit window.

    Returns
    -------
    FittedPositions
        NaN where the slope does not fall through zero within half a window of the start, or the window leaves
        the frame.

    Notes
    -----
    The slope, with :math:`h` half the window,

    .. math:: b(x) = \frac{\sum_{j=-h}^{h} j\, I(x + j)}{\sum_{j=-h}^{h} j^2} ,

    is interpolated between pixels by the cubic through its four neighbours; of several zeros the one nearest
    the start counts. Its error is that of the slope over :math:`|b'(x)|`.
    Source: paper, appendix B; Savitzky & Golay 1964.
    """
    half, width = window_px // 2, profile.shape[1]
    slope = _slope(profile, window_px).ravel()
    left = np.flatnonzero((slope[:-1] >= 0) & (slope[1:] < 0))
    column = left % width
    left = left[(column >= half) & (column <= width - 2 - half)]  # the parabola stands inside the frame
    at, found = _nearest(left, slope, starts.frame * width + starts.x, half)
    four = slope[np.clip(at + np.arange(-1, 3)[:, None], 0, len(slope) - 1)].astype(np.float64)
    step, steepness = _cubic_zero(four)
    frame, column = np.divmod(at, width)
    found &= np.isfinite(step) & (frame == starts.frame)
    err = 1 / np.sqrt((np.arange(-half, half + 1) ** 2).sum()) / np.abs(steepness)
    return FittedPositions(np.where(found, column + step, np.nan), np.where(found, err, np.nan))


def template_shift(
    profile: NDArray[np.floating], starts: Starts, shape: NDArray[np.integer], x_px: Floats, *, half_px: int
) -> FittedPositions:
    """Positions by matching each ridge to its own mean shape.

    The pixels of all ridges of one sheet, each shifted by its first position, give the mean shape and its
    derivative at any fraction of a pixel (a least-squares spline). One Gauss-Newton step then fits shift,
    brightness and background together, twice over. The mean shift over all of a sheet's ridges is
    subtracted, so a template never moves a sheet's mean position.

    Parameters
    ----------
    profile
        Grey levels (frame, x), bright ridges.
    starts, shape, x_px
        Of each ridge (points,): frame and whole pixel; which template it belongs to; its first position, from
        `sliding_vertex`.
    half_px
        Half-width of the template.

    Returns
    -------
    FittedPositions
        NaN where x_px is NaN, the window leaves the frame, or the step is larger than a pixel.

    Notes
    -----
    Least-squares matching. The scatter is 1.00–1.04 of the Cramér–Rao bound at FWHM 6–10 px.
    """
    centre = np.rint(np.nan_to_num(x_px)).astype(np.int64)
    offsets = np.arange(-half_px, half_px + 1)
    pixels = gather(profile, Starts(starts.frame, centre), offsets)
    position, err = np.array(x_px, np.float64), np.full(len(x_px), np.nan)
    usable = np.isfinite(position) & np.isfinite(pixels).all(axis=1)
    for which in np.unique(shape[usable]):
        mine = np.flatnonzero(usable & (shape == which))
        fraction = position[mine] - centre[mine]
        position[mine], err[mine] = _match(pixels[mine], fraction, centre[mine])
    return FittedPositions(np.where(np.isfinite(err), position, np.nan), err)


def gather(profile: NDArray[np.floating], starts: Starts, offsets: NDArray[np.integer]) -> Floats:
    """Pixels at consecutive `offsets` from each start, (points, offsets), NaN outside the frame."""
    missing = max(0, len(offsets) - profile.shape[1])
    padded = np.pad(profile, ((0, 0), (0, missing)), constant_values=np.nan) if missing else profile
    last = padded.shape[1] - 1
    wanted = starts.x + offsets[0]
    first = np.clip(wanted, 0, last + 1 - len(offsets))
    pixels = sliding_window_view(padded, len(offsets), axis=1)[starts.frame, first].astype(np.float64)
    cut = np.flatnonzero(first != wanted)  # a few, near the ends
    columns = starts.x[cut, None] + offsets
    inside = np.clip(columns, 0, last)
    pixels[cut] = np.where(columns == inside, padded[starts.frame[cut, None], inside], np.nan)
    return np.asarray(pixels, np.float64)


def _quadratic_norm(offsets: NDArray[np.integer]) -> float:
    centred = offsets.astype(np.float64) ** 2
    return float(((centred - centred.mean()) ** 2).sum())


def _parabola(pixels: Floats, offsets: NDArray[np.integer]) -> tuple[Floats, Floats]:
    """Slope and second-degree coefficient of the least-squares parabola through rows of pixels."""
    linear = offsets / (offsets**2).sum()
    square = offsets.astype(np.float64) ** 2
    quadratic = (square - square.mean()) / _quadratic_norm(offsets)
    level = pixels - pixels.mean(axis=1, keepdims=True)
    return level @ linear, level @ quadratic


def _slope(profile: NDArray[np.floating], window_px: int) -> Floats32:
    """Slope of the sliding parabola at every pixel, grey levels per px."""
    offsets = np.arange(-(window_px // 2), window_px // 2 + 1)
    kernel = (offsets / (offsets**2).sum())[None, :]
    clean = np.ascontiguousarray(profile, np.float32)
    return np.asarray(cv2.filter2D(clean, cv2.CV_32F, kernel, borderType=cv2.BORDER_REPLICATE), np.float32)


def _nearest(left: Ints, slope: Floats32, start: Ints, reach: int) -> tuple[Ints, Bools]:
    """Of the pixels just left of a zero, the one whose zero is nearest each start, and whether it is within
    reach."""
    if not len(left):
        return np.zeros_like(start), np.zeros(len(start), bool)
    zero = left + slope[left] / (slope[left].astype(np.float64) - slope[left + 1])
    after = np.searchsorted(zero, start)
    before, after = np.maximum(after - 1, 0), np.minimum(after, len(zero) - 1)
    chosen = np.where(np.abs(zero[before] - start) <= np.abs(zero[after] - start), before, after)
    return left[chosen], np.abs(zero[chosen] - start) <= reach


def _cubic_zero(four: Floats) -> tuple[Floats, Floats]:
    """Zero in [0, 1] of the cubic through values at −1, 0, 1, 2 (4, points), and its derivative there; Newton
    from the chord."""
    a, b, c, d = four
    cubic = np.stack([(-a + 3 * b - 3 * c + d) / 6, (a - 2 * b + c) / 2, c - b / 2 - a / 3 - d / 6, b])
    with np.errstate(divide="ignore", invalid="ignore"):
        t = b / (b - c)
        for _ in range(4):
            value = ((cubic[0] * t + cubic[1]) * t + cubic[2]) * t + cubic[3]
            rise = (3 * cubic[0] * t + 2 * cubic[1]) * t + cubic[2]
            t = np.clip(t - value / rise, 0.0, 1.0)
    return t, (3 * cubic[0] * t + 2 * cubic[1]) * t + cubic[2]


def _match(pixels: Floats, fraction: Floats, centre: Ints) -> tuple[Floats, Floats]:
    """Positions of one sheet's ridges against their mean shape, and their error per grey level of noise."""
    step = np.zeros_like(fraction)
    err = np.full_like(fraction, np.nan)
    for _ in range(2):
        try:
            mean, rise = _mean_shape(fraction + step, pixels)
        except np.linalg.LinAlgError:
            return fraction + centre, err
        more, err = _gauss_newton(pixels, mean, rise)
        if not np.isfinite(more).any():
            return fraction + centre, err
        step += more - np.nanmean(more)
    bad = ~(np.abs(step) <= 1.0)
    return np.where(bad, np.nan, fraction + step + centre), np.where(bad, np.nan, err)


_PIECES = np.array([[1, -3, 3, -1], [4, 0, -6, 3], [1, 3, 3, -3], [0, 0, 0, 1]]) / 6
"""The four cubic B-splines over one cell of even knots: coefficients of 1, t, t², t³ for t from 0 to 1."""


def _mean_shape(shift_px: Floats, pixels: Floats) -> tuple[Floats, Floats]:
    """Value and slope of one sheet's mean shape at each pixel: a least-squares cubic spline through all.

    shift_px: by how much each ridge is shifted, (ridges,). pixels: (ridges, pixels). Knots stand between the
    pixels of a ridge that is not shifted. All pixels of a ridge lie at the same place between two knots, so
    that sums over ridges are products of matrices. Beyond the knots the outermost cells go on.
    """
    cells = pixels.shape[1]
    normal, right = np.zeros((cells + 3, cells + 3)), np.zeros(cells + 3)
    at = 0.5 - np.clip(shift_px, -cells, cells)  # of the first pixel among the knots
    whole = np.floor(at)
    kinds = np.unique(whole[np.isfinite(whole)])
    groups = [(whole == first, np.arange(cells) + int(first)) for first in kinds]
    place, four = at - whole, np.arange(4)
    for mine, column in groups:
        cell = np.clip(column, 0, cells - 1)
        powers = place[mine, None] ** four
        blocks = np.tile(powers.T @ powers, (cells, 1, 1))  # (cell, 4, 4)
        loads = pixels[mine].T @ powers
        for beyond in np.flatnonzero(cell != column):  # these pixels count at the outermost knot
            end = (np.sign(column[beyond]) > 0) ** four.astype(float)
            blocks[beyond], loads[beyond] = mine.sum() * np.outer(end, end), pixels[mine, beyond].sum() * end
        row = cell[:, None] + four
        np.add.at(normal, (row[:, :, None], row[:, None, :]), _PIECES @ blocks @ _PIECES.T)
        np.add.at(right, row, loads @ _PIECES.T)
    found = np.linalg.solve(normal, right)
    cubic = found[np.arange(cells)[:, None] + four] @ _PIECES
    mean, rise = np.full_like(pixels, np.nan), np.full_like(pixels, np.nan)
    for mine, column in groups:
        cell = np.clip(column, 0, cells - 1)
        powers = place[mine, None] ** four
        mean[mine] = powers @ cubic[cell].T
        rise[mine] = powers[:, :3] @ (cubic[cell, 1:] * four[1:]).T
        for beyond in np.flatnonzero(cell != column):
            powers = (place[mine, None] + column[beyond] - cell[beyond]) ** four
            mean[mine, beyond] = powers @ cubic[cell[beyond]]
            rise[mine, beyond] = powers[:, :3] @ (cubic[cell[beyond], 1:] * four[1:])
    return mean, rise


def _gauss_newton(pixels: Floats, mean: Floats, rise: Floats) -> tuple[Floats, Floats]:
    """Shift that brings the mean shape onto the pixels, with brightness and level fitted alongside.

    Level and brightness are eliminated: of the normal equations for the shift and the brightness, both less
    their means over the pixels, only the shift is solved for.
    """
    shift, shape = rise.mean(axis=1, keepdims=True) - rise, mean - mean.mean(axis=1, keepdims=True)
    rest = pixels - mean
    shift_shift, shift_shape, shape_shape = (
        np.einsum("ij,ij->i", a, b) for a, b in ((shift, shift), (shift, shape), (shape, shape))
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        shared = shift_shape / shape_shape
        alone = shift_shift - shared * shift_shape
        found = np.einsum("ij,ij->i", shift, rest) - shared * np.einsum("ij,ij->i", shape, rest)
        return found / alone, np.sqrt(1 / alone)


# --- all sheets of all frames -------------------------------------------------------------------------------


def choose_window(
    comb: RidgeComb,
    asked: int | Literal["auto"] | None,
    *,
    settings: TrackingSettings = DEFAULT,
) -> int:
    """Width of the fit window, px, odd.

    Parameters
    ----------
    comb
        Width and pitch of the ridges.
    asked
        A width, which is taken as it is; "auto" for one that follows the ridges' width; None for the
        publication's where that suits the ridges' width, else as "auto".
    settings
        Standard window, and window per ridge width.

    Returns
    -------
    int

    Raises
    ------
    InputError
        For an even window, one below 3 px, or one wider than the ridges' spacing.
    """
    if isinstance(asked, int):
        if asked < 3 or asked % 2 == 0:
            raise InputError(
                "`window_px`", "an odd number of pixels, 3 or more", str(asked), "try `window_px` auto"
            )
        if asked > comb.pitch_px:
            near = f"a window no wider than the ridges' spacing, {comb.pitch_px:.0f} px"
            raise InputError("`window_px`", near, str(asked), "try `window_px` auto")
        return asked
    narrow, wide = settings.standard_widths_px
    if asked is None and narrow <= comb.fwhm_px <= wide:
        return settings.standard_window_px
    widest = max(5.0, 0.9 * comb.pitch_px)
    return 2 * round((min(max(5.0, settings.window_per_width * comb.fwhm_px), widest) - 1) / 2) + 1


def fit_sheets(
    bright: Floats32, start_px: Floats, *, fit: FitName, window_px: int, comb: RidgeComb
) -> tuple[Floats, Floats]:
    """Positions and their error per grey level of noise, both (frame, N), NaN where start_px is.

    Parameters
    ----------
    bright
        Profile with bright ridges (frame, x).
    start_px
        Whole pixels (frame, N), NaN for none.
    fit, window_px
        Method and width of its window.
    comb
        Width and pitch of the ridges.
    """
    x, err = np.full(start_px.shape, np.nan), np.full(start_px.shape, np.nan)
    search_px = max(2, round(comb.fwhm_px / 2))

    def run(rows: slice) -> None:
        known = np.isfinite(start_px[rows])
        frame, sheet = np.nonzero(known)
        starts = Starts(frame, start_px[rows][known].astype(np.int64))
        if fit == "paper":
            done = paper_vertex(bright[rows], starts, window_px=window_px, search_px=search_px)
        else:
            done = sliding_vertex(bright[rows], starts, window_px=window_px)
        x[rows][frame, sheet], err[rows][frame, sheet] = done

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(run, [slice(i, i + FRAMES_PER_BLOCK) for i in range(0, len(bright), FRAMES_PER_BLOCK)]))
    return _matched(bright, x, comb) if fit == "template" else (x, err)


def learned_template(
    bright: Floats32, x_px: Floats, err: Floats, comb: RidgeComb, *, settings: TrackingSettings = DEFAULT
) -> tuple[Floats, Floats, Bools]:
    """Positions against each sheet's mean shape where that is learned well, else those of the sliding window.

    Parameters
    ----------
    bright
        Profile with bright ridges (frame, x).
    x_px, err
        Positions and errors per grey level by the sliding window (frame, N).
    comb
        Width and pitch of the ridges.
    settings
        The fields `template_…`.

    Returns
    -------
    x_px, err, learned
        Positions and errors (frame, N); whether each sheet's are the template's (N,).

    Notes
    -----
    A mean shape is known between pixels only if its sheet moved over them, in enough frames. It is used for a
    sheet if it answers wherever the window does, follows its motion with the same scale, and scatters less
    from frame to frame; for none if it fails for most sheets, or the film is too long.
    """
    none = np.zeros(x_px.shape[1], bool)
    seen = np.isfinite(x_px)
    enough = seen.sum(axis=0) >= settings.template_frames
    if not enough.any() or seen.sum() > settings.template_ridges:
        return x_px, err, none
    moved = x_px - nan_median(x_px)
    spread = nan_median(np.abs(moved)) / NORMAL_MEDIAN
    learned = enough & (spread >= settings.template_motion_px)
    if learned.mean() < 0.5:
        return x_px, err, none
    there, own_err = _matched(bright, np.where(learned, x_px, np.nan), comb)
    answers = (np.isfinite(there) | ~seen).mean(axis=0) > 0.99
    both = np.isfinite(there) & seen
    ours, theirs = np.where(both, moved, 0.0), np.where(both, there - nan_median(x_px), 0.0)
    scale = (ours * theirs).sum(axis=0) / np.maximum((ours**2).sum(axis=0), 1e-12)
    new = seen.any(axis=1)  # frames that repeat the one before are none
    with np.errstate(invalid="ignore"):
        better = position_noise(there[new]) <= position_noise(x_px[new])
    learned &= answers & (np.abs(scale - 1) < settings.template_scale) & better
    if learned.mean() < 0.5:
        return x_px, err, none
    take = learned & np.isfinite(there)
    return np.where(take, there, x_px), np.where(take, own_err, err), learned


def locking_error(
    x_px: Floats, bright: Floats32, start_px: Floats, window_px: int, comb: RidgeComb
) -> Floats:
    """Distance of the paper fit's positions from where the sliding slope is zero, px, (frame, N).

    The paper's fit locks to whole pixels by more than the noise; this is that error, as the recording itself
    shows it. 0 where it is unknown.
    """
    free, _ = fit_sheets(bright, start_px, fit="sliding", window_px=window_px, comb=comb)
    return np.nan_to_num(np.abs(x_px - free), nan=0.0)


def _matched(bright: Floats32, x: Floats, comb: RidgeComb) -> tuple[Floats, Floats]:
    """Positions against each sheet's own mean shape, from those of the sliding window."""
    known = np.isfinite(x)
    frame, sheet = np.nonzero(known)
    half = max(3, round(min(0.9 * comb.fwhm_px, 0.5 * comb.pitch_px)))
    done = template_shift(
        bright, Starts(frame, np.rint(x[known]).astype(np.int64)), sheet, x[known], half_px=half
    )
    out, err = np.full(x.shape, np.nan), np.full(x.shape, np.nan)
    out[known], err[known] = done
    return out, err


# --- noise --------------------------------------------------------------------------------------------------


def intensity_noise(profile: NDArray[np.floating], x_px: Floats, *, half_px: int, fallback: float) -> Floats:
    """Standard deviation of the profile's noise around each sheet, grey levels, (N,).

    From second differences in time of the pixels around a ridge, taken along with all sheets by whole pixels,
    less what its motion and flicker (level, brightness, first and second derivative of the ridge) explain: so
    the paper's texture and a shaking camera are no noise, and bright ridges may be noisier. The median over
    groups of three frames ignores slips.

    Parameters
    ----------
    profile, x_px
        Grey levels (frame, x); positions (frame, N), NaN where missing.
    half_px
        Half-width of the pixels taken, at least 5.
    fallback
        For sheets seen in fewer than eight groups of three frames.
    """
    half = max(half_px, 5)
    middle = _triples(x_px)
    if len(middle) < LEAST_TRIPLES:
        return np.full(x_px.shape[1], fallback)
    centre = np.nan_to_num(np.rint(x_px[middle]), nan=-10 * half).astype(np.int64)
    offsets = np.arange(-half - 1, half + 2)
    before, now, after = (
        gather(profile, Starts(np.repeat(middle + step, x_px.shape[1]), (centre + carried).ravel()), offsets)
        for step in (-1, 0, 1)
        for carried in [_common_steps(x_px, middle, step)[:, None]]
    )
    variance = _residual_variance(before + after - 2 * now, (before + now + after) / 3)
    variance = variance.reshape(len(middle), -1) / 6
    known = np.isfinite(variance).sum(axis=0) >= LEAST_TRIPLES
    typical = nan_median(variance, axis=0)
    return np.asarray(np.where(known, np.sqrt(typical), fallback), np.float64)


def _common_steps(x_px: Floats, middle: Ints, step: int) -> Ints:
    """Whole pixels by which all sheets are carried from frames `middle` to those `step` further."""
    carried = nan_median(x_px[middle + step] - x_px[middle], axis=1)
    return np.asarray(np.rint(np.nan_to_num(carried)), np.int64)


def position_noise(x_px: Floats) -> Floats:
    """Standard deviation of the positions from frame to frame, px, as measured.

    From second differences in time, so that a steady creep does not count, less their median over the
    sheets, so that vibration of the camera does not either (with five sheets or more); median absolute
    value, so slips do not.

    Parameters
    ----------
    x_px
        Positions (frame, N), NaN where missing.

    Returns
    -------
    (N,), NaN for sheets seen in fewer than eight groups of three consecutive frames.
    """
    second = x_px[2:] - 2 * x_px[1:-1] + x_px[:-2]
    if x_px.shape[1] >= 5 and len(second):
        second = second - np.nan_to_num(nan_median(second, axis=1))[:, None]
    known = np.isfinite(second).sum(axis=0) >= LEAST_TRIPLES
    if not len(second):
        return np.full(x_px.shape[1], np.nan)
    typical = nan_median(np.abs(second), axis=0)
    return np.asarray(np.where(known, typical / NORMAL_MEDIAN / np.sqrt(6), np.nan), np.float64)


def _triples(x_px: Floats) -> Ints:
    """Middle frames of triples in which most sheets are seen, spread over the recording."""
    seen = np.isfinite(x_px).mean(axis=1) > 0.5
    middle = 1 + np.flatnonzero(seen[2:] & seen[1:-1] & seen[:-2])
    if not len(middle):
        return np.asarray(middle, np.int64)
    return np.unique(middle[np.linspace(0, len(middle) - 1, 400).astype(int)])


def _residual_variance(change: Floats, mean: Floats) -> Floats:
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
