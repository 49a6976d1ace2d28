"""Runs that several tests draw."""

import pytest

from tests.scenes import analysed


@pytest.fixture(scope="session")
def video_only():
    """A run without force and without pixel size."""
    return analysed.video_only()


@pytest.fixture(scope="session")
def pulled():
    """A run with everything."""
    return analysed.with_force()
