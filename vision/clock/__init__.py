"""The camera's clock against the testing machine's."""

from vision.clock.clock import Candidate, Clock, synchronise
from vision.clock.settings import ClockSettings
from vision.clock.slips import force_slips, video_slips

__all__ = ["Candidate", "Clock", "ClockSettings", "force_slips", "synchronise", "video_slips"]
