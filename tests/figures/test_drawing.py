"""Figures drawn by matplotlib."""

import itertools
import subprocess
import sys
from dataclasses import replace

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure as Page
from matplotlib.font_manager import FontProperties, findfont, get_font

from tests.scenes.analysed import with_force
from tests.scenes.report_data import make_tracks, sawtooth
from vision.figures import Figure, Image, Panel, Series, noise_figure, space_time_figure, tracks_figure
from vision.figures.camera import SlipTimes
from vision.figures.catalogue import figure_named, figures_of
from vision.figures.drawing import _page, new_figure, picture_style, render
from vision.figures.force import clocks_figure
from vision.figures.style import DATA, label_step


def test_the_same_figure_gives_the_same_file(tmp_path):
    """A failure means that figures under version control change without reason."""
    figure = noise_figure(make_tracks(sawtooth(300, 10)))
    for kind in ("png", "pdf", "svg"):
        one, other = (figure.save(tmp_path / f"{k}.{kind}").read_bytes() for k in range(2))
        assert one == other


def test_text_of_vector_files_is_text(tmp_path):
    """A failure means that a manuscript's labels cannot be edited or searched."""
    figure = noise_figure(make_tracks(sawtooth(300, 10)))
    assert "noise of x (px)" in figure.save(tmp_path / "noise.svg").read_text(encoding="utf-8")
    assert b"DejaVuSans" in figure.save(tmp_path / "noise.pdf").read_bytes()


def test_figures_have_the_letters_they_need():
    """A failure means boxes in place of symbols."""
    with picture_style():
        glyphs = get_font(findfont(FontProperties())).get_charmap()
    needed = "AZaz09 ~ΔΛσδμ²¹⁻ₓᵥₚₛₜ₀−±·×∝√µ°…→"
    assert [letter for letter in needed if ord(letter) not in glyphs] == []


def test_nobody_s_settings_change_the_files(tmp_path):
    """A failure means that a matplotlibrc turns the report's pictures into white on black, or into LaTeX."""
    figure = noise_figure(make_tracks(sawtooth(300, 10)))
    plain = figure.save(tmp_path / "plain.png").read_bytes()
    with mpl.rc_context({"axes.facecolor": "black", "font.size": 30, "text.usetex": True}):
        assert figure.save(tmp_path / "other.png").read_bytes() == plain
        assert mpl.rcParams["font.size"] == 30


@pytest.mark.thorough
def test_pyplot_is_not_imported_unless_it_is_used():
    """A failure means a slower start, or a window where there is no screen."""
    code = """
import sys
import numpy as np
from tests.scenes.analysed import with_force
from tests.scenes.report_data import make_tracks, sawtooth
from vision.figures import tracks_figure
figure = tracks_figure(make_tracks(sawtooth(30, 4)))
assert "matplotlib" not in sys.modules
figure.plot()
assert "matplotlib.pyplot" not in sys.modules
"""
    found = subprocess.run(
        [sys.executable, "-c", code], check=False, capture_output=True, text=True, env=None
    )
    assert found.returncode == 0, found.stderr


def test_a_notebook_shows_every_picture(monkeypatch):
    """A failure means that a notebook shows only the first picture, and then no other plots."""
    monkeypatch.setitem(sys.modules, "ipykernel", sys)
    figure = tracks_figure(make_tracks(sawtooth(30, 4)))
    shown = []
    monkeypatch.setattr(plt, "figure", lambda: shown.append(mpl.is_interactive()) or Page())
    with mpl.rc_context({"interactive": True, "figure.facecolor": "black"}):
        pages = [figure.plot().figure for _ in range(2)]
        assert shown == [True, True]
        assert mpl.is_interactive()
    assert [page.get_facecolor() for page in pages] == [(1, 1, 1, 1)] * 2
    assert tuple(pages[0].get_size_inches()) == (6.0, pytest.approx(3.13, abs=0.5))


def test_time_runs_down_in_the_space_time_diagram(video_only):
    """A failure means that slips look inwards instead of outwards."""
    ax = space_time_figure(video_only.strip, video_only.tracks).plot()
    top, bottom = ax.get_ylim()[::-1]
    assert top < bottom
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x (px)", "t (s)")


def test_the_two_curves_of_the_clock_check_do_not_cross(pulled):
    """A failure means that one curve hides the other where the clocks are judged."""
    ax = clocks_figure(pulled.force, pulled.tracks, pulled.clock, pulled.sticks).plot()
    right = next(other for other in ax.figure.axes if other is not ax)
    low, high = ax.get_xlim()

    def share(axes):
        line = axes.lines[0]
        x, y = line.get_xdata(), line.get_ydata()
        bottom, top = axes.get_ylim()
        return (y[(x >= low) & (x <= high)] - bottom) / (top - bottom)

    assert share(ax).min() > share(right).max()


