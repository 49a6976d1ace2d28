"""Colours of all figures, and text of figures and of the report: symbols, numbers with errors, units, axes.

Colours suit light and dark backgrounds, grey print and colour-blind readers. Single colours are those of
Okabe & Ito; series also differ in luminance, dashes and markers. Sheets are blue on the left and orange on
the right, and darkest (on a light background) at the axis.
"""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from markupsafe import Markup, escape

from vision.data import StripMetadata
from vision.figures.figure import Ink
from vision.models import Estimate, plus_minus
from vision.numeric import Floats, with_minus

if TYPE_CHECKING:
    from vision.clock import Clock

DATA: Ink = ("#0072b2", "#56b4e9")
PEAK: Ink = ("#b34700", "#ff9d57")
VALLEY: Ink = ("#008060", "#4fd6ad")
MODEL: Ink = ("#1a1a1a", "#f2f2f2")
OTHER_MODEL: Ink = ("#8a5a83", "#e0a3d6")
QUIET: Ink = ("#6b6b6b", "#a8a8a8")
ON_GREY: dict[int, Ink] = {-1: ("#3fb0ff", "#3fb0ff"), 1: ("#ff8a1f", "#ff8a1f")}  # sheets, by their side
HIGHLIGHT = "#d55e00"  # outline of the strip
SLIPS = "#e04fb3"  # marks of slips, magenta: unlike the tracks of both sides, also without red or green
CASING = "#101010"  # edge of tracks over an image
MISSING = "#cfe3f5"  # pixels that were not recorded

MANY_POINTS = 150  # more points of a series are drawn smaller, with faint error bars, and take turns
TURNS = 32  # parts in which such points are drawn; with 8, three tests of 635 events still hide the first

# parts of matplotlib's Blues, Oranges and viridis, as (light background, dark background)
_BLUES = ("#083c7d", "#1764ab", "#3b8bc2", "#6aaed6"), ("#dfecf7", "#b9d6ea", "#7fb9da", "#4493c7")
_ORANGES = ("#8e2d04", "#c54102", "#ec620f", "#fd8c3b"), ("#fee7d0", "#fdc590", "#fd9a4e", "#f26b15")
_VIRIDIS = ("#440154", "#3b528b", "#21918c", "#5ec962", "#fde725")


def sheet_inks(tracks: xr.Dataset) -> list[Ink]:
    """Return one colour per sheet, with the strongest contrast at the axis on either background."""
    side, n = tracks["side"].values, tracks["n"].values
    most = int(n.max(initial=1))
    outward = (n - 1) / (most - 1) if most > 1 else np.full(n.shape, 2 / 3)
    blues, oranges = (
        zip(_along(light, outward), _along(dark, outward), strict=True) for light, dark in (_BLUES, _ORANGES)
    )
    return [blue if s < 0 else orange for s, blue, orange in zip(side, blues, oranges, strict=True)]


def ordered_inks(count: int) -> list[Ink]:
    """Return colours for an ordered set, such as sticks from first to last, with rising luminance."""
    shares = np.linspace(0, 1, max(count, 2))[:count]
    light, dark = _along(_VIRIDIS, 0.82 * shares), _along(_VIRIDIS, 0.3 + 0.7 * shares)
    return list(zip(light, dark, strict=True))


def ordered_looks(count: int) -> list[dict[str, Any]]:
    """Return the colours of `ordered_inks` for series of points, every other of which is hollow."""
    return [{"ink": ink, "hollow": k % 2 == 1} for k, ink in enumerate(ordered_inks(count))]


def rgb(colour: str) -> tuple[int, int, int]:
    """Return red, green and blue of "#rrggbb", 0 to 255."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def _along(colours: tuple[str, ...], shares: Floats) -> list[str]:
    """Return interpolated colours at these shares of the way from the first to the last, 0 to 1."""
    at = np.linspace(0, 1, len(colours))
    channels = [np.interp(shares, at, channel) for channel in zip(*map(rgb, colours), strict=True)]
    return [f"#{round(r):02x}{round(g):02x}{round(b):02x}" for r, g, b in zip(*channels, strict=True)]


# --- symbols: σ_x, Λ_st and M_eff are written so in the program and in tables -------------------------------

_SYMBOL = re.compile(r"(?<![A-Za-z0-9_])([A-Za-zΔΛσδ𝒯])_(st|sl|eff|x|v|p|0)\b")
_SUBSCRIPTS = str.maketrans("xvpst0", "ₓᵥₚₛₜ₀")


def to_html(text: str) -> Markup:
    """Return safe HTML, with <sub> for subscripts, also where lines of the terminal have 𝒯0."""
    return Markup(_SYMBOL.sub(r"\1<sub>\2</sub>", str(escape(text)).replace("𝒯0", "𝒯_0")))


def to_unicode(text: str) -> str:
    """Return plain text with Unicode subscripts; "_eff" and "_sl" are unchanged, as Unicode lacks them."""
    return _SYMBOL.sub(lambda m: m[0] if m[2] in ("eff", "sl") else m[1] + m[2].translate(_SUBSCRIPTS), text)


def to_mathtext(text: str) -> str:
    """Return text for matplotlib, with Unicode subscripts, or else mathtext, which is slower."""
    # A name may contain "$".
    plain = _SYMBOL.sub(r"$\1_{\\mathrm{\2}}$", to_unicode(text).replace("$", r"\$"))
    plain = plain.replace("𝒯₀", r"$\mathcal{T}_0$")  # the font lacks this letter
    # Outside mathtext, a hat on a capital is cut off.
    return re.sub("(\\w)\u0302", r"$\\hat{\\mathrm{\1}}$", plain)


_LATEX = {
    **dict.fromkeys("μµ", r"\mu"),
    **{"σ": r"\sigma", "δ": r"\delta", "Δ": r"\Delta", "Λ": r"\Lambda", "λ": r"\lambda"},
    **{"ε": r"\varepsilon", "φ": r"\varphi", "χ": r"\chi", "𝒯": r"\mathcal{T}", "²": "^2", "°": r"^\circ"},
    **{"±": r"\pm", "−": "-", "×": r"\times", "·": r"\cdot", "√": r"\surd", "∝": r"\propto"},
}
_TO_LATEX = re.compile(rf"{_SYMBOL.pattern}|(\w)\u0302|([{''.join(_LATEX)}])|([\\%&#$_{{}}])")


def to_latex(text: str) -> str:
    """Return text for LaTeX: Greek letters, symbols with subscripts or hats and signs in formulae."""

    def formula(match: re.Match[str]) -> str:
        letter, subscript, hatted, sign, special = match.groups()
        if special:
            return rf"\{special}"
        body = _LATEX.get(letter or hatted or sign, letter or hatted)
        body = rf"\hat{{{body}}}" if hatted else body
        lowered = subscript if subscript in (None, "x", "0") else rf"\mathrm{{{subscript}}}"
        return f"${body}_{{{lowered}}}$" if subscript else f"${body}$"

    return _TO_LATEX.sub(formula, text.replace("𝒯0", "𝒯_0"))


# --- numbers ------------------------------------------------------------------------------------------------


def offset_text(clock: Clock) -> str:
    """Return a clock's offset, with its error if known, and at which video time if not at 0."""
    if not clock.offset_err_s > 0:
        return with_minus(f"{clock.offset_s:.4f} s")
    at, offsets, error_s = clock.offsets_at_slips()
    when = f" at video time {at} s" if at else ""
    return f"{plus_minus(Estimate(float(offsets[0]), error_s))} s{when}"


