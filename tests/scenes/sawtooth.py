"""Sawtooth recordings with known slips."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray
from scipy.signal import lfilter

from vision.data import ForceMetadata
from vision.force.signal import Signal
from vision.models import equations


@dataclass(frozen=True)
class Test:
    """A recording and its truth: one row per complete stick, from valley to peak."""

    __test__ = False
    force: xr.Dataset
    truth: pd.DataFrame


def recording(time: np.ndarray, load: np.ndarray, d: np.ndarray, speed_mm_min: float) -> xr.Dataset:
    return xr.Dataset(
        {
            "load_N": ("time_s", load, {"units": "N"}),
            "d_mm": ("time_s", d, {"units": "mm"}),
            "flag": ("time_s", np.full(time.size, "ok")),
        },
        coords={"time_s": time},
        attrs=ForceMetadata(
            source="made.txt", separation_from="displacement", speed_mm_min=speed_mm_min, d0_mm=13.0
        ).attrs(),
    )


def signal_of(load: np.ndarray, sigma: float) -> Signal:
    """Return a load without spikes and lost samples, of white noise, at one sample per second."""
    index, none = np.arange(float(load.size)), np.zeros(load.size, bool)
    return Signal(index, index, load, load, none, none, sigma, np.full(load.size, sigma), {})


def plain(*, sticks=200, samples=30, snr=6.0, seed=0, scatter=0.02, jitter=0.08) -> Test:
    """Equal sticks of `samples` samples with drops of `snr` times the noise of 1 N; slips between samples."""
    rng = np.random.default_rng(seed)
    length = samples * (1 + jitter * rng.standard_normal(sticks))
    drop = snr * (1 + scatter * rng.standard_normal(sticks))
    start = np.r_[0, np.cumsum(length)[:-1]] + samples
    index = np.arange(int(start[-1] + 2 * samples))
    mean_rise = snr / samples
    # A stick rises by its own drop; the peaks wander a little, as peaks do.
    level = np.searchsorted(start, index, side="right")
    load = 100 + mean_rise * index - np.r_[0, np.cumsum(drop)][level] + rng.standard_normal(index.size)
    speed = 1.0
    d = 13 + speed / 60 * index * 0.01
    v, p = start[:-1], start[1:]
    truth = pd.DataFrame(
        {
            "t_v_s": v * 0.01,
            "t_p_s": p * 0.01,
            "stick_length_um": (p - v) * 0.01 * speed / 60 * 1e3,
            "dF_N": (p - v) * mean_rise,
            "K_N_per_mm": mean_rise / (0.01 * speed / 60),
        }
    )
    return Test(recording(index * 0.01, load, d, speed), truth)


def realistic(
    *,
    speed=1.0,
    rate=200.0,
    noise=0.2,
    d0=13.0,
    d1=15.0,
    tau=0.003,
    slip_s=0.001,
    scatter=0.02,
    jitter=0.05,
    softening=0.08,
    compliance=0.0,
    seed=0,
) -> Test:
    """A test after the paper: peaks by Eq. 1, drops 0.34 of the normal force, stiffness of M_eff sheets.

    compliance: mm/N of the machine, in series.
    """
    rng = np.random.default_rng(seed)
    v_mm_s = speed / 60
    rows, knots_t, knots_f = [], [0.0], [0.0]
    d, peak = d0, float(equations.traction(d0, mu=0.89))
    k0 = float(equations.assembly_stiffness(d0, mu=0.89, n_hat_N=0.57, modulus_GPa=3.8))
    t = peak / k0 / v_mm_s
    d = d0 + v_mm_s * t
    knots_t.append(t)
    knots_f.append(peak)
    while d < d1:
        drop = 0.34 * float(equations.total_normal_force(d, mu=0.89)) * (1 + jitter * rng.standard_normal())
        t_v, f_v, d_v = t + slip_s, peak - drop, d + slip_s * v_mm_s
        k = float(equations.assembly_stiffness(d_v, mu=0.89, n_hat_N=0.57, modulus_GPa=3.8))
        # The slip happens at the end of the stick, about one drop over K further on.
        target = float(equations.traction(d_v + drop / k, mu=0.89)) * (1 + scatter * rng.standard_normal())
        rise = max(target - f_v, 0.4 * drop)
        k_all = 1 / (1 / k + compliance)
        length = rise / k_all
        s = np.linspace(0, 1, 12)
        # A slip is half a swing of a block on a spring.
        swing = np.linspace(0, 1, 12)[1:-1]
        knots_t.extend(t + swing * slip_s)
        knots_f.extend(peak - drop * (1 - np.cos(np.pi * swing)) / 2)
        # Chord slope k_all, tangent k_all at mid-stick, softer towards the peak.
        f = f_v + rise * (s + softening / 2 * s * (1 - s))
        knots_t.extend(t_v + s * length / v_mm_s)
        knots_f.extend(f)
        t, peak, d = t_v + length / v_mm_s, f_v + rise, d_v + length
        rows.append((t_v, t, d_v, d, f_v, peak, rise, length * 1e3, k_all, k))
    columns = "t_v_s,t_p_s,d_v_mm,d_p_mm,F_v_N,F_p_N,dF_N,stick_length_um,K_N_per_mm,K_sample_N_per_mm"
    truth = pd.DataFrame(rows, columns=columns.split(","))
    knots_t.append(t + slip_s)
    knots_f.append(peak * 0.7)
    knots_t.append(t + slip_s + 0.2)
    knots_f.append(peak * 0.7)
    fine = 1 / (rate * max(1, round(4000 / rate)))
    grid = np.arange(0, knots_t[-1], fine)
    load = np.interp(grid, knots_t, knots_f)
    if tau:
        a = np.exp(-fine / tau)
        load = lfilter([1 - a], [1, -a], load)
    step = round(1 / rate / fine)
    time, load = grid[::step], load[::step]
    load = np.round((load + noise * rng.standard_normal(time.size)) / 0.01) * 0.01
    travel = np.round((d0 + v_mm_s * time) / 50e-6) * 50e-6
    return Test(recording(time, load, travel, speed), truth)


def slow_among_sudden(
    seed: int, *, share: float = 0.2, slips: int = 120
) -> tuple[xr.Dataset, NDArray[np.float64]]:
    """Return a recording with K = 600 N/mm in which a share of the slips lasts 0.75 to 2.25 s, and the times,
    s, at which the others begin."""
    rng = np.random.default_rng(seed)
    knots_t, knots_f, sudden = [0.0], [0.0], []
    for k in range(slips):
        peak = 60 - 30 * k / slips + 0.1 * rng.standard_normal()
        drop = 4 + 0.3 * rng.standard_normal()
        knots_t.append(knots_t[-1] + (peak - knots_f[-1]) / 10)
        knots_f.append(peak)
        slow = rng.random() < share
        if not slow:
            sudden.append(knots_t[-1])
        length = 1.5 * rng.uniform(0.5, 1.5) if slow else 0.01
        drop *= rng.uniform(0.3, 1) if slow else 1
        swing = np.linspace(0, 1, 20)[1:]
        knots_t.extend(knots_t[-1] + length * swing)
        knots_f.extend(peak - drop * (1 - np.cos(np.pi * swing)) / 2)
    time = np.arange(0, knots_t[-1], 0.01)
    load = np.interp(time, knots_t, knots_f) + 0.05 * rng.standard_normal(time.size)
    return recording(time, load, 13 + time / 60, 1.0), np.array(sudden)
