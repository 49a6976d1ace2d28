"""The picture: positions, sharpness, noise, against the truth handed out with it."""

from dataclasses import replace

import numpy as np
import pytest

from vision.experiment import Experiment, profiles
from vision.experiment.scene import make_scene
from vision.experiment.settings import Camera, Mechanics, Optics, Sheets
from vision.experiment.simulate import frame_blocks, sensor_levels

PLAIN = Optics(contrast_spread=0, gradient=0, texture=0, flicker=0, tilt_deg=0)
WIDE = Sheets(count=8, pitch_px=70, bow_px=0)
NOISELESS = Camera(width=640, height=9, strip_rows=9, duration_s=1.0, fps=40, noise=False, prnu=0)


def centroids(line, positions_px, half=30):
    """Centroid around each true position, a straight pedestal taken off."""
    at = np.round(positions_px).astype(int)[:, None] + np.arange(-half, half + 1)
    y = line[at]
    share = np.linspace(0, 1, 2 * half + 1)
    y = y - (y[:, :1] * (1 - share) + y[:, -1:] * share)
    return (y * at).sum(axis=1) / y.sum(axis=1)


@pytest.mark.parametrize("shape", ["gaussian", "flat", "shouldered"])
@pytest.mark.parametrize("tilt_deg", [0.0, 0.8])
@pytest.mark.parametrize("polarity", ["bright", "dark"])
def test_noise_free_centroid_is_the_true_position(shape, tilt_deg, polarity):
    """1e-3 px in every frame, slips within the exposure included: the truth is exact."""
    optics = replace(PLAIN, shape=shape, tilt_deg=tilt_deg, polarity=polarity)
    intensity, truth = profiles(Experiment(sheets=WIDE, optics=optics, camera=NOISELESS))
    worst = max(
        np.abs(centroids(line, x) - x).max()
        for line, x in zip(intensity.values.astype(float), truth.x_px.values, strict=True)
    )
    assert worst < 1e-3


def test_sampling_at_points_would_fail_the_centroid_test():
    """The test above sees errors of its own size: the truth moved by 2e-3 px no longer agrees."""
    intensity, truth = profiles(Experiment(sheets=WIDE, optics=PLAIN, camera=NOISELESS))
    x = truth.x_px.values[0] + 2e-3
    assert np.abs(centroids(intensity.values[0].astype(float), x) - x).max() > 1e-3


def test_bow_and_distortion_are_in_the_truth():
    """Outer sheets bowed by 3 px, lens 1 %: centroids still where truth.nc says, within the stretch of a
    ridge."""
    sheets, optics = replace(WIDE, bow_px=3.0), replace(PLAIN, distortion=0.01, tilt_deg=0.5)
    intensity, truth = profiles(Experiment(sheets=sheets, optics=optics, camera=NOISELESS))
    x = truth.x_px.values[0]
    assert np.abs(centroids(intensity.values[0].astype(float), x) - x).max() < 5e-3


def test_images_and_direct_profile_agree_without_noise():
    """A failure means the quick path shows another experiment than the video."""
    camera = replace(NOISELESS, bits=16, full_well_e=1e9, height=40, strip_rows=30)
    e = Experiment(camera=camera, sheets=WIDE, optics=replace(PLAIN, tilt_deg=0.7, gradient=0.3, texture=0.1))
    intensity, _ = profiles(e)
    frames = np.concatenate(list(frame_blocks(make_scene(e))))
    mean = frames[:, 5:35].astype(float).mean(axis=1)
    assert np.abs(mean - intensity.values).max() < 2e-3 * 65535


@pytest.mark.parametrize("bits", [8, 12])
def test_photon_transfer_curve(bits):
    """Variance against mean is the sensor's: (e + read^2) / gain^2 + 1/12, from dim to bright, within 2 %."""
    camera = Camera(bits=bits, read_noise_e=30.0)
    gain = camera.electrons_per_level
    rng = np.random.default_rng(0)
    for light in (0.05, 0.2, 0.5, 0.8):
        flat = sensor_levels(np.full((400, 500), light, np.float32), camera, rng).astype(float)
        electrons = light * camera.full_well_e
        expected = (electrons + 30.0**2) / gain**2 + 1 / 12
        assert flat.mean() == pytest.approx(electrons / gain, rel=2e-3)
        assert flat.var() == pytest.approx(expected, rel=0.02)
        assert flat.var() != pytest.approx(electrons / gain**2, rel=0.02) or light > 0.4


def test_profile_noise_is_that_of_the_mean_of_its_rows():
    """Row-averaged noise against its prediction: tracking errors predicted from it stand or fall with
    this."""
    camera = Camera(width=700, height=40, strip_rows=40, duration_s=4, fps=100, exposure_s=0.001, prnu=0)
    still = Sheets(count=8, outer_ratio=0.0, spread_per_mm=0.0)
    optics = replace(PLAIN, vibration_px=0.0, drift_px=0.0)
    intensity, _ = profiles(Experiment(camera=camera, optics=optics, sheets=still, mechanics=Mechanics()))
    electrons = intensity.values.mean(axis=0) * camera.full_well_e / 255
    gain = camera.full_well_e / 255
    expected = np.sqrt(((electrons + 2.5**2) / gain**2 + 1 / 12) / 40)
    assert intensity.values.std(axis=0).mean() == pytest.approx(expected.mean(), rel=0.02)


def test_saturation_clips():
    """Light beyond the full well is the highest level, not an overflow."""
    camera = Camera()
    levels = sensor_levels(np.full((10, 10), 3.0, np.float32), camera, np.random.default_rng(0))
    assert (levels == 255).all()
    assert levels.dtype == np.uint8
