"""Threads that read and decode, and that are abandoned if a disk does not answer.

A read from a disk or a network that does not answer never returns and cannot be cancelled. All access to a
recording is therefore made in threads that can be abandoned: unlike those of `concurrent.futures` they do not
keep the process from ending.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import queue
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from pathlib import Path
from typing import TypeVar

from vision.errors import InputError
from vision.video.settings import DEFAULTS

Item = TypeVar("Item")
Result = TypeVar("Result")
Made = queue.Queue[tuple[Item] | Exception | None]

HELD = 32  # items that `in_threads` works on at once
LEAVE_S = 0.5  # longest wait for a thread that is no longer needed: Ctrl-C ends within a second


def answered(work: Callable[[], Result], path: Path, answer_s: float = DEFAULTS.answer_s) -> Result:
    """Return the result of `work`, which reads a recording.

    Raises
    ------
    InputError
        As `prefetch`, and as `work` itself.
    """
    return begun(work, path, answer_s)()


def begun(
    work: Callable[[], Result], path: Path, answer_s: float = DEFAULTS.answer_s
) -> Callable[[], Result]:
    """Start `work` at once, and return a function that waits for its result as `answered` does."""
    ready: Made[Result] = queue.Queue()
    _start((work() for _ in range(1)), ready, threading.Event())
    return lambda: _item(_awaited(ready, path, answer_s))


def prefetch(
    items: Iterator[Item], path: Path, answer_s: float = DEFAULTS.answer_s
) -> Generator[Item, None, None]:
    """Yield the same items in the same order, up to two of them made ahead in one thread.

    Decoders release the interpreter lock, so decoding and reducing share two cores. An exception raised by
    `items` is raised here, in its turn. Abandoning the iterator stops the thread, or abandons it if
    it is busy or blocked.

    Parameters
    ----------
    items
        Blocks or frames of a recording.
    path
        Path of the recording, for the message.
    answer_s
        See `VideoSettings.answer_s`.

    Raises
    ------
    InputError
        If there is no item and no computation for `answer_s`.
    """
    ready: Made[Item] = queue.Queue(maxsize=2)
    abandoned = threading.Event()
    worker = _start(items, ready, abandoned)
    try:
        while (entry := _awaited(ready, path, answer_s)) is not None:
            yield _item(entry)
    finally:
        abandoned.set()
        worker.join(LEAVE_S)


def _start(items: Iterator[Item], ready: Made[Item], abandoned: threading.Event) -> threading.Thread:
    thread = threading.Thread(target=_make_ahead, args=(items, ready, abandoned), daemon=True)
    thread.start()
    return thread


def _item(entry: tuple[Item] | Exception | None) -> Item:
    """Return the item of an entry, or raise its exception."""
    if isinstance(entry, Exception):
        raise entry
    assert entry is not None  # only `prefetch` reads up to the end
    return entry[0]


def _make_ahead(items: Iterator[Item], ready: Made[Item], abandoned: threading.Event) -> None:
    """Put each item into the queue in a tuple, and finally None or the exception that ended them."""

    def hand_over(entry: tuple[Item] | Exception | None) -> None:
        while not abandoned.is_set():
            with contextlib.suppress(queue.Full):
                ready.put(entry, timeout=0.1)
                return

    try:
        for item in items:
            hand_over((item,))
            if abandoned.is_set():
                break
        hand_over(None)
    except Exception as error:  # any exception is handled in the consuming thread
        hand_over(error)
    finally:
        close = getattr(items, "close", None)
        if close is not None:
            close()


def _awaited(ready: Made[Item], path: Path, answer_s: float) -> tuple[Item] | Exception | None:
    """Return the next entry; InputError if there is none while this process computes nothing."""
    while True:
        computed_s = time.process_time()
        with contextlib.suppress(queue.Empty):
            return ready.get(timeout=answer_s)
        if time.process_time() - computed_s < 0.01 * answer_s:
            wanted, found = "a disk or network that answers", f"no answer for {answer_s:g} s"
            advice = "look at the connection, or copy the recording to another disk"
            raise InputError(path, wanted, found, advice)


def usable_cores() -> int:
    """Return the number of cores that this process may use, on a cluster those of its job."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def in_threads(work: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """Yield the result of `work` for each item in order, on all cores.

    `HELD` items are drawn and worked on before the next are drawn, since both may read the same file.
    """
    source, count, abandoned = iter(items), usable_cores(), threading.Event()
    threads: list[threading.Thread] = []
    try:
        while batch := list(itertools.islice(source, HELD)):
            ready: list[Made[Result]] = [queue.Queue() for _ in range(count)]
            threads = [_start(map(work, batch[n::count]), made, abandoned) for n, made in enumerate(ready)]
            for n in range(len(batch)):
                yield _item(ready[n % count].get())
    finally:
        abandoned.set()
        for thread in threads:
            thread.join(LEAVE_S / count)
