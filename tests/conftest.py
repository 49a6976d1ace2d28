"""What tests of every package may ask for."""

import pytest


@pytest.fixture
def without_pictures(monkeypatch):
    """PNGs of one byte, where pictures are not what is tested: drawing takes most of a short run's time."""
    monkeypatch.setattr("vision.figures.drawing.png", lambda figure, **how: b".")
