"""A run read back: a finished one from its folder, an interrupted one from what was kept beside it."""

from __future__ import annotations

import glob
import hashlib
import json
import math
import os
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, Self

import numpy as np
import pandas as pd
import tifffile
import xarray as xr
from numpy.typing import NDArray

import vision
from vision.data import TRACKS, StripMetadata, TrackMetadata
from vision.errors import InputError
from vision.files import READ_HDF5, check_regular, reading, shortened, try_out
from vision.numeric import Floats, Floats32
from vision.run.folder import (
    MARK,
    Parameter,
    describe_input,
    existing_parent,
    lock_folder,
    plain,
    reading_folder,
    write_json,
)
from vision.run.tables import attrs_of_netcdf
from vision.video import FramesRead, FrameStore, Video, VideoSettings, video_files
from vision.video.frames import ProfileStore
from vision.video.stacks import check_tiff
from vision.video.uncompressed import read_fully

AGAIN = "run track again"


@dataclass(frozen=True)
class RunFolder:
    """A run folder."""

    folder: Path
    facts: Mapping[str, Any]  # what run.json says
    tracks: xr.Dataset | None  # as `track_sheets` gave them; None for a run of a force recording alone

    @property
    def pixel_size_um(self) -> float | None:
        """µm per pixel as recorded in run.json; None where it was not given."""
        value = self._parameter("pixel_size")
        with reading(self.folder / MARK, "a pixel size in µm", AGAIN):
            if value is None or 0 < float(value) < math.inf:
                return None if value is None else float(value)
            raise ValueError(value)

    @property
    def first_column(self) -> int:
        """Column of the video at which the strip begins."""
        first = str(self._parameter("columns") or "").partition(":")[0].strip()
        return int(first) if first.isdigit() else 0

    def _parameter(self, name: str) -> Any:
        with reading(self.folder / MARK, "parameters as track writes them", AGAIN):
            return self.facts.get("parameters", {}).get(name, {}).get("value")


def is_run(folder: Path) -> bool:
    """Whether this is a run folder and no folder of images."""
    return (folder / MARK).is_file()


def check_mark(target: Path, mark: str) -> None:
    """Keep a run from being overwritten by what is made from it: `mark` stands in an earlier one's run.json.

    Raises: InputError.
    """
    if is_run(target) and mark not in read_json(target / MARK):
        raise InputError(target, f"a folder of {mark} to overwrite", "another run", "give another `out`")


def read_run(folder: Path) -> RunFolder:
    """Facts and tracks of a run folder.  Raises: InputError if it is none, or a file in it is damaged."""
    if not is_run(folder):
        found = "no run.json in it" if folder.is_dir() else "no such folder"
        raise InputError(folder, "a run folder of track", found, "give the folder that track wrote")
    facts = read_json(folder / MARK)
    tracks = folder / "tracks.nc"
    return RunFolder(folder, facts, _read_tracks(tracks) if tracks.exists() else None)


def parameters_of(folder: Path, facts: Mapping[str, Any]) -> dict[str, Parameter]:
    """What a run was made with, by the names of the command's options.

    Raises: InputError where run.json holds none, or something else in their place.
    """
    known = facts.get("parameters")
    if not isinstance(known, dict) or not all(isinstance(one, dict) for one in known.values()):
        raise InputError(folder / MARK, "the parameters of a run", "none", AGAIN)
    return {name: Parameter(one.get("value"), one.get("how", "given")) for name, one in known.items()}


def tracks_of(run: RunFolder) -> xr.Dataset:
    """The tracks of a run that has some.  Raises: InputError."""
    if run.tracks is None:
        raise InputError(run.folder, "a run of a video", "no tracks.nc in it", "give the run of a video")
    return run.tracks


def read_json(path: Path) -> dict[str, Any]:
    """One JSON object.  Raises: InputError."""
    with reading(path, "JSON as track writes it", AGAIN):
        content = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(content, dict):
        raise InputError(path, "a JSON object", f"a {type(content).__name__}", AGAIN)
    return content


