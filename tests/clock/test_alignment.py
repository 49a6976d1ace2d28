"""The likelihood of one clock: pairs of slips, and their sizes as evidence."""

import numpy as np
import pytest

from tests.scenes.slip_trains import slip_sizes
from vision.clock.alignment import CandidateClocks, SlipSizes, SlipTrains, fit_clocks, size_evidence

COUNT = 40


def test_a_slip_pairs_with_one_slip_only():
    """A failure means that one force slip explains several camera slips, so that false ones cost nothing."""
    trains = SlipTrains(np.array([1.0, 1.01, 2.0, 3.0]), np.full(4, 0.02), np.array([1.0, 2.0, 3.0, 4.0]))
    fit = fit_clocks(trains, CandidateClocks(np.zeros(1), np.zeros(1), np.zeros(1)))
    np.testing.assert_array_equal(fit.partner[0], [0, -1, 1, 2])
    assert (fit.matched[0], fit.video[0], fit.force[0]) == (3, 4, 3)


def evidence(video, force, shift=0):
    """Of every slip paired with the one `shift` later."""
    partner = np.arange(len(video.score)) + shift
    partner[partner >= len(force.score)] = -1
    return float(size_evidence(video, force, partner[None])[0])


def test_sizes_that_go_together_are_told_from_those_one_slip_apart():
    """A failure means that the sizes cannot tell a shift by one slip."""
    rng = np.random.default_rng(0)
    size = slip_sizes(rng, COUNT)
    video, force = (SlipSizes.of(scale * size * (1 + 0.02 * rng.standard_normal(COUNT))) for scale in (3, 60))
    assert evidence(video, force) > 8
    assert evidence(video, force, shift=1) < 0


def test_no_pair_and_no_set_of_pairs_decides_alone():
    """A failure means that a few steps of the right size by chance, or of a bad frame, set the clocks."""
    rng = np.random.default_rng(1)
    size = slip_sizes(rng, COUNT)
    same = SlipSizes.of(size)
    assert evidence(same, same) <= COUNT
    spoilt = size.copy()
    spoilt[3] *= 20
    assert evidence(same, same) - evidence(same, SlipSizes.of(spoilt)) < 4
    opposite = SlipSizes(-same.score, same.reliability)
    assert evidence(same, opposite) == pytest.approx(np.log(0.1), abs=0.5)


def test_a_common_trend_is_no_evidence():
    """A failure means that any alignment looks right because both sizes fall through the test."""
    rng = np.random.default_rng(2)
    trend = np.exp(-0.01 * np.arange(100))
    both = [trend * (1 + 0.03 * rng.standard_normal(100)) for _ in range(2)]
    assert evidence(*(SlipSizes.of(size) for size in both)) < 1
    raw = [np.log(size) - np.log(size).mean() for size in both]
    assert evidence(*(SlipSizes(np.clip(v / v.std(), -2, 2)) for v in raw)) > 20  # with the trend left in


def test_a_camera_that_sees_no_difference_says_nothing():
    """A failure means that noise counts as slips of the wrong size."""
    rng = np.random.default_rng(3)
    force = SlipSizes.of(slip_sizes(rng, COUNT))
    assert evidence(SlipSizes.of(np.full(COUNT, 3.0), 0.1), force) == 0
    assert evidence(SlipSizes.of(3 + 0.1 * rng.standard_normal(COUNT), 0.15), force) == 0
    assert evidence(SlipSizes.of(np.full(COUNT, np.nan)), force) == 0
