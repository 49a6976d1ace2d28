import numpy as np
import pytest

from tests.scenes.films import comb, states, whole, write_cine
from vision.errors import InputError
from vision.video import open_video, strip_profile
from vision.video.uncompressed import MappedReader


@pytest.mark.parametrize(("dtype", "bits"), [(np.uint8, 8), (np.uint16, 12), (np.uint16, 14)])
def test_unpacked_cine_is_read_exactly(tmp_path, dtype, bits):
    """Failure: values are scaled, the depth is that of the container, or rows are upside down."""
    frames = comb(top=(1 << bits) - 1, dtype=dtype)
    video = open_video(write_cine(tmp_path / "a.cine", frames, real_bits=bits))
    assert isinstance(video.reader, MappedReader)
    assert np.array_equal(whole(video), frames)
    assert (video.depth_bits, video.saturation_level, video.clock.kind) == (bits, (1 << bits) - 1, "file")
    assert abs(video.clock.fps - 1000) < 0.01


def test_absurd_times_are_replaced(tmp_path):
    """Failure: one foreign frame stretches the time axis to months."""
    video = open_video(write_cine(tmp_path / "a.cine", comb(), real_bits=8, odd_time=5))
    assert np.allclose(video.times(np.arange(6)), np.arange(6) / 1000, atol=1e-6)


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
