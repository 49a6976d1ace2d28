"""Equations of the publication: amplification, traction, normal force, stiffness; geometry of sheets; and the
stick-slip of a block pulled through a spring.

Functions of separation and sheet number broadcast over both. Separations are in mm, forces in N, moduli in
GPa; the sample is the publication's unless another is given. The result is NaN only where an input is NaN or
out of range (negative friction, separation not positive).
Source: Plati, Restagno & Poulard, Eqs. 1-2, section IV and section "Stick-slip in a simple spring-block
model"; Alarcon et al. 2016 for the traction model; Elmer 1997 for spring and block.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import ArrayLike

from vision.errors import InputError, check_positive, check_within
from vision.numeric import Floats
from vision.sample import PUBLISHED, Sample

_LARGEST_EXPONENT = 700.0  # its exp() is a finite double, so that a fit that diverges meets no infinity


def amplification(d_mm: ArrayLike, *, mu: ArrayLike, sample: Sample = PUBLISHED) -> Floats:
    r"""Amplification parameter, dimensionless; NaN where d <= 0 or mu < 0.

    .. math:: \alpha = 2 \epsilon \mu M^2 / d
    """
    d, friction = np.asarray(d_mm, float), np.asarray(mu, float)
    with np.errstate(divide="ignore", invalid="ignore"):
        alpha = 2 * sample.thickness_mm * friction * sample.sheets_per_block**2 / d
    return np.where((d > 0) & (friction >= 0), alpha, np.nan)


def mean_amplification_excess(alpha: ArrayLike) -> Floats:
    r"""Mean over s = n/M from 0 to 1 of the amplification of the normal force, minus one.

    .. math:: \int_0^1 e^{\alpha (1 - s^2)} ds - 1
        = \sqrt{\frac{\pi}{4 \alpha}}\, e^\alpha\, \mathrm{erf}\sqrt\alpha - 1

    It is 0 at alpha = 0 (no amplification), saturates instead of overflowing, and is NaN for negative alpha.
    """
    a = np.asarray(alpha, float)
    large = a > 1e-4  # below this the closed form loses digits, and its series is used
    positive = np.where(large, a, 1.0)
    exponent = np.minimum(positive, _LARGEST_EXPONENT)
    closed = np.sqrt(np.pi / (4 * positive)) * np.exp(exponent) * scipy.special.erf(np.sqrt(positive)) - 1
    series = 2 * a / 3 + 4 * a**2 / 15
    return np.where(a < 0, np.nan, np.where(large, closed, series))


def traction(d_mm: ArrayLike, *, mu: ArrayLike, sample: Sample = PUBLISHED) -> Floats:
    r"""Total static friction in N that resists the pull, Eq. 1; 2 M T* for large d.

    .. math:: \mathcal T = 2 M T^* \sqrt{\frac{\pi}{4 \alpha}}\, e^\alpha\, \mathrm{erf}\sqrt\alpha

    The peaks of a recording follow it up to a constant offset, since the load cell is zeroed at d0. This is
    the continuum limit as printed; the sum over 25 discrete sheets is 6-7 % smaller.
    """
    alpha = amplification(d_mm, mu=mu, sample=sample)
    return np.asarray(2 * sample.sheets_per_block * sample.t_star_N * (1 + mean_amplification_excess(alpha)))


def normal_force(n: ArrayLike, d_mm: ArrayLike, *, mu: ArrayLike, sample: Sample = PUBLISHED) -> Floats:
    r"""Normal force in N on sheet n, Eq. 2.

    .. math:: N(n) = \frac{T^*}{2 \mu} \left(e^{\alpha (1 - (n/M)^2)} - 1\right)

    n counts from the centre outwards: 0 is the axis, M the outermost sheet, on which the force is 0.
    """
    alpha = amplification(d_mm, mu=mu, sample=sample)
    m, t_star = sample.sheets_per_block, sample.t_star_N
    depth = 1 - (np.asarray(n, float) / m) ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        excess = np.expm1(np.minimum(alpha * depth, _LARGEST_EXPONENT))
        force = t_star / (2 * np.asarray(mu, float)) * excess
        without_friction = t_star * sample.thickness_mm * m**2 / np.asarray(d_mm, float) * depth
    return np.where(np.asarray(mu) == 0, without_friction, force)


def sheet_weight_N(
    *, grammage_g_m2: float = 80.0, total_length_mm: float = 75.0, sample: Sample = PUBLISHED
) -> float:
    """Weight m_p g in N of one sheet of a given grammage: 2.6 mN for the publication's, close to its T*.

    The total length includes the clamped and the interleaved part.
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
    r"""Normal force in N on sheet n if gravity acts along x, as in blocks turned by 90°; negative where the
    sheets would separate.

    side: +1 where the weight points to the axis, -1 where it points away from it.  weight_N: m_p g of a
    sheet, for example from `sheet_weight_N`; for blocks turned by another angle, times the sine of the angle.

    .. math:: \frac{dN}{dn} = -\frac{4 \epsilon \mu n}{d} \left(N + \frac{T^*}{2 \mu}\right) \mp 2 m_p g,
        \qquad N(M) = 0,

    which adds to Eq. 2, with Dawson's function D,

    .. math:: \pm 2 m_p g \int_n^M e^{\alpha (n'^2 - n^2) / M^2} dn' = \pm \frac{2 m_p g M}{\sqrt\alpha}
        \left[e^{\alpha (1 - s^2)} D(\sqrt\alpha) - D(s \sqrt\alpha)\right], \quad s = n / M.

    The contributions of the two sides cancel: the traction is that of Eq. 1 as long as no N is negative.
    """
    m, root = sample.sheets_per_block, np.sqrt(amplification(d_mm, mu=mu, sample=sample))
    s = np.asarray(n, float) / m
    with np.errstate(over="ignore"):
        amplified = np.exp(root**2 * (1 - s**2)) * scipy.special.dawsn(root) - scipy.special.dawsn(s * root)
    from_weight = 2 * np.asarray(side) * weight_N * m * amplified / root
    return np.asarray(normal_force(n, d_mm, mu=mu, sample=sample) + from_weight)


