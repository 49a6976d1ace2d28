"""MappedFrames: uncompressed frames at known places of a file, read through a memory map."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.video.batching import frames_per_block
from vision.video.grey import luma
from vision.video.source import Block, Facts, Status


@dataclass(frozen=True, kw_only=True)
class MappedReader:
    """A `Reader` of frames that lie uncompressed in a file; only the pages of the wanted rows are touched.

    offsets: byte place of every frame's first stored row, -1 for a frame the camera lost.
    row_bytes: from one stored row to the next.  dtype: of one channel.  channels: 1, or 3 or 4 for colour.
    blue_first: colour is BGR.  bottom_up: the lowest row is stored first.  grey_levels: value for every
    stored 8-bit index (a palette); None where values are what they mean.
    Each block is mapped on its own, so memory does not grow with the file.
    """

    path: Path
    facts: Facts
    offsets: NDArray[np.int64]
    row_bytes: int
    dtype: np.dtype[np.generic]
    channels: int = 1
    blue_first: bool = False
    bottom_up: bool = False
    grey_levels: NDArray[np.uint8] | None = None

    def read(self, start: int, stop: int | None, rows: slice, columns: slice) -> Iterator[Block]:
        """Runs of equally spaced frames, each block one strided view of the file."""
        end = self.offsets.size if stop is None else min(stop, self.offsets.size)
        shape = (rows.stop - rows.start, columns.stop - columns.start)
        size = frames_per_block(*shape, self.dtype.itemsize * self.channels)
        for first, last in _even_runs(self.offsets, start, end):
            for at in range(first, last, size):
                yield self._block(at, min(at + size, last), rows, columns)

    def sample(self, numbers: Sequence[int]) -> Iterator[NDArray[np.generic]]:
        """Exactly these frames, whole; those the file does not hold are left out."""
        height, width = self.facts.shape
        for n in numbers:
            if n < self.offsets.size and self.offsets[n] >= 0:
                yield self._block(n, n + 1, slice(0, height), slice(0, width)).pixels[0]

    def _block(self, first: int, last: int, rows: slice, columns: slice) -> Block:
        count = last - first
        if self.offsets[first] < 0:
            nothing = np.zeros((count, rows.stop - rows.start, columns.stop - columns.start), self._native)
            return Block(nothing, first, _all("lost", count))
        return Block(self._grey(self._view(first, last)[:, rows, columns]), first, _all("ok", count))

    def _view(self, first: int, last: int) -> NDArray[np.generic]:
        """Frames first..last, (k, rows, columns) or with channels last, top row first, not copied."""
        height, width = self.facts.shape
        step = int(self.offsets[first + 1] - self.offsets[first]) if last - first > 1 else 0
        pixel = self.dtype.itemsize * self.channels
        length = step * (last - first - 1) + (height - 1) * self.row_bytes + width * pixel
        raw = np.memmap(self.path, np.uint8, "r", offset=int(self.offsets[first]), shape=(length,))
        view: NDArray[np.generic] = np.ndarray(
            (last - first, height, width, self.channels),
            self.dtype,
            raw,
            strides=(step, self.row_bytes, pixel, self.dtype.itemsize),
        )
        view = view if self.channels > 1 else view[..., 0]
        return view[:, ::-1] if self.bottom_up else view

    def _grey(self, pixels: NDArray[np.generic]) -> NDArray[np.generic]:
        if self.channels > 1:
            k, height, width = pixels.shape[:3]
            colour = pixels[..., 2::-1] if self.blue_first else pixels[..., :3]
            return luma(colour.astype(self._native).reshape(k * height, width, 3)).reshape(k, height, width)
        if self.grey_levels is not None:
            flat = np.ascontiguousarray(pixels).reshape(-1, pixels.shape[-1])
            return np.asarray(cv2.LUT(flat, self.grey_levels)).reshape(pixels.shape)
        return pixels if self.dtype.isnative else pixels.astype(self._native)

    @property
    def _native(self) -> np.dtype[np.generic]:
        return self.dtype.newbyteorder("=")


def _all(status: Status, count: int) -> tuple[Status, ...]:
    return (status,) * count


def _even_runs(offsets: NDArray[np.int64], start: int, stop: int) -> Iterator[tuple[int, int]]:
    """Half-open ranges within which frames are equally spaced and forward, or all lost."""
    while start < stop:
        steps = np.diff(offsets[start:stop])
        lost = offsets[start] < 0
        even = offsets[start + 1 : stop] < 0 if lost else (steps == steps[:1]) & (steps > 0)
        if not lost:
            even &= offsets[start + 1 : stop] >= 0
        length = int(np.argmin(even)) + 1 if not even.all() else even.size + 1
        yield start, start + length
        start += length
