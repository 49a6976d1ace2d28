"""Which of the persistent ridges belong to the comb: dust, labels and marks are taken out."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]
Ints = NDArray[np.int64]

# Per unit of the logarithm of spacing over pitch: dust halfway between two sheets costs two sheets
UNEVEN_COST = 3.0
EVEN = 0.12  # scatter (standard deviation of the logarithm) of the spacings of an even comb, at most
CONTRAST_WORTH = 0.4  # per unit of the logarithm of contrast: dust is often fainter, but so are some sheets
USUAL_WIDTHS = 0.35  # natural logarithm: ridges differ by this much
ODD_WIDTH_COST = 3.0  # per unit of the logarithm beyond that
LEAST_WORTH = 0.3
MOVES = 0.7  # px rms: neighbours that move this much tell what stands still
STILL = 0.3  # of the neighbours' motion: what moves less is no sheet
LEAST_FRAMES = 50
ODD_SPACING = 0.25  # natural logarithm: what is at the end and spaced so may be no sheet


def sheet_worth(log_contrast: Doubles, log_width: Doubles, found: Doubles) -> Doubles:
    """How much speaks for each entry being a sheet, (entries,): presence, contrast, and a width like the
    others'."""
    odd = np.maximum(np.abs(log_width - np.median(log_width)) - USUAL_WIDTHS, 0)
    faint = np.maximum(log_contrast - np.median(log_contrast), -2.5)
    worth = 1 + 1.5 * found + CONTRAST_WORTH * faint - ODD_WIDTH_COST * odd
    return np.asarray(np.maximum(worth, LEAST_WORTH), np.float64)


def choose_sheets(x_px: Doubles, worth: Doubles, pitch_px: float, sheets: int | None = None) -> Ints:
    """Numbers of the entries that together make the best comb.

    Each entry counts for its worth, each spacing against its departure from the local pitch; a dynamic
    programme over the entries in order finds the chain worth most, of exactly `sheets` entries where that is
    given. A faint sheet in its place is kept, since without it the spacing is double; dust between two sheets
    is not.

    Args: x_px, ascending; worth, from `sheet_worth`; both (entries,).  Returns: ascending numbers.
    """
    if sheets is None:
        local = _local_pitch(x_px, pitch_px)
        return _best_chain(worth, _uneven_cost(x_px, local) / _unevenness(x_px, local))
    # the pitch was measured on that many ridges, so strangers among the entries have not spoilt it
    return _best_chain_of(sheets, worth, _uneven_cost(x_px, np.full(len(x_px), pitch_px)))


def _unevenness(x_px: Doubles, local: Doubles) -> float:
    """How much more the spacings scatter than those of an even comb, at least 1: the more, the less they
    tell."""
    if len(x_px) < 6:
        return 1.0
    off = np.abs(np.log(np.maximum(np.diff(x_px), 1e-3) / local[:-1]))
    return max(1.0, float(np.median(off)) / 0.6745 / EVEN)


def standing_still(moved_px: Doubles, rest_px: Doubles) -> NDArray[np.bool_]:
    """Which entries stay where they are while the sheets beside them move: dust on the lens or the sensor,
    marks.

    A sheet moves at least as much as its neighbours on one of its sides: motion grows outwards. So each entry
    is compared with the smaller of the motions to its left and to its right (each the mean of two
    neighbours), as far as these go the same way. Only where that is more than 0.7 px rms is there a
    verdict. The centre of the comb gives none; its ends only where their spacing is not the comb's.

    Args: moved_px (frame, N), displacement from the resting place, NaN where missing; rest_px (N,), where
    that is.  Returns: (N,).
    """
    left, right = _beside(moved_px), _beside(moved_px[:, ::-1])[:, ::-1]
    gap = np.diff(rest_px)
    odd = np.abs(np.log(gap / np.median(gap))) > ODD_SPACING if len(gap) > 1 else np.zeros(2, bool)
    if odd[0]:
        left[:, 0] = right[:, 0]
    if odd[-1]:
        right[:, -1] = left[:, -1]
    common = np.where(left * right > 0, np.minimum(np.abs(left), np.abs(right)), 0.0)
    both = np.isfinite(left) & np.isfinite(right) & np.isfinite(moved_px)
    power = np.where(both, common**2, 0.0).sum(axis=0)
    own = np.where(both, np.nan_to_num(moved_px) ** 2, 0.0).sum(axis=0)
    frames = both.sum(axis=0)
    sure = (frames >= LEAST_FRAMES) & (power > frames * MOVES**2)
    return np.asarray(sure & (own < STILL**2 * power), bool)


def _beside(moved_px: Doubles) -> Doubles:
    """Mean motion of the two entries before each in its row, NaN where neither is seen."""
    padded = np.pad(moved_px, ((0, 0), (2, 0)), constant_values=np.nan)
    pair = np.stack([padded[:, :-2], padded[:, 1:-1]])
    count = np.isfinite(pair).sum(axis=0)
    return np.asarray(np.where(count, np.nan_to_num(pair).sum(axis=0) / np.maximum(count, 1), np.nan))


def _uneven_cost(x_px: Doubles, local: Doubles) -> Doubles:
    """Cost of having entry j next after entry i, (i, j); inf where j is not to the right of i."""
    gap = x_px[None, :] - x_px[:, None]
    local = (local[None, :] + local[:, None]) / 2
    return np.where(gap > 0, UNEVEN_COST * np.abs(np.log(np.where(gap > 0, gap, 1.0) / local)), np.inf)


def _local_pitch(x_px: Doubles, pitch_px: float) -> Doubles:
    """Median spacing of the nine entries around each, within a quarter of the pitch."""
    from scipy.ndimage import median_filter

    if len(x_px) < 6:
        return np.full(len(x_px), pitch_px)
    smooth = median_filter(np.diff(x_px), size=9, mode="nearest")
    return np.asarray(np.clip(np.r_[smooth, smooth[-1]], 0.75 * pitch_px, 1.25 * pitch_px), np.float64)


def _best_chain(worth: Doubles, cost: Doubles) -> Ints:
    best, origin = np.array(worth), np.full(len(worth), -1)
    for i in range(1, len(worth)):
        before = best[:i] - cost[:i, i]
        if before.max() > 0:
            origin[i] = int(np.argmax(before))
            best[i] += before.max()
    chain = [int(np.argmax(best))]
    while origin[chain[-1]] >= 0:
        chain.append(int(origin[chain[-1]]))
    return np.array(chain[::-1], np.int64)


def _best_chain_of(sheets: int, worth: Doubles, cost: Doubles) -> Ints:
    best, origin = worth, []
    for _ in range(sheets - 1):
        total = best[:, None] - cost
        origin.append(np.argmax(total, axis=0))
        best = total.max(axis=0) + worth
    chain = [int(np.argmax(best))]
    for step in reversed(origin):
        chain.append(int(step[chain[-1]]))
    return np.array(chain[::-1], np.int64)
