"""Doubtful identities: what the alignment did not use says that a sheet may be another one.

That is the jumps of the whole comb, the positions that neighbouring sheets predict, and the looks of the
ridges. Where sheets meet in one ridge, or part, all sheets on one side of it may be numbered by a neighbour:
`numbered_by_a_neighbour` looks for the ridge that is one too many where a sheet is missing,
`numbered_in_part` for parts of the comb that look like those beside, whether or not a sheet is missing.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from vision.memory import in_two_threads, row_parts, table_beside
from vision.numeric import (
    NORMAL_MEDIAN,
    Bools,
    Codes,
    Floats,
    Floats32,
    Ints,
    Ints32,
    beside,
    common_change,
    median_step,
    nan_median,
    nan_quantile,
    shifted,
    sigma_about_zero,
    typical_medians,
    typical_rows,
    typical_size,
    without_common_change,
)
from vision.sheets.identities import SHIFTS, Doubt, Identities, last_seen
from vision.sheets.reference import rest_positions
from vision.sheets.ridges import FEWEST, FRAMES_PER_BLOCK, RidgeComb, Ridges
from vision.sheets.settings import TrackingSettings

FRAMES_AT_ONCE = 512  # whose positions are predicted: NumPy's calls for fewer take longer than their work
PAIRS = 3  # neighbours on each side that predict a sheet's position
LINES = ((1, 2), (1, 3), (2, 3), (2, 4), (3, 4))  # distances of two neighbours on one side that a line joins
LIKE_ITSELF = 0.7
"""Change of log contrast up to which a ridge may be the sheet that is expected there: a factor of two."""


def doubts_of(x: Floats32, contrast: Floats32, identities: Identities, comb: RidgeComb) -> Codes:
    """Return which identities of paired ridges are doubtful by margin or jump, (frame, N).

    A margin that is too small is no doubt where the ridges do not move from the last certain frame to the
    next. x, contrast: of the paired ridges, (frame, N).
    """
    why = np.full(x.shape, Doubt.NONE, np.uint8, order="F")
    why[~(identities.margin >= comb.settings.doubt)] = Doubt.MARGIN
    moved = common_change(x, rest_positions(x))
    why[_unproved_jumps(x, moved, contrast, identities, comb)] = Doubt.JUMP
    why[np.isnan(x)] = Doubt.NONE
    unsettled = why == Doubt.MARGIN
    if unsettled.any():
        why[unsettled & unmoved(x, why == Doubt.NONE, unsettled, comb)] = Doubt.NONE
    return why


def _unproved_jumps(
    x: Floats32, moved: Floats, contrast: Floats32, identities: Identities, comb: RidgeComb
) -> Bools:
    """Return where the comb is displaced by a jump that could be one of whole pitches, (frame, N).

    Jumps divide the film into runs of frames. Where the comb is not at its usual place, the margin must
    exceed the cost of staying there; with neither end in view, where only brightness shows a jump, it must
    also exceed the costs of sheets that cross the edges. After a real jump every sheet keeps its brightness.
    Where those of most sheets changed by more than `least_misfit`, the costs mistake changed sheets for
    exchanged ones, and the margin required grows by the ratio of the squares: the overdispersion of a
    quasi-likelihood (McCullagh & Nelder 1989, chapter 9).
    moved: median of x less the rest positions, (frame,).
    """
    settings, none = comb.settings, np.zeros(x.shape, bool)
    seen = np.flatnonzero(np.isfinite(x).any(axis=1))
    step = np.zeros(len(x))
    step[seen[1:]] = np.nan_to_num(median_step(x[seen]))
    reach = settings.edge_pitches * comb.pitch_px
    rest = identities.rest_px
    no_end_in_view = (rest[:, 0] < reach) & (rest[:, -1] > comb.width_px - 1 - reach)
    run = np.cumsum(np.abs(step) > settings.jump_fraction * comb.pitch_px)
    runs = [run == one for one in range(run[-1] + 1)]
    place = np.array([nan_median(moved[one]) for one in runs])
    apart = np.abs(place - place[:, None]) / (settings.step_fraction * comb.pitch_px)
    away = apart[np.argmax((apart < 0.5) @ np.bincount(run))][run] > 1
    if not away.any():
        return none
    least = settings.stay_cost + 1.0 + np.where(no_end_in_view, 2 * settings.crossing_cost, 0.0)
    off = np.log(contrast.astype(np.float64))
    off -= identities.reference.log_contrast
    off -= nan_median(off, axis=1)[:, None]  # flicker
    misfit = np.nan_to_num(sigma_about_zero(off, axis=1)) ** 2  # of most: some are dimmed, or cut off
    worse = np.maximum(misfit / settings.least_misfit**2, 1.0)
    margin = nan_median(identities.margin, axis=1)  # of the whole comb; single sheets may be less certain
    # medians: a slip within the exposure of one frame changes brightnesses there alone
    given, wanted = (np.array([nan_median(part[one]) for one in runs]) for part in (margin, least * worse))
    unproved = away & (given < wanted)[run]
    return np.asarray(unproved[:, None] & np.isfinite(x), bool)


def unmoved(x: NDArray[np.floating], certain: Bools, unsettled: Bools, comb: RidgeComb) -> Bools:
    """Return which ridges lie where their sheet was and will be, (frame, N).

    They are judged in short stretches in which the numbering of most sheets is unsettled. Another numbering
    would mean that the comb jumped by whole pitches and, a few frames later, exactly back. This is excluded
    in a film in which the comb never jumps. x: positions of the paired ridges, px. certain, unsettled: whose
    identity is certain, or is to be settled.
    """
    settings = comb.settings
    if (np.abs(median_step(np.where(certain, x, np.nan))) > settings.jump_fraction * comb.pitch_px).any():
        return np.zeros(x.shape, bool)
    near, least = np.empty(x.shape, bool), settings.step_fraction * comb.pitch_px / 2
    number = np.arange(len(x), dtype=np.float64)
    for n, use in enumerate(certain.T):
        here = x[:, n].astype(np.float64)
        both = np.stack([np.where(use, here, np.nan), np.where(use, number, np.nan)])
        before, since = last_seen(both)
        after, until = last_seen(both[:, ::-1])[:, ::-1]
        near[:, n] = (until - since <= settings.unmoved_frames) & (np.abs(here - before) < least)
        near[:, n] &= np.abs(here - after) < least
    most = 2 * (near & unsettled).sum(axis=1, keepdims=True) > np.isfinite(x).sum(axis=1, keepdims=True)
    return np.asarray(near & most, bool)


# --- predictions by neighbouring sheets ---------------------------------------------------------------------


def predicted_by_neighbours(x_px: NDArray[np.floating]) -> Floats:
    r"""Return the position of each sheet predicted by its neighbours, px, (frame, N).

    x_px: positions (frame, N), NaN where missing. Missing sheets have a prediction, too. The median
    difference of each sheet is added. NaN where all neighbours are missing, and for fewer than three sheets.

    With the displacement :math:`u_n` from the rest position, the neighbours predict

    .. math:: \hat u_n = \operatorname{median}_{k \le 3}
              \frac{u_{n-k}\,d_{n+k} + u_{n+k}\,d_{n-k}}{d_{n-k} + d_{n+k}},

    where d are distances at rest: displacements are linear between the sheets of each pair, whatever the
    mechanics. Near the ends of the comb pairs are lacking; there, lines through two sheets on one side are
    used as well. The median over the pairs tolerates one wrong neighbour.
    """
    sheets = x_px.shape[1]
    if sheets < 3:
        return np.full(x_px.shape, np.nan)
    rest = rest_positions(x_px)
    predicted = table_beside(x_px, x_px.shape, order="F")

    def predict(rows: slice) -> None:
        predicted[rows] = _displacements(x_px[rows] - rest, rest)

    in_two_threads(predict, row_parts(len(x_px), FRAMES_AT_ONCE))
    predicted += rest + typical_medians(lambda rows: x_px[rows] - rest - predicted[rows], len(x_px))
    return predicted


def unlike_neighbours(x_px: NDArray[np.floating]) -> Floats:
    """Return positions (frame, N) less those that their neighbours predict."""
    predicted = predicted_by_neighbours(x_px)
    np.subtract(x_px, predicted, out=predicted)
    return predicted


def _displacements(moved: Floats, rest: Floats) -> Floats:
    """Return the displacements that neighbours predict from the displacements `moved`, both (frame, N)."""
    first, second, third = pairs = [_between(moved, rest, k) for k in range(1, PAIRS + 1)]
    low, high = np.minimum(first, second), np.maximum(first, second)
    predicted = np.maximum(low, np.minimum(high, third))  # their median; NaN where one is missing
    lacking = np.isnan(predicted)
    known_pairs = np.stack([pair[lacking] for pair in pairs])
    predicted[lacking] = _predicted_by_fewer(moved, known_pairs, *np.nonzero(lacking))
    return predicted


def _predicted_by_fewer(moved: Floats, pairs: Floats, frame: Ints, sheet: Ints) -> Floats:
    """Return displacements predicted where fewer than three pairs (3, points) are known. Where fewer than two
    are known, as near the ends of the comb, lines through two sheets on one side are used as well, so that
    one wrong sheet never has the majority."""
    few = np.isfinite(pairs).sum(axis=0) < 2
    frame, sheet = frame[few], sheet[few]
    furthest = max(max(line) for line in LINES)
    padded = np.pad(moved, ((0, 0), (furthest, furthest)), constant_values=np.nan)
    extrapolated = np.full((2 * len(LINES), len(few)), np.nan)
    for values, (step, (near, far)) in zip(extrapolated, product((1, -1), LINES), strict=True):
        close, remote = (padded[frame, sheet + furthest + step * k] for k in (near, far))
        values[few] = close + (close - remote) * near / (far - near)
    return nan_median(np.concatenate([pairs, extrapolated]))


def _between(moved: Floats, rest: Floats, k: int) -> Floats:
    """Return displacements interpolated between the k-th neighbours; NaN where either is missing."""
    predicted = np.full_like(moved, np.nan)
    if moved.shape[1] <= 2 * k:
        return predicted
    to_left, to_right = rest[k:-k] - rest[: -2 * k], rest[2 * k :] - rest[k:-k]
    apart = to_left + to_right
    apart = np.where(apart > 0, apart, np.nan)  # two sheets at one position predict nothing
    predicted[:, k:-k] = (moved[:, : -2 * k] * to_right + moved[:, 2 * k :] * to_left) / apart
    return predicted


def hops(residual: Floats, comb: RidgeComb) -> Bools:
    """Return which sheets are on another ridge, (frame, N).

    The residual is the distance from the position that the neighbours predict. It must exceed several times
    the sheet's own scatter, the width of a ridge (nearer ridges are not resolved), and by far the residuals
    of most sheets in the frame, since many residuals grow at once in an avalanche or in a blurred frame.
    Among adjacent sheets only the largest residual counts: that sheet spoils the prediction for the others.
    """
    least = np.fmax(comb.settings.leave_sigmas * typical_size(residual) / NORMAL_MEDIAN, comb.fwhm_px)
    found = np.empty(residual.shape, bool)
    for part in row_parts(len(residual)):
        found[part] = np.abs(residual[part]) > least
    rows = np.flatnonzero(found.any(axis=1))  # most films have none
    some = np.abs(residual[rows])
    padded = np.pad(some, ((0, 0), (PAIRS, PAIRS)), constant_values=np.nan)
    around = [padded[:, i : i + some.shape[1]] for i in range(2 * PAIRS + 1)]
    found[rows] &= (some > 3.0 * nan_quantile(some, 0.75, axis=1)[:, None]) & (some >= np.fmax.reduce(around))
    return found


# --- numberings that looks contradict: brightnesses and widths are those of other sheets --------------------

TERM_LIMIT = 4.0  # nats: no single brightness or width decides a numbering
LIKE_A_SHEET = 1.1
"""Log contrast below the median down to which a ridge may be a sheet that touches another: a third of it."""
LEAST_SCATTER = np.array([0.02, 0.03])[:, None, None]  # of log contrast and log width: specks, pixels
BESIDE = 4  # sheets on each side whose common change of brightness or width is one of light or focus
AROUND = 2  # frames before or after a frame whose looks are judged together
QUIET_SHARE = 0.25  # of the sheets, which tells how much looks deviate where most sheets may be wrong
QUIET_SIGMAS = 0.3186  # quantile of this share of the absolute value of a normal variable
BY_CHANCE = 3.6
"""Gain of another numbering, in nats over the root of the number of looks, that chance does not reach. It
scatters by 0.8 for sheets that are equal but for noise. Larger passes jumps that few sheets show, smaller
names jumps of equal sheets that stay (test_noise_of_equal_sheets_is_no_jump at 1.6)."""
SETTLED = 8  # frames whose mean looks are compared: more tell less distinct sheets, fewer jumps in short turn
PART_SHIFTS = (-3, -2, -1, 1, 2, 3)  # sheets by which a part of the comb may be numbered otherwise


def numbered_by_a_neighbour(
    ridges: Ridges, match: Ints32, paired: Floats32, certain: Floats32, expected_px: Floats, comb: RidgeComb
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
    `doubt`. Where most sheets of a frame deviate, z and t are divided by how much more than usual they do.

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
    of an unpaired ridge between a sheet and the next, (frame, N - 1)."""
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


