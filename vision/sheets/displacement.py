"""How the whole comb moves: its squeeze, and its displacement, with whole pitches told by the pattern."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vision.numeric import Bools, Floats, Floats32, Ints, in_two_threads, nan_median, row_parts
from vision.sheets.alignment import Candidates
from vision.sheets.ridges import RidgeComb, Ridges
from vision.sheets.settings import TrackingSettings
from vision.signals import running_median


def comb_squeeze(ridges: Ridges, settings: TrackingSettings) -> tuple[Floats, float]:
    """Return the mean spacing in each frame over that of the film, (frame, 1), and the comb's middle, px.

    The ratio is 1 in all frames of a film in which it hardly changes.
    The quantiles of the spacings are compared with their usual values, since spacings may be of several
    kinds; those of a missing sheet or a false detection are beyond the quantiles. A squeeze changes all of
    them alike: `squeeze_share` of the variance of their logarithms must be common.
    """
    middle_px, still = float(nan_median(ridges.x_px.ravel())), np.ones((len(ridges.x_px), 1))
    sheets = np.maximum(ridges.count, 1)
    usual = np.median(sheets)
    # Without frames in which many are covered, or in which two frames share an image and many are seen twice.
    rows = np.flatnonzero((2 * sheets >= usual) & (4 * sheets <= 5 * usual) & (sheets > 1))
    if not len(rows):
        return still, middle_px
    parts = in_two_threads(lambda part: _log_spacings(ridges.x_px[rows[part]]), row_parts(len(rows)))
    change = np.concatenate(parts)
    change -= np.median(change, axis=0)
    common = change.mean(axis=1)
    scale = running_median(np.exp(np.interp(np.arange(len(still)), rows, common)), 3)
    least, most = np.quantile(scale, (0.02, 0.98))
    squeezed = (most / least - 1) * usual / 2 >= settings.least_squeeze
    squeezed &= common.var() >= settings.squeeze_share * change.var()
    return scale[:, None] if squeezed else still, middle_px


def _log_spacings(x_px: Floats32) -> Floats:
    """Return the logarithms of quantiles of the spacings in each frame, (frame, 17)."""
    gap = np.diff(x_px.astype(np.float64), axis=1)
    last = np.isfinite(gap).sum(axis=1)[:, None] - 1
    gap.sort(axis=1)  # NaN last; nanquantile takes forty times as long
    at = np.linspace(0.1, 0.9, 17) * last
    lower = at.astype(np.int64)
    low, high = (np.take_along_axis(gap, k, axis=1) for k in (lower, np.minimum(lower + 1, last)))
    return np.asarray(np.log(low + (at - lower) * (high - low)), np.float64)


def comb_displacement(ridges: Ridges, comb: RidgeComb) -> tuple[Floats, Bools]:
    """Return the displacement of the whole comb since the first frame, px, (frame,), and which of its steps
    may be other ones, (frame − 1,): those of a comb that jumps.

    It is the sum of mean steps from each ridge to the nearest ridge of the next frame. Only steps within a
    pixel of their median enter (positions are whole pixels). Where most steps are too large to identify the
    same ridge, the step is 0.
    """
    frames = len(ridges.x_px)
    apart = 4.0 * (float(np.nanmax(ridges.x_px, initial=0.0)) + comb.pitch_px)
    moved, followed = np.zeros(frames - 1), np.zeros(frames - 1, bool)
    if not ridges.count.any():
        return np.zeros(frames), followed

    def follow(rows: slice) -> None:
        near = np.arange(rows.start, rows.stop + 1)
        moved[rows], followed[rows] = _mean_steps(ridges.x_px[near] + apart * near[:, None], apart, comb)

    in_two_threads(follow, row_parts(frames - 1))
    uncertain = ~followed | (np.abs(moved) > comb.settings.still_fraction * comb.pitch_px)
    return np.concatenate([[0.0], np.cumsum(np.where(followed, moved, 0.0))]), uncertain


def _mean_steps(in_one_row: Floats, apart: float, comb: RidgeComb) -> tuple[Floats, Bools]:
    """Return the mean step of the ridges from each frame to the next, and whether most were followed.

    in_one_row: positions in frames that lie `apart` in one row, px, (frame, K).
    """
    row = in_one_row[np.isfinite(in_one_row)]
    if not len(row):
        return np.zeros(len(in_one_row) - 1), np.zeros(len(in_one_row) - 1, bool)
    same = in_one_row[:-1] + apart  # positions in the next frame if nothing moves
    after = np.searchsorted(row, np.nan_to_num(same))
    near = np.stack([row[np.clip(after - 1, 0, len(row) - 1)], row[np.clip(after, 0, len(row) - 1)]]) - same
    step = np.where(np.abs(near[0]) < np.abs(near[1]), near[0], near[1])
    small = np.abs(step) < comb.settings.step_fraction * comb.pitch_px
    followed = small.sum(axis=1) > 0.5 * np.isfinite(same).sum(axis=1)
    small &= np.abs(step - nan_median(np.where(small, step, np.nan), axis=1)[:, None]) <= 1.0
    return np.where(small, step, 0.0).sum(axis=1) / np.maximum(small.sum(axis=1), 1), followed


# --- whole pitches ------------------------------------------------------------------------------------------

LEAST_DIFFERENCE = np.array([0.5, 0.02, 0.02])  # of positions (whole pixels), log contrasts and log widths
FIRST_REFERENCES = 8  # lists that are tried: one may mix frames between which the comb jumped by a pitch
MOST_LISTS = 192  # that enter a later reference


class Placed(NamedTuple):
    """Lists of candidates placed on the comb, (lists,).

    displacement_px: displacement of the comb. proved: whether the pattern proves it. first: sheet at which
    each list begins. jumps: whether the displacement that was given lacked whole pitches.
    """

    displacement_px: Floats
    proved: Bools
    first: Ints
    jumps: bool


def place_by_pattern(
    candidates: Candidates, frames: Ints, displacement_px: Floats, comb: RidgeComb
) -> Placed:
    r"""Add whole pitches to the displacement of the comb where the pattern of the sheets proves them.

    `comb_displacement` takes a step of more than half a pitch for one in the other direction. The pattern
    tells them apart: the bends of position, brightness and width along the comb, each sheet's difference from
    the mean of its neighbours, in which light that varies smoothly cancels. Each list of candidates is
    compared with a reference shifted by k sheets. If the n bends that both have differ by the mean absolute
    value :math:`\delta_k`, the log-likelihood of k for Laplace noise of unknown size is

    .. math:: -\frac{n}{2} \ln \delta_k

    for each kind of bend (half, since neighbouring bends share sheets). k is proved if it exceeds all others
    by `anchor_nats`. The longest list is the first reference, the proved lists together are the next. Other
    lists keep their displacement relative to the nearest proved list. Nothing is changed if less than half of
    the film is proved.

    There is one list for each segment of frames; `frames` is its number of frames and `displacement_px` its
    `comb_displacement`, (lists,).
    """
    site = _sites(candidates.x_px, comb.pitch_px)
    size = site.max(axis=1) + 1
    unchanged = Placed(displacement_px, np.zeros(len(site), bool), np.full(len(site), size.max()), False)
    if len(site) < 2 or np.median(size) < comb.settings.pattern_sheets:
        return unchanged
    lists, k = np.nonzero(site >= 0)
    table = np.full((3, len(site), size.max()), np.nan)  # of positions, log contrasts and log widths
    for row, values in zip(
        table, (candidates.x_px, candidates.log_contrast, candidates.log_width), strict=True
    ):
        row[lists, site[lists, k]] = values[lists, k]
    bends = np.full_like(table, np.nan)
    bends[..., 1:-1] = table[..., 1:-1] - (table[..., :-2] + table[..., 2:]) / 2
    known = np.concatenate([table[:1], bends])
    usual = np.flatnonzero(size >= np.median(size))
    best = unchanged
    for one in usual[np.argsort(-frames[usual], kind="stable")[:FIRST_REFERENCES]]:
        only = unchanged._replace(proved=np.arange(len(site)) == one)
        placed = _compared_with(only, known, frames, displacement_px, comb)
        best = max(best, placed, key=lambda found: int(frames[found.proved].sum()))
        if 2 * frames[best.proved].sum() > frames.sum():
            break
    for _ in range(2):
        if best.jumps:
            best = _compared_with(best, known, frames, displacement_px, comb)
    few = 2 * frames[best.proved].sum() <= frames.sum()
    return best._replace(displacement_px=displacement_px, jumps=False) if few else best


def _sites(x_px: Floats, pitch_px: float) -> Ints:
    """Return the number of each candidate in its list if missing ones are counted, −1 where there is none."""
    gap = np.nan_to_num(np.diff(x_px, axis=1, prepend=x_px[:, :1]))
    return np.where(np.isfinite(x_px), np.cumsum(np.rint(gap / pitch_px), axis=1), -1).astype(np.int64)


def _compared_with(
    reference: Placed, known: Floats, frames: Ints, displacement_px: Floats, comb: RidgeComb
) -> Placed:
    """Place all lists on the comb that the proved lists of `reference` show.

    known: position and the three bends of each sheet of each list, (4, lists, sheets).
    """
    x_px, bends = known[0], known[1:]
    rest_px, pattern = _mean_comb(reference, known, frames, comb)
    first, nats, moved = _best_fit(x_px - displacement_px[:, None], bends, rest_px, pattern, comb)
    proved = nats > comb.settings.anchor_nats
    if not (proved & moved).any():
        return Placed(displacement_px, proved, first, False)
    certain = np.flatnonzero(proved)
    nearest = certain[np.abs(certain - np.arange(len(proved))[:, None]).argmin(axis=1)]
    own = nan_median(x_px - rest_px[first[:, None] + np.arange(x_px.shape[1])], axis=1)
    return Placed(displacement_px + (own - displacement_px)[nearest], proved, first, True)


def _mean_comb(placed: Placed, known: Floats, frames: Ints, comb: RidgeComb) -> tuple[Floats, Floats]:
    """Return the rest position (columns,) and the bends (3, columns) of each sheet in the proved lists.

    There are three columns for each sheet of the longest list, so that every list may begin at the first
    two thirds of the columns.
    """
    sheets = known.shape[2]
    chosen = np.flatnonzero(placed.proved)
    chosen = chosen[np.argsort(-frames[chosen], kind="stable")[:MOST_LISTS]]
    everything = np.full((4, len(chosen), 3 * sheets), np.nan)
    columns = placed.first[chosen, None] + np.arange(sheets)
    everything[:, np.arange(len(chosen))[:, None], columns] = known[:, chosen]
    everything[0] -= placed.displacement_px[chosen, None]
    rest_px, *pattern = nan_median(everything, axis=1)
    column, seen = np.arange(3 * sheets), np.flatnonzero(np.isfinite(rest_px))
    outside = np.minimum(column - seen[0], 0) + np.maximum(column - seen[-1], 0)
    return np.interp(column, seen, rest_px[seen]) + comb.pitch_px * outside, np.array(pattern)


def _best_fit(
    rest_px: Floats, bends: Floats, columns_px: Floats, pattern: Floats, comb: RidgeComb
) -> tuple[Ints, Floats, Bools]:
    """Return the column at which each list fits the pattern best, by how many nats better than anywhere else,
    and whether its positions denote another column; (lists,).

    rest_px: positions less the displacement, (lists, sheets). bends: (3, lists, sheets). columns_px, pattern:
    from `_mean_comb`.
    """
    sheets = rest_px.shape[1]
    sheet = np.arange(sheets)
    near = np.interp(rest_px, columns_px, np.arange(len(columns_px))) - sheet
    by_position = np.rint(np.nan_to_num(nan_median(near, axis=1))).astype(np.int64)
    shifts = np.arange(-sheets // 2, sheets // 2 + 1)
    cost, count = np.full((len(shifts), len(rest_px)), np.inf), np.zeros((len(shifts), len(rest_px)))
    least = np.fmax(np.isfinite(bends[1]).sum(axis=1) / 2, comb.settings.pattern_sheets)
    for i, shift in enumerate(shifts.tolist()):
        first = np.clip(by_position + shift, 0, 2 * sheets)
        off = np.abs(bends - pattern[:, first[:, None] + sheet])
        count[i] = np.isfinite(off[1]).sum(axis=1)
        mean = np.nansum(off, axis=2) / np.maximum(count[i], 1)
        enough = (count[i] >= least) & (first == by_position + shift)
        cost[i, enough] = np.log(np.fmax(mean[:, enough], LEAST_DIFFERENCE[:, None])).sum(axis=0)
    best = cost.argmin(axis=0)
    lists = np.arange(len(rest_px))
    lowest = np.where(np.isfinite(cost[best, lists]), cost[best, lists], 0.0)
    overlap = np.maximum(np.minimum(count, count[best, lists]), 1)
    nats = (cost - lowest) * overlap / 2
    nats[best, lists] = np.inf
    fits = np.isfinite(cost).any(axis=0)
    moved = shifts[best]
    return np.clip(by_position + moved, 0, 2 * sheets), np.where(fits, nats.min(axis=0), 0.0), moved != 0
