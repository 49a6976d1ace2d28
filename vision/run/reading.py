"""Read a finished run from its folder, and the frames of an interrupted run from its checkpoint."""

from __future__ import annotations

import hashlib
import json
import math
import os
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import chain
from pathlib import Path, PureWindowsPath
from typing import Any, BinaryIO, Literal, Self, get_type_hints

import numpy as np
import pandas as pd
import xarray as xr

import vision
from vision.clock import Candidate, Clock
from vision.data import STIFF_BELOW, TRACKS, StripMetadata, TrackMetadata, strip_of
from vision.errors import InputError
from vision.files import AGAIN, READ_HDF5, Progress, matching, reading, shortened, try_out
from vision.folder import (
    RUN_JSON,
    check_target,
    existing_parent,
    from_json,
    plain,
    reading_folder,
    whole_file,
    write_json,
)
from vision.locks import Lock, lock_folder
from vision.memory import row_parts
from vision.numeric import number
from vision.pipeline import Analysis, Settings, analyse, open_recording
from vision.run.provenance import Parameter, describe_input
from vision.run.tables import attrs_of_netcdf, read_kymograph_tif, sheets_table
from vision.sheets.corrections import Correction, correction_of
from vision.video import FramesRead, FrameStore, Video, VideoSettings, video_files
from vision.words import words_of_characters

TEXT_COLUMNS = ("flag", "shell")  # of the tables of a run; all others hold numbers
EVENT_COLUMNS = ("event", "t_v_s", "t_p_s", "stick_length_um")  # of events.csv that later stages need


