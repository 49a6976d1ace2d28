"""The publication's test, simulated: all fifty sheets, no identity lost, errors as predicted."""

from dataclasses import replace

import numpy as np
import pytest

from vision.experiment import Experiment, profiles
from vision.sheets import track_sheets


@pytest.fixture(scope="module")
def paper():
    """Eight seconds of the paper's test at 60 frames/s: I(x, t) and its truth."""
    whole = Experiment()
    return profiles(replace(whole, camera=replace(whole.camera, duration_s=8.0)))


@pytest.fixture(scope="module")
def tracks(paper):
    """As found by default."""
    return track_sheets(paper[0])


def errors(tracks, truth):
    return tracks["x_px"].values - truth["x_px"].values


def test_all_sheets_are_found_and_none_is_swapped(paper, tracks):
    """A failure means that the main job fails on the publication's own kind of video."""
    _, truth = paper
    assert tracks.sizes["sheet"] == 50
    assert (tracks["flag"].values == "ok").all()
    assert np.abs(errors(tracks, truth)).max() < 0.2  # the pitch is 20 px
    np.testing.assert_array_equal(tracks["side"], truth["side"])
    np.testing.assert_array_equal(tracks["n"], truth["n"])
    assert tracks.attrs["axis_px"] == pytest.approx(truth.attrs["axis_px"], abs=2)


def test_stated_errors_are_the_true_ones(paper, tracks):
    """A failure means that published error bars would be wrong."""
    _, truth = paper
    off = errors(tracks, truth)
    scatter = np.std(off - np.median(off, axis=0), axis=0)  # fixed pattern apart
    stated = np.median(tracks["x_err_px"].values, axis=0)
    assert np.median(scatter / stated) == pytest.approx(1, abs=0.15)
    assert np.median(tracks["x_noise_px"].values / scatter) == pytest.approx(1, abs=0.2)


def test_too_narrow_a_window_is_noisier(paper, tracks):
    """A failure means that the tests above would pass whatever the window is."""
    strip, truth = paper
    right = np.std(errors(tracks, truth))
    assert np.std(errors(track_sheets(strip, window_px=3), truth)) > 1.5 * right


def test_the_wrong_polarity_finds_other_sheets(paper):
    """A failure means that the tests above would pass whatever the polarity is: fifty ridges have 49 gaps."""
    strip, _ = paper
    assert track_sheets(strip, ridges="dark").sizes["sheet"] != 50


def test_the_paper_s_fit_locks_where_the_sliding_one_does_not(paper, tracks):
    """A failure means that the default is no better than the published fit."""
    strip, truth = paper
    sliding = np.std(errors(tracks, truth))
    published = np.std(errors(track_sheets(strip, fit="paper"), truth))
    assert published > 2 * sliding
