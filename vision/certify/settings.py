"""Tunable constants of the certificate."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class CertifySettings:
    """What `certify` may be tuned by; tests/certify and reports/certify.md show the effect."""

    most_frames: int = 600
    """Frames of the recording that are imitated, from its middle.  More take longer; fewer leave the error of
    a sheet uncertain by 1/√(2 frames)."""

    films: int = 3
    """Films made, each with the residuals in another order.  More take longer and average over
    more encounters of noise and motion."""

    grid_per_px: int = 4
    """Points a pixel of the mean picture.  Ridges narrower than 3 px need more."""

    rigid_share: float = 0.3
    """Part of the spacing on either side of a ridge that moves with it, undeformed; the rest of the gap
    stretches.  Larger leaves less to stretch; smaller deforms the flanks on which positions rest."""

    longest_piece: int = 40
    """Frames over which the motion is a cubic.  Longer takes motion for noise; shorter noise for motion
    (made up for by the degrees of freedom, which fails where they are few)."""

    misfit: float = 1.6
    """Scatter of a sheet about its smooth motion, over that from frame to frame, from which its piece is
    halved.  Smaller takes slow noise for motion; larger takes motion of its own (ringing, slips of single
    sheets) for noise."""

    least_piece: int = 8
    """Frames between two slips from which a polynomial is fitted; shorter pieces are left as measured."""

    step_errors: float = 6.0
    """How far the movement of the sheets from frame to frame must stand out from its usual size to be taken
    for a slip, in median absolute deviations.  Smaller cuts up quiet pieces; larger smooths small slips."""

    least_ok: float = 0.9
    """Share of the sheets that a frame must show for its residual to be used, or the share that half of the
    frames show where that is less.  Smaller lets what covers the picture into every film; larger leaves no
    frame where a sheet is often hidden."""

    slow_frames: int = 9
    """Frames over which the residual is averaged to find its slow part.  Fewer keep more of the noise where
    it was, next to the same motion; more leave the grain of paper that is pulled along in what is moved."""

    pulled_errors: float = 2.5
    """Times its sheet's usual stated error from which a position is taken for pulled aside (dirt, a
    highlight, a hand): the sheets around say where the sheet truly was.  Smaller replaces motion by that of
    neighbours; larger takes what pulls ridges for motion."""

    gain_step: float = 0.03
    """Relative step of the brightness over which no residual is exchanged.  Smaller leaves few frames to
    exchange with where light flickers; larger moves what is clipped into frames where nothing was."""

    own_time_error: float = 0.2
    """Error, in frames, up to which the time that a step took is read from the step.  Larger rounds noise to
    dropped frames; smaller lets frames that were dropped count as noise."""

    largest_jump: float = 4.0
    """Largest multiple of the recording's own motion with which identities are tried."""

    errors_resolved: float = 3.0
    """Errors of a sweep by which it must differ from none."""


DEFAULT = CertifySettings()
