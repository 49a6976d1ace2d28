"""The HTTP interface: who is refused, and that a page gets what it asks for."""

from __future__ import annotations

import json
import re
import shutil
from concurrent.futures import ThreadPoolExecutor
from queue import Queue
from threading import Event, Thread

import numpy as np
import pytest
from starlette.testclient import TestClient

from tests.scenes.reviewed import FIXTURE, SETTINGS, remedies, truth
from tests.scenes.served import HERE, PATIENCE_S, PORT, TOKEN, Address, Served, app_of, page_of
from vision.command.main import track
from vision.command.options import RunOptions, VideoOptions
from vision.command.settings import settings_of_run
from vision.errors import InputError
from vision.review.api import first_answers, keep_first_view
from vision.review.server import FIRST_VIEW, MOST_BODY_BYTES, read_first_view, serve
from vision.review.session import Session


@pytest.fixture
def own_page(session):
    """A page that may decide."""
    return page_of(app_of(session))


@pytest.fixture(scope="module")
def app(watched):
    """What most tests ask, none of which may change anything."""
    return app_of(watched)


@pytest.fixture
def page(app):
    """A page that only looks."""
    return page_of(app)


@pytest.fixture
def stranger(app):
    return TestClient(app, base_url=HERE)


def shape_of(png):
    """(rows, columns) as a PNG's header says."""
    assert png[:8] == b"\x89PNG\r\n\x1a\n"
    return int.from_bytes(png[20:24]), int.from_bytes(png[16:20])


# --- who is refused -----------------------------------------------------------------------------------------

EVERYTHING = [
    "/",
    "/api/run",
    "/api/frame/3.png",
    "/api/kymograph/0/0/0.png",
    "/api/tracks",
    "/page/review.js",
]


@pytest.mark.parametrize("path", EVERYTHING)
@pytest.mark.parametrize("headers", [{}, {"X-Token": ""}, {"X-Token": "another"}, {"X-Token": TOKEN + "x"}])
def test_without_the_token_nothing_is_told(stranger, path, headers):
    """A failure means that any program or page of this machine reads the run."""
    answer = stranger.get(path, headers=headers)
    assert answer.status_code == 403
    assert TOKEN not in answer.text
    assert "run" not in answer.headers.get("set-cookie", "")


def test_without_the_token_nothing_is_changed(stranger, watched):
    """A failure means that any page of this machine can decide about the run."""
    for path in ("/api/decisions", "/api/undo", "/api/save", "/api/quit"):
        assert stranger.post(path, json={"decision": remedies()[0]}).status_code == 403
    assert watched.revision == len(watched.decisions) - len(watched.applied) == 0


@pytest.mark.parametrize(
    "host",
    [
        "evil.example",
        f"evil.example:{PORT}",
        "127.0.0.1",
        "127.0.0.1:1",
        f"127.0.0.1.evil.example:{PORT}",
        "",
    ],
)
def test_a_foreign_host_is_refused_even_with_the_token(page, host):
    """DNS rebinding: a foreign name that resolves to this machine lets a foreign page read the answers."""
    assert page.get("/api/run", headers={"Host": host}).status_code == 403


@pytest.mark.parametrize(
    "host", [f"127.0.0.1:{PORT}", f"localhost:{PORT}", f"[::1]:{PORT}", f"LOCALHOST:{PORT}"]
)
def test_every_name_of_the_loopback_address_is_served(page, host):
    """A failure means that the page does not open under a name that browsers use."""
    assert page.get("/api/state", headers={"Host": host}).status_code == 200


@pytest.mark.parametrize(
    "origin", ["https://evil.example", "null", f"http://127.0.0.1:{PORT + 1}", "http://localhost"]
)
def test_a_foreign_page_cannot_decide(page, watched, origin):
    """A failure means that a page from elsewhere changes the run of who visits it."""
    answer = page.post("/api/decisions", json={"decision": remedies()[0]}, headers={"Origin": origin})
    assert answer.status_code == 403
    assert not watched.pending


def test_the_own_page_can(own_page):
    """A failure means that the test above would pass with a server that refuses everybody."""
    answer = own_page.post("/api/decisions", json={"decision": remedies()[0]}, headers={"Origin": HERE})
    assert answer.status_code == 200


