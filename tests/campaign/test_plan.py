"""The plan: what is done is known by content and settings; short films share jobs."""

import json
import os
import re
import shutil
from pathlib import Path

import pytest

from tests.campaign.scenes import films, planned, rows
from vision.campaign import jobs
from vision.campaign.films import CampaignSettings
from vision.campaign.plan import (
    PlannedFilm,
    State,
    check_folder,
    make_plan,
    read_plan,
    read_state,
    share,
    vanished_films,
    write_plan,
    write_state,
)
from vision.command.main import run
from vision.errors import InputError


def finish(plan, *names):
    """Runs as a job leaves them, as far as the plan looks."""
    for name in names:
        plan.run_of(name).mkdir(parents=True, exist_ok=True)
        (plan.run_of(name) / "run.json").write_text("{}")
        write_state(plan.out, State(name=name, key=plan.film(name).key, state="done", seconds=2.0))


def waiting(plan):
    return sorted(name for job in plan.jobs.values() for name in job.films)


def test_only_what_changed_runs_again(tmp_path):
    """A failure means that finished work is repeated, or that old results stand for a changed film."""
    paths, out = films(tmp_path, 4), tmp_path / "out"
    plan = planned(out, paths, fps=20.0)
    assert waiting(plan) == ["t0", "t1", "t2", "t3"]
    finish(plan, "t0", "t1", "t2", "t3")
    os.utime(paths[1])  # as a copy does
    assert planned(out, paths, fps=20.0).jobs == {}
    content = paths[2].read_bytes()
    middle = len(content) // 2
    paths[2].write_bytes(content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :])  # one bit
    assert waiting(planned(out, paths, fps=20.0)) == ["t2"]
    assert waiting(planned(out, paths, fps=25.0)) == ["t0", "t1", "t2", "t3"]
    paths[2].write_bytes(content)
    moved = paths[3].rename(tmp_path / "moved.tif")
    assert waiting(make_plan([*rows(paths[:3], fps=20.0), *_named(moved, "t3", fps=20.0)], out)) == []


def _named(path, name, **values):
    row = rows([path], **values)[0]
    return [type(row)(row=9, film=row.film, name=name, values=values)]


def test_films_that_were_done_and_moved_away_stay_in_the_pool(tmp_path):
    """The camera's computer clears its folder; with --watch no table names them."""
    paths, out = films(tmp_path / "camera", 3), tmp_path / "out"
    plan = planned(out, paths)
    finish(plan, "t0", "t2")
    for path in paths[:2]:
        path.unlink()
    gone = vanished_films(out, tmp_path / "camera")
    assert [film.name for film in gone] == ["t0"]  # t1 was never done, t2 is still there
    after = make_plan(rows(paths[2:]), out, earlier=gone)
    assert [film.key for film in after.films] == [plan.film(name).key for name in ("t0", "t2")]
    assert after.jobs == {}


def test_failed_and_vanished_runs_are_done_again(tmp_path):
    """A failure means that a campaign calls films done that have no results."""
    paths, out = films(tmp_path, 2), tmp_path / "out"
    plan = planned(out, paths)
    finish(plan, "t0", "t1")
    write_state(out, State(name="t0", key=plan.film("t0").key, state="failed"))
    (plan.run_of("t1") / "run.json").unlink()
    assert waiting(planned(out, paths)) == ["t0", "t1"]


def test_facts_alone_make_a_new_pool_and_no_new_runs(tmp_path):
    """A failure means that a corrected humidity costs a night of computing, or changes no trend."""
    paths, out = films(tmp_path, 1), tmp_path / "out"
    plan = planned(out, paths)
    finish(plan, "t0")
    row = rows(paths)[0]
    other = make_plan([type(row)(row=2, film=row.film, name="t0", facts={"sample": "new"})], out)
    assert other.jobs == {}
    assert other.pool_key() != plan.pool_key()


def film(name, seconds):
    return PlannedFilm(name=name, film=f"/{name}.avi", options={}, facts={}, key=name, seconds=seconds)


def test_short_films_share_jobs_and_long_ones_do_not():
    """A failure means that starts of processes take longer than the films, or that cores idle at the end."""
    jobs = share([film(f"s{k}", 1.0) for k in range(200)] + [film("long", 600.0)], 1.0, 2)
    assert [f.name for f in jobs[0]] == ["long"]
    sizes = [len(job) for job in jobs[1:]]
    assert sizes == [25] * 8  # even, and enough of them that both cores end together
    assert sum(sizes) == 200
    assert len(share([film(f"s{k}", 1.0) for k in range(6)], 1.0, 2)) == 2
    # what was measured counts: with films twenty times as slow each is a job
    assert len(share([film(f"s{k}", 2.0) for k in range(6)], 20.0, 2)) == 6


