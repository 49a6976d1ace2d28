"""in_blocks(): frames that come one by one from a decoder, gathered into blocks."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import DTypeLike, NDArray

from vision.video.source import Block, Status

BLOCK_BYTES = 16 << 20  # large enough to hide Python's cost per block, small enough for a few in memory
BLOCK_FRAMES = 256


@dataclass(frozen=True)
class Shot:
    """One frame as a decoder hands it over: whole grey pixels, None if undecodable, and its own time."""

    pixels: NDArray[np.generic] | None
    status: Status = "ok"
    time_s: float | None = None


def frames_per_block(rows: int, columns: int, itemsize: int) -> int:
    """How many frames of this cut make a block."""
    return max(1, min(BLOCK_FRAMES, BLOCK_BYTES // max(1, rows * columns * itemsize)))


def in_blocks(
    shots: Iterable[Shot], *, start: int, rows: slice, columns: slice, dtype: DTypeLike
) -> Iterator[Block]:
    """Blocks of the shots, numbered from `start`, cut to `rows` and `columns`."""
    shape = (rows.stop - rows.start, columns.stop - columns.start)
    size = frames_per_block(*shape, np.dtype(dtype).itemsize)
    source = iter(shots)
    while batch := list(itertools.islice(source, size)):
        pixels = np.zeros((len(batch), *shape), dtype)
        for out, shot in zip(pixels, batch, strict=True):
            if shot.pixels is not None:
                out[:] = shot.pixels[rows, columns]
        yield Block(pixels, start, tuple(shot.status for shot in batch), _times(batch))
        start += len(batch)


def _times(batch: list[Shot]) -> NDArray[np.float64] | None:
    if all(shot.time_s is None for shot in batch):
        return None
    return np.array([np.nan if shot.time_s is None else shot.time_s for shot in batch])
