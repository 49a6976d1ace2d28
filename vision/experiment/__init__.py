"""Synthetic traction tests with known truth: mechanics, sheets, optics, camera, clocks."""

from vision.experiment.mechanics import simulate_pull
from vision.experiment.scene import make_scene, truth_of
from vision.experiment.settings import (
    Camera,
    Clocks,
    Experiment,
    Mechanics,
    Optics,
    Sheets,
    preset,
    settings_from_toml,
    with_settings,
)
from vision.experiment.simulate import force_recording, frame_blocks, profiles, simulate, write_force

__all__ = [
    "Camera",
    "Clocks",
    "Experiment",
    "Mechanics",
    "Optics",
    "Sheets",
    "force_recording",
    "frame_blocks",
    "make_scene",
    "preset",
    "profiles",
    "settings_from_toml",
    "simulate",
    "simulate_pull",
    "truth_of",
    "with_settings",
    "write_force",
]
