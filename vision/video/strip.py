"""I(x, t): the mean of the strip's rows in each frame, from one pass over the recording."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Protocol

import numpy as np
import xarray as xr

from vision.data import STRIP, STRIP_PARTS, StripMetadata, changed_settings, record
from vision.errors import InputError, check_kind
from vision.files import Progress, prefetch
from vision.numeric import Floats32, Pixels, Strings
from vision.video.frames import (
    STATUS_TYPE,
    Follow,
    FramesRead,
    FrameStore,
    blank_out,
    expected_frames,
    growth,
    held_back,
    is_blank,
    part_of,
)
from vision.video.reader import Block
from vision.video.settings import VideoSettings
from vision.video.strip_find import Strip, choose_strip, measure_strip
from vision.video.video import RANGE, Video, cut


class ReadingLog(Protocol):
    """Keeps the frames read from a long film, and returns those that an interrupted run kept.

    `begin` is called once, before anything is read, and `add` after every block. I(x, t) may spill into
    `folder`.
    """

    folder: Path

    def begin(self, video: Video, rows: slice, columns: slice) -> Iterator[FramesRead]:
        """Yield the first frames of the film that need not be read again."""
        ...

    def add(self, frames: FrameStore) -> None:
        """Keep the frames that are new."""
        ...


def strip_profile(
    video: Video,
    rows: slice | None = None,
    *,
    columns: slice | None = None,
    progress: Progress | None = None,
    settings: VideoSettings = VideoSettings(),
    log: ReadingLog | None = None,
    follow: Follow | None = None,
) -> xr.DataArray:
    r"""Return I(x, t), the mean over the strip's rows, for every frame of the recording.

    Parameters
    ----------
    video
        From `open_video`. It is read in one sequential pass.
    rows, columns
        Half-open, px, after rotation. Without `rows` the strip is found (`find_strip`); without `columns` all
        are used.
    progress
        Called with (frames done, total frames or None) after every block.
    settings
        See `VideoSettings`.
    log
        Keeps the frames read, and supplies those of an interrupted run.
    follow
        Continue as the recording grows, until it is closed. The strip is found in its first frames.

    Returns
    -------
    xarray.DataArray
        "intensity" (frame, x), float32 grey levels, as `vision.data.STRIP` declares it. Coordinates are frame
        (number in the file), x (column), time_s, NaN where unknown, and status: "ok", "blank" (no picture),
        "corrupt" (could not be decoded) or "lost" (not in the file). Rows of frames that are not "ok" are
        NaN. Frame counts, clock, strip and warnings are in the attributes (`vision.data.StripMetadata`).

    Raises
    ------
    InputError
        For rows or columns outside the frame, if no frame can be used, or if the disk is full.

    Notes
    -----
    With rows :math:`z_0 \le z < z_1`,

    .. math:: I(x, t) = \frac{1}{z_1 - z_0} \sum_{z=z_0}^{z_1 - 1} g(x, z, t).

    Integers are summed exactly; the mean is rounded once, to float32. Source: paper, appendix B.
    """
    check_kind(Video, "what `vision.open_video` returns", video=video)
    check_kind(slice | None, RANGE, rows=rows, columns=columns)
    plan = _Plan.of(video, rows, columns, settings)
    folder = None if log is None else log.folder
    store = _store(plan.width, video, settings, folder)
    for part in () if log is None else log.begin(video, plan.strip.rows, plan.columns):
        store.add(part)
    for latest, block in _blocks(video, plan, store, follow):
        video = latest
        store.add(_reduced(video, block))
        if log is not None:
            log.add(store)
        if progress is not None:
            progress(store.count, video.estimated)
        if follow is not None and follow.seen is not None:
            recent = partial(_recent, plan, video, store)
            follow.seen(recent, None if video.estimated is None else video.estimated - store.count)
    if follow is not None:  # more frames of the strip are known by now
        now = measure_strip(video, plan.strip.rows, columns=plan.columns, settings=settings)
        plan = replace(plan, strip=replace(now, how=plan.strip.how))
        if not follow.closed.is_set():
            last = video.first + store.count - 1
            line = f"{video.path.name}: followed up to frame {last}; later ones are not read"
            video = replace(video, warnings=(*video.warnings, line))
    return plan.assembled(video, store.part(0, store.count))


def strip_profiles(
    video: Video,
    strips: int,
    rows: slice | None = None,
    *,
    columns: slice | None = None,
    progress: Progress | None = None,
    settings: VideoSettings = VideoSettings(),
    folder: Path | None = None,
) -> tuple[xr.DataArray, xr.DataArray]:
    r"""Return I(x, t) of the strip, and I(x, z, t) of parts of it at several heights, from one pass.

    Parameters
    ----------
    video, rows, columns, progress, settings
        As for `strip_profile`.
    strips
        Number of parts, 2 or more; their heights differ by at most one row.
    folder
        Where the temporary file of a long film is made; by default the system's folder for these.

    Returns
    -------
    xarray.DataArray, xarray.DataArray
        The strip as `strip_profile` returns it, and its parts, "intensity" (z, frame, x), as
        `vision.data.STRIP_PARTS` declares them; z is the middle of a part's rows, px.

    Raises
    ------
    InputError
        As `strip_profile`, and for parts of fewer than two rows.
    """
    plan = _Plan.of(video, rows, columns, settings)
    first, height, width = plan.strip.rows.start, plan.strip.rows.stop - plan.strip.rows.start, plan.width
    if not 2 <= strips <= height // 2:
        wanted = f"2 to {height // 2} parts of the strip's {height} rows" if height >= 4 else "4 rows or more"
        raise InputError("`strips`", wanted, f"{strips} of {height} rows")
    edges = np.linspace(0, height, strips + 1).round().astype(int)
    parts = [slice(None), *(slice(*pair) for pair in pairwise(edges))]
    store = _store((1 + strips) * width, video, settings, folder)
    for block in prefetch(video.blocks(plan.strip.rows, plan.columns), video.path, settings.answer_s):
        store.add(_reduced(video, block, parts))
        if progress is not None:
            progress(store.count, video.estimated)
    read = store.part(0, store.count)
    whole = plan.assembled(video, replace(read, intensity=read.intensity[:, :width]))
    intensity = read.intensity[:, width:].reshape(-1, strips, width).swapaxes(0, 1)
    for part in intensity:
        blank_out(part, whole["status"].values != "ok")
    z = first + (edges[:-1] + edges[1:] - 1) / 2
    heights = xr.DataArray(
        intensity,
        dims=("z", "frame", "x"),
        coords={"z": ("z", z, STRIP_PARTS["z"].attrs), "frame": whole["frame"], "x": whole["x"]},
        name="intensity",
        attrs=STRIP_PARTS["intensity"].attrs,
    )
    return whole, record(heights, "strip_profiles", strips=strips)


def _store(columns: int, video: Video, settings: VideoSettings, folder: Path | None) -> FrameStore:
    """Return an empty storage for the frames of a recording."""
    return FrameStore(
        columns,
        expected=video.estimated,
        spill_bytes=settings.spill_bytes,
        memory_bytes=settings.memory_bytes,
        folder=folder,
    )


@dataclass(frozen=True)
class _Plan:
    """The rows and columns that are read of every frame, and those that were asked for."""

    strip: Strip
    columns: slice
    asked: Mapping[str, list[int] | None]
    settings: VideoSettings

    @classmethod
    def of(cls, video: Video, rows: slice | None, columns: slice | None, settings: VideoSettings) -> _Plan:
        """Return the plan for the given rows, or for the strip that is found if rows is None."""
        x = cut(columns, video.shape[1], what=f"{video.path}: `columns`")
        spans = {"rows": rows, "columns": columns}
        asked = {name: span and [span.start, span.stop] for name, span in spans.items()}
        return cls(choose_strip(video, rows, columns=x, settings=settings), x, asked, settings)

    @property
    def width(self) -> int:
        return int(self.columns.stop - self.columns.start)

    def assembled(self, video: Video, read: FramesRead, first: int = 0) -> xr.DataArray:
        """Return I(x, t) of the frames read; `first` is the number of frames read before them.

        Raises: InputError if no frame can be used.
        """
        intensity, status, settings = read.intensity, read.status, self.settings
        readable, saturated = status == "ok", video.saturation_level
        status[is_blank(intensity, readable, saturation_level=saturated, settings=settings)] = "blank"
        blank_out(intensity, status != "ok")
        if not (status == "ok").any():
            raise _nothing_to_see(video, status)
        frames = video.first + first + np.arange(status.size, dtype=np.int64)
        profile = xr.DataArray(
            intensity,
            dims=("frame", "x"),
            coords={
                "frame": ("frame", frames, STRIP["frame"].attrs),
                "x": ("x", np.arange(self.columns.start, self.columns.stop), STRIP["x"].attrs),
                "time_s": ("frame", read.times_s, STRIP["time_s"].attrs),
                "status": ("frame", status, STRIP["status"].attrs),
            },
            name="intensity",
            attrs=STRIP["intensity"].attrs | _metadata(video, self.strip, read, settings).attrs(),
        )
        return record(profile, "strip_profile", **self.asked, settings=changed_settings(settings))


def reference_frame(video: Video) -> Pixels:
    """Return the first readable frame that is not constant, whole, after rotation.

    Raises
    ------
    InputError
        If there is none.
    """
    # first try only the first frame, which suffices in most films, so that no others are decoded
    for part in (replace(video, stop=video.first + 1), video):
        for pixels in part.frames():
            if pixels.min() < pixels.max():
                return pixels
    raise InputError(video.path, "at least one frame that shows something", "none")


def _recent(plan: _Plan, video: Video, store: FrameStore, count: int) -> xr.DataArray:
    """Return I(x, t) of the last `count` frames in the store."""
    first = max(0, store.count - count)
    return plan.assembled(video, store.copy(first, store.count), first)


def _blocks(
    video: Video, plan: _Plan, store: FrameStore, follow: Follow | None
) -> Iterator[tuple[Video, Block]]:
    """Yield the blocks after the frames in the store, with the recording from which they are read.

    A growing recording is opened repeatedly; its last frames are read when it is closed.
    """
    rows, columns, settings = plan.strip.rows, plan.columns, plan.settings
    if follow is None:
        rest = replace(video, first=video.first + store.count)
        yield from (
            (video, block) for block in prefetch(rest.blocks(rows, columns), video.path, settings.answer_s)
        )
        return
    wanted = math.inf if video.stop is None else video.stop - video.first
    for now, whole in growth(video, follow, settings):
        again = min(store.count, 1)  # the last frame is read again, and must be the same
        margin = 0 if whole else settings.follow_margin
        stop = None if now.stop is None else now.stop + margin
        rest = replace(now, first=video.first + store.count - again, stop=stop)
        read = prefetch(rest.blocks(rows, columns), video.path, settings.answer_s)
        blocks = held_back(read if whole else _readable(read), margin)
        for block in _continued(now, blocks, store.copy(store.count - again, store.count)):
            yield now, block
            if follow.stop.is_set():
                return
        if whole or store.count == wanted:
            follow.closed.set()
            return


def _readable(blocks: Iterator[Block]) -> Iterator[Block]:
    """Yield the blocks before one that cannot be read yet, as in an MP4 with an incomplete last part."""
    with contextlib.suppress(InputError):
        yield from blocks


def _continued(video: Video, blocks: Iterator[Block], known: FramesRead) -> Iterator[Block]:
    """Yield the blocks without the frames that are already known.

    Raises: InputError if those frames have changed.
    """
    count = known.status.size
    for block in blocks:
        if count:
            same = _reduced(video, part_of(block, 0, count)).intensity
            if not np.array_equal(same, known.intensity, equal_nan=True):
                wanted, found = "a recording that only grows while it is followed", "other frames than before"
                raise InputError(video.path, wanted, found, "run again when it is complete")
        stop = len(block.status) if video.stop is None else min(len(block.status), video.stop - block.start)
        if stop > count:
            yield part_of(block, count, stop)
        count = 0


def _reduced(video: Video, block: Block, parts: Sequence[slice] = (slice(None),)) -> FramesRead:
    """Return the row means of each part of the rows, side by side, and status and times of one block."""
    means = np.concatenate([row_means(block.pixels[:, part]) for part in parts], axis=1)
    status = np.array(block.status, STATUS_TYPE)
    not_finite = ~np.isfinite(means).all(axis=1)
    means[not_finite] = np.nan  # infinities would spread into sums over frames
    status[(status == "ok") & not_finite] = "corrupt"
    numbers = np.arange(block.start, block.start + status.size, dtype=np.int64)
    return FramesRead(means, status, video.times(numbers) if block.times_s is None else block.times_s)


def row_means(pixels: Pixels) -> Floats32:
    """Return the mean over the rows of each frame, (k, rows, columns) to (k, columns).

    Integers are summed exactly, in the narrowest type that cannot overflow, which is three times as fast
    for 8 bits.
    """
    rows = pixels.shape[1]
    if pixels.dtype.kind == "f":
        return np.asarray(pixels.mean(axis=1, dtype=np.float64), np.float32)
    top = rows * ((1 << 8 * pixels.dtype.itemsize) - 1)
    wide = np.uint16 if top < 1 << 16 else np.uint32 if top < 1 << 32 else np.uint64
    return np.asarray(np.add.reduce(pixels, axis=1, dtype=wide) / rows, np.float32)


def _nothing_to_see(video: Video, status: Strings) -> InputError:
    """Return the error that says why no frame can be used."""
    if not status.size:
        return InputError(video.path, "frames within `frames`", "the file ends before them")
    names, counts = np.unique(status, return_counts=True)
    found = ", ".join(f"{count} {name}" for name, count in zip(names, counts, strict=True))
    is_float = video.saturation_level is None
    advice = "cut NaN off with `columns`" if is_float else "check `rows` and `columns`"
    return InputError(video.path, "at least one frame that shows something", f"none ({found})", advice)


def _metadata(video: Video, strip: Strip, read: FramesRead, settings: VideoSettings) -> StripMetadata:
    facts, clock = video.facts, video.clock
    status = read.status
    expected, warnings = expected_frames(video, status, read.times_s, settings=settings)
    usable = int(np.isin(status, ("ok", "blank")).sum())
    return StripMetadata(
        source=str(video.path),
        container=facts.container,
        codec=facts.codec,
        pixel_format=facts.pixel_format,
        decoder=facts.decoder,
        grey=facts.grey,
        file_pixel_size_um=math.nan if facts.pixel_size_um is None else facts.pixel_size_um,
        file_scale_unused=facts.scale_unused,
        rotate=video.rotate,
        depth_bits=video.depth_bits,
        saturation_level=math.nan if video.saturation_level is None else video.saturation_level,
        strip_z0=strip.rows.start,
        strip_z1=strip.rows.stop,
        strip_how=strip.how,
        strip_clarity=strip.clarity,
        tilt_deg=strip.tilt_deg,
        strip_halves_px=strip.errors.halves_px,
        strip_bow_px=strip.errors.bow_px,
        strip_err_px=strip.errors.error_px,
        clock_kind=clock.kind,
        clock_file=video.timestamps,
        fps=math.nan if clock.fps is None else clock.fps,
        frames_expected=expected,
        frames_read=usable,
        frames_lost=expected - usable,
        frames_blank=int((status == "blank").sum()),
        frames_corrupt=int((status == "corrupt").sum()),
        warnings=[*video.warnings, *video.changes, *strip.warnings, *warnings],
    )