@pytest.mark.parametrize(
    "path",
    [
        "/page/../server.py",
        "/page/%2e%2e/server.py",
        "/page/..%2fserver.py",
        "/page//etc/passwd",
        "/page/%2fetc%2fpasswd",
        "/api/frame/../../run.json",
        "/run.json",
        "/api/kymograph/0/0/../../run.json",
    ],
)
def test_no_path_leads_out(page, path):
    """A failure means that files of this machine can be read."""
    answer = page.get(path)
    assert answer.status_code in (403, 404)
    assert "import" not in answer.text
    assert "root:" not in answer.text


@pytest.mark.parametrize("path", ["/api/decisions", "/api/preview", "/api/strip"])
def test_a_large_body_is_refused(page, path):
    """A failure means that one request takes the memory of the machine."""
    assert page.post(path, content=b"x" * (MOST_BODY_BYTES + 1)).status_code == 413


def test_a_large_body_of_no_stated_length_is_refused(page):
    """A failure means that memory can be filled from a page."""

    def parts():
        for _ in range(30):
            yield b"x" * 50_000

    assert page.post("/api/preview", content=parts()).status_code == 413


@pytest.mark.parametrize("body", [b"{", b"[1]", b"\xff\xfe", b"[" * 100_000, b'{"decision": 3}', b"{}"])
def test_a_body_that_is_no_request_is_refused(page, body):
    """A failure means a traceback, or half a decision, for what is no request."""
    answer = page.post("/api/decisions", content=body)
    assert answer.status_code == 400
    assert "\n" not in answer.json()["error"]


def test_every_answer_forbids_what_is_not_its_own(page, stranger):
    """A failure means that a script hidden in a run's text could load or send something."""
    for answer in (page.get("/"), page.get("/api/run"), page.get("/nothing"), stranger.get("/")):
        policy = answer.headers["content-security-policy"]
        assert policy.startswith("default-src 'none'; script-src 'self';")
        assert "unsafe" not in policy
        assert "http" not in policy
        assert answer.headers["cache-control"] == "no-store"
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert answer.headers["x-frame-options"] == "DENY"
        assert answer.headers["referrer-policy"] == "no-referrer"


def test_the_page_needs_nothing_inline_and_nothing_from_elsewhere(page):
    """A failure means that the policy breaks the page, or that it loads something from the network."""
    html = page.get("/").text
    assert "<style" not in html
    assert not re.search(r"<script(?![^>]*\bsrc=)", html)
    assert not re.search(r"""\s(?:style|on[a-z]+)=["']""", html)
    names = set(re.findall(r"""(?:src|href)=["']([^"'#]+)["']""", html))
    assert names
    for name in names:
        assert name.lstrip("/").startswith("page/")
        assert page.get(f"/{name.lstrip('/')}").status_code == 200


def test_the_token_becomes_a_cookie_that_no_other_site_sends(app):
    """A failure means that pictures do not load, or that another site's requests carry the token."""
    browser = TestClient(app, base_url=HERE)
    opened = browser.get("/", params={"token": TOKEN})
    assert opened.status_code == 200
    cookie = opened.headers["set-cookie"].lower()
    assert "httponly" in cookie
    assert "samesite=strict" in cookie
    assert browser.get("/api/state").status_code == 200  # an image, say, that carries the cookie alone


def test_two_windows_know_of_each_other(own_page):
    """A failure means that two people undo each other's decisions unawares."""
    assert own_page.get("/api/run").json()["other_windows"] == 0
    second = own_page.get("/api/run", headers={"X-Window": "two"}).json()
    assert second["other_windows"] == 1
    assert own_page.get("/api/state").json()["other_windows"] == 1
    seen = second["revision"]
    assert (
        own_page.post("/api/decisions", json={"decision": remedies()[0], "revision": seen}).status_code == 200
    )
    late = own_page.post("/api/decisions", json={"decision": remedies()[0], "revision": seen})
    assert late.status_code == 409
    assert "another window" in late.json()["error"]


# --- what a page gets ---------------------------------------------------------------------------------------


