"""Subscripts as print has them: σ_x, Λ_st and M_eff are written so in the program and in tables."""

from __future__ import annotations

import re
from typing import Any

_SYMBOL = re.compile(r"(?<![A-Za-z0-9_])([A-Za-zΔΛσδ])_(st|sl|eff|x|v|p|0)\b")
_LETTERED = {"st", "x", "v", "p", "0"}
_SMALL = str.maketrans("xvpst0", "ₓᵥₚₛₜ₀")


def marked_up(text: str) -> Any:
    """For the page: safe markup with <sub>."""
    from markupsafe import Markup, escape

    return Markup(_SYMBOL.sub(r"\1<sub>\2</sub>", str(escape(text))))


def lettered(text: str) -> str:
    """For one line of plain text, as on a canvas: Unicode's own small letters, where there are."""
    return _SYMBOL.sub(lambda m: m[1] + m[2].translate(_SMALL) if m[2] in _LETTERED else m[0], text)


def drawn(text: str) -> str:
    """For matplotlib: small letters, and for the others its slower mathtext in the figure's own font."""
    return _SYMBOL.sub(r"$\1_{\\mathrm{\2}}$", lettered(text))
