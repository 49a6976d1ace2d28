"""Numberings that looks contradict: brightnesses and widths of ridges that are those of other sheets.

Where sheets meet in one ridge, or part, all sheets on one side of it may be numbered by a neighbour.
`numbered_by_a_neighbour` looks for the ridge that is one too many where a sheet is missing,
`numbered_in_part` for parts of the comb that look like those beside, whether or not a sheet is missing.
"""

from __future__ import annotations

import numpy as np

from vision.numeric import (
    Bools,
    Floats,
    Floats32,
    Ints,
    Ints32,
    beside,
    in_two_threads,
    nan_median,
    nan_quantile,
    row_parts,
    shifted,
    sigma_about_zero,
)
from vision.sheets.ridges import FRAMES_PER_BLOCK, RidgeComb, Ridges
from vision.sheets.settings import TrackingSettings

TERM_LIMIT = 4.0  # nats: no single brightness or width decides a numbering
LIKE_A_SHEET = 1.1
"""Log contrast below the median down to which a ridge may be a sheet that touches another: a third of it."""
LEAST_SCATTER = np.array([0.02, 0.03])[:, None, None]  # of log contrast and log width: specks, pixels
BESIDE = 4  # sheets on each side whose common change of brightness or width is one of light or focus
AROUND = 2  # frames before or after a frame whose looks are judged together
QUIET_SHARE = 0.25  # of the sheets, which tells how much looks deviate where most sheets may be wrong
QUIET_SIGMAS = 0.3186  # quantile of this share of the absolute value of a normal variable
PART_SHIFTS = (-3, -2, -1, 1, 2, 3)  # sheets by which a part of the comb may be numbered otherwise


def numbered_by_a_neighbour(
    ridges: Ridges,
    match: Ints32,
    paired: Floats32,
    certain: Floats32,
    expected_px: Floats,
    comb: RidgeComb,
) -> Bools:
    r"""Return which sheets may be on the ridge of the next sheet, as are all up to a missing one, (frame, N).

    Where sheets meet in one ridge or one slips between two others, the alignment may miss another sheet
    further on, and give each sheet between them the ridge of the next. Let z be the deviations of the log
    contrast and log width of a ridge from what is usual for a sheet, over their scatter. The two readings
    then differ by

    .. math:: e + \sum_n \Big[\min\Big(\frac{z_n^2}{2}, t\Big) - \min\Big(\frac{z_{n,n+1}^2}{2},
              t\Big) - s\Big] \text{ nats}

    over the sheets n between them, with :math:`z_{n,n+1}` that from the next sheet, t `TERM_LIMIT` and s
    `sheet_nats`. The evidence e of the ridge too many is the cost of a false detection where an unpaired
    ridge lies between two sheets. It is :math:`\sum \min(z^2/2, t)` of a ridge that is higher or wider than
    one sheet, less the same for the ridges beside the missing sheet, which may be in one of them. It is
    -`anchor_nats`/2 where nothing shows a ridge too many. The identities are doubtful if the sum exceeds
    `doubt`. Where most sheets of a frame deviate, z² and t are divided by how much more than usual they do.

    Parameters
    ----------
    ridges, paired
        All ridges, and positions, contrasts and widths of those of the sheets (3, frame, N).
    match
        Candidate of each sheet, -1 where missing, (frame, N).
    certain
        Contrasts and widths in some frames of the film, without those that are doubtful, (2, frame, N).
    expected_px
        Where missing sheets are expected, (frame, N). Near an edge of the picture they may be out of view.
    comb
        The ridges' appearance.
    """
    found = np.isfinite(paired[0])
    reach = comb.settings.edge_pitches * comb.pitch_px
    lost = ~found & (expected_px > reach) & (expected_px < comb.width_px - 1 - reach)
    rows = np.flatnonzero(lost.any(axis=1) & (found.mean(axis=1) >= 0.5))
    doubtful = np.zeros(found.shape, bool)
    if not len(rows):
        return doubtful
    middle, scatter = _usual_looks(certain)
    for part in row_parts(len(rows)):
        some = rows[part]
        looks = _without_light(np.log(paired[1:, some].astype(np.float64)), middle)
        extra = comb.settings.false_detection_cost * _unpaired(ridges, some, match[some], found[some])
        for turn in (slice(None), slice(None, None, -1)):
            usual = middle[..., turn], scatter[..., turn]
            off = _shifted_below(looks[..., turn], *usual, extra[:, turn], lost[some, turn], comb.settings)
            doubtful[some] |= off[:, turn]
    return doubtful


