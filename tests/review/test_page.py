"""The page of the review in a real browser: a run with planted faults is put right, kept and found again."""

import json
import os
import re
import shutil
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from threading import Event

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from tests.scenes import doubted as scene
from tests.scenes.browser import PATIENCE_MS, Visit, assert_shut_in
from tests.scenes.reviewed import SETTINGS
from tests.scenes.served import Served, Started
from vision.command.settings import settings_of_run
from vision.pipeline import Settings, analyse
from vision.review.api import keep_first_view
from vision.review.server import read_first_view
from vision.review.session import Session
from vision.run.provenance import Origin, Parameter
from vision.run.reading import read_run
from vision.run.writing import write_run

pytestmark = pytest.mark.thorough
SHOTS = os.environ.get("SHEETVISION_SCREENSHOTS")


@pytest.fixture
def run(doubted, tmp_path):
    """A run folder of one's own."""
    return shutil.copytree(doubted, tmp_path / "doubted")


@contextmanager
def served(run, settings):
    """A review within this process, which begins sooner than one of its own."""
    with Session(run, settings) as session, Served(session) as here:
        yield here


class ReviewVisit(Visit):
    """The open review of a run, and what a person does there."""

    def __init__(self, browser, address, **look):
        super().__init__(browser, address.address, **look)
        self.address = address.address
        self.page.wait_for_selector("#history li")

    def press(self, *keys):
        for key in keys:
            self.page.keyboard.press(key)

    def text(self, name):
        return self.page.locator(f"#{name}").inner_text()

    def history(self):
        """What counts, in words."""
        return self.page.locator("#history li:not(.undone) .what").all_inner_texts()

    def undone(self):
        return self.page.locator("#history li.undone").count()

    def reads(self, name, text):
        """What an element says once it says this."""
        self.page.locator(f"#{name}", has_text=text).wait_for()
        return self.text(name)

    def place(self, view, frame, column=None):
        """Where a frame and a column are on the screen, in one of the pictures."""
        box = self.page.locator(f"#{view}").bounding_box()
        x, y = self.page.evaluate(
            """([view, frame, column]) => {
              const { surface: s } = review.views[view], v = review.view;
              const across = (value, low, high) => s.left + (s.plotWidth * (value - low)) / (high - low);
              const middle = s.top + s.plotHeight / 2;
              if (view === "film") return [across(column, v.low, v.high), middle];
              const x = across(frame + 0.5, v.first, v.last);
              if (column == null) return [x, middle];
              return [x, s.top + s.plotHeight * (1 - (column - v.low) / (v.high - v.low))];
            }""",
            [view, frame, column],
        )
        return box["x"] + x, box["y"] + y

    def point(self, view, frame, column=None):
        """A click on a frame and column of a picture."""
        self.page.mouse.click(*self.place(view, frame, column))

    def drag(self, view, begin, end):
        """From one column to another."""
        self.page.mouse.move(*self.place(view, None, begin))
        self.page.mouse.down()
        self.page.mouse.move(*self.place(view, None, end), steps=5)
        self.page.mouse.up()

    def slide(self, film_s, by_s):
        """Moves the force along the film, by a time."""
        x, y = self.place("force", 120)
        width = self.page.evaluate("review.views.force.surface.plotWidth")
        self.page.mouse.move(x, y)
        self.page.mouse.down()
        self.page.mouse.move(x + by_s * width / film_s, y, steps=4)
        self.page.mouse.up()

    def rows(self):
        """Upper and lower edge of the film's picture on the screen."""
        box = self.page.locator("#film").bounding_box()
        top, high = self.page.evaluate(
            "(() => { const s = review.views.film.surface; return [s.top, s.plotHeight]; })()"
        )
        return box["y"] + top, box["y"] + top + high

    def label(self, name, text):
        """What a screen reader says of an element once it says this."""
        found = self.page.locator(f"#{name}[aria-label*='{text}']")
        found.wait_for()
        return found.get_attribute("aria-label")

    def effect(self):
        """What is said about the open decision, once it is known."""
        self.page.wait_for_selector("#decision .main:not([disabled]):not([hidden])")
        return self.text("effect")

    def kept(self, count):
        """Waits until so many decisions count."""
        self.page.wait_for_function(
            "(n) => document.querySelectorAll('#history li:not(.undone) .what').length === n", arg=count
        )

    def saved(self):
        self.page.wait_for_selector(
            "#connection[data-state=saved], #notice:not([hidden])", timeout=2 * PATIENCE_MS
        )
        assert self.text("notice") == ""

    def foreign(self):
        """Requests to anywhere but the program."""
        home = self.address.partition("?")[0]
        return [url for url in self.requests if not url.startswith((home, "blob:"))]

    def shot(self, name):
        """Pictures at two sizes, light and dark, where somebody wants to look at them."""
        if SHOTS:
            size = self.page.viewport_size
            for width, height in ((1280, 800), (1920, 1080)):
                self.page.set_viewport_size({"width": width, "height": height})
                for scheme in ("light", "dark"):
                    self.page.emulate_media(color_scheme=scheme)
                    self.page.wait_for_timeout(500)
                    self.page.screenshot(path=f"{SHOTS}/review_{name}_{width}_{scheme}.png")
            self.page.emulate_media(color_scheme="null")
            self.page.set_viewport_size(size)


