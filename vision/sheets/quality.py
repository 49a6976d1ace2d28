"""What the recording does to positions beyond the noise of its pixels: repeated frames, blur, codecs.

`repeated_frames` finds frames that the codec or the recorder repeated; `motion_blur` ridges that moved while
the shutter was open; `scene_changes` where the picture changes for good; `spatial_scatter` errors that
persist from frame to frame; `shared_error` those that neighbours have in common, and `left_out` how much of
the common motion a codec drops.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vision.numeric import NORMAL_MEDIAN, Bools, Floats, Floats32, Strings, nan_median, nan_quantile
from vision.sheets.ridges import FRAMES_PER_BLOCK, RidgeComb, profile_noise
from vision.sheets.settings import DEFAULT, TrackingSettings

FOURTH = np.array([1.0, -4.0, 6.0, -4.0, 1.0])
LEAST_FRAMES = 8
SCENE_FRAMES = 5  # before and after a change of scene that are compared
LAGS = {True: (16, 12, 8, 6, 4, 3, 2, 1), False: (4, 3, 2, 1)}
"""Frames apart at which neighbours are compared, where the codec carries content from frame to frame and
where not: what a codec holds still shows over more frames, but so do motions that sheets have of their own,
and sticks must be longer than twice as many."""


def repeated_frames(profile: Floats32, settings: TrackingSettings = DEFAULT) -> Bools:
    """Frames whose strip is that of the frame before, (frame,).

    Parameters
    ----------
    profile
        Grey levels (frame, x).
    settings
        `frozen_fraction`.

    Notes
    -----
    By the root mean square change from the frame before. Noise alone makes a frame differ from the one before
    by √2 of its standard deviation, within a few per cent; a frame that changes by much less than any other
    of the quietest tenth, and by less than noise, repeats the one before. Without such a gap nothing is
    repeated: where the camera or the sheets vibrate, frames near a turning point change by less than most,
    too.
    """
    change = np.empty(max(0, len(profile) - 1))
    for start in range(0, len(change), FRAMES_PER_BLOCK):
        step = np.diff(profile[start : start + FRAMES_PER_BLOCK + 1], axis=0)
        change[start : start + len(step)] = np.sqrt(np.square(step).mean(axis=1, dtype=np.float64))
    moving = change[np.isfinite(change) & (change > 0)]
    frozen = np.zeros(len(profile), bool)
    # a drawing without noise, or a still: nothing says that a frame should have changed
    if moving.size >= max(LEAST_FRAMES, settings.least_changing * len(change)):
        quiet = np.sort(change[change <= np.quantile(moving, 0.1)])
        gaps = np.flatnonzero(quiet[:-1] < settings.frozen_fraction * quiet[1:])
        if gaps.size:
            known = np.flatnonzero(np.isfinite(change))
            some = known[np.linspace(0, len(known) - 1, 200).astype(int)]
            frozen[1:] = change <= min(quiet[gaps[-1]], np.sqrt(2) * profile_noise(profile[some]))
    return frozen


class Blur(NamedTuple):
    """Both (frame, N).

    Parameters
    ----------
    blurred
        Ridges that moved while the shutter was open.
    err_px
        What this may shift them by, 0 elsewhere.
    """

    blurred: Bools
    err_px: Floats


def motion_blur(
    x_px: Floats, contrast: Floats, fwhm_px: Floats, comb: RidgeComb, settings: TrackingSettings = DEFAULT
) -> Blur:
    r"""Ridges smeared by their motion within one exposure.

    Parameters
    ----------
    x_px, contrast, fwhm_px
        Position, height and width of the ridges (frame, N), NaN where missing.
    comb
        Width and pitch of the ridges.
    settings
        The fields `blur_…`.

    Notes
    -----
    A ridge that jumps by D while the shutter is open, after a fraction p of it, is drawn twice, p and 1 − p
    high. The fit follows the higher part and is off by up to :math:`\min(p, 1-p)\,D`, the loss of height
    times the jump between the frames on both sides; by less where both parts merge into one wider ridge.
    Where the jump is about a pitch the second part lies on a neighbour's first and nothing is lower: there
    sheets of the same frame that moved otherwise tell p. Blurred are ridges that moved by more than a
    fraction of their width and are wider or lower than usual by more than their scatter.
    """
    moved = np.zeros_like(x_px)
    moved[1:-1] = np.nan_to_num(np.abs(x_px[2:] - x_px[:-2]))
    steps = np.nan_to_num(np.abs(np.diff(x_px, axis=0)))
    moved[1:] = np.maximum(moved[1:], steps)
    moved[:-1] = np.maximum(moved[:-1], steps)
    with np.errstate(divide="ignore", invalid="ignore"):
        lower, wider = -np.log(contrast), np.log(fwhm_px)
    fast = (moved > settings.blur_fraction * comb.fwhm_px) & np.isfinite(x_px)
    sampled = 0.7 / comb.fwhm_px**2  # height that a ridge between two pixels loses
    excess = np.maximum(_excess(lower, sampled), _excess(wider, sampled))
    blurred = fast & (excess > settings.blur_sigmas)
    # too little to be flagged, not too little to matter
    suspect = fast & (excess > 0.5 * settings.blur_sigmas)
    loss = np.clip(1 - np.exp(-np.nan_to_num(lower - nan_median(lower))), 0.0, 0.5)
    apart = moved / comb.fwhm_px
    pitches = np.maximum(np.rint(moved / comb.pitch_px), 1.0)
    over = fast & (np.abs(moved - pitches * comb.pitch_px) < settings.blur_overlap * comb.fwhm_px)
    telling = fast & ~over & (apart > 0.5)
    told = nan_quantile(np.where(telling, loss, np.nan), 0.75, axis=1)[:, None]
    most = nan_quantile(np.where(telling, excess, np.nan), 0.75, axis=1)[:, None]
    loss = np.where(over, np.fmax(loss, told), loss)
    blurred |= over & (most > settings.blur_sigmas)
    suspect |= over & (most > 0.5 * settings.blur_sigmas)
    share = np.minimum(0.8, apart)  # two parts nearer than a width merge, and the fit takes the middle
    return Blur(blurred, np.where(suspect, settings.blur_error * loss * moved * share, 0.0))


def _excess(values: Floats, least: float) -> Floats:
    """How far values (frame, N) exceed each sheet's median, in its standard deviations."""
    off = values - nan_median(values)
    spread = nan_median(np.abs(off)) / NORMAL_MEDIAN
    return np.nan_to_num(np.maximum(off - least, 0.0) / np.maximum(spread, 0.004))


