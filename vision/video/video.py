"""open_video() and Video: a film with its rotation, range of frames and clock."""

from __future__ import annotations

import glob
import os
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import NoneType
from typing import Literal

import numpy as np

from vision.errors import PATH, RANGE, InputError, check_kind, check_within, shown
from vision.files import Stamp, answered, check_pixels, check_regular, members, reading
from vision.folder import html_table, numbered
from vision.numeric import Floats, Ints, Pixels
from vision.video.raw import PIXELS, is_photron, open_raw, photron_files
from vision.video.reader import Block, Facts, Reader
from vision.video.settings import VideoSettings
from vision.video.stacks import IMAGES, is_tiff, open_sequence, open_stack
from vision.video.times import read_timestamps, unit_warning, usual_rate

FILMS = {".avi", ".mp4", ".m4v", ".mkv", ".mov", ".cine", PIXELS}
"""Suffixes by which the films of a folder are found. A film that is named may have any suffix."""
_BOXES = set(b"ftyp moov mdat moof styp sidx free skip wide uuid".split())  # parts of an MP4
_MOST_PARTS = 10_000  # a fragmented MP4 has two a second


@dataclass(frozen=True)
class FrameClock:
    """Source of the frame times."""

    # time stamps or rate of the recording itself ("file"), `fps` or `timestamps` ("given"), or a container's
    # rate, which need not be the camera's ("playback")
    kind: Literal["file", "given", "playback"]
    fps: float | None  # None if unknown


