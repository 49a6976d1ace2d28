"""Decisions: what they change, that they can be taken back, and that none is lost."""

import shutil
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import tifffile

from tests.scenes import doubted as scene
from tests.scenes.combs import comb, ridges, strip
from tests.scenes.reviewed import FIXTURE, PLANTED, SETTINGS, clean, remedies, truth
from vision import folder
from vision.command.main import run as track
from vision.command.settings import settings_of_run
from vision.errors import InputError
from vision.locks import POSIX
from vision.review import effects, saving
from vision.review.effects import CELLS, apply
from vision.review.saving import save_decisions
from vision.review.session import Session
from vision.run.reading import read_run
from vision.sheets.corrections import correction_of
from vision.sheets.recovery import Flag

EVERY_KIND = [
    {"kind": "swap", "sheets": [20, 22], "frames": "30:"},
    {"kind": "leave_out", "sheet": 5, "frames": "0:10"},
    {"kind": "delete", "sheet": 40},
    *remedies()[:4],
    {"kind": "strip", "rows": "4:24"},
    {"kind": "clock", "offset_s": 24.0, "drift_ppm": 12.5},
]


def claimed(folder):
    """The file that keeps a second review away; Windows needs none."""
    return [folder.with_name(f".{folder.name}.review")] if POSIX else []


def held(positions):
    """Everything a decision about sheets can change, to be compared."""
    cells = {name: getattr(positions, name).copy() for name in CELLS}
    return cells | {
        "side": positions.side.copy(),
        "n": positions.n.copy(),
        "axis": positions.attrs["axis_px"],
    }


def assert_same(one, other):
    for name, values in one.items():
        np.testing.assert_array_equal(values, other[name], err_msg=name)


def save(session):
    """As the server does it, in this process."""
    save_decisions(session.job(session.decisions, session.undone))


def off_px(tracks):
    """Largest distance from the truth; infinite where a sheet or a position is missing."""
    x_px, known = np.asarray(tracks["x_px"].values), truth()["x_px"].values
    if x_px.shape != known.shape:
        return np.inf
    return float(np.nan_to_num(np.abs(x_px - known), nan=np.inf).max())


@pytest.mark.thorough
def test_planted_mistakes_are_put_right_and_saved(session):
    """A failure means that a person who sees what is wrong cannot make the run right."""
    before = read_run(session.folder)
    assert off_px(before.tracks) == np.inf  # the mistakes are there, or this would prove nothing
    for remedy in remedies():
        session.decide(remedy)
    assert np.abs(session.positions.x_px - truth()["x_px"].values).max() < 0.5  # shown at once
    save(session)
    after = read_run(session.folder)
    assert off_px(after.tracks) < 0.5
    np.testing.assert_allclose(after.tracks["x_px"].values, clean().tracks["x_px"].values, atol=0.02)
    np.testing.assert_array_equal(after.tracks["n"].values, clean().tracks["n"].values)
    np.testing.assert_array_equal(after.tracks["side"].values, clean().tracks["side"].values)
    assert after.facts["clock"]["offset_s"] == 24.0
    assert len(after.facts["corrections"]) == len(PLANTED) + len(remedies())
    assert (session.folder / "shells.csv").exists()


def test_what_a_page_shows_is_what_saving_measures(session):
    """A failure means that the positions shown after a decision are not those that come of it."""
    session.decide({"kind": "swap", "sheets": [20, 22], "frames": "30:"})
    told = session.state()["decisions"][-1]["text"]  # with the names that the page shows
    assert told == "left 1 (index 20) and right 2 (index 22) swapped, frames 30:"
    session.decide(remedies()[1])
    shown = session.positions.x_px.copy()
    save(session)
    saved = read_run(session.folder).tracks["x_px"].values
    assert np.array_equal(np.isnan(shown), np.isnan(saved))
    assert np.nanmax(np.abs(shown - saved)) < 0.05


