"""synchronise(): the camera's clock against the testing machine's."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from vision.clock.force_slips import force_slips
from vision.clock.result import Candidate, Clock, How
from vision.clock.sizes import scored
from vision.clock.trains import Clocks, Fit, Trains, evaluate
from vision.clock.verdict import Alignment, align
from vision.clock.video_slips import video_slips
from vision.clock.video_time import clock_from_column
from vision.errors import InputError
from vision.force.recording import good_samples
from vision.sheets.medians import nan_median

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

_LEAST_SLIPS = 4
_LISTED = 5
_LEAST_ERROR_S = 0.001  # how long a slip takes
_CONTRADICTION = 3.0  # standard errors of the slips' own answer, and of one slip


def synchronise(
    tracks: xr.Dataset, force: xr.Dataset, sticks: pd.DataFrame, *, offset_s: float | None = None
) -> Clock:
    """The line t_force = a + b t_video.

    A given offset decides (the drift is then 0), else a column of the camera's times in the force recording,
    else the slips both saw.  Slips are nearly periodic, so an alignment shifted by whole slips fits nearly as
    well as the right one: it is called "ok" only where `align` has nothing against it, else "ambiguous", with
    the candidates.  Slips that did not decide are still compared, and a contradiction is a warning.

    Args: tracks, from `track_sheets`.  force, from `read_force`.  sticks, from `find_stick_slip`.  offset_s,
    force clock at video time 0.

    Raises InputError where the frames have no times, where a given clock puts the video outside the force
    recording, or, with slips to decide, where either side has fewer than four or none agree.
    Source: the notes on synchronising clocks.
    """
    warnings = _about_times(tracks)
    if offset_s is not None:
        _check_overlap(tracks, force, (offset_s, 0.0), "--offset")
        clock = _stated(tracks, force, sticks, (offset_s, 0.0), "given")
    elif (column := clock_from_column(force)) is not None:
        _check_overlap(tracks, force, column, str(force.attrs.get("path", "the force recording")))
        clock = _stated(tracks, force, sticks, column, "video time column")
    else:
        clock = _from_slips(tracks, force, sticks)
        if "video_time_s" in force:
            warnings = (
                *warnings,
                "the column of video times in the force recording is not usable: slips decide",
            )
    return replace(clock, warnings=(*warnings, *clock.warnings))


def _about_times(tracks: xr.Dataset) -> tuple[str, ...]:
    if tracks.attrs.get("clock_kind") != "playback":
        return ()
    return ("frame times are the file's playback rate, which need not be the camera's: give --fps",)


def _check_overlap(tracks: xr.Dataset, force: xr.Dataset, line: tuple[float, float], about: str) -> None:
    times = tracks["time_s"].to_numpy()
    times = times[np.isfinite(times)]
    if not len(times):
        source = str(tracks.attrs.get("source", "the tracks"))
        raise InputError(source, "a time for each frame", "none", "give --fps or --timestamps")
    if not np.isfinite(line[0]):
        raise InputError(about, "a number of seconds", f"{line[0]}")
    machine = good_samples(force)["time_s"].to_numpy()
    begin, end = (line[0] + (1 + 1e-6 * line[1]) * t for t in (times.min(), times.max()))
    if end < machine[0] or begin > machine[-1]:
        raise InputError(
            about,
            f"a video within the force recording, {machine[0]:.6g} to {machine[-1]:.6g} s",
            f"one from {begin:.6g} to {end:.6g} s on that clock",
            "check --offset, or whether the two files belong together",
        )


def _trains(video: pd.DataFrame, machine: pd.DataFrame) -> Trains:
    force_error = float(np.hypot(np.median(machine["error_s"]), _LEAST_ERROR_S))
    return Trains(
        video["time_s"].to_numpy(),
        np.hypot(video["error_s"].to_numpy(), force_error),
        machine["time_s"].to_numpy(),
        scored(video["step_px"].to_numpy(), video["step_err_px"].to_numpy()),
        scored(machine["drop_N"].to_numpy()),
        force_error,
    )


def _from_slips(tracks: xr.Dataset, force: xr.Dataset, sticks: pd.DataFrame) -> Clock:
    seen, drops = video_slips(tracks), force_slips(force, sticks)
    for about, slips in (
        (str(tracks.attrs.get("source", "the video")), seen),
        (str(force.attrs.get("path", "the force recording")), drops),
    ):
        if len(slips) < _LEAST_SLIPS:
            need = f"at least {_LEAST_SLIPS} slips to set the clocks by"
            raise InputError(about, need, f"{len(slips)}", "give --offset")
    found = align(_trains(seen, drops))
    if found.fit.likelihood[0] <= 0:
        raise InputError(
            str(tracks.attrs.get("source", "the video")),
            "slips at the same times as in the force recording",
            f"{len(seen)} slips that fit none of its {len(drops)} at any offset",
            "check whether the two files belong together, or give --offset",
        )
    return _decided(found, float(drops.attrs["lag_s"]))


def _decided(found: Alignment, lag_s: float) -> Clock:
    """The best alignment as a Clock; its error includes the load cell's lag."""
    error, drift_error = found.errors()
    doubt = () if not found.doubt else (f"clocks ambiguous: {found.doubt}; give --offset",)
    clock = _clock(found.clocks, found.fit, "events")
    return replace(
        clock,
        margin=found.margin,
        status="ambiguous" if doubt else "ok",
        error_ms=1e3 * float(np.hypot(error, lag_s)),
        drift_err_ppm=1e6 * drift_error,
        candidates=_candidates(found),
        warnings=doubt,
    )


