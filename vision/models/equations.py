"""The paper's equations for the whole assembly: amplification, traction, normal force, stiffness.

Every function is vectorised over separation (and sheet number, where there is one) and follows NumPy
broadcasting. Separations are in mm, forces in N, moduli in GPa. Defaults are the paper's sample: M = 25
sheets on each side of the axis, 0.1 mm thick, 45 mm wide, 57 mm from clamp to sheet end (`PAPER`), and
T* = 3 mN. NaN comes back only where an input is NaN or has no meaning (negative friction, separation not
positive).
Source: Plati, Restagno & Poulard, Eqs. 1-2 and section IV; Alarcon et al. 2016 for the traction model.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

T_STAR_N = 0.003


@dataclass(frozen=True, kw_only=True)
class Assembly:
    """A sample: sheets on each side of the axis, their thickness and width, clamp to sheet end."""

    sheets_per_side: int = 25
    thickness_mm: float = 0.1
    width_mm: float = 45.0
    length_mm: float = 57.0


PAPER = Assembly()

_LARGEST_EXPONENT = 700.0
"""exp() of this is still a finite double: forces saturate there, so a fit that strays meets no infinity."""
_SERIES_BELOW = 1e-4
"""Below this amplification the closed form of the mean excess loses digits and its series takes over."""


def amplification(d_mm: ArrayLike, *, mu: ArrayLike, assembly: Assembly = PAPER) -> Array:
    """Amplification parameter alpha = 2 eps mu M^2 / d, without unit; NaN where d <= 0 or mu < 0."""
    d, friction = np.asarray(d_mm, float), np.asarray(mu, float)
    with np.errstate(divide="ignore", invalid="ignore"):
        alpha = 2 * assembly.thickness_mm * friction * assembly.sheets_per_side**2 / d
    return np.where((d > 0) & (friction >= 0), alpha, np.nan)


def mean_amplification_excess(alpha: ArrayLike) -> Array:
    """Mean over s = n/M from 0 to 1 of e^(alpha (1 - s^2)) - 1.

    In closed form sqrt(pi/4 alpha) e^alpha erf(sqrt alpha) - 1; 0 at alpha = 0 (no amplification).
    Saturates instead of overflowing; NaN for negative alpha.
    """
    from scipy.special import erf

    a = np.asarray(alpha, float)
    positive = np.where(a > _SERIES_BELOW, a, 1.0)
    exponent = np.minimum(positive, _LARGEST_EXPONENT)
    closed = np.sqrt(np.pi / (4 * positive)) * np.exp(exponent) * erf(np.sqrt(positive)) - 1
    series = 2 * a / 3 + 4 * a**2 / 15
    return np.where(a < 0, np.nan, np.where(a > _SERIES_BELOW, closed, series))


def traction(
    d_mm: ArrayLike, *, mu: ArrayLike, t_star_N: float = T_STAR_N, assembly: Assembly = PAPER
) -> Array:
    """Total static friction in N that resists the pull, Eq. 1.

    2 M T* sqrt(pi/4 alpha) e^alpha erf(sqrt alpha), which tends to 2 M T* for large d. The peaks of a
    recording follow it up to a constant offset, since the load cell is zeroed at d0. This is the continuum
    limit as printed; the sum over 25 discrete sheets lies 6-7 % below.
    """
    alpha = amplification(d_mm, mu=mu, assembly=assembly)
    return np.asarray(2 * assembly.sheets_per_side * t_star_N * (1 + mean_amplification_excess(alpha)))


def normal_force(
    n: ArrayLike, d_mm: ArrayLike, *, mu: ArrayLike, t_star_N: float = T_STAR_N, assembly: Assembly = PAPER
) -> Array:
    """Normal force in N on sheet n, Eq. 2: (T*/2mu) (e^(alpha (1 - (n/M)^2)) - 1).

    n counts from the centre outwards (0 is the axis itself, M the outermost sheet, where the force is 0).
    """
    alpha = amplification(d_mm, mu=mu, assembly=assembly)
    share = 1 - (np.asarray(n, float) / assembly.sheets_per_side) ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        force = (
            t_star_N / (2 * np.asarray(mu, float)) * np.expm1(np.minimum(alpha * share, _LARGEST_EXPONENT))
        )
    without_friction = (
        t_star_N * assembly.thickness_mm * assembly.sheets_per_side**2 / np.asarray(d_mm, float) * share
    )
    return np.where(np.asarray(mu) == 0, without_friction, force)


def total_normal_force(
    d_mm: ArrayLike, *, mu: ArrayLike, t_star_N: float = T_STAR_N, assembly: Assembly = PAPER
) -> Array:
    """Normal force in N summed over the 4M faces: 4M times the mean of Eq. 2 = (traction - 2 M T*) / mu.

    The paper calls it an average; it is a total. NaN at mu = 0, where it has no use.
    """
    alpha = amplification(d_mm, mu=mu, assembly=assembly)
    friction = np.where(np.asarray(mu, float) > 0, mu, np.nan)
    return np.asarray(2 * assembly.sheets_per_side * t_star_N * mean_amplification_excess(alpha) / friction)


def stick_slip_amplitude(
    d_mm: ArrayLike,
    *,
    mu: ArrayLike,
    prefactor: float = 0.34,
    t_star_N: float = T_STAR_N,
    assembly: Assembly = PAPER,
) -> Array:
    """Force drop of one event in N: A (`prefactor`) times the total normal force."""
    total = total_normal_force(d_mm, mu=mu, t_star_N=t_star_N, assembly=assembly)
    return prefactor * total


def separation_scale_mm(
    *, mu: ArrayLike, n_hat_N: ArrayLike, t_star_N: float = T_STAR_N, assembly: Assembly = PAPER
) -> Array:
    """Separation in mm beyond which no sheet is pressed harder than N-hat.

    2 mu eps M^2 / ln(1 + 2 mu N-hat / T*).
    """
    friction = np.asarray(mu, float)
    return np.asarray(
        2
        * friction
        * assembly.thickness_mm
        * assembly.sheets_per_side**2
        / np.log1p(2 * friction * np.asarray(n_hat_N) / t_star_N)
    )


def reduced_separation(
    d_mm: ArrayLike,
    *,
    mu: ArrayLike,
    n_hat_N: ArrayLike,
    t_star_N: float = T_STAR_N,
    assembly: Assembly = PAPER,
) -> Array:
    """Reduced separation d-hat = ln(1 + 2 mu N-hat / T*) / alpha = d / separation scale, without unit."""
    scale = separation_scale_mm(mu=mu, n_hat_N=n_hat_N, t_star_N=t_star_N, assembly=assembly)
    return np.asarray(d_mm, float) / scale


def effective_sheets(d_hat: ArrayLike, *, assembly: Assembly = PAPER) -> Array:
    """Sheets a side that carry the pull, M_eff = M sqrt(1 - d-hat).

    0 (not NaN) where d-hat > 1, which happens inside the quoted ranges: there no sheet is pressed beyond
    N-hat.
    """
    d = np.asarray(d_hat, float)
    return np.where(np.isnan(d), np.nan, assembly.sheets_per_side * np.sqrt(np.maximum(1 - d, 0)))


def sheet_stiffness(*, modulus_GPa: ArrayLike, assembly: Assembly = PAPER) -> Array:
    """Stiffness of one sheet in N/mm, eps W Y / L (Y_p gives K_p, Y_eff gives K_eff)."""
    newton_per_mm2 = 1000 * np.asarray(modulus_GPa, float)
    return np.asarray(assembly.thickness_mm * assembly.width_mm * newton_per_mm2 / assembly.length_mm)


def assembly_stiffness(
    d_mm: ArrayLike,
    *,
    mu: ArrayLike,
    n_hat_N: ArrayLike,
    modulus_GPa: ArrayLike,
    t_star_N: float = T_STAR_N,
    assembly: Assembly = PAPER,
) -> Array:
    """Stiffness of the assembly in N/mm, K = M_eff K_eff; 0 where d-hat > 1."""
    d_hat = reduced_separation(d_mm, mu=mu, n_hat_N=n_hat_N, t_star_N=t_star_N, assembly=assembly)
    one = sheet_stiffness(modulus_GPa=modulus_GPa, assembly=assembly)
    return effective_sheets(d_hat, assembly=assembly) * one
