"""Analyse a video of interleaved sheets and a force recording: x(n,t), σ_x/Λ_st, shells.

`analyse` runs all stages, `save_run` and `load_run` write and read their results, `compare` compares several
tests, and the other names are single stages. Each is loaded from its package when first used; everything else
is imported from its module.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.2.0"

_PACKAGE_OF = {
    "analyse": "vision.pipeline",
    "classify_shells": "vision.shells",
    "compare": "vision.comparison",
    "find_stick_slip": "vision.force",
    "fit_models": "vision.models",
    "horizontal_deformation": "vision.deformation",
    "load_run": "vision.command.run_folders",
    "open_video": "vision.video",
    "read_force": "vision.force",
    "save_run": "vision.command.run_folders",
    "space_time": "vision.spacetime",
    "strip_profile": "vision.video",
    "synchronise": "vision.clock",
    "track_sheets": "vision.sheets",
}
__all__ = ["__version__", *_PACKAGE_OF]  # noqa: PLE0604

if TYPE_CHECKING:
    from vision.clock import synchronise as synchronise
    from vision.command.run_folders import load_run as load_run
    from vision.command.run_folders import save_run as save_run
    from vision.comparison import compare as compare
    from vision.deformation import horizontal_deformation as horizontal_deformation
    from vision.force import find_stick_slip as find_stick_slip
    from vision.force import read_force as read_force
    from vision.models import fit_models as fit_models
    from vision.pipeline import analyse as analyse
    from vision.sheets import track_sheets as track_sheets
    from vision.shells import classify_shells as classify_shells
    from vision.spacetime import space_time as space_time
    from vision.video import open_video as open_video
    from vision.video import strip_profile as strip_profile


def __getattr__(name: str) -> Any:
    if name not in _PACKAGE_OF:
        raise AttributeError(f"module 'vision' has no attribute '{name}'")
    return getattr(importlib.import_module(_PACKAGE_OF[name]), name)


def __dir__() -> list[str]:
    return ["__version__", *_PACKAGE_OF]
