"""Read tracks.nc as plain arrays in a separate process, since HDF5 can crash or hang on a damaged file.

This module imports neither xarray nor the stages of the analysis, so that reading can begin while the server
still imports those.
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
from vision.files import AGAIN, try_out

WANTED = "tracks as track writes them"
CELLS = ("x_px", "x_err_px", "x_withheld_px")
"""Numbers of (frame, sheet), in single precision: 1e-4 px is enough for display."""
WORDS = ("flag", "why")
AXES = ("frame", "time_s", "side", "n")
BLOCK = 8192  # frames whose words are read at a time, so that they take little memory
NEEDED = ("x_px", "x_err_px", "flag", "time_s", "side", "n", "frame")


@dataclass(frozen=True, kw_only=True)
class StoredTracks:
    """Content of a tracks.nc."""

    arrays: Mapping[str, NDArray[Any]]  # by name; words as indices in `words`
    words: Mapping[str, list[str]]  # those that occur in each array of words
    attrs: Mapping[str, Any]


def read_tracks(path: Path, rows: slice = slice(None)) -> StoredTracks:
    """Read the file, or some of its frames.

    Raises: InputError if the file is missing, damaged or not a file of tracks.
    """
    with TemporaryDirectory() as folder:
        ends = f"{rows.start}, {rows.stop}"
        unpacking = f"from vision.review.tracks_file import unpack; unpack(path, {folder!r}, slice({ends}))"
        try_out(path, unpacking, WANTED)
        facts = json.loads(Path(folder, "facts.json").read_text(encoding="utf-8"))
        if facts["absent"]:
            raise InputError(path, WANTED, f"no {', '.join(facts['absent'])}", AGAIN)
        arrays = {one.stem: np.load(one) for one in Path(folder).glob("*.npy")}
    return StoredTracks(arrays=arrays, words=facts["words"], attrs=facts["attrs"])


def unpack(path: str, folder: str, rows: slice) -> None:
    """Write an .npy file per array and facts.json into a folder; called in the separate process."""
    facts: dict[str, Any] = {"words": {}, "attrs": {}}
    with h5py.File(path, "r") as file:
        facts["absent"] = [name for name in NEEDED if name not in file]
        if not facts["absent"] and file["x_px"].ndim != 2:
            facts["absent"] = ["x(n, t)"]
        if not facts["absent"]:
            for name in filter(file.__contains__, (*CELLS, *WORDS, *AXES)):
                one = file[name]
                if name in CELLS:
                    values = one.astype(np.float32)[rows]
                elif name in WORDS:
                    values, facts["words"][name] = _codes(one, rows)
                else:
                    values = one[rows] if name in ("frame", "time_s") else one[:]
                np.save(Path(folder, f"{name}.npy"), values)
            facts["attrs"] = {name: _plain(value) for name, value in file.attrs.items() if name[0] != "_"}
    Path(folder, "facts.json").write_text(json.dumps(facts), encoding="utf-8")


def _codes(one: h5py.Dataset, rows: slice) -> tuple[NDArray[np.uint8], list[str]]:
    """Convert words stored as characters, (frame, sheet, character), to indices in a list of the words."""
    first, stop, _ = rows.indices(len(one))
    codes = np.zeros((stop - first, one.shape[1]), np.uint8)
    words: list[bytes] = []
    for start in range(first, stop, BLOCK):
        text = np.ascontiguousarray(one[start : min(start + BLOCK, stop)]).view(f"S{one.shape[-1]}").ravel()
        part, left, code = codes[start - first :].reshape(-1), np.arange(text.size), 0
        while left.size and code < 256:  # there are about a dozen words; np.unique would sort all cells
            words += [bytes(text[left[0]])] * (code == len(words))
            other = text[left] != words[code]
            part[left[~other]] = code
            left, code = left[other], code + 1
    return codes, [word.decode() for word in words]


def _plain(value: Any) -> Any:
    """Convert an attribute to what JSON can represent."""
    if isinstance(value, bytes):
        return value.decode()
    if isinstance(value, np.generic | np.ndarray):
        return value.item() if value.size == 1 else value.tolist()
    return value
