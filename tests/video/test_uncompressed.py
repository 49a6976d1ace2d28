import tracemalloc

import numpy as np
import pytest

from tests.scenes.films import comb, states, whole, write_avi
from vision.errors import InputError
from vision.video import open_video, strip_profile

GREY_RAMP = b"".join(bytes((n, n, n, 0)) for n in range(256))


@pytest.mark.parametrize("fourcc", [b"Y800", b"GREY", b"Y8  "])
@pytest.mark.parametrize("pad", [False, True])
def test_grey_avi_is_read_exactly(tmp_path, fourcc, pad):
    """Failure: pixels of the commonest camera format are shifted, flipped or mixed with row padding."""
    frames = comb(columns=51)
    video = open_video(write_avi(tmp_path / "a.avi", frames, fourcc=fourcc, pad=pad))
    assert np.array_equal(whole(video), frames)
    assert (video.expected, video.depth_bits, video.clock.kind, video.clock.fps) == (6, 8, "playback", 25.0)


@pytest.mark.parametrize("negative_height", [False, True])
def test_palette_bitmap_is_turned_right_side_up(tmp_path, negative_height):
    """Failure: z counts from the bottom, so every strip is taken at the wrong height."""
    frames = comb(columns=51)
    path = write_avi(
        tmp_path / "a.avi",
        frames,
        fourcc=bytes(4),
        palette=GREY_RAMP,
        pad=True,
        bottom_up=not negative_height,
        negative_height=negative_height,
    )
    assert np.array_equal(whole(open_video(path)), frames)


def test_palette_is_looked_up(tmp_path):
    """Failure: indices are taken for grey values; an inverted palette then turns bright ridges dark."""
    frames = comb(columns=52)
    palette = b"".join(bytes((255 - n, 255 - n, 255 - n, 0)) for n in range(256))
    path = write_avi(tmp_path / "a.avi", frames, fourcc=bytes(4), palette=palette, bottom_up=True)
    assert np.array_equal(whole(open_video(path)), 255 - frames)


@pytest.mark.parametrize("bits", [24, 32])
def test_bgr_becomes_bt601_luma(tmp_path, bits):
    """Failure: colour is averaged, or red and blue are swapped; the stated rule would be untrue."""
    rng = np.random.default_rng(1)
    colour = rng.integers(0, 256, (3, 10, 33, bits // 8), dtype=np.uint8)
    path = write_avi(tmp_path / "a.avi", colour, bits=bits, fourcc=bytes(4), pad=True, bottom_up=True)
    video = open_video(path)
    blue, green, red = (colour[..., n].astype(float) for n in range(3))
    assert np.abs(whole(video) - (0.299 * red + 0.587 * green + 0.114 * blue)).max() <= 0.51
    assert np.abs(whole(video) - (0.299 * blue + 0.587 * green + 0.114 * red)).max() > 20
    assert "BT.601" in video.facts.grey


def test_colour_with_masks_is_colour(tmp_path):
    """Failure: 32-bit colour whose header lists its masks is decoded as 16-bit colour, all pixels wrong."""
    colour = np.random.default_rng(1).integers(0, 256, (3, 10, 33, 4), dtype=np.uint8)
    masks = b"".join(mask.to_bytes(4, "little") for mask in (0xFF0000, 0xFF00, 0xFF))
    path = write_avi(tmp_path / "a.avi", colour, bits=32, fourcc=b"\3\0\0\0", palette=masks, bottom_up=True)
    assert np.abs(whole(open_video(path)) - colour[..., :3] @ [0.114, 0.587, 0.299]).max() <= 0.51


@pytest.mark.parametrize(("fourcc", "bits"), [(b"Y16 ", 16), (b"Y1\0\x0c", 12), (b"Y1\0\x0a", 10)])
def test_deep_grey_keeps_its_depth(tmp_path, fourcc, bits):
    """Failure: 10 to 16 bits are cut to 8 or read as colour, which costs most of the camera's precision."""
    frames = comb(top=(1 << bits) - 1, dtype=np.uint16)
    video = open_video(write_avi(tmp_path / "a.avi", frames, fourcc=fourcc, bits=16))
    assert np.array_equal(whole(video), frames)
    assert (video.depth_bits, video.saturation_level) == (bits, 2**bits - 1)


def test_unnamed_16_bits_are_refused(tmp_path):
    """Failure: deep pixels are read as 15-bit colour and tracked without a word."""
    path = write_avi(tmp_path / "a.avi", comb(dtype=np.uint16), fourcc=bytes(4), bits=16)
    with pytest.raises(InputError, match="16 bits per pixel"):
        open_video(path)


def test_packed_depth_is_refused(tmp_path):
    """Failure: frames of an unexpected size are sheared line by line."""
    path = write_avi(tmp_path / "a.avi", comb(rows=12, columns=75), fourcc=b"Y10 ", bits=10)
    with pytest.raises(InputError, match="bytes a frame"):
        open_video(path)


@pytest.mark.parametrize("segments", [1, 3])
def test_opendml_segments_and_a_cut_file(tmp_path, segments):
    """Failure: only the first gigabyte is read, a cut recording is refused, or lost frames go unsaid."""
    frames = comb(count=9)
    path = write_avi(tmp_path / "a.avi", frames, segments=segments)
    assert np.array_equal(whole(open_video(path)), frames)
    data = path.read_bytes()
    path.write_bytes(data[: data.index(frames[6].tobytes()) + 100])
    strip = strip_profile(open_video(path), slice(0, 12))
    assert strip.sizes["frame"] == 6
    assert (strip.frames_expected, strip.frames_read, strip.frames_lost) == (9, 6, 3)
    assert "inside frame 6" in strip.warnings[0]
    assert "3 are missing" in strip.warnings[1]


def test_dropped_frames_keep_their_numbers(tmp_path):
    """Failure: time runs fast after every frame the camera dropped."""
    frames = comb(count=8)
    path = write_avi(tmp_path / "a.avi", frames, drop=(2, 3))
    assert states(open_video(path)) == ["ok", "ok", "lost", "lost", *["ok"] * 4]
    strip = strip_profile(open_video(path), slice(3, 9), columns=slice(5, 20))
    assert strip.sizes["frame"] == 8
    assert np.isnan(strip[2:4]).all()
    assert np.allclose(strip[4:], frames[4:, 3:9, 5:20].mean(axis=1), atol=1e-4)
    assert strip.status.values.tolist() == states(open_video(path))


def test_no_whole_frame(tmp_path):
    """Failure: a header without frames counts as a recording."""
    frames = comb(count=2)
    path = write_avi(tmp_path / "a.avi", frames)
    data = path.read_bytes()
    path.write_bytes(data[: data.index(frames[0].tobytes()) + 10])
    with pytest.raises(InputError, match="whole frame"):
        open_video(path)


def test_few_columns_take_no_more_memory_than_all(tmp_path):
    """Failure: a few columns (the strip of a film that is rotated by 90°) take as many whole frames at once
    as they would fill a block: gigabytes of a large film."""
    path = write_avi(tmp_path / "a.avi", np.zeros((100, 400, 1000), np.uint8))
    tracemalloc.start()
    for _ in open_video(path).blocks(columns=slice(5, 9)):
        pass
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 12 << 20  # two blocks; all frames take 40 MB


def test_one_row(tmp_path):
    """Failure: line-scan recordings, one row high, cannot be read."""
    frames = comb(rows=1)
    strip = strip_profile(open_video(write_avi(tmp_path / "a.avi", frames)), slice(0, 1))
    assert np.array_equal(strip.values, frames[:, 0].astype(np.float32))
