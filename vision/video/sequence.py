"""A folder or a glob of numbered images: one file per frame, gaps in the numbers are lost frames."""

from __future__ import annotations

import glob
import itertools
import os
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.errors import InputError
from vision.video.batching import Shot, in_blocks
from vision.video.grey import LUMA_RULE, luma
from vision.video.source import Block, Facts
from vision.video.stack import grey_page

IMAGES = {".png", ".tif", ".tiff", ".jpg", ".jpeg", ".bmp"}
_AHEAD = 32  # files handed to the threads at once
_SPARSE = 10  # numbers spread wider than this many times the count are no frame numbers
_ENOUGH = 10  # files from which a constant step between numbers is believed


@dataclass(frozen=True)
class SequenceReader:
    """A `Reader` of image files. files: one per frame number, None for a number without a file (lost).

    A file that cannot be decoded is a frame "corrupt". InputError for one of another size or depth.
    """

    path: Path
    files: tuple[Path | None, ...]
    facts: Facts
    dtype: np.dtype[np.generic]

    def read(self, start: int, stop: int | None, rows: slice, columns: slice) -> Iterator[Block]:
        """Files in order of their numbers, decoded in threads."""
        shots = self._shots(self.files[start:stop])
        yield from in_blocks(shots, start=start, rows=rows, columns=columns, dtype=self.dtype)

    def sample(self, numbers: Sequence[int]) -> Iterator[NDArray[np.generic]]:
        """These frames, whole; lost and corrupt ones are left out."""
        for shot in self._shots([self.files[n] for n in numbers if n < len(self.files)]):
            if shot.pixels is not None:
                yield shot.pixels

    def _shots(self, files: Sequence[Path | None]) -> Iterator[Shot]:
        wanted = iter(files)
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            while batch := list(itertools.islice(wanted, _AHEAD)):
                yield from pool.map(self._shot, batch)

    def _shot(self, file: Path | None) -> Shot:
        if file is None:
            return Shot(None, "lost")
        pixels = _image(file)
        if pixels is None:
            return Shot(None, "corrupt")
        if pixels.shape != self.facts.shape or pixels.dtype != self.dtype:
            height, width = self.facts.shape
            found = f"{pixels.shape[1]} x {pixels.shape[0]} in {pixels.dtype}"
            raise InputError(file, f"{width} x {height} in {self.dtype}, as the first image", found)
        return Shot(pixels)


def open_sequence(path: Path) -> SequenceReader:
    """The images of a folder, of a glob pattern, or a single one.

    Files are ordered by the last number in their names, as cameras count (`…_175055809_0008.tiff` is number
    8).
    Raises: InputError for no images, several kinds or series of them, or none that can be read.
    """
    found = _candidates(path)
    files, warnings = _numbered(found, path)
    first = next(
        (pixels for file in files if file is not None and (pixels := _image(file)) is not None), None
    )
    if first is None:
        raise InputError(path, "at least one readable image", f"{len(found)} that cannot be decoded")
    is_float = first.dtype.kind == "f"
    bits = 32 if is_float else 8 * first.dtype.itemsize
    facts = Facts(
        shape=(first.shape[0], first.shape[1]),
        depth_bits=bits,
        saturation_level=None if is_float else float((1 << bits) - 1),
        promised=len(files),
        warnings=warnings,
        notes={
            "container": "images",
            "codec": found[0].suffix.lower().lstrip("."),
            "pixel_format": str(first.dtype),
            "grey": f"values as stored; colour by {LUMA_RULE}",
        },
    )
    return SequenceReader(path, files, facts, first.dtype)


def _candidates(path: Path) -> list[Path]:
    """Image files of one kind; InputError for none or for several kinds."""
    if path.is_dir():
        everything = list(path.iterdir())
    elif path.exists():
        everything = [path]
    else:
        everything = [Path(name) for name in glob.glob(str(path))]  # noqa: PTH207  # may be absolute
    images = [file for file in everything if file.suffix.lower() in IMAGES and file.is_file()]
    if not images:
        raise InputError(
            path, "numbered images (PNG, TIFF, JPEG, BMP)", "none", "check the folder or the pattern"
        )
    kinds = Counter(file.suffix.lower() for file in images)
    if len(kinds) > 1:
        found = ", ".join(f"{count} {kind}" for kind, count in kinds.most_common())
        raise InputError(path, "images of one kind", found, "give a pattern such as 'folder/*.tiff'")
    return images


def _numbered(files: list[Path], path: Path) -> tuple[tuple[Path | None, ...], tuple[str, ...]]:
    """The files by frame number, None for numbers left out, and warnings."""
    if len(files) == 1:
        return (files[0],), ()
    by_number: dict[int, Path] = {}
    for file in files:
        digits = re.findall(r"\d+", file.stem)
        if not digits:
            raise InputError(path, "a number in every image's name", file.name, "give a pattern")
        number = int(digits[-1])
        if number in by_number:
            both = f"{by_number[number].name} and {file.name}"
            raise InputError(path, "one image per frame number", both, "give a pattern that fits one series")
        by_number[number] = file
    numbers = np.array(sorted(by_number), np.int64)
    places, warnings = _places(numbers, path)
    frames: list[Path | None] = [None] * (int(places[-1]) + 1)
    for place, number in zip(places.tolist(), numbers.tolist(), strict=True):
        frames[place] = by_number[number]
    return tuple(frames), warnings


def _places(numbers: NDArray[np.int64], path: Path) -> tuple[NDArray[np.int64], tuple[str, ...]]:
    """Frame numbers from 0 out of file numbers, which may count in steps or be no count at all."""
    steps, counts = np.unique(np.diff(numbers), return_counts=True)
    usual = int(steps[np.argmax(counts)])
    if usual > 1 and numbers.size >= _ENOUGH and not (steps % usual).any():
        return (numbers - numbers[0]) // usual, (f"{path.name}: file numbers count in steps of {usual}",)
    if numbers[-1] - numbers[0] > _SPARSE * numbers.size:
        text = f"{path.name}: file numbers are no frame count; only their order is used"
        return np.arange(numbers.size), (text,)
    return numbers - numbers[0], ()


def _image(file: Path) -> NDArray[np.generic] | None:
    """Grey pixels of an image file at its full depth; None where it cannot be decoded."""
    if file.suffix.lower() in (".tif", ".tiff"):
        return _tiff(file)
    data = np.fromfile(file, np.uint8)
    pixels = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    if pixels is None:
        return None
    return np.asarray(pixels) if pixels.ndim == 2 else luma(np.asarray(pixels)[..., 2::-1])


def _tiff(file: Path) -> NDArray[np.generic] | None:
    import tifffile

    try:
        pixels = tifffile.imread(file, maxworkers=1)
    except Exception:  # tifffile and its codecs raise whatever they like for damaged data
        return None
    grey = grey_page(pixels)
    return grey.astype(grey.dtype.newbyteorder("="), copy=False)
