r"""Sheet-resolved pull: 2M springs whose thresholds decide which of them stick.

Each of the 2M sheets is a spring of stiffness k = εWY/L between its clamp and two faces with friction. It
sticks while its load T is below the threshold T_s of both faces. In a slip its load is reflected at the level
T_d of dynamic friction, as for a spring and block:

.. math:: T_s = 2\mu N + T^*, \qquad T_d = (2\mu - A) N + T^*, \qquad T \to 2T_d - T

with A = 2(μ_s − μ_d). The normal force N(n, d) follows Eq. 2 and is updated as d grows. If every sheet is at
its threshold, the loads are T* exp(α(1 − (n/M)²)). Their sum over the 2M sheets, at the positions n − ½, is
Eq. 1 to 5e-6, in whose continuum limit it is an integral over n.

Sheets that slip individually are rarely at their thresholds at the same time: the force stays near 1 − A/2μ
of Eq. 1. In the publication, all sheets slip at once and the peaks follow Eq. 1. The model gives this result,
since a sheet at its threshold creeps, held by those that still stick, and the assembly slips when none
sticks.

M_eff, Λ_st and σ_x/Λ_st do not enter. Source: Plati, Restagno & Poulard, Eqs. 1 and 2 and section "Stick-slip
in a simple spring-block model".
"""

# ruff: noqa: N815 (the unit is part of a name, and newton is N)
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr

from vision.models.equations import normal_force, sheet_stiffness
from vision.numeric import Floats
from vision.sample import PUBLISHED, Sample

_CLOSE = 1e-9  # tolerance of the threshold at which a slip is found, relative
_NARROW = 1e-13  # tolerance of d, relative


@dataclass(frozen=True, kw_only=True)
class SheetPull:
    """Parameters of a sheet-resolved pull; the defaults are the publication's numbers.

    Parameters
    ----------
    sample
        M, ε, W, L and T*.
    mu, amplitude
        μ (static) and A = 2(μ_s − μ_d).
    modulus_GPa
        Young's modulus Y of one sheet: k = εWY/L.
    speed_mm_min, d0_mm, d_end_mm
        Speed, initial and final separation.
    threshold_factor
        Factor on the threshold of each sheet from left to right, shape (2M,); None for equal sheets.
    longest_step_um
        Largest step of d between updates of N.
    """

    sample: Sample = PUBLISHED
    mu: float = 0.89
    amplitude: float = 0.34
    modulus_GPa: float = 3.8
    speed_mm_min: float = 1.0
    d0_mm: float = 13.0
    d_end_mm: float = 18.0
    threshold_factor: tuple[float, ...] | None = None
    longest_step_um: float = 0.5

    @property
    def stiffness_N_per_mm(self) -> float:
        """Stiffness k of one sheet."""
        return float(sheet_stiffness(modulus_GPa=self.modulus_GPa, sample=self.sample))

    def normal_N(self, d_mm: float) -> Floats:
        """Return N of Eq. 2 for the sheets of one side from the centre outwards, (M,)."""
        n = np.arange(int(self.sample.sheets_per_block)) + 0.5
        return np.asarray(normal_force(n, d_mm, mu=self.mu, sample=self.sample))


class _Assembly:
    """The sheets of a pull at a separation d. Loads are (2, M), left side first, from the centre outwards."""

    def __init__(self, pull: SheetPull) -> None:
        self.pull, self.k, self.d = pull, pull.stiffness_N_per_mm, pull.d0_mm
        count = int(pull.sample.sheets_per_block)
        given = np.ones(2 * count) if pull.threshold_factor is None else np.asarray(pull.threshold_factor)
        self.factor = np.stack([given[:count][::-1], given[count:]])
        self.load = np.zeros((2, count))

    def thresholds(self, d: float) -> tuple[Floats, Floats]:
        """Return T_s and T_d at a separation, (2, M)."""
        normal = self.pull.normal_N(d)
        top = 2 * self.pull.mu * normal + self.pull.sample.t_star_N
        return self.factor * top, self.factor * (top - self.pull.amplitude * normal)

    def margin(self, step: float) -> float:
        """Return (T_s − T)/T_s of the sheet that sticks longest after a step of d."""
        top, _ = self.thresholds(self.d + step)
        return float(((top - self.load - self.k * step) / top).max())

    def advance(self, step: float) -> None:
        """Increase d; sheets that stick gain k·step, the others creep at their thresholds."""
        self.d += step
        self.load = np.minimum(self.load + self.k * step, self.thresholds(self.d)[0])

    def step_to_slip(self, longest: float) -> float:
        """Return the step of d after which no sheet sticks, at most `longest`."""
        low, at_low = 0.0, max(self.margin(0.0), 0.0)
        high = step = longest
        at_high = margin = self.margin(longest)
        while not (margin >= -_CLOSE and (step == longest or margin <= _CLOSE)):
            if high - low <= _NARROW * self.d:
                return high
            # Loads and thresholds are nearly linear within a step: take the crossing of lines.
            step = low + (high - low) * at_low / (at_low - at_high)
            margin = self.margin(step)
            if margin < 0:
                high, at_high = step, margin
            else:
                low, at_low = step, margin
        return step

    def slip(self) -> None:
        """Reflect all loads at the level of dynamic friction."""
        top, level = self.thresholds(self.d)
        self.load = np.minimum(np.maximum(2 * level - self.load, 0.0), top)


def pull_sheets(pull: SheetPull) -> xr.Dataset:
    """Simulate the whole pull, event by event; it starts without loads.

    Returns
    -------
    xarray.Dataset
        Along ``step``: ``d_mm``, ``time_s``, ``force_N`` (sum of the loads), ``load_N`` (step, sheet) and
        ``slipped``. A slip consists of two steps at the same d and time; ``slipped`` is True on the second.
        Between steps loads are linear in d. Sheets are ordered from left to right, with ``side`` and ``n``.
        attrs: ``stiffness_N_per_mm`` of one sheet.
    """
    sheets = _Assembly(pull)
    steps = [(sheets.d, sheets.load, False)]
    while sheets.d < pull.d_end_mm * (1 - 1e-12):
        # Sheets reach their thresholds one after the other within a stick phase, which needs short steps.
        stick = 2 * pull.amplitude * float(pull.normal_N(sheets.d).max()) / sheets.k
        longest = min(pull.longest_step_um / 1000, stick / 20, pull.d_end_mm - sheets.d)
        sheets.advance(sheets.step_to_slip(longest))
        steps.append((sheets.d, sheets.load, False))
        if sheets.margin(0.0) <= _CLOSE:
            sheets.slip()
            steps.append((sheets.d, sheets.load, True))
    d, loads, slipped = (np.array(part) for part in zip(*steps, strict=True))
    load = np.concatenate([loads[:, 0, ::-1], loads[:, 1]], axis=1)
    number = np.arange(1, load.shape[1] // 2 + 1)
    return xr.Dataset(
        {
            "d_mm": ("step", d),
            "time_s": ("step", 60 * (d - d[0]) / pull.speed_mm_min),
            "force_N": ("step", load.sum(axis=1)),
            "load_N": (("step", "sheet"), load),
            "slipped": ("step", slipped),
        },
        coords={
            "side": ("sheet", np.repeat([-1, 1], number.size)),
            "n": ("sheet", np.r_[number[::-1], number]),
        },
        attrs={"stiffness_N_per_mm": sheets.k},
    )
