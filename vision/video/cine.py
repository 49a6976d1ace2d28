"""Phantom .cine: true bit depth and frame times from its header; pixels mapped or, if packed, decoded."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from vision.errors import InputError
from vision.numeric import Floats, Ints, Pixels
from vision.video.encoded import EncodedReader
from vision.video.reader import AS_STORED, Block, Facts, Reader, full_scale
from vision.video.uncompressed import MappedReader

_FILE = struct.Struct("<2sHHHiIiIIII8x")
_BITMAP = struct.Struct("<IiiHHIIiiII")
_REAL_BITS_AT = 896  # place of RealBPP in the SETUP block
_TIME_ONLY = 1002  # tag of the block with one 64-bit time per frame, in 2**-32 s


@dataclass(frozen=True)
class PackedCineReader:
    """A `Reader` of packed cine frames: decoded by FFmpeg, which widens to 16 bits; narrowed back here."""

    reader: Reader
    facts: Facts

    @property
    def _shift(self) -> int:
        return self.reader.facts.depth_bits - self.facts.depth_bits

    def read(self, start: int, stop: int | None, rows: slice, columns: slice) -> Iterator[Block]:
        """Blocks of the decoder, in the camera's own grey levels."""
        for block in self.reader.read(start, stop, rows, columns):
            yield replace(block, pixels=np.right_shift(block.pixels, self._shift))

    def sample(self, numbers: Sequence[int]) -> Iterator[Pixels]:
        """Whole frames near these numbers, in the camera's own grey levels."""
        yield from (np.right_shift(pixels, self._shift) for pixels in self.reader.sample(numbers))


def is_cine(head: bytes) -> bool:
    """Whether a file that begins with these bytes is a cine."""
    return head[:4] == b"CI\x2c\x00"


def open_cine(path: Path) -> Reader:
    """A reader with the file's own times (seconds from its first frame).

    Packed frames (10 bits) come as stored: the camera compands them, so they are not linear in light.

    Raises
    ------
    InputError
        For a damaged header or no whole frame.

    Notes
    -----
    Source: Vision Research, Cine File Format.
    """
    header = _read_header(path)
    if not header.offsets.size:
        advice = "the recording was cut short; copy it again"
        raise InputError(path, "at least one whole frame", "none", advice)
    facts = Facts(
        shape=(abs(header.height), header.width),
        depth_bits=header.real_bits,
        saturation_level=full_scale(header.real_bits),
        declared_frames=header.declared_frames,
        container="cine",
        codec="uncompressed",
        pixel_format=f"{header.real_bits} bit",
        decoder="none",
        grey=AS_STORED,
        times_s=header.times_s,
    )
    if header.compression == 0 and header.stored_bits in (8, 16, 24):
        return _mapped(path, header, facts)
    grey = f"{header.real_bits} bit as stored, companded by the camera, not linear in light"
    return PackedCineReader(EncodedReader(path), replace(facts, codec="packed", decoder="FFmpeg", grey=grey))


@dataclass(frozen=True)
class _Header:
    """What the file's first blocks say; offsets are those of frames that begin inside the file."""

    width: int
    height: int
    stored_bits: int
    compression: int
    real_bits: int
    declared_frames: int
    offsets: Ints
    times_s: Floats | None


def _mapped(path: Path, header: _Header, facts: Facts) -> MappedReader:
    starts = []
    with path.open("rb") as file:
        for offset in header.offsets.tolist():  # each frame begins with the length of its annotation
            file.seek(offset)
            starts.append(offset + int.from_bytes(file.read(4), "little"))
    row_bytes = header.width * header.stored_bits // 8
    inside = np.array(starts, np.int64)
    inside = inside[inside + abs(header.height) * row_bytes <= path.stat().st_size]
    return MappedReader(
        path=path,
        facts=facts,
        offsets=inside,
        row_bytes=row_bytes,
        dtype=np.dtype("<u2" if header.stored_bits == 16 else "u1"),
        channels=3 if header.stored_bits == 24 else 1,
        blue_first=True,
        bottom_up=header.height > 0,
    )


def _read_header(path: Path) -> _Header:
    try:
        data = _before_first_frame(path)
        _, _, _, _, _, _, _, count, bitmap_at, setup_at, images_at = _FILE.unpack_from(data)
        _, width, height, _, bits, compression, *_ = _BITMAP.unpack_from(data, bitmap_at)
        real = struct.unpack_from("<I", data, setup_at + _REAL_BITS_AT)[0]
        whole = min(count, (len(data) - images_at) // 8)
        offsets = np.frombuffer(data, "<i8", whole, images_at).astype(np.int64)
        times_s = _times(data, setup_at, images_at, count)
    except (struct.error, ValueError):
        raise InputError(path, "a whole cine header", "a file cut short inside it", "copy it again") from None
    deep = bits if compression == 0 else 10
    return _Header(
        width=width,
        height=height,
        stored_bits=bits,
        compression=compression,
        real_bits=real if 0 < real <= 16 else min(deep, 16),
        declared_frames=count,
        offsets=offsets[offsets < path.stat().st_size],
        times_s=times_s,
    )


def _before_first_frame(path: Path) -> bytes:
    with path.open("rb") as file:
        _, _, _, _, _, _, _, count, _, _, images_at = _FILE.unpack(file.read(_FILE.size))
        file.seek(0)
        return file.read(min(images_at + 8 * count, path.stat().st_size))


def _times(data: bytes, setup_at: int, images_at: int, count: int) -> Floats | None:
    """Seconds of each frame after the first, from the tagged blocks behind SETUP; None without any."""
    at = setup_at + struct.unpack_from("<H", data, setup_at + 142)[0]
    while at + 8 <= images_at:
        length, kind, _ = struct.unpack_from("<IHH", data, at)
        if kind == _TIME_ONLY and length >= 8 + 8 * count:
            ticks = np.frombuffer(data, "<u8", count, at + 8)
            return _plausible(np.asarray((ticks - ticks[0]).astype(np.int64) / 2.0**32, np.float64))
        if length < 8:
            return None
        at += length
    return None


def _plausible(times_s: Floats) -> Floats:
    """Times with the usual step in place of absurd leaps, as written for a frame that is none."""
    steps = np.diff(times_s)
    if not steps.size:
        return times_s
    usual = float(np.median(steps))
    absurd = np.abs(steps) > 100 * usual * times_s.size  # a hundred times as long as the whole recording
    return np.concatenate([times_s[:1], times_s[0] + np.cumsum(np.where(absurd, usual, steps))])
