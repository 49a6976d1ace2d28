"""Threads that read and decode, none of which is waited for where a disk does not answer.

A read of a disk or a network that does not answer never returns, and nothing can end it. So whatever touches
a recording does it in a thread that may be left behind: these do not keep the process from ending, as those
of `concurrent.futures` do.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import queue
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future
from pathlib import Path
from typing import TypeVar

from vision.errors import InputError
from vision.video.settings import DEFAULTS

Item = TypeVar("Item")
Result = TypeVar("Result")
Made = queue.Queue[tuple[Item] | Exception | None]
Todo = queue.SimpleQueue[tuple[Future[Result], Item] | None]

HELD = 32  # items that `in_threads` works on at once
LEAVE_S = 0.5  # longest wait for a thread that is no longer needed: Ctrl-C ends within a second


def answered(work: Callable[[], Result], path: Path, answer_s: float = DEFAULTS.answer_s) -> Result:
    """What `work` returns, which reads a recording.

    Raises
    ------
    InputError
        As for `prefetch`; and what `work` raises.
    """
    return begun(work, path, answer_s)()


def begun(
    work: Callable[[], Result], path: Path, answer_s: float = DEFAULTS.answer_s
) -> Callable[[], Result]:
    """`answered`, but begun at once: what is returned waits for the result."""
    ready: Made[Result] = queue.Queue()
    task = (work() for _ in range(1))
    threading.Thread(target=_make_ahead, args=(task, ready, threading.Event()), daemon=True).start()

    def result() -> Result:
        entry = _awaited(ready, path, answer_s)
        if isinstance(entry, Exception):
            raise entry
        assert entry is not None  # the end comes after the one result
        return entry[0]

    return result


def prefetch(
    items: Iterator[Item], path: Path, answer_s: float = DEFAULTS.answer_s
) -> Generator[Item, None, None]:
    """The same items in the same order, up to two of them made ahead in one thread.

    Decoders release the interpreter lock, so decoding and reducing share two cores. An exception raised by
    `items` is raised here, at its place in the order. Abandoning the iterator stops the thread, or leaves it
    behind where it is busy or blocked.

    Parameters
    ----------
    items
        Blocks or frames of a recording.
    path
        Of the recording, for the message.
    answer_s
        See `VideoSettings.answer_s`.

    Raises
    ------
    InputError
        Where nothing comes and nothing is computed for `answer_s`.
    """
    ready: Made[Item] = queue.Queue(maxsize=2)
    abandoned = threading.Event()
    worker = threading.Thread(target=_make_ahead, args=(items, ready, abandoned), daemon=True)
    worker.start()
    try:
        while (entry := _awaited(ready, path, answer_s)) is not None:
            if isinstance(entry, Exception):
                raise entry
            yield entry[0]
    finally:
        abandoned.set()
        worker.join(LEAVE_S)


def _make_ahead(items: Iterator[Item], ready: Made[Item], abandoned: threading.Event) -> None:
    """Put every item into the queue, each in a tuple; last None, or the exception that ended them."""

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
    except Exception as error:  # whatever it is, the thread that reads is where it is handled
        hand_over(error)
    finally:
        close = getattr(items, "close", None)
        if close is not None:
            close()


def _awaited(ready: Made[Item], path: Path, answer_s: float) -> tuple[Item] | Exception | None:
    """The next entry; InputError where none comes, and this process computes nothing meanwhile."""
    while True:
        computed_s = time.process_time()
        with contextlib.suppress(queue.Empty):
            return ready.get(timeout=answer_s)
        if time.process_time() - computed_s < 0.01 * answer_s:
            wanted, found = "a disk or network that answers", f"no answer for {answer_s:g} s"
            advice = "look at the connection, or copy the recording to another disk"
            raise InputError(path, wanted, found, advice)


def usable_cores() -> int:
    """Cores that this process may use: on a cluster those of its job, not all of the machine."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def in_threads(work: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """`work` of each item in order, on all cores.

    `HELD` items are drawn, then worked on, then the next are drawn: both may read the same file.
    """
    todo: Todo[Result, Item] = queue.SimpleQueue()
    workers = [threading.Thread(target=_serve, args=(work, todo), daemon=True) for _ in range(usable_cores())]
    for worker in workers:
        worker.start()
    source = iter(items)
    held: list[Future[Result]] = []
    try:
        while batch := list(itertools.islice(source, HELD)):
            held = [Future() for _ in batch]
            for task in zip(held, batch, strict=True):
                todo.put(task)
            yield from (future.result() for future in held)
    finally:
        for future in held:
            future.cancel()
        for _ in workers:
            todo.put(None)
        for worker in workers:
            worker.join(LEAVE_S / len(workers))


def _serve(work: Callable[[Item], Result], todo: Todo[Result, Item]) -> None:
    """Do what is put into the queue, up to None."""
    while (task := todo.get()) is not None:
        future, item = task
        if future.set_running_or_notify_cancel():
            try:
                future.set_result(work(item))
            except Exception as error:  # raised where the result is asked for
                future.set_exception(error)