def test_every_decision_can_be_taken_back_and_made_again(session):
    """A failure means that undo leaves something changed, or redo makes something else of it."""
    states = [held(session.positions)]
    for decision in EVERY_KIND:
        session.decide(decision)
        states.append(held(session.positions))
    for state in reversed(states[:-1]):
        session.undo()
        assert_same(state, held(session.positions))
    for state in states[1:]:
        session.redo()
        assert_same(state, held(session.positions))
    with pytest.raises(InputError, match="undone"):
        session.redo()


def test_a_new_decision_ends_what_was_taken_back(session):
    """A failure means that a decision which was taken back returns after another."""
    session.decide(EVERY_KIND[0])
    session.undo()
    session.decide(EVERY_KIND[1])
    assert session.undone == []
    assert session.decisions[-1].kind == "leave_out"


@pytest.mark.parametrize("decision", EVERY_KIND[:6], ids=lambda decision: decision["kind"])
def test_a_preview_is_what_the_decision_does(session, decision):
    """A failure means that a person agrees to something else than what is then kept."""
    first = session.revision
    before = held(session.positions)
    seen = session.effects.preview(decision, 60)
    assert_same(before, held(session.positions))
    assert session.revision == first
    session.decide(decision)
    rows = [session.positions.row_of(int(frame)) for frame in seen["frames"]]
    np.testing.assert_allclose(seen["after"]["x_px"], session.positions.x_px[rows], atol=2e-3)
    np.testing.assert_array_equal(seen["after"]["n"], session.positions.n)
    changed = "n" if decision["kind"] == "axis" else "x_px"
    assert not np.array_equal(seen["before"][changed], seen["after"][changed], equal_nan=True)


def test_stretches_without_a_ridge_are_listed_after_the_doubtful_ones(doubted):
    """A failure means that a review does not lead to where a sheet is lost, or not to the doubts first."""
    with Session(doubted, settings_of_run(doubted)) as session:
        before = [(one["sheet"], one["first"]) for one in session.doubts()]
        session.positions.flag[20:200, 3] = Flag.MISSING
        session.positions.flag[20:25, 5] = Flag.MISSING
        (lost,) = session.doubts()[len(before) :]
        assert [(one["sheet"], one["first"]) for one in session.doubts()[:-1]] == before
    assert (lost["sheet"], lost["first"], lost["stop"], lost["why"]) == (3, 20, 200, "no ridge")


@pytest.mark.parametrize("kind", ["accept", "assign"])
def test_a_preview_far_into_a_run_looks_at_the_frames_it_shows(doubted, tmp_path, monkeypatch, kind):
    """Of a long run only the frames about the cursor are looked at. A failure means that ridges of other
    frames, where the sheets stood elsewhere, are shown."""
    monkeypatch.setattr(effects, "SHOWN_ROWS", 40)
    run, x_px = shutil.copytree(doubted, tmp_path / "run"), scene.true_positions()
    sheet, (first, stop) = {
        "accept": (scene.DOUBTED, scene.DOUBT),
        "assign": (scene.LEFT_OUT, scene.GAP),
    }[kind]
    decision = {"kind": kind, "sheet": sheet, "frames": f"{first}:{stop}", "x_px": x_px[first, sheet]}
    with Session(run, settings_of_run(run)) as opened:
        seen = opened.effects.preview(decision, first + 10)
        frames = np.asarray(seen["frames"])
        assert frames[0] > 50
        assert seen["concerned"] == stop - first
        within = (frames >= first) & (frames < stop)
        shown = np.asarray(seen["after"]["x_px"])[within, sheet]
        np.testing.assert_allclose(shown, x_px[frames[within], sheet], atol=0.5)


