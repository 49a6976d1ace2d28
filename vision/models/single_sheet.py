"""Equations for one sheet or one contact: spring and block, friction laws, Young's modulus, bending, angle.

They follow NumPy broadcasting; forces in N, lengths in mm unless the name gives another unit. NaN comes back
only for NaN or meaningless input.
Source: Plati, Restagno & Poulard, section III.C and appendices.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from vision.numeric import Floats
from vision.sample import PUBLISHED, Sample


@dataclass(frozen=True, kw_only=True)
class SpringBlockCycle:
    """One period of a block dragged slowly through a spring: times in s, lengths in mm, forces in N."""

    stick_time_s: Floats
    slip_time_s: Floats
    lowest_elongation_mm: Floats
    force_drop_N: Floats  # noqa: N815 (the unit is part of the name)
    slow: Floats
    """True where v is below a tenth of (mu_s - mu_d) w / sqrt(m k): elsewhere the formulas do not hold."""


def spring_block(
    *,
    mass_kg: ArrayLike,
    stiffness_N_per_mm: ArrayLike,
    load_N: ArrayLike,
    mu_static: ArrayLike,
    mu_dynamic: ArrayLike,
    speed_mm_s: ArrayLike,
) -> SpringBlockCycle:
    r"""Stick-slip of the spring-block model in the limit of slow pulling.

    .. math:: t_{st} = \frac{2 (\mu_s - \mu_d) w}{k v}, \quad t_{sl} = \pi \sqrt{m / k}, \quad
        u_0 = \frac{(2 \mu_d - \mu_s) w}{k}, \quad \Delta F = 2 (\mu_s - \mu_d) w
    """
    m, k, w, v = (np.asarray(a, float) for a in (mass_kg, stiffness_N_per_mm, load_N, speed_mm_s))
    mu_s, mu_d = np.asarray(mu_static, float), np.asarray(mu_dynamic, float)
    drop = 2 * (mu_s - mu_d) * w
    k_SI = 1000 * k
    return SpringBlockCycle(
        stick_time_s=drop / (k * v),
        slip_time_s=np.pi * np.sqrt(m / k_SI),
        lowest_elongation_mm=(2 * mu_d - mu_s) * w / k,
        force_drop_N=drop,
        slow=v / 1000 < 0.1 * drop / 2 / np.sqrt(m * k_SI),
    )


def static_friction(load_N: ArrayLike, *, a: float = 0.507, b_N: float = 0.143) -> Floats:
    r"""Static friction coefficient under a normal load.

    .. math:: \mu_s(N) = a (1 + b / N)

    Adhesion adds to it at light loads: infinite at zero load, where the friction force itself stays at a b.
    """
    with np.errstate(divide="ignore"):
        return np.asarray(a * (1 + b_N / np.asarray(load_N, float)))


def rheometer_friction(torque_N_mm: ArrayLike, *, load_N: ArrayLike, radius_mm: float = 25.0) -> Floats:
    r"""Friction coefficient of two discs from the torque, under uniform pressure.

    .. math:: \mu = \frac{3 \tau}{2 R N}
    """
    return np.asarray(3 * np.asarray(torque_N_mm, float) / (2 * radius_mm * np.asarray(load_N, float)))


def modulus_from_offset(
    offset_N: ArrayLike, *, thickness_mm: float = PUBLISHED.thickness_mm, width_mm: float = PUBLISHED.width_mm
) -> Floats:
    r"""Young's modulus in GPa from a push-pull branch F = k D + F0 of one strip.

    .. math:: Y = |F_0| / (\epsilon W)

    D is the clamp distance and D0 = -F0/k the strip's free length, so k D0 = abs(F0). The paper prints
    D0 = k/F0, which has the wrong dimension.
    """
    return np.asarray(np.abs(np.asarray(offset_N, float)) / (thickness_mm * width_mm) / 1000)


def modulus_from_slope(
    stiffness_N_per_mm: ArrayLike,
    *,
    length_mm: ArrayLike,
    thickness_mm: float = PUBLISHED.thickness_mm,
    width_mm: float = PUBLISHED.width_mm,
) -> Floats:
    r"""Young's modulus in GPa from a strip's stiffness and length.

    .. math:: Y = k L / (\epsilon W)
    """
    k = np.asarray(stiffness_N_per_mm, float)
    return np.asarray(k * np.asarray(length_mm, float) / (thickness_mm * width_mm) / 1000)


def bending_length_mm(
    n: ArrayLike,
    d_mm: ArrayLike,
    *,
    n_hat_N: ArrayLike,
    modulus_GPa: ArrayLike,
    sample: Sample = PUBLISHED,
) -> Floats:
    r"""Length in mm over which N-hat bends sheet n back upright.

    .. math:: \lambda = \sqrt{\frac{n W Y \epsilon^4}{4 d \hat N}}

    A cantilever of that length and inertia eps^3 W / 12 is deflected by lambda n eps / d.
    """
    rigidity = 1000 * sample.width_mm * np.asarray(modulus_GPa, float) * sample.thickness_mm**4
    lever = 4 * np.asarray(d_mm, float) * np.asarray(n_hat_N, float)
    return np.asarray(np.sqrt(np.asarray(n, float) * rigidity / lever))


def sheet_angle_rad(n: ArrayLike, d_mm: ArrayLike, *, sample: Sample = PUBLISHED) -> Floats:
    """Angle in rad between sheet n and the pull, from clamp to interleaving point: arctan(n eps / d)."""
    return np.asarray(np.arctan(np.asarray(n, float) * sample.thickness_mm / np.asarray(d_mm, float)))


def largest_inward_displacement_mm(n: ArrayLike, *, sample: Sample = PUBLISHED) -> Floats:
    """Bound in mm on how far sheet n can move towards the axis, n eps."""
    return np.asarray(np.asarray(n, float) * sample.thickness_mm)
