"""Ridge positions to a hundredth of a pixel: one function per fit, each with its error.

The fits take the profile (frame, x) and whole-pixel starting points. They return positions in px (pixel
centres at integers) and the error that one grey level of white pixel noise would cause. Ridges are bright:
pass the negative profile for dark ones. `fit_sheets` fits all sheets in all frames; `intensity_noise` and
`position_noise` measure noise.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from vision.errors import InputError, shown
from vision.memory import give_back, in_two_threads, row_parts, some_rows, table_beside
from vision.numeric import (
    NORMAL_MEDIAN,
    Bools,
    Floats,
    Floats32,
    Ints,
    nan_median,
    nan_quantile,
    spread_indices,
    typical_median,
    typical_medians,
    typical_size,
)
from vision.sheets.ridges import RidgeComb, in_blocks
from vision.sheets.settings import TrackingSettings

FitName = Literal["sliding", "paper", "template"]
FitChoice = Literal["auto", "sliding", "paper", "template"]

WHOLE_LEVELS = 0.05  # grey: noise assumed where a profile, averaged over some rows, shows none
STEADY_FRAMES = 9  # whose mean height gives the error of a template position: single heights are noisy
LEAST_EXPLAINED = 0.5  # share of the variance of a ridge's pixels; below it most of them show something else
RIDGES_AT_ONCE = 8192  # whose pixels are matched at once
FRAMES_AT_ONCE = 512  # of which a sheet's pixels are gathered at once: each takes a page of a file or more
TRIPLES_AT_ONCE = 32  # whose pixels fit into a core's cache
LEAST_TRIPLES = 8  # groups of three consecutive frames that a measurement of noise needs
AT_REST_PX = 0.1  # motion from frame to frame that hardly changes a ridge's pixels beyond a fitted shift
CORRELATED_RIDGES = 400  # differences of three ridges that tell correlated noise from chance
NO_MORE = 1.2  # most variance at six frames over that at four, of noise that lasts for fewer
NO_LESS = 0.9  # least variance at four and six frames over that at a shorter lag, of noise that lasts


class FittedPositions(NamedTuple):
    """Positions and errors, one per starting point."""

    x_px: Floats  # NaN where the fit fails
    err_per_noise: Floats  # standard error of the position, px, per grey level of white noise in the profile


class Starts(NamedTuple):
    """Starting points of a fit: frame number (row of the profile) and whole pixel, both (points,)."""

    frame: Ints
    x: Ints


# --- the three fits -----------------------------------------------------------------------------------------


def paper_vertex(
    profile: NDArray[np.floating], starts: Starts, *, window_px: int = 9, search_px: int = 3
) -> FittedPositions:
    r"""Return the vertex of the least-squares parabola through pixels centred on the brightest one.

    This is exactly the publication's method. It locks to whole pixels (50–190 mpx peak to peak), which
    `sliding_vertex` does not.

    Parameters
    ----------
    profile
        Grey levels (frame, x), bright ridges.
    starts
        Starting points, (points,).
    window_px
        Odd width of the fit window.
    search_px
        Distance on either side of the start within which the brightest pixel is searched.

    Returns
    -------
    FittedPositions
        NaN where the window leaves the frame, the brightest pixel is at the limit of the search, the parabola
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
    r"""Return positions at which the slope of a sliding least-squares parabola is zero.

    The slope at the centre of a parabola fitted to `window_px` pixels is a fixed linear filter of the
    profile. A ridge lies where that slope falls through zero as the window slides. Unlike the vertex in a
    window centred on the brightest pixel, this position does not lock to whole pixels.

    Parameters
    ----------
    profile, starts, window_px
        As in `paper_vertex`.

    Returns
    -------
    FittedPositions
        NaN where the slope does not fall through zero within half a window of the start, or the window leaves
        the frame.

    Notes
    -----
    The slope, with :math:`h` half the window,

    .. math:: b(x) = \frac{\sum_{j=-h}^{h} j\, I(x + j)}{\sum_{j=-h}^{h} j^2} ,

    is interpolated between pixels by the cubic through its four neighbours. Of several zeros the one nearest
    to the start is used. Its error is that of the slope over :math:`|b'(x)|`.
    Source: paper, appendix B; Savitzky & Golay 1964.
    """
    half, width = window_px // 2, profile.shape[1]
    offsets = np.arange(-half, half + 1)
    kernel, clean = (offsets / (offsets**2).sum())[None, :], np.ascontiguousarray(profile, np.float32)
    filtered = cv2.filter2D(clean, cv2.CV_32F, kernel, borderType=cv2.BORDER_REPLICATE)
    slope = np.asarray(filtered.ravel(), np.float32)
    left = np.flatnonzero((slope[:-1] >= 0) & (slope[1:] < 0))
    column = left % width
    left = left[(column >= half) & (column <= width - 2 - half)]  # the parabola is inside the frame
    at, found = _nearest(left, slope, starts.frame * width + starts.x, half)
    four = slope[np.clip(at + np.arange(-1, 3)[:, None], 0, len(slope) - 1)].astype(np.float64)
    step, steepness = _cubic_zero(four)
    frame, column = np.divmod(at, width)
    found &= np.isfinite(step) & (frame == starts.frame)
    err = 1 / np.sqrt((offsets**2).sum()) / np.abs(steepness)
    return FittedPositions(np.where(found, column + step, np.nan), np.where(found, err, np.nan))


