"""Damage that knows a file's structure: sizes, counts and offsets are changed more often than pixels."""

import io
import re
import struct
import zipfile
import zlib
from collections.abc import Callable

import numpy as np

Random = np.random.Generator
SHEET = "xl/worksheets/sheet1.xml"
NUMBERS = (0, 1, 2, 3, 7, 8, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 1 << 20, 1 << 62)
WORDS = (
    *(
        "nan",
        "inf",
        "-inf",
        "1e308",
        "-1e308",
        "1e-320",
        "1e999",
        "9" * 400,
        "²",
        "٣",
        "\x00",
        '"',
        "'",
        "--",
    ),
    *(
        "",
        " " * 3000,
        "," * 300,
        ";" * 300,
        '"' * 301,
        "0x10",
        "1.2.3",
        "1,2,3",
        "+",
        "-",
        "e",
        "\ufeff",
        "\u2028",
    ),
    *("=1+1", "<script>", "%s", "{}", "Time", "Load [kN]", "(((((((((((((((", "mm", "#" * 200, "1" * 3000),
)


def mutated(data: bytes, kind: str, random: Random, other: bytes = b"") -> bytes:
    """One to four changes; sometimes first the end of another file of this kind in place of its own."""
    if other and random.random() < 0.1:
        at = random.random()
        data = data[: int(at * len(data))] + other[int(at * len(other)) :]
    if kind == "xlsx" and random.random() < 0.9:
        return _one_part(data, random)
    for _ in range(int(random.integers(1, 5))):
        changes = TEXT if kind in ("text", "times", "photron") else BINARY
        change = changes[int(random.integers(len(changes)))]
        data = change(data, kind, random)
    return with_checksums(data) if data[:4] == b"\x89PNG" and random.random() < 0.8 else data


