"""Stick-slip events: one row per stick, from its valley to its peak; and how small a slip could be found."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pandas as pd
import xarray as xr

from vision.data import FORCE, STICKS, ForceMetadata, StickMetadata, record
from vision.errors import InputError
from vision.force.corners import Corners, find_corners
from vision.force.lines import BrokenLines, fit_broken_lines, fit_lines, flat_ranges
from vision.force.lowpass import deconvolve_lowpass, estimate_lowpass
from vision.force.recording import find_spikes, is_compression, noise_sigma, usable
from vision.force.settings import DEFAULTS, ForceSettings
from vision.force.slips import Slips, find_slips
from vision.numeric import Bools, Floats, Ints


def find_stick_slip(
    force: xr.Dataset,
    *,
    threshold_N: float | None = None,
    machine_stiffness_N_per_mm: float | None = None,
    two_slopes: bool | None = None,
    lowpass_s: float | None = None,
    settings: ForceSettings = DEFAULTS,
) -> pd.DataFrame:
    """Stick-slip events of a recording, one row per complete stick: valley (v), peak (p), next valley.

    The initial elastic loading has a peak but no valley, and what follows the last slip no peak: neither is a
    row; the first slip is in the attributes.

    Parameters
    ----------
    force
        As from `read_force`.
    threshold_N
        Smallest drop that is a slip; found from the noise if absent (`find_slips`).
    machine_stiffness_N_per_mm
        Corrects d for the machine's own stretch, d - F/K_machine; no correction if absent.
    two_slopes
        Whether sticks are fitted with K1 up to a knee and K2 after it; by default from 5 mm/min on.
    lowpass_s
        Time constant of the load cell's low-pass to correct for, 0 for none; found from the transients after
        slips if absent.
    settings
        See `ForceSettings`.

    Returns
    -------
    Table with the columns of ``events.csv`` in order, then further ones; all are described in
    `vision.data.STICKS`. F_v and F_p are the stick line through the central 80 % extended to valley and peak;
    K is the slope of the central half, with two slopes of what follows the knee. Lengths and stiffness are
    NaN where d is not known. ``flag`` is "ok" or what is wrong within the stick: gap, nan, saturated,
    repeated, backwards, few (samples), falling. Attributes as `vision.data.StickMetadata`.

    Raises
    ------
    InputError
        For a load in compression, fewer than two slips, or a `lowpass_s` below 0 or not shorter than the
        usual time between slips.

    Notes
    -----
    Source: paper, section on stick-slip features.
    """
    FORCE.check(force)
    metadata = ForceMetadata.of(force)
    signal = _Signal.of(force, settings)
    if is_compression(signal.load):
        raise InputError(
            metadata.source,
            "a pull (positive load)",
            f"a median load of {np.median(signal.load):.3g}",
            "if tension counts negative on this machine give `columns` load=-NAME",
        )
    slips = find_slips(signal.clean, signal.sigma, threshold=threshold_N, settings=settings)
    if slips.edge.size < 2:
        raise InputError(
            metadata.source,
            "at least two slips",
            f"{slips.edge.size} drops above {slips.threshold:.3g} (noise {signal.sigma:.2g})",
            "lower `threshold_N` if smaller drops are slips",
        )
    period_s = slips.period * signal.interval_s
    if lowpass_s is not None and not 0 <= lowpass_s < period_s:
        raise InputError(
            metadata.source,
            f"a time constant from 0 to less than from slip to slip, {period_s:.3g} s",
            f"{lowpass_s:g} s",
            "give `lowpass_s` in seconds, or leave it out to have it found",
        )
    fast = metadata.speed_mm_min >= settings.fast_mm_min if two_slopes is None else two_slopes
    corners, tau, how = _corners(signal, slips, fast, lowpass_s, settings)
    events = _measure(signal, corners, tau, fast, 1 / (machine_stiffness_N_per_mm or np.inf), settings)
    first, last = np.interp(corners.peak[[0, -1]], np.arange(signal.time.size), signal.time)
    events.attrs |= StickMetadata(
        noise_N=signal.sigma,
        threshold_N=slips.threshold,
        threshold_how=slips.threshold_how,
        period_samples=slips.period,
        spikes=int(signal.is_spike.sum()),
        lowpass_s=tau * signal.interval_s,
        lowpass_how=how,
        first_slip_s=float(first),
        first_slip_N=float(signal.clean[int(corners.peak[0])]),
        last_slip_s=float(last),
        machine_stiffness_N_per_mm=machine_stiffness_N_per_mm or float("nan"),
        central_part=settings.central_part,
    ).attrs()
    return record(
        events,
        "find_stick_slip",
        threshold_N=threshold_N,
        machine_stiffness_N_per_mm=machine_stiffness_N_per_mm,
        two_slopes=two_slopes,
        lowpass_s=lowpass_s,
        settings=settings.changed(),
    )


@dataclass(frozen=True)
class _Signal:
    """Good samples: time, travel of the sample's end, load as recorded and without spikes.

    damage: for each kind of bad sample, how many of them came before each good one.
    """

    time: Floats
    travel: Floats
    load: Floats
    clean: Floats
    is_spike: Bools
    sigma: float
    damage: dict[str, Ints]

    @classmethod
    def of(cls, force: xr.Dataset, settings: ForceSettings) -> _Signal:
        count = force.sizes["time_s"]
        flags = np.asarray(force["flag"].values, dtype=str) if "flag" in force else np.full(count, "ok")
        good = usable(flags)
        time, travel, load = (force[k].to_numpy()[good].astype(float) for k in ("time_s", "d_mm", "load_N"))
        sigma = noise_sigma(load)
        is_spike, clean = find_spikes(load, sigma, settings=settings)
        kinds = ("gap", "nan", "saturated", "repeated", "backwards")
        damage = {kind: np.cumsum(flags == kind)[good] for kind in kinds if np.any(flags == kind)}
        return cls(time, travel, load, clean, is_spike, sigma, damage)

    @cached_property
    def interval_s(self) -> float:
        """From sample to sample, at the median."""
        return float(np.median(np.diff(self.time)))

    @cached_property
    def spikeless(self) -> Floats:
        """Load with NaN for spikes, so that fits leave them out."""
        return np.where(self.is_spike, np.nan, self.load)


def _corners(
    signal: _Signal, slips: Slips, two_slopes: bool, lowpass_s: float | None, settings: ForceSettings
) -> tuple[Corners, float, str]:
    """Corners of the slips, the low-pass's time constant in samples, and how it is known."""

    def corners(tau: float) -> Corners:
        corrected = deconvolve_lowpass(signal.clean, signal.sigma, slips, tau)
        return find_corners(corrected, two_slopes=two_slopes, settings=settings)

    if lowpass_s is not None:
        tau = lowpass_s / signal.interval_s
        return corners(tau), tau, "given"
    plain = corners(0.0)
    found = estimate_lowpass(signal.clean, plain.transients())
    if found is None or found.gain <= 2.5:  # nothing to look into
        return plain, 0.0, "none"
    # Corrected corners show the transients from their very begin: what is found a second time is believed.
    for _ in range(3):
        again = estimate_lowpass(signal.clean, corners(found.samples).transients(), found.samples)
        if again is None:
            break
        if again.confirms(found, settings):
            return corners(again.samples), again.samples, "found"
        found = again
    return plain, 0.0, "doubtful"


