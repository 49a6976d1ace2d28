"""Camera movement: what all sheets do together, separated from their own creep.

Vibration is what they do together in each frame beyond their creep.  Drift, steady movement during a stick,
is found from pairs of sheets left and right that creep in opposite directions, or, where one side only is in
view, by what each sheet does in other sticks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vision.deformation.creep import Creep, StickFrames
from vision.deformation.settings import DeformationSettings
from vision.numeric import NORMAL_MEDIAN, Bools, Floats, Ints, nan_median

# --- vibration ----------------------------------------------------------------------------------------------


def common_mode_motion(residual: Floats, settings: DeformationSettings) -> Floats:
    """Common movement in each frame that is no creep, px, (F,); 0 in frames with too few sheets.

    The mean of the residuals about each sheet's own creep, px, (F, sheet), weighted by the inverse of each
    sheet's variance, without outliers.
    """
    spread, weight = _spread_and_weight(residual)
    with np.errstate(invalid="ignore"):
        away = np.abs(residual - nan_median(residual, axis=1)[:, None])
        known = (away <= 8 * spread) & (weight > 0)  # others do not move with the rest
    enough = known.sum(axis=1) >= settings.least_sheets
    total = (known * weight).sum(axis=1)
    moved = np.where(known, residual, 0.0) @ weight
    return np.asarray(np.divide(moved, total, out=np.zeros_like(total), where=enough))


def common_mode_noise_factor(residual: Floats, settings: DeformationSettings) -> Floats:
    """Factor on each sheet's noise variance for the part that `common_mode_motion` takes away, (sheet,)."""
    _, weight = _spread_and_weight(residual)
    if (weight > 0).sum() < settings.least_sheets:
        return np.ones(weight.size)
    return np.asarray(1 / (1 - np.minimum(weight / weight.sum(), 0.5)))


def _spread_and_weight(residual: Floats) -> tuple[Floats, Floats]:
    """Typical residual of each sheet, px, and 1 over its square, (sheet,); the weight is 0 where unknown."""
    spread = nan_median(np.abs(residual))
    usual = nan_median(spread[None], axis=1)[0]
    spread = np.maximum(spread, 0.1 * usual if usual > 0 else 1e-6)
    return spread, np.where(np.isfinite(spread), spread**-2, 0.0)


def camera_pushes(x_px: Floats, frames: StickFrames, settings: DeformationSettings) -> Floats:
    """How far the camera was pushed since each stick's first frame, to the right, px, (F,).

    A push moves all sheets alike, from one frame to the next or the one after; what moves more often is
    vibration. x_px: positions in the frames of the sticks, (F, sheet).
    """
    step_px, step_s = np.diff(x_px, axis=0), np.diff(frames.since_s)
    same = np.diff(frames.row) == 0
    common_px = np.where(same, nan_median(step_px, axis=1), np.nan)
    common_px = common_px - nan_median((common_px / step_s)[:, None])[0] * step_s
    unlike_px = nan_median(np.abs(step_px - nan_median(step_px, axis=1)[:, None]), axis=1)
    pushed = np.r_[False, _stray(common_px, settings) & (np.abs(common_px) > 3 * unlike_px)]
    pushed &= frames.sums(pushed)[frames.row] <= 2
    moved_px = np.cumsum(np.where(pushed, np.r_[0.0, common_px], 0.0))
    first = np.searchsorted(frames.row, frames.row)
    return np.asarray(moved_px - moved_px[first])


# --- drift --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Drift:
    """Common part of one coefficient of the creep in each stick."""

    value: Floats  # px, (stick,); 0 where nothing is known of the camera's drift
    error: Floats  # px, (stick,)
    share: Floats  # weight with which each sheet went into it, (stick, sheet)

    def error_without(self, error: Floats) -> Floats:
        """Errors (stick, sheet) of the coefficients less the drift, of which each sheet is itself a part."""
        return np.asarray(np.sqrt(error**2 * (1 - self.share) + self.error[:, None] ** 2))


