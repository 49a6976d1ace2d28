"""Frames that the codec or the recorder repeated, ridges that moved while the shutter was open, and light in
the gaps between ridges: that of ridges out of focus, or of a faint second comb."""

from __future__ import annotations

from functools import partial, reduce
from typing import NamedTuple

import numpy as np

from vision.memory import in_two_threads, row_parts, some_rows, table_beside
from vision.numeric import (
    FWHM,
    Bools,
    Floats,
    Floats32,
    centred,
    nan_median,
    nan_quantile,
    sigma_about_zero,
    spread_indices,
)
from vision.sheets.distortion import levels_around
from vision.sheets.ridges import RidgeComb, in_blocks, profile_noise
from vision.sheets.settings import DEFAULT, LEAST_FRAMES, TrackingSettings

BLUR_FRAMES = 2  # before and after a blurred one: two may show the same one of two images
GAP_SHEETS = 5  # fewer, of an end or of the comb, do not show what lies in gaps
GAP_FRAMES = 50  # spread over the film
GAP_LIGHT = 0.5  # log2 of twice the light beyond an end over that in the gaps: 0 for blur, 1 for a board
LEAST_PERIODS, MOST_PERIODS = 12, 300  # of a film, evenly spread: those of fewer may agree by chance
PERIOD_FRAMES = 5  # whose mean has little noise
LIGHT_FRAMES = 5  # before and after, in at least one of which a ridge is as high as its light permits


def repeated_frames(profile: Floats32, settings: TrackingSettings = DEFAULT) -> Bools:
    """Return which frames of a profile (frame, x) repeat the strip of the frame before, (frame,).

    The measure is the root mean square change from the frame before. Noise alone makes frames differ by √2 of
    its standard deviation, within a few per cent. A frame is repeated if its change is less than noise and is
    separated by a clear gap from the changes of the other quiet frames (the quietest tenth). Without such a
    gap no frame is repeated: under vibration, frames near a turning point also change by less than most.
    """
    change = np.empty(max(0, len(profile) - 1))

    def compare(rows: slice) -> None:
        step = np.diff(profile[rows.start : rows.stop + 1], axis=0)
        change[rows] = np.sqrt(np.square(step).mean(axis=1, dtype=np.float64))

    in_blocks(compare, profile[:-1])
    moving = change[np.isfinite(change) & (change > 0)]
    frozen = np.zeros(len(profile), bool)
    # in a film without noise, or of a still scene, nothing shows that a frame should have changed
    if moving.size >= max(LEAST_FRAMES, settings.least_changing * len(change)):
        quiet = np.sort(change[change <= np.quantile(moving, 0.1)])
        gaps = np.flatnonzero(quiet[:-1] < settings.frozen_fraction * quiet[1:])
        if gaps.size:
            known = np.flatnonzero(np.isfinite(change))
            some = known[spread_indices(len(known), 200)]
            frozen[1:] = change <= min(quiet[gaps[-1]], np.sqrt(2) * profile_noise(some_rows(profile, some)))
    return frozen


def motion_blur(x_px: Floats, contrast: Floats32, fwhm_px: Floats32, comb: RidgeComb) -> tuple[Bools, Floats]:
    r"""Return whether each ridge moved during the exposure, and how far this may shift it, px; (frame, N).

    x_px, contrast, fwhm_px: position, height and width of the ridges (frame, N), NaN where missing.

    A ridge that jumps by D after a fraction p of the exposure appears twice, with heights p and 1 − p. The
    fit follows the higher image. Its error is up to :math:`\min(p, 1-p)\,D`: the loss of height times the
    motion over `BLUR_FRAMES` frames before and after. It is smaller where both images merge into one wider
    ridge. A ridge is blurred if it moved by more than a fraction of its width and is wider or lower than
    usual by more than its scatter. A ridge that is low in all of several frames is in a shadow.

    All sheets of a frame have the same p. Hence a sheet that moved by more than half its width has at least
    the signs of most such sheets: its own may be hidden by a background that varies, or, after a jump of
    about one pitch, by the image of its neighbour, which fills the gap that its own leaves.
    """
    settings = comb.settings
    fast = np.zeros(x_px.shape, bool, order="F")
    moved, excess, loss = (table_beside(x_px, x_px.shape, order="F") for _ in range(3))
    sampled = 0.7 / comb.fwhm_px**2  # height that a ridge between two pixels loses

    def measure(n: int) -> None:
        near = _frames_around(x_px[:, n], BLUR_FRAMES)
        step = np.nan_to_num(reduce(np.fmax, near) - reduce(np.fmin, near))
        lower, wider = -np.log(contrast[:, n].astype(np.float64)), np.log(fwhm_px[:, n].astype(np.float64))
        lower = lower - np.fmax(nan_median(lower), reduce(np.fmin, _frames_around(lower, LIGHT_FRAMES)))
        fast[:, n] = (step > settings.blur_fraction * comb.fwhm_px) & np.isfinite(x_px[:, n])
        moved[:, n] = step
        excess[:, n] = np.maximum(_excess(lower, sampled), _excess(wider, sampled))
        loss[:, n] = np.clip(1 - np.exp(-np.nan_to_num(lower)), 0.0, 0.5)

    in_two_threads(measure, range(x_px.shape[1]))
    blurred, err = np.empty_like(fast), moved

    def judge(rows: slice) -> None:
        blurred[rows], err[rows] = _blurred(moved[rows], fast[rows], excess[rows], loss[rows], comb)

    in_two_threads(judge, row_parts(len(x_px)))
    return blurred, err


