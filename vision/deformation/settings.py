"""Tunable constants of the deformation."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class DeformationSettings:
    """What `horizontal_deformation` may be tuned by; the tests named are in tests/deformation."""

    least_cover: float = 0.4
    """Share of a stick that its positions must span.  Larger drops sheets that are hidden for part of a
    stick; smaller extrapolates (test_motion: a stick seen only at its start)."""

    cubic_frames: int = 12
    """Frames a stick from which noise is measured about a cubic, else about a parabola.  Larger takes creep
    that slows down for noise; smaller spends degrees of freedom that short sticks lack (fast preset)."""

    curvature_errors: float = 3.0
    """Standard errors by which a parabola must differ from a line to be used.  Larger biases sticks that
    soften (test_motion: creep that slows down); smaller adds the noise of a coefficient to every sheet."""

    least_curved: int = 6
    """Positions from which a parabola is tried; with fewer, single blurred frames bend the curve."""

    outward_errors: float = 3.0
    """Standard errors beyond which movement outwards is reported as such, not as 0 (test_motion: outward)."""

    scale_error: float = 0.002
    """Relative error of the magnification over the view (bowed sheets, lens).  Larger widens the errors of
    the sheets that move most; judged by the coverage of the paper preset (test_simulated)."""

    fixed_pattern: float = 0.5
    """Error of position that repeats with the place on the sensor, over the noise of one frame, before it is
    measured: pixels that differ by 0.7 % under 5000 electrons.  Larger widens the errors of long sticks
    (test_simulated: unequal pixels)."""

    slip_delay_s: float = 0.025
    """Time next to each slip in which single sheets may slip late or early.  Larger leaves fewer frames from
    which the creep is extrapolated to it; smaller misses delays (test_simulated: sheets that slip late)."""

    late_errors: float = 5.0
    """Standard errors by which a position must differ from the rest of the stick to count as before or after
    the sheet's slip.  Smaller cuts frames of noisy sheets; larger keeps frames of late ones."""

    late_common: float = 0.2
    """Share of the sheets that may slip late; what more of them do together is an error of the clock."""

    correlation_positions: int = 10_000
    """Positions, about, from which the noise's autocorrelation is estimated.  More take longer; with fewer
    its error grows, by which the stated errors are off (test_creep)."""

    predicted_dof: float = 5.0
    """Weight of the predicted noise of a sheet against its residuals, as degrees of freedom.  It steadies
    sheets seen in few frames; larger hides sheets noisier than predicted (test_creep: a noisy sheet)."""

    uneven_probability: float = 1e-6
    """Chance below which residuals are too large for the sheet's noise.  Larger flags quiet sticks "uneven";
    smaller lets jumps within a stick pass for noise (test_creep: a sheet that slips by itself)."""

    least_sheets: int = 5
    """Sheets from which common-mode motion is separated from their own noise, and drift with one side in
    view. Fewer put too much of their noise into it (test_common_mode)."""

    least_pairs: int = 3
    """Pairs left and right from which drift is separated from creep (test_common_mode)."""

    neighbouring_sticks: int = 8
    """Sticks before and after that tell how much each sheet creeps, with one side in view.  More average
    over a changing profile; fewer leave more noise (test_common_mode: one side in view)."""

    jump_spreads: float = 6.0
    """Median sizes of what all sheets do together, in a stick or from one to the next, beyond which the
    camera was pushed, with one side in view.  Larger takes pushes for drift of the sticks beside them;
    smaller leaves out sticks in which it drifts fast (test_common_mode: a camera that is pushed)."""

    one_side_contrast: float = 25.0
    """Variance of the creep over the sheets, in units of its noise, from which one side tells drift from
    creep. Smaller invents drift where sheets creep alike (test_common_mode: one side that creeps alike)."""
