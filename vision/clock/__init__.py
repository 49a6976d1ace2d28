"""The camera's clock against the testing machine's."""

from vision.clock.force_slips import force_slips
from vision.clock.result import Candidate, Clock
from vision.clock.synchronise import synchronise
from vision.clock.video_slips import video_slips

__all__ = ["Candidate", "Clock", "force_slips", "synchronise", "video_slips"]
