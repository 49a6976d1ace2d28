"""Compressed video: all that FFmpeg decodes; of motion JPEG only the grey plane, on all cores."""

from __future__ import annotations

import contextlib
import itertools
import math
import re
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any, cast

import av
import av.bitstream
import av.container
import av.error
import av.logging
import numpy as np
import simplejpeg
from av.video.frame import PictureType

from vision.errors import InputError
from vision.files import MOST_PIXELS, check_pixels, check_regular, in_threads
from vision.numeric import Ints, Pixels
from vision.video.reader import (
    AS_STORED,
    LUMA_RULE,
    OVERLAY_COMMENT,
    Block,
    Facts,
    Frame,
    full_scale,
    gather_blocks,
    luma,
    shape_text,
)

# Metadata that are not UTF-8 do not matter here. PyAV from 19 on always replaces them and has no such option.
_TOLERANT: dict[str, Any] = {"metadata_errors": "replace"} if int(av.__version__.split(".")[0]) < 19 else {}
# Formats that cameras, microscopes and their programs write: no playlists, lists of files or networks.
_FORMATS = (
    "avi,mov,matroska,webm,asf,flv,mpeg,mpegts,mpegvideo,h264,hevc,m4v,mjpeg,mjpeg_2000,mxf,nut,ogg,cine,ivf,dv,"
    "wtv,yuv4mpegpipe,gif,apng,av1,obu,vc1,rm,swf,gxf,nsv,mpjpeg,r3d,bink,smjpeg"
)
_RAW = {"mjpeg", "h264", "hevc", "m4v", "mpegvideo", "obu", "vc1"}  # pictures alone, without a container
_CONTAINERS = {".avi", ".mp4", ".mkv", ".mov"}
_MOST_HELD = 32  # frames in memory at once; H.264 and HEVC have at most 16 B-frames in a row
_FRAMES_WITH_STEPS = 12  # the quantiser of the first predicted frames is that of the film to 2 of 51 levels
EXPORT_QUANTISERS = {"export_side_data": "venc_params"}
"""Option of FFmpeg's decoders for `block_quantisers`."""
_H263 = {"mpeg4", "h263", "flv1", "wmv1", "wmv2", "msmpeg4v1", "msmpeg4v2", "msmpeg4v3"}
_STEPS_STATED = _H263 | {"mpeg1video", "mpeg2video"}  # of these FFmpeg reports the step itself
_H263_ROUNDS = 1.4  # steps: its quantiser also leaves changes beyond a step uncoded
_FIRST_LEVEL = re.compile(r" init_qp_minus26 .*= (-?\d+)")
_SLICE = re.compile(r" (slice_type|slice_qp_delta) .*= (-?\d+)")
_PREDICTED = "1"  # type of a slice that is predicted from frames before
_RESTART = re.compile(rb"\xff([\xd0-\xd7])")


