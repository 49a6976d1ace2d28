r"""The pull resolved by sheets: 2M springs that stick and slip by themselves.

Each of the 2M sheets is a spring of stiffness k = εWY/L between its clamp and two faces that rub. It sticks
while its load T is below the threshold of both faces, and slips, as a spring and block do, about the level of
dynamic friction:

.. math:: T_s = 2\mu N + T^*, \qquad T_d = (2\mu - A) N + T^*, \qquad T \to 2T_d - T

with A = 2(μ_s − μ_d). The normal force N(n, d) is Eq. 2 and is computed again as d grows. With every sheet at
its threshold the loads are T* exp(α(1 − (n/M)²)), and their sum over the 2M sheets is Eq. 1, of which the
integral over n is the continuum limit.

Sheets that slip one by one are rarely at their thresholds at once: the force stays about 1 − A/2μ of Eq. 1,
and where N follows the loads (which e^α amplifies) about that of Eq. 1 at μ − A/2. The publication sees all
sheets slip at once and Eq. 1 at the peaks. That comes out where a sheet at its threshold creeps, held by
those that still stick, and the assembly slips when none does (``slips="together"``).

Nothing in here knows M_eff, Λ_st or σ_x/Λ_st. Source: Plati, Restagno & Poulard, Eqs. 1 and 2 and section
"Stick- slip in a simple spring-block model"; the normal force of actual loads: their outlook, "the normal
load increases during the stick phase".
"""

# ruff: noqa: N815 (the unit is part of a name, and newton is N)
from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from vision.errors import InputError, check_positive
from vision.models.equations import sheet_stiffness
from vision.numeric import Bools, Floats
from vision.sample import PUBLISHED, Sample

_CHOICES = {
    "normal_force": ("equation", "loads"),
    "positions": ("edges", "middles"),
    "slips": ("alone", "together"),
}


@dataclass(frozen=True, kw_only=True)
class SheetPull:
    """What a sheet-resolved pull is made of; the defaults are the publication's numbers.

    Parameters
    ----------
    sample
        M, ε, W, L and T*.
    mu, amplitude
        μ (static) and A = 2(μ_s − μ_d).
    modulus_GPa
        Y of one sheet: k = εWY/L.
    speed_mm_min, d0_mm, d_end_mm
        The pull.
    normal_force
        "equation": Eq. 2 at d, whatever the loads are; the sheets do not know of each other. "loads": N comes
        from the loads of the sheets outside, with weights such that it is Eq. 2 where all are at their
        threshold; a sheet that slips lowers the normal force on all inside of it.
    positions
        Where sheet n sits: "edges" at n, "middles" at n − ½ (whose sum is the continuum limit to 5e-6).
    slips
        "alone": each sheet slips at its threshold. "together": it creeps there until no sheet sticks, then
        all slip (with Eq. 2 alone).
    machine_N_per_mm
        Of the machine, which springs back when sheets slip and loads the others; infinite by default.
    relaxed
        Start without loads; else with every sheet where a slip from its threshold would leave it.
    threshold_factor
        Of each sheet, left to right, for sheets that differ: shape (2M,); None for equal ones.
    shortest_stick_um
        Sheets whose stick would be shorter slide at T_d instead, without events. Smaller is slower.
    longest_step_um
        Between two computations of N.
    """

    sample: Sample = PUBLISHED
    mu: float = 0.89
    amplitude: float = 0.34
    modulus_GPa: float = 3.8
    speed_mm_min: float = 1.0
    d0_mm: float = 13.0
    d_end_mm: float = 18.0
    normal_force: Literal["equation", "loads"] = "equation"
    positions: Literal["edges", "middles"] = "edges"
    slips: Literal["alone", "together"] = "alone"
    machine_N_per_mm: float = math.inf
    relaxed: bool = True
    threshold_factor: tuple[float, ...] | None = None
    shortest_stick_um: float = 0.5
    longest_step_um: float = 0.5

    def __post_init__(self) -> None:
        names = ("mu", "modulus_GPa", "speed_mm_min", "d0_mm", "shortest_stick_um", "longest_step_um")
        check_positive(**{name: getattr(self, name) for name in names})
        if not self.machine_N_per_mm > 0:
            raise InputError("`machine_N_per_mm`", "a positive number", f"{self.machine_N_per_mm!r}")
        if not self.d0_mm < self.d_end_mm < math.inf:
            raise InputError("`d_end_mm`", f"more than {self.d0_mm:g} mm", f"{self.d_end_mm!r}")
        if not 0 <= self.amplitude <= 2 * self.mu:
            raise InputError("`amplitude`", f"0 to 2μ = {2 * self.mu:g}", f"{self.amplitude!r}")
        for name, choices in _CHOICES.items():
            if getattr(self, name) not in choices:
                raise InputError(f"`{name}`", " or ".join(choices), f"{getattr(self, name)!r}")
        if self.slips == "together" and self.normal_force == "loads":
            raise InputError("`slips`", "alone where N follows the loads", "together")
        count = 2 * int(self.sample.sheets_per_block)
        factor = self.threshold_factor
        if factor is not None and (len(factor) != count or not min(factor) > 0):
            raise InputError("`threshold_factor`", f"{count} positive numbers", f"{len(factor)}")

    @property
    def stiffness_N_per_mm(self) -> float:
        """k of one sheet."""
        return float(sheet_stiffness(modulus_GPa=self.modulus_GPa, sample=self.sample))

    @property
    def n(self) -> Floats:
        """Positions of the sheets of one side, (M,), from the centre outwards."""
        count = int(self.sample.sheets_per_block)
        return np.arange(1.0, count + 1) - (0.5 if self.positions == "middles" else 0.0)