def assert_true(run):
    """The run folder holds the truth of the scene, every position."""
    tracks, truth = read_run(run).tracks, scene.true_positions()
    assert np.abs(tracks["x_px"].values - truth).max() < 0.5  # NaN would fail, too
    assert set(np.unique(tracks["flag"].values)) <= {"ok", "blurred"}
    half = scene.SHEETS // 2
    np.testing.assert_array_equal(tracks["side"].values, [-1] * half + [1] * half)
    np.testing.assert_array_equal(tracks["n"].values, [*range(half, 0, -1), *range(1, half + 1)])


def test_the_planted_faults_are_there(doubted):
    """A failure means that the tests below put right what was never wrong."""
    tracks, truth = read_run(doubted).tracks, scene.true_positions()
    away = np.abs(tracks["x_px"].values - truth)
    assert (away[scene.SWAPPED_FROM :, list(scene.SWAPPED)] > 90).all()
    assert (tracks["flag"].values[slice(*scene.GAP), scene.LEFT_OUT] == "left_out").all()
    assert (tracks["flag"].values[slice(*scene.DOUBT), scene.DOUBTED] == "doubtful").all()
    assert int((tracks["side"].values < 0).sum()) == 5


def test_by_the_keyboard_alone(browser, run):
    """A failure means that somebody without a mouse cannot put a run right, or loses a decision."""
    with Started(run) as started:
        visit = ReviewVisit(browser, started)
        page = visit.page
        visit.shot("start")
        visit.press("d")
        assert f"frames {scene.DOUBT[0]} to {scene.DOUBT[1] - 1}" in visit.text("message")
        visit.press("a")
        assert "0 → 31 of 31 positions" in visit.effect()
        visit.shot("accept")
        visit.press("Enter")
        visit.kept(3)
        assert "No stretch is doubtful" in visit.text("doubts")

        visit.press(*["ArrowDown"] * 4, *["Shift+ArrowLeft"] * 4, "s")  # sheet 2, frame 40
        assert "moved by 100" in visit.effect()
        visit.press("Enter")
        visit.kept(4)

        visit.press(*["ArrowUp"] * 6, *["Shift+ArrowRight"] * 11, "g")  # sheet 8, frame 150
        visit.press("Tab", "Tab", "Tab", "Control+A")
        page.keyboard.type(f"{scene.GAP[1]}")
        visit.reads("effect", "→ 21 of 21 positions")
        visit.press("Enter")
        visit.kept(5)

        visit.press("m", "Control+A")
        page.keyboard.type(f"{scene.AXIS_PX}")
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
        started.kill()
        page.wait_for_selector("#connection[data-state=lost]")
        assert "not answer" in visit.text("connection")
        visit.shot("gone")
        assert visit.foreign() == []
        visit.context.close()
    with served(run, settings_of_run(run)) as here:
        visit = ReviewVisit(browser, here)
        assert visit.history() == history
        visit.press("Control+S")
        visit.page.wait_for_selector("#saving:not([hidden])")
        visit.shot("saving")
        visit.saved()
        visit.shot("saved")
        assert_true(run)
        assert visit.complaints == []
        visit.context.close()


