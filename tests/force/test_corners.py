"""Begin and end of slips whose corners are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.scenes.sawtooth import signal_of
from vision.force.corners import find_corners
from vision.force.settings import ForceSettings
from vision.force.slips import find_slips


def half_cosines(length: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a load with 40 slips of so many samples, and where they begin."""
    rng = np.random.default_rng(0)
    period = 200 + rng.uniform(0, 1, 40)
    begin = np.cumsum(period)
    index = np.arange(int(begin[-1] + 100.0))
    k = np.searchsorted(begin, index, side="right")
    since = index - np.r_[0.0, begin][k]
    fall = np.where(k > 0, 50 * (1 + np.cos(np.pi * np.clip(since / length, 0, 1))) / 2, 0.0)
    load = 100 + fall + 0.25 * np.maximum(since - np.where(k > 0, length, 0.0), 0.0)
    return load + 0.05 * rng.standard_normal(load.size), begin


@pytest.mark.parametrize("length", [4.0, 12.0])
def test_corners_of_half_cosine_slips(length: float) -> None:
    """A failure means Λ_st is off by what a slip's own length makes."""
    load, begin = half_cosines(length)
    slips = find_slips(load, 0.05)
    assert slips.edge.size == 40
    corners = find_corners(signal_of(load, 0.05), slips)
    assert np.median(np.abs(corners.peak - begin)) < 0.15 * length
    assert np.median(np.abs(corners.valley - begin - length)) < 0.15 * length
    assert np.mean(np.abs(corners.peak - begin) < 3 * corners.error) > 0.95
    assert np.isnan(corners.knee).all()


def test_two_slips_in_neighbouring_samples_leave_the_others_as_they_are() -> None:
    """A failure means that one stick too short for a line costs all later slips their corners."""
    load, _ = half_cosines(12.0)
    slips = find_slips(load, 0.05)
    double = replace(
        slips, edge=np.insert(slips.edge, 8, slips.edge[8] - 1), drop=np.insert(slips.drop, 8, 1.0)
    )
    alone, beside = (find_corners(signal_of(load, 0.05), each) for each in (slips, double))
    np.testing.assert_allclose(beside.middle[11:], alone.middle[10:], atol=1e-6)


def test_the_assumed_shape_of_a_slip_is_part_of_the_error_of_its_corners() -> None:
    """A failure means that corners of slips of ten samples are stated too accurately, and Λ_st with them."""
    load, begin = half_cosines(10.0)
    slips = find_slips(load, 0.05)

    def covered(settings: ForceSettings) -> float:
        corners = find_corners(signal_of(load, 0.05), slips, settings=settings)
        off = np.r_[corners.peak - begin, corners.valley - begin - 10.0]
        return float(np.mean(np.abs(off) < np.tile(corners.error, 2)))

    assert covered(ForceSettings()) > 0.62
    assert covered(ForceSettings(shape_error=0.0)) < 0.55
