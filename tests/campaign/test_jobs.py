"""One job: each failure, however hard, is kept to its film."""

import ctypes
import faulthandler
import json
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

import vision
from tests.campaign.scenes import films, planned
from vision.campaign.jobs import SNAKEFILE, close_states, run_job
from vision.campaign.results import needs_pool, open_tables, pool, write_page
from vision.errors import InputError
from vision.folder import run_folder
from vision.run.provenance import Origin
from vision.sheets import track_sheets  # noqa: F401  # imported once, before the job forks

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="a job has no functions that a test defines")


def keep(target, **facts):
    """A run folder of few files."""
    target.mkdir(parents=True)
    (target / "run.json").write_text(json.dumps({"frames": {"read": 30, "lost": 0}} | facts))
    return ""


def states(plan):
    return {film.name: plan.state(film).state for film in plan.films}


def job_of(plan):
    (job,) = plan.jobs
    return job


def test_the_page_counts_the_frames_that_were_read(tmp_path):
    """A failure means that a film that breaks off looks whole."""
    plan = planned(tmp_path / "out", films(tmp_path, 1))
    assert run_job(plan, job_of(plan), lambda *one: keep(one[2], frames={"read": 17})) == 0
    write_page(plan, live=False)
    text = (plan.out / "index.html").read_text(encoding="utf-8")
    assert '<td class="n">17</td>' in text and '<td class="n">30</td>' not in text


def crash(parent, film, source, target):
    """Analyse a film; some end their process."""
    assert os.getpid() != parent
    if film.name == "t1":
        faulthandler.disable()
        ctypes.string_at(0)
    if film.name == "t3":
        os.kill(os.getpid(), signal.SIGKILL)
    return keep(target)


@pytest.mark.parametrize("system", ["linux", "darwin"])
def test_a_crash_costs_its_film_and_no_other(system, tmp_path, monkeypatch):
    """A failure means that a decoder's segmentation fault, or one film's memory, ends the night."""
    monkeypatch.setattr("sys.platform", system)
    plan = planned(tmp_path / "out", films(tmp_path, 5))
    work = partial(crash, os.getpid())
    assert run_job(plan, job_of(plan), work) == 1
    assert states(plan) == {"t0": "done", "t1": "failed", "t2": "done", "t3": "failed", "t4": "done"}
    reasons = [plan.state(plan.film(name)).reason for name in ("t1", "t3")]
    assert "signal 11 (Segmentation fault)" in reasons[0]
    assert "signal 9 (Killed)" in reasons[1]


def test_a_second_attempt_takes_only_what_is_not_done(tmp_path):
    """Snakemake repeats the job once: a passing fault is over then, and nothing is done twice."""
    plan, tried = planned(tmp_path / "out", films(tmp_path, 3)), tmp_path / "tried"
    tried.touch()

    def work(film, source, target):
        with tried.open("a") as file:
            file.write(f"{film.name}\n")
        if film.name == "t1" and tried.read_text().count("t1") == 1:
            return "the file server is away"
        return keep(target)

    assert run_job(plan, job_of(plan), work) == 1
    assert plan.state(plan.film("t1")).reason == "the file server is away"
    assert run_job(plan, job_of(plan), work) == 0
    assert tried.read_text().split() == ["t0", "t1", "t2", "t1"]
    assert plan.state(plan.film("t1")).attempts == 2


LATE = {"not_measured": {"clock": "no slips", "motion": "unexpected KeyError: x"}, "failures": ["motion"]}


@pytest.mark.parametrize(
    ("facts", "state", "reason"),
    [
        ({}, "done", ""),
        ({"warnings": ["one"]}, "warnings", "one"),
        ({"warnings": ["w" * 400, "two", "three"]}, "warnings", f"{'w' * 299}… (and 2 more)"),
        ({"warnings": ["one"], "not_measured": {"sticks": "no slips"}}, "partial", "no slips"),
        ({"not_measured": {"fits": "no separation"}}, "done", ""),
        (LATE, "partial", "no slips"),
        (
            LATE | {"not_measured": {"fits": "unexpected ValueError"}, "failures": ["fits"]},
            "partial",
            "unexpected",
        ),
        ({"failures": ["pictures and report"]}, "partial", "unexpected error: "),
    ],
)
def test_states_follow_what_run_json_says(tmp_path, facts, state, reason):
    """A failure means that a refused force recording is not seen, or costs a second pass over 100 GB, or that
    a run is judged in another way once it was corrected in a review."""
    plan = planned(tmp_path / "out", films(tmp_path, 1))
    assert run_job(plan, job_of(plan), lambda *one: keep(one[2], **facts)) == 0
    first = plan.state(plan.film("t0"))
    assert (first.state, first.frames) == (state, 30)
    assert first.reason.startswith(reason) and bool(first.reason) == bool(reason)
    run = plan.run_of("t0") / "run.json"
    run.write_text(json.dumps(json.loads(run.read_text()) | {"corrections": []}))
    assert needs_pool(plan)
    pool(plan, Origin(command="track campaign"))
    later = plan.state(plan.film("t0"))
    assert later.run != first.run
    assert replace(later, run=first.run, at=first.at) == first


