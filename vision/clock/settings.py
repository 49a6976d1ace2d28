"""Settings of the alignment of the clocks."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class ClockSettings:
    """Everything in the alignment that can be tuned.

    The tests named below make trains and recordings with a known clock: `tests/clock/test_alignment.py` is
    where wrong alignments must never pass.
    """

    # Slips of the camera
    step_significance: float = 6.0
    """Standard errors by which a common step must stand out. Larger → small slips are missed; smaller → noise
    counts as slips. `test_slips.py`: all slips are found at 3 to 20, noise alone makes one at 3."""
    step_part_significance: float = 3.0
    """The same for a frame that shows part of a step. Larger → slips during an exposure are placed less well;
    smaller → noise is taken for parts, and errors are two to four times those stated at 1.5."""
    bad_frame_return: float = 0.6
    """A step that falls back by this much of itself at once was a bad frame. Larger → bad frames count as
    slips (nothing else is found at 1.2 in `test_inward_steps_and_bad_single_frames_are_no_slips`)."""
    least_sheets: float = 0.2
    """Share of the sheets below which a frame is left out. Larger → slips in poor frames are placed less
    well."""

    # Slips of the load cell
    window_of_period: float = 0.3
    """Part of the time between slips that is searched for the whole of a drop, each way. Larger → the next
    slip comes into view; smaller → the transient of a slow low-pass is cut off. `test_slips.py`."""
    drop_end: float = 0.01
    """Of the steepest drop: a drop ends where its slope is less. Larger → the transient is cut off and slips
    are late by 0.2 ms at 0.02; smaller → noise is taken for a transient."""

    # Candidates
    largest_drift_ppm: float = 4000.0
    """Difference of the two clocks' rates that is searched. Larger → more chance alignments and time; smaller
    → poor camera clocks are not found. `test_drift_is_found` needs 3000."""
    drift_prior_ppm: float = 1500.0
    """Standard deviation of the prior on the drift. Larger → few slips bend the clock; smaller → true drifts
    are pulled towards 0. A factor of 2 either way changes one of a hundred hard alignments."""
    candidates: int = 100
    """Offsets that are refined. Larger → slower; smaller → the right one may be left out."""
    error_scales: tuple[float, ...] = (1.0, 1.4, 2.0)
    """By which stated errors of slips may be too small. Larger → chance pairs fit; 1 alone → slips are lost
    where errors are understated."""
    least_widening_gain: float = 2.0
    """Log-likelihood that wider errors must gain. Larger → slips whose errors are understated are lost; at 0
    one of ten sound alignments counts as widened by chance, and may be called ambiguous."""
    share_seen: float = 0.75
    """Share of the other instrument's slips that either one is taken to see. Larger → missed slips cost more
    and damaged trains are called ambiguous; smaller → the lead over a shift by one slip shrinks."""
    largest_pair_gain: float = 3.2
    """Log-likelihood that one pair of slips can gain. Larger → the ends of even trains decide; at half of it
    almost nothing is believed. `test_a_wrong_alignment_is_never_believed`."""

    # Sizes of the slips
    size_trend_slips: int = 15
    """Slips whose running median is the trend that is no evidence. Larger → a bending trend passes for
    agreement; smaller → true differences go. `test_a_common_trend_is_no_evidence`."""
    size_correlations: tuple[float, ...] = (0.3, 0.5, 0.7, 0.9)
    """Correlations, equally likely, between the sizes that the two instruments measure."""
    false_size_share: float = 0.2
    """Share of pairs whose sizes may be those of other slips. Larger → sizes weigh less; smaller → one bad
    frame outweighs many good pairs. `test_no_pair_and_no_set_of_pairs_decides_alone`."""
    unrelated_sizes: float = 0.1
    """Prior probability that the sizes tell nothing, as paper need not move as the force falls. Limits what
    sizes can take from an alignment, to log 0.1."""
    largest_size_gain: float = 1.0
    """Log-likelihood that the sizes of one pair can gain. Larger → a few like sizes decide; smaller → sizes
    are of no use in `test_sizes_decide_where_times_hardly_do`."""

    # Ambiguity
    least_slips: int = 4
    """Slips of either recording below which no alignment is tried."""
    least_matched: int = 6
    """Slips in common below which any alignment is ambiguous."""
    least_likelihood: float = 14.0
    """Log-likelihood, without that of sizes, below which an alignment may be a coincidence. Larger → short
    clips are ambiguous (a quarter fewer of hard alignments pass at 28); smaller → hardly any more pass, as
    the other tests object."""
    clear_likelihood: float = 20.0
    """Log-likelihood from which on the lead that is demanded below is not doubled. Larger → more clocks are
    ambiguous (a tenth fewer pass at 20 than at 14 in hard alignments)."""
    least_margin: float = 6.0
    """Log-likelihood by which the best alignment must exceed the next one. Larger → more clocks are
    ambiguous; smaller → wrong ones pass. `test_a_wrong_alignment_is_never_believed`."""
    missed_slips_sigma: float = 3.0
    """Standard deviations of what slips missed at random give to a shift by whole slips, which the lead over
    shifts must exceed. At 0 one of 700 hard alignments is wrong and accepted; at 6 damaged trains are
    ambiguous."""
    permutations: int = 16
    """Random orders of the camera's intervals that are aligned too. More → slower, and stricter.
    `test_shuffled_slips_reach_what_unrelated_ones_do`."""
    permutation_lead: float = 4.0
    """Log-likelihood by which the best alignment must exceed those of all permutations. Larger → a few clocks
    more are ambiguous."""
    largest_wander: float = 3.0
    """Standard errors of the correlation of neighbouring residuals from which on the clocks do not differ by
    an offset and a rate alone. Without it, 18 of 24 recordings that lost a frame unnoticed were accepted, in
    place of 4; `test_unreported_lost_frames_are_not_believed_blindly`."""
    usual_drift_ppm: float = 500.0
    """Difference of the clocks' rates from which on, by two standard errors, a warning doubts the frame rate.
    Larger → a rate that is wrong by a thousandth passes; smaller → poor but honest clocks get a warning.
    `test_a_wrong_frame_rate_is_said`."""
    contradiction_sigma: float = 3.0
    """Standard errors between a given clock and that of the slips from which on a warning is given."""

    @property
    def log_p_seen(self) -> float:
        """Log of the probability that one instrument sees a slip of the other."""
        return math.log(self.share_seen)

    @property
    def log_p_missed(self) -> float:
        """Log of the probability that it does not."""
        return math.log(1 - self.share_seen)
