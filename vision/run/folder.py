"""The run folder: written whole or not at all, with a run.json that says where its numbers come from."""

from __future__ import annotations

import ctypes
import errno
import glob
import hashlib
import importlib.metadata
import json
import math
import os
import platform
import secrets
import shutil
import sys
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, is_dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, Self

import vision
from vision.errors import InputError, with_options
from vision.video.threads import begun

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

MARK = "run.json"  # what makes a folder a run folder
PART, OLD = ".part", ".old"  # endings of a run that is being written, and of one that was moved aside
READING = ".reading"  # ending of what is kept while a long film is read


def check_target(target: Path, *, overwrite: bool) -> None:
    """Refuse early a folder that exists or is no run, or a place that cannot be written.

    Raises: InputError.
    """
    try:
        if target.exists():
            _check_earlier(target, overwrite=overwrite)
        parent = existing_parent(target)
    except OSError as error:
        raise _unwritable(target, error) from error
    if not os.access(parent, os.W_OK | os.X_OK):
        raise InputError(target, "a place that can be written", f"{parent} is not", "give another `out`")


def check_new(target: Path, *, overwrite: bool, kind: str = "file") -> None:
    """Refuse to write over something, unless that is asked for.  Raises: InputError."""
    if target.exists() and not overwrite:
        raise InputError(target, f"a new {kind}", "one that exists", "give `overwrite` or another `out`")


def _check_earlier(target: Path, *, overwrite: bool) -> None:
    """Only a run folder of one's own may be replaced, and only if asked for."""
    check_new(target, overwrite=overwrite, kind="folder")
    wanted = "a run folder to overwrite"
    if not (target.is_dir() and (not any(target.iterdir()) or (target / MARK).is_file())):
        raise InputError(target, wanted, "something else (no run.json in it)", "give another `out`")
    if target.samefile(Path.cwd()):
        raise InputError(target, wanted, "the working directory", "go one folder up")
    if not os.access(target, os.W_OK | os.X_OK):
        raise InputError(target, wanted, "one that is read-only", "give another `out`")


@contextmanager
def run_folder(target: Path, *, overwrite: bool = False) -> Iterator[Path]:
    """A temporary folder beside `target` that takes its place when everything in it is written.

    If anything goes wrong, an interrupt included, the temporary folder is removed and an earlier run stays
    as it was. What a killed process left behind is removed, or put back where the kill came between moving
    an earlier run aside and putting the new one in its place.

    Raises: InputError where the target exists or cannot be written, or the disk is full.
    """
    clean_up(target)
    check_target(target, overwrite=overwrite)
    # named first: an interrupt finds it
    made = target.parent / f".{target.name}.{secrets.token_hex(4)}{PART}"
    lock, missing = None, _missing_parents(target)
    try:
        made.mkdir(parents=True)
        lock = lock_folder(made)
        yield made
        put_in_place(made, target, overwrite=overwrite)
    except OSError as error:
        raise _unwritable(target, error) from error
    finally:
        shutil.rmtree(made, ignore_errors=True)
        if lock is not None:
            os.close(lock)
        _remove_empty(missing)


def reading_folder(target: Path) -> Path:
    """Where frames are kept while a long film is read for the run folder `target`."""
    return target.parent / f".{target.name}{READING}"


def clean_up(target: Path) -> None:
    """Remove or restore what processes that were killed left beside `target`."""
    hidden = f".{glob.escape(target.name)}.*"
    earlier = list(target.parent.glob(hidden + OLD))
    for left in (reading_folder(target), *earlier, *target.parent.glob(hidden + PART)):
        if (lock := lock_folder(left)) is None:
            continue
        if left in earlier and not target.exists():
            with suppress(OSError):
                left.rename(target)
        else:
            shutil.rmtree(left, ignore_errors=True)
        os.close(lock)


def lock_folder(folder: Path) -> int | None:
    """Claim a folder; None where a living process has it, where it is not there, or, off POSIX, always.

    The claim ends with the process, however that ends.
    """
    if fcntl is None:
        return None
    try:
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except OSError:
        return None
    try:
        lock_open_file(handle)
    except OSError:
        os.close(handle)
        return None
    return handle


def lock_open_file(handle: int) -> None:
    """Claim an open file for this process, until it is closed; off POSIX nothing is claimed.

    Raises: BlockingIOError where another process has it, OSError where the file system has no locks.
    """
    if fcntl is not None:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)


def put_in_place(made: Path, target: Path, *, overwrite: bool) -> None:
    """Put `made` in the place of `target`; an earlier run takes the temporary place, and is removed there.

    Where the file system can exchange two names in one step, the target is at every moment the old run or
    the new one; elsewhere a kill between two renames leaves the old run aside, and `clean_up` puts it back.

    Raises: InputError where another run has taken the place meanwhile.
    """
    if not target.exists():
        made.rename(target)
        return
    _check_earlier(target, overwrite=overwrite)
    if _exchange(made, target):
        return
    old = target.parent / f".{target.name}.{secrets.token_hex(4)}{OLD}"
    target.rename(old)
    try:
        made.rename(target)
    except OSError:
        old.rename(target)
        raise
    shutil.rmtree(old, ignore_errors=True)