def equation_normal_N(pull: SheetPull, d_mm: float) -> Floats:
    """Eq. 2 for the sheets of one side, (M,): (T*/2μ) (exp(α(1 − (n/M)²)) − 1)."""
    count = int(pull.sample.sheets_per_block)
    alpha = 2 * pull.sample.thickness_mm * pull.mu * count**2 / d_mm
    excess = np.expm1(alpha * (1 - (pull.n / count) ** 2))
    return np.asarray(pull.sample.t_star_N / (2 * pull.mu) * excess)


def threshold_loads_N(pull: SheetPull, d_mm: float) -> Floats:
    """Loads of the sheets of one side, (M,), all at their threshold under Eq. 2.

    Twice their sum is the traction: 0.934 of Eq. 1 at d = 13 mm and 0.944 at 18 mm, at n − ½ equal to 5e-6.
    """
    return _threshold(pull, equation_normal_N(pull, d_mm))


def _threshold(pull: SheetPull, normal: Floats) -> Floats:
    """T_s for normal forces of any shape."""
    return np.asarray(2 * pull.mu * normal + pull.sample.t_star_N)


def _transfer(pull: SheetPull, d_mm: float) -> Floats:
    """c(n), (M,): N(n) = N(n + 1) + c(n) (T(n) + T(n + 1)), beyond the outermost sheet N = T = 0.

    From one sheet to the next inside N grows by the mean of their loads times the slope 2εn/d of the sheets
    there; c is such that loads at their threshold under Coulomb friction give Eq. 2.
    """
    normal = equation_normal_N(pull, d_mm)
    load = _threshold(pull, normal)
    return np.asarray((normal - np.append(normal[1:], 0.0)) / (load + np.append(load[1:], 0.0)))


def normal_of_loads_N(pull: SheetPull, load_N: ArrayLike, d_mm: float) -> Floats:
    """Normal forces from the loads of the sheets outside, both (…, M) from the centre outwards."""
    load = np.asarray(load_N, float)
    pairs = load.copy()
    pairs[..., :-1] += load[..., 1:]
    return np.asarray(np.cumsum((_transfer(pull, d_mm) * pairs)[..., ::-1], axis=-1)[..., ::-1])


def pull_sheets(pull: SheetPull) -> xr.Dataset:
    """The whole pull, event by event.

    Parameters
    ----------
    pull
        `SheetPull`.

    Returns
    -------
    xarray.Dataset
        Over ``step``, in order, where a slip takes two steps of one d, before and after: ``d_mm``,
        ``time_s``, ``force_N`` (sum of the loads), ``load_N`` (step, sheet), ``slipped`` (step, sheet; True
        on the step after a slip), ``work_mJ``, ``elastic_mJ`` and ``dissipated_mJ`` since the start. Between
        steps loads are linear in d. Sheets from left to right, with ``side`` and ``n``. attrs:
        ``stiffness_N_per_mm`` of one sheet.

    Notes
    -----
    Slips take no time. Where the slip of one sheet brings others beyond their threshold (``normal_force``
    "loads", or a machine that springs back), these slip in the same event, until none is.
    """
    return (_Together if pull.slips == "together" else _Run)(pull).run()


