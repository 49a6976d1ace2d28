"""I(x, t): the mean of the strip's rows in each frame, from one pass over the recording."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import xarray as xr

from vision.data import STRIP_PARTS, StripMetadata, changed_settings, record, strip_of
from vision.errors import RANGE, InputError, check_kind, counted, reason_of
from vision.files import Progress, prefetch
from vision.memory import (
    give_back,
    in_two_threads,
    parts_in_turn,
    put_rows,
    row_parts,
    some_rows,
    table_in_file,
)
from vision.numeric import Bools, Floats, Floats32, Pixels, Strings, spread_indices
from vision.video.follow import Follow, followed
from vision.video.reader import Block
from vision.video.settings import VideoSettings
from vision.video.strip_find import Strip, find_strip, measure_strip
from vision.video.times import are_uneven, lost_between, thinned_from, usual_step_s
from vision.video.torn import TornFrames
from vision.video.video import Video, cut

STATUS_TYPE = "<U7"  # ok, blank, corrupt, lost
_COLUMN_FRAMES = 200  # spread over the film, which show padding and the gain of the columns
_COLUMN_PARTS = 8  # of the columns, which must agree


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
        "corrupt" (not decoded, or predicted from such a one) or "lost" (not in the file). Rows of frames that
        are not "ok" are NaN. Frame counts, clock, strip and warnings are in the attributes
        (`vision.data.StripMetadata`).

    Raises
    ------
    InputError
        For rows or columns outside the frame, if no frame can be used, or if the disk is full.

    Notes
    -----
    With rows :math:`z_0 \le z < z_1`,

    .. math:: I(x, t) = \frac{1}{z_1 - z_0} \sum_{z=z_0}^{z_1 - 1} g(x, z, t).

    Integers are summed exactly; the mean is rounded once, to float32. Columns below a Bayer pattern are
    brought to one brightness (`equalise_columns`). Source: paper, appendix B.
    """
    check_kind(Video, "what `vision.open_video` returns", video=video)
    check_kind(slice | None, RANGE, rows=rows, columns=columns)
    plan = _Plan.of(video, rows, columns, settings)
    folder = None if log is None else log.folder
    store = FrameStore(plan.width, expected=video.estimated, settings=settings, folder=folder)
    for part in () if log is None else log.begin(video, plan.strip.rows, plan.columns):
        store.add(part)

    def recent(count: int) -> xr.DataArray:
        first = max(0, store.count - count)
        return plan.assembled(video, store.copy(first, store.count), first)

    torn = TornFrames(plan.strip.rows.stop - plan.strip.rows.start, plan.width, settings)
    for latest, block in _blocks(video, plan, store.count, follow):
        video = latest
        read = _reduced(video, block)
        store.add(read)
        if torn.examines(block.start):
            upper = row_means(block.pixels[:, : torn.upper_rows])
            torn.add(read.intensity, upper, read.status == "ok", block.start)
        if log is not None:
            log.add(store)
        if progress is not None:
            progress(store.count, video.estimated)
        if follow is not None and follow.seen is not None:
            follow.seen(recent, None if video.estimated is None else video.estimated - store.count)
    if follow is not None:  # more frames of the strip are known by now
        now = measure_strip(video, plan.strip.rows, columns=plan.columns, settings=settings)
        plan = replace(plan, strip=replace(now, how=plan.strip.how))
        if not follow.closed.is_set():
            last = video.first + store.count - 1
            line = f"{video.path.name}: followed up to frame {last}; later ones are not read"
            video = replace(video, warnings=(*video.warnings, line))
    video = replace(video, warnings=(*video.warnings, *torn.warnings(video.path.name)))
    profile = plan.assembled(video, store.part(0, store.count))
    _check_shows_something(video, profile["status"].values)
    return profile


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
    """Return I(x, t) as `strip_profile` does, and I(x, z, t) of parts of the strip one above the other.

    Both are read in one pass. The parts, "intensity" (z, frame, x), are as `vision.data.STRIP_PARTS` declares
    them; z is the middle of a part's rows, px. Their heights differ by at most one row.

    strips: number of parts, 2 or more.  folder: where the temporary file of a long film is made; by default
    the system's folder for these.

    Raises: InputError as `strip_profile`, and for parts of fewer than two rows.
    """
    plan = _Plan.of(video, rows, columns, settings)
    first, height, width = plan.strip.rows.start, plan.strip.rows.stop - plan.strip.rows.start, plan.width
    if not 2 <= strips <= height // 2:
        wanted = f"2 to {height // 2} parts of the strip's {height} rows" if height >= 4 else "4 rows or more"
        raise InputError("`strips`", wanted, f"{strips} of {height} rows")
    edges = np.linspace(0, height, strips + 1).round().astype(int)
    parts = [slice(None), *(slice(*pair) for pair in pairwise(edges))]
    store = FrameStore((1 + strips) * width, expected=video.estimated, settings=settings, folder=folder)
    for _, block in _blocks(video, plan, 0, None):
        store.add(_reduced(video, block, parts))
        if progress is not None:
            progress(store.count, video.estimated)
    read = store.part(0, store.count)
    whole = plan.assembled(video, replace(read, intensity=read.intensity[:, :width]))
    _check_shows_something(video, read.status)
    intensity = read.intensity[:, width:].reshape(-1, strips, width).swapaxes(0, 1)
    for part in intensity:
        blank_out(part, whole["status"].values != "ok")
        equalise_columns(part, whole["status"].values == "ok", settings)
    shown = whole["x"].values - plan.columns.start  # without padding
    intensity = intensity[:, :, shown[0] : shown[-1] + 1]
    z = first + (edges[:-1] + edges[1:] - 1) / 2
    heights = xr.DataArray(
        intensity,
        dims=("z", "frame", "x"),
        coords={"z": ("z", z, STRIP_PARTS["z"].attrs), "frame": whole["frame"], "x": whole["x"]},
        name="intensity",
        attrs=STRIP_PARTS["intensity"].attrs,
    )
    return whole, record(heights, "strip_profiles", strips=strips)


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
        how: dict[str, Any] = {"columns": x, "settings": settings}
        strip = find_strip(video, **how) if rows is None else measure_strip(video, rows, **how)
        return cls(strip, x, asked, settings)

    @property
    def width(self) -> int:
        return int(self.columns.stop - self.columns.start)

    def assembled(self, video: Video, read: FramesRead, first: int = 0) -> xr.DataArray:
        """Return I(x, t) of the frames read; `first` is the number of frames read before them."""
        intensity, status, settings = read.intensity, read.status, self.settings
        readable, saturated = status == "ok", video.saturation_level
        status[is_blank(intensity, readable, saturation_level=saturated, settings=settings)] = "blank"
        blank_out(intensity, status != "ok")
        shown = slice(0, self.width)
        if self.asked["columns"] is None:
            shown = without_padding(intensity, status == "ok", settings)
            intensity = intensity[:, shown]
        columns_differ = equalise_columns(intensity, status == "ok", settings)
        profile = strip_of(
            intensity,
            frame=video.first + first + np.arange(status.size, dtype=np.int64),
            first_x=self.columns.start + shown.start,
            time_s=read.times_s,
            status=status,
            attrs=_metadata(video, self.strip, read, settings, columns_differ, shown).attrs(),
        )
        return record(profile, "strip_profile", **self.asked, settings=changed_settings(settings))


