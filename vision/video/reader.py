"""Readers of file formats: `Facts` from the headers, then blocks of grey frames, decoded or as stored."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Literal, Protocol

import cv2
import numpy as np
from numpy.typing import DTypeLike, NDArray

from vision.errors import InputError
from vision.numeric import Floats, Ints, Pixels

FrameStatus = Literal["ok", "corrupt", "lost"]

LUMA_RULE = "BT.601 luma, 0.299 R + 0.587 G + 0.114 B, rounded"
AS_STORED = "values as stored"
OVERLAY_COMMENT = "film with the tracks of sheets drawn on it"  # what `track overlay` writes says so
SECONDS = {"s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "ns": 1e-9}
SECONDS |= {"min": 60.0, "h": 3600.0}

_MPEG = {"mpeg1video", "mpeg2video", "mpeg4", "h261", "h263", "h264", "hevc", "vvc"}
_FURTHER = {"av1", "vp3", "vp6", "vp7", "vp8", "vp9", "theora", "flv1", "rv30", "rv40", "svq3", "cinepak"}
_MICROSOFT = {"msmpeg4v1", "msmpeg4v2", "msmpeg4v3", "wmv1", "wmv2", "wmv3", "vc1", "msvideo1"}
BETWEEN_FRAMES = frozenset(_MPEG | _FURTHER | _MICROSOFT)
"""Codecs that predict a frame from other frames, and so carry errors from frame to frame."""
LOSSY = BETWEEN_FRAMES | {"mjpeg", "mjpegb", "amv", "jpeg2000", "dvvideo", "dnxhd", "prores", "cfhd"}
"""Codecs whose frames differ from what was recorded, so that pixels do not show the noise of positions."""


@dataclass(frozen=True, kw_only=True)
class Facts:
    """Facts from the headers of a file, in the file's own orientation."""

    shape: tuple[int, int]  # (rows, columns)
    depth_bits: int  # significant bits per pixel; 32 for float
    saturation_level: float | None  # value of a saturated pixel; None for float
    declared_frames: int | None  # number of frames that the file states; None without
    # how pixels are stored, which program decodes them, and what a grey value means
    container: str
    codec: str
    pixel_format: str
    decoder: str
    grey: str
    estimated_frames: int | None = None  # from duration and rate, if none are declared
    duration_s: float | None = None  # that the file states, if frames carry times
    playback_fps: float | None = None  # the container's rate, which need not be the camera's
    camera_fps: float | None = None  # rate of the camera by its header, if frames carry no times
    times_s: Floats | None = None  # the recording's own time of each frame, if the headers contain them
    times_in_blocks: bool = False  # whether these times come with the blocks instead
    pixel_size_um: float | None = None  # µm per pixel that the file states; None without
    scale_unused: str = ""  # a scale in the file that is not used, and why
    # step, grey levels, to which a codec that predicts frames from others rounds changes; 0 if unknown
    quantiser_step: float = 0.0
    turned_deg: int = 0  # clockwise rotation for display that the file states (films of phones)
    warnings: tuple[str, ...] = ()  # conditions that may spoil the results

    @property
    def frames(self) -> int | None:
        """Number of frames that the file states, or else the estimate; None without either."""
        return self.declared_frames or self.estimated_frames


@dataclass(frozen=True)
class Block:
    """Consecutive frames, cut to the rows and columns asked for."""

    # (k, rows, columns), grey, in the file's own unsigned type or float32; read only. Pixels of a frame that
    # is not "ok" have no meaning.
    pixels: Pixels
    start: int  # number of the first frame, counted from 0 at the start of the file
    status: tuple[FrameStatus, ...]  # one per frame
    times_s: Floats | None = None  # the recording's own times, if they are known only as frames are read


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
    status: FrameStatus = "ok"
    time_s: float | None = None


