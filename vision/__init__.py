"""From a video of interleaved sheets to x(n,t): the pipeline's names, each loaded when it is first used."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

_HOMES = {
    "open_video": "vision.video",
    "strip_profile": "vision.video",
    "track_sheets": "vision.sheets.tracks",
    "read_force": "vision.force",
    "find_stick_slip": "vision.force",
    "fit_models": "vision.models.fits",
}

if TYPE_CHECKING:
    from vision.sheets.tracks import track_sheets
    from vision.video import open_video, strip_profile

__all__ = ["__version__", "open_video", "strip_profile", "track_sheets"]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'vision' has no attribute '{name}'")
    return getattr(importlib.import_module(_HOMES[name]), name)