def test_by_the_mouse_alone(browser, run):
    """A failure means that somebody who knows no key cannot put a run right."""
    truth = scene.true_positions()
    with served(run, settings_of_run(run)) as here:
        visit = ReviewVisit(browser, here)
        page = visit.page
        page.click("#doubts button")
        page.click("#decide-accept")
        assert "0 → 31 of 31 positions" in visit.effect()
        page.click("#keep")
        visit.kept(3)

        page.click("#whole")
        visit.point("diagram", scene.SWAPPED_FROM, truth[scene.SWAPPED_FROM, 3])  # there it is called 2
        assert "frame 40 " in visit.reads("where", "frame 40 ")
        page.click("#decide-swap")
        assert "moved by 100" in visit.effect()
        page.click("#keep")
        visit.kept(4)

        first, stop = scene.GAP
        visit.point("diagram", first - 5, truth[first - 5, scene.LEFT_OUT])
        visit.point("tracks", first)
        page.click("#decide-assign")
        visit.point("film", None, truth[first, scene.LEFT_OUT])
        visit.point("tracks", stop - 1)
        page.click("[aria-label='to frame: take the cursor\\'s']")
        visit.reads("effect", "0 → 21 of 21 positions")
        visit.effect()
        visit.shot("assign")
        page.click("#keep")
        visit.kept(5)

        page.click("#decide-axis")
        visit.drag("film", scene.WRONG_AXIS_PX, scene.AXIS_PX)
        visit.reads("effect", "left 6, right 6")
        visit.effect()
        visit.shot("axis")
        page.click("#keep")
        visit.kept(6)

        for left in range(5, 1, -1):
            page.click("#undo")
            visit.kept(left)
        assert visit.undone() == 4
        for done in range(3, 7):
            page.click("#redo")
            visit.kept(done)
        page.click("#save")
        visit.saved()
        assert_true(run)
        page.reload()
        page.wait_for_selector("#history li .what")
        assert len(visit.history()) == 6
        assert "up to date" in visit.text("connection")
        assert visit.complaints == []
        assert visit.foreign() == []
        page.click("#close")
        visit.reads("notice", "The review has ended")
        here.ended()
        visit.context.close()


PAPER = Path(__file__).parents[2] / "fixtures" / "paper"
PAPER_SETTINGS = Settings(pixel_size_um=10.0, d0_mm=13.0, timestamps=PAPER / "timestamps.txt")


@pytest.fixture(scope="module")
def unsure(tmp_path_factory):
    """A run whose five slips fit the force in several ways, so that its clock is ambiguous. Not to be
    changed."""
    run = tmp_path_factory.mktemp("unsure") / "paper"
    video, force = PAPER / "video.avi", PAPER / "force.txt"
    found = {
        "pixel_size": 10.0,
        "d0": 13.0,
        "timestamps": str(PAPER_SETTINGS.timestamps),
        "force": str(force),
    }
    parameters = {name: Parameter(value, "given") for name, value in found.items()}
    origin = Origin(command="track video.avi", inputs=(video, force), parameters=parameters)
    write_run(analyse(video, force, PAPER_SETTINGS), run, origin, report=False)
    return run


