"""Appearance of the ridges, and candidate ridges in each frame.

`describe_ridges` measures polarity, width, pitch and contrast once per recording; `find_ridges` then lists
the candidates of every frame. Which candidate is which sheet is decided later, from all frames together.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.data import TrackMetadata
from vision.errors import InputError, NoRidgesError
from vision.memory import Result, give_back, in_two_threads, row_parts, some_rows, table_beside
from vision.numeric import (
    FWHM,
    NORMAL_MEDIAN,
    Bools,
    Floats,
    Floats32,
    Ints,
    flat_ranges,
    spread_indices,
)
from vision.sheets.settings import DEFAULT, TrackingSettings
from vision.signals import find_maxima, half_widths

Polarity = Literal["bright", "dark"]
SEARCH_SIGMA_PX = 1.0  # standard deviation of the smoothing with which a comb is described
NEAREST = 3  # stripes whose levels stand for the comb's end
SLOPING = 8  # stripes over which the light at the comb's end slopes
FEWEST = 5  # stripes of a comb; fewer can be found in any picture
FRAMES_PER_BLOCK = 128  # processed at once, so that intermediate arrays fit into a core's cache


@dataclass(frozen=True)
class RidgeComb:
    """Appearance of the ridges, measured once per recording, and the thresholds that apply to them."""

    polarity: Polarity  # bright or dark ridges
    # fwhm_px, pitch_px: typical width and spacing
    fwhm_px: float
    pitch_px: float
    contrast: float  # typical prominence, grey levels
    noise: float  # standard deviation of the profile's noise, grey levels
    count: float  # number of main ridges in a frame
    width_px: int  # width of the profile
    settings: TrackingSettings = DEFAULT  # thresholds and costs of the tracking
    doubt: str = ""  # why the polarity that was found may be wrong
    top: float = 0.0  # width of a ridge where it has lost 15 % of its height, over that at half; 0: not known
    alternate: bool = False  # whether bright and dark ridges, both of which may be sheets, lie in turn

    @classmethod
    def of(cls, found: TrackMetadata, width_px: int, settings: TrackingSettings = DEFAULT) -> RidgeComb:
        """Return the comb as the tracking measured it."""
        return cls(
            "dark" if found.ridges == "dark" else "bright",
            found.ridge_fwhm_px,
            found.pitch_px,
            found.contrast,
            found.profile_noise,
            float(found.sheets),
            width_px,
            settings,
        )

    def bright(self, profile: Floats32) -> Floats32:
        """Return the profile with bright ridges."""
        return profile if self.polarity == "bright" else -profile

    def half_px(self, share: float) -> int:
        """Return this share of a ridge's width in pixels, no more than half the pitch and at least 3."""
        return max(3, round(min(share * self.fwhm_px, 0.5 * self.pitch_px)))


@dataclass(frozen=True)
class Ridges:
    """Candidates of each frame, left to right, padded with NaN to the largest count K; all (frame, K).

    x_px: position, whole pixels. contrast: prominence, grey levels. fwhm_px: width at half prominence,
    corrected for the smoothing.
    """

    x_px: Floats32
    contrast: Floats32
    fwhm_px: Floats32

    @cached_property
    def count(self) -> Ints:
        """Number of candidates in each frame, (frame,)."""
        return np.asarray(np.isfinite(self.x_px).sum(axis=1), np.int64)


# --- appearance of the ridges -------------------------------------------------------------------------------


def describe_ridges(
    profile: Floats32,
    *,
    polarity: Literal["bright", "dark", "auto"] = "auto",
    sheets: int | None = None,
    source: str = "the strip",
    settings: TrackingSettings = DEFAULT,
) -> RidgeComb:
    """Measure polarity, width, pitch and contrast of the ridges.

    Local extrema of lightly smoothed profiles are ranked by prominence. The strongest (`sheets` per frame, if
    that number is known) are the main ridges, and their medians describe the comb.

    Parameters
    ----------
    profile
        Grey levels (frame, x), at least one frame without NaN.
    polarity
        "auto" finds which stripes are the sheets, and which the gaps between them.
    sheets
        Number of ridges in view, if known.
    source
        Name of the recording in messages.
    settings
        Thresholds.

    Raises: InputError if no structure rises above the noise.
    """
    sample = _sample(profile)
    noise = profile_noise(sample)
    names: tuple[Polarity, ...] = ("bright", "dark") if polarity == "auto" else (polarity,)
    measured = (_measure(sample, name, noise, sheets, settings) for name in names)
    found = [main for main in measured if main is not None]
    if not found:
        raise no_ridges(sample, source)
    return _choose_polarity(sample, found[0], found[1], settings) if len(found) == 2 else found[0].comb


