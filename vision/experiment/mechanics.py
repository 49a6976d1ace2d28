r"""The traction test before any instrument: stick-slip events, d(t), F(t) and x(n, t).

The pull starts at time 0 of the machine's clock at d0 with zero force. A first elastic loading ends in
slip 0; event i is the stick phase between slips i and i + 1. In a stick phase a sheet creeps towards the axis
at constant speed; in a slip it jumps back out as half a cosine.

With ``mechanics.model = "sheets"``, thresholds determine which sheets stick and for how long. Each of the 2M
sheets is a spring of stiffness k = εWY/L between its clamp and two faces with friction. It sticks while its
load T is below the threshold T_s of both faces. In a slip its load is reflected at the level T_d of dynamic
friction, as for a spring and block:

.. math:: T_s = 2\mu N + T^*, \qquad T_d = (2\mu - A) N + T^*, \qquad T \to 2T_d - T

with A = 2(μ_s − μ_d). The normal force N(n, d) follows Eq. 2. If every sheet is at its threshold, the sum of
the loads over the 2M sheets, at the positions n − ½, is Eq. 1 to 5e-6. If sheets slipped individually, the
force would stay near 1 − A/2μ of Eq. 1. In the publication, all sheets slip at once and the peaks follow
Eq. 1. The model gives this result, since a sheet at its threshold creeps, held by those that still stick, and
the assembly slips when none sticks.

Between two slips of the assembly a sheet creeps by s(n) = d − d_v − (T(n) − T_v(n))/k. Its free part bends
inwards in proportion, and the slip reverses this:

.. math:: x(n, t) = \hat x(n) \mp \sqrt{12}\, r\, s(n, t)

with the same r for all sheets (`sheets.outer_ratio`): a sheet that creeps all the way has σ_x/Λ_st = r, one
that sticks to the end has 0. Neither M_eff nor a shell enters. Source: Plati, Restagno & Poulard, Eqs. 1 and
2 and section "Stick-slip in a simple spring-block model".
"""

from __future__ import annotations

import zlib
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import pandas as pd
import xarray as xr

from vision.experiment.settings import Experiment, Mechanics, Sheets
from vision.models import equations as eq
from vision.numeric import Bools, Floats, Ints
from vision.sample import PUBLISHED, Sample


def random_stream(seed: int, part: str, *numbers: int) -> np.random.Generator:
    """Return the random generator of one part of an experiment (and of one frame or sheet, if given).

    Each part has its own stream, derived from the seed and the name of the part, so that a change of one part
    (such as more texture) does not change the random numbers of the others.
    """
    key = (zlib.crc32(part.encode()), *numbers)
    return np.random.Generator(np.random.SFC64(np.random.SeedSequence(seed, spawn_key=key)))


