"""Several videos in one call; the pixel size from the sheets' own spacing."""

import json
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
import tifffile

from tests.scenes.comb_video import frames_of, positions, write_video
from vision.command.main import run

pytestmark = pytest.mark.usefixtures("without_pictures")


@pytest.fixture
def films(tmp_path):
    """Three good films, of 8, 7 and 6 sheets."""
    for k, sheets in enumerate((8, 7, 6)):
        write_video(tmp_path / f"t{k}.tif", frames_of(positions(30, sheets=sheets)))
    return ["t0.tif", "t1.tif", "t2.tif"]


def test_each_film_has_its_folder_and_its_row(films, capsys):
    """A failure means that one film's results stand under another's name, or that the table lacks one."""
    assert run([*films, "--fps", "20", "--no-report"]) == 0
    *table, where = capsys.readouterr().out.splitlines()
    assert where == "results: FILM_tracks/ (look at overview.png first)"
    head, *rows = [line.split() for line in table]
    assert head[:4] == ["film", "status", "sheets", "frames"]
    assert [row[:4] for row in rows] == [[f"t{k}.tif", "0", str(8 - k), "30"] for k in range(3)]
    for k in range(3):
        assert pd.read_csv(f"t{k}_tracks/tracks.csv")["index"].nunique() == 8 - k
        assert not Path(f"t{k}_tracks/report.html").exists()


def test_a_bad_film_costs_nothing_but_itself(films, capsys, monkeypatch):
    """A failure means that films after a bad one are not done, or that the exit status hides it."""
    Path("t1.tif").write_bytes(b"II*\0nothing")
    assert run([*films, "--out", "runs", "--no-report"]) == 2
    said = capsys.readouterr()
    assert sorted(path.name for path in Path("runs").iterdir()) == ["t0_tracks", "t2_tracks"]
    assert len(said.err.splitlines()) == 1
    assert "t1.tif" in said.err
    *table, where = said.out.splitlines()
    assert where == f"results: {Path('runs', 'FILM_tracks')}/ (look at overview.png first)"
    assert [line.split()[1] for line in table[1:]] == ["0", "2", "0"]
    assert run([*films, "--out", "runs", "--no-report", "--overwrite", "--quiet"]) == 2
    assert not capsys.readouterr().out

    from vision import pipeline

    track_sheets = pipeline.track_sheets

    def broken(strip, **options):
        if "t0" in strip.attrs["source"]:
            raise RuntimeError("nobody foresaw this")
        return track_sheets(strip, **options)

    monkeypatch.setattr(pipeline, "track_sheets", broken)
    assert run([*films, "--out", "others", "--no-report"]) == 3  # the worst of 3, 2 and 0
    assert [path.name for path in Path("others").iterdir()] == ["t2_tracks"]


def test_a_film_that_is_missing_costs_nothing_but_itself(films, capsys):
    """A failure means that one wrong name keeps all films of a night from being tracked."""
    assert run(["gone.tif", *films, "--no-report"]) == 2
    assert "gone.tif" in capsys.readouterr().err
    assert all(Path(f"{Path(film).stem}_tracks", "run.json").exists() for film in films)


def test_a_noise_that_was_not_measured_is_an_empty_cell(films, capsys):
    """A failure means that "nan" stands in the table, as if something had gone wrong."""
    assert run([*films, "--frames", "0:2", "--no-report"]) == 1
    _, *rows, _ = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert [row[5:7] for row in rows] == [["100.00", "%"]] * 3
    assert not any("nan" in row for row in rows)


def test_frames_that_a_film_lacks_are_not_measured(films, capsys):
    """A failure means that a film of which most is lost looks as if all of it had been measured."""
    write_video(Path("cut.avi"), frames_of(positions(40)))
    Path("cut.avi").write_bytes(Path("cut.avi").read_bytes()[: Path("cut.avi").stat().st_size // 2])
    assert run(["cut.avi", "t0.tif", "--fps", "20", "--no-report"]) == 1
    cut, whole = [line.split() for line in capsys.readouterr().out.splitlines()[1:3]]
    assert float(cut[5]) == pytest.approx(100 * int(cut[3]) / 40, abs=0.01) and int(cut[3]) < 25
    assert float(whole[5]) == 100


def test_warnings_name_their_film(films, capsys):
    """A failure means that nobody knows which of a hundred films lost frames."""
    pixels = frames_of(positions(30))
    pixels[4:8] = 0
    write_video(Path("t1.tif"), pixels)
    assert run([*films, "--no-report"]) == 1
    said = capsys.readouterr()
    assert said.err.startswith("track: warning: t1.tif: 4 frames blank")
    assert "1 warning" in said.out.splitlines()[2]


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--force", "t0.tif"], "one video"),
        (["--offset", "0"], "one video"),
        (["sub/t0.tif"], "different names"),
        (["--strip", "5"], "--strip"),
    ],
)
def test_what_cannot_be_true_of_several_is_refused(films, refused, arguments, expected):
    """A failure means that one force recording is laid under all films, or a folder written twice."""
    Path("sub").mkdir()
    write_video(Path("sub/t0.tif"))
    assert expected in refused(*films, *arguments)