def split(ridges: Ridges, match: Ints32, paired: Floats32, certain: Floats32) -> Bools:
    """Return which sheets may be one half of a sheet that splits, (frame, N): beside a ridge too many, and
    nearer to half of the width that they have in a quarter of the film than to all of it. The parameters are
    those of `numbered_by_a_neighbour`."""
    width, halves = paired[2], np.zeros(match.shape, bool)
    usual = nan_quantile(certain[1], 0.75)
    for rows in row_parts(len(width)):
        size = width[rows] / usual
        narrow = np.sqrt(2) * size < nan_median(size, axis=1)[:, None]
        some = np.arange(rows.start, rows.stop)[narrow.any(axis=1)]
        if len(some):
            between = _unpaired(ridges, some, match[some], np.isfinite(width[some])) > 0
            beside_one = np.pad(between, ((0, 0), (1, 0))) | np.pad(between, ((0, 0), (0, 1)))
            halves[some] = narrow[some - rows.start] & beside_one
    return halves


def seen_between(ridges: Ridges, match: Ints32) -> float:
    """Return the share of the frames in which most spacings of at least `FEWEST` sheets hold one more ridge
    like a sheet: sheets that are gone in most of the film. match: candidate of each sheet, (frame, N)."""
    if match.shape[1] < FEWEST:
        return 0.0
    rows = np.arange(len(match))[typical_rows(len(match))]
    between = _unpaired(ridges, rows, match[rows], match[rows] >= 0)
    return float((between.mean(axis=1) > 0.5).mean())


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


