"""The scene of an experiment: ridges, light and surface in any frame, before the sensor.

Tilt, bowed sheets and lens distortion are a map that is constant in time: a point at x on the middle row
appears on row z at x + s(x, z), with s = tan(tilt) ζ + bow(x) (ζ / half height)² + distortion, where ζ is the
row counted from the middle.

Light is in fractions of the sensor's saturation. The shape of a ridge is given by its integral from minus
infinity. The light in a cell is therefore a difference of two values, and exact; shapes are never sampled at
points. Every shape has its centroid at zero.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import scipy
import xarray as xr

from vision.experiment.mechanics import (
    Pull,
    RestingComb,
    SheetMotion,
    comb_at_rest,
    random_stream,
    resolved_test,
    sheet_motion,
    simulate_pull,
)
from vision.experiment.settings import Experiment, RidgeShape
from vision.numeric import FWHM, Floats, Floats32, Ints

# --- ridges -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class RidgeAppearance:
    """Appearance of each ridge: width, height (fraction of saturation, negative if dark), shoulder side."""

    shape: RidgeShape
    fwhm_px: Floats
    height: Floats
    shoulder_side: Floats


def _ridge_appearance(experiment: Experiment) -> RidgeAppearance:
    """Draw the width, height and shoulder side of each ridge at random."""
    optics, count = experiment.optics, experiment.ridges_in_view
    rng = random_stream(experiment.seed, "looks")
    width = optics.fwhm_px * np.exp(optics.fwhm_spread * np.clip(rng.standard_normal(count), -2, 2))
    unequal = np.exp(optics.contrast_spread * np.clip(rng.standard_normal(count), -2, 2))
    shoulder = np.where(rng.uniform(size=count) < 0.5, -1.0, 1.0)
    # Height for Michelson contrast c and gaps of brightness b: bright 2 b c / (1 - c), dark -2 b c / (1 + c).
    sign = 1 if optics.polarity == "bright" else -1
    height = sign * 2 * optics.level * optics.contrast / (1 - sign * optics.contrast) * unequal
    height[rng.permutation(count)[: optics.faint_sheets]] *= 0.2
    return RidgeAppearance(shape=optics.shape, fwhm_px=width, height=height, shoulder_side=shoulder)


def _light_up_to(u: Floats, ridges: RidgeAppearance) -> Floats:
    """Return the light of each ridge from minus infinity to u px from its centre, in height x px.

    u: shape (..., sheet, cell).
    """
    fwhm, side = ridges.fwhm_px[:, None], ridges.shoulder_side[:, None]
    if ridges.shape == "flat":
        return np.asarray(_soft_box(u, fwhm) * ridges.height[:, None])
    sigma = fwhm / FWHM
    area = (sigma * np.sqrt(2 * np.pi)) * ridges.height[:, None]
    if ridges.shape == "gaussian":
        return np.asarray(area * scipy.special.ndtr(u / sigma))
    share, distance = 0.22, 0.85 * fwhm * side  # fraction of the light in the shoulder, and its distance
    main = scipy.special.ndtr((u + share * distance) / sigma)
    shoulder = scipy.special.ndtr((u - (1 - share) * distance) / (0.9 * sigma))
    return np.asarray(area * ((1 - share) * main + share * shoulder))


def _soft_box(u: Floats, fwhm: Floats) -> Floats:
    """Return the integral of a box of width `fwhm` with soft edges, a difference of two integrals of ndtr."""
    soft = fwhm / 10

    def double_integral(v: Floats) -> Floats:
        return np.asarray(v * scipy.special.ndtr(v) + np.exp(-(v**2) / 2) / np.sqrt(2 * np.pi))

    return np.asarray(
        soft * (double_integral((u + fwhm / 2) / soft) - double_integral((u - fwhm / 2) / soft))
    )


@dataclass(frozen=True, kw_only=True)
class Line:
    """Line of cells on which ridges are drawn; each is 1/per_px wide, the first starts at start_px."""

    start_px: float
    per_px: int
    cells: int


def _light_per_cell(positions_px: Floats, brightness: Floats, ridges: RidgeAppearance, line: Line) -> Floats:
    """Return the light of all ridges in each cell of a line, (frame, cell), in height x px.

    brightness (frame, sheet): factor on the heights. Ridges are cut off at the ends of the line.
    """
    frames, cells = len(positions_px), line.cells
    # Half the window in which a ridge is drawn; 5e-10 of the light of a Gaussian lies outside it.
    reach_px = float(2.6 * np.max(ridges.fwhm_px) + 2)
    half = int(np.ceil(reach_px * line.per_px))
    first = np.floor((positions_px - line.start_px) * line.per_px).astype(np.int64) - half
    edge = first[..., None] + np.arange(2 * half + 2)
    up_to = _light_up_to(edge / line.per_px + line.start_px - positions_px[..., None], ridges)
    light = np.diff(up_to, axis=-1) * brightness[..., None]
    cell = edge[..., :-1]
    outside = (cell < 0) | (cell >= cells)
    flat = cell + np.arange(frames)[:, None, None] * cells
    flat[outside] = frames * cells
    total = np.bincount(flat.ravel(), weights=light.ravel(), minlength=frames * cells + 1)
    return np.asarray(total[: frames * cells].reshape(frames, cells))


# --- the camera's clock -------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class FrameTimes:
    """Times of mid-exposure, one entry per frame in the file."""

    camera_s: Floats  # true time on the camera's clock
    stamp_s: Floats  # recorded time; stale stamps repeat the previous one
    machine_s: Floats  # force clock
    exposed: Ints  # number of the frame, counting lost ones
    lost: int


def frame_times(experiment: Experiment) -> FrameTimes:
    """Return the times of the frames that are not lost; the first frame is never lost."""
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
    """Convert times from the force clock to the camera's clock."""
    clocks = experiment.clocks
    return (np.asarray(machine_s) - clocks.offset_s) / (1 + clocks.drift_ppm * 1e-6)


