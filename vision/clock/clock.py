"""The camera's clock against the testing machine's: `Clock` and `synchronise`.

Where samples or frames are lost, or a clock jumps, an alignment holds on one side of the place only. If few
slips lie on the other side, the alignment is that of the many, and those few are left without partners.
`find_breaks` and `silent_drops` find such slips at the beginning and end of the film.
"""

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
    align,
    find_alignments,
    fit_clocks,
)
from vision.clock.settings import ClockSettings
from vision.clock.slips import force_slips, video_slips
from vision.data import FORCE, STICKS, TRACKS, ForceMetadata, StripMetadata
from vision.errors import InputError, check_number, counted
from vision.files import html_table
from vision.force.recording import good_samples, usable
from vision.numeric import Bools, Floats, Ints, Strings, nan_median, sigma_about_zero, two_digits, with_minus

Status = Literal["ok", "ambiguous", "given"]
How = Literal["given", "video time column", "events"]


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """One alignment of the slips."""

    offset_s: float
    drift_ppm: float
    log_likelihood: float  # minus that of no matched slip
    matched: int  # number of paired slips


@dataclass(frozen=True, kw_only=True)
class Clock:
    r"""How video time maps to the force clock.

    Parameters
    ----------
    offset_s
        Force clock at video time 0.
    drift_ppm
        By how much the force clock is faster than the camera's.
    residual_ms
        Median absolute residual of the matched slips; NaN without any.
    matched, unmatched_video, unmatched_force
        Numbers of slips within the time that both recordings cover.
    only_video_s
        Times of the slips of the film that match no slip of the force, s, on the force clock.
    matched_s
        Times of the slips of the force that match one of the film, s, on the force clock.
    holds_from_s, holds_to_s
        Force clock from and up to which the slips agree with this clock; NaN: they do so to the beginning or
        end of the film.
    margin
        Log-likelihood minus that of the next different alignment; NaN where the clock was given.
    status
        "ok"; "ambiguous": the numbers are those of the best candidate, which may be wrong by whole slips and
        must be checked before use; or "given": set by an offset or by a column of video times.
    how
        What set the clock.
    error_ms
        Standard error of a mapped time in the middle of the matched slips; NaN where the clock was given.
    drift_err_ppm
        Standard error of the drift; NaN where the clock was given.
    offset_err_s
        Standard error of the offset, including that of the drift up to video time 0; NaN where the clock was
        given.
    candidates
        Alignments considered, best first.
    ambiguity
        Why the status is "ambiguous"; "" otherwise.
    warnings
        Warnings for the user.

    Notes
    -----
    .. math:: t_\mathrm{force} = \mathtt{offset\_s} + (1 + 10^{-6}\,\mathtt{drift\_ppm})\, t_\mathrm{video}
    """

    offset_s: float
    drift_ppm: float
    residual_ms: float = math.nan
    matched: int = 0
    unmatched_video: int = 0
    unmatched_force: int = 0
    only_video_s: tuple[float, ...] = ()
    matched_s: tuple[float, ...] = ()
    holds_from_s: float = math.nan
    holds_to_s: float = math.nan
    margin: float = math.nan
    status: Status
    how: How
    error_ms: float = math.nan
    drift_err_ppm: float = math.nan
    offset_err_s: float = math.nan
    candidates: tuple[Candidate, ...] = ()
    ambiguity: str = ""
    warnings: tuple[str, ...] = ()

    def to_force_s(self, video_time_s: ArrayLike) -> Floats:
        """Force clock at these video times, s; NaN stays NaN."""
        return self.offset_s + (1 + 1e-6 * self.drift_ppm) * np.asarray(video_time_s, np.float64)

    def to_video_s(self, force_time_s: ArrayLike) -> Floats:
        """Video time at these times of the force clock, s; NaN stays NaN."""
        return (np.asarray(force_time_s, np.float64) - self.offset_s) / (1 + 1e-6 * self.drift_ppm)

    def _repr_html_(self) -> str:
        def with_error(value: str, error: float, unit: str) -> str:
            return f"{value} ± {two_digits(error)} {unit}" if math.isfinite(error) else f"{value} {unit}"

        rows = {
            "status": f"{self.status} (from {self.how})",
            "offset": with_error(f"{self.offset_s:.4f}", self.offset_err_s, "s"),
            "drift": with_error(f"{self.drift_ppm:.1f}", self.drift_err_ppm, "ppm"),
            "slips": f"{self.matched} matched, {self.unmatched_video} only in the video, "
            f"{self.unmatched_force} only in the force",
        }
        if math.isfinite(self.residual_ms):
            rows["residual"] = f"{self.residual_ms:.2g} ms (median)"
        if math.isfinite(self.margin):
            rows["margin"] = f"{self.margin:.1f} in log-likelihood"
        rows |= {f"warning {k}": line for k, line in enumerate(self.warnings, 1)}
        return html_table("camera's clock to force clock", rows)


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

    The clock is the given offset; without one, a column of the camera's times in the force recording;
    without that, the alignment of the slips that both instruments recorded. A clock that does not come from
    the slips is compared with them, and a contradiction gives a warning.

    Parameters
    ----------
    tracks
        From `track_sheets`.
    force
        From `read_force`.
    sticks
        From `find_stick_slip`.
    offset_s
        Force clock at video time 0, where it is known.
    drift_ppm
        By how much the force clock is faster than the camera's, if `offset_s` is given.
    settings
        See `ClockSettings`.

    Returns
    -------
    The clock. Slips are nearly periodic, so an alignment shifted by whole slips fits nearly as well as the
    right one. The status is "ok" where `align` finds no ambiguity, and "ambiguous" otherwise, or where frames
    have no times of their own and the slips fit nearly as well at another frame rate.

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
        given = Clock(offset_s=offset_s, drift_ppm=drift_ppm, status="given", how="given")
        _check_overlap(tracks, force, given, "`offset_s`")
        clock = _given(tracks, force, sticks, given, settings)
    elif (column := clock_from_column(force)) is not None:
        _check_overlap(tracks, force, column, ForceMetadata.of(force).source)
        clock = _given(tracks, force, sticks, column, settings)
    else:
        clock = _from_slips(tracks, force, sticks, settings)
        if "video_time_s" in force:
            unusable = "the column of video times in the force recording is not usable: the slips are used"
            warnings = (*warnings, unusable)
    return replace(clock, warnings=(*warnings, *clock.warnings))


