"""Sphinx: the API pages, from the docstrings."""

import re
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from vision import __version__

project = "sheetvision"
release = __version__
extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",
    "myst_parser",
]
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
exclude_patterns = ["_build"]
html_theme = "alabaster"
html_theme_options = {
    "description": "Positions of interleaved paper sheets, x(n,t), from a video of stick-slip",
    "page_width": "1280px",  # lines of code are up to 110 characters long
    "body_max_width": "none",
}

default_role = "literal"  # `name` in a docstring is code
autodoc_typehints = "signature"
python_maximum_signature_line_length = 100
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True}
autodoc_preserve_defaults = True


def setup(app: Any) -> None:
    """Give each part of a docstring a paragraph of its own."""
    app.connect("autodoc-process-docstring", _part_paragraphs)


def _part_paragraphs(app: Any, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Args, Returns, Raises and Source, which start a line in the source, start a paragraph on the page."""
    part = re.compile(r"^((?:Args|Returns|Raises|Source):)", re.MULTILINE)
    lines[:] = part.sub(r"\n**\1**", "\n".join(lines)).split("\n")
