"""Waiting for something that another process or thread does."""

import time


def until(ready, seconds=120):
    """Return what `ready` returns as soon as it is true; fail after so many seconds."""
    end = time.monotonic() + seconds
    while not (found := ready()):
        assert time.monotonic() < end, "it never came"
        time.sleep(0.05)
    return found
