"""Stick-slip events: one row per stick, from its valley to its peak."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vision.errors import InputError
from vision.force.chain import time_constant, undelayed
from vision.force.corners import Corners, find_corners
from vision.force.flags import usable
from vision.force.measure import CENTRAL, Signal, measure
from vision.force.noise import noise_sigma, spikes
from vision.force.recording import is_compression
from vision.force.slips import Slips, find_slips

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

_FAST_MM_MIN = 5.0
_ROUNDS = 3
_MARKED = ("gap", "nan", "saturated", "repeated", "backwards")


def find_stick_slip(
    force: xr.Dataset,
    *,
    threshold_N: float | None = None,
    machine_stiffness_N_per_mm: float | None = None,
    two_slopes: bool | None = None,
    lowpass_s: float | None = None,
) -> pd.DataFrame:
    """Stick-slip events of a recording, one row per complete stick: valley (v), peak (p), next valley.

    The initial elastic loading has a peak but no valley, and what follows the last slip no peak: neither is a
    row; the first slip is in the attributes.  Lengths and stiffness are NaN where d is not known.

    Args: force, as from `read_force`.  threshold_N, smallest drop; found if absent (`find_slips`).
    machine_stiffness_N_per_mm, corrects d for the machine's own stretch, d - F/K_machine; off by default.
    two_slopes, fits K1 up to a knee and K2 after it; by default from 5 mm/min on.
    lowpass_s, time constant of the force chain, which is undone (0 for none); found from the slips' tails
    if absent.

    Returns: event, t_v_s, t_p_s, d_v_mm, d_p_mm, F_v_N and F_p_N (stick line through the central 80 %
    extended to valley and peak), dF_N = F_p - F_v, stick_length_um = d_p - d_v, slip_length_um = next d_v
    - d_p (0 where the slip is shorter than a sample), K_N_per_mm with K_err_N_per_mm (slope of the central
    half, with two slopes of what follows the knee), F_v_raw_N and F_p_raw_N (extremes, spikes aside),
    K30_N_per_mm and K70_N_per_mm (other central parts), K1_N_per_mm, K2_N_per_mm, knee, knee_gain (two
    slopes), stick_length_err_um (noise, sampling, and that a slip's shape is not known), slip_time_s,
    samples, flag ("ok" or what is wrong within the stick: gap, nan, saturated, repeated, backwards, few,
    falling).  attrs: noise_N, threshold_N, threshold_how, period_samples, spikes, lowpass_s with lowpass_how
    (found, given, none, or doubtful: tails that no single low-pass explains, left alone), first_slip_s,
    first_slip_N, last_slip_s and the arguments.

    Raises InputError for a load in compression, where there are not two slips, or for a lowpass_s below 0 or
    not shorter than the usual time between slips.  Source: paper, stick-slip features; the detection notes.
    """
    signal = _prepare(force)
    about = str(force.attrs.get("path", "force recording"))
    if is_compression(signal.load):
        raise InputError(
            about,
            "a pull (positive load)",
            f"a median load of {np.median(signal.load):.3g}",
            "if tension counts negative on this machine give --force-columns load=-NAME",
        )
    slips = find_slips(signal.clean, signal.sigma, threshold=threshold_N)
    if slips.edge.size < 2:
        raise InputError(
            about,
            "at least two slips",
            f"{slips.edge.size} drops above {slips.threshold:.3g} (noise {signal.sigma:.2g})",
            "lower --force-threshold if smaller drops are slips",
        )
    speed = float(force.attrs.get("speed_mm_min", np.nan))
    fast = speed >= _FAST_MM_MIN if two_slopes is None else two_slopes
    if lowpass_s is not None:
        _check_lowpass(about, lowpass_s, slips.period * signal.interval_s)
    corners, tau, how = _corners(signal, slips, fast, lowpass_s)
    events = measure(signal, corners, tau, fast, 1 / (machine_stiffness_N_per_mm or np.inf))
    events.attrs |= {"lowpass_s": tau * signal.interval_s, "lowpass_how": how}
    return _with_facts(events, signal, slips, corners, machine_stiffness_N_per_mm)


def _check_lowpass(about: str, lowpass_s: float, period_s: float) -> None:
    if not 0 <= lowpass_s < period_s:
        raise InputError(
            about,
            f"a time constant from 0 to less than from slip to slip, {period_s:.3g} s",
            f"{lowpass_s:g} s",
            "give --force-lowpass in seconds, or leave it out to have it found",
        )


def _corners(
    signal: Signal, slips: Slips, two_slopes: bool, lowpass_s: float | None
) -> tuple[Corners, float, str]:
    """Corners of the slips, the force chain's time constant in samples, and how it is known."""

    def corners(tau: float) -> Corners:
        return find_corners(undelayed(signal.clean, signal.sigma, slips, tau), two_slopes=two_slopes)

    if lowpass_s is not None:
        tau = lowpass_s / signal.interval_s
        return corners(tau), tau, "given"
    plain = corners(0.0)
    found = time_constant(signal.clean, plain.tails())
    if found is None or not found.worth_trying:
        return plain, 0.0, "none"
    # Corners freed of the low-pass show its tails from their very begin: what comes out again is believed.
    for _ in range(_ROUNDS):
        again = time_constant(signal.clean, corners(found.samples).tails(), found.samples)
        if again is None:
            break
        if again.confirms(found):
            return corners(again.samples), again.samples, "found"
        found = again
    return plain, 0.0, "doubtful"


def _with_facts(
    events: pd.DataFrame, signal: Signal, slips: Slips, corners: Corners, machine_stiffness: float | None
) -> pd.DataFrame:
    first, last = np.interp(corners.peak[[0, -1]], np.arange(signal.time.size), signal.time)
    events.attrs |= {
        "noise_N": signal.sigma,
        "threshold_N": slips.threshold,
        "threshold_how": slips.threshold_how,
        "period_samples": slips.period,
        "spikes": int(signal.is_spike.sum()),
        "first_slip_s": float(first),
        "first_slip_N": float(signal.clean[max(int(corners.peak[0]), 0)]),
        "last_slip_s": float(last),
        "machine_stiffness_N_per_mm": machine_stiffness or float("nan"),
        "central_part": CENTRAL,
    }
    return events


def _prepare(force: xr.Dataset) -> Signal:
    count = force.sizes["time_s"]
    flags = np.asarray(force["flag"].values, dtype=str) if "flag" in force else np.full(count, "ok")
    good = usable(flags)
    time, travel, load = (force[name].to_numpy()[good].astype(float) for name in ("time_s", "d_mm", "load_N"))
    sigma = noise_sigma(load)
    is_spike, clean = spikes(load, sigma)
    damage = {word: np.cumsum(flags == word)[good] for word in _MARKED if np.any(flags == word)}
    return Signal(time, travel, load, clean, is_spike, sigma, damage)
