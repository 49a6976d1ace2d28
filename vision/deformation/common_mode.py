"""Camera movement: the common motion of all sheets, separated from their own creep.

Vibration is the common motion in each frame that is not creep.  Drift is steady motion during a stick.  It is
found from pairs of sheets left and right, which creep in opposite directions, or, with only one side in view,
from the creep of each sheet in other sticks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import scipy

from vision.deformation.creep import Creep, DeformationSettings, Noise, StickFrames, coefficient_errors
from vision.memory import row_parts
from vision.numeric import (
    NORMAL_MEDIAN,
    Bools,
    Floats,
    Ints,
    centred,
    nan_median,
    sigma_about_zero,
    typical_size,
)

# --- vibration ----------------------------------------------------------------------------------------------


def common_mode_motion(residual: Floats, settings: DeformationSettings) -> tuple[Floats, Floats]:
    """Common motion in each frame beyond the creep, px, (F,); 0 in frames with too few sheets.

    It is the mean of the residuals about the creep of each sheet, px, (F, sheet), weighted by the inverse of
    each sheet's variance, without outliers. Also returns the factor on each sheet's noise variance that
    restores what subtracting this motion removes, (sheet,).
    """
    spread = typical_size(residual)
    typical = nan_median(spread)
    spread = np.maximum(spread, 0.1 * typical if typical > 0 else 1e-6)
    weight = np.where(np.isfinite(spread), spread**-2, 0.0)
    motion = np.zeros(len(residual))
    for some in row_parts(len(residual)):
        near = residual[some]
        with np.errstate(invalid="ignore"):
            deviation = np.abs(near - nan_median(near, axis=1)[:, None])
            known = (deviation <= 8 * spread) & (weight > 0)  # outliers do not move with the others
        enough = known.sum(axis=1) >= settings.least_sheets
        moved = np.where(known, near, 0.0) @ weight
        np.divide(moved, (known * weight).sum(axis=1), out=motion[some], where=enough)
    if (weight > 0).sum() < settings.least_sheets:
        return motion, np.ones(weight.size)
    return motion, np.asarray(1 / (1 - np.minimum(weight / weight.sum(), 0.5)))


def camera_bends(creep: Creep, side: Ints, settings: DeformationSettings) -> tuple[Floats, Floats]:
    """Coefficients from P₂ on of the camera's movement in each stick, and their errors, px, (stick, term).

    creep: fit to the positions, with at least three terms. A sheet's fit takes up this part of the movement,
    and that of a sheet which is hidden for part of a stick another part. Creep cancels between the two sides.
    With one side in view, what sheets repeat in every stick is creep; with few sticks nothing is found then,
    and the error is the bend itself. Coefficients that are not significant are 0.
    """
    whole = creep.good & ~creep.hidden(settings)
    bend = np.where(whole[..., None], creep.coefficient[..., 2:], np.nan)
    sides = [side == one for one in (-1, 1) if (side == one).sum() >= settings.least_pairs]

    def common(values: Floats) -> Floats:
        return np.asarray(np.mean([nan_median(values[:, one], axis=1) for one in sides], axis=0))

    none = np.zeros(bend.shape[::2])
    if not sides:
        return none, none
    repeated = len(bend) >= settings.least_repeats
    usual = nan_median(bend)[None]
    if repeated:
        bend = bend - (usual - common(usual)[:, None] if len(sides) == 2 else usual)
    found = common(bend)
    count = np.maximum(whole.sum(axis=1), 1)[:, None]
    error = sigma_about_zero(bend - found[:, None], axis=1) * np.sqrt(np.pi / 2 / count)
    if not repeated and len(sides) < 2:
        return none, np.nan_to_num(np.hypot(error, found))
    significant = np.abs(found) > settings.curvature_errors * error
    return np.where(significant, found, 0.0), np.nan_to_num(error)


# --- drift --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Drift:
    """Drift of the camera in each stick: the common part of one coefficient of the creep."""

    value: Floats  # px, (stick,); 0 where the drift is unknown
    error: Floats  # px, (stick,)
    share: Floats  # weight of each sheet in it, (stick, sheet)


def drift_model(
    line: Creep, side: Ints, n: Ints, frames: StickFrames, vibration_px: Floats, settings: DeformationSettings
) -> BothSides | OneSide:
    """Choose how drift is separated from creep: by pairs if there are enough, else with one side in view.

    line: fit to the positions without vibration.  side, n: of the sheets in order of position.
    vibration_px: result of `common_mode_motion`, (F,).
    """
    middle_px, slope_px = line.coefficient[..., 0], line.coefficient[..., 1]
    unpushed_px = _without_pushes_between(middle_px, frames, settings)
    slow_px = _net_rate(unpushed_px, frames, settings)[0] * frames.length_s[:, None] / 2
    both = BothSides.of(side, n, middle_px, slope_px, slow_px, settings)
    return both if both.enough else OneSide.of(slope_px, unpushed_px, n, frames, vibration_px, settings)


@dataclass(frozen=True)
class BothSides:
    """Drift from pairs of opposite sheets; left and right are their indices in the tracks, (pair,)."""

    left: Ints
    right: Ints
    slow_px: Floats  # half the movement to the right by the mean positions in all sticks, (stick, sheet)
    least_pairs: int
    movement: ClassVar[str] = "vibration and drift subtracted"

    @classmethod
    def of(
        cls,
        side: Ints,
        n: Ints,
        middle_px: Floats,
        slope_px: Floats,
        slow_px: Floats,
        settings: DeformationSettings,
    ) -> BothSides:
        """Pair sheets of equal number, counting gaps; shift the axis if the creep then is more symmetric.

        middle_px, slope_px: mean position, and half the movement to the right, (stick, sheet).  slow_px: that
        half from the mean positions of the sticks.
        """
        left, right = np.flatnonzero(side < 0), np.flatnonzero(side > 0)
        n = n + np.where(side < 0, _missing_sheets(middle_px, left[::-1]), _missing_sheets(middle_px, right))
        found = []
        for shift in (0, -2, -1, 1, 2):  # possible error of the left numbers relative to the right ones
            _, first, second = np.intersect1d(n[left] + shift, n[right], return_indices=True)
            found.append(cls(left[first], right[second], slow_px, settings.least_pairs))
        asymmetry = np.array([pairs.asymmetry_px(slope_px) for pairs in found])
        return found[np.argmin(asymmetry) if asymmetry.min() < 0.5 * asymmetry[0] else 0]

    def asymmetry_px(self, slope_px: Floats) -> float:
        """Mean asymmetry of the pairs that repeats in every stick, px; infinite without enough pairs."""
        if not self.enough:
            return np.inf
        total = slope_px[:, self.left] + slope_px[:, self.right]
        repeated = nan_median(total - nan_median(total, axis=1)[:, None])
        return float(np.nan_to_num(np.abs(repeated)).mean())

    @property
    def enough(self) -> bool:
        """Whether there are enough pairs to separate drift from creep."""
        return self.left.size >= self.least_pairs

    def drift(self, coefficient: Floats, error: Floats, *, slow: bool) -> Drift:
        """Drift of the camera during each stick from coefficients of the creep, to the right, (stick, sheet).

        Sheets creep inwards on both sides, so half the sum of a pair is the movement of the camera plus the
        pair's asymmetry. A part of this that is the same share of the creep for all pairs (one side creeps
        less) follows from the correlation of the half sums with the creep within each stick. The rest,
        relatively larger near the axis, is measured from the scatter of the pairs, which gives most weight to
        the nearly stationary inner sheets.

        `slow`: whether drift that is the same in all sticks must also show in the mean positions of the
        sheets. Where it does not, one side may creep more instead; this enters the error.
        """
        left, right = coefficient[:, self.left], coefficient[:, self.right]
        noise = (error[:, self.left] ** 2 + error[:, self.right] ** 2) / 4
        all_pairs = pair = _Pairs.of(left, right, noise, self.least_pairs)
        own, relative = 0.0, 0.04  # initial values; four rounds suffice to converge
        for _round in range(4):
            weight = pair.known / np.maximum(pair.noise + own + relative * pair.step**2, 1e-18)
            total = weight.sum(axis=1)
            share = np.divide(weight, total[:, None], out=np.zeros_like(weight), where=pair.known)
            sides, sides_err = all_pairs.difference_of_sides(weight)
            pair = replace(all_pairs, middle=all_pairs.middle - sides * all_pairs.step)
            value = (share * pair.middle).sum(axis=1)
            own, relative = pair.asymmetry(value, share, weight)
        of_sheet = np.zeros_like(coefficient)
        of_sheet[:, self.left] = of_sheet[:, self.right] = share
        random = np.divide(1, total, out=np.zeros_like(total), where=total > 0)
        systematic = sides_err * (share * pair.step).sum(axis=1)
        shift, shift_err = 0.0, 0.0
        if slow:
            shift, shift_err = self._constant_correction(value, random, share, all_pairs, own)
        return Drift(value + shift, np.sqrt(random + systematic**2 + shift_err**2), of_sheet)

    def _constant_correction(
        self, value: Floats, random: Floats, share: Floats, pairs: _Pairs, own_px2: float
    ) -> tuple[float, float]:
        """Correction of the drift that is the same in all sticks, and its error, px. It lies between 0 and
        the difference, beyond noise, from the drift of the sheets' mean positions from stick to stick. It is
        limited such that the sheets of the pair that creeps least do not creep outwards."""
        slow = (self.slow_px[:, self.left] + self.slow_px[:, self.right]) / 2
        difference = float(np.median((share * np.nan_to_num(slow)).sum(axis=1) - value))
        noise = np.pi / 2 * float(np.median(random)) / len(value)  # variance of a median
        difference = np.sign(difference) * np.sqrt(max(difference**2 - noise, 0.0))
        ends = np.clip((0.0, difference), *pairs.limits_of_correction(value, own_px2))
        return float(ends.mean()), float(abs(ends[1] - ends[0])) / 2


@dataclass(frozen=True)
class _Pairs:
    """Coefficients of pairs of sheets, (stick, pair), 0 where not known."""

    middle: Floats  # half the sum, px
    step: Floats  # half the difference, px: the creep
    noise: Floats  # variance of either, px²
    known: Bools
    # Without unusual variance, as of a jump within a stick (test_creep): the asymmetry is measured on these.
    quiet: Bools

    @classmethod
    def of(cls, left: Floats, right: Floats, noise: Floats, least: int) -> _Pairs:
        """Pairs of these coefficients; sticks with fewer than `least` known pairs are left out."""
        middle, step = (right + left) / 2, (left - right) / 2
        known = np.isfinite(middle) & np.isfinite(noise)
        known &= known.sum(axis=1, keepdims=True) >= least
        quiet = known & (noise <= 9 * np.median(noise[known])) if known.any() else known
        middle, step, noise = (np.where(known, part, 0.0) for part in (middle, step, noise))
        return cls(middle, step, noise, known, quiet)

    def limits_of_correction(self, value: Floats, own_px2: float) -> tuple[float, float]:
        """Range of a constant correction of the drift for which no sheet of the pair that creeps least creeps
        outwards, in the median over the sticks and within two standard errors, px.
        own_px2: variance of the half sums by movement of the sheets' own."""
        step, residual, noise = (
            nan_median(np.where(self.known, part, np.nan))
            for part in (self.step, self.middle - value[:, None], self.noise)
        )
        if not np.isfinite(step).any():
            return 0.0, 0.0
        least = np.nanargmin(np.abs(step))
        variance = np.pi / 2 * noise[least] / self.known[:, least].sum() + own_px2
        creep = abs(step[least]) + 2 * np.sqrt(variance)
        return float(residual[least] - creep), float(residual[least] + creep)

    def difference_of_sides(self, weight: Floats) -> tuple[float, float]:
        """Half sum as a share of the creep that all pairs have in common, and its error. 0 where all pairs
        creep alike, because there it cannot be separated from drift. What one pair differs by repeats in
        every stick, so each pair contributes one residual to the error."""
        weight = weight * self.quiet
        total = np.maximum(weight.sum(axis=1, keepdims=True), 1e-300)
        step, middle = (v - (weight * v).sum(axis=1, keepdims=True) / total for v in (self.step, self.middle))
        square = float((weight * step**2).sum())
        if square <= 4 * float((weight * self.noise).sum()):
            return 0.0, 0.0
        share = float((weight * step * middle).sum()) / square
        of_pair = (weight * step * (middle - share * step)).sum(axis=0)
        return share, float(np.sqrt(max((of_pair**2).sum() / square, 1.0) / square))

    def asymmetry(self, value: Floats, share: Floats, weight: Floats) -> tuple[float, float]:
        """Variance of the half sums beyond noise: a part that does not depend on the creep, px², from sheets
        that move by themselves, and the other in units of the squared creep."""
        excess = (self.middle - value[:, None]) ** 2 - self.noise * (1 - share)
        weight = weight * self.quiet
        rest = weight * (1 - share)  # the drift follows the pairs that weigh most
        design = np.stack([rest.ravel(), (rest * self.step**2).ravel()], axis=-1)
        own, relative = scipy.optimize.nnls(design, (weight * excess).ravel())[0]
        return float(own), float(relative)


