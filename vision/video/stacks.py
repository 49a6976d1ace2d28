"""Frames in pages or files: TIFF, BigTIFF, ImageJ and OME stacks; folders and globs of numbered images."""

from __future__ import annotations

import math
import re
import struct
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from threading import Lock
from typing import BinaryIO

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray
from PIL import Image as Pillow

from vision.errors import InputError, counted
from vision.files import TIFF, check_pixels, in_threads, members, reading
from vision.numeric import Floats, Ints, Pixels, number
from vision.video.reader import (
    AS_STORED,
    LUMA_RULE,
    SECONDS,
    Facts,
    Frame,
    ImagesReader,
    MappedReader,
    Reader,
    full_scale,
    luma,
    shape_text,
    whole_frames,
)

IMAGES = {".png", *TIFF, ".jpg", ".jpeg", ".bmp"}
_JPEG = {"jpg", "jpeg", "ojpeg", "jpeg_lossy"}
_UM_PER = {"nm": 1e-3, "micron": 1.0, "microns": 1.0, "um": 1.0, "µm": 1.0, "μm": 1.0, "mm": 1e3, "m": 1e6}
"""µm per unit of length. Inch and cm are left out: mostly they give the size of a print, such as 72 dpi."""
_OF_PRINTS = {"inch", "inches", "in", "cm"}

Pillow.MAX_IMAGE_PIXELS = None  # its warning; `check_pixels` bounds what is decoded

Page = tifffile.TiffPage | tifffile.TiffFrame | None
_FORMS = {
    b"II*\0": tifffile.TIFF.CLASSIC_LE,
    b"MM\0*": tifffile.TIFF.CLASSIC_BE,
    b"II+\0": tifffile.TIFF.BIG_LE,
    b"MM\0+": tifffile.TIFF.BIG_BE,
}


def is_tiff(head: bytes) -> bool:
    """Return whether a file that begins with these bytes is a TIFF or BigTIFF."""
    return head[:4] in _FORMS


def open_stack(path: Path) -> Reader:
    """Return a reader of one page per frame; compressed pages are decoded in threads.

    A stack has one dimension besides rows, columns and colour. An ImageJ stack cut short, which reads as
    one page, gives every whole frame the file holds. Grey values are as stored, also under a look-up table
    or "white is zero".

    Raises: InputError for a damaged file, several dimensions (time and channel, say), pages of several sizes,
    signed or 64-bit pixels.
    """
    is_whole = check_tiff(path)
    with reading(path, "a TIFF stack"), tifffile.TiffFile(path) as tif:
        reader = _pages_reader(tif, _pages(tif, path), path)
    cut_short = (f"{path.name}: the file was cut short; more pages were to follow",)
    return reader if is_whole else replace(reader, facts=replace(reader.facts, warnings=cut_short))


def _pages_reader(tif: tifffile.TiffFile, pages: Sequence[Page], path: Path) -> MappedReader | ImagesReader:
    first = tif.pages.first
    if first.dtype is None or first.dtype.kind not in "uf" or first.dtype.itemsize > 4:
        wanted, found = "unsigned integers of 8 or 16 bits, or float32", str(first.dtype)
        raise InputError(path, wanted, found, "convert the stack")
    channels = first.samplesperpixel
    dtype = first.dtype.newbyteorder(tif.byteorder)
    if not 1 <= channels <= 64:  # tifffile allocates memory for all of them
        raise InputError(path, "1 to 64 values per pixel", str(channels), "export it as grey")
    check_pixels(path, first.imagelength, first.imagewidth)
    is_colour = channels > 1 and not _leads_with_grey(first)
    if first.photometric == tifffile.PHOTOMETRIC.SEPARATED:
        raise InputError(
            path, "grey or RGB pixels", "those of a printing process (CMYK)", "export it as grey"
        )
    if is_colour and first.dtype not in (np.uint8, np.uint16, np.float32):
        raise InputError(path, "colours of 8 or 16 bits, or float32", str(first.dtype), "convert the stack")
    offsets = None
    if channels == 1 or (is_colour and first.planarconfig == 1):
        offsets = _offsets(tif, pages, path)
    if offsets is None:
        facts = _stack_facts(tif, len(pages), len(pages), path, decoder="tifffile")
        return ImagesReader(facts, dtype.newbyteorder("="), len(pages), partial(_decode_pages, path))
    facts = _stack_facts(tif, offsets.size, len(pages), path, decoder="none")
    return MappedReader(
        path=path,
        facts=facts,
        offsets=offsets,
        row_bytes=facts.shape[1] * dtype.itemsize * channels,
        dtype=dtype,
        channels=channels,
    )


