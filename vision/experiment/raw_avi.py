"""Uncompressed grey AVI (Y800), written frame by frame, of any length.

Up to about 1 GiB it is a plain AVI with `idx1`; each further part is an OpenDML segment (`RIFF AVIX`)
with its own index. Source: Microsoft AVI RIFF reference; OpenDML AVI file format extensions 1.02.
"""

from __future__ import annotations

import struct
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

_SEGMENT_BYTES = 1 << 30
_SEGMENTS = 256
"""Room in the header for this many segments: 256 GiB."""


class RawAviWriter:
    """Write (row, column) uint8 frames to a Y800 AVI; use as a context manager.

    Rows are padded to 4 bytes, the first row is the top one. segment_bytes bounds each RIFF part.
    """

    def __init__(
        self, path: Path, *, width: int, height: int, fps: float, segment_bytes: int = _SEGMENT_BYTES
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
        self._file.seek(at)
        self._file.write(struct.pack("<I", value))

    def _write_idx1(self, size: int) -> None:
        kind = np.dtype([("id", "S4"), ("flags", "<u4"), ("at", "<u4"), ("size", "<u4")])
        table = np.zeros(len(self._offsets), kind)
        table["id"], table["flags"], table["size"] = b"00db", 0x10, size
        table["at"] = np.array(self._offsets, np.int64) - 8 - (self._movi_at + 8)
        self._file.write(struct.pack("<4sI", b"idx1", table.nbytes) + table.tobytes())

    def _write_header(self, frames: int) -> None:
        size = self._stride * self._height
        rate, scale = self._rate.numerator, self._rate.denominator
        first = self._first_count or frames
        main = struct.pack(
            "<14I",
            round(1e6 * scale / rate),
            0,
            0,
            0x10,
            first,
            0,
            1,
            size,
            self._width,
            self._height,
            0,
            0,
            0,
            0,
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
        head = struct.pack("<HBBI4sIII", 4, 0, 0, len(self._segments), b"00db", 0, 0, 0)
        rows = b"".join(struct.pack("<QII", *segment) for segment in self._segments)
        return (head + rows).ljust(24 + 16 * _SEGMENTS, b"\0")


def _chunk(name: bytes, body: bytes) -> bytes:
    return struct.pack("<4sI", name, len(body)) + body


def _list(name: bytes, body: bytes) -> bytes:
    return struct.pack("<4sI4s", b"LIST", len(body) + 4, name) + body
