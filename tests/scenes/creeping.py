"""Tracks of sheets that creep and jump, with known truth, for tests of deformation and shells."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
import xarray as xr
from scipy.signal import lfilter

from vision.deformation import horizontal_deformation

PIXEL_UM = 10.0
_EXPOSED = np.linspace(-0.5, 0.5, 9)  # a frame is exposed from end to end of its interval


@dataclass(frozen=True)
class Clock:
    """Force clock = 5 s + video time."""

    status: str = "ok"
    residual_ms: float = 0.0
    offset_s: float = 5.0
    error_ms: float = np.nan
    slip_spread_ms: float = np.nan
    ambiguity: str = ""
    only_video_s: tuple[float, ...] = ()
    matched_s: tuple[float, ...] = ()

    def to_force_s(self, video_time_s):
        return self.offset_s + np.asarray(video_time_s)


@dataclass(frozen=True)
class Made:
    tracks: xr.Dataset
    sticks: pd.DataFrame
    ratio: np.ndarray  # (event, sheet), true σ_x/Λ_st
    sweep_px: np.ndarray


def profile(m_eff, *, sheets=25, outer=0.5, stiff=0.1):
    """σ_x/Λ_st of n = 1..sheets that crosses `stiff` at m_eff, (events, sheets)."""
    power = np.log(outer / stiff) / np.log(sheets / np.asarray(m_eff, float))
    return outer * (np.arange(1, sheets + 1) / sheets) ** power[:, None]


def straight(u):
    return u


def relaxing(strength):
    """Creep that slows down: 1 - exp, from 0 to 1."""
    return lambda u: -np.expm1(-strength * u) / -np.expm1(-strength)


def make(
    ratio,
    *,
    stick_um=20.0,
    frames=25.0,
    noise_px=0.05,
    rho=0.0,
    white_px=0.0,
    shape=straight,
    fps=60.0,
    drift_px_s=0.0,
    vibration_px=0.0,
    lost=0.0,
    missing=0.0,
    jitter=0.06,
    seed=0,
) -> Made:
    """Both sides alike, `ratio` (events, sheets a side) being the truth; `frames` frames a stick."""
    rng = np.random.default_rng(seed)
    events, side_sheets = ratio.shape
    number = np.arange(1, side_sheets + 1)
    side = np.r_[np.full(side_sheets, -1), np.ones(side_sheets, int)]
    n = np.r_[number[::-1], number]
    ratio = np.c_[ratio[:, ::-1], ratio]
    length_s = frames / fps * (1 + jitter * rng.uniform(-1, 1, events))
    begin = 3.3 / fps + np.r_[0, np.cumsum(length_s)]
    stick = stick_um * length_s / (frames / fps)
    fine = (np.arange(100_000) + 0.5) / 100_000
    sweep = ratio * stick[:, None] / PIXEL_UM / np.std(shape(fine))
    time = np.arange(int((begin[-1] + 3 / fps) * fps)) / fps
    x = 20.0 * (side * (n - 0.5)) + 960 + drift_px_s * time[:, None]
    for part in _EXPOSED / fps:
        row = np.clip(np.searchsorted(begin, time + part, side="right") - 1, 0, events - 1)
        u = np.clip((time + part - begin[row]) / length_s[row], 0, 1)
        x = x - side * sweep[row] * (shape(u)[:, None] - 0.5) / len(_EXPOSED)
    shake = vibration_px * np.sqrt(2) * np.sin(2 * np.pi * 23.7 * time)
    x = x + shake[:, None] + _noise(rng, x.shape, noise_px, rho) + white_px * rng.standard_normal(x.shape)
    x[rng.uniform(size=x.shape) < missing] = np.nan
    kept = rng.uniform(size=time.size) >= lost
    d_v = 13.2 + 1e-3 * np.r_[0, np.cumsum(stick)[:-1]]
    sticks = pd.DataFrame(
        {
            "event": np.arange(events),
            "t_v_s": 5 + begin[:-1],
            "t_p_s": 5 + begin[1:],
            "d_v_mm": d_v,
            "d_p_mm": d_v + 1e-3 * stick,
            "stick_length_um": stick,
        }
    )
    tracks = xr.Dataset(
        {
            "x_px": (("frame", "sheet"), x[kept]),
            "x_err_px": (("frame", "sheet"), np.full(x[kept].shape, np.hypot(noise_px, white_px) or 0.01)),
        },
        coords={
            "frame": np.flatnonzero(kept),
            "time_s": ("frame", time[kept]),
            "sheet": np.arange(n.size),
            "side": ("sheet", side),
            "n": ("sheet", n),
        },
        attrs={"source": "made.avi"},
    )
    return Made(tracks, sticks, ratio, sweep)


def _noise(rng, shape, sigma, rho):
    """AR(1) along frames with standard deviation sigma from the first frame on."""
    drive = rng.standard_normal(shape)
    drive[1:] *= np.sqrt(1 - rho**2)
    return sigma * lfilter([1.0], [1.0, -rho], drive, axis=0)


def uniform(sweep_px, stick_um, *, events=40, sheets=10):
    """True ratios, all alike, of a linear sweep."""
    return np.full((events, sheets), sweep_px * PIXEL_UM / np.sqrt(12) / stick_um)


def measure(made, clock=None, **options):
    """Deformation of the made tracks."""
    options = {"pixel_size_um": PIXEL_UM} | options
    return horizontal_deformation(made.tracks, made.sticks, clock or Clock(), **options)


def errors(made, motion):
    """(measured - true ratio, stated error) where there is a ratio."""
    wrong = motion["ratio"].to_numpy() - made.ratio
    known = np.isfinite(wrong)
    return wrong[known], motion["ratio_err"].to_numpy()[known]