def _missing_sheets(middle_px: Floats, outwards: Ints) -> Ints:
    """Number of sheets missing between the innermost of these sheets and each, (sheet,); 0 for others.
    outwards: indices of the sheets of one side, from the axis outwards."""
    count = np.zeros(middle_px.shape[1], np.int64)
    gap = np.abs(np.diff(nan_median(middle_px)[outwards]))
    if np.isfinite(gap).any():
        pitch = float(nan_median(gap))
        missing = np.maximum(np.floor(np.nan_to_num(gap / pitch) - 0.6), 0)  # a gap of 1.6 pitches hides one
        count[outwards[1:]] = np.cumsum(missing)
    return count


@dataclass(frozen=True)
class OneSide:
    """Drift with one side in view.

    In each stick every sheet creeps about as much as in the sticks before and after; a common motion beyond
    that is the camera's.  Drift that is the same in every stick shows in the slow movement of the mean
    positions, extrapolated to the axis, where sheets do not creep.
    """

    profile_px: Floats  # mean slopes of the neighbouring sticks, (stick, sheet)
    slow_px: Floats  # slope of the camera's slow movement, (stick,)
    slow_err_px: Floats  # its standard error, (stick,)
    near: Floats  # weights of the neighbouring sticks, (stick, stick)
    in_step_px: Floats  # half of what may be a vibration in step with the slips, (stick,)
    unknown_px: Floats  # error of the drift where it cannot be measured, (stick,)
    settings: DeformationSettings
    movement: ClassVar[str] = "vibration subtracted, and the part of drift that one side shows"

    @classmethod
    def of(
        cls,
        slope_px: Floats,
        unpushed_px: Floats,
        n: Ints,
        frames: StickFrames,
        vibration_px: Floats,
        settings: DeformationSettings,
    ) -> OneSide:
        """Drift model from the slopes and middles of all sheets, without pushes, and the vibration, px, (F,).
        Where drift cannot be measured, its error is the slope that white noise as large as the vibration
        would have."""
        stick = np.arange(frames.sticks)
        distance = np.abs(stick[:, None] - stick)
        near = np.maximum(1 - distance / (settings.neighbouring_sticks + 1.0), 0.0)
        near = near * ~_is_jump(nan_median(slope_px - nan_median(slope_px), axis=1), settings)
        profile_px = _weighted_mean(near * (distance > 0), slope_px)
        rate, weight = _rate(near, frames.middle_s, unpushed_px)
        steadiness = _steadiness(profile_px)
        slow_px_s = _at_axis(rate, weight * steadiness, n, profile_px)
        # The camera's walk is in both extrapolations; the smaller contains less of the sheets' own motion.
        walk_px = min(
            _random_walk_step(_at_axis(unpushed_px, weight, n, profile_px))
            for weight in (np.ones_like(steadiness), steadiness)
        )
        slow_err_px = walk_px / 2 * np.sqrt(1.2 / np.maximum(near.sum(axis=1), 1))
        variance_px2 = float((vibration_px**2).sum()) / max(vibration_px.size, 1)
        white_px = np.sqrt(3 * variance_px2 / np.maximum(frames.counts, 1))
        slow_px = slow_px_s * frames.length_s / 2
        # A vibration in step with the slips drifts alike in many sticks, by up to its amplitude. So may the
        # innermost sheets creep: half is subtracted, and an error.
        innermost_px = _on_axis(profile_px - slow_px[:, None], n, settings.innermost_share)
        most_px = np.sqrt(2 * variance_px2)
        in_step_px = np.clip(innermost_px, -most_px, most_px) / 2
        return cls(profile_px, slow_px, slow_err_px, near, in_step_px, white_px, settings)

    def drift(self, coefficient: Floats, error: Floats, *, slow: bool) -> Drift:
        """Drift of the camera during each stick; 0 where the sheets creep too much alike or are too few.

        coefficient, error: of the creep, to the right, px, (stick, sheet), NaN where unknown.  slow: whether
        slow movement contributes to this coefficient.
        """
        known = np.isfinite(coefficient) & np.isfinite(self.profile_px) & np.isfinite(error)
        value, profile = np.where(known, coefficient, 0.0), np.where(known, self.profile_px, 0.0)
        variance = np.where(known, error, np.inf) ** 2
        alike = _Line.through(profile, value, variance)
        # Sheets that creep more also differ more from one stick to the next.
        clear = known & (profile**2 > 9 * variance)
        own = (alike.residual**2 - variance)[clear] / profile[clear] ** 2
        scatter2 = max(float(np.median(own)) / NORMAL_MEDIAN**2, 0.0) if own.size else 0.0
        line = _Line.through(profile, value, variance + scatter2 * profile**2)
        count = known.sum(axis=1)
        contrast = alike.spread > self.settings.one_side_contrast * count
        measured = (count >= self.settings.least_sheets) & contrast
        intercept = np.where(measured, line.intercept, 0.0)
        # The mean drift of the neighbouring sticks is part of the profile: its random part is an error.
        shared = (self.near**2 @ intercept**2) / np.maximum(self.near @ measured, 1.0) ** 2
        error = np.sqrt(line.intercept_variance + shared)
        found = intercept
        if slow:
            # Noise alone can look like a random walk of up to about three errors.
            error = np.hypot(error, np.where(self.slow_err_px > 3 * error, self.slow_err_px, 0.0))
            error = np.hypot(error, self.in_step_px)
            found = found + self.slow_px + self.in_step_px
        return Drift(
            np.where(measured, found, 0.0), np.where(measured, error, self.unknown_px), np.zeros_like(value)
        )