def drift_model(
    line: Creep, side: Ints, n: Ints, frames: StickFrames, vibration_px: Floats, settings: DeformationSettings
) -> BothSides | OneSide:
    """The way in which drift can be separated from creep with the sheets in view.

    line: fitted to the positions without vibration.  side, n: of the sheets in order of place.  vibration_px:
    of `common_mode_motion`, (F,).
    """
    middle_px, slope_px = line.coefficient[..., 0], line.coefficient[..., 1]
    rate = np.diff(middle_px, axis=0) / np.diff(frames.middle_s)[:, None]
    slow_px = nan_median(rate) * frames.length_s[:, None] / 2
    both = BothSides.of(side, n, middle_px, slope_px, slow_px, settings)
    return both if both.enough else OneSide.of(line, n, frames, vibration_px, settings)


@dataclass(frozen=True)
class BothSides:
    """Pairs of sheets opposite each other: left and right are their places in the tracks, (pair,)."""

    left: Ints
    right: Ints
    slow_px: Floats  # half the movement to the right by the mean positions in all sticks, (stick, sheet)
    least_pairs: int
    movement = "vibration and drift taken off"

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
        """Pairs by number, overlooked sheets (gaps) counted; by creep, where that puts the axis elsewhere.

        middle_px, slope_px: mean position, and half the movement to the right, (stick, sheet).  slow_px: that
        half from the mean positions in other sticks.
        """
        left, right = np.flatnonzero(side < 0), np.flatnonzero(side > 0)
        n = n + np.where(side < 0, _missing(middle_px, left[::-1]), _missing(middle_px, right))
        found = []
        for shift in (0, -2, -1, 1, 2):  # sheets by which left and right may be numbered unlike
            _, first, second = np.intersect1d(n[left] + shift, n[right], return_indices=True)
            found.append(cls(left[first], right[second], slow_px, settings.least_pairs))
        unlike = np.array([each.asymmetry_px(slope_px) for each in found])
        return found[np.argmin(unlike) if unlike.min() < 0.5 * unlike[0] else 0]

    def asymmetry_px(self, slope_px: Floats) -> float:
        """By how much pairs differ in the same way in every stick; infinite without enough of them."""
        if not self.enough:
            return np.inf
        middle = slope_px[:, self.left] + slope_px[:, self.right]
        away = nan_median(middle - nan_median(middle, axis=1)[:, None])
        return float(np.nan_to_num(np.abs(away)).mean())

    @property
    def enough(self) -> bool:
        """Whether there are enough pairs to tell drift from creep."""
        return self.left.size >= self.least_pairs

    def drift(self, coefficient: Floats, error: Floats, *, slow: bool) -> Drift:
        """Drift of the camera during each stick from coefficients of the creep, to the right, (stick, sheet).

        Creep is inwards on both sides, so half the sum of a pair is what moved the camera, up to the pair's
        asymmetry.  The part of it that all pairs share, as a share of their creep (one side creeps less than
        the other), is found from how half the sums go with the creep within each stick: the camera moves all
        pairs alike.  What is left is larger the nearer the axis, as where a sheet was overlooked on one side;
        it is measured from how the pairs disagree, and the nearly still inner sheets lead.  `slow`: whether
        a camera that moves alike in all sticks must show in the sheets' mean positions, too.  Where it does
        not, it may as well be one side that creeps more: that is part of the error.
        """
        left, right = coefficient[:, self.left], coefficient[:, self.right]
        noise = (error[:, self.left] ** 2 + error[:, self.right] ** 2) / 4
        all_pairs = pair = _Pairs.of(left, right, noise, self.least_pairs)
        asymmetry = 0.2  # to begin with; four rounds suffice to converge
        for _round in range(4):
            weight = pair.known / np.maximum(pair.noise + (asymmetry * pair.step) ** 2, 1e-18)
            total = weight.sum(axis=1)
            share = np.divide(weight, total[:, None], out=np.zeros_like(weight), where=pair.known)
            sides, sides_err = all_pairs.difference_of_sides(weight)
            pair = replace(all_pairs, middle=all_pairs.middle - sides * all_pairs.step)
            value = (share * pair.middle).sum(axis=1)
            asymmetry = pair.asymmetry(value, share)
        of_sheet = np.zeros_like(coefficient)
        of_sheet[:, self.left] = of_sheet[:, self.right] = share
        random = np.divide(1, total, out=np.zeros_like(total), where=total > 0)
        together = np.hypot(pair.common_asymmetry(value, weight), sides_err)
        together = together * (share * pair.step).sum(axis=1)
        shift, shift_err = self._alike_in_all(value, random, share, all_pairs) if slow else (0.0, 0.0)
        return Drift(value + shift, np.sqrt(random + together**2 + shift_err**2), of_sheet)

    def _alike_in_all(
        self, value: Floats, random: Floats, share: Floats, pairs: _Pairs
    ) -> tuple[float, float]:
        """By how much the drift is to be changed in all sticks alike, and the error of that.

        Between none and what makes it agree with where the sheets are in the sticks before and after, as far
        as noise does not explain that; but within what the pair that creeps least leaves, whose sheets do
        not creep outwards.
        """
        slow = (self.slow_px[:, self.left] + self.slow_px[:, self.right]) / 2
        away = float(np.median((share * np.nan_to_num(slow)).sum(axis=1) - value))
        noise = np.pi / 2 * float(np.median(random)) / len(value)  # of a median
        away = np.sign(away) * np.sqrt(max(away**2 - noise, 0.0))
        ends = np.clip((0.0, away), *pairs.allowed(value))
        return float(ends.mean()), float(abs(ends[1] - ends[0])) / 2