# --- the scene ----------------------------------------------------------------------------------------------


def strip_slice(experiment: Experiment) -> slice:
    """Return the default strip: the middle `strip_rows` rows, or all rows of a smaller frame."""
    rows = min(experiment.camera.strip_rows, experiment.camera.height)
    first = (experiment.camera.height - rows) // 2
    return slice(first, first + rows)


@dataclass(frozen=True)
class Scene:
    """Everything derived from an experiment that images, strip profiles and truth share.

    It can be used from several threads once `response` and `texture` have been computed.
    """

    experiment: Experiment
    pull: Pull
    comb: RestingComb
    motion: SheetMotion
    ridges: RidgeAppearance
    times: FrameTimes

    # Positions

    def sway_px(self, frames: slice) -> Floats:
        """Return the shift of the picture in each frame: drift and vibration averaged over the exposure."""
        optics, camera = self.experiment.optics, self.experiment.camera
        t = self.times.machine_s[frames]
        rng = random_stream(self.experiment.seed, "sway")
        hz, phase, weight = rng.uniform(15, 60, 4), rng.uniform(0, 2 * np.pi, 5), rng.dirichlet(np.ones(4))
        waves = np.sin(2 * np.pi * hz * t[:, None] + phase[:4]) * np.sinc(hz * camera.exposure_s)
        share = (t - self.times.machine_s[0]) / camera.duration_s
        drift = optics.drift_px * (share - 0.5 + 0.2 * np.sin(2 * np.pi * share + phase[4]))
        return np.asarray(drift + optics.vibration_px * waves @ np.sqrt(2 * weight))

    def positions_px(self, frames: slice, *, parts: int = 1) -> Floats:
        """Return mean positions in each of `parts` equal parts of the exposure, (part, frame, sheet)."""
        exposure = self.experiment.camera.exposure_s * (1 + self.experiment.clocks.drift_ppm * 1e-6)
        t = self.times.machine_s[frames]
        edges = np.linspace(-exposure / 2, exposure / 2, parts + 1) if exposure else np.array([-5e-7, 5e-7])
        shift = (self.comb.rest_px + self.sway_px(frames)[:, None])[None]
        moved = [self.motion.mean_px(t + a, t + b) for a, b in pairwise(edges)]
        return shift + np.array(moved)

    def seen_px(self, frames: slice) -> Floats:
        """Return the true x in camera pixels, averaged over exposure and rows of the strip, (frame, sheet).

        Rows are weighted with their light.
        """
        rows, x_px = strip_slice(self.experiment), self.positions_px(frames)[0]
        zeta, weight = self.zeta_px[rows], self.row_light[rows]
        first, second = np.average(zeta, weights=weight), np.average(zeta**2, weights=weight)
        return np.asarray(x_px + self.shift_px(x_px, np.asarray(first), np.asarray(second)))

    # The map from sheet coordinates to pixels

    @property
    def tilt(self) -> float:
        """Columns by which a ridge shifts from row to row."""
        return float(np.tan(np.radians(self.experiment.optics.tilt_deg)))

    @property
    def zeta_px(self) -> Floats:
        """ζ of every row."""
        height = self.experiment.camera.height
        return np.arange(height, dtype=float) - (height - 1) / 2

    def shift_px(self, x_px: Floats, zeta_px: Floats, zeta2_px2: Floats | None = None) -> Floats:
        """Return s(x, z) in px, a polynomial in ζ: means of ζ and ζ² over rows give the mean shift."""
        camera, axis_px = self.experiment.camera, self.comb.axis_px
        half_comb_px = float(np.max(np.abs(self.comb.rest_px - axis_px))) or 1.0
        z2 = zeta_px**2 if zeta2_px2 is None else zeta2_px2
        out = np.clip((x_px - axis_px) / half_comb_px, -1.5, 1.5)
        bowed = -self.experiment.sheets.bow_px * out * np.abs(out) * z2 / (camera.height / 2) ** 2
        off = x_px - (camera.width - 1) / 2
        corner2 = (camera.width / 2) ** 2 + (camera.height / 2) ** 2
        lens = self.experiment.optics.distortion * off * (off**2 + z2) / corner2
        return np.asarray(self.tilt * zeta_px + bowed + lens)

    def source_px(self, x_px: Floats, zeta_px: Floats) -> Floats:
        """Return the inverse: the x that appears at pixel coordinate x_px of a row."""
        source = np.broadcast_to(x_px, np.broadcast_shapes(x_px.shape, zeta_px.shape)).astype(float)
        for _ in range(12):  # each step reduces the error to a few per cent or less
            source = x_px - self.shift_px(source, zeta_px)
        return source

    # Light

    @property
    def row_light(self) -> Floats:
        """Relative light of every row; its gradient is half that along x."""
        camera, gradient = self.experiment.camera, self.experiment.optics.gradient
        return 1 + gradient / 2 * self.zeta_px / camera.height

    def flicker(self, frames: slice) -> Floats:
        """Return the brightness factor of each frame: the flicker averaged over the exposure."""
        optics, camera = self.experiment.optics, self.experiment.camera
        t = self.times.machine_s[frames]
        wave = np.sin(2 * np.pi * optics.flicker_Hz * t) * np.sinc(optics.flicker_Hz * camera.exposure_s)
        return np.asarray(1 + optics.flicker * wave)

    @cached_property
    def line(self) -> Line:
        """Line of cells, wider than the frame by the largest shift due to tilt, bow and distortion."""
        camera, tilt = self.experiment.camera, self.tilt
        bow_px, distortion = self.experiment.sheets.bow_px, self.experiment.optics.distortion
        if not (tilt or bow_px or distortion):  # all rows show the same positions
            return Line(start_px=-0.5, per_px=1, cells=camera.width)
        largest_shift = abs(tilt) * camera.height / 2 + 2.25 * abs(bow_px) + abs(distortion) * camera.width
        margin, per_px = int(np.ceil(largest_shift)) + 3, 8
        return Line(start_px=-0.5 - margin, per_px=per_px, cells=(camera.width + 2 * margin) * per_px)

    @cached_property
    def base(self) -> Floats:
        """Light in each cell without ridges: the level of the gaps, and of the surroundings."""
        optics, comb, line = self.experiment.optics, self.comb, self.line
        margin = 1.5 * self.experiment.sheets.pitch_px
        left, right = comb.rest_px.min() - margin, comb.rest_px.max() + margin
        if self.experiment.sheets.side != "both":  # the sample continues beyond the axis
            left, right = (-1e6, right) if self.experiment.sheets.side == "right" else (left, 1e6)
        x = line.start_px + (np.arange(line.cells) + 0.5) / line.per_px
        soft_px = 4.0
        sample = scipy.special.ndtr((x - left) / soft_px) - scipy.special.ndtr((x - right) / soft_px)
        return np.asarray(optics.level * (optics.surround + (1 - optics.surround) * sample) / line.per_px)

    def ridge_light(self, frames: slice, brightness: Floats | None = None) -> Floats:
        """Return the light of the ridges in each cell, (frame, cell), with motion blur.

        brightness: factor (frame, sheet) on each ridge's height.
        """
        halves = self.positions_px(frames, parts=2)
        factor = np.ones(halves.shape[1:]) if brightness is None else brightness
        light = _light_per_cell(halves.mean(axis=0), factor, self.ridges, self.line)
        # Motion of 0.3 px within an exposure changes a ridge's width by less than 0.1 % and is not drawn.
        moving = np.flatnonzero(np.abs(np.diff(halves, axis=0)[0]).max(axis=1) > 0.15)
        if moving.size:
            parts = self.positions_px(frames, parts=24)[:, moving]
            blurred = [_light_per_cell(part, factor[moving], self.ridges, self.line) for part in parts]
            light[moving] = np.mean(blurred, axis=0)
        return light

    # Paper, dust and pixels

    @cached_property
    def _pattern(self) -> Floats:
        """Relative brightness along each sheet, (row, sheet), long enough for the whole video."""
        e = self.experiment
        travel = int(np.ceil(self._travel_px(slice(None)).max())) + 2
        noise = random_stream(e.seed, "texture").standard_normal((e.camera.height + travel, e.ridges_in_view))
        sigma = e.optics.texture_px / 2.355  # FWHM, rounded as in the stored fixtures
        smooth = scipy.ndimage.gaussian_filter1d(noise, sigma, axis=0, mode="wrap")
        smooth /= smooth.std() or 1.0
        return np.asarray(e.optics.texture * np.clip(smooth, -3, 3))

    def _travel_px(self, frames: slice) -> Floats:
        """Return how far the pulled block has moved along z since the first frame."""
        d = self.pull.separation_mm(self.times.machine_s)
        return np.asarray((d - d[0])[frames] * 1000 / self.experiment.camera.pixel_size_um)

    def texture(self, frames: slice) -> Floats:
        """Return the relative brightness of each ridge along z, (frame, row, sheet), with mean zero.

        Every second sheet belongs to the block that the machine pulls along z, so its texture moves.
        """
        rows = np.arange(self.experiment.camera.height)
        travel = self._travel_px(frames)
        whole = np.floor(travel).astype(np.int64)
        share = (travel - whole)[:, None, None]
        pulled, at = self._pattern[:, 0::2], whole[:, None] + rows
        texture = np.empty((len(travel), len(rows), self._pattern.shape[1]))
        texture[:, :, 0::2] = (1 - share) * pulled[at] + share * pulled[at + 1]
        texture[:, :, 1::2] = self._pattern[None, : len(rows), 1::2]
        return texture

    @cached_property
    def response(self) -> Floats32:
        """Product of light gradient, dust and pixel response, (row, column), 1 on average."""
        e = self.experiment
        x = np.arange(e.camera.width, dtype=float) - (e.camera.width - 1) / 2
        light = self.row_light[:, None] * (1 + e.optics.gradient * x / e.camera.width)
        light *= 1 + e.camera.prnu * random_stream(e.seed, "prnu").standard_normal(light.shape)
        return np.asarray(light * _dust(e), np.float32)


