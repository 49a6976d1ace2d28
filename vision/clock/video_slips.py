"""Slips as the camera sees them: sudden outward steps that all sheets share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vision.errors import InputError
from vision.force.noise import MAD_TO_SIGMA
from vision.sheets.medians import nan_median

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

Doubles = NDArray[np.float64]
Bools = NDArray[np.bool_]

_CLEAR = 6.0  # standard errors by which a step must stand out
_PART = 3.0  # the same for a frame that shows part of it
_SMALL = 0.1  # of the large steps: below this a step is one of few sheets, not a slip
_UNDONE = 0.6  # a step that falls back by this much at once was a bad frame
_ROUNDS = 3
_LEAST_SHEETS = 0.2  # of all: with fewer, a frame is left out


@dataclass(frozen=True)
class _Steps:
    """Movement between consecutive usable frames.

    time_s: (F,).  moved_px: (F-1, sheet), outward, NaN where either position is missing.  uniform: (sheet,),
    what a movement of the whole picture looks like in outward terms.
    """

    time_s: Doubles
    moved_px: Doubles
    uniform: Doubles


def video_slips(tracks: xr.Dataset) -> pd.DataFrame:
    """Common outward steps of all sheets, in order of time.

    The movement of all sheets from frame to frame is fitted by one pattern, how far each moves in a slip,
    and by a shift of the whole picture (drift, vibration) where both sides are in view; sheets weigh by
    their noise.  Missing positions and frames are left out.  A slip during an exposure shows as a frame in
    between, which places it within the exposure; one between two exposures lies anywhere between them.

    Args: tracks, from `track_sheets`: x_px (frame, sheet), time_s, side and n.
    Returns: time_s, error_s (standard error), step_px (of a typical outer sheet), step_err_px and frames
    (that the step takes: 1 between two frames); empty where nothing steps.  attrs: noise_px, share_exposed.

    Raises InputError where frames have no times or fewer than three can be used.
    """
    import pandas as pd

    steps = _steps(tracks)
    pattern = _first_pattern(np.asarray(tracks["n"].values, np.float64))
    noise = _noise(steps.moved_px)
    for _ in range(_ROUNDS):
        above, error, creep = _common(steps, pattern, noise)
        first, last = _runs(above, error, creep)
        pattern = _pattern(steps, pattern, first, last)
    time_s, error_s, share = _placed(steps.time_s, above, first, last)
    table = pd.DataFrame(
        {
            "time_s": time_s,
            "error_s": error_s,
            "step_px": _sums(above, first, last),
            "step_err_px": error[first],
            "frames": last - first + 1,
        }
    )
    table.attrs |= {"noise_px": float(np.median(error)), "share_exposed": share}
    return table


def _steps(tracks: xr.Dataset) -> _Steps:
    x = np.asarray(tracks["x_px"].values, np.float64)
    time = np.asarray(tracks["time_s"].values, np.float64)
    side = np.asarray(tracks["side"].values, np.float64)
    about = str(tracks.attrs.get("source", "the tracks"))
    if not np.isfinite(time).any():
        raise InputError(about, "a time for each frame", "none", "give --fps or --timestamps")
    seen = np.isfinite(x).mean(axis=1) >= _LEAST_SHEETS
    # A time stamp that does not rise is stale: the frame's true time is not known.
    before = np.maximum.accumulate(np.r_[-np.inf, np.where(np.isfinite(time), time, -np.inf)])[:-1]
    good = np.flatnonzero(seen & (time > before))
    if len(good) < 3:
        raise InputError(about, "at least 3 frames with sheets and rising times", f"{len(good)}")
    moved = np.diff(x[good], axis=0) * side
    two_sided = bool((side < 0).any() and (side > 0).any())
    return _Steps(time[good], moved, side if two_sided else np.zeros_like(side))


def _first_pattern(n: Doubles) -> Doubles:
    """Outer sheets move more."""
    return np.asarray(n / n.max())


def _noise(moved_px: Doubles) -> Doubles:
    """Standard error of one movement of each sheet, (sheet,); slips are too few to matter to a median."""
    away = moved_px - nan_median(moved_px)
    noise = MAD_TO_SIGMA * nan_median(np.abs(away))
    usual = noise[np.isfinite(noise)]
    floor = max(0.1 * float(np.median(usual)), 1e-6) if usual.size else 1.0
    return np.asarray(np.maximum(np.where(np.isfinite(noise), noise, np.inf), floor))


def _common(steps: _Steps, pattern: Doubles, noise: Doubles) -> tuple[Doubles, Doubles, float]:
    """(size of the pattern in each movement above the creep, its standard error, the creep), (F-1,) each.

    A uniform shift of all sheets is fitted along.
    """
    known = np.isfinite(steps.moved_px)
    moved = np.where(known, steps.moved_px, 0.0)
    w = known / noise**2
    pp, pu, uu = w @ pattern**2, w @ (pattern * steps.uniform), w @ steps.uniform**2
    pm, um = (w * moved) @ pattern, (w * moved) @ steps.uniform
    # With one sheet, or one side of a pair, the two cannot be told apart: all of it counts as a step.
    both = pp * uu - pu**2 > 1e-6 * pp * uu
    with np.errstate(divide="ignore", invalid="ignore"):
        size = np.where(both, (uu * pm - pu * um) / (pp * uu - pu**2), pm / pp)
        error = np.sqrt(np.where(both, uu / (pp * uu - pu**2), 1 / pp))
    useful = np.isfinite(size) & np.isfinite(error)
    if not useful.any():
        return np.zeros_like(size), np.full_like(error, np.inf), 0.0
    creep, scatter = _shortest_half(size[useful])
    # The sheets' own noise does not explain all, such as paper that gives way unevenly.
    error = error * max(scatter, 1e-9) / np.median(error[useful])
    return np.where(useful, size - creep, 0.0), np.where(useful, error, np.inf), creep


def _shortest_half(values: Doubles) -> tuple[float, float]:
    """Middle and standard deviation of what is not a slip, though slips be nearly half of all movements.

    From the shortest interval that holds half the values (Rousseeuw & Leroy 1988).
    """
    ordered = np.sort(values)
    half = len(ordered) // 2
    length = ordered[half:] - ordered[: len(ordered) - half]
    k = int(np.argmin(length))
    return float(ordered[k : k + half + 1].mean()), MAD_TO_SIGMA / 2 * float(length[k])


def _runs(above: Doubles, error: Doubles, creep: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First and last movement of each step.

    In a stick the sheets creep inwards, or rest where the machine does: only what goes outwards is a step.
    """
    outward = above + min(creep, 0.0)
    part = outward > _PART * error
    edges = np.diff(np.r_[0, part.astype(np.int8), 0])
    first, last = np.flatnonzero(edges > 0), np.flatnonzero(edges < 0) - 1
    height = _sums(above, first, last)
    sudden = np.maximum.reduceat(np.r_[outward, -np.inf], np.stack([first, last + 1], axis=1).ravel())[::2]
    padded = np.r_[0.0, above, 0.0]
    clear = (sudden > _CLEAR * error[first]) & (
        np.minimum(padded[first], padded[last + 2]) > -_UNDONE * height
    )
    if clear.any():
        clear &= height > _SMALL * np.percentile(height[clear], 90)
    return _completed(above, error, first[clear], last[clear])


