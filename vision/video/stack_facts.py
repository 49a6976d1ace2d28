"""What TIFF stacks say of themselves in ImageJ's, OME's and tifffile's own ways: frame count and times."""

from __future__ import annotations

import math
import re
import struct
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import tifffile

_UNIT_S = {"s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}


def promised_frames(tif: tifffile.TiffFile) -> int:
    """Frames the metadata promise; 0 where they promise nothing."""
    if tif.is_imagej:
        return int((tif.imagej_metadata or {}).get("images", 1))
    if tif.is_ome:
        sizes = re.findall(r'\bSize[TZC]="(\d+)"', _first_pixels(tif))
        return math.prod(int(n) for n in sizes) if sizes else 0
    if tif.is_shaped and tif.shaped_metadata:
        shape = tif.shaped_metadata[0].get("shape", ())
        colour = 1 if tif.pages.first.samplesperpixel > 1 else 0
        return math.prod(shape[: len(shape) - 2 - colour])
    return 0


def is_cut_short(tif: tifffile.TiffFile) -> bool:
    """True where the last page that can be reached names a following one."""
    last, form, file = tif.pages[-1], tif.tiff, tif.filehandle
    file.seek(last.offset)
    tags = int(struct.unpack(form.tagnoformat, file.read(form.tagnosize))[0])
    file.seek(last.offset + form.tagnosize + tags * form.tagsize)
    following = file.read(form.offsetsize)
    return len(following) < form.offsetsize or any(following)


def own_times(tif: tifffile.TiffFile, frames: int) -> NDArray[np.float64] | None:
    """Seconds of each frame from ImageJ's `finterval` or OME's `TimeIncrement`; None without a usable one."""
    step, unit = 0.0, "s"
    if tif.is_imagej:
        metadata = tif.imagej_metadata or {}
        step, unit = float(metadata.get("finterval", 0.0)), str(metadata.get("tunit", "s"))
    elif tif.is_ome:
        pixels = _first_pixels(tif)
        found = re.search(r'\bTimeIncrement="([^"]+)"', pixels)
        named = re.search(r'\bTimeIncrementUnit="([^"]+)"', pixels)
        step, unit = float(found.group(1)) if found else 0.0, named.group(1) if named else "s"
    seconds = step * _UNIT_S.get(unit.strip().lower(), 0.0)
    return np.arange(frames, dtype=np.float64) * seconds if seconds > 0 else None


def _first_pixels(tif: tifffile.TiffFile) -> str:
    """The opening tag of OME's first Pixels element."""
    found = re.search(r"<(?:\w+:)?Pixels\b[^>]*>", tif.ome_metadata or "")
    return found.group() if found else ""
