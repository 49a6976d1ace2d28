"""The publication's figures of one run, against numbers that are known."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from tests.figures.test_catalogue import scene
from tests.scenes.analysed import EXPERIMENT, Found
from vision.figures import manuscript_figures
from vision.figures.paper import deformation_mean_figure


@pytest.fixture(scope="module")
def made(pulled):
    return {figure.name: figure for figure in manuscript_figures(pulled)}


def test_a_run_with_everything_has_them_all(made, tmp_path):
    """A failure means that a figure of the publication cannot be drawn from a run."""
    assert set(made) == {"force_insets", "single_sheets", "profile", "deformation_mean"}
    for figure in made.values():
        assert figure.save(tmp_path / f"{figure.name}.png").stat().st_size > 5000
    assert manuscript_figures(Found()) == []


def test_insets_show_the_loading_and_four_events(made):
    """A failure means that an inset shows another part of the test than its title says."""
    whole, loading, early, late = made["force_insets"].panels
    assert loading.series[0].x[0] == pytest.approx(EXPERIMENT.mechanics.d0_mm, abs=0.01)
    top = float(np.nanmax(early.series[0].y))
    assert np.nanmax(late.series[0].y) < 0.5 * top < np.nanmax(whole.series[0].y)
    for panel in (early, late):
        y = panel.series[0].y
        drops = np.diff(y) < -0.3 * np.ptp(y)
        assert 4 <= drops.sum() <= 10  # a slip may fall on two samples


def test_the_ridge_moves_inwards_in_the_stick_and_back_in_the_slip(made):
    """A failure means that the three frames are not those of one stick and its slip."""
    panel = made["profile"].panels[1]
    start, end, after = (series.x[0] for series in panel.series if series.look == "points")
    side = -1 if panel.title.startswith("left") else 1
    assert side * (end - start) < -1
    assert side * (after - end) > 1


def test_outer_and_inner_sheets_are_shown(made):
    """A failure means that the diagrams are of other sheets, or longer than a few events."""
    titles = [panel.title for panel in made["single_sheets"].panels]
    assert [title.partition("\n")[0] for title in titles] == ["right, n = 23", "right, n = 10"]
    image = made["single_sheets"].panel.image
    assert image.right - image.left == pytest.approx(200, abs=10)  # µm


def test_the_mean_over_sticks_and_its_spread():
    """The mean is that of known ratios, the bars their standard deviation; 24 sticks make two groups."""
    rng = np.random.default_rng(0)
    n, sticks = np.tile(np.arange(1, 26), 2), 24
    truth = 0.5 * (n / 25) ** 2
    ratio = truth + 0.05 * rng.standard_normal((sticks, n.size))
    motion = xr.Dataset(
        {"ratio": (("event", "sheet"), ratio)},
        coords={
            "d_v_mm": ("event", np.linspace(13.2, 17.1, sticks)),
            "n": ("sheet", n),
            "side": ("sheet", np.repeat([-1, 1], 25)),
        },
    )
    panel = deformation_mean_figure(motion).panel
    assert len(panel.series) == 2
    for series in panel.series:
        np.testing.assert_allclose(series.y, truth[:25], atol=5 * 0.05 / np.sqrt(24))
        spread = (series.high - series.low) / 2
        assert spread.mean() == pytest.approx(0.05, rel=0.1)
    assert deformation_mean_figure(motion.isel(event=[0])) is None


@pytest.mark.parametrize(
    "options",
    [{"sheets": 1}, {"frames": 1}, {"frames": 2, "columns": 12, "sheets": 2}, {"nothing_found": True},
     {"times_s": np.full(40, np.nan)}, {}],
)  # fmt: skip
def test_any_recording_is_survived(options, tmp_path):
    """A failure means that a run is lost because one of its figures cannot be drawn."""
    for pixel_size_um in (10.0, None):
        results = replace(scene(**options), pixel_size_um=pixel_size_um)
        for figure in manuscript_figures(results):
            figure.save(tmp_path / f"{figure.name}.png")
