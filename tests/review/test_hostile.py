"""What may happen to a review from outside: foreign and broken requests, files that go, disks that fail."""

import errno
import json
import os
import shutil
import signal
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from tests.scenes.reviewed import PLANTED, SETTINGS, VIDEO, remedies
from tests.scenes.served import Served, Started, app_of, page_of
from vision.errors import InputError
from vision.review.session import Session
from vision.run.reading import read_run
from vision.sheets.corrections import read_decisions

pytestmark = pytest.mark.thorough
PROJECT = Path(__file__).parents[2]
LEFT_OUT = {"kind": "leave_out", "sheet": 5, "frames": "0:10"}


# --- requests -----------------------------------------------------------------------------------------------


def test_requests_by_hand(session):
    """What a browser would not send: foreign hosts in every form, and paths that no library has tidied."""
    with Served(session) as server:
        own, token = f"127.0.0.1:{server.port}", f"X-Token: {server.token}\r\n"

        def status(path="/api/run", host=own, more=""):
            said = server.raw(
                f"GET {path} HTTP/1.1\r\nHost: {host}\r\n{token}{more}Connection: close\r\n\r\n"
            )
            return int(said.split()[1])

        assert status() == 200
        evil = f"evil.example:{server.port}"
        assert status(host=evil) == 403
        assert status(host=f"127.0.0.1.evil.example:{server.port}") == 403
        assert status(more=f"Host: evil.example:{server.port}\r\n") in (400, 403)
        assert status(f"http://evil.example:{server.port}/api/run", host=f"evil.example:{server.port}") in (
            400,
            403,
        )
        assert status(more="Origin: http://evil.example\r\n") == 403
        for path in (
            "/page/..%2f..%2fserver.py",
            "/page/%2e%2e%2fserver.py",
            "/page/..\\server.py",
            "/../run.json",
        ):
            assert status(path) in (400, 403, 404)
        assert server.raw("GET / HTTP/9.9\r\n\r\n").split()[1] in ("400", "403", "505")


def test_half_requests_do_not_keep_others_waiting(session):
    """Slow-loris: connections that never finish what they ask."""
    with Served(session) as server:
        head = f"POST /api/preview HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\nX-Token: {server.token}\r\n"
        lines = [server.connected(head) for _ in range(100)]
        lines += [server.connected(f"{head}Content-Length: 900\r\n\r\n{{") for _ in range(100)]
        assert server.ask("/api/state")[0] == 200
        for line in lines:
            line.close()


def test_many_requests_at_once(session):
    """A failure means that a quick hand breaks the review."""
    names = ("run", "tracks", "kymograph/0/0/0.png", "frame/3.png", "ridges/7", "stick/70")
    with Served(session) as server, ThreadPoolExecutor(24) as pool:
        answers = list(pool.map(lambda k: server.ask(f"/api/{names[k % len(names)]}")[0], range(120)))
        assert set(answers) == {200}


def test_of_decisions_made_at_once_each_counts_or_is_refused(session):
    """A failure means that one of two windows overwrites the other's decision."""
    with Served(session) as server, ThreadPoolExecutor(8) as pool:
        before = len(session.decisions)
        seen = session.revision

        def decide(k):
            entry = LEFT_OUT | {"sheet": k}
            return server.ask("/api/decisions", {"decision": entry, "revision": seen})[0]

        answers = list(pool.map(decide, range(16)))
        assert sorted(answers) == [200] + [409] * 15
        assert len(session.decisions) == before + 1


# --- files --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("happens", ["deleted", "replaced"])
def test_a_run_that_goes_is_not_written_to(session, planted, happens):
    """A failure means that decisions about one run are kept with another, or in a folder made of nothing."""
    session.decide(LEFT_OUT)
    shutil.rmtree(session.folder)
    if happens == "replaced":
        shutil.copytree(planted, session.folder)
        (session.folder / "run.json").touch()  # else only where the disk puts it tells
    for work in (lambda: session.decide(remedies()[0]), session.undo, session.save):
        with pytest.raises(InputError, match="the run that is reviewed"):
            work()
    with pytest.raises(InputError, match="the run that is reviewed"):
        session.trial.start({"kind": "strip", "rows": "10:14"})
    assert session.folder.exists() == (happens == "replaced")
    assert len(session.decisions) == len(PLANTED) + 1
    assert len(session.curves(0, 240, 1000)) == 240  # it can still be looked at