def total_normal_force(d_mm: ArrayLike, *, mu: ArrayLike, sample: Sample = PUBLISHED) -> Floats:
    r"""Normal force in N summed over the 4M faces; NaN at mu = 0.

    .. math:: \mathcal N = 4 M \int_0^1 N(M s)\, ds = (\mathcal T - 2 M T^*) / \mu

    The publication calls it an average, but it is a total.
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
    r"""Separation in mm beyond which no normal force exceeds N-hat.

    .. math:: \hat\Lambda = \frac{2 \mu \epsilon M^2}{\ln(1 + 2 \mu \hat N / T^*)}
    """
    friction = np.asarray(mu, float)
    length = 2 * friction * sample.thickness_mm * sample.sheets_per_block**2
    return np.asarray(length / np.log1p(2 * friction * np.asarray(n_hat_N) / sample.t_star_N))


def reduced_separation(
    d_mm: ArrayLike, *, mu: ArrayLike, n_hat_N: ArrayLike, sample: Sample = PUBLISHED
) -> Floats:
    r"""Reduced separation, dimensionless.

    .. math:: \hat d = \ln(1 + 2 \mu \hat N / T^*) / \alpha = d / \hat\Lambda
    """
    return np.asarray(d_mm, float) / separation_scale_mm(mu=mu, n_hat_N=n_hat_N, sample=sample)


def effective_sheets(d_hat: ArrayLike, *, sample: Sample = PUBLISHED) -> Floats:
    r"""Effective number of sheets per side, which carry the pull.

    .. math:: M_\mathrm{eff} = M \sqrt{1 - \hat d}

    It is 0 (not NaN) where d-hat > 1, because there no normal force exceeds N-hat. This occurs within the
    publication's ranges of the parameters.
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
    d_mm: ArrayLike, *, mu: ArrayLike, n_hat_N: ArrayLike, modulus_GPa: ArrayLike, sample: Sample = PUBLISHED
) -> Floats:
    r"""Stiffness of the sample in N/mm; 0 where d-hat > 1.

    .. math:: K = M_\mathrm{eff} K_\mathrm{eff}
    """
    d_hat = reduced_separation(d_mm, mu=mu, n_hat_N=n_hat_N, sample=sample)
    return effective_sheets(d_hat, sample=sample) * sheet_stiffness(modulus_GPa=modulus_GPa, sample=sample)


