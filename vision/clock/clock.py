"""The camera's clock against the testing machine's: `Clock` and `synchronise`."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import ArrayLike

from vision.clock.alignment import (
    Alignments,
    CandidateClocks,
    ClockFits,
    SlipSizes,
    SlipTrains,
    align_slips,
    find_alignments,
    fit_clocks,
)
from vision.clock.settings import ClockSettings
from vision.clock.slips import force_slips, video_slips
from vision.data import FORCE, STICKS, TRACKS, ForceMetadata, StripMetadata
from vision.errors import InputError, check_number
from vision.folder import Shown, numbered
from vision.force.recording import good_samples
from vision.numeric import Floats, nan_median, sigma_about_zero, two_digits, with_minus

ClockStatus = Literal["ok", "ambiguous", "given"]
How = Literal["given", "video time column", "events"]


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """One alignment of the slips."""

    offset_s: float
    drift_ppm: float
    log_likelihood: float  # minus that of no matched slip
    matched: int  # number of paired slips


_FAR = 10  # error of the offset over that of a time among the slips


@dataclass(frozen=True, kw_only=True, repr=False)
class Clock(Shown):
    r"""How video time maps to the force clock.

    .. math:: t_\mathrm{force} = \mathtt{offset\_s} + (1 + 10^{-6}\,\mathtt{drift\_ppm})\, t_\mathrm{video}
    """

    offset_s: float  # force clock at video time 0
    drift_ppm: float  # by how much the force clock is faster than the camera's
    residual_ms: float = math.nan  # median absolute residual of the matched slips; NaN without any
    # Numbers of slips within the time that both recordings cover.
    matched: int = 0
    unmatched_video: int = 0
    unmatched_force: int = 0
    only_video_s: tuple[float, ...] = ()  # times on the force clock of the slips that only the film shows
    matched_s: tuple[float, ...] = ()  # and of the slips of the force that match one of the film
    margin: float = math.nan  # log-likelihood minus that of the next different alignment
    # "ok"; "ambiguous": the numbers are those of the best candidate, which may be wrong by whole slips and
    # must be checked before use; or "given": set by an offset or by a column of video times.
    status: ClockStatus
    how: How  # what set the clock
    # Standard errors, NaN as is the margin where the clock was given: of a mapped time in the middle of the
    # matched slips, of the drift, and of the offset, that of the drift up to video time 0 included.
    error_ms: float = math.nan
    drift_err_ppm: float = math.nan
    offset_err_s: float = math.nan
    # Time from the first to the last sheet in a slip that the film permits; NaN if it is not known.
    slip_spread_ms: float = math.nan
    candidates: tuple[Candidate, ...] = ()  # alignments considered, best first
    ambiguity: str = ""  # why the status is "ambiguous"
    warnings: tuple[str, ...] = ()  # for the user

    def to_force_s(self, video_time_s: ArrayLike) -> Floats:
        """Force clock at these video times, s; NaN stays NaN."""
        return self.offset_s + (1 + 1e-6 * self.drift_ppm) * np.asarray(video_time_s, np.float64)

    def to_video_s(self, force_time_s: ArrayLike) -> Floats:
        """Video time at these times of the force clock, s; NaN stays NaN."""
        return (np.asarray(force_time_s, np.float64) - self.offset_s) / (1 + 1e-6 * self.drift_ppm)

    def offsets_at_slips(self) -> tuple[int, Floats, float]:
        """Return a video time, s, and force clock less video time there, s: of this clock and its candidates,
        with the standard error of the first. The time is 0, or one among the matched slips where 0 is so far
        away (time stamps since 1970) that the drift decides the offset there."""
        far = self.offset_err_s > _FAR * 1e-3 * self.error_ms and self.matched_s
        at = round(float(self.to_video_s(np.mean(self.matched_s)))) if far else 0
        clocks: tuple[Clock | Candidate, ...] = (self, *self.candidates)
        offsets_s = np.array([one.offset_s + 1e-6 * one.drift_ppm * at for one in clocks])
        return at, offsets_s, 1e-3 * self.error_ms if at else self.offset_err_s

    def _shown(self) -> tuple[str, dict[str, str]]:
        def with_error(value: str, error: float, unit: str) -> str:
            return f"{value} ± {two_digits(error)} {unit}" if math.isfinite(error) else f"{value} {unit}"

        at, offsets, error_s = self.offsets_at_slips()
        rows = {
            "status": f"{self.status} (from {self.how})",
            "offset": with_error(f"{offsets[0]:.4f}", error_s, f"s at video time {at} s" if at else "s"),
            "drift": with_error(f"{self.drift_ppm:.1f}", self.drift_err_ppm, "ppm"),
            "slips": f"{self.matched} matched, {self.unmatched_video} only in the video, "
            f"{self.unmatched_force} only in the force",
        }
        if math.isfinite(self.residual_ms):
            rows["residual"] = f"{self.residual_ms:.2g} ms (median)"
        if math.isfinite(self.margin):
            rows["margin"] = f"{self.margin:.1f} in log-likelihood"
        return "camera's clock to force clock", rows | numbered("warning", self.warnings)


# --- synchronise --------------------------------------------------------------------------------------------


def synchronise(
    tracks: xr.Dataset,
    force: xr.Dataset,
    sticks: pd.DataFrame,
    *,
    offset_s: float | None = None,
    drift_ppm: float = 0.0,
    settings: ClockSettings = ClockSettings(),
) -> Clock:
    """Find the straight line from video time to the force clock.

    The clock is the given offset; without one, a column of the camera's times in the force recording; without
    that, the alignment of the slips that both instruments recorded. A clock that does not come from the slips
    is compared with them, and a contradiction gives a warning.

    Parameters
    ----------
    tracks, force, sticks
        From `track_sheets`, `read_force` and `find_stick_slip`.
    offset_s
        Force clock at video time 0, where it is known.
    drift_ppm
        By how much the force clock is faster than the camera's, if `offset_s` is given.
    settings
        See `ClockSettings`.

    Returns
    -------
    The clock. The status is "ok" where `align_slips` finds no ambiguity, and "ambiguous" otherwise, or where
    frames have no times of their own, from the file or from time stamps, and the slips fit nearly as well at
    another frame rate, also if one is given: the camera may have been slower than it was set.

    Raises
    ------
    InputError
        If the frames have no times; if a given clock puts the video outside the force recording; or if the
        clock must come from the slips and either recording has fewer than four or none coincide.
    """
    TRACKS.check(tracks)
    FORCE.check(force)
    STICKS.check(sticks)
    check_number(offset_s=offset_s, drift_ppm=drift_ppm)
    warnings: tuple[str, ...] = ()
    if StripMetadata.of(tracks).clock_kind == "playback":
        warnings = ("frame times are the file's playback rate, which need not be the camera's: give `fps`",)
    if offset_s is not None:
        given: Clock | None = given_clock(offset_s, drift_ppm, _frame_times(tracks), force)
    elif (given := clock_from_column(force)) is not None:
        _check_overlap(_frame_times(tracks), force, given, ForceMetadata.of(force).source)
    elif "video_time_s" in force:
        unusable = "the column of video times in the force recording is not usable: the slips are used"
        warnings = (*warnings, unusable)
    recordings = tracks, force, sticks
    clock = _given(*recordings, given, settings) if given else _from_slips(*recordings, settings)
    return replace(clock, warnings=(*warnings, *clock.warnings))


def _frame_times(tracks: xr.Dataset) -> Floats:
    """The times of the frames that have one.  Raises: InputError if none has."""
    times: Floats = tracks["time_s"].to_numpy()
    if not len(times := times[np.isfinite(times)]):
        source = StripMetadata.of(tracks).source
        raise InputError(source, "a time for each frame", "none", "give `fps` or `timestamps`")
    return times


def given_clock(offset_s: float, drift_ppm: float, video_s: Floats, force: xr.Dataset) -> Clock:
    """The clock of a given offset and drift.  Raises: InputError if it puts `video_s` outside the force."""
    clock = Clock(offset_s=offset_s, drift_ppm=drift_ppm, status="given", how="given")
    _check_overlap(video_s, force, clock, "`offset_s`")
    return clock


def _check_overlap(video_s: Floats, force: xr.Dataset, clock: Clock, about: str) -> None:
    """Raise InputError if this clock puts frames at these times, s, outside the force recording."""
    machine = good_samples(force)["time_s"].to_numpy()
    begin, end = clock.to_force_s([video_s.min(), video_s.max()])
    if end < machine[0] or begin > machine[-1]:
        wanted = f"a video within the force recording, {machine[0]:.6g} to {machine[-1]:.6g} s"
        found = f"one from {begin:.6g} to {end:.6g} s on that clock"
        raise InputError(about, wanted, found, "check `offset_s`, or whether the two files belong together")


def _slip_trains(seen: pd.DataFrame, drops: pd.DataFrame, settings: ClockSettings) -> SlipTrains:
    """The tables of `video_slips` and `force_slips` as trains."""
    force_error = float(np.hypot(np.median(drops["error_s"]), 0.001))  # a slip itself lasts about 1 ms
    return SlipTrains(
        seen["time_s"].to_numpy(),
        np.hypot(seen["error_s"].to_numpy(), force_error),
        drops["time_s"].to_numpy(),
        SlipSizes.of(seen["step_px"].to_numpy(), seen["step_err_px"].to_numpy(), settings),
        SlipSizes.of(drops["drop_N"].to_numpy(), settings=settings),
        force_error,
    )


def _from_slips(
    tracks: xr.Dataset, force: xr.Dataset, sticks: pd.DataFrame, settings: ClockSettings
) -> Clock:
    """Clock of the best alignment of the slips, with status "ok" or "ambiguous"."""
    seen, drops = video_slips(tracks, settings=settings), force_slips(force, sticks, settings=settings)
    video = StripMetadata.of(tracks).source
    _check_slips(ForceMetadata.of(force).source, len(drops), settings)
    _check_slips(video, len(seen), settings, tracks)
    found, advice = _against_frame_rates(align_slips(_slip_trains(seen, drops, settings), settings), tracks)
    if found.fits.log_likelihood[0] <= 0:
        raise InputError(
            video,
            "slips at the same times as in the force recording",
            f"{len(seen)} slips that coincide with none of its {len(drops)} at any offset",
            advice or "check whether the two files belong together and `fps`, or give `offset_s`",
        )
    error, drift_error, offset_error = found.errors()
    # The force may fall with the first or with the last of the sheets.
    spread_ms = _slip_spread_ms(seen)
    constant = float(np.hypot(drops["lag_s"].iloc[0], 1e-3 * spread_ms / 2))
    clocks, fits = found.clocks, found.fits
    drift = float(clocks.drift[0])
    clock = _clock_of(found.trains, clocks, fits, "events")
    if found.ambiguity:
        warnings = [f"clocks ambiguous: {found.ambiguity}; {advice or 'give `offset_s`'}"]
    else:
        warnings = _unmatched_warnings(clock, settings)
        if abs(drift) - 2 * drift_error > 1e-6 * settings.usual_drift_ppm:
            rate = _frame_rate(StripMetadata.of(tracks), 1 + drift)
            percent = with_minus(f"{100 * drift:+.2f}")
            warnings.append(
                f"the clocks of film and machine differ by {percent} %, more than real clocks: they agree at"
                f" {rate}; check `fps`"
            )
    return replace(
        clock,
        margin=found.margin,
        status="ambiguous" if found.ambiguity else "ok",
        error_ms=1e3 * float(np.hypot(error, constant)),
        drift_err_ppm=1e6 * drift_error,
        offset_err_s=float(np.hypot(offset_error, constant)),
        slip_spread_ms=spread_ms,
        candidates=tuple(
            Candidate(
                offset_s=float(clocks.offset_s[k]),
                drift_ppm=1e6 * float(clocks.drift[k]),
                log_likelihood=float(fits.log_likelihood[k]),
                matched=int(fits.matched[k]),
            )
            for k in range(min(5, len(clocks.drift)))
        ),
        ambiguity=found.ambiguity,
        warnings=tuple(warnings),
    )


def _check_slips(about: str, slips: int, settings: ClockSettings, tracks: xr.Dataset | None = None) -> None:
    """Raise InputError if these are too few to align the clocks; it names jumps of the sheets inwards."""
    if slips >= settings.least_slips:
        return
    found, advice = f"{slips}", "give `offset_s`"
    if tracks is not None:
        inwards = len(video_slips(tracks.assign_coords(side=-tracks["side"]), settings=settings))
        if inwards >= settings.least_slips:
            found += f", and {inwards} jumps of the sheets inwards"
            advice = "check that the film does not run backwards, and `axis_px`"
    raise InputError(about, f"at least {settings.least_slips} slips to align the clocks", found, advice)


def _slip_spread_ms(seen: pd.DataFrame) -> float:
    """Time from the first to the last sheet in the slips of `video_slips`, ms; NaN without slips."""
    return 1e3 * float(seen["spread_s"].iloc[0]) if len(seen) else math.nan


def _against_frame_rates(found: Alignments, tracks: xr.Dataset) -> tuple[Alignments, str]:
    """The alignments, ambiguous also where other frame rates fit as well, and advice on the cause or ""."""
    strip, settings = StripMetadata.of(tracks), found.settings
    if strip.clock_kind == "file" or strip.clock_file:
        return found, ""  # each frame has its own time; a rate that is given may be the one that was set
    rate, likelihood = _best_beyond_search(found)
    lead = likelihood - float(found.fits.log_likelihood[0])
    if not found.ambiguity and lead > -settings.least_margin:
        why = f"the slips fit nearly as well at {_frame_rate(strip, rate)}"
        return replace(found, ambiguity=why), "give `timestamps` of the frames, or `offset_s`"
    # Evenly spaced slips fit nearly equally well at many rates.
    if found.ambiguity and lead > settings.clear_likelihood:
        scaled = replace(found.trains, video_s=rate * found.trains.video_s)
        if not align_slips(scaled, settings).ambiguity:
            return found, f"the slips agree at {_frame_rate(strip, rate)}: check `fps`"
    return found, ""


def _unmatched_warnings(clock: Clock, settings: ClockSettings) -> list[str]:
    """Warnings of slips that only one of the two recordings shows."""
    of_film = (
        "slips of the film match no drop of the force, and stick phases that contain them are left out: check"
        " `threshold_N` and `offset_s`"
    )
    of_force = (
        "drops of the force match no slip of the film: check whether frames are missing and whether the"
        " sheets in view slip"
    )
    alone = {of_film: clock.unmatched_video, of_force: clock.unmatched_force}
    return [
        f"{count} of {count + clock.matched} {line}"
        for line, count in alone.items()
        if count > settings.unmatched_share * (count + clock.matched)
    ]


def _best_beyond_search(found: Alignments) -> tuple[float, float]:
    """Rate of the force clock relative to the camera's at which the slips align best, and its log-likelihood.

    Only rates beyond the largest drift that differ from the rate found are compared.
    """
    trains, most = found.trains, 1e-6 * found.settings.largest_drift_ppm
    known = 1 + found.clocks.drift[0]  # the least squares may exceed the range of the search slightly
    best = math.nan, -math.inf
    for steps in (1, -1, 2, -2, 3, -3):
        rate = 1 + 1.8 * most * steps
        clocks, fits = find_alignments(replace(trains, video_s=rate * trains.video_s), found.settings)
        rate *= 1 + float(clocks.drift[0])
        likelihood = float(fits.log_likelihood[0])
        if abs(rate - 1) > most and abs(rate - known) > most / 4 and likelihood > best[1]:
            best = rate, likelihood
    return best


def _frame_rate(strip: StripMetadata, rate: float) -> str:
    """Frame rate at which the clocks would agree, given the machine's present `rate` relative to the
    camera's."""
    if not math.isfinite(strip.fps):
        return f"{1 / rate:.4f} times the frame rate"
    return f"{strip.fps / rate:.5g} frames/s instead of {strip.fps:.5g}"