def frames_with_values(profile: Floats32) -> Bools:
    """Return which frames of a profile (frame, x) have no NaN, (frame,)."""
    return np.concatenate(in_blocks(lambda rows: np.isfinite(profile[rows]).all(axis=1), profile))


def no_ridges(profile: Floats32, source: str) -> NoRidgesError:
    """Return the error for a strip without ridges, which names a periodic pattern too fine to be resolved."""
    sample = _sample(profile).astype(np.float64)
    power = (np.abs(np.fft.rfft(sample - sample.mean(axis=1, keepdims=True))) ** 2).mean(axis=0)
    waves = np.fft.rfftfreq(sample.shape[1])
    power[waves < 1 / 50] = 0.0  # uneven light
    wave = waves[np.argmax(power)]
    if wave >= 1 / 4 and power.max() > 20 * np.median(power[power > 0]):
        found, advice = f"a pattern of {1 / wave:.1f} px", "film it larger, or with more pixels"
        return NoRidgesError(source, "ridges more than 4 px apart", found, advice)
    return NoRidgesError(
        source, "upright ridges", "none above the noise", "check `rows`, `rotate` and `ridges`"
    )


def profile_noise(profile: Floats32) -> float:
    """Return the standard deviation of the pixel noise of profiles (frame, x), grey levels.

    It is the median absolute value of sixth differences along x, in which a smooth ridge hardly shows. 0 for
    a profile without noise; too small if compression has smoothed the noise.
    """
    kernel = np.array([1, -6, 15, -20, 15, -6, 1], np.float64)[None, :]
    spread = cv2.filter2D(np.ascontiguousarray(profile, np.float32), cv2.CV_32F, kernel)[:, 3:-3]
    return float(np.median(np.abs(spread)) / (NORMAL_MEDIAN * np.sqrt(924.0)))


def _smoothed(profile: Floats32, sigma_px: float, wall_px: int = 0) -> Floats32:
    """Smooth profiles (frame, x) along x with a Gaussian, leaving `wall_px` columns free on both sides.
    Values that are not finite are replaced by 0."""
    finite = np.isfinite(profile)
    clean = profile if finite.all() else np.where(finite, profile, np.float32(0))
    half = max(1, int(np.ceil(4 * sigma_px)))
    kernel = cv2.getGaussianKernel(2 * half + 1, sigma_px).reshape(1, -1)
    line = np.empty((len(profile), profile.shape[1] + 2 * wall_px), np.float32)
    inner = line[:, wall_px : wall_px + profile.shape[1]]
    cv2.filter2D(clean, cv2.CV_32F, kernel, dst=inner, borderType=cv2.BORDER_REPLICATE)
    return line


def _noise_floor(noise: float, smoothing_px: float, settings: TrackingSettings) -> float:
    """Return the prominence, grey levels, that white noise does not reach after Gaussian smoothing."""
    smoothed_noise = noise / np.sqrt(2 * np.sqrt(np.pi) * max(smoothing_px, 0.3))
    return max(1e-6, float(settings.noise_factor * smoothed_noise))


def _sample(profile: Floats32) -> Floats32:
    """Return frames spread over the recording, without those that contain NaN."""
    good = np.flatnonzero(frames_with_values(profile[:, :1]))
    if not good.size:
        raise InputError("the strip", "at least one frame that shows something", "none")
    picked = good[spread_indices(len(good), 48)]
    return np.ascontiguousarray(some_rows(profile, picked), np.float32)


