"""The publication's figures from one run: their numbers against what they are made from."""

import numpy as np
import pytest

from tests.scenes.report_data import make_profile, make_tracks, sawtooth
from vision.figures import FIGURES, publication_figures_of
from vision.figures.camera import intensity_figure, single_sheets_figure
from vision.figures.catalogue import slips_of
from vision.figures.positions import mean_deformation_figure


def test_a_whole_run_has_them_all_with_their_numbers(pulled):
    """A failure means that a figure of the publication is not there, or does not say which one it is."""
    figures = publication_figures_of(pulled)
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
    figure = intensity_figure(strip, tracks, tracks["time_s"].values[50:351:50] - 0.5 / 60)
    lines = [s for s in figure.panels[1].series if s.dashed]
    start, end, after = (float(s.x[0]) for s in lines)
    assert start - end == pytest.approx(4.0, abs=0.5)  # the jump, right side: inwards is to the left
    assert abs(after - start) < 0.3
    assert len(intensity_figure(strip, tracks).panels) == 1  # without slips no stick is known


def test_space_time_of_two_sheets_over_four_slips(pulled):
    """A failure means the wrong sheets, or slips marked elsewhere than in the force."""
    slips, source = slips_of(pulled)
    figure = single_sheets_figure(pulled.strip, pulled.tracks, slips, pixel_size_um=10.0)
    assert source == "the force"
    assert [panel.title.split("\n")[0] for panel in figure.panels] == ["right, n = 23", "right, n = 10"]
    inside = slips[(slips > 0) & (slips < float(pulled.tracks["time_s"][-1]))]
    np.testing.assert_allclose(figure.panels[0].marks, inside[:4])
    assert single_sheets_figure(pulled.strip, pulled.tracks, inside[:1]) is None


def test_k_is_marked_where_it_is_taken(pulled):
    """A failure means that the dots or arrows of F − F_v are not K's stretch, ΔF and Λ_st."""
    panel = FIGURES["sticks"].make(pulled).panel
    first = pulled.sticks.iloc[0]
    dots = next(s for s in panel.series if s.label == "K is taken here")
    length = first["stick_length_um"]
    assert dots.x.min() >= 0.24 * length
    assert dots.x.max() <= 0.76 * length
    drop, stick = panel.arrows
    assert drop.y == (0.0, pytest.approx(first["dF_N"]))
    assert stick.x == (0.0, pytest.approx(length))