def _dust(e: Experiment) -> Floats:
    """Return the transmission of dust on the lens: round, dark, stationary spots."""
    rng = random_stream(e.seed, "dust")
    x, z = rng.uniform(0, e.camera.width, e.optics.dust), rng.uniform(0, e.camera.height, e.optics.dust)
    size = rng.uniform(1.5, 5, e.optics.dust)
    across = np.exp(-((np.arange(e.camera.width) - x[:, None]) ** 2) / (2 * size[:, None] ** 2))
    along = np.exp(-((np.arange(e.camera.height) - z[:, None]) ** 2) / (2 * size[:, None] ** 2))
    return np.asarray(1 - np.minimum(0.25 * along.T @ across, 0.9))


def make_scene(experiment: Experiment) -> Scene:
    """Compute the pull, the sheets' motion, their appearance and the frame times of an experiment."""
    comb = comb_at_rest(experiment)
    pull: Pull
    motion: SheetMotion
    if experiment.mechanics.model == "sheets":
        pull, motion = resolved_test(experiment, comb)
    else:
        pull = simulate_pull(experiment.mechanics, seed=experiment.seed, sample=experiment.sample)
        motion = sheet_motion(experiment, pull, comb)
    return Scene(
        experiment=experiment,
        pull=pull,
        comb=comb,
        motion=motion,
        ridges=_ridge_appearance(experiment),
        times=frame_times(experiment),
    )


