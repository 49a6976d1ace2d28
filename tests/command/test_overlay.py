"""`track overlay`: the strokes on the film stand where the sheets are, on the frames they belong to."""

import json
import shutil
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import xarray as xr

from tests.scenes.comb_video import frames_of, positions, write_video
from vision.command.main import run
from vision.video import open_video

pytestmark = pytest.mark.usefixtures("without_pictures")

FRAMES, BLANK, MARGIN, SCALE = 40, 7, 22, 3  # 161 columns are enlarged threefold


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A film with one blank frame, and its run."""
    folder = tmp_path_factory.mktemp("made")
    pixels = frames_of(positions(FRAMES, sheets=7), width_px=161, rows=41)
    pixels[BLANK] = 0
    film = write_video(folder / "comb.tif", pixels)
    options = [
        "--fps",
        "20",
        "--strip",
        "4:36",
        "--quiet",
        "--no-report",
        "--out",
        str(folder / "comb_tracks"),
    ]
    assert run([str(film), *options]) == 1  # the blank frame
    return folder


@pytest.fixture
def there(made, tmp_path, monkeypatch):
    shutil.copytree(made, tmp_path / "work")
    monkeypatch.chdir(tmp_path / "work")
    facts = json.loads(Path("comb_tracks/run.json").read_text())
    facts["inputs"][0]["path"] = "comb.tif"
    Path("comb_tracks/run.json").write_text(json.dumps(facts))
    return tmp_path / "work"


def decoded(path):
    with av.open(str(path)) as file:
        rate = float(file.streams.video[0].average_rate)
        return np.stack([frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)]), rate


def strokes(picture):
    """Columns of the film where colour stands between the strip's edge and the end of the strokes."""
    rows = picture[MARGIN + 4 * SCALE + 4 : MARGIN + 4 * SCALE + 20].astype(int)
    colour = (rows[..., 0] - rows[..., 2]).mean(axis=0)  # red less blue: orange above 0, blue below
    found = []
    for sign in (-1, 1):
        strong = np.clip(sign * colour - 20, 0, None)
        wide = np.convolve(strong, np.ones(9), "same") > 0  # a codec's colours come in blocks
        edges = np.flatnonzero(np.diff(np.r_[0, wide, 0]))
        for first, last in edges.reshape(-1, 2):
            column = np.average(np.arange(first, last), weights=strong[first:last])
            found.append(((column + 0.5) / SCALE - 0.5, sign))
    return sorted(found)


def test_strokes_stand_on_the_sheets_of_their_own_frame(there, capsys):
    """Failure: the overlay is shifted, scaled wrongly, a frame late, or of the wrong side's colour."""
    assert run(["overlay", "comb_tracks"]) == 0
    assert "40 frames" in capsys.readouterr().out
    film, rate = decoded("comb_tracks_overlay.mp4")
    assert (len(film), rate) == (FRAMES, 20)
    assert film.shape[1] % 2 == film.shape[2] % 2 == 0
    truth = positions(FRAMES, sheets=7)
    for frame in (0, 19, 20, 39):  # before and after the jump by 4 px
        found = strokes(film[frame])
        assert len(found) == 7
        assert np.abs(np.array([x for x, _ in found]) - truth[frame]).max() < 0.5
        assert np.array([side for _, side in found])[[0, 1, 2, 4, 5, 6]].tolist() == [-1, -1, -1, 1, 1, 1]
    assert np.abs(truth[19] - truth[20]).max() > 3  # a frame too late would show
    assert film[BLANK, MARGIN:-MARGIN].mean() < 6  # not the frame before it


@pytest.mark.parametrize(
    ("recorded", "said"),
    [
        (60.0, "played at 50 frames/s (recorded at 60)"),
        (0.5, "played at 5 frames/s (recorded at 0.5)"),
        (20.0, "played at 20 frames/s, "),
    ],
)
def test_another_speed_than_the_film_s_is_said(there, capsys, recorded, said):
    """Failure: slow motion is shown for what was seen, and nobody is told."""
    with xr.open_dataset("comb_tracks/tracks.nc", engine="h5netcdf") as data:
        tracks = data.load().assign_attrs(fps=recorded)
    tracks.to_netcdf("comb_tracks/tracks.nc", engine="h5netcdf")
    assert run(["overlay", "comb_tracks", "--frames", "0:3", "--out", "part.mp4"]) == 0
    assert said in capsys.readouterr().out


