"""Displacement of every sheet from one origin, the same in every figure."""

from __future__ import annotations

import numpy as np
import xarray as xr

from vision.numeric import Bools, Floats, Ints, nan_median

ORIGIN_FRAMES = 20
"""Frames whose median is the origin: the noise of an origin is a quarter of that of a position. More would
reach into the motion of the first stick."""
MOST_SHEETS = 0.9
"""Share of the sheets that a stretch must show. More would wait for sheets that come into view late, while
the others already move; fewer would place many sheets by their neighbours."""
LEAST_FOUND = 0.95
"""Share of the frames in which a sheet must have a position to count in a mean over sheets: a sheet that
comes and goes would shift the mean, a mean over too few sheets is noisier."""


def origin_px(tracks: xr.Dataset) -> Floats:
    """Position of every sheet in the first stretch in which most sheets were measured, (sheet,) in px.

    Parameters
    ----------
    tracks
        From `vision.track_sheets`.

    Returns
    -------
    Medians over up to `ORIGIN_FRAMES` frames, the same frames for all sheets: the first run of frames in
    which nearly as many sheets as ever have a position. A sheet without one there starts, in its own first
    frames, at the displacement that its neighbours have in these frames (linear in n). NaN for a sheet that
    was never found.

    Notes
    -----
    A mean or median over all frames depends on which of them have a position: a gap would shift the whole
    curve against its neighbours'.
    """
    x = np.asarray(tracks["x_px"].values, np.float64)
    known = np.isfinite(x)
    if not known.any():
        return np.full(x.shape[1], np.nan)
    first, last = _first_stretch(known)
    origin = nan_median(x[first:last])
    late = np.flatnonzero(~np.isfinite(origin) & known.any(axis=0))
    placed = np.flatnonzero(np.isfinite(origin))
    signed = np.asarray(tracks["side"].values * tracks["n"].values, np.float64)
    for sheet in late:
        frames = np.flatnonzero(known[:, sheet])[:ORIGIN_FRAMES]
        moved = nan_median(x[np.ix_(frames, placed)] - origin[placed])
        seen = np.flatnonzero(np.isfinite(moved))
        order = seen[np.argsort(signed[placed[seen]])]
        shift = np.interp(signed[sheet], signed[placed[order]], moved[order]) if order.size else 0.0
        origin[sheet] = np.median(x[frames, sheet]) - shift
    return origin


def _first_stretch(known: Bools) -> tuple[int, int]:
    """First and last + 1 of the frames for the origin."""
    frames, sheets = known.shape
    length = min(ORIGIN_FRAMES, frames)
    total = np.concatenate([np.zeros((1, sheets), np.int64), np.cumsum(known, axis=0)])
    whole = (total[length:] - total[:-length] == length).sum(axis=1)  # sheets with a position throughout
    if whole.max() == 0:
        start = int(known.any(axis=1).argmax())
        return start, min(start + length, frames)
    start = int((whole >= MOST_SHEETS * whole.max()).argmax())
    return start, start + length


def _mean(x: Floats) -> Floats:
    """Mean of the known values of each column, NaN without any."""
    known = np.isfinite(x)
    count = known.sum(axis=0)
    total = np.where(known, x, 0).sum(axis=0)
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan))


def outward_px(tracks: xr.Dataset, sheets: Ints | None = None) -> Floats:
    """Mean displacement of sheets away from the axis since the origin, px, (frame,).

    Parameters
    ----------
    tracks
        From `vision.track_sheets`.
    sheets
        Indices of those that count; None for all. Only those with a position in most frames are used, or all
        of them where there is none.

    Returns
    -------
    NaN in frames in which one of the sheets used has no position: without it the mean would jump. Where this
    leaves no frame, the mean over the sheets that have one.
    """
    chosen = np.arange(tracks.sizes["sheet"]) if sheets is None else sheets
    x = np.asarray(tracks["x_px"].values, np.float64)[:, chosen]
    found = np.isfinite(x).mean(axis=0)
    steady = found >= min(LEAST_FOUND, float(found.max(initial=0.0)))
    outward = (x - origin_px(tracks)[chosen]) * tracks["side"].values[chosen]
    whole = np.asarray(outward[:, steady].mean(axis=1)) if steady.any() else np.full(len(x), np.nan)
    return whole if np.isfinite(whole).any() else _mean(outward.T)


def outer_less_inner_px(tracks: xr.Dataset) -> dict[int, Floats]:
    """Outward displacement of the outer third of the sheets less that of the inner third, by side, px.

    Motion of the camera and of the whole sample is in both thirds and drops out; what is left is deformation.
    A side with fewer than three sheets is left out.
    """
    n, side = np.asarray(tracks["n"].values), np.asarray(tracks["side"].values)
    curves = {}
    for which in (-1, 1):
        mine = np.flatnonzero(side == which)
        third = mine.size // 3
        if third:
            ordered = mine[np.argsort(n[mine])]
            curves[which] = outward_px(tracks, ordered[-third:]) - outward_px(tracks, ordered[:third])
    return curves
