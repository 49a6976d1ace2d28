"""What the figures of several tests show, and what is said beside them."""

import numpy as np
import pytest

import vision
from tests.scenes.comparison import events, write_run
from vision.figures.figure import Figure, Panel, Series, save_figures
from vision.figures.style import DATA


def with_sticks(folder, title):
    """A run that has kept its figure of single sticks."""
    panel = Panel(x_label="d − d_v (µm)", y_label="F − F_v (N)", title=title, series=(LINE,))
    save_figures(folder / "figures.npz", [Figure.of("sticks", panel, "Sticks.", title="Sticks")])
    return folder


LINE = Series(label="1", x=np.arange(3.0), y=np.arange(3.0), ink=DATA)


def test_speeds_that_differ_in_the_last_digit_are_one(tmp_path):
    """A failure means one velocity twice on the page, and figures of one name that overwrite each other."""
    speeds = (1.0, 0.9999999999999998, 10.0)
    folders = [
        with_sticks(write_run(tmp_path / f"r{k}", events(speed=v, seed=k), speed=v), f"r{k}")
        for k, v in enumerate(speeds)
    ]
    names = [figure.name for figure in vision.compare(folders).figures()]
    assert names.count("sticks_V1") == 1
    assert "sticks_V10" in names
    assert len(set(names)) == len(names)
