"""A recording that a camera still writes: opened again and read on until it is closed."""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import xarray as xr

from vision.errors import InputError
from vision.files import Stamp
from vision.video.reader import Block
from vision.video.settings import VideoSettings
from vision.video.threads import answered
from vision.video.video import Video, open_video, pixels_file


@dataclass(frozen=True, kw_only=True)
class Follow:
    """How a growing recording is followed.

    Parameters
    ----------
    stop
        Set from outside to end with what has been read.
    closed
        Set when the recording is closed and read to its end.
    seen
        Called after every block with a function that gives I(x, t) of the last so many frames, and with the
        frames in the file that are not read yet (None where their number is not known).
    waiting
        Called once with the reason where the recording cannot be read for now, as an MP4 that is not closed.
    """

    stop: threading.Event = field(default_factory=threading.Event)
    closed: threading.Event = field(default_factory=threading.Event)
    seen: Callable[[Callable[[int], xr.DataArray], int | None], None] | None = None
    waiting: Callable[[str], None] | None = None


def await_video(
    path: str | os.PathLike[str], opened: Callable[[], Video], follow: Follow, settings: VideoSettings
) -> Video:
    """The recording, as soon as it holds enough frames to find the strip in, or stands still.

    Parameters
    ----------
    path
        Of the recording, which need not be there yet.
    opened
        Opens it.
    follow, settings
        See `Follow` and `VideoSettings`.

    Raises
    ------
    InputError
        Where it cannot be opened and nothing has been written to it for `settings.follow_give_up_s`.
    """
    film = Path(path)
    pixels = answered(lambda: pixels_file(film), film, settings.answer_s)
    watch = _Watch(pixels, settings.answer_s)
    tell_at = time.monotonic() + settings.follow_tell_s
    while True:
        still_s = watch.still_s()
        try:
            video = opened()
        except InputError as error:
            if max(still_s, watch.age_s()) >= settings.follow_give_up_s or follow.stop.is_set():
                raise
            if follow.waiting is not None and time.monotonic() >= tell_at:
                follow.waiting(str(error))
                tell_at = math.inf
        else:
            few = video.estimated is not None and video.estimated < settings.follow_first
            if not few or still_s >= settings.follow_still_s or follow.stop.is_set():
                return video
        follow.stop.wait(settings.follow_poll_s)


def growth(video: Video, follow: Follow, settings: VideoSettings) -> Iterator[tuple[Video, bool]]:
    """The recording, opened anew each time it has grown, and whether it is closed: then it is the last one.

    It is closed when its size and time have stood still for `settings.follow_still_s` and it can be opened.
    A pause lasts as long as the reading before it, so that formats which must be decoded from their start
    are not decoded all the time.

    Raises
    ------
    InputError
        Where it was removed or replaced, or stands still and cannot be opened.
    """
    watch = _Watch(video.watched, settings.answer_s)
    while not follow.stop.is_set():
        began = time.monotonic()
        yield video, False
        pause_until = 2 * time.monotonic() - began
        seen = watch.stamp
        while not follow.stop.wait(settings.follow_poll_s):
            still_s = watch.still_s()
            if still_s < settings.follow_still_s and (watch.stamp == seen or time.monotonic() < pause_until):
                continue
            try:
                video = _again(video)
            except InputError:
                if still_s >= settings.follow_give_up_s:
                    raise
                continue
            if still_s >= settings.follow_still_s:
                yield video, True
                return
            break


def _again(video: Video) -> Video:
    """The same recording as it is now.  Raises: InputError."""
    change = answered(lambda: video.stamp.change(video.watched), video.path, video.answer_s)
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
    """How long a file or folder has stood still, by this process's own clock."""

    def __init__(self, path: Path, answer_s: float) -> None:
        self._path, self._answer_s = path, answer_s
        self.stamp = self._now()
        self._since = time.monotonic()

    def still_s(self) -> float:
        """Seconds since a change was last seen; takes a new stamp."""
        now = self._now()
        if now != self.stamp:
            self.stamp, self._since = now, time.monotonic()
        return time.monotonic() - self._since

    def _now(self) -> Stamp:
        return answered(lambda: Stamp.of(self._path), self._path, self._answer_s)

    def age_s(self) -> float:
        """Seconds since it was written to, by its own time; 0 for one that is not there."""
        return 0.0 if self.stamp.facts is None else time.time() - self.stamp.facts[1] / 1e9


def held_back(blocks: Iterator[Block], margin: int) -> Iterator[Block]:
    """The same frames without the last `margin`, which may not be written whole yet."""
    waiting: list[Block] = []
    count = 0
    for block in blocks:
        waiting.append(block)
        count += len(block.status)
        while count - len(waiting[0].status) >= margin:
            count -= len(waiting[0].status)
            yield waiting.pop(0)
            if not waiting:
                break
    for block in waiting:
        ready = min(len(block.status), count - margin)
        if ready > 0:
            yield part_of(block, 0, ready)
        count -= len(block.status)


def part_of(block: Block, start: int, stop: int) -> Block:
    """Frames `start` to before `stop` of a block, counted from its first."""
    times_s = None if block.times_s is None else block.times_s[start:stop]
    return Block(block.pixels[start:stop], block.start + start, block.status[start:stop], times_s)