def reference_frame(video: Video) -> Pixels:
    """Return the first readable frame that is not constant, whole, after rotation.  Raises: InputError."""
    # first try only the first frame, which suffices in most films, so that no others are decoded
    for part in (replace(video, stop=video.first + 1), video):
        for pixels in part.frames():
            if pixels.min() < pixels.max():
                return pixels
    raise InputError(video.path, "at least one frame that shows something", "none")


def _blocks(video: Video, plan: _Plan, known: int, follow: Follow | None) -> Iterator[tuple[Video, Block]]:
    """Yield the blocks after the first `known` frames, with the recording from which they are read."""
    rows, columns, settings = plan.strip.rows, plan.columns, plan.settings
    if follow is not None:
        yield from followed(video, rows, columns, known, follow, settings)
        return
    rest = replace(video, first=video.first + known)
    for block in prefetch(rest.blocks(rows, columns), video.path, settings.answer_s):
        yield video, block


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


def _check_shows_something(video: Video, status: Strings) -> None:
    """Raise `InputError`, which says why, if no frame can be used."""
    if not status.size:
        raise InputError(video.path, "frames within `frames`", "the file ends before them")
    names, counts = np.unique(status, return_counts=True)
    if "ok" not in names:
        found = ", ".join(f"{count} {name}" for name, count in zip(names, counts, strict=True))
        is_float = video.saturation_level is None
        advice = "cut NaN off with `columns`" if is_float else "check `rows` and `columns`"
        raise InputError(video.path, "at least one frame that shows something", f"none ({found})", advice)


