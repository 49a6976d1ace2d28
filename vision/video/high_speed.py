"""File formats of high-speed cameras: Phantom .cine, and Photron .mraw with its .cih or .cihx."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from vision.errors import InputError
from vision.numeric import Floats, Ints, Pixels
from vision.video.reader import (
    AS_STORED,
    LUMA_RULE,
    Block,
    Facts,
    Reader,
    frames_per_block,
    full_scale,
    shape_text,
)
from vision.video.uncompressed import MappedReader, read_fully, repeated

# --- Phantom ------------------------------------------------------------------------------------------------


def is_cine(head: bytes) -> bool:
    """Return whether a file that begins with these bytes is a cine."""
    return head[:4] == b"CI\x2c\x00"


def open_cine(path: Path) -> Reader:
    """Return a reader with the file's own times (seconds from its first frame).

    Packed frames (10 bits) are returned as stored: the camera compands them, so they are not linear in light.

    Raises
    ------
    InputError
        For a damaged header or no whole frame.

    Notes
    -----
    Source: Vision Research, Cine File Format.
    """
    header = _read_cine_header(path)
    if not header.offsets.size:
        advice = "the recording was cut short; copy it again"
        raise InputError(path, "at least one whole frame", "none", advice)
    mosaic = (
        f"{path.name}: a Bayer pattern of colour filters lies on the pixels, so that neighbouring columns "
        "differ in brightness: export it as grey, or with interpolated colour",
    )
    facts = Facts(
        shape=(abs(header.height), header.width),
        depth_bits=header.real_bits,
        saturation_level=full_scale(header.real_bits),
        declared_frames=header.declared_frames,
        container="cine",
        codec="uncompressed",
        pixel_format=f"{header.real_bits} bit",
        decoder="none",
        grey=LUMA_RULE if header.stored_bits in (24, 48) else AS_STORED,
        times_s=header.times_s,
        warnings=mosaic * header.mosaic,
    )
    if header.compression != 0 or header.stored_bits not in (8, 16, 24, 48):
        grey = f"{header.real_bits} bit as stored, companded by the camera, not linear in light"
        facts = replace(facts, codec="packed", decoder="FFmpeg", grey=grey)
        from vision.video.encoded import EncodedReader

        return PackedCineReader(EncodedReader(path), facts)
    starts = []
    with path.open("rb") as file:
        for offset in header.offsets.tolist():  # each frame begins with the length of its annotation
            file.seek(offset)
            starts.append(offset + int.from_bytes(file.read(4), "little"))
    row_bytes = header.width * header.stored_bits // 8
    inside = np.array(starts, np.int64)
    return MappedReader(
        path=path,
        facts=facts,
        offsets=inside[inside + abs(header.height) * row_bytes <= path.stat().st_size],
        row_bytes=row_bytes,
        dtype=np.dtype("<u2" if header.stored_bits in (16, 48) else "u1"),
        channels=3 if header.stored_bits in (24, 48) else 1,
        blue_first=True,
        bottom_up=header.height > 0,
    )


@dataclass(frozen=True)
class PackedCineReader:
    """A `Reader` of packed cine frames: FFmpeg widens them to 16 bits, which is undone here."""

    reader: Reader
    facts: Facts

    @property
    def _shift(self) -> int:
        return self.reader.facts.depth_bits - self.facts.depth_bits

    def read(self, start: int, stop: int | None, rows: slice, columns: slice) -> Iterator[Block]:
        """Yield the decoder's blocks, in the camera's own grey levels."""
        for block in self.reader.read(start, stop, rows, columns):
            yield replace(block, pixels=np.right_shift(block.pixels, self._shift))

    def sample(self, numbers: Sequence[int]) -> Iterator[Pixels]:
        """Yield whole frames near these numbers, in the camera's own grey levels."""
        yield from (np.right_shift(pixels, self._shift) for pixels in self.reader.sample(numbers))


@dataclass(frozen=True)
class _CineHeader:
    """Content of the file's first blocks; offsets are those of frames that begin inside the file.

    mosaic: whether pixels of a colour camera are stored without interpolation.
    """

    width: int
    height: int
    stored_bits: int
    compression: int
    mosaic: bool
    real_bits: int
    declared_frames: int
    offsets: Ints
    times_s: Floats | None