def match_sheet(
    profile: NDArray[np.floating], frame: Ints, x_px: Floats, half_px: int, *, dark: bool = False
) -> FittedPositions:
    """Return the positions of one sheet by matching each of its ridges to their mean shape.

    The pixels of all ridges of the sheet, each shifted by its initial position, give the mean shape and its
    derivative at any fraction of a pixel (a least-squares spline). A Gauss-Newton step then fits shift,
    brightness and background together; both are done twice, and the shape is learned from ridges without
    their brightness and background. The mean shift over the ridges is subtracted, so that the template never
    moves the sheet's mean position.

    Parameters
    ----------
    profile
        Grey levels (frame, x).
    frame, x_px
        For each ridge (ridges,): frame, and initial position from `sliding_vertex`, not NaN.
    half_px
        Half-width of the template.
    dark
        Whether ridges are dark, so that the negative profile is matched.

    Returns
    -------
    FittedPositions
        NaN where the window leaves the frame, or the step is larger than a pixel.

    Notes
    -----
    This is least-squares matching. Its scatter is 1.00–1.04 of the Cramér–Rao bound at FWHM 6–10 px.
    """
    centre = np.rint(x_px).astype(np.int64)
    position, err = np.full(len(x_px), np.nan), np.full(len(x_px), np.nan)
    offsets = np.arange(-half_px, half_px + 1)
    pixels = np.empty((len(frame), len(offsets)), profile.dtype)
    for rows in row_parts(len(frame), FRAMES_AT_ONCE):
        pixels[rows] = gather(profile, Starts(frame[rows], centre[rows]), offsets)
        give_back(profile)
    inside = np.isfinite(pixels).all(axis=1)
    if inside.any():
        if dark:
            np.negative(pixels, out=pixels)
        pixels, centre = pixels if inside.all() else pixels[inside], centre[inside]
        position[inside], err[inside] = _match(pixels, x_px[inside] - centre, centre)
    return FittedPositions(np.where(np.isfinite(err), position, np.nan), err)


def gather(profile: NDArray[np.floating], starts: Starts, offsets: NDArray[np.integer]) -> Floats:
    """Return pixels at consecutive `offsets` from each start, (points, offsets), NaN outside the frame."""
    missing = max(0, len(offsets) - profile.shape[1])
    padded = np.pad(profile, ((0, 0), (0, missing)), constant_values=np.nan) if missing else profile
    last = padded.shape[1] - 1
    wanted = starts.x + offsets[0]
    first = np.clip(wanted, 0, last + 1 - len(offsets))
    pixels = sliding_window_view(padded, len(offsets), axis=1)[starts.frame, first].astype(np.float64)
    cut = np.flatnonzero(first != wanted)  # the few windows near the ends
    columns = starts.x[cut, None] + offsets
    inside = np.clip(columns, 0, last)
    pixels[cut] = np.where(columns == inside, padded[starts.frame[cut, None], inside], np.nan)
    return np.asarray(pixels, np.float64)


