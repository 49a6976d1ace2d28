"""What is measured on each stick, all sticks at once."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vision.force.corners import Corners
from vision.force.lines import (
    BrokenLines,
    Floats,
    Ints,
    Lines,
    fit_broken_lines,
    fit_lines,
    flat_ranges,
)

if TYPE_CHECKING:
    import pandas as pd

CENTRAL = 0.5
_SENSITIVITY = (0.3, 0.7)
# F_p and F_v come from a line through nearly all of the stick: a shorter one would not reach the ends.
_EXTRAPOLATED = 0.8
_FEW_SAMPLES = 10
_CLEAR_OF_KNEE, _EARLY_KNEE = 0.03, 0.65  # of the stick
_TWO_SLOPES = ("K1_N_per_mm", "K2_N_per_mm", "knee", "knee_gain")


@dataclass(frozen=True)
class Signal:
    """Good samples: time, travel of the sample's end, load as recorded and without spikes, and damage
    marks."""

    time: Floats
    travel: Floats
    load: Floats
    clean: Floats
    is_spike: NDArray[np.bool_]
    sigma: float
    damage: dict[str, Ints]

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
    """Valley, peak and knee (NaN: none) of each stick, in samples, and the force chain's time constant."""

    v: Floats
    p: Floats
    knee: Floats
    lag: float

    def central(self, part: float) -> tuple[Ints, Ints]:
        """[start, stop) of the central part."""
        margin = 0.5 * (1 - part) * (self.p - self.v)
        return _between(self.v + margin, self.p - margin)

    def one_slope(self, part: float) -> tuple[Ints, Ints]:
        """The same after the knee; before it where it comes late."""
        margin, clear = 0.5 * (1 - part) * (self.p - self.v), _CLEAR_OF_KNEE * (self.p - self.v)
        start, stop = self.v + margin, self.p - margin
        early = self.knee - self.v < _EARLY_KNEE * (self.p - self.v)
        start = np.where(early, np.fmax(start, self.knee + clear), start)
        return _between(start, np.where(early, stop, np.fmin(stop, self.knee - clear)))

    def broken(self, x: Floats, y: Floats) -> BrokenLines:
        """Lines with a knee through nearly all of each stick."""
        return fit_broken_lines(x, y, *self.central(_EXTRAPOLATED), lag=self.lag)


def _between(start: Floats, stop: Floats) -> tuple[Ints, Ints]:
    return np.ceil(start).astype(np.int64), np.floor(stop).astype(np.int64) + 1


def measure(
    signal: Signal, corners: Corners, lag: float, two_slopes: bool, compliance: float
) -> pd.DataFrame:
    """The table, from corners in samples: valley[j] ends slip j, peak[j] begins it.

    lag: the force chain's time constant in samples.  compliance: of the machine, mm/N.
    """
    import pandas as pd

    index = np.arange(signal.time.size, dtype=float)
    v, p, v_next = corners.valley[:-1], corners.peak[1:], corners.valley[1:]
    sticks = _Sticks(v, p, corners.knee[1:-1], lag)
    t_v, t_p, t_next = (np.interp(at, index, signal.time) for at in (v, p, v_next))
    f_v, f_p, rising = _ends(signal, sticks, t_v, t_p)
    # What the machine stretches is taken off at the corners: off every sample it would carry the noise.
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
    return table.assign(flag=_event_flags(signal, v, p, rising))


def _ends(
    signal: Signal, sticks: _Sticks, t_v: Floats, t_p: Floats
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """(F_v, F_p, does the load rise): stick lines extended to the corners, each side of the knee its own."""
    line = fit_lines(signal.time, signal.spikeless, *sticks.central(_EXTRAPOLATED), lag=sticks.lag)
    bent = np.isfinite(sticks.knee)
    f_v, f_p = line.at(t_v), line.at(t_p)
    if bent.any():
        broken = sticks.broken(signal.time, signal.spikeless)
        f_v = np.where(bent, broken.first_at(t_v), f_v)
        f_p = np.where(bent, broken.second_at(t_p), f_p)
    return f_v, f_p, line.slope > 0


def _stiffness(signal: Signal, sticks: _Sticks, two_slopes: bool, compliance: float) -> dict[str, Floats]:
    """Slopes of load against d; the machine's compliance, in series, is taken off."""

    def sample(slope: Floats) -> Floats:
        with np.errstate(divide="ignore"):
            return np.where(slope * compliance < 1, slope / (1 - slope * compliance), np.nan)

    travel, load = signal.travel, signal.spikeless

    def line(part: float) -> Lines:
        return fit_lines(travel, load, *sticks.one_slope(part), lag=sticks.lag)

    central = line(CENTRAL)
    k = sample(central.slope)
    with np.errstate(invalid="ignore"):
        columns = {"K_N_per_mm": k, "K_err_N_per_mm": central.slope_error * (k / central.slope) ** 2}
    for part in _SENSITIVITY:
        columns[f"K{100 * part:.0f}_N_per_mm"] = sample(line(part).slope)
    if not two_slopes or not np.isfinite(travel).any():
        return columns | dict.fromkeys(_TWO_SLOPES, np.full(k.size, np.nan))
    broken = sticks.broken(travel, load)
    found = sample(broken.first), sample(broken.second), broken.knee, broken.gain
    return columns | dict(zip(_TWO_SLOPES, found, strict=True))


def _raw_extremes(signal: Signal, v: Floats, p: Floats) -> dict[str, Floats]:
    """Lowest load near each valley and highest near each peak, spikes aside: within a tenth of the stick."""
    reach = np.maximum(0.1 * (p - v), 1)
    size = signal.clean.size
    lowest, highest = np.full(v.size, np.inf), np.full(v.size, -np.inf)
    for extreme, corner, place in ((np.minimum, v, lowest), (np.maximum, p, highest)):
        start = np.clip(np.floor(corner - reach), 0, size - 1).astype(np.int64)
        row, index = flat_ranges(start, np.clip(np.ceil(corner + reach) + 1, 1, size).astype(np.int64))
        extreme.at(place, row, signal.clean[index])
    return {"F_v_raw_N": lowest, "F_p_raw_N": highest}


def _event_flags(signal: Signal, v: Floats, p: Floats, rising: NDArray[np.bool_]) -> list[str]:
    """What is wrong within each stick, joined by "+"; "ok" where nothing is."""
    last = signal.time.size - 1
    first, final = np.clip(np.floor(v), 0, last).astype(int), np.clip(np.ceil(p), 0, last).astype(int)
    marks = {word: seen[final] > seen[first] for word, seen in signal.damage.items()}
    marks |= {"few": p - v < _FEW_SAMPLES, "falling": ~rising}
    return ["+".join(word for word, mark in marks.items() if mark[k]) or "ok" for k in range(v.size)]
