# ruff: noqa: N815 (the unit is part of a name, and newton is N)
"""What the model fits found, and its form in models.json."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vision.models import equations
from vision.models.equations import Assembly


@dataclass(frozen=True)
class Estimate:
    """A value and its standard error; the error is NaN for a value that was held fixed."""

    value: float
    error: float


@dataclass(frozen=True)
class Goodness:
    """How well one model follows its points.

    scatter: rms deviation over the model.  chi2_dof: squared deviations over the point-to-point scatter of
    neighbours, which knows no model: about 1 where the model's shape is right, more where it is not.
    """

    points: int
    scatter: float
    chi2_dof: float


@dataclass(frozen=True)
class ShellComparison:
    """Sheets found stiff by imaging less the M_eff that the force implies, over events and sides."""

    compared: int
    mean_difference: float
    rms_difference: float


@dataclass(frozen=True, kw_only=True)
class ModelFits:
    """Parameters of the paper's models for one recording, with standard errors.

    scale_mm: Λ̂, where M_eff reaches 0.  bending_mm: λ of the outermost sheet at mid-test.  correlation:
    of the pairs fitted together.  d_mm, d_hat, M_eff: over the events used, first and last.
    """

    mu: Estimate
    t0_N: Estimate
    t_star_N: Estimate
    amplitude: Estimate
    n_hat_N: Estimate
    modulus_GPa: Estimate
    scale_mm: Estimate
    bending_mm: Estimate
    goodness: dict[str, Goodness]
    correlation: dict[str, float]
    d_mm: tuple[float, float]
    assembly: Assembly
    shells: ShellComparison | None
    notes: tuple[str, ...]

    def reduced_separation(self, d_mm: ArrayLike) -> NDArray[np.float64]:
        """d̂ = d / Λ̂."""
        return np.asarray(d_mm, float) / self.scale_mm.value

    def effective_sheets(self, d_mm: ArrayLike) -> NDArray[np.float64]:
        """M_eff a side that the force implies at d; 0 beyond Λ̂."""
        return equations.effective_sheets(self.reduced_separation(d_mm), assembly=self.assembly)

    def peak_force_N(self, d_mm: ArrayLike) -> NDArray[np.float64]:
        """The fitted F_max(d) = 𝒯(d) + 𝒯0."""
        traction = equations.traction(
            d_mm, mu=self.mu.value, t_star_N=self.t_star_N.value, assembly=self.assembly
        )
        return np.asarray(traction + self.t0_N.value)

    def stiffness_N_per_mm(self, d_mm: ArrayLike) -> NDArray[np.float64]:
        """The fitted K(d) = M_eff K_eff."""
        one = equations.sheet_stiffness(modulus_GPa=self.modulus_GPa.value, assembly=self.assembly)
        return np.asarray(self.effective_sheets(d_mm) * one)

    def to_json(self) -> dict[str, Any]:
        """The content of models.json: fitted values with errors, and what was held fixed; no NaN in it."""
        named = {
            "mu": self.mu,
            "T0_N": self.t0_N,
            "T_star_N": self.t_star_N,
            "A": self.amplitude,
            "N_hat_N": self.n_hat_N,
            "Y_eff_GPa": self.modulus_GPa,
            "Lambda_hat_mm": self.scale_mm,
            "bending_length_mm": self.bending_mm,
        }
        fitted = {name: asdict(estimate) for name, estimate in named.items() if np.isfinite(estimate.error)}
        fixed = {name: estimate.value for name, estimate in named.items() if not np.isfinite(estimate.error)}
        content = {
            **fitted,
            "fixed": {**fixed, **asdict(self.assembly)},
            "goodness": {name: asdict(good) for name, good in self.goodness.items()},
            "correlation": self.correlation,
            "d_mm": self.d_mm,
            "d_hat": tuple(self.reduced_separation(self.d_mm).tolist()),
            "M_eff": tuple(self.effective_sheets(self.d_mm).tolist()),
            "shells": asdict(self.shells) if self.shells else None,
            "notes": self.notes,
        }
        return {key: _without_nan(item) for key, item in content.items()}


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(item) for item in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