def _exchange(one: Path, other: Path) -> bool:
    """Swap two names in one step; False where the system or the file system cannot."""
    if not sys.platform.startswith("linux"):
        return False
    call = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if call is None:
        return False
    here, exchange = -100, 2  # AT_FDCWD: relative names are those of the working directory; RENAME_EXCHANGE
    return int(call(here, os.fsencode(one), here, os.fsencode(other), exchange)) == 0


@contextmanager
def whole_file(target: Path, *, durable: bool = False) -> Iterator[Path]:
    """A path beside the target; what is written there takes the target's place when it is whole.

    durable: it is on the disk when this returns, whatever ends the machine; that takes some milliseconds.

    Raises: InputError where it cannot be written; an earlier file is as it was then.
    """
    made, missing = None, _missing_parents(target)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        made = Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=target.parent))
        yield made / target.name
        if durable:
            _to_disk(made / target.name)
        (made / target.name).replace(target)
        if durable:
            _to_disk(target.parent)
    except OSError as error:
        found = str(error.strerror or error).lower()
        raise InputError(target, "a place that can be written", found, "nothing was written") from error
    finally:
        if made is not None:
            shutil.rmtree(made, ignore_errors=True)
        _remove_empty(missing)


def _to_disk(path: Path) -> None:
    """Wait until a file, or what a folder's names stand for, is on the disk."""
    if path.is_dir() and fcntl is None:  # Windows opens no folders
        return
    handle = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _missing_parents(path: Path) -> list[Path]:
    """Folders above a path that must be made, the nearest first."""
    return [parent for parent in path.absolute().parents if not parent.exists()]


def _remove_empty(folders: list[Path]) -> None:
    """Folders that were made for something that failed."""
    for folder in folders:
        with suppress(OSError):  # not empty: it did not fail
            folder.rmdir()


def existing_parent(path: Path) -> Path:
    """The nearest folder above a path that is there."""
    return next(parent for parent in path.absolute().parents if parent.exists())


def _unwritable(target: Path, error: OSError) -> InputError:
    short = error.errno is None and "requested and" in str(error)  # NumPy's words for a write cut short
    full = short or error.errno in (errno.ENOSPC, errno.EDQUOT)
    found = "a full disk" if full else str(error.strerror or error).lower()
    return InputError(target, "a place that can be written", found, "nothing was written; give another `out`")


# --- run.json: inputs, versions, parameters -----------------------------------------------------------------


PACKAGES = ("av", "h5netcdf", "numpy", "opencv-python-headless", "pandas", "scipy", "tifffile", "xarray")
MIB = 1 << 20
PARTS = 64
"""MiB of a file that its fingerprint covers: the first, the last, and others evenly between. More would read
more of a film of 100 GB than the strip needs; fewer could miss a film that was cut or replaced in part."""
AHEAD_BYTES = 256 * MIB
"""How far checksums run ahead of the film. Smaller makes them wait; more than memory holds reads twice."""


@dataclass(frozen=True)
class Parameter:
    """A parameter's value and where it came from."""

    value: Any
    how: Literal["given", "config", "default", "found"]


@dataclass(frozen=True, kw_only=True)
class Origin:
    """Where a run comes from, for run.json."""

    command: str  # the command line
    inputs: Sequence[Path] = ()  # files and folders that were read
    # every option with its value and whether it was given
    parameters: Mapping[str, Parameter] = field(default_factory=dict)
    checksum: bool = False  # whether the inputs' SHA-256 is that of every byte
    # names of arguments and the command's options that the report shows in their place
    options: Mapping[str, str] = field(default_factory=dict)
    # inputs that are described already (`vision.run.Checksums`)
    described: Mapping[Path, Mapping[str, Any]] = field(default_factory=dict)

    def named(self, lines: Iterable[str]) -> list[str]:
        """Messages with the command's options in place of Python's arguments, where a command writes."""
        return [with_options(line, self.options) if self.options else line for line in lines]

    def describe(self) -> Callable[[], list[Mapping[str, Any]]]:
        """Begin to read the inputs, 50 ms of a core; what is returned waits for their descriptions."""
        parts = [
            partial(self.described.__getitem__, path)
            if path in self.described
            else begun(partial(describe_input, path, whole=self.checksum), path)
            for path in self.inputs
        ]
        return lambda: [part() for part in parts]

    def facts(self, inputs: Callable[[], list[Mapping[str, Any]]] | None = None) -> dict[str, Any]:
        """What every run.json begins with: command, versions, parameters, inputs (from `describe`)."""
        return {
            "command": self.command,
            "versions": versions(),
            "parameters": dict(self.parameters),
            "inputs": (inputs or self.describe())(),
        }


