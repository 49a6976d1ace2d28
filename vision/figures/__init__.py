"""Figures as plain data, which matplotlib or the report's page draws, or which are written as tables."""

from vision.figures.camera import frame_figure, kymograph_figure, preview_figure, space_time_figure
from vision.figures.catalogue import (
    FIGURES,
    Results,
    figures_of,
    kymograph,
    missing_parts,
    overview,
    publication_figures_of,
    sections_of,
)
from vision.figures.figure import Figure, Image, Panel, Series, load_figures, save_figures
from vision.figures.force import clocks_figure, force_figure, force_overview_figure
from vision.figures.positions import (
    deformation_figure,
    noise_figure,
    pixel_locking_figure,
    shells_figure,
    tracks_figure,
)
from vision.figures.style import percent

__all__ = [
    "FIGURES",
    "Figure",
    "Image",
    "Panel",
    "Results",
    "Series",
    "clocks_figure",
    "deformation_figure",
    "figures_of",
    "force_figure",
    "force_overview_figure",
    "frame_figure",
    "kymograph",
    "kymograph_figure",
    "load_figures",
    "missing_parts",
    "noise_figure",
    "overview",
    "percent",
    "pixel_locking_figure",
    "preview_figure",
    "publication_figures_of",
    "save_figures",
    "sections_of",
    "shells_figure",
    "space_time_figure",
    "tracks_figure",
]
