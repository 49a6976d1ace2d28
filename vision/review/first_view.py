"""Answers to what a page asks first about a run, kept in its folder: a long run is seen before it is read.

This module imports nothing that takes time, for it is what is waited for.
"""

from __future__ import annotations

import hashlib
import json
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any
from zipfile import BadZipFile, ZipFile

from vision import __version__

NAME = "first_view.zip"
READ = ("run.json", "corrections.toml")
SIZED = ("tracks.nc", "kymograph.tif", "events.csv", "clock.json")
MOST_BYTES = 64 << 20  # more is not a first view


def read_first_view(folder: Path, film: Path | None = None) -> dict[str, bytes]:
    """Answers by their questions; none where they are not those about this run, or damaged.

    Parameters
    ----------
    folder
        The run folder.
    film
        Where the film lies now, if not where it was when it was tracked.
    """
    try:
        with ZipFile(folder / NAME) as kept:
            if (
                kept.comment != _state(folder, film)
                or sum(one.file_size for one in kept.filelist) > MOST_BYTES
            ):
                return {}
            return {name: kept.read(name) for name in kept.namelist()}
    except (OSError, ValueError, RuntimeError, EOFError, BadZipFile, zlib.error):  # all that ZipFile raises
        return {}


def write_first_view(
    path: Path, folder: Path, answers: Mapping[str, bytes], film: Path | None = None
) -> None:
    """The file that `read_first_view` finds in the run folder.

    Parameters
    ----------
    path
        Where it is written.
    folder
        The run folder.
    answers
        By their questions.
    film
        Where the film lies now, if not where it was when it was tracked.
    """
    with ZipFile(path, "w") as kept:
        for name, content in answers.items():
            kept.writestr(name, content)
        kept.comment = _state(folder, film)


def _state(folder: Path, film: Path | None) -> bytes:
    """A digest of what the answers follow from: the run, its decisions, whether its inputs are there, and the
    program that gave them."""
    texts = [(folder / name).read_bytes() if (folder / name).exists() else b"" for name in READ]
    facts = json.loads(texts[0])
    texts += [path.read_bytes() for path in sorted(Path(__file__).parent.glob("*.py"))]
    inputs = [Path(str(one["path"])) for one in facts.get("inputs") or []]
    places = [*inputs, *(folder.absolute().parent / one for one in inputs), *([film] if film else [])]
    known = [__version__, *_facts(folder / name for name in SIZED), *_facts(places, dated=True)]
    return hashlib.sha256(b"\0".join([*texts, json.dumps(known).encode()])).hexdigest().encode()


def _facts(paths: Iterable[Path], *, dated: bool = False) -> list[Any]:
    """Sizes, and times of the last change; nothing of files that are not there."""
    found = [path.stat() if path.exists() else None for path in paths]
    return [one and [one.st_size, one.st_mtime_ns if dated else 0] for one in found]