@dataclass(frozen=True)
class RunFolder:
    """A finished run. Its other files are read when they are first used; InputError says which is damaged."""

    folder: Path
    facts: Mapping[str, Any]  # content of run.json

    @property
    def name(self) -> str:
        """Name of the folder."""
        return self.folder.resolve().name

    @cached_property
    def parameters(self) -> dict[str, Parameter]:
        """Parameters by the names of the command's options."""
        known = self.facts.get("parameters", {})
        if not isinstance(known, dict) or not all(isinstance(one, dict) for one in known.values()):
            raise InputError(self.folder / RUN_JSON, "the parameters of a run", "none", AGAIN)
        return {name: Parameter(one.get("value"), one.get("how", "given")) for name, one in known.items()}

    def value(self, option: str) -> Any:
        """Return the value of an option; None if it was not given and has no default."""
        return self.parameters[option].value if option in self.parameters else None

    @property
    def pixel_size_um(self) -> float | None:
        """µm per pixel; None if it was not given."""
        value = self.value("pixel_size")
        if value is None:
            return None
        size = number(value)
        if not 0 < size < math.inf:
            raise InputError(self.folder / RUN_JSON, "a pixel size in µm", "a damaged one", AGAIN)
        return size

    @property
    def threshold(self) -> float:
        """σ_x/Λ_st below which a sheet is stiff."""
        threshold = number(self.value("threshold"))
        return threshold if threshold > 0 else STIFF_BELOW

    @property
    def with_force(self) -> bool:
        """Whether the run has a force recording."""
        return bool(self.value("force") or self.facts.get("force_alone"))

    @property
    def of_video(self) -> bool:
        """Whether the run has tracks, and not only a force recording."""
        return (self.folder / "tracks.nc").exists()

    @cached_property
    def tracks(self) -> xr.Dataset:
        """The tracks as `track_sheets` returned them.  Raises: InputError for a run without a video."""
        if not self.of_video:
            found, advice = "no tracks.nc in it", "give the run of a video"
            raise InputError(self.folder, "a run of a video", found, advice)
        return read_tracks(self.folder / "tracks.nc")

    @cached_property
    def clock(self) -> Clock | None:
        """The clock, which may be ambiguous; None if the run has none."""
        path = self.folder / "clock.json"
        if not path.exists():
            return None
        facts = read_json(path)
        with reading(path, "a clock as track writes it", AGAIN):
            known, kinds = from_json(Clock, facts), get_type_hints(Clock)
            for name, value in known.items():
                if kinds[name] in (float, int):
                    known[name] = kinds[name](math.nan if value is None else value)
            times = {name: tuple(map(float, known.get(name) or ())) for name in ("only_video_s", "matched_s")}
            candidates = tuple(Candidate(**one) for one in known.get("candidates") or ())
            warnings = tuple(map(str, known.get("warnings") or ()))
            return Clock(**known | times | {"candidates": candidates, "warnings": warnings})

    def table(self, name: str, needs: Sequence[str] = ()) -> pd.DataFrame | None:
        """Return a table, such as "events"; None if the run does not have it.

        needs: columns that it must have.
        Raises: InputError if the file is damaged, lacks one of them, or has text in a column of numbers.
        """
        path, wanted = self.folder / f"{name}.csv", "a table as track writes it"
        if not path.exists():
            return None
        with reading(path, wanted, AGAIN):
            table = pd.read_csv(path)
            with path.open("rb") as file:
                file.seek(-1, os.SEEK_END)
                last = file.read()
        if last != b"\n":
            raise InputError(path, wanted, "one whose last line was cut", AGAIN)
        if absent := [column for column in needs if column not in table]:
            raise InputError(path, wanted, f"no {', '.join(absent)}", AGAIN)
        for column in table.columns.difference(list(TEXT_COLUMNS)):
            wrong = table[column].notna() & pd.to_numeric(table[column], errors="coerce").isna()
            if wrong.any():
                found = f"{shortened(str(table[column][wrong].iloc[0]), 40)!r} in the column {column!r}"
                raise InputError(path, wanted, found, AGAIN)
        return table

    @cached_property
    def events(self) -> pd.DataFrame | None:
        """The stick-slip events; None if the run has none."""
        return self.table("events", EVENT_COLUMNS)

    @property
    def tables(self) -> dict[str, pd.DataFrame]:
        """Tables that the run has, but that of all positions, by the names of their files."""
        tables = {"sheets": sheets_table(self.tracks)} if self.of_video else {}
        found = {name: self.table(name) for name in ("events", "deformation", "shells")}
        return tables | {name: table for name, table in found.items() if table is not None}

    @property
    def applied(self) -> list[Correction]:
        """Decisions that are already applied in the tables of the run."""
        stored = (from_json(Correction, one) for one in self.facts.get("corrections") or [])
        return [correction_of(one["kind"], Correction(**one).entry()) for one in stored]

    def found(self, named: Path) -> Path:
        """Return where a file that the run used is.

        A relative path is tried from where the run was made and from here. Then the last parts of the path,
        as many as possible, are tried from the run and each folder above: both may have been moved together,
        also from Windows to another system.
        """
        made_in = Path(str(self.facts.get("directory") or "."))
        stated = PureWindowsPath(named) if "\\" in str(named) else named
        parts = stated.parts[bool(stated.anchor) :]
        ends = (Path(*parts[first:]) for first in range(len(parts)))
        folder = self.folder.absolute()
        moved = (above / end for end in ends for above in (folder, *folder.parents))
        return next(filter(matching, chain((made_in / named, named), moved)), named)

    def force(self, moved: str | Path | None = None) -> Path | None:
        """Return the path of the force recording, as `input` does; None for a run without one."""
        return self.input("force", moved) if self.with_force else None

    def input(self, which: Literal["film", "force"], moved: str | Path | None = None) -> Path:
        """Return the path of the film or the force recording after checking that it is the same file.

        moved: its new path, if it was moved.

        Raises: InputError if the run has none, there is no such file, or its size or fingerprint differs.
        """
        inputs = self.facts.get("inputs") or []  # the film is the first, the force recording the last
        if not inputs or not (self.of_video if which == "film" else self.with_force):
            wanted = "a run of a video" if which == "film" else "a run with a force recording"
            raise InputError(self.folder, wanted, "none in its run.json", "give another run")
        known: Mapping[str, Any] = inputs[0 if which == "film" or not self.of_video else -1]
        path = self.found(Path(str(known["path"]))) if moved is None else Path(moved)
        if not matching(path):
            advice = "put it back there, or measure the run again with" if which == "force" else "give"
            advice += f" its new path (`{which}`)"
            raise InputError(path, f"an input of {self.folder}", "no such file", advice)
        kind = "sha256" if "sha256" in known else "fingerprint"
        now = describe_input(path, whole=kind == "sha256")
        same_size = now["size_bytes"] == known["size_bytes"]
        if not same_size or now.get(kind) != known.get(kind):
            wanted = f"an input of {self.folder}, {known['size_bytes']} bytes"
            found = "another of the same size" if same_size else f"one of {now['size_bytes']} bytes"
            raise InputError(path, wanted, found, "track it again")
        return path