@pytest.mark.parametrize("code", [errno.EROFS, errno.EACCES, errno.ENOSPC])
def test_a_folder_that_cannot_be_written_keeps_nothing(session, monkeypatch, code):
    """A failure means that a page shows a decision that no file holds."""

    def refused(*args, **kwargs):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(Path, "mkdir", refused)
    text = (session.folder / "corrections.toml").read_bytes()
    found = "a full disk" if code == errno.ENOSPC else os.strerror(code).lower()
    for work in (lambda: session.decide(LEFT_OUT), session.undo):
        with pytest.raises(InputError, match=found):
            work()
    assert (session.folder / "corrections.toml").read_bytes() == text
    assert len(session.decisions) == len(PLANTED)


@pytest.mark.posix
def test_a_run_on_a_file_server_without_locks_is_reviewed(run, monkeypatch):
    """A failure means that such a run is said to be under review already, for ever."""

    def none(*_):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr("vision.locks.fcntl.flock", none)
    with Session(run, SETTINGS) as session:
        session.decide(LEFT_OUT)
    assert read_decisions(run / "corrections.toml").corrections


def test_a_disk_that_is_full_while_saving_leaves_the_run(session):
    """A failure means that half a run takes the place of a whole one, or that the decision is gone."""
    resource = pytest.importorskip("resource")
    before = {path.name: path.read_bytes() for path in session.folder.iterdir()}
    session.decide(LEFT_OUT)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, hard))  # less than the diagram has
    try:
        session.save()
        session.saver.wait()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert "a place that can be written" in session.saver.error
    after = {path.name: path.read_bytes() for path in session.folder.iterdir()}
    text = after.pop("corrections.toml")
    assert b"sheet = 5" in text
    assert {name: before[name] for name in after} == after
    assert [path.name for path in session.folder.parent.iterdir() if path.suffix == ".part"] == []


def test_nothing_beside_the_data_is_executed(session, tmp_path, monkeypatch):
    """A failure means that a pickle.py in the working directory runs when decisions are saved."""
    (tmp_path / "pickle.py").write_text("open('executed', 'w').close()")
    monkeypatch.chdir(tmp_path)
    session.undo()
    session.save()
    session.saver.wait()
    assert session.saver.error == ""
    assert not (tmp_path / "executed").exists()


@pytest.mark.posix
def test_a_film_that_is_moved_away_meanwhile(run, tmp_path):
    """A failure means that the review ends with the film, or that it says nothing."""
    film = shutil.copy(VIDEO, tmp_path / "moved.avi")
    with Session(run, SETTINGS, film=film) as session:
        page = page_of(app_of(session))
        assert page.get("/api/frame/3.png").status_code == 200
        film.unlink()
        assert page.get("/api/frame/200.png").status_code in (200, 422)
        assert page.post("/api/decisions", json={"decision": LEFT_OUT}).status_code == 200
        assert (
            page.post("/api/retrack", json={"decision": {"kind": "strip", "rows": "10:14"}}).status_code
            == 200
        )
        session.saver.wait()
        told = page.get("/api/retrack").json()
        assert told["found"] is None
        assert "film" in told["error"]


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no such signal here")
@pytest.mark.parametrize("saving", [False, True])
def test_a_server_that_is_killed_loses_nothing_that_it_confirmed(run, saving):
    """As a user starts it: decisions that a page showed as kept are there, whatever it was doing."""
    with Started(run) as server:
        confirmed = 0
        while confirmed < 5:
            entry = LEFT_OUT | {"sheet": confirmed, "frames": f"{confirmed}:{confirmed + 1}"}
            assert server.ask("/api/decisions", {"decision": entry})[0] == 200
            confirmed += 1
        if saving:
            server.ask("/api/save", {})
            while server.ask("/api/save")[1]["stage"] == "starting":
                time.sleep(0.02)
        else:
            entry = json.dumps({"decision": LEFT_OUT | {"sheet": 9}})
            head = f"POST /api/decisions HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\nX-Token: {server.token}"
            line = server.connected(f"{head}\r\nContent-Length: {len(entry)}\r\n\r\n{entry}")
            line.close()  # its answer is not waited for
        server.kill()
    kept = read_decisions(run / "corrections.toml").corrections
    assert len(kept) >= confirmed + len(PLANTED)
    with Session(run, SETTINGS) as again:
        assert len(again.decisions) == len(kept)
        assert read_run(run).tracks.sizes["sheet"] == again.positions.sheets
