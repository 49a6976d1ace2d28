"""What trains that do not belong together reach: the camera's own with its intervals in another order."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vision.clock.search import find_alignments
from vision.clock.sizes import Sizes, off_trend
from vision.clock.trains import Doubles, Ints, Trains

_SHUFFLES, _AT_LEAST = 16, 4
_FAR_BELOW = 0.5  # of the likelihood: shuffled trains that reach less leave no question


def beats_chance(trains: Trains, likelihood: float, lead: float) -> bool:
    """Whether no shuffled camera train has an alignment within `lead` of this log-likelihood.

    Intervals change places with the sizes of the slips that end them, the trend stays.  So the shuffled
    trains are as even, as damaged and as long as the real one, tried at as many offsets and rates, and their
    sizes go with their intervals as they do in the real one.  Sixteen, or four where they are far below;
    drawn alike each time.
    """
    rng = np.random.default_rng(0)
    length = np.log(np.diff(trains.video_s))
    uneven = off_trend(length)
    highest = -np.inf
    for count in range(_SHUFFLES):
        order = rng.permutation(len(length))
        shuffled = _reordered(trains, length - uneven + uneven[order], order)
        reached = float(find_alignments(shuffled)[1].likelihood[0])
        if reached > likelihood - lead:
            return False
        highest = max(highest, reached)
        if count + 1 >= _AT_LEAST and highest < _FAR_BELOW * likelihood:
            break
    return True


def _reordered(trains: Trains, log_length: Doubles, order: Ints) -> Trains:
    size = trains.video_size
    return replace(
        trains,
        video_s=np.cumsum(np.r_[trains.video_s[0], np.exp(log_length)]),
        video_size=size and Sizes(np.r_[size.score[:1], size.score[1:][order]], size.sure),
    )
