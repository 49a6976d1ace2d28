"""What can be tuned in reading a force recording and finding its stick-slip events."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any


@dataclass(frozen=True, kw_only=True)
class ForceSettings:
    """Tunable numbers of `read_force` and `find_stick_slip`; the defaults suit recordings of 10 to 10 000 Hz.

    Sigmas count the standard deviation of the load's white noise unless stated otherwise.
    """

    gap_intervals: float = 5.0
    """A step in time of more sampling intervals than this is a gap. Larger overlooks short interruptions,
    smaller flags the jitter of a clock; shown by recordings of which a part was cut out."""

    saturated_run: int = 5
    """Equal samples in a row at the largest load that mean saturation. Smaller flags the rounded peaks of a
    coarse load cell, larger misses short saturations."""

    spike_sigmas: float = 6.0
    """A sample this far from the median of the five around it is a spike. Smaller takes noise for spikes,
    larger lets spikes make slips; shown by sawteeth with 1 % of spikes added."""

    step_width: float = 0.15
    """Half the width of the step filter, in periods. Wider averages more noise away, narrower follows
    irregular slips; shown by recall at drops of six sigmas."""

    candidate_sigmas: float = 5.5
    """Prominence, in standard deviations of the step filter's output, that makes a drop a candidate. Smaller
    costs time and admits noise, larger misses small slips."""

    split_sigmas: float = 5.0
    """By how much two lines must fit better than one for a slip to be between them. Smaller splits sticks in
    noise, larger joins sticks over small slips; shown by ramps of noise, which must give no event."""

    threshold_sigmas: float = 4.0
    """Smallest drop between stick lines that is a slip, where no threshold is given. Lower finds smaller
    slips and more false ones; shown by at most 1 % false events at drops of six sigmas."""

    threshold_gap: float = 3.0
    """A gap of this ratio in the sizes of the drops separates noise from slips and moves the threshold there.
    Smaller may cut off true small slips, larger leaves clusters of false ones."""

    line_part: float = 0.8
    """Central part of a stick through which its line is fitted; drops, F_v and F_p are extrapolated
    from it. Larger comes closer to the rounded ends, smaller extrapolates further."""

    fast_mm_min: float = 5.0
    """Pulling speed from which sticks may have two slopes. Fast pulls show a steeper start; fitting a knee to
    slow ones only adds noise."""

    knee_gain: float = 1.5
    """How many times smaller the squared residuals with a knee must be for a stick to have two slopes.
    Smaller sees knees in noise, larger misjudges the corners of bent sticks."""

    corner_error: float = 0.3
    """Samples by which a corner may be off because it lies between two; shown by how often the stated error
    of Λ_st covers the truth."""

    shape_error: float = 0.04
    """Part of a slip's length by which its corners may be off, its shape being assumed; shown like
    `corner_error`."""

    lowpass_accepted: float = 5.0
    """Gain in squares, over chance, that a low-pass must reach when corners are corrected for it. Lower finds
    low-passes in noise, higher leaves the drops of fast pulls too small; shown by sawteeth with and without
    one."""

    central_part: float = 0.5
    """Central part of the stick over which K is measured. Larger lowers the error of K and takes in the
    curvature of the ends; the columns K30 and K70 show how much it matters."""

    few_samples: int = 10
    """Sticks of fewer samples are flagged "few", and the model fits leave them out."""

    def changed(self) -> dict[str, Any]:
        """What differs from the defaults, for the record of operations."""
        return {
            part.name: value for part in fields(self) if (value := getattr(self, part.name)) != part.default
        }


DEFAULTS = ForceSettings()
