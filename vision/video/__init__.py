"""A file becomes frames becomes I(x, t)."""

from vision.video.opening import open_video
from vision.video.source import Block, FrameClock, Status, Video
from vision.video.strip import reference_frame, strip_profile

__all__ = ["Block", "FrameClock", "Status", "Video", "open_video", "reference_frame", "strip_profile"]
