"""Slips as the load cell sees them, against known times."""

import numpy as np
import pytest

from tests.scenes.slip_trains import sawtooth, slip_times, sticks_of
from vision.clock import force_slips

STOP_S = 60.0


@pytest.fixture(scope="module")
def slips_s():
    times = 1.0 + slip_times(np.random.default_rng(0), 150, period_s=0.61)
    return times[times < STOP_S - 1]


@pytest.mark.parametrize(("rate_hz", "lowpass_s"), [(200, 0.003), (1000, 0.003), (100, 0.01), (200, 0.0003)])
def test_force_slips_are_free_of_the_chain_s_delay(rate_hz, lowpass_s, slips_s):
    """A failure means that the load cell's low-pass shifts all clocks by its time constant."""
    force = sawtooth(np.random.default_rng(8), slips_s, stop_s=STOP_S, rate_hz=rate_hz, lowpass_s=lowpass_s)
    found = force_slips(force, sticks_of(slips_s))
    assert len(found) == len(slips_s)
    bias = np.mean(found["time_s"].to_numpy() - slips_s)
    assert abs(bias) < 1e-3 + 0.2 * lowpass_s
    assert abs(bias) < 3 * found.attrs["lag_s"]


def test_slips_where_the_load_holds_still(slips_s):
    """A failure means a division by no drop, where the events are those of another recording."""
    force = sawtooth(np.random.default_rng(8), slips_s, stop_s=STOP_S)
    found = force_slips(force.assign(load_N=0 * force["load_N"] + 5), sticks_of(slips_s))
    np.testing.assert_allclose(found["time_s"], slips_s, atol=0.05)


def test_without_the_correction_they_are_late(slips_s):
    """A failure means that the test above would pass without the correction."""
    force = sawtooth(np.random.default_rng(9), slips_s, stop_s=STOP_S, lowpass_s=0.01)
    found = force_slips(force, sticks_of(slips_s))
    assert np.mean(found["time_s"].to_numpy() + found.attrs["delay_s"] - slips_s) > 7e-3


def test_no_sticks_no_slips(slips_s):
    """A failure means a traceback where a recording has no events."""
    force = sawtooth(np.random.default_rng(10), slips_s, stop_s=STOP_S)
    assert len(force_slips(force, sticks_of(slips_s).iloc[:0])) == 0