def _read_cine_header(path: Path) -> _CineHeader:
    size, main = path.stat().st_size, struct.Struct("<2sHHHiIiIIII8x")
    try:
        with path.open("rb") as file:
            _, _, layout, *_, count, bitmap_at, setup_at, images_at = main.unpack(file.read(main.size))
            file.seek(0)
            data = file.read(min(images_at + 8 * count, size))  # everything before the first frame
        _, width, height, _, bits, compression = struct.unpack_from("<IiiHHI", data, bitmap_at)
        real = struct.unpack_from("<I", data, setup_at + 896)[0]  # RealBPP in the SETUP block
        whole = min(count, (len(data) - images_at) // 8)
        offsets = np.frombuffer(data, "<i8", whole, images_at).astype(np.int64)
        times_s = _cine_times(data, setup_at, images_at, count)
    except (struct.error, ValueError):
        raise InputError(path, "a whole cine header", "a file cut short inside it", "copy it again") from None
    return _CineHeader(
        width=width,
        height=height,
        stored_bits=bits,
        compression=compression,
        mosaic=layout == 2,
        real_bits=real if 0 < real <= 16 else min(bits if compression == 0 else 10, 16),
        declared_frames=count,
        offsets=offsets[offsets < size],
        times_s=times_s,
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

    Raises
    ------
    InputError
        If the other file is not beside it.
    """
    wanted = HEADERS if path.suffix.lower() == PIXELS else (PIXELS,)
    beside = sorted(path.parent.glob("*"))
    others = [
        other for end in wanted for other in beside if other.stem == path.stem and other.suffix.lower() == end
    ]
    if not others:
        name = f"{path.stem}{wanted[0]}"
        raise InputError(path, f"{name} beside it", "no such file", "copy both files of the recording")
    return (path, others[0]) if path.suffix.lower() == PIXELS else (others[0], path)


def open_photron(path: Path) -> Reader:
    """Return a reader with the camera's own clock: frame number over the header's frame rate.

    Parameters
    ----------
    path
        The .mraw or its .cih; the other one must be beside it.

    Raises
    ------
    InputError
        If one of the two is missing, the header lacks a number or contradicts the file's size, pixels are
        colour or of another depth, or there is no whole frame.

    Notes
    -----
    The file has no signature and no frame headers: frame n begins at byte n · width · height · bits / 8. Two
    12-bit pixels a, b are stored as the bytes a₁₁…a₄, a₃…a₀ b₁₁…b₈, b₇…b₀; 16 bits low byte first, with the
    camera's fewer bits at the lower or the higher end ("EffectiveBit Side"). Source: Photron FASTCAM Viewer,
    file formats; the published reader pyMRAW (ladisk/pyMRAW).
    """
    pixels, text = photron_files(path)
    fields = _fields(text)
    kind = fields.get("Color Type", "Mono")
    if "mono" not in kind.lower():
        raise InputError(text, "Color Type : Mono", f"'{kind[:40]}'", "export the recording as grey")
    width, height = (_whole(text, fields, f"Image {side}", 1 << 16) for side in ("Width", "Height"))
    bits, frames = _whole(text, fields, "Color Bit", 64), _whole(text, fields, "Total Frame", 10**8)
    if bits not in _DEPTHS:
        raise InputError(text, "Color Bit : 8, 12 or 16", str(bits), "save the recording with one of these")
    if bits == 12 and width * height % 2:
        raise InputError(text, "an even number of pixels at 12 bit", shape_text((height, width)))
    size, frame_bytes = pixels.stat().st_size, width * height * bits // 8
    _check_size(pixels, text, (height, width), bits, frames, size)
    held, rest = divmod(size, frame_bytes)
    warnings = []
    if held > frames:
        warnings.append(
            f"{pixels.name}: holds {held} frames where {text.name} says {frames}; all are read: "
            "check the width, height and Color Bit"
        )
    if rest:
        warnings.append(f"{pixels.name}: the file ends inside frame {held}, which is left out")
    rate, step = _number(fields.get("Record Rate(fps)")), int(_number(fields.get("Save Step")) or 1)
    if step > 1 and rate is not None:
        warnings.append(
            f"{text.name}: {rate:g} frames/s were recorded, and the save step is {step}: "
            f"if only every {step}th frame was saved, give `fps` {rate / step:g}"
        )
    effective = _number(fields.get("EffectiveBit Depth"))
    used = bits if bits == 8 or not effective or effective > bits else int(effective)
    upper = bits == 16 and fields.get("EffectiveBit Side", "").lower() == "higher" and used < bits
    facts = Facts(
        shape=(height, width),
        depth_bits=used,
        saturation_level=full_scale(used) * (1 << (bits - used) * upper),
        declared_frames=max(frames, held),
        container="mraw",
        codec="packed" if bits == 12 else "uncompressed",
        pixel_format=f"grey {bits} bit" + f", the upper {used} used" * upper,
        decoder="none",
        grey=AS_STORED,
        camera_fps=rate,
        warnings=tuple(warnings),
    )
    if bits == 12:
        return Packed12Reader(path=pixels, facts=facts, count=held)
    return MappedReader(
        path=pixels,
        facts=facts,
        offsets=frame_bytes * np.arange(held, dtype=np.int64),
        row_bytes=width * bits // 8,
        dtype=np.dtype("u1" if bits == 8 else "<u2"),
    )


def _check_size(pixels: Path, text: Path, shape: tuple[int, int], bits: int, frames: int, size: int) -> None:
    """Refuse a file whose size fits the header's frames only at another depth: the depth is wrong."""
    area, picture = shape[0] * shape[1], shape_text(shape)
    fits = [depth for depth in _DEPTHS if frames * (area * depth // 8) == size]
    if fits and bits not in fits:
        needed = frames * (area * bits // 8)
        wanted = f"{needed} bytes for {frames} frames of {picture}, {bits} bit by {text.name}"
        found = f"{size} bytes, as {fits[0]} bit need"
        raise InputError(pixels, wanted, found, f"correct Color Bit in {text.name}")
    if size < area * bits // 8:
        wanted = f"at least one frame of {picture}, {bits} bit, {area * bits // 8} bytes"
        raise InputError(pixels, wanted, f"{size} bytes", "the recording was cut short; copy it again")


@dataclass(frozen=True, kw_only=True)
class Packed12Reader:
    """A `Reader` of 12-bit pixels, two in three bytes, high bits first; only the wanted rows are unpacked.

    Parameters
    ----------
    path, facts
        The .mraw, and the facts from its header.
    count
        Number of whole frames in the file.
    """

    path: Path
    facts: Facts
    count: int

    def read(self, start: int, stop: int | None, rows: slice, columns: slice) -> Iterator[Block]:
        """Yield frames in order, unpacked block by block."""
        end = self.count if stop is None else min(stop, self.count)
        # 6 bytes per pixel at most: 12 bits packed, and 16 bits twice
        size = frames_per_block(rows.stop - rows.start, self.facts.shape[1], 6)
        for first in range(start, end, size):
            last = min(first + size, end)
            yield Block(self._unpacked(first, last, rows)[:, :, columns], first, repeated("ok", last - first))

    def sample(self, numbers: Sequence[int]) -> Iterator[Pixels]:
        """Yield exactly these frames, whole, without those that the file does not contain."""
        for n in numbers:
            if n < self.count:
                yield self._unpacked(n, n + 1, slice(0, self.facts.shape[0]))[0]

    def _unpacked(self, first: int, last: int, rows: slice) -> NDArray[np.uint16]:
        height, width = self.facts.shape
        frame_bytes = height * width * 3 // 2
        begin, end = rows.start * width, rows.stop * width  # in pixels; a row may begin inside three bytes
        even = begin - begin % 2
        raw = np.empty((last - first, (end + 1) // 2 * 3 - even // 2 * 3), np.uint8)
        with self.path.open("rb", buffering=0) as file:
            for n, frame in enumerate(raw, first):
                file.seek(n * frame_bytes + even // 2 * 3)
                read_fully(file, memoryview(frame), self.path)
        triples = raw.reshape(last - first, -1, 3).astype(np.uint16)
        pixels = np.empty((last - first, 2 * triples.shape[1]), np.uint16)
        pixels[:, 0::2] = triples[..., 0] << 4 | triples[..., 1] >> 4
        pixels[:, 1::2] = (triples[..., 1] & 15) << 8 | triples[..., 2]
        return pixels[:, begin - even : end - even].reshape(last - first, rows.stop - rows.start, width)


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


def _number(value: str | None) -> float | None:
    """Return a positive number, None for anything else."""
    try:
        number = float(value or "")
    except ValueError:
        return None
    return number if 0 < number < float("inf") else None