def is_run(folder: Path) -> bool:
    """Tell a run folder from a folder of images."""
    return (folder / RUN_JSON).is_file()


def check_results(target: Path, *, overwrite: bool, mark: str) -> None:
    """Check that results can be written to a folder, before anything is computed.

    It must be new, or hold earlier results of the same command to be replaced, whose run.json has the key
    `mark`.  Raises: InputError, also as `vision.folder.check_target`.
    """
    if is_run(target) and mark not in read_json(target / RUN_JSON):
        wanted = "a new folder, or an earlier result of the same command to overwrite"
        raise InputError(target, wanted, "another run", "give another `out`")
    check_target(target, overwrite=overwrite)


def check_outside(target: Path, run: Path) -> None:
    """Check that results are not written into a run, which is replaced as a whole.  Raises: InputError."""
    if target.resolve().is_relative_to(run.resolve()):
        raise InputError(target, "a place outside the run folder", "one inside", "give another `out`")


def read_run(folder: Path) -> RunFolder:
    """Open a run folder and read its run.json.  Raises: InputError if it is none, or is damaged."""
    if not is_run(folder):
        found = "no run.json in it" if folder.is_dir() else "a file" if folder.is_file() else "no such folder"
        raise InputError(folder, "a run folder of track", found, "give the folder that track wrote")
    return RunFolder(folder, read_json(folder / RUN_JSON))


def read_json(path: Path, advice: str = AGAIN) -> dict[str, Any]:
    """Read a JSON object.  Raises: InputError with this advice."""
    with reading(path, "JSON as track writes it", advice):
        content = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(content, dict):
        raise InputError(path, "a JSON object", f"a {type(content).__name__}", advice)
    return content


def first_column(run: RunFolder) -> int:
    """Return the film's column that is the first of the strip and of kymograph.tif."""
    recording = run.facts.get("recording")
    padding = recording.get("padding") if isinstance(recording, dict) else None
    left_out = [part for part in map(str, padding or ()) if part.startswith("0:")]
    start = left_out[0][2:] if left_out else str(run.value("columns") or "").partition(":")[0].strip()
    return int(start) if start.isdigit() else 0


def film_if_there(
    run: RunFolder, settings: Settings, moved: str | Path | None = None, *, asked: bool = False
) -> Video | None:
    """Open the film of a run, or return None if it is gone, as only another strip needs it.

    moved: its new path, if it was moved.  asked: whether the user has just given this path.
    Raises: InputError if that path does not hold the film.
    """
    try:
        return open_recording(run.input("film", moved), settings)
    except InputError:
        if asked and moved is not None:
            raise
        return None


def analyse_again(
    run: RunFolder,
    settings: Settings,
    video: Video | None,
    force: Path | None,
    *,
    earlier: Analysis | None = None,
    progress: Progress | None = None,
) -> Analysis:
    """Analyse a finished run again, with its strip, tracks and clock as far as the settings leave them.

    settings: with the corrections to apply.  video, force: those of the run, None for none; without the film,
    there is no image of a frame, and no other strip.  earlier: the run as stored, by default with these
    settings and its own corrections.  progress: see `analyse`.  Raises: InputError as `analyse`.
    """
    if settings.pitch_um is not None:  # the pixel size follows from the tracks
        settings = replace(settings, pixel_size_um=None, pixel_size_err_um=None)
    if not run.of_video:
        return analyse(None, force, settings)
    earlier = earlier or stored_analysis(run, settings)
    return analyse(video, force, settings, earlier=earlier, progress=progress)


def stored_analysis(run: RunFolder, settings: Settings) -> Analysis:
    """Return strip, tracks and clock of a run, for `analyse` with other settings or corrections.

    settings: those of the run; its corrections are added.
    """
    settings = replace(settings, corrections=tuple(run.applied))
    return Analysis(settings=settings, strip=read_strip(run), tracks=run.tracks, clock=run.clock)