def test_a_part_of_the_film(there):
    """Failure: --frames draws the first frames, or others' positions."""
    assert run(["overlay", "comb_tracks", "--frames", "20:23", "--out", "part.mp4", "--quiet"]) == 0
    film, _ = decoded("part.mp4")
    assert len(film) == 3
    assert np.abs(np.array([x for x, _ in strokes(film[0])]) - positions(FRAMES, sheets=7)[20]).max() < 0.5
    assert run(["overlay", "comb_tracks", "--frames", "50:60", "--out", "other.mp4"]) == 2
    assert not Path("other.mp4").exists()


def test_a_film_that_is_gone_or_another_is_refused(there, refused):
    """Failure: tracks are drawn on a film that they do not belong to."""
    film = Path("comb.tif")
    content = film.read_bytes()
    for change, words in (
        (content[:-1] + bytes([content[-1] ^ 1]), "another of the same size"),
        (content + b"\0", "bytes"),
    ):
        film.write_bytes(change)
        assert words in refused("overlay", "comb_tracks")
    film.rename("moved.tif")
    assert "--film" in refused("overlay", "comb_tracks")
    Path("moved.tif").write_bytes(content)
    assert run(["overlay", "comb_tracks", "--film", "moved.tif", "--frames", "0:2", "--quiet"]) == 0
    assert run(["overlay", "comb_tracks", "--film", "moved.tif"]) == 2  # keeps what is there
    assert run(["overlay", "."]) == 2


def test_a_film_is_found_from_any_directory(tmp_path, monkeypatch):
    """Failure: a run in another folder than its film can only be used where it was made."""
    (tmp_path / "films").mkdir()
    write_video(tmp_path / "films" / "comb.tif", frames_of(positions(5)))
    monkeypatch.chdir(tmp_path / "films")
    assert run(["comb.tif", "--quiet", "--no-report", "--out", "../results/comb"]) in (0, 1)
    monkeypatch.chdir("/")
    there = str(tmp_path / "results" / "comb")
    assert run(["overlay", there, "--out", str(tmp_path / "o.mp4"), "--quiet"]) == 0
    (tmp_path / "results").rename(tmp_path / "films" / "results")  # both are taken to another place
    (tmp_path / "films").rename(tmp_path / "copy")
    shutil.move(tmp_path / "copy" / "comb.tif", tmp_path / "copy" / "results" / "comb.tif")
    there = str(tmp_path / "copy" / "results" / "comb")
    assert run(["overlay", there, "--out", str(tmp_path / "p.mp4"), "--quiet"]) == 0


def test_wide_films_are_scaled_down(tmp_path):
    """Failure: a wide film gives an MP4 that no player shows."""
    x = positions(3, sheets=20, pitch_px=120.0)
    write_video(tmp_path / "wide.tif", frames_of(x, width_px=2500, rows=20))
    assert run(["wide.tif", "--quiet", "--no-report", "--window", "9"]) in (0, 1)
    assert run(["overlay", "wide_tracks", "--quiet"]) == 0
    film, _ = decoded("wide_tracks_overlay.mp4")
    assert film.shape[2] == 1920


def test_a_film_of_images_given_as_a_pattern(tmp_path):
    """Failure: a film that is a glob, absolute or not, is thought to be gone."""
    for k, frame in enumerate(frames_of(positions(5))):
        cv2.imwrite(f"f{k}.png", frame)
    assert run([str(tmp_path / "f*.png"), "--quiet", "--no-report", "--out", "run"]) in (0, 1)
    assert run(["overlay", "run", "--quiet"]) == 0
    assert len(decoded("run_overlay.mp4")[0]) == 5


def test_an_overlay_given_as_a_film_is_called_one(there):
    """Failure: ridges below drawn strokes are tracked like those of the film, and nobody is told."""
    assert run(["overlay", "comb_tracks", "--quiet"]) == 0
    (line,) = open_video("comb_tracks_overlay.mp4").warnings
    assert line.startswith("comb_tracks_overlay.mp4: an overlay")
    shutil.copy("comb_tracks_overlay.mp4", "renamed.mp4")
    assert open_video("renamed.mp4").warnings[0].startswith("renamed.mp4: an overlay")
    assert not open_video("comb.tif").warnings
