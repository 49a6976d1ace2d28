"""Horizontal deformation: σ_x and σ_x/Λ_st from x(n, t) and the stick phases."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from vision.clock import Clock
from vision.data import (
    MOTION,
    NOT_SUBTRACTED,
    STICKS,
    TRACKS,
    MotionMetadata,
    StripMetadata,
    TrackMetadata,
    changed_settings,
    check_pixel_size,
    has_flag,
    record,
)
from vision.deformation.common_mode import (
    BothSides,
    Drift,
    OneSide,
    camera_bends,
    common_mode_motion,
    drift_model,
    own_movement,
    repeated_bends,
)
from vision.deformation.creep import (
    Creep,
    DeformationSettings,
    LateSlips,
    Noise,
    StickFrames,
    coefficient_errors,
    find_late_slips,
    fit_creep,
    frames_of_sticks,
    legendre,
    measure_noise,
)
from vision.errors import InputError, shown
from vision.numeric import Bools, Floats, Ints, nan_median, sigma_about_zero
from vision.video.reader import BETWEEN_FRAMES

ENDS = ("t_v_s", "t_p_s", "d_v_mm", "d_p_mm")  # of a stick, as far as they are known


def horizontal_deformation(
    tracks: xr.Dataset,
    sticks: pd.DataFrame,
    clock: Clock,
    *,
    pixel_size_um: float | None,
    margin_s: float | None = None,
    common_mode: bool = True,
    settings: DeformationSettings = DeformationSettings(),
) -> xr.Dataset:
    r"""Measure the horizontal deformation of every sheet in every stick phase inside the video.

    Parameters
    ----------
    tracks
        From `track_sheets`: x_px (frame, sheet) with time_s, side and n. Positions from other sources work,
        too; without ``attrs["fit"]`` the errors do not include those of pixels.
    sticks
        From `find_stick_slip`: t_v_s, t_p_s, stick_length_um and, if known, stick_length_err_um.
    clock
        From `synchronise`.
    pixel_size_um
        µm per pixel; required.
    margin_s
        Time left out next to each slip; by default half a frame interval (the exposure) plus the error of the
        clock.
    common_mode
        Whether to subtract camera movement.
    settings
        See `DeformationSettings`.

    Returns
    -------
    Dataset (event, sheet), as declared in `vision.data.MOTION`. ``flag`` is "ok", or

    - "few": fewer than 4 usable frames, or they span less than two fifths of the stick; all values are NaN;
    - "no_length": Λ_st is not known; the ratio is NaN;
    - "outward": the sheet moves outwards by more than 3 errors; the size of the movement is reported;
    - "uneven": the residuals exceed the noise of the sheet (it slipped by itself); the error is increased;
    - "below_noise": the measurement is negative and reported as 0; ``ratio_signed`` contains it.

    Raises
    ------
    InputError
        If there is no pixel size, no time of a frame, no stick length, or no stick phase inside the video, or
        if the clock is ambiguous.

    Notes
    -----
    With :math:`\delta x = x - \hat x` and :math:`\hat x` the mean over the stick,

    .. math:: \sigma_x = \sqrt{\langle \delta x^2 \rangle},

    so that a linear sweep S gives :math:`S / \sqrt{12}`. ``sigma_x_um`` is this value over the usable frames,
    including noise and vibration. ``sigma_x_corrected_um`` is

    .. math:: \sqrt{a_1^2 / 3 + a_2^2 / 5}

    with the creep :math:`\hat x + a_1 P_1(u) + a_2 P_2(u)` fitted to the usable frames (Legendre polynomials,
    u from −1 at the valley to +1 at the peak). The term :math:`a_2^2`, minus its noise, is used only where
    :math:`a_2` exceeds 3 errors. For many frames the result equals :math:`\sqrt{\sigma^2 -
    \mathrm{noise}^2}`; for few frames it has less bias, since it keeps the sign.

    Camera movement consists of vibration, the common motion in each frame beyond the creep, and of drift
    during the stick, which is found from left and right, or, with one side in view, from the creep of the
    sheets in other sticks (``attrs["camera_movement"]``). The creep of a sheet that slips late or early is
    shortened accordingly.

    Errors follow from the residuals of each sheet and their autocorrelation. They include unequal pixels,
    unequal magnification and static dirt, with the publication's fit its shift towards whole pixels, and what
    a sheet does by itself in every stick: steady movement that slips do not return, and bends that other
    sheets do not show. They exclude that of the pixel size. Of films whose codec predicts frames from others
    (H.264), the noise is at least the stated error of the positions. An error of the ends of a stick changes
    σ_x and Λ_st by the same factor; that of their ratio contains only the part from an unsteady pull or
    creep, and from sheets that slip in turn (``clock.slip_spread_ms``).

    Source: paper, horizontal deformation by image processing.
    """
    TRACKS.check(tracks, needs=("x_px", "time_s", "side", "n"))
    STICKS.check(sticks, needs=("event", "t_v_s", "t_p_s", "stick_length_um"))
    if not hasattr(clock, "to_force_s"):
        raise InputError("`clock`", "what `vision.synchronise` returns", shown(clock))
    source = StripMetadata.of(tracks).source
    pixel = _pixel_size(pixel_size_um)
    if clock.status == "ambiguous":
        why = clock.ambiguity or "several alignments"
        raise InputError(source, "clocks that are not ambiguous", why, "give `offset_s`")
    time = np.asarray(clock.to_force_s(np.asarray(tracks["time_s"].values, float)), float)
    interval = _interval(time, source)
    events = _inside(sticks, time, interval, source)
    events, after_s, before_s = _uninterrupted(events, clock, settings, source)
    margin = interval / 2 + _clock_error_s(clock, interval) if margin_s is None else margin_s
    start, stop = (events[name].to_numpy(float) for name in ("t_v_s", "t_p_s"))
    every = frames_of_sticks(time, start, stop, margin_s=0.0, interval_s=interval)
    frames = frames_of_sticks(time, start, stop, margin_s=margin, interval_s=interval)
    first, last = _between_slips(clock, start + after_s, stop - before_s)
    at = time[frames.frame]
    frames = frames.only((at > first[frames.row] + interval) & (at < last[frames.row] - interval))
    late_s = 1e-3 * float(np.nan_to_num(clock.slip_spread_ms)) / 2
    motion, found = _measure(tracks, events, frames, pixel, common_mode, late_s, settings)
    found["warnings"] += _too_short(motion, every)
    motion["frames_left_out"] = "event", every.counts - frames.counts, MOTION["frames_left_out"].attrs
    facts = MotionMetadata(source=source, pixel_size_um=pixel, margin_s=margin, interval_s=interval, **found)
    return record(
        motion.assign_attrs(facts.attrs()),
        "horizontal_deformation",
        pixel_size_um=pixel,
        margin_s=margin,
        common_mode=common_mode,
        settings=changed_settings(settings),
    )


# --- input --------------------------------------------------------------------------------------------------


def _pixel_size(size_um: float | None) -> float:
    """Return the pixel size; raise InputError if it is missing or not plausible."""
    if size_um is None or size_um != size_um:  # NaN
        raise InputError("`pixel_size_um`", "µm per pixel, without which there is no σ_x/Λ_st", "none")
    check_pixel_size(size_um)
    return float(size_um)


def _interval(time_s: Floats, source: str) -> float:
    """Median time between frames, s."""
    step = np.diff(time_s[np.isfinite(time_s)])
    if not (step > 0).any():
        found = "no increasing frame times"
        raise InputError(source, "the times of the frames", found, "give `fps` or `timestamps`")
    return float(np.median(step[step > 0]))


def _clock_error_s(clock: Clock, interval_s: float) -> float:
    """Error of a mapped time, s: two standard errors, or, where these are unknown, the residuals beyond those
    that the frame interval explains (a quarter of it)."""
    if np.isfinite(clock.error_ms):
        return 2 * float(clock.error_ms) / 1000
    residual_s = float(np.nan_to_num(clock.residual_ms)) / 1000
    return float(np.sqrt(max(residual_s**2 - (interval_s / 4) ** 2, 0.0)))


def _inside(sticks: pd.DataFrame, time_s: Floats, interval_s: float, source: str) -> pd.DataFrame:
    """Stick phases that lie wholly inside the video, in order of time."""
    first, last = np.nanmin(time_s), np.nanmax(time_s)
    start, stop = sticks["t_v_s"], sticks["t_p_s"]
    within = (start >= first - interval_s) & (stop <= last + interval_s) & (stop > start)
    if not within.any():
        span = f"{start.min():.3f} to {stop.max():.3f} s" if len(sticks) else "no stick phase at all"
        wanted = f"stick phases between {first:.3f} and {last:.3f} s of the force clock, when the video ran"
        raise InputError(source, wanted, span, "check `force` and `offset_s`")
    if not np.isfinite(sticks.loc[within, "stick_length_um"].to_numpy(float)).any():
        found = "no displacement in the force recording"
        raise InputError(source, "stick lengths", found, "give `speed_mm_min`")
    return sticks[within].sort_values("t_v_s")


def _uninterrupted(
    events: pd.DataFrame, clock: Clock, settings: DeformationSettings, source: str
) -> tuple[pd.DataFrame, Floats, Floats]:
    """Stick phases without those that contain a slip of the film that the force lacks, of which the clock
    warns, or in which the machine paused (flag "still"), of which `find_stick_slip` warns.

    A slip near either end of a stick is the one between two sticks, timed differently, unless the film shows
    that one as well. The lengths of these ends, s, (stick,), are returned with the stick phases.
    """
    start, stop = (events[name].to_numpy(float) for name in ("t_v_s", "t_p_s"))
    near_s = settings.slip_near_end * (stop - start)
    after_s, before_s = (
        np.where(
            _any_between(clock.matched_s, end - near_s, end + near_s),
            np.minimum(settings.slip_delay_s, near_s),
            near_s,
        )
        for end in (start, stop)
    )
    whole = ~_any_between(clock.only_video_s, start + after_s, stop - before_s)
    rests = has_flag(events["flag"], "still") if "flag" in events else np.zeros_like(whole)
    if not (whole & ~rests).any():
        found = "rests of the machine" if (whole & rests).any() else "slips of the film"
        found += " within all of them"
        raise InputError(source, "stick phases in which the sheets do not slip", found, "check `offset_s`")
    measured = whole & ~rests
    return events.loc[measured], after_s[measured], before_s[measured]


def _between_slips(clock: Clock, after_s: Floats, before_s: Floats) -> tuple[Floats, Floats]:
    """Times of the film's last slip up to `after_s` that the force lacks, and of the first from `before_s`
    on, s, of each stick; infinite without one. Frames beyond them belong to another stick."""
    times = np.sort(clock.only_video_s)
    first = np.r_[-np.inf, times][np.searchsorted(times, after_s, side="right")]
    last = np.r_[times, np.inf][np.searchsorted(times, before_s)]
    return first, last


def _any_between(times_s: Sequence[float], after_s: Floats, before_s: Floats) -> Bools:
    """Whether any of the times is after the one and before the other, of each stick."""
    times = np.sort(times_s)
    return np.asarray(np.searchsorted(times, before_s) > np.searchsorted(times, after_s, side="right"))


# --- measurement --------------------------------------------------------------------------------------------


def _measure(
    tracks: xr.Dataset,
    events: pd.DataFrame,
    frames: StickFrames,
    pixel_um: float,
    common_mode: bool,
    late_s: float,
    settings: DeformationSettings,
) -> tuple[xr.Dataset, dict[str, Any]]:
    """Measure the deformation in the usable frames; also return fields of `MotionMetadata`.

    late_s: mean time by which the sheets may slip after the fall of the force.
    """
    x_px, side = np.asarray(tracks["x_px"].values, float)[frames.frame], tracks["side"].values
    terms = 4 if np.median(frames.counts) >= settings.cubic_frames else 3
    steady, rms_px, facts = x_px, _rms(x_px, frames), TrackMetadata.of(tracks)
    del x_px  # tables of positions are large in long films
    vibration, factor = np.zeros(len(steady)), np.ones(side.size)
    bends_err_px = np.zeros(frames.sticks)
    if common_mode and len(steady):
        creep = fit_creep(steady, frames, terms, settings)
        residual = creep.at(frames)
        np.subtract(steady, residual, out=residual)
        vibration, factor = common_mode_motion(residual, settings)
        del residual
        bends, bends_err = camera_bends(creep, side, settings)
        bends_err_px = np.sqrt((bends_err**2).sum(axis=1))
        moved = vibration + (legendre(frames.u, terms)[:, 2:] * bends[frames.row]).sum(axis=1)
        steady = steady - moved[:, None]
    slips = find_late_slips(steady, frames, settings)
    steady = np.where(slips.outside, np.nan, steady)
    noise = measure_noise(steady, frames, terms, settings)
    line, parabola, close = (fit_creep(steady, frames, k, settings, noise.correlation) for k in (2, 3, terms))
    noise = replace(noise, noise_px=noise.noise_px * np.sqrt(factor))
    noise, warnings = _with_noise_of_codec(noise, tracks, settings)
    of_picture = (*_errors_of_picture(noise, tracks, settings), facts.window_px)
    errors = [coefficient_errors(part, noise, *of_picture) for part in (line, parabola)]
    camera = drift_model(line, side, tracks["n"].values, frames, vibration, settings) if common_mode else None
    # The share of independent frames is the ratio of the sweep's variances for white and correlated noise.
    white = fit_creep(steady, frames, 2, settings)
    independent = nan_median(white.inverse[..., 1, 1] / line.inverse[..., 1, 1], axis=1)
    curve = _Curve.of(line, parabola, errors, camera, settings).shortened(slips)
    own_px = own_movement(curve.middle, curve.straight, frames, settings)
    bends_px = repeated_bends(close, noise, settings)
    warnings += _own_warnings(own_px, bends_px, curve.slope_err, settings)
    own_bend_px = np.abs(curve.slope) * curve.end_slope[:, None] / 3  # which a hidden sheet does not show
    hidden_px = settings.bend_as_slope * np.hypot(bends_err_px[:, None], own_bend_px) * line.hidden(settings)
    curve = replace(curve, slope_err=np.sqrt(curve.slope_err**2 + own_px**2 + bends_px**2 + hidden_px**2))
    resting = np.fmax(late_s / frames.length_s - np.median(slips.lost, axis=1), 0.0)
    values = {
        "sigma_x_um": np.where(line.good, rms_px, np.nan) * pixel_um,
        **_relative_to_length(curve, line, noise.excess > 1, events, side, pixel_um, resting, settings),
        "sweep_um": -2 * side * curve.straight * pixel_um,
        "frames": line.count,
        "x_hat_px": curve.middle,
        "effective_frames": frames.counts * np.where(np.isfinite(independent), independent, 1),
        "drift_um": 2 * curve.drift * pixel_um,
        "drift_err_um": 2 * curve.drift_err * pixel_um,
        "noise_um": noise.noise_px * pixel_um,
    }
    coords = {name: events[name].to_numpy(float) for name in ENDS if name in events}
    coords |= {name: tracks[name].values for name in ("side", "n")}
    index = {"event": events["event"].to_numpy(), "sheet": tracks["sheet"].values}
    motion = xr.Dataset(MOTION.declared(values | coords), index).set_coords(list(coords))
    return motion, {
        "noise_share": noise.correlation.share,
        "noise_rho": noise.correlation.rho,
        "camera_movement": camera.movement if camera else NOT_SUBTRACTED,
        "warnings": warnings,
    }


def _relative_to_length(
    curve: _Curve,
    line: Creep,
    uneven: Bools,
    events: pd.DataFrame,
    side: Ints,
    pixel_um: float,
    resting: Floats,
    settings: DeformationSettings,
) -> dict[str, Any]:
    """The size of the creep in µm and relative to Λ_st, errors and flags, by their names in `MOTION`. A
    negative size that is not significant becomes 0."""
    length = events["stick_length_um"].to_numpy(float)[:, None]
    length = np.where(length > 0, length, np.nan)
    sigma_length_err, length_err = _length_errors(events, curve.end_slope, resting, settings)
    signed = -side * np.sign(curve.slope) * np.sqrt(curve.mean_square) * pixel_um  # positive inwards
    error = curve.rms_err * pixel_um
    outward = signed < -settings.outward_errors * error
    size = np.where(outward, -signed, np.maximum(signed, 0))
    flags = {
        "few": ~line.good,
        "no_length": np.broadcast_to(np.isnan(length), line.good.shape),
        "outward": outward,
        "uneven": uneven,
        "below_noise": signed < 0,
    }
    return {
        "sigma_x_corrected_um": size,
        "sigma_x_err_um": np.hypot(error, size * sigma_length_err[:, None]),
        "ratio": size / length,
        "ratio_err": np.hypot(error / length, size / length * length_err[:, None]),
        "ratio_signed": signed / length,
        "flag": np.select(list(flags.values()), list(flags), default="ok"),
        "stick_length_um": length[:, 0],
        "length_err": length_err,
    }


def _with_noise_of_codec(
    noise: Noise, tracks: xr.Dataset, settings: DeformationSettings
) -> tuple[Noise, list[str]]:
    """Noise of at least the stated error of positions, for codecs that predict frames from others. Such a
    codec repeats a sheet that creeps by less than its rounding, so that its residuals are near zero while it
    is wrong by up to its movement. Also return a warning if many sheets are held still."""
    if StripMetadata.of(tracks).codec not in BETWEEN_FRAMES or "x_err_px" not in tracks:
        return noise, []
    second_px = TrackMetadata.of(tracks).second_comb_err_px
    error_px = np.sqrt(np.fmax(nan_median(tracks["x_err_px"].values) ** 2 - second_px**2, 0.0))
    held = noise.noise_px < settings.held_noise * error_px
    raised = replace(noise, noise_px=np.fmax(noise.noise_px, error_px))
    if not held.any() or held.sum() < settings.warned_sheets * held.size:
        return raised, []
    what = f"the film's compression holds {held.sum()} of {held.size} sheets still between slips"
    bias = "their σ_x/Λ_st are too small by about their errors, alike in all sticks"
    return raised, [f"{what}: {bias}: record raw, FFV1 or MJPEG"]


def _errors_of_picture(
    noise: Noise, tracks: xr.Dataset, settings: DeformationSettings
) -> tuple[Floats, Floats]:
    """Error by unequal pixels, px, and relative error of displacements, of each sheet, (sheet,)."""
    fit, sheets = TrackMetadata.of(tracks).fit, noise.noise_px.size
    pattern = scale = np.zeros(sheets)
    if fit != "unknown":  # measured in a picture
        pattern = settings.fixed_pattern * noise.noise_px
        locking = settings.locking if fit == "paper" else 0.0
        scale = np.full(sheets, np.hypot(settings.scale_error, locking))
    return pattern, np.hypot(scale, tracks["misscaled"].values) if "misscaled" in tracks else scale


def _own_warnings(
    own_px: Floats, bends_px: Floats, error_px: Floats, settings: DeformationSettings
) -> list[str]:
    """Warnings of movement that is no creep, beyond the other errors, in many of the sheets."""
    causes = {
        "move steadily, though slips return the others (paper that settles, a block that slides):"
        " let the sample rest before the test": nan_median(own_px),
        "bend alike in every stick, as sheets do that slip in turn: see the slips in the space-time diagram,"
        " and check the clocks": bends_px,
    }
    usual = nan_median(error_px)
    lines = []
    for cause, size_px in causes.items():
        found = int((size_px > usual).sum())
        if found >= settings.warned_sheets * size_px.size:
            lines.append(f"{found} of {size_px.size} sheets {cause}; the error of σ_x/Λ_st contains it")
    return lines


def _too_short(motion: xr.Dataset, frames: StickFrames) -> list[str]:
    """Warning if most stick phases have too few frames for any sheet; shorter ones among longer are usual."""
    short = (motion["flag"] == "few").all("sheet").values
    if short.sum() <= short.size / 2:
        return []
    return [
        f"{short.sum()} of {short.size} stick phases are too short for σ_x/Λ_st, with"
        f" {np.median(frames.counts):.0f} frames in the median (4 are needed, without those beside a slip):"
        " film more frames/s, or pull more slowly"
    ]


def _rms(x_px: Floats, frames: StickFrames) -> Floats:
    """RMS of x minus its mean over the frames of each stick, px, (stick, sheet); NaN without frames."""
    known = np.isfinite(x_px)
    count = frames.sums(known)
    count[count == 0] = np.nan
    displacement = np.where(known, x_px, 0.0)
    displacement -= (frames.sums(displacement) / count)[frames.row]
    displacement[~known] = 0.0
    return np.sqrt(frames.sums(np.square(displacement, out=displacement)) / count)


@dataclass(frozen=True)
class _Curve:
    """Creep without drift, x = middle + slope P1(u) + bend P2(u), px, (stick, sheet). It is a parabola where
    that differs significantly from a line, else a line."""

    middle: Floats
    slope: Floats
    slope_err: Floats
    bend: Floats  # 0 for a line
    bend_err: Floats
    straight: Floats  # slope of the line, also where a parabola is used
    drift: Floats  # (stick,)
    drift_err: Floats  # (stick,)

    @classmethod
    def of(
        cls,
        line: Creep,
        parabola: Creep,
        errors: Sequence[Floats],
        camera: BothSides | OneSide | None,
        settings: DeformationSettings,
    ) -> _Curve:
        """Choose line or parabola for each sheet and stick, and subtract the drift of the camera.
        errors: standard errors of the coefficients of the line and of the parabola."""
        line_err, parabola_err = errors
        bend, bend_err, _ = _without_drift(
            camera, parabola.coefficient[..., 2], parabola_err[..., 2], slow=False
        )
        curved = np.abs(bend) > settings.curvature_errors * bend_err
        curved &= parabola.count >= settings.least_curved
        best = np.where(curved[..., None], parabola.coefficient[..., :2], line.coefficient)
        best_err = np.where(curved, parabola_err[..., 1], line_err[..., 1])
        slope, slope_err, _ = _without_drift(camera, best[..., 1], best_err)
        straight, _, drift = _without_drift(camera, line.coefficient[..., 1], line_err[..., 1])
        bend = np.where(curved, bend, 0.0)
        return cls(best[..., 0], slope, slope_err, bend, bend_err, straight, drift.value, drift.error)

    def shortened(self, slips: LateSlips) -> _Curve:
        """The curve scaled to the part of the stick in which each sheet creeps."""
        creeping = 1 - slips.lost
        return replace(
            self,
            slope=self.slope * creeping,
            slope_err=np.hypot(self.slope_err, self.slope * slips.lost_err),
            bend=self.bend * creeping,
            straight=self.straight * creeping,
        )

    @property
    def mean_square(self) -> Floats:
        """Mean square displacement over the whole stick, px²."""
        bent = np.where(self.bend == 0, 0.0, np.maximum(self.bend**2 - self.bend_err**2, 0.0))
        return np.asarray(self.slope**2 / 3 + bent / 5, np.float64)

    @property
    def end_slope(self) -> Floats:
        """Relative difference of the speed at the ends of a stick from its mean, of all sheets, (stick,)."""
        square = np.nansum(self.slope**2, axis=1)
        bent = np.abs(np.nansum(self.slope * self.bend, axis=1))
        return np.asarray(3 * bent / np.where(square > 0, square, 1.0))

    @property
    def rms_err(self) -> Floats:
        """Standard error of the root of the mean square, to first order, px."""
        spread = np.hypot(self.slope / 3 * self.slope_err, self.bend / 5 * self.bend_err)
        with np.errstate(divide="ignore", invalid="ignore"):
            curved = spread / np.sqrt(self.mean_square)
        return np.where(self.bend == 0, self.slope_err / np.sqrt(3), curved)


def _without_drift(
    camera: BothSides | OneSide | None, value: Floats, error: Floats, *, slow: bool = True
) -> tuple[Floats, Floats, Drift]:
    """Coefficient minus the camera's drift, its error including that of the drift, and the drift."""
    if camera is None:
        none = np.zeros(len(value))
        return value, error, Drift(none, none, np.zeros_like(value))
    drift = camera.drift(value, error, slow=slow)
    # Each sheet contributes to the drift that is taken from it.
    left_over = np.sqrt(error**2 * (1 - drift.share) + drift.error[:, None] ** 2)
    return value - drift.value[:, None], left_over, drift


# --- errors of the stick length -----------------------------------------------------------------------------


def _length_errors(
    events: pd.DataFrame, end_slope: Floats, resting: Floats, settings: DeformationSettings
) -> tuple[Floats, Floats]:
    """Relative errors from the ends of each stick, (stick,): of σ_x, and of σ_x/Λ_st.

    Wrong ends change both by the same factor if the pull and the creep are steady. The error of the ratio is
    the part by which they are not (`end_slope` for the creep), and `resting`, the share of the stick in which
    sheets that slip in turn may not creep.
    """
    length = events["stick_length_um"].to_numpy(float)
    stated_um = events["stick_length_err_um"].to_numpy(float) if "stick_length_err_um" in events else 0.0
    stated: Floats = np.nan_to_num(stated_um / length)
    sigma = np.hypot(stated * (1 + end_slope), resting)
    if len(length) < settings.least_repeats:
        return sigma, sigma
    speed = length / (events["t_p_s"] - events["t_v_s"]).to_numpy(float)
    uneven = sigma_about_zero(speed / nan_median(speed) - 1)
    return sigma, np.hypot(np.hypot(np.fmin(stated, uneven), stated * end_slope), resting)
