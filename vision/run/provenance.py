"""Where the numbers come from: inputs, versions, parameters; and how they are written as JSON."""

from __future__ import annotations

import glob
import hashlib
import importlib.metadata
import json
import math
import platform
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, is_dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, Self

import vision
from vision.errors import InputError, with_options
from vision.video.threads import answered

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

    def facts(self) -> dict[str, Any]:
        """What every run.json begins with: command, versions, parameters, inputs."""
        return {
            "command": self.command,
            "versions": versions(),
            "parameters": dict(self.parameters),
            "inputs": [
                self.described.get(path) or answered(partial(describe_input, path, whole=self.checksum), path)
                for path in self.inputs
            ],
        }


def versions() -> dict[str, str]:
    """Versions of sheetvision, Python and the libraries that touch the numbers."""

    known = {name: _version(name) for name in PACKAGES}
    return {"sheetvision": vision.__version__, "python": platform.python_version(), **known}


def _version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "unknown"


def describe_input(
    path: Path, *, whole: bool = False, pace: Callable[[int, int], None] | None = None
) -> dict[str, Any]:
    """Path, size and fingerprint of an input; of a folder or a pattern, those of its files in order, as one.

    The fingerprint is the SHA-256 of each file's size and of 64 evenly spaced MiB of all of them, the first
    and the last among them; of the whole content where that is shorter, or where ``whole`` asks for it.
    ``pace`` is called after every part with the bytes read and their number.

    Raises
    ------
    InputError
        For an input that is gone or cannot be read.
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

    A thread reads them in turn, not further ahead of the film than `AHEAD_BYTES`, so that the system's memory
    still holds what one of the two has read when the other comes to it.

    Parameters
    ----------
    paths
        Inputs, the film first; none for nothing to do.
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
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if isinstance(value, (bool, int, float, str, type(None))) else str(value)
