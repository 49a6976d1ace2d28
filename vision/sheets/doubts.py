"""Doubtful identities: what the alignment did not use says that a sheet may be another one.

That is the positions that neighbouring sheets predict, the jumps of the whole comb, and other numberings that
pair the ridges as well. The pattern of spacings, brightnesses and widths ends doubts. Numberings that the
looks of the ridges contradict in a part of the comb are found in `vision.sheets.looks`.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from vision.numeric import (
    NORMAL_MEDIAN,
    Bools,
    Codes,
    Floats,
    Floats32,
    Ints,
    column_parts,
    common_change,
    in_two_threads,
    median_size,
    median_step,
    median_where,
    nan_median,
    nan_quantile,
    row_parts,
    shifted,
    without_common_change,
)
from vision.sheets.identities import SHIFTS, Doubt, Identities, last_seen, torn
from vision.sheets.reference import rest_positions
from vision.sheets.ridges import RidgeComb, in_blocks

PAIRS = 3  # neighbours on each side that predict a sheet's position
LINES = ((1, 2), (1, 3), (2, 3), (2, 4), (3, 4))  # distances of two neighbours on one side that a line joins
TERM_LIMIT = 4.0  # nats: no single spacing, brightness or width decides a numbering
LIKE_ITSELF = 0.7
"""Change of log contrast up to which a ridge may be the sheet that is expected there: a factor of two."""
MOST_COMPLETE = 0.95  # quantile of the number of sheets found from which on frames tell the usual spacings
LEFT_AT_END = 0.4  # pitches by which a spacing is narrower that a missing sheet at an end does not leave


def doubts_of(
    x: Floats32, contrast: Floats32, fwhm: Floats32, identities: Identities, comb: RidgeComb
) -> Codes:
    """Return which identities of paired ridges are doubtful by margin, jump or tear, (frame, N).

    A margin that is too small is no doubt where the pattern confirms the identity, or where the ridges do not
    move from the last certain frame to the next. x, contrast, fwhm: of the paired ridges, (frame, N).
    """
    why = np.full(x.shape, Doubt.NONE, np.uint8, order="F")
    why[~(identities.margin >= comb.settings.doubt)] = Doubt.MARGIN
    rest = rest_positions(x)
    why[_unproved_jumps(x, common_change(x, rest), contrast, identities, comb)] = Doubt.JUMP

    def doubt_torn(rows: slice) -> None:
        why[rows][torn(x[rows] - rest, comb)] = Doubt.TEAR

    in_two_threads(doubt_torn, row_parts(len(x)))
    why[np.isnan(x)] = Doubt.NONE
    unsettled = why == Doubt.MARGIN
    if unsettled.any():
        known = np.where(why == Doubt.TEAR, np.float32(np.nan), x)
        trusted = np.isfinite(known) & (why == Doubt.NONE)
        bright, wide = (np.log(values.astype(np.float64)) for values in (contrast, fwhm))
        why[unsettled & anchored(known, bright, wide, trusted, comb)] = Doubt.NONE
        del bright, wide
        unsettled &= why == Doubt.MARGIN
        why[unsettled & unmoved(x, why == Doubt.NONE, unsettled, comb)] = Doubt.NONE
    return why


def _unproved_jumps(
    x: Floats32, moved: Floats, contrast: Floats32, identities: Identities, comb: RidgeComb
) -> Bools:
    """Return where the comb is displaced by a jump that could be one of whole pitches, (frame, N).

    Jumps divide the film into runs of frames. Where the comb is not at its usual place, the margin must
    exceed the cost of staying there; with neither end in view, where only brightness shows a jump, it must
    also exceed the costs of sheets that cross the edges. After a real jump every sheet keeps its brightness.
    Where brightnesses changed by more than `least_misfit`, the costs mistake changed sheets for exchanged
    ones, and the margin required grows by the ratio of the squares: the overdispersion of a quasi-likelihood
    (McCullagh & Nelder 1989, chapter 9).
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
    place = np.array([nan_median(moved[run == one]) for one in range(run[-1] + 1)])
    apart = np.abs(place - place[:, None]) / (settings.step_fraction * comb.pitch_px)
    away = apart[np.argmax((apart < 0.5) @ np.bincount(run))][run] > 1
    if not away.any():
        return none
    least = settings.stay_cost + 1.0 + np.where(no_end_in_view, 2 * settings.crossing_cost, 0.0)
    off = np.log(contrast.astype(np.float64))
    off -= identities.reference.log_contrast
    off -= nan_median(off, axis=1)[:, None]  # flicker
    misfit = np.minimum(np.nan_to_num(off) ** 2, LIKE_ITSELF**2).sum(axis=1)
    misfit /= np.maximum(np.isfinite(off).sum(axis=1), 1)
    worse = np.maximum(misfit / settings.least_misfit**2, 1.0)
    margin = nan_median(identities.margin, axis=1)  # of the whole comb; single sheets may be less certain
    runs = [run == one for one in range(run[-1] + 1)]
    # medians: a slip within the exposure of one frame changes brightnesses there alone
    given, wanted = (np.array([nan_median(part[one]) for one in runs]) for part in (margin, least * worse))
    unproved = away & (given < wanted)[run]
    return np.asarray(unproved[:, None] & np.isfinite(x), bool)


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
    predicted = np.empty(x_px.shape, order="F")

    def predict(rows: slice) -> None:
        predicted[rows] = _displacements(x_px[rows] - rest, rest)

    def add_usual_difference(few: slice) -> None:
        own = predicted[:, few]
        own += rest[few] + nan_median(x_px[:, few] - rest[few] - own)

    in_blocks(predict, x_px)
    in_two_threads(add_usual_difference, column_parts(predicted))
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
    """Return displacements predicted where fewer than three pairs (3, points) are known.

    Where fewer than two are known, as near the ends of the comb, lines through two sheets on one side are
    used as well, so that one wrong sheet never has the majority.
    """
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
    least = np.fmax(comb.settings.leave_sigmas * median_size(residual) / NORMAL_MEDIAN, comb.fwhm_px)
    found = np.empty(residual.shape, bool)
    for part in row_parts(len(residual)):
        found[part] = np.abs(residual[part]) > least
    rows = np.flatnonzero(found.any(axis=1))  # most films have none
    some = np.abs(residual[rows])
    padded = np.pad(some, ((0, 0), (PAIRS, PAIRS)), constant_values=np.nan)
    around = [padded[:, i : i + some.shape[1]] for i in range(2 * PAIRS + 1)]
    found[rows] &= (some > 3.0 * nan_quantile(some, 0.75, axis=1)[:, None]) & (some >= np.fmax.reduce(around))
    return found


