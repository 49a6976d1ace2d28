from pathlib import Path

import numpy as np
import pytest

from tests.scenes.films import comb, whole
from vision.errors import InputError
from vision.video import open_video, strip_profile, video_files
from vision.video.reader import MappedReader

DATA = Path(__file__).parents[2] / "../shared/data"
XML = """<?xml version="1.0"?>
<cih><frameInfo><totalFrame>{frames}</totalFrame></frameInfo><recordInfo><recordRate>{rate}</recordRate>
</recordInfo><imageDataInfo><resolution><width>{width}</width><height>{height}</height></resolution><colorInfo>
<type>Mono</type><bit>{bits}</bit></colorInfo><effectiveBit><depth>{real}</depth><side>{side}</side>
</effectiveBit></imageDataInfo></cih>
"""
TEXT = """#Camera Information Header
Camera Type : FASTCAM SA-Z type 2100K-M-64GB
Record Rate(fps) : {rate}
Shutter Speed(s) : 1/15371
Total Frame : {frames}
Image Width : {width}
Image Height : {height}
Color Type : Mono
Color Bit : {bits}
EffectiveBit Depth : {real}
EffectiveBit Side : {side}
Comment Text : Total Frame : 999
#Photron Fastcam Viewer Version Information (Resave):
"""


def pack12(frames):
    """Two pixels in three bytes, most significant bits first, bit by bit: not the reader's arithmetic."""
    bits = (frames.reshape(-1, 1) >> np.arange(11, -1, -1)) & 1
    return np.packbits(bits.astype(np.uint8).ravel()).tobytes()


def write_photron(folder, frames, *, bits, header=TEXT, name="a", suffix="cih", lies=None):
    """The two files of a recording; `lies` replace what the header says."""
    count, height, width = frames.shape
    data = pack12(frames) if bits == 12 else frames.astype("u1" if bits == 8 else "<u2").tobytes()
    says = {
        "frames": count,
        "width": width,
        "height": height,
        "bits": bits,
        "real": min(bits, 12),
        "side": "Lower",
        "rate": 15000,
    }
    (folder / f"{name}.mraw").write_bytes(data)
    (folder / f"{name}.{suffix}").write_text(header.format(**(says | (lies or {}))), encoding="latin-1")
    return folder / f"{name}.mraw"


@pytest.mark.parametrize("bits", [8, 12, 16])
@pytest.mark.parametrize("given", ["a.mraw", "a.cih"])
def test_every_depth_is_read_exactly(tmp_path, bits, given):
    """Failure: bits are unpacked in the wrong order, scaled, or the rate is taken for a playback rate."""
    real = min(bits, 12)
    frames = comb(top=(1 << real) - 1, dtype=np.uint16)
    write_photron(tmp_path, frames, bits=bits)
    video = open_video(tmp_path / given)
    assert isinstance(video.reader, MappedReader)
    assert np.array_equal(whole(video), frames)
    assert np.array_equal(np.stack(list(video.sample(6))), frames)
    assert (video.depth_bits, video.saturation_level) == (real, (1 << real) - 1)
    assert (video.clock.kind, video.clock.fps, video.warnings) == ("file", 15000.0, ())
    assert np.allclose(video.times(np.arange(6)), np.arange(6) / 15000)
    assert [path.name for path in video_files(tmp_path / given)] == ["a.mraw", "a.cih"]


@pytest.mark.parametrize("width", [50, 51])
def test_packed_rows_that_begin_inside_three_bytes(tmp_path, width):
    """Failure: rows or columns of packed frames are off by a pixel where a row has an odd number."""
    frames = comb(columns=width, top=4095, dtype=np.uint16)
    video = open_video(write_photron(tmp_path, frames, bits=12), frames=slice(1, 5))
    for rows, columns in ((slice(3, 8), slice(7, 30)), (slice(1, 2), slice(0, width)), (slice(0, 12), None)):
        got = np.concatenate([block.pixels for block in video.blocks(rows, columns)])
        assert np.array_equal(got, frames[1:5, rows, columns or slice(None)])


@pytest.mark.parametrize("kind", ["Raw", "Color"])
def test_raw_pixels_are_read_and_colour_is_refused(tmp_path, kind):
    """A failure means that recordings whose pixels are stored as the sensor gave them cannot be used, or that
    three colours pass for three pixels."""
    frames = np.random.default_rng(3).integers(0, 4096, (3, 4, 50))
    path = write_photron(tmp_path, frames, bits=12, header=TEXT.replace("Mono", kind))
    if kind == "Color":
        with pytest.raises(InputError, match="Mono or Raw; found 'Color'"):
            open_video(path)
        return
    np.testing.assert_array_equal(list(open_video(path).frames()), frames)


