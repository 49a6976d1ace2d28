"""`track review`: what it prints, and when it does not begin."""

import importlib.util
import shutil
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest

from tests.scenes.reviewed import SETTINGS, VIDEO, write_planted
from vision.command.main import run
from vision.command.settings import settings_of_run
from vision.review.session import Session

pytestmark = pytest.mark.usefixtures("without_pictures")

HOME = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_planted(tmp_path_factory.mktemp("review") / "run")


def test_a_run_has_the_settings_that_it_was_made_with(folder):
    """A failure means that saving analyses by other settings than the run."""
    found = settings_of_run(folder)
    assert found.pixel_size_um == SETTINGS.pixel_size_um
    assert found.d0_mm == SETTINGS.d0_mm
    assert found.fps == SETTINGS.fps
    assert found.corrections == ()


def test_without_the_extra_it_says_what_to_install(folder, monkeypatch, refused):
    """A failure means a traceback of a missing package."""
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "uvicorn" else found(name))
    assert "pip install -c constraints.txt '.[review]'" in refused("review", folder)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["nowhere.avi"], "nowhere.avi: expected a run folder or a video"),
        (["RUN", "--film", "OTHER"], "other.avi: expected an input of"),
        (["RUN", "--film", "gone.avi"], "gone.avi: expected an input of"),
        (["RUN", "--pixel-size", "3"], "without further options; found --pixel-size; give"),
    ],
)
def test_what_cannot_be_reviewed_is_one_line(folder, arguments, says, tmp_path, refused):
    """A failure means a traceback, or options that are taken and do nothing."""
    (other := tmp_path / "other.avi").write_bytes(b"RIFF")
    meant = {"RUN": folder, "OTHER": other}
    assert says in refused("review", *(meant.get(name, name) for name in arguments))


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("run.json", b'{"parameters": {}, "corrections": [{"sheet": 3}]}'),
        ("run.json", b'{"parameters": {"fps": 3}}'),
        ("corrections.toml", b"[[swap"),
        ("corrections.toml", b'[[swap]]\nsheets = [3, 99]\nframes = "0:"\ndate = "2027-01-01"'),
        ("clock.json", b'{"offset": 3}'),
        ("events.csv", b"a,b\n1,2,3\n"),
        ("kymograph.tif", b"II*\0"),
        ("tracks.nc", b"nothing"),
    ],
)
def test_a_damaged_run_is_one_line(folder, tmp_path, name, content, capsys):
    """A failure means a traceback, or a server that starts on half a run."""
    copy = shutil.copytree(folder, tmp_path / "run")
    (copy / name).write_bytes(content)
    assert run(["review", str(copy), "--no-browser"]) == 2
    said = capsys.readouterr().err
    assert "Traceback" not in said
    assert said.count("\n") == 1


def test_decisions_of_another_film_are_a_warning(folder, tmp_path, capsys):
    """The run's own corrections.toml is taken without a word; one that names another film is not."""
    own = (folder / "corrections.toml").read_text()
    video = [str(VIDEO), "--fps", "60", "--no-report", "--quiet"]
    for name, text in (("own.toml", own), ("other.toml", own.replace('film = "', 'film = "0'))):
        Path(name).write_text(text)
        run([*video, "--corrections", name, "--out", name.removesuffix(".toml")])
        assert ("another film" in capsys.readouterr().err) == (name == "other.toml")
    assert (tmp_path / "own" / "corrections.toml").exists()


def test_a_second_review_is_refused(folder, capsys):
    """A failure means that two reviews of a run overwrite each other's decisions."""
    with Session(folder, SETTINGS):
        assert run(["review", str(folder), "--no-browser"]) == 2
    assert "review" in capsys.readouterr().err


@pytest.mark.posix
def test_the_address_is_printed_and_ctrl_c_ends_it(folder):
    """The whole command, as a person starts it."""
    command = [sys.executable, str(HOME / "cli.py"), "review", str(folder), "--no-browser"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        address = process.stdout.readline().split()[-1]
        assert address.startswith("http://127.0.0.1:")
        with urllib.request.urlopen(address, timeout=120) as page:
            assert b"<html" in page.read()
        process.send_signal(signal.SIGINT)
        assert process.wait(120) == 130
        said = process.stderr.read()
        assert said == "track: interrupted; the review has ended, and its decisions are stored\n"
