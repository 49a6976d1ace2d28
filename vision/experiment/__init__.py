"""A synthetic traction test with known truth: mechanics, sheets, optics, camera, clocks."""

from vision.experiment.force_file import force_recording, write_force
from vision.experiment.images import frame_blocks, profiles
from vision.experiment.mechanics import Pull, simulate_pull
from vision.experiment.presets import preset
from vision.experiment.scene import Scene, make_scene
from vision.experiment.settings import (
    Camera,
    Clocks,
    Experiment,
    ForceFile,
    LoadCell,
    Mechanics,
    Optics,
    Sheets,
    settings_from_toml,
    with_settings,
)
from vision.experiment.simulate import SimulatedTest, simulate
from vision.experiment.truth import truth_of

__all__ = [
    "Camera",
    "Clocks",
    "Experiment",
    "ForceFile",
    "LoadCell",
    "Mechanics",
    "Optics",
    "Pull",
    "Scene",
    "Sheets",
    "SimulatedTest",
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