_SAME_FACTS = ("container", "codec", "quantiser_step", "pixel_format", "decoder", "grey", "depth_bits")


def _metadata(
    video: Video,
    strip: Strip,
    read: FramesRead,
    settings: VideoSettings,
    columns_differ: float,
    shown: slice,
) -> StripMetadata:
    facts, clock = video.facts, video.clock
    status = read.status
    expected, warnings = expected_frames(video, status, read.times_s, settings=settings)
    if columns_differ:
        warnings.append(
            f"{video.path.name}: neighbouring columns differ in brightness by {100 * columns_differ:.0f} %,"
            " as below a Bayer pattern of colour filters; they were brought to the same brightness: record in"
            " grey, or with interpolated colour"
        )
    usable = int(np.isin(status, ("ok", "blank")).sum())
    padding = [(0, shown.start), (shown.stop, read.intensity.shape[1])]
    return StripMetadata(
        source=str(video.path),
        **{name: getattr(facts, name) for name in _SAME_FACTS},
        file_pixel_size_um=math.nan if facts.pixel_size_um is None else facts.pixel_size_um,
        file_scale_unused=facts.scale_unused,
        rotate=video.rotate,
        saturation_level=math.nan if video.saturation_level is None else video.saturation_level,
        strip_z0=strip.rows.start,
        strip_z1=strip.rows.stop,
        strip_how=strip.how,
        strip_clarity=strip.clarity,
        padding=[f"{first}:{stop}" for first, stop in padding if first < stop],
        tilt_deg=strip.tilt_deg,
        strip_halves_px=strip.errors.halves_px,
        strip_bow_px=strip.errors.bow_px,
        strip_err_px=strip.errors.error_px,
        clock_kind=clock.kind,
        clock_file="" if video.timestamps is None else video.timestamps.name,
        fps=math.nan if clock.fps is None else clock.fps,
        frames_expected=expected,
        frames_read=usable,
        frames_lost=expected - usable,
        frames_blank=int((status == "blank").sum()),
        frames_corrupt=int((status == "corrupt").sum()),
        warnings=[*video.warnings, *video.changes, *strip.warnings, *warnings],
    )


# --- blank and missing frames -------------------------------------------------------------------------------


