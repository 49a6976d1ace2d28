"""The budget of systematic errors, which every frame or event shares.

The statistical error of each number does not contain them. Their sources are the initial separation, the
sample's geometry, drift of the load cell, the pixel size, the choice of the strip's rows, uneven light, the
clock, and the compliance of the machine.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from vision.data import MotionMetadata, StickMetadata, StripMetadata, TrackMetadata
from vision.mapped import some_rows
from vision.numeric import FWHM, nan_median, rms, spread_indices
from vision.sheets.ridges import frames_with_values

if TYPE_CHECKING:
    from vision.figures import Results

QUANTITIES: Mapping[str, tuple[str, str]] = {
    "x_px": ("position of a sheet (not in x_err_px)", "px"),
    "mu": ("μ", ""),
    "T0_N": ("𝒯_0", "N"),
    "A": ("A", ""),
    "N_hat_N": ("N̂", "N"),
    "Y_eff_GPa": ("Y_eff", "GPa"),
    "Lambda_hat_mm": ("Λ̂", "mm"),
    "K_N_per_mm": ("K", "N/mm"),
    "ratio": ("σ_x/Λ_st", ""),
}
"""Quantities with systematic errors: the name in tables, and the unit."""
SOURCES = {
    "d0": "initial separation d0",
    "load_drift": "drift of the load cell",
    "steps": "steps of the displacement",
    "low_pass": "load cell's low-pass",
    "filter": "filter that may have lengthened slips",
    "average": "average of a load that rings",
    "sampling": "rise of the force during a slip",
    "thickness_mm": "thickness of a sheet",
    "width_mm": "width of the sheets",
    "length_mm": "length of the sheets",
    "t_star_N": "T*, friction of adhering sheets",
    "strip": "choice of the strip's rows",
    "light": "uneven light",
    "pixel_size": "pixel size",
    "clock": "clock",
    "machine": "compliance of the machine",
}


@dataclass(frozen=True, kw_only=True)
class Budget:
    """Errors of the quantities that a run measured (keys of `QUANTITIES`), in their units; NaN: not known."""

    values: Mapping[str, float]
    statistical: Mapping[str, float]  # standard errors; for positions and σ_x/Λ_st the median
    # systematic errors: source (key of `SOURCES`) to quantity to error; None if the error is not known, no
    # entry if the source does not affect the quantity
    sources: Mapping[str, Mapping[str, float | None]]

    def total(self, quantity: str) -> float:
        """Return the root of the sum of squares of the known errors; NaN if only zeros are known."""
        known = [error for errors in self.sources.values() if (error := errors.get(quantity)) is not None]
        total = math.hypot(*known) if known else math.nan
        return math.nan if total == 0 and self.unknown(quantity) else total

    def unknown(self, quantity: str) -> list[str]:
        """Return the sources whose error is not known, which the total lacks."""
        return [name for name, errors in self.sources.items() if errors.get(quantity, 0.0) is None]

    def to_json(self) -> dict[str, dict[str, object]]:
        """Return for run.json: quantity to value, statistical and systematic error, and error by source."""
        return {
            quantity: {
                "value": self.values[quantity],
                "statistical": self.statistical[quantity],
                "systematic": self.total(quantity),
                "sources": {
                    name: errors[quantity] for name, errors in self.sources.items() if quantity in errors
                },
            }
            for quantity in self.values
        }


def systematic_budget(results: Results) -> Budget:
    """Return the budget of a run's results; empty without tracks, motion and fits.

    Errors of the fitted parameters are those of `ModelFits.budget` (a fit repeated with each source changed).
    The strip's rows and uneven light shift each sheet by a constant, which displacements and σ_x do not have.
    The pixel size scales σ_x/Λ_st; its error is not known. An error of the clock does not affect σ_x as long
    as it is smaller than the time left out beside each slip. A machine that is not stiff moves less at the
    sample than its crosshead does: K and σ_x/Λ_st are too small by K over its stiffness, unless corrected.
    """
    values: dict[str, float] = {}
    statistical: dict[str, float] = {}
    sources: dict[str, dict[str, float | None]] = {}

    def add(source: str, quantity: str, error: float | None) -> None:
        sources.setdefault(source, {})[quantity] = error

    if results.tracks is not None:
        values["x_px"] = math.nan  # a position for every sheet and frame
        statistical["x_px"] = float(nan_median(results.tracks["x_err_px"].values.ravel()))
        add("strip", "x_px", StripMetadata.of(results.tracks).strip_err_px)
        light = None if results.strip is None else uneven_light_px(results.strip, results.tracks)
        add("light", "x_px", light)
    if results.fits is not None and results.sticks is not None:
        fitted = results.fits.named()
        for quantity, estimate in fitted.items():
            values[quantity], statistical[quantity] = estimate.value, estimate.error
        for source, errors in results.fits.budget.items():
            for quantity in (*fitted, "K_N_per_mm"):
                add(source, quantity, errors[quantity])
        values["K_N_per_mm"] = float(nan_median(results.sticks["K_N_per_mm"].to_numpy(float)))
        statistical["K_N_per_mm"] = float(nan_median(results.sticks["K_err_N_per_mm"].to_numpy(float)))
    if results.motion is not None:
        values["ratio"] = float(nan_median(results.motion["ratio"].values.ravel()))
        statistical["ratio"] = float(nan_median(results.motion["ratio_err"].values.ravel()))
        add("pixel_size", "ratio", None)
        if results.clock is not None:
            margin_s = MotionMetadata.of(results.motion).margin_s
            add("clock", "ratio", 0.0 if 1e-3 * results.clock.error_ms <= margin_s else None)
    affected = {"K_N_per_mm", "Lambda_hat_mm", "N_hat_N", "Y_eff_GPa", "ratio"} & values.keys()
    sticks = results.sticks if affected else None
    if sticks is not None and math.isnan(StickMetadata.of(sticks).machine_stiffness_N_per_mm):
        sources["machine"] = dict.fromkeys(sorted(affected))
    return Budget(values=values, statistical=statistical, sources=sources)


def uneven_light_px(strip: xr.DataArray, tracks: xr.Dataset) -> float | None:
    r"""Return by how much uneven light shifts the ridges, RMS over the sheets in px; None if not known.

    A Gaussian ridge of standard width :math:`\sigma` and height C (negative if dark) stands at :math:`x_n` on
    a level V. In light of intensity L(x), a parabola fitted over a window of w pixels has its vertex at x,
    where to first order

    .. math:: x - x_n = \frac{L'}{L}\, \frac{V + C}{C}\, \left(\sigma^2 + \frac{w^2}{20}\right)

    (:math:`w^2/20` is the variance of the parabolic kernel whose convolution with the profile has the
    parabola's slope). V and :math:`L'/L` are measured in the gaps on both sides of a ridge in the mean frame.
    """
    found = TrackMetadata.of(tracks)
    x = nan_median(tracks["x_px"].values) - float(strip["x"].values[0])  # column of each sheet
    known = frames_with_values(strip.values[:, :1])
    if x.size < 3 or not known.any() or not math.isfinite(found.pitch_px):
        return None
    frames = np.flatnonzero(known)
    sample = frames[spread_indices(frames.size, 50)]
    mean = some_rows(strip.values, sample).astype(np.float64).mean(axis=0)
    column = np.arange(mean.size)
    gaps = np.interp(x[:-1] + np.diff(x) / 2, column, mean)
    level = (gaps[1:] + gaps[:-1]) / 2
    slope = np.diff(gaps) / ((x[2:] - x[:-2]) / 2)
    top = np.interp(x[1:-1], column, mean)
    height = np.abs(top - level)
    variance = (found.ridge_fwhm_px / FWHM) ** 2 + found.window_px**2 / 20
    with np.errstate(divide="ignore", invalid="ignore"):
        shift = slope / level * top / height * variance
    size = rms(shift)
    return size if math.isfinite(size) else None
