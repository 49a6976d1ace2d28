"""Recording: a reader's file as the user asked for it: turned, cut to `--frames`, on the chosen clock."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vision.errors import InputError
from vision.video.source import Block, FrameClock, Reader


@dataclass(repr=False, frozen=True, kw_only=True)
class Recording:
    """A `Video`: see `vision.video.source.Video` for what each member means.

    rotate: degrees clockwise, a multiple of 90.  first, stop: frame numbers kept, half-open; stop None is
    the end. given_fps, given_times_s: the camera's clock as the user states it, which outranks the file's.
    """

    path: Path
    reader: Reader
    rotate: int = 0
    first: int = 0
    stop: int | None = None
    given_fps: float | None = None
    given_times_s: NDArray[np.float64] | None = None
    warnings: tuple[str, ...] = ()

    def __repr__(self) -> str:
        count = "an unknown number of" if self.expected is None else self.expected
        rate = "" if self.clock.fps is None else f", {self.clock.fps:g} frames/s ({self.clock.kind})"
        rows, columns = self.shape
        return f"<{self.path.name}: {count} frames of {columns} x {rows} px, {self.depth_bits} bit{rate}>"

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) after rotation."""
        rows, columns = self.reader.facts.shape
        return (columns, rows) if self.rotate % 180 else (rows, columns)

    @property
    def depth_bits(self) -> int:
        """Significant bits per pixel; 32 for float."""
        return self.reader.facts.depth_bits

    @property
    def saturation_level(self) -> float | None:
        """Value of a saturated pixel; None for float."""
        return self.reader.facts.saturation_level

    @property
    def expected(self) -> int | None:
        """Frames the file promises within `first:stop`; None where it promises nothing."""
        promised = self.reader.facts.promised
        if promised is None:
            return None
        return max(0, (promised if self.stop is None else min(promised, self.stop)) - self.first)

    @property
    def about(self) -> int | None:
        """`expected`, or a guess from length and rate where nothing is promised; None without either."""
        if self.expected is not None or self.reader.facts.about is None:
            return self.expected
        held = self.reader.facts.about
        return max(0, (held if self.stop is None else min(held, self.stop)) - self.first)

    @property
    def duration_s(self) -> float | None:
        """How long the file says it lasts by its own clock; None if it does not, or for a part of it."""
        return self.reader.facts.duration_s if self.stop is None and self.clock.kind == "file" else None

    @property
    def clock(self) -> FrameClock:
        """The clock in use: given, else the file's own, else the playback rate."""
        facts = self.reader.facts
        if self.given_times_s is not None:
            return FrameClock("given", _median_rate(self.given_times_s))
        if self.given_fps is not None:
            return FrameClock("given", self.given_fps)
        if facts.times_s is not None:
            return FrameClock("file", _median_rate(facts.times_s))
        if facts.stamped:
            return FrameClock("file", facts.playback_fps)
        return FrameClock("playback", facts.playback_fps)

    @property
    def notes(self) -> dict[str, str]:
        """How the pixels are read."""
        return dict(self.reader.facts.notes)

    def times(self, frames: NDArray[np.int64]) -> NDArray[np.float64]:
        """Seconds of each frame number; NaN where unknown."""
        table = self.given_times_s
        if table is None and self.given_fps is None:
            table = self.reader.facts.times_s
        if table is not None:
            out = np.full(frames.shape, np.nan)
            known = (frames >= 0) & (frames < table.size)
            out[known] = table[frames[known]]
            return out
        fps = self.clock.fps
        return np.full(frames.shape, np.nan) if fps is None else frames / fps

    def blocks(self, rows: slice | None = None, columns: slice | None = None) -> Iterator[Block]:
        """One sequential pass, cut after rotation. InputError for a cut outside the frame."""
        height, width = self.shape
        r = cut(rows, height, what=f"{self.path}: rows")
        c = cut(columns, width, what=f"{self.path}: columns")
        file_rows, file_columns = _before_rotation(r, c, self.reader.facts.shape, self.rotate)
        for block in self.reader.read(self.first, self.stop, file_rows, file_columns):
            times_s = block.times_s if self.clock.kind == "file" else None
            yield Block(self._turn(block.pixels), block.start, block.status, times_s)

    def frames(self) -> Iterator[NDArray[np.generic]]:
        """Every readable frame, whole."""
        for block in self.blocks():
            for pixels, status in zip(block.pixels, block.status, strict=True):
                if status == "ok":
                    yield pixels

    def sample(self, count: int) -> Iterator[NDArray[np.generic]]:
        """Up to `count` readable whole frames over the recording; its first ones if its length is unknown."""
        last = self.reader.facts.promised or self.reader.facts.about or self.first + count
        last = last if self.stop is None else min(last, self.stop)
        numbers = np.unique(
            np.round(np.linspace(self.first, max(last - 1, self.first), count)).astype(np.int64)
        )
        for pixels in self.reader.sample([int(n) for n in numbers]):
            yield self._turn(pixels)

    def _turn(self, pixels: NDArray[np.generic]) -> NDArray[np.generic]:
        return np.rot90(pixels, k=-(self.rotate // 90), axes=(-2, -1)) if self.rotate else pixels


def cut(wanted: slice | None, size: int, *, what: str) -> slice:
    """`wanted` checked against `size` pixels: InputError unless 0 <= start < stop <= size."""
    if wanted is None:
        return slice(0, size)
    start = 0 if wanted.start is None else int(wanted.start)
    stop = size if wanted.stop is None else int(wanted.stop)
    if wanted.step not in (None, 1) or not 0 <= start < stop <= size:
        raise InputError(
            what, f"a range within 0:{size}", f"{start}:{stop}", "counted from 0, end not included"
        )
    return slice(start, stop)


def _before_rotation(rows: slice, columns: slice, shape: tuple[int, int], rotate: int) -> tuple[slice, slice]:
    """The file's rows and columns that become `rows` and `columns` after turning clockwise."""
    height, width = shape
    if rotate == 90:
        return _mirror(columns, height), rows
    if rotate == 180:
        return _mirror(rows, height), _mirror(columns, width)
    if rotate == 270:
        return columns, _mirror(rows, width)
    return rows, columns


def _mirror(span: slice, size: int) -> slice:
    return slice(size - span.stop, size - span.start)


def _median_rate(times_s: NDArray[np.float64]) -> float | None:
    """Frames per second from the median interval; None for fewer than two times or a still clock."""
    if times_s.size < 2:
        return None
    step = float(np.nanmedian(np.diff(times_s)))
    return 1.0 / step if step > 0 else None