@dataclass(frozen=True, kw_only=True)
class EncodedReader:
    """One video stream of a container, decoded frame by frame by FFmpeg.

    A packet that cannot be decoded gives a "corrupt" frame, and so do frames predicted from it; a number that
    the container skips gives a "lost" frame.  Raises: InputError while reading, if a frame has another size
    than the first.
    """

    path: Path
    facts: Facts
    dtype: np.dtype[np.generic]  # of the decoded pixels
    # of an AVI, which has no times and skips the numbers of frames that the camera dropped; None for others
    fixed_rate: Fraction | None
    size: int  # of the file when it was opened; what is written later is not read
    shift: int = 0  # bits by which FFmpeg widens the pixels of a packed cine, and which are taken back

    @classmethod
    def of(cls, path: Path) -> EncodedReader:
        """Open a file and decode its first frame; InputError if nothing in it can be decoded."""
        with _video_stream(path) as stream:
            stream.thread_type = "NONE"  # with threads FFmpeg decodes several frames before it returns one
            stream.codec_context.options = EXPORT_QUANTISERS
            first = next((frame for _, frame in _decoded(stream) if frame is not None), None)
            if first is None:
                found = f"none (codec {stream.codec_context.name})"
                raise InputError(path, "a video with at least one readable frame", found)
            kind, warnings = stream.container.format.name, []
            if _ends_early(path):
                warnings.append(f"{path.name}: the file was cut short; its last frames are missing")
            if kind in _RAW and path.suffix.lower() in _CONTAINERS:
                what = "the beginning of the file is missing or damaged, and with it the header"
                why = "earlier frames and the frame rate are lost: copy the file again, or give `fps`"
                warnings.append(f"{path.name}: {what}; {why}")
            if stream.container.metadata.get("comment") == OVERLAY_COMMENT:
                what = "an overlay, on which the tracks of a run are drawn"
                warnings.append(f"{path.name}: {what}: give the film that was recorded instead")
            if first.interlaced_frame:
                what = "odd and even rows are half a frame apart, which blurs moving ridges"
                warnings.append(f"{path.name}: the film is interlaced: {what}")
            size = path.stat().st_size
            facts = _facts(stream, first, size)
            step = _quantiser_step(stream, facts)
            facts = replace(facts, quantiser_step=step, warnings=tuple(warnings))
            return cls(
                path=path,
                facts=facts,
                dtype=grey_plane(first).dtype.newbyteorder("="),
                fixed_rate=stream.average_rate if kind == "avi" else None,
                size=size,
            )

    def read(self, start: int, stop: int | None, rows: slice, columns: slice) -> Iterator[Block]:
        """Yield frames in file order; those before `start` are decoded, too, as codecs need them."""
        frames = itertools.islice(self._frames(), start, stop)
        yield from gather_blocks(frames, start=start, rows=rows, columns=columns, dtype=self.dtype)

    def sample(self, numbers: Sequence[int]) -> Iterator[Pixels]:
        """Yield the key frame at or before each number, each only once, without decoding other frames."""
        packets: list[av.Packet[av.VideoStream]] = []
        with _video_stream(self.path) as stream:
            rate = self.facts.playback_fps or 1 / float(stream.time_base or 1)
            for number in numbers:
                if _enter(stream, number / rate, stream.start_time or 0):
                    packet = next(_video_packets(stream))
                    seen = [other.pos for other in packets if other.pos is not None]
                    if packet is not None and packet.pos not in seen:
                        packets.append(packet)
            for packet in (*packets, None):
                frames = _frames_of(packet, stream)  # several packets at once, in threads
                if packet is not None and _reorders(stream):  # it would wait for frames displayed before it
                    frames = (frames or _frames_of(None, stream))[:1]
                    stream.codec_context.flush_buffers()
                yield from (self._checked(grey_plane(frame)) for frame in frames)

    def from_key_frame(self, time_s: float) -> Iterator[tuple[float, Pixels]]:
        """Yield readable frames with the container's times, from the key frame at or before `time_s` on.

        Yield none if the file has no entry there, or no times in the order of display.
        """
        with _video_stream(self.path) as stream:
            first = stream.start_time or 0
            if not _enter(stream, time_s, 0 if self.facts.times_in_blocks else first):
                return
            for pts, frame in _decoded(stream):
                if pts is None:
                    return
                if frame is not None and not frame.is_corrupt:
                    yield float((pts - first) * (stream.time_base or 1)), self._checked(grey_plane(frame))

    def _frames(self) -> Iterator[Frame]:
        """Yield every frame number once, in order."""
        number = 0
        with _video_stream(self.path) as stream:
            for pts, decoded in _undamaged(_decoded(stream, self.size)):
                for _ in range(self._skipped(pts, number, stream)):
                    yield Frame(None, "lost")
                    number += 1
                time_s = self._time_s(pts, stream)
                if decoded is None:
                    yield Frame(None, "corrupt", time_s)
                else:
                    yield Frame(self._checked(grey_plane(decoded)), "ok", time_s)
                number += 1

    def _time_s(self, pts: int | None, stream: av.VideoStream) -> float | None:
        if not self.facts.times_in_blocks or pts is None or stream.time_base is None:
            return None
        return float(pts * stream.time_base)

    def _skipped(self, pts: int | None, number: int, stream: av.VideoStream) -> int:
        """Return how many frames a fixed-rate container skips before this one; 0 for an impossible number."""
        if self.fixed_rate is None or pts is None or stream.time_base is None:
            return 0
        place = round(pts * stream.time_base * self.fixed_rate)
        most = max(self.facts.frames or 0, self.size // 8)  # a dropped frame takes 8 bytes
        return max(0, place - number) if place < most else 0

    def _checked(self, pixels: Pixels) -> Pixels:
        if pixels.shape != self.facts.shape:
            wanted, found = shape_text(self.facts.shape), shape_text(pixels.shape)
            raise InputError(self.path, f"every frame {wanted}", f"one of {found}", "split the recording")
        return np.right_shift(pixels, self.shift) if self.shift else pixels


class MjpegReader(EncodedReader):
    """Reads the same facts and frames as `EncodedReader`, twice as fast.

    libjpeg-turbo decodes only the Y plane, and of a JPEG with restart markers only the wanted rows. It rounds
    differently from FFmpeg in one pixel of a hundred, by one grey level; `open_encoded` checks that there is
    no larger difference. Damage in what is decoded gives a "corrupt" frame.
    """

    def read(self, start: int, stop: int | None, rows: slice, columns: slice) -> Iterator[Block]:
        """Yield frames in file order; those before `start` are not decoded."""
        with _video_stream(self.path) as stream:
            jpegs = itertools.islice(self._jpegs(stream), start, stop)
            frames = in_threads(partial(self._decode, rows=rows), jpegs)
            decoded = slice(0, rows.stop - rows.start)
            yield from gather_blocks(frames, start=start, rows=decoded, columns=columns, dtype=np.uint8)

    def _jpegs(self, stream: av.VideoStream) -> Iterator[tuple[bytes, float | None]]:
        """Yield (JPEG, its own time) for every frame number; no bytes for a frame that the camera dropped."""
        number = 0
        for packet in _video_packets(stream, self.size):
            if packet is None:
                return
            for _ in range(self._skipped(packet.pts, number, stream)):
                yield b"", None
                number += 1
            yield bytes(packet), self._time_s(packet.pts, stream)
            number += 1

    def _decode(self, jpeg: tuple[bytes, float | None], rows: slice) -> Frame:
        """Return these rows of a JPEG."""
        data, time_s = jpeg
        if not data:
            return Frame(None, "lost", time_s)
        part, first = data, 0
        with contextlib.suppress(IndexError, ZeroDivisionError):  # a damaged header
            part, first = _part_of_jpeg(data, rows, self.facts.shape)
        pixels = _y_plane(part)
        if pixels is None:
            return Frame(None, "corrupt", time_s)
        if part is data:  # a part is made only of a picture of the right size
            self._checked(pixels)
        return Frame(pixels[rows.start - first : rows.stop - first], "ok", time_s)


def open_encoded(path: Path) -> EncodedReader:
    """Return an `MjpegReader` if its first frame is FFmpeg's up to rounding, else an `EncodedReader`.

    Other codecs, interlaced or lossless JPEG and JPEG in RGB are decoded by FFmpeg.
    """
    reader = EncodedReader.of(path)
    if reader.facts.codec != "mjpeg" or reader.facts.depth_bits != 8:
        return reader
    with _video_stream(path) as stream:
        stream.thread_type = "NONE"
        packet = next(_video_packets(stream))
        fast = None if packet is None else _y_plane(bytes(packet))
        slow = [grey_plane(frame) for frame in _frames_of(packet, stream)]
        if fast is None or not slow or slow[0].shape != fast.shape:
            return reader
        furthest = np.abs(fast.astype(np.int16) - slow[0].astype(np.int16)).max()
    if furthest > 1:
        return reader
    return MjpegReader(**vars(reader) | {"facts": replace(reader.facts, decoder="libjpeg-turbo")})


def _part_of_jpeg(jpeg: bytes, rows: slice, shape: tuple[int, int]) -> tuple[bytes, int]:
    """Return a JPEG of the rows around `rows` alone, and the number of its first row.

    Rows can be decoded without those above them if restart markers separate them, which FFmpeg and many
    cameras write after every row of blocks. Without such markers, if some are missing or out of order, or if
    the picture has not this shape, the whole JPEG is returned.
    """
    whole = jpeg, 0
    size_at, interval, at = 0, 0, 2
    while (kind := jpeg[at : at + 2]) != b"\xff\xda":  # the header ends where the scan starts
        if kind == b"\xff\xc0":
            size_at = at + 5  # height, width, number of colours, and of each colour three bytes
        elif kind == b"\xff\xdd":
            interval = int.from_bytes(jpeg[at + 4 : at + 6], "big")
        elif kind[:1] != b"\xff":
            return whole
        at += 2 + int.from_bytes(jpeg[at + 2 : at + 4], "big")
    start = at + 2 + int.from_bytes(jpeg[at + 2 : at + 4], "big")
    height, width = (int.from_bytes(jpeg[size_at + k : size_at + k + 2], "big") for k in (0, 2))
    colours = jpeg[size_at + 4]
    if not (size_at and interval) or (height, width) != shape or jpeg[at + 4] != colours:
        return whole  # also where each colour has its own scan
    sampling = jpeg[size_at + 6 : size_at + 5 + 3 * colours : 3] if colours > 1 else b"\x11"
    across = -(-width // (8 * max(factors >> 4 for factors in sampling)))  # blocks
    part_rows = interval // across * 8 * max(factors & 15 for factors in sampling)
    pieces = _RESTART.split(jpeg[start:])
    parts, numbers = pieces[::2], b"".join(pieces[1::2])
    if interval % across or numbers != bytes(0xD0 + n % 8 for n in range(-(-height // part_rows) - 1)):
        return whole
    first, last = rows.start // part_rows, -(-rows.stop // part_rows)
    scan = parts[first]
    for number, part in enumerate(parts[first + 1 : last]):
        scan += bytes([255, 0xD0 + number % 8]) + part
    lines = min(height, last * part_rows) - first * part_rows
    header = jpeg[:size_at] + lines.to_bytes(2, "big") + jpeg[size_at + 2 : start]
    return header + scan + b"\xff\xd9", first * part_rows


def _y_plane(jpeg: bytes) -> Pixels | None:
    """Return grey (rows, columns) of one JPEG; None if it is damaged."""
    try:
        return np.asarray(simplejpeg.decode_jpeg(jpeg, colorspace="GRAY"))[..., 0]
    except ValueError:
        return None


def open_container(path: Path) -> av.container.InputContainer:
    """Open a container, restricted to the formats and the protocol that are allowed.

    Raises InputError for any other file.
    """
    check_regular(path, "a video")
    try:
        container: av.container.InputContainer = av.open(
            f"file:{path}",  # else a colon in a name, as in a time, would be read as a protocol
            options={
                "protocol_whitelist": "file",
                "format_whitelist": _FORMATS,
                "max_pixels": str(MOST_PIXELS),
            },
            **_TOLERANT,
        )
    except (av.error.FFmpegError, OSError):
        with path.open("rb") as file:
            head = file.read(12)
        if head[4:8] in (b"ftyp", b"mdat", b"free", b"wide"):
            found = "an MP4/MOV without its index (moov), which is written when the recording is closed"
            advice = "close it, or repair it from an intact one"
        else:
            found = "another kind of file, or a damaged one"
            advice = "give a film (AVI, MP4, MKV, MOV, cine, mraw), a TIFF or images"
        raise InputError(path, "a video", found, advice) from None
    return container


@contextlib.contextmanager
def _video_stream(path: Path) -> Iterator[av.VideoStream]:
    """Open a film and yield its video stream, set to decode on all cores; InputError if it has none."""
    with open_container(path) as container:
        if not container.streams.video:
            raise InputError(path, "a video stream", "none (sound or data only)")
        stream = container.streams.video[0]
        if getattr(stream, "codec_context", None) is None:
            advice = "convert the video to FFV1 or raw AVI"
            raise InputError(path, "a codec FFmpeg knows", "an unknown one", advice)
        if stream.codec_context.width and stream.codec_context.height:
            check_pixels(path, stream.codec_context.height, stream.codec_context.width)
        stream.thread_type = "AUTO"
        yield stream


def _ends_early(path: Path) -> bool:
    """Return whether the file is shorter than the size that its Matroska segment states.

    Recorders that do not close their file leave that size unknown, all ones.
    """
    with path.open("rb") as file:
        head = file.read(4096)
    if head[:4] != b"\x1a\x45\xdf\xa3":
        return False
    length, at = _vint(head, 4)
    at += length or 0
    if length is None or head[at : at + 4] != b"\x18\x53\x80\x67":
        return False
    length, at = _vint(head, at + 4)
    return length is not None and at + length > path.stat().st_size


def _vint(data: bytes, at: int) -> tuple[int | None, int]:
    """Return a Matroska length, None if unknown or absent, and the position after it."""
    size = 9 - data[at].bit_length() if at < len(data) and data[at] else 0
    value = int.from_bytes(data[at : at + size], "big") & ((1 << 7 * size) - 1)
    known = size and at + size <= len(data) and value != (1 << 7 * size) - 1
    return (value if known else None), at + size


def _facts(stream: av.VideoStream, first: av.VideoFrame, size: int) -> Facts:
    """Return the facts of a file; it cannot hold more frames than bytes."""
    container, rate = cast("av.container.InputContainer", stream.container), stream.average_rate
    kinds = container.format.name.split(",")
    # MP4 has a table with the time of every frame, in which phones write the camera's own: uneven ones
    stamped = "matroska" in kinds or ("mov" in kinds and _is_uneven(stream))
    duration_s = None if container.duration is None else container.duration / av.time_base
    depth_bits, saturation_level, grey = _grey_scale(first)
    estimated = round(duration_s * float(rate)) if rate and duration_s else 0
    return Facts(
        shape=(first.height, first.width),
        depth_bits=depth_bits,
        saturation_level=saturation_level,
        declared_frames=stream.frames if 0 < stream.frames <= size else None,
        container=container.format.name,
        codec=stream.codec_context.codec.canonical_name,  # the name is the decoder's: libdav1d for AV1
        pixel_format=first.format.name,
        decoder="FFmpeg",
        grey=grey,
        estimated_frames=estimated if 0 < estimated <= size else None,
        duration_s=duration_s if stamped else None,
        playback_fps=float(rate) if rate else None,
        times_in_blocks=stamped,
        turned_deg=-90 * round(first.rotation / 90) % 360,
    )


def _quantiser_step(stream: av.VideoStream, facts: Facts) -> float:
    """Return the median step, grey levels, of the next frames that are predicted from frames before them.

    0 if there are none, or nothing states their quantisers. The step is that of a transform that keeps the
    sum of squares. That of H.264 and HEVC doubles with every 6 levels and is 1 at level 4; levels of HEVC's
    slices are those of 8 bits.
    """
    codec, levels = facts.codec, _slice_levels(stream) if facts.codec == "hevc" else []
    if levels:  # blocks have finer steps than their slice with x265, those that hardly change half of it
        return float(2.0 ** (facts.depth_bits - 8.5 + (np.median(levels) - 4) / 6))
    if codec != "h264" and codec not in _STEPS_STATED:
        return 0.0
    steps = []
    for _, frame in itertools.islice(_decoded(stream), _FRAMES_WITH_STEPS):
        found = None if frame is None or frame.pict_type != PictureType.P else block_quantisers(frame)
        if found is not None:
            level = float(np.mean(found[1]))
            steps.append(2.0 ** ((level - 4) / 6) if codec == "h264" else level)
    return float(np.median(steps)) * (_H263_ROUNDS if codec in _H263 else 1.0) if steps else 0.0


def _slice_levels(stream: av.VideoStream) -> list[float]:
    """Return the levels of the quantiser of HEVC's next slices that are predicted from frames before them.
    The decoder does not report them, but FFmpeg logs the headers of slices."""
    before = av.logging.get_level()
    av.logging.set_level(av.logging.INFO)
    try:
        with av.logging.Capture() as lines, contextlib.suppress(av.error.FFmpegError, ValueError):
            headers = av.bitstream.BitStreamFilterContext("trace_headers", stream)
            for packet in itertools.islice(_video_packets(stream), _FRAMES_WITH_STEPS):
                headers.filter(packet)
    finally:
        av.logging.set_level(before)
    text = "\n".join(line.strip() for _, _, line in lines)
    stated = _FIRST_LEVEL.search(text)
    first = 26.0 + (float(stated[1]) if stated else 0.0)
    entries = _SLICE.findall(text)  # of each slice its type and, later, its level
    return [
        first + float(level)
        for (before, kind), (name, level) in itertools.pairwise(entries)
        if (before, kind, name) == ("slice_type", _PREDICTED, "slice_qp_delta")
    ]


def block_quantisers(frame: av.VideoFrame) -> tuple[int, Ints] | None:
    """Return the quantiser of a frame and those of its blocks, in FFmpeg's units: twice those of MPEG-2 and
    MPEG-4, four times those of VP9. None if the decoder, opened with `EXPORT_QUANTISERS`, reports none."""
    part = cast("Mapping[str, Any]", frame.side_data).get("VIDEO_ENC_PARAMS")
    if part is None:
        return None
    # unsigned nb_blocks; size_t blocks_offset, block_size; enum type; int32 qp
    blocks, first, size, _, base = struct.unpack_from("@IQQii", data := bytes(part))
    if not blocks:
        return None
    # of a block: int src_x, src_y, w, h; int32 delta_qp
    return base, base + np.ndarray((blocks,), np.int32, data, first + 16, (size,)).astype(np.int64)


def _is_uneven(stream: av.VideoStream) -> bool:
    """Return whether intervals between frames differ by a tenth of the usual one, beyond rounding: the
    container's times are then not merely a playback rate."""
    ticks = np.array([entry.timestamp for entry in stream.index_entries], np.int64)
    interval = np.diff(np.sort(ticks)).astype(np.float64)
    if interval.size < 2:
        return False
    usual = float(np.median(interval))
    return bool((np.abs(interval - usual) > max(1.5, 0.1 * usual)).any())


def _decoded(
    stream: av.VideoStream, size: float = math.inf
) -> Iterator[tuple[int | None, av.VideoFrame | None]]:
    """Yield (pts, frame) in display order; the frame is None if the decoder never returned it.

    size: see `_video_packets`.

    A packet failed to decode if a later frame was returned before its own, for every codec and number of
    threads.
    """
    waiting: list[int] = []
    # AVI has only times of decoding, which are wrong if the order of display differs
    timed = stream.container.format.name != "avi" or not _reorders(stream)
    for packet in _video_packets(stream, size):
        if timed and packet is not None and packet.pts is not None:
            waiting.append(packet.pts)
        for frame in _frames_of(packet, stream):
            if frame.pts is not None:
                overtaken = sorted(pts for pts in waiting if pts < frame.pts)
                waiting = [pts for pts in waiting if pts > frame.pts]
                yield from ((pts, None) for pts in overtaken)
            yield (frame.pts if timed else None), frame
    yield from ((pts, None) for pts in sorted(waiting))


def _undamaged(
    decoded: Iterable[tuple[int | None, av.VideoFrame | None]],
) -> Iterator[tuple[int | None, av.VideoFrame | None]]:
    """Yield (pts, frame) in display order; the frame is None if it is damaged or predicted from such a one.

    A decoder marks only the frame whose data are damaged. The damage lasts until the next key frame, and is
    in the B-frames displayed before it as well, as these are decoded after it.
    """
    held: list[tuple[int | None, av.VideoFrame | None]] = []  # B-frames whose later reference is not known
    damaged = False
    for pts, frame in decoded:
        held.append((pts, frame))
        if frame is not None and frame.pict_type == PictureType.B and len(held) < _MOST_HELD:
            continue
        own = frame is None or frame.is_corrupt
        between = damaged or own or any(other is None or other.is_corrupt for _, other in held)
        damaged = own if frame is not None and frame.key_frame else between
        yield from ((each, None if between else other) for each, other in held[:-1])
        yield pts, None if damaged else frame
        held = []
    yield from ((pts, None if damaged or frame is None or frame.is_corrupt else frame) for pts, frame in held)


def _reorders(stream: av.VideoStream) -> bool:
    """Return whether the order of display may differ from that of decoding."""
    return bool(stream.codec_context.codec.properties & 8)  # AV_CODEC_PROP_REORDER


def _video_packets(
    stream: av.VideoStream, size: float = math.inf
) -> Iterator[av.Packet[av.VideoStream] | None]:
    """Yield packets until the file ends or breaks off, then None, which flushes the decoder.

    size: bytes of the file; packets that begin further on are left out. Where a file has grown since its last
    packet was found to be cut off, FFmpeg goes on in the middle of that packet, and an AVI has no times that
    tell how many frames it misses.
    """
    container = cast("av.container.InputContainer", stream.container)
    with contextlib.suppress(av.error.FFmpegError, OSError):
        for packet in container.demux(stream):
            if (packet.pos or 0) >= size:
                break
            if packet.size:
                yield packet
    yield None


def _frames_of(packet: av.Packet[av.VideoStream] | None, stream: av.VideoStream) -> list[av.VideoFrame]:
    try:
        return list(stream.codec_context.decode(packet))
    except (av.error.FFmpegError, EOFError):
        return []


def _enter(stream: av.VideoStream, time_s: float, origin: int) -> bool:
    """Seek the key frame at or before `time_s` after `origin`; return False if there is no entry."""
    try:
        cast("av.container.InputContainer", stream.container).seek(
            int(time_s / (stream.time_base or 1)) + origin, stream=stream
        )
    except (av.error.FFmpegError, OSError):
        return False
    return True


def grey_plane(frame: av.VideoFrame) -> Pixels:
    """Return grey (rows, columns) of a decoded frame: `luma` of colour, else a view of the luma plane."""
    bits = frame.format.components[0].bits
    if _is_colour(frame.format):
        return luma(frame.to_ndarray(format="rgb48le" if bits > 8 else "rgb24"))
    frame = _with_luma_plane(frame)
    item = np.dtype("u1" if bits <= 8 else ">u2" if frame.format.is_big_endian else "<u2")
    stored = frame.planes[0]
    lines = np.frombuffer(memoryview(stored), item).reshape(-1, stored.line_size // item.itemsize)
    return lines[: frame.height, : frame.width]


def _is_colour(kind: av.VideoFormat) -> bool:
    return kind.is_rgb or kind.has_palette


def _with_luma_plane(frame: av.VideoFrame) -> av.VideoFrame:
    """Return the frame in a format whose first plane is luma alone, not packed with chroma or alpha."""
    kind = frame.format
    bits, others = kind.components[0].bits, kind.components[1:]
    alone = 8 <= bits <= 16 and all(other.plane > 0 for other in others)
    if alone:
        return frame
    depth = "" if bits <= 8 else f"{bits}le" if bits in (10, 12) else "16le"
    family = "gray" if len(others) < 2 else "yuv444p"
    # With several threads FFmpeg now and then gives eight wrong pixels of y210.
    return frame.reformat(format=family + depth, dst_color_range=frame.color_range, threads=1)


def _grey_scale(frame: av.VideoFrame) -> tuple[int, float, str]:
    """Return significant bits, value of white, and the meaning of a grey value in words."""
    if _is_colour(frame.format):
        bits = 16 if frame.format.components[0].bits > 8 else 8  # deeper colour is decoded to 16 bits
        return bits, full_scale(bits), LUMA_RULE
    kind = _with_luma_plane(frame).format
    bits = kind.components[0].bits
    if kind.name.startswith("gray"):
        return bits, full_scale(bits), AS_STORED
    if not kind.name.startswith("yuvj") and int(frame.color_range) in (0, 1):
        return bits, float(235 << (bits - 8)), "Y plane as stored, limited range (black 16, white 235 of 255)"
    return bits, full_scale(bits), "Y plane as stored"
