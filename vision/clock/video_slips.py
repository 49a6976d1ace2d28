"""Slips as the camera sees them: sudden outward steps that all sheets share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
import xarray as xr

from vision.clock.settings import ClockSettings
from vision.data import StripMetadata
from vision.errors import InputError
from vision.numeric import NORMAL_MEDIAN, Floats, Ints, nan_median


@dataclass(frozen=True)
class _Steps:
    """Movement between consecutive usable frames.

    time_s: (F,).  moved_px: (F-1, sheet), outward, NaN where either position is missing.  uniform: (sheet,),
    what a movement of the whole picture looks like in outward terms.
    """

    time_s: Floats
    moved_px: Floats
    uniform: Floats


def video_slips(tracks: xr.Dataset, *, settings: ClockSettings = ClockSettings()) -> pd.DataFrame:
    r"""Common outward steps of all sheets, in order of time.

    Parameters
    ----------
    tracks
        From `track_sheets`: x_px (frame, sheet), time_s, side and n. Missing positions and frames are left
        out.
    settings
        See `ClockSettings`.

    Returns
    -------
    A table, empty where nothing steps, with the columns time_s, error_s (standard error), step_px (of a
    typical outer sheet), step_err_px and frames (that the step takes; 1 between two frames). ``attrs``:
    noise_px of the common movement, and share_exposed, the part of the frame time during which the shutter is
    open.

    Raises
    ------
    InputError
        Where frames have no times or fewer than three can be used.

    Notes
    -----
    From frame to frame :math:`f`, sheet :math:`n` moves outwards by

    .. math:: \Delta x_{nf} = a_f p_n + s_f u_n,

    where :math:`p_n` is how far each sheet moves in a slip and :math:`s_f` is a shift of the whole picture
    (drift, vibration), fitted where both sides are in view, :math:`u_n = \pm 1` being a sheet's side. Both
    are weighted least squares by the sheets' noise. A slip is an :math:`a_f` that stands out from the creep.
    One during an exposure shows as a frame in between, which places it within the exposure; one between two
    exposures lies anywhere between them.
    """
    steps = _steps(tracks, settings.least_sheets)
    pattern = _first_pattern(np.asarray(tracks["n"].values, np.float64))
    noise = _noise(steps.moved_px)
    for _ in range(3):
        above, error, creep = _common(steps, pattern, noise)
        first, last = _find_steps(above, error, creep, settings)
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


def _steps(tracks: xr.Dataset, least_sheets: float) -> _Steps:
    x = np.asarray(tracks["x_px"].values, np.float64)
    time = np.asarray(tracks["time_s"].values, np.float64)
    side = np.asarray(tracks["side"].values, np.float64)
    about = StripMetadata.of(tracks).source
    if not np.isfinite(time).any():
        raise InputError(about, "a time for each frame", "none", "give `fps` or `timestamps`")
    seen = np.isfinite(x).mean(axis=1) >= least_sheets
    # A time stamp that does not rise is stale: the frame's true time is not known.
    before = np.maximum.accumulate(np.r_[-np.inf, np.where(np.isfinite(time), time, -np.inf)])[:-1]
    good = np.flatnonzero(seen & (time > before))
    if len(good) < 3:
        raise InputError(about, "at least 3 frames with sheets and rising times", f"{len(good)}")
    moved = np.diff(x[good], axis=0) * side
    two_sided = bool((side < 0).any() and (side > 0).any())
    return _Steps(time[good], moved, side if two_sided else np.zeros_like(side))


def _first_pattern(n: Floats) -> Floats:
    """Outer sheets move more."""
    return np.asarray(n / n.max())


def _noise(moved_px: Floats) -> Floats:
    """Standard error of one movement of each sheet, (sheet,); slips are too few to matter to a median."""
    away = moved_px - nan_median(moved_px)
    noise = nan_median(np.abs(away)) / NORMAL_MEDIAN
    usual = noise[np.isfinite(noise)]
    floor = max(0.1 * float(np.median(usual)), 1e-6) if usual.size else 1.0
    return np.asarray(np.maximum(np.where(np.isfinite(noise), noise, np.inf), floor))


def _common(steps: _Steps, pattern: Floats, noise: Floats) -> tuple[Floats, Floats, float]:
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


def _shortest_half(values: Floats) -> tuple[float, float]:
    """Middle and standard deviation of what is not a slip, though slips be nearly half of all movements.

    From the shortest interval that holds half the values (Rousseeuw & Leroy 1988).
    """
    ordered = np.sort(values)
    half = len(ordered) // 2
    length = ordered[half:] - ordered[: len(ordered) - half]
    k = int(np.argmin(length))
    return float(ordered[k : k + half + 1].mean()), float(length[k]) / (2 * NORMAL_MEDIAN)


def _find_steps(above: Floats, error: Floats, creep: float, settings: ClockSettings) -> tuple[Ints, Ints]:
    """First and last movement of each step.

    In a stick the sheets creep inwards, or rest where the machine does: only what goes outwards is a step.
    """
    outward = above + min(creep, 0.0)
    part = outward > settings.step_part_significance * error
    edges = np.diff(np.r_[0, part.astype(np.int8), 0])
    first, last = np.flatnonzero(edges > 0), np.flatnonzero(edges < 0) - 1
    height = _sums(above, first, last)
    sudden = np.maximum.reduceat(np.r_[outward, -np.inf], np.stack([first, last + 1], axis=1).ravel())[::2]
    padded = np.r_[0.0, above, 0.0]
    clear = (sudden > settings.step_significance * error[first]) & (
        np.minimum(padded[first], padded[last + 2]) > -settings.bad_frame_return * height
    )
    if clear.any():
        clear &= height > 0.1 * np.percentile(height[clear], 90)
    return _with_other_part(above, settings.step_part_significance * error, first[clear], last[clear])


def _with_other_part(above: Floats, least: Floats, first: Ints, last: Ints) -> tuple[Ints, Ints]:
    """Extend steps of one movement by the neighbour that shows another part, though less than the creep.

    A part exceeds the next movement further away: there may be no creep at all before a slip.
    """
    single, least = first == last, least[first]
    padded = np.maximum(np.r_[0.0, 0.0, above, 0.0, 0.0], 0.0)
    before, after = padded[first + 1] - padded[first], padded[last + 3] - padded[last + 4]
    earlier = single & (before > least) & (before >= after)
    later = single & (after > least) & (after > before)
    return first - earlier, last + later


def _sums(values: Floats, first: Ints, last: Ints) -> Floats:
    total = np.r_[0.0, np.cumsum(values)]
    return np.asarray(total[last + 1] - total[first])


def _pattern(steps: _Steps, pattern: Floats, first: Ints, last: Ints) -> Floats:
    """How far each sheet moves in the median step, the outermost tenth being 1; as it was without steps."""
    if len(first) < 3:
        return pattern
    clean = first[first == last] if np.sum(first == last) >= 3 else first
    typical = nan_median(steps.moved_px[clean])
    typical = np.maximum(np.where(np.isfinite(typical), typical, 0.0), 0.0)
    top = float(np.percentile(typical, 90))
    return np.asarray(typical / top) if top > 0 else pattern


def _placed(time_s: Floats, above: Floats, first: Ints, last: Ints) -> tuple[Floats, Floats, float]:
    """(time, standard error) of each step, and the share of the frame time during which light is collected.

    That share is how often a step shows as a frame in between. A step without such a frame lies anywhere in
    the time between exposures; one with it lies within the exposure, and the part of the step that the frame
    shows gives the place.
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