def test_a_covered_sheet_is_counted(tmp_path):
    """A failure means that n cannot be put right in a review, or is another one in the saved run."""
    x = comb(60, per_side=8, axis_px=200)
    x[:, 4] = np.nan
    picture = np.rint(strip(ridges(x, width=400)).values).astype(np.uint8)
    tifffile.imwrite(tmp_path / "film.tif", np.repeat(picture[:, None], 8, axis=1), photometric="minisblack")
    out = tmp_path / "run"
    assert track([str(tmp_path / "film.tif"), "--out", str(out), "--no-report", "--quiet"]) == 1
    with Session(out, settings_of_run(out)) as session:
        assert len(session.sheets()) == 15
        session.decide({"kind": "add", "frame": 0, "x_px": 130.0})
        seen = session.sheets()
        assert [sheet["n"] for sheet in seen] == [*range(8, 0, -1), *range(1, 9)]
        assert seen[4]["x_px"] == pytest.approx(130, abs=2)
        save(session)
    assert list(pd.read_csv(out / "sheets.csv")["n"]) == [*range(8, 0, -1), *range(1, 9)]


def test_a_film_with_time_stamps_is_shown_from_another_folder(tmp_path, monkeypatch):
    """A failure means that a review in another working directory than the run's shows no film."""
    for name in ("video.avi", "timestamps.txt"):
        shutil.copy(FIXTURE / name, tmp_path)
    monkeypatch.chdir(tmp_path)
    assert track(["video.avi", "--timestamps", "timestamps.txt", "--frames", "0:60", "--quiet"]) == 0
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    with Session(tmp_path / "video_tracks", settings_of_run(tmp_path / "video_tracks")) as session:
        assert session.recordings.picture(3, 0.05).shape == (30, 1200)
        (tmp_path / "timestamps.txt").unlink()
    with (
        Session(tmp_path / "video_tracks", settings_of_run(tmp_path / "video_tracks")) as session,
        pytest.raises(InputError, match=r"^timestamps.txt: expected a readable file"),
    ):
        session.recordings.picture(3, 0.05)


def test_the_effect_on_the_deformation_is_shown(session):
    """Sheets of the stiff centre and of the outside exchanged: their ratios must change, others' hardly."""
    session.decide(remedies()[-1])
    frame = 120
    seen = session.effects.preview({"kind": "swap", "sheets": [2, 30], "frames": "0:"}, frame)
    before, after = (
        {row["index"]: row["ratio"] for row in seen[name]["sheets"]}
        for name in ("stick_before", "stick_after")
    )
    assert abs(after[2] - before[2]) > 0.05
    assert abs(after[40] - before[40]) < 0.02


@pytest.mark.parametrize(
    ("decision", "says"),
    [
        ({"kind": "swap", "sheets": [3, 99], "frames": "0:"}, "0 to 48"),
        ({"kind": "accept", "sheet": 3, "frames": "0:5"}, "doubtful stretch"),
        ({"kind": "assign", "sheet": 7, "frames": "50:60", "x_px": 5.0}, "a ridge near"),
        ({"kind": "leave_out", "sheet": 1, "frames": "0:9999"}, "0:240"),
        ({"kind": "rename", "sheet": 1}, "a kind of"),
        ({"kind": "axis"}, "x_px"),
        ({"kind": "axis", "x_px": "left"}, "x_px"),
    ],
)
def test_what_does_not_fit_is_refused_and_not_kept(watched, decision, says):
    """A failure means that a wrong decision is kept, or half of it."""
    before = held(watched.positions)
    with pytest.raises(InputError, match=says):
        watched.decide(decision)
    assert_same(before, held(watched.positions))
    assert len(watched.decisions) == len(PLANTED)


def test_a_sheet_without_any_position_is_numbered_between_its_neighbours(session):
    """A failure means that the axis cannot be moved where a sheet is doubtful in every frame."""
    session.positions.x_px[:, 5] = np.nan
    side, n = session.positions.side.copy(), session.positions.n.copy()
    session.decide({"kind": "axis", "x_px": session.positions.track_facts.axis_px})
    np.testing.assert_array_equal(session.positions.side, side)
    np.testing.assert_array_equal(session.positions.n, n)


def test_the_only_sheet_is_not_deleted(watched):
    """A failure means an answer with an internal error."""
    part = watched.positions
    one = {name: getattr(part, name)[:, :1] for name in CELLS} | {"side": part.side[:1], "n": part.n[:1]}
    with pytest.raises(InputError, match="the only one that is left"):
        apply(replace(part, **one), correction_of("delete", {"sheet": 0}), watched.diagram)


