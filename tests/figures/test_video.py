"""Figures of the video: their numbers against what they are made from."""

import numpy as np
import pytest

from tests.scenes.report_data import make_profile, make_tracks, sawtooth
from vision.figures import (
    frame_figure,
    noise_figure,
    overview,
    pixel_locking_figure,
    space_time_figure,
    tracks_figure,
)
from vision.figures.positions import MOST_POINTS

JUMP_PX = 4.0


@pytest.fixture(scope="module")
def tracks():
    return make_tracks(sawtooth(1000, 10, jump_px=JUMP_PX))


def by_label(figure):
    return {series.label: series for series in figure.panel.series}


def test_displacements_are_in_the_unit_of_the_label(tracks):
    """A failure means that lengths in the report are off by the pixel size."""
    px, um = (tracks_figure(tracks, pixel_size_um=size) for size in (None, 10.0))
    outer_px, outer_um = by_label(px)["right 5"].y, by_label(um)["right 5"].y
    assert "(px)" in px.panel.y_label
    assert "(µm)" in um.panel.y_label
    assert np.ptp(outer_px) == pytest.approx(JUMP_PX, abs=0.1)
    np.testing.assert_allclose(outer_um, 10 * outer_px)


def test_the_space_time_tracks_are_where_the_ridges_are(tracks):
    """A failure means that tracks are drawn beside their ridges."""
    figure = space_time_figure(make_profile(tracks, 220), tracks, pixel_size_um=10.0)
    np.testing.assert_allclose(by_label(figure)["left 1"].y, tracks["x_px"].values[:, 4] * 0.01)
    assert (figure.panel.image.left, figure.panel.image.right) == pytest.approx((-0.005, 2.195))
    assert figure.panel.image.top == pytest.approx(-0.5 / 60)


def test_long_tests_keep_every_slip_on_the_page():
    """A failure means that slips vanish from x(n,t) of a long test."""
    figure = tracks_figure(make_tracks(sawtooth(100_000, 6, period=4000)))
    outer = by_label(figure)["right 3"].y
    assert len(outer) <= MOST_POINTS
    assert (np.diff(outer) > JUMP_PX / 2).sum() == 24
    assert f"{len(outer) // 2} intervals of the 100000 frames" in figure.caption
    assert "tracks.csv holds every frame" in figure.caption


def test_the_frame_numbers_its_sheets(tracks):
    """A failure means that sheets have another number in the image than in the tables."""
    figure = frame_figure(np.arange(220 * 200).reshape(200, 220) % 255, tracks)
    left, right = figure.panel.series
    assert left.text == ("5", "4", "3", "2", "1")
    assert right.text == ("1", "2", "3", "4", "5")
    np.testing.assert_allclose(right.x, tracks["x_px"].values[0, 5:])
    assert (figure.panel.bands[0].low, figure.panel.bands[0].high) == (59.5, 143.5)


def test_locked_positions_show_in_the_locking_check():
    """A failure means that the report cannot tell a fit that locks to whole pixels."""
    rng = np.random.default_rng(0)
    true = rng.uniform(0, 20, 12) + np.linspace(0, 2.3, 2000)[:, None] + np.arange(12) * 20
    even = pixel_locking_figure(make_tracks(true))
    locked = pixel_locking_figure(make_tracks(true - 0.05 * np.sin(2 * np.pi * true)))

    def errors_off(figure):
        band = figure.panel.bands[0]
        return (by_label(figure)["positions"].y - 1) / ((band.high - 1) / 2)

    assert np.abs(errors_off(even)).max() < 3
    assert errors_off(locked)[[0, -1]].min() > 4
    assert errors_off(locked)[9:11].max() < -3


def test_still_sheets_are_no_sign_of_locking():
    """A failure means that sheets that happen to stand at the same phase are called locked."""
    rng = np.random.default_rng(3)
    x = np.sort(rng.uniform(0, 400, 10)) + rng.normal(0, 0.01, (5000, 10))
    figure = pixel_locking_figure(make_tracks(x))
    density, band = by_label(figure)["positions"].y, figure.panel.bands[0]
    assert density.min() == 0
    assert band.low == 0
    assert (density < 1 + 1.5 * (band.high - 1)).all()


def test_the_noise_of_each_sheet_is_that_of_the_tables(tracks):
    """A failure means that noise is shown for the wrong sheet or in the wrong unit."""
    tracks = tracks.assign(x_noise_px=("sheet", np.arange(10) / 100))
    figure = noise_figure(tracks, pixel_size_um=10.0)
    measured = by_label(figure)["from frame to frame"]
    assert measured.x.tolist() == [-5, -4, -3, -2, -1, 1, 2, 3, 4, 5]
    np.testing.assert_allclose(measured.y, np.arange(10) / 10)


def test_a_recording_without_clock_counts_frames(tracks):
    """A failure means that a report claims seconds that nobody measured."""
    unknown = tracks.assign_coords(time_s=("frame", np.full(1000, np.nan)))
    figure = tracks_figure(unknown)
    assert figure.panel.x_label == "frame"
    assert figure.panel.series[0].x[-1] == 999
    playback = tracks.assign_attrs(clock_kind="playback")
    assert "playback" in tracks_figure(playback).panel.x_label


@pytest.mark.parametrize(("rows", "square"), [(4, False), (200, True), (900, True)])
def test_a_frame_keeps_its_shape_unless_nothing_could_be_seen(tracks, rows, square):
    """A failure means a frame that is stretched, or one too flat to see."""
    figure = frame_figure(np.zeros((rows, 220)), tracks.assign_attrs(strip_z0=0, strip_z1=rows))
    assert figure.panel.square_pixels or not square
    ax = figure.plot()
    ax.figure.draw_without_rendering()
    if square:
        a, b = ax.transData.transform([(0, 0), (100, 100)])
        assert abs(b - a) == pytest.approx(abs(b - a)[0], rel=1e-6)


def test_one_definition_of_displacement(tracks):
    """A failure means that overview.png and the report subtract different things."""
    x = tracks["x_px"].values.copy()
    x[0, 3] += 500  # which moves a mean, not a median
    tracks = make_tracks(x)
    strip = make_profile(tracks, 220)
    figures = [space_time_figure(strip, tracks), tracks_figure(tracks)]
    assert overview(figures).panels[-1].series is figures[1].panel.series
    np.testing.assert_allclose(figures[1].panel.series[3].y, x[:, 3] - np.median(x[:20, 3]))
