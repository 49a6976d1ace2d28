r"""The traction test itself, before any instrument: stick-slip events, d(t), F(t), x(n, t), the two clocks.

The pull starts at time 0 of the machine's clock at d0 with zero force. A first elastic loading ends in
slip 0; event i is the stick between slips i and i + 1. In a stick a sheet creeps towards the axis at constant
speed; in a slip it jumps back out as half a cosine.

With ``mechanics.model = "sheets"`` thresholds decide which sheets stick and for how long (`sheet_model`); the
one thing added here is how far a sheet is seen to move. What it creeps between two slips of the assembly,
s(n) = d − d_v − (T(n) − T_v(n))/k, its free part takes up by bending inwards, and the slip gives it back:

.. math:: x(n, t) = \hat x(n) \mp \sqrt{12}\, r\, s(n, t)

with one r for all sheets (`sheets.outer_ratio`): a sheet that creeps all the way has σ_x/Λ_st = r, one that
sticks to the end has 0. It uses neither M_eff nor a shell.
"""

# ruff: noqa: N815 (the unit is part of a name, and newton is N)
from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np
import pandas as pd
import xarray as xr

from vision.experiment.settings import Experiment, Mechanics, Sheets
from vision.experiment.sheet_model import SheetPull, pull_sheets
from vision.models import equations as eq
from vision.numeric import Bools, Floats, Ints
from vision.sample import PUBLISHED, Sample


def random_stream(seed: int, part: str, *numbers: int) -> np.random.Generator:
    """Random numbers of one part of an experiment (and, where given, of one frame or sheet of it).

    Each part has its own stream, derived from the seed and the part's name, so that a change of one part
    (more texture, say) leaves the numbers of every other part as they were.
    """
    key = (zlib.crc32(part.encode()), *numbers)
    return np.random.Generator(np.random.SFC64(np.random.SeedSequence(seed, spawn_key=key)))


# --- the pull -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Pull:
    """What the machine did and how the sample responded.

    One entry per stick, the initial loading first: it starts at (start_s, d_start_mm, low_N) and ends,
    in a slip, at (end_s, d_end_mm, high_N). The stick under way when the machine stops is included.
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
        """Whether each stick ended in a slip before the machine stopped."""
        return self.end_s <= self.stop_s

    @property
    def slip_s(self) -> Floats:
        """Times at which slips begin."""
        return self.end_s[self.complete]

    def separation_mm(self, time_s: Floats) -> Floats:
        """d(t) in mm; constant before the pull and after it."""
        speed = self.settings.speed_mm_min / 60
        return self.settings.d0_mm + speed * np.clip(time_s, 0, self.stop_s)

    def force_N(self, time_s: Floats) -> Floats:
        """F(t) in N, exact; 0 before the pull, constant after the machine has stopped."""
        m = self.settings
        t = np.clip(time_s, 0, self.stop_s)
        k = np.clip(np.searchsorted(self.start_s, t, side="right") - 1, 0, None)
        u = (t - self.start_s[k]) / (self.end_s[k] - self.start_s[k])
        rise = self.high_N - self.low_N
        stick = self.low_N[k] + rise[k] * _stick_shape(u, m)
        # Between the end of a stick and the start of the next the force falls as half a cosine.
        fall = np.clip((t - self.end_s[k]) / m.slip_s, 0, 1)
        following = np.minimum(k + 1, len(self.low_N) - 1)
        slip = self.high_N[k] + (self.low_N[following] - self.high_N[k]) * (1 - np.cos(np.pi * fall)) / 2
        return np.where(u <= 1, stick, slip)

    def events(self) -> pd.DataFrame:
        """The complete stick-slip events, without the initial loading: the columns of `events.csv`, exact.

        Times are on the machine's clock. M_eff stands beside K; slip_length_um is what the machine moved
        during the slip.
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
    r"""The whole test, event by event.

    Parameters
    ----------
    m
        Friction, stiffness and the pull.
    seed
        Of the scatter.
    sample
        M, the dimensions of the sheets, and T*.

    Notes
    -----
    An event that starts at d has

    .. math:: \Delta F = A\,N(d), \qquad K = M_\mathrm{eff}(d)\,K_\mathrm{eff},
              \qquad \Lambda_\mathrm{st} = \Delta F / K

    and ends at the peak force of Eq. 1. ΔF varies by `period_jitter`, the peaks by `peak_scatter`. Where
    the model has no stiff sheet left (M_eff < 1), the pull goes on with one: K would be 0 and the next
    slip never come. Source: paper, Eqs. 1-2 and section IV.
    """
    rng = random_stream(seed, "mechanics")
    speed, stop_s = m.speed_mm_min / 60, (m.d_end_mm - m.d0_mm) / (m.speed_mm_min / 60)
    rows: list[tuple[float, ...]] = []
    time, d, low = 0.0, m.d0_mm, 0.0
    while time < stop_s:
        drop, stiffness, m_eff = _event_at(d, m, sample, jitter=rng.standard_normal())
        scatter = 1 + m.peak_scatter * rng.standard_normal()
        length = drop / (stiffness * _mean_slope(m)) if rows else _loading_mm(stiffness, m, sample)
        length = max(length, 2e-4)  # without force, where the pull only builds up, it would be zero
        high = _peak_force_N(d + length, m, sample) * scatter
        low = max(high - drop, 0.0) if rows else 0.0
        end = time + length / speed
        rows.append((time, end, d, d + length, low, high, stiffness, m_eff))
        time, d = end + m.slip_s, d + length + speed * m.slip_s
    names = ("start_s", "end_s", "d_start_mm", "d_end_mm", "low_N", "high_N",
             "stiffness_N_per_mm", "effective_sheets")  # fmt: skip
    return Pull(settings=m, stop_s=stop_s, **dict(zip(names, np.array(rows).T, strict=True)))


