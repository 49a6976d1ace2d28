"""Sphinx: the API pages, from the docstrings."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from vision import __version__

project = "sheetvision"
release = __version__
extensions = ["sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
exclude_patterns = ["_build"]
html_theme = "alabaster"
html_theme_options = {
    "description": "Positions of interleaved paper sheets, x(n,t), from a video of stick-slip",
    "page_width": "1100px",
}

autodoc_typehints = "none"  # the signatures hold them
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True}
autodoc_preserve_defaults = True
