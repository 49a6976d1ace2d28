"""I(x, t) becomes x(n, t): ridges, subpixel fits, identities, numbering."""

from vision.sheets.corrections import Correction, read_corrections
from vision.sheets.recovery import doubtful_stretches
from vision.sheets.reference import wide_spacings
from vision.sheets.settings import TrackingSettings
from vision.sheets.subpixel import FitChoice, FitName, Starts, choose_window, paper_vertex, sliding_vertex
from vision.sheets.tracks import pixel_size_of, track_sheets, with_heights

__all__ = [
    "Correction",
    "FitChoice",
    "FitName",
    "Starts",
    "TrackingSettings",
    "choose_window",
    "doubtful_stretches",
    "paper_vertex",
    "pixel_size_of",
    "read_corrections",
    "sliding_vertex",
    "track_sheets",
    "wide_spacings",
    "with_heights",
]