def read_strip(run: RunFolder) -> xr.DataArray:
    """Read I(x, t) from kymograph.tif, with the coordinates and attributes that `strip_profile` set.

    The values are a copy, of a long film in a temporary file. The file itself is not memory-mapped: if it
    became shorter, access would kill the process. A frame's status is "ok" if its row has values, else the
    flag of its sheets.

    Raises: InputError if the file is missing or damaged, or does not fit the tracks.
    """
    tracks = run.tracks
    values = read_kymograph_tif(run.folder / "kymograph.tif", tracks.sizes["frame"])
    flags = tracks["flag"].values[:, 0]
    return strip_of(
        values,
        frame=tracks["frame"].values,
        first_x=first_column(run),
        time_s=tracks["time_s"].values,
        status=np.where(np.isfinite(values[:, 0]), "ok", flags),
        attrs=tracks.attrs,
    )


def read_tracks(path: Path, *, without: Sequence[str] = (), single: Sequence[str] = ()) -> xr.Dataset:
    """Read tracks.nc as `track_sheets` returned it, without some variables, and others in single precision.

    It is first read in a separate process, as HDF5 can crash or hang on a damaged file.

    Raises: InputError if it is missing or damaged.
    """
    wanted = "tracks as track writes them"
    try_out(path, READ_HDF5, wanted)
    with reading(path, wanted, AGAIN):
        with xr.open_dataset(path, engine="h5netcdf", concat_characters=False, cache=False) as data:
            words = {name: _words(data[name]) for name in ("flag", "why") if name in data}
            # x_um would stay what it was when the pixel size is changed
            others = [*words, "x_um", "index", *without]
            kept = data.drop_vars(others, errors="ignore")
            found = {name: _in_single(kept[name]) for name in single if name in kept}
            tracks = kept.assign(found).load().assign(words)
        tracks.attrs = attrs_of_netcdf(tracks.attrs)
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


def _in_single(values: xr.DataArray) -> xr.Variable:
    """Return a variable in single precision, which is read a part at a time."""
    found = np.empty(values.shape, np.float32)
    for rows in row_parts(len(values), 1 << 14):
        found[rows] = values[rows].values
    return xr.Variable(values.dims, found, values.attrs)


def _words(characters: xr.DataArray) -> xr.Variable:
    """Return the words that a file holds as characters."""
    attrs = {name: value for name, value in characters.attrs.items() if name != "_Encoding"}
    return xr.Variable(characters.dims[:-1], words_of_characters(characters), attrs)


# --- checkpoint of an interrupted run -----------------------------------------------------------------------

FRAMES, FACTS = "frames", "reading.json"
STATUS = ("", "ok", "corrupt", "lost")  # status by its number in the file; 0: not written before a crash
PART = 4096  # frames read or written at a time
RESTART = "run without `resume` to start at the first frame"