@dataclass(repr=False, frozen=True, kw_only=True)
class Video:
    """A recording, opened by `open_video`: facts are known at once, pixels are read in one sequential pass.

    The whole file is never loaded.
    """

    path: Path
    reader: Reader  #: code for its format
    rotate: int  #: degrees clockwise by which frames are turned after the file's own rotation
    first: int  #: range of frame numbers, half-open
    stop: int | None  #: None: the end
    given_fps: float | None  #: the camera's clock as given by the user, instead of the file's
    given_times_s: Floats | None
    timestamps: Path | None  #: file that the given times are from
    warnings: tuple[str, ...]  #: defects of the file that its headers show
    pixels_path: Path  #: file or folder that holds the pixels: `path`, or the .mraw of a Photron recording
    stamp: Stamp  #: its size and time when it was opened
    answer_s: float  #: see `VideoSettings.answer_s`

    def __repr__(self) -> str:
        count = "an unknown number of" if self.expected is None else self.expected
        rate = "" if self.clock.fps is None else f", {self.clock.fps:g} frames/s ({self.clock.kind})"
        rows, columns = self.shape
        return f"<{self.path.name}: {count} frames of {columns} x {rows} px, {self.depth_bits} bit{rate}>"

    def _repr_html_(self) -> str:
        rows, columns = self.shape
        known = self.clock.fps is not None
        table = {
            "frames": "not known" if self.expected is None else str(self.expected),
            "size": f"{columns} x {rows} px, {self.depth_bits} bit",
            "frame rate": f"{self.clock.fps:g} /s ({self.clock.kind})" if known else "not known",
            "duration": "not known" if self.duration_s is None else f"{self.duration_s:.4g} s",
        }
        return html_table(self.path.name, table | numbered("warning", self.warnings))

    @property
    def facts(self) -> Facts:
        """Facts from the file's headers, before rotation and cuts."""
        return self.reader.facts

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) after rotation."""
        rows, columns = self.facts.shape
        return (columns, rows) if self.turned_deg % 180 else (rows, columns)

    @property
    def turned_deg(self) -> int:
        """Degrees clockwise by which stored pictures are turned: the file's own rotation, then `rotate`."""
        return (self.facts.turned_deg + self.rotate) % 360

    @property
    def depth_bits(self) -> int:
        """Significant bits per pixel; 32 for float."""
        return self.facts.depth_bits

    @property
    def saturation_level(self) -> float | None:
        """Value of a saturated pixel; None for float."""
        return self.facts.saturation_level

    @property
    def expected(self) -> int | None:
        """Number of frames in the range according to the file's headers; None if they do not state it."""
        return self._kept(self.facts.declared_frames)

    @property
    def estimated(self) -> int | None:
        """`expected`, or an estimate from duration and rate; None without either."""
        return self._kept(self.facts.frames)

    def _kept(self, held: int | None) -> int | None:
        if held is None:
            return None
        return max(0, (held if self.stop is None else min(held, self.stop)) - self.first)

    @property
    def duration_s(self) -> float | None:
        """Duration by the given times or the file's own clock; None without, or for a part of the file."""
        if self.given_times_s is not None and self.stop is None and self.first == 0:
            times_s, rate = self.given_times_s, self.clock.fps
            return None if rate is None else float(np.nanmax(times_s) - np.nanmin(times_s)) + 1 / rate
        return self.facts.duration_s if self.stop is None and self.clock.kind == "file" else None

    @property
    def clock(self) -> FrameClock:
        """The clock in use: given, else the file's own, else the playback rate."""
        if self.given_times_s is not None:
            return FrameClock("given", usual_rate(self.given_times_s))
        if self.given_fps is not None:
            return FrameClock("given", self.given_fps)
        if self.facts.times_s is not None:
            return FrameClock("file", usual_rate(self.facts.times_s))
        if self.facts.camera_fps is not None:
            return FrameClock("file", self.facts.camera_fps)
        return FrameClock("file" if self.facts.times_in_blocks else "playback", self.facts.playback_fps)

    def times(self, frames: Ints) -> Floats:
        """Return the time of each frame number, s; NaN where unknown."""
        table = self.given_times_s
        if table is None and self.given_fps is None:
            table = self.facts.times_s
        if table is None:
            fps = self.clock.fps
            return np.full(frames.shape, np.nan) if fps is None else frames / fps
        out = np.full(frames.shape, np.nan)
        known = (frames >= 0) & (frames < table.size)
        out[known] = table[frames[known]]
        return out

    def blocks(self, rows: slice | None = None, columns: slice | None = None) -> Iterator[Block]:
        """Read all frames in one sequential pass, cut after rotation.

        Raises: InputError for a cut outside the frame.
        """
        height, width = self.shape
        r = cut(rows, height, what=f"{self.path}: `rows`")
        c = cut(columns, width, what=f"{self.path}: `columns`")
        file_rows, file_columns = _before_rotation(r, c, self.facts.shape, self.turned_deg)
        blocks = self.reader.read(self.first, self.stop, file_rows, file_columns)
        while (block := self._next(blocks)) is not None:
            times_s = block.times_s if self.clock.kind == "file" else None
            yield Block(self._turned(block.pixels), block.start, block.status, times_s)

    def _next(self, blocks: Iterator[Block]) -> Block | None:
        """Return the next block; InputError for any error of a decoder, or if the file was replaced."""
        with reading(self.path, "a recording that can be read to its end"):
            block = next(blocks, None)
        pixels = self.pixels_path
        change = self.stamp.change(pixels) if pixels.is_file() or block is None else ""
        if change not in ("", "grew", "was changed"):
            advice = "wait until nothing writes it, then run again"
            raise InputError(
                self.path, "a recording that stays as it is while it is read", f"one that {change}", advice
            )
        return block

    @property
    def changes(self) -> tuple[str, ...]:
        """A warning if the file has been written to since it was opened."""
        change = answered(lambda: self.stamp.change(self.pixels_path), self.path, self.answer_s)
        if not change:
            return ()
        return (f"{self.path.name}: the recording {change} while it was read: run again when it is complete",)

    def frames(self) -> Iterator[Pixels]:
        """Yield every readable frame, whole."""
        blocks = self.blocks()
        while (block := answered(lambda: next(blocks, None), self.path, self.answer_s)) is not None:
            for pixels, status in zip(block.pixels, block.status, strict=True):
                if status == "ok":
                    yield pixels

    def sample(self, count: int) -> Iterator[Pixels]:
        """Yield up to `count` frames spread over the recording, or the first if its length is unknown."""
        last = self.facts.frames or self.first + count
        last = last if self.stop is None else min(last, self.stop)
        spread = np.linspace(self.first, max(last - 1, self.first), count)
        found = self.reader.sample(np.unique(np.round(spread).astype(np.int64)).tolist())

        def following() -> Pixels | None:
            with reading(self.path, "a recording that can be read"):
                return next(found, None)

        while (pixels := answered(following, self.path, self.answer_s)) is not None:
            yield self._turned(pixels)

    def _turned(self, pixels: Pixels) -> Pixels:
        turns = -(self.turned_deg // 90)
        return np.rot90(pixels, k=turns, axes=(-2, -1)) if turns else pixels


def open_video(
    path: str | os.PathLike[str],
    *,
    rotate: int = 0,
    frames: slice | None = None,
    fps: float | None = None,
    timestamps: str | os.PathLike[str] | None = None,
    answer_s: float = VideoSettings.answer_s,
) -> Video:
    """Open a recording, to be read in one pass.

    Parameters
    ----------
    path
        A video file, a TIFF, a cine, a Photron .mraw or .cih, a folder or a glob of numbered images. Of a
        folder of films, which the command takes one by one, give a film.
    rotate
        Degrees clockwise by which each frame is turned: 0, 90, 180 or 270. A film that states how it is to be
        turned for display, as phones' films do, is first turned in that way.
    frames
        Half-open range of frame numbers; frames keep their numbers and times.
    fps
        The camera's rate, Hz.
    timestamps
        A text file with the time of every frame (`read_timestamps`). With neither `fps` nor `timestamps` the
        file's own time stamps are used if it has them, else its playback rate.
    answer_s
        Longest wait, s, for a disk or network that does not answer (`VideoSettings.answer_s`).

    Returns
    -------
    Video
        Its facts are known at once; no frame but the first is decoded yet.

    Raises
    ------
    InputError
        If the file cannot be read or an argument does not suit it.
    """
    check_kind(PATH, "the path of a video or of images", path=path)
    check_kind((*PATH, NoneType), "the path of a file with the time of every frame", timestamps=timestamps)
    check_within("a positive number of frames per second, at most 1e9", 1e-12, 1e9, fps=fps)
    where = Path(path)
    if rotate not in (0, 90, 180, 270):
        raise InputError("`rotate`", "0, 90, 180 or 270", str(rotate))
    if fps is not None and timestamps is not None:
        raise InputError("`fps` and `timestamps`", "one of the two", "both")

    def opened() -> tuple[Reader, Stamp, Path, int | None]:
        pixels = pixels_file(where)
        stamp = Stamp.of(pixels)  # before the file is opened
        with reading(where, "a recording"):
            again = _second_recording(pixels) if pixels.is_file() else None
            return _open_reader(where), stamp, pixels, again

    reader, stamp, pixels, again = answered(opened, where, answer_s)
    facts = reader.facts
    check_pixels(where, *facts.shape)
    first, stop = _frame_range(frames, facts.declared_frames, where)
    warnings, times_s = [*facts.warnings], None
    if again is not None:
        warnings.append(
            f"{where.name}: a second recording begins at byte {again}; its frames are left out, or follow as "
            "if no time had passed: save each in a file of its own"
        )
    if timestamps is not None:
        table = Path(timestamps)
        times_s, odd = answered(lambda: read_timestamps(table), table, answer_s)
        warnings += odd
        if facts.declared_frames not in (None, times_s.size):
            wanted = f"{facts.declared_frames} times, one per frame of {where.name}"
            raise InputError(timestamps, wanted, f"{times_s.size} times")
        warnings += unit_warning(times_s, facts.playback_fps, table.name)
    if stop is not None and facts.frames is not None and stop > facts.frames:
        about = "" if facts.declared_frames else "about "
        warnings.append(f"`frames`: asked for frames up to {stop}, the file has {about}{facts.frames}")
    return Video(
        path=where,
        reader=reader,
        rotate=rotate,
        first=first,
        stop=stop,
        given_fps=fps,
        given_times_s=times_s,
        timestamps=None if timestamps is None else Path(timestamps),
        warnings=tuple(warnings),
        pixels_path=pixels,
        stamp=stamp,
        answer_s=answer_s,
    )


def _second_recording(path: Path) -> int | None:
    """Return the byte at which another recording begins in an AVI or MP4, as where two files were joined.

    None for a single one. The parts of a file follow each other by the lengths that they state. Those of
    OpenDML, from 1 GiB on, belong to the AVI before.
    """
    with path.open("rb") as file:
        size, at = os.fstat(file.fileno()).st_size, 0
        for _ in range(_MOST_PARTS):
            file.seek(at)
            head = file.read(16)
            if head[:4] == b"RIFF" and len(head) == 16:
                length = 8 + int.from_bytes(head[4:8], "little")
                begins, length = head[8:12] == b"AVI ", length + length % 2
            elif head[4:8] in _BOXES and len(head) == 16:
                short = int.from_bytes(head[:4], "big")
                length = int.from_bytes(head[8:], "big") if short == 1 else short
                begins = head[4:8] == b"ftyp"
            else:
                return None
            if begins and at:
                return at
            if not 8 <= length < size - at:
                return None
            at += length
    return None


def video_files(path: Path) -> tuple[Path, ...]:
    """Return the files of a recording: one, or the pixels and the header of a Photron recording."""
    return photron_files(path) if path.is_file() and is_photron(path) else (path,)


def files_in(folder: Path, suffixes: Collection[str]) -> list[Path]:
    """Return the files of a folder, or of a pattern, with one of these suffixes, in order of their names.

    Hidden ones are left out.  Raises: InputError if the folder cannot be read.
    """
    with reading(folder, "a folder that can be read", "check its permissions"):
        files = [file for file in sorted(members(folder)) if file.suffix.lower() in suffixes]
    return [file for file in files if not file.name.startswith(".") and file.is_file()]


def pixels_file(path: Path) -> Path:
    """Return the file of a recording that holds its pixels, which grows while a camera writes."""
    try:
        return video_files(path)[0]
    except InputError:  # opening the recording reports that the other file is missing
        return path


def _open_reader(path: Path) -> Reader:
    """Return the reader for this kind of file, recognised by its first bytes."""
    if path.is_dir() or (not path.exists() and glob.has_magic(str(path))):
        try:
            return open_sequence(path)
        except InputError:
            if path.is_dir() and (films := files_in(path, FILMS)) and not files_in(path, IMAGES):
                found, advice = f"a folder of {len(films)} film(s)", f"give a film in it, such as {films[0]}"
                raise InputError(path, "a film or a folder of images", found, advice) from None
            raise
    check_regular(path, "a video, a TIFF, a folder or glob of images")
    with path.open("rb") as file:
        head = file.read(12)
    if not head:
        advice = "copy it again from the camera's computer"
        raise InputError(path, "a video", "an empty file (0 bytes)", advice)
    if (reader := open_raw(path, head)) is not None:
        return reader
    if is_tiff(head):
        return open_stack(path)
    if path.suffix.lower() in IMAGES:
        return open_sequence(path)
    from vision.video.encoded import open_encoded  # loads FFmpeg, 30 ms that raw films do not need

    return open_encoded(path)


def _frame_range(frames: slice | None, declared: int | None, path: Path) -> tuple[int, int | None]:
    """Return `frames` as first and stop; InputError if it is no range or contains no frame."""
    check_kind(slice | None, RANGE, frames=frames)
    if frames is None:
        return 0, None
    first = 0 if frames.start is None else int(frames.start)
    stop = None if frames.stop is None else int(frames.stop)
    if frames.step not in (None, 1) or first < 0 or (stop is not None and stop <= first):
        step = "" if frames.step is None else f":{frames.step}"
        raise InputError("`frames`", "A:B with 0 <= A < B", f"{frames.start}:{frames.stop}{step}")
    if declared is not None and first >= declared:
        raise InputError(f"{path}: `frames`", f"a start below {declared}, the frames in the file", str(first))
    return first, stop


def cut(wanted: slice | None, size: int, *, what: str) -> slice:
    """Check `wanted` against `size` pixels: InputError unless 0 <= start < stop <= size."""
    if wanted is None:
        return slice(0, size)
    if not isinstance(wanted, slice):
        raise InputError(what, RANGE, shown(wanted))
    start = 0 if wanted.start is None else int(wanted.start)
    stop = size if wanted.stop is None else int(wanted.stop)
    if wanted.step not in (None, 1) or not 0 <= start < stop <= size:
        advice = "counted from 0, end not included"
        step = "" if wanted.step in (None, 1) else f" in steps of {wanted.step}"
        raise InputError(what, f"a range within 0:{size}", f"{start}:{stop}{step}", advice)
    return slice(start, stop)


def _before_rotation(rows: slice, columns: slice, shape: tuple[int, int], rotate: int) -> tuple[slice, slice]:
    """Return the file's rows and columns that become `rows` and `columns` after rotation."""
    for turn in reversed(range(rotate // 90)):  # quarter turns are undone, the last one first
        size = shape[turn % 2]
        rows, columns = slice(size - columns.stop, size - columns.start), rows
    return rows, columns
