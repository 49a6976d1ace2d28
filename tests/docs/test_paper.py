"""The page that goes through the publication names only what is there."""

import re
from pathlib import Path

import vision.experiment
from vision.figures import FIGURES
from vision.models import equations

PROJECT = Path(__file__).parents[2]
TEXT = (PROJECT / "docs" / "paper.md").read_text(encoding="utf-8")
OF_SEVERAL = {"peaks", "sticks", "drops", "stiffnesses", "collapse", "trends"}


def test_every_file_it_names_is_there():
    """A failure means that a reader is sent to a file that was renamed or never written."""
    named = set(re.findall(r"`((?:vision|tests)/[\w/]+\.py)`", TEXT))
    assert len(named) > 15
    assert [name for name in sorted(named) if not (PROJECT / name).is_file()] == []


def test_every_figure_and_function_it_names_is_there():
    """A failure means a command that answers with an error."""
    drawn = set(re.findall(r"`track figures RUN (\w+)`", TEXT))
    assert drawn <= set(FIGURES)
    assert set(re.findall(r"`track figures DIR (\w+)`", TEXT)) <= OF_SEVERAL
    for name in ("amplification", "traction", "normal_force", "effective_sheets", "assembly_stiffness"):
        assert f"`{name}`" in TEXT
        assert hasattr(equations, name)
    assert all((equations, vision.experiment))