def _one_part(data: bytes, random: Random) -> bytes:
    """A workbook with one of its XML files changed; unchanged if it is no archive any more."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as book:
            parts = {name: book.read(name) for name in book.namelist()}
    except (zipfile.BadZipFile, zlib.error, EOFError):
        return data
    name = list(parts)[int(random.integers(len(parts)))] if random.random() < 0.5 else SHEET
    parts[name] = mutated(parts[name], "text", random)
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as book:
        for part, content in parts.items():
            book.writestr(part, content)
    return packed.getvalue()


# --- places of numbers ------------------------------------------------------------------------------------


def places(data: bytes, kind: str) -> list[tuple[int, int]]:
    """(place, bytes) of the numbers a reader steers by."""
    found = FIELDS.get(kind, lambda _: [])(data)
    return [(at, size) for at, size in found if at + size <= len(data)]


def _riff(data: bytes) -> list[tuple[int, int]]:
    found = [(at + 4, 4) for at in _all(data, rb"RIFF|LIST|avih|strh|strf|00d[bc]|idx1|indx|dmlh|JUNK")]
    for name, size in ((b"avih", 56), (b"strh", 56), (b"strf", 40)):
        found += [(at + 8 + k, 4) for at in _all(data, name) for k in range(0, size, 4)]
    return found


def _tiff(data: bytes) -> list[tuple[int, int]]:
    order = "<" if data[:2] == b"II" else ">"
    big = len(data) > 4 and struct.unpack_from(order + "H", data, 2)[0] == 43
    width, entry, head = (8, 20, 8) if big else (4, 12, 2)
    number, count = order + ("Q" if big else "I"), order + ("Q" if big else "H")
    found, at = [(width, width)], 0
    for _ in range(12):
        if width + at + width > len(data):
            break
        at = struct.unpack_from(number, data, at or width)[0]
        if not at or at + head > len(data):
            break
        tags = struct.unpack_from(count, data, at)[0]
        found.append((at, head))
        for n in range(min(tags, 40)):
            tag = at + head + n * entry
            found += [
                (tag, 2),
                (tag + 2, 2),
                (tag + 4, width),
                (tag + 4 + width, width),
                (tag + 4 + width, 2),
            ]
        at += head + tags * entry
        found.append((at, width))
    return found


def _mp4(data: bytes) -> list[tuple[int, int]]:
    names = rb"ftyp|moov|mvhd|trak|tkhd|mdia|mdhd|minf|stbl|stsd|stts|stss|ctts|stsc|stsz|stco|mdat|avc1|elst"
    return [(at + k, 4) for at in _all(data, names) for k in (-4, 8, 12, 16, 20, 28, 32)]


def _matroska(data: bytes) -> list[tuple[int, int]]:
    masters = rb"\x18\x53\x80\x67|\x15\x49\xa9\x66|\x16\x54\xae\x6b|\x1f\x43\xb6\x75|\x1c\x53\xbb\x6b"
    names = masters + rb"|\xae|\xe0|\xb0|\xba|\xa3|\x44\x89"
    return [
        (at + k, size) for at in _all(data, names) for k, size in ((1, 1), (2, 1), (3, 2), (4, 1), (4, 4))
    ]


def _png(data: bytes) -> list[tuple[int, int]]:
    return [(at + k, 4) for at in _all(data, rb"IHDR|IDAT|PLTE|IEND") for k in (-4, 4, 8)] + [
        (at + k, 1) for at in _all(data, rb"IHDR") for k in range(12, 17)
    ]


def _cine(data: bytes) -> list[tuple[int, int]]:
    return (
        [(k, 4) for k in range(0, 84, 4)]
        + [(84 + k, 4) for k in (140, 142, 896)]
        + [(2084 + k, 4) for k in range(0, 140, 4)]
    )


def _mat(data: bytes) -> list[tuple[int, int]]:
    return [(k, 4) for k in range(120, min(len(data), 700), 4)]


def _hdf5(data: bytes) -> list[tuple[int, int]]:
    head = [(k, 8) for k in range(8, 100, 4)]
    return head + [(at + k, 4) for at in _all(data, rb"TREE|SNOD|HEAP|OHDR|FRHP") for k in range(4, 40, 4)]


def _all(data: bytes, pattern: bytes) -> list[int]:
    return [match.start() for match in re.finditer(pattern, data, re.DOTALL)]


FIELDS: dict[str, Callable[[bytes], list[tuple[int, int]]]] = {
    "riff": _riff,
    "tiff": _tiff,
    "mp4": _mp4,
    "matroska": _matroska,
    "png": _png,
    "images": lambda data: (_png if data[:4] == b"\x89PNG" else _tiff)(data),
    "cine": _cine,
    "mat": _mat,
    "hdf5": _hdf5,
}

# --- changes ----------------------------------------------------------------------------------------------


def number(data: bytes, kind: str, random: Random) -> bytes:
    """A number of the structure becomes another one: extreme, near, or any."""
    known = [place for place in places(data, kind) if place[0] >= 0]
    if not known:
        return flip(data, kind, random)
    at, size = known[int(random.integers(len(known)))]
    order = "big" if kind in ("mp4", "matroska", "png", "images") or data[:2] == b"MM" else "little"
    old = int.from_bytes(data[at : at + size], order)
    options = (
        NUMBERS[int(random.integers(len(NUMBERS)))],
        old + int(random.integers(-3, 4)),
        old * 2 + 1,
        len(data) + int(random.integers(-9, 9)),
        int(random.integers(0, 1 << 31)),
        old ^ (1 << int(random.integers(8 * size))),
    )
    new = options[int(random.integers(len(options)))] % (1 << 8 * size)
    return data[:at] + new.to_bytes(size, order) + data[at + size :]


def flip(data: bytes, kind: str, random: Random) -> bytes:
    """A few bits anywhere."""
    out = bytearray(data)
    for _ in range(int(random.integers(1, 12))):
        if out:
            out[int(random.integers(len(out)))] ^= 1 << int(random.integers(8))
    return bytes(out)


def cut(data: bytes, kind: str, random: Random) -> bytes:
    """The end is missing."""
    return data[: int(random.integers(len(data) + 1))]


def remove(data: bytes, kind: str, random: Random) -> bytes:
    """A piece is missing."""
    first, last = _span(data, random)
    return data[:first] + data[last:]


def repeat(data: bytes, kind: str, random: Random) -> bytes:
    """A piece comes twice."""
    first, last = _span(data, random)
    return data[:last] + data[first:last] + data[last:]


def blank(data: bytes, kind: str, random: Random) -> bytes:
    """A piece is zeros, as of a disk block that was never written."""
    first, last = _span(data, random)
    return data[:first] + bytes(last - first) + data[last:]


def junk(data: bytes, kind: str, random: Random) -> bytes:
    """A piece is noise."""
    first, last = _span(data, random)
    return data[:first] + random.bytes(last - first) + data[last:]


def swap(data: bytes, kind: str, random: Random) -> bytes:
    """Two pieces change places."""
    (a, b), (c, d) = sorted((_span(data, random), _span(data, random)))
    return data if b > c else data[:a] + data[c:d] + data[b:c] + data[a:b] + data[d:]


def reverse(data: bytes, kind: str, random: Random) -> bytes:
    """The words of a piece are in the other byte order."""
    first, last = _span(data, random)
    size = (2, 4, 8)[int(random.integers(3))]
    last -= (last - first) % size
    words = np.frombuffer(data[first:last], np.uint8).reshape(-1, size)
    return data[:first] + words[:, ::-1].tobytes() + data[last:]


def real(data: bytes, kind: str, random: Random) -> bytes:
    """A number of the structure becomes a floating-point one that nobody expects."""
    known = places(data, kind)
    at = known[int(random.integers(len(known)))][0] if known else int(random.integers(len(data) + 1))
    value = (float("nan"), float("inf"), -0.0, 1e-310, -1e300)[int(random.integers(5))]
    packed = struct.pack("<>"[int(random.integers(2))] + "d", value)
    return data[:at] + packed + data[at + 8 :] if at >= 0 else data


def nest(data: bytes, kind: str, random: Random) -> bytes:
    """The beginning of an element stands in itself, many times."""
    known = [at for at, _ in places(data, kind) if at >= 0] or [0]
    at = max(0, known[int(random.integers(len(known)))] - 4)
    size = (8, 12, 20, 64)[int(random.integers(4))]
    return data[:at] + data[at : at + size] * int(2 ** random.uniform(1, 12)) + data[at:]


def columns(data: bytes, kind: str, random: Random) -> bytes:
    """A column of a table goes, comes twice, or changes place with another in all lines from one on."""
    lines = [re.split(rb"([,;\t:]| {2,})", one) for one in data.split(b"\n")]
    start, width = int(random.integers(len(lines))), max(map(len, lines))
    a, b = (2 * int(random.integers((width + 1) // 2)) for _ in range(2))
    how = int(random.integers(3))
    for cells in lines[start:]:
        if max(a, b) < len(cells):
            if how == 0:
                del cells[a : a + 2]
            elif how == 1:
                cells[a:a] = cells[a : a + 2]
            else:
                cells[a], cells[b] = cells[b], cells[a]
    return b"\n".join(b"".join(cells) for cells in lines)


def cell(data: bytes, kind: str, random: Random) -> bytes:
    """A word takes the place of a cell."""
    parts = re.split(rb"([,;\t\n]| {2,})", data)
    parts[int(random.integers(len(parts)))] = WORDS[int(random.integers(len(WORDS)))].encode()
    return b"".join(parts)


def line(data: bytes, kind: str, random: Random) -> bytes:
    """A line goes, comes twice, is of blanks, or is padded."""
    lines = data.split(b"\n")
    at = int(random.integers(len(lines)))
    options = (
        [],
        [lines[at]] * 2,
        [b""] * 3,
        [lines[at].replace(b",", b" , ") + b" " * 2000 + b"x"],
        [b'"' + lines[at]],
    )
    lines[at : at + 1] = options[int(random.integers(len(options)))]
    return b"\n".join(lines)


def recode(data: bytes, kind: str, random: Random) -> bytes:
    """Another encoding, line end or separator."""
    options = (
        data.decode("utf-8", "replace").encode("utf-16"),
        data.replace(b"\n", b"\r\n"),
        data.replace(b"\n", b"\r"),
        data.replace(b",", b";"),
        data.replace(b".", b","),
        data.replace(b"\n", b"\x00"),
        b"\xef\xbb\xbf" + data,
        data.replace(b"e", b"\xe9"),
    )
    return options[int(random.integers(len(options)))]


def _span(data: bytes, random: Random) -> tuple[int, int]:
    first = int(random.integers(len(data) + 1))
    return first, min(len(data), first + int(2 ** random.uniform(0, 10)))


def with_checksums(data: bytes) -> bytes:
    """A PNG whose chunks have the right checksums, so that damage gets past them."""
    out, at = bytearray(data), 8
    while at + 12 <= len(out):
        end = at + 8 + int.from_bytes(out[at : at + 4], "big")
        if end + 4 > len(out):
            break
        out[end : end + 4] = zlib.crc32(out[at + 4 : end]).to_bytes(4, "big")
        at = end + 4
    return bytes(out)


ANY = (flip, cut, remove, repeat, blank, junk, swap)
BINARY = (*ANY, number, number, number, number, reverse, real, nest)
TEXT = (*ANY, cell, cell, cell, line, line, columns, recode)
