"""Where every sheet is at every moment, x(n, t), before camera and lens.

In a stick a sheet creeps towards the axis at constant speed; in a slip it jumps back out as half a
cosine. The sweep of sheet n in one stick is sqrt(12) sigma_x, with sigma_x / (stick length) = outer
(rank/M)^p and p such that it falls to the stiff threshold at M_eff.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vision.experiment.randomness import stream

if TYPE_CHECKING:
    from vision.experiment.mechanics import Pull
    from vision.experiment.settings import Experiment, Mechanics, Sheets

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Comb:
    """The ridges at rest, left to right: position, side (-1, +1), n from 1, and distance from the axis
    in pitches."""

    axis_px: float
    rest_px: Array
    side: NDArray[np.int64]
    n: NDArray[np.int64]
    rank: Array


def comb_at_rest(experiment: Experiment) -> Comb:
    """Ridges with uneven pitch, centred in the frame.

    With an odd number the middle one stands on the axis and counts as n = 1 on the right.
    """
    sheets, middle = experiment.sheets, (experiment.camera.width - 1) / 2
    right = {"both": (sheets.count + 1) // 2, "right": sheets.count, "left": 0}[sheets.side]
    place = np.arange(sheets.count) - (sheets.count - right)
    side = np.where(place >= 0, 1, -1)
    n = np.where(place >= 0, place + 1, -place)
    odd = sheets.side == "both" and sheets.count % 2 == 1
    steps = place + (0.0 if odd else 0.5)
    axis = middle - steps.mean() * sheets.pitch_px
    rng = stream(experiment.seed, "comb")
    uneven = sheets.pitch_jitter * rng.uniform(-1, 1, sheets.count)
    rank = np.abs(steps) + (0.0 if odd else 0.5)
    rest = axis + (steps + uneven) * sheets.pitch_px
    return Comb(axis_px=axis, rest_px=rest, side=side, n=n, rank=rank)


def deformation_ratio(rank_share: Array, m_eff: Array, sheets: Sheets, m: Mechanics) -> Array:
    """sigma_x over stick length (event, sheet) for sheets at rank/M and events of M_eff stiff sheets."""
    stiff_share = np.clip(m_eff / m.sheets_per_side, 0.02, 0.98)[:, None]
    if sheets.outer_ratio <= sheets.stiff_ratio:
        return np.broadcast_to(sheets.outer_ratio * rank_share, (len(m_eff), len(rank_share))).copy()
    power = np.log(sheets.stiff_ratio / sheets.outer_ratio) / np.log(stiff_share)
    return np.asarray(sheets.outer_ratio * rank_share**power)


@dataclass(frozen=True, kw_only=True)
class Motion:
    """Displacement from rest of every sheet, px, as a function of the machine's time.

    Segment k runs from one slip to the next: every sheet holds for its `delay_s`, jumps within `slip_s`
    to `outer` and creeps to `inner`. The first segment has no slip. `sweep_px` and `ratio` are (stick,
    sheet).
    """

    begin_s: Array
    length_s: Array
    slip_s: float
    stop_s: float
    before_px: Array
    outer_px: Array
    inner_px: Array
    delay_s: Array
    integral_px_s: Array
    sweep_px: Array
    ratio: Array

    def mean_px(self, from_s: Array, to_s: Array) -> Array:
        """Displacement (time, sheet) averaged between two times, exactly."""
        span = (np.asarray(to_s) - from_s)[:, None]
        return (self._primitive(to_s) - self._primitive(from_s)) / span

    def _primitive(self, time_s: Array) -> Array:
        """Integral of the displacement from time 0."""
        t = np.clip(time_s, 0, self.stop_s)
        k = np.clip(np.searchsorted(self.begin_s, t, side="right") - 1, 0, None)
        inside = _segment_integral(self, k, (t - self.begin_s[k])[:, None])
        early, late = np.minimum(time_s, 0)[:, None], np.maximum(time_s - self.stop_s, 0)[:, None]
        outside = early * self.outer_px[0] + late * self._final_px()
        return np.asarray(self.integral_px_s[k] + inside + outside)

    def _final_px(self) -> Array:
        """Where the sheets stay when the machine has stopped."""
        last = np.clip(np.searchsorted(self.begin_s, self.stop_s, side="right") - 1, 0, None)
        share = np.clip((self.stop_s - self.begin_s[last] - self.slip_s) / self.length_s[last], 0, 1)
        return np.asarray(self.outer_px[last] + share * (self.inner_px[last] - self.outer_px[last]))


def _segment_integral(motion: Motion, k: NDArray[np.int64], tau: Array) -> Array:
    """Integral of the displacement over the first tau seconds of segments k: hold, half cosine, straight
    line."""
    before, outer, inner = motion.before_px[k], motion.outer_px[k], motion.inner_px[k]
    delay = motion.delay_s[k]
    slip = np.where(k > 0, motion.slip_s, 1e-12)[:, None]
    creep = motion.length_s[k][:, None] - slip - delay
    held = np.minimum(tau, delay)
    u = np.clip(tau - delay, 0, slip)
    v = np.maximum(tau - delay - slip, 0)
    jump = before * u + (outer - before) * (u / 2 - slip / (2 * np.pi) * np.sin(np.pi * u / slip))
    return np.asarray(before * held + jump + outer * v + (inner - outer) * v**2 / (2 * creep))


def sheet_motion(experiment: Experiment, pull: Pull, comb: Comb) -> Motion:
    """The motion that belongs to a pull: creep, jumps, slow spreading, optional delays between sheets."""
    sheets, m = experiment.sheets, experiment.mechanics
    rng = stream(experiment.seed, "motion")
    ratio = deformation_ratio(comb.rank / sheets.per_side, pull.effective_sheets, sheets, m)
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