def is_blank(
    profiles: Floats32,
    readable: Bools,
    *,
    saturation_level: float | None = None,
    settings: VideoSettings = VideoSettings(),
) -> Bools:
    """Return which readable frames do not show the scene, (frame), from their intensity (frame, x).

    A frame is blank if its profile is constant or saturated throughout, if its contrast (standard deviation
    along x) is below `settings.blank_contrast` of the recording's median contrast, or if the frame is
    brighter than usual and its contrast, relative to its level, is below `settings.bright_contrast` of the
    median. Dim frames keep their relative contrast, and motion blur preserves the gradient of the light and
    the edges of the comb. If more than half of a recording is blank, only constant and saturated frames are
    found; saturation_level is None for float.
    """
    level, contrast, darkest = np.empty((3, len(profiles)))

    def measure(span: slice) -> None:
        darkest[span], values = profiles[span].min(axis=1), profiles[span].astype(np.float64)
        level[span] = values.mean(axis=1)
        values -= level[span, None]
        contrast[span] = np.sqrt(np.square(values, out=values).mean(axis=1))
        give_back(profiles[span])

    in_two_threads(measure, row_parts(len(profiles), 64))  # parts that fit into a core's cache
    blank = contrast <= 1e-6 * np.maximum(np.abs(level), 1.0)
    if saturation_level is not None:
        blank |= darkest >= settings.saturated * saturation_level
    usual = readable & ~blank
    if usual.any():
        usual_level = float(np.median(level[usual]))
        usual_contrast = float(np.median(contrast[usual]))
        blank |= contrast < settings.blank_contrast * usual_contrast
        flat = contrast * usual_level < settings.bright_contrast * usual_contrast * level
        blank |= flat & (level > settings.bright_level * usual_level)
    return np.asarray(blank & readable, bool)


def blank_out(intensity: Floats32, unusable: Bools) -> None:
    """Set the intensity (frame, x) of unusable frames (frame) to NaN, in place."""
    for rows in parts_in_turn(intensity):
        intensity[rows][unusable[rows]] = np.nan


def expected_frames(
    video: Video, status: Strings, times_s: Floats, *, settings: VideoSettings = VideoSettings()
) -> tuple[int, list[str]]:
    """Return the number of frames expected, and one line for each kind of unusable or missing frame.

    It follows from the number of frames, the file's duration and gaps in its times. Frames lost between time
    stamps, or before the end that the file states, have no row but are counted. status, times_s: status and
    time of each frame in the file (frame).
    """
    name, warnings = video.path.name, []
    if video.expected is not None and status.size < video.expected:
        missing = video.expected - status.size
        found = f"{status.size} of {video.expected} expected frames are in the file"
        warnings.append(f"{name}: {found}; {missing} {'is' if missing == 1 else 'are'} missing")
    reasons = {
        "corrupt": "corrupt or predicted from corrupt ones",
        "lost": "lost by the camera",
        "blank": "blank",
    }
    for state, reason in reasons.items():
        which = np.flatnonzero(status == state)
        if which.size:
            where = f"the first is frame {video.first + which[0]}"
            warnings.append(f"{name}: {counted(which.size, 'frame')} {reason}, {where}")
    measured = video.clock.kind == "file" or (video.clock.kind == "given" and are_uneven(times_s))
    between, first = lost_between(times_s, settings=settings) if measured else (0, 0)
    if between:
        where = f"according to gaps in its times, the first after frame {video.first + first}"
        warnings.append(f"{name}: {counted(between, 'frame')} lost {where}")
    if measured and (thinned := thinned_from(times_s, settings=settings)) is not None:
        what = f"from frame {video.first + thinned} on, frames come at half or a third of the usual rate"
        warnings.append(f"{name}: {what}: the camera was slower, or frames are lost evenly")
    beyond = 0
    if video.clock.kind == "file" and video.duration_s is not None:
        known = times_s[np.isfinite(times_s)]
        usual_s = usual_step_s(known)
        missing_s = video.duration_s - float(known[-1]) if usual_s > 0 else 0.0
        if missing_s > settings.early_end_steps * usual_s:
            beyond = round(missing_s / usual_s) - 1  # the last frame itself lasts one step
            stated = f"{name}: the file should last {video.duration_s:.3f} s"
            warnings.append(f"{stated}; its last {missing_s:.3f} s are missing, about {beyond} frames")
    return max(status.size, video.expected or 0) + between + beyond, warnings


# --- columns beside the picture, and of unequal gain --------------------------------------------------------


