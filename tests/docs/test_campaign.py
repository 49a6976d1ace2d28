"""The example table of docs/campaign.md can be run from the project's folder."""

import re
import shutil
from pathlib import Path

from vision.command.main import run

PROJECT = Path(__file__).parents[2]


def test_the_example_table_passes_the_checks(tmp_path, monkeypatch, capsys):
    """A failure means that a first campaign, copied from the page, is refused."""
    page = (PROJECT / "docs" / "campaign.md").read_text(encoding="utf-8")
    (table,) = re.findall(r"```\n(name,film,.*?)```", page, re.DOTALL)
    shutil.copytree(PROJECT / "fixtures", tmp_path / "fixtures")
    (tmp_path / "tests.csv").write_text(table)
    monkeypatch.chdir(tmp_path)
    assert run(["campaign", "tests.csv", "--dry-run"]) == 0
    assert "2 of 2 films would run" in capsys.readouterr().out
