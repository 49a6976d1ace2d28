import struct
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from tests.scenes.films import comb, states, whole, write_avi, write_encoded
from vision.errors import InputError
from vision.video import open_video, strip_profile
from vision.video.encoded import EncodedReader, MjpegReader

DATA = Path(__file__).parents[2] / "../shared/data"
needs_data = pytest.mark.skipif(not DATA.exists(), reason="real recordings are not here")


@pytest.mark.parametrize(
    ("pix_fmt", "bits", "name"),
    [("gray", 8, "a.avi"), ("gray10le", 10, "a.mkv"), ("gray12le", 12, "a.mkv"), ("gray16le", 16, "a.avi")],
)
def test_ffv1_is_lossless_at_every_depth(tmp_path, pix_fmt, bits, name):
    """Failure: an archive format loses depth or is scaled on the way in."""
    frames = comb(rows=32, columns=64, top=(1 << bits) - 1, dtype=np.uint8 if bits == 8 else np.uint16)
    path = write_encoded(
        tmp_path / name, frames, codec="ffv1", pix_fmt=pix_fmt, source=pix_fmt, options={"g": "1"}
    )
    video = open_video(path)
    assert np.array_equal(whole(video), frames)
    assert video.depth_bits == bits
    assert len(list(video.sample(3))) >= 2


def test_rgb_video_follows_the_luma_rule(tmp_path):
    """Failure: colour recordings become grey by another rule than the one stated."""
    rng = np.random.default_rng(2)
    colour = rng.integers(0, 256, (3, 16, 32, 3), dtype=np.uint8)
    path = write_encoded(tmp_path / "a.mkv", colour, codec="ffv1", pix_fmt="bgr0", source="rgb24")
    assert np.abs(whole(open_video(path)) - colour @ [0.299, 0.587, 0.114]).max() <= 0.51


