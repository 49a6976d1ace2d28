"""Runs read back: finished ones, and what an interrupted one kept."""

from __future__ import annotations

import errno
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from tests.scenes.comb_video import write_video
from tests.scenes.films import comb, write_avi, write_encoded
from vision.command.main import run
from vision.errors import InputError
from vision.folder import clean_up, reading_folder, run_folder
from vision.run.reading import Checkpoint, RunFolder, read_run, read_strip
from vision.video import VideoSettings, open_video, strip_profile


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    place = tmp_path_factory.mktemp("run")
    words = [str(write_video(place / "comb.tif")), "--quiet", "--no-report", "--out", str(place / "run")]
    assert run(words) == 0
    return place / "run"


@pytest.fixture
def folder(finished, tmp_path):
    return Path(shutil.copytree(finished, tmp_path / "run"))


def test_a_diagram_that_shrinks_after_it_was_read_is_whole(folder):
    """A failure means that `track kymograph RUN` is killed (SIGBUS) where another program cuts the file."""
    strip = read_strip(read_run(folder))
    before = strip.values.copy()
    os.truncate(folder / "kymograph.tif", 1000)
    assert np.array_equal(strip.values, before)
    assert strip.shape == (60, 180)


@pytest.mark.parametrize(("name", "value"), [("offset_s", {}), ("matched_s", ["x"]), ("matched", [])])
def test_a_clock_that_holds_no_numbers_is_one_line(name, value, folder):
    """A failure means that a damaged clock.json ends in a traceback."""
    whole = {"offset_s": 1.0, "drift_ppm": None, "matched_s": [1.5], "unmatched_video": 0}
    whole |= {"unmatched_force": 0, "matched": 4, "status": "ok", "how": "events"}
    (folder / "clock.json").write_text(json.dumps(whole))
    assert read_run(folder).clock.matched_s == (1.5,)
    (folder / "clock.json").write_text(json.dumps(whole | {name: value}))
    with pytest.raises(InputError, match=r"clock\.json"):
        _ = read_run(folder).clock


@pytest.mark.parametrize("cell", ["\u2028", "broken", "1,5"])
def test_text_among_the_numbers_of_a_table_is_one_line(cell, folder):
    """A failure means that a damaged or edited table ends in a traceback, or that its events go missing."""
    path = folder / "events.csv"
    path.write_text(f'event,t_p_s,flag\n0,1.5,ok\n1,"{cell}",ok\n', encoding="utf-8")
    with pytest.raises(InputError, match="t_p_s"):
        read_run(folder).table("events")
    path.write_text("event,t_p_s,knee,flag\n0,1.5,True,ok\n1,,,low force\n", encoding="utf-8")
    table = read_run(folder).table("events")
    assert table is not None and table["t_p_s"].isna().tolist() == [False, True]


def test_a_table_that_was_cut_is_one_line(folder):
    """A failure means that a copy which a full disk cut is compared with half of its events."""
    path = folder / "events.csv"
    whole = "event,t_p_s,flag\n0,1.5,ok\n1,2.25,ok\n"
    for size in range(len("event,t_p_s,flag\n0,"), len(whole)):
        if whole[size - 1] != "\n":
            path.write_text(whole[:size], encoding="utf-8")
            with pytest.raises(InputError, match=r"events\.csv"):
                read_run(folder).table("events")


@pytest.mark.parametrize("size", [0, 5, 500, 20_000])
def test_a_diagram_that_was_cut_is_one_line(size, folder):
    """A failure means a traceback, or zeros in place of what is missing."""
    os.truncate(folder / "kymograph.tif", size)
    with pytest.raises(InputError) as caught:
        read_strip(read_run(folder))
    assert "\n" not in str(caught.value)


def test_a_diagram_may_be_larger_than_any_frame(folder, monkeypatch):
    """A failure means that the diagram of a long film, over 100 million values, is refused."""
    monkeypatch.setattr("vision.files.MOST_PIXELS", 1000)
    assert read_strip(read_run(folder)).shape == (60, 180)


