"""Uncompressed AVI, memory-mapped: 8-bit grey, palette bitmaps, BGR, 10 to 16 bits in two bytes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vision.errors import InputError
from vision.video.avi import AviLayout
from vision.video.grey import LUMA_RULE, luma
from vision.video.mapped import MappedReader
from vision.video.source import Facts

_PLAIN = {bytes(4), b"DIB ", b"RGB ", b"RAW "}
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


@dataclass(frozen=True)
class _Pixels:
    """How one stored pixel is laid out."""

    bits: int
    channels: int
    name: str


def is_raw(layout: AviLayout) -> bool:
    """True for an AVI whose frames this module reads or refuses; other codecs are for a decoder."""
    return layout.fourcc in _PLAIN or layout.fourcc in _GREY_BITS


def open_raw_avi(path: Path, layout: AviLayout) -> MappedReader:
    """A reader of uncompressed frames.

    Plain bitmaps are bottom-up unless their height is negative, fourcc greys are top-down; rows may be
    padded to 4 bytes. Palette colours and BGR become grey by `LUMA_RULE`. More than 8 bits are 10 to 16
    bits in two bytes, low byte first.
    Raises: InputError for plain bitmaps of 16 bits (15-bit colour or a deep camera: the file does not say),
    for packed deep formats, and for a file without a whole frame.
    """
    pixels = _pixels(path, layout)
    held = layout.sizes[layout.sizes > 0]
    if not held.size:
        raise InputError(
            path, "at least one whole frame", "none", "the recording was cut short; copy it again"
        )
    frame_bytes = int(np.median(held))
    row_bytes = _row_bytes(path, layout, pixels, frame_bytes)
    if (held < row_bytes * (layout.height - 1) + layout.width * _pixel_bytes(pixels)).any():
        raise InputError(
            path, f"frames of {frame_bytes} bytes", f"one of {int(held.min())}", "a damaged recording"
        )
    plain = layout.fourcc in _PLAIN
    return MappedReader(
        path=path,
        facts=_facts(path, layout, pixels),
        offsets=np.where(layout.sizes > 0, layout.offsets, -1),
        row_bytes=row_bytes,
        dtype=np.dtype("u1" if pixels.bits == 8 else "<u2"),
        channels=pixels.channels,
        blue_first=True,
        bottom_up=plain and not layout.top_down,
        grey_levels=_grey_levels(layout) if plain and layout.bits == 8 else None,
    )


def _pixels(path: Path, layout: AviLayout) -> _Pixels:
    if layout.fourcc in _GREY_BITS:
        bits = _GREY_BITS[layout.fourcc]
        return _Pixels(bits, 1, f"grey {bits} bit")
    if layout.bits in (8, 24, 32):
        names = {8: "8-bit palette", 24: "BGR24", 32: "BGR32"}
        return _Pixels(8, layout.bits // 8 if layout.bits > 8 else 1, names[layout.bits])
    found = f"{layout.bits} bits per pixel without a name for them"
    raise InputError(path, "a raw AVI of 8, 24 or 32 bits per pixel", found, "export as FFV1 or 16-bit TIFF")


def _pixel_bytes(pixels: _Pixels) -> int:
    return pixels.channels * (1 if pixels.bits == 8 else 2)


def _row_bytes(path: Path, layout: AviLayout, pixels: _Pixels, frame_bytes: int) -> int:
    """Bytes from row to row, from the size of a frame: padded to 4 bytes or not."""
    packed = layout.width * _pixel_bytes(pixels)
    padded = (packed + 3) // 4 * 4
    fitting = [row for row in (padded, packed) if frame_bytes == row * layout.height]
    if fitting:
        return fitting[0]
    wanted = f"{padded * layout.height} bytes a frame for {layout.width} x {layout.height}, {pixels.name}"
    raise InputError(
        path, wanted, f"{frame_bytes} bytes", "packed depths are not read; export as FFV1 or TIFF"
    )


def _grey_levels(layout: AviLayout) -> NDArray[np.uint8] | None:
    """Grey of each palette entry; None where the palette is the plain grey ramp or absent."""
    if not layout.palette.size:
        return None
    levels = np.zeros(256, np.uint8)
    colours = layout.palette[:256, 2::-1]
    levels[: len(colours)] = luma(colours[np.newaxis])[0]
    return None if np.array_equal(levels, np.arange(256)) else levels


def _facts(path: Path, layout: AviLayout, pixels: _Pixels) -> Facts:
    held = layout.offsets.size
    warnings: tuple[str, ...] = ()
    if layout.cut_short:
        warnings = (f"{path.name}: the file ends inside frame {held}, which is left out",)
    colour = pixels.channels > 1 or (layout.bits == 8 and layout.fourcc in _PLAIN)
    return Facts(
        shape=(layout.height, layout.width),
        depth_bits=pixels.bits,
        saturation_level=float((1 << pixels.bits) - 1),
        promised=max(layout.promised or held, held),
        playback_fps=layout.fps,
        warnings=warnings,
        notes={
            "container": "avi",
            "codec": "uncompressed",
            "pixel_format": pixels.name,
            "grey": LUMA_RULE if colour else "values as stored",
        },
    )
