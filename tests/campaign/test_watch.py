"""Films that a camera writes are taken when they are complete, and not before."""

import pytest

from tests.scenes.comb_video import frames_of, positions, write_video
from vision.campaign.settings import CampaignSettings
from vision.campaign.table import Row
from vision.campaign.watch import FolderWatch
from vision.errors import InputError

TUNING = CampaignSettings(still_seconds=10.0, abandoned_seconds=600.0)


class Clock:
    """Seconds that a test sets."""

    now = 0.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


def complete(watch):
    return [film.name for film in watch.films() if watch.complete(film)]


def test_a_film_is_taken_when_it_stands_still(tmp_path, clock):
    """A failure means that half a film is analysed, or that a film is never taken."""
    watch = FolderWatch(tmp_path, TUNING, clock)
    whole = write_video(tmp_path / "whole.tif", frames_of(positions(30))).read_bytes()
    film = tmp_path / "film.tif"
    film.write_bytes(whole[:20_000])
    (tmp_path / "notes.txt").write_text("no film")
    (tmp_path / ".hidden.tif").write_bytes(whole)
    assert complete(watch) == []
    clock.now = 8.0
    film.write_bytes(whole[:40_000])  # the camera goes on
    assert complete(watch) == []
    clock.now = 11.0
    assert complete(watch) == ["whole.tif"]
    film.write_bytes(whole)
    assert complete(watch) == ["whole.tif"]
    clock.now = 30.0
    assert complete(watch) == ["film.tif", "whole.tif"]


def test_a_cut_film_is_taken_in_the_end(tmp_path, clock):
    """The camera's computer failed: nobody will finish this film, and it should be named."""
    watch = FolderWatch(tmp_path, TUNING, clock)
    content = write_video(tmp_path / "t.tif", frames_of(positions(30))).read_bytes()
    (tmp_path / "t.tif").write_bytes(content[:30_000])
    assert complete(watch) == []
    clock.now = 300.0
    assert complete(watch) == []  # it stands still, but its pages are not all there
    clock.now = 601.0
    assert complete(watch) == ["t.tif"]


def test_two_files_of_one_recording_come_together(tmp_path, clock):
    """A failure means that frames are analysed before the file that says what they are has come."""
    watch = FolderWatch(tmp_path, TUNING, clock)
    (tmp_path / "p.mraw").write_bytes(bytes(100))
    clock.now = 700.0
    assert complete(watch) == []


def test_rows_wait_for_all_their_files(tmp_path, clock):
    """A failure means that a film is analysed without the force recording that its row names."""
    watch = FolderWatch(tmp_path, TUNING, clock)
    film = write_video(tmp_path / "t.tif", frames_of(positions(30)))
    for name in ("t.tiff", "other.tif"):
        (tmp_path / name).write_bytes(film.read_bytes())
    row = Row(row=2, film=str(film), name="t", options={"force": str(tmp_path / "t.txt")})

    def new(path):
        return Row(row=0, film=str(path), name=path.stem)

    def names():
        return sorted(ready.name for ready in watch.rows([row], new))

    assert names() == []
    clock.now = 20.0
    assert names() == ["other", "t.tiff"]  # "t" is the row's
    (tmp_path / "t.txt").write_text("0 1\n")
    assert names() == ["other", "t.tiff"]
    clock.now = 40.0
    assert names() == ["other", "t", "t.tiff"]


def test_a_folder_that_is_none(tmp_path):
    """A failure means that a campaign waits for films in a folder that is not there."""
    with pytest.raises(InputError, match="no such folder"):
        FolderWatch(tmp_path / "gone")
