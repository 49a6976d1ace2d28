"""Multi-page TIFF, BigTIFF, ImageJ and OME stacks."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vision.errors import InputError
from vision.video.batching import Shot, in_blocks
from vision.video.grey import LUMA_RULE, luma
from vision.video.mapped import MappedReader
from vision.video.source import Block, Facts, Reader
from vision.video.stack_facts import is_cut_short, own_times, promised_frames

if TYPE_CHECKING:
    import tifffile

_MAGIC = (b"II*\x00", b"MM\x00*", b"II+\x00", b"MM\x00+")
_AHEAD = 32  # pages handed to the threads at once


def is_tiff(path: Path) -> bool:
    """True for TIFF and BigTIFF."""
    with path.open("rb") as file:
        return file.read(4) in _MAGIC


def open_stack(path: Path) -> Reader:
    """A reader of one page per frame; pages that are not compressed are mapped, others decoded in threads.

    A stack has one dimension besides rows, columns and colour. An ImageJ stack cut short, which reads as
    one page, gives every whole frame the file holds. Grey values are as stored, also under a look-up table
    or "white is zero".
    Raises: InputError for a damaged file, several dimensions (time and channel, say), pages of several sizes.
    """
    import tifffile

    try:
        with tifffile.TiffFile(path) as tif:
            pages = _pages(tif, path)
            layout = _layout(tif, pages, path)
    except (tifffile.TiffFileError, OSError, ValueError, IndexError, KeyError) as error:
        raise InputError(path, "a TIFF stack", f"a damaged one ({error})", "export it again") from None
    if layout.offsets is not None:
        return MappedReader(
            path=path,
            facts=layout.facts,
            offsets=layout.offsets,
            row_bytes=layout.facts.shape[1] * layout.dtype.itemsize * layout.channels,
            dtype=layout.dtype,
            channels=layout.channels,
        )
    return CompressedStackReader(path, layout.facts, layout.dtype.newbyteorder("="), len(pages))


@dataclass(frozen=True)
class _Layout:
    facts: Facts
    dtype: np.dtype[np.generic]
    channels: int
    offsets: NDArray[np.int64] | None


@dataclass(frozen=True)
class CompressedStackReader:
    """A `Reader` of TIFF pages that must be decoded; a page that cannot be is a frame "corrupt"."""

    path: Path
    facts: Facts
    dtype: np.dtype[np.generic]
    pages: int

    def read(self, start: int, stop: int | None, rows: slice, columns: slice) -> Iterator[Block]:
        """Pages in order, decoded in threads."""
        end = self.pages if stop is None else min(stop, self.pages)
        shots = self._shots(range(start, end))
        yield from in_blocks(shots, start=start, rows=rows, columns=columns, dtype=self.dtype)

    def sample(self, numbers: Sequence[int]) -> Iterator[NDArray[np.generic]]:
        """These pages, whole; those that cannot be decoded are left out."""
        for shot in self._shots([n for n in numbers if n < self.pages]):
            if shot.pixels is not None:
                yield shot.pixels

    def _shots(self, numbers: Sequence[int]) -> Iterator[Shot]:
        import tifffile

        with tifffile.TiffFile(self.path) as tif, ThreadPoolExecutor(os.cpu_count()) as pool:
            tif.filehandle.set_lock(True)  # the threads share one file
            wanted = iter(numbers)
            pages = _pages(tif, self.path)
            while batch := [pages[n] for n in itertools.islice(wanted, _AHEAD)]:
                yield from pool.map(_decode, batch)


def _decode(page: tifffile.TiffPage | tifffile.TiffFrame | None) -> Shot:
    if page is None:
        return Shot(None, "lost")
    try:
        pixels = page.asarray(maxworkers=1)
    except Exception:  # tifffile and its codecs raise whatever they like for damaged data
        return Shot(None, "corrupt")
    return Shot(grey_page(pixels))


def grey_page(pixels: NDArray[np.generic]) -> NDArray[np.generic]:
    """Grey (rows, columns) of a page's array: as it is, or luma of colour in its last or first dimension."""
    if pixels.ndim == 2:
        return pixels
    return luma(pixels if pixels.shape[-1] in (3, 4) else np.moveaxis(pixels, 0, -1))