# --- geometry of single sheets between the clamp and the interleaved part -----------------------------------


def sheet_angle_rad(n: ArrayLike, d_mm: ArrayLike, *, sample: Sample = PUBLISHED) -> Floats:
    r"""Angle in rad between sheet n and the pull.

    .. math:: \theta(n, d) = \arctan(n\epsilon/d)

    It is 10.89° at n = 25 and d = 13 mm, and 7.91° at 18 mm.
    """
    return np.asarray(np.arctan(np.asarray(n, float) * sample.thickness_mm / np.asarray(d_mm, float)))


def excess_length_mm(n: ArrayLike, d_mm: ArrayLike, *, sample: Sample = PUBLISHED) -> Floats:
    r"""Length of the oblique path of sheet n minus the separation, in mm.

    .. math:: \sqrt{d^2 + (n\epsilon)^2} - d

    Its mean over n = 1 … 25 at d = 13 mm is 0.085 mm, so that sheets of equal length are not equally taut.
    """
    d = np.asarray(d_mm, float)
    return np.asarray(np.hypot(d, np.asarray(n, float) * sample.thickness_mm) - d)


def bending_length_mm(
    n: ArrayLike, d_mm: ArrayLike, *, n_hat_N: ArrayLike, modulus_GPa: ArrayLike, sample: Sample = PUBLISHED
) -> Floats:
    r"""Distance λ in mm from the clamp end at which N̂ bends sheet n parallel to the pull.

    The sheet is a cantilever fixed at the interleaving point:

    .. math:: \hat N = \frac{3\,\delta\,I\,Y_p}{\lambda^3}, \quad \delta = \lambda\,n\epsilon/d, \quad
        I = \frac{\epsilon^3 W}{12}, \qquad \lambda = \sqrt{\frac{n W Y_p \epsilon^4}{4 d \hat N}}

    λ depends on n and d, so always state them with it.
    """
    rigidity = 1000 * np.asarray(modulus_GPa, float) * sample.width_mm * sample.thickness_mm**4
    lever = 4 * np.asarray(d_mm, float) * np.asarray(n_hat_N, float)
    return np.asarray(np.sqrt(np.asarray(n, float) * rigidity / lever))


