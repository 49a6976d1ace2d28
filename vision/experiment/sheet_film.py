r"""What the sheet-resolved pull looks like: its force, its events, and where every sheet is seen.

For ``mechanics.model = "sheets"``. Which sheets stick and for how long comes out of thresholds
(`sheet_model`); the one thing added here is how far a sheet is seen to move. What it creeps between two slips
of the assembly, s(n) = d − d_v − (T(n) − T_v(n))/k, its free part takes up by bending inwards, and the slip
gives it back:

.. math:: x(n, t) = \hat x(n) \mp \sqrt{12}\, r\, s(n, t)

with one r for all sheets (`sheets.outer_ratio`): a sheet that creeps all the way has σ_x/Λ_st = r, one that
sticks to the end has 0. It uses neither M_eff nor a shell.
"""

# ruff: noqa: N815 (the unit is part of a name, and newton is N)
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr

from vision.experiment.mechanics import Pull, random_stream
from vision.experiment.motion import RestingComb
from vision.experiment.settings import Experiment
from vision.experiment.sheet_model import SheetPull, pull_sheets
from vision.numeric import Floats, Ints


@dataclass(frozen=True, kw_only=True)
class ResolvedPull(Pull):
    """A pull whose force is a path, straight between its points."""

    path_s: Floats
    path_N: Floats

    def force_N(self, time_s: Floats) -> Floats:
        """F(t) in N, exact; 0 before the pull, constant after the machine has stopped."""
        return np.asarray(np.interp(time_s, self.path_s, self.path_N))


@dataclass(frozen=True, kw_only=True)
class ResolvedMotion:
    """Displacement of every sheet from rest, px: straight between the points of a path.

    `sweep_px` (inward motion from valley to peak), `ratio` (σ_x/Λ_st) and `delay_s` are (stick, sheet).
    """

    path_s: Floats
    path_px: Floats
    integral_px_s: Floats
    sweep_px: Floats
    ratio: Floats
    delay_s: Floats

    def mean_px(self, from_s: Floats, to_s: Floats) -> Floats:
        """Displacement (time, sheet) averaged between two times, exactly."""
        span = (np.asarray(to_s) - from_s)[:, None]
        return (self._primitive(to_s) - self._primitive(from_s)) / span

    def _primitive(self, time_s: Floats) -> Floats:
        """Integral of the displacement from the path's start; it stays as it is before and after."""
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
    result = pull_sheets(sheet_pull(experiment))
    after_slip = np.flatnonzero(result["slipped"].values.any(axis=1))
    valley = np.append(0, after_slip)
    peak = np.append(after_slip - 1, result.sizes["step"] - 1)
    at = result["time_s"].values.copy()
    # A slip takes two steps of one time in the model: here it is given its duration.
    following = np.append(at, np.inf)[after_slip + 1]
    at[after_slip] += np.minimum(experiment.mechanics.slip_s, 0.5 * (following - at[after_slip]))
    return (
        _resolved_pull(experiment, result, at, valley, peak),
        _resolved_motion(experiment, comb, result, at, valley, peak),
    )


def _resolved_pull(
    experiment: Experiment, result: xr.Dataset, at: Floats, valley: Ints, peak: Ints
) -> ResolvedPull:
    m, force = experiment.mechanics, result["force_N"].values
    begin, end = at[valley], at[peak]
    central = [np.interp(begin + share * (end - begin), at, force) for share in (0.25, 0.75)]
    length_mm = np.maximum(end - begin, 1e-9) * m.speed_mm_min / 60
    stiffness = (central[1] - central[0]) / (0.5 * length_mm)
    ended = end.copy()
    ended[-1] = np.nextafter(end[-1], np.inf)  # the machine stops before the last one slips
    return ResolvedPull(
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
    integral, square = _integrals(path, at)
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


def _integrals(path: Floats, at: Floats) -> tuple[Floats, Floats]:
    """Integrals over time of a path of straight pieces and of its square, from its start to each point."""
    spans, before, after = np.diff(at)[:, np.newaxis], path[:-1], path[1:]
    pieces = ((before + after) / 2 * spans, (before**2 + before * after + after**2) / 3 * spans)
    first, second = (np.concatenate([np.zeros((1, path.shape[1])), np.cumsum(p, axis=0)]) for p in pieces)
    return first, second