@dataclass(frozen=True)
class _Pairs:
    """Half the sum of each pair, half its difference (its creep) and the variance of either, px, 0 where not
    known; asymmetry is measured on the quiet ones.  All (stick, pair)."""

    middle: Floats
    step: Floats
    noise: Floats
    known: Bools
    quiet: Bools

    @classmethod
    def of(cls, left: Floats, right: Floats, noise: Floats, least: int) -> _Pairs:
        """From coefficients; pairs of unusual variance (one slipped by itself) are not quiet."""
        middle, step = (right + left) / 2, (left - right) / 2
        known = np.isfinite(middle) & np.isfinite(noise)
        known &= known.sum(axis=1, keepdims=True) >= least
        quiet = known & (noise <= 9 * np.median(noise[known])) if known.any() else known
        middle, step, noise = (np.where(known, part, 0.0) for part in (middle, step, noise))
        return cls(middle, step, noise, known, quiet)

    def allowed(self, value: Floats) -> tuple[float, float]:
        """Least and most by which the drift may be changed in all sticks alike without either sheet of the
        pair that creeps least creeping outwards, in the middle stick and within two standard errors."""
        step, apart, noise = (
            nan_median(np.where(self.known, part, np.nan))
            for part in (self.step, self.middle - value[:, None], self.noise)
        )
        if not np.isfinite(step).any():
            return 0.0, 0.0
        least = np.nanargmin(np.abs(step))
        creep = abs(step[least]) + 2 * np.sqrt(np.pi / 2 * noise[least] / self.known[:, least].sum())
        return float(apart[least] - creep), float(apart[least] + creep)

    def difference_of_sides(self, weight: Floats) -> tuple[float, float]:
        """Half the sums as a share of the creep, the same for all pairs, and its error from noise.

        0 where the pairs creep alike: there nothing tells it from drift.
        """
        weight = weight * self.quiet
        total = np.maximum(weight.sum(axis=1, keepdims=True), 1e-300)
        step = self.step - (weight * self.step).sum(axis=1, keepdims=True) / total
        told = float((weight * step**2).sum())
        if told <= 4 * float((weight * self.noise).sum()):
            return 0.0, 0.0
        return float((weight * step * self.middle).sum()) / told, told**-0.5

    def asymmetry(self, value: Floats, share: Floats) -> float:
        """RMS asymmetry beyond noise, as a share of the creep."""
        apart = (self.middle - value[:, None]) ** 2 - self.noise * (1 - share)
        steps = max(float((self.step[self.quiet] ** 2).sum()), 1e-18)
        return float(np.sqrt(max(float(apart[self.quiet].sum()), 0.0) / steps))

    def common_asymmetry(self, value: Floats, weight: Floats) -> float:
        """Asymmetry of all pairs in the same direction."""
        weight = weight * self.quiet
        steps = max(float((weight * self.step**2).sum()), 1e-18)
        return float((weight * self.step * (self.middle - value[:, None])).sum()) / steps


