"""Drops of a sawtooth among noise and knees."""

from __future__ import annotations

import numpy as np
import pytest

from tests.scenes.sawtooth import plain
from vision.force import find_stick_slip
from vision.force.slips import find_slips


@pytest.mark.parametrize("snr", [6.0, 40.0])
def test_every_slip_is_at_its_sample(snr: float) -> None:
    """A failure means slips are missed, doubled, or away from the sample after their drop."""
    test = plain(sticks=100, samples=40, snr=snr, seed=1)
    slips = find_slips(test.force["load_N"].to_numpy(), 1.0)
    true = np.r_[test.truth["t_v_s"], test.truth["t_p_s"].iloc[-1]] / 0.01
    away = np.abs(slips.edge[:, None] - true).min(axis=1)
    assert slips.edge.size == pytest.approx(true.size, abs=1)
    assert np.mean(away <= 2) > 0.97
    assert np.median(slips.drop) == pytest.approx(snr, rel=0.1)
    assert slips.period == pytest.approx(40, rel=0.05)


def test_a_gap_between_small_and_large_drops_moves_the_threshold() -> None:
    """A failure means clusters of small false drops stay among the true ones."""
    small = np.where(np.arange(60) % 3 == 1, 8.0, 100.0)
    load = np.concatenate([np.linspace(0, drop, 50, endpoint=False) + 500 for drop in small])
    load += np.random.default_rng(2).standard_normal(load.size)
    slips = find_slips(load, 1.0)
    assert slips.threshold_how == "gap"
    assert 8 < slips.threshold < 100
    assert slips.drop.min() > 50


def test_knees_are_not_slips() -> None:
    """A failure means the change of slope within the sticks of fast pulls counts as an event of its own."""
    test = plain(sticks=40, samples=200, snr=2000, jitter=0.1, scatter=0.05, seed=3)
    time = test.force["time_s"].to_numpy()
    stick = np.searchsorted(test.truth["t_v_s"], time, side="right") - 1
    start, end = (test.truth[name].to_numpy()[stick] for name in ("t_v_s", "t_p_s"))
    phase = np.clip(np.where(stick >= 0, (time - start) / (end - start), 0.0), 0.0, 1.0)
    bump = 500 * np.minimum(phase / 0.3, (1 - phase) / 0.7)
    bent = test.force.assign(load_N=("time_s", test.force["load_N"].to_numpy() + bump))
    assert len(find_stick_slip(bent)) == len(find_stick_slip(test.force))