@pytest.mark.parametrize(("pix_fmt", "plain", "codec"), [
    ("ya8", "gray", "png"), ("ya16be", "gray16be", "png"), ("monob", "gray", "png"),
    ("y210le", "yuv422p10le", "rawvideo"), ("vuya", "yuv444p", "rawvideo"),
    ("yuyv422", "yuv422p", "rawvideo"), ("uyvy422", "yuv422p", "rawvideo"),
])  # fmt: skip
@pytest.mark.parametrize("size", [(7, 34), (1, 50)])
def test_luma_is_taken_out_of_formats_that_pack_it(tmp_path, pix_fmt, plain, codec, size):
    """Failure: alpha, chroma or shifted bits are taken for grey levels, without a word."""
    rows, columns = size
    rng = np.random.default_rng(4)
    path = tmp_path / ("a.mov" if codec == "png" else "a.nut")
    with av.open(str(path), "w") as out:
        stream = out.add_stream(codec, rate=25)
        stream.height, stream.width, stream.pix_fmt = rows, columns, pix_fmt
        for n in range(3):
            frame = av.VideoFrame(columns, rows, pix_fmt)
            for plane in frame.planes:
                plane.update(rng.integers(0, 256, plane.buffer_size, dtype=np.uint8).tobytes())
            frame.pts, frame.time_base = n, Fraction(1, 25)
            out.mux(stream.encode(frame))
        out.mux(stream.encode(None))
    with av.open(str(path)) as file:  # FFmpeg converts each frame to the nearest format with a plane of luma
        decoded = list(file.decode(video=0))
        truth = []
        for frame in decoded:
            plane = frame.reformat(format=plain, dst_color_range=frame.color_range, threads=1).planes[0]
            item = np.dtype(">u2" if plain.endswith("be") else "<u2" if plain.endswith("le") else "u1")
            lines = np.frombuffer(memoryview(plane), item).reshape(-1, plane.line_size // item.itemsize)
            truth.append(lines[:rows, :columns].astype(int))
    assert decoded[0].format.name == pix_fmt
    assert np.array_equal(whole(open_video(path)), truth)


def test_h264_gives_the_luma_plane(tmp_path):
    """Failure: limited-range luma is stretched without notice, or B frames come out of order."""
    frames = comb(count=30, rows=64, columns=96, top=200)
    options = {"qp": "0", "preset": "ultrafast", "bf": "2", "g": "10"}
    path = write_encoded(
        tmp_path / "a.mp4", frames, codec="libx264", pix_fmt="yuv420p", source="gray", options=options
    )
    with av.open(str(path)) as file:
        planes = [np.asarray(memoryview(f.planes[0])) for f in file.decode(video=0)]
        width = 96
        truth = np.stack([p.reshape(-1)[: 64 * (p.size // 64)].reshape(64, -1)[:, :width] for p in planes])
    video = open_video(path)
    assert np.array_equal(whole(video), truth)
    assert np.array_equal(list(video.sample(4)), truth[[0, 10, 20]])  # key frames, each once
    assert "limited range" in video.facts.grey
    assert (video.expected, video.clock.kind) == (30, "playback")
    # still the comb that went in, scaled to 16..235
    assert np.abs(whole(video).astype(float) - (16 + frames.astype(float) * 219 / 255)).max() <= 2


@pytest.mark.parametrize(
    ("codec", "options", "step"),
    [
        ("libx264", {"qp": "28", "x264-params": "ipratio=1.4:pbratio=1.3"}, 16.0),
        ("libx264", {"qp": "28", "g": "1"}, 0.0),  # no frame is predicted
        ("mpeg4", {"qmin": "5", "qmax": "5"}, 14.0),
        ("mpeg2video", {"qmin": "5", "qmax": "5"}, 10.0),
        ("msmpeg4", {"qmin": "5", "qmax": "5"}, 14.0),
        ("libx265", {"x265-params": "qp=28:ipratio=1.4:pbratio=1.3:log-level=none"}, 11.3),  # of 16
        ("libx265 10", {"x265-params": "qp=28:ipratio=1.4:pbratio=1.3:log-level=none"}, 45.25),  # of 1023
        ("ffv1", {}, 0.0),
    ],
)
def test_the_step_of_the_quantiser_is_read(tmp_path, codec, options, step):
    """By which errors of films that predict frames are stated. Failure: that of key or B frames is taken."""
    frames = np.random.default_rng(1).integers(0, 255, (16, 32, 64), dtype=np.uint8)
    codec, _, bits = codec.partition(" ")
    kind = "gray" if codec == "ffv1" else f"yuv420p{bits}le" if bits else "yuv420p"
    path = write_encoded(
        tmp_path / "a.mkv", frames, codec=codec, pix_fmt=kind, source="gray", options=options
    )
    assert open_video(path).facts.quantiser_step == pytest.approx(step, rel=0.01)


@pytest.mark.parametrize("flags", ["", "+ildct+ilme"])
def test_interlaced_films_are_named(tmp_path, flags):
    """Failure: rows that were recorded at two times are averaged without a word."""
    options = {"flags": flags} if flags else {}
    frames = comb(rows=32, columns=64)
    path = write_encoded(
        tmp_path / "a.mp4", frames, codec="libx264", pix_fmt="yuv420p", source="gray", options=options
    )
    assert [("interlaced" in line) for line in open_video(path).warnings] == [True] * bool(flags)


def test_reordered_frames_in_an_avi_are_all_there(tmp_path):
    """Failure: AVI stores decoding times only; taken for display times they lose and invent frames."""
    frames = comb(count=30, rows=64, columns=96, top=200)
    options = {"qp": "0", "preset": "ultrafast", "bf": "2"}
    path = write_encoded(
        tmp_path / "a.avi", frames, codec="libx264", pix_fmt="yuv420p", source="gray", options=options
    )
    assert states(open_video(path)) == ["ok"] * 30


def test_truncated_h264_and_damage(tmp_path):
    """Failure: frames that lean on a damaged one are tracked as if they were real."""
    frames = comb(count=20, rows=64, columns=96)
    options = {"g": "5", "bf": "0"}
    path = write_encoded(
        tmp_path / "a.mp4", frames, codec="libx264", pix_fmt="yuv420p", source="gray", options=options
    )
    data = bytearray(path.read_bytes())
    start = data.index(b"mdat") + 900
    data[start : start + 300] = bytes(300)
    path.write_bytes(data)
    found = states(open_video(path))
    assert len(found) == 20
    assert 1 <= found.count("corrupt") <= 6


@pytest.mark.parametrize("codec", ["libx264", "mpeg4"])
def test_frames_predicted_from_a_damaged_one_are_corrupt(tmp_path, codec):
    """Failure: frames that carry the damage of another are tracked as if they were real."""
    rng = np.random.default_rng(3)
    frames = comb(count=40, rows=64, columns=96, top=200) + rng.integers(0, 40, (40, 64, 96), np.uint8)
    options = {"g": "10", "bf": "2", "sc_threshold": "0"}
    path = write_encoded(
        tmp_path / "a.mkv", frames, codec=codec, pix_fmt="yuv420p", source="gray", options=options
    )
    clean = whole(open_video(path))
    with av.open(str(path)) as film:
        (packet,) = [
            one for one in film.demux(video=0) if one.size and round(25 * one.pts * one.time_base) == 13
        ]
        at, data = path.read_bytes().index(bytes(packet)), bytearray(path.read_bytes())
    data[at + packet.size // 2 : at + packet.size] = bytes(packet.size - packet.size // 2)
    path.write_bytes(data)
    found, decoded = np.array(states(open_video(path))), whole(open_video(path))
    assert found.size == 40
    assert np.array_equal(found == "corrupt", (decoded != clean).any(axis=(1, 2)))
    assert 8 <= (found == "corrupt").sum() <= 9  # until the next key frame


def mjpeg(path, count=12, **size):
    frames = comb(count=count, rows=48, columns=96, **size)
    return write_encoded(
        path, frames, codec="mjpeg", pix_fmt="yuvj420p", source="gray", options={"qscale": "2"}
    )


def mjpeg_with_restarts(path, pix_fmt="yuvj420p"):
    """Four frames of 52 rows with a marker after every 16."""
    frames = comb(count=4, rows=52, columns=100)
    options = {"qscale": "2", "threads": "2"}
    return write_encoded(path, frames, codec="mjpeg", pix_fmt=pix_fmt, source="gray", options=options)


def test_fast_mjpeg_equals_ffmpeg_but_for_rounding(tmp_path):
    """Failure: the quick decoder is not the same measurement as the reference decoder."""
    path = mjpeg(tmp_path / "a.avi")
    video = open_video(path)
    assert isinstance(video.reader, MjpegReader)
    full = slice(0, 48), slice(0, 96)
    slow = np.concatenate([b.pixels for b in EncodedReader.of(path).read(0, None, *full)])
    assert np.abs(whole(video).astype(int) - slow).max() <= 1
    assert np.mean(whole(video) != slow) < 0.05


@pytest.mark.parametrize("pix_fmt", ["yuvj420p", "yuvj444p"])
@pytest.mark.parametrize("rows", [(0, 5), (3, 17), (16, 32), (30, 52), (0, 52)])
def test_mjpeg_with_restart_markers_is_decoded_only_where_needed(tmp_path, rows, pix_fmt):
    """Failure: other rows than asked for; or damage elsewhere in the picture costs frames."""
    path = mjpeg_with_restarts(tmp_path / "a.avi", pix_fmt)
    data = path.read_bytes()
    assert b"\xff\xdd" in data and b"\xff\xd1" in data
    z = slice(*rows)
    clean = whole(open_video(path))
    assert np.array_equal(np.concatenate([b.pixels for b in open_video(path).blocks(z)]), clean[:, z])
    broken = bytearray(data)
    place = data.index(b"\xff\xd1", data.rindex(b"\xff\xd8\xff"))  # before rows 32 to 48
    broken[place + 2 : place + 12] = bytes([255, 0]) * 5
    path.write_bytes(broken)
    (block,) = open_video(path).blocks(z)
    reached = z.start < 48 and z.stop > 32
    assert block.status == ("ok", "ok", "ok", "corrupt" if reached else "ok")
    assert reached or np.array_equal(block.pixels, clean[:, z])


def test_rows_of_an_mjpeg_that_damage_displaced_are_not_decoded(tmp_path):
    """Failure: where one marker is lost and another made up, rows are taken from another place."""
    path = mjpeg_with_restarts(tmp_path / "a.avi")
    data = bytearray(path.read_bytes())
    scan = data.rindex(b"\xff\xda") + 14
    last = data.index(b"\xff\xd2", scan)  # before rows 48 to 52
    data[scan : scan + 2], data[last : last + 2] = b"\xff\xd0", bytes(2)
    path.write_bytes(data)
    (block,) = open_video(path).blocks(slice(33, 47))
    assert block.status == ("ok", "ok", "ok", "corrupt")


def test_damaged_mjpeg_frame_is_flagged_and_counted(tmp_path):
    """Failure: a torn frame is tracked, or dropping it shifts every later time stamp."""
    path = mjpeg(tmp_path / "a.avi")
    clean = strip_profile(open_video(path), slice(0, 48))
    data = bytearray(path.read_bytes())
    starts = [n for n in range(len(data) - 3) if data[n : n + 3] == b"\xff\xd8\xff"]
    middle = (starts[5] + starts[6]) // 2
    data[middle : middle + 200] = b"\xff\xd9" + bytes(198)
    path.write_bytes(data)
    strip = strip_profile(open_video(path), slice(0, 48))
    assert strip.status.values.tolist() == ["ok"] * 5 + ["corrupt"] + ["ok"] * 6
    assert np.isnan(strip[5]).all()
    assert np.array_equal(strip[6:], clean[6:])
    assert (strip.frames_read, strip.frames_corrupt) == (11, 1)
    assert "corrupt" in strip.warnings[0]


def test_damaged_ffv1_frame_is_flagged_and_counted(tmp_path):
    """Failure: frames behind a damaged one move up by one number."""
    frames = comb(count=10, rows=32, columns=64)
    options = {"slicecrc": "1", "level": "3", "g": "1"}
    path = write_encoded(
        tmp_path / "a.avi", frames, codec="ffv1", pix_fmt="gray", source="gray", options=options
    )
    data = bytearray(path.read_bytes())
    at, places = data.index(b"movi") + 4, []
    while data[at : at + 4] == b"00dc":
        length = struct.unpack_from("<I", data, at + 4)[0]
        places.append((at + 8, length))
        at += 8 + length + length % 2
    start, length = places[4]
    data[start : start + length] = bytes(255 - b for b in data[start : start + length])
    path.write_bytes(data)
    video = open_video(path)
    assert states(video) == ["ok"] * 4 + ["corrupt"] + ["ok"] * 5
    assert np.array_equal(whole(video)[5:], frames[5:])


def test_truncated_mjpeg_gives_what_it_holds(tmp_path):
    """Failure: a recording cut by a full disk is refused or its missing end is not mentioned."""
    path = mjpeg(tmp_path / "a.avi", count=20)
    data = path.read_bytes()
    twelfth = [n for n in range(len(data) - 3) if data[n : n + 3] == b"\xff\xd8\xff"][11]
    path.write_bytes(data[: twelfth + 400])
    strip = strip_profile(open_video(path), slice(0, 48))
    assert (strip.frames_expected, strip.frames_read, strip.frames_lost) == (20, 11, 9)
    assert "missing" in strip.warnings[0]


def test_matroska_times_are_its_own(tmp_path):
    """Failure: a container that stamps every frame is treated as one with a playback rate only."""
    path = write_encoded(
        tmp_path / "a.mkv", comb(rows=32), codec="ffv1", pix_fmt="gray", source="gray", fps=30
    )
    strip = strip_profile(open_video(path), slice(0, 32))
    assert strip.clock_kind == "file"
    assert np.allclose(strip.time_s, np.arange(6) / 30, atol=6e-4)


def test_cut_matroska_is_reported(tmp_path):
    """Failure: a container that holds no frame count loses its end without a warning."""
    frames = comb(count=40, rows=32)
    path = write_encoded(
        tmp_path / "a.mkv", frames, codec="ffv1", pix_fmt="gray", source="gray", options={"g": "1"}
    )
    assert strip_profile(open_video(path), slice(0, 32)).warnings == []
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    strip = strip_profile(open_video(path), slice(0, 32))
    assert 15 <= strip.frames_read <= 25
    assert np.allclose(strip[:15], frames[:15].mean(axis=1), rtol=1e-6)
    assert "missing" in strip.warnings[0]


def avi_that_skips(tmp_path, drop):
    path = mjpeg(tmp_path / "b.avi", count=8)
    with av.open(str(path)) as file:
        jpegs = [bytes(packet) for packet in file.demux(video=0) if packet.size]
    raw = [np.frombuffer(j, np.uint8) for j in jpegs]
    length = max(map(len, jpegs))
    padded = np.stack([np.pad(j, (0, length - len(j))) for j in raw])[:, None, :]
    out = write_avi(tmp_path / "a.avi", padded, fourcc=b"MJPG", bits=24, drop=drop)
    data = bytearray(out.read_bytes())  # the header's frame size is that of the picture, not of its bytes
    data[data.index(b"strf") + 12 : data.index(b"strf") + 20] = struct.pack("<ii", 96, 48)
    out.write_bytes(data)
    return out


def test_skipped_frames_in_an_encoded_avi_are_lost(tmp_path):
    """Failure: frames the camera dropped (empty chunks) shift all later times."""
    assert states(open_video(avi_that_skips(tmp_path, (3,)))) == ["ok"] * 3 + ["lost"] + ["ok"] * 4


def test_a_part_that_ends_among_skipped_frames_ends_there(tmp_path):
    """Failure: more frames than asked for, where those at the end were dropped."""
    reader = EncodedReader.of(avi_that_skips(tmp_path, (3, 4, 5)))
    blocks = reader.read(1, 5, slice(0, 48), slice(0, 96))
    assert [status for block in blocks for status in block.status] == ["ok"] * 2 + ["lost"] * 2


def test_changing_size_is_refused(tmp_path):
    """Failure: frames of two sizes are averaged into one profile."""
    one = mjpeg(tmp_path / "b.avi", count=3)
    two = write_encoded(
        tmp_path / "c.avi", comb(rows=32, columns=64), codec="mjpeg", pix_fmt="yuvj420p", source="gray"
    )
    jpegs = []
    for path in (one, two):
        with av.open(str(path)) as file:
            jpegs += [bytes(packet) for packet in file.demux(video=0) if packet.size]
    out = tmp_path / "a.mjpeg"
    out.write_bytes(b"".join(jpegs))
    with pytest.raises(InputError, match="every frame 96 x 48"):
        strip_profile(open_video(out), slice(0, 32))


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("a.avi", b"", "empty"),
        ("a.avi", b"this is no video at all\n" * 50, "expected a video"),
        ("notes.txt", b"this is no video at all\n" * 50, "expected a video"),
        ("a.avi", bytes(range(256)) * 40, "expected a video"),
        ("a.avi", b"RIFF\x10\0\0\0AVI LIST", "video stream"),
        ("a.mp4", b"\0\0\0\x18ftypisom\0\0\2\0isomiso2\0\1\0\0mdat" + bytes(70000), "moov"),
    ],
)
def test_files_that_are_no_video(tmp_path, name, content, says):
    """Failure: a wrong file ends in a traceback instead of one line that helps."""
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(InputError, match=says) as caught:
        open_video(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def test_missing_file_and_unknown_codec(tmp_path):
    """Failure: as above, for a mistyped name and for a codec nobody has."""
    with pytest.raises(InputError, match="no such file"):
        open_video(tmp_path / "nothing.avi")
    path = write_avi(tmp_path / "a.avi", comb(), fourcc=b"QZQZ")
    with pytest.raises(InputError):
        open_video(path)


@needs_data
def test_released_markers():
    """Failure: the benchmark recording is not read whole."""
    strip = strip_profile(open_video(DATA / "released_markers.avi"), slice(0, 40))
    assert strip.shape == (582, 1200)
    assert (strip.frames_lost, strip.clock_kind, strip.fps) == (0, "playback", 20.0)
    assert (strip.status == "ok").all()


@needs_data
def test_striped_beam():
    """Failure: cine depth, times or the white last frame are got wrong."""
    video = open_video(DATA / "striped_beam.cine", rotate=90)
    assert (video.shape, video.depth_bits, video.expected) == ((256, 32), 10, 235)
    strip = strip_profile(video, slice(0, 256))
    assert strip.status.values.tolist() == ["ok"] * 234 + ["blank"]
    assert float(strip.max()) <= 1023
    assert strip.clock_kind == "file"
    assert np.allclose(strip.time_s, np.arange(235) * 0.01, atol=1e-6)
    assert len(list(video.sample(8))) >= 6


def phone_film(path, frames, times_s, *, turned_deg=0):
    """H.264 in MP4 with a time for every frame, and the angle (clockwise) that a player is to turn it by."""
    with av.open(str(path), "w") as file:
        stream = file.add_stream("libx264", rate=30, options={"qp": "0", "preset": "ultrafast", "bf": "2"})
        stream.height, stream.width = frames.shape[1:]
        stream.pix_fmt = "yuv420p"
        stream.codec_context.time_base = Fraction(1, 90_000)
        if turned_deg:
            stream.set_display_rotation(-turned_deg)
        for picture, time_s in zip(frames, times_s, strict=True):
            frame = av.VideoFrame.from_ndarray(picture, format="gray")
            frame.pts, frame.time_base = round(time_s * 90_000), Fraction(1, 90_000)
            file.mux(stream.encode(frame))
        file.mux(stream.encode())
    return path


def test_a_variable_frame_rate_gives_every_frame_its_own_time(tmp_path):
    """Failure: a phone's film, with frames 1/30 or 1/24 s apart, is given even times, frames wrong."""
    frames = comb(count=60, rows=64, columns=96, top=200)
    times_s = np.cumsum(np.r_[0.0, np.repeat([1 / 30, 1 / 24, 1 / 60], 20)[:59]])
    strip = strip_profile(open_video(phone_film(tmp_path / "phone.mp4", frames, times_s)))
    assert strip.attrs["clock_kind"] == "file"
    found = strip["time_s"].values
    assert np.abs(found - found[0] - times_s).max() < 1e-4
    assert np.abs(np.linspace(0, times_s[-1], 60) - times_s).max() > 0.1  # what even times would cost
    even = open_video(phone_film(tmp_path / "even.mp4", frames, np.arange(60) * 1001 / 30_000))
    assert even.clock.kind == "playback"


@pytest.mark.parametrize("name", ["phone.mp4", "phone.mkv"])
@pytest.mark.parametrize("gone", [(), (10, 31, 32, 50, 150, 215)])
def test_a_camera_that_changes_its_rate_loses_nothing(tmp_path, name, gone):
    """Failure: a phone that films slower in dim light is said to lose frames, or hides those it did lose."""
    intervals = np.repeat([1 / 30, 1 / 24, 1 / 55, 1 / 13], [40, 40, 120, 40])
    count, times_s = intervals.size, np.cumsum(intervals)
    kept = np.delete(np.arange(count), gone)
    path = phone_film(tmp_path / name, comb(count=count, rows=64, columns=96, top=200)[kept], times_s[kept])
    strip = strip_profile(open_video(path), slice(0, 64))
    assert strip.attrs["clock_kind"] == "file"
    assert (strip.frames_read, strip.frames_lost) == (len(kept), len(gone))
    assert len(strip.warnings) == (1 if gone else 0)


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv"])
def test_evenly_lost_frames_are_told(tmp_path, name):
    """Failure: every second frame is lost where a disk is too slow, and nobody is told."""
    kept = np.r_[:40, 40:120:2]
    path = phone_film(tmp_path / name, comb(count=120, rows=64, columns=96, top=200)[kept], kept / 60)
    strip = strip_profile(open_video(path), slice(0, 64))
    assert "from frame 40 on, frames come at half or a third" in strip.warnings[-1]


@pytest.mark.parametrize("turned_deg", [0, 90, 180, 270])
def test_a_film_is_seen_as_players_show_it(tmp_path, turned_deg):
    """Failure: a film of a phone held upright lies on its side, although every player shows it upright."""
    frames = comb(count=6, rows=64, columns=96, top=200)
    path = phone_film(tmp_path / "phone.mp4", frames, np.arange(6) / 30, turned_deg=turned_deg)
    stored = whole(open_video(phone_film(tmp_path / "stored.mp4", frames, np.arange(6) / 30)))
    turns = -(turned_deg // 90)
    assert np.array_equal(whole(open_video(path)), np.rot90(stored, turns, axes=(1, 2)))
    asked = whole(open_video(path, rotate=90))
    assert np.array_equal(asked, np.rot90(stored, turns - 1, axes=(1, 2)))