def test_a_clock_is_accepted_by_sliding_the_force(browser, unsure, tmp_path):
    """A failure means that ambiguous clocks cannot be settled, or that σ_x/Λ_st does not follow."""
    run = shutil.copytree(unsure, tmp_path / "paper")
    clock = json.loads((run / "clock.json").read_text())
    assert clock["status"] == "ambiguous"
    assert not (run / "deformation.csv").exists()
    truth = xr.load_dataset(PAPER / "truth.nc", engine="h5netcdf")
    right = float(truth.attrs["offset_s"])
    fits = [abs(one["offset_s"] - right) < 0.05 for one in clock["candidates"]]
    assert sum(fits) == 1
    with served(run, PAPER_SETTINGS) as here:
        visit = ReviewVisit(browser, here)
        page = visit.page
        visit.reads("force-facts", "clocks ambiguous, drawn at the likeliest offset")
        visit.reads("warnings", "clocks ambiguous")
        page.click("#decide-clock")
        visit.effect()
        wrong = str(fits.index(False))
        page.select_option("#field-candidate", wrong)
        missed = int(visit.effect().split(" of ")[0])
        away = clock["candidates"][int(wrong)]["offset_s"] - right
        visit.shot("clock_wrong")
        film_s = page.evaluate("review.view.seconds(review.view.end) - review.view.seconds(0)")
        for _ in range(100):  # no further than the picture is wide at a time
            at = float(page.input_value("#field-offset"))
            if abs(at - right) < 0.02:
                break
            visit.slide(film_s, max(-0.4 * film_s, min(0.4 * film_s, at - right)))
        assert abs(float(page.input_value("#field-offset")) - right) < 0.02, away
        met = int(visit.effect().split(" of ")[0])
        assert met > missed
        visit.shot("clock")
        page.select_option("#field-candidate", str(fits.index(True)))
        assert float(page.input_value("#field-offset")) == pytest.approx(right, abs=0.01)
        assert int(visit.effect().split(" of ")[0]) >= met
        page.click("#keep")
        visit.kept(1)
        visit.reads("force-facts", "clocks given")
        page.click("#slip-after")
        visit.reads("message", "Slip at")
        visit.press(*["ArrowRight"] * 5)
        label = visit.label("stick", "in stick")
        visit.shot("deformation")
        event, ratio = re.search(r"in stick (\d+);.*: ([0-9.]+); threshold", label).groups()
        peak = pd.read_csv(run / "events.csv").set_index("event").loc[int(event), "t_p_s"]
        same = int(np.abs(truth["t_p_s"].values - peak).argmin())
        assert float(ratio) == pytest.approx(float(truth["ratio"].values[same, 0]), abs=0.03)
        page.click("#save")
        visit.saved()
        assert json.loads((run / "clock.json").read_text())["status"] == "given"
        assert (run / "deformation.csv").exists()
        assert visit.complaints == []
        visit.context.close()


@pytest.fixture(scope="module")
def pulled_page(planted, tmp_path_factory):
    """A run with a force recording."""
    run = shutil.copytree(planted, tmp_path_factory.mktemp("pulled") / "late")
    with served(run, SETTINGS) as here:
        yield here


@pytest.fixture
def visit(browser, pulled_page):
    """Its open review, which finds nothing to complain about."""
    visit = ReviewVisit(browser, pulled_page)
    yield visit
    assert visit.complaints == []
    visit.context.close()


def test_the_first_view_is_there_before_the_run_is_read(browser, planted, tmp_path):
    """A failure means that somebody with a long run waits for all of it before anything is seen."""
    run, begun, free = shutil.copytree(planted, tmp_path / "late"), Event(), Event()

    def opening():
        begun.set()
        assert free.wait(PATIENCE_MS / 1000)

    with Session(run, SETTINGS) as session:
        with ThreadPoolExecutor(1) as beside:  # Playwright has an event loop of its own in this thread
            beside.submit(keep_first_view, session).result()
        with Served(session, read_first_view(run), opening) as here:
            visit = ReviewVisit(browser, here)
            page = visit.page
            page.wait_for_function(
                """() => review.film.rows && review.views.film.shown && review.force.parts.kept.size
                  && review.tiles.pictures.kept.size && review.tiles.blocks.kept.size"""
            )
            visit.reads("at-sheet", "x = ")
            assert page.evaluate("review.tiles.pictures.refused.size + review.tiles.blocks.refused.size") == 0
            assert begun.wait(PATIENCE_MS / 1000)  # by the first question that is not kept
            page.evaluate("0")  # what was asked meanwhile has been noted
            asked = {url.partition(here.url)[2] for url in visit.requests if "/api/" in url}
            assert len(asked) > 10
            assert asked - set(read_first_view(run)) == {"/api/state"}
            free.set()
            visit.press("n")
            visit.reads("message", "Slip at")
            assert visit.complaints == []
            visit.context.close()


