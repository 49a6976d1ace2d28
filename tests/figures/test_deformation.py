"""Figures of the deformation: their numbers against what they are made from."""

import numpy as np
import pytest
from matplotlib.figure import Figure as Page

from vision.figures.positions import deformation_figure, shells_figure, stick_figure


def by_label(figure):
    return {series.label: series for series in figure.panel.series}


def test_one_stick_shows_inward_motion_of_its_size(pulled):
    """A failure means that δx(t) is that of another stick, sheet or sign."""
    figure = stick_figure(pulled.tracks, pulled.motion, pulled.clock)
    series, outer = by_label(figure), int(pulled.tracks["n"].max())
    event = int(figure.title.split("event ")[1].split(",")[0])
    right = pulled.motion.sel(event=event)["sweep_um"][-1]
    moved = {
        side: np.polyfit(s.x, s.y, 1)[0] * np.ptp(s.x)
        for side in ("left", "right")
        if (s := series[f"{side} {outer}"])
    }
    assert moved["left"] > 0 > moved["right"]
    assert -moved["right"] == pytest.approx(float(right), rel=0.2)


def test_the_ratio_figure_shades_its_threshold(pulled):
    """A failure means that stiff and mobile are told apart by another threshold than stated."""
    figure = deformation_figure(pulled.motion, threshold=0.2)
    assert (figure.panel.bands[0].low, figure.panel.bands[0].high) == (0, 0.2)
    assert "0.2" in figure.caption
    first = figure.panel.series[0]
    assert first.x.tolist() == sorted(first.x)
    assert first.y[[0, -1]].min() > 0.3 > 0.1 > first.y[24:26].max()


def test_shell_sizes_are_those_of_the_table(pulled):
    """A failure means that the shell figure and shells.csv disagree."""
    figure = shells_figure(pulled.shells, pulled.fits)
    right = by_label(figure)["right side"]
    table = pulled.shells[pulled.shells["side"] == 1]
    np.testing.assert_allclose(right.y, table["stiff_sheets"].astype(float))
    np.testing.assert_allclose(right.low, table["stiff_low"].astype(float))
    model = by_label(figure)["M_eff (force)"]
    np.testing.assert_allclose(model.y, pulled.fits.effective_sheets(model.x))


def test_both_sides_of_a_shell_are_seen_side_by_side(pulled):
    """A failure means that the left side's points hide behind the right side's, or stand at a wrong d."""
    shells = pulled.shells.assign(stiff_sheets=8)
    figure = shells_figure(shells)
    left, right = (by_label(figure)[f"{side} side"] for side in ("left", "right"))
    assert left.hollow and not right.hollow
    step = np.diff(np.unique(shells["d_v_mm"])).min()
    assert 0 < right.shift == -left.shift < step / 2
    np.testing.assert_array_equal(left.x, right.x)  # the table has d itself
    ax = figure.plot(Page().subplots())
    at = {line.get_label(): line.get_xdata() for line in ax.lines}
    np.testing.assert_allclose(at["right side"] - at["left side"], 2 * right.shift)
