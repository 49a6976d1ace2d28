"""Settings of the alignment of the clocks."""

from __future__ import annotations

import math
from dataclasses import dataclass

from vision.data import Tunable


@dataclass(frozen=True, kw_only=True, repr=False)
class ClockSettings(Tunable):
    """Tunable constants of the alignment.

    The tests named below use slip trains and recordings with a known clock.  `tests/clock/test_alignment.py`
    checks that no wrong alignment is accepted.
    """

    # Slips of the camera
    step_significance: float = 6.0
    """Standard errors that a common step must exceed to count as a slip. Larger → small slips are missed;
    smaller → noise counts as slips (`test_slips.py`: at 3 it makes one)."""
    step_part_significance: float = 3.0
    """Standard errors that part of a step must exceed to be one. Larger → slips during an exposure are timed
    less well; smaller → noise counts as parts, and at 1.5 errors are two to four times those stated."""
    reach_s: float = 0.025
    """Time before and after a step within which single sheets may follow it. Larger → creep passes for slips;
    smaller → late sheets are overlooked."""
    bad_frame_return: float = 0.6
    """Fraction of a step that a neighbouring movement must reverse for it to be a bad frame. Larger → bad
    frames count as slips (`test_inward_steps_and_bad_single_frames_are_no_slips`)."""

    # Slips of the load cell
    window_of_period: float = 0.3
    """Fraction of the time between slips, before and after each, in which its drop is searched. Larger → the
    next slip is included; smaller → the transient of a slow low-pass is cut off. `test_slips.py`."""
    drop_end: float = 0.01
    """Fraction of the steepest slope below which a drop ends. Larger → the transient is cut off and slips are
    late (by 0.2 ms at 0.02); smaller → noise is taken for a transient."""
    unseen_delay: float = 2.0
    """Error of the slips' times for a filter whose delay the drops do not show, over the standard deviation
    that is left of a drop. Smaller → too small ones (`test_a_filter_of_second_order_is_in_the_error`)."""
    behind_ringing: float = 0.1
    """Error of the slips' times for a low-pass that ringing hides, over the period of the ringing. Smaller →
    too small errors behind such a low-pass (`test_a_low_pass_that_ringing_hides_is_in_the_error`)."""
    swing_back: float = 0.2
    """Rise of the load after a drop, over the steepest fall, from which the load cell swings. Larger → clocks
    are off by a quarter of a swing whose period is not known; smaller → noise after a drop counts as a swing
    (`test_ringing_of_an_unknown_period_is_in_the_error`)."""
    longest_drop: float = 3.0
    """Usual sampling intervals from which the interval of a drop is a gap, which leaves the time of the slip
    open. Larger → gaps displace the clock; smaller → slips are left out where times are uneven."""

    # Candidates
    largest_drift_ppm: float = 4000.0
    """Largest difference of the two clocks' rates that is searched. Larger → slower, and more alignments by
    chance; smaller → poor camera clocks are not found. `test_drift_is_found` needs 3000."""
    drift_prior_ppm: float = 1500.0
    """Standard deviation of the prior on the drift. Larger → few slips set the drift; smaller → true drifts
    are pulled towards 0."""
    candidates: int = 100
    """Number of offsets that are refined. Larger → slower; smaller → the right one may be left out."""
    voting_slips: int = 150
    """Largest number of camera slips that vote for offsets together. Larger → slower, by the square of it;
    smaller → parts in which few slips match have no right candidate (`test_thousands_of_slips…`)."""
    error_scales: tuple[float, ...] = (1.0, 1.4, 2.0)
    """Factors by which the stated errors of slips may be too small. Larger → chance pairs fit; 1 alone →
    slips are lost where errors are understated."""
    least_widening_gain: float = 2.0
    """Log-likelihood that wider errors must gain. Larger → slips whose errors are understated are lost; at 0
    one of ten correct alignments is widened by chance, and may be called ambiguous."""
    share_seen: float = 0.75
    """Assumed probability that one instrument detects a slip of the other. Larger → damaged trains are called
    ambiguous; smaller → the lead over a shift by one slip shrinks."""
    largest_pair_gain: float = 3.2
    """Largest log-likelihood gain of one pair of slips. Larger → the ends of even trains decide; at half of
    it almost no alignment is accepted."""

    # Sizes of the slips
    size_trend_slips: int = 15
    """Window, in slips, of the running median that is subtracted as a trend. Larger → a curved trend counts
    as agreement; smaller → true differences are removed."""
    size_correlations: tuple[float, ...] = (0.3, 0.5, 0.7, 0.9)
    """Possible correlations, equally likely, between the sizes that the two instruments measure."""
    false_size_share: float = 0.2
    """Probability that the sizes of a pair belong to different slips. Larger → sizes weigh less; smaller →
    one bad frame outweighs many good pairs."""
    unrelated_sizes: float = 0.1
    """Prior probability that the two sizes are unrelated, as paper need not move as the force falls. The
    sizes can lower the log-likelihood of an alignment by at most its logarithm."""
    largest_size_gain: float = 1.0
    """Largest log-likelihood gain from the sizes of one pair. Larger → a few similar sizes decide; smaller →
    sizes are of no use."""

    # Ambiguity
    least_slips: int = 4
    """Fewest slips in either recording for which an alignment is tried."""
    least_matched: int = 6
    """Fewest matched slips for which an alignment may be unambiguous."""
    least_likelihood: float = 14.0
    """Log-likelihood, without that of sizes, below which an alignment may be a coincidence. Larger → short
    clips are ambiguous (at 28 a quarter fewer of the hard ones pass)."""
    clear_likelihood: float = 20.0
    """Log-likelihood below which the required leads are doubled. Larger → more clocks are ambiguous."""
    least_margin: float = 6.0
    """Log-likelihood by which the best alignment must exceed the next one. Larger → more clocks are
    ambiguous; smaller → wrong ones pass (`test_a_wrong_alignment_is_never_believed`)."""
    largest_wander: float = 3.0
    """Correlation of neighbouring residuals, in standard errors, above which the clocks differ by more than
    an offset and a rate. Without it 18 of 24 recordings with an unreported lost frame pass, else 4."""
    largest_jump_periods: float = 2.5
    """Largest jump of a clock that is tried, in mean times between slips. Larger jumps leave the slips beyond
    without partners; larger → slower."""
    jumped_slips: int = 1_000_000
    """Number of jumps that are tried, times slips. Larger → slower, more memory; smaller → coarser steps."""
    least_jump_slips: int = 3
    """Fewest slips before or after a jump. Smaller → one false slip and its neighbour make a jump."""
    least_jump_lead: float = 8.0
    """Log-likelihood that a jump must gain. Larger → the loss of a whole slip is overlooked (at 8 in one of
    fifteen random trains); smaller → correct clocks have jumps (at 8 one in a hundred, at 6 one in forty)."""
    usual_drift_ppm: float = 500.0
    """Difference of the clocks' rates that two standard errors must exceed for a warning about the frame
    rate. Larger → a rate wrong by a thousandth passes; smaller → poor but correct clocks are warned of."""
    unmatched_share: float = 0.2
    """Share of the slips of film or force without a partner above which a warning is given. Larger →
    contradicting recordings pass; smaller → a warning for each missed slip."""
    contradiction_sigma: float = 3.0
    """Difference, in standard errors, between a given clock and that of the slips that is warned of."""

    @property
    def log_p_missed(self) -> float:
        """Log of the probability that one instrument does not detect a slip of the other."""
        return math.log(1 - self.share_seen)
