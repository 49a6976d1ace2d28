"""What is measured on each stick phase, all at once: end forces, lengths, stiffness, errors, flags."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pandas as pd
import xarray as xr

from vision.force.corners import Corners
from vision.force.lines import BrokenLines, Lines, fit_broken_lines, fit_lines
from vision.force.recording import find_spikes, noise_sigma, usable
from vision.force.regime import Extremes, is_slow
from vision.force.settings import ForceSettings
from vision.numeric import Bools, Floats, Ints

_EXTREME_SIGMAS = 4.0  # of the noise, by which the smallest of many samples may lie below the load itself


@dataclass(frozen=True)
class Signal:
    """The good samples of a force recording.

    Parameters
    ----------
    time, travel
        Of each sample, s, and of the sample's end, mm.
    load, clean
        As recorded and with spikes replaced by their neighbours, N.
    is_spike
        Samples that are spikes.
    sigma
        Noise of the load, N.
    damage
        For each kind of bad sample, how many of them came before each good one.
    """

    time: Floats
    travel: Floats
    load: Floats
    clean: Floats
    is_spike: Bools
    sigma: float
    damage: dict[str, Ints]

    @classmethod
    def of(cls, force: xr.Dataset, settings: ForceSettings) -> Signal:
        """The good samples of a recording from `vision.force.read_force`."""
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


def measure_sticks(
    signal: Signal,
    corners: Corners,
    extremes: Extremes,
    lag: float,
    two_slopes: bool,
    compliance: float,
    settings: ForceSettings,
) -> pd.DataFrame:
    """The columns of the events that are measured on each stick by itself.

    Parameters
    ----------
    signal
        The recording.
    corners, extremes
        In samples: valley[j] ends slip j, peak[j] begins it. The extremes are those recorded.
    lag
        Time constant of the load cell's low-pass that is corrected for, in samples; 0: as recorded.
    two_slopes
        Whether sticks have knees.
    compliance
        Of the machine, mm/N.
    settings
        See `ForceSettings`.

    Returns
    -------
    One row per stick, from the valley after slip j to the peak before slip j + 1; see `vision.data.STICKS`.
    """
    index = np.arange(signal.time.size, dtype=float)
    slow = is_slow(corners.valley - corners.peak, corners.peak[1:] - corners.valley[:-1], settings)
    recorded = slow if not lag else np.zeros_like(slow)
    valley = np.where(recorded, extremes.valley, corners.valley)
    peak = np.where(recorded, extremes.peak, corners.peak)
    v, p, v_next = valley[:-1], peak[1:], valley[1:]
    sticks = _Sticks(v, p, corners.knee[1:-1], lag, settings)
    t_v, t_p, t_next = (np.interp(at, index, signal.time) for at in (v, p, v_next))
    ends = _ends(signal, sticks, t_v, t_p)
    f_v, f_p = ends.f_v, ends.f_p
    if not lag:
        f_v, f_p = _within_recorded(signal, extremes, ends, np.isfinite(sticks.knee), settings)
        f_v = np.where(recorded[:-1], extremes.low[:-1], f_v)
        f_p = np.where(recorded[1:], extremes.high[1:], f_p)
    place = np.where(recorded, _flat_top_error(signal, corners, extremes), corners.error)
    # The machine's stretch is subtracted at the corners: at every sample it would add the load's noise to d.
    d_v = np.interp(v, index, signal.travel) - compliance * f_v
    d_p = np.interp(p, index, signal.travel) - compliance * f_p
    last = np.interp(v_next[-1:], index, signal.travel) - compliance * signal.clean[int(v_next[-1])]
    relative = np.hypot(place[:-1], place[1:]) / (p - v)
    # Near a slow slip's extreme the load is level: the place of the corner does not matter there.
    rise = np.abs(ends.slope) * signal.interval_s
    f_v_err = np.hypot(ends.error_v, np.where(recorded[:-1], 0, rise * place[:-1]))
    f_p_err = np.hypot(ends.error_p, np.where(recorded[1:], 0, rise * place[1:]))
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
            "F_v_raw_N": extremes.lowest[:-1],
            "F_p_raw_N": extremes.highest[1:],
            "F_v_err_N": f_v_err,
            "F_p_err_N": f_p_err,
            "dF_err_N": np.hypot(f_v_err, f_p_err),
            "stick_length_err_um": 1e3 * (d_p - d_v) * relative,
            "slip_time_s": t_next - t_p,
            "samples": (p - v).astype(int),
        }
    )
    return table.assign(flag=_event_flags(signal, sticks, ends.slope > 0, slow[:-1] | slow[1:]))


def _within_recorded(
    signal: Signal, extremes: Extremes, ends: _Ends, bent: Bools, settings: ForceSettings
) -> tuple[Floats, Floats]:
    """Forces at the ends of the stick lines, held to what was recorded there.

    A stick begins and ends between two samples: it may be a sample's rise longer than what was recorded. The
    load cell is late, too: the lowest sample lies above the true valley, and a small share of the drop is
    left for that. The whole recording's range is never left. Two straight lines are a rough likeness of a
    bent stick that is curved throughout, and cut its corners off: there what was recorded holds, but for the
    noise of single samples.
    """
    highest, lowest = extremes.highest[1:], extremes.lowest[:-1]
    rise = np.abs(ends.slope) * signal.interval_s
    spare = rise + settings.between_samples * np.maximum(highest - lowest, 0)
    f_v = np.fmax(ends.f_v, np.maximum(lowest - spare, signal.clean.min()))
    f_p = np.fmin(ends.f_p, np.minimum(highest + rise, signal.clean.max()))
    noise = _EXTREME_SIGMAS * signal.sigma
    return (
        np.where(bent, np.fmin(f_v, lowest + noise), f_v),
        np.where(bent, np.fmax(f_p, highest - noise), f_p),
    )


def _flat_top_error(signal: Signal, corners: Corners, extremes: Extremes) -> Floats:
    """Samples within which noise hides the extreme of half a cosine."""
    noise = signal.sigma / np.sqrt(extremes.width)
    relative = noise / np.maximum(extremes.high - extremes.low, noise)
    return np.asarray(np.fmax(extremes.fall * 2 / np.pi * np.sqrt(relative), corners.error))


@dataclass(frozen=True)
class _Ends:
    """Forces at the two ends of each stick with the errors of their lines, and the sticks' slope in N/s."""

    f_v: Floats
    f_p: Floats
    error_v: Floats
    error_p: Floats
    slope: Floats


