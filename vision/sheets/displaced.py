"""Sheets that are numbered one too high or too low between a missing sheet and a ridge too many.

Where sheets meet in one ridge, or one slips between two others, all ridges can be paired with the sheets in
two ways: the sheets up to the one that seems to be missing stay, or all of them moved by one.
"""

from __future__ import annotations

import numpy as np

from vision.numeric import NORMAL_MEDIAN, Bools, Floats, Floats32, Ints, nan_median, shifted
from vision.sheets.settings import TrackingSettings

TERM_LIMIT = 4.0  # nats: no single brightness or width decides
LIKE_A_SHEET = 0.7  # change of log contrast up to which a ridge may be a sheet: a factor of two
LEAST_SCATTER = np.array([0.02, 0.03])  # of log contrast and log width: frames differ by more than noise


def numbered_by_a_neighbour(
    candidates: Floats32, match: Ints, paired: Floats, usual: Floats, settings: TrackingSettings
) -> Bools:
    found = np.isfinite(paired[0])
    rows = np.flatnonzero(~found.all(axis=1) & (found.mean(axis=1) >= 0.5))
    doubtful = np.zeros(found.shape, bool)
    if not len(rows):
        return doubtful
    looks = np.log(paired[1:])
    looks -= _common(looks - nan_median(np.log(usual), axis=1)[:, None])
    known = np.log(usual)
    known -= _common(known - nan_median(known, axis=1)[:, None])
    middle = nan_median(known, axis=1)[:, None]
    scatter = nan_median(np.abs(known - middle), axis=1)[:, None] / NORMAL_MEDIAN
    scatter = np.fmax(scatter, LEAST_SCATTER[:, None, None])
    looks = looks[:, rows]
    extra = _unpaired_between(candidates[:, rows], match[rows], paired[0, rows], usual)
    for way in (1, -1):
        turn = slice(None, None, way)
        off = _doubtful(
            looks[..., turn], middle[..., turn], scatter[..., turn], np.pad(extra[:, turn], ((0, 0), (1, 0))), settings
        )
        doubtful[rows] |= off[:, turn]
    return doubtful


def _common(off: Floats) -> Floats:
    return nan_median(off, axis=2)[..., None]


def _doubtful(looks: Floats, middle: Floats, scatter: Floats, extra: Floats, settings: TrackingSettings) -> Bools:
    """For sheets below a missing one."""
    off = (looks - middle) / scatter
    worse = np.fmax(nan_median(np.abs(off), axis=2)[..., None] / NORMAL_MEDIAN, 1.0)
    next_middle, next_scatter = (shifted(part[:, 0], 1)[:, None] for part in (middle, scatter))
    other = (looks - next_middle) / np.fmax(scatter, next_scatter)
    own_cost, other_cost = (np.fmin((z / worse) ** 2 / 2, TERM_LIMIT) for z in (off, other))
    found = np.isfinite(looks[0])
    gain = np.where(found, np.nan_to_num(own_cost - other_cost), 0.0).sum(axis=0)
    larger = looks - middle > np.log([settings.merged_height, settings.merged_width])[:, None, None]
    merged = np.where(larger.any(axis=0) & found, np.where(off > 0, np.nan_to_num(own_cost), 0.0).sum(axis=0), 0.0)
    total = np.cumsum(gain, axis=1)
    group = np.cumsum(~found, axis=1)
    apart = 10.0 * (TERM_LIMIT * 4 * found.shape[1])
    below = np.pad(merged, ((0, 0), (1, 0)))[:, :-1]  # beside the missing sheet, the merged ridge is both
    begin = np.maximum(below, extra) + gain - total
    begin = np.maximum.accumulate(np.where(found, begin, -apart) + apart * group, axis=1) - apart * group
    # total at the last sheet before the next missing one
    nextmiss = np.where(~found, np.arange(found.shape[1]), found.shape[1])
    nextmiss = np.minimum.accumulate(nextmiss[:, ::-1], axis=1)[:, ::-1]
    last = np.take_along_axis(np.pad(total, ((0, 0), (1, 1))), np.minimum(nextmiss, found.shape[1]), axis=1)
    rival = np.pad(merged, ((0, 0), (1, 2)))  # the missing sheet may as well be in the ridge beside it
    rival = np.maximum(rival[:, :-2], rival[:, 2:])
    last = last - np.take_along_axis(rival, nextmiss, axis=1)
    closed = nextmiss < found.shape[1]
    off = found & closed & (begin + last > settings.doubt)
    off[:, :-1] |= off[:, 1:] & (merged > 0)[:, :-1]
    return np.asarray(off, bool)


def _unpaired_between(candidates: Floats32, match: Ints, x_px: Floats, usual: Floats) -> Floats:
    """Return `TERM_LIMIT` where an unpaired ridge like a sheet lies between two adjacent sheets that are
    found, else 0, (frame, N − 1)."""
    rows, sheets = x_px.shape
    unpaired = np.pad(np.isfinite(candidates[0]), ((0, 0), (0, 1)))
    np.put_along_axis(unpaired, match, values=False, axis=1)  # -1, where missing, is the padding
    unpaired = unpaired[:, :-1]
    level = np.log(candidates[1]) - nan_median(np.log(candidates[1]), axis=1)[:, None]
    unpaired &= level > -LIKE_A_SHEET
    frame, k = np.nonzero(unpaired)
    below = x_px[frame] < candidates[0, frame, k][:, None]
    left = np.where(below, np.arange(sheets), -1).max(axis=1, initial=-1)
    between = np.zeros((rows, sheets + 1))
    between[frame, left + 1] = TERM_LIMIT
    found = np.isfinite(x_px)
    return np.where(found[:, 1:] & found[:, :-1], between[:, 1:-1], 0.0)
