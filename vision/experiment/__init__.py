"""Synthetic traction tests with known truth: mechanics, sheets, optics, camera, clocks."""

from vision.experiment.mechanics import simulate_pull
from vision.experiment.settings import Experiment, preset, setting_names, settings_from_toml, with_settings
from vision.experiment.simulate import force_recording, profiles, simulate, write_force

__all__ = [
    "Experiment",
    "force_recording",
    "preset",
    "profiles",
    "setting_names",
    "settings_from_toml",
    "simulate",
    "simulate_pull",
    "with_settings",
    "write_force",
]