def test_zooming_out_draws_the_tracks_now_and_then(visit):
    """A failure means that a look from one slip out to the whole test stutters: lines are slow to draw, so
    that they are stretched in between, and drawn as they are once the picture rests."""
    steps, drawn, plain = visit.page.evaluate(
        """async () => {
          const { view, views: { diagram } } = review, counts = { drawn: 0, lines: 0 };
          for (const name of ["drawn", "lines"]) {
            const work = diagram[name].bind(diagram);
            diagram[name] = (...given) => { counts[name] += 1; return work(...given); };
          }
          view.setFrames(view.begin + 60, view.begin + 70);
          let steps = 0;
          for (; view.last - view.first < view.end - view.begin; steps++) {
            view.zoomFrames(1.03, view.begin + 65);
            await new Promise(requestAnimationFrame);
          }
          const { drawn, lines } = counts;
          while (!view.settled || counts.lines === lines) await new Promise(requestAnimationFrame);
          return [steps, drawn, counts.lines - counts.drawn];
        }"""
    )
    assert steps > 60
    assert 3 < drawn < steps / 4
    assert plain >= 1


def test_dragging_the_strip_shows_its_noise_at_once(visit):
    """A failure means that rows are chosen blindly."""
    page = visit.page
    page.wait_for_selector("#decide-strip:not([disabled])")
    page.click("#decide-strip")
    assert "noise from frame to frame" in visit.effect()
    before = visit.text("film-facts")
    top, bottom = visit.rows()
    page.mouse.move(600, bottom - 2)
    page.mouse.down()
    page.mouse.move(600, bottom - 0.7 * (bottom - top), steps=4)
    page.mouse.up()
    page.wait_for_function("(old) => document.getElementById('film-facts').textContent !== old", arg=before)
    visit.effect()
    was, will = re.search(r"frame to frame: ([0-9.]+) → ([0-9.]+) px", visit.text("effect")).groups()
    assert float(will) > 1.3 * float(was)  # a third of the rows, more noise: about the root of three
    visit.shot("strip")
    visit.press("Escape")
    visit.reads("film-facts", before)


def test_a_drag_goes_to_no_frame_in_whatever_direction(visit):
    """A failure means that the cursor jumps where a person only moved a picture."""
    mouse = visit.page.mouse
    for name in ("film", "diagram", "tracks"):
        box = visit.page.locator(f"#{name}").bounding_box()
        x, y = box["x"] + 0.7 * box["width"], box["y"] + 0.5 * box["height"]
        for across, up in ((30, 0), (0, 30)):
            mouse.move(x, y)
            mouse.down()
            mouse.move(x + across, y - up, steps=4)
            mouse.up()
        assert visit.page.evaluate("review.view.frame") == 0, name
    mouse.click(x, y)
    assert visit.page.evaluate("review.view.frame") > 0


def test_another_strip_is_tracked_again_before_it_is_kept(browser, planted, tmp_path):
    """A failure means that rows are kept of which nobody saw positions and shells, or that a long film holds
    the review."""
    run = shutil.copytree(planted, tmp_path / "late")
    before = (run / "tracks.csv").read_bytes()
    with served(run, SETTINGS) as here:
        visit = ReviewVisit(browser, here)
        page = visit.page
        count = len(visit.history())
        page.wait_for_selector("#decide-strip:not([disabled])")
        visit.press("z", "Control+A")
        page.keyboard.type("10")
        visit.press("Tab", "Control+A")
        page.keyboard.type("14")
        visit.reads("film-facts", "rows 10:14")
        visit.effect()
        assert page.locator("#keep").is_hidden()
        visit.press("Enter")
        page.click("#stop")
        visit.reads("message", "Not tracked again")
        assert page.locator("#keep").is_hidden()
        visit.effect()
        visit.press("Enter")
        visit.shot("tracking")
        page.wait_for_selector("#keep:not([disabled]):not([hidden])")
        told = visit.text("effect")
        assert re.search(r"[1-9]\d* of 117\d\d differ by over 3 errors", told)
        assert "shell, stiff sheets" in told
        was, will = re.search(r"error of a position \(median\): ([0-9.]+) → ([0-9.]+) px", told).groups()
        assert float(will) > 1.5 * float(was)
        visit.shot("tracked")
        assert (run / "tracks.csv").read_bytes() == before
        visit.press("Enter")
        visit.kept(count + 1)
        visit.reads("connection", "Saved at")
        assert read_run(run).tracks.attrs["strip_z0"] == 10
        assert visit.complaints == []
        visit.context.close()


