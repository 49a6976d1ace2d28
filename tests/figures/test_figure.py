"""Figures as data: tables, files, and figures kept in a file."""

import re
from dataclasses import fields, is_dataclass, replace

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure as Page

from tests.scenes.report_data import make_tracks, sawtooth
from vision.errors import InputError
from vision.figures import FIGURES, Figure, Panel, force_overview_figure, load_figures, save_figures
from vision.figures.catalogue import figures_of, overview
from vision.figures.force import clocks_figure
from vision.figures.positions import shells_figure, tracks_figure


def test_tables_hold_the_drawn_numbers(pulled):
    """A failure means that the CSV of a figure is not what the figure shows."""
    tracks = make_tracks(sawtooth(1000, 10))
    wide = tracks_figure(tracks).table()
    assert list(wide.columns[:2]) == ["t (s)", "left 5: x − x₀ (px)"]
    np.testing.assert_allclose(
        wide["right 5: x − x₀ (px)"], tracks["x_px"][:, 9] - tracks["x_px"][:20, 9].median(), atol=1e-12
    )
    long = shells_figure(pulled.shells, pulled.fits).table()
    assert set(long["series"]) == {"left side", "right side", "M_eff (force)"}
    assert long.loc[long["series"] == "right side", "low"].notna().all()
    both = clocks_figure(pulled.force, pulled.tracks, pulled.clock).table()
    assert both.loc[both["series"] == "sheets", "quantity"].str.contains("px").all()


def test_the_table_of_several_panels_names_them(pulled):
    """A failure means that the numbers of force.png cannot be told apart."""
    figure = force_overview_figure(pulled.force, pulled.sticks, pulled.fits)
    table = figure.table()
    assert list(table["panel"].unique()) == [panel.title for panel in figure.panels]
    stiffness = table[(table["y_label"] == "K (N/mm)") & (table["series"] == "K")]
    usable = pulled.sticks[pulled.sticks["flag"] == "ok"]
    np.testing.assert_allclose(np.sort(stiffness["y"]), np.sort(usable["K_N_per_mm"].dropna()))
    assert stiffness["low"].notna().all()


def same(a, b):
    """Whether two figures hold the same, arrays included."""
    if is_dataclass(a):
        return type(a) is type(b) and all(same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
    if isinstance(a, np.ndarray):
        return (
            isinstance(b, np.ndarray)
            and a.dtype == b.dtype
            and np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
        )
    if isinstance(a, tuple):
        return isinstance(b, tuple) and len(a) == len(b) and all(map(same, a, b))
    return type(a) is type(b) and a == b


def test_figures_come_back_from_their_file(pulled, tmp_path):
    """A failure means that `track figures` draws other figures than the run had."""
    figures = [*figures_of(pulled), force_overview_figure(pulled.force, pulled.sticks, pulled.fits)]
    back = load_figures(save_figures(tmp_path / "figures.npz", figures))
    assert [f.name for f in back] == [f.name for f in figures]
    assert all(map(same, figures, back))
    assert not same(figures[2], figures[1])  # the comparison can fail
    assert [f.panel.common_x for f in back] == [f.panel.common_x for f in figures]  # tables keep their form
    assert same(overview(figures), overview(back))


def test_the_same_figures_give_the_same_file(pulled, tmp_path):
    """A failure means that a run under version control changes without reason."""
    one, other = (save_figures(tmp_path / f"{k}.npz", figures_of(pulled)).read_bytes() for k in range(2))
    assert one == other


def test_shared_arrays_are_kept_once(tmp_path):
    """A failure means that the file grows with the number of figures that show the same."""
    figure = tracks_figure(make_tracks(sawtooth(1500, 20)))
    sizes = [save_figures(tmp_path / "f.npz", [figure] * k).stat().st_size for k in (1, 4)]
    assert sizes[1] < 1.2 * sizes[0]


@pytest.mark.parametrize("content", [b"", b"PK no archive", b"text"])
def test_a_file_that_holds_no_figures_is_refused(tmp_path, content):
    """A failure means a traceback, or a pickle that is executed."""
    path = tmp_path / "figures.npz"
    path.write_bytes(content)
    with pytest.raises(InputError, match="figures that a run has saved"):
        load_figures(path)


def test_pickles_are_refused(tmp_path):
    """A failure means that a run folder from elsewhere can run code."""
    path = tmp_path / "figures.npz"
    np.savez(path, figures=np.array([{"class": "Figure"}], dtype=object))
    with pytest.raises(InputError, match="figures that a run has saved"):
        load_figures(path)


def test_the_ending_says_what_is_written(pulled, tmp_path):
    """A failure means a file of another kind than its name says."""
    figure = tracks_figure(pulled.tracks)
    heads = {"png": b"\x89PNG", "pdf": b"%PDF", "svg": b"<?xml"}
    for kind, head in heads.items():
        assert figure.save(tmp_path / f"f.{kind}").read_bytes().startswith(head)
    table = pd.read_csv(figure.save(tmp_path / "f.csv"))
    np.testing.assert_allclose(table["t (s)"], pulled.tracks["time_s"], rtol=1e-6)
    with pytest.raises(InputError, match=r"\.png, \.pdf, \.svg or \.csv"):
        figure.save(tmp_path / "f.gif")


def test_a_figure_fits_the_column_of_a_journal(pulled, tmp_path):
    """A failure means figures that are scaled in the manuscript, with letters that nobody can read."""
    figure = FIGURES["intensity"].make(pulled)
    assert figure is not None
    column = figure.of_width(86, font_size=8)
    column.save(tmp_path / "f.svg", font_size=8)
    text = (tmp_path / "f.svg").read_text(encoding="utf-8")
    assert float(re.search(r'<svg[^>]* width="([\d.]+)pt"', text)[1]) == pytest.approx(
        86 / 25.4 * 72, abs=0.01
    )
    sizes = {float(size) for size in re.findall(r"font(?:-size)?: ([\d.]+)px", text)}
    assert max(sizes) == pytest.approx(8.8)  # titles of panels
    assert min(sizes) == pytest.approx(6.4)  # legends
    with pytest.raises(InputError, match="a width from 40 to 1000 mm"):
        figure.of_width(30, font_size=8)


def test_panels_side_by_side_are_stacked_in_a_column_with_their_labels():
    """A failure means panels too narrow to read, or an axis without its label."""
    left = Panel(x_label="x (px)", y_label="t (s)", title="left")
    pair = Figure(name="f", title="", caption="", panels=(left, replace(left, y_label="")), columns=2)
    column = pair.of_width(86)
    assert column.columns == 1
    assert [panel.y_label for panel in column.panels] == ["t (s)", "t (s)"]
    assert [panel.y_label for panel in pair.of_width(178).panels] == ["t (s)", ""]


def test_figures_are_drawn_on_given_axes_or_their_own(pulled):
    """A failure means that the figures cannot be placed in a notebook's own figure."""
    for figure in figures_of(pulled):
        ax = Page().subplots()
        assert figure.plot(ax) is ax
        assert ax.get_xlabel() and ax.get_ylabel() and ax.has_data(), figure.name
        assert figure.plot().figure.get_size_inches()[0] == figure.width_in
    several = force_overview_figure(pulled.force, pulled.sticks)
    assert len(several.plot().figure.axes) == 4
    with pytest.raises(InputError, match="4 panels"):
        several.plot(Page().subplots())


def test_a_notebook_shows_a_figure(pulled):
    """A failure means that a figure at the end of a cell is a page of numbers."""
    assert tracks_figure(pulled.tracks)._repr_png_().startswith(b"\x89PNG")
