"""Scatter of positions: what errors from frame to frame, between sheets, and of a codec add up to.

`BetweenSlips` are positions without slips. `spatial_scatter` measures errors that persist from frame to
frame, `shared_error` those that neighbours share, and `noise_excess` what all stated errors leave out;
`raise_left_behind` adds what a codec does not code, and positions do not show.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vision.memory import in_two_threads, row_parts
from vision.numeric import NORMAL_MEDIAN, Bools, Floats, nan_median, nan_quantile, typical_median
from vision.sheets.settings import DEFAULT, LEAST_FRAMES, QUARTER_PIXEL, TrackingSettings

FOURTH = np.array([1.0, -4.0, 6.0, -4.0, 1.0])
OPENING = 10  # sheets that show the opening of the comb
NOISE_LAGS = range(2, 9)  # frames: an error that repeats itself vanishes at some of them
SIZED_FRAMES = 2048
"""Frames of a long film by whose scatter errors are judged. Fewer judge worse (these to 1 %), more take
longer and more memory: of 9600 frames all tables of the tracking fit beside them (test_scatter.py,
test_tracks.py)."""
STRETCH_FRAMES = 32  # consecutive ones of these: of single frames evenly spread, all may be even ones
ONE_SIGMA = 0.6827  # share of values that lie within one standard deviation
LAGS = (4, 3, 2, 1)
"""Lags, in frames, of second differences in time."""
LONG_LAGS = (12, 8, 6, *LAGS)
"""The lags for codecs that predict frames from others. Content that a codec keeps unchanged shows at longer
lags; but so do bent creep and the individual motion of sheets, and stick phases must be longer than two
lags."""
TINY = np.finfo(float).tiny


class BetweenSlips:
    """Positions (frame, N), NaN where missing or repeated, divided at the slips.

    In a slip sheets move by more than usual, and neighbours move alike. Where a codec redraws a frame,
    neighbours do not move alike.
    """

    def __init__(self, x_px: Floats) -> None:
        self.frames = len(x_px)
        self.seen = np.isfinite(x_px).any(axis=1)
        # most is computed of one sheet after the other
        self.x_px = np.asfortranarray(x_px if self.seen.all() else x_px[self.seen])
        self.slips = np.zeros(len(self.x_px), np.int64)
        if x_px.shape[1] < len(FOURTH):
            return
        apart, *sizes = np.empty((3, max(0, len(self.x_px) - 1)))

        def measure(rows: slice) -> None:
            step = np.diff(self.x_px[rows.start : rows.stop + 1], axis=0)
            apart[rows] = nan_quantile(np.abs(_fourth_differences(step)), 0.75, axis=1)
            # vibration hides slips in the steps, but not in those without the common motion
            for size, moved in zip(sizes, (step, step - nan_median(step, axis=1)[:, None]), strict=True):
                size[rows] = nan_quantile(np.abs(moved), 0.75, axis=1)

        in_two_threads(measure, row_parts(len(apart)))
        slip = np.zeros(len(apart), bool)
        for size in sizes:
            slip |= (size > 3 * nan_median(size[size > 0])) & (size > 3 * apart)
        self.slips = np.cumsum(np.r_[0, slip])

    def second(self, lags: Sequence[int], values: Floats | None = None) -> Floats:
        """Return second differences in time that contain no slip, (…, N).

        They are of values (frame, …), by default the positions, at the first of these lags that leaves enough
        frames, and are scaled to keep the standard deviation of independent values.
        """
        x = self.x_px if values is None else values
        for lag in lags:
            calm = self.without_slip(2 * lag)
            if calm.sum() >= LEAST_FRAMES:
                second = -2.0 * x[lag:-lag] + x[: -2 * lag] + x[2 * lag :]
                return np.asarray(second[calm] / np.sqrt(6), np.float64)
        return x[:0]

    def settled(self) -> Bools:
        """Return which frames are in the later half of a stick; all if there are no slips."""
        _, first, length = np.unique(self.slips, return_index=True, return_counts=True)
        since = np.arange(len(self.slips)) - np.repeat(first, length)
        return np.asarray((2 * since >= np.repeat(length, length)) | (len(first) == 1), bool)

    def without_slip(self, frames: int) -> Bools:
        """Return whether this many frames follow each frame without a slip, for all but the last of them."""
        return np.asarray(self.slips[frames:] == self.slips[:-frames], bool)


def _fitted(sheets: int) -> float:
    """Return how many sheets' scatter is lost with the median motion: a line along n, or of few a level."""
    return 3.0 if sheets >= OPENING else 1.25


