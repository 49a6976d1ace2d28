r"""Stick-slip of a block pulled through a spring: exact, in the limit of slow pulling, and by integration.

A block of mass m under the load w is pulled at the speed v through a spring of stiffness k. Its friction
coefficient is μ_s at rest and μ_d < μ_s while it slides. The elongation u of the spring grows as v t until
k u = μ_s w. Then

.. math:: m\ddot u = -k u + \mu_d w, \qquad u(0) = \mu_s w/k, \qquad \dot u(0) = v,

until the block is at rest again, u̇ = v. Source: Plati, Restagno & Poulard, section "Stick-slip in a simple
spring-block model"; Elmer 1997.
"""

# ruff: noqa: N815 (the unit is part of a name, and newton is N)
from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
import xarray as xr
from numpy.typing import ArrayLike

from vision.errors import InputError, check_positive
from vision.numeric import Floats


@dataclass(frozen=True, kw_only=True)
class SpringBlock:
    """Parameters of the block, its spring and its friction.

    Parameters
    ----------
    mass_kg, stiffness_N_per_mm, load_N
        m, k and w.
    mu_static, mu_dynamic
        μ_s > μ_d ≥ 0.

    Raises
    ------
    InputError
        If a number is not positive and finite, or μ_d ≥ μ_s, where there is no stick-slip.
    """

    mass_kg: float
    stiffness_N_per_mm: float
    load_N: float
    mu_static: float
    mu_dynamic: float

    def __post_init__(self) -> None:
        check_positive(**{name: value for name, value in vars(self).items() if name != "mu_dynamic"})
        if not 0 <= self.mu_dynamic < math.inf:
            raise InputError("`mu_dynamic`", "zero or more", f"{self.mu_dynamic!r}")
        if self.mu_dynamic >= self.mu_static:
            raise InputError("`mu_dynamic`", f"less than μ_s = {self.mu_static:g}", f"{self.mu_dynamic:g}")

    @property
    def stiffness_N_per_m(self) -> float:
        """k in N/m."""
        return 1000 * self.stiffness_N_per_mm

    @property
    def critical_speed_mm_s(self) -> float:
        """v_c = (μ_s − μ_d) w / √(mk); pulling is slow if v is far below it."""
        drop = (self.mu_static - self.mu_dynamic) * self.load_N
        return 1000 * drop / math.sqrt(self.mass_kg * self.stiffness_N_per_m)


@dataclass(frozen=True, kw_only=True)
class StickSlipCycle:
    """One period of the stationary motion; each field has the shape of the speeds."""

    stick_time_s: Floats  # t_st
    slip_time_s: Floats  # t_sl
    slip_length_mm: Floats  # Λ_sl = v t_sl, displacement of the pulled end during the slip
    lowest_elongation_mm: Floats  # u0, at the end of the slip
    highest_elongation_mm: Floats  # μ_s w / k, at its start
    force_drop_N: Floats  # Δf = 2 (μ_s − μ_d) w


def stick_slip(block: SpringBlock, speed_mm_s: ArrayLike, *, slow: bool = False) -> StickSlipCycle:
    r"""Stationary cycle at the pulling speed v, mm/s: exact, or as printed for slow pulling.

    Raises
    ------
    InputError
        If a speed is not positive.

    Notes
    -----
    .. math:: t_{st} = \frac{2(\mu_s-\mu_d)w}{kv}, \quad u_0 = \frac{(2\mu_d-\mu_s)w}{k}, \quad
              t_{sl} = 2\sqrt{\frac{m}{k}}\left[\pi - \arctan\frac{(\mu_s-\mu_d)w}{v\sqrt{mk}}\right],
              \quad \Lambda_{sl} = v\,t_{sl}

    The slow limit differs only in t_sl = π √(m/k), which is too short by 6 % at v = 0.1 v_c, 33 % at v_c and
    47 % at 5 v_c; `slow_speed_limit_mm_s` gives the speed up to which it is accurate.
    """
    speed = _speeds(speed_mm_s)
    angle = (
        0.5 * np.pi * np.ones_like(speed) if slow else np.pi - np.arctan(block.critical_speed_mm_s / speed)
    )
    slip_s = 2 * math.sqrt(block.mass_kg / block.stiffness_N_per_m) * angle
    k, w, ones = block.stiffness_N_per_mm, block.load_N, np.ones_like(speed)
    drop = 2 * (block.mu_static - block.mu_dynamic) * w
    return StickSlipCycle(
        stick_time_s=drop / (k * speed),
        slip_time_s=slip_s,
        slip_length_mm=speed * slip_s,
        lowest_elongation_mm=(2 * block.mu_dynamic - block.mu_static) * w / k * ones,
        highest_elongation_mm=block.mu_static * w / k * ones,
        force_drop_N=drop * ones,
    )


