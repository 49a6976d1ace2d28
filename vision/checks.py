"""Warnings that only the tracks or several stages show: what is missing or doubtful, and contradictions."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
import xarray as xr

from vision.data import FlagCounts, StripMetadata, TrackMetadata, Tunable
from vision.errors import counted, first_of
from vision.models.equations import effective_sheets
from vision.numeric import (
    Bools,
    Floats,
    Ints,
    Pixels,
    nan_median,
    nan_quantile,
    stretches,
    typical,
    typical_median,
)
from vision.sample import Sample
from vision.sheets.corrections import Correction, decision_texts, ordered, sheet_name, sheet_names
from vision.sheets.numbering import ends_in_view
from vision.sheets.order import out_of_turn, shown_before, wrong_period
from vision.sheets.recovery import LONG_GAP, WITHOUT_RIDGE, missing_stretches
from vision.sheets.reference import static_ridges
from vision.sheets.settings import DEFAULT as TRACKING
from vision.sheets.settings import TrackingSettings
from vision.sheets.tracks import comb_is_stationary
from vision.video.reader import BETWEEN_FRAMES
from vision.words import is_word

if TYPE_CHECKING:
    from vision.models import ModelFits
    from vision.shells import ShellSettings
    from vision.video import VideoSettings


@dataclass(frozen=True, kw_only=True, repr=False)
class CheckSettings(Tunable):
    """Tunable constants of these warnings, and of the advice if no ridges are found."""

    most_saturated: float = 0.5
    """Share of saturated pixels above which they are named as the reason why no ridges are found.  Smaller
    blames a bright background; larger lets a saturated picture pass as one without sheets."""
    most_left_out: float = 0.1
    """Share of the positions left out above which a warning doubts others, too.  Larger gives no advice if a
    hand always covers part of the comb; smaller advises on gaps that harm nothing else."""
    usual_missing: float = 0.01
    """Share of the positions that may be missing without a warning.  Smaller warns of the usual gaps at the
    edges of the picture; larger overlooks sheets that are lost for a while."""
    second_comb: float = 2.0
    """Error by a second comb over the sheets, over that of the noise, from which a warning names it.  Larger
    is silent about reflections that double the errors; smaller warns where they matter little."""
    few_measured: float = 0.5
    """Share of the positions that are measured below which a warning doubts that there is a comb of sheets.
    Films of streets, animals and faces reach 0.49; larger doubts combs that something hides for long."""
    changed_px: float = 0.1
    """Error of most positions of a frame, px, from which a warning counts the frame, where ridges look unlike
    usual.  Smaller names errors well below a sheet's sweep; larger is silent where the light moves from one
    side of the sheets to the other (`test_ridges_lit_from_the_other_side_are_named`)."""
    changed_frames: float = 0.05
    """Share of the frames that such a stretch, and such ridges, must have for the warning.  Smaller warns of
    slips; larger overlooks a light that moves shortly before the film ends."""
    seen_between: float = 0.05
    """Share of the frames with a further ridge between most sheets above which a warning says so.  Smaller
    warns of frames in which two images overlap; larger is silent where a film shows the blocks together only
    at its beginning (`test_sheets_that_leave_early_are_named`)."""
    gap_depth: float = 0.4
    """Depth of the gaps between ridges, over the ridges' height above the background, below which a warning
    says that neighbours may be merged: 0.6 or more in focus.  Smaller overlooks films of which half of the
    sheets are seen; larger warns of dense combs (`test_sheets_out_of_focus_are_said_to_merge`)."""
    pair_spacings: int = 9
    """Smallest number of spacings in which pairs of ridges are looked for.  Fewer may alternate by chance;
    more leave out small combs."""
    pair_tail: float = 0.1
    """Quantile of the wide spacings, and from above of the narrow ones, that is compared by `pair_ratio`.
    Smaller lets a single spacing decide; larger calls an uneven comb one of pairs."""
    pair_ratio: float = 1.5
    """Ratio of these quantiles from which ridges form pairs.  Smaller calls an uneven comb one of pairs;
    larger misses the edges of thick sheets (`test_two_edges_of_every_sheet_are_said_to_be_pairs`)."""
    pair_motion: float = 2.0
    """Ridges also form pairs if the spacings beside every second one change by this factor more than that
    does.  Single sheets reach 1.4, two edges of every sheet 3 or more.  Smaller calls noise pairs."""
    odd_width: float = 1.75
    """Width of a ridge, over the median, above which it may be something else: sheets stay below 1.5, ridges
    between pairs and gaps taken for sheets exceed 1.9.  Smaller doubts sheets of an uneven block."""
    end_height: float = 0.25
    """Height of an outermost sheet over that of the next two, each in its noise, below which it may be
    something else: ends of reflections have 0.06 to 0.25. Larger doubts dim sheets, smaller lets more of
    these pass (`test_the_end_of_a_reflection_beyond_the_comb`)."""
    end_still: float = 0.25
    """Motion of an outermost sheet, over that of the next two, below which it may be something else, as edges
    of the background with 0 to 0.1. Larger doubts sheets that stick to something outside."""
    end_moves: float = 2.5
    """Motion of those two, in errors of a position, from which that is judged. Smaller judges noise; larger
    leaves edges beside sheets that hardly move (`test_a_still_edge_beyond_the_comb` at 5)."""
    end_in_view: float = 0.25
    """Share of the frames that must show both from which that is judged. Smaller judges few frames, larger
    leaves edges beside sheets often lost (`test_stripes_of_the_background_that_continue_the_comb` at 0.8)."""
    unequal_sides: float = 1.3
    """Ratio of the sheets on the two sides, less two sheets, above which an axis found from motion is
    questioned.  Smaller questions samples in which some sheets are dark; larger lets axes pass that follow
    the camera (`test_an_axis_that_the_camera_moves`)."""
    unlikely_spacing: float = 10.0
    """Ratio of the sheets' spacing to two thicknesses, or its inverse, above which the pixel size is
    questioned.  A wrong unit changes it by 1000, bulging sheets by 2 to 4; larger overlooks factors of 10."""
    least_spacing_um: float = 1.0
    """Spacing below which the pixel size is questioned though the sheets' thickness is not known: light
    hardly resolves less.  Larger would question discs of a muscle, 1.8 µm apart."""


DEFAULT = CheckSettings()


# --- warnings about the tracks ------------------------------------------------------------------------------


DOUBTFUL = {
    "doubtful": "where the identity of the sheet is uncertain",
    "merged": "where a sheet shares a ridge with another or a mark",
}
"""Flags of positions that are left out because they may belong to another sheet, and why."""


def tracking_warnings(
    tracks: xr.Dataset, settings: CheckSettings = DEFAULT, tracking: TrackingSettings = TRACKING
) -> list[str]:
    """Return warnings about polarity, frozen, lost, misplaced or mixed frames, doubtful or missing positions,
    motion, a second comb, missed sheets."""
    return list(_of_tracks(tracks, settings, tracking))


def _of_tracks(tracks: xr.Dataset, settings: CheckSettings, tracking: TrackingSettings) -> Iterator[str]:
    found, flags = TrackMetadata.of(tracks), FlagCounts(tracks)
    yield from _polarity(found)
    total = max(1, flags.total())
    if frozen := flags.frozen_frames:
        copies = f"{counted(frozen, 'frame')} repeated from the frame before"
        yield f"{copies}, without positions (flag frozen)"
    yield from _wrong_moments(tracks, found, tracking)
    # frozen, blank and lost frames, and decisions, say nothing about the comb
    share = flags.measured / max(1, flags.measured + flags.of((*DOUBTFUL, *WITHOUT_RIDGE)))
    if share < settings.few_measured:
        strip = StripMetadata.of(tracks)
        yield (
            f"only {100 * share:.0f} % of the positions are measured: what is found in rows"
            f" {strip.strip_z0}:{strip.strip_z1} may be no comb of sheets: look at the film, and give where"
            " they are (`rows`, `columns`, `frames`) or how the picture lies (`rotate`)"
        )
    if uncertain := flags.of(DOUBTFUL):
        line = f"{uncertain} of {total} positions left out{why_left_out(flags)}"
        if uncertain > settings.most_left_out * total:
            jumps = 2 * is_word(tracks["why"], "jump").sum() > uncertain
            line += "; with so many, other positions may also be wrong: " + (
                "film an end of the comb, mark a sheet or film faster, as the comb jumps by unknown pitches"
                if jumps
                else "check where the tracks lie, and exclude what hides the comb with `frames` or `columns`"
            )
        yield line
    if (missing := flags.of(WITHOUT_RIDGE)) > settings.usual_missing * total:
        named = ", ".join(f"{flags[flag]} {flag}" for flag in WITHOUT_RIDGE if flags[flag])
        where = longest_stretches(missing_stretches(tracks), "flag")
        line = f"{missing} of {total} positions missing (flag in tracks.csv: {named})"
        yield f"{line}: {where}" if where else line
    yield from _frames_with_few_sheets(tracks)
    yield from _still(tracks, tracking, measured="ok" in flags)
    yield from _second_comb(tracks, found, settings)
    yield from _changed_shape(tracks, found, settings)
    if found.noise_lasts:
        yield (
            "the noise of each frame resembles that of the frame before (correlation"
            f" {found.noise_lasts:.2f}): frames were averaged in time, so that positions lag behind in slips,"
            " which x_err_px includes roughly: switch off the camera's noise reduction"
        )
    if steps := found.large_steps:
        yield (
            "the sheets look alike and neither end of the comb is in view: displacements of the whole comb"
            f" may be wrong by multiples of the spacing ({found.pitch_px:.1f} px) after its large steps"
            f" before {_frames(steps)}: film an end of the comb, or mark a sheet"
        )
    if unseen := found.unseen_jumps:
        yield (
            f"the brightnesses along the comb moved on by sheets before {_frames(unseen)}, but the sheets"
            " seem to stay, and neither end of the comb is in view:"
            " displacements of the whole comb may be wrong by multiples of the spacing"
            f" ({found.pitch_px:.1f} px) from there on: film an end of the comb, or mark a sheet"
        )
    if found.gap_depth < settings.gap_depth and found.sheets_how == "found":
        yield (
            f"the gaps between ridges are only {100 * found.gap_depth:.0f} % as deep as the background beside"
            " the comb: out of focus, or the sheets touch, and neighbours may be seen as one: focus the"
            f" camera, and confirm the {found.sheets} ridges found with `sheets`"
        )
    yield from _spacings(tracks, found, settings)


def _wrong_moments(tracks: xr.Dataset, found: TrackMetadata, tracking: TrackingSettings) -> Iterator[str]:
    """Warn of frames that are missing, in the wrong order, shown twice, or mixed from two."""
    x_px, err_px, frame = (tracks[name].values for name in ("x_px", "x_err_px", "frame"))
    repeats = shown_before(x_px)
    if count := len(repeats.rows):
        again, earlier = (first_of(frame[rows].tolist(), 5) for rows in repeats)
        yield (
            f"{counted(count, 'frame')} ({again}) repeat an earlier picture ({earlier}) with its noise: a"
            " part of the film was written again, and the times from there on may be wrong, unless the film"
            " was computed without noise: use it as the camera recorded it, or leave such frames out with"
            " `frames`"
        )
    if period := wrong_period(x_px, err_px, tracking):
        yield (
            f"in each {period} successive frames the order is wrong, since all sheets go back within them by"
            " whole steps of their creep: positions belong to other times than stated: record or convert the"
            " film again, with its frames in the order of display"
        )
    advances = out_of_turn(x_px, err_px, tracks["time_s"].values, tracking)
    if count := len(advances.rows):
        low, high = (f"{value:.2g}" for value in (advances.frames.min(), advances.frames.max()))
        yield (
            f"before {counted(count, 'frame')} ({first_of(frame[advances.rows].tolist(), 5)}) the sheets"
            f" advance at once as far as they creep in {low if low == high else f'{low} to {high}'} frames:"
            " frames are missing there, or in another order, and the times of the film are wrong: give the"
            " camera's own times with `timestamps`, check the order of the files that the film was made of,"
            " or record again"
        )
    if found.mixed_frames and not found.noise_lasts:
        yield (
            f"{100 * found.mixed_frames:.0f} % of the frames are mixed from two, as when the frame rate was"
            " converted: positions there lie between those of two moments, by more than x_err_px where sheets"
            " move: use the film as the camera recorded it"
        )


def _frames(numbers: Sequence[int]) -> str:
    """Return "frame 3", or "frames 3, 5"."""
    return f"{'frame' if len(numbers) == 1 else 'frames'} {first_of(numbers, 5)}"


def longest_stretches(table: pd.DataFrame, why: str) -> str:
    """Return the longest three stretches of a table of `vision.sheets.recovery` as text, "" without any.

    Sheets with the same frames and reason, in the column `why`, count as one stretch.
    """
    alike = [rows for _, rows in table.groupby(["first_frame", "last_frame", why], sort=False)]
    longest = sorted(alike, key=lambda rows: -int(rows["frames"].sum()))
    texts = [
        f"{_sheet_range(rows)} in frames {rows['first_frame'].iloc[0]}:{rows['last_frame'].iloc[0] + 1}"
        f" ({rows[why].iloc[0]})"
        for rows in longest[:3]
    ]
    return "; ".join(texts) + (" …" if len(alike) > 3 else "")


def _sheet_range(rows: pd.DataFrame) -> str:
    """Return "left 13 (index 12)", or "4 sheets between index 3 and 9"."""
    if len(rows) == 1:
        return sheet_name(*rows.iloc[0][["side", "n", "sheet"]])
    return f"{len(rows)} sheets between index {rows['sheet'].min()} and {rows['sheet'].max()}"


def _polarity(found: TrackMetadata) -> Iterator[str]:
    """Warn if the ridges of the other polarity may be sheets, too, or instead."""
    other = _other_polarity(found)
    if found.ridges_alternate == "yes":
        yield (
            "bright and dark ridges lie in turn on a ground between them, and only the"
            f" {found.ridges} ones are taken for sheets: if the {other} ones are sheets, too, n and the stiff"
            " shell count every second sheet: look at the film, and track both in two runs, with `ridges` as"
            " bright and as dark"
        )
    elif found.ridges_doubt:
        yield (
            f"the {found.ridges} stripes are taken for the sheets, but may be the gaps: {found.ridges_doubt}:"
            f" look at the film, and give `ridges` as {found.ridges} or {other}"
        )


def _other_polarity(found: TrackMetadata) -> str:
    return "bright" if found.ridges == "dark" else "dark"


def why_left_out(flags: Mapping[str, int]) -> str:
    """Return why positions are left out, with the number for each reason if there are several."""
    counts = {why: flags[flag] for flag, why in DOUBTFUL.items() if flags.get(flag)}
    if len(counts) == 1:
        return f" {next(iter(counts))}"
    return ": " + ", ".join(f"{count} {why}" for why, count in counts.items())


def _still(tracks: xr.Dataset, settings: TrackingSettings, *, measured: bool) -> Iterator[str]:
    """Warn if neither motion nor noise is seen, or only noise."""
    frames = tracks.sizes["frame"]
    if frames < 3:
        yield f"only {counted(frames, 'frame')}: neither motion nor noise can be measured"
    elif frames >= 10 and measured and not (tracks["x_noise_px"].values > 0).any():
        if np.ptp(np.nan_to_num(tracks["x_px"].values), axis=0).any():
            yield (
                "most positions do not change from one frame to the next: the film has too few grey levels,"
                " or its noise was removed, so that the errors cannot be measured"
            )
        else:
            yield "all frames are equal: neither motion nor noise can be measured"
    elif frames >= 20 and measured and comb_is_stationary(tracks, settings):
        yield (
            "hardly any sheet moves relative to the others by more than the noise: if more should, the comb"
            " may be a pattern in the background (`rows`, `columns`), or the pull is in other `frames`"
        )


def _with_picture(tracks: xr.Dataset) -> Bools:
    """Return which frames have a picture of their own, (frame,)."""
    return np.asarray(~is_word(tracks["flag"], "frozen", "blank", "corrupt", "lost").all(axis=1))


def _frames_with_few_sheets(tracks: xr.Dataset) -> Iterator[str]:
    """Warn if fewer than half of the sheets are found in many successive frames."""
    few = _with_picture(tracks) & (is_word(tracks["flag"], *WITHOUT_RIDGE).mean(axis=1) > 0.5)
    length, where = _longest_run(tracks, few)
    if length < LONG_GAP:
        return
    yield (
        f"fewer than half of the sheets are found in {few.sum()} frames (the longest run is {where}): another"
        " scene, or something in front of the sheets? exclude these frames with `frames`"
    )


def _longest_run(tracks: xr.Dataset, marked: Bools) -> tuple[int, str]:
    """Return the number of frames in the longest run of marked ones, (frame,), and which: "40:55"; 0 and ""
    for none."""
    _, first, stop = stretches(marked[:, None])
    if not len(first):
        return 0, ""
    longest, number = int(np.argmax(stop - first)), tracks["frame"].values
    return int(stop[longest] - first[longest]), f"{number[first[longest]]}:{number[stop[longest] - 1] + 1}"


def _noise_px(tracks: xr.Dataset) -> float:
    """Return the usual noise of a position, px."""
    # a codec hides the noise of pixels, from which the latter is predicted
    return float(nan_median(np.fmax(tracks["x_noise_px"].values, tracks["x_predicted_px"].values)))


def _second_comb(tracks: xr.Dataset, found: TrackMetadata, settings: CheckSettings) -> Iterator[str]:
    """Warn of a second comb whose error exceeds that of the noise."""
    if not found.second_comb_err_px or not {"x_noise_px", "x_predicted_px"} <= set(tracks):
        return
    if found.second_comb_err_px > settings.second_comb * _noise_px(tracks):
        yield (
            f"light moves between the ridges and the gaps beside them (by {100 * found.second_comb:.1f} % of"
            " the ridges' height): a reflection, a second comb or haze lies over the sheets, or they lean;"
            f" x_err_px includes {found.second_comb_err_px:.2g} px for it: look at the film, and keep"
            " reflections out"
        )


def _changed_shape(tracks: xr.Dataset, found: TrackMetadata, settings: CheckSettings) -> Iterator[str]:
    """Warn of frames in which most ridges look unlike usual, and positions may be off by far."""
    if "distorted" not in tracks or nan_median(tracks["distorted"].values) < settings.changed_frames:
        return
    err = nan_median(np.where(is_word(tracks["flag"], "ok"), tracks["x_err_px"].values, np.nan), axis=1)
    least = max(settings.changed_px, 3 * _noise_px(tracks))
    changed = err > np.hypot(least, found.second_comb_err_px)  # which has its own warning
    length, where = _longest_run(tracks, changed)
    if length > settings.changed_frames * len(changed):
        yield (
            f"most ridges look unlike usual in {100 * changed.mean():.0f} % of the frames (the longest run"
            f" is {where}): the light or the focus changed, or something lies over the strip. Positions there"
            f" may be off by {nan_median(err[changed]):.2g} px or twice as much, which x_err_px includes"
            " roughly: look at the film, and analyse the parts before and after with `frames`"
        )


def _spacings(tracks: xr.Dataset, found: TrackMetadata, settings: CheckSettings) -> Iterator[str]:
    """Warn of ridges in pairs, which keep their distance or whose narrow and wide spacings alternate, or of
    missing sheets; no pairs are reported if the number of sheets was given."""
    apart = np.diff(tracks["x_px"].values, axis=1)
    spacing = nan_median(apart)
    if np.isfinite(spacing).sum() >= settings.pair_spacings and found.sheets_how == "found":
        least = typical(tracks["x_err_px"].values)
        change = np.fmax(np.sqrt(nan_median((apart - spacing) ** 2)), least)
        beside = np.pad(change, 1, constant_values=np.nan)
        ratio = np.fmin(beside[:-2], beside[2:]) / change
        keep_distance = max(nan_median(ratio[k::2]) for k in (0, 1)) > settings.pair_motion
        alternate = _alternating(spacing, settings)
        if alternate or keep_distance:
            yield (
                f"the ridges form pairs: {alternate or 'only every second spacing changes'}; if each"
                " pair is the two edges of one sheet, n and the stiff shell count edges, two for each sheet:"
                f" look at the film, and try `ridges` as {_other_polarity(found)}; if not, give `sheets` as"
                f" {len(spacing) + 1}"
            )
            return
    if not found.wide_spacings:
        return
    assumed = found.axis_how == "geometry"
    axis = ", and the axis, only the middle of the comb, and with it n of both sides may be wrong"
    give = ", give the axis (`axis_px`)"
    yield (
        f"sheets may be missing at x = {', '.join(found.wide_spacings)}: n of the sheets further out would"
        f" then be too small{axis * assumed}: check these positions (dirt, faint sheets){give * assumed}, and"
        f" count them by [[add]] in `corrections`, or confirm the {found.sheets} ridges found with `sheets`"
    )


def _alternating(spacing_px: Floats, settings: CheckSettings) -> str:
    """Return which narrow and wide spacings (N − 1,) alternate, or ""; also without one of the ridges, as one
    between two pairs shifts all pairs that follow."""
    place, ridge = np.arange(len(spacing_px) - 1), np.arange(1, len(spacing_px))[:, None]
    without = spacing_px[place + (place >= ridge)] + np.where(place == ridge - 1, spacing_px[ridge], 0.0)
    tail = settings.pair_tail
    for tried in (spacing_px[None], without)[: 2 if len(place) >= settings.pair_spacings else 1]:
        one, other = tried[:, 0::2], tried[:, 1::2]
        low, other_low = (nan_quantile(part, tail, axis=1) for part in (one, other))
        high, other_high = (nan_quantile(part, 1 - tail, axis=1) for part in (one, other))
        apart = np.nan_to_num(np.maximum(low / other_high, other_low / high))
        best = int(apart.argmax())
        if apart[best] > settings.pair_ratio:
            narrow, wide = sorted((nan_median(one[best]), nan_median(other[best])))
            but = f", but for the ridge of index {best + 1}" if len(tried) > 1 else ""
            return f"spacings of {narrow:.0f} and {wide:.0f} px alternate{but}"
    return ""


def decision_warnings(tracks: xr.Dataset, corrections: Sequence[Correction]) -> list[str]:
    """Return warnings of manual swaps and assignments that let a sheet jump by over half a pitch, against the
    others: an identity that was right is wrong then."""
    x_px, frame = tracks["x_px"].values, tracks["frame"].values
    pitch, lines = TrackMetadata.of(tracks).pitch_px, []
    done = ordered(corrections)
    texts = decision_texts(done, sheet_names(tracks["side"].values, tracks["n"].values))
    for one, text in zip(done, texts, strict=True):
        if one.kind not in ("swap", "assign"):
            continue
        ends = [np.searchsorted(frame, end) for end in (one.first, one.stop) if end is not None]
        for row in (row for row in ends if 0 < row < len(frame)):
            step = x_px[row] - x_px[row - 1]
            step = step - nan_median(step)
            if jumped := [k for k in one.sheets if k < step.size and abs(step[k]) > pitch / 2]:
                far = " and ".join(f"{step[k] / pitch:+.1f}" for k in jumped)
                lines.append(
                    f"{text}: in frame {frame[row]} this moves them by {far} pitches against the other"
                    " sheets: look at the tracks there"
                )
    return lines


def overexposure(frame: Pixels, rows: slice, settings: VideoSettings, *, dark: bool = False) -> list[str]:
    """Return a warning if many of the averaged pixels are saturated, so that ridges have flat tops, or `dark`
    ones have clipped flanks: within 0.4 % of the 99.9 % quantile, as a camera of 12 bits in a file of 16, or
    a codec's white, saturates below the largest value that the file could hold."""
    pixels = frame[rows]
    top = float(np.quantile(pixels, 0.999))
    share = float((np.abs(pixels.astype(np.float32) - top) <= top / 255).mean())
    if share < settings.overexposed or top < settings.few_levels:
        return []
    where = f"{100 * share:.0f} % of the averaged pixels are as bright as the brightest ({top:.0f})"
    if dark:
        return [
            f"{where}: the bright ground is clipped, and perhaps the flanks of the dark ridges, so that"
            " x_err_px may be too small: film with less light, or with more if the film is a negative"
        ]
    return [
        f"{where}: overexposed. Ridges have flat tops and x_err_px may be too small: film with less light"
    ]


