"""A synthetic traction test with known truth: mechanics, sheets, optics, camera, clocks."""

from vision.experiment.profile import profiles
from vision.experiment.settings import Camera, Clocks, Experiment, LoadCell, Mechanics, Optics, Sheets

__all__ = ["Camera", "Clocks", "Experiment", "LoadCell", "Mechanics", "Optics", "Sheets", "profiles"]
