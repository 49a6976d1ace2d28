"""What can be tuned in reading a force recording and finding its stick-slip events."""

from __future__ import annotations

from dataclasses import dataclass

from vision.data import Tunable


@dataclass(frozen=True, kw_only=True, repr=False)
class ForceSettings(Tunable):
    """Tunable numbers of `read_force` and `find_stick_slip`; the defaults suit recordings of 10 to 10 000 Hz.

    A sigma is the standard deviation of the load's white noise unless stated otherwise.
    """

    # samples that are left out
    gap_intervals: float = 5.0
    """A step of more sampling intervals than this, in time or in the crosshead's way, is a gap; as many lost
    samples in a row flag the stick. Larger overlooks interruptions, smaller flags the jitter of clocks."""
    saturated_run: int = 5
    """Equal samples in a row at the largest load that mean saturation. Smaller flags the rounded peaks of a
    coarse load cell, larger misses short saturations."""

    # white noise and spikes
    noise_ratio: float = 4.0
    """Ratio of the noise in parts of a recording from which each part has its own. Smaller follows the
    scatter of the estimates, larger overlooks a change of range."""
    spike_sigmas: float = 6.0
    """A sample this far from the median of the five around it is a spike. Smaller takes noise for spikes,
    larger lets spikes make slips (sawteeth with 1 % of spikes)."""
    most_spikes: float = 0.05
    """Share of spikes from which a recording is refused as sampled too slowly. Smaller refuses real impulses
    (1 %), larger takes beats of the sampling for slips."""
    smooth_growth: float = 1.5
    """Growth of the noise, if every second sample is left out, from which a filter has smoothed it. Smaller
    takes random walks (1.41) for smooth, larger the noise of a moving mean (1.51 or more) for slips."""
    smooth_fewest: int = 1000
    """Samples that are left of a recording of smoothed noise, at least. Fewer do not tell its noise, more
    leave the noise of slow filters smooth."""
    hum_ratio: float = 10.0
    """Power of a line of the load's spectrum over that of the frequencies around it from which it may be hum.
    Smaller takes chance for hum (it reaches 3 in 15 spectra), larger leaves hum that hides or cuts sticks."""
    hum_in_phase: float = 0.7
    """Mean resultant length of a line's phases at ten slips in a row from which it belongs to the slips: 0.28
    by chance, near 1 for harmonics of regular slips. Smaller leaves hum in the search for slips, larger takes
    harmonics of irregular slips for hum (test_events)."""

    # slips
    step_width: float = 0.15
    """Half the width of the step filter, in periods. Wider averages more noise, narrower follows irregular
    slips (recall at drops of six sigmas)."""
    missed_share: float = 0.05
    """Excess of downward over upward steps within the sticks, over the slips found, from which a warning says
    that slips were missed. Smaller warns of a few, larger of many only (small slips near the noise)."""
    close_share: float = 0.05
    """Smallest drop, over those beside it, of a slip that is closer to them than the step filter tells apart;
    over the usual one, of a drop whose omission is a warning. Smaller takes the tail of a low-pass for slips,
    larger misses small slips among large ones."""
    candidate_sigmas: float = 5.5
    """Prominence, in standard deviations of the step filter's output, that makes a drop a candidate. Smaller
    costs time and admits noise, larger misses small slips."""
    split_sigmas: float = 5.0
    """By how much two lines must fit better than one for a slip to be between them. Smaller splits sticks in
    noise, larger joins sticks over small slips (ramps of noise must give no event)."""
    line_reach: float = 2.0
    """Usual spacings of drops from a drop within which lines are fitted beside it. Smaller averages less
    noise in long sticks, larger takes noise in a rest of the machine for drops (rests of 2 to 100 s)."""
    threshold_sigmas: float = 4.0
    """Smallest drop between stick lines that is a slip, where no threshold is given. Lower finds smaller
    slips and more false ones (at most 1 % at drops of six sigmas)."""
    threshold_gap: float = 3.0
    """A gap of this ratio in the sizes of the drops separates noise from slips and moves the threshold there.
    Smaller may cut off true small slips, larger leaves clusters of false ones."""
    jump_cost: float = 3.0
    """Number of drops that one upward jump of the same size offsets when the threshold is chosen. Smaller
    retains more small slips and more false ones (pink noise, knocks)."""
    slow_gap: float = 2.0
    """Ratio, as for `threshold_gap`, where most drops below the gap last nearly as long as the rises beside
    them: smoothed noise. Smaller cuts off small slow slips, larger takes noise for slips."""

    # lines through the sticks
    uneven_parts: int = 8
    """Parts of a stick whose means are compared with its line. Fewer overlook a small slip within a stick,
    more compare parts of too few samples."""
    uneven_excess: float = 1.7
    """Ratio of that deviation to the noise from which it enters the errors. Smaller enlarges the errors of
    sticks with white noise (1 % exceed this), larger leaves out small slips."""
    line_part: float = 0.8
    """Central part of a stick through which its line is fitted and extrapolated. Larger comes closer to the
    rounded ends, smaller extrapolates further."""
    shape_sigmas: float = 4.0
    """Standard errors by which the curvature common to all sticks must differ from 0 to extend their lines.
    Smaller bends straight sticks, larger reads the ends of curved sticks from straight lines."""
    shape_slip: float = 0.1
    """Largest median length of slips, over that of sticks, with which this curvature is used. Longer slips
    would count as the ends of the sticks."""
    knee_ratio: float = 1.2
    """Slope before over slope after the knee, at the median of the sticks, from which a recording's sticks
    have two slopes. Sticks that soften by 10 % reach 1.1, the publication's fast pulls 1.8."""
    knee_gain: float = 1.5
    """How many times smaller the squared residuals with a knee must be for a stick to have two slopes.
    Smaller sees knees in noise, larger misjudges the corners of bent sticks."""

    # corners of the slips
    shape_error: float = 0.045
    """Part of a slip's length by which its corners may be off because its shape is assumed (test_corners)."""

    # the load cell's low-pass
    lowpass_accepted: float = 5.0
    """Decrease of the squared residuals, over chance, that a low-pass must reach when corners are corrected
    for it. Lower finds low-passes in noise, higher leaves the drops of fast pulls too small."""
    lowpass_same: float = 0.2
    """Relative difference within which the time constants after large and small slips, and after long and
    short sticks, must agree to prove a low-pass. Larger finds one in paper on paper, which has none."""
    lowpass_tail: float = 0.2
    """Share by which slips may be shorter before their middle than after it when corrected for a low-pass:
    below 0.1 behind one, 0.26 to 0.6 for Butterworth filters and damped load cells (test_slips). Larger
    corrects for a low-pass that the load did not pass, smaller doubts true ones."""

    # what was recorded at the ends of the sticks
    slow_slip: float = 0.2
    """Length of a slip over that of a neighbouring stick from which it is slow: measured at the recorded
    extremes and flagged. Extrapolated stick lines read half cosines 0.4 % too large at 0.33 and 20 % at 1."""
    level_share: float = 0.06
    """Share by which slips may be shorter before their middle than after it without a filter: below 0.03 in
    paper on paper, 0.2 or more behind low-passes. Smaller widens the errors of slips that are resolved,
    larger trusts what a filter cut."""
    tails_share: float = 0.04
    """Share by which the tails of slips (`Corners.tails`) may differ from those of half a cosine, in the half
    that differs less: up to 0.03 for moving blocks, 0.05 or more for moving means. Smaller widens the errors
    of slips that are resolved, larger trusts what a filter made."""
    smooth_noise: float = 0.3
    """Correlation of the noise over a twentieth of a slow slip above which a filter may have made the slip:
    moving means 0.34 or more, paper on paper up to 0.12. Smaller doubts slow slips whose noise is pink,
    larger trusts smoothed ones (test_events)."""
    white_noise: float = 0.05
    """The same for slips that are not slow: white noise up to 0.03, means and filters 0.4 or more. Larger
    trusts slips that a filter made, smaller enlarges errors of clean recordings tenfold (test_events)."""
    rounding_share: float = 0.7
    """Share of the noise's variance that may be rounding for the rest to show whether a filter made slips.
    Smaller doubts slips of coarse recordings that are resolved, larger trusts what a filter made and rounding
    made white (test_events)."""
    filter_share: float = 0.3
    """Length of slips over that of sticks from which a filter that may have lengthened them leaves too little
    of the sticks for K, off by 4 % at 0.35 and by 10 % at 0.5. Smaller doubts recordings that are resolved,
    larger is silent about a wrong N̂ (test_events)."""
    extreme_sigmas: float = 4.0
    """Noise by which the extreme of many samples may differ from the load. Larger leaves F_v of steep sticks
    too high (test_sheet_film), smaller takes single samples of noise for valleys (test_events)."""
    ringing_share: float = 0.2
    """Second swing of the load cell after a slip, over its first, from which it rings and the stick line, not
    the recorded valley, is F_v. Larger takes F_v from the swing of a damped load cell, smaller from the line
    where sticks begin steeply."""
    ringing_alike: float = 0.35
    """Autocorrelation of the load's steps, at a period and below its negative at half of it, from which the
    load rings: 0.4 for ringing that decays within one period, 0.26 for slips, noise and low-passes. Smaller
    proposes to average what does not ring, larger overlooks ringing."""
    ringing_rebound: float = 0.05
    """Height of the load's first swing above the stick's line, over the fall before it, from which it rings:
    0.06 at 0.4 of the critical damping. Larger takes the swings of such a load cell for slips, smaller
    averages what filters overshoot (test_signal)."""
    ringing_steps: float = 0.97
    """Quantile of the load's steps to which larger ones, the slips, are cut before their autocorrelation;
    where that shows no ringing, three times as many are. Larger lets slips hide faint ringing, smaller cuts
    ringing that decays fast (test_signal)."""
    ringing_fewest: int = 40
    """Periods of ringing in a recording, at least. Smaller takes sticks for periods, larger overlooks it."""
    ringing_between: float = 5.0
    """Periods of ringing from slip to slip, at least, in the median. Smaller averages sticks of which too
    little is left, larger leaves the ringing in short ones (test_signal)."""
    between_samples: float = 0.03
    """Share of the drop by which a stick's line may begin below the lowest sample, since a fast slip may end
    between two samples. Smaller reads drops at 200 Hz 2 % too small, larger believes the line where the load
    cell was too slow to follow."""

    # what is not stick-slip, or not resolved
    short_stick: float = 3.0
    """Shortest stick, in time constants of the low-pass. A shorter one mainly shows the instrument."""
    upward_share: float = 0.4
    """Upward jump within a stick over the median drop from which the drops beside it may be no slips; where
    the median jump reaches it the recording shows noise. Smaller flags slips in a few steps of a coarse load
    cell (0.31), larger passes noise (0.43 to 13)."""
    periodic_share: float = 0.5
    """Share of what the displacement deviates from a straight line that one line of its spectrum holds, and
    of which K shows the inverse, from which it has a periodic error. Smaller names uneven machines, larger
    misses errors beside others (test_regime)."""
    periodic_change: float = 0.01
    """Change of K by that error from which a warning is given. Smaller warns of what no fit shows."""
    equal_share: float = 0.5
    """Duration of falls over that of rises (or its inverse) from which the two count as equally long. Slow
    slips of true stick-slip stay below it or have straight sticks; a sinusoid has 1."""

    # stiffness
    central_part: float = 0.5
    """Central part of the stick over which K is measured. Larger lowers the error of K but includes the
    curvature of the ends, as the columns K30 and K70 show."""

    # noise that is not white
    alike_sigmas: float = 6.0
    """Excess variance of the means of quarters of the sticks, in units of 1 over the root of their number,
    beyond which noise counts as slow; of their curvatures, beyond which each stick bends by its own amount.
    Smaller widens errors by chance, larger leaves them too small."""
    contrasts: int = 4
    """Independent values per stick that a time scale counts for at most in the fit of slow noise. More give
    the shortest scales, where hum and digits disturb, more weight; fewer tell its kinds apart less well."""

    # flags of sticks
    falling_share: float = 0.1
    """Fall of the load within a stick, over its rise, from which it is flagged "falling". Smaller flags small
    slips and noise, larger takes K and Λ_st across slips that were not found (test_events)."""
    least_fall: float = 0.2
    """Fall of the load within a slip's length, over the drop between the lines beside it, below which it is
    none: 0 in the middle of a rise, 0.5 or more at slips. Larger flags slow slips in noise, smaller calls
    sticks ok that an impulse has divided (test_events)."""
    least_speed: float = 0.8
    """Speed of the crosshead in a stick, over the usual one of the sticks around, below which it paused.
    Larger flags sticks of an unsteady pull, smaller measures sticks that contain a rest of the machine."""
    rest_mm: float = 0.02
    """How far d, where it is calculated from the speed, may be off by a rest of the machine before a warning
    says so. Smaller warns of small slips in a stick, larger passes short rests."""
    speed_change: float = 1.5
    """Ratio of the load's rises in time from which a warning says that the machine changed its speed, where d
    is calculated from one. Smaller warns of sticks that soften, larger passes small changes."""
    few_samples: int = 10
    """Sticks of fewer samples are flagged "few", and the model fits leave them out."""