def _measure(
    sample: Floats32, polarity: Polarity, noise: float, sheets: int | None, settings: TrackingSettings
) -> _MainRidges | None:
    """Return the main ridges of this polarity, None without any.

    A bright base below ridges, such as the light of a blurred comb, can have more prominence than the ridges
    on it. Where only one or two ridges are prominent in the whole picture, ridges prominent in their
    surroundings are searched as well, and where fewer than `FEWEST` are, at least so many.
    """
    whole = _measure_within(sample, polarity, noise, sheets, settings, None)
    if whole is None or whole.comb.count >= FEWEST:
        return whole
    few = 3 if whole.comb.count < 3 else FEWEST
    near = [reach for reach in (6, 12, 24, 48) if reach < 2 * whole.comb.fwhm_px]
    tried = [_measure_within(sample, polarity, noise, sheets, settings, reach) for reach in near]
    combs = [whole, *(main for main in tried if main is not None and main.comb.count >= few)]
    return max(combs, key=lambda main: main.comb.count * main.comb.contrast / np.sqrt(main.comb.fwhm_px))


def _measure_within(
    sample: Floats32,
    polarity: Polarity,
    noise: float,
    sheets: int | None,
    settings: TrackingSettings,
    reach_px: int | None,
) -> _MainRidges | None:
    """Return the ridges prominent within `reach_px` on both sides (None: in the whole picture)."""
    sigma = SEARCH_SIGMA_PX
    walled = _smoothed(sample if polarity == "bright" else -sample, sigma, wall_px=1)
    walled[:, [0, -1]] = walled[:, 1:-1].min()
    floor = _noise_floor(noise, sigma, settings)
    reach = walled.shape[1] if reach_px is None else reach_px
    maxima = find_maxima(walled.ravel(), least_prominence=floor, reach=reach)
    at, prominence = maxima
    widths = half_widths(walled.ravel(), maxima)
    frame = at // walled.shape[1]
    upper = float(np.quantile(prominence, 0.9)) if len(prominence) else np.inf
    x = at % walled.shape[1] - 1  # without the wall
    whole = (x > 0) & (x < sample.shape[1] - 1)  # else it is the flank of a ridge outside the picture
    strength = np.where(whole & (prominence >= 0.3 * upper), prominence, 0.0)
    width, main = _commonest_width(widths, strength, frame, sheets)
    if not main.any():
        return None
    fwhm = float(np.sqrt(max(width**2 - (FWHM * sigma) ** 2, 1.0)))
    gaps = np.diff(at[main])[np.diff(frame[main]) == 0]
    pitch = float(np.median(gaps)) if len(gaps) else float(sample.shape[1])
    counts = np.bincount(frame[main], minlength=len(sample))
    contrast, ends = float(np.median(prominence[main])), np.cumsum(counts)[:-1]
    count, width_px = float(np.median(counts)), sample.shape[1]
    top = float(np.median((half_widths(walled.ravel(), maxima, below=0.15) / widths)[main]))
    comb = RidgeComb(polarity, fwhm, pitch, contrast, noise, count, width_px, settings, top=top)
    return _MainRidges(comb, np.split(x[main], ends), np.split(widths[main], ends))


def _commonest_width(
    widths: Floats, strength: Floats, frame: Ints, sheets: int | None
) -> tuple[float, Bools]:
    """Return the width of the kind of ridge with the largest total prominence, and which ridges are of it.
    The sum is divided by the root of the width to favour narrow ridges: the gap between two is not a
    ridge."""
    tried = np.geomspace(1.5, max(2.0, float(widths.max(initial=2.0))), 40)
    off = np.abs(np.log(np.maximum(widths, 0.1) / tried[:, None]))
    kinds = (strength > 0) & (off < np.log(1.6))
    if sheets:
        kinds = np.array([kind & _strongest(np.where(kind, strength, -1.0), frame, sheets) for kind in kinds])
    best = kinds[int(np.argmax((kinds * strength).sum(axis=1) / np.sqrt(tried)))]
    return (float(np.median(widths[best])) if best.any() else 0.0), best


