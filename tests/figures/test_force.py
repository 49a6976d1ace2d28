"""Figures of the force: their numbers against what they are made from."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from tests.figures.conftest import JUMP_PX, by_label
from tests.scenes.report_data import make_tracks
from vision.clock import video_slips
from vision.figures import force_overview_figure
from vision.figures.catalogue import figures_of
from vision.figures.force import (
    FIRST_SLIPS,
    _some_sticks,
    clock_residuals_figure,
    clocks_figure,
    force_figure,
    sticks_figure,
    stiffness_figure,
    stiffness_residuals_figure,
)
from vision.figures.positions import outward_px
from vision.models import Estimate
from vision.report.text import methods


def test_all_sheets_opening_is_positive(tracks):
    """A failure means that the clock check compares force drops with steps of the wrong sign."""
    opened = outward_px(tracks)
    assert opened[51] - opened[48] == pytest.approx(JUMP_PX * np.mean([1, 3, 5, 7, 9]) / 9, abs=0.2)


def test_frames_without_sheets_have_no_opening(tracks):
    """A failure means that lost frames are shown as motion."""
    x = tracks["x_px"].values.copy()
    x[100:110] = np.nan
    opened = outward_px(make_tracks(x))
    assert np.isnan(opened[100:110]).all()
    assert np.isfinite(np.delete(opened, np.s_[100:110])).all()


def test_peaks_lie_on_the_force_curve_and_eq_1(pulled):
    """A failure means that F(d), its peaks or the model are drawn against different separations."""
    figure = force_figure(pulled.force, pulled.sticks, pulled.fits)
    series = by_label(figure)
    peaks, model = series["peaks"], series["Eq. 1 + 𝒯_0"]
    near = np.abs(peaks.x[:, None] - series["F"].x) < 0.003
    highest = np.where(near, series["F"].y, -np.inf).max(axis=1)
    assert np.median(np.abs(highest - peaks.y) / peaks.y) < 0.02
    assert np.median(np.abs(np.interp(peaks.x, model.x, model.y) / peaks.y - 1)) < 0.03
    assert 0.001 < pulled.fits.t_star_N.value < 0.01
    assert f"with T* = {1000 * pulled.fits.t_star_N.value:g} mN and" in figure.caption


def test_captions_state_both_errors_of_the_fits(pulled):
    """A failure means a caption whose ± is the smaller part of the error that the answers above state."""
    mu, known = replace(pulled.fits.mu, systematic_error=0.02), {"error": 0.005, "systematic_error": 0.02}
    names = ("amplitude", "n_hat_N", "modulus_GPa")
    fits = replace(pulled.fits, mu=mu, **{name: Estimate(value=0.3, **known) for name in names})
    figures = {figure.name: figure for figure in figures_of(replace(pulled, fits=fits))}
    for name, estimates in (("force", 1), ("force_drop", 1), ("stiffness", 2)):
        assert figures[name].caption.count("(syst.)") >= estimates


def test_force_keeps_its_extremes_where_the_crosshead_jitters(pulled):
    """A failure means that F(d) loses peaks where the crosshead stands still or steps back."""
    rng = np.random.default_rng(1)
    force = pulled.force.copy(deep=True)
    force["d_mm"].values[:] += rng.normal(0, 1e-3, force.sizes["time_s"])
    force["load_N"].values[1000] = 400.0
    curve = by_label(force_figure(force))["F"]
    assert (np.diff(curve.x) >= 0).all()
    assert curve.y.max() == 400.0
    assert curve.x[curve.y.argmax()] == pytest.approx(force["d_mm"].values[1000], abs=0.01)


def test_single_sticks_start_at_zero_and_rise_with_their_stiffness(pulled):
    """A failure means that F − F_v against d − d_v is cut or shifted."""
    first = sticks_figure(pulled.force, pulled.sticks).panel.series[0]
    stick = pulled.sticks.iloc[0]
    assert (np.diff(first.x) >= 0).all()
    assert first.x.max() == pytest.approx(stick["stick_length_um"], abs=0.6)
    middle = (first.x > 0.3 * first.x.max()) & (first.x < 0.7 * first.x.max())
    slope = np.polyfit(first.x[middle], first.y[middle], 1)[0]
    assert 1000 * slope == pytest.approx(stick["K_N_per_mm"], rel=0.03)


def test_force_and_sheets_step_together_on_the_force_clock(pulled):
    """A failure means that the clock check is drawn with the wrong clock."""
    figure = clocks_figure(pulled.force, pulled.tracks, pulled.clock, pulled.sticks)
    force, sheets = figure.panel.series
    drop, step = _slip_times(force.x, -force.y, 10), _slip_times(sheets.x, sheets.y, 0.2)
    apart = np.abs(step[:, None] - drop).min(axis=1)
    assert len(step) >= 3
    assert apart.max() < 1.5 / 60
    late = replace(pulled.clock, offset_s=pulled.clock.offset_s + 0.3)
    shifted = clocks_figure(pulled.force, pulled.tracks, late, pulled.sticks).panel.series[1]
    wrong = _slip_times(shifted.x, shifted.y, 0.2)
    assert np.abs(wrong[:, None] - drop).min(axis=1).max() > 0.1


def test_shown_events_are_marked_at_both_ends_and_panels_leave_no_hole(pulled):
    """A failure means drops without a mark, as if they were missed, or an empty quarter of force.png."""
    figure = force_overview_figure(pulled.force, pulled.sticks, pulled.fits)
    curve, _, peaks, valleys = figure.panels[1].series
    assert curve.x[[0, -1]] == pytest.approx([valleys.x[0], peaks.x[-1]], abs=0.01)
    assert figure.panels[1].x_label == "t (s)"  # without a video there is no other clock
    still = pulled.sticks.assign(K_N_per_mm=np.nan)
    three = force_overview_figure(pulled.force, still)
    assert (len(figure.panels), figure.columns, len(three.panels), three.columns) == (4, 2, 3, 3)


@pytest.mark.parametrize(("slips", "cut"), [(12, False), (60, True)])
def test_the_first_view_of_the_clocks_cuts_no_slip(slips, cut):
    """A failure means a short film of which matched slips are out of view, or a view that ends in a slip."""
    t_p = 0.3 + np.arange(slips) + np.random.default_rng(0).uniform(-0.2, 0.2, slips)
    view = _some_sticks(np.linspace(0, slips, 100), pd.DataFrame({"t_p_s": t_p}))
    assert (view is not None) == cut
    if view is not None:
        assert ((t_p > view[0]) & (t_p < view[1])).sum() == FIRST_SLIPS
        assert min(np.abs(t_p - end).min() for end in view) > 0.25


def test_residuals_of_the_clocks_are_in_ms_and_grow_with_the_offset(pulled):
    """A failure means residuals of the wrong sign or unit, beside errors in another."""

    def points(later_s):
        clock = replace(pulled.clock, offset_s=pulled.clock.offset_s + later_s)
        figure = clock_residuals_figure(pulled.force, pulled.tracks, clock, pulled.sticks)
        return by_label(figure)["slips"]

    now, late = points(0.0), points(0.01)
    assert np.abs(now.y).max() < 1000 * 1.5 / 60
    np.testing.assert_allclose(late.y - now.y, 10.0, atol=1e-6)
    error = 1000 * video_slips(pulled.tracks)["error_s"].to_numpy()
    np.testing.assert_allclose(now.high - now.y, error[: now.y.size], rtol=1e-6)


def _slip_times(time, value, least):
    """Middles of the steps up."""
    jump = np.diff(value)
    at = np.flatnonzero(jump > least)
    at = at[np.r_[True, np.diff(at) > 3]]
    return (time[at] + time[at + 1]) / 2


def test_an_ambiguous_clock_says_so(pulled):
    """A failure means that an alignment that may be wrong looks like a sure one."""
    doubtful = replace(pulled.clock, status="ambiguous")
    figure = clocks_figure(pulled.force, pulled.tracks, doubtful)
    assert "only the likeliest" in figure.caption
    assert "one way only" not in figure.caption


def test_a_given_offset_without_slips_claims_no_agreement(pulled):
    """A failure means that a clock nobody checked is reported as checked, or as 'nan ms'."""
    unchecked = {"status": "given", "how": "given", "matched": 0, "residual_ms": np.nan, "margin": np.nan}
    figure = clocks_figure(pulled.force, pulled.tracks, replace(pulled.clock, **unchecked))
    assert "0 slips matched. The offset was not found from the slips (given)." in figure.caption
    assert "nan" not in figure.caption


def test_a_force_over_a_weight_is_in_no_newton(pulled):
    """A failure means that a number without unit is published as newtons."""
    bare = pulled.force.assign(load_N=pulled.force["load_N"].assign_attrs(units="1"))
    for results, letter in ((pulled, True), (replace(pulled, force=bare, fits=None), False)):
        figures = {figure.name: figure for figure in figures_of(results)}
        labels = [
            figures[name].panel.y_label for name in ("force", "clocks", "sticks", "force_drop", "stiffness")
        ]
        assert all(("N" in label) is letter for label in labels)
        assert (" N" in methods(results)[2]) is letter
    assert figures["force_drop"].panel.y_label == "ΔF / weight"
    assert figures["stiffness"].panel.y_label == "K / weight (1/mm)"


def test_lines_run_from_valley_to_peak_along_the_force(pulled):
    """A failure means that the picture by which events are judged shows others than the table."""
    panel = force_overview_figure(pulled.force, pulled.sticks, pulled.fits).panels[1]
    series = {one.label: one for one in panel.series}
    lines = series["stick phases"].y.reshape(-1, 3)
    times = series["stick phases"].x.reshape(-1, 3)
    middle = np.interp(times[:, :2].mean(axis=1), series["F"].x, series["F"].y)
    np.testing.assert_allclose(middle, lines[:, :2].mean(axis=1), rtol=0.03)
    first = len(pulled.sticks) // 2 - 3
    drops = pulled.sticks["dF_N"].iloc[first : first + 6]
    np.testing.assert_allclose(lines[:, 1] - lines[:, 0], drops, rtol=0.03)
    assert np.isnan(lines[:, 2]).all()  # no line from one stick to the next


def test_an_oscillation_has_rises_and_no_stick_phases(pulled):
    """A failure means that the picture calls stick phases what the run says is no stick-slip."""
    sticks = pulled.sticks.copy()
    sticks.attrs = pulled.sticks.attrs | {"regime": "oscillation"}
    whole, some = force_overview_figure(pulled.force, sticks, pulled.fits).panels[:2]
    labels = [one.label for one in some.series]
    assert "rises" in labels and "stick phases" not in labels
    assert "(oscillation), drops between fitted lines above" in whole.title


def test_a_recording_without_separation_says_so(pulled, tmp_path):
    """A failure means no picture, or empty axes, where no speed was given."""
    blind = pulled.sticks.assign(d_v_mm=np.nan, d_p_mm=np.nan, K_N_per_mm=np.nan)
    force = pulled.force.assign(d_mm=pulled.force["d_mm"] * np.nan)
    figure = force_overview_figure(force, blind)
    assert [panel.empty for panel in figure.panels] == [False, False, False]
    axes = figure.plot().figure.axes
    assert axes[2].get_xlabel().startswith("t")
    figure.save(tmp_path / "force.png")


def test_error_bars_and_arrows_are_in_view(pulled):
    """A failure means bars that are cut off, or an arrow over the curves that it measures."""
    figure = stiffness_residuals_figure(pulled.sticks, pulled.fits)
    points, y_range = by_label(figure)["K − M_eff K_eff"], figure.panel.y_range
    inside = (points.low > y_range[0]) & (points.high < y_range[1])
    assert inside.mean() > 0.9
    panel = sticks_figure(pulled.force, pulled.sticks).panel
    drop, length = panel.arrows
    curves = [series for series in panel.series if series.label.startswith("d_v")]
    assert drop.x[0] > max(series.x.max() for series in curves)
    assert length.y[0] > max(series.y.max() for series in curves)
    assert drop.x[0] < panel.x_range[1]
    assert length.y[0] < panel.y_range[1]


def test_the_legend_of_the_central_parts_has_no_event_s_colour(pulled):
    """A failure means that the dots of one event seem to be the only ones from which K is measured."""
    panel = sticks_figure(pulled.force, pulled.sticks).panel
    curves = [series.ink for series in panel.series if series.label.startswith("d_v")]
    dots = [series for series in panel.series if series.look == "points"]
    assert dots[0].label == "K is measured here" and dots[0].ink not in curves
    assert [series.ink for series in dots[1:]] == curves


def test_a_recording_without_events_has_its_picture(pulled, tmp_path):
    """A failure means a traceback for a recording in which nothing slips."""
    figure = force_overview_figure(pulled.force, pulled.sticks.iloc[:0])
    assert [panel.title for panel in figure.panels] == [figure.panel.title]
    figure.save(tmp_path / "force.png")


def test_the_stiffness_is_that_to_which_the_models_are_fitted(pulled):
    """A failure means that the residuals of a fast pull, whose sticks have knees, doubt a model that fits."""
    k = pulled.sticks["K_N_per_mm"]
    bent = pulled.sticks.assign(
        K2_N_per_mm=k, K2_err_N_per_mm=pulled.sticks["K_err_N_per_mm"], K_N_per_mm=1.3 * k
    )
    straight, knees = (
        [make(sticks, pulled.fits) for make in (stiffness_figure, stiffness_residuals_figure)]
        for sticks in (pulled.sticks, bent)
    )
    for one, other in zip(straight, knees, strict=True):
        for part, same in zip(one.panel.series, other.panel.series, strict=True):
            np.testing.assert_array_equal(part.y, same.y)
    assert "the central 50 % of every stick phase" in straight[0].caption
    assert "every stick phase after its knee" in knees[0].caption
