"""A recording that a camera still writes: read as it grows, each frame once."""

from __future__ import annotations

import contextlib
import math
import os
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import xarray as xr

from vision.errors import InputError
from vision.files import Watch, answered, prefetch
from vision.video.reader import Block
from vision.video.settings import VideoSettings
from vision.video.video import Video, open_video, pixels_file


@dataclass(frozen=True, kw_only=True)
class Follow:
    """How a growing recording is followed."""

    stop: threading.Event = field(default_factory=threading.Event)  #: set by the caller to end
    closed: threading.Event = field(default_factory=threading.Event)  #: set when it is closed and read
    #: Called after each block with a function that returns I(x, t) of a number of the last frames, and with
    #: the number of frames in the file that are not read yet (None if unknown).
    seen: Callable[[Callable[[int], xr.DataArray], int | None], None] | None = None
    #: Called once with the reason if the recording cannot be read yet, such as an MP4 that is not closed.
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
    watch = answered(lambda: Watch(pixels), pixels, settings.answer_s)
    report_at = time.monotonic() + settings.follow_tell_s
    while True:
        unchanged_s = answered(watch.unchanged_s, pixels, settings.answer_s)
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


def followed(
    video: Video, rows: slice, columns: slice, known: int, follow: Follow, settings: VideoSettings
) -> Iterator[tuple[Video, Block]]:
    """Yield the blocks of a growing recording after the first `known` frames, with it as it was then open.

    The last frames are read when it is closed.

    Raises: InputError if the last frame that was read has changed when it is read again, or as `growth`.
    """
    wanted = math.inf if video.stop is None else video.stop - video.first
    last: Block | None = None
    for now, whole in growth(video, follow, settings):
        margin = 0 if whole else settings.follow_margin
        skip = 0 if last is None else 1  # the last frame is read again, and must be the same
        stop = None if now.stop is None else now.stop + margin
        rest = replace(now, first=video.first + known - skip, stop=stop)
        read = prefetch(rest.blocks(rows, columns), video.path, settings.answer_s)
        for block in held_back(read if whole else _readable(read), margin):
            if skip and last is not None:
                _check_unchanged(video, last, block)
            end = len(block.status) if now.stop is None else min(len(block.status), now.stop - block.start)
            if end > skip:
                known += end - skip
                last = _part_of(block, end - 1, end)
                last = replace(last, pixels=last.pixels.copy())
                yield now, _part_of(block, skip, end)
                if follow.stop.is_set():
                    return
            skip = 0
        if whole or known == wanted:
            follow.closed.set()
            return


def _check_unchanged(video: Video, last: Block, block: Block) -> None:
    """Raise `InputError` unless the block begins with the last frame that was read."""
    same = last.status[0] == block.status[0]
    if not (same and last.pixels.tobytes() == block.pixels[:1].tobytes()):
        wanted, found = "a recording that only grows while it is followed", "other frames than before"
        raise InputError(video.path, wanted, found, "run again when it is complete")


def growth(video: Video, follow: Follow, settings: VideoSettings) -> Iterator[tuple[Video, bool]]:
    """Yield the recording each time it has grown, and whether it is closed, which is True for the last one.

    It is closed when its size and time have not changed for `settings.follow_still_s` and it can be opened.
    Each pause is as long as the reading before it, so that formats that must be decoded from their start are
    not decoded all the time.

    Raises: InputError if it was removed or replaced, or no longer grows and cannot be opened.
    """
    path, answer_s = video.pixels_path, settings.answer_s
    watch = answered(lambda: Watch(path), path, answer_s)
    while not follow.stop.is_set():
        began = time.monotonic()
        yield video, False
        pause_until = 2 * time.monotonic() - began
        seen = watch.stamp
        while not follow.stop.wait(settings.follow_poll_s):
            unchanged_s = answered(watch.unchanged_s, path, answer_s)
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


def _readable(blocks: Iterator[Block]) -> Iterator[Block]:
    """Yield the blocks before one that cannot be read yet, as in an MP4 with an incomplete last part."""
    with contextlib.suppress(InputError):
        yield from blocks


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
            yield _part_of(block, 0, min(ready, len(block.status)))
        ready -= len(block.status)


def _part_of(block: Block, start: int, stop: int) -> Block:
    """Return frames `start` to before `stop` of a block, counted from its first."""
    times_s = None if block.times_s is None else block.times_s[start:stop]
    return Block(block.pixels[start:stop], block.start + start, block.status[start:stop], times_s)
