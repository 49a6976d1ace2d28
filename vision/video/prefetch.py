"""prefetch(): decode the next blocks in a thread while the present one is used."""

from __future__ import annotations

import contextlib
import queue
import threading
from collections.abc import Iterator
from typing import TypeVar

T = TypeVar("T")
_WAIT_S = 0.1  # how soon an abandoned thread notices


def prefetch(items: Iterator[T], *, depth: int = 2) -> Iterator[T]:
    """The same items in the same order, up to `depth` of them made ahead in one thread.

    Decoders release the interpreter lock, so decoding and reducing share two cores. An exception raised by
    `items` is raised here, at its place in the order. Abandoning the iterator stops the thread.
    """
    ready: queue.Queue[tuple[T] | Exception | None] = queue.Queue(maxsize=depth)
    abandoned = threading.Event()
    worker = threading.Thread(target=_fill, args=(items, ready, abandoned), daemon=True)
    worker.start()
    try:
        while (entry := ready.get()) is not None:
            if isinstance(entry, Exception):
                raise entry
            yield entry[0]
    finally:
        abandoned.set()
        worker.join()


def _fill(
    items: Iterator[T], ready: queue.Queue[tuple[T] | Exception | None], abandoned: threading.Event
) -> None:
    try:
        for item in items:
            _put((item,), ready, abandoned)
            if abandoned.is_set():
                break
        _put(None, ready, abandoned)
    except Exception as error:  # whatever it is, the thread that reads is where it is handled
        _put(error, ready, abandoned)
    finally:
        close = getattr(items, "close", None)
        if close is not None:
            close()


def _put(
    entry: tuple[T] | Exception | None,
    ready: queue.Queue[tuple[T] | Exception | None],
    abandoned: threading.Event,
) -> None:
    """Hand one entry over; give up as soon as nobody reads any more."""
    while not abandoned.is_set():
        with contextlib.suppress(queue.Full):
            ready.put(entry, timeout=_WAIT_S)
            return
