"""Uncompressed frames, read row by row; raw AVI: 8-bit grey, palettes, BGR, 10 to 16 bits in two bytes."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.errors import InputError
from vision.numeric import Ints, Pixels
from vision.video.reader import (
    AS_STORED,
    LUMA_RULE,
    Block,
    Facts,
    Status,
    frames_per_block,
    full_scale,
    luma,
    shape_text,
)

_PLAIN = {bytes(4), b"DIB ", b"RGB ", b"RAW "}
_MASKED = b"\3\0\0\0"  # masks of red, green and blue follow the header
_GREY_BITS = {
    b"Y800": 8,
    b"GREY": 8,
    b"Y8  ": 8,
    b"Y16 ": 16,
    b"Y10 ": 10,
    b"Y12 ": 12,
    b"Y1\x00\x10": 16,
    b"Y1\x00\x0e": 14,
    b"Y1\x00\x0c": 12,
    b"Y1\x00\x0a": 10,
}


@dataclass(frozen=True, kw_only=True)
class MappedReader:
    """A `Reader` of frames stored uncompressed in a file; only the wanted rows are read.

    The file is not mapped into memory: a mapped file that becomes shorter kills the process.

    Parameters
    ----------
    path, facts
        The file, and the facts from its headers.
    offsets
        Byte at which the first stored row of each frame begins, -1 for a frame that the camera lost.
    row_bytes
        From one stored row to the next.
    dtype, channels
        Type of one channel; 1, or 3 or 4 for colour.
    blue_first, bottom_up
        Whether colour is BGR; whether the lowest row is stored first.
    grey_levels
        Grey value of each stored 8-bit index of a palette; None without a palette.
    """

    path: Path
    facts: Facts
    offsets: Ints
    row_bytes: int
    dtype: np.dtype[np.generic]
    channels: int = 1
    blue_first: bool = False
    bottom_up: bool = False
    grey_levels: NDArray[np.uint8] | None = None

    def read(self, start: int, stop: int | None, rows: slice, columns: slice) -> Iterator[Block]:
        """Yield runs of equally spaced frames, each block as one strided view."""
        end = self.offsets.size if stop is None else min(stop, self.offsets.size)
        shape = (rows.stop - rows.start, columns.stop - columns.start)
        size = frames_per_block(*shape, self.dtype.itemsize * self.channels)
        for first, last in _even_runs(self.offsets, start, end):
            for at in range(first, last, size):
                yield self._block(at, min(at + size, last), rows, columns)

    def sample(self, numbers: Sequence[int]) -> Iterator[Pixels]:
        """Yield exactly these frames, whole, without those that the file does not contain."""
        height, width = self.facts.shape
        for n in numbers:
            if n < self.offsets.size and self.offsets[n] >= 0:
                yield self._block(n, n + 1, slice(0, height), slice(0, width)).pixels[0]

    def _block(self, first: int, last: int, rows: slice, columns: slice) -> Block:
        count = last - first
        if self.offsets[first] < 0:
            nothing = np.zeros((count, rows.stop - rows.start, columns.stop - columns.start), self._native)
            return Block(nothing, first, repeated("lost", count))
        return Block(self._grey(self._stored(first, last, rows)[:, :, columns]), first, repeated("ok", count))

    def _stored(self, first: int, last: int, rows: slice) -> Pixels:
        """Return frames first..last cut to rows, (k, rows, columns) or with channels last, top row first.

        Raises
        ------
        InputError
            If the file has become shorter.
        """
        height, width = self.facts.shape
        top, stop = (height - rows.stop, height - rows.start) if self.bottom_up else (rows.start, rows.stop)
        pixel = self.dtype.itemsize * self.channels
        length = (stop - top - 1) * self.row_bytes + width * pixel  # the file may end with the last pixel
        raw = np.empty((last - first, (stop - top) * self.row_bytes), np.uint8)
        with self.path.open("rb", buffering=0) as file:
            for place, frame in zip(self.offsets[first:last].tolist(), raw, strict=True):
                file.seek(place + top * self.row_bytes)
                read_fully(file, memoryview(frame)[:length], self.path)
        view: Pixels = np.ndarray(
            (last - first, stop - top, width, self.channels),
            self.dtype,
            raw,
            strides=(raw.shape[1], self.row_bytes, pixel, self.dtype.itemsize),
        )
        view = view if self.channels > 1 else view[..., 0]
        return view[:, ::-1] if self.bottom_up else view

    def _grey(self, pixels: Pixels) -> Pixels:
        if self.channels > 1:
            k, height, width = pixels.shape[:3]
            colour = pixels[..., 2::-1] if self.blue_first else pixels[..., :3]
            return luma(colour.astype(self._native).reshape(k * height, width, 3)).reshape(k, height, width)
        if self.grey_levels is not None:
            flat = np.ascontiguousarray(pixels).reshape(-1, pixels.shape[-1])
            return np.asarray(cv2.LUT(flat, self.grey_levels)).reshape(pixels.shape)
        return pixels if self.dtype.isnative else pixels.astype(self._native)

    @property
    def _native(self) -> np.dtype[np.generic]:
        return self.dtype.newbyteorder("=")


def read_fully(file: BinaryIO, buffer: memoryview, path: Path) -> None:
    """Read until the buffer is full.

    Parameters
    ----------
    file
        An unbuffered file, at the position to read from.
    buffer
        Buffer to be filled.
    path
        Path for the message.

    Raises
    ------
    InputError
        If the file ends before.
    """
    done = 0
    while done < len(buffer):
        count = file.readinto(buffer[done:])  # type: ignore[attr-defined]  # raw files have it
        if not count:
            advice = "wait until it is copied, then run again"
            raise InputError(
                path, "a file that stays whole while it is read", "one that became shorter", advice
            )
        done += count


def repeated(status: Status, count: int) -> tuple[Status, ...]:
    """Return the same status for `count` frames."""
    return (status,) * count


def _even_runs(offsets: Ints, start: int, stop: int) -> Iterator[tuple[int, int]]:
    """Yield half-open ranges in which frames are equally spaced and ascending, or all lost."""
    while start < stop:
        steps = np.diff(offsets[start:stop])
        lost = offsets[start] < 0
        even = offsets[start + 1 : stop] < 0 if lost else (steps == steps[:1]) & (steps > 0)
        if not lost:
            even &= offsets[start + 1 : stop] >= 0
        length = int(np.argmin(even)) + 1 if not even.all() else even.size + 1
        yield start, start + length
        start += length


@dataclass(frozen=True, kw_only=True)
class AviLayout:
    """Header of an AVI file's first video stream and positions of its frames, from its chunks alone.

    Parameters
    ----------
    fourcc, bits
        Compression, four bytes, zeros for plain bitmaps; bits per pixel.
    width, height, top_down
        Picture in px; top_down for a height that was stored as a negative number.
    palette
        (entries, 4): blue, green, red, 0.
    declared_frames, fps
        Values of the header; None if it does not state them.
    offsets, sizes
        Position and length of each whole frame; length 0 is a frame that the camera dropped.
    cut_short
        Whether the file ends inside a frame.

    Notes
    -----
    Source: Microsoft AVI RIFF reference; OpenDML AVI file format extensions 1.02.
    """

    fourcc: bytes
    bits: int
    width: int
    height: int
    top_down: bool
    palette: NDArray[np.uint8]
    declared_frames: int | None
    fps: float | None
    offsets: Ints
    sizes: Ints
    cut_short: bool

    @property
    def is_uncompressed(self) -> bool:
        """Whether frames are uncompressed, so that `open_raw_avi` reads or refuses them without a decoder."""
        return self.is_plain or self.fourcc in _GREY_BITS

    @property
    def is_plain(self) -> bool:
        """Whether frames are bitmaps without a name of their format, or with the masks of 32-bit colour."""
        return self.fourcc in _PLAIN or (self.fourcc == _MASKED and self.bits == 32)


def is_avi(head: bytes) -> bool:
    """Return whether a file that begins with these 12 bytes is an AVI."""
    return head[:4] == b"RIFF" and head[8:12] == b"AVI "


def read_avi_layout(path: Path) -> AviLayout:
    """Walk through the chunks, OpenDML segments included; index and list sizes are not trusted.

    Every whole frame is found in files without an index, with a broken one, over 1 GiB or cut short.

    Raises
    ------
    InputError
        For an AVI without a video stream, or with a palette that changes.
    """
    with path.open("rb", buffering=0) as file:
        header, frames, cut_short = _walk(file, os.fstat(file.fileno()).st_size, path)
    if len(header.strf) < 40:
        raise InputError(path, "an AVI with a video stream", "none in its header", "record or copy it again")
    _, width, height, _, bits, fourcc, _, _, _, used, _ = struct.unpack_from("<IiiHH4sIiiII", header.strf)
    scale, rate, _, length = struct.unpack_from("<4I", header.strh, 20)
    table = np.frombuffer(header.strf[40 : 40 + 4 * (used or 256)], np.uint8)
    where = np.array(frames, np.int64).reshape(-1, 2)
    return AviLayout(
        fourcc=fourcc,
        bits=bits,
        width=width,
        height=abs(height),
        top_down=height < 0,
        palette=table[: table.size // 4 * 4].reshape(-1, 4),
        declared_frames=max(length, header.total_frames) or None,
        fps=rate / scale if scale and rate else None,
        offsets=where[:, 0],
        sizes=where[:, 1],
        cut_short=cut_short,
    )


@dataclass
class _Header:
    """Header chunks found so far: number of the present and of the video stream, its strh and strf, dmlh."""

    stream: int = -1
    video: int = -1
    strh: bytes = b""
    strf: bytes = b""
    total_frames: int = 0

    def add(self, name: bytes, data: bytes) -> None:
        """Keep a chunk that describes the first video stream."""
        if name == b"LIST":
            if data[4:8] == b"dmlh":
                self.total_frames = struct.unpack_from("<I", data, 12)[0]
        elif name == b"strh":
            self.stream += 1
            if data[:4] == b"vids" and self.video < 0:
                self.video, self.strh = self.stream, data
        elif self.stream == self.video:
            self.strf = data


def _walk(file: BinaryIO, size: int, path: Path) -> tuple[_Header, list[tuple[int, int]], bool]:
    """Read all chunks, and return header, frames (position, length) and whether the last frame is cut."""
    header, at = _Header(), 0
    frames: list[tuple[int, int]] = []
    while at + 8 <= size:
        file.seek(at)
        head = file.read(12)
        name, length = struct.unpack_from("<4sI", head)
        if name in (b"RIFF", b"LIST") and head[8:12] not in (b"INFO", b"odml"):  # its contents come next
            at += 12
            continue
        if name[2:] in (b"db", b"dc") and name[:2] == b"%02d" % header.video:
            if at + 8 + length > size:
                return header, frames, True
            frames.append((at + 8, length))
        elif name[2:] == b"pc":
            advice = "export the video as grey"
            raise InputError(path, "one palette for all frames", "a palette change", advice)
        elif not name.isascii() or name == bytes(4):  # space that a camera reserved and never filled
            break
        elif name in (b"strh", b"strf", b"LIST"):
            file.seek(at + 8)
            header.add(name, file.read(min(length, 4096)))
        at += 8 + length + length % 2
    return header, frames, False


def open_raw_avi(path: Path, layout: AviLayout) -> MappedReader:
    """Return a reader of uncompressed frames.

    Plain bitmaps are bottom-up unless their height is negative, fourcc greys are top-down; rows may be
    padded to 4 bytes. Palette colours and BGR become grey by `LUMA_RULE`. More than 8 bits are 10 to 16
    bits in two bytes, low byte first.

    Raises
    ------
    InputError
        For plain bitmaps of 16 bits (15-bit colour or a deep camera: the file does not say), for packed deep
        formats, and for a file without a whole frame.
    """
    bits, channels, name = _pixel_format(path, layout)
    pixel_bytes = channels * (1 if bits == 8 else 2)
    held = layout.sizes[layout.sizes > 0]
    if not held.size:
        advice = "the recording was cut short; copy it again"
        raise InputError(path, "at least one whole frame", "none", advice)
    frame_bytes = int(np.median(held))
    packed = layout.width * pixel_bytes
    padded = (packed + 3) // 4 * 4
    row_bytes = next((row for row in (padded, packed) if frame_bytes == row * layout.height), None)
    if row_bytes is None:
        size = shape_text((layout.height, layout.width))
        wanted = f"{padded * layout.height} bytes a frame for {size}, {name}"
        advice = "packed depths are not read; export as FFV1 or TIFF"
        raise InputError(path, wanted, f"{frame_bytes} bytes", advice)
    if (held < row_bytes * (layout.height - 1) + packed).any():
        found = f"one of {int(held.min())}"
        raise InputError(path, f"frames of {frame_bytes} bytes", found, "a damaged recording")
    plain, whole = layout.is_plain, layout.offsets.size
    cut_short = (f"{path.name}: the file ends inside frame {whole}, which is left out",) * layout.cut_short
    facts = Facts(
        shape=(layout.height, layout.width),
        depth_bits=bits,
        saturation_level=full_scale(bits),
        declared_frames=max(layout.declared_frames or 0, whole),
        container="avi",
        codec="uncompressed",
        pixel_format=name,
        decoder="none",
        grey=LUMA_RULE if channels > 1 or (plain and layout.bits == 8) else AS_STORED,
        playback_fps=layout.fps,
        warnings=cut_short,
    )
    return MappedReader(
        path=path,
        facts=facts,
        offsets=np.where(layout.sizes > 0, layout.offsets, -1),
        row_bytes=row_bytes,
        dtype=np.dtype("u1" if bits == 8 else "<u2"),
        channels=channels,
        blue_first=True,
        bottom_up=plain and not layout.top_down,
        grey_levels=_grey_levels(layout) if plain and layout.bits == 8 else None,
    )


def _pixel_format(path: Path, layout: AviLayout) -> tuple[int, int, str]:
    """Return significant bits, number of channels and name of the pixel format."""
    if layout.fourcc in _GREY_BITS:
        bits = _GREY_BITS[layout.fourcc]
        return bits, 1, f"grey {bits} bit"
    if layout.bits in (8, 24, 32):
        name = {8: "8-bit palette", 24: "BGR24", 32: "BGR32"}[layout.bits]
        return 8, max(1, layout.bits // 8), name
    found = f"{layout.bits} bits per pixel without a name for them"
    raise InputError(path, "a raw AVI of 8, 24 or 32 bits per pixel", found, "export as FFV1 or 16-bit TIFF")


def _grey_levels(layout: AviLayout) -> NDArray[np.uint8] | None:
    """Return the grey value of each palette entry; None for the plain grey ramp or no palette."""
    if not layout.palette.size:
        return None
    levels = np.zeros(256, np.uint8)
    colours = layout.palette[:256, 2::-1]
    levels[: len(colours)] = luma(colours[np.newaxis])[0]
    return None if np.array_equal(levels, np.arange(256)) else levels
