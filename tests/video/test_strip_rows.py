"""Which rows are averaged, and how much positions depend on it: combs with known bow, shade and edges."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from tests.video.test_strip_find import Scene
from vision.experiment import Experiment, simulate
from vision.experiment.settings import Camera, Sheets
from vision.sheets import track_sheets
from vision.video import find_strip, measure_strip, open_video, strip_profile
from vision.video.settings import VideoSettings
from vision.video.strip_find import row_shifts, strip_errors

HEIGHT, WIDTH, FRAMES = 100, 800, 6
KEPT = replace(VideoSettings(), least_bias_px=99.0)  # rows are left out for nothing


def comb(shift=0.0, light=1.0, noise=2.0, seed=0):
    """Ridges 20 px apart, 7 px wide; `shift` px and `light` may depend on row (column vector) and x."""
    rng = np.random.default_rng(seed)
    x = np.broadcast_to(np.arange(WIDTH)[None], (HEIGHT, WIDTH))
    frames = []
    for t in range(FRAMES):
        phase = (x - shift - 0.3 * t + 10) % 20 - 10
        grey = light * (60 + 100 * np.exp(-(phase**2) / 2 / (7 / 2.355) ** 2))
        frames.append(np.clip(grey + rng.normal(0, noise, grey.shape), 0, 255).astype(np.uint8))
    return Scene(np.array(frames))


ROW = np.arange(HEIGHT)[:, None]
ZETA = (ROW - 49.5) / 50  # -1 at the top, 1 at the bottom
OUT = np.arange(WIDTH)[None] / (WIDTH / 2) - 1  # -1 at the left, 1 at the right


@pytest.mark.parametrize("noise", [1.0, 8.0])
def test_straight_ridges_have_no_error_of_the_strip(noise):
    """Failure: noise is stated as bias, or costs rows."""
    strip = find_strip(comb(noise=noise))
    assert strip.rows == slice(0, HEIGHT)
    assert strip.errors.error_px < 0.005 * noise
    assert strip.errors.halves_px < 0.01 * noise


def test_lean_is_no_error_of_the_strip():
    """Failure: what the tilt says is said again as a difference between the halves."""
    strip = find_strip(comb(shift=1.0 * ZETA))
    assert strip.rows == slice(0, HEIGHT)
    assert abs(strip.tilt_deg - np.degrees(np.arctan(1 / 50))) < 0.05
    assert strip.errors.halves_px < 0.03  # of 1 px between the halves' means
    assert strip.warnings == ()


def test_bowed_ridges_lose_the_rows_at_the_frame_s_edges():
    """Failure: rows in which the outer ridges are bowed most are averaged, or the bow is stated wrongly.

    Ridges x + c(x) zeta² have c/2 between the outer and the inner half, 0.12 c between all rows and the
    inner four fifths.
    """
    bow = 0.6 * OUT
    scene = comb(shift=bow * ZETA**2)
    strip = find_strip(scene)
    assert strip.rows == slice(8, 92)
    whole = measure_strip(scene, slice(0, HEIGHT)).errors
    rms = 0.6 / np.sqrt(3)
    assert whole.bow_px == pytest.approx(rms / 2, rel=0.2)
    assert whole.error_px == pytest.approx(0.12 * rms, rel=0.25)
    assert strip.errors.error_px < 0.8 * whole.error_px
    assert find_strip(scene, settings=KEPT).rows == slice(0, HEIGHT)  # the wrong setting keeps them
    assert not strip.warnings
    strong = measure_strip(comb(shift=4 * bow * ZETA**2), slice(0, HEIGHT))
    assert "depend on the rows averaged" in strong.warnings[0]


def test_shaded_rows_are_left_out():
    """Failure: rows in which a shadow displaces the ridges bias every position."""
    displaced = np.where(ROW >= 82, 1.5, 0.0)
    scene = comb(shift=displaced)
    strip = find_strip(scene)
    biased = find_strip(scene, settings=KEPT)

    def bias(rows):
        return float(displaced[rows].mean())

    assert bias(biased.rows) > 0.2
    assert bias(strip.rows) < 0.05
    assert strip.rows.stop - strip.rows.start > 70


def test_dark_rows_at_the_edges_are_left_out():
    """Failure: rows without light are averaged in and dilute the ridges."""
    dark = np.where((ROW < 12) | (ROW >= 85), 0.03, 1.0)
    strip = find_strip(comb(light=dark))
    assert 10 <= strip.rows.start <= 14
    assert 83 <= strip.rows.stop <= 87


def test_vignetting_moves_no_ridge():
    """Failure: uneven light is taken for a bow and costs rows."""
    strip = find_strip(comb(light=1 - 0.4 * (OUT**2 + ZETA**2) / 2))
    assert strip.rows.stop - strip.rows.start > 85
    assert strip.errors.error_px < 0.02
    assert strip.warnings == ()


def test_shifts_of_single_bands_are_measured():
    """Failure: the displacement of a band has the wrong sign or size."""
    displaced = np.where((ROW >= 40) & (ROW < 44), 0.8, 0.0)
    frames = comb(shift=displaced, noise=0.5).pixels.astype(float)
    slopes = np.gradient(frames.reshape(FRAMES, 25, 4, WIDTH).mean(axis=2), axis=-1)
    shifts = row_shifts(slopes, 0.0, VideoSettings())
    odd = shifts.shift_px[10].mean()
    assert odd - np.median(shifts.shift_px) == pytest.approx(0.8, abs=0.08)
    assert strip_errors(None, VideoSettings()).error_px == 0
    assert row_shifts(slopes[:, :5], 0.0, VideoSettings()) is None


@pytest.fixture(scope="module")
def bowed_film(tmp_path_factory):
    """A synthetic test in a frame of 100 rows; truth holds for the middle 84."""
    experiment = Experiment(
        camera=Camera(width=700, height=100, duration_s=0.4), sheets=Sheets(count=30), seed=3
    )
    folder = tmp_path_factory.mktemp("film") / "test"
    simulate(experiment, folder)
    truth = xr.open_dataset(folder / "truth.nc", engine="h5netcdf")["x_px"].values
    return open_video(next(folder.glob("video.*"))), truth


def bias_px(film, rows=None, settings=VideoSettings()):
    """Mean error of every sheet of a synthetic film."""
    video, truth = film
    tracks = track_sheets(strip_profile(video, rows, settings=settings))
    return np.nanmean(tracks["x_px"].values - truth, axis=0)


def test_the_strip_of_a_synthetic_film_is_within_its_truth(bowed_film):
    """Failure: the program's own choice of rows biases the outer sheets by more than their error."""
    found = np.abs(bias_px(bowed_film)).max()
    wrong = np.abs(bias_px(bowed_film, settings=KEPT)).max()
    assert wrong > 0.08
    assert found < 0.05