# --- what is measured on each stick, all sticks at once -----------------------------------------------------


@dataclass(frozen=True)
class _Sticks:
    """Valley, peak and knee (NaN: none) of each stick, in samples; lag: time constant of the low-pass."""

    v: Floats
    p: Floats
    knee: Floats
    lag: float
    settings: ForceSettings

    def central(self, part: float) -> tuple[Ints, Ints]:
        """[start, stop) of the central part."""
        margin = 0.5 * (1 - part) * (self.p - self.v)
        return _between(self.v + margin, self.p - margin)

    def one_slope(self, part: float) -> tuple[Ints, Ints]:
        """The same after the knee; before it where it comes late."""
        length = self.p - self.v
        margin, clear = 0.5 * (1 - part) * length, 0.03 * length
        start, stop = self.v + margin, self.p - margin
        early = self.knee - self.v < 0.65 * length
        start = np.where(early, np.fmax(start, self.knee + clear), start)
        return _between(start, np.where(early, stop, np.fmin(stop, self.knee - clear)))

    def broken(self, x: Floats, y: Floats) -> BrokenLines:
        """Lines with a knee through nearly all of each stick."""
        return fit_broken_lines(x, y, *self.central(self.settings.line_part), lag=self.lag)


def _between(start: Floats, stop: Floats) -> tuple[Ints, Ints]:
    return np.ceil(start).astype(np.int64), np.floor(stop).astype(np.int64) + 1


