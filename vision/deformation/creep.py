"""Creep of every sheet in every stick: Legendre series fitted to all at once by generalised least squares.

The module also assigns frames to sticks, finds sheets that slip late or early, and measures the noise of the
positions with its autocorrelation, from which the standard errors follow.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
import scipy
from numpy.polynomial.legendre import legvander
from numpy.typing import NDArray

from vision.data import TrackMetadata, Tunable
from vision.memory import row_parts
from vision.numeric import NORMAL_MEDIAN, Bools, Floats, Ints, nan_median, typical_where

POSITIONS_AT_ONCE = 100_000  # to which creep is fitted; more take memory, fewer calls of NumPy


@dataclass(frozen=True, kw_only=True, repr=False)
class DeformationSettings(Tunable):
    """Tunable constants of `horizontal_deformation`; the tests named are in tests/deformation."""

    slip_near_end: float = 0.15
    """Fraction of a stick, from either end, in which an unmatched slip of the film may be the one that ends
    or begins it; frames beyond it are left out.  Larger measures sticks in which the sheets slip; smaller
    leaves out all sticks if the given clock is slightly wrong (test_motion)."""
    least_cover: float = 0.4
    """Fraction of a stick that its positions must span.  Larger drops sheets that are hidden for part of a
    stick; smaller extrapolates (test_motion: a stick seen only at its start)."""
    cubic_frames: int = 12
    """Fewest frames per stick for which noise is measured about a cubic instead of a parabola.  Larger takes
    decelerating creep for noise; smaller uses up the degrees of freedom of short sticks (fast preset)."""
    curvature_errors: float = 3.0
    """Standard errors by which a parabola must differ from a line to be used.  Larger biases sticks with
    decelerating creep (test_motion); smaller adds the noise of a coefficient to every sheet."""
    mostly_seen: float = 0.75
    """Share of a stick's positions from which a sheet counts as seen in all of it.  Larger leaves few sheets
    to measure the camera's bends; smaller takes sheets that saw another part of its movement
    (test_common_mode: a camera that is knocked)."""
    bend_as_slope: float = 1.5
    """Slope that a bend of 1 px gives a sheet that is seen in half of the stick.  It multiplies the bend of
    the creep, and the error of the camera's, for sheets hidden for part of a stick (test_common_mode)."""
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
    the sheets that move most (coverage of the paper preset, test_simulated)."""
    fixed_pattern: float = 0.5
    """Position error that repeats with the position on the sensor, in units of the noise of one frame: pixels
    that differ by 0.7 %.  Larger widens the errors of long sticks (test_simulated: unequal pixels)."""
    locking: float = 0.15
    """Relative error of displacements by the publication's fit, which shifts positions towards whole pixels.
    Larger widens the errors of ridges wider than the window, smaller is too small for others
    (test_simulated)."""
    slip_delay_s: float = 0.025
    """Time next to each slip in which individual sheets may slip late or early.  Larger leaves fewer frames
    from which the creep is extrapolated; smaller misses delays (test_simulated: sheets that slip late)."""
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
    """Weight of the noise of all sheets against the residuals of one, as degrees of freedom.  Larger hides
    sheets noisier than the others (test_creep: a noisy sheet)."""
    held_noise: float = 0.5
    """Noise of a sheet, over the stated error of its positions, below which a codec holds it still.  Larger
    warns of every compressed film, smaller does not count sheets that the codec moves only now and then
    (test_sheets_that_a_codec_holds_still_have_its_error)."""
    warned_sheets: float = 0.2
    """Share of sheets that such a codec holds still, or whose movement is no creep, from which a warning is
    given.  Larger is silent about a stiff shell of which nothing is measured, smaller warns by chance."""
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
    innermost_share: float = 1 / 6
    """Fraction of the sheets, next to the axis, that show a vibration in step with the slips, with one side
    in view. Larger takes the bend of the profile for it; smaller has more noise (test_common_mode)."""
    jump_spreads: float = 6.0
    """Median sizes of common movement beyond which the camera was pushed.  Larger counts pushes as drift;
    smaller leaves out sticks with fast drift (test_common_mode: a camera that moves at every slip)."""
    one_side_contrast: float = 3.0
    """Variance of the creep over the sheets, in units of its noise, above which drift is measured with one
    side in view.  Larger leaves a camera that sways in noisy films; smaller takes creep for drift."""


# --- frames of sticks ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class StickFrames:
    """The F frames that lie wholly within sticks, in order of time."""

    frame: Ints  # index in the tracks, (F,)
    row: Ints  # index of the stick of each frame, increasing, (F,)
    u: Floats  # time from -1 at the valley to +1 at the peak, (F,)
    slot: Ints  # time since the valley in whole frame intervals, (F,); lost frames leave gaps
    sticks: int  # number of sticks, including those without frames
    length_s: Floats  # duration of each stick, (stick,)
    middle_s: Floats  # middle of each stick, (stick,)
    interval_s: float  # time between frames

    def only(self, chosen: Bools | Ints) -> StickFrames:
        """Return some of the frames, of the same sticks."""
        names = ("frame", "row", "u", "slot")
        return replace(self, **{name: getattr(self, name)[chosen] for name in names})

    @property
    def since_s(self) -> Floats:
        """Time since the valley, (F,)."""
        return (self.u + 1) / 2 * self.length_s[self.row]

    @property
    def counts(self) -> Ints:
        """Number of frames in each stick, (stick,)."""
        return np.bincount(self.row, minlength=self.sticks)

    def sums(self, values: NDArray[np.generic]) -> Floats:
        """Sum of `values` (F, ...) over the frames of each stick, (stick, ...); 0 without frames."""
        return self._reduce(np.add, values, 0.0)

    def lowest(self, values: NDArray[np.generic]) -> Floats:
        """Minimum of `values` (F, ...) in each stick, (stick, ...); inf without frames."""
        return self._reduce(np.minimum, values, np.inf)

    def _reduce(self, operation: np.ufunc, values: NDArray[np.generic], empty: float) -> Floats:
        out = np.full((self.sticks, *values.shape[1:]), empty)
        if self.row.size:
            first = np.flatnonzero(np.r_[True, np.diff(self.row) > 0])
            out[self.row[first]] = operation.reduceat(values, first, axis=0, dtype=float)
        return out


def frames_of_sticks(
    time_s: Floats, start_s: Floats, stop_s: Floats, *, margin_s: float, interval_s: float
) -> StickFrames:
    """Return the frames at least `margin_s` after the start and before the end of each stick.

    time_s: time of every frame on the force clock, NaN where unknown.  start_s, stop_s: start and end of the
    sticks, in order and not overlapping.  Frames that are not later than the one before (stale time stamps)
    are left out.
    """
    known = np.flatnonzero(np.isfinite(time_s))
    known = known[time_s[known] > np.r_[-np.inf, np.maximum.accumulate(time_s[known])[:-1]]]
    stick = np.searchsorted(start_s + margin_s, time_s[known], side="right") - 1
    inside = (stick >= 0) & (time_s[known] <= stop_s[stick] - margin_s)
    frame, row = known[inside], stick[inside]
    since = time_s[frame] - start_s[row]
    slot, length = np.rint(since / interval_s).astype(np.int64), stop_s - start_s
    u, middle = 2 * since / length[row] - 1, start_s + length / 2
    return StickFrames(frame, row, u, slot, start_s.size, length, middle, interval_s)


# --- the fit ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class AR1Noise:
    r"""Noise with autocorrelation 1 at lag 0 and :math:`s \rho^k` at a lag of k frames; white by default."""

    share: float = 0.0  # s: share of the AR(1) process in the variance; the rest is white noise
    rho: float = 0.0  # AR(1) coefficient


@dataclass(frozen=True)
class Creep:
    r"""Fitted creep, :math:`x(u) = \sum_k c_k P_k(u)`; NaN where not `good`."""

    coefficient: Floats  # px, (stick, sheet, term)
    inverse: Floats  # inverse normal matrix, (stick, sheet, term, term): the covariance for noise of 1 px
    square: Floats  # sum of squares of the whitened residuals, px², (stick, sheet)
    log_det: Floats  # log determinant of the correlation matrix of the noise, (stick, sheet)
    count: Ints  # number of positions used, (stick, sheet)
    good: Bools  # whether there are enough positions for a fit, (stick, sheet)

    def at(self, frames: StickFrames) -> Floats:
        """Fitted positions in every frame, px, (F, sheet)."""
        design = legendre(frames.u, self.coefficient.shape[2])
        fitted = np.empty((len(design), self.coefficient.shape[1]))
        for some in row_parts(len(design)):
            fitted[some] = np.einsum("fk,fsk->fs", design[some], self.coefficient[frames.row[some]])
        return fitted

    def hidden(self, settings: DeformationSettings) -> Bools:
        """Whether a sheet is not seen in a large part of the frames in which another is, (stick, sheet)."""
        return np.asarray(
            self.count < settings.mostly_seen * self.count.max(axis=1, keepdims=True, initial=0)
        )

    @property
    def dof(self) -> Ints:
        """Degrees of freedom of the residuals, (stick, sheet); 0 where not `good`."""
        return np.where(self.good, self.count - self.coefficient.shape[2], 0)


def legendre(u: Floats, terms: int) -> Floats:
    """Legendre polynomials P_0, P_1, ... at u, (size of u, terms); the coefficient of P_0 is the mean."""
    return np.asarray(legvander(u, terms - 1))


def fit_creep(
    x_px: Floats, frames: StickFrames, terms: int, settings: DeformationSettings, noise: AR1Noise = AR1Noise()
) -> Creep:
    r"""Fit the creep by generalised least squares over the frames of each stick.

    x_px: positions, px, (F, sheet); NaN is left out.  terms: 2 for a line, 3 for a parabola, 4 for a cubic.
    A fit needs four positions (the terms of a cubic) that span at least ``least_cover`` of the stick.

    .. math:: c = (A^T R^{-1} A)^{-1} A^T R^{-1} x

    Here the columns of A are the Legendre polynomials at the frames, and R is the correlation matrix of the
    noise.  The inverse T of an AR(1) correlation matrix is tridiagonal, whichever frames are missing.  With
    additional white noise

    .. math:: R^{-1} = (s 1 + (1 - s) T)^{-1} T,

    which is one banded system for all sticks and sheets.
    """
    # A few sheets at a time limit the memory.
    some = np.array_split(np.arange(x_px.shape[1]), max(1, x_px.size // POSITIONS_AT_ONCE))
    parts = [_fit_sheets(x_px[:, sheets], frames, terms, settings, noise) for sheets in some]
    names = [one.name for one in fields(Creep)]
    return Creep(*(np.concatenate([getattr(part, name) for part in parts], axis=1) for name in names))


def _fit_sheets(
    x_px: Floats, frames: StickFrames, terms: int, settings: DeformationSettings, noise: AR1Noise
) -> Creep:
    """Fit the creep of some sheets; see `fit_creep`."""
    known = np.isfinite(x_px)
    count = frames.sums(known).astype(np.int64)
    u = np.broadcast_to(frames.u[:, None], known.shape)
    span = (-frames.lowest(np.where(known, -u, np.inf)) - frames.lowest(np.where(known, u, np.inf))) / 2
    good = (count >= 4) & (span >= settings.least_cover)
    middle = frames.sums(np.where(known, x_px, 0.0)) / np.maximum(count, 1)
    displacement = x_px - middle[frames.row]  # otherwise rounding would affect the sums of squares
    matrix, log_det = _normal_equations(displacement, frames, terms, noise)
    inverse = np.full((*good.shape, terms, terms), np.nan)
    inverse[good] = np.linalg.inv(matrix[good][:, :terms, :terms])
    right = matrix[..., :terms, terms]
    coefficient = np.einsum("esab,esb->esa", inverse, right)
    square = np.maximum(matrix[..., terms, terms] - (right * coefficient).sum(axis=-1), 0.0)
    coefficient[..., 0] += middle
    return Creep(coefficient, inverse, square, log_det, count, good)


def _normal_equations(
    x_px: Floats, frames: StickFrames, terms: int, noise: AR1Noise
) -> tuple[Floats, Floats]:
    """Matrix (A x)' R⁻¹ (A x) of every stick and sheet, (stick, sheet, terms + 1, terms + 1), and log det R.
    (A x) is the design matrix A with the positions x as another column."""
    sheet, at = np.nonzero(np.isfinite(x_px).T)
    cell = frames.row[at] * x_px.shape[1] + sheet  # positions of one stick and sheet are consecutive
    begins = np.ones(cell.size, bool)
    begins[1:] = np.diff(cell) != 0
    gap = np.zeros(cell.size)
    gap[1:] = np.maximum(np.diff(frames.slot[at]), 1)
    columns = np.vstack([legendre(frames.u[at], terms).T, x_px[at, sheet]])
    weighted, log_det = _times_inverse(columns, np.where(begins, 0.0, noise.rho**gap), noise.share)
    first, shape = np.flatnonzero(begins), (frames.sticks, x_px.shape[1])
    matrix, determinant = np.zeros((shape[0] * shape[1], terms + 1, terms + 1)), np.zeros(shape)
    for a, b in zip(*np.triu_indices(terms + 1), strict=True):
        matrix[cell[first], a, b] = matrix[cell[first], b, a] = np.add.reduceat(
            columns[a] * weighted[b], first
        )
    determinant.flat[cell[first]] = np.add.reduceat(log_det, first)
    return matrix.reshape(*shape, terms + 1, terms + 1), determinant


def _times_inverse(columns: Floats, phi: Floats, share: float) -> tuple[Floats, Floats]:
    """R⁻¹ times the columns, (k, N), and the contribution of each position to log det R, (N,).
    phi: correlation of the AR(1) noise with that of the previous position, 0 where a stick begins, (N,)."""
    if share == 0 or phi.size == 0:
        return columns, np.zeros(phi.size)
    weight = 1 / (1 - phi**2)
    step = columns.copy()
    step[:, 1:] -= phi[1:] * columns[:, :-1]
    step *= weight
    slow = step.copy()
    slow[:, :-1] -= phi[1:] * step[:, 1:]
    if share == 1:
        return slow, -np.log(weight)
    diagonal, off = weight.copy(), np.zeros(phi.size)
    diagonal[:-1] += (phi**2 * weight)[1:]
    off[:-1] = -(phi * weight)[1:]
    band = np.vstack([share + (1 - share) * diagonal, (1 - share) * off])
    factor = scipy.linalg.cholesky_banded(band, lower=True, check_finite=False)
    solved = scipy.linalg.cho_solve_banded((factor, True), slow.T, check_finite=False).T
    return solved, 2 * np.log(factor[0]) - np.log(weight)


# --- sheets that slip late or early -------------------------------------------------------------------------


@dataclass(frozen=True)
class LateSlips:
    """Parts of sticks in which individual sheets do not creep, since they slip after or before the others."""

    outside: Bools  # positions before the sheet's own slip into the stick or after the next, (F, sheet)
    lost: Floats  # share of the stick in which the sheet does not creep, (stick, sheet)
    lost_err: Floats  # its standard error, (stick, sheet)


def find_late_slips(x_px: Floats, frames: StickFrames, settings: DeformationSettings) -> LateSlips:
    """Find sheets that slip late or early, by a parabola through the frames in the middle of each stick.

    x_px: positions without vibration, (F, sheet).  Sticks with too few frames are not corrected.  A sheet is
    late if it has not slipped yet in the first frames of a stick; it slips between the last such frame and
    the next.  Early slips are found in the same way at the end of a stick.  The delay of the other sheets
    follows from the share of late ones, assuming that all delays up to the longest are equally likely.
    """
    late, blurred, clear = _late(x_px, frames, settings)
    length_s = frames.length_s[:, None]
    outside, lost, variance = np.zeros_like(late), np.zeros(clear.shape), np.zeros(clear.shape)
    for since_s in (frames.since_s, frames.length_s[frames.row] - frames.since_s):
        near = (since_s < frames.length_s[frames.row] / 2)[:, None]
        begin = _latest(near & blurred, since_s, frames)
        last_late = np.maximum(_latest(near & late, since_s, frames), begin)
        excluded = (since_s[:, None] <= last_late[frames.row]) & (last_late > 0)[frames.row]
        first = frames.lowest(np.where(excluded | np.isnan(x_px), np.inf, since_s[:, None]))
        delay = _longest_delay(frames.lowest(since_s) - begin[:, 0], last_late > begin, clear, settings)
        # Each sheet slips at a time between last_late and `until`, uniformly distributed.
        until = np.where(last_late > begin, first, np.minimum(first, begin + delay))
        until = np.where(np.isfinite(until), until, last_late)
        outside |= excluded
        lost += ((last_late + until) / 2 - begin) / length_s
        variance += (until - last_late) ** 2 / 12 / length_s**2
    return LateSlips(outside, lost, np.sqrt(variance))


def _latest(selected: Bools, since_s: Floats, frames: StickFrames) -> Floats:
    """Time of the last selected frame (F, ...) in each stick, s, (stick, ...); 0 without any."""
    return np.maximum(-frames.lowest(np.where(selected, -since_s[:, None], 0.0)), 0.0)


def _late(x_px: Floats, frames: StickFrames, settings: DeformationSettings) -> tuple[Bools, Bools, Bools]:
    """Positions before the sheet's slip or after the next one, (F, sheet); frames in which all sheets are
    slipping, (F, 1); and sheets with slips large enough for this test, (stick, sheet)."""
    end = _near_the_ends(frames, settings)
    creep = fit_creep(np.where(end[:, None], np.nan, x_px), frames, 3, settings)
    residual = creep.at(frames)
    np.subtract(x_px, residual, out=residual)
    residual -= nan_median(residual, axis=1)[:, None]
    fitted = np.broadcast_to(~end[:, None], residual.shape)
    noise_px = typical_where(fitted, np.abs(residual)) / NORMAL_MEDIAN
    ends, residual = frames.only(end), residual[end]
    limit = settings.late_errors * _extrapolation_error(noise_px, creep, ends)
    jump = 2 * creep.coefficient[..., 1]
    late, blurred = np.zeros(x_px.shape, bool), np.zeros((len(x_px), 1), bool)
    with np.errstate(divide="ignore", invalid="ignore"):
        largest = -ends.lowest(np.where(np.isfinite(limit), -limit, 0.0))
        clear = (largest > 0) & np.isfinite(largest) & (np.abs(jump) > 2 * largest)
        clear &= ~_uneven(creep.square, creep.dof, _typical_variance(creep), settings)
        # Part of the slip that is still missing, or, at the end of the stick, that is already made.
        part = -np.sign(ends.u)[:, None] * residual / jump[ends.row]
        part = np.where(clear[ends.row] & (part < 1.5), part, np.nan)  # more is not a late slip
        common = np.maximum(_lower_quantile(part, settings.late_common), 0.0)[:, None]
        least = np.maximum(limit / np.abs(jump)[ends.row], 0.01)
        late[end], blurred[end] = part - common > least, (common > least).any(axis=1, keepdims=True)
    return late, blurred, clear


def _near_the_ends(frames: StickFrames, settings: DeformationSettings) -> Bools:
    """Frames within `slip_delay_s` of either end of sticks that have at least six others, (F,)."""
    reach = int(np.ceil(settings.slip_delay_s / frames.interval_s))
    after = np.arange(frames.row.size) - np.searchsorted(frames.row, frames.row)
    before = frames.counts[frames.row] - 1 - after
    near = np.minimum(after, before) < reach
    return np.asarray(near & (after + before + 1 - 2 * reach >= 6))


def _extrapolation_error(noise_px: Floats, creep: Creep, ends: StickFrames) -> Floats:
    """Standard error of the residuals at the ends, which are not fitted, px, (F, sheet).
    noise_px: standard deviation of the residuals of each sheet that are fitted, (sheet,)."""
    terms = creep.coefficient.shape[2]
    count = max(float(np.median(creep.count)), terms + 1)
    design = legendre(ends.u, terms)
    variance = 1 + np.einsum("fa,fsab,fb->fs", design, creep.inverse[ends.row], design)
    return np.asarray(noise_px * np.sqrt(count / (count - terms)) * np.sqrt(variance))


def _lower_quantile(part: Floats, share: float) -> Floats:
    """Quantile over the sheets, rounded down to one of the values, (F,); 0 where none is known."""
    ordered = np.nan_to_num(np.sort(part, axis=1))  # NaN comes last
    index = (share * np.maximum(np.isfinite(part).sum(axis=1) - 1, 0)).astype(int)
    return np.asarray(np.take_along_axis(ordered, index[:, None], axis=1)[:, 0])


def _longest_delay(first_s: Floats, late: Bools, clear: Bools, settings: DeformationSettings) -> float:
    """Longest delay of a sheet, s, at which the expected share of late sheets equals the observed one.
    first_s: time of the first frame of each stick, (stick,); a sheet is late if its delay exceeds it. 0 if
    too few sheets are late."""
    weight = clear.sum(axis=1)
    observed = (late & clear).sum() / max(weight.sum(), 1)
    if observed < 0.004:
        return 0.0
    longest = np.linspace(0.0, 2 * settings.slip_delay_s, 101)[1:]
    expected = weight @ np.maximum(1 - first_s[:, None] / longest, 0.0) / weight.sum()
    return float(np.interp(observed, expected, longest))


_LEAST_VARIANCE_PX2 = 1e-12  # noise variance of exact positions, whose residuals are rounding errors

# --- size and autocorrelation -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Noise:
    """Noise of the positions of all sheets."""

    noise_px: Floats  # standard deviation of single positions, (sheet,)
    correlation: AR1Noise  # from frame to frame, the same for all sheets
    excess: Floats  # factor, at least 1, by which the residuals of a stick exceed noise_px, (stick, sheet)


def measure_noise(x_px: Floats, frames: StickFrames, terms: int, settings: DeformationSettings) -> Noise:
    """Measure the noise and its autocorrelation from the residuals of a parabola or cubic in each stick.

    x_px: positions without vibration, (F, sheet), NaN where there is none.  Sticks with uneven residuals (a
    sheet that slipped by itself) are left out.
    """
    white = fit_creep(x_px, frames, terms, settings)
    even = (white.dof > 0) & ~_uneven(white.square, white.dof, _typical_variance(white), settings)
    correlation = _fit_correlation(x_px, frames, terms, even, settings)
    creep = fit_creep(x_px, frames, terms, settings, correlation)
    variance = _variance(np.where(even, creep.square, 0.0), creep.dof * even, settings)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(creep.dof > 0, creep.square / creep.dof / variance, 1.0)
    uneven = _uneven(ratio * creep.dof, creep.dof, np.ones(variance.size), settings)
    return Noise(np.sqrt(variance), correlation, np.where(uneven, np.sqrt(np.maximum(ratio, 1)), 1.0))


def _fit_correlation(
    x_px: Floats, frames: StickFrames, terms: int, used: Bools, settings: DeformationSettings
) -> AR1Noise:
    """Fit AR(1) plus white noise by restricted maximum likelihood, or white noise if that fits as well. Each
    sheet has its own variance.  used: which sheets in which sticks may be selected, (stick, sheet)."""
    every = max(1, round(x_px.size / settings.correlation_positions))
    sheets = max(1, min(every, x_px.shape[1] // 8))
    selected = used[:, ::sheets] & (np.arange(frames.sticks) % max(1, every // sheets) == 0)[:, None]
    inside = selected.any(axis=1)[frames.row]
    part = frames.only(inside)
    x_px = np.where(selected[part.row], x_px[inside, ::sheets], np.nan)

    def deviance(share_and_rho: Floats) -> float:
        """-2 log restricted likelihood, up to a constant."""
        creep = fit_creep(x_px, part, terms, settings, AR1Noise(*share_and_rho.tolist()))
        dof = creep.dof.sum(axis=0)
        variance = np.nansum(creep.square, axis=0)[dof > 0] / dof[dof > 0]
        log_variance = dof[dof > 0] @ np.log(np.maximum(variance, _LEAST_VARIANCE_PX2))
        log_det = np.linalg.slogdet(creep.inverse[creep.good])[1].sum()
        return float(log_variance + creep.log_det.sum() - log_det)

    white = fit_creep(x_px, part, terms, settings)
    if white.dof.sum() < 30 or not np.nansum(white.square) > _LEAST_VARIANCE_PX2 * white.dof.sum():
        return AR1Noise()
    found = scipy.optimize.minimize(
        deviance,
        [0.7, 0.6],
        method="Nelder-Mead",
        bounds=[(0.01, 1.0), (0.02, 0.97)],
        options={"xatol": 0.01, "fatol": 0.5, "maxfev": 40},
    )
    # Two parameters must decrease the deviance by as much as two of three standard errors do.
    return AR1Noise(*map(float, found.x)) if deviance(np.zeros(2)) - found.fun > 2 * 3.0**2 else AR1Noise()


def _typical_variance(creep: Creep) -> Floats:
    """Median noise variance of each sheet over the sticks, px², (sheet,); the overall median if unknown."""
    median = 2 * scipy.special.gammaincinv(np.maximum(creep.dof, 1) / 2, 0.5)  # median of chi-square
    each = nan_median(np.where(creep.dof > 0, creep.square / median, np.nan))
    overall = float(nan_median(each))
    return np.maximum(np.where(np.isfinite(each), each, np.nan_to_num(overall)), _LEAST_VARIANCE_PX2)


def _uneven(square: Floats, dof: Ints, variance: Floats, settings: DeformationSettings) -> Bools:
    """Whether the residuals are significantly too large."""
    # Half the degrees of freedom, because sums of squares of correlated noise scatter more.
    fewer = np.maximum(dof / 2, 1)
    limit = scipy.special.chdtri(fewer, settings.uneven_probability)
    return np.asarray(square / variance * fewer / np.maximum(dof, 1) > limit)


def _variance(square: Floats, dof: Ints, settings: DeformationSettings) -> Floats:
    """Noise variance of each sheet, px², from its residuals and, with a small weight, those of all sheets."""
    measured, weight = square.sum(axis=0), dof.sum(axis=0)
    common = measured.sum() / max(weight.sum(), 1)
    each = (measured + settings.common_dof * common) / (weight + settings.common_dof)
    return np.asarray(np.maximum(each, _LEAST_VARIANCE_PX2))


# --- fixed-pattern error ------------------------------------------------------------------------------------


def fixed_pattern_gain(reach_px: Floats, terms: int, window_px: int) -> Floats:
    r"""RMS contribution of a fixed pattern of 1 px RMS to each coefficient of the creep, (..., terms).

    reach_px (...): half the distance r that the sheet creeps.  A wave of frequency f per px contributes
    :math:`(2 l + 1) j_l(2 \pi f r)` to the coefficient of :math:`P_l` (spherical Bessel functions).  Waves
    are weighted by the transfer function of the subpixel fit, which weights the pixels of its window by their
    distance from its centre.
    """
    waves_per_px = np.arange(0.01, 0.5, 0.01)
    away_px = np.arange(window_px // 2 + 1)
    power = (np.sin(2 * np.pi * waves_per_px[:, None] * away_px) @ away_px) ** 2
    reach = np.nan_to_num(np.abs(reach_px))
    grid = np.linspace(0, float(reach.max(initial=0.0)) + 1e-9, 200)
    order, phase = np.arange(terms)[:, None, None], 2 * np.pi * waves_per_px[:, None] * grid
    square = power @ scipy.special.spherical_jn(order, phase) ** 2 / power.sum()
    return np.stack([(2 * k + 1) * np.interp(reach, grid, np.sqrt(square[k])) for k in range(terms)], axis=-1)


# --- standard errors ----------------------------------------------------------------------------------------


def coefficient_errors(
    fit: Creep,
    noise: Noise,
    pattern_px: Floats | float = 0.0,
    scale: Floats | float = 0.0,
    window_px: int = TrackMetadata.window_px,
) -> Floats:
    """Standard errors of the coefficients of a fit with the correlation of `noise`, px, (stick, sheet, term).

    pattern_px: fixed-pattern error of each sheet, (sheet,).  scale: relative error of all displacements of a
    sheet, (sheet,).  window_px: of the subpixel fit.
    """
    variance = np.einsum("eskk->esk", fit.inverse)
    random = np.sqrt(variance) * (noise.noise_px * noise.excess)[..., None]
    reach = fit.coefficient[..., 1]
    pattern = fixed_pattern_gain(reach, variance.shape[2], window_px) * np.reshape(pattern_px, (-1, 1))
    return np.asarray(np.sqrt(random**2 + pattern**2 + (scale * reach)[..., None] ** 2))
