"""The traction test itself, before any instrument: stick-slip events, d(t), F(t), and the two clocks.

The pull starts at time 0 of the machine's clock at d0 with zero force. A first elastic loading ends in
slip 0; event i is the stick between slips i and i + 1.
"""

# ruff: noqa: N815 (the unit is part of a name, and newton is N)
from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np
import pandas as pd

from vision.experiment.settings import Experiment, Mechanics
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
    start, end_s, d_start, d_stop, lows, highs, k, sheets = np.array(rows).T
    return Pull(
        settings=m,
        start_s=start,
        end_s=end_s,
        d_start_mm=d_start,
        d_end_mm=d_stop,
        low_N=lows,
        high_N=highs,
        stiffness_N_per_mm=k,
        effective_sheets=sheets,
        stop_s=stop_s,
    )


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
