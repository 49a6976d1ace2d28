"""The symmetry axis, and each sheet's side and number counted from it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vision.sheets.medians import nan_median
from vision.sheets.noise import NORMAL_MEDIAN, position_noise

Doubles = NDArray[np.float64]

SURE = 4.0  # standard errors by which motion must speak for a side
RIGID = 3.0  # px per px that the ends step apart: what moves more than that moves as a whole
# Of all the motion: splits this close to the best one are equal, and the middle one is taken
SLACK = 0.02
SHAKES = 2.0  # times the vibration that all sheets may have in common: what it may add to every motion
DECIDED = 2  # sheets by which the axis may then still lie elsewhere for the motion to have found it


@dataclass(frozen=True)
class Numbering:
    """axis_px: the symmetry axis.  how: "given", or found from "motion", or from "geometry": the middle of
    the comb.  side: −1 left, +1 right of the axis, (N,).  n: from the centre outwards, from 1, (N,).
    between_px: where the motion allows the axis to lie; NaN where it tells nothing.
    """

    axis_px: float
    how: Literal["given", "motion", "geometry"]
    side: NDArray[np.int64]
    n: NDArray[np.int64]
    between_px: tuple[float, float] = (np.nan, np.nan)


def number_sheets(x_px: Doubles, *, axis_px: float | None = None) -> Numbering:
    """Side and n of every sheet.

    The sheets on either side move against each other: in a stick phase both inwards, in a slip both
    outwards. The axis is put where the motion changes sign. The stiff centre hardly moves, so several
    places are equally good; as both sides move alike, the axis is in the middle of these. A shaking camera
    adds to all sheets alike and so widens the choice. The axis is in the middle of the comb if that is
    among what is left, or without significant motion. With one side in view all sheets move alike, and the
    axis lies outside, beyond the end that moves least. A sheet that stands on the axis itself (odd number)
    counts as the first on the right.

    Args: x_px (frame, N), NaN where missing, sheets in order.  axis_px: given by the user.
    Returns: Numbering. Where the axis lies outside the picture, n counts from the sheet in view nearest to
    it.
    """
    place = nan_median(x_px, axis=0)
    if axis_px is not None:
        return _numbered(axis_px, "given", int(np.searchsorted(place, axis_px)), len(place))
    split, how, between = _split_by_motion(x_px)
    numbering = _numbered(_axis(place, split), how, split, len(place))
    if between is None:
        return numbering
    edge = np.r_[place[0], 0.5 * (place[1:] + place[:-1]), place[-1]]
    low, high = np.interp(between, np.arange(len(edge)), edge)
    return replace(numbering, between_px=(float(low), float(high)))


def _numbered(
    axis_px: float, how: Literal["given", "motion", "geometry"], split: int, sheets: int
) -> Numbering:
    index = np.arange(sheets)
    right = index >= split
    n = np.where(right, index - split + 1, split - index)
    return Numbering(float(axis_px), how, np.where(right, 1, -1).astype(np.int64), n.astype(np.int64))


def _split_by_motion(
    x_px: Doubles,
) -> tuple[int, Literal["motion", "geometry"], tuple[float, float] | None]:
    """Number of sheets left of the axis, and between which numbers the motion allows it."""
    sheets = x_px.shape[1]
    opening, error, shake = _opening(x_px)
    sure = (np.abs(opening[[0, -1]]) > SURE * error[[0, -1]]).any()
    if sheets < 3 or not sure or np.abs(opening).max() > RIGID:
        return sheets // 2, "geometry", None
    good = _splits(opening, error)
    first, last = (_middle(_splits(opening + SHAKES * sign * shake, error)) for sign in (1, -1))
    low, high = min(first, last), max(first, last)
    outside = good[(good == 0) | (good == sheets)]  # all sheets move alike: one side is in view
    if len(outside):
        return int(outside[0]), "motion", (low, high)
    middle, even = _middle(good), sheets // 2
    if low - 0.5 <= sheets / 2 <= high + 0.5:
        return even, "motion" if high - low <= DECIDED else "geometry", (low, high)
    return int(np.floor(middle) if middle > even else np.ceil(middle)), "motion", (low, high)


def _splits(opening: Doubles, error: Doubles) -> NDArray[np.int64]:
    """Splits that set the motion of one side against the other's as well as the best one does."""
    total = np.r_[0, np.cumsum(opening)]
    contrast = total[-1] - 2 * total  # right of the split less left of it
    slack = SLACK * np.abs(opening).sum() + np.sqrt((error**2).sum())
    return np.asarray(np.flatnonzero(contrast >= contrast.max() - slack), np.int64)


def _middle(splits: NDArray[np.int64]) -> float:
    return float(splits[0] + splits[-1]) / 2


def _opening(x_px: Doubles) -> tuple[Doubles, Doubles, float]:
    """How far each sheet steps when the comb's ends step apart by one pixel, the standard error, and that
    which vibration gives all sheets together.

    The distance between the ends does not feel vibration or drift of the camera, so neither do these
    slopes, as long as the two are unrelated. Where both ends step the same way (one side in view), the
    larger one leads.
    """
    step = np.diff(x_px, axis=0)
    known = np.isfinite(step)
    step = np.where(known, step, 0.0)
    ends = known[:, 0] & known[:, -1]
    apart = np.where(ends, step[:, -1] - step[:, 0], 0.0)
    noise = np.nan_to_num(position_noise(x_px), nan=1.0) * np.sqrt(2)
    apart = np.where(np.abs(apart) > 5 * noise[[0, -1]].max(), apart, 0.0)  # slips only: noise is no motion
    power = float((apart**2).sum())
    if power == 0:
        return np.zeros(x_px.shape[1]), np.full(x_px.shape[1], np.inf), 0.0
    common = nan_median(np.where(known, step, np.nan), axis=1)
    shaking = float(np.nan_to_num(nan_median(np.abs(common)))) / NORMAL_MEDIAN
    return (apart @ step) / power, noise / np.sqrt(power), shaking / float(np.sqrt(power))


def _axis(place: Doubles, split: int) -> float:
    """Middle between the innermost sheets, from the three innermost pairs; half a spacing beyond the end if
    one-sided."""
    sheets = len(place)
    spacing = float(np.median(np.diff(place))) if sheets > 1 else 0.0
    if split == 0:
        return float(place[0] - spacing / 2)
    if split == sheets:
        return float(place[-1] + spacing / 2)
    pairs = min(3, split, sheets - split)
    inner = np.r_[place[split - pairs : split], place[split : split + pairs]]
    if sheets % 2 and split == sheets // 2:
        return float(place[split] - 0.01 * spacing)  # the middle sheet stands on the axis
    return float(inner.mean())
