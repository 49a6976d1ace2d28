"""Stick-slip events, one row per stick from its valley to its peak; and the smallest slip that is found."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import pandas as pd
import xarray as xr

from vision.data import (
    FORCE,
    ForceMetadata,
    LowpassHow,
    StickMetadata,
    changed_settings,
    joined_flags,
    load_unit_text,
    record,
)
from vision.errors import InputError, check_positive, check_within
from vision.force.corners import Corners, Extremes, find_corners, find_extremes, is_slow
from vision.force.lines import fit_broken_lines, fit_lines, fit_polynomials
from vision.force.lowpass import Lowpass, find_lowpass
from vision.force.recording import flags_of, is_compression
from vision.force.regime import Regime, doubts, find_regime, is_unloading, lasting_falls, speed_warnings
from vision.force.settings import ForceSettings
from vision.force.signal import (
    Signal,
    SlowNoise,
    find_hum,
    is_hum,
    ringing_period,
    rms_of,
    smoothed_samples,
    with_slow_noise,
)
from vision.force.slips import (
    Slips,
    find_slips,
    missed_slips,
    size_gap,
    stick_drops,
    stick_lines,
    stick_middles,
)
from vision.force.sticks import filter_length, measure_sticks
from vision.numeric import Bools, Floats, Ints, nan_median, spread_indices


def find_stick_slip(
    force: xr.Dataset,
    *,
    threshold_N: float | None = None,
    machine_stiffness_N_per_mm: float | None = None,
    lowpass_s: float | Literal["auto"] = 0.0,
    average_s: float | Literal["auto"] = 0.0,
    settings: ForceSettings = ForceSettings(),
) -> pd.DataFrame:
    """Return the stick-slip events of a recording, one row per complete stick: valley (v) to peak (p).

    The initial elastic loading has no valley and the stick after the last slip no peak, so neither has a row;
    the first slip is in the attributes.

    Parameters
    ----------
    force
        As from `read_force`.
    threshold_N
        Smallest drop that counts as a slip; by default found from the noise (`find_slips`).
    machine_stiffness_N_per_mm
        Corrects d for the stretch of the machine, d - F/K_machine; by default d is not corrected.
    lowpass_s
        Time constant of the load cell's low-pass to correct for; 0 for none, "auto" for the one that the
        transients after slips prove, if any. One that was found is proposed (``lowpass_proposed_s``).
    average_s
        Time over which the load is averaged, for a load cell that rings after slips; 0 for none, "auto" for
        one period of the ringing, if there is any. It excludes `lowpass_s`.
    settings
        See `ForceSettings`.

    Returns
    -------
    Table with the columns of ``events.csv`` in order, then further ones, which `vision.data.STICKS`
    describes, and the attributes of `vision.data.StickMetadata`. F_v and F_p are the ends, at valley and
    peak, of a line through the central part of the stick, with the curvature common to all sticks and limited
    to what was recorded; beside slow slips they are the recorded extremes. K is the slope of the central
    half, K1 and K2 those before and after a knee. Lengths and stiffness are NaN where d is unknown.
    ``flag`` is "ok" or, joined by "+", what is wrong within the stick (gap, nan, saturated, repeated,
    backwards, few, falling, unloading) or beside it (jump, still), what the instrument cannot give (short,
    negative), how it was measured (slow), and what the whole recording shows (oscillation, cycles, noise).

    Raises
    ------
    InputError
        For a load in compression, a crosshead that goes back in the sticks, too few samples per slip, fewer
        than two slips, falls that are all unloading, or a `lowpass_s` or `average_s` that cannot be.

    Notes
    -----
    Errors of forces and lengths contain the noise, the position error of the corners, that of the curvature
    of the sticks, what was recorded beyond the lines, the length of slips of half a sample or more, and
    the effect of a low-pass that was found but not corrected. Source: paper, section on stick-slip features.
    """
    FORCE.check(force)
    check_within("a number from 0", 0, math.inf, threshold_N=threshold_N)
    check_positive(machine_stiffness_N_per_mm=machine_stiffness_N_per_mm)
    recorded = ForceMetadata.of(force)
    source = recorded.source
    _check_times(force, source)
    signal = Signal.of(force, settings)
    swing_s = ringing_period(signal.load, settings) * signal.interval_s
    calm = _without_ringing(signal, swing_s, threshold_N, settings)
    ringing_s = swing_s if calm else math.nan
    seconds = _average(average_s, ringing_s, lowpass_s)
    # Slips that were searched to tell ringing, or smooth noise, are not searched again.
    known = calm if seconds == ringing_s else None
    if not seconds:
        known = _slips_in_smooth_noise(signal, threshold_N, lowpass_s, settings)
        if known and calm and not _as_many(known[1], calm[1]):
            known = None  # what looked like smooth noise is the ringing
    signal = known[0] if known else signal.average(seconds, settings)
    still_rings = signal.averaged * signal.interval_s < 0.7 * ringing_s  # not where there is no ringing
    rings = _proposal(ringing_s) if still_rings else ""
    _check_load(signal, source, rings, settings)
    signal, slips = known or _slips(signal, threshold_N, settings)
    searched = slips
    if calm and not seconds:
        signal, slips = _without_swings(signal, slips, calm, settings)
    if slips.edge.size < 2:
        raise _too_few_slips(signal, slips, source, rings)
    period_s = slips.period * signal.interval_s
    _check_lowpass(lowpass_s, period_s, source)
    analysis = _analyse_slips(signal, slips, lowpass_s, settings)
    unloading = is_unloading(signal.travel, analysis.extremes)
    events, shares = _measure(signal, analysis, 1 / (machine_stiffness_N_per_mm or np.inf), settings)
    _check_direction(events, unloading, source)
    lasting = lasting_falls(slips, events["F_p_N"].to_numpy(float), settings)
    events = events.assign(flag=_all_flags(events, analysis, unloading, lasting, signal, slips, settings))
    unit = load_unit_text(force)
    swings_s = math.nan if calm else swing_s
    warnings = doubts(events, analysis.regime, signal, slips, unit, rings, swings_s, lasting, settings)
    if slips is not searched and rings not in warnings:
        warnings = [rings, *warnings]
    if threshold_N is None and analysis.regime.name == "stick-slip" and not (rings or signal.averaged):
        warnings += _missed_warnings(signal, slips, analysis, unit, settings)
    if recorded.separation_from == "speed" and analysis.regime.name == "stick-slip":
        warnings += speed_warnings(events, settings)
    more = {
        "warnings": [*warnings, *_filter_warnings(events, analysis, settings)],
        "ringing_s": ringing_s,
        "machine_stiffness_N_per_mm": machine_stiffness_N_per_mm or math.nan,
        "central_part": settings.central_part,
    }
    events.attrs |= _metadata(signal, slips, analysis, shares | more).attrs()
    return record(
        events,
        "find_stick_slip",
        threshold_N=threshold_N,
        machine_stiffness_N_per_mm=machine_stiffness_N_per_mm,
        lowpass_s=lowpass_s,
        average_s=average_s,
        settings=changed_settings(settings),
    )


def _without_ringing(
    signal: Signal, period_s: float, threshold_N: float | None, settings: ForceSettings
) -> tuple[Signal, Slips] | None:
    """Return the averaged signal and its slips if an oscillation of this period, NaN for none, is ringing.

    Without it the load shows stick-slip, whose slips are several periods apart.
    """
    if math.isnan(period_s):
        return None
    calm, slips = _slips(signal.average(period_s, settings), threshold_N, settings)
    if slips.edge.size < 2 or slips.period < settings.ringing_between * calm.averaged:
        return None
    corners = find_corners(calm, slips, settings=settings)
    extremes = find_extremes(calm.clean, calm.sigma, corners.middle, corners.length, corners.drop)
    regime = find_regime(calm.clean, slips, extremes, settings)
    return (calm, slips) if regime.name == "stick-slip" else None


def _without_swings(
    signal: Signal, slips: Slips, calm: tuple[Signal, Slips], settings: ForceSettings
) -> tuple[Signal, Slips]:
    """Return the slips without those that are swings of the load, and the signal with the ringing as noise:
    only those that the mean over a period, `calm`, shows as well, where that shows another number."""
    averaged, seen = calm
    if _as_many(slips, seen):
        return signal, slips
    slips = seen.at_first_fall(signal.clean, math.ceil(averaged.averaged))
    return with_slow_noise(signal, slips, settings), slips


def _as_many(slips: Slips, seen: Slips) -> bool:
    """Return whether these are as many as the slips that are seen without ringing, within 5 %."""
    return abs(slips.edge.size - seen.edge.size) <= 0.05 * seen.edge.size


def _slips_in_smooth_noise(
    signal: Signal, threshold_N: float | None, lowpass_s: float | str, settings: ForceSettings
) -> tuple[Signal, Slips] | None:
    """Return the samples as far apart as a filter has smoothed the noise, and the slips in them.

    All samples are returned, with this noise, where a low-pass is given or the transients after slips prove
    one, which need them. None where samples are not alike, or where too few would be left in a stick.
    """
    every = smoothed_samples(signal.clean, settings)
    if every == 1:
        return None
    thin, slips = _slips(signal.thinned(every, settings), threshold_N, settings)
    if slips.edge.size < 2 or slips.period <= 3 * settings.few_samples:
        return None
    fine = slips.in_every_sample(signal.clean, every)
    full = signal.with_noise_of(thin)
    given = not isinstance(lowpass_s, str) and lowpass_s > 0
    if given or find_lowpass(full, fine, find_corners(full, fine, settings=settings), settings).proven:
        return full, fine
    return thin, slips


def _proposal(ringing_s: float) -> str:
    """Return that the load oscillates, and what to do."""
    return (
        f"the load oscillates at {1 / ringing_s:.3g} Hz (ringing after slips, or hum): give `average_s` "
        f"auto, or {ringing_s:.3g}, to average it over one period"
    )


def _average(average_s: float | str, ringing_s: float, lowpass_s: float | str) -> float:
    """Return the time over which to average the load.  Raises: InputError."""
    if average_s == "auto":
        seconds = 0.0 if math.isnan(ringing_s) else ringing_s
    elif isinstance(average_s, str) or not 0 <= average_s < math.inf:
        raise InputError("`average_s`", "seconds from 0, or auto", f"'{average_s}'")
    else:
        seconds = average_s
    if seconds and lowpass_s:
        raise InputError("`average_s`", "no `lowpass_s` beside it", f"{lowpass_s}", "leave one of them out")
    return seconds


def _check_load(signal: Signal, source: str, rings: str, settings: ForceSettings) -> None:
    """Raise InputError for a load in compression, or with too many spikes.  rings: that the load rings."""
    # A negative load that falls suddenly is a pull whose load cell was zeroed under load.
    if is_compression(signal.load) and np.sum(np.diff(signal.clean) ** 3) > 0:
        wanted = "a pull (positive load)"
        advice = "if tension counts negative on this machine give `columns` load=-NAME"
        raise InputError(source, wanted, f"a median load of {np.median(signal.load):.3g}", advice)
    if signal.is_spike.mean() > settings.most_spikes:
        if rings:
            raise InputError(source, "stick-slip", f"{100 * signal.is_spike.mean():.0f} % of spikes", rings)
        found = f"{100 * signal.is_spike.mean():.0f} %: the load jumps from sample to sample"
        advice = "record more samples per second: 30 or more in each stick, and several in each ringing"
        raise InputError(source, f"at most {100 * settings.most_spikes:g} % of spikes", found, advice)


def _too_few_slips(signal: Signal, slips: Slips, source: str, rings: str) -> InputError:
    """Return the error for fewer than two slips, whose cause is the average, ringing, sampling or threshold.
    Sticks of a few samples rise by most steps from sample to sample, and falls are frequent."""
    if signal.averaged and not rings:
        return InputError(
            source,
            "at least two slips",
            f"{slips.edge.size} in the load averaged over {signal.averaged * signal.interval_s:.3g} s",
            "give a shorter `average_s`, one period of the ringing",
        )
    step = np.diff(signal.load)
    usual = float(np.mean(np.abs(step)))
    if np.abs(step.sum()) >= 0.9 * np.abs(step).sum():
        found = f"one that goes from {signal.load[0]:.3g} to {signal.load[-1]:.3g} without turning back"
        return InputError(source, "a load that falls at slips", found, "name its column: `columns` load=…")
    falls = step < -usual
    if np.median(step) > 0.3 * usual and np.mean(falls) > 0.1:
        return InputError(
            source,
            "30 samples or more in each stick",
            f"falls of {-np.median(step[falls]):.3g} every {1 / np.mean(falls):.2g} samples",
            rings or "record more samples per second",
        )
    return InputError(
        source,
        "at least two slips",
        f"{slips.edge.size} drops between fitted lines above {slips.threshold:.3g} "
        f"(noise {signal.sigma:.2g})",
        rings or "lower `threshold_N` if smaller drops are slips",
    )


def _check_times(force: xr.Dataset, source: str) -> None:
    """Raise InputError where many samples share one time, or those of one's own arrays are not in order.

    They would be left out; of a file, a warning says how many go back.
    """
    flags = flags_of(force)
    back = np.count_nonzero(flags == "backwards")
    if back and "flag" not in force:
        raise InputError(source, "samples in order of time", f"{back} earlier than one before", "sort them")
    changes = np.diff(force["load_N"].to_numpy(), prepend=np.nan) != 0
    shared = float(np.mean((flags == "repeated") & changes))
    if shared > 0.3:
        raise InputError(
            source,
            "a time for every sample",
            f"{100 * shared:.0f} % of the samples at the time of the one before: it is written too coarsely",
            "give the sampling rate in place of the time, such as `columns` time=100Hz",
        )


def _check_direction(events: pd.DataFrame, unloading: Bools, source: str) -> None:
    """Raise InputError where the crosshead goes back in all falls of the load, or in the sticks."""
    if unloading.all():
        wanted = "stick-slip: the force falls while the crosshead goes on"
        raise InputError(source, wanted, f"{unloading.size} falls, all while it goes back: push–pull cycles")
    stick_length = float(nan_median(events["stick_length_um"].to_numpy(float)))
    if stick_length < 0:
        wanted = "a crosshead that goes on while the load rises"
        advice = "if the displacement counts the other way give `columns` displacement=-NAME"
        raise InputError(source, wanted, f"one that goes back, by {-stick_length:.3g} µm in a stick", advice)


def _check_lowpass(lowpass_s: float | str, period_s: float, source: str) -> None:
    """Raise InputError for a time constant that is not shorter than the time from slip to slip."""
    if isinstance(lowpass_s, str):
        if lowpass_s != "auto":
            raise InputError("`lowpass_s`", "seconds or auto", f"'{lowpass_s}'")
    elif not 0 <= lowpass_s < period_s:
        wanted = f"a time constant from 0 to the time between slips, {period_s:.3g} s"
        found = f"{lowpass_s:g} s"
        raise InputError(source, wanted, found, "give `lowpass_s` in seconds, or auto to have it found")


@dataclass(frozen=True)
class _SlipAnalysis:
    """What is known about a recording before its sticks are measured."""

    corners: Corners  # corrected for the low-pass, if it is corrected for
    extremes: Extremes  # of the load as recorded, about its own slips, which lag behind the corrected corners
    regime: Regime
    found: Lowpass  # low-pass that the transients suggest
    how: LowpassHow  # as ``lowpass_how`` of `StickMetadata`
    lengthened: float  # samples by which a filter may have lengthened every slip (`filter_length`)
    by_filter: float  # the same, but 0 where a low-pass or an average explains it


def _analyse_slips(
    signal: Signal, slips: Slips, lowpass_s: float | str, settings: ForceSettings
) -> _SlipAnalysis:
    """Find corners, extremes, knees and the regime, and decide which low-pass to correct for."""
    given = 0.0 if isinstance(lowpass_s, str) else lowpass_s / signal.interval_s
    bent = _have_knees(signal, slips, given, settings)
    corners = find_corners(signal, slips, two_slopes=bent, settings=settings)
    extremes = find_extremes(signal.clean, signal.sigma, corners.middle, corners.length, corners.drop)
    regime = find_regime(signal.clean, slips, extremes, settings)
    if signal.averaged:
        extremes = _without_average(extremes, signal, slips, settings)
    found = Lowpass()
    if not given and not signal.averaged and regime.name == "stick-slip":
        found = find_lowpass(signal, slips, corners, settings)
        if found.samples and not bent:
            # The transients of the low-pass may hide the knees.
            bent = _have_knees(signal, slips, found.samples, settings)
            if bent:
                corners = find_corners(signal, slips, two_slopes=bent, settings=settings)
                found = find_lowpass(signal, slips, corners, settings)
    how: LowpassHow = "given" if given else "recorded" if lowpass_s == 0 else "none"
    lengthened = 0.0 if given else filter_length(signal, corners, settings)
    if given:
        corners = find_corners(signal, slips, lowpass=given, two_slopes=bent, settings=settings)
    elif found.doubt and not lengthened:
        found = Lowpass()  # it would have lengthened the ends of the slips
    elif lowpass_s == "auto" and found.corners is not None:
        corners, how = (found.corners, "found") if found.proven else (corners, "doubtful")
    if corners.lowpass:
        lengthened = filter_length(signal, corners, settings)
    explained = corners.lowpass or found.samples or signal.averaged
    return _SlipAnalysis(corners, extremes, regime, found, how, lengthened, 0.0 if explained else lengthened)


def _without_average(extremes: Extremes, signal: Signal, slips: Slips, settings: ForceSettings) -> Extremes:
    """Return the extremes of the load before it was averaged twice: the averages begin to fall by the
    averaged time before a sudden slip, but at first more slowly than the stick goes on rising."""
    lines = signal.averaged * np.nan_to_num(stick_lines(signal.clean, slips.edge, settings).slope)
    average_s = signal.averaged * signal.interval_s
    slip_s = signal.time_at(np.asarray(slips.edge - 0.5, np.float64))
    long = np.diff(np.r_[signal.time[0], slip_s, signal.time[-1]]) > 3 * average_s
    levels = (np.interp(slip_s + k * average_s, signal.time, signal.clean) for k in (-2, -1, 1, 2))
    early, before, after, late = levels
    before = np.where(long[:-1], before - early, lines[:-1])
    after = np.where(long[1:], late - after, lines[1:])
    before, after = (np.clip(part, 0, slips.drop) for part in (before, after))
    return replace(
        extremes,
        highest=extremes.highest + before - 0.5 * before**2 / slips.drop,
        lowest=extremes.lowest - after + 0.5 * after**2 / slips.drop,
    )


def _slips(signal: Signal, threshold_N: float | None, settings: ForceSettings) -> tuple[Signal, Slips]:
    """Return the slips, fewer than two of which are drops above the noise alone, and the signal with its slow
    noise."""
    signal, slips = _search_slips(signal, threshold_N, settings)
    if slips.edge.size < 2:
        return signal, slips
    signal = with_slow_noise(signal, slips, settings)
    if threshold_N is None:
        signal, slips = _above_swings(signal, slips, settings)
        signal, slips = _above_slow_noise(signal, slips, settings)
    return signal, slips


def _search_slips(signal: Signal, threshold_N: float | None, settings: ForceSettings) -> tuple[Signal, Slips]:
    """Return the slips, which are searched in the load without hum, and the signal with the hum as noise."""
    # Averages contain little hum, and their noise is not white.
    hum = [] if signal.averaged else find_hum(signal.clean, settings)
    while True:
        quiet = signal.without(hum, settings)
        slips = find_slips(quiet.clean, quiet.noise, threshold=threshold_N, settings=settings)
        # If a line was a harmonic of the slips, its subtraction has displaced them: search again without it.
        kept = [line for line in hum if is_hum(line, signal.clean, slips, settings)]
        if len(kept) == len(hum):
            break
        hum = kept
    if not hum:
        return signal, slips
    rms = rms_of(hum)
    hum.sort(key=lambda line: line.rms, reverse=True)
    noisy = replace(signal, hum=hum, sigma=np.hypot(quiet.sigma, rms), noise=np.hypot(quiet.noise, rms))
    return noisy, slips


def _above_swings(signal: Signal, slips: Slips, settings: ForceSettings) -> tuple[Signal, Slips]:
    """Leave out drops that are swings of smoothed noise: most are as slow as the rises beside them, and a gap
    in the sizes separates them from slips. The noise is then the scatter about the stick lines."""
    gap = size_gap(slips.drop, settings.slow_gap, 1 - 3 / slips.drop.size)
    small = slips.drop < gap
    if small.any():
        slow = is_slow(find_corners(signal, slips, settings=settings), settings)
        if slow[small].mean() >= 0.5:
            slips = slips.kept(~small, gap, "gap")
            spread = float(nan_median(stick_lines(signal.clean, slips.edge, settings).spread))
            signal = with_slow_noise(replace(signal, sigma=max(signal.sigma, spread)), slips, settings)
    return signal, slips


def _above_slow_noise(signal: Signal, slips: Slips, settings: ForceSettings) -> tuple[Signal, Slips]:
    """Return the slips that exceed noise that is not white, and the signal with that noise measured again: by
    four errors of the drop between two lines once the drops of the noise are gone, or five with the lines
    found first."""
    keep = np.ones(slips.edge.shape, dtype=bool)
    while signal.slow is not None:
        # Drops of the noise cut the sticks short. Without them the lines are longer, the noise is known
        # better, and drops that are the largest of many by chance are smaller. But so are those of slips
        # beside a slip that was taken for noise: a drop that was clear at first stays.
        first = slips.drop / _drop_errors(signal.slow, slips.edge, signal.clean.size, settings)
        edge = slips.edge[keep]
        drop = stick_drops(signal.clean, edge, settings)
        now = drop / _drop_errors(signal.slow, edge, signal.clean.size, settings)
        above = (now >= settings.threshold_sigmas) | (first[keep] >= settings.split_sigmas)
        if above.all() or np.sum(above) < 2:
            break
        keep[keep] = above
        least = max(settings.threshold_sigmas * float(np.median(drop / now)), slips.threshold)
        clear = slips.kept(keep, least, "noise")
        signal = with_slow_noise(signal, clear, settings)
    return signal, slips if keep.all() else clear


def _drop_errors(slow: SlowNoise, edge: Ints, size: int, settings: ForceSettings) -> Floats:
    """Return the standard error, in slow noise, of the drop between the lines on both sides of each edge."""
    length = settings.line_part * np.maximum(np.diff(np.r_[0, edge, size]), 3)
    some = np.geomspace(length.min(), length.max(), 24)
    variance = np.interp(length, some, [slow.of_drop(each, 1 / settings.line_part) for each in some])
    return np.asarray(np.sqrt(0.5 * (variance[:-1] + variance[1:])), np.float64)


def _have_knees(signal: Signal, slips: Slips, lag: float, settings: ForceSettings) -> bool:
    """Return whether the median stick is steeper before a knee than after it.

    The pulling speed plays no part: sticks at 4.9975 and at 5.0000 mm/min are the same.
    """
    start, stop = (at[1:-1] for at in stick_middles(slips.edge, signal.clean.size, settings))
    some = spread_indices(start.size, 60)
    index = np.arange(signal.clean.size, dtype=float)
    broken = fit_broken_lines(index, signal.clean, start[some], stop[some], lag=lag)
    known = np.isfinite(broken.gain) & (broken.first > 0) & (broken.second > 0)
    if known.sum() < max(2, 0.5 * known.size):
        return False
    ratio = float(np.median(broken.first[known] / broken.second[known]))
    # A stick that bends gradually is fitted better by a polynomial.
    begin, end = start[some][known], stop[some][known]
    _, residual, row = fit_polynomials(signal.clean, begin, end)
    smooth = fit_lines(index, signal.clean, begin, end).squares / np.maximum(
        np.bincount(row, residual**2), np.finfo(float).tiny
    )
    if not lag and np.median(smooth) > np.median(broken.gain[known]):
        return False
    return float(np.median(broken.gain[known])) > settings.knee_gain and ratio > settings.knee_ratio


def _measure(
    signal: Signal, analysis: _SlipAnalysis, compliance: float, settings: ForceSettings
) -> tuple[pd.DataFrame, dict[str, float]]:
    """Return the events, and what `StickMetadata` says of a low-pass.

    If a low-pass was found but not corrected, it also says what the correction would change, and the errors
    include it.
    """
    corners, found = analysis.corners, analysis.found
    known = bool(corners.lowpass or found.proven or signal.averaged)

    def measured(corners: Corners, lengthened: float, known: bool) -> pd.DataFrame:
        extremes = analysis.extremes
        return measure_sticks(signal, corners, extremes, compliance, settings, lengthened, known)

    events = measured(corners, analysis.lengthened, known)
    if corners.lowpass or found.corners is None:
        return events, {}
    other = measured(found.corners, filter_length(signal, found.corners, settings), known=True)
    # The bias is equal in all events, so that it is added linearly, not in quadrature.
    pairs = [(f"{name}_N", f"{name}_err_N") for name in ("F_v", "F_p", "dF")]
    pairs += [("stick_length_um", "stick_length_err_um"), ("K_N_per_mm", "K_err_N_per_mm")]
    bias = {error: (other[value] - events[value]).abs().fillna(0.0) for value, error in pairs}
    errors = {error: events[error] + added for error, added in bias.items()}
    share = other["K_N_per_mm"] / events["K_N_per_mm"] - 1
    changes = {
        "lowpass_dF_share": other["dF_N"] / events["dF_N"] - 1,
        "lowpass_K_share": share,
        "lowpass_peak_mm": (other["F_p_N"] - events["F_p_N"]) / events["K_N_per_mm"],
    }
    finite = {name: change[np.isfinite(change)] for name, change in changes.items()}
    medians = {name: float(change.median()) for name, change in finite.items() if len(change)}
    return events.assign(**errors, K_lowpass_share=share), medians


def _missed_warnings(
    signal: Signal, slips: Slips, analysis: _SlipAnalysis, unit: str, settings: ForceSettings
) -> list[str]:
    """Return how many slips were missed, as far as the steps within the sticks tell; see `missed_slips`.

    The transients of a low-pass are steps, too.
    """
    if analysis.corners.lowpass or analysis.found.proven:
        return []
    start, stop = analysis.corners.valley[:-1], analysis.corners.peak[1:]
    missed, height = missed_slips(signal.clean, signal.noise, slips.edge, start, stop, settings)
    missed -= slips.left_out.size  # of which there is a warning
    if missed < settings.missed_share * slips.edge.size:
        return []
    return [
        f"at least {missed} slips of about {height:.2g} {unit} were missed beside {slips.edge.size} found, "
        "as sticks contain so many more steps downward than upward: less noise or more samples per second "
        f"find them; `threshold_N` {2 * height:.2g} leaves out all small slips"
    ]


def _filter_warnings(events: pd.DataFrame, analysis: _SlipAnalysis, settings: ForceSettings) -> list[str]:
    """Return that a filter, which is not corrected, may have smoothed much of the sticks.

    An oscillation has none.
    """
    slip, stick = events["slip_time_s"].median(), (events["t_p_s"] - events["t_v_s"]).median()
    smoothed = analysis.lengthened if analysis.found.doubt else analysis.by_filter
    if analysis.regime.name == "oscillation" or not (smoothed and slip > settings.filter_share * stick):
        return []
    return [
        f"slips last {slip / stick:.2g} times as long as sticks, and the load is not level at their ends, or "
        "its noise is as smooth, as where a filter has smoothed it: F_p and ΔF, and K, Λ̂, N̂ and Y_eff, may "
        "be wrong by more than their errors; filter the load less, or pull more slowly"
    ]


def _metadata(signal: Signal, slips: Slips, analysis: _SlipAnalysis, more: dict[str, Any]) -> StickMetadata:
    """Return what later stages need to know of the slips and of the low-pass, and `more`."""
    tau, found, peak = analysis.corners.lowpass, analysis.found, analysis.corners.peak
    first, last = signal.time_at(peak[[0, -1]])
    return StickMetadata(
        noise_N=signal.sigma,
        threshold_N=slips.threshold,
        threshold_how=slips.threshold_how,
        period_samples=slips.period,
        every=signal.every,
        spikes=int(signal.is_spike.sum()),
        lowpass_s=tau * signal.interval_s,
        lowpass_how=analysis.how,
        lowpass_proposed_s=found.samples * signal.interval_s if found.samples and not tau else float("nan"),
        lowpass_proven=found.proven,
        lowpass_doubt=found.doubt,
        filter_s=analysis.by_filter * signal.interval_s,
        average_s=signal.averaged * signal.interval_s,
        two_slopes=analysis.corners.two_slopes,
        bend_share=float(analysis.corners.shape.ends[0, 0]),
        hum_Hz=signal.hum[0].frequency / signal.interval_s if signal.hum else float("nan"),
        hum_N=rms_of(signal.hum),
        regime=analysis.regime.name,
        fall_over_rise=analysis.regime.fall_over_rise,
        first_slip_s=float(first),
        first_slip_N=float(signal.clean[int(peak[0])]),
        last_slip_s=float(last),
        **more,
    )


def _all_flags(
    events: pd.DataFrame,
    analysis: _SlipAnalysis,
    unloading: Bools,
    lasting: Bools,
    signal: Signal,
    slips: Slips,
    settings: ForceSettings,
) -> list[str]:
    """Add flags for what contradicts stick-slip and for what the instrument cannot resolve."""
    regime, found = analysis.regime.name, analysis.found
    response_s = (analysis.corners.lowpass or (found.samples if found.proven else 0.0)) * signal.interval_s
    duration = (events["t_p_s"] - events["t_v_s"]).to_numpy(float)
    # k + 1 slips lie before stick k. Where a jump reverses a drop, or a drop a jump, that drop is no slip,
    # but ends the stick with the jump and the one before or after it. Many jumps make all drops doubtful.
    away = np.arange(len(events))[:, np.newaxis] + 1 - slips.before_jumps(settings)
    length = np.nan_to_num(analysis.corners.length) + 2 * signal.averaged
    no_fall = _without_fall(signal.clean, slips, length, settings)
    jump = (np.abs(away) <= 1).any(axis=1) | no_fall[:-1] | no_fall[1:]
    marks = {
        "jump": jump | (jump.mean() >= 0.5) | lasting[:-1] | lasting[1:],
        "unloading": unloading[:-1] | unloading[1:],
        "short": duration < settings.short_stick * response_s,
        "negative": events["F_v_N"].to_numpy(float) < -3 * signal.sigma,
        regime: np.full(len(events), regime != "stick-slip"),
    }
    both = zip(events["flag"], joined_flags(marks), strict=True)
    return ["+".join(flag for flag in flags if flag != "ok") or "ok" for flags in both]


def _without_fall(y: Floats, slips: Slips, length: Floats, settings: ForceSettings) -> Bools:
    """Return at which slips the load does not fall: within a slip's length, six samples at least, it is
    nowhere lower by `least_fall` of the drop than before. An impulse of a few samples tilts a line of its
    stick, which is then divided in the middle of its rise."""
    reach = np.clip(np.ceil(length), 6, None).astype(np.int64)
    before, edge = np.maximum(slips.edge - reach, 0), np.maximum(slips.edge, 1)
    after = np.minimum(edge + reach, y.size)
    if y.size - edge[-1] < 0.5 * slips.period:
        after[-1] = y.size  # so little follows that the last edge is known less well
    highest, lowest = (
        work.reduceat(y, np.stack([begin, np.minimum(end, y.size - 1)], axis=1).ravel())[::2]
        for work, begin, end in ((np.maximum, before, edge), (np.minimum, edge, after))
    )
    return np.asarray(highest - lowest < settings.least_fall * slips.drop, np.bool_)