# --- warnings about results that contradict each other ------------------------------------------------------


def consistency_warnings(
    tracks: xr.Dataset,
    sample: Sample | None = None,
    *,
    assumed: Sample | None = None,
    pixel_size_um: float | None = None,
    columns: Floats | None = None,
    settings: CheckSettings = DEFAULT,
) -> list[str]:
    """Return warnings about findings that contradict each other, each with what to do about it.

    sample: the given sample, which is compared with the ridges per side and their spacing.
    assumed: the sample that is assumed if none was given.
    columns: the columns of I(x,t), px; None where they are not known, so that the comb's ends may be outside.
    """
    found, used, most = TrackMetadata.of(tracks), sample or assumed, int(tracks["n"].max())
    lines = list(_comb_warnings(tracks, found, settings))
    one_side = len(np.unique(tracks["side"].values)) == 1
    one_at_most = used is not None and tracks.sizes["sheet"] <= used.sheets_per_block
    ends_px = _outermost_px(tracks)
    axis_in_comb = ends_px[0] < found.axis_low_px and found.axis_high_px < ends_px[1]
    if one_at_most and found.axis_how == "geometry" and not axis_in_comb:
        lines.append(
            "the motion does not show where the axis is, and the middle of the ridges is assumed: if only one"
            " side is in view, side and n of all sheets are wrong: look at overview.png, and give `axis_px`"
        )
    if used is not None and one_side and found.axis_how != "given" and most < used.sheets_per_block:
        lines.append(
            f"only {most} of {used.sheets_per_block} sheets of one side are in view, and n counts from the"
            " innermost of them: if others lie between it and the axis, n and the stiff shell are too small"
            " by their number: give `axis_px`"
        )
    view_px = None if columns is None else (columns[0], columns[-1])
    in_view = ends_in_view(ends_px, view_px, found.pitch_px)
    lines += _side_warnings(tracks["side"].values, found, used, in_view, settings)
    spacing = math.nan if pixel_size_um is None else found.pitch_px * pixel_size_um / 1000
    if used is None and 1000 * spacing < settings.least_spacing_um:
        lines.append(
            f"with this pixel size, the sheets are {1000 * spacing:.2g} µm apart, closer than paper is thick:"
            " check `pixel_size_um` (µm)"
        )
    ratio = math.nan if used is None else spacing / (2 * used.thickness_mm)
    if used is not None and (ratio <= 1 / settings.unlikely_spacing or ratio >= settings.unlikely_spacing):
        lines.append(
            f"with this pixel size, sheets {used.thickness_mm:g} mm thick are {spacing:.3g} mm apart: check"
            " `pixel_size_um` (µm) and `thickness_mm`"
        )
    if used is not None and most > used.sheets_per_block:
        how = "given" if sample is not None else "assumed"
        lines.append(
            f"{used.sheets_per_block} sheets per block and side {how}, but n reaches {most}: check"
            " `sheets_per_block`, `axis_px` and `sheets`"
        )
    return lines


