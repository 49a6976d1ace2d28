"""A file becomes frames becomes I(x, t)."""

from vision.video.opening import open_video
from vision.video.source import Block, FrameClock, Status, Video
from vision.video.strip import reference_frame, strip_profile
from vision.video.strip_find import Strip, find_strip, measure_strip

__all__ = [
    "Block",
    "FrameClock",
    "Status",
    "Strip",
    "Video",
    "find_strip",
    "measure_strip",
    "open_video",
    "reference_frame",
    "strip_profile",
]