def test_the_page_shows_mu_and_the_stiff_sheets(tmp_path):
    """A failure means that the page of a campaign shows no result, or one without its errors."""

    def work(film, source, target):
        kept = keep(target)
        mu = {"value": 0.8896, "error": 0.00017, "systematic_error": 0.0065}
        (target / "models.json").write_text(json.dumps({"mu": mu}))
        (target / "shells.csv").write_text("event,side,stiff_sheets\n1,-1,6\n1,1,8\n2,-1,8\n2,1,\n")
        return kept

    plan = planned(tmp_path / "out", films(tmp_path, 1))
    assert run_job(plan, job_of(plan), work) == 0
    write_page(plan, live=False)
    page = (plan.out / "index.html").read_text(encoding="utf-8")
    for shown in ("0.8896 ± 0.0065", "8 (6 to 8)"):
        assert f">{shown}<" in page


def test_staged_films_are_read_from_the_node_s_disk(tmp_path, monkeypatch):
    """A failure means that a node reads over the network after all, keeps the copy, or fills its disk."""
    disk = tmp_path / "scratch"
    disk.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(disk))
    paths = films(tmp_path, 1)
    plan = replace(planned(tmp_path / "out", paths), stage=True)
    seen = tmp_path / "seen"

    def work(film, source, target):
        assert source.read_bytes() == paths[0].read_bytes()
        seen.write_text(str(source))
        return keep(target)

    assert run_job(plan, job_of(plan), work) == 0
    assert disk in Path(seen.read_text()).parents
    assert not any(disk.iterdir())

    def full(path):
        return os.statvfs_result((0,) * 10) if path is None else type("Usage", (), {"free": 1000})()

    monkeypatch.setattr("shutil.disk_usage", full)
    (plan.run_of("t0") / "run.json").unlink()
    assert run_job(plan, job_of(plan), work) == 1
    reason = plan.state(plan.film("t0")).reason
    assert "expected room for" in reason
    assert str(disk) in reason


def small_disk(folder, size):
    """A file system of its own, or a skip where there are no rights to mount one."""
    folder.mkdir()
    if shutil.which("mount") is None:
        pytest.skip("no program mounts file systems")
    made = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={size}", "none", folder], capture_output=True, check=False
    )
    if made.returncode:
        pytest.skip("no right to mount a small file system")


def test_a_full_disk_in_the_middle(tmp_path, monkeypatch):
    """One line for each film that found no room; what was finished before is kept and can be opened."""
    paths = films(tmp_path, 4)
    run = vision.save_run(vision.analyse(paths[0], fps=20.0), tmp_path / "run", report=False)
    small_disk(tmp_path / "disk", "1500k")
    try:
        out = tmp_path / "disk" / "out"
        plan = planned(out, paths)

        def work(film, source, target):
            try:
                with run_folder(target) as folder:
                    for name in ("run.json", "tracks.nc"):
                        shutil.copy(run / name, folder)
                    (folder / "kymograph.tif").write_bytes(bytes(600_000))
            except InputError as error:
                return str(error)
            return ""

        assert run_job(plan, job_of(plan), work) == 1
        close_states(plan)
        found = [plan.state(film) for film in plan.films]
        assert found[0].state == "done"
        assert found[-1].state == "failed"
        assert all("full" in state.reason for state in found if state.state == "failed")
        done = [state.name for state in found if state.state == "done"]
        assert open_tables(out, "positions").count_rows() >= 240 * len(done)
        assert not list(out.rglob(".*.part"))
        filler = out / "filler"
        with pytest.raises(OSError, match="space"), filler.open("wb") as file:
            while True:
                file.write(bytes(4096))
        with pytest.raises(InputError, match=r"index\.html: expected a place that can be written"):
            write_page(plan, live=False)
    finally:
        subprocess.run(["umount", "-l", tmp_path / "disk"], check=True)


def test_jobs_are_quoted_as_the_command_prompt_of_windows_needs(monkeypatch):
    """A failure means that no film of a campaign is tracked on Windows."""
    settings, _, _ = SNAKEFILE.read_text(encoding="utf-8").partition('if "plan" in config')
    found = {"config": {}}
    with monkeypatch.context() as windows:
        windows.setattr("os.name", "nt")
        windows.setattr("sys.executable", "C:\\my programs\\python.exe")
        exec(settings, found)
    assert found["TRACK"] == '"C:\\my programs\\python.exe" -P -m vision.command'
