"""Photron .mraw: frames of 8, 12 (packed) or 16 bits, described by a .cih or .cihx text beside it."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from vision.errors import InputError
from vision.numeric import Pixels
from vision.video.reader import (
    AS_STORED,
    Block,
    Facts,
    Reader,
    Status,
    frames_per_block,
    full_scale,
    shape_text,
)
from vision.video.uncompressed import MappedReader, read_fully

PIXELS, HEADERS = ".mraw", (".cih", ".cihx")
_DEPTHS = (8, 12, 16)
_MOST_TEXT = 1 << 20  # bytes of a header that are read; those of real cameras are 10 to 30 kB
_MOST_FRAMES = 10**8
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


@dataclass(frozen=True)
class _Header:
    """What the text says. rate: frames per second, None where it does not say; step: of the frames saved."""

    width: int
    height: int
    bits: int
    significant_bits: int
    side: Literal["lower", "higher"]
    frames: int
    rate: float | None
    step: int

    @property
    def frame_bytes(self) -> int:
        return self.width * self.height * self.bits // 8


@dataclass(frozen=True, kw_only=True)
class Packed12Reader:
    """A `Reader` of 12-bit pixels, two in three bytes, high bits first; only the wanted rows are unpacked.

    Parameters
    ----------
    path, facts
        The .mraw, and what its header says.
    count
        Whole frames in the file.
    """

    path: Path
    facts: Facts
    count: int

    def read(self, start: int, stop: int | None, rows: slice, columns: slice) -> Iterator[Block]:
        """Frames in order, unpacked block by block."""
        end = self.count if stop is None else min(stop, self.count)
        size = frames_per_block(rows.stop - rows.start, self.facts.shape[1], 6)  # 12 bits, and as 16, twice
        for first in range(start, end, size):
            last = min(first + size, end)
            ok: Status = "ok"
            yield Block(self._unpacked(first, last, rows)[:, :, columns], first, (ok,) * (last - first))

    def sample(self, numbers: Sequence[int]) -> Iterator[Pixels]:
        """Exactly these frames, whole; those the file does not hold are left out."""
        for n in numbers:
            if n < self.count:
                yield self._unpacked(n, n + 1, slice(0, self.facts.shape[0]))[0]

    def _unpacked(self, first: int, last: int, rows: slice) -> NDArray[np.uint16]:
        height, width = self.facts.shape
        frame_bytes = height * width * 3 // 2
        begin, end = rows.start * width, rows.stop * width  # in pixels; a row may begin inside three bytes
        even = begin - begin % 2
        raw = np.empty((last - first, (end + 1) // 2 * 3 - even // 2 * 3), np.uint8)
        with self.path.open(
            "rb", buffering=0
        ) as file:  # a mapped file that becomes shorter kills the process
            for n, frame in enumerate(raw, first):
                file.seek(n * frame_bytes + even // 2 * 3)
                read_fully(file, memoryview(frame), self.path)
        triples = raw.reshape(last - first, -1, 3).astype(np.uint16)
        pixels = np.empty((last - first, 2 * triples.shape[1]), np.uint16)
        pixels[:, 0::2] = triples[..., 0] << 4 | triples[..., 1] >> 4
        pixels[:, 1::2] = (triples[..., 1] & 15) << 8 | triples[..., 2]
        return pixels[:, begin - even : end - even].reshape(last - first, rows.stop - rows.start, width)


def is_photron(path: Path) -> bool:
    """Whether this is one of the two files of a Photron recording, by its name: neither has a signature."""
    return path.suffix.lower() in (PIXELS, *HEADERS)


def photron_files(path: Path) -> tuple[Path, Path]:
    """(.mraw, .cih or .cihx) of the recording to which this file belongs.

    Raises
    ------
    InputError
        Where the other file is not beside it.
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
    """A reader with the camera's own clock: frame number over the header's frame rate.

    Parameters
    ----------
    path
        The .mraw or its .cih; the other one lies beside it.

    Raises
    ------
    InputError
        Where one of the two is missing, the header lacks a number or contradicts the file's size, pixels are
        colour or of another depth, and for no whole frame.

    Notes
    -----
    The file has no signature and no frame headers: frame n begins at byte n · width · height · bits / 8. Two
    12-bit pixels a, b are stored as the bytes a₁₁…a₄, a₃…a₀ b₁₁…b₈, b₇…b₀; 16 bits low byte first, with the
    camera's fewer bits at the lower or the higher end ("EffectiveBit Side"). Source: Photron FASTCAM Viewer,
    file formats; the published reader pyMRAW (ladisk/pyMRAW).
    """
    pixels, text = photron_files(path)
    header = _read_header(text)
    size = pixels.stat().st_size
    held = size // header.frame_bytes
    _check_size(pixels, text, header, size)
    facts = _facts(pixels, text, header, size)
    if header.bits == 12:
        return Packed12Reader(path=pixels, facts=facts, count=held)
    return MappedReader(
        path=pixels,
        facts=facts,
        offsets=header.frame_bytes * np.arange(held, dtype=np.int64),
        row_bytes=header.width * header.bits // 8,
        dtype=np.dtype("u1" if header.bits == 8 else "<u2"),
    )