# --- the pull -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Pull:
    """Motion of the machine and response of the sample.

    The arrays have one entry per stick phase, from the initial loading to the unfinished one at the end. It
    starts at (start_s, d_start_mm, low_N) and ends with a slip at (end_s, d_end_mm, high_N).
    """

    settings: Mechanics
    start_s: Floats
    end_s: Floats
    d_start_mm: Floats
    d_end_mm: Floats
    low_N: Floats
    high_N: Floats
    stiffness_N_per_mm: Floats
    effective_sheets: Floats
    stop_s: float

    @property
    def complete(self) -> Bools:
        """Whether each stick phase ended with a slip before the machine stopped."""
        return self.end_s <= self.stop_s

    @property
    def slip_s(self) -> Floats:
        """Times at which slips begin."""
        return self.end_s[self.complete]

    def separation_mm(self, time_s: Floats) -> Floats:
        """Return d(t) in mm; it is constant before and after the pull."""
        speed = self.settings.speed_mm_min / 60
        return self.settings.d0_mm + speed * np.clip(time_s, 0, self.stop_s)

    def force_N(self, time_s: Floats) -> Floats:
        """Return the exact F(t) in N; 0 before the pull, constant after the machine has stopped."""
        m = self.settings
        t = np.clip(time_s, 0, self.stop_s)
        k = np.clip(np.searchsorted(self.start_s, t, side="right") - 1, 0, None)
        u = (t - self.start_s[k]) / (self.end_s[k] - self.start_s[k])
        rise = self.high_N - self.low_N
        stick = self.low_N[k] + rise[k] * _stick_shape(u, m)
        # Between two stick phases the force falls as half a cosine.
        fall = np.clip((t - self.end_s[k]) / m.slip_s, 0, 1)
        following = np.minimum(k + 1, len(self.low_N) - 1)
        slip = self.high_N[k] + (self.low_N[following] - self.high_N[k]) * (1 - np.cos(np.pi * fall)) / 2
        return np.where(u <= 1, stick, slip)

    def events(self) -> pd.DataFrame:
        """Return the exact complete events, without the initial loading, as in `events.csv` with M_eff.

        Times are on the machine's clock; slip_length_um is the machine's motion during the slip.
        """
        keep = np.flatnonzero(self.complete)[1:]
        slip_um = 1000 * self.settings.slip_s * self.settings.speed_mm_min / 60
        columns = {
            "event": np.arange(len(keep)),
            "t_v_s": self.start_s[keep],
            "t_p_s": self.end_s[keep],
            "d_v_mm": self.d_start_mm[keep],
            "d_p_mm": self.d_end_mm[keep],
            "F_v_N": self.low_N[keep],
            "F_p_N": self.high_N[keep],
            "dF_N": (self.high_N - self.low_N)[keep],
            "stick_length_um": 1000 * (self.d_end_mm - self.d_start_mm)[keep],
            "slip_length_um": np.full(len(keep), slip_um),
            "K_N_per_mm": self.stiffness_N_per_mm[keep],
            "M_eff": self.effective_sheets[keep],
        }
        return pd.DataFrame(columns)


def simulate_pull(m: Mechanics, *, seed: int, sample: Sample = PUBLISHED) -> Pull:
    r"""Simulate the whole test, event by event.

    An event that starts at d has

    .. math:: \Delta F = A\,N(d), \qquad K = M_\mathrm{eff}(d)\,K_\mathrm{eff},
              \qquad \Lambda_\mathrm{st} = \Delta F / K

    and ends at the peak force of Eq. 1. ΔF varies by `period_jitter`, the peaks by `peak_scatter`. If no
    stiff sheet is left (M_eff < 1), the pull continues with one, since with K = 0 the next slip would never
    come. Source: publication, Eqs. 1-2 and section IV.
    """
    rng = random_stream(seed, "mechanics")
    speed = m.speed_mm_min / 60
    rows: list[tuple[float, ...]] = []
    time, d, low = 0.0, m.d0_mm, 0.0
    while time < m.pull_s:
        drop, stiffness, m_eff = _event_at(d, m, sample, jitter=rng.standard_normal())
        scatter = 1 + m.peak_scatter * rng.standard_normal()
        length = drop / (stiffness * _mean_slope(m)) if rows else _loading_mm(stiffness, m, sample)
        length = max(length, 2e-4)  # it would be zero while the force is still building up from zero
        high = _peak_force_N(d + length, m, sample) * scatter
        low = max(high - drop, 0.0) if rows else 0.0
        end = time + length / speed
        rows.append((time, end, d, d + length, low, high, stiffness, m_eff))
        time, d = end + m.slip_s, d + length + speed * m.slip_s
    names = ("start_s", "end_s", "d_start_mm", "d_end_mm", "low_N", "high_N",
             "stiffness_N_per_mm", "effective_sheets")  # fmt: skip
    return Pull(settings=m, stop_s=m.pull_s, **dict(zip(names, np.array(rows).T, strict=True)))


def _event_at(d_mm: float, m: Mechanics, sample: Sample, *, jitter: float) -> tuple[float, float, float]:
    """Return force drop (N), stiffness (N/mm) and M_eff of an event that starts at d."""
    total = eq.total_normal_force(d_mm, mu=m.mu, sample=sample)
    d_hat = eq.reduced_separation(d_mm, mu=m.mu, n_hat_N=m.n_hat_N, sample=sample)
    sheets = float(eq.effective_sheets(d_hat, sample=sample))
    one = eq.sheet_stiffness(modulus_GPa=m.modulus_GPa, sample=sample)
    # A drop is never negative, however large the jitter.
    drop = m.amplitude * float(total) * max(1 + m.period_jitter * jitter, 0.1) * _built_up(d_mm, m)
    return drop, max(sheets, 1.0) * float(one), sheets