def numbered_in_part(looks: Floats32, sure: Bools, certain: Floats32, settings: TrackingSettings) -> Bools:
    r"""Return which sheets are in a part of the comb that looks like the sheets beside, (frame, N).

    Sheets that were one ridge in many frames leave the numbering of one side open even if every sheet has a
    ridge. Let z be the deviations of a ridge's log contrast and log width from what is usual for sheet n, and
    :math:`z_{n,n+k}` those from sheet n + k, over their scatter. A part of the comb is doubtful if

    .. math:: \sum_n \Big[\min\Big(t, \sum_z \min\Big(\frac{z_n^2}{2}, t\Big) -
              \min\Big(\frac{z_{n,n+k}^2}{2}, t\Big)\Big) - s\Big] \text{ nats}

    over its sheets, as a mean of the frame with `AROUND` frames before or after it, exceeds `part_nats` for a
    shift k of up to three sheets. t is `TERM_LIMIT` and s `sheet_nats`: four sheets have to agree. If even
    the quarter of the sheets that deviates least does so more than usual, z and t are divided by how much
    more. The sheets beside such a part are doubtful, too. False for fewer than `pattern_sheets` sheets.

    Parameters
    ----------
    looks
        Contrasts and widths of the ridges of the sheets, (2, frame, N), NaN where missing.
    sure
        Which of them are compared, (frame, N): those that are not doubtful.
    certain
        Contrasts and widths in some frames of the film, without those that are doubtful.
    settings
        Thresholds.
    """
    doubtful = np.zeros(looks.shape[1:], bool)
    if looks.shape[2] < settings.pattern_sheets:
        return doubtful
    middle, scatter = _usual_looks(certain)

    def judge(rows: slice) -> None:
        around = slice(max(0, rows.start - AROUND), rows.stop + AROUND)
        near = np.log(np.where(sure[around], looks[:, around], np.nan).astype(np.float64))
        at = np.arange(min(rows.start, AROUND), len(near[0]))[: rows.stop - rows.start]
        off = (_without_light(near, middle) - middle) / scatter
        unusual = np.minimum((off**2 / 2).sum(axis=0), TERM_LIMIT) - 1.5
        odd = np.zeros(len(unusual), bool)  # few frames: the others are not compared
        odd[at] = _largest_in_mean(unusual, at).max(axis=1) > settings.anchor_nats / 2
        odd = np.flatnonzero(np.convolve(odd, np.ones(2 * AROUND + 1))[AROUND : AROUND + len(odd)] > 0.5)
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
    return np.asarray(doubtful & sure & np.isfinite(looks[0]), bool)


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


