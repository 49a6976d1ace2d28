"""Arrays and pictures in the page: small, and as exact as stated."""

import base64
import io

import numpy as np
import pytest
from PIL import Image

from vision.figures import Image as Grey
from vision.report.page import PLAIN, ArrayStore, image_uri


def decode(store, array):
    """What the page's script does."""
    if "v" in array:
        return np.array([np.nan if v is None else v for v in array["v"]])
    code = np.frombuffer(base64.b64decode(store.blobs()[array["b"]]), "<i2").astype(float)
    value = array["start"] + array["slope"] * np.arange(code.size) + array["step"] * code
    return np.where(code == -32768, np.nan, value)


def grey(pixels):
    return Grey(pixels=pixels, left=0, right=1, top=0, bottom=1)


@pytest.mark.parametrize("size", [PLAIN, 5000])
def test_values_come_back_within_the_stated_step(size):
    """A failure means that the page's figures and CSV files are less exact than stated."""
    values = np.random.default_rng(0).normal(0, 12, size)
    values[[3, 77]] = np.nan
    store = ArrayStore()
    back = decode(store, store.add(values))
    np.testing.assert_array_equal(np.isnan(back), np.isnan(values))
    assert np.nanmax(np.abs(back - values)) <= np.nanmax(np.ptp(values[np.isfinite(values)])) / 65534


def test_times_keep_microseconds_over_an_hour():
    """A failure means that slips and frames cannot be compared at the resolution of the clocks."""
    time = 1000 + np.arange(100_000) / 30 + np.random.default_rng(1).uniform(-1e-3, 1e-3, 100_000)
    store = ArrayStore()
    assert np.abs(decode(store, store.add(time)) - time).max() < 1e-6


def test_arrays_that_differ_by_scale_are_kept_once():
    """A failure means that positions and displacements double the size of the page."""
    x = np.random.default_rng(2).normal(size=3000)
    store = ArrayStore()
    first, second = store.add(x), store.add(500 + 0.01 * x)
    assert first["b"] == second["b"]
    assert len(store.blobs()) == 1


def test_constant_and_empty_arrays_survive():
    """A failure means a sheet that was never found, or never moves, breaks the page."""
    store = ArrayStore()
    constant, unknown = np.full(3000, 4.2), np.full(3000, np.nan)
    np.testing.assert_allclose(decode(store, store.add(constant)), constant)
    assert np.isnan(decode(store, store.add(unknown))).all()


def test_pictures_keep_to_their_size_even_if_they_are_noise():
    """A failure means that a noisy recording makes the page larger than 3 MB."""
    noise = np.random.default_rng(3).integers(0, 255, (1200, 1900), dtype=np.uint8)
    uri = image_uri(grey(noise), most_bytes=200_000)
    data = base64.b64decode(uri.removeprefix("data:image/jpeg;base64,"))
    assert len(data) <= 200_000
    assert Image.open(io.BytesIO(data)).width > 100


def test_clean_pictures_keep_their_resolution():
    """A failure means that pictures are made coarse without need."""
    ridges = np.tile((127 + 120 * np.sin(np.arange(1900) / 3)).astype(np.uint8), (600, 1))
    data = base64.b64decode(
        image_uri(grey(ridges), most_bytes=450_000).removeprefix("data:image/jpeg;base64,")
    )
    image = np.asarray(Image.open(io.BytesIO(data)), float)
    assert image.shape == (600, 1900)
    assert np.abs(image - ridges).mean() < 4
