"""The examples of docs/results.md run as they stand on the page."""

import inspect
import re
import shutil
from pathlib import Path

import matplotlib
import numpy as np
import pytest
import xarray as xr

from vision.command.main import run
from vision.command.options import SimulateOptions
from vision.errors import InputError
from vision.experiment import preset

PROJECT = Path(__file__).parents[2]
LATE = PROJECT / "fixtures" / "late"
PAGE = (PROJECT / "docs" / "results.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the film, the recording and the run that the page names."""
    place = tmp_path_factory.mktemp("results")
    shutil.copy(LATE / "video.avi", place / "test.avi")
    shutil.copy(LATE / "force.txt", place / "test.txt")
    for name in ("discs.csv", "strip.txt"):
        shutil.copy(PROJECT / "fixtures" / name, place)
    options = ("--timestamps", str(LATE / "timestamps.txt"), "--d0", "16.6", "--pixel-size", "10", "--quiet")
    run(
        [
            str(place / "test.avi"),
            *options,
            "--force",
            str(place / "test.txt"),
            "--out",
            str(place / "test_tracks"),
        ]
    )
    return place


@pytest.mark.thorough
def test_the_examples_give_what_they_promise(folder, monkeypatch):
    """A failure means that a line which readers copy fails, or finds nothing."""
    monkeypatch.chdir(folder)
    matplotlib.use("agg")
    tables, cells, stages = {}, {}, {}
    for block in BLOCKS[:3]:
        exec(block, tables)
    assert len(tables["outermost"]) == len(tables["x_um"]) == 240
    assert tables["moved_err_px"] > tables["first"].x_err_px > 0
    assert np.isfinite(tables["ratio"]["median"]).sum() >= 40
    with xr.open_dataset(LATE / "truth.nc") as truth:
        innermost = truth.ratio[:, truth.n.values == 1].values
    found = tables["usable"][tables["usable"].n == 1].ratio
    assert found.size == 22  # two sheets in eleven sticks; 14 of them are positive
    assert found.median() == pytest.approx(innermost.mean(), abs=0.002)  # 0.0082 without `below_noise`
    exec(BLOCKS[3], cells)
    assert cells["outermost"].dims == ("frame",)
    assert np.isfinite(cells["outermost"].values).all()
    assert bool(cells["measured"].all())
    exec(BLOCKS[4], stages)
    assert stages["left"].get_xlabel()
    assert len(stages["right"].lines) > 0
    stages["fig"].canvas.draw()
    label = stages["right"].yaxis.label.get_window_extent()
    assert label.x0 > stages["left"].get_window_extent().x1  # the labels do not cover the other figure
    assert stages["right"].get_legend().get_window_extent().y1 <= stages["fig"].bbox.y1
    for block in BLOCKS[5:]:
        exec(block, cells)
    assert cells["law"].a == pytest.approx(0.507, abs=0.002)
    assert cells["young"].value == pytest.approx(2.5, abs=0.01)
    assert np.isfinite(cells["motion"].ratio.values).any()
    assert (folder / "shells.pdf").stat().st_size > 5000
    np.testing.assert_allclose(cells["sigma_x_um"], cells["stick"].sigma_x_um, rtol=1e-6)


def test_every_python_example_is_run():
    """A failure means that an example was added which no test runs."""
    assert len(BLOCKS) == 10


def test_every_preset_is_named_wherever_presets_are_listed():
    """A failure means that nobody learns of a preset, or that one is offered which does not exist."""
    with pytest.raises(InputError) as caught:
        preset("none of them")
    names = set(caught.value.expected.split(", "))
    glossary = (PROJECT / "docs" / "glossary.md").read_text(encoding="utf-8")
    row = next(line for line in glossary.splitlines() if line.startswith("| preset |"))
    assert set(re.findall(r"`(\w+)`", row)) == names
    assert set(re.findall(r'``"(\w+)"``', inspect.getdoc(preset))) == names
    table = PAGE.split("| preset | simulates |")[1].split("\n\n")[0]
    assert set(re.findall(r"^\| `(\w+)`", table, re.MULTILINE)) == names
    help_text = re.search(r'preset: str = .*\n +"""(.*)\."""', inspect.getsource(SimulateOptions))[1]
    assert set(re.split(", | or ", help_text)) == names
