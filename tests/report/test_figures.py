"""The figures as files, and on a notebook's own axes."""

import os
import time

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont, get_font
from vision.report.results import RunResults
from vision.report.sections import charts_of, sections_of
from vision.report.style import DATA, MODEL, PEAK, VALLEY, picture_style

from tests.scenes.report_data import make_profile, make_tracks, sawtooth
from vision.report import drawing, figures


@pytest.fixture
def ax():
    return Figure().subplots()


@pytest.fixture(scope="module")
def small():
    tracks = make_tracks(sawtooth(300, 10))
    frame = np.arange(200 * 220).reshape(200, 220) % 251
    return RunResults(profile=make_profile(tracks, 220), tracks=tracks, frame=frame)


@pytest.fixture(scope="module")
def written(small, tmp_path_factory):
    return figures.write_figures(tmp_path_factory.mktemp("run") / "figures", small)


def test_every_figure_is_a_pdf_an_svg_and_a_table(small, written):
    """A failure means that a manuscript lacks a figure or the numbers behind it."""
    folder = written[0].parent
    names = {chart.name for section in sections_of(small) for chart in section.charts}
    assert {path.name for path in written} == {
        *(f"{name}.{suffix}" for name in names for suffix in ("pdf", "svg", "csv")),
        "captions.txt",
    }
    assert all(path.read_bytes()[:4] == b"%PDF" for path in written if path.suffix == ".pdf")
    svg = (folder / "noise.svg").read_text(encoding="utf-8")
    assert "noise of x (px)" in svg  # text is text, to be edited
    table = pd.read_csv(folder / "displacement.csv")
    np.testing.assert_allclose(table["t (s)"], small.tracks["time_s"], rtol=1e-6)


def test_the_same_run_gives_the_same_files(small, written, tmp_path):
    """A failure means that figures under version control change without reason."""
    again = figures.write_figures(tmp_path, small)
    pairs = [(a, b) for a, b in zip(written, again, strict=True) if a.suffix in (".csv", ".pdf", ".txt")]
    assert all(a.read_bytes() == b.read_bytes() for a, b in pairs)


def test_figures_have_the_letters_they_need(small, written):
    """A failure means boxes in place of symbols, or text that no viewer can draw or edit."""
    with picture_style():
        path = findfont(FontProperties())
    glyphs = get_font(path).get_charmap()
    needed = "AZaz09 ~ΔΛσδμ²¹⁻ₓᵥₚₛₜ₀−±·×∝√µ°…→"
    assert [letter for letter in needed if ord(letter) not in glyphs] == []
    assert b"DejaVuSans-Figures" in (written[0].parent / "noise.pdf").read_bytes()
    assert "'DejaVu Sans'" in (written[0].parent / "noise.svg").read_text(encoding="utf-8")


def test_what_the_second_process_leaves_is_drawn_by_the_first(small, written, tmp_path, monkeypatch):
    """A failure means that a helper that cannot start, or is killed, costs a run its figures."""
    monkeypatch.setattr(drawing.sys, "executable", "/bin/false")
    again = figures.write_figures(tmp_path, small)
    assert [path.name for path in again] == [path.name for path in written]
    pairs = [(a, b) for a, b in zip(written, again, strict=True) if a.suffix == ".pdf"]
    assert all(a.read_bytes() == b.read_bytes() for a, b in pairs)


@pytest.mark.skipif(os.cpu_count() == 1, reason="one processor draws alone")
def test_the_second_process_draws_while_the_first_is_busy(small, tmp_path):
    """A failure means that the helper draws nothing, or goes on after its run has failed."""
    charts = charts_of(sections_of(small))
    with pytest.raises(RuntimeError), drawing.drawn_meanwhile(tmp_path, charts):
        for _ in range(600):
            if (tmp_path / f"{charts[0].name}.svg").exists():
                raise RuntimeError("done enough")
            time.sleep(0.1)
    left = sorted(path.name for path in tmp_path.iterdir())
    assert f"{charts[0].name}.svg" in left
    assert f"{charts[-1].name}.svg" not in left
    time.sleep(0.5)
    assert sorted(path.name for path in tmp_path.iterdir()) == left


def test_drawing_functions_take_and_return_axes(ax, pulled):
    """A failure means that the figures cannot be placed in a notebook's own figure."""
    r, size = pulled, {"pixel_size_um": pulled.pixel_size_um}
    calls = {
        figures.draw_frame: ((r.frame, r.tracks), {}),
        figures.draw_space_time: ((r.profile, r.tracks), size),
        figures.draw_displacement: ((r.tracks,), size),
        figures.draw_noise: ((r.tracks,), size),
        figures.draw_locking: ((r.tracks,), {}),
        figures.draw_pull: ((r.force, r.sticks, r.fits), {}),
        figures.draw_clocks: ((r.force, r.tracks, r.clock, r.sticks), size),
        figures.draw_sticks: ((r.force, r.sticks), {}),
        figures.draw_drops: ((r.sticks, r.fits), {}),
        figures.draw_stiffness: ((r.sticks, r.fits), {}),
        figures.draw_stick: ((r.tracks, r.motion, r.clock), {}),
        figures.draw_ratio: ((r.motion,), {"threshold": 0.1}),
        figures.draw_shells: ((r.shells, r.fits), {}),
    }
    assert len(calls) == sum(name.startswith("draw_") for name in vars(figures)) - 1  # all but draw_chart
    for draw, (args, options) in calls.items():
        mine = Figure().subplots()
        assert draw(mine, *args, **options) is mine
        assert mine.get_xlabel() and mine.get_ylabel(), draw.__name__
        assert mine.has_data(), draw.__name__


def test_time_runs_down_in_the_space_time_diagram(ax, small):
    """A failure means that slips look inwards instead of outwards."""
    figures.draw_space_time(ax, small.profile, small.tracks)
    top, bottom = ax.get_ylim()[::-1]
    assert top < bottom
    assert ax.get_xlabel() == "x (px)"
    assert ax.get_ylabel() == "t (s)"
    line = next(line for line in ax.lines if line.get_label() == "right 5")
    np.testing.assert_allclose(line.get_xdata(), small.tracks["x_px"][:, 9])


def test_the_two_curves_of_the_clock_check_do_not_cross(ax, pulled):
    """A failure means that one curve hides the other where the clocks are judged."""
    figures.draw_clocks(ax, pulled.force, pulled.tracks, pulled.clock, pulled.sticks)
    right = next(other for other in ax.figure.axes if other is not ax)
    low, high = ax.get_xlim()

    def share(axes):
        line = axes.lines[0]
        x, y = line.get_xdata(), line.get_ydata()
        bottom, top = axes.get_ylim()
        return (y[(x >= low) & (x <= high)] - bottom) / (top - bottom)

    assert share(ax).min() > share(right).max()


def luminance(colour):
    rgb = [int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in rgb]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


@pytest.mark.parametrize("ink", [DATA, PEAK, VALLEY, MODEL])
def test_inks_can_be_read_on_their_ground(ink):
    """A failure means curves that vanish on paper or on a dark screen (contrast below 3)."""
    assert 1.05 / (luminance(ink[0]) + 0.05) > 3
    assert (luminance(ink[1]) + 0.05) / (luminance("#1d2024") + 0.05) > 3
