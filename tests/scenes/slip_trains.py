"""Slips with known times as a camera and a load cell see them, for tests of the clocks alone."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
import xarray as xr
from scipy.signal import lfilter

from tests.scenes.sawtooth import recording
from vision.clock.alignment import SlipSizes, SlipTrains


@dataclass(frozen=True)
class Pair:
    """Two trains, and the clock between them: t_force = offset_s + rate t_video."""

    trains: SlipTrains
    offset_s: float
    rate: float

    def error_s(self, alignment) -> float:
        """By how much the best alignment is off at the centre of its slips."""
        centre = alignment.clocks.centre_s[0]
        return float(alignment.clocks.middle_s[0] - self.offset_s - self.rate * centre)


def slip_times(rng, count, *, period_s=0.5, jitter=0.07, trend=0.0):
    """Slips whose intervals scatter by `jitter` and change by `trend`, relatively, from one to the next."""
    usual = period_s * np.exp(trend * np.arange(count))
    return np.cumsum(usual * np.maximum(1 + jitter * rng.standard_normal(count), 0.2))


def damaged(rng, times, missed, false):
    """(the same with a share missed and false ones among them, which slip each is, -1 for a false one)."""
    kept = np.flatnonzero(rng.random(len(times)) >= missed)
    false_s = rng.uniform(times[0], times[-1], rng.poisson(false * len(times)))
    all_s, which = np.r_[times[kept], false_s], np.r_[kept, np.full(len(false_s), -1)]
    order = np.argsort(all_s)
    return all_s[order], which[order]


def seen_by_camera(rng, times, frame_s, lost=0.0):
    """(middle, standard error, index of the slip) of the gap between the frames around each slip.

    A share of frames is lost; of several slips between two frames the first counts.
    """
    frames = np.arange(times[0] - 1 - frame_s * rng.random(), times[-1] + 1, frame_s)
    frames = frames[rng.random(len(frames)) >= lost]
    after, which = np.unique(np.clip(np.searchsorted(frames, times), 1, len(frames) - 1), return_index=True)
    length = frames[after] - frames[after - 1]
    return frames[after] - 0.5 * length, length / np.sqrt(12), which


def sizes_of(rng, which, about, noise=0.02) -> SlipSizes:
    """Scored sizes of slips whose sizes are `about`; false ones are small."""
    size = np.where(which < 0, 0.4, about[which]) * (1 + noise * rng.standard_normal(len(which)))
    return SlipSizes.of(size, noise)


def pair(
    rng,
    *,
    video=100,
    force=None,
    missed=(0.0, 0.0),
    false=(0.0, 0.0),
    frame_s=0.05,
    drift_ppm=50.0,
    lost=0.0,
    unrelated=False,
    sizes=None,
    foreign=False,
    **pattern,
) -> Pair:
    """Trains of `video` and `force` slips, the shorter a random part of the longer.

    missed and false: shares, camera first.  unrelated: the camera's slips are those of another test.  sizes:
    scatter of the slips' sizes, relatively.  foreign: the camera sees other sizes than the load cell.
    """
    force = video if force is None else force
    slips = slip_times(rng, max(video, force), **pattern)
    first_v, first_f = (rng.integers(0, len(slips) - count + 1) for count in (video, force))
    at_camera = slips[first_v : first_v + video]
    if unrelated:
        at_camera = slip_times(rng, video, **pattern)
    offset, rate = rng.uniform(-30, 30), 1 + 1e-6 * drift_ppm
    camera, which_v = damaged(rng, at_camera, missed[0], false[0])
    middle, error, seen = seen_by_camera(rng, (camera - offset) / rate, frame_s, lost)
    machine, which_f = damaged(rng, slips[first_f : first_f + force], missed[1], false[1])
    machine = np.sort(machine + 0.001 * rng.standard_normal(len(machine)))
    trains = SlipTrains(middle, np.hypot(error, 0.0014), machine)
    if sizes is not None:
        about = [slip_sizes(rng, len(slips), sizes) for _ in range(2)]
        at_video = sizes_of(rng, which_v[seen], about[int(unrelated or foreign)][first_v:])
        trains = replace(trains, video_size=at_video, force_size=sizes_of(rng, which_f, about[0][first_f:]))
    return Pair(trains, offset, rate)


def slip_sizes(rng, count, scatter=0.07):
    """Sizes that scatter, relatively, and fall slowly."""
    return np.exp(scatter * rng.standard_normal(count) - 0.004 * np.arange(count))


def tracks(
    rng,
    slips_s,
    *,
    stop_s,
    frame_s=0.05,
    exposure_s=0.004,
    noise_px=0.05,
    jump_px=3.0,
    per_side=10,
    sides=(-1, 1),
    missing=0.05,
    lost=0.0,
    shake_px=0.1,
    drift_px=1.0,
    sizes=None,
    power=2.0,
    spread_s=0.0,
) -> xr.Dataset:
    """x(n, t): sheets that creep inwards and jump outwards at the slips, outer ones by `jump_px`.

    sizes: of each slip, relatively.  power: of n with which the jumps grow.  spread_s: time within which the
    sheets follow a slip one after the other.  With noise, missing positions, lost frames, and a picture that
    shakes and drifts as a whole.
    """
    time = np.arange(0.5 * frame_s, stop_s, frame_s)
    time = time[rng.random(len(time)) >= lost]
    side = np.repeat(sides, per_side)
    n = np.concatenate([np.arange(per_side, 0, -1) if s < 0 else np.arange(1, per_side + 1) for s in sides])
    begin, end = time - exposure_s / 2, time + exposure_s / 2
    sizes = np.ones(len(slips_s)) if sizes is None else sizes
    # Mean over the exposure of the slips so far, and the creep that undoes them on average.
    late = spread_s * np.random.default_rng(1).random((len(n), len(slips_s)))
    slips = np.clip((end[:, None, None] - slips_s - late) / exposure_s, 0, 1) @ sizes
    knots = np.r_[begin[0] - 1, slips_s, end[-1] + 1]
    creep = np.interp(time, knots, np.r_[0.0, np.cumsum(np.r_[sizes, 1.0])])
    outward = jump_px * (n / per_side) ** power * (slips - creep[:, None])
    picture = shake_px * rng.standard_normal((len(time), 1)) + np.linspace(0, drift_px, len(time))[:, None]
    x = 500 + side * (20 * n + outward) + picture + noise_px * rng.standard_normal(outward.shape)
    x[rng.random(x.shape) < missing] = np.nan
    return as_tracks(x, time, side, n, noise_px)


def as_tracks(x_px, time_s, side, n, noise_px) -> xr.Dataset:
    """Positions (frame, sheet) as `track_sheets` returns them."""
    where = ("frame", "sheet")
    flag = np.where(np.isfinite(x_px), "ok", "missing")
    variables = {
        "x_px": (where, x_px),
        "x_err_px": (where, np.full(x_px.shape, noise_px)),
        "flag": (where, flag),
    }
    coords = {"time_s": ("frame", time_s), "side": ("sheet", side), "n": ("sheet", n)}
    return xr.Dataset(variables, coords, {"source": "film.avi", "clock_kind": "given", "fit": "sliding"})


def sawtooth(
    rng, slips_s, *, stop_s, rate_hz=200.0, lowpass_s=0.003, drop_N=30.0, noise_N=0.05, sizes=None
) -> xr.Dataset:
    """A recording whose load drops at the slips, through a first-order low-pass, and rises in between.

    sizes: of each slip, relatively.
    """
    sizes = np.ones(len(slips_s)) if sizes is None else sizes
    fine = int(np.ceil(2000.0 / rate_hz))
    time = np.arange(0, stop_s, 1 / (rate_hz * fine))
    knots = np.r_[0.0, slips_s, stop_s]
    share = np.interp(time, knots, np.arange(len(knots)))
    following = np.r_[sizes, 1.0, 1.0][np.floor(share).astype(int)]
    load = 100 + drop_N * following * (share - np.floor(share))
    alpha = 1 - np.exp(-1 / (rate_hz * fine * lowpass_s))
    load = lfilter([alpha], [1, alpha - 1], load - load[0])[::fine] + load[0]
    load = load + noise_N * rng.standard_normal(len(load))
    return recording(time[::fine], load, 13 + time[::fine] / 60, 1.0)


def sticks_of(slips_s, *, drop_N=30.0, sizes=None) -> pd.DataFrame:
    """The event table of a recording with these slips, corners exact."""
    peak_N = 100 + drop_N * (np.ones(len(slips_s)) if sizes is None else sizes)
    t_v_s, t_p_s = slips_s[:-1] + 0.001, slips_s[1:]
    table = pd.DataFrame(
        {
            "event": np.arange(len(t_v_s)),
            "t_v_s": t_v_s,
            "t_p_s": t_p_s,
            "d_v_mm": 13 + t_v_s / 60,
            "d_p_mm": 13 + t_p_s / 60,
            "F_v_N": 100.0,
            "F_p_N": peak_N[1:],
            "dF_N": peak_N[1:] - 100.0,
            "stick_length_um": 1e3 * (t_p_s - t_v_s) / 60,
        }
    )
    table.attrs["first_slip_s"] = float(slips_s[0])
    return table