def _strongest(strength: Floats, frame: Ints, most: int) -> Bools:
    """Return which entries are among the `most` strongest of their frame (entries are ordered by frame)."""
    order = np.lexsort((-strength, frame))
    first = np.searchsorted(frame, frame)
    strongest = np.zeros(len(frame), bool)
    strongest[order] = np.arange(len(frame)) - first < most
    return strongest


# --- bright or dark: which stripes of a comb are the sheets, and which the gaps between them ----------------


class _MainRidges(NamedTuple):
    """The main ridges of one polarity in a sample of frames: the comb that they form, and for each frame
    their positions, px in ascending order, and their widths, px."""

    comb: RidgeComb
    x: Sequence[Ints | Floats]
    width: list[Floats]

    @property
    def spacing(self) -> Ints:
        """All distances between neighbours."""
        return np.concatenate([np.diff(x) for x in self.x])


def _choose_polarity(
    sample: Floats32, bright: _MainRidges, dark: _MainRidges, settings: TrackingSettings
) -> RidgeComb:
    """Return the comb of the stripes that are the sheets, with the reason if that is doubtful.

    The background beside the comb is also what shows between the sheets, unless clamps or boards lie there:
    what varies along the comb can overrule it if narrowness does, too. Where the background seldom says
    anything, what varies decides, and the narrower stripes are the sheets if nothing else tells them from
    gaps.
    """
    line = _smoothed(sample, SEARCH_SIGMA_PX)
    narrower = float(np.log(dark.comb.fwhm_px / bright.comb.fwhm_px))
    background = widths = heights = changes = 0.0
    if even := min(len(bright.spacing), len(dark.spacing)) > 0:
        spacings = bright.spacing, dark.spacing
        pitch = float(np.median(np.concatenate(spacings)))
        quartiles = np.array([np.quantile(spacing, [0.25, 0.75]) for spacing in spacings])
        even = bool((quartiles[:, 1] <= settings.even_spacing * quartiles[:, 0]).all())
        background = _background(line, bright, dark, pitch, settings.background_margin)
        if even:
            changes, widths, heights = _variation(line, bright, dark, pitch)
    varied, clear, doubt = widths + heights, settings.clear_evidence, ""
    background_decides = abs(background) > settings.background_decides
    if background_decides:
        is_bright = background > 0
        if _clipped(line, bright, settings):  # all that is bright has the same level, and unlike edges
            varied, changes = widths, 0.0
        if varied * background < 0 and abs(varied) >= settings.polarity_evidence:
            if abs(varied) >= clear and varied * narrower > 0:
                is_bright = varied > 0
            doubt = "the background beside the comb says one thing, what varies along the comb the other"
        elif changes * background <= -settings.polarity_evidence:
            doubt = "they change their widths, and the stripes between them do not"
    else:
        few = min(bright.comb.count, dark.comb.count) < FEWEST
        is_bright, doubt = _polarity_of_stripes(widths, heights, narrower, background, settings, few=few)
    alternate = not background_decides and _alternate(line, bright, dark, settings)
    return replace((bright if is_bright else dark).comb, doubt=doubt, alternate=alternate)


def _polarity_of_stripes(
    widths: float,
    heights: float,
    narrower: float,
    background: float,
    settings: TrackingSettings,
    *,
    few: bool,
) -> tuple[bool, str]:
    """Return whether the bright stripes are the sheets if the background seldom says anything, and the doubt.

    All values speak for the bright stripes if positive. widths, heights: by how much more the dark stripes
    vary in width and the bright ones in height. few: whether too few stripes are in view for that.
    """
    varied = 0.0 if few else widths + heights
    decided = abs(varied) >= settings.polarity_evidence
    is_bright = varied > 0 if decided else varied + narrower >= np.log(settings.dark_width_ratio)
    contradict = widths * heights < 0 and min(abs(widths), abs(heights)) >= settings.clear_evidence
    if background * (1 if is_bright else -1) < -settings.background_seen:
        doubt = "the background beside the comb, where it says anything, says the opposite"
    elif varied and (contradict or abs(varied + narrower) < settings.clear_evidence):
        doubt = "no clear background is beside the comb, and widths and brightness tell little or disagree"
    elif few and abs(narrower) < settings.polarity_evidence:
        doubt = "both are nearly as wide, and no clear background is beside them"
    else:
        doubt = ""
    return is_bright, doubt


