"""Shifts of positions that are the same in all frames: by neighbours, by light, by the ridge's own shape."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vision.mapped import some_rows
from vision.numeric import FWHM, Floats, Floats32, nan_median, spread_indices
from vision.sheets.distortion import levels_around
from vision.sheets.ridges import FEWEST, RidgeComb
from vision.sheets.subpixel import Starts, sliding_vertex

FRAMES = 200  # spread over the film, whose median profile is fitted
STEPS = 8  # of the fit, which settles after five
# How far places (in ridge widths), widths and exponent (logarithms) lie from those expected, and how well the
# ridges have the shape that is fitted, over their height: it keeps ridges that hide each other in place. With
# 0.05 those that are wider than others are held back: shifts of known films are wrong by 80 mpx, not by 9.
PLACES, WIDTHS, MISFIT = 0.25, 0.5, 0.01
EXPONENTS = np.log([1.5, 8.0])  # from sharp ridges to boxes
# Share of a ridge's height at which its flanks are looked for, and by what the distance of their middle is
# multiplied, since blur moves flanks as well. On 30 films of sheets with a slope and a texture, 64 of 100
# positions lie within one error (52 at half the height); lower flanks and larger factors overstate the error.
FLANK, LOPSIDED = 0.35, 2.0
DARKEST = 0.1  # of a ridge's height: a darker background tells nothing of the light


class ConstantShift(NamedTuple):
    """By how much positions are shifted in all frames, px, (N,); NaN where not known."""

    overlap: Floats
    light: Floats
    shape: Floats

    @property
    def size_px(self) -> Floats:
        """Root of the sum of squares of those that are known, (N,)."""
        return np.asarray(np.sqrt(np.nansum(np.square(self), axis=0)), np.float64)


def constant_shift(profile: Floats32, x_px: Floats, window_px: int, comb: RidgeComb) -> ConstantShift:
    r"""Return by how much positions x_px (frame, N) of the sliding window are shifted in all frames.

    All are NaN for sheets without positions. The shift by light is NaN for fewer than five sheets, which may
    lie on anything.

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
    """
    rest, rows = nan_median(x_px), spread_indices(len(x_px), FRAMES)
    seen = np.isfinite(rest)
    shift = ConstantShift(*np.full((3, len(rest)), np.nan))
    if not seen.any():
        return shift
    half = max(comb.half_px(1.0), round(comb.pitch_px))
    bright = comb.bright(some_rows(profile, rows))
    around = nan_median(levels_around(bright, x_px[np.ix_(rows, seen)], half))
    at = rest[seen] + np.arange(-half, half + 1)[:, None]
    nearest = np.abs(at[..., None] - rest[seen]).argmin(axis=2) == np.arange(at.shape[1])
    known = np.isfinite(around) & nearest  # each pixel once
    place, width, exponent, height, level, slope = _fitted_comb(at[known], around[known], rest[seen], comb)
    away = np.abs(np.arange(profile.shape[1]) - place[:, None]) / width[:, None]
    drawn = height[:, None] * np.exp(-(away**exponent) / 2)
    frame, start = np.arange(len(place)), np.rint(place).astype(np.int64)
    alone = sliding_vertex(drawn, Starts(frame, start), window_px=window_px)
    together = sliding_vertex(drawn.sum(axis=0)[None], Starts(0 * frame, start), window_px=window_px)
    shift.overlap[seen] = together.x_px - alone.x_px
    others = height * np.exp(-((np.abs(at[..., None] - place) / width) ** exponent) / 2)  # (u, sheet, ridge)
    others = others.sum(axis=2) - np.diagonal(others, axis1=1, axis2=2)
    own = (around - others - level - slope * (at - place)) * np.sign(height)
    lopsided = LOPSIDED * (_middle_of_flanks(own) + shift.overlap[seen])
    if len(place) >= FEWEST:
        level = np.copysign(np.fmax(np.abs(level), DARKEST * np.abs(height)), level)
        with np.errstate(divide="ignore", invalid="ignore"):
            by_light = slope / level * (level + height) / height * (width**2 + window_px**2 / 20)
        on_ridge = comb.fwhm_px / 2
        shift.light[seen] = np.clip(by_light, -on_ridge, on_ridge)
    beyond = lopsided**2 - np.nan_to_num(shift.light[seen]) ** 2  # light makes ridges lopsided, too
    shift.shape[seen] = np.sqrt(np.fmax(beyond, 0.0))
    return shift


def _middle_of_flanks(height: Floats) -> Floats:
    """Return the middle between the flanks of ridges (u, N), from the middle row, (N,); NaN where one is not
    seen."""
    half, sheet = len(height) // 2, np.arange(height.shape[1])
    level, middle = FLANK * height[half - 1 : half + 2].max(axis=0), np.zeros(height.shape[1])
    for outwards, side in ((height[half::-1], -1), (height[half:], 1)):
        below = outwards < level
        first = np.maximum(below.argmax(axis=0), 1)
        inner, outer = outwards[first - 1, sheet], outwards[first, sheet]
        flank = first - (level - outer) / (inner - outer)
        middle += np.where(below.any(axis=0) & (inner > outer), side * flank / 2, np.nan)
    return middle


def _fitted_comb(at_px: Floats, grey: Floats, rest_px: Floats, comb: RidgeComb) -> tuple[Floats, ...]:
    r"""Fit ridges :math:`C_n \exp(-|x - x_n|^p / 2\sigma_n^p)` on a background of second degree to grey
    levels (K,) at these columns, by the method of Gauss and Newton.

    Returns :math:`x_n, \sigma_n, p, C_n`, and the background and its slope per px at :math:`x_n`. rest_px:
    measured positions, (N,).
    """
    sheets, middle, half = len(rest_px), (at_px.max() + at_px.min()) / 2, np.ptp(at_px) / 2
    background = np.vander((at_px - middle) / half, 3)
    width = np.full(sheets, np.log(comb.fwhm_px / FWHM))
    spread = np.repeat([PLACES * comb.fwhm_px, WIDTHS, np.inf], [sheets, sheets + 1, sheets + 3])
    weight, parts = (MISFIT * comb.contrast / spread) ** 2, np.cumsum([sheets, sheets, 1, sheets])
    expected = found = np.concatenate([rest_px, width, [np.log(2)], np.zeros(sheets + 3)])
    for _ in range(STEPS):
        place, width, exponent, height, base = np.split(found, parts)
        away = (at_px[:, None] - place) / np.exp(width)
        away[away == 0] = 1e-9  # whose logarithm is finite
        raised = np.abs(away) ** np.exp(exponent) / 2
        ridge = np.exp(-raised)
        rise = ridge * raised * height * np.exp(exponent)
        sharper = -(rise * np.log(np.abs(away))).sum(axis=1, keepdims=True)
        regressors = np.hstack([rise / (away * np.exp(width)), rise, sharper, ridge, background])
        left = grey - ridge @ height - background @ base
        normal = regressors.T @ regressors + np.diag(weight)
        normal += 1e-12 * np.trace(normal) * np.eye(len(normal))  # solvable, whatever is seen
        change = np.linalg.solve(normal, regressors.T @ left + weight * (expected - found))
        change[: parts[2]] = np.clip(change[: parts[2]], -0.3, 0.3)
        found = found + change
        found[parts[1]] = np.clip(found[parts[1]], *EXPONENTS)
    place, width, exponent, height, base = np.split(found, parts)
    there = (place - middle) / half
    background_there = np.polyval(base, there), np.polyval(np.polyder(base), there) / half
    return place, np.exp(width), np.exp(exponent), height, *background_there
