"""The figures' numbers against what they are made from."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure
from vision.report.chart import table_of
from vision.report.draw import draw_chart
from vision.report.methods import methods
from vision.report.sections import charts_of, sections_of
from vision.report.symbols import drawn, lettered, marked_up

from tests.scenes.report_data import make_profile, make_tracks, sawtooth
from vision.report import force_charts, sheet_charts, shell_charts

JUMP_PX = 4.0


@pytest.fixture(scope="module")
def tracks():
    return make_tracks(sawtooth(1000, 10, jump_px=JUMP_PX))


def by_label(chart):
    return {series.label: series for series in chart.series}


def test_displacements_are_in_the_unit_of_the_label(tracks):
    """A failure means that lengths in the report are off by the pixel size."""
    px, um = (sheet_charts.displacement_chart(tracks, pixel_size_um=size) for size in (None, 10.0))
    outer_px, outer_um = by_label(px)["right 5"].y, by_label(um)["right 5"].y
    assert "(px)" in px.y_label
    assert "(µm)" in um.y_label
    assert np.ptp(outer_px) == pytest.approx(JUMP_PX, abs=0.1)
    np.testing.assert_allclose(outer_um, 10 * outer_px)


def test_the_space_time_tracks_are_where_the_ridges_are(tracks):
    """A failure means that tracks are drawn beside their ridges."""
    chart = sheet_charts.space_time_chart(make_profile(tracks, 220), tracks, pixel_size_um=10.0)
    np.testing.assert_allclose(by_label(chart)["left 1"].y, tracks["x_px"].values[:, 4] * 0.01)
    assert (chart.picture.left, chart.picture.right) == pytest.approx((-0.005, 2.195))
    assert chart.picture.top == pytest.approx(-0.5 / 60)


def test_long_tests_keep_every_slip_on_the_page():
    """A failure means that slips vanish from x(n,t) of a long test."""
    chart = sheet_charts.displacement_chart(make_tracks(sawtooth(100_000, 6, period=4000)))
    outer = by_label(chart)["right 3"].y
    assert len(outer) <= sheet_charts.MOST_POINTS
    assert (np.diff(outer) > JUMP_PX / 2).sum() == 24
    assert "24 slips" not in chart.caption
    assert "tracks.csv holds every frame" in chart.caption


def test_the_frame_numbers_its_sheets(tracks):
    """A failure means that sheets carry another number in the picture than in the tables."""
    chart = sheet_charts.frame_chart(np.arange(220 * 200).reshape(200, 220) % 255, tracks)
    left, right = chart.series
    assert left.text == ("5", "4", "3", "2", "1")
    assert right.text == ("1", "2", "3", "4", "5")
    np.testing.assert_allclose(right.x, tracks["x_px"].values[0, 5:])
    assert (chart.bands[0].low, chart.bands[0].high) == (59.5, 143.5)


def test_locked_positions_show_in_the_locking_check():
    """A failure means that the report cannot tell a fit that locks to whole pixels."""
    rng = np.random.default_rng(0)
    true = rng.uniform(0, 20, 12) + np.linspace(0, 2.3, 2000)[:, None] + np.arange(12) * 20
    even = sheet_charts.locking_chart(make_tracks(true))
    locked = sheet_charts.locking_chart(make_tracks(true - 0.05 * np.sin(2 * np.pi * true)))

    def errors_off(chart):
        band = chart.bands[0]
        return (by_label(chart)["positions"].y - 1) / ((band.high - 1) / 2)

    assert np.abs(errors_off(even)).max() < 3
    assert errors_off(locked)[[0, -1]].min() > 4
    assert errors_off(locked)[9:11].max() < -3


def test_still_sheets_are_no_sign_of_locking():
    """A failure means that sheets that happen to stand at the same phase are called locked."""
    rng = np.random.default_rng(3)
    x = np.sort(rng.uniform(0, 400, 10)) + rng.normal(0, 0.01, (5000, 10))
    chart = sheet_charts.locking_chart(make_tracks(x))
    density, band = by_label(chart)["positions"].y, chart.bands[0]
    assert density.min() == 0
    assert band.low == 0
    assert (density < 1 + 1.5 * (band.high - 1)).all()


def test_the_noise_of_each_sheet_is_that_of_the_tables(tracks):
    """A failure means that noise is shown for the wrong sheet or in the wrong unit."""
    tracks = tracks.assign(x_noise_px=("sheet", np.arange(10) / 100))
    chart = sheet_charts.noise_chart(tracks, pixel_size_um=10.0)
    measured = by_label(chart)["measured"]
    assert measured.x.tolist() == [-5, -4, -3, -2, -1, 1, 2, 3, 4, 5]
    np.testing.assert_allclose(measured.y, np.arange(10) / 10)


def test_a_recording_without_clock_counts_frames(tracks):
    """A failure means that a report claims seconds that nobody measured."""
    unknown = tracks.assign_coords(time_s=("frame", np.full(1000, np.nan)))
    chart = sheet_charts.displacement_chart(unknown)
    assert chart.x_label == "frame"
    assert chart.series[0].x[-1] == 999
    playback = tracks.assign_attrs(clock_kind="playback")
    assert "playback" in sheet_charts.displacement_chart(playback).x_label


def test_all_sheets_opening_is_positive(tracks):
    """A failure means that the clock check compares force drops with steps of the wrong sign."""
    opened = force_charts.opening_px(tracks)
    assert opened[51] - opened[48] == pytest.approx(JUMP_PX * np.mean([1, 3, 5, 7, 9]) / 9, abs=0.2)


def test_frames_without_sheets_have_no_opening(tracks):
    """A failure means that lost frames are shown as motion."""
    x = tracks["x_px"].values.copy()
    x[100:110] = np.nan
    opened = force_charts.opening_px(make_tracks(x))
    assert np.isnan(opened[100:110]).all()
    assert np.isfinite(np.delete(opened, np.s_[100:110])).all()


def test_peaks_lie_on_the_force_curve_and_eq_1(pulled):
    """A failure means that F(d), its peaks or the model are drawn against different separations."""
    chart = force_charts.pull_chart(pulled.force, pulled.sticks, pulled.fits)
    series = by_label(chart)
    peaks, model = series["peaks"], series["Eq. 1 + T_0"]
    near = np.abs(peaks.x[:, None] - series["F"].x) < 0.003
    highest = np.where(near, series["F"].y, -np.inf).max(axis=1)
    assert np.median(np.abs(highest - peaks.y) / peaks.y) < 0.02
    assert np.median(np.abs(np.interp(peaks.x, model.x, model.y) / peaks.y - 1)) < 0.03


def test_single_sticks_start_at_zero_and_rise_with_their_stiffness(pulled):
    """A failure means that F − F_v against d − d_v is cut or shifted."""
    first = force_charts.sticks_chart(pulled.force, pulled.sticks).series[0]
    stick = pulled.sticks.iloc[0]
    assert (np.diff(first.x) >= 0).all()
    assert first.x.max() == pytest.approx(stick["stick_length_um"], abs=0.6)
    middle = (first.x > 0.3 * first.x.max()) & (first.x < 0.7 * first.x.max())
    slope = np.polyfit(first.x[middle], first.y[middle], 1)[0]
    assert 1000 * slope == pytest.approx(stick["K_N_per_mm"], rel=0.03)


def test_force_and_sheets_step_together_on_the_force_clock(pulled):
    """A failure means that the clock check is drawn with the wrong clock."""
    chart = force_charts.clock_chart(pulled.force, pulled.tracks, pulled.clock, pulled.sticks)
    force, sheets = chart.series
    drop, step = _slip_times(force.x, -force.y, 10), _slip_times(sheets.x, sheets.y, 0.2)
    apart = np.abs(step[:, None] - drop).min(axis=1)
    assert len(step) >= 3
    assert apart.max() < 1.5 / 60
    late = replace(pulled.clock, offset_s=pulled.clock.offset_s + 0.3)
    shifted = force_charts.clock_chart(pulled.force, pulled.tracks, late, pulled.sticks).series[1]
    wrong = _slip_times(shifted.x, shifted.y, 0.2)
    assert np.abs(wrong[:, None] - drop).min(axis=1).max() > 0.1


def _slip_times(time, value, least):
    """Middles of the steps up."""
    jump = np.diff(value)
    at = np.flatnonzero(jump > least)
    at = at[np.r_[True, np.diff(at) > 3]]
    return (time[at] + time[at + 1]) / 2


def test_an_ambiguous_clock_says_so(pulled):
    """A failure means that an alignment that may be wrong looks like a sure one."""
    doubtful = replace(pulled.clock, status="ambiguous")
    chart = force_charts.clock_chart(pulled.force, pulled.tracks, doubtful)
    assert any("ambiguous" in note for note in chart.notes)
    assert "one way only" not in chart.caption


def test_a_given_offset_without_slips_claims_no_agreement(pulled):
    """A failure means that a clock nobody checked is reported as checked, or as 'nan ms'."""
    unchecked = {"status": "given", "how": "given", "matched": 0, "residual_ms": np.nan, "margin": np.nan}
    chart = force_charts.clock_chart(pulled.force, pulled.tracks, replace(pulled.clock, **unchecked))
    assert "No slip was matched. The offset was not found from the slips (given)." in chart.caption
    assert "nan" not in chart.caption


def test_one_stick_shows_inward_motion_of_its_size(pulled):
    """A failure means that δx(t) is that of another stick, sheet or sign."""
    chart = shell_charts.stick_chart(pulled.tracks, pulled.motion, pulled.clock)
    series, outer = by_label(chart), int(pulled.tracks["n"].max())
    event = int(chart.title.split("event ")[1].split(",")[0])
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
    chart = shell_charts.ratio_chart(pulled.motion, threshold=0.2)
    assert (chart.bands[0].low, chart.bands[0].high) == (0, 0.2)
    assert "0.2" in chart.caption
    first = chart.series[0]
    assert first.x.tolist() == sorted(first.x)
    assert first.y[[0, -1]].min() > 0.3 > 0.1 > first.y[24:26].max()


def test_shell_sizes_are_those_of_the_table(pulled):
    """A failure means that the shell figure and shells.csv disagree."""
    chart = shell_charts.shells_chart(pulled.shells, pulled.fits)
    right = by_label(chart)["right side"]
    table = pulled.shells[pulled.shells["side"] == 1]
    np.testing.assert_allclose(right.y, table["stiff_sheets"].astype(float))
    np.testing.assert_allclose(right.low, table["stiff_low"].astype(float))
    model = by_label(chart)["M_eff (force)"]
    np.testing.assert_allclose(model.y, pulled.fits.effective_sheets(model.x))


def test_both_sides_of_a_shell_are_seen_side_by_side(pulled):
    """A failure means that the left side's points hide behind the right side's, or stand at a wrong d."""
    shells = pulled.shells.assign(stiff_sheets=8)
    chart = shell_charts.shells_chart(shells)
    left, right = (by_label(chart)[f"{side} side"] for side in ("left", "right"))
    assert left.hollow and not right.hollow
    step = np.diff(np.unique(shells["d_v_mm"])).min()
    assert 0 < right.shift == -left.shift < step / 2
    np.testing.assert_array_equal(left.x, right.x)  # the table has d itself
    ax = draw_chart(Figure().subplots(), chart)
    at = {line.get_label(): line.get_xdata() for line in ax.lines}
    np.testing.assert_allclose(at["right side"] - at["left side"], 2 * right.shift)


def test_a_force_over_a_weight_is_in_no_newton(pulled):
    """A failure means that a number without unit is published as newtons."""
    bare = pulled.force.assign(load_N=pulled.force["load_N"].assign_attrs(units="1"))
    for results, letter in ((pulled, True), (replace(pulled, force=bare, fits=None), False)):
        charts = {chart.name: chart for chart in charts_of(sections_of(results))}
        labels = [charts[name].y_label for name in ("force", "clocks", "sticks", "drops", "stiffness")]
        assert all(("N" in label) is letter for label in labels)
        assert (" N" in methods(results)[2]) is letter
    assert charts["drops"].y_label == "ΔF / weight"
    assert charts["stiffness"].y_label == "K / weight (1/mm)"


@pytest.mark.parametrize(
    ("text", "small", "markup", "figure"),
    [
        ("σ_x / Λ_st", "σₓ / Λₛₜ", "σ<sub>x</sub> / Λ<sub>st</sub>", "σₓ / Λₛₜ"),
        ("F − F_v (N)", "F − Fᵥ (N)", "F − F<sub>v</sub> (N)", "F − Fᵥ (N)"),
        (
            "M_eff K_eff",
            "M_eff K_eff",
            "M<sub>eff</sub> K<sub>eff</sub>",
            r"$M_{\mathrm{eff}}$ $K_{\mathrm{eff}}$",
        ),
        ("tracks_x.csv <b>", "tracks_x.csv <b>", "tracks_x.csv &lt;b&gt;", "tracks_x.csv <b>"),
    ],
)
def test_symbols_are_set_as_in_print(text, small, markup, figure):
    """A failure means underscores in a manuscript's figure, or a file name taken for a symbol."""
    assert (lettered(text), str(marked_up(text)), drawn(text)) == (small, markup, figure)


def test_tables_hold_the_drawn_numbers(pulled, tracks):
    """A failure means that the CSV of a figure is not what the figure shows."""
    wide = table_of(sheet_charts.displacement_chart(tracks))
    assert list(wide.columns[:2]) == ["t (s)", "left 5"]
    np.testing.assert_allclose(
        wide["right 5"], tracks["x_px"][:, 9] - tracks["x_px"][:, 9].median(), atol=1e-12
    )
    long = table_of(shell_charts.shells_chart(pulled.shells, pulled.fits))
    assert set(long["series"]) == {"left side", "right side", "M_eff (force)"}
    assert long.loc[long["series"] == "right side", "low"].notna().all()
    both = table_of(force_charts.clock_chart(pulled.force, pulled.tracks, pulled.clock))
    assert both.loc[both["series"] == "sheets", "quantity"].str.contains("px").all()