def _side_warnings(
    side: Ints,
    found: TrackMetadata,
    sample: Sample | None,
    in_view: tuple[bool, bool],
    settings: CheckSettings,
) -> Iterator[str]:
    """Warn if one side lacks a sheet, or of a doubtful axis although, or because, a comb's end is in view.

    in_view: whether the first sheet, and the last one, is known to be an end of the comb.
    """
    left, right = (int((side == which).sum()) for which in (-1, 1))
    fewer, more = sorted((left, right))
    one_side = fewer == 0
    one_lacks = sample is not None and more == sample.sheets_per_block and 1 <= more - fewer <= 2
    if one_lacks and found.sheets_how == "found":
        yield (
            f"{left} sheets on the left but {right} on the right: if one is overlooked, n of those beyond it"
            " is too small: look for a wide spacing or a sheet outside the picture, or give the number of"
            " sheets in view (`sheets`)"
        )
    unequal = fewer > 0 and more > settings.unequal_sides * fewer + 2
    if unequal and found.axis_how == "motion" and all(in_view):
        yield (
            f"{left} sheets on the left of the axis but {right} on the right, though the whole comb is in"
            " view: the axis is where the sheets do not move, which is wrong if the camera moves along with"
            " them: look at overview.png, and give `axis_px`"
        )
    beside_axis = in_view[0 if side[0] > 0 else 1]
    if found.axis_carried == "yes" or (one_side and beside_axis and found.axis_carried == "perhaps"):
        count, taken = "all", "one side of the sample: the other should be in view, too"
        if found.axis_carried == "yes":
            count = "all or most"
            taken = "both sides, which the load carries along, with the axis in the middle of the ridges"
        yield (
            f"{count} sheets move the same way; they are taken for {taken}: side and n of all sheets may"
            " be wrong: look at overview.png, and give `axis_px`"
        )
    undecided = found.axis_open == "yes" and found.axis_how != "given"
    if undecided and any(in_view) and not (all(in_view) or one_side):
        yield (
            "the picture may cut off one end of the comb, and the motion leaves open where the axis is: side"
            " and n of all sheets may be wrong: look at overview.png, and give `axis_px`"
        )


