"""I(x, t) in tiles: single pixels, and ever coarser levels in which no slip and no thin ridge is lost."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from threading import Lock

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.errors import InputError
from vision.figures.decimate import grey_levels
from vision.numeric import Floats32
from vision.review.diagram import Diagram

TILES_KEPT = 256  # as PNG, some 60 kB each
PART_VALUES = 1 << 20  # read at a time while levels are made: 4 MB
Grey = NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True)
class TileSettings:
    """How the space-time diagram is cut."""

    columns: int = 512
    """Of a tile. Wider tiles are fewer requests, but a pan waits longer for one; 512 x 256 takes 3 ms."""

    rows: int = 256
    """Of a tile, likewise."""

    factor: int = 4
    """Frames of a level to one row of the next. 2 would double the memory and the work of the first view;
    with 8 a page has to shrink pictures so far that single frames fade."""

    first_kept: int = 2
    """Finest level that is kept in memory. Level 1 would take half the size of the recording's 8-bit diagram,
    and is made as fast from the file: 2 MB per tile."""

    sampled_rows: int = 512
    """Frames from which the grey scale is taken."""


class Tiles:
    """The pyramid of one space-time diagram.

    Parameters
    ----------
    diagram
        I(x, t), on disk.
    bright
        Whether ridges are bright. A coarse row shows each column's largest value in its frames (the smallest
        where ridges are dark), so that a ridge that was somewhere for one frame is still seen.
    settings
        How it is cut.

    Notes
    -----
    A row of level l holds ``factor**l`` frames; columns are never merged. Level 0 is the recording itself.
    """

    def __init__(
        self, diagram: Diagram, *, bright: bool = True, settings: TileSettings = TileSettings()
    ) -> None:
        self.diagram, self.bright, self.settings = diagram, bright, settings
        self.low, self.high = _limits(diagram.sample(settings.sampled_rows))
        self._kept: list[Grey] = []  # levels from `first_kept` on
        self._building = Lock()
        self.png = lru_cache(maxsize=TILES_KEPT)(self._png)

    @property
    def levels(self) -> int:
        """Number of levels; the last one fits into one tile's rows."""
        frames, levels = self.diagram.frames, 1
        while frames > self.settings.rows:
            frames, levels = -(-frames // self.settings.factor), levels + 1
        return levels

    def build(self) -> None:
        """Make the levels that are kept; they are made at the first need otherwise."""
        with self._building:
            step = self.settings.factor**self.settings.first_kept
            if self._kept or self.levels <= self.settings.first_kept:
                return
            made = [self._first_level(step)]
            while len(made) < self.levels - self.settings.first_kept:
                made.append(_extremes(made[-1], self.settings.factor, bright=self.bright))
            self._kept = [self._grey(level) for level in made]

    def _first_level(self, step: int) -> Floats32:
        """Extremes of every `step` frames, read in parts by two threads."""
        frames, columns = self.diagram.frames, self.diagram.columns
        out = np.empty((-(-frames // step), columns), np.float32)
        block = max(1, PART_VALUES // (step * columns))

        def work(row: int) -> None:
            part = self.diagram.rows(row * step, (row + block) * step)
            out[row : row + block] = _extremes(part, step, bright=self.bright)

        with ThreadPoolExecutor(2) as pool:
            list(pool.map(work, range(0, len(out), block)))
        return out

    def _grey(self, values: Floats32) -> Grey:
        """8 bits; frames that are not there are mid-grey. In parts, as this takes more than the result."""
        starts = range(0, len(values), self.settings.rows)
        parts = [grey_levels(values[k : k + self.settings.rows], self.low, self.high) for k in starts]
        return np.concatenate(parts)

    def part(self, level: int, x: int, y: int) -> Grey:
        """One tile in 8 bits; those at the right and lower edge are smaller.

        Raises
        ------
        InputError
            For a tile that is not there.
        """
        rows, columns = self.settings.rows, self.settings.columns
        step = self.settings.factor**level if 0 <= level < self.levels else 0
        height = -(-self.diagram.frames // step) if step else 0
        if not (0 <= y * rows < height and 0 <= x * columns < self.diagram.columns):
            raise InputError("the tile", f"one of {self.levels} levels", f"{level}/{x}/{y}")
        across = slice(x * columns, (x + 1) * columns)
        if level >= self.settings.first_kept:
            self.build()
            return self._kept[level - self.settings.first_kept][y * rows : (y + 1) * rows, across]
        part = self.diagram.shared_rows(y * rows * step, (y + 1) * rows * step)[:, across]
        return self._grey(part if level == 0 else _extremes(part, step, bright=self.bright))

    def _png(self, level: int, x: int, y: int) -> bytes:
        """One tile as an 8-bit PNG."""
        return encode_png(self.part(level, x, y))


def encode_png(pixels: Grey) -> bytes:
    """An 8-bit picture as PNG, packed fast rather than small: it travels within one machine."""
    made, data = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    assert made
    return data.tobytes()


def _extremes(values: Floats32, step: int, *, bright: bool) -> Floats32:
    """Largest (or smallest) of every `step` rows, the last interval may be shorter; NaN only without any."""
    pick = np.fmax if bright else np.fmin
    whole = len(values) // step * step
    out = pick.reduce(values[:whole].reshape(-1, step, values.shape[1]), axis=1)
    if whole < len(values):
        out = np.concatenate([out, pick.reduce(values[whole:], axis=0)[None]])
    return np.asarray(out, np.float32)


def _limits(sample: Floats32) -> tuple[float, float]:
    """Black and white: all but the outermost grey values."""
    known = sample[np.isfinite(sample)]
    if not known.size:
        return 0.0, 1.0
    low, high = np.percentile(known, (0.5, 99.8))
    return float(low), float(max(high, low + 1e-6))