def test_a_title_is_wrapped_to_its_panel():
    """A failure means that the titles of a narrow film end outside the picture."""
    title = "Frame 0 (t = 0 s): averaged rows (outlined), sheet numbers n, symmetry axis (dashed)"
    panel = Panel(title=title, x_label="x (px)", y_label="z (px)")
    page = new_figure(Figure(name="narrow", title="", caption="", panels=(panel, panel), width_in=5))
    FigureCanvasAgg(page).draw()
    above, below = (text.get_window_extent() for text in page.texts)
    assert [text.get_text().replace("\n", " ") for text in page.texts] == [title, title]
    assert max(above.x1, below.x1) <= page.bbox.x1 and above.y1 <= page.bbox.y1
    assert below.y1 < page.axes[0].get_window_extent().y0 and below.y0 > page.axes[1].get_window_extent().y1


def test_titles_of_a_row_stand_at_one_height():
    """A failure means that a long legend lifts one title above those beside it."""
    curves = [Series(label=f"{k} N", x=np.arange(3.0), y=np.arange(3.0), ink=DATA) for k in range(9)]
    panels = [
        Panel(title=f"after {n}", x_label="x", y_label="y", series=tuple(curves[:n])) for n in (9, 1, 3)
    ]
    page = new_figure(Figure(name="row", title="", caption="", panels=tuple(panels), columns=3, width_in=13))
    FigureCanvasAgg(page).draw()
    assert len({text.get_position()[1] for text in page.texts}) == 1
    lowest = min(text.get_window_extent().y0 for text in page.texts)
    assert lowest >= max(ax.get_legend().get_window_extent().y1 for ax in page.axes[1:])


def test_legends_name_the_sides_and_hide_nothing():
    """A failure means that the highest peaks disappear behind the legend."""
    ax = tracks_figure(make_tracks(sawtooth(100, 6))).plot()
    FigureCanvasAgg(ax.figure).draw()
    legend = ax.get_legend()
    assert legend.get_window_extent().y0 >= ax.get_window_extent().y1
    names = [text.get_text() for text in legend.get_texts()]
    assert names == [f"{side}, n = 1 (dark) to 3 (bright)" for side in ("left", "right")]


def test_legends_and_lines_show_what_there_is():
    """A failure means a legend of curves that are not drawn, or measured values that no line shows."""
    x = np.arange(5.0)
    series = (
        Series(label="alone", x=x, y=np.array([np.nan, 2, np.nan, 3, 4]), ink=DATA),
        Series(label="nothing", x=x, y=np.full(5, np.nan), ink=DATA),
    )
    panel = Panel(x_label="x", y_label="y", series=series)
    ax = Figure(name="f", title="", caption="", panels=(panel,)).plot()
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["alone"]
    assert [line.get_xdata().tolist() for line in ax.lines if line.get_marker() == "o"] == [[1.0]]


def test_the_label_of_marks_is_below_their_panel(video_only):
    """A failure means that the displacements seem to have marks, or that nobody knows what marks are."""
    panel = space_time_figure(
        video_only.strip, video_only.tracks, slips=SlipTimes(np.array([1.0, 2.0]))
    ).panel
    lower = Panel(
        x_label="x", y_label="y", series=(Series(label="F", x=np.arange(3.0), y=np.arange(3.0), ink=DATA),)
    )
    page = new_figure(Figure(name="f", title="", caption="", panels=(panel, lower)))
    FigureCanvasAgg(page).draw()
    label = next(t for t in page.texts if panel.marks_label in t.get_text()).get_window_extent()
    assert page.axes[0].xaxis.label.get_window_extent().y0 > label.y1
    assert label.y0 > page.axes[1].get_window_extent().y1
    assert label.y0 > max(text.get_window_extent().y1 for text in page.axes[1].get_legend().get_texts())


def test_many_tracks_leave_the_image_visible(video_only):
    """A failure means that the lines of many sheets hide the ridges."""
    few, many = (space_time_figure(video_only.strip, make_tracks(sawtooth(60, n))).panel for n in (10, 200))
    assert few.series[0].width == 1
    assert many.series[0].width == 0.25