def _alternate(line: Floats32, bright: _MainRidges, dark: _MainRidges, settings: TrackingSettings) -> bool:
    """Return whether bright and dark ridges lie in turn on a ground of a level between theirs, as white and
    black sheets on grey do. From a sheet to a gap the level falls all the way; from a white to a black sheet
    it is that of the ground, and constant, in the middle. `line` is the sample, lightly smoothed."""
    found = [np.zeros((2, 0))]
    for row, up, down in zip(line, bright.x, dark.x, strict=True):
        x, is_bright = np.concatenate([up, down]), np.repeat([True, False], [len(up), len(down)])
        order = np.argsort(x)
        x, is_bright = x[order], is_bright[order]
        turn = np.flatnonzero(is_bright[1:] != is_bright[:-1])
        pair = np.where(is_bright[turn], [x[turn], x[turn + 1]], [x[turn + 1], x[turn]])
        top, bottom = row[pair.astype(np.int64)]
        places = pair[0] + np.multiply.outer([0.4, 0.6], pair[1] - pair[0])
        found.append((np.interp(places, np.arange(len(row)), row) - bottom) / np.fmax(top - bottom, 1e-6))
    near_top, near_bottom = np.concatenate(found, axis=1)
    if len(near_top) < FEWEST * len(line):
        return False
    step, level = np.quantile(near_top - near_bottom, 0.75), np.median(near_top + near_bottom) / 2
    return bool(step < settings.ground_step and abs(level - 0.5) < settings.ground_level)


def _variation(
    line: Floats32, bright: _MainRidges, dark: _MainRidges, pitch: float
) -> tuple[float, float, float]:
    """Return what changes of widths in time, widths with these changes, and levels say: a positive number if
    the bright stripes are the sheets, a negative one if the dark ones are, 0 if nothing tells.

    Sheets are alike in width and keep their widths, while gaps do not. And two sheets differ in brightness,
    while two gaps show the same background. `line` is the sample, lightly smoothed.
    """
    halves = _halfway(line, bright, dark)
    changes = [_width_change(stripes, pitch) for stripes in halves]
    widths = [_bend(stripes.width) for stripes in halves]
    heights = [_bend([row[x] for row, x in zip(line, stripes.x, strict=True)]) for stripes in (bright, dark)]
    if not min(*changes, *widths, *heights) > 0:
        return 0.0, 0.0, 0.0
    in_time, in_space = (float(np.log(dark / bright)) for bright, dark in (changes, widths))
    return in_time, in_time + in_space, float(np.log(heights[0] / heights[1]))


def _clipped(line: Floats32, bright: _MainRidges, settings: TrackingSettings) -> bool:
    """Return whether most bright stripes reach the same level, which is then the camera's ceiling, or the
    brighter half of them does."""
    tops = np.concatenate([row[x] for row, x in zip(line, bright.x, strict=True)])
    low, level, high = np.quantile(tops, [0.05, 0.5, 0.95])
    same = np.median(np.abs(tops - level)) <= settings.same_level * level
    return bool(same or high - level <= settings.ceiling * (level - low))


def _halfway(line: Floats32, bright: _MainRidges, dark: _MainRidges) -> tuple[_MainRidges, _MainRidges]:
    """Return bright and dark stripes between places halfway from dark to bright, with middles and widths.
    Widths at half prominence would change with the neighbours' levels. Halfway is a parabola through the
    levels of all stripes of a frame, so that uneven light does not matter."""
    found: tuple[list[tuple[Floats, Floats]], ...] = ([], [])
    for row, up, down in zip(line, bright.x, dark.x, strict=True):
        edges, rises = np.zeros(0), np.zeros(0, bool)
        if min(len(up), len(down)) >= NEAREST:
            x = np.concatenate([up, down])
            weights = np.repeat([len(up) ** -0.5, len(down) ** -0.5], [len(up), len(down)])
            halfway = np.polynomial.Polynomial.fit(x, row[x].astype(float), 2, w=weights)
            above = row - halfway(np.arange(len(row)))
            before = np.flatnonzero((above[1:] > 0) != (above[:-1] > 0))
            edges = before + above[before] / (above[before] - above[before + 1])
            rises = above[before + 1] > 0
        middle, width = (edges[1:] + edges[:-1]) / 2, np.diff(edges)
        for stripes, its in zip(found, (rises[:-1], ~rises[:-1]), strict=True):
            stripes.append((middle[its], width[its]))
    first, second = (
        _MainRidges(main.comb, [x for x, _ in stripes], [width for _, width in stripes])
        for main, stripes in zip((bright, dark), found, strict=True)
    )
    return first, second