def read_table(folder: Path, name: str) -> pd.DataFrame | None:
    """A CSV table of a run folder; None where it has none.  Raises: InputError for a damaged one."""
    path = folder / f"{name}.csv"
    if not path.exists():
        return None
    with reading(path, "a table as track writes it", AGAIN):
        return pd.read_csv(path)


def read_strip(run: RunFolder) -> xr.DataArray:
    """I(x, t) from kymograph.tif, with the coordinates and attributes `strip_profile` gave it.

    The values are a copy, beyond 1 GiB in a temporary file: a mapped file that becomes shorter kills the
    process. A frame's status is "ok" wherever its row has values, else the flag of its sheets.
    Raises: InputError where the file is missing, damaged, or does not fit the tracks.
    """
    tracks, path = tracks_of(run), run.folder / "kymograph.tif"
    values = _read_tif(path, tracks.sizes["frame"])
    first = run.first_column
    flags = tracks["flag"].values[:, 0]
    return xr.DataArray(
        values,
        dims=("frame", "x"),
        coords={
            "frame": tracks["frame"].values,
            "x": np.arange(first, first + values.shape[1], dtype=np.int64),
            "time_s": ("frame", tracks["time_s"].values, {"units": "s"}),
            "status": ("frame", np.where(np.isfinite(values[:, 0]), "ok", flags)),
        },
        name="intensity",
        attrs=tracks.attrs | {"units": "grey level", "long_name": "mean intensity of the strip"},
    )


def input_of(folder: Path, known: Mapping[str, Any], moved: Path | None = None) -> Path:
    """A file that the run was made from: `known` is its entry in run.json, `moved` where it lies now.

    Raises: InputError where it is gone, or another file has its name (by size and fingerprint).
    """
    named = Path(str(known["path"]))
    places = [named, folder.absolute().parent / named] if moved is None else [moved]
    path = next((place for place in places if _there(place)), None)
    if path is None:
        found, advice = "no such file", "say where it lies now (`film`)"
        raise InputError(places[0], f"an input of {folder}", found, advice)
    whole = "sha256" in known
    now = describe_input(path, whole=whole)
    if now["size_bytes"] != known["size_bytes"]:
        found = f"one of {now['size_bytes']} bytes"
        raise InputError(path, f"an input of {folder}, {known['size_bytes']} bytes", found)
    kind = "sha256" if whole else "fingerprint"
    if now.get(kind) != known.get(kind):
        raise InputError(path, f"an input of {folder}", "another of the same size", "track it again")
    return path


def _there(place: Path) -> bool:
    return place.exists() or bool(glob.glob(str(place)))  # noqa: PTH207  # may be absolute


def slip_times_s(run: RunFolder) -> Floats | None:
    """When the slips begin, in the video's seconds: the events' peaks moved by the run's clock.

    None where the run has no events, or its clocks are ambiguous: a slip in the wrong place is worse than
    none.
    """
    events, clock = read_table(run.folder, "events"), run.folder / "clock.json"
    if events is None or not clock.exists():
        return None
    facts = read_json(clock)
    if facts.get("status") not in ("ok", "given"):
        return None
    peaks = events["t_p_s"].to_numpy(np.float64)
    drift = 1 + 1e-6 * float(facts.get("drift_ppm") or 0.0)
    video_s = (peaks - float(facts["offset_s"])) / drift
    return np.asarray(video_s[np.isfinite(video_s)])


def _read_tracks(path: Path) -> xr.Dataset:
    """tracks.nc; HDF5 can crash or run for ever on a damaged file, so a process of its own tries it first."""
    wanted = "tracks as track writes them"
    try_out(path, READ_HDF5, wanted)
    with reading(path, wanted, AGAIN):
        with xr.open_dataset(path, engine="h5netcdf") as data:
            tracks = data.load()
        tracks.attrs = attrs_of_netcdf(tracks.attrs)
        words = [name for name in ("flag", "why") if name in tracks]
        tracks = tracks.assign({name: tracks[name].astype(str) for name in words})
        try:
            TRACKS.check(tracks)
            TrackMetadata.of(tracks)
            StripMetadata.of(tracks)
        except InputError as error:
            raise InputError(path, wanted, shortened(str(error)), AGAIN) from error
        numbers = [str(name) for name in TRACKS.variables if name in tracks.variables and name not in words]
        odd = [name for name in numbers if tracks[name].dtype.kind not in "fiu"]
        if odd:
            raise InputError(path, wanted, f"no numbers in {', '.join(odd)}", AGAIN)
    return tracks