def _check_overlap(tracks: xr.Dataset, force: xr.Dataset, clock: Clock, about: str) -> None:
    """Raise InputError if this clock puts the video outside the force recording."""
    times = tracks["time_s"].to_numpy()
    times = times[np.isfinite(times)]
    if not len(times):
        source = StripMetadata.of(tracks).source
        raise InputError(source, "a time for each frame", "none", "give `fps` or `timestamps`")
    machine = good_samples(force)["time_s"].to_numpy()
    begin, end = clock.to_force_s([times.min(), times.max()])
    if end < machine[0] or begin > machine[-1]:
        raise InputError(
            about,
            f"a video within the force recording, {machine[0]:.6g} to {machine[-1]:.6g} s",
            f"one from {begin:.6g} to {end:.6g} s on that clock",
            "check `offset_s`, or whether the two files belong together",
        )


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
    video, machine = StripMetadata.of(tracks).source, ForceMetadata.of(force).source
    for about, slips in ((machine, drops), (video, seen)):
        if len(slips) < settings.least_slips:
            need = f"at least {settings.least_slips} slips to align the clocks"
            backwards = about == video and _if_backwards(tracks, drops, settings)
            raise InputError(about, need, f"{len(slips)}", backwards or "give `offset_s`")
    found, advice = _against_film(align(_slip_trains(seen, drops, settings), settings), tracks, drops)
    if found.fits.log_likelihood[0] <= 0:
        raise InputError(
            video,
            "slips at the same times as in the force recording",
            f"{len(seen)} slips that coincide with none of its {len(drops)} at any offset",
            advice or "check whether the two files belong together and `fps`, or give `offset_s`",
        )
    error, drift_error, offset_error = found.errors()
    # The force may fall with the first or with the last of the sheets.
    constant = float(np.hypot(drops["lag_s"].iloc[0], seen["spread_s"].iloc[0] / 2))
    clocks, fits = found.clocks, found.fits
    drift = float(clocks.drift[0])
    clock = _clock_of(found.trains, clocks, fits, "events")
    if found.ambiguity:
        warnings = [f"clocks ambiguous: {found.ambiguity}; {advice or 'give `offset_s`'}"]
    else:
        breaks = find_breaks(tracks, force, seen, drops, found)
        for part in breaks:
            if part.at_end:
                clock = replace(clock, holds_to_s=part.holds_s)
            else:
                clock = replace(clock, holds_from_s=part.holds_s)
        warnings = [part.warning for part in breaks] + _unmatched_warnings(clock, settings)
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