def _clock_of(trains: SlipTrains, clocks: CandidateClocks, fits: ClockFits, how: How) -> Clock:
    """Clock from the first of the candidates, with its numbers of slips and its residual."""
    first, last = trains.force_s[[0, -1]]
    seen_s = clocks.map(trains.video_s)[0]
    # A pair may lie beyond the common time by more than the usual error of a slip.
    alone = [max(int(count[0] - fits.matched[0]), 0) for count in (fits.video, fits.force)]
    only_video = (fits.partner[0] < 0) & (seen_s > first) & (seen_s < last)
    return Clock(
        offset_s=float(clocks.offset_s[0]),
        drift_ppm=1e6 * float(clocks.drift[0]),
        residual_ms=1e3 * float(nan_median(np.abs(fits.residual_s[0]))),
        matched=int(fits.matched[0]),
        unmatched_video=alone[0],
        unmatched_force=alone[1],
        only_video_s=tuple(seen_s[only_video].tolist()),
        matched_s=tuple(np.unique(trains.force_s[fits.partner[0][fits.partner[0] >= 0]]).tolist()),
        status="given",
        how=how,
    )


def _given(
    tracks: xr.Dataset, force: xr.Dataset, sticks: pd.DataFrame, clock: Clock, settings: ClockSettings
) -> Clock:
    """A given clock with the slips that match it, and with warnings where they contradict it."""
    seen, drops = video_slips(tracks, settings=settings), force_slips(force, sticks, settings=settings)
    if len(seen) and len(drops) > 1:
        trains = _slip_trains(seen, drops, settings)
        clocks = CandidateClocks(np.array([clock.offset_s]), np.array([1e-6 * clock.drift_ppm]), np.zeros(1))
        given = _clock_of(trains, clocks, fit_clocks(trains, clocks, settings), clock.how)
    else:
        given = replace(clock, unmatched_video=len(seen), unmatched_force=len(drops))
    given = replace(given, slip_spread_ms=_slip_spread_ms(seen))
    if min(len(seen), len(drops)) < settings.least_slips:  # too few for an alignment of their own
        return given
    found = align_slips(trains, settings)
    centre = found.clocks.centre_s[0]
    difference = float(found.clocks.middle_s[0] - given.to_force_s(centre))
    error = float(np.hypot(found.errors()[0], found.trains.typical_error_s))
    warnings = _unmatched_warnings(given, settings)
    if not found.ambiguity and abs(difference) > settings.contradiction_sigma * error:
        warnings = [
            f"according to the slips the force clock is {found.clocks.offset_s[0]:.4f} s at video time 0, "
            f"not {given.offset_s:.4f} s (margin {found.margin:.0f})"
        ]
    return replace(given, warnings=tuple(warnings))