def _quadratic_norm(offsets: NDArray[np.integer]) -> float:
    centred = offsets.astype(np.float64) ** 2
    return float(((centred - centred.mean()) ** 2).sum())


def _parabola(pixels: Floats, offsets: NDArray[np.integer]) -> tuple[Floats, Floats]:
    """Return slope and second-degree coefficient of the least-squares parabola through rows of pixels."""
    linear = offsets / (offsets**2).sum()
    square = offsets.astype(np.float64) ** 2
    quadratic = (square - square.mean()) / _quadratic_norm(offsets)
    level = pixels - pixels.mean(axis=1, keepdims=True)
    return level @ linear, level @ quadratic


def _nearest(left: Ints, slope: Floats32, start: Ints, reach: int) -> tuple[Ints, Bools]:
    """Return the pixel just left of the zero nearest to each start, and whether that zero is within reach.
    left: pixels just left of a zero of the slope."""
    if not len(left):
        return np.zeros_like(start), np.zeros(len(start), bool)
    zero = left + slope[left] / (slope[left].astype(np.float64) - slope[left + 1])
    after = np.searchsorted(zero, start)
    before, after = np.maximum(after - 1, 0), np.minimum(after, len(zero) - 1)
    chosen = np.where(np.abs(zero[before] - start) <= np.abs(zero[after] - start), before, after)
    return left[chosen], np.abs(zero[chosen] - start) <= reach


def _cubic_zero(four: Floats) -> tuple[Floats, Floats]:
    """Return the zero in [0, 1] of the cubic through values at −1, 0, 1, 2 (4, points), and its slope there.
    Newton's method, started at the zero of the chord."""
    a, b, c, d = four
    cubic = np.stack([(-a + 3 * b - 3 * c + d) / 6, (a - 2 * b + c) / 2, c - b / 2 - a / 3 - d / 6, b])
    with np.errstate(divide="ignore", invalid="ignore"):
        t = b / (b - c)
        for _ in range(4):
            value = ((cubic[0] * t + cubic[1]) * t + cubic[2]) * t + cubic[3]
            rise = (3 * cubic[0] * t + 2 * cubic[1]) * t + cubic[2]
            t = np.clip(t - value / rise, 0.0, 1.0)
    return t, (3 * cubic[0] * t + 2 * cubic[1]) * t + cubic[2]


def _match(pixels: NDArray[np.floating], fraction: Floats, centre: Ints) -> tuple[Floats, Floats]:
    """Match one sheet's ridges to their mean shape: positions, and their error per grey level of noise.

    The shape is that of ridges brought to the same level and height. Without this, light that changes while
    a sheet creeps over the pixels would become a part of the shape, and hold the positions back. Ridges of
    which the shape, upright, explains less than half of the variance of the pixels are covered by something
    else: they do not count for the shape, and have no position.
    """
    step, none = np.zeros_like(fraction), np.full_like(fraction, np.nan)
    level, height, alike = np.zeros_like(fraction), np.ones_like(fraction), np.ones(len(fraction), bool)
    update, err = np.empty((2, len(fraction)))
    for _ in range(2):
        try:
            cubic = _mean_shape(fraction + step, pixels, level, np.where(alike, height, 0.0))
        except np.linalg.LinAlgError:
            return none, none
        for rows in row_parts(len(pixels), RIDGES_AT_ONCE):
            grey = _less_mean(pixels[rows])
            fitted = _fit_shape(grey, *_shape_at(cubic, (fraction + step)[rows]))
            update[rows], err[rows], level[rows], height[rows], explained = fitted
            alike[rows] = explained >= LEAST_EXPLAINED * np.einsum("ij,ij->i", grey, grey)
        alike &= (np.abs(step + update) <= 1.0) & (height > 0)
        if not alike.any():
            return none, none
        step += update - update[alike].mean()
    share, steady = cv2.blur(np.stack([alike, np.where(alike, height, 0.0)], 1), (1, STEADY_FRAMES)).T
    with np.errstate(divide="ignore", invalid="ignore"):
        err *= share / steady
    return np.where(alike, fraction + step + centre, np.nan), np.where(alike, err, np.nan)