@dataclass(frozen=True)
class _Line:
    """Least squares of value = share · profile + intercept in each stick."""

    intercept: Floats  # (stick,)
    intercept_variance: Floats
    spread: Floats  # weighted sum of squares of the profile about its mean
    residual: Floats  # (stick, sheet)

    @classmethod
    def through(cls, profile: Floats, value: Floats, variance: Floats) -> _Line:
        """The line through values (stick, sheet) of these variances, infinite where a value is unknown."""
        weight = 1 / variance
        total = np.maximum(weight.sum(axis=1), 1e-300)
        centre, moved = ((weight * part).sum(axis=1) / total for part in (profile, value))
        contrast = profile - centre[:, None]
        spread = (weight * contrast**2).sum(axis=1)
        divisor = np.maximum(spread, 1e-300)
        share = (weight * contrast * value).sum(axis=1) / divisor
        intercept = moved - share * centre
        residual = value - share[:, None] * profile - intercept[:, None]
        return cls(intercept, 1 / total + centre**2 / divisor, spread, residual)


def _without_pushes_between(middle_px: Floats, frames: StickFrames, settings: DeformationSettings) -> Floats:
    """Mean positions (stick, sheet) without pushes of the camera between sticks, px."""
    known = np.flatnonzero(np.isfinite(middle_px).any(axis=1))
    between_s = np.diff(frames.middle_s[known])[:, None]
    shift_px = np.diff(middle_px[known], axis=0)
    common_px = nan_median(shift_px - nan_median(shift_px / between_s) * between_s, axis=1)
    pushed_px = np.zeros(len(middle_px))
    pushed_px[known[1:]] = np.where(_is_jump(common_px, settings), common_px, 0.0)
    return np.asarray(middle_px - np.cumsum(pushed_px)[:, None])


