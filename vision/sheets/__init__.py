"""I(x, t) becomes x(n, t): ridges, subpixel fits, identities, numbering."""

from vision.sheets.reference import wide_spacings
from vision.sheets.scale import pixel_size_from_pitch
from vision.sheets.settings import TrackingSettings
from vision.sheets.subpixel import (
    FitName,
    FittedPositions,
    Starts,
    choose_window,
    paper_vertex,
    position_noise,
    sliding_vertex,
    template_shift,
)
from vision.sheets.tracks import track_sheets

__all__ = [
    "FitName",
    "FittedPositions",
    "Starts",
    "TrackingSettings",
    "choose_window",
    "paper_vertex",
    "pixel_size_from_pitch",
    "position_noise",
    "sliding_vertex",
    "template_shift",
    "track_sheets",
    "wide_spacings",
]
