"""The page of the review in a real browser: a run with planted faults is put right, kept and found again."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.scenes import planted
from tests.scenes.browser import chromium
from vision.run.reading import read_run

PROJECT = Path(__file__).parents[2]
PATIENCE_MS = 30_000  # the machine may be busy
SHOTS = os.environ.get("SHEETVISION_SCREENSHOTS")


@pytest.fixture(scope="module")
def browser():
    with chromium() as opened:
        yield opened


@pytest.fixture(scope="module")
def planted_run(tmp_path_factory):
    return planted.planted_run(tmp_path_factory.mktemp("planted"))


@pytest.fixture
def run(planted_run, tmp_path):
    """A copy of its own for each test."""
    copy = tmp_path / "planted"
    copy.mkdir()
    for file in planted_run.iterdir():
        (copy / file.name).write_bytes(file.read_bytes())
    return copy


class Served:
    """`track review` in a process of its own, as a user starts it."""

    def __init__(self, run):
        command = [sys.executable, PROJECT / "cli.py", "review", run, "--no-browser"]
        self.process = subprocess.Popen(command, cwd=PROJECT, stdout=subprocess.PIPE, text=True)
        for line in self.process.stdout:
            if found := re.search(r"http://\S+", line):
                self.address = found[0]
                break

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.kill()

    def kill(self):
        """At once, with nothing put in order."""
        self.process.kill()
        self.process.wait()
        self.process.stdout.close()


class Visit:
    """An open page, with everything it complained about or asked for."""

    def __init__(self, browser, served, **look):
        self.context = browser.new_context(**{"viewport": {"width": 1280, "height": 800}} | look)
        self.page = self.context.new_page()
        self.page.set_default_timeout(PATIENCE_MS)
        self.address = served.address
        self.complaints, self.requests = [], []
        self.page.on("console", lambda message: self.complaints.append(message.text))
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(served.address)
        self.page.wait_for_selector("#history li")

    def press(self, *keys):
        for key in keys:
            self.page.keyboard.press(key)

    def text(self, name):
        return self.page.locator(f"#{name}").inner_text()

    def history(self):
        """What counts, and what was undone."""
        entries = self.page.locator("#history li .what")
        return [
            self.page.locator("#history li:not(.undone) .what").nth(k).inner_text()
            for k in range(entries.count() - self.undone())
        ]

    def undone(self):
        return self.page.locator("#history li.undone").count()

    def reads(self, name, text):
        """Waits until an element says this."""
        self.page.locator(f"#{name}", has_text=text).wait_for()

    def effect(self):
        """What is said about the open decision, once it is known."""
        self.page.wait_for_selector("#keep:not([disabled])")
        return self.text("effect")

    def kept(self, count):
        """Waits until so many decisions count."""
        self.page.wait_for_function(
            "(n) => document.querySelectorAll('#history li:not(.undone) .what').length === n", arg=count
        )

    def saved(self):
        self.page.wait_for_selector("#connection[data-state=saved]")

    def foreign(self):
        """Requests to anywhere but the program."""
        home = self.address.partition("?")[0]
        return [url for url in self.requests if not url.startswith((home, "blob:"))]

    def shot(self, name):
        if SHOTS:
            self.page.wait_for_timeout(500)
            self.page.screenshot(path=f"{SHOTS}/review_{name}.png")


def assert_true(run):
    """The run folder holds the truth of the scene, every position."""
    tracks, truth = read_run(run).tracks, planted.true_positions()
    assert np.abs(tracks["x_px"].values - truth).max() < 0.5  # NaN would fail, too
    assert set(np.unique(tracks["flag"].values)) <= {"ok", "blurred"}
    half = planted.SHEETS // 2
    np.testing.assert_array_equal(tracks["side"].values, [-1] * half + [1] * half)
    np.testing.assert_array_equal(tracks["n"].values, [*range(half, 0, -1), *range(1, half + 1)])


def test_the_planted_faults_are_there(planted_run):
    """A failure means that the tests below put right what was never wrong."""
    tracks, truth = read_run(planted_run).tracks, planted.true_positions()
    away = np.abs(tracks["x_px"].values - truth)
    assert (away[planted.SWAPPED_FROM :, list(planted.SWAPPED)] > 90).all()
    assert (tracks["flag"].values[slice(*planted.GAP), planted.LEFT_OUT] == "left_out").all()
    assert (tracks["flag"].values[slice(*planted.DOUBT), planted.DOUBTED] == "doubtful").all()
    assert int((tracks["side"].values < 0).sum()) == 5


def test_by_the_keyboard_alone(browser, run):
    """A failure means that somebody without a mouse cannot put a run right, or loses a decision."""
    with Served(run) as served:
        visit = Visit(browser, served)
        page = visit.page
        visit.shot("start")
        visit.press("d")
        assert f"frames {planted.DOUBT[0]} to {planted.DOUBT[1] - 1}" in visit.text("message")
        visit.press("a")
        assert "0 → 31 of 31 positions" in visit.effect()
        visit.shot("accept")
        visit.press("Enter")
        visit.kept(3)
        assert "No stretch is in doubt" in visit.text("doubts")

        visit.press(*["ArrowDown"] * 4, *["Shift+ArrowLeft"] * 4, "s")  # sheet 2, frame 40
        assert "moved by 100" in visit.effect()
        visit.press("Enter")
        visit.kept(4)

        visit.press(*["ArrowUp"] * 6, *["Shift+ArrowRight"] * 11, "g")  # sheet 8, frame 150
        visit.press("Tab", "Tab", "Tab", "Control+A")
        page.keyboard.type(f"{planted.GAP[1]}")
        visit.reads("effect", "→ 21 of 21 positions")
        visit.press("Enter")
        visit.kept(5)

        visit.press("m", "Control+A")
        page.keyboard.type(f"{planted.AXIS_PX}")
        visit.reads("effect", "left 6, right 6")
        visit.press("Enter")
        visit.kept(6)

        for left in range(5, 1, -1):
            visit.press("u")
            visit.kept(left)
        assert visit.undone() == 4
        assert page.locator("#doubts button").count() == 1
        for done in range(3, 7):
            visit.press("Control+Shift+Z" if done % 2 else "r")
            visit.kept(done)
        history = visit.history()
        assert visit.complaints == []
        served.kill()
        page.wait_for_selector("#connection[data-state=lost]")
        assert "does not answer" in visit.text("connection")
        visit.shot("gone")
        assert visit.foreign() == []
        visit.context.close()
    with Served(run) as served:
        visit = Visit(browser, served)
        assert visit.history() == history
        visit.press("Control+S")
        visit.page.wait_for_selector("#saving:not([hidden])")
        visit.shot("saving")
        visit.saved()
        visit.shot("saved")
        assert_true(run)
        assert visit.complaints == []
        visit.context.close()
