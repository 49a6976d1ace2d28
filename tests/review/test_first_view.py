"""What is kept for the first view of a run: as the run says, and not used once it says something else."""

import json
import shutil

import pytest
from starlette.testclient import TestClient

from tests.scenes.reviewed import FIXTURE, SETTINGS, remedies
from tests.scenes.served import app_of
from vision.command.commands import track
from vision.command.options import RunOptions, VideoOptions
from vision.command.settings import settings_of_run
from vision.review.api import first_answers, keep_first_view
from vision.review.first_view import NAME, read_first_view
from vision.review.session import Session

PORT, TOKEN = 54321, "a-token-of-this-test"


@pytest.fixture
def kept(run):
    """A run folder with its first view."""
    with Session(run, SETTINGS) as session:
        keep_first_view(session)
    return run


def test_kept_answers_are_those_of_the_run(kept):
    """A failure means that a review begins with pictures or numbers of something else."""
    answers = read_first_view(kept)
    assert {"/api/run", "/api/times", "/api/frame/0.png", "/api/force?points=4096"} <= set(answers)
    with Session(kept, SETTINGS) as session:
        client = TestClient(app_of(session, port=PORT, token=TOKEN), base_url=f"http://127.0.0.1:{PORT}")
        for question, content in answers.items():
            assert client.get(question, headers={"X-Token": TOKEN}).content == content, question


def test_a_copied_run_keeps_its_first_view(kept, tmp_path):
    """A failure means that a run from another disk, with newer times of its files, opens slowly."""
    assert read_first_view(shutil.copytree(kept, tmp_path / "copy", copy_function=shutil.copy))


def test_a_run_with_decisions_begins_with_them(kept):
    """A failure means that a decision seems lost when the review is opened again."""
    with Session(kept, SETTINGS) as session:
        session.decide(remedies()[0])
        assert read_first_view(kept) == {}
        keep_first_view(session)
        decided = len(session.decisions)
    told = json.loads(read_first_view(kept)["/api/run"])
    assert (len(told["decisions"]), told["revision"]) == (decided, 0)
    with Session(kept, SETTINGS) as session:
        assert session.revision == 0


def changed(run):
    (run / "run.json").write_bytes((run / "run.json").read_bytes() + b" ")


def other_tracks(run):
    (run / "tracks.nc").write_bytes((run / "tracks.nc").read_bytes()[:-1])


def cut_short(run):
    (run / NAME).write_bytes((run / NAME).read_bytes()[:-300])


def flipped(run):
    content = bytearray((run / NAME).read_bytes())
    content[len(content) // 2] ^= 1
    (run / NAME).write_bytes(content)


def emptied(run):
    (run / NAME).write_bytes(b"")


@pytest.mark.parametrize("harm", [changed, other_tracks, cut_short, flipped, emptied])
def test_of_another_run_or_damaged_it_is_not_used(kept, harm):
    """A failure means that a review shows what is no longer true."""
    harm(kept)
    assert read_first_view(kept) == {}


def test_of_a_film_that_has_gone_since_it_is_not_used(run, tmp_path):
    """A failure means that a film is shown that is not there."""
    film = shutil.copy(FIXTURE / "video.avi", tmp_path / "video.avi")
    with Session(run, SETTINGS, film=film) as session:
        keep_first_view(session)
    assert "/api/frame/0.png" in read_first_view(run, film)
    assert read_first_view(run) == {}
    film.unlink()
    assert read_first_view(run, film) == {}


def test_of_a_long_film_it_is_kept_with_the_run(monkeypatch, tmp_path):
    """A failure means that the first review of a long film waits until all of it has been read."""
    monkeypatch.setattr("vision.command.track.LONG_FRAMES", 30)
    run = tmp_path / "run"
    options = RunOptions(out=run, report=False, quiet=True)
    track(FIXTURE / "video.avi", reading=VideoOptions(frames="0:40"), run=options)
    kept = read_first_view(run)
    with Session(run, settings_of_run(run)) as session:
        assert first_answers(session) == kept
