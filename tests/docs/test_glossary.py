"""The glossary explains each term once, in half a line."""

from pathlib import Path

GLOSSARY = Path(__file__).parents[2] / "docs" / "glossary.md"
SYMBOLS = ["d", "V", "ΔF", "Λ_st", "Λ_sl", "K", "σ_x", "M_eff", "μ", "T*", "𝒯0", "A", "N̂", "Y_eff", "Λ̂", "α"]


def rows():
    """Cells of every row of the tables."""
    lines = GLOSSARY.read_text(encoding="utf-8").splitlines()
    cells = [line.strip("| ").split(" | ") for line in lines if line.startswith("| ")]
    return [row for row in cells if row != ["term", "meaning"]]


def terms():
    return [term for row in rows() for term in row[0].split(", ")]


def test_every_term_is_explained_once_and_briefly():
    """A failure means a broken table, a term explained twice, or text that belongs in the methods."""
    assert len(rows()) > 60
    assert [row for row in rows() if len(row) != 2 or not row[1] or len(row[1]) > 110] == []
    assert sorted({term for term in terms() if terms().count(term) > 1}) == []


def test_the_symbols_of_the_tables_are_there():
    """A failure means that a symbol of events.csv, shells.csv or models.json is not explained."""
    assert set(SYMBOLS) - set(terms()) == set()
