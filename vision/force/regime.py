"""What a recording shows: stick-slip, an oscillation, cycles of loading and unloading, or noise; and why its
events may not be stick-slip."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.lib.stride_tricks import sliding_window_view

from vision.data import RegimeName, has_flag
from vision.force.corners import Extremes
from vision.force.lines import fit_lines
from vision.force.settings import ForceSettings
from vision.force.signal import Signal, noise_sigma, step_between
from vision.force.slips import Slips, upward_share
from vision.numeric import Bools, Floats, flat_ranges, nan_median, quantum, white_noise


@dataclass(frozen=True)
class Regime:
    """What kind of motion a recording shows."""

    # "stick-slip"; "oscillation": rises and falls are equally long, and rises are rounded; "cycles": both are
    # equally long and straight; "noise": the load jumps upward about as far as it drops
    name: RegimeName
    fall_over_rise: float  # median duration of falls over that of rises
    upward_share: float  # median of the largest upward jumps within sticks over the median drop


def find_regime(y: Floats, slips: Slips, extremes: Extremes, settings: ForceSettings) -> Regime:
    """Return whether a load shows stick-slip, an oscillation, cycles of loading and unloading, or noise.

    A line and half a cosine are fitted to each rise and fall of the load, and show which of them are straight
    or rounded. Slow slips of stick-slip are rounded as those of an oscillation, but the sticks are straight.
    """
    rise, fall = extremes.rise, extremes.fall[1:]
    known = (rise >= 4) & (fall >= 2)
    upward = upward_share(y, slips.edge, settings)
    name: RegimeName = "noise" if upward > settings.upward_share else "stick-slip"
    if known.sum() < 2:
        return Regime(name, float("nan"), upward)
    ratio = float(np.median(fall[known] / rise[known]))
    equal = settings.equal_share < ratio < 1 / settings.equal_share
    v, p, next_v = extremes.valley[:-1], extremes.peak[1:], extremes.valley[1:]
    rounded_rise = _roundness(y, v[known], p[known]) > 1
    rounded_fall = _roundness(y, p[known], next_v[known]) > 1
    if equal and rounded_rise:
        name = "oscillation"
    elif equal and not rounded_rise and not rounded_fall:
        name = "cycles"
    return Regime(name, ratio, upward)


def _roundness(y: Floats, start: Floats, stop: Floats) -> float:
    """Return the median ratio of the squared residuals of a line to those of half a cosine."""
    row, index = flat_ranges(start.astype(np.int64), stop.astype(np.int64) + 1)
    u = (index - start[row]) / (stop - start)[row]
    first = np.searchsorted(row, np.arange(start.size + 1))
    line, cosine = (
        fit_lines(shape, y[index], first[:-1], first[1:]).squares
        for shape in (u, 0.5 * (1 - np.cos(np.pi * u)))
    )
    return float(np.median(line / np.maximum(cosine, 1e-300)))


def is_unloading(travel: Floats, extremes: Extremes) -> Bools:
    """Return whether the crosshead goes back during each fall, by more than a fifth of its last advance and
    four errors of the difference of two samples.

    travel: separation at each sample; where it is NaN, no fall counts as unloading.
    """
    index = np.arange(travel.size)
    at_peak, at_valley = (np.interp(at, index, travel) for at in (extremes.peak, extremes.valley))
    forward = np.abs(at_peak - np.r_[travel[0], at_valley[:-1]])
    return np.asarray((at_peak - at_valley) > np.maximum(0.2 * forward, 4 * np.sqrt(2) * noise_sigma(travel)))


_FLAGGED = {
    "unloading": "lie beside a fall while the crosshead went back",
    "jump": "contain or adjoin an upward jump of the load, as large as slips, an impulse, or a fall after "
    "which it stays lower: noise, knocks, ringing, a loose cable, or another range or zero",
    "falling": "contain a fall of the load, as of a slip that lasts longer than they do and was not found",
    "still": "contain or precede a rest of the machine, which moved more slowly than in those around, or the "
    "displacement had ended",
    "short": "are shorter than the load cell's own response allows",
    "negative": "have a negative friction force: check the load cell's zero",
}
"""Flags of which a warning is given, and what sticks with this flag do."""


def doubts(
    events: pd.DataFrame,
    regime: Regime,
    signal: Signal,
    slips: Slips,
    unit: str,
    rings: str,
    swing_s: float,
    lasting: Bools,
    settings: ForceSettings,
) -> list[str]:
    """Return why the recording, or a part of its events, may not be stick-slip.

    unit: of the load.  rings: that the load rings, which then explains an oscillation and jumps.  swing_s:
    period of an oscillation that cannot be averaged; NaN for none.  lasting: the `lasting_falls`.
    """
    if rings and regime.name != "stick-slip":
        return [rings, *_load_warnings(signal, slips, events, unit)]
    range_N, ratio = np.ptp(np.percentile(signal.clean, [1, 99])), f"{regime.fall_over_rise:.2g}"
    of_all = {
        "oscillation": f"an oscillation, not stick-slip: falls last {ratio} times as long as rises, which "
        f"are rounded, and the load varies by {range_N:.3g} {unit}",
        "cycles": f"not stick-slip: falls last {ratio} times as long as rises and are equally straight, as "
        "in cycles of loading and unloading",
        "noise": "stick-slip is not clearly visible: within the sticks the load jumps upward by "
        f"{regime.upward_share:.2g} times the median drop, as noise does, so all events are flagged noise; "
        "a larger `threshold_N` leaves out the smaller drops",
    }
    lines = [of_all[regime.name]] if regime.name in of_all else []
    if rings and has_flag(events["flag"], "jump").any():
        lines.append(rings)
    period_s = slips.period * signal.interval_s
    if swing_s < 0.7 * period_s and regime.name == "stick-slip":
        lines.append(
            f"the load oscillates with a period of {swing_s:.2g} s, a large part of the {period_s:.2g} s "
            "between slips: some events may be its swings, and averages would cut off the sticks"
        )
    for column, values, what, unit_of_steps in (
        ("stick_length_um", 1e3 * signal.travel, "lengths and K are not resolved: the displacement", "µm"),
        ("dF_N", signal.load, "drops and K are not resolved: the load", unit),
    ):
        step, stick = step_between(values), float(nan_median(events[column].to_numpy(float)))
        if step > 0.3 * stick:  # about three steps in a stick, or fewer
            lines.append(
                f"{what} has steps of {step:.3g} {unit_of_steps}, sticks are {stick:.3g} {unit_of_steps}"
            )
    lines += _displacement_warnings(signal, events) + _periodic_warnings(signal, events, settings)
    lines += slips.warnings(unit, settings) + _load_warnings(signal, slips, events, unit)
    lines += _fall_warnings(signal, slips, lasting, unit)
    for word, meaning in _FLAGGED.items():
        if count := int(has_flag(events["flag"], word).sum()):
            lines.append(f"{count} of {len(events)} sticks {meaning} (flag {word})")
    return lines


def _displacement_warnings(signal: Signal, events: pd.DataFrame) -> list[str]:
    """Return that noise of the displacement makes K, over half a stick, uncertain by more than 5 %: the
    stated error of K then grows with K itself, so that the fits give large K too little weight."""
    if len(signal.travel) < 3:
        return []
    noise_um = 1e3 * white_noise(signal.travel)
    samples = ((events["t_p_s"] - events["t_v_s"]) / (2 * signal.interval_s)).clip(lower=1.0)
    error = np.sqrt(12 / samples) * noise_um / (events["stick_length_um"] / 2)
    share = float(nan_median(error.to_numpy(float)))
    if not share > 0.05:
        return []
    return [
        f"the displacement's noise of {noise_um:.2g} µm makes K of a stick uncertain by {100 * share:.0f} %: "
        "Λ̂, N̂ and Y_eff may be wrong by several of their errors; record the crosshead's position, or "
        "average the displacement"
    ]


def _periodic_warnings(signal: Signal, events: pd.DataFrame, settings: ForceSettings) -> list[str]:
    """Return that the displacement has a periodic error, which makes K of single sticks wrong by 1 % or more.

    One line, with five periods or more, then holds most of what the displacement deviates from a straight
    line, beyond its steps. The crosshead itself may also move unevenly, but K does not change with that: it
    falls as the displacement that is measured in a stick grows. Lines of up to three sticks in a period may
    be the stick-slip itself, of a displacement measured on the sample.
    """
    if not np.isfinite(signal.travel).all() or len(events) < 8:
        return []
    time = signal.time - signal.time.mean()
    rest = signal.travel - np.polynomial.Polynomial.fit(time, signal.travel, 1)(time)
    power = np.abs(np.fft.rfft(np.hanning(rest.size) * rest)) ** 2
    line = 5 + int(np.argmax(power[5:]))
    share = float(power[line - 2 : line + 3].sum() / max(power[1:].sum(), np.finfo(float).tiny))
    size_um, period_um = (
        1e3 * float(np.sqrt(2 * share) * np.std(rest)),
        1e3 * float(np.ptp(signal.travel)) / line,
    )
    change = 2 * np.pi * size_um / max(period_um, np.finfo(float).tiny)
    sticks = time.size / line / float((events["t_p_s"] - events["t_v_s"]).median() / signal.interval_s)
    small = size_um < 1e3 * quantum(signal.travel) or change < settings.periodic_change
    if share < settings.periodic_share or small or sticks < 3:
        return []
    pace = events["stick_length_um"] / (events["t_p_s"] - events["t_v_s"])
    both = np.stack([pace, events["K_N_per_mm"]]).astype(float)
    steps = np.diff(np.log(both[:, (both > 0).all(axis=0)]), axis=1)  # K falls slowly in a test
    if not np.sum(steps[0] * steps[1]) < -settings.periodic_share * np.sum(steps[0] ** 2):
        return []
    return [
        f"the displacement has a periodic error of ±{size_um:.2g} µm every {period_um:.3g} µm, as of a screw "
        f"or a scale: Λ_st and K of single sticks may be wrong by {100 * change:.2g} %, whatever their "
        "errors; the fits average over it"
    ]


def speed_warnings(events: pd.DataFrame, settings: ForceSettings) -> list[str]:
    """Return where the machine may have rested, or changed its speed, if d is calculated from one speed.

    The load rises in time with K V, and K changes slowly. What one stick takes longer for its rise than those
    around, as a way at the given speed, counts from half a usual stick and `rest_mm` on. A change of the
    speed is one by `speed_change`, beyond the errors, from five sticks to the next five, and half of it is
    more than the changes beside it.
    """
    if len(events) < 3:
        return []
    begin, d_mm = events["t_v_s"].to_numpy(float), events["d_v_mm"].to_numpy(float)
    whole_s, way_mm = np.diff(begin), np.diff(d_mm)
    rise, error = (events[name].to_numpy(float)[:-1] for name in ("dF_N", "dF_err_N"))
    pace = pd.Series(rise / np.where(whole_s > 0, whole_s, np.nan))
    around = pace.rolling(5, center=True, min_periods=1).median()
    lost_mm = (way_mm * (1 - (pace + 3 * error / whole_s) / around)).to_numpy()
    lines = []
    if (rest := np.flatnonzero(lost_mm > max(settings.rest_mm, 0.5 * float(nan_median(way_mm))))).size:
        k, more = rest[0], f" and {rest.size - 1} times later" if rest.size > 1 else ""
        lines.append(
            f"the load rises too little for the time from {begin[k]:.4g} s to {begin[k + 1]:.4g} s{more}: if "
            f"the machine rested, d = d0 + V t is {np.sum(lost_mm[rest]):.2g} mm too large afterwards; "
            "record the displacement, or cut the recording there"
        )
    # Of a stick and the four before it, from the fifth on.
    five = np.log(pace.where(pace > 0).rolling(5).median().to_numpy()[4:])
    unsure = pd.Series(error / rise).rolling(5).median().to_numpy()[4:]
    if five.size <= 15:
        return lines
    step = five[10:-5] - five[5:-10]
    beside = np.fmax(np.abs(five[5:-10] - five[:-15]), np.abs(five[15:] - five[10:-5]))
    clear = np.abs(step) - 2 * np.fmax(unsure[10:-5], unsure[5:-10]) > np.log(settings.speed_change)
    changes = np.where(clear & (np.abs(step) > 2 * beside), np.abs(step), 0.0)
    if changes.any():
        k = int(np.argmax(changes))
        lines.append(
            f"from {begin[10 + k]:.4g} s on the load rises {np.exp(step[k]):.2g} times as fast as before: if "
            "the machine changed its speed, d = d0 + V t is wrong, and Λ_st and K with it; record the "
            "displacement, or save both parts in files of their own"
        )
    return lines


def lasting_falls(slips: Slips, peak: Floats, settings: ForceSettings) -> Bools:
    """Return after which slips the load does not regain its level, as after a zero set under load or a part
    that broke: the `peak` of the sticks is lower from there on.

    A line with a step through the peaks of ten sticks on either side falls there by more than half of the
    drop, and by `split_sigmas` of its error; so do the two peaks beside it, and the last ones are still lower
    by most of it.
    """
    reach, lasting = 10, np.zeros(slips.edge.size, np.bool_)
    if peak.size <= 2 * reach:
        return lasting
    window = np.delete(sliding_window_view(peak, 2 * reach + 1), reach, axis=1)
    x = np.delete(np.arange(-reach, reach + 1.0), reach)
    design = np.stack([np.ones_like(x), x, x > 0], axis=1)
    fit = window @ np.linalg.pinv(design).T
    spread = np.sqrt(np.sum((window - fit @ design.T) ** 2, axis=1) / (x.size - 3))
    step, error = -fit[:, 2], spread * np.sqrt(np.linalg.inv(design.T @ design)[2, 2])
    left = np.median(window[:, :reach], axis=1) - np.median(window[:, -3:], axis=1)
    tested = slice(reach + 1, reach + 1 + step.size)  # stick k - 1 ends, with its peak, at slip k
    at_once = window[:, reach - 1] - window[:, reach]  # peaks may also wander from stick to stick
    clear = np.minimum(step, at_once) > np.maximum(0.5 * slips.drop[tested], settings.split_sigmas * error)
    lasting[tested] = clear & (left > 0.75 * step)
    return lasting


def _fall_warnings(signal: Signal, slips: Slips, lasting: Bools, unit: str) -> list[str]:
    """Return which falls may be no slips: those that are not made up for, or five times those around."""
    around = np.delete(sliding_window_view(np.pad(slips.drop, 5), 11), 5, axis=1).max(axis=1)
    large = slips.drop > 5 * around
    large[-1:] = False  # it may be the end of the test
    first = lasting & ~np.r_[False, lasting[:-1]]  # a step fits the slip beside it nearly as well
    return [
        f"the load falls by {slips.drop[k]:.3g} {unit} at {signal.time[slips.edge[k]]:.4g} s, "
        f"{slips.drop[k] / around[k]:.2g} times as far as at the slips around"
        f"{', and stays lower' * bool(lasting[k])}: a change of range or zero, or a part that broke"
        for k in np.flatnonzero(large | first)[:5]
    ]


def _load_warnings(signal: Signal, slips: Slips, events: pd.DataFrame, unit: str) -> list[str]:
    """Return that the noise changes, and that the load at rest is not 0.

    The load rests in the first or last period of the slips if it changes there by a tenth of itself at most.
    """
    lines = []
    quiet, loud = signal.noise.min(), signal.noise.max()
    if quiet < loud:
        lines.append(
            f"the noise changes between {quiet:.2g} and {loud:.2g} {unit} within the recording: a change of "
            "the amplifier's range, whose forces then differ by a factor, or of what disturbs the load cell"
        )
    peak, part = float(events["F_p_N"].median()), max(int(slips.period), 8)
    for load, when in (
        (signal.clean[:part], "before the pull"),
        (signal.clean[-part:], "at the end, after the pull"),
    ):
        first, last = np.mean(load[: part // 2]), np.mean(load[part // 2 :])
        level = 0.5 * (first + last)
        rests = abs(last - first) < 0.1 * abs(level) and level < 0.2 * abs(peak)
        if rests and abs(level) > 0.005 * abs(peak):
            lines.append(
                f"the load rests at {level:.3g} {unit} {when}, {100 * level / peak:.1f} % of the usual peak: "
                "if nothing was pulled then, the load cell's zero is wrong by as much, and with it 𝒯0 and μ"
            )
    return lines