def _decode_pages(path: Path, numbers: Sequence[int]) -> Iterator[Frame]:
    with tifffile.TiffFile(path) as tif:
        tif.filehandle.set_lock(True)  # the threads share one file
        pages = _pages(tif, path)
        shape = (tif.pages.first.imagelength, tif.pages.first.imagewidth)
        one = partial(_decode_page, shape=shape, tif=tif, lock=Lock())
        yield from in_threads(one, (pages[n] for n in numbers))


def _decode_page(page: Page, shape: tuple[int, int], tif: tifffile.TiffFile, lock: Lock) -> Frame:
    """Return the page as a frame, "corrupt" if it cannot be decoded to this shape.

    Pages in other files of the same recording (OME) are decoded one at a time, each file opened for it.
    """
    if page is None or (key := page.keyframe) is None:
        return Frame(None, "lost")
    try:
        fits = (key.imagelength, key.imagewidth) == shape  # another size might take any memory
        with nullcontext() if page.parent is tif else _opened(page.parent.filehandle, lock):
            grey = _grey_page(key, page.asarray(maxworkers=1)) if fits else None
    except Exception:  # tifffile and its codecs raise any exception for damaged data
        grey = None
    return Frame(grey) if grey is not None and grey.shape == shape else Frame(None, "corrupt")


@contextmanager
def _opened(other: tifffile.FileHandle, lock: Lock) -> Iterator[None]:
    with lock:
        other.open()
        try:
            yield
        finally:
            other.close()


def _grey_page(first: tifffile.TiffPage, pixels: Pixels) -> Pixels:
    """Return grey (rows, columns) of a decoded page: its only or first value per pixel, or luma of colour."""
    if first.samplesperpixel == 1:
        return pixels
    pixels = np.moveaxis(pixels, 0, -1) if first.planarconfig == 2 else pixels
    return pixels[..., 0] if _leads_with_grey(first) else luma(pixels)


def _leads_with_grey(page: tifffile.TiffPage) -> bool:
    """Return whether the first of several values per pixel is grey: of grey with alpha, of Lab, of YCbCr."""
    kinds = tifffile.PHOTOMETRIC
    lab = (kinds.CIELAB, kinds.ICCLAB, kinds.ITULAB)
    # tifffile converts YCbCr to RGB in JPEG alone
    stored_ycbcr = page.photometric == kinds.YCBCR and _codec_of_page(page) != "mjpeg"
    return page.samplesperpixel == 2 or page.photometric in lab or stored_ycbcr


def _pages(tif: tifffile.TiffFile, path: Path) -> Sequence[Page]:
    """Return the frames' pages; InputError unless they are one run of images of one size."""
    if not tif.series:
        raise InputError(path, "a TIFF with an image", "none", "export it again")
    series = tif.series[0]
    sizes = zip(series.axes, series.shape, strict=True)
    many = [f"{axis}={n}" for axis, n in sizes if axis not in "YXS" and n > 1]
    if len(many) > 1:
        raise InputError(path, "one dimension of frames", " ".join(many), "export one channel, one plane")
    if len(tif.series) == 1:
        return series.pages
    if len(series.pages) == 1:  # each page was written as a series
        return _single_pages(tif, path)
    if len(tif.series[1].pages) == len(series.pages):
        raise InputError(path, "one series of images", str(len(tif.series)), "export one of them")
    # a page of another kind between the frames is a damaged one, not the thumbnail or label of a microscope
    frames: dict[int, Page] = {page.index: page for page in series.pages if page is not None}
    return [frames.get(number) for number in range(min(frames), max(frames) + 1)]


def _single_pages(tif: tifffile.TiffFile, path: Path) -> Sequence[Page]:
    """Return all pages but thumbnails; InputError for images of several sizes."""
    pages = [page for page in tif.pages if not getattr(page, "is_reduced", False)]  # a TiffFrame never is
    first = pages[0].shape
    odd = next((page.shape for page in pages if page.shape != first), None)
    if odd is not None:
        found = f"{shape_text(first)} and {shape_text(odd)}"
        raise InputError(path, "pages of one size", found, "split the stack")
    return pages


