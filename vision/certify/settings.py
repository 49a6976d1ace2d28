"""Tunable constants of the certificate."""

from __future__ import annotations

from dataclasses import dataclass

from vision.data import Tunable


@dataclass(frozen=True, kw_only=True, repr=False)
class CertifySettings(Tunable):
    """Tunable constants of `certify`; tests/certify and reports/certify.md show their effect."""

    most_frames: int = 600
    """Number of frames of the recording that are imitated, from its middle.  More take longer; with fewer the
    error of a sheet is uncertain by 1/√(2 frames)."""

    films: int = 3
    """Number of films, each with the residuals in another order.  More take longer and average over more
    combinations of noise and motion."""

    least_frames: int = 30
    """Smallest number of frames that show the sheets.  Fewer leave the noise in the mean picture: of 30 it
    holds a thirtieth of the variance."""

    grid_per_px: int = 4
    """Points per pixel of the mean picture.  Ridges narrower than 3 px need more."""

    rigid_share: float = 0.3
    """Part of the spacing on either side of a ridge that moves with it undeformed, while the rest of the gap
    stretches.  Larger leaves less to stretch; smaller deforms the flanks that determine positions."""

    longest_piece: int = 40
    """Number of frames over which the motion is a parabola.  Longer pieces treat motion as noise; shorter
    ones treat noise as motion (corrected for by the degrees of freedom, unless they are few)."""

    misfit: float = 1.6
    """Scatter of a sheet about its smooth motion, over that from frame to frame, from which its piece is
    halved.  Smaller treats slow noise as motion; larger treats individual motion (ringing, slips of single
    sheets) as noise."""

    least_piece: int = 8
    """Smallest number of frames between two slips to which a polynomial is fitted; shorter pieces are left as
    measured."""

    least_sharing: int = 5
    """Smallest number of sheets whose common motion is separated from that of each.  With fewer, their median
    is hardly more than the noise of single sheets."""

    step_errors: float = 6.0
    """Excess of the sheets' steps from frame to frame over the usual size that makes a slip, in median
    absolute deviations.  Smaller divides quiet pieces; larger smooths small slips."""

    least_ok: float = 0.9
    """Share of the sheets that a frame must show for its residual to be used, or the median share of all
    frames if that is less.  Smaller copies what covers the picture into every film; larger leaves no frame if
    a sheet is often hidden."""

    slow_frames: int = 9
    """Number of frames over which the residual is averaged to find its slow part.  Fewer leave more of the
    noise at its place, with the same motion; more move the grain of paper to other frames."""

    distorted_errors: float = 2.5
    """Multiple of a sheet's usual stated error from which a position counts as distorted (by dirt, a
    highlight, a hand), and its true value is predicted from neighbours.  Smaller replaces motion by that of
    neighbours; larger treats distortion as motion."""

    neighbour_errors: float = 3.0
    """Multiple of the usual error of neighbours' predictions that the stated error of such a position must
    also exceed.  Smaller replaces the true motion of sheets that slip by themselves; larger treats distortion
    as motion."""

    alike: float = 1.15
    """Ratio of the scatter of the films' positions to that of the recording's, or its inverse, from which the
    certificate says that its errors are approximate.  Smaller doubts good certificates; larger trusts films
    that are unlike the recording."""

    above_noise: float = 1.25
    """Ratio of the films' errors to the recording's noise from frame to frame from which the certificate says
    that they may contain motion.  Smaller doubts films of grained paper, whose errors are larger than their
    noise; larger trusts films under a lamp that moves (errors up to twice too small)."""

    most_at_distorted: float = 0.2
    """Share of the squared stated errors at positions with large ones (dirt, a highlight, a hand) from which
    the certificate says that its errors are approximate.  Smaller doubts films in which noise differs between
    sheets; larger trusts films in which few positions decide the error, which was then 0.5 to 4 times the
    certified one (test_certify: sheets known less well)."""

    most_hidden: float = 4.0
    """Largest common motion of the sheets of films that are encoded again, relative to what the recording
    shows of it.  Smaller lacks motion that strong compression hides; larger adds motion where the recording
    shows nothing but errors of the codec."""

    read_frames: int = 600
    """Number of frames from which it is read how a film was encoded.  Fewer may miss key frames; more take
    longer to decode."""

    tried_frames: int = 60
    """Number of frames that are encoded to find the noise of such a film.  With a third of them the noise is
    the same within 0.1 grey levels (tests/certify); more take longer."""

    most_noise_grey: float = 12.0
    """Largest pixel noise that is tried, more than films that can be tracked have.  Larger takes longer."""

    noise_error_grey: float = 0.03
    """Tolerance of the noise.  Larger makes films unlike the recording; smaller takes longer."""

    gain_step: float = 0.03
    """Relative step of the brightness across which residuals are not exchanged.  Smaller leaves few frames
    for exchange in flickering light; larger moves clipped pixels into frames that have none."""

    own_time_error: float = 0.2
    """Largest error, in frames, with which the time of a step is measured from its size.  Larger rounds noise
    to dropped frames; smaller treats dropped frames as noise."""

    largest_jump: float = 4.0
    """Largest multiple of the recording's motion with which identities are tested."""

    errors_resolved: float = 3.0
    """Number of standard errors by which a sweep must differ from zero to be resolved."""
