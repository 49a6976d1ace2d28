"""HDF5 files that are read without a process of their own: those written here, and those one has read before.

Each start of such a process takes a quarter of a second, and most tests read the same few runs, or copies of
them. A file that was damaged has another content, and is tried as ever.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from vision.run import reading, writing


@contextmanager
def harmless_files() -> Iterator[None]:
    """For as long as the block lasts."""
    known: set[bytes] = set()
    try_out, write = reading.try_out, writing.write_tracks_nc

    def written(tracks: Any, path: Path, **how: Any) -> None:
        write(tracks, path, **how)
        known.add(_digest(path))

    def tried(path: Path, *how: Any, **limits: Any) -> None:
        content = _digest(path)
        if content not in known:
            try_out(path, *how, **limits)
            known.add(content)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writing, "write_tracks_nc", written)
        patch.setattr(reading, "try_out", tried)
        yield


def _digest(path: Path) -> bytes:
    """Of the content; random for what is no file, which is never known."""
    return hashlib.sha256(path.read_bytes()).digest() if path.is_file() else os.urandom(8)