def _event_at(d_mm: float, m: Mechanics, sample: Sample, *, jitter: float) -> tuple[float, float, float]:
    """Force drop (N), stiffness (N/mm) and M_eff of an event that starts at d."""
    total = eq.total_normal_force(d_mm, mu=m.mu, sample=sample)
    d_hat = eq.reduced_separation(d_mm, mu=m.mu, n_hat_N=m.n_hat_N, sample=sample)
    sheets = float(eq.effective_sheets(d_hat, sample=sample))
    one = eq.sheet_stiffness(modulus_GPa=m.modulus_GPa, sample=sample)
    # A drop never turns negative, however large the jitter asked for.
    drop = m.amplitude * float(total) * max(1 + m.period_jitter * jitter, 0.1) * _built_up(d_mm, m)
    return drop, max(sheets, 1.0) * float(one), sheets


def _peak_force_N(d_mm: float, m: Mechanics, sample: Sample) -> float:
    """Force at which the sample slips at d: Eq. 1 and the offset, smaller while the pull builds up."""
    force = eq.traction(d_mm, mu=m.mu, sample=sample)
    return (float(force) + m.t0_N) * _built_up(d_mm, m)


def _built_up(d_mm: float, m: Mechanics) -> float:
    """Share of the peak force reached at d."""
    return 1 - float(np.exp(-(d_mm - m.d0_mm) / m.buildup_mm)) if m.buildup_mm else 1.0


def _loading_mm(stiffness_N_per_mm: float, m: Mechanics, sample: Sample) -> float:
    """Length of the first elastic loading: where K (d - d0) meets the force at which the sample slips."""
    length = 0.0
    for _ in range(50):
        length = _peak_force_N(m.d0_mm + length, m, sample) / (stiffness_N_per_mm * _mean_slope(m))
    return length


def _mean_slope(m: Mechanics) -> float:
    """Mean slope of the stick over K, K being the slope of its later (or only) part."""
    return 1 + m.early_fraction * (m.early_stiffness_ratio - 1) if m.early_stiffness_ratio > 1 else 1.0


def _stick_shape(u: Floats, m: Mechanics) -> Floats:
    """Share of the stick's force rise reached at the share u of its length: 0 to 1.

    The slope falls by `softening` from start to end, its mean and its middle value being one; with an early
    steeper part it falls at `early_fraction` by `early_stiffness_ratio` instead.
    """
    if m.early_stiffness_ratio > 1:
        later = 1 / (1 + m.early_fraction * (m.early_stiffness_ratio - 1))
        return later * (u + (m.early_stiffness_ratio - 1) * np.minimum(u, m.early_fraction))
    return u + m.softening * u * (1 - u) / 2


