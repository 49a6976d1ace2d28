"""What the fits give: values with their errors, how well the models follow, and their form in models.json."""

# ruff: noqa: N815 (the unit is part of a name, and newton is N)
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from vision.escaping import html_table
from vision.models import equations
from vision.numeric import Floats
from vision.sample import Sample


@dataclass(frozen=True)
class Estimate:
    """A value, its standard error and its systematic error; errors that are not known are NaN."""

    value: float
    error: float
    systematic_error: float = float("nan")


@dataclass(frozen=True)
class Goodness:
    """How well one model follows its points.

    Parameters
    ----------
    points
        How many.
    scatter
        Root mean square of the deviation over the model.
    chi2_dof
        Squared deviations over the point-to-point scatter of neighbours, which knows no model: about 1 where
        the model's shape is right, more where it is not.
    """

    points: int
    scatter: float
    chi2_dof: float


@dataclass(frozen=True, kw_only=True)
class ModelFits:
    """Parameters of the paper's models for one recording, with standard errors.

    Parameters
    ----------
    mu, t0_N
        Friction coefficient, and offset of the peak forces.
    t_star_N
        T*; its error is NaN where it was held fixed.
    amplitude, n_hat_N, modulus_GPa
        A, N-hat and Y_eff.
    scale_mm
        Lambda-hat, where M_eff reaches 0.
    bending_mm
        Bending length of the outermost sheet at mid-test.
    goodness
        Of the fits to "peaks", "drops" and "stiffness".
    correlation
        Of the pairs of parameters that are fitted together.
    d_mm
        Separation at the first and last event used.
    sample
        As given.
    notes
        What limits the result.
    warnings
        Why it may be wrong.
    held
        Names of parameters that were given, not fitted.
    left_out
        Events not used, by the reason: "flagged", "build_up" (before the peaks' maximum), "misfit" (after it,
        before Eq. 1 fits) and "outside" the range given.
    budget
        Source of a systematic error to what it contributes to each parameter; None where it is not known.
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
    sample: Sample
    notes: tuple[str, ...]
    warnings: tuple[str, ...] = ()
    held: tuple[str, ...] = ()
    left_out: Mapping[str, int] = field(default_factory=dict)
    budget: Mapping[str, Mapping[str, float | None]] = field(default_factory=dict)

    def reduced_separation(self, d_mm: ArrayLike) -> Floats:
        """Separation over Lambda-hat, without unit."""
        return np.asarray(d_mm, float) / self.scale_mm.value

    def effective_sheets(self, d_mm: ArrayLike) -> Floats:
        """M_eff per side that the force implies at d; 0 beyond Lambda-hat."""
        return equations.effective_sheets(self.reduced_separation(d_mm), sample=self.sample)

    def peak_force_N(self, d_mm: ArrayLike) -> Floats:
        """The fitted peak force, traction plus offset."""
        sample = replace(self.sample, t_star_N=self.t_star_N.value)
        return np.asarray(equations.traction(d_mm, mu=self.mu.value, sample=sample) + self.t0_N.value)

    def stiffness_N_per_mm(self, d_mm: ArrayLike) -> Floats:
        """The fitted K(d) = M_eff K_eff."""
        one = equations.sheet_stiffness(modulus_GPa=self.modulus_GPa.value, sample=self.sample)
        return np.asarray(self.effective_sheets(d_mm) * one)

    @property
    def chi2_dof(self) -> float:
        """That of the three fits together."""
        return float(np.mean([good.chi2_dof for good in self.goodness.values()]))

    def _repr_html_(self) -> str:
        named = {
            "μ": (self.mu, ""),
            "𝒯0": (self.t0_N, "N"),
            "A": (self.amplitude, ""),
            "N̂": (self.n_hat_N, "N"),
            "Y_eff": (self.modulus_GPa, "GPa"),
            "Λ̂": (self.scale_mm, "mm"),
        }
        rows = {
            name: f"{one.value:.5g}" + (f" ± {one.error:.2g}" if np.isfinite(one.error) else "") + f" {unit}"
            for name, (one, unit) in named.items()
        }
        rows["d"] = f"{self.d_mm[0]:.2f} to {self.d_mm[1]:.2f} mm"
        rows |= {
            f"χ²/dof, {name}": f"{good.chi2_dof:.3g} ({good.points} points)"
            for name, good in self.goodness.items()
        }
        rows |= {f"note {k}": line for k, line in enumerate(self.notes, 1)}
        return html_table("models fitted to the force recording", rows)

    def to_json(self) -> dict[str, Any]:
        """The content of models.json: values with errors, how well they fit, and the sample; no NaN in it."""
        named = {
            "mu": self.mu,
            "T0_N": self.t0_N,
            "A": self.amplitude,
            "N_hat_N": self.n_hat_N,
            "Y_eff_GPa": self.modulus_GPa,
            "Lambda_hat_mm": self.scale_mm,
            "bending_length_mm": self.bending_mm,
        }
        if np.isfinite(self.t_star_N.error):
            named["T_star_N"] = self.t_star_N
        content = {
            **{name: asdict(estimate) for name, estimate in named.items()},
            "events_used": self.goodness["peaks"].points,
            "fit_range_mm": self.d_mm,
            "chi2_dof": self.chi2_dof,
            "sample": asdict(self.sample),
            "goodness": {name: asdict(good) for name, good in self.goodness.items()},
            "correlation": self.correlation,
            "d_mm": self.d_mm,
            "d_hat": tuple(self.reduced_separation(self.d_mm).tolist()),
            "M_eff": tuple(self.effective_sheets(self.d_mm).tolist()),
            "held": self.held,
            "events_left_out": dict(self.left_out),
            "budget": {source: dict(parts) for source, parts in self.budget.items()},
            "notes": self.notes,
            "warnings": self.warnings,
        }
        return {key: _without_nan(item) for key, item in content.items()}


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(item) for item in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
