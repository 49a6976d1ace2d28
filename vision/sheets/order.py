"""Frames that do not show one moment in its turn: neighbours in the wrong order, in which every sheet goes
back for one frame, and frames that a converter mixed from two, which have less noise."""

from __future__ import annotations

import numpy as np

from vision.memory import some_rows
from vision.numeric import (
    Bools,
    Floats,
    Floats32,
    Ints,
    in_two_threads,
    nan_median,
    row_parts,
    spread_indices,
)
from vision.sheets.settings import DEFAULT, TrackingSettings
from vision.signals import running_median

FEWEST = 3  # sheets, less the motion that they share; and mixed frames, that scatter
SUCCESSIVE = 64  # frames of a stretch that shows mixed frames
STRETCHES = 32  # spread over a film
AROUND = 9  # frames whose median change is usual
NOISE_ORDER = 6  # of the differences along x, which hardly contain ridges


def exchanged_frames(x_px: Floats, err_px: Floats, settings: TrackingSettings = DEFAULT) -> Ints:
    r"""Return the rows of frames that show what the next frame should, and the reverse; none if in doubt.

    x_px, err_px: positions and their errors (frame, N), NaN where missing.

    Let :math:`a`, :math:`b` and :math:`c` be the displacements (N,) between four successive frames, less
    what all sheets share, weighted by the errors. If the middle two are exchanged, these are :math:`p+q`,
    :math:`-q` and :math:`q+r`, with the true displacements :math:`p`, :math:`q` and :math:`r`: b is opposite
    to both others. Their sizes relative to b, :math:`-a\cdot b/b^2` and :math:`-c\cdot b/b^2`, are 1 if the
    sheets slip between the exchanged frames, 2 if they creep, and 3 if both pairs beside them are exchanged
    as well. Sheets or a camera that vibrate go back too, but by any part of the steps before and after, or
    in many successive frames. Exchanged frames are therefore reported where their number exceeds
    `exchanged_least` and twice that of the other returns, or where all frames are (`_pair_by_pair`).
    """
    if len(rows := _pair_by_pair(x_px, err_px, settings)):
        return rows
    ratio = np.zeros((2, max(0, len(x_px) - 3)))

    def compare(rows: slice) -> None:
        part = slice(rows.start, rows.stop + 3)
        ratio[:, rows] = _returns(x_px[part], err_px[part], settings)

    in_two_threads(compare, row_parts(ratio.shape[1]))
    nearest = np.rint(ratio)
    whole = ((nearest >= 1) & (np.abs(ratio - nearest) < settings.exchanged_whole)).all(axis=0)
    beside, two_away = (np.pad(whole, distance) for distance in (1, 2))
    creep = 2 + np.stack([two_away[:-4], two_away[4:]])
    whole &= ((nearest == 1) | (nearest == creep)).all(axis=0) & ~beside[:-2] & ~beside[2:]
    others = int(((ratio > 0).all(axis=0) & ~whole & ~beside[:-2] & ~beside[2:]).sum())
    few = whole.sum() < settings.exchanged_least or whole.sum() <= 2 * others
    return np.zeros(0, np.int64) if few else np.flatnonzero(whole) + 1


