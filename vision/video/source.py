"""Video: what every recording offers; Reader: what the code for one container must supply."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

Status = Literal["ok", "corrupt", "lost"]


@dataclass(frozen=True)
class Block:
    """A run of consecutive frames cut to the rows and columns asked for.

    pixels: (k, rows, columns), the file's own unsigned dtype (or float32), grey; treat as read-only.
    start: frame number of the first one, counted from 0 at the start of the file (not of `--frames`).
    status: one entry per frame; `pixels` of a frame that is not "ok" is meaningless.
    times_s: the recording's own time of each frame, where it is known only as frames are read; else None.
    """

    pixels: NDArray[np.generic]
    start: int
    status: tuple[Status, ...]
    times_s: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class FrameClock:
    """Where frame times come from.

    kind: "file" (time stamps of the recording itself), "given" (--fps or --timestamps) or "playback" (a
    container's rate, which need not be the camera's; None fps where the container has none).
    """

    kind: Literal["file", "given", "playback"]
    fps: float | None


@dataclass(frozen=True)
class Facts:
    """What a reader knows of its file before any pixel is decoded, in the file's own orientation.

    shape: (rows, columns).  depth_bits: significant bits; 32 for float.  saturation_level: the value of a
    saturated pixel, None for float.  promised: frames the file says it holds, None without a promise.
    about: a guess at their number where none is promised.  duration_s: how long it says it lasts, if frames
    carry times.  times_s: the recording's own time of each frame, where it keeps any.  stamped: own times
    come with the blocks instead.  warnings: what the user must be told.  notes: how pixels are read.
    """

    shape: tuple[int, int]
    depth_bits: int
    saturation_level: float | None
    promised: int | None
    about: int | None = None
    duration_s: float | None = None
    playback_fps: float | None = None
    times_s: NDArray[np.float64] | None = None
    stamped: bool = False
    warnings: tuple[str, ...] = ()
    notes: dict[str, str] = field(default_factory=dict)


class Reader(Protocol):
    """One container's code: facts at once, pixels in the file's own orientation."""

    @property
    def facts(self) -> Facts: ...  # noqa: D102

    def read(self, start: int, stop: int | None, rows: slice, columns: slice) -> Iterator[Block]:
        """Frames `start` to `stop` in order, each number exactly once, cut to rows and columns."""
        ...

    def sample(self, numbers: Sequence[int]) -> Iterator[NDArray[np.generic]]:
        """Whole readable frames at or near these numbers; fewer where the file allows no jump."""
        ...


class Video(Protocol):
    """A recording, opened: facts at once, pixels in one sequential pass.

    shape: (rows, columns) after rotation.  depth_bits: significant bits per pixel.  saturation_level: the
    value of a saturated pixel, None for float.  expected: frames the file promises (after --frames), None
    where it makes no promise.  duration_s: how long the file says it lasts by its own clock.  warnings:
    what is wrong with the file as far as its headers tell.  Nothing here loads the whole file.
    """

    @property
    def path(self) -> Path: ...  # noqa: D102
    @property
    def shape(self) -> tuple[int, int]: ...  # noqa: D102
    @property
    def depth_bits(self) -> int: ...  # noqa: D102
    @property
    def saturation_level(self) -> float | None: ...  # noqa: D102
    @property
    def expected(self) -> int | None: ...  # noqa: D102
    @property
    def about(self) -> int | None: ...  # noqa: D102
    @property
    def clock(self) -> FrameClock: ...  # noqa: D102
    @property
    def notes(self) -> dict[str, str]: ...  # noqa: D102
    @property
    def warnings(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def rotate(self) -> int: ...  # noqa: D102
    @property
    def duration_s(self) -> float | None: ...  # noqa: D102

    def times(self, frames: NDArray[np.int64]) -> NDArray[np.float64]:
        """Seconds of each frame number; NaN where unknown."""
        ...

    def blocks(self, rows: slice | None = None, columns: slice | None = None) -> Iterator[Block]:
        """One sequential pass, rows and columns cut after rotation."""
        ...

    def frames(self) -> Iterator[NDArray[np.generic]]:
        """Every readable frame, whole."""
        ...

    def sample(self, count: int) -> Iterator[NDArray[np.generic]]:
        """Up to `count` readable whole frames spread over the recording."""
        ...
