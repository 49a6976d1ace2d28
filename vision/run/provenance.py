"""Where the numbers come from: inputs, versions, parameters; and how they are written as JSON."""

from __future__ import annotations

import glob
import hashlib
import importlib.metadata
import json
import math
import platform
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, is_dataclass
from pathlib import Path
from typing import Any, Literal

import vision
from vision.errors import InputError, with_options

PACKAGES = ("av", "h5netcdf", "numpy", "opencv-python-headless", "pandas", "scipy", "tifffile", "xarray")
MIB = 1 << 20
PARTS = 64
"""MiB of a file that its fingerprint covers: the first, the last, and others evenly between. More would read
more of a film of 100 GB than the strip needs; fewer could miss a film that was cut or replaced in part."""


@dataclass(frozen=True)
class Parameter:
    """A parameter's value and where it came from."""

    value: Any
    how: Literal["given", "config", "default", "found"]


@dataclass(frozen=True, kw_only=True)
class Origin:
    """Where a run comes from, for run.json.

    Parameters
    ----------
    command
        The command line.
    inputs
        Files and folders that were read.
    parameters
        Every option with its value and whether it was given.
    checksum
        Whether the inputs' SHA-256 is that of every byte.
    options
        Names of arguments and the command's options that the report shows in their place.
    """

    command: str
    inputs: Sequence[Path] = ()
    parameters: Mapping[str, Parameter] = field(default_factory=dict)
    checksum: bool = False
    options: Mapping[str, str] = field(default_factory=dict)

    def named(self, lines: Iterable[str]) -> list[str]:
        """Messages with the command's options in place of Python's arguments, where a command writes."""
        return [with_options(line, self.options) if self.options else line for line in lines]

    def facts(self) -> dict[str, Any]:
        """What every run.json begins with: command, versions, parameters, inputs."""
        return {
            "command": self.command,
            "versions": versions(),
            "parameters": dict(self.parameters),
            "inputs": [describe_input(path, whole=self.checksum) for path in self.inputs],
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


def describe_input(path: Path, *, whole: bool = False) -> dict[str, Any]:
    """Path, size and fingerprint of an input; of a folder or a pattern, those of its files in order, as one.

    The fingerprint is the SHA-256 of each file's size and of 64 evenly spaced MiB of it, the first and the
    last among them; of the whole content where the file is shorter, or where ``whole`` asks for it.

    Raises
    ------
    InputError
        For an input that is gone or cannot be read.
    """
    digest, size, modified = hashlib.sha256(), 0, 0.0
    covered = True
    try:
        for file in _files(path):
            facts = file.stat()
            size, modified = size + facts.st_size, max(modified, facts.st_mtime)
            covered &= whole or facts.st_size <= PARTS * MIB
            if not (whole or facts.st_size <= PARTS * MIB):
                digest.update(str(facts.st_size).encode())
            with file.open("rb") as stream:
                for start in _starts(facts.st_size, whole=whole):
                    stream.seek(start)
                    digest.update(stream.read(MIB))
    except OSError as error:
        why = (error.strerror or str(error)).lower()
        raise InputError(path, "an input that stays there until the end", why) from error
    kind = "sha256" if covered else "fingerprint"
    return {"path": str(path), "size_bytes": size, "modified_s": modified, kind: digest.hexdigest()}


def _starts(size: int, *, whole: bool) -> Iterable[int]:
    """Where the MiB begin that are read."""
    if whole or size <= PARTS * MIB:
        return range(0, size, MIB)
    return [round(part * (size - MIB) / (PARTS - 1)) for part in range(PARTS)]


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