class Checkpoint:
    """Stores I(x, t) while a film is read, so that an interrupted run can be resumed.

    A hidden folder beside the run folder holds two files. One grows by a record per frame (status, time, the
    strip's mean). The other says which film is read and how. The folder is made when reading has taken
    `after_s`, and removed when the run folder is written. A record that was only partly written
    before a kill is ignored.

    With `resume` a run continues where an interrupted one of the same film with the same settings ended; if
    nothing was stored, at the first frame. Without `resume`, what an earlier run left is removed. As frames
    are numbered without gaps (`vision.video.reader.Reader`), and each row is computed from its frame alone,
    the result is the same bit for bit. If the disk is full, the run continues without a checkpoint.

    Raises: InputError with `resume`: on entering, if another process reads into the same folder; from
    `begin`, if the film or the settings differ.
    """

    def __init__(
        self, target: Path, *, resume: bool = False, after_s: float = VideoSettings.resume_after_s
    ) -> None:
        # Temporary files for I(x, t) go to the disk of the results, which has enough room.
        self.folder = existing_parent(target)
        self.resumed = 0  # frames taken from the interrupted run
        self.kept = 0  # frames in the file so far
        self._target, self._place = target, reading_folder(target)
        self._resume, self._after_s = resume, after_s
        self._began = time.monotonic()
        self._own = False  # whether this run holds the folder's lock
        self._off = False  # whether nothing is stored: another run has the folder, or writing failed
        self._lock: Lock | None = None
        self._file: BinaryIO | None = None
        self._facts: Callable[[], dict[str, Any]] = dict

    def __enter__(self) -> Self:
        if self._place.is_dir():
            self._lock = lock_folder(self._place)
            self._own = self._lock is not None
            self._off = not self._own
            if self._off and self._resume:
                found, advice = "one that is still running", "wait for it, or give another `out`"
                raise InputError(self._target, "an interrupted run to resume", found, advice)
            if not self._resume:
                self.remove()
        return self

    def __exit__(self, *error: object) -> None:
        if self._file is not None:
            self._file.close()
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def remove(self) -> None:
        """Remove what was stored, which nobody will resume."""
        if self._file is not None:
            self._file.close()  # Windows does not remove open files
        if self._own:
            shutil.rmtree(self._place, ignore_errors=True)
        self.__exit__()
        self._file, self._own, self.kept = None, False, 0

    def begin(self, video: Video, rows: slice, columns: slice) -> Iterator[FramesRead]:
        """Start, and yield the frames that an interrupted run stored, part by part."""
        self._began = time.monotonic()
        self._facts = partial(_film_and_settings, video, rows, columns)
        width = columns.stop - columns.start
        self._record = np.dtype([("status", "u1"), ("time_s", "<f8"), ("intensity", "<f4", width)])
        if not (self._own and (self._place / FACTS).is_file()):
            return
        self._check()
        frames = self._place / FRAMES
        with reading(frames, "frames of an interrupted run", RESTART):
            self._file = frames.open("r+b", buffering=0)
        while (part := np.fromfile(self._file, self._record, PART)).size:
            unwritten = (part["status"] == 0) | (part["status"] >= len(STATUS))
            written = part[: int(unwritten.argmax()) if unwritten.any() else None]
            self.kept += written.size
            yield FramesRead(written["intensity"], np.array(STATUS)[written["status"]], written["time_s"])
            if written.size < part.size:
                break
        self.resumed = self.kept
        self._file.truncate(self.kept * self._record.itemsize)
        self._file.seek(0, os.SEEK_END)

    def add(self, frames: FrameStore) -> None:
        """Store new frames, once reading has taken `after_s`."""
        if self._off or (self._file is None and time.monotonic() - self._began < self._after_s):
            return
        try:
            if self._file is None:
                self._start()
            for start in range(self.kept, frames.count, PART):
                self._write(frames.copy(start, min(start + PART, frames.count)))
        except (OSError, InputError):  # the run continues without a checkpoint
            self.remove()
            self._off = True

    def _start(self) -> None:
        """Make the folder; the facts are written last, as `begin` ignores frames without them."""
        self.remove()
        self._place.mkdir(parents=True)
        self._own, self._lock = True, lock_folder(self._place)
        self._file = (self._place / FRAMES).open("wb", buffering=0)
        with whole_file(self._place / FACTS) as path:  # a kill may come while it is written
            write_json(self._facts(), path)

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
        """Check that film and settings are those of the interrupted run.  Raises: InputError."""
        kept = read_json(self._place / FACTS, RESTART)
        for name, now in plain(self._facts()).items():
            if kept.get(name) != now:
                about = "the same film" if name == "inputs" else f"{name} {kept.get(name)} as before"
                found = "one that was changed or replaced" if name == "inputs" else str(now)
                raise InputError(self._target, f"{about}, to resume", found, RESTART)


def _film_and_settings(video: Video, rows: slice, columns: slice) -> dict[str, Any]:
    """Return everything that I(x, t) depends on."""
    given = video.given_times_s
    return {
        "sheetvision": vision.__version__,
        "strip": [rows.start, rows.stop],
        "columns": [columns.start, columns.stop],
        "rotate": video.rotate,
        "frames": [video.first, video.stop],
        "fps": video.given_fps,
        "timestamps": None if given is None else hashlib.sha256(given.tobytes()).hexdigest(),
        # Size and content of the film's files; their names and times may change.
        "inputs": [
            {k: v for k, v in describe_input(path).items() if k not in ("path", "modified_s")}
            for path in video_files(video.path)
        ],
    }