# --- spring and block ---------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class SpringBlock:
    r"""A block pulled through a spring at the speed v, and its stationary stick-slip.

    The friction coefficient is μ_s at rest and μ_d < μ_s while the block slides. The elongation u of the
    spring grows as v t until k u = μ_s w; then, until the block is at rest again (u̇ = v),

    .. math:: m\ddot u = -k u + \mu_d w, \qquad u(0) = \mu_s w/k, \qquad \dot u(0) = v

    Here m, k and w are `mass_kg`, `stiffness_N_per_mm` and `load_N`. InputError is raised if a number is not
    positive and finite, or μ_d ≥ μ_s, where there is no stick-slip.
    """

    mass_kg: float
    stiffness_N_per_mm: float
    load_N: float
    mu_static: float
    mu_dynamic: float

    def __post_init__(self) -> None:
        check_positive(**{name: value for name, value in vars(self).items() if name != "mu_dynamic"})
        if not 0 <= self.mu_dynamic < self.mu_static:
            wanted = f"at least 0 and less than μ_s = {self.mu_static:g}"
            raise InputError("`mu_dynamic`", wanted, f"{self.mu_dynamic!r}")

    @property
    def critical_speed_mm_s(self) -> float:
        """v_c = (μ_s − μ_d) w / √(mk); pulling is slow if v is far below it."""
        return 500 * self.force_drop_N / math.sqrt(1000 * self.mass_kg * self.stiffness_N_per_mm)

    @property
    def force_drop_N(self) -> float:
        """Δf = 2 (μ_s − μ_d) w."""
        return 2 * (self.mu_static - self.mu_dynamic) * self.load_N

    @property
    def lowest_elongation_mm(self) -> float:
        """u0 = (2 μ_d − μ_s) w / k, at the end of a slip."""
        return (2 * self.mu_dynamic - self.mu_static) * self.load_N / self.stiffness_N_per_mm

    def stick_time_s(self, speed_mm_s: ArrayLike) -> Floats:
        """t_st = 2 (μ_s − μ_d) w / (k v); InputError if a speed is not positive."""
        return self.force_drop_N / (self.stiffness_N_per_mm * _speeds(speed_mm_s))

    def slip_time_s(self, speed_mm_s: ArrayLike, *, slow: bool = False) -> Floats:
        r"""Duration of a slip, exact or in the limit of slow pulling, as printed.

        .. math:: t_{sl} = 2\sqrt{\frac{m}{k}}\left[\pi - \arctan\frac{v_c}{v}\right]
                  \approx \pi\sqrt{\frac{m}{k}}

        The limit is too short by 6 % at v = 0.1 v_c, 33 % at v_c and 47 % at 5 v_c. The pulled end moves by
        Λ_sl = v t_sl meanwhile. InputError if a speed is not positive.
        """
        over_v = self.critical_speed_mm_s / _speeds(speed_mm_s)
        angle = np.full(over_v.shape, np.pi / 2) if slow else np.pi - np.arctan(over_v)
        return np.asarray(2 * math.sqrt(1e-3 * self.mass_kg / self.stiffness_N_per_mm) * angle)


def _speeds(speed_mm_s: ArrayLike) -> Floats:
    """Return the speeds as an array; raise InputError if one is not positive."""
    speed = np.asarray(speed_mm_s, float)
    if not (np.isfinite(speed) & (speed > 0)).all():
        raise InputError("`speed_mm_s`", "positive speeds", f"{speed_mm_s!r}")
    return speed


def onset_of_stick_slip(
    *, a: float, b: float, critical_length_um: float, load_N: float, speed_mm_s: float, mass_kg: float = 0.0
) -> tuple[float, float]:
    r"""Stiffness in N/mm of the spring below which steady sliding is unstable, and the period there, s.

    The friction depends on the speed V and on the age θ of the contacts (rate and state):

    .. math:: \mu = \mu_0 + a \ln\frac{V}{V_0} + b \ln\frac{V_0 \theta}{D_c}, \qquad
        \dot\theta = 1 - \frac{V \theta}{D_c}

    It follows from the linear stability of steady sliding (Rice and Ruina 1983) that

    .. math:: k_c = \frac{(b - a) N}{D_c} \left[1 + \frac{m V^2}{a N D_c}\right], \qquad
        t_c = 2 \pi \frac{D_c}{V} \sqrt{\frac{a}{b - a}}

    Here a is the direct effect of the speed, b that of the age, D_c = `critical_length_um` the distance over
    which contacts are renewed. InputError is raised if b ≤ a, where steady sliding is always stable, or a
    number is not positive and finite (the mass may be 0).
    """
    check_within("a number from 0", 0, math.inf, mass_kg=mass_kg)
    check_positive(a=a, b=b, critical_length_um=critical_length_um, load_N=load_N, speed_mm_s=speed_mm_s)
    if b <= a:
        raise InputError("`b`", f"more than a = {a:g}", f"{b:g}")
    length, speed = 1e-6 * critical_length_um, 1e-3 * speed_mm_s
    stiffness = 1e-3 * (b - a) * load_N / length * (1 + mass_kg * speed**2 / (a * load_N * length))
    return stiffness, 2 * math.pi * length / speed * math.sqrt(a / (b - a))
