"""Colours of all figures, for light and dark backgrounds, grey print and colour-blind readers.

Single colours are those of Okabe & Ito; series also differ in luminance, dashes and markers. Sheets are blue
on the left and orange on the right, and darkest (on a light background) at the axis.
"""

from __future__ import annotations

import numpy as np
import xarray as xr

from vision.figures.figure import Ink
from vision.numeric import Floats

DATA: Ink = ("#0072b2", "#56b4e9")
PEAK: Ink = ("#b34700", "#ff9d57")
VALLEY: Ink = ("#008060", "#4fd6ad")
MODEL: Ink = ("#1a1a1a", "#f2f2f2")
OTHER_MODEL: Ink = ("#8a5a83", "#e0a3d6")
QUIET: Ink = ("#6b6b6b", "#a8a8a8")
LEFT_ON_GREY: Ink = ("#3fb0ff", "#3fb0ff")
RIGHT_ON_GREY: Ink = ("#ff8a1f", "#ff8a1f")
HIGHLIGHT = "#d55e00"  # outline of the strip and marks of slips
CASING = "#101010"  # edge of tracks over an image
MISSING = "#cfe3f5"  # pixels that were not recorded

# parts of matplotlib's Blues, Oranges and viridis, as (light background, dark background)
_BLUES = ("#083c7d", "#1764ab", "#3b8bc2", "#6aaed6"), ("#dfecf7", "#b9d6ea", "#7fb9da", "#4493c7")
_ORANGES = ("#8e2d04", "#c54102", "#ec620f", "#fd8c3b"), ("#fee7d0", "#fdc590", "#fd9a4e", "#f26b15")
_VIRIDIS = ("#440154", "#3b528b", "#21918c", "#5ec962", "#fde725")


def sheet_inks(tracks: xr.Dataset) -> list[Ink]:
    """Return one colour per sheet, with the strongest contrast at the axis on either background."""
    side, n = tracks["side"].values, tracks["n"].values
    most = int(n.max(initial=1))
    outward = (n - 1) / (most - 1) if most > 1 else np.full(n.shape, 2 / 3)
    tones = {s: [_along(tone, outward) for tone in (_BLUES if s < 0 else _ORANGES)] for s in (-1, 1)}
    return [(tones[s][0][k], tones[s][1][k]) for k, s in enumerate(np.where(side < 0, -1, 1).tolist())]


def ordered_inks(count: int) -> list[Ink]:
    """Return colours for an ordered set, such as sticks from first to last, with rising luminance."""
    shares = np.linspace(0, 1, max(count, 2))[:count]
    light, dark = _along(_VIRIDIS, 0.82 * shares), _along(_VIRIDIS, 0.3 + 0.7 * shares)
    return list(zip(light, dark, strict=True))


def rgb(colour: str) -> tuple[int, int, int]:
    """Return red, green and blue of "#rrggbb", 0 to 255."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def _along(colours: tuple[str, ...], shares: Floats) -> list[str]:
    """Return interpolated colours at these shares of the way from the first to the last, 0 to 1."""
    at = np.linspace(0, 1, len(colours))
    channels = [np.interp(shares, at, channel) for channel in zip(*map(rgb, colours), strict=True)]
    return [f"#{round(r):02x}{round(g):02x}{round(b):02x}" for r, g, b in zip(*channels, strict=True)]
