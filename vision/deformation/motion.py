"""horizontal_deformation(): x(n, t) and the stick phases become σ_x and σ_x/Λ_st."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np

from vision.deformation.amplitude import Amplitude, Sheets, measure_amplitude
from vision.deformation.dataset import as_dataset
from vision.deformation.frames import Doubles, frames_of_sticks
from vision.deformation.locking import pull
from vision.errors import InputError
from vision.sheets.medians import nan_median

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr


class VideoClock(Protocol):
    """What is needed of `vision.clock.Clock`.

    status: "ok", "given" or "ambiguous".  residual_ms: scatter of single events, NaN where not known.  A
    clock may also have error_ms, the standard error of a mapped time.
    """

    @property
    def status(self) -> str: ...  # noqa: D102
    @property
    def residual_ms(self) -> float: ...  # noqa: D102

    def to_force_s(self, video_time_s: Doubles) -> Doubles:
        """Times on the force clock."""
        ...


def horizontal_deformation(
    tracks: xr.Dataset,
    sticks: pd.DataFrame,
    clock: VideoClock,
    *,
    pixel_size_um: float | None = None,
    margin_s: float | None = None,
    common_mode: bool = True,
) -> xr.Dataset:
    """Horizontal deformation of every sheet in every stick phase that lies inside the video.

    With δx = x - x̂ and x̂ the mean over the stick, σ_x = √(mean of δx²): a linear sweep S gives S/√12.

    - `sigma_x_um` is just that over the usable frames: noise and vibration are in it.
    - `sigma_x_corrected_um` is √(a1²/3 + a2²/5) with the creep x̂ + a1 P1 + a2 P2 (Legendre) fitted to the
      usable frames and taken over the whole stick; a2 only where it exceeds 3 errors, less its noise.
      For many frames it equals √(σ² - noise²); for few it has less bias, since it keeps the sign: a
      movement outwards is a negative measurement, reported as 0 (flag "below_noise"; `ratio_signed` keeps
      it), unless it exceeds 3 errors (flag "outward": its size is reported).
    - Camera movement is taken off (`common_mode`): what all sheets do together beyond their creep in each
      frame, and what moved during the stick, told from left and right, or, with one side in view, from the
      sheets' creep in other sticks and their mean positions; attrs["camera_movement"] says which.
    - A sheet that slips later than the force dropped, or before, is not in the stick in these frames; it
      creeps for that much less.
    - Errors rest on the residuals of each sheet, with their autocorrelation: see `Memory`.  A stick whose own
      residuals stand out has its error raised ("uneven").  For tracks of `track_sheets` they hold what
      repeats from stick to stick: unequal pixels (see `pattern`) and unequal magnification.  The
      publication's fit (attrs["fit"]) is let go from whole pixels first (see `locking`), except in
      `sigma_x_um`.  Not in them: the error of the pixel size, and of the stick length unless `sticks` has
      stick_length_err_um.

    Args: tracks, of `track_sheets`.  sticks, of `find_stick_slip`.  clock, of `synchronise`.
    pixel_size_um, or else tracks.attrs["pixel_size_um"].  margin_s: time kept clear of each slip; by
    default half a frame interval (the exposure) and what the clock may be wrong by.

    Returns: Dataset (event, sheet), variables as their attrs say; coordinates t_v_s, t_p_s, d_v_mm, d_p_mm
    (event), side, n (sheet).  flag: "ok"; "few" (less than 4 usable frames, or they cover less than two
    fifths of the stick: all NaN); "no_length" (Λ_st unknown: ratio NaN); "outward", "uneven",
    "below_noise".

    Raises: InputError without a pixel size, times, stick lengths or a stick phase inside the video, and for
    clocks called ambiguous.  Source: paper, horizontal deformation by image processing.
    """
    source = str(tracks.attrs.get("source", "tracks"))
    pixel = _pixel_size(tracks, pixel_size_um, source)
    if clock.status == "ambiguous":
        raise InputError(source, "clocks that agree in one way only", "several", "give --offset")
    time = np.asarray(clock.to_force_s(np.asarray(tracks["time_s"].values, float)), float)
    interval = _interval(time, source)
    events = _inside(sticks, time, interval, source)
    if margin_s is None:
        margin_s = interval / 2 + _clock_error_s(clock, interval)
    start, stop = (events[name].to_numpy(float) for name in ("t_v_s", "t_p_s"))
    every, frames = (
        frames_of_sticks(time, start, stop, margin_s=margin, interval_s=interval)
        for margin in (0.0, margin_s)
    )
    x_px = np.asarray(tracks["x_px"].values, float)[frames.frame]
    found = measure_amplitude(x_px, frames, _sheets(tracks), common_mode=common_mode)
    settings = {"margin_s": margin_s, "interval_s": interval} | _how(found)
    motion = as_dataset(tracks, events, found, pixel_size_um=pixel, left_out=every.counts - frames.counts)
    return motion.assign_attrs(settings)


def _pixel_size(tracks: xr.Dataset, given: float | None, source: str) -> float:
    size = float(tracks.attrs.get("pixel_size_um", np.nan) if given is None else given)
    if not (np.isfinite(size) and size > 0):
        found = "none" if np.isnan(size) else f"{size:g}"
        raise InputError(source, "a pixel size in um for σ_x/Λ_st", found, "give --pixel-size")
    return size


def _interval(time_s: Doubles, source: str) -> float:
    step = np.diff(time_s[np.isfinite(time_s)])
    if not (step > 0).any():
        raise InputError(source, "the times of the frames", "none that pass", "give --fps or --timestamps")
    return float(np.median(step[step > 0]))


def _clock_error_s(clock: VideoClock, interval_s: float) -> float:
    """What a mapped time may be wrong by: two standard errors, or what the residuals are beyond what they
    would be if frames alone limited them (a quarter of an interval)."""
    error_s = float(getattr(clock, "error_ms", np.nan)) / 1000
    if np.isfinite(error_s):
        return 2 * error_s
    residual_s = float(np.nan_to_num(clock.residual_ms)) / 1000
    return float(np.sqrt(max(residual_s**2 - (interval_s / 4) ** 2, 0.0)))


def _inside(sticks: pd.DataFrame, time_s: Doubles, interval_s: float, source: str) -> pd.DataFrame:
    """The stick phases that lie wholly inside the video, in order of time."""
    first, last = np.nanmin(time_s), np.nanmax(time_s)
    start, stop = sticks["t_v_s"], sticks["t_p_s"]
    within = (start >= first - interval_s) & (stop <= last + interval_s) & (stop > start)
    if not within.any():
        span = f"{start.min():.3f} to {stop.max():.3f} s" if len(sticks) else "no stick phase at all"
        raise InputError(
            source,
            f"stick phases between {first:.3f} and {last:.3f} s of the force clock, when the video ran",
            span,
            "check --force and --offset",
        )
    if not np.isfinite(sticks.loc[within, "stick_length_um"].to_numpy(float)).any():
        raise InputError(source, "stick lengths", "no displacement in the force recording", "give --speed")
    return sticks[within].sort_values("t_v_s")


def _sheets(tracks: xr.Dataset) -> Sheets:
    x_px = np.asarray(tracks["x_px"].values, float)
    error_px = np.full_like(x_px, np.nan)
    if "x_err_px" in tracks:
        error_px = np.asarray(tracks["x_err_px"].values, float)
    fit = tracks.attrs.get("fit")
    share = pull(x_px, error_px) if fit == "paper" else np.zeros(x_px.shape[1])
    return Sheets(tracks["side"].values, tracks["n"].values, nan_median(error_px), share, fit is not None)


def _how(found: Amplitude) -> dict[str, object]:
    return {
        "noise_share": found.memory.share,
        "noise_rho": found.memory.rho,
        "camera_movement": found.camera,
    }
