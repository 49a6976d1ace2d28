"""Clocks that jump near the first or last slips of the film: said, and no stick phase there is used."""

from dataclasses import replace

import numpy as np
import pytest

from tests.scenes.slip_trains import sawtooth, slip_times, sticks_of, tracks
from vision.clock import synchronise
from vision.deformation import horizontal_deformation
from vision.errors import InputError

STOP_S = 24.0


def slips_and_film(seed):
    """Thirty slips, the first after 3 s, and their film from before the pull."""
    rng = np.random.default_rng(seed)
    slips = 3.0 + np.r_[0, slip_times(rng, 29, period_s=0.61)]
    return rng, slips, tracks(rng, slips, stop_s=STOP_S)


def of_machine(rng, slips, gap=None):
    """The recording of slips at these times; without the samples in a gap."""
    force = sawtooth(rng, slips, stop_s=slips[-1] + 1)
    if gap is None:
        return force
    time = force["time_s"].to_numpy()
    flag = force["flag"].to_numpy().astype("<U9")
    flag[np.searchsorted(time, gap[1])] = "gap"
    return force.assign(flag=("time_s", flag)).isel(time_s=(time < gap[0]) | (time >= gap[1]))


def jumped(slips, after, by_s):
    """The times of the slips where the clock jumps by `by_s` after that slip."""
    return np.where(np.arange(len(slips)) > after, slips + by_s, slips)


def events_used(film, sticks, clock):
    return horizontal_deformation(film, sticks, clock, pixel_size_um=10.0)["event"].to_numpy()


@pytest.mark.parametrize("by_s", [-0.2, -0.35, 0.17, 0.4])
@pytest.mark.parametrize("after", [0, 28])
def test_a_clock_that_jumps_beside_the_first_or_last_slip_is_said(after, by_s):
    """A failure means that a clock that is wrong for the first or last stick phase is ok without a word, or
    that it costs more than that one."""
    rng, slips, film = slips_and_film(5)
    seen = jumped(slips, after, by_s)
    sticks = sticks_of(seen)
    clock = synchronise(film, of_machine(rng, seen), sticks)
    (line,) = clock.warnings
    if clock.status == "ambiguous":
        assert "a clock that jumps" in line
        return
    assert "a clock jumps" in line
    assert list(np.setdiff1d(sticks["event"], events_used(film, sticks, clock))) == [after]


def test_a_time_column_that_jumps_ahead_after_the_first_slip_is_said():
    """The slip before the jump is recorded before the film, the film's first slip in the gap.  A failure
    means that one slip of the film alone passes in silence although the force recording has a gap there."""
    rng, slips, film = slips_and_film(6)
    seen = jumped(slips, 0, 3.4) - 2.5
    sticks = sticks_of(seen)
    gap = seen[0] + 0.3, seen[0] + 3.7
    whole, broken = (synchronise(film, of_machine(rng, seen, lost), sticks) for lost in (None, gap))
    assert (whole.status, whole.warnings) == ("ok", ())
    assert broken.status == "ok"
    (line,) = broken.warnings
    assert line.startswith("before ") and "1 slip of the film without a match" in line


def test_sound_clocks_and_single_missed_slips_are_not_doubted():
    """A failure means a warning for each film whose first slip one of the recordings does not show."""
    for missing in (0, 1, 29, None):
        rng, slips, film = slips_and_film(7)
        there = np.arange(30) != missing
        clock = synchronise(film, of_machine(rng, slips[there]), sticks_of(slips[there]))
        assert (clock.status, clock.warnings) == ("ok", ())
        assert np.isnan([clock.holds_from_s, clock.holds_to_s]).all()


def test_small_first_slips_of_the_film_are_not_doubted():
    """A failure means that sheets that give way before the force does cost the clock's good name."""
    rng = np.random.default_rng(8)
    slips = 3.0 + np.r_[0, slip_times(rng, 29, period_s=0.61)]
    film = tracks(rng, slips, stop_s=STOP_S, sizes=np.where(np.arange(30) < 3, 0.35, 1.0))
    clock = synchronise(film, of_machine(rng, slips[3:]), sticks_of(slips[3:]))
    assert (clock.status, clock.warnings) == ("ok", ())


def test_a_clock_that_holds_nowhere_near_a_stick_is_refused():
    """A failure means empty tables where no stick phase can be used."""
    rng, slips, film = slips_and_film(9)
    sticks = sticks_of(slips)
    clock = synchronise(film, of_machine(rng, slips), sticks)
    with pytest.raises(InputError, match="stick phases between"):
        horizontal_deformation(film, sticks, replace(clock, holds_from_s=100.0), pixel_size_um=10.0)
