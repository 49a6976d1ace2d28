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

from __future__ import annotations

import numpy as np
import xarray as xr

from vision.experiment.settings import Mechanics
from vision.models.equations import normal_force, sheet_stiffness
from vision.numeric import Floats
from vision.sample import PUBLISHED, Sample

_CLOSE = 1e-9  # tolerance of the threshold at which a slip is found, relative
_NARROW = 1e-13  # tolerance of d, relative


def normal_N(d_mm: float, m: Mechanics, sample: Sample = PUBLISHED) -> Floats:
    """Return N of Eq. 2 for the sheets of one side from the centre outwards, (M,)."""
    n = np.arange(int(sample.sheets_per_block)) + 0.5
    return np.asarray(normal_force(n, d_mm, mu=m.mu, sample=sample))


class _Assembly:
    """The sheets of a pull at a separation d. Loads are (2, M), left side first, from the centre outwards."""

    def __init__(self, m: Mechanics, sample: Sample, threshold_factor: Floats | None) -> None:
        self.m, self.sample, self.d = m, sample, m.d0_mm
        self.k = float(sheet_stiffness(modulus_GPa=m.modulus_GPa, sample=sample))
        count = int(sample.sheets_per_block)
        given = np.ones(2 * count) if threshold_factor is None else threshold_factor
        self.factor = np.stack([given[:count][::-1], given[count:]])
        self.load = np.zeros((2, count))

    def thresholds(self, d: float) -> tuple[Floats, Floats]:
        """Return T_s and T_d at a separation, (2, M)."""
        normal = normal_N(d, self.m, self.sample)
        top = 2 * self.m.mu * normal + self.sample.t_star_N
        return self.factor * top, self.factor * (top - self.m.amplitude * normal)

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


def pull_sheets(
    m: Mechanics,
    sample: Sample = PUBLISHED,
    *,
    threshold_factor: Floats | None = None,
    longest_step_um: float = 0.5,
) -> xr.Dataset:
    """Simulate the whole pull, event by event; it starts without loads.

    Parameters
    ----------
    m
        μ (static), A = 2(μ_s − μ_d), Young's modulus Y of one sheet (k = εWY/L), and the pull.
    sample
        M, ε, W, L and T*.
    threshold_factor
        Factor on the threshold of each sheet from left to right, shape (2M,); None for equal sheets.
    longest_step_um
        Largest step of d between updates of N.

    Returns
    -------
    xarray.Dataset
        Along ``step``: ``d_mm``, ``time_s``, ``force_N`` (sum of the loads), ``load_N`` (step, sheet) and
        ``slipped``. A slip consists of two steps at the same d and time; ``slipped`` is True on the second.
        Between steps loads are linear in d. Sheets are ordered from left to right, with ``side`` and ``n``.
        attrs: ``stiffness_N_per_mm`` of one sheet.
    """
    sheets = _Assembly(m, sample, threshold_factor)
    steps = [(sheets.d, sheets.load, False)]
    while sheets.d < m.d_end_mm * (1 - 1e-12):
        # Sheets reach their thresholds one after the other within a stick phase, which needs short steps.
        stick = 2 * m.amplitude * float(normal_N(sheets.d, m, sample).max()) / sheets.k
        longest = min(longest_step_um / 1000, stick / 20, m.d_end_mm - sheets.d)
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
            "time_s": ("step", 60 * (d - d[0]) / m.speed_mm_min),
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
