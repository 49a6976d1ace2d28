"""The symmetry axis, and each sheet's side and number counted from it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from vision.numeric import NORMAL_MEDIAN, Floats, Ints, nan_median
from vision.sheets.settings import DEFAULT, TrackingSettings
from vision.sheets.subpixel import position_noise
from vision.signals import running_median

AxisHow = Literal["given", "motion", "geometry"]


@dataclass(frozen=True)
class Numbering:
    """Side and number of every sheet.

    Parameters
    ----------
    axis_px
        The symmetry axis.
    how
        "given", or found from "motion", or from "geometry": the middle of the comb.
    side
        −1 left, +1 right of the axis, (N,).
    n
        From the centre outwards, from 1, (N,).
    low_px, high_px
        Between what the motion allows the axis to lie; NaN where it tells nothing.
    """

    axis_px: float
    how: AxisHow
    side: Ints
    n: Ints
    low_px: float = np.nan
    high_px: float = np.nan


def number_sheets(
    x_px: Floats, *, axis_px: float | None = None, settings: TrackingSettings = DEFAULT
) -> Numbering:
    r"""Side and n of every sheet.

    Both sides move inwards in a stick and outwards in a slip; the axis is where the motion changes sign. The
    stiff centre hardly moves, so several places are equally good, and more where the camera shakes: the axis
    is in the middle of the comb if that is among them, or without significant motion, else in the middle of
    these places. With one side in view all sheets move alike, and the axis lies beyond the end that moves
    least. A sheet on the axis itself (odd number) counts as the first on the right.

    Parameters
    ----------
    x_px
        Positions (frame, N), NaN where missing, sheets in order.
    axis_px
        The axis, if known.
    settings
        What counts as significant motion.

    Returns
    -------
    Numbering
        Where the axis lies outside the picture, n counts from the sheet in view nearest to it.

    Notes
    -----
    With :math:`s_n` the step of sheet n per step by which the comb's ends move apart, the split k (sheets
    left of the axis) maximises

    .. math:: \sum_{n > k} s_n - \sum_{n \le k} s_n .
    """
    place = nan_median(x_px, axis=0)
    sheets = len(place)
    split, how, between = _split_by_motion(x_px, settings)
    low = high = np.nan
    if between is not None:
        edge = np.r_[_axis(place, 0), 0.5 * (place[1:] + place[:-1]), _axis(place, sheets)]
        low, high = np.interp(between, np.arange(len(edge)), edge)
    if axis_px is not None:
        split = int(np.searchsorted(place, axis_px))
        return Numbering(float(axis_px), "given", *_counted(split, sheets), float(low), float(high))
    return Numbering(_axis(place, split), how, *_counted(split, sheets), float(low), float(high))


def _counted(split: int, sheets: int) -> tuple[Ints, Ints]:
    """Side and n, with so many sheets left of the axis."""
    index = np.arange(sheets)
    right = index >= split
    n = np.where(right, index - split + 1, split - index)
    return np.where(right, 1, -1).astype(np.int64), n.astype(np.int64)


def _split_by_motion(
    x_px: Floats, settings: TrackingSettings
) -> tuple[int, AxisHow, tuple[float, float] | None]:
    """Number of sheets left of the axis, and between which numbers the motion allows it."""
    sheets = x_px.shape[1]
    opening, error, vibration = _opening(x_px, settings)
    moves = (np.abs(opening[[0, -1]]) > settings.axis_sigmas * error[[0, -1]]).any()
    rigid = np.abs(opening).max() > 3.0  # px per px: what moves more than the ends do moves as a whole
    if sheets < 3 or not moves or rigid:
        return sheets // 2, "geometry", None
    opening = running_median(opening, 3)  # one sheet between two that agree was covered in a slip
    good = _splits(opening, error, settings)
    shift = settings.vibration_sigmas * vibration
    first, last = (_middle(_splits(opening + sign * shift, error, settings)) for sign in (1, -1))
    low, high = min(first, last), max(first, last)
    outside = good[(good == 0) | (good == sheets)]  # all sheets move alike: one side is in view
    if len(outside):
        beyond = int(outside[0])
        return beyond, "motion", (min(low, beyond), max(high, beyond))
    middle, even = _middle(good), sheets // 2
    if low - 0.5 <= sheets / 2 <= high + 0.5:
        return even, "motion" if high - low <= settings.decided_sheets else "geometry", (low, high)
    return int(np.floor(middle) if middle > even else np.ceil(middle)), "motion", (low, high)


def _splits(opening: Floats, error: Floats, settings: TrackingSettings) -> Ints:
    """Splits that set the motion of one side against the other's as well as the best one does."""
    total = np.r_[0, np.cumsum(opening)]
    contrast = total[-1] - 2 * total  # right of the split less left of it
    slack = settings.axis_slack * np.abs(opening).sum() + np.sqrt((error**2).sum())
    return np.asarray(np.flatnonzero(contrast >= contrast.max() - slack), np.int64)


def _middle(splits: Ints) -> float:
    return float(splits[0] + splits[-1]) / 2


def _opening(x_px: Floats, settings: TrackingSettings) -> tuple[Floats, Floats, float]:
    """How far each sheet steps when the comb's ends step apart by one pixel, its standard error, and the
    error that vibration adds to all sheets together.

    A camera that shakes or drifts does not change the distance between the ends. A knock against it, or a
    cut, moves all sheets by more than the ends move apart: such steps say nothing.
    """
    step = np.diff(x_px, axis=0)
    known = np.isfinite(step)
    step = np.where(known, step, 0.0)
    ends = known[:, 0] & known[:, -1]
    apart = np.where(ends, step[:, -1] - step[:, 0], 0.0)
    noise = np.nan_to_num(position_noise(x_px), nan=1.0) * np.sqrt(2)
    apart = np.where(np.abs(apart) > 5 * noise[[0, -1]].max(), apart, 0.0)  # slips only: noise is no motion
    common = nan_median(np.where(known, step, np.nan), axis=1)
    apart = np.where(np.abs(np.nan_to_num(common)) < settings.knock_ratio * np.abs(apart), apart, 0.0)
    power = float((apart**2).sum())
    if power == 0:
        return np.zeros(x_px.shape[1]), np.full(x_px.shape[1], np.inf), 0.0
    vibration = float(np.nan_to_num(nan_median(np.abs(common)))) / NORMAL_MEDIAN
    return (apart @ step) / power, noise / np.sqrt(power), vibration / float(np.sqrt(power))


def _axis(place: Floats, split: int) -> float:
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