# --- sheets that nothing tells apart ------------------------------------------------------------------------


def sheets_alike(rest_px: Floats, contrast: Floats32, fwhm_px: Floats32, comb: RidgeComb) -> bool:
    """Return whether the sheets look so alike that a picture does not show which sheets it contains.

    Neither end of the comb is in view, and brightness, width and spacing differ from the mean of both
    neighbours by no more than they change with time, or than slips change spacings. A jump of such a comb by
    its pitch is invisible. Light that falls off along the comb is not a pattern of the sheets. False for
    fewer than five sheets. rest_px: rest positions (N,). Contrasts and widths are (frame, N).
    """
    if len(rest_px) < 5 or _end_in_view(rest_px, comb):
        return False
    alike = nan_median(np.abs(_bend(rest_px))) < comb.settings.spacing_spread * comb.pitch_px
    for values in (contrast, fwhm_px):
        pattern = without_common_change(np.log(values.astype(np.float64)))
        mean = nan_median(pattern)
        within = nan_median(typical_size(pattern, mean))
        alike &= nan_median(np.abs(_bend(mean))) < comb.settings.alike_scatter * within
    return bool(alike)


def _end_in_view(rest_px: Floats, comb: RidgeComb) -> bool:
    """Return whether the first or the last of the sheets rests away from the edges of the picture."""
    reach = comb.settings.edge_pitches * comb.pitch_px
    return bool(rest_px[0] > reach or rest_px[-1] < comb.width_px - 1 - reach)


