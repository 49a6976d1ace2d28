"""Where the numbers come from: inputs, versions, parameters, counts, warnings, timings."""

from __future__ import annotations

import glob
import hashlib
import importlib.metadata
import json
import math
import platform
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from vision.errors import InputError

PACKAGES = ("av", "h5netcdf", "numpy", "opencv-python-headless", "pandas", "scipy", "tifffile", "xarray")
CHUNK_BYTES = 1 << 22


@dataclass(frozen=True)
class Parameter:
    """A parameter's value and where it came from."""

    value: Any
    how: Literal["given", "config", "default", "found"]


def versions() -> dict[str, str]:
    """Versions of sheetvision, Python and the libraries that touch the numbers."""
    import vision

    known = {name: _version(name) for name in PACKAGES}
    return {"sheetvision": vision.__version__, "python": platform.python_version(), **known}


def _version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "unknown"


def describe_input(path: Path, *, stop: threading.Event | None = None) -> dict[str, Any]:
    """Path, size and SHA-256 of an input; of a folder or a glob, those of its files in order, hashed as one.

    stop: once set, reading ends and the result is meaningless.  Raises: OSError for a file that is gone.
    """
    digest, size = hashlib.sha256(), 0
    for file in _files(path):
        with file.open("rb") as stream:
            while (chunk := stream.read(CHUNK_BYTES)) and not (stop and stop.is_set()):
                digest.update(chunk)
                size += len(chunk)
    return {"path": str(path), "size_bytes": size, "sha256": digest.hexdigest()}


@contextmanager
def described_meanwhile(path: Path) -> Iterator[Callable[[], dict[str, Any]]]:
    """`describe_input` in a thread while the recording is decoded; yields a function that waits for it.

    A checksum needs every byte, tracking only the strip's: for large files it is the longer of the two.
    Leaving the block before the end stops the thread.  Raises: InputError, from that function, for an input
    that can no longer be read.
    """
    stop, found, failed = threading.Event(), [], []

    def work() -> None:
        try:
            found.append(describe_input(path, stop=stop))
        except OSError as error:  # raised where the result is asked for
            failed.append(error)

    def result() -> dict[str, Any]:
        worker.join()
        if failed:
            why = (failed[0].strerror or str(failed[0])).lower()
            raise InputError(path, "an input that stays there until the end", why)
        return found[0]

    worker = threading.Thread(target=work, daemon=True)
    worker.start()
    try:
        yield result
    finally:
        stop.set()


def _files(path: Path) -> list[Path]:
    if path.is_dir():
        return sorted(file for file in path.iterdir() if file.is_file())
    if path.exists():
        return [path]
    return sorted(Path(name) for name in glob.glob(str(path)))  # noqa: PTH207  # may be absolute


def write_run_json(folder: Path, facts: Mapping[str, Any]) -> None:
    """run.json: strict JSON, null for what is not a number."""
    text = json.dumps(_plain(facts), indent=2, ensure_ascii=False, allow_nan=False)
    (folder / "run.json").write_text(text + "\n", encoding="utf-8")


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, Parameter):
        return {"value": _plain(value.value), "how": value.how}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if hasattr(value, "item"):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if isinstance(value, (bool, int, float, str, type(None))) else str(value)
