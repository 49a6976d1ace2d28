"""The API pages are built from the docstrings without a complaint."""

import subprocess
import sys
from pathlib import Path

import pytest

import vision

PROJECT = Path(__file__).parents[2]


def test_the_pages_build_without_warnings_and_hold_every_name_of_the_pipeline(tmp_path):
    """A failure means that a docstring does not render, or that a stage of the pipeline is not documented."""
    pytest.importorskip("sphinx")
    command = [sys.executable, "-m", "sphinx", "-W", "-q", "-d", tmp_path / "trees"]
    done = subprocess.run(
        [*command, PROJECT / "docs", tmp_path / "pages"],
        capture_output=True,
        text=True,
        check=False,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "pages" / "api.html").read_text(encoding="utf-8")
    stages = set(vision.__all__) - {"__version__"}
    assert len(stages) >= 10
    assert [name for name in sorted(stages) if f'id="vision.{name}"' not in page] == []
