"""Shifts of positions that are the same in all frames: by neighbours, by light, by the ridge's own shape."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vision.memory import some_rows
from vision.numeric import FWHM, Bools, Floats, Floats32, nan_median, sigma_about_zero, spread_indices
from vision.sheets.distortion import levels_around
from vision.sheets.ridges import FEWEST, RidgeComb
from vision.sheets.subpixel import Starts, sliding_vertex

FRAMES = 200  # spread over the film, whose median profile is fitted
STEPS = 8  # of the fit, which settles after five
# Sheets whose pixels are compared with the ridges at once, and how many beside them reach there: further ones
# have less than 1e-9 of their height there, even if they are as wide as the pitch. Larger takes longer.
TOGETHER, BESIDE = 40, 5
# How far places (in ridge widths), widths and exponent (logarithms) lie from those expected, and how well the
# ridges have the shape that is fitted, over their height: it keeps ridges that hide each other in place. With
# 0.05 those that are wider than others are held back: shifts of known films are wrong by 80 mpx, not by 9.
PLACES, WIDTHS, MISFIT = 0.25, 0.5, 0.01
EXPONENTS = np.log([1.5, 8.0])  # from sharp ridges to boxes
# Share of a ridge's height at which its flanks are looked for, and by what the distance of their middle is
# multiplied, since blur moves flanks as well. On 94 films of sheets with a slope and a texture, 66 of 100
# positions lie within one error; lower flanks and larger factors overstate the error.
FLANK, LOPSIDED = 0.35, 2.0
BEYOND = 0.6  # pitches, within which grey levels beside a sheet are its own in a comb with uneven gaps
LOWEST = 0.05  # of the usual height: what is fitted lower, or upside down, is not the ridge that was measured
DARKEST = 0.1  # of a ridge's height: a darker background tells nothing of the light


class ConstantShift(NamedTuple):
    """By how much positions are shifted in all frames, px, (N,); NaN where not known."""

    overlap: Floats
    light: Floats
    shape: Floats

    @property
    def size_px(self) -> Floats:
        """Root of the sum of squares of those that are known, (N,); NaN where none is."""
        size = np.sqrt(np.nansum(np.square(self), axis=0))
        return np.where(np.isnan(self).all(axis=0), np.nan, size)


def constant_shift(profile: Floats32, x_px: Floats, window_px: int, comb: RidgeComb) -> ConstantShift:
    r"""Return by how much positions x_px (frame, N) of the sliding window are shifted in all frames.

    All are NaN for sheets without positions, and for those that do not look like a ridge. The shift by light
    is NaN for fewer than five sheets, which may lie on anything.

    The comb of all ridges on its background is fitted to the median profile around the sheets. The sliding
    window is then applied to the ridges so drawn, together and each alone: the difference is the shift by
    neighbours. A ridge of standard width :math:`\sigma` and height C (negative if dark) on a background V in
    light of intensity L(x), of which V shows the slope, is shifted to first order by

    .. math:: \frac{L'}{L}\, \frac{V + C}{C}\, \left(\sigma^2 + \frac{w^2}{20}\right) ,

    since :math:`w^2/20` is the variance of the parabolic kernel whose convolution with the profile has the
    slope of a parabola over w pixels. The template keeps the mean position of the sliding window, and the
    publication's fit has it in the mean over a pixel, so that these shifts hold for them as well.

    A sheet that is brighter on one side has its maximum on that side, but its flanks where its edges are. The
    error by its shape is twice the distance of the position from the middle between the flanks at a third of
    its height, in the median profile less the background and the other ridges, beyond the shifts by both.
    Its square is averaged with that of the usual one, as texture may shift flanks as far as the maximum.
    """
    shift = ConstantShift(*np.full((3, x_px.shape[1]), np.nan))
    shown = np.flatnonzero(np.isfinite(x_px).any(axis=1))
    if not shown.size:
        return shift
    rows = shown[spread_indices(shown.size, FRAMES)]
    seen = np.flatnonzero(np.isfinite(x_px[rows]).any(axis=0))
    half = max(comb.half_px(1.0), round(comb.pitch_px))
    bright, rest = comb.bright(some_rows(profile, rows)), nan_median(x_px[:, seen])
    around = nan_median(levels_around(bright, x_px[np.ix_(rows, seen)], half))
    at = rest + np.arange(-half, half + 1)[:, None]
    nearest = np.abs(at[..., None] - rest).argmin(axis=2) == np.arange(seen.size)
    known = nearest & _of_sheets(around, BEYOND * comb.pitch_px)
    grey = np.where(known, around, np.nan)  # each pixel once
    place, width, exponent, height, level, slope = _fitted_comb(at, grey, rest, comb)

    def ridges_at(x: Floats) -> Floats:
        """Return each ridge alone at columns x, (…, N)."""
        return np.asarray(height * np.exp(-((np.abs(x - place) / width) ** exponent) / 2), np.float64)

    drawn = ridges_at(np.arange(profile.shape[1], dtype=np.float64)[:, None]).T
    frame, start, comb_drawn = np.arange(seen.size), np.rint(place).astype(np.int64), drawn.sum(axis=0)[None]
    alone = sliding_vertex(drawn, Starts(frame, start), window_px=window_px)
    together = sliding_vertex(comb_drawn, Starts(0 * frame, start), window_px=window_px)
    shift.overlap[seen] = together.x_px - alone.x_px
    others = levels_around(comb_drawn, rest[None], half)[0] - ridges_at(at)
    own = around - others - level - slope * (at - place)
    lopsided = LOPSIDED * (_middle_of_flanks(own) + shift.overlap[seen])
    on_ridge = comb.fwhm_px / 2  # where a maximum lies
    if seen.size >= FEWEST:
        level = np.copysign(np.fmax(np.abs(level), DARKEST * np.abs(height)), level)
        with np.errstate(divide="ignore", invalid="ignore"):
            by_light = slope / level * (level + height) / height * (width**2 + window_px**2 / 20)
        shift.light[seen] = np.clip(by_light, -on_ridge, on_ridge)
    beyond = lopsided**2 - np.nan_to_num(shift.light[seen]) ** 2  # light makes ridges lopsided, too
    shape = np.sqrt(np.clip(beyond, 0.0, on_ridge**2))
    shift.shape[seen] = np.hypot(shape, sigma_about_zero(shape)) / np.sqrt(2)
    for values in shift:
        values[seen[height < LOWEST * comb.contrast]] = np.nan
    return shift


def _of_sheets(around: Floats, least_px: float) -> Bools:
    """Return which grey levels (u, N) lie within this distance of the middle row, or before the darkest.

    Those beyond may be of a ridge that is none of the sheets: one without positions, or beyond the last.
    """
    half = len(around) // 2
    left, right = (np.nan_to_num(one, nan=np.inf).argmin(axis=0) for one in (around[half::-1], around[half:]))
    u = np.arange(-half, half + 1)[:, None]
    return np.asarray((u >= -np.fmax(left, least_px)) & (u <= np.fmax(right, least_px)))


def _middle_of_flanks(height: Floats) -> Floats:
    """Return the middle between the flanks of ridges (u, N), from the middle row, (N,); NaN where one is not
    seen."""
    half, sheet = len(height) // 2, np.arange(height.shape[1])
    level, middle = FLANK * height[half - 1 : half + 2].max(axis=0), np.zeros(height.shape[1])
    for outwards, side in ((height[half::-1], -1), (height[half:], 1)):
        below = outwards < level
        first = np.maximum(below.argmax(axis=0), 1)
        inner, outer = outwards[first - 1, sheet], outwards[first, sheet]
        falls = (inner >= level) & (level > outer)
        flank = first - (level - outer) / np.where(falls, inner - outer, np.nan)
        middle += side * flank / 2
    return middle


def _fitted_comb(at_px: Floats, grey: Floats, rest_px: Floats, comb: RidgeComb) -> tuple[Floats, ...]:
    r"""Fit ridges :math:`C_n \exp(-|x - x_n|^p / 2\sigma_n^p)` on a background of second degree to grey
    levels at these columns, (u, N), NaN where not known, by the method of Gauss and Newton.

    Returns :math:`x_n, \sigma_n, p, C_n`, and the background and its slope per px at :math:`x_n`. rest_px:
    measured positions, (N,).
    """
    known, sheets = np.isfinite(grey), len(rest_px)
    low, high = at_px[known].min(), at_px[known].max()
    middle, half = (low + high) / 2, max((high - low) / 2, 1.0)
    width = np.full(sheets, np.log(comb.fwhm_px / FWHM))
    spread = np.repeat([PLACES * comb.fwhm_px, WIDTHS, np.inf], [sheets, sheets + 1, sheets + 3])
    weight, parts = (MISFIT * comb.contrast / spread) ** 2, np.cumsum([sheets, sheets, 1, sheets])
    expected = found = np.concatenate([rest_px, width, [np.log(2)], np.zeros(sheets + 3)])
    places, widths, exponents, heights, bases = np.split(np.arange(found.size), parts)
    for _ in range(STEPS):
        normal, towards = np.diag(weight), weight * (expected - found)
        for first in range(0, sheets, TOGETHER):
            own = known[:, first : first + TOGETHER]
            at = at_px[:, first : first + TOGETHER][own][:, None]
            near = slice(max(0, first - BESIDE), first + TOGETHER + BESIDE)
            width, exponent = np.exp(found[widths[near]]), np.exp(found[exponents])
            away = (at - found[places[near]]) / width
            away[away == 0] = 1e-9  # whose logarithm is finite
            log_away = np.log(np.abs(away))
            raised = np.exp(exponent * log_away) / 2
            ridge = np.exp(-raised)
            rise = ridge * raised * found[heights[near]] * exponent
            sharper = -(rise * log_away).sum(axis=1, keepdims=True)
            background = np.vander((at[:, 0] - middle) / half, 3)
            regressors = np.hstack([rise / (away * width), rise, sharper, ridge, background])
            left = (
                grey[:, first : first + TOGETHER][own]
                - ridge @ found[heights[near]]
                - background @ found[bases]
            )
            numbers = np.concatenate([places[near], widths[near], exponents, heights[near], bases])
            normal[np.ix_(numbers, numbers)] += regressors.T @ regressors
            towards[numbers] += regressors.T @ left
        normal += 1e-12 * np.trace(normal) * np.eye(len(normal))  # solvable, whatever is seen
        change = np.linalg.solve(normal, towards)
        change[: parts[2]] = np.clip(change[: parts[2]], -0.3, 0.3)
        found = found + change
        found[exponents] = np.clip(found[exponents], *EXPONENTS)
    place, width, exponent, height, base = np.split(found, parts)
    there = (place - middle) / half
    background_there = np.polyval(base, there), np.polyval(np.polyder(base), there) / half
    return place, np.exp(width), np.exp(exponent), height, *background_there
