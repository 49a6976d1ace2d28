"""tracks.nc as plain arrays, read by a process of its own: HDF5 can crash or never end on a damaged file.

It imports neither xarray nor this project's stages: reading begins while the server still imports those.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from vision.errors import InputError
from vision.isolation import run_parser

WANTED = "tracks as track writes them"
AGAIN = "run track again"
CELLS = ("x_px", "x_err_px", "x_withheld_px")
"""Numbers of (frame, sheet); kept in single precision, 1e-4 px, which is enough to look at."""
WORDS = ("flag", "why")
AXES = ("frame", "time_s", "side", "n")
NEEDED = ("x_px", "x_err_px", "flag", "time_s", "side", "n", "frame")
BLOCK = 8192  # frames read at a time


@dataclass(frozen=True, kw_only=True)
class Stored:
    """What a tracks.nc holds.

    Parameters
    ----------
    arrays
        By their names there; words as places in `words`.
    words
        Of each array of words.
    attrs
        Of the file.
    """

    arrays: Mapping[str, NDArray[Any]]
    words: Mapping[str, list[str]]
    attrs: Mapping[str, Any]


def read_tracks(path: Path, rows: slice = slice(None)) -> Stored:
    """The file, or some of its frames.

    Raises
    ------
    InputError
        For a file that is not there, damaged, or no tracks.
    """
    with TemporaryDirectory() as place:
        begin, end = rows.start or 0, -1 if rows.stop is None else rows.stop
        unpacking = f"from vision.review.tracks_file import unpack; unpack(path, {place!r}, {begin}, {end})"
        run_parser(path, unpacking, WANTED)
        facts = json.loads(Path(place, "facts.json").read_text(encoding="utf-8"))
        if facts["absent"]:
            raise InputError(path, WANTED, f"no {', '.join(facts['absent'])}", AGAIN)
        arrays = {one.stem: np.load(one) for one in Path(place).glob("*.npy")}
    return Stored(arrays=arrays, words=facts["words"], attrs=facts["attrs"])


def unpack(path: str, place: str, begin: int, end: int) -> None:
    """In a process of its own: an .npy file per array into a folder, and facts.json.

    Parameters
    ----------
    path
        The file.
    place
        The folder.
    begin, end
        Frames; an end of -1 is the last.
    """
    facts: dict[str, Any] = {"words": {}, "attrs": {}}
    with h5py.File(path, "r") as file:
        facts["absent"] = [name for name in NEEDED if name not in file]
        if not facts["absent"] and file["x_px"].ndim != 2:
            facts["absent"] = ["x(n, t)"]
        if not facts["absent"]:
            rows = slice(*slice(begin, None if end < 0 else end).indices(len(file["x_px"])))
            known = [name for name in (*CELLS, *WORDS, *AXES) if name in file]
            for name in known:
                one = file[name]
                if name in CELLS:
                    values = np.empty((rows.stop - rows.start, one.shape[1]), np.float32)
                    for here, there in _parts(one, rows):
                        values[here] = one[there]
                elif name in WORDS:
                    values, facts["words"][name] = _codes(one, rows)
                else:
                    values = one[rows] if name in ("frame", "time_s") else one[:]
                np.save(Path(place, f"{name}.npy"), values)
            facts["attrs"] = {name: _plain(value) for name, value in file.attrs.items() if name[0] != "_"}
    Path(place, "facts.json").write_text(json.dumps(facts), encoding="utf-8")


def _parts(one: h5py.Dataset, rows: slice) -> list[tuple[slice, slice]]:
    """Rows counted from the first wanted, and in the file, a part at a time.

    Parts begin where the file's chunks do, each of which is unpacked once so.
    """
    chunk = (one.chunks or (1,))[0]
    step = chunk * max(1, BLOCK // chunk)
    firsts = range(rows.start - rows.start % step, rows.stop, step)
    there = [slice(max(first, rows.start), min(first + step, rows.stop)) for first in firsts]
    return [(slice(part.start - rows.start, part.stop - rows.start), part) for part in there]


def _codes(one: h5py.Dataset, rows: slice) -> tuple[NDArray[np.uint8], list[str]]:
    """Words written letter by letter, (frame, sheet, letters), as places in a list of those that occur."""
    codes = np.zeros((rows.stop - rows.start, one.shape[1]), np.uint8)
    words: list[bytes] = []
    for here, there in _parts(one, rows):
        text = np.ascontiguousarray(one[there]).view(f"S{one.shape[-1]}")[..., 0]
        left, found = np.arange(text.size), text.ravel()
        part = codes[here].reshape(-1)
        for code in range(256):
            if not left.size:
                break
            if code == len(words):
                words.append(bytes(found[left[0]]))
            other = found[left] != words[code]
            part[left[~other]] = code
            left = left[other]
    return codes, [word.decode() for word in words]


def _plain(value: Any) -> Any:
    """An attribute as JSON has it."""
    if isinstance(value, bytes):
        return value.decode()
    if isinstance(value, np.generic | np.ndarray):
        return value.item() if value.size == 1 else value.tolist()
    return value