def test_a_ridge_is_not_given_twice(watched):
    """A failure means that two sheets stand at one place."""
    x_px = float(watched.positions.x_px[50, 9])
    with pytest.raises(InputError, match="no other sheet"):
        watched.decide({"kind": "assign", "sheet": 7, "frames": "50:60", "x_px": x_px})


def test_decisions_are_there_when_the_run_is_opened_again(run):
    """A failure means that a closed window costs what was decided in it."""
    with Session(run, SETTINGS) as first:
        for decision in EVERY_KIND[:3]:
            first.decide(decision)
        first.undo()
        last = held(first.positions)
    with Session(run, SETTINGS) as again:
        assert_same(last, held(again.positions))
        assert again.changed
        again.redo()
        assert again.decisions[-1].kind == "delete"


def test_saved_decisions_can_be_taken_back(run):
    """A failure means that saving ends undo, or that what is undone in a later review is lost or not said."""
    with Session(run, SETTINGS) as first:
        before = held(first.positions)
        first.decide(EVERY_KIND[1])
        first.save()
        first.saver.wait()
        assert first.saver.error == ""
        assert not first.changed
        first.undo()
        first.redo()
        assert not first.changed
        first.undo()  # the tables contain it: seen when it is saved
    with Session(run, SETTINGS) as again:
        assert again.positions.flag[5, 5] == Flag.LEFT_OUT
        assert [one.kind for one in again.unseen] == ["leave_out"]
        assert again.changed
        save(again)
    with Session(run, SETTINGS) as saved:
        np.testing.assert_allclose(saved.positions.x_px[:, 5], before["x_px"][:, 5], atol=1e-3)
        assert saved.unseen == [] and not saved.changed


def test_the_other_rows_show_their_ridges_and_noise(watched):
    """Fewer rows, more noise."""
    many = watched.effects.strip_preview("2:28", 100)
    few = watched.effects.strip_preview("14:16", 100)
    assert len(many["ridges"]) >= 48
    assert few["profile_noise"] > 1.5 * many["profile_noise"]
    with pytest.raises(InputError, match="rows within"):
        watched.effects.strip_preview("0:999", 100)


def test_a_second_review_of_the_same_run_is_refused(run):
    """A failure means that two reviews write over each other's decisions."""
    with Session(run, SETTINGS), pytest.raises(InputError, match="open"):
        Session(run, SETTINGS)
    Session(run, SETTINGS).__exit__()
    assert not list(run.parent.glob(".*.review"))  # a hidden file stays


def test_a_disk_that_fails_loses_nothing_that_was_kept(session, monkeypatch):
    """A failure means that a decision shown as kept is gone, or that half a file is left."""
    session.decide(EVERY_KIND[0])
    text = (session.folder / "corrections.toml").read_text()

    def full(handle):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(folder.os, "fsync", full)
    with pytest.raises(InputError, match="nothing was written"):
        session.decide(EVERY_KIND[1])
    assert (session.folder / "corrections.toml").read_text() == text
    assert session.decisions[-1].kind == "swap"
    assert [path.name for path in session.folder.glob(".corr*")] == []


# --- another strip, tracked again before it is kept ---------------------------------------------------------


@pytest.fixture
def clocked(unplanted, tmp_path):
    """A run without mistakes."""
    with Session(shutil.copytree(unplanted, tmp_path / "clean"), SETTINGS) as opened:
        yield opened


