"""Finished run folders whose files are damaged, shrink or grow."""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from tests.scenes.comb_video import write_video
from vision.command.main import run
from vision.errors import InputError
from vision.run import read_run, read_strip


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    place = tmp_path_factory.mktemp("run")
    words = [str(write_video(place / "comb.tif")), "--quiet", "--no-report", "--out", str(place / "run")]
    assert run(words) == 0
    return place / "run"


@pytest.fixture
def folder(finished, tmp_path):
    return Path(shutil.copytree(finished, tmp_path / "run"))


def test_a_diagram_that_shrinks_after_it_was_read_is_whole(folder):
    """A failure means that `track kymograph RUN` is killed (SIGBUS) where another program cuts the file."""
    strip = read_strip(read_run(folder))
    before = strip.values.copy()
    os.truncate(folder / "kymograph.tif", 1000)
    assert np.array_equal(strip.values, before)
    assert strip.shape == (60, 180)


@pytest.mark.parametrize("size", [0, 5, 500, 20_000])
def test_a_diagram_that_was_cut_is_one_line(size, folder):
    """A failure means a traceback, or zeros in place of what is missing."""
    os.truncate(folder / "kymograph.tif", size)
    with pytest.raises(InputError) as caught:
        read_strip(read_run(folder))
    assert "\n" not in str(caught.value)


def test_a_diagram_may_be_larger_than_any_frame(folder, monkeypatch):
    """A failure means that the diagram of a long film, over 100 million values, is refused."""
    monkeypatch.setattr("vision.files.MOST_PIXELS", 1000)
    assert read_strip(read_run(folder)).shape == (60, 180)