# --- the camera's clock and the sheets at rest --------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class FrameTimes:
    """Times of mid-exposure, one entry per frame that reached the file.

    camera_s is true camera time, stamp_s what the camera wrote (stale stamps repeat the one before),
    machine_s the force clock; `exposed` numbers the frames before any were lost.
    """

    camera_s: Floats
    stamp_s: Floats
    machine_s: Floats
    exposed: Ints
    lost: int


def frame_times(experiment: Experiment) -> FrameTimes:
    """Times of the frames that are kept; the first is never lost."""
    camera, clocks = experiment.camera, experiment.clocks
    total = max(round(camera.duration_s * camera.fps), 1)
    rng = random_stream(experiment.seed, "clocks")
    keep = rng.uniform(size=total) >= clocks.dropped
    keep[0] = True
    exposed = np.flatnonzero(keep)
    true = exposed / camera.fps
    stale = rng.uniform(size=total)[exposed] < clocks.stale
    stale[0] = False
    source = np.maximum.accumulate(np.where(stale, 0, np.arange(len(true))))
    machine = clocks.offset_s + (1 + clocks.drift_ppm * 1e-6) * true
    return FrameTimes(
        camera_s=true, stamp_s=true[source], machine_s=machine, exposed=exposed, lost=total - len(exposed)
    )


def camera_time(machine_s: Floats, experiment: Experiment) -> Floats:
    """Video time of a moment on the force clock."""
    clocks = experiment.clocks
    return (np.asarray(machine_s) - clocks.offset_s) / (1 + clocks.drift_ppm * 1e-6)


@dataclass(frozen=True, kw_only=True)
class RestingComb:
    """The ridges at rest, left to right: position, side (-1, +1), n from 1, and distance from the axis
    in pitches."""

    axis_px: float
    rest_px: Floats
    side: Ints
    n: Ints
    rank: Floats


