"""Files of uncompressed frames: raw AVI, Phantom .cine, and Photron .mraw with its .cih or .cihx."""

from __future__ import annotations

import math
import os
import re
import struct
from array import array
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from vision.errors import InputError
from vision.numeric import Floats, Ints, number
from vision.video.reader import (
    AS_STORED,
    LUMA_RULE,
    Facts,
    MappedReader,
    Reader,
    full_scale,
    luma,
    shape_text,
    whole_frames,
)


def open_raw(path: Path, head: bytes) -> Reader | None:
    """Return the reader of a file that begins with `head`, 12 bytes; None for a file of another kind.

    Raises: InputError for a damaged file, or one whose pixels cannot be read.
    """
    if is_photron(path):
        return _open_photron(path)
    if head[:4] == b"CI\x2c\x00":
        return _open_cine(path)
    if head[:4] == b"RIFF" and head[8:] == b"AVI ":
        return _open_avi(path)
    return None


# --- AVI ----------------------------------------------------------------------------------------------------

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


def _walk(file: BinaryIO, size: int, path: Path) -> tuple[_Header, Ints, bool]:
    """Read all chunks, and return header, frames (position, length), (k, 2), and whether the last is cut."""
    header, at, is_cut = _Header(), 0, False
    frames = array("q")  # a list of 100 000 pairs would take 12 MB
    while at + 8 <= size:
        file.seek(at)
        head = file.read(12)
        name, length = struct.unpack_from("<4sI", head)
        if name in (b"RIFF", b"LIST") and head[8:12] not in (b"INFO", b"odml"):  # its contents come next
            at += 12
            continue
        if name[2:] in (b"db", b"dc") and name[:2] == b"%02d" % header.video:
            is_cut = at + 8 + length > size
            if is_cut:
                break
            frames.extend((at + 8, length))
        elif name[2:] == b"pc":
            advice = "export the video as grey"
            raise InputError(path, "one palette for all frames", "a palette change", advice)
        elif not name.isascii() or name == bytes(4):  # space that a camera reserved and never filled
            break
        elif name in (b"strh", b"strf", b"LIST"):
            file.seek(at + 8)
            header.add(name, file.read(min(length, 4096)))
        at += 8 + length + length % 2
    return header, np.array(frames, np.int64).reshape(-1, 2), is_cut


def _open_avi(path: Path) -> MappedReader | None:
    """Return a reader of uncompressed frames; None if the first video stream is compressed.

    Frames are found by walking through all chunks, OpenDML segments included, since indexes and the sizes of
    lists cannot be trusted: without an index, with a broken one, over 1 GiB or cut short. Plain bitmaps are
    bottom-up unless their height is negative, fourcc greys are top-down; rows may be padded to 4 bytes.
    Palette colours and BGR become grey by `LUMA_RULE`. More than 8 bits are 10 to 16 bits in two bytes, low
    byte first. Plain bitmaps of 16 bits are refused (15-bit colour or a deep camera: the file does not say),
    and so are packed deep formats. Source: Microsoft AVI RIFF reference; OpenDML AVI file format extensions
    1.02.
    """
    with path.open("rb", buffering=0) as file:
        header, frames, is_cut = _walk(file, os.fstat(file.fileno()).st_size, path)
    if len(header.strf) < 40:
        raise InputError(path, "an AVI with a video stream", "none in its header", "record or copy it again")
    _, width, height, _, stored, fourcc, _, _, _, used, _ = struct.unpack_from("<IiiHH4sIiiII", header.strf)
    plain = fourcc in (bytes(4), b"DIB ", b"RGB ", b"RAW ") or (fourcc == _MASKED and stored == 32)
    if not plain and fourcc not in _GREY_BITS:
        return None
    bits, channels, name = _pixel_format(path, fourcc, stored)
    scale, rate, _, length = struct.unpack_from("<4I", header.strh, 20)
    offsets, sizes = frames.T
    held = sizes[sizes > 0]  # 0 is a frame that the camera dropped
    if not held.size:
        advice = "the recording was cut short; copy it again"
        raise InputError(path, "at least one whole frame", "none", advice)
    frame_bytes, shape = int(np.median(held)), (abs(height), width)
    packed = width * channels * (1 if bits == 8 else 2)
    row_bytes = _row_bytes(path, packed, frame_bytes, shape, name)
    if (held < row_bytes * (shape[0] - 1) + packed).any():
        found = f"one of {int(held.min())}"
        raise InputError(path, f"frames of {frame_bytes} bytes", found, "a damaged recording")
    has_palette = plain and stored == 8
    cut_short = f"{path.name}: the file ends inside frame {sizes.size}, which is left out"
    facts = Facts(
        shape=shape,
        depth_bits=bits,
        saturation_level=full_scale(bits),
        declared_frames=max(length, header.total_frames, sizes.size),
        container="avi",
        codec="uncompressed",
        pixel_format=name,
        decoder="none",
        grey=LUMA_RULE if channels > 1 or has_palette else AS_STORED,
        playback_fps=rate / scale if scale and rate else None,
        warnings=(cut_short,) if is_cut else (),
    )
    return MappedReader(
        path=path,
        facts=facts,
        offsets=np.where(sizes > 0, offsets, -1),
        row_bytes=row_bytes,
        dtype=np.dtype("u1" if bits == 8 else "<u2"),
        channels=channels,
        blue_first=True,
        bottom_up=plain and height > 0,
        grey_levels=_grey_levels(header.strf[40 : 40 + 4 * (used or 256)]) if has_palette else None,
    )


