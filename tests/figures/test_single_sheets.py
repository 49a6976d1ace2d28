"""Figures of single sheets: their numbers against the measurements, and back from a file."""

import numpy as np
import pytest

from tests.scenes.single_sheets import CyclesTest, DiscTest, write_cycles, write_rheocompass
from vision.figures import load_figures, save_figures
from vision.figures.single_sheets import friction_figure, modulus_figure
from vision.force.recording import read_force
from vision.models.friction import FrictionSettings, fit_static_friction, friction_of_disc
from vision.models.modulus import PUBLISHED_SHEET, measure_cycles
from vision.models.rheometer import read_rheometer


def test_friction_shows_what_was_measured(tmp_path):
    """A failure means that a coefficient is drawn at another load, or that the figure is lost when kept."""
    write_rheocompass(tmp_path / "r.csv", DiscTest(loads_N=(0.1, 0.5, 2.0)))
    measured = [friction_of_disc(one) for one in read_rheometer(tmp_path / "r.csv")]
    dynamic_deg = FrictionSettings().dynamic_deg
    law = fit_static_friction([m.N_N for m in measured], [m.mu_s for m in measured])
    figure = friction_figure(measured, law, mu=0.89, dynamic_deg=dynamic_deg)
    static = figure.panels[1].series[0]
    np.testing.assert_allclose(static.y, [m.mu_s for m in sorted(measured, key=lambda m: m.N_N)])
    assert figure.panels[2].series[2].x[0] == pytest.approx(law.crossing_N(0.89))
    assert figure.panels[0].bands[0].of_x
    kept = load_figures(save_figures(tmp_path / "f.npz", [figure]))[0]
    assert kept.png() == figure.png()
    without = friction_figure(measured, None, mu=0.89, dynamic_deg=dynamic_deg)
    assert "published" in without.panels[2].series[1].label


@pytest.mark.parametrize("clamp_distance_mm", [None, 18.0])
def test_modulus_shows_its_lines(tmp_path, clamp_distance_mm):
    """A failure means that a fitted part is drawn beside the force it was fitted to, also where the first
    sample, from which the distance of the clamps counts, cannot be used."""
    write_cycles(tmp_path / "sheet.txt", CyclesTest())
    force = read_force(tmp_path / "sheet.txt")
    if clamp_distance_mm:
        force["crosshead_mm"][0] += 3
        force["load_N"][0] = np.nan
    cycles = measure_cycles(force, sheet=PUBLISHED_SHEET, clamp_distance_mm=clamp_distance_mm)
    figure = modulus_figure(force, cycles)
    lines = figure.panels[0].series[1:]
    assert len(lines) == len(cycles)
    residuals = figure.panels[1]
    for curve in residuals.series:
        inside = (curve.x >= residuals.bands[0].low) & (curve.x <= residuals.bands[0].high)
        assert np.abs(curve.y[inside]).mean() < 0.05 * float(np.ptp(force["load_N"].values[1:]))
    np.testing.assert_allclose(figure.panels[2].series[0].y, cycles["Y_p_GPa"])
    assert load_figures(save_figures(tmp_path / "f.npz", [figure]))[0].caption == figure.caption
    figure.save(tmp_path / "m.png")
