"""What tests of every package share."""

import os

import pytest

# Before the workers load NumPy: two workers of two threads each wait for each other half of the time.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def pytest_xdist_auto_num_workers():
    """One worker for each core that may be used: xdist counts those of the machine. Each takes half a GiB."""
    return min(8, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)


@pytest.fixture
def without_pictures(monkeypatch):
    """PNGs of one byte, where pictures are not what is tested: drawing takes most of a short run's time."""
    monkeypatch.setattr("vision.figures.drawing.png", lambda figure, **how: b".")
