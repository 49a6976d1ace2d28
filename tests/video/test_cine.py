import struct

import numpy as np
import pytest

from tests.scenes.films import comb, states, whole, write_cine
from vision.errors import InputError
from vision.video import open_video, strip_profile
from vision.video.reader import MappedReader


@pytest.mark.parametrize(("dtype", "bits"), [(np.uint8, 8), (np.uint16, 12), (np.uint16, 14)])
def test_unpacked_cine_is_read_exactly(tmp_path, dtype, bits):
    """Failure: values are scaled, the depth is that of the container, or rows are upside down."""
    frames = comb(top=(1 << bits) - 1, dtype=dtype)
    video = open_video(write_cine(tmp_path / "a.cine", frames, real_bits=bits))
    assert isinstance(video.reader, MappedReader)
    assert np.array_equal(whole(video), frames)
    assert (video.depth_bits, video.saturation_level, video.clock.kind) == (bits, (1 << bits) - 1, "file")
    assert abs(video.clock.fps - 1000) < 0.01


def test_deep_colour_cine_follows_the_luma_rule(tmp_path):
    """Failure: 12 bits of colour in 48 lose their lower bits, or red and blue change places."""
    colour = np.random.default_rng(2).integers(0, 4096, (3, 7, 33, 3), dtype=np.uint16)
    video = open_video(write_cine(tmp_path / "a.cine", colour, real_bits=12))
    assert np.abs(whole(video) - colour @ [0.114, 0.587, 0.299]).max() <= 0.6
    assert (video.saturation_level, "BT.601" in video.facts.grey) == (4095, True)


def test_the_mosaic_of_a_colour_camera_is_told(tmp_path):
    """Failure: columns under red and blue filters are tracked as grey without a word."""
    path = write_cine(tmp_path / "a.cine", comb(), real_bits=8, mosaic=True)
    assert "Bayer" in open_video(path).warnings[0]
    assert open_video(write_cine(tmp_path / "b.cine", comb(), real_bits=8)).warnings == ()


def test_absurd_times_are_replaced(tmp_path):
    """Failure: one foreign frame stretches the time axis to months."""
    video = open_video(write_cine(tmp_path / "a.cine", comb(), real_bits=8, odd_time=5))
    assert np.allclose(video.times(np.arange(6)), np.arange(6) / 1000, atol=1e-6)


@pytest.mark.parametrize("place", [1 << 40, -5])
def test_a_frame_whose_place_is_damaged_is_lost(tmp_path, place):
    """Failure: all later frames move up by one, and their times with them, or the film is refused."""
    frames = comb()
    path = write_cine(tmp_path / "a.cine", frames, real_bits=8)
    data = bytearray(path.read_bytes())
    struct.pack_into("<q", data, struct.unpack_from("<I", data, 32)[0] + 8 * 2, place)
    path.write_bytes(data)
    video = open_video(path)
    assert states(video) == ["ok", "ok", "lost", "ok", "ok", "ok"]
    assert np.array_equal(whole(video)[3:], frames[3:])


def test_cut_cine_gives_what_it_holds(tmp_path):
    """Failure: a cine saved over a broken network is refused, or its missing frames go unsaid."""
    frames = comb(count=9)
    path = write_cine(tmp_path / "a.cine", frames, real_bits=8)
    path.write_bytes(path.read_bytes()[: -3 * frames[0].nbytes])
    strip = strip_profile(open_video(path), slice(0, 12))
    assert (strip.frames_expected, strip.frames_read) == (9, 6)
    assert "3 are missing" in strip.warnings[0]
    assert states(open_video(path)) == ["ok"] * 6
    for length in (20, 60, 900, 1300):
        path.write_bytes(path.read_bytes()[:length])
        with pytest.raises(InputError):
            open_video(path)