def _blurred(
    moved: Floats, fast: Bools, excess: Floats, loss: Floats, comb: RidgeComb
) -> tuple[Bools, Floats]:
    """Return which ridges of some frames are blurred, and how far this may shift them, px; (frame, N).
    moved: motion over `BLUR_FRAMES` frames before and after, px. fast: whether it may blur. excess, loss: the
    signs of each sheet itself, to which those of the frame are added here."""
    settings = comb.settings
    apart = moved / comb.fwhm_px
    pitches = np.maximum(np.rint(moved / comb.pitch_px), 1.0)
    overlapping = np.abs(moved - pitches * comb.pitch_px) < settings.blur_overlap * comb.fwhm_px
    informative = fast & ~overlapping & (apart > 0.5)
    for sign, share in ((excess, 0.5), (loss, 0.75)):
        of_frame = nan_quantile(np.where(informative, sign, np.nan), share, axis=1)[:, None]
        np.copyto(sign, np.fmax(sign, of_frame), where=informative | (fast & overlapping))
    suspect = fast & (excess > 0.5 * settings.blur_sigmas)  # not flagged, but with a larger error
    merged = np.minimum(0.8, apart)  # images nearer than a width merge, and the fit finds their middle
    err = np.where(suspect, settings.blur_error * loss * moved * merged, 0.0)
    return fast & (excess > settings.blur_sigmas), err


def _frames_around(values: Floats, frames: int) -> list[Floats]:
    """Return values (frame,) of each frame before, at and after every frame, up to so many frames away."""
    padded = np.pad(values, frames, constant_values=np.nan)
    return [padded[k : k + len(values)] for k in range(2 * frames + 1)]


def _excess(values: Floats, least: float) -> Floats:
    """Return how far values of a sheet (frame,) exceed their median plus `least`, in standard deviations."""
    off = values - nan_median(values)
    spread = sigma_about_zero(off)
    return np.nan_to_num(np.maximum(off - least, 0.0) / np.maximum(spread, 0.004))


def gap_depth(profile: Floats32, x_px: Floats, comb: RidgeComb) -> float:
    """Return how deep the gaps between blurred ridges are, over their height above the background.

    Out of focus, light of the sheets fills the gaps between them. Half a spacing beyond an end of the comb,
    where it is that of one sheet, there is half as much of it; light of a board behind the comb, or of a
    lamp, is there as well, or nowhere beyond. The background is the lowest level from one spacing to two
    beyond the end, and compared with the five sheets of this end, since light is uneven.

    Parameters
    ----------
    profile
        Grey levels (frame, x).
    x_px
        Positions (frame, N), NaN where missing.
    comb
        Polarity of the ridges.

    Returns
    -------
    float
        The median over gaps and frames, as a mean of the ends that show about half of the light beyond: 1
        where gaps are as dark as the background, 0 without gaps. NaN without such an end, and where no frame
        shows five sheets.
    """
    seen = np.flatnonzero(np.isfinite(x_px).sum(axis=1) >= GAP_SHEETS)
    if not len(seen):
        return np.nan
    rows = seen[spread_indices(len(seen), GAP_FRAMES)]
    bright, x = comb.bright(some_rows(profile, rows)), x_px[rows]

    def of_end(x: Floats) -> tuple[float, float]:
        """Return the depth at one end, and the light beyond over half of that in the gaps."""
        tops, apart = levels_at(bright, x), np.diff(x, axis=1)
        gaps = reduce(np.fmin, [levels_at(bright, x[:, :-1] + share * apart) for share in (0.35, 0.5, 0.65)])
        beyond = x[:, :1] - nan_median(apart.ravel()) * np.array([0.5, 1.0, 1.25, 1.5, 1.75])
        half, *others = levels_at(bright, beyond).T
        dark = reduce(np.fmin, others)
        lower = np.minimum(tops[:, 1:], tops[:, :-1])
        height, filled, outside, usual, last = (
            float(nan_median((level.T - dark).ravel())) for level in (lower, gaps, half, tops, tops[:, 0])
        )
        with np.errstate(divide="ignore", invalid="ignore"):  # the last sheet may be brighter or darker
            depth, spread = np.divide([height - filled, 2 * outside * usual], [height, filled * last])
        return float(depth), float(spread)

    ends = np.array([of_end(x[:, :GAP_SHEETS]), of_end(x[:, : -GAP_SHEETS - 1 : -1])])
    of_sheets = np.abs(np.log2(np.fmax(ends[:, 1], 1e-6))) < GAP_LIGHT
    return float(ends[of_sheets, 0].mean()) if of_sheets.any() else np.nan


