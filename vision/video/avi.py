"""AviLayout: what an AVI file says of itself and where its frames lie, from its chunks alone."""

from __future__ import annotations

import os
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from vision.errors import InputError

_LISTS = {b"RIFF", b"LIST"}
_SKIPPED_LISTS = {b"INFO", b"odml"}
_HEADER = struct.Struct("<4sI")


@dataclass(frozen=True)
class AviLayout:
    """The first video stream of an AVI file.

    fourcc: compression, four bytes, zeros for plain bitmaps.  height is never negative: top_down keeps the
    sign. palette: (entries, 4) blue, green, red, 0.  promised: frames by the header, None without a
    promise. offsets, sizes: place and length of every whole frame held; length 0 is a frame the camera
    dropped. cut_short: the file ends inside a frame.  Source: Microsoft AVI RIFF reference; OpenDML AVI
    1.02.
    """

    fourcc: bytes
    bits: int
    width: int
    height: int
    top_down: bool
    palette: NDArray[np.uint8]
    promised: int | None
    fps: float | None
    offsets: NDArray[np.int64]
    sizes: NDArray[np.int64]
    cut_short: bool


@dataclass
class _Gathered:
    """What the walk through the chunks has met so far."""

    stream: int = -1
    video: int = -1
    strh: bytes = b""
    strf: bytes = b""
    dmlh: int = 0


def is_avi(path: Path) -> bool:
    """True for a RIFF file of the form AVI."""
    with path.open("rb") as file:
        head = file.read(12)
    return head[:4] == b"RIFF" and head[8:12] == b"AVI "


def read_avi_layout(path: Path) -> AviLayout:
    """Walk through the chunks, OpenDML segments included; index and list sizes are not trusted.

    So files without index, with a broken one, over 1 GiB, or cut short give every whole frame they hold.
    Raises: InputError for an AVI without a video stream.
    """
    with path.open("rb", buffering=0) as file:
        size = os.fstat(file.fileno()).st_size
        met, frames, cut_short = _walk(file, size, path)
    if len(met.strf) < 40:
        raise InputError(path, "an AVI with a video stream", "none in its header", "record or copy it again")
    _, width, height, _, bits, fourcc, _, _, _, used, _ = struct.unpack_from("<IiiHH4sIiiII", met.strf)
    scale, rate, _, length = struct.unpack_from("<4I", met.strh, 20)
    table = np.frombuffer(met.strf[40 : 40 + 4 * (used or 256)], np.uint8)
    where = np.array(frames, np.int64).reshape(-1, 2)
    return AviLayout(
        fourcc=fourcc,
        bits=bits,
        width=width,
        height=abs(height),
        top_down=height < 0,
        palette=table[: table.size // 4 * 4].reshape(-1, 4),
        promised=max(length, met.dmlh) or None,
        fps=rate / scale if scale and rate else None,
        offsets=where[:, 0],
        sizes=where[:, 1],
        cut_short=cut_short,
    )


def _walk(file: BinaryIO, size: int, path: Path) -> tuple[_Gathered, list[tuple[int, int]], bool]:
    """Chunk by chunk to the end of the file: headers, frames (place, length), and whether the last is cut."""
    met, at = _Gathered(), 0
    frames: list[tuple[int, int]] = []
    while at + 8 <= size:
        file.seek(at)
        head = file.read(12)
        name, length = _HEADER.unpack_from(head)
        if name in _LISTS and head[8:12] not in _SKIPPED_LISTS:
            at += 12
            continue
        if name[2:] in (b"db", b"dc") and name[:2] == b"%02d" % met.video:
            if at + 8 + length > size:
                return met, frames, True
            frames.append((at + 8, length))
        elif name[2:] == b"pc":
            raise InputError(
                path, "one palette for all frames", "a palette change", "export the video as grey"
            )
        elif not name.isascii() or name == bytes(4):  # space a camera reserved and never filled
            break
        else:
            _note(met, name, length, file, at)
        at += 8 + length + length % 2
    return met, frames, False


def _note(met: _Gathered, name: bytes, length: int, file: BinaryIO, at: int) -> None:
    """Keep a header chunk that describes the first video stream."""
    if name not in (b"strh", b"strf", b"LIST"):
        return
    file.seek(at + 8)
    data = file.read(min(length, 4096))
    if name == b"LIST":
        met.dmlh = struct.unpack_from("<I", data, 12)[0] if data[4:8] == b"dmlh" else met.dmlh
    elif name == b"strh":
        met.stream += 1
        if data[:4] == b"vids" and met.video < 0:
            met.video, met.strh = met.stream, data
    elif met.stream == met.video:
        met.strf = data
