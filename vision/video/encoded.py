"""EncodedReader: whatever PyAV decodes: MJPEG, H.264, FFV1, cine and the rest."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path

import av
import av.container
import av.error
import numpy as np
from numpy.typing import NDArray

from vision.errors import InputError
from vision.video import grey
from vision.video.batching import Shot, in_blocks
from vision.video.source import Block, Facts

_NOT_VIDEO = {"tty", "image2", "txt"}  # containers that swallow any text or picture
_REORDERS = 8  # AV_CODEC_PROP_REORDER
_STAMPED = {"matroska", "webm"}  # containers whose times are those of each frame, not of a rate


class EncodedReader:
    """One video stream of a container, decoded frame by frame.

    A packet that cannot be decoded gives a frame "corrupt"; a number the container skips gives a frame
    "lost".
    Raises: InputError if nothing in the file can be decoded, or a frame has another size than the first.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        with open_container(path) as container:
            stream = video_stream(container, path)
            first = _first_frame(container, stream, path)
            self._dtype = grey.plane(first).dtype.newbyteorder("=")
            self.facts = _facts(container, stream, first)
            self._fixed_rate = stream.average_rate if container.format.name == "avi" else None

    def read(self, start: int, stop: int | None, rows: slice, columns: slice) -> Iterator[Block]:
        """Frames in file order; those before `start` are decoded and dropped: codecs need them."""
        shots = (shot for n, shot in enumerate(self._shots(stop)) if n >= start)
        yield from in_blocks(shots, start=start, rows=rows, columns=columns, dtype=self._dtype)

    def sample(self, numbers: Sequence[int]) -> Iterator[NDArray[np.generic]]:
        """The key frame at or before each number; each key frame once."""
        seen: set[int | None] = set()
        with open_container(self._path) as container:
            stream = video_stream(container, self._path)
            rate = self.facts.playback_fps or 1 / float(stream.time_base or 1)
            for number in numbers:
                frame = _near(container, stream, number / rate)
                if frame is not None and frame.pts not in seen:
                    seen.add(frame.pts)
                    yield self._checked(frame)

    def _shots(self, stop: int | None) -> Iterator[Shot]:
        """Every frame number once, in order, up to `stop`."""
        number = 0
        with open_container(self._path) as container:
            stream = video_stream(container, self._path)
            for pts, frame in _decoded(container, stream):
                for _ in range(self._skipped(pts, number, stream)):
                    yield Shot(None, "lost")
                    number += 1
                if stop is not None and number >= stop:
                    return
                yield self._shot(frame, pts, stream)
                number += 1

    def _time_s(self, pts: int | None, stream: av.VideoStream) -> float | None:
        if not self.facts.stamped or pts is None or stream.time_base is None:
            return None
        return float(pts * stream.time_base)

    def _shot(self, frame: av.VideoFrame | None, pts: int | None, stream: av.VideoStream) -> Shot:
        time_s = self._time_s(pts, stream)
        if frame is None or frame.is_corrupt:
            return Shot(None, "corrupt", time_s)
        return Shot(self._checked(frame), "ok", time_s)

    def _skipped(self, pts: int | None, number: int, stream: av.VideoStream) -> int:
        """Frame numbers a fixed-rate container leaves out before this one (cameras drop frames that way)."""
        if self._fixed_rate is None or pts is None or stream.time_base is None:
            return 0
        return max(0, round(pts * stream.time_base * self._fixed_rate) - number)

    def _checked(self, frame: av.VideoFrame) -> NDArray[np.generic]:
        pixels = grey.plane(frame)
        if pixels.shape != self.facts.shape:
            height, width = self.facts.shape
            found = f"one of {frame.width} x {frame.height}"
            raise InputError(self._path, f"every frame {width} x {height}", found, "split the recording")
        return pixels


def open_container(path: Path) -> av.container.InputContainer:
    """The container; InputError where it is none."""
    try:
        container = av.open(str(path))
    except (av.error.FFmpegError, OSError) as error:
        raise InputError(path, "a video", *_why_not(path, error)) from None
    if container.format.name in _NOT_VIDEO:
        container.close()
        raise InputError(path, "a video", "a text file")
    return container