def _random_walk_step(position_px: Floats) -> float:
    """RMS step, px, of the camera's random walk from stick to stick; steady drift does not count."""
    change_px = np.diff(position_px, n=2)
    return float(sigma_about_zero(change_px)) / np.sqrt(2) if change_px.size else 0.0


def _is_jump(common_px: Floats, settings: DeformationSettings) -> Bools:
    """Whether each common movement is so large that the camera must have been pushed, (n,)."""
    size = np.abs(common_px)
    return np.asarray(size > settings.jump_spreads * nan_median(size))


def _weighted_mean(near: Floats, value: Floats) -> Floats:
    """Weighted mean over the neighbouring sticks, (stick, sheet); NaN without any."""
    known = np.isfinite(value)
    count = near @ known
    return np.where(count > 0, near @ np.where(known, value, 0.0) / np.maximum(count, 1e-300), np.nan)


def _rate(near: Floats, time_s: Floats, value: Floats) -> tuple[Floats, Floats]:
    """Slope of value (stick, sheet) against time over the neighbouring sticks, px/s, and its weight, which is
    smaller for sheets known in few of them."""
    known = np.isfinite(value)
    time = np.where(known, time_s[:, None], np.nan)
    product, square = (
        _weighted_mean(near, time * part) - _weighted_mean(near, time) * _weighted_mean(near, part)
        for part in (value, time)
    )
    weight = np.nan_to_num(square) * (near @ known)
    weight = weight / np.maximum(weight.max(axis=1, keepdims=True), 1e-300)
    with np.errstate(divide="ignore", invalid="ignore"):
        return product / square, np.where(weight > 1e-6, weight, 0.0)