def test_the_run_at_a_glance(page):
    """A failure means that the page opens with other numbers than the run's."""
    facts = page.get("/api/run").json()
    assert facts["frames"] == 240
    assert facts["columns"] == 1200
    assert len(facts["sheets"]) == 49
    assert facts["clock"]["offset_s"] == 23.0
    assert {"first", "stop", "event", "stick_length_um"} <= set(facts["sticks"][0])
    assert facts["decisions"][0]["saved"]
    assert "swapped" in facts["decisions"][0]["text"]


def test_curves_are_the_positions(page):
    """A failure means that sheets are drawn where they are not."""
    answer = page.get("/api/tracks", params={"first": 10, "stop": 60, "points": 1000})
    table = np.frombuffer(answer.content, "<f4").reshape(
        int(answer.headers["X-Rows"]), int(answer.headers["X-Columns"])
    )
    assert table[:, 0].tolist() == list(range(10, 60))
    np.testing.assert_allclose(table[:, 1], truth()["x_px"].values[10:60, 0], atol=0.5)
    assert np.isnan(table[40:, 8]).all()  # the planted gap of sheet 7


def test_few_points_keep_every_jump(page):
    """Means would hide a slip of one frame; extremes do not."""
    whole, few = (
        np.frombuffer(page.get("/api/tracks", params={"points": points}).content, "<f4").reshape(-1, 50)
        for points in (1000, 20)
    )
    assert len(few) <= 20 < len(whole)
    np.testing.assert_array_equal(np.nanmax(few[:, 1:], axis=0), np.nanmax(whole[:, 1:], axis=0))
    np.testing.assert_array_equal(np.nanmin(few[:, 1:], axis=0), np.nanmin(whole[:, 1:], axis=0))


def test_pictures(page):
    """A failure means that frames or the diagram are of another size than the curves over them."""
    assert shape_of(page.get("/api/frame/17.png").content) == (30, 1200)
    tiles = page.get("/api/run").json()["tiles"]
    assert shape_of(page.get("/api/kymograph/0/0/0.png").content) == (240, tiles["columns"])
    assert shape_of(page.get("/api/kymograph/0/2/0.png").content)[1] == 1200 - 2 * tiles["columns"]
    assert page.get("/api/kymograph/0/3/0.png").status_code == 422
    assert page.get("/api/kymograph/9/0/0.png").status_code == 422
    assert page.get("/api/frame/9999.png").status_code == 422


def test_candidates_of_a_frame_name_their_sheets(page):
    """A failure means that a person is offered a ridge that belongs to another sheet."""
    found = page.get("/api/ridges/55").json()
    x_px = truth()["x_px"].values[55]
    by_sheet = {one["sheet"]: one["x_px"] for one in found["candidates"] if one["sheet"] is not None}
    assert abs(by_sheet[0] - x_px[0]) < 1
    assert 7 not in by_sheet  # left out here
    free = [one["x_px"] for one in found["candidates"] if one["sheet"] is None]
    assert min(abs(place - x_px[7]) for place in free) < 1
    assert found["sheets"][7]["flag"] == "left_out"


def test_the_force(page):
    """A failure means that the force is drawn at another time, or in another unit."""
    answer = page.get("/api/force", params={"first_s": 25.0, "stop_s": 26.0, "points": 500})
    table = np.frombuffer(answer.content, "<f8").reshape(-1, 3)
    assert 25.0 <= table[:, 0].min() < table[:, 0].max() < 26.0
    assert 1 < np.nanmean(table[:, 1]) < 1e4
    assert page.get("/api/force", params={"first_s": "soon"}).status_code == 400


def test_another_clock_moves_the_sticks_and_keeps_nothing(page):
    """A failure means that trying out a clock changes the run, or shows sticks elsewhere."""
    before = page.get("/api/run").json()
    seen = page.post("/api/clock", json={"offset_s": 24.0}).json()
    true = truth()["t_p_video_s"].values * 60
    inside = [stick["stop"] for stick in seen["sticks"] if 5 < stick["stop"] < 235]
    assert max(min(abs(stop - true)) for stop in inside) < 2.5
    assert max(min(abs(stick["stop"] - true)) for stick in before["sticks"]) > 5  # the planted clock is wrong
    assert page.get("/api/run").json()["sticks"] == before["sticks"]


