"""The page on the publication names tests and modules that exist."""

import re
from pathlib import Path

PROJECT = Path(__file__).parents[2]
PAGE = (PROJECT / "docs" / "paper.md").read_text(encoding="utf-8")


def test_every_test_that_is_named_exists():
    """A failure means that the page claims a proof that is not there."""
    named = re.findall(r"`([a-z_/]+\.py)::(test_\w+)`", PAGE)
    assert len(named) > 50
    for file, function in named:
        text = (PROJECT / "tests" / file).read_text(encoding="utf-8")
        assert re.search(rf"^def {function}\(", text, re.MULTILINE), f"{file}::{function}"


def test_every_module_that_is_named_exists():
    """A failure means that the page sends its reader to a file that was moved."""
    for file in set(re.findall(r"`((?:vision|reports)/[\w/]+\.\w+)`", PAGE)):
        assert (PROJECT / file).is_file(), file
