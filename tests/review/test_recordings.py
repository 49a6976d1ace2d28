"""What a review shows of a run's recordings: the diagram's tiles and single frames of the film."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tifffile

from vision.errors import InputError
from vision.pipeline import Settings
from vision.review import recordings
from vision.review.recordings import TILE_ROWS, Diagram, Film, Recordings, Tiles
from vision.sheets import TrackingSettings
from vision.video import open_video, strip_profile

FRAMES, COLUMNS = 5000, 700


@pytest.fixture(scope="module")
def values():
    """A bright ridge at column 300; in frame 3210 alone it stands at 340; frames 100 to 199 are missing."""
    picture = np.random.default_rng(0).normal(40, 1, (FRAMES, COLUMNS)).astype(np.float32)
    picture[:, 298:303] += 60
    picture[3210, 298:303] -= 60
    picture[3210, 338:343] += 60
    picture[100:200] = np.nan
    return picture


@pytest.fixture
def make(tmp_path):
    """Tiles of a diagram that is written first."""
    opened = []

    def made(values, bright=True):
        path = tmp_path / f"{len(opened)}.tif"
        tifffile.imwrite(path, values)
        opened.append(Diagram(path, 0, TrackingSettings()))
        return Tiles(opened[-1], bright=bright)

    yield made
    for diagram in opened:
        diagram.close()


@pytest.fixture
def tiles(values, make):
    return make(values)


def test_level_0_is_the_recording(values, tiles):
    """A failure means that grey levels or columns of the diagram are not those recorded."""
    shown = tiles.part(0, 0, 2)
    wanted = np.clip(np.rint(255 * (values[512:768, :512] - tiles.low) / (tiles.high - tiles.low)), 0, 255)
    np.testing.assert_array_equal(shown, wanted.astype(np.uint8))


@pytest.mark.parametrize("level", [1, 2, 3])
def test_a_ridge_that_was_elsewhere_for_one_frame_is_seen_at_every_level(tiles, level):
    """A failure means that a look at the whole test does not show what went wrong in it. Means would not."""
    step = 4**level
    y, row = divmod(3210 // step, TILE_ROWS)
    shown = tiles.part(level, 0, y).astype(int)
    assert shown[row, 340] > 200
    assert shown[row - 1, 340] < 100
    assert shown[row, 300] > 200  # and where it usually is


def test_dark_ridges_keep_their_smallest_values(values, make):
    """A failure means that what happened to dark sheets for one frame is lost from afar."""
    tiles = make(80 - values, bright=False)
    shown = tiles.part(2, 0, 0).astype(int)
    assert shown[3210 // 16, 340] < 50
    assert shown[3210 // 16 - 1, 340] > 150


def test_frames_that_are_missing_are_grey_and_hide_no_others(tiles):
    """A failure means that lost frames look like dark ones, or cover those beside them."""
    assert np.isin(tiles.part(0, 0, 0)[120:150], (127, 128)).all()
    assert np.isin(tiles.part(1, 0, 0)[26:49], (127, 128)).all()
    assert (tiles.part(1, 0, 0)[24, 290:296] < 100).all()  # frames 96 to 99 are there


def test_the_last_level_is_one_tile_high_and_edges_are_smaller(tiles):
    """A failure means that the page asks for tiles that do not exist, or stretches the last."""
    last = tiles.levels - 1
    rows = -(-FRAMES // 4**last)
    assert rows <= TILE_ROWS < -(-FRAMES // 4 ** (last - 1))
    assert tiles.part(last, 0, 0).shape == (rows, 512)
    assert tiles.part(last, 1, 0).shape == (rows, COLUMNS - 512)
    assert tiles.part(0, 1, FRAMES // 256).shape == (FRAMES % 256, COLUMNS - 512)


def test_made_from_the_file_or_kept_in_memory_a_level_is_the_same(values, make, monkeypatch):
    """A failure means that a long film is shown otherwise than a short one."""
    shown = []
    for kept in (1, 3):
        monkeypatch.setattr(recordings, "FIRST_KEPT", kept)
        tiles = make(values)
        shown.append([tiles.part(level, 0, 0) for level in (1, 2)])
    for one, other in zip(*shown, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("place", [(-1, 0, 0), (9, 0, 0), (0, 2, 0), (0, 0, 20), (0, -1, 0), (0, 0, -1)])
def test_a_tile_that_is_not_there_is_refused(tiles, place):
    """A failure means a picture of another place, or a traceback."""
    with pytest.raises(InputError, match="levels"):
        tiles.part(*place)


def test_a_short_film_has_one_level(values, make):
    """A failure means that a short film has no diagram."""
    tiles = make(values[:50])
    assert tiles.levels == 1
    assert tiles.part(0, 0, 0).shape == (50, 512)


def test_a_diagram_that_was_cut_short_is_named(values, make):
    """A failure means that a damaged file is shown as a recording."""
    tiles = make(values[:1000])
    with tiles.diagram.path.open("r+b") as file:
        file.truncate(2_000_000)
    with pytest.raises(InputError, match="cut short"):
        tiles.diagram.rows(900, 1000)


# --- film ---------------------------------------------------------------------------------------------------


FIXTURES = Path(__file__).parents[2] / "fixtures"


@pytest.mark.parametrize("name", ["paper/video.avi", "hostile/video.mkv", "dark/video.mp4", "deep/video.tif"])
def test_the_frame_asked_for_is_shown(name):
    """MJPEG, FFV1 with lost frames, H.264, TIFF. A failure means that a frame beside it is looked at."""
    video = open_video(FIXTURES / name)
    strip = strip_profile(video, slice(2, 20))
    film = Film(video)
    known = np.flatnonzero(np.isfinite(strip.values[:, 0]))
    order = [*known[10:16], *np.random.default_rng(0).permutation(known)[:12]]
    off = []
    for row in order:
        picture = film.picture(int(strip["frame"].values[row]), float(strip["time_s"].values[row]))
        away = np.abs(strip.values[known] - picture[2:20].mean(axis=0)).mean(axis=1)
        off.append(known[away.argmin()] - row)
        assert away.min() < 0.3 * np.sort(away)[1] or away.min() < 1e-3
    assert off == [0] * len(order)


def test_a_turned_film_is_turned():
    """A failure means that a turned film is shown lying beside its upright tracks."""
    film = Film(open_video(FIXTURES / "dark/video.mp4", rotate=90))
    still = Film(open_video(FIXTURES / "dark/video.mp4"))
    np.testing.assert_array_equal(film.picture(7, np.nan), np.rot90(still.picture(7, np.nan), k=-1))


@pytest.mark.parametrize("name", ["dark/video.mp4", "paper/video.avi"])
def test_a_frame_behind_the_end_is_none(name):
    """A failure means that the last frame is shown for frames that the film does not have."""
    film = Film(open_video(FIXTURES / name))
    assert film.picture(100_000, np.nan) is None


def test_a_film_that_cannot_be_opened_is_tried_once():
    """A disk that does not answer takes seconds; each picture of the page would wait for it again."""
    tried = []

    class Stored:
        def input(self, *of):
            tried.append(of)
            raise InputError("film.avi", "a disk that answers", "nothing for 10 s")

    recordings = Recordings(Stored(), Settings(), None)
    for _ in range(2):
        with pytest.raises(InputError, match=r"nothing for 10 s"):
            recordings.film()
    assert len(tried) == 1
