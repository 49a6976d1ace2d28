"""What is measured on each stick, all sticks at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vision.force.corners import Corners
from vision.force.lines import Floats, Ints, Lines, fit_broken_lines, fit_lines, flat_ranges

if TYPE_CHECKING:
    import pandas as pd

CENTRAL = 0.5
_SENSITIVITY = (0.3, 0.7)
# F_p and F_v come from a line through nearly all of the stick: a shorter one would not reach the ends.
_EXTRAPOLATED = 0.8
_FEW_SAMPLES = 10


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


def measure(signal: Signal, corners: Corners, two_slopes: bool, compliance: float) -> pd.DataFrame:
    """The table, from corners in samples: valley[j] ends slip j, peak[j] begins it.  compliance: mm/N."""
    import pandas as pd

    index = np.arange(signal.time.size, dtype=float)
    v, p, v_next = corners.valley[:-1], corners.peak[1:], corners.valley[1:]
    t_v, t_p, t_next = (np.interp(at, index, signal.time) for at in (v, p, v_next))
    line = _central(signal, signal.time, v, p, _EXTRAPOLATED)
    f_v, f_p = line.at(t_v), line.at(t_p)
    # What the machine itself stretches is taken off at the corners: off every sample it would carry the
    # noise.
    d_v = np.interp(v, index, signal.travel) - compliance * f_v
    d_p = np.interp(p, index, signal.travel) - compliance * f_p
    last = np.interp(v_next[-1:], index, signal.travel) - compliance * signal.clean[int(v_next[-1])]
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
            **_stiffness(signal, v, p, two_slopes, compliance),
            **_raw_extremes(signal, v, p),
            "slip_time_s": t_next - t_p,
            "samples": (p - v).astype(int),
        }
    )
    return table.assign(flag=_event_flags(signal, v, p, line.slope))


def _central(signal: Signal, x: Floats, v: Floats, p: Floats, part: float) -> Lines:
    """Lines of load against x through the central part of each stick, spikes left out."""
    start, stop = _central_range(v, p, part)
    return fit_lines(x, np.where(signal.is_spike, np.nan, signal.load), start, stop)


def _central_range(v: Floats, p: Floats, part: float) -> tuple[Ints, Ints]:
    margin = 0.5 * (1 - part) * (p - v)
    return np.ceil(v + margin).astype(np.int64), np.floor(p - margin).astype(np.int64) + 1


def _stiffness(
    signal: Signal, v: Floats, p: Floats, two_slopes: bool, compliance: float
) -> dict[str, Floats]:
    """Slopes of load against d; the machine's compliance, in series, is taken off."""

    def sample(slope: Floats) -> Floats:
        with np.errstate(divide="ignore"):
            return np.where(slope * compliance < 1, slope / (1 - slope * compliance), np.nan)

    central, *others = (_central(signal, signal.travel, v, p, part) for part in (CENTRAL, *_SENSITIVITY))
    k = sample(central.slope)
    columns = {"K_N_per_mm": k, "K_err_N_per_mm": central.slope_error * (k / central.slope) ** 2}
    columns |= {
        f"K{part:.0%}_N_per_mm".replace("%", ""): sample(line.slope)
        for part, line in zip(_SENSITIVITY, others, strict=True)
    }
    nothing = np.full(v.size, np.nan)
    if not two_slopes or not np.isfinite(signal.travel).any():
        return columns | dict.fromkeys(("K1_N_per_mm", "K2_N_per_mm", "knee", "knee_gain"), nothing)
    start, stop = _central_range(v, p, _EXTRAPOLATED)
    broken = fit_broken_lines(signal.travel, np.where(signal.is_spike, np.nan, signal.load), start, stop)
    return columns | {
        "K1_N_per_mm": sample(broken.first),
        "K2_N_per_mm": sample(broken.second),
        "knee": broken.knee,
        "knee_gain": broken.gain,
    }


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


def _event_flags(signal: Signal, v: Floats, p: Floats, slope: Floats) -> list[str]:
    """What is wrong within each stick, joined by "+"; "ok" where nothing is."""
    last = signal.time.size - 1
    first, final = np.clip(np.floor(v), 0, last).astype(int), np.clip(np.ceil(p), 0, last).astype(int)
    marks = {word: seen[final] > seen[first] for word, seen in signal.damage.items()}
    marks |= {"few": p - v < _FEW_SAMPLES, "falling": ~(slope > 0)}
    return ["+".join(word for word, mark in marks.items() if mark[k]) or "ok" for k in range(v.size)]