def _clock(clocks: Clocks, fit: Fit, how: How) -> Clock:
    """The first of the clocks with its counts and residual."""
    return Clock(
        offset_s=float(clocks.offset_s[0]),
        drift_ppm=1e6 * float(clocks.drift[0]),
        residual_ms=1e3 * float(nan_median(np.abs(fit.residual_s[0]))),
        matched=int(fit.matched[0]),
        unmatched_video=int(fit.video[0] - fit.matched[0]),
        unmatched_force=int(fit.force[0] - fit.matched[0]),
        margin=float("nan"),
        status="given",
        how=how,
    )


def _candidates(found: Alignment) -> tuple[Candidate, ...]:
    facts = (found.clocks.offset_s, 1e6 * found.clocks.drift, found.fit.likelihood, found.fit.matched)
    return tuple(
        Candidate(offset_s=float(a), drift_ppm=float(b), log_likelihood=float(c), matched=int(m))
        for a, b, c, m in zip(*(fact[:_LISTED] for fact in facts), strict=True)
    )


def _stated(
    tracks: xr.Dataset, force: xr.Dataset, sticks: pd.DataFrame, line: tuple[float, float], how: How
) -> Clock:
    """A clock that was told, with what the slips say about it."""
    seen, drops = video_slips(tracks), force_slips(force, sticks)
    clock = Clock(
        offset_s=line[0],
        drift_ppm=line[1],
        residual_ms=float("nan"),
        matched=0,
        unmatched_video=len(seen),
        unmatched_force=len(drops),
        margin=float("nan"),
        status="given",
        how=how,
    )
    if min(len(seen), len(drops)) < _LEAST_SLIPS:
        return clock
    trains = _trains(seen, drops)
    told = Clocks(np.array([line[0]]), np.array([1e-6 * line[1]]), np.zeros(1))
    compared = _clock(told, evaluate(trains, told), how)
    return replace(compared, warnings=_contradiction(compared, align(trains)))


def _contradiction(told: Clock, found: Alignment) -> tuple[str, ...]:
    """What the slips have against a clock that was told."""
    centre = found.clocks.centre_s[0]
    away = float(found.clocks.middle_s[0] - told.to_force_s(centre))
    allowed = _CONTRADICTION * float(np.hypot(found.errors()[0], found.trains.typical_error_s))
    if not found.doubt and abs(away) > allowed:
        return (
            f"the slips say that the force clock is {found.clocks.offset_s[0]:.4f} s at video time 0, not "
            f"{told.offset_s:.4f} s (margin {found.margin:.0f})",
        )
    if told.matched < min(told.unmatched_video, told.unmatched_force):
        return (f"only {told.matched} slips agree with the clock that was told ({told.how})",)
    return ()
