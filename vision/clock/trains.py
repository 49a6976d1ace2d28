"""Two trains of slips, and the log-likelihood that one clock maps the camera's onto the machine's.

Every slip the camera saw within the time both trains cover is either a slip of the force, with a Gaussian
error, or false; every slip of the force there is seen or missed.  An alignment earns for each pair and pays
for every slip left over on either side.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vision.clock.sizes import Sizes, size_evidence

Doubles = NDArray[np.float64]
Ints = NDArray[np.int64]

# A pair earns at most this, however sharp both times are.  Without a cap one slip more at the end of an even
# train would decide between shifts by a whole event, and which slip is the first or last one seen is chance.
_MOST_PER_PAIR = 3.2
_SEEN = 0.75  # share of the slips that either side is taken to see
PAIRED, ALONE = float(2 * np.log(_SEEN)), float(np.log(1 - _SEEN))
DRIFT_PPM = 1500.0  # standard deviation of the prior on the drift
# Stated errors of single slips may be too small; they are widened, alignment by alignment, where that pays.
_SCALES = (1.0, 1.4, 2.0)


@dataclass(frozen=True)
class Trains:
    """Slip times in order on both clocks, s, and the standard error of each camera slip's place (the force
    slip's included); how large each was, where known; the standard error of a force slip's place."""

    video_s: Doubles
    error_s: Doubles
    force_s: Doubles
    video_size: Sizes | None = None
    force_size: Sizes | None = None
    force_error_s: float = 0.001

    @property
    def period_s(self) -> float:
        """Mean time between slips, the shorter of the two trains'."""
        return float(min(np.ptp(t) / (len(t) - 1) for t in (self.video_s, self.force_s)))

    @property
    def typical_error_s(self) -> float:
        """Median error of a slip."""
        return float(np.median(self.error_s))

    def earned(self) -> Doubles:
        """What a pair without residual earns over a slip at any time, (video slips,)."""
        # The 1 is what an unrelated slip would cost for being there at all (rate times time, per slip).
        even = 1 + np.log(self.period_s / (self.error_s * np.sqrt(2 * np.pi)))
        return np.asarray(np.clip(even, 0.0, _MOST_PER_PAIR) + PAIRED)


@dataclass(frozen=True)
class Clocks:
    """K clocks: t_force = middle_s + (1 + drift) (t_video - centre_s), each array (K,)."""

    middle_s: Doubles
    drift: Doubles
    centre_s: Doubles

    def map(self, video_s: Doubles) -> Doubles:
        """(K, times)."""
        return np.asarray(
            self.middle_s[:, None] + (1 + self.drift[:, None]) * (video_s - self.centre_s[:, None])
        )

    def take(self, rows: Ints) -> Clocks:
        """Some of them."""
        return Clocks(self.middle_s[rows], self.drift[rows], self.centre_s[rows])

    @property
    def offset_s(self) -> Doubles:
        """Force clock at video time 0."""
        return self.middle_s - (1 + self.drift) * self.centre_s


@dataclass(frozen=True)
class Fit:
    """How well K clocks fit.

    likelihood (K,), of the best of the scales.  sizes (K,), the sizes' part of it.  scale (K,).  residual_s
    (K, video slips), mapped less force, NaN where not paired.  partner (K, video slips), index of the force
    slip, -1 where not paired.  video, force (K,): slips of either train in the time both cover.
    """

    likelihood: Doubles
    sizes: Doubles
    scale: Doubles
    residual_s: Doubles
    partner: Ints
    video: Ints
    force: Ints

    @property
    def matched(self) -> Ints:
        """Pairs, (K,)."""
        return np.asarray((self.partner >= 0).sum(axis=1))


def nearest(force_s: Doubles, mapped_s: Doubles) -> Ints:
    """Index of the force slip nearest to each time, any shape."""
    right = np.clip(np.searchsorted(force_s, mapped_s), 1, len(force_s) - 1)
    closer = mapped_s - force_s[right - 1] < force_s[right] - mapped_s
    return np.asarray(np.where(closer, right - 1, right))


def evaluate(trains: Trains, clocks: Clocks) -> Fit:
    """Log-likelihood of each clock, relative to no slip in common, prior of the drift included.

    Pairs are mutual nearest neighbours that earn more than two slips left over cost.
    """
    mapped = clocks.map(trains.video_s)
    partner = nearest(trains.force_s, mapped)
    residual = mapped - trains.force_s[partner]
    mutual = _is_mutual(partner, np.abs(residual), len(trains.force_s))
    video, force = _within(trains, mapped)
    z2 = (residual / trains.error_s) ** 2
    prior = -0.5 * (1e6 * clocks.drift / DRIFT_PPM) ** 2
    gains = [trains.earned() - np.log(s) - 0.5 * z2 / s**2 - 2 * ALONE for s in _SCALES]
    gain = np.stack([np.where(mutual, np.maximum(g, 0.0), 0.0) for g in gains])
    best = np.argmax(gain.sum(axis=2), axis=0)
    gain = np.take_along_axis(gain, best[None, :, None], axis=0)[0]
    paired = gain > 0
    partner = np.where(paired, partner, -1)
    sizes = np.zeros(len(partner))
    if trains.video_size and trains.force_size:
        sizes = size_evidence(trains.video_size, trains.force_size, partner)
    return Fit(
        likelihood=gain.sum(axis=1) + ALONE * (video + force) + prior + sizes,
        sizes=sizes,
        scale=np.asarray(_SCALES)[best],
        residual_s=np.where(paired, residual, np.nan),
        partner=partner,
        video=video,
        force=force,
    )


def _is_mutual(partner: Ints, away_s: Doubles, force: int) -> NDArray[np.bool_]:
    """Whether no other camera slip lies nearer to the same force slip."""
    key = partner + force * np.arange(len(partner))[:, None]
    least = np.full(key.shape[0] * force, np.inf)
    np.minimum.at(least, key.ravel(), away_s.ravel())
    return np.asarray(away_s <= least[key])


def _within(trains: Trains, mapped_s: Doubles) -> tuple[Ints, Ints]:
    """(video, force) slips in the time from the later first slip to the earlier last one, (K,) each.

    Not of the recordings but of the slips: a train's end is no evidence, its first or last slips may be too
    small to be seen.
    """
    slack = 3 * trains.typical_error_s
    start = np.maximum(mapped_s[:, 0], trains.force_s[0]) - slack
    stop = np.minimum(mapped_s[:, -1], trains.force_s[-1]) + slack
    video = ((mapped_s >= start[:, None]) & (mapped_s <= stop[:, None])).sum(axis=1)
    force = np.searchsorted(trains.force_s, stop, "right") - np.searchsorted(trains.force_s, start)
    return np.asarray(video), np.maximum(force, 0)