def _frames_seen(intensity: Floats32, usable: Bools) -> Floats32:
    """Return frames that show something, spread over the film, copied; none if none does."""
    frames = np.flatnonzero(usable)
    if not frames.size:
        return intensity[:0]
    return some_rows(intensity, frames[spread_indices(frames.size, _COLUMN_FRAMES)])


def without_padding(intensity: Floats32, usable: Bools, settings: VideoSettings = VideoSettings()) -> slice:
    """Return the columns of I(x, t), (frame, x), without those that a program put beside the picture.

    Bars of one colour, as a film has that was fitted into a wider frame, and columns that repeat the
    picture's edge look like a background, which tells sheets from gaps. The columns from an edge on that
    equal the outermost one, up to `padding_level` of the range of grey levels, are padding if they end in
    nearly all frames with the same step, of at least `padding_step` of this range, twice as high as the next
    three: no sheet has such an edge that stands still. Columns that equal the outermost one exactly are
    padding if this scatters in time, against the whole frame, at least half as much as the quietest columns:
    a real background would scatter from column to column as well. usable: which frames show something.
    """
    some = _frames_seen(intensity, usable)
    if not len(some):
        return slice(0, intensity.shape[1])
    low, high = np.quantile(some, [0.02, 0.98])
    left, right = (_padding(line, float(high - low), settings) for line in (some, some[:, ::-1]))
    return slice(left, intensity.shape[1] - right)


def _padding(some: Floats32, contrast: float, settings: VideoSettings) -> int:
    """Return how many columns at the left of some frames (frame, x) are padding."""
    differs = np.abs(some - some[:, :1]).max(axis=0) > settings.padding_level * contrast
    count = int(differs.argmax())
    if not settings.padding_columns <= count < some.shape[1] - settings.padding_columns:
        return 0
    steps = np.abs(np.diff(some[:, count - 1 : count + 4], axis=1))
    still = steps[:, 0] > np.fmax(settings.padding_step * contrast, 2 * steps[:, 1:].max(axis=1))
    if still.mean() > 0.9:
        return count
    alike = int((np.ptp(some - some[:, :1], axis=0) > 0).argmax())  # exactly
    change = np.diff(some, axis=0)
    change = (
        np.abs(change - np.median(change, axis=1, keepdims=True)).mean(axis=0) if len(change) else some[0]
    )
    repeats = change[0] > np.quantile(change[count:], 0.1) / 2 > 0
    return alike if alike >= settings.padding_columns and repeats else 0


def equalise_columns(intensity: Floats32, usable: Bools, settings: VideoSettings = VideoSettings()) -> float:
    r"""Divide I(x, t), (frame, x), by the gain of its columns, in place, and return by how much they differ.

    Columns below a Bayer pattern of colour filters, saved as grey, are brighter and darker in turn. They hide
    ridges, shift positions within the pixel, and look like a reflection. With light L(x) that is smooth from
    pixel to pixel,

    .. math:: I(x) = L(x)\,\bigl(1 + (-1)^x a\bigr), \qquad
        a = \frac{\sum (-1)^x \left(I(x) - \tfrac12 I(x-1) - \tfrac12 I(x+1)\right)}{2 \sum I(x)} .

    The gain is corrected if the mean a of eight parts of the columns exceeds `settings.column_gain` and
    `settings.column_sigmas` times its standard error: sharp ridges contribute by chance, with another sign in
    each part. Sheets and gaps of different colours have different gains, of which this is the mean. The
    result is 2|a|, or 0 without a correction. usable: which frames show something, (frame,).
    """
    shown = _frames_seen(intensity, usable)
    if not len(shown) or intensity.shape[1] < 4 * _COLUMN_PARTS:
        return 0.0
    mean = shown.mean(axis=0, dtype=np.float64)
    sign = 1.0 - 2.0 * (np.arange(mean.size) % 2)
    beside = 0.5 * (mean[:-2] + mean[2:])
    sums = sign[1:-1] * (mean[1:-1] - beside), mean[1:-1] + beside
    change, level = ([part.sum() for part in np.array_split(one, _COLUMN_PARTS)] for one in sums)
    if min(level) <= 0:
        return 0.0
    gains = np.divide(change, level)
    gain, error = float(gains.mean()), float(gains.std(ddof=1) / np.sqrt(_COLUMN_PARTS))
    if not abs(gain) > max(settings.column_gain, settings.column_sigmas * error):
        return 0.0
    factor = (1 / (1 + sign * gain)).astype(np.float32)
    for rows in parts_in_turn(intensity):
        intensity[rows] *= factor
    return 2 * abs(gain)


