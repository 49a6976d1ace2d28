"""Lossy compression smears noise and shifts grey levels: sheets must be the same after it."""

from fractions import Fraction

import av
import numpy as np
import pytest

from tests.scenes.combs import bound_px, comb, ridges, strip
from vision.sheets import track_sheets
from vision.video import open_video, strip_profile

FRAMES, ROWS, WIDTH, PITCH = 120, 32, 640, 20.0


def film(path, codec, options, truth):
    """The comb as a video of ROWS rows with pixel noise of 4 grey levels."""
    rng = np.random.default_rng(1)
    light = strip(ridges(truth, width=WIDTH), snr=1e6).values
    pixels = light[:, None, :] + rng.normal(0, 4, (FRAMES, ROWS, WIDTH))
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=Fraction(25), options=options)
        stream.width, stream.height = WIDTH, ROWS
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        for frame in pixels.clip(0, 255).astype(np.uint8):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="gray")))
        container.mux(stream.encode())
    return path


@pytest.mark.parametrize(
    ("name", "codec", "options"),
    [("a.avi", "mjpeg", {"qscale": "5"}), ("a.mp4", "libx264", {"crf": "28", "threads": "1"})],
    ids=["MJPEG", "H.264"],
)
def test_sheets_survive_lossy_compression(tmp_path, name, codec, options):
    """A failure means compressed recordings swap or lose sheets, or shift them by tenths of a pixel."""
    truth = comb(FRAMES, per_side=13, axis_px=WIDTH / 2, slip=0.85)
    video = open_video(film(tmp_path / name, codec, options, truth))
    tracks = track_sheets(strip_profile(video, slice(0, ROWS)))
    x, given = tracks.x_px.values, tracks.flag.values == "ok"
    assert x.shape == truth.shape
    assert given.mean() > 0.995
    assert np.nanmax(np.abs(x - truth)) < PITCH / 2
    inside = np.abs(x - truth)[given] < tracks.x_err_px.values[given]
    assert 0.62 < inside.mean() < 0.75  # one standard error, artefacts of the codec included
    snr = 60 / (4 / np.sqrt(ROWS))
    assert np.sqrt(np.nanmedian((x - truth) ** 2)) < 5 * bound_px(7, snr)