def comb_at_rest(experiment: Experiment) -> RestingComb:
    """Ridges with uneven pitch, centred in the frame.

    With an odd number the middle one stands on the axis and counts as n = 1 on the right.
    """
    sheets, count = experiment.sheets, experiment.ridges_in_view
    middle = (experiment.camera.width - 1) / 2
    right = {"both": (count + 1) // 2, "right": count, "left": 0}[sheets.side]
    place = np.arange(count) - (count - right)
    side = np.where(place >= 0, 1, -1)
    n = np.where(place >= 0, place + 1, -place)
    odd = sheets.side == "both" and count % 2 == 1
    steps = place + (0.0 if odd else 0.5)
    axis = middle - steps.mean() * sheets.pitch_px
    rng = random_stream(experiment.seed, "comb")
    uneven = sheets.pitch_jitter * rng.uniform(-1, 1, count)
    rank = np.abs(steps) + (0.0 if odd else 0.5)
    rest = axis + (steps + uneven) * sheets.pitch_px
    return RestingComb(axis_px=axis, rest_px=rest, side=side, n=n, rank=rank)


# --- the sheets' motion -------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class SheetMotion:
    """Displacement from rest of every sheet, px, as a function of the machine's time.

    `sweep_px` (inward motion from valley to peak), `ratio` (σ_x/Λ_st) and `delay_s` are (stick, sheet).
    """

    sweep_px: Floats
    ratio: Floats
    delay_s: Floats
    integral_px_s: Floats

    def mean_px(self, from_s: Floats, to_s: Floats) -> Floats:
        """Displacement (time, sheet) averaged between two times, exactly."""
        span = (np.asarray(to_s) - from_s)[:, None]
        return (self._primitive(to_s) - self._primitive(from_s)) / span

    def _primitive(self, time_s: Floats) -> Floats:
        """Integral of the displacement from the start."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class Motion(SheetMotion):
    """The motion that belongs to events from equations.

    Segment k runs from one slip to the next: every sheet stays for its `delay_s`, jumps within `slip_s`
    to `outer` and creeps to `inner`. The first segment has no slip.
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
        inside = _segment_integral(self, k, (t - self.begin_s[k])[:, None])
        early, late = np.minimum(time_s, 0)[:, None], np.maximum(time_s - self.stop_s, 0)[:, None]
        outside = early * self.outer_px[0] + late * self._final_px()
        return np.asarray(self.integral_px_s[k] + inside + outside)

    def _final_px(self) -> Floats:
        """Where the sheets stay when the machine has stopped."""
        last = np.clip(np.searchsorted(self.begin_s, self.stop_s, side="right") - 1, 0, None)
        share = np.clip((self.stop_s - self.begin_s[last] - self.slip_s) / self.length_s[last], 0, 1)
        return np.asarray(self.outer_px[last] + share * (self.inner_px[last] - self.outer_px[last]))


def _segment_integral(motion: Motion, k: Ints, tau: Floats) -> Floats:
    """Integral of the displacement over the first tau seconds of segments k: rest, half cosine, straight
    line."""
    before, outer, inner = motion.before_px[k], motion.outer_px[k], motion.inner_px[k]
    delay = motion.delay_s[k]
    slip = np.where(k > 0, motion.slip_s, 1e-12)[:, None]
    creep = motion.length_s[k][:, None] - slip - delay
    waited = np.minimum(tau, delay)
    u = np.clip(tau - delay, 0, slip)
    v = np.maximum(tau - delay - slip, 0)
    jump = before * u + (outer - before) * (u / 2 - slip / (2 * np.pi) * np.sin(np.pi * u / slip))
    return np.asarray(before * waited + jump + outer * v + (inner - outer) * v**2 / (2 * creep))


def sheet_motion(experiment: Experiment, pull: Pull, comb: RestingComb) -> Motion:
    r"""The motion that belongs to a pull: creep, jumps, slow spreading, delays between sheets.

    Notes
    -----
    The sweep of a sheet in one stick is √12 σ_x (uniform creep), with

    .. math:: \sigma_x / \Lambda_\mathrm{st} = r_\mathrm{outer}\,(\mathrm{rank}/M)^p

    and p such that it falls to the stiff threshold at M_eff.
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
    if len(sweep) > 1:  # the initial loading is longer than a stick and ends where the first stick would
        inner[0] = -comb.side * sweep[1] / 2
        outer[0] = inner[0] + comb.side * sweep[0]
    begin = np.concatenate([[0.0], pull.end_s[:-1]])
    length = np.diff(np.append(begin, pull.end_s[-1]))
    delay = sheets.slip_delay_s * rng.uniform(0, 1, sweep.shape)
    delay = np.minimum(delay, 0.5 * np.maximum(length - m.slip_s, 0)[:, None])
    delay[0] = 0
    motion = Motion(
        begin_s=begin,
        length_s=length,
        slip_s=m.slip_s,
        stop_s=pull.stop_s,
        before_px=np.vstack([outer[:1], inner[:-1]]),
        outer_px=outer,
        inner_px=inner,
        delay_s=delay,
        integral_px_s=np.zeros_like(sweep),
        sweep_px=sweep,
        ratio=ratio,
    )
    whole = _segment_integral(motion, np.arange(len(length)), length[:, None])
    motion.integral_px_s[1:] = np.cumsum(whole, axis=0)[:-1]
    return motion


def _deformation_ratio(rank_share: Floats, stiff_share: Floats, sheets: Sheets) -> Floats:
    """σ_x/Λ_st (event, sheet) for sheets at rank/M and events at which M_eff/M of the sheets are stiff."""
    if sheets.outer_ratio <= sheets.stiff_ratio:
        return np.broadcast_to(sheets.outer_ratio * rank_share, (len(stiff_share), len(rank_share))).copy()
    power = (
        np.log(sheets.stiff_ratio / sheets.outer_ratio) / np.log(np.clip(stiff_share, 0.02, 0.98))[:, None]
    )
    return np.asarray(sheets.outer_ratio * rank_share**power)


# --- resolved by sheets -------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class ResolvedPull(Pull):
    """A pull whose force is a path, straight between its points."""

    path_s: Floats
    path_N: Floats

    def force_N(self, time_s: Floats) -> Floats:
        """F(t) in N."""
        return np.asarray(np.interp(time_s, self.path_s, self.path_N))


@dataclass(frozen=True, kw_only=True)
class ResolvedMotion(SheetMotion):
    """Straight between the points of a path; before and after it the sheets stay as they are."""

    path_s: Floats
    path_px: Floats

    def _primitive(self, time_s: Floats) -> Floats:
        at, x = self.path_s, self.path_px
        t = np.clip(time_s, at[0], at[-1])
        k = np.clip(np.searchsorted(at, t, side="right") - 1, 0, at.size - 2)
        tau, length = (t - at[k])[:, None], (at[k + 1] - at[k])[:, None]
        inside = self.integral_px_s[k] + tau * (x[k] + (x[k + 1] - x[k]) * tau / (2 * length))
        early, late = np.minimum(time_s - at[0], 0)[:, None], np.maximum(time_s - at[-1], 0)[:, None]
        return np.asarray(inside + early * x[0] + late * x[-1])


def sheet_pull(experiment: Experiment) -> SheetPull:
    """The sheet-resolved pull of an experiment: its sample, friction, speed, unequal thresholds."""
    m = experiment.mechanics
    count = 2 * experiment.sample.sheets_per_block
    spread = np.clip(random_stream(experiment.seed, "thresholds").standard_normal(count), -3, 3)
    return SheetPull(
        sample=experiment.sample,
        mu=m.mu,
        amplitude=m.amplitude,
        modulus_GPa=m.modulus_GPa,
        speed_mm_min=m.speed_mm_min,
        d0_mm=m.d0_mm,
        d_end_mm=m.d_end_mm,
        positions="middles",
        slips="together",
        threshold_factor=tuple((1 + m.threshold_scatter * spread).tolist()),
    )


def resolved_test(experiment: Experiment, comb: RestingComb) -> tuple[ResolvedPull, ResolvedMotion]:
    """Pull and motion of a test with ``mechanics.model = "sheets"``."""
    m, result = experiment.mechanics, pull_sheets(sheet_pull(experiment))
    after_slip = np.flatnonzero(result["slipped"].values.any(axis=1))
    valley = np.append(0, after_slip)
    peak = np.append(after_slip - 1, result.sizes["step"] - 1)
    at = result["time_s"].values.copy()
    # A slip takes two steps of one time in the model: here it is given its duration.
    following = np.append(at, np.inf)[after_slip + 1]
    at[after_slip] += np.minimum(m.slip_s, 0.5 * (following - at[after_slip]))
    begin, end, force = at[valley], at[peak], result["force_N"].values
    central = [np.interp(begin + share * (end - begin), at, force) for share in (0.25, 0.75)]
    length_mm = np.maximum(end - begin, 1e-9) * m.speed_mm_min / 60
    stiffness = (central[1] - central[0]) / (0.5 * length_mm)
    ended = end.copy()
    ended[-1] = np.nextafter(end[-1], np.inf)  # the machine stops before the last one slips
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
    stretch = result["load_N"].values / result.attrs["stiffness_N_per_mm"]
    d = result["d_mm"].values
    since = valley[np.searchsorted(valley, np.arange(d.size), side="right") - 1]
    crept_mm = (d - d[since])[:, np.newaxis] - (stretch - stretch[since])
    model = zip(result["side"].values.tolist(), result["n"].values.tolist(), strict=True)
    place = {one: i for i, one in enumerate(model)}
    seen = [place[one] for one in zip(comb.side.tolist(), comb.n.tolist(), strict=True)]
    px_per_mm = 1000 / experiment.camera.pixel_size_um
    path = -comb.side * np.sqrt(12) * experiment.sheets.outer_ratio * px_per_mm * crept_mm[:, seen]
    spans, before, after = np.diff(at)[:, np.newaxis], path[:-1], path[1:]
    pieces = ((before + after) / 2 * spans, (before**2 + before * after + after**2) / 3 * spans)
    none = np.zeros((1, path.shape[1]))
    integral, square = (np.concatenate([none, np.cumsum(piece, axis=0)]) for piece in pieces)
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