def _shifted_below(
    looks: Floats, middle: Floats, scatter: Floats, extra: Floats, lost: Bools, settings: TrackingSettings
) -> Bools:
    """Return which sheets may be on the ridge of the sheet above, up to a sheet that is `lost`, (frame, N).

    looks: log contrasts and log widths, (2, frame, N), with the usual ones and their scatter. extra: evidence
    of an unpaired ridge between a sheet and the next, (frame, N - 1).
    """
    found = np.isfinite(looks[0])
    off = (looks - middle) / scatter
    worse = np.fmax(sigma_about_zero(off, axis=2)[..., None], 1.0)
    above, its_scatter = (shifted(part[:, 0], 1)[:, None] for part in (middle, scatter))
    other = (looks - above) / np.fmax(scatter, its_scatter)
    own_cost, other_cost = (np.fmin(z**2 / (2 * worse), TERM_LIMIT) / worse for z in (off, other))
    gain = np.where(found, (own_cost - other_cost).sum(axis=0) - settings.sheet_nats, 0.0)
    larger = looks - middle > np.log([settings.merged_height, settings.merged_width])[:, None, None]
    merged = np.where(larger.any(axis=0), np.where(off > 0, own_cost, 0.0).sum(axis=0), 0.0)

    # A block that begins at sheet i and ends before the lost sheet k gains too_many[i] + gain[i] + … +
    # gain[k − 1] less what the ridges beside k may hold. For each sheet: the best beginning at or before it,
    # in its run of sheets that are found, and the end of that run.
    total, run = np.cumsum(gain, axis=1), np.cumsum(~found, axis=1)
    too_many = np.pad(np.maximum(merged[:, :-1], extra), ((0, 0), (1, 0)))
    too_many[too_many == 0] = -settings.anchor_nats / 2
    apart = 100.0 * TERM_LIMIT * found.shape[1]  # more than any sum: keeps the runs apart
    first = np.where(found, too_many + gain - total, -apart) + apart * run
    first = np.maximum.accumulate(first, axis=1) - apart * run
    beside = np.pad(merged, ((0, 0), (1, 1)))
    last = np.pad(total, ((0, 0), (1, 0)))[:, :-1] - np.maximum(beside[:, :-2], beside[:, 2:])
    last = np.where(lost, last, -apart)
    number = np.arange(found.shape[1])
    end = np.minimum.accumulate(np.where(found, len(number), number)[:, ::-1], axis=1)[:, ::-1]
    last = np.take_along_axis(np.pad(last, ((0, 0), (0, 1)), constant_values=-apart), end, axis=1)
    doubtful = found & (first + last > settings.doubt)
    doubtful[:, :-1] |= doubtful[:, 1:] & (merged > 0)[:, :-1]  # the ridge that may hold two sheets
    return np.asarray(doubtful, bool)


def _unpaired(ridges: Ridges, rows: Ints, match: Ints32, found: Bools) -> Floats:
    """Return 1 where an unpaired ridge like a sheet lies between two sheets that are found, else 0, in some
    rows, (rows, N - 1)."""
    x_px, contrast = (values[rows].astype(np.float64) for values in (ridges.x_px, ridges.contrast))
    unpaired = np.pad(np.isfinite(x_px), ((0, 0), (0, 1)))
    np.put_along_axis(unpaired, match, values=False, axis=1)  # -1, where missing, is the column added
    level = np.log(contrast)
    unpaired = unpaired[:, :-1] & (level - nan_median(level, axis=1)[:, None] > -LIKE_A_SHEET)
    frame, k = np.nonzero(unpaired)
    left = np.where((match[frame] >= 0) & (match[frame] < k[:, None]), np.arange(match.shape[1]), -1)
    between = np.zeros((len(match), match.shape[1] + 1))
    between[frame, 1 + left.max(axis=1, initial=-1)] = 1.0
    return np.where(found[:, 1:] & found[:, :-1], between[:, 1:-1], 0.0)


def _without_light(looks: Floats, usual: Floats) -> Floats:
    """Return looks (kinds, frame, N) without the change that sheets side by side share."""

    common = np.empty_like(looks)
    for rows in row_parts(looks.shape[1], FRAMES_PER_BLOCK):
        off = np.pad(looks[:, rows] - usual, ((0, 0), (0, 0), (BESIDE, BESIDE)), constant_values=np.nan)
        beside = np.lib.stride_tricks.sliding_window_view(off, 2 * BESIDE + 1, axis=2)
        common[:, rows] = nan_median(beside, axis=-1)
    return np.asarray(looks - common, np.float64)


