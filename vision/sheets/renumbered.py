"""Frames in which another numbering pairs the ridges with the sheets as well.

A missing sheet and a ridge too many elsewhere can be read in two ways: both are as they seem, or each sheet
between them is on the ridge of the next one.
"""

from __future__ import annotations

import numpy as np

from vision.numeric import (
    Bools,
    Floats,
    Floats32,
    Ints,
    Ints32,
    common_change,
    nan_median,
    row_parts,
    shifted,
    sigma_about_zero,
)
from vision.sheets.reference import rest_positions
from vision.sheets.ridges import RidgeComb, Ridges, in_blocks
from vision.sheets.settings import TrackingSettings

TERM_LIMIT = 4.0  # nats: no single spacing, brightness or width decides a numbering
LIKE_ITSELF = 0.7
"""Change of log contrast up to which a ridge may be the sheet that is expected there: a factor of two."""
LIKE_A_SHEET = 1.1  # the same for a ridge that touches another and so stands out less: a factor of three
LEAST_SCATTER = np.array([0.02, 0.03])[:, None, None]  # of log contrast and log width: specks, pixels
BESIDE = 4  # sheets on each side whose common change of brightness or width is one of light or focus
USUAL_FRAMES = 2000  # of the film, from which the usual brightnesses and widths are taken


def numbered_off_the_end(ridges: Ridges, paired: Floats32, comb: RidgeComb) -> Bools:
    """Return where a displaced comb leaves out a ridge at one end while its other end is missing, (frame, N).

    If the ridge beyond the end is like the sheets, the frame has as many ridges as the comb has sheets, and
    another numbering pairs all of them. In a comb that is displaced by less than half of `jump_fraction`, a
    sheet from beyond the end has come into view. paired: positions and contrasts of the ridges of the sheets,
    (2, frame, N).
    """
    x, contrast = paired
    moved = common_change(x, rest_positions(x))
    displaced = np.flatnonzero(np.abs(moved) > 0.5 * comb.settings.jump_fraction * comb.pitch_px)
    off = np.zeros(len(x), bool)
    for part in row_parts(len(displaced)):
        rows = displaced[part]
        ridge, height = (values[rows].astype(np.float64) for values in (ridges.x_px, ridges.contrast))
        alike = np.abs(np.log(height / nan_median(contrast[rows], axis=1)[:, None])) < LIKE_ITSELF
        for way in (1, -1):  # a ridge beyond the last sheet, then one before the first
            place = way * x[rows, ::way]
            beyond = (way * ridge - np.fmax.reduce(place, axis=1)[:, None]) / comb.pitch_px
            off[rows] |= np.isnan(place[:, 0]) & (alike & (beyond > 0.5) & (beyond < 1.5)).any(axis=1)
    return np.asarray(off[:, None] & np.isfinite(x), bool)


def usual_frames(frames: int) -> slice:
    """Return the frames from which the usual brightnesses and widths are taken, at most `USUAL_FRAMES`."""
    return slice(None, None, 1 + frames // USUAL_FRAMES)


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
        Contrasts and widths in `usual_frames`, without those that are doubtful, (2, frame, N).
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
    known = np.log(certain.astype(np.float64))
    middle = nan_median(known, axis=1)[:, None]
    known = _without_light(known, middle)
    middle = nan_median(known, axis=1)[:, None]
    scatter = sigma_about_zero(known - middle, axis=1)[:, None]
    scatter = np.fmax(scatter, LEAST_SCATTER)
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

    def common(rows: slice) -> Floats:
        off = np.pad(looks[:, rows] - usual, ((0, 0), (0, 0), (BESIDE, BESIDE)), constant_values=np.nan)
        return nan_median(np.lib.stride_tricks.sliding_window_view(off, 2 * BESIDE + 1, axis=2), axis=-1)

    return np.asarray(looks - np.concatenate(in_blocks(common, looks.shape[1]), axis=1), np.float64)