def _comb_warnings(tracks: xr.Dataset, found: TrackMetadata, settings: CheckSettings) -> Iterator[str]:
    """Warn of further or doubtful ridges of the comb, and of an axis that the motion excludes."""
    if found.ridges_beyond and found.sheets_how == "found":
        where = " on both sides" if found.ridges_beyond > 1 else ""
        yield (
            f"a ridge beyond the outermost sheet is left out{where}: if it is a sheet, the axis and n change:"
            " look at overview.png, and give the number of sheets (`sheets`), or `frames` in which all of"
            " them are apart"
        )
    elif found.ridges_beyond:
        yield (
            f"beyond the {found.sheets} sheets of the comb or between them, {found.ridges_beyond} more would"
            f" change every n: give `sheets` as {found.sheets + found.ridges_beyond} or leave it out"
        )
    if found.ridges_between > settings.seen_between and found.sheets_how == "found":
        yield (
            f"in {100 * found.ridges_between:.0f} % of the frames there is a further ridge between most of"
            f" the {found.sheets} sheets: if these are sheets that leave the picture, as when the blocks"
            " part, n is too small: give `frames` in which all of them are seen"
        )
    snr, share = tracks["snr"].values, tracks["found"].values
    wide = tracks["fwhm_px"].values > settings.odd_width * nan_median(tracks["fwhm_px"].values)
    least = np.full(len(snr), 0.1 * nan_median(snr))
    if len(snr) >= 5:
        least[[0, -1]] = np.fmax(least[0], settings.end_height * snr[[[1, -2], [2, -3]]].min(axis=0))
    counted_by_hand = (share == 0) & (found.corrections_applied > 0)  # a covered sheet
    rare = (share < 0.25 * _with_picture(tracks).mean()) & ~counted_by_hand
    odd = (snr < least) | rare | wide | _stationary_ends(tracks, settings) | _still_between(tracks, settings)
    if (weak := np.flatnonzero(odd)).size and found.sheets > 1:
        which = first_of(weak.tolist(), 6)
        yield (
            f"{len(weak)} of {found.sheets} sheets (index {which}) may be something else (little contrast,"
            " found in few frames, far wider than the others, or still at the comb's end or between sheets"
            " that move): look at the film, restrict `columns`, give `sheets`, or leave them out by"
            " `corrections`"
        )
    if not _motion_allows_axis(tracks, found):
        yield (
            f"the axis at {found.axis_px:.0f} px is outside the range that the motion allows"
            f" ({found.axis_low_px:.0f} to {found.axis_high_px:.0f} px): check `axis_px`, and whether both"
            " sides are in view"
        )