@pytest.mark.parametrize(("which", "advice"), [("film", "new path"), ("force", "put it back")])
def test_a_lost_input_is_named_with_advice_that_can_be_followed(which, advice, folder):
    """A failure means that a lost force recording is to be given with an option that is the film's."""
    lost = {"inputs": [{"path": "lost"}, {"path": "lost"}], "parameters": {"force": {"value": "lost"}}}
    with pytest.raises(InputError, match=f"^lost: .* found no such file; .*{advice}"):
        RunFolder(folder, lost).input(which)


# --- what an interrupted run kept ---------------------------------------------------------------------------


ROWS = slice(2, 10)
SETTINGS = VideoSettings(resume_after_s=0.0)
STOP_AT = 500
FORMATS = {
    "a.avi": write_avi,
    "mjpeg.avi": lambda path, frames: encoded(path, frames, "mjpeg", "yuvj420p"),
    "h264.mkv": lambda path, frames: encoded(path, frames, "libx264", "yuv420p"),
}


def encoded(path, frames, codec, pix_fmt):
    return write_encoded(path, frames[:, :, :48], codec=codec, pix_fmt=pix_fmt, source="gray")


@pytest.fixture(scope="module")
def frames():
    return comb(count=1200)


@pytest.fixture
def film(tmp_path, frames):
    return write_avi(tmp_path / "a.avi", frames)


def profile(video, target, *, resume=False, stop_at=None, **how):
    """The strip, and the frames taken over; as if Ctrl-C came once `stop_at` frames are read."""

    def progress(done, total):
        if stop_at is not None and done >= stop_at:
            raise KeyboardInterrupt

    with Checkpoint(target, resume=resume, after_s=0) as log:
        rows = how.pop("rows", ROWS)
        strip = strip_profile(open_video(video, **how), rows, progress=progress, log=log)
        return strip, log.resumed


def interrupt(video, target, **how):
    with pytest.raises(KeyboardInterrupt):
        profile(video, target, stop_at=STOP_AT, **how)


@pytest.mark.parametrize("name", FORMATS)
def test_the_result_is_that_of_one_run_bit_for_bit(name, tmp_path, frames):
    """A failure means that a resumed run reports other positions, or frames twice or never."""
    film = FORMATS[name](tmp_path / name, frames)
    whole = strip_profile(open_video(film), ROWS)
    interrupt(film, tmp_path / "out")
    strip, resumed = profile(film, tmp_path / "out", resume=True)
    assert STOP_AT <= resumed < 1200
    assert strip.identical(whole)
    assert strip.values.tobytes() == whole.values.tobytes()


def test_a_run_can_be_interrupted_again_and_again(film, tmp_path):
    """A failure means that the second kill loses what the first had left."""
    whole = strip_profile(open_video(film), ROWS)
    for stop_at in (300, 600, 900):
        with pytest.raises(KeyboardInterrupt):
            profile(film, tmp_path / "out", resume=True, stop_at=stop_at)
    strip, resumed = profile(film, tmp_path / "out", resume=True)
    assert resumed >= 900
    assert strip.identical(whole)


def test_a_record_cut_by_the_kill_is_left_out(film, tmp_path):
    """A failure means that half a row, or a block a crash left unwritten, becomes a frame."""
    interrupt(film, tmp_path / "out")
    kept = reading_folder(tmp_path / "out") / "frames"
    record = 9 + 4 * 50
    os.truncate(kept, 400 * record + 100)
    with kept.open("r+b") as file:
        file.seek(390 * record)
        file.write(bytes(10 * record))
    strip, resumed = profile(film, tmp_path / "out", resume=True)
    assert resumed == 390
    assert strip.identical(strip_profile(open_video(film), ROWS))


