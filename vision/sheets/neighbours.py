"""Identities held against the sheets around, and against the comb's own pattern.

The alignment decides which ridge is which sheet; what it decided is tested here with what it did not use.
`neighbour_residual` says how far each sheet leaves what its neighbours say; `hops` finds sheets that have
gone over to another ridge, `anchored` the frames in which spacings, brightnesses and widths fit one
numbering only, so that an earlier doubt ends, and `pattern_moved` where brightnesses and widths go on under
another numbering.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from vision.numeric import NORMAL_MEDIAN, Bools, Floats, Ints, nan_median, nan_quantile, shifted
from vision.sheets.ridges import RidgeComb
from vision.sheets.settings import DEFAULT, TrackingSettings

PAIRS = 3  # neighbours on either side that a sheet is compared with
SHIFTS = (-2, -1, 1, 2)  # other numberings that the pattern must exclude
PATTERN_FRAMES = 5  # compared before and after a jump
LEAST_PATTERN = 8  # sheets: fewer are alike by chance
TERM_LIMIT = 4.0  # nats: no single spacing, brightness or width decides a numbering


def neighbour_residual(x_px: Floats) -> Floats:
    r"""How far each sheet stands from where the sheets around it say, px, (frame, N).

    Parameters
    ----------
    x_px
        Positions (frame, N), NaN where missing.

    Returns
    -------
    Less each sheet's own median; NaN where it or all its neighbours are missing, and for fewer than three
    sheets.

    Notes
    -----
    With the displacement :math:`u_n` from the median position, the neighbours say

    .. math:: \hat u_n = \operatorname{median}_{k \le 3}
              \frac{u_{n-k}\,d_{n+k} + u_{n+k}\,d_{n-k}}{d_{n-k} + d_{n+k}},

    d being distances at rest: linear in n between each pair, whatever the mechanics. Towards the ends of the
    comb, where pairs are lacking, lines through two sheets on one side take their place. A median over the
    pairs, so that one wrong neighbour does not mislead.
    """
    return np.asarray(x_px - said_by_neighbours(x_px), np.float64)


def said_by_neighbours(x_px: Floats) -> Floats:
    """Where the sheets around say that each sheet stands, px, (frame, N), whether it is seen there or not.

    NaN as in `neighbour_residual`.
    """
    sheets = x_px.shape[1]
    if sheets < 3:
        return np.full(x_px.shape, np.nan)
    place = places_in_comb(x_px)
    moved = x_px - place
    first, second, third = pairs = [_between(moved, place, k) for k in range(1, PAIRS + 1)]
    low, high = np.minimum(first, second), np.maximum(first, second)
    said = np.maximum(low, np.minimum(high, third))  # their median; NaN where one is missing
    lacking = np.isnan(said)
    said[lacking] = _said_by_fewer(moved, np.stack([pair[lacking] for pair in pairs]), *np.nonzero(lacking))
    return np.asarray(place + said + nan_median(moved - said), np.float64)


def _said_by_fewer(moved: Floats, pairs: Floats, frame: Ints, sheet: Ints) -> Floats:
    """Displacement said by what there is of the three pairs (3, points); where that is less than two, as
    towards the ends, by lines through two sheets on one side, too: one wrong sheet is never in the majority.
    """
    few = np.isfinite(pairs).sum(axis=0) < 2
    frame, sheet = frame[few], sheet[few]
    two = ((1, 2), (1, 3), (2, 3), (2, 4), (3, 4))
    furthest = max(max(pair) for pair in two)
    padded = np.pad(moved, ((0, 0), (furthest, furthest)), constant_values=np.nan)
    lines = np.full((2 * len(two), len(few)), np.nan)
    for line, (step, (near, far)) in zip(lines, product((1, -1), two), strict=True):
        close, remote = (padded[frame, sheet + furthest + step * k] for k in (near, far))
        line[few] = close + (close - remote) * near / (far - near)
    return nan_median(np.concatenate([pairs, lines]))


def places_in_comb(x_px: Floats) -> Floats:
    """Each sheet's median position less the comb's motion, (N,).

    Right for sheets, too, that were in view only while the comb stood aside.
    """
    place = nan_median(x_px)
    for _ in range(3):
        place = nan_median(x_px - nan_median(x_px - place, axis=1)[:, None])
    return place


def _between(moved: Floats, place: Floats, k: int) -> Floats:
    """Displacement said by the k-th neighbours, linear between them; NaN where one of both is missing."""
    said = np.full_like(moved, np.nan)
    if moved.shape[1] <= 2 * k:
        return said
    to_left, to_right = place[k:-k] - place[: -2 * k], place[2 * k :] - place[k:-k]
    apart = to_left + to_right
    apart = np.where(apart > 0, apart, np.nan)  # two sheets in one place say nothing
    said[:, k:-k] = (moved[:, : -2 * k] * to_right + moved[:, 2 * k :] * to_left) / apart
    return said


def torn(moved: Floats, comb: RidgeComb, settings: TrackingSettings = DEFAULT) -> Bools:
    """Sheets displaced from rest very differently from their neighbours in the same frame, (frame, N).

    A slip moves neighbours alike, however far; where neighbours differ by more than `tear_fraction` pitches,
    one of the identities is wrong. Such tears cut the sheets of a frame into groups, and all but the largest
    group are doubtful.
    """
    frames, sheets = moved.shape
    seen = np.isfinite(moved)
    before = np.hstack([np.full((frames, 1), np.nan), last_seen(moved)[:, :-1]])
    group = np.cumsum(np.abs(moved - before) > settings.tear_fraction * comb.pitch_px, axis=1)
    key = (group + sheets * np.arange(frames)[:, None])[seen]
    size = np.bincount(key, minlength=frames * sheets).reshape(frames, sheets)
    own = np.take_along_axis(size, group, axis=1)
    return np.asarray(seen & (own < size.max(axis=1, keepdims=True)), bool)


def last_seen(values: Floats) -> Floats:
    """NaN replaced by the last value before it in the row."""
    number = np.where(np.isfinite(values), np.arange(values.shape[1]), 0)
    return np.asarray(np.take_along_axis(values, np.maximum.accumulate(number, axis=1), axis=1), np.float64)


def hops(residual: Floats, comb: RidgeComb, settings: TrackingSettings = DEFAULT) -> Bools:
    """Sheets that left what their neighbours say, (frame, N): they stand on another ridge.

    By several times the sheet's own scatter, by more than a ridge's width (two ridges are not resolved nearer
    than that), and by far more than most sheets of the frame, since in an avalanche or in a blurred frame
    many leave at once. Of sheets side by side only the one that leaves most is named: it misleads the others.
    """
    size = np.abs(residual)
    own = settings.leave_sigmas * nan_median(size) / NORMAL_MEDIAN
    found = np.asarray(size > np.fmax(own, comb.fwhm_px), bool)
    rows = np.flatnonzero(found.any(axis=1))  # in most films none
    some = size[rows]
    padded = np.pad(some, ((0, 0), (PAIRS, PAIRS)), constant_values=np.nan)
    around = [padded[:, i : i + size.shape[1]] for i in range(2 * PAIRS + 1)]
    found[rows] &= (some > 3.0 * nan_quantile(some, 0.75, axis=1)[:, None]) & (some >= np.fmax.reduce(around))
    return found


def anchored(
    x_px: Floats,
    log_contrast: Floats,
    log_width: Floats,
    trusted: Bools,
    comb: RidgeComb,
    settings: TrackingSettings = DEFAULT,
) -> Bools:
    """Sheets in frames whose pattern of spacings, brightnesses and widths fits this numbering only.

    Parameters
    ----------
    x_px, log_contrast, log_width
        Of the ridge paired with each sheet (frame, N), NaN where none.
    trusted
        Identities from which the pattern is learned (frame, N).
    comb
        Pitch of the ridges.
    settings
        `anchor_fit`, `anchor_nats`.

    Returns
    -------
    (frame, N). False where fewer than a tenth of the frames are trusted, and for sheets that stand beside no
    neighbour at their usual spacing: the rest of the frame says nothing about these.

    Notes
    -----
    Every feature's median and scatter are measured over the trusted frames. The cost of a numbering is the
    sum of squares over twice the variance, each at most `TERM_LIMIT`; a frame is anchored where every
    numbering shifted by one or two sheets costs `anchor_nats` more. An even comb of equal sheets is never
    anchored.
    """
    if x_px.shape[1] < 3 or trusted.any(axis=1).mean() < 0.1:
        return np.zeros(x_px.shape, bool)
    gap = np.diff(x_px, axis=1, append=np.nan)
    both = trusted & np.hstack([trusted[:, 1:], np.zeros((len(trusted), 1), bool)])
    features = (
        (gap, both, 0.01 * comb.pitch_px),
        (_less_common(log_contrast), trusted, 0.05),
        (_less_common(log_width), trusted, 0.05),
    )
    own = np.zeros(len(x_px))
    terms = np.zeros(len(x_px))
    excess = np.zeros((len(SHIFTS), len(x_px)))
    for values, learned, floor in features:
        cost = _feature_costs(values, learned, floor)
        own += np.nansum(cost[0], axis=1)
        terms += np.isfinite(cost[0]).sum(axis=1)
        # only what both numberings explain
        excess += np.stack([np.nansum(shifted - cost[0], axis=1) for shifted in cost[1:]])
    fits = own < settings.anchor_fit * np.maximum(terms, 1)
    spacing = _feature_costs(gap, both, 0.01 * comb.pitch_px)[0] < TERM_LIMIT / 2
    beside = spacing | np.hstack([np.zeros((len(gap), 1), bool), spacing[:, :-1]])
    return np.asarray((fits & (excess.min(axis=0) > settings.anchor_nats))[:, None] & beside, bool)


def pattern_moved(log_contrast: Floats, log_width: Floats) -> Ints:
    """By how many sheets the pattern of looks has moved along the comb since the first frame, (frame,).

    Parameters
    ----------
    log_contrast, log_width
        Of the ridge paired with each sheet (frame, N), NaN where none, or one that is doubted.

    Notes
    -----
    An even comb of nearly equal sheets with no end in view looks the same after a jump by its pitch, but
    small differences in brightness and width jump, too. From five frames to the next five they change by
    several times what is usual, and less than a third as much against those of another sheet: light that
    changes does not do that. None for fewer than eight sheets.
    """
    frames, sheets = log_contrast.shape
    moved = np.zeros(frames, np.int64)
    if frames < 4 * PATTERN_FRAMES or sheets < LEAST_PATTERN:
        return moved
    looks = np.stack([_less_common(log_contrast), _less_common(log_width)])
    means = nan_median(np.lib.stride_tricks.sliding_window_view(looks, PATTERN_FRAMES, axis=1), axis=-1)
    before, after = means[:, :-PATTERN_FRAMES], means[:, PATTERN_FRAMES:]
    own, others = _unlikeness(before, after, 0), np.stack([_unlikeness(before, after, by) for by in SHIFTS])
    own, usual = np.where(own < np.inf, own, 0.0), np.median(own)
    found = np.flatnonzero((others.min(axis=0) < own / 3) & (own > 3 * usual))
    events: list[int] = []
    for frame in found[np.argsort(others.min(axis=0)[found] / own[found])].tolist():
        if all(abs(frame - other) >= PATTERN_FRAMES for other in events):
            events.append(frame)
    for best in events:  # the medians tell to two frames when, each frame's own looks the rest
        first, last = best + PATTERN_FRAMES // 2 + 1, best + PATTERN_FRAMES + PATTERN_FRAMES // 2
        near = looks[:, first:last]
        as_before = np.broadcast_to(before[:, [best]], near.shape)
        each = np.stack([_unlikeness(as_before, near, by) for by in (0, *SHIFTS)])
        moved[first:last] += np.array((0, *SHIFTS))[each.argmin(axis=0)]
        moved[last:] += SHIFTS[int(np.argmin(others[:, best]))]
    return moved


def _unlikeness(before: Floats, after: Floats, by: int) -> Floats:
    """Change of looks (kinds, frame, N) against those of the sheet `by` further that most sheets keep to,
    (frame,); inf where that leaves too few sheets."""
    step = after - np.stack([shifted(part, by) for part in before])
    size = nan_quantile(np.abs(step - nan_median(step, axis=2)[..., None]), 0.75, axis=2)
    enough = np.isfinite(step).all(axis=0).sum(axis=1) >= LEAST_PATTERN
    return np.where(enough, np.hypot(*size), np.inf)


def _less_common(values: Floats) -> Floats:
    """Less the median over the sheets of each frame, about each sheet's own: flicker and focus."""
    off = values - nan_median(values)
    return np.asarray(values - nan_median(off, axis=1)[:, None])


def _feature_costs(values: Floats, learned: Bools, floor: float) -> list[NDArray[np.float64]]:
    """Cost of each value in its own place, then in those of SHIFTS, (frame, N), NaN where unknown."""
    seen = np.where(learned, values, np.nan)
    middle = nan_median(seen)
    spread = nan_median(np.abs(seen - middle)) / NORMAL_MEDIAN
    spread = np.maximum(spread, floor)
    out = []
    for shift in (0, *SHIFTS):
        place, sigma = shifted(middle[None], shift), shifted(spread[None], shift)
        # the wider of both scatters, so that a noisy sheet does not exclude a numbering by itself
        sigma = np.fmax(sigma, spread[None])
        out.append(
            np.fmin((values - place) ** 2 / (2 * sigma**2), np.where(np.isfinite(place), TERM_LIMIT, np.nan))
        )
    return [np.where(np.isfinite(values), cost, np.nan) for cost in out]
