"""Escape text from files and names in the program's output: HTML, and cells of spreadsheets."""

from __future__ import annotations

import html
import re
from collections.abc import Mapping

import pandas as pd

_FORMULA = tuple("=+-@")  # first characters of cells that Excel and LibreOffice take for formulas
_NUMBER = re.compile(r"[-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?")


def html_table(title: str, rows: Mapping[str, str]) -> str:
    """Return an HTML table of two columns for notebooks, with escaped text."""
    cells = "".join(
        f'<tr><th style="text-align:left">{html.escape(name)}</th>'
        f'<td style="text-align:left">{html.escape(value)}</td></tr>'
        for name, value in rows.items()
    )
    return f"<table><caption>{html.escape(title)}</caption>{cells}</table>"


def harmless(text: str) -> str:
    """Put an apostrophe before text that a spreadsheet would take for a formula.

    Numbers are not changed. Carriage returns become spaces, since some programs start a row there.
    """
    text = text.replace("\r", " ")
    is_formula = text.lstrip()[:1] in _FORMULA or text[:1] == "\t"
    return f"'{text}" if text and is_formula and not _NUMBER.fullmatch(text) else text


def harmless_table(table: pd.DataFrame) -> pd.DataFrame:
    """Return the table with `harmless` text and column names, for every table that may contain names."""
    safe = table.rename(columns=lambda name: harmless(str(name)))
    for k, column in enumerate(safe.columns):
        if safe.iloc[:, k].dtype.kind not in "iufb":
            cells = safe.iloc[:, k].map(lambda cell: harmless(cell) if isinstance(cell, str) else cell)
            safe = safe.assign(**{column: cells})
    return safe