def test_a_plan_is_read_as_it_was_written(tmp_path):
    """A failure means that jobs on another machine follow another plan."""
    plan = planned(tmp_path / "out", films(tmp_path, 3), fps=20.0)
    assert read_plan(tmp_path / "out" / "plan.json") == plan


def test_estimates_grow_with_frames_and_columns(tmp_path):
    """What a batch system is asked for."""
    short, long = films(tmp_path / "a", 1)[0], films(tmp_path / "b", 1, frames=300)[0]
    few, many = (make_plan(rows([path]), tmp_path / "o").films[0] for path in (short, long))
    assert (few.frames, many.frames, few.columns) == (30, 300, 180)
    tuning = CampaignSettings()
    more = 270 * 180 / 1e6 * (tuning.seconds_per_megasample + 12e-3 * tuning.seconds_per_gigapixel)
    assert many.seconds - few.seconds == pytest.approx(more, abs=0.02)
    assert not (tmp_path / "o" / "plan.json").exists()


def test_a_force_recording_takes_its_time(tmp_path):
    """A failure means that a dry run states half of the time of short films with their recordings."""
    path, tuning = films(tmp_path, 1)[0], CampaignSettings()
    (tmp_path / "pull.txt").write_text("its content is looked at when it is read")
    alone, pulled = (
        make_plan(rows([path], **more), tmp_path / "o").films[0].seconds
        for more in ({}, {"force": str(tmp_path / "pull.txt")})
    )
    assert pulled - alone == pytest.approx(tuning.force_seconds)


def test_copies_of_one_film_are_jobs_of_their_own(tmp_path):
    """A failure means that jobs of the same content stand for each other, and one of them never runs."""
    path = films(tmp_path, 1)[0]
    copies = [Path(shutil.copy(path, tmp_path / f"c{k}.tif")) for k in range(4)]
    plan = make_plan(rows(copies), tmp_path / "out", cores=2)
    assert len(plan.jobs) == 2
    assert waiting(plan) == ["c0", "c1", "c2", "c3"]


def test_a_film_that_cannot_be_opened_is_tried_all_the_same(tmp_path):
    """A failure means that one bad film stops the whole campaign, or is silently left out."""
    path = tmp_path / "bad.tif"
    path.write_bytes(b"II*\0nothing")
    plan = planned(tmp_path / "out", [path])
    assert waiting(plan) == ["bad"]
    assert "expected a TIFF" in plan.films[0].doubt


@pytest.mark.parametrize(
    ("content", "word"),
    [
        ({"version": "0.1.0", "layout": 1}, "found one of 0.1.0"),
        ({"layout": 99}, "layout 99"),
        (None, "another folder"),
    ],
)
def test_a_folder_that_is_not_this_version_s_campaign_is_left_alone(tmp_path, content, word):
    """A failure means that results of another version are mixed with new ones, or overwritten."""
    out = tmp_path / "out"
    planned(out, films(tmp_path, 1))
    if content is None:
        (out / "plan.json").rename(out / "thesis.txt")
    else:
        (out / "plan.json").write_text(json.dumps(json.loads((out / "plan.json").read_text()) | content))
    before = sorted(out.rglob("*"))
    with pytest.raises(InputError, match=word):
        check_folder(out)
    (tmp_path / "t.csv").write_text("film\nt0.tif\n")
    assert run(["campaign", str(tmp_path / "t.csv"), "--out", str(out)]) == 2
    assert sorted(out.rglob("*")) == before


def test_dry_run_says_what_would_run_and_writes_nothing(tmp_path, capsys):
    """A failure means that looking at a campaign changes it."""
    paths, out = films(tmp_path, 3), tmp_path / "out"
    finish(planned(out, paths, fps=20.0), "t0")
    # the same settings through the command's own defaults are other settings: nothing counts as done
    (tmp_path / "bad.avi").write_bytes(b"no film")
    names = [*(path.name for path in paths), "bad.avi"]
    (tmp_path / "t.csv").write_text("film,fps\n" + "".join(f"{name},20\n" for name in names))
    before = sorted(out.rglob("*"))
    assert run(["campaign", str(tmp_path / "t.csv"), "--out", str(out), "--dry-run"]) == 1
    said = capsys.readouterr().out
    assert "30 frames x 180 px" in said
    assert "3 of 4 films would run" in said
    wall_s = float(re.search(r"([0-9.]+) s with", said)[1])
    assert wall_s >= CampaignSettings().campaign_seconds + CampaignSettings().start_seconds
    assert re.search(r"bad +would fail  .*bad\.avi: expected", said)
    assert "nothing was written" in said
    assert sorted(out.rglob("*")) == before


