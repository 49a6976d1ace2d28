"""open_video(): the reader that fits the file, the user's cut, turn and clock checked once."""

from __future__ import annotations

import glob
import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vision.errors import InputError
from vision.video.recording import Recording
from vision.video.source import Facts, Reader
from vision.video.timestamps import read_timestamps


def open_video(
    path: str | os.PathLike[str],
    *,
    rotate: int = 0,
    frames: slice | None = None,
    fps: float | None = None,
    timestamps: str | os.PathLike[str] | None = None,
) -> Recording:
    """A recording, ready to be read in one pass.

    Args: path, a video file, a TIFF, a folder or a glob of numbered images.  rotate, degrees clockwise (0,
    90, 180, 270). frames, half-open range of frame numbers kept.  fps, the camera's rate in Hz.
    timestamps, a text file with the time of every frame.  Neither given: the file's own time stamps where
    it has them, else its playback rate.
    Raises: InputError if the file cannot be read or an argument does not fit it.
    """
    where = Path(path)
    if rotate not in (0, 90, 180, 270):
        raise InputError("--rotate", "0, 90, 180 or 270", str(rotate))
    if fps is not None and not 0 < fps < float("inf"):
        raise InputError("--fps", "a positive number of frames per second", str(fps))
    if fps is not None and timestamps is not None:
        raise InputError("--fps and --timestamps", "one of the two", "both")
    reader = _reader(where)
    first, stop = _frame_range(frames, reader.facts.promised, where)
    times_s, odd = _given_times(timestamps, reader.facts.promised, where)
    return Recording(
        path=where,
        reader=reader,
        rotate=rotate,
        first=first,
        stop=stop,
        given_fps=fps,
        given_times_s=times_s,
        warnings=(*reader.facts.warnings, *odd, *_beyond(stop, reader.facts)),
    )


def _reader(path: Path) -> Reader:
    """The reader for this kind of file, told by its first bytes."""
    from vision.video import avi, cine, mjpeg, raw, sequence, stack

    if path.is_dir() or (not path.exists() and glob.has_magic(str(path))):
        return sequence.open_sequence(path)
    _check_file(path)
    if avi.is_avi(path) and raw.is_raw(layout := avi.read_avi_layout(path)):
        return raw.open_raw_avi(path, layout)
    if stack.is_tiff(path):
        return stack.open_stack(path)
    if cine.is_cine(path):
        return cine.open_cine(path)
    if path.suffix.lower() in sequence.IMAGES:
        return sequence.open_sequence(path)
    return mjpeg.open_encoded(path)


def _check_file(path: Path) -> None:
    try:
        with path.open("rb") as file:
            head = file.read(1)
    except OSError as error:
        found = error.strerror or type(error).__name__
        raise InputError(
            path, "a video, a TIFF, a folder or glob of images", found, "check the path"
        ) from None
    if not head:
        raise InputError(
            path, "a video", "an empty file (0 bytes)", "copy it again from the camera's computer"
        )


def _given_times(
    timestamps: str | os.PathLike[str] | None, promised: int | None, path: Path
) -> tuple[NDArray[np.float64] | None, tuple[str, ...]]:
    """The time-stamp file's times; InputError where there are not as many as frames."""
    if timestamps is None:
        return None, ()
    times_s, warnings = read_timestamps(Path(timestamps))
    if promised is not None and times_s.size != promised:
        found = f"{times_s.size} times"
        raise InputError(timestamps, f"{promised} times, one per frame of {path.name}", found)
    return times_s, warnings


def _beyond(stop: int | None, facts: Facts) -> tuple[str, ...]:
    """A warning where more frames are asked for than there are."""
    held = facts.promised or facts.about
    if stop is None or held is None or stop <= held:
        return ()
    about = "" if facts.promised else "about "
    return (f"--frames: asked for frames up to {stop}, the file has {about}{held}",)


def _frame_range(frames: slice | None, promised: int | None, path: Path) -> tuple[int, int | None]:
    """`--frames` as first and stop; InputError where it is no range or holds none of the frames."""
    if frames is None:
        return 0, None
    first = 0 if frames.start is None else int(frames.start)
    stop = None if frames.stop is None else int(frames.stop)
    if frames.step not in (None, 1) or first < 0 or (stop is not None and stop <= first):
        raise InputError("--frames", "A:B with 0 <= A < B", f"{frames.start}:{frames.stop}")
    if promised is not None and first >= promised:
        raise InputError(f"{path}: --frames", f"a start below {promised}, the frames in the file", str(first))
    return first, stop
