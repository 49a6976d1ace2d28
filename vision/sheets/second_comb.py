"""A faint second comb over or behind the sheets, such as their reflection in a pane of glass.

Where a ridge of the second comb passes a ridge of the first, it shifts the position by up to a tenth of the
ridge's width and hardly changes the ridge's shape. `second_comb` finds it by the light that it brings: to a
ridge in some frames, to the gap beside it in others.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vision.mapped import some_rows
from vision.numeric import FWHM, Bools, Floats, Floats32, nan_median, spread_indices
from vision.sheets.distortion import levels_around
from vision.sheets.ridges import RidgeComb

LEAST_SHEETS = 5
LEAST_PERIODS = 12  # fewer may agree by chance
MOST_PERIODS = 300  # spread over the film
_FRAMES = 5  # of a period, whose mean has little noise


class SecondComb(NamedTuple):
    """What a second comb does: the light that goes between ridges and gaps, rms, over the ridges' height, and
    the error of all positions by it, px; 0 if there is none."""

    depth: float = 0.0
    error_px: float = 0.0


def second_comb(profile: Floats32, x_px: Floats, blurred: Bools, comb: RidgeComb) -> SecondComb:
    r"""Return how far a second comb shifts the positions x_px (frame, N), NaN where missing.

    Ridges blurred by motion (frame, N), lower and wider for that reason, do not count.

    The levels in the middle of a gap, :math:`g`, and at the tops of the ridges beside it, :math:`t`, both
    over the height of the ridges, are averaged over a few frames. Their changes count without those of all
    sheets together, and without what is in proportion to the width of the gap, as overlapping flanks are. A
    lamp, a shadow or dirt changes both in the same direction, and noise changes each by itself. What has the
    size of a ridge, and which the sheets move against, changes them in opposite directions: if t and g, of
    all gaps together, are correlated by less than -`second_comb_correlation`, the error of all positions is

    .. math:: k\,\sigma_r\,\sqrt{-\langle t\,g\rangle} ,

    where :math:`\sigma_r` is the standard deviation of a ridge and k is `second_comb_shift`. It is the same
    in all frames, since a ridge exactly over another changes the tops most and shifts the position least.
    It must also hold if the weight of each gap is limited to the upper quartile of all weights, as scratches
    change few gaps.

    Sheets that lean by different amounts show the same: their ridges become lower and wider.

    Nothing is found for fewer than five sheets, films of fewer than 60 frames, and narrow ridges, whose tops
    change with their place among the pixels (`second_comb_least_px`).
    """
    settings, periods = comb.settings, len(profile) // _FRAMES
    if (
        x_px.shape[1] < LEAST_SHEETS
        or periods < LEAST_PERIODS
        or comb.fwhm_px < settings.second_comb_least_px
    ):
        return SecondComb()
    rows = (_FRAMES * spread_indices(periods, MOST_PERIODS)[:, None] + np.arange(_FRAMES)).ravel()
    bright, x = comb.bright(some_rows(profile, rows)), np.where(blurred[rows], np.nan, x_px[rows])
    apart = np.diff(x, axis=1)
    tops, gaps = levels_at(bright, x), levels_at(bright, x[:, :-1] + 0.5 * apart)
    tops, gaps, apart = (_of_periods(values) for values in ((tops[:, 1:] + tops[:, :-1]) / 2, gaps, apart))
    height = nan_median(tops - gaps)
    height[~(height > 0)] = np.nan
    tops, gaps = (_changes(values / height, apart, settings.second_comb_most) for values in (tops, gaps))
    known = np.isfinite(tops) & np.isfinite(gaps)
    count = np.maximum(known.sum(axis=0), 1)
    tops, gaps = np.where(known, tops, 0.0), np.where(known, gaps, 0.0)
    shared = (tops * gaps).sum(axis=0) / count
    size = np.sqrt((tops**2).sum(axis=0) * (gaps**2).sum(axis=0)) / count
    capped = np.fmin(1.0, np.quantile(size, 0.75) / np.fmax(size, 1e-12))
    least = -settings.second_comb_correlation
    if any(np.sum(each * shared) >= least * np.sum(each * size) for each in (count, count * capped)):
        return SecondComb()
    depth = float(np.sqrt(-np.average(shared, weights=count)))
    return SecondComb(depth, settings.second_comb_shift * comb.fwhm_px / FWHM * depth)


def levels_at(bright: Floats32, x_px: Floats) -> Floats:
    """Return the mean of three pixels around each place x_px (frame, K); NaN at NaN and at the edge.

    A line between pixels would lower tops and raise gaps that lie there, by 1 % of a ridge of 6 px, as a
    second comb does.
    """
    return np.asarray(levels_around(bright, x_px, 1).mean(axis=1), np.float64)


def _of_periods(values: Floats) -> Floats:
    """Return means over successive frames, (period, K), NaN where fewer than half of them are known."""
    values = values.reshape(-1, _FRAMES, values.shape[1])
    known = np.isfinite(values)
    count = known.sum(axis=1)
    total = np.where(known, values, 0.0).sum(axis=1)
    return np.where(count > _FRAMES / 2, total / np.maximum(count, 1), np.nan)


def _changes(level: Floats, apart_px: Floats, most: float) -> Floats:
    """Return the changes of levels (period, K) in time, against those of all sheets, and without what is in
    proportion to the distance of the two sheets; at most `most`."""
    level = level - nan_median(level)
    level -= nan_median(level, axis=1)[:, None]
    known = np.isfinite(level) & np.isfinite(apart_px)
    count = np.maximum(known.sum(axis=0), 1)
    centred = [
        np.where(known, values - np.where(known, values, 0.0).sum(axis=0) / count, 0.0)
        for values in (level, apart_px)
    ]
    change, apart = centred
    slope = (change * apart).sum(axis=0) / np.maximum((apart**2).sum(axis=0), 1e-12)
    return np.where(known, np.clip(change - slope * apart, -most, most), np.nan)