def _against_film(found: Alignments, tracks: xr.Dataset, drops: pd.DataFrame) -> tuple[Alignments, str]:
    """The alignments, ambiguous also where the film contradicts them, and advice on the cause or ""."""
    strip, settings = StripMetadata.of(tracks), found.settings
    if not found.ambiguity and (silent := silent_drops(tracks, drops, found)):
        why = f"the film shows no slip at {silent} drops of the force before or after those in common"
        why += " (lost frames? a clock that jumps?)"
        found = replace(found, ambiguity=why)
    if found.ambiguity and (backwards := _if_backwards(tracks, drops, settings)):
        return found, backwards
    if strip.clock_kind == "file":
        return found, ""
    rate, likelihood = _best_beyond_search(found)
    lead = likelihood - float(found.fits.log_likelihood[0])
    if not found.ambiguity and lead > -settings.least_margin:
        return replace(found, ambiguity="evenly spaced slips fit nearly as well at other frame rates"), ""
    # Evenly spaced slips fit nearly equally well at many rates.
    if found.ambiguity and lead > settings.clear_likelihood:
        scaled = replace(found.trains, video_s=rate * found.trains.video_s)
        if not align(scaled, settings).ambiguity:
            return found, f"the slips agree at {_frame_rate(strip, rate)}: check `fps`"
    return found, ""