def _background(line: Floats32, bright: _MainRidges, dark: _MainRidges, pitch: float, margin: float) -> float:
    """Return +1 if the background beside the comb is as dark as the dark stripes near by, -1 if as bright as
    the bright ones.

    It is the mean over both ends and all frames in which a pitch is in view there: 0 where the
    background is neither, and 0 if these are less than a tenth of all. An end says nothing if it does so only
    with, or only without, the slope of the light along the comb's first stripes.
    """
    sides = []
    for row, up, down in zip(line, bright.x, dark.x, strict=True):
        if min(len(up), len(down)) < NEAREST:
            continue
        last, bright_px, dark_px = len(row) - 1, np.asarray(up, np.int64), np.asarray(down, np.int64)
        from_right = row[::-1], last - bright_px[::-1], last - dark_px[::-1]
        for at, ups, downs in ((row, bright_px, dark_px), from_right):
            end = min(ups[0], downs[0])
            if end > pitch:
                level = at - np.arange(len(at)) * _slope_at_end(at, ups, downs)
                said = [_beside_end(one, ups, downs, end, pitch, margin) for one in (at, level)]
                sides.append(said[0] if said[0] == said[1] else 0.0)
    return float(np.mean(sides)) if len(sides) > 0.1 * 2 * len(line) else 0.0


def _beside_end(
    line: Floats32 | Floats, ups: Ints, downs: Ints, end: int, pitch: float, margin: float
) -> float:
    """Return +1 if the background before the comb's `end` is as dark as the first dark stripes, -1 if as
    bright as the first bright ones, else 0. ups, downs: places of the bright and dark stripes in a line."""
    beside = line[max(0, int(end - 2.3 * pitch)) : int(end - 0.7 * pitch) + 1]
    high, low = line[ups[:NEAREST]].mean(), line[downs[:NEAREST]].mean()
    level = (np.quantile(beside, [0.1, 0.9]) - low) / (high - low) - 0.5
    return float(level[1] < -margin) - float(level[0] > margin)


def _slope_at_end(line: Floats32, ups: Ints, downs: Ints) -> float:
    """Return the slope of the light over the first stripes of a line (x,), grey levels per px."""
    stripes = ups[:SLOPING], downs[:SLOPING]
    away = np.concatenate([x - x.mean() for x in stripes])
    off = np.concatenate([line[x] - line[x].mean() for x in stripes])
    return float(away @ off / (away @ away))


def _width_change(stripes: _MainRidges, pitch: float) -> float:
    """Return by how much the width of a stripe changes from one frame of the sample to the next, px."""
    changes = [np.zeros(0)]
    for x, width, later, width_later in zip(
        stripes.x, stripes.width, stripes.x[1:], stripes.width[1:], strict=False
    ):
        if len(x) and len(later):
            away = np.abs(later - x[:, None])
            next_ = away.argmin(axis=1)
            same = (away.argmin(axis=0)[next_] == np.arange(len(x))) & (away.min(axis=1) < 0.5 * pitch)
            changes.append(np.abs(width_later[next_] - width)[same])
    found = np.concatenate(changes)
    return float(found.mean()) if len(found) else 0.0


def _bend(values: Sequence[Floats | Floats32]) -> float:
    """Return by how much the value of a stripe typically differs from the mean of both its neighbours."""
    found = np.concatenate([np.abs(np.diff(one, 2)) for one in values])
    return float(np.median(found)) / 2 if len(found) else 0.0


# --- candidates in each frame -------------------------------------------------------------------------------