def _on_axis(profile: Floats, n: Ints, share: float) -> Floats:
    """Profile (stick, sheet) at n = 0, (stick,), by a line through this share of the sheets, or three."""
    inner = n <= max(share * n.max(), 3.0)
    known = np.isfinite(profile[:, inner])
    number = np.where(known, n[inner], 0.0)
    value = np.where(known, profile[:, inner], 0.0)
    return _Line.through(number, value, np.where(known, 1.0, np.inf)).intercept


def _steadiness(profile: Floats) -> Floats:
    """Weight of each sheet, which falls with its creep, as it may wander as far, (stick, sheet), or NaN."""
    wander = np.abs(profile) / np.maximum(nan_median(np.abs(profile), axis=1)[:, None], 1e-300)
    return np.asarray(1 / (0.1 + wander**2), np.float64)


def _at_axis(rate: Floats, weight: Floats, n: Ints, profile: Floats) -> Floats:
    """Rate (stick, sheet) extrapolated to a sheet on the axis that does not creep, (stick,)."""
    weight = np.where(np.isfinite(rate) & np.isfinite(profile), weight, 0.0)
    design = np.stack(
        [np.ones(rate.shape), np.broadcast_to(n - 0.5, rate.shape), np.nan_to_num(profile)], axis=-1
    )
    weighted = design * weight[..., None]
    matrix = np.einsum("esa,esb->eab", weighted, design) + 1e-9 * np.eye(3)
    right = np.einsum("esa,es->ea", weighted, np.where(weight > 0, rate, 0.0))
    return np.linalg.solve(matrix, right[..., None])[:, 0, 0]


