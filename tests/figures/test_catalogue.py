"""Which figures a run has, those that put others together, those of the publication; notebooks."""

import itertools
import re
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from matplotlib.backends.backend_agg import FigureCanvasAgg

from tests.scenes.analysed import Found
from tests.scenes.report_data import make_profile, make_tracks, sawtooth
from vision.errors import InputError
from vision.figures.camera import SlipTimes, intensity_figure, single_sheets_figure, space_time_figure
from vision.figures.catalogue import (
    FIGURES,
    Plots,
    figure_named,
    figures_of,
    kymograph,
    missing_parts,
    not_in_report,
    overview,
    sections_of,
)
from vision.figures.figure import Figure, Image, Panel
from vision.figures.positions import mean_deformation_figure
from vision.folder import html_table


def scene(*, sheets=7, frames=40, rows=60, columns=400, times_s=None, nothing_found=False):
    """Frame, strip I(x, t) and tracks of a comb that opens and closes."""
    n = np.arange(sheets) - (sheets - 1) / 2
    t = np.arange(frames)
    x_px = columns / 2 + n * (columns - 20) / sheets + 2 * np.sin(t / 5)[:, None] * n / max(1, n.max())
    if nothing_found:
        x_px[:] = np.nan
    ridges = np.exp(-((np.arange(columns) - np.nan_to_num(x_px)[:, :, None]) ** 2) / 8).sum(axis=1)
    profile = np.asarray(50 + 100 * ridges, np.float32)
    clock = {"time_s": ("frame", t / 25 if times_s is None else times_s), "frame": t}
    attrs = {"strip_z0": rows // 3, "strip_z1": rows // 2, "clock_kind": "given", "axis_px": columns / 2}
    strip = xr.DataArray(profile, dims=("frame", "x"), coords=clock | {"x": np.arange(columns)}, attrs=attrs)
    who = {
        "sheet": np.arange(sheets),
        "side": ("sheet", np.where(n < 0, -1, 1)),
        "n": ("sheet", np.abs(np.floor(np.where(n < 0, n, n + 1))).astype(int)),
    }
    positions = {"x_px": (("frame", "sheet"), x_px), "x_err_px": (("frame", "sheet"), 0 * x_px + 0.01)}
    noise = {"x_noise_px": ("sheet", np.full(sheets, 0.01))}
    tracks = xr.Dataset(positions | noise, coords=clock | who, attrs=attrs | {"fit": "sliding"})
    frame = np.broadcast_to(profile[:1], (rows, columns)).astype(np.uint8)
    return Found(frame=frame, strip=strip, tracks=tracks, pixel_size_um=10.0)


@pytest.mark.thorough
@pytest.mark.parametrize(
    "options",
    [
        {"sheets": 1},
        {"sheets": 200, "columns": 1920, "frames": 5},
        {"frames": 1},
        {"frames": 2, "columns": 12, "sheets": 2},
        {"frames": 9000, "sheets": 2},
        {"rows": 4},
        {"rows": 1200},
        {"times_s": np.full(40, np.nan)},
        {"times_s": np.r_[np.arange(20.0), np.arange(20.0)]},
        {"nothing_found": True},
    ],
)
def test_any_recording_has_its_figures(options, tmp_path):
    """A failure means that a run's tables are lost because its figures cannot be drawn."""
    figures = figures_of(scene(**options))
    names = ["frame", "space_time", "tracks", "outer_inner", "noise", "pixel_locking"]
    if options.get("sheets", 7) < 6:  # thirds of a side need three sheets
        names.remove("outer_inner")
    assert [figure.name for figure in figures] == names
    for figure in (*figures, overview(figures), kymograph(figures)):
        assert figure.save(tmp_path / f"{figure.name}.png").stat().st_size > 3000


def test_blank_frames_are_shown_as_missing():
    """A failure means a black picture, or none, where every row that is drawn is missing."""
    results = scene()
    results.strip[:] = np.nan
    image = next(figure for figure in figures_of(results) if figure.name == "space_time").panel.image
    assert image.missing.all()
    assert (image.pixels == 128).all()


@pytest.mark.parametrize("sheets", [7, 50, 200])
def test_no_two_sheet_numbers_overlap(sheets):
    """A failure means that the numbers 1 and 1 at the centre read as 11."""
    page = overview(figures_of(scene(sheets=sheets, columns=1920, frames=3))).plot().figure
    FigureCanvasAgg(page).draw()
    numbers = [label for label in page.axes[0].texts if label.get_text().isdigit()]
    boxes = sorted((label.get_window_extent() for label in numbers), key=lambda box: box.x0)
    assert len(boxes) >= min(sheets, 20)
    assert all(a.x1 <= b.x0 for a, b in itertools.pairwise(boxes))


def test_nothing_in_the_overview_overlaps():
    """A failure means a title over a legend, or labels of one panel in the next."""
    page = overview(figures_of(scene())).plot().figure
    FigureCanvasAgg(page).draw()
    boxes = [ax.get_tightbbox() for ax in page.axes]
    titles, feet = (
        [text.get_window_extent() for text in page.texts if text.get_va() == where]
        for where in ("baseline", "top")
    )
    assert len(feet) == 2
    assert not any(foot.overlaps(box) for foot in feet for box in [*boxes, *titles])
    legend = page.axes[2].get_legend().get_window_extent()
    assert legend.y0 >= page.axes[2].get_window_extent().y1  # above the lines
    assert not titles[2].overlaps(legend)
    assert all(upper.y0 >= lower.y1 for upper, lower in itertools.pairwise(boxes))
    assert all(title.y0 >= ax.get_window_extent().y1 for title, ax in zip(titles, page.axes, strict=True))
    assert all(page.bbox.contains(*corner) for box in [*boxes, *titles, *feet] for corner in (box.p0, box.p1))


@pytest.mark.parametrize("shape", [(20, 1200), (400, 30)])
def test_the_grey_scale_of_a_frame_lies_beside_everything(shape):
    """A failure means a grey scale over the title of a narrow frame, or over the numbers of a flat one, or
    cut off at the edge of the picture."""
    image = Image(
        pixels=np.zeros(shape, np.uint8), left=0, right=shape[1], top=0, bottom=shape[0], black=3, white=90
    )
    panel = Panel(
        title="Frame 0 (t = 0 s): averaged rows (outlined)",
        x_label="x (px)",
        y_label="z (px)",
        image=image,
        downwards=True,
    )
    figure = Figure(name="frame", title="frame", caption="", panels=(panel,))
    page = figure.plot().figure
    FigureCanvasAgg(page).draw()
    ax = page.axes[0]
    (text,) = (text for text in page.texts if "grey levels" in text.get_text())
    scale = text.get_window_extent()
    others = [ax.xaxis.label, *ax.get_xticklabels()]
    assert not any(scale.overlaps(other.get_window_extent()) for other in others)
    assert page.bbox.y0 <= scale.y0 < scale.y1 <= ax.get_window_extent().y0


def test_tracks_lie_on_their_ridges_also_after_a_gap():
    """A failure means that after lost frames, or in mm, the tracks lie beside the ridges they belong to."""
    times_s = np.arange(40) / 25
    times_s[20:] += 2.0
    results = scene(times_s=times_s)
    ax = space_time_figure(results.strip, results.tracks, pixel_size_um=10.0).plot()
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x (mm)", "t (s)")
    drawn = [line for collection in ax.collections for line in collection.get_segments()]
    expected = np.stack([results.tracks["x_px"].values.T / 100, np.tile(times_s, (7, 1))], axis=2)
    for part in (drawn[:7], drawn[7:]):  # dark edges, then colours
        np.testing.assert_allclose(sorted(part, key=lambda line: line[0, 0]), expected)


def test_a_single_frame_is_seen_as_dots():
    """A failure means that the positions of a single picture are drawn as nothing."""
    results = scene(frames=1)
    ax = space_time_figure(results.strip, results.tracks).plot()
    assert [line.get_marker() for line in ax.lines] == ["o"] * 7


def test_figures_come_in_the_order_of_reading(pulled):
    """A failure means that a figure is missing or elsewhere, or has a panel that the report does not draw."""
    figures = figures_of(pulled)
    assert {len(figure.panels) for figure in figures} == {1}
    assert [figure.name for figure in figures] == [name for name, entry in FIGURES.items() if entry.section]
    assert [figure.name for _, part in sections_of(figures) for figure in part] == [f.name for f in figures]


def test_every_figure_can_be_made_alone(pulled):
    """A failure means that a name of the catalogue makes another figure, or none."""
    made = {name: entry.make(pulled) for name, entry in FIGURES.items()}
    assert {name: figure.name for name, figure in made.items()} == {name: name for name in made}
    assert all(figure.caption and figure.title for figure in made.values())
    assert all(entry.make(Found()) is None for entry in FIGURES.values())


@pytest.mark.parametrize(
    ("changes", "reason", "gone"),
    [
        (
            {"motion": None, "shells": None},
            "no stick phase was measured in the video",
            {"stick", "deformation", "shells"},
        ),
        (
            {"clock": None, "motion": None, "shells": None},
            "were not matched",
            {"clocks", "stick", "deformation", "shells"},
        ),
        ({"fits": None}, "the models were not fitted", set()),
        ({"shells": None}, "too few sheets have a known deformation", {"shells"}),
        (
            {"sticks": None, "clock": None, "motion": None, "shells": None, "fits": None},
            "none were found",
            {"sticks", "force_drop", "stiffness"},
        ),
        ({"frame": None, "reasons": {"frame": "it was raining"}}, "it was raining", {"frame"}),
        ({"pixel_size_um": None}, "(`pixel_size_um`)", set()),
        ({"tracks": None, "strip": None, "motion": None}, "no video was given", {"tracks", "clocks"}),
    ],
)
def test_each_missing_part_is_named(pulled, changes, reason, gone):
    """A failure means that a part is missing without a word."""
    results = replace(pulled, **changes)
    assert reason in " ".join(missing_parts(results))
    assert not gone & {figure.name for figure in figures_of(results)}


def test_nothing_is_missing_from_a_whole_run(pulled):
    """A failure means that a reader is told to give what was given."""
    assert missing_parts(pulled) == []


def test_ambiguous_clocks_are_named_in_a_sentence(pulled):
    """A failure means "expected clocks that are not ambiguous; found …" in the report."""
    clock = replace(pulled.clock, status="ambiguous")
    reasons = {"motion": "test.avi: expected clocks that are not ambiguous; found too few slips"}
    (line,) = missing_parts(replace(pulled, motion=None, shells=None, clock=clock, reasons=reasons))
    assert line.startswith("Deformation and shells: the time of stick phases in the video is unknown")


def test_a_whole_run_has_them_all_with_their_numbers(pulled):
    """A failure means that a figure of the publication is not there, or does not say which one it is."""
    figures = figures_of(pulled, not_in_report())
    assert [f.name for f in figures] == ["force_insets", "single_sheets", "mean_deformation", "intensity"]
    assert all(f"figure {FIGURES[f.name].paper} of the publication" in f.caption for f in figures)


def test_the_mean_deformation_is_that_of_the_sticks(pulled):
    """A failure means that a curve is not the mean, or its band not the spread, of the sticks it names."""
    figure = mean_deformation_figure(pulled.motion, threshold=pulled.threshold)
    curve = figure.panel.series[0]
    ratio = pulled.motion["ratio"].to_numpy()
    order = np.argsort(pulled.motion["side"].values * pulled.motion["n"].values)
    np.testing.assert_allclose(curve.y, np.nanmean(ratio, axis=0)[order])
    spread = np.nanstd(ratio, axis=0, ddof=1)[order]
    np.testing.assert_allclose(curve.high - curve.y, spread, atol=1e-12)
    assert f"{pulled.motion['d_v_mm'].values.mean():.2f} mm" in curve.label


def test_one_ridge_moves_inwards_and_back():
    """A failure means that the three frames are not start and end of a stick and after its slip."""
    tracks = make_tracks(sawtooth(400, 12, period=50, noise_px=0.001))
    strip = make_profile(tracks, 260)
    figure = intensity_figure(strip, tracks, SlipTimes(tracks["time_s"].values[50:351:50] - 0.5 / 60))
    lines = [s for s in figure.panels[1].series if s.dashed]
    start, end, after = (float(s.x[0]) for s in lines)
    assert start - end == pytest.approx(4.0, abs=0.5)  # the jump, right side: inwards is to the left
    assert abs(after - start) < 0.3
    assert len(intensity_figure(strip, tracks).panels) == 1  # without slips no stick is known


def test_space_time_of_two_sheets_over_four_slips(pulled):
    """A failure means the wrong sheets, or slips marked elsewhere than in the force."""
    slips, source = pulled.slips
    figure = single_sheets_figure(pulled.strip, pulled.tracks, SlipTimes(slips), pixel_size_um=10.0)
    assert source == "the force"
    assert [panel.title.split("\n")[0] for panel in figure.panels] == ["right, n = 23", "right, n = 10"]
    assert len({panel.y_range for panel in figure.panels}) == 1  # and so the same ticks
    inside = slips[(slips > 0) & (slips < float(pulled.tracks["time_s"][-1]))]
    np.testing.assert_allclose(figure.panels[0].marks, inside[:4])
    assert single_sheets_figure(pulled.strip, pulled.tracks, SlipTimes(inside[:1])) is None


def test_k_is_marked_where_it_is_taken(pulled):
    """A failure means that the dots or arrows of F − F_v are not K's stretch, ΔF and Λ_st."""
    panel = FIGURES["sticks"].make(pulled).panel
    first = pulled.sticks.iloc[0]
    dots = next(s for s in panel.series if s.label == "K is measured here")
    length = first["stick_length_um"]
    assert dots.x.min() >= 0.24 * length
    assert dots.x.max() <= 0.76 * length
    drop, stick = panel.arrows
    assert drop.y == (0.0, pytest.approx(first["dF_N"]))
    assert stick.x == (0.0, pytest.approx(length))


def test_clock_and_models_are_short_tables(pulled):
    """A failure means that a notebook shows a wall of numbers, or a value without its error."""
    clock, fits = pulled.clock._repr_html_(), pulled.fits._repr_html_()
    assert f"{pulled.clock.offset_s:.4f}" in clock
    assert f"{pulled.clock.matched} matched" in clock
    assert "nan" not in clock
    mu = pulled.fits.mu
    assert f" ± {mu.error:.2g} (stat.) ± {mu.systematic_error:.2g} (syst.)" in fits
    digits = len(re.search(r"0\.(\d+) ± ", fits)[1])  # the value ends where its error does
    assert 10 <= min(mu.error, mu.systematic_error) * 10**digits < 100
    assert clock.count("<tr>") <= 8
    assert fits.count("<tr>") <= 14
    for shown, table in ((pulled.clock, clock), (pulled.fits, fits)):
        lines = repr(shown).splitlines()
        assert len(lines) == 1 + table.count("<tr>")
        assert max(map(len, lines)) < 160


def test_text_cannot_break_the_table():
    """A failure means that a file's name injects markup into a notebook."""
    assert "<script>" not in html_table("<script>", {"<script>": "<script>"})


def test_a_figure_shows_the_stick_phases_that_were_chosen(pulled):
    """A failure means that a notebook can show one stick phase only, or another than it was asked for."""
    events = pulled.motion["event"].values.tolist()
    for event in (events[0], events[-1]):
        figure = figure_named(pulled, "stick", event=event)
        assert f"event {event}," in figure.title
        stick_um = float(pulled.motion["stick_length_um"].sel(event=event))
        length_s = max(float(series.x[-1]) for series in figure.panel.series)
        row = pulled.sticks.set_index("event").loc[event]
        assert 0 < length_s <= row.t_p_s - row.t_v_s
        assert f"{stick_um:.1f} µm" in figure.caption
    assert (
        len(Plots(pulled).deformation(events=events[:2]).get_legend().get_texts()) == 3
    )  # and the threshold
    with pytest.raises(InputError, match=r"measured stick phases \(.{,30}\); found 1000000"):
        Plots(pulled).stick(event=10**6)
    with pytest.raises(InputError, match=r"options that it has \(events\)"):
        Plots(pulled).deformation(event=events[0])
