"""Which candidate is which sheet: order-preserving alignment of many candidate lists with a comb, all at
once.

A dynamic programme finds, for each list, the cheapest way to pair candidates with sheets when order never
changes, sheets may be missing and candidates may be no sheet at all. Costs are negative log-likelihoods,
so that a difference of 3 means odds of 20. What speaks for a pairing, in the order of weight: all sheets
and no stranger accounted for (count, edges); spacings that change little between neighbours (a
displacement smooth in n); the brightness of each sheet; and, weakly, staying where it was (still centre)
— weakly because a whole comb may jump by pitches.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]
Ints = NDArray[np.int64]

LISTS_PER_BATCH = 128
BAND = 8  # more sheets than this missing on one side and strangers on the other are not looked for
SPACING_SPREAD = 0.08  # of the pitch: how much one spacing may change without cost
SPACING_KNEE = 1.5  # standard deviations
SPACING_LIMIT = 8.0  # a single sheet may leave its neighbours behind, at this cost
BRIGHTNESS_SPREAD = 0.25  # natural logarithm
BRIGHTNESS_LIMIT = 4.0
STAY_COST = 4.0  # for the whole comb together to have moved by half a pitch or more
MISSING_COST = 6.0
STRANGER_COST = 7.0  # for a candidate as bright as the sheets; fainter ones are cheaper
OUTSIDE_COST = 0.5  # for a sheet missing whose place is outside the picture
CROSSING_COST = (
    2.0  # for one that the comb's own displacement takes there, or one not known yet that comes in
)
MOST_CROSSING = 3  # sheets that cross an edge of the picture in one displacement
EDGE_REACH = 1.5  # pitches between the comb's end and the picture's: nearer, more sheets may be outside
# steps (sheets, candidates) from one pair to the next: neighbours, missing sheets, strangers, some of both
STEPS = (
    (1, 1),
    *((a, 1) for a in range(2, 9)),
    *((1, b) for b in range(2, 5)),
    (2, 2),
    (2, 3),
    (3, 2),
    (3, 3),
)


@dataclass(frozen=True)
class Reference:
    """The comb that candidates are aligned with.

    x_px: expected positions, (lists, N).  log_contrast: (N,).  missing_cost: (N,), small for sheets often
    unseen. pitch_px: typical spacing.  width_px: of the picture, sheets expected outside it are missing
    for nothing.  open_ended: whether there may be more sheets beyond the first and the last.
    """

    x_px: Doubles
    log_contrast: Doubles
    missing_cost: Doubles
    pitch_px: float
    width_px: tuple[float, float]
    open_ended: bool = True

    def mirrored(self) -> Reference:
        """The comb with left and right exchanged."""
        low, high = self.width_px
        return Reference(
            -self.x_px[:, ::-1],
            self.log_contrast[::-1],
            self.missing_cost[::-1],
            self.pitch_px,
            (-high, -low),
            self.open_ended,
        )


@dataclass(frozen=True)
class Candidates:
    """Candidate lists: x_px, log_contrast and log_width, (lists, K), each row ascending in x, padded with
    NaN."""

    x_px: Doubles
    log_contrast: Doubles
    log_width: Doubles

    def take(self, rows: Ints) -> Candidates:
        """Some of the lists."""
        return Candidates(self.x_px[rows], self.log_contrast[rows], self.log_width[rows])

    def first(self, count: int) -> Candidates:
        """The first places of every list."""
        return Candidates(self.x_px[:, :count], self.log_contrast[:, :count], self.log_width[:, :count])


@dataclass(frozen=True)
class Alignment:
    """match: candidate of each sheet, −1 where missing, (lists, N).  margin: how much dearer the cheapest
    alignment is
    that pairs this sheet or this candidate otherwise, nats, inf where there is none, NaN where missing,
    (lists, N).
    """

    match: Ints
    margin: Doubles


def align(candidates: Candidates, reference: Reference) -> Alignment:
    """Cheapest order-preserving pairing of each candidate list with the sheets, and how sure it is.

    Lists are independent of each other; all work is vectorised over them. Source: Needleman & Wunsch
    1970, with the spacing to the previous pair as the cost of a step; margins from the forward and
    backward passes together.
    """
    count = np.isfinite(candidates.x_px).sum(axis=1)
    order = np.argsort(count, kind="stable")  # lists of like length share a narrow band
    batches = [order[i : i + LISTS_PER_BATCH] for i in range(0, len(order), LISTS_PER_BATCH)]
    match = np.full(reference.x_px.shape, -1, np.int64)
    margin = np.full(reference.x_px.shape, np.nan)
    with ThreadPoolExecutor(2) as pool:
        done = pool.map(lambda rows: _align_batch(candidates.take(rows), _take(reference, rows)), batches)
        for rows, part in zip(batches, done, strict=True):
            match[rows], margin[rows] = part.match, part.margin
    return Alignment(match, margin)


def _take(reference: Reference, rows: Ints) -> Reference:
    return Reference(
        reference.x_px[rows],
        reference.log_contrast,
        reference.missing_cost,
        reference.pitch_px,
        reference.width_px,
        reference.open_ended,
    )


def _align_batch(candidates: Candidates, reference: Reference) -> Alignment:
    longest = max(1, int(np.isfinite(candidates.x_px).sum(axis=1).max(initial=1)))
    candidates = candidates.first(longest)
    pair, missing, stranger = _pair_costs(candidates, reference)
    left = _outside(candidates.x_px, reference, missing, stranger)
    right = _outside(-candidates.x_px[:, ::-1], reference.mirrored(), missing[:, ::-1], stranger[:, ::-1])[
        ::-1, :, ::-1
    ]
    forward, origin = _pass(pair, left, candidates.x_px, reference.x_px, reference.pitch_px)
    turned = (pair[::-1, :, ::-1], right[::-1, :, ::-1])  # seen in a mirror
    mirrored_x = -candidates.x_px[:, ::-1], -reference.x_px[:, ::-1]
    backward = _pass(*turned, *mirrored_x, reference.pitch_px)[0][::-1, :, ::-1]
    real = np.isfinite(pair)
    through = np.where(
        real, forward + backward - np.where(real, pair, 0.0), np.inf
    )  # best alignment with this pair
    match = _trace(forward + right, origin)
    return Alignment(match, _margins(through, match))


def _pair_costs(candidates: Candidates, reference: Reference) -> tuple[Doubles, Doubles, Doubles]:
    """Cost of pairing, less that of leaving sheet and candidate alone, (N, lists, K), inf where there is no
    candidate; and these two, (lists, N) and (lists, K)."""
    sheets, pitch = reference.x_px.shape[1], reference.pitch_px
    brightness = candidates.log_contrast - _typical_difference(candidates, reference)[:, None]
    off = brightness[None] - reference.log_contrast[:, None, None]
    cost = np.minimum(off**2 / (2 * BRIGHTNESS_SPREAD**2), BRIGHTNESS_LIMIT)
    moved = (candidates.x_px[None] - reference.x_px.T[:, :, None]) / (0.5 * pitch)
    cost += STAY_COST / sheets * np.minimum(moved**2, 1.0)
    faint = np.exp(brightness - np.median(reference.log_contrast)) / 0.5
    stranger = STRANGER_COST * np.clip(faint, 0.3, 1.0)
    low, high = reference.width_px
    inside = (reference.x_px > low) & (reference.x_px < high)
    missing = np.where(inside, reference.missing_cost, OUTSIDE_COST)
    cost -= stranger[None] + missing.T[:, :, None]
    return np.where(np.isfinite(cost), cost, np.inf), missing, stranger


def _outside(x: Doubles, reference: Reference, missing: Doubles, stranger: Doubles) -> Doubles:
    """What an alignment that begins with each pair is spared, (N, lists, K), zero or less.

    Sheets further to the left that are then expected outside the picture are missing for little, and where
    the comb may go on beyond its first sheet, candidates to the left of that are sheets not known yet.
    """
    sheet_x, low = reference.x_px, reference.width_px[0]
    spared = np.maximum(missing - CROSSING_COST, 0)[:, :MOST_CROSSING]
    spared = np.pad(np.cumsum(spared, axis=1), ((0, 0), (1, 0)))
    rows, most = np.arange(len(x))[:, None], spared.shape[1] - 1
    out = np.zeros((sheet_x.shape[1], *x.shape))
    for n in range(min(2 * BAND, sheet_x.shape[1])):
        moved = np.nan_to_num(x) - sheet_x[:, n, None]
        gone = (sheet_x[:, None, : min(n, most)] + moved[:, :, None] < low).sum(axis=2)
        out[n] = -spared[rows, gone]
    if reference.open_ended:
        goes_on = sheet_x[:, 0] < low + EDGE_REACH * reference.pitch_px
        unknown = np.maximum(np.nan_to_num(stranger) - CROSSING_COST, 0)[:, :MOST_CROSSING].cumsum(axis=1)
        out[0, :, 1 : MOST_CROSSING + 1] -= np.where(goes_on[:, None], unknown, 0.0)[:, : x.shape[1] - 1]
    return out


def _typical_difference(candidates: Candidates, reference: Reference) -> Doubles:
    """Flicker: how much brighter, in logarithm, each list is than the reference, (lists,)."""
    count = np.isfinite(candidates.log_contrast).sum(axis=1)
    place = np.maximum(0, (0.6 * (count - 1)).astype(np.int64))
    upper = np.take_along_axis(np.sort(candidates.log_contrast, axis=1), place[:, None], axis=1)[:, 0]
    return np.asarray(np.nan_to_num(upper - np.quantile(reference.log_contrast, 0.6)), np.float64)


def _pass(
    pair: Doubles, first_pair: Doubles, x: Doubles, sheet_x: Doubles, pitch: float
) -> tuple[Doubles, NDArray[np.int8]]:
    """Cost of the best alignment ending with each pair, (N, lists, K), and the step it came by (−1: its
    first); first_pair, cost of beginning with each."""
    best = np.full_like(pair, np.inf)
    origin = np.full(pair.shape, -1, np.int8)
    for n, (low, high) in enumerate(_band(pair)):
        row = np.array(first_pair[n, :, low:high])
        step = np.full(row.shape, -1, np.int8)
        for code, (a, b) in enumerate(STEPS):
            first = max(low, b)  # the pair before has a candidate, too
            if a > n or first >= high:
                continue
            change = x[:, first:high] - x[:, first - b : high - b]
            change -= (sheet_x[:, n] - sheet_x[:, n - a])[:, None]
            total = _spacing_cost(change, SPACING_SPREAD * pitch * np.sqrt(a))
            total += best[n - a][:, first - b : high - b]
            better = total < row[:, first - low :]
            np.copyto(row[:, first - low :], total, where=better)
            np.copyto(step[:, first - low :], np.int8(code), where=better)
        best[n, :, low:high] = row + pair[n, :, low:high]
        origin[n, :, low:high] = step
    return best, origin


def _band(pair: Doubles) -> Iterator[tuple[int, int]]:
    """Candidates worth a look for each sheet: as many to the left of it as there are sheets, give or take
    BAND."""
    sheets, _, count = pair.shape
    least = int(np.isfinite(pair[0]).sum(axis=1).min())
    low, high = min(0, least - sheets) - BAND, max(count - least, count - sheets) + BAND
    for n in range(sheets):
        first = min(max(0, n + low), count - 1)
        yield first, max(first + 1, min(count, n + high + 1))


def _spacing_cost(change: Doubles, spread: float | np.floating) -> Doubles:
    """Quadratic for small changes of a spacing, then linear, then constant (Huber, capped); a NaN ends there
    too."""
    size = np.abs(change)
    size /= spread
    near = np.minimum(size, SPACING_KNEE)
    cost = near * (size - 0.5 * near)  # Huber's: size²/2, then a straight line
    return np.fmin(cost, SPACING_LIMIT)


def _trace(forward: Doubles, origin: NDArray[np.int8]) -> Ints:
    """Candidate of each sheet in the best alignment of each list, −1 where missing, (lists, N)."""
    sheets, lists, count = forward.shape
    match = np.full((lists, sheets), -1, np.int64)
    flat = np.moveaxis(forward, 1, 0).reshape(lists, -1)
    n, k = np.divmod(np.argmin(flat, axis=1), count)
    alive = flat.min(axis=1) < 0
    steps = np.array(STEPS)
    rows = np.arange(lists)
    for _ in range(sheets):
        match[rows[alive], n[alive]] = k[alive]
        code = origin[n, rows, k]
        alive &= code >= 0
        n, k = np.where(alive, n - steps[code, 0], n), np.where(alive, k - steps[code, 1], k)
    return match


def _margins(through: Doubles, match: Ints) -> Doubles:
    """Cost of the best alignment that pairs the sheet, or its candidate, otherwise, less that of the best of
    all."""
    sheets, lists, _ = through.shape
    list_, sheet = np.nonzero(match >= 0)
    candidate = match[list_, sheet]
    others = np.array(through)
    others[sheet, list_, candidate] = np.inf
    rival = np.minimum(others.min(axis=2)[sheet, list_], others.min(axis=0)[list_, candidate])
    margin = np.full((lists, sheets), np.nan)
    margin[list_, sheet] = rival - np.minimum(through.min(axis=(0, 2)), 0)[list_]
    return margin
