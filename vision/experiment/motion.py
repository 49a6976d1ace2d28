"""Where every sheet is at every moment, x(n, t), and where the camera sees it.

In a stick a sheet creeps towards the axis at constant speed; in a slip it jumps back out as half a
cosine. Tilt, bowed sheets and lens distortion are a map that is fixed in time: a point at x on the middle
row is seen on row z at x + s(x, z), with s = tan(tilt) ζ + bow(x) (ζ / half height)² + distortion, where ζ
is the row counted from the middle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vision.experiment.mechanics import Pull, random_stream
from vision.experiment.settings import Experiment, Sheets
from vision.numeric import Floats, Ints


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


@dataclass(frozen=True, kw_only=True)
class Motion:
    """Displacement from rest of every sheet, px, as a function of the machine's time.

    Segment k runs from one slip to the next: every sheet stays for its `delay_s`, jumps within `slip_s`
    to `outer` and creeps to `inner`. The first segment has no slip. `sweep_px` and `ratio` are (stick,
    sheet).
    """

    begin_s: Floats
    length_s: Floats
    slip_s: float
    stop_s: float
    before_px: Floats
    outer_px: Floats
    inner_px: Floats
    delay_s: Floats
    integral_px_s: Floats
    sweep_px: Floats
    ratio: Floats

    def mean_px(self, from_s: Floats, to_s: Floats) -> Floats:
        """Displacement (time, sheet) averaged between two times, exactly."""
        span = (np.asarray(to_s) - from_s)[:, None]
        return (self._primitive(to_s) - self._primitive(from_s)) / span

    def _primitive(self, time_s: Floats) -> Floats:
        """Integral of the displacement from time 0."""
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
    held = np.minimum(tau, delay)
    u = np.clip(tau - delay, 0, slip)
    v = np.maximum(tau - delay - slip, 0)
    jump = before * u + (outer - before) * (u / 2 - slip / (2 * np.pi) * np.sin(np.pi * u / slip))
    return np.asarray(before * held + jump + outer * v + (inner - outer) * v**2 / (2 * creep))


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


@dataclass(frozen=True, kw_only=True)
class Geometry:
    """The fixed map from sheet coordinates to pixels."""

    width: int
    height: int
    tilt: float
    bow_px: float
    axis_px: float
    half_comb_px: float
    distortion: float

    @property
    def straight(self) -> bool:
        """True where every row shows the same."""
        return self.tilt == 0 and self.bow_px == 0 and self.distortion == 0

    @property
    def zeta_px(self) -> Floats:
        """ζ of every row."""
        return np.arange(self.height, dtype=float) - (self.height - 1) / 2

    def shift_px(self, x_px: Floats, zeta_px: Floats, zeta2_px2: Floats | None = None) -> Floats:
        """s(x, z) in px. Polynomial in ζ, so means of ζ and ζ² over rows give the mean shift."""
        z2 = zeta_px**2 if zeta2_px2 is None else zeta2_px2
        out = np.clip((x_px - self.axis_px) / self.half_comb_px, -1.5, 1.5)
        bowed = -self.bow_px * out * np.abs(out) * z2 / (self.height / 2) ** 2
        off = x_px - (self.width - 1) / 2
        corner2 = (self.width / 2) ** 2 + (self.height / 2) ** 2
        lens = self.distortion * off * (off**2 + z2) / corner2
        return np.asarray(self.tilt * zeta_px + bowed + lens)

    def source_px(self, x_px: Floats, zeta_px: Floats) -> Floats:
        """The inverse: which x is seen at pixel coordinate x_px of a row."""
        source = np.broadcast_to(x_px, np.broadcast_shapes(x_px.shape, zeta_px.shape)).astype(float)
        for _ in range(12):  # contracts by the local stretch, a few per cent at most
            source = x_px - self.shift_px(source, zeta_px)
        return source


def camera_geometry(experiment: Experiment, comb: RestingComb) -> Geometry:
    """Geometry of an experiment; the bow is that of the outermost sheet over the frame's height."""
    optics, camera = experiment.optics, experiment.camera
    return Geometry(
        width=camera.width,
        height=camera.height,
        tilt=float(np.tan(np.radians(optics.tilt_deg))),
        bow_px=experiment.sheets.bow_px,
        axis_px=comb.axis_px,
        half_comb_px=float(np.max(np.abs(comb.rest_px - comb.axis_px))) or 1.0,
        distortion=optics.distortion,
    )
