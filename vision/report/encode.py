"""Arrays and pictures in as few bytes as the page needs."""

from __future__ import annotations

import base64
import io
from typing import Any

import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]

PLAIN = 400  # values up to which an array is written as numbers
_STEPS = 32767
_GAP = -32768
_QUALITIES = (85, 75, 60, 45, 30, 15)


class Store:
    """Arrays of a page, each kept once however many figures draw it."""

    def __init__(self) -> None:
        self._places: dict[bytes, int] = {}

    def add(self, values: Doubles) -> dict[str, Any]:
        """What stands in the page for an array: plain numbers if short, else 16-bit steps around a line.

        A long array is kept to 1/65534 of its range about the straight line from its first to its last value
        (rising arrays: times) or about its middle, far below what a screen resolves.
        """
        values = np.asarray(values, np.float64)
        if values.size <= PLAIN:
            return {"v": [None if not np.isfinite(v) else float(f"{v:.8g}") for v in values]}
        start, slope = _line(values)
        rest = values - start - slope * np.arange(values.size)
        known = np.isfinite(rest)
        low, high = (float(rest[known].min()), float(rest[known].max())) if known.any() else (0.0, 0.0)
        middle, step = (low + high) / 2, (high - low) / (2 * _STEPS) or 1.0
        code = np.where(known, np.rint((np.nan_to_num(rest) - middle) / step), _GAP).astype("<i2")
        place = self._places.setdefault(code.tobytes(), len(self._places))
        return {"b": place, "start": start + middle, "slope": slope, "step": step}

    def blobs(self) -> list[str]:
        """All arrays in base64, in the order of their places."""
        return [base64.b64encode(data).decode("ascii") for data in self._places]


def _line(values: Doubles) -> tuple[float, float]:
    """Start and slope of the line an array is written about: 0 and 0 unless it rises throughout."""
    if not np.isfinite(values).all() or (np.diff(values) < 0).any():
        return 0.0, 0.0
    return float(values[0]), float(values[-1] - values[0]) / (values.size - 1)


def picture_uri(pixels: NDArray[np.uint8], *, most_bytes: int) -> str:
    """A grey picture as a JPEG data URI, of the best quality that keeps to the size, made smaller if need
    be."""
    from PIL import Image

    image = Image.fromarray(pixels)
    while True:
        for quality in _QUALITIES:
            stream = io.BytesIO()
            image.save(stream, "JPEG", quality=quality, optimize=True)
            if stream.tell() <= most_bytes:
                text = base64.b64encode(stream.getvalue()).decode("ascii")
                return f"data:image/jpeg;base64,{text}"
        image = image.resize((max(1, image.width * 2 // 3), max(1, image.height * 2 // 3)))