def test_preview_decide_undo_redo(own_page):
    """A failure means that the page's buttons do something else than they say."""
    decision = remedies()[0]
    seen = own_page.post("/api/preview", json={"decision": decision, "frame": 120}).json()
    assert seen["frames"][0] <= 120 <= seen["frames"][-1]
    assert own_page.get("/api/state").json()["revision"] == 0
    state = own_page.post("/api/decisions", json={"decision": decision}).json()
    assert state["can_undo"]
    assert state["decisions"][-1]["entry"]["frames"] == "100:"
    state = own_page.post("/api/undo", json={}).json()
    assert state["can_redo"]
    assert not state["changed"]
    assert own_page.post("/api/redo").json()["changed"]


def test_the_stick_is_measured_anew_while_decisions_wait(own_page):
    """A failure means that the deformation shown is that before the decisions."""
    own_page.post("/api/decisions", json={"decision": remedies()[-1]})
    sticks = own_page.get("/api/run").json()["sticks"]
    event = sticks[len(sticks) // 2]["event"]
    found = own_page.get(f"/api/stick/{event}").json()
    assert len(found["sheets"]) == 49
    assert own_page.get("/api/stick/99999").json()["sheets"] == []


def test_a_film_that_is_gone_costs_only_its_pictures(run, tmp_path):
    """A failure means that a run cannot be looked at without its film."""
    film = tmp_path / "another.avi"
    film.write_bytes((FIXTURE / "video.avi").read_bytes()[:-1])
    with Session(run, SETTINGS, film=film) as opened:
        client = page_of(app_of(opened))
        assert client.get("/api/frame/3.png").status_code == 422
        assert client.get("/api/run").json()["frames"] == 240
        told = client.get("/api/film").json()
        assert told["rows"] is None
        assert "bytes" in told["error"]
        assert client.get("/api/kymograph/0/0/0.png").status_code == 200


def test_served_on_the_loopback_address_until_it_is_told_to_stop(session):
    """The real server: an address with its token, and an end."""
    with Served(session) as served:
        assert served.url.startswith("http://127.0.0.1:")
        assert served.ask("/api/run")[1]["frames"] == 240
        assert served.ask("/api/quit", {}) == (200, {"ended": True})
        served.ended()


def test_the_page_is_there_before_the_run_has_been_read():
    """A failure means that a long run keeps a person waiting before a blank window."""
    begin, opened = Event(), Queue()

    def reading(stop):
        assert begin.wait(PATIENCE_S)
        raise InputError("tracks.nc", "tracks", "a damaged file")

    def work():
        with pytest.raises(InputError, match="damaged"):
            serve(reading, opened=opened.put)
        opened.put("refused")

    serving = Thread(target=work, daemon=True)
    serving.start()
    served = Address(opened.get(timeout=PATIENCE_S))
    assert b"<html" in served.ask(f"/?token={served.token}")[1]
    with ThreadPoolExecutor(1) as pool:
        asked = pool.submit(served.ask, "/api/run")
        begin.set()
        status, told = asked.result()
    assert (status, opened.get(timeout=PATIENCE_S)) == (422, "refused")
    assert "damaged" in told["error"]


@pytest.mark.parametrize("port", [-1, 99999])
def test_a_port_that_does_not_exist_is_refused_in_one_line(port):
    """A failure means a traceback for a slip of the pen in a number."""
    with pytest.raises(InputError, match=rf"`port`: expected a free one, at most 65535; found {port}"):
        serve(lambda stop: None, opened=lambda address: None, port=port)


# --- the first view -----------------------------------------------------------------------------------------


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
        client = page_of(app_of(session))
        for question, content in answers.items():
            assert client.get(question).content == content, question


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
    (run / FIRST_VIEW).write_bytes((run / FIRST_VIEW).read_bytes()[:-300])


def flipped(run):
    content = bytearray((run / FIRST_VIEW).read_bytes())
    content[len(content) // 2] ^= 1
    (run / FIRST_VIEW).write_bytes(content)


def emptied(run):
    (run / FIRST_VIEW).write_bytes(b"")


@pytest.mark.parametrize("harm", [changed, other_tracks, cut_short, flipped, emptied])
def test_of_another_run_or_damaged_it_is_not_used(kept, harm):
    """A failure means that a review shows what is no longer true."""
    harm(kept)
    assert read_first_view(kept) == {}


@pytest.mark.posix
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
