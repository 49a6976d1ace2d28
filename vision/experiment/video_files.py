"""Writing the frames of a synthetic test to a video file of any container the program reads."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

import av
import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from vision.errors import InputError
from vision.experiment.mechanics import FrameTimes
from vision.experiment.settings import Camera
from vision.numeric import Pixels

Blocks = Iterator[Pixels]
Writer = Callable[[Path, Blocks, Camera, FrameTimes], None]


def write_video(folder: Path, blocks: Blocks, camera: Camera, times: FrameTimes, *, container: str) -> Path:
    """Write every frame to folder/video.* and return its path.

    Parameters
    ----------
    folder
        An existing folder.
    blocks
        From `frame_blocks`.
    camera, times
        For the frame rate, the depth and the numbers of lost frames.
    container
        raw (Y800 AVI), mjpeg (AVI), h264 (MP4), ffv1 (Matroska, 8 to 16 bit), tiff (BigTIFF where large) or
        png (numbered files, lost frames leave gaps). Only ffv1 keeps the times of lost frames; the others
        run on.

    Raises
    ------
    InputError
        As `check_container`.

    Notes
    -----
    The h264 encoder gives the same bytes again only where both sides are multiples of 16: elsewhere its
    padding is not defined and decoded pixels differ by a level or so.
    """
    check_container(container, camera)
    name, write, _ = _CONTAINERS[container]
    path = folder / name
    write(path, blocks, camera, times)
    return path


def check_container(container: str, camera: Camera) -> None:
    """InputError for an unknown container, one too shallow for the camera's bits, or odd sides in h264."""
    if container not in _CONTAINERS:
        raise InputError("`container`", ", ".join(_CONTAINERS), container)
    bits = _CONTAINERS[container][2]
    if camera.bits > bits:
        advice = "use ffv1, tiff or png"
        raise InputError("`container`", f"at most {bits} bits in {container}", f"{camera.bits} bits", advice)
    if container == "h264" and (camera.width % 2 or camera.height % 2):
        raise InputError("`container`", "even width and height in h264", f"{camera.width} x {camera.height}")


def _raw(path: Path, blocks: Blocks, camera: Camera, times: FrameTimes) -> None:
    """Uncompressed AVI."""
    with RawAviWriter(path, width=camera.width, height=camera.height, fps=camera.fps) as writer:
        for block in blocks:
            for frame in block:
                writer.write(frame)


def _encoded(
    path: Path, blocks: Blocks, camera: Camera, times: FrameTimes, *, codec: str, layout: str
) -> None:
    """Any PyAV codec; `layout` is the pixel format of the stream."""
    options = {"libx264": {"crf": "12", "preset": "fast"}, "ffv1": {"level": "3", "slices": "4"}}.get(
        codec, {}
    )
    rate = Fraction(camera.fps).limit_denominator(1000)
    with av.open(str(path), "w") as file:
        stream: Any = file.add_stream(codec, rate=rate, options=options)
        stream.width, stream.height, stream.pix_fmt = camera.width, camera.height, layout
        if codec == "libx264":
            stream.codec_context.thread_count = 1  # more threads, another stream each time
        if codec == "mjpeg":
            stream.codec_context.qmin = stream.codec_context.qmax = 2
            stream.codec_context.color_range = 2
        stream.codec_context.time_base = 1 / rate
        numbers = iter(times.exposed if codec == "ffv1" else range(len(times.exposed)))
        for block in blocks:
            for pixels in block:
                frame = _av_frame(pixels, layout)
                frame.pts, frame.time_base = int(next(numbers)), 1 / rate
                file.mux(stream.encode(frame))
        file.mux(stream.encode(None))


def _av_frame(pixels: Pixels, layout: str) -> Any:
    """The grey values as a PyAV frame: exactly in grey layouts and in full-range YUV, scaled in h264's
    range."""
    if layout == "yuv420p":
        pixels = np.rint(16 + pixels * (219 / 255)).astype(np.uint8)
    if layout in ("gray", "gray16le"):
        return av.VideoFrame.from_ndarray(pixels, layout)
    frame = av.VideoFrame(pixels.shape[1], pixels.shape[0], layout)
    _fill(frame.planes[0], pixels)
    for colour in frame.planes[1:]:
        colour.update(bytes([128]) * colour.buffer_size)
    return frame