# --- truth.nc -----------------------------------------------------------------------------------------------

_MEANING = {
    "x_px": (
        "px",
        "true position: mean over the exposure and over the default strip's rows, centroid of the ridge",
    ),
    "visible": ("1", "1 where the ridge lies completely inside the frame"),
    "time_s": ("s", "camera clock at mid-exposure"),
    "stamp_s": ("s", "time stamp written by the camera; stale stamps repeat the previous one"),
    "time_force_s": ("s", "force clock at mid-exposure"),
    "exposed": ("1", "number of the frame, counting lost frames"),
    "d_mm": ("mm", "separation at mid-exposure"),
    "t_v_video_s": ("s", "start of the stick phase on the camera clock"),
    "t_p_video_s": ("s", "end of the stick phase on the camera clock"),
    "slip_s": ("s", "start of every slip on the force clock; slip 0 ends the initial loading"),
    "slip_video_s": ("s", "start of every slip on the camera clock"),
    "slip_delay_s": ("s", "delay of each sheet's jump after the slip"),
    "sigma_x_um": ("um", "RMS displacement over the stick phase"),
    "sweep_um": ("um", "inward motion over the stick phase"),
    "ratio": ("1", "sigma_x over the stick length"),
    "shell": ("1", "1 where the ratio is below the stiff threshold"),
    "fwhm_px": ("px", "full width of each ridge at half height"),
    "height": ("1", "height of each ridge over the gaps, in units of saturation"),
}


