"""Numbers as text: no more digits than they are worth."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vision.models.fits_result import Estimate


def percent(share: float) -> str:
    """A share as a percentage that does not round 99.96 up to 100."""
    return f"{math.floor(1000 * share) / 10:g} %"


def plus_minus(estimate: Estimate) -> str:
    """A value and its standard error, rounded to the error's second digit; four digits without an error."""
    value, error = estimate.value, estimate.error
    if not math.isfinite(error) or error <= 0:
        return f"{value:.4g}".replace("-", "−")
    digits = max(0, 1 - math.floor(math.log10(error)))
    return f"{value:.{digits}f} ± {error:.{digits}f}".replace("-", "−")


def signed(value: float) -> str:
    """A whole number with its sign."""
    return f"{value:+.0f}".replace("-", "−")