def _peak_force_N(d_mm: float, m: Mechanics, sample: Sample) -> float:
    """Return the force at which the sample slips at d: Eq. 1 with the offset, reduced during the build-up."""
    force = eq.traction(d_mm, mu=m.mu, sample=sample)
    return (float(force) + m.t0_N) * _built_up(d_mm, m)


def _built_up(d_mm: float, m: Mechanics) -> float:
    """Return the fraction of the peak force that is reached at d."""
    return 1 - float(np.exp(-(d_mm - m.d0_mm) / m.buildup_mm)) if m.buildup_mm else 1.0


def _loading_mm(stiffness_N_per_mm: float, m: Mechanics, sample: Sample) -> float:
    """Return the length of the first elastic loading, at which K (d - d0) reaches the force of the slip."""
    length = 0.0
    for _ in range(50):
        length = _peak_force_N(m.d0_mm + length, m, sample) / (stiffness_N_per_mm * _mean_slope(m))
    return length


def _mean_slope(m: Mechanics) -> float:
    """Return the mean slope of a stick phase relative to K, the slope of its later (or only) part."""
    return 1 + m.early_fraction * (m.early_stiffness_ratio - 1)


def _stick_shape(u: Floats, m: Mechanics) -> Floats:
    """Return the fraction of the force rise at the fraction u of a stick phase: softening, or two slopes."""
    if m.early_stiffness_ratio > 1:
        later = 1 / _mean_slope(m)
        return later * (u + (m.early_stiffness_ratio - 1) * np.minimum(u, m.early_fraction))
    return u + m.softening * u * (1 - u) / 2


# --- the sheets at rest -------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class RestingComb:
    """Ridges at rest, left to right."""

    axis_px: float
    rest_px: Floats  # position
    side: Ints  # -1 or +1
    n: Ints  # from 1
    rank: Floats  # distance from the axis in pitches, counted from ½ below n