def unseen_jumps(rest_px: Floats, contrast: Floats32, fwhm_px: Floats32, comb: RidgeComb) -> Ints:
    r"""Return the frames before which the sheets' looks moved on by sheets, although the sheets seem to stay.

    Where a comb without an end in view jumps by about its pitch, each sheet may be taken for the next one.
    The looks of almost equal sheets do not outweigh that the comb seems to stay, but they show that it may
    have jumped. Let a and b be the mean log contrasts and log widths of the `SETTLED` frames before and
    after. Then the sum over the sheets n of

    .. math:: \min\Big(\frac{(b_n - a_n)^2}{2 s^2}, t\Big)
              - \min\Big(\frac{(b_{n+k} - a_n)^2}{2 s^2}, t\Big),

    with the usual change s of such means and t `TERM_LIMIT`, exceeds `BY_CHANCE` times the root of the number
    of its terms for a k of `SHIFTS`.
    Empty if an end of the comb is in view. rest_px: rest positions (N,). Contrasts and widths are (frame, N).
    """
    if _end_in_view(rest_px, comb):
        return np.zeros(0, np.int64)
    gain = np.zeros(len(contrast))

    def compare(rows: slice) -> None:
        first = max(0, rows.start - SETTLED)
        near = np.log(np.stack([looks[first : rows.stop + SETTLED] for looks in (contrast, fwhm_px)]))
        looks = _without_light(near, nan_median(near, axis=1)[:, None])
        variance = sigma_about_zero(np.diff(looks, axis=1), axis=1)[:, None] ** 2 / 2
        known = np.isfinite(looks)
        count, total = (
            np.pad(np.cumsum(values, axis=1), ((0, 0), (1, 0), (0, 0)))
            for values in (known, np.where(known, looks, 0.0))
        )
        at = np.arange(max(rows.start, 1), rows.stop) - first
        edges = np.stack([np.maximum(at - SETTLED, 0), at, np.minimum(at + SETTLED, len(near[0]))])
        frames = np.diff(count[:, edges], axis=1).astype(np.float64)
        frames[frames == 0] = np.nan
        (before, after), (many, others) = (
            np.moveaxis(values, 1, 0) for values in (np.diff(total[:, edges], axis=1) / frames, frames)
        )

        def cost(by: int) -> Floats:
            """Return the cost of the looks afterwards if they are those of the sheets `by` further on."""
            moved, seen = (np.stack([shifted(kind, by) for kind in values]) for values in (after, others))
            changed = (moved - before) ** 2 / (LEAST_SCATTER**2 + variance * (1 / many + 1 / seen))
            return np.asarray(np.minimum(changed / 2, TERM_LIMIT))

        own = cost(0)
        for by in SHIFTS:
            saved = own - cost(by)
            terms = np.maximum(np.isfinite(saved).sum(axis=(0, 2)), 1)
            gain[at + first] = np.fmax(gain[at + first], np.nansum(saved, axis=(0, 2)) / np.sqrt(terms))

    in_two_threads(compare, row_parts(len(gain), 1024))  # ten tables of each part are held at once
    around = np.lib.stride_tricks.sliding_window_view(np.pad(gain, SETTLED), 2 * SETTLED + 1)
    return np.flatnonzero((gain > BY_CHANCE) & (gain >= around.max(axis=1)))


def _bend(values: Floats) -> Floats:
    """Return values (N,) minus the means of their neighbours, (N − 2,)."""
    return np.asarray(values[1:-1] - (values[2:] + values[:-2]) / 2)