_CLOSE = 1e-9  # share of the threshold to which the time of a slip is found
_NARROW = 1e-13  # share of d to which it is found where margins jump


class _Run:
    """State of a pull: loads (2, M), side −1 first, from the centre outwards."""

    def __init__(self, pull: SheetPull) -> None:
        self.pull = pull
        self.k = pull.stiffness_N_per_mm
        self.shortest_N = self.k * pull.shortest_stick_um / 1000
        count = int(pull.sample.sheets_per_block)
        self.factor = np.ones((2, count))
        if pull.threshold_factor is not None:
            given = np.asarray(pull.threshold_factor, float)
            self.factor = np.stack([given[:count][::-1], given[count:]])
        self.d = pull.d0_mm
        self.load = np.zeros((2, count))
        if not pull.relaxed:
            normal = np.broadcast_to(equation_normal_N(pull, self.d), self.load.shape)
            self.load = self.factor * (_threshold(pull, normal) - 2 * pull.amplitude * normal)
        self.start_mJ = self._elastic()
        self.work = self.dissipated = 0.0
        self.energies: list[tuple[float, float, float, float]] = []
        self.loads: list[Floats] = []
        self.slips: list[Bools] = []

    def run(self) -> xr.Dataset:
        """All events up to the end of the pull."""
        none = np.zeros(self.load.shape, bool)
        self._keep(none)
        while self.d < self.pull.d_end_mm * (1 - 1e-12):
            self._advance(min(self._longest_mm(), self.pull.d_end_mm - self.d))
            self._keep(none)
            slipped = self._avalanche()
            if slipped.any():
                self._keep(slipped)
        return self._dataset()

    def _longest_mm(self) -> float:
        return self.pull.longest_step_um / 1000

    def _normal(self, load: Floats, d: float) -> Floats:
        if self.pull.normal_force == "equation":
            return np.asarray(np.broadcast_to(equation_normal_N(self.pull, d), load.shape))
        return normal_of_loads_N(self.pull, load, d)

    def _levels(self, normal: Floats) -> tuple[Floats, Floats]:
        """(T_s, T_d)."""
        top = _threshold(self.pull, normal)
        return self.factor * top, self.factor * (top - self.pull.amplitude * normal)

    def _slides(self, load: Floats, normal: Floats, d: float) -> Bools:
        """Whether a sheet slides rather than sticks: a stick would be too short at the N it has at T_d.

        That N depends on the sheets outside alone, so a sheet's own load cannot make it one or the other.
        """
        if self.pull.normal_force == "loads":
            transfer = _transfer(self.pull, d)
            outside = normal - transfer * load
            normal = outside + transfer * self._settled(outside, self.factor, transfer)
        return np.asarray(2 * self.pull.amplitude * normal < self.shortest_N)

    def _settled(self, outside: Any, factor: Any, transfer: Any) -> Any:
        """T = T_d(N) where N = outside + transfer · T."""
        kinetic = 2 * self.pull.mu - self.pull.amplitude
        load = factor * (kinetic * outside + self.pull.sample.t_star_N)
        return load / (1 - factor * kinetic * transfer)

    def _loaded(self, step: float) -> Floats:
        """Loads after a step: sticking sheets gain k·step, sliding ones no more than T_d."""
        d, load = self.d + step, self.load + self.k * step
        if self.pull.normal_force == "equation":
            normal = self._normal(load, d)
            return np.where(self._slides(load, normal, d), np.minimum(load, self._levels(normal)[1]), load)
        for side in range(2):
            self._settle(load[side], self.factor[side], _transfer(self.pull, d))
        return load

    def _settle(self, load: Floats, factor: Floats, transfer: Floats) -> None:
        """Take the sliding sheets of one side down to T_d, from the outermost inwards; in place."""
        drop, values = 2 * self.pull.amplitude, []
        outer_load = outer_normal = 0.0
        columns = zip(*(part[::-1].tolist() for part in (transfer, load, factor)), strict=True)
        for c, trial, f in columns:
            outside = outer_normal + c * outer_load
            settled = self._settled(outside, f, c)
            own = min(trial, settled) if drop * (outside + c * settled) < self.shortest_N else trial
            values.append(own)
            outer_load, outer_normal = own, outside + c * own
        load[:] = values[::-1]

    def _margin(self, step: float) -> Floats:
        """(T_s − T)/T_s after a step of sheets that stick; infinite for those that slide."""
        load, d = self._loaded(step), self.d + step
        normal = self._normal(load, d)
        top, _ = self._levels(normal)
        return np.where(self._slides(load, normal, d), np.inf, (top - load) / top)

    def _advance(self, longest: float) -> None:
        """To the next slip, at most by one step."""
        low, at_low = 0.0, np.maximum(self._margin(0.0), 0.0)
        step, margin = longest, self._margin(longest)
        high, at_high = step, margin
        for _ in range(_MOST):
            if margin.min() >= -_CLOSE and (step == longest or margin.min() <= _CLOSE):
                break
            if high - low <= _NARROW * self.d:  # one that slid grips above its threshold
                step = high
                break
            # Loads and thresholds bend little within a step: the first crossing of straight lines.
            first = at_high < 0
            before, after = at_low[first], at_high[first]
            known = np.isfinite(before)  # a sheet that slid before has no margin to start from
            share = np.where(
                known, np.where(known, before, 0.0) / (np.where(known, before, 1.0) - after), 0.5
            )
            step = low + (high - low) * float(share.min())
            margin = self._margin(step)
            if margin.min() < 0:
                high, at_high = step, margin
            else:
                low, at_low = step, margin
        else:
            raise RuntimeError(f"no time found for the slip after d = {self.d:.9g} mm")
        self._stretch(step)

    def _stretch(self, step: float) -> None:
        """Grow d by a step in which no sheet slips."""
        load = self._loaded(step)
        mean = 0.5 * (self.load + load)
        self.work += float(mean.sum()) * step
        self.dissipated += float(np.sum(mean * (step - (load - self.load) / self.k)))
        self.load, self.d = load, self.d + step

    def _slip(self, load: Floats) -> None:
        """Take the loads down at one d, and let the machine spring back by what the force falls."""
        before, force = self._elastic(), float(self.load.sum())
        self.load = load
        self.load = self._loaded(0.0)
        self.dissipated += before - self._elastic()
        machine = self.pull.machine_N_per_mm
        if math.isfinite(machine):
            back = 0.0
            for _ in range(_MOST):  # sheets that slide gain no load: the machine moves further than with all
                missing = force - float(self._loaded(back).sum()) - machine * back
                back += missing / (machine + self.load.size * self.k)
                if abs(missing) <= _CLOSE * force:
                    break
            self._stretch(back)

    def _avalanche(self) -> Bools:
        """Slips of every sheet that is at its threshold, and of those that these bring there."""
        slipped = np.zeros(self.load.shape, bool)
        for _ in range(_MOST):
            over = self._margin(0.0) <= _CLOSE
            if not over.any():
                break
            _, level = self._levels(self._normal(self.load, self.d))
            self._slip(np.where(over, np.maximum(2 * level - self.load, 0.0), self.load))
            slipped |= over
        return slipped

    def _elastic(self) -> float:
        return float(np.sum(self.load**2)) / (2 * self.k)

    def _keep(self, slipped: Bools) -> None:
        self.energies.append((self.d, self.work, self._elastic() - self.start_mJ, self.dissipated))
        self.loads.append(self.load)
        self.slips.append(slipped)

    def _dataset(self) -> xr.Dataset:
        d, work, elastic, dissipated = np.array(self.energies).T
        load, slipped = (_left_to_right(np.array(part)) for part in (self.loads, self.slips))
        crosshead = d + load.sum(axis=1) / self.pull.machine_N_per_mm
        time = 60 * np.maximum.accumulate(crosshead - crosshead[0]) / self.pull.speed_mm_min
        energy = {"units": "mJ"}
        return xr.Dataset(
            {
                "d_mm": ("step", d, {"units": "mm", "long_name": "separation"}),
                "time_s": ("step", time, {"units": "s", "long_name": "machine's clock"}),
                "force_N": ("step", load.sum(axis=1), {"units": "N", "long_name": "force"}),
                "load_N": (("step", "sheet"), load, {"units": "N", "long_name": "load of a sheet"}),
                "slipped": (("step", "sheet"), slipped),
                "work_mJ": ("step", work, energy),
                "elastic_mJ": ("step", elastic, energy),
                "dissipated_mJ": ("step", dissipated, energy),
            },
            coords={
                "side": ("sheet", np.repeat([-1, 1], load.shape[1] // 2)),
                "n": ("sheet", _left_to_right(np.tile(np.arange(1, load.shape[1] // 2 + 1), (1, 2, 1)))[0]),
            },
            attrs={"stiffness_N_per_mm": self.k, "normal_force": self.pull.normal_force},
        )


class _Together(_Run):
    """Sheets that creep at their thresholds until none sticks."""

    def _longest_mm(self) -> float:
        # Fine enough for the sheets that come to their thresholds one after the other within a stick.
        stick = 2 * self.pull.amplitude * float(self._normal(self.load, self.d).max()) / self.k
        return min(super()._longest_mm(), stick / 20)

    def _loaded(self, step: float) -> Floats:
        top, _ = self._levels(self._normal(self.load, self.d + step))
        return np.minimum(self.load + self.k * step, top)

    def _margin(self, step: float) -> Floats:
        """That of the sheet which sticks longest."""
        top, _ = self._levels(self._normal(self.load, self.d + step))
        return np.asarray([((top - self.load - self.k * step) / top).max()])

    def _avalanche(self) -> Bools:
        if self._margin(0.0)[0] > _CLOSE:
            return np.zeros(self.load.shape, bool)
        _, level = self._levels(self._normal(self.load, self.d))
        self._slip(np.maximum(2 * level - self.load, 0.0))
        return np.ones(self.load.shape, bool)


_MOST = 1000  # iterations of what converges in a few


def _left_to_right(values: NDArray[Any]) -> NDArray[Any]:
    """(step, 2, M) from the centre outwards becomes (step, 2M) from left to right."""
    return np.concatenate([values[:, 0, ::-1], values[:, 1]], axis=1)


def loads_at(result: xr.Dataset, d_mm: ArrayLike) -> Floats:
    """Loads in N of `pull_sheets` at given separations, (d, sheet); those after a slip that happens at d.

    Raises: InputError for separations outside the pull.
    """
    known, wanted = result["d_mm"].values, np.atleast_1d(np.asarray(d_mm, float))
    if not ((wanted >= known[0]) & (wanted <= known[-1])).all():
        raise InputError(
            "`d_mm`", f"{known[0]:g} to {known[-1]:g} mm", f"{wanted.min():g} to {wanted.max():g}"
        )
    right = np.clip(np.searchsorted(known, wanted, side="right"), 1, known.size - 1)
    width = known[right] - known[right - 1]
    share = np.where(width > 0, (wanted - known[right - 1]) / np.where(width > 0, width, 1.0), 1.0)
    load = result["load_N"].values
    return np.asarray(load[right - 1] + share[:, np.newaxis] * (load[right] - load[right - 1]))


def slip_share(result: xr.Dataset, d_v_mm: ArrayLike, d_p_mm: ArrayLike) -> xr.DataArray:
    """How far each sheet slipped within stretches of the pull, over their length: 0 stuck, 1 sliding.

    (event, sheet): 1 − ΔT / (k Λ_st), with the load a sheet gained over what it gains where it sticks.
    result: of `pull_sheets`.  d_v_mm, d_p_mm: ends of the stretches, such as the sticks of
    `vision.find_stick_slip`.
    """
    first, last = np.atleast_1d(np.asarray(d_v_mm, float)), np.atleast_1d(np.asarray(d_p_mm, float))
    if first.shape != last.shape or not (last > first).all():
        raise InputError("`d_p_mm`", "as many as `d_v_mm` and each larger", f"{last.size} for {first.size}")
    # A stretch begins after the slip at its first end and ends before the one at its last.
    gained = loads_at(result, np.nextafter(last, first)) - loads_at(result, first)
    share = 1 - gained / (result.attrs["stiffness_N_per_mm"] * (last - first))[:, np.newaxis]
    return xr.DataArray(share, dims=("event", "sheet"), coords={"side": result["side"], "n": result["n"]})