def _less_mean(pixels: NDArray[np.floating]) -> Floats:
    """Return pixels (ridges, pixels) less the mean of each ridge."""
    grey = pixels.astype(np.float64)
    grey -= grey.mean(axis=1, keepdims=True)
    return grey


_PIECES = np.array([[1, -3, 3, -1], [4, 0, -6, 3], [1, 3, 3, -3], [0, 0, 0, 1]]) / 6
"""The four cubic B-splines over one cell of even knots: coefficients of 1, t, t², t³ for t from 0 to 1."""


def _mean_shape(shift_px: Floats, pixels: NDArray[np.floating], level: Floats, height: Floats) -> Floats:
    """Return one sheet's mean shape, a least-squares cubic spline: its coefficients in each cell, (cells, 4).

    shift_px, level, height: of each ridge, (ridges,); height 0 for ridges that do not count. pixels: (ridges,
    pixels), of which the shape is the mean of (pixels − level) / height, weighted by the squared height since
    their noise is the same. Knots lie midway between the pixels of a ridge that is not shifted. All pixels of
    a ridge have the same position between two knots, so that sums over ridges are products of matrices.
    Beyond the knots the outermost cells are extrapolated.
    """
    cells, four = pixels.shape[1], np.arange(4)
    normal, right = np.zeros((cells + 3, cells + 3)), np.zeros(cells + 3)
    for rows in row_parts(len(pixels), RIDGES_AT_ONCE):
        grey = _less_mean(pixels[rows]) - level[rows, None]
        for mine, column, fraction in _in_cells(shift_px[rows], cells):
            cell = np.clip(column, 0, cells - 1)
            tall = height[rows][mine]
            weighted = fraction[:, None] ** four * tall[:, None]
            blocks = np.tile(weighted.T @ weighted, (cells, 1, 1))  # (cell, 4, 4)
            loads = grey[mine].T @ weighted
            for beyond in np.flatnonzero(cell != column):  # these pixels count at the outermost knot
                end = (np.sign(column[beyond]) > 0) ** four.astype(float)
                blocks[beyond] = tall @ tall * np.outer(end, end)
                loads[beyond] = grey[mine, beyond] @ tall * end
            row = cell[:, None] + four
            np.add.at(normal, (row[:, :, None], row[:, None, :]), _PIECES @ blocks @ _PIECES.T)
            np.add.at(right, row, loads @ _PIECES.T)
    spline = np.linalg.solve(normal, right)
    return np.asarray(spline[np.arange(cells)[:, None] + four] @ _PIECES, np.float64)


def _shape_at(cubic: Floats, shift_px: Floats) -> tuple[Floats, Floats]:
    """Return value and slope of a mean shape at each pixel of ridges that are shifted, (ridges, pixels)."""
    cells, four = len(cubic), np.arange(4)
    mean, rise = np.full((2, len(shift_px), cells), np.nan)
    for mine, column, fraction in _in_cells(shift_px, cells):
        cell = np.clip(column, 0, cells - 1)
        powers = fraction[:, None] ** four
        mean[mine] = powers @ cubic[cell].T
        rise[mine] = powers[:, :3] @ (cubic[cell, 1:] * four[1:]).T
        for beyond in np.flatnonzero(cell != column):
            powers = (fraction[:, None] + column[beyond] - cell[beyond]) ** four
            mean[mine, beyond] = powers @ cubic[cell[beyond]]
            rise[mine, beyond] = powers[:, :3] @ (cubic[cell[beyond], 1:] * four[1:])
    return mean, rise


def _in_cells(shift_px: Floats, cells: int) -> Iterator[tuple[Bools, Ints, Floats]]:
    """Yield ridges whose pixels lie in the same cells: which these are, the cell of each pixel, and where in
    its cell each ridge's pixels lie, from 0 to 1."""
    first_px = 0.5 - np.clip(shift_px, -cells, cells)  # position of the first pixel among the knots
    whole = np.floor(first_px)
    for first in np.unique(whole[np.isfinite(whole)]):
        mine = whole == first
        yield mine, np.arange(cells) + int(first), (first_px - whole)[mine]


