"""`track campaign` from the table to the pool, through Snakemake."""

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from tests.campaign.scenes import environment, films, table
from tests.scenes.waiting import until
from vision.campaign.results import open_tables
from vision.command.main import run

pytest.importorskip("snakemake", reason="pip install '.[campaign]'")
HERE = Path(__file__).parents[2]
PAPER = HERE / "fixtures" / "paper"


def states(out):
    with (out / "campaign.csv").open(encoding="utf-8") as file:
        return {Path(row["film"]).stem: row for row in csv.DictReader(file)}


def start(arguments, folder):
    return subprocess.Popen(
        [sys.executable, "-m", "vision.command", "campaign", *map(str, arguments)],
        env=environment(HERE), cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip


@pytest.mark.thorough
def test_all_good_films_are_done_and_the_bad_one_is_named(tmp_path, monkeypatch, capsys):
    """The whole way: a table, one film that is none, two that are done, one of them with its force recording,
    the pool; and a second call that finds nothing to do.
    """
    monkeypatch.setenv("PYTHONPATH", str(HERE))
    films(tmp_path, 1)
    (tmp_path / "bad; $(touch x).tif").write_bytes(b"II*\0nothing")
    path = table(
        tmp_path / "tests.csv", ["t0.tif", PAPER / "video.avi", "bad; $(touch x).tif"], fps=[20, "", 20],
        timestamps=["", PAPER / "timestamps.txt", ""], force=["", PAPER / "force.txt", ""], d0=["", 13, ""],
        sample="old", RH_percent=[40, 41, 42], name=["t0", "paper", "bad"],
    )  # fmt: skip
    out = tmp_path / "out"
    asked = ["campaign", str(path), "--out", str(out), "--cores", "1", "--no-report"]
    assert run(asked) == 1
    said = capsys.readouterr()
    found = states(out)
    assert [found[name]["state"] for name in ("t0", "video", "bad; $(touch x)")] == [
        "done",
        "warnings",
        "failed",
    ]
    assert "clocks ambiguous" in found["video"]["reason"]
    assert "bad: failed: " in said.err
    assert "expected a TIFF" in said.err
    assert "3 tests: 1 done, 1 failed, 1 with warnings; 3 of them run now" in said.out
    assert json.loads((out / "states" / "bad.json").read_text())["attempts"] == 2
    assert not (tmp_path / "x").exists()
    assert not (out / "x").exists()
    assert (out / "runs" / "t0" / "tracks.csv").is_file()
    with (out / "pool" / "tests.csv").open() as file:
        assert [row["run"] for row in csv.DictReader(file)] == ["paper"]
    assert open_tables(out, "sticks").count_rows() == 57
    assert open_tables(out, "positions").count_rows() == 30 * 8 + 300 * 50
    page = (out / "index.html").read_text()
    assert 'http-equiv="refresh"' not in page
    assert page.count("data:image/png;base64") == 2

    (tmp_path / "bad; $(touch x).tif").unlink()
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:3]))
    made = (out / "runs" / "paper" / "run.json").stat().st_mtime_ns
    log = (out / "snakemake.log").stat().st_size
    pooled = (out / "pool" / "run.json").stat().st_mtime_ns
    assert run(asked) == 1  # the warnings still matter
    assert "2 tests: 1 done, 1 with warnings; 0 of them run now" in capsys.readouterr().out
    assert (out / "runs" / "paper" / "run.json").stat().st_mtime_ns == made
    assert (out / "pool" / "run.json").stat().st_mtime_ns == pooled
    assert (out / "snakemake.log").stat().st_size == log


@pytest.mark.thorough
def test_a_campaign_of_bad_films_alone_ends_with_two(tmp_path, monkeypatch):
    """A failure means that a script takes a campaign without any result for one with warnings."""
    monkeypatch.setenv("PYTHONPATH", str(HERE))
    (tmp_path / "bad.tif").write_bytes(b"II*\0nothing")
    path = table(tmp_path / "tests.csv", ["bad.tif"], fps=[20])
    assert run(["campaign", str(path), "--out", str(tmp_path / "out"), "--cores", "1", "--no-report"]) == 2


@pytest.mark.slow
def test_an_interrupt_keeps_what_is_done_and_ends_all_it_started(tmp_path):
    """Ctrl-C, or a closed terminal: no process is left, the next call goes on."""
    films(tmp_path, 12, frames=200)
    path, out = table(tmp_path / "t.csv", [f"t{k}.tif" for k in range(12)], fps=20), tmp_path / "out"
    process = start([path, "--out", out, "--no-report"], tmp_path)
    until(lambda: sum('"done"' in file.read_text() for file in out.glob("states/*.json")) >= 2)
    process.send_signal(signal.SIGTERM)
    assert process.wait(60) == 130
    left = subprocess.run(["pgrep", "-f", str(out)], capture_output=True, text=True, check=False).stdout
    assert left == ""
    assert not list(out.rglob(".*.part"))
    words = {row["state"] for row in states(out).values()}
    assert words == {"done", "waiting"}
    before = {file: file.stat().st_mtime_ns for file in out.glob("runs/*/run.json")}
    assert start([path, "--out", out, "--no-report"], tmp_path).wait(170) == 0
    assert {row["state"] for row in states(out).values()} == {"done"}
    assert all(file.stat().st_mtime_ns == made for file, made in before.items())


