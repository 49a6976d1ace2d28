"""Doubtful identities: what the alignment did not use says that a sheet may be another one.

That is the positions that neighbouring sheets predict, and the jumps of the whole comb. Numberings that the
looks of the ridges contradict in a part of the comb are found in `vision.sheets.looks`.
"""

from __future__ import annotations

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
    nan_median,
    nan_quantile,
    row_parts,
    without_common_change,
)
from vision.sheets.identities import Doubt, Identities, last_seen
from vision.sheets.reference import rest_positions
from vision.sheets.ridges import RidgeComb, in_blocks

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


# --- sheets that nothing tells apart ------------------------------------------------------------------------


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