def _missing(middle_px: Floats, outwards: Ints) -> Ints:
    """Sheets missing between the innermost and each of those sheets, as (sheet,), 0 for others."""
    out = np.zeros(middle_px.shape[1], np.int64)
    gap = np.abs(np.diff(nan_median(middle_px)[outwards]))
    if np.isfinite(gap).any():
        pitch = float(nan_median(gap))
        missing = np.maximum(np.floor(np.nan_to_num(gap / pitch) - 0.6), 0)  # a gap of 1.6 pitches hides one
        out[outwards[1:]] = np.cumsum(missing)
    return out


@dataclass(frozen=True)
class OneSide:
    """What is needed to tell drift from creep with one side in view.

    In each stick every sheet creeps about as much as in the sticks before and after; what they do beyond, in
    equal measure, is the camera's.  What the camera does in every stick is in the slow movement of the
    sheets' mean positions, extrapolated to the axis, where sheets move with the camera alone.
    """

    profile_px: Floats  # slopes as in the neighbouring sticks, (stick, sheet)
    slow_px: Floats  # slope of the camera's slow movement, (stick,)
    slow_err_px: Floats  # its standard error, (stick,)
    near: Floats  # weights of the neighbouring sticks, (stick, stick)
    unknown_px: Floats  # error of a slope from which nothing can be taken off, (stick,)
    settings: DeformationSettings
    movement = "vibration taken off, and drift as far as one side tells"

    @classmethod
    def of(
        cls, line: Creep, n: Ints, frames: StickFrames, vibration_px: Floats, settings: DeformationSettings
    ) -> OneSide:
        """From the lines fitted to all sheets; what of the vibration (F,) looks like creep is taken to be as
        much as if it were white, where nothing tells."""
        stick = np.arange(frames.sticks)
        away = np.abs(stick[:, None] - stick)
        near = np.maximum(1 - away / (settings.neighbouring_sticks + 1.0), 0.0)
        middle_px, slope_px = line.coefficient[..., 0], line.coefficient[..., 1]
        near = near * ~_stray(nan_median(slope_px - nan_median(slope_px), axis=1), settings)
        profile_px = _mean(near * (away > 0), slope_px)
        rest_px = middle_px - _pushed_between(middle_px, frames.middle_s, settings)[:, None]
        slow_px_s = _at_axis(*_rate(near, frames.middle_s, rest_px), n, profile_px)
        at_rest_px = _at_axis(rest_px, np.isfinite(rest_px).astype(float), n, profile_px)
        walk_px = _random_walk(at_rest_px)
        slow_err_px = walk_px / 2 * np.sqrt(1.2 / np.maximum(near.sum(axis=1), 1))
        variance_px2 = float((vibration_px**2).sum()) / max(vibration_px.size, 1)
        white_px = np.sqrt(3 * variance_px2 / np.maximum(frames.counts, 1))
        return cls(profile_px, slow_px_s * frames.length_s / 2, slow_err_px, near, white_px, settings)

    def drift(self, coefficient: Floats, error: Floats, *, slow: bool) -> Drift:
        """Drift of the camera during each stick; 0 where sheets creep too much alike, or are too few.

        coefficient, error: of the creep, to the right, px, (stick, sheet), NaN where unknown.  slow: whether
        slow movement has a part in this coefficient.
        """
        known = np.isfinite(coefficient) & np.isfinite(self.profile_px) & np.isfinite(error)
        weight = np.where(known, 1 / np.where(known, error, 1.0) ** 2, 0.0)
        value, profile = np.where(known, coefficient, 0.0), np.where(known, self.profile_px, 0.0)
        total = np.maximum(weight.sum(axis=1), 1e-300)
        creep, moved = ((weight * part).sum(axis=1) / total for part in (profile, value))
        away = profile - creep[:, None]
        spread = (weight * away**2).sum(axis=1)
        count = known.sum(axis=1)
        clear = (count >= self.settings.least_sheets) & (spread > self.settings.one_side_contrast * count)
        spread = np.maximum(spread, 1e-300)
        beyond = np.where(clear, moved - (weight * away * value).sum(axis=1) / spread * creep, 0.0)
        # The same in each of these sticks, it would pass for creep: as much as chance leaves in their mean.
        shared = (self.near**2 @ beyond**2) / np.maximum(self.near @ clear, 1.0) ** 2
        error = np.sqrt(1 / total + creep**2 / spread + shared)
        # Noise alone passes for a walk of up to about three errors.
        walked = slow & (self.slow_err_px > 3 * error)
        error = np.hypot(error, np.where(walked, self.slow_err_px, 0.0))
        found = beyond + (self.slow_px if slow else 0.0)
        return Drift(
            np.where(clear, found, 0.0), np.where(clear, error, self.unknown_px), np.zeros_like(weight)
        )


