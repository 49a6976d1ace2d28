"""What tests of commands share."""

import pytest

from vision.command.main import run


@pytest.fixture(autouse=True)
def place(tmp_path, monkeypatch):
    """A working directory for each test, as commands write to it."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def refused(tmp_path, capsys):
    """A function that runs a command which must be refused, and returns the one line that says why.

    The exit status is 2, nothing goes to standard output, and no file of the test is made or changed.
    """

    def files():
        return {p: p.stat().st_mtime_ns if p.is_file() else 0 for p in tmp_path.rglob("*")}

    def refuse(*arguments):
        capsys.readouterr()  # what earlier commands printed
        before = files()
        assert run([str(argument) for argument in arguments]) == 2
        said = capsys.readouterr()
        assert said.out == ""
        assert said.err.startswith("track: ") and said.err.count("\n") == 1
        assert files() == before
        return said.err

    return refuse
