"""Small recordings with known pixels, written byte by byte or by other libraries' writers."""

from __future__ import annotations

import struct
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray


def comb(count=6, rows=12, columns=50, *, top=255, dtype=np.uint8):
    """Frames (count, rows, columns) of a moving comb with texture along z: no two rows or frames alike."""
    t, z, x = np.ogrid[:count, :rows, :columns]
    wave = 0.5 + 0.3 * np.cos(2 * np.pi * (x - 0.6 * t) / 9.7) + 0.1 * np.cos(0.8 * z + 0.1 * x)
    return np.round(wave / 0.92 * top).astype(dtype)


def chunk(name: bytes, data: bytes) -> bytes:
    """A RIFF chunk, padded to an even size."""
    return name + struct.pack("<I", len(data)) + data + b"\0" * (len(data) % 2)


def lists(name: bytes, *chunks: bytes) -> bytes:
    """A RIFF list of chunks."""
    return chunk(b"LIST", name + b"".join(chunks))


def avi_header(*, width, height, bits, fourcc, palette=b"", frames, fps=25, total=None) -> bytes:
    """Header of an AVI of one uncompressed stream; `total`: the frames of all OpenDML segments."""
    strh = struct.pack(
        "<4s4sIHHIIIIIIII4h", b"vids", b"\0\0\0\0", 0, 0, 0, 0, 1, fps, 0, frames, 0, 0, 0, 0, 0, 0, 0
    )
    strf = struct.pack("<IiiHH4sIiiII", 40, width, height, 1, bits, fourcc, 0, 0, 0, len(palette) // 4, 0)
    avih = struct.pack("<14I", 1_000_000 // fps, 0, 0, 0, frames, 0, 1, 0, width, abs(height), 0, 0, 0, 0)
    extra = [] if total is None else [lists(b"odml", chunk(b"dmlh", struct.pack("<62I", total, *[0] * 61)))]
    stream = lists(b"strl", chunk(b"strh", strh), chunk(b"strf", strf + palette))
    return lists(b"hdrl", chunk(b"avih", avih), stream, *extra)


def stored(frame: NDArray, *, bottom_up: bool, pad: bool) -> bytes:
    """One frame as an AVI chunk holds it."""
    rows = frame[::-1] if bottom_up else frame
    lines = [line.tobytes() for line in rows]
    return b"".join(line + b"\0" * (-len(line) % 4 if pad else 0) for line in lines)


def write_avi(
    path: Path,
    frames: NDArray,
    *,
    bits=8,
    fourcc=b"Y800",
    bottom_up=False,
    pad=False,
    negative_height=False,
    palette=b"",
    segments=1,
    drop=(),
    index=True,
    promised=None,
) -> Path:
    """A raw AVI; `segments` RIFF chunks as OpenDML has them; `drop`ped frames are chunks of no length;
    `promised` frames stand in the header where it is wrong."""
    height, width = frames.shape[1:3]
    chunks = [
        chunk(
            b"00db" if fourcc == bytes(4) else b"00dc",
            b"" if n in drop else stored(f, bottom_up=bottom_up, pad=pad),
        )
        for n, f in enumerate(frames)
    ]
    header = avi_header(
        width=width,
        height=-height if negative_height else height,
        bits=bits,
        fourcc=fourcc,
        palette=palette,
        frames=len(frames) if promised is None else promised,
    )
    parts = np.array_split(np.arange(len(chunks)), segments)
    movi = [lists(b"movi", *(chunks[n] for n in part)) for part in parts]
    idx1 = chunk(b"idx1", bytes(16 * len(parts[0]))) if index else b""
    out = chunk(b"RIFF", b"AVI " + header + chunk(b"JUNK", bytes(37)) + movi[0] + idx1)
    out += b"".join(chunk(b"RIFF", b"AVIX" + part) for part in movi[1:])
    path.write_bytes(out)
    return path


def write_encoded(
    path: Path, frames: NDArray, *, codec: str, pix_fmt: str, source: str, fps=25, options=None
) -> Path:
    """A video by FFmpeg's own writers. source: the pixel format of `frames`."""
    with av.open(str(path), "w") as out:
        stream = out.add_stream(codec, rate=fps, options=options or {})
        stream.height, stream.width = frames.shape[1:3]
        stream.pix_fmt = pix_fmt
        stream.codec_context.time_base = Fraction(1, fps)
        for n, pixels in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(pixels, format=source)
            frame.pts, frame.time_base = n, Fraction(1, fps)
            out.mux(stream.encode(frame))
        out.mux(stream.encode(None))
    return path


def whole(video) -> NDArray:
    """All frames of a video, stacked, whatever their status."""
    return np.concatenate([block.pixels for block in video.blocks()])


def states(video) -> list[str]:
    """Status of every frame."""
    return [status for block in video.blocks() for status in block.status]


def write_cine(path, frames, *, real_bits, rate=1000.0, odd_time=None, mosaic=False):
    """An unpacked cine: bottom row first, one time per frame, annotations of any length; colour is BGR."""
    count, height, width = frames.shape[:3]
    setup = bytearray(1024)
    setup[140:144] = struct.pack("<2sH", b"ST", len(setup))
    setup[896:900] = struct.pack("<I", real_bits)
    ticks = (np.arange(count) / rate * 2**32).astype("<u8") + np.uint64(1_700_000_000 << 32)
    if odd_time is not None:
        ticks[odd_time] += np.uint64(10**7 << 32)
    times = struct.pack("<IHH", 8 + 8 * count, 1002, 0) + ticks.tobytes()
    images_at = 44 + 40 + len(setup) + len(times)
    blobs = [struct.pack("<I", 8 + n) + bytes(n) + bytes(4) + f[::-1].tobytes() for n, f in enumerate(frames)]
    places = images_at + 8 * count + np.concatenate([[0], np.cumsum([len(b) for b in blobs[:-1]])])
    head = struct.pack(
        "<2sHHHiIiIIII8s", b"CI", 44, 2 * mosaic, 1, 0, count, 0, count, 44, 84, images_at, bytes(8)
    )
    bits = 8 * frames[0, 0, 0].nbytes
    bitmap = struct.pack("<IiiHHIIiiII", 40, width, height, 1, bits, 0, frames[0].nbytes, 0, 0, 0, 0)
    path.write_bytes(head + bitmap + setup + times + places.astype("<i8").tobytes() + b"".join(blobs))
    return path
