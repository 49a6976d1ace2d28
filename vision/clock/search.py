"""All alignments worth a look: votes for offsets, then affine refits of the best."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vision.clock.trains import ALONE, DRIFT_PPM, Clocks, Doubles, Fit, Ints, Trains, evaluate, nearest

_MOST_DRIFT = 4000e-6
_CANDIDATES = 100
_LEAST_COMMON = 3
_BIN = 1.5  # errors of a slip; a vote counts for its bin and both neighbours
_COARSE = 1 / 60  # of a period: finer bins only cost time, the refits narrow down
_WIDE, _ROUNDS, _FINAL = 1.4, 4, 2  # bins the errors are widened to, rounds to narrow them down, and after
_DOUBTFUL = 2.5  # errors at which a pair is as likely false as true


def find_alignments(trains: Trains) -> tuple[Clocks, Fit]:
    """Different alignments, best first; at least one.

    Two clocks are the same alignment where they agree within three errors of a slip at both ends of the
    camera's train.
    """
    clocks = refit(trains, vote(trains))
    fit = evaluate(trains, clocks)
    order = np.argsort(-fit.likelihood, kind="stable")
    ends = clocks.map(trains.video_s[[0, -1]])[order]
    apart = np.abs(ends[:, None] - ends[None]).max(axis=2) > 3 * trains.typical_error_s
    first = np.array([apart[i, :i].all() for i in range(len(order))])
    rows = order[first]
    return clocks.take(rows), _rows(fit, rows)


def _rows(fit: Fit, rows: Ints) -> Fit:
    return Fit(
        fit.likelihood[rows],
        fit.sizes[rows],
        fit.scale[rows],
        fit.residual_s[rows],
        fit.partner[rows],
        fit.video[rows],
        fit.force[rows],
    )


def vote(trains: Trains) -> Clocks:
    """The most promising offsets, scale by scale of the clock: pairs that agree against slips in the overlap.

    The score is the likelihood with every pair in three bins counted as one without residual.
    """
    centre = 0.5 * (trains.video_s[0] + trains.video_s[-1])
    span = min(np.ptp(trains.video_s), np.ptp(trains.force_s))
    width = _bin_s(trains)
    count = int(np.ceil(_MOST_DRIFT * span / width)) * 2 + 1
    drifts = np.linspace(-_MOST_DRIFT, _MOST_DRIFT, count)
    low = trains.force_s[0] - centre - (1 + _MOST_DRIFT) * np.ptp(trains.video_s)
    high = trains.force_s[-1] - centre + (1 + _MOST_DRIFT) * np.ptp(trains.video_s)
    bins = int(np.ceil((high - low) / width)) + 1
    score, best = np.full(bins, -np.inf), np.zeros(bins)
    for drift in drifts:
        here = _score(trains, (1 + drift) * (trains.video_s - centre), low + centre, width, bins)
        score, best = np.maximum(score, here), np.where(here > score, drift, best)
    chosen = _summits(score)
    middle = low + centre + width * (chosen + 0.5)
    return Clocks(middle, best[chosen], np.full(len(chosen), centre))


def _bin_s(trains: Trains) -> float:
    return max(_BIN * trains.typical_error_s, _COARSE * trains.period_s)


def _score(trains: Trains, scaled: Doubles, low: float, width: float, bins: int) -> Doubles:
    """Approximate likelihood for every offset bin at one scale."""
    first, last = trains.force_s[[0, -1]]
    offset = (trains.force_s[None, :] - scaled[:, None]).ravel()
    votes = np.bincount(((offset - low) / width).astype(np.int64), minlength=bins)[:bins]
    votes = np.convolve(votes, np.ones(3, np.int64), "same")

    def passed(offset_s: Doubles) -> Ints:
        """How many of these offsets lie below each bin's middle."""
        index = np.clip(np.ceil((offset_s - low) / width - 0.5), 0, bins).astype(np.int64)
        return np.asarray(np.cumsum(np.bincount(index, minlength=bins + 1))[:bins])

    # A slip enters the common time at one offset and leaves it at another.
    force = passed(trains.force_s - scaled[-1] - width) - passed(trains.force_s - scaled[0] + width)
    video = passed(first - scaled - width) - passed(last - scaled + width)
    fewest = np.minimum(force, video)
    gain = float(np.median(trains.earned())) - 2 * ALONE
    score = gain * np.minimum(votes, fewest) + ALONE * (force + video)
    return np.where(fewest >= _LEAST_COMMON, score, -np.inf)


def _summits(score: Doubles) -> NDArray[np.int64]:
    """The highest bins that no neighbour within two exceeds."""
    from scipy.ndimage import maximum_filter1d

    top = np.flatnonzero((score == maximum_filter1d(score, 5)) & np.isfinite(score))
    if not len(top):
        return np.array([int(np.argmax(score))])
    return top[np.argsort(-score[top], kind="stable")[:_CANDIDATES]]


def refit(trains: Trains, clocks: Clocks) -> Clocks:
    """Weighted affine least squares, each slip with its nearest partner, weights falling with the residual.

    The errors start wide and narrow down.  The drift is held by its prior, so that few slips do not bend it.
    """
    v, weight0 = trains.video_s, trains.error_s**-2.0
    wide = _WIDE * _bin_s(trains) / trains.typical_error_s
    for widening in np.r_[np.geomspace(wide, 1.0, _ROUNDS), np.ones(_FINAL)]:
        mapped = clocks.map(v)
        target = trains.force_s[nearest(trains.force_s, mapped)]
        z2 = ((mapped - target) / (widening * trains.error_s)) ** 2
        # Chance of being a true pair: flat inside, so that errors as even as a frame's all count.
        weight = weight0 / (1 + np.exp(0.5 * (np.minimum(z2, 60.0) - _DOUBTFUL**2)))
        clocks = _least_squares(v, target, weight, clocks)
    return clocks


def _least_squares(v: Doubles, target: Doubles, weight: Doubles, clocks: Clocks) -> Clocks:
    total = weight.sum(axis=1)
    good = total > 0
    total = np.where(good, total, 1.0)
    centre = np.where(good, (weight * v).sum(axis=1) / total, clocks.centre_s)
    dv = v - centre[:, None]
    excess = target - dv
    middle = (weight * excess).sum(axis=1) / total
    drift = (weight * dv * excess).sum(axis=1) / ((weight * dv**2).sum(axis=1) + (1e-6 * DRIFT_PPM) ** -2)
    return Clocks(np.where(good, middle, clocks.middle_s), np.where(good, drift, clocks.drift), centre)