def _row_bytes(path: Path, packed: int, frame_bytes: int, shape: tuple[int, int], name: str) -> int:
    """Return the bytes from one row to the next: the `packed` pixels, usually padded to a multiple of 4."""
    padded = (packed + 3) // 4 * 4
    for row in (padded, packed):
        if frame_bytes == row * shape[0]:
            return row
    wanted = f"{padded * shape[0]} bytes a frame for {shape_text(shape)}, {name}"
    advice = "packed depths are not read; export as FFV1 or TIFF"
    raise InputError(path, wanted, f"{frame_bytes} bytes", advice)


def _pixel_format(path: Path, fourcc: bytes, stored: int) -> tuple[int, int, str]:
    """Return significant bits, number of channels and name of the pixel format of `stored` bits."""
    if fourcc in _GREY_BITS:
        bits = _GREY_BITS[fourcc]
        return bits, 1, f"grey {bits} bit"
    if stored in (8, 24, 32):
        name = {8: "8-bit palette", 24: "BGR24", 32: "BGR32"}[stored]
        return 8, max(1, stored // 8), name
    found = f"{stored} bits per pixel without a name for them"
    raise InputError(path, "a raw AVI of 8, 24 or 32 bits per pixel", found, "export as FFV1 or 16-bit TIFF")


def _grey_levels(table: bytes) -> NDArray[np.uint8] | None:
    """Return the grey value of each palette entry (blue, green, red, 0); None for the grey ramp or none."""
    colours = np.frombuffer(table[: len(table) // 4 * 4], np.uint8).reshape(-1, 4)[:256, 2::-1]
    if not colours.size:
        return None
    levels = np.zeros(256, np.uint8)
    levels[: len(colours)] = luma(colours[np.newaxis])[0]
    return None if np.array_equal(levels, np.arange(256)) else levels


# --- Phantom ------------------------------------------------------------------------------------------------


def _cine_headers(path: Path, size: int) -> tuple[int, int, int, int, int, int, int, Ints, Floats | None]:
    """Return what the headers of a .cine of this size state.

    The kind (2: pixels of a colour camera without interpolation), number of frames, width, height (negative
    if the top row is stored first), bits of a pixel in the file, compression (0: none), significant bits (not
    from 1 to 16 if unknown), position of each frame (-1 for one that is not in the file), and its time, s.
    """
    main = struct.Struct("<2sHHHiIiIIII8x")
    try:
        with path.open("rb") as file:
            _, _, kind, *_, count, bitmap_at, setup_at, images_at = main.unpack(file.read(main.size))
            file.seek(0)
            data = file.read(min(images_at + 8 * count, size))  # everything before the first frame
        _, width, height, _, stored, compression = struct.unpack_from("<IiiHHI", data, bitmap_at)
        bits = struct.unpack_from("<I", data, setup_at + 896)[0]  # RealBPP in the SETUP block
        entries = min(count, (len(data) - images_at) // 8)
        frames = np.frombuffer(data, "<i8", entries, images_at).astype(np.int64)
        times_s = _cine_times(data, setup_at, images_at, count)
    except (struct.error, ValueError):
        raise InputError(path, "a whole cine header", "a file cut short inside it", "copy it again") from None
    frames = whole_frames(frames, 4, size)  # each begins with the length of its annotation
    return kind, count, width, height, stored, compression, bits, frames, times_s


def _open_cine(path: Path) -> Reader:
    """Return a reader with the file's own times (seconds from its first frame).

    Packed frames (10 bits) are returned as stored: the camera compands them, so they are not linear in light.
    Source: Vision Research, Cine File Format.
    """
    size = path.stat().st_size
    kind, count, width, height, stored, compression, bits, frames, times_s = _cine_headers(path, size)
    if not frames.size:
        advice = "the recording was cut short; copy it again"
        raise InputError(path, "at least one whole frame", "none", advice)
    if not 0 < bits <= 16:
        bits = min(stored if compression == 0 else 10, 16)
    mosaic = (
        f"{path.name}: a Bayer pattern of colour filters lies on the pixels, so that neighbouring columns "
        "differ in brightness: export it as grey, or with interpolated colour"
    )
    facts = Facts(
        shape=(abs(height), width),
        depth_bits=bits,
        saturation_level=full_scale(bits),
        declared_frames=count,
        container="cine",
        codec="uncompressed",
        pixel_format=f"{bits} bit",
        decoder="none",
        grey=LUMA_RULE if stored in (24, 48) else AS_STORED,
        times_s=times_s,
        warnings=(mosaic,) if kind == 2 else (),
    )
    if compression != 0 or stored not in (8, 16, 24, 48):
        grey = f"{bits} bit as stored, companded by the camera, not linear in light"
        facts = replace(facts, codec="packed", decoder="FFmpeg", grey=grey)
        from vision.video.encoded import EncodedReader

        reader = EncodedReader.of(path)  # FFmpeg widens the frames to 16 bits
        return replace(reader, facts=facts, shift=reader.facts.depth_bits - bits)
    with path.open("rb") as file:
        for n in np.flatnonzero(frames >= 0):
            file.seek(frames[n])
            frames[n] += int.from_bytes(file.read(4), "little")
    row_bytes = width * stored // 8
    return MappedReader(
        path=path,
        facts=facts,
        offsets=whole_frames(frames, abs(height) * row_bytes, size),
        row_bytes=row_bytes,
        dtype=np.dtype("<u2" if stored in (16, 48) else "u1"),
        channels=3 if stored in (24, 48) else 1,
        blue_first=True,
        bottom_up=height > 0,
    )


def _cine_times(data: bytes, setup_at: int, images_at: int, count: int) -> Floats | None:
    """Return the seconds of each frame after the first, from the tagged blocks after SETUP; None without.

    A step a hundred times as long as the recording, as written for an invalid frame, becomes a usual one.
    """
    at = setup_at + struct.unpack_from("<H", data, setup_at + 142)[0]
    while at + 8 <= images_at:
        length, kind, _ = struct.unpack_from("<IHH", data, at)
        if kind == 1002 and length >= 8 + 8 * count:  # "time only": 64 bits a frame, in 2**-32 s
            ticks = np.frombuffer(data, "<u8", count, at + 8)
            times_s = (ticks - ticks[0]).astype(np.int64) / 2.0**32
            steps = np.diff(times_s)
            usual = float(np.median(steps)) if steps.size else 0.0
            absurd = np.abs(steps) > 100 * usual * times_s.size
            return np.concatenate([[0.0], np.cumsum(np.where(absurd, usual, steps))])
        if length < 8:
            return None
        at += length
    return None


# --- Photron ------------------------------------------------------------------------------------------------

PIXELS, HEADERS = ".mraw", (".cih", ".cihx")
_DEPTHS = (8, 12, 16)
_IN_XML = {
    "Record Rate(fps)": "recordInfo/recordRate",
    "Total Frame": "frameInfo/totalFrame",
    "Image Width": "imageDataInfo/resolution/width",
    "Image Height": "imageDataInfo/resolution/height",
    "Color Type": "imageDataInfo/colorInfo/type",
    "Color Bit": "imageDataInfo/colorInfo/bit",
    "EffectiveBit Depth": "imageDataInfo/effectiveBit/depth",
    "EffectiveBit Side": "imageDataInfo/effectiveBit/side",
    "Save Step": "frameInfo/skipFrame",
}


def is_photron(path: Path) -> bool:
    """Return whether this is a file of a Photron recording, by its name: neither file has a signature."""
    return path.suffix.lower() in (PIXELS, *HEADERS)


def photron_files(path: Path) -> tuple[Path, Path]:
    """Return both files (.mraw, .cih or .cihx) of the recording to which this file belongs.

    Raises: InputError if the other file is not beside it.
    """
    wanted = HEADERS if path.suffix.lower() == PIXELS else (PIXELS,)
    beside = sorted(path.parent.glob("*"))
    others = [one for end in wanted for one in beside if (one.stem, one.suffix.lower()) == (path.stem, end)]
    if not others:
        name = f"{path.stem}{wanted[0]}"
        raise InputError(path, f"{name} beside it", "no such file", "copy both files of the recording")
    return (path, others[0]) if path.suffix.lower() == PIXELS else (others[0], path)


def _open_photron(path: Path) -> Reader:
    """Return a reader with the camera's own clock: frame number over the header's frame rate.

    `path` is the .mraw or its .cih; the other one must be beside it. The file has no signature and no frame
    headers: frame n begins at byte n · width · height · bits / 8. Two 12-bit pixels a, b are stored as the
    bytes a₁₁…a₄, a₃…a₀ b₁₁…b₈, b₇…b₀; 16 bits low byte first, with the camera's fewer bits at the lower or
    the higher end ("EffectiveBit Side"). The colour type Raw has one value a pixel, too: of a colour camera
    it is a Bayer pattern, which is evened out where the strip is averaged. Source: Photron FASTCAM Viewer,
    file formats; the published reader pyMRAW (ladisk/pyMRAW).
    """
    pixels, text = photron_files(path)
    fields = _fields(text)
    shape, bits, frames, size = _stated(pixels, text, fields)
    frame_bytes = shape[0] * shape[1] * bits // 8
    held, rest = divmod(size, frame_bytes)
    warnings = []
    if held > frames:
        warnings.append(
            f"{pixels.name}: holds {held} frames where {text.name} says {frames}; all are read: "
            "check the width, height and Color Bit"
        )
    if rest:
        warnings.append(f"{pixels.name}: the file ends inside frame {held}, which is left out")
    names = ("Record Rate(fps)", "Save Step", "EffectiveBit Depth")
    stated = (number(fields.get(name)) for name in names)
    rate, step, effective = (value if 0 < value < math.inf else 0.0 for value in stated)
    if step >= 2 and rate:
        warnings.append(
            f"{text.name}: {rate:g} frames/s were recorded, and the save step is {int(step)}: "
            f"if only every {int(step)}th frame was saved, give `fps` {rate / int(step):g}"
        )
    used = bits if bits == 8 or not effective or effective > bits else int(effective)
    unused = bits - used
    upper = bits == 16 and unused > 0 and fields.get("EffectiveBit Side", "").lower() == "higher"
    facts = Facts(
        shape=shape,
        depth_bits=used,
        saturation_level=full_scale(used) * (1 << unused if upper else 1),
        declared_frames=max(frames, held),
        container="mraw",
        codec="packed" if bits == 12 else "uncompressed",
        pixel_format=f"grey {bits} bit, the upper {used} used" if upper else f"grey {bits} bit",
        decoder="none",
        grey=AS_STORED,
        camera_fps=rate or None,
        warnings=tuple(warnings),
    )
    return MappedReader(
        path=pixels,
        facts=facts,
        offsets=frame_bytes * np.arange(held, dtype=np.int64),
        row_bytes=0 if bits == 12 else shape[1] * bits // 8,
        dtype=np.dtype("u1" if bits == 8 else "<u2"),
    )


def _stated(pixels: Path, text: Path, fields: Mapping[str, str]) -> tuple[tuple[int, int], int, int, int]:
    """Return shape, bits per pixel and number of frames by the header, and the size of the file, checked.

    Raises: InputError also for a size that fits the header's frames only at another depth.
    """
    kind = fields.get("Color Type", "Mono")
    if not any(name in kind.lower() for name in ("mono", "raw")):
        raise InputError(text, "Color Type : Mono or Raw", f"'{kind[:40]}'", "export the recording as grey")
    width, height = (_whole(text, fields, f"Image {side}", 1 << 16) for side in ("Width", "Height"))
    bits, frames = _whole(text, fields, "Color Bit", 64), _whole(text, fields, "Total Frame", 10**8)
    if bits not in _DEPTHS:
        raise InputError(text, "Color Bit : 8, 12 or 16", str(bits), "save the recording with one of these")
    if bits == 12 and width * height % 2:
        raise InputError(text, "an even number of pixels at 12 bit", shape_text((height, width)))
    area, picture, size = height * width, shape_text((height, width)), pixels.stat().st_size
    fits = [depth for depth in _DEPTHS if frames * (area * depth // 8) == size]
    if fits and bits not in fits:
        needed = frames * (area * bits // 8)
        wanted = f"{needed} bytes for {frames} frames of {picture}, {bits} bit by {text.name}"
        found = f"{size} bytes, as {fits[0]} bit need"
        raise InputError(pixels, wanted, found, f"correct Color Bit in {text.name}")
    if size < area * bits // 8:
        wanted = f"at least one frame of {picture}, {bits} bit, {area * bits // 8} bytes"
        raise InputError(pixels, wanted, f"{size} bytes", "the recording was cut short; copy it again")
    return (height, width), bits, frames, size


def _fields(text: Path) -> Mapping[str, str]:
    """Return names and first values, from lines `name : value` or from the XML in a .cihx."""
    with text.open("rb") as file:  # real cameras' headers are 10 to 30 kB
        content = file.read(1 << 20).decode("utf-8", errors="replace")
    if "<cih" not in content:
        lines = [line.partition(":") for line in content.splitlines()]
        return {name.strip(): value.strip() for name, colon, value in reversed(lines) if colon}
    xml = re.search(r"<cih\b.*</cih>", content, re.DOTALL)
    try:
        root = ElementTree.fromstring(xml[0] if xml else "")  # no entities without a DOCTYPE
    except ElementTree.ParseError as error:
        raise InputError(text, "a whole header of a Photron recording", f"damaged XML ({error})") from None
    return {name: value.strip() for name, place in _IN_XML.items() if (value := root.findtext(place))}


def _whole(text: Path, fields: Mapping[str, str], name: str, most: int) -> int:
    value = fields.get(name, "")
    if not re.fullmatch(r"[0-9]{1,12}", value) or not 1 <= int(value) <= most:
        found = f"'{value[:40]}'" if value else "none"
        raise InputError(text, f"{name} : a whole number from 1 to {most}", found, "copy it again")
    return int(value)
