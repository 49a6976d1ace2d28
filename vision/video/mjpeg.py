"""MjpegReader: motion JPEG, every packet one JPEG, the grey plane alone decoded on all cores."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import av
import numpy as np
import simplejpeg
from numpy.typing import NDArray

from vision.errors import InputError
from vision.video.batching import Shot, in_blocks
from vision.video.encoded import EncodedReader, open_container, video_packets, video_stream
from vision.video.source import Block

_AHEAD = 32  # packets handed to the threads at once
_ROUNDING = 1  # grey levels by which two correct JPEG decoders may differ


class MjpegReader(EncodedReader):
    """The same facts and frames as `EncodedReader`, twice as fast.

    libjpeg-turbo decodes the Y plane alone. It rounds differently from FFmpeg in one pixel of a hundred, by
    one grey level; `open_encoded` checks that nothing more than this differs.  A damaged JPEG gives a frame
    "corrupt".
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.facts.notes["decoder"] = "libjpeg-turbo"

    def read(self, start: int, stop: int | None, rows: slice, columns: slice) -> Iterator[Block]:
        """Frames in file order; those before `start` are not decoded."""
        shots = self._jpeg_shots(start, stop)
        yield from in_blocks(shots, start=start, rows=rows, columns=columns, dtype=np.uint8)

    def _jpeg_shots(self, start: int, stop: int | None) -> Iterator[Shot]:
        with open_container(self._path) as container, ThreadPoolExecutor(os.cpu_count()) as pool:
            stream = video_stream(container, self._path)
            wanted = itertools.islice(self._jpegs(container, stream), start, stop)
            while batch := list(itertools.islice(wanted, _AHEAD)):
                yield from pool.map(self._decode, batch)

    def _jpegs(
        self, container: av.container.InputContainer, stream: av.VideoStream
    ) -> Iterator[tuple[bytes, float | None]]:
        """(JPEG, its own time) for every frame number; no bytes for a frame the camera dropped."""
        number = 0
        for packet in video_packets(container, stream):
            if packet is None:
                return
            for _ in range(self._skipped(packet.pts, number, stream)):
                yield b"", None
                number += 1
            yield bytes(packet), self._time_s(packet.pts, stream)
            number += 1

    def _decode(self, jpeg: tuple[bytes, float | None]) -> Shot:
        data, time_s = jpeg
        if not data:
            return Shot(None, "lost", time_s)
        try:
            pixels = simplejpeg.decode_jpeg(data, colorspace="GRAY")[..., 0]
        except ValueError:
            return Shot(None, "corrupt", time_s)
        if pixels.shape != self.facts.shape:
            height, width = self.facts.shape
            found = f"one of {pixels.shape[1]} x {pixels.shape[0]}"
            raise InputError(self._path, f"every frame {width} x {height}", found, "split the recording")
        return Shot(pixels, "ok", time_s)


def open_encoded(path: Path) -> EncodedReader:
    """The reader for a compressed video: this one where it fits, else FFmpeg's own decoder."""
    reader = EncodedReader(path)
    return MjpegReader(path) if _fits(path, reader) else reader


def _fits(path: Path, reader: EncodedReader) -> bool:
    """True where the first frame's JPEG decodes to FFmpeg's Y plane but for rounding.

    False for other codecs, interlaced or lossless JPEG and JPEG in RGB: those stay with FFmpeg.
    """
    if reader.facts.notes["codec"] != "mjpeg" or reader.facts.depth_bits != 8:
        return False
    with open_container(path) as container:
        packet = next(video_packets(container, video_stream(container, path)), None)
        if packet is None:
            return False
        try:
            fast = simplejpeg.decode_jpeg(bytes(packet), colorspace="GRAY")[..., 0]
        except ValueError:
            return False
    slow = next(iter(reader.sample([0])), None)
    return slow is not None and slow.shape == fast.shape and _furthest(fast, slow) <= _ROUNDING


def _furthest(a: NDArray[np.generic], b: NDArray[np.generic]) -> int:
    return int(np.abs(np.asarray(a, np.int16) - np.asarray(b, np.int16)).max())
