"""Tests of identities against neighbouring sheets and against the comb's own pattern.

The alignment decides which ridge is which sheet. The functions here test its decisions with information that
it did not use. `neighbour_residual` measures how far each sheet is from the position that its neighbours
predict. `hops` finds sheets that have moved to another ridge. `anchored` finds frames whose spacings,
brightnesses and widths fit a single numbering, so that an earlier doubt is settled. `pattern_shift` finds
frames from which on brightnesses and widths fit another numbering. `sheets_alike` finds combs
without any pattern.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from vision.numeric import NORMAL_MEDIAN, Bools, Floats, Ints, nan_median, nan_quantile, shifted
from vision.sheets.ridges import RidgeComb
from vision.sheets.settings import DEFAULT, TrackingSettings

PAIRS = 3  # neighbours on each side that predict a sheet's position
LINES = ((1, 2), (1, 3), (2, 3), (2, 4), (3, 4))  # distances of two neighbours on one side that a line joins
SHIFTS = (-2, -1, 1, 2)  # alternative numberings that the pattern must exclude
TERM_LIMIT = 4.0  # nats: no single spacing, brightness or width decides a numbering


def neighbour_residual(x_px: Floats) -> Floats:
    r"""Return the distance of each sheet from the position that its neighbours predict, px, (frame, N).

    x_px: positions (frame, N), NaN where missing. The median residual of each sheet is subtracted. NaN where
    the sheet or all its neighbours are missing, and for fewer than three sheets.

    With the displacement :math:`u_n` from the rest position, the neighbours predict

    .. math:: \hat u_n = \operatorname{median}_{k \le 3}
              \frac{u_{n-k}\,d_{n+k} + u_{n+k}\,d_{n-k}}{d_{n-k} + d_{n+k}},

    where d are distances at rest: displacements are linear between the sheets of each pair, whatever the
    mechanics. Near the ends of the comb pairs are lacking; there, lines through two sheets on one side are
    used as well. The median over the pairs tolerates one wrong neighbour.
    """
    return np.asarray(x_px - predicted_by_neighbours(x_px), np.float64)


def predicted_by_neighbours(x_px: Floats) -> Floats:
    """Return the position of each sheet predicted by its neighbours, px, (frame, N).

    Missing sheets have one, too. NaN where all neighbours are missing, and for fewer than three sheets; see
    `neighbour_residual`.
    """
    sheets = x_px.shape[1]
    if sheets < 3:
        return np.full(x_px.shape, np.nan)
    rest = rest_positions(x_px)
    moved = x_px - rest
    first, second, third = pairs = [_between(moved, rest, k) for k in range(1, PAIRS + 1)]
    low, high = np.minimum(first, second), np.maximum(first, second)
    predicted = np.maximum(low, np.minimum(high, third))  # their median; NaN where one is missing
    lacking = np.isnan(predicted)
    known_pairs = np.stack([pair[lacking] for pair in pairs])
    predicted[lacking] = _predicted_by_fewer(moved, known_pairs, *np.nonzero(lacking))
    return np.asarray(rest + predicted + nan_median(moved - predicted), np.float64)


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


def rest_positions(x_px: Floats) -> Floats:
    """Return each sheet's median position after removing the comb's common motion, (N,).

    This is also right for sheets that are in view only while the comb is displaced.
    """
    rest = nan_median(x_px)
    for _ in range(3):
        rest = nan_median(x_px - nan_median(x_px - rest, axis=1)[:, None])
    return rest


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


def torn(moved: Floats, comb: RidgeComb) -> Bools:
    """Return which sheets are displaced very differently from their neighbours in a frame, (frame, N).

    A slip moves neighbours alike, however far. Where the displacements `moved` of neighbours differ by more
    than `tear_fraction` pitches, one of the identities is wrong. Such tears divide the sheets of a frame into
    groups; all groups but the largest are doubtful.
    """
    frames, sheets = moved.shape
    seen = np.isfinite(moved)
    before = np.hstack([np.full((frames, 1), np.nan), last_seen(moved)[:, :-1]])
    group = np.cumsum(np.abs(moved - before) > comb.settings.tear_fraction * comb.pitch_px, axis=1)
    key = (group + sheets * np.arange(frames)[:, None])[seen]
    size = np.bincount(key, minlength=frames * sheets).reshape(frames, sheets)
    own_size = np.take_along_axis(size, group, axis=1)
    return np.asarray(seen & (own_size < size.max(axis=1, keepdims=True)), bool)


def last_seen(values: Floats) -> Floats:
    """Replace each NaN by the last value before it in its row."""
    number = np.where(np.isfinite(values), np.arange(values.shape[1]), 0)
    return np.asarray(np.take_along_axis(values, np.maximum.accumulate(number, axis=1), axis=1), np.float64)


def hops(residual: Floats, comb: RidgeComb) -> Bools:
    """Return which sheets are on another ridge, judged by their `neighbour_residual`, (frame, N).

    The residual must exceed several times the sheet's own scatter, the width of a ridge (nearer ridges are
    not resolved), and by far the residuals of most sheets in the frame, since many residuals grow at once in
    an avalanche or in a blurred frame. Among adjacent sheets only the largest residual counts: that sheet
    spoils the prediction for the others.
    """
    size = np.abs(residual)
    least = comb.settings.leave_sigmas * nan_median(size) / NORMAL_MEDIAN
    found = np.asarray(size > np.fmax(least, comb.fwhm_px), bool)
    rows = np.flatnonzero(found.any(axis=1))  # most films have none
    some = size[rows]
    padded = np.pad(some, ((0, 0), (PAIRS, PAIRS)), constant_values=np.nan)
    around = [padded[:, i : i + size.shape[1]] for i in range(2 * PAIRS + 1)]
    found[rows] &= (some > 3.0 * nan_quantile(some, 0.75, axis=1)[:, None]) & (some >= np.fmax.reduce(around))
    return found


def anchored(x_px: Floats, log_contrast: Floats, log_width: Floats, trusted: Bools, comb: RidgeComb) -> Bools:
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
    gap = np.diff(x_px, axis=1, append=np.nan)
    both = trusted & np.hstack([trusted[:, 1:], np.zeros((len(trusted), 1), bool)])
    features = (
        (gap, both, 0.01 * comb.pitch_px),
        (_without_common_change(log_contrast), trusted, 0.05),
        (_without_common_change(log_width), trusted, 0.05),
    )
    own_cost = np.zeros(len(x_px))
    terms = np.zeros(len(x_px))
    excess = np.zeros((len(SHIFTS), len(x_px)))
    for values, learned, floor in features:
        cost = _feature_costs(values, learned, floor)
        own_cost += np.nansum(cost[0], axis=1)
        terms += np.isfinite(cost[0]).sum(axis=1)
        # only features that both numberings explain
        excess += np.stack([np.nansum(other - cost[0], axis=1) for other in cost[1:]])
    fits = own_cost < comb.settings.anchor_fit * np.maximum(terms, 1)
    usual_gap = _feature_costs(gap, both, 0.01 * comb.pitch_px)[0] < TERM_LIMIT / 2
    beside = usual_gap | np.hstack([np.zeros((len(gap), 1), bool), usual_gap[:, :-1]])
    return np.asarray((fits & (excess.min(axis=0) > comb.settings.anchor_nats))[:, None] & beside, bool)


def pattern_shift(log_contrast: Floats, log_width: Floats, settings: TrackingSettings = DEFAULT) -> Ints:
    """Return by how many sheets the pattern has shifted along the comb since the first frame, (frame,).

    The pattern is each sheet's brightness and width: log contrast and log width (frame, N), NaN where missing
    or doubtful. An even comb of nearly equal sheets with no end in view looks alike after a jump by one
    pitch, but its pattern jumps. Medians over `pattern_frames` frames before and after each frame are
    compared. At a jump the sheets' change is `pattern_change` times the usual one, and `pattern_ratio` times
    the change relative to another sheet; a change of light does not shift the pattern. 0 for fewer than
    `pattern_sheets` sheets.
    """
    frames, sheets = log_contrast.shape
    span, shift = settings.pattern_frames, np.zeros(frames, np.int64)
    if frames < 4 * span or sheets < settings.pattern_sheets:
        return shift
    features = np.stack([_without_common_change(log_contrast), _without_common_change(log_width)])
    medians = nan_median(np.lib.stride_tricks.sliding_window_view(features, span, axis=1), axis=-1)
    before, after = medians[:, :-span], medians[:, span:]
    own = _feature_change(before, after, 0, settings)
    others = np.stack([_feature_change(before, after, by, settings) for by in SHIFTS])
    own, usual = np.where(own < np.inf, own, 0.0), np.median(own)
    least = others.min(axis=0)
    found = np.flatnonzero((least < own / settings.pattern_ratio) & (own > settings.pattern_change * usual))
    events: list[int] = []
    for frame in found[np.argsort(least[found] / own[found])].tolist():
        if all(abs(frame - other) >= span for other in events):
            events.append(frame)
    for event in events:  # medians date the jump to about two frames; the single frames decide the rest
        first, last = event + span // 2 + 1, event + span + span // 2
        near = features[:, first:last]
        as_before = np.broadcast_to(before[:, [event]], near.shape)
        each = np.stack([_feature_change(as_before, near, by, settings) for by in (0, *SHIFTS)])
        shift[first:last] += np.array((0, *SHIFTS))[each.argmin(axis=0)]
        shift[last:] += SHIFTS[int(np.argmin(others[:, event]))]
    return shift


def sheets_alike(x_px: Floats, contrast: Floats, fwhm_px: Floats, comb: RidgeComb) -> bool:
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
    for pattern in (_without_common_change(np.log(values)) for values in (contrast, fwhm_px)):
        mean = nan_median(pattern)
        within = nan_median(nan_median(np.abs(pattern - mean)))
        alike &= nan_median(np.abs(_bend(mean))) < comb.settings.alike_scatter * within
    return bool(alike)


def _bend(values: Floats) -> Floats:
    """Return values (N,) minus the means of their neighbours, (N − 2,)."""
    return np.asarray(values[1:-1] - (values[2:] + values[:-2]) / 2)


def _feature_change(before: Floats, after: Floats, by: int, settings: TrackingSettings) -> Floats:
    """Return the change of features (kinds, frame, N) relative to those of the sheet `by` further, (frame,).

    Three quarters of the sheets change by no more than this; inf where too few sheets are known.
    """
    step = after - np.stack([shifted(part, by) for part in before])
    size = nan_quantile(np.abs(step - nan_median(step, axis=2)[..., None]), 0.75, axis=2)
    enough = np.isfinite(step).all(axis=0).sum(axis=1) >= settings.pattern_sheets
    return np.where(enough, np.hypot(*size), np.inf)


def _without_common_change(values: Floats) -> Floats:
    """Remove from each frame the change that all sheets share (flicker, focus)."""
    off = values - nan_median(values)
    return np.asarray(values - nan_median(off, axis=1)[:, None])


def _feature_costs(values: Floats, learned: Bools, floor: float) -> list[NDArray[np.float64]]:
    """Return the cost of each value for its own sheet, then for each sheet of SHIFTS; (frame, N), NaN where
    unknown."""
    seen = np.where(learned, values, np.nan)
    middle = nan_median(seen)
    spread = nan_median(np.abs(seen - middle)) / NORMAL_MEDIAN
    spread = np.maximum(spread, floor)
    costs = []
    for shift in (0, *SHIFTS):
        expected = shifted(middle[None], shift)
        # the wider of both scatters, so that a single noisy sheet does not exclude a numbering
        sigma = np.fmax(shifted(spread[None], shift), spread[None])
        limit = np.where(np.isfinite(expected), TERM_LIMIT, np.nan)
        costs.append(np.fmin((values - expected) ** 2 / (2 * sigma**2), limit))
    return [np.where(np.isfinite(values), cost, np.nan) for cost in costs]
