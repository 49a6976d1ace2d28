"""Times of the slips: drops of the force, corrected for the low-pass, and outward steps of the sheets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pandas as pd
import xarray as xr

from vision.clock.settings import ClockSettings
from vision.data import StickMetadata, StripMetadata
from vision.errors import InputError
from vision.force.recording import good_samples
from vision.force.signal import averaged
from vision.memory import in_two_threads, row_parts
from vision.numeric import NORMAL_MEDIAN, Floats, Ints, flat_ranges, nan_median

SLIPS_AT_ONCE = 256  # compared with the frames before them: thousands would take as much memory as the film

# --- slips of the load cell ---------------------------------------------------------------------------------


def force_slips(
    force: xr.Dataset, sticks: pd.DataFrame, *, settings: ClockSettings = ClockSettings()
) -> pd.DataFrame:
    r"""Find the time of every slip in the force, beginning with the one that ends the initial loading.

    Returns
    -------
    A table, empty where `sticks` is, without the slips during which samples are lost; with the columns time_s
    (middle of the slip on the force clock, in order), error_s (its random standard error), drop_N (mean of
    its own drop and of the rises before and after it, because the sheets may follow either; NaN for the first
    and last slip) and lag_s (standard error that is common to all times, the same in each row).

    Notes
    -----
    The mean time of the drop, weighted by the fall in each sample, gives the slip's time to a fraction of a
    sampling interval. The load cell's low-pass delays that mean by its time constant :math:`\tau`: its
    impulse response :math:`e^{-t/\tau}/\tau` has a third central moment of :math:`2\tau^3`, while a slip is
    symmetric and has none. So the mean third moment of all slips gives the delay. A filter with a symmetric
    response shows only in their width, as slips that last do: `lag_s` contains `unseen_delay` times the
    standard deviation that neither the low-pass nor the sampling explains.

    A load that rings is averaged over one period T, twice. Ringing delays the mean time by a hundredth of T,
    and the variance of the averaged drop is :math:`T^2 (1/6 - 1/2\pi^2)`. Where the load swings back after
    the drop, but its period is not known, the drop that is timed is late by up to half of the swing, which
    `lag_s` contains.
    """
    good = good_samples(force)
    time, load = good["time_s"].to_numpy().astype(float), good["load_N"].to_numpy().astype(float)
    begin, end, drop = _bounds(sticks)
    none = pd.DataFrame(dict.fromkeys(("time_s", "error_s", "drop_N", "lag_s"), np.empty(0)))
    if not len(begin) or len(time) < 3:
        return none
    facts = StickMetadata.of(sticks)
    average_s = float(np.nan_to_num(facts.average_s or facts.ringing_s))
    if average_s:
        load = averaged(time, load, average_s)  # the first swing of a load that rings would be the drop
    interval = float(np.median(np.diff(time)))
    steepest, of = np.unique(_steepest(time, load, begin, end), return_index=True)
    around = np.clip(steepest[:, None] + np.arange(-10, 11), 0, len(time) - 2)
    longest = settings.longest_drop * np.median(time[around + 1] - time[around], axis=1)
    timed = time[steepest + 1] - time[steepest] < longest
    if not timed.any():
        return none
    steepest, of = steepest[timed], of[timed]
    drops = _measure_drops(time, load, steepest, longest[timed], average_s, settings)
    # What widens a drop besides the low-pass of that delay, the sampling, and the averaging of the ringing.
    known = drops.delay_s**2 + interval**2 / 6 + average_s**2 * (1 / 6 - 0.5 / np.pi**2)
    other_s = np.sqrt(max(0.0, drops.width_s**2 - known))
    order = np.argsort(drops.middle_s)
    # A drop within one interval may lie anywhere in it; one that spreads over several is timed by its mean.
    error = np.full(len(order), max(drops.largest, 0.5) * interval / np.sqrt(12))
    # Remaining errors of the delay, of a filter that is faster than the sampling, of the shape of a drop or
    # half a swing, and of a filter with a symmetric response: it widens a drop as a slip that lasts does, but
    # delays it. Last, that of a low-pass behind which the load cell rings no less visibly.
    shape, unseen = (0.5, 0.0) if drops.swings else (0.02, settings.unseen_delay)
    factors = 0.25, 0.3, shape, unseen, settings.behind_ringing
    lag = np.multiply(factors, (drops.delay_s, interval, drops.duration_s, other_s, average_s))
    return pd.DataFrame(
        {
            "time_s": (drops.middle_s - drops.delay_s)[order],
            "error_s": error,
            "drop_N": drop[of][order],
            "lag_s": float(np.sqrt(lag @ lag)),
        }
    )


def _bounds(sticks: pd.DataFrame) -> tuple[Floats, Floats, Floats]:
    """Begin, s, end, s, and drop, N, of each slip; the last one is taken to last as long as the others."""
    if not len(sticks):
        return np.empty(0), np.empty(0), np.empty(0)
    valley, peak = sticks["t_v_s"].to_numpy(float), sticks["t_p_s"].to_numpy(float)
    first = StickMetadata.of(sticks).first_slip_s
    typical = float(np.median(valley[1:] - peak[:-1])) if len(peak) > 1 else 0.0
    begin, end = np.r_[first, peak], np.r_[valley, peak[-1] + max(typical, 0.0)]
    known = np.isfinite(begin) & np.isfinite(end)
    top, bottom = (np.asarray(sticks[name], np.float64) for name in ("F_p_N", "F_v_N"))
    rise, fall = top - bottom, top[:-1] - bottom[1:]
    drop = np.r_[np.nan, 0.5 * fall + 0.25 * (rise[:-1] + rise[1:]), np.nan]
    return begin[known], end[known], drop[known]


def _steepest(time: Floats, load: Floats, begin: Floats, end: Floats) -> Ints:
    """Index of the sample before the steepest drop of each slip, up to three samples beyond its ends."""
    beyond = 3
    start = np.clip(np.searchsorted(time, begin) - beyond, 0, len(time) - 2)
    stop = np.clip(np.searchsorted(time, end) + beyond, start + 1, len(time) - 1)
    row, index = flat_ranges(start, stop)
    order = np.lexsort((load[index] - load[index + 1], row))
    last_of_row = np.flatnonzero(np.diff(np.r_[row[order], -1]) != 0)  # the largest drop of each slip
    return np.asarray(index[order[last_of_row]])


class _Drops(NamedTuple):
    """The drops of the load at the slips, in time; but for the first, of all drops together."""

    middle_s: Floats  # mean time of each drop, weighted by the fall in each sample
    delay_s: float = 0.0  # of the low-pass
    duration_s: float = 0.0  # to where a drop ends (`drop_end`)
    width_s: float = 0.0  # standard deviation in time
    largest: float = 1.0  # part of a drop within its steepest interval
    swings: bool = False  # the load swings back after a drop, with a period that is not known


def _measure_drops(
    time: Floats, load: Floats, steepest: Ints, longest: Floats, average_s: float, settings: ClockSettings
) -> _Drops:
    """Measure the drops around their steepest intervals.

    longest: interval from which there is a gap, for each drop, s.
    average_s: time over which the load was averaged, twice, 0 if it was not.
    """
    spacing = float(np.median(np.diff(steepest))) if len(steepest) > 1 else 0.0
    # At most 100 samples, which limits the memory at high sampling rates.
    reach = int(np.clip(settings.window_of_period * spacing, 1, 100))
    if average_s:  # the drop, and the transient of a low-pass; what lies beyond is noise
        reach = int(np.clip(np.ceil(2 * average_s / float(np.median(np.diff(time)))), 1, reach))
    around = np.arange(-reach, reach + 1)
    inside = (steepest >= reach) & (steepest < len(time) - 1 - reach)
    middle = 0.5 * (time[steepest] + time[steepest + 1])
    index = steepest[:, None] + around
    # Beside a gap the mean time is that of what was recorded.
    whole = np.max(np.diff(time)[np.clip(index, 0, len(time) - 2)], axis=1)
    inside &= whole < longest
    if not inside.any():
        return _Drops(middle)
    index = index[inside]
    drop = load[index] - load[index + 1]
    drop = drop - np.median(drop, axis=1, keepdims=True)  # without the rise of the stick phase
    profile = drop.sum(axis=0)  # it ends on either side of the steepest interval
    small = np.flatnonzero(profile < settings.drop_end * profile[reach])
    first = int(small[small < reach].max(initial=-1)) + 1
    last = int(small[small > reach].min(initial=len(profile))) - 1
    swings = not average_s and bool(profile[last:].min() < -settings.swing_back * profile[reach])
    drop, when = drop[:, first : last + 1], (0.5 * (time[index] + time[index + 1]))[:, first : last + 1]
    total = np.maximum(drop.sum(axis=1), drop.max(axis=1))
    total[total <= 0] = 1.0  # a constant load has no drop
    since_steepest = when - middle[inside, None]
    shift = np.clip((drop * since_steepest).sum(axis=1) / total, since_steepest[:, 0], since_steepest[:, -1])
    middle[inside] += shift
    # About the mean of all drops: noise moves that of one along with it, which would hide its width.
    since_mean = since_steepest - (drop * since_steepest).sum() / total.sum()
    second, third = (float((drop * since_mean**power).sum() / total.sum()) for power in (2, 3))
    return _Drops(
        middle,
        delay_s=float(np.cbrt(max(third, 0.0) / 2)),
        duration_s=float(np.median(since_steepest[:, -1] - since_steepest[:, 0])),
        width_s=float(np.sqrt(max(second, 0.0))),
        largest=float(np.median(drop.max(axis=1) / total)),
        swings=swings,
    )


# --- slips of the camera ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Steps:
    """Movement between consecutive usable frames."""

    time_s: Floats  # (F,)
    moved_px: Floats  # outward movement, (F-1, sheet), NaN where either position is missing
    # Outward movement of each sheet when the whole picture moves by 1 px, (1 or 2, sheet).  With one side in
    # view the first row is 0: sheets that slip alike look like a picture that moves.
    uniform: Floats


def video_slips(tracks: xr.Dataset, *, settings: ClockSettings = ClockSettings()) -> pd.DataFrame:
    r"""Find the common outward steps of all sheets, in order of time.

    Missing positions and frames are left out.

    Returns
    -------
    A table, empty without steps, with the columns time_s, error_s (standard error), step_px (of a typical
    outer sheet), step_err_px, frames (number of movements between frames that the step spans) and spread_s
    (time from the first to the last sheet in a slip, the same in each row).

    Raises
    ------
    InputError
        If the frames have no times or fewer than three can be used.

    Notes
    -----
    From frame to frame :math:`f`, sheet :math:`n` moves outwards by

    .. math:: \Delta x_{nf} = a_f p_n + s_f u_n,

    where the pattern :math:`p_n` is the movement of each sheet in a slip, and :math:`s_f` is a shift of the
    whole picture (drift, vibration); :math:`u_n = \pm 1` is the side of the sheet. Both are fitted by least
    squares, weighted by the noise of the sheets; with one side in view the shift only if the slips then stand
    out more. A slip is an :math:`a_f` that exceeds the creep significantly. During an exposure it shows as a
    frame in an intermediate position, which gives its time; between two exposures it may lie anywhere.
    """
    steps = _steps(tracks)
    n = np.asarray(tracks["n"].values, np.float64)
    pattern = n / n.max()  # initial guess: outer sheets move more
    noise = _noise(steps.moved_px)
    for _ in range(3):
        above, error, creep = _common_movement(steps, pattern, noise, settings)
        first, last = _find_steps(above, error, creep, settings)
        pattern = _updated_pattern(steps, pattern, first, last)
    time_s, error_s = _step_times(steps.time_s, above, first, last)
    return pd.DataFrame(
        {
            "time_s": time_s,
            "error_s": error_s,
            "step_px": _sums(above, first, last),
            "step_err_px": error[first],
            "frames": last - first + 1,
            "spread_s": _spread_of_sheets(steps, noise, first, last, settings),
        }
    )


def _steps(tracks: xr.Dataset) -> _Steps:
    """Movement between consecutive frames that show sheets and have increasing times."""
    x = np.asarray(tracks["x_px"].values, np.float64)
    time = np.asarray(tracks["time_s"].values, np.float64)
    side = np.asarray(tracks["side"].values, np.float64)
    about = StripMetadata.of(tracks).source
    if not np.isfinite(time).any():
        raise InputError(about, "a time for each frame", "none", "give `fps` or `timestamps`")
    seen = np.isfinite(x).any(axis=1)
    # A time stamp that does not increase is stale: the frame's true time is not known.
    before = np.maximum.accumulate(np.r_[-np.inf, np.where(np.isfinite(time), time, -np.inf)])[:-1]
    good = np.flatnonzero(seen & (time > before))
    if len(good) < 3:
        raise InputError(about, "at least 3 frames with sheets and rising times", f"{len(good)}")
    moved = np.diff(x if len(good) == len(x) else x[good], axis=0)
    moved *= side
    two_sided = bool((side < 0).any() and (side > 0).any())
    return _Steps(time[good], moved, side[None] if two_sided else np.stack([np.zeros_like(side), side]))


def _noise(moved_px: Floats) -> Floats:
    """Standard deviation of the movements of each sheet, (sheet,), by a median, which few slips affect."""
    deviation = moved_px - nan_median(moved_px)
    noise = nan_median(np.abs(deviation, out=deviation)) / NORMAL_MEDIAN
    known = noise[np.isfinite(noise)]
    floor = max(0.1 * float(np.median(known)), 1e-6) if known.size else 1.0
    return np.asarray(np.maximum(np.where(np.isfinite(noise), noise, np.inf), floor))


def _common_movement(
    steps: _Steps, pattern: Floats, noise: Floats, settings: ClockSettings
) -> tuple[Floats, Floats, float]:
    """Size of the pattern in each movement above the creep, its standard error, (F-1,) each, and the creep.

    A uniform shift of all sheets is fitted at the same time; with one side in view, if the slips then stand
    out more. The error alone does not tell: where all sheets slip alike, the shift takes the slips with it.
    """

    def prominence(fit: tuple[Floats, Floats, float]) -> float:
        significance = fit[0] / fit[1]
        return float(np.nan_to_num(nan_median(significance[significance > settings.step_significance])))

    fits = [_fit_pattern(steps, pattern, uniform, noise) for uniform in steps.uniform]
    return max(fits, key=prominence)


def _fit_pattern(
    steps: _Steps, pattern: Floats, uniform: Floats, noise: Floats
) -> tuple[Floats, Floats, float]:
    """The result of `_common_movement` for this shift of the sheets, (sheet,)."""
    # Sums over the sheets of products of the pattern (p), the uniform shift (u) and the movement (m).
    weighted = np.stack([pattern, uniform]) / noise**2
    products = np.stack([weighted[0] * pattern, weighted[0] * uniform, weighted[1] * uniform])

    def sums(rows: slice) -> Floats:
        known = np.isfinite(steps.moved_px[rows])
        return np.concatenate([products @ known.T, weighted @ np.where(known, steps.moved_px[rows], 0.0).T])

    parts = in_two_threads(sums, row_parts(len(steps.moved_px)))
    pp, pu, uu, pm, um = np.concatenate(parts, axis=1)
    # With one sheet, or without a shift, all movement counts as the pattern.
    separable = pp * uu - pu**2 > 1e-6 * pp * uu
    with np.errstate(divide="ignore", invalid="ignore"):
        size = np.where(separable, (uu * pm - pu * um) / (pp * uu - pu**2), pm / pp)
        error = np.sqrt(np.where(separable, uu / (pp * uu - pu**2), 1 / pp))
    useful = np.isfinite(size) & np.isfinite(error)
    if not useful.any():
        return np.zeros_like(size), np.full_like(error, np.inf), 0.0
    creep, scatter = _shortest_third(size[useful])
    # The noise of the sheets does not explain all scatter: paper also deforms unevenly.
    error = error * max(scatter, 1e-9) / np.median(error[useful])
    return np.where(useful, size - creep, 0.0), np.where(useful, error, np.inf), creep


def _shortest_third(values: Floats) -> tuple[float, float]:
    """Centre and standard deviation of the movements without slips, robust up to two thirds of others: of the
    shortest interval that contains a third of the values (after Rousseeuw & Leroy 1988)."""
    ordered = np.sort(values)
    third = len(ordered) // 3
    length = ordered[third:] - ordered[: len(ordered) - third]
    k = int(np.argmin(length))
    within = 0.4307  # standard deviations from the mean, in which a third of normally distributed values lie
    return float(ordered[k : k + third + 1].mean()), float(length[k]) / (2 * within)


def _find_steps(above: Floats, error: Floats, creep: float, settings: ClockSettings) -> tuple[Ints, Ints]:
    """Indices of the first and last movement of each step, which is outward: in a stick phase the sheets
    creep inwards, or rest."""
    outward = above + min(creep, 0.0)
    part = outward > settings.step_part_significance * error
    edges = np.diff(np.r_[0, part.astype(np.int8), 0])
    first, last = np.flatnonzero(edges > 0), np.flatnonzero(edges < 0) - 1
    height = _sums(above, first, last)
    largest = np.maximum.reduceat(np.r_[outward, -np.inf], np.stack([first, last + 1], axis=1).ravel())[::2]
    padded = np.r_[0.0, above, 0.0]
    reversed_by = -np.minimum(padded[first], padded[last + 2])
    significant = largest > settings.step_significance * error[first]
    accepted = significant & (reversed_by < settings.bad_frame_return * height)
    if accepted.any():
        accepted &= height > 0.1 * np.percentile(height[accepted], 90)
    return _with_neighbours(above, settings.step_part_significance * error, first[accepted], last[accepted])


def _with_neighbours(above: Floats, least: Floats, first: Ints, last: Ints) -> tuple[Ints, Ints]:
    """Extend steps of one movement by the neighbouring movement that shows another part of the step.

    A part must exceed the next movement away from the step by `least`, because there may be no creep at all
    before a slip.
    """
    single, least = first == last, least[first]
    padded = np.maximum(np.r_[0.0, 0.0, above, 0.0, 0.0], 0.0)
    before, after = padded[first + 1] - padded[first], padded[last + 3] - padded[last + 4]
    earlier = single & (before > least) & (before >= after)
    later = single & (after > least) & (after > before)
    return first - earlier, last + later


def _sums(values: Floats, first: Ints, last: Ints) -> Floats:
    """Sums of the values from each first to each last index, inclusive."""
    total = np.r_[0.0, np.cumsum(values)]
    return np.asarray(total[last + 1] - total[first])


def _updated_pattern(steps: _Steps, pattern: Floats, first: Ints, last: Ints) -> Floats:
    """Median movement of each sheet over the steps, with a 90th percentile of 1; unchanged without steps."""
    if len(first) < 3:
        return pattern
    clean = first[first == last] if np.sum(first == last) >= 3 else first
    typical = nan_median(steps.moved_px[clean])
    typical = np.maximum(np.where(np.isfinite(typical), typical, 0.0), 0.0)
    scale = float(np.percentile(typical, 90))
    return np.asarray(typical / scale) if scale > 0 else pattern


def _spread_of_sheets(
    steps: _Steps, noise: Floats, first: Ints, last: Ints, settings: ClockSettings
) -> float:
    r"""Time from the first to the last sheet in a slip that the film permits, s, if all times between are
    equally likely.

    While some sheets have slipped and others have not, sheets differ in the part of their step that they have
    made. The spread is that at which `_expected_variance` is the variance of these parts, of all slips
    together, less the noise of equally long parts of the film before them, plus its standard error: a film
    that is too noisy to show a delay does not exclude it. Half of the intermediate positions count for the
    exposure; where slips follow each other too closely, all of them may be due to the sheets.
    """
    frame_s = float(np.median(np.diff(steps.time_s)))
    intermediate_s = _exposed_share(first, last) * frame_s
    # Sheets that slip early or late need not be part of the step.
    beside = int(np.ceil(settings.reach_s / frame_s))
    apart = np.flatnonzero(np.diff(first, prepend=-np.inf) > 2 * beside)  # a slow slip may be several steps
    if apart.size < 3:
        return intermediate_s
    beside = int(np.clip((np.median(np.diff(first[apart])) - 4) // 4, 1, beside))
    begin, end = first[apart] - beside, np.maximum.reduceat(last, apart) + beside + 1
    length = end - begin
    clear = (begin - length >= np.r_[0, end[:-1]]) & (end <= len(steps.moved_px))
    if clear.sum() < 3:
        return intermediate_s
    moved, weight = steps.moved_px.copy(), noise**-2.0
    if len(steps.uniform) == 1:
        moved *= steps.uniform
        moved -= nan_median(moved, axis=1)[:, None]
        moved *= steps.uniform
    moved -= nan_median(moved)
    np.nan_to_num(moved, copy=False)

    def compare(some: slice) -> Floats:
        """Return what `unlike` and `size` are of some slips, (2, slips)."""
        row, index = flat_ranges(begin[clear][some], end[clear][some])
        start = np.flatnonzero(np.diff(row, prepend=-1))

        def course(of: Ints) -> tuple[Floats, Floats]:
            """Movement of each sheet since the beginning of its slip, and all of it, px, (row, sheet)."""
            so_far = np.cumsum(moved[of], axis=0)
            so_far -= (so_far - moved[of])[start][row]
            return so_far, np.add.reduceat(moved[of], start, axis=0)[row]

        (made, step), (made_before, step_before) = course(index), course(index - length[clear][some][row])
        part = (((made * step) @ weight) / np.maximum((step**2) @ weight, 1e-300))[:, None]
        unlike = ((made - part * step) ** 2 - (made_before - part * step_before) ** 2) @ weight
        size = ((step**2 - step_before**2) @ weight)[start]
        return np.stack([np.add.reduceat(unlike, start), size])

    slips = in_two_threads(compare, row_parts(int(clear.sum()), SLIPS_AT_ONCE))
    unlike, size = np.concatenate(slips, axis=1)
    if not size.sum() > 0:
        return intermediate_s
    variance = unlike.sum() / size.sum()
    error = np.sqrt(np.sum((unlike - variance * size) ** 2)) / size.sum()
    largest = max(variance, 0.0) + error
    spread_s = np.linspace(0.0, 4 * length.max() * frame_s, 1000)
    return float(np.interp(largest * frame_s, _expected_variance(spread_s, intermediate_s / 2), spread_s))


def _expected_variance(spread_s: Floats, exposed_s: float) -> Floats:
    r"""Variance over the sheets of the part of a step that they have made, integrated over time, s.

    Sheets that slip at times t and t + δ differ, in the square, by

    .. math:: h = \delta^2 (1 - \delta / 3E) / E \;\text{up to}\; E, \quad \delta - E / 3 \;\text{beyond},

    where E is the exposure, during which a sheet that slips is seen on its way. The variance is half the mean
    of h over all pairs of times within the spread.
    """
    share = (np.arange(100) + 0.5) / 100  # of the spread; the density of δ falls linearly to 0
    apart_s = spread_s[:, None] * share
    short = apart_s**2 / exposed_s * (1 - apart_s / (3 * exposed_s))
    differs_s = np.where(apart_s < exposed_s, short, apart_s - exposed_s / 3)
    return np.asarray((differs_s * (1 - share)).mean(axis=1))


def _exposed_share(first: Ints, last: Ints) -> float:
    """Exposure over the frame time: the fraction of steps with a frame in an intermediate position."""
    return float((np.sum(last > first) + 0.5) / (len(first) + 1.0))


def _step_times(time_s: Floats, above: Floats, first: Ints, last: Ints) -> tuple[Floats, Floats]:
    """Time and standard error of each step, s: anywhere between two exposures without a frame in an
    intermediate position, else within the exposure, at a time given by the part of the step that the frame
    shows."""
    above = np.maximum(above, 0.0)
    middle, length = 0.5 * (time_s[1:] + time_s[:-1]), np.diff(time_s)
    frame_time = float(np.median(length))
    centroid = _sums(above * middle, first, last) / np.maximum(_sums(above, first, last), 1e-300)
    movements = last - first + 1
    count = len(first)
    share = _exposed_share(first, last)
    share_err_s = frame_time * np.sqrt(share * (1 - share) / (count + 1.0))
    intermediate = time_s[first + 1]
    in_exposure = intermediate + share * (centroid - intermediate)
    unexposed = np.maximum(length[first] - share * frame_time, 0.1 * frame_time) / np.sqrt(12)
    time = np.where(movements == 2, in_exposure, centroid)
    error = np.select(
        [movements == 1, movements == 2], [unexposed, share_err_s / 2 + 0.03 * frame_time], 0.3 * frame_time
    )
    return time, error