def _fit_shape(pixels: Floats, mean: Floats, rise: Floats) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Fit the mean shape to the pixels of each ridge, of mean 0: shift, its error per grey level of noise at
    unit height, level, height, and the sum of squares that they explain, (ridges,).

    The fit is linear in level, height, and height times shift. The level is eliminated from the normal
    equations: the slope and the shape are taken less their means over the pixels.
    """
    rise_mean, shape_mean = rise.mean(axis=1, keepdims=True), mean.mean(axis=1, keepdims=True)
    shift, shape = rise_mean - rise, mean - shape_mean
    shift_shift, shift_shape, shape_shape, shift_pixels, shape_pixels = (
        np.einsum("ij,ij->i", a, b)
        for a, b in ((shift, shift), (shift, shape), (shape, shape), (shift, pixels), (shape, pixels))
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        shared = shift_shape / shape_shape
        alone = shift_shift - shared * shift_shape
        moved = (shift_pixels - shared * shape_pixels) / alone
        height = (shape_pixels - moved * shift_shape) / shape_shape
        level = moved * rise_mean[:, 0] - height * shape_mean[:, 0]
        explained = height * shape_pixels + moved * shift_pixels
        return moved / height, np.sqrt(1 / alone), level, height, explained


# --- all sheets of all frames -------------------------------------------------------------------------------


def check_window(window_px: Any) -> None:
    """Raise `InputError` for a width of the fit window that is not odd, "auto" or None."""
    odd = isinstance(window_px, int | np.integer) and window_px >= 3 and window_px % 2 == 1
    if not (odd or window_px is None or (isinstance(window_px, str) and window_px == "auto")):
        expected = "an odd number of pixels, 3 or more"
        raise InputError("`window_px`", expected, shown(window_px), "try `window_px` auto")


def choose_window(comb: RidgeComb, asked: int | Literal["auto"] | None, *, fit: FitChoice = "auto") -> int:
    """Return the width of the fit window, px, odd.

    Parameters
    ----------
    comb
        Width, top and pitch of the ridges.
    asked
        A given width; "auto" for a width that follows that of the ridges; None for the publication's width if
        it suits the ridges, else as for "auto". On a ridge with a flat top the publication's window sees no
        flank, and its positions are those of the texture on the top.
    fit
        With "paper", the publication's fit, tops count as round.

    Raises: InputError for an even window, one below 3 px, or one wider than the ridges' spacing.
    """
    check_window(asked)
    if isinstance(asked, int | np.integer):
        if asked > comb.pitch_px:
            narrower = f"a window no wider than the ridges' spacing, {comb.pitch_px:.0f} px"
            raise InputError("`window_px`", narrower, str(asked), "try `window_px` auto")
        return int(asked)
    narrow, wide = comb.settings.standard_widths_px
    flat = fit != "paper" and comb.top > comb.settings.flat_top
    if asked is None and narrow <= comb.fwhm_px <= wide and not flat:
        return comb.settings.standard_window_px
    # The flanks of a flat ridge stand at half its width, and those of close neighbours must stay outside.
    widest = comb.fwhm_px + 0.25 * (comb.pitch_px - comb.fwhm_px) if flat else 0.9 * comb.pitch_px
    width = max(5.0, min(comb.settings.window_per_width * comb.fwhm_px, widest))
    return 2 * round((width - 1) / 2) + 1


def fit_sheets(
    profile: Floats32, start_px: NDArray[np.floating], *, fit: FitName, window_px: int, comb: RidgeComb
) -> tuple[Floats, Floats]:
    """Return positions and their error per grey level of noise, both (frame, N), NaN where start_px is.

    profile: grey levels (frame, x). start_px: whole pixels (frame, N), NaN for none.
    """
    x, err = (table_beside(profile, start_px.shape, order="F") for _ in range(2))
    x[:], err[:] = np.nan, np.nan
    search_px = max(2, round(comb.fwhm_px / 2))

    def run(rows: slice) -> None:
        known = np.isfinite(start_px[rows])
        frame, sheet = np.nonzero(known)
        starts = Starts(frame, start_px[rows][known].astype(np.int64))
        bright = comb.bright(profile[rows])
        if fit == "paper":
            done = paper_vertex(bright, starts, window_px=window_px, search_px=search_px)
        else:
            done = sliding_vertex(bright, starts, window_px=window_px)
        x[rows][frame, sheet], err[rows][frame, sheet] = done

    in_blocks(run, profile)
    return _match_all(profile, x, comb) if fit == "template" else (x, err)


def learned_template(
    profile: Floats32, x_px: Floats, err: Floats, comb: RidgeComb
) -> tuple[Floats, Floats, Bools]:
    """Return template positions for sheets whose mean shape is learned well, and the given ones for others.

    x_px and err are positions and errors per grey level by the sliding window (frame, N); both are returned,
    and whether those of a sheet are from the template, (N,).

    A mean shape is known between pixels only if its sheet moved over them in enough frames. The template is
    used for a sheet if it has a position wherever the sliding window has, if both measure the same motion,
    and if it scatters less from frame to frame. It is used for no sheet if it fails for most, or if the film
    is too long.
    """
    settings = comb.settings
    none = np.zeros(x_px.shape[1], bool)
    count = np.isfinite(x_px).sum(axis=0)
    enough = count >= settings.template_frames
    if not enough.any() or count.sum() > settings.template_ridges:
        return x_px, err, none
    middle = typical_median(x_px)
    spread = typical_size(x_px, middle)
    learned = enough & (spread / NORMAL_MEDIAN >= settings.template_motion_px)
    if learned.mean() < 0.5:
        return x_px, err, none
    matched, matched_err = _match_all(profile, x_px, comb, learned)
    new = np.isfinite(x_px).any(axis=1)  # without repeated frames
    by_match, by_window = (x if new.all() else x[new] for x in (matched, x_px))
    with np.errstate(invalid="ignore"):
        learned &= position_noise(by_match) <= position_noise(by_window)
    for n in np.flatnonzero(learned).tolist():
        learned[n] = _same_motion(x_px[:, n] - middle[n], matched[:, n] - middle[n], settings)
    if learned.mean() < 0.5:
        return x_px, err, none
    for n in range(x_px.shape[1]):
        kept = np.isnan(matched[:, n]) | ~learned[n]
        matched[kept, n], matched_err[kept, n] = x_px[kept, n], err[kept, n]
    return matched, matched_err, learned


def _same_motion(by_window: Floats, by_match: Floats, settings: TrackingSettings) -> bool:
    """Return whether the template has a position wherever the sliding window has, and measures the same
    motion; both (frame,)."""
    seen, matched = np.isfinite(by_window), np.isfinite(by_match)
    both = matched & seen
    scale = (by_window[both] * by_match[both]).sum() / max(float((by_window[both] ** 2).sum()), 1e-12)
    complete = (matched | ~seen).mean() > 0.99
    return bool(complete and abs(scale - 1) < settings.template_scale)


def _match_all(
    profile: Floats32, x: Floats, comb: RidgeComb, sheets: Bools | None = None
) -> tuple[Floats, Floats]:
    """Match sheets, by default all, to their mean shapes, starting at positions x of the sliding window."""
    half = comb.half_px(0.9)
    out, err = (table_beside(profile, x.shape, order="F") for _ in range(2))
    out[:], err[:] = np.nan, np.nan

    def match(n: int) -> None:
        """Match one sheet, whose pixels alone are gathered: those of all sheets would take most memory."""
        frame = np.flatnonzero(np.isfinite(x[:, n]))
        dark = comb.polarity == "dark"
        out[frame, n], err[frame, n] = match_sheet(profile, frame, x[frame, n], half, dark=dark)

    chosen = np.ones(x.shape[1], bool) if sheets is None else sheets
    in_two_threads(match, np.flatnonzero(chosen).tolist())
    return out, err


# --- noise --------------------------------------------------------------------------------------------------


def intensity_noise(
    profile: NDArray[np.floating], x_px: Floats, frozen: Bools, *, half_px: int, fallback: float
) -> Floats:
    """Return the standard deviation of the profile's noise around each sheet, grey levels, (N,).

    It is measured from second differences in time of the pixels around a ridge. The pixels follow the common
    motion of all sheets by whole pixels, and changes that motion and flicker explain (level, brightness,
    first and second derivative of the ridge) are subtracted. Hence neither the texture of the paper nor
    vibration counts as noise. The median over groups of three frames ignores slips.

    profile, x_px: grey levels (frame, x); positions (frame, N), NaN where missing. frozen: frames that repeat
    the one before, which are left out, (frame,). half_px: half-width of the
    window; at least 5 are used. fallback: noise of sheets seen in fewer than eight groups of three frames.
    """
    variance = _noise_variance(profile, x_px, frozen, half_px=half_px)
    if len(variance) < LEAST_TRIPLES:
        return np.full(x_px.shape[1], fallback)
    known = np.isfinite(variance).sum(axis=0) >= LEAST_TRIPLES
    typical = nan_median(variance, axis=0)
    return np.asarray(np.where(known, np.sqrt(typical), fallback), np.float64)


def noise_correlation(
    profile: NDArray[np.floating], x_px: Floats, frozen: Bools, *, half_px: int, least: float
) -> float:
    r"""Return the correlation of the profile's noise between a frame and the next; 0 where it is not clear.

    profile, x_px, frozen, half_px: as for `intensity_noise`. A correlation up to `least` is 0.

    With the noise :math:`\rho^k` correlated over k frames, second differences at lags of two frames have
    :math:`(1 + \rho)(3 - \rho^2)/(3 - \rho)` times the variance of those at one, and longer lags have no
    less. The mean of three frames or more has over twice the variance at two, and soon no more than
    :math:`3/((1 - \rho)(3 - \rho))` times that at one. Unequal pixels under a comb that vibrates over them
    leave less at some longer lag. Motion that the fitted changes do not describe, as of sheets that ring,
    adds to longer lags: ridges that hardly move between the frames decide, where they are as many. It is not
    clear in films with fewer than `CORRELATED_RIDGES` differences, and where noise is less than
    `WHOLE_LEVELS`, which is rounding.
    """

    def typical(lag: int) -> float:
        """Return the typical variance of ridges at rest, or of all; NaN from too few differences."""
        variance = _noise_variance(profile, x_px, frozen, half_px=half_px, lag=lag)
        if variance.size < CORRELATED_RIDGES:
            return float("nan")
        moved = _own_motion(x_px, frozen, lag)
        resting = moved <= max(AT_REST_PX, float(nan_quantile(moved.ravel(), 0.25)))
        if resting.sum() >= CORRELATED_RIDGES:
            variance = np.where(resting, variance, np.nan)
        return float(nan_median(nan_median(variance, axis=0)))

    one, two = typical(1), typical(2)
    rho = np.linspace(0, 1, 101)
    found = float(np.interp(two / one, (1 + rho) * (3 - rho**2) / (3 - rho), rho)) if one > 0 else 0.0
    if not (one > WHOLE_LEVELS**2 and found > least):
        return 0.0
    three, four, six = typical(3), typical(4), typical(6)
    decays = two <= 2 * one
    if not decays:
        # Noise that lasts for ever would have twice the variance at twice the lag.
        if two > 2.1 * one and six > NO_MORE * four:
            return 0.0
        found = 2 - float(np.sqrt(1 + 3 * one / six))
    lasts = min(four / three, six / four) > NO_LESS and four / two < 1.2 * two / one
    return found if lasts and three > (1.0 if decays else NO_LESS) * two else 0.0


def _own_motion(x_px: Floats, frozen: Bools, lag: int) -> Floats:
    """Return the larger motion of each sheet, against the comb's, from and to the middle one of the groups of
    frames of `_noise_variance`, px, (groups, N)."""
    triples = _triples(x_px, frozen, lag)
    steps = [x_px[frame] - x_px[triples[1]] for frame in triples[[0, 2]]]
    before, after = (np.abs(step - nan_median(step, axis=1)[:, None]) for step in steps)
    return np.asarray(np.fmax(before, after), np.float64)


def _noise_variance(
    profile: NDArray[np.floating], x_px: Floats, frozen: Bools, *, half_px: int, lag: int = 1
) -> Floats:
    """Return the variance of the noise around each sheet in groups of three frames, `lag` frames apart, grey
    levels squared, (groups, N); see `intensity_noise`."""
    half = max(half_px, 5)
    triples = _triples(x_px, frozen, lag)
    offsets = np.arange(-half - 1, half + 2)

    def of_part(some: slice) -> Floats:
        x = x_px[triples[1, some]]
        centre = np.nan_to_num(np.rint(x), nan=-10 * half).astype(np.int64)

        def around(frame: Ints) -> Floats:
            """Return the pixels around the ridges in these frames."""
            common = np.nan_to_num(nan_median(x_px[frame] - x, axis=1))
            column = centre + np.rint(common).astype(np.int64)[:, None]
            row = np.repeat(np.arange(len(frame)), x.shape[1])
            return gather(some_rows(profile, frame), Starts(row, column.ravel()), offsets)

        before, now, after = (around(frame) for frame in triples[:, some])
        variance = _residual_variance(before + after - 2 * now, (before + now + after) / 3)
        return variance.reshape(x.shape) / 6

    parts = in_two_threads(of_part, row_parts(triples.shape[1], TRIPLES_AT_ONCE))
    return np.concatenate([np.zeros((0, x_px.shape[1])), *parts])


def position_noise(x_px: Floats) -> Floats:
    """Return the measured standard deviation of the positions from frame to frame, px.

    Second differences in time exclude steady creep. Subtracting their median over the sheets (with five
    sheets or more) excludes vibration of the camera, and the median absolute value excludes slips.

    Parameters
    ----------
    x_px
        Positions (frame, N), NaN where missing.

    Returns
    -------
    (N,), NaN for sheets seen in fewer than eight groups of three consecutive frames.
    """
    if len(x_px) < 3:
        return np.full(x_px.shape[1], np.nan)
    middle = np.arange(1, len(x_px) - 1)

    def sizes(rows: Ints | slice) -> Floats:
        second = -2.0 * x_px[middle[rows]] + x_px[middle[rows] + 1] + x_px[middle[rows] - 1]
        if x_px.shape[1] >= 5:
            second -= np.nan_to_num(nan_median(second, axis=1))[:, None]
        return np.abs(second, out=second)

    typical, seen = typical_medians(sizes, len(middle)), np.isfinite(x_px)
    known = (seen[1:-1] & seen[2:] & seen[:-2]).sum(axis=0) >= LEAST_TRIPLES
    return np.asarray(np.where(known, typical / NORMAL_MEDIAN / np.sqrt(6), np.nan), np.float64)


def _triples(x_px: Floats, frozen: Bools, lag: int) -> Ints:
    """Return frames that are not repeated, in triples `lag` such frames apart, in which most sheets are seen,
    spread over the recording, (3, triples)."""
    new = np.flatnonzero(~frozen)
    seen = np.isfinite(x_px).mean(axis=1)[new] > 0.5
    first = np.flatnonzero(seen[2 * lag :] & seen[lag:-lag] & seen[: -2 * lag])
    if len(first):
        first = first[spread_indices(len(first), 400)]
    return np.asarray(new[first + lag * np.arange(3)[:, None]], np.int64)


def _residual_variance(change: Floats, mean: Floats) -> Floats:
    """Return the variance of `change` (points, pixels) without the fitted changes of the mean ridge.
    Gram-Schmidt treats all points at once; LAPACK's QR of each small matrix takes several times as long."""
    known = np.isfinite(mean).all(axis=1) & np.isfinite(change).all(axis=1)
    mean = mean[known]
    inner = mean[:, 1:-1]
    fitted = (inner, (mean[:, 2:] - mean[:, :-2]) / 2, mean[:, 2:] - 2 * inner + mean[:, :-2])
    directions: list[Floats] = []
    for values in (*fitted, change[known][:, 1:-1]):
        beside = values - values.mean(axis=1, keepdims=True)
        for direction in directions:
            beside -= np.einsum("ij,ij->i", direction, beside)[:, None] * direction
        squares = np.einsum("ij,ij->i", beside, beside)
        least = 1e-20 * np.einsum("ij,ij->i", values, values)  # less is rounding, magnified
        scale = np.divide(1, np.sqrt(squares), out=np.zeros_like(squares), where=squares > least)
        directions.append(beside * scale[:, None])
    dof = inner.shape[1] - 1 - len(fitted)
    out = np.full(len(change), np.nan)
    # the median of a chi-squared variable with k degrees of freedom is about k (1 − 2/(9k))³
    out[known] = squares / (dof * (1 - 2 / (9 * dof)) ** 3)
    return out