def _fill(plane: Any, pixels: Pixels) -> None:
    """Copy grey values into a plane whose rows may be longer than the picture's."""
    rows, columns = pixels.shape
    values = np.zeros((rows, plane.line_size // pixels.itemsize), pixels.dtype)
    values[:, :columns] = pixels
    plane.update(values.tobytes())


def _mjpeg(path: Path, blocks: Blocks, camera: Camera, times: FrameTimes) -> None:
    """Motion JPEG at the best quality."""
    _encoded(path, blocks, camera, times, codec="mjpeg", layout="yuvj420p")


def _h264(path: Path, blocks: Blocks, camera: Camera, times: FrameTimes) -> None:
    """H.264 in limited range, as cameras write it."""
    _encoded(path, blocks, camera, times, codec="libx264", layout="yuv420p")


def _ffv1(path: Path, blocks: Blocks, camera: Camera, times: FrameTimes) -> None:
    """Lossless, in the shallowest layout that holds the bits."""
    layout = {8: "gray", 10: "gray10le", 12: "gray12le"}.get(camera.bits, "gray16le")
    _encoded(path, blocks, camera, times, codec="ffv1", layout=layout)


def _tiff(path: Path, blocks: Blocks, camera: Camera, times: FrameTimes) -> None:
    """One multi-page TIFF."""
    size = camera.width * camera.height * (1 if camera.bits == 8 else 2) * len(times.exposed)
    with tifffile.TiffWriter(path, bigtiff=size > 3 << 30) as file:
        for block in blocks:
            for frame in block:
                file.write(frame, photometric="minisblack", contiguous=True)


def _png(path: Path, blocks: Blocks, camera: Camera, times: FrameTimes) -> None:
    """Numbered files in a folder."""
    path.mkdir()
    numbers = iter(times.exposed)
    for block in blocks:
        for frame in block:
            done, data = cv2.imencode(".png", frame)
            if not done:
                raise OSError(f"{path}: a frame could not be encoded as PNG")
            (path / f"frame_{next(numbers):06d}.png").write_bytes(data.tobytes())


_CONTAINERS: dict[str, tuple[str, Writer, int]] = {
    "raw": ("video.avi", _raw, 8),
    "mjpeg": ("video.avi", _mjpeg, 8),
    "h264": ("video.mp4", _h264, 8),
    "ffv1": ("video.mkv", _ffv1, 16),
    "tiff": ("video.tif", _tiff, 16),
    "png": ("video", _png, 16),
}


# --- uncompressed AVI ---------------------------------------------------------------------------------------

_SEGMENTS = 256  # for which there is space in the header: 256 GiB


class RawAviWriter:
    """Write (row, column) uint8 frames to a Y800 AVI; use as a context manager.

    Rows are padded to 4 bytes, the first row is the top one. segment_bytes bounds each RIFF part.
    """

    def __init__(
        self, path: Path, *, width: int, height: int, fps: float, segment_bytes: int = 1 << 30
    ) -> None:
        self._file: BinaryIO = path.open("wb")
        self._width, self._height = width, height
        self._rate = Fraction(fps).limit_denominator(1_000_000)
        self._stride = (width + 3) // 4 * 4
        self._segment_bytes = segment_bytes
        self._segments: list[tuple[int, int, int]] = []
        """Offset and size of each segment's index chunk, and its frames."""
        self._offsets: list[int] = []
        self._first_count = self._first_bytes = 0
        self._write_header(0)
        self._riff_at, self._movi_at = 0, self._open_movi()

    def __enter__(self) -> RawAviWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self._close_segment()
                self._file.seek(0)
                self._write_header(sum(frames for _, _, frames in self._segments))
        finally:
            self._file.close()

    def write(self, frame: NDArray[np.uint8]) -> None:
        """Append one frame."""
        size = self._stride * self._height
        if self._offsets and self._file.tell() - self._riff_at + size > self._segment_bytes:
            self._close_segment()
            if len(self._segments) == _SEGMENTS:
                raise OSError(f"a raw AVI holds at most {_SEGMENTS} parts; use ffv1 or tiff")
            self._riff_at = self._file.tell()
            self._file.write(b"RIFF\0\0\0\0AVIX")
            self._movi_at = self._open_movi()
        padded = np.zeros((self._height, self._stride), np.uint8)
        padded[:, : self._width] = frame
        self._offsets.append(self._file.tell() + 8)
        self._file.write(struct.pack("<4sI", b"00db", size) + padded.tobytes())

    def _open_movi(self) -> int:
        """Begin a list of frames; its place in the file."""
        at = self._file.tell()
        self._file.write(b"LIST\0\0\0\0movi")
        return at

    def _close_segment(self) -> None:
        """Write the segment's indexes and fill in its sizes."""
        size, frames = self._stride * self._height, len(self._offsets)
        index_at = self._file.tell()
        base = self._movi_at
        entries = np.empty((frames, 2), "<u4")
        entries[:, 0], entries[:, 1] = np.array(self._offsets, np.int64) - base, size
        body = struct.pack("<HBBI4sQI", 2, 0, 1, frames, b"00db", base, 0) + entries.tobytes()
        self._file.write(struct.pack("<4sI", b"ix00", len(body)) + body)
        self._segments.append((index_at, len(body) + 8, frames))
        movi_end = self._file.tell()
        if self._riff_at == 0:
            self._write_idx1(size)
            self._first_count, self._first_bytes = frames, self._file.tell() - 8
        end = self._file.tell()
        self._fill_in(self._movi_at + 4, movi_end - self._movi_at - 8)
        self._fill_in(self._riff_at + 4, end - self._riff_at - 8)
        self._file.seek(end)
        self._offsets = []

    def _fill_in(self, at: int, value: int) -> None:
        """Write a size that was not known before."""
        self._file.seek(at)
        self._file.write(struct.pack("<I", value))

    def _write_idx1(self, size: int) -> None:
        """The index of AVI 1.0, for readers that know no OpenDML."""
        kind = np.dtype([("id", "S4"), ("flags", "<u4"), ("at", "<u4"), ("size", "<u4")])
        table = np.zeros(len(self._offsets), kind)
        table["id"], table["flags"], table["size"] = b"00db", 0x10, size
        table["at"] = np.array(self._offsets, np.int64) - 8 - (self._movi_at + 8)
        self._file.write(struct.pack("<4sI", b"idx1", table.nbytes) + table.tobytes())

    def _write_header(self, frames: int) -> None:
        """The header, with the counts and sizes known so far."""
        size = self._stride * self._height
        rate, scale = self._rate.numerator, self._rate.denominator
        first = self._first_count or frames
        main = struct.pack(
            "<14I",
            *(round(1e6 * scale / rate), 0, 0, 0x10, first, 0, 1, size, self._width, self._height),
            *(0, 0, 0, 0),
        )
        stream = struct.pack(
            "<4s4sIHHIIIIIIIIHHHH",
            *(b"vids", b"Y800", 0, 0, 0, 0, scale, rate, 0, frames, size, 0xFFFFFFFF, 0),
            *(0, 0, self._width, self._height),
        )
        picture = struct.pack("<IiiHH4sIiiII", 40, self._width, self._height, 1, 8, b"Y800", size, 0, 0, 0, 0)
        stream_list = (
            _chunk(b"strh", stream) + _chunk(b"strf", picture) + _chunk(b"indx", self._super_index())
        )
        extended = _list(b"odml", _chunk(b"dmlh", struct.pack("<I", frames).ljust(248, b"\0")))
        header = _list(b"hdrl", _chunk(b"avih", main) + _list(b"strl", stream_list) + extended)
        self._file.write(struct.pack("<4sI4s", b"RIFF", self._first_bytes, b"AVI ") + header)

    def _super_index(self) -> bytes:
        """OpenDML's index of the segments' indexes, padded to its full size."""
        head = struct.pack("<HBBI4sIII", 4, 0, 0, len(self._segments), b"00db", 0, 0, 0)
        rows = b"".join(struct.pack("<QII", *segment) for segment in self._segments)
        return (head + rows).ljust(24 + 16 * _SEGMENTS, b"\0")


def _chunk(name: bytes, body: bytes) -> bytes:
    """A RIFF chunk."""
    return struct.pack("<4sI", name, len(body)) + body


def _list(name: bytes, body: bytes) -> bytes:
    """A RIFF list."""
    return struct.pack("<4sI4s", b"LIST", len(body) + 4, name) + body
