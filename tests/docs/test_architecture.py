"""What docs/architecture.md and docs/extending.md name is there."""

import re
from pathlib import Path

import pytest

PROJECT = Path(__file__).parents[2]
CODE = "\n".join(
    path.read_text(encoding="utf-8")
    for path in (PROJECT / "vision").rglob("*")
    if path.suffix in (".py", ".js") or path.name == "Snakefile"
)


def files_in(text):
    return set(re.findall(r"`((?:[a-z_]+/)+[a-z_]+\.(?:py|js|md))`", text))


def names_in(text):
    """Functions, classes and fields in backticks; of a method also its class. No paths and commands."""
    quoted = re.findall(r"`([^`\n]+)`", text)
    whole = [one for one in quoted if re.fullmatch(r"_?[A-Za-z][\w.]+", one)]
    return {name for one in whole for name in one.split(".")}


def is_there(name):
    return re.search(rf"\b{re.escape(name)}\b", CODE) is not None


@pytest.mark.parametrize("page", ["architecture.md", "extending.md"])
def test_a_reader_is_sent_to_what_exists(page):
    """A failure means that whoever looks up where to change something finds nothing there."""
    text = (PROJECT / "docs" / page).read_text(encoding="utf-8")
    files = files_in(text)
    assert len(files) >= 5
    assert [
        file
        for file in sorted(files)
        if not ((PROJECT / file).exists() or (PROJECT / "vision" / file).exists())
    ] == []
    names = names_in(text)
    assert len(names) >= 20
    assert [name for name in sorted(names) if not is_there(name)] == []


def test_a_name_that_is_gone_is_found():
    """The check must notice what does not exist, or it proves nothing."""
    assert not is_there("no_such_" + "function")
    assert files_in("`command/no_such.py`") == {"command/no_such.py"}