def stored_kymograph(path: Path) -> tuple[int, np.dtype[Any], tuple[int, int]]:
    """Where in the file of a space-time diagram its values begin, their type and shape (frame, x).

    For reading a part at a time: it is never mapped, as a mapping of a file that shrinks ends the process.
    Raises: InputError for a damaged file.
    """
    wanted = "a space-time diagram as track writes it"
    check_regular(path, wanted)
    check_tiff(path, frames=False)
    with reading(path, wanted, AGAIN):
        with tifffile.TiffFile(path) as tif:
            page = tif.pages.first
            shape, dtype, start = page.shape, page.dtype, page.dataoffsets[0]
            plain = page.is_contiguous and dtype is not None and dtype.newbyteorder("=") == np.float32
            order = tif.byteorder
        if len(shape) != 2 or not plain:
            raise InputError(path, wanted, f"{dtype} of shape {shape}", AGAIN)
        return start, np.dtype(np.float32).newbyteorder(order), (shape[0], shape[1])


def _read_tif(path: Path, frames: int) -> Floats32:
    """The one page of a space-time diagram.  Raises: InputError."""
    start, stored, shape = stored_kymograph(path)
    if shape[0] != frames:
        raise InputError(path, f"{frames} rows, one per frame of tracks.nc", f"shape {shape}", AGAIN)
    rows = ProfileStore(shape[1], expected=frames)
    with (
        reading(path, "a space-time diagram as track writes it", AGAIN),
        path.open("rb", buffering=0) as file,
    ):
        file.seek(start)
        for first in range(0, frames, 4096):
            part = np.empty((min(4096, frames - first), shape[1]), stored)
            read_fully(file, part.data.cast("B"), path)
            rows.append(part.astype(np.float32, copy=False))
    return rows.rows()


# --- what an interrupted run kept ---------------------------------------------------------------------------


FRAMES, FACTS = "frames", "reading.json"
STATUS = ("", "ok", "corrupt", "lost")  # by their number in the file; 0 is what a crash leaves unwritten
PART = 4096  # frames read back at a time
RESTART = "run without `resume` to start at the first frame"


