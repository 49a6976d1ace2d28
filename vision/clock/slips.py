"""When slips happen: drops of the force, corrected for the low-pass, and outward steps of the sheets."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
import xarray as xr

from vision.clock.settings import ClockSettings
from vision.data import StickMetadata, StripMetadata
from vision.errors import InputError
from vision.force.lines import flat_ranges
from vision.force.recording import good_samples
from vision.numeric import NORMAL_MEDIAN, Floats, Ints, nan_median

# --- as the load cell sees them -----------------------------------------------------------------------------


def force_slips(
    force: xr.Dataset, sticks: pd.DataFrame, *, settings: ClockSettings = ClockSettings()
) -> pd.DataFrame:
    r"""Middle of every slip, in order, the one that ends the initial loading first.

    Parameters
    ----------
    force
        From `read_force`.
    sticks
        From `find_stick_slip`.
    settings
        See `ClockSettings`.

    Returns
    -------
    A table, empty where `sticks` is, with the columns

    - time_s: on the force clock;
    - error_s: standard error of each by itself;
    - drop_N: how far the force fell, the mean of the slip's own drop and of the rises before and after it, as
      the sheets may follow either; NaN for the first and last slip, which are known from one side only.

    ``attrs``: delay_s, which was subtracted, and lag_s, by what all times together may be wrong.

    Notes
    -----
    The steepest drop finds a slip; the mean time of its drop, sample by sample, places it to a part of a
    sampling interval. The load cell's low-pass delays that mean by its time constant :math:`\tau` and makes
    the drop asymmetric: the impulse response :math:`e^{-t/\tau}/\tau` has a third central moment of
    :math:`2\tau^3`, while a slip itself, symmetric, has none. So the mean third moment of all slips gives the
    delay.
    """
    good = good_samples(force)
    time, load = good["time_s"].to_numpy().astype(float), good["load_N"].to_numpy().astype(float)
    begin, end, drop = _bounds(sticks)
    if not len(begin) or len(time) < 3:
        return pd.DataFrame(dict.fromkeys(("time_s", "error_s", "drop_N"), np.empty(0)))
    interval = float(np.median(np.diff(time)))
    steepest, of = np.unique(_steepest(time, load, begin, end), return_index=True)
    middle, delay, duration = _mean_times(time, load, steepest, settings)
    order = np.argsort(middle)
    error = np.full(len(order), 0.5 * interval / np.sqrt(12))
    table = pd.DataFrame({"time_s": (middle - delay)[order], "error_s": error, "drop_N": drop[of][order]})
    # What remains of the delay, of the sampling, and of the shape of a drop.
    lag = np.multiply((0.25, 0.12, 0.02), (delay, interval, duration))
    table.attrs |= {"delay_s": delay, "lag_s": float(np.sqrt(lag @ lag))}
    return table


def _bounds(sticks: pd.DataFrame) -> tuple[Floats, Floats, Floats]:
    """Begin, end and drop of each slip; the last one ends, as the table does not say, as the others do.

    The drop is the mean of the fall and of the rises beside it; NaN for the first and the last slip.
    """
    if not len(sticks):
        return np.empty(0), np.empty(0), np.empty(0)
    valley, peak = sticks["t_v_s"].to_numpy(float), sticks["t_p_s"].to_numpy(float)
    first = StickMetadata.of(sticks).first_slip_s
    usual = float(np.median(valley[1:] - peak[:-1])) if len(peak) > 1 else 0.0
    begin, end = np.r_[first, peak], np.r_[valley, peak[-1] + max(usual, 0.0)]
    known = np.isfinite(begin) & np.isfinite(end)
    top, bottom = (np.asarray(sticks[name], np.float64) for name in ("F_p_N", "F_v_N"))
    rise, fall = top - bottom, top[:-1] - bottom[1:]
    drop = np.r_[np.nan, 0.5 * fall + 0.25 * (rise[:-1] + rise[1:]), np.nan]
    return begin[known], end[known], drop[known]


def _steepest(time: Floats, load: Floats, begin: Floats, end: Floats) -> Ints:
    """The sample before the steepest drop of each slip, looked for three samples beyond its ends."""
    around = 3
    start = np.clip(np.searchsorted(time, begin) - around, 0, len(time) - 2)
    stop = np.clip(np.searchsorted(time, end) + around, start + 1, len(time) - 1)
    row, index = flat_ranges(start, stop)
    order = np.lexsort((load[index] - load[index + 1], row))
    return np.asarray(index[order[np.flatnonzero(np.diff(np.r_[row[order], -1]) != 0)]])


def _mean_times(
    time: Floats, load: Floats, steepest: Ints, settings: ClockSettings
) -> tuple[Floats, float, float]:
    """(mean time of each drop, delay of the low-pass, time from 1 % to 1 % of the steepest drop), s."""
    spacing = float(np.median(np.diff(steepest))) if len(steepest) > 1 else 0.0
    # At most 100 samples, which keeps memory small at high sampling rates.
    reach = int(np.clip(settings.window_of_period * spacing, 1, 100))
    around = np.arange(-reach, reach + 1)
    inside = (steepest >= reach) & (steepest < len(time) - 1 - reach)
    middle = 0.5 * (time[steepest] + time[steepest + 1])
    if not inside.any():
        return middle, 0.0, 0.0
    index = steepest[inside, None] + around
    drop = load[index] - load[index + 1]
    drop = drop - np.median(drop, axis=1, keepdims=True)  # the stick's own rise
    first, last = _drop_extent(drop.sum(axis=0), reach, settings.drop_end)
    drop, when = drop[:, first : last + 1], (0.5 * (time[index] + time[index + 1]))[:, first : last + 1]
    total = np.maximum(drop.sum(axis=1), drop.max(axis=1))
    total[total <= 0] = 1.0  # a constant load has no drop to place
    away = when - middle[inside, None]
    shift = np.clip((drop * away).sum(axis=1) / total, away[:, 0], away[:, -1])
    middle[inside] += shift
    third = float((drop * (away - shift[:, None]) ** 3).sum() / total.sum())
    return middle, float(np.cbrt(max(third, 0.0) / 2)), float(np.median(away[:, -1] - away[:, 0]))


def _drop_extent(profile: Floats, centre: int, end: float) -> tuple[int, int]:
    """First and last place around the centre where the sum of all drops exceeds `end` of its height there."""
    small = np.flatnonzero(profile < end * profile[centre])
    first = small[small < centre].max(initial=-1) + 1
    last = small[small > centre].min(initial=len(profile)) - 1
    return int(first), int(last)


# --- as the camera sees them --------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Steps:
    """Movement between consecutive usable frames."""

    time_s: Floats  # (F,)
    moved_px: Floats  # (F-1, sheet), outward, NaN where either position is missing
    uniform: Floats  # what a movement of the whole picture looks like in outward terms, (sheet,)


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
    n = np.asarray(tracks["n"].values, np.float64)
    pattern = n / n.max()  # to begin with: outer sheets move more
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
    each = np.stack([pattern, steps.uniform]) / noise**2  # two products of matrices hold all five sums
    pp, pu, uu = np.stack([each[0] * pattern, each[0] * steps.uniform, each[1] * steps.uniform]) @ known.T
    pm, um = each @ np.where(known, steps.moved_px, 0.0).T
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