def _why_not(path: Path, error: Exception) -> tuple[str, str]:
    with path.open("rb") as file:
        head = file.read(12)
    if head[4:8] in (b"ftyp", b"mdat", b"free", b"wide"):
        return (
            "an MP4/MOV without its index (moov)",
            "the recording was not closed; repair it from an intact one",
        )
    return (
        f"a file that is none ({type(error).__name__})",
        "give a recording PyAV, tifffile or OpenCV can read",
    )


def video_stream(container: av.container.InputContainer, path: Path) -> av.VideoStream:
    """The video stream, to be decoded on all cores; InputError for none or an unknown codec."""
    if not container.streams.video:
        raise InputError(path, "a video stream", "none (sound or data only)")
    stream = container.streams.video[0]
    if getattr(stream, "codec_context", None) is None:
        raise InputError(
            path, "a codec FFmpeg knows", "an unknown one", "convert the video to FFV1 or raw AVI"
        )
    stream.thread_type = "AUTO"
    return stream


def _first_frame(container: av.container.InputContainer, stream: av.VideoStream, path: Path) -> av.VideoFrame:
    """The first frame that decodes; InputError where none does."""
    for _, frame in _decoded(container, stream):
        if frame is not None:
            return frame
    codec = stream.codec_context.name
    raise InputError(path, "a video with at least one readable frame", f"none (codec {codec})")


def _facts(container: av.container.InputContainer, stream: av.VideoStream, first: av.VideoFrame) -> Facts:
    rate = stream.average_rate
    stamped = bool(_STAMPED & set(container.format.name.split(",")))
    duration_s = None if container.duration is None else container.duration / av.time_base
    return Facts(
        shape=(first.height, first.width),
        depth_bits=grey.depth_bits(first),
        saturation_level=grey.saturation_level(first),
        promised=stream.frames or None,
        about=round(duration_s * float(rate)) if rate and duration_s else None,
        playback_fps=float(rate) if rate else None,
        stamped=stamped,
        duration_s=duration_s if stamped else None,
        notes={
            "container": container.format.name,
            "codec": stream.codec_context.name,
            "pixel_format": first.format.name,
            "grey": grey.rule(first),
        },
    )


def _decoded(
    container: av.container.InputContainer, stream: av.VideoStream
) -> Iterator[tuple[int | None, av.VideoFrame | None]]:
    """(pts, frame) in display order; the frame is None where a packet's frame never came out of the decoder.

    Packets that were fed but overtaken by a later frame failed to decode: that holds for every codec and
    thread count.
    """
    waiting: list[int] = []
    timed = _has_display_times(container, stream)
    for packet in video_packets(container, stream):
        if timed and packet is not None and packet.pts is not None:
            waiting.append(packet.pts)
        for frame in _frames_of(packet, stream):
            if frame.pts is not None:
                overtaken = sorted(pts for pts in waiting if pts < frame.pts)
                waiting = [pts for pts in waiting if pts > frame.pts]
                yield from ((pts, None) for pts in overtaken)
            yield (frame.pts if timed else None), frame
    yield from ((pts, None) for pts in sorted(waiting))


def _has_display_times(container: av.container.InputContainer, stream: av.VideoStream) -> bool:
    """False where times are those of decoding: AVI knows no others; they mislead where order differs."""
    return container.format.name != "avi" or not stream.codec_context.codec.properties & _REORDERS


def video_packets(
    container: av.container.InputContainer, stream: av.VideoStream
) -> Iterator[av.Packet[av.VideoStream] | None]:
    """Packets up to where the file ends or breaks off, then None, which flushes the decoder."""
    with contextlib.suppress(av.error.FFmpegError, OSError):
        yield from (packet for packet in container.demux(stream) if packet.size)
    yield None


def _frames_of(packet: av.Packet[av.VideoStream] | None, stream: av.VideoStream) -> list[av.VideoFrame]:
    try:
        return list(stream.codec_context.decode(packet))
    except (av.error.FFmpegError, EOFError):
        return []


def _near(
    container: av.container.InputContainer, stream: av.VideoStream, time_s: float
) -> av.VideoFrame | None:
    """The first frame decoded after seeking to `time_s`; None where the file cannot be entered there."""
    base = stream.time_base or 1
    try:
        container.seek(int(time_s / base) + (stream.start_time or 0), stream=stream)
    except (av.error.FFmpegError, OSError):
        return None
    return next((frame for _, frame in _decoded(container, stream) if frame is not None), None)