@pytest.mark.thorough
def test_another_strip_is_tracked_before_it_is_kept(clocked, monkeypatch):
    """A failure means that a person chooses rows without knowing what they do to positions and shells, or
    that something else is kept than what was shown."""
    folder, revision = clocked.folder, clocked.revision
    before = held(clocked.positions)
    clocked.trial.start({"kind": "strip", "rows": "10:14"})
    clocked.saver.wait()
    found = clocked.trial.state()["found"]
    assert clocked.trial.state()["error"] == ""
    assert_same(before, held(clocked.positions))
    assert read_run(folder).facts["found"]["strip"] != [10, 14]
    seen = clocked.trial.at(120)
    assert clocked.revision == revision
    assert [len(row["shells"]) for row in (seen["stick_before"], seen["stick_after"])] == [2, 2]

    shells, earlier = pd.read_csv(folder / "shells.csv"), read_run(folder).tracks["x_px"].values

    def refused(*args, **kwargs):
        raise OSError(30, "Read-only file system")

    with monkeypatch.context() as broken:
        broken.setattr(saving, "put_in_place", refused)
        with pytest.raises(InputError, match="read-only file system; not kept"):
            clocked.trial.keep()
    assert clocked.decisions == []
    assert not (folder / "corrections.toml").exists()
    clocked.trial.keep()
    tracks = read_run(folder).tracks
    assert (tracks.attrs["strip_z0"], tracks.attrs["strip_z1"]) == (10, 14)
    assert [one.kind for one in clocked.decisions] == ["strip"]
    assert not clocked.changed
    assert list(folder.parent.glob(".clean.*")) == claimed(folder)

    away = np.abs(tracks["x_px"].values - earlier)
    assert found["compared"] == np.isfinite(away).sum()
    assert found["median_px"] == pytest.approx(np.nanmedian(away), abs=1e-4)
    assert found["error_px"][1] > 1.5 * found["error_px"][0]  # fewer rows, more noise
    np.testing.assert_allclose(seen["after"]["x_px"][3], tracks["x_px"].values[seen["frames"][3]], atol=2e-3)
    new = pd.read_csv(folder / "shells.csv")
    both = shells.merge(new, on=["event", "side"])
    assert sum(side["other"] for side in found["shells"]) == (
        (both["stiff_sheets_x"] != both["stiff_sheets_y"]).sum()
    )
    assert all(side["of"] == len(both) / 2 for side in found["shells"])


def test_tracking_again_can_be_cancelled(clocked):
    """A failure means that a long film holds the review for hours, or that half a run is left."""
    clocked.trial.start({"kind": "strip", "rows": "10:14"})
    clocked.trial.discard()
    assert not clocked.saver.running
    assert clocked.trial.state()["found"] is None
    assert list(clocked.folder.parent.glob(".clean.*")) == claimed(clocked.folder)
    with pytest.raises(InputError, match="track again first"):
        clocked.trial.keep()
    clocked.decide({"kind": "axis", "x_px": 590.0})  # and it goes on


# In place of the process that tracks: it says that it has, as soon as it is asked.
TRACKED_AT_ONCE = """
import json, sys
sys.stdin.buffer.read()
for kind, content in (("found", {}), ("end", "")):
    print(json.dumps([kind, content, 0, 0]))
"""


def test_what_was_tried_out_does_not_outlive_another_decision(clocked, monkeypatch):
    """A failure means that a run is kept that does not follow the decisions made meanwhile."""
    monkeypatch.setattr(saving, "_CHILD", TRACKED_AT_ONCE)
    clocked.trial.start({"kind": "strip", "rows": "10:14"})
    with pytest.raises(InputError, match="being tracked"):
        clocked.decide({"kind": "axis", "x_px": 590.0})
    clocked.saver.wait()
    clocked.decide({"kind": "axis", "x_px": 590.0})
    with pytest.raises(InputError, match="track again first"):
        clocked.trial.keep()


def test_the_shell_before_a_decision_is_the_one_in_the_header(clocked):
    """A failure means that two numbers for one thing stand on one page."""
    seen = clocked.effects.preview({"kind": "swap", "sheets": [2, 30], "frames": "0:"}, 120)
    header = clocked.effects.stick(seen["event"])
    for name in ("sheets", "shells"):
        assert seen["stick_before"][name] == header[name]
    assert seen["stick_after"]["sheets"] != header["sheets"]
    table = pd.read_csv(clocked.folder / "shells.csv").query("event == @seen['event']")
    sizes = {one["side"]: one["stiff_sheets"] for one in header["shells"]}
    for side, known in zip(table["side"], table["stiff_sheets"], strict=True):
        assert abs(sizes[side] - known) <= 1  # from the sticks around in place of all