def _measure(
    signal: _Signal,
    corners: Corners,
    lag: float,
    two_slopes: bool,
    compliance: float,
    settings: ForceSettings,
) -> pd.DataFrame:
    """The table, from corners in samples: valley[j] ends slip j, peak[j] begins it.

    lag: time constant of the low-pass in samples.  compliance: of the machine, mm/N.
    """
    index = np.arange(signal.time.size, dtype=float)
    v, p, v_next = corners.valley[:-1], corners.peak[1:], corners.valley[1:]
    sticks = _Sticks(v, p, corners.knee[1:-1], lag, settings)
    t_v, t_p, t_next = (np.interp(at, index, signal.time) for at in (v, p, v_next))
    f_v, f_p, rising = _ends(signal, sticks, t_v, t_p)
    # The machine's stretch is subtracted at the corners: at every sample it would add the load's noise to d.
    d_v = np.interp(v, index, signal.travel) - compliance * f_v
    d_p = np.interp(p, index, signal.travel) - compliance * f_p
    last = np.interp(v_next[-1:], index, signal.travel) - compliance * signal.clean[int(v_next[-1])]
    relative = np.hypot(corners.error[:-1], corners.error[1:]) / (p - v)
    table = pd.DataFrame(
        {
            "event": np.arange(v.size),
            "t_v_s": t_v,
            "t_p_s": t_p,
            "d_v_mm": d_v,
            "d_p_mm": d_p,
            "F_v_N": f_v,
            "F_p_N": f_p,
            "dF_N": f_p - f_v,
            "stick_length_um": 1e3 * (d_p - d_v),
            "slip_length_um": 1e3 * (np.r_[d_v[1:], last] - d_p),
            **_stiffness(signal, sticks, two_slopes, compliance),
            **_raw_extremes(signal, v, p),
            "stick_length_err_um": 1e3 * (d_p - d_v) * relative,
            "slip_time_s": t_next - t_p,
            "samples": (p - v).astype(int),
        }
    )
    return table.assign(flag=_event_flags(signal, sticks, rising))


def _ends(signal: _Signal, sticks: _Sticks, t_v: Floats, t_p: Floats) -> tuple[Floats, Floats, Bools]:
    """(F_v, F_p, does the load rise): stick lines extended to the corners, each side of the knee its own."""
    central = sticks.central(sticks.settings.line_part)
    line = fit_lines(signal.time, signal.spikeless, *central, lag=sticks.lag)
    bent = np.isfinite(sticks.knee)
    f_v, f_p = line.at(t_v), line.at(t_p)
    if bent.any():
        broken = sticks.broken(signal.time, signal.spikeless)
        f_v = np.where(bent, broken.first_at(t_v), f_v)
        f_p = np.where(bent, broken.second_at(t_p), f_p)
    return f_v, f_p, line.slope > 0


def _stiffness(signal: _Signal, sticks: _Sticks, two_slopes: bool, compliance: float) -> dict[str, Floats]:
    """Slopes of load against d, corrected for the machine's compliance in series."""

    def sample(slope: Floats) -> Floats:
        with np.errstate(divide="ignore"):
            return np.where(slope * compliance < 1, slope / (1 - slope * compliance), np.nan)

    travel, load = signal.travel, signal.spikeless
    central, narrow, wide = (
        fit_lines(travel, load, *sticks.one_slope(part), lag=sticks.lag)
        for part in (sticks.settings.central_part, 0.3, 0.7)
    )
    k = sample(central.slope)
    with np.errstate(invalid="ignore"):
        columns = {"K_N_per_mm": k, "K_err_N_per_mm": central.slope_error * (k / central.slope) ** 2}
    columns |= {"K30_N_per_mm": sample(narrow.slope), "K70_N_per_mm": sample(wide.slope)}
    names = ("K1_N_per_mm", "K2_N_per_mm", "knee", "knee_gain")
    if not two_slopes or not np.isfinite(travel).any():
        return columns | dict.fromkeys(names, np.full(k.size, np.nan))
    broken = sticks.broken(travel, load)
    found = sample(broken.first), sample(broken.second), broken.knee, broken.gain
    return columns | dict(zip(names, found, strict=True))


def _raw_extremes(signal: _Signal, v: Floats, p: Floats) -> dict[str, Floats]:
    """Lowest load near each valley and highest near each peak, spikes aside: within a tenth of the stick."""
    reach = np.maximum(0.1 * (p - v), 1)
    size = signal.clean.size
    lowest, highest = np.full(v.size, np.inf), np.full(v.size, -np.inf)
    for extreme, corner, place in ((np.minimum, v, lowest), (np.maximum, p, highest)):
        start = np.clip(np.floor(corner - reach), 0, size - 1).astype(np.int64)
        row, index = flat_ranges(start, np.clip(np.ceil(corner + reach) + 1, 1, size).astype(np.int64))
        extreme.at(place, row, signal.clean[index])
    return {"F_v_raw_N": lowest, "F_p_raw_N": highest}