class Checkpoint:
    """Keeps I(x, t) block by block while a film is read, and gives it back to a run that resumes.

    A folder beside the run folder, hidden as the run folder itself is until it is whole, holds one file that
    grows by a record per frame (status, time, the strip's mean) and one that says what is read and how. It
    exists once the reading has taken `after_s`, and until the run folder is written: `done` removes it. A
    record that was cut short by a kill is left out.

    With `resume` a run goes on where an interrupted one of the same film with the same settings ended, or
    from the first frame where nothing was kept; without, what an earlier run left is removed. Frames are
    numbered without gaps (`vision.video.Reader`), and each row is computed from its frame alone, so that the
    result is the same bit for bit. A disk that is full costs the checkpoint, not the run.

    Raises
    ------
    InputError
        With `resume`: on entering, where another process reads into the same folder; from `begin`, where the
        film or the way it is read is another one.
    """

    def __init__(
        self, target: Path, *, resume: bool = False, after_s: float = VideoSettings.resume_after_s
    ) -> None:
        # where I(x, t) may spill: on the disk that has room for results
        self.folder = existing_parent(target)
        self.resumed = 0  # frames taken over from the interrupted run
        self.kept = 0  # frames in the file by now
        self._target, self._place = target, reading_folder(target)
        self._resume, self._after_s = resume, after_s
        self._began = time.monotonic()
        self._own = False  # whether the folder is this run's
        self._off = False  # whether nothing is kept: another run has the folder, or it cannot be written
        self._lock: int | None = None
        self._file: BinaryIO | None = None
        self._facts: Callable[[], dict[str, Any]] = dict

    def __enter__(self) -> Self:
        if self._place.is_dir():
            self._lock = lock_folder(self._place)
            self._own = self._lock is not None or os.name != "posix"
            self._off = not self._own
            if self._off and self._resume:
                found, advice = "one that still runs", "wait for it, or give another `out`"
                raise InputError(self._target, "an interrupted run to resume", found, advice)
            if not self._resume:
                self.done()
        return self

    def __exit__(self, *error: object) -> None:
        if self._file is not None:
            self._file.close()
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def done(self) -> None:
        """Leave nothing to resume: the run folder is written."""
        if self._own:
            shutil.rmtree(self._place, ignore_errors=True)
        self.__exit__()
        self._file, self._own, self.kept = None, False, 0

    def begin(self, video: Video, rows: slice, columns: slice) -> Iterator[FramesRead]:
        """What an interrupted run kept of this reading, part by part; nothing where there is none."""
        self._began = time.monotonic()
        self._facts = partial(_facts, video, rows, columns)
        width = columns.stop - columns.start
        self._record = np.dtype([("status", "u1"), ("time_s", "<f8"), ("intensity", "<f4", width)])
        if not (self._own and (self._place / FACTS).is_file()):
            return
        self._check()
        frames = self._place / FRAMES
        with reading(frames, "frames of an interrupted run", RESTART):
            self._file = frames.open("r+b", buffering=0)
        while (part := np.fromfile(self._file, self._record, PART)).size:
            whole = part[: _first_odd(part["status"])]
            self.kept += whole.size
            yield FramesRead(whole["intensity"], np.array(STATUS)[whole["status"]], whole["time_s"])
            if whole.size < part.size:
                break
        self.resumed = self.kept
        self._file.truncate(self.kept * self._record.itemsize)
        self._file.seek(0, os.SEEK_END)

    def add(self, frames: FrameStore) -> None:
        """Keep what is new, once reading has taken long enough."""
        if self._off or (self._file is None and time.monotonic() - self._began < self._after_s):
            return
        try:
            if self._file is None:
                self._start()
            for start in range(self.kept, frames.count, PART):
                self._write(frames.part(start, min(start + PART, frames.count)))
        except (OSError, InputError):  # the run itself may still succeed
            self.done()
            self._off = True

    def _start(self) -> None:
        """Make the folder; the facts come last, as frames without them are nothing."""
        self.done()
        self._place.mkdir(parents=True)
        self._own, self._lock = True, lock_folder(self._place)
        self._file = (self._place / FRAMES).open("wb", buffering=0)
        write_json(self._facts(), self._place / FACTS)

    def _write(self, part: FramesRead) -> None:
        records = np.empty(part.status.size, self._record)
        records["status"] = [STATUS.index(status) for status in part.status]
        records["time_s"], records["intensity"] = part.times_s, part.intensity
        assert self._file is not None
        data = memoryview(records.tobytes())
        while data:
            data = data[self._file.write(data) :]
        self.kept += records.size

    def _check(self) -> None:
        """Refuse to go on with another film, or with the same one read otherwise."""
        kept = read_json(self._place / FACTS)
        for name, now in plain(self._facts()).items():
            if kept.get(name) != now:
                about = "the same film" if name == "inputs" else f"{name} {kept.get(name)} as before"
                found = "one that was changed or replaced" if name == "inputs" else str(now)
                raise InputError(self._target, f"{about}, to resume", found, RESTART)


def _facts(video: Video, rows: slice, columns: slice) -> dict[str, Any]:
    """What I(x, t) depends on."""
    given = video.given_times_s
    return {
        "sheetvision": vision.__version__,
        "strip": [rows.start, rows.stop],
        "columns": [columns.start, columns.stop],
        "rotate": video.rotate,
        "frames": [video.first, video.stop],
        "fps": video.given_fps,
        "timestamps": None if given is None else hashlib.sha256(given.tobytes()).hexdigest(),
        # size and content of every file of the film; its name and time may change
        "inputs": [
            {k: v for k, v in describe_input(path).items() if k not in ("path", "modified_s")}
            for path in video_files(video.path)
        ],
    }


def _first_odd(status: NDArray[np.uint8]) -> int:
    """How many records come before the first one that was not written."""
    odd = np.flatnonzero((status == 0) | (status >= len(STATUS)))
    return int(odd[0]) if odd.size else status.size
