"""strip_profile(): a recording becomes I(x, t), the mean of the strip's rows in every frame."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vision.errors import InputError
from vision.video.blank import is_blank
from vision.video.prefetch import prefetch
from vision.video.profile_store import SPILL_BYTES, ProfileStore
from vision.video.recording import cut
from vision.video.source import Block, Video
from vision.video.strip_find import Strip, find_strip, measure_strip

if TYPE_CHECKING:
    import xarray as xr

Progress = Callable[[int, int | None], None]
_EARLY_STEPS = 3.5  # frame intervals between the last frame and the stated end that are no cause for alarm
_STATUS = np.array(["ok", "corrupt", "lost", "blank"])


def strip_profile(
    video: Video,
    rows: slice | None = None,
    *,
    columns: slice | None = None,
    progress: Progress | None = None,
    spill_bytes: int = SPILL_BYTES,
) -> xr.DataArray:
    """I(x, t): the mean over the strip's rows, for every frame of the recording.

    Args: rows and columns, half-open, in pixels after rotation; no rows: `find_strip`.  progress is
    called with (frames done, frames expected or None) after every block.  spill_bytes: a larger I(x, t)
    lives in a temporary file.
    Returns: float32 "intensity" (frame, x) in grey levels. Coordinates: frame (number in the file), x
    (column), time_s and status on frame: "ok", "blank" (nothing to see), "corrupt" (could not be decoded),
    "lost" (recorded nowhere); rows of frames that are not "ok" are NaN. Frame counts, clock, strip and
    warnings are in the attributes.
    Raises: InputError for rows or columns outside the frame, or when no frame can be used.
    """
    import xarray as xr

    _, width = video.shape
    x = cut(columns, width, what=f"{video.path}: columns")
    strip = find_strip(video, columns=x) if rows is None else measure_strip(video, rows, columns=x)
    intensity, numbers, codes, times_s = _reduce(video, strip.rows, x, progress, spill_bytes)
    codes[is_blank(intensity, codes == 0, saturation_level=video.saturation_level)] = 3
    intensity[codes > 0] = np.nan
    if not (codes == 0).any():
        raise InputError(
            video.path, "at least one frame that shows something", f"none in {codes.size} frames"
        )
    return xr.DataArray(
        intensity,
        dims=("frame", "x"),
        coords={
            "frame": numbers,
            "x": np.arange(x.start, x.stop, dtype=np.int64),
            "time_s": ("frame", times_s, {"units": "s"}),
            "status": ("frame", _STATUS[codes]),
        },
        name="intensity",
        attrs=_attributes(video, strip, codes) | {"warnings": _warnings(video, strip, codes, times_s)},
    )


def reference_frame(video: Video) -> NDArray[np.generic]:
    """The first readable frame that is not constant, whole, after rotation. InputError for none."""
    for pixels in video.frames():
        if pixels.min() < pixels.max():
            return pixels
    raise InputError(video.path, "at least one frame that shows something", "none")


def _reduce(
    video: Video, rows: slice, columns: slice, progress: Progress | None, spill_bytes: int
) -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.int8], NDArray[np.float64]]:
    """One pass: row means, frame numbers, status codes (places in `_STATUS`), times."""
    store = ProfileStore(columns.stop - columns.start, expected=video.expected, spill_bytes=spill_bytes)
    numbers: list[NDArray[np.int64]] = [np.empty(0, np.int64)]
    codes: list[NDArray[np.int8]] = [np.empty(0, np.int8)]
    times: list[NDArray[np.float64]] = [np.empty(0)]
    done = 0
    for block in prefetch(video.blocks(rows, columns)):
        means = row_means(block.pixels)
        state = _codes(block)
        state[(state == 0) & np.isnan(means).any(axis=1)] = 1
        store.append(means)
        codes.append(state)
        numbers.append(np.arange(block.start, block.start + state.size, dtype=np.int64))
        times.append(video.times(numbers[-1]) if block.times_s is None else block.times_s)
        done += state.size
        if progress is not None:
            progress(done, video.expected)
    return store.rows(), np.concatenate(numbers), np.concatenate(codes), np.concatenate(times)


def row_means(pixels: NDArray[np.generic]) -> NDArray[np.float32]:
    """Mean over the rows of each frame, (k, rows, columns) to (k, columns).

    Integers are summed exactly, in the narrowest type that cannot overflow, which is three times as fast
    for 8 bits.
    """
    rows = pixels.shape[1]
    if pixels.dtype.kind == "f":
        return np.asarray(pixels.mean(axis=1, dtype=np.float64), np.float32)
    top = rows * ((1 << 8 * pixels.dtype.itemsize) - 1)
    wide = np.uint16 if top < 1 << 16 else np.uint32 if top < 1 << 32 else np.uint64
    return np.asarray(np.add.reduce(pixels, axis=1, dtype=wide) / rows, np.float32)


def _codes(block: Block) -> NDArray[np.int8]:
    places = {str(name): place for place, name in enumerate(_STATUS)}
    return np.array([places[status] for status in block.status], np.int8)


def _attributes(video: Video, strip: Strip, codes: NDArray[np.int8]) -> dict[str, Any]:
    read = int(np.isin(codes, (0, 3)).sum())
    expected = codes.size if video.expected is None else video.expected
    clock = video.clock
    return {
        "units": "grey level",
        "long_name": "mean intensity of the strip",
        "source": str(video.path),
        "rotate": video.rotate,
        "depth_bits": video.depth_bits,
        "saturation_level": float("nan") if video.saturation_level is None else video.saturation_level,
        "strip_z0": strip.rows.start,
        "strip_z1": strip.rows.stop,
        "strip_how": strip.how,
        "strip_clarity": strip.clarity,
        "tilt_deg": strip.tilt_deg,
        "clock_kind": clock.kind,
        "fps": float("nan") if clock.fps is None else clock.fps,
        "frames_expected": expected,
        "frames_read": read,
        "frames_lost": max(expected, codes.size) - read,
        "frames_blank": int((codes == 3).sum()),
        "frames_corrupt": int((codes == 1).sum()),
        **video.notes,
    }


def _warnings(video: Video, strip: Strip, codes: NDArray[np.int8], times_s: NDArray[np.float64]) -> str:
    """Everything the user must be told, one line each."""
    frames = (*_count_warnings(video, codes), *_early_end(video, times_s))
    return "\n".join((*video.warnings, *strip.warnings, *frames))


def _count_warnings(video: Video, codes: NDArray[np.int8]) -> list[str]:
    """One line for each kind of frame that is not there."""
    name, warnings = video.path.name, []
    if video.expected is not None and codes.size < video.expected:
        missing = video.expected - codes.size
        warnings.append(
            f"{name}: {codes.size} of {video.expected} promised frames are in the file; {missing} are missing"
        )
    for code, what in ((1, "corrupt and left out"), (2, "lost by the camera"), (3, "blank and left out")):
        which = np.flatnonzero(codes == code)
        if which.size:
            warnings.append(f"{name}: {which.size} frame(s) {what}, the first at place {which[0]}")
    return warnings


def _early_end(video: Video, times_s: NDArray[np.float64]) -> list[str]:
    """A warning where frames stop well before the file says it ends."""
    if video.duration_s is None or times_s.size < 2:
        return []
    missing_s = video.duration_s - float(times_s[-1])
    if not missing_s > _EARLY_STEPS * float(np.median(np.diff(times_s))):
        return []
    name = video.path.name
    return [f"{name}: the file should last {video.duration_s:.3f} s, its last {missing_s:.3f} s are missing"]
