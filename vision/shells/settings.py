"""Settings of the classification into stiff and mobile sheets."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class ShellSettings:
    """Everything in the statistics of shells that can be tuned; measured on the scenes of
    `tests/shells/test_sizes.py`."""

    sheet_scatters: tuple[float, ...] = (0.03, 0.08, 0.15, 0.25)
    """Relative scatter of the sheets about a smooth profile, of which the likeliest is taken. One value of
    0.08 in its place widens the intervals by 7 %, 0.25 by 18 %."""
    profile_error: float = 0.2
    """By how much of their distance from the threshold real profiles differ from those tried. Smaller →
    intervals too narrow for shapes not tried (72 % hold the truth at 0); larger → they widen."""
    profile_error_growth: float = 0.5
    """By how much more they differ, per threshold of distance. 0 lets sheets far from the threshold decide,
    and costs 1 % of the intervals."""
    outlier_sigma: float = 4.0
    """Standard deviations from all profiles beyond which a sheet is counted by its own measurement. Smaller →
    single sheets count where noise is large; larger → one odd sheet moves the shell
    (`test_single_sheets_do_not_decide`)."""
    misread_share: float = 0.2
    """Share of such sheets that are taken to be misread. 0 makes intervals too narrow where sheets are
    misread: 80 % hold the truth in place of 97 %."""
    draws: int = 256
    """Random profiles per event. More → smoother intervals, slower."""
    significance: float = 1e-3
    """Probability of chance below which a fall of the ratio with n, or a rise, is accepted."""