def test_a_small_space_time_diagram_has_thinner_tracks(video_only):
    """A failure means that the tracks of 50 sheets hide the ridges in a figure for a manuscript."""
    figure = space_time_figure(video_only.strip, make_tracks(sawtooth(60, 50)))
    small, wide = (
        replace(figure, width_in=width).plot().collections[-1].get_linewidth()[0] for width in (6, 13)
    )
    assert wide == pytest.approx(1.0, abs=0.03)
    assert small == pytest.approx(5.0 / 12, abs=0.03)


@pytest.mark.parametrize(("period", "crowded"), [(200, False), (20, True)])
def test_many_slips_of_many_sheets_are_no_solid_block(period, crowded):
    """A failure means that the displacements of a long test fill their panel, or that lines of a short one
    are faint without need."""
    ax = tracks_figure(make_tracks(sawtooth(1000, 50, period=period))).plot()
    faint = np.asarray(ax.collections[0].get_alpha()) < 1
    assert len(ax.collections[0].get_paths()) == 50
    assert np.count_nonzero(~faint) == (8 if crowded else 50)
    named = [text.get_text() for text in ax.get_legend().get_texts()]
    assert all(text.endswith("; faint except 4, 11, 18, 25") == crowded for text in named)


@pytest.mark.thorough
@pytest.mark.parametrize("width", [2, 3.5, 6, 12])
def test_every_legend_fits_above_its_axes(pulled, width):
    """A failure means legends cut off at the edge of the file, or over the data."""
    for figure in figures_of(pulled):
        page = replace(figure, width_in=width).plot().figure
        FigureCanvasAgg(page).draw()
        legend = page.axes[0].get_legend()
        if legend is not None and width >= 3.5:
            box = legend.get_window_extent()
            assert box.y1 <= page.bbox.y1 + 1, figure.name
            assert box.x0 >= 0, figure.name


@pytest.mark.parametrize("letters", [8, 10])
def test_a_legend_of_many_rows_follows_its_title(letters):
    """A failure means a hole between title and legend, or a legend over the title."""
    x = np.arange(3.0)
    lines = tuple(Series(label=f"d_v = 16.6{k} mm, a long label", x=x, y=x, ink=DATA) for k in range(8))
    panel = Panel(x_label="d (mm)", y_label="F (N)", series=lines, title="The title of one of two panels")
    page = Figure(name="f", title="", caption="", panels=(panel, panel), width_in=3.4)
    with mpl.rc_context({"font.size": letters}):
        drawn = new_figure(page)
        FigureCanvasAgg(drawn).draw()
        for ax, title in zip(drawn.axes, drawn.texts, strict=True):
            gap = title.get_window_extent().y0 - ax.get_legend().get_window_extent().y1
            assert -0.01 < gap / drawn.dpi < 0.15


@pytest.mark.parametrize(("room", "step"), [(0.5, 1), (1.5, 2), (4.1, 5), (12, 20), (1e9, 500000)])
def test_numbers_are_thinned_to_round_steps(room, step):
    """A failure means that every seventh sheet is numbered."""
    assert label_step(np.arange(50.0), room) == step
    assert label_step(np.array([3.0]), 0.5) == 1


def test_given_axes_keep_their_own_style():
    """A failure means that one figure changes the look of all others in a notebook."""
    before = dict(mpl.rcParams)
    noise_figure(make_tracks(sawtooth(30, 4))).plot(Page().subplots())
    noise_figure(make_tracks(sawtooth(30, 4))).plot()
    assert dict(mpl.rcParams) == before


def test_long_numbers_of_an_axis_do_not_touch():
    """A failure means that a referee cannot read the separations of the first rise of the force."""
    x = np.linspace(16.6, 16.622, 50)
    panel = Panel(x_label="d (mm)", y_label="F (N)", series=(Series(label="F", x=x, y=x, ink=DATA),))
    for columns in (1, 2, 3):
        page = new_figure(Figure(name="f", title="", caption="", panels=(panel,) * columns, columns=columns))
        FigureCanvasAgg(page).draw()
        for ax in page.axes:
            low, high = ax.get_xlim()
            ticks = zip(ax.get_xticks(), ax.get_xticklabels(), strict=True)
            boxes = [label.get_window_extent() for at, label in ticks if low <= at <= high]
            assert len(boxes) >= 2
            assert all(one.x1 + 4 < other.x0 for one, other in itertools.pairwise(boxes))
            widest = min(label.get_window_extent().x0 for label in ax.get_yticklabels())
            assert ax.yaxis.label.get_window_extent().x1 < widest