def find_ridges(profile: Floats32, comb: RidgeComb) -> Ridges:
    """Return the candidate ridges of every frame of a profile (frame, x); frames of NaN have none.

    A candidate is a local maximum of the lightly smoothed profile (a minimum for dark ridges) whose
    prominence within its surroundings reaches a threshold that faint sheets reach, too. The comb's noise and
    contrast set the threshold; with `contrast` 0, its noise alone. Shoulders have no prominence; maxima much
    narrower than a ridge are hot pixels. Source: paper, appendix B (local maxima of I(x)).
    """
    parts = in_blocks(lambda rows: _find_block(profile[rows], comb), profile)
    most = max((int(counts.max()) for counts, _ in parts), default=1)
    tables = table_beside(profile, (3, len(profile), max(1, most)), np.float32)
    tables[:] = np.nan
    start = 0
    for counts, found in parts:  # one row per frame
        frame, rank = flat_ranges(np.zeros_like(counts), counts)
        tables[:, start + frame, rank] = found
        start += len(counts)
    return Ridges(*tables)


def find_faint(profile: Floats32, comb: RidgeComb) -> Ridges:
    """Return all maxima above the noise, of which a decision may say that one is a sheet.

    Of a faint ridge on the flank of a neighbour only the top stands out, as narrow as a hot pixel.
    """
    anything = replace(comb, contrast=0.0, settings=replace(comb.settings, narrowest_widths=0.0))
    return find_ridges(profile, anything)


def in_blocks(work: Callable[[slice], Result], table: NDArray[Any]) -> list[Result]:
    """Return the results of `work` for consecutive blocks of frames of a table (frame, ...), found in two
    threads. The memory of a block in a temporary file is given back."""

    def of_block(rows: slice) -> Result:
        result = work(rows)
        give_back(table[rows])
        return result

    return in_two_threads(of_block, row_parts(len(table), FRAMES_PER_BLOCK))


def _find_block(profile: Floats32, comb: RidgeComb) -> tuple[Ints, Floats32]:
    """Return the number of ridges in each of a block of frames, and position, contrast and width of all in
    turn, (3, ridges).

    The block is searched as one long line, in which three columns stand between the picture's edge and the
    next frame: one higher than the edge by the threshold, the frame's lowest value, and a wall. A ridge that
    the edge cuts thus counts if it rises above the edge by the threshold, with the base on its other side;
    else it is the flank of something outside the picture.
    """
    settings = comb.settings
    smoothing_px = max(0.5, settings.smoothing_widths * comb.fwhm_px)
    least = _noise_floor(comb.noise, smoothing_px, settings)
    threshold = max(least, settings.faint_fraction * comb.contrast)
    reach_px = max(4, round(settings.surroundings_widths * comb.fwhm_px))
    columns, width = 3, profile.shape[1]
    walled = _smoothed(comb.bright(profile), smoothing_px, wall_px=columns)
    inside = walled[:, columns:-columns]
    walled[:, [2, -3]] = inside[:, [0, -1]] + threshold
    walled[:, [1, -2]] = inside.min(axis=1, keepdims=True)
    walled[:, [0, -1]] = walled[:, 2:-2].max() + 1
    maxima = find_maxima(
        walled.ravel(),
        least_prominence=threshold,
        reach=reach_px,
        widest=reach_px,  # a wider plateau is flat background, whose prominence is not defined
    )
    at, prominence = maxima
    widths = half_widths(walled.ravel(), maxima)
    frame, x = np.divmod(at, walled.shape[1])
    x -= columns
    fwhm = np.sqrt(np.maximum(widths**2 - (FWHM * smoothing_px) ** 2, 0.25))
    relative = fwhm / comb.fwhm_px
    keep = (relative >= settings.narrowest_widths) & (relative <= settings.widest_widths)
    keep &= (x >= 0) & (x < width)
    flattened = np.hypot(1, FWHM * smoothing_px / comb.fwhm_px)  # height a Gaussian loses to the smoothing
    counts = np.bincount(frame[keep], minlength=len(profile))
    return counts, np.array([x[keep], prominence[keep] * flattened, fwhm[keep]], np.float32)