@pytest.mark.slow
def test_two_campaigns_in_one_folder(tmp_path, capsys):
    """The second is refused in one line."""
    films(tmp_path, 2, frames=200)
    path, out = table(tmp_path / "t.csv", ["t0.tif", "t1.tif"], fps=20), tmp_path / "out"
    process = start([path, "--out", out, "--no-report"], tmp_path)
    until((out / "snakemake.log").exists)
    assert run(["campaign", str(path), "--out", str(out)]) == 2
    assert "a campaign that is not running; found a running one" in capsys.readouterr().err
    assert process.wait(100) == 0


@pytest.mark.slow
def test_watching_takes_films_as_they_come(tmp_path):
    """The camera's computer writes one film after the other; a row of the table gives one its settings."""
    source, camera, out = tmp_path / "source", tmp_path / "camera", tmp_path / "out"
    camera.mkdir()
    made = films(source, 3)
    path = table(tmp_path / "t.csv", ["camera/t1.tif"], fps=25, RH_percent=40)
    (tmp_path / "setup.toml").write_text("fps = 20\n")
    shutil.copy(made[0], camera)
    asked = [path, "--watch", camera, "--out", out, "--config", tmp_path / "setup.toml", "--idle", 25]
    process = start([*asked, "--no-report"], tmp_path)
    until((out / "runs" / "t0" / "run.json").exists)
    shutil.copy(made[1], camera)
    (camera / "t2.tif").write_bytes(made[2].read_bytes()[:5000])  # it breaks off
    assert process.wait(120) == 0
    assert sorted(row["state"] for row in states(out).values()) == ["done", "done"]
    rates = [json.loads((out / "runs" / name / "run.json").read_text()) for name in ("t0", "t1")]
    assert [rate["parameters"]["fps"]["value"] for rate in rates] == [20.0, 25.0]


@pytest.mark.slow
def test_films_in_object_storage_are_fetched(tmp_path, capsys):
    """One that is not there is named, and keeps no other from being done; so is a plugin that is missing."""
    path = table(tmp_path / "t.csv", ["nowhere://bucket/a.tif"])
    assert run(["campaign", str(path)]) == 2
    assert "pip install snakemake-storage-plugin-nowhere" in capsys.readouterr().err
    pytest.importorskip("snakemake_storage_plugin_http", reason="pip install snakemake-storage-plugin-http")
    films(tmp_path / "served", 2)

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *words):
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=tmp_path / "served")) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        base = f"http://127.0.0.1:{server.server_port}"
        names = [f"{base}/t0.tif", f"{base}/gone.tif", "served/t1.tif"]
        table(path, names, fps=20)
        out = tmp_path / "out"
        assert start([path, "--out", out, "--no-report"], tmp_path).wait(170) == 1
        server.shutdown()
    found = states(out)
    assert [found[name]["state"] for name in ("t0", "gone", "t1")] == ["done", "failed", "done"]
    assert found["gone"]["reason"] == f"{base}/gone.tif: expected a film in storage; found none"


@pytest.mark.slow
def test_snakemake_alone_does_the_same(tmp_path):
    """The Snakefile needs no `track campaign` beside it."""
    from vision.campaign.jobs import HERE, SNAKEFILE

    films(tmp_path, 2)
    path, out = table(tmp_path / "t.csv", ["t0.tif", "t1.tif"], fps=20), tmp_path / "out"
    for target in ("films", "pool"):
        subprocess.run(
            [sys.executable, "-m", "snakemake", "-s", SNAKEFILE, "--profile", HERE / "profiles" / "local",
             "--config", f"table={path}", f"out={out}", "--", target],
            env=environment(HERE), cwd=tmp_path, check=True, capture_output=True, timeout=100,
        )  # fmt: skip
    assert sorted(run.name for run in (out / "runs").iterdir()) == ["t0", "t1"]
    assert open_tables(out, "tests").count_rows() == 2


@pytest.mark.slow
def test_two_hundred_films_cost_little_more_than_their_analysis(tmp_path):
    """CPU time of a campaign against that of single calls, which start a process each: at most 1.1 of it.

    Compared in CPU time, as both cores are busy all the time and other programs may be, too.
    """
    count = 60  # as many a job as of two hundred: see test_plan
    films(tmp_path, count, frames=60)
    path = table(tmp_path / "t.csv", [f"t{k}.tif" for k in range(count)], fps=20)
    spent = []
    for arguments in (["campaign", path, "--out", "out"], ["t0.tif", "--fps", "20", "--out", "single"]):
        before = os.times()
        subprocess.run(
            [sys.executable, "-m", "vision.command", *map(str, arguments)],
            env=environment(HERE), cwd=tmp_path, check=True, capture_output=True, timeout=600,
        )  # fmt: skip
        after = os.times()
        spent.append(
            after.children_user + after.children_system - before.children_user - before.children_system
        )
    assert spent[0] < 1.1 * count * spent[1]
    assert spent[0] < 0.6 * count * spent[1]  # 0.35 here; one process a film gives 1.1