def _if_backwards(tracks: xr.Dataset, drops: pd.DataFrame, settings: ClockSettings) -> str:
    """Advice for a film that is played backwards; "" if its slips do not match the force's in reverse."""
    reverse = tracks.isel(frame=slice(None, None, -1))
    seen = video_slips(reverse.assign_coords(time_s=-reverse["time_s"]), settings=settings)
    if (
        min(len(seen), len(drops)) < settings.least_slips
        or align(_slip_trains(seen, drops, settings), settings).ambiguity
    ):
        return ""
    return "the slips match those of the force in reverse order: the film is played backwards"


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
    only_video = (fits.partner[0] < 0) & (seen_s > first) & (seen_s < last)
    return Clock(
        offset_s=float(clocks.offset_s[0]),
        drift_ppm=1e6 * float(clocks.drift[0]),
        residual_ms=1e3 * float(nan_median(np.abs(fits.residual_s[0]))),
        matched=int(fits.matched[0]),
        unmatched_video=int(fits.video[0] - fits.matched[0]),
        unmatched_force=int(fits.force[0] - fits.matched[0]),
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
    if min(len(seen), len(drops)) < settings.least_slips:  # too few for an alignment of their own
        backwards = _if_backwards(tracks, drops, settings)
        return replace(given, warnings=(backwards,) if backwards else ())
    return replace(given, warnings=_contradiction(given, align(trains, settings)))


def _contradiction(given: Clock, found: Alignments) -> tuple[str, ...]:
    """Warning that the slips do not match a given clock; empty where they do."""
    centre = found.clocks.centre_s[0]
    difference = float(found.clocks.middle_s[0] - given.to_force_s(centre))
    error = float(np.hypot(found.errors()[0], found.trains.typical_error_s))
    if not found.ambiguity and abs(difference) > found.settings.contradiction_sigma * error:
        return (
            f"according to the slips the force clock is {found.clocks.offset_s[0]:.4f} s at video time 0, "
            f"not {given.offset_s:.4f} s (margin {found.margin:.0f})",
        )
    return tuple(_unmatched_warnings(given, found.settings))


# --- slips at the beginning or end of the film that only one of the two recordings shows --------------------


@dataclass(frozen=True)
class Break:
    """Where at one end the slips stop to agree."""

    holds_s: float  # force clock between the last slip of the agreeing part and the next drop beyond it
    slip_s: float  # force clock of that last slip
    at_end: bool  # the slips disagree after it, else before it
    film: int  # number of slips of the film beyond it that match no drop
    force: int  # number of drops beyond it that match no slip of the film

    @property
    def warning(self) -> str:
        """Line for the user."""
        alone = {"slip": (self.film, "of the film"), "drop": (self.force, "of the force")}
        found = " and ".join(f"{counted(count, noun)} {of}" for noun, (count, of) in alone.items() if count)
        return (
            f"{'after' if self.at_end else 'before'} {self.slip_s:.6g} s of the force clock, {found} without"
            " a match in the other recording, unlike the rest: samples or frames may be lost there, or a"
            " clock jumps; stick phases there are left out"
        )


@dataclass(frozen=True)
class _Slips:
    """The slips of both recordings in order of time, a pair as one, (slips,) each."""

    time_s: Floats  # on the force clock
    of_force: Bools
    of_film: Bools

    def part(self, which: Bools | Ints) -> _Slips:
        """The selected ones."""
        return _Slips(self.time_s[which], self.of_force[which], self.of_film[which])

    @property
    def reverse(self) -> _Slips:
        """These slips with time running backwards."""
        return _Slips(-self.time_s[::-1], self.of_force[::-1], self.of_film[::-1])


def silent_drops(tracks: xr.Dataset, drops: pd.DataFrame, found: Alignments) -> int:
    """Number of drops of the force, at the beginning or end of the film, that the film does not show in time.

    0 where all of them may have been missed at random, as some are among the others.  Otherwise frames are
    lost or one of the clocks jumps, so that the alignment holds only in part of the film.  Slips that the
    film shows alone count up to the number of the drops that it does not show, because a film also shows
    slips that leave the force unchanged.
    """
    slips, settings = _all_slips(_frames_s(tracks, found), drops, found, None), found.settings
    first, last = drops["time_s"].to_numpy()[[0, -1]]
    slips = slips.part(slips.of_force | (slips.time_s > first) & (slips.time_s < last))
    silent = 0
    for each in (slips, slips.reverse):
        lead = _lead(each, settings, limited=True)
        if lead.max(initial=0.0) > settings.least_margin:
            silent += int(np.sum(~each.of_film[: int(np.argmax(lead)) + 1]))
    return silent


def find_breaks(
    tracks: xr.Dataset, force: xr.Dataset, seen: pd.DataFrame, drops: pd.DataFrame, found: Alignments
) -> list[Break]:
    """Where, at the beginning and at the end of the film, the slips do not agree as the others do.

    Unlike in `silent_drops`, large slips that only the film shows count as much as drops that only the force
    shows, while the force is recorded; fewer are enough, and fewest beside a gap of the recording.
    """
    frame_s = _frames_s(tracks, found)
    slips = _all_slips(frame_s, drops, found, seen)
    time = force["time_s"].to_numpy()
    flag = force["flag"].to_numpy() if "flag" in force else np.full(time.shape, "ok")
    recorded = time[usable(flag)]
    slips = slips.part((slips.time_s > recorded[0]) & (slips.time_s < recorded[-1]))
    common = max(frame_s[0], recorded[0]), min(frame_s[-1], recorded[-1])
    before, after = _gaps(time, flag)
    forwards = _break(slips, drops, found, after[after > common[0]], 1)
    backwards = _break(slips.reverse, drops, found, -before[before < common[1]], -1)
    return [each for each in (forwards, backwards) if each]


def _break(slips: _Slips, drops: pd.DataFrame, found: Alignments, gap_s: Floats, sign: int) -> Break | None:
    """The break at the beginning (sign 1), or at the end (-1) of slips in reverse.

    gap_s: the ends of the recording's gaps in the film, in reverse for sign -1.
    """
    settings, period = found.settings, found.trains.period_s
    lead = _lead(slips, settings)
    last = int(np.argmax(lead)) if lead.size else 0
    agreeing = last + 1 + np.flatnonzero((slips.of_film & slips.of_force)[last + 1 :])
    if not lead.max(initial=0.0) > settings.least_gap_lead or not agreeing.size:
        return None
    slip = float(slips.time_s[agreeing[0]])
    if not lead.max() > settings.least_end_lead and not (gap_s < slip).any():
        return None
    drop = np.sort(sign * drops["time_s"].to_numpy())
    earlier = drop[drop < slip - period / 4].max(initial=slip - period)
    outside = slips.part(np.arange(lead.size) <= last)
    film, force = int(np.sum(~outside.of_force)), int(np.sum(~outside.of_film))
    return Break(sign * 0.5 * (earlier + slip), sign * slip, sign < 0, film, force)


def _gaps(time_s: Floats, flag: Strings) -> Floats:
    """The samples before and after each gap, and where the time steps back, (2, gaps), s."""
    good = np.flatnonzero(usable(flag))
    backwards = np.cumsum(flag == "backwards")[good]
    after = np.flatnonzero((flag[good][1:] == "gap") | (np.diff(backwards) > 0)) + 1
    return np.stack([time_s[good[after - 1]], time_s[good[after]]])


def _frames_s(tracks: xr.Dataset, found: Alignments) -> Floats:
    """Times of the frames that show enough sheets, in order, on the force clock, s."""
    time = tracks["time_s"].to_numpy()
    shown = np.isfinite(tracks["x_px"].to_numpy()).mean(axis=1) >= found.settings.least_sheets
    return np.sort(found.clocks.map(time[shown & np.isfinite(time)])[0])


def _all_slips(frame_s: Floats, drops: pd.DataFrame, found: Alignments, seen: pd.DataFrame | None) -> _Slips:
    """The slips of film and force; without those that the other recording may not show.

    frame_s: from `_frames_s`.
    These are small drops, in which the sheets may move too little, drops between distant frames, and, where
    `seen` is given, small slips of the film.
    """
    partner = found.fits.partner[0]
    drop_s, size = drops["time_s"].to_numpy(), drops["drop_N"].to_numpy()
    next_frame = np.clip(np.searchsorted(frame_s, drop_s), 1, len(frame_s) - 1)
    filmed = (drop_s > frame_s[0]) & (drop_s < frame_s[-1])
    filmed &= frame_s[next_frame] - frame_s[next_frame - 1] < 2 * np.median(np.diff(frame_s))
    paired = np.isin(np.arange(len(drop_s)), partner[partner >= 0])
    filmed &= paired | ~(size < 0.5 * nan_median(size[paired]))
    alone = partner < 0
    if seen is not None:
        step = seen["step_px"].to_numpy()
        alone &= ~(step < 0.5 * nan_median(step[partner >= 0]))
    alone_s = found.clocks.map(found.trains.video_s)[0][alone]
    of_film = np.r_[paired[filmed], np.ones(alone_s.size, dtype=bool)]
    of_force = np.arange(of_film.size) < filmed.sum()
    time_s = np.r_[drop_s[filmed], alone_s]
    return _Slips(time_s, of_force, of_film).part(np.argsort(time_s, kind="stable"))


def _lead(slips: _Slips, settings: ClockSettings, *, limited: bool = False) -> Floats:
    """Log-likelihood that the slips up to each one pair by chance, minus that they pair as the later ones.

    limited: slips of the film alone count up to the number of drops of the force alone.
    """
    silent, alone = np.cumsum(~slips.of_film), np.cumsum(~slips.of_force)
    matched = np.cumsum(slips.of_film & slips.of_force)
    if limited:
        alone = np.minimum(alone, silent)
    rest: Ints = (matched + silent)[-1:] - matched - silent
    by_chance = settings.paired_by_chance
    missed = (silent[-1:] - silent + 1) / (rest + 2)
    false_rest: Ints = np.sum(~slips.of_force) - alone
    false = (false_rest + 1) / (rest + false_rest + 2)
    lead = silent * np.log((1 - by_chance) / missed)
    lead += alone * np.log(np.maximum((1 - by_chance) / false, 1))
    lead += matched * np.log(by_chance**2 / (1 - missed))  # both a drop and a slip of the film
    return np.asarray(lead)


# --- a column of video times in the force recording ---------------------------------------------------------


def clock_from_column(force: xr.Dataset) -> Clock | None:
    """Return the clock that the video times in the testing machine's recording lie on.

    A value is repeated until the next frame arrives, so only its first sample counts. Values more than 5 σ
    off the line are left out. None without a usable column: it needs ten different values, and a rate
    within 2 % of the machine's.
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
    centre = float(np.median(video))
    slope, middle = _robust_line(video - centre, machine)
    if not abs(slope - 1) <= 0.02:
        return None
    return Clock(
        offset_s=middle - slope * centre,
        drift_ppm=1e6 * (slope - 1),
        status="given",
        how="video time column",
    )


def _robust_line(x: Floats, y: Floats) -> tuple[float, float]:
    """Slope and intercept without outliers, starting from the median of slopes across half the data.

    NaN where x does not rise from the first half to the second.
    """
    half = len(x) // 2
    rise, run = y[-half:] - y[:half], x[-half:] - x[:half]
    if not np.any(run > 0):  # the video times start again
        return math.nan, math.nan
    slope = float(np.median(rise[run > 0] / run[run > 0]))
    intercept = float(np.median(y - slope * x))
    for _ in range(10):
        residual = np.abs(y - intercept - slope * x)
        used = residual <= 5 * max(float(sigma_about_zero(residual)), 1e-6)
        if not np.ptp(x[used]) > 0:
            break
        slope, intercept = (float(c) for c in np.polyfit(x[used], y[used], 1))
    return slope, intercept
