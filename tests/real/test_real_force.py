"""`track force` on recordings of paper sliding on paper; skipped where they are absent."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from vision.data import StickMetadata
from vision.force import find_stick_slip
from vision.force.recording import read_force

DATA = Path(__file__).parents[2] / "../shared/data"
pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason="the recordings are not here")


@cache
def found(name):
    """The recording and its events, as recorded."""
    force = read_force(DATA / f"paper_on_paper_{name}.mat")
    return force, find_stick_slip(force)


NAMES = ("k168Nm_v42", "k168Nm_v1100", "k1002Nm_v4300")


@pytest.mark.parametrize("name", NAMES)
def test_every_force_lies_within_what_was_recorded(name):
    """A failure means a peak, a valley or a drop that no sample shows; nothing is deconvolved unasked."""
    force, events = found(name)
    low, high = float(force.load_N.min()), float(force.load_N.max())
    assert force["load_N"].attrs["units"] == "1"  # force over weight
    for part in ("F_p_N", "F_v_N"):
        assert low <= events[part].min() and events[part].max() <= high
    assert (events["dF_N"] > 0).all() and events["dF_N"].max() <= high - low
    assert StickMetadata.of(events).lowpass_s == 0


def test_the_slow_pull_is_a_clean_sawtooth():
    """375 s at 2 kHz with impulsive noise: stick-slip at a steady pace, no event of which is doubtful."""
    force, events = found("k168Nm_v42")
    facts = StickMetadata.of(events)
    assert float(force.time_s[-1] - force.time_s[0]) == pytest.approx(375.6, abs=0.1)
    assert facts.regime == "stick-slip" and facts.fall_over_rise < 0.1
    assert 240 <= len(events) <= 260
    assert (events["flag"] == "ok").mean() > 0.95
    assert facts.spikes > 0  # impulses are counted, and no events
    steps = np.diff(events["t_p_s"].to_numpy())
    assert steps.min() > 0.3 * np.median(steps)  # an impulse taken for a slip would cut a stick in two


def test_the_fast_pull_has_rounded_events_and_says_so():
    """Irregular and rounded: stick-slip still, with every slip slow against its stick."""
    _, events = found("k168Nm_v1100")
    facts = StickMetadata.of(events)
    assert facts.regime == "stick-slip" and facts.fall_over_rise > 0.2
    assert events["flag"].str.contains("slow").mean() > 0.9


def test_the_stiff_spring_oscillates():
    """Almost sinusoidal, 0.19 of the weight from peak to valley: no stick-slip, and no drop above that."""
    force, events = found("k1002Nm_v4300")
    facts = StickMetadata.of(events)
    assert facts.regime == "oscillation"
    assert "an oscillation, no stick-slip" in " ".join(facts.warnings)
    low, high = np.quantile(force.load_N.values, (0.01, 0.99))
    assert high - low == pytest.approx(0.19, abs=0.005)
    assert events["dF_N"].median() < high - low
    assert not (events["flag"] == "ok").any()
