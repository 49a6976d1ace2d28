"""Torn frames: a picture that was replaced while it was read shows an earlier time in some of its rows."""

from __future__ import annotations

import numpy as np

from vision.errors import first_of
from vision.numeric import Bools, Floats, Floats32, Ints
from vision.video.settings import VideoSettings

PARTS = 8  # of the columns, which must agree
LEAST_ROWS = 4  # of half a strip
LEAST_COLUMNS = 64
LARGEST = 1e15  # grey level whose square is a number in single precision
ALL_EXAMINED, ONE_IN = 256, 16  # frames at the beginning; later one block of sixteen, which takes less time


class TornFrames:
    r"""Collects from block to block by what part of a frame the lower rows are later than the upper ones.

    Let :math:`s(x)` be the change of the strip's mean from the frame before, and :math:`d(x)` the difference
    of the lower and the upper half, less that of the frame before, or less its mean over the block. Where a
    sheet moves, both have its flanks:

    .. math:: \beta = \sum d\,s \Big/ \sum s^2

    is the time between the halves, in frames. A rolling shutter changes it in slips as against the frame
    before alone, and sheets that lean or bend as against the mean alone: the smaller of both counts.
    Brightness and motion that all columns share are removed from s and d before, as light that flickers and a
    camera that turns change d, too. The error of :math:`\beta` is the scatter between parts of the columns.
    """

    def __init__(self, rows: int, columns: int, settings: VideoSettings) -> None:
        self._rows, self.upper_rows, self._settings = rows, rows // 2, settings
        self._large_enough = self.upper_rows >= LEAST_ROWS and columns >= LEAST_COLUMNS
        self._blocks = 0
        self._last: tuple[Floats32, Floats32] | None = None  # mean, and lower less upper half
        self._lag: list[Floats] = []
        self._err: list[Floats] = []
        self._frame: list[Ints] = []

    def examines(self, first: int) -> bool:
        """Tell whether the next block, which begins with this frame, is to be added."""
        self._blocks += 1
        due = first < ALL_EXAMINED or self._blocks % ONE_IN == 0
        if not due:
            self._last = None
        return due and self._large_enough

    def add(self, mean: Floats32, upper: Floats32, usable: Bools, first: int) -> None:
        """Add a block: means of all rows and of the `upper_rows`, (frame, x), which frames are usable, and
        the number of the first."""
        half, frame = self.upper_rows, first + np.arange(len(mean))
        usable = usable & (np.abs(mean) < LARGEST).all(axis=1) & (np.abs(upper) < LARGEST).all(axis=1)
        if not usable.all():
            mean, upper, frame = mean[usable], upper[usable], frame[usable]
        if not len(mean):
            return
        lower = np.asarray((self._rows * mean - half * upper) / (self._rows - half), np.float32)
        apart = lower - upper
        last_mean, last_apart = (mean[:1], apart[:1]) if self._last is None else self._last
        self._last = mean[-1:].copy(), apart[-1:].copy()
        step, change = np.diff(mean, axis=0, prepend=last_mean), np.diff(apart, axis=0, prepend=last_apart)
        patterns: list[Floats32] = []
        for values in (mean, np.gradient(mean, axis=1), step, change, apart - apart.mean(axis=0)):
            left = values - values.mean(axis=1, keepdims=True)
            for pattern in patterns[:2]:
                size = np.maximum(np.einsum("tx,tx->t", pattern, pattern), 1e-12)
                left -= (np.einsum("tx,tx->t", left, pattern) / size)[:, None] * pattern
            patterns.append(left)
        _, _, step, *both = patterns
        starts = np.arange(PARTS) * mean.shape[1] // PARTS
        weight = np.maximum(np.add.reduceat(step * step, starts, axis=1, dtype=np.float64), 1e-12)
        total = weight.sum(axis=1)
        moved = np.stack([np.add.reduceat(step * one, starts, axis=1, dtype=np.float64) for one in both])
        lag = moved.sum(axis=2) / total
        scatter = np.sum((moved - weight * lag[:, :, None]) ** 2, axis=2) * PARTS / (PARTS - 1)
        nearer = np.where(np.abs(lag[0]) < np.abs(lag[1]), *lag)
        self._lag.append(np.where(lag[0] * lag[1] > 0, nearer, 0.0))
        self._err.append(np.sqrt(scatter.max(axis=0)) / total)
        self._frame.append(frame)

    def warnings(self, name: str) -> list[str]:
        """Return a warning that names the torn frames, if there are more than by chance.

        Halves of what leans or bends move differently in all frames: lags near the median do not count.
        """
        if not self._lag:
            return []
        settings = self._settings
        lag, err, frame = (np.concatenate(one) for one in (self._lag, self._err, self._frame))
        known = (err > 0) & (err < settings.torn_lag / 2)
        lag, err, frame = lag[known], err[known], frame[known]
        least = np.maximum(settings.torn_lag, settings.torn_sigmas * err)
        usual = np.median(lag) if len(lag) else 0.0
        torn = np.minimum(np.abs(lag), np.abs(lag - usual)) > least
        count = int(torn.sum())
        if count < max(settings.torn_least, settings.torn_share * len(lag)):
            return []
        named = first_of(frame[torn].tolist(), 5)
        return [
            f"{name}: in {count} of {len(lag)} frames examined ({named}) the upper and the lower rows show"
            " different times, as where a picture is replaced while it is read (torn frames), or rows are"
            " exposed in turn: positions there lie between those of two moments, by more than x_err_px where"
            " sheets move, and other frames may be torn as well: record the camera's own frames, not those of"
            " a screen, or choose fewer rows (`rows`)"
        ]
