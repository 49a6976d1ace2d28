"""The gallery's scripts run as a reader would run them, and draw something."""

import runpy
import sys
from pathlib import Path

import numpy as np
import pytest

from vision.run import writing

PROJECT = Path(__file__).parents[2]
SCRIPTS = sorted((PROJECT / "docs" / "gallery").glob("*.py"))


def test_the_gallery_has_its_scripts():
    """A failure means that a script was lost or renamed, and is no longer run by the test below."""
    names = [path.stem for path in SCRIPTS]
    assert names == [
        "publication_figures",
        "several_tests",
        "track_one_video",
        "what_would_my_camera_resolve",
        "with_force",
    ]


@pytest.mark.thorough
@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_a_script_of_the_gallery_draws_its_picture(script, tmp_path, monkeypatch):
    """A failure means that an example which readers copy fails, warns or draws an empty page."""
    from matplotlib.image import imread

    monkeypatch.chdir(tmp_path)
    # Pictures and pages of the runs behind an example, none of which it shows.
    monkeypatch.setattr(writing, "_write_figures_and_page", lambda *arguments, **options: None)
    monkeypatch.setattr(sys, "argv", [str(script), str(tmp_path)])
    runpy.run_path(str(script), run_name="__main__")
    picture = imread(tmp_path / f"{script.stem}.png")
    assert picture.shape[0] > 400
    assert picture.shape[1] > 800
    assert np.ptp(picture[..., :3]) > 0.9
