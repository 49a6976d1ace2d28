"""From a video of interleaved sheets and a force recording to x(n,t), σ_x/Λ_st and shells, in ten names.

Each name is loaded from its room when it is first used; everything else is reached through its module.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

_ROOMS = {
    "open_video": "vision.video",
    "strip_profile": "vision.video",
    "track_sheets": "vision.sheets.tracks",
    "space_time": "vision.spacetime",
    "read_force": "vision.force.recording",
    "find_stick_slip": "vision.force.stickslip",
    "synchronise": "vision.clock",
    "horizontal_deformation": "vision.deformation",
    "classify_shells": "vision.shells",
    "fit_models": "vision.models.fits",
}

if TYPE_CHECKING:
    from vision.clock import synchronise
    from vision.deformation import horizontal_deformation
    from vision.force.recording import read_force
    from vision.force.stickslip import find_stick_slip
    from vision.models.fits import fit_models
    from vision.sheets.tracks import track_sheets
    from vision.shells import classify_shells
    from vision.spacetime import space_time
    from vision.video import open_video, strip_profile

__all__ = [
    "__version__",
    "classify_shells",
    "find_stick_slip",
    "fit_models",
    "horizontal_deformation",
    "open_video",
    "read_force",
    "space_time",
    "strip_profile",
    "synchronise",
    "track_sheets",
]


def __getattr__(name: str) -> Any:
    if name not in _ROOMS:
        raise AttributeError(f"module 'vision' has no attribute '{name}'")
    return getattr(importlib.import_module(_ROOMS[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
