"""`track preview`: what would be measured, from a few frames of a film with a known comb."""

import re
from pathlib import Path

import numpy as np
import pytest

from tests.scenes.comb_video import frames_of, positions, write_video
from vision.command.main import run
from vision.command.options import VideoOptions
from vision.command.settings import merged, settings_of
from vision.command.views import make_preview
from vision.figures import preview_figure
from vision.video.reader import MappedReader

FRAMES = 400


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    return write_video(tmp_path_factory.mktemp("film") / "comb.tif", frames_of(positions(FRAMES)))


@pytest.fixture(scope="module")
def found(film):
    return make_preview(film, settings_of(merged(VideoOptions())))[1]


def test_sheets_positions_and_noise_are_the_scene_s(found):
    """Failure: the preview promises other sheets or another noise than the film has."""
    x = found.tracks["x_px"].values
    error = x - positions(FRAMES)[: len(x)]
    assert x.shape == (24, 8)
    assert np.abs(error).max() < 0.1
    scatter = np.std(error - error.mean(axis=0))
    stated = np.median(found.tracks["x_err_px"].values)
    assert stated == pytest.approx(scatter, rel=0.2)


def test_some_tens_of_frames_are_read(film, monkeypatch):
    """Failure: a film of an hour is read whole before anything is shown."""
    read, block = [], MappedReader._block

    def counted(self, first, last, rows, columns):
        read.append(last - first)
        return block(self, first, last, rows, columns)

    monkeypatch.setattr(MappedReader, "_block", counted)
    make_preview(film, settings_of(merged(VideoOptions())))
    assert sum(read) < 100


def test_ten_lines_and_a_picture(film, refused, capsys):
    """Failure: the summary is longer, lacks the noise, or the picture is not where it is said to be."""
    assert run(["preview", str(film), "--fps", "20", "--pixel-size", "10"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 11
    assert "400 frames of" in lines[0]
    assert "8 bright ridges (4 left, 4 right)" in lines[1]
    px, um = map(float, re.search(r"noise +([\d.]+) px = ([\d.]+) µm", lines[3]).groups())
    assert um == pytest.approx(10 * px, rel=0.01)
    assert Path("comb_preview.png").stat().st_size > 10_000
    assert run(["preview", str(film), "--quiet"]) == 0  # its own picture is made anew
    assert "one that exists" in refused("preview", str(film), "--out", "comb_preview.png")


def test_the_picture_shows_the_measured_numbers(found):
    """Failure: the picture shows other positions or another noise than the lines say."""
    frame, profile, noise = preview_figure(found.frame, found.strip, found.tracks, pixel_size_um=10).panels
    assert np.allclose(profile.series[1].x, positions(FRAMES)[0], atol=0.1)
    assert np.array_equal(profile.series[0].y, found.strip.values[0])
    assert "µm" in noise.y_label
    assert np.allclose(noise.series[1].y, 10 * np.median(found.tracks["x_err_px"].values, axis=0))
    assert frame.image is not None


def test_without_an_axis_sheets_are_numbered_from_the_left():
    """In its first frames the film moves so little that its axis may be anywhere in most of the comb. A
    failure means a picture with an axis that is only the middle of the comb, and sheets numbered from it."""
    film = Path(__file__).parents[2] / "fixtures" / "paper" / "video.avi"
    _, found = make_preview(film, settings_of(merged(VideoOptions())))
    frame = preview_figure(found.frame, found.strip, found.tracks).panels[0]
    assert frame.x_lines == ()
    (strokes,) = frame.series
    assert strokes.text == tuple(str(k) for k in range(50))
    assert "index from the left (axis not known)" in frame.title
    _, told = make_preview(film, settings_of(merged(VideoOptions(axis=959.5))))
    frame = preview_figure(told.frame, told.strip, told.tracks).panels[0]
    assert frame.x_lines == (959.5,)
    assert [series.text[0] for series in frame.series] == ["25", "1"]
    assert "sheet numbers n" in frame.title


def test_a_film_without_ridges_is_refused_in_one_line(tmp_path, refused):
    """Failure: a film of nothing ends in a traceback, or in a picture."""
    write_video(tmp_path / "flat.tif", np.full((5, 20, 60), 90, np.uint8))
    refused("preview", "flat.tif")


def test_warnings_about_light_and_strip_are_told(tmp_path, capsys):
    """Failure: ten lines that look well, of an overexposed film, or of level bands."""
    frames = frames_of(positions(60))
    light = write_video(tmp_path / "light.tif", np.minimum(frames.astype(float) * 3, 255).astype(np.uint8))
    bands = 80 + 60 * np.sin(np.arange(80) / 2)[:, None] + frames[:, :1] / 2
    level = write_video(tmp_path / "level.tif", bands.clip(0, 255).astype(np.uint8))
    assert run(["preview", str(light), "--fps", "20", "--out", str(tmp_path / "light.png")]) == 1
    assert "overexposed" in capsys.readouterr().err
    assert run(["preview", str(level), "--fps", "20", "--out", str(tmp_path / "level.png")]) == 1
    assert "--rotate 90" in capsys.readouterr().err


def test_frames_without_a_picture_are_told_whatever_the_film_is_called(tmp_path, capsys):
    """Failure: a warning about a frame is left out because a word of it is in the film's name."""
    frames = frames_of(positions(60))
    frames[5] = 0
    film = write_video(tmp_path / "missing.tif", frames)
    assert run(["preview", str(film), "--fps", "20", "--out", str(tmp_path / "blank.png")]) == 1
    assert "1 frame blank" in capsys.readouterr().err