def _stationary_ends(tracks: xr.Dataset, settings: CheckSettings) -> Bools:
    """Return which sheets are the outermost and still while the next two, which move less, do move, (N,):
    edges of the background or of a lamp's light. Compared are displacements along x; the camera's own are in
    all of them."""
    x_px, rest_px = tracks["x_px"].values, nan_median(tracks["x_px"].values)
    still = np.zeros(x_px.shape[1], bool)
    if len(still) < 5:
        return still
    noise, sides = typical_median(tracks["x_err_px"].values), tracks["side"].values
    seen = np.asarray(np.isfinite(x_px).any(axis=0), bool)
    for inwards, side in ((slice(None), -1), (slice(None, None, -1), 1)):
        n = np.flatnonzero((sides[inwards] == side) & seen[inwards])
        if len(n) < 3:
            continue
        moved = x_px[:, inwards][:, n] - rest_px[inwards][n]
        known = np.isfinite(moved)
        moved[~known] = 0.0
        two = known[:, 1:-1] & known[:, 2:]  # the next two of the first, of the second, …
        # the smaller of both motions: one sheet alone may split, or stick to something
        pair = moved[:, 1:-1], moved[:, 2:]
        inner = np.sign(pair[0]) * np.fmin(*np.abs(pair)) * (pair[0] * pair[1] > 0) * two
        both, power = known.T @ two.astype(float), known.T @ inner**2
        # Edges stay in view; a sheet that leaves it is seen where it has moved less, unless an edge that
        # stays is still further out.
        least = (settings.end_moves * noise[inwards][n, None]) ** 2
        stands = (both > settings.end_in_view * len(known)) & (power > both * least)
        stands[0] &= both[0] > 0.8 * len(known)
        stands &= np.fmax(moved.T @ inner, (moved**2).T @ two) < settings.end_still * power
        row = np.flatnonzero(np.logical_and.accumulate(stands, axis=0).diagonal())
        still[inwards][n[: row.max(initial=-1) + 1]] = True
    return still