def _pushed_between(middle_px: Floats, middle_s: Floats, settings: DeformationSettings) -> Floats:
    """How far the camera was pushed between sticks since the first one, px, (stick,)."""
    known = np.flatnonzero(np.isfinite(middle_px).any(axis=1))
    between_s = np.diff(middle_s[known])[:, None]
    shift_px = np.diff(middle_px[known], axis=0)
    common_px = nan_median(shift_px - nan_median(shift_px / between_s) * between_s, axis=1)
    pushed_px = np.zeros(len(middle_px))
    pushed_px[known[1:]] = np.where(_stray(common_px, settings), common_px, 0.0)
    return np.cumsum(pushed_px)


def _random_walk(place_px: Floats) -> float:
    """RMS step, px, of a camera that moves at slips, too, from stick to stick; drift, which goes on as it
    went, is left out."""
    change_px = np.diff(place_px, n=2)
    return float(np.median(np.abs(change_px))) / NORMAL_MEDIAN / np.sqrt(2) if change_px.size else 0.0


def _stray(common_px: Floats, settings: DeformationSettings) -> Bools:
    """Where what all sheets do together is unlike all else: the camera was pushed, (n,)."""
    away = np.abs(common_px)
    return np.asarray(away > settings.jump_spreads * nan_median(away[:, None])[0])


def _mean(near: Floats, value: Floats) -> Floats:
    """Weighted mean over the neighbouring sticks, (stick, sheet); NaN without any."""
    known = np.isfinite(value)
    count = near @ known
    return np.where(count > 0, near @ np.where(known, value, 0.0) / np.maximum(count, 1e-300), np.nan)


def _rate(near: Floats, time_s: Floats, value: Floats) -> tuple[Floats, Floats]:
    """Slope of value (stick, sheet) against time, px/s, over the neighbouring sticks, and its weight, which
    is less for sheets that few of them show."""
    known = np.isfinite(value)
    time = np.where(known, time_s[:, None], np.nan)
    product, square = (
        _mean(near, time * part) - _mean(near, time) * _mean(near, part) for part in (value, time)
    )
    weight = np.nan_to_num(square) * (near @ known)
    weight = weight / np.maximum(weight.max(axis=1, keepdims=True), 1e-300)
    with np.errstate(divide="ignore", invalid="ignore"):
        return product / square, np.where(weight > 1e-6, weight, 0.0)


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
