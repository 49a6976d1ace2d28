"""The origin of displacements: gaps shift no curve, and motion of the camera drops out."""

import numpy as np
import pytest

from tests.scenes.report_data import make_tracks, sawtooth
from vision.figures.positions import (
    origin_px,
    outer_inner_figure,
    outer_less_inner_px,
    outward_px,
    tracks_figure,
)

SHEETS, JUMP_PX = 12, 4.0


def scene(frames=600, *, drift_px=0.0):
    """Sheets that open and close, with a camera that drifts by this much over the film."""
    x = sawtooth(frames, SHEETS, jump_px=JUMP_PX, noise_px=0.001)
    return x + np.linspace(0, drift_px, frames)[:, None]


def test_gaps_shift_no_curve():
    """A failure means that a sheet that is lost for a while is drawn beside where it would be."""
    whole = scene(drift_px=10.0)
    gaps = whole.copy()
    gaps[100:400, 7] = np.nan  # half of the film: mean and median of what is left move by px
    by_label = {s.label: s.y for s in tracks_figure(make_tracks(gaps)).panel.series}
    known = np.isfinite(gaps[:, 7])
    expected = whole[:, 7] - np.median(whole[:20, 7])
    np.testing.assert_allclose(by_label["right 2"][known], expected[known], atol=0.01)
    median = gaps[known, 7] - np.nanmedian(gaps[:, 7])
    assert np.abs(median - (whole[known, 7] - np.median(whole[:, 7]))).max() > 1  # the wrong origin


def test_a_sheet_found_late_starts_where_its_neighbours_are():
    """A failure means that a sheet which comes into view later is drawn from zero."""
    x = scene(drift_px=8.0)
    late = x.copy()
    late[:333, 8] = np.nan
    np.testing.assert_allclose(origin_px(make_tracks(late)), origin_px(make_tracks(x)), atol=0.03)


def test_without_any_position_there_is_no_origin():
    """A failure means an exception where a film shows nothing."""
    nothing = make_tracks(np.full((30, SHEETS), np.nan))
    assert np.isnan(origin_px(nothing)).all()
    assert np.isnan(outward_px(nothing)).all()


def test_outer_less_inner_is_free_of_the_camera():
    """A failure means that a drift of the camera is taken for deformation, or deformation is lost."""
    still, moving = (outer_less_inner_px(make_tracks(scene(drift_px=drift))) for drift in (0.0, 30.0))
    for side in (-1, 1):
        np.testing.assert_allclose(moving[side], still[side], atol=0.02)
    share = np.arange(1, SHEETS, 2) / (SHEETS - 1)  # of the jump, from the centre outwards
    jump = JUMP_PX * (share[-2:].mean() - share[:2].mean())
    assert still[1][51] - still[1][48] == pytest.approx(jump, rel=0.06)


def test_a_sheet_that_comes_and_goes_does_not_move_the_mean():
    """A failure means steps in outer − inner where a sheet is lost, which look like slips."""
    x = scene()
    x[200:300, -1] = np.nan
    shown = outer_less_inner_px(make_tracks(x))[1]
    moved = scene() - np.median(scene()[:20], axis=0)
    steady = moved[:, -2] - moved[:, 6:8].mean(axis=1)  # without the sheet that comes and goes
    np.testing.assert_allclose(shown, steady, atol=0.01)


def test_few_sheets_have_no_thirds():
    """A failure means a figure of nothing."""
    assert outer_inner_figure(make_tracks(sawtooth(100, 4))) is None