# --- movement that slips do not return ----------------------------------------------------------------------


def own_movement(
    middle_px: Floats, slope_px: Floats, frames: StickFrames, settings: DeformationSettings
) -> Floats:
    """Half the steady movement of each sheet in a stick that slips do not return, px, (stick, sheet).

    Paper that settles moves so, and a block that slides. What all sheets share does not count, nor what is
    proportional to their creep.  middle_px: mean positions; slope_px: half the movement to the right, px,
    (stick, sheet).
    """
    rate, error = _net_rate(_without_pushes_between(middle_px, frames, settings), frames, settings)
    own = rate - nan_median(rate)
    creep = nan_median(2 * slope_px / frames.length_s[:, None])
    own = own - creep * np.nansum(own * creep) / max(np.nansum(creep**2), 1e-300)
    return _beyond(own, error, settings) * frames.length_s[:, None] / 2


def repeated_bends(creep: Creep, noise: Noise, settings: DeformationSettings) -> Floats:
    """Size of the bends of the creep that a sheet repeats in most sticks, and others do not, px, (sheet,).

    Sheets that slip in the middle of the others' sticks bend so.  creep: with at least three terms.  The
    scatter of a few sticks may be small by chance, so the noise sets the least error.
    """
    used = (creep.good & (noise.excess <= 1))[..., None]
    known = np.where(used, creep.coefficient, 0.0)
    bend = np.where(used, _without_common_part(known[..., 2:], known[..., 1:2], used), np.nan)
    usual = nan_median(bend)
    scatter = sigma_about_zero(bend - usual)
    scatter = np.fmax(scatter, nan_median(np.where(used, coefficient_errors(creep, noise), np.nan)[..., 2:]))
    error = scatter * np.sqrt(np.pi / 2 / np.maximum(used.sum(axis=0), 1))  # of a median
    error[used.sum(axis=0)[:, 0] < settings.least_repeats] = np.inf
    return np.asarray(np.sqrt((_beyond(usual, error, settings) ** 2).sum(axis=-1)))


