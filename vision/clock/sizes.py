"""Whether the slips that the camera saw as large are those in which the force fell far.

Both fall slowly through a test, which tells nothing: only how a slip differs from its neighbours counts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vision.force.noise import MAD_TO_SIGMA

Doubles = NDArray[np.float64]
Ints = NDArray[np.int64]

_FAR = 2.0  # standard deviations: sizes further off, of two slips seen as one or of dust, count as this far
_AROUND = 15  # slips whose median is the trend
_ENOUGH = 30  # slips from which on the trend need not be straight
_LEAST = 5  # sizes known, below which there is no scatter to compare with
_RELATED = (0.3, 0.5, 0.7, 0.9)  # correlations, equally likely
_UNRELATED = 0.1  # chance that sizes tell nothing although both vary: paper need not move as the force falls
_FALSE = 0.2  # share of pairs whose sizes are another slip's
_MOST_PER_PAIR = 1.0


@dataclass(frozen=True)
class Sizes:
    """Sizes of the slips of a train as standard scores about their trend, NaN where not known.

    sure: correlation of the scores with those without the error of measurement, 0 to 1.
    """

    score: Doubles
    sure: float = 1.0


def scored(size: Doubles, error: Doubles | float = 0.0) -> Sizes:
    """Sizes, any unit, positive, in the order of the slips; error: standard error, the same unit."""
    known = np.isfinite(size) & (size > 0)
    score = np.full(len(size), np.nan)
    if known.sum() < _LEAST:
        return Sizes(score, 0.0)
    off = off_trend(np.log(size[known]))
    scatter = MAD_TO_SIGMA * float(np.median(np.abs(off)))
    noise = float(np.median(np.broadcast_to(error, size.shape)[known] / size[known]))
    if not scatter > max(noise, 1e-9):
        return Sizes(score, 0.0)
    score[known] = np.clip(off / scatter, -_FAR, _FAR)
    return Sizes(score, float(np.sqrt(1 - (noise / scatter) ** 2)))


def off_trend(values: Doubles) -> Doubles:
    """Values less a straight line (Theil and Sen's) and, where they are many, a running median."""
    from scipy.ndimage import median_filter
    from scipy.stats import theilslopes

    slope, level = theilslopes(values)[:2]
    away = values - level - slope * np.arange(len(values))
    return np.asarray(away - median_filter(away, _AROUND, mode="nearest") if len(away) >= _ENOUGH else away)


def size_evidence(video: Sizes, force: Sizes, partner: Ints) -> Doubles:
    """Log of how much likelier the sizes of the paired slips are if they go together, (K,).

    partner: (K, video slips), index of the force slip, -1 where not paired.  Weighed over all correlations
    that may be, none at all among them.  One pair adds no more than 1 and takes no more than 1.6, all pairs
    together take no more than 2.3; 0 where either side's sizes do not vary beyond their errors.
    """
    sure = video.sure * force.sure
    v = np.broadcast_to(video.score, partner.shape)
    f = force.score[np.maximum(partner, 0)]
    both = (partner >= 0) & np.isfinite(v) & np.isfinite(f)
    v, f = np.where(both, v, 0.0), np.where(both, f, 0.0)
    evidence = [np.full(len(partner), np.log(_UNRELATED))]
    for related in np.multiply(_RELATED, sure):
        free = 1 - related**2
        ratio = np.exp(0.5 * (f**2 - (f - related * v) ** 2 / free)) / np.sqrt(free)
        each = np.minimum(np.log(_FALSE + (1 - _FALSE) * ratio), _MOST_PER_PAIR)
        total = np.where(both, each, 0.0).sum(axis=1)
        evidence.append(total + np.log((1 - _UNRELATED) / len(_RELATED)))
    return np.asarray(np.logaddexp.reduce(np.stack(evidence)))
