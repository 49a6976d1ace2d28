"""strip_profile(): a recording becomes I(x, t), the mean of the strip's rows in every frame."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vision.errors import InputError
from vision.video.blank import is_blank
from vision.video.frame_counts import BLANK, CORRUPT, OK, STATUS, Counts, count_frames
from vision.video.prefetch import prefetch
from vision.video.profile_store import SPILL_BYTES, ProfileStore
from vision.video.recording import cut
from vision.video.source import Block, Video
from vision.video.strip_find import Strip, find_strip, measure_strip

if TYPE_CHECKING:
    import xarray as xr

Progress = Callable[[int, int | None], None]


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
    called with (frames done, frames in all or None) after every block.  spill_bytes: a larger I(x, t)
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
    codes[is_blank(intensity, codes == OK, saturation_level=video.saturation_level)] = BLANK
    intensity[codes != OK] = np.nan
    _check_any(video, codes)
    counts = count_frames(video, codes, times_s)
    return xr.DataArray(
        intensity,
        dims=("frame", "x"),
        coords={
            "frame": numbers,
            "x": np.arange(x.start, x.stop, dtype=np.int64),
            "time_s": ("frame", times_s, {"units": "s"}),
            "status": ("frame", STATUS[codes]),
        },
        name="intensity",
        attrs=_attributes(video, strip, counts),
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
    """One pass: row means, frame numbers, status codes (places in `STATUS`), times."""
    store = ProfileStore(columns.stop - columns.start, expected=video.about, spill_bytes=spill_bytes)
    numbers: list[NDArray[np.int64]] = [np.empty(0, np.int64)]
    codes: list[NDArray[np.int8]] = [np.empty(0, np.int8)]
    times: list[NDArray[np.float64]] = [np.empty(0)]
    done = 0
    for block in prefetch(video.blocks(rows, columns)):
        means = row_means(block.pixels)
        state = _codes(block)
        odd = ~np.isfinite(means).all(axis=1)
        means[odd] = np.nan  # infinities would spread into sums over frames
        state[(state == OK) & odd] = CORRUPT
        store.append(means)
        codes.append(state)
        numbers.append(np.arange(block.start, block.start + state.size, dtype=np.int64))
        times.append(video.times(numbers[-1]) if block.times_s is None else block.times_s)
        done += state.size
        if progress is not None:
            progress(done, video.about)
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
    places = {str(name): place for place, name in enumerate(STATUS)}
    return np.array([places[status] for status in block.status], np.int8)


def _check_any(video: Video, codes: NDArray[np.int8]) -> None:
    """InputError where no frame can be used; it says why."""
    if (codes == OK).any():
        return
    if not codes.size:
        raise InputError(video.path, "frames within --frames", "the file ends before them")
    names, counts = np.unique(STATUS[codes], return_counts=True)
    found = ", ".join(f"{count} {name}" for name, count in zip(names, counts, strict=True))
    advice = "cut NaN off with --columns" if video.saturation_level is None else "check --strip and --columns"
    raise InputError(video.path, "at least one frame that shows something", f"none ({found})", advice)


def _attributes(video: Video, strip: Strip, counts: Counts) -> dict[str, Any]:
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
        "frames_expected": counts.expected,
        "frames_read": counts.read,
        "frames_lost": counts.lost,
        "frames_blank": counts.blank,
        "frames_corrupt": counts.corrupt,
        "warnings": "\n".join((*video.warnings, *strip.warnings, *counts.warnings)),
        **video.notes,
    }