def _check_size(pixels: Path, text: Path, header: _Header, size: int) -> None:
    """A size that fits the header's frames at another depth only means that the depth is wrong."""
    shape = shape_text((header.height, header.width))
    if size != header.frames * header.frame_bytes:
        area = header.width * header.height
        fits = [bits for bits in _DEPTHS if header.frames * area * bits // 8 == size]
        if fits:
            wanted = f"{header.frames * header.frame_bytes} bytes for {header.frames} frames of {shape}, "
            found = f"{size} bytes, as {fits[0]} bit need"
            advice = f"correct Color Bit in {text.name}"
            raise InputError(pixels, f"{wanted}{header.bits} bit by {text.name}", found, advice)
    if size < header.frame_bytes:
        wanted = f"at least one frame of {shape}, {header.bits} bit, {header.frame_bytes} bytes"
        raise InputError(pixels, wanted, f"{size} bytes", "the recording was cut short; copy it again")


def _facts(pixels: Path, text: Path, header: _Header, size: int) -> Facts:
    held, rest = divmod(size, header.frame_bytes)
    warnings = []
    if held > header.frames:
        warnings.append(
            f"{pixels.name}: holds {held} frames where {text.name} says {header.frames}; all are read: "
            "check the width, height and Color Bit"
        )
    if rest:
        warnings.append(f"{pixels.name}: the file ends inside frame {held}, which is left out")
    if header.step > 1 and header.rate is not None:
        warnings.append(
            f"{text.name}: {header.rate:g} frames/s were recorded, and the save step is {header.step}: "
            f"if only every {header.step}th frame was saved, give `fps` {header.rate / header.step:g}"
        )
    bits = 8 if header.bits == 8 else min(header.bits, header.significant_bits)
    shift = header.bits - bits if header.side == "higher" and header.bits == 16 else 0
    declared = max(header.frames, held)
    return Facts(
        shape=(header.height, header.width),
        depth_bits=bits,
        saturation_level=full_scale(bits) * (1 << shift),
        declared_frames=declared,
        container="mraw",
        codec="packed" if header.bits == 12 else "uncompressed",
        pixel_format=f"grey {header.bits} bit" + (f", the upper {bits} used" if shift else ""),
        decoder="none",
        grey=AS_STORED,
        camera_fps=header.rate,
        warnings=tuple(warnings),
    )


def _read_header(text: Path) -> _Header:
    fields = _fields(text)
    kind = fields.get("Color Type", "Mono")
    if "mono" not in kind.lower():
        raise InputError(text, "Color Type : Mono", f"'{kind[:40]}'", "export the recording as grey")
    width, height = (_whole(text, fields, f"Image {side}", 1, 1 << 16) for side in ("Width", "Height"))
    bits = _whole(text, fields, "Color Bit", 1, 64)
    if bits not in _DEPTHS:
        raise InputError(text, "Color Bit : 8, 12 or 16", str(bits), "save the recording with one of these")
    if bits == 12 and width * height % 2:
        raise InputError(text, "an even number of pixels at 12 bit", shape_text((height, width)))
    rate = _number(fields.get("Record Rate(fps)"))
    effective = _number(fields.get("EffectiveBit Depth"))
    step = _number(fields.get("Save Step"))
    return _Header(
        width=width,
        height=height,
        bits=bits,
        significant_bits=int(effective) if effective and effective <= 16 else bits,
        side="higher" if fields.get("EffectiveBit Side", "").lower() == "higher" else "lower",
        frames=_whole(text, fields, "Total Frame", 1, _MOST_FRAMES),
        rate=rate,
        step=int(step or 1),
    )


def _fields(text: Path) -> Mapping[str, str]:
    """Names and values, of lines `name : value` or of the XML in a .cihx; the first of a name counts."""
    with text.open("rb") as file:
        content = file.read(_MOST_TEXT).decode("utf-8", errors="replace")
    if "<cih" not in content:
        lines = [line.partition(":") for line in content.splitlines()]
        return {name.strip(): value.strip() for name, colon, value in reversed(lines) if colon}
    xml = re.search(r"<cih\b.*</cih>", content, re.DOTALL)
    try:
        root = ElementTree.fromstring(xml[0] if xml else "")  # no entities without a DOCTYPE
    except ElementTree.ParseError as error:
        raise InputError(text, "a whole header of a Photron recording", f"damaged XML ({error})") from None
    return {name: value.strip() for name, place in _IN_XML.items() if (value := root.findtext(place))}


def _whole(text: Path, fields: Mapping[str, str], name: str, least: int, most: int) -> int:
    value = fields.get(name, "")
    if not re.fullmatch(r"[0-9]{1,12}", value) or not least <= int(value) <= most:
        found = f"'{value[:40]}'" if value else "none"
        raise InputError(text, f"{name} : a whole number from {least} to {most}", found, "copy it again")
    return int(value)


def _number(value: str | None) -> float | None:
    """A positive number, None for anything else."""
    try:
        number = float(value or "")
    except ValueError:
        return None
    return number if 0 < number < float("inf") else None
