"""Kills of fixed seeds; any number by hand: python -m tests.kill --cases N --seed S."""

import os
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.thorough
@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes cannot be forked here")
def test_killed_at_random_moments(tmp_path):
    """A failure means a mixed or lost run, rubbish beside it, or a resumed run with other positions."""
    environment = os.environ | {"TMPDIR": str(tmp_path), "PYTHONWARNINGS": "ignore"}
    words = [sys.executable, "-m", "tests.kill", "--cases", "10", "--seed", "1", "--quick"]
    place = Path(__file__).parents[2]
    done = subprocess.run(words, capture_output=True, text=True, env=environment, cwd=place, check=False)
    assert (done.returncode, done.stderr) == (0, ""), done.stdout + done.stderr