def _without_common_part(bend: Floats, slope: Floats, used: Bools) -> Floats:
    """Bends (stick, sheet, ...) minus what the sheets of a stick share: a constant, a part of the slope."""
    bend, slope = centred(bend, used, axis=1), centred(slope, used, axis=1)
    square = np.maximum((slope**2).sum(axis=1, keepdims=True), 1e-12)
    return np.asarray(bend - slope * (bend * slope).sum(axis=1, keepdims=True) / square)


def _net_rate(middle_px: Floats, frames: StickFrames, settings: DeformationSettings) -> tuple[Floats, Floats]:
    """Rate at which the mean positions (stick, sheet) move, px/s, and its standard error, (sheet,). Distant
    sticks are compared, since sheets that miss some slips move randomly between adjacent sticks."""
    apart = max(frames.sticks // 4, 1)  # so few pairs of sticks contain the single jump of a sheet
    elapsed_s = (frames.middle_s[apart:] - frames.middle_s[:-apart])[:, None]
    rates = (middle_px[apart:] - middle_px[:-apart]) / elapsed_s
    rate = nan_median(rates)
    scatter = sigma_about_zero(rates - rate)
    error = scatter / np.sqrt(max(len(rates) / apart, 1.0))  # pairs that have no stick in common
    return rate, np.where(np.isfinite(rates).sum(axis=0) < settings.least_repeats, np.inf, error)


def _beyond(value: Floats, error: Floats, settings: DeformationSettings) -> Floats:
    """Size of the values beyond `own_errors` of their standard errors; 0 where unknown."""
    beyond = value**2 - (settings.own_errors * error) ** 2
    return np.sqrt(np.maximum(np.nan_to_num(beyond), 0.0))
