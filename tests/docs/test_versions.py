"""constraints-lowest.txt holds the oldest versions that pyproject.toml allows."""

import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_the_oldest_versions_are_those_that_are_tested():
    """A failure means that a version is allowed with which the tests were never run."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    allowed = dict(line.split(">=") for line in project["dependencies"])
    lines = (ROOT / "constraints-lowest.txt").read_text(encoding="utf-8").splitlines()
    tested = dict(line.split("==") for line in lines if not line.startswith("#"))
    assert {name: numbers(tested.get(name, "0")) for name in allowed} == {
        name: numbers(version) for name, version in allowed.items()
    }


def numbers(version):
    """The numbers of a version; 3.1 and 3.1.0 are one."""
    found = [int(part) for part in version.split(".")]
    return found + [0] * (4 - len(found))
