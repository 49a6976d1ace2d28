"""The budget of systematic errors: what is wrong in the same way in every frame and event, beside the noise.

Statistical errors come with each number. What is here moves all of them together, so that it is no part of
them: the separation at the start, the sample's geometry, a drifting load cell, the pixel size, the choice of
the strip's rows, uneven light, and the clock.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from vision.data import MotionMetadata, StripMetadata, TrackMetadata
from vision.numeric import FWHM, nan_median

if TYPE_CHECKING:
    from vision.figures import Results

QUANTITIES: Mapping[str, tuple[str, str]] = {
    "x_px": ("place of a sheet (not in x_err)", "px"),
    "mu": ("μ", ""),
    "T0_N": ("𝒯0", "N"),
    "A": ("A", ""),
    "N_hat_N": ("N̂", "N"),
    "Y_eff_GPa": ("Y_eff", "GPa"),
    "Lambda_hat_mm": ("Λ̂", "mm"),
    "K_N_per_mm": ("K", "N/mm"),
    "ratio": ("σ_x/Λ_st", ""),
}
"""What the errors are of: a name for tables, and the unit."""
SOURCES = {
    "d0": "initial separation d0",
    "load_drift": "drift of the load cell",
    "low_pass": "load cell's low-pass",
    "sampling": "rise of the force while a slip lasts",
    "thickness_mm": "thickness of a sheet",
    "width_mm": "width of the sheets",
    "length_mm": "length of the sheets",
    "t_star_N": "T*, friction of adhering sheets",
    "strip": "choice of the strip's rows",
    "light": "uneven light",
    "pixel_size": "pixel size",
    "clock": "clock",
}


@dataclass(frozen=True, kw_only=True)
class Budget:
    """Errors of the quantities that a run has (keys of `QUANTITIES`), in their units; NaN where not known."""

    values: Mapping[str, float]
    statistical: Mapping[str, float]  # standard errors; of positions and of σ_x/Λ_st their median
    # source (as in `SOURCES`) to what it contributes to each quantity; None where that is not known, no entry
    # where it has no part in it
    sources: Mapping[str, Mapping[str, float | None]]

    def total(self, quantity: str) -> float:
        """Root of the sum of squares of what is known; NaN where nothing is."""
        parts = [part[quantity] for part in self.sources.values() if part.get(quantity) is not None]
        return math.hypot(*parts) if parts else math.nan  # type: ignore[arg-type]

    def unknown(self, quantity: str) -> list[str]:
        """Sources of unknown size, which the total lacks."""
        return [name for name, part in self.sources.items() if quantity in part and part[quantity] is None]

    def to_json(self) -> dict[str, dict[str, object]]:
        """By quantity: value, statistical and systematic error, and each source's part; for run.json."""
        return {
            quantity: {
                "value": self.values[quantity],
                "statistical": self.statistical[quantity],
                "systematic": self.total(quantity),
                "sources": {name: part[quantity] for name, part in self.sources.items() if quantity in part},
            }
            for quantity in self.values
        }


def systematic_budget(results: Results) -> Budget:
    """The budget of a run, as `vision.analyse` returns it; empty where it has neither sheets nor fits.

    The force's part is that of the fits (everything fitted again with each source moved). What the strip's
    rows and uneven light do to places of sheets is the same in every frame: displacements and σ_x are free of
    it. The pixel size scales σ_x/Λ_st; its error is known where it was measured only, not where it was given.
    The clock has no part in σ_x as long as it is better than the frames left out beside slips.
    """
    values: dict[str, float] = {}
    statistical: dict[str, float] = {}
    sources: dict[str, dict[str, float | None]] = {}

    def add(source: str, quantity: str, part: float | None) -> None:
        sources.setdefault(source, {})[quantity] = part

    if results.tracks is not None:
        values["x_px"] = math.nan  # one for each sheet and frame
        statistical["x_px"] = float(nan_median(results.tracks["x_err_px"].values.ravel()))
        add("strip", "x_px", StripMetadata.of(results.tracks).strip_err_px)
        light = None if results.strip is None else uneven_light_px(results.strip, results.tracks)
        add("light", "x_px", light)
    if results.fits is not None:
        fitted = results.fits.named()
        for quantity, estimate in fitted.items():
            values[quantity], statistical[quantity] = estimate.value, estimate.error
        for source, parts in results.fits.budget.items():
            for quantity in (*fitted, "K_N_per_mm"):
                add(source, quantity, parts[quantity])
    if results.sticks is not None and results.fits is not None:
        values["K_N_per_mm"] = float(nan_median(results.sticks["K_N_per_mm"].to_numpy(float)))
        statistical["K_N_per_mm"] = float(nan_median(results.sticks["K_err_N_per_mm"].to_numpy(float)))
    if results.motion is not None:
        values["ratio"] = float(nan_median(results.motion["ratio"].values.ravel()))
        statistical["ratio"] = float(nan_median(results.motion["ratio_err"].values.ravel()))
        add("pixel_size", "ratio", None)
        if results.clock is not None:
            margin_s = MotionMetadata.of(results.motion).margin_s
            add("clock", "ratio", 0.0 if 1e-3 * results.clock.error_ms <= margin_s else None)
    return Budget(values=values, statistical=statistical, sources=sources)


def uneven_light_px(strip: xr.DataArray, tracks: xr.Dataset) -> float | None:
    r"""RMS over the sheets of how far the light's slope shifts their places, px; None where it is not known.

    A ridge of height C (negative where dark) over a level V, Gaussian with standard width :math:`\sigma`, in
    light L(x), has its maximum at

    .. math:: x - x_n = \frac{L'}{L}\, \frac{V + C}{C}\, \left(\sigma^2 + \frac{w^2}{20}\right)

    to first order, as the parabola over a window of w pixels sees it (its slope is that of the profile under
    a parabolic kernel, whose variance is :math:`w^2/20`). V and :math:`L'/L` are those of the gaps on both
    sides in the mean frame.
    """
    found = TrackMetadata.of(tracks)
    place = nan_median(tracks["x_px"].values) - float(strip["x"].values[0])
    known = np.isfinite(strip.values[:, :1]).all(axis=1)
    if place.size < 3 or not known.any() or not math.isfinite(found.pitch_px):
        return None
    frames = np.flatnonzero(known)
    some = frames[np.unique(np.linspace(0, frames.size - 1, 50).astype(int))]
    mean = np.asarray(strip.values[some], np.float64).mean(axis=0)
    column = np.arange(mean.size)
    gaps = np.interp(np.r_[place[:-1] + np.diff(place) / 2], column, mean)
    level = (gaps[1:] + gaps[:-1]) / 2
    slope = np.diff(gaps) / ((place[2:] - place[:-2]) / 2)
    top = np.interp(place[1:-1], column, mean)
    height = np.abs(top - level)
    width = (found.ridge_fwhm_px / FWHM) ** 2 + found.window_px**2 / 20
    with np.errstate(divide="ignore", invalid="ignore"):
        shift = slope / level * top / height * width
    shift = shift[np.isfinite(shift)]
    return float(np.sqrt(np.mean(shift**2))) if shift.size else None