# --- a faint second comb ------------------------------------------------------------------------------------


class SecondComb(NamedTuple):
    """What a second comb does: the light that goes between ridges and gaps, rms, over the ridges' height, and
    the error of all positions by it, px; 0 if there is none."""

    depth: float = 0.0
    error_px: float = 0.0


def second_comb(profile: Floats32, x_px: Floats, blurred: Bools, comb: RidgeComb) -> SecondComb:
    r"""Return how far a second comb shifts the positions x_px (frame, N), NaN where missing.

    A second comb over or behind the sheets, such as their reflection in a pane of glass, shifts positions by
    up to a tenth of a ridge's width and hardly changes shapes. It is found by the light that it brings: to a
    ridge in some frames, to the gap beside it in others. Ridges blurred by motion (frame, N) do not count.

    The levels in the middle of a gap, :math:`g`, and at the tops of the ridges beside it, :math:`t`, both
    over the usual height of the ridges, are averaged over a few frames. Their changes count without those of
    all sheets together, and without what is in proportion to the width of the gap, as overlapping flanks are.
    A lamp, a shadow or dirt changes both in the same direction, and noise changes each by itself. What has
    the size of a ridge, and which the sheets move against, changes them in opposite directions: if t and g,
    of all gaps together, are correlated by less than -`second_comb_correlation`, the error of all positions
    is

    .. math:: k\,\sigma_r\,\sqrt{-q\,\langle t\,g\rangle} ,

    where :math:`\sigma_r` is the standard deviation of a ridge and k is `second_comb_shift`. It is the same
    in all frames, since a ridge exactly over another changes the tops most and shifts the position least.
    A reflection changes as quickly as the sheets move, haze slowly: q, at most 1, is the share of steps from
    period to period in :math:`\langle t\,g\rangle` over their share in the squares of the displacements.
    It must also hold if the weight of each gap is limited to the upper quartile of all weights, as scratches
    change few gaps.

    What all sheets share counts only if it is lopsided (`_over_all`).

    Sheets that lean by different amounts show the same: their ridges become lower and wider.

    Nothing is found for fewer than five sheets, films of fewer than 60 frames, and narrow ridges, whose tops
    change with their place among the pixels (`second_comb_least_px`).
    """
    settings, periods = comb.settings, len(profile) // PERIOD_FRAMES
    if x_px.shape[1] < GAP_SHEETS or periods < LEAST_PERIODS or comb.fwhm_px < settings.second_comb_least_px:
        return SecondComb()
    rows = (PERIOD_FRAMES * spread_indices(periods, MOST_PERIODS)[:, None] + np.arange(PERIOD_FRAMES)).ravel()
    bright, x = comb.bright(some_rows(profile, rows)), np.where(blurred[rows], np.nan, x_px[rows])
    quarter = (x[:, 1:] - x[:, :-1]) / 4
    places = x, (x[:, 1:] + x[:, :-1]) / 2, x[:, :-1] + quarter, x[:, 1:] - quarter
    tops, gaps, right, left = in_two_threads(partial(levels_at, bright), places)
    sides = right[:, 1:] - left[:, :-1]
    tops, gaps, sides, x = map(_of_periods, ((tops[:, 1:] + tops[:, :-1]) / 2, gaps, sides, x))
    apart = np.diff(x, axis=1)
    height = float(nan_median(nan_median(tops - gaps)))  # a gap that shows something bright has next to none
    if not height > 0:
        return SecondComb()
    whole = _over_all(tops / height, gaps / height, sides / height, settings)
    tops, gaps = (_changes(values / height, apart, settings.second_comb_most) for values in (tops, gaps))
    known = np.isfinite(tops) & np.isfinite(gaps)
    count = np.maximum(known.sum(axis=0), 1)
    tops, gaps = np.where(known, tops, 0.0), np.where(known, gaps, 0.0)
    shared = (tops * gaps).sum(axis=0) / count
    size = np.sqrt((tops**2).sum(axis=0) * (gaps**2).sum(axis=0)) / count
    capped = np.fmin(1.0, np.quantile(size, 0.75) / np.fmax(size, 1e-12))
    least = -settings.second_comb_correlation
    if any(np.sum(each * shared) >= least * np.sum(each * size) for each in (count, count * capped)):
        return SecondComb(whole, settings.second_comb_whole * comb.fwhm_px / FWHM * whole)
    moved = centred(x - nan_median(x, axis=1)[:, None], np.isfinite(x))
    motion = np.sum(moved**2) / np.fmax(np.sum(np.diff(moved, axis=0) ** 2), 1e-12)
    light = np.sum(np.diff(tops, axis=0) * np.diff(gaps, axis=0)) / np.sum(tops * gaps)
    depth = float(np.sqrt(-np.average(shared, weights=count) * np.clip(light * motion, 0.0, 1.0)))
    shift = max(settings.second_comb_shift * depth, settings.second_comb_whole * whole)
    return SecondComb(max(depth, whole), shift * comb.fwhm_px / FWHM)


