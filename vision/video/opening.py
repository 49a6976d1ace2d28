"""open_video(): the reader that fits the file, the user's cut, turn and clock checked once."""

from __future__ import annotations

import os
from pathlib import Path

from vision.errors import InputError
from vision.video.recording import Recording
from vision.video.source import Reader


def open_video(
    path: str | os.PathLike[str],
    *,
    rotate: int = 0,
    frames: slice | None = None,
    fps: float | None = None,
    timestamps: str | os.PathLike[str] | None = None,
) -> Recording:
    """A recording, ready to be read in one pass.

    Args: path, a video file, a TIFF, a folder or a glob of numbered images.  rotate, degrees clockwise (0, 90, 180, 270).
    frames, half-open range of frame numbers kept.  fps, the camera's rate in Hz.  timestamps, a text file with the
    time of every frame.  Neither given: the file's own time stamps where it has them, else its playback rate.
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
    return Recording(
        path=where,
        reader=reader,
        rotate=rotate,
        first=first,
        stop=stop,
        given_fps=fps,
        warnings=reader.facts.warnings,
    )


def _reader(path: Path) -> Reader:
    from vision.video.encoded import EncodedReader

    if not path.exists():
        raise InputError(path, "a video file", "nothing by that name", "check the path")
    if path.stat().st_size == 0:
        raise InputError(
            path, "a video file", "an empty file (0 bytes)", "copy it again from the camera computer"
        )
    return EncodedReader(path)


def _frame_range(frames: slice | None, promised: int | None, path: Path) -> tuple[int, int | None]:
    """`--frames` as first and stop; InputError where it is no range or none of the file's frames are in it."""
    if frames is None:
        return 0, None
    first = 0 if frames.start is None else int(frames.start)
    stop = None if frames.stop is None else int(frames.stop)
    if frames.step not in (None, 1) or first < 0 or (stop is not None and stop <= first):
        raise InputError("--frames", "A:B with 0 <= A < B", f"{frames.start}:{frames.stop}")
    if promised is not None and first >= promised:
        raise InputError(f"{path}: --frames", f"a start below {promised}, the frames in the file", str(first))
    return first, stop
