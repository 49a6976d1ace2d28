"""What a notebook shows of the objects of an analysis."""

from vision.escaping import html_table


def test_clock_and_models_are_short_tables(pulled):
    """A failure means that a notebook shows a wall of numbers, or a value without its error."""
    clock, fits = pulled.clock._repr_html_(), pulled.fits._repr_html_()
    assert f"{pulled.clock.offset_s:.4f}" in clock
    assert f"{pulled.clock.matched} matched" in clock
    assert "nan" not in clock
    assert f"{pulled.fits.mu.value:.5g} ± {pulled.fits.mu.error:.2g}" in fits
    assert clock.count("<tr>") <= 8
    assert fits.count("<tr>") <= 14


def test_text_cannot_break_the_table():
    """A failure means that a file's name injects markup into a notebook."""
    assert "<script>" not in html_table("<script>", {"<script>": "<script>"})