def beside_missing(flag: Strings) -> Bools:
    """Positions (frame, N) next to a sheet that is missing in that frame. What covers a sheet cuts into the
    next one, whose ridge then jumps and changes its shape as if it were blurred, and may be off by half of
    its width."""
    missing = np.pad(flag == "missing", ((0, 0), (1, 1)))
    return np.asarray(missing[:, :-2] | missing[:, 2:], bool)


class BetweenSlips:
    """Positions (frame, N), NaN where missing or repeated, and between which frames lies a slip: there sheets
    move by more than usual, and neighbours alike; where a codec draws anew they do not."""

    def __init__(self, x_px: Floats) -> None:
        self.frames = len(x_px)
        self.x_px = x_px[np.isfinite(x_px).any(axis=1)]
        self.slips = np.zeros(len(self.x_px), np.int64)
        if x_px.shape[1] < len(FOURTH):
            return
        step = np.diff(self.x_px, axis=0)
        apart = nan_quantile(np.abs(_fourth(step)), 0.75, axis=1)
        slip = np.zeros(len(step), bool)
        for moved in (step, step - nan_median(step, axis=1)[:, None]):  # a camera that shakes hides no slip
            size = nan_quantile(np.abs(moved), 0.75, axis=1)
            slip |= (size > 3 * nan_median(size[size > 0])) & (size > 3 * apart)
        self.slips = np.cumsum(np.r_[0, slip])

    def second(self, lags: Sequence[int], values: Floats | None = None) -> Floats:
        """Second differences in time of values (frame, …), of the positions by default, without a slip
        between the three frames, over the first of these lags that leaves enough; scaled to keep the
        deviation of independent values. (…, N)."""
        x = self.x_px if values is None else values
        for lag in lags:
            calm = self.slips[2 * lag :] == self.slips[: -2 * lag]
            if calm.sum() >= LEAST_FRAMES:
                return np.asarray((x[2 * lag :] - 2 * x[lag:-lag] + x[: -2 * lag])[calm] / np.sqrt(6))
        return x[:0]


