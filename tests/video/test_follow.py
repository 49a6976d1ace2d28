"""A recording is followed while it grows: the result is that of the whole one."""

import os
import shutil
import threading
import time

import av
import cv2
import numpy as np
import pytest
import tifffile

from tests.scenes.films import comb, write_avi, write_cine, write_encoded
from vision.data import StripMetadata
from vision.errors import InputError
from vision.video import Follow, VideoSettings, await_video, open_video, strip_profile
from vision.video.follow import held_back
from vision.video.reader import Block

ROWS = slice(2, 10)
QUICK = VideoSettings(
    follow_poll_s=0.02,
    follow_still_s=0.4,
    follow_give_up_s=1.0,
    follow_first=20,
    follow_margin=8,
    follow_tell_s=0.0,
)
COUNT = 200
PATIENCE_S = 120  # on a machine that does much else


class Clock:
    """The follower's seconds, which stand while the camera writes: a pause of a busy machine ends no film."""

    def __init__(self):
        self._shown, self._looked, self.stands = 0.0, time.monotonic(), lambda: False

    def monotonic(self):
        now, stands = time.monotonic(), self.stands()
        self._shown += 0.0 if stands else now - self._looked
        self._looked = now
        return self._shown

    def time(self):
        return time.time()


@pytest.fixture(autouse=True)
def clock(monkeypatch):
    made = Clock()
    monkeypatch.setattr("vision.video.follow.time", made)
    return made


@pytest.fixture(scope="module")
def frames():
    return comb(count=COUNT)


def film(codec, pix_fmt):
    return lambda path, frames: write_encoded(
        path, frames[:, :, :48], codec=codec, pix_fmt=pix_fmt, source="gray"
    )


def stack(path, frames, **how):
    tifffile.imwrite(path, frames, photometric="minisblack", **how)
    return path


def photron(path, frames):
    path.write_bytes(frames.tobytes())
    rows, columns = frames.shape[1:]
    fields = {"Total Frame": len(frames), "Image Width": columns, "Image Height": rows, "Color Bit": 8}
    text = "".join(f"{name} : {value}\n" for name, value in fields.items())
    path.with_suffix(".cih").write_text(f"Record Rate(fps) : 100\n{text}")
    return path


def fragmented(path, frames):
    """An MP4 whose every tenth frame begins a part of its own, with an index of its own."""
    how = {"codec": "libx264", "pix_fmt": "yuv420p", "source": "gray", "options": {"g": "10"}}
    plain = write_encoded(path.with_name("plain.mp4"), frames[:, :, :48], **how)
    options = {"movflags": "frag_keyframe+empty_moov"}
    with av.open(str(plain)) as source, av.open(str(path), "w", options=options) as out:
        stream = out.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(video=0):
            if packet.dts is not None:
                packet.stream = stream
                out.mux(packet)
    return path


GROWING = {
    "raw.avi": write_avi,
    "mjpeg.avi": film("mjpeg", "yuvj420p"),
    "h264.mkv": film("libx264", "yuv420p"),
    "ffv1.mkv": film("ffv1", "gray"),
    "pages.tif": stack,
    "lzw.tif": lambda path, frames: stack(path, frames, compression="lzw"),
    "a.mraw": photron,
    "a.cine": lambda path, frames: write_cine(path, frames, real_bits=8),
    "h264.mp4": film("libx264", "yuv420p"),  # cannot be read until it is closed
    "parts.mp4": fragmented,
}


def copy_slowly(source, target, seen=None, *, pieces=12, pause_s=0.04):
    """As a camera writes: pieces that end anywhere inside a frame; half of them once the first was seen."""
    data = source.read_bytes()
    with target.open("wb", buffering=0) as out:
        for n, part in enumerate(np.array_split(np.frombuffer(data, np.uint8), pieces)):
            if n == pieces // 2 and seen is not None:
                assert seen.wait(PATIENCE_S)
            out.write(part.tobytes())
            time.sleep(pause_s)


def write_images(frames, folder):
    for n in np.random.default_rng(0).permuted(np.arange(COUNT).reshape(-1, 4), axis=1).ravel():
        cv2.imwrite(str(folder / f"a_{n:05d}.png"), frames[n])
        time.sleep(0.002)


def followed(clock, path, write, *arguments, follow=None, **how):
    """The strip of a recording that another thread writes meanwhile."""
    follow = follow or Follow()
    writer = threading.Thread(target=write, args=arguments)
    clock.stands = writer.is_alive
    writer.start()
    try:
        video = await_video(path, lambda: open_video(path, **how), follow, QUICK)
        return strip_profile(video, ROWS, settings=QUICK, follow=follow)
    finally:
        writer.join()


def same(strip, whole):
    assert strip.sizes["frame"] == whole.sizes["frame"]
    assert strip.values.tobytes() == whole.values.tobytes()
    assert strip["time_s"].identical(whole["time_s"])
    assert strip["status"].identical(whole["status"])
    assert repr(StripMetadata.of(strip)) == repr(StripMetadata.of(whole))  # NaN is not itself


@pytest.mark.thorough
@pytest.mark.parametrize("name", GROWING)
def test_a_growing_film_gives_what_the_whole_one_gives(name, clock, tmp_path, frames):
    """A failure means that frames are lost, doubled or half-written where the file was opened again."""
    (tmp_path / "whole").mkdir()
    whole = GROWING[name](tmp_path / "whole" / name, frames)
    target = tmp_path / name
    if whole.with_suffix(".cih").exists():
        shutil.copy(whole.with_suffix(".cih"), tmp_path)
    strip = followed(clock, target, copy_slowly, whole, target)
    shutil.copy(whole, target)
    same(strip, strip_profile(open_video(target), ROWS))
    assert strip.sizes["frame"] == COUNT