def _speeds(speed_mm_s: ArrayLike) -> Floats:
    """Return the speeds as an array; raise InputError if one is not positive."""
    speed = np.asarray(speed_mm_s, float)
    if not (np.isfinite(speed) & (speed > 0)).all():
        raise InputError("`speed_mm_s`", "positive speeds", f"{speed_mm_s!r}")
    return speed


def slow_speed_limit_mm_s(block: SpringBlock, *, tolerance: float = 0.05) -> float:
    r"""Speed above which the slip time of the slow limit is too short by more than the tolerance.

    The tolerance is a fraction of the exact slip time.

    Raises
    ------
    InputError
        If the tolerance is not between 0 and 0.5; the relative error is below 0.5 at every speed.

    Notes
    -----
    .. math:: \frac{v}{v_c} = \tan\left(\frac{\pi}{2}\,\frac{p}{1 - p}\right)

    with the tolerance p; the result is 0.083 v_c for 5 %.
    """
    if not 0 < tolerance < 0.5:
        raise InputError("`tolerance`", "a share between 0 and 0.5", f"{tolerance!r}")
    return block.critical_speed_mm_s * math.tan(0.5 * math.pi * tolerance / (1 - tolerance))


def integrate_motion(
    block: SpringBlock, speed_mm_s: float, *, cycles: int = 3, samples_per_phase: int = 100
) -> xr.Dataset:
    """Integrate the equation of motion, starting from a relaxed spring.

    Parameters
    ----------
    cycles
        Number of slips.
    samples_per_phase
        Number of samples of each stick and each slip.

    Returns
    -------
    xarray.Dataset
        ``elongation_mm``, ``block_speed_mm_s``, ``force_N`` and ``sliding`` over ``time_s``; and over
        ``slip``: ``slip_start_s``, ``slip_end_s``, ``highest_elongation_mm`` and ``lowest_elongation_mm``.

    Raises
    ------
    InputError
        If the speed is not positive, or there is less than one slip or two samples.

    Notes
    -----
    Sticks end where k u reaches μ_s w, and slips end where the block comes to rest; both are found as events
    of the integration (eighth-order Runge-Kutta, relative tolerance 1e-11). The integration is independent of
    the closed forms of `stick_slip` and confirms them to 1e-9 for v/v_c from 0.01 to 5.
    """
    speed = float(_speeds(speed_mm_s)) / 1000
    if cycles < 1 or samples_per_phase < 2:
        found = f"{cycles}, {samples_per_phase}"
        raise InputError("`cycles`, `samples_per_phase`", "at least 1 and 2", found)
    parts = [(np.zeros(1), np.array([[0.0], [speed]]))]
    for phase in range(2 * cycles):
        time, state = parts[-1]
        parts.append(_phase(block, speed, time[-1], state[:, -1], phase % 2 == 1, samples_per_phase))
    parts = parts[1:]
    times, states = (np.concatenate([part[k] for part in parts], axis=-1) for k in range(2))
    ends = np.array([time[-1] for time, _ in parts]).reshape(cycles, 2)
    stretch = 1000 * np.array([state[0, -1] for _, state in parts]).reshape(cycles, 2)
    return xr.Dataset(
        {
            "elongation_mm": ("time_s", 1000 * states[0], {"units": "mm", "long_name": "elongation"}),
            "block_speed_mm_s": ("time_s", 1000 * (speed - states[1]), {"units": "mm/s"}),
            "force_N": (
                "time_s",
                block.stiffness_N_per_m * states[0],
                {"units": "N", "long_name": "spring force"},
            ),
            "sliding": ("time_s", np.repeat(np.arange(2 * cycles) % 2 == 1, samples_per_phase)),
            "slip_start_s": ("slip", ends[:, 0], {"units": "s"}),
            "slip_end_s": ("slip", ends[:, 1], {"units": "s"}),
            "highest_elongation_mm": ("slip", stretch[:, 0], {"units": "mm"}),
            "lowest_elongation_mm": ("slip", stretch[:, 1], {"units": "mm"}),
        },
        coords={"time_s": ("time_s", times, {"units": "s", "long_name": "time"})},
    )


