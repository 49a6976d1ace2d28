"""A synthetic traction test with known truth: mechanics, sheets, optics, camera, clocks."""

from vision.experiment.presets import preset, settings_from_toml, with_settings
from vision.experiment.profile import profiles
from vision.experiment.settings import (
    Camera,
    Clocks,
    Experiment,
    ForceFile,
    LoadCell,
    Mechanics,
    Optics,
    Sheets,
)
from vision.experiment.simulate import simulate

__all__ = [
    "Camera",
    "Clocks",
    "Experiment",
    "ForceFile",
    "LoadCell",
    "Mechanics",
    "Optics",
    "Sheets",
    "preset",
    "profiles",
    "settings_from_toml",
    "simulate",
    "with_settings",
]