def _still_between(tracks: xr.Dataset, settings: CheckSettings) -> Bools:
    """Return which sheets are still while those on both sides move in the same direction, (N,), such as a
    scratch at the place of a missing sheet."""
    x_px = tracks["x_px"].values
    rest_px = nan_median(x_px)
    least = settings.end_moves * typical(tracks["x_err_px"].values)
    sensitive = replace(TRACKING, moving_px=least, static_fraction=settings.end_still)
    with np.errstate(invalid="ignore"):  # sheets swapped manually, or never seen
        return static_ridges(x_px - rest_px, rest_px, settings=sensitive)


def _outermost_px(tracks: xr.Dataset) -> tuple[float, float]:
    """Return the median positions of the first and the last sheet, px."""
    x_px = nan_median(tracks["x_px"].values)
    return float(np.nanmin(x_px, initial=math.inf)), float(np.nanmax(x_px, initial=-math.inf))


def _motion_allows_axis(tracks: xr.Dataset, found: TrackMetadata) -> bool:
    """Return whether the axis is where the motion of the sheets allows it, or nothing is known of that. It
    lies between two sheets, half a pitch from both; with one side in view anywhere beyond its end."""
    if not (math.isfinite(found.axis_low_px) and math.isfinite(found.axis_high_px)):
        return True
    slack, (first, last) = 0.75 * found.pitch_px, _outermost_px(tracks)
    low = -math.inf if found.axis_low_px <= first else found.axis_low_px - slack
    high = math.inf if found.axis_high_px >= last else found.axis_high_px + slack
    return bool(low <= found.axis_px <= high)