# --- the comb's own pattern ---------------------------------------------------------------------------------


def anchored(
    x_px: NDArray[np.floating], log_contrast: Floats, log_width: Floats, trusted: Bools, comb: RidgeComb
) -> Bools:
    """Return which identities are confirmed by a pattern that fits no other numbering, (frame, N).

    The pattern is the spacings, brightnesses and widths of the sheets (positions, log contrasts and log
    widths of the ridges paired with them, (frame, N), NaN where none); the median and scatter of each are
    measured over the trusted identities (frame, N). The cost of a numbering is the sum of squared deviations
    over twice the variance, each at most `TERM_LIMIT`. A frame is anchored if every numbering shifted by one
    or two sheets costs `anchor_nats` more. An even comb of equal sheets is never anchored.

    False where fewer than a tenth of the frames are trusted, and for sheets without a neighbour at the usual
    spacing: the rest of the frame does not constrain these.
    """
    if x_px.shape[1] < 3 or trusted.any(axis=1).mean() < 0.1:
        return np.zeros(x_px.shape, bool)
    both = trusted & np.hstack([trusted[:, 1:], np.zeros((len(trusted), 1), bool)])
    own_cost, terms = np.zeros((2, len(x_px)))
    excess, usual_gap = np.zeros((len(SHIFTS), len(x_px))), np.empty(x_px.shape, bool)
    for kind, values in enumerate((x_px, log_contrast, log_width)):
        of_gaps = kind == 0
        if of_gaps:
            feature = _Feature.of(np.diff(values, axis=1, append=np.nan), both, 0.01 * comb.pitch_px)
        else:
            feature = _Feature.of(without_common_change(values), trusted, 0.05)
        for rows in row_parts(len(x_px)):
            own, *others = feature.costs(rows)
            own_cost[rows] += np.nansum(own, axis=1)
            terms[rows] += np.isfinite(own).sum(axis=1)
            # only features that both numberings explain
            excess[:, rows] += np.stack([np.nansum(other - own, axis=1) for other in others])
            if of_gaps:
                usual_gap[rows] = own < TERM_LIMIT / 2
    fits = own_cost < comb.settings.anchor_fit * np.maximum(terms, 1)
    beside = usual_gap | np.hstack([np.zeros((len(x_px), 1), bool), usual_gap[:, :-1]])
    return np.asarray((fits & (excess.min(axis=0) > comb.settings.anchor_nats))[:, None] & beside, bool)


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