@pytest.mark.parametrize("width", [600, 839])
def test_a_narrow_window_shows_one_column(browser, pulled_page, width):
    """A failure means that a narrow window cuts off the page or squeezes its pictures to nothing."""
    visit = ReviewVisit(browser, pulled_page, viewport={"width": width, "height": 900})
    visit.press("g")
    visit.effect()
    assert visit.page.evaluate("document.documentElement.scrollWidth") == width
    boxes = [
        visit.page.locator(f"#{name}").bounding_box()
        for name in ("film", "diagram", "tracks", "force", "stick", "doubts", "keep", "history")
    ]
    assert all(box["x"] >= 0 and box["x"] + box["width"] <= width for box in boxes)
    assert all(box["height"] > 100 for box in boxes[:5])
    assert all(upper["y"] + upper["height"] <= lower["y"] for upper, lower in pairwise(boxes))
    assert visit.complaints == []
    visit.context.close()


@pytest.mark.parametrize(("width", "height", "scheme"), [(1280, 800, "light"), (1920, 1080, "dark")])
def test_the_page_fits_its_window(browser, pulled_page, width, height, scheme):
    """A failure means that a projector or a small screen shows a page cut off, or in the wrong colours."""
    visit = ReviewVisit(
        browser, pulled_page, viewport={"width": width, "height": height}, color_scheme=scheme
    )
    page = visit.page
    size = page.evaluate("[document.documentElement.scrollWidth, document.documentElement.scrollHeight]")
    assert size == [width, height]
    assert page.evaluate("document.documentElement.dataset.theme") == scheme
    visit.press("g")
    visit.effect()
    for name in ("keep", "history", "doubts", "stick"):
        box = page.locator(f"#{name}").bounding_box()
        assert box["y"] + box["height"] <= height
        assert box["height"] > 12
    visit.press("Escape")
    page.click("#theme")
    assert page.evaluate("document.documentElement.dataset.theme") != scheme
    assert visit.complaints == []
    visit.context.close()


def test_every_control_and_picture_has_a_name(visit):
    """For a screen reader: a failure means that it says "button", or nothing where something changed."""
    page = visit.page
    asked = visit.context.new_cdp_session(page)

    def nodes():
        found = asked.send("Accessibility.getFullAXTree")["nodes"]
        return [one for one in found if not one["ignored"] and one["role"]["value"] != "RootWebArea"]

    def told(node, name):
        return next((p["value"].get("value") for p in node.get("properties", []) if p["name"] == name), None)

    page.wait_for_selector("#decide-strip:not([disabled])")
    for kind in ("", "accept", "swap", "assign", "add", "delete", "axis", "strip", "clock"):
        if kind:
            page.click(f"#decide-{kind}")
            page.wait_for_selector("#effect :is(li), #effect.refused")
        reached = [one for one in nodes() if told(one, "focusable")]
        assert len(reached) > 25
        assert [one for one in reached if not one["name"]["value"].strip()] == []
        assert page.locator("#effect[aria-live=polite]").count() == bool(kind)
    live = [one for one in nodes() if told(one, "live") == "polite"]
    assert len(live) >= 4
    visit.press("Escape", "?")
    assert page.locator("#keys").is_visible()
    visit.press("Escape")
    focused = set()
    for _ in range(40):  # every control is reached, and seen to be
        visit.press("Tab")
        name, ring = page.evaluate(
            "[document.activeElement.id, getComputedStyle(document.activeElement).outlineStyle]"
        )
        assert ring == "solid" or not name
        focused.add(name)
    wanted = page.evaluate(
        """[...document.querySelectorAll("button, select, input, canvas")]
          .filter((one) => one.checkVisibility() && !one.disabled).map((one) => one.id)"""
    )
    assert set(wanted) <= focused


