"""The paper's equations for the whole sample: amplification, traction, normal force, stiffness.

Every function follows NumPy broadcasting over separation (and sheet number, where there is one). Separations
are in mm, forces in N, moduli in GPa; the sample is the publication's unless another is given. NaN comes back
only where an input is NaN or has no meaning (negative friction, separation not positive).
Source: Plati, Restagno & Poulard, Eqs. 1-2 and section IV; Alarcon et al. 2016 for the traction model.
"""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import ArrayLike

from vision.numeric import Floats
from vision.sample import PUBLISHED, Sample

_LARGEST_EXPONENT = 700.0
"""exp() of this is still a finite double: forces saturate there, so a fit that strays meets no infinity."""
_SERIES_BELOW = 1e-4
"""Below this amplification the closed form of the mean excess loses digits and its series takes over."""


def amplification(d_mm: ArrayLike, *, mu: ArrayLike, sample: Sample = PUBLISHED) -> Floats:
    r"""Amplification parameter, without unit; NaN where d <= 0 or mu < 0.

    .. math:: \alpha = 2 \epsilon \mu M^2 / d
    """
    d, friction = np.asarray(d_mm, float), np.asarray(mu, float)
    with np.errstate(divide="ignore", invalid="ignore"):
        alpha = 2 * sample.thickness_mm * friction * sample.sheets_per_block**2 / d
    return np.where((d > 0) & (friction >= 0), alpha, np.nan)


def mean_amplification_excess(alpha: ArrayLike) -> Floats:
    r"""Mean over s = n/M from 0 to 1 of the amplification of the normal force less one.

    .. math:: \int_0^1 e^{\alpha (1 - s^2)} ds - 1
        = \sqrt{\frac{\pi}{4 \alpha}}\, e^\alpha\, \mathrm{erf}\sqrt\alpha - 1

    0 at alpha = 0 (no amplification); saturates instead of overflowing; NaN for negative alpha.
    """
    a = np.asarray(alpha, float)
    positive = np.where(a > _SERIES_BELOW, a, 1.0)
    exponent = np.minimum(positive, _LARGEST_EXPONENT)
    closed = np.sqrt(np.pi / (4 * positive)) * np.exp(exponent) * scipy.special.erf(np.sqrt(positive)) - 1
    series = 2 * a / 3 + 4 * a**2 / 15
    return np.where(a < 0, np.nan, np.where(a > _SERIES_BELOW, closed, series))


def traction(d_mm: ArrayLike, *, mu: ArrayLike, sample: Sample = PUBLISHED) -> Floats:
    r"""Total static friction in N that resists the pull, Eq. 1; 2 M T* for large d.

    .. math:: \mathcal T = 2 M T^* \sqrt{\frac{\pi}{4 \alpha}}\, e^\alpha\, \mathrm{erf}\sqrt\alpha

    The peaks of a recording follow it up to a constant offset, since the load cell is zeroed at d0. This is
    the continuum limit as printed; the sum over 25 discrete sheets lies 6-7 % below.
    """
    alpha = amplification(d_mm, mu=mu, sample=sample)
    return np.asarray(2 * sample.sheets_per_block * sample.t_star_N * (1 + mean_amplification_excess(alpha)))


def normal_force(n: ArrayLike, d_mm: ArrayLike, *, mu: ArrayLike, sample: Sample = PUBLISHED) -> Floats:
    r"""Normal force in N on sheet n, Eq. 2.

    .. math:: N(n) = \frac{T^*}{2 \mu} \left(e^{\alpha (1 - (n/M)^2)} - 1\right)

    n counts from the centre outwards (0 is the axis itself, M the outermost sheet, where the force is 0).
    """
    alpha = amplification(d_mm, mu=mu, sample=sample)
    m, t_star = sample.sheets_per_block, sample.t_star_N
    share = 1 - (np.asarray(n, float) / m) ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        excess = np.expm1(np.minimum(alpha * share, _LARGEST_EXPONENT))
        force = t_star / (2 * np.asarray(mu, float)) * excess
        without_friction = t_star * sample.thickness_mm * m**2 / np.asarray(d_mm, float) * share
    return np.where(np.asarray(mu) == 0, without_friction, force)


def sheet_weight_N(
    *, grammage_g_m2: float = 80.0, total_length_mm: float = 75.0, sample: Sample = PUBLISHED
) -> float:
    """Weight m_p g in N of one sheet of a given grammage: 2.6 mN for the publication's, close to its T*.

    The total length counts, with what is clamped and interleaved.
    """
    return 1e-9 * grammage_g_m2 * scipy.constants.g * sample.width_mm * total_length_mm


