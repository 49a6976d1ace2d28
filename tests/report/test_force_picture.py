"""force.png and its panel of single sticks."""

import numpy as np
from matplotlib.figure import Figure
from vision.report.force_picture import ZOOMED_EVENTS, draw_some_sticks, write_force_picture


def test_lines_run_from_valley_to_peak_along_the_force(pulled):
    """A failure means that the picture by which events are judged shows others than the table."""
    ax = draw_some_sticks(Figure().subplots(), pulled.force, pulled.sticks)
    load, *lines = ax.lines
    sticks = lines[:ZOOMED_EVENTS]
    for line in sticks:
        between = np.interp(line.get_xdata().mean(), load.get_xdata(), load.get_ydata())
        assert abs(between / line.get_ydata().mean() - 1) < 0.03
    rising = [line.get_ydata()[1] - line.get_ydata()[0] for line in sticks]
    first = len(pulled.sticks) // 2 - ZOOMED_EVENTS // 2
    drops = pulled.sticks["dF_N"].iloc[first : first + ZOOMED_EVENTS]
    np.testing.assert_allclose(rising, drops, rtol=0.03)


def test_a_recording_without_separation_has_its_picture(pulled, tmp_path):
    """A failure means no picture, or axes of nothing without a word, where no speed was given."""
    blind = pulled.sticks.assign(d_v_mm=np.nan, d_p_mm=np.nan, K_N_per_mm=np.nan)
    force = pulled.force.assign(d_mm=pulled.force["d_mm"] * np.nan)
    write_force_picture(tmp_path / "force.png", force, blind)
    assert (tmp_path / "force.png").stat().st_size > 10_000