def numbered_in_part(looks: Floats32, certain: Floats32, settings: TrackingSettings) -> Bools:
    r"""Return which sheets are in a part of the comb that looks like the sheets beside, (frame, N).

    Sheets that were one ridge in many frames leave the numbering of one side open even if every sheet has a
    ridge. Let z be the deviations of a ridge's log contrast and log width from what is usual for sheet n, and
    :math:`z_{n,n+k}` those from sheet n + k, over their scatter. A part of the comb is doubtful if

    .. math:: \sum_n \Big[\min\Big(t, \sum_z \min\Big(\frac{z_n^2}{2}, t\Big) -
              \min\Big(\frac{z_{n,n+k}^2}{2}, t\Big)\Big) - s\Big] \text{ nats}

    over its sheets, as a mean of the frame with `AROUND` frames before or after it, exceeds `part_nats` for a
    shift k of up to three sheets. t is `TERM_LIMIT` and s `sheet_nats`: four sheets have to agree. If even
    the quarter of the sheets that deviates least does so more than usual, z² and t are divided by how much
    more. The sheets beside such a part are doubtful, too. False for fewer than `pattern_sheets` sheets.

    Parameters
    ----------
    looks
        Contrasts and widths of the ridges of the sheets, (2, frame, N), NaN where missing or doubtful.
    certain
        The same in some frames of the film, without those that are doubtful.
    settings
        Thresholds.
    """
    doubtful = np.zeros(looks.shape[1:], bool)
    if looks.shape[2] < settings.pattern_sheets:
        return doubtful
    middle, scatter = _usual_looks(certain)

    def judge(rows: slice) -> None:
        near = np.log(looks[:, max(0, rows.start - AROUND) : rows.stop + AROUND].astype(np.float64))
        at = np.arange(min(rows.start, AROUND), len(near[0]))[: rows.stop - rows.start]
        off = (_without_light(near, middle) - middle) / scatter
        unusual = np.minimum((off**2 / 2).sum(axis=0), TERM_LIMIT) - 1.5
        odd = np.zeros(len(unusual), bool)  # few frames: the others are not compared
        odd[at] = _largest_in_mean(unusual, at).max(axis=1) > settings.anchor_nats / 2
        odd = np.flatnonzero(np.convolve(odd, np.ones(2 * AROUND + 1), "same") > 0.5)
        if not len(odd):
            return
        near, off, gain = near[:, odd], off[:, odd], np.zeros_like(unusual)
        quiet = nan_quantile(np.abs(off), QUIET_SHARE, axis=2)[..., None] / QUIET_SIGMAS
        worse = np.fmax(quiet, 1.0)
        own_cost = np.fmin(off**2 / (2 * worse), TERM_LIMIT) / worse
        for by in PART_SHIFTS:
            usual, its_scatter = (shifted(part[:, 0], by)[:, None] for part in (middle, scatter))
            other = (_without_light(near, usual) - usual) / np.fmax(scatter, its_scatter)
            other_cost = np.fmin(other**2 / (2 * worse), TERM_LIMIT) / worse
            gain[odd] = np.fmin((own_cost - other_cost).sum(axis=0), TERM_LIMIT) - settings.sheet_nats
            part = _largest_in_mean(gain, at) > settings.part_nats
            doubtful[rows] |= part | beside(part)  # at its end may be a ridge of two sheets

    in_two_threads(judge, row_parts(len(doubtful)))
    return np.asarray(doubtful & np.isfinite(looks[0]), bool)


def _largest_in_mean(gain: Floats, at: Ints) -> Floats:
    """Return the larger one of the sums of `_largest_sum` in the mean of each of some frames `at` and of
    those before, and in the mean of it and of those after, (len(at), N). gain: (frame, N), NaN as 0."""
    total = np.pad(np.cumsum(np.nan_to_num(gain), axis=0), ((1, 0), (0, 0)))
    spans = (np.maximum(at - AROUND, 0), at + 1), (at, np.minimum(at + AROUND + 1, len(gain)))
    before, after = (
        _largest_sum((total[end] - total[begin]) / (end - begin)[:, None]) for begin, end in spans
    )
    return np.maximum(before, after)


def _largest_sum(gain: Floats) -> Floats:
    """Return the largest sum over adjacent entries of a row among which each entry is, (frame, N)."""
    total = np.pad(np.cumsum(gain, axis=1), ((0, 0), (1, 0)))
    before = np.minimum.accumulate(total[:, :-1], axis=1)
    after = np.maximum.accumulate(total[:, :0:-1], axis=1)[:, ::-1]
    return np.asarray(after - before, np.float64)


def _usual_looks(certain: Floats32) -> tuple[Floats, Floats]:
    """Return the median and the scatter of each sheet's log contrast and log width, (2, 1, N), without the
    light that sheets side by side share. certain: contrasts and widths in some frames, (2, frame, N)."""
    known = np.log(certain.astype(np.float64))
    known = _without_light(known, nan_median(known, axis=1)[:, None])
    middle = nan_median(known, axis=1)[:, None]
    return middle, np.fmax(sigma_about_zero(known - middle, axis=1)[:, None], LEAST_SCATTER)