def sheets_alike(x_px: Floats, contrast: Floats32, fwhm_px: Floats32, comb: RidgeComb) -> bool:
    """Return whether the sheets look so alike that a picture does not show which sheets it contains.

    Neither end of the comb is in view, and brightness, width and spacing differ from the mean of both
    neighbours by no more than they change with time, or than slips change spacings. A jump of such a comb by
    its pitch is invisible. Light that falls off along the comb is not a pattern of the sheets. False for
    fewer than five sheets. Positions, contrasts and widths are (frame, N), NaN where missing.
    """
    rest = rest_positions(x_px)
    reach = comb.settings.edge_pitches * comb.pitch_px
    if len(rest) < 5 or rest[0] > reach or rest[-1] < comb.width_px - 1 - reach:
        return False
    alike = nan_median(np.abs(_bend(rest))) < comb.settings.spacing_spread * comb.pitch_px
    for values in (contrast, fwhm_px):
        pattern = without_common_change(np.log(values.astype(np.float64)))
        mean = nan_median(pattern)
        within = nan_median(median_size(pattern, mean))
        alike &= nan_median(np.abs(_bend(mean))) < comb.settings.alike_scatter * within
    return bool(alike)


def _bend(values: Floats) -> Floats:
    """Return values (N,) minus the means of their neighbours, (N − 2,)."""
    return np.asarray(values[1:-1] - (values[2:] + values[:-2]) / 2)


@dataclass(frozen=True)
class _Feature:
    """Values of the sheets (frame, N), NaN where unknown; of each sheet the usual one, and its scatter."""

    values: Floats
    middle: Floats
    spread: Floats

    @classmethod
    def of(cls, values: Floats, learned: Bools, least_spread: float) -> _Feature:
        """Return the feature, with what is usual taken from the values that are learned (frame, N)."""
        middle = median_where(learned, values)
        off = zip(learned.T, values.T, middle, strict=True)
        spread = [nan_median(np.where(use, np.abs(own - at), np.nan)) for use, own, at in off]
        return cls(values, middle, np.maximum(np.array(spread) / NORMAL_MEDIAN, least_spread))

    def costs(self, rows: slice) -> list[Floats]:
        """Return the cost of each value for its own sheet, then for each sheet of SHIFTS; (frame, N), NaN
        where unknown."""
        values = self.values[rows]
        costs = []
        for shift in (0, *SHIFTS):
            expected = shifted(self.middle[None], shift)
            # the wider of both scatters, so that a single noisy sheet does not exclude a numbering
            sigma = np.fmax(shifted(self.spread[None], shift), self.spread[None])
            limit = np.where(np.isfinite(expected), TERM_LIMIT, np.nan)
            costs.append(np.fmin((values - expected) ** 2 / (2 * sigma**2), limit))
        return [np.where(np.isfinite(values), cost, np.nan) for cost in costs]