def comb_at_rest(experiment: Experiment) -> RestingComb:
    """Return ridges with an irregular pitch, centred in the frame.

    If their number is odd, the middle one lies on the axis and counts as n = 1 on the right.
    """
    sheets, count = experiment.sheets, experiment.ridges_in_view
    middle = (experiment.camera.width - 1) / 2
    right = {"both": (count + 1) // 2, "right": count, "left": 0}[sheets.side]
    number = np.arange(count) - (count - right)  # 0 for the first ridge on the right
    side = np.where(number >= 0, 1, -1)
    n = np.where(number >= 0, number + 1, -number)
    odd = sheets.side == "both" and count % 2 == 1
    steps = number + (0.0 if odd else 0.5)  # distance from the axis in pitches
    axis = middle - steps.mean() * sheets.pitch_px
    rng = random_stream(experiment.seed, "comb")
    jitter = sheets.pitch_jitter * rng.uniform(-1, 1, count)
    rank = np.abs(steps) + (0.0 if odd else 0.5)
    rest = axis + (steps + jitter) * sheets.pitch_px
    return RestingComb(axis_px=axis, rest_px=rest, side=side, n=n, rank=rank)


# --- the sheets' motion -------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class SheetMotion(ABC):
    """Displacement of every sheet from rest, px, as a function of the machine's time."""

    sweep_px: Floats  # inward motion from valley to peak, (stick phase, sheet)
    ratio: Floats  # σ_x/Λ_st, (stick phase, sheet)
    delay_s: Floats  # of the slip, (stick phase, sheet)

    def mean_px(self, from_s: Floats, to_s: Floats) -> Floats:
        """Return the exact mean displacement between two times, (time, sheet)."""
        span = (np.asarray(to_s) - from_s)[:, None]
        return (self._primitive(to_s) - self._primitive(from_s)) / span

    @abstractmethod
    def _primitive(self, time_s: Floats) -> Floats:
        """Return the integral of the displacement over time."""


@dataclass(frozen=True, kw_only=True)
class Motion(SheetMotion):
    """Motion for events drawn from the equations.

    Segment k lasts from one slip to the next: every sheet rests for its `delay_s`, jumps to `outer` within
    `slip_s` and creeps to `inner`. The first segment has no slip.
    """

    begin_s: Floats
    length_s: Floats
    slip_s: float
    stop_s: float
    before_px: Floats
    outer_px: Floats
    inner_px: Floats

    def _primitive(self, time_s: Floats) -> Floats:
        t = np.clip(time_s, 0, self.stop_s)
        k = np.clip(np.searchsorted(self.begin_s, t, side="right") - 1, 0, None)
        inside = self._within_segment(k, (t - self.begin_s[k])[:, None])
        early, late = np.minimum(time_s, 0)[:, None], np.maximum(time_s - self.stop_s, 0)[:, None]
        last = np.clip(np.searchsorted(self.begin_s, self.stop_s, side="right") - 1, 0, None)
        share = np.clip((self.stop_s - self.begin_s[last] - self.slip_s) / self.length_s[last], 0, 1)
        at_stop = self.outer_px[last] + share * (self.inner_px[last] - self.outer_px[last])
        outside = early * self.outer_px[0] + late * at_stop
        return np.asarray(self._before_segment[k] + inside + outside)

    @cached_property
    def _before_segment(self) -> Floats:
        """Integral of the displacement up to the begin of each segment, (segment, sheet)."""
        whole = self._within_segment(np.arange(len(self.length_s)), self.length_s[:, None])
        return np.concatenate([np.zeros_like(whole[:1]), np.cumsum(whole, axis=0)[:-1]])

    def _within_segment(self, k: Ints, tau: Floats) -> Floats:
        """Return the integral over the first tau seconds of segments k: rest, half cosine, straight line."""
        before, outer, inner = self.before_px[k], self.outer_px[k], self.inner_px[k]
        delay = self.delay_s[k]
        slip = np.where(k > 0, self.slip_s, 1e-12)[:, None]
        creep = self.length_s[k][:, None] - slip - delay
        rested = np.minimum(tau, delay)
        u = np.clip(tau - delay, 0, slip)
        v = np.maximum(tau - delay - slip, 0)
        jump = before * u + (outer - before) * (u / 2 - slip / (2 * np.pi) * np.sin(np.pi * u / slip))
        return np.asarray(before * rested + jump + outer * v + (inner - outer) * v**2 / (2 * creep))


def sheet_motion(experiment: Experiment, pull: Pull, comb: RestingComb) -> Motion:
    r"""Return the motion of the sheets during a pull: creep, jumps, slow spreading, delays between sheets.

    The sweep of a sheet in one stick phase is √12 σ_x (uniform creep), with

    .. math:: \sigma_x / \Lambda_\mathrm{st} = r_\mathrm{outer}\,(\mathrm{rank}/M)^p

    where p is chosen such that the ratio equals the stiff threshold at M_eff.
    """
    sheets, m = experiment.sheets, experiment.mechanics
    rng = random_stream(experiment.seed, "motion")
    stiff_share = pull.effective_sheets / experiment.sample.sheets_per_block
    ratio = _deformation_ratio(comb.rank / experiment.ridges_per_side, stiff_share, sheets)
    ratio = ratio * np.maximum(1 + sheets.sweep_scatter * rng.standard_normal(ratio.shape), 0)
    stick_um = 1000 * (pull.d_end_mm - pull.d_start_mm)[:, None]
    sweep = np.sqrt(12) * ratio * stick_um / experiment.camera.pixel_size_um
    spread = sheets.spread_per_mm * (pull.d_start_mm - m.d0_mm)[:, None] * (comb.rest_px - comb.axis_px)
    outer, inner = spread + comb.side * sweep / 2, spread - comb.side * sweep / 2
    if len(sweep) > 1:  # the initial loading is longer than a stick phase; it ends as the first one does
        inner[0] = -comb.side * sweep[1] / 2
        outer[0] = inner[0] + comb.side * sweep[0]
    begin = np.concatenate([[0.0], pull.end_s[:-1]])
    length = np.diff(np.append(begin, pull.end_s[-1]))
    delay = sheets.slip_delay_s * rng.uniform(0, 1, sweep.shape)
    delay = np.minimum(delay, 0.5 * np.maximum(length - m.slip_s, 0)[:, None])
    delay[0] = 0
    return Motion(
        begin_s=begin,
        length_s=length,
        slip_s=m.slip_s,
        stop_s=pull.stop_s,
        before_px=np.vstack([outer[:1], inner[:-1]]),
        outer_px=outer,
        inner_px=inner,
        delay_s=delay,
        sweep_px=sweep,
        ratio=ratio,
    )


def _deformation_ratio(rank_share: Floats, stiff_share: Floats, sheets: Sheets) -> Floats:
    """Return σ_x/Λ_st (event, sheet) for given rank/M of the sheets and M_eff/M of the events."""
    if sheets.outer_ratio <= sheets.stiff_ratio:
        return np.broadcast_to(sheets.outer_ratio * rank_share, (len(stiff_share), len(rank_share))).copy()
    at_stiff = np.clip(stiff_share, 0.02, 0.98)[:, None]
    power = np.log(sheets.stiff_ratio / sheets.outer_ratio) / np.log(at_stiff)
    return np.asarray(sheets.outer_ratio * rank_share**power)


# --- sheet-resolved pulls -----------------------------------------------------------------------------------

_CLOSE, _NARROW = 1e-9, 1e-13  # relative tolerances: of the threshold at which a slip is found, and of d


def normal_N(d_mm: float, m: Mechanics, sample: Sample = PUBLISHED) -> Floats:
    """Return N of Eq. 2 for the sheets of one side from the centre outwards, (M,)."""
    n = np.arange(int(sample.sheets_per_block)) + 0.5
    return np.asarray(eq.normal_force(n, d_mm, mu=m.mu, sample=sample))


class _Assembly:
    """The sheets of a pull at a separation d. Loads are (2, M), left side first, from the centre outwards."""

    def __init__(self, m: Mechanics, sample: Sample, threshold_factor: Floats | None) -> None:
        self.m, self.sample, self.d = m, sample, m.d0_mm
        self.k = float(eq.sheet_stiffness(modulus_GPa=m.modulus_GPa, sample=sample))
        count = int(sample.sheets_per_block)
        given = np.ones(2 * count) if threshold_factor is None else threshold_factor
        self.factor = np.stack([given[:count][::-1], given[count:]])
        self.load = np.zeros((2, count))
        # A step needs those of its two ends, several times.
        self.thresholds = lru_cache(2)(self._thresholds)

    def _thresholds(self, d: float) -> tuple[Floats, Floats]:
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

    m: μ (static), A = 2(μ_s − μ_d), Young's modulus Y of one sheet (k = εWY/L), and the pull.
    threshold_factor: factor on the threshold of each sheet from left to right, (2M,); None for equal sheets.
    longest_step_um: largest step of d between updates of N.

    Returns ``d_mm``, ``time_s``, ``force_N`` (sum of the loads), ``load_N`` (step, sheet) and ``slipped``
    along ``step``. A slip consists of two steps at the same d and time; ``slipped`` is True on the second.
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


@dataclass(frozen=True, kw_only=True)
class ResolvedPull(Pull):
    """Pull with a piecewise linear force."""

    path_s: Floats
    path_N: Floats

    def force_N(self, time_s: Floats) -> Floats:
        """Return F(t) in N."""
        return np.asarray(np.interp(time_s, self.path_s, self.path_N))


@dataclass(frozen=True, kw_only=True)
class ResolvedMotion(SheetMotion):
    """Piecewise linear motion; before and after it the sheets are at rest."""

    path_s: Floats
    path_px: Floats
    integral_px_s: Floats  # up to each point of the path

    def _primitive(self, time_s: Floats) -> Floats:
        at, x = self.path_s, self.path_px
        t = np.clip(time_s, at[0], at[-1])
        k = np.clip(np.searchsorted(at, t, side="right") - 1, 0, at.size - 2)
        tau, length = (t - at[k])[:, None], (at[k + 1] - at[k])[:, None]
        inside = self.integral_px_s[k] + tau * (x[k] + (x[k + 1] - x[k]) * tau / (2 * length))
        early, late = np.minimum(time_s - at[0], 0)[:, None], np.maximum(time_s - at[-1], 0)[:, None]
        return np.asarray(inside + early * x[0] + late * x[-1])


def threshold_factors(experiment: Experiment) -> Floats:
    """Return the factors of the unequal thresholds of an experiment's sheets, (2M,)."""
    rng = random_stream(experiment.seed, "thresholds")
    spread = np.clip(rng.standard_normal(2 * experiment.sample.sheets_per_block), -3, 3)
    return np.asarray(1 + experiment.mechanics.threshold_scatter * spread)


def resolved_test(experiment: Experiment, comb: RestingComb) -> tuple[ResolvedPull, ResolvedMotion]:
    """Return pull and motion of a test with ``mechanics.model = "sheets"``."""
    m, factors = experiment.mechanics, threshold_factors(experiment)
    result = pull_sheets(m, experiment.sample, threshold_factor=factors)
    after_slip = np.flatnonzero(result["slipped"].values)
    valley = np.append(0, after_slip)
    peak = np.append(after_slip - 1, result.sizes["step"] - 1)
    at = result["time_s"].values.copy()
    # In the model a slip consists of two steps at the same time; here it gets its duration.
    following = np.append(at, np.inf)[after_slip + 1]
    at[after_slip] += np.minimum(m.slip_s, 0.5 * (following - at[after_slip]))
    begin, end, force = at[valley], at[peak], result["force_N"].values
    central = [np.interp(begin + share * (end - begin), at, force) for share in (0.25, 0.75)]
    length_mm = np.maximum(end - begin, 1e-9) * m.speed_mm_min / 60
    stiffness = (central[1] - central[0]) / (0.5 * length_mm)
    ended = end.copy()
    ended[-1] = np.nextafter(end[-1], np.inf)  # the machine stops before the last stick phase ends in a slip
    pull = ResolvedPull(
        settings=m,
        start_s=begin,
        end_s=ended,
        d_start_mm=m.d0_mm + begin * m.speed_mm_min / 60,
        d_end_mm=m.d0_mm + end * m.speed_mm_min / 60,
        low_N=force[valley],
        high_N=force[peak],
        stiffness_N_per_mm=stiffness,
        effective_sheets=stiffness / (2 * float(result.attrs["stiffness_N_per_mm"])),
        stop_s=float(at[-1]),
        path_s=at,
        path_N=force,
    )
    return pull, _resolved_motion(experiment, comb, result, at, valley, peak)


def _resolved_motion(
    experiment: Experiment, comb: RestingComb, result: xr.Dataset, at: Floats, valley: Ints, peak: Ints
) -> ResolvedMotion:
    """Return the motion of the sheets in view; σ_x is exact for their piecewise linear paths."""
    elongation = result["load_N"].values / result.attrs["stiffness_N_per_mm"]
    d = result["d_mm"].values
    since = valley[np.searchsorted(valley, np.arange(d.size), side="right") - 1]
    creep_mm = (d - d[since])[:, np.newaxis] - (elongation - elongation[since])
    model = zip(result["side"].values.tolist(), result["n"].values.tolist(), strict=True)
    index = {side_and_n: i for i, side_and_n in enumerate(model)}
    in_view = [index[one] for one in zip(comb.side.tolist(), comb.n.tolist(), strict=True)]
    px_per_mm = 1000 / experiment.camera.pixel_size_um
    path = -comb.side * np.sqrt(12) * experiment.sheets.outer_ratio * px_per_mm * creep_mm[:, in_view]
    spans, before, after = np.diff(at)[:, np.newaxis], path[:-1], path[1:]
    pieces = ((before + after) / 2 * spans, (before**2 + before * after + after**2) / 3 * spans)
    start = np.zeros((1, path.shape[1]))
    integral, square = (np.concatenate([start, np.cumsum(piece, axis=0)]) for piece in pieces)
    length_s = np.maximum(at[peak] - at[valley], 1e-9)[:, np.newaxis]
    mean = (integral[peak] - integral[valley]) / length_s
    variance = (square[peak] - square[valley]) / length_s - mean**2
    stick_px = length_s * experiment.mechanics.speed_mm_min / 60 * px_per_mm
    return ResolvedMotion(
        path_s=at,
        path_px=path,
        integral_px_s=integral,
        sweep_px=comb.side * (path[valley] - path[peak]),
        ratio=np.sqrt(np.maximum(variance, 0)) / stick_px,
        delay_s=np.zeros((valley.size, path.shape[1])),
    )
