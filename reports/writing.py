"""Write a report beside the script that makes it."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path


def write_report(name: str, lines: Iterable[str]) -> None:
    """Write `reports/NAME.md`, with a last line that says what makes it, and print it."""
    text = "\n".join([*lines, "", f"Made by `python -m reports.{name}`."]) + "\n"
    (Path(__file__).parent / f"{name}.md").write_text(text, encoding="utf-8")
    print(text)


def row(cells: Iterable[object]) -> str:
    """Return a line of a table."""
    return f"| {' | '.join(map(str, cells))} |"


def head(columns: Iterable[str]) -> list[str]:
    """Return the two first lines of a table."""
    names = list(columns)
    return [row(names), "|---" * len(names) + "|"]
