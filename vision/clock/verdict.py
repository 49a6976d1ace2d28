"""Whether the best alignment may be believed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vision.clock.search import find_alignments
from vision.clock.shuffle import beats_chance
from vision.clock.trains import ALONE, DRIFT_PPM, Clocks, Doubles, Fit, Trains
from vision.force.noise import MAD_TO_SIGMA

LEAST_MARGIN = 6.0
_OVER_CHANCE = 4.0  # over the best of the shuffled trains
_LEAST_LIKELIHOOD, _CLEAR = 14.0, 20.0
_AGAINST = -0.5  # log-likelihood of the sizes at which they do not go together
_LEAST_MATCHED = 6
_LARGEST_SCALE = 1.5
_ALIKE = 0.5  # in the logarithm of neighbouring intervals: what differs more has slips missing or false
_FAR, _FEW = 2.3, 0.05  # errors; even ones, as of a slip between two frames, end at sqrt(3) of theirs
_WANDER = 3.0  # standard errors of the correlation of one residual with the next
_CHANCE = 3.0  # standard deviations of the likelihood of shifts of an even train
_SIMILAR = 0.5  # of the slips: alternatives with fewer in common are no shifts


@dataclass(frozen=True)
class Alignment:
    """The alignments of two trains, best first, and what is against the first ("" where nothing is).

    margin: log-likelihood of the best over the next; inf where it is the only one.
    """

    trains: Trains
    clocks: Clocks
    fit: Fit
    margin: float
    doubt: str

    def errors(self) -> tuple[float, float]:
        """Standard errors of the best clock: at the centre of its slips, s, and of its drift."""
        paired = self.fit.partner[0] >= 0
        weight = (self.trains.error_s[paired] * self.fit.scale[0]) ** -2.0
        if not paired.any():
            return float("nan"), float("nan")
        away = self.trains.video_s[paired] - self.clocks.centre_s[0]
        drift = 1 / np.sqrt((weight * away**2).sum() + (1e-6 * DRIFT_PPM) ** -2)
        return float(1 / np.sqrt(weight.sum())), float(drift)


def align(trains: Trains) -> Alignment:
    """Find the alignments and judge the best.

    It is believed only where its log-likelihood exceeds the next one's by 6 (12 where it is not itself far
    above that of unrelated slips, or the sizes speak against it, and more where the slips lie further apart
    than their errors say), and:
    - it pairs enough slips to be no coincidence of unrelated recordings, and its likelihood exceeds by 4 (8)
      that of the best alignment of shuffled slips;
    - the residuals are what the slips' errors allow and do not wander: unrelated even trains drift through
      each other smoothly;
    - the intervals are uneven enough to tell a shift by one slip, or else the sizes are;
    - the lead over shifts of similar overlap exceeds what slips missed at random on both sides give an even
      train: with shares p and q of the force's and the camera's slips paired, the number of pairs of a
      wrong shift scatters by sqrt(n p (1 - p) (1 - q)).
    """
    clocks, fit = find_alignments(trains)
    margin = float(fit.likelihood[0] - fit.likelihood[1]) if len(fit.likelihood) > 1 else float("inf")
    return Alignment(trains, clocks, fit, margin, _doubt(trains, fit, margin))


def _doubt(trains: Trains, fit: Fit, margin: float) -> str:
    wide = fit.scale[0] ** 2
    # Sizes speak for an alignment only against others: where the times agree by chance, the lengths of the
    # sticks do, and the sizes with them.
    likelihood = fit.likelihood[0] - max(fit.sizes[0], 0.0)
    if fit.matched[0] < _LEAST_MATCHED or likelihood < (_LEAST_LIKELIHOOD if wide == 1 else _CLEAR * wide):
        return f"the {fit.matched[0]} slips in common are too few, or fit too loosely, to tell from chance"
    sure = likelihood >= _CLEAR and fit.sizes[0] > _AGAINST and not _loose(trains, fit)
    strict = wide * (1 if sure else 2)
    needed = LEAST_MARGIN * strict
    if margin <= needed:
        return f"the next alignment fits nearly as well (margin {margin:.1f}, {needed:.3g} needed)"
    if _lead_over_shifts(fit, fit.likelihood) <= _chance_of_shifts(trains, fit):
        return "slips missed on both sides could explain the lead over shifts by whole slips"
    by_sizes = min(_lead_over_shifts(fit, fit.sizes), float(fit.sizes[0]))
    told = _told_by_intervals(trains, fit) + max(by_sizes, 0.0)
    # Unrelated trains that are tried at more offsets agree more often.
    least_told = LEAST_MARGIN + np.log(len(trains.video_s) + len(trains.force_s))
    if told <= max(least_told, _chance_of_shifts(trains, fit)):
        return "the slips are so even that neither times nor sizes tell a shift by one slip"
    if fit.scale[0] > _LARGEST_SCALE:
        return "the slips of the two recordings lie further apart than their errors allow"
    if _wanders(fit, trains):
        return "the residuals wander: the clocks do not differ by an offset and a rate"
    if not beats_chance(trains, fit.likelihood[0], _OVER_CHANCE * strict):
        return "the camera's slips fit nearly as well with their intervals in any other order"
    return ""


def _lead_over_shifts(fit: Fit, value: Doubles) -> float:
    """Of the best alignment's value; inf without another that has as many slips in common."""
    shifts = value[1:][fit.force[1:] >= _SIMILAR * fit.force[0]]
    return float(value[0] - shifts.max(initial=-np.inf))