def spatial_scatter(positions: BetweenSlips, *, between_frames: bool) -> Floats:
    """Scatter of each sheet's position against its neighbours', px, (N,).

    From fourth differences along n, which a motion smooth in n hardly has, of second differences in time over
    up to 4 frames without a slip, or 16 where a codec carries content between frames: sheets that creep or
    jump by amounts of their own do not enter. Unlike the scatter from frame to frame it sees errors that a
    codec carries from one frame into the next. NaN with fewer than five sheets, and where slips leave too few
    frames between them.
    """
    sheets, second = positions.x_px.shape[1], positions.second(LAGS[between_frames])
    if sheets < len(FOURTH) or not len(second):
        return np.full(sheets, np.nan)
    return np.asarray(np.pad(_deviation(_fourth(second)), 2, mode="edge"), np.float64)


class SceneChange(NamedTuple):
    """The frame from which on the sheets stand or look otherwise for good.

    Parameters
    ----------
    frame
        The first frame of the new scene.
    moved_px
        By how much all sheets are displaced together.
    brightness
        Change of the logarithm of their brightness, rms over the sheets, common changes left out.
    """

    frame: int
    moved_px: float
    brightness: float


def scene_changes(
    x_px: Floats, contrast: Floats, comb: RidgeComb, settings: TrackingSettings = DEFAULT
) -> list[SceneChange]:
    """Where the film was cut, or the camera or the light was moved: sheets before and after may be others.

    Parameters
    ----------
    x_px, contrast
        Positions and heights of the ridges (frame, N), NaN where missing.
    comb
        Pitch of the ridges.
    settings
        `cut_pitches`, `cut_brightness`, `cut_ratio`.

    Returns
    -------
    Changes in order of time; none where such changes are usual in the film.

    Notes
    -----
    Means over five frames before and after are compared. In a slip the sides of the comb move against each
    other and every sheet keeps its looks. It is another scene where all sheets are displaced by more than the
    comb's ends are against each other, or their brightnesses change, once and by several times what is usual,
    and most of that is left some frames later: a camera that was knocked swings back.
    """
    frames, sheets = x_px.shape
    if frames < 4 * SCENE_FRAMES or sheets < 3:
        return []
    bright = np.log(contrast)
    bright -= nan_median(bright, axis=1)[:, None]
    moved, looks = (_after_less_before(values) for values in (x_px, bright))
    together = nan_median(moved, axis=1)
    apart = np.abs(moved - together[:, None])
    rigid = np.abs(together) > 2.0 * np.nan_to_num(nan_median(apart, axis=1), nan=np.inf)
    size = np.where(rigid, np.abs(np.nan_to_num(together)) / comb.pitch_px / settings.cut_pitches, 0.0)
    known = np.isfinite(looks)
    change = np.sqrt((np.where(known, looks, 0.0) ** 2).sum(axis=1) / np.maximum(known.sum(axis=1), 1))
    change[known.sum(axis=1) < max(3, sheets / 2)] = 0.0
    found = []
    sorts = ((size, 1.0, x_px, together), (change, settings.cut_brightness, bright, change))
    for values, limit, measured, by in sorts:
        least = max(limit, settings.cut_ratio * float(np.median(values)))
        at = int(np.argmax(values))
        others = np.abs(np.arange(len(values)) - at) > 2 * SCENE_FRAMES
        once = values[at] >= least and (values[others] < values[at] / 2).all()
        if once and _lasts(measured, at + SCENE_FRAMES, by[at]):
            found.append(at)
    if len(found) == 2 and abs(found[0] - found[1]) <= SCENE_FRAMES:
        found = found[:1]
    return [
        SceneChange(at + SCENE_FRAMES, float(np.nan_to_num(together[at])), float(change[at]))
        for at in sorted(found)
    ]


def _lasts(values: Floats, frame: int, change: float) -> bool:
    """Whether half of a change of values (frame, N) is left three times SCENE_FRAMES after a frame."""
    later = values[frame + 3 * SCENE_FRAMES :][:SCENE_FRAMES]
    left = nan_median(later) - nan_median(values[:frame][-4 * SCENE_FRAMES :])
    left = left[np.isfinite(left)]
    return not len(left) or bool(np.sqrt((left**2).mean()) >= abs(change) / 2)