def test_a_kill_while_the_facts_are_written_costs_only_the_frames(film, tmp_path, monkeypatch):
    """A failure means that a run that was killed at the wrong moment cannot be resumed."""

    def half(content, path):
        path.write_text('{"strip": [')
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("vision.run.reading.write_json", half)
        with pytest.raises(KeyboardInterrupt):
            profile(film, tmp_path / "out")
    strip, resumed = profile(film, tmp_path / "out", resume=True)
    assert resumed == 0
    assert strip.identical(strip_profile(open_video(film), ROWS))


def test_damaged_facts_say_what_to_do(film, tmp_path):
    """A failure means that "run track again" is advised to someone who just did."""
    interrupt(film, tmp_path / "out")
    (reading_folder(tmp_path / "out") / "reading.json").write_text("")
    with pytest.raises(InputError, match="run without `resume`"):
        profile(film, tmp_path / "out", resume=True)


@pytest.mark.parametrize(
    ("name", "now"),
    [
        ("strip", {"rows": slice(3, 10)}),
        ("rotate", {"rotate": 180}),
        ("fps", {"fps": 50.0}),
        ("frames", {"frames": slice(10, 1100)}),
    ],
)
def test_other_settings_are_refused_in_one_line(name, now, film, tmp_path):
    """A failure means that rows averaged in two ways are joined into one I(x, t)."""
    interrupt(film, tmp_path / "out")
    with pytest.raises(InputError, match=rf"{name}.*as before, to resume.*`resume`") as caught:
        profile(film, tmp_path / "out", resume=True, **now)
    assert "\n" not in str(caught.value)
    assert profile(film, tmp_path / "out", resume=True)[1] >= STOP_AT  # what was kept is kept


def test_another_film_is_refused(film, tmp_path, frames):
    """A failure means that two films are joined."""
    interrupt(film, tmp_path / "out")
    write_avi(film, frames[::-1])
    with pytest.raises(InputError, match="the same film, to resume"):
        profile(film, tmp_path / "out", resume=True)


def test_without_resume_what_was_kept_is_removed(film, tmp_path):
    """A failure means that hidden files pile up, or that a new run is not new."""
    interrupt(film, tmp_path / "out")
    assert profile(film, tmp_path / "out")[1] == 0
    interrupt(film, tmp_path / "out")
    clean_up(tmp_path / "out")
    assert [p.name for p in tmp_path.iterdir()] == ["a.avi"]


def test_nothing_is_kept_of_a_short_reading_or_after_the_run(film, tmp_path):
    """A failure means that every film is written twice, or that leftovers stay beside the results."""
    with Checkpoint(tmp_path / "out") as log:
        strip_profile(open_video(film), ROWS, log=log)
        assert not reading_folder(tmp_path / "out").exists()
    with Checkpoint(tmp_path / "out", after_s=0) as log:
        strip_profile(open_video(film), ROWS, log=log)
        with run_folder(tmp_path / "out") as folder:
            (folder / "run.json").write_text("{}")
        assert log.kept == 1200  # writing the run folder does not clear what is in use
        log.remove()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.avi", "out"]


def test_two_runs_into_one_folder_do_not_share_what_they_keep(film, tmp_path):
    """A failure means that rows of two processes are mixed in one file."""
    with Checkpoint(tmp_path / "out", after_s=0) as first:
        strip_profile(open_video(film), ROWS, log=first)
        strip, _ = profile(film, tmp_path / "out")
        assert (first.kept, strip.sizes["frame"]) == (1200, 1200)
        assert (reading_folder(tmp_path / "out") / "frames").stat().st_size == 1200 * (9 + 4 * 50)
        with pytest.raises(InputError, match="still running"):
            profile(film, tmp_path / "out", resume=True)


def test_a_full_disk_costs_only_what_could_be_resumed(film, tmp_path, monkeypatch):
    """A failure means that keeping the frames ends a run that would have fitted."""

    def full(self, part):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Checkpoint, "_write", full)
    strip, _ = profile(film, tmp_path / "out")
    assert strip.sizes["frame"] == 1200
    assert [p.name for p in tmp_path.iterdir()] == ["a.avi"]