def _chance_of_shifts(trains: Trains, fit: Fit) -> float:
    matched, force, video = int(fit.matched[0]), int(fit.force[0]), int(fit.video[0])
    p, q = (matched + 1) / (force + 2), (matched + 1) / (video + 2)
    scatter = np.sqrt(max(force * p * (1 - p) * (1 - q), 0.0))
    return float(_CHANCE * scatter * (np.median(trains.earned()) - 2 * ALONE))


def _told_by_intervals(trains: Trains, fit: Fit) -> float:
    """By how much a shift by one slip lowers the likelihood through the unevenness of the intervals alone.

    It moves each slip by how far one interval differs from the usual one; neighbours give the scatter, so
    that a trend is no evidence.
    """
    paired = np.unique(fit.partner[0][fit.partner[0] >= 0])
    interval = np.diff(trains.force_s[paired])
    change = np.abs(np.diff(interval))[np.abs(np.diff(np.log(interval))) < _ALIKE]
    if not len(change):
        return 0.0
    # Errors of the force's slips look uneven, too: three of them, the middle one twice, make a change.
    uneven2 = (MAD_TO_SIGMA * float(np.median(change))) ** 2 / 2 - 3 * trains.force_error_s**2
    error = trains.typical_error_s * fit.scale[0]
    most = np.median(trains.earned()) - 2 * ALONE
    return float(len(interval) * min(0.5 * max(uneven2, 0.0) / error**2, 0.5 * most))


def _loose(trains: Trains, fit: Fit) -> bool:
    """Whether more than a few residuals are larger than a slip between two frames can have."""
    away = np.abs(fit.residual_s[0] / trains.error_s)[fit.partner[0] >= 0] / fit.scale[0]
    return bool(np.mean(away > _FAR) > _FEW)


def _wanders(fit: Fit, trains: Trains) -> bool:
    """Whether neighbouring residuals are alike beyond chance (von Neumann's ratio)."""
    z = (fit.residual_s[0] / trains.error_s)[fit.partner[0] >= 0]
    alike = 1 - np.sum(np.diff(z) ** 2) / (2 * max(np.sum(z**2), np.finfo(float).tiny))
    return bool(alike * np.sqrt(len(z)) > _WANDER)
