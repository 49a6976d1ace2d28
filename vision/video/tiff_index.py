"""The chain of pages of a TIFF, walked and bounded before a library reads it."""

from __future__ import annotations

import os
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from vision.errors import InputError
from vision.files import check_pixels

MOST_TAGS = 1000
"""Tags of one page. Microscopes write up to 60; more refuses fewer damaged pages, which take long."""
MOST_TAG_BYTES = 1 << 26
"""Bytes that all tags may point to besides the file's own size: shared values would take for ever."""
_BYTES_OF_TYPE = dict(enumerate((1, 1, 2, 4, 8, 1, 1, 2, 4, 8, 4, 8, 4, 2, 4, 8, 8, 8, 8), 1))
_WIDTH, _LENGTH, _SAMPLES = 256, 257, 277
_ADVICE = "copy or export it again"


@dataclass(frozen=True)
class _Form:
    """How a classic or a big TIFF lays out numbers: of tags, one tag, an offset; bytes a tag holds itself."""

    count: struct.Struct
    tag: struct.Struct
    offset: struct.Struct
    inside: int


def _form(head: bytes) -> tuple[_Form, int]:
    """The layout, and where the first offset stands."""
    order = "<" if head[:2] == b"II" else ">"
    if struct.unpack_from(f"{order}H", head, 2)[0] == 43:
        return _Form(
            struct.Struct(f"{order}Q"), struct.Struct(f"{order}HHQ8s"), struct.Struct(f"{order}Q"), 8
        ), 8
    return _Form(struct.Struct(f"{order}H"), struct.Struct(f"{order}HHI4s"), struct.Struct(f"{order}I"), 4), 4


def check_tiff(path: Path, *, frames: bool = True) -> None:
    """Refuse a TIFF whose index would lead a reader in circles, or whose pages are no pictures.

    A chain that leaves the file is fine: such a file was cut short.

    Parameters
    ----------
    path
        The file.
    frames
        Whether its pages are frames, which have a largest size; space-time diagrams have none.

    Raises
    ------
    InputError
        For a chain that returns to an earlier page, more tags than a page has, tags that together point to
        more than the file holds, or pages of no pixels or far too many.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        form, at = _form(file.read(16).ljust(16, b"\0"))
        file.seek(at)
        place = _unpacked(form.offset, file)
        seen: set[int] = set()
        spent = 0
        while place and place < size:
            if place in seen:
                raise InputError(
                    path, "a TIFF stack", f"one whose page {len(seen)} is an earlier one", _ADVICE
                )
            seen.add(place)
            file.seek(place)
            pointed, shape = _page_facts(file, form, path, number=len(seen) - 1, order=form.tag.format[:1])
            spent += pointed
            if frames and shape is not None:
                check_pixels(path, *shape)
            if spent > size + MOST_TAG_BYTES:
                raise InputError(path, "a TIFF stack", "tags that point to more than the file holds", _ADVICE)
            place = _unpacked(form.offset, file)


def _page_facts(
    file: BinaryIO, form: _Form, path: Path, *, number: int, order: str
) -> tuple[int, tuple[int, int] | None]:
    """Bytes the tags of the page at the file's place point to, and its rows and values per row.

    The place is then behind the tags.
    """
    tags = _unpacked(form.count, file)
    if tags > MOST_TAGS:
        wanted = f"at most {MOST_TAGS} tags in page {number}"
        raise InputError(path, wanted, str(tags), _ADVICE)
    data = file.read(tags * form.tag.size)
    size = os.fstat(file.fileno()).st_size
    spent, shape = 0, {}
    for code, kind, count, value in form.tag.iter_unpack(data[: len(data) // form.tag.size * form.tag.size]):
        held = count * _BYTES_OF_TYPE.get(kind, 1)
        if held > form.inside:
            if held > size:
                found = f"{held} bytes in a file of {size}"
                raise InputError(path, f"a tag {code} of page {number} that fits in the file", found, _ADVICE)
            spent += held
        elif code in (_WIDTH, _LENGTH, _SAMPLES):
            shape[code] = _number(value, kind, order)
    if _WIDTH in shape and _LENGTH in shape:
        return spent, (shape[_LENGTH], shape[_WIDTH] * max(1, shape.get(_SAMPLES, 1)))
    return spent, None


def _number(value: bytes, kind: int, order: str) -> int:
    """A whole number of one, two, four or eight bytes; 0 for another type."""
    code = {1: "B", 3: "H", 4: "I", 16: "Q"}.get(kind)
    return int(struct.unpack_from(order + code, value)[0]) if code else 0


def _unpacked(form: struct.Struct, file: BinaryIO) -> int:
    """The next number; 0 where the file ends."""
    data = file.read(form.size)
    return int(form.unpack(data)[0]) if len(data) == form.size else 0
