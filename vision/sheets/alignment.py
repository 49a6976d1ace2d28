"""Order-preserving alignment of candidate lists with the comb: which candidate is which sheet.

A dynamic programme finds, for each list, the cheapest pairing of candidates with sheets. The order never
changes, sheets may be missing, and candidates may be false detections. Costs are negative log-likelihoods in
nats, so that a difference of 3 means odds of 20. The terms, in the order of weight, are: sheets and
candidates that stay unpaired; changes of spacings (displacements are smooth in n); changes of each sheet's
brightness; and, weakly, displacements, since a whole comb may jump by pitches.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from vision.memory import in_two_threads, row_parts, table_beside
from vision.numeric import Floats, Ints, Ints32, Rows
from vision.sheets.settings import DEFAULT, TrackingSettings

Real = TypeVar("Real", bound=np.floating)
BAND = 8  # largest number of missing sheets or false detections on one side of a pair
MOST_CROSSING = 3  # largest number of sheets that cross an edge of the picture in one displacement


@dataclass(frozen=True)
class ExpectedSheets:
    """The comb with which candidates are aligned.

    x_px: expected positions, (lists, N). log_contrast: logarithm of each sheet's contrast, (N,).
    missing_cost: cost of not finding a sheet, (N,), nats; small for sheets that are often unseen. pitch_px:
    typical spacing. view_px: left and right end of the picture; sheets expected outside it are missing at
    hardly any cost. open_ends: whether there may be more sheets beyond the first and beyond the last.
    settings: costs.
    """

    x_px: Floats
    log_contrast: Floats
    missing_cost: Floats
    pitch_px: float
    view_px: tuple[float, float]
    open_ends: tuple[bool, bool] = (False, False)
    settings: TrackingSettings = DEFAULT

    def mirrored(self) -> ExpectedSheets:
        """Return the comb with left and right exchanged."""
        low, high = self.view_px
        return replace(
            self,
            x_px=-self.x_px[:, ::-1],
            log_contrast=self.log_contrast[::-1],
            missing_cost=self.missing_cost[::-1],
            view_px=(-high, -low),
            open_ends=self.open_ends[::-1],
        )


@dataclass(frozen=True)
class Candidates(Rows):
    """Candidate lists, (lists, K), each row ascending in x and padded with NaN: positions, and logarithms of
    contrast and width.
    """

    x_px: Floats
    log_contrast: Floats
    log_width: Floats

    def first(self, count: int) -> Candidates:
        """Return the first entries of every list."""
        return Candidates(self.x_px[:, :count], self.log_contrast[:, :count], self.log_width[:, :count])


@dataclass(frozen=True)
class Pairing:
    """Result of an alignment, both (lists, N).

    match: candidate of each sheet, −1 where missing. margin: extra cost, nats, of the cheapest alignment that
    pairs this sheet or this candidate otherwise; inf where there is none, NaN where the sheet is missing.
    """

    match: Ints
    margin: Floats


def values_of(match: Ints | Ints32, values: NDArray[Real]) -> NDArray[Real]:
    """Return the values (lists, K) of the candidate of each sheet, NaN where missing, (lists, N)."""
    found = table_beside(values, match.shape, values.dtype, "F")

    def take(rows: slice) -> None:
        paired = np.take_along_axis(values[rows], np.maximum(match[rows], 0), axis=1)
        found[rows] = np.where(match[rows] >= 0, paired, np.nan)

    in_two_threads(take, row_parts(len(match)))
    return found


def align(candidates: Candidates, expected: ExpectedSheets, *, margins: bool = True) -> Pairing:
    r"""Find the cheapest order-preserving pairing of each candidate list with the sheets, and its margins.

    The lists are independent of each other; there is one row of expected positions for each. Margins take
    half of the time; without them they are NaN.

    With the cost :math:`p_{nk}` of pairing sheet n with candidate k (less the cost of leaving both unpaired),
    the cheapest alignment that ends with this pair costs

    .. math:: C_{nk} = p_{nk} + \min\Big(f_{nk},\ \min_{a,b}\ C_{n-a,\,k-b}
              + s(\Delta x_k - \Delta \hat x_n;\ a) - g_{n-a,\,n}\Big),

    where s is the cost of a changed spacing, f the cost of an alignment that begins here, and g the discount
    for adjacent missing sheets. One of these costs as much as a single missing sheet, the others
    `covered_cost` (Gotoh 1982), since an object that covers one sheet also covers those beside it. Margins
    follow from the forward and the backward pass together. Source: Needleman & Wunsch 1970, with the spacing
    to the previous pair as the cost of a step.
    """
    count = np.isfinite(candidates.x_px).sum(axis=1)
    order = np.argsort(count, kind="stable")  # lists of like length share a narrow band
    batches = [order[i : i + 128] for i in range(0, len(order), 128)]
    match = np.full(expected.x_px.shape, -1, np.int64)
    margin = np.full(expected.x_px.shape, np.nan)

    def run(rows: Ints) -> Pairing:
        return _align_batch(candidates.take(rows), replace(expected, x_px=expected.x_px[rows]), margins)

    for rows, part in zip(batches, in_two_threads(run, batches), strict=True):
        match[rows], margin[rows] = part.match, part.margin
    return Pairing(match, margin)


def _align_batch(candidates: Candidates, expected: ExpectedSheets, margins: bool) -> Pairing:
    """Align lists of similar length."""
    longest = max(1, int(np.isfinite(candidates.x_px).sum(axis=1).max(initial=1)))
    candidates = candidates.first(longest)
    pair, missing, false_detection = _pair_costs(candidates, expected)
    further = _adjacent_discount(missing, expected)
    left = _outside(candidates.x_px, expected, missing, false_detection)
    mirrored_x = -candidates.x_px[:, ::-1]
    right = _outside(mirrored_x, expected.mirrored(), missing[:, ::-1], false_detection[:, ::-1])
    right = right[::-1, :, ::-1]
    fewest = int(np.isfinite(candidates.x_px).sum(axis=1).min())
    steps = steps_between(expected.x_px.shape[1] - fewest)
    forward, origin = _pass(pair, left, candidates.x_px, expected, further, steps)
    match = _trace(forward + right, origin, steps)
    if not margins:
        return Pairing(match, np.full(match.shape, np.nan))
    backward, _ = _pass(
        pair[::-1, :, ::-1], right[::-1, :, ::-1], mirrored_x, expected.mirrored(), further[:, ::-1], steps
    )
    backward = backward[::-1, :, ::-1]
    real = np.isfinite(pair)
    # cost of the best alignment that has this pair
    through = np.where(real, forward + backward - np.where(real, pair, 0.0), np.inf)
    return Pairing(match, _margins(through, match))


def steps_between(missing: int) -> list[tuple[int, int]]:
    """Return the steps (sheets, candidates) from one pair to the next.

    They lead to the neighbour, over missing sheets, over false detections, or over some of both. Longer steps
    are added where so many sheets are missing that an object may cover adjacent ones; without them, the comb
    on both sides of the object would be taken for two combs. The number of steps fits into int8.
    """
    short = [(a, 1) for a in range(1, 9)] + [(1, b) for b in range(2, 5)]
    both = [(a, b) for a in (2, 3) for b in (2, 3)]
    return short + both + [(a, b) for a in range(9, min(missing + 3, 40)) for b in (1, 2, 3)]


def _pair_costs(candidates: Candidates, expected: ExpectedSheets) -> tuple[Floats, Floats, Floats]:
    """Return the cost of each pair less that of leaving both unpaired, (N, lists, K), inf without candidate;
    the cost of a missing sheet, (lists, N); and that of a false detection, (lists, K)."""
    sheets, pitch, costs = expected.x_px.shape[1], expected.pitch_px, expected.settings
    brightness = candidates.log_contrast - _flicker(candidates, expected)[:, None]
    off = brightness[None] - expected.log_contrast[:, None, None]
    # limited: a sheet may change its brightness at this cost
    cost = np.minimum(off**2 / (2 * costs.brightness_spread**2), 4.0)
    moved = np.abs(candidates.x_px[None] - expected.x_px.T[:, :, None]) / (0.5 * pitch)
    cost += costs.stay_cost / sheets * (np.minimum(moved**2, 1.0) + np.maximum(moved / 4 - 0.5, 0.0))
    relative = np.exp(brightness - np.median(expected.log_contrast)) / 0.5
    false_detection = costs.false_detection_cost * np.clip(relative, 0.3, 1.0)
    low, high = expected.view_px
    inside = (expected.x_px > low) & (expected.x_px < high)
    missing = np.where(inside, expected.missing_cost, 0.5)
    cost -= false_detection[None] + missing.T[:, :, None]
    return np.where(np.isfinite(cost), cost, np.inf), missing, false_detection


def _outside(x: Floats, expected: ExpectedSheets, missing: Floats, false_detection: Floats) -> Floats:
    """Return the discount for an alignment that begins with each pair, (N, lists, K), zero or less. Sheets
    further to the left that are then expected outside the picture are missing at little cost. If there may be
    more sheets beyond the first, candidates to its left are sheets not yet known."""
    sheet_x, low, crossing = expected.x_px, expected.view_px[0], expected.settings.crossing_cost
    saved = np.maximum(missing - crossing, 0)[:, :MOST_CROSSING]
    saved = np.pad(np.cumsum(saved, axis=1), ((0, 0), (1, 0)))
    rows, most = np.arange(len(x))[:, None], saved.shape[1] - 1
    out = np.zeros((sheet_x.shape[1], *x.shape))
    covered = np.pad(np.cumsum(_adjacent_discount(missing, expected), axis=1), ((0, 0), (1, 0)))
    for n in range(sheet_x.shape[1]):
        out[n] = -_but_one(covered[:, n, None], n)
        if n < 2 * BAND:
            moved = np.nan_to_num(x) - sheet_x[:, n, None]
            gone = (sheet_x[:, None, : min(n, most)] + moved[:, :, None] < low).sum(axis=2)
            out[n] = np.minimum(out[n], -saved[rows, gone])
    if expected.open_ends[0]:
        unknown = np.maximum(np.nan_to_num(false_detection) - crossing, 0)[:, :MOST_CROSSING].cumsum(axis=1)
        out[0, :, 1 : MOST_CROSSING + 1] -= unknown[:, : x.shape[1] - 1]
    return out


def _adjacent_discount(missing: Floats, expected: ExpectedSheets) -> Floats:
    """Return the discount for each sheet that is missing beside another missing one, (lists, N)."""
    return np.maximum(missing - expected.settings.covered_cost, 0.0)


def _but_one(discount: Floats, count: int | Ints) -> Floats:
    """Return the total discount of `count` adjacent missing sheets without that of one, on average."""
    return discount * np.maximum(count - 1, 0) / np.maximum(count, 1)


def _flicker(candidates: Candidates, expected: ExpectedSheets) -> Floats:
    """Return the log brightness of each list relative to the comb, (lists,)."""
    count = np.isfinite(candidates.log_contrast).sum(axis=1)
    rank = np.maximum(0, (0.6 * (count - 1)).astype(np.int64))
    upper = np.take_along_axis(np.sort(candidates.log_contrast, axis=1), rank[:, None], axis=1)[:, 0]
    return np.asarray(np.nan_to_num(upper - np.quantile(expected.log_contrast, 0.6)), np.float64)


def _pass(
    pair: Floats,
    first_pair: Floats,
    x: Floats,
    expected: ExpectedSheets,
    further: Floats,
    steps: list[tuple[int, int]],
) -> tuple[Floats, NDArray[np.int8]]:
    """Return the cost of the best alignment that ends with each pair, (N, lists, K), and the number of its
    last step, −1 for a first pair.

    first_pair: cost of beginning with each pair. further: discount for adjacent missing sheets, (lists, N).
    """
    best = np.full_like(pair, np.inf)
    origin = np.full(pair.shape, -1, np.int8)
    missed = np.pad(np.cumsum(further, axis=1), ((0, 0), (1, 0))).T
    sheet_x = expected.x_px.T
    over, along = np.array(steps).T
    for n, (low, high) in enumerate(_band(pair)):
        totals = np.full((len(steps), len(x), high - low), np.inf)
        for b in range(1, along.max() + 1):
            first = max(low, b)  # the pair before has a candidate, too
            codes = np.flatnonzero((along == b) & (over <= n))
            if not codes.size or first >= high:
                continue
            a = over[codes]
            change = x[:, first:high] - x[:, first - b : high - b] - (sheet_x[n] - sheet_x[n - a])[..., None]
            total = _spacing_cost(change, expected, a[:, None, None])
            total += best[n - a, :, first - b : high - b]
            total -= _but_one(missed[n] - missed[n - a + 1], a[:, None] - 1)[..., None]
            totals[codes, :, first - low :] = total
        begun, cheapest = first_pair[n, :, low:high], totals.min(axis=0)
        best[n, :, low:high] = np.minimum(begun, cheapest) + pair[n, :, low:high]
        origin[n, :, low:high] = np.where(cheapest < begun, totals.argmin(axis=0), -1)
    return best, origin


def _band(pair: Floats) -> Iterator[tuple[int, int]]:
    """Yield the range of candidates for each sheet: its own index, give or take BAND."""
    sheets, _, count = pair.shape
    least = int(np.isfinite(pair[0]).sum(axis=1).min())
    low, high = min(0, least - sheets) - BAND, max(count - least, count - sheets) + BAND
    for n in range(sheets):
        first = min(max(0, n + low), count - 1)
        yield first, max(first + 1, min(count, n + high + 1))


def _spacing_cost(change_px: Floats, expected: ExpectedSheets, spacings: Ints) -> Floats:
    """Return Huber's function of the change of a spacing (knee at 1.5 spreads), capped; NaN costs the cap.
    Beyond a tear it grows again: sheets may part, but no part of the comb moves to other sheets'
    positions."""
    costs = expected.settings
    size = np.abs(change_px)
    size /= costs.spacing_spread * expected.pitch_px * np.sqrt(spacings)
    near = np.minimum(size, 1.5)
    cost = np.fmin(near * (size - 0.5 * near), costs.spacing_limit)
    cost += 1.5 * np.fmax(size - costs.tear_fraction / costs.spacing_spread, 0.0)
    return cost


def _trace(forward: Floats, origin: NDArray[np.int8], steps: list[tuple[int, int]]) -> Ints:
    """Return the candidate of each sheet in the best alignment of each list, −1 where missing, (lists, N)."""
    sheets, lists, count = forward.shape
    match = np.full((lists, sheets), -1, np.int64)
    flat = np.moveaxis(forward, 1, 0).reshape(lists, -1)
    n, k = np.divmod(np.argmin(flat, axis=1), count)
    alive = flat.min(axis=1) < 0
    step = np.array(steps)
    rows = np.arange(lists)
    for _ in range(sheets):
        match[rows[alive], n[alive]] = k[alive]
        code = origin[n, rows, k]
        alive &= code >= 0
        n, k = np.where(alive, n - step[code, 0], n), np.where(alive, k - step[code, 1], k)
    return match


def _margins(through: Floats, match: Ints) -> Floats:
    """Return the cost of the best alignment that pairs the sheet or its candidate otherwise, less the lowest
    cost of all alignments, (lists, N)."""
    sheets, lists, _ = through.shape
    list_, sheet = np.nonzero(match >= 0)
    candidate = match[list_, sheet]
    others = np.array(through)
    others[sheet, list_, candidate] = np.inf
    rival = np.minimum(others.min(axis=2)[sheet, list_], others.min(axis=0)[list_, candidate])
    margin = np.full((lists, sheets), np.nan)
    margin[list_, sheet] = rival - np.minimum(through.min(axis=(0, 2)), 0)[list_]
    return margin
