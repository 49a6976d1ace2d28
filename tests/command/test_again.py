"""A finished run is measured again with other options."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from vision.command.main import run
from vision.run.reading import read_run

LATE = Path(__file__).parents[2] / "fixtures" / "late"


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with the film and its files, and a run of the film alone."""
    place = tmp_path_factory.mktemp("again")
    for name in ("video.avi", "force.txt", "timestamps.txt"):
        (place / name).write_bytes((LATE / name).read_bytes())
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        options = ["--timestamps", "timestamps.txt", "--fit", "sliding", "--quiet"]
        assert run(["video.avi", *options, "--out", "first"]) in (0, 1)
    return place


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def facts(folder):
    return json.loads((folder / "run.json").read_text(encoding="utf-8"))


def test_a_force_recording_is_added_and_the_pixel_size_changed_without_reading_the_film(place):
    """A failure means that a wrong scale, or a forgotten force file, costs another pass through the film, or
    that options of the run are lost on the way."""
    force, first = ["--force", str(place / "force.txt"), "--d0", "16.6"], read_run(place / "first")
    assert run([str(place / "first"), *force, "--pixel-size", "10", "--out", "whole", "--quiet"]) in (0, 1)
    (place / "video.avi").rename(place / "away.avi")
    try:
        assert run(["whole", "--pixel-size", "8±0.1", "--out", "smaller", "--quiet"]) in (0, 1)
    finally:
        (place / "away.avi").rename(place / "video.avi")
    for folder in (Path("whole"), Path("smaller")):
        np.testing.assert_array_equal(read_run(folder).tracks["x_px"], first.tracks["x_px"])
        found = facts(folder)
        assert "reading" not in found["seconds"]
        assert found["parameters"]["fit"] == {"value": "sliding", "how": "given"}
        assert [Path(one["path"]).name for one in found["inputs"]][:: len(found["inputs"]) - 1] == [
            "video.avi",
            "force.txt",
        ]
        assert found["inputs"][0]["sha256"] == facts(place / "first")["inputs"][0]["sha256"]
    large, small = (pd.read_csv(f"{name}/deformation.csv") for name in ("whole", "smaller"))
    np.testing.assert_allclose(small["sigma_x_um"], 0.8 * large["sigma_x_um"], rtol=1e-6)
    assert facts(Path("smaller"))["systematic_errors"]["ratio"]["systematic"] > 0
    assert run(["overlay", "smaller", "--frames", "0:3", "--quiet"]) == 0  # finds the film from here


def test_another_strip_is_read(place):
    """A failure means the positions of the earlier strip under the name of another."""
    assert run([str(place / "first"), "--strip", "0:12", "--out", "upper", "--quiet"]) in (0, 1)
    assert "reading" in facts(Path("upper"))["seconds"]
    tracks = read_run(Path("upper")).tracks
    assert (tracks.attrs["strip_z0"], tracks.attrs["strip_z1"]) == (0, 12)


def test_a_film_that_was_moved_is_read_again(place, capsys):
    """A failure means advice to give an option that there is not, or a run without its film's path."""
    Path("far").mkdir()
    asked = [str(place / "first"), "--strip", "2:20", "--out", "other", "--quiet"]
    (place / "video.avi").rename("far/moved.avi")
    try:
        assert run(asked) == 2
        assert "say where it lies (--film)" in capsys.readouterr().err
        assert run([*asked, "--film", str(place / "force.txt")]) == 2
        assert run([*asked, "--film", "far/moved.avi"]) in (0, 1)
        assert run(["far/moved.avi", "--film", "far/moved.avi", "--out", "x"]) == 2
    finally:
        Path("far/moved.avi").rename(place / "video.avi")
    found = facts(Path("other"))
    assert found["found"]["strip"]["z0"] == 2
    assert Path(found["inputs"][0]["path"]) == Path("far/moved.avi")


def test_decisions_of_the_run_are_kept(place):
    """A failure means that a sheet that was left out by hand is back."""
    text = '[[leave_out]]\nsheet = 3\nframes = "5:9"\n'
    Path("by_hand.toml").write_text(text, encoding="utf-8")
    decided = [str(place / "first"), "--corrections", "by_hand.toml", "--out", "decided", "--quiet"]
    assert run(decided) in (0, 1)
    assert run(["decided", "--pixel-size", "10", "--out", "scaled", "--quiet"]) in (0, 1)
    assert (read_run(Path("scaled")).tracks["flag"][5:9, 3] == "left_out").all()
    assert Path("scaled/corrections.toml").read_text(encoding="utf-8").count("leave_out") == 1


def test_a_run_is_replaced_only_if_it_is_asked_for(place, refused):
    """A failure means a run that is lost, or an option that does nothing."""
    before = (place / "first" / "run.json").read_bytes()
    assert "--overwrite" in refused(str(place / "first"), "--pixel-size", "10")
    assert "--follow" in refused(str(place / "first"), "--follow", "--out", "other")
    assert (place / "first" / "run.json").read_bytes() == before
    assert not Path("other").exists()