def _offsets(tif: tifffile.TiffFile, pages: Sequence[Page], path: Path) -> Ints | None:
    """Return the position of each whole frame; None if pages are compressed, tiled, packed, scattered or
    in other files."""
    first = tif.pages.first
    if not (first.is_contiguous and first.compression == first.fillorder == 1):
        return None
    frame_bytes, end = first.nbytes, path.stat().st_size
    declared = _declared_frames(tif)
    if (tif.is_imagej or tif.is_shaped) and declared > len(tif.pages):  # one page stands for all
        held = min(declared, (end - first.dataoffsets[0]) // frame_bytes)
        return first.dataoffsets[0] + frame_bytes * np.arange(held, dtype=np.int64)
    runs = [[] if page is None or page.parent is not tif else _contiguous_runs(page) for page in pages]
    if not all(len(run) == 1 for run in runs):
        return None
    return whole_frames(np.array(runs, np.int64)[:, 0], frame_bytes, end)


def _contiguous_runs(page: tifffile.TiffPage | tifffile.TiffFrame) -> list[int]:
    """Return where the page's contiguous pieces start: one number for a page stored in one run."""
    starts, lengths = page.dataoffsets, page.databytecounts
    pieces = zip(starts[1:], starts, lengths, strict=False)
    return [starts[0], *(start for start, before, length in pieces if start != before + length)]


def _stack_facts(tif: tifffile.TiffFile, held: int, indexed: int, path: Path, *, decoder: str) -> Facts:
    """Return the facts of a stack with `held` whole pages and `indexed` pages in its index."""
    first = tif.pages.first
    is_float = first.dtype is not None and first.dtype.kind == "f"
    bits = 32 if is_float else int(first.bitspersample)
    if not held:
        raise InputError(path, "at least one whole frame", "none", "the file was cut short; copy it again")
    declared = _declared_frames(tif)
    possible = declared <= 10 * path.stat().st_size  # a damaged header may state any number
    declared = max(declared if possible else 0, held, indexed)
    size_um, unused = _own_pixel_size_um(tif)
    return Facts(
        shape=(first.imagelength, first.imagewidth),
        depth_bits=bits,
        saturation_level=None if is_float else full_scale(bits),
        declared_frames=declared,
        container="tiff",
        codec=_codec_of_page(first),
        pixel_format=f"{first.samplesperpixel} x {first.dtype}",
        decoder=decoder,
        grey=LUMA_RULE if first.samplesperpixel > 1 and not _leads_with_grey(first) else AS_STORED,
        times_s=_own_times(tif, declared),
        pixel_size_um=size_um,
        scale_unused=unused,
    )


def _codec_of_page(page: tifffile.TiffPage) -> str:
    """Return TIFF's name of the compression; "mjpeg" for every JPEG, which is lossy as in films."""
    if page.compression == 1 or not hasattr(page.compression, "name"):
        return "uncompressed"
    name = page.compression.name.lower()
    return "mjpeg" if name in _JPEG else str(name)


def _codec_of_image(file: Path) -> str:
    """Return the suffix of an image file, or the compression of a TIFF."""
    if not _is_tiff_image(file):
        suffix = file.suffix.lower().lstrip(".")
        return "mjpeg" if suffix in _JPEG else suffix
    try:
        with tifffile.TiffFile(file) as tif:
            return _codec_of_page(tif.pages.first)
    except (tifffile.TiffFileError, OSError, ValueError, IndexError, KeyError):  # the first image is damaged
        return "tiff"


def _declared_frames(tif: tifffile.TiffFile) -> int:
    """Return the number of frames in the metadata of ImageJ, OME or tifffile; 0 without."""
    samples = tif.pages.first.samplesperpixel
    if tif.is_imagej:
        return int((tif.imagej_metadata or {}).get("images", 1))
    if tif.is_ome:
        sizes = [_ome_pixels(tif).get(f"Size{axis}", "") for axis in "TZC"]
        times, planes, channels = (int(size) if size.isdecimal() else 1 for size in sizes)
        return times * planes * max(1, channels // samples)  # red, green and blue of a page count as channels
    if tif.is_shaped and tif.shaped_metadata:
        shape = tif.shaped_metadata[0].get("shape", ())
        return math.prod(shape[: len(shape) - 2 - (samples > 1)])
    return 0


def _own_times(tif: tifffile.TiffFile, frames: int) -> Floats | None:
    """Return the times of frames from ImageJ's `finterval` or OME's `TimeIncrement`, s; None without."""
    if tif.is_imagej:
        about, names = tif.imagej_metadata or {}, ("finterval", "tunit")
    else:
        about, names = _ome_pixels(tif), ("TimeIncrement", "TimeIncrementUnit")
    unit = str(about.get(names[1], "s")).strip().lower()
    step_s = number(about.get(names[0])) * SECONDS.get(unit, 0.0)
    return np.arange(frames, dtype=np.float64) * step_s if 0 < step_s < math.inf else None


def _own_pixel_size_um(tif: tifffile.TiffFile) -> tuple[float | None, str]:
    """Return the size of a square pixel from ImageJ's or OME's calibration, µm, and a scale not used.

    The size is None without a calibration. A size in inch or cm, also that of the TIFF itself, and one of
    pixels that are not square are not used; they are returned as text.
    """
    stated, about = _stated_by_tags(tif), _ome_pixels(tif)
    if tif.is_ome and not tif.is_imagej:
        names = ("PhysicalSizeX", "PhysicalSizeY")
        stated = [(number(about.get(one)), about.get(f"{one}Unit", "µm").strip().lower()) for one in names]
    (across, unit), (down, unit_down) = stated
    size, height = across * _UM_PER.get(unit, 0.0), down * _UM_PER.get(unit_down, 0.0)
    if 0 < size < math.inf and math.isclose(size, height, rel_tol=1e-3):
        return size, ""
    if 0 < size < math.inf and 0 < height < math.inf:
        return None, f"{size:.4g} x {height:.4g} µm per px, not square"
    if unit in _OF_PRINTS and 0 < across < math.inf:
        return None, f"{1 / across:.4g} px per {unit.replace('inches', 'inch')}, mostly the size of a print"
    return None, ""


def _stated_by_tags(tif: tifffile.TiffFile) -> list[tuple[float, str]]:
    """Return the size of a pixel along x and y, by the TIFF's resolution in ImageJ's or its own unit."""
    tags, unit = tif.pages.first.tags, ""
    if tif.is_imagej:
        unit = str((tif.imagej_metadata or {}).get("unit", "")).replace("\\u00B5", "µ").strip().lower()
    elif "ResolutionUnit" in tags:
        unit = {2: "inch", 3: "cm"}.get(tags["ResolutionUnit"].value, "")
    try:
        stated = [tags[name].value for name in ("XResolution", "YResolution")]
        return [(length / pixels, unit) for pixels, length in stated]
    except (KeyError, TypeError, ValueError, ZeroDivisionError):  # no resolution, or a damaged one
        return [(math.nan, unit)] * 2


def _ome_pixels(tif: tifffile.TiffFile) -> dict[str, str]:
    """Return the attributes of OME's first Pixels element."""
    found = re.search(r"<(?:\w+:)?Pixels\b[^>]*>", tif.ome_metadata or "")
    return dict(re.findall(r'\b(\w+)="([^"]+)"', found.group())) if found else {}


def open_sequence(path: Path) -> ImagesReader:
    """Open the images of a folder, of a glob, or a single one; gaps in their numbers are lost frames.

    Files are ordered by the last number in their names, as cameras count (`…_175055809_0008.tiff` is number
    8). A file that cannot be decoded gives a "corrupt" frame.

    Raises: InputError for no images, several kinds or series of them, or only damaged ones; while reading,
    for an image of another size or depth.
    """
    found = _image_files(path)
    files, warnings = _numbered(found, path)
    there = [file for file in files if file is not None]
    first = next((pixels for pixels in map(_image, there) if pixels is not None), None)
    if first is None:
        raise InputError(path, "at least one readable image", f"{len(found)} that cannot be decoded")
    is_float = first.dtype.kind == "f"
    bits = 32 if is_float else 8 * first.dtype.itemsize
    facts = Facts(
        shape=(first.shape[0], first.shape[1]),
        depth_bits=bits,
        saturation_level=None if is_float else full_scale(bits),
        declared_frames=len(files),
        container="images",
        codec=_codec_of_image(there[0]),
        pixel_format=str(first.dtype),
        decoder="tifffile" if _is_tiff_image(there[0]) else "OpenCV",
        grey=f"{AS_STORED}; colour by {LUMA_RULE}",
        turned_deg=_turned_deg(there[0]),
        warnings=warnings,
    )

    def decode(numbers: Sequence[int]) -> Iterator[Frame]:
        one = partial(_decode_image, shape=facts.shape, dtype=first.dtype)
        return in_threads(one, (files[n] for n in numbers))

    return ImagesReader(facts, first.dtype, len(files), decode)


def _is_tiff_image(file: Path) -> bool:
    return file.suffix.lower() in TIFF


def _turned_deg(file: Path) -> int:
    """Return the clockwise rotation for display that a photograph states (in EXIF), degrees.

    A TIFF's rotation is ignored, as by ImageJ and tifffile.
    """
    if _is_tiff_image(file):
        return 0
    try:
        with Pillow.open(file) as header:
            return {3: 180, 6: 90, 8: 270}.get(header.getexif().get(274, 1), 0)
    except Exception:  # Pillow raises any exception for damaged data
        return 0


def _decode_image(file: Path | None, shape: tuple[int, int], dtype: np.dtype[np.generic]) -> Frame:
    """Return one file as a frame; InputError if it has another size or depth."""
    if file is None:
        return Frame(None, "lost")
    pixels = _image(file)
    if pixels is None and not file.exists():
        wanted, advice = "images that exist while they are read", "wait until no program moves them"
        raise InputError(file, wanted, "one that was removed", advice)
    if pixels is None:
        return Frame(None, "corrupt")
    if pixels.shape != shape or pixels.dtype != dtype:
        wanted = f"{shape_text(shape)} in {dtype}, as the first image"
        raise InputError(file, wanted, f"{shape_text(pixels.shape)} in {pixels.dtype}")
    return Frame(pixels)


def _image_files(path: Path) -> list[Path]:
    """Return the image files; InputError for none or for several kinds."""
    everything = members(path)
    images = [file for file in everything if file.suffix.lower() in IMAGES and file.is_file()]
    if not images:
        wanted = "a film or numbered images (PNG, TIFF, JPEG, BMP)"
        folders = sum(file.is_dir() for file in everything)
        found = f"none among {counted(len(everything) - folders, 'file')}" if everything else "none"
        found += f" and {counted(folders, 'folder')}" if folders else ""
        inside = "give a film, or one folder of images: those inside the folders are not looked for"
        raise InputError(path, wanted, found, inside if folders else "check the folder or the pattern")
    kinds = Counter(file.suffix.lower() for file in images)
    if len(kinds) > 1:
        found = ", ".join(f"{count} {kind}" for kind, count in kinds.most_common())
        raise InputError(path, "images of one kind", found, "give a pattern such as 'folder/*.tiff'")
    return images


def _numbered(files: list[Path], path: Path) -> tuple[tuple[Path | None, ...], tuple[str, ...]]:
    """Return the files by frame number, None for missing numbers, and warnings."""
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
    span = f"{by_number[int(numbers[0])].name} to {by_number[int(numbers[-1])].name}"
    places, warnings = _frame_numbers(numbers, path, span)
    frames: list[Path | None] = [None] * (int(places[-1]) + 1)
    for place, number in zip(places.tolist(), numbers.tolist(), strict=True):
        frames[place] = by_number[number]
    return tuple(frames), warnings


def _frame_numbers(numbers: Ints, path: Path, span: str) -> tuple[Ints, tuple[str, ...]]:
    """Return frame numbers from 0 for file numbers, which may count in steps or not at all.
    span: names of the first and the last file."""
    steps, counts = np.unique(np.diff(numbers), return_counts=True)
    usual = int(steps[np.argmax(counts)])
    if usual > 1 and numbers.size >= 10 and not (steps % usual).any():  # few files do not prove a step
        return (numbers - numbers[0]) // usual, (f"{path.name}: file numbers count in steps of {usual}",)
    if numbers[-1] - numbers[0] > 10 * numbers.size:  # nine in ten frames lost is unlikely: clock times, say
        text = (
            f"{path.name}: file numbers are not frame numbers; only their order is used, from {span}: check"
            " it, as a camera may have begun to count anew"
        )
        return np.arange(numbers.size), (text,)
    return numbers - numbers[0], ()


def _image(file: Path) -> Pixels | None:
    """Return grey pixels of an image file at its full depth; None if it cannot be decoded."""
    try:
        pixels = _tiff_image(file) if _is_tiff_image(file) else _other_image(file)
    except _SeveralPagesError:
        raise
    except Exception:  # decoders raise any exception for damaged data
        return None
    if pixels is None or pixels.ndim != 2 or pixels.dtype.kind not in "uf" or pixels.dtype.itemsize > 4:
        return None
    return pixels


class _SeveralPagesError(InputError):
    """Error for a stack among single images."""


def _tiff_image(file: Path) -> Pixels:
    """Return the only page of a TIFF, or raise any exception of the decoder."""
    check_tiff(file)
    with tifffile.TiffFile(file) as tif:
        held = max(len(tif.pages), _declared_frames(tif))
        same = sum(page.shape == tif.pages.first.shape for page in tif.pages[:3])
        if held > 1 and (same > 1 or len(tif.pages) == 1):
            found = f"one with {held}"
            raise _SeveralPagesError(
                file, "one page per image of a folder", found, "give the stacks one by one"
            )
        check_pixels(file, tif.pages.first.imagelength, tif.pages.first.imagewidth)
        grey = _grey_page(tif.pages.first, tif.pages.first.asarray(maxworkers=1))
    return grey.astype(grey.dtype.newbyteorder("="), copy=False)


def _other_image(file: Path) -> Pixels | None:
    """Return a PNG, JPEG or BMP, or any picture that OpenCV reads under such a name; else None."""
    formats = ("PNG", "JPEG", "BMP", "DIB", "MPO", "TIFF")
    with Pillow.open(file, formats=formats) as header:  # reads the header alone
        check_pixels(file, header.height, header.width)
    data = np.fromfile(file, np.uint8)
    if data.size == 0 or _ends_in_chunk(data):
        return None
    pixels = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    if pixels is None:
        return None
    return np.asarray(pixels) if pixels.ndim == 2 else luma(np.asarray(pixels)[..., 2::-1])


def _ends_in_chunk(data: NDArray[np.uint8]) -> bool:
    """Return whether a PNG ends inside a chunk, for which libpng would allocate whatever it states."""
    at, name = 8, b"" if data[:4].tobytes() == b"\x89PNG" else b"IEND"
    while name != b"IEND" and at + 8 <= data.size:
        name = data[at + 4 : at + 8].tobytes()
        at += 12 + int.from_bytes(data[at : at + 4].tobytes(), "big")
    return at > data.size


# --- the chain of a TIFF's pages, before a library follows it -----------------------------------------------


def check_tiff(path: Path) -> bool:
    """Refuse a TIFF whose index would lead a reader in circles, or whose tags would take it for ever.

    Return False if the chain of its pages leaves the file, which was cut short.

    Raises: InputError for a chain that returns to an earlier page, more tags than a page has, or tags that
    together point to more than the file holds.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        form = _FORMS.get(file.read(4), tifffile.TIFF.CLASSIC_LE)
        file.seek(form.offsetsize)
        seen: set[int] = set()
        spent, found, place = 0, "", _number(form.offsetformat, file)
        while not found and 0 < place < size:
            if place in seen:
                found = f"one whose page {len(seen)} is an earlier one"
            file.seek(place)
            tags = _number(form.tagnoformat, file)
            if tags > 1000:  # microscopes write up to 60; damaged pages of more take long
                found = f"{tags} tags in page {len(seen)}"
            data = file.read(max(0, min(tags, 1000)) * form.tagsize)
            whole = data[: len(data) // form.tagsize * form.tagsize]
            for _, kind, count, _ in struct.iter_unpack(form.tagformat1 + form.tagformat2[1:], whole):
                spent += count * struct.calcsize("=" + tifffile.TIFF.DATA_FORMATS.get(kind, "1B"))
            if spent > size + (1 << 26):  # pages may share values; reading all would never end
                found = "tags that point to more than the file holds"
            seen.add(place)
            place = _number(form.offsetformat, file)
    if found:
        raise InputError(path, "a TIFF stack", found, "copy or export it again")
    return place == 0


def _number(code: str, file: BinaryIO) -> int:
    """Return the next number; -1 at the end of the file."""
    data = file.read(struct.calcsize(code))
    return int(struct.unpack(code, data)[0]) if len(data) == struct.calcsize(code) else -1
