"""Small synthetic tests that several tests share."""

from vision.experiment import Experiment
from vision.experiment.settings import Camera, Clocks, Mechanics, Sheets

SMALL = Experiment(
    camera=Camera(width=322, height=20, duration_s=0.4),
    mechanics=Mechanics(d_end_mm=13.2),
    clocks=Clocks(offset_s=5.0, force_rate_Hz=100.0),
    sheets=Sheets(count=12),
)
"""24 frames, 12 sheets, several slips."""
