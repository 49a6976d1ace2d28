"""One look for all pictures: readable, safe for colour-blind eyes and for grey printing."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import xarray as xr

LEFT_MAP, RIGHT_MAP = "Blues", "Oranges"

# colour on a light and on a dark ground; Okabe & Ito's set, told apart by luminance, dashes and marks as well
DATA = ("#0072b2", "#56b4e9")
PEAK = ("#b34700", "#ff9d57")
VALLEY = ("#008060", "#4fd6ad")
MODEL = ("#1a1a1a", "#f2f2f2")
OTHER_MODEL = ("#8a5a83", "#e0a3d6")
LEFT_ON_GREY, RIGHT_ON_GREY = ("#1e88ff", "#1e88ff"), ("#ff6a00", "#ff6a00")
QUIET = ("#6b6b6b", "#a8a8a8")

STROKE = 0.2  # of the strip's height: marks of a sheet from above and below, its ridge left to be seen


@contextmanager
def picture_style() -> Iterator[None]:
    """Fonts and lines of all pictures, for the time of drawing."""
    import matplotlib as mpl

    look: Any = {
        "font.family": _families(),
        "font.size": 10,
        "axes.titlesize": 11,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "legend.frameon": False,
        "image.composite_image": False,
        "mathtext.default": "regular",
        "svg.fonttype": "none",
        "pdf.fonttype": 42,
    }
    with mpl.rc_context(look):
        yield


@cache
def _families() -> list[str]:
    """Fonts of all pictures: the cut-down one that is quick to embed, the whole one for letters it lacks."""
    from matplotlib.font_manager import fontManager

    fontManager.addfont(str(files("vision.report").joinpath("assets/DejaVuSansFigures.ttf")))
    return ["DejaVu Sans Figures", "DejaVu Sans"]


def sheet_colours(tracks: xr.Dataset) -> list[tuple[float, float, float]]:
    """RGB per sheet: blues on the left, oranges on the right, dark at the centre and brighter outwards."""
    import matplotlib as mpl

    side, n = tracks["side"].values, tracks["n"].values
    depth = 0.95 - 0.45 * (n - 1) / max(1, int(n.max(initial=1)) - 1)
    left, right = mpl.colormaps[LEFT_MAP](depth), mpl.colormaps[RIGHT_MAP](depth)
    rgb = np.where((side < 0)[:, None], left, right)[:, :3]
    return [(float(r), float(g), float(b)) for r, g, b in rgb]


def sheet_inks(tracks: xr.Dataset) -> list[tuple[str, str]]:
    """Per sheet, its colour on a light and on a dark ground, strongest at the centre on either."""
    import matplotlib as mpl
    from matplotlib.colors import to_hex

    side, n = tracks["side"].values, tracks["n"].values
    outward = (n - 1) / max(1, int(n.max(initial=1)) - 1)
    maps = [mpl.colormaps[LEFT_MAP if s < 0 else RIGHT_MAP] for s in side]
    return [
        (to_hex(chosen(0.95 - 0.45 * float(k))), to_hex(chosen(0.12 + 0.5 * float(k))))
        for chosen, k in zip(maps, outward, strict=True)
    ]


def ordered_inks(count: int) -> list[tuple[str, str]]:
    """Colours for an ordered set (sticks from first to last): luminance rises steadily, so grey print keeps
    the order."""
    import matplotlib as mpl
    from matplotlib.colors import to_hex

    shares = np.linspace(0, 1, max(count, 2))[:count]
    ramp = mpl.colormaps["viridis"]
    return [(to_hex(ramp(0.82 * float(k))), to_hex(ramp(0.3 + 0.7 * float(k)))) for k in shares]