def shells_against_fits(
    shells: pd.DataFrame | None, fits: ModelFits | None, settings: ShellSettings, *, codec: str = ""
) -> list[str]:
    """Return a warning if M_eff of the fits contradicts the stiff shells that the video shows.

    An M_eff from k to k + 1 predicts k stiff sheets. Where all sheets of one side in view are stiff,
    there is no upper limit. Only the statistical error of Λ̂ is used, as an error of d0 shifts d and Λ̂ alike.
    codec: of the film; one that predicts frames from others repeats sheets that creep by little.
    """
    if shells is None or fits is None:
        return []
    known = shells[shells["stiff_sheets"].notna()]
    if len(known) < 3:  # so few may contradict by chance
        return []
    d_mm, scale = known["d_v_mm"].to_numpy(float), fits.scale_mm
    beyond = settings.fit_sigma * scale.error
    least, most = (
        effective_sheets(d_mm / max(scale.value + sign * beyond, 1e-9), sample=fits.sample)
        for sign in (-1, 1)
    )
    low, high = known["stiff_low"].to_numpy(float), known["stiff_high"].to_numpy(float)
    in_view = high < known["sheets_known"].to_numpy(float)
    outside = (most < low) | (in_view & (least >= high + 1))
    if outside.mean() <= settings.contradicted_share:
        return []
    fitted = np.median(fits.effective_sheets(d_mm[outside]))
    ends = [f"{np.median(end[outside]):.0f}" for end in (low, high)]
    shell = f"{' to '.join(dict.fromkeys(ends))} sheets"
    stiffer = codec in BETWEEN_FRAMES and np.median(low[outside]) > fitted
    hidden = f" the codec ({codec}) may hide the movement of sheets that creep by little;" if stiffer else ""
    return [
        f"M_eff of the fits ({fitted:.1f}) lies outside the stiff shell's interval ({shell}) in"
        f" {outside.sum()} of {len(known)} stick phases and sides:{hidden}"
        " check `d0_mm`, `pixel_size_um`, `axis_px`, the sample's geometry, `sheets_per_block` and"
        " `threshold`"
    ]


def unlike_sides(shells: pd.DataFrame | None, settings: ShellSettings) -> list[str]:
    """Return a warning if the stiff shells of the two sides differ by more than their errors and one sheet:
    sheets differ, and an axis one sheet aside makes it two."""
    if shells is None or shells["side"].nunique() < 2:
        return []
    names = ["stiff_sheets", "stiff_low", "stiff_high"]
    known = shells.dropna(subset="stiff_sheets").set_index("event")
    left, right = (known.loc[known["side"] == side, names].astype(float) for side in (-1, 1))
    left, right = left.align(right, join="inner", axis=0)
    one_larger = [
        ((one["stiff_low"] > other["stiff_high"]) & (one["stiff_sheets"] > other["stiff_sheets"] + 1)).sum()
        for one, other in ((left, right), (right, left))
    ]
    if len(left) < 3 or max(one_larger) <= settings.contradicted_share * len(left):
        return []
    sizes = (side["stiff_sheets"].median() for side in (left, right))
    return [
        "the stiff shell has {:.0f} sheets on the left but {:.0f} on the right".format(*sizes)
        + f" in {max(one_larger)} of {len(left)} stick phases: check `axis_px` and whether each sheet has a"
        " number, unless the sample is not symmetric"
    ]