def test_an_answer_about_an_earlier_value_settles_nothing(visit):
    """A failure means that a decision can be kept beside the effect of another."""
    visit.page.click("#decide-axis")
    visit.effect()
    late = visit.page.evaluate(
        """async () => {
          const form = review.decisions, ask = review.preview;
          const asked = new Promise((here) => {
            const old = { lines: ["of an earlier value"] };
            review.preview = () => new Promise((answer) => here(() => answer(old)));
          });
          form.changed(true);
          const answer = await asked;  // the first question is on its way
          review.preview = ask;
          form.changed();              // and the value is changed before it is answered
          answer();
          await Promise.resolve(); await Promise.resolve();
          return [form.ready, form.form.querySelector("#effect").textContent];
        }"""
    )
    assert late[0] is False
    assert "earlier" not in late[1]
    assert "earlier" not in visit.effect()


def test_an_effect_on_a_part_of_the_frames_says_so(visit):
    """A failure means that the effect near the cursor is taken for the whole one."""
    lines = visit.page.evaluate(
        """async () => {
          const { effectOn } = await import("./page/effect.js");
          const held = { x_px: [[1], [2]], side: [1], n: [1] };
          const answer = (concerned) => ({ frames: [7, 8], before: held, after: held, concerned });
          const decision = { kind: "leave_out", sheet: 0, frames: "7:" };
          return [2, 90].map((n) => effectOn(answer(n), decision, () => "sheet 0", "no stick").lines[0]);
        }"""
    )
    assert "concerns" not in lines[0]
    assert "frames 7–8 (near the cursor; the decision concerns 90 frames)" in lines[1]


def test_a_second_window_is_told_of_the_first(browser, pulled_page):
    """A failure means that two people undo each other's decisions without knowing."""
    first, second = ReviewVisit(browser, pulled_page), ReviewVisit(browser, pulled_page)
    second.reads("notice", "open in another window")
    first.reads("notice", "open in another window")
    before = len(second.history())
    second.page.click("#decide-axis")
    second.effect()
    second.press("Enter")
    second.kept(before + 1)
    first.kept(before + 1)  # it learns of it by itself
    first.press("u")
    first.kept(before)
    second.kept(before)
    for visit in (first, second):
        assert visit.complaints == []
        visit.context.close()


def test_the_page_finds_the_program_again(browser, pulled_page):
    """A failure means that a laptop that slept shows a page that is dead, or that seems alive and is not."""
    visit = ReviewVisit(browser, pulled_page)
    page = visit.page
    page.route("**/api/**", lambda route: route.abort())
    page.wait_for_selector("#connection[data-state=lost]")
    assert "does not answer" in visit.text("notice")
    assert page.locator("#undo").is_disabled()
    page.unroute("**/api/**")
    visit.reads("message", "answers again")
    page.wait_for_selector("#connection:not([data-state=lost])")
    assert not page.locator("#undo").is_disabled()
    visit.context.close()


def test_the_page_could_not_ask_the_network_if_it_tried(browser, pulled_page):
    """A failure means that a script that strayed into the page could send the data away."""
    visit = ReviewVisit(browser, pulled_page)
    assert_shut_in(visit)
    visit.context.close()


def test_a_late_answer_does_not_hide_the_end(browser, run):
    """A failure means that a page that was waiting for news hid the notice that the review has ended."""
    with served(run, settings_of_run(run)) as here:
        visit = ReviewVisit(browser, here)
        page, waiting = visit.page, []
        state = page.evaluate("review.state")

        def hold(route):
            waiting.append(route)

        page.route("**/api/state", hold)
        for _ in range(PATIENCE_MS // 50):
            if waiting:
                break
            page.wait_for_timeout(50)
        page.click("#close")
        visit.reads("notice", "The review has ended")
        waiting[0].fulfill(json=state | {"other_windows": 2})
        page.evaluate("() => new Promise((done) => { setTimeout(done, 200); })")  # for the page to read it
        assert "The review has ended" in visit.text("notice")
        here.ended()
        visit.context.close()
