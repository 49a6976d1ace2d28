"""Text from files and names made harmless where it leaves the program: HTML, and cells of spreadsheets."""

from __future__ import annotations

import html
import re
from collections.abc import Mapping

import pandas as pd

_FORMULA = tuple("=+-@")  # what a cell begins with that Excel and LibreOffice compute
_NUMBER = re.compile(r"[-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?")


def html_table(title: str, rows: Mapping[str, str]) -> str:
    """A short table of two columns, as notebooks show objects; text is escaped."""
    cells = "".join(
        f'<tr><th style="text-align:left">{html.escape(name)}</th>'
        f'<td style="text-align:left">{html.escape(value)}</td></tr>'
        for name, value in rows.items()
    )
    return f"<table><caption>{html.escape(title)}</caption>{cells}</table>"


def harmless(text: str) -> str:
    """Text that no spreadsheet takes for a formula: one that begins as such gets an apostrophe before it.

    Numbers in text stay as they are. Carriage returns become blanks, as some programs begin a row there.
    """
    text = text.replace("\r", " ")
    bites = text.lstrip()[:1] in _FORMULA or text[:1] == "\t"
    return f"'{text}" if text and bites and not _NUMBER.fullmatch(text) else text


def harmless_table(table: pd.DataFrame) -> pd.DataFrame:
    """The table with `harmless` text and names of columns, as every table is written that may hold names."""
    safe = table.rename(columns=lambda name: harmless(str(name)))
    for place, column in enumerate(safe.columns):
        if safe.iloc[:, place].dtype.kind not in "iufb":
            cells = safe.iloc[:, place].map(lambda cell: harmless(cell) if isinstance(cell, str) else cell)
            safe = safe.assign(**{column: cells})
    return safe
