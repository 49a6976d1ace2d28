"""Tunable constants of the deformation."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class DeformationSettings:
    """Tunable constants of `horizontal_deformation`; the tests named are in tests/deformation."""

    slip_near_end: float = 0.15
    """Fraction of a stick, from either end, in which an unmatched slip of the film may be the one that ends
    or begins it, unless that one is matched; frames beyond it are left out.  Larger measures sticks in which
    the sheets slip; smaller leaves out all sticks if the given clock is slightly wrong (test_motion)."""

    least_cover: float = 0.4
    """Fraction of a stick that its positions must span.  Larger drops sheets that are hidden for part of a
    stick; smaller extrapolates (test_motion: a stick seen only at its start)."""

    cubic_frames: int = 12
    """Fewest frames per stick for which noise is measured about a cubic instead of a parabola.  Larger
    mistakes decelerating creep for noise; smaller uses up the degrees of freedom of short sticks (fast
    preset)."""

    curvature_errors: float = 3.0
    """Standard errors by which a parabola must differ from a line to be used.  Larger biases sticks with
    decelerating creep (test_motion); smaller adds the noise of a coefficient to every sheet."""

    least_curved: int = 6
    """Fewest positions to which a parabola is fitted; with fewer, single blurred frames bend the curve."""

    outward_errors: float = 3.0
    """Standard errors beyond which outward movement is reported as such, not as 0 (test_motion: outward)."""

    own_errors: float = 2.0
    """Standard errors beyond which movement that a sheet repeats, and that slips do not return or other
    sheets do not show, enters its error.  Larger hides paper that settles (test_common_mode); smaller
    widens the errors of quiet sheets by chance."""

    scale_error: float = 0.002
    """Relative error of the magnification over the view (bowed sheets, lens).  Larger widens the errors of
    the sheets that move most; tested by the coverage of the paper preset (test_simulated)."""

    fixed_pattern: float = 0.5
    """Position error that repeats with the position on the sensor, in units of the noise of one
    frame: pixels that differ by 0.7 % at 5000 electrons.  Larger widens the errors of long sticks
    (test_simulated: unequal pixels)."""

    locking: float = 0.15
    """Relative error of displacements by the publication's fit, which shifts positions towards whole pixels.
    Larger widens the errors of ridges wider than the window, smaller is too small for others
    (test_simulated)."""

    slip_delay_s: float = 0.025
    """Time next to each slip in which individual sheets may slip late or early, which may count as another
    slip of the film.  Larger leaves fewer frames from which the creep is extrapolated; smaller misses delays
    (test_simulated: sheets that slip late)."""

    late_errors: float = 5.0
    """Standard errors by which a position must differ from the rest of the stick to count as before or after
    the sheet's slip.  Smaller removes frames of noisy sheets; larger leaves in frames of late ones."""

    late_common: float = 0.2
    """Fraction of sheets that slip in time, below which the delay is common to all: an error of the clock
    (test_simulated: a clock wrong by a frame)."""

    correlation_positions: int = 10_000
    """Approximate number of positions from which the autocorrelation of the noise is estimated.  More take
    longer; fewer make the stated errors less accurate (test_creep)."""

    common_dof: float = 5.0
    """Weight of the noise of all sheets against the residuals of one, as degrees of freedom.  It stabilises
    sheets seen in few frames; larger hides sheets noisier than the others (test_creep: a noisy sheet)."""

    held_noise: float = 0.5
    """Noise of a sheet, over the stated error of its positions, below which a codec that predicts frames from
    others holds it still.  Larger warns of every compressed film, smaller does not count sheets that the
    codec moves only now and then (test_sheets_that_a_codec_holds_still_have_its_error)."""

    warned_sheets: float = 0.2
    """Share of sheets that such a codec holds still, or whose movement is no creep, from which a warning is
    given.  Larger is silent about a stiff shell of which nothing is measured, smaller warns of one sheet by
    chance."""

    uneven_probability: float = 1e-6
    """Probability below which residuals are too large for the sheet's noise.  Larger flags normal sticks
    "uneven"; smaller accepts jumps within a stick as noise (test_creep: a sheet that slips by itself)."""

    least_sheets: int = 5
    """Fewest sheets from which common-mode motion, or drift with one side in view, is measured.  Fewer add
    too much of their own noise (test_common_mode)."""

    least_pairs: int = 3
    """Fewest pairs left and right from which drift is separated from creep (test_common_mode: six sheets)."""

    least_repeats: int = 5
    """Fewest sticks from which the scatter of the pull, or of what a sheet does in each of them, is measured.
    Fewer are alike by chance; more leave short films without (test_common_mode: paper that settles)."""

    neighbouring_sticks: int = 8
    """Number of sticks before and after from which the creep of each sheet is predicted, with one side in
    view.  More average over a changing profile; fewer leave more noise (test_common_mode)."""

    jump_spreads: float = 6.0
    """Median sizes of common movement beyond which the camera was pushed.  Larger counts pushes as drift;
    smaller leaves out sticks with fast drift (test_common_mode: a camera that moves at every slip)."""

    one_side_contrast: float = 25.0
    """Variance of the creep over the sheets, in units of its noise, above which drift is measured with one
    side in view.  Smaller finds false drift where all sheets creep alike (test_common_mode)."""