def test_bits_at_the_higher_end_saturate_there(tmp_path):
    """Failure: white frames of a camera that fills the upper 12 of 16 bits never count as saturated."""
    frames = comb(top=4095, dtype=np.uint16) << 4
    video = open_video(write_photron(tmp_path, frames, bits=16, lies={"side": "Higher"}))
    assert (video.depth_bits, video.saturation_level) == (12, 65520)
    assert np.array_equal(whole(video), frames)


def test_xml_headers_of_newer_cameras(tmp_path):
    """Failure: a .cihx is refused, or found where the pixels are given but not the reverse."""
    frames = comb(top=4095, dtype=np.uint16)
    write_photron(tmp_path, frames, bits=12, header=XML, suffix="cihx", lies={"rate": "2000.5"})
    for given in ("a.mraw", "a.cihx"):
        video = open_video(tmp_path / given)
        assert np.array_equal(whole(video), frames)
        assert video.clock.fps == 2000.5
    (tmp_path / "a.cihx").write_text("binary<cih><frameInfo>")
    with pytest.raises(InputError, match="XML"):
        open_video(tmp_path / "a.mraw")


@pytest.mark.parametrize("bits", [8, 12, 16])
def test_a_cut_recording_gives_what_it_holds(tmp_path, bits):
    """Failure: frames that were not copied are not counted as lost."""
    frames = comb(count=9, dtype=np.uint16)
    path = write_photron(tmp_path, frames, bits=bits)
    path.write_bytes(path.read_bytes()[: -frames[0].size * bits * 5 // 16])  # two and a half frames less
    strip = strip_profile(open_video(path), slice(0, 12))
    assert (strip.frames_expected, strip.frames_read, strip.frames_lost) == (9, 6, 3)
    assert any("ends inside frame 6" in line for line in strip.warnings)
    assert any("3 are missing" in line for line in strip.warnings)
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(InputError, match="at least one frame"):
        open_video(path)


@pytest.mark.parametrize(
    "lie",
    [
        {"bits": 16},  # the file is of 8: half as many frames would be read, each two in one
        {"bits": 10},
        {"width": 0},
        {"width": -50},
        {"height": 10**9},
        {"height": ""},
        {"frames": 0},
        {"frames": "many"},
        {"bits": 24},
    ],
)
def test_lying_headers_are_refused(tmp_path, lie):
    """Failure: a header that cannot be true gives frames, or an exception that is no InputError."""
    with pytest.raises(InputError):
        open_video(write_photron(tmp_path, comb(), bits=8, lies=lie))


def test_more_frames_than_the_header_says_are_read_and_said(tmp_path):
    """Failure: frames beyond the header's count vanish, or appear without a word."""
    video = open_video(write_photron(tmp_path, comb(count=9), bits=8, lies={"frames": 7}))
    assert len(whole(video)) == 9
    assert "holds 9 frames where a.cih says 7" in video.warnings[0]


def test_a_missing_partner_is_named(tmp_path):
    """Failure: pixels without their description are guessed at."""
    path = write_photron(tmp_path, comb(), bits=8)
    (tmp_path / "a.cih").rename(tmp_path / "b.cih")
    for given in (path, tmp_path / "b.cih"):
        with pytest.raises(InputError, match="beside it"):
            open_video(given)


def test_no_rate_is_no_clock(tmp_path):
    """Failure: a recording without a rate is given one."""
    video = open_video(write_photron(tmp_path, comb(), bits=8, lies={"rate": ""}))
    assert video.clock.fps is None
    assert np.isnan(video.times(np.arange(3))).all()


@pytest.mark.skipif(not DATA.is_dir(), reason="the recordings are not here")
@pytest.mark.parametrize("name", ["two_bands.mraw", "two_bands.cih"])
def test_the_recording_of_two_bands(name):
    """Failure: a camera's own files differ from what is believed of them."""
    video = open_video(DATA / name, rotate=90)
    assert (video.shape, video.expected, video.depth_bits) == ((640, 40), 75, 8)
    assert (video.clock.kind, video.clock.fps) == ("file", 15000.0)
    assert "save step is 100" in video.warnings[0]  # said, since 150 frames/s would be as consistent
