"""One run with planted mistakes for all tests of the review, and copies of it to decide about."""

import shutil

import pytest

from tests.scenes.doubted import doubted_run
from tests.scenes.reviewed import PLANTED, SETTINGS, write_planted
from tests.scenes.undrawn import undrawn
from vision.review import saving
from vision.review.session import Session


@pytest.fixture(scope="package", autouse=True)
def undrawn_runs():
    """A review reads no picture of a run: none is drawn, here or in the processes that save one."""
    with undrawn(), pytest.MonkeyPatch.context() as patch:
        undraw = "from tests.scenes.undrawn import undraw; undraw()"
        patch.setattr(saving, "_CHILD", saving._CHILD.replace("\nfrom ", f"\n{undraw}\nfrom "))
        yield


@pytest.fixture(scope="package")
def planted(tmp_path_factory):
    """Not to be changed: see `run`."""
    return write_planted(tmp_path_factory.mktemp("planted") / "run")


@pytest.fixture(scope="package")
def doubted(tmp_path_factory):
    """Not to be changed either."""
    return doubted_run(tmp_path_factory.mktemp("doubted"))


@pytest.fixture(scope="package")
def unplanted(tmp_path_factory):
    """The run without mistakes; not to be changed."""
    return write_planted(tmp_path_factory.mktemp("unplanted") / "run", ())


@pytest.fixture(scope="package")
def watched(planted, tmp_path_factory):
    """An open review for tests that must not change it, which is looked at when all of them are done."""
    copy = shutil.copytree(planted, tmp_path_factory.mktemp("watched") / "run")
    written = (copy / "corrections.toml").read_bytes()
    with Session(copy, SETTINGS) as opened:
        yield opened
        assert len(opened.decisions) == len(PLANTED)
        assert not opened.changed and not opened.undone
    assert (copy / "corrections.toml").read_bytes() == written


@pytest.fixture
def run(planted, tmp_path):
    """A run folder of one's own."""
    return shutil.copytree(planted, tmp_path / "run")


@pytest.fixture
def session(run):
    with Session(run, SETTINGS) as opened:
        yield opened
