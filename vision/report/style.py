"""One look for all pictures: readable, safe for colour-blind eyes and for grey printing."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import xarray as xr

LEFT_MAP, RIGHT_MAP = "Blues", "Oranges"


@contextmanager
def picture_style() -> Iterator[None]:
    """Fonts and lines of all pictures, for the time of drawing."""
    import matplotlib as mpl

    look: Any = {
        "font.size": 10,
        "axes.titlesize": 11,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "legend.frameon": False,
        "image.composite_image": False,
        "svg.fonttype": "none",
        "pdf.fonttype": 42,
    }
    with mpl.rc_context(look):
        yield


def sheet_colours(tracks: xr.Dataset) -> list[tuple[float, float, float]]:
    """RGB per sheet: blues on the left, oranges on the right, dark at the centre and brighter outwards."""
    import matplotlib as mpl

    side, n = tracks["side"].values, tracks["n"].values
    depth = 0.95 - 0.45 * (n - 1) / max(1, int(n.max(initial=1)) - 1)
    left, right = mpl.colormaps[LEFT_MAP](depth), mpl.colormaps[RIGHT_MAP](depth)
    rgb = np.where((side < 0)[:, None], left, right)[:, :3]
    return [(float(r), float(g), float(b)) for r, g, b in rgb]


def axis_of(pixel_size_um: float | None, *, small: bool = False) -> tuple[float, str]:
    """Factor from px and label of an x axis: mm (µm for displacements) where the pixel size is known."""
    if pixel_size_um is None:
        return 1.0, "x (px)"
    return (pixel_size_um, "x (µm)") if small else (pixel_size_um / 1000, "x (mm)")