def _phase(
    block: SpringBlock, speed: float, time: float, state: Floats, sliding: bool, samples: int
) -> tuple[Floats, Floats]:
    """Times, (samples,), and (u, u̇), (2, samples), of one stick or one slip, including its end; SI units."""
    m, k = block.mass_kg, block.stiffness_N_per_m
    kinetic, static = block.mu_dynamic * block.load_N, block.mu_static * block.load_N

    def motion(_: float, y: Floats) -> list[float]:
        return [y[1], (kinetic - k * y[0]) / m if sliding else 0.0]

    def ends(_: float, y: Floats) -> float:
        return float(y[1] - speed) if sliding else float(k * y[0] - static)

    ends.terminal, ends.direction = True, 1.0  # type: ignore[attr-defined]
    # A slip lasts at most a period of the free oscillation, a stick until the spring reaches the threshold.
    longest = 2.1 * math.pi * math.sqrt(m / k) if sliding else 1.1 * (static / k - state[0]) / speed
    found: Any = scipy.integrate.solve_ivp(
        motion,
        (time, time + longest),
        [state[0], speed],
        method="DOP853",
        events=ends,
        rtol=1e-11,
        atol=1e-12 * np.array([static / k, speed + static / math.sqrt(m * k)]),
        max_step=longest / 20,
        dense_output=True,
    )
    times = np.linspace(time, float(found.t_events[0][-1]), samples)
    states = np.asarray(found.sol(times), float)
    states[:, -1] = found.y_events[0][-1]
    return times, states


# --- rate-and-state friction --------------------------------------------------------------------------------


def critical_stiffness_N_per_mm(
    *, a: float, b: float, critical_length_um: float, load_N: float, speed_mm_s: float, mass_kg: float = 0.0
) -> float:
    r"""Stiffness of the spring below which steady sliding is unstable and stick-slip begins.

    The friction depends on the speed V and on the age θ of the contacts:

    .. math:: \mu = \mu_0 + a \ln\frac{V}{V_0} + b \ln\frac{V_0 \theta}{D_c}, \qquad
        \dot\theta = 1 - \frac{V \theta}{D_c}, \qquad
        k_c = \frac{(b - a) N}{D_c} \left[1 + \frac{m V^2}{a N D_c}\right]

    Parameters
    ----------
    a, b
        Direct effect of the speed, and effect of the age.
    critical_length_um
        Sliding distance D_c over which contacts are renewed.
    load_N, speed_mm_s, mass_kg
        N, V and m.

    Raises
    ------
    InputError
        If a number is not positive and finite, or b ≤ a, where steady sliding is always stable.

    Notes
    -----
    It follows from the linear stability of steady sliding (Rice and Ruina 1983).
    """
    _check_rate_state(a, b, critical_length_um)
    length = 1e-6 * critical_length_um
    inertia = mass_kg * (1e-3 * speed_mm_s) ** 2 / (a * load_N * length)
    return 1e-3 * (b - a) * load_N / length * (1 + inertia)


def onset_period_s(*, a: float, b: float, critical_length_um: float, speed_mm_s: float) -> float:
    r"""Period of the oscillation at the onset of this instability, for any mass.

    .. math:: 2 \pi \frac{D_c}{V} \sqrt{\frac{a}{b - a}}
    """
    _check_rate_state(a, b, critical_length_um)
    return 2e-3 * math.pi * critical_length_um / speed_mm_s * math.sqrt(a / (b - a))


def _check_rate_state(a: float, b: float, critical_length_um: float) -> None:
    """Raise InputError if steady sliding is always stable, or a number is not positive."""
    check_positive(a=a, b=b, critical_length_um=critical_length_um)
    if b <= a:
        raise InputError("`b`", f"more than a = {a:g}", f"{b:g}")