def _event_flags(signal: _Signal, sticks: _Sticks, rising: Bools) -> list[str]:
    """What is wrong within each stick, joined by "+"; "ok" where nothing is."""
    v, p, last = sticks.v, sticks.p, signal.time.size - 1
    first, final = np.clip(np.floor(v), 0, last).astype(int), np.clip(np.ceil(p), 0, last).astype(int)
    marks = {kind: seen[final] > seen[first] for kind, seen in signal.damage.items()}
    marks |= {"few": p - v < sticks.settings.few_samples, "falling": ~rising}
    return ["+".join(word for word, mark in marks.items() if mark[k]) or "ok" for k in range(v.size)]


# --- detection limit ----------------------------------------------------------------------------------------


def detection_limit(
    force: xr.Dataset,
    sticks: pd.DataFrame,
    *,
    levels_N: tuple[float, ...] | None = None,
    injected: int = 40,
    seed: int = 0,
    settings: ForceSettings = DEFAULTS,
) -> pd.DataFrame:
    """The share of known small slips that are found when added to the recording's own sticks.

    Parameters
    ----------
    force, sticks
        As from `read_force` and `find_stick_slip`.
    levels_N
        Drops to try; by default 1 to 12 times the noise.
    injected, seed
        Most sticks that get a slip, and the seed of their choice.
    settings
        As for `find_stick_slip`.

    Returns
    -------
    Columns dF_N, dF_over_noise, recall, injected. ``attrs["limit_N"]`` is the smallest level from which on at
    least 95 % are found, NaN if none.

    Raises
    ------
    InputError
        With fewer than three whole sticks.

    Notes
    -----
    In the middle of a stick the load is lowered by a known step until the stick's own slip, so noise, spikes
    and stiffness are the recording's; the threshold stays as it was. A slip counts as found if an event peaks
    within a tenth of that stick. The stick is thereby cut in two, which makes the limit a little pessimistic.
    """
    STICKS.check(sticks)
    metadata = StickMetadata.of(sticks)
    whole = sticks[(sticks["flag"] == "ok") & (sticks["samples"] >= 2 * sticks["samples"].median() / 3)]
    if len(whole) < 3:
        raise InputError("detection limit", "at least three whole sticks", f"{len(whole)}")
    levels = np.array(levels_N or metadata.noise_N * np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 12.0]))
    rng = np.random.default_rng(seed)
    chosen = np.sort(rng.choice(len(whole), size=min(injected, len(whole)), replace=False))
    picked = whole.iloc[chosen]
    recall = np.array([_recall(force, picked, level, metadata.threshold_N, settings) for level in levels])
    columns = {"dF_N": levels, "dF_over_noise": levels / metadata.noise_N, "recall": recall}
    table = pd.DataFrame(columns).assign(injected=chosen.size)
    good = np.flatnonzero(np.logical_and.accumulate((recall >= 0.95)[::-1])[::-1])
    limit = float(levels[good[0]]) if good.size else float("nan")
    table.attrs = {"limit_N": limit, "noise_N": metadata.noise_N, "seed": seed}
    return table


def _recall(
    force: xr.Dataset, picked: pd.DataFrame, drop_N: float, threshold_N: float, settings: ForceSettings
) -> float:
    """Share of the sticks in whose middle a slip of `drop_N` is found."""
    begin, end, slip = (picked[name].to_numpy() for name in ("t_v_s", "t_p_s", "slip_time_s"))
    middle = 0.5 * (begin + end)
    time = force["time_s"].to_numpy()
    # Lowered from mid-stick to the middle of the stick's own slip, which is smaller by as much.
    begun, over = (np.searchsorted(at, time, side="right") for at in (middle, end + 0.5 * slip))
    lowered = force.assign(load_N=force["load_N"] - drop_N * (begun - over))
    try:
        found = find_stick_slip(lowered, threshold_N=threshold_N, settings=settings)
    except InputError:
        return 0.0
    peaks = np.r_[StickMetadata.of(found).first_slip_s, found["t_p_s"].to_numpy()]
    nearest = np.min(np.abs(peaks[:, np.newaxis] - middle), axis=0)
    return float(np.mean(nearest < 0.1 * (end - begin)))
