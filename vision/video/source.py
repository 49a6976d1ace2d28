"""Video: what every reader offers, whatever the container."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

Status = Literal["ok", "corrupt", "lost"]


@dataclass(frozen=True)
class Block:
    """A run of consecutive frames cut to the rows and columns asked for.

    pixels: (k, rows, columns), the file's own unsigned dtype (or float32), grey.
    start: frame number of the first one, counted from 0 at the start of the file (not of `--frames`).
    status: one entry per frame; `pixels` of a frame that is not "ok" is meaningless.
    """

    pixels: NDArray[np.generic]
    start: int
    status: tuple[Status, ...]


@dataclass(frozen=True)
class FrameClock:
    """Where frame times come from.

    kind: "file" (time stamps of the recording itself), "given" (--fps or --timestamps) or "playback" (a container's
    rate, which need not be the camera's; None fps where the container has none).
    """

    kind: Literal["file", "given", "playback"]
    fps: float | None


class Video(Protocol):
    """A recording, opened: facts at once, pixels in one sequential pass.

    shape: (rows, columns) after rotation.  depth_bits: significant bits per pixel.  expected: frames the file
    promises (after --frames), None where it makes no promise.  Nothing here loads the whole file.
    """

    @property
    def path(self) -> Path: ...  # noqa: D102
    @property
    def shape(self) -> tuple[int, int]: ...  # noqa: D102
    @property
    def depth_bits(self) -> int: ...  # noqa: D102
    @property
    def expected(self) -> int | None: ...  # noqa: D102
    @property
    def clock(self) -> FrameClock: ...  # noqa: D102
    @property
    def notes(self) -> dict[str, str]: ...  # noqa: D102

    def times(self, frames: NDArray[np.int64]) -> NDArray[np.float64]:
        """Seconds of each frame number; NaN where unknown."""
        ...

    def blocks(self, rows: slice | None = None, columns: slice | None = None) -> Iterator[Block]:
        """One sequential pass, rows and columns cut after rotation."""
        ...

    def frames(self) -> Iterator[NDArray[np.generic]]:
        """Every readable frame, whole."""
        ...