def truth_of(scene: Scene) -> xr.Dataset:
    """Return the truth of a synthetic test, the content of truth.nc.

    Its dimensions are frame, sheet, event and slip. Events have the columns of `events.csv` (force clock) and
    M_eff, without the initial loading. Attributes: every setting as JSON, the rows of the default strip, the
    clocks, the axis.
    """
    comb, ridges, e, rows = scene.comb, scene.ridges, scene.experiment, strip_slice(scene.experiment)
    sheets = {"side": comb.side, "n": comb.n, "fwhm_px": ridges.fwhm_px, "height": ridges.height}
    data = _frames(scene) | _events(scene) | {name: ("sheet", one) for name, one in sheets.items()}
    dataset = xr.Dataset(data, coords={"sheet": np.arange(len(scene.comb.n))})
    for name, (units, meaning) in _MEANING.items():
        dataset[name].attrs |= {"units": units, "long_name": meaning}
    dataset["shell"].attrs |= {"flag_values": np.array([0, 1], np.int8), "flag_meanings": "mobile stiff"}
    dataset.attrs |= {
        "settings": json.dumps(asdict(e)),
        "seed": e.seed,
        "strip_z0": rows.start,
        "strip_z1": rows.stop,
        "axis_px": comb.axis_px,
        "offset_s": e.clocks.offset_s,
        "drift_ppm": e.clocks.drift_ppm,
        "pixel_size_um": e.camera.pixel_size_um,
        "fps": e.camera.fps,
        "frames_lost": scene.times.lost,
        "first_slip_s": float(scene.pull.end_s[0]),
        "positions": "pixel centres at integers",
    }
    return dataset


def _frames(scene: Scene) -> dict[str, Any]:
    """Return positions and times of every frame."""
    times = scene.times
    x = scene.seen_px(slice(None))
    reach = scene.ridges.fwhm_px
    inside = (x > reach - 0.5) & (x < scene.experiment.camera.width - 0.5 - reach)
    return {
        "x_px": (("frame", "sheet"), x),
        "visible": (("frame", "sheet"), inside.astype(np.int8)),
        "time_s": ("frame", times.camera_s),
        "stamp_s": ("frame", times.stamp_s),
        "time_force_s": ("frame", times.machine_s),
        "exposed": ("frame", times.exposed),
        "d_mm": ("frame", scene.pull.separation_mm(times.machine_s)),
    }


def _events(scene: Scene) -> dict[str, Any]:
    """Return events and slips on both clocks, and the deformation of every sheet."""
    pull, e = scene.pull, scene.experiment
    events = pull.events()
    keep = np.flatnonzero(pull.complete)[1:]
    ratio = scene.motion.ratio[keep]
    sweep = scene.motion.sweep_px[keep] * e.camera.pixel_size_um
    slips = np.flatnonzero(pull.complete)
    following = np.minimum(slips + 1, len(pull.start_s) - 1)
    both = ("event", "sheet")
    table = {str(name): ("event", events[name].to_numpy()) for name in events.columns}
    return table | {
        "t_v_video_s": ("event", camera_time(events["t_v_s"].to_numpy(), e)),
        "t_p_video_s": ("event", camera_time(events["t_p_s"].to_numpy(), e)),
        "slip_s": ("slip", pull.slip_s),
        "slip_video_s": ("slip", camera_time(pull.slip_s, e)),
        "slip_delay_s": (("slip", "sheet"), scene.motion.delay_s[following]),
        "sigma_x_um": (both, ratio * events["stick_length_um"].to_numpy()[:, np.newaxis]),
        "sweep_um": (both, sweep),
        "ratio": (both, ratio),
        "shell": (both, (ratio < e.sheets.stiff_ratio).astype(np.int8)),
    }
