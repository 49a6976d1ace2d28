"""Figures as plain data, which matplotlib or the report's page draws, or which are written as tables."""

from vision.figures.camera import frame_figure, kymograph_figure, preview_figure, space_time_figure
from vision.figures.catalogue import FIGURES, Results
from vision.figures.figure import Figure, Image, Panel, Series, load_figures, save_figures
from vision.figures.force import clocks_figure, force_figure, force_overview_figure
from vision.figures.positions import (
    deformation_figure,
    noise_figure,
    pixel_locking_figure,
    shells_figure,
    tracks_figure,
)

__all__ = [
    "FIGURES",
    "Figure",
    "Image",
    "Panel",
    "Results",
    "Series",
    "clocks_figure",
    "deformation_figure",
    "force_figure",
    "force_overview_figure",
    "frame_figure",
    "kymograph_figure",
    "load_figures",
    "noise_figure",
    "pixel_locking_figure",
    "preview_figure",
    "save_figures",
    "shells_figure",
    "space_time_figure",
    "tracks_figure",
]
