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


def standing_still(moved_px: Doubles) -> NDArray[np.bool_]:
    """Which entries stay where they are while the sheets beside them move: dust on the lens or the sensor,
    marks.

    Each entry's motion is compared with the mean of its two neighbours on either side, over the frames
    where all are seen. Only where these move together by more than 0.7 px rms is there a verdict; the
    centre of the comb gives none.

    Args: moved_px (frame, N), displacement from the resting place, NaN where missing.  Returns: (N,).
    """
    padded = np.pad(moved_px, ((0, 0), (2, 2)), constant_values=np.nan)
    around = np.stack([padded[:, i : i + moved_px.shape[1]] for i in (0, 1, 3, 4)])
    seen = np.isfinite(around)
    mean = np.where(seen, around, 0.0).sum(axis=0) / np.maximum(seen.sum(axis=0), 1)
    both = seen.any(axis=0) & np.isfinite(moved_px)
    power = np.where(both, mean**2, 0.0).sum(axis=0)
    own = np.where(both, np.nan_to_num(moved_px) ** 2, 0.0).sum(axis=0)
    frames = both.sum(axis=0)
    sure = (frames >= LEAST_FRAMES) & (power > frames * MOVES**2)
    return np.asarray(sure & (own < STILL**2 * power), bool)


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
