"""Lines and broken lines through stretches of a signal."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from vision.force import lines as module
from vision.force.lines import FittedLoad, fit_broken_lines, fit_lines
from vision.numeric import flat_ranges


def test_ranges_one_after_the_other() -> None:
    """A failure means that samples of one stretch are counted to another."""
    row, index = flat_ranges(np.array([3, 7, 2]), np.array([5, 7, 4]))
    np.testing.assert_array_equal(row, [0, 0, 2, 2])
    np.testing.assert_array_equal(index, [3, 4, 2, 3])


def test_lines_are_those_of_polyfit() -> None:
    """A failure means a wrong slope or error; NaN must be left out and short stretches give NaN."""
    rng = np.random.default_rng(0)
    x, y = np.sort(rng.uniform(0, 10, 60)), rng.normal(0, 1, 60)
    y[5] = np.nan
    lines = fit_lines(x, y, np.array([0, 30, 58]), np.array([30, 58, 60]))
    for k, part in enumerate((np.delete(np.arange(30), 5), np.arange(30, 58))):
        expected, covariance = np.polyfit(x[part], y[part], 1, cov=True)
        assert lines.slope[k] == pytest.approx(expected[0])
        assert lines.slope_error[k] == pytest.approx(np.sqrt(covariance[0, 0]))
        assert lines.at(np.zeros(3))[k] == pytest.approx(expected[1])
    assert np.isnan(lines.slope[2])


def test_stretches_are_fitted_once_and_blocks_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """A failure means lines of other stretches, or stretches that are fitted again, which takes half the time
    of a search for slips."""
    y = np.random.default_rng(0).normal(size=200_000)
    start = np.arange(0, 190_000, 5000)
    alone = [
        fit_lines(np.arange(y.size, dtype=float), y, start[k : k + 1], start[k : k + 1] + 8000)
        for k in range(38)
    ]
    load, fitted = FittedLoad(y), []
    once = module.fit_lines
    monkeypatch.setattr(module, "fit_lines", lambda *given: fitted.append(given[2].size) or once(*given))
    some = np.array([7, 3, 3, 20])
    load.lines(start[some], start[some] + 8000)
    lines = load.lines(start, start + 8000)  # overlapping
    np.testing.assert_array_equal(lines.slope, [line.slope[0] for line in alone])
    np.testing.assert_array_equal(lines.spread, [line.spread[0] for line in alone])
    assert fitted == [3, 35]


def test_lines_behind_a_low_pass_are_the_lines_before_it() -> None:
    """A failure means slopes and ends of sticks are those of the amplifier."""
    tau, fine = 12.0, 50
    index = np.arange(80.0)
    before = 3 + 0.5 * index + 0.4 * np.minimum(index - 25, 0)
    grid = np.arange(-fine * 200, fine * 80) / fine
    driven = np.interp(grid, index, before, left=60.0)
    keep = np.exp(-1 / (fine * tau))
    after = lfilter([1 - keep], [1, -keep], driven, zi=[keep * 60.0])[0][fine * 200 :: fine]
    start, stop = np.array([40]), np.array([80])
    line = fit_lines(index, after, start, stop, lag=tau)
    assert line.slope == pytest.approx(0.5, rel=1e-3)
    assert line.at(np.array([79.0])) == pytest.approx(before[-1], abs=0.02)
    assert fit_lines(index, after, start, stop).slope != pytest.approx(0.5, rel=0.05)
    broken = fit_broken_lines(index, after, np.array([0]), stop, lag=tau)
    assert broken.first == pytest.approx(0.9, rel=0.05)
    assert broken.second == pytest.approx(0.5, rel=0.02)
    assert broken.first_at(np.array([0.0])) == pytest.approx(before[0], abs=0.5)
    assert broken.second_at(np.array([79.0])) == pytest.approx(before[-1], abs=0.1)
