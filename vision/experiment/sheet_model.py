r"""Sheet-resolved pull: 2M springs that stick and slip individually.

Each of the 2M sheets is a spring of stiffness k = εWY/L between its clamp and two faces with friction. It
sticks while its load T is below the threshold T_s of both faces. In a slip its load is reflected at the level
T_d of dynamic friction, as for a spring and block:

.. math:: T_s = 2\mu N + T^*, \qquad T_d = (2\mu - A) N + T^*, \qquad T \to 2T_d - T

with A = 2(μ_s − μ_d). The normal force N(n, d) follows Eq. 2 and is updated as d grows. If every sheet is at
its threshold, the loads are T* exp(α(1 − (n/M)²)). Their sum over the 2M sheets becomes Eq. 1 in the
continuum limit, in which it is an integral over n.

Sheets that slip individually are rarely at their thresholds at the same time: the force stays near 1 − A/2μ
of Eq. 1 or, if N follows the loads (which e^α amplifies), near Eq. 1 with μ − A/2. In the publication, all
sheets slip at once and the peaks follow Eq. 1. The model gives this result if a sheet at its threshold
creeps, held by those that still stick, and the assembly slips when none sticks (``slips="together"``).

M_eff, Λ_st and σ_x/Λ_st do not enter. Source: Plati, Restagno & Poulard, Eqs. 1 and 2 and section "Stick-slip
in a simple spring-block model"; for the normal force from loads their outlook, "the normal load increases
during the stick phase".
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
    normal_force
        "equation": N follows Eq. 2, so the sheets do not affect each other. "loads": N follows from the loads
        of the sheets further out, with weights that give Eq. 2 if all are at their thresholds; a sheet that
        slips lowers the normal force on all sheets inside it.
    positions
        Position of sheet n: "edges" at n, "middles" at n − ½ (whose sum is the continuum limit to 5e-6).
    slips
        "alone": each sheet slips at its threshold. "together": it creeps there until no sheet sticks, then
        all slip (only with ``normal_force="equation"``).
    machine_N_per_mm
        Stiffness of the machine, which springs back when sheets slip and loads the others; default infinite.
    relaxed
        Whether the pull starts without loads; else each sheet starts as after a slip from its threshold.
    threshold_factor
        Factor on the threshold of each sheet from left to right, shape (2M,); None for equal sheets.
    shortest_stick_um
        Sheets with shorter stick phases slide at T_d instead, without events. A smaller value is slower.
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
        """Stiffness k of one sheet."""
        return float(sheet_stiffness(modulus_GPa=self.modulus_GPa, sample=self.sample))

    @property
    def n(self) -> Floats:
        """Positions of the sheets of one side, (M,), from the centre outwards."""
        count = int(self.sample.sheets_per_block)
        return np.arange(1.0, count + 1) - (0.5 if self.positions == "middles" else 0.0)


def equation_normal_N(pull: SheetPull, d_mm: float) -> Floats:
    """Return N of Eq. 2 for the sheets of one side, (M,): (T*/2μ) (exp(α(1 − (n/M)²)) − 1)."""
    count = int(pull.sample.sheets_per_block)
    alpha = 2 * pull.sample.thickness_mm * pull.mu * count**2 / d_mm
    excess = np.expm1(alpha * (1 - (pull.n / count) ** 2))
    return np.asarray(pull.sample.t_star_N / (2 * pull.mu) * excess)


def threshold_loads_N(pull: SheetPull, d_mm: float) -> Floats:
    """Return the loads of the sheets of one side, (M,), if all are at their thresholds under Eq. 2.

    Twice their sum over Eq. 1 is 0.934 at d = 13 mm and 0.944 at 18 mm; with positions n − ½ it is 1 to 5e-6.
    """
    return _threshold(pull, equation_normal_N(pull, d_mm))


def _threshold(pull: SheetPull, normal: Floats) -> Floats:
    """Return T_s for normal forces of any shape."""
    return np.asarray(2 * pull.mu * normal + pull.sample.t_star_N)


def _transfer(pull: SheetPull, d_mm: float) -> Floats:
    """Return c(n), (M,), in N(n) = N(n + 1) + c(n) (T(n) + T(n + 1)); N = T = 0 beyond the outermost sheet.

    From one sheet to the next one inside, N grows by the mean of their loads times the slope 2εn/d of the
    sheets there. c is chosen such that loads at their thresholds give Eq. 2.
    """
    normal = equation_normal_N(pull, d_mm)
    load = _threshold(pull, normal)
    return np.asarray((normal - np.append(normal[1:], 0.0)) / (load + np.append(load[1:], 0.0)))


def normal_of_loads_N(pull: SheetPull, load_N: ArrayLike, d_mm: float) -> Floats:
    """Return normal forces from the loads of the sheets, both (…, M) from the centre outwards."""
    load = np.asarray(load_N, float)
    pairs = load.copy()
    pairs[..., :-1] += load[..., 1:]
    return np.asarray(np.cumsum((_transfer(pull, d_mm) * pairs)[..., ::-1], axis=-1)[..., ::-1])


def pull_sheets(pull: SheetPull) -> xr.Dataset:
    """Simulate the whole pull, event by event.

    Parameters
    ----------
    pull
        Parameters of the pull.

    Returns
    -------
    xarray.Dataset
        Along ``step``: ``d_mm``, ``time_s``, ``force_N`` (sum of the loads), ``load_N`` (step, sheet),
        ``slipped`` (step, sheet), and ``work_mJ``, ``elastic_mJ`` and ``dissipated_mJ`` since the start. A
        slip consists of two steps at the same d; ``slipped`` is True on the second. Between steps loads are
        linear in d. Sheets are ordered from left to right, with ``side`` and ``n``. attrs:
        ``stiffness_N_per_mm`` of one sheet.

    Notes
    -----
    Slips take no time. If the slip of one sheet takes others beyond their thresholds (``normal_force``
    "loads", or a machine that springs back), these slip in the same event, until no sheet is beyond its own.
    """
    return (_Together if pull.slips == "together" else _Individual)(pull).run()


_CLOSE = 1e-9  # tolerance of the threshold at which a slip is found, relative
_NARROW = 1e-13  # tolerance of d, relative, where margins are discontinuous


class _Individual:
    """Pull of sheets that slip individually. Loads are (2, M), side −1 first, from the centre outwards."""

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
        """Simulate all events up to the end of the pull."""
        none = np.zeros(self.load.shape, bool)
        self._record(none)
        while self.d < self.pull.d_end_mm * (1 - 1e-12):
            self._advance(min(self._longest_mm(), self.pull.d_end_mm - self.d))
            self._record(none)
            slipped = self._avalanche()
            if slipped.any():
                self._record(slipped)
        return self._dataset()

    def _longest_mm(self) -> float:
        return self.pull.longest_step_um / 1000

    def _normal(self, load: Floats, d: float) -> Floats:
        if self.pull.normal_force == "equation":
            return np.asarray(np.broadcast_to(equation_normal_N(self.pull, d), load.shape))
        return normal_of_loads_N(self.pull, load, d)

    def _levels(self, normal: Floats) -> tuple[Floats, Floats]:
        """Return (T_s, T_d)."""
        top = _threshold(self.pull, normal)
        return self.factor * top, self.factor * (top - self.pull.amplitude * normal)

    def _slides(self, load: Floats, normal: Floats, d: float) -> Bools:
        """Return whether each sheet slides because its stick phase would be too short.

        The length of the stick phase is computed with the N that the sheet has at T_d. This N depends only on
        the sheets further out, so a sheet's load does not decide whether it slides.
        """
        if self.pull.normal_force == "loads":
            transfer = _transfer(self.pull, d)
            outside = normal - transfer * load
            normal = outside + transfer * self._settled(outside, self.factor, transfer)
        return np.asarray(2 * self.pull.amplitude * normal < self.shortest_N)

    def _settled(self, outside: Any, factor: Any, transfer: Any) -> Any:
        """Solve T = T_d(N) with N = outside + transfer · T."""
        kinetic = 2 * self.pull.mu - self.pull.amplitude
        load = factor * (kinetic * outside + self.pull.sample.t_star_N)
        return load / (1 - factor * kinetic * transfer)

    def _loaded(self, step: float) -> Floats:
        """Return the loads after a step: sticking sheets gain k·step, sliding ones are limited to T_d."""
        d, load = self.d + step, self.load + self.k * step
        if self.pull.normal_force == "equation":
            normal = self._normal(load, d)
            return np.where(self._slides(load, normal, d), np.minimum(load, self._levels(normal)[1]), load)
        for side in range(2):
            self._settle(load[side], self.factor[side], _transfer(self.pull, d))
        return load

    def _settle(self, load: Floats, factor: Floats, transfer: Floats) -> None:
        """Limit the sliding sheets of one side to T_d, from the outermost inwards, in place."""
        drop, values = 2 * self.pull.amplitude, []
        outer_load = outer_normal = 0.0
        columns = zip(*(part[::-1].tolist() for part in (transfer, load, factor)), strict=True)
        for c, trial, f in columns:
            outside = outer_normal + c * outer_load
            settled = self._settled(outside, f, c)
            slides = drop * (outside + c * settled) < self.shortest_N
            outer_load = min(trial, settled) if slides else trial
            outer_normal = outside + c * outer_load
            values.append(outer_load)
        load[:] = values[::-1]

    def _margin(self, step: float) -> Floats:
        """Return (T_s − T)/T_s of each sheet after a step; infinite for sliding sheets."""
        load, d = self._loaded(step), self.d + step
        normal = self._normal(load, d)
        top, _ = self._levels(normal)
        return np.where(self._slides(load, normal, d), np.inf, (top - load) / top)

    def _advance(self, longest: float) -> None:
        """Increase d to the next slip, at most by `longest`."""
        low, at_low = 0.0, np.maximum(self._margin(0.0), 0.0)
        step, margin = longest, self._margin(longest)
        high, at_high = step, margin
        for _ in range(_MAX_ITERATIONS):
            if margin.min() >= -_CLOSE and (step == longest or margin.min() <= _CLOSE):
                break
            if high - low <= _NARROW * self.d:  # a sheet stops sliding above its threshold
                step = high
                break
            # Loads and thresholds are nearly linear within a step: take the first crossing of lines.
            first = at_high < 0
            before, after = at_low[first], at_high[first]
            known = np.isfinite(before)  # a sheet that slid before has no margin
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
        """Increase d by a step in which no sheet slips."""
        load = self._loaded(step)
        mean = 0.5 * (self.load + load)
        self.work += float(mean.sum()) * step
        self.dissipated += float(np.sum(mean * (step - (load - self.load) / self.k)))
        self.load, self.d = load, self.d + step

    def _slip(self, load: Floats) -> None:
        """Set the loads after a slip at constant d, and let the machine spring back."""
        before, force = self._elastic(), float(self.load.sum())
        self.load = load
        self.load = self._loaded(0.0)
        self.dissipated += before - self._elastic()
        machine = self.pull.machine_N_per_mm
        if math.isfinite(machine):
            back = 0.0
            for _ in range(_MAX_ITERATIONS):  # sliding sheets gain no load, so one step does not suffice
                imbalance = force - float(self._loaded(back).sum()) - machine * back
                back += imbalance / (machine + self.load.size * self.k)
                if abs(imbalance) <= _CLOSE * force:
                    break
            self._stretch(back)

    def _avalanche(self) -> Bools:
        """Let every sheet at its threshold slip, and those which that takes to their thresholds."""
        slipped = np.zeros(self.load.shape, bool)
        for _ in range(_MAX_ITERATIONS):
            over = self._margin(0.0) <= _CLOSE
            if not over.any():
                break
            _, level = self._levels(self._normal(self.load, self.d))
            self._slip(np.where(over, np.maximum(2 * level - self.load, 0.0), self.load))
            slipped |= over
        return slipped

    def _elastic(self) -> float:
        return float(np.sum(self.load**2)) / (2 * self.k)

    def _record(self, slipped: Bools) -> None:
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


class _Together(_Individual):
    """Pull of sheets that creep at their thresholds until none sticks, then slip together."""

    def _longest_mm(self) -> float:
        # Sheets reach their thresholds one after the other within a stick phase, which needs short steps.
        stick = 2 * self.pull.amplitude * float(self._normal(self.load, self.d).max()) / self.k
        return min(super()._longest_mm(), stick / 20)

    def _loaded(self, step: float) -> Floats:
        top, _ = self._levels(self._normal(self.load, self.d + step))
        return np.minimum(self.load + self.k * step, top)

    def _margin(self, step: float) -> Floats:
        """Return the margin of the sheet that sticks longest, shape (1,)."""
        top, _ = self._levels(self._normal(self.load, self.d + step))
        return np.asarray([((top - self.load - self.k * step) / top).max()])

    def _avalanche(self) -> Bools:
        if self._margin(0.0)[0] > _CLOSE:
            return np.zeros(self.load.shape, bool)
        _, level = self._levels(self._normal(self.load, self.d))
        self._slip(np.maximum(2 * level - self.load, 0.0))
        return np.ones(self.load.shape, bool)


_MAX_ITERATIONS = 1000  # all iterations converge in a few


def _left_to_right(values: NDArray[Any]) -> NDArray[Any]:
    """Convert (step, 2, M) from the centre outwards to (step, 2M) from left to right."""
    return np.concatenate([values[:, 0, ::-1], values[:, 1]], axis=1)


def loads_at(result: xr.Dataset, d_mm: ArrayLike) -> Floats:
    """Return the loads (N) in a result of `pull_sheets` at given separations, (d, sheet).

    At the d of a slip, these are the loads after it.  Raises: InputError for separations outside the pull.
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
    """Return how far each sheet slipped in parts of the pull, relative to their length, (event, sheet).

    The share is 1 − ΔT / (k Λ_st): 0 for a sheet that sticks and gains the load k Λ_st, 1 for a sliding one.

    result: from `pull_sheets`.  d_v_mm, d_p_mm: ends of the parts, such as the stick phases of
    `vision.find_stick_slip`.
    """
    first, last = np.atleast_1d(np.asarray(d_v_mm, float)), np.atleast_1d(np.asarray(d_p_mm, float))
    if first.shape != last.shape or not (last > first).all():
        raise InputError("`d_p_mm`", "as many as `d_v_mm` and each larger", f"{last.size} for {first.size}")
    # A part begins after a slip at its first end, and ends before a slip at its last end.
    gained = loads_at(result, np.nextafter(last, first)) - loads_at(result, first)
    share = 1 - gained / (result.attrs["stiffness_N_per_mm"] * (last - first))[:, np.newaxis]
    return xr.DataArray(share, dims=("event", "sheet"), coords={"side": result["side"], "n": result["n"]})
