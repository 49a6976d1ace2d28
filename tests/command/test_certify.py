"""`track certify` as typed, on a simulated test: the certificate against the truth."""

import shutil

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from tests.scenes.degraded import SCENE
from vision.certify import CertifySettings, certify_run
from vision.command.main import run
from vision.experiment import preset, simulate, with_settings
from vision.review.saving import _deformation_differs
from vision.run.reading import read_json, read_run

pytestmark = pytest.mark.usefixtures("without_pictures")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("certify")
    changes = {**SCENE, "camera.duration_s": 10, "mechanics.d_end_mm": 15}
    test = simulate(with_settings(preset("paper", seed=3), changes), folder / "sim")
    told = ["--timestamps", str(test.timestamps), "--pixel-size", "10", "--offset", "36", "--quiet"]
    target = folder / "sim_tracks"
    assert run([str(test.video), "--force", str(test.force), *told, "--out", str(target)]) in (0, 1)
    return target, test.truth


@pytest.mark.thorough
def test_the_certificate_of_a_run(made, tmp_path, capsys):
    """A failure means that the command does not certify a run, or not with what the errors were."""
    target, truth = made
    assert run(["certify", str(target), "--films", "1"]) == 0
    assert "Random error of a position" in capsys.readouterr().out
    facts = read_json(tmp_path / "sim_tracks_certificate/certificate.json")
    error = _positions(target / "tracks.nc") - _positions(truth)
    actual = np.sqrt(np.mean((error - error.mean(axis=0)) ** 2))
    assert 0.85 < facts["error_px"] / actual < 1.15
    assert abs(facts["threshold"]["bias"]) < 0.05
    assert len(pd.read_csv(tmp_path / "sim_tracks_certificate/certificate.csv")) == error.shape[1]
    page = (tmp_path / "sim_tracks_certificate/certificate.html").read_text("utf-8")
    assert '<div class="what">σ<sub>x</sub>/Λ<sub>st</sub> at 0.1</div>' in page
    assert run(["certify", str(target)]) == 2  # never over an earlier one unasked
    assert "--overwrite" in capsys.readouterr().err


@pytest.mark.thorough
def test_a_run_without_a_force_recording(made, tmp_path, capsys):
    """A failure means exit status 1, as after a warning that matters, for every film without a force."""
    target = tmp_path / "film_tracks"
    film = str(made[0].parent / "sim/video.avi")
    assert run([film, "--fps", "60", "--quiet", "--out", str(target)]) == 0
    assert run(["certify", str(target), "--films", "1"]) == 0
    printed = capsys.readouterr()
    assert "not known" in next(line for line in printed.out.splitlines() if line.startswith("σ_x/Λ_st"))
    assert not printed.err


def test_every_film_is_progress(made):
    """A failure means a bar that stands still, or ends early, while films at the threshold are tracked."""
    seen = []
    settings = CertifySettings(films=1, largest_jump=1.5)
    certify_run(read_run(made[0]), settings=settings, progress=lambda *counts: seen.append(counts))
    assert seen == [(1, 4), (2, 4), (3, 4), (4, 4)]


def test_nothing_is_written_into_a_run(made, refused):
    """The run is replaced as a whole. A failure means that what was written into it is lost with it."""
    there = sorted(path.name for path in made[0].iterdir())
    for command in (["certify", str(made[0]), "--films", "1"], ["figures", str(made[0])]):
        assert "expected a place outside the run folder" in refused(*command, "--out", str(made[0] / "more"))
    assert sorted(path.name for path in made[0].iterdir()) == there


def test_shells_unknown_before_and_after_are_no_change(made, tmp_path):
    """A failure means that a review says of sticks with too few sheets that their shells change."""
    sheets = np.arange(len(xr.load_dataset(made[0] / "tracks.nc", engine="h5netcdf")["sheet"]))
    folder = tmp_path / "run"
    shutil.copytree(made[0], folder)
    shells = pd.read_csv(folder / "shells.csv", dtype={"stiff_sheets": "Int64"})
    shells.loc[:2, ["stiff_sheets", "stiff_low", "stiff_high"]] = pd.NA
    shells.to_csv(folder / "shells.csv", index=False)
    found = _deformation_differs(folder, folder, sheets, sheets)
    assert [side["other"] for side in found["shells"]] == [0, 0]


def test_what_cannot_be_certified(tmp_path, refused):
    """One line each, exit status 2."""
    refused("certify", tmp_path)
    refused("certify", tmp_path, "--films", "0")


def test_a_place_that_cannot_be_written_is_said_at_once(made, tmp_path, monkeypatch, refused):
    """A failure means that minutes of films are made, and lost."""
    monkeypatch.setattr("vision.command.views.certify_run", None)
    (tmp_path / "file").touch()
    for place in (tmp_path / "file", tmp_path / "file" / "below"):
        assert "expected a place for a folder; found a file" in refused("certify", made[0], "--out", place)


def _positions(path):
    with xr.open_dataset(path, engine="h5netcdf") as data:
        return data["x_px"].values
