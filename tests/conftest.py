"""What tests of every package share."""

import gc
import os
import sys

import pytest
from hypothesis import HealthCheck, settings

from tests.scenes.undrawn import undrawn

# Before the workers load NumPy: two workers of two threads each wait for each other half of the time.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
for name in ("FORCE_COLOR", "COLUMNS", "LINES"):  # a terminal's or a CI service's, which text output obeys
    os.environ.pop(name, None)
# Where modules are not kept compiled, each process that a test starts compiles all of them again.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False
gc.set_threshold(50_000)  # the libraries' half a million objects stay
# The same examples each time, however long one takes.
settings.register_profile(
    "same", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("same")


def pytest_xdist_auto_num_workers():
    """One worker for each core that may be used: xdist counts those of the machine. Each takes half a GiB."""
    return min(8, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)


def pytest_runtest_setup(item):
    """Skip what a system does not have."""
    if os.name != "posix" and item.get_closest_marker("posix"):
        pytest.skip("Windows has nothing of the kind")


@pytest.fixture(scope="session", autouse=True)
def harmless():
    """Runs that these tests made are read without a process of their own that tries them first."""
    from tests.scenes.harmless import harmless_files

    with harmless_files():
        yield


@pytest.fixture(scope="module")
def without_pictures():
    """PNGs of one byte for a module's tests and fixtures, where pictures are not what is tested."""
    with undrawn():
        yield


@pytest.fixture
def no_picture():
    """As `without_pictures`, for a single test."""
    with undrawn():
        yield


@pytest.fixture(scope="module")
def browser():
    """A real browser."""
    from tests.scenes.browser import chromium

    with chromium() as opened:
        yield opened


@pytest.fixture(scope="session")
def video_only():
    """A run without force and without pixel size."""
    from tests.scenes import analysed  # not where nobody asks for it: it loads half of the program

    return analysed.video_only()


@pytest.fixture(scope="session")
def pulled():
    """A run of a video and a force recording, with every stage."""
    from tests.scenes import analysed

    return analysed.with_force()
