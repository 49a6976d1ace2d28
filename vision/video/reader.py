"""Interface of the readers of file formats: `Facts` from the headers, then blocks of grey frames."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import cv2
import numpy as np
from numpy.typing import DTypeLike

from vision.numeric import Floats, Pixels

Status = Literal["ok", "corrupt", "lost"]

LUMA_RULE = "BT.601 luma, 0.299 R + 0.587 G + 0.114 B, rounded"
AS_STORED = "values as stored"


@dataclass(frozen=True, kw_only=True)
class Facts:
    """Facts from the headers of a file, in the file's own orientation.

    Parameters
    ----------
    shape
        (rows, columns).
    depth_bits, saturation_level
        Significant bits per pixel, 32 for float; value of a saturated pixel, None for float.
    declared_frames
        Number of frames that the file states; None without.
    estimated_frames
        Number of frames from duration and rate, if none is declared.
    duration_s
        Duration that the file states, if frames carry times.
    playback_fps
        The container's rate, which need not be the camera's.
    camera_fps
        The rate at which the camera recorded according to its header, if frames carry no times.
    times_s
        The recording's own time of each frame (frame), if the headers contain them.
    times_in_blocks
        Whether these times come with the blocks instead.
    turned_deg
        Degrees clockwise by which the file is to be turned for display, as phones state.
    container, codec, pixel_format, decoder, grey
        How pixels are stored, which program decodes them, and what a grey value means.
    warnings
        Conditions that may spoil the results.
    """

    shape: tuple[int, int]
    depth_bits: int
    saturation_level: float | None
    declared_frames: int | None
    container: str
    codec: str
    pixel_format: str
    decoder: str
    grey: str
    estimated_frames: int | None = None
    duration_s: float | None = None
    playback_fps: float | None = None
    camera_fps: float | None = None
    times_s: Floats | None = None
    times_in_blocks: bool = False
    turned_deg: int = 0
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Block:
    """Consecutive frames, cut to the rows and columns asked for.

    Parameters
    ----------
    pixels
        (k, rows, columns), grey, in the file's own unsigned type or float32; read only. Pixels of a frame
        that is not "ok" have no meaning.
    start
        Number of the first frame, counted from 0 at the start of the file.
    status
        One entry per frame.
    times_s
        The recording's own time of each frame, s, if it is known only as frames are read.
    """

    pixels: Pixels
    start: int
    status: tuple[Status, ...]
    times_s: Floats | None = None


class Reader(Protocol):
    """Reader of one file format, with pixels in the file's own orientation."""

    @property
    def facts(self) -> Facts:
        """Facts, known as soon as the file is open."""
        ...

    def read(self, start: int, stop: int | None, rows: slice, columns: slice) -> Iterator[Block]:
        """Yield frames `start` to `stop` in order, each number exactly once, cut to rows and columns."""
        ...

    def sample(self, numbers: Sequence[int]) -> Iterator[Pixels]:
        """Yield whole readable frames at or near these numbers, fewer if the file has no entry there."""
        ...


@dataclass(frozen=True)
class Frame:
    """One whole decoded frame. pixels: None if not readable. time_s: its own time, if it has one."""

    pixels: Pixels | None
    status: Status = "ok"
    time_s: float | None = None


def frames_per_block(rows: int, columns: int, itemsize: int) -> int:
    """Return the number of frames per block: up to 16 MiB, so that Python's cost per block is negligible."""
    return max(1, min(256, (16 << 20) // max(1, rows * columns * itemsize)))


def gather_blocks(
    frames: Iterable[Frame], *, start: int, rows: slice, columns: slice, dtype: DTypeLike
) -> Iterator[Block]:
    """Collect single frames into blocks, numbered from `start` and cut to `rows` and `columns`."""
    shape = (rows.stop - rows.start, columns.stop - columns.start)
    size = frames_per_block(*shape, np.dtype(dtype).itemsize)
    source = iter(frames)
    while True:
        pixels = np.zeros((size, *shape), dtype)
        status: list[Status] = []
        times: list[float] = []
        for out, frame in zip(pixels, source, strict=False):  # so that whole frames are not kept
            if frame.pixels is not None:
                out[:] = frame.pixels[rows, columns]
            status.append(frame.status)
            times.append(np.nan if frame.time_s is None else frame.time_s)
        if not status:
            return
        times_s = np.array(times)
        known = bool(np.isfinite(times_s).any())
        yield Block(pixels[: len(status)], start, tuple(status), times_s if known else None)
        start += len(status)


@dataclass(frozen=True)
class ImagesReader:
    """A `Reader` of frames that are stored and decoded one by one: compressed TIFF pages, image files.

    Parameters
    ----------
    facts
        See `Facts`.
    dtype
        Type of the decoded pixels.
    count
        Frame numbers in the file.
    decode
        Function that yields the frames of given numbers, in that order.
    """

    facts: Facts
    dtype: np.dtype[np.generic]
    count: int
    decode: Callable[[Sequence[int]], Iterator[Frame]]

    def read(self, start: int, stop: int | None, rows: slice, columns: slice) -> Iterator[Block]:
        """Yield frames in order, decoded in threads."""
        numbers = range(start, self.count if stop is None else min(stop, self.count))
        frames = self.decode(numbers)
        yield from gather_blocks(frames, start=start, rows=rows, columns=columns, dtype=self.dtype)

    def sample(self, numbers: Sequence[int]) -> Iterator[Pixels]:
        """Yield exactly these frames, whole, without lost and corrupt ones."""
        for frame in self.decode([n for n in numbers if n < self.count]):
            if frame.pixels is not None:
                yield frame.pixels


def luma(rgb: Pixels) -> Pixels:
    """Return BT.601 luma (rows, columns) of RGB or RGBA (rows, columns, 3 or 4): uint8, uint16 or float32.

    Integers are rounded, so that equal channels give the same value.
    """
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(rgb[..., :3]), cv2.COLOR_RGB2GRAY))


def full_scale(bits: int) -> float:
    """Return the largest value of an unsigned integer of that many bits."""
    return float((1 << bits) - 1)


def shape_text(shape: Sequence[int]) -> str:
    """Return (rows, columns) as text for messages: columns x rows."""
    return f"{shape[1]} x {shape[0]}"