def frames_per_block(rows: int, columns: int, itemsize: int) -> int:
    """Return the number of frames per block: up to 4 MiB.

    Smaller blocks cost more of Python's time; larger ones leave the processor's cache before their mean.
    """
    return max(1, min(256, (4 << 20) // max(1, rows * columns * itemsize)))


def gather_blocks(
    frames: Iterable[Frame], *, start: int, rows: slice, columns: slice, dtype: DTypeLike
) -> Iterator[Block]:
    """Collect single frames into blocks, numbered from `start` and cut to `rows` and `columns`."""
    shape = (rows.stop - rows.start, columns.stop - columns.start)
    size = frames_per_block(*shape, np.dtype(dtype).itemsize)
    source = iter(frames)
    while True:
        pixels = np.zeros((size, *shape), dtype)
        status: list[FrameStatus] = []
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
    """A `Reader` of frames that are stored and decoded one by one: compressed TIFF pages, image files."""

    facts: Facts
    dtype: np.dtype[np.generic]  # of the decoded pixels
    count: int  # of the frame numbers in the file
    decode: Callable[[Sequence[int]], Iterator[Frame]]  # yields the frames of these numbers, in that order

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


@dataclass(frozen=True, kw_only=True)
class MappedReader:
    """A `Reader` of frames stored uncompressed in a file; only the wanted rows are read.

    The file is not mapped into memory: a mapped file that becomes shorter kills the process.
    """

    path: Path
    facts: Facts
    offsets: Ints  # byte at which the first stored row of each frame begins, -1 for a frame that was lost
    row_bytes: int  # from one row to the next; 0 for 12-bit pixels packed two in three bytes without padding
    dtype: np.dtype[np.generic]  # of one channel
    channels: int = 1  # 3 or 4 for colour
    blue_first: bool = False  # whether colour is BGR
    bottom_up: bool = False  # whether the lowest row is stored first
    grey_levels: NDArray[np.uint8] | None = None  # grey value of each 8-bit index of a palette

    def read(self, start: int, stop: int | None, rows: slice, columns: slice) -> Iterator[Block]:
        """Yield blocks of frames in order."""
        end = self.offsets.size if stop is None else min(stop, self.offsets.size)
        bytes_per_pixel = self.dtype.itemsize * self.channels if self.row_bytes else 6  # 12 bits, 16 twice
        size = frames_per_block(rows.stop - rows.start, self.facts.shape[1], bytes_per_pixel)  # whole rows
        for first in range(start, end, size):
            yield self._block(first, min(first + size, end), rows, columns)

    def sample(self, numbers: Sequence[int]) -> Iterator[Pixels]:
        """Yield exactly these frames, whole, without those that the file does not contain."""
        height, width = self.facts.shape
        for n in numbers:
            if n < self.offsets.size and self.offsets[n] >= 0:
                yield self._block(n, n + 1, slice(0, height), slice(0, width)).pixels[0]

    def _block(self, first: int, last: int, rows: slice, columns: slice) -> Block:
        pixels = self._grey(self._stored(first, last, rows)[:, :, columns])
        status: list[FrameStatus] = ["lost" if place < 0 else "ok" for place in self.offsets[first:last]]
        return Block(pixels, first, tuple(status))

    def _stored(self, first: int, last: int, rows: slice) -> Pixels:
        """Return frames first..last cut to rows, (k, rows, columns) or with channels last, top row first."""
        height, width = self.facts.shape
        top, stop = (height - rows.stop, height - rows.start) if self.bottom_up else (rows.start, rows.stop)
        if not self.row_bytes:
            return self._unpacked(first, last, top * width, stop * width)
        pixel = self.dtype.itemsize * self.channels
        length = (stop - top - 1) * self.row_bytes + width * pixel  # the file may end with the last pixel
        raw = np.empty((last - first, (stop - top) * self.row_bytes), np.uint8)
        self._fill(raw[:, :length], first, top * self.row_bytes)
        view: Pixels = np.ndarray(
            (last - first, stop - top, width, self.channels),
            self.dtype,
            raw,
            strides=(raw.shape[1], self.row_bytes, pixel, self.dtype.itemsize),
        )
        view = view if self.channels > 1 else view[..., 0]
        return view[:, ::-1] if self.bottom_up else view

    def _unpacked(self, first: int, last: int, begin: int, end: int) -> Pixels:
        """Return pixels `begin` to before `end` of packed frames; a row may begin inside three bytes."""
        even = begin - begin % 2
        raw = np.empty((last - first, (end + 1) // 2 * 3 - even // 2 * 3), np.uint8)
        self._fill(raw, first, even // 2 * 3)
        triples = raw.reshape(last - first, -1, 3).astype(np.uint16)
        pixels = np.empty((last - first, 2 * triples.shape[1]), np.uint16)
        pixels[:, 0::2] = triples[..., 0] << 4 | triples[..., 1] >> 4
        pixels[:, 1::2] = (triples[..., 1] & 15) << 8 | triples[..., 2]
        return pixels[:, begin - even : end - even].reshape(last - first, -1, self.facts.shape[1])

    def _fill(self, raw: NDArray[np.uint8], first: int, start: int) -> None:
        """Read one row of `raw` per frame from `first` on, from byte `start` of each frame."""
        with self.path.open("rb") as file:
            for place, frame in zip(self.offsets[first : first + len(raw)].tolist(), raw, strict=True):
                if place < 0:
                    frame[:] = 0
                else:
                    file.seek(place + start)
                    read_fully(file, memoryview(frame), self.path)

    def _grey(self, pixels: Pixels) -> Pixels:
        native = self.dtype.newbyteorder("=")
        if self.channels > 1:
            k, height, width = pixels.shape[:3]
            colour = pixels[..., 2::-1] if self.blue_first else pixels[..., :3]
            return luma(colour.astype(native).reshape(k * height, width, 3)).reshape(k, height, width)
        if self.grey_levels is not None:
            flat = np.ascontiguousarray(pixels).reshape(-1, pixels.shape[-1])
            return np.asarray(cv2.LUT(flat, self.grey_levels)).reshape(pixels.shape)
        return pixels if self.dtype.isnative else pixels.astype(native)


def whole_frames(places: Ints, frame_bytes: int, size: int) -> Ints:
    """Return where frames begin in a file of `size` bytes, -1 for those that are not wholly in it.

    Those at the end are left out, as of a file cut short: the number of frames that it states tells of them.
    """
    held = (places >= 0) & (places <= size - frame_bytes)
    return np.where(held, places, -1)[: np.flatnonzero(held).max(initial=-1) + 1]


def read_fully(file: BinaryIO, buffer: memoryview, path: Path) -> None:
    """Fill the buffer from a buffered file; InputError, which names `path`, if the file ends before."""
    if file.readinto(buffer) < len(buffer):  # type: ignore[attr-defined]  # buffered files have it
        wanted, found = "a file that does not change while it is read", "one that became shorter"
        raise InputError(path, wanted, found, "wait until it is copied, then run again")


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
