"""Frames written to every container are read back as they were drawn."""

import struct

import numpy as np
import pytest

from tests.scenes.experiments import SMALL
from vision.experiment import (
    frame_blocks,
    make_scene,
    simulate,
    with_settings,
)
from vision.experiment.video_files import RawAviWriter
from vision.video import open_video


def drawn(experiment):
    return np.concatenate(list(frame_blocks(make_scene(experiment))))


def read(path):
    return np.concatenate([block.pixels for block in open_video(path).blocks()])


@pytest.mark.parametrize(
    ("container", "bits"),
    [
        ("raw", 8),
        ("ffv1", 8),
        ("ffv1", 10),
        ("ffv1", 12),
        ("ffv1", 16),
        ("tiff", 8),
        ("tiff", 12),
        ("png", 8),
        ("png", 16),
    ],
)
def test_lossless_containers_hold_the_frames_exactly(tmp_path, container, bits):
    """A failure means the reader or the writer changes values."""
    e = with_settings(SMALL, {"camera.bits": bits})
    test = simulate(e, tmp_path / "t", container=container)
    pixels = read(test.video)
    assert pixels.dtype == (np.uint8 if bits == 8 else np.uint16)
    assert np.array_equal(pixels, drawn(e))


@pytest.mark.parametrize(("container", "tolerance"), [("mjpeg", 3.0), ("h264", 8.0)])
def test_lossy_containers_hold_them_nearly(tmp_path, container, tolerance):
    """RMS difference in grey levels; h264 also rescales to its limited range, undone here."""
    test = simulate(SMALL, tmp_path / "t", container=container)
    pixels = read(test.video).astype(float)
    frames = drawn(SMALL).astype(float)
    if container == "h264":
        pixels = (pixels - 16) * 255 / 219
    assert pixels.shape == frames.shape
    assert np.sqrt(((pixels - frames) ** 2).mean()) < tolerance


def test_raw_avi_in_several_segments(tmp_path):
    """OpenDML: a file over 1 GiB goes on in RIFF AVIX parts; here the parts are small."""
    frames = np.random.default_rng(0).integers(0, 256, (150, 7, 9), dtype=np.uint8)
    path = tmp_path / "long.avi"
    with RawAviWriter(path, width=9, height=7, fps=29.97, segment_bytes=6000) as writer:
        for frame in frames:
            writer.write(frame)
    data = path.read_bytes()
    assert data.count(b"AVIX") > 1
    sizes, at = [], 0
    while at < len(data):
        name, size = struct.unpack_from("<4sI", data, at)
        assert name == b"RIFF"
        sizes.append(size)
        at += size + 8
    assert at == len(data)
    assert np.array_equal(read(path), frames)