# --- storage of the frames that are read --------------------------------------------------------------------


@dataclass(frozen=True)
class FramesRead:
    """Consecutive frames: intensity (frame, x), grey levels; status and time, s, of each frame."""

    intensity: Floats32
    status: Strings
    times_s: Floats


class FrameStore:
    """Growing storage of I(x, t): rows of float32, in memory or in a temporary file, each with its status and
    time.

    A row has `columns` values, and about `expected` rows will come. Above `settings.spill_bytes` they are
    stored in a temporary file in `folder`, by default the system's. If that disk is full they stay in memory,
    and above `settings.memory_bytes` InputError is raised.
    """

    def __init__(
        self,
        columns: int,
        *,
        expected: int | None,
        settings: VideoSettings = VideoSettings(),
        folder: Path | None = None,
    ) -> None:
        self._columns, self._settings, self._folder = columns, settings, folder
        self._marks = np.zeros(1024, [("status", STATUS_TYPE), ("time_s", np.float64)])
        self.count = 0
        """Number of rows so far."""
        most = max(1, 2 * settings.memory_bytes // (4 * columns))  # a damaged header may state any number
        self._rows = self._allocate(max(1, min(expected or 1024, most)))

    def append(self, rows: Floats32) -> None:
        """Add `rows` (k, columns) at the end."""
        needed = self.count + rows.shape[0]
        if needed > self._rows.shape[0]:
            old = self.rows()
            self._rows = self._allocate(max(needed, 2 * self._rows.shape[0]))
            for part in parts_in_turn(old):
                put_rows(self._rows, part.start, old[part])
        put_rows(self._rows, self.count, rows)
        self.count = needed

    def add(self, frames: FramesRead) -> None:
        """Add frames at the end."""
        needed = self.count + frames.status.size
        if needed > self._marks.size:
            more = np.zeros(max(needed, self._marks.size), self._marks.dtype)
            self._marks = np.concatenate([self._marks, more])
        new = self._marks[self.count : needed]
        new["status"], new["time_s"] = frames.status, frames.times_s
        self.append(frames.intensity)

    def rows(self) -> Floats32:
        """Return all rows so far, (n, columns), not copied."""
        return self._rows[: self.count]

    def part(self, start: int, stop: int) -> FramesRead:
        """Return frames `start` to before `stop`; the intensity is not copied."""
        marks = self._marks[start:stop].copy()
        return FramesRead(self.rows()[start:stop], marks["status"], marks["time_s"])

    def copy(self, start: int, stop: int) -> FramesRead:
        """Return frames `start` to before `stop`, copied."""
        part = self.part(start, stop)
        copied = replace(part, intensity=part.intensity.copy())
        give_back(part.intensity)
        return copied

    def _allocate(self, capacity: int) -> Floats32:
        size = capacity * self._columns * 4
        if size > self._settings.spill_bytes:
            try:
                return table_in_file((capacity, self._columns), self._folder)
            except OSError as error:
                if size > self._settings.memory_bytes:
                    raise self._no_room(size, error) from error
        return np.empty((capacity, self._columns), np.float32)

    def _no_room(self, size: int, error: OSError) -> InputError:
        wanted = f"{size / (1 << 30):.1f} GiB for I(x, t)"
        advice = "give another `out`, or `columns`" if self._folder else "set TMPDIR, or give `columns`"
        return InputError(self._folder or tempfile.gettempdir(), wanted, reason_of(error), advice)
