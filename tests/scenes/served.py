"""A review that is served within the test's own process."""

from __future__ import annotations

from queue import Queue
from threading import Thread

from vision.review.server import serve
from vision.review.session import Session


def serving_of(session: Session) -> tuple[Thread, str]:
    """A thread that serves a review, and its address with the token."""
    opened: Queue[str] = Queue()
    serving = Thread(target=serve, args=(session,), kwargs={"opened": opened.put}, daemon=True)
    serving.start()
    return serving, opened.get(timeout=120)