def drift_text(clock: Clock) -> str:
    """Return a clock's drift, with its error if known."""
    if clock.status == "given" and clock.drift_ppm == 0:  # an offset alone says nothing about the drift
        return "0 ppm (assumed)"
    error = clock.drift_err_ppm
    if not error > 0:
        return with_minus(f"{clock.drift_ppm:+.0f} ppm")
    sign = "+" if clock.drift_ppm > 0 else ""
    return f"{sign}{plus_minus(Estimate(clock.drift_ppm, error))} ppm"


def matches_text(clock: Clock) -> str:
    """Return how many slips match, to how many ms, and how many only one recording shows."""
    spread = f" to {clock.residual_ms:.2g} ms (median)" if math.isfinite(clock.residual_ms) else ""
    numbers = {"film": clock.unmatched_video, "force": clock.unmatched_force}
    alone = "".join(f", {count} only in the {name}" for name, count in numbers.items() if count > 0)
    return f"{clock.matched} slips matched{spread}{alone}"


# --- units and axes -----------------------------------------------------------------------------------------

UM_PER_MM = 1000
# labels of axes that several figures share
VALLEY_SEPARATION = "d_v (mm)"
FORCE_CLOCK = ", force clock"  # left out where there is no other clock


def time_axis(data: xr.Dataset | xr.DataArray) -> tuple[Floats, str]:
    """Return the times of the frames of tracks or I(x, t), (frame,), and the label of their axis.

    The label names the playback rate if the times are known only from it. Frame numbers replace times that
    are unknown, do not increase in most frames, or decrease.
    """
    time = np.asarray(data["time_s"].values, np.float64)
    steps = np.diff(time)
    if not np.isfinite(time).all() or (steps < 0).any() or (steps.size and np.median(steps) <= 0):
        return np.asarray(data["frame"].values, np.float64), "frame"
    playback = "clock_kind" in data.attrs and StripMetadata.of(data).clock_kind == "playback"
    return time, "t (s, playback rate)" if playback else "t (s)"


def displacement_unit(pixel_size_um: float | None) -> tuple[float, str]:
    """Return the factor from px, and the unit: µm, or px if the pixel size is not known."""
    return (1.0, "px") if pixel_size_um is None else (pixel_size_um, "µm")


def position_unit(pixel_size_um: float | None, width_px: float) -> tuple[float, str]:
    """Return factor from px and unit for a picture `width_px` wide: mm, µm below 1 mm, or px."""
    if pixel_size_um is None or pixel_size_um * width_px < UM_PER_MM:
        return displacement_unit(pixel_size_um)
    return pixel_size_um / UM_PER_MM, "mm"


def from_zero(*values: Floats, share: float = 1.0) -> tuple[float, float] | None:
    """Return the range of an axis from 0 to above the values; None if none is positive.

    share: quantile of the values. If the largest is more than twice as large, it may lie outside.
    """
    known = np.concatenate([np.asarray(part, np.float64).ravel() for part in values])
    known = known[np.isfinite(known)]
    if not known.size:
        return None
    usual, largest = float(np.quantile(known, share)), float(known.max())
    top = 1.15 * largest if largest < 2 * usual else 1.25 * usual  # the rest are outliers
    return (0.0, top) if top > 0 else None


def label_step(x: Any, width: float) -> int:
    """Return the step, 1, 2, 5, 10, 20, …, at which labels of this width fit, one at every step-th point."""
    pitch = float(np.median(np.abs(np.diff(x)))) if len(x) > 1 else width
    least = width / max(pitch, 1e-9)
    steps = np.outer(10 ** np.arange(6), [1, 2, 5]).ravel()
    return int(steps[min(int(np.searchsorted(steps, least)), steps.size - 1)])
