"""Single frames in any order are the frames that were asked for."""

from pathlib import Path

import numpy as np
import pytest

from vision.review.film import Film
from vision.video import open_video, strip_profile

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