def test_a_dry_run_names_what_film_and_force_cannot_have(tmp_path, capsys):
    """A failure means that a dry run calls fine what then fails."""
    films(tmp_path, 5)
    rows = "\n".join(f"{k / 10}\t{k % 9}\t{k / 1000}" for k in range(100))
    (tmp_path / "f.txt").write_text(f"Time [s]\tLoad [N]\tDisplacement [mm]\n{rows}\n")
    (tmp_path / "t.txt").write_text("\n".join(str(k / 20) for k in range(7)))
    table = "film,fps,timestamps,strip,window,force,offset\n" + "\n".join(
        (
            "t0.tif,20,,,,f.txt,5",
            "t1.tif,20,,,,f.txt,999",
            "t2.tif,20,,0:5000,,,",
            "t3.tif,20,,,999,,",
            "t4.tif,,t.txt,,,,",
        )
    )
    (tmp_path / "t.csv").write_text(table)
    assert run(["campaign", str(tmp_path / "t.csv"), "--out", str(tmp_path / "out"), "--dry-run"]) == 1
    said = capsys.readouterr().out
    assert re.search(r"t0 +would run +30 frames", said)
    for name, reason in (
        ("t1", "--offset: expected a video within the force recording"),
        ("t2", ".*--strip: expected a range within"),
        ("t3", "--window: expected at most the picture's 180 columns"),
        ("t4", ".*t.txt: expected 30 times"),
    ):
        assert re.search(rf"{name} +would fail +{reason}", said), said
    (tmp_path / "t.csv").write_text("film,fps,window\nt3.tif,20,999\n")
    assert run(["campaign", str(tmp_path / "t.csv"), "--out", str(tmp_path / "out"), "--dry-run"]) == 2


def test_a_dry_run_reads_the_force_of_films_in_storage(tmp_path, capsys, monkeypatch):
    """A failure means that a force recording that cannot be used is found after the film was fetched."""
    monkeypatch.setattr(jobs, "check_engine", lambda *_: None)  # the plugin of the address need not be there
    rows = "\n".join(f"{k / 10}\t{k % 9}\t{k / 1000}" for k in range(100))
    (tmp_path / "good.txt").write_text(f"Time [s]\tLoad [N]\tDisplacement [mm]\n{rows}\n")
    (tmp_path / "bad.txt").write_text(f"Time [s]\tDisplacement [mm]\n{rows}\n")
    (tmp_path / "t.csv").write_text("film,force\ns3://b/one.avi,good.txt\ns3://b/two.avi,bad.txt\n")
    assert run(["campaign", str(tmp_path / "t.csv"), "--out", str(tmp_path / "out"), "--dry-run"]) == 1
    said = capsys.readouterr().out
    assert re.search(r"one +would run +in object storage", said)
    assert re.search(r"two +would fail +.*bad.txt: expected", said), said


def test_a_state_that_cannot_be_read_is_none(tmp_path):
    """A failure means that a state cut off by a power failure stops the campaign."""
    write_state(tmp_path, State(name="x", key="k", state="done"))
    assert read_state(tmp_path, "x").state == "done"
    (tmp_path / "states" / "x.json").write_text('{"name": "x", "st')
    assert read_state(tmp_path, "x") == State(name="x")


def test_planning_again_reads_no_film(tmp_path, monkeypatch):
    """Fingerprints are kept, by size and time of each file."""
    path, out = films(tmp_path, 1)[0], tmp_path / "out"
    copies = [tmp_path / f"c{k}.tif" for k in range(10)]
    for copy in copies:
        os.link(path, copy)
    write_plan(make_plan(rows(copies), out))
    kept = json.loads((out / "fingerprints.json").read_text())
    assert len(kept) == 10
    read = []
    monkeypatch.setattr("vision.campaign.plan.describe_input", read.append)
    make_plan(rows(copies), out)
    assert read == []


def test_a_batch_system_is_asked_for_minutes(tmp_path, monkeypatch):
    """A film of ten minutes with the start of its process, doubled for safety, and five minutes for a slow
    start: 25 minutes.  A failure means that jobs are cut off, or wait for hours in a queue."""
    tuning = CampaignSettings(base_seconds=590.0, start_seconds=9.5, margin=2.0, spare_minutes=5)
    monkeypatch.setattr("vision.campaign.plan.SETTINGS", tuning)
    (job,) = make_plan(rows(films(tmp_path, 1)), tmp_path / "out").jobs.values()
    assert job.seconds == pytest.approx(599.5, abs=0.1)
    assert job.minutes == 25