# --- where another numbering pairs the ridges as well -------------------------------------------------------


def numbered_between_tears(x: NDArray[np.floating], missing: Bools, comb: RidgeComb) -> Bools:
    r"""Return which sheets may be on the ridge of the next, as another spacing has room for a missing one.

    A missing sheet leaves a spacing twice as wide. If that spacing is narrower and another one wider, the
    sheet may be missing in the other one, and each of the k sheets between both be on the ridge of the next.
    With the changes of both spacings from the usual ones in pitches, :math:`t_m` where the sheet is missing
    and :math:`t_w` where it may be, these sheets are doubtful if

    .. math:: t_w - t_m > t_0 + k\,t_1

    with `room_pitches` :math:`t_0` and `room_per_sheet` :math:`t_1`; at 1 both readings fit equally well. A
    sheet that is missing in view at an end of the comb leaves no spacing; :math:`t_m` is -`LEFT_AT_END`.
    Spacings are usual in the frames that show most sheets.

    Parameters
    ----------
    x
        Positions of the sheets, px, NaN where missing or doubtful, (frame, N).
    missing
        Whether a sheet has no ridge, (frame, N).
    comb
        The ridges' appearance.

    Returns
    -------
    numpy.ndarray
        Whether a sheet with a position is doubtful, (frame, N).
    """
    found = np.isfinite(x)
    count, doubtful = found.sum(axis=1), np.zeros(found.shape, bool)
    usual_px = rest_positions(x[count >= np.quantile(count, MOST_COMPLETE)])
    lacking = np.flatnonzero(missing.any(axis=1) & (count > 0))
    per_sheet = comb.settings.room_per_sheet * np.arange(x.shape[1] + 1)
    for part in row_parts(len(lacking)):
        rows = lacking[part]
        narrow, wide = _spacing_changes(x[rows].astype(np.float64), missing[rows], usual_px, comb)
        for turn in (slice(None), slice(None, None, -1)):  # sheet n has the spacings up to n on its left
            least = np.minimum.accumulate(narrow[:, turn] - per_sheet, axis=1)[:, :-1]
            most = np.maximum.accumulate((wide[:, turn] - per_sheet)[:, ::-1], axis=1)[:, ::-1][:, 1:]
            doubtful[rows] |= found[rows] & (most - least > comb.settings.room_pitches)[:, turn]
    return doubtful


def _spacing_changes(
    x: Floats, missing: Bools, usual_px: NDArray[np.floating], comb: RidgeComb
) -> tuple[Floats, Floats]:
    """Return by how many pitches the spacing before each sheet, and that after the last one, is wider than
    usual, (frame, N + 1): inf where no sheet is missing in it, and the same, -inf where it is none."""
    number, found = np.arange(x.shape[1] + 1), np.isfinite(x)
    here = np.pad(found, ((0, 0), (0, 1)), constant_values=True)
    before = np.maximum.accumulate(np.where(found, number[:-1], -1), axis=1)
    before = np.pad(before, ((0, 0), (1, 0)), constant_values=-1)
    moved = np.pad((x - usual_px) / comb.pitch_px, ((0, 0), (0, 1)), constant_values=np.nan)
    wider = moved - np.take_along_axis(moved, np.maximum(before, 0), axis=1)
    at_end = here & ((before < 0) | (number == number[-1]))
    wider[at_end] = np.nan
    end_px = np.stack([np.nanmin(x, axis=1), comb.width_px - 1 - np.nanmax(x, axis=1)], axis=1)
    in_view = np.where(number < number[-1], end_px[:, :1], end_px[:, 1:]) > comb.pitch_px
    narrow = np.where(at_end & in_view, -LEFT_AT_END, wider)
    lost = np.pad(np.cumsum(missing, axis=1), ((0, 0), (1, 0)))  # before each spacing
    narrow[~here | (lost == np.take_along_axis(lost, before + 1, axis=1))] = np.inf
    return np.nan_to_num(narrow, nan=np.inf), np.nan_to_num(wider, nan=-np.inf)
