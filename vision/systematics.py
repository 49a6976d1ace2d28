"""The budget of systematic errors, which every frame or event shares.

The statistical error of each number does not contain them. Their sources are the initial separation, the
sample's geometry, drift of the load cell, the pixel size, the choice of the strip's rows, uneven light,
ridges that overlap, the clock, and the compliance of the machine.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import xarray as xr

from vision.data import MotionMetadata, StickMetadata, StripMetadata
from vision.models.single_fits import SYMBOLS
from vision.numeric import nan_median, rms, typical

if TYPE_CHECKING:
    from vision.figures import Results

QUANTITIES: Mapping[str, tuple[str, str]] = {
    "x_px": ("absolute position of a sheet", "px"),
    **SYMBOLS,
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
    "overlap": "overlap of neighbouring ridges",
    "shape": "ridges that are brighter on one side",
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
    The strip's rows, uneven light, neighbours and the shape of ridges shift each sheet by a constant, which
    displacements and σ_x do not have (`constant_error_px` of the tracks for each sheet). The pixel size
    scales σ_x/Λ_st. An error of the clock does not affect σ_x as long as it is
    smaller than the time left out beside each slip. A machine that is not stiff moves less at the sample than
    its crosshead does: K and σ_x/Λ_st are too small by K over its stiffness, unless corrected.
    """
    values: dict[str, float] = {}
    statistical: dict[str, float] = {}
    sources: dict[str, dict[str, float | None]] = {}

    def add(source: str, quantity: str, error: float | None) -> None:
        sources.setdefault(source, {})[quantity] = error

    if results.tracks is not None:
        values["x_px"] = math.nan  # a position for every sheet and frame
        statistical["x_px"] = typical(results.tracks["x_err_px"].values)
        add("strip", "x_px", StripMetadata.of(results.tracks).strip_err_px)
        sources |= {one: {"x_px": _size_of(results.tracks, one)} for one in ("light", "overlap", "shape")}
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
        size, error = results.pixel_size_um, results.pixel_size_err_um
        relative = None if size is None or error is None else error / size
        add("pixel_size", "ratio", None if relative is None else abs(values["ratio"]) * relative)
        if results.clock is not None:
            margin_s = MotionMetadata.of(results.motion).margin_s
            add("clock", "ratio", 0.0 if 1e-3 * results.clock.error_ms <= margin_s else None)
    affected = {"K_N_per_mm", "Lambda_hat_mm", "N_hat_N", "Y_eff_GPa", "ratio"} & values.keys()
    sticks = results.sticks if affected else None
    if sticks is not None and math.isnan(StickMetadata.of(sticks).machine_stiffness_N_per_mm):
        sources["machine"] = dict.fromkeys(sorted(affected))
    return Budget(values=values, statistical=statistical, sources=sources)


def _size_of(tracks: xr.Dataset, source: str) -> float | None:
    """Return a shift of positions, root mean square over the sheets; None if it is not known."""
    name = f"x_{source}_px"
    size = rms(tracks[name].values) if name in tracks else math.nan
    return size if math.isfinite(size) else None