def spatial_scatter(positions: BetweenSlips, *, between_frames: bool) -> Floats:
    """Return the scatter of each sheet's position against its neighbours, px, (N,).

    It is the deviation of fourth differences along n, in which a motion smooth in n hardly shows, of second
    differences in time, in which the creep and the jumps of single sheets do not show. The lag in time is up
    to 4 frames, or up to 12 where a codec predicts frames from others. Unlike the scatter from frame to frame
    it includes errors that a codec carries from one frame to the next. NaN for fewer than five sheets, and
    where slips leave too few frames between them.
    """
    x, lags = positions.x_px, LONG_LAGS if between_frames else LAGS
    sheets = x.shape[1]
    if sheets < len(FOURTH) or not len(positions.second(lags, x[:, :1])):
        return np.full(sheets, np.nan)
    around = (x[:, k : k + len(FOURTH)] for k in range(sheets - len(FOURTH) + 1))
    scatter = [_deviation(_fourth_differences(positions.second(lags, five))[:, 0]) for five in around]
    return np.asarray(np.pad(np.array(scatter), 2, mode="edge"), np.float64)


def noise_excess(positions: BetweenSlips, err_px: Floats, settings: TrackingSettings = DEFAULT) -> Floats:
    r"""Return how much more positions scatter than their errors (frame, N) say, as a factor, (N,).

    Turbulent air, flicker that differs between rows, and a camera that shakes along leaning sheets shift each
    ridge by another amount, and leave its shape unchanged. This shows in second differences of positions in
    time, between slips: those of the film, and those of the sheet itself, since often only the outer sheets
    of one side slip. The motion that all sheets share is subtracted. With ten sheets or more, so is a share
    in the opening of the comb, the motion of its outer thirds against each other: either one linear in n (a
    camera that vibrates or breathes), or that of the sheets beside, which move alike when slips are slow or
    come in every frame, whichever leaves less. Sizes at several lags are averaged as squares, since at one
    lag an error that lasts or repeats itself may cancel; a size is the one within which 68 % of the frames
    lie, in whole sticks or in their later halves, whichever is less: vibration of single sheets counts as an
    error, ringing after slips does not. 1 for fewer than five sheets, and where slips leave too few frames
    between them.
    """
    sheets = err_px.shape[1]
    if sheets < len(FOURTH):
        return np.ones(sheets)
    x_px, slips = positions.x_px, _slips_of_sheets(positions.x_px, settings)
    settled, seen = positions.settled(), np.flatnonzero(positions.seen)

    def size(lag: int) -> Floats:
        calm = np.flatnonzero(positions.without_slip(2 * lag))
        if len(calm) < 2 * LEAST_FRAMES:
            return np.full((2, sheets), np.nan)
        first = calm[np.arange(len(calm)) // STRETCH_FRAMES % -(-len(calm) // SIZED_FRAMES) == 0]
        middle, last = first + lag, first + 2 * lag
        second = -2.0 * x_px[middle]
        second += x_px[first]
        second += x_px[last]
        second /= np.sqrt(6)
        second[slips[last] != slips[first]] = np.nan
        opening, shares = _motion(second)
        expected = 4 * err_px[seen[middle]] ** 2
        expected += err_px[seen[first]] ** 2
        expected += err_px[seen[last]] ** 2
        expected = np.sqrt(expected / 6)
        late = settled[first]
        late |= late.sum() < 2 * LEAST_FRAMES  # a quantile of fewer is too small
        of_sheets = []
        for share in shares:
            scatter = second - opening[:, None] * share
            np.abs(scatter, out=scatter)
            scatter /= expected
            of_sheets.append(np.array([nan_quantile(some, ONE_SIGMA) for some in (scatter, scatter[late])]))
        return min(of_sheets, key=lambda of_lag: float(nan_median(of_lag[0])))

    sizes = np.array(in_two_threads(size, NOISE_LAGS))
    total, count = np.nansum(sizes**2, axis=0), np.isfinite(sizes).sum(axis=0)
    excess = np.sqrt(total / np.where(count, count, np.nan) / (1 - _fitted(sheets) / sheets))
    usual = np.nan_to_num(np.nanmin(nan_median(excess, axis=1), initial=np.inf), nan=1.0, posinf=1.0)
    excess = np.fmin(*excess)
    own = np.where(excess > settings.own_excess * usual, excess, usual)
    return np.fmin(own, settings.most_own_excess * usual)


def _slips_of_sheets(x_px: Floats, settings: TrackingSettings) -> NDArray[np.int32]:
    """Return the number of slips of each sheet up to each frame, beyond the common motion, (frame, N)."""
    step = np.diff(x_px, axis=0)
    step -= nan_median(step, axis=1)[:, None]
    step -= typical_median(step)
    np.abs(step, out=step)
    slips = np.zeros(x_px.shape, np.int32)
    np.cumsum(step > settings.slip_sigmas * typical_median(step) / NORMAL_MEDIAN, axis=0, out=slips[1:])
    return slips


def shared_error(positions: BetweenSlips) -> float:
    r"""Return the error that neighbouring sheets share where a codec predicts frames from others, px.

    It is to be added in quadrature to `spatial_scatter`, which does not include it. 0 for fewer than eight
    sheets or sixteen frames.

    Blocks of the codec are wider than a sheet's spacing, and sheets in one block share an error. Second
    differences of positions in time, without the motion of the comb (`_motion`), scatter by :math:`a` over
    all sheets and by :math:`b` between neighbours: :math:`c = s_x\,(a^2/b^2 - 1)^{1/2}`, with :math:`s_x` the
    usual `spatial_scatter`. The ratio a/b is taken at a lag of at most four frames: creep that bends in a
    stick shows in a at longer ones. As much again is shared by all sheets (reports/degraded.md: H.264, HEVC,
    MPEG-2, MPEG-4 and VP9).
    """
    sheets = positions.x_px.shape[1]
    if sheets < len(FOURTH) + 3 or positions.frames < 2 * LEAST_FRAMES:
        return 0.0
    own = float(np.nan_to_num(nan_median(spatial_scatter(positions, between_frames=True))))
    second = positions.second(LAGS)
    between = _deviation(_fourth_differences(second))
    opening, shares = _motion(second)
    apart = min(_deviation(second - opening[:, None] * share) for share in shares)
    ratio = float(np.nan_to_num(apart / max(between, 1e-9) / np.sqrt(1 - _fitted(sheets) / sheets)))
    return own * float(np.sqrt(2 * max(0.0, ratio**2 - 1)))


def raise_left_behind(err_px: Floats, x_px: Floats, step_px: Floats, settings: TrackingSettings) -> None:
    """Raise errors (frame, N), in place, to how far a codec that predicts frames leaves ridges behind.

    It codes no change of a block below a share of its quantiser's step. A ridge that creeps or vibrates so
    far stays where it was drawn last, which no scatter shows; further than quarter pixels it is drawn where
    it is, as these are how codecs state motion. One that moves at once, in a slip or with the camera, is left
    behind by a share of that motion, up to a larger share of the step.

    x_px: positions, NaN where missing or repeated, (frame, N). step_px: shift of a ridge that changes its
    pixels by one step of the quantiser, (N,).
    """
    least, most, share = settings.left_behind
    np.fmax(err_px, np.fmin(least * step_px, QUARTER_PIXEL), out=err_px)
    for rows in row_parts(len(x_px) - 1):
        moved = np.abs(np.diff(x_px[rows.start : rows.stop + 1], axis=0))
        later = err_px[rows.start + 1 : rows.stop + 1]
        np.fmax(later, np.fmin(share * moved, most * step_px), out=later)


def _motion(second: Floats) -> tuple[Floats, list[Floats]]:
    """Subtract the motion that all sheets share from second differences (frame, N), in place.

    Returns the opening of the comb, the motion of its outer thirds against each other, (frame,), and shares
    in it that sheets may have, (N,): one linear in n and that of the sheets beside; none for fewer than ten
    sheets.
    """
    second -= nan_median(second, axis=1)[:, None]
    sheets = second.shape[1]
    if sheets < OPENING:
        return np.zeros(len(second)), [np.zeros(sheets)]
    third, place = sheets // 3, np.arange(sheets) - (sheets - 1) / 2
    low, high = (nan_median(part, axis=1) for part in (second[:, :third], second[:, -third:]))
    opening = np.nan_to_num(high - low)
    known = np.isfinite(second)
    share = opening @ np.where(known, second, 0.0) / np.fmax(opening**2 @ known, TINY)
    beside = np.pad(share, 1, "reflect", reflect_type="odd")
    return opening, [place / (sheets - third), (beside[:-2] + beside[2:]) / 2]


def _fourth_differences(x_px: Floats) -> Floats:
    """Return fourth differences along n, (frame, N − 4), scaled as `BetweenSlips.second` is."""
    last = x_px.shape[1] - len(FOURTH) + 1
    fourth = x_px[:, :last] * FOURTH[0]
    for k, weight in enumerate(FOURTH[1:], 1):
        fourth += x_px[:, k : k + last] * weight
    fourth /= np.sqrt((FOURTH**2).sum())
    return np.asarray(fourth, np.float64)


def _deviation(values: Floats) -> float:
    """Return a robust standard deviation of values about zero, NaN where nothing is known. Absolute values
    are limited to their 0.9 quantile, which reduces a normal variable's deviation to 0.9118. A median
    absolute deviation would be zero where codecs repeat blocks."""
    size = np.abs(values.ravel())
    count = np.isfinite(size).sum()
    if not count:
        return np.nan
    np.minimum(size, nan_quantile(size, 0.9), out=size)
    np.square(np.nan_to_num(size, copy=False), out=size)
    return float(np.sqrt(size.sum() / count) / 0.9118)
