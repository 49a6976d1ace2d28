"""The symmetry axis, and the side and number of each sheet, counted from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from vision.memory import row_parts
from vision.numeric import NORMAL_MEDIAN, Floats, Ints, nan_median, typical_median, typical_size
from vision.sheets.reference import spacing_sizes
from vision.sheets.settings import DEFAULT, TrackingSettings
from vision.sheets.subpixel import position_noise
from vision.signals import mean_over

AxisHow = Literal["given", "motion", "geometry"]
Carried = Literal["yes", "perhaps", "no"]
LEAST_SEEN = 0.1  # of all slips, as squares, in which a sheet is seen: in fewer, one slip tells its motion


@dataclass(frozen=True)
class Numbering:
    """Side and number of every sheet.

    axis_px: the symmetry axis. how: "given", or found from "motion", or from "geometry": the middle of the
    comb. side: −1 left, +1 right of the axis; n: from the centre outwards, from 1; both (N,). low_px,
    high_px: limits that the motion sets to the axis; NaN where it sets none. carried: whether most sheets
    move alike, and the axis is in the middle since they are taken to be carried along; "perhaps" if they are
    taken for one side, though the innermost move as well. missing: number of sheets that seem to be missing
    in wide spacings, and count where the middle of the comb is looked for.
    """

    axis_px: float
    how: AxisHow
    side: Ints
    n: Ints
    low_px: float = np.nan
    high_px: float = np.nan
    carried: Carried = "no"
    missing: int = 0


def number_sheets(
    x_px: Floats,
    *,
    axis_px: float | None = None,
    width_px: int | None = None,
    settings: TrackingSettings = DEFAULT,
) -> Numbering:
    r"""Find the symmetry axis, and number the sheets of each side from it.

    Both sides move inwards in a stick phase and outwards in a slip; the axis is where the motion changes
    sign. The stiff centre hardly moves, so that several positions are equally good, and more if the camera
    vibrates. The axis is in the middle of the comb if that is one of them, or if there is no significant
    motion or no slip, else in the middle of these positions; so it is where the picture cuts off one end of
    the comb, if that is nearer to this end, and the motion leaves few sheets open. Sheets that seem to be
    missing in wide spacings count for the middle of the comb, but not for n. With one side in view all sheets
    move alike, and the axis lies beyond the end that moves least. A sheet on the axis (odd number, no end cut
    off) is the first on the right.

    A camera that moves along with the sheets, or a sample that the load carries along, shifts the place where
    the motion changes sign. If the whole comb is within a picture of `width_px` columns, and the motion less
    a shift of all sheets is clearly more symmetric about the comb's middle than the motion is about that
    place, the axis may be in the middle. So it may be if most sheets move alike, but less a shift far more
    symmetrically than one side does, whose motion grows towards one end.

    With one side in view, n counts from the sheet nearest to the axis, unless the axis is given as axis_px:
    then the sheets that fit between both at the comb's median spacing count as well. x_px: positions
    (frame, N), NaN where missing, sheets in order.

    With :math:`s_n` the step of sheet n per step by which the comb's ends move apart, the split k (sheets
    left of the axis) maximises

    .. math:: \sum_{n > k} s_n - \sum_{n \le k} s_n .
    """
    position = placed(typical_median(x_px))
    sheets = len(position)
    place = _places(position, settings)
    all_sheets = int(place[-1]) + 1
    spacing = float(np.median(np.diff(position))) if sheets > 1 else np.inf
    left, right = ends_in_view(position[[0, -1]], None if width_px is None else (0, width_px - 1), spacing)
    cut_off = int(left) - int(right)
    on_left = (all_sheets + (cut_off > 0)) // 2  # the side that is cut off does not show more than the other
    even = int(np.searchsorted(place, on_left))
    split, how, limits, carried = _split_by_motion(
        x_px, even, settings, whole=left and right, cut_off=cut_off
    )
    low = high = np.nan
    if limits is not None:
        edge = np.r_[_axis(position, 0), 0.5 * (position[1:] + position[:-1]), _axis(position, sheets)]
        low, high = np.interp(limits, np.arange(len(edge)), edge)
    if axis_px is not None:
        split = int(np.searchsorted(position, axis_px))
        side, n = _side_and_n(split, sheets)
        beyond = max(position[0] - axis_px, axis_px - position[-1], 0.0)
        if spacing > 0:  # the axis is half a spacing from the innermost sheet
            n += int(beyond / spacing)
        return Numbering(float(axis_px), "given", side, n, float(low), float(high))
    on_sheet = all_sheets % 2 == 1 and split == even and int(place[split]) == all_sheets // 2 and not cut_off
    on_sheet &= limits is None or bool(np.floor(limits[0]) <= even <= limits[1])
    axis_px = _axis(position, split, on_sheet=on_sheet)
    missing = all_sheets - sheets if how == "geometry" else 0
    side, n = _side_and_n(split, sheets)
    return Numbering(axis_px, how, side, n, float(low), float(high), carried, missing)


def ends_in_view(
    ends_px: Sequence[float] | Floats, view_px: tuple[float, float] | None, spacing_px: float
) -> tuple[bool, bool]:
    """Return whether the first sheet, and the last one, is so far inside the view, from its first to its last
    column, that no other sheet is beyond it. False for a view that is not known."""
    if view_px is None:
        return False, False
    room_px = 1.5 * spacing_px
    return bool(view_px[0] < ends_px[0] - room_px), bool(ends_px[1] + room_px < view_px[1])


def placed(position: Floats) -> Floats:
    """Return positions of the sheets, (N,), with those that are NaN placed evenly between those beside them,
    and beyond the ends at their median spacing. NaN only if no sheet has a position."""
    index, known = np.arange(len(position)), np.flatnonzero(np.isfinite(position))
    if not len(known) or len(known) == len(position):
        return position
    spacing = np.median(np.diff(position[known]) / np.diff(known)) if len(known) > 1 else 0.0
    beyond = np.minimum(index - known[0], 0) + np.maximum(index - known[-1], 0)
    return np.asarray(np.interp(index, known, position[known]) + beyond * spacing, np.float64)


def _places(position: Floats, settings: TrackingSettings) -> Ints:
    """Return the place of each sheet in the comb, from 0, if those that seem to be missing count, (N,). In
    each wide spacing at least one is missing. How many is counted in spacings of the whole comb, as the nine
    around a gap scatter too much."""
    ordered = np.sort(position)  # manual corrections may have swapped sheets
    gap = np.diff(ordered)
    with np.errstate(divide="ignore", invalid="ignore"):  # sheets at the same position, or none with any
        _, wide = spacing_sizes(ordered, settings=settings)
    step = np.ones(len(gap), np.int64)
    if wide.any():
        step[wide] = np.maximum(np.rint(gap[wide] / np.median(gap)), 2)
    return np.insert(np.cumsum(step), 0, 0)


def _side_and_n(split: int, sheets: int) -> tuple[Ints, Ints]:
    """Return side and n if `split` sheets are left of the axis."""
    index = np.arange(sheets)
    right = index >= split
    n = np.where(right, index - split + 1, split - index)
    return np.where(right, 1, -1).astype(np.int64), n.astype(np.int64)


def _split_by_motion(
    x_px: Floats, even: int, settings: TrackingSettings, *, whole: bool, cut_off: int
) -> tuple[int, AxisHow, tuple[float, float] | None, Carried]:
    """Return the number of sheets left of the axis, how it was found, the limits set by the motion, and
    whether all sheets are carried along, as most of them move alike.

    Splits are equally good within the noise of positions. The limits also allow for steps that are no
    opening: vibration in all frames, and in slips, whose sizes differ, a comb that is carried along or an
    avalanche on one side (White 1980, with the residuals of MacKinnon & White 1985). even: number of sheets
    left of the middle of the comb. whole: whether the whole comb is in view. cut_off: −1 or 1 where only its
    left or right end is not, so that its middle is on this side of the middle of what is in view, else 0.
    """
    sheets = x_px.shape[1]
    step, apart, noise = _slips(x_px, settings)
    power = float((apart**2).sum())
    if sheets < 3 or power == 0:
        return even, "geometry", None, "no"
    opening, error = _opening(step, apart), noise / np.sqrt(power)
    contrast = _contrast(opening)
    best = int(contrast.argmax())
    worse = contrast[best] - contrast
    slack = settings.axis_slack * np.abs(opening).sum() + np.sqrt((error**2).sum())
    good = np.flatnonzero(worse <= slack)
    other = np.empty((len(step), sheets + 1))
    for rows in row_parts(len(step)):
        other[rows] = _contrast(step[rows] - apart[rows, None] * opening)
        other[rows] -= other[rows][:, [best]]
    vibration = typical_size(other) / NORMAL_MEDIAN * np.sqrt(power)
    leverage = apart**2 / power
    weight = apart / np.maximum(1 - leverage, 1e-6)
    in_slips = np.array([np.linalg.norm(weight * column) for column in other.T])
    spread = np.maximum(vibration, in_slips) / power
    possible = np.flatnonzero(worse <= slack + settings.vibration_sigmas * spread)
    middle = float(good[0] + good[-1]) / 2
    low, high = middle - good[0] + possible[0], middle - good[-1] + possible[-1]
    # What is equally good may go on beyond the picture, and its middle then lies elsewhere.
    low, high = low if possible[0] else 0.0, high if possible[-1] < sheets else float(sheets)
    of_middle = _asymmetry(opening, even, shifted=True)
    if whole and of_middle < settings.carried_symmetry * _asymmetry(opening, best):
        low, high = min(low, even), max(high, even)
    alike = 4 * min(best, sheets - best) < sheets  # most sheets move alike: hardly any has its counterpart
    size = np.abs(opening)[:: -1 if 2 * best > sheets else 1]
    moves = bool(size[:2].min() > settings.innermost_moves * size.max())  # sheets at an axis hardly do
    carried = whole and alike and moves and of_middle < settings.carried_alike * float(opening.std())
    carried &= not np.floor(low) <= even <= high
    if carried:
        low, high = min(low, even), max(high, even)
    in_middle = bool(np.floor(low) <= even <= high)
    beyond_still = _beyond_still_half(opening, even, settings)
    if in_middle and beyond_still is not None:
        return beyond_still, "motion", (min(low, beyond_still), max(high, beyond_still)), "perhaps"
    towards_end = cut_off * (middle - even) > 0
    if in_middle and not (towards_end and high - low < settings.decided_range * sheets):
        how: AxisHow = "motion" if high - low <= settings.decided_sheets else "geometry"
        return even, how, (low, high), "yes" if carried else "no"
    outside = good[(good == 0) | (good == sheets)]  # all sheets move alike: one side is in view
    if len(outside):
        beyond = int(outside[0])
        return beyond, "motion", (float(possible[0]), float(possible[-1])), "perhaps" if moves else "no"
    open_ends = [end for end in (0, sheets) if low <= end <= high]
    if whole and len(open_ends) == 1:  # sides would be unequal: it is one, whose innermost sheets are still
        return open_ends[0], "motion", (low, high), "perhaps"
    return int(np.floor(middle) if middle > even else np.ceil(middle)), "motion", (low, high), "no"


def _beyond_still_half(opening: Floats, even: int, settings: TrackingSettings) -> int | None:
    """Return the split beyond the half of the comb whose sheets hardly move against each other, or None if
    both halves do so alike, as two sides, and noise, do. A shift of the whole comb does not change this."""
    left, right = opening[:even].std(), opening[even:].std()
    if left < settings.still_half * right:
        return 0
    return len(opening) if right < settings.still_half * left else None


def _opening(step: Floats, apart: Floats) -> Floats:
    """Return the step of each sheet per step of the ends, (N,), from the steps (frame − 1, N) in which it is
    seen; unknown ones, NaN, are replaced by what follows from it, in place. Sheets that touch in every slip
    are not seen in any: those beside tell how they move."""
    unknown = np.isnan(step)
    step[unknown] = 0.0
    seen = apart**2 @ ~unknown
    known = np.flatnonzero(seen > LEAST_SEEN * seen.max())
    opening = np.interp(np.arange(len(seen)), known, (apart @ step)[known] / seen[known])
    for rows in row_parts(len(step)):
        np.copyto(step[rows], apart[rows, None] * opening, where=unknown[rows])
    return opening


def _contrast(step: Floats) -> Floats:
    """Return the motion right of each split less that left of it, (..., N + 1)."""
    total = np.cumsum(np.insert(step, 0, 0.0, axis=-1), axis=-1)
    return np.asarray(total[..., -1:] - 2 * total, np.float64)


def _asymmetry(opening: Floats, split: int, *, shifted: bool = False) -> float:
    """Return the RMS of the sums of the motions (N,) of the k-th sheets left and right of a split.
    shifted: without what all pairs share, as where all sheets are carried along. The middle sheet of an odd
    comb has no pair. NaN with too few pairs."""
    right = opening[split + (2 * split + 1 == len(opening)) :]
    pairs = min(split, len(right))
    if pairs <= shifted:
        return np.nan
    total = right[:pairs] + opening[split - pairs : split][::-1]
    total -= shifted * total.mean()
    return float(np.sqrt((total**2).sum() / (pairs - shifted)))


def _slips(x_px: Floats, settings: TrackingSettings) -> tuple[Floats, Floats, Floats]:
    """Return the step of each sheet, (frame − 1, N), NaN where unknown, the step of the comb's ends away from
    each other, 0 for noise, (frame − 1,), and the noise of a step, (N,).

    Sticks count as well as slips, but not in a film without slips: a camera that zooms, or turns, also moves
    the ends apart, evenly, from any point. One that vibrates or drifts does not. After a knock or a cut all
    sheets move together by more than the ends move apart; such steps are not used.
    """
    step = np.diff(x_px, axis=0)
    known = np.isfinite(step)
    common = np.nan_to_num(nan_median(step, axis=1))
    often = 2 * known.sum(axis=0) >= len(known)
    ends = np.flatnonzero(often)[[0, -1]] if often.any() else np.array([0, -1])
    apart = step[:, ends[1]] - step[:, ends[0]]
    step[~known] = 0.0
    noise = np.nan_to_num(position_noise(x_px), nan=1.0) * np.sqrt(2)
    least = 5 * np.hypot(*noise[ends])
    even = mean_over(apart, settings.axis_frames)
    slips = bool((np.abs(apart - even) > least).any())
    apart = np.where(slips & (np.abs(apart) > least), apart, 0.0)
    apart = np.where(np.abs(common) < settings.knock_ratio * np.abs(apart), apart, 0.0)
    for rows in row_parts(len(step)):
        beside = np.pad(step[rows], ((0, 0), (1, 1)), "edge")
        low, high = np.minimum(beside[:, :-2], beside[:, 2:]), np.maximum(beside[:, :-2], beside[:, 2:])
        step[rows] = np.clip(step[rows], low, high)  # the median of three removes a sheet that was covered
    step[~known] = np.nan
    return step, apart, noise


def _axis(position: Floats, split: int, *, on_sheet: bool = False) -> float:
    """Return the middle of the three innermost pairs of sheets, half a spacing beyond the end if all sheets
    are on one side, or the position of the middle sheet if the axis is on it."""
    sheets = len(position)
    spacing = float(np.median(np.diff(position))) if sheets > 1 else 0.0
    if on_sheet:
        return float(position[split] - 0.01 * spacing)  # it is the first on the right
    if split == 0:
        return float(position[0] - spacing / 2)
    if split == sheets:
        return float(position[-1] + spacing / 2)
    pairs = min(3, split, sheets - split)
    inner = np.r_[position[split - pairs : split], position[split : split + pairs]]
    return float(inner.mean())