def _over_all(tops: Floats, gaps: Floats, sides: Floats, settings: TrackingSettings) -> float:
    """Return the light, rms, that a second comb which moves over all sheets alike brings from the tops to the
    gaps (period, K), over the usual height of the ridges; 0 without one.

    Even combs lie over each other alike everywhere. The focus changes all tops and gaps as well, but it
    leaves the two sides of a ridge equal, and a comb that moves does not. sides: the level a quarter of the
    spacing to the right of a ridge less that to the left, over its height, (period, K).
    """
    top, gap, side = (nan_median(values - nan_median(values), axis=1) for values in (tops, gaps, sides))
    known = np.isfinite(top) & np.isfinite(gap) & np.isfinite(side)
    if known.sum() < LEAST_PERIODS:
        return 0.0
    top, gap, side = (centred(values[known], known[known]) for values in (top, gap, side))
    own = sides[known] - nan_median(sides) - side[:, None]
    chance = np.sqrt(np.pi / 2 / sides.shape[1]) * nan_median(sigma_about_zero(own))
    shared = float(np.mean(top * gap))
    opposite = shared < -settings.second_comb_opposite * top.std() * gap.std()
    lopsided = side.std() > settings.second_comb_lopsided * chance
    return float(np.sqrt(-shared)) if opposite and lopsided else 0.0


def levels_at(bright: Floats32, x_px: Floats) -> Floats:
    """Return the mean of three pixels around each place x_px (frame, K); NaN at NaN and at the edge.

    A line between pixels would lower tops and raise gaps that lie there, by 1 % of a ridge of 6 px, as a
    second comb does.
    """
    return np.asarray(levels_around(bright, x_px, 1).mean(axis=1), np.float64)


def _of_periods(values: Floats) -> Floats:
    """Return means over successive frames, (period, K), NaN where fewer than half of them are known."""
    values = values.reshape(-1, PERIOD_FRAMES, values.shape[1])
    known = np.isfinite(values)
    count = known.sum(axis=1)
    total = np.where(known, values, 0.0).sum(axis=1)
    return np.where(count > PERIOD_FRAMES / 2, total / np.maximum(count, 1), np.nan)


def _changes(level: Floats, apart_px: Floats, most: float) -> Floats:
    """Return the changes of levels (period, K) in time, against those of all sheets, and without what changes
    from period to period in proportion to the distance of the two sheets; at most `most`."""
    level = level - nan_median(level)
    level -= nan_median(level, axis=1)[:, None]
    known = np.isfinite(level) & np.isfinite(apart_px)
    step, opening = (np.diff(np.where(known, values, np.nan), axis=0) for values in (level, apart_px))
    slope = np.nansum(step * opening, axis=0) / np.fmax(np.nansum(opening**2, axis=0), 1e-12)
    change = centred(level - slope * apart_px, known)
    return np.where(known, np.clip(change, -most, most), np.nan)
