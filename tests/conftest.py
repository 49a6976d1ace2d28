"""What tests of every package share."""

import os

import pytest
from hypothesis import HealthCheck, settings

# Before the workers load NumPy: two workers of two threads each wait for each other half of the time.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
for name in ("FORCE_COLOR", "COLUMNS", "LINES"):  # a terminal's or a CI service's, which text output obeys
    os.environ.pop(name, None)
# The same examples each time, however long one takes.
settings.register_profile(
    "same", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("same")


def pytest_xdist_auto_num_workers():
    """One worker for each core that may be used: xdist counts those of the machine. Each takes half a GiB."""
    return min(8, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)


@pytest.fixture
def without_pictures(monkeypatch):
    """PNGs of one byte, where pictures are not what is tested: drawing takes most of a short run's time."""
    monkeypatch.setattr("vision.figures.drawing.png", lambda figure, **how: b".")


@pytest.fixture(scope="session")
def video_only():
    """A run without force and without pixel size, for figures and reports."""
    from tests.scenes import analysed

    return analysed.video_only()


@pytest.fixture(scope="session")
def pulled():
    """A run with everything."""
    from tests.scenes import analysed

    return analysed.with_force()