def _ends(signal: Signal, sticks: _Sticks, t_v: Floats, t_p: Floats) -> _Ends:
    """Stick lines extended to the corners, each side of the knee its own."""
    central = sticks.central(sticks.settings.line_part)
    line = fit_lines(signal.time, signal.spikeless, *central, lag=sticks.lag)
    bent = np.isfinite(sticks.knee)
    f_v, f_p = line.at(t_v), line.at(t_p)
    if bent.any():
        broken = sticks.broken(signal.time, signal.spikeless)
        f_v = np.where(bent, broken.first_at(t_v), f_v)
        f_p = np.where(bent, broken.second_at(t_p), f_p)
    return _Ends(f_v, f_p, line.error_at(t_v), line.error_at(t_p), line.slope)


def _stiffness(signal: Signal, sticks: _Sticks, two_slopes: bool, compliance: float) -> dict[str, Floats]:
    """Slopes of load against d, corrected for the machine's compliance in series."""

    def sample(slope: Floats) -> Floats:
        with np.errstate(divide="ignore"):
            return np.where(slope * compliance < 1, slope / (1 - slope * compliance), np.nan)

    travel, load = signal.travel, signal.spikeless

    def both(line: Lines) -> tuple[Floats, Floats]:
        k = sample(line.slope)
        with np.errstate(divide="ignore", invalid="ignore"):
            return k, line.slope_error * (k / line.slope) ** 2

    part = sticks.settings.central_part
    central, narrow, wide = (
        fit_lines(travel, load, *sticks.central(share), lag=sticks.lag) for share in (part, 0.3, 0.7)
    )
    k, error = both(central)
    columns = {"K_N_per_mm": k, "K_err_N_per_mm": error}
    columns |= {"K30_N_per_mm": sample(narrow.slope), "K70_N_per_mm": sample(wide.slope)}
    names = ("K1_N_per_mm", "K2_N_per_mm", "K2_err_N_per_mm", "knee", "knee_gain")
    if not two_slopes or not np.isfinite(travel).any():
        return columns | dict.fromkeys(names, np.full(k.size, np.nan))
    broken = sticks.broken(travel, load)
    after, after_error = both(fit_lines(travel, load, *sticks.one_slope(part), lag=sticks.lag))
    bent = np.isfinite(sticks.knee)
    second = np.where(bent, after, sample(broken.second)), np.where(bent, after_error, error)
    return columns | dict(zip(names, (sample(broken.first), *second, broken.knee, broken.gain), strict=True))


def _event_flags(signal: Signal, sticks: _Sticks, rising: Bools, slow: Bools) -> list[str]:
    """What is wrong within each stick, joined by "+"; "ok" where nothing is."""
    v, p, last = sticks.v, sticks.p, signal.time.size - 1
    first, final = np.clip(np.floor(v), 0, last).astype(int), np.clip(np.ceil(p), 0, last).astype(int)
    marks = {kind: seen[final] > seen[first] for kind, seen in signal.damage.items()}
    marks |= {"few": p - v < sticks.settings.few_samples, "falling": ~rising, "slow": slow}
    return ["+".join(word for word, mark in marks.items() if mark[k]) or "ok" for k in range(v.size)]