def test_a_panel_without_data_says_so_in_a_file():
    """A failure means that a recording without events has no picture."""
    panel = Panel(x_label="d (mm)", y_label="K (N/mm)", placeholder="d is not known")
    page = new_figure(Figure(name="f", title="", caption="", panels=(panel,)))
    assert [text.get_text() for text in page.axes[0].texts] == ["d is not known"]


@pytest.mark.parametrize("name", ["sticks", "deformation", "shells"])
def test_the_legend_is_whole_on_axes_of_pyplot(name):
    """A failure means that a legend above the axes is cut off at the edge of the figure."""
    page = Page(figsize=(6, 4))
    ax = page.subplots()
    figure_named(with_force(), name).plot(ax)
    page.canvas.draw()
    legend = ax.get_legend().get_window_extent()
    assert page.bbox.x0 <= legend.x0 <= legend.x1 <= page.bbox.x1
    assert page.bbox.y0 <= legend.y0 <= legend.y1 <= page.bbox.y1


def test_two_tests_on_one_axes_are_told_apart():
    """A failure means that curves of two tests look alike, or that the legend names the last one only."""
    ax, figure = Page(figsize=(8, 6)).subplots(), figure_named(with_force(), "shells")
    plain = figure.plot(Page().subplots()).get_legend().get_texts()
    figure.plot(ax, label="dry", color="C2")
    figure.plot(ax, label="humid", color="C3")
    labels = [text.get_text() for text in ax.get_legend().get_texts()]
    assert labels == [f"{test}: {text.get_text()}" for test in ("dry", "humid") for text in plain]
    colours = [line.get_color() for line in ax.get_lines()]
    assert colours == ["C2"] * (len(colours) // 2) + ["C3"] * (len(colours) // 2)


def test_sheets_that_coincide_hide_neither_side():
    """A failure means that one side covers the other where they move alike."""
    at = np.arange(100.0)
    inks = {-1: ("#0000ff", "#0000ff"), 1: ("#ff0000", "#ff0000")}
    series = tuple(
        Series(label=f"{side} {n}", x=at, y=at, ink=inks[side], dashed=side < 0, sheet=(side, n))
        for side, most in ((-1, 3), (1, 4))
        for n in range(1, most + 1)
    )
    figure = Panel(x_label="t", y_label="x", series=series).figure("both", "")
    pixels = render(figure)[..., :3].astype(int)
    red, blue = pixels[..., 0] - pixels[..., 2] > 100, pixels[..., 2] - pixels[..., 0] > 100
    assert 0.3 < red.sum() / blue.sum() < 3


def test_fast_oscillations_do_not_fill_a_space_time_diagram():
    """A failure means an image that the zigzag of a track hides."""
    at = np.linspace(0, 10, 1001)
    y = np.where(at < 5, 50.0, 50 + 30 * (-1.0) ** np.arange(1001))
    track = Series(label="right 1", x=at, y=y, ink=("#ff0000", "#ff0000"), sheet=(1, 1))
    image = Image(pixels=np.full((100, 100), 128, np.uint8), left=0, right=100, top=0, bottom=10)
    ranges = {"x_range": (0.0, 10.0), "y_range": (0.0, 100.0)}
    panel = Panel(x_label="t", y_label="x", series=(track,), image=image, time_down=True, **ranges)
    ax = panel.figure("diagram", "").plot()
    ax.figure.draw_without_rendering()
    for collection in ax.collections:
        (path,) = collection.get_paths()
        steps = np.abs(np.diff(path.vertices, axis=0))
        assert np.nanmax(steps[:, 0]) < 1
    known = np.isfinite(ax.collections[0].get_paths()[0].vertices[:, 0])
    assert known.sum() == at.size  # every position is still there
    assert len(ax.lines[-1].get_xdata()) == (at >= 5).sum()  # as dots


def test_a_unit_stays_with_its_number():
    """A failure means a title whose second line is "s)"."""
    title = "Displacement of every sheet from x₀, its median over frames 104 to 123 (t = 3.59 to 4.24 s)"
    for width in np.arange(3, 7.5, 0.25):
        panel = Panel(title=title, x_label="t (s)", y_label="x")
        page = new_figure(panel.figure("one", "", width_in=width, panel_titles=True))
        lines = page.texts[0].get_text().split("\n")
        assert " ".join(lines) == title
        assert not any(line.startswith("s)") for line in lines)
        assert min(map(len, lines)) > 0.4 * max(map(len, lines))


def test_points_of_many_events_do_not_hide_those_of_other_tests():
    """A failure means that of tests that collapse only the last is seen."""
    x = np.linspace(13, 18, 600)
    inks = [("#ff0000", "#ff0000"), ("#00ff00", "#00ff00"), ("#0000ff", "#0000ff")]
    series = tuple(Series.points(f"test {k}", x, 20 - x, ink) for k, ink in enumerate(inks))
    pixels = render(Panel(x_label="d", y_label="K", series=series).figure("f", "")).astype(int)
    seen = [int(((pixels[..., k] > 200) & (pixels[..., :3].sum(axis=2) < 300)).sum()) for k in range(3)]
    assert min(seen) > 0.5 * max(seen), seen
    assert len(series) == 3
    assert Panel(x_label="d", y_label="K", series=series).table().notna().all(axis=None)


def test_numbers_of_an_axis_are_whole_and_do_not_touch_its_label():
    """A failure means that an axis shows 0.0025 and +1.909e1 above, or numbers over the label."""
    panel = Panel(
        x_label="n", y_label="Λ̂ (mm)", series=(Series.points("", [0, 1], [19.0925, 19.0955], DATA, [0, 0]),)
    )
    with picture_style():
        page = new_figure(panel.figure("f", ""))
        FigureCanvasAgg(page).draw()
    axis = page.axes[0].yaxis
    assert axis.get_offset_text().get_text() == ""
    left = min(number.get_window_extent().x0 for number in axis.get_ticklabels() if number.get_text())
    assert left > axis.label.get_window_extent().x1


def test_a_label_is_not_cut_off_beside_a_low_panel():
    """A failure means labels that end at the edge of a narrow figure."""
    rising = Series(label="", x=np.arange(2.0), y=np.arange(2.0), ink=DATA)
    panel = Panel(x_label="t (s)", y_label="density over even spread", aspect=0.2, series=(rising,))
    page = new_figure(panel.figure("f", "").of_width(60))
    label, whole = page.axes[0].yaxis.label.get_window_extent(), page.bbox
    assert whole.y0 <= label.y0
    assert label.y1 <= whole.y1


def test_a_png_states_its_size_on_paper(tmp_path):
    """A failure means that a text processor shows a figure of 6 inches as one of 19."""
    panel = Panel(x_label="x", y_label="y", series=(Series.points("", [0, 1], [0, 1], DATA),))
    panel.figure("f", "").save(tmp_path / "f.png", dpi=300)
    content = (tmp_path / "f.png").read_bytes()
    at = content.index(b"pHYs") + 4
    assert int.from_bytes(content[at : at + 4]) == pytest.approx(300 / 0.0254, abs=1)
    width = int.from_bytes(content[16:20])
    assert width / 300 == pytest.approx(6.0, abs=0.02)
    assert mpl.image.imread(tmp_path / "f.png").shape[1] == width


def _numbers_of(ax):
    """The boxes of the numbers that are drawn at a y axis."""
    low, high = sorted(ax.get_ylim())
    numbers = zip(ax.get_yticks(), ax.get_yticklabels(), strict=True)
    return [text.get_window_extent() for at, text in numbers if low <= at <= high]


@pytest.mark.parametrize("scale", [1.0, 8.0, 200.0, 3000.0, -3000.0, -0.07])
def test_a_label_stands_beside_the_numbers_of_its_axis(scale):
    """A failure means that it stands far from a narrow figure's axis, or over the numbers."""
    x = np.linspace(0, 1, 9)
    panel = Panel(x_label="d (mm)", y_label="F (N)", series=(Series(label="F", x=x, y=scale * x, ink=DATA),))
    with picture_style(8):
        page = _page(panel.figure("one", "").of_width(86, 8))
        FigureCanvasAgg(page).draw()
        (ax,) = page.axes
        numbers = min(box.x0 for box in _numbers_of(ax))
        gap_in = (numbers - ax.yaxis.label.get_window_extent().x1) / page.dpi
    assert 0 < gap_in < 0.1


def test_the_label_of_the_right_axis_stands_beside_its_numbers():
    """A failure means that it stands a third of an inch from an axis with short numbers."""
    x = np.linspace(0, 1, 9)
    left = Series(label="force", x=x, y=30 * x, ink=DATA)
    right = Series(label="sheets", x=x, y=8 * x - 2, ink=DATA, axis="right")
    panel = Panel(x_label="t (s)", y_label="F (N)", y2_label="motion (µm)", series=(left, right))
    with picture_style():
        page = _page(panel.figure("one", ""))
        FigureCanvasAgg(page).draw()
        ax = page.axes[-1]
        numbers = max(box.x1 for box in _numbers_of(ax))
        gap_in = (ax.yaxis.label.get_window_extent().x0 - numbers) / page.dpi
    assert 0 < gap_in < 0.15
