"""Frames as they are read: storage of I(x, t), blank and lost frames, and recordings that still grow."""

from __future__ import annotations

import math
import os
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import xarray as xr

from vision.errors import InputError, counted
from vision.files import Stamp, answered
from vision.mapped import give_back, parts_in_turn, table_in_file
from vision.numeric import Bools, Floats, Floats32, Ints, Strings
from vision.video.reader import Block
from vision.video.settings import VideoSettings
from vision.video.video import Video, open_video, pixels_file

STATUS_TYPE = "<U7"  # ok, blank, corrupt, lost
_NEAR = 9  # frames before and after a step between times that are compared with it


@dataclass(frozen=True)
class FramesRead:
    """Consecutive frames: intensity (frame, x), grey levels; status and time, s, of each frame."""

    intensity: Floats32
    status: Strings
    times_s: Floats


class FrameStore:
    """Growing storage of I(x, t): rows of float32, in memory or in a temporary file, each with its status and
    time.

    A row has `columns` values, and about `expected` rows will come. Above `spill_bytes` they are stored in a
    temporary file in `folder`, by default the system's. If that disk is full they stay in memory, and above
    `memory_bytes` InputError is raised.
    """

    def __init__(
        self,
        columns: int,
        *,
        expected: int | None,
        spill_bytes: int = VideoSettings.spill_bytes,
        memory_bytes: int = VideoSettings.memory_bytes,
        folder: Path | None = None,
    ) -> None:
        self._columns = columns
        self._folder = folder
        self._spill_bytes, self._memory_bytes = spill_bytes, memory_bytes
        self._marks = np.zeros(1024, [("status", STATUS_TYPE), ("time_s", np.float64)])
        self.count = 0
        """Number of rows so far."""
        most = max(1, 2 * memory_bytes // (4 * columns))  # a damaged header may state any number
        self._rows = self._allocate(max(1, min(expected or 1024, most)))

    def append(self, rows: Floats32) -> None:
        """Add `rows` (k, columns) at the end."""
        needed = self.count + rows.shape[0]
        if needed > self._rows.shape[0]:
            old = self.rows()
            self._rows = self._allocate(max(needed, 2 * self._rows.shape[0]))
            for part in parts_in_turn(old):
                self._put(part.start, old[part])
        self._put(self.count, rows)
        self.count = needed

    def add(self, frames: FramesRead) -> None:
        """Add frames at the end."""
        needed = self.count + frames.status.size
        if needed > self._marks.size:
            more = np.zeros(max(needed, self._marks.size), self._marks.dtype)
            self._marks = np.concatenate([self._marks, more])
        new = self._marks[self.count : needed]
        new["status"], new["time_s"] = frames.status, frames.times_s
        self.append(frames.intensity)

    def rows(self) -> Floats32:
        """Return all rows so far, (n, columns), not copied."""
        return self._rows[: self.count]

    def part(self, start: int, stop: int) -> FramesRead:
        """Return frames `start` to before `stop`; the intensity is not copied."""
        marks = self._marks[start:stop].copy()
        return FramesRead(self.rows()[start:stop], marks["status"], marks["time_s"])

    def copy(self, start: int, stop: int) -> FramesRead:
        """Return frames `start` to before `stop`, copied."""
        part = self.part(start, stop)
        copied = replace(part, intensity=part.intensity.copy())
        give_back(part.intensity)
        return copied

    def _put(self, start: int, rows: Floats32) -> None:
        place = self._rows[start : start + len(rows)]
        place[:] = rows
        give_back(place)

    def _allocate(self, capacity: int) -> Floats32:
        size = capacity * self._columns * 4
        if size > self._spill_bytes:
            try:
                return table_in_file(capacity, self._columns, self._folder)
            except OSError as error:
                if size > self._memory_bytes:
                    raise self._no_room(size, error) from error
        return np.empty((capacity, self._columns), np.float32)

    def _no_room(self, size: int, error: OSError) -> InputError:
        wanted = f"{size / (1 << 30):.1f} GiB for I(x, t)"
        found = (error.strerror or str(error)).lower()
        advice = "give another `out`, or `columns`" if self._folder else "set TMPDIR, or give `columns`"
        return InputError(self._folder or tempfile.gettempdir(), wanted, found, advice)


# --- blank frames -------------------------------------------------------------------------------------------


def is_blank(
    profiles: Floats32,
    readable: Bools,
    *,
    saturation_level: float | None = None,
    settings: VideoSettings = VideoSettings(),
) -> Bools:
    """Return which readable frames do not show the scene, (frame), from their intensity (frame, x).

    A frame is blank if its profile is constant or saturated throughout, if its contrast (standard deviation
    along x) is below `settings.blank_contrast` of the recording's median contrast, or if the frame is
    brighter than usual and its contrast, relative to its level, is below `settings.bright_contrast` of the
    median. Dim frames keep their relative contrast, and motion blur preserves the gradient of the light and
    the edges of the comb. If more than half of a recording is blank, only constant and saturated frames are
    found; saturation_level is None for float.
    """
    level, contrast, darkest = np.empty((3, len(profiles)))
    for span in parts_in_turn(profiles, 256):  # parts that fit into the processor's cache
        values = profiles[span].astype(np.float64)
        level[span], contrast[span] = values.mean(axis=1), values.std(axis=1)
        darkest[span] = values.min(axis=1)
    blank = contrast <= 1e-6 * np.maximum(np.abs(level), 1.0)
    if saturation_level is not None:
        blank |= darkest >= settings.saturated * saturation_level
    usual = readable & ~blank
    if usual.any():
        usual_level = float(np.median(level[usual]))
        usual_contrast = float(np.median(contrast[usual]))
        blank |= contrast < settings.blank_contrast * usual_contrast
        flat = contrast * usual_level < settings.bright_contrast * usual_contrast * level
        blank |= flat & (level > settings.bright_level * usual_level)
    return np.asarray(blank & readable, bool)


def blank_out(intensity: Floats32, unusable: Bools) -> None:
    """Set the intensity (frame, x) of unusable frames (frame) to NaN, in place."""
    for rows in parts_in_turn(intensity):
        intensity[rows][unusable[rows]] = np.nan


# --- lost frames --------------------------------------------------------------------------------------------


def expected_frames(
    video: Video, status: Strings, times_s: Floats, *, settings: VideoSettings = VideoSettings()
) -> tuple[int, list[str]]:
    """Return the number of frames expected, and one line for each kind of unusable or missing frame.

    It follows from the number of frames, the file's duration and gaps in its times. Frames lost between time
    stamps, or before the end that the file states, have no row but are counted. status, times_s: status and
    time of each frame in the file (frame).
    """
    name, warnings = video.path.name, []
    if video.expected is not None and status.size < video.expected:
        missing = video.expected - status.size
        found = f"{status.size} of {video.expected} expected frames are in the file"
        warnings.append(f"{name}: {found}; {missing} {'is' if missing == 1 else 'are'} missing")
    reasons = {"corrupt": "corrupt", "lost": "lost by the camera", "blank": "blank"}
    for state, reason in reasons.items():
        which = np.flatnonzero(status == state)
        if which.size:
            where = f"the first is frame {video.first + which[0]}"
            warnings.append(f"{name}: {counted(which.size, 'frame')} {reason}, {where}")
    measured = video.clock.kind == "file" or (video.clock.kind == "given" and _uneven(times_s))
    between, first = lost_between(times_s, settings=settings) if measured else (0, 0)
    if between:
        where = f"according to gaps in its times, the first after frame {video.first + first}"
        warnings.append(f"{name}: {counted(between, 'frame')} lost {where}")
    if measured and (thinned := thinned_from(times_s, settings=settings)) is not None:
        what = f"from frame {video.first + thinned} on, frames come at half or a third of the usual rate"
        warnings.append(f"{name}: {what}: the camera was slower, or frames are lost evenly")
    beyond = 0
    if video.clock.kind == "file" and video.duration_s is not None:
        known = times_s[np.isfinite(times_s)]
        usual_s = usual_step_s(known)
        missing_s = video.duration_s - float(known[-1]) if usual_s > 0 else 0.0
        if missing_s > settings.early_end_steps * usual_s:
            beyond = round(missing_s / usual_s) - 1  # the last frame itself lasts one step
            stated = f"the file should last {video.duration_s:.3f} s"
            warnings.append(
                f"{name}: {stated}; its last {missing_s:.3f} s are missing, about {beyond} frames"
            )
    return max(status.size, video.expected or 0) + between + beyond, warnings


def lost_between(times_s: Floats, *, settings: VideoSettings = VideoSettings()) -> tuple[int, int]:
    """Return the number of frames lost between time stamps, and the index of the frame before the first gap.

    A step of more than `settings.gap_steps` usual steps is a gap if the frames after it remain late against
    the usual rate: a frame that is merely late is followed by short steps. If the camera changes its rate,
    the usual step is that of the frames around (`_local_step_s`). If more than a fifth is lost, too few are
    counted. (0, 0) for none, or fewer than three known times (frame), NaN where unknown.
    """
    places = np.flatnonzero(np.isfinite(times_s))
    known = times_s[places]
    local_s = _local_step_s(known, places, settings)
    steps = np.diff(known) / local_s - (np.diff(places) - 1)  # frames without a time took one step each
    gaps = np.flatnonzero(steps > settings.gap_steps)
    gaps = gaps[_lasting_delay(known, places, local_s, gaps) > settings.late_steps]
    lost = int(np.round(steps[gaps] - 1).sum())
    return (lost, int(places[gaps[0]])) if lost else (0, 0)


def _local_step_s(known: Floats, places: Ints, settings: VideoSettings) -> Floats:
    """Return the usual time from one frame to the next, s, at each step between known times.

    It is that of the whole recording, or a longer time on which eight of the nine steps before or after
    agree, because a camera that changes its rate does so for many frames. NaN for fewer than three times.
    """
    usual_s = usual_step_s(known)
    step_s = np.diff(known) / np.diff(places)
    if not usual_s > 0 or not (step_s > settings.same_rate * usual_s).any():
        return np.full(step_s.shape, usual_s if usual_s > 0 else np.nan)
    padded = np.pad(step_s, _NEAR, constant_values=np.nan)
    runs = np.lib.stride_tricks.sliding_window_view(padded, _NEAR)
    middle = np.sort(runs, axis=1)[:, _NEAR // 2]  # NaN comes last
    ratio = runs / middle[:, np.newaxis]
    agree = (ratio < settings.same_rate) & (ratio > 1 / settings.same_rate)
    steady = np.where(agree.sum(axis=1) >= _NEAR - 1, middle, usual_s)
    before, after = steady[: step_s.size], steady[_NEAR + 1 :]
    return np.maximum(usual_s, np.maximum(before, after))


def thinned_from(times_s: Floats, *, settings: VideoSettings = VideoSettings()) -> int | None:
    """Return the first frame after which frames come at half or a third of the usual rate; None if none.

    Either the camera changed its rate or frames are lost evenly; their times do not show which.
    """
    places = np.flatnonzero(np.isfinite(times_s))
    known = times_s[places]
    step_s = np.minimum(_local_step_s(known, places, settings), np.diff(known) / np.diff(places))
    ratio = step_s / usual_step_s(known)
    whole = np.clip(np.round(ratio), 2, 3)
    thinned = np.flatnonzero(np.abs(ratio / whole - 1) < settings.whole_ratio)
    return int(places[thinned[0]]) if thinned.size else None


def usual_step_s(times_s: Floats) -> float:
    """Return the time from one frame to the next without losses, s; NaN for fewer than three times.

    It is the tenth percentile of the time that 20 frames take: rounded times have few distinct steps, and the
    shorter runs of 20 frames contain no lost frame.
    """
    if times_s.size < 3:
        return math.nan
    lag = min(20, max(1, times_s.size // 4))
    return float(np.quantile(times_s[lag:] - times_s[:-lag], 0.1)) / lag


def _lasting_delay(known: Floats, places: Ints, local_s: Floats, gaps: Ints) -> Floats:
    """Return the median delay of the nine frames after each gap less that of the nine before, usual steps."""

    def delay(frames: Ints) -> Floats:
        inside = np.clip(frames, 0, known.size - 1)
        here = gaps[:, np.newaxis]
        late = (known[inside] - known[here]) / local_s[here] - (places[inside] - places[here])
        return np.asarray(np.nanmedian(np.where(inside == frames, late, np.nan), axis=1), np.float64)

    reach = np.arange(_NEAR)
    return delay(gaps[:, np.newaxis] + 1 + reach) - delay(gaps[:, np.newaxis] - reach)


def _uneven(times_s: Floats) -> bool:
    """Return whether times were measured, not computed from a rate."""
    steps = np.diff(times_s[np.isfinite(times_s)])
    return bool(steps.size and np.ptp(steps) > 1e-6 * abs(float(steps.max())))


# --- a recording that grows ---------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Follow:
    """How a growing recording is followed.

    Parameters
    ----------
    stop
        Set by the caller to end with what has been read.
    closed
        Set when the recording is closed and has been read to its end.
    seen
        Called after each block with a function that returns I(x, t) of a number of the last frames, and with
        the number of frames in the file that are not read yet (None if unknown).
    waiting
        Called once with the reason if the recording cannot be read yet, such as an MP4 that is not closed.
    """

    stop: threading.Event = field(default_factory=threading.Event)
    closed: threading.Event = field(default_factory=threading.Event)
    seen: Callable[[Callable[[int], xr.DataArray], int | None], None] | None = None
    waiting: Callable[[str], None] | None = None


def await_video(
    path: str | os.PathLike[str], opened: Callable[[], Video], follow: Follow, settings: VideoSettings
) -> Video:
    """Wait until a recording has enough frames to find the strip, or no longer grows, and open it.

    `path` need not exist yet; `opened` opens it.

    Raises: InputError if it cannot be opened and nothing has been written to it for
    `settings.follow_give_up_s`.
    """
    film = Path(path)
    pixels = answered(lambda: pixels_file(film), film, settings.answer_s)
    watch = _Watch(pixels, settings.answer_s)
    report_at = time.monotonic() + settings.follow_tell_s
    while True:
        unchanged_s = watch.unchanged_s()
        try:
            video = opened()
        except InputError as error:
            if max(unchanged_s, watch.age_s()) >= settings.follow_give_up_s or follow.stop.is_set():
                raise
            if follow.waiting is not None and time.monotonic() >= report_at:
                follow.waiting(str(error))
                report_at = math.inf
        else:
            few = video.estimated is not None and video.estimated < settings.follow_first
            if not few or unchanged_s >= settings.follow_still_s or follow.stop.is_set():
                return video
        follow.stop.wait(settings.follow_poll_s)


def growth(video: Video, follow: Follow, settings: VideoSettings) -> Iterator[tuple[Video, bool]]:
    """Yield the recording each time it has grown, and whether it is closed, which is True for the last one.

    It is closed when its size and time have not changed for `settings.follow_still_s` and it can be opened.
    Each pause is as long as the reading before it, so that formats that must be decoded from their start are
    not decoded all the time.

    Raises: InputError if it was removed or replaced, or no longer grows and cannot be opened.
    """
    watch = _Watch(video.pixels_path, settings.answer_s)
    while not follow.stop.is_set():
        began = time.monotonic()
        yield video, False
        pause_until = 2 * time.monotonic() - began
        seen = watch.stamp
        while not follow.stop.wait(settings.follow_poll_s):
            unchanged_s = watch.unchanged_s()
            closed = unchanged_s >= settings.follow_still_s
            if not closed and (watch.stamp == seen or time.monotonic() < pause_until):
                continue
            try:
                video = _reopened(video)
            except InputError:
                if unchanged_s >= settings.follow_give_up_s:
                    raise
                continue
            if closed:
                yield video, True
                return
            break


def _reopened(video: Video) -> Video:
    """Open the recording again, as it is now; refuse one that was removed or replaced."""
    change = answered(lambda: video.stamp.change(video.pixels_path), video.path, video.answer_s)
    if change in ("was removed", "was replaced"):
        raise InputError(video.path, "a recording that only grows while it is followed", f"one that {change}")
    whole = video.first == 0 and video.stop is None
    return open_video(
        video.path,
        rotate=video.rotate,
        frames=None if whole else slice(video.first, video.stop),
        fps=video.given_fps,
        answer_s=video.answer_s,
    )


class _Watch:
    """Watches how long a file or folder has not changed, by the clock of this process."""

    def __init__(self, path: Path, answer_s: float) -> None:
        self._path, self._answer_s = path, answer_s
        self.stamp = self._now()
        self._since = time.monotonic()

    def unchanged_s(self) -> float:
        """Take a new stamp, and return the seconds since a change was last seen."""
        now = self._now()
        if now != self.stamp:
            self.stamp, self._since = now, time.monotonic()
        return time.monotonic() - self._since

    def _now(self) -> Stamp:
        return answered(lambda: Stamp.of(self._path), self._path, self._answer_s)

    def age_s(self) -> float:
        """Return the seconds since the file's own time of change; 0 if it does not exist."""
        return 0.0 if self.stamp.facts is None else time.time() - self.stamp.facts[1] / 1e9


def held_back(blocks: Iterator[Block], margin: int) -> Iterator[Block]:
    """Yield all frames but the last `margin`, which may not be completely written yet."""
    held: list[Block] = []
    for block in blocks:
        held.append(block)
        while sum(len(later.status) for later in held[1:]) >= margin and len(held) > 1:
            yield held.pop(0)
    ready = sum(len(block.status) for block in held) - margin
    for block in held:
        if ready > 0:
            yield part_of(block, 0, min(ready, len(block.status)))
        ready -= len(block.status)


def part_of(block: Block, start: int, stop: int) -> Block:
    """Return frames `start` to before `stop` of a block, counted from its first."""
    times_s = None if block.times_s is None else block.times_s[start:stop]
    return Block(block.pixels[start:stop], block.start + start, block.status[start:stop], times_s)
