"""Grey pixels out of decoded frames: the luma plane as stored, or BT.601 luma of colour."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import av

LUMA_RULE = "BT.601 luma, 0.299 R + 0.587 G + 0.114 B, rounded"
_LIMITED_RANGE = 1  # AVColorRange: 16..235 of 255


def luma(rgb: NDArray[np.generic]) -> NDArray[np.generic]:
    """Grey (rows, columns) of RGB or RGBA (rows, columns, 3 or 4) in uint8, uint16 or float32: BT.601 luma.

    Integers are rounded, so equal channels come out unchanged.
    """
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(rgb[..., :3]), cv2.COLOR_RGB2GRAY))


def plane(frame: av.VideoFrame) -> NDArray[np.generic]:
    """Grey (rows, columns) of a decoded frame: a view where its format keeps luma apart, else `luma`."""
    kind = frame.format
    if kind.is_rgb or kind.has_palette:
        deep = kind.components[0].bits > 8
        return luma(frame.to_ndarray(format="rgb48le" if deep else "rgb24"))
    bits = kind.components[0].bits
    item: np.dtype[np.generic] = np.dtype("u1" if bits <= 8 else ">u2" if kind.is_big_endian else "<u2")
    stored = frame.planes[0]
    lines = np.frombuffer(memoryview(stored), item).reshape(-1, stored.line_size // item.itemsize)
    offset, step = _PACKED_LUMA.get(kind.name, (0, 1))
    return lines[: frame.height, offset : offset + step * frame.width : step]


_PACKED_LUMA = {
    "yuyv422": (0, 2),
    "uyvy422": (1, 2),
    "yvyu422": (0, 2),
}  # first luma byte, bytes between lumas


def rule(frame: av.VideoFrame) -> str:
    """In words: what a grey value of this frame is."""
    kind = frame.format
    if kind.is_rgb or kind.has_palette:
        return LUMA_RULE
    if kind.name.startswith("gray"):
        return "values as stored"
    return "Y plane as stored" + (", limited range (black 16, white 235 of 255)" if is_limited(frame) else "")


def depth_bits(frame: av.VideoFrame) -> int:
    """Significant bits of a grey value of this frame. Colour above 8 bits is widened to 16 by the decoder."""
    bits = frame.format.components[0].bits
    if frame.format.is_rgb or frame.format.has_palette:
        return 16 if bits > 8 else 8
    return bits


def saturation_level(frame: av.VideoFrame) -> float:
    """Grey value of white: all bits set, or 235/255 of that scale for limited-range luma."""
    bits = depth_bits(frame)
    return float(235 << (bits - 8)) if is_limited(frame) else float((1 << bits) - 1)


def is_limited(frame: av.VideoFrame) -> bool:
    """True for luma stored as 16..235: YUV that does not say it is full range."""
    kind = frame.format
    is_yuv = not (kind.is_rgb or kind.has_palette or kind.name.startswith(("gray", "yuvj")))
    return is_yuv and int(frame.color_range) in (0, _LIMITED_RANGE)