def versions() -> dict[str, str]:
    """Versions of sheetvision, Python and the libraries that touch the numbers."""
    known = {"sheetvision": vision.__version__, "python": platform.python_version()}
    for name in PACKAGES:
        try:
            known[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            known[name] = "unknown"
    return known


def describe_input(
    path: Path, *, whole: bool = False, pace: Callable[[int, int], None] | None = None
) -> dict[str, Any]:
    """Path, size and fingerprint of an input; of a folder or a pattern, those of its files in order, as one.

    The fingerprint is the SHA-256 of each file's size and of 64 evenly spaced MiB of all of them, the first
    and the last among them; of the whole content where that is shorter, or where ``whole`` asks for it.
    ``pace`` is called after every part with the bytes read and their number.

    Raises: InputError for an input that is gone or cannot be read.
    """
    digest = hashlib.sha256()
    try:
        files = [(file, file.stat()) for file in _files(path)]
        size = sum(facts.st_size for _, facts in files)
        whole = whole or size <= PARTS * MIB
        if not whole:
            digest.update("".join(str(facts.st_size) for _, facts in files).encode())
        done = 0
        for part in _parts([(file, facts.st_size) for file, facts in files], whole=whole):
            digest.update(part)
            done += len(part)
            if pace is not None:
                pace(done, size)
    except OSError as error:
        why = (error.strerror or str(error)).lower()
        raise InputError(path, "an input that stays there until the end", why) from error
    modified = max((facts.st_mtime for _, facts in files), default=0.0)
    kind = "sha256" if whole else "fingerprint"
    return {"path": str(path), "size_bytes": size, "modified_s": modified, kind: digest.hexdigest()}


class Checksums:
    """Describes inputs by all of their bytes while the film is read, so that the disk gives each byte once.

    A thread reads them in turn, the film first, not further ahead of it than `AHEAD_BYTES`, so that the
    system's memory still holds what one of the two has read when the other comes to it.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        self._paths = paths
        self._share = 0.0
        self._found: dict[Path, dict[str, Any]] = {}
        self._error: InputError | None = None
        self._moved = threading.Condition()
        self._thread = threading.Thread(target=self._work, daemon=True)

    def __enter__(self) -> Self:
        if self._paths:
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._move(math.inf)  # the thread ends with the part it is at

    def beside(self, progress: Callable[[int, int | None], None] | None) -> Callable[[int, int | None], None]:
        """The same progress function, which this object follows too."""

        def both(done: int, total: int | None) -> None:
            self._move(done / total if total else 1.0)
            if progress is not None:
                progress(done, total)

        return both

    def found(self) -> dict[Path, dict[str, Any]]:
        """Every input as `describe_input` describes it.  Raises: InputError as that does."""
        if self._paths:
            self._move(1.0)
            self._thread.join()
        if self._error is not None:
            raise self._error
        return self._found

    def _move(self, share: float) -> None:
        with self._moved:
            self._share = max(share, self._share)
            self._moved.notify_all()

    def _work(self) -> None:
        try:
            for path in self._paths:
                self._found[path] = describe_input(path, whole=True, pace=self._wait)
        except InputError as error:
            self._error = error
        except _LeftError:
            pass

    def _wait(self, done: int, size: int) -> None:
        with self._moved:
            self._moved.wait_for(lambda: self._share >= 1 or done - self._share * size <= AHEAD_BYTES)
            if self._share == math.inf:
                raise _LeftError


class _LeftError(Exception):
    """Nobody waits for the checksums any more."""


def _parts(files: Sequence[tuple[Path, int]], *, whole: bool) -> Iterator[bytes]:
    """The MiB that are read of files taken as one; a part that begins in one may end in the next."""
    size = sum(length for _, length in files)
    spread = [round(part * (size - MIB) / (PARTS - 1)) for part in range(PARTS)]
    wanted = [(0, size)] if whole else [(start, start + MIB) for start in spread]
    begin = 0
    for file, length in files:
        spans = [(max(low, begin) - begin, min(high, begin + length) - begin) for low, high in wanted]
        spans = [(low, high) for low, high in spans if low < high]
        begin += length
        if not spans:
            continue
        with file.open("rb") as stream:
            for low, high in spans:
                stream.seek(low)
                for at in range(low, high, MIB):
                    yield stream.read(min(MIB, high - at))


def _files(path: Path) -> list[Path]:
    if path.is_dir():
        return sorted(file for file in path.iterdir() if file.is_file())
    if path.exists():
        return [path]
    return sorted(Path(name) for name in glob.glob(str(path)))  # noqa: PTH207  # may be absolute


def write_json(content: Mapping[str, Any], path: Path) -> None:
    """Strict JSON, to be read by people too; null for what is not a number."""
    text = json.dumps(plain(content), indent=2, ensure_ascii=False, allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8", errors="replace")


def plain(value: Any) -> Any:
    """What JSON can hold: NaN and infinity become None, dataclasses objects, arrays lists, the rest text."""
    if type(value) is float:  # most values are, in long lists
        return value if math.isfinite(value) else None
    if is_dataclass(value) and not isinstance(value, type):
        return plain(asdict(value))
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    return value if isinstance(value, (bool, int, float, str, type(None))) else str(value)
