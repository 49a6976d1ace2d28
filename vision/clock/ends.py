"""Slips at the beginning or end of the film that only one of the two recordings shows.

Where samples or frames are lost, or a clock jumps, an alignment holds on one side of the place only. If few
slips lie on the other side, the alignment is that of the many, and those few are left without partners.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
import xarray as xr

from vision.clock.alignment import Alignments
from vision.clock.settings import ClockSettings
from vision.errors import counted
from vision.force.recording import usable
from vision.numeric import Bools, Floats, Ints, Strings, nan_median


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
