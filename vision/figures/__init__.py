"""Every figure, declared once as data: drawn by matplotlib or by the report's page, written as a table."""

from vision.figures.catalogue import (
    FIGURES,
    Results,
    figures_of,
    kymograph,
    missing_parts,
    overview,
    sections_of,
)
from vision.figures.figure import (
    Band,
    Figure,
    Image,
    Panel,
    Series,
    load_figures,
    save_figures,
    write_captions,
)
from vision.figures.force import force_overview_figure
from vision.figures.labels import percent, plus_minus, signed
from vision.figures.video import kymograph_figure

__all__ = [
    "FIGURES",
    "Band",
    "Figure",
    "Image",
    "Panel",
    "Results",
    "Series",
    "figures_of",
    "force_overview_figure",
    "kymograph",
    "kymograph_figure",
    "load_figures",
    "missing_parts",
    "overview",
    "percent",
    "plus_minus",
    "save_figures",
    "sections_of",
    "signed",
    "write_captions",
]