def _after_less_before(values: Floats) -> Floats:
    """Mean of SCENE_FRAMES frames less that of as many before them, (frame − 2 SCENE_FRAMES + 1, N)."""
    known = np.isfinite(values)
    with np.errstate(divide="ignore", invalid="ignore"):
        means = _sums(np.where(known, values, 0.0)) / _sums(known.astype(np.float64))
    return np.asarray(means[SCENE_FRAMES:] - means[:-SCENE_FRAMES], np.float64)


def _sums(values: Floats) -> Floats:
    """Sums over SCENE_FRAMES frames."""
    total = np.vstack([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    return np.asarray(total[SCENE_FRAMES:] - total[:-SCENE_FRAMES], np.float64)


def shared_error(positions: BetweenSlips, *, between_frames: bool) -> float:
    r"""Error that neighbouring sheets share on compressed film, px.

    Parameters
    ----------
    positions
        Of the sheets in all frames.
    between_frames
        Whether the codec carries content from frame to frame; else only the first part below counts.

    Returns
    -------
    float
        To be added in quadrature to `spatial_scatter`, which does not see it; 0 for fewer than eight sheets
        or frames.

    Notes
    -----
    Blocks of the codec are wider than a sheet's spacing, and predicted frames move them by quarter pixels.

    1. Sheets in one block err together. Second differences of positions in time, without what all sheets do,
       scatter by :math:`a` over all sheets and by :math:`b` between neighbours (`spatial_scatter`):
       :math:`c = (a^2 - b^2)^{1/2}`.
    2. All sheets err together, too, which cannot be told from the camera's shaking: by c again, or, where the
       shaking seen from frame to frame, s, is large against b, by :math:`b\,s/(s + 2b)`, whichever is more.
       Both were measured on H.264, HEVC, MPEG-2, MPEG-4 and VP9 (reports/degraded.md).
    """
    found = _shared(positions, between_frames=between_frames)
    return float(np.hypot(found.blocks, found.all_sheets))


def left_out(positions: BetweenSlips) -> float:
    """What a codec left out of the motion that all sheets share, over what is left of it, see
    `shared_error`: the error that all sheets share."""
    found = _shared(positions, between_frames=True)
    return found.all_sheets / max(found.shaking, 1e-9)


class _Shared(NamedTuple):
    """What blocks of sheets err together, what all sheets do, and what these move from frame to frame, px."""

    blocks: float
    all_sheets: float
    shaking: float


def _shared(positions: BetweenSlips, *, between_frames: bool) -> _Shared:
    if positions.x_px.shape[1] < len(FOURTH) + 3 or positions.frames < 2 * LEAST_FRAMES:
        return _Shared(0.0, 0.0, 0.0)
    second = positions.second(LAGS[between_frames])
    own = _deviation_of_all(_fourth(second))
    apart = _deviation_of_all(second - nan_median(second, axis=1)[:, None])
    blocks = float(np.sqrt(max(0.0, apart**2 - own**2)))
    shaking = _deviation_of_all(positions.second((1,), nan_median(positions.x_px, axis=1)[:, None]))
    followed = own * shaking / max(shaking + 2 * own, 1e-9)
    return _Shared(blocks, max(blocks, followed) if between_frames else 0.0, shaking)


def _fourth(x_px: Floats) -> Floats:
    """Fourth differences along n, (frame, N − 4), scaled to keep the deviation of independent values."""
    last = x_px.shape[1] - len(FOURTH) + 1
    parts = [x_px[:, k : k + last] * weight for k, weight in enumerate(FOURTH)]
    return np.asarray(np.sum(parts, axis=0) / np.sqrt((FOURTH**2).sum()), np.float64)


def _deviation(values: Floats) -> Floats:
    """Standard deviation about zero along the first axis, from sizes cut at their 0.9 quantile, which leaves
    0.9118 of a normal variable's; NaN where nothing is known. A median is zero where codecs repeat blocks."""
    size = np.abs(values)
    with np.errstate(divide="ignore", invalid="ignore"):
        cut = np.nan_to_num(np.minimum(size, nan_quantile(size, 0.9)) ** 2)
        return np.asarray(np.sqrt(cut.sum(axis=0) / np.isfinite(size).sum(axis=0)) / 0.9118)


def _deviation_of_all(values: Floats) -> float:
    """The same of all values; 0 where nothing is known."""
    return float(np.nan_to_num(_deviation(values.ravel()))) if values.size else 0.0
