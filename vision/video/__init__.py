"""Read a film and reduce it to I(x, t)."""

from vision.video.follow import Follow, await_video
from vision.video.settings import VideoSettings
from vision.video.strip import (
    FramesRead,
    FrameStore,
    ReadingLog,
    reference_frame,
    strip_profile,
    strip_profiles,
)
from vision.video.strip_find import find_strip, measure_strip
from vision.video.times import read_timestamps
from vision.video.video import Video, open_video, video_files

__all__ = [
    "Follow",
    "FrameStore",
    "FramesRead",
    "ReadingLog",
    "Video",
    "VideoSettings",
    "await_video",
    "find_strip",
    "measure_strip",
    "open_video",
    "read_timestamps",
    "reference_frame",
    "strip_profile",
    "strip_profiles",
    "video_files",
]
