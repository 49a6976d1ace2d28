"""Disks that stop answering while a campaign is planned, a folder is watched, or a film is copied."""

import os
import threading
from functools import partial
from pathlib import Path

import pytest

from tests.campaign.scenes import films, planned, rows, table
from vision.campaign import films as films_of_campaign
from vision.campaign import jobs, plan
from vision.campaign.films import FolderWatch, read_campaign
from vision.campaign.jobs import _source, copy_or_give_up
from vision.campaign.plan import State, make_plan, vanished_films, write_state
from vision.errors import InputError
from vision.files import answered, prefetch


@pytest.fixture(autouse=True)
def short_wait(monkeypatch):
    """A disk is given up after 0.2 s."""
    for module in (films_of_campaign, plan, jobs):
        monkeypatch.setattr(module, "answered", partial(answered, answer_s=0.2))
    monkeypatch.setattr(jobs, "prefetch", partial(prefetch, answer_s=0.2))


@pytest.fixture
def dies(monkeypatch):
    """dies(path, name): from now on the method of that name never returns for that path."""
    lost = threading.Event()

    def kill(path, name):
        real = getattr(Path, name)

        def dead(self, *arguments, **options):
            return lost.wait(20) if self == path else real(self, *arguments, **options)

        monkeypatch.setattr(Path, name, dead)

    yield kill
    lost.set()


@pytest.mark.parametrize(
    ("name", "asked"), [("t1.tif", "exists"), ("f.csv", "is_file"), ("table.csv", "read_bytes")]
)
def test_a_table_whose_disk_dies_ends_in_one_line(tmp_path, dies, name, asked):
    """A failure means that `track campaign` waits for ever, without a word, for a connection that is lost."""
    paths = films(tmp_path, 2)
    (tmp_path / "f.csv").write_text("")
    file = table(tmp_path / "table.csv", [path.name for path in paths], force="f.csv")
    dies(tmp_path / name, asked)
    with pytest.raises(InputError, match=r"expected a disk .* answers; found no answer for 0\.2 s") as caught:
        read_campaign(
            file,
            options=("force",),
            check=lambda _: ({}, []),
            name_of=lambda p: p.stem,
        )
    assert ("table.csv" if name == "table.csv" else "t0.tif" if name == "f.csv" else name) in str(
        caught.value
    )


@pytest.mark.parametrize("asked", ["stat", "open"])
def test_a_plan_whose_disk_dies_ends_in_one_line(tmp_path, dies, asked):
    """A failure means the same for the fingerprints and headers of the films."""
    paths = films(tmp_path, 2)
    dies(paths[1], asked)
    with pytest.raises(InputError, match=r"t1\.tif: expected a disk .* no answer for 0\.2 s"):
        make_plan(rows(paths), tmp_path / "out")


@pytest.mark.parametrize("asked", ["iterdir", "is_dir"])
def test_a_watched_folder_whose_disk_dies_ends_in_one_line(tmp_path, dies, asked):
    """A failure means that a campaign that watches a camera's folder stands still, unnoticed."""
    folder = films(tmp_path / "camera", 1)[0].parent
    watch = FolderWatch(folder)
    dies(folder, asked)
    with pytest.raises(InputError, match=r"camera: expected a disk .* no answer for 0\.2 s"):
        FolderWatch(folder) if asked == "is_dir" else watch.rows([], lambda _: None)


def test_a_film_that_left_a_folder_whose_disk_dies(tmp_path, dies):
    """A failure means that the second run of a watched campaign never begins."""
    paths = films(tmp_path / "camera", 1)
    plan = planned(tmp_path / "out", paths)
    plan.run_of("t0").mkdir(parents=True)
    (plan.run_of("t0") / "run.json").write_text("{}")
    write_state(plan.out, State(name="t0", key=plan.films[0].key, state="done"))
    dies(paths[0], "exists")
    with pytest.raises(InputError, match=r"camera: expected a disk .* no answer for 0\.2 s"):
        vanished_films(tmp_path / "out", tmp_path / "camera")


def test_a_film_whose_disk_dies_before_it_is_copied(tmp_path, dies):
    """A failure means that a job holds its node until the batch system kills it."""
    paths = films(tmp_path, 1)
    film = planned(tmp_path / "out", paths).films[0]
    dies(paths[0], "is_file")
    told = pytest.raises(InputError, match=r"t0\.tif: expected a disk .* no answer for 0\.2 s")
    with told, _source(film, {}, stage=True):
        pass


@pytest.mark.posix
def test_a_copy_that_stalls_is_one_line_and_no_hang(tmp_path):
    """A failure means that a file server which stops answering stops a campaign for ever."""
    pipe, film = tmp_path / "pipe.avi", tmp_path / "film.avi"
    os.mkfifo(pipe)
    with pipe.open("r+b", buffering=0) as end:
        end.write(bytes(1000))
        with pytest.raises(InputError, match=r"pipe\.avi: expected a disk .* no answer for 0\.2 s"):
            copy_or_give_up(pipe, tmp_path / "copy")
    film.write_bytes(bytes(1000))
    copy_or_give_up(film, tmp_path / "copy")
    assert (tmp_path / "copy").read_bytes() == bytes(1000)
    with pytest.raises(FileNotFoundError):
        copy_or_give_up(tmp_path / "none.avi", tmp_path / "copy")