def _completed(
    above: Doubles, error: Doubles, first: NDArray[np.int64], last: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Steps of one movement with the neighbour that shows another part, though it be less than the creep.

    A part is more than the next movement further away: there may be no creep at all before a slip.
    """
    single, least = first == last, _PART * error[first]
    padded = np.maximum(np.r_[0.0, 0.0, above, 0.0, 0.0], 0.0)
    before, after = padded[first + 1] - padded[first], padded[last + 3] - padded[last + 4]
    earlier = single & (before > least) & (before >= after)
    later = single & (after > least) & (after > before)
    return first - earlier, last + later


def _sums(values: Doubles, first: NDArray[np.int64], last: NDArray[np.int64]) -> Doubles:
    total = np.r_[0.0, np.cumsum(values)]
    return np.asarray(total[last + 1] - total[first])


def _pattern(steps: _Steps, pattern: Doubles, first: NDArray[np.int64], last: NDArray[np.int64]) -> Doubles:
    """How far each sheet moves in the median step, the outermost tenth being 1; as it was without steps."""
    if len(first) < 3:
        return pattern
    clean = first[first == last] if np.sum(first == last) >= 3 else first
    typical = nan_median(steps.moved_px[clean])
    typical = np.maximum(np.where(np.isfinite(typical), typical, 0.0), 0.0)
    top = float(np.percentile(typical, 90))
    return np.asarray(typical / top) if top > 0 else pattern


def _placed(
    time_s: Doubles, above: Doubles, first: NDArray[np.int64], last: NDArray[np.int64]
) -> tuple[Doubles, Doubles, float]:
    """(time, standard error) of each step, and the share of the frame time during which light is collected.

    That share is how often a step shows as a frame in between.  Where it is e, a step without such a frame
    lies within the dark time, evenly; one with it within the exposure, where the part of the step already
    shown says.
    """
    above = np.maximum(above, 0.0)
    middle, length = 0.5 * (time_s[1:] + time_s[:-1]), np.diff(time_s)
    usual = float(np.median(length))
    centroid = _sums(above * middle, first, last) / np.maximum(_sums(above, first, last), 1e-300)
    frames = last - first + 1
    count = len(first)
    share = (np.sum(frames > 1) + 0.5) / (count + 1.0)
    unsure = usual * np.sqrt(share * (1 - share) / (count + 1.0))
    inside = time_s[first + 1]  # the frame in between
    split = inside + share * (centroid - inside)
    dark = np.maximum(length[first] - share * usual, 0.1 * usual) / np.sqrt(12)
    time = np.where(frames == 2, split, centroid)
    error = np.select([frames == 1, frames == 2], [dark, unsure / 2 + 0.03 * usual], 0.3 * usual)
    return time, error, float(share)