def _pages(tif: tifffile.TiffFile, path: Path) -> Sequence[tifffile.TiffPage | tifffile.TiffFrame | None]:
    """The frames' pages; InputError unless they are one run of images of one size."""
    if not tif.series:
        raise InputError(path, "a TIFF with an image", "none", "export it again")
    series = tif.series[0]
    many = [
        f"{axis}={n}"
        for axis, n in zip(series.axes, series.shape, strict=True)
        if axis not in "YXS" and n > 1
    ]
    if len(many) > 1:
        raise InputError(path, "one dimension of frames", " ".join(many), "export one channel, one plane")
    if len(series.pages) == 1 and len(tif.series) > 1:  # written page by page, each its own series
        return _single_pages(tif, path)
    if len(tif.series) > 1 and len(tif.series[1].pages) == len(series.pages):
        raise InputError(path, "one series of images", str(len(tif.series)), "export one of them")
    return series.pages


def _single_pages(
    tif: tifffile.TiffFile, path: Path
) -> Sequence[tifffile.TiffPage | tifffile.TiffFrame | None]:
    """All pages but thumbnails; InputError for images of several sizes."""
    pages = [page for page in tif.pages if not getattr(page, "is_reduced", False)]  # a TiffFrame never is
    first = pages[0].shape
    odd = next((page.shape for page in pages if page.shape != first), None)
    if odd is not None:
        found = f"{first[1]} x {first[0]} and {odd[1]} x {odd[0]}"
        raise InputError(path, "pages of one size", found, "split the stack")
    return pages


def _layout(
    tif: tifffile.TiffFile,
    pages: Sequence[tifffile.TiffPage | tifffile.TiffFrame | None],
    path: Path,
) -> _Layout:
    first = tif.pages.first
    if first.dtype is None or first.dtype.kind not in "uf" or first.dtype.itemsize > 4:
        found = str(first.dtype)
        raise InputError(path, "unsigned integers of 8 or 16 bits, or float32", found, "convert the stack")
    size = (first.imagelength, first.imagewidth)
    channels = first.samplesperpixel
    dtype = first.dtype.newbyteorder(tif.byteorder)
    offsets = _offsets(tif, pages, path) if first.planarconfig == 1 or channels == 1 else None
    held = len(pages) if offsets is None else offsets.size
    return _Layout(_facts(tif, size, held, path), dtype, channels, offsets)


def _offsets(
    tif: tifffile.TiffFile,
    pages: Sequence[tifffile.TiffPage | tifffile.TiffFrame | None],
    path: Path,
) -> NDArray[np.int64] | None:
    """Place of every whole frame; None where pages are compressed, tiled, packed or scattered."""
    first = tif.pages.first
    if not first.is_memmappable and not (first.is_contiguous and first.compression == 1):
        return None
    frame_bytes, end = first.nbytes, path.stat().st_size
    if (tif.is_imagej or tif.is_shaped) and promised_frames(tif) > len(tif.pages):  # one page stands for all
        held = min(promised_frames(tif), (end - first.dataoffsets[0]) // frame_bytes)
        return first.dataoffsets[0] + frame_bytes * np.arange(held, dtype=np.int64)
    if not all(page is not None and len(_spans(page)) == 1 for page in pages):
        return None
    places = np.array([_spans(page)[0] for page in pages if page is not None], np.int64)
    return places[places + frame_bytes <= end]


def _spans(page: tifffile.TiffPage | tifffile.TiffFrame) -> list[int]:
    """Where the page's contiguous pieces start: one number for a page stored in one run."""
    starts, lengths = page.dataoffsets, page.databytecounts
    pieces = zip(starts[1:], starts, lengths, strict=False)
    return [starts[0], *(start for start, before, length in pieces if start != before + length)]


def _facts(tif: tifffile.TiffFile, shape: tuple[int, int], held: int, path: Path) -> Facts:
    first = tif.pages.first
    is_float = first.dtype is not None and first.dtype.kind == "f"
    bits = 32 if is_float else int(first.bitspersample)
    if not held:
        raise InputError(path, "at least one whole frame", "none", "the file was cut short; copy it again")
    promised = max(promised_frames(tif), held)
    return Facts(
        shape=shape,
        depth_bits=bits,
        saturation_level=None if is_float else float((1 << bits) - 1),
        promised=promised,
        times_s=own_times(tif, promised),
        warnings=(f"{path.name}: the file was cut short; more pages were to follow",) * is_cut_short(tif),
        notes={
            "container": "tiff",
            "codec": first.compression.name.lower() if hasattr(first.compression, "name") else "uncompressed",
            "pixel_format": f"{first.samplesperpixel} x {first.dtype}",
            "grey": LUMA_RULE if first.samplesperpixel > 1 else "values as stored",
        },
    )