def test_a_growing_folder_gives_what_the_whole_one_gives(clock, tmp_path, frames):
    """A failure means that images which came out of order count as lost."""
    strip = followed(clock, tmp_path, write_images, frames, tmp_path)
    same(strip, strip_profile(open_video(tmp_path), ROWS))
    assert (strip["status"] == "ok").all()


def test_it_ends_when_told_with_what_there_is_and_says_so(clock, tmp_path, frames):
    """A failure means that Ctrl-C loses the run, or that a part of a film passes for all of it."""
    whole = write_avi(tmp_path / "whole.avi", frames)
    follow = Follow(seen=lambda last, behind: follow.stop.set())
    film = tmp_path / "a.avi"
    strip = followed(clock, film, copy_slowly, whole, film, follow.stop, follow=follow)
    assert 0 < strip.sizes["frame"] < COUNT
    last = strip.sizes["frame"] - 1
    assert any(f"followed up to frame {last};" in line for line in StripMetadata.of(strip).warnings)


def test_the_last_frames_can_be_looked_at_meanwhile(clock, tmp_path, frames):
    """A failure means that the live state shows other frames than the last."""
    whole, seen, first = write_avi(tmp_path / "whole.avi", frames), [], threading.Event()

    def look(last, behind):
        seen.append(last(10))
        first.set()

    film = tmp_path / "a.avi"
    strip = followed(clock, film, copy_slowly, whole, film, first, follow=Follow(seen=look))
    assert len(seen) >= 2
    assert seen[-1].values.tobytes() == strip.values[-10:].tobytes()
    for one in seen:
        at = one["frame"].values
        assert one.values.tobytes() == strip.values[at].tobytes()


def test_a_film_that_shows_nothing_for_a_while_is_followed_further(clock, tmp_path, frames):
    """A failure means that a run ends in the middle of the test because the light was off."""
    dark, nothing = frames.copy(), threading.Event()
    dark[40:160] = 0

    def look(last, behind):
        if (last(10)["status"] == "blank").all():
            nothing.set()

    film = tmp_path / "a.avi"
    whole = write_avi(tmp_path / "whole.avi", dark)
    strip = followed(clock, film, copy_slowly, whole, film, nothing, follow=Follow(seen=look))
    assert nothing.is_set()
    same(strip, strip_profile(open_video(film), ROWS))


def test_a_part_of_a_film_is_followed_to_its_end(clock, tmp_path, frames):
    """A failure means that `frames` is forgotten, or waits for the camera to end."""
    whole = write_avi(tmp_path / "whole.avi", frames)
    how = {"frames": slice(10, 60)}
    strip = followed(clock, tmp_path / "a.avi", copy_slowly, whole, tmp_path / "a.avi", **how)
    assert (strip["frame"].values[0], strip["frame"].values[-1]) == (10, 59)


def test_a_film_that_is_rewritten_is_one_line(clock, tmp_path, frames):
    """A failure means that frames of two recordings are joined."""
    path, seen = write_avi(tmp_path / "a.avi", frames[:100]), threading.Event()
    follow = Follow(seen=lambda last, behind: seen.set())

    def rewrite():
        assert seen.wait(PATIENCE_S)
        other = write_avi(tmp_path / "b.avi", frames[::-1])
        path.write_bytes(other.read_bytes())  # the same file with other frames

    with pytest.raises(InputError, match="only grows while it is followed"):
        followed(clock, path, rewrite, follow=follow)


def test_what_never_becomes_a_film_is_refused(clock, tmp_path):
    """A failure means that a wrong name waits for ever, or that an old file is waited for."""
    path, tried = tmp_path / "a.avi", []

    def opened():
        tried.append(clock.monotonic())
        assert len(tried) < 2000
        return open_video(path)

    with pytest.raises(InputError):
        await_video(path, opened, Follow(), QUICK)
    assert tried[-1] - tried[0] > 0.9 * QUICK.follow_give_up_s
    path.write_bytes(b"no film")
    os.utime(path, (0, 0))
    tried.clear()
    with pytest.raises(InputError):
        await_video(path, opened, Follow(), QUICK)
    assert len(tried) == 1


@pytest.mark.parametrize("sizes", [[3], [8], [9], [5, 5, 5], [1] * 20, [30, 2, 2], [2, 30]])
def test_the_last_frames_are_held_back(sizes):
    """A failure means that a half-written frame is taken, or that whole ones are left out."""
    starts = np.cumsum([0, *sizes])
    blocks = [
        Block(np.full((n, 1, 1), 0), int(start), ("ok",) * n) for n, start in zip(sizes, starts, strict=False)
    ]
    kept = [block.start + n for block in held_back(iter(blocks), 8) for n in range(len(block.status))]
    assert kept == list(range(max(0, sum(sizes) - 8)))


def test_what_cannot_be_read_until_it_is_closed_is_waited_for_and_told(clock, tmp_path, frames):
    """A failure means that an MP4 is refused while the camera writes it, or that nobody knows what is waited
    for."""
    whole = GROWING["h264.mp4"](tmp_path / "whole.mp4", frames).read_bytes()
    film, said, told = tmp_path / "a.mp4", [], threading.Event()
    film.write_bytes(whole[: len(whole) // 2])

    def tell(reason):
        said.append(reason)
        told.set()

    def close():
        assert told.wait(PATIENCE_S)
        film.write_bytes(whole)

    strip = followed(clock, film, close, follow=Follow(waiting=tell))
    assert strip.sizes["frame"] == COUNT
    assert len(said) == 1
    assert "index (moov), which is written when the recording is closed" in said[0]