@pytest.mark.parametrize("order", [("t0.tif", "t0.txt"), ("t0.txt", "t0.tif"), ("t0.txt",)])
def test_a_force_recording_without_its_option_is_named(films, order, refused):
    """A failure means that a force recording is called a film, or a film of the same name as the first."""
    said = refused(*order)
    assert "t0.txt: expected a video; found a table" in said and "--force" in said


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_frames_that_the_shell_spread_out_are_no_films(suffix, refused):
    """A failure means that 500 images of one film become 500 run folders."""
    names = [f"{k}.{suffix}" for k in range(3)]
    for name in names:
        cv2.imwrite(name, frames_of(positions(1))[0])
    assert "quote the pattern: track" in refused(*names)
    assert run([]) == 0  # help
    assert run(["--fps", "5"]) == 2


def test_films_of_a_folder_are_preferred_to_pictures_beside_them(films, tmp_path, capsys):
    """A failure means that `track .` takes the picture of a preview for the film."""
    folder = tmp_path / "films"
    folder.mkdir()
    write_video(folder / "pull.avi", frames_of(positions(30, sheets=8)))
    cv2.imwrite(str(folder / "pull_preview.png"), np.zeros((40, 200), np.uint8))
    assert run(["films", "--fps", "20", "--no-report"]) == 0
    assert "1 film and 1 picture; the films are used" in capsys.readouterr().err
    assert pd.read_csv("pull_tracks/tracks.csv")["index"].nunique() == 8
    write_video(folder / "push.avi", frames_of(positions(30, sheets=7)))
    assert run(["preview", "films", "--fps", "20"]) == 2
    assert "expected one film; found 2; name one of them, such as pull.avi" in capsys.readouterr().err
    assert run(["films", "--fps", "20", "--no-report", "--out", "runs"]) == 0
    assert sorted(path.name for path in Path("runs").iterdir()) == ["pull_tracks", "push_tracks"]


def test_an_overlay_beside_its_run_is_no_film(films, tmp_path):
    """A failure means that `track .` tracks its own drawing. A film that is only named so is tracked."""
    write_video(tmp_path / "pull.avi", frames_of(positions(20, sheets=8)))
    write_video(tmp_path / "push_overlay.avi", frames_of(positions(24, sheets=8)))
    for film in films:
        Path(film).unlink()
    assert run(["pull.avi", "--fps", "20", "--no-report"]) == 0
    assert run(["overlay", "pull_tracks"]) == 0
    assert Path("pull_tracks_overlay.mp4").exists()
    assert run([".", "--fps", "20", "--no-report", "--out", "runs"]) == 0
    assert sorted(path.name for path in Path("runs").iterdir()) == ["pull_tracks", "push_overlay_tracks"]


def test_the_sheets_themselves_are_the_ruler(films):
    """A failure means lengths in a wrong unit: the comb's spacing is 20 px less its opening of 1 px or so."""
    assert run([films[0], "--pitch", "0.2mm", "--no-report", "--quiet"]) == 0
    facts = json.loads(Path("t0_tracks/run.json").read_text())
    true_px = np.diff(np.median(positions(30), axis=0)).mean()
    size = facts["parameters"]["pixel_size"]
    assert size["how"] == "found"
    assert size["value"] == pytest.approx(200 / true_px, rel=5e-4)  # half a pixel in 20 would be 2.5e-2
    table = pd.read_csv("t0_tracks/tracks.csv")
    assert np.allclose(table["x_um"], size["value"] * table["x_px"], rtol=1e-4)


def test_the_scale_of_the_film_is_used_and_said(capsys):
    """A failure means that a scale set in Fiji is ignored, hides one that was given, or is not shown."""
    frames = frames_of(positions(30))
    scale = {"resolution": (0.1, 0.1), "metadata": {"unit": "micron", "axes": "TYX", "finterval": 0.05}}
    tifffile.imwrite("fiji.tif", frames, imagej=True, **scale)
    assert run(["fiji.tif", "--no-report"]) == 0
    assert "scale      10 µm per px (from the film's file)" in capsys.readouterr().out
    size = json.loads(Path("fiji_tracks/run.json").read_text())["parameters"]["pixel_size"]
    assert size == {"value": pytest.approx(10.0), "how": "found"}
    table = pd.read_csv("fiji_tracks/tracks.csv")
    assert np.allclose(table["x_um"], 10 * table["x_px"], rtol=1e-4)
    assert run(["kymograph", "fiji.tif", "--sheet", "right:1", "--width", "0.2mm"]) == 0
    assert run(["fiji.tif", "--no-report", "--overwrite", "--pixel-size", "12"]) == 0
    assert "scale      12 µm per px (the film's file states 10)" in capsys.readouterr().out


def test_names_that_begin_with_a_bracket(films):
    """A failure means that the numbered films of some cameras, or a pattern of digits, are taken for JSON."""
    Path("t0.tif").rename("[1].tif")
    Path("t1.tif").rename("{2}.tif")
    assert run(["[1].tif", "{2}.tif", "--fps", "20", "--no-report", "--quiet"]) == 0
    assert Path("[1]_tracks").is_dir() and Path("{2}_tracks").is_dir()
    cv2.imwrite("a1.png", tifffile.imread("t2.tif")[0])
    cv2.imwrite("a2.png", tifffile.imread("t2.tif")[1])
    assert run(["[a-c][0-9].png", "--fps", "20", "--no-report", "--quiet", "--out", "pattern"]) == 1
    assert json.loads(Path("pattern/run.json").read_text(encoding="utf-8"))["frames"]["read"] == 2