# --- a column of video times in the force recording ---------------------------------------------------------


def clock_from_column(force: xr.Dataset) -> Clock | None:
    """Return the clock that the video times in the testing machine's recording lie on.

    A value is repeated until the next frame arrives, so only its first sample counts. Values more than 5 σ
    off the line are left out, beginning with that of medians. None without a usable column: it needs ten
    different values, and a rate within 2 % of the machine's.
    """
    if "video_time_s" not in force:
        return None
    video, machine = force["video_time_s"].to_numpy(), force["time_s"].to_numpy()
    known = np.isfinite(video) & np.isfinite(machine)
    video, machine = video[known], machine[known]
    new = np.flatnonzero(np.diff(video) > 0) + 1
    video, machine = video[new], machine[new]
    if len(video) < 10:
        return None
    # Slopes across half of the values; none rises where the video times start again.
    half, centre = len(video) // 2, float(np.median(video))
    video = video - centre
    rise, run = machine[-half:] - machine[:half], video[-half:] - video[:half]
    if not np.any(run > 0):
        return None
    slope = float(np.median(rise[run > 0] / run[run > 0]))
    middle = float(np.median(machine - slope * video))
    for _ in range(10):
        residual = np.abs(machine - middle - slope * video)
        used = residual <= 5 * max(float(sigma_about_zero(residual)), 1e-6)
        if not np.ptp(video[used]) > 0:
            break
        slope, middle = (float(c) for c in np.polyfit(video[used], machine[used], 1))
    if not abs(slope - 1) <= 0.02:
        return None
    return Clock(
        offset_s=middle - slope * centre, drift_ppm=1e6 * (slope - 1), status="given", how="video time column"
    )
