"""Displacements from one origin, and figures of the deformation: numbers against what they are made from."""

import numpy as np
import pytest
from matplotlib.figure import Figure as Page

from tests.figures.conftest import JUMP_PX, by_label
from tests.scenes.creeping import PIXEL_UM, Clock, make, measure, uniform
from tests.scenes.report_data import make_tracks, sawtooth
from vision.figures.positions import (
    deformation_figure,
    origin_frames,
    origin_px,
    outer_inner_figure,
    outer_less_inner_px,
    outward_px,
    shells_figure,
    stick_figure,
    tracks_figure,
)

SHEETS = 12


def scene(frames=600, *, drift_px=0.0):
    """Sheets that open and close, with a camera that drifts by this much over the film."""
    x = sawtooth(frames, SHEETS, jump_px=JUMP_PX, noise_px=0.001)
    return x + np.linspace(0, drift_px, frames)[:, None]


def test_the_frames_of_the_origin_are_named():
    """A failure means curves that do not start at 0 although the title says so, without a reason."""
    x = scene()
    x[:7] = np.nan  # from the first frame in which sheets are seen
    figure = tracks_figure(make_tracks(x))
    wanted = "its median over frames 7 to 26 (t = 0.117 to 0.433 s)"
    assert wanted in figure.panel.title and wanted in figure.caption
    assert "frames 0 to 4 (" in tracks_figure(make_tracks(scene(5))).panel.title


def test_gaps_shift_no_curve():
    """A failure means that a sheet that is lost for a while is drawn beside where it would be."""
    whole = scene(drift_px=10.0)
    gaps = whole.copy()
    gaps[100:400, 7] = np.nan  # half of the film: mean and median of what is left move by px
    by_label = {s.label: s.y for s in tracks_figure(make_tracks(gaps)).panel.series}
    known = np.isfinite(gaps[:, 7])
    expected = whole[:, 7] - np.median(whole[:20, 7])
    np.testing.assert_allclose(by_label["right 2"][known], expected[known], atol=0.01)
    median = gaps[known, 7] - np.nanmedian(gaps[:, 7])
    assert np.abs(median - (whole[known, 7] - np.median(whole[:, 7]))).max() > 1  # the wrong origin


def test_a_sheet_found_late_starts_where_its_neighbours_are():
    """A failure means that a sheet which comes into view later is drawn from zero."""
    x = scene(drift_px=8.0)
    late = x.copy()
    late[:333, 8] = np.nan
    origins = [origin_px(tracks, origin_frames(tracks)) for tracks in map(make_tracks, (late, x))]
    np.testing.assert_allclose(*origins, atol=0.03)


def test_frozen_frames_do_not_move_the_origin_to_the_middle_of_a_film():
    """The camera repeats every tenth frame. A failure means an origin where the sheets are far from rest."""
    x = scene()
    x[:100:10] = np.nan
    assert origin_frames(make_tracks(x)).tolist() == [k for k in range(23) if k % 10]


def test_without_any_position_there_is_no_origin():
    """A failure means an exception where a film shows nothing."""
    nothing = make_tracks(np.full((30, SHEETS), np.nan))
    assert np.isnan(origin_px(nothing, origin_frames(nothing))).all()
    assert np.isnan(outward_px(nothing)).all()


def test_outer_less_inner_is_free_of_the_camera():
    """A failure means that a drift of the camera is taken for deformation, or deformation is lost."""
    still, moving = (outer_less_inner_px(make_tracks(scene(drift_px=drift))) for drift in (0.0, 30.0))
    for side in (-1, 1):
        np.testing.assert_allclose(moving[side], still[side], atol=0.02)
    share = np.arange(1, SHEETS, 2) / (SHEETS - 1)  # of the jump, from the centre outwards
    jump = JUMP_PX * (share[-2:].mean() - share[:2].mean())
    assert still[1][51] - still[1][48] == pytest.approx(jump, rel=0.06)


def test_a_sheet_that_comes_and_goes_does_not_move_the_mean():
    """A failure means steps in outer − inner where a sheet is lost, which look like slips."""
    x = scene()
    x[200:300, -1] = np.nan
    shown = outer_less_inner_px(make_tracks(x))[1]
    moved = scene() - np.median(scene()[:20], axis=0)
    steady = moved[:, -2] - moved[:, 6:8].mean(axis=1)  # without the sheet that comes and goes
    np.testing.assert_allclose(shown, steady, atol=0.01)


def test_few_sheets_have_no_thirds():
    """A failure means a figure of nothing."""
    assert outer_inner_figure(make_tracks(sawtooth(100, 4))) is None


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


def test_displacement_over_one_stick():
    """A failure means that the figure of δx(t) shows another stick, another origin or another scale."""
    made = make(uniform(2.0, 20.0, events=5), noise_px=0.0)
    motion = measure(made).assign_coords(d_v_mm=("event", np.arange(5.0)))
    figure = stick_figure(made.tracks, motion, Clock())
    event = int(figure.title.split("event ")[1].split(",")[0])
    stick = made.sticks.loc[event]
    length = stick["t_p_s"] - stick["t_v_s"]
    for curve, side, sweep_px in zip(
        figure.panel.series, made.tracks["side"].values, made.sweep_px[event], strict=True
    ):
        assert 0 <= curve.x.min() < 1 / 60 and length - 1 / 60 < curve.x.max() <= length
        expected = -side * PIXEL_UM * sweep_px * (curve.x / length - 0.5)
        np.testing.assert_allclose(curve.y[1:-1], expected[1:-1], atol=1e-3)


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


def test_numbers_of_sheets_are_whole(pulled):
    """A failure means that an axis counts sheets as 2.5, 5, 7.5."""
    shells = pulled.shells.assign(stiff_sheets=8, stiff_low=7, stiff_high=8)
    ticks = shells_figure(shells).of_width(86.0).plot().get_yticks()
    np.testing.assert_array_equal(ticks, ticks.round())


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
