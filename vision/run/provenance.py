"""Provenance of a run, for run.json: its command, parameters, versions and fingerprints of its inputs."""

from __future__ import annotations

import hashlib
import importlib.metadata
import math
import platform
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, Future
from dataclasses import asdict, dataclass, field, is_dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, Self

import vision
from vision.errors import InputError, reason_of, with_options
from vision.files import Progress, begun, members

PACKAGES = ("av", "h5netcdf", "numpy", "opencv-python-headless", "pandas", "scipy", "tifffile", "xarray")
MIB = 1 << 20
_MESSAGES = frozenset({"notes", "warnings", "reason", "not_measured"})
"""Entries of JSON files that hold messages."""
PARTS = 64
"""Number of MiB in a fingerprint: the first, the last, and others evenly between. More would read more of a
film of 100 GB than the strip needs; fewer could miss that a film was cut or partly replaced."""
AHEAD_BYTES = 256 * MIB
"""How far checksums may be ahead of the film. Less makes them wait; if it exceeds the memory, the disk must
read everything twice."""


@dataclass(frozen=True)
class Parameter:
    """A parameter's value and where it came from."""

    value: Any
    how: Literal["given", "config", "default", "found"]


@dataclass(frozen=True, kw_only=True)
class Origin:
    """Provenance of a run, for run.json."""

    command: str  # the command line
    inputs: Sequence[Path] = ()  # files and folders that were read
    parameters: dict[str, Parameter] = field(default_factory=dict)  # every option
    checksum: bool = False  # whether all bytes of the inputs are hashed
    # option that replaces each argument of the library in messages; empty without a command
    options: Mapping[str, str] = field(default_factory=dict)
    # descriptions of inputs that are known already (`Checksums`)
    described: Mapping[Path, Mapping[str, Any]] = field(default_factory=dict)

    def named(self, lines: Iterable[str]) -> list[str]:
        """Return messages with the command's options in place of Python's arguments."""
        return [with_options(line, self.options) if self.options else line for line in lines]

    def worded(self, content: Any, *, message: bool = False) -> Any:
        """Return the content of a JSON file, with the command's options in its notes and warnings."""
        if is_dataclass(content) and not isinstance(content, type):
            content = asdict(content)
        if isinstance(content, Mapping):
            return {
                name: self.worded(part, message=message or name in _MESSAGES)
                for name, part in content.items()
            }
        if isinstance(content, list | tuple):
            return [self.worded(part, message=message) for part in content]
        return self.named([content])[0] if message and isinstance(content, str) else content

    def describe(self) -> Callable[[], list[Mapping[str, Any]]]:
        """Start to read the inputs in threads; return a function that waits for their descriptions."""
        parts = [
            partial(self.described.__getitem__, path)
            if path in self.described
            else begun(partial(describe_input, path, whole=self.checksum), path)
            for path in self.inputs
        ]
        return lambda: [part() for part in parts]

    def facts(
        self, inputs: Callable[[], list[Mapping[str, Any]]] | None = None, **messages: Iterable[str]
    ) -> dict[str, Any]:
        """Return command, directory, versions, parameters, inputs (of `describe`) and messages for run.json.

        messages: lists of lines, such as ``warnings=…``, in which options replace Python's arguments.
        """
        known = {
            "command": self.command,
            "directory": str(Path.cwd()),  # from which relative paths count
            "versions": versions(),
            "parameters": {name: asdict(one) for name, one in self.parameters.items()},
            "inputs": (inputs or self.describe())(),
        }
        return known | {name: self.named(lines) for name, lines in messages.items()}


def versions() -> dict[str, str]:
    """Return the versions of sheetvision, Python and the libraries that affect the numbers."""
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
    """Return path, size and fingerprint of an input: a file, or the files of a folder or pattern joined.

    The fingerprint is the SHA-256 of the sizes of all files and of 64 evenly spaced MiB of their content. It
    is the SHA-256 of the whole content if that is shorter, or with ``whole``. ``pace`` is called after every
    part with the number of bytes read and the total.

    Raises: InputError for an input that does not exist or cannot be read.
    """
    digest = hashlib.sha256()
    try:
        files = [(file, file.stat()) for file in sorted(members(path)) if file.is_file() or not path.is_dir()]
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
        wanted = "an input that stays there until the end"
        raise InputError(path, wanted, reason_of(error)) from error
    modified = max((facts.st_mtime for _, facts in files), default=0.0)
    kind = "sha256" if whole else "fingerprint"
    return {"path": str(path), "size_bytes": size, "modified_s": modified, kind: digest.hexdigest()}


def checksum_of(described: Mapping[str, Any]) -> str:
    """Return the SHA-256 or the fingerprint of an input that `describe_input` described; "" for neither."""
    return str(described.get("sha256") or described.get("fingerprint") or "")


class Checksums:
    """Hash all bytes of the inputs while the film is read, so that the disk reads each byte only once.

    A thread reads the inputs in turn, the film first, at most `AHEAD_BYTES` ahead of the reading of frames.
    Whichever of the two reads a part second then finds it in the system's cache.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        self._paths = paths
        self._share = 0.0  # of the film's frames that were read; infinite to end the thread
        self._found: Future[dict[Path, dict[str, Any]]] = Future()
        self._progressed = threading.Condition()

    def __enter__(self) -> Self:
        threading.Thread(target=self._work, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._proceed(math.inf)  # the thread ends after the current part

    def following(self, progress: Progress | None) -> Progress:
        """Return a progress function that also tells this object how far the film is read."""

        def both(done: int, total: int | None) -> None:
            self._proceed(done / total if total else 1.0)
            if progress is not None:
                progress(done, total)

        return both

    def found(self) -> dict[Path, dict[str, Any]]:
        """Return the description of every input; see `describe_input`.  Raises: InputError."""
        self._proceed(1.0)
        return self._found.result()

    def _proceed(self, share: float) -> None:
        with self._progressed:
            self._share = max(share, self._share)
            self._progressed.notify_all()

    def _work(self) -> None:
        try:
            described = {path: describe_input(path, whole=True, pace=self._wait) for path in self._paths}
            self._found.set_result(described)
        except BaseException as error:
            self._found.set_exception(error)

    def _wait(self, done: int, size: int) -> None:
        with self._progressed:
            self._progressed.wait_for(lambda: self._share >= 1 or done - self._share * size <= AHEAD_BYTES)
            if self._share == math.inf:
                raise CancelledError


def _parts(files: Sequence[tuple[Path, int]], *, whole: bool) -> Iterator[bytes]:
    """Yield the parts to hash of files that are joined; a part of 1 MiB may begin in one and end in the next.
    files: path and length in bytes."""
    size = sum(length for _, length in files)
    starts = [round(part * (size - MIB) / (PARTS - 1)) for part in range(PARTS)]
    wanted = [(0, size)] if whole else [(start, start + MIB) for start in starts]
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