def _pair_by_pair(x_px: Floats, err_px: Floats, settings: TrackingSettings) -> Ints:
    """Return every second row of a film in which all frames are exchanged with the next, as by fields in the
    wrong order, though the sheets creep too little for a pair to show it; none of other films.

    The median displacements over each other pair of frames are then 3 and -1 times the creep. Films are not
    seen in which a frame is lost: from there on it is the other pairs that go back.
    """
    none = np.zeros(0, np.int64)
    if len(x_px) < 2 * FEWEST + 1:
        return none
    first = 2 * spread_indices((len(x_px) - 1) // 2, SUCCESSIVE * STRETCHES)
    steps = np.stack([nan_median(x_px[first + k + 1] - x_px[first + k]) for k in (0, 1)])
    variance = np.pi * nan_median(err_px[first]) ** 2 / len(first)  # of such a median
    known = np.isfinite(steps).all(axis=0) & (variance > 0)
    if known.sum() < FEWEST:
        return none
    weight = 1 / variance[known]
    steps = steps[:, known] - np.average(steps[:, known], axis=1, weights=weight)[:, None]
    power = steps**2 @ weight
    back = int(power.argmin())
    off = (3 * steps[back] + steps[1 - back]) ** 2 @ weight
    clear = power[back] > max(settings.exchanged_clear, 8 * known.sum())
    exchanged = clear and off < settings.exchanged_whole**2 * power[1 - back]
    return np.arange(back, len(x_px) - 1, 2) if exchanged else none


def _returns(x_px: Floats, err_px: Floats, settings: TrackingSettings) -> Floats:
    """Return the steps before and after over those by which the sheets return, (2, quadruple of frames), 0
    where they do not, or by no more than noise."""
    count = len(x_px) - 3
    step = np.diff(x_px, axis=0)
    err = np.maximum.reduce([err_px[k : k + count] for k in range(4)])
    known = np.isfinite(step[:-2] + step[1:-1] + step[2:]) & (err > 0)
    weight = np.where(known, 1 / np.where(known, err, 1.0) ** 2, 0.0)
    total = np.maximum(weight.sum(axis=1), 1e-12)

    def relative(part: Floats) -> Floats:
        part = np.where(known, part, 0.0)
        shared = (weight * part).sum(axis=1) / total
        return np.asarray(part - shared[:, None])

    before, back, after = (relative(step[k : k + count]) for k in range(3))
    power, sheets = (weight * back**2).sum(axis=1), known.sum(axis=1)
    against = -np.stack([(weight * part * back).sum(axis=1) for part in (before, after)])
    ratio = against / np.maximum(power, 1e-12)
    clear = (sheets >= FEWEST) & (power > np.maximum(settings.exchanged_clear, 8 * sheets))
    return np.where(clear & (ratio.min(axis=0) > settings.exchanged_returns), ratio, 0.0)


def mixed_frames(profile: Floats32, frozen: Bools, settings: TrackingSettings = DEFAULT) -> float:
    """Return the share of frames that are mixed from two, as a change of the frame rate may do; 0 if none.

    profile: I(x,t), (frame, x).  frozen: frames that repeat the one before, (frame,).

    The mean of two frames has half of their noise, and shares noise with the frame before: it differs from
    it by a quarter of the usual square, and its own sixth differences along x are smaller as well. Frames
    that hardly moved also differ less, but have the noise of the frames beside them. A film has mixed frames
    if the noise of those that differ less than `mixed_change` of the usual is, in the mean, smaller by
    `mixed_noise` and by `mixed_sigmas` standard errors.
    """
    rows = np.arange(len(profile))
    if len(rows) > SUCCESSIVE * STRETCHES:
        start = SUCCESSIVE * spread_indices(len(rows) // SUCCESSIVE, STRETCHES)
        rows = (start[:, None] + np.arange(SUCCESSIVE)).ravel()
    some = some_rows(profile, rows)
    some = some[np.isfinite(some[:, some.shape[1] // 2]) & ~frozen[rows]]
    if len(some) <= AROUND or some.shape[1] <= NOISE_ORDER:
        return 0.0
    power, change = np.empty(len(some)), np.empty(len(some) - 1)

    def measure(part: slice) -> None:
        before = max(0, part.start - 1)
        noise = np.diff(some[before : part.stop], NOISE_ORDER, axis=1)
        power[before : part.stop] = np.square(noise).mean(axis=1, dtype=np.float64)
        change[before : part.stop - 1] = np.square(np.diff(noise, axis=0)).mean(axis=1, dtype=np.float64)

    in_two_threads(measure, row_parts(len(some), SUCCESSIVE))
    usual = running_median(change, AROUND, ends="symmetric")
    suspect = 1 + np.flatnonzero(change[:-1] < settings.mixed_change * usual[:-1])
    if len(suspect) < FEWEST:
        return 0.0
    beside = (power[suspect - 1] + power[suspect + 1]) / 2
    less = 2 * (beside - power[suspect]) / np.maximum(usual[suspect - 1], 1e-12)
    least = settings.mixed_sigmas * less.std(ddof=1) / np.sqrt(len(less))
    mixed = less.mean() > max(settings.mixed_noise, least)
    return len(suspect) / len(some) if mixed else 0.0