def normal_force_on_edge(
    n: ArrayLike,
    d_mm: ArrayLike,
    *,
    side: ArrayLike,
    weight_N: float,
    mu: ArrayLike,
    sample: Sample = PUBLISHED,
) -> Floats:
    r"""Normal force in N on sheet n where gravity acts along x: the blocks turned by 90°.

    Parameters
    ----------
    n, d_mm, mu, sample
        As in `normal_force`.
    side
        +1 where the weight points to the axis, -1 where it points away from it.
    weight_N
        m_p g of a sheet, as from `sheet_weight_N`; for blocks turned by an angle, times its sine.

    Returns
    -------
    Newtons; negative where sheets that cannot pull at each other would part.

    Notes
    -----
    .. math:: \frac{dN}{dn} = -\frac{4 \epsilon \mu n}{d} \left(N + \frac{T^*}{2 \mu}\right) \mp 2 m_p g,
        \qquad N(M) = 0,

    which adds to Eq. 2

    .. math:: \pm 2 m_p g \int_n^M e^{\alpha (n'^2 - n^2) / M^2} dn' = \pm \frac{2 m_p g M}{\sqrt\alpha}
        \left[e^{\alpha (1 - s^2)} D(\sqrt\alpha) - D(s \sqrt\alpha)\right], \quad s = n / M

    with Dawson's function D. The two sides cancel: the traction stays that of Eq. 1 as long as no N is
    negative.
    """
    m = sample.sheets_per_block
    root = np.sqrt(amplification(d_mm, mu=mu, sample=sample))
    s = np.asarray(n, float) / m
    with np.errstate(over="ignore"):
        grown = np.exp(root**2 * (1 - s**2)) * scipy.special.dawsn(root) - scipy.special.dawsn(s * root)
    weight = 2 * np.asarray(side) * weight_N * m * grown / root
    return np.asarray(normal_force(n, d_mm, mu=mu, sample=sample) + weight)


def total_normal_force(d_mm: ArrayLike, *, mu: ArrayLike, sample: Sample = PUBLISHED) -> Floats:
    r"""Normal force in N summed over the 4M faces; NaN at mu = 0, where it has no use.

    .. math:: \mathcal N = 4 M \int_0^1 N(M s)\, ds = (\mathcal T - 2 M T^*) / \mu

    The paper calls it an average; it is a total.
    """
    alpha = amplification(d_mm, mu=mu, sample=sample)
    friction = np.where(np.asarray(mu, float) > 0, mu, np.nan)
    excess = mean_amplification_excess(alpha)
    return np.asarray(2 * sample.sheets_per_block * sample.t_star_N * excess / friction)


def stick_slip_amplitude(
    d_mm: ArrayLike, *, mu: ArrayLike, prefactor: float = 0.34, sample: Sample = PUBLISHED
) -> Floats:
    r"""Force drop of one event in N; `prefactor` is A.

    .. math:: \Delta F = A \mathcal N
    """
    return prefactor * total_normal_force(d_mm, mu=mu, sample=sample)


def separation_scale_mm(*, mu: ArrayLike, n_hat_N: ArrayLike, sample: Sample = PUBLISHED) -> Floats:
    r"""Separation in mm beyond which no sheet is pressed harder than N-hat.

    .. math:: \hat\Lambda = \frac{2 \mu \epsilon M^2}{\ln(1 + 2 \mu \hat N / T^*)}
    """
    friction = np.asarray(mu, float)
    length = 2 * friction * sample.thickness_mm * sample.sheets_per_block**2
    return np.asarray(length / np.log1p(2 * friction * np.asarray(n_hat_N) / sample.t_star_N))


def reduced_separation(
    d_mm: ArrayLike, *, mu: ArrayLike, n_hat_N: ArrayLike, sample: Sample = PUBLISHED
) -> Floats:
    r"""Reduced separation, without unit.

    .. math:: \hat d = \ln(1 + 2 \mu \hat N / T^*) / \alpha = d / \hat\Lambda
    """
    return np.asarray(d_mm, float) / separation_scale_mm(mu=mu, n_hat_N=n_hat_N, sample=sample)


def effective_sheets(d_hat: ArrayLike, *, sample: Sample = PUBLISHED) -> Floats:
    r"""Sheets per side that carry the pull.

    .. math:: M_\mathrm{eff} = M \sqrt{1 - \hat d}

    0 (not NaN) where d-hat > 1, which happens inside the quoted ranges: there no sheet is pressed beyond
    N-hat.
    """
    d = np.asarray(d_hat, float)
    return np.where(np.isnan(d), np.nan, sample.sheets_per_block * np.sqrt(np.maximum(1 - d, 0)))


def sheet_stiffness(*, modulus_GPa: ArrayLike, sample: Sample = PUBLISHED) -> Floats:
    r"""Stiffness of one sheet in N/mm (Y_p gives K_p, Y_eff gives K_eff).

    .. math:: K = \epsilon W Y / L
    """
    newton_per_mm2 = 1000 * np.asarray(modulus_GPa, float)
    return np.asarray(sample.thickness_mm * sample.width_mm * newton_per_mm2 / sample.length_mm)


def assembly_stiffness(
    d_mm: ArrayLike,
    *,
    mu: ArrayLike,
    n_hat_N: ArrayLike,
    modulus_GPa: ArrayLike,
    sample: Sample = PUBLISHED,
) -> Floats:
    r"""Stiffness of the sample in N/mm; 0 where d-hat > 1.

    .. math:: K = M_\mathrm{eff} K_\mathrm{eff}
    """
    d_hat = reduced_separation(d_mm, mu=mu, n_hat_N=n_hat_N, sample=sample)
    return effective_sheets(d_hat, sample=sample) * sheet_stiffness(modulus_GPa=modulus_GPa, sample=sample)
