"""How the whole comb moves: its squeeze, and its displacement."""

from __future__ import annotations

import numpy as np

from vision.numeric import Bools, Floats, Floats32, in_two_threads, nan_median, row_parts
from vision.sheets.ridges import RidgeComb, Ridges
from vision.sheets.settings import TrackingSettings
from vision.signals import running_median


def comb_squeeze(ridges: Ridges, settings: TrackingSettings) -> tuple[Floats, float]:
    """Return the mean spacing in each frame over that of the film, (frame, 1), and the comb's middle, px.

    The ratio is 1 in all frames of a film in which it hardly changes.
    The quantiles of the spacings are compared with their usual values, since spacings may be of several
    kinds; those of a missing sheet or a false detection are beyond the quantiles. A squeeze changes all of
    them alike: `squeeze_share` of the variance of their logarithms must be common.
    """
    middle_px, still = float(nan_median(ridges.x_px.ravel())), np.ones((len(ridges.x_px), 1))
    sheets = np.maximum(ridges.count, 1)
    usual = np.median(sheets)
    # Without frames in which many are covered, or in which two frames share an image and many are seen twice.
    rows = np.flatnonzero((2 * sheets >= usual) & (4 * sheets <= 5 * usual) & (sheets > 1))
    if not len(rows):
        return still, middle_px
    parts = in_two_threads(lambda part: _log_spacings(ridges.x_px[rows[part]]), row_parts(len(rows)))
    change = np.concatenate(parts)
    change -= np.median(change, axis=0)
    common = change.mean(axis=1)
    scale = running_median(np.exp(np.interp(np.arange(len(still)), rows, common)), 3)
    least, most = np.quantile(scale, (0.02, 0.98))
    squeezed = (most / least - 1) * usual / 2 >= settings.least_squeeze
    squeezed &= common.var() >= settings.squeeze_share * change.var()
    return scale[:, None] if squeezed else still, middle_px


def _log_spacings(x_px: Floats32) -> Floats:
    """Return the logarithms of quantiles of the spacings in each frame, (frame, 17)."""
    gap = np.diff(x_px.astype(np.float64), axis=1)
    last = np.isfinite(gap).sum(axis=1)[:, None] - 1
    gap.sort(axis=1)  # NaN last; nanquantile takes forty times as long
    at = np.linspace(0.1, 0.9, 17) * last
    lower = at.astype(np.int64)
    low, high = (np.take_along_axis(gap, k, axis=1) for k in (lower, np.minimum(lower + 1, last)))
    return np.asarray(np.log(low + (at - lower) * (high - low)), np.float64)


def comb_displacement(ridges: Ridges, comb: RidgeComb) -> Floats:
    """Return the displacement of the whole comb since the first frame, px, (frame,).

    It is the sum of mean steps from each ridge to the nearest ridge of the next frame. Only steps within a
    pixel of their median enter (positions are whole pixels). Where most steps are too large to identify the
    same ridge, the step is 0.
    """
    frames = len(ridges.x_px)
    apart = 4.0 * (float(np.nanmax(ridges.x_px, initial=0.0)) + comb.pitch_px)
    if not ridges.count.any():
        return np.zeros(frames)
    moved, followed = np.zeros(frames - 1), np.zeros(frames - 1, bool)

    def follow(rows: slice) -> None:
        near = np.arange(rows.start, rows.stop + 1)
        moved[rows], followed[rows] = _mean_steps(ridges.x_px[near] + apart * near[:, None], apart, comb)

    in_two_threads(follow, row_parts(frames - 1))
    return np.concatenate([[0.0], np.cumsum(np.where(followed, moved, 0.0))])


def _mean_steps(in_one_row: Floats, apart: float, comb: RidgeComb) -> tuple[Floats, Bools]:
    """Return the mean step of the ridges from each frame to the next, and whether most were followed.

    in_one_row: positions in frames that lie `apart` in one row, px, (frame, K).
    """
    row = in_one_row[np.isfinite(in_one_row)]
    if not len(row):
        return np.zeros(len(in_one_row) - 1), np.zeros(len(in_one_row) - 1, bool)
    same = in_one_row[:-1] + apart  # positions in the next frame if nothing moves
    after = np.searchsorted(row, np.nan_to_num(same))
    near = np.stack([row[np.clip(after - 1, 0, len(row) - 1)], row[np.clip(after, 0, len(row) - 1)]]) - same
    step = np.where(np.abs(near[0]) < np.abs(near[1]), near[0], near[1])
    small = np.abs(step) < comb.settings.step_fraction * comb.pitch_px
    followed = small.sum(axis=1) > 0.5 * np.isfinite(same).sum(axis=1)
    small &= np.abs(step - nan_median(np.where(small, step, np.nan), axis=1)[:, None]) <= 1.0
    return np.where(small, step, 0.0).sum(axis=1) / np.maximum(small.sum(axis=1), 1), followed
